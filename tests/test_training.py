"""The training loop and checkpoints: what is resumed, what is refused, what is left in place."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import ClassVar

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from PIL import Image
from rich.console import Console
from safetensors.torch import save_file

import hvf
from hvf.files import replacing, write_bytes
from hvf.images import frame_grid
from hvf.models.checkpoint import (
    export_half,
    load_any,
    load_model,
    read_header,
    read_tensors,
    save_model,
)
from hvf.models.config import config_from_json
from hvf.models.entry import ModelEntry
from hvf.registry import MODELS
from hvf.training import loop as loop_module
from hvf.training.loop import LoopConfig, Validation, seeded, train
from hvf.training.state import fitted, save_state

QUIET = Console(quiet=True)
WEIGHTS = Path(hvf.__file__).parent / "weights"


@dataclasses.dataclass(frozen=True)
class Inner:
    sizes: tuple[int, ...] = (3, 4)
    name: str | None = None


@dataclasses.dataclass(frozen=True)
class LineConfig:
    width: int = 4
    inner: Inner = Inner()
    scale: float = 0.5

    def __post_init__(self) -> None:
        if self.width < 1:
            raise ValueError(f"width must be positive, got {self.width}")


class Line(torch.nn.Module):
    """A small network with convolution, noise, a buffer and a frozen weight."""

    config_type: ClassVar[type[LineConfig]] = LineConfig

    def __init__(self, config: LineConfig) -> None:
        super().__init__()
        self.config = config
        self.conv = torch.nn.Conv2d(2, config.width, 3)
        self.out = torch.nn.Linear(config.width, 1)
        self.frozen = torch.nn.Parameter(torch.ones(2), requires_grad=False)
        self.register_buffer("calls", torch.zeros((), dtype=torch.int64))

    def loss(
        self, batch: Mapping[str, torch.Tensor], generator: torch.Generator, step: int
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        self.calls += 1
        noise = torch.randn(batch["x"].shape, generator=generator)
        features = torch.relu(self.conv(batch["x"] + 0.1 * noise)).mean((2, 3))
        error = (self.out(features)[:, 0] - batch["y"]).square().mean()
        return error, {"error": error.detach()}


class Lines:
    """Batches that are a function of the step; ``before`` is called with every step first."""

    def __init__(self, before: Callable[[int], None] = lambda step: None) -> None:
        self.before = before

    def batch(self, step: int) -> Mapping[str, torch.Tensor]:
        self.before(step)
        generator = torch.Generator().manual_seed(step)
        x = torch.randn(8, 2, 5, 5, generator=generator)
        return {"x": x, "y": x[:, 0].mean((1, 2))}


LOOP = LoopConfig(
    steps=12,
    learning_rate=1e-2,
    schedule="cosine",
    warmup_steps=3,
    clip_norm=1.0,
    checkpoint_every=4,
    validate_every=5,
    log_every=2,
    threads=1,
    device="cpu",
)


def run(
    out: Path, sampler: Lines | None = None, loop: LoopConfig = LOOP, **options: object
) -> Line:
    model = seeded(loop.seed, lambda: Line(LineConfig()))
    return train(model, sampler or Lines(), loop, out, environment="maze", console=QUIET, **options)


def same(first: Path, second: Path) -> bool:
    """Whether two runs hold the same weights, buffers, moments and step counts, bit for bit."""
    a, b = (read_tensors(out / "training.safetensors")[0] for out in (first, second))
    return a.keys() == b.keys() and all(a[name].equal(b[name]) for name in a)


# ---- the loop ----------------------------------------------------------------------------------


def test_the_loop_is_adam_on_the_batches_of_its_sampler(tmp_path: Path) -> None:
    loop = dataclasses.replace(LOOP, clip_norm=0.0, channels_last=False)
    model = run(tmp_path, loop=loop)
    reference = seeded(0, lambda: Line(LineConfig()))
    weights = [p for p in reference.parameters() if p.requires_grad]
    optimiser = torch.optim.Adam(weights, lr=1.0)
    for step in range(12):
        warm, done = min(1.0, (step + 1) / 3), max(0, step - 3) / 9
        optimiser.param_groups[0]["lr"] = 1e-2 * warm * (1 + math.cos(math.pi * done)) / 2
        seed = int(np.random.SeedSequence([0, step]).generate_state(1, np.uint64)[0]) >> 1
        optimiser.zero_grad()
        loss, _ = reference.loss(Lines().batch(step), torch.Generator().manual_seed(seed), step)
        loss.backward()
        optimiser.step()
    for name, value in reference.state_dict().items():
        torch.testing.assert_close(model.state_dict()[name], value, rtol=1e-4, atol=1e-6)


def test_adam_has_its_betas_and_epsilon(tmp_path: Path) -> None:
    loop = dataclasses.replace(
        LOOP, steps=3, clip_norm=0.0, channels_last=False, schedule="constant", warmup_steps=0,
        betas=(0.5, 0.6), eps=0.1,
    )  # fmt: skip
    model = run(tmp_path, loop=loop)
    reference = seeded(0, lambda: Line(LineConfig()))
    weights = [p for p in reference.parameters() if p.requires_grad]
    optimiser = torch.optim.Adam(weights, lr=1e-2, betas=(0.5, 0.6), eps=0.1)
    for step in range(3):
        seed = int(np.random.SeedSequence([0, step]).generate_state(1, np.uint64)[0]) >> 1
        optimiser.zero_grad()
        loss, _ = reference.loss(Lines().batch(step), torch.Generator().manual_seed(seed), step)
        loss.backward()
        optimiser.step()
    for name, value in reference.state_dict().items():
        torch.testing.assert_close(model.state_dict()[name], value, rtol=1e-4, atol=1e-6)
    with pytest.raises(ValueError, match="betas is"):
        run(tmp_path, loop=dataclasses.replace(loop, betas=(0.5, 0.7)))


def test_runs_from_before_betas_could_be_set_are_the_same_runs(tmp_path: Path) -> None:
    run(tmp_path)
    said = read_header(tmp_path / "model.safetensors").training["loop"]
    assert not {"betas", "eps"} & said.keys()


def test_a_run_that_died_and_was_resumed_equals_one_that_did_not(tmp_path: Path) -> None:
    def die_at_7(step: int) -> None:
        if step == 7:
            raise MemoryError("killed")

    with pytest.raises(MemoryError):
        run(tmp_path / "died", Lines(die_at_7))
    assert read_header(tmp_path / "died/model.safetensors").training["step"] == 4
    drawn: list[int] = []
    resumed = run(tmp_path / "died", Lines(drawn.append))
    assert drawn == list(range(4, 12))
    whole = run(tmp_path / "whole")
    assert same(tmp_path / "died", tmp_path / "whole")
    for name, value in whole.state_dict().items():
        assert resumed.state_dict()[name].equal(value)
    assert int(resumed.calls) == 12


@pytest.mark.parametrize("done", [4, 8, 12])
def test_killed_between_weights_and_state_ends_with_the_same_of_both(
    done: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(path: Path, state: object, identity: object, step: int) -> None:
        if step == done:
            raise MemoryError("killed")
        save_state(path, state, identity, step)

    with monkeypatch.context() as patch:
        patch.setattr(loop_module, "save_state", killed)
        with pytest.raises(MemoryError):
            run(tmp_path / "died")
    # Weights come first: a state is never without the weights that belong to it.
    assert read_header(tmp_path / "died/model.safetensors").training["step"] == done
    run(tmp_path / "died")
    run(tmp_path / "whole")
    assert same(tmp_path / "died", tmp_path / "whole")
    a, b = (load_model(tmp_path / n / "model.safetensors", Line) for n in ("died", "whole"))
    assert all(a.state_dict()[name].equal(value) for name, value in b.state_dict().items())


@pytest.mark.parametrize("left", ["nothing", "older", "damaged"])
def test_a_finished_run_gets_its_weights_back(left: str, tmp_path: Path) -> None:
    def measure(model: Line, generator: torch.Generator) -> Validation:
        return Validation({"bias": float(model.out.bias)})

    run(tmp_path, validate=measure)
    path = tmp_path / "model.safetensors"
    expected, whole = read_header(path), path.read_bytes()
    path.unlink()
    if left == "older":
        save_model(path, Line(LineConfig()), environment="maze", training={"step": 8})
    elif left == "damaged":
        path.write_bytes(whole[:100])
    drawn: list[int] = []
    model = run(tmp_path, Lines(drawn.append), validate=measure)
    assert drawn == []
    assert read_header(path) == expected
    assert load_model(path, Line).out.weight.equal(model.out.weight)


def test_a_metric_that_is_no_number_is_left_out_of_the_header(tmp_path: Path) -> None:
    def measure(model: Line, generator: torch.Generator) -> Validation:
        return Validation({"mean": math.nan, "best": math.inf, "error": 0.25})

    run(tmp_path, validate=measure)
    header = read_header(tmp_path / "model.safetensors")
    assert header.training["validation"] == {"error": 0.25}
    with pytest.raises(ValueError, match="JSON"):
        save_model(tmp_path / "x", Line(LineConfig()), environment="maze", training={"x": math.nan})
    assert not (tmp_path / "x").exists()


def test_ctrl_c_saves_the_step_it_finished(tmp_path: Path) -> None:
    def interrupt_at_6(step: int) -> None:
        if step == 6:
            os.kill(os.getpid(), signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "stopped", Lines(interrupt_at_6))
    assert signal.getsignal(signal.SIGINT) is before
    step = int(read_header(tmp_path / "stopped/model.safetensors").training["step"])
    assert step in (6, 7)  # the batch of step 6 is drawn while step 5 is computed
    run(tmp_path / "stopped")
    run(tmp_path / "whole")
    assert same(tmp_path / "stopped", tmp_path / "whole")


def test_a_finished_run_is_not_trained_again(tmp_path: Path) -> None:
    first = run(tmp_path)
    drawn: list[int] = []
    again = run(tmp_path, Lines(drawn.append))
    assert drawn == []
    assert again.out.weight.equal(first.out.weight)
    assert not again.training


def test_reporting_does_not_change_the_result(tmp_path: Path) -> None:
    def measure(model: Line, generator: torch.Generator) -> Validation:
        assert not model.training
        assert torch.is_inference_mode_enabled()
        number = float(torch.randn((), generator=generator))
        return Validation({"number": number}, {"grey": np.full((4, 6, 3), 128, np.uint8)})

    loop = dataclasses.replace(LOOP, log_every=1, validate_every=2, checkpoint_every=3)
    run(tmp_path / "often", loop=loop, validate=measure)
    run(tmp_path / "seldom")
    assert same(tmp_path / "often", tmp_path / "seldom")
    pictures = sorted((tmp_path / "often/pictures").iterdir())
    assert [path.name for path in pictures] == [f"grey_{n:07d}.png" for n in range(2, 13, 2)]
    assert np.asarray(Image.open(pictures[0])).shape == (4, 6, 3)
    assert list((tmp_path / "often").glob("events.out.tfevents.*"))
    assert "number" in read_header(tmp_path / "often/model.safetensors").training["validation"]


@pytest.mark.parametrize(
    ("change", "named"),
    [({"learning_rate": 0.5}, "learning_rate"), ({"steps": 13}, "steps"), ({"seed": 1}, "seed")],
)
def test_another_run_in_the_same_place_is_refused(
    change: dict[str, float], named: str, tmp_path: Path
) -> None:
    run(tmp_path)
    before = (tmp_path / "training.safetensors").read_bytes()
    with pytest.raises(ValueError, match=f"belongs to another run.*{named}"):
        run(tmp_path, loop=dataclasses.replace(LOOP, **change))
    with pytest.raises(ValueError, match=r"belongs to another run.*data"):
        run(tmp_path, run={"data": "other"})
    assert (tmp_path / "training.safetensors").read_bytes() == before


def test_a_loss_that_is_not_finite_stops_without_saving(tmp_path: Path) -> None:
    class Diverging(Lines):
        def batch(self, step: int) -> Mapping[str, torch.Tensor]:
            batch = dict(super().batch(step))
            return {**batch, "y": batch["y"] / 0} if step >= 5 else batch

    with pytest.raises(RuntimeError, match="step 7"):
        run(tmp_path, Diverging())
    assert read_header(tmp_path / "model.safetensors").training["step"] == 4
    assert load_model(tmp_path / "model.safetensors", Line).out.weight.isfinite().all()


def test_a_damaged_state_is_one_clear_error(tmp_path: Path) -> None:
    run(tmp_path)
    path = tmp_path / "training.safetensors"
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=r"training\.safetensors"):
        run(tmp_path)
    save_file({"x": torch.zeros(1)}, path)
    with pytest.raises(ValueError, match="not a training state"):
        run(tmp_path)


def test_seeded_leaves_the_global_generator_alone() -> None:
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    a = seeded(1, lambda: Line(LineConfig()))
    assert torch.rand(3).equal(expected)
    assert a.conv.weight.equal(seeded(1, lambda: Line(LineConfig())).conv.weight)
    assert not a.conv.weight.equal(seeded(2, lambda: Line(LineConfig())).conv.weight)


@given(
    field=st.sampled_from(
        ["steps", "log_every", "validate_every", "checkpoint_every", "learning_rate"]
    ),
    value=st.integers(max_value=0),
)
def test_loop_config_names_a_bad_number(field: str, value: int) -> None:
    with pytest.raises(ValueError, match=field):
        LoopConfig(**{field: value})


@pytest.mark.parametrize("field", ["learning_rate", "weight_decay", "clip_norm"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -1.0])
def test_loop_config_refuses_what_is_not_finite(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=field):
        LoopConfig(**{field: value})


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_cuda_where_there_is_none_is_a_clear_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no CUDA device"):
        run(tmp_path, loop=dataclasses.replace(LOOP, device="cuda"))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_the_same_code_trains_on_cuda_in_bfloat16(tmp_path: Path) -> None:
    class OnDevice(Line):
        def loss(
            self, batch: Mapping[str, torch.Tensor], generator: torch.Generator, step: int
        ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
            assert batch["x"].device.type == generator.device.type == "cuda"
            assert torch.is_autocast_enabled("cuda")
            error = (self.out(self.conv(batch["x"]).mean((2, 3)))[:, 0] - batch["y"]).square()
            return error.mean(), {}

    loop = dataclasses.replace(LOOP, device="auto")
    model = train(OnDevice(LineConfig()), Lines(), loop, tmp_path, environment="maze")
    assert next(model.parameters()).is_cuda


# ---- what is fitted without gradient ----------------------------------------------------------


def test_what_is_fitted_is_fitted_once(tmp_path: Path) -> None:
    calls: list[int] = []

    def fit(model: Line) -> None:
        calls.append(1)
        model.calls.fill_(7)

    path, identity = tmp_path / "fitted.safetensors", {"seed": 1, "sizes": (2, 3)}
    for _ in range(2):
        model = fitted(path, seeded(0, lambda: Line(LineConfig())), identity, fit)
        assert int(model.calls) == 7
    assert calls == [1]
    with pytest.raises(
        ValueError, match=r"fitted\.safetensors: belongs to another run .*seed is 1"
    ):
        fitted(path, Line(LineConfig()), {**identity, "seed": 2}, fit)
    path.write_bytes(path.read_bytes()[:50])
    with pytest.raises(ValueError, match=r"fitted\.safetensors"):
        fitted(path, Line(LineConfig()), identity, fit)


def test_a_fit_that_fails_keeps_nothing(tmp_path: Path) -> None:
    def fit(model: Line) -> None:
        raise ValueError("frames: none")

    with pytest.raises(ValueError, match="frames: none"):
        fitted(tmp_path / "fitted.safetensors", Line(LineConfig()), {}, fit)
    assert not list(tmp_path.iterdir())


# ---- checkpoints -------------------------------------------------------------------------------


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    config = LineConfig(3, Inner((7, 8, 9), "x"), 0.25)
    path = tmp_path / "line.safetensors"
    save_model(path, Line(config), environment="maze", training={"command": "test", "seed": 4})
    return path


def test_a_model_comes_back_as_it_was_saved(saved: Path) -> None:
    model = load_model(saved, Line, environment="maze")
    assert model.config == LineConfig(3, Inner((7, 8, 9), "x"), 0.25)
    assert not model.training
    tensors, _ = read_tensors(saved)
    assert all(model.state_dict()[name].equal(value) for name, value in tensors.items())
    header = read_header(saved)
    assert (header.model, header.environment) == ("Line", "maze")
    assert header.training == {"command": "test", "seed": 4}


def test_a_checkpoint_of_another_class_or_environment_is_refused(saved: Path) -> None:
    class Other(Line):
        pass

    with pytest.raises(ValueError, match=r"line\.safetensors: holds a Line, expected a Other"):
        load_model(saved, Other)
    with pytest.raises(ValueError, match="for environment 'maze', expected 'desk'"):
        load_model(saved, Line, environment="desk")


def test_missing_and_foreign_checkpoints_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no\.safetensors"):
        load_model(tmp_path / "no.safetensors", Line)
    path = tmp_path / "foreign.safetensors"
    save_file({"x": torch.zeros(1)}, path)
    with pytest.raises(ValueError, match=r"foreign\.safetensors: is not a model checkpoint"):
        load_model(path, Line)
    path.write_bytes(b"\x80\x04pickle")
    with pytest.raises(ValueError, match=r"foreign\.safetensors: not a safetensors file"):
        load_model(path, Line)


@given(data=st.data())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
def test_a_cut_or_flipped_checkpoint_loads_or_is_one_clear_error(
    data: st.DataObject, saved: Path, tmp_path: Path
) -> None:
    content = bytearray(saved.read_bytes())
    path = tmp_path / "damaged.safetensors"
    if data.draw(st.booleans()):
        path.write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])
        with pytest.raises(ValueError, match=r"damaged\.safetensors"):
            load_model(path, Line)
    else:
        content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
        path.write_bytes(content)
        try:
            load_model(path, Line, environment="maze")
        except ValueError as error:
            message = str(error)
            if "damaged.safetensors" not in message:
                raise


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("out.weight", torch.zeros(1, 9), "out.weight has shape"),
        ("out.weight", torch.full((1, 4), math.nan), "out.weight holds NaN"),
        ("extra", torch.zeros(1), "holds 'extra'"),
        ("out.weight", None, "lacks the weights 'out.weight'"),
    ],
)
def test_weights_that_do_not_fit_are_named(
    name: str, value: torch.Tensor | None, message: str, tmp_path: Path
) -> None:
    class Changed(Line):
        def state_dict(self, *_: object, **__: object) -> dict[str, torch.Tensor]:
            return {k: v for k, v in {**super().state_dict(), name: value}.items() if v is not None}

    Changed.__name__ = "Line"
    save_model(tmp_path / "x.safetensors", Changed(LineConfig()), environment="maze")
    with pytest.raises(ValueError, match=rf"x\.safetensors.*{message}"):
        load_model(tmp_path / "x.safetensors", Line)


def test_a_config_that_the_model_refuses_is_named(tmp_path: Path) -> None:
    model = Line(LineConfig())
    object.__setattr__(model.config, "width", -2)
    save_model(tmp_path / "x.safetensors", model, environment="maze")
    with pytest.raises(ValueError, match=r"x\.safetensors: config of Line is not valid: width"):
        load_model(tmp_path / "x.safetensors", Line)


@given(
    width=st.integers(1, 100),
    sizes=st.lists(st.integers()).map(tuple),
    name=st.none() | st.text(),
    scale=st.floats(allow_nan=False),
)
@settings(max_examples=40)
def test_configs_survive_json(
    width: int, sizes: tuple[int, ...], name: str | None, scale: float
) -> None:
    config = LineConfig(width, Inner(sizes, name), scale)
    assert (
        config_from_json(LineConfig, json.loads(json.dumps(dataclasses.asdict(config)))) == config
    )


def test_unknown_fields_of_a_config_and_missing_ones_without_default_are_named() -> None:
    @dataclasses.dataclass(frozen=True)
    class Needs:
        width: int
        depth: int = 3

    with pytest.raises(ValueError, match="no field 'height'"):
        config_from_json(LineConfig, {**dataclasses.asdict(LineConfig()), "height": 1})
    with pytest.raises(ValueError, match="'width' of Needs is missing"):
        config_from_json(Needs, {"depth": 1})
    assert config_from_json(Needs, {"width": 2}) == Needs(2, 3)


def test_a_checkpoint_older_than_a_field_of_its_config_loads_with_the_default(
    saved: Path, tmp_path: Path
) -> None:
    tensors, metadata = read_tensors(saved)
    config = json.loads(metadata["config"])
    del config["scale"], config["inner"]["name"]
    old = tmp_path / "old.safetensors"
    save_file(tensors, old, {**metadata, "config": json.dumps(config)})
    assert load_model(old, Line).config == LineConfig(3, Inner((7, 8, 9), None), 0.5)
    save_file(tensors, old, {**metadata, "config": json.dumps({**config, "height": 1})})
    with pytest.raises(ValueError, match=r"old\.safetensors: config of Line .* no field 'height'"):
        load_model(old, Line)


# ---- models by their checkpoints ---------------------------------------------------------------


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> ModelEntry:
    """``Line`` as a model of another package, which was once called otherwise."""
    entry = ModelEntry("a line", "video", "dynamics", Line, None, formerly=("Stroke", "Rule"))
    monkeypatch.setattr(MODELS, "_targets", dict(MODELS._targets))
    MODELS.register("line", entry)
    return entry


def test_a_checkpoint_leads_to_its_model(saved: Path, registered: ModelEntry) -> None:
    found = load_any(saved, environment="maze")
    assert (found.name, found.entry, found.header.model) == ("line", registered, "Line")
    assert isinstance(found.module, Line)
    assert not found.module.training
    expected = load_model(saved, Line).state_dict()
    assert all(found.module.state_dict()[name].equal(value) for name, value in expected.items())
    with pytest.raises(ValueError, match="for environment 'maze', expected 'desk'"):
        load_any(saved, environment="desk")


@pytest.mark.parametrize("name", ["Stroke", "Rule"])
def test_a_class_is_found_by_the_names_that_it_had(
    name: str, saved: Path, registered: ModelEntry, tmp_path: Path
) -> None:
    tensors, metadata = read_tensors(saved)
    old = tmp_path / "old.safetensors"
    save_file(tensors, old, {**metadata, "model": name})
    assert load_any(old).name == "line"
    assert load_model(old, Line).config == load_model(saved, Line).config


def test_of_two_classes_of_a_name_a_checkpoint_leads_to_its_own_packages(
    saved: Path, registered: ModelEntry, tmp_path: Path
) -> None:
    theirs = type("CVAE", (Line,), {"__module__": "their.models"})
    MODELS.register("theirs", ModelEntry("a line", "video", "dynamics", theirs, None))
    path = tmp_path / "theirs.safetensors"
    save_model(path, theirs(LineConfig()), environment="kitchen")
    assert load_any(path).name == "theirs"
    assert load_any(WEIGHTS / "maze_cvae.safetensors").name == "cvae"
    # An older checkpoint does not say where its class came from, nor is ours hidden by theirs.
    tensors, metadata = read_tensors(path)
    save_file(tensors, path, {k: v for k, v in metadata.items() if k != "package"})
    with pytest.raises(ValueError, match="config of CVAE is not valid"):
        load_any(path)


def test_a_checkpoint_of_no_known_model_lists_those_that_there_are(saved: Path) -> None:
    with pytest.raises(ValueError, match=r"line\.safetensors: no model has the class 'Line'") as e:
        load_any(saved)
    assert all(f"{name} (" in str(e.value) for name in MODELS)


def test_a_package_that_cannot_be_imported_does_not_hide_the_others(
    saved: Path, registered: ModelEntry, monkeypatch: pytest.MonkeyPatch
) -> None:
    targets = {"broken": "no_such_package:MODEL", **MODELS._targets}
    monkeypatch.setattr(MODELS, "_targets", targets)
    assert load_any(saved).name == "line"
    targets.pop("line")
    with pytest.raises(ValueError, match="not to be imported: model 'broken'"):
        load_any(saved)


@pytest.mark.parametrize("path", sorted(WEIGHTS.glob("*.safetensors")), ids=lambda path: path.stem)
def test_shipped_weights_load_as_they_are_stored(path: Path) -> None:
    found = load_any(path)
    tensors, metadata = read_tensors(path)
    assert metadata["model"] in (found.entry.class_name, *found.entry.formerly)
    own = found.module.state_dict()
    assert own.keys() == tensors.keys()
    assert all(own[name].equal(value.to(own[name].dtype)) for name, value in tensors.items())
    assert type(load_model(path, type(found.module))) is found.entry.resolved("module")


def test_half_precision_is_for_what_can_bear_it(
    saved: Path, registered: ModelEntry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Line, "keep_float32", ("out.weight",), raising=False)
    size = export_half(saved, tmp_path / "half.safetensors")
    assert size == (tmp_path / "half.safetensors").stat().st_size < saved.stat().st_size
    before, after = load_model(saved, Line), load_model(tmp_path / "half.safetensors", Line)
    assert after.out.weight.equal(before.out.weight)
    assert not after.conv.weight.equal(before.conv.weight)
    torch.testing.assert_close(after.conv.weight, before.conv.weight, rtol=1e-3, atol=1e-7)
    assert read_header(tmp_path / "half.safetensors") == read_header(saved)


def test_weights_beyond_half_precision_are_named(registered: ModelEntry, tmp_path: Path) -> None:
    model = Line(LineConfig())
    with torch.no_grad():
        model.out.weight.fill_(1e6)
    save_model(tmp_path / "x.safetensors", model, environment="maze")
    with pytest.raises(ValueError, match=r"out\.weight does not fit into half precision"):
        export_half(tmp_path / "x.safetensors", tmp_path / "half.safetensors")
    assert not (tmp_path / "half.safetensors").exists()


def test_layers_keep_the_axes_that_coordinates_are_read_off_by() -> None:
    from hvf.models.layers.dynamics import LayerDynamics
    from layered_desk import random_dynamics

    tensors = random_dynamics().state_dict()
    assert set(LayerDynamics.keep_float32) <= tensors.keys()


def test_a_model_without_config_cannot_be_saved(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="Linear has no config"):
        save_model(tmp_path / "x.safetensors", torch.nn.Linear(1, 1), environment="maze")
    assert not list(tmp_path.iterdir())


# ---- files whole or not at all -----------------------------------------------------------------


def test_a_write_that_fails_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"good")

    def fail(error: BaseException) -> None:
        with replacing(path) as temporary:
            temporary.write_bytes(b"half")
            raise error

    with pytest.raises(KeyboardInterrupt):
        fail(KeyboardInterrupt())
    with pytest.raises(OSError, match="No space left") as caught:
        fail(OSError(28, "No space left on device"))
    assert caught.value.filename == str(path)
    assert caught.value.errno == 28
    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]
    assert path.read_bytes() == b"good"
    write_bytes(path, b"better")
    assert path.read_bytes() == b"better"


def test_a_path_that_cannot_be_a_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OSError, match=r"cannot write.*file/below"):
        write_bytes(tmp_path / "file/below", b"x")


# ---- pictures ----------------------------------------------------------------------------------


def test_a_grid_holds_its_frames_in_rows() -> None:
    rows = [np.full((n, 2, 3, 3), n, np.uint8) for n in (1, 2)]
    grid = frame_grid(rows, zoom=2, border=1)
    assert grid.shape == (2 * 5 + 1, 2 * 7 + 1, 3)
    assert (grid[1:5, 1:7] == 1).all()
    assert (grid[6:10, 1:7] == 2).all()
    assert (grid[6:10, 8:14] == 2).all()
    assert (grid[1:5, 8:] == 255).all()
    assert (grid[0] == 255).all()


def test_a_grid_of_nothing_or_of_other_frames_is_refused() -> None:
    frames = np.zeros((1, 2, 3, 3), np.uint8)
    for rows in ([], [frames.astype(np.float32)], [frames, frames[:, :1]]):
        with pytest.raises(ValueError, match="rows"):
            frame_grid(rows)
