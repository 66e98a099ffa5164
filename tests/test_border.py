"""The border between Python and Rust: whatever comes in, one clear error or the right answer.

``fuzz_border.py`` makes the calls of the first test for as long as you like.
"""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import border_calls
import hvf_core
import nonsense
import processes
from border_worlds import (
    A3,
    KEYPOINT,
    KEYPOINT_FRAMES,
    KEYPOINT_PARTS,
    KEYPOINT_WORLD,
    LATENT,
    LATENT_PARTS,
    LAYER_FRAMES,
    LAYER_PARTS,
    LAYER_WORLD,
    LAYERS,
    MAZE_FRAMES,
    MAZE_WORLD,
    STATES,
    WORLDS,
)
from hvf_core import HVF, VisualMPC
from nonsense import Entries, Index, Length, misaligned, packed

MPC = VisualMPC(horizon=2, samples=6, elites=2, iterations=2)
NAMES = [type(world).__name__ for world, _, _ in WORLDS]
named = pytest.mark.parametrize("frames", [frames for _, frames, _ in WORLDS], ids=NAMES)
worlds = pytest.mark.parametrize(
    ("world", "frames", "dim"), [(w, f, a.shape[-1]) for w, f, a in WORLDS], ids=NAMES
)


class Point:
    """A point mass whose frames are anything with a length."""

    action_low = np.array([-1, -1], np.float32)
    action_high = np.array([1, 1], np.float32)

    def rollout_costs(self, starts: Any, goals: Any, actions: Any) -> Any:
        return actions.sum(axis=(2, 3)) ** 2


@settings(max_examples=250, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_nonsense_is_computed_or_refused(data: st.DataObject) -> None:
    border_calls.make(border_calls.any_call(lambda n: data.draw(st.integers(0, n - 1))))


def test_nothing_public_is_left_out() -> None:
    assert set(border_calls.CATALOGUE) == set(border_calls.public())


@pytest.mark.parametrize("name", sorted(border_calls.CATALOGUE))
def test_calls_with_what_makes_sense_return(name: str) -> None:
    for maker in border_calls.CATALOGUE[name]:
        call = maker(lambda n: 0)
        assert call.name == name
        if name in MADE_ELSEWHERE:
            with pytest.raises(TypeError, match=f"cannot create 'hvf_core.{name}' instances"):
                call()
        else:
            found = call()
            assert type(found).__name__ == name or not name[0].isupper() or "." in name


MADE_ELSEWHERE = {"Plan", "Plans", "SearchResult", "KeypointFrames", "LayerFrames"}
"""What only planners and worlds make."""


# --- numbers and names ------------------------------------------------------------------------

WHOLE: dict[str, Callable[[Any], Any]] = {
    "horizon": lambda x: VisualMPC(horizon=x),
    "samples": lambda x: VisualMPC(samples=x),
    "keep_elites": lambda x: HVF(keep_elites=x),
    "subgoals": lambda x: HVF(subgoals=x),
    "image_size": lambda x: hvf_core.MazeWorld(image_size=x),
    "latent_dim": lambda x: hvf_core.MazeSubgoals(x),
    "size": lambda x: hvf_core.maze_render(STATES, x),
    "count": lambda x: hvf_core.maze_episodes(0, 0, x, "hard"),
    "spacing": lambda x: hvf_core.KeypointWorld(**{**KEYPOINT, "spacing": x}),
    "substeps": lambda x: hvf_core.KeypointWorld(**{**KEYPOINT, "substeps": x}),
    "arm_places": lambda x: hvf_core.LayerWorld(**{**LAYERS, "arm_places": (x, 2, 2)}),
    "hold": lambda x: hvf_core.LatentWorld(**{**LATENT, "hold": x}),
    "seed": lambda x: MPC.plan(Point(), np.zeros((1, 2)), np.zeros((1, 2)), seed=x),
    "seeds": lambda x: MPC.plan_batch(Point(), np.zeros((1, 2)), np.zeros((1, 2)), seeds=[x]),
}


@pytest.mark.parametrize("name", WHOLE)
def test_integers_of_any_size_and_sign_are_refused_by_name(name: str) -> None:
    for value in (-1, -(2**70), 2**70, 2**500, np.int64(-1), Index(-1)):
        with pytest.raises(ValueError, match=f"^{name}: "):
            WHOLE[name](value)
    for wrong in ("3", 1.5, None if name != "size" else 1j, np.zeros(2), Index("3")):
        with pytest.raises(TypeError, match=f"^{name}: "):
            WHOLE[name](wrong)


@pytest.mark.parametrize("name", WHOLE)
def test_what_an_index_raises_comes_back_as_it_is(name: str) -> None:
    for raised in (KeyboardInterrupt, nonsense.OwnError):
        with pytest.raises(raised):
            WHOLE[name](Index(raised))


@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("min_variance", lambda x: VisualMPC(min_variance=x)),
        ("initial_std", lambda x: VisualMPC(initial="normal", initial_std=x)),
        ("warm_start_std", lambda x: VisualMPC(warm_start_std=x)),
        ("blur", lambda x: hvf_core.MazeWorld(blur=x)),
        ("blur", lambda x: hvf_core.image_cost(MAZE_FRAMES.images, MAZE_FRAMES.images, blur=x)),
        ("action_scale", lambda x: hvf_core.KeypointWorld(**{**KEYPOINT, "action_scale": x})),
        ("reach", lambda x: hvf_core.LayerWorld(**{**LAYERS, "reach": x})),
    ],
)
def test_numbers_are_refused_by_name(name: str, call: Callable[[Any], Any]) -> None:
    for value in (float("nan"), float("inf"), 10**400, -1.0):
        with pytest.raises(ValueError, match=f"^{name}: "):
            call(value)
    for wrong in ("1", None, 1j, np.complex64(1), np.ones(1), [1.0]):
        with pytest.raises(TypeError, match=f"^{name}: "):
            call(wrong)
    with pytest.raises(KeyboardInterrupt):
        call(Index(KeyboardInterrupt))


