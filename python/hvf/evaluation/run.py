"""Success rates with confidence intervals, resumable, as JSON.

Trials run in chunks of a few, in lock-step; each finished chunk is saved. A stopped evaluation
goes on from there and ends in the same result, since a trial depends on its own seed only.
"""

from __future__ import annotations

import dataclasses
import json
import platform
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Protocol

from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from hvf.evaluation.acting import Outcome
from hvf.evaluation.statistics import wilson_interval
from hvf.files import write_bytes

FORMAT = 1
"""Version of the JSON that :class:`Report` is written as."""


class Task(Protocol):
    """An agent on numbered episodes of an environment."""

    @property
    def name(self) -> str:
        """What is evaluated, in a few words."""
        ...

    @property
    def config(self) -> Mapping[str, Any]:
        """All settings, JSON's types."""
        ...

    def run(self, first: int, count: int) -> Outcome:
        """Run episodes ``first..first + count``."""
        ...


@dataclasses.dataclass(frozen=True)
class TrialRecord:
    """Outcome of one episode.

    Attributes:
        index: number of the episode.
        success: whether the goal was reached.
        steps: steps taken.
        switches: steps before which the next subgoal was taken.
        search_seconds: time of its subgoal search: its share of its chunk's.
        step_seconds: time of deciding on one action: its share of its chunk's.
        error: why it ended before its time, in failure; else None.
    """

    index: int
    success: bool
    steps: int
    switches: tuple[int, ...]
    search_seconds: float
    step_seconds: float
    error: str | None = None


@dataclasses.dataclass(frozen=True)
class Report:
    """What an evaluation found.

    Attributes:
        name: what was evaluated.
        config: all settings.
        trials: outcomes, in order of their index.
        wall_seconds: time it took, over all runs if it was resumed.
        provenance: code and program versions.
    """

    name: str
    config: Mapping[str, Any]
    trials: tuple[TrialRecord, ...]
    wall_seconds: float
    provenance: Mapping[str, Any]

    @property
    def successes(self) -> int:
        """Number of successful trials."""
        return sum(trial.success for trial in self.trials)

    @property
    def success_rate(self) -> float:
        """Fraction of successful trials."""
        return self.successes / len(self.trials)

    @property
    def interval(self) -> tuple[float, float]:
        """95% confidence interval of the success rate (Wilson, 1927)."""
        return wilson_interval(self.successes, len(self.trials))

    @property
    def search_seconds(self) -> float:
        """Mean time of one subgoal search; trials of a chunk share the cores."""
        return sum(trial.search_seconds for trial in self.trials) / len(self.trials)

    @property
    def step_seconds(self) -> float:
        """Mean time of deciding on one action; trials of a chunk share the cores."""
        steps = sum(trial.steps for trial in self.trials)
        return sum(trial.step_seconds * trial.steps for trial in self.trials) / max(steps, 1)

    def to_json(self) -> dict[str, Any]:
        """As written to disk."""
        low, high = self.interval if self.trials else (0.0, 1.0)
        return {
            "format": FORMAT,
            "name": self.name,
            "config": self.config,
            "successes": self.successes,
            "success_rate": self.success_rate if self.trials else None,
            "confidence_interval_95": [low, high],
            "seconds_per_search": self.search_seconds if self.trials else None,
            "seconds_per_step": self.step_seconds if self.trials else None,
            "wall_seconds": self.wall_seconds,
            "provenance": self.provenance,
            "trials": [dataclasses.asdict(trial) for trial in self.trials],
        }


