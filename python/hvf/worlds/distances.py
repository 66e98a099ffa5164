"""Other planning costs than pixels: distance in a VAE's latent, and learned temporal distance.

Rollouts stay in Rust; the distance is a torch model that is asked once for all candidates of all
problems. Both are slower than the pixel cost, which has a closed form: the temporal distance by
about an order of magnitude, the latent cost, which has to draw and encode frames, by three.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import hvf_core
from hvf.models.frames import to_unit
from hvf.models.temporal_distance import TemporalDistance
from hvf.models.vae import CVAE
from hvf.protocols import WorldModel
from hvf.settings import OverHorizon, Planning
from hvf.worlds.keypoint import KeypointWorld
from hvf.worlds.threads import one_thread
from hvf.worlds.world import Around

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


class DistanceWorld(Around):
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
    def inner(self) -> Any:
        """The world that predicts."""
        return self.world

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
        with one_thread():
            costs = self.distance(starts, goals, path)
            total = costs.amin(dim=2) if self.over_horizon == "min" else costs.sum(dim=2)
        result: NDArray[np.float32] = total.numpy()
        return result


class LatentWorld(Around):
    """Any world that draws what it predicts, with distance in a VAE's latent as its cost.

    Args:
        world: has ``observe(images)``, frames with ``images``, and ``predict(frames[N],
            actions[N, H, A])`` that gives uint8 ``[N, H, S, S, 3]``.
        cvae: encodes goals and predicted frames; a conditional one in the scene of the start.
        over_horizon: whether the last predicted frame counts, their sum, or their minimum.
    """

    def __init__(self, world: Any, cvae: CVAE, over_horizon: OverHorizon) -> None:
        self.world = world
        self.cvae = cvae.eval()
        self.over_horizon = over_horizon

    @property
    def inner(self) -> Any:
        """The world that predicts."""
        return self.world

    def observe(self, images: NDArray[np.uint8]) -> Any:
        """Frames of uint8 `images [N, S, S, 3]`."""
        return self.world.observe(images)

    def rollout_costs(
        self, starts: Any, goals: Any, actions: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Planning costs float32 `[B, D]` of `actions [B, D, H, A]`."""
        count, candidates = actions.shape[:2]
        costs = np.empty((count, candidates), np.float32)
        for b in range(count):
            one = np.array([b])
            scene = to_unit(torch.from_numpy(np.ascontiguousarray(starts[one].images)))
            drawn = self.world.predict(starts[np.repeat(one, candidates)], actions[b])
            seen = drawn[:, -1:] if self.over_horizon == "last" else drawn
            goal = to_unit(torch.from_numpy(np.ascontiguousarray(goals[one].images)))
            with one_thread():
                aim = self._encode(goal, scene)
                flat = torch.from_numpy(np.ascontiguousarray(seen)).flatten(0, 1)
                parts = [self._encode(to_unit(part), scene) for part in torch.split(flat, _AT_ONCE)]
                apart = (torch.cat(parts) - aim).square().sum(dim=1).reshape(candidates, -1)
            total = apart.amin(dim=1) if self.over_horizon == "min" else apart.sum(dim=1)
            costs[b] = total.numpy()
        return costs

    def _encode(self, images: Tensor, scene: Tensor) -> Tensor:
        """Means of the posterior, `[N, L]`."""
        given = scene.expand(len(images), -1, -1, -1) if self.cvae.config.conditional else None
        return self.cvae.encode(images, given)[0]


def latent_world(world: Any, model: Any, planning: Planning) -> WorldModel[Any]:
    """A world whose cost is distance in the latent of a VAE or CVAE.

    Raises:
        ValueError: a world that does not draw what it predicts, or a model that is no VAE.
    """
    if not isinstance(model, CVAE):
        raise ValueError(f"cost: 'latent' needs a cvae or vae, got {type(model).__name__}")
    if isinstance(world, KeypointWorld):
        distance = LatentDistance(model, world)
        return DistanceWorld(world, distance, planning.over_horizon)
    if not hasattr(world, "predict") or not hasattr(world, "observe"):
        kind = type(world).__name__
        raise ValueError(f"cost: 'latent' needs dynamics that draw frames, got {kind}")
    return LatentWorld(world, model, planning.over_horizon)


def temporal_world(world: Any, model: Any, planning: Planning) -> WorldModel[Any]:
    """A keypoint world whose cost is the learned distance in steps.

    Raises:
        ValueError: another kind of world or model.
    """
    if not isinstance(model, TemporalDistance):
        raise ValueError(
            f"cost: 'temporal' needs a temporal-distance model, got {type(model).__name__}"
        )
    if not isinstance(world, KeypointWorld):
        kind = type(world).__name__
        raise ValueError(f"cost: 'temporal' needs keypoint dynamics, got {kind}")
    return DistanceWorld(world, StepsDistance(model), planning.over_horizon)


def temporal_of(model: TemporalDistance, world: Any) -> WorldModel[Any]:
    """A keypoint world with this cost and no other settings; see :func:`temporal_world`."""
    return temporal_world(world, model, Planning())
