"""Freed memory stays with the process.

Torch asks for new memory for whatever an operation gives. The C library of Linux hands blocks of
some megabytes back to the system as soon as they are free, and gets them anew, page by page and
filled with zeros, for the next operation: at the images of a plan (64 at a time) that takes a third
of the time.
"""

from __future__ import annotations

import ctypes
import sys

# Of glibc's malloc.h, and what it takes at most for the second.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_LARGEST_KEPT = 32 * 2**20
_KEPT = 2**30


def keep_freed() -> bool:
    """Keep up to a gigabyte of freed memory, in blocks of up to 32 MB; returns whether it can.

    For the whole process, so for programs and not for libraries to call. Nothing happens without
    glibc.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    # Either one alone would end that the other adapts itself.
    limits = ((_MMAP_THRESHOLD, _LARGEST_KEPT), (_TRIM_THRESHOLD, _KEPT))
    return all(mallopt(name, limit) == 1 for name, limit in limits)
