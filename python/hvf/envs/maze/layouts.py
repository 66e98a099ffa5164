"""Layouts of the maze: by name, from a TOML file, or as they are.

A file says what :class:`hvf_core.MazeLayout` takes, with a table for each wall. Lengths are
metres, angles degrees; the arena reaches up to 0.3 m from its centre::

    arena = [0.3, 0.3]                       # half-widths; may be left out
    start = [-0.27, -0.20, -0.27, 0.27]      # low x, high x, low y, high y
    goal = [0.20, 0.27, -0.27, 0.27]

    [[walls]]
    centre = [0.0, 0.0]
    half = [0.005, 0.3]                      # half extents along its own two axes
    angle = 30                               # anticlockwise; may be left out
    gap = { half = 0.05, range = [-0.2, 0.2] }   # along the second axis; may be left out
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from hvf_core import MAZE_LAYOUTS, MazeLayout

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

LayoutLike: TypeAlias = MazeLayout | str | Path
"""A layout, its name, or a TOML file."""

NAMES = ", ".join(MAZE_LAYOUTS)
"""Names of layouts, for messages and help."""

_KEYS = ("name", "arena", "start", "goal", "walls")
_WALL_KEYS = ("centre", "half", "angle", "gap")
_GAP_KEYS = ("half", "range")


def layout_of(layout: LayoutLike) -> MazeLayout:
    """The layout that is meant.

    Args:
        layout: a layout; a name, such as ``"corridor-4"`` or ``"spiral"``; or the path of a TOML
            file (ends in ``.toml``).

    Raises:
        ValueError: a name that there is not, or a file that is no layout.
        FileNotFoundError: there is no such file.
        TypeError: something else.
    """
    if isinstance(layout, MazeLayout):
        return layout
    if isinstance(layout, Path) or (isinstance(layout, str) and layout.endswith(".toml")):
        return read_layout(Path(layout))
    if isinstance(layout, str):
        try:
            return MazeLayout.preset(layout)
        except ValueError as error:
            raise ValueError(f"{error}, nor a file that ends in .toml") from None
    raise TypeError(
        f"layout: expected a MazeLayout, a name or a TOML file, got {type(layout).__name__}"
    )


def read_layout(path: Path) -> MazeLayout:
    """A layout from a TOML file; see the module's documentation.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not TOML, has a key that there is not or lacks one, or says a layout that
            cannot be; names the file.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise FileNotFoundError(f"layout: there is no file {path}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"layout: {path} is not TOML: {error}") from error
    try:
        return _made(content, path.stem)
    except (ValueError, TypeError) as error:
        raise ValueError(f"layout: {path}: {error}") from error


def _made(content: Mapping[str, Any], stem: str) -> MazeLayout:
    _check_keys("the file", content, _KEYS, ("start", "goal"))
    walls, gaps = [], []
    tables = content.get("walls", [])
    if not isinstance(tables, list):
        raise ValueError(f"walls: must be tables, [[walls]], got {tables!r}")
    for index, wall in enumerate(tables):
        name = f"walls[{index}]"
        _check_keys(name, wall, _WALL_KEYS, ("centre", "half"))
        centre = _numbers(f"{name}.centre", wall["centre"], 2)
        half = _numbers(f"{name}.half", wall["half"], 2)
        angle = _numbers(f"{name}.angle", [wall.get("angle", 0.0)], 1)
        walls.append([*centre, *half, *angle])
        if "gap" in wall:
            gap = wall["gap"]
            _check_keys(f"{name}.gap", gap, _GAP_KEYS, _GAP_KEYS)
            opening = _numbers(f"{name}.gap.half", [gap["half"]], 1)
            gaps.append([index, *opening, *_numbers(f"{name}.gap.range", gap["range"], 2)])
    return MazeLayout(
        str(content.get("name", stem)),
        walls,
        start=_numbers("start", content["start"], 4),
        goal=_numbers("goal", content["goal"], 4),
        arena=_numbers("arena", content.get("arena", [0.3, 0.3]), 2),
        gaps=gaps,
    )


def _check_keys(where: str, table: Any, known: Sequence[str], needed: Sequence[str]) -> None:
    if not isinstance(table, Mapping):
        raise ValueError(f"{where}: must be a table, got {table!r}")
    for key in table:
        if key not in known:
            raise ValueError(f"{where}: no key {key!r}; keys are {', '.join(known)}")
    for key in needed:
        if key not in table:
            raise ValueError(f"{where}: needs {key!r}")


def _numbers(where: str, value: Any, count: int) -> list[float]:
    numbers = isinstance(value, list) and all(
        isinstance(number, int | float) and not isinstance(number, bool) for number in value
    )
    if not numbers or len(value) != count:
        raise ValueError(f"{where}: must be {count} numbers, got {value!r}")
    return [float(number) for number in value]


def fingerprint(layout: MazeLayout) -> str:
    """A layout's name and, unless it is one of those that come along, a checksum of what it is."""
    try:
        if MazeLayout.preset(layout.name) == layout:
            return layout.name
    except ValueError:
        pass
    parts = (layout.walls, layout.gaps, layout.start, layout.goal, layout.arena)
    digest = hashlib.sha256(b"".join(np.asarray(part, "<f8").tobytes() for part in parts))
    return f"{layout.name} ({digest.hexdigest()[:8]})"


def state_names(layout: MazeLayout) -> list[str]:
    """What the numbers of a state are, ``[S]``."""
    return ["agent_x", "agent_y", *(f"gap {index}" for index in range(layout.columns - 2))]
