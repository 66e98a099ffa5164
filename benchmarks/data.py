"""Collecting, storing and loading the maze's episodes: rates and sizes.

python benchmarks/data.py
"""

from __future__ import annotations

import json
import tempfile
import time
from pathlib import Path

from rich.console import Console

from hvf.data.loader import EpisodePool, PairSampler
from hvf.domains.maze_collection import MazeCollection

EPISODES, STEPS, FULL = 400, 100, 10_000


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        path = MazeCollection(Path(folder) / "maze.h5", EPISODES, STEPS).run(Console(quiet=True))
        seconds = time.perf_counter() - began
        size = path.stat().st_size
        found = {"collect": {"per_second": EPISODES / seconds}}
        print(f"collect: {EPISODES / seconds:.0f} episodes/s of {STEPS} steps")
        print(f"         {FULL} episodes: {seconds * FULL / EPISODES:.0f} s", end="")
        print(f", {size * FULL / EPISODES / 1e6:.0f} MB")

        pool = EpisodePool(path)
        began = time.perf_counter()
        pool.move_to(0)
        decoded = len(pool) * (STEPS + 1) / (time.perf_counter() - began)
        found["decode"] = {"per_second": decoded}
        print(f"decode:  {decoded:,.0f} frames/s")
        for name, memory in (("all in memory", 2.0), ("one new episode a step", 0.2)):
            sampler = PairSampler(EpisodePool(path, memory_gb=memory), batch_size=64)
            sampler.batch(0)
            began = time.perf_counter()
            for step in range(1, 101):
                sampler.batch(step)
            rate = 100 * 128 / (time.perf_counter() - began)
            found[f"batches, {name}"] = {"per_second": rate}
            print(f"batches: {rate:,.0f} frames/s, {name}")
        print(json.dumps(found))


if __name__ == "__main__":
    main()
