"""What agents have in common that act straight towards the goal image, without subgoals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hvf.agents.frames import images_of
from hvf.protocols import Decision, Frames, Images, Indices, Trials


class DirectAgent:
    """Has goal images and no subgoals; how it acts is for others to say."""

    def __init__(self) -> None:
        self._goals: Images = np.empty((0, 0, 0, 3), np.uint8)

    def begin(self, trials: Trials) -> None:
        """Note the goals."""
        self._goals = trials.goals

    def choose(self, trial: int, seed: int) -> Frames:
        """Choose no subgoals."""
        none: Frames = self._goals[trial][None][:0]
        return none

    def choose_anew(self, trial: int, seed: int, count: int) -> Frames | None:
        """Choose none either."""
        return None

    def act(
        self, which: Indices, observations: Images, aims: Indices, seeds: Sequence[int]
    ) -> Decision:
        """Return actions."""
        raise NotImplementedError

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
