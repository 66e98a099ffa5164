"""Success rates: settings, reports, going on with a stopped evaluation, and pictures."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import itertools
import json
import math
import os
import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from rich.progress import Progress

import hvf
import hvf_core
import processes
from hvf.cli.watching import how_it_went, watch
from hvf.data.splits import EPISODE_SEEDS
from hvf.evaluation import Evaluation, Outcome, Task, Trial
from hvf.evaluation.acting import Watcher
from hvf.evaluation.code import same_code
from hvf.evaluation.pictures import save_film, save_strip, save_subgoals
from hvf.evaluation.recording import record
from hvf.evaluation.report import HEAD, Report, load, save
from hvf.evaluation.run import evaluate, evaluate_task
from hvf.evaluation.statistics import wilson_interval
from hvf.progress import Bar
from hvf.registry import DOMAINS, METHODS
from hvf.settings import Planning, World

CHEAP: dict[str, Any] = {
    "samples": 30,
    "elites": 6,
    "iterations": 2,
    "subgoal_samples": 12,
    "subgoal_elites": 4,
    "subgoal_iterations": 2,
    "dynamics": "simulator",
}
QUIET = Console(quiet=True)


def cheap(**settings: Any) -> Task:
    """A task of the maze with the true simulator and small budgets."""
    return Task.open(Evaluation.of("maze", **{**CHEAP, **settings}))


# ---- settings ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"method": "clever"}, "^method: must be one of none, hvf"),
        ({"task": "extreme"}, "^task: must be one of easy, medium, hard"),
        ({"split": "exam"}, "^split: must be one of train, validation, test"),
        ({"subgoals": -1}, "^subgoals: "),
        ({"seed": -1}, "^seed: "),
        ({"seed": 2**64}, "^seed: "),
        ({"horizon": 0}, "^horizon: "),
        ({"elites": 201}, "^elites: "),
        ({"blur": -1.0}, "^blur: "),
        ({"over_horizon": "first"}, "^over_horizon: "),
        ({"initial": "leftward"}, "^initial: "),
        ({"steps": 0}, "^steps: "),
        ({"threshold": float("nan")}, "^threshold: "),
        ({"reached": "never"}, "^reached: "),
        ({"replan_every": 6}, "^replan_every: "),
    ],
)
def test_settings_out_of_range_are_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Evaluation.of("maze", **settings)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"dynamics": "dream"}, "^dynamics: 'dream' is neither a file nor one of the models"),
        ({"generator": "gan"}, "^generator: 'gan' is neither a file"),
        ({"dynamics": "cvae"}, "^dynamics: .* holds a cvae model, which is good for generator"),
        ({"cost": "beauty"}, "^cost: must be one of pixel, latent, temporal"),
    ],
)
def test_models_that_there_are_not_are_named_when_they_are_loaded(
    settings: dict[str, Any], message: str
) -> None:
    pytest.importorskip("torch")
    evaluation = Evaluation.of("maze", **settings)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        Task.open(evaluation)


def test_presets_are_where_settings_begin() -> None:
    maze = DOMAINS["maze"]
    paper = Evaluation.of("maze", "paper", method="none", horizon=10)
    assert paper.planning == dataclasses.replace(maze.preset("paper").planning, horizon=10)
    assert (paper.planning.blur, paper.planning.initial) == (0.0, "normal")
    assert (paper.method, paper.preset, paper.world) == ("none", "paper", World("keypoint", "cvae"))
    with pytest.raises(ValueError, match=r"^preset: must be one of 'default', 'paper', 'released'"):
        Evaluation.of("maze", "newspaper")
    with pytest.raises(TypeError, match=r"^horizont: there is no such setting"):
        Evaluation.of("maze", horizont=3)
    with pytest.raises(ValueError, match=r"^domain: must be one of maze, desk"):
        Evaluation.of("cellar")


def world_of(evaluation: Evaluation) -> World:
    """The names of what an evaluation plans with, its defaults said."""
    return evaluation.place.resolved(evaluation.world)


@pytest.mark.parametrize(
    ("preset", "settings", "world"),
    [
        ("default", {}, ("keypoint", "keypoint-generator")),
        ("default", {"dynamics": "simulator"}, ("simulator", "oracle")),
        ("default", {"generator": "cvae"}, ("keypoint", "cvae")),
        ("paper", {}, ("keypoint", "cvae")),
        ("paper", {"dynamics": "simulator"}, ("simulator", "cvae")),
        ("paper", {"dynamics": "simulator", "generator": "default"}, ("simulator", "oracle")),
        ("released", {}, ("keypoint", "cvae")),
    ],
)
def test_every_dynamics_has_a_generator_unless_the_preset_has_one(
    preset: str, settings: dict[str, Any], world: tuple[str, str]
) -> None:
    named = world_of(Evaluation.of("maze", preset, **settings))
    assert (named.dynamics, named.generator) == world


def test_episodes_are_those_of_validation_unless_asked_for() -> None:
    assert Evaluation.of("maze").split == "validation"
    seeds = {split: Evaluation.of("maze", split=split).episode_seed for split in EPISODE_SEEDS}
    assert seeds == dict(EPISODE_SEEDS)
    assert len(set(seeds.values())) == 3
    assert Evaluation.of("maze", seed=4).episode_seed == 4
    config = cheap(method="random").config
    assert (config["split"], config["seed"]) == ("validation", EPISODE_SEEDS["validation"])
    # With a seed of one's own they are nobody's.
    assert cheap(method="random", seed=4).config["split"] is None


def test_splits_share_no_episode() -> None:
    count = 200
    found = [
        DOMAINS["maze"].open().trials("hard", seed, 0, count).states.tolist()
        for seed in EPISODE_SEEDS.values()
    ]
    states = {tuple(state) for split in found for state in split}
    assert len(states) == 3 * count


SOME: dict[str, Any] = {
    "task": st.sampled_from(["easy", "hard"]),
    "method": st.sampled_from(list(METHODS)),
    "subgoals": st.integers(0, 12),
    "split": st.sampled_from(list(EPISODE_SEEDS)),
    "seed": st.none() | st.integers(0, 3),
    "dynamics": st.sampled_from(
        [
            "default",
            "keypoint",
            "simulator",
            "a/model.safetensors",
            "b/a/model.safetensors",
            "a.safetensors",
            "A.safetensors",
            "keypoint/model.safetensors",
        ]
    ),
    "generator": st.sampled_from(["default", "cvae", "keypoint-generator", "runs/cvae.safetensors"])
    | st.text("ab-./", min_size=1, max_size=4),
    "cost": st.sampled_from(["pixel", "latent"]),
    "cost_model": st.none() | st.sampled_from(["x/model.safetensors", "y/x/model.safetensors"]),
    "samples": st.sampled_from([200, 50, 500]),
    "blur": st.sampled_from([0.0, 3.0, 0.5, 5e-05, 5.0]),
    "initial": st.sampled_from(["uniform", "normal"]),
    "initial_low": st.none() | st.sampled_from([(-1.0, 0.0), (-1.0, -2.0), (-1.5, -2.0)]),
    "initial_high": st.none() | st.sampled_from([(1.0, 2.0), (1.0, 2.5)]),
    "warm_start": st.booleans(),
    "subgoal_samples": st.sampled_from([100, 200]),
    "reduction": st.sampled_from(["max", "mean", "max-sum"]),
    "steps": st.none() | st.sampled_from([5, 50]),
    "threshold": st.sampled_from([0.0, 1e-3, 1e-2]),
}


def said(evaluation: Evaluation) -> tuple[Any, ...]:
    """All that a report says of an evaluation's settings, without loading its models."""
    method, world = METHODS[evaluation.method], world_of(evaluation)
    return (
        evaluation.task,
        evaluation.method,
        evaluation.subgoals if method.has_subgoals else 0,
        evaluation.preset,
        (evaluation.split, evaluation.seed),
        (world.dynamics, world.cost, world.cost_model) if method.needs_dynamics else (),
        world.generator if method.needs_generator else "",
        evaluation.planning,
    )


