"""The house is open: a domain and a model of another package, from data to pictures."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

pytest.importorskip("torch")

import firefly
import hvf
import processes
from hvf.cli import main
from hvf.data.formats import open_episodes
from hvf.evaluation.report import load
from hvf.images import write_png
from hvf.models.checkpoint import load_any
from hvf.registry import DOMAINS, METHODS, MODELS, Registry


@pytest.fixture(scope="module", autouse=True)
def registered() -> Iterator[None]:
    """The package of others is imported, and forgotten after these tests."""
    with pytest.MonkeyPatch.context() as patch:
        for registry in (DOMAINS, MODELS):
            patch.setattr(registry, "_targets", dict(registry._targets))
        firefly.register()
        yield


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("data") / "firefly.h5"
    words = ["collect", "firefly", "--out", str(out), "--episodes", "24", "--steps", "6"]
    assert main([*words, "--seed", "3", "--part", "10"]) == 0
    return out


@pytest.fixture(scope="module")
def wings(data: Path) -> Path:
    out = data.parent / "wings"
    assert main(["train", "wings", "--data", str(data), "--out", str(out)]) == 0
    return out / "model.safetensors"


@pytest.fixture(scope="module")
def cvae(data: Path) -> Path:
    out = data.parent / "cvae"
    tiny = "--model.channels 4 8 --model.strides 2 2 --model.pyramid-levels 1 "
    tiny += "--model.posterior-layers 16 --model.scene-layers 16 --model.image-layers 16 "
    tiny += "--batch-size 8 --loop.steps 60 --loop.warmup-steps 5 --loop.device cpu"
    words = ["train", "cvae", "--data", str(data), "--out", str(out), "--loop.threads", "1"]
    assert main([*words, *tiny.split()]) == 0
    return out / "model.safetensors"


def test_collected_episodes_are_of_the_domain(data: Path) -> None:
    with open_episodes(data) as file:
        assert file.metadata.environment == "firefly"
        assert (len(file), file.metadata.steps, file.frame_shape) == (24, 6, (16, 16, 3))
        assert (file.metadata.action_low, file.metadata.action_high) == ((-2, -2), (2, 2))
        episode = file.read(0, 1)
    light = episode.frames[0, :, :, :, 0].astype(float)
    assert light.max(axis=(1, 2)).min() > 100
    # Once more: the same file, episode by episode.
    again = data.with_name("again.h5")
    words = ["collect", "firefly", "--out", str(again), "--episodes", "3", "--steps", "6"]
    assert main([*words, "--seed", "3"]) == 0
    with open_episodes(again) as file:
        np.testing.assert_array_equal(file.read(0, 1).frames, episode.frames)


def test_a_model_of_ones_own_is_trained_and_found_by_its_checkpoint(wings: Path) -> None:
    found = load_any(wings)
    assert (found.name, found.header.environment) == ("wings", "firefly")
    gain = found.module.far.weight.detach().numpy()
    np.testing.assert_allclose(gain, np.eye(2), atol=0.2)


def test_the_papers_generator_learns_from_these_images(cvae: Path) -> None:
    found = load_any(cvae)
    assert found.name == "cvae"
    assert found.module.config.image_size == (16, 16)


def test_subgoals_are_searched_between_two_images(
    wings: Path, cvae: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = tmp_path / "a.png", tmp_path / "b.png"
    for file, place in zip(files, [(4, 4), (11, 11)], strict=True):
        write_png(file, firefly.draw(place)[0])
    out = tmp_path / "strip.png"
    words = ["subgoals", "--start", str(files[0]), "--goal", str(files[1]), "--out", str(out)]
    words += ["--dynamics", str(wings), "--generator", str(cvae), "--domain", "firefly"]
    assert main([*words, "--subgoals", "1"]) == 0
    assert iio.imread(tmp_path / "strip-1.png").shape == (16, 16, 3)
    facts = json.loads(out.with_suffix(".json").read_text())
    assert {part: weights["model"] for part, weights in facts["weights"].items()} == {
        "dynamics": "wings",
        "generator": "cvae",
    }
    assert "hardest segment" in " ".join(capsys.readouterr().out.split())


def test_subgoals_are_searched_between_two_recorded_frames(
    wings: Path, cvae: Path, data: Path, tmp_path: Path
) -> None:
    words = ["plan", "firefly", "--data", str(data), "--episode", "2", "--first", "1"]
    words += ["--dynamics", str(wings), "--generator", str(cvae), "--out", str(tmp_path)]
    assert main([*words, "--subgoals", "2"]) == 0
    names = {path.name.removeprefix("episode-2-1-6") for path in tmp_path.iterdir()}
    assert names == {".png", ".json", "-1.png", "-2.png"}


def test_searches_with_other_settings_are_kept_apart(
    wings: Path, cvae: Path, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["plan", "firefly", "--data", str(data), "--dynamics", str(wings)]
    words += ["--generator", str(cvae), "--subgoals", "1"]
    for more in (
        [],
        ["--seed", "1"],
        ["--samples", "61"],
        ["--from", "1"],
        ["--over-horizon", "min"],
    ):
        assert main([*words, *more]) == 0
    folders = {path.name: path for path in (tmp_path / "outputs" / "plan").iterdir()}
    assert len(folders) == 4
    assert all(name.startswith(f"firefly-{data.stem}-default-subgoals-1") for name in folders)
    assert sum(len(list(folder.glob("*.json"))) for folder in folders.values()) == 5


def test_methods_are_evaluated_and_compared(
    wings: Path, cvae: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reports = {}
    for method in ("random", "none", "hvf"):
        out = tmp_path / f"{method}.json"
        words = ["eval", "firefly", "--method", method, "--subgoals", "1", "--trials", "8"]
        words += ["--dynamics", str(wings), "--generator", str(cvae), "--out", str(out)]
        assert main(words) == 0
        reports[method] = load(out)
    assert all(len(report.trials) == 8 for report in reports.values())
    assert reports["hvf"].kind == "video"
    assert reports["hvf"].weights["dynamics"]["model"] == "wings"
    # The wings know where to go, and the pixel is far.
    assert reports["none"].successes >= 7 > reports["random"].successes
    assert main(["results", "firefly", str(tmp_path)]) == 0
    assert "HVF-1" in capsys.readouterr().out
    # In one process and on its own, a trial is the same.
    again = tmp_path / "again.json"
    words = ["eval", "firefly", "--method", "none", "--trials", "8", "--chunk", "3"]
    assert main([*words, "--dynamics", str(wings), "--out", str(again)]) == 0
    outcomes = [[(t.success, t.steps) for t in r.trials] for r in (load(again), reports["none"])]
    assert outcomes[0] == outcomes[1]


def test_ground_truth_is_refused_where_there_is_none(
    wings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["eval", "firefly", "--method", "ground-truth", "--dynamics", str(wings)]
    assert main([*words, "--trials=1", "--out", str(tmp_path / "x.json")]) == 2
    (said,) = capsys.readouterr().err.strip().splitlines()
    assert said == "hvf eval: method: 'ground-truth' needs true_subgoals, which GymTrials lacks"
    assert main(["eval", "firefly", "--dynamics", "simulator", "--method=none", "--trials=1"]) == 2
    assert "'simulator' is not available here" in capsys.readouterr().err


def test_an_episode_is_drawn(wings: Path, cvae: Path, tmp_path: Path) -> None:
    world = ["--dynamics", str(wings), "--generator", str(cvae), "--subgoals", "1"]
    assert main(["plan", "firefly", *world, "--episode", "1", "--out", str(tmp_path)]) == 0
    strip = iio.imread(tmp_path / "episode-1.png")
    # Start, subgoal, goal and end: four panels.
    assert strip.shape[1] > 4 * 200
    film = iio.imread(tmp_path / "episode-1.gif", index=None)
    assert 2 <= len(film) <= 13 + 6
    assert film.shape[1:3] == (390, 640)
    demo = ["demo", "firefly", "--episodes", "2", "--pictures", "1", "--out", str(tmp_path / "d")]
    assert main([*demo, *world]) == 0
    names = {path.name for path in (tmp_path / "d").iterdir()}
    assert names == {"episode-0.png", "episode-0.gif", "hvf.json", "none.json"}


def test_a_domain_by_hand_has_ground_truth_and_tells_where_things_are(
    wings: Path, cvae: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    world = ["--dynamics", str(wings), "--generator", str(cvae), "--subgoals", "1"]
    world += ["--samples=30", "--elites=5", "--horizon=3", "--threshold=0.01"]
    out = tmp_path / "report.json"
    words = ["eval", "meadow", "--method", "ground-truth", "--trials", "4", "--out", str(out)]
    assert main([*words, *world]) == 0
    report = load(out)
    assert (report.task, report.successes) == ("far", 4)
    assert all(len(trial.switches) <= 1 for trial in report.trials)
    assert main(["plan", "meadow", "--method", "none", "--out", str(tmp_path), *world]) == 0
    assert iio.imread(tmp_path / "episode-0.png").shape[1] > 3 * 200
    capsys.readouterr()
    assert main(["collect", "meadow", "--out", "x.h5"]) == 2
    assert "nothing can be collected in meadow" in capsys.readouterr().err


def test_the_package_does_not_know_them() -> None:
    package = Path(hvf.__file__).parent
    names = re.compile(r"\b(firefly|meadow|wings)\b", re.IGNORECASE)
    assert [path for path in package.rglob("*.py") if names.search(path.read_text())] == []


# ---- entry points ------------------------------------------------------------------------------


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """A folder as pip leaves it, with a distribution that adds to the registries."""
    info = tmp_path / "fireflies-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: fireflies\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[hvf.domains]\nfirefly = firefly:FIREFLY\nmaze = firefly:MEADOW\n\n"
        "[hvf.models]\nwings = firefly:WINGS\nbroken = fireflies.nowhere:NOTHING\n"
    )
    return tmp_path


def test_entry_points_of_other_packages_are_found(installed: Path) -> None:
    path = f"{installed}:{Path(firefly.__file__).parent}:{Path(hvf.__file__).parent.parent}"
    program = (
        "from hvf.cli import main\n"
        "from hvf.registry import DOMAINS, MODELS\n"
        "for words in (['eval', '--help'], ['train', 'wings', '--help']):\n"
        "    try:\n        main(words)\n"
        "    except SystemExit as stop:\n        assert not stop.code\n"
        # A name of this package stays this package's.
        "assert DOMAINS['maze'].tasks.keys() == {'easy', 'medium', 'hard'}\n"
        "assert DOMAINS['firefly'].name == 'firefly'\n"
        "try:\n    MODELS['broken']\nexcept ImportError as error:\n    print(error)\n"
    )
    done = processes.run(processes.python(program), env={"PYTHONPATH": path}, check=True)
    assert "firefly" in done.stdout
    assert "hvf train wings" in done.stdout
    assert "fireflies" in done.stdout.splitlines()[-1]


def test_a_domain_of_another_package_brings_its_own_tables(installed: Path) -> None:
    path = f"{installed}:{Path(firefly.__file__).parent}:{Path(hvf.__file__).parent.parent}"
    program = (
        "import sys\nfrom hvf.cli import main\n"
        "if __name__ == '__main__':\n"
        f"    out = ['--trials', '3', '--workers', '1', '--out', {str(installed / 'out')!r}]\n"
        "    sys.exit(main(['paper', 'firefly', *out]))\n"
    )
    (installed / "program.py").write_text(program)
    words = [sys.executable, str(installed / "program.py")]
    done = processes.run(words, env={"PYTHONPATH": path}, check=True)
    lines = done.stdout.splitlines()
    assert lines[0] == "**Flights in the dark**"
    (row,) = [line for line in lines if line.startswith("| random | ")]
    assert "(n = 3) (paper 2%" in row
    (file,) = (installed / "out").iterdir()
    report = load(file)
    assert (report.domain, report.preset, report.split) == ("firefly", "default", "test")


BROKEN = """
[hvf.domains]
lost-place = plugs.nowhere:PLACE
[hvf.models]
lost-model = plugs.nowhere:MODEL
[hvf.methods]
lost-method = plugs.nowhere:METHOD
hasty = hasty:METHOD
[hvf.costs]
lost-cost = plugs.nowhere:COST
"""


def test_a_plugin_that_cannot_be_imported_is_named_and_spoils_no_other(tmp_path: Path) -> None:
    info = tmp_path / "plugs-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: plugs\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(BROKEN)
    (tmp_path / "hasty.py").write_text("raise RuntimeError('no licence [red]')\n")
    path = f"{tmp_path}:{Path(hvf.__file__).parent.parent}"

    def run(words: str) -> tuple[int, str, str]:
        command = [*processes.HVF, *words.split()]
        done = processes.run(command, env={"PYTHONPATH": path, "COLUMNS": "200"})
        return done.returncode, done.stdout, done.stderr

    gone = "(plugs.nowhere:{}): No module named 'plugs'"
    for words, known, lost in (
        ("eval --help", "the Franka", f"cannot be imported: domain 'lost-place' {gone}"),
        ("train --help", "SV2P", f"cannot be imported: model 'lost-model' {gone}"),
        ("eval maze --help", "method none:", f"cannot be imported: method 'lost-method' {gone}"),
        ("eval maze --help", "cost pixel:", f"cannot be imported: cost 'lost-cost' {gone}"),
    ):
        status, said, _ = run(words)
        assert status == 0
        assert known.split()[0] in said
        attribute = re.findall(r"'lost-(\w+)'", lost)[0].upper()
        assert lost.format(attribute) in re.sub(r"[\s│]+", " ", said)
    status, said, _ = run("paper maze --no-run --only methods --out none")
    assert (status, said.splitlines()[0]) == (0, "**Methods by difficulty**")
    assert "method 'hasty' (hasty:METHOD): no licence [red]" in re.sub(
        r"[\s│]+", " ", run("eval maze --help")[1]
    )
    for words, said in (
        ("eval lost-place", f"hvf eval: domain 'lost-place' {gone.format('PLACE')}"),
        ("train lost-model", f"hvf train: model 'lost-model' {gone.format('MODEL')}"),
        ("eval maze --method lost-method", f"method 'lost-method' {gone.format('METHOD')}"),
        ("eval maze --method hasty", "hvf eval: method 'hasty' (hasty:METHOD): no licence [red]"),
    ):
        status, _, errors = run(words)
        assert status == 1
        (line,) = errors.strip().splitlines()
        assert said in line


def test_names_are_taken_once() -> None:
    registry: Registry[int] = Registry("number", "hvf.none", {"one": "math:pi"})
    registry.register("two", 2)
    with pytest.raises(ValueError, match="number: there is a number 'two' already"):
        registry.register("two", 3)
    registry.register("two", 3, replace=True)
    assert list(registry) == ["one", "two"]
    assert (len(registry), "one" in registry, registry["two"]) == (2, True, 3)
    assert registry["one"] == pytest.approx(np.pi)
    with pytest.raises(ValueError, match="number: must be one of one, two; got 'three'"):
        registry["three"]
    registry.register("lost", "math:tau_of_nothing")
    with pytest.raises(ImportError, match="math has no 'tau_of_nothing'"):
        registry["lost"]
    assert "hvf" in METHODS
