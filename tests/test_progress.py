"""The progress bar: what it says, and when it says nothing."""

from __future__ import annotations

import io
import re

from rich.console import Console

from hvf.cli.watching import searching, watch
from hvf.evaluation.evaluation import Evaluation
from hvf.evaluation.task import Task
from hvf.progress import Bar, progress
from hvf.settings import Planning


class Clock:
    """Seconds that pass when they are told to."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def terminal(clock: Clock) -> tuple[Console, io.StringIO]:
    output = io.StringIO()
    console = Console(
        file=output, force_terminal=True, width=120, get_time=clock, color_system=None
    )
    return console, output


def last_line(output: io.StringIO) -> str:
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", output.getvalue())
    lines = [line for line in re.split(r"[\r\n]+", text) if "/" in line]
    return " ".join(word for word in lines[-1].split() if set(word) - set("━╸╺"))


def test_a_bar_tells_what_is_done_and_how_long_the_rest_takes() -> None:
    clock = Clock()
    console, output = terminal(clock)
    with progress(console, "acting", 10, "trials", transient=False) as bar:
        for _ in range(4):
            clock.now += 2
            bar.advance(note="[3] reached")
    assert last_line(output) == "acting 4/10 trials [3] reached 0:00:08 left 0:00:12"


def test_work_that_goes_on_once_in_minutes_has_a_time_left_too() -> None:
    clock = Clock()
    console, output = terminal(clock)
    with progress(console, "acting", 5, "trials", transient=False) as bar:
        for _ in range(3):
            clock.now += 200
            bar.advance()
    assert last_line(output).endswith("0:10:00 left 0:06:40")


def test_work_that_was_done_before_counts_but_not_for_its_speed() -> None:
    clock = Clock()
    console, output = terminal(clock)
    with progress(console, "training", 1000, "steps", completed=900, transient=False) as bar:
        for step in (910, 920, 930):
            clock.now += 10
            bar.update(completed=step, note="loss 0.5")
    assert last_line(output) == "training 930/1000 steps loss 0.5 0:00:30 left 0:01:10"


def test_a_total_may_come_later() -> None:
    console, output = terminal(Clock())
    with progress(console, "loading", None, transient=False) as bar:
        bar.update(total=7, description="acting")
        bar.advance(2)
    assert last_line(output).startswith("acting 2/7 0:00:00 left")


def test_nothing_is_shown_where_there_is_no_terminal() -> None:
    output = io.StringIO()
    with progress(Console(file=output), "acting", 3) as bar:
        bar.advance()
    assert output.getvalue() == ""


def test_a_search_moves_a_bar_by_its_iterations() -> None:
    clock = Clock()
    console, output = terminal(clock)
    with searching(console, 2, Planning(subgoal_iterations=4)) as told:
        told(1, 4, 0.25)
        told(3, 4, 0.125)
        clock.now += 1
    shown = output.getvalue()
    assert "searching for 2 subgoals" in shown
    assert "3/4 iterations cost 0.125" in re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", shown)


def test_an_episode_shows_how_its_search_goes_on() -> None:
    said: list[dict[str, object]] = []

    class Noting(Bar):
        def __init__(self) -> None:
            pass

        def update(self, **given: object) -> None:  # type: ignore[override]
            said.append(given)

        def advance(self, count: float = 1, note: str | None = None) -> None:
            said.append({"count": count})

    small = {"samples": 20, "elites": 5, "iterations": 2, "subgoal_samples": 6}
    small |= {"subgoal_elites": 3, "subgoal_iterations": 2, "steps": 3}
    with Task.open(Evaluation.of("maze", dynamics="simulator", subgoals=1, **small)) as task:
        watch(task, 0, Noting())
    notes = [str(given["note"]) for given in said if given.get("note")]
    assert [note.split(",")[0] for note in notes] == ["iteration 1 of 2", "iteration 2 of 2"]
    assert sum(float(str(given["count"])) for given in said if "count" in given) == 3
