"""What proposals by a network are worth to the search for subgoals at the desk, and what they cost.

By the search's own objective (nats of the hardest segment, lower is better) on validation episodes,
without acting: the best of 128 draws of the prior and of the proposals, and what a search with the
default settings finds from either. Medians and means over the episodes, and the median processor
time; the plans along what was found, which a search makes at its end, are left out.

    python benchmarks/desk_proposals.py --episodes 20
"""

from __future__ import annotations

import argparse
import dataclasses
import time

import numpy as np

import hvf
from hvf.agents.frames import observed
from hvf.data.splits import EPISODE_SEEDS
from hvf.domains.desk import DESK
from hvf.worlds.load import load_asked

TASKS = {"two_block": 1, "door_block": 1, "door_two_block": 2}
DRAWN = {"subgoal_samples": 128, "subgoal_elites": 2, "subgoal_iterations": 1}
# Plans along what is found are no part of what is measured.
UNPLANNED = {"samples": 2, "elites": 1, "iterations": 1, "keep_elites": 0}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--episodes", type=int, default=20)
    episodes = parser.parse_args().episodes
    preset = DESK.preset("default")
    world, generator = hvf.load("desk", "default")
    _, trained = load_asked(DESK, preset.world, "layers-proposals")
    proposing = trained.of(generator)
    whole = dataclasses.replace(preset.planning, **UNPLANNED)
    few = dataclasses.replace(whole, **DRAWN)
    ways = {
        "128 draws of the prior": (few, generator),
        "128 proposals": (few, proposing),
        "search from the prior": (whole, generator),
        "search from proposals": (whole, proposing),
    }
    print(f"| {episodes} episodes each | median | mean | ms |\n|---|---:|---:|---:|")
    with DESK.open(1) as place:
        for task, subgoals in TASKS.items():
            trials = place.trials(task, EPISODE_SEEDS["validation"], 0, episodes)
            starts = observed(world, trials.observe(np.arange(episodes)))
            goals = observed(world, trials.goals)
            for name, (planning, draws) in ways.items():
                costs, seconds = [], []
                search = planning.search(subgoals)
                for i in range(episodes):
                    one = np.array([i])
                    begin = time.process_time()
                    found = search.search(world, draws, starts[one], goals[one], seed=i)
                    seconds.append(time.process_time() - begin)
                    costs.append(found.cost)
                median, mean, took = np.median(costs), np.mean(costs), 1e3 * np.median(seconds)
                print(f"| {task}: {name} | {median:.1f} | {mean:.1f} | {took:.0f} |", flush=True)


if __name__ == "__main__":
    main()