def made(preset: str, settings: dict[str, Any]) -> Evaluation:
    """An evaluation; bounds of the first actions go with a uniform distribution only."""
    bounded = settings.get("initial_low") or settings.get("initial_high")
    return Evaluation.of(
        "maze", preset, **{**settings, **({"initial": "uniform"} if bounded else {})}
    )


@given(
    st.sampled_from(["default", "paper"]),
    st.fixed_dictionaries({}, optional=SOME),
    st.sampled_from(["default", "paper"]),
    st.fixed_dictionaries({}, optional=SOME),
    st.booleans(),
)
@settings(max_examples=200)
def test_settings_that_differ_have_files_that_differ(
    preset: str, some: dict[str, Any], other: str, more: dict[str, Any], alike: bool
) -> None:
    first = made(preset, some)
    # Two that are alike but for a setting or two are the likelier to share a name.
    few = dict(itertools.islice(more.items(), 2))
    second = made(preset if alike else other, {**(some if alike else {}), **few})
    if said(first) != said(second):
        assert first.slug != second.slug
    for evaluation in (first, second):
        assert evaluation.slug == evaluation.slug.strip("-")
        assert set(evaluation.slug) <= set("abcdefghijklmnopqrstuvwxyz0123456789.-")


def test_plain_settings_are_read_off_the_name_of_the_file() -> None:
    def slug(preset: str = "default", **settings: Any) -> str:
        return Evaluation.of("maze", preset, **settings).slug

    assert slug() == "maze-hard-hvf-2-default"
    assert slug("paper", method="none", horizon=10, task="easy", split="test") == (
        "maze-easy-no-subgoals-paper-horizon-10-test"
    )
    assert slug(generator="cvae", threshold=1e-5, seed=3) == (
        "maze-hard-hvf-2-default-generator-cvae-threshold-1e-05-seed-3"
    )
    assert slug(dynamics="runs/mine/model.safetensors").startswith(
        "maze-hard-hvf-2-default-dynamics-mine-"
    )


