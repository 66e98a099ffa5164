"""Recipes: settings and presets, the one driver, and every model trained by the command line."""

from __future__ import annotations

import dataclasses
import io
import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from rich.console import Console

import toy_desk as toy
from hvf.cli import main
from hvf.data.episodes import Episodes, Metadata
from hvf.data.formats.hdf5 import write_episodes
from hvf.data.loader import EpisodePool, WindowSampler
from hvf.domains.maze_collection import MazeCollection
from hvf.models.checkpoint import load_any, read_header
from hvf.models.entry import ModelEntry
from hvf.models.vae import PAPER_CVAE, CVAEConfig
from hvf.registry import MODELS
from hvf.training.loop import LoopConfig, Validation, seeded
from hvf.training.recipe import Recipe, Stage, Stages, TrainingData, recipe_class, train
from hvf.training.recipe import run as run_recipe
from hvf.training.recipes import layers as layers_recipe
from hvf.training.recipes.vae import CVAERecipe

QUIET = Console(quiet=True)
SHORT = LoopConfig(steps=2, device="cpu", threads=1)


@pytest.fixture(scope="module")
def maze(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("maze") / "maze.h5"
    return MazeCollection(path, episodes=24, steps=10).run(QUIET)


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("desk") / "desk.h5"
    toy.write(path, 0, 60, 20)
    return path


# ---- settings and presets ----------------------------------------------------------------------


def test_settings_reach_into_fields_of_fields() -> None:
    recipe = CVAERecipe.of(
        "default",
        data=Path("x.h5"),
        batch_size=3,
        loop={"steps": 7, "seed": 2},
        **{"model.latent_dim": 5, "model.channels": (4, 4, 4, 4)},
    )
    plain = CVAERecipe(data=Path("x.h5"))
    assert recipe == dataclasses.replace(
        plain,
        batch_size=3,
        loop=dataclasses.replace(plain.loop, steps=7, seed=2),
        model=dataclasses.replace(plain.model, latent_dim=5, channels=(4, 4, 4, 4)),
    )


def test_paths_may_be_words() -> None:
    recipe = recipe_class("layers-generator").of("default", data="x.h5", dynamics="y", out="z")
    assert (recipe.data, recipe.dynamics, recipe.folder) == (Path("x.h5"), Path("y"), Path("z"))


def test_fields_that_fit_only_together_are_set_together() -> None:
    both = {"model.channels": (4, 8), "model.strides": (2, 2)}
    assert CVAERecipe.of("default", data=Path("x.h5"), **both).model.strides == (2, 2)
    with pytest.raises(ValueError, match="strides must be 1 or 2"):
        CVAERecipe.of("default", data=Path("x.h5"), **{"model.channels": (4, 8)})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"bath_size": 3}, "CVAERecipe has no setting 'bath_size'; it has batch_size, camera"),
        ({"loop.stps": 3}, "LoopConfig has no setting 'stps'"),
        ({"batch_size.x": 3}, "CVAERecipe.batch_size has no setting 'x'"),
        ({"batch_size": 0}, "batch_size must be at least 1"),
        (
            {"preset": "papr"},
            "preset: must be one of default, paper, bair, paper-bair, desk; got 'papr'",
        ),
    ],
)
def test_settings_that_there_are_not_are_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        train("cvae", "none.h5", **settings)


def test_the_papers_preset_is_all_of_the_papers_training() -> None:
    recipe = CVAERecipe.of("paper", data=Path("x.h5"), batch_size=2)
    assert recipe.model == PAPER_CVAE
    assert recipe.batch_size == 2
    assert CVAERecipe.of("paper", data=Path("x.h5")).batch_size == 256
    loop = recipe.loop
    assert (loop.steps, loop.learning_rate, loop.schedule) == (100_000, 1e-4, "constant")
    assert (loop.warmup_steps, loop.weight_decay, loop.clip_norm) == (0, 0, 0)
    assert recipe.folder == Path("runs/cvae-paper")


