"""SV2P: its parts against slow NumPy, its schedules in closed form, and its training."""

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
from hypothesis import given
from hypothesis import strategies as st

import hvf_core
from convolving import slow_convolution
from hvf.cli import main
from hvf.data.episodes import Episodes, Metadata
from hvf.data.formats.hdf5 import write_episodes
from hvf.models.checkpoint import load_any, save_model
from hvf.models.frames import to_unit
from hvf.models.sv2p import SV2P, SV2PConfig, SV2PSmall
from hvf.models.sv2p.config import SMALL
from hvf.models.sv2p.layers import ConvLSTM, Down, MovedImages, Up, initialise, layer_norm
from hvf.models.sv2p.posterior import divergence
from hvf.registry import MODELS
from hvf.settings import Planning
from hvf.training.loop import seeded
from hvf.training.recipe import recipe_class
from hvf.worlds.video import VideoWorld, world_of

TINY = SV2PConfig(
    image_size=(16, 24), action_low=(-2, -1), action_high=(2, 3), stem=4,
    widths=(4, 4, 6, 6, 8, 6, 4), kernel=3, masks=4, move=3, posterior=(4, 4, 4), frames=4,
    posterior_from=2, kl_from=4, kl_weight=0.1, sampling_k=3.0,
)  # fmt: skip
SIZE = "--model.stem 4 --model.widths 4 4 4 4 4 4 4 --model.kernel 3 --model.masks 3 "
SIZE += "--model.posterior 4 4 4 --model.frames 4 --batch-size 3 --loop.threads 1"


def made(config: SV2PConfig = TINY, kind: type[SV2P] = SV2P) -> SV2P:
    return seeded(0, lambda: kind(config)).eval()


def clips(count: int = 5, config: SV2PConfig = TINY, seed: int = 0) -> dict[str, torch.Tensor]:
    rng = np.random.default_rng(seed)
    shape = (count, config.frames, *config.image_size, 3)
    actions = rng.uniform(config.action_low, config.action_high, (count, config.frames - 1, 2))
    return {
        "frames": torch.from_numpy(rng.integers(0, 256, shape, dtype=np.uint8)),
        "actions": torch.from_numpy(actions.astype(np.float32)),
    }


def values(*tensors: torch.Tensor) -> list[np.ndarray]:
    return [tensor.detach().numpy().astype(np.float64) for tensor in tensors]


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


# ---- architecture ------------------------------------------------------------------------------


def test_it_has_the_parameters_of_the_released_model() -> None:
    model = made(SV2PConfig())
    counts = {
        name: sum(weights.numel() for weights in part.parameters())
        for name, part in model.named_children()
    }
    lstms = [sum(w.numel() for w in lstm.parameters()) for lstm in model.lstms]
    assert lstms == [204928, 204928, 614656, 819456, 2458112, 1229056, 409728]
    norms = [sum(w.numel() for w in norm.parameters()) for norm in model.lstm_norms]
    assert norms == [64, 64, 128, 128, 256, 128, 64]
    expected = {
        "stem": 2432, "stem_norm": 64, "down1": 9248, "down2": 36928, "action_gain": 192,
        "action_shift": 192, "bottleneck": 4224, "up1": 147584, "up2": 83040, "up3": 36928,
        "up_norm": 128, "anew": 195, "masks": 715, "moved": 2048250, "posterior": 66434,
    }  # fmt: skip
    assert {name: counts[name] for name in expected} == expected
    body = [sum(w.numel() for w in layer.parameters()) for layer in model.posterior.body]
    assert body == [9536, 0, 64, 18496, 0, 128, 36928, 0, 128]
    assert sum(counts.values()) - counts["posterior"] == 8311816
    assert model.noise == 64


