"""Distances in steps of play, as a planning cost and as what a segment costs.

They compare what object models perceive, keypoints or states, so that nothing is drawn: rollouts
run in Rust, and a torch model is asked once for all candidates of a problem. Slower than the pixel
cost, which both worlds have in Rust, by about an order of magnitude.
"""

from __future__ import annotations

from typing import Any, Generic, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import hvf_core
from hvf.models.layers.distance import LayerDistance
from hvf.models.temporal_distance import TemporalDistance
from hvf.settings import OverHorizon, Planning
from hvf.threads import one_thread
from hvf.worlds.keypoint import KeypointSubgoals, KeypointWorld
from hvf.worlds.layers import LayerWorld
from hvf.worlds.layers_meanings import meanings
from hvf.worlds.layers_subgoals import StateSubgoals
from hvf.worlds.world import Measured

WorldT = TypeVar("WorldT", KeypointWorld, LayerWorld)
ModelT = TypeVar("ModelT", TemporalDistance, LayerDistance)


class StepsWorld(Measured, Generic[WorldT, ModelT]):
    """An object model with a distance in steps as its cost.

    Args:
        world: rolls out.
        model: the distance.
        over_horizon: whether the last predicted frame counts, their sum, or their minimum.
    """

    def __init__(self, world: WorldT, model: ModelT, over_horizon: OverHorizon) -> None:
        super().__init__(world, over_horizon)
        self.model: ModelT = model.eval()

    def rollout_costs(
        self, starts: Any, goals: Any, actions: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Planning costs float32 `[B, D]` of `actions [B, D, H, A]`."""
        path = torch.from_numpy(np.ascontiguousarray(self.world.rollout(starts, actions)))
        if self.over_horizon == "last":
            path = path[:, :, -1:]
        with one_thread():
            costs = self.between(starts, goals, path)
            total = costs.amin(dim=2) if self.over_horizon == "min" else costs.sum(dim=2)
        result: NDArray[np.float32] = total.numpy()
        return result

    def between(self, starts: Any, goals: Any, path: Tensor) -> Tensor:
        """Distances `[B, D, H]` of what is predicted, `path [B, D, H, ...]`, to `goals [B]`."""
        raise NotImplementedError


class KeypointStepsWorld(StepsWorld[KeypointWorld, TemporalDistance]):
    """The compact dynamics model, with the temporal distance of keypoints as its cost."""

    def between(
        self, starts: hvf_core.KeypointFrames, goals: hvf_core.KeypointFrames, path: Tensor
    ) -> Tensor:
        """Distances `[B, D, H]` of predicted keypoints `path [B, D, H, 2]` to `goals [B]`."""
        shape = path.shape[:3]
        codes = self.model.code(torch.from_numpy(starts.maps))[:, None, None].expand(*shape, -1)
        aim = torch.from_numpy(goals.keypoints)[:, None, None].expand(*shape, -1)
        distance: Tensor = self.model(path, aim, codes)
        return distance


class LayerStepsWorld(StepsWorld[LayerWorld, LayerDistance]):
    """The layers model, with the temporal distance of states as its cost.

    A part that is not seen in a goal may be gone, or hidden: what is nearer counts.
    """

    def between(
        self, starts: hvf_core.LayerFrames, goals: hvf_core.LayerFrames, path: Tensor
    ) -> Tensor:
        """Distances `[B, D, H]` of predicted states `path [B, D, H, X]` to `goals [B]`."""
        perception = self.world.dynamics.perception
        begin, end = torch.from_numpy(starts.states), torch.from_numpy(goals.states)
        costs = []
        for before, after, states in zip(begin, end, path, strict=True):
            flat = states.flatten(0, 1)
            each = [
                self.model(flat, meaning.expand(len(flat), -1))
                for meaning in meanings(perception, before, after)
            ]
            costs.append(torch.stack(each).amin(dim=0).reshape(states.shape[:2]))
        return torch.stack(costs)


class KeypointStepsSubgoals:
    """Subgoals of the keypoint generator, whose segments cost steps.

    A generator that judges (`hvf.protocols.Judging`).
    """

    def __init__(self, subgoals: KeypointSubgoals, model: TemporalDistance) -> None:
        self.subgoals = subgoals
        self.model = model.eval()

    @property
    def latent_dim(self) -> int:
        """Latent dimensions of one image."""
        return self.subgoals.latent_dim

    def decode(
        self, scene: hvf_core.KeypointFrames, latents: NDArray[np.float32]
    ) -> hvf_core.KeypointFrames:
        """Frames `[M * K]` for `latents [M, K, L]` in the scene of `scene [1]`, sample-major."""
        return self.subgoals.decode(scene, latents)

    def segment_costs(
        self,
        start: hvf_core.KeypointFrames,
        goal: hvf_core.KeypointFrames,
        latents: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """What each segment costs, float32 `[M, K + 1]`, for `latents [M, K, L]`."""
        count, subgoals, _ = latents.shape
        with one_thread():
            drawn = self.subgoals.points(start, latents).reshape(count, subgoals, 2)
            ends = [
                torch.from_numpy(frames.keypoints)[:, None].expand(count, 1, 2)
                for frames in (start, goal)
            ]
            path = torch.cat([ends[0], drawn, ends[1]], dim=1)
            codes = self.model.code(torch.from_numpy(start.maps))[:, None]
            costs = self.model(path[:, :-1], path[:, 1:], codes.expand(count, subgoals + 1, -1))
        segments: NDArray[np.float32] = costs.numpy()
        return segments


def keypoint_steps(model: TemporalDistance, world: Any, planning: Planning) -> KeypointStepsWorld:
    """A world of keypoints whose cost is a distance in steps.

    Raises:
        ValueError: another kind of world.
    """
    if not isinstance(world, KeypointWorld):
        raise ValueError(f"cost: 'temporal' needs keypoint dynamics, got {type(world).__name__}")
    return KeypointStepsWorld(world, model, planning.over_horizon)


def layer_steps(model: LayerDistance, world: Any, planning: Planning) -> LayerStepsWorld:
    """A world of layers whose cost is a distance in steps.

    Raises:
        ValueError: another kind of world, or states of another length.
    """
    if not isinstance(world, LayerWorld):
        raise ValueError(f"cost: 'temporal' needs layers dynamics, got {type(world).__name__}")
    _check(model, world)
    return LayerStepsWorld(world, model, planning.over_horizon)


def keypoint_segments(model: TemporalDistance, subgoals: Any) -> KeypointStepsSubgoals:
    """Subgoals of keypoints whose segments cost a distance in steps.

    Raises:
        ValueError: subgoals of another kind.
    """
    if not isinstance(subgoals, KeypointSubgoals):
        kind = type(subgoals).__name__
        raise ValueError(f"segment_model: temporal-distance is for keypoint-generator, got {kind}")
    return KeypointStepsSubgoals(subgoals, model)


def layer_segments(model: LayerDistance, subgoals: Any) -> StateSubgoals:
    """Subgoals of layers whose segments cost a distance in steps.

    Raises:
        ValueError: subgoals of another kind, or states of another length.
    """
    if not isinstance(subgoals, StateSubgoals):
        kind = type(subgoals).__name__
        raise ValueError(f"segment_model: layers-distance is for layers-generator, got {kind}")
    _check(model, subgoals.world)
    return StateSubgoals(subgoals.generator, subgoals.world, model.eval())


def _check(model: LayerDistance, world: LayerWorld) -> None:
    expected = world.dynamics.config.perception.state_size
    found = model.config.state_size
    if expected != found:
        raise ValueError(f"distance: of states of length {found}, the world's: {expected}")
