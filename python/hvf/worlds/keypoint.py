"""The keypoint models as the planner wants them.

Perception runs in torch, rollouts and costs in Rust (`hvf_core.KeypointWorld`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import hvf_core
from hvf.models.frames import to_frames, to_unit
from hvf.models.keypoint.dynamics import KeypointDynamics
from hvf.models.keypoint.generator import KeypointGenerator
from hvf.settings import OverHorizon, Planning
from hvf.threads import one_thread
from hvf.worlds.world import Around, checked_images

_IMAGES_AT_ONCE = 512
# Drawing takes a few numbers a pixel: so many images stay in the caches, and in memory that is
# there already.
_IMAGES_IN_CACHE = 32


class KeypointWorld(Around):
    """The compact dynamics model as a world model (`hvf.protocols.WorldModel`).

    Args:
        dynamics: the trained model.
        blur: standard deviation in pixels of the Gaussian blur through which predicted frames and
            goals are compared; 0 for none.
        over_horizon: whether the last predicted frame counts, their sum, or their minimum.
    """

    def __init__(
        self, dynamics: KeypointDynamics, blur: float = 0.0, over_horizon: OverHorizon = "last"
    ) -> None:
        self.dynamics = dynamics.eval()
        config, perception = dynamics.config, dynamics.perception
        weights = {
            name: tensor.detach().cpu().numpy() for name, tensor in dynamics.state_dict().items()
        }
        limit = np.full(config.action_dim, config.action_scale, np.float32)
        self._native = hvf_core.KeypointWorld(
            patch=weights["cell.patch.weight"],
            patch_bias=weights["cell.patch.bias"],
            context=weights["cell.context.weight"],
            middle=weights["cell.middle.weight"],
            middle_bias=weights["cell.middle.bias"],
            output=weights["cell.output.weight"],
            output_bias=weights["cell.output.bias"],
            free=weights["cell.free.weight"],
            action_scale=config.action_scale,
            spacing=config.cell.spacing,
            substeps=config.cell.substeps,
            half_size=perception.half_size.tolist(),
            edge=perception.edge.tolist(),
            colour=perception.colour.tolist(),
            action_low=(-limit).tolist(),
            action_high=limit.tolist(),
            image_size=config.perception.image_size,
            blur=blur,
            over_horizon=over_horizon,
        )

    @property
    def native(self) -> hvf_core.KeypointWorld:
        """What the planner runs without the GIL, and what the methods here speak for."""
        return self._native

    @property
    def inner(self) -> Any:
        """The world in Rust."""
        return self.native

    def observe(self, images: NDArray[np.uint8]) -> hvf_core.KeypointFrames:
        """Frames of uint8 `images [N, S, S, 3]`.

        Raises:
            ValueError: images of another size than the model's.
            TypeError: images that are not uint8.
        """
        size = self.dynamics.config.perception.image_size
        images = checked_images(images, size, size)
        device = self.dynamics.perception.colour.device
        with one_thread():
            parts = torch.split(torch.from_numpy(images), _IMAGES_AT_ONCE)
            observed = [self.dynamics.observe(part.to(device)) for part in parts]
            keypoints = torch.cat([keypoint for keypoint, _ in observed]).cpu().numpy()
            maps = torch.cat([scene for _, scene in observed]).cpu().numpy()
        return self.native.frames(images, keypoints, maps)

    def rollout_costs(
        self,
        starts: hvf_core.KeypointFrames,
        goals: hvf_core.KeypointFrames,
        actions: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Planning costs float32 `[B, D]` of `actions [B, D, H, A]`."""
        return self.native.rollout_costs(starts, goals, actions)

    def predict(
        self, starts: hvf_core.KeypointFrames, actions: NDArray[np.float32]
    ) -> NDArray[np.uint8]:
        """Predicted frames uint8 `[N, H, S, S, 3]` for `actions [N, H, A]`, to look at."""
        drawn = self.drawn(starts, self.rollout(starts, actions[:, None]))[:, 0]
        shape = (*drawn.shape[:2], *starts.images.shape[1:])
        return to_frames(drawn.flatten(0, 1)).numpy().reshape(shape)

    def rollout(
        self, starts: hvf_core.KeypointFrames, actions: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Predicted keypoints `[B, D, H, 2]` for `actions [B, D, H, A]`."""
        path: NDArray[np.float32] = self.native.rollout(starts, np.ascontiguousarray(actions))
        return path

    def drawn(self, starts: hvf_core.KeypointFrames, path: NDArray[np.float32]) -> torch.Tensor:
        """Images of keypoints `path [B, D, H, 2]`, about in [0, 1], float `[B, D, H, 3, S, S]`."""
        images = to_unit(torch.from_numpy(starts.images))
        before = torch.from_numpy(starts.keypoints)
        if len(images) > 1:
            each = path.shape[1] * path.shape[2]
            images, before = (part.repeat_interleave(each, dim=0) for part in (images, before))
        with one_thread():
            points = torch.from_numpy(np.ascontiguousarray(path)).flatten(0, 2)
            drawn: torch.Tensor = self.dynamics.draw(images, before, points)
        return drawn.reshape(*path.shape[:3], *drawn.shape[1:])


class KeypointSubgoals:
    """Subgoals drawn by the keypoint generator (`hvf.protocols.SubgoalModel`)."""

    def __init__(self, generator: KeypointGenerator, world: KeypointWorld) -> None:
        expected = world.dynamics.config.perception.image_size
        found = generator.config.image_size
        if expected != found:
            raise ValueError(
                f"generator: made for images of {found} pixels, the world's have {expected}"
            )
        self.generator = generator.eval()
        self.world = world

    @property
    def latent_dim(self) -> int:
        """Latent dimensions of one image."""
        return self.generator.config.latent_dim

    def decode(
        self, scene: hvf_core.KeypointFrames, latents: NDArray[np.float32]
    ) -> hvf_core.KeypointFrames:
        """Frames `[M * K]` for `latents [M, K, L]` in the scene of `scene [1]`, sample-major."""
        dynamics = self.world.dynamics
        with one_thread():
            keypoints = self.points(scene, latents)
            start, before = (
                to_unit(torch.from_numpy(scene.images)),
                torch.from_numpy(scene.keypoints),
            )
            images = [
                to_frames(dynamics.draw(start, before, some)).numpy()
                for some in torch.split(keypoints, _IMAGES_IN_CACHE)
            ]
        return scene.moved(np.concatenate(images), keypoints.numpy())

    def points(self, scene: hvf_core.KeypointFrames, latents: NDArray[np.float32]) -> torch.Tensor:
        """Keypoints `[M * K, 2]` of the same frames, of which nothing is drawn."""
        count = latents.shape[0] * latents.shape[1]
        code = self.generator.code(torch.from_numpy(scene.maps))
        flat = torch.from_numpy(np.ascontiguousarray(latents).reshape(count, -1))
        return self.generator.decode(flat, code.expand(count, -1))


def world_of(dynamics: KeypointDynamics, planning: Planning) -> KeypointWorld:
    """The world that a trained model is, with the cost of plan settings."""
    return KeypointWorld(dynamics, planning.blur, planning.over_horizon)


def subgoals_of(generator: KeypointGenerator, world: object) -> KeypointSubgoals:
    """Subgoals drawn by a trained generator in a keypoint world.

    Raises:
        ValueError: another kind of world, whose frames have no keypoints.
    """
    inner = getattr(world, "world", world)
    if not isinstance(inner, KeypointWorld):
        kind = type(world).__name__
        raise ValueError(f"generator: keypoint-generator needs keypoint dynamics, got {kind}")
    return KeypointSubgoals(generator, inner)
