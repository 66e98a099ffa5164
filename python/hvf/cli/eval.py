"""``hvf eval DOMAIN``: success rates."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from hvf.cli.arguments import domain_named, evaluating
from hvf.evaluation.evaluation import Evaluation


@dataclasses.dataclass(frozen=True)
class Eval:
    """Measure how often a method reaches the goal, with its confidence interval.

    The same command goes on where it was stopped. Episodes are those of the validation split,
    unless ``--split test`` asks for those that published tables are made of. Examples:

        hvf eval maze --method hvf --subgoals 2 --task hard

        hvf eval maze --method none --dynamics simulator --preset paper

    Attributes:
        evaluation: which method, world and task, and how it plans.
        trials: episodes.
        out: JSON file with the result and every trial's outcome; by default named after all
            settings that differ from the preset's, in outputs/eval.
        chunk: trials that run together; a stop loses no more than these. 0 for what suits.
        workers: processes that simulate and draw; 0 for as many as there are cores.
        overwrite: begin anew if the file holds another evaluation.
    """

    evaluation: Evaluation
    trials: int = 100
    out: Path | None = None
    chunk: int = 0
    workers: int = 0
    overwrite: bool = False


def run(words: Sequence[str]) -> None:
    """Measure, write the report, and print it."""
    from hvf.evaluation.report import table
    from hvf.evaluation.run import evaluate

    domain, rest = domain_named("eval", words)
    domain.check_task(domain.default_task)
    config = evaluating(Eval, "eval", domain, rest)
    file = config.out or Path("outputs", "eval", f"{config.evaluation.slug}.json")
    console = Console()
    report = evaluate(
        config.evaluation,
        config.trials,
        file,
        chunk=config.chunk,
        workers=config.workers,
        overwrite=config.overwrite,
        console=console,
    )
    console.print(table([report]))
    console.print(f"{file} has every trial, all settings and versions", highlight=False)
