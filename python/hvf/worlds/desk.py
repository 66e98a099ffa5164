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


@dataclass(frozen=True)
class DeskWorldConfig:
    """What to plan the desk with.

    Attributes:
        model: ``learned`` models, or the ``simulator``: true dynamics, drawn.
        blur: standard deviation in pixels of the Gaussian blur through which predicted frames and
            goals are compared; 0 for none.
        over_horizon: the cost of a rollout is that of its last frame, the sum over all frames, or
            the smallest.
        dynamics: checkpoint of the learned dynamics; None for the one that ships.
        vae: checkpoint of the VAE of subgoals; None for the one that ships.
    """

    model: ModelName = "learned"
    blur: float = 0.0
    over_horizon: OverHorizon = "last"
    dynamics: Path | None = None
    vae: Path | None = None

    def __post_init__(self) -> None:
        if self.model not in get_args(ModelName):
            words = ", ".join(get_args(ModelName))
            raise ValueError(f"model: must be one of {words}; got {self.model!r}")
        check_blur(self.blur)
        check_over_horizon(self.over_horizon)


def load_desk(
    config: DeskWorldConfig, pool: DeskPool
) -> tuple[WorldModel[Any], SubgoalModel[Any] | None]:
    """The world model of the desk, and what draws subgoals in it: nothing, where there is no VAE.

    Args:
        config: which.
        pool: where the simulator runs.

    Raises:
        FileNotFoundError: a checkpoint that is not there.
        ValueError: a checkpoint of another model or environment.
    """
    if config.model == "simulator":
        from hvf.worlds.desk_simulator import DeskSimulatorWorld

        return DeskSimulatorWorld(pool, config.blur, config.over_horizon), None
    from hvf.models.checkpoint import load_model
    from hvf.models.cvae import CVAE
    from hvf.models.desk.dynamics import DeskDynamics
    from hvf.worlds.desk_learned import DeskLearnedWorld
    from hvf.worlds.learned import ImageSubgoals

    dynamics = config.dynamics or WEIGHTS / "desk_dynamics.safetensors"
    model = load_model(dynamics, DeskDynamics, environment="desk")
    world = DeskLearnedWorld(model, config.blur, config.over_horizon)
    vae = config.vae or WEIGHTS / "desk_vae.safetensors"
    if config.vae is None and not vae.exists():
        return world, None
    return world, ImageSubgoals(load_model(vae, CVAE, environment="desk"))


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
    allowed = get_args(OverHorizon)
    if over_horizon not in allowed:
        words = ", ".join(allowed)
        raise ValueError(f"over_horizon: must be one of {words}; got {over_horizon!r}")
