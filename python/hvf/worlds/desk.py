"""What the Franka desk is planned with: learned models, or the true simulator."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args

from hvf.protocols import SubgoalModel, WorldModel
from hvf.worlds import WEIGHTS

if TYPE_CHECKING:
    from hvf.envs.desk.pool import DeskPool

ModelName: TypeAlias = Literal["learned", "simulator"]
OverHorizon: TypeAlias = Literal["last", "sum", "min"]
GeneratorName: TypeAlias = Literal["states", "vae"]


@dataclass(frozen=True)
class DeskWorldConfig:
    """What to plan the desk with.

    Attributes:
        model: ``learned`` models, or the ``simulator``: true dynamics, drawn.
        blur: standard deviation in pixels of the Gaussian blur through which predicted frames and
            goals are compared; 0 for none.
        over_horizon: the cost of a rollout is that of its last frame, the sum over all frames, or
            the smallest.
        generator: where subgoals of the learned model come from: ``states`` (learned, drawn by the
            compact dynamics) or the paper's ``vae`` on images.
        dynamics: checkpoint of the learned dynamics; None for the one that ships.
        desk_generator: checkpoint of the generator of states; None for the one that ships.
        vae: checkpoint of the VAE; it has to be named, as none ships.
    """

    model: ModelName = "learned"
    generator: GeneratorName = "states"
    blur: float = 0.0
    over_horizon: OverHorizon = "last"
    dynamics: Path | None = None
    desk_generator: Path | None = None
    vae: Path | None = None

    def __post_init__(self) -> None:
        check_word("model", self.model, ModelName)
        check_word("generator", self.generator, GeneratorName)
        check_blur(self.blur)
        check_over_horizon(self.over_horizon)

    @property
    def checkpoints(self) -> dict[str, Path]:
        """The checkpoints that the world is made of; none for the simulator."""
        if self.model == "simulator":
            return {}
        paths = {"dynamics": self.dynamics or WEIGHTS / "desk_dynamics.safetensors"}
        if self.generator == "vae":
            return paths if self.vae is None else {**paths, "vae": self.vae}
        generator = self.desk_generator or WEIGHTS / "desk_generator.safetensors"
        return {**paths, "desk_generator": generator}


def load_desk(
    config: DeskWorldConfig, pool: DeskPool
) -> tuple[WorldModel[Any], SubgoalModel[Any] | None]:
    """The world model of the desk, and what draws subgoals in it: nothing, where none is named.

    Args:
        config: which.
        pool: where the simulator runs.

    Raises:
        FileNotFoundError: a checkpoint that is not there.
        ValueError: a checkpoint of another model or environment.
    """
    if config.model == "simulator":
        from hvf.worlds.mujoco import MujocoWorld

        return MujocoWorld(pool, config.blur, config.over_horizon), None
    from hvf.models.checkpoint import load_model
    from hvf.models.layers.dynamics import LayerDynamics
    from hvf.models.layers.generator import LayerGenerator
    from hvf.models.vae import CVAE
    from hvf.worlds.keypoint import ImageSubgoals
    from hvf.worlds.layers import LayerWorld
    from hvf.worlds.layers_subgoals import StateSubgoals

    paths = config.checkpoints
    if not paths["dynamics"].exists():
        path = paths["dynamics"]
        raise FileNotFoundError(f"{path}: no such dynamics; `hvf train desk-dynamics` makes it")
    model = load_model(paths["dynamics"], LayerDynamics, environment="desk")
    world = LayerWorld(model, config.blur, config.over_horizon)
    if "vae" in paths:
        return world, ImageSubgoals(load_model(paths["vae"], CVAE, environment="desk"))
    if config.generator == "vae" or not paths["desk_generator"].exists():
        return world, None
    generator = load_model(paths["desk_generator"], LayerGenerator, environment="desk")
    return world, StateSubgoals(generator, world)


def check_blur(blur: float) -> None:
    """Refuse a blur that is not finite and at least 0.

    Raises:
        ValueError: it is not.
    """
    if not (math.isfinite(blur) and blur >= 0):
        raise ValueError(f"blur: must be finite and not negative, got {blur}")


def check_over_horizon(over_horizon: str) -> None:
    """Refuse another word than ``last``, ``sum`` and ``min``.

    Raises:
        ValueError: another.
    """
    check_word("over_horizon", over_horizon, OverHorizon)


def check_word(name: str, value: str, allowed: object) -> None:
    """Refuse a ``value`` of ``name`` that is not one of the literals ``allowed``.

    Raises:
        ValueError: it is not.
    """
    words = get_args(allowed)
    if value not in words:
        raise ValueError(f"{name}: must be one of {', '.join(words)}; got {value!r}")
