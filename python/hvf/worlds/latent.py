"""The latent model as the planner wants it.

Frames are seen in torch; states are rolled out, read out and compared in Rust
(`hvf_core.LatentWorld`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

import hvf_core
from hvf.models.frames import to_frames, to_unit
from hvf.models.latent.model import LatentModel
from hvf.models.latent.network import Block, Residual
from hvf.protocols import Images
from hvf.settings import OverHorizon, Planning
from hvf.threads import one_thread
from hvf.worlds.world import Around, checked_images

_IMAGES_AT_ONCE = 256

Layer = tuple[NDArray[np.float32], NDArray[np.float32]]


class LatentWorld(Around):
    """The latent model as a world model (`hvf.protocols.WorldModel`).

    Its cost is the squared distance of blurred and reduced frames, per pixel of these.

    Args:
        model: the trained model.
        blur: of the plan's settings. The model sees through a blur of its own, and no further
            one is added: less is not to be had, more is refused.
        over_horizon: whether the last predicted frame counts, their sum, or their minimum. A model
            with ``hold`` predicts, and is compared at, every ``hold``-th step only.
        action_repeat: steps that a planned action is held for: a multiple of the model's ``hold``.

    Raises:
        ValueError: more blur than the model's, or an ``action_repeat`` that it cannot take.
    """

    def __init__(
        self,
        model: LatentModel,
        blur: float = 0.0,
        over_horizon: OverHorizon = "last",
        action_repeat: int = 1,
    ) -> None:
        config = model.config
        if blur > config.blur:
            raise ValueError(
                f"blur: this model sees through a blur of {config.blur} pixels and compares "
                f"through no other, got {blur}"
            )
        if action_repeat % model.hold:
            raise ValueError(
                f"action_repeat: must be a multiple of {model.hold}, the steps for which this "
                f"model holds an action; got {action_repeat}"
            )
        self.model = model.eval()
        # Distances of scaled coefficients times this are those of frames, per pixel.
        self._scale = model.basis.scale / config.cells**0.5
        factor = self._scale.cpu().numpy()
        matrix, bias = _layer(model.readout.output)
        self._native = hvf_core.LatentWorld(
            config.action_low,
            config.action_high,
            _network(model.network),
            readout={
                "input": _layer(model.readout.input),
                "blocks": [],
                "output": (factor[:, None] * matrix, factor * bias),
                "activation": "sin",
            },
            over_horizon=over_horizon,
            hold=model.hold,
        )

    @property
    def native(self) -> hvf_core.LatentWorld:
        """The world in Rust, which the planner runs without the GIL."""
        return self._native

    @property
    def inner(self) -> Any:
        """The world in Rust."""
        return self.native

    def observe(self, images: Images) -> hvf_core.LatentFrames:
        """Frames of uint8 ``images [N, H, W, 3]``.

        Raises:
            ValueError: images of another size than the model's.
            TypeError: images that are not uint8.
        """
        images = checked_images(images, *self.model.config.image_size)
        basis, cells = self.model.basis, self.model.config.cells
        found: list[tuple[Tensor, ...]] = []
        with one_thread():
            for part in torch.split(torch.from_numpy(images), _IMAGES_AT_ONCE):
                unit = to_unit(part.to(basis.mean.device))
                seen = basis(unit)
                outside = basis.outside(unit) / cells
                found.append((self.model.encoder(seen), seen * self._scale, outside))
            latents, targets, constants = (
                torch.cat(column).cpu().numpy() for column in zip(*found, strict=True)
            )
        return hvf_core.LatentFrames(latents, targets, constants, images)

    def rollout_costs(
        self,
        starts: hvf_core.LatentFrames,
        goals: hvf_core.LatentFrames,
        actions: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Planning costs float32 ``[B, D]`` of ``actions [B, D, H, A]``."""
        return self.native.rollout_costs(starts, goals, actions)

    def predict(self, starts: hvf_core.LatentFrames, actions: NDArray[np.float32]) -> Images:
        """Predicted frames uint8 ``[N, H, S, S, 3]`` for ``actions [N, H, A]``, to look at.

        A model with ``hold`` predicts every ``hold``-th frame; those in between are copies of the
        next one that it predicts.
        """
        horizon, hold = actions.shape[1], self.model.hold
        device = self.model.basis.mean.device
        drawn = []
        with one_thread():
            first = to_unit(torch.from_numpy(starts.images).to(device))
            done = torch.from_numpy(np.ascontiguousarray(actions[:, ::hold])).to(device)
            state = self.model.start(first[:, None], done[:, :0])
            for h in range(done.shape[1]):
                state = self.model.step(state, done[:, h], None)
                drawn.append(to_frames(self.model.images(state)))
            images: Images = torch.stack(drawn, 1).cpu().numpy()
        return np.ascontiguousarray(images.repeat(hold, axis=1)[:, :horizon])


def world_of(model: LatentModel, planning: Planning) -> LatentWorld:
    """The world that a trained latent model is, with the cost of plan settings.

    Raises:
        ValueError: more blur than the model's, or an ``action_repeat`` that it cannot take.
    """
    return LatentWorld(model, planning.blur, planning.over_horizon, planning.action_repeat)


def _layer(layer: nn.Linear) -> Layer:
    """Weights and bias of a linear layer."""
    return layer.weight.detach().cpu().numpy(), layer.bias.detach().cpu().numpy()


def _network(network: Residual) -> dict[str, Any]:
    """Weights of a network with residual blocks, as the world in Rust takes them."""
    blocks = [block for block in network.blocks if isinstance(block, Block)]
    return {
        "input": _layer(network.input),
        "blocks": [(_layer(block.first), _layer(block.second)) for block in blocks],
        "output": _layer(network.output),
        "activation": "relu",
    }
