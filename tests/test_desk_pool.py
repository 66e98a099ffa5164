"""Processes of the desk: signals, and how they end."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import processes

pytest.importorskip("mujoco", reason="MuJoCo 4 needs Python 3.11")

PROGRAM = """
import sys, time
from hvf.envs.desk.pool import DeskPool

def nap(worker, seconds):
    print("at work", flush=True)
    time.sleep(seconds)

if __name__ == "__main__":
    with DeskPool(2, 8) as pool:
        waiting = [pool.submit(nap, float(sys.argv[1])) for _ in range(3)]
        print([part.result() for part in waiting], flush=True)
"""


@pytest.fixture
def at_work(tmp_path: Path) -> Any:
    """A program with two processes and three naps; ``starting``: they are still importing."""
    path = tmp_path / "pool.py"
    path.write_text(PROGRAM)

    @contextlib.contextmanager
    def start(seconds: float, starting: bool = False) -> Iterator[processes.Child]:
        with processes.started([sys.executable, str(path), str(seconds)], deadline=120) as child:
            if starting:
                child.wait_until(lambda: len(spawned(child)) == 2)
            else:
                child.wait_until(lambda: child.output.count("at work") >= 2)
            yield child

    return start


def spawned(child: processes.Child) -> list[int]:
    """The processes of its pool."""
    found = []
    for one in processes.members(child.pid):
        with contextlib.suppress(OSError):
            if b"spawn_main" in Path(f"/proc/{one}/cmdline").read_bytes():
                found.append(one)
    return found


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
@pytest.mark.parametrize("starting", [True, False])
def test_they_end_when_the_one_that_made_them_is_gone(
    at_work: Any, number: signal.Signals, starting: bool
) -> None:
    with at_work(600, starting) as child:
        child.tell_it_alone(number)
        child.wait_until_gone()  # long before their naps are over
    # One that is still being set up says that nobody sets it up any more.
    assert starting or "Traceback" not in child.errors


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("starting", [True, False])
def test_they_leave_signals_to_the_one_that_made_them(
    at_work: Any, number: signal.Signals, starting: bool
) -> None:
    with at_work(1, starting) as child:
        for process in spawned(child):
            os.kill(process, number)
        assert child.wait() == 0, child.errors
    assert child.output.endswith("[None, None, None]\n")
    assert child.errors == ""


def test_one_that_is_killed_breaks_the_pool_at_once(at_work: Any) -> None:
    with at_work(600) as child:
        os.kill(spawned(child)[-1], signal.SIGKILL)
        assert child.wait() == 1
        assert child.gone()
    assert "BrokenProcessPool" in child.errors
