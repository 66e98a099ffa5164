"""The generator of subgoal images: its networks, its loss, what it refuses, how it is trained."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from rich.console import Console
from torch import nn

import hvf_core
from hvf.data.episodes import Episodes, Metadata
from hvf.data.formats.hdf5 import write_episodes
from hvf.domains.maze_collection import MazeCollection
from hvf.models.checkpoint import load_model, read_header
from hvf.models.frames import to_unit
from hvf.models.vae import (
    BAIR_CVAE,
    CVAE,
    DESK_VAE,
    PAPER_BAIR,
    PAPER_CVAE,
    PAPER_VAE,
    VAE,
    CVAEConfig,
    gaussian_kl,
    pyramid_loss,
)
from hvf.training.loop import LoopConfig, seeded, train
from hvf.training.recipe import train as train_model
from hvf.training.recipes.vae import maze_probe, validate_subgoals

QUIET = Console(quiet=True)
SMALL = CVAEConfig(
    image_size=(16, 16),
    channels=(8, 16),
    strides=(2, 2),
    latent_dim=3,
    posterior_layers=(16,),
    scene_layers=(16,),
    image_layers=(16,),
    pyramid_levels=2,
)
SMALL_VAE = dataclasses.replace(SMALL, conditional=False, scene_layers=())


def small(config: CVAEConfig = SMALL) -> CVAE:
    return seeded(0, lambda: CVAE(config)).eval()


def frames(count: int, size: tuple[int, int] = (16, 16), seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (count, *size, 3), dtype=torch.uint8, generator=generator)


# ---- networks ----------------------------------------------------------------------------------


def layers(network: nn.Module, kind: type[nn.Module]) -> list[tuple[int, ...]]:
    return [tuple(m.weight.shape) for m in network.modules() if isinstance(m, kind)]


def test_the_default_has_the_layers_of_the_papers_maze_cvae() -> None:
    model = CVAE(CVAEConfig())
    assert layers(model.encoder, nn.Conv2d) == [
        (16, 3, 3, 3),
        (32, 16, 3, 3),
        (64, 32, 3, 3),
        (128, 64, 3, 3),
    ]
    assert layers(model.decoder, nn.ConvTranspose2d) == [
        (128, 64, 3, 3),
        (64, 32, 3, 3),
        (32, 16, 3, 3),
        (16, 3, 3, 3),
    ]
    spatial = 4 * 4 * 128
    assert layers(model.scene, nn.Linear) == [(512, spatial), (512, 512), (256, 512)]
    assert layers(model.image, nn.Linear) == [
        (256, 256 + 8),
        (256, 256),
        (256, 256),
        (spatial, 256),
    ]
    assert layers(model.posterior, nn.Linear) == [(512, 2 * spatial), (16, 512)]


@pytest.mark.parametrize(
    ("config", "spatial"),
    [(CVAEConfig(), (4, 4)), (DESK_VAE, (8, 8)), (BAIR_CVAE, (6, 8))],
    ids=["maze", "desk", "bair"],
)
def test_the_decoder_mirrors_the_encoder(config: CVAEConfig, spatial: tuple[int, int]) -> None:
    model = CVAE(config)
    images = torch.rand(2, 3, *config.image_size)
    assert model.encoder(images).shape == (2, config.channels[-1], *spatial)
    scene = images if config.conditional else None
    mean, log_variance = model.encode(images, scene)
    assert mean.shape == log_variance.shape == (2, 8)
    assert model.decode(mean, scene).shape == images.shape


@given(
    height=st.integers(8, 21), width=st.integers(8, 21), strides=st.tuples(*[st.integers(1, 2)] * 3)
)
@settings(max_examples=25)
def test_any_image_size_is_decoded_to_itself(
    height: int, width: int, strides: tuple[int, int, int]
) -> None:
    config = dataclasses.replace(
        SMALL, image_size=(height, width), channels=(2, 3, 4), strides=strides
    )
    images = torch.rand(2, 3, height, width)
    model = CVAE(config)
    assert model.decode(model.encode(images, images)[0], images).shape == images.shape


def test_one_scene_for_many_latents_is_that_scene_repeated() -> None:
    model, scene = small(), torch.rand(1, 3, 16, 16)
    latent = torch.randn(5, 3)
    together = model.decode(latent, scene)
    torch.testing.assert_close(together, model.decode(latent, scene.expand(5, -1, -1, -1)))
    apart = torch.cat([model.decode(z[None], scene) for z in latent])
    torch.testing.assert_close(together, apart, rtol=1e-4, atol=1e-5)


def test_latent_and_scene_both_change_the_image() -> None:
    model = small()
    with torch.no_grad():
        for weights in model.decoder.parameters():
            weights.mul_(10)
    latent, scene = torch.randn(2, 3), torch.rand(2, 3, 16, 16)
    base = model.decode(latent, scene)
    assert (model.decode(latent.flip(0), scene) - base).abs().max() > 1e-3
    assert (model.decode(latent, scene.flip(0)) - base).abs().max() > 1e-3


def test_the_mean_image_is_where_decoding_starts() -> None:
    seen = frames(300, seed=3) // 2 + 40
    model = small().centre(seen)
    expected = to_unit(seen).double().mean(0).float()
    torch.testing.assert_close(model.mean_image, expected, rtol=0, atol=1e-6)
    with torch.no_grad():
        for weights in model.decoder.parameters():
            weights.zero_()
    torch.testing.assert_close(
        model.decode(torch.zeros(1, 3), expected[None])[0], expected, rtol=0, atol=1e-5
    )


# ---- loss --------------------------------------------------------------------------------------


def test_kl_is_that_of_torch_distributions() -> None:
    mean, log_variance = torch.randn(6, 8), torch.randn(6, 8)
    posterior = torch.distributions.Normal(mean, (0.5 * log_variance).exp())
    prior = torch.distributions.Normal(torch.zeros(8), torch.ones(8))
    expected = torch.distributions.kl_divergence(posterior, prior).sum(1)
    torch.testing.assert_close(gaussian_kl(mean, log_variance), expected)
    assert gaussian_kl(torch.zeros(1, 8), torch.zeros(1, 8)).item() == 0


def test_pyramid_is_the_squared_error_of_block_means() -> None:
    prediction, image = torch.rand(2, 3, 8, 8), torch.rand(2, 3, 8, 8)
    expected = 0.0
    for level in (1, 2, 3):
        side = 2**level
        for y in range(0, 8, side):
            for x in range(0, 8, side):
                block = (prediction - image)[:, :, y : y + side, x : x + side].mean((2, 3))
                expected += 8**level * float(block.square().sum())
    assert float(pyramid_loss(prediction, image, 3)) == pytest.approx(expected / 2, rel=1e-4)
    assert float(pyramid_loss(prediction, image, 0)) == 0


def test_pyramid_grows_with_distance_where_the_pixel_loss_does_not() -> None:
    def squares(first: int) -> torch.Tensor:  # 5 pixels wide, from `first` to `first` + 15
        images = torch.zeros(16, 1, 64, 64)
        for i in range(16):
            images[i, 0, 30:35, first + i : first + i + 5] = 1
        return images

    here, near, far = squares(5), squares(11), squares(27)
    assert float((here - near).square().sum()) == float((here - far).square().sum())
    assert pyramid_loss(here, near, 4) < 0.9 * pyramid_loss(here, far, 4)


def test_the_loss_is_the_bound_of_each_image_with_the_other_as_its_scene() -> None:
    model = small(dataclasses.replace(SMALL, kl_weight=2.0, kl_steps=0, pyramid_weight=0.5))
    batch = {"image": frames(4, seed=1), "scene": frames(4, seed=2)}
    loss, parts = model.loss(batch, torch.Generator().manual_seed(7), 0)
    image, scene = to_unit(batch["image"]), to_unit(batch["scene"])
    noise = torch.randn(8, 3, generator=torch.Generator().manual_seed(7))
    expected = torch.zeros(())
    for target, other, eps in ((image, scene, noise[:4]), (scene, image, noise[4:])):
        mean, log_variance = model.encode(target, other)
        drawn = model.decode(mean + eps * (log_variance / 2).exp(), other)
        entropy = nn.functional.binary_cross_entropy(drawn, target, reduction="sum")
        expected = expected + entropy / 8 + 0.25 * pyramid_loss(drawn, target, 2)
        expected = expected + gaussian_kl(mean, log_variance).mean()
    torch.testing.assert_close(loss, expected, rtol=1e-4, atol=1e-3)
    assert set(parts) == {"pixel", "pyramid", "kl", "mse"}
    assert not any(value.requires_grad for value in parts.values())


def test_without_a_scene_the_loss_needs_only_images() -> None:
    model = small(SMALL_VAE)
    loss, _ = model.loss({"image": frames(4)}, torch.Generator(), 0)
    loss.backward()
    assert all(weights.grad is not None for weights in model.parameters())


def test_kl_weight_grows_geometrically_and_stays() -> None:
    config = CVAEConfig(kl_start=0.01, kl_weight=1.0, kl_steps=100)
    assert config.kl_weight_at(0) == pytest.approx(0.01)
    assert config.kl_weight_at(50) == pytest.approx(0.1)
    assert config.kl_weight_at(100) == config.kl_weight_at(10_000) == 1.0


# ---- bad input ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"image_size": (4, 64)}, "image_size"),
        ({"channels": ()}, "channels"),
        ({"channels": (8, 0)}, "channels"),
        ({"strides": (2,)}, "strides"),
        ({"strides": (2, 3)}, "strides"),
        ({"latent_dim": 0}, "latent_dim"),
        ({"image_layers": (0,)}, "image_layers"),
        ({"conditional": False}, "scene_layers"),
        ({"scene_layers": ()}, "scene_layers"),
        ({"pyramid_levels": 5}, "pyramid_levels"),
        ({"kl_weight": math.nan}, "kl_weight"),
        ({"kl_start": 0.0}, "kl_start"),
        ({"pyramid_weight": -1.0}, "pyramid_weight"),
    ],
)
def test_config_names_a_bad_field(change: dict[str, object], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        dataclasses.replace(SMALL, **change)


@given(
    latent=st.lists(st.integers(0, 4), min_size=1, max_size=3),
    scene=st.lists(st.sampled_from([1, 2, 3, 16]), min_size=4, max_size=4),
)
@settings(max_examples=60)
def test_decode_takes_its_shapes_and_names_others(latent: list[int], scene: list[int]) -> None:
    model = small()
    fits = len(latent) == 2 and latent[1] == 3
    if fits and scene[1:] == [3, 16, 16] and scene[0] in (1, latent[0]):
        assert model.decode(torch.zeros(latent), torch.zeros(scene)).shape[0] == latent[0]
    else:
        with pytest.raises(ValueError, match="scene must be" if fits else "latent must be"):
            model.decode(torch.zeros(latent), torch.zeros(scene))


def test_a_scene_is_needed_exactly_where_there_is_one() -> None:
    with pytest.raises(ValueError, match="scene must be given"):
        small().decode(torch.zeros(1, 3))
    with pytest.raises(ValueError, match="scene must be None"):
        small(SMALL_VAE).decode(torch.zeros(1, 3), torch.zeros(1, 3, 16, 16))


def test_centre_names_bad_frames() -> None:
    with pytest.raises(TypeError, match="frames must be uint8"):
        small().centre(torch.rand(2, 16, 16, 3))
    for shape in ((2, 3, 16, 16), (0, 16, 16, 3), (16, 16, 3)):
        with pytest.raises(ValueError, match="frames must be"):
            small().centre(torch.zeros(shape, dtype=torch.uint8))


# ---- training ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "maze.h5"
    return MazeCollection(path, episodes=30, steps=10).run()


class Squares:
    """Batches of images of one square on a background whose shade is the scene's."""

    def batch(self, step: int) -> dict[str, torch.Tensor]:
        rng = np.random.default_rng(step)
        shade = rng.integers(0, 120, (16, 1, 1, 1))
        both = []
        for _ in range(2):
            images = np.broadcast_to(shade, (16, 16, 16, 3)).astype(np.uint8)
            for image, (y, x) in zip(images, rng.integers(0, 13, (16, 2)), strict=True):
                image[y : y + 4, x : x + 4] = 255
            both.append(torch.from_numpy(images))
        return {"image": both[0], "scene": both[1]}


