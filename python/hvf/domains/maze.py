"""The maze of Nair & Finn (2020), section 6.1: two walls with a gap each, simulated in Rust.

Its tasks are the paper's three difficulties, and layouts (:mod:`hvf.envs.maze.layouts`): other
walls, starts and targets, by name or from a TOML file.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

import hvf_core
from hvf.domains.domain import Domain, Place
from hvf.domains.weights import WEIGHTS
from hvf.envs.maze.layouts import NAMES, LayoutLike, fingerprint, layout_of
from hvf.protocols import Images, Indices, SubgoalModel, WorldModel
from hvf.settings import Planning, Preset, World

STEPS = 50
"""Steps of an episode, ``T``."""


class MazeTrials:
    """Episodes ``first..first + count`` of a seed, side by side, stepped by the Rust simulator.

    Attributes:
        layout: walls, where they start and aim.
        states: where they are, float64 ``[B, 4]``, or as many numbers as a layout's states have.
        targets: where they should be, float64 ``[B, 2]``.
    """

    def __init__(
        self,
        seed: int,
        first: int,
        count: int,
        layout: LayoutLike,
        image_size: int = 64,
    ) -> None:
        self.image_size = image_size
        self.layout = layout_of(layout)
        self.states, self.targets = hvf_core.maze_episodes(seed, first, count, layout=self.layout)
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
        self.states[which] = hvf_core.maze_step(self.states[which], actions, self.layout)
        return {}

    def success(self, which: Indices) -> NDArray[np.bool_]:
        """Return whether agents are within 0.05 m of their targets."""
        return hvf_core.maze_success(self.states[which], self.targets[which], self.layout)

    def true_subgoals(self, count: int) -> Images:
        """Return images of the agent on its way, ``[B, count, S, S, 3]``.

        In the gaps that it has to pass; in a layout at turns of the shortest way.
        """
        states = hvf_core.maze_subgoals(self.states, self.targets, count, self.layout)
        images = self._render(states.reshape(-1, states.shape[-1]))
        return images.reshape(len(self), count, *images.shape[1:])

    def positions(self, which: Indices) -> NDArray[np.float64]:
        """Return where agents are in the images now, pixels, ``[N, 2]``."""
        return self._pixels(self.states[which])

    def target(self, trial: int) -> tuple[float, float, float]:
        """Return the disc in which a trial's agent should end, pixels."""
        column, row = self._pixels(self.targets[trial][None])[0]
        radius = hvf_core.MAZE_SUCCESS_DISTANCE * self.image_size / (2 * hvf_core.MAZE_VIEW)
        return float(column), float(row), radius

    def _pixels(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        view = hvf_core.MAZE_VIEW
        right, down = places[:, 0] + view, view - places[:, 1]
        return np.stack([right, down], axis=1) * self.image_size / (2 * view) - 0.5

    def _render(self, states: NDArray[np.float64]) -> Images:
        return hvf_core.maze_render(states, self.image_size, self.layout)


class Maze(Place):
    """The maze, ready: nothing to start.

    Args:
        layout: of the true dynamics; None for the paper's.
    """

    def __init__(self, layout: hvf_core.MazeLayout | None = None) -> None:
        self._layout = layout

    def trials(self, task: str, seed: int, first: int, count: int) -> MazeTrials:
        """Fresh trials; the task is the difficulty, or a layout."""
        return MazeTrials(seed, first, count, task)

    def of_task(self, task: str) -> Maze:
        """The maze in the layout of a task."""
        return Maze(layout_of(task))

    def simulator(self, planning: Planning) -> WorldModel[Any]:
        """The true maze, in Rust."""
        return hvf_core.MazeWorld(
            blur=planning.blur, over_horizon=planning.over_horizon, layout=self._layout
        )

    def oracle(self) -> SubgoalModel[Any]:
        """What draws the agent at true positions."""
        return hvf_core.MazeSubgoals(layout=self._layout)


class Layouts:
    """Tasks that are layouts (:class:`hvf.domains.domain.MoreTasks`)."""

    option = "layout"
    about = f"layouts: {NAMES} (N from 1 to 7), or a TOML file"

    def steps(self, task: str) -> int:
        """As many as in the paper's maze, of any layout that there is."""
        try:
            layout_of(task)
        except ValueError as error:
            # A file says itself what is wrong with it.
            if task.endswith(".toml"):
                raise
            raise ValueError(
                f"task: must be one of {NAMES} (N from 1 to 7), or a TOML file; got {task!r}"
            ) from error
        return STEPS

    def parts(self, task: str) -> Mapping[str, str]:
        """The layout, and what it is where it is read from a file."""
        return {"layout": fingerprint(layout_of(task))}


_OBJECTS = World("keypoint")
_PAPER = Planning(initial="normal")
_DEFAULT = Planning(blur=3.0, over_horizon="min", subgoal_samples=100, subgoal_elites=20)

MAZE = Domain(
    name="maze",
    about="a square is pushed through the gaps of two walls (paper, section 6.1)",
    open_with=lambda workers: Maze(),
    action_low=(-hvf_core.MAZE_ACTION_LIMIT,) * 2,
    action_high=(hvf_core.MAZE_ACTION_LIMIT,) * 2,
    tasks={"easy": STEPS, "medium": STEPS, "hard": STEPS},
    more_tasks=Layouts(),
    task_word="difficulty",
    presets={
        "default": Preset(
            _DEFAULT, _OBJECTS, "blurred frames, the nearest of the horizon, uniform actions first"
        ),
        "paper": Preset(
            _PAPER,
            World("keypoint", "cvae"),
            "as published: last frame, no blur, actions from N(0, 1) first, images by the CVAE",
        ),
        "released": Preset(
            dataclasses.replace(
                _PAPER,
                initial="uniform",
                initial_low=(0.0, -hvf_core.MAZE_ACTION_LIMIT),
                clip=False,
                best="last",
                # Mean squared error below 2 of 255, per colour.
                threshold=3 * 2.0 / 255**2,
            ),
            World("keypoint", "cvae"),
            "as the authors' code: actions to the right first, no clipping, best of the last round",
        ),
    },
    weights={
        "keypoint": WEIGHTS / "maze_dynamics.safetensors",
        "keypoint-generator": WEIGHTS / "maze_keypoint_generator.safetensors",
        "cvae": WEIGHTS / "maze_cvae.safetensors",
        "temporal-distance": WEIGHTS / "maze_temporal_distance.safetensors",
        "latent": WEIGHTS / "maze_latent.safetensors",
    },
    generators={"keypoint": "keypoint-generator", "simulator": "oracle", "latent": "cvae"},
    video_generator="cvae",
    distances={"keypoint": "temporal-distance"},
    # Pixel cost without subgoals, and numbers of subgoals on hard. Their other results are in a
    # bar chart only.
    published={
        ("none", 0): {"easy": 0.93, "medium": 0.68, "hard": 0.33},
        ("hvf", 1): {"hard": 0.47},
        ("hvf", 2): {"hard": 0.54},
    },
    collection="hvf.domains.maze_collection:MazeCollection",
    experiments="hvf.experiments.maze:maze",
    groups={"agent": slice(0, 2), "gaps": slice(2, None)},
)
