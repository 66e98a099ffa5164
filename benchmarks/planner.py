"""Planning in the maze with learned models and with the true simulator: one step, one search.

The paper's full budget (K = 2, M = D = 200, 5 x 5 iterations, H = 5) and how the time of a search
with learned models grows with M, D, K and H; how many calls of the model and rollouts it takes,
with pruning and without. Medians.

    python benchmarks/planner.py
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

import hvf
import hvf_core

ROUNDS = 3
STEPS = 15


def seconds(work: Callable[[int], object], rounds: int) -> float:
    """Median over ``rounds`` calls, each with its number, after one more to warm up."""
    work(rounds)
    times = []
    for number in range(rounds):
        begin = time.perf_counter()
        work(number)
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


class Counted:
    """A world that counts its calls and rollouts."""

    def __init__(self, world: Any) -> None:
        self.world = world
        self.action_low, self.action_high = world.action_low, world.action_high
        self.calls = self.rollouts = 0

    def rollout_costs(self, starts: Any, goals: Any, actions: NDArray[np.float32]) -> Any:
        """Score candidates, ``[B, D]``."""
        self.calls += 1
        self.rollouts += actions.shape[0] * actions.shape[1]
        return self.world.rollout_costs(starts, goals, actions)

    def shared_rollout_costs(self, start: Any, goals: Any, actions: NDArray[np.float32]) -> Any:
        """Score candidates that all goals share; the time is that of scoring each anew."""
        self.calls += 1
        self.rollouts += len(actions)
        everywhere = np.zeros(len(goals), np.int64)
        return self.world.rollout_costs(
            start[everywhere], goals, np.repeat(actions[None], len(goals), axis=0)
        )


def work_of_a_search(world: Any, ends: list[tuple[Any, Any]], prune: bool) -> dict[str, float]:
    """Median calls and rollouts of full-budget searches between ``ends``."""
    generator = hvf.load("maze", dynamics="keypoint")[1]
    search = hvf_core.HVF(mpc=hvf_core.VisualMPC(horizon=5), prune=prune)
    calls, rollouts = [], []
    for number, (start, goal) in enumerate(ends):
        counted = Counted(world)
        frames = [world.observe(image[None]) for image in (start, goal)]
        search.search(counted, generator, *frames, seed=number)
        calls.append(counted.calls)
        rollouts.append(counted.rollouts)
    return {"calls": statistics.median(calls), "rollouts": statistics.median(rollouts)}


def main() -> None:
    states, targets = hvf_core.maze_episodes(0, 0, STEPS + 1, "hard")
    starts = hvf_core.maze_render(states)
    goals = hvf_core.maze_render(np.hstack([targets, states[:, 2:]]))
    found: dict[str, float] = {}
    for model in ("keypoint", "simulator"):
        world, generator = hvf.load("maze", dynamics=model)

        def step(i: int, horizon: int = 5, world: object = world) -> None:
            mpc = hvf_core.VisualMPC(horizon=horizon)
            mpc.plan(world, starts[i % len(starts)], goals[i % len(goals)], seed=i)

        def search(
            i: int,
            samples: int = 200,
            candidates: int = 200,
            subgoals: int = 2,
            horizon: int = 5,
            world: object = world,
            generator: object = generator,
        ) -> None:
            mpc = hvf_core.VisualMPC(horizon=horizon, samples=candidates, elites=candidates // 5)
            search = hvf_core.HVF(mpc=mpc, subgoals=subgoals, samples=samples, elites=samples // 5)
            search.search(world, generator, starts[i], goals[i], seed=i)

        found[f"{model}: MPC step"] = seconds(step, STEPS)
        found[f"{model}: search"] = seconds(search, ROUNDS)
        if model == "keypoint":
            for name, values in (
                ("samples", (100, 400)),
                ("candidates", (100, 400)),
                ("subgoals", (1, 3)),
                ("horizon", (3, 10)),
            ):
                for value in values:
                    found[f"{model}: search, {name} {value}"] = seconds(
                        lambda i, name=name, value=value: search(i, **{name: value}), 1
                    )
    for name, median in found.items():
        print(f"{name:32} {1e3 * median:10.1f} ms")
    world, _ = hvf.load("maze", dynamics="keypoint")
    ends = list(zip(starts[:ROUNDS], goals[:ROUNDS], strict=True))
    for name, prune in (("pruning", True), ("no pruning", False)):
        for what, count in work_of_a_search(world, ends, prune).items():
            found[f"keypoint: search, {name}: {what}"] = count
            print(f"search, {name}: {count:,.0f} {what}")
    print(json.dumps(found))


if __name__ == "__main__":
    main()
