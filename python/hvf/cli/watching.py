"""An episode as it happens: a bar that moves by its steps, and a line of how it went."""

from __future__ import annotations

from rich.progress import Progress, TaskID

from hvf.evaluation.acting import Outcome
from hvf.evaluation.recording import Episode, record
from hvf.evaluation.task import Task
from hvf.protocols import Images, Indices


class _Bar:
    """Moves a bar by the steps of one episode (:class:`hvf.evaluation.acting.Watcher`)."""

    def __init__(self, progress: Progress, bar: TaskID, steps: int) -> None:
        self._progress, self._bar = progress, bar
        self.left = steps

    def chosen(self, trial: int) -> None:
        """Subgoals are chosen."""
        self._progress.update(self._bar, description="acting")

    def seen(self, step: int, which: Indices, observations: Images) -> None:
        """Something is seen: nothing to tell."""

    def stepped(self, step: int, which: Indices) -> None:
        """A step was taken."""
        self.left -= 1
        self._progress.update(self._bar, advance=1)


def watch(task: Task, index: int, progress: Progress, bar: TaskID) -> tuple[Outcome, Episode]:
    """Run one episode, while ``bar`` goes on by the steps that it may take at most."""
    progress.update(bar, description="choosing subgoals")
    moving = _Bar(progress, bar, task.steps)
    outcome, (episode,) = record(task, index, 1, [moving])
    progress.update(bar, advance=moving.left)
    return outcome, episode


def how_it_went(name: str, outcome: Outcome) -> str:
    """The outcome of one episode in a line."""
    (trial,) = outcome.trials
    return (
        f"{name}: goal {'reached' if trial.success else 'not reached'} after {trial.steps} steps; "
        f"subgoals in {sum(outcome.search_seconds):.2f} s, "
        f"{1e3 * outcome.acting_seconds / max(outcome.decisions, 1):.1f} ms a step"
    )
