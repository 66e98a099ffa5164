"""Settings of all tests, and programs that run beside them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable

import pytest
from hypothesis import settings

# No test depends on how fast, or how busy, the machine is.
settings.register_profile("hvf", deadline=None)
settings.load_profile("hvf")


@pytest.fixture
def outputs_by_threads() -> Callable[[str], set[str]]:
    """What a program prints with one thread and with two: one string if they agree."""

    def run(program: str) -> set[str]:
        return {
            subprocess.run(
                [sys.executable, "-c", program],
                env={**os.environ, "RAYON_NUM_THREADS": threads},
                capture_output=True,
                text=True,
                check=True,
            ).stdout
            for threads in ("1", "2")
        }

    return run


@pytest.fixture
def interrupted_output() -> Callable[[str], str]:
    """What a program prints when Ctrl-C comes soon after it has printed ``planning``."""

    def run(program: str) -> str:
        child = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
        assert child.stdout is not None
        with child:
            assert child.stdout.readline() == "planning\n"
            time.sleep(0.3)  # well into the plan, most likely; earlier passes too
            child.send_signal(signal.SIGINT)
            output, _ = child.communicate(timeout=60)
        assert child.returncode == 0
        return output

    return run
