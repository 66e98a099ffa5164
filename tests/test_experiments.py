"""The paper's tables as lists of evaluations, and running them side by side."""

from __future__ import annotations

import dataclasses
import hashlib
import re
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import processes
from hvf.cli import main
from hvf.evaluation.evaluation import Evaluation
from hvf.evaluation.report import Report, load, save
from hvf.evaluation.run import evaluate
from hvf.experiments.cells import Cell, PaperTable, Setup
from hvf.experiments.notes import outdated, planned_with
from hvf.experiments.paper import (
    files,
    markdown,
    paper,
    tables,
    verdict,
)
from hvf.experiments.parallel import finished, report_of, run_all
from hvf.experiments.planners import VARIANTS
from hvf.registry import DOMAINS
from hvf_core import HVF, VisualMPC
from made_reports import made

PAPER = Setup("maze")


def settings(evaluation: Evaluation | None) -> dict[str, object]:
    """Of planning, and what draws subgoals."""
    assert evaluation is not None
    world = evaluation.place.resolved(evaluation.world)
    return {**vars(evaluation.planning), "generator": world.generator, "cost": world.cost}


def differences(one: Evaluation | None, other: Evaluation) -> dict[str, object]:
    """Settings of the first that the other does not have."""
    return {k: v for k, v in settings(one).items() if v != settings(other)[k]}


def test_every_maze_table_of_the_paper_is_there() -> None:
    found = {table.name: table for table in tables(PAPER)}
    assert set(found) == {"methods", "subgoals", "reduction", "samples", "horizon", "cost"}
    # Numbers as in the paper's tables, read column by column.
    published = {
        name: [[cell.published for cell in row] for row in table.rows.values()]
        for name, table in found.items()
    }
    assert published["subgoals"] == [[0.33], [0.47], [0.54], [0.39], [0.02], [0.0]]
    assert published["reduction"] == [[0.47, 0.54], [0.45, 0.53]]
    assert published["samples"] == [[0.33, 0.47, 0.54], [0.35, 0.54, 0.55]]
    assert published["horizon"] == [[0.33, 0.47, 0.54], [0.46, 0.55, 0.37], [0.31, 0.39, 0.24]]
    assert published["cost"] == [[0.93, 0.68, 0.33], [0.62, 0.49, 0.23]]
    assert published["methods"][0] == [0.93, 0.68, 0.33]
    assert [row[2] for row in published["methods"][1:3]] == [0.47, 0.54]


def test_the_desk_has_every_task_and_the_numbers_of_the_papers_text() -> None:
    (table,) = tables(Setup("desk"))
    assert table.columns == ("door", "two_block", "door_block", "door_two_block")
    published = {name: [cell.published for cell in row] for name, row in table.rows.items()}
    assert published.pop("no subgoals") == [None, None, None, 0.15]
    assert published.pop("HVF-1") == [None, None, None, 0.15]
    assert published.pop("HVF-2") == [None, None, None, 0.42]
    assert all(row == [None] * 4 for row in published.values())


def test_methods_become_rows_when_the_models_that_they_ask_are_given() -> None:
    given = Setup("maze", models=(("tap", "runs/tap/model.safetensors"),))
    (before,), (after,) = (tables(setup, ["methods"]) for setup in (PAPER, given))
    assert after.rows.keys() - before.rows.keys() == {"TAP-1", "TAP-2"}
    cells = {name: row for name, row in after.rows.items() if name in before.rows}
    assert cells == before.rows
    for count, row in ((1, after.rows["TAP-1"]), (2, after.rows["TAP-2"])):
        for cell in row:
            assert cell.evaluation is not None
            assert cell.evaluation.subgoals == count
            assert cell.evaluation.world.method_model == "runs/tap/model.safetensors"
    assert given.options.endswith("--models tap runs/tap/model.safetensors")
    with pytest.raises(
        ValueError,
        match=r"models: methods and costs ask cvae, layers-proposals, rig, tap, tdm; got 'sv2p'",
    ):
        Setup("maze", models=(("sv2p", "runs/sv2p/model.safetensors"),))


