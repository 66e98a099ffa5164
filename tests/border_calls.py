"""Calls of everything public in ``hvf_core``: with what makes sense, and with nonsense.

A call is known by the name that what is called gives itself, ``MazeWorld.rollout_costs``.
"""

from __future__ import annotations

import copy
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, TypeAlias

import numpy as np

import hvf_core
import stub_docs
from border_worlds import (
    A2,
    A3,
    GRU,
    KEYPOINT,
    KEYPOINT_FRAMES,
    KEYPOINT_PARTS,
    KEYPOINT_WORLD,
    LAID,
    LATENT,
    LATENT_FRAMES,
    LATENT_PARTS,
    LATENT_WORLD,
    LAYER_FRAMES,
    LAYER_PARTS,
    LAYER_WORLD,
    LAYERS,
    LAYOUT,
    MAZE_FRAMES,
    MAZE_LAYOUT,
    MAZE_WORLD,
    PLANNERS,
    POINTS,
    SEARCHES,
    STATES,
    WORLDS,
    numbers,
)
from hvf_core import HVF, VisualMPC
from nonsense import (
    ANYTHING,
    FLOATS,
    RAISED,
    SETTINGS,
    Choose,
    OwnError,
    Source,
    arrays,
    either,
    instead,
    of,
    quiet,
)

# --- models -----------------------------------------------------------------------------------

BUDGET: dict[str, Source] = {
    "samples": SETTINGS,
    "elites": SETTINGS,
    "iterations": SETTINGS,
    "min_variance": FLOATS,
    "keep_elites": SETTINGS,
    "best": of("all", "last"),
    "momentum": FLOATS,
    "samples_decay": FLOATS,
    "temperature": FLOATS,
    "min_std": FLOATS,
    "covariance": of("diagonal", "full"),
    "shrinkage": FLOATS,
}
MPC_OPTIONS: dict[str, Source] = {
    **BUDGET,
    "horizon": SETTINGS,
    "action_repeat": SETTINGS,
    "initial": of("uniform", "normal"),
    "initial_low": arrays,
    "initial_high": arrays,
    "initial_mean": FLOATS,
    "initial_std": FLOATS,
    "warm_start_std": FLOATS,
    "clip": of(True, False),
    "noise_beta": FLOATS,
    "shift_elites": SETTINGS,
}
HVF_OPTIONS: dict[str, Source] = {
    **BUDGET,
    "mpc": of(None, *PLANNERS),
    "subgoals": SETTINGS,
    "prune": of(True, False),
    "reduction": of("max", "mean", "max-sum"),
    "share_rollouts": of(True, False),
    "chunk": SETTINGS,
    "segment_cost": of("planned", "likelihood"),
}


class Model:
    """A point mass that sometimes answers nonsense."""

    def __init__(self, choose: Choose) -> None:
        self.answer = lambda sensible: either(choose, sensible)
        self.action_low = either(choose, np.array([-1, -1], np.float32))
        self.action_high = either(choose, np.array([1, 1], np.float32))
        if choose(2):
            self.max_candidates = either(choose, 7, SETTINGS)
        if choose(2):
            self.uses_seeds = either(choose, True)
        if choose(2):
            self.pads = either(choose, True)
        if choose(6) == 5:
            self.native = either(choose, MAZE_WORLD)

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


class Frames:
    """Frames of a class of their own."""

    def __init__(self, points: np.ndarray) -> None:
        self.points = points

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, index: Any) -> Any:
        return type(self)(self.points[index])


def joining(choose: Choose) -> Frames:
    """Frames that can be joined, sometimes to nonsense."""

    def join(parts: list[Any]) -> Any:
        return either(choose, kind(np.concatenate([part.points for part in parts])))

    kind = type("Joining", (Frames,), {"join": staticmethod(join)})
    return kind(POINTS)


class Generator:
    def __init__(self, choose: Choose, frames: Any) -> None:
        self.answer = lambda sensible: either(choose, sensible)
        self.choose = choose
        self.frames = frames
        self.latent_dim = either(choose, 2, SETTINGS)

    def decode(self, scene: Any, latents: Any) -> Any:
        return self.answer(self.frames[np.zeros(latents.shape[0] * latents.shape[1], np.int64)])

    def segment_costs(self, scene: Any, goal: Any, latents: Any) -> Any:
        return self.answer(np.abs(latents).sum(axis=2).repeat(2, axis=1)[:, : latents.shape[1] + 1])

    def proposals(self, start: Any, goal: Any, subgoals: int) -> Any:
        """Some, now and then."""
        if self.choose(3):
            return None
        mean = np.zeros((subgoals, 2), np.float32)
        return self.answer((self.answer(mean), self.answer(mean + 1)))


