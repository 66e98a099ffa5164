"""Training the compact dynamics of the desk: what it learns, reports, resumes and refuses."""

from __future__ import annotations

import dataclasses
import io
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console
from torch import nn

import toy_desk as toy
from hvf.data.episodes import Episodes, Metadata
from hvf.data.formats.hdf5 import EpisodeFile, write_episodes
from hvf.data.loader import EpisodePool, WindowSampler
from hvf.models.checkpoint import load_model, read_tensors
from hvf.models.layers.backdrop import Backdrop
from hvf.models.layers.colours import Colours
from hvf.models.layers.dynamics import LayerDynamics
from hvf.models.layers.perception import LayerPerception
from hvf.training.loop import LoopConfig
from hvf.training.recipe import train as train_model
from hvf.training.recipes import layers as layers_recipe
from hvf.training.recipes.layers import LayersRecipe, validate_arm, validate_layers
from hvf.training.tracks import layers as layers_tracks
from hvf.training.tracks.layers import LayerSampler, LayerTracks

EPISODES, STEPS = 60, 20
SHORT = LoopConfig(
    steps=8,
    learning_rate=1e-3,
    channels_last=False,
    precision="float32",
    validate_every=8,
    checkpoint_every=4,
    device="cpu",
)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "desk.h5"
    toy.write(path, 0, EPISODES, STEPS)
    return path


@pytest.fixture(autouse=True)
def few_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Colours are found in as many frames as there are."""
    monkeypatch.setattr(layers_recipe, "_PAIRS", 400)


def train(data: Path, out: Path, **settings: Any) -> str:
    """Train a tiny model; returns what was said."""
    said = io.StringIO()
    small: dict[str, Any] = {
        "arm_batch": 4, "windows": 4, "length": 3, "short_steps": 4, "model": toy.TINY,
        "arm_loop": SHORT, "loop": SHORT,
    }  # fmt: skip
    console = Console(file=said, width=300)
    train_model("layers", data, out=out, console=console, **{**small, **settings})
    return said.getvalue()


def same(first: Path, second: Path) -> bool:
    """Whether two checkpoints hold the same, bit for bit."""
    a, b = (read_tensors(path)[0] for path in (first, second))
    return a.keys() == b.keys() and all(a[name].equal(b[name]) for name in a)


# ---- whole trainings ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def whole(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that nothing stopped."""
    out = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(layers_recipe, "_PAIRS", 400)
        train(data, out)
    return out


@pytest.mark.parametrize(
    ("sampler", "steps"), [(WindowSampler, "perception at 4"), (LayerSampler, "cell at 4")]
)
def test_training_that_died_goes_on_to_the_same_result(
    data: Path,
    whole: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    sampler: type[Any],
    steps: str,
) -> None:
    draw: Callable[[Any, int], object] = sampler.batch

    def die(self: Any, step: int) -> object:
        if step == 6:
            raise MemoryError("killed")
        return draw(self, step)

    with monkeypatch.context() as patch:
        patch.setattr(sampler, "batch", die)
        with pytest.raises(MemoryError):
            train(data, tmp_path)
    said = train(data, tmp_path)
    assert said.count("resuming at step 4") == 1
    assert said.count("already trained for 8 steps") == (0 if "perception" in steps else 1)
    for name in ("training", "model", "perception/training", "perception/model"):
        assert same(tmp_path / f"{name}.safetensors", whole / f"{name}.safetensors")


def test_a_finished_training_is_not_done_again(data: Path, whole: Path) -> None:
    before = (whole / "model.safetensors").read_bytes()
    assert train(data, whole).count("already trained for 8 steps") == 2
    assert (whole / "model.safetensors").read_bytes() == before


