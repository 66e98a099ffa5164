"""What stands under a table: of which models, episodes, code and weights its rows are.

All of it is read from the reports themselves.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

from hvf.evaluation.evaluation import Evaluation
from hvf.evaluation.report import Report
from hvf.worlds.load import cost_model, file_checksum

_PARTS = ("dynamics", "generator", "segment", "cost", "method")
"""Parts that a model may have, in the order in which they are named."""


def notes(reports: Iterable[Report]) -> list[str]:
    """What a reader has to know: episodes, the code that made the rows, weights that differ."""
    reports = list(reports)
    episodes = f"split {reports[0].split}, " if reports[0].split else ""
    notes = [
        f"Episodes: {episodes}seed {reports[0].seed}; 100 where no n is given.",
        made_by(reports),
    ]
    weights: dict[tuple[str, str], set[str]] = {}
    for report in reports:
        for role, weight in report.weights.items():
            # A checkpoint of one's own is named in its row.
            shown = str(report.world.get(role) or weight["model"])
            weights.setdefault((role, shown), set()).add(weight["sha256"])
    mixed = sorted({shown for (_, shown), sums in weights.items() if len(sums) > 1})
    if mixed:
        notes.append(f"Not all rows are of the same weights: {', '.join(mixed)} differ.")
    return notes


def made_by(reports: Iterable[Report]) -> str:
    """The code that made reports, in a sentence."""
    commits = set()
    for report in reports:
        commit = report.code.get("commit")
        words = str(commit)[:10] if commit else f"version {report.code.get('version')}"
        commits.add(words + (" with changes" if report.code.get("changes") and commit else ""))
    return f"Code: {', '.join(sorted(commits))}."


def planned_with(reports: Iterable[Report]) -> str:
    """The models that took part together, and of what kind that is, in a sentence.

    Rows with fewer of the same models, as those without subgoals, are not named by themselves.

    Args:
        reports: of a table, in its order.

    Returns:
        ``"Models: keypoint and keypoint-generator (object)."``; empty if there were none.
    """
    found = list(dict.fromkeys((_together(report), report.kind) for report in reports))
    words = [
        f"{_listed(models)} ({kind})"
        for models, kind in found
        if models and not any(kind == other and set(models) < set(more) for more, other in found)
    ]
    return f"Models: {'; '.join(words)}." if words else ""


def outdated(evaluation: Evaluation, report: Report) -> list[str]:
    """Models of a report that ship under the same name with other weights today.

    Of models from files nothing is said: what these hold is not for the package to know.

    Args:
        evaluation: what would run today.
        report: what ran then.
    """
    domain = evaluation.place
    held = {part: weights["model"] for part, weights in report.weights.items()}
    # Of what was planned with then: a file may be gone.
    world = dataclasses.replace(
        evaluation.world, dynamics=held.get("dynamics", evaluation.world.dynamics)
    )
    names = {**evaluation.world_names, "cost": cost_model(domain, world) or ""}
    shipped = {
        part: domain.weights[names[part]]
        for part in _PARTS
        if part in held and names.get(part) in domain.weights
    }
    return [
        names[part]
        for part, path in shipped.items()
        if path.is_file() and report.weights[part]["sha256"] != file_checksum(path)
    ]


def _together(report: Report) -> tuple[str, ...]:
    """The models of a report, each once: what checkpoints hold, or how true dynamics are called."""
    held = {part: weights["model"] for part, weights in report.weights.items()}
    # A cost is no model, but may ask one.
    named = {part: name for part, name in report.world.items() if part != "cost"}
    names = {**named, **held}
    return tuple(dict.fromkeys(names[part] for part in _PARTS if part in names))


def _listed(words: tuple[str, ...]) -> str:
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last