def test_every_preset_of_every_recipe_is_a_recipe() -> None:
    for name in MODELS:
        kind = recipe_class(name)
        assert kind.name == name
        for preset in ("default", *kind.presets):
            recipe = kind.of(preset, data=Path("x.h5"))
            assert (recipe.preset, recipe.loop.seed) == (preset, 0)


def test_unknown_models_and_models_without_recipe_are_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.raises(ValueError, match=r"model: must be one of keypoint, .*; got 'sv3p'"):
        train("sv3p", "none.h5")
    monkeypatch.setattr(MODELS, "_targets", dict(MODELS._targets))
    MODELS.register("fixed", ModelEntry("cannot learn", "video", "dynamics", Counter, None))
    with pytest.raises(ValueError, match="'fixed' has no recipe"):
        train("fixed", "none.h5")
    with pytest.raises(FileNotFoundError, match=r"none\.h5"):
        train("cvae", "none.h5")


# ---- the driver --------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class CounterConfig:
    actions: int = 1


class Counter(torch.nn.Module):
    """Learns the mean action."""

    config_type: ClassVar[type[CounterConfig]] = CounterConfig

    def __init__(self, config: CounterConfig) -> None:
        super().__init__()
        self.config = config
        self.mean = torch.nn.Parameter(torch.zeros(config.actions))

    def loss(
        self, batch: Mapping[str, torch.Tensor], generator: torch.Generator, step: int
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        return (batch["actions"][:, 0] - self.mean).square().mean(), {}


@dataclasses.dataclass(frozen=True, kw_only=True)
class CounterRecipe(Recipe):
    """A recipe of another package, in two stages."""

    name: ClassVar[str] = "counter"
    made: ClassVar[list[Any]] = []

    loop: LoopConfig = SHORT
    twice: bool = True

    def stages(self, data: TrainingData) -> Stages:
        pool = data.pool()
        self.made[:] = [data, pool]
        config = CounterConfig(data.action_dim)
        first = seeded(self.loop.seed, lambda: Counter(config))
        sampler = WindowSampler(pool, 4, 1, self.loop.seed)
        if self.twice:
            first = yield Stage(first, sampler, self.loop, "first: half", folder="first")
            self.made.append(first)
        second = Counter(config)
        second.load_state_dict(first.state_dict())
        yield Stage(
            second,
            sampler,
            self.loop,
            "second: half",
            settings={"twice": self.twice},
            validate=lambda model, _: Validation({"mean": float(model.mean.sum())}),
        )


@pytest.fixture
def counter(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MODELS, "_targets", dict(MODELS._targets))
    entry = ModelEntry("counts", "video", "dynamics", Counter, None, recipe=CounterRecipe)
    MODELS.register("counter", entry)


@pytest.fixture
def own_data(tmp_path: Path) -> Path:
    """Episodes of a place that this package does not know."""
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (30, 5, 12, 20, 3), np.uint8)
    actions = rng.uniform(0, 1, (30, 4, 6)).astype(np.float32)
    path = tmp_path / "kitchen.h5"
    metadata = Metadata("kitchen", {"colour": "red"}, 3, 4, 30, {})
    write_episodes(path, metadata, Episodes(frames, actions, np.zeros((30, 5, 1))))
    return path


