"""Making frames smaller by the area filter: a new pixel is the mean of what it covers of the old.

The old picture is laid under the grid of the new one, and each old pixel counts by the area that
they share, also where a border goes through it. Sums are of whole numbers and rounded once, halves
up, so that frames are the same on every machine. The shape of the picture is not kept: 64x64 to
48x64 presses it flat, as the paper's BAIR frames are.
"""

from __future__ import annotations

import functools
import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray


def size_of(text: str) -> tuple[int, int]:
    """Height and width of ``"48x64"``.

    Raises:
        ValueError: it is not like that.
    """
    match = re.fullmatch(r"([1-9]\d{0,3})x([1-9]\d{0,3})", text)
    if match is None:
        raise ValueError(f"size: must be height x width, such as 48x64; got {text!r}")
    return int(match[1]), int(match[2])


def area_resized(frames: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Frames uint8 ``[N, H, W, 3]`` in another size, ``[N, *size, 3]``.

    Larger ones are possible too: their pixels lie in one old pixel, or over the border of two.
    """
    if frames.shape[1:3] == size:
        return frames
    axes = [(axis, *_shares(frames.shape[axis], new)) for axis, new in enumerate(size, 1)]
    total = axes[0][3] * axes[1][3]
    summed: NDArray[Any] = frames
    for axis, which, shares, _ in axes:
        if frames.shape[axis] != size[axis - 1]:
            summed = _summed(summed, axis, which, shares.astype(_kind(2 * 256 * total)))
    rounded: NDArray[np.uint8] = ((2 * summed + total) // (2 * total)).astype(np.uint8)
    return rounded


def _summed(
    array: NDArray[Any], axis: int, which: NDArray[np.int64], shares: NDArray[Any]
) -> NDArray[Any]:
    """New pixels along an axis, not yet divided: sums of ``array`` at ``which`` by ``shares``."""
    rest = [1] * array.ndim
    rest[axis] = -1
    parts = (
        np.take(array, which[:, k], axis) * shares[:, k].reshape(rest)
        for k in range(which.shape[1])
    )
    total: NDArray[Any] = next(parts)
    for part in parts:
        total += part
    return total


def _kind(least: int) -> type[np.unsignedinteger[Any]]:
    """Whole numbers that hold ``least``; small ones are quick."""
    if least < 1 << 16:
        return np.uint16
    return np.uint32 if least < 1 << 32 else np.uint64


@functools.cache
def _shares(old: int, new: int) -> tuple[NDArray[np.int64], NDArray[np.int64], int]:
    """Which of ``old`` pixels each of ``new`` covers, and how much of it; both ``[new, K]``.

    In units of which a new pixel is so many as the last number says: shares sum to it.
    """
    common = math.gcd(old, new)
    wide, narrow = old // common, new // common
    # A line of old * new / common units: old pixels have `narrow` of them, new ones `wide`.
    begin = np.arange(new) * wide
    first = begin // narrow
    most = int(((begin + wide - 1) // narrow - first).max()) + 1
    which = first[:, None] + np.arange(most)
    under = which * narrow
    shared = np.minimum(begin[:, None] + wide, under + narrow) - np.maximum(begin[:, None], under)
    return np.minimum(which, old - 1), np.maximum(shared, 0), wide
