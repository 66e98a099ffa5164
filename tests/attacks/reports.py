"""Reports of evaluations that lie."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hvf.evaluation.report import load

GENUINE = next(iter(sorted((Path(__file__).parents[2] / "results" / "maze").glob("*.json"))))


def attempt(path: Path) -> object:
    """Open an attack as a user would, and ask for what tables show."""
    report = load(path)
    return report.interval, report.success_rate, report.search_seconds


def changed(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """The genuine report, changed."""
    content = json.loads(GENUINE.read_text())
    change(content)
    path.write_text(json.dumps(content))


def trial(path: Path, **fields: Any) -> None:
    """The genuine report with other fields of its first trial."""
    changed(path, lambda content: content["trials"][0].update(fields))


ATTACKS: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.write_bytes(b""),
    "no text": lambda path: path.write_bytes(b"\xff\xfe\0\x80" * 100),
    "nested 100,000 deep": lambda path: path.write_text("[" * 100_000),
    "a number": lambda path: path.write_text("7"),
    "a list": lambda path: path.write_text("[]"),
    "null": lambda path: path.write_text("null"),
    "number of 5,000 digits": lambda path: path.write_text('{"format": 1' + "0" * 5_000 + "}"),
    "trials that are a number": lambda path: changed(path, lambda all_: all_.update(trials=3)),
    "trials that are words": lambda path: changed(path, lambda all_: all_.update(trials="abc")),
    "trial with unknown fields": lambda path: trial(path, __class__="os"),
    "trial whose success is a word": lambda path: trial(path, success="yes"),
    "trial of NaN seconds": lambda path: trial(path, search_seconds=float("nan")),
    "trial of fewer than no steps": lambda path: trial(path, steps=-4),
    "trial that switches at words": lambda path: trial(path, switches=["a", None]),
    "task that is a list": lambda path: changed(path, lambda all_: all_.update(task=["a"])),
    "subgoals below zero": lambda path: changed(path, lambda all_: all_.update(subgoals=-1)),
    "code that is a number": lambda path: changed(path, lambda all_: all_.update(code=3)),
    "planning that is a word": lambda path: changed(path, lambda all_: all_.update(planning="x")),
    "no planning": lambda path: changed(path, lambda all_: all_.pop("planning")),
    "wall time without end": lambda path: changed(
        path, lambda all_: all_.update(wall_seconds=float("inf"))
    ),
}
