"""What an evaluation found, as JSON."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich import box
from rich.table import Table

from hvf.evaluation.statistics import wilson_interval
from hvf.files import write_bytes
from hvf.settings import Planning

FORMAT = 2
"""Version of the JSON that :class:`Report` is written as."""

HEAD = (
    "domain",
    "task",
    "method",
    "subgoals",
    "preset",
    "split",
    "seed",
    "world",
    "kind",
    "planning",
    "weights",
)
"""Settings of an evaluation, in the order in which they are written."""


@dataclasses.dataclass(frozen=True)
class TrialRecord:
    """Outcome of one episode.

    Attributes:
        index: number of the episode.
        success: whether the goal was reached.
        steps: steps taken.
        switches: steps before which the next subgoal was taken.
        search_seconds: wall time of its subgoal search.
        step_seconds: time of deciding on one action: its share of its chunk's.
        error: why it ended before its time, in failure; else None.
    """

    index: int
    success: bool
    steps: int
    switches: tuple[int, ...]
    search_seconds: float
    step_seconds: float
    error: str | None = None


@dataclasses.dataclass(frozen=True)
class Report:
    """What an evaluation found.

    Attributes:
        name: what was evaluated, in a few words.
        domain: name of the domain.
        task: what was to be done.
        method: what acted.
        subgoals: number of subgoals (K); 0 for a method without.
        preset: the settings that this began with.
        split: which episodes; None for those of a seed of one's own.
        seed: of the episodes and of all planning.
        world: names of "dynamics", "generator", "cost" and "method", of those that take part.
        kind: "video", "object" or "simulator"; empty where no model took part.
        planning: all plan settings.
        weights: part to the model that it holds and its SHA-256, for those that took part.
        trials: outcomes, in order of their index.
        wall_seconds: time it took, over all runs if it was resumed.
        code: the code and programs that ran.
    """

    name: str
    domain: str
    task: str
    method: str
    subgoals: int
    preset: str
    split: str | None
    seed: int
    world: Mapping[str, str]
    kind: str
    planning: Mapping[str, Any]
    weights: Mapping[str, Mapping[str, str]]
    trials: tuple[TrialRecord, ...]
    wall_seconds: float
    code: Mapping[str, Any]

    @classmethod
    def of(
        cls,
        name: str,
        head: Mapping[str, Any],
        trials: Sequence[TrialRecord],
        wall_seconds: float,
        code: Mapping[str, Any],
    ) -> Report:
        """A report with the settings in ``head`` (see :data:`HEAD`)."""
        settings = {key: head[key] for key in HEAD}
        return cls(name, **settings, trials=tuple(trials), wall_seconds=wall_seconds, code=code)

    @property
    def head(self) -> dict[str, Any]:
        """All settings."""
        return {key: getattr(self, key) for key in HEAD}

    @property
    def successes(self) -> int:
        """Number of successful trials."""
        return sum(trial.success for trial in self.trials)

    @property
    def success_rate(self) -> float:
        """Fraction of successful trials."""
        return self.successes / len(self.trials)

    @property
    def interval(self) -> tuple[float, float]:
        """95% confidence interval of the success rate (Wilson, 1927)."""
        return wilson_interval(self.successes, len(self.trials))

    @property
    def search_seconds(self) -> float:
        """Mean time of one subgoal search."""
        return sum(trial.search_seconds for trial in self.trials) / len(self.trials)

    @property
    def step_seconds(self) -> float:
        """Mean time of deciding on one action; trials of a chunk share the cores."""
        steps = sum(trial.steps for trial in self.trials)
        return sum(trial.step_seconds * trial.steps for trial in self.trials) / max(steps, 1)

    def differs_from(self, name: str, head: Mapping[str, Any]) -> str:
        """The first setting in which another evaluation differs, in words; empty if none."""
        whole = {**head, "planning": _whole(head["planning"])}
        other = json.loads(json.dumps({key: whole[key] for key in HEAD}))
        own = json.loads(json.dumps(self.head))
        for key in HEAD:
            if own[key] != other[key]:
                found = own[key] if not isinstance(own[key], dict) else _first(own[key], other[key])
                return f"{key} is {found}" if isinstance(found, str | int) else f"other {key}"
        return "" if name == self.name else "another name"

    def to_json(self) -> dict[str, Any]:
        """As written to disk."""
        low, high = self.interval if self.trials else (0.0, 1.0)
        return {
            "format": FORMAT,
            "name": self.name,
            **self.head,
            "successes": self.successes,
            "success_rate": self.success_rate if self.trials else None,
            "confidence_interval_95": [low, high],
            "seconds_per_search": self.search_seconds if self.trials else None,
            "seconds_per_step": self.step_seconds if self.trials else None,
            "wall_seconds": self.wall_seconds,
            "code": self.code,
            "trials": [dataclasses.asdict(trial) for trial in self.trials],
        }


def save(report: Report, out: Path) -> None:
    """Write a report, whole or not at all.

    Raises:
        OSError: the file cannot be written.
    """
    text = json.dumps(report.to_json(), indent=1, allow_nan=False)
    write_bytes(out, f"{text}\n".encode())


def load(path: Path) -> Report:
    """Read a report.

    Raises:
        FileNotFoundError: there is none.
        ValueError: the file is not a report, or is damaged.
    """
    try:
        content = json.loads(path.read_text())
        if content["format"] != FORMAT:
            raise ValueError(f"format {content['format']}")
        _check(content, _TYPES)
        trials = [_trial(entry) for entry in content["trials"]]
        wall = float(content["wall_seconds"])
        content["planning"] = _whole(content["planning"])
        return Report.of(content["name"], content, trials, wall, content["code"])
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{path}: is not an evaluation of this version ({error})") from error


def _whole(planning: Mapping[str, Any]) -> dict[str, Any]:
    """All plan settings: one that was not there yet did what its default does."""
    return {**dataclasses.asdict(Planning()), **planning}


_TYPES: Mapping[str, tuple[type, ...]] = {
    "name": (str,),
    **dict.fromkeys(("domain", "task", "method", "preset", "kind"), (str,)),
    **dict.fromkeys(("world", "planning", "weights", "code"), (dict,)),
    "split": (str, type(None)),
    "subgoals": (int,),
    "seed": (int,),
    "wall_seconds": (float, int),
    "trials": (list,),
}
_TRIAL_TYPES: Mapping[str, tuple[type, ...]] = {
    "index": (int,),
    "success": (bool,),
    "steps": (int,),
    "switches": (list,),
    "search_seconds": (float, int),
    "step_seconds": (float, int),
}


def _check(content: Mapping[str, Any], types: Mapping[str, tuple[type, ...]]) -> None:
    """Refuse entries of other types, and numbers that count or measure nothing."""
    for name, allowed in types.items():
        value = content[name]
        if type(value) not in allowed:
            raise TypeError(f"{name} is of type {type(value).__name__}")
        if isinstance(value, int | float) and not 0 <= value < float("inf"):
            raise ValueError(f"{name} is {value}")


def _trial(entry: Mapping[str, Any]) -> TrialRecord:
    _check(entry, _TRIAL_TYPES)
    switches = tuple(entry["switches"])
    if any(type(step) is not int for step in switches):
        raise TypeError("switches are no steps")
    return TrialRecord(**{**entry, "switches": switches})


def table(reports: Sequence[Report], title: str = "") -> Table:
    """Reports as a table, one in a row."""
    result = Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1))
    result.add_column("evaluation")
    for column in ("success", "95%", "s/search", "ms/step"):
        result.add_column(column, justify="right", no_wrap=True)
    for report in reports:
        low, high = report.interval
        result.add_row(
            report.name,
            f"{report.success_rate:.0%} ({report.successes}/{len(report.trials)})",
            f"{100 * low:.0f}-{high:.0%}",
            f"{report.search_seconds:.2f}" if report.search_seconds > 1e-3 else "-",
            f"{1e3 * report.step_seconds:.1f}",
        )
    return result


def _first(a: Mapping[str, Any], b: Mapping[str, Any]) -> str:
    """The first entry in which two mappings differ, in words."""
    for key in [*a, *b]:
        if a.get(key) != b.get(key):
            return f"with {key} {a.get(key)} there, {b.get(key)} here"
    return "another"
