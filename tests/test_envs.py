"""The Gymnasium environments, by Gymnasium's and Stable-Baselines3's checkers and each other."""

import sys
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import DependencyNotInstalled, ResetNeeded
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import hvf_core
import processes
from hvf.envs import MAZE_ID, register_envs
from hvf.envs.maze.env import MazeEnv
from hvf.envs.maze.vector import MazeVectorEnv


def complaints(caught: list[warnings.WarningMessage]) -> list[str]:
    """What a checker warned of, but for one thing: the action box is the paper's, [-3, 3]."""
    checkers = [w for w in caught if "gymnasium" in w.filename or "stable_baselines3" in w.filename]
    texts = [str(w.message) for w in checkers]
    return [text for text in texts if "symmetric and normalized" not in text]


@pytest.mark.parametrize("difficulty", ["easy", "medium", "hard"])
def test_gymnasiums_checker_passes(difficulty: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(gymnasium.make(MAZE_ID, difficulty=difficulty).unwrapped)
    assert complaints(caught) == []


@pytest.mark.parametrize("goals", [False, True])
def test_stable_baselines_checker_passes(goals: bool) -> None:
    from stable_baselines3.common.env_checker import check_env as sb3_check_env

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        sb3_check_env(gymnasium.make(MAZE_ID, goal_observation=goals).unwrapped, warn=True)
    assert complaints(caught) == []


def test_importing_hvf_registers_without_torch() -> None:
    code = (
        "import sys, hvf, gymnasium; env = gymnasium.make('hvf/Maze-v0', difficulty='easy');"
        "env.reset(seed=0); assert 'torch' not in sys.modules"
    )
    processes.run(processes.python(code), check=True)
    register_envs()


def test_episodes_are_those_of_the_core() -> None:
    env = gymnasium.make(MAZE_ID, difficulty="medium")
    starts, targets = hvf_core.maze_episodes(11, 0, 3, "medium")
    for index in range(3):
        image, info = env.reset(seed=11 if index == 0 else None)
        np.testing.assert_array_equal(info["state"], starts[index])
        np.testing.assert_array_equal(info["target"], targets[index])
        np.testing.assert_array_equal(image, hvf_core.maze_render(starts[index : index + 1])[0])
        goal = np.hstack([targets[index], starts[index, 2:]])
        np.testing.assert_array_equal(info["goal"], hvf_core.maze_render(goal[None])[0])


def test_steps_rewards_and_ends() -> None:
    options = {"state": [0.2, 0.0, 0.1, -0.1], "target": [0.2, 0.12]}
    for reward, expected in (("sparse", (0.0, 1.0)), ("dense", (-0.0705, -0.021))):
        env = gymnasium.make(MAZE_ID, reward=reward)
        _, info = env.reset(seed=0, options=options)
        np.testing.assert_allclose(info["distance"], 0.12)
        for value, success in zip(expected, (False, True), strict=True):
            action = np.array([0, 1], np.float32)
            image, given, terminated, truncated, info = env.step(action)
            assert given == pytest.approx(value, abs=2e-4)
            assert terminated == info["success"] == success
            assert not truncated
            np.testing.assert_array_equal(image, hvf_core.maze_render(info["state"][None])[0])
        if reward == "dense":
            assert given == -info["distance"]


@pytest.mark.parametrize("reward", ["sparse", "dense"])
def test_rewards_of_goals_are_those_of_the_steps(reward: Any) -> None:
    env = MazeEnv("easy", reward=reward, goal_observation=True)
    plain = MazeEnv("easy", reward=reward)
    first, info = env.reset(seed=3)
    np.testing.assert_array_equal(first["observation"], plain.reset(seed=3)[0])
    assert env.observation_space.contains(first)
    seen, rewards = [], []
    for _ in range(40):
        towards = 4 * np.sign(first["desired_goal"] - info["state"][:2])
        observation, given, *_, info = env.step((towards * 0.2).astype(np.float32))
        np.testing.assert_array_equal(observation["achieved_goal"], info["state"][:2])
        np.testing.assert_array_equal(observation["desired_goal"], info["target"])
        assert given == env.compute_reward(info["state"][:2], info["target"], info)
        seen.append(observation["achieved_goal"])
        rewards.append(given)
    targets = np.tile(first["desired_goal"], (40, 1))
    together = env.compute_reward(np.stack(seen), targets, [{}] * 40)
    assert np.asarray(together).tolist() == rewards
    assert len(set(rewards)) > 1
    for bad in (np.zeros(3), np.full(2, np.nan), "there", np.zeros((2, 2))):
        with pytest.raises(ValueError, match="_goal"):
            env.compute_reward(bad, np.zeros(2), {})


def test_hindsight_replay_learns_on_goal_observations() -> None:
    from stable_baselines3 import SAC, HerReplayBuffer

    env = gymnasium.make(MAZE_ID, difficulty="easy", image_size=36, goal_observation=True)
    learner = SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=HerReplayBuffer,
        learning_starts=60,
        batch_size=8,
        buffer_size=100,
        policy_kwargs={"net_arch": [8]},
        device="cpu",
    )
    learner.learn(64)
    assert learner.num_timesteps == 64


