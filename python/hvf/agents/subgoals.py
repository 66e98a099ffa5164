"""Where an agent's subgoals come from (:class:`hvf.protocols.SubgoalSource`)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from hvf.agents.frames import observed
from hvf.protocols import (
    Frames,
    Images,
    Proposer,
    SubgoalModel,
    SubgoalSource,
    Trials,
    TrueSubgoals,
    WorldModel,
)
from hvf_core import HVF


def no_subgoals(trials: Trials, trial: int, seed: int) -> Frames:
    """No subgoals: straight to the goal image (Finn & Levine, 2017)."""
    none: Frames = trials.goals[trial][None][:0]
    return none


def ground_truth(count: int) -> SubgoalSource:
    """The domain's own subgoals: the upper bound that the paper compares with."""

    def of_all(trials: Trials) -> Any:
        if not isinstance(trials, TrueSubgoals):
            kind = type(trials).__name__
            raise ValueError(f"method: 'ground-truth' needs true_subgoals, which {kind} lacks")
        return trials.true_subgoals(count)

    once = _Once(of_all)

    def source(trials: Trials, trial: int, seed: int) -> Frames:
        frames: Frames = once(trials)[trial]
        return frames

    return source


def searched(search: HVF, world: WorldModel[Any], generator: SubgoalModel[Any]) -> SubgoalSource:
    """HVF: subgoal images found by search (paper, algorithm 2), once, at the start."""

    def ends_of_all(trials: Trials) -> tuple[Any, Any]:
        starts = trials.observe(np.arange(len(trials)))
        return observed(world, starts), observed(world, trials.goals)

    once = _Once(ends_of_all)

    def source(trials: Trials, trial: int, seed: int) -> Frames:
        starts, goals = once(trials)
        index = np.array([trial])
        found = search.search(world, generator, starts[index], goals[index], seed)
        frames: Frames = found.subgoals
        return frames

    return source


def proposed(count: int, proposer: Proposer) -> SubgoalSource:
    """Subgoal images that a model proposes between start and goal, once, at the start.

    Reads what trials show and nothing else.
    """

    def source(trials: Trials, trial: int, seed: int) -> Images:
        start = trials.observe(np.array([trial]))[0]
        return proposer.propose(start, trials.goals[trial], count)

    return source


class _Once:
    """What is made once for all trials, at the first one's turn."""

    def __init__(self, make: Callable[[Trials], Any]) -> None:
        self._make = make
        self._trials: Trials | None = None
        self._made: Any = None

    def __call__(self, trials: Trials) -> Any:
        if self._trials is not trials:
            self._trials, self._made = trials, self._make(trials)
        return self._made
