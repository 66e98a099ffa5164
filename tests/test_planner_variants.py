"""Variants of the cross-entropy method, and what a search tells while it works."""

from __future__ import annotations

import itertools
import os
import signal
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hvf.agents.planning import PlanningAgent
from hvf.agents.subgoals import no_subgoals
from hvf.cli.arguments import evaluating
from hvf.cli.plan import Plan
from hvf.evaluation.acting import act
from hvf.registry import DOMAINS
from hvf.settings import Acting, Planning, Replanning
from hvf_core import HVF, SearchResult, VisualMPC
from line import Line
from test_agents import MPC, latent_world
from test_planner import GOAL, SMALL, SMALL_SEARCH, START, PointMass, Positions

Floats = NDArray[np.float64]

OPTIONS: dict[str, Any] = {
    "momentum": st.floats(0, 0.9),
    "samples_decay": st.floats(1, 3),
    "temperature": st.none() | st.floats(0.01, 100),
    "min_std": st.floats(0, 1),
}
OVER_TIME: dict[str, Any] = {"noise_beta": st.floats(0, 4), "keep_elites": st.integers(0, 5)}
NEAR = np.array([[1.5, -0.5]], np.float32)


def plan(mpc: VisualMPC, **options: Any) -> tuple[Any, list[Any]]:
    world = PointMass()
    return mpc.plan(world, START, NEAR, seed=3, **options), world.calls


@settings(max_examples=60, deadline=None)
@given(options=st.fixed_dictionaries({**OPTIONS, **OVER_TIME}))
def test_a_plan_equals_a_numpy_cem_over_the_candidates_the_model_saw(
    options: dict[str, Any],
) -> None:
    mpc = VisualMPC(horizon=3, samples=40, elites=8, iterations=4, min_variance=0, **options)
    found, calls = plan(mpc)
    # The first distribution is uniform in [-1, 1].
    mean, std = np.zeros(6), np.full(6, 1 / np.sqrt(3))
    kept, kept_costs, best = np.empty((0, 6)), np.empty(0), []
    for iteration, (_, _, actions, costs) in enumerate(calls):
        count = 40.0
        for _ in range(iteration):
            count /= options["samples_decay"]
        assert actions.shape[1] == int(max(count, 16))
        pool = np.concatenate([kept, actions[0].reshape(-1, 6)])
        pool_costs = np.concatenate([kept_costs, costs[0]])
        order = np.argsort(pool_costs, kind="stable")[:8]
        elites, elite_costs = pool[order], pool_costs[order]
        weights = np.ones(8)
        if options["temperature"] is not None:
            weights = np.exp(-(elite_costs - elite_costs[0]) / options["temperature"])
        new = np.average(elites, axis=0, weights=weights)
        new_std = np.sqrt(np.average((elites - new) ** 2, axis=0, weights=weights))
        share = options["momentum"]
        mean = share * mean + (1 - share) * new
        std = np.maximum(share * std + (1 - share) * new_std, options["min_std"])
        np.testing.assert_allclose(found.history["max_std"][iteration], std.max(), rtol=1e-4)
        best.append(float(elite_costs[0]))
        kept, kept_costs = elites[: options["keep_elites"]], elite_costs[: options["keep_elites"]]
    assert found.cost == min(best)
    if options["keep_elites"]:
        assert best == sorted(best, reverse=True)


def test_coloured_noise_has_the_spectrum_of_its_exponent() -> None:
    horizon, beta = 8, 2.0
    mpc = VisualMPC(
        horizon=horizon, samples=20_000, iterations=1, initial="normal", clip=False, noise_beta=beta
    )
    _, ((_, _, actions, _),) = plan(mpc)
    power = (np.abs(np.fft.rfft(actions[0], axis=1)) ** 2).mean(axis=(0, 2))
    law = np.maximum(np.fft.rfftfreq(horizon) * horizon, 1) ** -beta
    both = law[np.abs(np.fft.fftfreq(horizon) * horizon).round().astype(int)]
    np.testing.assert_allclose(power / horizon**2, law / both.sum(), rtol=0.05)
    np.testing.assert_allclose(actions[0].std(axis=0), 1, rtol=0.03)


