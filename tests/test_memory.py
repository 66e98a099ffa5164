"""Memory that is freed and asked for again comes from the process, not from the system."""

from __future__ import annotations

import sys

import pytest

import processes

BLOCKS = """
import resource
from hvf.memory import keep_freed
kept = {keep} and keep_freed()
def faults():
    for _ in range(40):
        blocks = [bytearray(3 * 2**20) for _ in range(8)]
        del blocks
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
first = faults()
print(kept, faults() - first)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc's setting")
def test_freed_blocks_are_kept_where_the_c_library_can() -> None:
    def faults(keep: bool) -> tuple[bool, int]:
        program = processes.python(BLOCKS.format(keep=keep))
        kept, count = processes.run(program, check=True).stdout.split()
        return kept == "True", int(count)

    (_, before), (kept, after) = faults(False), faults(True)
    if not kept:
        pytest.skip("the C library is not glibc")
    # 24 MB are 6,144 pages, asked for 40 times.
    assert after < 100 < before