def test_a_short_training_draws_the_right_square_on_the_right_scene(tmp_path: Path) -> None:
    config = dataclasses.replace(SMALL, kl_start=1e-3, kl_weight=1e-2, kl_steps=100)
    model = seeded(0, lambda: CVAE(config)).centre(Squares().batch(0)["image"])
    loop = LoopConfig(steps=200, learning_rate=5e-3, device="cpu", threads=1)
    train(model, Squares(), loop, tmp_path, environment="squares", console=Console(quiet=True))
    held_out = Squares().batch(10_000)
    image, scene = to_unit(held_out["image"]), to_unit(held_out["scene"])
    drawn = model.decode(model.encode(image, scene)[0], scene)
    # To draw the scene's own square, or none, leaves all of its error.
    assert (drawn - image).square().mean() < 0.5 * (scene - image).square().mean()


def test_training_writes_what_the_planner_loads(data: Path, tmp_path: Path) -> None:
    model = CVAEConfig(channels=(4, 8, 8, 8), scene_layers=(8,), image_layers=(8,))
    loop = LoopConfig(steps=2, device="cpu", threads=1)
    trained = train_model(
        "cvae", data, out=tmp_path, batch_size=2, model=model, loop=loop, console=QUIET
    )
    loaded = load_model(tmp_path / "model.safetensors", CVAE, environment="maze")
    assert loaded.config == model
    latent, scene = torch.randn(3, 8), torch.rand(1, 3, 64, 64)
    torch.testing.assert_close(loaded.decode(latent, scene), trained.decode(latent, scene))
    found = read_header(tmp_path / "model.safetensors").training
    assert found["command"] == "hvf train cvae"
    assert found["data"]["episodes"] == 30
    assert found["validation"].keys() >= {"kl", "mse", "agent_mm", "gap_mm", "sharp_samples"}
    assert (tmp_path / "pictures/subgoals_0000002.png").exists()