def test_a_second_start_fits_and_perceives_nothing(
    data: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    shutil.copytree(whole, out)
    # As if it had been killed at the cell's first step.
    for name in ("training", "model"):
        (out / f"{name}.safetensors").unlink()
    asked: list[str] = []
    for kind, name in (
        (LayerPerception, "fit"),
        (LayerPerception, "fit_gallery"),
        (Colours, "fit"),
        (Backdrop, "fit_table"),
        (layers_tracks, "_see"),
    ):
        monkeypatch.setattr(kind, name, lambda *_, name=name, **__: asked.append(name))
    moved: list[int] = []
    move = EpisodePool.move_to
    monkeypatch.setattr(
        EpisodePool, "move_to", lambda pool, step: moved.append(len(pool)) or move(pool, step)
    )
    train(data, out)
    assert asked == []
    assert moved == [3]  # the held-out episodes alone are decoded
    for name in ("training", "model", "perception/training", "perception/model"):
        assert same(out / f"{name}.safetensors", whole / f"{name}.safetensors")


@pytest.mark.parametrize("settings", [{"memory_gb": 1.0}, {"model.perception.sprite": 7}])
def test_what_was_fitted_otherwise_is_not_gone_on_with(
    data: Path, whole: Path, settings: dict[str, Any]
) -> None:
    before = (whole / "perception" / "fitted.safetensors").read_bytes()
    name = next(iter(settings)).rpartition(".")[2]
    with pytest.raises(ValueError, match=rf"fitted\.safetensors: belongs to another run.*{name}"):
        train(data, whole, **settings)
    assert (whole / "perception" / "fitted.safetensors").read_bytes() == before


def test_large_is_the_same_model_at_a_size_for_a_gpu() -> None:
    small = LayersRecipe.of("default", data=Path("desk.h5"))
    large = LayersRecipe.of("large", data=Path("desk.h5"), windows=7)
    assert (small.folder, large.folder) == (Path("runs/layers"), Path("runs/layers-large"))
    assert large.model.perception.arm == dataclasses.replace(
        small.model.perception.arm, channels=(32, 64, 64, 128), hidden=512, features=256,
        patch_rank=48,
    )  # fmt: skip
    assert large.model.perception.gallery == small.model.perception.gallery
    assert large.model.cell == dataclasses.replace(small.model.cell, part_hidden=256, memory=8)
    assert large.loop == dataclasses.replace(small.loop, steps=60_000, threads=0)
    assert large.arm_loop == dataclasses.replace(small.arm_loop, steps=20_000, threads=0)
    assert (large.episodes, large.memory_gb, large.arm_batch) == (9000, 8.0, 256)
    assert (large.windows, large.short_steps) == (7, 40_000)


def test_training_the_cell_leaves_perception_as_it_was(whole: Path) -> None:
    model = load_model(whole / "model.safetensors", LayerDynamics, environment="desk")
    seen = load_model(whole / "perception/model.safetensors", LayerPerception, environment="desk")
    for name, tensor in seen.state_dict().items():
        if not name.startswith("gallery"):
            assert torch.equal(model.perception.state_dict()[name], tensor), name
    # The gallery comes last, when the arm's encoder is trained.
    assert int((model.perception.gallery.index > 0).sum()) > 10
    assert not seen.gallery.index.any()
    fresh = LayerDynamics(toy.TINY).cell.state_dict()
    assert not model.cell.state_dict()["contact"].equal(fresh["contact"])


def test_another_run_is_not_gone_on_with(data: Path, whole: Path) -> None:
    for settings in ({"windows": 5}, {"arm_batch": 5}, {"short_steps": 5}, {"episodes": 50}):
        with pytest.raises(ValueError, match=f"belongs to another run.*{next(iter(settings))}"):
            train(data, whole, **settings)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_training_runs_on_cuda(data: Path, tmp_path: Path) -> None:
    loop = dataclasses.replace(SHORT, device="cuda")
    train(data, tmp_path, arm_loop=loop, loop=loop)
    load_model(tmp_path / "model.safetensors", LayerDynamics, environment="desk")


# ---- what is learned ---------------------------------------------------------------------------


def test_the_cell_learns_how_the_hand_moves_and_is_held_back(data: Path) -> None:
    perception, _ = toy.seen()
    _, states = toy.make(0, EPISODES, STEPS)
    tracks = LayerTracks(data, perception, EPISODES)
    for seen in (tracks.states, tracks.truth):
        seen[..., :3] = states[..., :3]
    torch.manual_seed(0)
    model = LayerDynamics(toy.TINY).freeze_perception(perception)
    hands, places = tracks.contacts()
    model.fit_contact(torch.from_numpy(hands), torch.from_numpy(places))
    sampler = LayerSampler(tracks, 64, 4, 100, seed=1)
    optimiser = torch.optim.Adam(model.cell.parameters(), 1e-2)
    for step in range(130):
        loss, _ = model.loss(sampler.batch(step), torch.Generator(), step)
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        optimiser.step()
    # Squares are met beside the disc: four pixels from its middle, in the toy.
    met = model.cell.place(torch.from_numpy(states[:, 0, :3]).float()).detach().numpy()
    assert np.linalg.norm(met - toy.place(states[:, 0, :3]), axis=1).mean() < 6
    actions, fresh = toy.make(9, 60, 6)
    start = torch.cat(
        [torch.from_numpy(fresh[:, 0, :5]).float(), toy.as_seen(fresh[:, 0], perception)[:, 5:]],
        dim=1,
    )
    with torch.inference_mode():
        path = model.rollout(start, torch.from_numpy(actions)).numpy()
    error = np.linalg.norm(path[..., :3] - fresh[:, 1:, :3], axis=2).mean()
    # Adding actions up goes wrong at borders.
    summed = fresh[:, :1, :3] + np.cumsum(actions, axis=1)
    naive = np.linalg.norm(summed - fresh[:, 1:, :3], axis=2).mean()
    assert error < 0.88 * naive


# ---- what is measured --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def held_out(data: Path) -> EpisodePool:
    pool = EpisodePool(data, "validation", environment="desk")
    pool.move_to(0)
    return pool


def test_a_model_in_which_nothing_moves_errs_by_what_moves(
    data: Path, held_out: EpisodePool
) -> None:
    perception, _ = toy.seen()
    model = LayerDynamics(toy.TINY).freeze_perception(perception).requires_grad_(False).eval()
    for network in (model.cell.hand, model.cell.parts, *model.cell.sliders):
        for layer in network.modules():
            if isinstance(layer, nn.Linear):
                layer.weight.zero_()
                layer.bias.zero_()
    with torch.inference_mode():
        found = validate_layers(model, held_out).metrics
        first = perception.observe(torch.from_numpy(held_out.frames[:, 0]))
        last = perception.observe(torch.from_numpy(held_out.frames[:, 15]))
    for guess, still in (
        ("moved_parts", "moved_still"),
        ("slider_0", "slider_0_still"),
        ("slider_1", "slider_1_still"),
    ):
        assert found.get(guess) == found.get(still)
    # The toy's door is not moved in so few episodes, and the mean over nothing is no number.
    assert found.keys() >= {"moved_parts", "hand", "still_parts"}
    assert all(np.isfinite(value) for value in found.values())
    hand = (first - last)[:, :3].norm(dim=1).mean()
    assert found["hand"] == pytest.approx(float(hand), rel=1e-5)
    assert 10 < found["psnr"] < 40


def test_motion_of_codes_is_measured_against_actions(
    data: Path, held_out: EpisodePool, monkeypatch: pytest.MonkeyPatch
) -> None:
    with EpisodeFile(data) as file:
        shown = file.read(EPISODES - len(held_out), len(held_out))
    # The pool holds the same episodes in its own order.
    order = [
        int(np.flatnonzero((shown.actions == x).all(axis=(1, 2)))[0]) for x in held_out.actions
    ]
    actions, states = shown.actions[order], shown.states[order]
    model, _ = toy.seen()
    told = iter(torch.from_numpy(states).float())
    monkeypatch.setattr(model, "observe", lambda frames: next(told))
    found = validate_arm(model, held_out).metrics
    moved = np.diff(states[..., :3], axis=1) * np.sign(actions)
    for i in range(3):
        ratio = moved[..., i].sum() / np.abs(actions[..., i]).sum()
        assert found[f"moved_{i}"] == pytest.approx(ratio, rel=1e-4)
        assert found[f"back_{i}"] == pytest.approx(0, abs=1e-6)
        assert found[f"beyond_{i}"] == pytest.approx(0, abs=1e-6)


# ---- what is refused ---------------------------------------------------------------------------


def write_blank(path: Path, size: int, steps: int, actions: int) -> Path:
    """A file of four episodes in which nothing is."""
    frames = np.zeros((4, steps + 1, size, size, 3), np.uint8)
    moves, states = np.zeros((4, steps, actions), np.float32), np.zeros((4, steps + 1, 1))
    metadata = Metadata("desk", {}, 0, steps, 4, {})
    write_episodes(path, metadata, Episodes(frames, moves, states))
    return path


@pytest.mark.parametrize(
    ("size", "steps", "actions", "message"),
    [
        (16, 12, 3, r"frames are \(16, 16\), the model takes \(32, 32\)"),
        (32, 12, 2, "actions have 2 dimensions, the model's 3"),
        (32, 2, 3, "length must be from 1 to 2 for .*blank.h5, got 3"),
        (32, 12, 3, "too few coloured pixels change"),
    ],
)
def test_data_that_does_not_fit_is_one_clear_error(
    tmp_path: Path, size: int, steps: int, actions: int, message: str
) -> None:
    path = write_blank(tmp_path / "blank.h5", size, steps, actions)
    with pytest.raises(ValueError, match=message):
        train(path, tmp_path / "out")
    assert not (tmp_path / "out" / "model.safetensors").exists()


def test_episodes_too_short_to_tell_what_slides_are_an_error(tmp_path: Path) -> None:
    toy.write(tmp_path / "short.h5", 0, 60, 6)
    with pytest.raises(ValueError, match="frames: to find what slides, 2 of an episode are needed"):
        train(tmp_path / "short.h5", tmp_path / "out")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"episodes": 0}, "episodes must be at least 1"),
        ({"arm_batch": 0}, "arm_batch must be at least 1"),
        ({"windows": 0}, "windows must be at least 1"),
        ({"length": 0}, "length must be at least 1"),
        ({"memory_gb": float("nan")}, "memory_gb must be positive"),
    ],
)
def test_settings_out_of_range_are_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        LayersRecipe(data=Path("none.h5"), **settings)
