"""Trials of which only images can be read, to show that a method reads nothing else."""

from __future__ import annotations

from typing import Any

from hvf.protocols import Trials

SHOWN = ("goals", "observe", "step", "success")
"""What every domain has: images, actions, and whether it is done."""


class Blind:
    """What trials show; states, true subgoals and frames of a simulator are not there.

    Attributes:
        refused: what was asked for beyond that.
    """

    def __init__(self, trials: Trials) -> None:
        self._trials = trials
        self.refused: list[str] = []

    def __len__(self) -> int:
        return len(self._trials)

    def __getattr__(self, name: str) -> Any:
        if name not in SHOWN:
            self.refused.append(name)
            raise AttributeError(f"read {name}, which is no image")
        return getattr(self._trials, name)
