"""Call everything in ``hvf_core`` with nonsense for as long as you like.

    python tests/fuzz_border.py --calls 1000000 --seed 0

The calls are those of ``test_border.py`` (``nonsense.py``), in processes of their own that have a
deadline and a limit of memory: a panic, an abort, a hang or a process that grows is seen and said,
with the call that did it. Needs Linux (memory is read from ``/proc``).
"""

from __future__ import annotations

import argparse
import faulthandler
import gc
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

MEMORY = 6 << 30
"""Bytes of address space that a child may have."""
PART = 2_500
"""Calls of one child."""
BATCH = 500
"""Calls between two looks at memory; what Hypothesis remembers of them is then forgotten."""
SECONDS = 60
"""A call that takes longer hangs."""


def child(calls: int, first_seed: int, note: Path) -> None:
    """Make ``calls`` calls; print how many and by how many bytes the process grew."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    import nonsense

    # A hang ends the child, which says where it was.
    sizes: list[int] = []
    made = returned = 0
    with note.open("w+b", buffering=0) as last:

        def batch(number: int, size: int) -> None:
            @seed(number)
            @settings(
                max_examples=size,
                database=None,
                deadline=None,
                phases=[Phase.generate],
                suppress_health_check=list(HealthCheck),
            )
            @given(st.data())
            def run(data: st.DataObject) -> None:
                nonlocal made, returned
                name, call = nonsense.any_call(data.draw)
                last.seek(0)
                last.write(f"{number}: {name}".ljust(200).encode(errors="replace"))
                faulthandler.dump_traceback_later(SECONDS, exit=True)
                try:
                    returned += nonsense.make(name, call)
                except AssertionError:
                    # At once: Hypothesis would make the call again, and print what is in it.
                    traceback.print_exc()
                    sys.stderr.flush()
                    os._exit(1)
                faulthandler.cancel_dump_traceback_later()
                made += 1

            run()

        number = first_seed
        while made < calls:
            batch(number, min(BATCH, calls - made))
            number += 1
            gc.collect()
            sizes.append(resident())
    # The first batches load what is loaded once.
    settled = sizes[min(len(sizes) - 1, len(sizes) // 4)]
    said = {"calls": made, "returned": returned, "grown": sizes[-1] - settled, "size": sizes[-1]}
    print(json.dumps(said))


def resident() -> int:
    """Bytes of memory that this process holds."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def main() -> int:
    """Run children one after the other until all calls are made or something is wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--calls", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        child(options.calls, options.seed, options.child)
        return 0
    made, returned, grown, begun = 0, 0, [], time.monotonic()
    note = Path(tempfile.gettempdir()) / f"fuzz_border.{os.getpid()}"
    first_seed = options.seed * 1_000_000_000
    while made < options.calls:
        part = min(PART, options.calls - made)
        words = [sys.executable, __file__, "--child", str(note)]
        words += ["--calls", str(part), "--seed", str(first_seed + made)]
        done = subprocess.run(words, capture_output=True, text=True)
        if done.returncode:
            print(f"after {made} calls: status {done.returncode} in {note.read_text().strip()}")
            print(done.stderr[-6000:])
            return 1
        said = json.loads(done.stdout.splitlines()[-1])
        made += said["calls"]
        returned += said["returned"]
        grown.append(said["grown"])
        seconds = time.monotonic() - begun
        print(
            f"{made} calls ({returned / made:.0%} returned), {made / seconds:.0f} a second; this "
            f"process grew by {said['grown'] / 2**20:.1f} MiB to {said['size'] / 2**20:.0f} MiB",
            flush=True,
        )
    note.unlink(missing_ok=True)
    print(f"{made} calls: no panic, no abort, no hang; most growth {max(grown) / 2**20:.1f} MiB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