def test_coloured_actions_are_each_uniform_in_the_box() -> None:
    mpc = VisualMPC(horizon=6, samples=20_000, iterations=1, noise_beta=2)
    _, ((_, _, actions, _),) = plan(mpc)
    values = np.sort(actions[0].reshape(-1, 12), axis=0)
    even = np.broadcast_to(np.linspace(-1, 1, len(values))[:, None], values.shape)
    np.testing.assert_allclose(values, even, atol=0.05)
    apart = np.corrcoef(actions[0, :, 2, 0], actions[0, :, 3, 0])[0, 1]
    assert apart > 0.3


class Judge(Positions):
    """Likes subgoals on the way between start and goal; keeps what it said of each sample."""

    def __init__(self) -> None:
        super().__init__()
        self.judged: list[tuple[Floats, Floats]] = []

    def segment_costs(self, start: Any, goal: Any, latents: Any) -> Any:
        samples = len(latents)
        ends = [np.repeat(frame[:, None], samples, axis=0) for frame in (start, goal)]
        way = np.concatenate([ends[0], 2 * latents, ends[1]], axis=1)
        costs = (np.diff(way, axis=1) ** 2).sum(axis=-1)
        self.judged.append((latents.reshape(samples, -1).astype(np.float64), costs.max(axis=1)))
        return costs


@pytest.mark.parametrize("shrinkage", [0.05, 0.5, 1.0])
def test_a_full_covariance_is_numpys_shrunk_one_over_all_latents(shrinkage: float) -> None:
    judge, count = Judge(), 4000
    HVF(
        mpc=SMALL,
        samples=count,
        elites=30,
        iterations=2,
        covariance="full",
        shrinkage=shrinkage,
        segment_cost="likelihood",
    ).search(PointMass(), judge, START, GOAL, seed=1)
    (first, costs), (second, _) = judge.judged
    elites = first[np.argsort(costs, kind="stable")[:30]]
    own = np.corrcoef(elites.T)
    assert np.abs(own - np.eye(4)).max() > 0.3
    expected = (1 - shrinkage) * own + shrinkage * np.eye(4)
    # The standard error of a correlation is below a sixtieth.
    np.testing.assert_allclose(np.corrcoef(second.T), expected, atol=0.07)
    np.testing.assert_allclose(second.std(axis=0), elites.std(axis=0), rtol=0.06)
    np.testing.assert_allclose(second.mean(axis=0), elites.mean(axis=0), atol=0.06)


def test_what_ends_a_search_has_the_best_so_far() -> None:
    full = SMALL_SEARCH.search(PointMass(), Positions(), START, GOAL, seed=5)
    told: list[tuple[int, int, float]] = []

    def until_second(iteration: int, iterations: int, cost: float) -> None:
        told.append((iteration, iterations, cost))
        if iteration == 2:
            raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough") as ended:
        SMALL_SEARCH.search(PointMass(), Positions(), START, GOAL, seed=5, progress=until_second)
    partial = ended.value.partial  # type: ignore[attr-defined]
    assert isinstance(partial, SearchResult)
    best = np.minimum.accumulate(full.history["best"])
    assert told == [(1, 3, best[0]), (2, 3, best[1])]
    assert partial.cost == best[1]
    assert partial.iterations == 2
    np.testing.assert_array_equal(partial.subgoals, 2 * partial.latents)
    assert partial.segment_costs.max() == partial.cost


def test_progress_changes_nothing_and_tells_all_iterations() -> None:
    told: list[tuple[int, int, float]] = []
    with_it = SMALL_SEARCH.search(
        PointMass(), Positions(), START, GOAL, 5, progress=lambda *now: told.append(now)
    )
    without = SMALL_SEARCH.search(PointMass(), Positions(), START, GOAL, 5)
    np.testing.assert_array_equal(with_it.latents, without.latents)
    assert [now[:2] for now in told] == [(1, 3), (2, 3), (3, 3)]
    assert told[-1][2] == without.cost
    none: list[Any] = []
    HVF(mpc=SMALL, subgoals=0).search(
        PointMass(), None, START, GOAL, progress=lambda *now: none.append(now)
    )
    assert none == []
    with pytest.raises(TypeError, match="progress: expected None or progress"):
        SMALL_SEARCH.search(PointMass(), Positions(), START, GOAL, progress=3)  # type: ignore[arg-type]


