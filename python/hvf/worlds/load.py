"""From names and checkpoints to what the planner plans with.

A checkpoint's header says which model it holds; the registry says what that is good for and what
makes a world of it. Torch is imported only where a learned model takes part.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hvf.protocols import SubgoalModel, WorldModel
from hvf.registry import COSTS, MODELS
from hvf.settings import Planning, World

if TYPE_CHECKING:
    from hvf.domains.domain import Domain, Place
    from hvf.models.entry import Role

# A cost may also be measured in the latent of a generator.
_ROLES: Mapping[str, tuple[Role, ...]] = {
    "dynamics": ("dynamics",),
    "generator": ("generator",),
    "cost": ("distance", "generator"),
    "segment": ("distance",),
}


@dataclass(frozen=True)
class Weights:
    """Learned weights that take part.

    Attributes:
        path: the checkpoint.
        model: what it holds, by its name in the registry.
        kind: "video" or "object".
    """

    path: Path
    model: str
    kind: str

    @property
    def sha256(self) -> str:
        """Checksum of the file."""
        return file_checksum(self.path)


@dataclass(frozen=True)
class Loaded:
    """What is planned with.

    Attributes:
        world: predicts and scores.
        generator: draws subgoals; None where none is asked for.
        weights: the checkpoints in it, by their part: "dynamics", "generator", "cost", "segment".
        kind: "simulator" for true dynamics; else "object" if one of the models is, or "video".
    """

    world: WorldModel[Any]
    generator: SubgoalModel[Any] | None
    weights: dict[str, Weights] = field(default_factory=dict)

    @property
    def kind(self) -> str:
        """What results may be compared with."""
        return kind_of(self.weights) if "dynamics" in self.weights else "simulator"


def file_checksum(path: Path) -> str:
    """SHA-256 of a file, which is read again only when it has changed."""
    return _checksum(path, path.stat().st_mtime_ns)


@functools.lru_cache
def _checksum(path: Path, changed: int) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def kind_of(weights: Mapping[str, Weights]) -> str:
    """What learned models together are: "object" if one is, or "video"; empty for none."""
    kinds = {each.kind for each in weights.values()}
    return "object" if "object" in kinds else "video" if kinds else ""


def load(
    domain: Domain,
    world: World,
    planning: Planning,
    place: Place,
    *,
    generator: bool = True,
) -> Loaded:
    """Load what is planned with.

    Args:
        domain: whose names count.
        world: the names.
        planning: settings of the cost: blur, and which predicted frames count.
        place: the open domain, for what is not learned.
        generator: whether subgoals are drawn.

    Raises:
        FileNotFoundError: a checkpoint that is not there; says how to make it.
        ValueError: a name that there is not, or a checkpoint of another model.
    """
    world = domain.resolved(world)
    weights: dict[str, Weights] = {}
    models: dict[str, Any] = {}

    def module(part: str, name: str) -> Any:
        path = checkpoint(domain, part, name)
        if part not in models:
            weights[part], models[part] = _read(part, path, _ROLES[part])
        return models[part]

    if world.dynamics == "simulator":
        _check_computing(world, "simulator", in_torch=False)
        dynamics = place.simulator(planning)
    else:
        model = module("dynamics", world.dynamics)
        held = weights["dynamics"]
        _check_computing(world, held.model, MODELS[held.model].in_torch)
        dynamics = _plannable(held)(model, planning, **world.computing)
    cost = COSTS[world.cost]
    planned: WorldModel[Any] = dynamics
    asked = cost_model(domain, world)
    if cost.in_steps:
        if asked is None:
            raise ValueError(
                f"cost_model: name one for the cost {world.cost!r}; none goes with {world.dynamics}"
            )
        model = module("cost", asked)
        planned = _in_steps(weights["cost"], world.cost)(model, dynamics, planning)
    elif cost.world is not None:
        model = module("cost", asked) if asked else None
        planned = cost.world(dynamics, model, planning)
    drawn: SubgoalModel[Any] | None = None
    if generator and world.generator == "oracle":
        drawn = place.oracle()
    elif generator:
        model = module("generator", world.generator)
        drawn = _plannable(weights["generator"])(model, dynamics)
    if drawn is not None and planning.segment_cost == "distance":
        model = module("segment", segment_model(domain, world))
        drawn = _judge(weights["segment"])(model, drawn)
    return Loaded(planned, drawn, weights)


def cost_model(domain: Domain, world: World) -> str | None:
    """The model that a cost asks: the one that is named, or else what goes with it; None for none.

    Args:
        domain: whose names count.
        world: names the cost, and may name the model.
    """
    if world.cost_model is not None:
        return world.cost_model
    cost = COSTS[world.cost]
    dynamics = domain.resolved(world).dynamics
    return _distance_for(domain, dynamics) if cost.in_steps else cost.model


def _check_computing(world: World, model: str, in_torch: bool) -> None:
    """Refuse settings of torch for dynamics that it does not roll out."""
    if world.computing and not in_torch:
        names = ", ".join(world.computing)
        raise ValueError(f"{names}: for dynamics that torch rolls out, which {model} is not")


def segment_model(domain: Domain, world: World) -> str:
    """The distance that segments cost, where they cost one.

    Raises:
        ValueError: none is named, and none goes with the dynamics.
    """
    dynamics = domain.resolved(world).dynamics
    asked = world.segment_model or _distance_for(domain, dynamics)
    if asked is None:
        raise ValueError(
            f"segment_model: name one for the segment cost 'distance'; none goes with {dynamics}"
        )
    return asked


def _distance_for(domain: Domain, dynamics: str) -> str | None:
    """The distance in steps that goes with dynamics: with their model, which may be in a file."""
    return domain.distances.get(dynamics) or domain.distances.get(domain.model_of(dynamics))


def load_asked(domain: Domain, world: World, name: str) -> tuple[Weights, Any]:
    """The model that a method asks of its own (:attr:`hvf.agents.method.Method.asks`).

    Args:
        domain: whose names count.
        world: has the checkpoint, ``method_model``, or none for the domain's own.
        name: of the model in :data:`hvf.registry.MODELS`; another of its role will do.

    Raises:
        FileNotFoundError: a checkpoint that is not there; says how to make it.
        ValueError: a checkpoint of a model of another role.
    """
    path = checkpoint(domain, "method_model", world.method_model or name)
    weights, model = _read("method_model", path, (MODELS[name].role,))
    return weights, _plannable(weights)(model)


def load_generator(domain: Domain, name: str) -> Loaded:
    """Load a generator alone, with no world around it: its frames are images.

    Raises:
        FileNotFoundError: a checkpoint that is not there; says how to make it.
        ValueError: a checkpoint of another model, or of one that draws with its dynamics.
    """
    weights, model = _read("generator", checkpoint(domain, "generator", name), _ROLES["generator"])
    if weights.kind != "video":
        raise ValueError(f"generator: {weights.model} draws with its dynamics; name these too")
    return Loaded(_Nowhere(), _plannable(weights)(model, None), {"generator": weights})


class _Nowhere:
    """A world of images in which nothing is known of actions."""

    action_low = action_high = np.empty(0, np.float32)

    def rollout_costs(self, starts: Any, goals: Any, actions: Any) -> Any:
        raise ValueError("dynamics: none are loaded, nothing can be planned")


def checkpoint(domain: Domain, part: str, name: str) -> Path:
    """The checkpoint that a name stands for in a domain: one that ships, or a file.

    Raises:
        FileNotFoundError: neither; says what there is and how to make one.
    """
    if name in domain.weights:
        path = domain.weights[name]
        if path.is_file():
            return path
        raise FileNotFoundError(f"{path}: no such {part}; `hvf train {name} --data FILE` makes it")
    path = Path(name)
    if path.is_file():
        return path
    if name == "default":
        raise FileNotFoundError(
            f"{part}: name one for this world; none goes with it in {domain.name}"
        )
    ships = ", ".join(domain.weights) or "none"
    made = f"; `hvf train {name} --data FILE` makes one" if name in MODELS else ""
    raise FileNotFoundError(
        f"{part}: {name!r} is neither a file nor one of the models that ship for "
        f"{domain.name} ({ships}){made}"
    )


def _read(part: str, path: Path, roles: tuple[Role, ...]) -> tuple[Weights, Any]:
    from hvf.models.checkpoint import load_any

    found = load_any(path)
    if found.entry.role not in roles:
        raise ValueError(
            f"{part}: {path} holds a {found.name} model, which is good for "
            f"{found.entry.role}, not for this"
        )
    return Weights(path, found.name, found.entry.kind), found.module


def _plannable(weights: Weights) -> Any:
    return MODELS[weights.model].resolved("plannable")


def _in_steps(weights: Weights, cost: str) -> Any:
    if not MODELS[weights.model].in_steps:
        raise ValueError(
            f"cost_model: {cost!r} needs a distance in steps; {weights.path} holds a "
            f"{weights.model} model"
        )
    return _plannable(weights)


def _judge(weights: Weights) -> Any:
    judge = MODELS[weights.model].resolved("judge")
    if judge is None:
        raise ValueError(f"segment_model: a {weights.model} model does not judge segments")
    return judge