def test_the_size_of_images_is_the_datas(data: Path, tmp_path: Path) -> None:
    loop = LoopConfig(steps=1, device="cpu", threads=1)
    model = train_model(
        "cvae", data, out=tmp_path, batch_size=2, model=SMALL, loop=loop, console=QUIET
    )
    assert model.config == dataclasses.replace(SMALL, image_size=(64, 64))


def test_any_environments_images_train_a_cvae_and_too_small_ones_are_refused(
    tmp_path: Path,
) -> None:
    loop = LoopConfig(steps=1, device="cpu", threads=1)
    for size in ((8, 12), (4, 4)):
        path = tmp_path / f"{size[0]}.h5"
        frames = np.random.default_rng(0).integers(0, 256, (4, 6, *size, 3), np.uint8)
        moves, states = np.zeros((4, 5, 7), np.float32), np.zeros((4, 6, 1))
        write_episodes(path, Metadata("kitchen", {}, 0, 5, 4, {}), Episodes(frames, moves, states))
        settings = {"out": tmp_path / "run", "model": SMALL, "loop": loop, "console": QUIET}
        if size == (4, 4):
            with pytest.raises(ValueError, match=r"4\.h5: the model cannot take its images"):
                train_model("cvae", path, **settings)
            continue
        assert train_model("cvae", path, **settings).config.image_size == size
        header = read_header(tmp_path / "run/model.safetensors")
        assert header.environment == "kitchen"
        assert header.training["validation"].keys() == {"kl", "latents_used", "mse"}


