"""Variants of the cross-entropy method against the plain one, at equal budget.

The budget is small, so that a better search shows: with the preset's own, every variant finds about
the same plans. All rows draw as many candidates per plan (iCEM, whose samples decay, within one in
a hundred), act in the same episodes, and are compared in pairs.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hvf.experiments.cells import Cell, PaperTable, Setup
from hvf.registry import METHODS

BUDGET: Mapping[str, Any] = {
    "samples": 40,
    "elites": 8,
    "iterations": 3,
    "subgoal_samples": 20,
    "subgoal_elites": 5,
    "subgoal_iterations": 3,
}
"""A fifth of the maze's samples, and three iterations instead of five."""

_ICEM: Mapping[str, Any] = {
    "noise_beta": 2.0,
    "keep_elites": 3,
    "momentum": 0.1,
    # 49 + 39 + 31 candidates instead of 3 times 40.
    "samples": 49,
    "samples_decay": 1.25,
    "warm_start": True,
    "shift_elites": 3,
}

VARIANTS: Mapping[str, Mapping[str, Any]] = {
    "plain CEM": {},
    "elites kept": {"keep_elites": 3, "subgoal_keep_elites": 2},
    "momentum 0.1": {"momentum": 0.1, "subgoal_momentum": 0.1},
    "least deviation": {"min_std": 0.5, "subgoal_min_std": 0.3},
    "coloured noise": {"noise_beta": 2.0},
    "warm start": {"warm_start": True},
    "warm start, elites shifted": {"warm_start": True, "shift_elites": 3},
    "iCEM": _ICEM,
    "elites weighted": {"temperature": 1e-3, "subgoal_temperature": 1e-3},
    "MPPI": {
        "elites": 40,
        "temperature": 1e-3,
        "subgoal_elites": 20,
        "subgoal_temperature": 1e-3,
    },
    "full covariance of actions": {"covariance": "full"},
    "full covariance of subgoals": {"subgoal_covariance": "full"},
}
"""Row to what differs from plain CEM. Temperatures are of the maze's costs, squared pixels."""


def planners(setup: Setup, task: str) -> PaperTable:
    """Each variant of the search, for actions and for subgoals, on one task.

    Args:
        setup: what all evaluations share.
        task: which.
    """
    plain = setup.evaluation("none", task=task, **BUDGET)
    searching = setup.evaluation("hvf", 2, task=task, **BUDGET)

    def cells(changed: Mapping[str, Any]) -> tuple[Cell, ...]:
        own = {name: value for name, value in changed.items() if not name.startswith("subgoal_")}
        without = setup.evaluation("none", task=task, **{**BUDGET, **own}) if own else None
        both = setup.evaluation("hvf", 2, task=task, **{**BUDGET, **changed})
        return Cell(without, baseline=plain), Cell(both, baseline=searching)

    rows = {name: cells(changed) for name, changed in VARIANTS.items() if changed}
    return PaperTable(
        "planners",
        f"Variants of the search at equal budget, {task}",
        "search",
        (METHODS["none"].label(0), METHODS["hvf"].label(2)),
        {next(iter(VARIANTS)): (Cell(plain), Cell(searching)), **rows},
        extra=True,
    )
