"""Video models as worlds: against a toy whose truth is known, and for bits that do not change."""

from __future__ import annotations

import dataclasses
import shutil
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from torch import nn

import hvf_core
from hvf.agents.planning import PlanningAgent
from hvf.blur import blur_matrix
from hvf.evaluation.prediction import context_of, predict
from hvf.models.vae import CVAE, CVAEConfig
from hvf.models.video import State, VideoConfig, VideoModel, sequence_noise
from hvf.protocols import Drawable, Observer, Preparer, Remembering, RolloutSharer, WorldModel
from hvf.settings import Planning
from hvf.worlds.batching import batches
from hvf.worlds.distances import latent_world
from hvf.worlds.pixels import PixelCost
from hvf.worlds.video import RememberingVideoWorld, VideoWorld, world_of

HEIGHT, WIDTH, SIDE = 12, 16, 3.0
CONFIG = VideoConfig(image_size=(HEIGHT, WIDTH), action_low=(-2, -2), action_high=(2, 2))


def drawn(places: Any) -> np.ndarray:
    """A white square with its corner at ``places [..., 2]`` (row, column), area coverage."""
    places = np.asarray(places, np.float64)[..., None]
    lines = []
    for axis, size in enumerate((HEIGHT, WIDTH)):
        grid, corner = np.arange(size), places[..., axis, :]
        lines.append(np.clip(np.minimum(grid + 1, corner + SIDE) - np.maximum(grid, corner), 0, 1))
    image = lines[0][..., :, None] * lines[1][..., None, :]
    return np.repeat(image[..., None], 3, axis=-1).astype(np.float32)


def seen(places: Any) -> np.ndarray:
    return np.rint(drawn(places) * 255).astype(np.uint8)


class Square(VideoModel):
    """The square goes where actions push it; with noise, also where that pushes it each step.

    With a context of two it goes on as fast as it was, and actions are added to that.
    """

    def __init__(self, config: VideoConfig = CONFIG, **kind: int) -> None:
        super().__init__(config)
        for name, value in kind.items():
            setattr(self, name, value)
        self.weight = nn.Parameter(torch.ones(()))
        self.started: list[int] = []
        self.largest = 0
        self.drawings = 0

    def start(self, frames: torch.Tensor, past: torch.Tensor) -> State:
        assert frames.shape[1:] == (self.context, 3, HEIGHT, WIDTH)
        assert past.shape == (len(frames), self.context - 1, 2)
        self.started.append(len(frames))
        mass = frames[:, :, 0] + 1e-9
        total = mass.sum(dim=(-1, -2))
        rows = (mass.sum(-1) * torch.arange(HEIGHT)).sum(-1) / total
        columns = (mass.sum(-2) * torch.arange(WIDTH)).sum(-1) / total
        place = torch.stack([rows, columns], dim=-1) - (SIDE - 1) / 2
        speed = place[:, -1] - place[:, -2] if self.context > 1 else torch.zeros_like(place[:, -1])
        return place[:, -1], speed

    def step(
        self, state: State, actions: torch.Tensor, noise: torch.Tensor | None, *, last: bool = False
    ) -> State:
        self.largest = max(self.largest, len(actions))
        place, speed = state
        moved = place + speed + self.hold * actions * self.weight
        return (moved if noise is None else moved + noise[:, :2]), speed

    def images(self, state: State) -> torch.Tensor:
        self.drawings += len(state[0])
        lines = []
        for axis, size in enumerate((HEIGHT, WIDTH)):
            grid, corner = torch.arange(size), state[0][:, axis, None]
            end = torch.minimum(grid + 1, corner + SIDE)
            lines.append((end - torch.maximum(grid, corner)).clamp(0, 1))
        return (lines[0][:, :, None] * lines[1][:, None, :])[:, None].expand(-1, 3, -1, -1)


