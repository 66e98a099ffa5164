"""Visual MPC and the subgoal search with worlds written in Python."""

from __future__ import annotations

import copy
import os
import pickle
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import hvf_core
from hvf import protocols
from hvf_core import HVF, VisualMPC

Floats = NDArray[np.float32]


class PointMass:
    """Frames are positions [N, 2]; every action is added to the position."""

    action_low = np.array([-1.0, -1.0], np.float32)
    action_high = np.array([1.0, 1.0], np.float32)

    def __init__(self) -> None:
        self.calls: list[tuple[Floats, Floats, Floats, Floats]] = []

    def rollout_costs(self, starts: Floats, goals: Floats, actions: Floats) -> Any:
        ends = starts[:, None] + actions.sum(axis=2)
        costs = ((ends - goals[:, None]) ** 2).sum(axis=-1)
        self.calls.append((starts, goals, actions, costs))
        return costs


class SharingPointMass(PointMass):
    def shared_rollout_costs(self, start: Floats, goals: Floats, actions: Floats) -> Floats:
        ends = (start[:, None] + actions[None].sum(axis=2)).astype(np.float32)
        return ((ends - goals[:, None]) ** 2).sum(axis=-1)


class Positions:
    """Latents are positions; remembers what it was asked."""

    latent_dim = 2

    def __init__(self) -> None:
        self.calls: list[tuple[Floats, Floats]] = []

    def decode(self, scene: Floats, latents: Floats) -> Floats:
        self.calls.append((scene, latents.copy()))
        return 2 * latents.reshape(-1, 2)


START = np.zeros((1, 2), np.float32)
GOAL = np.array([[6.0, 3.0]], np.float32)
SMALL = VisualMPC(horizon=3, samples=30, elites=6, iterations=3)
SMALL_SEARCH = HVF(mpc=SMALL, subgoals=2, samples=24, elites=5, iterations=3)


def refit(elites: Floats) -> tuple[Floats, Floats]:
    return elites.mean(axis=0, dtype=np.float64), elites.std(axis=0, dtype=np.float64)


def test_the_test_models_satisfy_the_protocols() -> None:
    assert isinstance(PointMass(), protocols.WorldModel)
    assert not isinstance(PointMass(), protocols.RolloutSharer)
    assert isinstance(SharingPointMass(), protocols.RolloutSharer)
    assert isinstance(Positions(), protocols.SubgoalModel)
    assert isinstance(START, protocols.Frames)
    assert isinstance(torch.zeros(1), protocols.Frames)


def test_plan_equals_a_numpy_cem_over_the_candidates_the_model_saw() -> None:
    world = PointMass()
    mpc = VisualMPC(horizon=3, samples=500, elites=50, iterations=4, min_variance=0.0)
    plan = mpc.plan(world, START, GOAL / 3, seed=1)
    best = (np.inf, np.empty(0))
    mean = std = np.empty(0)
    for iteration, (_, _, actions, costs) in enumerate(world.calls):
        candidates, cost = actions[0].reshape(500, 6), costs[0]
        if iteration == 0:
            assert candidates.min() >= -1
            assert candidates.max() <= 1
            assert abs(candidates.mean()) < 0.05
            assert abs(candidates.std() - 1 / np.sqrt(3)) < 0.03
        else:
            # Clipping to the box can only pull the sample moments inwards.
            inside = (np.abs(mean) + 4 * std) < 1
            drawn_mean, drawn_std = candidates.mean(axis=0), candidates.std(axis=0)
            assert np.all(np.abs(drawn_mean - mean)[inside] < 5 * std[inside] / np.sqrt(500))
            assert np.all(np.abs(drawn_std / std - 1)[inside] < 5 / np.sqrt(2 * 500))
        order = np.argsort(cost, kind="stable")[:50]
        mean, std = refit(candidates[order])
        if cost[order[0]] < best[0]:
            best = (cost[order[0]], actions[0, order[0]])
        history = {name: values[iteration] for name, values in plan.history.items()}
        assert history["best"] == cost[order[0]]
        assert history["elite_worst"] == cost[order[-1]]
        assert history["elite_mean"] == pytest.approx(cost[order].mean(dtype=np.float64))
        assert history["population_mean"] == pytest.approx(cost.mean(dtype=np.float64))
        assert history["max_std"] == pytest.approx(std.max())
    assert len(world.calls) == plan.iterations == 4
    assert plan.cost == best[0]
    np.testing.assert_array_equal(plan.actions, best[1])


