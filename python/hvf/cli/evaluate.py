"""``hvf eval``: success rates."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from hvf.cli.presets import begin_with_preset as prepare
from hvf.domains.maze import MazeEvaluation, Preset
from hvf.evaluation.run import Task, evaluate, table

__all__ = ["EvalMaze", "Measured", "maze", "measure", "prepare"]


@dataclasses.dataclass(frozen=True)
class Measured:
    """How much is measured, and where the result goes.

    Attributes:
        trials: episodes; the first 100 of the default seed are those of the results table.
        out: JSON file with the result and every trial's outcome; by default named after the
            evaluation, in outputs/eval.
        chunk: trials that run together; a stop loses no more than these.
        overwrite: begin anew if the file holds another evaluation.
    """

    trials: int = 100
    out: Path | None = None
    chunk: int = 25
    overwrite: bool = False


@dataclasses.dataclass(frozen=True)
class EvalMaze(Measured):
    """Success of an agent in the maze.

    Attributes:
        evaluation: which agent, world and difficulty, and how it plans.
        preset: settings to begin with; the options below show and change them one by one.
    """

    evaluation: Annotated[MazeEvaluation, tyro.conf.OmitArgPrefixes] = MazeEvaluation()
    preset: Preset = "default"


def maze(config: Annotated[EvalMaze, tyro.conf.arg(name="")]) -> None:
    """Measure how often an agent reaches the goal in the maze, with its confidence interval.

    The same command goes on where it was stopped. Examples:

        hvf eval maze --agent hvf --subgoals 2 --difficulty hard
        hvf eval maze --agent none --model simulator --preset paper
    """
    measure(config.evaluation.task(), config, config.preset)


def measure(task: Task, config: Measured, preset: str) -> None:
    """Run a task's trials, write the report, and print it."""
    slug = re.sub(r"[^a-z0-9]+", "-", f"{task.name} {preset}".lower()).strip("-")
    file = config.out or Path("outputs", "eval", f"{slug}.json")
    console = Console()
    report = evaluate(task, config.trials, file, config.chunk, config.overwrite, console=console)
    console.print(table([report]))
    console.print(f"{file} has every trial, all settings and versions", highlight=False)
