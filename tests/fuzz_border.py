"""Call everything in ``hvf_core`` with nonsense for as long as you like.

    python tests/fuzz_border.py --calls 1000000
    python tests/fuzz_border.py --calls 1 --first 123456  # this one again

The calls are those of ``test_border.py`` (``border_calls.py``), each made of the random numbers
that its number is the seed of, in processes that have a deadline and a limit of memory: a panic, an
abort, a hang or a process that grows is seen and said, with the call that did it. Needs Linux
(memory is read from ``/proc``).
"""

from __future__ import annotations

import argparse
import faulthandler
import gc
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

MEMORY = 6 << 30
"""Bytes of address space that a child may have."""
PART = 50_000
"""Calls of one child."""
LOOK = 1_000
"""Calls between two looks at memory."""
GROWTH = 32 << 20
"""Bytes that a child may grow by after its first quarter."""
SECONDS = 60
"""A call that is still the same after a second look hangs."""


def child(calls: int, first: int, note: Path) -> None:
    """Make ``calls`` calls; print how many returned and by how many bytes the process grew."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    faulthandler.enable()
    from border_calls import any_call, make

    sizes: list[int] = []
    returned = 0
    with note.open("w+b", buffering=0) as last:
        for made, number in enumerate(range(first, first + calls)):
            if made % LOOK == 0:
                gc.collect()
                sizes.append(resident())
            draw = random.Random(number).random
            call = any_call(lambda n, draw=draw: int(draw() * n))
            os.pwrite(last.fileno(), f"{number}: {call.name}".ljust(80).encode(), 0)
            returned += make(call)
    # The first calls load what is loaded once.
    grown = sizes[-1] - sizes[len(sizes) // 4]
    print(json.dumps({"returned": returned, "grown": grown, "size": sizes[-1]}))


def resident() -> int:
    """Bytes of memory that this process holds."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def watched(words: list[str], note: Path) -> subprocess.CompletedProcess[str]:
    """Run a child; if it hangs, say what its threads do, and end it."""
    last = ""
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as run:
        while True:
            try:
                output, errors = run.communicate(timeout=SECONDS)
                return subprocess.CompletedProcess(words, run.returncode, output, errors)
            except subprocess.TimeoutExpired:
                now = note.read_text()
                if now == last:
                    for thread in Path(f"/proc/{run.pid}/task").iterdir():
                        # R is running or waiting for a processor, S waiting for another thread.
                        state = (thread / "stat").read_text().rpartition(")")[2].split()
                        print(f"thread {thread.name}: {state[0]}, {state[11]} ticks of processor")
                    run.send_signal(signal.SIGABRT)
                last = now


def main() -> int:
    """Run children one after the other until all calls are made or something is wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--calls", type=int, default=1_000_000)
    parser.add_argument("--first", type=int, default=0, help="number of the first call")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        child(options.calls, options.first, options.child)
        return 0
    made, returned, grown, begun = 0, 0, 0, time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        note = Path(folder) / "call"
        while made < options.calls:
            part = min(PART, options.calls - made)
            words = [sys.executable, __file__, "--child", str(note)]
            words += ["--calls", str(part), "--first", str(options.first + made)]
            note.write_text(f"{options.first + made}: none yet")
            done = watched(words, note)
            if done.returncode:
                print(f"status {done.returncode} in call {note.read_text().strip()}")
                print(done.stderr[-6000:])
                return 1
            said = json.loads(done.stdout.splitlines()[-1])
            made += part
            returned += said["returned"]
            grown = max(grown, said["grown"])
            rate = made / (time.monotonic() - begun)
            print(
                f"{made} calls ({returned / made:.0%} returned), {rate:.0f} a second; this process "
                f"grew by {said['grown'] / 2**20:.1f} MiB to {said['size'] / 2**20:.0f} MiB",
                flush=True,
            )
            if said["grown"] > GROWTH:
                return 1
    print(f"{made} calls: no panic, no abort, no hang; most growth {grown / 2**20:.1f} MiB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