class Churn(VideoModel):
    """Layers whose last bits depend on batches and threads, if one lets them."""

    noise = 5

    def __init__(self, config: VideoConfig = CONFIG) -> None:
        super().__init__(config)
        torch.manual_seed(3)
        self.into = nn.Conv2d(3, 8, 3, padding=1)
        self.acted = nn.Linear(7, 8)
        self.wide = nn.Linear(8 * HEIGHT * WIDTH, 40)
        self.back = nn.Linear(40, 8)
        self.out = nn.Conv2d(8, 3, 1)

    def start(self, frames: torch.Tensor, past: torch.Tensor) -> State:
        hidden = self.into(frames[:, -1])
        return hidden, self.wide(hidden.flatten(1))

    def step(
        self, state: State, actions: torch.Tensor, noise: torch.Tensor | None, *, last: bool = False
    ) -> State:
        assert noise is not None
        hidden, code = state
        push = self.acted(torch.cat([actions, noise], 1)) + self.back(code)
        hidden = torch.tanh(hidden + push[:, :, None, None])
        return hidden, self.wide(hidden.flatten(1))

    def images(self, state: State) -> torch.Tensor:
        return torch.sigmoid(self.out(state[0]))


PLACES = np.array([[3.0, 4.0], [6.5, 9.0], [1.0, 2.0]])


def problems(seed: int = 0, candidates: int = 7, steps: int = 3) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    goals = rng.uniform(0, 9, (len(PLACES), 2))
    actions = rng.uniform(-1.5, 1.5, (len(PLACES), candidates, steps, 2)).astype(np.float32)
    return seen(PLACES), goals, actions


def slow_costs(path: np.ndarray, goals: np.ndarray, blur: float, over: str) -> np.ndarray:
    """Costs ``[B, D]`` of squares at ``path [B, D, H, 2]``, written out with SciPy."""
    images, aims = drawn(path).astype(np.float64), seen(goals)[:, None, None] / 255
    if blur:
        images, aims = (
            ndimage.gaussian_filter(x, (0, 0, 0, blur, blur, 0)) for x in (images, aims)
        )
    costs = ((images - aims) ** 2).sum((3, 4, 5)) / (HEIGHT * WIDTH)
    return {"last": costs[:, :, -1], "sum": costs.sum(2), "min": costs.min(2)}[over]


@pytest.mark.parametrize("over", ["last", "sum", "min"])
@pytest.mark.parametrize("blur", [0.0, 2.0])
def test_costs_are_those_of_the_true_frames(over: Any, blur: float) -> None:
    model = Square()
    world = VideoWorld(model, blur=blur, over_horizon=over, device="cpu")
    starts, goals, actions = problems()
    costs = world.rollout_costs(world.observe(starts), world.observe(seen(goals)), actions)
    path = PLACES[:, None, None] + np.cumsum(actions, axis=2)
    assert costs.dtype == np.float32
    np.testing.assert_allclose(costs, slow_costs(path, goals, blur, over), rtol=1e-4, atol=1e-6)


@given(
    st.integers(1, 9), st.integers(1, 9), st.sampled_from([0.0, 0.4, 1.5, 4.0]), st.integers(0, 99)
)
@settings(max_examples=30)
def test_the_pixel_cost_is_the_native_one(height: int, width: int, blur: float, seed: int) -> None:
    a, b = np.random.default_rng(seed).random((2, 3, height, width, 3), dtype=np.float32)
    cost = PixelCost(height, width, blur, torch.device("cpu"))
    x, y = (cost.features(torch.from_numpy(images).permute(0, 3, 1, 2)) for images in (a, b))
    native = hvf_core.image_cost(a, b, blur=blur)
    np.testing.assert_allclose(cost.between(x, y).numpy(), native, rtol=1e-4, atol=1e-7)


def test_the_blur_is_scipys_even_where_it_is_wider_than_the_image() -> None:
    for n, sigma in [(1, 2.0), (5, 7.0), (16, 1.0)]:
        expected = ndimage.gaussian_filter1d(np.eye(n), sigma, axis=0)
        np.testing.assert_allclose(blur_matrix(n, sigma), expected, atol=1e-12)


