"""Searches that ask for the segments of all samples, and of searches beside them, in few calls."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import hvf_core
from hvf_core import HVF, VisualMPC

Floats = NDArray[np.float32]
SMALL = VisualMPC(horizon=3, samples=30, elites=6, iterations=3, min_variance=0.0)
WHOLE = HVF(
    mpc=SMALL, subgoals=2, samples=24, elites=5, iterations=2, prune=False, share_rollouts=False
)


class Held:
    """Frames of a class of its own, that cannot be joined."""

    def __init__(self, points: Floats) -> None:
        self.points = points

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, index: NDArray[np.int64]) -> Any:
        return type(self)(self.points[index])


class Joining(Held):
    """Frames that can."""

    @staticmethod
    def join(parts: list[Joining]) -> Joining:
        return Joining(np.concatenate([part.points for part in parts]))


class Sloppy(Held):
    """Frames that lose one on the way."""

    @staticmethod
    def join(parts: list[Sloppy]) -> Sloppy:
        return Sloppy(np.concatenate([part.points for part in parts])[1:])


class Points:
    """A point that moves by its actions, in frames of any class; counts its calls."""

    action_low = np.array([-1.0, -1.0], np.float32)
    action_high = np.array([1.0, 1.0], np.float32)

    def __init__(self, plain: Callable[[Any], Floats]) -> None:
        self.plain = plain
        self.sizes: list[int] = []

    def rollout_costs(self, starts: Any, goals: Any, actions: Floats) -> Any:
        self.sizes.append(len(actions))
        start, goal = self.plain(starts), self.plain(goals)
        ends = start[:, None] + actions.sum(axis=2)
        return ((ends - goal[:, None]) ** 2).sum(axis=-1)


class Drawing:
    latent_dim = 2

    def __init__(self, made: Callable[[Floats], Any]) -> None:
        self.made = made

    def decode(self, scene: Any, latents: Floats) -> Any:
        return self.made(2 * latents.reshape(-1, 2))


KINDS: dict[str, tuple[Callable[[Floats], Any], Callable[[Any], Floats]]] = {
    "arrays": (lambda points: points, lambda frames: frames),
    "tensors": (torch.from_numpy, lambda frames: frames.numpy()),
    "joining": (Joining, lambda frames: frames.points),
    "held": (Held, lambda frames: frames.points),
}


def ends(count: int) -> tuple[Floats, Floats]:
    random = np.random.default_rng(5)
    return tuple(random.normal(0, 3, (2, count, 2)).astype(np.float32))  # type: ignore[return-value]


@pytest.mark.parametrize("kind", KINDS)
def test_a_search_asks_for_all_segments_at_once_where_frames_can_be_joined(kind: str) -> None:
    made, plain = KINDS[kind]
    starts, goals = ends(3)
    world = Points(plain)
    expected = [
        WHOLE.search(Points(lambda frames: frames), Drawing(lambda points: points), s, g, seed)
        for s, g, seed in zip(starts[:, None], goals[:, None], (7, 7, 8), strict=True)
    ]
    found = WHOLE.search_batch(world, Drawing(made), made(starts), made(goals), [7, 7, 8])
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one.latents, other.latents)
        np.testing.assert_array_equal(one.segment_costs, other.segment_costs)
        np.testing.assert_array_equal(plain(one.subgoals), other.subgoals)
        np.testing.assert_array_equal(
            np.stack([plan.actions for plan in one.plans]),
            np.stack([plan.actions for plan in other.plans]),
        )
    if kind == "held":  # first, second and third segments of three searches
        assert world.sizes == [24] * (2 * 3 * 3 * 3)
    else:
        assert world.sizes == [3 * 3 * 24] * (2 * 3)


@pytest.mark.parametrize(
    "drawn",
    [
        lambda points: points.astype(np.float64),
        lambda points: np.pad(points, ((0, 0), (0, 1))),
    ],
)
def test_arrays_of_another_kind_are_not_joined(drawn: Callable[[Floats], Any]) -> None:
    """They would become one: the model must see what its generator drew."""
    seen: set[tuple[Any, Any]] = set()

    class Picky(Points):
        def rollout_costs(self, starts: Any, goals: Any, actions: Floats) -> Any:
            seen.add((starts.dtype.name, starts.shape[1]))
            return super().rollout_costs(starts[:, :2], goals[:, :2], actions)

    start, goal = ends(1)
    WHOLE.search(Picky(lambda frames: frames), Drawing(drawn), start, goal)
    one = drawn(start)
    assert seen == {("float32", 2), (one.dtype.name, one.shape[1])}


def test_a_join_that_loses_frames_is_an_error() -> None:
    start, goal = ends(1)
    with pytest.raises(ValueError, match="join must give the 72 frames of its parts, got 71"):
        WHOLE.search(Points(lambda f: f.points), Drawing(Sloppy), Sloppy(start), Sloppy(goal))


def test_what_a_join_raises_is_raised() -> None:
    class Broken(Held):
        @staticmethod
        def join(parts: list[Broken]) -> Broken:
            raise ZeroDivisionError("no memory")

    start, goal = ends(1)
    with pytest.raises(ZeroDivisionError, match="no memory"):
        WHOLE.search(Points(lambda f: f.points), Drawing(Broken), Broken(start), Broken(goal))


@settings(max_examples=30, deadline=None)
@given(
    count=st.integers(1, 4),
    subgoals=st.integers(0, 3),
    prune=st.booleans(),
    share=st.booleans(),
    chunk=st.none() | st.integers(1, 30),
    most=st.integers(1, 3000),
    kind=st.sampled_from(sorted(KINDS)),
)
def test_searches_side_by_side_are_what_each_is_alone(
    count: int, subgoals: int, prune: bool, share: bool, chunk: int | None, most: int, kind: str
) -> None:
    made, plain = KINDS[kind]
    starts, goals = ends(count)

    def search(**options: Any) -> HVF:
        return HVF(mpc=SMALL, subgoals=subgoals, samples=24, elites=5, iterations=2, **options)

    world = Points(plain)
    world.max_candidates = most  # type: ignore[attr-defined]
    together = search(prune=prune, share_rollouts=share, chunk=chunk).search_batch(
        world, Drawing(made), made(starts), made(goals), list(range(count))
    )
    for number, found in enumerate(together):
        alone = search(prune=False).search(
            Points(plain),
            Drawing(made),
            made(starts[number : number + 1]),
            made(goals[number : number + 1]),
            number,
        )
        np.testing.assert_array_equal(found.latents, alone.latents)
        np.testing.assert_array_equal(found.segment_costs, alone.segment_costs)


def test_the_maze_searches_side_by_side_as_alone() -> None:
    states, targets = hvf_core.maze_episodes(0, 3, 3, "hard")
    starts = hvf_core.maze_render(states)
    goals = hvf_core.maze_render(np.hstack([targets, states[:, 2:]]))
    world, generator = hvf_core.MazeWorld(), hvf_core.MazeSubgoals()
    search = HVF(mpc=SMALL, subgoals=2, samples=24, elites=5, iterations=2)
    found = search.search_batch(world, generator, starts, goals, [1, 2, 3])
    for number in range(3):
        one = slice(number, number + 1)
        alone = search.search(world, generator, starts[one], goals[one], number + 1)
        np.testing.assert_array_equal(found[number].latents, alone.latents)
        np.testing.assert_array_equal(found[number].segment_costs, alone.segment_costs)


@pytest.mark.parametrize("wrong", [0, -1, 2.5, "all"])
def test_a_chunk_that_is_no_number_of_samples_is_refused(wrong: Any) -> None:
    with pytest.raises((ValueError, TypeError), match=r"^chunk: "):
        HVF(chunk=wrong)
    assert HVF(chunk=7).chunk == 7
    assert HVF().chunk is None
    assert HVF(chunk=7) != HVF(chunk=8)