# --- calls ------------------------------------------------------------------------------------


class Call(NamedTuple):
    """Something that is called, and with what."""

    called: Callable[..., Any]
    arguments: tuple[Any, ...]
    options: dict[str, Any]
    spoilt: int = 0
    """How many of these are nonsense; -1 for an unknown number."""

    @property
    def name(self) -> str:
        """What is called, by its own word."""
        return str(self.called.__qualname__)

    def __call__(self) -> Any:
        """Make it, and read whatever it gives."""
        found = self.called(*self.arguments, **self.options)
        look(found)
        return found


def look(found: Any) -> None:
    """Read everything that can be read of what a call gave."""
    if isinstance(found, (list, tuple)):
        for item in found:
            look(item)
    if type(found).__module__ != "hvf_core":
        return
    for name in readable(type(found)):
        getattr(found, name, None)
    repr(found), hash(found)
    if hasattr(found, "__len__"):
        assert len(list(found)) == len(found)
    if isinstance(found, (HVF, VisualMPC, hvf_core.MazeLayout)):
        assert copy.copy(found) == found


def readable(kind: type) -> list[str]:
    """The attributes of a class's objects that are not called."""
    return [
        name
        for name in vars(kind)
        if not name.startswith("_") and not callable(getattr(kind, name))
    ]


def public() -> Iterator[str]:
    """Everything in the module that can be called, by name: classes, their methods, functions."""
    for name, thing in stub_docs.public():
        if callable(thing):
            yield name
        if isinstance(thing, type) and "__getitem__" in vars(thing):
            yield f"{name}.__getitem__"


Maker: TypeAlias = Callable[[Choose], Call]
CATALOGUE: defaultdict[str, list[Maker]] = defaultdict(list)
"""What makes calls, by the name of what is called. With zeros for choices they make sense."""


SPOILT = of(0, 1, 1, 2)
"""How many arguments are nonsense."""


def add(called: Callable[..., Any], *arguments: Any, **options: Any) -> None:
    """A call of which up to two arguments may be nonsense."""

    sensible: dict[Any, Any] = {**dict(enumerate(arguments)), **options}
    places = of(*sensible)

    def maker(choose: Choose) -> Call:
        given = dict(sensible)
        spoilt = {places(choose) for _ in range(SPOILT(choose) if given else 0)}
        for place in spoilt:
            given[place] = instead(choose, sensible[place])
        return Call(
            called,
            tuple(given[place] for place in range(len(arguments))),
            {name: given[name] for name in options},
            len(spoilt),
        )

    CATALOGUE[called.__qualname__].append(maker)


def mostly(choose: Choose, source: Source) -> Any:
    return (source if choose(5) < 4 else ANYTHING)(choose)


def add_planner(kind: type, options: dict[str, Source]) -> None:
    """A planner of which up to three options are given."""

    def maker(choose: Choose) -> Call:
        names = [of(*options)(choose) for _ in range(choose(4))]
        return Call(kind, (), {name: mostly(choose, options[name]) for name in names}, -1)

    CATALOGUE[kind.__qualname__].append(maker)


def add_planning(called: Callable[..., Any], search: bool, batch: bool) -> None:
    """A call of a planner with a world of this module or a model in Python."""

    def maker(choose: Choose) -> Call:
        kinds = [(kind, POINTS) for kind in (Model, Sharer, Preparer, Observer)]
        world, frames, *_ = of(*WORLDS, *kinds)(choose)
        if isinstance(world, type) and choose(3) == 2:
            frames = joining(choose)
        model = world(choose) if isinstance(world, type) else world
        if choose(10) == 9:
            model = ANYTHING(choose)
        given = frames if batch else frames[np.array([0])]
        start, goal = either(choose, given), either(choose, given)
        seed = either(choose, [1, 2, 3] if batch else 5)
        if search:
            generator = either(choose, Generator(choose, frames))
            progress = () if batch else (either(choose, None),)
            return Call(called, (model, generator, start, goal, seed, *progress), {}, -1)
        warm, elites = either(choose, None), either(choose, None)
        return Call(called, (model, start, goal, seed, warm, elites), {}, -1)

    CATALOGUE[called.__qualname__].append(maker)


IMAGES = np.zeros((2, 8, 8, 3), np.uint8)
for images in (IMAGES, IMAGES.astype(np.float32)):
    add(hvf_core.image_cost, images, images, "pairs", 0.5)
