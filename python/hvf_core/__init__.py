"""The Rust core: maze, image costs, CEM, visual MPC and subgoal search."""

from .hvf_core import *  # noqa: F403
from .hvf_core import __version__

__all__ = [name for name in dir() if not name.startswith("_")] + ["__version__"]
