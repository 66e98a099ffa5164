"""The maze's simulator as a world model, against drawing every frame and SciPy."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy import ndimage

import hvf_core


def tasks(count: int, difficulty: str = "hard") -> tuple[np.ndarray, np.ndarray]:
    starts, targets = hvf_core.maze_episodes(7, 0, count, difficulty)
    return starts, np.concatenate([targets, starts[:, 2:]], axis=1)


def drawn_costs(
    starts: np.ndarray, goals: np.ndarray, actions: np.ndarray, blur: float, over_horizon: str
) -> np.ndarray:
    """Steps, draws and compares every frame; `goals` are images."""
    problems, candidates, steps, _ = actions.shape
    states = np.repeat(starts, candidates, axis=0)
    costs = []
    for step in range(steps):
        states = hvf_core.maze_step(states, actions[:, :, step].reshape(-1, 2))
        frames = hvf_core.maze_render(states) / 255.0 - np.repeat(goals, candidates, axis=0) / 255.0
        if blur:
            frames = ndimage.gaussian_filter(frames, (0, blur, blur, 0))
        costs.append((frames**2).sum((1, 2, 3)).reshape(problems, candidates) / 64**2)
    return {"last": costs[-1], "sum": sum(costs), "min": np.min(costs, axis=0)}[over_horizon]


@pytest.mark.parametrize("over_horizon", ["last", "sum", "min"])
@pytest.mark.parametrize("blur", [0.0, 1.0, 3.0])
def test_costs_are_those_of_the_drawn_frames(blur: float, over_horizon: str) -> None:
    starts, goal_states = tasks(4)
    actions = np.random.default_rng(0).uniform(-3, 3, (4, 20, 5, 2)).astype(np.float32)
    world = hvf_core.MazeWorld(blur=blur, over_horizon=over_horizon)
    images = hvf_core.maze_render(goal_states)
    noise = np.random.default_rng(1).integers(0, 256, images.shape, dtype=np.uint8)
    for goals in (images, images[::-1].copy(), noise):
        costs = world.rollout_costs(hvf_core.MazeFrames(starts), goals, actions)
        expected = drawn_costs(starts, goals, actions, blur, over_horizon)
        assert costs.dtype == np.float32
        np.testing.assert_allclose(costs, expected, rtol=1e-5, atol=1e-6 * expected.mean())


def test_frames_select_and_show_their_states_and_images() -> None:
    starts, _ = tasks(3)
    frames = hvf_core.MazeFrames(starts)
    np.testing.assert_array_equal(frames.images, hvf_core.maze_render(starts))
    picked = frames[np.array([2, 0, 2, -2])]
    np.testing.assert_array_equal(picked.states, starts[[2, 0, 2, 1]])
    assert len(frames[1]) == 1
    observed = hvf_core.MazeWorld().observe(frames.images)
    np.testing.assert_allclose(observed.states, starts, atol=2e-4)
    with pytest.raises(IndexError):
        frames[3]


def test_shared_rollouts_cost_the_same_bits() -> None:
    starts, goals = tasks(5)
    actions = np.random.default_rng(0).uniform(-3, 3, (30, 5, 2)).astype(np.float32)
    for blur in (0.0, 2.0):
        world = hvf_core.MazeWorld(blur=blur)
        start, many = hvf_core.MazeFrames(starts[:1]), hvf_core.MazeFrames(goals)
        shared = world.shared_rollout_costs(start, many, actions)
        apart = world.rollout_costs(
            start[np.zeros(5, np.int64)], many, np.broadcast_to(actions, (5, *actions.shape))
        )
        np.testing.assert_array_equal(shared, apart)


def test_rollout_is_repeated_stepping() -> None:
    starts, _ = tasks(1)
    actions = np.random.default_rng(0).uniform(-4, 4, (6, 7, 2)).astype(np.float32)
    states = np.repeat(starts, 6, axis=0)
    path = hvf_core.MazeWorld().rollout(hvf_core.MazeFrames(starts), actions)
    for step in range(7):
        states = hvf_core.maze_step(states, actions[:, step])
        np.testing.assert_array_equal(path[:, step], states)


def test_oracle_subgoals_fill_free_space_evenly() -> None:
    starts, _ = tasks(1)
    latents = np.random.default_rng(0).standard_normal((5000, 1, 8)).astype(np.float32)
    drawn = hvf_core.MazeSubgoals().decode(hvf_core.MazeFrames(starts), latents).states
    assert len(drawn) == 5000
    np.testing.assert_array_equal(drawn[:, 2:], np.repeat(starts[:, 2:], 5000, axis=0))
    # Free means: a step without force stays.
    still = hvf_core.maze_step(drawn, np.zeros((5000, 2), np.float32))
    np.testing.assert_array_equal(still, drawn)
    counts = np.histogram2d(drawn[:, 0], drawn[:, 1], bins=2)[0]
    assert abs(counts / 1250 - 1).max() < 0.1


def test_oracle_reads_the_scene_off_an_image() -> None:
    starts, _ = tasks(1)
    latents = np.random.default_rng(0).standard_normal((4, 2, 8)).astype(np.float32)
    subgoals = hvf_core.MazeSubgoals().decode(hvf_core.maze_render(starts), latents)
    np.testing.assert_allclose(subgoals.states[:, 2:], np.repeat(starts[:, 2:], 8, 0), atol=2e-4)


def test_search_finds_the_gaps_and_mpc_the_way_to_them() -> None:
    starts, goals = tasks(1)
    world = hvf_core.MazeWorld(blur=3.0)
    mpc = hvf_core.VisualMPC(samples=60, elites=12, iterations=3)
    search = hvf_core.HVF(mpc=mpc, subgoals=2, samples=40, elites=8, iterations=3)
    start, goal = hvf_core.maze_render(starts)[0], hvf_core.maze_render(goals)[0]
    found = search.search(world, hvf_core.MazeSubgoals(), start, goal, seed=3)
    direct = mpc.plan(world, start, goal, seed=3)
    assert found.cost < direct.cost
    assert max(found.segment_costs) == found.cost
    path = world.rollout(start, np.asarray(found.plans[0].actions)[None])[0]
    reached = np.linalg.norm(path[-1, :2] - found.subgoals.states[0, :2])
    assert reached < 0.05


def test_costs_do_not_depend_on_the_number_of_threads(
    outputs_by_threads: Callable[[str], set[str]],
) -> None:
    program = (
        "import numpy as np, hvf_core\n"
        "starts, targets = hvf_core.maze_episodes(0, 0, 3, 'medium')\n"
        "start = hvf_core.maze_render(starts)\n"
        "goal = hvf_core.maze_render(np.concatenate([targets, starts[:, 2:]], 1))\n"
        "hvf = hvf_core.HVF(mpc=hvf_core.VisualMPC(samples=40, elites=8), samples=20, elites=5)\n"
        "out = hvf.search(hvf_core.MazeWorld(blur=2.0), hvf_core.MazeSubgoals(), start[0], goal[0])"
        "\nprint(out.cost.hex(), out.latents.tobytes().hex())\n"
    )
    assert len(outputs_by_threads(program)) == 1


IMAGES = np.zeros((2, 64, 64, 3), np.uint8)
ACTIONS = np.zeros((2, 3, 1, 2), np.float32)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda w: w.rollout_costs(IMAGES[:1], IMAGES, ACTIONS), ValueError, "^starts: "),
        (lambda w: w.rollout_costs(IMAGES, IMAGES[:1], ACTIONS), ValueError, "^goals: "),
        (lambda w: w.rollout_costs(IMAGES, IMAGES, ACTIONS[0]), ValueError, "^actions: "),
        (lambda w: w.rollout(IMAGES[:1], ACTIONS[0] * np.nan), ValueError, "^actions: "),
        (lambda w: w.rollout_costs(IMAGES, IMAGES, "go"), TypeError, "^actions: "),
        (lambda w: w.rollout_costs(IMAGES, None, ACTIONS), TypeError, "^goals: "),
        (lambda w: w.rollout_costs(IMAGES[:, :32, :32], IMAGES, ACTIONS), ValueError, "^starts: "),
        (lambda w: w.observe(IMAGES.astype(np.float32)), TypeError, "^images: "),
        (lambda w: w.observe(IMAGES[..., :2]), ValueError, "^images: "),
        (lambda w: w.rollout(IMAGES, ACTIONS[0]), ValueError, "^start: "),
        (lambda w: hvf_core.MazeFrames(np.zeros((2, 3))), ValueError, "^states: "),
        (lambda w: hvf_core.MazeFrames(np.full((1, 4), 9.0)), ValueError, r"^states\[0\]: "),
        (lambda w: hvf_core.MazeFrames(np.zeros((1, 4)), 4), ValueError, "^image_size: "),
        (lambda w: hvf_core.MazeWorld(blur=-1), ValueError, "^blur: "),
        (lambda w: hvf_core.MazeWorld(over_horizon="mean"), ValueError, "^over_horizon: "),
        (lambda w: hvf_core.MazeWorld(image_size=0), ValueError, "size: "),
        (lambda w: hvf_core.MazeSubgoals(1), ValueError, "^latent_dim: "),
        (
            lambda w: hvf_core.MazeSubgoals().decode(IMAGES, np.zeros((1, 1, 8))),
            ValueError,
            "^scene: ",
        ),
        (
            lambda w: hvf_core.MazeSubgoals().decode(IMAGES[:1], np.zeros((1, 1, 7))),
            ValueError,
            "^latents: ",
        ),
    ],
)
def test_bad_input_is_one_clear_error(call: object, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        call(hvf_core.MazeWorld())  # type: ignore[operator]
