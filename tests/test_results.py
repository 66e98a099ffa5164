"""The table of results."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from hvf.cli import main
from hvf.evaluation import MazeEvaluation
from hvf.evaluation.run import Report, TrialRecord, save
from hvf.evaluation.task import AgentName

NO_WEIGHTS: dict[str, str] = {}


def write(
    path: Path,
    successes: int,
    trials: int,
    evaluation: MazeEvaluation,
    sha256: dict[str, str] = NO_WEIGHTS,
    search_seconds: float = 0.5,
) -> None:
    """A report of which the first trials succeed, in 10 steps each, the others in 50."""
    records = tuple(
        TrialRecord(i, i < successes, 10 if i < successes else 50, (), search_seconds, 0.002)
        for i in range(trials)
    )
    config: dict[str, Any] = {**dataclasses.asdict(evaluation), "sha256": sha256}
    save(Report(evaluation.name, config, records, 1.0, {"commit": "0123456789abcdef"}), path)


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_rows_hold_the_agents_and_columns_the_difficulties(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    of = MazeEvaluation.of
    write(tmp_path / "a.json", 93, 100, of(agent="none", difficulty="easy"), search_seconds=0)
    write(tmp_path / "b.json", 0, 50, of(agent="none", difficulty="hard"), search_seconds=0)
    write(tmp_path / "c.json", 50, 100, of("paper", subgoals=1, difficulty="hard"))
    write(tmp_path / "d.json", 1, 100, of(agent="random", difficulty="easy"), search_seconds=0)
    write(tmp_path / "e.json", 100, 100, of(agent="ground-truth", model="simulator", horizon=7))
    assert main(["results", "maze", str(tmp_path)]) == 0
    header, rule, *lines = capsys.readouterr().out.splitlines()
    assert cells(header)[3:6] == ["easy", "medium", "hard"]
    assert cells(rule)[3] == "---:"
    # Wilson intervals in closed form: (p + z^2/2n -+ z sqrt(p(1-p)/n + z^2/4n^2)) / (1 + z^2/n).
    expected = [
        ["default", "learned", "no subgoals", "93% [86, 97]", "", "0% [0, 7] (n = 50)", "", "2.0"],
        ["default, horizon 7", "simulator", "ground truth-2", "", "", "100% [96, 100]"],
        ["paper", "learned", "HVF-1", "", "", "50% [40, 60]", "0.50", "2.0"],
        ["", "", "random", "1% [0, 5]", "", "", "", "2.0"],
        ["ICLR 2020, tables", "learned (SV2P)", "no subgoals", "93%", "68%", "33%", "", ""],
        ["ICLR 2020, tables", "learned (SV2P)", "HVF-1", "", "", "47%", "", ""],
        ["ICLR 2020, tables", "learned (SV2P)", "HVF-2", "", "", "54%", "", ""],
    ]
    for line, row in zip(lines, expected, strict=False):
        assert cells(line)[: len(row)] == row
    assert lines[len(expected) :] == ["", "Code: 0123456789."]


def test_how_subgoals_are_searched_for_is_no_setting_of_an_agent_that_does_not_search(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    of = MazeEvaluation.of
    write(tmp_path / "a.json", 1, 2, of(agent="none", subgoal_samples=7, subgoal_elites=3))
    write(tmp_path / "b.json", 1, 2, of(agent="hvf", subgoal_samples=7, subgoal_elites=3))
    assert main(["results", "maze", str(tmp_path)]) == 0
    rows = [cells(line)[0] for line in capsys.readouterr().out.splitlines()[2:4]]
    assert rows == ["default", "default, subgoal_samples 7, subgoal_elites 3"]


def test_says_when_weights_differ(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for difficulty in ("easy", "hard"):
        evaluation = MazeEvaluation.of(difficulty=difficulty)
        write(tmp_path / f"{difficulty}.json", 1, 2, evaluation, {"dynamics": difficulty})
    assert main(["results", "maze", str(tmp_path)]) == 0
    assert "Not all rows are of the same weights: dynamics differ." in capsys.readouterr().out


@pytest.mark.parametrize(("agent", "matters"), [("none", False), ("hvf", True)])
def test_what_draws_subgoals_matters_only_to_an_agent_that_searches(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], agent: AgentName, matters: bool
) -> None:
    for difficulty in ("easy", "hard"):
        evaluation = MazeEvaluation.of(difficulty=difficulty, agent=agent)
        write(tmp_path / f"{difficulty}.json", 1, 2, evaluation, {"keypoint_generator": difficulty})
    assert main(["results", "maze", str(tmp_path)]) == 0
    assert ("keypoint_generator differ" in capsys.readouterr().out) == matters


def test_refuses_two_results_for_one_cell(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / "a.json", 1, 2, MazeEvaluation.of())
    write(tmp_path / "b.json", 1, 2, MazeEvaluation.of())
    assert main(["results", "maze", str(tmp_path)]) == 0
    write(tmp_path / "b.json", 2, 2, MazeEvaluation.of())
    assert main(["results", "maze", str(tmp_path)]) == 2
    assert "b.json" in capsys.readouterr().err


@pytest.mark.parametrize("content", [None, "", "{}", '{"format": 1}'])
def test_refuses_what_is_not_an_evaluation(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str | None
) -> None:
    if content is not None:
        (tmp_path / "x.json").write_text(content)
    assert main(["results", "maze", str(tmp_path)]) == 2
    assert ("folder" if content is None else "x.json") in capsys.readouterr().err


def test_refuses_an_evaluation_of_something_else(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trial = TrialRecord(0, True, 1, (), 0.0, 0.0)
    save(Report("desk", {"agent": "none"}, (trial,), 1.0, {}), tmp_path / "desk.json")
    assert main(["results", "maze", str(tmp_path)]) == 2
    assert "desk.json" in capsys.readouterr().err


def test_refuses_a_missing_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["results", "maze", str(tmp_path / "none")]) == 2
    assert "folder" in capsys.readouterr().err
