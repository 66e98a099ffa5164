"""``hvf collect maze``: data from random interaction."""

from __future__ import annotations

from typing import Annotated

import tyro

from hvf.domains.maze_collection import MazeCollection


def maze(config: Annotated[MazeCollection, tyro.conf.arg(name="")]) -> None:
    """Collect episodes of the maze under uniformly random actions into one HDF5 file.

    Ctrl-C stops; the same command goes on from there.
    """
    config.run()
