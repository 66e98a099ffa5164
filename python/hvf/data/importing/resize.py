"""Making frames smaller by the area filter: a new pixel is the mean of what it covers of the old.

The old picture is laid under the grid of the new one, and each old pixel counts by the area that
they share, also where a border goes through it. Sums are of whole numbers and rounded once, halves
up, so that frames are the same on every machine. The shape of the picture is not kept: 64x64 to
48x64 presses it flat, as the paper's BAIR frames are.
"""

from __future__ import annotations

import functools
import re

import numpy as np
from numpy.typing import NDArray

# Whole numbers below this are exact in float32.
_EXACT = 1 << 24


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
    old = frames.shape[1:3]
    if tuple(old) == size:
        return frames
    count, channels = len(frames), frames.shape[3]
    rows, columns = _shares(old[0], size[0]), _shares(old[1], size[1])
    total = old[0] * old[1]
    kind = np.float32 if 255 * total < _EXACT else np.float64
    # [h, H] x [N, H, W * 3], then the same for columns.
    tall = rows.astype(kind) @ frames.reshape(count, old[0], -1).astype(kind)
    wide = tall.reshape(count, size[0], old[1], channels)
    summed = np.einsum("nhwc,vw->nhvc", wide, columns.astype(kind), optimize=True)
    whole = summed.astype(np.int64)
    rounded: NDArray[np.uint8] = ((2 * whole + total) // (2 * total)).astype(np.uint8)
    return rounded


@functools.cache
def _shares(old: int, new: int) -> NDArray[np.int64]:
    """What each of ``new`` pixels covers of each of ``old``, ``[new, old]``; rows sum to ``old``.

    A line of ``old * new`` units: old pixels have ``new`` of them, new ones ``old``.
    """
    begin = np.arange(new)[:, None] * old
    under = np.arange(old)[None, :] * new
    shared = np.minimum(begin + old, under + new) - np.maximum(begin, under)
    shares: NDArray[np.int64] = np.maximum(shared, 0)
    return shares