def test_search_equals_a_numpy_search_over_the_latents_the_generator_saw() -> None:
    generator = Positions()
    result = SMALL_SEARCH.search(PointMass(), generator, START, GOAL, seed=3)
    all_costs = HVF(
        mpc=SMALL, subgoals=2, samples=24, elites=5, iterations=3, prune=False, share_rollouts=False
    )
    world = PointMass()
    again = Positions()
    all_costs.search(world, again, START, GOAL, seed=3)
    # Three iterations per search iteration, all three segments of all 24 samples in one call.
    best = np.inf
    for iteration, (scene, latents) in enumerate(again.calls):
        np.testing.assert_array_equal(scene, START)
        np.testing.assert_array_equal(latents, generator.calls[iteration][1])
        calls = world.calls[3 * iteration : 3 * iteration + 3]
        segments = np.minimum.reduce([call[3].min(axis=1) for call in calls]).reshape(24, 3).T
        costs = np.max(segments, axis=0)
        order = np.argsort(costs, kind="stable")[:5]
        history = {name: values[iteration] for name, values in result.history.items()}
        assert history["best"] == costs[order[0]]
        assert history["elite_worst"] == costs[order[-1]]
        _, std = refit(latents.reshape(24, 4)[order])
        assert history["max_std"] == pytest.approx(std.max())
        if costs[order[0]] < best:
            best = costs[order[0]]
            expected = latents[order[0]]
            expected_segments = [segment[order[0]] for segment in segments]
    np.testing.assert_array_equal(result.latents, expected)
    np.testing.assert_array_equal(result.segment_costs, expected_segments)
    assert result.cost == best == max(result.segment_costs)
    np.testing.assert_array_equal(result.subgoals, 2 * result.latents)
    assert len(result.plans) == 3
    evaluated, skipped = result.history["evaluated"], result.history["skipped"]
    np.testing.assert_array_equal(evaluated + skipped, 3 * 24)
    assert skipped.sum() > 0


class Judge(Positions):
    """Knows how far apart positions are."""

    def segment_costs(self, start: Floats, goal: Floats, latents: Floats) -> Any:
        ends = np.repeat(start[None], len(latents), 0), np.repeat(goal[None], len(latents), 0)
        way = np.concatenate([ends[0], 2 * latents, ends[1]], axis=1)
        costs = np.linalg.norm(np.diff(way, axis=1), axis=2)
        self.calls.append((latents.copy(), costs))
        return costs


REDUCTIONS: dict[str, Callable[[Floats], Floats]] = {
    "max": lambda segments: segments.max(axis=1),
    "mean": lambda segments: segments.mean(axis=1),
    "max-sum": lambda segments: segments.max(axis=1) + 0.1 * segments.sum(axis=1),
}


@pytest.mark.parametrize("reduction", REDUCTIONS)
def test_a_search_by_likelihood_equals_a_numpy_search_over_the_same_latents(
    reduction: Literal["max", "mean", "max-sum"],
) -> None:
    judge, world = Judge(), PointMass()
    assert isinstance(judge, protocols.Judging)
    search = HVF(
        mpc=SMALL, samples=24, elites=5, iterations=6, reduction=reduction,
        segment_cost="likelihood",
    )  # fmt: skip
    result = search.search(world, judge, START, GOAL, seed=3)
    *asked, (scene, drawn) = judge.calls
    np.testing.assert_array_equal(scene, START)
    np.testing.assert_array_equal(drawn, result.latents[None])
    best = np.inf
    for iteration, (latents, segments) in enumerate(asked):
        costs = REDUCTIONS[reduction](segments).astype("f4")
        order = np.argsort(costs, kind="stable")[:5]
        assert result.history["best"][iteration] == pytest.approx(costs[order[0]], rel=1e-6)
        _, std = refit(latents.reshape(24, 4)[order])
        assert result.history["max_std"][iteration] == pytest.approx(std.max())
        if costs[order[0]] < best:
            best, expected = costs[order[0]], latents[order[0]]
    np.testing.assert_array_equal(result.latents, expected)
    assert result.cost == pytest.approx(best, rel=1e-6)
    # The answer alone is planned: three segments, each once an iteration.
    problems = sum(len(actions) for _, _, actions, _ in world.calls)
    assert problems == int(result.plans.iterations.sum())


@pytest.mark.parametrize("reduction", REDUCTIONS)
def test_a_planned_search_costs_what_its_reduction_makes_of_its_segments(
    reduction: Literal["max", "mean", "max-sum"],
) -> None:
    def found(prune: bool) -> hvf_core.SearchResult:
        search = HVF(
            mpc=SMALL, samples=24, elites=5, iterations=3, reduction=reduction, prune=prune
        )
        return search.search(PointMass(), Positions(), START, GOAL, seed=3)

    result, plain = found(True), found(False)
    segments = np.asarray(result.segment_costs)[None]
    assert result.cost == pytest.approx(REDUCTIONS[reduction](segments).item(), rel=1e-6)
    assert (result.history["skipped"].sum() > 0) == (reduction == "max")
    assert result.cost == plain.cost
    np.testing.assert_array_equal(result.latents, plain.latents)
    np.testing.assert_array_equal(result.segment_costs, plain.segment_costs)


