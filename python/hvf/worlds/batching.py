"""Candidates in batches that a machine can hold, the same on every machine.

The last bits of what a network computes depend on the size of its batch, on the place in it and on
the number of threads: libraries choose their kernels by these. So a batch has a fixed size, holds
candidates of one problem on a CPU, is computed on one thread, and cores get batches of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from hvf.threads import one_thread

T = TypeVar("T")

Rows = NDArray[np.int64]
"""Numbers of rows, int64 ``[N]``."""


def batches(count: int, most: int, *, few_sizes: bool = False) -> list[Rows]:
    """Rows ``0 .. count - 1`` in batches of one size, the last one filled up with its last row.

    Args:
        count: rows.
        most: rows of a batch, at most.
        few_sizes: take powers of two below ``most``, so that other counts make few other sizes.
    """
    number = -(-count // most)
    size = -(-count // number)
    if few_sizes:
        size = min(most, 1 << (size - 1).bit_length())
    return [
        np.minimum(np.arange(first, first + size), count - 1) for first in range(0, count, size)
    ]


def on_threads(tasks: Sequence[Callable[[], T]], threads: int) -> list[T]:
    """What ``tasks`` return, in order, each computed on one thread without gradients.

    Ctrl-C leaves what has not begun undone.
    """
    with one_thread():
        if min(threads, len(tasks)) < 2:
            return [task() for task in tasks]
        pool = ThreadPoolExecutor(min(threads, len(tasks)), initializer=_alone)
        try:
            return list(pool.map(_without_gradients, tasks))
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _alone() -> None:
    torch.set_num_threads(1)


def _without_gradients(task: Callable[[], T]) -> T:
    with torch.inference_mode():
        return task()


def allocated(run: Callable[[int], object], device: torch.device) -> float:
    """Bytes that a batch takes for each of its rows, from ``run(rows)`` at two sizes.

    On CUDA it is the peak of the allocator. On the CPU, which does not tell, it is the sum of all
    that the operations return, which is two to four times as much as there is at any one time.
    """
    few, many = (_bytes(run, rows, device) for rows in (1, 3))
    return max(1.0, (many - few) / 2)


def _bytes(run: Callable[[int], object], rows: int, device: torch.device) -> int:
    if device.type == "cuda":
        run(rows)  # libraries set up what they keep
        before: int = torch.cuda.memory_allocated(device)
        torch.cuda.reset_peak_memory_stats(device)
        run(rows)
        peak: int = torch.cuda.max_memory_allocated(device)
        return peak - before
    with _Counted() as counted:
        run(rows)
    total: int = counted.bytes
    return total


class _Counted(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Adds up the memory of what operations return, if it is not that of their arguments."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.bytes = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        known = {_storage(leaf) for leaf in tree_leaves((args, kwargs)) if _is_tensor(leaf)}
        for leaf in tree_leaves(result):
            if _is_tensor(leaf) and _storage(leaf) not in known:
                self.bytes += leaf.untyped_storage().nbytes()
        return result


def _is_tensor(leaf: object) -> bool:
    return isinstance(leaf, torch.Tensor)


def _storage(tensor: torch.Tensor) -> int:
    return tensor.untyped_storage().data_ptr()
