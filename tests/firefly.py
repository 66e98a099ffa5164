"""A domain and a model of somebody else's: a light that flies over a plane, and how it does.

As another package would have them: nothing here is known to hvf but by its registries.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch

from hvf.data.loader import WindowSampler
from hvf.domains.domain import Domain, Place
from hvf.domains.gym import gym_domain
from hvf.experiments.cells import Cell, PaperTable, Setup
from hvf.models.entry import ModelEntry
from hvf.registry import DOMAINS, MODELS
from hvf.settings import Planning, World
from hvf.training.loop import LoopConfig, seeded
from hvf.training.recipe import Recipe, Stage, Stages, TrainingData

SIZE = 16
PLANNING = Planning(
    horizon=3, samples=20, elites=4, iterations=2, subgoal_samples=6, subgoal_elites=2,
    subgoal_iterations=2, threshold=0.5,
)  # fmt: skip


def draw(places: Any) -> Any:
    """Images uint8 ``[N, S, S, 3]`` of a light at ``places [N, 2]``, pixels."""
    grid = np.stack(np.mgrid[:SIZE, :SIZE], axis=-1)
    apart = ((grid - np.reshape(places, (-1, 1, 1, 2))) ** 2).sum(axis=-1)
    light = 250 * np.exp(-apart / 6)
    return np.repeat(np.rint(light)[..., None], 3, axis=-1).astype(np.uint8)


class Firefly(gymnasium.Env[Any, Any]):
    """Fly to where the goal image shows the light."""

    observation_space = gymnasium.spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8)
    action_space = gymnasium.spaces.Box(-2, 2, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
        super().reset(seed=seed)
        self.place, self.goal = self.np_random.uniform(3, SIZE - 4, (2, 2))
        return draw(self.place)[0], {"goal": draw(self.goal)[0]}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, Any]:
        self.place = np.clip(self.place + action, 0, SIZE - 1)
        done = bool(np.linalg.norm(self.place - self.goal) < 1.5)
        info = {"goal": draw(self.goal)[0], "success": done}
        return draw(self.place)[0], 0.0, done, False, info


class Wings(torch.nn.Module):
    """Knows where the light is, and learns how far an action takes it."""

    @dataclasses.dataclass(frozen=True)
    class Config:
        actions: int = 2

    config_type: ClassVar[type[Config]] = Config

    def __init__(self, config: Config) -> None:
        super().__init__()
        self.config = config
        self.far = torch.nn.Linear(config.actions, 2)

    def where(self, images: torch.Tensor) -> torch.Tensor:
        light = images[..., 0].float() + 1e-3
        rows, columns = light.sum(-1), light.sum(-2)
        line = torch.arange(light.shape[-1]).float()
        both = [(x * line).sum(-1) / x.sum(-1) for x in (rows, columns)]
        return torch.stack(both, dim=-1)

    def loss(self, batch: Any, generator: torch.Generator, step: int) -> Any:
        places = self.where(batch["frames"])
        missed = places[:, 1] - places[:, 0] - self.far(batch["actions"][:, 0])
        return missed.square().mean(), {}


class Flight:
    """What the planner asks: the distance at the end, in pixels."""

    action_low, action_high = -2 * np.ones(2, np.float32), 2 * np.ones(2, np.float32)

    def __init__(self, wings: Wings, planning: Planning) -> None:
        self.wings = wings

    def rollout_costs(self, starts: Any, goals: Any, actions: Any) -> Any:
        here, there = (self.wings.where(torch.from_numpy(x)) for x in (starts, goals))
        ends = here[:, None] + self.wings.far(torch.from_numpy(actions)).sum(dim=2)
        return (ends - there[:, None]).square().sum(dim=-1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class WingsRecipe(Recipe):
    """Training of the wings."""

    name: ClassVar[str] = "wings"
    loop: LoopConfig = LoopConfig(steps=300, learning_rate=0.02, device="cpu", threads=1)

    def stages(self, data: TrainingData) -> Stages:
        wings = seeded(self.loop.seed, lambda: Wings(Wings.Config(data.action_dim)))
        yield Stage(wings, WindowSampler(data.pool(), 32, 1, self.loop.seed), self.loop)


def flights(setup: Setup) -> list[PaperTable]:
    """Tables of its own for ``hvf paper``."""
    cell = Cell(setup.evaluation("random"), published=0.02)
    return [PaperTable("flights", "Flights in the dark", "wings", ("there",), {"random": (cell,)})]


FIREFLY = dataclasses.replace(
    gym_domain("firefly", Firefly, steps=12, planning=PLANNING, world=World("wings.safetensors")),
    experiments=flights,
)
WINGS = ModelEntry("how a light flies", "video", "dynamics", Wings, Flight, WingsRecipe)


class Swarm:
    """Trials of a domain by hand: several lights, each on a plane of its own."""

    def __init__(self, seed: int, first: int, count: int, near: bool) -> None:
        rngs = [np.random.default_rng([seed, first + i]) for i in range(count)]
        self.places, self.ends = np.stack([rng.uniform(3, 12, (2, 2)) for rng in rngs], axis=1)
        self.ends = np.where(near, self.places + 2, self.ends)
        self.goals = draw(self.ends)

    def __len__(self) -> int:
        return len(self.places)

    def observe(self, which: Any) -> Any:
        return draw(self.places[which])

    def step(self, which: Any, actions: Any) -> dict[int, str]:
        self.places[which] = np.clip(self.places[which] + actions, 0, SIZE - 1)
        return {}

    def success(self, which: Any) -> Any:
        return np.linalg.norm(self.places[which] - self.ends[which], axis=1) < 1.5

    def true_subgoals(self, count: int) -> Any:
        ways = np.linspace(self.places, self.ends, count + 2, axis=1)[:, 1:-1]
        return draw(ways).reshape(len(self), count, SIZE, SIZE, 3)

    def positions(self, which: Any) -> Any:
        return self.places[which][:, ::-1].copy()

    def target(self, trial: int) -> tuple[float, float, float]:
        row, column = self.ends[trial]
        return float(column), float(row), 1.5


class Meadow(Place):
    """The domain by hand, open."""

    def trials(self, task: str, seed: int, first: int, count: int) -> Swarm:
        return Swarm(seed, first, count, task == "near")


MEADOW = Domain(
    "meadow", "lights on a meadow", lambda workers: Meadow(), (-2.0, -2.0), (2.0, 2.0),
    tasks={"near": 6, "far": 12},
)  # fmt: skip


def register() -> None:
    """What importing the package would do."""
    DOMAINS.register("firefly", FIREFLY)
    DOMAINS.register("meadow", MEADOW)
    MODELS.register("wings", WINGS)
