"""The native world of latents, against torch's modules and the planner's answer for a slow twin."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from typing import Any

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import processes
from hvf_core import HVF, LatentFrames, LatentWorld, VisualMPC

torch = pytest.importorskip("torch")
nn = torch.nn

LOW, HIGH = [-2.0, 0.0], [2.0, 1.0]
SIZE, ACTIONS, READ = 10, 2, 14


class Residual(nn.Module):
    """A residual network of torch's own layers."""

    def __init__(self, inputs: int, width: int, blocks: int, outputs: int, wave: bool = False):
        super().__init__()
        self.input = nn.Linear(inputs, width)
        self.blocks = nn.ModuleList(
            nn.ModuleList([nn.Linear(width, width), nn.Linear(width, width)]) for _ in range(blocks)
        )
        self.output = nn.Linear(width, outputs)
        self.wave = wave

    def forward(self, x: Any) -> Any:
        x = self.input(x)
        x = x.sin() if self.wave else x.relu()
        for first, second in self.blocks:
            x = (x + second(first(x).relu())).relu()
        return self.output(x)


def layer(module: Any) -> tuple[np.ndarray, np.ndarray]:
    return module.weight.detach().numpy(), module.bias.detach().numpy()


def weights(network: Residual) -> dict[str, Any]:
    return {
        "input": layer(network.input),
        "blocks": [(layer(first), layer(second)) for first, second in network.blocks],
        "output": layer(network.output),
        "activation": "sin" if network.wave else "relu",
    }