def test_a_search_by_likelihood_needs_a_generator_that_knows() -> None:
    search = HVF(mpc=SMALL, segment_cost="likelihood")
    with pytest.raises(TypeError, match=r"^generator: segment_cost='likelihood' needs one with"):
        search.search(PointMass(), Positions(), START, GOAL)
    judge = Judge()
    judge.segment_costs = lambda *_: np.zeros((3, 4))  # type: ignore[method-assign]
    said = r"segment_costs must return float32 costs \[M, K \+ 1\] = \[200, 3\], got"
    with pytest.raises(ValueError, match=said):
        search.search(PointMass(), judge, START, GOAL)


class Proposing(Judge):
    """Proposes what it is told to."""

    def __init__(self, answer: Any) -> None:
        super().__init__()
        self.answer = answer
        self.asked: list[tuple[Floats, Floats, int]] = []

    def proposals(self, start: Floats, goal: Floats, subgoals: int) -> Any:
        self.asked.append((start, goal, subgoals))
        return self.answer


@pytest.mark.parametrize("cost", ["planned", "likelihood"])
def test_a_search_begins_at_the_proposals_of_its_generator(
    cost: Literal["planned", "likelihood"],
) -> None:
    search = HVF(mpc=SMALL, samples=24, elites=5, iterations=2, segment_cost=cost)
    mean = np.array([[0.25, -0.5], [1.0, 2.0]], np.float32)
    std = np.array([[0.5, 0.25], [2.0, 0.125]], np.float32)
    for answer in [(mean, std), (torch.tensor(mean, requires_grad=True), std.tolist())]:
        proposing = Proposing(answer)
        assert isinstance(proposing, protocols.Proposing)
        search.search(PointMass(), proposing, START, GOAL, seed=3)
        prior = Proposing(None)
        search.search(PointMass(), prior, START, GOAL, seed=3)
        which = 1 if cost == "planned" else 0
        first, drawn = (each.calls[0][which] for each in (prior, proposing))
        np.testing.assert_allclose(
            drawn.reshape(24, 2, 2), mean + std * first.reshape(24, 2, 2), rtol=1e-6
        )
        ((start, goal, subgoals),) = proposing.asked
        np.testing.assert_array_equal(start, START)
        np.testing.assert_array_equal(goal, GOAL)
        assert subgoals == 2


def test_a_generator_that_proposes_nothing_or_the_prior_is_searched_from_the_prior() -> None:
    search = HVF(mpc=SMALL, samples=24, elites=5, iterations=3, segment_cost="likelihood")
    expected = search.search(PointMass(), Judge(), START, GOAL, seed=3)
    for answer in (None, (np.zeros((2, 2)), np.ones((2, 2)))):
        same(expected, search.search(PointMass(), Proposing(answer), START, GOAL, seed=3))
    judge = Judge()
    judge.proposals = None  # type: ignore[attr-defined]
    same(expected, search.search(PointMass(), judge, START, GOAL, seed=3))


@pytest.mark.parametrize(
    ("answer", "kind", "said"),
    [
        (3, TypeError, r"^generator: proposals must return None or a tuple \(mean, std\), got"),
        ((np.zeros((2, 2)),) * 3, TypeError, r"^generator: proposals must return None or a tuple"),
        ((np.zeros((3, 2)), np.ones((2, 2))), ValueError, r"latents \[K, L\] = \[2, 2\], got"),
        ((np.zeros((2, 2)), "wide"), ValueError, r"latents \[K, L\] = \[2, 2\], got"),
        ((np.full((2, 2), np.nan), np.ones((2, 2))), ValueError, "mean must be finite, got NaN"),
        ((np.zeros((2, 2)), -np.ones((2, 2))), ValueError, "std must be finite and not negative"),
    ],
)
def test_proposals_that_are_none_are_one_clear_error(
    answer: Any, kind: type[Exception], said: str
) -> None:
    search = HVF(mpc=SMALL, samples=24, elites=5, segment_cost="likelihood")
    with pytest.raises(kind, match=said):
        search.search(PointMass(), Proposing(answer), START, GOAL)


