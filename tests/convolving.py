"""A convolution, one number at a time: what layers are compared with."""

from __future__ import annotations

import numpy as np


def slow_convolution(
    x: np.ndarray, weight: np.ndarray, bias: np.ndarray, stride: int = 1
) -> np.ndarray:
    """``x [C, H, W]`` padded by zeros to its own size; weights ``[O, C, k, k]``, k odd.

    Every ``stride``-th row and column of that is kept.
    """
    side = weight.shape[2]
    padded = np.pad(x, ((0, 0), (side // 2,) * 2, (side // 2,) * 2))
    out = np.empty((len(weight), -(-x.shape[1] // stride), -(-x.shape[2] // stride)))
    for o in range(len(weight)):
        for row in range(out.shape[1]):
            for column in range(out.shape[2]):
                top, left = row * stride, column * stride
                patch = padded[:, top : top + side, left : left + side]
                out[o, row, column] = (patch * weight[o]).sum() + bias[o]
    return out