@pytest.mark.parametrize("size", [(64, 64), (48, 64), (8, 16)])
def test_any_size_that_8_divides(size: tuple[int, int]) -> None:
    model = made(dataclasses.replace(TINY, image_size=size))
    assert model.noise == size[0] * size[1] // 64
    state = model.start(torch.rand(2, 1, 3, *size), torch.zeros(2, 0, 2))
    noise = torch.randn(2, model.noise)
    later = model.step(model.step(state, torch.zeros(2, 2), noise), torch.ones(2, 2), noise)
    images = model.images(later)
    assert images.shape == (2, 3, *size)
    assert (images >= 0).all()
    assert (images <= 1 + 1e-6).all()
    with pytest.raises(ValueError, match=r"^image_size must be multiples of 8, got \(60, 64\)"):
        SV2PConfig(image_size=(60, 64))


def test_a_last_step_gives_the_same_image() -> None:
    model = made()
    state = model.start(torch.rand(3, 1, 3, 16, 24), torch.zeros(3, 0, 2))
    action, noise = torch.rand(3, 2), torch.randn(3, model.noise)
    whole, last = model.step(state, action, noise), model.step(state, action, noise, last=True)
    torch.testing.assert_close(model.images(last), model.images(whole))
    assert len(last) == 1
    assert len(whole) == len(state) == 4 + 2 * 7


def test_the_latent_and_the_action_matter() -> None:
    model = made()
    state = model.start(torch.rand(1, 1, 3, 16, 24), torch.zeros(1, 0, 2))
    action, noise = torch.rand(1, 2), torch.randn(1, model.noise)
    images = [
        model.images(model.step(state, a, z))
        for a, z in ((action, noise), (action + 1, noise), (action, -noise))
    ]
    assert not images[0].equal(images[1])
    assert not images[0].equal(images[2])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"widths": (4, 4)}, "^widths must be 7 numbers"),
        ({"posterior": (4, 0, 4)}, "^posterior must be 3 numbers"),
        ({"kernel": 4}, "^kernel must be odd"),
        ({"move": 0}, "^move must be odd"),
        ({"masks": 1}, "^masks must be at least 2"),
        ({"frames": 1}, "^frames must be at least 2"),
        ({"kl_weight": math.nan}, "^kl_weight must be at least 0"),
        ({"sampling_k": 0.0}, "^sampling_k must be positive"),
        ({"least_log_variance": math.inf}, "^least_log_variance must be finite"),
    ],
)
def test_bad_configs_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(TINY, **change)


# ---- layers ------------------------------------------------------------------------------------


def test_the_convolutional_lstm_is_the_formulas() -> None:
    torch.manual_seed(0)
    cell = ConvLSTM(3, 2, 5)
    x, c, h = torch.randn(3, 2, 3, 4, 6)[:, :, :3], torch.randn(2, 2, 4, 6), None
    x, h = x[0], torch.randn(2, 2, 4, 6)
    after, hidden = values(*cell(x, c, h))
    weight, bias = values(cell.gates.weight, cell.gates.bias)
    for n in range(2):
        joint = np.concatenate(values(x[n], h[n]))
        gates = slow_convolution(joint, weight, bias)
        i, j, f, o = gates[:2], gates[2:4], gates[4:6], gates[6:]
        expected = sigmoid(f + 1.0) * c[n].numpy() + sigmoid(i) * np.tanh(j)
        np.testing.assert_allclose(after[n], expected, atol=1e-5)
        np.testing.assert_allclose(hidden[n], np.tanh(expected) * sigmoid(o), atol=1e-5)