def same(a: hvf_core.SearchResult, b: hvf_core.SearchResult) -> None:
    np.testing.assert_array_equal(a.latents, b.latents)
    np.testing.assert_array_equal(a.segment_costs, b.segment_costs)
    np.testing.assert_array_equal(a.plans.actions, b.plans.actions)
    for name in ["best", "elite_mean", "elite_worst", "max_std"]:
        np.testing.assert_array_equal(a.history[name], b.history[name])


@settings(max_examples=10, deadline=None)
@given(
    seed=st.integers(0, 2**64 - 1),
    prune=st.booleans(),
    share=st.booleans(),
    keep=st.integers(0, 5),
    most=st.integers(1, 2000),
)
def test_savings_and_call_sizes_change_nothing(
    seed: int, prune: bool, share: bool, keep: int, most: int
) -> None:
    options: dict[str, Any] = {
        "mpc": SMALL,
        "samples": 24,
        "elites": 5,
        "iterations": 2,
        "keep_elites": keep,
    }
    plain = HVF(**options, prune=False, share_rollouts=False)
    world = SharingPointMass()
    world.max_candidates = most  # type: ignore[attr-defined]
    found = HVF(**options, prune=prune, share_rollouts=share)
    same(
        found.search(world, Positions(), START, GOAL, seed),
        plain.search(PointMass(), Positions(), START, GOAL, seed),
    )


def test_batches_equal_one_by_one() -> None:
    rng = np.random.default_rng(0)
    starts = rng.normal(size=(7, 2)).astype(np.float32)
    goals = rng.normal(size=(7, 2)).astype(np.float32)
    seeds = [5, 1, 2**64 - 1, 0, 5, 9, 3]
    plans = SMALL.plan_batch(PointMass(), starts, goals, seeds)
    assert len(plans) == 7
    assert plans.actions.shape == (7, 3, 2)
    for b, plan in enumerate(plans):
        alone = SMALL.plan(PointMass(), starts[b : b + 1], goals[b : b + 1], seeds[b])
        np.testing.assert_array_equal(alone.actions, plan.actions)
        np.testing.assert_array_equal(alone.actions, plans.actions[b])
        assert alone.cost == plans.costs[b]
        np.testing.assert_array_equal(
            alone.history["best"], plans.history["best"][b, : alone.iterations]
        )
    np.testing.assert_array_equal(
        SMALL.plan_batch(PointMass(), starts, goals, 4).actions[3],
        SMALL.plan(PointMass(), starts[3:4], goals[3:4], 4).actions,
    )
    results = SMALL_SEARCH.search_batch(PointMass(), Positions(), starts[:2], goals[:2], [8, 9])
    same(results[1], SMALL_SEARCH.search(PointMass(), Positions(), starts[1:2], goals[1:2], 9))


def test_one_start_serves_all_goals_and_shares_rollouts() -> None:
    goals = np.random.default_rng(0).normal(size=(7, 2)).astype(np.float32)
    starts = np.repeat(START, 7, axis=0)
    sharing = SMALL.plan_batch(SharingPointMass(), START, goals)
    np.testing.assert_array_equal(
        sharing.actions, SMALL.plan_batch(PointMass(), starts, goals).actions
    )


def test_no_subgoals_is_the_plan_and_needs_no_generator() -> None:
    found = HVF(mpc=SMALL, subgoals=0).search(PointMass(), None, START, GOAL, seed=2)
    plan = SMALL.plan(PointMass(), START, GOAL, seed=2)
    np.testing.assert_array_equal(found.plans[0].actions, plan.actions)
    assert found.cost == plan.cost
    assert len(found.subgoals) == 0


def test_actions_are_handed_over_without_a_copy() -> None:
    """The model may keep the array and write to it: the planner draws its elites again."""

    class Vandal(PointMass):
        def rollout_costs(self, starts: Floats, goals: Floats, actions: Floats) -> Any:
            assert actions.flags.c_contiguous
            assert actions.flags.writeable
            assert actions.dtype == np.float32
            assert not isinstance(actions.base, np.ndarray)
            shared = torch.from_numpy(actions)
            assert shared.data_ptr() == actions.ctypes.data
            costs = super().rollout_costs(starts, goals, actions)
            kept.append((actions, actions.copy()))
            return costs

    kept: list[tuple[Floats, Floats]] = []
    expected = SMALL.plan(PointMass(), START, GOAL)
    plan = SMALL.plan(Vandal(), START, GOAL)
    np.testing.assert_array_equal(plan.actions, expected.actions)
    for actions, when_seen in kept:
        np.testing.assert_array_equal(actions, when_seen)

    class Overwriting(PointMass):
        def rollout_costs(self, starts: Floats, goals: Floats, actions: Floats) -> Any:
            costs = super().rollout_costs(starts, goals, actions.copy())
            actions[:] = np.nan
            return costs

    np.testing.assert_array_equal(SMALL.plan(Overwriting(), START, GOAL).actions, expected.actions)


