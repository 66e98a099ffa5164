"""Hierarchical visual foresight: reach a far goal image by searching for subgoal images.

    import gymnasium, hvf

    world, generator = hvf.load("maze")
    env = gymnasium.make("hvf/Maze-v0", difficulty="hard")
    image, info = env.reset(seed=0)
    found = hvf.HVF(subgoals=2).search(world, generator, image, info["goal"])

    report = hvf.evaluate("maze", method="hvf", subgoals=2, trials=20)

Names are imported when they are first used: ``import hvf`` is quick, and without torch. It makes
the environments known to Gymnasium.
"""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hvf.api import evaluate, load, train
    from hvf.domains.domain import Domain
    from hvf.evaluation.evaluation import Evaluation
    from hvf.registry import COSTS, DOMAINS, METHODS, MODELS
    from hvf.settings import Acting, Planning, Preset, World
    from hvf_core import HVF, VisualMPC

__all__ = [
    "COSTS",
    "DOMAINS",
    "HVF",
    "METHODS",
    "MODELS",
    "Acting",
    "Domain",
    "Evaluation",
    "Planning",
    "Preset",
    "VisualMPC",
    "World",
    "__version__",
    "evaluate",
    "load",
    "train",
]

try:
    __version__ = version("hvf")
except PackageNotFoundError:  # from a source tree that is not installed
    __version__ = "0+unknown"

_WHERE = {
    "COSTS": "hvf.registry",
    "DOMAINS": "hvf.registry",
    "HVF": "hvf_core",
    "METHODS": "hvf.registry",
    "MODELS": "hvf.registry",
    "Acting": "hvf.settings",
    "Domain": "hvf.domains.domain",
    "Evaluation": "hvf.evaluation.evaluation",
    "Planning": "hvf.settings",
    "Preset": "hvf.settings",
    "VisualMPC": "hvf_core",
    "World": "hvf.settings",
    "evaluate": "hvf.api",
    "load": "hvf.api",
    "train": "hvf.api",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used (PEP 562)."""
    if name not in _WHERE:
        raise AttributeError(f"module 'hvf' has no attribute {name!r}")
    import importlib

    value = getattr(importlib.import_module(_WHERE[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _register() -> None:
    from hvf.envs import register_envs

    register_envs()


_register()