class Slow:
    """The same world in torch, float64: a model of the planner's protocol, image by image."""

    action_low = np.array(LOW, np.float32)
    action_high = np.array(HIGH, np.float32)

    def __init__(self, over_horizon: str = "last", recurrent: bool = False, hold: int = 1) -> None:
        torch.manual_seed(3)
        self.network = Residual(SIZE + ACTIONS, 33, 2, SIZE)
        self.cell = nn.GRUCell(ACTIONS, SIZE)
        self.reader = Residual(SIZE, 24, 0, READ, wave=True)
        self.scale = np.linspace(0.1, 0.5, SIZE, dtype=np.float32)
        self.weights = np.linspace(0.5, 2.0, READ, dtype=np.float32)
        self.over_horizon, self.recurrent, self.hold = over_horizon, recurrent, hold
        cell = {name: value.numpy() for name, value in self.cell.state_dict().items()}
        dynamics = cell if recurrent else {**weights(self.network), "scale": self.scale}
        self.native = LatentWorld(
            LOW,
            HIGH,
            dynamics,
            readout=weights(self.reader),
            weights=self.weights,
            over_horizon=over_horizon,
            hold=hold,
        )
        for module in (self.network, self.cell, self.reader):
            module.double()

    def rollout(self, latents: np.ndarray, actions: np.ndarray) -> np.ndarray:
        problems, candidates = actions.shape[:2]
        low, high = self.action_low.astype(float), self.action_high.astype(float)
        units = torch.from_numpy((actions[:, :, :: self.hold] - low) / (high - low) * 2 - 1)
        z = torch.from_numpy(latents).double()[:, None].expand(-1, candidates, -1)
        path = []
        with torch.no_grad():
            for step in range(units.shape[2]):
                u = units[:, :, step]
                if self.recurrent:
                    flat = self.cell(u.reshape(-1, ACTIONS), z.reshape(-1, SIZE))
                    z = flat.reshape(problems, candidates, SIZE)
                else:
                    z = z + torch.from_numpy(self.scale) * self.network(torch.cat([z, u], -1))
                path.append(z)
        return torch.stack(path, 2).numpy()

    def read(self, latents: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return self.reader(torch.from_numpy(latents).double()).numpy()

    def rollout_costs(self, starts: np.ndarray, goals: np.ndarray, actions: np.ndarray) -> Any:
        read = self.read(self.rollout(starts, actions))
        aims = self.read(goals)[:, None, None]
        costs = ((read - aims) ** 2 * self.weights).sum(-1)
        return {"last": costs[:, :, -1], "sum": costs.sum(-1), "min": costs.min(-1)}[
            self.over_horizon
        ]


def latents(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((count, SIZE)).astype(np.float32)


def drawn_actions(*shape: int) -> np.ndarray:
    return np.random.default_rng(9).uniform(LOW, HIGH, (*shape, ACTIONS)).astype(np.float32)


@pytest.mark.parametrize("recurrent", [False, True])
@pytest.mark.parametrize(("over_horizon", "hold"), [("last", 1), ("sum", 2), ("min", 3)])
def test_rollouts_and_costs_are_those_of_torch(
    recurrent: bool, over_horizon: str, hold: int
) -> None:
    slow = Slow(over_horizon, recurrent, hold)
    starts, goals, actions = latents(3), latents(3, 1), drawn_actions(3, 21, 6)
    found = slow.native.rollout(LatentFrames(starts), actions)
    expected = slow.rollout(starts, actions)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    costs = slow.native.rollout_costs(LatentFrames(starts), LatentFrames(goals), actions)
    assert costs.dtype == np.float32
    np.testing.assert_allclose(costs, slow.rollout_costs(starts, goals, actions), rtol=1e-4)


def test_targets_and_constants_of_goals_are_what_is_compared() -> None:
    slow = Slow("sum")
    goals, actions = latents(3, 1), drawn_actions(3, 5, 4)
    starts = LatentFrames(latents(3))
    plain = slow.native.rollout_costs(starts, LatentFrames(goals), actions)
    targets = slow.read(goals).astype(np.float32)
    # The latents of a goal with targets do not matter.
    given = LatentFrames(np.zeros_like(goals), targets=targets)
    np.testing.assert_allclose(slow.native.rollout_costs(starts, given, actions), plain, rtol=1e-5)
    constants = np.array([0.5, -1.0, 2.0], np.float32)
    more = LatentFrames(goals, constants=constants)
    found = slow.native.rollout_costs(starts, more, actions)
    np.testing.assert_allclose(found, plain + 4 * constants[:, None], rtol=1e-5)


def test_a_matrix_costs_what_it_reads_out() -> None:
    slow, rng = Slow(), np.random.default_rng(2)
    for outputs in (4, 40):
        matrix = rng.standard_normal((outputs, SIZE)).astype(np.float32)
        scale = rng.uniform(0.5, 2, outputs).astype(np.float32)
        dynamics = {**weights(slow.network.float()), "scale": slow.scale}
        world = LatentWorld(LOW, HIGH, dynamics, readout=matrix, weights=scale)
        starts, goals, actions = latents(2), latents(2, 1), drawn_actions(2, 9, 3)
        ends = world.rollout(LatentFrames(starts), actions)[:, :, -1].astype(float)
        expected = (((ends - goals[:, None]) @ matrix.T.astype(float)) ** 2 * scale).sum(-1)
        costs = world.rollout_costs(LatentFrames(starts), LatentFrames(goals), actions)
        np.testing.assert_allclose(costs, expected, rtol=1e-4)
        given = LatentFrames(goals, targets=goals)
        with pytest.raises(ValueError, match=r"^goals: have targets"):
            world.rollout_costs(LatentFrames(starts), given, actions)


def test_shared_rollouts_and_a_problem_alone_cost_the_same_bits() -> None:
    world = Slow("sum").native
    start, goals, actions = (
        LatentFrames(latents(1)),
        LatentFrames(latents(7, 1)),
        drawn_actions(37, 4),
    )
    shared = world.shared_rollout_costs(start, goals, actions)
    every = np.broadcast_to(actions, (7, *actions.shape))
    apart = world.rollout_costs(start[np.zeros(7, np.int64)], goals, every)
    np.testing.assert_array_equal(shared, apart)
    alone = world.rollout_costs(start, goals[np.array([5])], actions[None, 11:12])
    assert alone[0, 0] == shared[5, 11]


class Scattered:
    """Subgoals anywhere: a latent of the search, spread over the latents of the world."""

    latent_dim = 3

    def __init__(self, wrap: Callable[[np.ndarray], Any]) -> None:
        self.spread = np.random.default_rng(5).standard_normal((3, SIZE)).astype(np.float32)
        self.wrap = wrap

    def decode(self, scene: Any, drawn: np.ndarray) -> Any:
        return self.wrap(drawn.reshape(-1, 3) @ self.spread)


def test_planner_and_search_find_what_they_find_with_the_world_in_python() -> None:
    slow = Slow()
    starts, goals = latents(3), latents(3, 1)
    mpc = VisualMPC(horizon=3, samples=40, elites=8, iterations=3)
    native = mpc.plan_batch(slow.native, LatentFrames(starts), LatentFrames(goals), seeds=4)
    python = mpc.plan_batch(Duck(slow), starts, goals, seeds=4)
    np.testing.assert_allclose(native.actions, python.actions, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(native.costs, python.costs, rtol=1e-4)
    search = HVF(mpc=mpc, subgoals=2, samples=6, elites=2, iterations=2)
    inside = search.search(
        slow.native,
        Scattered(lambda rows: LatentFrames(np.ascontiguousarray(rows))),
        LatentFrames(starts[:1]),
        LatentFrames(goals[:1]),
        seed=1,
    )
    outside = search.search(Duck(slow), Scattered(lambda rows: rows), starts[:1], goals[:1], seed=1)
    np.testing.assert_array_equal(inside.latents, outside.latents)
    np.testing.assert_allclose(inside.segment_costs, outside.segment_costs, rtol=1e-4)
    assert isinstance(inside.subgoals, LatentFrames)


class Duck:
    """The slow world without its native one."""

    action_low, action_high = Slow.action_low, Slow.action_high

    def __init__(self, slow: Slow) -> None:
        self.rollout_costs = slow.rollout_costs


class Seen:
    """What a package makes of a native world: `observe` for images, `native` for the planner."""

    def __init__(self, world: LatentWorld) -> None:
        self._native = world
        self.action_low, self.action_high = world.action_low, world.action_high

    @property
    def native(self) -> LatentWorld:
        return self._native

    def observe(self, images: np.ndarray) -> LatentFrames:
        rows = images.reshape(len(images), -1)[:, :SIZE].astype(np.float32) / 255
        return LatentFrames(np.ascontiguousarray(rows), images=images)

    def rollout_costs(self, *_: Any) -> Any:
        raise AssertionError("the planner asks the native world")


def test_a_wrapper_that_observes_images_plans_natively() -> None:
    world = Seen(Slow().native)
    images = np.random.default_rng(0).integers(0, 256, (2, 4, 4, 3), dtype=np.uint8)
    frames = world.observe(images)
    np.testing.assert_array_equal(frames.images, images)
    mpc = VisualMPC(horizon=3, samples=20, elites=4, iterations=2)
    plan = mpc.plan(world, images[0], images[1], seed=3)
    assert plan.cost == mpc.plan(world.native, frames[0], frames[1], seed=3).cost
    with pytest.raises(TypeError, match="start: expected LatentFrames, got"):
        mpc.plan(world.native, images[0], images[1])


def test_frames_are_picked_by_index() -> None:
    rows, images = latents(3), np.arange(36, dtype=np.uint8).reshape(3, 2, 2, 3)
    frames = LatentFrames(rows, targets=rows[:, :4], constants=rows[:, 0], images=images)
    index = np.array([2, 0, -2])
    picked = frames[index]
    assert len(picked) == 3
    np.testing.assert_array_equal(picked.latents, rows[index])
    np.testing.assert_array_equal(picked.targets, rows[index, :4])
    np.testing.assert_array_equal(picked.constants, rows[index, 0])
    np.testing.assert_array_equal(picked.images, images[index])
    np.testing.assert_array_equal(frames[-1].latents, rows[2:])
    bare = LatentFrames(rows)
    assert bare.targets is None
    assert not hasattr(bare, "images")
    np.testing.assert_array_equal(bare.constants, np.zeros(3, np.float32))
    for index in (3, np.array([-4])):
        with pytest.raises(IndexError, match="beyond 3 frames"):
            frames[index]
    for nonsense in ("a", 0.5, np.array([[0]])):
        with pytest.raises(TypeError, match="index"):
            frames[nonsense]


def test_actions_of_nan_cost_nan_and_a_dear_world_takes_fewer_candidates() -> None:
    slow = Slow()
    actions = drawn_actions(1, 4, 2)
    actions[0, 2, 0, 1] = np.nan
    costs = slow.native.rollout_costs(LatentFrames(latents(1)), LatentFrames(latents(1)), actions)
    np.testing.assert_array_equal(np.isnan(costs[0]), [False, False, True, False])
    assert 1024 <= slow.native.max_candidates <= 65536
    assert (slow.native.latent_dim, slow.native.hold) == (SIZE, 1)


GOOD = weights(Residual(SIZE + ACTIONS, 8, 1, SIZE))
CELL = {
    "weight_ih": np.zeros((3 * SIZE, ACTIONS), np.float32),
    "weight_hh": np.zeros((3 * SIZE, SIZE), np.float32),
    "bias_ih": np.zeros(3 * SIZE, np.float32),
    "bias_hh": np.zeros(3 * SIZE, np.float32),
}


def spoilt(array: np.ndarray) -> np.ndarray:
    array = array.copy()
    array.flat[-1] = np.nan
    return array


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"action_low": [0.0]}, "action_high: must have as many"),
        ({"action_low": [-1.0] * 3, "action_high": [1.0] * 3}, "action_low: expected 2 dimensions"),
        ({"dynamics": {}}, r"dynamics: must have an entry 'input'"),
        ({"dynamics": {**GOOD, "outptu": 1}}, r"dynamics: has no entry 'outptu'"),
        (
            {"dynamics": {**GOOD, "activation": "gelu"}},
            r"dynamics\['activation'\]: expected 'relu'",
        ),
        ({"dynamics": {**GOOD, "input": GOOD["output"]}}, r"dynamics\['input'\]: expected"),
        ({"dynamics": {**GOOD, "output": GOOD["input"]}}, r"dynamics\['(in|out)put'\]: expected"),
        (
            {"dynamics": {**GOOD, "output": (spoilt(GOOD["output"][0]), GOOD["output"][1])}},
            r"dynamics\['output'\]: weights must be finite",
        ),
        (
            {"dynamics": {**GOOD, "blocks": [(GOOD["input"], GOOD["output"])]}},
            r"dynamics\['blocks'\]: block 0, layer 0: expected weights",
        ),
        (
            {"dynamics": {**GOOD, "blocks": [(GOOD["input"],)]}},
            r"dynamics\['blocks'\]\[0\]: expected two layers, 2 things, got 1",
        ),
        (
            {"dynamics": {**GOOD, "scale": np.ones(3, np.float32)}},
            r"dynamics\['scale'\]: expected 1",
        ),
        ({"dynamics": {**GOOD, "scale": np.nan}}, r"dynamics\['scale'\]: must be finite"),
        ({"dynamics": {**CELL, "bias_hh": np.zeros(4, np.float32)}}, r"dynamics\['bias_hh'\]: "),
        ({"dynamics": {**CELL, "weight_ih": CELL["weight_hh"]}}, r"action_low: expected 10"),
        ({"dynamics": {**CELL, "scale": 1.0}}, r"dynamics: has no entry 'scale'"),
        ({"readout": np.zeros((3, 4), np.float32)}, "readout: expected shape"),
        ({"readout": np.zeros((3, SIZE), np.float32)}, "readout: must not all be zero"),
        ({"readout": GOOD}, "readout: input: expected weights"),
        ({"weights": np.ones(4, np.float32)}, "weights: expected shape"),
        ({"weights": -np.ones(SIZE, np.float32)}, "weights: must be finite and not negative"),
        ({"over_horizon": "mean"}, "over_horizon: expected 'last'"),
        ({"hold": 0}, "hold: must be at least 1"),
        ({"hold": -(2**70)}, "hold: must not be negative"),
    ],
)
def test_what_makes_no_world_is_refused_by_name(arguments: dict[str, Any], said: str) -> None:
    good = {"action_low": LOW, "action_high": HIGH, "dynamics": GOOD}
    LatentWorld(**good)
    LatentWorld(LOW, HIGH, CELL)
    with pytest.raises(ValueError, match=f"^{said}"):
        LatentWorld(**{**good, **arguments})


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"dynamics": 3}, "dynamics: expected weights of a network, a dict, got"),
        ({"dynamics": {**GOOD, "input": 3}}, r"dynamics\['input'\]: expected weights and bias"),
        ({"dynamics": {**GOOD, "blocks": "no"}}, r"dynamics\['blocks'\]"),
        ({"dynamics": {**GOOD, "activation": 3}}, r"dynamics\['activation'\]: expected a string"),
        ({"dynamics": {**GOOD, "scale": "much"}}, r"dynamics\['scale'\]: expected"),
        ({"readout": "all"}, "readout: expected"),
        ({"weights": [1.0]}, "weights: expected"),
        ({"hold": 1.5}, "hold: expected an integer, got float"),
        ({"action_low": "no"}, r"action_low: expected a float array \[A\]"),
        (
            {"dynamics": {**GOOD, "input": (GOOD["input"][0].astype(float), GOOD["input"][1])}},
            r"dynamics\['input'\]\[0\]: expected float32 \[outputs, inputs\], got a float64",
        ),
        ({"readout": np.zeros((3, SIZE))}, r"readout: expected float32 \[P, Z\]"),
    ],
)
def test_what_is_of_another_type_is_refused_by_name(arguments: dict[str, Any], said: str) -> None:
    with pytest.raises(TypeError, match=f"^{said}"):
        LatentWorld(**{"action_low": LOW, "action_high": HIGH, "dynamics": GOOD, **arguments})


