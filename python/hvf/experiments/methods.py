"""The table of methods by task, of any domain."""

from __future__ import annotations

from hvf.experiments.cells import Cell, PaperTable, Setup
from hvf.registry import DOMAINS, METHODS

_METHODS = (
    ("none", 0),
    ("hvf", 1),
    ("hvf", 2),
    ("tap", 1),
    ("tap", 2),
    ("ground-truth", 1),
    ("ground-truth", 2),
    ("rig", 0),
    ("random", 0),
)
"""Methods of the paper's figures, and acting at random.

Those become rows whose models ship or are given.
"""


def methods(setup: Setup, title: str) -> PaperTable:
    """Methods by task. They are bar charts in the paper, with few numbers in the text.

    Args:
        setup: what all evaluations share; the domain has the tasks and the published numbers.
        title: of the table.
    """
    domain = DOMAINS[setup.domain]
    rows = {
        METHODS[method].label(count): tuple(
            Cell(
                setup.evaluation(method, count, task=task),
                domain.published.get((method, count), {}).get(task),
            )
            for task in domain.tasks
        )
        for method, count in _METHODS
        if setup.has(METHODS[method].asks)
    }
    return PaperTable("methods", title, "method", tuple(domain.tasks), rows)
