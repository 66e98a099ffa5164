"""The layers model as the planner wants it.

Perception runs in torch; rollouts, drawn frames and costs in Rust (`hvf_core.LayerWorld`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

import hvf_core
from hvf.models.frames import to_frames
from hvf.models.layers.dynamics import LayerDynamics
from hvf.models.layers.perception import Scene
from hvf.settings import OverHorizon, Planning
from hvf.threads import one_thread
from hvf.worlds.world import Around, checked_images

_IMAGES_AT_ONCE = 64


class LayerWorld(Around):
    """The layers model as a world model (`hvf.protocols.WorldModel`).

    Args:
        dynamics: the trained model.
        blur: standard deviation in pixels of the Gaussian blur through which predicted frames and
            goals are compared; 0 for none.
        over_horizon: whether the last predicted frame counts, their sum, or their minimum.
        hold: steps that each action is held for; only frames after a held action count.
        scene_weight: how often what is behind the arm counts, beside the whole image.
    """

    def __init__(
        self,
        dynamics: LayerDynamics,
        blur: float = 0.0,
        over_horizon: OverHorizon = "last",
        hold: int = 1,
        scene_weight: float = 0.0,
    ) -> None:
        self.dynamics = dynamics.eval().requires_grad_(False)
        self.hold = hold
        cell, perception = dynamics.cell, dynamics.perception
        gallery = perception.gallery
        self._device = perception.sprites.device
        self._native = hvf_core.LayerWorld(
            hand=_layers(cell.hand),
            sliders=[_layers(network) for network in cell.sliders],
            parts=_layers(cell.parts),
            contact=cell.contact.cpu().numpy(),
            reach=cell.config.reach,
            arm_low=gallery.low.tolist(),
            arm_step=gallery.step.tolist(),
            arm_places=gallery.config.places,
            arm_patches=gallery.patches.cpu().numpy(),
            arm_index=gallery.index.int().cpu().numpy(),
            table=perception.backdrop.table.cpu().numpy(),
            sprites=perception.sprites.cpu().numpy(),
            blur=blur,
            over_horizon=over_horizon,
            hold=hold,
            scene_weight=scene_weight,
        )

    @property
    def native(self) -> hvf_core.LayerWorld:
        """What the planner runs without the GIL, and what the methods here speak for."""
        return self._native

    @property
    def inner(self) -> Any:
        """The world in Rust."""
        return self.native

    def observe(self, images: NDArray[np.uint8]) -> hvf_core.LayerFrames:
        """Frames of uint8 `images [N, S, S, 3]`.

        Raises:
            ValueError: images of another size than the model's.
            TypeError: images that are not uint8.
        """
        size = self.dynamics.config.perception.image_size
        images = checked_images(images, size, size)
        with one_thread():
            parts = torch.split(torch.from_numpy(images), _IMAGES_AT_ONCE)
            scenes = [self.dynamics.perception.scene(part.to(self._device)) for part in parts]
            if scenes:
                self.dynamics.perception.check(parts[0].to(self._device), scenes[0].states)
        return self._frames(images, scenes)

    def changed(
        self, scene: hvf_core.LayerFrames, states: NDArray[np.float32]
    ) -> hvf_core.LayerFrames:
        """Frames that `scene [1]` becomes at `states [N, X]`, as the model draws them.

        Raises:
            ValueError: more than one scene, states of another length than the model's, or states
                that are not finite.
        """
        perception = self.dynamics.perception
        length = perception.config.state_size
        if len(scene) != 1:
            raise ValueError(f"scene: expected one frame, got {len(scene)}")
        if states.ndim != 2 or states.shape[1] != length:
            raise ValueError(f"states: expected shape [N, {length}], got {states.shape}")
        if not np.isfinite(states).all():
            raise ValueError("states: must be finite")
        images, scenes = [], []
        with one_thread():
            start = perception.scene(torch.from_numpy(scene.images).to(self._device))
            tensor = torch.from_numpy(np.ascontiguousarray(states, np.float32)).to(self._device)
            for part in torch.split(tensor, _IMAGES_AT_ONCE):
                scenes.append(perception.change(start, part))
                images.append(to_frames(perception.with_arm(scenes[-1])).cpu().numpy())
        return self._frames(np.concatenate(images), scenes)

    def rollout_costs(
        self,
        starts: hvf_core.LayerFrames,
        goals: hvf_core.LayerFrames,
        actions: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Planning costs float32 `[B, D]` of `actions [B, D, H, A]`."""
        return self.native.rollout_costs(starts, goals, actions)

    def shared_rollout_costs(
        self,
        start: hvf_core.LayerFrames,
        goals: hvf_core.LayerFrames,
        actions: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Planning costs float32 `[B, D]` of `actions [D, H, A]` from one start for every goal.

        They are those of :meth:`rollout_costs`, to the last bit.
        """
        return self.native.shared_rollout_costs(start, goals, actions)

    def rollout(
        self, starts: hvf_core.LayerFrames, actions: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Predicted states `[B, D, H / hold, X]` that count, for `actions [B, D, H, A]`."""
        path = self.native.rollout(starts, np.ascontiguousarray(actions))
        counted: NDArray[np.float32] = path[:, :, self.hold - 1 :: self.hold]
        return counted

    def predict(
        self, starts: hvf_core.LayerFrames, actions: NDArray[np.float32]
    ) -> NDArray[np.uint8]:
        """Predicted frames uint8 `[N, H, S, S, 3]` for `actions [N, H, A]`, to look at."""
        return self.native.predict(starts, actions)

    def _frames(self, images: NDArray[np.uint8], scenes: list[Scene]) -> hvf_core.LayerFrames:
        clean = torch.cat([scene.image for scene in scenes]).permute(0, 2, 3, 1).contiguous()
        regions = torch.cat([scene.regions for scene in scenes])
        states = torch.cat([scene.states for scene in scenes])
        return self.native.frames(
            images, clean.cpu().numpy(), regions.cpu().numpy(), states.cpu().numpy()
        )


def world_of(dynamics: LayerDynamics, planning: Planning) -> LayerWorld:
    """The world that a trained model is, with the cost of plan settings."""
    return LayerWorld(
        dynamics,
        planning.blur,
        planning.over_horizon,
        planning.action_repeat,
        planning.scene_weight,
    )


def _layers(network: nn.Module) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Weights and bias of every linear layer of `network`."""
    return [
        (layer.weight.detach().cpu().numpy(), layer.bias.detach().cpu().numpy())
        for layer in network.modules()
        if isinstance(layer, nn.Linear)
    ]
