"""The latent model as the planner wants it: states rolled out, and read out only to be compared."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hvf.models.frames import to_frames, to_unit
from hvf.models.latent.model import LatentModel
from hvf.protocols import Images
from hvf.settings import OverHorizon, Planning
from hvf.worlds.threads import one_thread
from hvf.worlds.world import checked_images

_IMAGES_AT_ONCE = 256


@dataclasses.dataclass(frozen=True)
class LatentFrames:
    """What the latent model sees in images.

    Attributes:
        images: uint8 ``[N, H, W, 3]``.
        states: to start from, float32 ``[N, S]``.
        targets: what read-outs are compared with, float32 ``[N, Z]``.
        constants: squared distance of the images from what a read-out can be, float32 ``[N]``.
    """

    images: Images
    states: NDArray[np.float32]
    targets: NDArray[np.float32]
    constants: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: NDArray[np.int64]) -> LatentFrames:
        return LatentFrames(
            self.images[index], self.states[index], self.targets[index], self.constants[index]
        )


class LatentWorld:
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
        if blur > model.config.blur:
            raise ValueError(
                f"blur: this model sees through a blur of {model.config.blur} pixels and compares "
                f"through no other, got {blur}"
            )
        if action_repeat % model.hold:
            raise ValueError(
                f"action_repeat: must be a multiple of {model.hold}, the steps for which this "
                f"model holds an action; got {action_repeat}"
            )
        self.model = model.eval()
        self.over_horizon = over_horizon
        # Distances of scaled coefficients times this are those of frames, per pixel.
        self._scale = model.basis.scale / model.config.cells**0.5

    @property
    def action_low(self) -> NDArray[np.float32]:
        """Lowest action, float32 ``[A]``."""
        return np.array(self.model.config.action_low, np.float32)

    @property
    def action_high(self) -> NDArray[np.float32]:
        """Highest action, float32 ``[A]``."""
        return np.array(self.model.config.action_high, np.float32)

    def observe(self, images: Images) -> LatentFrames:
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
            columns = [torch.cat(column).cpu().numpy() for column in zip(*found, strict=True)]
        return LatentFrames(images, *columns)

    def rollout_costs(
        self, starts: LatentFrames, goals: LatentFrames, actions: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Planning costs float32 ``[B, D]`` of ``actions [B, D, H, A]``."""
        hold, device = self.model.hold, self.model.basis.mean.device
        with one_thread():
            units = self.model.unit_actions(torch.from_numpy(actions[:, :, ::hold]).to(device))
            targets = torch.from_numpy(goals.targets).to(device)[:, None]
            constants = torch.from_numpy(goals.constants).to(device)[:, None]
            states = torch.from_numpy(starts.states).to(device)[:, None]
            states = states.expand(-1, units.shape[1], -1)
            costs = []
            for h in range(units.shape[2]):
                states = self.model.moved(states, units[:, :, h])
                if self.over_horizon != "last" or h == units.shape[2] - 1:
                    missed = self.model.read(states) * self._scale - targets
                    costs.append(missed.square().sum(-1) + constants)
            every = torch.stack(costs)
            whole = every.amin(0) if self.over_horizon == "min" else every.sum(0)
        found: NDArray[np.float32] = whole.cpu().numpy()
        return found

    def predict(self, starts: LatentFrames, actions: NDArray[np.float32]) -> Images:
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