def evaluate(
    task: Task,
    trials: int,
    out: Path | None = None,
    chunk: int = 25,
    overwrite: bool = False,
    console: Console | None = None,
) -> Report:
    """Run episodes ``0..trials`` of a task.

    Args:
        task: what to run.
        trials: how many episodes.
        out: JSON file to write; its finished trials are kept and not run again.
        chunk: trials that run in lock-step; the result does not depend on it.
        overwrite: start anew if ``out`` holds another evaluation.
        console: where progress goes.

    Raises:
        FileExistsError: ``out`` holds another evaluation, or one by other code.
        ValueError: numbers that are not positive.
        KeyboardInterrupt: stopped; the same call goes on from there.
    """
    for argument, value in (("trials", trials), ("chunk", chunk)):
        if value < 1:
            raise ValueError(f"{argument}: must be at least 1, got {value}")
    console = console or Console()
    made_by = provenance()
    done, earlier = ({}, 0.0) if out is None else _finished(out, task, made_by, overwrite)
    begin = time.perf_counter()

    def report(records: Mapping[int, TrialRecord]) -> Report:
        ordered = tuple(records[index] for index in sorted(records) if index < trials)
        seconds = earlier + time.perf_counter() - begin
        return Report(task.name, task.config, ordered, seconds, made_by)

    missing = [index for index in range(trials) if index not in done]
    with Progress(
        TextColumn(f"{task.name}:"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("trials, {task.fields[success]} reached the goal, left"),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
        transient=True,
    ) as progress:
        successes = sum(record.success for record in done.values())
        bar = progress.add_task("", total=trials, success=successes, completed=len(done))
        try:
            for first, count in _runs(missing, chunk):
                for record in records(task.run(first, count), first):
                    done[record.index] = record
                    if record.error is not None:
                        console.print(f"{task.name}: {record.error}")
                if out is not None:
                    save(report(done), out)
                successes = sum(record.success for record in done.values())
                progress.update(bar, advance=count, success=successes)
        except KeyboardInterrupt:
            if out is not None:
                console.print(f"{out}: stopped; the same command goes on from there")
            raise
    return report(done)


def save(report: Report, out: Path) -> None:
    """Write a report, whole or not at all.

    Raises:
        OSError: the file cannot be written.
    """
    write_bytes(out, (json.dumps(report.to_json(), indent=1) + "\n").encode())


def load(path: Path) -> Report:
    """Read a report.

    Raises:
        FileNotFoundError: there is none.
        ValueError: the file is not a report, or is damaged.
    """
    try:
        content = json.loads(path.read_text())
        if content["format"] != FORMAT:
            raise ValueError(f"format {content['format']}")
        return Report(
            content["name"],
            content["config"],
            tuple(
                TrialRecord(**{**trial, "switches": tuple(trial["switches"])})
                for trial in content["trials"]
            ),
            float(content["wall_seconds"]),
            content["provenance"],
        )
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: is not an evaluation of this version ({error})") from error


def table(reports: Sequence[Report], title: str = "") -> Table:
    """Reports as a table, one in a row."""
    result = Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1))
    result.add_column("evaluation")
    for column in ("success", "95%", "s/search", "ms/step"):
        result.add_column(column, justify="right", no_wrap=True)
    for report in reports:
        low, high = report.interval
        result.add_row(
            report.name,
            f"{report.success_rate:.0%} ({report.successes}/{len(report.trials)})",
            f"{100 * low:.0f}-{high:.0%}",
            f"{report.search_seconds:.2f}" if report.search_seconds > 1e-3 else "-",
            f"{1e3 * report.step_seconds:.1f}",
        )
    return result


def provenance() -> dict[str, Any]:
    """Commit and versions of the code that runs."""
    packages = {}
    for package in ("hvf", "numpy", "torch", "gymnasium", "mujoco"):
        try:
            packages[package] = version(package)
        except PackageNotFoundError:
            packages[package] = "not installed"
    return {
        "commit": _commit(),
        "python": platform.python_version(),
        "machine": f"{platform.machine()} {sys.platform}",
        "packages": packages,
    }


def _commit() -> str | None:
    """Commit of the working tree that this file is in; None outside of one."""
    here = Path(__file__).parent
    try:
        commit = _git(here, "rev-parse", "HEAD")
        changed = _git(here, "status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.SubprocessError):
        return None
    return f"{commit} with changes" if changed else commit


def _git(folder: Path, *arguments: str) -> str:
    result = subprocess.run(
        ["git", *arguments], cwd=folder, capture_output=True, text=True, check=True, timeout=10
    )
    return result.stdout.strip()


def _finished(
    out: Path, task: Task, made_by: Mapping[str, Any], overwrite: bool
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
    same_config = json.loads(json.dumps(task.config)) == earlier.config
    if not (same_config and earlier.name == task.name):
        raise FileExistsError(
            f"{out}: holds another evaluation ({earlier.name}, or other settings); choose another "
            "out, or overwrite"
        )
    if earlier.provenance.get("commit") != made_by["commit"]:
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


def records(outcome: Outcome, first: int) -> list[TrialRecord]:
    """The outcomes of episodes ``first`` and following, one record each."""
    search = outcome.search_seconds / len(outcome.trials)
    step = outcome.acting_seconds / max(outcome.decisions, 1)
    return [
        TrialRecord(
            first + offset, trial.success, trial.steps, trial.switches, search, step, trial.error
        )
        for offset, trial in enumerate(outcome.trials)
    ]