def test_ctrl_c_leaves_the_best_so_far() -> None:
    class Slow(PointMass):
        """Asks to stop in the second iteration, and takes its time until that is seen."""

        def rollout_costs(self, starts: Any, goals: Any, actions: Any) -> Any:
            if iterations and not self.calls:
                os.kill(os.getpid(), signal.SIGINT)
            return super().rollout_costs(starts, goals, actions)

    iterations: list[int] = []
    world = Slow()

    def first(iteration: int, of: int, cost: float) -> None:
        iterations.append(iteration)
        world.calls.clear()

    with pytest.raises(KeyboardInterrupt) as stopped:
        HVF(mpc=SMALL, subgoals=1, samples=8, elites=2, iterations=10**4, min_variance=0).search(
            world, Positions(), START, GOAL, progress=first
        )
    assert stopped.value.partial.iterations == len(iterations)  # type: ignore[attr-defined]


def test_an_exception_before_the_first_iteration_has_nothing() -> None:
    class Broken(PointMass):
        def rollout_costs(self, starts: Any, goals: Any, actions: Any) -> Any:
            raise LookupError

    with pytest.raises(LookupError) as raised:
        SMALL_SEARCH.search(Broken(), Positions(), START, GOAL)
    assert not hasattr(raised.value, "partial")


def test_a_warm_start_begins_with_the_shifted_elites() -> None:
    mpc = VisualMPC(horizon=4, samples=30, elites=6, iterations=2, shift_elites=3)
    before, calls = plan(mpc)
    last = calls[-1]
    order = np.argsort(last[3][0], kind="stable")[:3]
    np.testing.assert_array_equal(before.elites, last[2][0, order])
    shifted = before.elites[:, [1, 2, 3, 3]]
    for options in (
        {"warm_start": before},
        {"warm_start": before.actions, "warm_elites": before.elites},
    ):
        _, calls = plan(mpc, **options)
        np.testing.assert_array_equal(calls[0][2][0, :3], shifted)
    _, plain = plan(mpc, warm_start=before.actions)
    np.testing.assert_array_equal(calls[0][2][0, 3:], plain[0][2][0, 3:])
    batch = mpc.plan_batch(PointMass(), START, np.concatenate([NEAR, GOAL]), seeds=3)
    assert batch.elites.shape == (2, 3, 4, 2)
    np.testing.assert_array_equal(batch[0].elites, before.elites)
    fewer = VisualMPC(horizon=4, samples=30, elites=6, shift_elites=1)
    _, calls = plan(fewer, warm_start=before)
    np.testing.assert_array_equal(calls[0][2][0, :1], shifted[:1])


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"warm_elites": np.zeros((1, 3, 2))}, ValueError, "warm_elites: belong to a warm_start"),
        ({"warm_elites": np.zeros((2, 3, 2))}, ValueError, "warm_elites: must have shape"),
        ({"warm_elites": np.zeros((1, 4, 2))}, ValueError, "warm_elites: must have shape"),
        ({"warm_elites": np.full((1, 3, 2), np.nan)}, ValueError, "warm_elites: must be finite"),
        ({"warm_elites": "best"}, TypeError, "warm_elites: expected"),
    ],
)
def test_elites_that_do_not_fit_are_named(
    options: dict[str, Any], error: type[Exception], message: str
) -> None:
    mpc = VisualMPC(horizon=3, samples=20, elites=4, shift_elites=1)
    if not message.endswith("warm_start"):
        options = {"warm_start": np.zeros((3, 2), np.float32), **options}
    with pytest.raises(error, match=message):
        plan(mpc, **options)


