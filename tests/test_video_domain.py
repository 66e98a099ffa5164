"""Recorded video: subgoals between its frames, and reports on many, against known truth."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("torch")

import drifting
from hvf.cli import main
from hvf.data.formats import open_episodes
from hvf.evaluation.neighbours import nearest_frames
from hvf.evaluation.scenes import retrieved, scene_figures
from hvf.experiments import video_report
from hvf.experiments.video_report import VideoReport, report
from hvf.registry import DOMAINS, MODELS
from hvf.settings import World

TRAIN, TEST = range(10, 18), range(100, 105)
SETTINGS = """--horizon 1 --action-repeat 1 --samples 400 --elites 5 --iterations 1
--subgoal-samples 40 --subgoal-elites 4 --subgoal-iterations 2"""
QUICK = SETTINGS.split()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Episodes for training and for tests, and checkpoints."""
    out = tmp_path_factory.mktemp("drift")
    drifting.episodes(out / "train.h5", TRAIN)
    drifting.episodes(out / "test.h5", TEST, split="test")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MODELS, "_targets", dict(MODELS._targets))
        drifting.models(out)
        yield out


def worlds(folder: Path) -> list[str]:
    names = [str(folder / f"{name}.safetensors") for name in ("drift", "wanderer")]
    return ["--dynamics", names[0], "--generator", names[1]]


def apart(a: Any, b: Any) -> float:
    """Squared L2 of colours in [0, 1], per pixel."""
    difference = (a.astype(float) - b.astype(float)) / 255
    return float((difference**2).sum() / (a.shape[0] * a.shape[1]))


def least_cost(start: NDArray[np.uint8], goal: NDArray[np.uint8]) -> float:
    """What the best of all actions costs: 25 whole pixels are in the box."""
    steps = range(-2, 3)
    return min(apart(np.roll(start, (y, x), (0, 1)), goal) for y in steps for x in steps)


def test_video_is_a_domain_of_recorded_episodes_only(tmp_path: Path, capsys: Any) -> None:
    video = DOMAINS["video"]
    assert (video.tasks, video.action_low) == ({}, ())
    with video.open() as place, pytest.raises(ValueError, match="no episodes to act in"):
        place.trials("", 0, 0, 1)
    for verb in ("eval", "demo"):
        assert main([verb, "video"]) == 2
        assert "no episodes to act in" in " ".join(capsys.readouterr().err.split())
    assert main(["collect", "video"]) == 2
    assert main(["plan", "video", "--data", str(tmp_path / "nothing.h5")]) == 2
    assert "no such data file" in capsys.readouterr().err


def test_segments_cost_what_the_best_actions_cost(folder: Path, tmp_path: Path) -> None:
    words = ["plan", "video", "--data", str(folder / "test.h5"), "--episode", "2", "--from", "1"]
    words += ["--train-data", str(folder / "train.h5"), "--to", "5", "--subgoals", "2"]
    assert main([*words, *worlds(folder), *QUICK, "--out", str(tmp_path)]) == 0
    frames, _ = drifting.drift(TEST[2], 6)
    drawn = [iio.imread(tmp_path / f"episode-2-1-5-{k}.png") for k in (1, 2)]
    ways = [frames[1], *drawn, frames[5]]
    found = json.loads((tmp_path / "episode-2-1-5.json").read_text())
    expected = [least_cost(a, b) for a, b in itertools.pairwise(ways)]
    np.testing.assert_allclose(found["segment_costs"], expected, rtol=1e-5, atol=1e-7)
    direct = least_cost(frames[1], frames[5])
    assert found["cost_without_subgoals"] == pytest.approx(direct, rel=1e-5)
    # Start, two subgoals and goal; below the subgoals, what is nearest in the training episodes.
    strip = iio.imread(tmp_path / "episode-2-1-5.png")
    assert strip.shape[0] > 500
    assert strip.shape[1] > 4 * 200
    # The last one is for validation.
    training = [drifting.drift(seed, 6)[0] for seed in TRAIN[:-1]]
    known = {(i, t): frame for i, frames in enumerate(training) for t, frame in enumerate(frames)}
    for image, near in zip(drawn, found["nearest_training_frames"], strict=True):
        distances = {place: apart(image, frame) for place, frame in known.items()}
        assert near["distance"] == pytest.approx(min(distances.values()))
        assert distances[near["episode"], near["frame"]] == pytest.approx(near["distance"])


