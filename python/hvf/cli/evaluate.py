"""``hvf eval``: success rates."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from hvf.cli.presets import begin_with_preset as prepare
from hvf.evaluation.evaluate import evaluate, table
from hvf.evaluation.maze import MazeEvaluation, Preset

__all__ = ["maze", "prepare"]


@dataclasses.dataclass(frozen=True)
class EvalMaze:
    """Success of an agent in the maze.

    Attributes:
        evaluation: which agent, world and difficulty, and how it plans.
        trials: episodes; the first 100 of the default seed are those of the results table.
        preset: settings to begin with; the options below show and change them one by one.
        out: JSON file with the result and every trial's outcome; by default named after the
            evaluation, in outputs/eval.
        chunk: trials that run together; a stop loses no more than these.
        overwrite: begin anew if the file holds another evaluation.
    """

    evaluation: Annotated[MazeEvaluation, tyro.conf.OmitArgPrefixes] = MazeEvaluation()
    trials: int = 100
    preset: Preset = "default"
    out: Path | None = None
    chunk: int = 25
    overwrite: bool = False

    @property
    def file(self) -> Path:
        """Where the result is written."""
        words = f"{self.evaluation.name} {self.preset}"
        slug = re.sub(r"[^a-z0-9]+", "-", words.lower()).strip("-")
        return self.out or Path("outputs", "eval", f"{slug}.json")


def maze(config: Annotated[EvalMaze, tyro.conf.arg(name="")]) -> None:
    """Measure how often an agent reaches the goal in the maze, with its confidence interval.

    The same command goes on where it was stopped. Examples:

        hvf eval maze --agent hvf --subgoals 2 --difficulty hard
        hvf eval maze --agent none --model simulator --preset paper
    """
    console = Console()
    task = config.evaluation.task()
    report = evaluate(
        task, config.trials, config.file, config.chunk, config.overwrite, console=console
    )
    console.print(table([report]))
    console.print(f"{config.file} has every trial, all settings and versions", highlight=False)
