"""Time-agnostic prediction: its network, loss and batches, and the method that plans with it."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from numpy.typing import NDArray
from rich.console import Console

from hvf.cli import main
from hvf.data.episodes import Episodes, Metadata
from hvf.data.formats.hdf5 import write_episodes
from hvf.data.loader import EpisodePool
from hvf.data.temporal import BetweenSampler
from hvf.evaluation.evaluation import Evaluation
from hvf.evaluation.run import evaluate
from hvf.evaluation.task import Task
from hvf.experiments.cells import Setup
from hvf.experiments.paper import tables
from hvf.models.checkpoint import save_model
from hvf.models.frames import to_frames, to_unit
from hvf.models.tap import TAP, TAPConfig
from hvf.registry import DOMAINS
from hvf.training.loop import LoopConfig, seeded
from hvf.training.recipe import train
from hvf.training.recipes.tap import TAPRecipe
from hvf.worlds.images import ImageProposer

QUIET = Console(quiet=True)
SMALL = TAPConfig(image_size=(16, 20), channels=(4, 8), hidden=16, latent_dim=3)
QUICK = {"samples": 12, "elites": 4, "iterations": 1, "horizon": 3, "steps": 3}


def frames(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).integers(0, 256, (*shape, 3), np.uint8))


def file_of(path: Path, lengths: list[int], size: tuple[int, int] = (4, 5)) -> Path:
    """Episodes whose frames say which they are: red is the episode, green the time."""
    count, steps = len(lengths), max(lengths)
    seen = np.zeros((count, steps + 1, *size, 3), np.uint8)
    seen[..., 0] = np.arange(count)[:, None, None, None]
    seen[..., 1] = np.arange(steps + 1)[None, :, None, None]
    actions = np.zeros((count, steps, 2), np.float32)
    episodes = Episodes(seen, actions, lengths=np.array(lengths))
    write_episodes(path, Metadata("own", {}, 0, steps, count, {}), episodes)
    return path


# ---- the network -------------------------------------------------------------------------------


def test_the_network_has_the_released_codes_layers_and_parameters() -> None:
    model = TAP(TAPConfig())
    assert sum(weights.numel() for weights in model.parameters()) == 1_389_387
    seen = model.encoder(torch.zeros(1, 3, 64, 64))
    assert seen.shape == (1, 128, 3, 3)
    kinds = [type(layer).__name__ for layer in model.encoder]
    # No ReLU after the last convolution, and none before the first transposed one.
    assert kinds == ["Conv2d", "ReLU"] * 3 + ["Conv2d"]
    assert [type(layer).__name__ for layer in model.decoder] == (
        ["ConvTranspose2d", "ReLU"] * 3 + ["ConvTranspose2d"]
    )
    shapes = [tuple(w.shape) for name, w in model.named_parameters() if "weight" in name]
    assert shapes[4:7] == [(512, 2304), (8, 512), (1152, 8)]


def test_the_network_is_its_layers_written_out_in_numpy() -> None:
    model = seeded(0, lambda: TAP(SMALL)).eval().double()
    weights = {name: tensor.detach().numpy() for name, tensor in model.state_dict().items()}
    start, goal = (to_unit(frames(2, 16, 20, seed=s)).double() for s in (1, 2))

    def convolved(x: NDArray[Any], layer: str) -> NDArray[Any]:
        w, b = weights[f"{layer}.weight"], weights[f"{layer}.bias"]
        height, width = ((size - 3) // 2 + 1 for size in x.shape[2:])
        out = np.zeros((len(x), len(w), height, width))
        for r, c in itertools.product(range(height), range(width)):
            window = x[:, :, 2 * r : 2 * r + 3, 2 * c : 2 * c + 3]
            out[:, :, r, c] = np.einsum("nihw,oihw->no", window, w) + b
        return out

    def grown(x: NDArray[Any], layer: str, size: tuple[int, int]) -> NDArray[Any]:
        w, b = weights[f"{layer}.weight"], weights[f"{layer}.bias"]
        out = np.zeros((len(x), w.shape[1], *(s + 3 for s in size)))
        for r, c in itertools.product(*map(range, x.shape[2:])):
            out[:, :, 2 * r : 2 * r + 3, 2 * c : 2 * c + 3] += np.einsum(
                "ni,iohw->nohw", x[:, :, r, c], w
            )
        return out[:, :, : size[0], : size[1]] + b[:, None, None]

    def dense(x: NDArray[Any], layer: str) -> NDArray[Any]:
        return x @ weights[f"{layer}.weight"].T + weights[f"{layer}.bias"]

    def encoded(images: torch.Tensor) -> NDArray[Any]:
        hidden = np.maximum(convolved(images.numpy(), "encoder.0"), 0)
        return convolved(hidden, "encoder.2").reshape(2, -1)

    both = np.concatenate([encoded(start), encoded(goal)], axis=1)
    latent = dense(np.maximum(dense(both, "bottleneck.0"), 0), "bottleneck.2")
    features = dense(latent, "features").reshape(2, 8, *SMALL.sizes[-1])
    hidden = np.maximum(grown(features, "decoder.0", SMALL.sizes[1]), 0)
    logits = grown(hidden, "decoder.2", SMALL.sizes[0])
    expected = np.clip(1 / (1 + np.exp(-logits)), 1e-3, 1 - 1e-3)
    found = model(start, goal).detach().numpy()
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def test_the_loss_is_the_nearest_candidates_likelihood_written_out() -> None:
    model = seeded(0, lambda: TAP(SMALL)).eval()
    batch = {"start": frames(3, 16, 20), "end": frames(3, 16, 20, seed=1)}
    batch["candidates"] = frames(3, 4, 16, 20, seed=2)
    loss, said = model.loss(batch, torch.Generator(), 0)
    p = model(to_unit(batch["start"]), to_unit(batch["end"])).detach().double().numpy()
    each = np.zeros((3, 4))
    for b, c in itertools.product(range(3), range(4)):
        frame = batch["candidates"][b, c].numpy().transpose(2, 0, 1) / 255
        each[b, c] = -(frame * np.log(p[b]) + (1 - frame) * np.log(1 - p[b])).sum()
    assert loss.item() == pytest.approx(each.min(1).mean(), rel=1e-5)
    assert said["candidate"].item() == pytest.approx(each.argmin(1).mean())
    # With the pyramid, as the CVAE's: summed squares of pooled differences, by pixels.
    wider = TAP(dataclasses.replace(SMALL, pyramid_levels=1, pyramid_weight=2.0)).eval()
    wider.load_state_dict(model.state_dict())
    chosen = np.stack([batch["candidates"][b, each[b].argmin()].numpy() for b in range(3)])
    apart = p - chosen.transpose(0, 3, 1, 2) / 255
    pooled = apart.reshape(3, 3, 8, 2, 10, 2).mean((3, 5))
    expected = loss.item() + 2 * 8 * (pooled**2).sum() / 3
    assert wider.loss(batch, torch.Generator(), 0)[0].item() == pytest.approx(expected, rel=1e-5)
    # Only the nearest candidate pulls: others may be anything further.
    batch["candidates"][0, each[0].argmax()] = 255 - batch["candidates"][0, each[0].argmin()]
    assert model.loss(batch, torch.Generator(), 0)[0].item() == pytest.approx(loss.item())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"image_size": (30, 64)}, "image_size must be .* four|image_size must be"),
        ({"image_size": (64,)}, "image_size must be"),
        ({"channels": ()}, "channels must be positive"),
        ({"pyramid_levels": 7}, "pyramid_levels must be from 0"),
        ({"initialisation": "zero"}, "initialisation must be he or truncated-normal"),
        ({"latent_dim": 0}, "latent_dim must be at least 1"),
        ({"least_probability": 0.0}, "least_probability must be between"),
    ],
)
def test_a_config_that_cannot_be_is_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TAPConfig(**settings)


def test_a_centred_model_sees_and_draws_differences_to_the_mean_image() -> None:
    model = seeded(0, lambda: TAP(dataclasses.replace(SMALL, centred=True))).eval()
    seen = frames(9, 16, 20, seed=3)
    model.centre(seen)
    mean = seen.double().mean(0).permute(2, 0, 1) / 255
    torch.testing.assert_close(model.mean_image.double(), mean, rtol=1e-6, atol=1e-6)
    with torch.no_grad():
        for weights in model.decoder.parameters():
            weights.zero_()
    still = model(mean[None].float(), mean[None].float())
    torch.testing.assert_close(still[0].double(), mean.clamp(1e-2, 0.99), rtol=1e-4, atol=1e-5)
    with pytest.raises(ValueError, match=r"frames must be \[N, 16, 20, 3\]"):
        model.centre(frames(2, 16, 16))
    with pytest.raises(ValueError, match="centre: the config says"):
        TAP(SMALL).centre(seen)


def test_images_of_another_size_are_refused_by_name() -> None:
    model = TAP(SMALL)
    good, bad = torch.zeros(2, 3, 16, 20), torch.zeros(2, 3, 16, 16)
    with pytest.raises(ValueError, match=r"start: expected shape \[B, 3, 16, 20\]"):
        model(bad, good)
    with pytest.raises(ValueError, match="goal: expected shape"):
        model(good, bad)
    with pytest.raises(ValueError, match="goal: must be 2 images"):
        model(good, good[:1])


# ---- batches -----------------------------------------------------------------------------------


@given(
    lengths=st.lists(st.integers(3, 40), min_size=2, max_size=6),
    nearest=st.integers(1, 12),
    more=st.integers(0, 8),
    margin=st.integers(0, 5),
    seed=st.integers(0, 2**31),
)
@settings(max_examples=40, deadline=None)
def test_starts_ends_and_candidates_are_the_released_codes(
    tmp_path_factory: pytest.TempPathFactory,
    lengths: list[int],
    nearest: int,
    more: int,
    margin: int,
    seed: int,
) -> None:
    furthest = nearest + more
    folder = tmp_path_factory.mktemp("between")
    pool = EpisodePool(file_of(folder / "own.h5", [*lengths, 2]), seed=seed)
    try:
        if nearest <= 2 * margin or pool.longest < furthest + 1:
            with pytest.raises(ValueError, match=r"^(nearest must be|furthest: the longest)"):
                BetweenSampler(pool, 64, nearest, furthest, margin, seed)
            return
        sampler = BetweenSampler(pool, 64, nearest, furthest, margin, seed)
        batch = {name: frames.numpy() for name, frames in sampler.batch(3).items()}
        again = sampler.batch(3)
        assert all((again[name].numpy() == batch[name]).all() for name in batch)
    finally:
        pool.close()
    most = furthest - 2 * margin
    assert batch["candidates"].shape == (64, most, 4, 5, 3)
    for b in range(64):
        episode, start = batch["start"][b, 0, 0, :2].astype(int)
        other, end = batch["end"][b, 0, 0, :2].astype(int)
        assert episode == other
        steps = lengths[episode]
        # choice(frames - 20), then range(start + 12, start + 20), of the released code.
        assert 0 <= start < steps + 1 - (furthest + 1)
        assert nearest <= end - start <= furthest
        between = [*range(start + margin, end - margin)]
        assert (batch["candidates"][b, :, 0, 0, 0] == episode).all()
        times = batch["candidates"][b, :, 0, 0, 1].tolist()
        assert times == between + between[-1:] * (most - len(between))


def test_every_start_and_every_end_is_drawn(tmp_path: Path) -> None:
    pool = EpisodePool(file_of(tmp_path / "own.h5", [24] * 4))
    batch = BetweenSampler(pool, 4000).batch(0)
    starts, ends = (batch[name][:, 0, 0, 1].long() for name in ("start", "end"))
    assert set(starts.tolist()) == set(range(25 - 20))
    assert set((ends - starts).tolist()) == set(range(12, 20))
    counts = np.bincount((ends - starts).numpy())[12:]
    assert abs(counts / 4000 - 1 / 8).max() < 5 * np.sqrt(1 / 8 * 7 / 8 / 4000)
    pool.close()


def test_a_pool_that_holds_no_long_episode_says_how_to_help(tmp_path: Path) -> None:
    # Frames of the maze's size, so that one episode fills the pool.
    path = file_of(tmp_path / "own.h5", [3, 3, 3, 25, 3], (64, 64))
    pool = EpisodePool(path, memory_gb=26 * 64 * 64 * 3 / 1e9)
    sampler = BetweenSampler(pool, 2)
    found, said = [], []
    for step in range(4):
        try:
            found.append(sampler.batch(step)["start"][0, 0, 0, 0].item())
        except ValueError as error:
            said.append(str(error))
    assert found == [3]
    assert len(said) == 3
    assert all("furthest: none of the 1 episodes in memory at step" in words for words in said)
    assert all("(memory_gb)" in words for words in said)
    pool.close()


# ---- proposals and the method ------------------------------------------------------------------


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained TAP of the maze's size, small."""
    path = tmp_path_factory.mktemp("tap") / "model.safetensors"
    config = TAPConfig(channels=(4, 4, 8, 8), hidden=16)
    save_model(path, seeded(1, lambda: TAP(config)), environment="maze")
    return path


