"""``hvf paper``: the paper's tables as lists of evaluations.

A domain's experiments are a function from :class:`Setup` (preset, world, split) to tables of
:class:`Cell`, registered in :data:`EXPERIMENTS`. Cells of several tables are evaluated once.

Numbers of the paper (Nair & Finn, ICLR 2020) are success rates over 100 trials. A *verdict* says
how ours compares: ``higher`` or ``lower`` if the 95% interval of the difference of the two rates
(Newcombe's hybrid score interval for separate samples, the paper's rate as so many successes of
100) lies on one side of 0; else ``agrees``, which means that so many trials show no difference,
not that there is none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from hvf.evaluation.evaluation import Evaluation
from hvf.evaluation.report import Report
from hvf.evaluation.statistics import difference_interval
from hvf.experiments.parallel import Failure, report_of, run_all
from hvf.experiments.tables import line, notes, rate
from hvf.registry import METHODS

PUBLISHED_TRIALS = 100
"""Trials behind each number of the paper."""

LEGEND = (
    "Success with its 95% Wilson interval; behind it the paper's number, where it gives one, and "
    "whether ours is higher or lower, or agrees: the 95% interval of the difference (Newcombe's, "
    "for separate samples of which the paper's has 100 trials) lies above 0, below, or around it."
)


@dataclass(frozen=True)
class Setup:
    """What all evaluations of an experiment share.

    Attributes:
        domain: where.
        preset: settings that they begin with.
        dynamics: what they plan with; None for the preset's.
        generator: what draws subgoals; None for the preset's.
        split: which episodes.
    """

    domain: str
    preset: str = "paper"
    dynamics: str | None = None
    generator: str | None = None
    split: str = "test"

    def evaluation(self, method: str, subgoals: int = 0, **settings: object) -> Evaluation:
        """One of them.

        Raises:
            ValueError, TypeError: a setting that there is not, or out of range.
        """
        world = {"dynamics": self.dynamics, "generator": self.generator}
        named = {name: value for name, value in world.items() if value is not None}
        settings = {"method": method, "subgoals": subgoals, "split": self.split} | settings
        return Evaluation.of(self.domain, self.preset, **named, **settings)

    @property
    def options(self) -> str:
        """As options of the command."""
        words = [f"--preset {self.preset}"]
        words += [f"--world {self.dynamics}"] if self.dynamics else []
        words += [f"--generator {self.generator}"] if self.generator else []
        words += [f"--split {self.split}"] if self.split != "test" else []
        return " ".join(words)


@dataclass(frozen=True)
class Cell:
    """A number of a table.

    Attributes:
        evaluation: gives ours; None where there is none to have.
        published: the paper's, as a fraction; None where it is in a figure only.
    """

    evaluation: Evaluation | None
    published: float | None = None


@dataclass(frozen=True)
class PaperTable:
    """A table.

    Attributes:
        name: for ``--only``.
        title: what it shows.
        corner: what the rows are.
        columns: names.
        rows: name to cells, one a column.
    """

    name: str
    title: str
    corner: str
    columns: tuple[str, ...]
    rows: Mapping[str, tuple[Cell, ...]]

    def __post_init__(self) -> None:
        for name, cells in self.rows.items():
            if len(cells) != len(self.columns):
                raise ValueError(f"rows: {name} must have {len(self.columns)} cells")

    @property
    def evaluations(self) -> list[Evaluation]:
        """All that it needs, without repetition."""
        cells = [cell for row in self.rows.values() for cell in row]
        return list(dict.fromkeys(cell.evaluation for cell in cells if cell.evaluation))


Published = Mapping[str, Mapping[int, float]]

_BY_SUBGOALS = {0: 0.33, 1: 0.47, 2: 0.54, 3: 0.39, 5: 0.02, 10: 0.0}
_BY_REDUCTION: Published = {"max": {1: 0.47, 2: 0.54}, "mean": {1: 0.45, 2: 0.53}}
_BY_SAMPLES: Published = {
    "200": {0: 0.33, 1: 0.47, 2: 0.54},
    "1000": {0: 0.35, 1: 0.54, 2: 0.55},
}
_BY_HORIZON: Published = {
    "5": {0: 0.33, 1: 0.47, 2: 0.54},
    "10": {0: 0.46, 1: 0.55, 2: 0.37},
    "15": {0: 0.31, 1: 0.39, 2: 0.24},
}
_BY_COST = {
    "pixel": {"easy": 0.93, "medium": 0.68, "hard": 0.33},
    "latent": {"easy": 0.62, "medium": 0.49, "hard": 0.23},
}
_METHODS = (
    ("none", 0),
    ("hvf", 1),
    ("hvf", 2),
    ("tap", 1),
    ("tap", 2),
    ("ground-truth", 1),
    ("ground-truth", 2),
    ("random", 0),
)
"""Methods of the paper's figure, and acting at random; those that there are become rows."""


