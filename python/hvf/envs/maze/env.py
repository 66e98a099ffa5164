"""The maze as a Gymnasium environment."""

from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from hvf.envs.actions import checked_actions
from hvf.envs.maze.layouts import LayoutLike
from hvf.envs.maze.task import (
    RENDER_FPS,
    RENDER_MODES,
    Difficulty,
    MazeTask,
    Reward,
)
from hvf.envs.shown import Image, ShownEnv


class MazeEnv(ShownEnv):
    """Push a square through the gaps of two walls to where a goal image shows it.

    The maze of Nair & Finn (2020), section 6.1, made with ``gymnasium.make("hvf/Maze-v0")``,
    which also ends episodes after 50 steps.

    * Observation: image of the scene, uint8 ``[S, S, 3]``. The target is never drawn. With
      ``goal_observation=True`` a dict as goal-conditioned learners with hindsight expect it:
      ``observation``, that image, and ``achieved_goal`` and ``desired_goal``, where agent and
      target are, float64 ``[2]`` in metres (the true state); and there is ``compute_reward``.
    * Action: force on the agent, float32 ``[2]`` in ``[-3, 3]``; larger ones are clipped. One
      step lasts 0.5 s from rest and moves a free agent 0.0495 m per unit.
    * Reward: 1 on success, else 0 (``reward="sparse"``), or minus the distance to the target in
      metres (``"dense"``).
    * Termination: success, the agent's centre within 0.05 m of the target.
    * ``info``: ``state`` float64 ``[4]`` (x, y and the ``y`` of both gaps, m; in a layout ``x``,
      ``y`` and where its gaps are), ``target``
      ``[2]``, ``goal`` (goal image), ``success``, ``distance`` (m).

    With ``layout="corridor-4"``, ``"u-maze"``, ``"spiral"``, a TOML file or a
    :class:`hvf_core.MazeLayout` walls, starts and targets are others
    (:mod:`hvf.envs.maze.layouts`).

    After ``reset(seed=s)`` the first episode is ``hvf_core.maze_episodes(s, 0, 1, difficulty)``,
    the one after the next ``reset()`` has index 1, and so on.
    ``reset(options={"state": ..., "target": ..., "episode": ...})`` asks for something else, see
    :meth:`MazeTask.episode`.
    """

    title = "hvf/Maze-v0: scene and goal"
    metadata = {"render_modes": list(RENDER_MODES), "render_fps": RENDER_FPS}  # noqa: RUF012

    def __init__(
        self,
        difficulty: Difficulty = "hard",
        image_size: int = 64,
        reward: Reward = "sparse",
        render_mode: str | None = None,
        goal_observation: bool = False,
        layout: LayoutLike | None = None,
    ) -> None:
        self.task = MazeTask(difficulty, image_size, reward, render_mode, goal_observation, layout)
        self.observation_space = self.task.observation_space
        if goal_observation:
            # Learners take an environment that has this method for one with goals.
            self.compute_reward = self.task.rewards_of_goals
        self.action_space = self.task.action_space
        self.render_mode = render_mode
        self._seed: int | None = None
        self._episode = 0
        self._target = np.zeros((1, 2))
        self._goal = np.zeros((image_size, image_size, 3), np.uint8)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start the next episode, or the first one of ``seed``.

        Raises:
            ValueError: for options that :meth:`MazeTask.episode` refuses.
        """
        super().reset(seed=seed)
        if seed is not None:
            self._seed, self._episode = seed, 0
        elif self._seed is None:
            self._seed = int(self.np_random.integers(2**63))
        start, target = self.task.episode(self._seed, self._episode, options)
        self._episode += 1
        self._state, self._target = start[None], target[None]
        self._goal = self.task.goals(self._state, self._target)[0]
        if self.render_mode == "human":
            self._show()
        return self._observe(), self._info()

    def step(self, action: NDArray[np.float32]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Apply a force ``[2]`` for half a second.

        Raises:
            ValueError: for another shape, or an action that is not finite.
            ResetNeeded: before the first ``reset``.
        """
        if self._state is None:
            raise ResetNeeded("call reset before step")
        actions = checked_actions(action, (2,))[None]
        self._state = self.task.step(self._state, actions)
        info = self._info()
        if self.render_mode == "human":
            self._show()
        success, distance = np.array([info["success"]]), np.array([info["distance"]])
        reward = float(self.task.rewards(success, distance)[0])
        return self._observe(), reward, info["success"], False, info

    def _observe(self) -> Any:
        assert self._state is not None
        batch = self.task.observations(self._state, self._target)
        return (
            {name: part[0] for name, part in batch.items()}
            if self.task.goal_observation
            else batch[0]
        )

    def _info(self) -> dict[str, Any]:
        assert self._state is not None
        return {
            "state": self._state[0].copy(),
            "target": self._target[0].copy(),
            "goal": self._goal.copy(),
            "success": bool(self.task.success(self._state, self._target)[0]),
            "distance": float(self.task.distances(self._state, self._target)[0]),
        }

    def _picture(self) -> Image:
        assert self._state is not None
        picture: Image = self.task.pictures(self._state, self._target)[0]
        return picture
