"""What predictions are measured by, against direct computation, and `hvf probe` on toy data."""

from __future__ import annotations

import dataclasses
import io
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from rich.console import Console
from scipy.ndimage import gaussian_filter

import hvf_core
import toy_desk as toy
from hvf.cli import main
from hvf.data.episodes import Episodes, Metadata
from hvf.data.formats.hdf5 import EpisodeFile, write_episodes
from hvf.evaluation.prediction import (
    Windows,
    check_disjoint,
    image_figures,
    observables_of,
    predict,
    read_windows,
    thing_figures,
    things_of,
)
from hvf.experiments.prediction import Probe, measure, probe
from hvf.models.checkpoint import save_model
from hvf.models.frames import to_unit
from hvf.models.image_quality import image_psnr, psnr, ssim
from hvf.models.keypoint.dynamics import DynamicsConfig, KeypointDynamics
from hvf.models.keypoint.generator import GeneratorConfig, KeypointGenerator
from hvf.models.keypoint.perception import PerceptionConfig
from hvf.training.loop import LoopConfig
from hvf.worlds.keypoint import KeypointWorld
from hvf.worlds.layers import LayerWorld
from layered_desk import random_dynamics

Write = Callable[..., Path]
FEW = LoopConfig(steps=30, learning_rate=3e-3, validate_every=30, checkpoint_every=30, threads=1)
QUIET = Console(file=io.StringIO())