@given(st.integers(0, 200), st.integers(0, 200))
@settings(max_examples=50, deadline=None)
def test_interval_is_wilsons(successes: int, failures: int) -> None:
    n, z = successes + failures, 1.959963984540054
    if n == 0:
        with pytest.raises(ValueError, match="successes"):
            wilson_interval(0, 0)
        return
    p = successes / n
    centre = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * math.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    # Without a success the reference's lower end is 0 but for rounding.
    expected = (centre - half, centre + half)
    np.testing.assert_allclose(wilson_interval(successes, n), expected, rtol=1e-9, atol=1e-12)


# ---- going on, and what is written -------------------------------------------------------------


class Coin:
    """A task whose trial succeeds if its number is even, and that can be stopped."""

    name = "coin"
    steps = 10
    chunk = 4

    def __init__(self, stop_after: int = 10**9, **settings: Any) -> None:
        head = dict.fromkeys(HEAD, "")
        head |= {"subgoals": 0, "split": None, "seed": 1, "planning": {"samples": 1, "blur": 0.0}}
        head |= {"world": {"dynamics": "copper"}, "weights": {"dynamics": {"sha256": "0"}}}
        self.config = {**head, **settings}
        self.ran: list[int] = []
        self.stop_after = stop_after

    def run(self, first: int, count: int, watchers: Sequence[Watcher] = ()) -> Outcome:
        if len(self.ran) + count > self.stop_after:
            raise KeyboardInterrupt
        self.ran += range(first, first + count)
        for watcher in watchers:
            for trial in range(count):
                watcher.chosen(trial)
            for step in range(1, self.steps + 1):
                watcher.stepped(step, np.arange(count))
        trials = [
            Trial(i % 2 == 0, i, (), (), "it rolled away" if i == 5 else None)
            for i in range(first, first + count)
        ]
        return Outcome(trials, [], [0.1] * count, 0.2, count)