# ---- the paper's configuration -----------------------------------------------------------------


def test_the_papers_cvae_has_the_layers_of_the_released_code() -> None:
    model = CVAE(PAPER_CVAE)
    assert sum(weights.numel() for weights in model.parameters()) == 2_862_931
    image = torch.rand(2, 3, 64, 64)
    sides = [image.shape[-1]]
    for layer in model.encoder:
        image = layer(image)
        if isinstance(layer, nn.Conv2d):
            sides.append(image.shape[-1])
    assert sides == [64, 31, 15, 7, 3]
    # Linear at the end of the encoder, of the scene's layers and before the decoder.
    assert not isinstance(model.encoder[-1], nn.ReLU)
    assert [type(layer).__name__ for layer in model.image] == (
        ["Linear", "ReLU"] * 2 + ["Linear", "Linear"]
    )
    assert "mean_image" not in model.state_dict()
    with pytest.raises(ValueError, match="centre: "):
        model.centre(frames(2, (64, 64)))


@pytest.mark.parametrize("config", [CVAEConfig(), PAPER_CVAE], ids=["ours", "paper"])
def test_one_scene_for_all_images_is_encoded_as_copies_of_it_are(config: CVAEConfig) -> None:
    model = seeded(0, lambda: CVAE(config)).double()
    image = to_unit(frames(3, (64, 64), 1)).double()
    scene = to_unit(frames(1, (64, 64), 2)).double()
    with torch.no_grad():
        shared = model.encode(image, scene)
        copies = model.encode(image, scene.expand(3, -1, -1, -1))
        features = [model.encoder(model.taken(x)).flatten(1) for x in (scene, image)]
        both = torch.cat([features[0].expand(3, -1), features[1]], 1)
        expected = model.posterior(both)[:, : config.latent_dim]
    for one, other in zip(shared, copies, strict=True):
        torch.testing.assert_close(one, other)
    torch.testing.assert_close(shared[0], expected.float())


