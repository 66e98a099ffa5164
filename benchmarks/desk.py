"""The Franka desk, per second: agent steps, images, and rollouts for a planner.

Wall time and, for what runs in this process, processor time, which says what a core that others
use too would do alone.

    python benchmarks/desk.py
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable

import numpy as np

from hvf.envs.desk.arrangement import random_arrangement, settled
from hvf.envs.desk.env import DeskEnv
from hvf.envs.desk.pool import DeskPool
from hvf.envs.desk.rendering import DeskRenderer
from hvf.envs.desk.simulator import DeskSimulator

DESKS, STEPS = 25, 20


def rates(count: int, work: Callable[[], object]) -> tuple[float, float]:
    """``count`` things per second of wall time, and of this process's time."""
    work()
    wall, own = time.perf_counter(), time.process_time()
    work()
    return count / (time.perf_counter() - wall), count / (time.process_time() - own)


def report(what: str, wall: float, own: float | None = None) -> None:
    print(f"{what:52} {wall:8.0f} /s" + (f"   {own:8.0f} /s of processor time" if own else ""))
    results[what] = {"per_second": wall, "per_processor_second": own}


results: dict[str, dict[str, float | None]] = {}


def main() -> None:
    rng = np.random.default_rng(0)
    simulator = DeskSimulator()
    states = settled(simulator, [random_arrangement(rng, None) for _ in range(DESKS)])
    actions = rng.uniform(-1, 1, (DESKS, STEPS, 3))
    report(
        f"agent steps, {DESKS} desks side by side, one core",
        *rates(DESKS * STEPS, lambda: simulator.rollout(states, actions)),
    )
    report(
        "agent steps, one desk",
        *rates(STEPS * 5, lambda: [simulator.rollout(states[:1], actions[:1]) for _ in range(5)]),
    )
    for size in (64, 32):
        renderer = DeskRenderer(simulator.model, size)
        report(
            f"images of {size} x {size}, one core",
            *rates(10 * DESKS, lambda: [renderer.render(states) for _ in range(10)]),  # noqa: B023
        )
        renderer.close()
    env = DeskEnv("door")
    env.reset(seed=0)
    report(
        "steps of the Gymnasium environment",
        *rates(100, lambda: [env.step(env.action_space.sample()) for _ in range(100)]),
    )
    env.close()
    with DeskPool() as pool:
        plans = rng.uniform(-1, 1, (200, 15, 3))
        starts = np.repeat(states[:1], 200, axis=0)
        wall, _ = rates(200, lambda: pool.rollout(starts, plans))
        report(f"rollouts of 15 steps with last image, {pool.workers} processes", wall)
    print(json.dumps(results))


if __name__ == "__main__":
    main()