def test_an_episodes_own_frames_are_no_neighbours(folder: Path, tmp_path: Path) -> None:
    words = ["plan", "video", "--data", str(folder / "train.h5"), "--episode", "3", *worlds(folder)]
    assert main([*words, *QUICK, "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "episode-3-0-6.json").read_text())
    held_out = len(TRAIN) - 1
    places = {near["episode"] for near in found["nearest_training_frames"]}
    assert not places & {3, held_out}


def test_a_file_for_tests_has_no_neighbours_of_its_own(
    folder: Path, tmp_path: Path, capsys: Any
) -> None:
    words = ["plan", "video", "--data", str(folder / "test.h5"), *worlds(folder), *QUICK]
    assert main([*words, "--subgoals", "1", "--out", str(tmp_path)]) == 0
    assert "--train-data" in capsys.readouterr().out
    found = json.loads((tmp_path / "episode-0-0-6.json").read_text())
    assert "nearest_training_frames" not in found


def test_frames_and_episodes_that_there_are_not_are_named(
    folder: Path, tmp_path: Path, capsys: Any
) -> None:
    words = ["plan", "video", "--data", str(folder / "test.h5"), "--out", str(tmp_path)]
    for more, said in (
        (["--from", "7"], "from: the episode has 7 frames, got 7"),
        (["--to", "-8"], "to: the episode has 7 frames, got -8"),
        (["--episode", "5"], "episode: .* has 5, got 5"),
        (["--subgoals", "0"], "subgoals: must be at least 1"),
        (["--camera", "side"], "has no camera 'side'"),
        (["--dynamics", "default"], "dynamics: name one"),
    ):
        assert main([*words, *worlds(folder), *more]) == 2
        assert re.search(said, " ".join(capsys.readouterr().err.split()))
    assert not list(tmp_path.iterdir())


def test_neighbours_are_those_of_a_slow_search() -> None:
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (5, 8, 8, 3)).astype(np.uint8)
    frames = rng.integers(0, 256, (3, 4, 8, 8, 3)).astype(np.uint8)
    frames[2, 1] = images[4]
    lengths = [3, 2, 3]

    class File:
        path = Path("here")

        def read(self, number: int, count: int) -> Any:
            arrays = {"frames": frames[[number]], "lengths": np.array([lengths[number]])}
            return type("Read", (), arrays)

    found = nearest_frames(File(), [0, 1, 2], images)  # type: ignore[arg-type]
    for q in range(5):
        all_of_them = {
            (e, t): apart(images[q], frames[e, t]) for e in range(3) for t in range(lengths[e] + 1)
        }
        best = min(all_of_them, key=lambda place: all_of_them[place])
        assert (found.episodes[q], found.times[q]) == best
        assert found.distances[q] == pytest.approx(all_of_them[best])
        np.testing.assert_array_equal(found.images[q], frames[best])
    assert found.distances[4] == 0
    with pytest.raises(ValueError, match="images: are"):
        nearest_frames(File(), [0], images[:, :4])  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="no episodes to look"):
        nearest_frames(File(), [], images)  # type: ignore[arg-type]


def test_scene_figures_are_those_of_a_slow_count() -> None:
    rng = np.random.default_rng(1)
    episodes = [rng.integers(0, 256, (t, 6, 6, 3)).astype(np.uint8) for t in (3, 4, 5)]
    mixed = [episodes[1][0], episodes[1][2], episodes[2][1], episodes[0][0]]
    found = scene_figures(np.stack(mixed), 1, episodes)
    own, other = [], []
    for image in mixed:
        # The first frame of their own episode is what they were drawn for.
        own.append(min(apart(image, frame) for frame in episodes[1][1:]))
        other.append(min(apart(image, frame) for e in (0, 2) for frame in episodes[e]))
    # A copy of the first frame is as far from what follows as from anything else, here.
    assert found["kept"] == np.mean([a < b for a, b in zip(own, other, strict=True)])
    assert found["own"] == pytest.approx(np.mean(own))
    assert found["other"] == pytest.approx(np.mean(other))
    assert found["conditioning"] == pytest.approx(
        np.mean([apart(image, episodes[1][0]) for image in mixed])
    )
    pairs = [apart(a, b) for i, a in enumerate(mixed) for b in mixed[:i]]
    assert found["spread"] == pytest.approx(np.mean(pairs))
    with pytest.raises(ValueError, match="at least 2 episodes"):
        scene_figures(np.stack(mixed), 0, episodes[:1])


def test_what_is_retrieved_is_of_the_most_similar_training_episode(folder: Path) -> None:
    with open_episodes(folder / "train.h5") as file:
        frames, _ = drifting.drift(TRAIN[4], 6)
        found = retrieved(file, range(7), frames[2], 9, [3])
    assert found.shape == (9, drifting.SIZE, drifting.SIZE, 3)
    for image in found:
        assert min(apart(image, frame) for frame in frames) == 0


# ---- reports -----------------------------------------------------------------------------------