@pytest.mark.parametrize(
    "convert",
    [
        torch.from_numpy,
        lambda costs: costs.astype(np.float64),
        lambda costs: np.asfortranarray(costs),
        lambda costs: costs.tolist(),
        lambda costs: np.repeat(costs, 2, axis=1)[:, ::2],
    ],
    ids=["torch", "float64", "fortran", "lists", "strided"],
)
def test_costs_may_be_anything_that_asarray_takes(convert: Any) -> None:
    class Converting(PointMass):
        def rollout_costs(self, starts: Floats, goals: Floats, actions: Floats) -> Any:
            return convert(super().rollout_costs(starts, goals, actions))

    plan = SMALL.plan(Converting(), START, GOAL)
    np.testing.assert_array_equal(plan.actions, SMALL.plan(PointMass(), START, GOAL).actions)


def test_frames_may_be_tensors() -> None:
    class Torch(PointMass):
        def rollout_costs(self, starts: Any, goals: Any, actions: Floats) -> Any:
            assert isinstance(starts, torch.Tensor)
            assert isinstance(goals, torch.Tensor)
            return super().rollout_costs(starts.numpy(), goals.numpy(), actions)

    class TorchPositions(Positions):
        def decode(self, scene: Any, latents: Floats) -> Any:
            return torch.from_numpy(super().decode(scene.numpy(), latents))

    start, goal = torch.from_numpy(START), torch.from_numpy(GOAL)
    found = SMALL_SEARCH.search(Torch(), TorchPositions(), start, goal)
    assert isinstance(found.subgoals, torch.Tensor)
    same(found, SMALL_SEARCH.search(PointMass(), Positions(), START, GOAL))


def test_images_are_observed() -> None:
    class Seeing(PointMass):
        def observe(self, images: NDArray[np.uint8]) -> Floats:
            assert images.ndim == 4
            seen.append(len(images))
            return images[:, 0, 0, :2].astype(np.float32)

    class Drawing(Positions):
        def decode(self, scene: Floats, latents: Floats) -> Any:
            assert scene.dtype == np.float32
            images = np.zeros((latents.shape[0] * latents.shape[1], 4, 4, 3), np.uint8)
            images[:, 0, 0, :2] = np.clip(2 * latents.reshape(-1, 2), 0, 255).astype(np.uint8)
            return images

    seen: list[int] = []
    start, goal = np.zeros((4, 4, 3), np.uint8), np.full((4, 4, 3), 3, np.uint8)
    plan = SMALL.plan(Seeing(), start, goal)
    expected = SMALL.plan(PointMass(), START, np.full((1, 2), 3, np.float32))
    np.testing.assert_array_equal(plan.actions, expected.actions)
    assert seen == [1, 1]
    found = SMALL_SEARCH.search(Seeing(), Drawing(), start[None], goal[None])
    assert found.subgoals.shape == (2, 2)
    assert 48 in seen


def test_a_warm_start_continues_the_shifted_plan() -> None:
    class Flat(PointMass):
        def rollout_costs(self, starts: Floats, goals: Floats, actions: Floats) -> Any:
            return ((actions - actions.mean(axis=1, keepdims=True)) ** 2).sum(axis=(2, 3))

    mpc = VisualMPC(horizon=3, samples=100, elites=10, iterations=1, warm_start_std=1e-4)
    last = np.array([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]], np.float32)
    plan = mpc.plan(Flat(), START, GOAL, warm_start=last)
    np.testing.assert_allclose(plan.actions, last[[1, 2, 2]], atol=1e-3)
    again = mpc.plan(Flat(), START, GOAL, warm_start=plan)
    np.testing.assert_allclose(again.actions, last[[2, 2, 2]], atol=2e-3)
    many = mpc.plan_batch(Flat(), START, GOAL, warm_start=last[None])
    np.testing.assert_array_equal(many.actions[0], plan.actions)
    np.testing.assert_allclose(
        mpc.plan_batch(Flat(), START, GOAL, warm_start=many).actions[0], last[[2, 2, 2]], atol=2e-3
    )


