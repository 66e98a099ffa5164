"""The latent model: what it sees, what it costs, what it learns, and how it is kept."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from rich.console import Console
from scipy.ndimage import gaussian_filter

import hvf_core
from hvf.data.episodes import Episodes, Metadata
from hvf.data.formats.hdf5 import write_episodes
from hvf.settings import Planning

torch = pytest.importorskip("torch")

from hvf.models.checkpoint import load_any, read_header, save_model  # noqa: E402
from hvf.models.frames import to_unit  # noqa: E402
from hvf.models.latent.basis import BlurredBasis  # noqa: E402
from hvf.models.latent.config import LatentConfig  # noqa: E402
from hvf.models.latent.dynamics import LatentDynamics  # noqa: E402
from hvf.models.latent.model import LatentModel  # noqa: E402
from hvf.training.loop import LoopConfig  # noqa: E402
from hvf.training.recipe import train  # noqa: E402
from hvf.training.tracks.coefficients import Coefficients, CoefficientWindows, fit_basis  # noqa: E402
from hvf.worlds.latent import LatentWorld, world_of  # noqa: E402

QUIET = Console(file=io.StringIO())
HEIGHT, WIDTH = 14, 18
BOX = ((-1.0, -2.0, 0.0), (1.0, 2.0, 4.0))
TINY = {
    "blur": 1.5,
    "cell": 2,
    "components": 24,
    "state": 6,
    "encoder_width": 32,
    "encoder_blocks": 1,
    "dynamics_width": 32,
    "dynamics_blocks": 1,
    "readout_width": 48,
    "decoder_channels": 6,
}


def drawn(places: NDArray[np.float64]) -> NDArray[np.uint8]:
    """A soft light at ``places [..., 2]`` (row, column): uint8 ``[..., H, W, 3]``."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    squared = (rows - places[..., :1, None]) ** 2 + (columns - places[..., 1:, None]) ** 2
    light = np.exp(-squared / 4)[..., None] * np.array([200, 120, 40]) + 20
    return light.round().astype(np.uint8)


