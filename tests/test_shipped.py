"""What ships is good for something: floors of success, on validation episodes."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.console import Console

from hvf.evaluation import Evaluation, evaluate
from hvf.models.checkpoint import load_any
from hvf.registry import DOMAINS

QUIET = Console(file=io.StringIO())


@pytest.mark.parametrize("domain", ["maze", "desk"])
def test_every_checkpoint_that_ships_is_the_model_that_its_name_says(domain: str) -> None:
    for name, path in DOMAINS[domain].weights.items():
        assert load_any(path).name == name
        assert path.stat().st_size < 15e6


def test_hard_mazes_are_mostly_done_without_subgoals() -> None:
    evaluation = Evaluation.of("maze", method="none", task="hard")
    report = evaluate(evaluation, 20, console=QUIET)
    # 80% of 100 test episodes; 20 trials of that go below 10 once in 2,000 times.
    assert report.successes >= 10
    assert report.kind == "object"


@pytest.mark.slow
def test_a_small_search_does_nearly_all_hard_mazes() -> None:
    few = {"subgoal_samples": 40, "subgoal_elites": 8, "subgoal_iterations": 3, "samples": 100}
    evaluation = Evaluation.of("maze", task="hard", subgoals=2, elites=20, **few)
    assert evaluate(evaluation, 12, console=QUIET).successes >= 8


@pytest.mark.slow
def test_the_door_is_mostly_closed(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    evaluation = Evaluation.of("desk", method="none", task="door")
    report = evaluate(evaluation, 6, tmp_path / "door.json", console=QUIET)
    # 97% of 100 test episodes.
    assert report.successes >= 4
