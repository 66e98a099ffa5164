"""The learned models of the desk: subgoals of the VAE, and what measures predictions."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

import hvf_core
from hvf.data.episodes import Episodes, Metadata
from hvf.data.formats.hdf5 import EpisodeFile, write_episodes

torch = pytest.importorskip("torch")

from hvf.models.image_quality import perceptual_distance, psnr, ssim  # noqa: E402
from hvf.models.vae import CVAEConfig  # noqa: E402
from hvf.training.loop import LoopConfig  # noqa: E402
from hvf.training.recipe import train  # noqa: E402
from hvf.worlds.images import ImageSubgoals  # noqa: E402
from hvf.worlds.layers import LayerWorld  # noqa: E402
from layered_desk import random_dynamics  # noqa: E402

SHORT = LoopConfig(steps=8, learning_rate=1e-3, validate_every=8, checkpoint_every=4)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Episodes of noise."""
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (6, 10, 32, 32, 3), dtype=np.uint8)
    actions = rng.uniform(-1, 1, (6, 9, 3)).astype(np.float32)
    path = tmp_path_factory.mktemp("data") / "desk.h5"
    metadata = Metadata("desk", {}, 0, 9, 6, {})
    write_episodes(path, metadata, Episodes(frames, actions, np.zeros((6, 10, 17))))
    return path


def test_the_planner_searches_subgoals_in_learned_models(data: Path, tmp_path: Path) -> None:
    world = LayerWorld(random_dynamics())
    vae = CVAEConfig(
        image_size=(32, 32), conditional=False, channels=(4, 8), strides=(2, 2), latent_dim=3,
        posterior_layers=(8,), scene_layers=(), image_layers=(8,),
    )  # fmt: skip
    quiet = Console(file=io.StringIO())
    generator = train("vae", data, out=tmp_path, batch_size=4, model=vae, loop=SHORT, console=quiet)
    with EpisodeFile(data) as file:
        images = file.read(0, 1).frames[0, :2]
    mpc = hvf_core.VisualMPC(horizon=3, samples=8, elites=2, iterations=2, action_repeat=3)
    costs = set()
    for share in (True, False):
        search = hvf_core.HVF(
            mpc=mpc, subgoals=2, samples=6, elites=2, iterations=2, share_rollouts=share
        )
        found = search.search(world, ImageSubgoals(generator), images[0], images[1], seed=1)
        costs.add(found.cost)
    assert len(costs) == 1
    assert np.isfinite(costs.pop())


def test_image_measures_agree_with_their_definitions() -> None:
    rng = np.random.default_rng(4)
    truth = rng.integers(0, 256, (2, 1, 14, 13, 3), dtype=np.uint8)
    guess = (0.7 * truth + 60 * rng.random(truth.shape)).astype(np.uint8)
    mse = ((guess / 255.0 - truth / 255.0) ** 2).mean(axis=(2, 3, 4))
    np.testing.assert_allclose(psnr(guess, truth), 10 * np.log10(1 / mse))
    assert ssim(truth, truth) == pytest.approx(np.ones((2, 1)))
    line = np.exp(-0.5 * ((np.arange(11) - 5) / 1.5) ** 2)
    window = np.outer(line, line) / line.sum() ** 2
    expected = []
    for colour in range(3):
        a, b = guess[1, 0, ..., colour] / 255.0, truth[1, 0, ..., colour] / 255.0
        for i in range(4):
            for j in range(3):
                x, y = a[i : i + 11, j : j + 11], b[i : i + 11, j : j + 11]
                mx, my = (window * x).sum(), (window * y).sum()
                vx, vy = (window * (x - mx) ** 2).sum(), (window * (y - my) ** 2).sum()
                both = (window * (x - mx) * (y - my)).sum()
                value = (2 * mx * my + 1e-4) * (2 * both + 9e-4)
                expected.append(value / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4)))
    assert ssim(guess, truth)[1, 0] == pytest.approx(np.mean(expected), rel=1e-9)


def test_the_learned_measure_is_the_packages_own_on_colours_from_minus_one_to_one() -> None:
    stlpips = pytest.importorskip("stlpips_pytorch.stlpips", reason="hvf[metrics] not installed")
    rng = np.random.default_rng(5)
    truth = rng.integers(0, 256, (33, 2, 64, 64, 3), dtype=np.uint8)
    guess = (0.8 * truth + 20).astype(np.uint8)
    found = perceptual_distance()(guess, truth)
    assert found.shape == (33, 2)
    assert (found > 0).all()
    assert (perceptual_distance()(truth[:1], truth[:1]) == 0).all()
    network = stlpips.LPIPS(net="alex", variant="shift_tolerant", verbose=False).eval()
    pair = [torch.from_numpy(x[32, 1] / 127.5 - 1).float() for x in (guess, truth)]
    with torch.no_grad():
        expected = network(*(x.permute(2, 0, 1)[None] for x in pair)).item()
    assert found[32, 1] == pytest.approx(expected, rel=1e-4)


def test_without_its_package_the_learned_measure_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "stlpips_pytorch", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'hvf\[metrics\]'"):
        perceptual_distance()