@pytest.mark.parametrize("std", [1e-60, 1e300, 3e38])
def test_deviations_count_in_the_precision_they_are_used_in(std: float) -> None:
    with pytest.raises(ValueError, match=r"^initial_std: must be finite and positive"):
        VisualMPC(initial="normal", initial_std=std)


def test_a_box_too_wide_to_draw_from_is_refused() -> None:
    world = Point()
    world.action_low, world.action_high = np.full(2, -3e38, "f4"), np.full(2, 3e38, "f4")
    with pytest.raises(ValueError, match=r"^model\.action_low: "):
        MPC.plan(world, np.zeros((1, 2)), np.zeros((1, 2)))


# --- lengths ----------------------------------------------------------------------------------


@pytest.mark.parametrize("length", [2**20 + 1, 2**40, 2**62, 2**70])
def test_more_problems_than_could_be_meant_are_refused(length: int) -> None:
    frames = range(length)
    for call in (
        lambda: MPC.plan_batch(Point(), frames, [0]),
        lambda: MPC.plan_batch(Point(), [0], frames),
        lambda: HVF(subgoals=0).search_batch(Point(), None, frames, frames),
    ):
        with pytest.raises(ValueError, match=r"^(starts|goals): "):
            call()


def test_what_a_length_raises_comes_back_as_it_is() -> None:
    for raised in (KeyboardInterrupt, nonsense.OwnError):
        with pytest.raises(raised):
            MPC.plan_batch(Point(), Length(raised), [0])
    with pytest.raises(TypeError, match=r"^starts: expected frames"):
        MPC.plan_batch(Point(), Length(TypeError), [0])
    with pytest.raises(ValueError, match=r"should return >= 0"):
        MPC.plan_batch(Point(), Length(-1), [0])
    world = Point()
    world.uses_seeds = Length(2**70)  # type: ignore[attr-defined]
    with pytest.raises(TypeError, match=r"^model\.uses_seeds: expected True or False"):
        MPC.plan_batch(world, [0], [0])
    for raised in (KeyboardInterrupt, nonsense.OwnError):
        with pytest.raises(raised):
            MAZE_FRAMES[Length(raised)]


