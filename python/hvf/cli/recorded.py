"""``hvf plan DOMAIN --data FILE``: subgoals between two frames of a recorded episode."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from hvf.cli.arguments import parsed
from hvf.domains.domain import Domain
from hvf.settings import World


@dataclasses.dataclass(frozen=True)
class Recorded:
    """Search for subgoals between two frames of a recorded episode; write a picture.

    Nothing is acted, so that it works on video of what nobody can simulate. Example:

        hvf plan maze --data data/maze.h5 --episode 3 --first 0 --last 29 --subgoals 2

    Attributes:
        data: file of episodes.
        episode: number of the episode.
        first: number of its frame that is the start.
        last: number of the frame that is the goal; negative numbers count from the end.
        subgoals: how many (K).
        dynamics: a checkpoint, or a name of the domain's models.
        generator: a checkpoint, or a name of the domain's models.
        preset: plan settings, by name.
        out: folder for the picture.
        seed: of the search.
    """

    data: Path
    episode: int = 0
    first: int = 0
    last: int = -1
    subgoals: int = 2
    dynamics: str = "default"
    generator: str = "default"
    preset: str = "default"
    out: Path = Path("outputs/plan")
    seed: int = 0

    def __post_init__(self) -> None:
        if self.subgoals < 1:
            raise ValueError(f"subgoals: must be at least 1, got {self.subgoals}")
        if self.episode < 0:
            raise ValueError(f"episode: must not be negative, got {self.episode}")


def run(domain: Domain, words: Sequence[str]) -> None:
    """Search, and write what was found."""
    from hvf.data.formats import open_episodes
    from hvf.evaluation.between import load_for, search_between

    config = parsed(Recorded, f"plan {domain.name}", words)
    planning = domain.preset(config.preset).planning
    console = Console()
    with open_episodes(config.data) as file:
        if config.episode >= len(file):
            raise ValueError(f"episode: {config.data} has {len(file)}, got {config.episode}")
        episode = file.read(config.episode, 1)
        frames = episode.frames[0, : int(episode.lengths[0]) + 1]
    numbers = range(len(frames))
    for name, number in (("first", config.first), ("last", config.last)):
        if not -len(frames) <= number < len(frames):
            raise ValueError(f"{name}: the episode has {len(frames)} frames, got {number}")
    start, goal = frames[numbers[config.first]], frames[numbers[config.last]]
    with console.status("loading models"):
        loaded = load_for(domain, World(config.dynamics, config.generator), planning)
    with console.status(f"searching for {config.subgoals} subgoals"):
        found = search_between(loaded, planning, start, goal, config.subgoals, config.seed)
    out = (
        config.out / f"episode-{config.episode}-{numbers[config.first]}-{numbers[config.last]}.png"
    )
    found.write(out)
    console.print(f"{out}: {found.title}", highlight=False)