def test_calls_that_do_not_fit_are_refused_by_name() -> None:
    world, frames = Slow().native, LatentFrames(latents(2))
    other = LatentFrames(np.zeros((2, 4), np.float32))
    with pytest.raises(ValueError, match=r"^starts: expected latents of 10"):
        world.rollout_costs(other, frames, drawn_actions(2, 3, 4))
    goals = LatentFrames(latents(2), targets=latents(2))
    with pytest.raises(ValueError, match=r"^goals: expected targets of 14"):
        world.rollout_costs(frames, goals, drawn_actions(2, 3, 4))
    with pytest.raises(ValueError, match=r"^actions: expected 2 problems, got 1"):
        world.rollout_costs(frames, frames, drawn_actions(1, 3, 4))
    with pytest.raises(TypeError, match=r"^actions: expected float32 \[B, D, H, A\]"):
        world.rollout(frames, drawn_actions(2, 3, 4).astype(float))
    endless = np.broadcast_to(np.float32(0), (2, 10**6, 10**6, 2))
    with pytest.raises(MemoryError, match=r"^actions: .* does not fit into memory"):
        world.rollout(frames, endless)
    raw = np.zeros(2 * 3 * 4 * 2 * 4 + 1, np.uint8)[1:]
    askew = raw.view(np.float32).reshape(2, 3, 4, 2)
    with pytest.raises(ValueError, match=r"^actions: .* memory is misaligned"):
        world.rollout(frames, askew)


