"""What every world asks of the images it is given."""

from __future__ import annotations

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
