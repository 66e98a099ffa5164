"""Reports of evaluations that nobody ran."""

from __future__ import annotations

import dataclasses
from collections.abc import Container

from hvf.evaluation.evaluation import Evaluation
from hvf.evaluation.report import Report, TrialRecord
from hvf.registry import METHODS


def made(
    evaluation: Evaluation, successes: Container[int], trials: int = 100, kind: str = "object"
) -> Report:
    """A report as if these trials had succeeded, with models of a kind."""
    method = METHODS[evaluation.method]
    head = {
        "domain": evaluation.domain,
        "task": evaluation.task,
        "method": evaluation.method,
        "subgoals": evaluation.subgoals if method.has_subgoals else 0,
        "preset": evaluation.preset,
        "split": evaluation.split,
        "seed": evaluation.episode_seed,
        "world": evaluation.world_names,
        "kind": kind,
        "planning": dataclasses.asdict(evaluation.planning),
        "weights": {},
    }
    records = [TrialRecord(i, i in successes, 9, (), 0.0, 0.0) for i in range(trials)]
    return Report.of(evaluation.name, head, records, 1.0, {"commit": "c0ffee", "changes": None})