def test_episodes_are_truncated_after_fifty_steps() -> None:
    env = gymnasium.make(MAZE_ID, difficulty="hard")
    env.reset(seed=0)
    for step in range(1, 51):
        *_, terminated, truncated, _ = env.step(np.zeros(2, np.float32))
        assert (terminated, truncated) == (False, step == 50)


def test_resets_take_an_episode_a_state_or_a_target() -> None:
    env = MazeEnv("hard")
    starts, targets = hvf_core.maze_episodes(5, 0, 10, "hard")
    _, info = env.reset(seed=5, options={"episode": 9})
    np.testing.assert_array_equal(info["state"], starts[9])
    _, info = env.reset(seed=5, options={"state": [0.0, 0.0, 0.0, 0.0]})
    np.testing.assert_array_equal(info["state"], 0)
    np.testing.assert_array_equal(info["target"], targets[0])
    # Inside a wall: put where the agent can stand.
    _, info = env.reset(seed=5, options={"state": [0.14, 0.2, 0.0, 0.0]})
    np.testing.assert_array_equal(info["state"], [0.12, 0.2, 0.0, 0.0])


@pytest.mark.parametrize(
    "options",
    [
        {"state": [0.0, 0.0]},
        {"state": [9.0, 0.0, 0.0, 0.0]},
        {"state": "here"},
        {"target": [np.nan, 0.0]},
        {"target": [0.0, 0.0, 0.0]},
        {"episode": -1},
        {"colour": 3},
    ],
)
def test_bad_options_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError):
        MazeEnv().reset(seed=0, options=options)
    with pytest.raises(ValueError):
        MazeVectorEnv(2).reset(seed=0, options=options)


@pytest.mark.parametrize(
    ("settings", "argument"),
    [
        ({"difficulty": "brutal"}, "difficulty"),
        ({"reward": "shaped"}, "reward"),
        ({"image_size": 4}, "size"),
        ({"render_mode": "ascii"}, "render_mode"),
    ],
)
def test_bad_settings_are_refused(settings: dict[str, Any], argument: str) -> None:
    for make in (MazeEnv, MazeVectorEnv):
        with pytest.raises(ValueError, match=argument):
            make(**settings)


def test_bad_vector_settings_are_refused() -> None:
    for settings in ({"num_envs": 0}, {"max_episode_steps": 0}, {"render_mode": "human"}):
        with pytest.raises(ValueError, match=next(iter(settings))):
            MazeVectorEnv(**settings)  # type: ignore[arg-type]
    envs = MazeVectorEnv(3)
    with pytest.raises(ValueError, match="seed"):
        envs.reset(seed=[1, 2])
    for mask in (np.zeros(3, bool), np.ones(2, bool), [1, 0, 1], "all"):
        with pytest.raises(ValueError, match="reset_mask"):
            envs.reset(options={"reset_mask": mask})


def test_stepping_before_reset_is_refused() -> None:
    with pytest.raises(ResetNeeded):
        MazeEnv().step(np.zeros(2, np.float32))
    with pytest.raises(ResetNeeded):
        MazeVectorEnv(2).step(np.zeros((2, 2), np.float32))


@given(
    hnp.arrays(
        np.float32,
        hnp.array_shapes(min_dims=1, max_dims=2, max_side=3),
        elements=st.floats(width=32),
    )
)
def test_actions_of_another_shape_or_not_finite_are_refused(action: np.ndarray) -> None:
    env, envs = MazeEnv(), MazeVectorEnv(3)
    env.reset(seed=0)
    envs.reset(seed=0)
    for stepped, shape in ((env, (2,)), (envs, (3, 2))):
        if action.shape == shape and np.isfinite(action).all():
            observation, *_ = stepped.step(action)
            assert stepped.observation_space.contains(observation)
        else:
            with pytest.raises(ValueError, match="action"):
                stepped.step(action)


def test_pictures_show_scene_and_goal() -> None:
    env = gymnasium.make(MAZE_ID, render_mode="rgb_array")
    _, info = env.reset(seed=3)
    picture = env.render()
    assert picture.shape == (256, 520, 3)
    np.testing.assert_array_equal(
        picture[:, :256], hvf_core.maze_render(info["state"][None], 256)[0]
    )
    envs = gymnasium.make_vec(MAZE_ID, num_envs=2, render_mode="rgb_array")
    envs.reset(seed=3)
    np.testing.assert_array_equal(envs.render()[0], picture)


def test_human_mode_draws_every_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr("hvf.envs.maze.env.RENDER_FPS", 1000)
    env = gymnasium.make(MAZE_ID, render_mode="human")
    env.reset(seed=0)
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).transpose(1, 0, 2)
    env.step(np.array([0, 3], np.float32))
    after = pygame.surfarray.array3d(pygame.display.get_surface()).transpose(1, 0, 2)
    picture = gymnasium.make(MAZE_ID, render_mode="rgb_array")
    picture.reset(seed=0)
    np.testing.assert_array_equal(shown, picture.render())
    assert (shown != after).any()
    env.close()
    env.close()


