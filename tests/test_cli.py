"""The command line: what every verb says, refuses, and writes."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest

import hvf
import hvf_core
import processes
from hvf.cli import VERBS, main
from hvf.cli.arguments import searching_with
from hvf.domains.domain import Domain, Place
from hvf.evaluation.report import load
from hvf.images import write_png
from hvf.registry import COSTS, DOMAINS, METHODS, MODELS

CHEAP = ["--samples=30", "--elites=6", "--iterations=2", "--steps=4"]
SEARCH = ["--subgoal-samples=12", "--subgoal-elites=4", "--subgoal-iterations=2"]
TRUE = [*CHEAP, *SEARCH, "--dynamics=simulator"]


def status(words: list[str]) -> int:
    """Exit status of a command, in this process."""
    try:
        return main(words)
    except SystemExit as stop:
        return int(stop.code or 0)


def one_line(text: str) -> str:
    """The only line of an error."""
    (line,) = text.strip().splitlines()
    return line


@pytest.fixture
def recorded_only(monkeypatch: pytest.MonkeyPatch) -> str:
    """A domain of recorded video: it has no trials."""
    monkeypatch.setattr(DOMAINS, "_targets", dict(DOMAINS._targets))
    kitchen = Domain("kitchen", "video of a kitchen", lambda workers: Place(), (-1.0,), (1.0,))
    DOMAINS.register("kitchen", kitchen)
    return "kitchen"


# ---- help --------------------------------------------------------------------------------------


def test_without_a_verb_all_verbs_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    for words in ([], ["--help"], ["-h"]):
        assert status(words) == 0
        said = capsys.readouterr().out
        assert all(f"  {verb}" in said for verb in VERBS)


def test_an_unknown_verb_is_named_and_the_others_listed(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert status(["dance", "maze"]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("hvf: no verb 'dance'")
    assert "eval" in said.err


def test_the_version_is_the_packages(capsys: pytest.CaptureFixture[str]) -> None:
    assert status(["--version"]) == 0
    assert capsys.readouterr().out == f"hvf {hvf.__version__}\n"


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_help(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert status([verb, "--help"]) == 0
    said = capsys.readouterr()
    assert "usage: hvf " + verb in said.out
    assert "Traceback" not in said.out + said.err


@pytest.mark.parametrize("verb", [v for v in VERBS if VERBS[v].takes in ("MODEL", "DOMAIN")])
def test_a_verb_that_takes_a_name_lists_names(
    verb: str, capsys: pytest.CaptureFixture[str]
) -> None:
    names = list(MODELS if VERBS[verb].takes == "MODEL" else DOMAINS)
    assert status([verb, "--help"]) == 0
    said = capsys.readouterr().out
    assert all(name in said for name in names)
    # Without the name: the same, as an error.
    assert status([verb]) == 2
    said = capsys.readouterr().err
    assert all(name in said for name in names)
    assert status([verb, "moon"]) == 2
    said = one_line(capsys.readouterr().err)
    assert said.startswith(f"hvf {verb}: ")
    assert "must be one of" in said
    assert "got 'moon'" in said


@pytest.mark.parametrize(
    ("verb", "name"),
    [
        ("eval", "maze"),
        ("plan", "desk"),
        ("demo", "maze"),
        ("collect", "maze"),
        ("collect", "desk"),
        ("results", "desk"),
        ("paper", "maze"),
    ],
)
def test_help_of_a_name_lists_its_options(
    verb: str, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert status([verb, name, "--help"]) == 0
    said = capsys.readouterr().out
    assert f"usage: hvf {verb} {name}" in said
    if verb in ("eval", "plan", "demo"):
        words = " ".join(said.split())
        for known in (*DOMAINS[name].tasks, *METHODS, *COSTS, *DOMAINS[name].presets):
            assert known in words
        assert "--over-horizon" in said


def test_help_shows_the_settings_of_the_preset_that_is_asked_for(
    capsys: pytest.CaptureFixture[str],
) -> None:
    said = {}
    for preset in ("default", "paper"):
        assert status(["eval", "maze", "--preset", preset, "--help"]) == 0
        said[preset] = " ".join(capsys.readouterr().out.split())
    assert "(default: uniform)" in said["default"]
    assert "(default: normal)" in said["paper"]


@pytest.mark.parametrize("model", ["cvae", "keypoint"])
def test_help_of_a_model_lists_its_recipe(model: str, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("torch")
    assert status(["train", model, "--help"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "--loop.steps" in said
    assert "--data" in said
    assert "Assumes:" in said


# ---- what cannot be --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["eval", "maze", "--trials", "0", *TRUE], "hvf eval: trials: must be at least 1, got 0"),
        (["eval", "maze", "--subgoals", "-1"], "hvf eval: subgoals: must not be negative, got -1"),
        (["eval", "maze", "--samples", "many"], "hvf eval: --samples: "),
        (["eval", "maze", "--preset", "papr"], "hvf eval: preset: must be one of 'default', "),
        (["eval", "maze", "--task", "easier"], "hvf eval: task: must be one of easy, medium, hard"),
        (["eval", "maze", "--out", "/", *TRUE], "/: is a directory"),
        (["plan", "maze", "--dynamics", "no/such.safetensors"], "hvf plan: dynamics: 'no/such.sa"),
        (["plan", "maze", "--episode", "-1"], "hvf plan: episode: must not be negative"),
        (["plan", "maze", "--film", "avi"], "hvf plan: film: must be 'gif' or 'mp4'"),
        (["demo", "maze", "--pictures", "-1"], "hvf demo: pictures: must not be negative"),
        (["results", "maze", "no/such/folder"], "hvf results: folder: "),
        (["train", "cvae", "--data", "no/such.h5"], "hvf train: no/such.h5"),
        (["export", "--source", "no/such.safetensors", "--target", "x"], "no/such.safetensors"),
        (["plan", "maze", "--data", "no/such.h5"], "no/such.h5"),
    ],
)
def test_a_wrong_value_is_one_line_and_status_2(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if words[0] in ("train", "export") or "--dynamics" in words:
        pytest.importorskip("torch")
    assert status(words) == 2
    assert said in one_line(capsys.readouterr().err)


def test_a_wrong_option_is_named_with_what_may_be_meant(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert status(["eval", "maze", "--blurr", "3"]) == 2
    said = capsys.readouterr().err
    assert "--blurr" in said
    assert "--blur " in said
    assert "Traceback" not in said


def test_debug_shows_where_an_error_comes_from(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["eval", "maze", "--trials", "0", *TRUE]
    assert status([*words, "--debug"]) == 2
    said = capsys.readouterr().err
    assert "Traceback (most recent call last)" in said
    assert "ValueError: trials: must be at least 1, got 0" in said
    assert said.splitlines()[-1].startswith("hvf eval: trials: ")
    assert status(["--debug", *words]) == 2
    assert "Traceback" in capsys.readouterr().err


def test_what_fails_on_the_way_is_status_1(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import hvf.cli.results as results

    def fail(words: Any) -> None:
        raise RuntimeError("no space left")

    monkeypatch.setattr(results, "run", fail)
    assert status(["results", "maze", "x"]) == 1
    assert one_line(capsys.readouterr().err) == "hvf results: no space left"

    def stop(words: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(results, "run", stop)
    assert status(["results", "maze", "x"]) == 130


def test_a_reader_that_goes_away_is_no_error(tmp_path: Path) -> None:
    """As in ``hvf paper maze | head``."""
    read, write = os.pipe()
    os.close(read)
    words = ["paper", "maze", "--no-run", "--only", "methods", "--out", "none"]
    with os.fdopen(write, "wb") as pipe:
        done = subprocess.run(
            [*processes.HVF, *words],
            cwd=tmp_path,
            stdout=pipe,
            stderr=subprocess.PIPE,
            text=True,
            timeout=processes.DEADLINE,
        )
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.parametrize("verb", ["eval", "demo"])
def test_a_domain_without_trials_says_why_it_cannot_be_acted_in(
    verb: str, recorded_only: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert status([verb, recorded_only]) == 2
    said = one_line(capsys.readouterr().err)
    assert said.startswith(f"hvf {verb}: domain: kitchen has no episodes to act in")
    assert "hvf plan kitchen" in said
    assert status(["collect", recorded_only]) == 2
    assert "nothing can be collected in kitchen" in one_line(capsys.readouterr().err)


# ---- end to end in the maze --------------------------------------------------------------------


def test_eval_writes_a_report_and_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "report.json"
    words = ["eval", "maze", "--method", "none", "--trials", "2", "--out", str(out), *TRUE]
    assert status([*words, "--preset", "paper"]) == 0
    report = load(out)
    assert len(report.trials) == 2
    assert (report.preset, report.split) == ("paper", "validation")
    assert (report.planning["initial"], report.planning["samples"]) == ("normal", 30)
    assert "no subgoals" in capsys.readouterr().out
    assert status(words) == 2
    assert "another evaluation" in one_line(capsys.readouterr().err)
    assert status([*words, "--preset", "paper", "--trials", "3"]) == 0
    assert load(out).trials[:2] == report.trials
    assert status([*words, "--overwrite"]) == 0
    assert load(out).preset == "default"


@pytest.mark.parametrize("option", ["--task=easy", "--difficulty=easy"])
def test_the_mazes_tasks_are_also_called_difficulties(
    option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert status(["eval", "maze", "--method=random", "--trials=1", "--steps=2", option]) == 0
    (path,) = (tmp_path / "outputs" / "eval").iterdir()
    assert path.name == "maze-easy-random-default-steps-2.json"
    assert load(path).task == "easy"
    words = ["eval", "maze", "--method=random", "--trials=1", "--steps=2", "--difficulty", "medium"]
    assert status(words) == 0
    assert len(list(path.parent.iterdir())) == 2


def test_plan_and_demo_draw(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan = ["plan", "maze", "--episode", "1", "--out", str(tmp_path / "plan"), *TRUE]
    assert status([*plan, "--subgoals", "1"]) == 0
    assert {p.name for p in (tmp_path / "plan").iterdir()} == {"episode-1.png", "episode-1.gif"}
    assert "HVF-1, simulator, episode 1: goal " in " ".join(capsys.readouterr().out.split())
    demo = ["demo", "maze", "--episodes", "2", "--pictures", "1", "--out", str(tmp_path / "demo")]
    assert status([*demo, *TRUE]) == 0
    names = {p.name for p in (tmp_path / "demo").iterdir()}
    assert names == {"episode-0.png", "episode-0.gif", "hvf.json", "none.json"}
    assert "HVF-2" in capsys.readouterr().out


def test_what_differs_is_drawn_in_folders_that_differ(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    quick = ["--method=none", "--dynamics=simulator", *CHEAP]
    for verb in (["plan"], ["demo", "--episodes=1", "--pictures=1"]):
        for words in ([], ["--blur=1"], ["--difficulty=easy"]):
            assert status([verb[0], "maze", *verb[1:], *quick, *words]) == 0
        folders = {folder.name for folder in (tmp_path / "outputs" / verb[0]).iterdir()}
        common = "simulator-samples-30-elites-6-iterations-2"
        assert folders == {
            f"maze-hard-no-subgoals-default-dynamics-{common}-steps-4",
            f"maze-hard-no-subgoals-default-dynamics-{common}-blur-1.0-steps-4",
            f"maze-easy-no-subgoals-default-dynamics-{common}-steps-4",
        }
        files = {"plan": {"episode-0.png", "episode-0.gif"}}
        files["demo"] = files["plan"] | {"none.json"}
        for folder in folders:
            written = (tmp_path / "outputs" / verb[0] / folder).iterdir()
            assert {path.name for path in written} == files[verb[0]]


def scene(path: Path, index: int = 0) -> tuple[Path, Path]:
    """Start and goal of an episode as files."""
    states, targets = hvf_core.maze_episodes(0, index, 1, "hard")
    goals = np.concatenate([targets, states[:, 2:]], axis=1)
    files = path / "start.png", path / "goal.png"
    for file, state in zip(files, (states, goals), strict=True):
        write_png(file, hvf_core.maze_render(state)[0])
    return files


def test_subgoals_are_found_between_two_images(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("torch")
    start, goal = scene(tmp_path)
    out = tmp_path / "found" / "strip.png"
    words = ["subgoals", "--start", str(start), "--goal", str(goal), "--out", str(out)]
    assert status([*words, "--subgoals", "1"]) == 0
    names = {path.name for path in out.parent.iterdir()}
    assert names == {"strip.png", "strip.json", "strip-1.png"}
    assert iio.imread(out.with_name("strip-1.png")).shape == (64, 64, 3)
    facts = json.loads(out.with_suffix(".json").read_text())
    assert len(facts["segment_costs"]) == 2
    assert max(facts["segment_costs"]) < facts["cost_without_subgoals"]
    assert facts["weights"].keys() == {"dynamics", "generator"}
    assert "hardest segment" in " ".join(capsys.readouterr().out.split())


def test_images_that_are_not_there_or_do_not_fit_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("torch")
    start, goal = scene(tmp_path)
    small, text = tmp_path / "small.png", tmp_path / "text.png"
    write_png(small, np.zeros((32, 32, 3), np.uint8))
    text.write_text("no image")
    for files, said in (
        ((tmp_path / "none.png", goal), "start: "),
        ((start, tmp_path / "none.png"), "goal: "),
        ((start, text), "text.png is no image"),
        ((start, small), "goal: must be as large as start [64, 64, 3], got [32, 32, 3]"),
        ((small, small), "images: expected shape [N, 64, 64, 3]"),
    ):
        words = ["subgoals", "--start", str(files[0]), "--goal", str(files[1])]
        assert status([*words, "--out", str(tmp_path / "x.png")]) == 2
        assert said in one_line(capsys.readouterr().err)
    assert not (tmp_path / "x.png").exists()
    words = ["subgoals", "--start", str(start), "--goal", str(goal)]
    for option, said in (
        ("--subgoals=0", "subgoals: must be at least 1, got 0"),
        ("--domain=moon", "domain: must be one of maze, desk"),
        ("--generator=moon", "generator: 'moon' is neither a file"),
        ("--dynamics=cvae", "dynamics: "),
        ("--samples=0", "samples: "),
        ("--preset=moon", "preset: "),
        ("--memory-gb=0", "memory_gb: must be positive"),
        ("--method-model=x.safetensors", "method_model: no method acts here"),
    ):
        assert status([*words, option]) == 2
        assert said in one_line(capsys.readouterr().err)


@pytest.mark.parametrize("verb", ["subgoals", "plan", "report"])
def test_a_search_that_acts_in_nothing_takes_all_of_a_preset_and_any_setting(verb: str) -> None:
    pytest.importorskip("torch")
    from hvf.cli.recorded import Recorded
    from hvf.cli.subgoals import Subgoals
    from hvf.experiments.video_report import VideoReport

    configs: dict[str, tuple[Any, list[str]]] = {
        "subgoals": (Subgoals, ["start", "goal"]),
        "plan": (Recorded, ["data"]),
        "report": (VideoReport, ["data"]),
    }
    config, needed = configs[verb]
    desk = DOMAINS["desk"]
    words = [f"--{name}=file" for name in needed]
    usual = searching_with(config, verb, desk, words, needed)
    default = desk.preset("default")
    assert (usual.world, usual.planning) == (default.world, default.planning)
    words += ["--preset=video", "--samples=20", "--elites=12", "--precision=bfloat16"]
    found = searching_with(config, verb, desk, words, needed)
    video = desk.preset("video")
    assert found.world == dataclasses.replace(video.world, precision="bfloat16")
    assert found.world.dynamics == "latent"
    assert found.planning == dataclasses.replace(video.planning, samples=20, elites=12)


def test_export_writes_the_same_model_at_half_its_size(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    torch = pytest.importorskip("torch")
    from hvf.models.checkpoint import load_any, save_model
    from hvf.models.vae import CVAE, CVAEConfig

    torch.manual_seed(0)
    source, target = tmp_path / "model.safetensors", tmp_path / "half.safetensors"
    model = CVAE(CVAEConfig(image_size=(16, 16), channels=(4, 8), strides=(2, 2), pyramid_levels=1))
    save_model(source, model, environment="maze")
    assert status(["export", "--source", str(source), "--target", str(target)]) == 0
    assert target.stat().st_size < 0.6 * source.stat().st_size
    found = load_any(target)
    assert found.name == "cvae"
    for name, weight in found.module.state_dict().items():
        torch.testing.assert_close(weight, model.state_dict()[name], rtol=1e-3, atol=1e-3)
    assert "half.safetensors" in capsys.readouterr().out


# ---- what is imported --------------------------------------------------------------------------

HEAVY = ("torch", "matplotlib", "scipy", "mujoco", "h5py")


@pytest.mark.parametrize(
    "program",
    [
        "import hvf; hvf.VisualMPC, hvf.HVF, hvf.DOMAINS, hvf.Planning, hvf.Evaluation",
        "import hvf; [hvf.DOMAINS[name] for name in hvf.DOMAINS]",
        "from hvf.cli import main; main([]); main(['--version'])",
    ],
)
def test_importing_is_light(program: str) -> None:
    check = f"import sys\n{program}\nprint(*[name for name in {HEAVY} if name in sys.modules])"
    done = processes.run(processes.python(check), check=True)
    assert done.stdout.splitlines()[-1] == ""


def test_help_imports_no_torch() -> None:
    check = (
        "import sys\nfrom hvf.cli import main\n"
        "for words in (['eval', '--help'], ['train', '--help'], ['eval', 'maze', '--help']):\n"
        "    try:\n        main(words)\n    except SystemExit:\n        pass\n"
        "assert 'torch' not in sys.modules\n"
    )
    processes.run(processes.python(check), check=True)