def test_a_stopped_evaluation_goes_on_where_it_was(tmp_path: Path) -> None:
    out = tmp_path / "folder" / "coin.json"
    with pytest.raises(KeyboardInterrupt):
        evaluate_task(Coin(stop_after=7), 10, out, chunk=3)
    # Every finished chunk is there.
    assert [trial.index for trial in load(out).trials] == [0, 1, 2, 3, 4, 5]
    resumed = Coin()
    report = evaluate_task(resumed, 10, out, chunk=3)
    assert resumed.ran == [6, 7, 8, 9]
    at_once = evaluate_task(Coin(), 10, tmp_path / "other.json", chunk=3)
    assert [dataclasses.astuple(t)[:4] for t in report.trials] == [
        dataclasses.astuple(t)[:4] for t in at_once.trials
    ]
    assert load(out).trials == report.trials
    assert (report.successes, report.success_rate) == (5, 0.5)
    content = json.loads(out.read_text())
    assert content["format"] == 2
    assert content["confidence_interval_95"] == list(wilson_interval(5, 10))
    assert content.keys() >= {"name", *HEAD, "wall_seconds", "trials"}
    assert {"version", "commit", "changes", "python", "packages"} <= content["code"].keys()
    assert content["trials"][5] == {
        "index": 5,
        "success": False,
        "steps": 5,
        "switches": [],
        "search_seconds": 0.1,
        "step_seconds": pytest.approx(0.2 / 3),
        "error": "it rolled away",
    }


def test_more_trials_are_added_to_a_finished_evaluation(tmp_path: Path) -> None:
    out = tmp_path / "coin.json"
    evaluate_task(Coin(), 4, out)
    more = Coin()
    assert evaluate_task(more, 9, out).successes == 5
    assert more.ran == [4, 5, 6, 7, 8]
    fewer = evaluate_task(Coin(stop_after=0), 3, out)
    assert len(fewer.trials) == 3
    assert len(load(out).trials) == 9


def test_gaps_between_finished_trials_are_filled(tmp_path: Path) -> None:
    out = tmp_path / "coin.json"
    whole = evaluate_task(Coin(), 9, out)
    save(dataclasses.replace(whole, trials=tuple(whole.trials[i] for i in (1, 4, 8))), out)
    again = Coin()
    assert [trial.index for trial in evaluate_task(again, 9, out).trials] == list(range(9))
    assert again.ran == [0, 2, 3, 5, 6, 7]


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"method": "toss"}, "method is "),
        ({"preset": "paper"}, "preset is "),
        ({"seed": 2}, "seed is 1"),
        ({"split": "test", "seed": 2}, "other split"),
        ({"world": {"dynamics": "tin"}}, "world is with dynamics copper there, tin here"),
        ({"planning": {"samples": 1, "blur": 1.0}}, "planning is with blur 0.0 there, 1.0 here"),
        ({"weights": {"dynamics": {"sha256": "1"}}}, "weights is with dynamics"),
        ({"weights": {}}, "weights is with dynamics"),
    ],
)
def test_another_evaluation_is_refused_with_the_first_setting_that_differs(
    tmp_path: Path, settings: dict[str, Any], said: str
) -> None:
    out = tmp_path / "coin.json"
    evaluate_task(Coin(), 2, out)
    before = out.read_bytes()
    other = Coin(**settings)
    with pytest.raises(FileExistsError) as caught:
        evaluate_task(other, 2, out)
    assert f"holds another evaluation (coin: {said}" in str(caught.value)
    assert other.ran == []
    assert out.read_bytes() == before
    assert evaluate_task(Coin(**settings), 2, out, overwrite=True).head == other.config