def test_configurations_can_be_read_compared_copied_and_pickled() -> None:
    mpc = VisualMPC(
        horizon=6,
        samples=50,
        elites=7,
        iterations=2,
        min_variance=0.1,
        action_repeat=3,
        initial_low=[0, -1],
        keep_elites=2,
        warm_start_std=0.3,
    )
    search = HVF(mpc=mpc, subgoals=1, samples=9, elites=3, reduction="mean", prune=False)
    for made in (mpc, search, VisualMPC(initial="normal", initial_std=2.0)):
        assert pickle.loads(pickle.dumps(made)) == made
        assert copy.deepcopy(made) == made
        assert eval(repr(made), {"VisualMPC": VisualMPC, "HVF": HVF}) == made
    assert mpc != VisualMPC()
    assert (mpc.horizon, mpc.action_repeat, mpc.initial_low) == (6, 3, [0.0, -1.0])
    assert (search.mpc, search.reduction, search.prune) == (mpc, "mean", False)
    with pytest.raises(AttributeError):
        mpc.horizon = 3  # type: ignore[misc]


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"horizon": 0}, ValueError),
        ({"horizon": -1}, ValueError),
        ({"horizon": 2.5}, TypeError),
        ({"samples": 0}, ValueError),
        ({"samples": 2**70}, ValueError),
        ({"elites": 201}, ValueError),
        ({"elites": 0}, ValueError),
        ({"iterations": 0}, ValueError),
        ({"min_variance": float("nan")}, ValueError),
        ({"min_variance": -1.0}, ValueError),
        ({"action_repeat": 2}, ValueError),
        ({"initial": "gaussian"}, ValueError),
        ({"initial_std": 0.0, "initial": "normal"}, ValueError),
        ({"initial_low": [0.0, 0.0], "initial": "normal"}, ValueError),
        ({"initial_low": "left"}, TypeError),
        ({"keep_elites": 41}, ValueError),
        ({"warm_start_std": float("inf")}, ValueError),
    ],
)
def test_settings_out_of_range_are_named(options: dict[str, Any], error: type[Exception]) -> None:
    with pytest.raises(error, match=next(iter(options))):
        VisualMPC(**options)


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"mpc": 3}, TypeError),
        ({"subgoals": -1}, ValueError),
        ({"samples": 0}, ValueError),
        ({"elites": 500}, ValueError),
        ({"reduction": "min"}, ValueError),
        ({"segment_cost": "guessed"}, ValueError),
        ({"keep_elites": -5}, ValueError),
    ],
)
def test_search_settings_out_of_range_are_named(
    options: dict[str, Any], error: type[Exception]
) -> None:
    with pytest.raises(error, match=next(iter(options))):
        HVF(**options)


@settings(max_examples=100, deadline=None)
@given(
    horizon=st.integers(-(2**80), 2**80),
    samples=st.integers(-3, 2**66),
    elites=st.integers(-3, 300),
    iterations=st.integers(-3, 2**40),
    repeat=st.integers(-3, 8),
    variance=st.floats(),
)
def test_any_numbers_give_a_planner_or_a_value_error(
    horizon: int, samples: int, elites: int, iterations: int, repeat: int, variance: float
) -> None:
    named = None
    try:
        VisualMPC(
            horizon=horizon,
            samples=samples,
            elites=elites,
            iterations=iterations,
            action_repeat=repeat,
            min_variance=variance,
        )
    except ValueError as error:
        named = str(error).split(":")[0]
    fields = ["horizon", "samples", "elites", "iterations", "action_repeat", "min_variance"]
    assert named in [None, *fields]


def answering(costs: Any) -> PointMass:
    class Answering(PointMass):
        def rollout_costs(self, starts: Floats, goals: Floats, actions: Floats) -> Any:
            return costs(super().rollout_costs(starts, goals, actions))

    return Answering()


@pytest.mark.parametrize(
    "costs",
    [
        lambda costs: costs[0],
        lambda costs: costs.T,
        lambda costs: costs[:, :-1],
        lambda costs: costs[..., None],
        lambda costs: 3.0,
        lambda costs: None,
        lambda costs: "costs",
        lambda costs: costs.astype(np.complex64),
    ],
)
def test_wrong_costs_name_the_model_the_method_and_the_shape(costs: Any) -> None:
    with pytest.raises(ValueError, match=r"model Answering: rollout_costs must.*\[1, 30\], got"):
        SMALL.plan(answering(costs), START, GOAL)


def test_costs_of_nan_only_are_an_error_and_single_ones_rank_last() -> None:
    def some(costs: Floats) -> Floats:
        costs[:, ::2] = np.nan
        return costs

    plan = SMALL.plan(answering(some), START, GOAL)
    assert np.isfinite(plan.cost)
    with pytest.raises(ValueError, match=r"model Answering: .*rollout_costs for problem 0 is NaN"):
        SMALL.plan(answering(lambda costs: np.full_like(costs, np.nan)), START, GOAL)