WRONG = [
    ({"momentum": 1.0}, ValueError),
    ({"momentum": float("nan")}, ValueError),
    ({"samples_decay": 0.5}, ValueError),
    ({"temperature": 0.0}, ValueError),
    ({"temperature": "hot"}, TypeError),
    ({"min_std": -1.0}, ValueError),
    ({"min_std": 1e300}, ValueError),
    ({"covariance": "half"}, ValueError),
    ({"shrinkage": 0.0}, ValueError),
    ({"shrinkage": 2.0, "covariance": "full"}, ValueError),
]
WRONG_OVER_TIME = [
    ({"noise_beta": -0.1}, ValueError),
    ({"noise_beta": float("inf")}, ValueError),
    ({"noise_beta": 1.0, "covariance": "full"}, ValueError),
    ({"noise_beta": 1.0, "horizon": 300}, ValueError),
    ({"shift_elites": 41}, ValueError),
    ({"shift_elites": 1.5}, TypeError),
]


@pytest.mark.parametrize(
    ("kind", "options", "error"),
    [(kind, *wrong) for kind, wrong in itertools.product((VisualMPC, HVF), WRONG)]
    + [(VisualMPC, *wrong) for wrong in WRONG_OVER_TIME],
)
def test_options_out_of_range_are_named(
    kind: Any, options: dict[str, Any], error: type[Exception]
) -> None:
    with pytest.raises(error, match=f"^{next(iter(options))}: "):
        kind(**options)


def test_too_many_dimensions_for_correlations_are_refused() -> None:
    mpc = VisualMPC(horizon=129, covariance="full")
    with pytest.raises(ValueError, match="covariance: 'full' is for at most 256 dimensions"):
        mpc.plan(PointMass(), START, GOAL)


def test_settings_reach_the_planners() -> None:
    ours = {"noise_beta": 2.0, "momentum": 0.1, "samples_decay": 1.25, "temperature": 0.5}
    ours |= {"min_std": 0.01, "shift_elites": 4, "keep_elites": 3}
    subgoals = {"momentum": 0.2, "samples_decay": 1.5, "temperature": 0.7, "min_std": 0.02}
    subgoals |= {"covariance": "full", "shrinkage": 0.3, "keep_elites": 5}  # type: ignore[dict-item]
    named = {f"subgoal_{name}": value for name, value in subgoals.items()}
    planning = Planning(**ours, **named, warm_start=True)  # type: ignore[arg-type]
    assert planning.mpc == VisualMPC(**ours)  # type: ignore[arg-type]
    assert planning.search(2) == HVF(mpc=planning.mpc, **subgoals)  # type: ignore[arg-type]
    full = Planning(covariance="full", shrinkage=0.4)
    assert full.mpc == VisualMPC(covariance="full", shrinkage=0.4)
    with pytest.raises(ValueError, match="shift_elites: belongs to warm_start"):
        Planning(shift_elites=2)
    words = ["--noise-beta", "2", "--temperature", "0.5", "--subgoal-covariance", "full"]
    config = evaluating(Plan, "plan", DOMAINS["maze"], words)
    assert config.evaluation.planning.mpc.noise_beta == 2
    assert config.evaluation.planning.temperature == 0.5
    assert config.evaluation.planning.search(1).covariance == "full"


def test_agents_hand_over_the_elites_of_their_last_plans() -> None:
    world, seen = latent_world(), []
    mpc = VisualMPC(horizon=MPC.horizon, samples=20, elites=5, iterations=2, shift_elites=2)
    costs = world.rollout_costs

    def noting(starts: Any, goals: Any, actions: Any) -> Any:
        seen.append(np.array(actions))
        return costs(starts, goals, actions)

    world.rollout_costs = noting  # type: ignore[method-assign]
    agent = PlanningAgent(world, mpc, no_subgoals, Replanning(warm_start=True))
    act(Line([3, 5]), agent, Acting(steps=2, threshold=0), [0, 1])
    (first, last), (again, _) = seen[:2], seen[2:4]
    assert first.shape[0] == 2
    for trial in range(2):
        kept = again[trial, :2]
        # Both are candidates of the last iteration, shifted by the step that was acted.
        steps = np.minimum(np.arange(mpc.horizon) + 1, mpc.horizon - 1)
        pool = last[trial][:, steps]
        assert all((pool == elite).all(axis=(1, 2)).any() for elite in kept)
