"""Programs that tests run beside themselves, each with a deadline.

A child starts with the signals that a program in the foreground of a terminal has, also where the
tests were started with some of them ignored (in the background of a script, under ``nohup``);
and in a session of its own, so that it and whatever it started can be ended together.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO

DEADLINE = 600.0
"""Seconds that a child may take: far more than any needs, also on a busy machine."""

_LAST_WORDS = 10.0
"""Seconds to wait for what an ended child has printed."""

HVF = (sys.executable, "-c", "import sys; from hvf.cli import main; sys.exit(main())")
"""The command line, whether or not its script is on the path."""


class TimedOutError(AssertionError):
    """A child, or what a test waited for, took longer than its deadline."""


class Child:
    """A running program.

    Attributes:
        pid: number of its process, and of its group.
    """

    def __init__(self, process: subprocess.Popen[str], deadline: float) -> None:
        self.pid = process.pid
        self._process = process
        self._seconds = deadline
        self._end = time.monotonic() + deadline
        self._text: dict[str, list[str]] = {"output": [], "errors": []}
        self._grown = threading.Condition()
        self._readers = [
            threading.Thread(target=self._read, args=(name, pipe), daemon=True)
            for name, pipe in (("output", process.stdout), ("errors", process.stderr))
        ]
        for reader in self._readers:
            reader.start()

    @property
    def output(self) -> str:
        """What it has printed."""
        return "".join(self._text["output"])

    @property
    def errors(self) -> str:
        """What it has printed to standard error."""
        return "".join(self._text["errors"])

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self._process.poll() is None

    def tell(self, number: signal.Signals) -> None:
        """Send a signal to it and all that it started, as a terminal does."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, number)

    def tell_it_alone(self, number: signal.Signals) -> None:
        """Send a signal to its own process only."""
        self._process.send_signal(number)

    def wait_until(self, holds: Callable[[], bool]) -> None:
        """Wait until something holds.

        Raises:
            TimedOutError: it does not by the deadline, or the child has ended before.
        """
        while not holds():
            if not self.running:
                for reader in self._readers:
                    reader.join(_LAST_WORDS)
                if holds():
                    return
                raise TimedOutError(self._told("ended before what was waited for"))
            self._check_deadline()
            time.sleep(0.002)

    def wait_for(self, text: str) -> None:
        """Wait until it has printed ``text``, to either of both."""
        self.wait_until(lambda: text in self.output or text in self.errors)

    def wait(self) -> int:
        """Wait for its end, and for the end of everything that could still print for it.

        Returns:
            Its status; negative: minus the signal that ended it.

        Raises:
            TimedOutError: it takes longer than its deadline.
        """
        while self.running or any(reader.is_alive() for reader in self._readers):
            self._check_deadline()
            with self._grown:
                self._grown.wait(0.01)
        return self._process.wait()

    def gone(self) -> bool:
        """Whether it and everything that it started have ended."""
        return not self.running and not members(self.pid)

    def wait_until_gone(self) -> None:
        """Wait until nothing of it is left.

        Raises:
            TimedOutError: something outlives the deadline.
        """
        while not self.gone():
            self._check_deadline()
            time.sleep(0.01)

    def end(self) -> None:
        """Kill what is left of it."""
        if not self.gone():  # its number may be another's by now
            self.tell(signal.SIGKILL)
        self._process.wait()
        for reader in self._readers:
            reader.join(_LAST_WORDS)

    def _check_deadline(self) -> None:
        if time.monotonic() > self._end:
            self.end()
            raise TimedOutError(self._told(f"took longer than {self._seconds:g} s"))

    def _told(self, what: str) -> str:
        return f"{self._process.args}: {what}\n{self.output}\n{self.errors}"

    def _read(self, name: str, pipe: IO[str]) -> None:
        with pipe:
            for line in pipe:
                with self._grown:
                    self._text[name].append(line)
                    self._grown.notify_all()


@contextlib.contextmanager
def started(
    words: Sequence[str], *, env: Mapping[str, str] | None = None, deadline: float = DEADLINE
) -> Iterator[Child]:
    """A program that runs while the block does; nothing of it is left after the block.

    Args:
        words: program and arguments.
        env: variables to set, beside this process's own.
        deadline: seconds; after them whatever waits for the child kills it and fails.
    """
    with default_signals():
        process = subprocess.Popen(
            list(words),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, **(env or {})},
            start_new_session=True,
        )
    child = Child(process, deadline)
    try:
        yield child
    finally:
        child.end()


def run(
    words: Sequence[str],
    *,
    env: Mapping[str, str] | None = None,
    deadline: float = DEADLINE,
    check: bool = False,
) -> subprocess.CompletedProcess[str]:
    """Run a program to its end.

    Args:
        words: program and arguments.
        env: variables to set, beside this process's own.
        deadline: seconds; after them it is killed, and the test fails.
        check: fail unless its status is 0.
    """
    with started(words, env=env, deadline=deadline) as child:
        status = child.wait()
        done = subprocess.CompletedProcess(words, status, child.output, child.errors)
    assert not check or status == 0, f"{words}: status {status}\n{child.output}\n{child.errors}"
    return done


def python(program: str) -> list[str]:
    """Words that run a program given as text."""
    return [sys.executable, "-c", program]


def members(group: int) -> list[int]:
    """Processes of a child's group that have not ended.

    Those do not count that have and whose status nobody has asked for.
    """
    if not Path("/proc/self/stat").exists():  # another system than Linux
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return []
        return [group]
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, its_group = path.read_text().rpartition(")")[2].split()[:3]
        except OSError:  # has ended meanwhile
            continue
        if int(its_group) == group and state not in "ZX":
            found.append(int(path.parent.name))
    return found


@contextlib.contextmanager
def default_signals() -> Iterator[None]:
    """Ctrl-C interrupts this process and SIGTERM ends it, in this block, as nobody ignored them.

    A child that is started in the block has these signals too: what a parent ignores its children
    ignore, and a Python that ignores SIGINT from its start never raises KeyboardInterrupt.
    """
    wanted = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    ignored = [number for number in wanted if signal.getsignal(number) == signal.SIG_IGN]
    for number in ignored:
        signal.signal(number, wanted[number])
    try:
        yield
    finally:
        for number in ignored:
            signal.signal(number, signal.SIG_IGN)