def test_a_recipe_of_another_package_is_driven_like_ours(
    own_data: Path, counter: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    said = io.StringIO()
    model = train("counter", own_data, console=Console(file=said, width=300))
    data, _, first = CounterRecipe.made
    assert (data.environment, data.image_size, data.action_dim) == ("kitchen", (12, 20), 6)
    assert (data.training, len(data.held_out)) == (29, 1)
    assert isinstance(model, Counter)
    assert not model.training
    assert model.mean.norm() > first.mean.norm() > 0
    assert said.getvalue().index("first: half") < said.getvalue().index("second: half")
    header = read_header("runs/counter/model.safetensors")
    assert header.environment == "kitchen"
    assert header.training["command"] == "hvf train counter"
    assert header.training["data"]["parameters"] == {"colour": "red"}
    assert header.training["twice"] is True
    assert header.training["validation"].keys() == {"mean"}
    assert "twice" not in read_header("runs/counter/first/model.safetensors").training
    assert load_any("runs/counter/model.safetensors").name == "counter"
    with pytest.raises(ValueError, match=r"belongs to another run .*twice"):
        train("counter", own_data, console=QUIET, twice=False)


@pytest.mark.parametrize(
    ("low", "high", "largest"), [((-2.0, -3.0), (1.0, 2.5), 3.0), (None, None, None)]
)
def test_the_largest_action_is_that_of_the_box_if_the_data_has_one(
    low: tuple[float, ...] | None, high: tuple[float, ...] | None, largest: float | None,
    own_data: Path,
) -> None:  # fmt: skip
    with TrainingData(own_data, 0, QUIET) as data:
        data.metadata = SimpleNamespace(action_low=low, action_high=high)  # type: ignore[assignment]
        assert data.largest_action == largest


def test_episodes_of_different_lengths_train_what_can_take_them(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (30, 13, 16, 16, 3), np.uint8)
    lengths = rng.integers(10, 13, 30)
    lengths[0] = 12
    for i, length in enumerate(lengths):
        frames[i, length + 1 :] = 0
    actions = np.zeros((30, 12, 2), np.float32)
    path = tmp_path / "video.h5"
    metadata = Metadata("video", {}, None, 12, 30, {}, cameras=("front",))
    write_episodes(path, metadata, Episodes(frames, actions, lengths=lengths))
    small = {"channels": (4, 8), "strides": (2, 2), "pyramid_levels": 2}
    settings = {"loop": SHORT, "batch_size": 2, "console": QUIET}
    model = train("cvae", path, out=tmp_path / "cvae", camera="front", model=small, **settings)
    assert read_header(tmp_path / "cvae/model.safetensors").training["camera"] == "front"
    # The mean image is of every tenth frame of those that there are.
    seen = [frames[i, ::10][: (lengths[i] // 10) + 1] for i in range(29)]
    expected = np.concatenate(seen).mean(axis=0).transpose(2, 0, 1) / 255
    np.testing.assert_allclose(model.mean_image.numpy(), expected, atol=1e-5)
    with pytest.raises(ValueError, match="front"):
        train("cvae", path, out=tmp_path / "side", camera="side", model=small, **settings)
    with pytest.raises(ValueError, match=r"video\.h5: episodes are 10 to 12 steps long"):
        train("keypoint", path, out=tmp_path / "keypoint", console=QUIET)
    assert not (tmp_path / "keypoint").exists()


def test_files_are_closed_whatever_happens(
    own_data: Path, counter: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[EpisodePool] = []
    closed: list[EpisodePool] = []
    begin, close = EpisodePool.__init__, EpisodePool.close

    def noted(pool: EpisodePool, *arguments: Any, **options: Any) -> None:
        opened.append(pool)
        begin(pool, *arguments, **options)

    monkeypatch.setattr(EpisodePool, "__init__", noted)
    monkeypatch.setattr(EpisodePool, "close", lambda pool: closed.append(pool) or close(pool))
    train("counter", own_data, out=tmp_path / "a", console=QUIET)
    monkeypatch.setattr(Counter, "loss", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        train("counter", own_data, out=tmp_path / "b", console=QUIET)
    assert len(opened) == 4
    assert all(any(pool is other for other in closed) for pool in opened)


def test_a_recipe_without_stages_is_a_clear_error(own_data: Path) -> None:
    class Nothing(CounterRecipe):
        def stages(self, data: TrainingData) -> Stages:
            yield from ()

    with pytest.raises(TypeError, match="Nothing has no stage"):
        run_recipe(Nothing(data=own_data), QUIET)


# ---- entries -----------------------------------------------------------------------------------


def test_models_are_listed_without_torch() -> None:
    program = (
        "import sys; from hvf.registry import MODELS\n"
        "for name in MODELS: print(name, MODELS[name].kind, MODELS[name].class_name)\n"
        "assert 'torch' not in sys.modules"
    )
    found = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60
    )
    kinds = {line.split()[0]: line.split()[1] for line in found.stdout.splitlines()}
    assert kinds == {
        "keypoint": "object",
        "keypoint-generator": "object",
        "temporal-distance": "object",
        "layers": "object",
        "layers-generator": "object",
        "layers-proposals": "object",
        "layers-distance": "object",
        "cvae": "video",
        "vae": "video",
        "sv2p": "video",
        "sv2p-small": "video",
        "spatial-latent": "video",
        "tap": "video",
        "tdm": "video",
        "rig": "video",
        "latent": "video",
    }


def test_every_entry_says_what_its_model_assumes_and_leads_to_it() -> None:
    for name in MODELS:
        entry = MODELS[name]
        assert entry.about
        assert entry.assumes
        module = entry.resolved("module")
        assert module.__name__ == entry.class_name
        assert dataclasses.is_dataclass(module.config_type)
        assert callable(entry.resolved("plannable"))
        assert entry.resolved("recipe") is recipe_class(name)


# ---- the command line --------------------------------------------------------------------------


def command(*words: object) -> None:
    assert main([str(word) for word in words]) == 0


LOOP = ("--loop.steps", 2, "--loop.threads", 1, "--loop.device", "cpu")


def test_hvf_train_trains_the_models_of_the_maze(maze: Path, tmp_path: Path) -> None:
    out = tmp_path / "keypoint"
    first = ("--perception-loop.steps", 2, "--perception-loop.threads", 1)
    command("train", "keypoint", "--data", maze, "--out", out, "--episodes", 8, *first, *LOOP)
    dynamics = out / "model.safetensors"
    for name in ("keypoint-generator", "temporal-distance"):
        out = tmp_path / name
        command(
            "train", name, "--data", maze, "--dynamics", dynamics, "--out", out,
            "--episodes", 8, "--batch-size", 16, *LOOP,
        )  # fmt: skip
    command("train", "cvae", "--data", maze, "--out", tmp_path / "cvae", "--batch-size", 2, *LOOP)
    for name in ("keypoint", "keypoint-generator", "temporal-distance", "cvae"):
        found = load_any(tmp_path / name / "model.safetensors", environment="maze")
        assert found.name == name
        assert found.header.training["step"] == 2


def test_hvf_train_trains_the_models_of_the_desk(
    desk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(layers_recipe, "_PAIRS", 400)
    sizes = {
        "--model.perception.colours.image-size": 32,
        "--model.perception.colours.parts": 5,
        "--model.perception.sprite": 9,
        "--model.perception.backdrop.bins": (11, 8),
        "--model.perception.gallery.places": (5, 6, 2),
        "--model.perception.gallery.patches": 400,
        "--model.perception.arm.channels": (4, 8),
        "--arm-batch": 4,
        "--windows": 4,
        "--length": 3,
    }
    words: list[object] = []
    for option, value in sizes.items():
        words += [option, *(value if isinstance(value, tuple) else (value,))]
    out = tmp_path / "layers"
    first = ("--arm-loop.steps", 2, "--arm-loop.threads", 1)
    command("train", "layers", "--data", desk, "--out", out, *words, *first, *LOOP)
    dynamics = out / "model.safetensors"
    out = tmp_path / "layers-generator"
    command(
        "train", "layers-generator", "--data", desk, "--dynamics", dynamics, "--out", out,
        "--batch-size", 16, *LOOP,
    )  # fmt: skip
    again = ("--dynamics", dynamics, "--generator", out / "model.safetensors", "--batch-size", 16)
    out = tmp_path / "layers-proposals"
    command("train", "layers-proposals", "--data", desk, "--out", out, *again, *LOOP)
    out = tmp_path / "layers-distance"
    command(
        "train", "layers-distance", "--data", desk, "--dynamics", dynamics, "--out", out,
        "--batch-size", 16, *LOOP,
    )  # fmt: skip
    cell = ("--perception", dynamics, "--windows", 4, "--length", 3, "--pushed", 0.5)
    command("train", "layers", "--data", desk, "--out", tmp_path / "cell", *cell, *LOOP)
    kept, found = (
        load_any(path).module.perception
        for path in (dynamics, tmp_path / "cell" / "model.safetensors")
    )
    for name, value in kept.state_dict().items():
        assert found.state_dict()[name].equal(value), name
    command("train", "vae", "--data", desk, "--out", tmp_path / "vae", "--batch-size", 2, *LOOP)
    for name in ("layers", "layers-generator", "layers-proposals", "layers-distance", "vae"):
        found = load_any(tmp_path / name / "model.safetensors", environment="desk")
        assert found.name == name
    half = tmp_path / "half.safetensors"
    command("export", "--source", dynamics, "--target", half)
    before, after = load_any(dynamics).module, load_any(half).module
    kept = before.keep_float32
    for name, value in before.state_dict().items():
        stored = after.state_dict()[name]
        if name in kept or not value.is_floating_point():
            assert stored.equal(value), name
        else:
            assert stored.equal(value.half().float()), name
    # Where the hand meets parts is read off to the last bit.
    hands = torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    assert before.cell.place(hands).equal(after.cell.place(hands))


def test_a_preset_fills_in_what_is_not_said(maze: Path, tmp_path: Path) -> None:
    command(
        "train", "cvae", "--preset", "paper", "--data", maze, "--out", tmp_path,
        "--loop.steps", 1, "--batch-size", 2, "--loop.device=cpu", "--model.latent-dim", 3,
    )  # fmt: skip
    header = read_header(tmp_path / "model.safetensors")
    expected = dataclasses.asdict(dataclasses.replace(PAPER_CVAE, latent_dim=3))
    assert header.config == json.loads(json.dumps(expected))
    training = header.training
    assert (training["preset"], training["batch_size"]) == ("paper", 2)
    assert training["loop"]["learning_rate"] == 1e-4
    assert training["loop"]["precision"] == "float32"


def test_the_command_line_and_python_train_the_same(maze: Path, tmp_path: Path) -> None:
    command(
        "train", "cvae", "--data", maze, "--out", tmp_path / "a", "--batch-size", 2,
        "--model.channels", 4, 8, "--model.strides", 2, 2, *LOOP,
    )  # fmt: skip
    loop = {"steps": 2, "threads": 1, "device": "cpu"}
    model = train(
        "cvae", maze, out=tmp_path / "b", batch_size=2, loop=loop, console=QUIET,
        **{"model.channels": (4, 8), "model.strides": (2, 2)},
    )  # fmt: skip
    assert model.config == CVAEConfig(channels=(4, 8), strides=(2, 2))
    found = load_any(tmp_path / "a/model.safetensors").module.state_dict()
    assert all(found[name].equal(value) for name, value in model.state_dict().items())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--help"], "temporal-distance"),
        (["layers", "--help"], "--arm-loop.steps"),
        (["layers", "--preset", "large", "--help"], "60000"),
        (["layers", "--preset=large", "--help"], "60000"),
        (["cvae", "--help"], "Presets: default, paper, bair"),
    ],
)
def test_help_shows_models_options_and_what_holds(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as left:
        main(["train", *words])
    assert left.value.code == 0
    assert said in capsys.readouterr().out


@pytest.mark.parametrize("words", [["cvae"], ["cvae", "--data", "x.h5", "--bath-size", "3"]])
def test_what_is_not_said_right_is_an_error(words: list[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main(["train", *words])
    assert left.value.code == 2


def test_what_cannot_be_used_is_one_line(
    maze: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words, message in (
        (["sv3p"], "must be one of keypoint"),
        (["cvae", "--data", str(tmp_path / "no.h5")], "no such data file"),
        (["cvae", "--data", str(maze), "--preset", "papr"], "preset: must be one of"),
        (["layers", "--data", str(maze), "--length", "5"], "actions have 2 dimensions"),
    ):
        assert main(["train", *words]) == 2
        assert message in " ".join(capsys.readouterr().err.split())