def test_it_is_what_the_planner_asks_for() -> None:
    world = VideoWorld(Square(), device="cpu")
    for protocol in (WorldModel, Observer, Preparer, RolloutSharer, Drawable):
        assert isinstance(world, protocol)
    assert not isinstance(world, Remembering)
    assert not world.uses_seeds
    np.testing.assert_array_equal(world.action_high, [2, 2])
    frames = world.observe(seen(PLACES))
    np.testing.assert_array_equal(
        world.images(frames[np.array([2, 0, 2])]), seen(PLACES)[[2, 0, 2]]
    )
    mpc = hvf_core.VisualMPC(horizon=3, samples=64, elites=8, iterations=6)
    start, target = seen(PLACES[1:2]), seen([[3.0, 5.0]])
    plan = mpc.plan(VideoWorld(Square(), blur=1.5, device="cpu"), start, target, seed=0)
    np.testing.assert_allclose(plan.actions.sum(0), [-3.5, -4], atol=0.3)


def test_starts_are_prepared_once_and_only_frames_that_count_are_drawn() -> None:
    model = Square()
    world = VideoWorld(model, device="cpu")
    mpc = hvf_core.VisualMPC(horizon=4, samples=20, elites=4, iterations=3, min_variance=0.0)
    world.rollouts.most  # noqa: B018 - measures memory with batches of its own
    model.started.clear()
    model.drawings = 0
    starts, goals, _ = problems()
    mpc.plan_batch(world, starts, seen(goals), seeds=[0, 1, 2])
    # Once to see how large a state is, and each start by itself.
    assert model.started == [1] * (1 + len(starts))
    assert model.drawings == len(starts) * 20 * 3
    model.drawings = 0
    summed = VideoWorld(model, over_horizon="sum", device="cpu")
    summed.rollouts.__dict__.update(world.rollouts.__dict__)
    mpc.plan_batch(summed, starts, seen(goals), seeds=[0, 1, 2])
    assert model.drawings == len(starts) * 20 * 3 * 4


@pytest.mark.parametrize("prepared", [True, False])
def test_bits_do_not_depend_on_what_else_is_planned(prepared: bool) -> None:
    world = VideoWorld(Churn(), blur=1.0, device="cpu")
    starts, goals, actions = problems(candidates=37)
    seeds = np.arange(3 * 37).reshape(3, 37)
    ours, theirs = world.observe(starts), world.observe(seen(goals))
    if prepared:
        ours, theirs = world.prepare(ours, theirs)
    together = world.rollout_costs(ours, theirs, actions, seeds=seeds)
    for b in range(3):
        one = np.array([b])
        alone = world.rollout_costs(ours[one], theirs[one], actions[one], seeds=seeds[one])
        np.testing.assert_array_equal(alone[0], together[b])
        copies = np.array([b, b, b])
        same = world.rollout_costs(ours[copies], theirs, actions[copies], seeds=seeds[copies])
        shared = world.shared_rollout_costs(ours[one], theirs, actions[b], seeds=seeds[b])
        np.testing.assert_array_equal(shared, same)


def test_a_plan_is_the_same_alone_and_in_a_batch() -> None:
    world = VideoWorld(Churn(), device="cpu")
    mpc = hvf_core.VisualMPC(horizon=3, samples=30, elites=5, iterations=3)
    starts, goals, _ = problems()
    plans = mpc.plan_batch(world, starts, seen(goals), seeds=[5, 6, 7])
    for b in range(3):
        alone = mpc.plan(world, starts[b : b + 1], seen(goals[b : b + 1]), seed=5 + b)
        np.testing.assert_array_equal(alone.actions, plans.actions[b])
        assert alone.cost == plans.costs[b]


def test_a_plan_is_the_same_with_any_number_of_threads() -> None:
    mpc = hvf_core.VisualMPC(horizon=3, samples=60, elites=5, iterations=3)
    starts, goals, _ = problems()
    found, before = [], torch.get_num_threads()
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            world = VideoWorld(Churn(), device="cpu")
            found.append(mpc.plan_batch(world, starts, seen(goals), seeds=[5, 6, 7]))
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    for plans in found[1:]:
        np.testing.assert_array_equal(plans.actions, found[0].actions)
        np.testing.assert_array_equal(plans.costs, found[0].costs)


