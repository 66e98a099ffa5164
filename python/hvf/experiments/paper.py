"""``hvf paper``: the paper's tables as lists of evaluations.

A domain's experiments are a function from :class:`~hvf.experiments.cells.Setup` (preset, world,
split) to tables of :class:`~hvf.experiments.cells.Cell`, which the domain names
(:attr:`hvf.domains.domain.Domain.experiments`). A cell of several tables is evaluated once.

Numbers of the paper (Nair & Finn, ICLR 2020) are success rates over 100 trials. A *verdict* says
how ours compares: ``higher`` or ``lower`` if the 95% interval of the difference of the two rates
(Newcombe's hybrid score interval for separate samples, the paper's rate as so many successes of
100) lies on one side of 0; else ``agrees``, which means that so many trials show no difference,
not that there is none. An order of two methods is judged by pairs of our own episodes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from rich.console import Console

from hvf.evaluation.evaluation import Evaluation
from hvf.evaluation.report import Report
from hvf.evaluation.statistics import difference_interval
from hvf.experiments.cells import Cell, Order, PaperTable, Setup
from hvf.experiments.notes import notes, outdated, planned_with
from hvf.experiments.parallel import Failure, report_of, run_all
from hvf.experiments.tables import compared, difference, line, rate
from hvf.importing import imported
from hvf.registry import DOMAINS

PUBLISHED_TRIALS = 100
"""Trials behind each number of the paper."""

LEGEND = (
    "Success with its 95% Wilson interval; behind it the paper's number, where it gives one, and "
    "whether ours is higher or lower, or agrees: the 95% interval of the difference (Newcombe's, "
    "for separate samples of which the paper's has 100 trials) lies above 0, below, or around it."
)

PAIRED = (
    "Success with its 95% Wilson interval; behind it, where both are there, the points more than "
    "the row that is named under the table, on the same episodes, with their 95% interval for "
    "paired data (Newcombe, 1998, method 10) and McNemar's exact p, which is not corrected for the "
    "number of comparisons."
)

ORDERS = (
    "Success of the first with its 95% Wilson interval; behind it the points more than the second, "
    "on the same episodes, with their 95% interval for paired data (Newcombe, 1998, method 10) and "
    "McNemar's exact p, which is not corrected for the number of comparisons; and, where the paper "
    "has an order, whether ours is that (the interval is on that side of 0), the reverse, or "
    "neither is shown."
)


def all_tables(setup: Setup) -> list[PaperTable]:
    """All tables of a domain, also those that are made only when they are named.

    Raises:
        ValueError: a domain that there is not, or that has no tables; settings out of range.
        ImportError: they are somebody's, and cannot be imported.
    """
    target = DOMAINS[setup.domain].experiments
    if target is None:
        raise ValueError(f"domain: {setup.domain} has no tables of experiments")
    experiments: Callable[[Setup], list[PaperTable]] = (
        imported(target) if isinstance(target, str) else target
    )
    return experiments(setup)


def tables(setup: Setup, only: Sequence[str] = ()) -> list[PaperTable]:
    """The tables of a domain, or some of them.

    Raises:
        ValueError: a table that there is not; ImportError: as :func:`all_tables`.
    """
    found = {table.name: table for table in all_tables(setup)}
    for name in only:
        if name not in found:
            raise ValueError(f"only: must be of {', '.join(found)}; got {name!r}")
    return [table for name, table in found.items() if (name in only if only else not table.extra)]


def files(chosen: Sequence[PaperTable], folder: Path) -> dict[Evaluation, Path]:
    """The evaluations of tables, each once, and their files.

    Raises:
        ValueError: two that are not equal but would share a file.
    """
    found = {
        evaluation: folder / f"{evaluation.slug}.json"
        for table in chosen
        for evaluation in table.evaluations
    }
    for file, count in Counter(found.values()).items():
        if count > 1:
            raise ValueError(f"{file}: is the file of {count} evaluations that are not equal")
    return found


def paper(
    setup: Setup,
    folder: Path,
    *,
    only: Sequence[str] = (),
    trials: int = 100,
    workers: int = 0,
    chunk: int = 0,
    run: bool = True,
    console: Console | None = None,
) -> tuple[str, list[Failure]]:
    """Run what is missing of the tables, and give them as Markdown, with what failed.

    Args:
        setup: what all evaluations share.
        folder: where their JSON files are.
        only: names of tables; all if empty.
        trials: episodes of each evaluation.
        workers: evaluations at a time, 0 for as many as there are cores.
        chunk: trials that run together, and that a stop loses; 0 for what suits the domain.
        run: whether to run anything, or only to show what is there.
        console: where progress goes.

    Raises:
        ValueError, TypeError, FileExistsError, KeyboardInterrupt: as
            :func:`~hvf.experiments.parallel.run_all` and :func:`tables`.
    """
    chosen = tables(setup, only)
    where = files(chosen, folder)
    failures: list[Failure] = []
    if run:
        failures = run_all(where, trials, workers=workers, chunk=chunk, console=console)
    found = {evaluation: report_of(evaluation, file) for evaluation, file in where.items()}
    reports = {
        evaluation: report
        for evaluation, report in found.items()
        if report is not None and report.trials
    }
    options = setup.options
    options += f" --trials {trials}" if trials != 100 else ""
    options += f" --out {folder}" if folder != Path("results", setup.domain) else ""
    return markdown(chosen, reports, f"{setup.domain} {options}"), failures


def markdown(
    chosen: Sequence[PaperTable], reports: Mapping[Evaluation, Report], options: str
) -> str:
    """Tables with our numbers, the paper's, and verdicts; blank where there is no report.

    Args:
        chosen: tables.
        reports: what there is.
        options: those of ``hvf paper`` that make them.
    """
    lines = []
    for table in chosen:
        there = [reports[each] for each in table.evaluations if each in reports]
        lines += [
            f"**{table.title}**",
            "",
            line([table.corner, *table.columns]),
            f"|---|{'---:|' * len(table.columns)}",
            *(
                line([name, *(_words(cell, reports) for cell in cells)])
                for name, cells in table.rows.items()
            ),
            "",
            *_paragraph(_pairs(table)),
            *_paragraph(planned_with(there)),
            *_paragraph(_outdated(table, reports)),
            f"`hvf paper {options} --only {table.name}`",
            "",
        ]
    legend = [words for words in (LEGEND, PAIRED, ORDERS) if words in map(_legend, chosen)]
    return "\n".join([*lines, *legend, *(notes(reports.values()) if reports else [])])


def verdict(successes: int, trials: int, published: float) -> str:
    """``"higher"``, ``"lower"`` or ``"agrees"``: a rate and one of the paper's; see the module.

    Args:
        successes: ours.
        trials: of so many.
        published: the paper's rate.

    Raises:
        ValueError: no trials, or rates out of range.
    """
    other = round(published * PUBLISHED_TRIALS)
    low, high = difference_interval(successes, trials, other, PUBLISHED_TRIALS)
    return "higher" if low > 0 else "lower" if high < 0 else "agrees"


def order_verdict(report: Report, baseline: Report, order: Order) -> str:
    """``"the paper's order"``, ``"reversed"`` or ``"not shown"``; see the module.

    Args:
        report: of what the paper has higher or lower.
        baseline: than this.
        order: which of both.

    Raises:
        ValueError: reports of different episodes.
    """
    found = compared(report, baseline)
    low, high = (found.low, found.high) if order == "higher" else (-found.high, -found.low)
    return "the paper's order" if low > 0 else "reversed" if high < 0 else "not shown"


def _paragraph(words: str) -> list[str]:
    """Lines of a paragraph; none if there is nothing to say."""
    return [words, ""] if words else []


def _legend(table: PaperTable) -> str:
    """How to read its cells."""
    cells = [cell for row in table.rows.values() for cell in row]
    if any(cell.order for cell in cells):
        return ORDERS
    return PAIRED if any(cell.baseline for cell in cells) else LEGEND


def _pairs(table: PaperTable) -> str:
    """Which rows are compared with which; empty if none are, or if rows say it themselves."""
    if _legend(table) != PAIRED:
        return ""
    named = {
        (place, cell.evaluation): name
        for name, cells in table.rows.items()
        for place, cell in enumerate(cells)
    }
    found = list(
        dict.fromkeys(
            (name, named.get((place, cell.baseline), cell.baseline.name))
            for name, cells in table.rows.items()
            for place, cell in enumerate(cells)
            if cell.baseline is not None
        )
    )
    others = {other for _, other in found}
    if len(others) == 1:
        return f"Points are more than *{others.pop()}*."
    pairs = (f"*{name}* more than *{other}*" for name, other in found)
    return f"Points are of {'; '.join(pairs)}."


def _outdated(table: PaperTable, reports: Mapping[Evaluation, Report]) -> str:
    """Which cells are of weights that have changed since; empty if none are."""
    found: dict[str, list[str]] = {}
    for name, cells in table.rows.items():
        for column, cell in zip(table.columns, cells, strict=True):
            words = f"{name}, {column}" if len(table.columns) > 1 else name
            for each in (cell.evaluation, cell.baseline):
                if each is not None and each in reports:
                    found.setdefault(words, []).extend(outdated(each, reports[each]))
    cells_of = [
        f"*{words}* ({', '.join(dict.fromkeys(models))})"
        for words, models in found.items()
        if models
    ]
    return f"Not of the weights that ship now: {'; '.join(cells_of)}." if cells_of else ""


def _words(cell: Cell, reports: Mapping[Evaluation, Report]) -> str:
    report = reports.get(cell.evaluation) if cell.evaluation else None
    ours = "" if report is None else rate(report)
    baseline = reports.get(cell.baseline) if cell.baseline else None
    if report is not None and baseline is not None:
        ours += f"; {difference(report, baseline)}"
        if cell.order is not None:
            ours += f" ({order_verdict(report, baseline, cell.order)})"
    elif cell.order is not None:
        return ""
    if cell.published is None:
        return ours
    paper = f"paper {cell.published:.0%}"
    if report is None:
        return f"({paper})"
    return f"{ours} ({paper}: {verdict(report.successes, len(report.trials), cell.published)})"
