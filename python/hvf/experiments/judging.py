"""The paper's numbers and orders, each once, beside ours of every kind of model.

Two tables of a domain's cells, none of their own: *judging* has a row for each number that the
paper gives and a column for each way of planning (settings and models); *orders* has a row for
each order that it gives, in numbers or in words, and says by how much ours differ on the same
episodes. Orders of methods whose models do not ship become rows when these are given.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from hvf.evaluation.evaluation import Evaluation
from hvf.experiments.cells import Cell, Order, PaperTable, Setup
from hvf.registry import METHODS, MODELS


class Way(NamedTuple):
    """A column: how we plan.

    Attributes:
        preset: settings.
        dynamics: what is planned with; None for the preset's.
    """

    preset: str
    dynamics: str | None = None


class Claim(NamedTuple):
    """A row of the second table: what the paper says of two evaluations.

    Attributes:
        words: which two, and of what.
        one: settings of the first, as :meth:`~hvf.experiments.cells.Setup.evaluation` takes them.
        other: settings of the second.
        order: whether the paper has the first higher or lower; None where it does not say.
    """

    words: str
    one: Mapping[str, Any]
    other: Mapping[str, Any]
    order: Order | None


def judging(
    setup: Setup,
    ways: Sequence[Way],
    published: Callable[[Setup], Sequence[PaperTable]],
    claims: Sequence[Claim],
) -> list[PaperTable]:
    """Both tables.

    Args:
        setup: domain, split and models that do not ship; its preset and what it plans with do not
            count.
        ways: columns.
        published: the domain's tables of the paper, which have the numbers.
        claims: orders.
    """
    setups = [_planned(setup, way) for way in ways]
    columns = tuple(map(_heading, setups))
    rows = {
        claim.words: tuple(
            Cell(one.evaluation(**claim.one), None, one.evaluation(**claim.other), claim.order)
            for one in setups
        )
        for claim in claims
        if all(setup.has(METHODS[one["method"]].asks) for one in (claim.one, claim.other))
    }
    return [
        PaperTable(
            "judging",
            "Every number of the paper, and ours by kind of model",
            "table: cell",
            columns,
            _numbers([published(one) for one in setups]),
            extra=True,
        ),
        PaperTable(
            "orders",
            "Orders in the paper, and ours on the same episodes",
            "more or less than",
            columns,
            rows,
            extra=True,
        ),
    ]


def _planned(setup: Setup, way: Way) -> Setup:
    return dataclasses.replace(setup, preset=way.preset, dynamics=way.dynamics, generator=None)


def _numbers(ways: Sequence[Sequence[PaperTable]]) -> dict[str, tuple[Cell, ...]]:
    """Cells of which the paper gives a number, by way of planning; those of several tables once."""
    rows: dict[str, tuple[Cell, ...]] = {}
    seen: set[Evaluation | None] = set()
    for alike in zip(*ways, strict=True):
        first = alike[0]
        for row in first.rows:
            for place, column in enumerate(first.columns):
                cells = tuple(table.rows[row][place] for table in alike)
                if cells[0].published is None or cells[0].evaluation in seen:
                    continue
                seen.add(cells[0].evaluation)
                words = f"{row}, {column}" if len(first.columns) > 1 else row
                rows[f"{first.name}: {words}"] = cells
    return rows


def _heading(setup: Setup) -> str:
    """Settings, models and what kind they are."""
    evaluation = setup.evaluation("hvf", 1)
    world = evaluation.place.resolved(evaluation.world)
    models = world.dynamics, world.generator
    kind = "object" if "object" in {MODELS[name].kind for name in models} else "video"
    return f"`{setup.preset}`, {' and '.join(models)} ({kind})"
