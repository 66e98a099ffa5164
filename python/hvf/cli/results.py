"""``hvf results``: evaluations as a table for the README."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeAlias, get_args

import tyro

from hvf.domains.maze import Difficulty, MazeEvaluation
from hvf.evaluation.run import Report, load
from hvf.evaluation.task import AGENTS, TEST_SEED, AgentName, Evaluation, agent_name

Published: TypeAlias = Mapping[tuple[AgentName, int], Mapping[str, float]]

# Weights that only draw subgoals.
_DRAW_SUBGOALS = ("keypoint_generator", "desk_generator", "vae")


@dataclasses.dataclass(frozen=True)
class Layout:
    """What the table of one environment has.

    Attributes:
        environment: its name.
        key: setting that the columns are for.
        columns: its values.
        evaluation: settings of its evaluations.
        published: success rates that Nair & Finn (ICLR 2020) give in numbers, 100 trials each.
    """

    environment: str
    key: str
    columns: tuple[str, ...]
    evaluation: type[Evaluation]
    published: Published = dataclasses.field(default_factory=dict)


MAZE = Layout(
    "maze",
    "difficulty",
    get_args(Difficulty),
    MazeEvaluation,
    # Pixel cost without subgoals, and numbers of subgoals on hard. Their other results are in a
    # bar chart only.
    {
        ("none", 0): {"easy": 0.93, "medium": 0.68, "hard": 0.33},
        ("hvf", 1): {"hard": 0.47},
        ("hvf", 2): {"hard": 0.54},
    },
)


class Row(NamedTuple):
    """What the evaluations in one row of the table share."""

    settings: str
    world: str
    agent: AgentName
    subgoals: int

    @property
    def agent_name(self) -> str:
        """As the table has it."""
        return agent_name(self.agent, self.subgoals)


@dataclasses.dataclass(frozen=True)
class ResultsMaze:
    """A table of evaluations of the maze.

    Attributes:
        folder: the JSON files that ``hvf eval maze`` wrote.
    """

    folder: tyro.conf.Positional[Path]


def maze(config: Annotated[ResultsMaze, tyro.conf.arg(name="")]) -> None:
    """Print the evaluations in a folder as a Markdown table, with the paper's results below.

    Cells are success rates with 95% Wilson intervals, and the number of trials if it is not 100.
    Example: hvf results maze results/maze
    """
    print(markdown(read(config.folder), MAZE))


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


def markdown(reports: Mapping[Path, Report], layout: Layout) -> str:
    """Reports as a Markdown table.

    Args:
        reports: evaluations of one environment, by the file that they are from.
        layout: of its table.

    Raises:
        ValueError: a report of something else, or two of the same thing that disagree.
    """
    rows: dict[Row, dict[str, Report]] = {}
    for path, report in reports.items():
        if not report.trials:
            continue
        row, column = _place(path, report, layout)
        other = rows.setdefault(row, {}).setdefault(column, report)
        if _outcomes(other) != _outcomes(report):
            raise ValueError(
                f"folder: {path} and another file are of the same evaluation ({report.name}, "
                f"{row.settings}) with different results"
            )
    columns = layout.columns
    lines = [
        _line(["settings", "world", "agent", *columns, "s/search", "ms/step"]),
        f"|---|---|---|{'---:|' * (len(columns) + 2)}",
    ]
    for row in sorted(rows, key=_order):
        cells = rows[row]
        rates = [_cell(cells[name]) if name in cells else "" for name in columns]
        lines.append(_line([*row[:2], row.agent_name, *rates, *_seconds(cells.values())]))
    for (agent, subgoals), published in layout.published.items():
        row = Row("ICLR 2020, tables", "learned (SV2P)", agent, subgoals)
        rates = [f"{published[name]:.0%}" if name in published else "" for name in columns]
        lines.append(_line([*row[:2], row.agent_name, *rates, "", ""]))
    return "\n".join([*lines, *_notes(rows)])


def _place(path: Path, report: Report, layout: Layout) -> tuple[Row, str]:
    """Row and column of a report."""
    wrong = f"{path}: is not an evaluation of the {layout.environment}"
    try:
        config = report.config
        agent, subgoals, column = config["agent"], config["subgoals"], config[layout.key]
        searches = agent == "hvf"
        settings = _settings(config["planning"], config["seed"], layout.evaluation, searches)
        generator = config.get("generator", "default")
        drawn_by = "" if generator == "default" else f" ({generator})"
        world = config["model"] + (drawn_by if agent == "hvf" else "")
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{wrong} ({error})") from error
    if agent not in AGENTS or column not in layout.columns:
        raise ValueError(f"{wrong} ({agent}, {column})")
    if agent == "random":
        settings, world = "", ""
    return Row(settings, world, agent, 0 if agent in ("none", "random") else subgoals), column


def _settings(
    planning: Mapping[str, Any], seed: int, evaluation: type[Evaluation], searches: bool
) -> str:
    """The nearest preset, and in what the settings differ from it.

    How subgoals are searched for is no setting of an agent that does not search.
    """
    found = dataclasses.asdict(type(evaluation.presets["default"])(**planning))
    differences: dict[str, dict[str, Any]] = {}
    for preset, settings in evaluation.presets.items():
        named = dataclasses.asdict(settings)
        differences[preset] = {
            name: value
            for name, value in found.items()
            if value != named[name] and (searches or not name.startswith("subgoal_"))
        }
    nearest = min(differences, key=lambda preset: len(differences[preset]))
    words = [nearest, *(f"{name} {value}" for name, value in differences[nearest].items())]
    return ", ".join(words if seed == TEST_SEED else [*words, f"seed {seed}"])


def _order(row: Row) -> tuple[bool, str, str, int, int]:
    """Random last; learned models before the simulator; few subgoals first."""
    agents = ("none", "hvf", "ground-truth", "random")
    return row.agent == "random", row.settings, row.world, agents.index(row.agent), row.subgoals


def _cell(report: Report) -> str:
    low, high = report.interval
    count = "" if len(report.trials) == 100 else f" (n = {len(report.trials)})"
    return f"{report.success_rate:.0%} [{100 * low:.0f}, {100 * high:.0f}]{count}"


def _seconds(reports: Iterable[Report]) -> tuple[str, str]:
    """Mean seconds per search and milliseconds per step over all trials of a row."""
    first, *others = reports
    trials = first.trials + tuple(trial for report in others for trial in report.trials)
    pooled = dataclasses.replace(first, trials=trials)
    search = f"{pooled.search_seconds:.2f}" if pooled.search_seconds > 1e-3 else ""
    return search, f"{1e3 * pooled.step_seconds:.1f}"


def _notes(rows: Mapping[Row, Mapping[str, Report]]) -> list[str]:
    """What a reader has to know about the rows: code that made them, weights that differ.

    What draws subgoals does not matter to an agent that does not search.
    """
    all_reports = [report for cells in rows.values() for report in cells.values()]
    commits = {str(report.provenance.get("commit")) for report in all_reports}
    short = sorted(" ".join([commit[:10], *commit.split()[1:]]) for commit in commits)
    weights: dict[str, set[str]] = {}
    for report in all_reports:
        idle = () if report.config["agent"] == "hvf" else _DRAW_SUBGOALS
        for name, checksum in report.config.get("sha256", {}).items():
            if name in idle:
                continue
            weights.setdefault(name, set()).add(checksum)
    mixed = [name for name, sums in weights.items() if len(sums) > 1]
    notes = ["", f"Code: {', '.join(short)}."]
    if mixed:
        notes.append(f"Not all rows are of the same weights: {', '.join(mixed)} differ.")
    return notes


def _outcomes(report: Report) -> list[tuple[int, bool]]:
    return [(trial.index, trial.success) for trial in report.trials]


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"
