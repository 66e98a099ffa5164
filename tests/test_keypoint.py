"""The compact dynamics model: Rust against torch, closed-form costs against drawn frames."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter, map_coordinates

import hvf
import hvf_core

torch = pytest.importorskip("torch")

from hvf.models.frames import to_unit  # noqa: E402
from hvf.models.keypoint.cell import Cell, CellConfig  # noqa: E402
from hvf.models.keypoint.dynamics import DynamicsConfig, KeypointDynamics  # noqa: E402
from hvf.models.keypoint.generator import GeneratorConfig, KeypointGenerator  # noqa: E402
from hvf.models.keypoint.perception import KeypointPerception, PerceptionConfig  # noqa: E402
from hvf.worlds.keypoint import KeypointSubgoals, KeypointWorld  # noqa: E402


@pytest.fixture(scope="module")
def dynamics() -> KeypointDynamics:
    torch.manual_seed(3)
    config = DynamicsConfig(cell=CellConfig(hidden=24, taps=5, spacing=3, substeps=3, memory=4))
    model = KeypointDynamics(config).fit_backgrounds(torch.rand(4, 8, 8))
    with torch.no_grad():
        model.perception.log_half_size.copy_(torch.tensor([2.3, 2.8]).log())
        model.perception.log_edge.copy_(torch.tensor([1.0, 1.7]).log())
        model.cell.output.weight.mul_(10.0)
        model.cell.free.weight.normal_(std=4.0)
    return model.eval()


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    images, _, _ = hvf_core.maze_collect(5, 0, 6, 1)
    return images[:, 0]


def actions_of(shape: tuple[int, ...], seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-3, 3, shape).astype(np.float32)


def test_rollouts_in_rust_are_those_of_torch(dynamics, frames):
    world = KeypointWorld(dynamics)
    observed = world.observe(frames)
    actions = actions_of((2, 37, 6, 2), 0)
    starts = observed[np.array([2, 5])]
    found = world.native.rollout(starts, actions)
    with torch.inference_mode():
        keypoints = torch.from_numpy(starts.keypoints)[:, None].expand(-1, 37, -1)
        expected = dynamics.rollout(
            keypoints, torch.from_numpy(starts.maps), torch.from_numpy(actions)
        )
    # Some leave the image: its border goes on there.
    assert (expected < 0).any() or (expected > 63).any()
    np.testing.assert_allclose(found, expected.numpy(), atol=2e-3)


def test_a_cell_sees_the_same_wherever_in_the_scene_it_is():
    torch.manual_seed(0)
    cell = Cell(CellConfig(), action_dim=2)
    scene = torch.randn(1, 64, 64)
    moved = scene.roll((5, -7), dims=(1, 2))
    points, actions = torch.full((1, 1, 2), 31.3), torch.rand(1, 1, 2)
    with torch.inference_mode():
        here = cell(cell.smooth(scene), points, actions) - points
        shift = torch.tensor([5.0, -7.0])
        there = cell(cell.smooth(moved), points + shift, actions) - points - shift
    np.testing.assert_allclose(here, there, atol=1e-4)


def test_patches_are_bilinear_interpolation_of_a_scene_whose_border_goes_on():
    cell = Cell(CellConfig(taps=3, spacing=4), action_dim=2)
    scene = np.random.default_rng(0).standard_normal((12, 10)).astype(np.float32)
    points = np.random.default_rng(1).uniform(0, 9, (6, 2)).astype(np.float32)
    found = cell.patches(
        torch.from_numpy(scene[:10])[None], torch.from_numpy(points)[None]
    ).numpy()[0]
    for point, patch in zip(points, found, strict=True):
        grid = point[:, None] + np.array([-4.0, 0.0, 4.0])
        rows, columns = np.meshgrid(*grid, indexing="ij")
        expected = map_coordinates(scene[:10], [rows, columns], order=1, mode="nearest")
        np.testing.assert_allclose(patch, expected.ravel(), atol=1e-4)


@pytest.mark.parametrize("blur", [0.0, 2.5])
@pytest.mark.parametrize("over_horizon", ["last", "sum", "min"])
def test_costs_in_closed_form_are_those_of_drawn_frames(dynamics, frames, blur, over_horizon):
    world = KeypointWorld(dynamics, blur, over_horizon)
    observed = world.observe(frames)
    starts, goals = observed[np.array([0, 1])], observed[np.array([3, 4])]
    actions = actions_of((2, 5, 4, 2), 1)
    found = world.rollout_costs(starts, goals, actions)
    for b in range(2):
        path = torch.from_numpy(world.native.rollout(starts, actions)[b])
        image = to_unit(torch.from_numpy(starts.images[b : b + 1]))
        keypoint = torch.from_numpy(starts.keypoints[b : b + 1])
        goal = goals.images[b] / 255.0
        for d in range(5):
            costs = []
            for h in range(4):
                with torch.inference_mode():
                    drawn = dynamics.draw(image, keypoint, path[d, h : h + 1])
                difference = drawn[0].permute(1, 2, 0).double().numpy() - goal
                if blur:
                    difference = gaussian_filter(difference, (blur, blur, 0))
                costs.append((difference**2).sum(axis=2).mean())
            expected = {"last": costs[-1], "sum": sum(costs), "min": min(costs)}[over_horizon]
            assert found[b, d] == pytest.approx(expected, rel=1e-4, abs=1e-7)


def test_a_subgoal_search_in_the_learned_world_does_not_depend_on_the_exact_savings(
    dynamics, frames
):
    world = KeypointWorld(dynamics, blur=2.0)
    generator = KeypointSubgoals(KeypointGenerator(GeneratorConfig(scene_dim=5)), world)
    mpc = hvf_core.VisualMPC(horizon=3, samples=32, elites=8, iterations=2)
    results = []
    for exact_savings in (True, False):
        search = hvf_core.HVF(
            mpc=mpc,
            subgoals=2,
            samples=24,
            elites=6,
            iterations=2,
            prune=exact_savings,
            share_rollouts=exact_savings,
        )
        results.append(search.search(world, generator, frames[0], frames[1], seed=4))
    first, second = results
    assert first.cost == second.cost
    np.testing.assert_array_equal(first.latents, second.latents)
    np.testing.assert_array_equal(first.subgoals.images, second.subgoals.images)


def test_perception_finds_what_moves_from_unlabelled_pairs():
    images, _, states = hvf_core.maze_collect(11, 0, 40, 8, 32)
    torch.manual_seed(0)
    model = KeypointPerception(PerceptionConfig(image_size=32, sprite_from=150))
    optimiser = torch.optim.Adam(model.parameters(), lr=1e-2)
    frames = torch.from_numpy(images)
    draw = torch.Generator().manual_seed(1)
    for step in range(300):
        episode = torch.randint(0, 40, (16,), generator=draw)
        times = torch.randint(0, 9, (2, 16), generator=draw)
        batch = {"scene": frames[episode, times[0]], "image": frames[episode, times[1]]}
        loss, _ = model.loss(batch, draw, step)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    with torch.inference_mode():
        found = model.keypoints(to_unit(frames[:, 0])).numpy()
    scale = 32 / 0.64
    truth = np.stack([(0.32 - states[:, 0, 1]) * scale, (states[:, 0, 0] + 0.32) * scale], 1) - 0.5
    assert np.median(np.linalg.norm(found - truth, axis=1)) < 0.1


def test_generated_subgoals_are_the_scene_with_the_sprite_moved(dynamics, frames):
    world = KeypointWorld(dynamics)
    generator = KeypointSubgoals(KeypointGenerator(GeneratorConfig(scene_dim=5)), world)
    scene = world.observe(frames[:1])
    latents = np.random.default_rng(0).standard_normal((4, 2, 8)).astype(np.float32)
    drawn = generator.decode(scene, latents)
    assert len(drawn) == 8
    with torch.inference_mode():
        expected = dynamics.draw(
            to_unit(torch.from_numpy(frames[:1])),
            torch.from_numpy(scene.keypoints),
            torch.from_numpy(drawn.keypoints),
        )
    np.testing.assert_allclose(
        drawn.images.transpose(0, 3, 1, 2), expected.clamp(0, 1).numpy() * 255, atol=0.51
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"patch": np.zeros((24, 16), np.float32)}, "patch"),
        ({"patch": np.zeros((22, 25), np.float32)}, "patch"),
        ({"context": np.zeros((24, 5), np.float32)}, "context"),
        ({"middle": np.zeros((24, 20), np.float32)}, "middle"),
        ({"free": np.zeros((2, 0), np.float32)}, "free"),
        ({"output": np.zeros((1, 24), np.float32)}, "output"),
        ({"spacing": 0}, "spacing"),
        ({"substeps": 0}, "substeps"),
        ({"output_bias": np.full(6, np.nan, np.float32)}, "output_bias"),
        ({"action_scale": 0.0}, "action_scale"),
        ({"half_size": [0.0, 1.0]}, "half_size"),
        ({"edge": [1.0, float("inf")]}, "edge"),
        ({"half_size": [30.0, 1.0]}, "half_size"),
        ({"action_low": [-1.0]}, "action_high"),
        ({"image_size": 1}, "image_size"),
        ({"blur": -1.0}, "blur"),
        ({"over_horizon": "mean"}, "over_horizon"),
    ],
)
def test_weights_that_do_not_fit_are_refused_by_name(change, message):
    arguments = {
        "patch": np.zeros((24, 25), np.float32),
        "patch_bias": np.zeros(24, np.float32),
        "context": np.zeros((24, 6), np.float32),
        "middle": np.zeros((24, 24), np.float32),
        "middle_bias": np.zeros(24, np.float32),
        "output": np.zeros((6, 24), np.float32),
        "output_bias": np.zeros(6, np.float32),
        "free": np.zeros((2, 2), np.float32),
        "action_scale": 3.0,
        "spacing": 2,
        "substeps": 4,
        "half_size": [2.5, 2.5],
        "edge": [1.0, 1.0],
        "colour": [0.1, 0.6, 0.0],
        "action_low": [-3.0, -3.0],
        "action_high": [3.0, 3.0],
        "image_size": 64,
    }
    hvf_core.KeypointWorld(**arguments)
    with pytest.raises(ValueError, match=message):
        hvf_core.KeypointWorld(**{**arguments, **change})


@settings(max_examples=30, deadline=None)
@given(
    count=st.integers(0, 3),
    keypoint_rows=st.integers(0, 3),
    map_rows=st.integers(0, 3),
    map_size=st.sampled_from([64, 32]),
    bad=st.sampled_from([None, np.nan, np.inf]),
)
def test_frames_that_do_not_belong_together_are_refused(
    dynamics, count, keypoint_rows, map_rows, map_size, bad
):
    world = KeypointWorld(dynamics).native
    images = np.zeros((count, 64, 64, 3), np.uint8)
    keypoints = np.zeros((keypoint_rows, 2), np.float32)
    maps = np.zeros((map_rows, map_size, map_size), np.float32)
    if bad is not None and keypoints.size:
        keypoints[0, 0] = bad
    if count == keypoint_rows == map_rows and map_size == 64 and (bad is None or not count):
        frames = world.frames(images, keypoints, maps)
        assert len(frames) == count
        if count == 1:
            assert len(frames.moved(np.zeros((2, 64, 64, 3), np.uint8), keypoints[[0, 0]])) == 2
        else:
            with pytest.raises(ValueError, match="expected 1 frame"):
                frames.moved(images, keypoints)
    else:
        with pytest.raises(ValueError, match=r"keypoints|maps"):
            world.frames(images, keypoints, maps)


def test_frames_of_another_world_are_refused(dynamics, frames):
    one, other = KeypointWorld(dynamics), KeypointWorld(dynamics)
    with pytest.raises(ValueError, match="another world"):
        one.native.rollout(other.observe(frames[:1]), actions_of((1, 3, 2, 2), 0))


def test_images_of_another_size_are_refused(dynamics):
    world = KeypointWorld(dynamics)
    with pytest.raises(ValueError, match="images"):
        world.observe(np.zeros((1, 32, 32, 3), np.uint8))
    with pytest.raises(TypeError, match="uint8"):
        world.observe(np.zeros((1, 64, 64, 3), np.float32))


def test_a_search_with_the_shipped_models_does_not_depend_on_the_number_of_threads(
    outputs_by_threads: Callable[[str], set[str]],
) -> None:
    program = (
        "import numpy as np, torch, hvf_core\n"
        "import hvf\n"
        "torch.set_num_threads(1)\n"
        "world, generator = hvf.load('maze')\n"
        "starts, targets = hvf_core.maze_episodes(0, 0, 1, 'hard')\n"
        "start = hvf_core.maze_render(starts)[0]\n"
        "goal = hvf_core.maze_render(np.concatenate([targets, starts[:, 2:]], 1))[0]\n"
        "hvf = hvf_core.HVF(mpc=hvf_core.VisualMPC(samples=40, elites=8), samples=20, elites=5)\n"
        "out = hvf.search(world, generator, start, goal)\n"
        "print(out.cost.hex(), out.latents.tobytes().hex())\n"
    )
    assert len(outputs_by_threads(program)) == 1


def test_the_shipped_dynamics_predict_the_simulator() -> None:
    world, _ = hvf.load("maze")
    images, actions, states = hvf_core.maze_collect(1_000_000_011, 0, 60, 5)
    path = world.native.rollout(world.observe(images[:, 0]), actions[:, None])[:, 0]
    # Pixels of 1 cm from the middle of an image that shows 0.64 m.
    truth = np.stack([32 - 100 * states[:, 1:, 1], 32 + 100 * states[:, 1:, 0]], axis=2) - 0.5
    missed = np.linalg.norm(path - truth, axis=2)
    assert np.median(missed[:, 0]) < 0.2
    assert np.median(missed[:, 4]) < 0.4
    assert np.mean(missed[:, 4] > 2.5) < 0.12
