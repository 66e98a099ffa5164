"""The Franka desk: kinematics, physics, images, tasks, and the Gymnasium environment."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded

import processes

pytest.importorskip("mujoco", reason="MuJoCo 4 needs Python 3.11")

import mujoco

from hvf.envs import DESK_ID
from hvf.envs.desk import opengl, panda
from hvf.envs.desk import simulator as desk
from hvf.envs.desk.arrangement import Arrangement, random_arrangement, settled
from hvf.envs.desk.env import DeskEnv
from hvf.envs.desk.pool import DeskPool
from hvf.envs.desk.rendering import DeskRenderer
from hvf.envs.desk.scene import (
    BASE,
    BLOCKS,
    BUTTON_LIT,
    BUTTON_PLACES,
    load_scene,
    scene_spec,
)
from hvf.envs.desk.simulator import WORKSPACE, DeskSimulator, DivergenceError
from hvf.envs.desk.tasks import MAX_STEPS, TASKS, make_episodes, object_success
from scripted_desk import Script, successes

OBJECTS = slice(7, 33)
"""Door, drawer, buttons and cubes among the positions."""


@pytest.fixture(scope="module")
def simulator() -> DeskSimulator:
    return DeskSimulator()


@pytest.fixture(scope="module")
def renderer(simulator: DeskSimulator) -> Iterator[DeskRenderer]:
    renderer = DeskRenderer(simulator.model)
    yield renderer
    renderer.close()


def empty_table(**options: Any) -> Arrangement:
    """The cubes on the floor beyond the desk, nothing in the arm's way."""
    blocks = np.array([[1.2, y, BASE[2] + 0.035] for y in (-0.3, 0.0, 0.3)])
    return Arrangement(**{"door": 0.2, "drawer": 0.0, "blocks": blocks, **options})