def test_moved_images_are_masked_and_summed_but_for_the_last() -> None:
    torch.manual_seed(0)
    moved = MovedImages(7, 4, 5)
    image, features = torch.rand(2, 3, 6, 8), torch.randn(2, 7)
    masks = torch.rand(2, 3, 6, 8)
    found = moved(image, features, masks).detach().numpy()
    weight, bias = values(moved.kernels.weight, moved.kernels.bias)
    for n in range(2):
        raw = (weight @ features[n].numpy() + bias).reshape(4, 5, 5)
        kernels = np.maximum(raw - 1e-12, 0) + 1e-12
        kernels /= kernels.sum(axis=(1, 2), keepdims=True)
        expected = np.zeros((3, 6, 8))
        for k in range(3):
            for colour in range(3):
                plane = image[n, colour].numpy()[None]
                gone = slow_convolution(plane, kernels[k][None, None], np.zeros(1))[0]
                expected[colour] += masks[n, k].numpy() * gone
        np.testing.assert_allclose(found[n], expected, atol=1e-5)
    # A kernel of nothing but negative numbers is an average.
    with torch.no_grad():
        moved.kernels.weight.zero_()
        moved.kernels.bias.fill_(-1)
    np.testing.assert_allclose(moved.normalised(features).detach(), 1 / 25, rtol=1e-5)


@pytest.mark.parametrize("side", [3, 5])
def test_down_pads_below_and_to_the_right(side: int) -> None:
    torch.manual_seed(0)
    down, x = Down(2, 3, side), torch.randn(1, 2, 6, 8)
    weight, bias = values(down.weight, down.bias)
    before = (side - 2) // 2  # TensorFlow's SAME: the smaller half of k - 2 comes first
    padded = np.zeros((2, 6 + side, 8 + side))
    padded[:, before : before + 6, before : before + 8] = x[0].numpy()
    (found,) = values(down(x))
    assert found.shape == (1, 3, 3, 4)
    for row in range(3):
        for column in range(4):
            patch = padded[:, 2 * row : 2 * row + side, 2 * column : 2 * column + side]
            expected = (patch * weight).sum(axis=(1, 2, 3)) + bias
            np.testing.assert_allclose(found[0, :, row, column], expected, atol=1e-5)


def test_up_lacks_the_first_row_and_column_of_a_transposed_convolution() -> None:
    torch.manual_seed(0)
    up, x = Up(2), torch.randn(1, 2, 3, 4)
    weight, bias = values(up.weight, up.bias)
    full = np.zeros((2, 7, 9))
    for row in range(3):
        for column in range(4):
            for channel in range(2):
                spread = x[0, channel, row, column].item() * weight[channel]
                full[:, 2 * row : 2 * row + 3, 2 * column : 2 * column + 3] += spread
    expected = np.maximum(full + bias[:, None, None], 0)[:, 1:, 1:]
    np.testing.assert_allclose(up(x)[0].detach(), expected, atol=1e-5)


def test_the_norm_is_over_channels_and_pixels() -> None:
    torch.manual_seed(0)
    norm, x = layer_norm(3), torch.randn(2, 3, 4, 5) * 3 + 1
    with torch.no_grad():
        norm.weight.copy_(torch.tensor([1.0, 2.0, 3.0]))
        norm.bias.copy_(torch.tensor([0.0, 1.0, -1.0]))
    for n, image in enumerate(x.numpy().astype(np.float64)):
        normal = (image - image.mean()) / image.std()
        expected = normal * np.array([1, 2, 3])[:, None, None] + np.array([0, 1, -1])[:, None, None]
        np.testing.assert_allclose(norm(x)[n].detach(), expected, atol=1e-5)


def test_weights_begin_uniform_with_a_variance_of_the_mean_fan() -> None:
    torch.manual_seed(0)
    for layer, inputs, outputs in (
        (torch.nn.Conv2d(20, 60, 3), 180, 540),
        (torch.nn.ConvTranspose2d(20, 60, 3), 180, 540),
        (torch.nn.Linear(100, 300), 100, 300),
    ):
        initialise(layer)
        variance = 1.3 / ((inputs + outputs) / 2)
        assert layer.weight.var().item() == pytest.approx(variance, rel=0.05)
        assert layer.weight.abs().max().item() <= math.sqrt(3 * variance)
        assert not layer.bias.any()


# ---- schedules ---------------------------------------------------------------------------------


@given(st.integers(0, 10**7), st.integers(1, 64))
def test_scheduled_sampling_counts_true_frames(step: int, batch: int) -> None:
    config = SV2PConfig()
    found = config.true_frames(step, batch)
    expected = batch / (1 + math.exp(min(step / 900 - math.log(900), 600)))
    assert abs(found - expected) <= 0.5 + 1e-9
    assert 0 <= found <= batch


