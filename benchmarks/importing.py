"""How fast BAIR's records are imported: sequences a second of one core's time.

Synthetic records of noise, as the tests write them; the best of several rounds, by the processor's
clock, since the wall's has the disk in it: a sequence of two cameras is 0.74 MB, read once and
written twice (parts, and the whole).

    TMPDIR=/dev/shm python benchmarks/importing.py
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from rich.console import Console

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import recordings
from hvf.data.importing.bair import BairImport, BairSource

DISTINCT, COUNT, ROUNDS = 8, 64, 7


def main() -> None:
    """Print a table."""
    found: dict[str, dict[str, float]] = {}

    def tell(what: str, work: Callable[[], object]) -> None:
        took = []
        for _ in range(ROUNDS):
            begin = time.process_time()
            work()
            took.append(time.process_time() - begin)
        found[what] = {"per_processor_second": COUNT / min(took)}
        print(f"{what:32} {COUNT / min(took):6.0f} sequences a core second", flush=True)

    some = [recordings.bair_record(recordings.bair_episode(seed)) for seed in range(DISTINCT)]
    console = Console(quiet=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        block = recordings.tfrecords(some)
        file = recordings.write(folder / "noise.tfrecords", block * (COUNT // DISTINCT))
        print(f"{COUNT} sequences of 30 frames, {file.stat().st_size / 1e6:.0f} MB")
        for cameras in (("main", "aux1"), ("main",)):
            seen = " and ".join(cameras)
            source = BairSource([file], cameras)
            tell(f"read and checked, {seen}", lambda s=source: [s.read(i) for i in range(COUNT)])
            for size in (None, "48x64"):
                out = folder / "out.h5"
                config = BairImport(path=file, out=out, cameras=cameras, size=size, overwrite=True)
                tell(f"imported, {seen}, {size or '64x64'}", lambda c=config: c.run(console))
    print(json.dumps(found))


if __name__ == "__main__":
    main()
