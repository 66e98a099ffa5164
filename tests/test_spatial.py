"""The spatial latent model: its arithmetic against slow NumPy, its loss, and what it learns."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest

pytest.importorskip("torch")

import torch
from scipy.ndimage import gaussian_filter
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

import hvf_core
from convolving import slow_convolution
from hvf.cli import main
from hvf.data.episodes import Episodes, Metadata
from hvf.data.formats.hdf5 import write_episodes
from hvf.data.loader import EpisodePool, WindowSampler
from hvf.models.checkpoint import load_any, save_model
from hvf.models.frames import to_unit
from hvf.models.spatial import SpatialConfig, SpatialLatent
from hvf.models.spatial.network import Decoder, Dynamics, Encoder
from hvf.settings import Planning
from hvf.training.loop import seeded
from hvf.training.recipe import recipe_class
from hvf.worlds.video import VideoWorld, world_of

TINY = SpatialConfig(
    image_size=(16, 24), action_low=(-2, -1, 0), action_high=(2, 3, 1), widths=(4, 5, 6),
    blocks=2, known=7, blur=1.5,
)  # fmt: skip


def made(config: SpatialConfig = TINY) -> SpatialLatent:
    return seeded(0, lambda: SpatialLatent(config)).eval()


def values(*tensors: torch.Tensor) -> list[np.ndarray]:
    return [tensor.detach().numpy().astype(np.float64) for tensor in tensors]


def convolved(layer: nn.Module, x: np.ndarray) -> np.ndarray:
    assert isinstance(layer, nn.Conv2d)
    assert layer.bias is not None
    return slow_convolution(x, *values(layer.weight, layer.bias), stride=layer.stride[0])


def rectified(x: np.ndarray) -> np.ndarray:
    return np.maximum(x, 0)


def shuffled(x: np.ndarray) -> np.ndarray:
    """Four numbers of each channel in a row become four pixels."""
    out = np.empty((len(x) // 4, 2 * x.shape[1], 2 * x.shape[2]))
    for k in range(4):
        out[:, k // 2 :: 2, k % 2 :: 2] = x[k::4]
    return out


# ---- arithmetic --------------------------------------------------------------------------------


def test_the_encoder_halves_and_keeps_every_size() -> None:
    torch.manual_seed(0)
    encoder, images = Encoder((4, 5, 6)), torch.rand(2, 3, 16, 24)
    found = encoder(images)
    assert [part.shape[1:] for part in found] == [(4, 8, 12), (5, 4, 6), (6, 2, 3)]
    for n in range(2):
        x = values(images[n])[0] - 0.5
        for level, features in zip(encoder.levels, found, strict=True):
            x = rectified(convolved(level[0], x))
            if features is found[-1]:
                first, _, second = encoder.block
                x = x + convolved(second, rectified(convolved(first, x)))
            np.testing.assert_allclose(features[n].detach(), x, atol=1e-5)


def test_dynamics_are_convolutions_and_a_network_that_sees_the_whole_grid() -> None:
    torch.manual_seed(0)
    dynamics = Dynamics(4, (3, 5), 2, blocks=2, known=7)
    grid, units = torch.randn(2, 4, 3, 5), torch.rand(2, 2)
    found = dynamics(grid, units)
    for n in range(2):
        cells = values(grid[n])[0]
        known = np.concatenate([units[n].numpy(), convolved(dynamics.squeeze, cells).flatten()])
        for layer in (dynamics.known[0], dynamics.known[2]):
            weight, bias = values(layer.weight, layer.bias)
            known = rectified(weight @ known + bias)
        weight, bias = values(dynamics.paint.weight, dynamics.paint.bias)
        painted = (weight @ known + bias).reshape(3, 5, 4).transpose(2, 0, 1)
        hidden = rectified(convolved(dynamics.input, cells) + painted)
        for block in dynamics.blocks:
            weight, bias = values(block.acted.weight, block.acted.bias)
            gain, shift = np.split(weight @ known + bias, 2)
            between = convolved(block.first, hidden) * (1 + gain[:, None, None])
            between = rectified(between + shift[:, None, None])
            hidden = rectified(hidden + convolved(block.second, between))
        np.testing.assert_allclose(found[n].detach(), convolved(dynamics.output, hidden), atol=1e-4)


def test_the_decoder_doubles_and_adds_what_was_seen() -> None:
    torch.manual_seed(0)
    decoder = Decoder((4, 5, 6))
    features = [torch.randn(2, 4, 8, 12), torch.randn(2, 5, 4, 6), torch.randn(2, 6, 2, 3)]
    grid = torch.randn(2, 6, 2, 3)
    colours, mask = decoder(grid, decoder.seen(features))
    assert colours.shape == (2, 3, 16, 24)
    for n in range(2):
        skips = [
            convolved(skip, values(feature[n])[0])
            for skip, feature in zip(decoder.skips, features[::-1], strict=True)
        ]
        hidden = rectified(convolved(decoder.first, values(grid[n])[0]) + skips[0])
        for larger, here, skip in zip(decoder.larger, decoder.here, skips[1:], strict=True):
            hidden = rectified(shuffled(convolved(larger, hidden)) + skip)
            hidden = rectified(hidden + convolved(here, hidden))
        drawn = shuffled(convolved(decoder.last, hidden))
        np.testing.assert_allclose(colours[n].detach(), drawn[:3], atol=1e-4)
        np.testing.assert_allclose(mask[n].detach(), drawn[3:], atol=1e-4)


def test_a_frame_is_drawn_over_the_first_one() -> None:
    model = made()
    first = torch.rand(2, 1, 3, 16, 24)
    state = model.start(first, torch.zeros(2, 0, 3))
    colours, mask = values(*model.decoder(state[0], state[2:]))
    part = 1 / (1 + np.exp(-mask))
    expected = part * (colours + 0.5) + (1 - part) * values(first[:, 0])[0]
    np.testing.assert_allclose(model.drawn(state).detach(), expected, atol=1e-5)
    np.testing.assert_allclose(model.images(state).detach(), expected.clip(0, 1), atol=1e-5)


def test_a_step_is_a_change_by_the_action_in_its_box() -> None:
    model = made()
    state = model.start(torch.rand(2, 1, 3, 16, 24), torch.zeros(2, 0, 3))
    before = [part.clone() for part in state]
    action = torch.tensor([[2.0, 1.0, 0.25], [-2.0, 3.0, 1.0]])
    units = torch.tensor([[1.0, 0.0, -0.5], [-1.0, 1.0, 1.0]])
    after = model.step(state, action, None)
    torch.testing.assert_close(after[0], state[0] + model.dynamics(state[0], units))
    for part, same, old in zip(after[1:], state[1:], before[1:], strict=True):
        assert part is same
        assert same.equal(old)
    assert state[0].equal(before[0])


@pytest.mark.parametrize(("blur", "weight", "sharp"), [(1.5, 4.0, 3.0), (0.0, 1.0, 0.0)])
def test_the_loss_is_of_sharp_and_blurred_frames_and_weighs_what_changes(
    blur: float, weight: float, sharp: float
) -> None:
    config = dataclasses.replace(
        TINY, blur=blur, blur_weight=weight, change_weight=sharp, change=0.3, drawn=2
    )
    model, batch = made(config), clips(config=config)
    loss, parts = model.loss(batch, torch.Generator().manual_seed(1), 0)
    compared = torch.randperm(4, generator=torch.Generator().manual_seed(1))[:2].tolist()
    frames = batch["frames"].numpy() / 255
    state = model.start(to_unit(batch["frames"][:, 0])[:, None], torch.zeros(5, 0, 3))
    losses, errors, changes = [], [], []
    for time in range(4):
        state = model.step(state, batch["actions"][:, time], None)
        error = values(model.drawn(state))[0].transpose(0, 2, 3, 1) - frames[:, time + 1]
        change = frames[:, time + 1] - frames[:, 0]
        weighed = (error**2).mean(-1) * (1 + sharp * np.minimum(np.abs(change).max(-1) / 0.3, 1))
        smooth = gaussian_filter(error, (0, blur, blur, 0))
        losses.append(weighed.mean() + weight * (smooth**2).mean())
        errors.append((error**2).mean())
        changes.append((change**2).mean())
    assert loss.item() == pytest.approx(np.mean(np.take(losses, compared)), rel=1e-4)
    assert parts["mse"].item() == pytest.approx(np.mean(np.take(errors, compared)), rel=1e-4)
    assert parts["still"].item() == pytest.approx(np.mean(np.take(changes, compared)), rel=1e-4)


def clips(count: int = 5, steps: int = 4, config: SpatialConfig = TINY) -> dict[str, torch.Tensor]:
    rng = np.random.default_rng(0)
    shape = (count, steps + 1, *config.image_size, 3)
    actions = rng.uniform(config.action_low, config.action_high, (count, steps, 3))
    return {
        "frames": torch.from_numpy(rng.integers(0, 256, shape, dtype=np.uint8)),
        "actions": torch.from_numpy(actions.astype(np.float32)),
    }


# ---- shapes ------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(64, 64), (48, 64), (8, 16)])
def test_any_size_that_the_cells_divide(size: tuple[int, int]) -> None:
    model = made(dataclasses.replace(TINY, image_size=size))
    state = model.start(torch.rand(2, 1, 3, *size), torch.zeros(2, 0, 3))
    assert state[0].shape == (2, 6, size[0] // 8, size[1] // 8)
    images = model.images(model.step(state, torch.ones(2, 3), None))
    assert images.shape == (2, 3, *size)
    assert 0 <= images.min() <= images.max() <= 1
    batch = clips(1, 1, model.config)
    assert model.loss(batch, torch.Generator(), 0)[0].isfinite()


def test_it_has_the_size_that_the_documentation_says() -> None:
    model = made(SpatialConfig(action_low=(-1,) * 3, action_high=(1,) * 3))
    assert sum(weights.numel() for weights in model.parameters()) == 732076
    state = model.start(torch.rand(1, 1, 3, 64, 64), torch.zeros(1, 0, 3))
    counts = []
    for work in (
        lambda: model.step(state, torch.zeros(1, 3), None),
        lambda: model.images(state),
    ):
        with FlopCounterMode(display=False) as counted:
            work()
        counts.append(round(counted.get_total_flops() / 1e6, 1))
    assert counts == [12.3, 18.6]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"widths": (4,)}, "^widths must be two or more numbers"),
        ({"widths": (4, 0)}, "^widths must be two or more numbers"),
        ({"known": 0}, "^known must be at least 1, got 0"),
        ({"hold": 0}, "^hold must be at least 1, got 0"),
        ({"drawn": 0}, "^drawn must be at least 1, got 0"),
        ({"blocks": -1}, "^blocks must be finite and not negative"),
        ({"blur": math.nan}, "^blur must be finite and not negative"),
        ({"blur_weight": -1.0}, "^blur_weight must be finite and not negative"),
        ({"change_weight": math.inf}, "^change_weight must be finite and not negative"),
        ({"change": 0.0}, "^change must be positive"),
        ({"image_size": (20, 24)}, r"^image_size must be multiples of 8, got \(20, 24\)"),
    ],
)
def test_bad_configs_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(TINY, **change)


# ---- planning ----------------------------------------------------------------------------------


def problems(candidates: int = 30, steps: int = 6) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    starts, goals = rng.integers(0, 256, (2, 3, 16, 24, 3), dtype=np.uint8)
    shape = (3, candidates, steps // 3, 3)
    actions = rng.uniform(TINY.action_low, TINY.action_high, shape).repeat(3, axis=2)
    return starts, goals, actions.astype(np.float32)


def world(model: SpatialLatent) -> VideoWorld:
    return VideoWorld(model, blur=1.5, over_horizon="last", action_repeat=3, device="cpu")


def test_costs_are_those_of_the_frames_after_held_actions() -> None:
    model = made(dataclasses.replace(TINY, hold=3))
    starts, goals, actions = problems()
    planned = world(model)
    costs = planned.rollout_costs(planned.observe(starts), planned.observe(goals), actions)
    for b in range(3):
        state = model.start(
            to_unit(torch.from_numpy(starts[b : b + 1]))[:, None], torch.zeros(1, 0, 3)
        )
        state = tuple(part.expand(30, *part.shape[1:]) for part in state)
        for time in (0, 3):
            state = model.step(state, torch.from_numpy(actions[b, :, time]), None)
        apart = values(model.images(state))[0] - goals[b].transpose(2, 0, 1) / 255
        expected = np.square(gaussian_filter(apart, (0, 0, 1.5, 1.5))).sum((1, 2, 3)) / (16 * 24)
        np.testing.assert_allclose(costs[b], expected, rtol=1e-4)


def test_a_plan_is_the_same_alone_and_in_a_batch() -> None:
    starts, goals, _ = problems()
    planned = world(made(dataclasses.replace(TINY, hold=3)))
    mpc = hvf_core.VisualMPC(horizon=6, samples=40, elites=5, iterations=2, action_repeat=3)
    seen, wanted = planned.observe(starts), planned.observe(goals)
    together = mpc.plan_batch(planned, seen, wanted, seeds=[4, 5, 6])
    for b in range(3):
        alone = mpc.plan(planned, seen[np.array([b])], wanted[np.array([b])], seed=4 + b)
        np.testing.assert_array_equal(alone.actions, together.actions[b])
        assert alone.cost == together.costs[b]


def test_actions_that_are_not_held_long_enough_are_refused() -> None:
    with pytest.raises(ValueError, match=r"^action_repeat: must be a multiple of 3.*got 2"):
        world_of(made(dataclasses.replace(TINY, hold=3)), Planning(horizon=4, action_repeat=2))


# ---- learning ----------------------------------------------------------------------------------

SIDE, HOLD = 16, 2


def pushing(episodes: int, steps: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A red hand that actions move along an image, and a blue box that it pushes before it.

    Actions are held for :data:`HOLD` steps.
    """
    rng = np.random.default_rng(seed)
    actions = rng.uniform(-1, 1, (episodes, steps // HOLD, 2)).repeat(HOLD, axis=1)
    hand, box = rng.uniform(2, 5, episodes), rng.uniform(6, 9, episodes)
    frames = np.zeros((episodes, steps + 1, SIDE, SIDE, 3), np.uint8)
    for step in range(steps + 1):
        if step:
            hand = np.clip(hand + 1.5 * actions[:, step - 1, 0], 1, SIDE - 6)
            box = np.maximum(box, hand + 3)
        for colour, place in ((0, hand), (2, box)):
            near = np.clip(2 - np.abs(np.arange(SIDE) - place[:, None]), 0, 1)
            frames[:, step, 4:12, :, colour] = np.rint(255 * near)[:, None]
    return frames, actions.astype(np.float32)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "pushing.h5"
    metadata = Metadata(
        "pushing", {"action_repeat": HOLD}, None, 12, 200, {},
        action_low=(-1.0, -1.0), action_high=(1.0, 1.0),
    )  # fmt: skip
    write_episodes(path, metadata, Episodes(*pushing(200, 12)))
    return path


@pytest.fixture(scope="module")
def run(data: Path) -> Path:
    out = data.parent / "run"
    words = ["train", "spatial-latent", "--data", str(data), "--out", str(out), "--length", "3"]
    words += ["--model.widths", "8", "16", "24", "--model.blur", "1", "--loop.threads", "1"]
    words += ["--loop.steps", "400", "--loop.learning-rate", "3e-3", "--loop.warmup-steps", "20"]
    assert main([*words, "--loop.device", "cpu"]) == 0
    return out


def test_what_is_pushed_is_predicted_to_go_along(run: Path) -> None:
    model = load_any(run / "model.safetensors").module
    assert isinstance(model, SpatialLatent)
    assert model.hold == HOLD
    frames, actions = pushing(200, 3 * HOLD, seed=9)
    first, truth = (to_unit(torch.from_numpy(frames[:, time])) for time in (0, -1))
    state = model.start(first[:, None], torch.zeros(200, 0, 2))
    with torch.inference_mode():
        for time in range(0, 3 * HOLD, HOLD):
            state = model.step(state, torch.from_numpy(actions[:, time]), None)
        drawn = model.images(state)
    moved = (truth - first)[:, 2].abs().amax((1, 2)) > 0.5
    assert 20 < moved.sum() < 180
    for colour, part in ((0, slice(None)), (2, moved)):
        error, still = ((images - truth)[part, colour].square().mean() for images in (drawn, first))
        assert error < 0.3 * still, colour


def test_it_is_trained_probed_and_planned_with_by_name(
    run: Path, data: Path, tmp_path: Path
) -> None:
    found = load_any(run / "model.safetensors")
    assert found.name == "spatial-latent"
    assert found.module.config.image_size == (SIDE, SIDE)
    assert found.module.config.action_low == (-1, -1)
    assert {"psnr_1", "psnr_3", "still_3"} <= set(found.header.training["validation"])
    words = ["probe", "--data", str(data), "--model", str(run / "model.safetensors")]
    words += ["--out", str(tmp_path / "probe"), "--horizon", "6", "--steps-ahead", "2", "6"]
    assert main(words) == 0
    assert iio.imread(tmp_path / "probe/strips.png").ndim == 3
    world = found.entry.resolved("plannable")(
        found.module, Planning(blur=1.0, horizon=4, action_repeat=HOLD)
    )
    frames, _ = pushing(2, 2)
    mpc = hvf_core.VisualMPC(horizon=4, samples=12, elites=3, iterations=2, action_repeat=HOLD)
    plan = mpc.plan(world, frames[0, :1], frames[1, 1:2], seed=0)
    assert np.isfinite(plan.cost)


def test_same_seed_same_weights_and_a_checkpoint_is_the_model(data: Path, tmp_path: Path) -> None:
    words = ["train", "spatial-latent", "--data", str(data), "--batch-size", "2"]
    words += ["--model.widths", "4", "4", "--loop.steps", "2", "--loop.device", "cpu"]
    for out in ("a", "b"):
        assert main([*words, "--out", str(tmp_path / out), "--loop.threads", "1"]) == 0
    first, second = (load_any(tmp_path / out / "model.safetensors").module for out in "ab")
    for name, value in first.state_dict().items():
        assert value.equal(second.state_dict()[name]), name
    save_model(tmp_path / "again.safetensors", first, environment="pushing")
    again = load_any(tmp_path / "again.safetensors").module
    assert again.config == first.config
    frames = torch.rand(2, 1, 3, SIDE, SIDE)
    images = [model.images(model.start(frames, torch.zeros(2, 0, 2))) for model in (first, again)]
    assert images[0].equal(images[1])


def test_windows_begin_where_actions_begin_that_are_held(data: Path) -> None:
    frames, actions = pushing(200, 12)
    pool = EpisodePool(data)
    batch = WindowSampler(pool, 300, 3, hold=HOLD).batch(0)
    assert batch["frames"].shape == (300, 4, SIDE, SIDE, 3)
    places = set()
    for clip, acted in zip(batch["frames"].numpy(), batch["actions"].numpy(), strict=True):
        episode, first = np.argwhere(actions[:, :, 0] == acted[0, 0])[0]
        assert first % HOLD == 0
        times = first + HOLD * np.arange(4)
        np.testing.assert_array_equal(clip, frames[episode, times])
        np.testing.assert_array_equal(acted, actions[episode, times[:3]])
        places.add(int(first))
    assert places == {0, 2, 4, 6}
    with pytest.raises(ValueError, match=r"^length must be from 1 to 6, got 7"):
        WindowSampler(pool, 1, 7, hold=HOLD)
    with pytest.raises(ValueError, match=r"^hold must be at least 1, got 0"):
        WindowSampler(pool, 1, 1, hold=0)


def test_data_that_does_not_fit_is_refused(data: Path, tmp_path: Path) -> None:
    recipe: Any = recipe_class("spatial-latent")
    with pytest.raises(ValueError, match=r"^batch_size must be at least 1, got 0"):
        recipe.of("default", data=data, batch_size=0)
    with pytest.raises(ValueError, match=r"^memory_gb must be positive"):
        recipe.of("desk", data=data, memory_gb=0.0)
    words = ["train", "spatial-latent", "--data", str(data), "--out", str(tmp_path)]
    assert main([*words, "--model.widths", "4", "4", "4", "4", "4"]) != 0
    assert main([*words, "--length", "7"]) != 0
