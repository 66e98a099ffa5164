"""The maze's functions in Python: what they compute, and what they refuse."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import hvf_core

REFERENCE = Path(__file__).parents[2] / "shared" / "maze" / "reference_transitions.csv"
REACH = hvf_core.MAZE_REACH


def random_states(count: int, seed: int = 0) -> np.ndarray:
    starts = [hvf_core.maze_collect(seed, i, 1, 1, 8)[2][0, 0] for i in range(count)]
    return np.array(starts)


def penetration(states: np.ndarray) -> np.ndarray:
    """Depth of the agent in a wall or the border, m, from their outlines alone."""
    x, y = states[:, 0], states[:, 1]
    depth = np.maximum(abs(x), abs(y)) - 0.275
    for wall, gap in zip((-0.15, 0.15), states[:, 2:].T, strict=True):
        depth = np.maximum(depth, np.minimum(0.03 - abs(x - wall), abs(y - gap) - 0.025))
    return depth


def test_steps_end_where_the_original_simulator_ended() -> None:
    if not REFERENCE.exists():
        pytest.skip(f"{REFERENCE} is not there")
    table = np.loadtxt(REFERENCE, delimiter=",", skiprows=1)
    w, position, action, after = table[:, 2:4], table[:, 4:6], table[:, 6:8], table[:, 8:10]
    found = hvf_core.maze_step(np.hstack([position, w]), action)[:, :2]
    error = np.hypot(*(found - after).T)
    walls = np.array(hvf_core.MAZE_WALL_X)
    same = (found[:, :1] > walls).sum(1) == (after[:, :1] > walls).sum(1)
    assert np.median(error) <= 0.5e-3
    assert np.quantile(error, 0.95) <= 8e-3
    assert same.mean() >= 0.995


def test_long_rollouts_stay_where_the_agent_can_stand() -> None:
    rng = np.random.default_rng(0)
    states, _ = hvf_core.maze_episodes(0, 0, 300, "medium")
    for _ in range(100):
        actions = rng.choice([-3, -1, 0, 1e-7, 3, 1e300], (300, 2)) * rng.uniform(0, 1, (300, 2))
        states = hvf_core.maze_step(states, actions)
        assert penetration(states).max() <= 1e-12


def test_free_motion_is_the_recurrence_of_the_original() -> None:
    actions = np.random.default_rng(1).uniform(-1.5, 1.5, (50, 2)).astype(np.float32)
    x, v = np.zeros((50, 2)), np.zeros((50, 2))
    for _ in range(250):
        v = (v + 0.002 * 0.05 * actions.astype(np.float64) / 0.125) / (1 + 0.002 * 0.01 / 0.125)
        x += 0.002 * v
    np.testing.assert_allclose(hvf_core.maze_step(np.zeros((50, 4)), actions)[:, :2], x, atol=1e-12)


@pytest.mark.parametrize("size", [8, 33, 64])
def test_frames_are_what_supersampling_gives(size: int) -> None:
    states = random_states(6)
    n = 1280 // size
    axis = ((np.arange(size * n) + 0.5) / (size * n) - 0.5) * 0.64
    x, y = axis[None, :], -axis[:, None]
    for state, frame in zip(states, hvf_core.maze_render(states, size), strict=True):
        extent = np.maximum(abs(x), abs(y))
        solid = (extent > 0.3) & (extent < 0.31)
        for wall, gap in zip((-0.15, 0.15), state[2:], strict=True):
            solid |= (abs(x - wall) < 0.005) & (abs(y - gap) > 0.05) & (extent < 0.3)
        agent = (abs(x - state[0]) < 0.025) & (abs(y - state[1]) < 0.025)
        points = np.where(solid[..., None], (130, 180, 235), (24, 36, 92))
        points = np.where(agent[..., None], (60, 200, 90), points)
        mean = points.reshape(size, n, size, n, 3).mean((1, 3))
        assert abs(frame - mean).max() <= 2 * 180 / n + 0.5
        assert abs(frame - mean).mean() < 0.6


@given(st.integers(0, 2**63), st.integers(64, 96))
def test_states_are_located_in_their_frames(seed: int, size: int) -> None:
    states = random_states(3, seed)
    np.testing.assert_allclose(
        hvf_core.maze_locate(hvf_core.maze_render(states, size)), states, atol=1.5e-4
    )


def test_located_noisy_and_blurred_frames_are_near() -> None:
    from scipy.ndimage import gaussian_filter

    states, _ = hvf_core.maze_episodes(0, 0, 100, "hard")
    frames = hvf_core.maze_render(states).astype(np.float64)
    noise = np.random.default_rng(0).normal(0, 8, frames.shape)
    noisy = np.clip(gaussian_filter(frames, (0, 1, 1, 0)) + noise, 0, 255).astype(np.uint8)
    error = abs(hvf_core.maze_locate(noisy) - states)
    assert np.median(error) < 2e-3
    assert np.quantile(error, 0.95) < 8e-3


def test_an_episode_is_the_same_in_any_range() -> None:
    starts, targets = hvf_core.maze_episodes(7, 0, 20, "hard")
    again, _ = hvf_core.maze_episodes(7, 5, 3, "hard")
    np.testing.assert_array_equal(again, starts[5:8])
    assert len(np.unique(starts[:, 0])) == 20
    assert not np.array_equal(hvf_core.maze_episodes(8, 0, 20, "hard")[1], targets)
    images, actions, states = hvf_core.maze_collect(7, 0, 10, 4, 16)
    part = hvf_core.maze_collect(7, 6, 2, 4, 16)
    for whole, chunk in zip((images, actions, states), part, strict=True):
        np.testing.assert_array_equal(chunk, whole[6:8])


def test_collected_images_and_states_follow_from_the_actions() -> None:
    images, actions, states = hvf_core.maze_collect(0, 0, 30, 10, 24)
    assert images.shape == (30, 11, 24, 24, 3)
    assert (images.dtype, actions.dtype, states.dtype) == (np.uint8, np.float32, np.float64)
    for time in range(10):
        step = hvf_core.maze_step(states[:, time], actions[:, time])
        np.testing.assert_array_equal(step, states[:, time + 1])
    np.testing.assert_array_equal(
        hvf_core.maze_render(states.reshape(-1, 4), 24), images.reshape(-1, 24, 24, 3)
    )
    assert abs(actions).max() <= 3
    assert abs(actions.mean()) < 0.25
    assert 1.6 < actions.std() < 1.85  # uniform on [-3, 3]: 1.73


def test_ground_truth_subgoals_are_the_gaps_to_pass() -> None:
    for difficulty, gaps in (("hard", (0, 1)), ("medium", (1, 1))):
        starts, targets = hvf_core.maze_episodes(0, 0, 20, difficulty)
        subgoals = hvf_core.maze_subgoals(starts, targets, 2)
        for k, gap in enumerate(gaps):
            np.testing.assert_array_equal(subgoals[:, k, 0], hvf_core.MAZE_WALL_X[gap])
            np.testing.assert_array_equal(subgoals[:, k, 1], starts[:, 2 + gap])
        np.testing.assert_array_equal(subgoals[..., 2:], np.repeat(starts[:, None, 2:], 2, 1))
    starts, targets = hvf_core.maze_episodes(0, 0, 20, "easy")
    middle = hvf_core.maze_subgoals(starts, targets, 1)[:, 0, :2]
    clear = starts[:, 0] > 0.18
    np.testing.assert_allclose(middle[clear], (starts[:, :2] + targets)[clear] / 2)


def test_success_is_being_within_five_centimetres() -> None:
    states = np.array([[0.2, 0.0, 0, 0], [0.2, 0.0, 0, 0]])
    targets = np.array([[0.2, 0.0499], [0.2, 0.0501]])
    np.testing.assert_array_equal(hvf_core.maze_success(states, targets), [True, False])


def test_results_are_the_same_with_one_thread_and_many(
    outputs_by_threads: Callable[[str], set[str]],
) -> None:
    code = (
        "import hvf_core, hashlib; parts = hvf_core.maze_collect(3, 0, 40, 20, 32);"
        "print(hashlib.sha256(b''.join(p.tobytes() for p in parts)).hexdigest())"
    )
    assert len(outputs_by_threads(code)) == 1


def test_empty_batches_give_empty_results() -> None:
    nothing = np.zeros((0, 4))
    assert hvf_core.maze_step(nothing, np.zeros((0, 2))).shape == (0, 4)
    assert hvf_core.maze_render(nothing).shape == (0, 64, 64, 3)
    assert hvf_core.maze_locate(np.zeros((0, 64, 64, 3), np.uint8)).shape == (0, 4)
    assert hvf_core.maze_episodes(0, 0, 0, "easy")[1].shape == (0, 2)
    assert hvf_core.maze_subgoals(nothing, np.zeros((0, 2)), 2).shape == (0, 2, 4)
    assert hvf_core.maze_collect(0, 0, 0, 3)[0].shape == (0, 4, 64, 64, 3)


def test_views_that_are_not_contiguous_are_taken() -> None:
    states, _ = hvf_core.maze_episodes(0, 0, 4, "hard")
    frames = hvf_core.maze_render(states)
    strided = np.repeat(frames, 2, axis=0)[::2]
    np.testing.assert_array_equal(hvf_core.maze_locate(strided), hvf_core.maze_locate(frames))
    fortran = np.asfortranarray(states)
    np.testing.assert_array_equal(hvf_core.maze_render(fortran), frames)


ONE = np.zeros((1, 4))


@pytest.mark.parametrize(
    ("call", "error", "argument"),
    [
        (lambda: hvf_core.maze_step(ONE, np.zeros((2, 2))), ValueError, "actions"),
        (lambda: hvf_core.maze_step(ONE, np.zeros((1, 3))), ValueError, "actions"),
        (lambda: hvf_core.maze_step(ONE, np.array([[np.nan, 0]])), ValueError, "actions"),
        (lambda: hvf_core.maze_step(ONE, np.array([[np.inf, 0]])), ValueError, "actions"),
        (lambda: hvf_core.maze_step(ONE, [["a", "b"]]), TypeError, "actions"),
        (lambda: hvf_core.maze_step(np.zeros(4), np.zeros((1, 2))), ValueError, "states"),
        (lambda: hvf_core.maze_step(None, np.zeros((1, 2))), (TypeError, ValueError), "states"),
        (lambda: hvf_core.maze_render(ONE + 1), ValueError, "states"),
        (lambda: hvf_core.maze_render(ONE * np.nan), ValueError, "states"),
        (lambda: hvf_core.maze_render(ONE, 7), ValueError, "size"),
        (lambda: hvf_core.maze_render(ONE, -1), ValueError, "size"),
        (lambda: hvf_core.maze_render(ONE, 10**6), ValueError, "size"),
        (lambda: hvf_core.maze_render(ONE, 64.0), TypeError, "size"),
        (lambda: hvf_core.maze_locate(np.zeros((1, 64, 64, 3))), TypeError, "images"),
        (lambda: hvf_core.maze_locate(np.zeros((64, 64, 3), np.uint8)), ValueError, "images"),
        (lambda: hvf_core.maze_locate(np.zeros((1, 64, 32, 3), np.uint8)), ValueError, "images"),
        (lambda: hvf_core.maze_locate(np.zeros((1, 4, 4, 3), np.uint8)), ValueError, "images"),
        (lambda: hvf_core.maze_episodes(-1, 0, 1, "easy"), ValueError, "seed"),
        (lambda: hvf_core.maze_episodes(0, -1, 1, "easy"), ValueError, "first"),
        (lambda: hvf_core.maze_episodes(0, 0, -1, "easy"), ValueError, "count"),
        (lambda: hvf_core.maze_episodes(0, 0, 1, "brutal"), ValueError, "difficulty"),
        (lambda: hvf_core.maze_subgoals(ONE, np.zeros((2, 2)), 1), ValueError, "targets"),
        (lambda: hvf_core.maze_subgoals(ONE, np.full((1, 2), np.nan), 1), ValueError, "targets"),
        (lambda: hvf_core.maze_subgoals(ONE, np.zeros((1, 2)), -1), ValueError, "subgoals"),
        (lambda: hvf_core.maze_collect(0, 0, 1, 0), ValueError, "steps"),
        (lambda: hvf_core.maze_collect(0, 0, 10**8, 10**6), (MemoryError, ValueError), ""),
        (lambda: hvf_core.maze_success(ONE, np.zeros((1, 4))), ValueError, "targets"),
    ],
)
def test_bad_input_gets_one_error_that_names_the_argument(call, error, argument) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(error) as caught:
        call()
    assert str(caught.value).startswith(argument)


any_floats = st.floats(allow_nan=True, allow_infinity=True, width=32)
any_array = hnp.arrays(
    st.sampled_from([np.float32, np.float64, np.int64, np.uint8, np.bool_]),
    hnp.array_shapes(min_dims=0, max_dims=5, min_side=0, max_side=4),
)


@given(any_array, any_array)
def test_any_arrays_are_computed_or_refused(first: np.ndarray, second: np.ndarray) -> None:
    for call in (
        lambda: hvf_core.maze_step(first, second),
        lambda: hvf_core.maze_render(first, 8),
        lambda: hvf_core.maze_locate(first),
        lambda: hvf_core.maze_subgoals(first, second, 2),
        lambda: hvf_core.maze_success(first, second),
    ):
        complaint = None
        try:
            result = call()
        except (ValueError, TypeError) as error:
            complaint = str(error)
        if complaint is None:
            assert len(result) == len(first)
        else:
            assert complaint.startswith(("states", "actions", "images", "starts", "targets"))


@given(
    hnp.arrays(np.float64, (3, 4), elements=any_floats),
    hnp.arrays(np.float32, (3, 2), elements=any_floats),
)
def test_any_numbers_step_to_legal_states_or_are_refused(
    states: np.ndarray, actions: np.ndarray
) -> None:
    legal = (
        np.isfinite(states).all()
        and np.isfinite(actions).all()
        and abs(states[:, :2]).max() <= hvf_core.MAZE_ARENA
        and abs(states[:, 2:]).max() <= hvf_core.MAZE_GAP_LIMIT
    )
    if legal:
        assert penetration(hvf_core.maze_step(states, actions)).max() <= 1e-12
    else:
        with pytest.raises(ValueError):
            hvf_core.maze_step(states, actions)


@given(
    hnp.arrays(np.float64, (20, 2), elements=st.floats(-0.3, 0.3)),
    hnp.arrays(np.float64, (20, 2), elements=st.floats(-0.25, 0.25)),
    hnp.arrays(np.float32, (20, 2), elements=st.floats(-3, 3, width=32)),
)
def test_legal_numbers_step_to_legal_states(
    positions: np.ndarray, gaps: np.ndarray, actions: np.ndarray
) -> None:
    after = hvf_core.maze_step(np.hstack([positions, gaps]), actions)
    assert penetration(after).max() <= 1e-12
    np.testing.assert_array_equal(after[:, 2:], gaps)
