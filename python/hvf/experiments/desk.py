"""The desk's figure in Nair & Finn (ICLR 2020), and what our search for subgoals goes by."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hvf.experiments.cells import Cell, PaperTable, Setup
from hvf.experiments.methods import methods
from hvf.registry import METHODS

_CHOSEN = {"two_block": 1, "door_block": 1, "door_two_block": 2}
"""Subgoals of each task with more than the door to it, chosen on validation."""

_PLANNED: Mapping[str, Any] = {
    "segment_cost": "planned",
    "subgoal_samples": 50,
    "subgoal_elites": 10,
    "subgoal_iterations": 2,
}
"""Planning every segment takes about ten times as long with so many samples as likelihood does."""

_OBJECTIVES: Mapping[str, Mapping[str, Any]] = {
    "likelihood, maximum (default)": {},
    "likelihood, mean": {"reduction": "mean"},
    "planned pixels, maximum (the paper's)": _PLANNED,
    "planned pixels, mean": {**_PLANNED, "reduction": "mean"},
}


def desk(setup: Setup) -> list[PaperTable]:
    """The desk's tables."""
    return [methods(setup, "Methods by task"), _objectives(setup)]


def _objectives(setup: Setup) -> PaperTable:
    """What a segment costs in the search for subgoals, and how segments are reduced to a sample."""

    def cells(method: str, settings: Mapping[str, Any]) -> tuple[Cell, ...]:
        return tuple(
            Cell(setup.evaluation(method, 0 if method == "none" else count, task=task, **settings))
            for task, count in _CHOSEN.items()
        )

    rows = {METHODS["none"].label(0): cells("none", {})}
    rows |= {name: cells("hvf", settings) for name, settings in _OBJECTIVES.items()}
    rows["true subgoals"] = cells("ground-truth", {})
    return PaperTable(
        "objective",
        "What a sample of subgoals costs",
        "cost",
        tuple(f"{task}, {METHODS['hvf'].label(count)}" for task, count in _CHOSEN.items()),
        rows,
        extra=True,
    )