def episodes(number: int, steps: int, seed: int, hold: int = 1) -> Episodes:
    """A light that the first two numbers of an action move, up to the border."""
    rng = np.random.default_rng(seed)
    low, high = np.array(BOX)
    actions = rng.uniform(low, high, (number, -(-steps // hold), 3)).repeat(hold, axis=1)
    actions = actions[:, :steps].astype(np.float32)
    places = np.empty((number, steps + 1, 2))
    places[:, 0] = rng.uniform(2, [HEIGHT - 3, WIDTH - 3], (number, 2))
    for t in range(steps):
        moved = places[:, t] + actions[:, t, :2] * [1.5, 1.0] / hold
        places[:, t + 1] = moved.clip(2, [HEIGHT - 3, WIDTH - 3])
    return Episodes(drawn(places), actions)


def written(path: Path, number: int, steps: int, seed: int = 0, hold: int = 1) -> Path:
    metadata = Metadata(
        "lights",
        {"action_repeat": hold},
        seed,
        steps,
        number,
        {},
        action_low=BOX[0],
        action_high=BOX[1],
    )
    write_episodes(path, metadata, episodes(number, steps, seed, hold))
    return path


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("data") / "lights.h5", 60, 12)


def short(steps: int, rate: float = 3e-3) -> LoopConfig:
    return LoopConfig(
        steps=steps,
        learning_rate=rate,
        schedule="cosine",
        warmup_steps=10,
        clip_norm=1.0,
        precision="float32",
        threads=1,
        validate_every=steps,
        checkpoint_every=steps,
    )


def trained_on(path: Path, out: Path, steps: int) -> LatentModel:
    found = train(
        "latent",
        path,
        out=out,
        batch_size=64,
        length=3,
        pairs=8,
        model=TINY,
        loop=short(steps),
        decoder_loop=short(steps // 4 + 1),
        console=QUIET,
    )
    assert isinstance(found, LatentModel)
    return found


@pytest.fixture(scope="module")
def run(data: Path) -> Path:
    out = data.parent / "run"
    trained_on(data, out, 600)
    return out


@pytest.fixture(scope="module")
def model(run: Path) -> LatentModel:
    found = load_any(run / "model.safetensors").module
    assert isinstance(found, LatentModel)
    return found


def reduced(images: NDArray[np.uint8], blur: float, cell: int) -> NDArray[np.float64]:
    """Blurred by scipy, then the mean of each cell, one at a time: ``[N, h, w, 3]``."""
    found = []
    for image in images.astype(np.float64) / 255:
        smooth = gaussian_filter(image, (blur, blur, 0)) if blur else image
        rows = range(0, image.shape[0], cell)
        columns = range(0, image.shape[1], cell)
        found.append(
            [[smooth[r : r + cell, c : c + cell].mean((0, 1)) for c in columns] for r in rows]
        )
    return np.array(found)


def some(count: int, seed: int = 1) -> NDArray[np.uint8]:
    rng = np.random.default_rng(seed)
    return drawn(rng.uniform(1, [HEIGHT - 2, WIDTH - 2], (count, 2)))


@settings(max_examples=10)
@given(blur=st.sampled_from([0.0, 0.7, 3.0]), cell=st.integers(1, 5))
def test_reduced_frames_are_means_of_cells_of_blurred_frames(blur: float, cell: int) -> None:
    config = LatentConfig(image_size=(HEIGHT, WIDTH), blur=blur, cell=cell, components=3)
    images = some(3)
    found = BlurredBasis(config).reduced(to_unit(torch.from_numpy(images)))
    expected = reduced(images, blur, cell).transpose(0, 3, 1, 2).reshape(3, -1)
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-6)


def test_components_are_those_of_a_singular_value_decomposition() -> None:
    config = LatentConfig(image_size=(HEIGHT, WIDTH), blur=1.0, cell=2, components=5)
    images = some(200)
    unit = to_unit(torch.from_numpy(images))
    basis = BlurredBasis(config).fit(torch.split(unit, 70))
    flat = reduced(images, 1.0, 2).transpose(0, 3, 1, 2).reshape(200, -1)
    _, values, vectors = np.linalg.svd(flat - flat.mean(0), full_matrices=False)
    # Up to the sign of each, and in pairs of nearly equal variance no better than these are apart.
    along = np.abs((basis.components.double().numpy() * vectors[:5].T).sum(0))
    np.testing.assert_allclose(along, 1, atol=1e-3)
    assert float(basis.variance) == pytest.approx((values**2).sum() / 200, rel=1e-4)
    coefficients = (basis(unit) * basis.scale).numpy()
    np.testing.assert_allclose((coefficients**2).mean(0), values[:5] ** 2 / 200, rtol=1e-3)
    assert float(basis(unit).square().mean()) == pytest.approx(1, rel=1e-3)


def test_the_cost_is_the_distance_of_blurred_frames_to_the_goal(model: LatentModel) -> None:
    world = LatentWorld(model)
    starts, goals = some(2, 3), some(2, 4)
    actions = np.random.default_rng(0).uniform(*BOX, (2, 3, 1, 3)).astype(np.float32)
    found = world.rollout_costs(world.observe(starts), world.observe(goals), actions)
    aims = reduced(goals, model.config.blur, model.config.cell).transpose(0, 3, 1, 2)
    with torch.inference_mode():
        for b in range(2):
            for d in range(3):
                state = model.start(to_unit(torch.from_numpy(starts[b : b + 1]))[:, None], None)
                state = model.step(state, torch.from_numpy(actions[b, d]), None)
                image = model.basis.frames(model.read(state[0]))[0].double().numpy()
                expected = ((image - aims[b]) ** 2).sum() / model.config.cells
                assert found[b, d] == pytest.approx(expected, rel=1e-3)


def weights(model: LatentModel, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    layer = model.get_submodule(name)
    return layer.weight.detach().double().numpy(), layer.bias.detach().double().numpy()


def linear(model: LatentModel, name: str, numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    matrix, bias = weights(model, name)
    return np.asarray(matrix @ numbers + bias)


def slow_step(
    model: LatentModel, state: NDArray[np.float64], action: NDArray[np.float32]
) -> NDArray[np.float64]:
    low, high = np.array(BOX)
    unit = (action - low) / (high - low) * 2 - 1
    hidden = np.maximum(linear(model, "network.input", np.concatenate([state, unit])), 0)
    inner = np.maximum(linear(model, "network.blocks.0.first", hidden), 0)
    hidden = np.maximum(hidden + linear(model, "network.blocks.0.second", inner), 0)
    return state + linear(model, "network.output", hidden)


@pytest.mark.parametrize("over_horizon", ["last", "sum", "min"])
def test_rollouts_are_those_of_slow_code(model: LatentModel, over_horizon: str) -> None:
    world = LatentWorld(model, over_horizon=over_horizon)
    starts, goals = world.observe(some(2, 5)), world.observe(some(2, 6))
    actions = np.random.default_rng(0).uniform(*BOX, (2, 4, 3, 3)).astype(np.float32)
    found = world.rollout_costs(starts, goals, actions)
    scale = model.basis.scale.double().numpy()
    for b in range(2):
        for d in range(4):
            state, costs = starts.latents[b].astype(np.float64), []
            for action in actions[b, d]:
                state = slow_step(model, state, action)
                waves = np.sin(linear(model, "readout.input", state))
                seen = linear(model, "readout.output", waves) * scale / model.config.cells**0.5
                costs.append(((seen - goals.targets[b]) ** 2).sum() + goals.constants[b])
            expected = {"last": costs[-1], "sum": sum(costs), "min": min(costs)}[over_horizon]
            assert found[b, d] == pytest.approx(expected, rel=1e-3, abs=1e-6)


def test_training_predicts_far_better_than_that_nothing_moves(run: Path) -> None:
    measured = read_header(run / "dynamics" / "model.safetensors").training["validation"]
    assert measured["error_5"] < 0.2 * measured["still_5"]
    drawn = read_header(run / "model.safetensors").training["validation"]
    assert drawn["mse"] < 0.4 * drawn["still_mse"]


def test_a_light_is_carried_to_its_goal(model: LatentModel) -> None:
    world = world_of(model, Planning(over_horizon="min"))
    mpc = hvf_core.VisualMPC(horizon=3, samples=60, elites=10, iterations=3)
    places = np.array([[4.0, 5.0]])
    target = np.array([[8.0, 7.0]])
    first = float(((places - target) ** 2).sum() ** 0.5)
    for step in range(4):
        plan = mpc.plan(world, drawn(places)[0], drawn(target)[0], seed=step)
        places = places + plan.actions[0, :2] * [1.5, 1.0]
    assert float(((places - target) ** 2).sum() ** 0.5) < 0.35 * first


def test_pictures_are_of_the_states_that_actions_lead_to(model: LatentModel) -> None:
    world = LatentWorld(model)
    truth = episodes(6, 3, seed=9)
    predicted = world.predict(world.observe(truth.frames[:, 0]), truth.actions)
    assert predicted.shape == (6, 3, HEIGHT, WIDTH, 3)
    assert predicted.dtype == np.uint8
    error = np.square(predicted.astype(float) - truth.frames[:, 1:]).mean()
    still = np.square(truth.frames[:, :1].astype(float) - truth.frames[:, 1:]).mean()
    assert error < 0.5 * still


def test_same_seed_same_weights_and_a_checkpoint_is_the_model(
    data: Path, tmp_path: Path, model: LatentModel
) -> None:
    first, again = (trained_on(data, tmp_path / name, 12) for name in "ab")
    for name, tensor in first.state_dict().items():
        assert torch.equal(tensor, again.state_dict()[name]), name
    save_model(tmp_path / "copy.safetensors", model, environment="lights")
    found = load_any(tmp_path / "copy.safetensors")
    assert found.name == "latent"
    assert found.module.config == model.config
    assert found.module.config.action_dim == 3
    assert found.module.config.image_size == (HEIGHT, WIDTH)
    images = some(4)
    before, after = (LatentWorld(each).observe(images) for each in (model, found.module))
    np.testing.assert_array_equal(before.latents, after.latents)


def test_a_step_of_a_model_is_as_long_as_actions_are_held(tmp_path: Path) -> None:
    path = written(tmp_path / "held.h5", 40, 12, hold=3)
    model = trained_on(path, tmp_path / "run", 8)
    assert model.hold == 3
    with pytest.raises(ValueError, match="action_repeat: must be a multiple of 3"):
        world_of(model, Planning(horizon=4, action_repeat=2))
    world = world_of(model, Planning(horizon=6, action_repeat=3))
    frames = world.observe(some(2))
    actions = np.random.default_rng(0).uniform(*BOX, (2, 5, 2, 3)).astype(np.float32)
    held = actions.repeat(3, axis=2)
    costs = world.rollout_costs(frames, frames, held)
    with torch.inference_mode():
        states = torch.from_numpy(frames.latents)[:, None].expand(-1, 5, -1)
        for h in range(2):
            states = model.moved(states, model.unit_actions(torch.from_numpy(actions[:, :, h])))
        seen = (model.read(states) * model.basis.scale).numpy() / model.config.cells**0.5
    expected = ((seen - frames.targets[:, None]) ** 2).sum(-1) + frames.constants[:, None]
    np.testing.assert_allclose(costs, expected, rtol=1e-4)
    predicted = world.predict(frames, held[:, 0])
    np.testing.assert_array_equal(predicted[:, 0], predicted[:, 2])


def test_windows_begin_where_actions_begin_and_stay_within_their_episode(tmp_path: Path) -> None:
    made = episodes(8, 9, seed=2, hold=2)
    lengths = np.array([9, 4, 9, 3, 5, 8, 9, 9])
    found = Episodes(made.frames, made.actions, lengths=lengths)
    path = tmp_path / "unequal.h5"
    write_episodes(path, Metadata("lights", {}, 0, 9, 8, {}), found)
    config = LatentConfig(image_size=(HEIGHT, WIDTH), cell=2, blur=1.0, components=8)
    basis = BlurredBasis(config)
    fit_basis(path, basis, 8, console=QUIET)
    tracks = Coefficients(path, basis, 8, console=QUIET)
    np.testing.assert_array_equal(tracks.lengths, lengths)
    batch = CoefficientWindows(tracks, batch_size=200, length=2, hold=2, seed=0).batch(5)
    seen = set()
    for coefficients, actions in zip(batch["coefficients"], batch["actions"], strict=True):
        ((episode, time),) = np.argwhere((made.actions == actions[0].numpy()).all(-1))[::2]
        assert time % 2 == 0
        assert time + 4 <= lengths[episode]
        np.testing.assert_array_equal(actions[1], made.actions[episode, time + 2])
        images = made.frames[episode, time : time + 5 : 2]
        expected = basis(to_unit(torch.from_numpy(images)))
        np.testing.assert_allclose(coefficients.float(), expected, atol=5e-3)
        seen.add(int(episode))
    assert seen == {0, 1, 2, 4, 5, 6, 7}
    with pytest.raises(ValueError, match="no episode has 10 steps; the longest has 9"):
        CoefficientWindows(tracks, batch_size=1, length=5, hold=2, seed=0)


def test_coefficients_are_seen_once_for_all_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written(tmp_path / "lights.h5", 8, 5)
    config = LatentConfig(image_size=(HEIGHT, WIDTH), cell=2, blur=1.0, components=8)
    basis, same = BlurredBasis(config), BlurredBasis(config)
    for each in (basis, same):
        fit_basis(path, each, 6, console=QUIET)
    first = Coefficients(path, basis, 6, console=QUIET)
    monkeypatch.setattr(BlurredBasis, "forward", None)
    again = Coefficients(path, same, 6, console=QUIET)
    np.testing.assert_array_equal(first.coefficients, again.coefficients)
    np.testing.assert_array_equal(first.actions, again.actions)


def test_a_training_that_goes_on_takes_no_components_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written(tmp_path / "lights.h5", 8, 5)
    whole = trained_on(path, tmp_path / "whole", 8)
    calls = []
    advance = LatentDynamics.loss

    def stopped(self: LatentDynamics, *arguments: Any) -> Any:
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return advance(self, *arguments)

    with monkeypatch.context() as patched:
        patched.setattr(LatentDynamics, "loss", stopped)
        with pytest.raises(KeyboardInterrupt):
            trained_on(path, tmp_path / "stopped", 8)
    monkeypatch.setattr(BlurredBasis, "fit", None)
    model = trained_on(path, tmp_path / "stopped", 8).state_dict()
    assert all(model[name].equal(value) for name, value in whole.state_dict().items())


def test_bad_input_is_one_clear_error(model: LatentModel) -> None:
    with pytest.raises(ValueError, match=r"blur: .* 1\.5 pixels .* got 2"):
        LatentWorld(model, blur=2.0)
    with pytest.raises(ValueError, match=r"images: expected shape \[N, 14, 18, 3\]"):
        LatentWorld(model).observe(np.zeros((1, 18, 14, 3), np.uint8))
    with pytest.raises(TypeError, match="images: must be uint8"):
        LatentWorld(model).observe(np.zeros((1, 14, 18, 3), np.float32))
    for field, value in (("state", 0), ("dynamics_blocks", -1), ("blur", -1.0), ("cell", 0)):
        with pytest.raises(ValueError, match=field):
            LatentConfig(**{field: value})
    with pytest.raises(ValueError, match="components must be at most 12"):
        LatentConfig(image_size=(8, 8), components=13)
    still = torch.full((3, 3, HEIGHT, WIDTH), 0.5)
    basis = BlurredBasis(LatentConfig(image_size=(HEIGHT, WIDTH), components=3))
    with pytest.raises(ValueError, match="images: all are the same"):
        basis.fit([still])
    with pytest.raises(ValueError, match="images: there are none"):
        basis.fit([])
