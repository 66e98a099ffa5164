"""The box that actions lie in: the lowest and the highest action, ``A`` numbers each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Box: TypeAlias = tuple[tuple[float, ...], tuple[float, ...]]


def check_action_box(low: Sequence[float], high: Sequence[float]) -> None:
    """Refuse what is no box.

    Raises:
        ValueError: no dimensions, not as many of one as of the other, or a low that is not below.
    """
    paired = len(low) == len(high) > 0
    if not paired or any(a >= b for a, b in zip(low, high, strict=True)):
        raise ValueError(f"action_low must be below action_high, got {low} and {high}")


def extremes(
    actions: NDArray[np.float32], lengths: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The least and the most that was done, ``[A]`` each.

    Args:
        actions: ``[N, T, A]``; what is after the end of an episode means nothing.
        lengths: steps of each episode, ``[N]``.
    """
    done = actions[np.arange(actions.shape[1]) < lengths[:, None]]
    return done.min(0), done.max(0)


def box_around(least: NDArray[np.float32], most: NDArray[np.float32]) -> Box:
    """The smallest box from ``least`` to ``most``, a little wider where these are the same."""
    still = least == most
    low = np.where(still, least - 1, least)
    high = np.where(still, most + 1, most)
    return tuple(map(float, low)), tuple(map(float, high))