def random_states(simulator: DeskSimulator, count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return settled(simulator, [random_arrangement(rng, None) for _ in range(count)])


# ---- the arm -----------------------------------------------------------------------------------


def published_frames(joints: np.ndarray) -> list[np.ndarray]:
    """Frames of the links and the tool, by the manufacturer's table and Craig's formula."""
    table = [
        (0, 0.333, 0),
        (0, 0, -np.pi / 2),
        (0, 0.316, np.pi / 2),
        (0.0825, 0, np.pi / 2),
        (-0.0825, 0.384, -np.pi / 2),
        (0, 0, np.pi / 2),
        (0.088, 0, np.pi / 2),
        (0, 0.107 + 0.1034, 0),
    ]
    pose = np.eye(4)
    pose[:3, 3] = (0, 0, -0.10)
    frames = []
    for (a, d, alpha), theta in zip(table, [*joints, -np.pi / 4], strict=True):
        ca, sa, ct, st = np.cos(alpha), np.sin(alpha), np.cos(theta), np.sin(theta)
        pose = pose @ np.array(
            [
                [ct, -st, 0, a],
                [st * ca, ct * ca, -sa, -d * sa],
                [st * sa, ct * sa, ca, d * ca],
                [0, 0, 0, 1],
            ]
        )
        frames.append(pose)
    return frames


def test_the_arm_has_the_published_kinematics(simulator: DeskSimulator) -> None:
    data = mujoco.MjData(simulator.model)
    rng = np.random.default_rng(0)
    for joints in rng.uniform(panda.LOWER, panda.UPPER, (20, 7)):
        expected = published_frames(joints)
        data.qpos[:7] = joints
        mujoco.mj_kinematics(simulator.model, data)
        for i, pose in enumerate(expected[:7]):
            body = data.body(f"panda_link{i + 1}")
            np.testing.assert_allclose(body.xpos, pose[:3, 3], atol=1e-9)
            np.testing.assert_allclose(body.xmat.reshape(3, 3), pose[:3, :3], atol=1e-9)
        finger = data.geom("finger").xpos + data.geom("finger").xmat[2::3] * panda.FINGER[2]
        np.testing.assert_allclose(finger, expected[7][:3, 3], atol=1e-9)
        np.testing.assert_allclose(panda.frames(joints[None], BASE)[0], expected, atol=1e-12)


def test_the_arm_has_the_published_limits_and_masses(simulator: DeskSimulator) -> None:
    model = simulator.model
    limits = [2.8973, 1.7628, 2.8973, 3.0718, 2.8973, 0.0175, 2.8973]
    np.testing.assert_array_equal(model.jnt_range[:7, 0], np.negative(limits))
    np.testing.assert_array_equal(
        model.jnt_range[:7, 1], [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]
    )
    np.testing.assert_array_equal(model.actuator_forcerange[:, 1], [87] * 4 + [12] * 3)
    masses = [model.body(f"panda_link{i}").mass[0] for i in range(1, 8)]
    expected = [4.970684, 0.646926, 3.228604, 3.587895, 1.225946, 1.666555, 0.735522]
    np.testing.assert_allclose(masses, expected)


def test_inverse_kinematics_reaches_the_workspace_pointing_down() -> None:
    rng = np.random.default_rng(0)
    targets = rng.uniform(*WORKSPACE, (60, 3))
    joints = panda.inverse_kinematics(np.tile(panda.HOME, (60, 1)), targets, BASE, 40)
    for angles, target in zip(joints, targets, strict=True):
        tool = published_frames(angles)[-1]
        assert np.abs(tool[:3, 3] - target).max() < 1e-3
        assert np.abs(tool[:3, :3] - np.diag([1, -1, -1])).max() < 2e-3
        assert (angles >= panda.LOWER).all()
        assert (angles <= panda.UPPER).all()


def test_the_fingertip_follows_actions_within_millimetres(simulator: DeskSimulator) -> None:
    rng = np.random.default_rng(0)
    tips = rng.uniform((0.3, -0.4, 0.05), (0.48, 0.4, 0.12), (20, 3))
    states = settled(simulator, [empty_table(end_effector=tuple(tip)) for tip in tips])
    errors, tilts = [], []
    for _ in range(25):
        tips = desk.end_effectors(states)
        wanted = np.clip(
            tips + 0.08 * rng.uniform(-1, 1, (20, 3)), (0.3, -0.42, 0.045), (0.5, 0.42, 0.12)
        )
        states = simulator.step(states, (wanted - tips) / 0.08)
        reached = np.clip(wanted, tips - 0.08, tips + 0.08)
        errors.append(np.linalg.norm(desk.end_effectors(states) - reached, axis=1))
        tilts.append(np.arccos(-panda.frames(states[:, :7], BASE)[:, 7, 2, 2].clip(-1, 1)))
    assert np.mean(errors) < 0.003
    assert np.max(errors) < 0.015
    assert np.degrees(np.max(tilts)) < 1.5


# ---- physics -----------------------------------------------------------------------------------


def test_nothing_moves_under_zero_action_after_200_resets(
    simulator: DeskSimulator, renderer: DeskRenderer
) -> None:
    starts = [random_states(simulator, 160)]
    starts += [make_episodes(simulator, task, 1, 0, 10).starts for task in TASKS]
    states = before = np.concatenate(starts)
    assert len(states) == 200
    for _ in range(5):
        states = simulator.step(states, np.zeros((200, 3)))
    assert np.abs(states - before)[:, OBJECTS].max() < 1e-6
    assert np.abs(desk.end_effectors(states) - desk.end_effectors(before)).max() < 3e-4
    # Of the spare degree of freedom little is left to move.
    assert np.abs(states - before)[:, :7].max() < 0.01
    changed = renderer.render(states[::20]).astype(int) - renderer.render(before[::20])
    assert np.abs(changed).mean() < 0.1


def test_resets_put_things_in_different_places(simulator: DeskSimulator) -> None:
    seen = desk.observables(random_states(simulator, 200))
    for name in ("door", "drawer"):
        values = seen[:, desk.OBSERVABLES.index(name)]
        travel = {"door": 0.40, "drawer": 0.10}[name]
        # Uniform: the mean of 200 is within five deviations of the middle.
        assert abs(values.mean() - travel / 2) < 5 * travel / np.sqrt(12 * 200)
    blocks = seen[:, 8:].reshape(200, 3, 3)
    assert np.ptp(blocks[..., 1]) > 0.6
    gaps = np.linalg.norm(blocks[:, :, None] - blocks[:, None], axis=3)
    assert (gaps + np.eye(3)).min() > 0.14


def test_a_batch_gives_what_single_desks_give_on_any_number_of_threads(
    simulator: DeskSimulator,
) -> None:
    states = random_states(simulator, 7)
    actions = np.random.default_rng(1).uniform(-1, 1, (7, 6, 3))
    together = simulator.rollout(states, actions)
    threaded = DeskSimulator(threads=3).rollout(states, actions)
    np.testing.assert_array_equal(together, threaded)
    for i in range(7):
        state = states[i : i + 1]
        for step in range(6):
            state = simulator.step(state, actions[i : i + 1, step])
            np.testing.assert_array_equal(state[0], together[i, step])


def test_rest_is_slept_through_but_nothing_sleeps_in_the_air(simulator: DeskSimulator) -> None:
    blocks = np.array([[0.45, y, 0.035] for y in (-0.25, 0.0, 0.25)])
    state = settled(simulator, [empty_table(blocks=blocks, end_effector=(0.45, -0.06, 0.05))])
    np.testing.assert_array_equal(state[0, desk.POSITIONS :], 0.0)
    hanging = state.copy()
    hanging[0, desk.BLOCKS.start + 7 + 2] += 0.05
    for _ in range(3):
        hanging = simulator.step(hanging, np.zeros((1, 3)))
    assert np.abs(desk.block_positions(hanging)[0, 1, 2] - 0.035) < 1e-3
    # What the arm touches wakes up, and what that touches.
    pushed = state
    for _ in range(8):
        pushed = simulator.step(pushed, np.array([[0.0, 0.5, -0.2]]))
    moved = np.abs(desk.block_positions(pushed) - desk.block_positions(state))[0].max(axis=1)
    assert moved[0] < 1e-6
    assert (moved[1:] > 0.02).all()


def test_hostile_actions_do_no_harm(simulator: DeskSimulator) -> None:
    """Full speed along every axis and diagonal, and back and forth, for 40 steps."""
    directions = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), -1).reshape(27, 3).astype(float)
    states = random_states(simulator, 54)
    actions = np.concatenate([directions, directions])
    for step in range(40):
        actions[27:] = directions * (-1) ** (step // 2)
        states = simulator.step(states, actions)
    tips = desk.end_effectors(states)
    assert (tips > WORKSPACE[0] - 0.05).all()
    assert (tips < WORKSPACE[1] + 0.05).all()
    assert (states[:, desk.DOOR] > -0.01).all()
    assert (states[:, desk.DOOR] < 0.41).all()
    # No cube under the floor or in the table.
    assert (desk.block_positions(states)[..., 2] > BASE[2] + 0.02).all()
    assert np.abs(desk.block_positions(states)).max() < 1.0


def test_actions_beyond_the_box_are_clipped(simulator: DeskSimulator) -> None:
    states = random_states(simulator, 2)
    far = simulator.step(states, np.array([[50.0, -2.0, 1e30], [0.3, -9.0, 0.0]]))
    near = simulator.step(states, np.array([[1.0, -1.0, 1.0], [0.3, -1.0, 0.0]]))
    np.testing.assert_array_equal(far, near)


@pytest.mark.parametrize("button", range(3))
def test_the_arm_presses_buttons_and_they_light_up(
    button: int, simulator: DeskSimulator, renderer: DeskRenderer
) -> None:
    above = (*BUTTON_PLACES[button], 0.09)
    state = settled(simulator, [empty_table(end_effector=above)])
    yellow = np.array([255, 240, 90])

    def lit(state: np.ndarray) -> bool:
        return bool((np.abs(renderer.render(state)[0] - yellow).sum(axis=-1) < 120).any())

    assert not lit(state)
    for _ in range(2):
        state = simulator.step(state, np.array([[0, 0, -1.0]]))
    depths = state[0, desk.BUTTONS]
    assert depths[button] > BUTTON_LIT
    assert np.delete(depths, button).max() < 1e-3
    assert lit(state)
    for _ in range(2):
        state = simulator.step(state, np.array([[0, 0, 1.0]]))
    assert np.abs(state[0, desk.BUTTONS]).max() < 1e-3
    assert not lit(state)


def test_a_finger_that_comes_from_the_side_presses_a_button_too(simulator: DeskSimulator) -> None:
    x, y = BUTTON_PLACES[1]
    state = settled(simulator, [empty_table(end_effector=(x + 0.10, y, 0.027))])
    deepest = 0.0
    for _ in range(4):
        state = simulator.step(state, np.array([[-0.6, 0, -0.1]]))
        deepest = max(deepest, state[0, desk.BUTTONS][1])
    assert deepest > BUTTON_LIT
    assert desk.end_effectors(state)[0, 0] < x - 0.05


def test_a_cube_on_a_button_stays_where_it_is(simulator: DeskSimulator) -> None:
    blocks = np.array([[x, y, 0.035] for x, y in BUTTON_PLACES])
    blocks[1, 0] = 0.60
    states = settled(simulator, [empty_table(blocks=blocks)])
    for _ in range(5):
        states = simulator.step(states, np.zeros((1, 3)))
    assert np.abs(desk.block_positions(states)[0] - blocks).max() < 1e-3
    assert np.abs(states[0, desk.BUTTONS]).max() < 1e-6


def test_a_simulation_that_diverges_is_named(
    simulator: DeskSimulator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    states = random_states(simulator, 4)
    states[2, 60] = 1e9
    with pytest.raises(DivergenceError, match=r"\[2\]") as caught:
        simulator.step(states, np.zeros((4, 3)))
    assert caught.value.which == [2]
    with pytest.raises(DivergenceError) as caught:
        simulator.rollout(states, np.zeros((4, 2, 3)))
    assert (caught.value.which, caught.value.step) == ([2], 0)
    assert not list(tmp_path.iterdir())  # MuJoCo would leave a log file


# ---- images ------------------------------------------------------------------------------------


def projected(point: np.ndarray, size: int) -> np.ndarray:
    """Pixel (column, row) of a point, by a pinhole camera as the scene's study describes it."""
    azimuth, elevation = np.radians(75), np.radians(-58)
    forward = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    ray = point - (np.array([0.49, 0, 0.03]) - 1.12 * forward)
    scale = size / 2 / np.tan(np.radians(45) / 2) / (ray @ forward)
    return np.array([size / 2 + scale * (ray @ right), size / 2 - scale * (ray @ up)]) - 0.5


def test_cubes_appear_where_a_pinhole_camera_sees_them(
    simulator: DeskSimulator, renderer: DeskRenderer
) -> None:
    places = np.array([[0.45, -0.25, 0.035], [0.50, 0.0, 0.035], [0.42, 0.25, 0.035]])
    away = (0.30, -0.40, 0.12)
    state = settled(simulator, [empty_table(blocks=places, door=0.0, end_effector=away)])
    image = renderer.render(state)[0].astype(int)
    for i in range(len(BLOCKS)):
        others = np.delete(image, i, axis=-1)
        grey = np.ptp(others, axis=-1) < 45  # unlike the orange door
        rows, columns = np.nonzero((image[..., i] > others.max(axis=-1) + 50) & grey)
        assert len(rows) > 15
        expected = projected(places[i], 64)
        assert np.hypot(columns.mean() - expected[0], rows.mean() - expected[1]) < 1.5


def test_images_are_twice_as_large_ones_averaged(
    simulator: DeskSimulator, renderer: DeskRenderer
) -> None:
    states = random_states(simulator, 3)
    small, large = DeskRenderer(simulator.model, 32), renderer
    # 32 is drawn at 64, and 64 at 128: averaging 64 again differs from 32 by sampling only.
    halved = large.render(states).reshape(3, 32, 2, 32, 2, 3).mean(axis=(2, 4))
    assert np.abs(halved - small.render(states)).mean() < 3
    small.close()
    with pytest.raises(RuntimeError, match="closed"):
        small.render(states)


def test_door_drawer_and_arm_are_seen_to_move(
    simulator: DeskSimulator, renderer: DeskRenderer
) -> None:
    base = settled(simulator, [empty_table()])
    image = renderer.render(base)[0].astype(int)
    for change in ({"door": 0.23}, {"drawer": 0.03}, {"end_effector": (0.36, 0.03, 0.12)}):
        moved = renderer.render(settled(simulator, [empty_table(**change)]))[0]
        assert (np.abs(moved - image).max(axis=-1) > 20).sum() >= 8


def test_missing_opengl_names_the_debian_package(monkeypatch: pytest.MonkeyPatch) -> None:
    missing = {
        name: (("libNoSuch.so",), packages) for name, (_, packages) in opengl._LIBRARIES.items()
    }
    monkeypatch.setattr(opengl, "_LIBRARIES", missing)
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    with pytest.raises(RuntimeError, match=r"apt install libosmesa6 \(or libegl1"):
        DeskRenderer(load_scene())
    for name, package in (("osmesa", "libosmesa6"), ("egl", "libegl1")):
        monkeypatch.setenv("MUJOCO_GL", name)
        with pytest.raises(RuntimeError, match=f"apt install {package}"):
            opengl.check_environment()
    monkeypatch.setenv("MUJOCO_GL", "crayons")
    with pytest.raises(ValueError, match=r"MUJOCO_GL.*'crayons'"):
        opengl.check_environment()


# ---- tasks -------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", TASKS)
def test_goals_are_successes_and_starts_are_not(task: Any, simulator: DeskSimulator) -> None:
    episodes = make_episodes(simulator, task, 0, 0, 12)
    starts = object_success(task, episodes.blocks, episodes.starts)
    stages = [
        object_success(task, episodes.blocks, episodes.stages[:, j])
        for j in range(episodes.stages.shape[1])
    ]
    blocks = {"door": 0, "two_block": 2, "door_block": 1, "door_two_block": 2}[task]
    np.testing.assert_array_equal(episodes.blocks.sum(axis=1), blocks)
    # One more object is done in each stage.
    wanted = episodes.stages.shape[1]
    for j, done in enumerate([starts, *stages]):
        np.testing.assert_array_equal((~done).sum(axis=1), wanted - j)
    np.testing.assert_array_equal(episodes.goals, episodes.stages[:, -1])


def test_success_has_the_papers_thresholds(simulator: DeskSimulator) -> None:
    state = settled(simulator, [empty_table(door=0.0)])
    none = np.zeros((1, 3), bool)
    for opening, closed in ((0.0, True), (0.0199, True), (0.0201, False), (0.3, False)):
        state[:, desk.DOOR] = opening
        assert object_success("door", none, state)[0].tolist() == [closed, True, True, True]
    wanted = np.array([[True, False, True]])
    for height, fallen in ((0.035, False), (0.019, True), (-0.065, True)):
        state[:, 14], state[:, 21] = height, 0.035
        expected = [True, fallen, True, True]
        assert object_success("two_block", wanted, state)[0].tolist() == expected


def test_episodes_are_functions_of_seed_and_number(simulator: DeskSimulator) -> None:
    many = make_episodes(simulator, "door_block", 5, 0, 4)
    one = make_episodes(simulator, "door_block", 5, 3, 1)
    np.testing.assert_array_equal(many.starts[3], one.starts[0])
    np.testing.assert_array_equal(many.stages[3], one.stages[0])
    other = make_episodes(simulator, "door_block", 6, 3, 1)
    assert (one.starts != other.starts).any()


def test_goals_leave_the_other_objects_where_they_were(simulator: DeskSimulator) -> None:
    episodes = make_episodes(simulator, "two_block", 3, 0, 10)
    before, after = (desk.block_positions(x) for x in (episodes.starts, episodes.goals))
    np.testing.assert_allclose(before[~episodes.blocks], after[~episodes.blocks], atol=1e-6)
    np.testing.assert_array_equal(
        episodes.starts[:, [desk.DOOR, desk.DRAWER]], episodes.goals[:, [desk.DOOR, desk.DRAWER]]
    )


@pytest.mark.parametrize("task", TASKS)
def test_a_script_that_reads_the_state_does_the_task(task: Any) -> None:
    # Over 50 trials of each task: `python tests/scripted_desk.py`.
    assert successes(task, 6, seed=0).all()


def test_the_drawer_can_be_hooked_and_pulled(simulator: DeskSimulator) -> None:
    states = settled(simulator, [empty_table(drawer=0.0, door=0.0)])
    script = Script("door", np.zeros(3, bool), states[0])
    script.state = states[0]
    for action in script.open_drawer():
        states = simulator.step(states, action[None])
        script.state = states[0]
    assert states[0, desk.DRAWER] > 0.06


# ---- the Gymnasium environment -----------------------------------------------------------------


def complaints(caught: list[warnings.WarningMessage]) -> list[str]:
    checkers = [w for w in caught if "gymnasium" in w.filename or "stable_baselines3" in w.filename]
    return [str(w.message) for w in checkers]


def test_gymnasiums_checker_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    from gymnasium.utils.env_checker import check_env

    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        env = gymnasium.make(DESK_ID, task="door_two_block", disable_env_checker=True)
        check_env(env.unwrapped)
    assert complaints(caught) == []


@pytest.mark.parametrize("goals", [False, True])
def test_stable_baselines_checker_passes(goals: bool) -> None:
    from stable_baselines3.common.env_checker import check_env

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(
            gymnasium.make(DESK_ID, task="two_block", goal_observation=goals).unwrapped, warn=True
        )
    assert complaints(caught) == []


def test_importing_hvf_loads_no_mujoco() -> None:
    code = "import sys, hvf; assert 'mujoco' not in sys.modules and 'OpenGL' not in sys.modules"
    processes.run(processes.python(code), check=True)


def test_saving_and_restoring_is_exact() -> None:
    env, other = DeskEnv("door_two_block"), DeskEnv("door_two_block")
    env.action_space.seed(0)
    env.reset(seed=4)
    for _ in range(6):
        *_, info = env.step(env.action_space.sample())
    saved = info["state"]
    observation, restored = other.reset(seed=4, options={"state": saved})
    np.testing.assert_array_equal(restored["state"], saved)
    for _ in range(8):
        action = env.action_space.sample()
        first, second = env.step(action), other.step(action)
        np.testing.assert_array_equal(first[0], second[0])
        np.testing.assert_array_equal(first[4]["state"], second[4]["state"])
        observation = first[0]
    assert observation.dtype == np.uint8
    env.close()
    other.close()


def test_info_has_the_state_and_every_objects_success(simulator: DeskSimulator) -> None:
    env = DeskEnv("door_block")
    expected = make_episodes(simulator, "door_block", 2, 0, 2)
    for number in range(2):
        image, info = env.reset(seed=2 if number == 0 else None)
        np.testing.assert_array_equal(info["state"], expected.starts[number])
        np.testing.assert_array_equal(info["goal_state"], expected.goals[number])
        assert info["object_success"]["door"] is False
        assert sum(not done for done in info["object_success"].values()) == 2
        assert image.shape == info["goal"].shape == (64, 64, 3)
        seen = [*info["end_effector"], info["door"], info["drawer"], *info["buttons"]]
        named = desk.observables(info["state"][None])[0]
        np.testing.assert_array_equal([*seen, *info["blocks"].ravel()], named)
        assert len(named) == len(desk.OBSERVABLES)
    env.reset(options={"state": expected.goals[1], "episode": 1})
    *_, reward, terminated, truncated, info = env.step(np.zeros(3, np.float32))
    assert (reward, terminated, truncated) == (1.0, True, False)
    assert all(info["object_success"].values())
    env.close()


def test_episodes_are_truncated_after_the_tasks_steps() -> None:
    env = DeskEnv("door", image_size=8)
    env.reset(seed=0)
    for step in range(1, MAX_STEPS["door"] + 1):
        *_, terminated, truncated, _ = env.step(np.zeros(3, np.float32))
        assert (terminated, truncated) == (False, step == 50)
    env.close()


def test_pictures_show_scene_and_goal() -> None:
    env = gymnasium.make(DESK_ID, task="door", render_mode="rgb_array")
    observation, info = env.reset(seed=3)
    picture = env.render()
    assert picture.shape == (256, 520, 3)
    for half, image in ((picture[:, :256], observation), (picture[:, 264:], info["goal"])):
        averaged = half.reshape(64, 4, 64, 4, 3).mean(axis=(1, 3))
        # The same but for how edges are sampled; scene and goal differ by 8 and more.
        assert np.abs(averaged - image).mean() < 3
    env.close()


def test_vector_environments_of_gymnasium_work() -> None:
    envs = gymnasium.make_vec(DESK_ID, 2, vectorization_mode="sync", task="door", image_size=16)
    observations, infos = envs.reset(seed=0)
    assert observations.shape == (2, 16, 16, 3)
    assert infos["state"].shape == (2, 63)
    envs.step(envs.action_space.sample())
    envs.close()


def test_a_diverged_episode_is_truncated_and_names_seed_and_step() -> None:
    env = DeskEnv("door", image_size=8)
    _, info = env.reset(seed=9)
    env.step(np.zeros(3, np.float32))
    wild = info["state"].copy()
    wild[62] = 1e9
    first, _ = env.reset(seed=9, options={"state": wild, "episode": 3})
    last, reward, terminated, truncated, info = env.step(np.zeros(3, np.float32))
    assert (reward, terminated, truncated) == (0.0, False, True)
    assert "diverged: seed 9, episode 3, step 0" in info["error"]
    np.testing.assert_array_equal(last, first)
    np.testing.assert_array_equal(info["state"], wild)
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(3, np.float32))
    env.reset(seed=9)
    *_, info = env.step(np.zeros(3, np.float32))
    assert "error" not in info
    env.close()


@pytest.mark.parametrize("task", TASKS)
def test_rewards_of_goals_are_those_of_the_steps(task: Any, simulator: DeskSimulator) -> None:
    env = DeskEnv(task, image_size=8, goal_observation=True)
    plain = DeskEnv(task, image_size=8)
    ways = make_episodes(simulator, task, 5, 0, 1).ways[0].reshape(-1, 63)
    seen, rewards = [], []
    for state in ways:
        options = {"state": state, "episode": 0}
        env.reset(seed=5, options=options)
        plain.reset(seed=5, options=options)
        observation, reward, *_, info = env.step(np.zeros(3, np.float32))
        image, expected, *_ = plain.step(np.zeros(3, np.float32))
        assert env.observation_space.contains(observation)
        np.testing.assert_array_equal(observation["observation"], image)
        achieved, desired = observation["achieved_goal"], observation["desired_goal"]
        assert reward == expected == env.compute_reward(achieved, desired, {})
        assert achieved.tolist() == [info["door"], *info["blocks"][:, 2]]
        seen.append(observation)
        rewards.append(reward)
    together = env.compute_reward(
        *(np.stack([one[key] for one in seen]) for key in ("achieved_goal", "desired_goal")), None
    )
    assert together.tolist() == rewards
    assert 1.0 in rewards
    assert 0.0 in rewards
    # In hindsight: what was achieved is reached where it was wanted.
    assert env.compute_reward(achieved, achieved, None) == 1
    for bad in (np.zeros(3), np.full(4, np.nan), "there"):
        with pytest.raises(ValueError, match="achieved_goal"):
            env.compute_reward(bad, desired, None)
    env.close()
    plain.close()


# ---- bad input ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "error", "names"),
    [
        ({"task": "dishes"}, ValueError, "task.*'dishes'"),
        ({"image_size": 4}, ValueError, "image_size.*4"),
        ({"image_size": 6.5}, TypeError, "image_size.*6.5"),
        ({"render_mode": "ascii"}, ValueError, "render_mode"),
        ({"scene": "/nowhere/scene.xml"}, FileNotFoundError, "/nowhere/scene.xml"),
    ],
)
def test_bad_settings_are_refused(
    settings: dict[str, Any], error: type[Exception], names: str
) -> None:
    with pytest.raises(error, match=names):
        DeskEnv(**settings)


