"""Image costs against NumPy and SciPy."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import ndimage

import hvf_core


def frames(count: int, shape: tuple[int, int, int] = (64, 64, 3), seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (count, *shape), dtype=np.uint8)


def slow_cost(a: np.ndarray, b: np.ndarray, blur: float) -> np.ndarray:
    """All pairs, written out in float64."""
    scale = 255.0 if a.dtype == np.uint8 else 1.0
    a, b = a / scale, b / scale
    if blur:
        a, b = (ndimage.gaussian_filter(x, (0, blur, blur, 0)) for x in (a, b))
    return ((a[:, None] - b[None]) ** 2).sum((2, 3, 4)) / (a.shape[1] * a.shape[2])


@pytest.mark.parametrize("shape", [(64, 64, 3), (48, 64, 3), (7, 5, 1), (1, 1, 4)])
@pytest.mark.parametrize("blur", [0.0, 0.5, 3.0, 8.0])
def test_costs_equal_numpy_and_scipy(shape: tuple[int, int, int], blur: float) -> None:
    a, b = frames(6, shape, 1), frames(5, shape, 2)
    for x, y in ((a, b), ((a / 255).astype(np.float32), (b / 255).astype(np.float32))):
        expected = slow_cost(x, y, blur)
        table = hvf_core.image_cost(x, y, "all_pairs", blur=blur)
        np.testing.assert_allclose(table, expected, rtol=1e-5, atol=1e-7)
        pairs = hvf_core.image_cost(x[:5], y, blur=blur)
        np.testing.assert_allclose(pairs, np.diag(expected[:5]), rtol=1e-5, atol=1e-7)
        one = hvf_core.image_cost(x[:1], y, mode="all_pairs", blur=blur)
        np.testing.assert_allclose(one, expected[:1], rtol=1e-5, atol=1e-7)


@given(
    hnp.arrays(np.uint8, st.tuples(*[st.integers(1, 9)] * 4)),
    st.integers(1, 9),
    st.integers(0, 2**32 - 1),
)
@settings(max_examples=60, deadline=None)
def test_costs_of_bytes_are_the_integer_sum_divided_once(
    a: np.ndarray, count: int, seed: int
) -> None:
    b = frames(count, a.shape[1:], seed)
    sums = ((a[:, None].astype(np.int64) - b[None]) ** 2).sum((2, 3, 4))
    expected = sums / float(255**2 * a.shape[1] * a.shape[2])
    np.testing.assert_array_equal(hvf_core.image_cost(a, b, "all_pairs"), expected)


def test_large_tables_are_exact_across_blocks() -> None:
    a, b = frames(130, (20, 30, 3), 3), frames(67, (20, 30, 3), 4)
    flat_a, flat_b = (x.reshape(len(x), -1).astype(np.int64) for x in (a, b))
    sums = (flat_a**2).sum(1)[:, None] + (flat_b**2).sum(1) - 2 * flat_a @ flat_b.T
    expected = sums / float(255**2 * 600)
    np.testing.assert_array_equal(hvf_core.image_cost(a, b, "all_pairs"), expected)


def test_same_result_with_one_thread_and_two(
    outputs_by_threads: Callable[[str], set[str]],
) -> None:
    program = (
        "import numpy as np, hvf_core, hashlib\n"
        "r = np.random.default_rng(0)\n"
        "a = r.random((70, 16, 16, 3), dtype=np.float32)\n"
        "b = r.random((70, 16, 16, 3), dtype=np.float32)\n"
        "out = [hvf_core.image_cost(a, b, m, blur=s)"
        " for m in ('pairs', 'all_pairs') for s in (0.0, 2.0)]\n"
        "print(hashlib.sha256(b''.join(o.tobytes() for o in out)).hexdigest())\n"
    )
    assert len(outputs_by_threads(program)) == 1


GOOD = np.zeros((2, 8, 8, 3), np.float32)


@pytest.mark.parametrize(
    ("a", "b", "options", "error", "message"),
    [
        (GOOD[0], GOOD, {}, ValueError, r"^a: expected uint8 or float32 \[N, H, W, C\]"),
        (GOOD.astype(np.float64), GOOD, {}, TypeError, "^a: expected uint8 or float32"),
        (GOOD, [[1.0]], {}, TypeError, "^b: expected uint8 or float32"),
        (GOOD, GOOD.astype(np.uint8), {}, ValueError, "^b: must have the dtype of a"),
        (GOOD, GOOD[:1], {}, ValueError, "^b: must hold as many frames"),
        (GOOD, GOOD[:, :4].copy(), {}, ValueError, "^b: frames must have the shape"),
        (GOOD[:0], GOOD[:0], {}, ValueError, "^a: must be a non-empty batch"),
        (GOOD[:, :, ::2], GOOD[:, :, ::2], {}, ValueError, "^a: must be C-contiguous"),
        (GOOD, GOOD + 1.5, {}, ValueError, "^b: float32 images must be finite and within"),
        (GOOD - np.float32(0.1), GOOD, {}, ValueError, "^a: float32 images"),
        (GOOD, GOOD * np.nan, {}, ValueError, "^b: float32 images"),
        (GOOD, GOOD * np.nan, {"mode": "all_pairs"}, ValueError, "^b: float32 images"),
        (GOOD, GOOD, {"mode": "some"}, ValueError, "^mode: expected"),
        (GOOD, GOOD, {"blur": -1.0}, ValueError, "^blur: must be"),
        (GOOD, GOOD, {"blur": float("nan")}, ValueError, "^blur: must be"),
        (GOOD, GOOD, {"blur": 1e300}, ValueError, "^blur: must be"),
    ],
)
def test_bad_input_is_one_clear_error(
    a: np.ndarray, b: np.ndarray, options: dict, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        hvf_core.image_cost(a, b, **options)


def test_negative_zero_is_a_colour() -> None:
    assert (hvf_core.image_cost(GOOD, -GOOD) == 0).all()
