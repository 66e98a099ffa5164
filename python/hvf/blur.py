"""The Gaussian blur through which frames are compared, as a matrix."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


def blur_matrix(n: int, sigma: float) -> NDArray[np.float64]:
    """A Gaussian blur of ``n`` pixels in a row as a matrix ``[n, n]``: ``out = matrix @ row``.

    The kernel ends at four standard deviations, and the row is continued by reflection about the
    edges of its last pixels (``d c b a | a b c d | d c b a``): SciPy's defaults.
    """
    radius = int(4 * sigma + 0.5)
    taps = np.arange(-radius, radius + 1)
    weights = np.array([math.exp(-0.5 * (tap / sigma) ** 2) for tap in taps])
    weights /= weights.sum()
    folded = (np.arange(n)[:, None] + taps) % (2 * n)
    sources = np.where(folded < n, folded, 2 * n - 1 - folded)
    matrix = np.zeros((n, n))
    np.add.at(matrix, (np.arange(n)[:, None].repeat(len(taps), 1), sources), weights)
    return matrix