def maze(setup: Setup) -> list[PaperTable]:
    """The maze's tables. Methods are a bar chart in the paper, with few numbers in the text.

    Elites and the steps towards a subgoal stay as they are when samples or the horizon change.
    """
    difficulties = ("easy", "medium", "hard")

    def subgoals(count: int, **settings: object) -> Evaluation:
        return setup.evaluation("hvf" if count else "none", count, task="hard", **settings)

    def grid(
        name: str, title: str, corner: str, numbers: Published, settings: Callable[[str], object]
    ) -> PaperTable:
        counts = next(iter(numbers.values()))
        rows = {
            row: tuple(
                Cell(subgoals(count, **{corner: settings(row)}), published)
                for count, published in values.items()
            )
            for row, values in numbers.items()
        }
        return PaperTable(name, title, corner, tuple(map(_counted, counts)), rows)

    def methods(method: str, count: int) -> tuple[Cell, ...]:
        numbers = {"hard": _BY_SUBGOALS[count]} if method == "hvf" else {}
        published = _BY_COST["pixel"] if method == "none" else numbers
        return tuple(
            Cell(setup.evaluation(method, count, task=task), published.get(task))
            for task in difficulties
        )

    def cost(name: str) -> tuple[Cell, ...]:
        # A simulator has states, no latents.
        possible = name == "pixel" or setup.dynamics != "simulator"
        return tuple(
            Cell(setup.evaluation("none", task=task, cost=name) if possible else None, number)
            for task, number in _BY_COST[name].items()
        )

    return [
        PaperTable(
            "methods",
            "Methods by difficulty",
            "method",
            difficulties,
            {
                METHODS[method].label(count): methods(method, count)
                for method, count in _METHODS
                if method in METHODS
            },
        ),
        PaperTable(
            "subgoals",
            "Number of subgoals, hard",
            "subgoals",
            ("success",),
            {str(k): (Cell(subgoals(k), number),) for k, number in _BY_SUBGOALS.items()},
        ),
        grid(
            "reduction",
            "Cost of a sample: the maximum or the mean over its segments, hard",
            "reduction",
            _BY_REDUCTION,
            str,
        ),
        grid("samples", "Samples of the search for actions (D), hard", "samples", _BY_SAMPLES, int),
        grid("horizon", "Planning horizon (H), hard", "horizon", _BY_HORIZON, int),
        PaperTable(
            "cost",
            "Cost without subgoals: pixels, or the latent of the VAE",
            "cost",
            difficulties,
            {name: cost(name) for name in _BY_COST},
        ),
    ]


EXPERIMENTS: Mapping[str, Callable[[Setup], list[PaperTable]]] = {"maze": maze}
"""Domain to its tables."""


def tables(setup: Setup, only: Sequence[str] = ()) -> list[PaperTable]:
    """The tables of a domain, or some of them.

    Raises:
        ValueError: a domain or table that there is not, or settings out of range.
    """
    if setup.domain not in EXPERIMENTS:
        known = ", ".join(EXPERIMENTS)
        raise ValueError(f"domain: the paper's tables are of {known}; got {setup.domain!r}")
    found = {table.name: table for table in EXPERIMENTS[setup.domain](setup)}
    for name in only:
        if name not in found:
            raise ValueError(f"only: must be of {', '.join(found)}; got {name!r}")
    return [table for name, table in found.items() if not only or name in only]


def files(chosen: Sequence[PaperTable], folder: Path) -> dict[Evaluation, Path]:
    """The evaluations of tables, each once, and their files."""
    return {
        evaluation: folder / f"{evaluation.slug}.json"
        for table in chosen
        for evaluation in table.evaluations
    }


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
            f"`hvf paper {options} --only {table.name}`",
            "",
        ]
    return "\n".join([*lines, LEGEND, *(notes(reports.values()) if reports else [])])


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


def _words(cell: Cell, reports: Mapping[Evaluation, Report]) -> str:
    report = reports.get(cell.evaluation) if cell.evaluation else None
    ours = "" if report is None else rate(report)
    if cell.published is None:
        return ours
    paper = f"paper {cell.published:.0%}"
    if report is None:
        return f"({paper})"
    return f"{ours} ({paper}: {verdict(report.successes, len(report.trials), cell.published)})"


def _counted(subgoals: int) -> str:
    return "no subgoals" if not subgoals else f"{subgoals} subgoal{'s' if subgoals > 1 else ''}"
