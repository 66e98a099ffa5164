"""Worlds to plan in: learned models and simulators behind the planner's protocols."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import hvf_core
from hvf.protocols import SubgoalModel, WorldModel

__all__ = ["WEIGHTS", "MazeWorldConfig", "load_maze"]

WEIGHTS = Path(str(files("hvf"))) / "weights"
"""Directory of the weights that the package ships."""


@dataclass(frozen=True)
class MazeWorldConfig:
    """What to plan the maze with.

    Attributes:
        model: ``learned`` is the compact dynamics model, ``simulator`` the true dynamics.
        generator: where subgoal images come from: ``keypoint`` (learned, with the compact model's
            sprite), ``cvae`` (the paper's, on images), ``oracle`` (true positions), or ``default``:
            ``keypoint`` for the learned model, ``oracle`` for the simulator.
        blur: standard deviation in pixels of the Gaussian blur through which predicted frames and
            goals are compared; 0 for none.
        over_horizon: the cost of a rollout is that of its last frame, the sum over all frames, or
            the smallest.
        dynamics: checkpoint of the dynamics; None for the one that ships.
        keypoint_generator: checkpoint of the keypoint generator; None for the one that ships.
        cvae: checkpoint of the CVAE; None for the one that ships.
    """

    model: Literal["learned", "simulator"] = "learned"
    generator: Literal["default", "keypoint", "cvae", "oracle"] = "default"
    blur: float = 0.0
    over_horizon: Literal["last", "sum", "min"] = "last"
    dynamics: Path | None = None
    keypoint_generator: Path | None = None
    cvae: Path | None = None

    def __post_init__(self) -> None:
        for name, allowed in (
            ("model", ("learned", "simulator")),
            ("generator", ("default", "keypoint", "cvae", "oracle")),
            ("over_horizon", ("last", "sum", "min")),
        ):
            value = getattr(self, name)
            if value not in allowed:
                raise ValueError(f"{name}: must be one of {', '.join(allowed)}; got {value!r}")
        if not 0 <= self.blur < float("inf"):
            raise ValueError(f"blur: must be finite and not negative, got {self.blur}")


def load_maze(config: MazeWorldConfig) -> tuple[WorldModel[Any], SubgoalModel[Any]]:
    """The world model and the subgoal generator of the maze.

    Torch is imported only where a learned model takes part.

    Raises:
        FileNotFoundError: a checkpoint that is not there.
        ValueError: a checkpoint of another model or environment.
    """
    generator = config.generator
    if generator == "default":
        generator = "keypoint" if config.model == "learned" else "oracle"
    if config.model == "simulator" and generator == "oracle":
        world = hvf_core.MazeWorld(blur=config.blur, over_horizon=config.over_horizon)
        return world, hvf_core.MazeSubgoals()
    return _load_learned(config, generator)


def _load_learned(
    config: MazeWorldConfig, generator: str
) -> tuple[WorldModel[Any], SubgoalModel[Any]]:
    from hvf.models.checkpoint import load_model
    from hvf.models.cvae import CVAE
    from hvf.models.keypoint_dynamics import KeypointDynamics
    from hvf.models.keypoint_generator import KeypointGenerator
    from hvf.worlds.learned import ImageSubgoals, KeypointSubgoals, LearnedWorld

    world: Any = hvf_core.MazeWorld(blur=config.blur, over_horizon=config.over_horizon)
    learned: LearnedWorld | None = None
    if config.model == "learned" or generator == "keypoint":
        path = config.dynamics or WEIGHTS / "maze_dynamics.safetensors"
        dynamics = load_model(path, KeypointDynamics, environment="maze")
        learned = LearnedWorld(dynamics, config.blur, config.over_horizon)
    if config.model == "learned":
        world = learned
    subgoals: SubgoalModel[Any]
    if generator == "oracle":
        subgoals = hvf_core.MazeSubgoals()
    elif generator == "cvae":
        path = config.cvae or WEIGHTS / "maze_cvae.safetensors"
        subgoals = ImageSubgoals(load_model(path, CVAE, environment="maze"))
    else:
        assert learned is not None
        path = config.keypoint_generator or WEIGHTS / "maze_keypoint_generator.safetensors"
        model = load_model(path, KeypointGenerator, environment="maze")
        subgoals = KeypointSubgoals(model, learned)
    return world, subgoals
