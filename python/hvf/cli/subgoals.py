"""``hvf subgoals``: subgoals between two images of your own."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from hvf.cli.arguments import asked, searching_with
from hvf.registry import DOMAINS
from hvf.settings import Planning, World


@dataclasses.dataclass(frozen=True)
class Subgoals:
    """Find the subgoal images between a start and a goal image, and what each segment costs.

    Acts in nothing: all that is needed are two images and two trained models. Example:

        hvf subgoals --start a.png --goal b.png --dynamics runs/keypoint/model.safetensors
        --generator runs/cvae/model.safetensors --subgoals 2 --out strip.png

    Attributes:
        start: image of the start (PNG, JPEG, ...), of the size that the models were trained for.
        goal: image of the goal.
        subgoals: how many (K).
        out: picture to write; beside it a JSON file with the costs, and one PNG for each subgoal.
        domain: whose names and presets count.
        preset: settings, by name; the others begin with them.
        world: what is planned with.
        planning: plan settings.
        seed: of the search.
    """

    start: Path
    goal: Path
    subgoals: int = 2
    out: Path = Path("outputs/subgoals/strip.png")
    domain: str = "maze"
    preset: str = "default"
    world: World = World()
    planning: Planning = Planning()
    seed: int = 0

    def __post_init__(self) -> None:
        if self.subgoals < 1:
            raise ValueError(f"subgoals: must be at least 1, got {self.subgoals}")


def run(words: Sequence[str]) -> None:
    """Search, and write what was found."""
    from hvf.cli.watching import searching
    from hvf.evaluation.between import load_for, search_between
    from hvf.images import read_image

    domain = DOMAINS[asked(words, "domain", Subgoals.domain)]
    config = searching_with(Subgoals, "subgoals", domain, words, ["start", "goal"])
    planning, console = config.planning, Console()
    start, goal = read_image("start", config.start), read_image("goal", config.goal)
    with console.status("loading models"):
        loaded = load_for(domain, config.world, planning)
    with searching(console, config.subgoals, planning) as told:
        found = search_between(
            loaded, planning, start, goal, config.subgoals, config.seed, progress=told
        )
    found.write(config.out)
    console.print(f"{config.out}: {found.title}", highlight=False)
