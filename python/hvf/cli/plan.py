"""``hvf plan``: one episode, with pictures."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from hvf.cli.presets import begin_with_preset as prepare
from hvf.evaluation.maze import MazeEvaluation, Preset

if TYPE_CHECKING:
    from hvf.evaluation.recording import DrawableTrials
    from hvf.evaluation.task import EpisodeTask

__all__ = ["Drawn", "PlanMaze", "draw", "maze", "prepare"]


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
    from hvf.evaluation.recording import record

    console = Console()
    outcome, (episode,) = record(task, config.episode, 1)
    name = f"{task.name}, episode {config.episode}"
    stem = config.out / f"episode-{config.episode}"
    save_strip(episode, stem.with_suffix(".png"), name)
    save_film(episode, stem.with_suffix(f".{config.film}"), name)
    verdict = "reached" if episode.trial.success else "not reached"
    console.print(
        f"{name}: goal {verdict} after {episode.trial.steps} steps; "
        f"subgoals in {outcome.search_seconds:.2f} s, "
        f"{1e3 * outcome.acting_seconds / max(outcome.decisions, 1):.1f} ms a step",
        highlight=False,
    )
    console.print(f"{stem.with_suffix('.png')} and {stem.with_suffix('.' + config.film)}")
