"""One cell of the results: a method with its world and plan settings, on a task of a domain."""

from __future__ import annotations

import dataclasses
import re
from typing import Annotated, Any

import tyro

from hvf.data.splits import EPISODE_SEEDS
from hvf.domains.domain import Domain
from hvf.evaluation.naming import changes, short, slug, word
from hvf.registry import DOMAINS, METHODS
from hvf.settings import Acting, Planning, World
from hvf.worlds.load import segment_model


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """What is evaluated.

    Attributes:
        domain: name of the domain.
        task: what is to be done there: one of its tasks; in the maze also a layout.
        method: what acts: "hvf" searches for subgoals, "none" plans straight to the goal,
            "ground-truth" gets the domain's own subgoals, "random" acts at random.
        subgoals: number of subgoals (K), for methods that have any.
        world: what is planned with.
        planning: how agents plan and act.
        preset: name of the settings that this began with.
        split: which episodes: "train", "validation" (on which settings are chosen) or "test" (for
            published tables only).
        seed: of the episodes and of all planning, in place of the split's.
    """

    domain: Annotated[str, tyro.conf.Fixed]
    task: str
    method: str = "hvf"
    subgoals: int = 2
    world: World = World()
    planning: Planning = Planning()
    preset: str = "default"
    split: str = "validation"
    seed: int | None = None

    def __post_init__(self) -> None:
        place = DOMAINS[self.domain]
        place.check_task(self.task)
        method = METHODS[self.method]
        if self.subgoals < 0:
            raise ValueError(f"subgoals: must not be negative, got {self.subgoals}")
        if self.split not in EPISODE_SEEDS:
            words = ", ".join(EPISODE_SEEDS)
            raise ValueError(f"split: must be one of {words}; got {self.split!r}")
        if self.seed is not None and not 0 <= self.seed < 2**64:
            raise ValueError(f"seed: must be from 0 to 2**64 - 1, got {self.seed}")
        place.preset(self.preset)
        dynamics = place.resolved(self.world).dynamics
        if method.needs_generator and dynamics in place.privileged:
            raise ValueError(
                f"method: {self.method!r} needs learned dynamics at the {self.domain}: no "
                f"{dynamics} can start from a drawn subgoal"
            )

    @classmethod
    def of(cls, domain: str, preset: str = "default", **settings: Any) -> Evaluation:
        """An evaluation from settings of all its parts, beginning with a preset of the domain.

        ``Evaluation.of("maze", "paper", method="none", horizon=10, dynamics="simulator")``

        Raises:
            ValueError: a domain or preset that there is not, or a setting out of range.
            TypeError: a setting that there is not.
        """
        place = DOMAINS[domain]
        chosen = place.preset(preset)
        own = {field.name for field in dataclasses.fields(cls)}
        mine: dict[str, Any] = {"task": place.default_task}
        if chosen.method is not None:
            mine["method"] = chosen.method
        mine |= {name: value for name, value in settings.items() if name in own}
        whole = {name: mine.pop(name) for name in ("world", "planning") if name in mine}
        inner = {name: value for name, value in settings.items() if name not in own}
        made = dataclasses.replace(chosen, **whole).changed(inner)
        return cls(domain=domain, preset=preset, world=made.world, planning=made.planning, **mine)

    @property
    def place(self) -> Domain:
        """The domain itself."""
        return DOMAINS[self.domain]

    @property
    def acting(self) -> Acting:
        """The rule of acting."""
        return self.planning.rule(self.place.steps(self.task))

    @property
    def episode_seed(self) -> int:
        """Seed of the episodes and of all planning."""
        return EPISODE_SEEDS[self.split] if self.seed is None else self.seed

    @property
    def label(self) -> str:
        """The method in a few words."""
        return METHODS[self.method].label(self.subgoals)

    @property
    def name(self) -> str:
        """What is evaluated, in a few words."""
        method = METHODS[self.method]
        words = [self.label]
        if method.needs_dynamics:
            world = self.place.resolved(self.world)
            words.append(short(world.dynamics))
            natural = self.place.generators.get(world.dynamics, "default")
            if method.needs_generator and world.generator != natural:
                words[-1] += f" ({short(world.generator)})"
            if world.cost != "pixel":
                words.append(f"{world.cost} cost")
        return f"{self.domain} {self.task}: {', '.join(words)}"

    @property
    def world_names(self) -> dict[str, str]:
        """What takes part, by its part: "dynamics", "generator", "cost", "segment", "method".

        And what the task brings, as the maze's "layout"; and how the dynamics are computed, where
        that is not as usual.
        """
        method, world = METHODS[self.method], self.place.resolved(self.world)
        names = {"dynamics": world.dynamics} if method.needs_dynamics else {}
        if method.needs_generator:
            names["generator"] = world.generator
        if method.needs_dynamics:
            names["cost"] = world.cost
        if self._measures_segments:
            names["segment"] = segment_model(self.place, world)
        if method.asks is not None:
            names["method"] = world.method_model or method.asks
        if method.needs_dynamics:
            names |= {name: str(value) for name, value in world.computing.items()}
        return {**names, **self.place.parts(self.task)}

    @property
    def slug(self) -> str:
        """A name for its file: what it is, and all settings that differ from the preset's.

        Settings that differ have names that differ: a value that letters, digits and dots cannot
        tell (a path, a tuple) is followed by a checksum.
        """
        method, place = METHODS[self.method], self.place
        task = self.task if re.fullmatch(r"[a-z0-9_.-]+", self.task) else word(self.task, ())
        words = [self.domain, task, self.label, self.preset]
        preset = place.preset(self.preset)
        world = dict(changes(self.world, preset.world))
        if not method.needs_generator:
            world.pop("generator", None)
        if not self._measures_segments:
            world.pop("segment_model", None)
        if method.asks is None:
            world.pop("method_model", None)
        if not method.needs_dynamics:
            world = {name: value for name, value in world.items() if name == "method_model"}
        for name, value in {**world, **changes(self.planning, preset.planning)}.items():
            words.append(f"{name}-{word(value, place.weights)}")
        if self.split != "validation":
            words.append(self.split)
        if self.seed is not None:
            words.append(f"seed-{self.seed}")
        return slug(words)

    @property
    def _measures_segments(self) -> bool:
        """Whether segments cost a distance."""
        searches = METHODS[self.method].needs_generator
        return searches and self.planning.segment_cost == "distance"
