"""``hvf demo``: the main job on a few episodes, with pictures."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console
from rich.progress import Progress

from hvf.cli.plan import how_it_went, watch
from hvf.cli.presets import begin_with_preset as prepare
from hvf.domains.maze import MazeEvaluation, Preset
from hvf.evaluation.task import AgentName

if TYPE_CHECKING:
    from hvf.evaluation.task import EpisodeTask

__all__ = ["DemoMaze", "Shown", "maze", "prepare", "show"]


@dataclasses.dataclass(frozen=True)
class Shown:
    """What is shown of a few episodes, and where.

    Attributes:
        episodes: how many.
        pictures: of how many of them to draw pictures.
        out: folder for the pictures and the results.
    """

    episodes: int = 8
    pictures: int = 3
    out: Path = Path("outputs/demo")

    def __post_init__(self) -> None:
        if self.episodes < 1:
            raise ValueError(f"episodes: must be at least 1, got {self.episodes}")
        if self.pictures < 0:
            raise ValueError(f"pictures: must not be negative, got {self.pictures}")


@dataclasses.dataclass(frozen=True)
class DemoMaze(Shown):
    """A few episodes of the maze.

    Attributes:
        evaluation: which world and difficulty, and how it plans; agent hvf is compared with none.
        preset: settings to begin with; the options below show and change them one by one.
    """

    evaluation: Annotated[MazeEvaluation, tyro.conf.OmitArgPrefixes] = MazeEvaluation()
    preset: Preset = "default"


def maze(config: Annotated[DemoMaze, tyro.conf.arg(name="")]) -> None:
    """Reach goal images in the maze, with subgoals and without; write pictures and a table.

    Searches for subgoal images between the start image and the goal image of each episode, plans
    to each in turn, and acts.
    """

    def task(agent: AgentName) -> EpisodeTask[Any]:
        return dataclasses.replace(config.evaluation, agent=agent).task()

    show(task, config.evaluation.agent, config, f"{config.episodes} episodes of the maze")


def show(
    make: Callable[[AgentName], EpisodeTask[Any]], agent: AgentName, config: Shown, title: str
) -> None:
    """Run the same episodes with an agent and without subgoals; write pictures and a table.

    Args:
        make: the task of an agent.
        agent: the one whose episodes are drawn.
        config: how many, and where.
        title: of the table.
    """
    from hvf.evaluation.pictures import save_film, save_strip
    from hvf.evaluation.run import Report, provenance, records, save, table

    console = Console()
    reports: list[Report] = []
    pictures: list[Path] = []
    agents: tuple[AgentName, ...] = ("none",) if agent == "none" else (agent, "none")
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        bar = progress.add_task("loading", total=None)
        for name in agents:
            task = make(name)
            steps = len(agents) * config.episodes * task.evaluation.acting.steps
            progress.update(bar, total=steps)
            done, seconds = [], 0.0
            for index in range(config.episodes):
                outcome, episode = watch(task, index, progress, bar)
                done += records(outcome, index)
                seconds += outcome.search_seconds + outcome.acting_seconds
                caption = f"{task.name}, episode {index}"
                console.print(how_it_went(caption, outcome), highlight=False)
                if name == agent and len(pictures) < config.pictures:
                    progress.update(bar, description="drawing")
                    stem = config.out / f"episode-{index}"
                    save_strip(episode, stem.with_suffix(".png"), caption)
                    save_film(episode, stem.with_suffix(".gif"), caption)
                    pictures.append(stem)
            report = Report(task.name, task.config, tuple(done), seconds, provenance())
            save(report, config.out / f"{name}.json")
            reports.append(report)
    console.print(table(reports, title))
    for stem in pictures:
        console.print(f"{stem}.png (start, subgoals, goal, path) and {stem}.gif", highlight=False)
    console.print(f"{config.out}/*.json: every trial, all settings and versions", highlight=False)
