"""The maze: its episodes as trials, its settings."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

import hvf_core
from hvf.evaluation.acting import Images, Indices
from hvf.evaluation.task import EpisodeTask, Evaluation
from hvf.settings import Acting, OverHorizon, Planning
from hvf.worlds import WEIGHTS, MazeWorldConfig, load_maze

_CHECKPOINTS = ("dynamics", "keypoint_generator", "cvae", "temporal_distance")

Difficulty: TypeAlias = Literal["easy", "medium", "hard"]
ModelName: TypeAlias = Literal["learned", "simulator"]
GeneratorName: TypeAlias = Literal["default", "keypoint", "cvae", "oracle"]
Preset: TypeAlias = Literal["default", "paper"]


@dataclasses.dataclass(frozen=True)
class MazePlanning(Planning):
    """How agents plan and act in the maze; see :class:`~hvf.settings.Planning`.

    Attributes:
        initial: first distribution of actions: uniform over the box, normal (the paper's), or
            uniform with x >= 0 (a hint of the original code that the goal is to the right).
        cost: what predicted frames cost: pixel distance to the goal (the paper's), distance in the
            CVAE's latent, or learned temporal distance; the latter two for learned models only.
        steps: steps of a trial (T).
    """

    initial: Literal["uniform", "normal", "rightward"] = "uniform"
    blur: float = 3.0
    over_horizon: OverHorizon = "min"
    cost: Literal["pixel", "latent", "temporal"] = "pixel"
    subgoal_samples: int = 100
    subgoal_elites: int = 20
    steps: int = 50

    def __post_init__(self) -> None:
        if self.initial not in ("uniform", "normal", "rightward"):
            raise ValueError(
                f"initial: must be 'uniform', 'normal' or 'rightward', got {self.initial!r}"
            )
        super().__post_init__()
        _ = self.acting
        # The world checks what is its own.
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
        return self.rule(self.steps)

    def _actions(self) -> dict[str, Any]:
        rightward = self.initial == "rightward"
        return {
            "initial": "normal" if self.initial == "normal" else "uniform",
            "initial_low": (0.0, -hvf_core.MAZE_ACTION_LIMIT) if rightward else None,
        }


@dataclasses.dataclass(frozen=True)
class MazeEvaluation(Evaluation):
    """One cell of the results: an agent, a world to plan with, a difficulty.

    The ground-truth subgoals are the agent in the gaps that it has to pass.

    Attributes:
        difficulty: walls to pass: easy 0, medium 1, hard 2.
        model: what is planned with: learned models, or the true simulator.
        generator: what draws subgoals for hvf: "keypoint" and "cvae" are learned, "oracle" draws
            the true agent; "default" is "keypoint" for learned models, "oracle" for the simulator.
        dynamics: checkpoint of the learned dynamics; None for the shipped one.
        keypoint_generator: checkpoint of the keypoint generator; None for the shipped one.
        cvae: checkpoint of the CVAE; None for the shipped one.
        temporal_distance: checkpoint of the temporal distance; None for the shipped one.
        planning: how agents plan and act.
    """

    presets: ClassVar[Mapping[str, Planning]] = {
        name: MazePlanning.preset(name) for name in get_args(Preset)
    }

    difficulty: Difficulty = "hard"
    model: ModelName = "learned"
    generator: GeneratorName = "default"
    dynamics: Path | None = None
    keypoint_generator: Path | None = None
    cvae: Path | None = None
    temporal_distance: Path | None = None
    planning: MazePlanning = MazePlanning()

    def __post_init__(self) -> None:
        super().__post_init__()
        allowed = get_args(Difficulty)
        if self.difficulty not in allowed:
            words = ", ".join(allowed)
            raise ValueError(f"difficulty: must be one of {words}, got {self.difficulty!r}")
        _ = self.world

    @property
    def name(self) -> str:
        """What is evaluated, in a few words."""
        world = "" if self.agent == "random" else f", {self.model}"
        if self.agent == "hvf" and self.generator != "default":
            world += f" ({self.generator})"
        if self.planning.cost != "pixel":
            world += f", {self.planning.cost} cost"
        return f"maze {self.difficulty}: {self.agent_name}{world}"

    @property
    def acting(self) -> Acting:
        """The rule of acting."""
        return self.planning.acting

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

    def step(self, which: Indices, actions: NDArray[np.float32]) -> dict[int, str]:
        """Apply ``actions[N, 2]`` for half a second; nothing can go wrong."""
        self.states[which] = hvf_core.maze_step(self.states[which], actions)
        return {}

    def success(self, which: Indices) -> NDArray[np.bool_]:
        """Return whether agents are within 0.05 m of their targets."""
        return hvf_core.maze_success(self.states[which], self.targets[which])

    def true_subgoals(self, count: int) -> Images:
        """Return images of the agent in the gaps that it has to pass, ``[B, count, S, S, 3]``."""
        states = hvf_core.maze_subgoals(self.states, self.targets, count)
        images = self._render(states.reshape(-1, 4))
        return images.reshape(len(self), count, *images.shape[1:])

    def positions(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where agents in ``states[N, 4]`` are in the images, pixels, ``[N, 2]``."""
        view = hvf_core.MAZE_VIEW
        right, down = states[:, 0] + view, view - states[:, 1]
        return np.stack([right, down], axis=1) * self.image_size / (2 * view) - 0.5

    def target(self, trial: int) -> tuple[float, float, float]:
        """Return the disc in which a trial's agent should end, pixels."""
        column, row = self.positions(self.targets[trial][None])[0]
        radius = hvf_core.MAZE_SUCCESS_DISTANCE * self.image_size / (2 * hvf_core.MAZE_VIEW)
        return float(column), float(row), radius

    def _render(self, states: NDArray[np.float64]) -> Images:
        return hvf_core.maze_render(states, self.image_size)


class MazeTask(EpisodeTask[MazeTrials]):
    """An evaluation in the maze with its models loaded."""

    evaluation: MazeEvaluation

    def __init__(self, evaluation: MazeEvaluation) -> None:
        world, generator = load_maze(evaluation.world)
        super().__init__(evaluation, world, generator, _checkpoints(evaluation.world))

    def trials(self, first: int, count: int) -> MazeTrials:
        """Fresh trials of episodes ``first..first + count``."""
        evaluation = self.evaluation
        return MazeTrials(evaluation.seed, first, count, evaluation.difficulty)


def _checkpoints(world: MazeWorldConfig) -> dict[str, Path]:
    """The checkpoints that a world may be made of; none for a simulator."""
    if world.model == "simulator" and world.generator in ("default", "oracle"):
        return {}
    return {
        name: getattr(world, name) or WEIGHTS / f"maze_{name}.safetensors" for name in _CHECKPOINTS
    }