def test_costs_become_rows_when_the_models_that_they_ask_are_given() -> None:
    given = Setup("maze", models=(("tdm", "runs/tdm/model.safetensors"),))
    (before,), (after,) = (tables(setup, ["cost"]) for setup in (PAPER, given))
    assert list(after.rows) == [*before.rows, "tdm"]
    assert {name: after.rows[name] for name in before.rows} == before.rows
    for task, cell in zip(after.columns, after.rows["tdm"], strict=True):
        assert cell.evaluation is not None
        assert (cell.evaluation.method, cell.evaluation.task) == ("none", task)
        assert cell.evaluation.world.cost == "tdm"
        assert cell.evaluation.world.cost_model == "runs/tdm/model.safetensors"
        assert cell.published is None


def test_choices_at_the_desk_differ_in_what_counts_only() -> None:
    (table,) = tables(Setup("desk", "default", split="validation"), ["choices"])
    for column, task in enumerate(("two_block", "door_block", "door_two_block")):
        cells = [row[column].evaluation for row in table.rows.values()]
        assert len(set(cells)) == len(cells) == 7
        default = Evaluation.of("desk", task=task, subgoals=2 if task == "door_two_block" else 1)
        assert default in cells
        for cell in cells:
            assert differences(cell, default).keys() <= {"scene_weight", "reduction"}


def test_the_sweep_at_the_desk_changes_one_setting_of_acting_at_a_time() -> None:
    (table,) = tables(Setup("desk", "default", split="validation"), ["sweep"])
    without = Evaluation.of("desk", task="two_block", method="none", subgoals=0)
    defaults = table.rows["default"]
    assert defaults[0].evaluation == without
    seen = set()
    for name, row in table.rows.items():
        if name == "default":
            continue
        for cell, default in zip(row, defaults, strict=True):
            if cell.evaluation is None:
                continue
            assert cell.baseline == default.evaluation
            changed = differences(cell.evaluation, default.evaluation)
            # An aim that is chosen anew is, at another time.
            assert len(changed.keys() - {"choose_anew"}) == 1 or changed.keys() == {
                "samples",
                "elites",
            }
            seen.add((cell.evaluation.method, *changed.items()))
    assert len(seen) == sum(
        cell.evaluation is not None for name, row in table.rows.items() if name != "default"
        for cell in row
    )  # fmt: skip


@pytest.mark.parametrize(
    ("name", "rows", "differ"),
    [
        ("objectives", 6, {"segment_cost", "reduction"}),
        ("acting", 4, {"cost"}),
    ],
)
def test_what_search_and_acting_go_by_is_all_that_differs(
    name: str, rows: int, differ: set[str]
) -> None:
    (table,) = tables(Setup("desk", "default", split="validation"), [name])
    for column, (task, count) in enumerate(
        (("two_block", 1), ("door_block", 1), ("door_two_block", 2))
    ):
        cells = [row[column].evaluation for row in table.rows.values()]
        assert len(set(cells)) == len(cells) == rows
        default = Evaluation.of("desk", task=task, subgoals=count)
        found: set[str] = set()
        for cell in cells:
            assert cell is not None
            assert (cell.task, cell.subgoals) == (task, 0 if cell.method == "none" else count)
            found |= differences(cell, default).keys()
        assert found == differ


def test_the_maze_is_searched_and_acted_by_steps_of_play_alone_and_together() -> None:
    (table,) = tables(Setup("maze", "default", split="validation"), ["objectives"])
    assert table.columns == ("no subgoals", "1 subgoal", "2 subgoals", "3 subgoals")
    changed = [
        [
            None
            if cell.evaluation is None
            else differences(cell.evaluation, Evaluation.of("maze", task="hard"))
            for cell in row
        ]
        for row in table.rows.values()
    ]
    search, act = {"segment_cost": "distance"}, {"cost": "temporal"}
    assert changed == [
        [{}] * 4, [None, *[search] * 3], [act, None, None, None], [None, *[{**search, **act}] * 3],
    ]  # fmt: skip
    for row in table.rows.values():
        for count, cell in enumerate(row):
            assert cell.evaluation is None or cell.evaluation.subgoals == count


