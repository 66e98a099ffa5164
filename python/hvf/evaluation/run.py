"""Success rates with confidence intervals, resumable, as JSON.

Trials run in chunks of a few, in lock-step; each finished chunk is saved. A stopped evaluation
goes on from there and ends in the same result, since a trial depends on its own seed only.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from rich.console import Console

from hvf.evaluation.acting import Outcome, Watcher
from hvf.evaluation.code import code_of, same_code
from hvf.evaluation.evaluation import Evaluation
from hvf.evaluation.report import Report, TrialRecord, load, save
from hvf.evaluation.task import Task
from hvf.progress import Bar, progress
from hvf.protocols import Images, Indices

__all__ = ["Runnable", "evaluate", "evaluate_task"]


class Runnable(Protocol):
    """A method on numbered episodes of a domain; see :class:`hvf.evaluation.task.Task`."""

    @property
    def name(self) -> str:
        """What is evaluated, in a few words."""
        ...

    @property
    def config(self) -> Mapping[str, Any]:
        """All settings, JSON's types: the head of the report."""
        ...

    @property
    def steps(self) -> int:
        """Most steps of an episode."""
        ...

    @property
    def chunk(self) -> int:
        """Episodes that run together if nothing else is asked for."""
        ...

    def run(self, first: int, count: int, watchers: Sequence[Watcher] = ()) -> Outcome:
        """Run episodes ``first..first + count``."""
        ...


def evaluate(
    evaluation: Evaluation,
    trials: int = 100,
    out: Path | None = None,
    *,
    chunk: int = 0,
    workers: int = 0,
    overwrite: bool = False,
    console: Console | None = None,
) -> Report:
    """Run the first episodes of an evaluation's split; see :func:`evaluate_task`.

    Args:
        evaluation: which.
        trials: how many episodes.
        out: JSON file to write; its finished trials are kept and not run again.
        chunk: trials that run in lock-step; 0 for what suits: one where that takes long.
        workers: processes that simulate and draw, for domains that have any.
        overwrite: start anew if ``out`` holds another evaluation.
        console: where progress goes.

    Raises:
        FileNotFoundError: models that are not there.
        FileExistsError, ValueError, KeyboardInterrupt: as :func:`evaluate_task`.
    """
    with Task.open(evaluation, workers) as task:
        return evaluate_task(task, trials, out, chunk, overwrite, console)


def evaluate_task(
    task: Runnable,
    trials: int,
    out: Path | None = None,
    chunk: int = 0,
    overwrite: bool = False,
    console: Console | None = None,
) -> Report:
    """Run episodes ``0..trials`` of a task.

    Args:
        task: what to run.
        trials: how many episodes.
        out: JSON file to write; its finished trials are kept and not run again.
        chunk: trials that run in lock-step; the result does not depend on it. 0 for the task's.
        overwrite: start anew if ``out`` holds another evaluation.
        console: where progress goes.

    Raises:
        FileExistsError: ``out`` holds another evaluation, or one by other code.
        ValueError: numbers that are not positive.
        KeyboardInterrupt: stopped; the same call goes on from there.
    """
    if trials < 1:
        raise ValueError(f"trials: must be at least 1, got {trials}")
    if chunk < 0:
        raise ValueError(f"chunk: must be at least 1, or 0 for the usual, got {chunk}")
    console = console or Console()
    code, config = code_of(), task.config
    done, earlier = ({}, 0.0) if out is None else _finished(out, task.name, config, code, overwrite)
    begin = time.perf_counter() - earlier

    def report() -> Report:
        ordered = tuple(done[index] for index in sorted(done) if index < trials)
        return Report.of(task.name, config, ordered, time.perf_counter() - begin, code)

    missing = [index for index in range(trials) if index not in done]
    total, before = trials * task.steps, len(done) * task.steps
    with progress(console, f"{task.name}:", total, "steps", completed=before) as bar:
        watcher = _Steps(bar, task.steps, trials, done)
        try:
            for first, count in _runs(missing, chunk or task.chunk):
                watcher.begin(count)
                for record in records(task.run(first, count, [watcher]), first):
                    done[record.index] = record
                    if record.error is not None:
                        console.print(f"{task.name}: {record.error}")
                if out is not None:
                    save(report(), out)
                watcher.end()
        except KeyboardInterrupt:
            if out is not None:
                console.print(f"{out}: stopped; the same command goes on from there")
            raise
    return report()