@pytest.mark.parametrize("config", [PAPER_CVAE, PAPER_VAE, PAPER_BAIR], ids=["cvae", "vae", "bair"])
def test_the_papers_loss_is_the_evidence_bound_of_the_second_given_the_first(
    config: CVAEConfig,
) -> None:
    model = seeded(0, lambda: (CVAE if config.conditional else VAE)(config))
    size = config.image_size
    batch = {"image": frames(3, size, 1), "scene": frames(3, size, 2)}
    loss, parts = model.loss(batch, torch.Generator().manual_seed(7), 0)
    image, scene = to_unit(batch["image"]).double(), to_unit(batch["scene"]).double()
    model = model.double()
    features = [
        model.encoder(x).flatten(1) for x in ([scene, image] if config.conditional else [image])
    ]
    mean, second = model.posterior(torch.cat(features, 1)).double().chunk(2, 1)
    std = second.clamp_min(0)
    assert 0 < float((std == 0).double().mean()) < 1
    noise = torch.randn(3, 8, generator=torch.Generator().manual_seed(7)).double()
    given_scene = scene if config.conditional else None
    drawn = torch.sigmoid(model.decode_logits(mean + noise * std, given_scene).double())
    drawn = drawn.clamp(1e-5, 1 - 1e-5).detach()
    likelihood = torch.distributions.Bernoulli(drawn, validate_args=False).log_prob(image)
    std, mean = std.detach(), mean.detach()
    kl = 0.5 * (-1 - (1e-5 + std**2).log() + mean**2 + std**2).sum(1)
    expected = -likelihood.sum((1, 2, 3)).mean() + kl.mean()
    assert float(loss.detach()) == pytest.approx(float(expected), rel=1e-5)
    assert float(parts["kl"]) == pytest.approx(float(kl.mean()), rel=1e-4)