def test_rows_of_proposals_differ_in_where_and_how_long_the_search_is() -> None:
    (table,) = tables(Setup("desk", "default", split="validation"), ["proposals"])
    budget = {"subgoal_samples", "subgoal_elites", "subgoal_iterations"}
    for column, (task, count) in enumerate(
        (("two_block", 1), ("door_block", 1), ("door_two_block", 2))
    ):
        cells = [row[column].evaluation for row in table.rows.values()]
        assert len(set(cells)) == len(cells) == 5
        default = Evaluation.of("desk", task=task, subgoals=count)
        assert default in cells
        for cell in cells:
            assert cell is not None
            assert (cell.task, cell.subgoals) == (task, count)
            assert differences(cell, default).keys() <= budget


def test_rows_of_video_models_differ_in_method_and_budget_only() -> None:
    (table,) = tables(Setup("desk", split="validation"), ["video"])
    for column, (task, count) in enumerate((("door_block", 1), ("door_two_block", 2))):
        preset = Evaluation.of("desk", "video", task=task, subgoals=count)
        cells = [row[column].evaluation for row in table.rows.values()]
        assert len(set(cells)) == len(cells) == 5
        assert preset in cells
        for cell in cells:
            assert cell is not None
            assert cell.task == task
            assert cell.world_names["dynamics"] == "latent"
            assert differences(cell, preset).keys() <= {"samples", "elites", "iterations"}


@pytest.mark.parametrize("preset", ["paper", "released", "default"])
def test_cells_of_several_tables_are_evaluated_once(preset: str) -> None:
    setup = Setup("maze", preset)
    chosen = tables(setup)
    where = files(chosen, Path("out"))
    cells = [cell.evaluation for table in chosen for row in table.rows.values() for cell in row]
    assert len(cells) > len(where)
    # 3 difficulties of 6 methods or more; 3 numbers of subgoals, 2 means, 3 samples, 6 horizons
    # and 3 latent costs that these do not have.
    new = 3 + 2 + 3 + 6 + 3
    assert len(where) == len(chosen[0].evaluations) + new
    assert len(set(where.values())) == len(where)
    assert all(evaluation.split == "test" for evaluation in where)
    assert all(evaluation.preset == preset for evaluation in where)


def test_a_cell_differs_from_its_preset_in_what_its_table_says_only() -> None:
    found = {table.name: table for table in tables(PAPER)}
    base = Evaluation.of("maze", "paper", subgoals=2, split="test")
    cells = {
        ("samples", "1000"): {"samples": 1000},
        ("horizon", "15"): {"horizon": 15},
        ("reduction", "mean"): {"reduction": "mean"},
    }
    for (name, row), changed in cells.items():
        cell = found[name].rows[row][-1]
        expected = Evaluation.of("maze", "paper", subgoals=2, split="test", **changed)
        assert cell.evaluation == expected
        assert cell.evaluation != base
    assert found["subgoals"].rows["2"][0].evaluation == base
    latent = found["cost"].rows["latent"][0].evaluation
    assert latent == Evaluation.of(
        "maze", "paper", method="none", subgoals=0, task="easy", split="test", cost="latent"
    )


def test_the_ablation_goes_from_our_settings_to_the_papers_one_at_a_time() -> None:
    assert "ablation" not in {table.name for table in tables(PAPER)}
    (table,) = tables(Setup("maze", split="validation"), ["ablation"])
    ours = Evaluation.of("maze", "default", subgoals=2)
    published = Evaluation.of("maze", "paper", subgoals=2)
    searched = {name: cells[1].evaluation for name, cells in table.rows.items()}
    assert (searched.pop("default"), searched.pop("paper")) == (ours, published)

    one_by_one = {"default": {}, "paper": {}}
    for name, evaluation in searched.items():
        start = name.split(",")[0].split(" ")[0]
        one_by_one[start] |= differences(evaluation, {"default": ours, "paper": published}[start])
    # Together they are all that there is between the two.
    assert one_by_one["default"] == differences(published, ours)
    assert one_by_one["paper"] == differences(ours, published)
    # What only a search of subgoals has is not run without one.
    assert [cells[0].evaluation is None for cells in table.rows.values()].count(True) == 4
    files([table, *tables(PAPER)], Path())