@given(st.integers(1, 300), st.integers(1, 70), st.booleans())
def test_batches_are_of_one_size_and_miss_nothing(count: int, most: int, few: bool) -> None:
    found = batches(count, most, few_sizes=few)
    (size,) = {len(rows) for rows in found}
    assert size <= most
    assert np.unique(np.concatenate(found)).tolist() == list(range(count))
    if not few:
        assert len(found) == -(-count // most)


def test_batches_stay_within_the_memory() -> None:
    starts, goals, actions = problems(candidates=60)
    largest = {}
    for memory_gb in (1e-9, 2e-4, 2.0):
        model = Square()
        world = VideoWorld(model, memory_gb=memory_gb, device="cpu")
        per_row = world.rollouts._bytes
        model.largest = 0
        ours, theirs = world.prepare(world.observe(starts), world.observe(seen(goals)))
        assert (ours.state is None) == (memory_gb == 1e-9)
        costs = world.rollout_costs(ours, theirs, actions)
        largest[memory_gb] = model.largest
        assert model.largest == 1 or model.largest * per_row <= memory_gb * 1e9
        path = PLACES[:, None, None] + np.cumsum(actions, axis=2)
        np.testing.assert_allclose(costs, slow_costs(path, goals, 0, "last"), rtol=1e-4, atol=1e-6)
    assert largest[1e-9] == 1 < largest[2e-4] < largest[2.0] <= 25
    # An image float32 and its difference to the goal, at the least.
    assert per_row > 2 * 4 * 3 * HEIGHT * WIDTH


def test_noise_is_drawn_from_the_seed_of_each_candidate() -> None:
    world = VideoWorld(Square(noise=4), device="cpu")
    assert world.uses_seeds
    starts, goals, actions = problems()
    seeds = np.random.default_rng(1).integers(0, 2**63 - 1, actions.shape[:2])
    ours, theirs = world.observe(starts), world.observe(seen(goals))
    costs = world.rollout_costs(ours, theirs, actions, seeds=seeds)
    noise = sequence_noise(torch.from_numpy(seeds.ravel()), 4).numpy()[:, :2]
    steps = actions + noise.reshape(3, 7, 1, 2)
    path = PLACES[:, None, None] + np.cumsum(steps, axis=2)
    np.testing.assert_allclose(costs, slow_costs(path, goals, 0, "last"), rtol=1e-4, atol=1e-6)
    assert (costs != world.rollout_costs(ours, theirs, actions, seeds=seeds + 1)).any()
    with pytest.raises(ValueError, match=r"^seeds: this model is stochastic"):
        world.rollout_costs(ours, theirs, actions)
    mpc = hvf_core.VisualMPC(horizon=3, samples=20, elites=5, iterations=2)
    plans = [mpc.plan(world, starts[:1], seen(goals[:1]), seed=s) for s in (1, 1, 2)]
    np.testing.assert_array_equal(plans[0].actions, plans[1].actions)
    assert (plans[0].actions != plans[2].actions).any()


def test_predictions_are_images_of_every_step() -> None:
    world = VideoWorld(Square(noise=2), device="cpu")
    _, _, actions = problems()
    images = predict(world, seen(PLACES), actions[:, 0])
    noise = sequence_noise(torch.arange(3), 2).numpy()[:, None]
    path = PLACES[:, None] + np.cumsum(actions[:, 0] + noise, axis=1)
    assert np.abs(images.astype(int) - seen(path)).max() <= 1
    again = world.predict(world.observe(seen(PLACES)), actions[:, 0], seeds=np.array([0, 1, 2]))
    np.testing.assert_array_equal(images, again)
    none = world.predict(world.observe(seen(PLACES[:0])), actions[:0, 0])
    assert none.shape == (0, 3, HEIGHT, WIDTH, 3)


def test_a_model_of_long_steps_takes_every_held_action_once() -> None:
    model = Square(hold=3)
    starts, goals, actions = problems(steps=2)
    actions /= 3
    held = actions.repeat(3, axis=2)
    path = PLACES[:, None, None] + np.cumsum(3 * actions, axis=2)
    for over in ("last", "sum"):
        world = VideoWorld(model, action_repeat=6, over_horizon=over, device="cpu")
        costs = world.rollout_costs(world.observe(starts), world.observe(seen(goals)), held)
        np.testing.assert_allclose(costs, slow_costs(path, goals, 0, over), rtol=1e-4, atol=1e-6)
    images = world.predict(world.observe(starts), held[:, 0, :5])
    expected = seen(path[:, 0].repeat(3, axis=1)[:, :5])
    assert np.abs(images.astype(int) - expected).max() <= 1
    with pytest.raises(ValueError, match=r"^action_repeat: must be a multiple of 3"):
        VideoWorld(model, action_repeat=2)
    with pytest.raises(ValueError, match=r"^action_repeat"):
        world_of(model, Planning(horizon=4, action_repeat=4))
    with pytest.raises(ValueError, match=r"^actions: 5 steps are no multiple of 3"):
        world.rollout_costs(world.observe(starts), world.observe(starts), held[:, :, :5])


@pytest.mark.parametrize("hold", [1, 2])
def test_a_model_with_context_starts_from_what_was_seen(hold: int) -> None:
    world = world_of(Square(context=2, hold=hold), Planning(horizon=4, action_repeat=hold))
    assert isinstance(world, RememberingVideoWorld)
    assert isinstance(world, Remembering)
    assert context_of(world) == hold + 1
    speed = np.array([0.5, -0.5])
    times = np.arange(-hold, 1)[:, None] / hold
    history = seen(PLACES[:, None] + times * speed)
    past = np.zeros((3, hold, 2), np.float32)
    _, goals, actions = problems(steps=2)
    actions /= hold
    path = PLACES[:, None, None] + np.cumsum(speed + hold * actions, axis=2)
    starts = world.observe_history(history, past)
    costs = world.rollout_costs(starts, world.observe(seen(goals)), actions.repeat(hold, axis=2))
    # Where the square is at a half pixel is read off bytes.
    np.testing.assert_allclose(costs, slow_costs(path, goals, 0, "last"), rtol=0.02, atol=1e-3)
    with pytest.raises(ValueError, match=r"^images: expected shape \[N"):
        world.observe_history(history[:, :1], past)
    with pytest.raises(ValueError, match=r"^actions: expected shape"):
        world.observe_history(history, past[:, :0])
    # Seen for the first time, nothing moved yet.
    still = PLACES[:, None, None] + np.cumsum(hold * actions, axis=2)
    costs = world.rollout_costs(
        world.observe(seen(PLACES)), world.observe(seen(goals)), actions.repeat(hold, axis=2)
    )
    np.testing.assert_allclose(costs, slow_costs(still, goals, 0, "last"), rtol=0.02, atol=1e-3)


def test_an_agent_tells_the_model_what_it_saw_and_did() -> None:
    @dataclasses.dataclass
    class Two:
        goals: np.ndarray

        def __len__(self) -> int:
            return 2

    model = Square(context=2)
    world = world_of(model, Planning(horizon=2))
    histories = []
    observe = world.observe_history
    world.observe_history = lambda *seen: (histories.append(seen), observe(*seen))[1]  # type: ignore
    mpc = hvf_core.VisualMPC(horizon=2, samples=8, elites=2, iterations=1)
    agent = PlanningAgent(world, mpc, lambda trials, trial, seed: seen(PLACES[:1]))
    agent.begin(Two(seen(PLACES[:2])))  # type: ignore[arg-type]
    which, aims = np.arange(2), np.zeros(2, np.int64)
    for trial in range(2):
        agent.choose(trial, 0)
    first = agent.act(which, seen(PLACES[:2]), aims, [0, 1])
    agent.acted(which, first.actions)
    agent.act(which, seen(PLACES[:2] + 1), aims, [0, 1])
    images, actions = histories[-1]
    np.testing.assert_array_equal(images, np.stack([seen(PLACES[:2]), seen(PLACES[:2] + 1)], 1))
    np.testing.assert_array_equal(actions[:, 0], first.actions)


def test_it_plans_in_the_latent_of_a_vae() -> None:
    torch.manual_seed(0)
    tiny = CVAEConfig(
        image_size=(HEIGHT, WIDTH), channels=(4, 4), strides=(2, 2), latent_dim=3,
        posterior_layers=(8,), scene_layers=(8,), image_layers=(8,), pyramid_levels=1,
    )  # fmt: skip
    model = Square()
    world = latent_world(VideoWorld(model, device="cpu"), CVAE(tiny), Planning())
    mpc = hvf_core.VisualMPC(horizon=3, samples=20, elites=5, iterations=2)
    starts, goals, _ = problems()
    model.started.clear()
    plan = mpc.plan(world, starts[:1], seen(goals[:1]), seed=0)
    assert np.isfinite(plan.cost)
    # All candidates share the start.
    assert sum(model.started) <= 2 + 3


def test_bad_settings_and_images_are_refused() -> None:
    refused: list[tuple[dict[str, Any], str]] = [
        ({"blur": -1.0}, "^blur: must be finite"),
        ({"over_horizon": "first"}, "^over_horizon: must be one of"),
        ({"precision": "float16"}, "^precision: must be one of"),
        ({"memory_gb": 0.0}, "^memory_gb: must be positive"),
        ({"action_repeat": 0}, "^action_repeat"),
    ]
    for kind, message in refused:
        with pytest.raises(ValueError, match=message):
            VideoWorld(Square(), **{"device": "cpu", **kind})
    world = VideoWorld(Square(), device="cpu")
    with pytest.raises(ValueError, match=r"^images: expected shape \[N, 12, 16, 3\]"):
        world.observe(np.zeros((1, 16, 12, 3), np.uint8))
    with pytest.raises(TypeError, match=r"^images: must be uint8"):
        world.observe(np.zeros((1, 12, 16, 3), np.float32))


def test_half_precision_is_near() -> None:
    starts, goals, actions = problems()
    seeds = np.arange(21).reshape(3, 7)
    costs = []
    for precision in ("float32", "bfloat16"):
        world = VideoWorld(Churn(), precision=precision, device="cpu")  # type: ignore[arg-type]
        ours, theirs = world.prepare(world.observe(starts), world.observe(seen(goals)))
        costs.append(world.rollout_costs(ours, theirs, actions, seeds=seeds))
    assert costs[1].dtype == np.float32
    np.testing.assert_allclose(costs[1], costs[0], rtol=0.03)
    assert (costs[1] != costs[0]).any()


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="torch.compile needs a C++ compiler here")
def test_a_compiled_model_gives_the_same_costs() -> None:
    starts, goals, actions = problems(candidates=16)
    seeds = np.arange(3 * 16).reshape(3, 16)
    costs = []
    for compiled in (False, True):
        world = VideoWorld(Churn(), compile=compiled, device="cpu")
        ours, theirs = world.prepare(world.observe(starts), world.observe(seen(goals)))
        costs.append(world.rollout_costs(ours, theirs, actions, seeds=seeds))
    np.testing.assert_allclose(costs[1], costs[0], rtol=1e-4)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda_gives_the_costs_of_the_cpu() -> None:
    starts, goals, actions = problems(candidates=200)
    seeds = np.arange(600).reshape(3, 200)
    costs = {}
    for device, precision in (("cpu", "float32"), ("cuda", "float32"), ("cuda", "auto")):
        model = Churn()
        world = VideoWorld(model, blur=1.0, device=device, precision=precision)  # type: ignore
        ours, theirs = world.prepare(world.observe(starts), world.observe(seen(goals)))
        costs[device, precision] = world.rollout_costs(ours, theirs, actions, seeds=seeds)
        one = np.array([0])
        shared = world.shared_rollout_costs(ours[one], theirs[one], actions[0], seeds=seeds[0])
        np.testing.assert_allclose(shared[0], costs[device, precision][0], rtol=1e-2)
        assert world.predict(ours, actions[:, 0]).shape == (3, 3, HEIGHT, WIDTH, 3)
    np.testing.assert_allclose(costs["cuda", "float32"], costs["cpu", "float32"], rtol=1e-2)
    np.testing.assert_allclose(costs["cuda", "auto"], costs["cpu", "float32"], rtol=0.1)