anything = st.one_of(
    st.none(),
    st.integers(),
    st.floats(),
    st.text(max_size=3),
    hnp.arrays(
        st.sampled_from([np.float32, np.float64, np.int64, np.uint8]),
        hnp.array_shapes(min_dims=0, max_dims=4, max_side=SIZE),
    ),
    st.lists(st.floats(width=32), max_size=3),
)
layers = st.one_of(anything, st.tuples(anything, anything), st.just(GOOD["input"]))
networks = st.one_of(
    anything,
    st.fixed_dictionaries(
        {"input": layers, "output": st.one_of(layers, st.just(GOOD["output"]))},
        optional={
            "blocks": st.one_of(anything, st.lists(st.tuples(layers, layers), max_size=2)),
            "scale": anything,
            "activation": st.one_of(anything, st.sampled_from(["relu", "sin"])),
            "weight_hh": anything,
        },
    ),
    st.just(GOOD),
    st.just(CELL),
)


@settings(max_examples=300, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    low=st.one_of(anything, st.just(LOW)),
    high=st.one_of(anything, st.just(HIGH)),
    dynamics=networks,
    readout=networks,
    scale=anything,
    over_horizon=st.one_of(anything, st.just("last")),
    hold=st.one_of(anything, st.just(1)),
)
def test_nonsense_makes_a_world_or_a_value_or_type_error(
    low: Any, high: Any, dynamics: Any, readout: Any, scale: Any, over_horizon: Any, hold: Any
) -> None:
    with contextlib.suppress(TypeError, ValueError):
        world = LatentWorld(
            low,
            high,
            dynamics,
            readout=readout,
            weights=scale,
            over_horizon=over_horizon,
            hold=hold,
        )
        frames = LatentFrames(np.zeros((1, world.latent_dim), np.float32))
        actions = np.zeros((1, 2, min(world.hold, 9), len(world.action_low)), np.float32)
        assert world.rollout_costs(frames, frames, actions).shape == (1, 2)


