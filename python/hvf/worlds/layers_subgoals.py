"""Subgoals drawn as states by a generator, and as images by the layers model."""

from __future__ import annotations

import itertools

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import hvf_core
from hvf.models.layers.generator import LayerGenerator
from hvf.threads import one_thread
from hvf.worlds.layers import LayerWorld

# Presence from which on a part is there.
_THERE = 0.5
# Opacity of the arm, over the place of a part, from which on it may hide it.
_COVERED = 0.6


class StateSubgoals:
    """Subgoals drawn by the generator of states (`hvf.protocols.SubgoalModel`).

    Args:
        generator: the trained generator.
        world: the world whose frames it draws.

    Raises:
        ValueError: a generator of states of another length than the world's.
    """

    def __init__(self, generator: LayerGenerator, world: LayerWorld) -> None:
        expected = world.dynamics.config.perception.state_size
        found = generator.config.state_size
        if expected != found:
            raise ValueError(f"generator: draws states of length {found}, the world's: {expected}")
        self.generator = generator.eval().requires_grad_(False)
        self.world = world

    @property
    def latent_dim(self) -> int:
        """Latent dimensions of one image."""
        return self.generator.config.latent_dim

    def decode(
        self, scene: hvf_core.LayerFrames, latents: NDArray[np.float32]
    ) -> hvf_core.LayerFrames:
        """Frames `[M * K]` for `latents [M, K, L]` in the scene of `scene [1]`, sample-major.

        Each of the `K` subgoals of a sample is drawn given the one before it, the first given the
        scene: the generator knows what a few seconds of play change, and `K` times that is more.
        """
        with one_thread():
            path = self._path(torch.from_numpy(scene.states), latents)
            states = torch.stack(path, dim=1).flatten(0, 1)
        return self.world.changed(scene, states.numpy())

    def segment_costs(
        self,
        start: hvf_core.LayerFrames,
        goal: hvf_core.LayerFrames,
        latents: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """How unlikely each segment is, nats, float32 `[M, K + 1]`, for `latents [M, K, L]`.

        A part that is not seen in `goal [1]` may be gone, or hidden behind the arm where it was in
        `start [1]`: what is likelier counts. Nothing is drawn.
        """
        with one_thread():
            begin, end = torch.from_numpy(start.states), torch.from_numpy(goal.states)
            path = self._path(begin, latents)
            before = begin.expand(len(latents), -1)
            costs = []
            for states in path:
                costs.append(self.generator.surprise(states, before))
                before = states
            ends = self._meanings(begin[0], end[0])
            last = [self.generator.surprise(each.expand(len(latents), -1), before) for each in ends]
            costs.append(torch.stack(last).amin(dim=0))
            segments: NDArray[np.float32] = torch.stack(costs, dim=1).numpy()
        return segments

    def _path(self, scene: Tensor, latents: NDArray[np.float32]) -> list[Tensor]:
        """States of each of the `K` subgoals, `[M, X]`, from `scene [1, X]`."""
        now, path = scene.expand(len(latents), -1), []
        for drawn in torch.from_numpy(np.ascontiguousarray(latents)).unbind(dim=1):
            now = self.generator.decode(drawn, now)
            path.append(now)
        return path

    def _meanings(self, start: Tensor, goal: Tensor) -> Tensor:
        """States `[N, X]` that what is seen of `goal [X]` may mean after `start [X]`."""
        perception = self.world.dynamics.perception
        count = perception.config.roaming
        was, seen = (states[-3 * count :].reshape(count, 3) for states in (start, goal))
        covered = perception.covered(goal[None], was[None, :, :2])[0]
        gone = was * was.new_tensor([1.0, 1.0, 0.0])
        choices = []
        for part in range(count):
            if seen[part, 2] > _THERE:
                choices.append([seen[part]])
            elif was[part, 2] <= _THERE or covered[part] <= _COVERED:
                choices.append([gone[part]])
            else:
                choices.append([gone[part], was[part]])
        fixed = goal[: -3 * count]
        return torch.stack([torch.cat([fixed, *each]) for each in itertools.product(*choices)])


def subgoals_of(generator: LayerGenerator, world: object) -> StateSubgoals:
    """Subgoals drawn by a trained generator in a world of layers.

    Raises:
        ValueError: another kind of world, or states of another length.
    """
    if not isinstance(world, LayerWorld):
        kind = type(world).__name__
        raise ValueError(f"generator: layers-generator needs layers dynamics, got {kind}")
    return StateSubgoals(generator, world)