def test_wrong_frames_are_named() -> None:
    two = np.zeros((2, 2), np.float32)
    with pytest.raises(ValueError, match="start: must be one"):
        SMALL.plan(PointMass(), two, GOAL)
    with pytest.raises(ValueError, match="goal: must be one"):
        SMALL.plan(PointMass(), START, two)
    with pytest.raises(TypeError, match="start: expected frames"):
        SMALL.plan(PointMass(), 5, GOAL)
    with pytest.raises(ValueError, match="starts: must hold"):
        SMALL.plan_batch(PointMass(), two, np.zeros((3, 2), np.float32))
    with pytest.raises(ValueError, match="goals: must hold"):
        SMALL.plan_batch(PointMass(), two, two[:0])
    with pytest.raises(ValueError, match="starts: must hold"):
        SMALL_SEARCH.search_batch(PointMass(), Positions(), two, np.zeros((3, 2), np.float32))

    class OneFrameShort:
        def __len__(self) -> int:
            return 2

        def __getitem__(self, index: Any) -> Any:
            return two[:1]

    one_at_a_time = PointMass()
    one_at_a_time.max_candidates = 1  # type: ignore[attr-defined]
    frames = OneFrameShort()
    SMALL.plan_batch(one_at_a_time, frames, frames)
    with pytest.raises(ValueError, match=r"frames\[index\] must hold"):
        SMALL_SEARCH.search(PointMass(), Positions(), START, frames_after(frames))


def frames_after(frames: Any) -> Any:
    """One frame, but indexing it gives one frame whatever the index."""

    class One:
        def __len__(self) -> int:
            return 1

        def __getitem__(self, index: Any) -> Any:
            return frames[index]

    return One()


@pytest.mark.parametrize("seed", [-1, 2**64])
def test_seeds_out_of_range_are_refused(seed: int) -> None:
    with pytest.raises(ValueError, match="seed"):
        SMALL.plan(PointMass(), START, GOAL, seed=seed)
    with pytest.raises(ValueError, match="seeds"):
        SMALL.plan_batch(PointMass(), START, GOAL, seeds=[seed])


class Many(Positions):
    latent_dim = 5


def test_other_arguments_that_do_not_fit_are_named() -> None:
    world = PointMass()
    with pytest.raises(TypeError, match="seed"):
        SMALL.plan(world, START, GOAL, seed=1.5)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="seeds: must be as many"):
        SMALL.plan_batch(world, START, GOAL, seeds=[1, 2])
    with pytest.raises(TypeError, match="seeds"):
        SMALL.plan_batch(world, START, GOAL, seeds="one")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="warm_start"):
        SMALL.plan(world, START, GOAL, warm_start=np.zeros((4, 2)))
    with pytest.raises(ValueError, match="warm_start"):
        SMALL.plan(world, START, GOAL, warm_start=np.full((3, 2), np.nan))
    with pytest.raises(TypeError, match="warm_start"):
        SMALL.plan(world, START, GOAL, warm_start="last")
    with pytest.raises(ValueError, match="samples"):
        VisualMPC(samples=2**28).plan(world, START, GOAL)
    with pytest.raises(ValueError, match="horizon"):
        VisualMPC(horizon=2**40).plan(world, START, GOAL)
    with pytest.raises(ValueError, match="subgoals"):
        HVF(subgoals=2**16)
    many = HVF(mpc=SMALL, subgoals=2**16 - 1)
    with pytest.raises(ValueError, match="subgoals"):
        many.search(world, Many(), START, GOAL)
    with pytest.raises(ValueError, match="initial_low"):
        VisualMPC(initial_low=[0.0, 0.0, 0.0]).plan(world, START, GOAL)
    with pytest.raises(ValueError, match="initial_low"):
        VisualMPC(initial_low=[-2.0, 0.0]).plan(world, START, GOAL)


def test_models_that_lack_something_are_named() -> None:
    class NoActions:
        def rollout_costs(self, starts: Any, goals: Any, actions: Any) -> Any: ...

    with pytest.raises(TypeError, match=r"model: must have .*NoActions has no action_low"):
        SMALL.plan(NoActions(), START, GOAL)
    with pytest.raises(TypeError, match="model: must have"):
        SMALL.plan(None, START, GOAL)
    world = PointMass()
    world.action_low = np.array([2.0, -1.0], np.float32)
    with pytest.raises(ValueError, match="action_low"):
        SMALL.plan(world, START, GOAL)
    world.action_low = np.zeros((2, 2), np.float32)
    with pytest.raises(ValueError, match="action_low"):
        SMALL.plan(world, START, GOAL)
    with pytest.raises(TypeError, match="generator: must have latent_dim"):
        SMALL_SEARCH.search(PointMass(), None, START, GOAL)

    class Short(Positions):
        def decode(self, scene: Floats, latents: Floats) -> Floats:
            return super().decode(scene, latents)[1:]

    with pytest.raises(ValueError, match=r"decode must give 48 frames, got 47"):
        SMALL_SEARCH.search(PointMass(), Short(), START, GOAL)
    empty = Positions()
    empty.latent_dim = 0
    with pytest.raises(ValueError, match="latent_dim"):
        SMALL_SEARCH.search(PointMass(), empty, START, GOAL)


