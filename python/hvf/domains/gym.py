"""Any Gymnasium environment with image observations and a goal image, as a domain.

    from hvf.domains.gym import gym_domain
    from hvf.registry import DOMAINS

    DOMAINS.register("reach", gym_domain("reach", "My/Reach-v0", steps=50))

Then ``hvf collect reach``, ``hvf train cvae --data FILE``, ``hvf eval reach``, ``hvf plan reach``
and ``hvf demo reach`` work as for the maze. Nothing but images, actions and success is asked of the
environment: there are no ground-truth subgoals and no simulator to plan with.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from numpy.typing import NDArray

from hvf.domains.domain import Domain, Place
from hvf.domains.gym_collection import GymCollection
from hvf.domains.gym_env import GymEnv
from hvf.protocols import Images, Indices
from hvf.settings import Planning, Preset, World


class GymTrials:
    """Episodes ``first..first + count`` of a seed, side by side in a vector environment.

    Args:
        vector: an environment of ``B`` copies, of any kind that Gymnasium has.
        where: where in it to look.
        seed: of the episodes; episode ``i`` is reset with a seed made of (seed, i).
        first: number of the first.
    """

    def __init__(self, vector: SyncVectorEnv, where: GymEnv, seed: int, first: int) -> None:
        self._vector, self._where = vector, where
        count = vector.num_envs
        seeds: list[int | None] = [
            int(np.random.SeedSequence([seed, first + i]).generate_state(1)[0] >> 1)
            for i in range(count)
        ]
        observations, infos = vector.reset(seed=seeds)
        self._images = where.image(observations).copy()
        self._goals = np.stack(
            [where.goal(_one(observations, i), _one(infos, i)) for i in range(count)]
        )
        self._success = np.zeros(count, np.bool_)
        space = vector.single_action_space
        assert isinstance(space, gymnasium.spaces.Box)
        self._idle = np.clip(np.zeros(space.shape), space.low, space.high).astype(space.dtype)

    @property
    def goals(self) -> Images:
        """Goal images, uint8 ``[B, H, W, 3]``."""
        return self._goals

    def __len__(self) -> int:
        """Return the number of episodes, ``B``."""
        return self._vector.num_envs

    def observe(self, which: Indices) -> Images:
        """Return the images that were seen last."""
        images: Images = self._images[which]
        return images

    def step(self, which: Indices, actions: NDArray[np.float32]) -> dict[int, str]:
        """Apply ``actions[N, A]`` to the trials ``which``; the others idle, and are not looked at.

        Returns:
            Those that ended without success: number of the trial to words.
        """
        every = np.repeat(self._idle[None], len(self), axis=0)
        every[which] = actions
        observations, _, terminated, truncated, infos = self._vector.step(every)
        images, ended = self._where.image(observations), {}
        for trial in map(int, which):
            self._images[trial] = images[trial]
            info = _one(infos, trial)
            said = info.get(self._where.success_key, terminated[trial])
            self._success[trial] = bool(said)
            if (terminated[trial] or truncated[trial]) and not said:
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
        self._vectors: list[VectorEnv[Any, Any, Any]] = []

    def trials(self, task: str, seed: int, first: int, count: int) -> GymTrials:
        """Fresh trials, in as many copies of the environment."""
        where = self._envs[task]
        vector = SyncVectorEnv([where.make] * count, autoreset_mode=AutoresetMode.DISABLED)
        self.close()
        self._vectors.append(vector)
        return GymTrials(vector, where, seed, first)

    def close(self) -> None:
        """Close the environments."""
        for vector in self._vectors:
            vector.close()
        self._vectors.clear()


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


def _one(batch: Any, number: int) -> Any:
    """What one environment of a vector said, of a batch of observations or infos."""
    if not isinstance(batch, Mapping):
        return batch[number]
    found = {}
    for key, values in batch.items():
        if key.startswith("_"):
            continue
        present = batch.get(f"_{key}")
        if present is None or present[number]:
            found[key] = values[number] if not isinstance(values, Mapping) else _one(values, number)
    return found