def test_several_subgoals_are_proposed_from_the_goal_backwards() -> None:
    model = seeded(0, lambda: TAP(SMALL)).eval()
    start, goal = frames(16, 20, seed=1).numpy(), frames(16, 20, seed=2).numpy()

    def tap(first: Any, later: Any) -> Any:
        pair = (to_unit(torch.from_numpy(image)[None]) for image in (first, later))
        return to_frames(model(*pair).detach())[0].numpy()

    proposer = ImageProposer(model)
    one = tap(start, goal)
    np.testing.assert_array_equal(proposer.propose(start, goal, 1), [one])
    two = tap(start, one)
    np.testing.assert_array_equal(proposer.propose(start, goal, 2), [two, one])
    three = tap(start, two)
    np.testing.assert_array_equal(proposer.propose(start, goal, 3), [three, two, one])
    assert proposer.propose(start, goal, 0).shape == (0, 16, 20, 3)


def test_the_method_is_evaluated_by_name_alone_and_in_a_batch(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = {"method": "tap", "subgoals": 1, "method_model": str(checkpoint), **QUICK}
    report = evaluate(Evaluation.of("maze", **settings), 3, chunk=3, console=QUIET)
    alone = evaluate(Evaluation.of("maze", **settings), 3, chunk=1, console=QUIET)
    assert [(t.success, t.steps, t.switches) for t in report.trials] == [
        (t.success, t.steps, t.switches) for t in alone.trials
    ]
    assert report.name == "maze hard: TAP-1, keypoint"
    assert report.world["method"] == str(checkpoint)
    assert report.weights["method"]["model"] == "tap"
    assert report.kind == "object"  # the dynamics are
    out = tmp_path / "report.json"
    words = ["--method", "tap", "--subgoals", "1", "--method-model", str(checkpoint)]
    quick = [word for name, n in QUICK.items() for word in (f"--{name}", str(n))]
    assert main(["eval", "maze", *words, *quick, "--trials", "1", "--out", str(out)]) == 0
    assert "TAP-1" in capsys.readouterr().out


def test_files_of_other_models_have_other_names(checkpoint: Path) -> None:
    one = Evaluation.of("maze", method="tap", subgoals=1)
    other = dataclasses.replace(
        one, world=dataclasses.replace(one.world, method_model=str(checkpoint))
    )
    assert one.slug != other.slug
    # Of no account to a method that asks no model.
    none = Evaluation.of("maze", method="none", method_model=str(checkpoint))
    assert none.slug == Evaluation.of("maze", method="none").slug


def test_a_model_that_is_not_there_or_cannot_propose_is_named(tmp_path: Path) -> None:
    cvae = str(DOMAINS["maze"].weights["cvae"])
    with pytest.raises(ValueError, match=r"method_model: .* holds a cvae model, .* for generator"):
        Task.open(Evaluation.of("maze", method="tap", subgoals=1, method_model=cvae))
    missing = Evaluation.of("maze", method="tap", subgoals=1, method_model="none.safetensors")
    with pytest.raises(FileNotFoundError, match=r"method_model: 'none\.safetensors' is neither"):
        Task.open(missing)


def test_rows_of_the_papers_table_are_those_whose_models_ship(
    checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    maze = DOMAINS["maze"]
    for ships in (False, True):
        weights = {name: path for name, path in maze.weights.items() if name != "tap"}
        weights |= {"tap": checkpoint} if ships else {}
        changed = dataclasses.replace(maze, weights=weights)
        monkeypatch.setitem(DOMAINS._targets, "maze", changed)
        rows = tables(Setup("maze"), ["methods"])[0].rows
        assert ("TAP-1" in rows, "TAP-2" in rows) == (ships, ships)


# ---- training ----------------------------------------------------------------------------------


def test_the_papers_preset_is_the_released_training() -> None:
    recipe = TAPRecipe.of("paper", data=Path("x.h5"))
    assert (recipe.batch_size, recipe.nearest, recipe.furthest, recipe.margin) == (256, 12, 19, 5)
    assert recipe.model == TAPConfig()
    assert recipe.model.pyramid_levels == 0
    loop = recipe.loop
    assert (loop.steps, loop.learning_rate, loop.schedule) == (100_000, 1e-3, "constant")
    assert (loop.warmup_steps, loop.weight_decay, loop.clip_norm) == (0, 0, 0)


def test_training_finds_what_lies_between_and_repeats_to_the_bit(tmp_path: Path) -> None:
    """A bar that grows by a pixel a step, so that what lies between can be known."""
    rng = np.random.default_rng(0)
    episodes, steps = 24, 14
    seen = np.zeros((episodes, steps + 1, 16, 20, 3), np.uint8)
    for episode in range(episodes):
        row = rng.integers(1, 14)
        for t in range(steps + 1):
            seen[episode, t, row : row + 2, : t + 3] = 255
    data = tmp_path / "bars.h5"
    actions = np.zeros((episodes, steps, 1), np.float32)
    write_episodes(data, Metadata("own", {}, 0, steps, episodes, {}), Episodes(seen, actions))
    model = dataclasses.replace(
        TAPRecipe(data=data).model, channels=(8, 16), hidden=64, image_size=(16, 20), latent_dim=4
    )
    settings: dict[str, Any] = {
        "console": QUIET, "model": model, "nearest": 8, "furthest": 9, "margin": 3,
    }  # fmt: skip
    loop = LoopConfig(steps=300, learning_rate=3e-3, validate_every=150, device="cpu", threads=1)
    trained = [
        train("tap", data, out=tmp_path / out, loop=dataclasses.replace(loop, steps=n), **settings)
        for out, n in (("one", 300), ("two", 300), ("begun", 1))
    ]
    first, second = (model.state_dict() for model in trained[:2])
    assert all(torch.equal(first[name], second[name]) for name in first)
    pool = EpisodePool(data, "train")
    batch = BetweenSampler(pool, 64, 8, 9, 3).batch(10**6)
    pool.close()
    errors = [m.loss(batch, torch.Generator(), 0)[1]["mse"].item() for m in trained]
    apart = (batch["candidates"].float() - batch["start"].float()[:, None]) / 255
    copied = apart.square().flatten(2).mean(2).min(1).values.mean().item()
    assert errors[0] < 0.5 * min(copied, errors[2]), (errors, copied)


def test_episodes_that_are_too_short_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"furthest: the longest episode has 19 steps"):
        train("tap", file_of(tmp_path / "own.h5", [19, 8, 19], (64, 64)), out=tmp_path / "run")
    with pytest.raises(ValueError, match=r"own2\.h5: the model cannot take its images"):
        train("tap", file_of(tmp_path / "own2.h5", [25] * 3), out=tmp_path / "run")
