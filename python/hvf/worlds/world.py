"""What worlds have in common: the images that they take, and the actions of what they wrap."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


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
