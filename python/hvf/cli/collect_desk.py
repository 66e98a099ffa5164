"""``hvf collect desk``: random interaction at the Franka desk. Needs MuJoCo."""

from __future__ import annotations

from typing import Annotated

import tyro

from hvf.domains.desk.collection import DeskCollection


def desk(config: Annotated[DeskCollection, tyro.conf.arg(name="")]) -> None:
    """Collect episodes of the Franka desk under uniformly random actions into one HDF5 file.

    Ctrl-C stops; the same command goes on from there.
    """
    config.run()
