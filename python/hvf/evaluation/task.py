"""An agent on an environment's episodes: what every evaluation shares.

An environment brings settings (a subclass of :class:`Evaluation`), and its trials with a world to
plan them in (a subclass of :class:`EpisodeTask`). Agents, seeds and records are the same for all.
"""

from __future__ import annotations

import abc
import dataclasses
import hashlib
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Generic, Literal, TypeAlias, TypeVar, get_args

from hvf.agents.planning import (
    NoSubgoals,
    PlanningAgent,
    RandomAgent,
    SearchedSubgoals,
    SubgoalSource,
    TrueSubgoals,
)
from hvf.evaluation.acting import Outcome, Trials, act, derived_seed
from hvf.protocols import SubgoalModel, WorldModel
from hvf.settings import Acting, Planning

TEST_SEED = 1_000_000_007
"""Seed of the episodes that results are reported on. Settings were chosen on
:data:`VALIDATION_SEED`, models trained on data of small seeds (``hvf collect --seed``)."""
VALIDATION_SEED = 1_000_000_009
"""Seed of the episodes that settings were chosen on."""

AgentName: TypeAlias = Literal["hvf", "none", "ground-truth", "random"]
AGENTS: tuple[AgentName, ...] = get_args(AgentName)

SomeEvaluation = TypeVar("SomeEvaluation", bound="Evaluation")
SomeTrials = TypeVar("SomeTrials", bound=Trials, covariant=True)
SomeTask = TypeVar("SomeTask", bound="EpisodeTask[Any]")


@dataclasses.dataclass(frozen=True)
class Evaluation(abc.ABC):
    """One cell of the results: an agent, and how it plans.

    Attributes:
        agent: "hvf" searches for subgoals; "none" is visual foresight, straight to the goal;
            "ground-truth" gets the environment's own subgoals; "random" acts at random.
        subgoals: number of subgoals (K) of hvf and ground-truth.
        seed: seed of the episodes and of all planning.
        planning: how agents plan and act.
    """

    presets: ClassVar[Mapping[str, Planning]]
    """Settings of planning by the name of their preset; ``"default"`` is one of them."""
    preset_settings: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    """What else a preset begins with."""

    agent: AgentName = "hvf"
    subgoals: int = 2
    seed: int = TEST_SEED
    planning: Planning = Planning()

    def __post_init__(self) -> None:
        if self.agent not in AGENTS:
            raise ValueError(f"agent: must be one of {', '.join(AGENTS)}, got {self.agent!r}")
        if self.subgoals < 0:
            raise ValueError(f"subgoals: must not be negative, got {self.subgoals}")
        if not 0 <= self.seed < 2**64:
            raise ValueError(f"seed: must be from 0 to 2**64 - 1, got {self.seed}")

    @classmethod
    def of(cls: type[SomeEvaluation], preset: str = "default", **settings: Any) -> SomeEvaluation:
        """An evaluation from settings of both dataclasses, beginning with a preset.

        ``MazeEvaluation.of("paper", agent="none", horizon=10)``

        Raises:
            ValueError: a preset that there is not.
            TypeError: a setting that there is not.
        """
        if preset not in cls.presets:
            names = ", ".join(map(repr, cls.presets))
            raise ValueError(f"preset: must be one of {names}, got {preset!r}")
        own = {field.name for field in dataclasses.fields(cls)}
        mine = dict(cls.preset_settings.get(preset, {}))
        mine |= {name: value for name, value in settings.items() if name in own}
        rest = {name: value for name, value in settings.items() if name not in own}
        planning = mine.pop("planning", cls.presets[preset])
        return cls(planning=dataclasses.replace(planning, **rest), **mine)

    @property
    def agent_name(self) -> str:
        """The agent in a few words."""
        return agent_name(self.agent, self.subgoals)

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """What is evaluated, in a few words."""

    @property
    @abc.abstractmethod
    def acting(self) -> Acting:
        """The rule of acting."""


def agent_name(agent: AgentName, subgoals: int) -> str:
    """An agent in a few words."""
    return {
        "hvf": f"HVF-{subgoals}",
        "none": "no subgoals",
        "ground-truth": f"ground truth-{subgoals}",
        "random": "random",
    }[agent]


class EpisodeTask(abc.ABC, Generic[SomeTrials]):
    """An evaluation with its world loaded; see :class:`hvf.evaluation.run.Task`.

    Close it, or use it in a ``with`` block.

    Args:
        evaluation: which agent, and how it plans.
        world: what it plans with.
        generator: what draws the subgoals of agent hvf.
        checkpoints: files of learned weights that take part.
        told: whether plans start from the trials' own frames in place of images; see
            :class:`~hvf.agents.planning.PlanningAgent`.
    """

    def __init__(
        self,
        evaluation: Evaluation,
        world: WorldModel[Any],
        generator: SubgoalModel[Any] | None,
        checkpoints: Mapping[str, Path],
        told: bool = False,
    ) -> None:
        self.evaluation = evaluation
        self.world = world
        self.generator = generator
        self._checkpoints = checkpoints
        planning = evaluation.planning
        self.agent: PlanningAgent | RandomAgent
        if evaluation.agent == "random":
            self.agent = RandomAgent(world.action_low, world.action_high)
        else:
            source: SubgoalSource = NoSubgoals()
            if evaluation.agent == "hvf" and evaluation.subgoals:
                search = planning.search(evaluation.subgoals)
                source = SearchedSubgoals(search, world, generator)
            elif evaluation.agent == "ground-truth":
                source = TrueSubgoals(evaluation.subgoals)
            self.agent = PlanningAgent(world, planning.mpc, source, planning.replanning, told)

    @abc.abstractmethod
    def trials(self, first: int, count: int) -> SomeTrials:
        """Fresh trials of episodes ``first..first + count``."""

    def close(self) -> None:
        """Give back what the world holds: nothing, for most."""

    def __enter__(self: SomeTask) -> SomeTask:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def name(self) -> str:
        """What is evaluated."""
        return self.evaluation.name

    @property
    def config(self) -> Mapping[str, Any]:
        """All settings, and checksums of learned weights; JSON's types."""
        settings = dataclasses.asdict(self.evaluation)
        for name, value in settings.items():
            if isinstance(value, Path):
                settings[name] = str(value)
        return {**settings, "sha256": checksums(self._checkpoints)}

    def seeds(self, first: int, count: int) -> list[int]:
        """Seeds of the planning in these episodes."""
        return [derived_seed(self.evaluation.seed, index) for index in range(first, first + count)]

    def run(self, first: int, count: int) -> Outcome:
        """Run episodes ``first..first + count``."""
        trials = self.trials(first, count)
        return act(trials, self.agent, self.evaluation.acting, self.seeds(first, count))


def checksums(files: Mapping[str, Path]) -> dict[str, str]:
    """SHA-256 of those of the files that are there."""
    return {
        name: hashlib.sha256(path.read_bytes()).hexdigest()
        for name, path in files.items()
        if path.exists()
    }
