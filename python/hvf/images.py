"""Images as files: read, written, and many laid out in one."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hvf.files import replacing

_BORDER = 2


def frame_grid(
    rows: Sequence[NDArray[np.uint8]], *, zoom: int = 1, border: int = _BORDER
) -> NDArray[np.uint8]:
    """Lay frames out in rows on white.

    Args:
        rows: one array ``[N, height, width, 3]`` per row, all frames of one size.
        zoom: how many pixels a pixel becomes on each side.
        border: white pixels around every frame.

    Returns:
        One image, uint8 ``[rows * ..., columns * ..., 3]``.

    Raises:
        ValueError: no rows, or frames that are not uint8 RGB of one size.
    """
    if not rows:
        raise ValueError("rows must not be empty")
    height, width = rows[0].shape[1:3]
    for row in rows:
        if row.dtype != np.uint8 or row.ndim != 4 or row.shape[1:] != (height, width, 3):
            raise ValueError(
                f"rows must be uint8 [N, {height}, {width}, 3], got {row.dtype} {row.shape}"
            )
    cell_height, cell_width = height * zoom + border, width * zoom + border
    columns = max(len(row) for row in rows)
    grid = np.full(
        (len(rows) * cell_height + border, columns * cell_width + border, 3), 255, np.uint8
    )
    for i, row in enumerate(rows):
        for j, frame in enumerate(row):
            y, x = border + i * cell_height, border + j * cell_width
            grid[y : y + height * zoom, x : x + width * zoom] = frame.repeat(zoom, 0).repeat(
                zoom, 1
            )
    return grid


def write_png(path: str | Path, image: NDArray[np.uint8]) -> None:
    """Write an image, uint8 ``[height, width, 3]``, as PNG, whole or not at all.

    Raises:
        OSError: the file cannot be written; names ``path``.
    """
    with replacing(path) as temporary:
        Image.fromarray(image).save(temporary, format="png")


def read_image(argument: str, path: str | Path) -> NDArray[np.uint8]:
    """Read an image file as RGB, uint8 ``[height, width, 3]``.

    Args:
        argument: its name in errors.
        path: a PNG, JPEG or anything else that Pillow reads.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no image, or has more than 89 million pixels.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{argument}: {path} is no file")
    # Pillow warns of a size that few cameras have, and refuses twice of it: it may be a lie that
    # takes all memory.
    too_large = (Image.DecompressionBombWarning, Image.DecompressionBombError)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(path) as image:
                return np.array(image.convert("RGB"))
    except (OSError, SyntaxError, *too_large) as error:
        raise ValueError(f"{argument}: {path} is no image ({error})") from error
