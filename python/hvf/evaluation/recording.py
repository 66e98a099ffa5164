"""Episodes with everything that was seen, for pictures."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hvf.evaluation.acting import Outcome, Trial, Watcher, act
from hvf.evaluation.task import Task
from hvf.protocols import Images, Indices, Locating, Trials


@dataclasses.dataclass(frozen=True)
class Episode:
    """One episode, as it went.

    Attributes:
        index: its number.
        trial: its outcome.
        observations: what was seen, uint8 ``[steps + 1, H, W, 3]``.
        path: where what acts was in the images, pixels, float64 ``[steps + 1, 2]``; None for a
            domain that does not tell.
        target: column, row and radius of where that should end, pixels; None if it is no place.
        subgoals: uint8 ``[K, H, W, 3]``.
        goal: goal image, uint8 ``[H, W, 3]``.
    """

    index: int
    trial: Trial
    observations: Images
    path: NDArray[np.float64] | None
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


class Recorder:
    """Keeps what trials see (a :class:`~hvf.evaluation.acting.Watcher`)."""

    def __init__(self, trials: Trials) -> None:
        self._trials = trials
        self._seen: list[list[Images]] = [[] for _ in range(len(trials))]
        self._path: list[list[NDArray[np.float64]]] = [[] for _ in range(len(trials))]

    def chosen(self, trial: int) -> None:
        """Subgoals are kept by the outcome."""

    def seen(self, step: int, which: Indices, observations: Images) -> None:
        """Keep what is seen, and where."""
        places = self._trials.positions(which) if isinstance(self._trials, Locating) else None
        for n, trial in enumerate(map(int, which)):
            self._seen[trial].append(observations[n].copy())
            if places is not None:
                self._path[trial].append(places[n].copy())

    def stepped(self, step: int, which: Indices) -> None:
        """What comes of a step is seen before the next one."""

    def finish(self, outcome: Outcome) -> None:
        """Look once more at every trial, where its last step led."""
        for trial, result in enumerate(outcome.trials):
            if len(self._seen[trial]) == result.steps:
                which = np.array([trial])
                self.seen(result.steps, which, self._trials.observe(which))

    def episode(self, index: int, trial: int, outcome: Outcome, subgoals: Images) -> Episode:
        """A trial as an episode with this number."""
        path, steps = self._path[trial], outcome.trials[trial].steps
        located = isinstance(self._trials, Locating)
        return Episode(
            index,
            outcome.trials[trial],
            np.stack(self._seen[trial][: steps + 1]),
            np.stack(path[: steps + 1]) if path else None,
            self._trials.target(trial) if located else None,  # type: ignore[attr-defined]
            subgoals,
            self._trials.goals[trial],
        )


def record(
    task: Task, first: int, count: int, watchers: Sequence[Watcher] = ()
) -> tuple[Outcome, list[Episode]]:
    """Run episodes ``first..first + count`` and keep what they saw.

    Args:
        task: what to run.
        first: number of the first episode.
        count: how many.
        watchers: are told how it goes on.
    """
    trials = task.trials(first, count)
    recorder = Recorder(trials)
    seeds = task.seeds(first, count)
    outcome = act(trials, task.agent, task.evaluation.acting, seeds, [recorder, *watchers])
    recorder.finish(outcome)
    episodes = []
    for offset, frames in enumerate(outcome.subgoals):
        size = trials.goals.shape[1:]
        images = task.agent.images(frames) if len(frames) else np.empty((0, *size), np.uint8)
        episodes.append(recorder.episode(first + offset, offset, outcome, images))
    return outcome, episodes
