"""Planning at the Franka desk with the shipped models: one step, one search for subgoals.

With our own settings (``default``: the nearest frame of 1,000 candidates, subgoals by likelihood)
and the paper's (``paper``: M = D = 200, 5 x 5 iterations, every segment planned), H = 15 as 5
actions of 3 steps. Wall time and processor time, which says what cores that others use too would
do alone. Medians; a search that plans every segment is timed once.

    python benchmarks/desk_planner.py
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable

import hvf
from hvf.domains.desk import DESK
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
    episodes = make_episodes(DeskSimulator(), "door_two_block", 0, 0, STEPS)
    with DeskPool(1) as pool:
        starts, goals = pool.render(episodes.starts), pool.render(episodes.goals)
    found: dict[str, dict[str, float]] = {}
    for preset in ("default", "paper"):
        world, generator = hvf.load("desk", preset)
        planning = DESK.preset(preset).planning
        mpc, rounds = planning.mpc, STEPS if planning.segment_cost == "likelihood" else 1

        def step(i: int, mpc: hvf.VisualMPC = mpc, world: object = world) -> None:
            mpc.plan(world, starts[i], goals[i], seed=i)

        calls: dict[str, tuple[Callable[[int], object], int]] = {"MPC step": (step, STEPS)}
        for subgoals in (1, 2):
            searching = planning.search(subgoals)

            def search(i: int, searching: hvf.HVF = searching, world: object = world) -> None:
                searching.search(world, generator, starts[i], goals[i], seed=i)  # noqa: B023

            calls[f"search, K = {subgoals}"] = (search, rounds)
        step(0)
        for name, (work, times) in calls.items():
            wall, own = seconds(work, times)
            print(f"{preset}: {name:14} {wall:9.3f} s   {own:9.3f} s of processor time", flush=True)
            found[f"{preset}: {name}"] = {"wall": round(wall, 4), "processor": round(own, 4)}
    print(json.dumps(found))


if __name__ == "__main__":
    main()
