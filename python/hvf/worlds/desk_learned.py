"""The learned models of the desk as the planner wants them.

A candidate costs the squared distance, per pixel, of its last predicted frame to the goal image.
With `d` the change of features from start to last frame, `e` the goal less the start image, and `B`
the images of the features, that is `|B d - e|^2 = d (B^T B) d - 2 d (B^T e) + |e|^2`: the first
matrix belongs to the model, the others to the problem, and no frame is drawn.

Letters in shapes: `B` problems, `D` candidates, `H` steps, `A` action dimensions, `S` image size,
`F` features, `X` length of a state.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hvf.models.frames import to_unit
from hvf.models.parts_dynamics import PartsDynamics

_IMAGES_AT_ONCE = 256
# Rollouts of this many candidates stay in the processor's cache.
_CANDIDATES_AT_ONCE = 2000


@dataclass(frozen=True)
class DeskFrames:
    """Images and what the model sees in them.

    Attributes:
        images: uint8 `[N, S, S, 3]`.
        states: float32 `[N, X]`.
        features: float32 `[N, F]`.
    """

    images: NDArray[np.uint8]
    states: Tensor
    features: Tensor

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.images)

    def __getitem__(self, index: NDArray[np.int64]) -> DeskFrames:
        """Return the frames at `index`, an int64 array."""
        places = torch.from_numpy(np.asarray(index, np.int64)).to(self.states.device)
        return DeskFrames(self.images[index], self.states[places], self.features[places])


class DeskLearnedWorld:
    """The compact dynamics of the desk as a world model (`hvf.protocols.WorldModel`).

    Args:
        dynamics: the trained model, on the device to plan on.
    """

    def __init__(self, dynamics: PartsDynamics) -> None:
        self.dynamics = dynamics.eval().requires_grad_(False)
        self.gram = dynamics.gram()
        self._device = dynamics.state_mean.device

    @property
    def action_low(self) -> NDArray[np.float32]:
        """Lowest action, float32 `[A]`."""
        return -self.action_high

    @property
    def action_high(self) -> NDArray[np.float32]:
        """Highest action, float32 `[A]`."""
        return np.ones(self.dynamics.config.hand.action_dim, np.float32)

    def observe(self, images: NDArray[np.uint8]) -> DeskFrames:
        """Frames of uint8 `images [N, S, S, 3]`.

        Raises:
            ValueError: images of another size than the model's.
            TypeError: images that are not uint8.
        """
        size = self.dynamics.config.parts.image_size
        if images.dtype != np.uint8:
            raise TypeError(f"images: must be uint8, got {images.dtype}")
        if images.ndim != 4 or images.shape[1:] != (size, size, 3):
            raise ValueError(f"images: expected shape [N, {size}, {size}, 3], got {images.shape}")
        images = np.ascontiguousarray(images)
        with torch.inference_mode():
            parts = torch.split(torch.from_numpy(images), _IMAGES_AT_ONCE)
            states = torch.cat([self.dynamics.observe(part.to(self._device)) for part in parts])
            return DeskFrames(images, states, self.dynamics.features(states))

    def rollout_costs(
        self, starts: DeskFrames, goals: DeskFrames, actions: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Planning costs float32 `[B, D]` of `actions [B, D, H, A]`."""
        with torch.inference_mode():
            problems, candidates = actions.shape[:2]
            moves = torch.from_numpy(actions).to(self._device).flatten(0, 1)
            owner = torch.arange(problems, device=self._device).repeat_interleave(candidates)
            linear, constant = self._aims(starts, goals)
            costs = []
            for chosen, b in zip(
                torch.split(moves, _CANDIDATES_AT_ONCE),
                torch.split(owner, _CANDIDATES_AT_ONCE),
                strict=True,
            ):
                change = self._last(starts.states[b], chosen) - starts.features[b]
                quadratic = ((change @ self.gram) * change).sum(dim=1)
                costs.append(quadratic - 2.0 * (change * linear[b]).sum(dim=1) + constant[b])
            return self._per_pixel(torch.cat(costs).reshape(problems, candidates))

    def shared_rollout_costs(
        self, start: DeskFrames, goals: DeskFrames, actions: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Planning costs float32 `[B, D]` of `actions [D, H, A]` from one start for every goal.

        Equal to those of :meth:`rollout_costs` up to the rounding of float32 sums.
        """
        with torch.inference_mode():
            moves = torch.from_numpy(actions).to(self._device)
            linear, constant = self._aims(start, goals)
            costs = []
            for chosen in torch.split(moves, _CANDIDATES_AT_ONCE):
                before = start.states.expand(len(chosen), -1)
                change = self._last(before, chosen) - start.features
                quadratic = ((change @ self.gram) * change).sum(dim=1)
                costs.append(quadratic - 2.0 * linear @ change.T + constant[:, None])
            return self._per_pixel(torch.cat(costs, dim=1))

    def predict(self, starts: DeskFrames, actions: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Predicted frames uint8 `[N, H, S, S, 3]` for `actions [N, H, A]`, to look at."""
        with torch.inference_mode():
            moves = torch.from_numpy(actions).to(self._device)
            path = self.dynamics.rollout(starts.states, moves)
            images = to_unit(torch.from_numpy(starts.images).to(self._device))
            drawn = [
                self.dynamics.draw(images, starts.states, path[:, h]).clamp(0, 1)
                for h in range(path.shape[1])
            ]
            frames = (torch.stack(drawn, dim=1) * 255).round().to(torch.uint8)
            return np.ascontiguousarray(frames.permute(0, 1, 3, 4, 2).cpu().numpy())

    def _last(self, states: Tensor, actions: Tensor) -> Tensor:
        """Features `[N, F]` after `actions [N, H, A]` from `states [N, X]`."""
        path = self.dynamics.rollout(states, actions.clamp(-1, 1), last=True)
        return self.dynamics.features(path[:, 0])

    def _aims(self, starts: DeskFrames, goals: DeskFrames) -> tuple[Tensor, Tensor]:
        """What of a cost depends on the problem: linear part `[B, F]` and constant `[B]`."""
        first = to_unit(torch.from_numpy(starts.images).to(self._device))
        last = to_unit(torch.from_numpy(goals.images).to(self._device))
        wanted = last - first
        return self.dynamics.correlations(wanted), wanted.square().sum(dim=(1, 2, 3))

    def _per_pixel(self, costs: Tensor) -> NDArray[np.float32]:
        size = self.dynamics.config.parts.image_size
        result: NDArray[np.float32] = (costs / size**2).float().cpu().numpy()
        return result