@pytest.fixture(scope="module")
def write(tmp_path_factory: pytest.TempPathFactory) -> Write:
    """Write a file of episodes of the maze at 32 pixels."""

    def file(seed: int, episodes: int = 8, steps: int = 6, first: int = 0, **options: Any) -> Path:
        path = tmp_path_factory.mktemp("data") / "maze.h5"
        frames, actions, states = hvf_core.maze_collect(seed, first, episodes, steps, 32)
        parameters = {"states": ["x", "y", "w1", "w2"], **options}
        metadata = Metadata("maze", parameters, seed, steps, episodes, {})
        write_episodes(path, metadata, Episodes(frames, actions, states))
        return path

    return file


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the learned measure, which takes seconds and has a test of its own."""
    monkeypatch.setitem(sys.modules, "stlpips_pytorch", None)


class Shifter:
    """A world without frames of its own: an action of more than 0 moves all pixels to the right."""

    def predict(self, frames: NDArray[np.uint8], actions: NDArray[np.float32]) -> NDArray[np.uint8]:
        drawn = []
        for h in range(actions.shape[1]):
            step = (actions[:, h, 0] > 0)[:, None, None, None]
            frames = np.where(step, np.roll(frames, 1, axis=2), frames)
            drawn.append(frames)
        return np.stack(drawn, axis=1)


def random_windows(seed: int = 0, count: int = 20, horizon: int = 3) -> Windows:
    rng = np.random.default_rng(seed)

    def images(*shape: int) -> NDArray[np.uint8]:
        return rng.integers(0, 256, (*shape, 16, 16, 3), dtype=np.uint8)

    return Windows(
        past=images(count, 1),
        past_actions=np.empty((count, 0, 2), np.float32),
        actions=rng.uniform(-1, 1, (count, horizon, 2)).astype(np.float32),
        future=images(count, horizon),
        states=rng.uniform(-0.01, 0.01, (count, horizon + 1, 4)),
    )


# ---- windows -----------------------------------------------------------------------------------


def test_windows_are_stretches_of_episodes_spread_from_their_start_to_their_end(
    write: Write,
) -> None:
    with EpisodeFile(write(3)) as file:
        windows = read_windows(file, [1, 5], windows=3, horizon=2, context=2)
        whole = file.read(5, 1)
    assert len(windows) == 6
    for row, now in zip((3, 4, 5), (1, 2, 4), strict=True):
        np.testing.assert_array_equal(windows.past[row], whole.frames[0, now - 1 : now + 1])
        np.testing.assert_array_equal(windows.past_actions[row], whole.actions[0, now - 1 : now])
        np.testing.assert_array_equal(windows.actions[row], whole.actions[0, now : now + 2])
        np.testing.assert_array_equal(windows.future[row], whole.frames[0, now + 1 : now + 3])
        assert windows.states is not None
        np.testing.assert_array_equal(windows.states[row], whole.states[0, now : now + 3])
    np.testing.assert_array_equal(windows.start, windows.past[:, 1])


def test_windows_begin_where_a_held_action_begins(write: Write) -> None:
    with EpisodeFile(write(3, steps=12, action_repeat=3)) as file:
        windows = read_windows(file, [0], windows=4, horizon=4)
        actions = file.read(0, 1).actions[0]
    starts = [int(np.flatnonzero((actions == a[0]).all(axis=1))[0]) for a in windows.actions]
    assert starts == [0, 3, 6]


def test_data_with_no_episode_as_long_as_a_window_is_refused(write: Write) -> None:
    with EpisodeFile(write(3)) as file, pytest.raises(ValueError, match="no episode has 8 steps"):
        read_windows(file, range(8), windows=2, horizon=7, context=2)


# ---- predictions -------------------------------------------------------------------------------


def test_a_world_without_frames_of_its_own_predicts_from_images() -> None:
    windows = random_windows(count=19)
    drawn = predict(Shifter(), windows.past, windows.actions)
    for row in range(19):
        image = windows.start[row]
        for h in range(3):
            if windows.actions[row, h, 0] > 0:
                image = np.roll(image, 1, axis=1)
            np.testing.assert_array_equal(drawn[row, h], image)


def test_a_world_with_context_gets_the_past_and_a_short_one_is_made_longer() -> None:
    class Remembers(Shifter):
        context = 3

        def observe_history(self, images: Any, actions: Any) -> Any:
            self.seen = images, actions
            return images[:, -1]

    world = Remembers()
    rng = np.random.default_rng(0)
    past = rng.integers(0, 256, (2, 4, 16, 16, 3), dtype=np.uint8)
    done = rng.uniform(size=(2, 3, 2)).astype(np.float32)
    predict(world, past, np.zeros((2, 1, 2), np.float32), done)
    np.testing.assert_array_equal(world.seen[0], past[:, 1:])
    np.testing.assert_array_equal(world.seen[1], done[:, 1:])
    predict(world, past[:, -2:], np.zeros((2, 1, 2), np.float32), done[:, -1:])
    np.testing.assert_array_equal(world.seen[0], past[:, [2, 2, 3]])
    np.testing.assert_array_equal(world.seen[1][:, 0], 0)
    np.testing.assert_array_equal(world.seen[1][:, 1], done[:, -1])


def test_what_cannot_predict_images_is_refused() -> None:
    class Wrong:
        def predict(self, frames: Any, actions: Any) -> Any:
            return frames

    windows = random_windows()
    with pytest.raises(ValueError, match="predicted uint8"):
        predict(Wrong(), windows.past, windows.actions)
    with pytest.raises(TypeError, match="object has no `predict`"):
        predict(object(), windows.past, windows.actions)


def test_the_keypoint_world_draws_what_its_torch_twin_draws(write: Write) -> None:
    torch.manual_seed(0)
    model = KeypointDynamics(DynamicsConfig(perception=PerceptionConfig(image_size=32))).eval()
    with torch.no_grad():
        model.cell.free.weight.normal_(std=2.0)
    with EpisodeFile(write(4)) as file:
        windows = read_windows(file, range(8), windows=1, horizon=3)
    drawn = predict(KeypointWorld(model), windows.past, windows.actions)
    with torch.inference_mode():
        images = torch.from_numpy(windows.start)
        keypoints, maps = model.observe(images)
        actions = torch.from_numpy(windows.actions)[:, None]
        path = model.rollout(keypoints[:, None], maps, actions)[:, 0]
        for h in range(3):
            expected = 255 * model.draw(to_unit(images), keypoints, path[:, h]).clamp(0, 1)
            found = drawn[:, h].transpose(0, 3, 1, 2)
            np.testing.assert_allclose(found, expected.numpy(), atol=1.01)


# ---- figures -----------------------------------------------------------------------------------


def test_figures_of_images_are_means_beside_those_of_the_last_frame_copied() -> None:
    windows = random_windows()
    drawn = predict(Shifter(), windows.past, windows.actions)
    found = image_figures(drawn, windows)
    for name, measure_of in (("psnr", psnr), ("ssim", ssim)):
        for h in range(3):
            guess = np.mean([measure_of(drawn[i, h], windows.future[i, h]) for i in range(20)])
            still = np.mean([measure_of(windows.start[i], windows.future[i, h]) for i in range(20)])
            assert found[name][h] == pytest.approx(guess, abs=6e-5)
            assert found[f"{name}_still"][h] == pytest.approx(still, abs=6e-5)


def test_images_are_compared_once_more_through_a_blur() -> None:
    windows = random_windows()
    drawn = predict(Shifter(), windows.past, windows.actions)
    found = image_figures(drawn, windows, blur=1.5)
    for h in range(3):
        smooth = gaussian_filter(
            drawn[:, h] / 255 - windows.future[:, h] / 255, (0, 1.5, 1.5, 0), output=np.float64
        )
        expected = -10 * np.log10((smooth**2).mean(axis=(1, 2, 3)))
        assert found["psnr_blurred"][h] == pytest.approx(expected.mean(), abs=1e-3)
    assert "psnr_blurred" not in image_figures(drawn, windows)


def test_figures_of_things_are_distances_in_millimetres() -> None:
    windows = random_windows()
    assert windows.states is not None

    class Reader:
        """Reads positions in the first pixel: red and green, centimetres from the middle."""

        def __call__(self, frames: torch.Tensor) -> torch.Tensor:
            return 0.01 * (frames[:, 0, 0].float() - 128) / 16

    windows = dataclasses.replace(windows, states=windows.states[..., :3])
    assert windows.states is not None
    drawn = predict(Shifter(), windows.past, windows.actions)
    reader: Any = Reader()
    found = thing_figures(drawn, windows, reader, {"it": [2, 0]}, (1, 3))
    for h in (1, 3):
        errors: dict[str, list[float]] = {"true": [], "predicted": [], "still": []}
        for i in range(20):
            truth = windows.states[i, h]
            for name, read in (
                ("true", 0.01 * (windows.future[i, h - 1, 0, 0].astype(float) - 128) / 16),
                ("predicted", 0.01 * (drawn[i, h - 1, 0, 0].astype(float) - 128) / 16),
                ("still", windows.states[i, 0]),
            ):
                errors[name].append(1e3 * float(np.hypot(*(read - truth)[[0, 2]])))
        moved = np.array(errors["still"]) > 10
        assert 0 < moved.sum() < 20
        assert found["it"][str(h)]["moved"] == pytest.approx(moved.mean(), abs=1e-4)
        for name, values in errors.items():
            assert found["it"][str(h)][name] == pytest.approx(np.mean(values), abs=0.051)
            moving = np.array(values)[moved].mean()
            assert found["it"][str(h)][f"moved_{name}"] == pytest.approx(moving, abs=0.051)


def test_observables_are_named_by_the_data_and_grouped_by_their_names() -> None:
    names = ["arm_x", "arm_y", "door", "x", "y", "arm_z", "left_button"]
    expected = {"arm": [0, 1, 5], "door": [2], "position": [3, 4], "left_button": [6]}
    assert things_of("recorded somewhere", names) == expected
    assert observables_of({"states": names}, 7) == names
    assert observables_of({}, 2) == ["state 0", "state 1"]
    with pytest.raises(ValueError, match="7 names of states"):
        observables_of({"states": names}, 4)


def test_psnr_in_training_is_psnr_of_bytes() -> None:
    rng = np.random.default_rng(1)
    guess, truth = rng.integers(0, 256, (2, 5, 16, 16, 3), dtype=np.uint8)
    found = image_psnr(to_unit(torch.from_numpy(guess)), to_unit(torch.from_numpy(truth)))
    np.testing.assert_allclose(found, psnr(guess, truth), atol=1e-4)


# ---- other data to test on ---------------------------------------------------------------------


def test_data_of_the_same_seed_is_no_test_data_unless_it_has_other_episodes(write: Write) -> None:
    with (
        EpisodeFile(write(3)) as data,
        EpisodeFile(write(3, episodes=4, steps=9)) as same,
        EpisodeFile(write(3, first=8)) as later,
        EpisodeFile(write(4)) as other,
    ):
        check_disjoint(data, later)
        check_disjoint(data, other)
        with pytest.raises(ValueError, match=r"test_data: has episodes of the data itself.*seed 3"):
            check_disjoint(data, same)


def test_data_of_another_place_is_no_test_data(write: Write, tmp_path: Path) -> None:
    toy.write(tmp_path / "desk.h5", 1, 2, 6)
    with (
        EpisodeFile(write(3)) as data,
        EpisodeFile(tmp_path / "desk.h5") as desk,
        pytest.raises(ValueError, match="test_data: environment is 'desk'"),
    ):
        check_disjoint(data, desk)


# ---- the whole ---------------------------------------------------------------------------------


def test_a_keypoint_model_is_probed_on_another_collection(write: Write, tmp_path: Path) -> None:
    torch.manual_seed(0)
    model = KeypointDynamics(DynamicsConfig(perception=PerceptionConfig(image_size=32))).eval()
    config = Probe(
        write(3), Path("unused"), write(4), tmp_path, horizon=5, steps_ahead=(1, 5), loop=FEW
    )
    figures = measure(KeypointWorld(model), config, QUIET)
    assert figures["split"] == "test"
    assert figures["windows"] == 8 * 2  # of 4 that begin at 0, 0, 0 and 1, the different ones
    assert len(figures["images"]["psnr"]) == len(figures["images"]["psnr_still"]) == 5
    # The gaps never move; the agent does.
    assert figures["things"]["agent"]["5"]["moved"] > 0.5
    assert figures["things"]["gaps"]["5"]["still"] == 0
    assert json.loads((tmp_path / "figures.json").read_text()) == figures
    assert (tmp_path / "predictions.png").stat().st_size > 1000
    # Six windows, of each the truth and the prediction; the last frame seen and five steps.
    assert iio.imread(tmp_path / "strips.png").shape == (12 * 66 + 2, 6 * 66 + 2, 3)


def test_a_layers_model_is_probed_on_the_datas_own_last_episodes(tmp_path: Path) -> None:
    data = tmp_path / "desk.h5"
    toy.write(data, 0, 5, 8)
    model = random_dynamics()
    config = Probe(data, Path("unused"), out=tmp_path, horizon=6, steps_ahead=(6,), loop=FEW)
    figures = measure(LayerWorld(model), config, QUIET)
    assert figures["split"] == "validation"
    assert figures["windows"] == 3
    assert figures["data"]["measured"]["seed"] == 0
    assert all(np.isfinite(row["6"]["predicted"]) for row in figures["things"].values())
    # Trained already: the same call reads the same.
    assert measure(LayerWorld(model), config, QUIET) == figures


def test_the_verb_probes_a_checkpoint(write: Write, tmp_path: Path) -> None:
    torch.manual_seed(0)
    model = KeypointDynamics(DynamicsConfig(perception=PerceptionConfig(image_size=32)))
    save_model(tmp_path / "model.safetensors", model, environment="maze")
    words = ["probe", "--data", str(write(3)), "--test-data", str(write(4))]
    words += ["--model", str(tmp_path / "model.safetensors"), "--out", str(tmp_path / "out")]
    words += ["--horizon", "4", "--steps-ahead", "1", "4", "--windows", "1", "--episodes", "5"]
    assert main([*words, "--loop.steps", "5"]) == 0
    figures = json.loads((tmp_path / "out" / "figures.json").read_text())
    assert figures["model"] == {"name": "keypoint", "kind": "object"}
    assert figures["windows"] == 5
    assert list(figures["things"]) == ["agent", "gaps"]


def test_a_model_that_predicts_no_frames_is_refused(write: Write, tmp_path: Path) -> None:
    path = tmp_path / "generator.safetensors"
    save_model(path, KeypointGenerator(GeneratorConfig(scene_dim=5)), environment="maze")
    with pytest.raises(ValueError, match="holds a keypoint-generator model, which is good for"):
        probe(Probe(write(3), path), QUIET)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"windows": 0}, "windows must be at least 1"),
        ({"steps_ahead": (1, 16)}, "steps_ahead must be from 1 to the horizon 15"),
        ({"steps_ahead": ()}, "steps_ahead must be"),
    ],
)
def test_settings_out_of_range_are_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Probe(Path("data"), Path("model"), **settings)
