"""What the maze environments share: their settings, episodes, rewards and pictures."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, cast, get_args

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

import hvf_core
from hvf.envs.goals import checked_goals
from hvf.envs.maze.layouts import LayoutLike, layout_of

Image: TypeAlias = NDArray[np.uint8]
Actions: TypeAlias = NDArray[np.float32]
States: TypeAlias = NDArray[np.float64]
Difficulty: TypeAlias = Literal["easy", "medium", "hard"]
Reward: TypeAlias = Literal["sparse", "dense"]

RENDER_MODES = ("human", "rgb_array")
RENDER_SIZE = 256
RENDER_FPS = 2
"""Real time: a step lasts half a second."""


@dataclass(frozen=True)
class MazeTask:
    """Settings of a maze environment.

    Attributes:
        difficulty: How many gaps lie between start and target: ``"easy"`` none, ``"medium"`` one,
            ``"hard"`` two.
        image_size: Width and height ``S`` of observations, pixels, 8 to 2048.
        reward: ``"sparse"``: 1 in the step that brings the agent within 0.05 m of the target,
            else 0. ``"dense"``: minus the distance to the target, m.
        render_mode: None, ``"rgb_array"`` or ``"human"``.
        goal_observation: Whether observations are dicts for goal-conditioned learners.
        layout: Walls, start and goal: None for the paper's maze at this difficulty, or a layout, a
            name (``"corridor-4"``, ``"u-maze"``, ``"spiral"``) or a TOML file; see
            :func:`hvf.envs.maze.layouts.layout_of`.

    Raises:
        ValueError: for a value that is none of these, or a difficulty of another layout.
        TypeError: for an image size that is no integer.
        FileNotFoundError: for a layout file that is not there.
    """

    difficulty: Difficulty = "hard"
    image_size: int = 64
    reward: Reward = "sparse"
    render_mode: str | None = None
    goal_observation: bool = False
    layout: LayoutLike | None = None

    def __post_init__(self) -> None:
        _choice("difficulty", self.difficulty, Difficulty)
        if self.layout is not None:
            object.__setattr__(self, "layout", layout_of(self.layout))
            if self.difficulty != "hard":
                raise ValueError(
                    f"difficulty: is of the paper's maze; layout {self.walls.name!r} says itself "
                    "where episodes start and aim"
                )
        _choice("reward", self.reward, Reward)
        if self.render_mode is not None and self.render_mode not in RENDER_MODES:
            raise ValueError(
                f"render_mode: must be None or one of {RENDER_MODES}, got {self.render_mode!r}"
            )
        self.observe(np.zeros((0, self.columns)))

    @property
    def walls(self) -> hvf_core.MazeLayout:
        """The layout, that of the paper's maze included."""
        return layout_of(self.difficulty if self.layout is None else self.layout)

    @property
    def _layout(self) -> hvf_core.MazeLayout | None:
        return cast("hvf_core.MazeLayout | None", self.layout)

    @property
    def columns(self) -> int:
        """Numbers of a state, ``S``: ``x``, ``y`` and one for each gap."""
        return 4 if self._layout is None else self._layout.columns

    @property
    def observation_space(self) -> spaces.Space[Any]:
        """Images, uint8 ``[S, S, 3]``, or dicts of those and of two goals, m."""
        image = spaces.Box(0, 255, (self.image_size, self.image_size, 3), np.uint8)
        if not self.goal_observation:
            return image
        arena = np.array(self.walls.arena)
        place = spaces.Box(-arena, arena, (2,), np.float64)
        return spaces.Dict({"observation": image, "achieved_goal": place, "desired_goal": place})

    @property
    def action_space(self) -> spaces.Space[Actions]:
        """Forces in units of 0.05 N, float32 ``[2]`` in ``[-3, 3]``."""
        limit = hvf_core.MAZE_ACTION_LIMIT
        return cast("spaces.Space[Actions]", spaces.Box(-limit, limit, (2,), np.float32))

    def observe(self, states: States) -> Image:
        """Images of ``states[N, 4]``: uint8 ``[N, S, S, 3]``."""
        return hvf_core.maze_render(states, self.image_size, self._layout)

    def step(self, states: States, actions: Actions) -> States:
        """States after half a second of ``actions[N, 2]``."""
        return hvf_core.maze_step(states, actions, self._layout)

    def success(self, states: States, targets: States) -> NDArray[np.bool_]:
        """Whether agents are within 0.05 m of ``targets[N, 2]``: bool ``[N]``."""
        return hvf_core.maze_success(states, targets, self._layout)

    def observations(self, states: States, targets: States) -> Any:
        """What is observed of ``states[N, 4]`` with ``targets[N, 2]``, a batch of the space's."""
        images = self.observe(states)
        if not self.goal_observation:
            return images
        return {
            "observation": images,
            "achieved_goal": states[:, :2].copy(),
            "desired_goal": targets.copy(),
        }

    def distances(self, states: States, targets: States) -> States:
        """Distances of ``states[N, 4]`` to ``targets[N, 2]``, m: float64 ``[N]``."""
        x, y = (states[:, :2] - targets).T
        return cast(States, np.hypot(x, y))

    def rewards(self, success: NDArray[np.bool_], distances: States) -> States:
        """Rewards ``[N]`` of steps that ended in success or not, at these distances."""
        return success.astype(np.float64) if self.reward == "sparse" else -distances

    def episode(
        self, seed: int, index: int, options: Mapping[str, Any] | None
    ) -> tuple[States, States]:
        """Start ``[4]`` and target ``[2]`` of an episode, or what ``options`` put in its place.

        Args:
            seed: Seed of the environment.
            index: Number of the episode since that seed was set.
            options: May hold ``"state"`` ``(x, y, w1, w2)`` (or a layout's), ``"target"``
                ``(x, y)`` and ``"episode"`` (another index), in metres. The agent is put where it
                can stand.

        Raises:
            ValueError: for other options, or values out of range.
        """
        options = dict(options or {})
        index = options.pop("episode", index)
        starts, targets = (
            hvf_core.maze_episodes(seed, index, 1, self.difficulty)
            if self._layout is None
            else hvf_core.maze_episodes(seed, index, 1, layout=self._layout)
        )
        start, target = starts[0], targets[0]
        if "state" in options:
            start = self._legal("options['state']", options.pop("state"))
        if "target" in options:
            position = _vector("options['target']", options.pop("target"), 2)
            target = self._legal("options['target']", [*position, *start[2:]])[:2]
        if options:
            raise ValueError(
                "options: may hold 'state', 'target' and 'episode', got also "
                + ", ".join(map(repr, options))
            )
        return start, target

    def rewards_of_goals(
        self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any
    ) -> np.float64 | NDArray[np.float64]:
        """Rewards of being at ``achieved_goal[..., 2]`` with the target at ``desired_goal``, m.

        What a step gives for its own two goals. ``info`` is not used.

        Raises:
            ValueError: for another shape, or places that are not finite.
        """
        achieved, desired = checked_goals(achieved_goal, desired_goal, 2)
        places, targets = achieved.reshape(-1, 2), desired.reshape(-1, 2)
        states = np.concatenate([places, np.zeros_like(places)], axis=1)
        success = hvf_core.maze_success(states, targets)
        rewards = self.rewards(success, self.distances(states, targets))
        return cast("np.float64 | NDArray[np.float64]", rewards.reshape(achieved.shape[:-1])[()])

    def goals(self, states: States, targets: States) -> Image:
        """Goal images: the scenes of ``states[N, 4]`` with the agent at ``targets[N, 2]``."""
        return self.observe(np.concatenate([targets, states[:, 2:]], axis=1))

    def pictures(self, states: States, targets: States) -> Image:
        """Pictures for people: scene and goal side by side, uint8 ``[N, S, 2 S + gap, 3]``."""
        goals = np.concatenate([targets, states[:, 2:]], axis=1)
        now = hvf_core.maze_render(states, RENDER_SIZE, self._layout)
        goal = hvf_core.maze_render(goals, RENDER_SIZE, self._layout)
        gap = np.full((len(now), RENDER_SIZE, 8, 3), 255, np.uint8)
        return np.concatenate([now, gap, goal], axis=2)

    def _legal(self, argument: str, value: ArrayLike) -> States:
        """A state, with the agent moved to where it can stand."""
        state = _vector(argument, value, self.columns)
        try:
            return np.ravel(self.step(state[None], np.zeros((1, 2), np.float32)))
        except ValueError as error:
            raise ValueError(f"{argument}: {error}") from error


def _choice(argument: str, value: str, choices: object) -> None:
    if value not in get_args(choices):
        raise ValueError(f"{argument}: must be one of {get_args(choices)}, got {value!r}")


def _vector(argument: str, value: ArrayLike, length: int) -> States:
    try:
        vector = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{argument}: expected {length} numbers, got {value!r}") from error
    if vector.shape != (length,):
        raise ValueError(f"{argument}: expected shape [{length}], got {list(vector.shape)}")
    return vector