@pytest.mark.parametrize("content", ["", "<mujoco", "<mujoco><worldbody/></mujoco>", "hello"])
def test_a_scene_that_cannot_be_used_is_refused(content: str, tmp_path: Path) -> None:
    path = tmp_path / "scene.xml"
    path.write_text(content)
    with pytest.raises(ValueError, match=r"scene\.xml"):
        load_scene(path)


def test_a_scene_of_ones_own_is_used(tmp_path: Path) -> None:
    spec = scene_spec()
    spec.geom("red").rgba = (1, 1, 0, 1)
    spec.compile()
    path = tmp_path / "scene.xml"
    path.write_text(spec.to_xml())
    assert load_scene(path).geom("red").rgba.tolist() == [1, 1, 0, 1]


@pytest.mark.parametrize(
    "action", [[np.nan, 0, 0], [0, np.inf, 0], [0, 0], [[0, 0, 0]], ["a", "b", "c"]]
)
def test_bad_actions_are_refused(action: Any) -> None:
    env = DeskEnv("door", image_size=8)
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(3, np.float32))
    env.reset(seed=0)
    with pytest.raises((ValueError, TypeError), match="action"):
        env.step(action)
    env.close()


def test_bad_options_are_refused() -> None:
    env = DeskEnv("door", image_size=8)
    for options in (
        {"colour": 3},
        {"episode": -1},
        {"episode": "first"},
        {"state": np.zeros(5)},
        {"state": np.full(63, np.nan)},
        {"state": "here"},
    ):
        with pytest.raises(ValueError, match="options"):
            env.reset(seed=0, options=options)
    env.close()


