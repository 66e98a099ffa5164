"""Goals as goal-conditioned learners give them back: many at once, checked."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Goals = NDArray[np.float64]


def checked_goals(achieved: ArrayLike, desired: ArrayLike, size: int) -> tuple[Goals, Goals]:
    """Both goals as float64 ``[..., size]``, of one shape.

    Raises:
        ValueError: for other shapes, or numbers that are not finite.
    """
    found = []
    for name, value in (("achieved_goal", achieved), ("desired_goal", desired)):
        try:
            array = np.asarray(value, np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{name}: expected numbers [..., {size}]") from error
        if array.ndim < 1 or array.shape[-1] != size:
            raise ValueError(f"{name}: expected shape [..., {size}], got {list(array.shape)}")
        if not np.isfinite(array).all():
            raise ValueError(f"{name}: must be finite")
        found.append(array)
    first, second = found
    if first.shape != second.shape:
        raise ValueError(
            f"desired_goal: expected shape {list(first.shape)} as achieved_goal, "
            f"got {list(second.shape)}"
        )
    return first, second
