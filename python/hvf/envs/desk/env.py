"""The desk as a Gymnasium environment."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from numpy.typing import ArrayLike, NDArray

from hvf.envs.actions import checked_actions
from hvf.envs.desk.rendering import DeskRenderer, check_image_size
from hvf.envs.desk.scene import BLOCKS
from hvf.envs.desk.simulator import (
    ACTION_SIZE,
    DOOR,
    DRAWER,
    STATE_SIZE,
    STEP_SECONDS,
    DeskSimulator,
    DivergenceError,
    Floats,
    block_positions,
    end_effectors,
)
from hvf.envs.desk.simulator import BUTTONS as BUTTON_POSITIONS
from hvf.envs.desk.tasks import (
    DOOR_CLOSED,
    MAX_STEPS,
    OFF_TABLE,
    Episodes,
    TaskName,
    check_task,
    has_door,
    make_episodes,
    object_success,
)
from hvf.envs.goals import checked_goals
from hvf.envs.shown import Image, ShownEnv

RENDER_MODES = ("human", "rgb_array")
RENDER_SIZE = 256

_GOAL_LIMIT = 2.0
"""Openings and heights in goals are clipped to this, m; nothing on or off the desk gets so far."""


class DeskEnv(ShownEnv):
    """A Franka Panda at a desk with a sliding door, a drawer, three buttons and three cubes.

    The desk of Nair & Finn (2020), section 6.2, made with
    ``gymnasium.make("hvf/FrankaDesk-v0", task="door_two_block")``.

    * Observation: image of the scene, uint8 ``[S, S, 3]``. With ``goal_observation=True`` a dict
      as goal-conditioned learners with hindsight expect it: ``observation``, that image, and
      ``achieved_goal`` and ``desired_goal``, what success is asked of, float64 ``[4]`` in metres:
      how far the door is open and how high red, green and blue cube are; a goal asks for a door
      that is closed in it and for cubes that are off the table in it (the true state); and there
      is ``compute_reward``.
    * Action: velocity of the fingertip along x, y and z in units of 0.4 m/s, float32 ``[3]`` in
      ``[-1, 1]``; larger ones are clipped. One step lasts 0.2 s.
    * Reward: 1 in a step that ends in success, else 0.
    * Termination: success. The door is closed within 0.02 m; the task's cubes are off the table.
    * Truncation: after the task's number of steps, 50 or 100; or when the simulation diverged,
      which ``info["error"]`` then says (it is not there otherwise). Observation and state are
      those from before that step, and the reward is 0.
    * ``info``: ``state`` float64 ``[63]``, see :mod:`hvf.envs.desk.simulator`; ``end_effector``
      ``[3]``, ``door``, ``drawer``, ``buttons`` ``[3]``, ``blocks`` ``[3, 3]`` (m); ``goal``
      (goal image) and ``goal_state``; ``success``, and ``object_success`` with ``door`` and the
      cubes' colours (True for what the task does not ask for).

    After ``reset(seed=s)`` the first episode is number 0 of that seed, the one after the next
    ``reset()`` number 1, and so on. ``reset(options={"episode": 7})`` asks for another number,
    ``options={"state": state}`` for another start, such as a saved ``info["state"]``: the same
    actions then lead to the same states and images, bit for bit.

    Args:
        task: ``"door"``, ``"two_block"``, ``"door_block"`` or ``"door_two_block"``.
        image_size: Width and height ``S`` of observations, pixels, 8 to 1024.
        render_mode: None, ``"rgb_array"`` or ``"human"``.
        scene: MJCF file to use in place of the package's own scene.
        goal_observation: Whether observations are dicts, see above.

    Raises:
        ValueError: for a setting that is none of these, or a scene that cannot be read.
        TypeError: for an image size that is no integer.
        FileNotFoundError: for a scene file that is not there.
        RuntimeError: without OpenGL; names the Debian package to install.
    """

    title = "hvf/FrankaDesk-v0: scene and goal"
    metadata = {  # noqa: RUF012
        "render_modes": list(RENDER_MODES),
        "render_fps": round(1 / STEP_SECONDS),
    }

    def __init__(
        self,
        task: TaskName = "door",
        image_size: int = 64,
        render_mode: str | None = None,
        scene: str | Path | None = None,
        goal_observation: bool = False,
    ) -> None:
        check_task(task)
        check_image_size(image_size)
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise ValueError(
                f"render_mode: must be None or one of {RENDER_MODES}, got {render_mode!r}"
            )
        self.task: TaskName = task
        self.render_mode = render_mode
        self.simulator = DeskSimulator(scene)
        self._renderer = DeskRenderer(self.simulator.model, image_size)
        self._pictures: DeskRenderer | None = None
        shape = (image_size, image_size, 3)
        self.goal_observation = goal_observation
        self.observation_space = cast("spaces.Space[Any]", spaces.Box(0, 255, shape, np.uint8))
        if goal_observation:
            goal = spaces.Box(-_GOAL_LIMIT, _GOAL_LIMIT, (1 + len(BLOCKS),), np.float64)
            self.observation_space = spaces.Dict(
                {
                    "observation": self.observation_space,
                    "achieved_goal": goal,
                    "desired_goal": goal,
                }
            )
            # Learners take an environment that has this method for one with goals.
            self.compute_reward = self._compute_reward
        self.action_space = cast(
            "spaces.Space[NDArray[np.float32]]",
            spaces.Box(-1.0, 1.0, (ACTION_SIZE,), np.float32),
        )
        self._seed: int | None = None
        self._next_episode = 0
        self._number = 0
        self._steps = 0
        self._diverged = False
        self._episode: Episodes | None = None
        self._goal = np.zeros(shape, np.uint8)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start the next episode, or the first one of ``seed``.

        Raises:
            ValueError: for options other than ``"episode"`` (an index) and ``"state"`` (float64
                ``[63]``), or values out of range.
        """
        super().reset(seed=seed)
        options = dict(options or {})
        if seed is not None:
            self._seed, self._next_episode = seed, 0
        elif self._seed is None:
            self._seed = int(self.np_random.integers(2**63))
        number = options.pop("episode", self._next_episode)
        if isinstance(number, bool) or not isinstance(number, (int, np.integer)) or number < 0:
            raise ValueError(f"options['episode']: must be an index from 0 on, got {number!r}")
        start = options.pop("state", None)
        if options:
            raise ValueError(
                "options: may hold 'state' and 'episode', got also " + ", ".join(map(repr, options))
            )
        state = None if start is None else _checked_state(start)
        self._number = int(number)
        self._episode = make_episodes(self.simulator, self.task, self._seed, self._number, 1)
        self._next_episode += 1
        self._state = self._episode.starts if state is None else state[None]
        self._steps = 0
        self._diverged = False
        self._goal = self._renderer.render(self._episode.goals)[0]
        if self.render_mode == "human":
            self._show()
        return self._observe(), self._info()

    def step(self, action: NDArray[np.float32]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Move the fingertip for 0.2 s at the velocity ``action[3]``.

        Raises:
            ValueError: for another shape, or an action that is not finite.
            ResetNeeded: before the first ``reset``, or after an episode that diverged.
        """
        if self._state is None or self._diverged:
            raise ResetNeeded("call reset before step")
        actions = checked_actions(action, (ACTION_SIZE,))[None]
        try:
            self._state = self.simulator.step(self._state, actions)
        except DivergenceError:
            self._diverged = True
            where = f"seed {self._seed}, episode {self._number}, step {self._steps}"
            info = {**self._info(), "error": f"the simulation diverged: {where}"}
            return self._observe(), 0.0, False, True, info
        self._steps += 1
        info = self._info()
        if self.render_mode == "human":
            self._show()
        truncated = self._steps >= MAX_STEPS[self.task]
        return self._observe(), float(info["success"]), info["success"], truncated, info

    def _compute_reward(
        self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any
    ) -> np.float64 | NDArray[np.float64]:
        """Rewards of ``achieved_goal[..., 4]`` where ``desired_goal`` was wanted.

        What :meth:`step` gives for its own two goals. A goal that asks for nothing is reached.
        ``info`` is not used.

        Raises:
            ValueError: for another shape, or goals that are not finite.
        """
        achieved, desired = checked_goals(achieved_goal, desired_goal, 1 + len(BLOCKS))
        below = np.array([DOOR_CLOSED, *[OFF_TABLE] * len(BLOCKS)])
        asked = np.less(desired, below)
        asked[..., 0] &= has_door(self.task)
        reached = (~asked | (achieved < below)).all(axis=-1)
        rewards: NDArray[np.float64] = np.asarray(reached, np.float64)
        return cast("np.float64 | NDArray[np.float64]", rewards[()])

    def close(self) -> None:
        """Close the window and give back what OpenGL holds."""
        super().close()
        self._renderer.close()
        if self._pictures is not None:
            self._pictures.close()

    def _picture(self) -> Image:
        assert self._state is not None
        assert self._episode is not None
        if self._pictures is None:
            self._pictures = DeskRenderer(self.simulator.model, RENDER_SIZE)
        now, goal = self._pictures.render(np.concatenate([self._state, self._episode.goals]))
        gap = np.full((RENDER_SIZE, 8, 3), 255, np.uint8)
        return np.concatenate([now, gap, goal], axis=1)

    def _observe(self) -> Image | dict[str, NDArray[Any]]:
        assert self._state is not None
        assert self._episode is not None
        image: Image = self._renderer.render(self._state)[0]
        if not self.goal_observation:
            return image
        return {
            "observation": image,
            "achieved_goal": _goal_of(self._state),
            "desired_goal": _goal_of(self._episode.goals),
        }

    def _info(self) -> dict[str, Any]:
        assert self._state is not None
        assert self._episode is not None
        done = object_success(self.task, self._episode.blocks, self._state)[0]
        state = self._state[0]
        return {
            "state": state.copy(),
            "end_effector": end_effectors(self._state)[0],
            "door": float(state[DOOR]),
            "drawer": float(state[DRAWER]),
            "buttons": state[BUTTON_POSITIONS].copy(),
            "blocks": block_positions(self._state)[0].copy(),
            "goal": self._goal.copy(),
            "goal_state": self._episode.goals[0].copy(),
            "success": bool(done.all()),
            "object_success": dict(zip(("door", *BLOCKS), done.tolist(), strict=True)),
        }


def _goal_of(states: Floats) -> Floats:
    """What success is asked of in the first state, ``[4]``."""
    found = np.concatenate([states[0, DOOR, None], block_positions(states)[0, :, 2]])
    goal: Floats = np.clip(found, -_GOAL_LIMIT, _GOAL_LIMIT)
    return goal


def _checked_state(value: ArrayLike) -> Floats:
    try:
        state = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"options['state']: expected {STATE_SIZE} numbers") from error
    if state.shape != (STATE_SIZE,):
        raise ValueError(
            f"options['state']: expected shape [{STATE_SIZE}], got {list(state.shape)}"
        )
    if not np.isfinite(state).all():
        raise ValueError("options['state']: must be finite")
    return state