def test_scheduled_sampling_is_half_done_and_done_where_the_reference_says() -> None:
    config = SV2PConfig()
    assert config.true_frames(0, 16) == 16
    assert config.true_frames(6122, 16) == 8
    assert (config.true_frames(9212, 16), config.true_frames(9213, 16)) == (1, 0)


def test_latents_and_divergence_come_in_three_stages() -> None:
    model, batch = made(), clips()
    losses = {}
    for step in (1, 2, 3, 4):
        model.zero_grad()
        loss, parts = model.loss(batch, torch.Generator().manual_seed(0), step)
        loss.backward()
        learned = [weights.grad is not None for weights in model.posterior.parameters()]
        assert all(learned) == any(learned) == (step >= 2)
        losses[step] = (loss.item(), parts)
    assert losses[1][1]["kl"] == 0
    for step in (2, 3):
        assert losses[step][1]["kl"] > 0
        assert losses[step][0] == losses[step][1]["mse"].item()
    expected = losses[4][1]["mse"] + 0.1 * losses[4][1]["kl"]
    assert losses[4][0] == pytest.approx(expected.item(), rel=1e-6)


def test_the_divergence_is_torchs() -> None:
    torch.manual_seed(0)
    mean, log_variance = torch.randn(2, 3, 5)
    posterior = torch.distributions.Normal(mean, (0.5 * log_variance).exp())
    prior = torch.distributions.Normal(0.0, 1.0)
    expected = torch.distributions.kl_divergence(posterior, prior).sum(dim=1)
    torch.testing.assert_close(divergence(mean, log_variance), expected)


def test_the_log_variance_has_a_least_value() -> None:
    model = made()
    frames = to_unit(clips()["frames"].flatten(0, 1)).reshape(5, 4, 3, 16, 24)
    mean, log_variance = model.posterior(frames)
    assert mean.shape == log_variance.shape == (5, model.noise)
    assert log_variance.min() == -5


@pytest.mark.parametrize("true", [True, False])
def test_a_clip_goes_on_from_true_or_from_predicted_frames(true: bool) -> None:
    config = dataclasses.replace(TINY, posterior_from=10**6, sampling_k=1e9 if true else 1e-2)
    model, batch = made(config), clips()
    _, parts = model.loss(batch, torch.Generator().manual_seed(4), 100)
    noise = torch.randn(5, model.noise, generator=torch.Generator().manual_seed(4))
    frames = to_unit(batch["frames"].flatten(0, 1)).reshape(5, 4, 3, 16, 24)
    state = model.start(frames[:, :1], torch.zeros(5, 0, 2))
    errors = []
    for time in range(3):
        image, memory = model._act(state, batch["actions"][:, time], noise)
        errors.append((image - frames[:, time + 1]).square().mean().item())
        state = model._see(frames[:, time + 1] if true else image, memory)
    assert parts["mse"].item() == pytest.approx(np.mean(errors), rel=1e-5)
    assert parts["mse_1"].item() == pytest.approx(errors[0], rel=1e-5)
    assert parts["mse_last"].item() == pytest.approx(errors[-1], rel=1e-5)


def test_a_loss_is_a_function_of_batch_generator_and_step() -> None:
    model, batch = made(), clips()
    first, again, other = (
        model.loss(batch, torch.Generator().manual_seed(seed), 3)[0] for seed in (0, 0, 1)
    )
    assert first == again != other
    with pytest.raises(ValueError, match=r"^frames: 3 in a clip, expected 4"):
        model.loss({**batch, "frames": batch["frames"][:, :3]}, torch.Generator(), 0)


# ---- learning ----------------------------------------------------------------------------------


