"""The desk's learned dynamics in Rust against torch: rollouts, drawn frames, costs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

import hvf_core
from hvf.protocols import Observer, RolloutSharer, WorldModel

torch = pytest.importorskip("torch")

from hvf.models.layers.dynamics import LayerDynamics  # noqa: E402
from hvf.models.layers.perception import Scene  # noqa: E402
from hvf.worlds.layers import LayerWorld  # noqa: E402
from layered_desk import ACTION, PARTS, SIZE, random_dynamics, random_states  # noqa: E402


@pytest.fixture(scope="module")
def dynamics() -> LayerDynamics:
    return random_dynamics()


def random_images(count: int, seed: int) -> NDArray[np.uint8]:
    rng = np.random.default_rng([seed, 1])
    return rng.integers(0, 256, (count, SIZE, SIZE, 3), dtype=np.uint8)


def frames_of(world: LayerWorld, count: int, seed: int) -> hvf_core.LayerFrames:
    """Frames that hold anything at all."""
    rng = np.random.default_rng(seed)
    images = random_images(count, seed)
    clean = rng.random((count, SIZE, SIZE, 3), dtype=np.float32)
    regions = rng.random((count, PARTS, SIZE, SIZE)) < 0.1
    return world.native.frames(images, clean, regions, random_states(count, seed))


def actions_of(shape: tuple[int, ...], seed: int) -> NDArray[np.float32]:
    """Some beyond the bounds, which are as if at the bounds."""
    return np.random.default_rng(seed).uniform(-1.2, 1.2, shape).astype(np.float32)


def torch_rollout(
    dynamics: LayerDynamics, states: NDArray[np.float32], actions: NDArray[np.float32]
) -> NDArray[np.float32]:
    """States `[D, H, X]` of `actions [D, H, A]` from one state."""
    with torch.inference_mode():
        start = torch.from_numpy(states).expand(len(actions), -1)
        path: NDArray[np.float32] = dynamics.rollout(
            start, torch.from_numpy(actions).clamp(-1, 1)
        ).numpy()
    return path


class Drawn:
    """Start frames that torch draws from, and the same for Rust."""

    def __init__(self, world: LayerWorld, count: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.images = rng.integers(0, 256, (count, SIZE, SIZE, 3), dtype=np.uint8)
        self.clean = rng.random((count, SIZE, SIZE, 3), dtype=np.float32)
        self.regions = rng.random((count, PARTS, SIZE, SIZE)) < 0.1
        self.states = random_states(count, seed)
        self.frames = world.native.frames(self.images, self.clean, self.regions, self.states)
        self.perception = world.dynamics.perception

    def draw(self, i: int, states: NDArray[np.float32]) -> NDArray[np.float32]:
        """Frames `[D, S, S, 3]` of start `i` at `states [D, X]`."""
        count = len(states)
        with torch.inference_mode():
            clean = torch.from_numpy(self.clean[i]).permute(2, 0, 1)
            scene = Scene(
                clean.expand(count, -1, -1, -1),
                torch.from_numpy(self.regions[i]).expand(count, -1, -1, -1),
                torch.from_numpy(self.states[i]).expand(count, -1),
            )
            drawn = self.perception.draw(scene, torch.from_numpy(states))
        return np.ascontiguousarray(drawn.permute(0, 2, 3, 1).numpy())


def test_rollouts_in_rust_are_those_of_torch(dynamics: LayerDynamics) -> None:
    world = LayerWorld(dynamics)
    frames = frames_of(world, 8, seed=1)
    actions = actions_of((8, 83, 12, ACTION), seed=2)
    found = world.native.rollout(frames, actions)
    for b in range(8):
        expected = torch_rollout(dynamics, frames.states[b], actions[b])
        np.testing.assert_allclose(found[b], expected, atol=2e-3)
    # Everything moves for some candidates, and some parts for none.
    moved = (found != frames.states[:, None, None]).mean(axis=(0, 1, 2))
    parts = moved[ACTION + 2 :].reshape(PARTS, 3)
    assert (moved[: ACTION + 2] > 0.9).all()
    assert ((parts[:, :2] > 0.1) & (parts[:, :2] < 0.9)).all()
    assert parts[:, 2].any()


def test_frames_drawn_in_rust_are_those_of_torch(dynamics: LayerDynamics) -> None:
    world = LayerWorld(dynamics)
    drawn = Drawn(world, 2, seed=3)
    for i in range(2):
        states = random_states(40, seed=4 + i)
        # Some that hardly change, and some with sliders beyond their ends.
        states[:10] = drawn.states[i] + np.float32(0.05) * (states[:10] - drawn.states[i])
        states[10:12, ACTION : ACTION + 2] = [[-0.5, 1.5], [1.0, 0.0]]
        states[12, ACTION + 2 : ACTION + 4] = [-40.0, 70.0]
        expected = drawn.draw(i, states)
        found = world.native.draw(drawn.frames[np.full(40, i)], states)
        np.testing.assert_allclose(found, expected, atol=2e-5)


@pytest.mark.parametrize("blur", [0.0, 1.5])
@pytest.mark.parametrize("over_horizon", ["last", "sum", "min"])
def test_costs_are_those_of_frames_that_torch_draws(
    dynamics: LayerDynamics, blur: float, over_horizon: Any
) -> None:
    world = LayerWorld(dynamics, blur, over_horizon)
    drawn = Drawn(world, 4, seed=5)
    starts, goals = drawn.frames[np.array([0, 1])], drawn.frames[np.array([2, 3])]
    actions = actions_of((2, 9, 4, ACTION), seed=6)
    found = world.rollout_costs(starts, goals, actions)
    for b in range(2):
        path = torch_rollout(dynamics, drawn.states[b], actions[b])
        costs = []
        for h in range(4):
            images = drawn.draw(b, path[:, h]).astype(np.float64)
            missed = images - drawn.images[2 + b] / 255.0
            if blur:
                missed = gaussian_filter(missed, (0, blur, blur, 0))
            costs.append((missed**2).sum(axis=3).mean(axis=(1, 2)))
        reduce: dict[str, Any] = {
            "last": lambda x: x[-1],
            "sum": sum,
            "min": lambda x: np.min(x, axis=0),
        }
        np.testing.assert_allclose(found[b], reduce[over_horizon](costs), rtol=1e-3)


def test_what_is_behind_the_arm_counts_where_the_goal_shows_it(dynamics: LayerDynamics) -> None:
    rng, weight = np.random.default_rng(10), 2.5
    clean = rng.uniform(-0.05, 1.05, (2, SIZE, SIZE, 3)).astype(np.float32)
    hidden = rng.random((2, SIZE, SIZE, 1)) < 0.3
    images = np.rint(clean.clip(0, 1) * 255).astype(np.uint8)
    images = np.where(hidden, images ^ 128, images)
    regions = rng.random((2, PARTS, SIZE, SIZE)) < 0.1
    states = random_states(2, seed=10)
    actions = actions_of((1, 30, 2, ACTION), seed=11)
    costs = []
    for world in (LayerWorld(dynamics), LayerWorld(dynamics, scene_weight=weight)):
        frames = world.native.frames(images, clean, regions, states)
        costs.append(world.rollout_costs(frames[np.array([0])], frames[np.array([1])], actions)[0])
    ends = torch.from_numpy(torch_rollout(dynamics, states[0], actions[0])[:, -1])
    with torch.inference_mode():
        scene = Scene(
            torch.from_numpy(clean[:1]).permute(0, 3, 1, 2),
            torch.from_numpy(regions[:1]),
            torch.from_numpy(states[:1]),
        )
        drawn = dynamics.perception.change(scene, ends).image.permute(0, 2, 3, 1).numpy()
    apart = (drawn.clip(0, 1) - clean[1].clip(0, 1)) * ~hidden[1]
    extra = (apart.astype(np.float64) ** 2).sum(axis=3).mean(axis=(1, 2))
    np.testing.assert_allclose(costs[1] - costs[0], weight * extra, rtol=2e-3)
    assert extra.std() > 0


@pytest.mark.parametrize("blur", [0.0, 1.5])
@pytest.mark.parametrize("over_horizon", ["last", "min"])
def test_shared_rollouts_cost_the_same_to_the_last_bit(
    dynamics: LayerDynamics, blur: float, over_horizon: Any
) -> None:
    world = LayerWorld(dynamics, blur, over_horizon)
    frames = frames_of(world, 7, seed=7)
    actions = actions_of((77, 5, ACTION), seed=8)
    shared = world.shared_rollout_costs(frames[np.array([4])], frames, actions)
    starts = frames[np.full(len(frames), 4)]
    alone = world.rollout_costs(starts, frames, np.stack([actions] * len(frames)))
    np.testing.assert_array_equal(shared, alone)
    assert shared.std() > 0
    # Nor does it matter what else is in the batch.
    one = world.rollout_costs(starts[np.array([2])], frames[np.array([2])], actions[None, 5:6])
    assert one[0, 0] == shared[2, 5]


def test_a_part_that_the_hand_does_not_come_near_stays(dynamics: LayerDynamics) -> None:
    world = LayerWorld(dynamics)
    frames = frames_of(world, 1, seed=9)
    states = frames.states
    states[0, ACTION + 2 :] = [500.0, 500.0, 1.0] * PARTS
    far = world.native.frames(
        frames.images,
        np.zeros((1, SIZE, SIZE, 3), np.float32),
        np.zeros((1, PARTS, SIZE, SIZE), bool),
        states,
    )
    path = world.native.rollout(far, actions_of((1, 20, 10, ACTION), seed=10))
    np.testing.assert_array_equal(
        path[..., ACTION + 2 :], np.broadcast_to(states[0, ACTION + 2 :], (1, 20, 10, 9))
    )


def test_predicted_frames_are_drawn_rollouts(dynamics: LayerDynamics) -> None:
    world = LayerWorld(dynamics)
    drawn = Drawn(world, 2, seed=11)
    actions = actions_of((2, 3, ACTION), seed=12)
    found = world.predict(drawn.frames, actions)
    assert found.shape == (2, 3, SIZE, SIZE, 3)
    for i in range(2):
        path = torch_rollout(dynamics, drawn.states[i], actions[i : i + 1])[0]
        np.testing.assert_allclose(found[i], 255 * drawn.draw(i, path), atol=0.51)


def test_an_action_that_is_no_number_has_a_cost_that_is_none(dynamics: LayerDynamics) -> None:
    world = LayerWorld(dynamics)
    frames = frames_of(world, 2, seed=13)
    actions = actions_of((2, 20, 4, ACTION), seed=14)
    good = world.rollout_costs(frames, frames, actions.copy())
    actions[1, 3, 2, 0] = np.nan
    bad = world.rollout_costs(frames, frames, actions)
    assert np.isnan(bad[1, 3])
    bad[1, 3] = good[1, 3]
    np.testing.assert_array_equal(bad, good)


def test_observed_frames_are_what_perception_sees(dynamics: LayerDynamics) -> None:
    world = LayerWorld(dynamics)
    assert isinstance(world, WorldModel)
    assert isinstance(world, RolloutSharer)
    assert isinstance(world, Observer)
    np.testing.assert_array_equal(world.action_low, -np.ones(ACTION))
    np.testing.assert_array_equal(world.action_high, np.ones(ACTION))
    images = np.random.default_rng(15).integers(0, 256, (70, SIZE, SIZE, 3), dtype=np.uint8)
    with torch.inference_mode():
        scene = dynamics.perception.scene(torch.from_numpy(images))
        still = dynamics.perception.draw(scene, scene.states).permute(0, 2, 3, 1)
    frames = world.observe(images)
    assert len(frames) == 70
    np.testing.assert_array_equal(frames.images, images)
    np.testing.assert_allclose(frames.states, scene.states, atol=1e-4)
    np.testing.assert_allclose(world.native.draw(frames, frames.states), still, atol=2e-3)


def test_a_changed_scene_looks_as_its_states_are_drawn(dynamics: LayerDynamics) -> None:
    world = LayerWorld(dynamics)
    scene = world.observe(random_images(1, seed=15))
    states = random_states(5, seed=16)
    frames = world.changed(scene, states)
    np.testing.assert_array_equal(frames.states, states)
    from_scene = world.native.draw(scene[np.zeros(5, np.int64)], states)
    np.testing.assert_allclose(frames.images, 255 * from_scene, atol=0.51)
    as_they_are = world.native.draw(frames, states)
    np.testing.assert_allclose(frames.images, 255 * as_they_are, atol=0.51)
    with pytest.raises(ValueError, match=r"states: expected shape \[N, 14\]"):
        world.changed(scene, states[:, :5])
    with pytest.raises(ValueError, match="states: must be finite"):
        world.changed(scene, np.full_like(states, np.nan))
    with pytest.raises(ValueError, match="scene: expected one frame, got 5"):
        world.changed(frames, states)


def test_the_planner_searches_subgoals_the_same_with_and_without_savings(
    dynamics: LayerDynamics,
) -> None:
    world = LayerWorld(dynamics, blur=1.0)

    class Anything:
        latent_dim = 2

        def decode(
            self, scene: hvf_core.LayerFrames, latents: NDArray[np.float32]
        ) -> hvf_core.LayerFrames:
            flat = latents.reshape(-1, 2)
            states = np.repeat(random_states(1, seed=17), len(flat), axis=0)
            states[:, :2] += flat
            return world.changed(scene, states)

    start, goal = (world.observe(random_images(1, seed=seed)) for seed in (18, 19))
    mpc = hvf_core.VisualMPC(horizon=4, samples=20, elites=4, iterations=2, action_repeat=2)
    found = [
        hvf_core.HVF(
            mpc=mpc, subgoals=2, samples=10, elites=3, iterations=2, prune=saved,
            share_rollouts=saved,
        ).search(world, Anything(), start, goal, seed=1)
        for saved in (True, False)
    ]  # fmt: skip
    assert found[0].cost == found[1].cost
    np.testing.assert_array_equal(found[0].latents, found[1].latents)


def test_results_do_not_depend_on_the_number_of_threads(
    outputs_by_threads: Callable[[str], set[str]],
) -> None:
    program = (
        "import sys, numpy as np, torch\n"
        "sys.path.insert(0, 'tests')\n"
        "from test_desk_layers import *\n"
        "torch.set_num_threads(1)\n"
        "world = LayerWorld(random_dynamics())\n"
        "frames = frames_of(world, 4, seed=20)\n"
        "actions = actions_of((4, 150, 6, 3), seed=21)\n"
        "costs = world.rollout_costs(frames, frames, actions)\n"
        "shared = world.shared_rollout_costs(frames[np.array([1])], frames, actions[0])\n"
        "path = world.native.rollout(frames, actions)\n"
        "print(*(x.tobytes().hex() for x in (costs, shared, path)))\n"
    )
    assert len(outputs_by_threads(program)) == 1


def _arguments(dynamics: LayerDynamics) -> dict[str, Any]:
    """What the native world is made of."""
    made: dict[str, Any] = {}

    class Recorded:
        def __init__(self, **arguments: Any) -> None:
            made.update(arguments)

    native = hvf_core.LayerWorld
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hvf_core, "LayerWorld", Recorded)
        LayerWorld(dynamics)
    native(**made)
    return made


def _with_nan(x: NDArray[np.float32]) -> NDArray[np.float32]:
    bad = x.copy()
    bad.flat[0] = np.nan
    return bad


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("hand", lambda layers: []),
        ("hand", lambda layers: layers[:1]),
        ("hand", lambda layers: [(_with_nan(layers[0][0]), layers[0][1]), *layers[1:]]),
        ("hand", lambda layers: [(layers[0][0], layers[0][1][1:]), *layers[1:]]),
        ("sliders", lambda networks: networks[:1]),
        ("sliders", lambda networks: [networks[0][1:], networks[1]]),
        ("parts", lambda layers: layers[1:]),
        ("parts", lambda layers: [*layers[:-1], (layers[-1][0][:2], layers[-1][1][:2])]),
        ("contact", lambda x: x[1:]),
        ("contact", _with_nan),
        ("reach", lambda x: 0.0),
        ("reach", lambda x: float("nan")),
        ("arm_low", lambda x: [float("nan"), 0.0, 0.0]),
        ("arm_step", lambda x: [1.0, 0.0, 1.0]),
        ("arm_places", lambda x: [4, 15, 1]),
        ("arm_patches", lambda x: x[:, 1:]),
        ("arm_patches", lambda x: x[1:]),
        ("arm_index", lambda x: x[1:]),
        ("arm_index", lambda x: x - 1),
        ("arm_index", lambda x: x + 300),
        ("table", lambda x: x[:1]),
        ("table", lambda x: x[:, :, :, :16]),
        ("table", lambda x: x[..., :20, :20]),
        ("arm_index", lambda x: x[:, :4]),
        ("sprites", lambda x: x[:, :3]),
        ("sprites", lambda x: x[..., :6]),
        ("sprites", lambda x: x[:0]),
        ("sprites", _with_nan),
        ("blur", lambda x: -1.0),
        ("blur", lambda x: float("inf")),
        ("over_horizon", lambda x: "mean"),
    ],
)
def test_weights_that_do_not_fit_are_refused_by_name(
    dynamics: LayerDynamics, name: str, change: Callable[[Any], Any]
) -> None:
    arguments = _arguments(dynamics)
    arguments[name] = change(arguments[name])
    with pytest.raises(ValueError, match=f"^{name}: "):
        hvf_core.LayerWorld(**arguments)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("images", lambda x: x[:, 1:]),
        ("clean", lambda x: x[:1]),
        ("clean", _with_nan),
        ("regions", lambda x: x[:, 1:]),
        ("states", lambda x: x[:, 1:]),
        ("states", _with_nan),
    ],
)
def test_frames_that_do_not_belong_together_are_refused(
    dynamics: LayerDynamics, name: str, change: Callable[[Any], Any]
) -> None:
    native = LayerWorld(dynamics).native
    arguments = {
        "images": np.zeros((2, SIZE, SIZE, 3), np.uint8),
        "clean": np.zeros((2, SIZE, SIZE, 3), np.float32),
        "regions": np.zeros((2, PARTS, SIZE, SIZE), bool),
        "states": np.zeros((2, 14), np.float32),
    }
    assert len(native.frames(**arguments)) == 2
    arguments[name] = change(arguments[name])
    with pytest.raises(ValueError, match=f"^{name}: "):
        native.frames(**arguments)


def test_bad_calls_are_refused_by_name(dynamics: LayerDynamics) -> None:
    one, other = LayerWorld(dynamics), LayerWorld(dynamics)
    frames = frames_of(one, 2, seed=22)
    with pytest.raises(ValueError, match="starts: are frames of another world"):
        other.rollout_costs(frames, frames, actions_of((2, 3, 2, ACTION), 0))
    with pytest.raises(ValueError, match="actions: expected 2 problems, got 3"):
        one.rollout_costs(frames, frames, actions_of((3, 3, 2, ACTION), 0))
    with pytest.raises(ValueError, match="actions: expected 3 action dimensions, got 2"):
        one.shared_rollout_costs(frames[np.array([0])], frames, actions_of((3, 2, 2), 0))
    with pytest.raises(ValueError, match="start: expected 1 frame, got 2"):
        one.shared_rollout_costs(frames, frames, actions_of((3, 2, ACTION), 0))
    with pytest.raises(ValueError, match=r"states: expected shape \[2, 14\]"):
        one.native.draw(frames, np.zeros((1, 14), np.float32))
    with pytest.raises(IndexError, match=r"index: .* is beyond 2 frames"):
        frames[np.array([2])]
    with pytest.raises(ValueError, match=r"images: expected shape \[N, 32, 32, 3\]"):
        one.observe(np.zeros((1, 64, 64, 3), np.uint8))
    with pytest.raises(TypeError, match="images: must be uint8"):
        one.observe(np.zeros((1, 32, 32, 3), np.float32))  # type: ignore[arg-type]
