"""Work as it happens: a bar that moves by an episode's steps or a search's iterations."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from rich.console import Console

from hvf.agents.planning import PlanningAgent
from hvf.agents.subgoals import Searched
from hvf.evaluation.acting import Outcome
from hvf.evaluation.recording import Episode, record
from hvf.evaluation.task import Task
from hvf.progress import Bar, progress
from hvf.protocols import Images, Indices
from hvf.settings import Planning


@contextlib.contextmanager
def searching(
    console: Console, subgoals: int, planning: Planning
) -> Iterator[Callable[[int, int, float], None]]:
    """Show a bar that moves by the iterations of one search; gives what the search should tell."""
    total = planning.subgoal_iterations
    with progress(console, f"searching for {subgoals} subgoals", total, "iterations") as bar:

        def told(iteration: int, iterations: int, cost: float) -> None:
            bar.update(completed=iteration, total=iterations, note=f"cost {cost:.3g}")

        yield told


class _Bar:
    """Moves a bar by the steps of one episode (:class:`hvf.evaluation.acting.Watcher`)."""

    def __init__(self, bar: Bar, steps: int) -> None:
        self._bar = bar
        self.left = steps

    def searched(self, iteration: int, iterations: int, cost: float) -> None:
        """An iteration of a search is done."""
        self._bar.update(note=f"iteration {iteration} of {iterations}, cost {cost:.3g}")

    def chosen(self, trial: int) -> None:
        """Subgoals are chosen."""
        self._bar.update(description="acting", note="")

    def seen(self, step: int, which: Indices, observations: Images) -> None:
        """Something is seen: nothing to tell."""

    def stepped(self, step: int, which: Indices) -> None:
        """A step was taken."""
        self.left -= 1
        self._bar.advance(1)


def watch(task: Task, index: int, bar: Bar) -> tuple[Outcome, Episode]:
    """Run one episode, while ``bar`` goes on by the steps that it may take at most."""
    bar.update(description="choosing subgoals")
    moving = _Bar(bar, task.steps)
    if isinstance(task.agent, PlanningAgent) and isinstance(task.agent.source, Searched):
        task.agent.source.progress = moving.searched
    outcome, (episode,) = record(task, index, 1, [moving])
    bar.advance(moving.left, note="")
    return outcome, episode


def how_it_went(name: str, outcome: Outcome) -> str:
    """The outcome of one episode in a line."""
    (trial,) = outcome.trials
    return (
        f"{name}: goal {'reached' if trial.success else 'not reached'} after {trial.steps} steps; "
        f"subgoals in {sum(outcome.search_seconds):.2f} s, "
        f"{1e3 * outcome.acting_seconds / max(outcome.decisions, 1):.1f} ms a step"
    )