for states, layout, difficulty in ((STATES, None, "hard"), (LAID, LAYOUT, None)):
    add(hvf_core.maze_step, states, numbers(3, 2), layout)
    add(hvf_core.maze_render, states, 8, layout)
    add(hvf_core.maze_locate, IMAGES, layout)
    add(hvf_core.maze_episodes, 0, 0, 3, difficulty, layout)
    add(hvf_core.maze_subgoals, states, states[:, :2], 2, layout)
    add(hvf_core.maze_collect, 0, 0, 2, 3, 8, layout)
    add(hvf_core.maze_success, states, states[:, :2], layout)
    add(hvf_core.MazeFrames, states, 8, layout)
    add(hvf_core.MazeWorld, 8, 1.0, "sum", layout)
    add(hvf_core.MazeSubgoals, 3, layout)
add(hvf_core.MazeLayout, **MAZE_LAYOUT)
add(hvf_core.MazeLayout.preset, "u-maze")
add(hvf_core.KeypointWorld, **KEYPOINT)
add(hvf_core.LayerWorld, **LAYERS)
add(hvf_core.LatentWorld, **LATENT)
add(hvf_core.LatentWorld, **GRU)
add(hvf_core.LatentFrames, *LATENT_PARTS)

for world, frames, actions in WORLDS:
    for index in (1, [0, 2], np.array([2, -3]), np.array([0], np.uint8)):
        add(frames.__getitem__, index)
    add(world.rollout_costs, frames, frames, actions)
    if hasattr(world, "shared_rollout_costs"):
        add(world.shared_rollout_costs, frames[0], frames, actions[0])
add(MAZE_WORLD.rollout, MAZE_FRAMES[0], A2[0])
add(MAZE_WORLD.observe, MAZE_FRAMES.images)
add(hvf_core.MazeSubgoals(2).decode, MAZE_FRAMES[0], numbers(2, 1, 2))
add(KEYPOINT_WORLD.rollout, KEYPOINT_FRAMES, A2)
add(KEYPOINT_WORLD.frames, *KEYPOINT_PARTS)
add(KEYPOINT_FRAMES[0].moved, *(part[:2] for part in KEYPOINT_PARTS[:2]))
add(LAYER_WORLD.rollout, LAYER_FRAMES, A3)
add(LAYER_WORLD.frames, *LAYER_PARTS)
add(LAYER_WORLD.draw, LAYER_FRAMES, LAYER_PARTS[3])
add(LAYER_WORLD.predict, LAYER_FRAMES, A3[:, 0])
add(LATENT_WORLD.rollout, LATENT_FRAMES, A2)

add_planner(VisualMPC, MPC_OPTIONS)
add_planner(HVF, HVF_OPTIONS)
for mpc in PLANNERS:
    add_planning(mpc.plan, search=False, batch=False)
    add_planning(mpc.plan_batch, search=False, batch=True)
for hvf in SEARCHES:
    add_planning(hvf.search, search=True, batch=False)
    add_planning(hvf.search_batch, search=True, batch=True)
PLANS = PLANNERS[0].plan_batch(MAZE_WORLD, MAZE_FRAMES, MAZE_FRAMES)
add(PLANS.__getitem__, 1)
# These only planners and worlds make.
for kind in (hvf_core.Plan, hvf_core.Plans, hvf_core.SearchResult):
    add(kind)
for kind in (hvf_core.KeypointFrames, hvf_core.LayerFrames):
    add(kind, numbers(3, 2))


PLANNING = [makers for name, makers in CATALOGUE.items() if "." in name and name[0] in "HV"]
ANY = of(*CATALOGUE.values(), *PLANNING * 3)
"""Planners, which have most to go wrong, more often."""


def any_call(choose: Choose) -> Call:
    """A call of something in ``hvf_core``; what is planned with makes choices of its own later."""
    return of(*ANY(choose))(choose)(choose)


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


def make(call: Call) -> bool:
    """Make a call; say whether it returned.

    Raises:
        AssertionError: It raises something that no call may, or not what its argument raised.
    """
    RAISED.clear()
    with warnings.catch_warnings(), quiet():
        warnings.simplefilter("ignore")
        try:
            call()
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt) or type(error).__module__[:10] == "hypothesis":
                raise
            wrong = None if error in RAISED else problem(error)
            # Of two arguments that are wrong, either may be complained about.
            if wrong is None and call.spoilt == 1 and own_errors() and error not in own_errors():
                wrong = f"{error!r} in place of {own_errors()}"
            if wrong is None:
                return False
            raise AssertionError(f"{call.name} raised {wrong}") from error
    assert not own_errors(), f"{call.name} returned in spite of {own_errors()}"
    return True


def own_errors() -> list[BaseException]:
    return [error for error in RAISED if isinstance(error, OwnError)]
