"""Nonsense for the border between Python and Rust: objects, and calls that are made with them.

What a call may do with any of it is return, or raise what :func:`problem` does not object to.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from hypothesis import strategies as st

import hvf_core
from hvf_core import HVF, VisualMPC

Draw = Callable[[st.SearchStrategy[Any]], Any]
Call = tuple[str, Callable[[], Any]]


class OwnError(Exception):
    """What objects raise of their own accord: it has to come back as it is."""


def problem(error: BaseException) -> str | None:
    """What is wrong with an exception at the border; None if it is one of those promised.

    MemoryError is promised where an array of a size that was asked for does not fit, IndexError
    between brackets.
    """
    if isinstance(error, (ValueError, TypeError, MemoryError, IndexError, OwnError)):
        return None
    # NumPy's own, of frames that are an array of more axes than it can index.
    if isinstance(error, RuntimeError) and "dimensions but the array has" in str(error):
        return None
    return f"{type(error).__module__}.{type(error).__qualname__}: {error}"


# --- objects --------------------------------------------------------------------------------


class Length:
    """Says that it is as long as it was told to; has items for ever."""

    def __init__(self, length: Any) -> None:
        self.length = length

    def __len__(self) -> Any:
        return raising(self.length)

    def __getitem__(self, index: Any) -> Any:
        return self


class Index:
    """An integer, or so it says."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __index__(self) -> Any:
        return raising(self.value)

    def __float__(self) -> Any:
        return raising(self.value)


