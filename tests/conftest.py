"""Settings of all tests, and programs that run beside them."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator

import pytest
from hypothesis import settings

import processes

# No test depends on how fast, or how busy, the machine is.
settings.register_profile("hvf", deadline=None)
settings.load_profile("hvf")


@pytest.fixture(scope="session", autouse=True)
def signals() -> Iterator[None]:
    """Ctrl-C reaches the tests that send it to themselves, also in a job in the background."""
    with processes.default_signals():
        yield


@pytest.fixture
def outputs_by_threads() -> Callable[[str], set[str]]:
    """What a program prints with one thread and with two: one string if they agree."""

    def run(program: str) -> set[str]:
        return {
            processes.run(
                processes.python(program), env={"RAYON_NUM_THREADS": threads}, check=True
            ).stdout
            for threads in ("1", "2")
        }

    return run


@pytest.fixture
def interrupted_output() -> Callable[[str], str]:
    """What a program prints when Ctrl-C comes soon after it has printed ``planning``."""

    def run(program: str) -> str:
        with processes.started(processes.python(program)) as child:
            child.wait_for("planning\n")
            time.sleep(0.3)  # well into the plan, most likely; earlier passes too
            child.tell(signal.SIGINT)
            assert child.wait() == 0, child.errors
        return child.output

    return run
