"""Episodes in memory, and where they come from.

Letters in shapes: ``N`` episodes of ``T`` steps, frames of ``H`` x ``W`` pixels, ``A`` action
dimensions, ``S`` state dimensions.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclasses.dataclass(frozen=True)
class Metadata:
    """Where the episodes of a file come from.

    Attributes:
        environment: name of the environment, such as ``maze``.
        parameters: what the environment was built with; JSON's types.
        seed: of the collection; episode ``i`` is a function of (seed, i).
        steps: actions per episode, ``T``.
        episodes: number of episodes, ``N``.
        versions: name to version of the programs that made it.
        diverged: simulations that diverged on the way; they are not among the episodes.
    """

    environment: str
    parameters: Mapping[str, Any]
    seed: int
    steps: int
    episodes: int
    versions: Mapping[str, str]
    diverged: int = 0


@dataclasses.dataclass(frozen=True)
class Episodes:
    """Episodes in memory, in the shapes of the module's table.

    Attributes:
        diverged: simulations that diverged before these were complete.

    Raises:
        ValueError: shapes that do not belong together, no episode, or actions that are not finite.
        TypeError: another dtype than the table's.
    """

    frames: NDArray[np.uint8]
    actions: NDArray[np.float32]
    states: NDArray[np.float64]
    diverged: int = 0

    def __post_init__(self) -> None:
        for name, dtype, ndim in (
            ("frames", np.uint8, 5),
            ("actions", np.float32, 3),
            ("states", np.float64, 3),
        ):
            array = getattr(self, name)
            if array.dtype != dtype:
                raise TypeError(f"{name} must be {np.dtype(dtype)}, got {array.dtype}")
            if array.ndim != ndim or 0 in array.shape:
                raise ValueError(f"{name} must have {ndim} non-empty axes, got {array.shape}")
        episodes, steps = self.actions.shape[:2]
        if self.frames.shape[:2] != (episodes, steps + 1) or self.frames.shape[-1] != 3:
            raise ValueError(
                f"frames must be [{episodes}, {steps + 1}, H, W, 3], got {self.frames.shape}"
            )
        if self.states.shape[:2] != (episodes, steps + 1):
            raise ValueError(
                f"states must be [{episodes}, {steps + 1}, S], got {self.states.shape}"
            )
        if not np.isfinite(self.actions).all():
            raise ValueError("actions must be finite")

    def __len__(self) -> int:
        return len(self.actions)