def test_variants_of_the_search_have_one_budget_and_differ_by_what_their_row_says() -> None:
    assert "planners" not in {table.name for table in tables(PAPER)}
    (table,) = tables(Setup("maze", "default", split="validation"), ["planners"])
    plain = [cell.evaluation for cell in table.rows["plain CEM"]]
    assert [cell.baseline for cell in table.rows["plain CEM"]] == [None, None]
    for name, cells in table.rows.items():
        for cell, base in zip(cells, plain, strict=True):
            if cell.evaluation is None:
                # Without subgoals it does not matter how they are searched for.
                assert all(option.startswith("subgoal_") for option in VARIANTS[name])
                continue
            assert base is not None
            drawn = [sum(_samples(one.planning.mpc)) for one in (cell.evaluation, base)]
            assert abs(drawn[0] - drawn[1]) <= 0.01 * drawn[1]
            searched = [sum(_samples(one.planning.search(2))) for one in (cell.evaluation, base)]
            assert searched[0] == searched[1]
            changed = differences(cell.evaluation, base)
            assert changed.items() <= VARIANTS[name].items()
            assert cell.baseline in (None, base)
    files([table, *tables(PAPER)], Path())


def _samples(search: VisualMPC | HVF) -> list[int]:
    least = min(search.samples, 2 * search.elites)
    decayed = (search.samples / search.samples_decay**i for i in range(search.iterations))
    return [max(int(samples), least) for samples in decayed]


def test_rows_that_are_compared_with_each_other_say_by_how_much_they_differ() -> None:
    (table,) = tables(Setup("maze", "default", split="validation"), ["planners"])
    cells = [table.rows[name][0] for name in ("plain CEM", "coloured noise")]
    reports = {
        cell.evaluation: made(cell.evaluation, range(successes), 100)
        for cell, successes in zip(cells, (40, 60), strict=True)
        if cell.evaluation is not None
    }
    text = markdown([table], reports, "maze")
    (row,) = [line for line in text.splitlines() if line.startswith("| coloured noise |")]
    # All of the plain one's successes are among the other's: 20 of 100 differ.
    assert "60% [50, 69]; +20 [" in row
    assert "p < 0.001" in row
    assert "same episodes" in text
    assert "the paper's number" not in text
    assert "\nPoints are more than *plain CEM*.\n" in text


@pytest.mark.parametrize(
    ("domain", "name"), [("desk", "objectives"), ("desk", "acting"), ("maze", "objectives")]
)
def test_a_table_names_the_row_that_each_of_its_differences_is_to(domain: str, name: str) -> None:
    (table,) = tables(Setup(domain, "default", split="validation"), [name])
    (line,) = [
        one for one in markdown([table], {}, "").splitlines() if one.startswith("Points are")
    ]
    others: dict[str, str] = {}
    for words in line.removeprefix("Points are").split(";"):
        named = re.findall(r"\*(.+?)\*", words)
        others |= dict.fromkeys(named[:1] if len(named) == 2 else table.rows, named[-1])
    for row, cells in table.rows.items():
        for place, cell in enumerate(cells):
            if cell.baseline is not None:
                other = others[row]
                assert table.rows[other][place].evaluation == cell.baseline


def test_evaluations_that_would_share_a_file_are_refused() -> None:
    same = [
        Evaluation.of("maze", "paper", method="none", subgoals=0, generator=generator)
        for generator in ("cvae", "keypoint-generator")
    ]
    rows = {"a": tuple(map(Cell, same))}
    with pytest.raises(ValueError, match="file of 2 evaluations"):
        files([PaperTable("x", "X", "x", ("one", "two"), rows)], Path())


