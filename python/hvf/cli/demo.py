"""``hvf demo DOMAIN``: the main job on a few episodes, with pictures."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from hvf.cli.arguments import domain_named, evaluating
from hvf.evaluation.evaluation import Evaluation
from hvf.progress import progress


@dataclasses.dataclass(frozen=True)
class Demo:
    """Reach goal images with subgoals and without; write pictures and a table.

    Searches for subgoal images between the start image and the goal image of each episode, plans
    to each in turn, and acts. Example:

        hvf demo desk --task door_block --subgoals 2

    Attributes:
        evaluation: which method, world and task, and how it plans; it is compared with none.
        episodes: how many.
        pictures: of how many of them to draw pictures.
        out: folder for the pictures and the results; by default named after all settings that
            differ from the preset's, in outputs/demo.
        workers: processes that simulate and draw; 0 for as many as there are cores.
    """

    evaluation: Evaluation
    episodes: int = 8
    pictures: int = 3
    out: Path | None = None
    workers: int = 0

    def __post_init__(self) -> None:
        if self.episodes < 1:
            raise ValueError(f"episodes: must be at least 1, got {self.episodes}")
        if self.pictures < 0:
            raise ValueError(f"pictures: must not be negative, got {self.pictures}")


def run(words: Sequence[str]) -> None:
    """Run the same episodes with a method and without subgoals; write pictures and a table."""
    from hvf.cli.watching import how_it_went, watch
    from hvf.evaluation.code import code_of
    from hvf.evaluation.pictures import save_film, save_strip
    from hvf.evaluation.report import Report, save, table
    from hvf.evaluation.run import records
    from hvf.evaluation.task import Task

    domain, rest = domain_named("demo", words)
    domain.check_task(domain.default_task)
    config = evaluating(Demo, "demo", domain, rest, **domain.demo)
    out = config.out or Path("outputs", "demo", config.evaluation.slug)
    console = Console()
    reports: list[Report] = []
    pictures: list[Path] = []
    chosen = config.evaluation.method
    methods = (chosen,) if chosen == "none" else (chosen, "none")
    with (
        progress(console, "loading", None, "steps") as bar,
        domain.open(config.workers) as place,
    ):
        for method in methods:
            task = Task(dataclasses.replace(config.evaluation, method=method), place)
            bar.update(total=len(methods) * config.episodes * task.steps)
            done, began = [], time.perf_counter()
            for index in range(config.episodes):
                outcome, episode = watch(task, index, bar)
                done += records(outcome, index)
                caption = f"{task.name}, episode {index}"
                console.print(how_it_went(caption, outcome), highlight=False)
                if method == chosen and len(pictures) < config.pictures:
                    bar.update(description="drawing")
                    stem = out / f"episode-{index}"
                    save_strip(episode, stem.with_suffix(".png"), caption)
                    save_film(episode, stem.with_suffix(".gif"), caption)
                    pictures.append(stem)
            seconds = time.perf_counter() - began
            report = Report.of(task.name, task.config, done, seconds, code_of())
            save(report, out / f"{method}.json")
            reports.append(report)
    console.print(table(reports, f"{config.episodes} episodes: {domain.name}"))
    for stem in pictures:
        console.print(f"{stem}.png (start, subgoals, goal, path) and {stem}.gif", highlight=False)
    console.print(f"{out}/*.json: every trial, all settings and versions", highlight=False)
