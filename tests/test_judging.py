"""The judging tables: every number and order of the paper once, beside ours by kind of model."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from hvf.experiments.cells import PaperTable, Setup
from hvf.experiments.paper import markdown, order_verdict, tables
from made_reports import made

PUBLISHED = Path(__file__).parent.parent.parent / "shared" / "paper" / "tables.json"


def judged(domain: str) -> tuple[PaperTable, PaperTable]:
    numbers, orders = tables(Setup(domain), ["judging", "orders"])
    return numbers, orders


def leaves(value: Any) -> list[float]:
    return (
        [leaf for each in value.values() for leaf in leaves(each)]
        if isinstance(value, dict)
        else [value]
    )


def test_every_number_of_the_paper_has_one_row() -> None:
    numbers, _ = judged("maze")
    found = sorted(cells[0].published or 0.0 for cells in numbers.rows.values())
    # Cells of the paper's tables that are not repeated from another one.
    methods, subgoals = [0.93, 0.68, 0.33, 0.47, 0.54], [0.39, 0.02, 0.0]
    mean, samples = [0.45, 0.53], [0.35, 0.54, 0.55]
    horizon, latent = [0.46, 0.55, 0.37, 0.31, 0.39, 0.24], [0.62, 0.49, 0.23]
    assert found == sorted([*methods, *subgoals, *mean, *samples, *horizon, *latent])
    for cells in numbers.rows.values():
        assert len({cell.published for cell in cells}) == 1
    if PUBLISHED.exists():
        published = json.loads(PUBLISHED.read_text())["maze"]
        words = {key: value for key, value in published.items() if isinstance(value, dict)}
        assert set(found) == set(leaves(words))
    desk, _ = judged("desk")
    assert [cells[0].published for cells in desk.rows.values()] == [0.15, 0.15, 0.42]


@pytest.mark.parametrize("domain", ["maze", "desk"])
def test_columns_say_what_plans_and_of_what_kind_it_is(domain: str) -> None:
    for table in judged(domain):
        for place, column in enumerate(table.columns):
            for cells in table.rows.values():
                evaluation = cells[place].evaluation
                assert evaluation is not None
                world = evaluation.place.resolved(evaluation.world)
                assert column.startswith(f"`{evaluation.preset}`, {world.dynamics} and ")
                video = {world.dynamics, world.generator} <= {"latent", "cvae", "vae"}
                assert column.endswith("(video)" if video else "(object)")
        assert any(column.endswith("(video)") for column in table.columns)


def test_an_order_is_judged_on_the_same_episodes() -> None:
    _, orders = judged("maze")
    shown: dict[str, str] = {}
    for name, ahead in (("ahead", 30), ("behind", -30), ("alike", 4)):
        cell = orders.rows["HVF-2 than no subgoals, hard"][0]
        assert cell.evaluation is not None
        assert cell.baseline is not None
        few, many = set(range(20)), set(range(20 + abs(ahead)))
        first, second = (many, few) if ahead > 0 else (few, many)
        reports = {
            cell.evaluation: made(cell.evaluation, first, kind="video"),
            cell.baseline: made(cell.baseline, second, kind="video"),
        }
        (row,) = [
            line
            for line in markdown([orders], reports, "").splitlines()
            if line.startswith("| HVF-2 than no subgoals, hard |")
        ]
        shown[name] = row.split("|")[2]
        # The other way round, what is higher is lower.
        flipped = order_verdict(reports[cell.baseline], reports[cell.evaluation], "lower")
        assert shown[name].strip().endswith(f"({flipped})")
    assert shown["ahead"].startswith(" 50% [40, 60]; +30 [")
    assert shown["ahead"].endswith("(the paper's order) ")
    assert shown["behind"].endswith("(reversed) ")
    # 4 of 100 differ: Newcombe's interval has 0 in it, McNemar's p is 1 / 8.
    assert "+4 [" in shown["alike"]
    assert shown["alike"].endswith("p = 0.12 (not shown) ")


def test_an_order_with_one_of_both_missing_is_blank() -> None:
    _, orders = judged("maze")
    cell = orders.rows["HVF-2 than HVF-1, hard"][1]
    for evaluation in (cell.evaluation, cell.baseline):
        assert evaluation is not None
        text = markdown([orders], {evaluation: made(evaluation, {1, 2}, kind="video")}, "")
        assert "| HVF-2 than HVF-1, hard |  |  |  |" in text.splitlines()


def test_what_an_order_compares_with_is_run_too() -> None:
    _, orders = judged("desk")
    needed = set(orders.evaluations)
    for cells in orders.rows.values():
        assert {cell.baseline for cell in cells} <= needed


def test_orders_of_methods_become_rows_when_the_models_that_they_ask_are_given() -> None:
    file = "runs/tap/model.safetensors"
    _, before = judged("maze")
    (after,) = tables(Setup("maze", models=(("tap", file),)), ["orders"])
    assert {name: after.rows[name] for name in before.rows} == before.rows
    added = {name: cells for name, cells in after.rows.items() if name not in before.rows}
    orders = {name: {cell.order for cell in cells} for name, cells in added.items()}
    # In words: near HVF on easy and medium, all fail on hard, the recursive one lower everywhere.
    assert orders == {
        "TAP-1 than HVF-1, easy (paper: about equal)": {None},
        "TAP-1 than HVF-1, medium (paper: about equal)": {None},
        "TAP-1 than HVF-1, hard": {"lower"},
        "HVF-2 than TAP-1, hard": {"higher"},
        "HVF-2 than TAP-2, hard": {"higher"},
        **{f"TAP-2 than TAP-1, {task}": {"lower"} for task in ("easy", "medium", "hard")},
    }
    for name, cells in added.items():
        words = re.fullmatch(r"(\S+) than (\S+), (\w+).*", name)
        assert words is not None
        for cell in cells:
            for label, one in zip(words.groups(), (cell.evaluation, cell.baseline), strict=False):
                assert one is not None
                assert (one.label, one.task) == (label, words[3])
                assert one.world.method_model == (file if one.method == "tap" else None)


def test_the_desk_is_ahead_of_the_papers_baselines_where_these_are_given() -> None:
    given = (("rig", "runs/rig/model.safetensors"), ("tap", "runs/tap/model.safetensors"))
    (with_tap,) = tables(Setup("desk", models=given[1:]), ["orders"])
    (with_both,) = tables(Setup("desk", models=given), ["orders"])
    _, without = judged("desk")
    tap, rig = with_tap.rows.keys() - without.rows.keys(), with_both.rows.keys() - with_tap.rows
    tasks = ("door", "two_block", "door_block", "door_two_block")
    assert tap == {f"HVF-2 than TAP-1, {task}" for task in tasks}
    assert rig == {f"HVF-2 than RIG, {task}" for task in tasks}
    for name in tap | rig:
        assert {cell.order for cell in with_both.rows[name]} == {"higher"}


def test_found_subgoals_at_the_desk_stand_beside_true_ones_without_an_order_of_the_paper() -> None:
    _, orders = judged("desk")
    found = {name: cells for name, cells in orders.rows.items() if name.startswith("ground truth")}
    assert list(found) == [
        "ground truth-1 than HVF-1, two_block",
        "ground truth-1 than HVF-1, door_block",
        "ground truth-2 than HVF-2, door_two_block",
    ]
    for name, cells in found.items():
        for cell in cells:
            assert cell.evaluation is not None
            assert cell.baseline is not None
            assert f"{cell.evaluation.label} than {cell.baseline.label}" in name
            assert cell.evaluation.task == cell.baseline.task == name.split(", ")[1]
            assert cell.order is None
            reports = {
                cell.evaluation: made(cell.evaluation, range(67)),
                cell.baseline: made(cell.baseline, range(52)),
            }
            (line,) = [
                line for line in markdown([orders], reports, "").splitlines() if "+15 [" in line
            ]
            # How much, and no word of an order.
            assert line.startswith(f"| {name} | ")
            assert "p < 0.001 |" in line
