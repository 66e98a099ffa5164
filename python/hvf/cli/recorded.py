"""``hvf plan DOMAIN --data FILE``: subgoals between two frames of a recorded episode."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from hvf.cli.arguments import searching_with
from hvf.domains.domain import Domain
from hvf.evaluation.naming import changes, slug, word
from hvf.settings import Planning, World


@dataclasses.dataclass(frozen=True)
class Recorded:
    """Search for subgoals between two frames of a recorded episode; write a picture.

    Nothing is acted, so that it works on video of what nobody can simulate. Below each subgoal
    stands the nearest of the training frames; a JSON file beside the picture has what each segment
    costs to plan, and what the plan straight to the goal costs. Example:

        hvf plan video --data data/bair-test.h5 --train-data data/bair.h5 --episode 3
        --from 0 --to 29 --subgoals 2 --dynamics runs/sv2p/model.safetensors
        --generator runs/cvae/model.safetensors

    Attributes:
        data: file of episodes.
        episode: number of the episode.
        first: number of its frame that is the start.
        last: number of the frame that is the goal; negative numbers count from the end.
        subgoals: how many (K).
        camera: whose frames; the first one's by default.
        train_data: file of the training episodes that neighbours are looked for in; by default the
            training episodes of the data, if it has any.
        preset: settings, by name; the others begin with them.
        world: what is planned with.
        planning: plan settings.
        out: folder for the picture; by default named after domain, data and all settings that
            differ from the preset's, in outputs/plan.
        seed: of the search.
    """

    data: Path
    episode: int = 0
    first: Annotated[int, tyro.conf.arg(name="from", aliases=("--first",))] = 0
    last: Annotated[int, tyro.conf.arg(name="to", aliases=("--last",))] = -1
    subgoals: int = 2
    camera: str | None = None
    train_data: Path | None = None
    preset: str = "default"
    world: World = World()
    planning: Planning = Planning()
    out: Path | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.subgoals < 1:
            raise ValueError(f"subgoals: must be at least 1, got {self.subgoals}")
        if self.episode < 0:
            raise ValueError(f"episode: must not be negative, got {self.episode}")


def run(domain: Domain, words: Sequence[str]) -> None:
    """Search, and write what was found."""
    from hvf.cli.watching import searching
    from hvf.data.formats import open_episodes
    from hvf.evaluation.between import Recorded as Episode
    from hvf.evaluation.between import load_for, training_episodes
    from hvf.evaluation.neighbours import nearest_frames

    config = searching_with(Recorded, f"plan {domain.name}", domain, words, ["data"])
    console = Console()
    with (
        open_episodes(config.data, camera=config.camera) as file,
        open_episodes(config.train_data or config.data, camera=config.camera) as known,
    ):
        episode = Episode.read(file, config.episode)
        ends = episode.at("from", config.first), episode.at("to", config.last)
        with console.status("loading models"):
            loaded = load_for(domain, config.world, config.planning)
        with searching(console, config.subgoals, config.planning) as told:
            found = episode.search(
                loaded, config.planning, ends, config.subgoals, config.seed, progress=told
            )
        training = training_episodes(known)
        if training is None:
            console.print("no nearest training frames: name the training episodes, --train-data")
        else:
            # Its own frames would be no news.
            own = config.episode if config.train_data is None else None
            others = [number for number in training if number != own]
            with console.status("looking for the nearest training frames"):
                nearest = nearest_frames(known, others, found.subgoals)
            found = dataclasses.replace(found, nearest=nearest)
    out = (
        config.out or Path("outputs", "plan", _name(domain, config))
    ) / f"episode-{config.episode}-{ends[0]}-{ends[1]}.png"
    found.write(out)
    console.print(f"{out}: {found.title}", highlight=False)
    costs = " + ".join(f"{cost:.3g}" for cost in found.segment_costs)
    console.print(f"segments {costs}; without subgoals {found.direct_cost:.3g}", highlight=False)


def _name(domain: Domain, config: Recorded) -> str:
    """A name for the folder of what a search makes, by all settings."""
    preset = domain.preset(config.preset)
    settings = {
        **changes(config, Recorded(config.data)),
        **changes(config.world, preset.world),
        **changes(config.planning, preset.planning),
    }
    known = {"episode", "first", "last", "world", "planning", "preset", "train_data", "out"}
    words = [domain.name, config.data.stem, config.preset]
    words += [
        f"{name}-{word(value, domain.weights)}"
        for name, value in settings.items()
        if name not in known
    ]
    return slug(words)
