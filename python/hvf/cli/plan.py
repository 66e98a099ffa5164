"""``hvf plan``: one episode, with pictures."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console
from rich.progress import Progress, TaskID

from hvf.cli.presets import begin_with_preset as prepare
from hvf.domains.maze import MazeEvaluation, Preset

if TYPE_CHECKING:
    from hvf.evaluation.acting import Indices, Outcome
    from hvf.evaluation.recording import DrawableTrials, Episode
    from hvf.evaluation.task import EpisodeTask

__all__ = ["Drawn", "PlanMaze", "draw", "how_it_went", "maze", "prepare", "watch"]


@dataclasses.dataclass(frozen=True)
class Drawn:
    """Which episode is drawn, and where.

    Attributes:
        episode: number of the episode.
        out: folder for the pictures.
        film: kind of the film; mp4 needs ``pip install imageio[ffmpeg]``.
    """

    episode: int = 0
    out: Path = Path("outputs/plan")
    film: Annotated[str, tyro.conf.arg(constructor=str)] = "gif"

    def __post_init__(self) -> None:
        if self.episode < 0:
            raise ValueError(f"episode: must not be negative, got {self.episode}")
        if self.film not in ("gif", "mp4"):
            raise ValueError(f"film: must be 'gif' or 'mp4', got {self.film!r}")


@dataclasses.dataclass(frozen=True)
class PlanMaze(Drawn):
    """One episode of the maze.

    Attributes:
        evaluation: which agent, world and difficulty, and how it plans.
        preset: settings to begin with; the options below show and change them one by one.
    """

    evaluation: Annotated[MazeEvaluation, tyro.conf.OmitArgPrefixes] = MazeEvaluation()
    preset: Preset = "default"


def maze(config: Annotated[PlanMaze, tyro.conf.arg(name="")]) -> None:
    """Plan and act in one episode of the maze; write a picture of the plan and a film.

    The picture shows start, subgoals, goal and the path taken; the film shows the episode beside
    what it aims at. Example:

        hvf plan maze --difficulty hard --episode 3
    """
    draw(config.evaluation.task(), config)


def draw(task: EpisodeTask[DrawableTrials], config: Drawn) -> None:
    """Run one episode, write its pictures, and say how it went."""
    from hvf.evaluation.pictures import save_film, save_strip

    console = Console()
    name = f"{task.name}, episode {config.episode}"
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        bar = progress.add_task("", total=task.evaluation.acting.steps)
        outcome, episode = watch(task, config.episode, progress, bar)
    stem = config.out / f"episode-{config.episode}"
    save_strip(episode, stem.with_suffix(".png"), name)
    save_film(episode, stem.with_suffix(f".{config.film}"), name)
    console.print(how_it_went(name, outcome), highlight=False)
    console.print(f"{stem.with_suffix('.png')} and {stem.with_suffix('.' + config.film)}")


def watch(
    task: EpisodeTask[DrawableTrials], index: int, progress: Progress, bar: TaskID
) -> tuple[Outcome, Episode]:
    """Run one episode, while ``bar`` goes on by the steps that it may take at most."""
    from hvf.evaluation.recording import record

    left = task.evaluation.acting.steps
    progress.update(bar, description="choosing subgoals")

    def stepped(step: int, which: Indices) -> None:
        nonlocal left
        left -= 1
        progress.update(bar, description="acting", advance=1)

    outcome, (episode,) = record(task, index, 1, stepped)
    progress.update(bar, advance=left)
    return outcome, episode


def how_it_went(name: str, outcome: Outcome) -> str:
    """The outcome of one episode in a line."""
    (trial,) = outcome.trials
    return (
        f"{name}: goal {'reached' if trial.success else 'not reached'} after {trial.steps} steps; "
        f"subgoals in {outcome.search_seconds:.2f} s, "
        f"{1e3 * outcome.acting_seconds / max(outcome.decisions, 1):.1f} ms a step"
    )
