"""Trials with everything they saw, for pictures."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from hvf.evaluation.acting import Images, Indices, Outcome, Trial, act
from hvf.evaluation.maze import MazeTask


@dataclasses.dataclass(frozen=True)
class Episode:
    """One episode of the maze, as it went.

    Attributes:
        index: its number.
        trial: its outcome.
        observations: what was seen, uint8 ``[steps + 1, S, S, 3]``.
        states: where the agent was, float64 ``[steps + 1, 4]``.
        target: where it should be, float64 ``[2]``.
        subgoals: uint8 ``[K, S, S, 3]``.
        goal: goal image, uint8 ``[S, S, 3]``.
    """

    index: int
    trial: Trial
    observations: Images
    states: NDArray[np.float64]
    target: NDArray[np.float64]
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


def record(task: MazeTask, first: int, count: int) -> tuple[Outcome, list[Episode]]:
    """Run episodes ``first..first + count`` and keep what they saw."""
    trials = task.trials(first, count)
    states = [[state] for state in trials.states.copy()]

    def keep(step: int, which: Indices) -> None:
        for trial in which:
            states[trial].append(trials.states[trial].copy())

    acting = task.evaluation.planning.acting
    outcome = act(trials, task.agent, acting, task.seeds(first, count), keep)
    episodes = []
    for offset, path in enumerate(states):
        # Frames are functions of the states: drawn again instead of kept.
        trials.states = np.stack(path)
        episodes.append(
            Episode(
                first + offset,
                outcome.trials[offset],
                trials.observe(np.arange(len(path))),
                trials.states,
                trials.targets[offset],
                outcome.subgoals[offset],
                trials.goals[offset],
            )
        )
    return outcome, episodes
