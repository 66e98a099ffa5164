"""Trials with everything they saw, for pictures."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hvf.evaluation.acting import Images, Indices, Outcome, Trial, Trials, act
from hvf.evaluation.task import EpisodeTask


class DrawableTrials(Trials, Protocol):
    """Trials whose images are functions of states, and that know where things are in them.

    Attributes:
        states: where the trials are, float64 ``[B, ...]``; they can be put elsewhere.
    """

    states: NDArray[np.float64]

    def positions(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where what acts is in the images of ``states[N]``, pixels, ``[N, 2]``.

        Column and row; the middle of the upper left pixel is (0, 0).
        """
        ...

    def target(self, trial: int) -> tuple[float, float, float] | None:
        """Return column, row and radius of where a trial should end; None if that is no place."""
        ...


@dataclasses.dataclass(frozen=True)
class Episode:
    """One episode, as it went.

    Attributes:
        index: its number.
        trial: its outcome.
        observations: what was seen, uint8 ``[steps + 1, S, S, 3]``.
        states: where everything was, float64 ``[steps + 1, ...]``.
        path: where what acts was in the images, pixels, float64 ``[steps + 1, 2]``.
        target: column, row and radius of where that should end, pixels; None if it is no place.
        subgoals: uint8 ``[K, S, S, 3]``.
        goal: goal image, uint8 ``[S, S, 3]``.
    """

    index: int
    trial: Trial
    observations: Images
    states: NDArray[np.float64]
    path: NDArray[np.float64]
    target: tuple[float, float, float] | None
    subgoals: Images
    goal: Images

    def aim(self, step: int) -> int:
        """Number of the subgoal that was aimed at in ``step``; ``K`` for the goal."""
        return sum(switch <= step for switch in self.trial.switches)

    def aim_image(self, step: int) -> Images:
        """What was aimed at in ``step``."""
        aim = self.aim(step)
        image: Images = self.subgoals[aim] if aim < len(self.subgoals) else self.goal
        return image


def record(
    task: EpisodeTask[DrawableTrials],
    first: int,
    count: int,
    after_step: Callable[[int, Indices], None] | None = None,
) -> tuple[Outcome, list[Episode]]:
    """Run episodes ``first..first + count`` and keep what they saw.

    Args:
        task: what to run.
        first: number of the first episode.
        count: how many.
        after_step: as of :func:`~hvf.evaluation.acting.act`.
    """
    trials = task.trials(first, count)
    states = [[state] for state in trials.states.copy()]

    def keep(step: int, which: Indices) -> None:
        for trial in which:
            states[trial].append(trials.states[trial].copy())
        if after_step is not None:
            after_step(step, which)

    outcome = act(trials, task.agent, task.evaluation.acting, task.seeds(first, count), keep)
    episodes = []
    for offset, visited in enumerate(states):
        # Frames are functions of the states: drawn again instead of kept.
        trials.states = np.stack(visited)
        episodes.append(
            Episode(
                first + offset,
                outcome.trials[offset],
                trials.observe(np.arange(len(visited))),
                trials.states,
                trials.positions(trials.states),
                trials.target(offset),
                outcome.subgoals[offset],
                trials.goals[offset],
            )
        )
    return outcome, episodes
