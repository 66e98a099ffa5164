"""Trials on a line, for tests of acting: what an agent sees is one pixel, its place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

GOAL = 9
"""Where every trial should end."""


def images(places: Sequence[int] | NDArray[Any]) -> NDArray[np.uint8]:
    """Places as images of one pixel, uint8 ``[N, 1, 1, 3]``."""
    return np.repeat(np.asarray(places, np.uint8), 3).reshape(-1, 1, 1, 3)


def places(frames: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Images of one pixel as places."""
    return frames[..., 0, 0, 0].astype(np.int64)


class Line:
    """Trials at places 0, 1, 2 ...; an action is how far to go, and the goal is at 9.

    Attributes:
        at: where they are.
        broken: steps, from 0, after which a trial breaks down.
    """

    def __init__(self, starts: Sequence[int], broken: Mapping[int, int] | None = None) -> None:
        self.at = np.array(starts)
        self.goals = images([GOAL] * len(starts))
        self.broken = dict(broken or {})
        self._taken = np.zeros(len(starts), np.int64)

    def __len__(self) -> int:
        return len(self.at)

    def observe(self, which: NDArray[np.int64]) -> NDArray[np.uint8]:
        return images(self.at[which])

    def step(self, which: NDArray[np.int64], actions: NDArray[np.float32]) -> dict[int, str]:
        self._taken[which] += 1
        broken = [int(b) for b in which if self.broken.get(int(b)) == self._taken[b] - 1]
        moving = ~np.isin(which, broken)
        self.at[which[moving]] += actions[moving, 0].astype(int)
        return {b: f"trial {b} broke down" for b in broken}

    def success(self, which: NDArray[np.int64]) -> NDArray[np.bool_]:
        return np.asarray(self.at[which] == GOAL)


class Road:
    """A world of places on a line: a plan costs its distance to the goal, plus `toll` a call."""

    action_low = np.array([-2.0], np.float32)
    action_high = np.array([2.0], np.float32)

    def __init__(self, toll: float = 0.0) -> None:
        self.toll = toll
        self.asked = 0

    def rollout_costs(
        self, starts: NDArray[np.uint8], goals: NDArray[np.uint8], actions: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        self.asked += 1
        here, there = (frames[:, 0, 0, 0].astype(np.float32) for frames in (starts, goals))
        ends = here[:, None] + actions[..., 0].sum(axis=2)
        return np.asarray((ends - there[:, None]) ** 2 + self.toll * self.asked)
