"""Random interaction in the maze."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from rich.console import Console

import hvf_core
from hvf.data.collect import CollectConfig, collect
from hvf.data.episodes import Episodes


@dataclasses.dataclass(frozen=True)
class MazeCollection(CollectConfig):
    """How much to collect in the maze, and where to put it.

    Episodes start anywhere in the arena and take uniformly random actions, a new one every step.
    """

    def run(self, console: Console | None = None) -> Path:
        """Collect, on all cores.

        Raises:
            FileExistsError, ValueError, OSError, KeyboardInterrupt: as
                :func:`hvf.data.collect.collect`.
        """

        def rollouts(seed: int, first: int, count: int, steps: int) -> Episodes:
            return Episodes(*hvf_core.maze_collect(seed, first, count, steps, self.image_size))

        limit = hvf_core.MAZE_ACTION_LIMIT
        return collect(
            self,
            "maze",
            {"image_size": self.image_size, "policy": "uniform"},
            rollouts,
            console,
            cameras=("above",),
            action_names=("x", "y"),
            action_low=(-limit, -limit),
            action_high=(limit, limit),
        )