def test_the_world_can_be_another() -> None:
    chosen = tables(Setup("maze", "default", "simulator", "oracle", "validation"))
    for evaluation in files(chosen, Path()):
        assert evaluation.world.dynamics == "simulator"
        assert evaluation.world.generator == "oracle"
        assert evaluation.split == "validation"
    # A simulator has no latents.
    cost = next(table for table in chosen if table.name == "cost")
    assert [cell.evaluation for cell in cost.rows["latent"]] == [None] * 3


def test_tables_are_chosen_by_name() -> None:
    assert [table.name for table in tables(PAPER, ["horizon", "subgoals"])] == [
        "subgoals",
        "horizon",
    ]
    with pytest.raises(ValueError, match=r"only: must be of methods, .*; got 'table2'"):
        tables(PAPER, ["subgoals", "table2"])
    with pytest.raises(ValueError, match=r"domain: .* maze, .*; got 'moon'"):
        tables(Setup("moon"))
    with pytest.raises(ValueError, match="domain: video has no tables of experiments"):
        tables(Setup("video"))
    with pytest.raises(ValueError, match="preset"):
        tables(Setup("maze", "moon"))


def test_a_row_must_fill_its_columns() -> None:
    with pytest.raises(ValueError, match="rows: a must have 2 cells"):
        PaperTable("x", "X", "x", ("one", "two"), {"a": (Cell(None),)})


def test_verdicts_follow_the_interval_of_the_difference() -> None:
    # 33 of 100 in the paper: Newcombe's interval leaves 0 out from 47 up and from 20 down.
    words = [verdict(successes, 100, 0.33) for successes in range(101)]
    assert words == ["lower"] * 21 + ["agrees"] * 26 + ["higher"] * 54
    # Few trials show little; none in the paper and none here is the same.
    assert verdict(2, 4, 0.33) == "agrees"
    assert verdict(0, 100, 0.0) == "agrees"
    with pytest.raises(ValueError, match="successes"):
        verdict(0, 0, 0.5)


def test_tables_show_ours_beside_the_papers_and_leave_blank_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    where = files(tables(PAPER, ["subgoals", "cost"]), tmp_path)
    for evaluation, file in where.items():
        if evaluation.method == "none" and evaluation.world.cost == "pixel":
            save(made(evaluation, range(60), 100), file)
        elif evaluation.subgoals == 3:
            save(made(evaluation, range(4), 10), file)
    words = ["paper", "maze", "--only", "subgoals", "cost", "--out", str(tmp_path), "--no-run"]
    assert main(words) == 0
    output = capsys.readouterr().out
    lines = output.splitlines()
    assert "| 0 | 60% [50, 69] (paper 33%: higher) |" in lines
    assert "| 1 | (paper 47%) |" in lines
    assert "| 3 | 40% [17, 69] (n = 10) (paper 39%: agrees) |" in lines
    pixel = "| pixel | 60% [50, 69] (paper 93%: lower) | 60% [50, 69] (paper 68%: agrees) |"
    assert any(line.startswith(pixel) for line in lines)
    assert "| latent | (paper 62%) | (paper 49%) | (paper 23%) |" in lines
    assert f"`hvf paper maze --preset paper --out {tmp_path} --only subgoals`" in lines
    assert "Code: c0ffee." in lines
    assert len(list(tmp_path.iterdir())) == 4


def test_a_table_says_which_models_its_rows_are_of_and_of_what_kind() -> None:
    given = dataclasses.replace(PAPER, models=(("rig", "runs/rig/model.safetensors"),))
    chosen = {table.name: table for table in tables(given, ["methods", "samples", "cost"])}
    cell = chosen["methods"].rows
    there = {"no subgoals": "object", "HVF-1": "object", "RIG": "video", "random": ""}
    reports: dict[Evaluation, Report] = {}
    for name, kind in there.items():
        evaluation = cell[name][0].evaluation
        assert evaluation is not None
        reports[evaluation] = made(evaluation, range(1), 2, kind)
    latent = chosen["cost"].rows["latent"][0].evaluation
    assert latent is not None
    weights = {"dynamics": {"model": "keypoint", "sha256": ""}}
    weights["cost"] = {"model": "cvae", "sha256": ""}
    reports[latent] = dataclasses.replace(made(latent, range(1), 2), weights=weights)
    under = {
        name: [
            line
            for line in markdown([table], reports, "").splitlines()
            if line.startswith("Models:")
        ]
        for name, table in chosen.items()
    }
    assert under == {
        # Of a checkpoint that a report has no weights of, its file is known.
        "methods": ["Models: keypoint and cvae (object); runs/rig/model.safetensors (video)."],
        "samples": [],
        "cost": ["Models: keypoint and cvae (object)."],
    }


