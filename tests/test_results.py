"""The tables of results, and that documents quote them as they are printed."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

import processes
from hvf.cli import main
from hvf.evaluation.evaluation import Evaluation
from hvf.evaluation.report import Report, TrialRecord, save
from hvf.experiments.quoted import Quote, block, printed, quotes, refreshed
from hvf.experiments.tables import compared
from hvf.registry import METHODS

ROOT = Path(__file__).parent.parent
NO_WEIGHTS: dict[str, dict[str, str]] = {}


def report(
    outcomes: list[bool],
    weights: dict[str, dict[str, str]] = NO_WEIGHTS,
    search_seconds: float = 0.5,
    commit: str = "0123456789abcdef",
    changes: str | None = None,
    **settings: Any,
) -> Report:
    """What an evaluation in the maze found; it took 10 steps to the goal, and else 50."""
    preset = settings.pop("preset", "default")
    evaluation = Evaluation.of(
        "maze", preset, **{"split": "test", "seed": None, "task": "hard", **settings}
    )
    method = METHODS[evaluation.method]
    world = evaluation.place.resolved(evaluation.world)
    names = {"dynamics": world.dynamics, "cost": world.cost} if method.needs_dynamics else {}
    if method.needs_generator:
        names["generator"] = world.generator
    kind = "simulator" if world.dynamics == "simulator" else "object"
    return Report(
        name=evaluation.name,
        domain="maze",
        task=evaluation.task,
        method=evaluation.method,
        subgoals=evaluation.subgoals if method.has_subgoals else 0,
        preset=preset,
        split=evaluation.split if evaluation.seed is None else None,
        seed=evaluation.episode_seed,
        world=names,
        kind=kind if method.needs_dynamics else "",
        planning=dataclasses.asdict(evaluation.planning),
        weights=weights,
        trials=tuple(
            TrialRecord(i, success, 10 if success else 50, (), search_seconds, 0.002)
            for i, success in enumerate(outcomes)
        ),
        wall_seconds=1.0,
        code={"version": "0.1.0", "commit": commit, "changes": changes},
    )


def write(path: Path, successes: int, trials: int, **settings: Any) -> None:
    """A report of which the first trials succeed."""
    save(report([i < successes for i in range(trials)], **settings), path)


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def rows(output: str) -> list[list[str]]:
    """Rows of the first table, without its header."""
    table = output.split("\n\n")[0].splitlines()
    return [cells(line) for line in table[2:]]


def differences(output: str) -> list[list[str]]:
    """Rows of the second table, without its header."""
    parts = [part for part in output.split("\n\n") if part.startswith("|")]
    return [cells(line) for line in parts[1].splitlines()[2:]] if len(parts) > 1 else []


def test_rows_hold_the_methods_and_columns_the_tasks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / "a.json", 93, 100, method="none", task="easy", search_seconds=0)
    write(tmp_path / "b.json", 0, 50, method="none", search_seconds=0)
    write(tmp_path / "c.json", 50, 100, preset="paper", subgoals=1)
    write(tmp_path / "d.json", 1, 100, method="random", task="easy", search_seconds=0)
    write(tmp_path / "e.json", 100, 100, method="ground-truth", dynamics="simulator", horizon=7)
    assert main(["results", "maze", str(tmp_path)]) == 0
    output = capsys.readouterr().out
    header, rule = output.splitlines()[:2]
    # Times are of whatever else the machine did: the JSON has them, no table.
    assert cells(header) == ["settings", "world", "kind", "method", "easy", "medium", "hard"]
    assert cells(rule) == ["---"] * 4 + ["---:"] * 3
    # Wilson intervals in closed form: (p + z^2/2n -+ z sqrt(p(1-p)/n + z^2/4n^2)) / (1 + z^2/n).
    none = ["no subgoals", "93% [86, 97]", "", "0% [0, 7] (n = 50)"]
    expected = [
        ["default", "keypoint", "object", *none],
        [
            "default, horizon 7",
            "simulator",
            "simulator",
            "ground truth-2",
            "",
            "",
            "100% [96, 100]",
        ],
        ["paper", "keypoint (cvae)", "object", "HVF-1", "", "", "50% [40, 60]"],
        ["", "", "", "random", "1% [0, 5]", "", ""],
        ["ICLR 2020, tables", "SV2P", "video", "no subgoals", "93%", "68%", "33%"],
        ["ICLR 2020, tables", "SV2P", "video", "HVF-1", "", "", "47%"],
        ["ICLR 2020, tables", "SV2P", "video", "HVF-2", "", "", "54%"],
    ]
    found = rows(output)
    assert len(found) == len(expected)
    for line, row in zip(found, expected, strict=True):
        assert line == row
    assert "split test, seed 1000000007" in output
    assert "Code: 0123456789." in output


def test_subgoals_are_paired_with_none_of_the_same_settings_on_common_episodes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    none = [i % 4 == 0 for i in range(100)]
    # On the first 40 episodes, of which none did 10: 5 of those, and 9 more.
    hvf = [(none[i] and i < 20) or (i % 4 == 1 and i < 36) for i in range(40)]
    save(report(none, method="none"), tmp_path / "none.json")
    save(report([not one for one in none], method="none", horizon=9), tmp_path / "other.json")
    save(report(hvf, subgoals=1, subgoal_samples=50), tmp_path / "hvf.json")
    save(report([True] * 100, method="ground-truth", threshold=0.1), tmp_path / "true.json")
    save(report([True] * 100, method="random"), tmp_path / "random.json")
    assert main(["results", "maze", str(tmp_path)]) == 0
    found = {row[3]: row for row in differences(capsys.readouterr().out)}
    assert found.keys() == {"HVF-1", "ground truth-2"}
    # Of 14 episodes that just one did, 9 to 5 or more uneven: 0.42 by the binomial's table.
    assert found["HVF-1"][0] == "default, subgoal_samples 50"
    assert found["HVF-1"][6].startswith("+10 [")
    assert found["HVF-1"][6].endswith("], p = 0.42 (n = 40)")
    assert found["ground truth-2"][6].startswith("+75 [")
    assert found["ground truth-2"][6].endswith("], p < 0.001")


def test_what_draws_subgoals_is_no_setting_of_the_method_that_has_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(
        tmp_path / "a.json",
        1,
        2,
        method="none",
        generator="cvae",
        subgoal_samples=70,
        segment_cost="likelihood",
    )
    write(tmp_path / "b.json", 1, 2, method="none", steps_per_subgoal=7, threshold=0.0)
    write(tmp_path / "c.json", 2, 2, generator="cvae", steps_per_subgoal=7)
    write(tmp_path / "d.json", 2, 2, method="ground-truth", subgoal_samples=70)
    assert main(["results", "maze", str(tmp_path)]) == 0
    output = capsys.readouterr().out
    assert [row[:2] for row in rows(output) if row[2] == "object"] == [
        ["default", "keypoint"],
        ["default", "keypoint"],
        ["default, steps_per_subgoal 7", "keypoint (cvae)"],
    ]
    assert [row[6].split(" [")[0] for row in differences(output)] == ["+50", "+50"]


def test_another_cost_is_another_row(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path / "a.json", 1, 2, method="none")
    write(tmp_path / "b.json", 2, 2, method="none", cost="temporal")
    write(tmp_path / "c.json", 2, 2, method="ground-truth", cost="temporal")
    assert main(["results", "maze", str(tmp_path)]) == 0
    output = capsys.readouterr().out
    assert [row[0] for row in rows(output)[:3]] == ["default", *["default, cost temporal"] * 2]
    assert [row[:1] + row[6].split(" [")[:1] for row in differences(output)] == [
        ["default, cost temporal", "0"]
    ]


@pytest.mark.parametrize("other", [{"split": "validation"}, {"seed": 3}])
def test_refuses_to_compare_different_episodes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], other: dict[str, Any]
) -> None:
    write(tmp_path / "a.json", 1, 2, method="none", **other)
    write(tmp_path / "b.json", 2, 2)
    assert main(["results", "maze", str(tmp_path)]) == 2
    message = " ".join(capsys.readouterr().err.split())
    assert "different episodes" in message
    assert "a.json" in message
    assert "b.json" in message
    with pytest.raises(ValueError, match="same episodes"):
        compared(report([True]), report([True], method="none", **other))
    # One split at a time is a table.
    assert main(["results", "maze", str(tmp_path), "--split", "test"]) == 0
    assert rows(capsys.readouterr().out)[0][3] == "HVF-2"
    assert main(["results", "maze", str(tmp_path), "--split", "train"]) == 2


def test_says_when_weights_or_code_differ(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for task, commit, changes in (("easy", "a" * 40, None), ("hard", "b" * 40, "12345")):
        weights = {"dynamics": {"model": "keypoint", "sha256": task}}
        file = tmp_path / f"{task}.json"
        write(file, 1, 2, task=task, weights=weights, commit=commit, changes=changes)
    assert main(["results", "maze", str(tmp_path)]) == 0
    output = capsys.readouterr().out
    assert "Not all rows are of the same weights: keypoint differ." in output
    assert "Code: aaaaaaaaaa, bbbbbbbbbb with changes." in output


def test_two_reports_of_one_cell_must_agree_on_the_episodes_that_both_have(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / "a.json", 1, 2)
    write(tmp_path / "b.json", 1, 7)
    assert main(["results", "maze", str(tmp_path)]) == 0
    assert "(n = 7)" in rows(capsys.readouterr().out)[0][6]
    write(tmp_path / "b.json", 2, 7)
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


def test_refuses_an_evaluation_in_another_domain(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / "maze.json", 1, 2)
    assert main(["results", "desk", str(tmp_path)]) == 2
    assert "maze.json" in capsys.readouterr().err


def test_refuses_a_missing_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["results", "maze", str(tmp_path / "none")]) == 2
    assert "folder" in capsys.readouterr().err


@pytest.mark.parametrize("domain", ["maze", "desk"])
def test_committed_results_make_a_table_without_torch_or_a_simulator(domain: str) -> None:
    program = (
        "import sys\n"
        "from hvf.cli import main\n"
        f"status = main(['results', {domain!r}, {str(ROOT / 'results' / domain)!r}])\n"
        "assert not {'torch', 'mujoco'} & sys.modules.keys()\n"
        "sys.exit(status)\n"
    )
    run = processes.run(processes.python(program))
    assert run.returncode == 0, run.stderr
    assert "no subgoals" in run.stdout


DOCUMENTS = {
    name: quotes((ROOT / name).read_text()) if (ROOT / name).exists() else []
    for name in ("README.md", "docs/results.md")
}
QUOTED = [(name, quote) for name, found in DOCUMENTS.items() for quote in found]


@pytest.mark.parametrize(
    ("document", "quote"),
    QUOTED,
    ids=[f"{name}: hvf {' '.join(quote.command)}" for name, quote in QUOTED],
)
def test_documents_quote_what_the_command_prints(
    document: str, quote: Quote, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    assert quote.text == block(printed(quote.command)), (
        f"{document}: `python -m hvf.experiments.quoted {document}` prints it anew"
    )


def test_quotes_are_found_and_printed_anew() -> None:
    document = (
        "Text\n<!-- table: hvf results maze 'my folder' -->\n| old |\n<!-- end -->\nMore\n"
        "<!-- table: hvf paper maze -->\n<!-- end -->\n"
    )
    assert quotes(document) == [
        Quote(("results", "maze", "my folder"), "| old |\n"),
        Quote(("paper", "maze"), ""),
    ]
    fresh = refreshed(document, lambda command: f"\n{command[-1]} \\1\n\n")
    assert [quote.text for quote in quotes(fresh)] == ["my folder \\1\n", "maze \\1\n"]
    assert fresh.startswith("Text\n")
    assert "\nMore\n" in fresh
    assert refreshed(fresh, lambda command: f"\n{command[-1]} \\1\n\n") == fresh
