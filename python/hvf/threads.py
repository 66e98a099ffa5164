"""Perception on one thread, so that the last bits of what is seen do not depend on the machine.

Torch cuts sums by the number of its threads. Plans are the same on any number of threads
everywhere else; here one thread is also the fastest for the few images of a step.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """In this block torch computes on one CPU thread, and without gradients."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.inference_mode():
            yield
    finally:
        torch.set_num_threads(before)
