"""What worlds have in common: the images that they take, and the actions of what they wrap."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hvf.settings import OverHorizon


def checked_images(images: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    """Images ``[N, height, width, 3]`` in C order.

    Raises:
        ValueError: images of another size.
        TypeError: images that are not uint8.
    """
    if images.dtype != np.uint8:
        raise TypeError(f"images: must be uint8, got {images.dtype}")
    if images.ndim != 4 or images.shape[1:] != (height, width, 3):
        raise ValueError(
            f"images: expected shape [N, {height}, {width}, 3], got {list(images.shape)}"
        )
    return np.ascontiguousarray(images)


class Around:
    """A world around another one, native or not, whose actions are its own."""

    @property
    def inner(self) -> Any:
        """The world inside."""
        raise NotImplementedError

    @property
    def action_low(self) -> NDArray[np.float32]:
        """Lowest action, float32 `[A]`."""
        low: NDArray[np.float32] = self.inner.action_low
        return low

    @property
    def action_high(self) -> NDArray[np.float32]:
        """Highest action, float32 `[A]`."""
        high: NDArray[np.float32] = self.inner.action_high
        return high


class Measured(Around):
    """A world around another one that predicts for it, with a cost of its own.

    Args:
        world: predicts; has ``observe(images)``.
        over_horizon: whether the last predicted frame counts, their sum, or their minimum.
    """

    def __init__(self, world: Any, over_horizon: OverHorizon) -> None:
        self.world = world
        self.over_horizon = over_horizon

    @property
    def inner(self) -> Any:
        """The world that predicts."""
        return self.world

    def observe(self, images: NDArray[np.uint8]) -> Any:
        """Frames of uint8 `images [N, S, S, 3]`."""
        return self.world.observe(images)