def records(outcome: Outcome, first: int) -> list[TrialRecord]:
    """The outcomes of episodes ``first`` and following, one record each.

    Trials decide in lock-step: the time of a decision is each one's share.
    """
    step = outcome.acting_seconds / max(outcome.decisions, 1)
    return [
        TrialRecord(
            first + offset, trial.success, trial.steps, trial.switches, search, step, trial.error
        )
        for offset, (trial, search) in enumerate(
            zip(outcome.trials, outcome.search_seconds, strict=True)
        )
    ]


class _Steps:
    """Moves a progress bar by every step and choice of subgoals (:class:`Watcher`)."""

    def __init__(self, bar: Bar, steps: int, trials: int, done: Mapping[int, TrialRecord]) -> None:
        self._bar, self._steps, self._trials, self._done = bar, steps, trials, done
        self._count = 0

    def begin(self, count: int) -> None:
        """A chunk begins."""
        self._count = count
        self._tell("choosing subgoals of")

    def chosen(self, trial: int) -> None:
        """A trial's subgoals are chosen."""
        last = trial + 1 == self._count
        self._tell("acting in" if last else f"chose subgoals of {trial + 1} of")

    def seen(self, step: int, which: Indices, observations: Images) -> None:
        """Trials see something: nothing to tell."""

    def stepped(self, step: int, which: Indices) -> None:
        """Trials took a step."""
        ahead = len(self._done) * self._steps + step * self._count
        self._bar.update(completed=ahead)

    def end(self) -> None:
        """A chunk is done and saved."""
        self._bar.update(completed=len(self._done) * self._steps)
        self._tell("")

    def _tell(self, doing: str) -> None:
        reached = sum(record.success for record in self._done.values())
        now = f"; {doing} {self._count} trials" if doing else ""
        words = f"{reached} of {len(self._done)} reached the goal, {self._trials} asked for{now}"
        self._bar.update(note=words)


def _finished(
    out: Path, name: str, config: Mapping[str, Any], code: Mapping[str, Any], overwrite: bool
) -> tuple[dict[int, TrialRecord], float]:
    """Trials that an earlier run of the same evaluation has finished, and how long it took."""
    if not out.exists() or overwrite:
        return {}, 0.0
    if out.is_dir():
        raise FileExistsError(f"{out}: is a directory; out must name a JSON file")
    try:
        earlier = load(out)
    except ValueError as error:
        raise FileExistsError(
            f"{out}: holds something else; choose another out, or overwrite"
        ) from error
    differs = earlier.differs_from(name, config)
    if differs:
        raise FileExistsError(
            f"{out}: holds another evaluation ({earlier.name}: {differs}); choose another out, or "
            "overwrite"
        )
    if not same_code(earlier.code, code):
        raise FileExistsError(f"{out}: was begun by other code; choose another out, or overwrite")
    return {trial.index: trial for trial in earlier.trials}, earlier.wall_seconds


def _runs(missing: Sequence[int], chunk: int) -> list[tuple[int, int]]:
    """Ranges (first, count) of at most ``chunk`` that cover the missing indices."""
    runs: list[tuple[int, int]] = []
    for index in missing:
        if runs and index == sum(runs[-1]) and runs[-1][1] < chunk:
            runs[-1] = (runs[-1][0], runs[-1][1] + 1)
        else:
            runs.append((index, 1))
    return runs
