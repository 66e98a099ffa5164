"""Any Gymnasium environment with image observations and a goal image, as a domain.

    from hvf.domains.gym import gym_domain
    from hvf.registry import DOMAINS

    DOMAINS.register("reach", gym_domain("reach", "My/Reach-v0", steps=50))

Then ``hvf collect reach``, ``hvf train cvae --data FILE``, ``hvf eval reach``, ``hvf plan reach``
and ``hvf demo reach`` work as for the maze. Nothing but images, actions and success is asked of the
environment: there are no ground-truth subgoals and no simulator to plan with.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from hvf.domains.domain import Domain, Place
from hvf.domains.gym_collection import GymCollection
from hvf.domains.gym_env import GymEnv
from hvf.protocols import Images, Indices
from hvf.settings import Planning, Preset, World


class GymTrials:
    """Episodes ``first..first + count`` of a seed, side by side, each in an environment of its own.

    Args:
        envs: ``B`` copies of the environment.
        where: where in it to look.
        seed: of the episodes; episode ``i`` is reset with a seed made of (seed, i).
        first: number of the first.
    """

    def __init__(
        self, envs: Sequence[gymnasium.Env[Any, Any]], where: GymEnv, seed: int, first: int
    ) -> None:
        self._envs, self._where = envs, where
        images, goals = [], []
        for number, env in enumerate(envs, first):
            word = int(np.random.SeedSequence([seed, number]).generate_state(1)[0] >> 1)
            observation, info = env.reset(seed=word)
            images.append(where.image(observation))
            goals.append(where.goal(observation, info))
        self._images, self._goals = np.stack(images), np.stack(goals)
        self._success = np.zeros(len(envs), np.bool_)

    @property
    def goals(self) -> Images:
        """Goal images, uint8 ``[B, H, W, 3]``."""
        return self._goals

    def __len__(self) -> int:
        """Return the number of episodes, ``B``."""
        return len(self._envs)

    def observe(self, which: Indices) -> Images:
        """Return the images that were seen last."""
        images: Images = self._images[which]
        return images

    def step(self, which: Indices, actions: NDArray[np.float32]) -> dict[int, str]:
        """Apply ``actions[N, A]`` to the trials ``which``; the others stay as they are.

        Returns:
            Those that ended without success: number of the trial to words.
        """
        ended = {}
        for trial, action in zip(map(int, which), actions, strict=True):
            env = self._envs[trial]
            taken = np.asarray(action, env.action_space.dtype)
            observation, _, terminated, truncated, info = env.step(taken)
            self._images[trial] = self._where.image(observation)
            said = info.get(self._where.success_key, terminated)
            self._success[trial] = bool(said)
            if (terminated or truncated) and not said:
                ended[trial] = str(info.get("error", "the environment ended the episode"))
        return ended

    def success(self, which: Indices) -> NDArray[np.bool_]:
        """Return whether the environment said so after the last step."""
        reached: NDArray[np.bool_] = self._success[which]
        return reached


class GymPlace(Place):
    """A Gymnasium environment, open.

    Args:
        envs: where to look, by task.
    """

    def __init__(self, envs: Mapping[str, GymEnv]) -> None:
        self._envs = envs
        self._open: list[gymnasium.Env[Any, Any]] = []

    def trials(self, task: str, seed: int, first: int, count: int) -> GymTrials:
        """Fresh trials, in as many copies of the environment; the last ones are closed."""
        where = self._envs[task]
        self.close()
        for _ in range(count):
            self._open.append(where.make())
        return GymTrials(tuple(self._open), where, seed, first)

    def close(self) -> None:
        """Close the environments."""
        while self._open:
            self._open.pop().close()


def gym_domain(
    name: str,
    env: Any,
    *,
    steps: int,
    about: str = "",
    tasks: Mapping[str, Mapping[str, Any]] | None = None,
    observation_key: str | None = None,
    goal_key: str = "goal",
    success_key: str = "success",
    planning: Planning = Planning(),
    world: World = World(),
    **more: Any,
) -> Domain:
    """A domain of a Gymnasium environment.

    Args:
        name: of the domain.
        env: id that ``gymnasium.make`` knows, or a function that makes one environment.
        steps: of an episode (T).
        about: what it is, in a line.
        tasks: name to keywords of the environment; one task ``"reach"`` without, if None.
        observation_key: the image among dictionary observations.
        goal_key: the goal image, in the observation or in ``info``.
        success_key: whether the goal is reached, in ``info``.
        planning: how agents plan if nothing else is said.
        world: what they plan with.
        more: other fields of :class:`~hvf.domains.domain.Domain`: ``presets``, ``weights``, ...

    Raises:
        ValueError: an environment whose actions are no box.
    """
    words: Mapping[str, Mapping[str, Any]] = {"reach": {}} if tasks is None else tasks
    envs = {
        task: GymEnv(env, kwargs, observation_key, goal_key, success_key)
        for task, kwargs in words.items()
    }
    first = next(iter(envs.values()))
    example = first.make()
    space = example.action_space
    example.close()
    assert isinstance(space, gymnasium.spaces.Box)
    # A class of its own, since the command line makes its options from classes.
    collection = type(
        "GymCollection",
        (GymCollection,),
        {"domain": name, "where": first, "__doc__": GymCollection.__doc__},
    )
    low, high = np.float32(space.low).tolist(), np.float32(space.high).tolist()
    return Domain(
        name=name,
        about=about or f"the Gymnasium environment {env}",
        open_with=lambda workers: GymPlace(envs),
        action_low=tuple(low),
        action_high=tuple(high),
        tasks=dict.fromkeys(envs, steps),
        presets=more.pop("presets", {"default": Preset(planning, world)}),
        collection=more.pop("collection", collection),
        **more,
    )