def test_human_mode_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    env = gymnasium.make(MAZE_ID, render_mode="human")
    with pytest.raises(DependencyNotInstalled, match=r"hvf\[render\]"):
        env.reset()


@pytest.mark.filterwarnings("error")
def test_make_vec_gives_the_native_environment_by_default() -> None:
    for mode in (None, "vector_entry_point"):
        envs = gymnasium.make_vec(MAZE_ID, num_envs=3, vectorization_mode=mode, difficulty="easy")
        assert isinstance(envs.unwrapped, MazeVectorEnv)
        assert envs.unwrapped.max_episode_steps == 50
        assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
        observations, infos = envs.reset(seed=0)
        assert envs.observation_space.contains(observations)
        assert infos["goal"].shape == (3, 64, 64, 3)
        envs.close()
    envs = gymnasium.make_vec(MAZE_ID, num_envs=3, vectorization_mode="sync")
    assert isinstance(envs.unwrapped, SyncVectorEnv)


@pytest.mark.parametrize(("reward", "goals"), [("sparse", False), ("dense", True)])
@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_native_vector_environment_is_gymnasiums_own(
    mode: AutoresetMode, reward: str, goals: bool
) -> None:
    """Everything that comes out equals what Gymnasium makes of single environments."""
    settings: dict[str, Any] = {
        "difficulty": "easy",
        "image_size": 16,
        "reward": reward,
        "goal_observation": goals,
    }
    count = 5
    native = gymnasium.make_vec(MAZE_ID, num_envs=count, autoreset_mode=mode, **settings)
    reference = SyncVectorEnv(
        [lambda: gymnasium.make(MAZE_ID, **settings)] * count, autoreset_mode=mode
    )
    rng = np.random.default_rng(0)
    ended = terminations = truncations = 0
    native_out: tuple[Any, ...] = native.reset(seed=4)
    reference_out: tuple[Any, ...] = reference.reset(seed=4)
    for _ in range(130):
        assert data_equivalence(native_out, reference_out, exact=True)
        if mode is AutoresetMode.DISABLED and len(native_out) > 2:
            done = native_out[2] | native_out[3]
            if done.any():
                native_out = native.reset(options={"reset_mask": done})
                reference_out = reference.reset(options={"reset_mask": done})
                assert data_equivalence(native_out, reference_out, exact=True)
        actions = rng.uniform(-1.5, 1.5, (count, 2)).astype(np.float32)
        # One maze hardly moves, so that it meets the step limit.
        actions[0] *= 0.01
        native_out, reference_out = native.step(actions), reference.step(actions)
        terminations += native_out[2].sum()
        truncations += native_out[3].sum()
        ended += (native_out[2] | native_out[3]).sum()
    assert terminations > 3
    assert truncations >= 1
    assert ended > 5


def test_rewards_of_many_goals_are_those_of_a_step() -> None:
    envs = MazeVectorEnv(6, difficulty="easy", image_size=16, goal_observation=True)
    envs.reset(seed=0)
    seen, rewards, *_, infos = envs.step(envs.action_space.sample())
    again = envs.compute_reward(seen["achieved_goal"], seen["desired_goal"], infos)
    np.testing.assert_array_equal(again, rewards)


def test_a_finished_maze_needs_a_reset_when_autoreset_is_disabled() -> None:
    envs = MazeVectorEnv(2, max_episode_steps=1, autoreset_mode=AutoresetMode.DISABLED)
    envs.reset(seed=0)
    envs.step(np.zeros((2, 2), np.float32))
    with pytest.raises(ResetNeeded, match=r"\[0, 1\]"):
        envs.step(np.zeros((2, 2), np.float32))


def test_what_was_handed_out_does_not_change() -> None:
    envs = MazeVectorEnv(4, max_episode_steps=2, image_size=16)
    handed_out: list[tuple[Any, Any]] = []

    def remember(out: tuple[Any, ...]) -> None:
        arrays = [out[0], *[v for v in out[-1].values() if isinstance(v, np.ndarray)]]
        handed_out.extend((array, array.copy()) for array in arrays)

    remember(envs.reset(seed=0))
    for _ in range(6):
        remember(envs.step(envs.action_space.sample()))
    for array, copy in handed_out:
        np.testing.assert_array_equal(array, copy)


def test_a_vector_wrapper_of_gymnasium_works_on_it() -> None:
    envs = gymnasium.make_vec(MAZE_ID, num_envs=2, difficulty="easy")
    listed = gymnasium.wrappers.vector.DictInfoToList(envs)
    _, infos = listed.reset(seed=0)
    assert [set(info) for info in infos] == [{"state", "target", "goal", "success", "distance"}] * 2
