"""Agents: visual foresight with and without subgoals, and the random floor.

All but the random one plan with the same visual MPC; they differ in where subgoals come from.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from hvf.evaluation.acting import Decision, Images, Indices, Trials, derived_seed
from hvf.protocols import Frames, SubgoalModel, WorldModel
from hvf.settings import Replanning
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


class TrialsWithFrames(Trials, Protocol):
    """Trials that can say more than what is seen."""

    def frames(self, which: Indices) -> Frames:
        """Return frames of the true simulator where the trials ``which`` are, ``[N]``."""
        ...


class PlanningAgent:
    """Plans with visual MPC, towards subgoals of one source.

    Args:
        world: what it plans with.
        mpc: how it plans.
        source: where its subgoals come from.
        replanning: when it plans anew; at every step, if nothing else is said.
        told: plans start from frames of the trials (:class:`TrialsWithFrames`) and not from what
            is observed: for a simulator whose state cannot be read off an image.
    """

    def __init__(
        self,
        world: WorldModel[Any],
        mpc: VisualMPC,
        source: SubgoalSource,
        replanning: Replanning = Replanning(),
        told: bool = False,
    ) -> None:
        replanning.check(mpc.horizon)
        self.world = world
        self.mpc = mpc
        self.source = source
        self.replanning = replanning
        self.told = told
        self._trials: TrialsWithFrames | None = None
        self._plans: dict[int, _Current] = {}

    def subgoals(self, trials: Trials, seeds: Sequence[int]) -> list[Images]:
        """Return the subgoals of every trial, and forget the last ones' plans."""
        self._plans.clear()
        self._trials = cast(TrialsWithFrames, trials) if self.told else None
        return self.source(trials, seeds)

    def act(
        self, which: Indices, observations: Images, targets: Images, seeds: Sequence[int]
    ) -> Decision:
        """Return the next actions of the best plans."""
        due = [
            n
            for n, (trial, target) in enumerate(zip(which, targets, strict=True))
            if self._is_due(int(trial), target)
        ]
        if due:
            self._plan(which[due], observations[due], targets[due], [seeds[n] for n in due])
        current = [self._plans[int(trial)] for trial in which]
        actions = np.stack([plan.next_action() for plan in current])
        return Decision(actions, np.array([plan.cost for plan in current], np.float32))

    def _is_due(self, trial: int, target: Images) -> bool:
        """Whether a trial needs a new plan."""
        plan = self._plans.get(trial)
        if plan is None or plan.since >= self.replanning.every or plan.left == 0:
            return True
        return not np.array_equal(plan.target, target)

    def _plan(
        self, which: Indices, observations: Images, targets: Images, seeds: Sequence[int]
    ) -> None:
        last = None
        if self.replanning.warm_start and all(int(trial) in self._plans for trial in which):
            last = np.stack([self._plans[int(trial)].before_last_action() for trial in which])
        starts = observations if self._trials is None else self._trials.frames(which)
        plans = self.mpc.plan_batch(self.world, starts, targets, seeds=seeds, warm_start=last)
        for n, trial in enumerate(map(int, which)):
            new = _Current(plans.actions[n], float(plans.costs[n]), targets[n])
            old = self._plans.get(trial)
            if self.replanning.keep_better and old is not None and old.still_better(new):
                old.since = 0
            else:
                self._plans[trial] = new


@dataclasses.dataclass
class _Current:
    """A plan that is being acted; ``since`` counts steps since it was last weighed."""

    actions: NDArray[np.float32]
    cost: float
    target: Images
    acted: int = 0
    since: int = 0

    @property
    def left(self) -> int:
        """Steps that have not been acted."""
        return len(self.actions) - self.acted

    def next_action(self) -> NDArray[np.float32]:
        action: NDArray[np.float32] = self.actions[self.acted]
        self.acted += 1
        self.since += 1
        return action

    def still_better(self, new: _Current) -> bool:
        """Whether the rest of this plan is worth more than a new one."""
        return self.left > 0 and self.cost <= new.cost and np.array_equal(self.target, new.target)

    def before_last_action(self) -> NDArray[np.float32]:
        """The plan as the search wants it for a warm start: it begins with the last action acted.

        Its last action is repeated where the plan has come to its end.
        """
        first = max(self.acted - 1, 0)
        steps = np.minimum(np.arange(len(self.actions)) + first, len(self.actions) - 1)
        rest: NDArray[np.float32] = self.actions[steps]
        return rest


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