def sliding(episodes: int, steps: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A bright bar that actions push along an image of 16 x 16."""
    rng = np.random.default_rng(seed)
    actions = rng.uniform(-2, 2, (episodes, steps, 2)).astype(np.float32)
    place = np.full(episodes, 8.0)
    frames = np.zeros((episodes, steps + 1, 16, 16, 3), np.uint8)
    for step in range(steps + 1):
        if step:
            place = np.clip(place + actions[:, step - 1, 0], 2, 13)
        near = np.clip(2.5 - np.abs(np.arange(16) - place[:, None]), 0, 1)
        frames[:, step] = np.rint(255 * near)[:, None, :, None]
    return frames, actions


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "sliding.h5"
    frames, actions = sliding(24, 9)
    metadata = Metadata(
        "sliding", {}, None, 9, 24, {}, action_low=(-2.0, -2.0), action_high=(2.0, 2.0)
    )
    write_episodes(path, metadata, Episodes(frames, actions))
    return path


def test_the_loss_falls_on_a_small_problem() -> None:
    config = dataclasses.replace(
        TINY, image_size=(16, 16), action_low=(-2, -2), action_high=(2, 2), frames=3,
        posterior_from=10**6, kl_from=10**6,
    )  # fmt: skip
    model = made(config).train()
    frames, actions = map(torch.from_numpy, sliding(16, 2))
    optimiser = torch.optim.Adam(model.parameters(), lr=3e-3, betas=(0.85, 0.997), eps=1e-6)
    losses = []
    for step in range(150):
        optimiser.zero_grad()
        generator = torch.Generator().manual_seed(step)
        loss, _ = model.loss({"frames": frames, "actions": actions}, generator, step)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        losses.append(loss.item())
    still = np.square((frames[:, 1:] - frames[:, :1].float()).numpy() / 255).mean()
    assert np.mean(losses[-10:]) < 0.35 * still < losses[0]


@pytest.mark.parametrize("name", ["sv2p", "sv2p-small"])
def test_it_is_trained_probed_and_planned_with_by_name(
    name: str, data: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    words = ["train", name, "--data", str(data), "--out", str(out), *SIZE.split()]
    assert main([*words, "--loop.steps", "3", "--loop.device", "cpu"]) == 0
    found = load_any(out / "model.safetensors")
    assert found.name == name
    assert found.module.config.image_size == (16, 16)
    assert found.module.config.action_low == (-2, -2)
    assert {"psnr_1", "psnr_3", "still_3"} <= set(found.header.training["validation"])
    assert found.header.training["loop"]["betas"] == [0.85, 0.997]
    assert iio.imread(next((out / "pictures").iterdir())).shape[0] > 100
    words = ["probe", "--data", str(data), "--model", str(out / "model.safetensors")]
    words += ["--out", str(tmp_path / "probe"), "--horizon", "4", "--steps-ahead", "1", "4"]
    assert main(words) == 0
    strips = iio.imread(tmp_path / "probe/strips.png")
    assert strips.shape == (2 * 4 * 34 + 2, 5 * 34 + 2, 3)
    world = found.entry.resolved("plannable")(found.module, Planning(blur=1.0))
    frames, _ = sliding(2, 1)
    mpc = hvf_core.VisualMPC(horizon=3, samples=12, elites=3, iterations=2)
    plan = mpc.plan(world, frames[0, :1], frames[1, 1:], seed=0)
    assert np.isfinite(plan.cost)


def test_a_run_that_was_stopped_goes_on_the_same(data: Path, tmp_path: Path) -> None:
    for out, steps in (("a", (2, 4)), ("b", (4,))):
        for step in steps:
            words = ["train", "sv2p", "--data", str(data), "--out", str(tmp_path / out)]
            words += [*SIZE.split(), "--loop.steps", "4", "--loop.device", "cpu"]
            words += ["--loop.checkpoint-every", "2"]
            if step == 2:
                with pytest.MonkeyPatch.context() as patch:
                    patch.setattr(SV2P, "loss", stopping(SV2P.loss, 2))
                    with pytest.raises(MemoryError):
                        main(words)
            else:
                assert main(words) == 0
    first, second = (load_any(tmp_path / x / "model.safetensors").module for x in "ab")
    for name, value in first.state_dict().items():
        assert value.equal(second.state_dict()[name]), name


def stopping(loss: Any, at: int) -> Any:
    def stopped(model: SV2P, batch: Any, generator: Any, step: int) -> Any:
        if step == at:
            raise MemoryError("killed")
        return loss(model, batch, generator, step)

    return stopped


def test_the_papers_preset_is_the_released_training() -> None:
    recipe: Any = recipe_class("sv2p").of("paper", data=Path("x.h5"))
    loop = recipe.loop
    assert (loop.steps, loop.learning_rate, loop.schedule) == (300_000, 1e-3, "constant")
    assert (loop.betas, loop.eps, loop.clip_norm) == ((0.85, 0.997), 1e-6, 1.0)
    assert (loop.weight_decay, loop.warmup_steps, recipe.batch_size) == (0, 0, 16)
    model = recipe.model
    assert (model.frames, model.posterior_from, model.kl_from) == (11, 15_000, 30_000)
    assert (model.kl_weight, model.sampling_k) == (1e-3, 900)
    small: Any = recipe_class("sv2p-small").of("default", data=Path("x.h5"))
    assert small.model == SMALL
    assert [4 * width for width in SMALL.widths] == list(model.widths)


def test_checkpoints_say_which_of_the_two_it_is(tmp_path: Path) -> None:
    for name, kind in (("sv2p", SV2P), ("sv2p-small", SV2PSmall)):
        model = made(TINY, kind)
        save_model(tmp_path / name, model, environment="maze")
        found = load_any(tmp_path / name)
        assert (found.name, type(found.module)) == (name, kind)
        assert found.module.config == TINY
        for key, value in model.state_dict().items():
            assert value.equal(found.module.state_dict()[key])
        assert MODELS[name].kind == "video"


# ---- planning ----------------------------------------------------------------------------------


def test_plans_have_the_same_bits_alone_and_together_and_follow_their_seeds() -> None:
    world = world_of(made(), Planning())
    assert world.uses_seeds
    rng = np.random.default_rng(0)
    starts, goals = rng.integers(0, 256, (2, 3, 16, 24, 3), dtype=np.uint8)
    mpc = hvf_core.VisualMPC(horizon=2, samples=30, elites=4, iterations=2)
    plans = mpc.plan_batch(world, starts, goals, seeds=[1, 2, 3])
    for b, seed in enumerate((1, 2, 3)):
        alone = mpc.plan(world, starts[b : b + 1], goals[b : b + 1], seed=seed)
        np.testing.assert_array_equal(alone.actions, plans.actions[b])
        assert alone.cost == plans.costs[b]
    images = world.observe(starts)
    actions = rng.uniform(-1, 1, (3, 4, 2)).astype(np.float32)
    once, again, other = (
        world.predict(images, actions, seeds=np.array(seeds))
        for seeds in ([5, 6, 7], [5, 6, 7], [8, 6, 7])
    )
    np.testing.assert_array_equal(once, again)
    assert (once[0] != other[0]).any()
    np.testing.assert_array_equal(once[1:], other[1:])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda_predicts_as_the_cpu_does() -> None:
    rng = np.random.default_rng(0)
    starts = rng.integers(0, 256, (3, 16, 24, 3), dtype=np.uint8)
    actions = rng.uniform(-1, 1, (3, 4, 2)).astype(np.float32)
    drawn = {}
    for device, precision in (("cpu", "float32"), ("cuda", "float32"), ("cuda", "auto")):
        world = VideoWorld(made(), device=device, precision=precision)  # type: ignore[arg-type]
        drawn[device, precision] = world.predict(world.observe(starts), actions).astype(int)
    cpu = drawn["cpu", "float32"]
    assert np.abs(drawn["cuda", "float32"] - cpu).max() <= 2
    assert np.abs(drawn["cuda", "auto"] - cpu).mean() <= 3
