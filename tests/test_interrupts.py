"""Ctrl-C and SIGTERM: when they raise, when they are noted, and who has them afterwards."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import processes
from hvf.interrupts import Interrupts, sigterm_as_interrupt

BOTH = pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])


@pytest.fixture(autouse=True)
def handlers_come_back() -> Iterator[None]:
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    yield
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


@BOTH
def test_either_raises_keyboard_interrupt(number: signal.Signals) -> None:
    with pytest.raises(KeyboardInterrupt), sigterm_as_interrupt():
        os.kill(os.getpid(), number)


@BOTH
def test_the_first_is_noted_and_the_second_raises(number: signal.Signals) -> None:
    with sigterm_as_interrupt():
        with Interrupts() as interrupts:
            assert not interrupts.asked
            os.kill(os.getpid(), number)
            assert interrupts.asked
            with pytest.raises(KeyboardInterrupt):
                interrupts.check()
            with pytest.raises(KeyboardInterrupt):
                os.kill(os.getpid(), number)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)


def test_one_that_is_lost_in_a_destructor_is_noted_without_a_word(
    capsys: pytest.CaptureFixture[str],
) -> None:
    class Falls:
        def __init__(self, error: type[BaseException] | None) -> None:
            self.error = error

        def __del__(self) -> None:
            if self.error is not None:
                raise self.error
            signal.raise_signal(signal.SIGTERM)

    told: list[type[BaseException]] = []
    before = sys.unraisablehook
    sys.unraisablehook = lambda lost: told.append(lost.exc_type)
    try:
        with Interrupts(at_once=True) as interrupts:
            Falls(ValueError)
            assert told == [ValueError]
            Falls(None)
            with pytest.raises(KeyboardInterrupt):
                interrupts.check()
        assert told == [ValueError]
        Falls(KeyError)
        assert told == [ValueError, KeyError]
    finally:
        sys.unraisablehook = before
    assert "Traceback" not in capsys.readouterr().err


def test_what_is_ignored_stays_ignored() -> None:
    """A script that puts its work into the background has it ignore Ctrl-C."""
    before = [signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, signal.SIGTERM)]
    try:
        with sigterm_as_interrupt(), Interrupts() as interrupts:
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGTERM)
            assert not interrupts.asked
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
    finally:
        for number, handler in zip((signal.SIGINT, signal.SIGTERM), before, strict=True):
            signal.signal(number, handler)


def test_a_thread_may_use_them_too() -> None:
    seen: list[bool] = []

    def work() -> None:
        with sigterm_as_interrupt(), Interrupts() as interrupts:
            seen.append(interrupts.asked)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [False]


PLAN = """
import numpy as np, hvf_core
from hvf.interrupts import sigterm_as_interrupt
starts, targets = hvf_core.maze_episodes(0, 0, 1, "hard")
start = hvf_core.MazeFrames(np.repeat(starts, 1000, axis=0))
planner = hvf_core.VisualMPC(horizon=50, samples=1000, iterations=30000, min_variance=0.0)
with sigterm_as_interrupt():
    try:
        print("planning", flush=True)
        # Weeks of native work.
        planner.plan_batch(hvf_core.MazeWorld(), start, start)
    except KeyboardInterrupt:
        print("interrupted", flush=True)
"""


@BOTH
def test_either_stops_a_plan_of_the_native_planner(number: signal.Signals) -> None:
    with processes.started(processes.python(PLAN)) as child:
        child.wait_for("planning\n")
        time.sleep(0.3)  # well into the plan, most likely; earlier passes too
        child.tell(number)
        assert child.wait() == 0, child.errors
    assert child.output.endswith("interrupted\n")


@BOTH
def test_either_stops_a_verb_with_status_130(number: signal.Signals, tmp_path: Path) -> None:
    parts = tmp_path / "maze.h5.parts"
    words = ["collect", "maze", "--out", str(tmp_path / "maze.h5"), "--episodes", "100000"]
    with processes.started([*processes.HVF, *words, "--part", "2"]) as child:
        child.wait_until(lambda: bool(list(parts.glob("0*.h5"))))
        child.tell(number)
        assert child.wait() == 130
    assert "the same command goes on from there" in child.errors + child.output
    assert "Traceback" not in child.errors
