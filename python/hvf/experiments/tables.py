"""Evaluations in a folder as Markdown: success rates, and what subgoals change on equal episodes.

Rows are methods with their settings, columns are tasks. Everything stands in the reports and in
the light :class:`~hvf.domains.domain.Domain`, so neither torch nor a simulator is imported.

Times stand in the JSON only: evaluations run side by side on machines that do other things, so
those of two rows do not compare. Speed is what ``benchmarks/`` measures.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hvf.domains.domain import Domain
from hvf.evaluation.report import Report, load
from hvf.evaluation.statistics import Paired, paired
from hvf.experiments.notes import notes
from hvf.registry import METHODS

BASELINE = "none"
"""The method that others are compared with."""

_OF_SUBGOALS = ("steps_per_subgoal", "threshold", "reached", "reached_blur")
_OF_SEARCH = ("reduction", "segment_cost", "choose_anew")


@dataclasses.dataclass(frozen=True)
class Row:
    """What the evaluations in one row of a table share.

    Attributes:
        settings: name of their preset, and in what they differ from it.
        world: what was planned with, and in brackets what drew subgoals.
        kind: kind of model that this is: ``video``, ``object`` or ``simulator``.
        method: what acted.
        subgoals: number of subgoals, 0 for a method that has none.
    """

    settings: str
    world: str
    kind: str
    method: str
    subgoals: int

    @property
    def words(self) -> tuple[str, str, str, str]:
        """Its cells left of the tasks."""
        label = METHODS[self.method].label(self.subgoals)
        return self.settings, self.world, self.kind, label


def read(folder: Path) -> dict[Path, Report]:
    """The reports in a folder.

    Raises:
        FileNotFoundError: no such folder, or no JSON files in it.
        ValueError: a JSON file that is not a report.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"folder: {folder} is not a folder")
    reports = {path: load(path) for path in sorted(folder.glob("*.json"))}
    if not reports:
        raise FileNotFoundError(f"folder: {folder} has no evaluations (*.json)")
    return reports


def markdown(reports: Mapping[Path, Report], domain: Domain, split: str | None = None) -> str:
    """Reports as two Markdown tables: success rates, and differences to no subgoals.

    Args:
        reports: evaluations in one domain, by the file that they are from.
        domain: gives the columns, the presets and the published numbers.
        split: which episodes, if the reports are of several splits.

    Raises:
        ValueError: a report of something else; two of the same thing that disagree; reports of
            different episodes, which cannot be compared.
    """
    chosen = {
        path: report
        for path, report in reports.items()
        if report.trials and split in (None, report.split)
    }
    if not chosen:
        which = "" if split is None else f" of split {split!r}"
        raise ValueError(f"folder: there is no evaluation{which} with any trials")
    for path, report in chosen.items():
        if report.domain != domain.name:
            raise ValueError(f"{path}: is an evaluation in {report.domain}, not in {domain.name}")
        domain.check_task(report.task)
    _check_same_episodes(chosen)
    others = {report.task for report in chosen.values()} - set(domain.tasks)
    tasks = [*domain.tasks, *sorted(others)]
    rows: dict[Row, dict[str, Report]] = {}
    baselines: dict[Row, Row] = {}
    for path, report in chosen.items():
        row = _row(report, domain)
        cells = rows.setdefault(row, {})
        cells[report.task] = _agreed(path, report, cells.get(report.task), row)
        if METHODS[report.method].has_subgoals and report.subgoals:
            baselines[row] = _unkind(_row(report, domain, BASELINE))
    return "\n".join(
        [
            *_rates(rows, domain, tasks),
            "",
            "In brackets 95% Wilson intervals.",
            *notes(chosen.values()),
            *_differences(rows, baselines, tasks),
        ]
    )


def rate(report: Report) -> str:
    """A success rate with its interval, and the number of trials if it is not 100."""
    low, high = report.interval
    return f"{report.success_rate:.0%} [{100 * low:.0f}, {100 * high:.0f}]{_count(report)}"


def line(cells: Iterable[str]) -> str:
    """A row of a Markdown table."""
    return f"| {' | '.join(cells)} |"


def _rates(
    rows: Mapping[Row, Mapping[str, Report]], domain: Domain, tasks: Sequence[str]
) -> list[str]:
    """The table of success rates, published ones last."""
    header = ["settings", "world", "kind", "method", *tasks]
    lines = [line(header), f"|{'---|' * 4}{'---:|' * len(tasks)}"]
    for row in sorted(rows, key=_order):
        cells = rows[row]
        rates = [rate(cells[task]) if task in cells else "" for task in tasks]
        lines.append(line([*row.words, *rates]))
    for (method, subgoals), published in domain.published.items():
        row = Row("ICLR 2020, tables", "SV2P", domain.published_kind, method, subgoals)
        rates = [f"{published[task]:.0%}" if task in published else "" for task in tasks]
        lines.append(line([*row.words, *rates]))
    return lines