def test_a_result_of_other_code_is_refused(tmp_path: Path) -> None:
    out = tmp_path / "coin.json"
    report = evaluate_task(Coin(), 2, out)
    save(dataclasses.replace(report, code={**report.code, "packages": {"numpy": "0.1"}}), out)
    with pytest.raises(FileExistsError, match="was begun by other code"):
        evaluate_task(Coin(), 2, out)


@pytest.mark.parametrize("content", [b"", b"{}", b"[1, 2]", b'{"format": 1}', b"\xff\x00"])
def test_a_file_that_is_no_report_is_left_alone(tmp_path: Path, content: bytes) -> None:
    out = tmp_path / "notes.json"
    out.write_bytes(content)
    with pytest.raises(FileExistsError, match="holds something else"):
        evaluate_task(Coin(), 2, out)
    with pytest.raises(ValueError, match=r"notes\.json: is not an evaluation"):
        load(out)
    assert out.read_bytes() == content
    with pytest.raises(FileExistsError, match="is a directory"):
        evaluate_task(Coin(), 2, tmp_path)


def test_numbers_that_are_not_positive_are_refused() -> None:
    with pytest.raises(ValueError, match=r"^trials: must be at least 1, got 0"):
        evaluate_task(Coin(), 0)
    with pytest.raises(ValueError, match=r"^chunk: must be at least 1, or 0 .* got -1"):
        evaluate_task(Coin(), 1, chunk=-1)


def test_progress_goes_by_steps_and_tells_of_errors_and_of_a_stop(tmp_path: Path) -> None:
    seen = io.StringIO()
    terminal = Console(file=seen, force_terminal=True, width=200, force_interactive=True)
    out = tmp_path / "coin.json"
    with pytest.raises(KeyboardInterrupt):
        evaluate_task(Coin(stop_after=8), 12, out, console=terminal)
    text = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", seen.getvalue())
    assert "coin: it rolled away" in text
    assert "120" in text  # twelve trials of ten steps
    assert f"{out}: stopped; the same command goes on from there" in text.replace("\n", "")
    plain = io.StringIO()
    evaluate_task(Coin(), 12, out, console=Console(file=plain, width=200))
    # Not on a terminal: no bar; and what was done before is not told again.
    assert plain.getvalue() == ""


def test_the_size_of_chunks_does_not_change_the_result() -> None:
    task = cheap(method="none", task="easy", steps=6)
    reports = [evaluate_task(task, 5, chunk=chunk, console=QUIET) for chunk in (2, 5)]
    outcomes = [[(t.index, t.success, t.steps) for t in report.trials] for report in reports]
    assert outcomes[0] == outcomes[1]


@pytest.mark.parametrize(
    ("settings", "at_once"),
    [
        ({"method": "none"}, 25),
        ({"method": "none", "dynamics": "keypoint"}, 25),
        ({"method": "hvf", "subgoals": 0}, 25),
        ({"method": "ground-truth", "dynamics": "latent"}, 25),
        ({"method": "random"}, 25),
        # A search takes as long as an episode; so do plans that ask a network for costs.
        ({"method": "hvf"}, 1),
        ({"method": "hvf", "dynamics": "latent"}, 1),
        ({"method": "none", "dynamics": "keypoint", "cost": "temporal"}, 1),
        ({"method": "none", "dynamics": "keypoint", "cost": "latent"}, 1),
    ],
)
def test_a_stop_loses_one_episode_where_an_episode_takes_long(
    settings: dict[str, Any], at_once: int
) -> None:
    if {"keypoint", "latent"} & set(settings.values()):
        pytest.importorskip("torch")
    task = cheap(**settings)
    assert task.chunk == at_once


