"""Gymnasium environments as domains: trials against stepping them by hand."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray

import hvf  # noqa: F401  (makes the maze known to Gymnasium)
import hvf_core
from hvf.agents.random import RandomAgent
from hvf.domains.domain import Domain
from hvf.domains.gym import GymTrials, gym_domain
from hvf.evaluation import act
from hvf.settings import Acting


class Counter(gymnasium.Env[Any, Any]):
    """Counts up by its action; the goal is a number. Says what it is told to say."""

    observation_space = gymnasium.spaces.Box(0, 255, (2, 3, 3), np.uint8)
    action_space = gymnasium.spaces.Box(0, 5, (1,), np.float64)
    seeds: ClassVar[list[int | None]] = []
    made: ClassVar[list[Counter]] = []

    def __init__(
        self,
        goal: int = 20,
        keys: tuple[str, str] | None = None,
        says_success: bool = True,
        ends_at: int = 10**6,
        truncates_at: int = 10**6,
        error: str | None = None,
    ) -> None:
        self.goal, self.keys, self.says_success = goal, keys, says_success
        self.ends_at, self.truncates_at, self.error = ends_at, truncates_at, error
        self.closed, self.steps = False, 0
        self.made.append(self)

    def image(self, number: float) -> NDArray[np.uint8]:
        return np.full((2, 3, 3), int(number), np.uint8)

    def _seen(self) -> Any:
        if self.keys is None:
            return self.image(self.number)
        camera, goal = self.keys
        return {camera: self.image(self.number), goal: self.image(self.goal), "arm": np.zeros(3)}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
        super().reset(seed=seed)
        self.seeds.append(seed)
        self.number = float(self.np_random.integers(0, 10))
        self.ended = False
        return self._seen(), {} if self.keys else {"goal": self.image(self.goal)}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, Any]:
        assert not self.ended, "stepped after its end"
        assert action.dtype == np.float64
        self.steps += 1
        self.number += float(action[0])
        reached = self.number >= self.goal
        terminated = self.number >= self.ends_at or (reached and not self.says_success)
        truncated = self.number >= self.truncates_at
        self.ended = terminated or truncated
        info: dict[str, Any] = {"success": reached} if self.says_success else {}
        if self.error is not None and self.ended:
            info["error"] = self.error
        return self._seen(), 0.0, terminated, truncated, info

    def close(self) -> None:
        self.closed = True


@pytest.fixture(autouse=True)
def forgotten() -> None:
    Counter.seeds.clear()
    Counter.made.clear()


def trials_of(domain: Domain, seed: int = 0, first: int = 0, count: int = 3) -> GymTrials:
    trials = domain.open().trials(domain.default_task, seed, first, count)
    assert isinstance(trials, GymTrials)
    return trials


def numbers(images: NDArray[np.uint8]) -> list[int]:
    assert images.shape[1:] == (2, 3, 3)
    return images[:, 0, 0, 0].tolist()


def test_trials_are_the_environment_stepped_by_hand() -> None:
    trials = trials_of(gym_domain("counter", Counter, steps=9), seed=4, first=2)
    seeds = list(Counter.seeds)
    assert len(set(seeds)) == 3
    rng = np.random.default_rng(0)
    actions = rng.uniform(0, 5, (4, 3, 1)).astype(np.float32)
    which = np.arange(3)
    seen = [trials.observe(which)]
    for step in actions:
        trials.step(which, step)
        seen.append(trials.observe(which))
    success = trials.success(which)
    for trial, seed in enumerate(seeds):
        env = Counter()
        observation, info = env.reset(seed=seed)
        np.testing.assert_array_equal(trials.goals[trial], info["goal"])
        np.testing.assert_array_equal(seen[0][trial], observation)
        for step in range(4):
            observation, _, _, _, info = env.step(actions[step, trial].astype(np.float64))
            np.testing.assert_array_equal(seen[step + 1][trial], observation)
        assert success[trial] == info["success"]
    assert len(trials) == 3


def test_an_episode_is_the_same_alone_and_in_a_batch_and_differs_by_seed() -> None:
    domain = gym_domain("counter", Counter, steps=9)
    together = trials_of(domain, seed=4, first=1, count=4)
    batch, Counter.seeds[:] = list(Counter.seeds), []
    trials_of(domain, seed=4, first=3, count=1)
    assert Counter.seeds == [batch[2]]
    Counter.seeds.clear()
    trials_of(domain, seed=5, first=1, count=4)
    assert not set(Counter.seeds) & set(batch)
    # And through acting: outcomes depend on each one's own seed only.
    agent = RandomAgent(*domain.action_box)
    outcome = act(together, agent, Acting(steps=9), [1, 2, 3, 4])
    alone = act(trials_of(domain, 4, 3, 1), agent, Acting(steps=9), [3])
    assert alone.trials == outcome.trials[2:3]


def test_finished_trials_idle() -> None:
    domain = gym_domain("counter", Counter, steps=9, tasks={"short": {"ends_at": 25}})
    trials = trials_of(domain)
    first = numbers(trials.observe(np.arange(3)))
    trials.step(np.array([1]), np.array([[2.0]], np.float32))
    # The others were not stepped.
    assert [env.steps for env in Counter.made[-3:]] == [0, 1, 0]
    assert numbers(trials.observe(np.arange(3))) == [first[0], first[1] + 2, first[2]]
    outcome = act(trials_of(domain), RandomAgent(*domain.action_box), Acting(steps=40), [0, 1, 2])
    # An environment that has ended is never stepped again, which its assertion would say.
    assert all(trial.success for trial in outcome.trials)
    assert [env.steps for env in Counter.made[-3:]] == [trial.steps for trial in outcome.trials]
    assert len({trial.steps for trial in outcome.trials}) > 1


def test_success_is_what_info_says_or_else_termination() -> None:
    one = np.array([0])
    five = np.array([[5.0]], np.float32)
    said = trials_of(gym_domain("counter", Counter, steps=9), count=1)
    quiet = trials_of(
        gym_domain("counter", Counter, steps=9, tasks={"it": {"says_success": False}}), count=1
    )
    for trials in (said, quiet):
        for _ in range(4):
            reached = numbers(trials.observe(one))[0] >= 20
            assert trials.success(one)[0] == reached
            if not reached:
                assert trials.step(one, five) == {}
        assert trials.success(one)[0]
    named = gym_domain("counter", Counter, steps=9, success_key="done")
    trials = trials_of(named, count=1)
    for _ in range(4):
        trials.step(one, five)
    # It says nothing under this name, and has not terminated.
    assert not trials.success(one)[0]


@pytest.mark.parametrize("end", ["ends_at", "truncates_at"])
@pytest.mark.parametrize("error", [None, "the gripper is stuck"])
def test_an_end_without_success_is_told(end: str, error: str | None) -> None:
    domain = gym_domain("counter", Counter, steps=9, tasks={"it": {end: 12, "error": error}})
    outcome = act(trials_of(domain), RandomAgent(*domain.action_box), Acting(steps=9), [0, 1, 2])
    words = error or "the environment ended the episode"
    assert [(trial.success, trial.error) for trial in outcome.trials] == [(False, words)] * 3


def test_observations_may_be_dictionaries_with_names_of_their_own() -> None:
    keys = {"observation_key": "camera", "goal_key": "wanted"}
    tasks = {"it": {"keys": ("camera", "wanted"), "goal": 33}}
    trials = trials_of(gym_domain("counter", Counter, steps=9, tasks=tasks, **keys))
    assert numbers(trials.goals) == [33, 33, 33]
    before = numbers(trials.observe(np.arange(3)))
    trials.step(np.array([0, 2]), np.array([[1.0], [2.0]], np.float32))
    after = numbers(trials.observe(np.arange(3)))
    assert [b - a for a, b in zip(before, after, strict=True)] == [1, 0, 2]


def test_what_is_not_there_is_named() -> None:
    tasks = {"it": {"keys": ("camera", "wanted")}}
    with pytest.raises(ValueError, match=r"^observation_key: 'eye' is none of \['camera'"):
        trials_of(gym_domain("c", Counter, steps=9, tasks=tasks, observation_key="eye"))
    with pytest.raises(ValueError, match=r"^goal_key: there is no 'goal' in the observation or in"):
        trials_of(gym_domain("c", Counter, steps=9, tasks=tasks, observation_key="camera"))
    with pytest.raises(TypeError, match=r"^observation: must be a uint8 image \[H, W, 3\], got fl"):
        trials_of(gym_domain("c", Counter, steps=9, tasks=tasks, observation_key="arm"))
    with pytest.raises(ValueError, match=r"^env: must have a box \[A\] of actions, got Discrete"):
        gym_domain("cart", "CartPole-v1", steps=9)
    with pytest.raises(ValueError, match=r"^generator: 'oracle' is not available here"):
        gym_domain("c", Counter, steps=9).open().oracle()


def test_a_domain_is_what_the_environment_says() -> None:
    domain = gym_domain(
        "counter", Counter, steps=7, tasks={"low": {"goal": 5}, "high": {"goal": 50}}, about="up"
    )
    assert (domain.name, domain.about, domain.default_task) == ("counter", "up", "high")
    assert dict(domain.tasks) == {"low": 7, "high": 7}
    assert (domain.action_low, domain.action_high) == ((0.0,), (5.0,))
    place = domain.open()
    assert numbers(place.trials("low", 0, 0, 1).goals) == [5]
    assert numbers(place.trials("high", 0, 0, 1).goals) == [50]
    # Environments of earlier trials are closed, and all of them in the end.
    assert [env.closed for env in Counter.made[-2:]] == [True, False]
    place.close()
    assert all(env.closed for env in Counter.made)


def test_the_maze_of_gymnasium_is_the_maze() -> None:
    made: list[Any] = []

    class Noted(gymnasium.Wrapper[Any, Any, Any, Any]):
        """Keeps the seeds that it is reset with."""

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            made.append(seed)
            return self.env.reset(seed=seed, options=options)

    def make(difficulty: str) -> Any:
        return Noted(gymnasium.make("hvf/Maze-v0", difficulty=difficulty, max_episode_steps=-1))

    domain = gym_domain("gym-maze", make, steps=50, tasks={"easy": {"difficulty": "easy"}})
    count, steps = 12, 15
    trials = trials_of(domain, seed=1, count=count)
    actions = np.random.default_rng(2).uniform(-3, 3, (steps, count, 2)).astype(np.float32)
    # Half of them are pushed straight at the target.
    states, targets = (
        np.concatenate(parts)
        for parts in zip(
            *(hvf_core.maze_episodes(seed, 0, 1, "easy") for seed in made), strict=True
        )
    )
    np.testing.assert_array_equal(
        trials.observe(np.arange(count)), hvf_core.maze_render(states, 64)
    )
    reached = np.zeros(count, bool)
    for step in range(steps):
        which = np.flatnonzero(~reached)
        toward = np.clip((targets - states[:, :2]) / 0.05, -3, 3).astype(np.float32)
        chosen = np.where(np.arange(count)[:, None] < count // 2, toward, actions[step])[which]
        assert trials.step(which, chosen) == {}
        states[which] = hvf_core.maze_step(states[which], chosen)
        np.testing.assert_array_equal(
            trials.observe(which), hvf_core.maze_render(states[which], 64)
        )
        success = hvf_core.maze_success(states[which], targets[which])
        np.testing.assert_array_equal(trials.success(which), success)
        reached[which] = success
    assert 3 < reached.sum() < count


def test_an_id_of_gymnasium_has_no_limit_of_its_own() -> None:
    domain = gym_domain("gym-maze", "hvf/Maze-v0", steps=80, tasks={"hard": {}})
    trials = trials_of(domain, count=1)
    still = np.zeros((1, 2), np.float32)
    assert [trials.step(np.array([0]), still) for _ in range(60)] == [{}] * 60