def test_bad_batches_are_refused(simulator: DeskSimulator, renderer: DeskRenderer) -> None:
    states = random_states(simulator, 2)
    for call, name in (
        (lambda: simulator.step(states[:, :5], np.zeros((2, 3))), "states"),
        (lambda: simulator.step(states, np.zeros((3, 3))), "actions"),
        (lambda: simulator.step(states, np.full((2, 3), np.nan)), "actions"),
        (lambda: simulator.rollout(states, np.zeros((2, 3))), "actions"),
        (lambda: renderer.render(states * np.nan), "states"),
        (lambda: DeskSimulator(threads=0), "threads"),
        (lambda: make_episodes(simulator, "door", -1, 0, 1), "seed"),
        (lambda: DeskPool(workers=-1), "workers"),
    ):
        with pytest.raises(ValueError, match=name):
            call()


# ---- processes ---------------------------------------------------------------------------------


def test_processes_render_and_roll_out_as_one_does(
    simulator: DeskSimulator, renderer: DeskRenderer
) -> None:
    states = random_states(simulator, 5)
    actions = np.random.default_rng(0).uniform(-1, 1, (5, 3, 3))
    ends = simulator.rollout(states, actions)[:, -1]
    with DeskPool(2) as pool:
        np.testing.assert_array_equal(pool.render(states), renderer.render(states))
        found, images = pool.rollout(states, actions)
        np.testing.assert_array_equal(found, ends)
        np.testing.assert_array_equal(images, renderer.render(ends))
        states[4, 60] = 1e9
        with pytest.raises(DivergenceError) as caught:
            pool.rollout(states, actions)
        assert caught.value.which == [4]


def test_a_missing_mujoco_is_one_clear_line() -> None:
    code = (
        "import sys, importlib.util as util; found = util.find_spec;"
        "util.find_spec = lambda name, *rest: None if name == 'mujoco' else found(name, *rest);"
        "from hvf.cli import main; sys.exit(main(['collect', 'desk', '--out', 'x.h5']))"
    )
    run = processes.run(processes.python(code))
    assert run.returncode == 1
    assert "needs MuJoCo 4 and Python 3.11" in run.stderr
    assert "Traceback" not in run.stderr


def test_torch_can_optimise_after_the_desk_was_drawn() -> None:
    pytest.importorskip("torch")
    program = (
        "import gymnasium, hvf\n"
        "environment = gymnasium.make('hvf/FrankaDesk-v0', task='door')\n"
        "environment.reset(seed=0)\n"
        "import torch\n"
        "layer = torch.nn.Linear(1, 1)\n"
        "torch.optim.Adam(layer.parameters()).step()\n"
        "print('fine')\n"
    )
    done = processes.run(processes.python(program))
    assert done.stdout == "fine\n", done.stderr
