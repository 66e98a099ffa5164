"""Acts by a policy, straight to the goal image and without a plan."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hvf.agents.frames import images_of
from hvf.protocols import Decision, Frames, Images, Indices, Policy, Trials


class PolicyAgent:
    """Acts by a policy that is given a goal image; has no subgoals.

    Args:
        policy: what it acts by.
    """

    def __init__(self, policy: Policy) -> None:
        self.policy = policy
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
        """Return the policy's actions."""
        # One at a time, so that an action does not depend on which trials run beside.
        chosen = [
            self.policy.act(observation, self._goals[trial])
            for trial, observation in zip(map(int, which), observations, strict=True)
        ]
        return Decision(np.stack(chosen).astype(np.float32))

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
