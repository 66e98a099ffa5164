"""Actions as environments take them: checked once, for all."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Actions: TypeAlias = NDArray[np.float32]


def checked_actions(actions: ArrayLike, shape: tuple[int, ...]) -> Actions:
    """Actions of this shape as float32.

    Raises:
        TypeError: for what is no array of numbers.
        ValueError: for another shape, or NaN or infinite actions.
    """
    try:
        array = np.asarray(actions, dtype=np.float32)
    except (TypeError, ValueError) as error:
        raise TypeError(f"action: expected a float array {list(shape)}, got {actions!r}") from error
    if array.shape != shape:
        raise ValueError(f"action: expected shape {list(shape)}, got {list(array.shape)}")
    if not np.isfinite(array).all():
        raise ValueError(f"action: must be finite, got {array.tolist()}")
    return array
