"""Actions drawn uniformly from the box: the floor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hvf.agents.frames import images_of
from hvf.protocols import Decision, Frames, Images, Indices, Trials


class RandomAgent:
    """Acts at random; has no subgoals.

    Args:
        low: lowest action, ``[A]``.
        high: highest action, ``[A]``.
    """

    def __init__(self, low: NDArray[np.float32], high: NDArray[np.float32]) -> None:
        self.low = low
        self.high = high
        self._goals: Images = np.empty((0, 0, 0, 3), np.uint8)

    def begin(self, trials: Trials) -> None:
        """Note the goals."""
        self._goals = trials.goals

    def choose(self, trial: int, seed: int) -> Frames:
        """Choose no subgoals."""
        none: Frames = self._goals[trial][None][:0]
        return none

    def act(
        self, which: Indices, observations: Images, aims: Indices, seeds: Sequence[int]
    ) -> Decision:
        """Return random actions."""
        draws = [np.random.default_rng(seed).uniform(self.low, self.high) for seed in seeds]
        return Decision(np.stack(draws).astype(np.float32))

    def acted(self, which: Indices, actions: NDArray[np.float32]) -> None:
        """Take note of nothing."""

    def distances(
        self, which: Indices, observations: Images, aims: Indices, blur: float
    ) -> NDArray[np.floating]:
        """Return infinity: there is nothing to reach before the goal."""
        return np.full(len(which), np.inf)

    def images(self, frames: Frames) -> Images:
        """Return no images."""
        return images_of(frames)