def reported(folder: Path, out: Path, *more: str) -> dict[str, Any]:
    words = ["report", "video", "--data", str(folder / "test.h5"), "--out", str(out), *QUICK]
    words += ["--train-data", str(folder / "train.h5"), "--subgoals", "1", "--draws", "6"]
    assert main([*words, *worlds(folder), *more]) == 0
    found: dict[str, Any] = json.loads((out / "report.json").read_text())
    return found


@pytest.fixture(scope="module")
def whole(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    out = tmp_path_factory.mktemp("report")
    return out, reported(folder, out)


def test_a_report_tells_what_is_true_of_the_models(whole: tuple[Path, dict[str, Any]]) -> None:
    out, found = whole
    names = {path.name for path in out.iterdir()}
    strips = {f"episode-{i}{end}" for i in range(5) for end in (".png", ".json", "-1.png")}
    assert names == strips | {"report.json", "report.md", "samples.png", "predictions.png"}
    summary = found["summary"]
    assert [record["episode"] for record in found["episodes"]] == list(range(5))
    # The dynamics are right, "nothing moves" is not.
    prediction = summary["prediction"]
    assert prediction["psnr"] == [60.0] * 6
    assert prediction["ssim"] == [1.0] * 6
    moved = [record for record in found["episodes"] if record["prediction"]["psnr_still"][-1] < 60]
    assert len(moved) >= 4
    # Its images are of the scene it is shown, and none of the training scenes is.
    scene = summary["scene"]
    assert scene["drawn"]["kept"] == 1.0
    assert scene["copied"]["kept"] == 1.0
    assert scene["retrieved"]["kept"] < 0.7
    assert scene["drawn"]["own"] < scene["drawn"]["other"]
    assert scene["copied"]["conditioning"] == scene["copied"]["spread"] == 0
    assert summary["chance"] == 0.2
    planned = [max(record["segment_costs"]) for record in found["episodes"]]
    assert summary["hardest_segment"] == pytest.approx(np.mean(planned))
    assert summary["easier"] > 0.5
    text = (out / "report.md").read_text()
    assert "# drift: 5 held-out episodes (test)" in text
    assert "| drawn by the generator | 100% |" in text


def test_a_stopped_report_goes_on_and_ends_the_same(
    folder: Path,
    tmp_path: Path,
    whole: tuple[Path, dict[str, Any]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    one = video_report._Work.episode
    asked: list[int] = []

    def stopped(work: Any, place: int) -> Any:
        asked.append(place)
        if len(asked) == 3:
            raise KeyboardInterrupt
        return one(work, place)

    monkeypatch.setattr(video_report._Work, "episode", stopped)
    config = VideoReport(
        data=folder / "test.h5",
        train_data=folder / "train.h5",
        world=World(str(folder / "drift.safetensors"), str(folder / "wanderer.safetensors")),
        subgoals=1,
        draws=6,
        planning=video_report.Planning(**whole[1]["settings"]["planning"]),
        out=tmp_path,
    )
    with pytest.raises(KeyboardInterrupt):
        report(DOMAINS["video"], config)
    assert len(json.loads((tmp_path / "report.json").read_text())["episodes"]) == 2
    found = report(DOMAINS["video"], config)
    assert asked == [0, 1, 2, 2, 3, 4]
    for key in ("summary", "episodes"):
        assert found[key] == whole[1][key]
    other = VideoReport(**{**vars(config), "seed": 1})
    with pytest.raises(FileExistsError, match="holds another report"):
        report(DOMAINS["video"], other)


def test_a_generator_that_draws_other_scenes_is_found_out(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entry = MODELS["wanderer"]
    blind = type(entry)(**{**vars(entry), "plannable": drifting.Blind})
    monkeypatch.setitem(MODELS._targets, "wanderer", blind)
    found = reported(folder, tmp_path, "--dynamics", "none", "--episodes", "4")
    assert found["summary"]["scene"]["drawn"]["kept"] < 0.6
    # Nothing was planned or predicted.
    assert {"prediction", "hardest_segment"}.isdisjoint(found["summary"])
    assert {path.name for path in tmp_path.iterdir()} == {"report.json", "report.md", "samples.png"}


def test_validation_episodes_are_those_of_a_file_for_training(folder: Path, tmp_path: Path) -> None:
    words = ["report", "video", "--data", str(folder / "train.h5"), "--out", str(tmp_path), *QUICK]
    assert main([*words, *worlds(folder), "--generator", "none"]) == 0
    found = json.loads((tmp_path / "report.json").read_text())
    assert [record["episode"] for record in found["episodes"]] == [len(TRAIN) - 1]
    assert "(validation)" in (tmp_path / "report.md").read_text()
    assert main([*words, "--generator", "none", "--dynamics", "none"]) == 2
