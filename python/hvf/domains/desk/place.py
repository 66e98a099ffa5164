"""The Franka desk, open: processes that simulate and draw. Needs MuJoCo."""

from __future__ import annotations

from typing import Any, cast

from hvf.domains.desk.trials import DeskTrials
from hvf.domains.domain import Place
from hvf.envs.desk.pool import DeskPool
from hvf.envs.desk.tasks import TaskName
from hvf.protocols import WorldModel
from hvf.settings import Planning
from hvf.worlds.mujoco import MujocoWorld

__all__ = ["Desk", "DeskTrials"]


class Desk(Place):
    """The desk with its processes.

    Args:
        workers: processes, 0 for as many as there are cores; results do not depend on it.

    Raises:
        RuntimeError: no OpenGL; names the Debian package to install.
    """

    def __init__(self, workers: int = 0) -> None:
        self.pool = DeskPool(workers)

    def trials(self, task: str, seed: int, first: int, count: int) -> DeskTrials:
        """Fresh trials of a task."""
        return DeskTrials(self.pool, seed, first, count, cast(TaskName, task))

    def simulator(self, planning: Planning) -> WorldModel[Any]:
        """MuJoCo rolled out, drawn, and compared in pixels."""
        return MujocoWorld(self.pool, planning.blur, planning.over_horizon)

    def close(self) -> None:
        """Stop the processes."""
        self.pool.close()
