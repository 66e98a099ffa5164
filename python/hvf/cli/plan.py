"""``hvf plan DOMAIN``: one episode, with pictures."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from hvf.cli import recorded
from hvf.cli.arguments import domain_named, evaluating
from hvf.evaluation.evaluation import Evaluation
from hvf.progress import progress


@dataclasses.dataclass(frozen=True)
class Plan:
    """Plan and act in one episode; write a picture of the plan and a film.

    The picture shows start, subgoals, goal and the path taken; the film shows the episode beside
    what it aims at. Example:

        hvf plan maze --task hard --episode 3

    With ``--data FILE`` it plans between two frames of a recorded episode, and acts in nothing:
    ``hvf plan maze --data FILE --help``.

    Attributes:
        evaluation: which method, world and task, and how it plans.
        episode: number of the episode.
        out: folder for the pictures; by default named after all settings that differ from the
            preset's, in outputs/plan.
        film: kind of the film, gif or mp4; mp4 needs ``pip install imageio[ffmpeg]``.
        workers: processes that simulate and draw; 0 for as many as there are cores.
    """

    evaluation: Evaluation
    episode: int = 0
    out: Path | None = None
    film: str = "gif"
    workers: int = 0

    def __post_init__(self) -> None:
        if self.episode < 0:
            raise ValueError(f"episode: must not be negative, got {self.episode}")
        if self.film not in ("gif", "mp4"):
            raise ValueError(f"film: must be 'gif' or 'mp4', got {self.film!r}")


def run(words: Sequence[str]) -> None:
    """Run one episode, write its pictures, and say how it went."""
    from hvf.cli.watching import how_it_went, watch
    from hvf.evaluation.pictures import save_film, save_strip
    from hvf.evaluation.task import Task

    domain, rest = domain_named("plan", words)
    if not domain.tasks or any(word.split("=")[0] == "--data" for word in rest):
        recorded.run(domain, rest)
        return
    config = evaluating(Plan, "plan", domain, rest)
    console = Console()
    with Task.open(config.evaluation, config.workers) as task:
        name = f"{task.name}, episode {config.episode}"
        with progress(console, "", task.steps, "steps") as bar:
            outcome, episode = watch(task, config.episode, bar)
    out = config.out or Path("outputs", "plan", config.evaluation.slug)
    stem = out / f"episode-{config.episode}"
    save_strip(episode, stem.with_suffix(".png"), name)
    save_film(episode, stem.with_suffix(f".{config.film}"), name)
    console.print(how_it_went(name, outcome), highlight=False)
    files = f"{stem.with_suffix('.png')} and {stem.with_suffix('.' + config.film)}"
    console.print(files, highlight=False, soft_wrap=True)