@settings(max_examples=300, deadline=None, suppress_health_check=list(HealthCheck))
@given(rows=anything, targets=anything, constants=anything, images=anything)
def test_nonsense_makes_frames_or_a_value_or_type_error(
    rows: Any, targets: Any, constants: Any, images: Any
) -> None:
    with contextlib.suppress(TypeError, ValueError):
        frames = LatentFrames(rows, targets, constants, images)
        assert len(frames) == len(frames.latents) == len(rows)


FORKED = """
import os, signal, sys, warnings
warnings.simplefilter("ignore")
import numpy as np
import hvf_core
layer = (np.zeros((2, 3), np.float32), np.zeros(2, np.float32))
last = (np.zeros((2, 2), np.float32), np.zeros(2, np.float32))
network = {"input": layer, "blocks": [], "output": last, "activation": "relu"}
world = hvf_core.LatentWorld([-1.0], [1.0], network)
frames = hvf_core.LatentFrames(np.zeros((1, 2), np.float32))
several = np.zeros((1, 2000, 3, 1), np.float32)
calls = {
    "rollout": lambda: world.rollout(frames, several),
    "rollout_costs": lambda: world.rollout_costs(frames, frames, several),
    "shared_rollout_costs": lambda: world.shared_rollout_costs(frames, frames, several[0]),
}
for call in calls.values():
    call()
child = os.fork()
if child == 0:
    signal.alarm(60)
    for name, call in calls.items():
        try:
            call()
        except RuntimeError as error:
            print(name, error, flush=True)
    os._exit(0)
_, status = os.waitpid(child, 0)
sys.exit(status != 0)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_calls_in_a_forked_child_say_why_they_cannot_work() -> None:
    done = processes.run(processes.python(FORKED), check=True)
    said = done.stdout.splitlines()
    assert [line.split()[0] for line in said] == [
        "rollout",
        "rollout_costs",
        "shared_rollout_costs",
    ]
    assert all("before this process was forked" in line for line in said)
