"""Other planning costs than pixels: distance in a VAE's latent, and learned temporal distance.

Rollouts stay in Rust; the distance is a torch model that is asked once for all candidates of all
problems. Both are slower than the pixel cost, which has a closed form: the temporal distance by
about an order of magnitude, the latent cost, which has to draw and encode frames, by three.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import hvf_core
from hvf.models.frames import to_unit
from hvf.models.temporal_distance import TemporalDistance
from hvf.models.vae import CVAE
from hvf.worlds.keypoint import KeypointWorld, OverHorizon

_AT_ONCE = 512


class Distance(Protocol):
    """How far predicted frames are from goals."""

    def __call__(
        self, starts: hvf_core.KeypointFrames, goals: hvf_core.KeypointFrames, path: Tensor
    ) -> Tensor:
        """Distances `[B, D, H]` of predicted keypoints `path [B, D, H, 2]` to `goals [B]`."""
        ...


class LatentDistance:
    """Squared distance between the latents of drawn frames and goal (means of the posterior)."""

    def __init__(self, cvae: CVAE, world: KeypointWorld) -> None:
        self.cvae = cvae.eval()
        self.dynamics = world.dynamics

    def __call__(
        self, starts: hvf_core.KeypointFrames, goals: hvf_core.KeypointFrames, path: Tensor
    ) -> Tensor:
        """Distances; see :class:`Distance`."""
        first = to_unit(torch.from_numpy(starts.images))
        aim, _ = self.cvae.encode(to_unit(torch.from_numpy(goals.images)), first)
        before = torch.from_numpy(starts.keypoints)
        flat = path.reshape(-1, 2)
        owner = torch.arange(len(path)).repeat_interleave(path.shape[1] * path.shape[2])
        parts = []
        for after, b in zip(torch.split(flat, _AT_ONCE), torch.split(owner, _AT_ONCE), strict=True):
            drawn = self.dynamics.draw(first[b], before[b], after).clamp(0, 1)
            latent, _ = self.cvae.encode(drawn, first[b])
            parts.append((latent - aim[b]).square().sum(dim=1))
        return torch.cat(parts).reshape(path.shape[:3])


class StepsDistance:
    """Learned temporal distance from predicted keypoints to that of the goal."""

    def __init__(self, model: TemporalDistance) -> None:
        self.model = model.eval()

    def __call__(
        self, starts: hvf_core.KeypointFrames, goals: hvf_core.KeypointFrames, path: Tensor
    ) -> Tensor:
        """Distances; see :class:`Distance`."""
        shape = path.shape[:3]
        codes = self.model.code(torch.from_numpy(starts.maps))[:, None, None].expand(*shape, -1)
        aim = torch.from_numpy(goals.keypoints)[:, None, None].expand(*shape, -1)
        distance: Tensor = self.model(path, aim, codes)
        return distance


class DistanceWorld:
    """The compact dynamics model with a distance as its planning cost.

    Args:
        world: rolls out.
        distance: what a predicted frame costs.
        over_horizon: whether the last predicted frame counts, their sum, or their minimum.
    """

    def __init__(self, world: KeypointWorld, distance: Distance, over_horizon: OverHorizon) -> None:
        self.world = world
        self.distance = distance
        self.over_horizon = over_horizon

    @property
    def action_low(self) -> NDArray[np.float32]:
        """Lowest action, float32 `[A]`."""
        return self.world.action_low

    @property
    def action_high(self) -> NDArray[np.float32]:
        """Highest action, float32 `[A]`."""
        return self.world.action_high

    def observe(self, images: NDArray[np.uint8]) -> hvf_core.KeypointFrames:
        """Frames of uint8 `images [N, S, S, 3]`."""
        return self.world.observe(images)

    def rollout_costs(
        self,
        starts: hvf_core.KeypointFrames,
        goals: hvf_core.KeypointFrames,
        actions: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Planning costs float32 `[B, D]` of `actions [B, D, H, A]`."""
        path = torch.from_numpy(self.world.native.rollout(starts, actions))
        if self.over_horizon == "last":
            path = path[:, :, -1:]
        with torch.inference_mode():
            costs = self.distance(starts, goals, path)
            total = costs.amin(dim=2) if self.over_horizon == "min" else costs.sum(dim=2)
        result: NDArray[np.float32] = total.numpy()
        return result