def test_rows_of_both_kinds_and_true_dynamics_are_told_apart() -> None:
    def report(dynamics: str, kind: str, method: str = "hvf") -> Report:
        evaluation = Evaluation.of("maze", method=method, dynamics=dynamics)
        return made(evaluation, range(1), 2, kind)

    reports = [
        report("latent", "video", "none"),
        report("simulator", "simulator"),
        report("latent", "video"),
        report("keypoint", "object", "none"),
    ]
    assert planned_with(reports) == (
        "Models: simulator and oracle (simulator); latent and cvae (video); keypoint (object)."
    )
    assert planned_with([made(RANDOM[0], range(1), 2, "")]) == ""


def shipped(evaluation: Evaluation, **files: str) -> Report:
    """A report with the weights that files hold now, by part, or with others where it is empty."""
    domain = evaluation.place
    weights = {
        part: {
            "model": name,
            "sha256": hashlib.sha256(domain.weights[name].read_bytes()).hexdigest(),
        }
        for part, name in files.items()
    }
    return dataclasses.replace(made(evaluation, range(1), 100), weights=weights)


def of_others(report: Report, part: str) -> Report:
    """The same, with other weights of a part."""
    weights = {**report.weights, part: {**report.weights[part], "sha256": "0" * 64}}
    return dataclasses.replace(report, weights=weights)


def test_cells_of_other_weights_than_ship_now_are_named_and_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (table,) = tables(PAPER, ["cost"])
    (methods,) = tables(PAPER, ["methods"])
    pixel, latent = (table.rows[name][2].evaluation for name in ("pixel", "latent"))
    hvf = methods.rows["HVF-2"][2].evaluation
    assert pixel is not None
    assert latent is not None
    assert hvf is not None
    reports = {
        pixel: shipped(pixel, dynamics="keypoint"),
        latent: shipped(latent, dynamics="keypoint", cost="cvae"),
        hvf: shipped(hvf, dynamics="keypoint", generator="cvae"),
    }

    def notes(changed: Evaluation | None, part: str) -> list[str]:
        for evaluation, file in files([table, methods], tmp_path).items():
            if evaluation in reports:
                report = reports[evaluation]
                save(of_others(report, part) if evaluation == changed else report, file)
        before = {file: file.read_bytes() for file in tmp_path.iterdir()}
        words = ["paper", "maze", "--only", "cost", "methods", "--out", str(tmp_path), "--no-run"]
        assert main(words) == 0
        assert {file: file.read_bytes() for file in tmp_path.iterdir()} == before
        output = capsys.readouterr().out
        assert "| HVF-2 |  |  | 1% [0, 5] (paper 54%: lower) |" in output
        return [line for line in output.splitlines() if line.startswith("Not of the weights")]

    assert notes(None, "") == []
    ship = "Not of the weights that ship now"
    assert notes(hvf, "generator") == [f"{ship}: *HVF-2, hard* (cvae)."]
    assert notes(latent, "cost") == [f"{ship}: *latent, hard* (cvae)."]
    # A cell of two tables is named under both.
    assert notes(pixel, "dynamics") == [
        f"{ship}: *no subgoals, hard* (keypoint).",
        f"{ship}: *pixel, hard* (keypoint).",
    ]


