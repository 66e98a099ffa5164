"""``hvf demo``: the main job on a few episodes, with pictures."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.progress import Progress

from hvf.cli.presets import begin_with_preset as prepare
from hvf.evaluation.maze import MazeEvaluation, Preset
from hvf.evaluation.task import AgentName

__all__ = ["maze", "prepare"]


@dataclasses.dataclass(frozen=True)
class DemoMaze:
    """A few episodes of the maze.

    Attributes:
        evaluation: which world and difficulty, and how it plans; agent hvf is compared with none.
        episodes: how many.
        pictures: of how many of them to draw pictures.
        preset: settings to begin with; the options below show and change them one by one.
        out: folder for the pictures and the results.
    """

    evaluation: Annotated[MazeEvaluation, tyro.conf.OmitArgPrefixes] = MazeEvaluation()
    episodes: int = 8
    pictures: int = 3
    preset: Preset = "default"
    out: Path = Path("outputs/demo")

    def __post_init__(self) -> None:
        if self.episodes < 1:
            raise ValueError(f"episodes: must be at least 1, got {self.episodes}")
        if self.pictures < 0:
            raise ValueError(f"pictures: must not be negative, got {self.pictures}")


def maze(config: Annotated[DemoMaze, tyro.conf.arg(name="")]) -> None:
    """Reach goal images in the maze, with subgoals and without; write pictures and a table.

    Searches for subgoal images between the start image and the goal image of each episode, plans
    to each in turn, and acts.
    """
    from hvf.evaluation.evaluate import Report, provenance, records, save, table
    from hvf.evaluation.pictures import save_film, save_strip
    from hvf.evaluation.recording import record

    console = Console()
    reports: list[Report] = []
    pictures: list[Path] = []
    agents: tuple[AgentName, ...] = (config.evaluation.agent, "none")
    steps = len(agents) * config.episodes + config.pictures
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        bar = progress.add_task("acting", total=steps)
        for agent in agents:
            evaluation = dataclasses.replace(config.evaluation, agent=agent)
            task = evaluation.task()
            done, seconds = [], 0.0
            for index in range(config.episodes):
                outcome, (episode,) = record(task, index, 1)
                done += records(outcome, index)
                seconds += outcome.search_seconds + outcome.acting_seconds
                progress.advance(bar)
                if agent == agents[0] and len(pictures) < config.pictures:
                    progress.update(bar, description="drawing")
                    stem = config.out / f"episode-{index}"
                    name = f"{task.name}, episode {index}"
                    save_strip(episode, stem.with_suffix(".png"), name)
                    save_film(episode, stem.with_suffix(".gif"), name)
                    pictures.append(stem)
                    progress.update(bar, description="acting", advance=1)
            report = Report(task.name, task.config, tuple(done), seconds, provenance())
            save(report, config.out / f"{agent}.json")
            reports.append(report)
    console.print(table(reports, f"{config.episodes} episodes of the maze"))
    for stem in pictures:
        console.print(f"{stem}.png (start, subgoals, goal, path) and {stem}.gif", highlight=False)
    console.print(f"{config.out}/*.json: every trial, all settings and versions", highlight=False)
