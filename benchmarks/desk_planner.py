"""Planning at the Franka desk with the shipped models: one MPC step, one search at full budget.

The paper's budget: M = D = 200, 5 x 5 iterations, H = 15 as 5 actions of 3 steps, K = 1 and 2.
Wall time and processor time, which says what cores that others use too would do alone. Medians of
MPC steps; a search is timed once.

    python benchmarks/desk_planner.py
"""

from __future__ import annotations

import json
import os
import statistics
import time
from collections.abc import Callable

import numpy as np
from rich.console import Console

import hvf
import hvf_core
from hvf.envs.desk.pool import DeskPool
from hvf.envs.desk.simulator import DeskSimulator
from hvf.envs.desk.tasks import make_episodes

STEPS = 9


def seconds(work: Callable[[int], object], rounds: int) -> tuple[float, float]:
    """Medians of wall and processor time of calls of ``work``, each with its number."""
    walls, owns = [], []
    for number in range(rounds):
        wall, own = time.perf_counter(), time.process_time()
        work(number)
        walls.append(time.perf_counter() - wall)
        owns.append(time.process_time() - own)
    return statistics.median(walls), statistics.median(owns)


def main() -> None:
    console = Console()
    episodes = make_episodes(DeskSimulator(), "door_two_block", 0, 0, STEPS)
    with DeskPool(1) as pool:
        starts, goals = pool.render(episodes.starts), pool.render(episodes.goals)
        world, generator = hvf.load("desk")
        mpc = hvf_core.VisualMPC(horizon=15, action_repeat=3)

        def step(i: int) -> None:
            mpc.plan(world, starts[i], goals[i], seed=i)

        def search(i: int, subgoals: int) -> None:
            searching = hvf_core.HVF(mpc=mpc, subgoals=subgoals)
            searching.search(world, generator, starts[i], goals[i], seed=i)

        step(0)
        found = {"MPC step": seconds(step, STEPS)}
        for subgoals in (1, 2):
            console.print(f"one search at full budget, K = {subgoals}", style="dim")
            found[f"search, K = {subgoals}"] = seconds(
                lambda i, subgoals=subgoals: search(i, subgoals), 1
            )
    for name, (wall, own) in found.items():
        print(f"{name:16} {wall:9.3f} s   {own:9.3f} s of processor time")
    results = {
        name: {"wall": np.round(w, 4), "own": np.round(o, 4)} for name, (w, o) in found.items()
    }
    print(json.dumps({"threads": os.cpu_count(), "seconds": results}))


if __name__ == "__main__":
    main()