def _differences(
    rows: Mapping[Row, Mapping[str, Report]], baselines: Mapping[Row, Row], tasks: Sequence[str]
) -> list[str]:
    """The table of paired differences; nothing where nothing can be paired."""
    by_baseline = {_unkind(row): cells for row, cells in rows.items()}
    lines = []
    for row in sorted(baselines, key=_order):
        other = by_baseline.get(baselines[row], {})
        cells = [
            difference(rows[row][task], other[task]) if task in rows[row] and task in other else ""
            for task in tasks
        ]
        if any(cells):
            lines.append(line([*row.words, *cells]))
    if not lines:
        return []
    return [
        "",
        f"Points of success more than *{METHODS[BASELINE].label(0)}* of the same settings and "
        "world on the same episodes, with 95% intervals for paired data (Newcombe, 1998, method "
        "10) and McNemar's exact p, which is not corrected for the number of comparisons:",
        "",
        line(["settings", "world", "kind", "method", *tasks]),
        f"|{'---|' * 4}{'---:|' * len(tasks)}",
        *lines,
    ]


def difference(report: Report, baseline: Report) -> str:
    """Points of success more, with their interval, and McNemar's exact p."""
    found = compared(report, baseline)
    p = "p < 0.001" if found.p < 1e-3 else f"p = {found.p:.2g}"
    count = "" if found.n == 100 else f" (n = {found.n})"
    low, high = _points(found.low), _points(found.high)
    return f"{_points(found.difference)} [{low}, {high}], {p}{count}"


def compared(report: Report, other: Report) -> Paired:
    """Two reports on the episodes that both have.

    Raises:
        ValueError: they are of different episodes: other splits, seeds, domains or tasks.
    """
    for name in ("domain", "task", "split", "seed"):
        a, b = getattr(report, name), getattr(other, name)
        if a != b:
            raise ValueError(
                f"{name}: only evaluations of the same episodes can be compared, but "
                f"{report.name!r} has {a!r} and {other.name!r} {b!r}"
            )
    return paired(_successes(report), _successes(other), common=True)


def _check_same_episodes(reports: Mapping[Path, Report]) -> None:
    """Refuse reports of which some have other episodes.

    Raises:
        ValueError: names two files.
    """
    seen: dict[tuple[str | None, int], Path] = {}
    for path, report in reports.items():
        seen.setdefault((report.split, report.seed), path)
    if len(seen) > 1:
        words = [
            f"{path.name} has split {split}, seed {seed}" for (split, seed), path in seen.items()
        ]
        raise ValueError(
            "folder: evaluations of different episodes cannot be compared "
            f"({'; '.join(words)}); choose one split, or keep them in folders of their own"
        )


def _row(report: Report, domain: Domain, method: str | None = None) -> Row:
    """Row of a report, or of what it would be with another method."""
    name = method or report.method
    kind = METHODS[name]
    if not kind.needs_dynamics:
        if kind.asks is None:
            return Row("", "", "", name, 0)
        return Row("", report.world.get("method", ""), report.kind, name, 0)
    preset = domain.presets.get(report.preset, domain.presets["default"])
    own = _relevant(dataclasses.asdict(preset.planning), name)
    settings = [report.preset] + [
        f"{setting} {value}"
        for setting, value in _relevant(report.planning, name).items()
        if _plain(own.get(setting)) != _plain(value)
    ]
    if report.world["cost"] != preset.world.cost:
        settings.append(f"cost {report.world['cost']}")
    words = report.world["dynamics"]
    if kind.needs_generator:
        words += f" ({report.world['generator']})"
    if kind.asks is not None:
        words += f" ({report.world.get('method', kind.asks)})"
    subgoals = report.subgoals if kind.has_subgoals else 0
    return Row(", ".join(settings), words, report.kind, name, subgoals)


def _relevant(planning: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Settings that a method uses: none that does not plan, no search without a generator."""
    method = METHODS[name]
    if not method.needs_dynamics:
        return {}

    def used(setting: str) -> bool:
        if setting.startswith("subgoal_") or setting in _OF_SEARCH:
            return method.needs_generator
        return method.has_subgoals or setting not in _OF_SUBGOALS

    return {setting: value for setting, value in planning.items() if used(setting)}


def _unkind(row: Row) -> Row:
    """A row whatever draws its subgoals, which may be of another kind than its dynamics."""
    return dataclasses.replace(row, kind="")


def _plain(value: Any) -> Any:
    """As JSON has it."""
    return list(value) if isinstance(value, tuple) else value


def _agreed(path: Path, report: Report, other: Report | None, row: Row) -> Report:
    """The longer of two reports of the same evaluation.

    Raises:
        ValueError: an episode ended otherwise.
    """
    if other is None:
        return report
    a, b = _successes(report), _successes(other)
    if any(a[index] != b[index] for index in a.keys() & b.keys()):
        raise ValueError(
            f"folder: {path} and another file are of the same evaluation ({report.name}, "
            f"{row.settings}) with different results"
        )
    return max(other, report, key=lambda one: len(one.trials))


def _order(row: Row) -> tuple[bool, str, str, int, int]:
    """What does not plan last; few subgoals first."""
    planless = not METHODS[row.method].needs_dynamics
    dynamics, method = row.world.split(" (")[0], list(METHODS).index(row.method)
    return planless, row.settings, dynamics, method, row.subgoals


def _successes(report: Report) -> dict[int, bool]:
    return {trial.index: trial.success for trial in report.trials}


def _count(report: Report) -> str:
    return "" if len(report.trials) == 100 else f" (n = {len(report.trials)})"


def _points(difference: float) -> str:
    """In percentage points, with its sign."""
    points = round(100 * difference)
    return f"{points:+d}" if points else "0"
