"""The Rust core: maze, image costs, CEM, visual MPC and subgoal search."""

from .hvf_core import *  # noqa: F403
from .hvf_core import __all__ as __all__
from .hvf_core import __version__ as __version__
