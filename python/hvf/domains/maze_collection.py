"""Random interaction in the maze."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from rich.console import Console

import hvf_core
from hvf.data.collect import CollectConfig, collect
from hvf.data.episodes import Episodes
from hvf.envs.maze.layouts import fingerprint, layout_of, state_names


@dataclasses.dataclass(frozen=True)
class MazeCollection(CollectConfig):
    """How much to collect in the maze, and where to put it.

    Episodes start anywhere in the arena and take uniformly random actions, a new one every step.

    Attributes:
        layout: walls: none for the paper's maze; a name (corridor-4, or another number up to 7,
            u-maze, spiral) or a TOML file. Every episode draws the gaps anew.
    """

    layout: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.layout is not None:
            layout_of(self.layout)

    def run(self, console: Console | None = None) -> Path:
        """Collect, on all cores.

        Raises:
            FileExistsError, ValueError, OSError, KeyboardInterrupt: as
                :func:`hvf.data.collect.collect`.
        """
        layout = None if self.layout is None else layout_of(self.layout)
        parameters: dict[str, Any] = {"image_size": self.image_size, "policy": "uniform"}
        if layout is not None:
            parameters |= {"layout": fingerprint(layout), "states": state_names(layout)}

        def rollouts(seed: int, first: int, count: int, steps: int) -> Episodes:
            return Episodes(
                *hvf_core.maze_collect(seed, first, count, steps, self.image_size, layout)
            )

        limit = hvf_core.MAZE_ACTION_LIMIT
        return collect(
            self,
            "maze",
            parameters,
            rollouts,
            console,
            cameras=("above",),
            action_names=("x", "y"),
            action_low=(-limit, -limit),
            action_high=(limit, limit),
        )
