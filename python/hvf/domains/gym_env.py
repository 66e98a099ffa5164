"""A Gymnasium environment, and where in it images, goals and success are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np

from hvf.protocols import Images


@dataclass(frozen=True)
class GymEnv:
    """An environment, and where in it to look.

    Attributes:
        env: id that ``gymnasium.make`` knows, or a function that makes one environment.
        kwargs: given to it.
        observation_key: the image among dictionary observations; None if the observation is one.
        goal_key: the goal image, in the observation or in ``info``.
        success_key: whether the goal is reached, in ``info``; where it is not there, termination
            counts as success.
    """

    env: Any
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    observation_key: str | None = None
    goal_key: str = "goal"
    success_key: str = "success"

    def make(self) -> gymnasium.Env[Any, Any]:
        """One environment, without its own limit of steps.

        Raises:
            ValueError: actions that are no box of numbers.
        """
        if callable(self.env):
            made = self.env(**self.kwargs)
        else:
            made = gymnasium.make(self.env, max_episode_steps=-1, **self.kwargs)
        space = made.action_space
        if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
            raise ValueError(f"env: must have a box [A] of actions, got {space}")
        return made  # type: ignore[no-any-return]

    def image(self, observation: Any) -> Images:
        """The image in an observation, or images in a batch of them.

        Raises:
            TypeError: it is no uint8 image.
            ValueError: no such key.
        """
        if self.observation_key is not None:
            if self.observation_key not in observation:
                raise ValueError(
                    f"observation_key: {self.observation_key!r} is none of {list(observation)}"
                )
            observation = observation[self.observation_key]
        return checked_image("observation", observation)

    def goal(self, observation: Any, info: Mapping[str, Any]) -> Images:
        """The goal image of an episode, uint8 ``[H, W, 3]``.

        Raises:
            ValueError: there is none under the key.
        """
        for place in (observation, info):
            if isinstance(place, Mapping) and self.goal_key in place:
                return checked_image("goal", place[self.goal_key])
        raise ValueError(
            f"goal_key: there is no {self.goal_key!r} in the observation or in info, which has "
            f"{sorted(info)}"
        )


def checked_image(name: str, image: Any) -> Images:
    """An image uint8 ``[..., H, W, 3]``.

    Raises:
        TypeError: it is something else.
    """
    array = np.asarray(image)
    if array.dtype != np.uint8 or array.ndim < 3 or array.shape[-1] != 3:
        raise TypeError(
            f"{name}: must be a uint8 image [H, W, 3], got {array.dtype} {list(array.shape)}"
        )
    return array