def test_a_sequence_of_seeds_is_not_asked_for_its_length() -> None:
    """Asking would print what that raises, and go on."""
    with pytest.raises(ValueError, match=r"^seeds: must be as many as goals \(1\)"):
        MPC.plan_batch(Point(), [0], [0], seeds=Length(KeyboardInterrupt))


@pytest.mark.parametrize("endless", [Length(3), [Length(2), 1.0], range(2**62), Length(2**60)])
def test_endless_sequences_are_no_numbers(endless: Any) -> None:
    with pytest.raises((ValueError, TypeError), match=r"^initial_low: "):
        VisualMPC(initial_low=endless)
    with pytest.raises((ValueError, TypeError), match=r"^states: "):
        hvf_core.maze_step(endless, np.zeros((1, 2)))
    with pytest.raises((ValueError, TypeError), match=r"^seeds: "):
        MPC.plan_batch(Point(), np.zeros((1, 2)), np.zeros((1, 2)), seeds=endless)

    class Endless(Point):
        def rollout_costs(self, starts: Any, goals: Any, actions: Any) -> Any:
            return endless

    with pytest.raises(ValueError, match=r"^model Endless: rollout_costs must return "):
        MPC.plan(Endless(), np.zeros((1, 2)), np.zeros((1, 2)))


def test_a_call_of_a_model_has_bounded_memory() -> None:
    sizes: list[int] = []

    class Sized(Point):
        def rollout_costs(self, starts: Any, goals: Any, actions: Any) -> Any:
            sizes.append(actions.size)
            return np.zeros(actions.shape[:2], np.float32)

    long = VisualMPC(horizon=4096, samples=64, elites=1, iterations=1)
    long.plan_batch(Sized(), np.zeros((1, 2)), np.zeros((140, 2)))
    assert sum(sizes) == 140 * 64 * 4096 * 2
    assert max(sizes) == 2**26


# --- arrays -----------------------------------------------------------------------------------

STRICT: dict[str, tuple[Callable[..., Any], tuple[Any, ...], int]] = {
    "a": (hvf_core.image_cost, (MAZE_FRAMES.images.astype(np.float32) / 255,) * 2, 0),
    "images": (KEYPOINT_WORLD.frames, KEYPOINT_PARTS, 0),
    "keypoints": (KEYPOINT_WORLD.frames, KEYPOINT_PARTS, 1),
    "maps": (KEYPOINT_WORLD.frames, KEYPOINT_PARTS, 2),
    "clean": (LAYER_WORLD.frames, LAYER_PARTS, 1),
    "regions": (LAYER_WORLD.frames, LAYER_PARTS, 2),
    "states": (LAYER_WORLD.frames, LAYER_PARTS, 3),
    "latents": (hvf_core.LatentFrames, LATENT_PARTS, 0),
    "actions": (
        KEYPOINT_WORLD.rollout_costs,
        (KEYPOINT_FRAMES, KEYPOINT_FRAMES, np.zeros((3, 4, 2, 2), np.float32)),
        2,
    ),
}


