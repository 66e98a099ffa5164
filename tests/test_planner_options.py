"""Options of the planners that the authors' released code needs; planners as values."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import hvf_core
from hvf_core import HVF, VisualMPC
from test_planner import GOAL, SMALL, START, PointMass, Positions


class Wide(PointMass):
    """The same world with a box that nothing leaves."""

    action_low = np.full(2, -1e3, np.float32)
    action_high = np.full(2, 1e3, np.float32)


@pytest.mark.parametrize("warm", [False, True])
@pytest.mark.parametrize(
    ("initial", "wide"),
    [
        ({}, {"initial_low": [-1.0, -1.0], "initial_high": [1.0, 1.0]}),
        ({"initial": "normal", "initial_std": 3.0}, {"initial": "normal", "initial_std": 3.0}),
    ],
    ids=["uniform", "normal"],
)
def test_without_clipping_plans_are_those_of_a_wide_box(
    initial: dict[str, Any], wide: dict[str, Any], warm: bool
) -> None:
    last = np.array([[0.0, 4.0], [0.5, -3.0], [2.0, 0.0]], np.float32) if warm else None
    size: dict[str, Any] = {"horizon": 3, "samples": 50, "elites": 8, "min_variance": 0.0}
    world = PointMass()
    free = VisualMPC(**size, **initial, clip=False)
    plan = free.plan(world, START, 2 * GOAL, seed=1, warm_start=last)
    expected = VisualMPC(**size, **wide).plan(Wide(), START, 2 * GOAL, seed=1, warm_start=last)
    np.testing.assert_array_equal(plan.actions, expected.actions)
    assert plan.cost == expected.cost
    first = np.abs(world.calls[0][2]).max()
    assert (first <= 1) == (initial == {} and not warm)
    assert np.abs(world.calls[1][2]).max() > 1
    clipped = PointMass()
    VisualMPC(**size, **initial).plan(clipped, START, 2 * GOAL, seed=1, warm_start=last)
    assert max(np.abs(call[2]).max() for call in clipped.calls) <= 1


def test_the_maze_clips_actions_beyond_the_box() -> None:
    states, targets = hvf_core.maze_episodes(0, 0, 8, "medium")
    goals = states.copy()
    goals[:, :2] = targets
    starts = hvf_core.MazeFrames(states)
    world = hvf_core.MazeWorld()
    actions = np.random.default_rng(0).uniform(-9, 9, (8, 30, 4, 2)).astype(np.float32)
    np.testing.assert_array_equal(
        world.rollout_costs(starts, hvf_core.MazeFrames(goals), actions),
        world.rollout_costs(starts, hvf_core.MazeFrames(goals), actions.clip(-3, 3)),
    )
    mpc = VisualMPC(samples=60, elites=10, initial="normal", initial_std=4.0, clip=False)
    plan = mpc.plan(world, starts[0], hvf_core.MazeFrames(goals[:1]))
    assert np.abs(plan.actions).max() > 3


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**64 - 1), keep=st.integers(0, 3), variance=st.sampled_from([0, 0.1]))
def test_the_answer_may_be_of_the_last_iteration(seed: int, keep: int, variance: float) -> None:
    size: dict[str, Any] = {
        "horizon": 3,
        "samples": 12,
        "elites": 4,
        "keep_elites": keep,
        "min_variance": variance,
    }
    world = PointMass()
    last = VisualMPC(**size, best="last").plan(world, START, GOAL / 4, seed)
    over_all = VisualMPC(**size).plan(PointMass(), START, GOAL / 4, seed)
    for name, figures in last.history.items():
        np.testing.assert_array_equal(figures, over_all.history[name])
    assert last.cost == last.history["best"][-1]
    assert over_all.cost == over_all.history["best"].min()
    if keep:  # the best of all is among those kept
        np.testing.assert_array_equal(last.actions, over_all.actions)
    else:
        _, _, actions, costs = world.calls[-1]
        assert last.cost == costs.min()
        np.testing.assert_array_equal(last.actions, actions[0, costs[0].argmin()])


def test_the_best_of_the_last_iteration_of_a_search_is_one_sample() -> None:
    # So near that the first samples are as good as later ones.
    near = GOAL / 4
    earlier_was_better = 0
    for seed in range(8):
        options: dict[str, Any] = {
            "mpc": SMALL,
            "subgoals": 2,
            "samples": 24,
            "elites": 5,
            "iterations": 3,
            "min_variance": 0.0,
        }
        world, generator = PointMass(), Positions()
        plain = HVF(**options, best="last", prune=False, share_rollouts=False)
        found = plain.search(world, generator, START, near, seed)
        # Three iterations, all segments of all samples in a call; the last three calls are the
        # last iteration's.
        calls = world.calls[-3:]
        segments = np.minimum.reduce([call[3].min(axis=1) for call in calls]).reshape(24, 3).T
        costs = segments.max(axis=0)
        best = costs.argmin()
        assert found.cost == costs[best]
        np.testing.assert_array_equal(found.segment_costs, segments[:, best])
        np.testing.assert_array_equal(found.latents, generator.calls[-1][1][best])
        np.testing.assert_array_equal(found.subgoals, 2 * found.latents)
        way = np.concatenate([START, found.subgoals, near])
        for k, plan in enumerate(found.plans):
            end = way[k] + plan.actions.sum(axis=0)
            assert plan.cost == pytest.approx(((end - way[k + 1]) ** 2).sum(), rel=1e-4)
        saving = HVF(**options, best="last").search(PointMass(), Positions(), START, near, seed)
        np.testing.assert_array_equal(saving.latents, found.latents)
        np.testing.assert_array_equal(saving.plans.actions, found.plans.actions)
        over_all = HVF(**options).search(PointMass(), Positions(), START, near, seed)
        earlier_was_better += over_all.cost < found.cost
    assert earlier_was_better > 0


@pytest.mark.parametrize("planner", [VisualMPC, HVF])
@pytest.mark.parametrize(
    ("options", "error"),
    [({"best": "first"}, ValueError), ({"best": None}, TypeError)],
)
def test_where_the_answer_comes_from_is_checked(
    planner: Any, options: dict[str, Any], error: type[Exception]
) -> None:
    with pytest.raises(error, match="best"):
        planner(**options)


def test_clipping_is_yes_or_no() -> None:
    with pytest.raises(TypeError, match="clip"):
        VisualMPC(clip="no")  # type: ignore[arg-type]


numbers = st.sampled_from([0.0, -0.0, 0.25])
controllers = st.one_of(
    st.builds(
        VisualMPC,
        horizon=st.integers(1, 2),
        keep_elites=st.integers(0, 1),
        min_variance=numbers,
        initial_low=st.one_of(st.none(), st.lists(numbers, min_size=1, max_size=2)),
        clip=st.booleans(),
        best=st.sampled_from(["all", "last"]),
        momentum=numbers,
        temperature=st.sampled_from([None, 0.5]),
        min_std=numbers,
        noise_beta=numbers,
        shift_elites=st.integers(0, 1),
    ),
    st.builds(VisualMPC, initial=st.just("normal"), initial_mean=numbers),
)
planners = st.one_of(
    controllers,
    st.builds(
        HVF,
        mpc=controllers,
        subgoals=st.integers(0, 1),
        reduction=st.sampled_from(["max", "mean", "max-sum"]),
        prune=st.booleans(),
        covariance=st.sampled_from(["diagonal", "full"]),
        shrinkage=st.sampled_from([0.1, 0.25]),
        samples_decay=st.sampled_from([1.0, 2.0]),
        best=st.sampled_from(["all", "last"]),
    ),
)


@settings(max_examples=300, deadline=None)
@given(a=planners, b=planners)
def test_equal_planners_have_equal_hashes_and_survive_copies(a: Any, b: Any) -> None:
    if a == b:
        assert hash(a) == hash(b)
    for again in (copy.deepcopy(a), pickle.loads(pickle.dumps(a)), eval(repr(a))):
        assert again == a
        assert hash(again) == hash(a)
    assert {a: 1}[a] == 1


BUDGET_OPTIONS: list[dict[str, Any]] = [
    {"momentum": 0.5},
    {"samples_decay": 1.25},
    {"temperature": 0.5},
    {"min_std": 0.5},
    {"covariance": "full"},
    {"covariance": "full", "shrinkage": 0.5},
]


def test_every_option_is_part_of_the_hash() -> None:
    options: list[dict[str, Any]] = [
        {"horizon": 6},
        {"samples": 201},
        {"elites": 39},
        {"iterations": 4},
        {"min_variance": 0.5},
        {"action_repeat": 5},
        {"initial": "normal"},
        {"initial_low": [0.0]},
        {"initial_high": [0.0]},
        {"keep_elites": 1},
        {"warm_start_std": 2.0},
        {"clip": False},
        {"best": "last"},
        {"noise_beta": 2.0},
        {"shift_elites": 1},
        *BUDGET_OPTIONS,
    ]
    made: list[Any] = [VisualMPC(), *(VisualMPC(**option) for option in options)]
    made += [HVF(mpc=mpc) for mpc in made]
    made += [HVF(subgoals=1), HVF(prune=False), HVF(share_rollouts=False)]
    made += [HVF(reduction="mean"), HVF(reduction="max-sum"), HVF(best="last")]
    made += [HVF(samples=201), HVF(segment_cost="likelihood")]
    made += [HVF(**option) for option in BUDGET_OPTIONS]
    assert len(set(made)) == len({hash(planner) for planner in made}) == len(made)
    assert VisualMPC(min_variance=0.0) == VisualMPC(min_variance=-0.0)
    assert hash(VisualMPC(min_variance=0.0)) == hash(VisualMPC(min_variance=-0.0))


def test_plans_can_be_iterated() -> None:
    goals = np.random.default_rng(0).normal(size=(4, 2)).astype(np.float32)
    plans = SMALL.plan_batch(PointMass(), START, goals)
    listed = list(plans)
    assert [plan.cost for plan in listed] == list(plans.costs)
    np.testing.assert_array_equal([plan.actions for plan in listed], plans.actions)
