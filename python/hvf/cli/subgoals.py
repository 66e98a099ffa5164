"""``hvf subgoals``: subgoals between two images of your own."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from hvf.cli.arguments import parsed
from hvf.registry import DOMAINS
from hvf.settings import World, check_word


@dataclasses.dataclass(frozen=True)
class Subgoals:
    """Find the subgoal images between a start and a goal image, and what each segment costs.

    Plans nothing but the subgoals, and acts in nothing: all that is needed are two images and two
    trained models. Example:

        hvf subgoals --start a.png --goal b.png --dynamics runs/keypoint/model.safetensors
        --generator runs/cvae/model.safetensors --subgoals 2 --out strip.png

    Attributes:
        start: image of the start (PNG, JPEG, ...), of the size that the models were trained for.
        goal: image of the goal.
        dynamics: a checkpoint, or a name of the domain's models.
        generator: a checkpoint, or a name of the domain's models.
        subgoals: how many (K).
        out: picture to write; beside it a JSON file with the costs, and one PNG for each subgoal.
        domain: whose names and presets count.
        preset: plan settings, by name.
        seed: of the search.
    """

    start: Path
    goal: Path
    dynamics: str = "default"
    generator: str = "default"
    subgoals: int = 2
    out: Path = Path("outputs/subgoals/strip.png")
    domain: str = "maze"
    preset: str = "default"
    seed: int = 0

    def __post_init__(self) -> None:
        if self.subgoals < 1:
            raise ValueError(f"subgoals: must be at least 1, got {self.subgoals}")
        check_word("domain", self.domain, tuple(DOMAINS))


def run(words: Sequence[str]) -> None:
    """Search, and write what was found."""
    from hvf.agents.frames import images_of
    from hvf.evaluation.pictures import save_subgoals
    from hvf.files import write_bytes
    from hvf.images import read_image, write_png
    from hvf.worlds.load import load

    config = parsed(Subgoals, "subgoals", words)
    console = Console()
    domain = DOMAINS[config.domain]
    start, goal = read_image("start", config.start), read_image("goal", config.goal)
    if start.shape != goal.shape:
        raise ValueError(
            f"goal: must be as large as start {list(start.shape)}, got {list(goal.shape)}"
        )
    preset = domain.preset(config.preset)
    world = World(config.dynamics, config.generator)
    with console.status("loading models"), domain.open() as place:
        loaded = load(domain, world, preset.planning, place)
        search = preset.planning.search(config.subgoals)
        direct = preset.planning.mpc.plan(loaded.world, start, goal, seed=config.seed)
    with console.status(f"searching for {config.subgoals} subgoals"):
        found = search.search(loaded.world, loaded.generator, start, goal, seed=config.seed)
    images = images_of(found.subgoals, loaded.world)
    costs = [float(cost) for cost in found.segment_costs]
    title = f"hardest segment {max(costs):.4f}; straight to the goal {direct.cost:.4f}"
    save_subgoals(start, images, goal, costs, config.out, title)
    stem = config.out.with_suffix("")
    for k, image in enumerate(images):
        write_png(stem.with_name(f"{stem.name}-{k + 1}.png"), np.ascontiguousarray(image))
    facts = {
        "segment_costs": costs,
        "cost": float(found.cost),
        "cost_without_subgoals": float(direct.cost),
        "seed": config.seed,
        "planning": dataclasses.asdict(preset.planning),
        "weights": {
            part: {"model": file.model, "sha256": file.sha256}
            for part, file in loaded.weights.items()
        },
    }
    write_bytes(stem.with_suffix(".json"), (json.dumps(facts, indent=1) + "\n").encode())
    console.print(f"{config.out}: {title}", highlight=False)