@pytest.mark.parametrize("name", STRICT)
def test_memory_that_is_no_array_of_the_dtype_is_refused(name: str) -> None:
    call, sensible, place = STRICT[name]

    def given_as(array: Any) -> Any:
        return call(*sensible[:place], array, *sensible[place + 1 :])

    array = sensible[place]
    given_as(array)
    expected = f"^{name}: expected .*, got "
    for wrong in (array.astype(np.complex64), array.astype("O"), array.tolist(), None, array.sum()):
        with pytest.raises(TypeError, match=expected):
            given_as(wrong)
    for wrong in (array[0], array[None], array.reshape((1,) * 30 + array.shape)):
        with pytest.raises(ValueError, match=expected):
            given_as(wrong)
    if array.dtype.itemsize > 1:
        with pytest.raises(TypeError, match=expected):
            given_as(array.astype(array.dtype.newbyteorder(">")))
        for wrong in (misaligned(array), packed(array)):
            with pytest.raises(ValueError, match=f"{expected}.*misaligned or packed"):
                given_as(wrong)
    with pytest.raises(MemoryError, match=f"^{name}: "):
        given_as(np.broadcast_to(array[:1], (2**55 // array[:1].size, *array.shape[1:])))


@pytest.mark.parametrize("way", [misaligned, packed, np.asfortranarray, lambda x: x[::-1][::-1]])
def test_numbers_are_read_from_memory_of_any_order(way: Callable[[Any], Any]) -> None:
    actions = np.random.default_rng(0).normal(size=(3, 2))
    expected = hvf_core.maze_step(STATES, actions)
    np.testing.assert_array_equal(hvf_core.maze_step(way(STATES), way(actions)), expected)
    costs = np.random.default_rng(0).normal(size=(1, 6)).astype(np.float32)

    class Answering(Point):
        def rollout_costs(self, starts: Any, goals: Any, actions: Any) -> Any:
            return way(costs)

    plan = VisualMPC(samples=6, elites=2, iterations=1).plan(Answering(), [0], [0])
    assert plan.cost == costs.min()


@pytest.mark.parametrize(
    "wrong", [STATES.astype(complex), STATES.astype(str), STATES.astype("O"), "abcd", None]
)
def test_what_is_no_number_is_not_made_one(wrong: Any) -> None:
    with pytest.raises(TypeError, match=r"^states: expected a float array \[N, 4\], got "):
        hvf_core.maze_step(wrong, np.zeros((3, 2)))


def test_numbers_beyond_single_precision_warn_of_nothing() -> None:
    costs = MAZE_WORLD.rollout_costs(MAZE_FRAMES, MAZE_FRAMES, np.full((3, 4, 2, 2), 1e300))
    assert np.isnan(costs).all()


def test_booleans_may_be_any_byte() -> None:
    images, clean, regions, states = LAYER_PARTS
    bytes_ = regions.view(np.uint8) * np.uint8(7)
    actions = np.zeros((3, 4, 2, 3), np.float32)
    found = []
    for parts in (regions, bytes_.view(bool)):
        frames = LAYER_WORLD.frames(images, clean, parts, states)
        found.append(LAYER_WORLD.rollout_costs(frames, frames, actions))
    np.testing.assert_array_equal(*found)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("image_size", 2**32),
        ("image_size", 200_000),
        ("substeps", 2**40),
        ("spacing", 2**40),
    ],
)
def test_sizes_that_no_memory_or_patience_has_room_for_are_refused(name: str, value: int) -> None:
    with pytest.raises(ValueError, match=f"^{name}: must be at least . and at most"):
        hvf_core.KeypointWorld(**{**KEYPOINT, name: value})


def test_a_grid_whose_size_wraps_is_refused() -> None:
    wrapped = {**LAYERS, "arm_places": (2**32, 2**32, 2), "arm_index": LAYERS["arm_index"][:0]}
    with pytest.raises(ValueError, match=r"^arm_index: expected shape"):
        hvf_core.LayerWorld(**wrapped)


def latent(entry: str, value: Any, argument: str = "dynamics") -> hvf_core.LatentWorld:
    return hvf_core.LatentWorld(**{**LATENT, argument: {**LATENT[argument], entry: value}})


ENDLESS = {
    "dynamics['input']": lambda x: latent("input", x),
    "readout['output']": lambda x: latent("output", x, "readout"),
    "dynamics['blocks']": lambda x: latent("blocks", x),
    "dynamics['blocks'][0]": lambda x: latent("blocks", [x]),
    "dynamics['blocks'][0][1]": lambda x: latent("blocks", [(LATENT["dynamics"]["input"], x)]),
    "dynamics['scale']": lambda x: latent("scale", x),
    "dynamics['activation']": lambda x: latent("activation", x),
    "dynamics": lambda x: hvf_core.LatentWorld(**{**LATENT, "dynamics": x}),
    "readout": lambda x: hvf_core.LatentWorld(**{**LATENT, "readout": x}),
    "hand": lambda x: hvf_core.LayerWorld(**{**LAYERS, "hand": x}),
    "sliders": lambda x: hvf_core.LayerWorld(**{**LAYERS, "sliders": [x]}),
}


@pytest.mark.parametrize("name", ENDLESS)
def test_weights_without_an_end_are_refused(name: str) -> None:
    for endless in (Length(3), Length(2**62), Entries(itertools.count())):
        with pytest.raises((ValueError, TypeError), match=f"^{re.escape(name)}(:|\\[)"):
            ENDLESS[name](endless)


def test_what_weights_raise_comes_back_as_it_is() -> None:
    for raised in (KeyboardInterrupt, nonsense.OwnError):
        for entries in (Entries(raised), Entries(("input",), raised)):
            for argument in ("dynamics", "readout"):
                with pytest.raises(raised):
                    hvf_core.LatentWorld(**{**LATENT, argument: entries})
        with pytest.raises(raised):
            latent("scale", Index(raised))
        for entry in ("input", "blocks"):
            with pytest.raises(raised):
                latent(entry, Raising(raised))


class Raising:
    """A sequence that raises when it is gone through."""

    def __init__(self, raised: type[BaseException]) -> None:
        self.raised = raised

    def __len__(self) -> int:
        return 2

    def __getitem__(self, index: Any) -> Any:
        raise self.raised


def test_names_that_are_no_text_are_refused() -> None:
    with pytest.raises(ValueError, match=r"^dynamics\['activation'\]: "):
        latent("activation", "\ud800")


def test_calls_of_worlds_are_not_larger_than_memory() -> None:
    """Actions that repeat themselves, and answers that would be larger than they are."""
    expected = r"^actions: must be at most \d+ numbers, and lead to no more, got \["
    for world, frames, actions in WORLDS:
        problems, candidates, _, dim = actions.shape
        long = np.broadcast_to(actions[:, :, :1], (problems, candidates, 2**25, dim))
        with pytest.raises(ValueError, match=expected):
            world.rollout_costs(frames, frames, long)
        if hasattr(world, "shared_rollout_costs"):
            with pytest.raises(ValueError, match=expected):
                world.shared_rollout_costs(
                    frames[0], frames, np.broadcast_to(long[0, :1], (9, *long.shape[2:]))
                )
    wide = np.broadcast_to(A3[:, :1, :1], (3, 1, 2**23, 3))
    with pytest.raises(ValueError, match=expected):
        LAYER_WORLD.rollout(LAYER_FRAMES, wide)
    with pytest.raises(ValueError, match=expected):
        LAYER_WORLD.predict(LAYER_FRAMES, wide[:, 0, : 2**17])


# --- indices ----------------------------------------------------------------------------------


@named
def test_frames_are_indexed_alike(frames: Any) -> None:
    images = frames.images
    for index in (0, -1, np.int8(1), [2, 0, -3], np.array([1, 1]), np.array([2], np.uint8), [], ()):
        expected = images[np.atleast_1d(np.asarray(index, np.int64))]
        np.testing.assert_array_equal(frames[index].images, expected)
    assert len(list(frames)) == 3
    for index in (3, -4, 2**70, [0, 3], np.array([-4]), np.array([2**64 - 1], np.uint64)):
        with pytest.raises(IndexError, match=r"^index: .* is beyond 3 frames"):
            frames[index]
    for wrong in (
        1.0,
        "0",
        None,
        np.zeros(2),
        np.array([True, False, True]),
        np.zeros((1, 1), int),
    ):
        with pytest.raises(TypeError, match=r"^index: expected"):
            frames[wrong]
    with pytest.raises(KeyboardInterrupt):
        frames[Index(KeyboardInterrupt)]


def test_plans_are_indexed_as_lists_are() -> None:
    plans = MPC.plan_batch(MAZE_WORLD, MAZE_FRAMES, MAZE_FRAMES)
    assert [plan.cost for plan in plans] == [plans[i].cost for i in (0, -2, np.int64(2))]
    for index in (3, -4, 2**70):
        with pytest.raises(IndexError):
            plans[index]


# --- NaN --------------------------------------------------------------------------------------


@worlds
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("over_horizon", ["last", "sum", "min"])
def test_a_candidate_that_is_no_number_costs_none(
    world: Any, frames: Any, dim: int, bad: float, over_horizon: Any
) -> None:
    if world is MAZE_WORLD:
        world = hvf_core.MazeWorld(image_size=8, over_horizon=over_horizon)
    elif world is KEYPOINT_WORLD:
        world = hvf_core.KeypointWorld(**{**KEYPOINT, "over_horizon": over_horizon})
        frames = world.frames(*KEYPOINT_PARTS)
    elif world is LAYER_WORLD:
        world = hvf_core.LayerWorld(**{**LAYERS, "over_horizon": over_horizon})
        frames = world.frames(*LAYER_PARTS)
    else:
        world = hvf_core.LatentWorld(**{**LATENT, "over_horizon": over_horizon})
    actions = np.random.default_rng(0).uniform(-1, 1, (3, 5, 4, dim)).astype(np.float32)
    expected = world.rollout_costs(frames, frames, actions)
    assert np.isfinite(expected).all()
    actions[1, 2, 1, 0] = bad
    expected[1, 2] = np.nan
    np.testing.assert_array_equal(world.rollout_costs(frames, frames, actions), expected)
    if hasattr(world, "shared_rollout_costs"):
        shared = world.shared_rollout_costs(frames[1], frames, actions[1])
        assert np.isnan(shared[:, 2]).all()
        np.testing.assert_array_equal(shared[1], expected[1])


# --- worlds around native ones ----------------------------------------------------------------


class Speaking:
    """Says in its body which native world its own costs are those of."""

    @property
    def native(self) -> hvf_core.MazeWorld:
        return MAZE_WORLD

    def rollout_costs(self, starts: Any, goals: Any, actions: Any) -> Any:
        return self.native.rollout_costs(starts, goals, actions)


class Silent:
    def __init__(self) -> None:
        self.native = MAZE_WORLD


class Overriding(Speaking):
    def rollout_costs(self, starts: Any, goals: Any, actions: Any) -> Any:
        return np.zeros(actions.shape[:2], np.float32)


class AtOnce(Silent):
    def prepare(self, starts: Any, goals: Any) -> Any:
        return starts, goals


class OnItsOwn(Overriding):
    native = None  # type: ignore[assignment]
    action_low = MAZE_WORLD.action_low
    action_high = MAZE_WORLD.action_high


class Further(Speaking):
    def images(self, frames: Any) -> Any:
        return frames.images


def test_costs_that_native_would_hide_are_refused() -> None:
    expected = MPC.plan(MAZE_WORLD, MAZE_FRAMES[0], MAZE_FRAMES[1])
    for model in (Speaking(), Silent(), Further()):
        plan = MPC.plan(model, MAZE_FRAMES[0], MAZE_FRAMES[1])
        np.testing.assert_array_equal(plan.actions, expected.actions)
    patched = Speaking()
    patched.rollout_costs = lambda *_: None  # type: ignore[method-assign]
    for model, method in ((Overriding(), "rollout_costs"), (AtOnce(), "prepare")):
        for call in (
            lambda model=model: MPC.plan(model, MAZE_FRAMES[0], MAZE_FRAMES[1]),
            lambda model=model: HVF(subgoals=0).search(model, None, MAZE_FRAMES[0], MAZE_FRAMES[1]),
        ):
            with pytest.raises(TypeError, match=f"^model: {method} of .* would not be called"):
                call()
    with pytest.raises(TypeError, match=r"^model: rollout_costs of Speaking"):
        MPC.plan(patched, MAZE_FRAMES[0], MAZE_FRAMES[1])
    assert MPC.plan(OnItsOwn(), MAZE_FRAMES[0], MAZE_FRAMES[1]).cost == 0.0


@worlds
def test_plans_do_not_depend_on_how_native_calls_are_cut(world: Any, frames: Any, dim: int) -> None:
    """Native worlds are asked in pieces, others in whole calls."""

    class Whole:
        action_low, action_high = world.action_low, world.action_high
        max_candidates = 2**20

        def rollout_costs(self, starts: Any, goals: Any, actions: Any) -> Any:
            return world.rollout_costs(starts, goals, actions)

    for samples in (1500, 4200):
        mpc = VisualMPC(horizon=4, samples=samples, elites=20, iterations=2)
        cut = mpc.plan_batch(world, frames, frames[[1, 2, 0]], seeds=[1, 2, 2])
        whole = mpc.plan_batch(Whole(), frames, frames[[1, 2, 0]], seeds=[1, 2, 2])
        np.testing.assert_array_equal(cut.actions, whole.actions)
        np.testing.assert_array_equal(cut.costs, whole.costs)
        shared = mpc.plan_batch(world, frames[1], frames, seeds=3)
        whole = mpc.plan_batch(Whole(), frames[1], frames, seeds=3)
        np.testing.assert_array_equal(shared.actions, whole.actions)


IN_A_CALL = """
import signal
import hvf_core
starts, _ = hvf_core.maze_episodes(0, 0, 1, "hard")
frames = hvf_core.MazeFrames(starts)
world = hvf_core.MazeWorld(blur=3.0, over_horizon="min")
looks = 0
def look(*_):
    global looks
    looks += 1
    if looks == 6:
        print("looked", flush=True)
        raise KeyboardInterrupt
signal.signal(signal.SIGALRM, look)
signal.setitimer(signal.ITIMER_REAL, 0.01, 0.01)
try:
    # One call of the world.
    hvf_core.VisualMPC(horizon=500, samples=100_000, iterations=1).plan(world, frames, frames)
except KeyboardInterrupt:
    signal.setitimer(signal.ITIMER_REAL, 0)
    print("interrupted", flush=True)
"""


def test_signals_are_looked_for_within_a_call_of_a_native_world() -> None:
    """Python's handlers run only where somebody looks."""
    done = processes.run(processes.python(IN_A_CALL), check=True)
    assert done.stdout == "looked\ninterrupted\n"


# --- forks ------------------------------------------------------------------------------------

FORKED = """
import os, signal, sys, warnings
warnings.simplefilter("ignore")
import hvf_core
def work():
    frames = hvf_core.MazeFrames([[0.0, 0.0, 0.1, 0.1]])
    return hvf_core.VisualMPC(samples=500).plan(hvf_core.MazeWorld(), frames, frames).cost
if sys.argv[1] == "after":
    work()
child = os.fork()
if child == 0:
    signal.alarm(60)
    try:
        work()
        print("worked", flush=True)
    except RuntimeError as error:
        print(error, flush=True)
    assert len(hvf_core.maze_episodes(0, 0, 3, "easy")[0]) == 3
    os._exit(0)
_, status = os.waitpid(child, 0)
work()
sys.exit(status != 0)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.parametrize("when", ["before", "after"])
def test_a_forked_child_works_or_says_why_not(when: str) -> None:
    done = processes.run([*processes.python(FORKED), when], check=True)
    if when == "before":
        assert done.stdout == "worked\n"
    else:
        assert "before this process was forked" in done.stdout
        assert "spawn" in done.stdout