def test_distances_that_ship_are_compared_and_checkpoints_from_files_are_not() -> None:
    steps = Evaluation.of("maze", segment_cost="distance", cost="temporal")
    parts = {"cost": "temporal-distance", "segment": "temporal-distance"}
    report = shipped(steps, dynamics="keypoint", generator="keypoint-generator", **parts)
    assert outdated(steps, report) == []
    assert outdated(steps, of_others(report, "cost")) == ["temporal-distance"]
    assert outdated(steps, of_others(report, "segment")) == ["temporal-distance"]
    assert outdated(steps, of_others(report, "generator")) == ["keypoint-generator"]
    own = dataclasses.replace(
        steps,
        world=dataclasses.replace(
            steps.world,
            dynamics="my/model.safetensors",
            generator="keypoint-generator",
            segment_model="temporal-distance",
        ),
    )
    assert outdated(own, of_others(report, "dynamics")) == []
    assert outdated(own, of_others(report, "cost")) == ["temporal-distance"]


def test_what_a_cell_is_compared_with_is_of_the_weights_that_ship_now_too() -> None:
    (table,) = tables(Setup("maze", "default", split="validation"), ["planners"])
    cell = table.rows["coloured noise"][0]
    assert cell.evaluation is not None
    assert cell.baseline is not None
    plain = of_others(shipped(cell.baseline, dynamics="keypoint"), "dynamics")
    reports = {cell.evaluation: shipped(cell.evaluation, dynamics="keypoint"), cell.baseline: plain}
    (line,) = [
        line for line in markdown([table], reports, "").splitlines() if "weights that" in line
    ]
    assert "*plain CEM, no subgoals* (keypoint)" in line
    assert "*coloured noise, no subgoals* (keypoint)" in line


def test_a_file_of_something_else_is_not_taken_for_a_cell(tmp_path: Path) -> None:
    evaluation = Evaluation.of("maze", "paper", method="none", subgoals=0, split="test")
    file = tmp_path / "cell.json"
    assert report_of(evaluation, file) is None
    others = [
        Evaluation.of("maze", "paper", method="none", subgoals=0),
        Evaluation.of("maze", "paper", method="none", subgoals=0, split="test", horizon=6),
        Evaluation.of("maze", "paper", method="none", subgoals=0, split="test", task="easy"),
        Evaluation.of("maze", "paper", method="none", split="test", dynamics="simulator"),
        Evaluation.of("maze", "paper", method="ground-truth", split="test"),
    ]
    for other in others:
        save(made(other, range(1), 2), file)
        with pytest.raises(FileExistsError, match=r"cell\.json: holds another evaluation"):
            report_of(evaluation, file)
    file.write_text("{}")
    with pytest.raises(FileExistsError, match=r"cell\.json: is in the way"):
        report_of(evaluation, file)
    save(made(evaluation, range(1), 2), file)
    assert finished(evaluation, file, 2)
    assert not finished(evaluation, file, 3)


RANDOM = [
    Evaluation.of("maze", method="random", subgoals=0, task=task, split="validation")
    for task in ("easy", "medium", "hard")
]


def outcomes(report: Report) -> list[tuple[int, bool, int]]:
    return [(trial.index, trial.success, trial.steps) for trial in report.trials]


def test_evaluations_side_by_side_end_as_one_by_one(tmp_path: Path) -> None:
    where = {evaluation: tmp_path / f"{evaluation.slug}.json" for evaluation in RANDOM}
    # One is there, one was begun: that one goes on, and no finished one is touched.
    evaluate(RANDOM[0], 6, where[RANDOM[0]])
    evaluate(RANDOM[1], 2, where[RANDOM[1]])
    before = where[RANDOM[0]].read_bytes()
    assert run_all(where, 6, workers=2) == []
    assert where[RANDOM[0]].read_bytes() == before
    for evaluation, file in where.items():
        assert outcomes(load(file)) == outcomes(evaluate(evaluation, 6))
    assert run_all(where, 6) == []


def test_a_failed_evaluation_does_not_stop_the_others(tmp_path: Path) -> None:
    missing = Evaluation.of("maze", method="none", subgoals=0, dynamics=str(tmp_path / "no.model"))
    where = {missing: tmp_path / "missing.json", RANDOM[0]: tmp_path / "random.json"}
    (failure,) = run_all(where, 2, workers=1)
    assert failure.evaluation == missing
    assert "no.model" in failure.message
    assert finished(RANDOM[0], where[RANDOM[0]], 2)


