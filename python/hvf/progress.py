"""The progress bar of all long work: what is done, for how long, and how long it will take."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

# Seconds whose speed tells the time left. Rich's own 30 know nothing of work that goes on once a
# minute.
_MEMORY = 3600.0


class Bar:
    """A bar that is on show."""

    def __init__(self, progress: Progress, task: TaskID) -> None:
        self._progress = progress
        self._task = task

    def advance(self, count: float = 1, note: str | None = None) -> None:
        """Go on by ``count`` units."""
        self._progress.update(self._task, advance=count, **_given(note=note))

    def update(
        self,
        *,
        completed: float | None = None,
        total: float | None = None,
        description: str | None = None,
        note: str | None = None,
    ) -> None:
        """Set what is given: units done, units in all, and the words before and after them."""
        given = _given(completed=completed, total=total, description=description, note=note)
        self._progress.update(self._task, **given)


@contextlib.contextmanager
def progress(
    console: Console,
    description: str,
    total: float | None,
    unit: str = "",
    *,
    completed: int = 0,
    note: str = "",
    transient: bool = True,
) -> Iterator[Bar]:
    """Show a bar while the block runs, if ``console`` is a terminal.

    ``collecting maze ━━━━╸━━━━ 450/1000 episodes, 2 diverged, 0:00:05, left 0:00:07``

    Args:
        console: where it is shown.
        description: what is being done.
        total: units of work in all; None if that is not known.
        unit: what they are: ``"episodes"``.
        completed: units that were done before.
        note: anything else that changes, such as a loss; see :meth:`Bar.update`.
        transient: whether the bar goes away at the end.
    """
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        *([TextColumn(unit, markup=False)] if unit else []),
        TextColumn("{task.fields[note]}", markup=False),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(
        *columns,
        console=console,
        disable=not console.is_terminal,
        transient=transient,
        speed_estimate_period=_MEMORY,
    ) as shown:
        task = shown.add_task(description, total=total, completed=completed, note=note)
        yield Bar(shown, task)


def _given(**settings: Any) -> dict[str, Any]:
    return {name: value for name, value in settings.items() if value is not None}
