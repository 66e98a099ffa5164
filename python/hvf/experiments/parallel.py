"""Many evaluations side by side: each in a process of its own, on one thread, with its own file.

One thread each is the fastest use of the cores, since no evaluation waits for another, and makes
sums of torch the same on every machine's number of cores. A finished evaluation is read, a stopped
one goes on. When the parent is stopped or dies, all of them stop.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from hvf.cores import cores
from hvf.evaluation.evaluation import Evaluation
from hvf.evaluation.report import Report, load
from hvf.evaluation.run import evaluate
from hvf.interrupts import Interrupts
from hvf.memory import keep_freed
from hvf.registry import METHODS

_POOLS = ("RAYON_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
_ONE_THREAD = dict.fromkeys(_POOLS, "1")
_LOOK = 0.2
"""Seconds between two looks at the processes."""
_PATIENCE = 5.0
"""Seconds that a process has to stop before it is killed; its file is whole either way."""
_SLOWER = {"latent": 100.0, "temporal": 10.0, "tdm": 100.0}
"""How much slower than pixels a cost is, roughly; see :mod:`hvf.worlds.cost`."""


@dataclasses.dataclass(frozen=True)
class Failure:
    """An evaluation that ended in an error.

    Attributes:
        evaluation: which.
        message: the error.
    """

    evaluation: Evaluation
    message: str


def run_all(
    files: Mapping[Evaluation, Path],
    trials: int,
    *,
    workers: int = 0,
    chunk: int = 0,
    console: Console | None = None,
) -> list[Failure]:
    """Run all evaluations that are not finished, those that take least first.

    Args:
        files: evaluations, and the JSON file of each.
        trials: episodes of each.
        workers: processes, 0 for as many as there are cores; results do not depend on it.
        chunk: trials that run together, and that a stop loses; 0 for what suits domain and method.
        console: where progress goes.

    Returns:
        Those that failed; the others are finished.

    Raises:
        FileExistsError: a file holds another evaluation.
        ValueError: numbers that are not positive.
        KeyboardInterrupt: stopped; the same call goes on from there.
    """
    for name, value, least in (("trials", trials, 1), ("workers", workers, 0), ("chunk", chunk, 0)):
        if value < least:
            raise ValueError(f"{name}: must be at least {least}, got {value}")
    console = console or Console(stderr=True)
    work = {evaluation: _work(evaluation) for evaluation in files}
    missing = [
        evaluation for evaluation, file in files.items() if not finished(evaluation, file, trials)
    ]
    waiting = deque(sorted(missing, key=lambda evaluation: work[evaluation]))
    context = multiprocessing.get_context("spawn")
    children: list[_Child] = []
    failures: list[Failure] = []
    total = trials * sum(work.values())
    done = total - trials * sum(work[evaluation] for evaluation in missing)
    with Interrupts() as interrupts, _progress(console) as (progress, bar):
        try:
            while waiting or children:
                interrupts.check()
                while waiting and len(children) < (workers or cores()):
                    evaluation = waiting.popleft()
                    file = files[evaluation]
                    children.append(_Child.start(context, evaluation, file, trials, chunk))
                wait([child.process.sentinel for child in children], timeout=_LOOK)
                for child in [child for child in children if not child.process.is_alive()]:
                    children.remove(child)
                    done += trials * work[child.evaluation]
                    message = child.message()
                    if message:
                        failures.append(Failure(child.evaluation, message))
                        console.print(f"{child.evaluation.name}: {message}", highlight=False)
                now = done + sum(child.trials() * work[child.evaluation] for child in children)
                names = ", ".join(child.evaluation.name for child in children)
                left = len(waiting) + len(children)
                progress.update(bar, total=total, completed=now, left=left, names=names)
        except KeyboardInterrupt:
            console.print("stopped; the same command goes on from there", highlight=False)
            raise
        finally:
            _stop(children)
    return failures


def finished(evaluation: Evaluation, file: Path, trials: int) -> bool:
    """Whether a file has all trials of an evaluation.

    Raises:
        FileExistsError: it holds something else.
    """
    report = report_of(evaluation, file)
    if report is None:
        return False
    return set(range(trials)) <= {trial.index for trial in report.trials}


def report_of(evaluation: Evaluation, file: Path) -> Report | None:
    """What a file has of an evaluation; None if it is not there.

    Raises:
        FileExistsError: it holds something else.
    """
    if not file.exists():
        return None
    try:
        report = load(file)
    except ValueError as error:
        raise FileExistsError(f"{file}: is in the way ({error}); move it away") from error
    for name, value in _settings(evaluation).items():
        found = getattr(report, name)
        if json.loads(json.dumps(found)) != json.loads(json.dumps(value)):
            raise FileExistsError(
                f"{file}: holds another evaluation ({report.name}, other {name}); move it away"
            )
    return report


def _settings(evaluation: Evaluation) -> dict[str, object]:
    """What a report of an evaluation has to say, whatever the weights."""
    method = METHODS[evaluation.method]
    return {
        "domain": evaluation.domain,
        "task": evaluation.task,
        "method": evaluation.method,
        "subgoals": evaluation.subgoals if method.has_subgoals else 0,
        "seed": evaluation.episode_seed,
        "world": evaluation.world_names,
        "planning": dataclasses.asdict(evaluation.planning),
    }


def _work(evaluation: Evaluation) -> float:
    """Predicted frames of a trial, roughly: what its time goes with."""
    planning, method = evaluation.planning, METHODS[evaluation.method]
    if not method.needs_dynamics:
        return 1.0
    plans = evaluation.acting.steps
    if method.needs_generator:
        searched = planning.subgoal_samples * planning.subgoal_iterations
        plans += searched * (evaluation.subgoals + 1)
    frames = planning.samples * planning.iterations * planning.horizon
    return float(plans * frames) * _SLOWER.get(evaluation.world.cost, 1.0)


@dataclasses.dataclass
class _Child:
    """A process with one evaluation."""

    evaluation: Evaluation
    file: Path
    process: BaseProcess
    errors: Connection
    _seen: tuple[int, int] = (0, 0)

    @classmethod
    def start(
        cls,
        context: multiprocessing.context.SpawnContext,
        evaluation: Evaluation,
        file: Path,
        trials: int,
        chunk: int,
    ) -> _Child:
        here, there = context.Pipe(duplex=False)
        process = context.Process(target=_run, args=(evaluation, file, trials, chunk, there))
        with _environment(_ONE_THREAD):
            process.start()
        there.close()
        return cls(evaluation, file, process, here)

    def trials(self) -> int:
        """How many are done, by its file, which is read when it is new."""
        try:
            changed = self.file.stat().st_mtime_ns
            if changed != self._seen[0]:
                self._seen = changed, len(load(self.file).trials)
        except (OSError, ValueError):
            pass
        return self._seen[1]

    def message(self) -> str:
        """Why it ended, if it is not because it was done."""
        self.process.join()
        try:
            message = self.errors.recv() if self.errors.poll() else ""
        except EOFError:
            message = ""
        self.errors.close()
        status = self.process.exitcode
        return str(message) or (f"ended with status {status}" if status else "")


def _run(evaluation: Evaluation, file: Path, trials: int, chunk: int, errors: Connection) -> None:
    """In the child: one evaluation."""
    # Ctrl-C reaches the whole group of processes; the parent decides, and says so with SIGTERM.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    _end_with_parent()
    keep_freed()
    try:
        evaluate(evaluation, trials, file, chunk=chunk, workers=1, console=Console(quiet=True))
    except KeyboardInterrupt:
        sys.exit(130)
    except Exception as error:
        errors.send(f"{type(error).__name__}: {error}")
        sys.exit(1)


def _end_with_parent() -> None:
    """A parent that is killed can say nothing; do not go on writing files beside its successor."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _stop(children: Sequence[_Child]) -> None:
    """End processes, gently first."""
    for child in children:
        child.process.terminate()
    deadline = time.monotonic() + _PATIENCE
    for child in children:
        child.process.join(max(deadline - time.monotonic(), 0.0))
        if child.process.is_alive():
            child.process.kill()
            child.process.join()


@contextlib.contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    """Variables for processes that are started within; as before afterwards."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextlib.contextmanager
def _progress(console: Console) -> Iterator[tuple[Progress, TaskID]]:
    columns = (
        TextColumn("{task.fields[left]} evaluations left"),
        BarColumn(),
        TimeRemainingColumn(),
        TextColumn("now {task.fields[names]}"),
    )
    shown = console.is_terminal
    with Progress(*columns, console=console, disable=not shown, transient=True) as progress:
        yield progress, progress.add_task("", total=None, left="", names="")
