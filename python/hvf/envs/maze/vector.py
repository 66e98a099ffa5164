"""Many mazes as one Gymnasium vector environment, stepped by the Rust core on all cores."""

from typing import Any, TypeAlias

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from hvf.envs.actions import checked_actions
from hvf.envs.maze.layouts import LayoutLike
from hvf.envs.maze.task import (
    RENDER_FPS,
    Difficulty,
    Image,
    MazeTask,
    Reward,
)

Bools: TypeAlias = NDArray[np.bool_]


class MazeVectorEnv(VectorEnv[Any, NDArray[np.float32], NDArray[Any]]):
    """``num_envs`` mazes that behave like as many :class:`~hvf.envs.maze.env.MazeEnv`.

    Made with ``gymnasium.make_vec("hvf/Maze-v0", num_envs=8)``. Environment ``i`` of
    ``reset(seed=s)`` is seeded with ``s + i``, as in Gymnasium's own vector environments, and
    gives what a single environment of that seed gives; episodes end after ``max_episode_steps``.

    Args:
        num_envs: Number of mazes ``N``, at least 1.
        max_episode_steps: Steps after which an episode is truncated; None for never.
        difficulty: As in :class:`~hvf.envs.maze.task.MazeTask`, like the next three.
        image_size: Width and height of observations, pixels.
        reward: ``"sparse"`` or ``"dense"``.
        render_mode: None or ``"rgb_array"``.
        autoreset_mode: What happens after an episode has ended (``metadata["autoreset_mode"]``):
            ``NEXT_STEP`` (the next step ignores the action and returns the first observation of
            the next episode), ``SAME_STEP`` (that observation comes at once, the last one in
            ``info["final_obs"]`` and ``info["final_info"]``) or ``DISABLED`` (the caller resets
            with ``options={"reset_mask": ...}``).
        goal_observation: As in :class:`~hvf.envs.maze.env.MazeEnv`: dicts of arrays ``[N, ...]``,
            and a ``compute_reward``.
        layout: As in :class:`~hvf.envs.maze.task.MazeTask`.

    Raises:
        ValueError: for a setting out of range.
    """

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        difficulty: Difficulty = "hard",
        image_size: int = 64,
        reward: Reward = "sparse",
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        goal_observation: bool = False,
        layout: LayoutLike | None = None,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs: must be at least 1, got {num_envs}")
        if max_episode_steps is not None and max_episode_steps < 1:
            raise ValueError(f"max_episode_steps: must be at least 1, got {max_episode_steps}")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode: must be None or 'rgb_array', got {render_mode!r}")
        self.task = MazeTask(difficulty, image_size, reward, render_mode, goal_observation, layout)
        if goal_observation:
            self.compute_reward = self.task.rewards_of_goals
        self.num_envs = num_envs
        self.max_episode_steps = max_episode_steps
        self.render_mode = render_mode
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": RENDER_FPS,
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_observation_space = self.task.observation_space
        self.single_action_space = self.task.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._seeds: list[int | None] = [None] * num_envs
        self._episodes = [0] * num_envs
        self._states = np.zeros((num_envs, self.task.columns))
        self._targets = np.zeros((num_envs, 2))
        self._goals = np.zeros((num_envs, image_size, image_size, 3), np.uint8)
        self._steps = np.zeros(num_envs, np.int64)
        self._started = np.zeros(num_envs, np.bool_)
        self._ended = np.zeros(num_envs, np.bool_)

    def reset(
        self,
        *,
        seed: int | list[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Start the next episode of every maze, or the first one of its seed.

        Args:
            seed: None, one seed (maze ``i`` gets ``seed + i``) or one for each maze.
            options: As for a single maze, for all of them; and ``"reset_mask"``, bool ``[N]``,
                to reset only some.

        Raises:
            ValueError: for options or a number of seeds that do not fit.
        """
        options = dict(options or {})
        mask = self._reset_mask(options.pop("reset_mask", None))
        super().reset(seed=seed if isinstance(seed, int) else None)
        if isinstance(seed, (int, np.integer)):
            seed = [int(seed) + index for index in range(self.num_envs)]
        if seed is not None:
            if len(seed) != self.num_envs:
                raise ValueError(f"seed: must be {self.num_envs} seeds, got {len(seed)}")
            for index in np.flatnonzero(mask):
                if seed[index] is not None:
                    self._seeds[index], self._episodes[index] = seed[index], 0
        self._next_episodes(mask, options)
        return self.task.observations(self._states, self._targets), self._infos(mask)

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Any, NDArray[np.float64], Bools, Bools, dict[str, Any]]:
        """Apply forces ``[N, 2]`` for half a second.

        Raises:
            ValueError: for another shape, or actions that are not finite.
            ResetNeeded: before ``reset``, or with autoreset disabled after an episode's end.
        """
        if not self._started.all():
            raise ResetNeeded("call reset before step")
        actions = checked_actions(actions, (self.num_envs, 2))
        if self.autoreset_mode is AutoresetMode.DISABLED and self._ended.any():
            raise ResetNeeded(
                f"episodes of mazes {np.flatnonzero(self._ended).tolist()} have ended and "
                "autoreset is disabled: reset them with options={'reset_mask': ...}"
            )
        restarted = self._ended
        moved = self.task.step(self._states, actions)
        self._states = np.where(restarted[:, None], self._states, moved)
        self._steps = self._steps + ~restarted
        if restarted.any():
            self._next_episodes(restarted, {})

        infos = self._infos(np.ones(self.num_envs, np.bool_))
        terminated = infos["success"] & ~restarted
        too_long = self.max_episode_steps is not None and self._steps >= self.max_episode_steps
        truncated = np.broadcast_to(too_long, (self.num_envs,)) & ~restarted
        rewards = self.task.rewards(infos["success"], infos["distance"])
        rewards[restarted] = 0.0
        ended = terminated | truncated
        observations = self.task.observations(self._states, self._targets)
        if self.autoreset_mode is AutoresetMode.SAME_STEP and ended.any():
            final = {key: value for key, value in infos.items() if not key.startswith("_")}
            # Gymnasium gives the last observations one by one.
            last = np.full(self.num_envs, None, dtype=object)
            last[ended] = _apart(observations, ended)
            self._next_episodes(ended, {})
            observations = self.task.observations(self._states, self._targets)
            infos = self._infos(np.ones(self.num_envs, np.bool_))
            infos |= {"final_obs": last, "_final_obs": ended.copy()}
            infos |= {"final_info": _masked(final, ended), "_final_info": ended.copy()}
            ended = np.zeros(self.num_envs, np.bool_)
        self._ended = ended
        return observations, rewards, terminated, truncated, infos

    def render(self) -> tuple[Image, ...] | None:
        """Scene and goal of each maze side by side, uint8 ``[256, 520, 3]`` each.

        Raises:
            ResetNeeded: before the first ``reset``.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render() without a render mode; give make_vec() render_mode=...")
            return None
        if not self._started.all():
            raise ResetNeeded("call reset before render")
        return tuple(self.task.pictures(self._states, self._targets))

    def _reset_mask(self, mask: Any) -> Bools:
        if mask is None:
            return np.ones(self.num_envs, np.bool_)
        array: NDArray[Any] = np.asarray(mask)
        if array.dtype != np.bool_ or array.shape != (self.num_envs,) or not array.any():
            raise ValueError(
                f"options['reset_mask']: must be bool [{self.num_envs}] with at least one True, "
                f"got {mask!r}"
            )
        return array.astype(np.bool_)

    def _next_episodes(self, mask: Bools, options: dict[str, Any]) -> None:
        """Put the masked mazes at the start of their next episodes."""
        # What was handed out stays as it was.
        states, targets, goals = self._states.copy(), self._targets.copy(), self._goals.copy()
        for index in np.flatnonzero(mask):
            seed = self._seeds[index]
            if seed is None:
                seed = self._seeds[index] = int(self.np_random.integers(2**63))
            start, target = self.task.episode(seed, self._episodes[index], options)
            states[index], targets[index] = start, target
            self._episodes[index] += 1
        goals[mask] = self.task.goals(states[mask], targets[mask])
        self._states, self._targets, self._goals = states, targets, goals
        self._steps = np.where(mask, 0, self._steps)
        self._started = self._started | mask
        self._ended = self._ended & ~mask

    def _infos(self, mask: Bools) -> dict[str, Any]:
        infos: dict[str, NDArray[Any]] = {
            "state": self._states.copy(),
            "target": self._targets,
            "goal": self._goals,
            "success": self.task.success(self._states, self._targets),
            "distance": self.task.distances(self._states, self._targets),
        }
        return _masked(infos, mask)


def _apart(observations: Any, mask: Bools) -> NDArray[Any]:
    """The masked ones of a batch of observations, one object each."""
    which = np.flatnonzero(mask)
    found = np.empty(len(which), dtype=object)
    for place, index in enumerate(which):
        if isinstance(observations, dict):
            found[place] = {name: part[index].copy() for name, part in observations.items()}
        else:
            found[place] = observations[index].copy()
    return found


def _masked(infos: dict[str, NDArray[Any]], mask: Bools) -> dict[str, Any]:
    """Infos in Gymnasium's vector form: ``_key`` says for which mazes ``key`` holds, else 0."""
    masked: dict[str, Any] = {}
    for key, value in infos.items():
        if not mask.all():
            value = value.copy()
            value[~mask] = 0
        masked[key], masked[f"_{key}"] = value, mask.copy()
    return masked
