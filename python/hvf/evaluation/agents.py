"""Agents: visual foresight with and without subgoals, and the random floor.

All but the random one plan with the same visual MPC; they differ in where subgoals come from.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from hvf.evaluation.acting import Decision, Images, Indices, Trials, derived_seed
from hvf.protocols import Frames, SubgoalModel, WorldModel
from hvf_core import HVF, VisualMPC


class SubgoalSource(Protocol):
    """Where an agent gets its subgoals from."""

    def __call__(self, trials: Trials, seeds: Sequence[int]) -> list[Images]:
        """Return the subgoals of every trial: ``B`` arrays uint8 ``[K, H, W, 3]``."""
        ...


class NoSubgoals:
    """Visual foresight: straight to the goal image (Finn & Levine, 2017)."""

    def __call__(self, trials: Trials, seeds: Sequence[int]) -> list[Images]:
        """Return no subgoals."""
        return [goal[None][:0] for goal in trials.goals]


class SearchedSubgoals:
    """HVF: subgoal images found by search (paper, algorithm 2), once, at the start."""

    def __init__(
        self, search: HVF, world: WorldModel[Any], generator: SubgoalModel[Any] | None
    ) -> None:
        self.search = search
        self.world = world
        self.generator = generator

    def __call__(self, trials: Trials, seeds: Sequence[int]) -> list[Images]:
        """Return the subgoals that the search finds, as images."""
        starts = trials.observe(np.arange(len(trials)))
        search_seeds = [derived_seed(seed, 0) for seed in seeds]
        found = self.search.search_batch(
            self.world, self.generator, starts, trials.goals, search_seeds
        )
        return [images_of(result.subgoals) for result in found]


class TrialsWithTruth(Trials, Protocol):
    """Trials of an environment that knows what good subgoals are."""

    def true_subgoals(self, count: int) -> Images:
        """Return ground-truth subgoals, uint8 ``[B, count, H, W, 3]``."""
        ...


class TrueSubgoals:
    """Ground-truth subgoals: the upper bound that the paper compares with."""

    def __init__(self, count: int) -> None:
        self.count = count

    def __call__(self, trials: Trials, seeds: Sequence[int]) -> list[Images]:
        """Return the environment's own subgoals."""
        return list(cast(TrialsWithTruth, trials).true_subgoals(self.count))


class PlanningAgent:
    """Plans every step anew with visual MPC, towards subgoals of one source.

    Args:
        world: what it plans with.
        mpc: how it plans.
        source: where its subgoals come from.
        warm_start: begin each search of actions around the rest of the last plan.
    """

    def __init__(
        self,
        world: WorldModel[Any],
        mpc: VisualMPC,
        source: SubgoalSource,
        warm_start: bool = False,
    ) -> None:
        self.world = world
        self.mpc = mpc
        self.source = source
        self.warm_start = warm_start
        self._last_plans: dict[int, NDArray[np.float32]] = {}

    def subgoals(self, trials: Trials, seeds: Sequence[int]) -> list[Images]:
        """Return the subgoals of every trial, and forget the last ones' plans."""
        self._last_plans.clear()
        return self.source(trials, seeds)

    def act(
        self, which: Indices, observations: Images, targets: Images, seeds: Sequence[int]
    ) -> Decision:
        """Return the first actions of the best plans."""
        last = None
        if self.warm_start and all(int(trial) in self._last_plans for trial in which):
            last = np.stack([self._last_plans[int(trial)] for trial in which])
        plans = self.mpc.plan_batch(self.world, observations, targets, seeds=seeds, warm_start=last)
        actions = plans.actions
        self._last_plans.update(zip(map(int, which), actions, strict=True))
        return Decision(np.ascontiguousarray(actions[:, 0]), plans.costs)


class RandomAgent:
    """Actions drawn uniformly from the box: the floor."""

    def __init__(self, low: NDArray[np.float32], high: NDArray[np.float32]) -> None:
        self.low = low
        self.high = high

    def subgoals(self, trials: Trials, seeds: Sequence[int]) -> list[Images]:
        """Return no subgoals."""
        return NoSubgoals()(trials, seeds)

    def act(
        self, which: Indices, observations: Images, targets: Images, seeds: Sequence[int]
    ) -> Decision:
        """Return random actions."""
        draws = [np.random.default_rng(seed).uniform(self.low, self.high) for seed in seeds]
        return Decision(np.stack(draws).astype(np.float32))


def images_of(frames: Frames) -> Images:
    """The images of a world's frames: uint8 ``[N, H, W, 3]``.

    Raises:
        TypeError: frames that are neither images nor have ``images``.
    """
    images = np.asarray(getattr(frames, "images", frames))
    if images.dtype != np.uint8 or images.ndim != 4:
        kind = type(frames).__name__
        raise TypeError(f"frames: expected uint8 images or frames with such images, got {kind}")
    return images
