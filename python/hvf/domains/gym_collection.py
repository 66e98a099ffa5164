"""Random interaction in any Gymnasium environment."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import gymnasium
import numpy as np
from rich.console import Console

from hvf.data.collect import CollectConfig, collect
from hvf.data.episodes import Episodes
from hvf.domains.gym_env import GymEnv


@dataclasses.dataclass(frozen=True)
class GymCollection(CollectConfig):
    """How much to collect, and where to put it.

    Actions are uniformly random. An episode ends early where the environment ends it; the size of
    images is the environment's.

    Attributes:
        action_repeat: steps for which each random action is held.
    """

    domain: ClassVar[str]
    """Name of the domain: the environment of the data."""
    where: ClassVar[GymEnv]
    """The environment."""

    episodes: int = 1000
    action_repeat: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.action_repeat < 1:
            raise ValueError(f"action_repeat must be at least 1, got {self.action_repeat}")

    def run(self, console: Console | None = None) -> Any:
        """Collect, in one process.

        Raises:
            FileExistsError, ValueError, OSError, KeyboardInterrupt: as
                :func:`hvf.data.collect.collect`.
        """
        env = self.where.make()
        try:
            space = env.action_space
            assert isinstance(space, gymnasium.spaces.Box)
            low = tuple(np.float32(space.low).tolist())
            high = tuple(np.float32(space.high).tolist())
            if not np.isfinite([low, high]).all():
                raise ValueError(f"env: actions must have bounds to be drawn from, got {space}")

            def rollouts(seed: int, first: int, count: int, steps: int) -> Episodes:
                made = [self._episode(env, seed, first + i, steps) for i in range(count)]
                lengths = np.array([len(actions) for _, actions in made], np.int64)
                # What ended early is padded: its last frame stands, its actions are zeros.
                missing = steps - lengths
                return Episodes(
                    np.stack(
                        [
                            np.pad(frames, ((0, short), (0, 0), (0, 0), (0, 0)), mode="edge")
                            for (frames, _), short in zip(made, missing, strict=True)
                        ]
                    ),
                    np.stack(
                        [
                            np.pad(actions, ((0, short), (0, 0)))
                            for (_, actions), short in zip(made, missing, strict=True)
                        ]
                    ),
                    lengths=lengths,
                )

            return collect(
                self,
                self.domain,
                {"policy": "uniform", "action_repeat": self.action_repeat},
                rollouts,
                console,
                {"gymnasium": gymnasium.__version__},
                action_low=low,
                action_high=high,
            )
        finally:
            env.close()

    def _episode(
        self, env: gymnasium.Env[Any, Any], seed: int, number: int, steps: int
    ) -> tuple[Any, Any]:
        """Frames ``[T+1, H, W, 3]`` and actions ``[T, A]`` of an episode."""
        # The last word keeps these streams apart from those of evaluated episodes.
        rng = np.random.default_rng([seed, number, 1])
        observation, _ = env.reset(seed=int(rng.integers(2**31)))
        space = env.action_space
        assert isinstance(space, gymnasium.spaces.Box)
        drawn = rng.uniform(space.low, space.high, (-(-steps // self.action_repeat), *space.shape))
        actions = np.repeat(drawn, self.action_repeat, axis=0)[:steps].astype(np.float32)
        frames = [self.where.image(observation)]
        for action in actions:
            observation, _, terminated, truncated, _ = env.step(action.astype(space.dtype))
            frames.append(self.where.image(observation))
            if terminated or truncated:
                break
        return np.stack(frames), actions[: len(frames) - 1]
