"""What a world written in Python may have beyond costs, and what its costs may be made of."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import hvf_core
from hvf import protocols
from hvf_core import HVF, VisualMPC
from test_planner import GOAL, SMALL, SMALL_SEARCH, START, Floats, PointMass, Positions, same

Seeds = NDArray[np.int64]
GOALS = np.random.default_rng(1).normal(size=(9, 2)).astype(np.float32)


def distances(starts: Floats, goals: Floats, actions: Floats) -> Floats:
    """Costs [B, D] of a point mass, by broadcasting: actions [B or 1, D, H, A]."""
    ends = starts[:, None] + actions.sum(axis=2)
    costs: Floats = ((ends - goals[:, None]) ** 2).sum(axis=-1).astype(np.float32)
    return costs


# --- prepare ------------------------------------------------------------------------------


class Encoding:
    """Frames of another class than those they are made of: numbers of pairs, and the pairs."""

    def __init__(self, points: Floats, pairs: Floats | None = None) -> None:
        self.points, self.pairs = points, pairs

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, index: NDArray[np.int64]) -> Encoding:
        return Encoding(self.points[index], None if self.pairs is None else self.pairs[index])


class Preparing(PointMass):
    """Plans with encodings only; goal b also holds the start that it belongs to."""

    def __init__(self) -> None:
        super().__init__()
        self.prepared: list[tuple[int, int]] = []

    def prepare(self, starts: Floats, goals: Floats) -> tuple[Encoding, Encoding]:
        assert not self.calls or self.prepared
        self.prepared.append((len(starts), len(goals)))
        pairs = np.broadcast_to(starts, goals.shape)
        return Encoding(starts), Encoding(goals, pairs)

    def rollout_costs(self, starts: Any, goals: Any, actions: Floats) -> Any:
        np.testing.assert_array_equal(starts.points, goals.pairs)
        return super().rollout_costs(starts.points, goals.points, actions)


class SharingPreparing(Preparing):
    def shared_rollout_costs(self, start: Any, goals: Any, actions: Floats) -> Any:
        assert len(start) == 1
        np.testing.assert_array_equal(goals.pairs, np.repeat(start.points, len(goals), axis=0))
        return distances(start.points, goals.points, actions[None])


@settings(max_examples=20, deadline=None)
@given(
    shares=st.booleans(),
    one_start=st.booleans(),
    most=st.integers(1, 400),
    variance=st.sampled_from([0.0, 0.05, 0.2]),
)
def test_prepare_is_called_once_per_plan(
    shares: bool, one_start: bool, most: int, variance: float
) -> None:
    mpc = VisualMPC(horizon=2, samples=40, elites=5, iterations=8, min_variance=variance)
    world = (SharingPreparing if shares else Preparing)()
    world.max_candidates = most  # type: ignore[attr-defined]
    starts = START if one_start else GOALS[::-1].copy()
    plans = mpc.plan_batch(world, starts, GOALS, seeds=3)
    assert world.prepared == [(len(starts), 9)]
    expected = mpc.plan_batch(PointMass(), starts, GOALS, seeds=3)
    np.testing.assert_array_equal(plans.actions, expected.actions)
    if variance == 0.2:
        assert plans.iterations.min() < 8


def test_prepare_is_called_once_per_batch_of_segments() -> None:
    world = SharingPreparing()
    assert isinstance(world, protocols.Preparer)
    assert isinstance(world, protocols.RolloutSharer)
    assert not isinstance(PointMass(), protocols.Preparer)
    expected = SMALL_SEARCH.search(PointMass(), Positions(), START, GOAL, seed=5)
    same(SMALL_SEARCH.search(world, Positions(), START, GOAL, seed=5), expected)
    # The first segments, which have one start; the others, whatever will be planned of them.
    assert world.prepared == [(1, 24), (48, 48)] * 3
    for share, prepared in ((True, [(1, 24), (24, 24)]), (False, [(48, 48)])):
        world = SharingPreparing()
        HVF(
            mpc=SMALL,
            subgoals=1,
            samples=24,
            elites=5,
            iterations=2,
            prune=False,
            share_rollouts=share,
        ).search(world, Positions(), START, GOAL)
        assert world.prepared == prepared * 2
    world = SharingPreparing()
    HVF(mpc=SMALL, subgoals=0).search(world, None, START, GOAL)
    assert world.prepared == [(1, 1)]


@pytest.mark.parametrize("share", [True, False])
def test_a_model_that_pads_is_called_in_few_sizes(share: bool) -> None:
    class Padding(PointMass):
        pads = True

    options: dict[str, Any] = {
        "mpc": VisualMPC(horizon=3, samples=32, elites=6, iterations=8, min_variance=0.05),
        "samples": 24, "elites": 5, "iterations": 2, "share_rollouts": share,
    }  # fmt: skip
    ordinary, padding = PointMass(), Padding()
    expected = HVF(**options).search(ordinary, Positions(), START, GOAL, seed=5)
    same(HVF(**options).search(padding, Positions(), START, GOAL, seed=5), expected)
    sizes = [{len(actions) for _, _, actions, _ in world.calls} for world in (ordinary, padding)]
    assert len(sizes[1]) < len(sizes[0])
    assert all(size & (size - 1) == 0 for size in sizes[1])


def test_whether_a_model_pads_is_yes_or_no() -> None:
    class Huge:
        def __len__(self) -> int:
            return 1 << 70

    class Undecided(PointMass):
        pads = Huge()

    with pytest.raises(TypeError, match=r"^model.pads: expected True or False"):
        SMALL.plan(Undecided(), START, GOAL)


@pytest.mark.parametrize(
    ("prepared", "said"),
    [
        (lambda starts, goals: goals, "prepare must return a tuple .*got a float32 array"),
        (lambda starts, goals: [starts, goals], "prepare must return a tuple .*got list"),
        (lambda starts, goals: None, "prepare must return a tuple .*got NoneType"),
        (lambda starts, goals: (starts,), "prepare must return a tuple .*got a tuple of 1"),
        (lambda starts, goals: (starts, goals, 1), "prepare must return a tuple .*tuple of 3"),
        (lambda starts, goals: (starts, goals[:-1]), "2 starts and 2 goals, got 2 and 1"),
        (lambda starts, goals: (starts[:1], goals), "2 starts and 2 goals, got 1 and 2"),
    ],
)
def test_what_prepare_must_return_is_said(prepared: Any, said: str) -> None:
    class Wrong(PointMass):
        def prepare(self, starts: Floats, goals: Floats) -> Any:
            return prepared(starts, goals)

    with pytest.raises(ValueError, match=f"model Wrong: .*{said}"):
        SMALL.plan_batch(Wrong(), GOALS[:2], GOALS[2:4])


def test_prepared_frames_without_a_length_and_exceptions_are_named() -> None:
    class Countless(PointMass):
        def prepare(self, starts: Floats, goals: Floats) -> Any:
            return starts, 5

    with pytest.raises(TypeError, match="prepare: goals: expected frames"):
        SMALL.plan(Countless(), START, GOAL)
    raised = KeyError("no encoder")

    class Failing(PointMass):
        def prepare(self, starts: Floats, goals: Floats) -> Any:
            raise raised

    with pytest.raises(KeyError) as caught:
        SMALL.plan(Failing(), START, GOAL)
    assert caught.value is raised
    without = PointMass()
    without.prepare = None  # type: ignore[attr-defined]
    SMALL.plan(without, START, GOAL)


# --- seeds --------------------------------------------------------------------------------


def philox(counter: list[int], key: list[int]) -> list[int]:
    """Philox4x32-10 (Salmon et al., 2011) in plain integers."""
    mask = 2**32 - 1
    for _ in range(10):
        a, b = 0xD2511F53 * counter[0], 0xCD9E8D57 * counter[2]
        high_b, low_b, high_a, low_a = b >> 32, b & mask, a >> 32, a & mask
        counter = [high_b ^ counter[1] ^ key[0], low_b, high_a ^ counter[3] ^ key[1], low_a]
        key = [(key[0] + 0x9E3779B9) & mask, (key[1] + 0xBB67AE85) & mask]
    return counter


def expected_seed(seed: int, iteration: int, sample: int) -> int:
    """The seed of one candidate of `VisualMPC`: of a counter that no candidate is drawn from."""
    words = philox([sample | 1 << 31, iteration << 16, 0, 0], [seed & (2**32 - 1), seed >> 32])
    return (words[1] << 32 | words[0]) >> 1


def noise(seeds: Seeds) -> Floats:
    """One number for every seed, of its own generator."""
    drawn = [np.random.default_rng(int(seed)).normal() for seed in seeds.ravel()]
    return np.reshape(drawn, seeds.shape).astype(np.float32)


class Noisy(PointMass):
    """Adds noise to every cost."""

    uses_seeds: Any = True

    def __init__(self) -> None:
        super().__init__()
        self.seeds: list[Seeds] = []

    def rollout_costs(  # type: ignore[override]
        self, starts: Floats, goals: Floats, actions: Floats, *, seeds: Seeds
    ) -> Any:
        assert seeds.shape == actions.shape[:2]
        assert seeds.dtype == np.int64
        assert seeds.flags.c_contiguous
        assert seeds.flags.writeable
        self.seeds.append(seeds.copy())
        costs = super().rollout_costs(starts, goals, actions) + noise(seeds)
        seeds[:] = -1  # the model's own
        return costs


class SharingNoisy(Noisy):
    def shared_rollout_costs(
        self, start: Floats, goals: Floats, actions: Floats, *, seeds: Seeds
    ) -> Any:
        assert seeds.shape == (len(actions),)
        self.seeds.append(seeds.copy())
        return distances(start, goals, actions[None]) + noise(seeds)


def test_seeds_are_those_of_the_counter_based_generator() -> None:
    mpc = VisualMPC(horizon=3, samples=20, elites=4, iterations=3, min_variance=0.0)
    seed = 2**63 + 12345
    world = Noisy()
    plan = mpc.plan(world, START, GOAL, seed=seed)
    best = (np.inf, np.empty(0))
    for iteration, (_, _, actions, costs) in enumerate(world.calls):
        seeds = np.array([expected_seed(seed, iteration, sample) for sample in range(20)])
        np.testing.assert_array_equal(world.seeds[iteration], seeds[None])
        noisy = costs[0] + noise(seeds)
        if noisy.min() < best[0]:
            best = (noisy.min(), actions[0, noisy.argmin()])
    assert plan.cost == best[0]
    np.testing.assert_array_equal(plan.actions, best[1])
    assert min(array.min() for array in world.seeds) >= 0


@settings(max_examples=15, deadline=None)
@given(
    seeds=st.lists(st.integers(0, 2**64 - 1), min_size=1, max_size=5),
    one_seed=st.booleans(),
    most=st.integers(1, 300),
    shares=st.booleans(),
)
def test_stochastic_plans_are_the_same_alone_and_in_a_batch(
    seeds: list[int], one_seed: bool, most: int, shares: bool
) -> None:
    mpc = VisualMPC(horizon=2, samples=20, elites=4, iterations=3)
    if one_seed:
        seeds = [seeds[0]] * len(seeds)
    world = (SharingNoisy if shares else Noisy)()
    world.max_candidates = most  # type: ignore[attr-defined]
    plans = mpc.plan_batch(world, START, GOALS[: len(seeds)], seeds)
    for b, plan in enumerate(plans):
        alone = mpc.plan(Noisy(), START, GOALS[b : b + 1], seeds[b])
        np.testing.assert_array_equal(alone.actions, plan.actions)
        assert alone.cost == plan.cost


def test_a_stochastic_search_is_the_same_with_its_savings() -> None:
    options: dict[str, Any] = {"mpc": SMALL, "samples": 16, "elites": 4, "iterations": 2}
    plain = HVF(**options, prune=False, share_rollouts=False)
    world = Noisy()
    expected = plain.search(world, Positions(), START, GOAL, seed=4)
    saving = SharingNoisy()
    same(HVF(**options).search(saving, Positions(), START, GOAL, seed=4), expected)
    # Three iterations a segment: the first is of one set of candidates for all samples, later
    # ones are new for every problem.
    first, *later = world.seeds[:3]
    assert np.all(first == first[0])
    fresh = np.concatenate([seeds.ravel() for seeds in later])
    assert len(np.unique(fresh)) == fresh.size
    shared = next(seeds for seeds in saving.seeds if seeds.shape == (30,))
    np.testing.assert_array_equal(shared, first[0])


@pytest.mark.parametrize("asked", [False, None, 0])
def test_no_seeds_for_those_who_do_not_ask(asked: Any) -> None:
    world = PointMass()
    world.uses_seeds = asked  # type: ignore[attr-defined]
    SMALL.plan(world, START, GOAL)


NOISY = """
import hashlib, sys
sys.path.insert(0, {path!r})
from test_planner_protocol import *
digest = hashlib.sha256()
plans = SMALL.plan_batch(SharingNoisy(), START, np.repeat(GOALS, 4, axis=0), 5)
found = SMALL_SEARCH.search(SharingNoisy(), Positions(), START, GOAL)
digest.update(plans.actions.tobytes() + found.latents.tobytes() + found.plans.actions.tobytes())
print(digest.hexdigest())
"""


def test_stochastic_plans_are_the_same_on_any_thread_count(
    outputs_by_threads: Callable[[str], set[str]],
) -> None:
    assert len(outputs_by_threads(NOISY.format(path=os.path.dirname(__file__)))) == 1


# --- costs --------------------------------------------------------------------------------


def answering(convert: Callable[[Floats], Any]) -> PointMass:
    class Answering(PointMass):
        def rollout_costs(self, starts: Floats, goals: Floats, actions: Floats) -> Any:
            return convert(distances(starts, goals, actions))

    return Answering()


class FakeTensor:
    """On a device, in a graph: NumPy may have it only after both are left."""

    def __init__(self, costs: Floats, steps: tuple[str, ...] = ("detach", "cpu")) -> None:
        self.costs, self.steps = costs, steps

    def detach(self) -> FakeTensor:
        return FakeTensor(self.costs, tuple(step for step in self.steps if step != "detach"))

    def cpu(self) -> FakeTensor:
        assert "detach" not in self.steps
        return FakeTensor(self.costs, ())

    def __array__(self, *_: Any, **__: Any) -> Floats:
        if self.steps:
            raise TypeError("can't convert device tensor to numpy")
        return self.costs


class OnDevice:
    """An array that only the standard moves to the host."""

    def __init__(self, costs: Floats) -> None:
        self.costs = costs

    def __array__(self, *_: Any, **__: Any) -> Floats:
        raise TypeError("implicit conversion is not allowed")

    def __dlpack__(self, *, dl_device: Any = None, copy: Any = None, **options: Any) -> Any:
        assert dl_device == (1, 0)
        return self.costs.__dlpack__(**{k: v for k, v in options.items() if v is not None})

    def __dlpack_device__(self) -> tuple[int, int]:
        return (2, 0)


def in_a_graph(costs: Floats, **options: Any) -> torch.Tensor:
    weight = torch.ones((), requires_grad=True)
    return (torch.from_numpy(costs) * weight).to(**options)


@pytest.mark.parametrize(
    "convert",
    [
        in_a_graph,
        lambda costs: in_a_graph(costs, dtype=torch.float64),
        lambda costs: in_a_graph(costs).T.contiguous().T,
        FakeTensor,
    ],
    ids=["grad", "float64", "strided", "fake"],
)
def test_tensors_are_detached_and_moved_to_the_host(convert: Any) -> None:
    expected = SMALL.plan_batch(answering(lambda costs: costs), START, GOALS)
    plans = SMALL.plan_batch(answering(convert), START, GOALS)
    np.testing.assert_array_equal(plans.actions, expected.actions)
    np.testing.assert_array_equal(plans.costs, expected.costs)


@pytest.mark.skipif(np.lib.NumpyVersion(np.__version__) < "2.1.0", reason="NumPy cannot ask")
def test_arrays_that_only_dlpack_moves_are_moved() -> None:
    expected = SMALL.plan(answering(lambda costs: costs), START, GOAL)
    assert SMALL.plan(answering(OnDevice), START, GOAL).cost == expected.cost


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_short_floats_are_costs(dtype: torch.dtype) -> None:
    rounded = answering(lambda costs: torch.from_numpy(costs).to(dtype).float().numpy())
    plan = SMALL.plan(answering(lambda costs: in_a_graph(costs, dtype=dtype)), START, GOAL)
    np.testing.assert_array_equal(plan.actions, SMALL.plan(rounded, START, GOAL).actions)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_costs_may_stay_on_a_gpu(dtype: torch.dtype) -> None:
    on_host = SMALL.plan(answering(lambda costs: in_a_graph(costs, dtype=dtype)), START, GOAL)
    world = answering(lambda costs: in_a_graph(costs, dtype=dtype, device="cuda"))
    np.testing.assert_array_equal(SMALL.plan(world, START, GOAL).actions, on_host.actions)


@pytest.mark.parametrize(
    ("convert", "said"),
    [
        (lambda costs: torch.from_numpy(costs).to("meta"), "torch.Tensor, which gave"),
        (lambda costs: torch.from_numpy(costs).to(torch.complex64), "complex64 array"),
        (lambda costs: torch.from_numpy(costs).to_sparse(), "torch.Tensor, which gave"),
        (lambda costs: torch.from_numpy(costs)[:, :-1], r"float32 array \[1, 29\]"),
        (lambda costs: torch.from_numpy(costs).bfloat16()[0], r"float32 array \[30\]"),
        (lambda costs: [[1.0], [2.0, 3.0]], "list, which gave ValueError"),
    ],
    ids=["meta", "complex", "sparse", "short", "flat", "ragged"],
)
def test_costs_that_cannot_be_read_name_model_and_method(convert: Any, said: str) -> None:
    expected = r"model Answering: rollout_costs must return float32 costs \[B, D\] = \[1, 30\], got"
    with pytest.raises(ValueError, match=f"{expected}.*{said}") as caught:
        SMALL.plan(answering(convert), START, GOAL)
    assert ("which gave" in said) == (caught.value.__cause__ is not None)


def test_ctrl_c_while_costs_are_read_comes_back_unchanged() -> None:
    class Interrupted:
        def cpu(self) -> Any:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        SMALL.plan(answering(lambda costs: Interrupted()), START, GOAL)


# --- images -------------------------------------------------------------------------------


class Grey(PointMass):
    """Frames are grey images, uint8 [N, H, W]: the first two pixels are the position."""

    def rollout_costs(self, starts: Any, goals: Any, actions: Floats) -> Any:
        assert starts.ndim == goals.ndim == 3
        points = [frames.reshape(len(frames), -1)[:, :2] for frames in (starts, goals)]
        start, goal = (point.astype(np.float32) for point in points)
        return super().rollout_costs(start, goal, actions)


@pytest.mark.parametrize("shape", [(5, 4, 4), (5, 4, 3), (5, 1, 2)])
def test_a_batch_of_grey_images_stays_a_batch(shape: tuple[int, ...]) -> None:
    images = np.random.default_rng(0).integers(0, 3, shape, dtype=np.uint8)
    plans = SMALL.plan_batch(Grey(), images, images[::-1].copy())
    assert len(plans) == 5

    class Drawing(Positions):
        def decode(self, scene: Any, latents: Floats) -> Any:
            assert scene.shape == (1, *shape[1:])
            drawn = np.zeros((latents.shape[0] * latents.shape[1], *shape[1:]), np.uint8)
            drawn[:, 0, :2] = np.clip(2 * latents.reshape(-1, 2), 0, 255)
            return drawn

    results = SMALL_SEARCH.search_batch(Grey(), Drawing(), images, images[::-1].copy())
    assert [result.subgoals.shape for result in results] == [(2, *shape[1:])] * 5
    np.testing.assert_array_equal(
        SMALL_SEARCH.search_batch(Grey(), Drawing(), images[:1], images)[3].latents,
        SMALL_SEARCH.search_batch(Grey(), Drawing(), images[:1], images[3:4])[0].latents,
    )
    if shape[-1] != 3:  # else it is an image, where one is asked for
        plan = SMALL.plan(Grey(), images[:1], images[4:])
        np.testing.assert_array_equal(plan.actions, plans[0].actions)


def test_one_image_is_no_batch_of_a_native_world() -> None:
    image = hvf_core.maze_render(hvf_core.maze_episodes(0, 0, 1, "easy")[0])[0]
    world = hvf_core.MazeWorld()
    with pytest.raises(TypeError, match=r"starts: expected .*images \[N, H, W, 3\]"):
        SMALL.plan_batch(world, image, image[None])
    with pytest.raises(TypeError, match=r"goals: expected .*images \[N, H, W, 3\]"):
        SMALL_SEARCH.search_batch(world, hvf_core.MazeSubgoals(), image[None], image)
    with pytest.raises(TypeError, match="start: expected"):
        SMALL.plan(world, image[..., 0], image)
    one = SMALL.plan(world, image, image)
    np.testing.assert_array_equal(
        one.actions, SMALL.plan_batch(world, image[None], image[None]).actions[0]
    )
