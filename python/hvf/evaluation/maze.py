"""The maze: its episodes as trials, its settings, its agents."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

import hvf_core
from hvf.evaluation.acting import Acting, Images, Indices, Outcome, act, derived_seed
from hvf.evaluation.agents import (
    NoSubgoals,
    PlanningAgent,
    RandomAgent,
    SearchedSubgoals,
    SubgoalSource,
    TrueSubgoals,
)
from hvf.worlds import WEIGHTS, MazeWorldConfig, load_maze

TEST_SEED = 1_000_000_007
"""Seed of the episodes that results are reported on. Settings were chosen on
:data:`VALIDATION_SEED`, models trained on data of small seeds (``hvf collect maze --seed``)."""
VALIDATION_SEED = 1_000_000_009
"""Seed of the episodes that settings were chosen on."""

_CHECKPOINTS = ("dynamics", "keypoint_generator", "cvae", "temporal_distance")

AgentName: TypeAlias = Literal["hvf", "none", "ground-truth", "random"]
Difficulty: TypeAlias = Literal["easy", "medium", "hard"]
ModelName: TypeAlias = Literal["learned", "simulator"]
GeneratorName: TypeAlias = Literal["default", "keypoint", "cvae", "oracle"]
Preset: TypeAlias = Literal["default", "paper"]


@dataclasses.dataclass(frozen=True)
class MazePlanning:
    """How agents plan and act. The paper's names are in brackets.

    Attributes:
        samples: candidate action sequences per iteration (D).
        elites: of which the best are kept (D*).
        iterations: iterations of the search for actions.
        horizon: model steps that a plan looks ahead (H).
        initial: first distribution of actions: uniform over the box, normal (the paper's), or
            uniform with x >= 0 (a hint of the original code that the goal is to the right).
        keep_elites: best candidates that compete again in the next iteration.
        warm_start: begin each step's search around the rest of the last plan.
        blur: standard deviation of a Gaussian blur of frames before they are compared, pixels.
        over_horizon: predicted frames that count: the last (the paper's), their sum or minimum.
        cost: what they cost: pixel distance to the goal (the paper's), distance in the CVAE's
            latent, or learned temporal distance; the latter two for learned models only.
        subgoal_samples: subgoal samples per iteration (M).
        subgoal_elites: of which the best are kept (M*).
        subgoal_iterations: iterations of the search for subgoals.
        reduction: cost of a sample over its segments: the maximum (the paper's) or the mean.
        steps: steps of a trial (T).
        steps_per_subgoal: most steps towards one subgoal (T*).
        threshold: cost below which a subgoal counts as reached.
        reached: which cost that is: of the observed frame, or planned.
    """

    samples: int = 200
    elites: int = 40
    iterations: int = 5
    horizon: int = 5
    initial: Literal["uniform", "normal", "rightward"] = "uniform"
    keep_elites: int = 0
    warm_start: bool = False
    blur: float = 3.0
    over_horizon: Literal["last", "sum", "min"] = "min"
    cost: Literal["pixel", "latent", "temporal"] = "pixel"
    subgoal_samples: int = 100
    subgoal_elites: int = 20
    subgoal_iterations: int = 5
    reduction: Literal["max", "mean"] = "max"
    steps: int = 50
    steps_per_subgoal: int = 10
    threshold: float = 1e-3
    reached: Literal["observed", "planned"] = "observed"

    def __post_init__(self) -> None:
        # The planners and the world check what is theirs.
        _ = self.acting
        self.search(1)
        hvf_core.MazeWorld(blur=self.blur, over_horizon=self.over_horizon)

    @classmethod
    def preset(cls, name: Preset) -> MazePlanning:
        """The settings called ``"default"``, or those of the paper.

        Raises:
            ValueError: for another name.
        """
        if name == "default":
            return cls()
        if name == "paper":
            return cls(
                initial="normal",
                blur=0.0,
                over_horizon="last",
                subgoal_samples=200,
                subgoal_elites=40,
            )
        raise ValueError(f"preset: must be 'default' or 'paper', got {name!r}")

    @property
    def acting(self) -> Acting:
        """The rule of acting."""
        return Acting(self.steps, self.steps_per_subgoal, self.threshold, self.reached)

    @property
    def mpc(self) -> hvf_core.VisualMPC:
        """Search for actions."""
        if self.initial not in ("uniform", "normal", "rightward"):
            raise ValueError(
                f"initial: must be 'uniform', 'normal' or 'rightward', got {self.initial!r}"
            )
        rightward = self.initial == "rightward"
        return hvf_core.VisualMPC(
            horizon=self.horizon,
            samples=self.samples,
            elites=self.elites,
            iterations=self.iterations,
            initial="normal" if self.initial == "normal" else "uniform",
            initial_low=(0.0, -hvf_core.MAZE_ACTION_LIMIT) if rightward else None,
            keep_elites=self.keep_elites,
        )

    def search(self, subgoals: int) -> hvf_core.HVF:
        """Search for subgoals."""
        return hvf_core.HVF(
            mpc=self.mpc,
            subgoals=subgoals,
            samples=self.subgoal_samples,
            elites=self.subgoal_elites,
            iterations=self.subgoal_iterations,
            reduction=self.reduction,
        )


@dataclasses.dataclass(frozen=True)
class MazeEvaluation:
    """One cell of the results: an agent, a world to plan with, a difficulty.

    Attributes:
        agent: "hvf" searches for subgoals; "none" is visual foresight, straight to the goal;
            "ground-truth" gets the gaps as subgoals; "random" acts at random.
        subgoals: number of subgoals (K) of hvf and ground-truth.
        difficulty: walls to pass: easy 0, medium 1, hard 2.
        model: what is planned with: learned models, or the true simulator.
        generator: what draws subgoals for hvf: "keypoint" and "cvae" are learned, "oracle" draws
            the true agent; "default" is "keypoint" for learned models, "oracle" for the simulator.
        dynamics: checkpoint of the learned dynamics; None for the shipped one.
        keypoint_generator: checkpoint of the keypoint generator; None for the shipped one.
        cvae: checkpoint of the CVAE; None for the shipped one.
        temporal_distance: checkpoint of the temporal distance; None for the shipped one.
        seed: seed of the episodes and of all planning.
        planning: how agents plan and act.
    """

    agent: AgentName = "hvf"
    subgoals: int = 2
    difficulty: Difficulty = "hard"
    model: ModelName = "learned"
    generator: GeneratorName = "default"
    dynamics: Path | None = None
    keypoint_generator: Path | None = None
    cvae: Path | None = None
    temporal_distance: Path | None = None
    seed: int = TEST_SEED
    planning: MazePlanning = MazePlanning()

    def __post_init__(self) -> None:
        for name, kind in (("agent", AgentName), ("difficulty", Difficulty)):
            value, allowed = getattr(self, name), get_args(kind)
            if value not in allowed:
                raise ValueError(f"{name}: must be one of {', '.join(allowed)}, got {value!r}")
        _ = self.world
        if self.subgoals < 0:
            raise ValueError(f"subgoals: must not be negative, got {self.subgoals}")
        if not 0 <= self.seed < 2**64:
            raise ValueError(f"seed: must be from 0 to 2**64 - 1, got {self.seed}")

    @classmethod
    def of(cls, preset: Preset = "default", **settings: Any) -> MazeEvaluation:
        """An evaluation from settings of both dataclasses, beginning with a preset.

        ``MazeEvaluation.of("paper", agent="none", horizon=10)``

        Raises:
            TypeError: for a setting that there is not.
        """
        own = {field.name for field in dataclasses.fields(cls)}
        mine = {name: value for name, value in settings.items() if name in own}
        rest = {name: value for name, value in settings.items() if name not in own}
        planning = mine.pop("planning", MazePlanning.preset(preset))
        return cls(planning=dataclasses.replace(planning, **rest), **mine)

    @property
    def name(self) -> str:
        """What is evaluated, in a few words."""
        agents = {
            "hvf": f"HVF-{self.subgoals}",
            "none": "no subgoals",
            "ground-truth": f"ground truth-{self.subgoals}",
            "random": "random",
        }
        world = "" if self.agent == "random" else f", {self.model}"
        if self.agent == "hvf" and self.generator != "default":
            world += f" ({self.generator})"
        if self.planning.cost != "pixel":
            world += f", {self.planning.cost} cost"
        return f"maze {self.difficulty}: {agents[self.agent]}{world}"

    @property
    def world(self) -> MazeWorldConfig:
        """What to plan with."""
        return MazeWorldConfig(
            model=self.model,
            generator=self.generator,
            blur=self.planning.blur,
            over_horizon=self.planning.over_horizon,
            cost=self.planning.cost,
            dynamics=self.dynamics,
            keypoint_generator=self.keypoint_generator,
            cvae=self.cvae,
            temporal_distance=self.temporal_distance,
        )

    def task(self) -> MazeTask:
        """Load what it needs.

        Raises:
            FileNotFoundError: models that are not there.
        """
        return MazeTask(self)


class MazeTrials:
    """Episodes ``first..first + count`` of a seed, side by side, stepped by the Rust simulator.

    Attributes:
        states: where they are, float64 ``[B, 4]``.
        targets: where they should be, float64 ``[B, 2]``.
    """

    def __init__(
        self, seed: int, first: int, count: int, difficulty: Difficulty, image_size: int = 64
    ) -> None:
        self.image_size = image_size
        self.states, self.targets = hvf_core.maze_episodes(seed, first, count, difficulty)
        self._goals = self._render(np.concatenate([self.targets, self.states[:, 2:]], axis=1))

    @property
    def goals(self) -> Images:
        """Goal images, uint8 ``[B, S, S, 3]``."""
        return self._goals

    def __len__(self) -> int:
        """Return the number of episodes, ``B``."""
        return len(self.states)

    def observe(self, which: Indices) -> Images:
        """Return images of the scenes now."""
        return self._render(self.states[which])

    def step(self, which: Indices, actions: NDArray[np.float32]) -> None:
        """Apply ``actions[N, 2]`` for half a second."""
        self.states[which] = hvf_core.maze_step(self.states[which], actions)

    def success(self, which: Indices) -> NDArray[np.bool_]:
        """Return whether agents are within 0.05 m of their targets."""
        return hvf_core.maze_success(self.states[which], self.targets[which])

    def true_subgoals(self, count: int) -> Images:
        """Return images of the agent in the gaps that it has to pass, ``[B, count, S, S, 3]``."""
        states = hvf_core.maze_subgoals(self.states, self.targets, count)
        images = self._render(states.reshape(-1, 4))
        return images.reshape(len(self), count, *images.shape[1:])

    def _render(self, states: NDArray[np.float64]) -> Images:
        return hvf_core.maze_render(states, self.image_size)


class MazeTask:
    """An evaluation with its models loaded; see :class:`hvf.evaluation.evaluate.Task`."""

    def __init__(self, evaluation: MazeEvaluation) -> None:
        self.evaluation = evaluation
        self.world, self.generator = load_maze(evaluation.world)
        planning = evaluation.planning
        self.agent: PlanningAgent | RandomAgent
        if evaluation.agent == "random":
            self.agent = RandomAgent(self.world.action_low, self.world.action_high)
        else:
            source: SubgoalSource = NoSubgoals()
            if evaluation.agent == "hvf" and evaluation.subgoals:
                search = planning.search(evaluation.subgoals)
                source = SearchedSubgoals(search, self.world, self.generator)
            elif evaluation.agent == "ground-truth":
                source = TrueSubgoals(evaluation.subgoals)
            self.agent = PlanningAgent(self.world, planning.mpc, source, planning.warm_start)

    @property
    def name(self) -> str:
        """What is evaluated."""
        return self.evaluation.name

    @property
    def config(self) -> Mapping[str, Any]:
        """All settings, and checksums of learned weights; JSON's types."""
        settings = dataclasses.asdict(self.evaluation)
        for name in _CHECKPOINTS:
            settings[name] = None if settings[name] is None else str(settings[name])
        return {**settings, "sha256": _checksums(self.evaluation.world)}

    def trials(self, first: int, count: int) -> MazeTrials:
        """Fresh trials of episodes ``first..first + count``."""
        return MazeTrials(self.evaluation.seed, first, count, self.evaluation.difficulty)

    def seeds(self, first: int, count: int) -> list[int]:
        """Seeds of the planning in these episodes."""
        return [derived_seed(self.evaluation.seed, index) for index in range(first, first + count)]

    def run(self, first: int, count: int) -> Outcome:
        """Run episodes ``first..first + count``."""
        return act(
            self.trials(first, count),
            self.agent,
            self.evaluation.planning.acting,
            self.seeds(first, count),
        )


def _checksums(world: MazeWorldConfig) -> dict[str, str]:
    """SHA-256 of the checkpoints that a world may be made of; none for a simulator."""
    if world.model == "simulator" and world.generator in ("default", "oracle"):
        return {}
    paths = {
        name: getattr(world, name) or WEIGHTS / f"maze_{name}.safetensors" for name in _CHECKPOINTS
    }
    return {
        name: hashlib.sha256(path.read_bytes()).hexdigest()
        for name, path in paths.items()
        if path.exists()
    }