class Arraying:
    """An array, or so it says."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __array__(self, dtype: Any = None, copy: Any = None) -> Any:
        return raising(self.value)


def raising(value: Any) -> Any:
    if isinstance(value, type) and issubclass(value, BaseException):
        raise value("raised by an argument")
    return value


def misaligned(array: np.ndarray) -> np.ndarray:
    """The same numbers one byte off."""
    memory = np.zeros(array.nbytes + 1, np.uint8)
    moved = memory[1:].view(array.dtype).reshape(array.shape)
    moved[...] = array
    return moved


def packed(array: np.ndarray) -> np.ndarray:
    """The same numbers as a field of a packed structure."""
    table = np.zeros(array.shape, np.dtype([("a", "u1"), ("b", array.dtype)]))
    table["b"] = array
    return table["b"]


FAR = [
    sign * 2**k + d
    for k in (41, 62, 63, 64, 70, 127, 128, 300)
    for sign in (1, -1)
    for d in (-1, 0, 1)
]
"""Integers that are no size of anything, but would be one if bits were cut off."""
SMALL = st.integers(-3, 9)
INTEGERS = st.one_of(SMALL, st.sampled_from(FAR))
SETTINGS = st.one_of(SMALL, st.integers(-3, 300), st.sampled_from([*FAR, 2**31, 2**32, 2**32 + 1]))
FLOATS = st.sampled_from(
    [
        0.0,
        -0.0,
        1.0,
        -1.0,
        0.5,
        1e-60,
        1e60,
        3.5e38,
        1e300,
        float("inf"),
        -float("inf"),
        float("nan"),
    ]
)
OTHERS = st.sampled_from(
    [
        None,
        True,
        "",
        "uniform",
        "last",
        "\ud800",
        "1",
        b"1",
        (),
        [],
        [[1], [1, 2]],
        [None],
        {},
        {1: 2},
        {1, 2},
        range(3),
        range(2**40),
        range(2**62),
        range(2**70),
        1j,
        np.complex64(1),
        np.float64(2),
        np.int8(-3),
        np.uint64(2**64 - 1),
        np.bool_(True),
        np.str_("a"),
        object(),
        object,
        len,
        ...,
        slice(None),
        slice(0, 2**70),
        memoryview(b"abcd"),
        iter([1, 2]),
        np.datetime64(0, "s"),
    ]
)
LIARS = st.one_of(
    st.builds(Length, st.one_of(INTEGERS, st.sampled_from(["3", 1.5, None, OwnError, TypeError]))),
    st.builds(Index, st.one_of(INTEGERS, st.sampled_from(["3", 1.5, None, OwnError, TypeError]))),
    st.builds(Arraying, st.sampled_from([np.zeros((1, 4)), [1], None, OwnError, TypeError, "x"])),
)
DTYPES = [
    "f4",
    "f8",
    "f2",
    ">f4",
    "u1",
    "i4",
    "i8",
    "u8",
    "?",
    "c8",
    "O",
    "U2",
    "S3",
    "M8[s]",
    "i4,f4",
]


@st.composite
def arrays(draw: Draw, *, near: np.ndarray | None = None) -> Any:
    """Arrays of every dtype, order and alignment; some much like ``near``."""
    if near is not None and draw(st.booleans()):
        array = near.copy()
        if array.size and array.dtype.kind == "f":
            with np.errstate(all="ignore"):
                array.flat[draw(st.integers(0, array.size - 1))] = draw(FLOATS)
    else:
        shape = tuple(draw(st.lists(st.integers(0, 5), max_size=6)))
        array = np.zeros(shape, np.dtype(draw(st.sampled_from(DTYPES))))
        if array.dtype.kind in "fiub" and array.size:
            with warnings.catch_warnings(), np.errstate(all="ignore"):
                warnings.simplefilter("ignore")
                array.flat[0] = draw(st.sampled_from([0, 1, 3, 100]))
    how = draw(st.integers(0, 12))
    if how == 1:
        array = np.asfortranarray(array)
    elif how == 2:
        array = array[::-1] if array.ndim else array
    elif how == 3 and not array.dtype.hasobject and array.dtype.fields is None:
        array = misaligned(array)
    elif how == 4 and not array.dtype.hasobject:
        array = packed(array)
    elif how == 5 and array.ndim:
        array = array[::2]
    elif how == 6 and array.ndim and array.shape[0]:
        # NumPy counts an axis without items as one.
        item = int(np.prod([max(n, 1) for n in array.shape[1:]])) * max(array.itemsize, 1)
        array = np.broadcast_to(array[:1], (2**56 // item, *array.shape[1:]))
    elif how == 7 and array.ndim < 8:
        array = array.reshape(
            (1,) * (40 if np.lib.NumpyVersion(np.__version__) >= "2.0.0" else 20) + array.shape
        )
    elif how == 8:
        array.flags.writeable = False
    elif how == 9:
        array = np.ma.masked_array(array)
    elif how == 10 and array.dtype == np.dtype("?"):
        array = np.full(array.shape, 7, np.uint8).view("?")
    elif how == 11:
        return array.tolist()
    elif how == 12 and array.dtype.kind == "f":
        return array.astype(np.float64)
    return array


ANYTHING = st.one_of(INTEGERS, FLOATS, OTHERS, LIARS, arrays())


def either(draw: Draw, sensible: Any, nonsense: st.SearchStrategy[Any] = ANYTHING) -> Any:
    """What makes sense, mostly; ``sensible`` may be a strategy."""
    if draw(st.integers(0, 4)):
        return draw(sensible) if isinstance(sensible, st.SearchStrategy) else sensible
    if isinstance(sensible, np.ndarray) and draw(st.booleans()):
        return draw(arrays(near=sensible))
    return draw(nonsense)


# --- worlds and models ------------------------------------------------------------------------

STATES = np.array([[0.0, 0.0, 0.1, -0.1], [0.1, 0.2, 0.0, 0.0], [-0.2, 0.0, 0.1, 0.1]])
LAYOUT = hvf_core.MazeLayout.preset("corridor-1")
LAID = STATES[:, :3] - [0.1, 0.0, 0.0]
"""States of it."""
RNG = np.random.default_rng(0)


def numbers(*shape: int) -> np.ndarray:
    return RNG.normal(0, 0.3, shape).astype(np.float32)


KEYPOINT: dict[str, Any] = {
    "patch": numbers(4, 9),
    "patch_bias": numbers(4),
    "context": numbers(4, 3),
    "middle": numbers(4, 4),
    "middle_bias": numbers(4),
    "output": numbers(3, 4),
    "output_bias": numbers(3),
    "free": numbers(2, 2),
    "action_scale": 3.0,
    "spacing": 2,
    "substeps": 2,
    "half_size": [1.5, 1.5],
    "edge": [1.0, 1.0],
    "colour": [0.1, 0.6, 0.0],
    "action_low": [-3.0, -3.0],
    "action_high": [3.0, 3.0],
    "image_size": 12,
    "blur": 1.0,
    "over_horizon": "min",
}
LAYERS: dict[str, Any] = {
    "hand": [(numbers(4, 8), numbers(4)), (numbers(3, 4), numbers(3))],
    "sliders": [[(numbers(1, 11), numbers(1))], [(numbers(1, 11), numbers(1))]],
    "parts": [(numbers(5, 18), numbers(5))],
    "contact": numbers(10, 2),
    "reach": 7.0,
    "arm_low": [-1.0, -1.0, -1.0],
    "arm_step": [1.0, 1.0, 1.0],
    "arm_places": (2, 3, 2),
    "arm_patches": np.concatenate(
        [np.zeros((1, 4, 8, 8), np.uint8), RNG.integers(0, 256, (3, 4, 8, 8)).astype(np.uint8)]
    ),
    "arm_index": RNG.integers(0, 4, (12, 16)).astype(np.int32),
    "table": RNG.integers(0, 256, (2, 2, 3, 32, 32)).astype(np.uint8),
    "sprites": np.abs(numbers(2, 4, 7, 7)).clip(0, 1),
    "blur": 1.0,
    "over_horizon": "last",
}
MAZE_WORLD = hvf_core.MazeWorld(image_size=8, blur=1.0)
MAZE_FRAMES = hvf_core.MazeFrames(STATES, image_size=8)
KEYPOINT_WORLD = hvf_core.KeypointWorld(**KEYPOINT)
KEYPOINT_IMAGES = RNG.integers(0, 256, (3, 12, 12, 3)).astype(np.uint8)
KEYPOINT_PARTS = (KEYPOINT_IMAGES, np.full((3, 2), 5.0, np.float32), numbers(3, 12, 12))
KEYPOINT_FRAMES = KEYPOINT_WORLD.frames(*KEYPOINT_PARTS)
LAYER_WORLD = hvf_core.LayerWorld(**LAYERS)
LAYER_PARTS = (
    RNG.integers(0, 256, (3, 32, 32, 3)).astype(np.uint8),
    RNG.random((3, 32, 32, 3)).astype(np.float32),
    RNG.random((3, 2, 32, 32)) < 0.1,
    np.abs(numbers(3, 11)),
)
LAYER_FRAMES = LAYER_WORLD.frames(*LAYER_PARTS)
POINTS = numbers(3, 2)
PLANNERS = [
    VisualMPC(horizon=2, samples=6, elites=2, iterations=2),
    VisualMPC(
        horizon=4,
        samples=5,
        elites=5,
        iterations=2,
        action_repeat=2,
        clip=False,
        initial="normal",
        keep_elites=2,
        best="last",
    ),
    VisualMPC(
        horizon=3,
        samples=6,
        elites=2,
        iterations=3,
        noise_beta=2,
        shift_elites=2,
        samples_decay=1.5,
        temperature=0.1,
        momentum=0.1,
        min_std=0.01,
    ),
]
SEARCHES = [
    HVF(mpc=PLANNERS[0], subgoals=0),
    HVF(mpc=PLANNERS[0], subgoals=1, samples=4, elites=2, iterations=2),
    HVF(mpc=PLANNERS[1], subgoals=2, samples=3, elites=1, iterations=1, reduction="mean"),
    HVF(mpc=PLANNERS[2], subgoals=2, samples=4, elites=3, iterations=2, covariance="full"),
]


class Model:
    """A point mass that sometimes answers nonsense."""

    def __init__(self, draw: Draw) -> None:
        self.answer = lambda sensible: either(draw, sensible)
        self.action_low = either(draw, np.array([-1, -1], np.float32))
        self.action_high = either(draw, np.array([1, 1], np.float32))
        if draw(st.booleans()):
            self.max_candidates = either(draw, 7, SETTINGS)
        if draw(st.booleans()):
            self.uses_seeds = either(draw, True)
        if not draw(st.integers(0, 5)):
            self.native = either(draw, MAZE_WORLD)

    def rollout_costs(self, starts: Any, goals: Any, actions: Any, seeds: Any = None) -> Any:
        costs = (actions.sum(axis=(2, 3)) ** 2).astype(np.float32)
        actions[...] = np.nan
        return self.answer(costs)


class Sharer(Model):
    def shared_rollout_costs(self, start: Any, goals: Any, actions: Any, seeds: Any = None) -> Any:
        costs = (actions.sum(axis=(1, 2)) ** 2).astype(np.float32)
        return self.answer(np.repeat(costs[None], len(goals), axis=0))


class Preparer(Model):
    def prepare(self, starts: Any, goals: Any) -> Any:
        return self.answer((self.answer(starts), self.answer(goals)))


class Observer(Model):
    def observe(self, images: Any) -> Any:
        return self.answer(POINTS[: len(images)])


class Generator:
    def __init__(self, draw: Draw, frames: Any) -> None:
        self.answer = lambda sensible: either(draw, sensible)
        self.frames = frames
        self.latent_dim = either(draw, 2, SETTINGS)

    def decode(self, scene: Any, latents: Any) -> Any:
        return self.answer(self.frames[np.zeros(latents.shape[0] * latents.shape[1], np.int64)])


# --- calls ------------------------------------------------------------------------------------


def constructor(draw: Draw) -> Call:
    settings: dict[str, Any] = {
        "horizon": SETTINGS,
        "samples": SETTINGS,
        "elites": SETTINGS,
        "iterations": SETTINGS,
        "min_variance": FLOATS,
        "keep_elites": SETTINGS,
        "best": st.sampled_from(["all", "last"]),
        "momentum": FLOATS,
        "samples_decay": FLOATS,
        "temperature": FLOATS,
        "min_std": FLOATS,
        "covariance": st.sampled_from(["diagonal", "full"]),
        "shrinkage": FLOATS,
    }
    mpc = {
        "noise_beta": FLOATS,
        "shift_elites": SETTINGS,
        "action_repeat": SETTINGS,
        "initial": st.sampled_from(["uniform", "normal"]),
        "initial_low": arrays(),
        "initial_high": arrays(),
        "initial_mean": FLOATS,
        "initial_std": FLOATS,
        "warm_start_std": FLOATS,
        "clip": st.booleans(),
    }
    search = {
        "mpc": st.sampled_from([None, *PLANNERS]),
        "subgoals": SETTINGS,
        "prune": st.booleans(),
        "reduction": st.sampled_from(["max", "mean"]),
        "share_rollouts": st.booleans(),
    }
    of = {
        VisualMPC: {**settings, **mpc},
        HVF: {**{k: v for k, v in settings.items() if k != "horizon"}, **search},
    }
    kind = draw(st.sampled_from(list(of)))
    names = draw(st.lists(st.sampled_from(list(of[kind])), max_size=3, unique=True))
    options = {name: either(draw, of[kind][name]) for name in names}

    def call() -> None:
        made = kind(**options)
        assert made == kind(**{name: getattr(made, name) for name in options})
        hash(made), repr(made)

    return f"{kind.__name__}({', '.join(names)})", call


def native(draw: Draw) -> Call:
    kind = draw(
        st.sampled_from(
            ["KeypointWorld", "LayerWorld", "MazeWorld", "MazeFrames", "MazeSubgoals", "MazeLayout"]
        )
    )
    of: dict[str, Any] = {
        "KeypointWorld": KEYPOINT,
        "LayerWorld": LAYERS,
        "MazeWorld": {"image_size": 8, "blur": 1.0, "over_horizon": "sum"},
        "MazeFrames": {"states": STATES, "image_size": 8, "layout": None},
        "MazeSubgoals": {"latent_dim": 3, "layout": LAYOUT},
        "MazeLayout": {
            "name": "any",
            "walls": LAYOUT.walls,
            "start": LAYOUT.start,
            "goal": LAYOUT.goal,
            "arena": LAYOUT.arena,
            "gaps": LAYOUT.gaps,
        },
    }
    names = draw(st.lists(st.sampled_from(list(of[kind])), min_size=1, max_size=2, unique=True))
    changed = {name: either(draw, of[kind][name]) for name in names}
    options = {**of[kind], **changed}
    return f"{kind}({', '.join(names)})", lambda: getattr(hvf_core, kind)(**options)


def function(draw: Draw) -> Call:
    images = np.zeros((2, 8, 8, 3), draw(st.sampled_from([np.uint8, np.float32])))
    of: dict[str, tuple[Any, ...]] = {
        "maze_step": (STATES, numbers(3, 2)),
        "maze_render": (STATES, 8),
        "maze_locate": (images,),
        "maze_episodes": (0, 0, 3, "hard"),
        "maze_subgoals": (STATES, STATES[:, :2], 2),
        "maze_collect": (0, 0, 2, 3, 8),
        "maze_success": (STATES, STATES[:, :2]),
        "image_cost": (images, images, "pairs", 0.5),
    }
    in_layout: dict[str, tuple[Any, ...]] = {
        "maze_step": (LAID, numbers(3, 2), LAYOUT),
        "maze_render": (LAID, 8, LAYOUT),
        "maze_locate": (images, LAYOUT),
        "maze_episodes": (0, 0, 3, None, LAYOUT),
        "maze_subgoals": (LAID, LAID[:, :2], 2, LAYOUT),
        "maze_collect": (0, 0, 2, 3, 8, LAYOUT),
        "maze_success": (LAID, LAID[:, :2], LAYOUT),
    }
    name, sensible = draw(st.sampled_from([*of.items(), *in_layout.items()]))
    arguments = [either(draw, argument) for argument in sensible]
    return name, lambda: getattr(hvf_core, name)(*arguments)


def method(draw: Draw) -> Call:
    a2, a3 = numbers(3, 4, 2, 2), numbers(3, 4, 2, 3)
    of: list[tuple[str, Callable[..., Any], tuple[Any, ...]]] = []
    for frames in (MAZE_FRAMES, KEYPOINT_FRAMES, LAYER_FRAMES):
        index = draw(st.sampled_from([1, -1, [0, 2], np.array([2, -3]), np.array([0], np.uint8)]))
        of.append((f"{type(frames).__name__}[]", frames.__getitem__, (index,)))
    for world, frames, actions in (
        (MAZE_WORLD, MAZE_FRAMES, a2),
        (KEYPOINT_WORLD, KEYPOINT_FRAMES, a2),
        (LAYER_WORLD, LAYER_FRAMES, a3),
    ):
        name = type(world).__name__
        of.append((f"{name}.rollout_costs", world.rollout_costs, (frames, frames, actions)))
        if not isinstance(world, hvf_core.KeypointWorld):
            shared = world.shared_rollout_costs
            of.append((f"{name}.shared_rollout_costs", shared, (frames[0], frames, actions[0])))
        one = isinstance(world, hvf_core.MazeWorld)
        rollout = (frames[0], actions[0]) if one else (frames, actions)
        of.append((f"{name}.rollout", world.rollout, rollout))
    of += [
        ("MazeWorld.observe", MAZE_WORLD.observe, (MAZE_FRAMES.images,)),
        (
            "MazeSubgoals.decode",
            hvf_core.MazeSubgoals(2).decode,
            (MAZE_FRAMES[0], numbers(2, 1, 2)),
        ),
        ("KeypointWorld.frames", KEYPOINT_WORLD.frames, KEYPOINT_PARTS),
        ("KeypointFrames.moved", KEYPOINT_FRAMES[0].moved, KEYPOINT_PARTS[:2]),
        ("LayerWorld.frames", LAYER_WORLD.frames, LAYER_PARTS),
        ("LayerWorld.draw", LAYER_WORLD.draw, (LAYER_FRAMES, LAYER_PARTS[3])),
        ("LayerWorld.predict", LAYER_WORLD.predict, (LAYER_FRAMES, a3[:, 0])),
    ]
    name, called, sensible = draw(st.sampled_from(of))
    arguments = [either(draw, argument) for argument in sensible]
    return name, lambda: called(*arguments)


def plan(draw: Draw) -> Call:
    worlds = [
        (MAZE_WORLD, MAZE_FRAMES),
        (KEYPOINT_WORLD, KEYPOINT_FRAMES),
        (LAYER_WORLD, LAYER_FRAMES),
    ]
    kinds = [Model, Sharer, Preparer, Observer]
    world, frames = draw(st.sampled_from([*worlds, *[(kind, POINTS) for kind in kinds]]))
    model = world(draw) if isinstance(world, type) else world
    if not draw(st.integers(0, 9)):
        model = draw(ANYTHING)
    one = frames[np.array([0])]
    generator = either(draw, Generator(draw, frames))
    mpc, search = draw(st.sampled_from(PLANNERS)), draw(st.sampled_from(SEARCHES))
    which = draw(st.sampled_from(["plan", "plan_batch", "search", "search_batch"]))
    batch = which.endswith("batch")
    start = either(draw, frames if batch else one)
    goal = either(draw, frames if batch else one)
    seed = either(draw, [1, 2, 3] if batch else 5)
    if which.startswith("plan"):
        warm = either(draw, None)
        called = mpc.plan_batch if batch else mpc.plan
        arguments: tuple[Any, ...] = (model, start, goal, seed, warm)
    else:
        called = search.search_batch if batch else search.search
        arguments = (model, generator, start, goal, seed)
    return f"{which} of {type(model).__name__}", lambda: called(*arguments)


def any_call(draw: Draw) -> Call:
    """A call of something in ``hvf_core``: its name, and what makes it.

    Args:
        draw: of ``st.data()``, since models draw what they answer while the call is made.
    """
    kind = draw(st.sampled_from([constructor, native, function, method, method, plan, plan]))
    return kind(draw)


def make(name: str, call: Callable[[], Any]) -> bool:
    """Make a call; say whether it returned.

    Raises:
        AssertionError: it raises something that no call may.
    """
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        try:
            call()
        except BaseException as error:
            wrong = problem(error)
            if wrong is None:
                return False
            if isinstance(error, KeyboardInterrupt) or type(error).__module__.startswith(
                "hypothesis"
            ):
                raise
            raise AssertionError(f"{name} raised {wrong}") from error
    return True