def with_tables(patch: pytest.MonkeyPatch, made: Callable[[Setup], list[PaperTable]]) -> None:
    """The maze has these tables and no others."""
    maze = dataclasses.replace(DOMAINS["maze"], experiments=made)
    patch.setattr(DOMAINS, "_targets", {**DOMAINS._targets, "maze": maze})


def test_the_command_prints_tables_although_a_cell_failed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    missing = Evaluation.of("maze", method="none", subgoals=0, dynamics=str(tmp_path / "no.model"))

    def toy(setup: Setup) -> list[PaperTable]:
        rows = {"bad": (Cell(missing, 0.5),), "good": (Cell(RANDOM[0], 0.5),)}
        return [PaperTable("toy", "Toy", "which", ("success",), rows)]

    with_tables(monkeypatch, toy)
    assert main(["paper", "maze", "--trials", "2", "--out", str(tmp_path / "out")]) == 1
    output = capsys.readouterr()
    assert "| bad | (paper 50%) |" in output.out
    assert "(n = 2) (paper 50%: agrees) |" in output.out
    assert "no.model" in output.err


@pytest.mark.parametrize(("name", "value"), [("trials", 0), ("workers", -1), ("chunk", -1)])
def test_refuses_numbers_out_of_range(tmp_path: Path, name: str, value: int) -> None:
    with pytest.raises(ValueError, match=name):
        run_all({RANDOM[0]: tmp_path / "x.json"}, **{"trials": 1, name: value})  # type: ignore[arg-type]


SLOW = """
import sys
from pathlib import Path
from hvf.evaluation.evaluation import Evaluation
from hvf.experiments.parallel import run_all

if __name__ == "__main__":
    folder = Path(sys.argv[1])
    where = {
        Evaluation.of("maze", "paper", method="none", subgoals=0, task=task, dynamics="simulator",
                      samples=20000): folder / f"{task}.json"
        for task in ("medium", "hard")
    }
    try:
        run_all(where, 500, workers=2, chunk=1)
    except KeyboardInterrupt:
        sys.exit(130)
"""


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_stop_ends_all_processes_and_loses_no_finished_trial(
    tmp_path: Path, how: signal.Signals
) -> None:
    program = tmp_path / "slow.py"
    program.write_text(SLOW)
    out = tmp_path / "out"
    out.mkdir()
    with processes.started([sys.executable, str(program), str(out)]) as parent:
        parent.wait_until(lambda: len(list(out.glob("*.json"))) == 2)
        assert len(processes.members(parent.pid)) >= 3
        begin = time.monotonic()
        if how == signal.SIGINT:
            parent.tell(how)  # as a terminal does, to the whole group
        else:
            parent.tell_it_alone(how)
        assert parent.wait() == (-signal.SIGKILL if how == signal.SIGKILL else 130), parent.errors
        parent.wait_until_gone()
        assert time.monotonic() - begin < 30
    for file in out.glob("*.json"):
        trials = load(file).trials
        assert [trial.index for trial in trials] == list(range(len(trials)))


def test_the_tables_of_a_paper_run_from_nothing_and_go_on(tmp_path: Path) -> None:
    def toy(setup: Setup) -> list[PaperTable]:
        rows = {"random": tuple(Cell(evaluation) for evaluation in RANDOM)}
        return [PaperTable("toy", "Toy", "method", ("easy", "medium", "hard"), rows)]

    setup = Setup("maze", split="validation")
    with pytest.MonkeyPatch.context() as patch:
        with_tables(patch, toy)
        empty, _ = paper(setup, tmp_path, run=False)
        first, failures = paper(setup, tmp_path, trials=3, workers=2)
        again, _ = paper(setup, tmp_path, run=False)
    assert failures == []
    assert "| random |  |  |  |" in empty
    assert first.replace(" --trials 3", "") == again
    assert first.count("(n = 3)") == 3