def test_a_search_is_saved_before_the_next_one_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, ran = tmp_path / "report.json", Task.run

    def stopped(task: Task, first: int, count: int, watchers: Sequence[Watcher] = ()) -> Outcome:
        if first == 2:
            raise KeyboardInterrupt
        return ran(task, first, count, watchers)

    monkeypatch.setattr(Task, "run", stopped)
    with pytest.raises(KeyboardInterrupt):
        evaluate_task(cheap(method="hvf", steps=2), 4, out, console=QUIET)
    assert [trial.index for trial in load(out).trials] == [0, 1]


def test_a_report_says_all_that_a_result_depends_on(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    evaluation = Evaluation.of(
        "maze", subgoals=1, steps=1, **{**CHEAP, "dynamics": "keypoint", "samples": 10}
    )
    out = tmp_path / "report.json"
    report = evaluate(evaluation, 1, out, console=QUIET)
    assert load(out).head == json.loads(json.dumps(report.head))
    assert (report.domain, report.task, report.method, report.subgoals) == (
        "maze",
        "hard",
        "hvf",
        1,
    )
    assert report.world == {
        "dynamics": "keypoint",
        "generator": "keypoint-generator",
        "cost": "pixel",
    }
    assert report.kind == "object"
    assert report.planning == dataclasses.asdict(evaluation.planning)
    weights = DOMAINS["maze"].weights
    assert {part: found["sha256"] for part, found in report.weights.items()} == {
        "dynamics": hashlib.sha256(weights["keypoint"].read_bytes()).hexdigest(),
        "generator": hashlib.sha256(weights["keypoint-generator"].read_bytes()).hexdigest(),
    }
    assert report.weights["generator"]["model"] == "keypoint-generator"
    straight = evaluate(dataclasses.replace(evaluation, method="none"), 1, console=QUIET)
    # Only what takes part is named.
    assert straight.world == {"dynamics": "keypoint", "cost": "pixel"}
    assert straight.weights.keys() == {"dynamics"}
    assert straight.subgoals == 0
    chance = evaluate(dataclasses.replace(evaluation, method="random"), 1, console=QUIET)
    assert (chance.world, chance.weights, chance.kind) == ({}, {}, "")


def test_reports_keep_their_numbers(tmp_path: Path) -> None:
    report = evaluate_task(Coin(), 6, tmp_path / "coin.json")
    assert isinstance(report, Report)
    assert report.interval == wilson_interval(3, 6)
    assert report.search_seconds == pytest.approx(0.1)
    # Weighted by steps: a trial of chunk 0 decided in 0.05 s, one of chunk 1 in 0.1 s.
    assert report.step_seconds == pytest.approx((0.05 * 6 + 0.1 * 9) / 15)


def test_a_setting_that_a_report_is_older_than_was_its_default(tmp_path: Path) -> None:
    out = tmp_path / "report.json"
    chance = Evaluation.of("maze", method="random")
    report = evaluate(chance, 1, out=out, console=QUIET)
    content = json.loads(out.read_text())
    for name in ("segment_cost", "choose_anew"):
        assert content["planning"].pop(name) == getattr(Planning(), name)
    out.write_text(json.dumps(content))
    assert load(out).head == report.head


# ---- which code ran ----------------------------------------------------------------------------

CODE = "import json; from hvf.evaluation.code import code_of; print(json.dumps(code_of()))"
PACKAGE = Path(hvf.__file__).parent


def repository(folder: Path, name: str) -> Path:
    """A repository of a project of this name, with this package inside."""
    shutil.copytree(
        PACKAGE,
        folder / "python" / "hvf",
        ignore=shutil.ignore_patterns("__pycache__", "weights", "*.so"),
    )
    for path in ("crates/lib.rs", "Cargo.toml", "Cargo.lock", "README.md"):
        (folder / path).parent.mkdir(exist_ok=True)
        (folder / path).write_text("first\n")
    (folder / "pyproject.toml").write_text(f'[project]\nname = "{name}"\n')
    git(folder, "init", "-q")
    commit(folder)
    return folder


def git(folder: Path, *words: str) -> str:
    # Settings of the user must not matter, nor a repository that hooks run in.
    env = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    identity = ["-c", "user.name=test", "-c", "user.email=test@example.org"]
    done = subprocess.run(
        ["git", *identity, *words],
        cwd=folder,
        env={**env, "GIT_CONFIG_GLOBAL": os.devnull},
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    return done.stdout.strip()


def commit(folder: Path) -> str:
    git(folder, "add", "-A")
    git(folder, "commit", "-q", "-m", "change")
    return git(folder, "rev-parse", "HEAD")


def code_in(folder: Path) -> dict[str, Any]:
    """What the copy of the package in a folder says of itself."""
    core = Path(hvf_core.__file__).parent.parent
    path = os.pathsep.join(map(str, (folder / "python", core)))
    done = processes.run(processes.python(CODE), env={"PYTHONPATH": path}, check=True)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


needs_git = pytest.mark.skipif(shutil.which("git") is None, reason="no git")


@needs_git
def test_the_commit_of_an_unrelated_repository_is_not_the_codes(tmp_path: Path) -> None:
    folder = repository(tmp_path, "somebody-elses")
    before = code_in(folder)
    assert (before["commit"], before["changes"]) == (None, None)
    (folder / "README.md").write_text("second\n")
    commit(folder)
    assert code_in(folder) == before
    (folder / "python" / "hvf" / "new.py").write_text("")
    after = code_in(folder)
    assert after["commit"] is None
    assert not same_code(before, after)


@needs_git
def test_another_build_of_the_extension_is_other_code(tmp_path: Path) -> None:
    folder = repository(tmp_path, "somebody-elses")
    core = folder / "python" / "hvf_core"
    shutil.copytree(Path(hvf_core.__file__).parent, core)
    before = code_in(folder)
    (extension,) = core.glob("hvf_core*.so")
    extension.write_bytes(extension.read_bytes() + b"\0")
    assert not same_code(before, code_in(folder))


@needs_git
def test_a_commit_that_changes_no_source_is_the_same_code(tmp_path: Path) -> None:
    folder = repository(tmp_path, "hvf")
    first = code_in(folder)
    assert (first["commit"], first["changes"]) == (git(folder, "rev-parse", "HEAD"), None)
    (folder / "README.md").write_text("second\n")
    second_commit = commit(folder)
    second = code_in(folder)
    assert second["commit"] == second_commit != first["commit"]
    assert same_code(first, second)
    # A change is other code, before and after it is committed; so is a file that git does not know.
    source = folder / "crates" / "lib.rs"
    source.write_text("second\n")
    changed = code_in(folder)
    assert changed["changes"] is not None
    assert not same_code(first, changed)
    commit(folder)
    assert not same_code(first, code_in(folder))
    (folder / "python" / "hvf" / "new.py").write_text("")
    assert code_in(folder)["changes"] is not None


# ---- what is imported --------------------------------------------------------------------------


@pytest.mark.parametrize("settings", ["method='random'", "method='none', dynamics='simulator'"])
def test_what_is_not_learned_loads_no_torch(settings: str) -> None:
    program = (
        "import sys, hvf\n"
        f"report = hvf.evaluate('maze', trials=2, steps=2, samples=10, elites=2, {settings})\n"
        "assert len(report.trials) == 2\n"
        "sys.exit('torch' in sys.modules)\n"
    )
    processes.run(processes.python(program), check=True)


# ---- pictures ----------------------------------------------------------------------------------


def test_pictures_show_the_episode(tmp_path: Path) -> None:
    task = cheap(task="easy", steps=3, over_horizon="sum")
    _, (episode,) = record(task, 5, 1)
    steps = episode.trial.steps
    trials = task.trials(5, 1)
    which = np.array([0])
    assert episode.path is not None
    assert len(episode.observations) == len(episode.path) == steps + 1
    np.testing.assert_array_equal(episode.observations[0], trials.observe(which)[0])
    np.testing.assert_array_equal(episode.path[0], trials.positions(which)[0])  # type: ignore[attr-defined]
    assert episode.target == trials.target(0)  # type: ignore[attr-defined]
    assert episode.subgoals.shape == (2, 64, 64, 3)
    save_strip(episode, tmp_path / "strip.png", "a title")
    strip = iio.imread(tmp_path / "strip.png")
    assert strip.shape[1] > 5 * 64
    assert strip[..., :3].std() > 10
    save_film(episode, tmp_path / "film.gif")
    assert len(iio.imread(tmp_path / "film.gif", index=None)) >= steps + 1
    with pytest.raises(ValueError, match=r"^path: must end in \.gif or \.mp4"):
        save_film(episode, tmp_path / "film.avi")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["film.gif", "strip.png"]


def test_pictures_of_a_domain_that_does_not_tell_where_things_are(tmp_path: Path) -> None:
    _, (episode,) = record(cheap(method="none", steps=2), 0, 1)
    blind = dataclasses.replace(episode, path=None, target=None)
    save_strip(blind, tmp_path / "strip.png")
    save_film(blind, tmp_path / "film.gif")
    assert iio.imread(tmp_path / "strip.png").shape[1] > 3 * 64


def test_subgoals_are_drawn_with_their_costs(tmp_path: Path) -> None:
    frames = np.random.default_rng(0).integers(0, 256, (4, 16, 16, 3), dtype=np.uint8)
    save_subgoals(frames[0], frames[1:3], frames[3], [0.1, 0.2, 0.3], tmp_path / "s.png", "title")
    assert iio.imread(tmp_path / "s.png").shape[1] > 4 * 200


def test_positions_are_where_the_agent_is_drawn() -> None:
    trials = cheap(method="none").trials(0, 4)
    which = np.arange(4)
    places = trials.positions(which)  # type: ignore[attr-defined]
    for image, (column, row) in zip(trials.observe(which), places, strict=True):
        middle = image[round(float(row)), round(float(column))].astype(int)
        corner = image[0, 0].astype(int)
        assert np.abs(middle - corner).max() > 40


def test_an_episode_knows_what_it_aimed_at() -> None:
    _, (episode,) = record(cheap(steps=4, steps_per_subgoal=1, threshold=0.0), 0, 1)
    assert episode.trial.switches == (1, 2)
    assert [episode.aim(step) for step in range(4)] == [0, 1, 2, 2]
    np.testing.assert_array_equal(episode.aim_image(1), episode.subgoals[1])
    np.testing.assert_array_equal(episode.aim_image(3), episode.goal)


def test_a_watched_episode_takes_its_share_of_the_bar() -> None:
    task = cheap(method="none", samples=10, elites=3, steps=7)
    with Progress(disable=True) as progress:
        number = progress.add_task("", total=21)
        outcomes = [watch(task, index, Bar(progress, number))[0] for index in (0, 1)]
        assert progress.tasks[number].completed == 14
    assert all(1 <= outcome.trials[0].steps <= 7 for outcome in outcomes)
    assert f"after {outcomes[0].trials[0].steps} steps" in how_it_went("two", outcomes[0])


def test_a_repository_that_does_not_answer_is_an_error_and_no_other_code(tmp_path: Path) -> None:
    git = tmp_path / "git"
    git.write_text("#!/bin/sh\nexec sleep 100\n")
    git.chmod(0o755)
    impatient = "from hvf.evaluation import code; code._PATIENCE = 0.2; code.code_of()"
    path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
    done = processes.run(processes.python(impatient), env={"PATH": path})
    assert done.returncode == 1
    assert "RuntimeError: git rev-parse: no answer" in done.stderr