@given(
    height=st.integers(8, 30),
    width=st.integers(8, 30),
    strides=st.lists(st.integers(1, 2), min_size=1, max_size=2),
)
@settings(max_examples=25)
def test_unpadded_images_of_any_size_are_decoded_to_theirs(
    height: int, width: int, strides: list[int]
) -> None:
    config = dataclasses.replace(
        SMALL, padding="valid", image_size=(height, width), channels=(2, 3)[: len(strides)],
        strides=tuple(strides),
    )  # fmt: skip
    images = torch.rand(2, 3, height, width)
    model = CVAE(config)
    assert tuple(model.encoder(images).shape[2:]) == config.sizes[-1]
    assert model.decode(model.encode(images, images)[0], images).shape == images.shape


def test_weights_of_the_paper_are_cut_normal() -> None:
    model = seeded(0, lambda: CVAE(PAPER_CVAE))
    for layer, inputs in (
        (model.encoder[2], 16 * 9),
        (model.decoder[0], 128 * 9),
        (model.posterior[0], 2304),
    ):
        spread = layer.weight.detach() * inputs**0.5
        assert float(spread.abs().max()) <= 2.0 + 1e-5
        assert float(spread.std()) == pytest.approx(0.88, abs=0.02)  # of a normal cut at 2
        assert not layer.bias.any()


def test_a_vae_has_no_scene() -> None:
    with pytest.raises(ValueError, match="conditional must be False"):
        VAE(CVAEConfig())
    with pytest.raises(ValueError, match=r"model\.conditional must be False"):
        train_model("vae", "none.h5", **{"model.conditional": True, "model.scene_layers": (8,)})


def test_ours_has_not_changed() -> None:
    """Weights and loss as they were before there were other configurations."""
    config = CVAEConfig(channels=(4, 8, 8, 8), scene_layers=(8,), image_layers=(8,))
    model = seeded(3, lambda: CVAE(config)).centre(frames(20, (64, 64)))
    batch = {"image": frames(2, (64, 64), 1), "scene": frames(2, (64, 64), 2)}
    loss, _ = model.loss(batch, torch.Generator().manual_seed(1), 100)
    total = sum(float(value.double().sum()) for value in model.state_dict().values())
    assert total == pytest.approx(6132.209955076313, rel=1e-7)
    assert float(loss.detach()) == pytest.approx(9728.3759765625, rel=1e-5)


def test_the_probe_calls_true_images_sharp_and_others_not() -> None:
    images, _, states = hvf_core.maze_collect(0, 0, 40, 5, 64)
    truth, other = images[:, 0], images[:, 5]
    perfect = maze_probe(truth, truth, other)
    assert perfect["agent_mm"] < 0.2
    assert perfect["gap_mm"] < 0.2
    assert perfect["sharp_samples"] == 1.0
    assert 0.5 < perfect["spread_x"] < 2
    empty = states[:, 0].copy()
    empty[:, :2] *= -1
    doubled = np.maximum(truth, hvf_core.maze_render(empty))  # two agents
    assert maze_probe(truth, truth, doubled)["sharp_samples"] < 0.1
    faint = (0.5 * other + 0.5 * truth).astype(np.uint8)
    assert maze_probe(truth, truth, faint)["sharp_samples"] < 0.3


def test_validation_measures_reconstructions_of_a_plain_vae_too() -> None:
    with torch.inference_mode():
        found = validate_subgoals(
            small(SMALL_VAE), {"image": frames(20)}, torch.Generator().manual_seed(0)
        )
    assert set(found.metrics) == {"kl", "latents_used", "mse"}
    assert found.pictures["subgoals"].shape == (3 * 34 + 2, 12 * 34 + 2, 3)
