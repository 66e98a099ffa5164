"""Worlds to plan in: learned models and simulators behind the planner's protocols."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import hvf_core
from hvf.protocols import SubgoalModel, WorldModel

if TYPE_CHECKING:
    import torch

Model = TypeVar("Model", bound="torch.nn.Module")

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
        cost: what a predicted frame costs: ``pixel`` distance to the goal, distance in the CVAE's
            ``latent``, or learned ``temporal`` distance (steps of random play); the latter two
            only for the learned model, and without a blur.
        dynamics: checkpoint of the dynamics; None for the one that ships.
        keypoint_generator: checkpoint of the keypoint generator; None for the one that ships.
        cvae: checkpoint of the CVAE; None for the one that ships.
        temporal_distance: checkpoint of the temporal distance; None for the one that ships.
    """

    model: Literal["learned", "simulator"] = "learned"
    generator: Literal["default", "keypoint", "cvae", "oracle"] = "default"
    blur: float = 0.0
    over_horizon: Literal["last", "sum", "min"] = "last"
    cost: Literal["pixel", "latent", "temporal"] = "pixel"
    dynamics: Path | None = None
    keypoint_generator: Path | None = None
    cvae: Path | None = None
    temporal_distance: Path | None = None

    def __post_init__(self) -> None:
        for name, allowed in (
            ("model", ("learned", "simulator")),
            ("generator", ("default", "keypoint", "cvae", "oracle")),
            ("over_horizon", ("last", "sum", "min")),
            ("cost", ("pixel", "latent", "temporal")),
        ):
            value = getattr(self, name)
            if value not in allowed:
                raise ValueError(f"{name}: must be one of {', '.join(allowed)}; got {value!r}")
        if not 0 <= self.blur < float("inf"):
            raise ValueError(f"blur: must be finite and not negative, got {self.blur}")
        if self.cost != "pixel" and self.model != "learned":
            raise ValueError(f"cost: {self.cost!r} needs model='learned', got {self.model!r}")


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
    from hvf.models.keypoint.dynamics import KeypointDynamics
    from hvf.models.keypoint.generator import KeypointGenerator
    from hvf.models.temporal_distance import TemporalDistance
    from hvf.models.vae import CVAE
    from hvf.worlds.costs import DistanceWorld, LatentDistance, StepsDistance
    from hvf.worlds.keypoint import ImageSubgoals, KeypointSubgoals, KeypointWorld

    def load(name: str, kind: type[Model]) -> Model:
        path = getattr(config, name) or WEIGHTS / f"maze_{name}.safetensors"
        return load_model(path, kind, environment="maze")

    world: Any = hvf_core.MazeWorld(blur=config.blur, over_horizon=config.over_horizon)
    learned: KeypointWorld | None = None
    if config.model == "learned" or generator == "keypoint":
        learned = KeypointWorld(
            load("dynamics", KeypointDynamics), config.blur, config.over_horizon
        )
    if config.model == "learned":
        assert learned is not None
        world = learned
        if config.cost == "latent":
            distance = LatentDistance(load("cvae", CVAE), learned)
            world = DistanceWorld(learned, distance, config.over_horizon)
        elif config.cost == "temporal":
            steps = StepsDistance(load("temporal_distance", TemporalDistance))
            world = DistanceWorld(learned, steps, config.over_horizon)
    subgoals: SubgoalModel[Any]
    if generator == "oracle":
        subgoals = hvf_core.MazeSubgoals()
    elif generator == "cvae":
        subgoals = ImageSubgoals(load("cvae", CVAE))
    else:
        assert learned is not None
        subgoals = KeypointSubgoals(load("keypoint_generator", KeypointGenerator), learned)
    return world, subgoals
