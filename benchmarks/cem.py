"""The cross-entropy method's own work: this library's, a batched torch CEM and a NumPy CEM.

Sampling, selection and refit for 600 problems of 200 candidates in 10 dimensions (a search's three
segments of 200 samples, 5 steps of 2 action dimensions), 5 iterations, with costs that are ready
beforehand. All three are called from Python in turn, in one run; medians.

    python benchmarks/cem.py
"""

from __future__ import annotations

import json
import os
import statistics
import time
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

import hvf_core

PROBLEMS, SAMPLES, ELITES, ITERATIONS = 600, 200, 40, 5
HORIZON, ACTION_DIM = 5, 2
DIMENSIONS = HORIZON * ACTION_DIM
ROUNDS = 15

COSTS = np.random.default_rng(0).random((PROBLEMS, SAMPLES), dtype=np.float32)
FRAMES = np.zeros((PROBLEMS, 1), np.float32)


class Free:
    """A world whose costs are ready beforehand."""

    action_low = np.full(ACTION_DIM, -3, np.float32)
    action_high = np.full(ACTION_DIM, 3, np.float32)
    max_candidates = PROBLEMS * SAMPLES

    def rollout_costs(
        self, starts: object, goals: object, actions: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        return COSTS


def hvf_cem() -> None:
    mpc = hvf_core.VisualMPC(
        horizon=HORIZON,
        samples=SAMPLES,
        elites=ELITES,
        iterations=ITERATIONS,
        min_variance=0.0,
    )
    mpc.plan_batch(Free(), FRAMES, FRAMES)


def torch_cem() -> None:
    costs = torch.from_numpy(COSTS)
    shape = (PROBLEMS, SAMPLES, DIMENSIONS)
    candidates = torch.empty(shape).uniform_(-3, 3)
    for left in reversed(range(ITERATIONS)):
        best = costs.topk(ELITES, dim=1, largest=False).indices
        elites = candidates.gather(1, best[:, :, None].expand(-1, -1, DIMENSIONS))
        std, mean = torch.std_mean(elites, dim=1, correction=0)
        if left:
            candidates = (mean[:, None] + std[:, None] * torch.randn(shape)).clamp_(-3, 3)


def numpy_cem() -> None:
    rng = np.random.default_rng(0)
    shape = (PROBLEMS, SAMPLES, DIMENSIONS)
    candidates = rng.random(shape, dtype=np.float32) * 6 - 3
    for left in reversed(range(ITERATIONS)):
        best = np.argpartition(COSTS, ELITES, axis=1)[:, :ELITES]
        elites = np.take_along_axis(candidates, best[:, :, None], axis=1)
        mean, std = elites.mean(axis=1), elites.std(axis=1)
        if left:
            normals = rng.standard_normal(shape, dtype=np.float32)
            candidates = np.clip(mean[:, None] + std[:, None] * normals, -3, 3)


def main() -> None:
    contestants: dict[str, Callable[[], None]] = {
        "hvf": hvf_cem,
        "torch": torch_cem,
        "numpy": numpy_cem,
    }
    seconds: dict[str, list[float]] = {name: [] for name in contestants}
    with torch.inference_mode():
        for round_ in range(ROUNDS + 2):
            for name, run in contestants.items():
                begin = time.perf_counter()
                run()
                if round_ >= 2:
                    seconds[name].append(time.perf_counter() - begin)
    candidates = PROBLEMS * SAMPLES * ITERATIONS
    rates = {name: candidates / statistics.median(times) for name, times in seconds.items()}
    print(
        f"{PROBLEMS} problems x {SAMPLES} samples x {DIMENSIONS} dimensions, {os.cpu_count()} cores"
    )
    for name, rate in rates.items():
        print(f"{name:>6}: {rate / 1e6:6.1f} million candidates/s, hvf x {rates['hvf'] / rate:.1f}")
    print(json.dumps({name: {"per_second": round(rate)} for name, rate in rates.items()}))


if __name__ == "__main__":
    main()
