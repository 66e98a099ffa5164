"""Image costs beside NumPy, torch and what the machine can read, all in one run.

    python benchmarks/image_cost.py

Medians over interleaved repetitions. "of read" is the rate at which a cost goes through its
input, divided by the read bandwidth: the fastest of several plain reductions over as much memory,
measured in the same run.
"""

from __future__ import annotations

import json
import statistics
import threading
import time
from collections.abc import Callable

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from scipy import ndimage

import hvf_core

PAIRS = 2048
ALL = 256
REPEATS = 9


def seconds(call: Callable[[], object]) -> float:
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


def medians(calls: dict[str, Callable[[], object]]) -> dict[str, float]:
    """Median seconds of each call; the calls take turns, so that they share what the machine
    does besides."""
    for call in calls.values():
        call()
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(REPEATS):
        for name, call in calls.items():
            # The threads of the last library go on spinning for a while, on all cores.
            time.sleep(0.2)
            times[name].append(seconds(call))
    return {name: statistics.median(values) for name, values in times.items()}


def in_threads(call: Callable[[np.ndarray], object], array: np.ndarray) -> None:
    """`call` on equal parts of `array`, one thread per core."""
    parts = np.array_split(array, torch.get_num_threads())
    threads = [threading.Thread(target=call, args=(part,)) for part in parts]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def main() -> None:
    rng = np.random.default_rng(0)
    a, b = (rng.integers(0, 256, (PAIRS, 64, 64, 3), dtype=np.uint8) for _ in range(2))
    af, bf = (x[: PAIRS // 4].astype(np.float32) / np.float32(255) for x in (a, b))
    ta, tb, taf, tbf = (torch.from_numpy(x) for x in (a, b, af, bf))
    pixels = 64 * 64
    words = np.concatenate([a.reshape(-1), b.reshape(-1)]).view(np.float32)

    reading = medians(
        {
            "numpy max": lambda: in_threads(np.max, words.view(np.uint64)),
            "numpy or": lambda: in_threads(np.bitwise_or.reduce, words.view(np.uint64)),
            "torch sum": lambda: torch.from_numpy(words.view(np.int64)).sum(),
        }
    )
    bandwidth = words.nbytes / min(reading.values())

    def numpy_bytes(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        difference = x.astype(np.int32) - y
        return np.einsum("nhwc,nhwc->n", difference, difference) / (255.0**2 * pixels)

    def numpy_floats(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return ((x - y) ** 2).sum((1, 2, 3)) / pixels

    def torch_floats(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return (x - y).square().sum((1, 2, 3)) / pixels

    def numpy_gram(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        x, y = (z.reshape(len(z), -1).astype(np.float32) for z in (x, y))
        norms = (x**2).sum(1)[:, None] + (y**2).sum(1)
        return (norms - 2 * x @ y.T) / (255.0**2 * pixels)

    def torch_cdist(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return torch.cdist(x.flatten(1).float(), y.flatten(1).float()) ** 2 / (255.0**2 * pixels)

    def scipy_blur(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        x, y = (ndimage.gaussian_filter(z, (0, 3, 3, 0)) for z in (x, y))
        return ((x - y) ** 2).sum((1, 2, 3)) / pixels

    few = slice(0, 64)
    cases: list[tuple[str, int | None, dict[str, Callable[[], object]]]] = [
        (
            f"{PAIRS} pairs, uint8",
            a.nbytes + b.nbytes,
            {
                "hvf": lambda: hvf_core.image_cost(a, b),
                "numpy": lambda: numpy_bytes(a, b),
                "torch": lambda: torch_floats(ta.float(), tb.float()) / 255**2,
            },
        ),
        (
            f"{PAIRS // 4} pairs, float32",
            af.nbytes + bf.nbytes,
            {
                "hvf": lambda: hvf_core.image_cost(af, bf),
                "numpy": lambda: numpy_floats(af, bf),
                "torch": lambda: torch_floats(taf, tbf),
            },
        ),
        (
            f"1 to {PAIRS}, uint8",
            b.nbytes,
            {
                "hvf": lambda: hvf_core.image_cost(a[:1], b, "all_pairs"),
                "numpy": lambda: numpy_bytes(a[:1], b),
                "torch": lambda: torch_floats(ta[:1].float(), tb.float()) / 255**2,
            },
        ),
        (
            f"{ALL} x {ALL} all pairs, uint8",
            None,
            {
                "hvf": lambda: hvf_core.image_cost(a[:ALL], b[:ALL], "all_pairs"),
                "numpy": lambda: [numpy_bytes(x[None], b[:ALL]) for x in a[:4]],
                "numpy Gram (BLAS, inexact)": lambda: numpy_gram(a[:ALL], b[:ALL]),
                "torch": lambda: torch_cdist(ta[:ALL], tb[:ALL]),
            },
        ),
        (
            "64 pairs, float32, blur 3",
            None,
            {
                "hvf": lambda: hvf_core.image_cost(af[few], bf[few], blur=3.0),
                "scipy": lambda: scipy_blur(af[few], bf[few]),
            },
        ),
    ]
    found: dict[str, dict[str, float]] = {"read": {"per_second": bandwidth}}
    table = Table(title=f"read bandwidth {bandwidth / 1e9:.1f} GB/s")
    for column in ("case", "what", "ms", "hvf is faster by", "GB/s", "of read"):
        table.add_column(column, justify="left" if column in ("case", "what") else "right")
    for case, nbytes, calls in cases:
        times = medians(calls)
        if "Gram" in "".join(calls):
            times["numpy"] *= ALL / 4  # Four rows were timed.
        found[case] = times
        for name, taken in times.items():
            table.add_row(
                case if name == "hvf" else "",
                name,
                f"{1e3 * taken:.2f}",
                "" if name == "hvf" else f"{taken / times['hvf']:.1f} x",
                f"{nbytes / taken / 1e9:.1f}" if nbytes else "",
                f"{nbytes / taken / bandwidth:.0%}" if nbytes else "",
            )
        table.add_section()
    Console(width=100).print(table)
    print(json.dumps(found))


if __name__ == "__main__":
    main()
