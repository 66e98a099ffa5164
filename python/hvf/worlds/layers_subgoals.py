"""Subgoals drawn as states by a generator, and as images by the layers model."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import hvf_core
from hvf.models.layers.generator import LayerGenerator
from hvf.threads import one_thread
from hvf.worlds.layers import LayerWorld
from hvf.worlds.layers_meanings import meanings

Judge: TypeAlias = Callable[[Tensor, Tensor], Tensor]
"""What it costs to get from states ``[N, X]`` to states ``[N, X]``: ``[N]``."""


class StateSubgoals:
    """Subgoals drawn by the generator of states (`hvf.protocols.SubgoalModel`).

    Args:
        generator: the trained generator.
        world: the world whose frames it draws.
        judge: what a segment costs; how unlikely it is, in nats, if nothing else is given.

    Raises:
        ValueError: a generator of states of another length than the world's.
    """

    def __init__(
        self, generator: LayerGenerator, world: LayerWorld, judge: Judge | None = None
    ) -> None:
        expected = world.dynamics.config.perception.state_size
        found = generator.config.state_size
        if expected != found:
            raise ValueError(f"generator: draws states of length {found}, the world's: {expected}")
        self.generator = generator.eval().requires_grad_(False)
        self.world = world
        self.judge = self._surprise if judge is None else judge

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
        """What each segment costs, float32 `[M, K + 1]`, for `latents [M, K, L]`.

        A part that is not seen in `goal [1]` may be gone, or hidden behind the arm where it was in
        `start [1]`: what costs less counts. Nothing is drawn.
        """
        with one_thread():
            begin, end = torch.from_numpy(start.states), torch.from_numpy(goal.states)
            path = self._path(begin, latents)
            before = begin.expand(len(latents), -1)
            costs = []
            for states in path:
                costs.append(self.judge(before, states))
                before = states
            ends = meanings(self.world.dynamics.perception, begin[0], end[0])
            last = [self.judge(before, each.expand(len(latents), -1)) for each in ends]
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

    def _surprise(self, before: Tensor, after: Tensor) -> Tensor:
        return self.generator.surprise(after, before)


def subgoals_of(generator: LayerGenerator, world: object) -> StateSubgoals:
    """Subgoals drawn by a trained generator in a world of layers.

    Raises:
        ValueError: another kind of world, or states of another length.
    """
    if not isinstance(world, LayerWorld):
        kind = type(world).__name__
        raise ValueError(f"generator: layers-generator needs layers dynamics, got {kind}")
    return StateSubgoals(generator, world)