class OutOfMemoryLaterError(Exception):
    pass


def test_exceptions_of_the_models_come_back_unchanged() -> None:
    raised = OutOfMemoryLaterError("at the third call")

    class Failing(PointMass):
        def rollout_costs(self, starts: Floats, goals: Floats, actions: Floats) -> Any:
            if len(self.calls) == 2:
                raise raised
            return super().rollout_costs(starts, goals, actions)

    class FailingPositions(Positions):
        def decode(self, scene: Floats, latents: Floats) -> Floats:
            raise raised

    class FailingSharer(PointMass):
        def shared_rollout_costs(self, *_: Any) -> Any:
            raise raised

    with pytest.raises(OutOfMemoryLaterError) as caught:
        SMALL.plan(Failing(), START, GOAL)
    assert caught.value is raised
    assert any(entry.name == "rollout_costs" for entry in caught.traceback)
    with pytest.raises(OutOfMemoryLaterError):
        SMALL_SEARCH.search(PointMass(), FailingPositions(), START, GOAL)
    with pytest.raises(OutOfMemoryLaterError):
        SMALL_SEARCH.search(FailingSharer(), Positions(), START, GOAL)


def test_the_gil_is_free_while_the_planner_works() -> None:
    """Another thread goes on between the end of one callback and the start of the next."""
    ticks = 0
    stop = threading.Event()

    def tick() -> None:
        nonlocal ticks
        while not stop.is_set():
            ticks += 1
            time.sleep(0)  # gives the GIL back each time: nobody has to force it

    class Watching(PointMass):
        def rollout_costs(self, starts: Floats, goals: Floats, actions: Floats) -> Any:
            progress.append(ticks - self.ticks_before)
            costs = np.zeros(actions.shape[:2], np.float32)
            self.ticks_before = ticks
            return costs

    progress: list[int] = []
    world = Watching()
    frames = np.zeros((300, 2), np.float32)
    thread = threading.Thread(target=tick, daemon=True)
    interval = sys.getswitchinterval()
    # Nobody is forced to give the GIL up: the other thread runs only where the planner lets it.
    sys.setswitchinterval(1000.0)
    thread.start()
    try:
        for _ in range(200):
            world.ticks_before = ticks
            VisualMPC(horizon=10, min_variance=0.0).plan_batch(world, frames, frames)
            if any(ticked > 0 for ticked in progress):
                break
    finally:
        stop.set()
        sys.setswitchinterval(interval)
        thread.join()
    assert any(ticked > 0 for ticked in progress)


DETERMINISM = """
import hashlib, sys, numpy as np
sys.path.insert(0, {path!r})
from test_planner import *
digest = hashlib.sha256()
goals = np.random.default_rng(0).normal(size=(90, 2)).astype(np.float32)
plans = VisualMPC().plan_batch(PointMass(), goals[::-1].copy(), goals, list(range(90)))
digest.update(plans.actions.tobytes() + plans.costs.tobytes())
found = HVF(mpc=SMALL, samples=60, elites=10).search(SharingPointMass(), Positions(), START, GOAL)
digest.update(found.latents.tobytes() + found.plans.actions.tobytes())
print(digest.hexdigest())
"""


def test_same_seed_same_plan_on_any_thread_count(
    outputs_by_threads: Callable[[str], set[str]],
) -> None:
    assert len(outputs_by_threads(DETERMINISM.format(path=os.path.dirname(__file__)))) == 1


INTERRUPTED = """
import sys, time
sys.path.insert(0, {path!r})
from test_planner import *

class Slow(PointMass):
    def rollout_costs(self, starts, goals, actions):
        if not self.calls:
            print("planning", flush=True)
        return super().rollout_costs(starts, goals, actions)

try:
    while True:
        HVF(mpc=VisualMPC(samples=100), samples=200).search(Slow(), Positions(), START, GOAL)
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""


def test_ctrl_c_stops_a_search(interrupted_output: Callable[[str], str]) -> None:
    program = INTERRUPTED.format(path=os.path.dirname(__file__))
    assert interrupted_output(program).endswith("interrupted\n")
