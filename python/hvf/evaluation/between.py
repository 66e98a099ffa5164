"""Subgoals between two images, with nothing to act in: for recorded video, and for your own."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from hvf.agents.frames import images_of
from hvf.domains.domain import Domain
from hvf.evaluation.pictures import save_subgoals
from hvf.files import write_bytes
from hvf.images import write_png
from hvf.protocols import Images
from hvf.settings import Planning, World
from hvf.worlds.load import Loaded, load


@dataclasses.dataclass(frozen=True)
class Between:
    """What a search found.

    Attributes:
        start: uint8 ``[H, W, 3]``.
        goal: uint8 ``[H, W, 3]``.
        subgoals: uint8 ``[K, H, W, 3]``.
        segment_costs: what each of the ``K + 1`` segments costs to plan.
        direct_cost: what the plan straight to the goal costs.
        facts: settings and weights, JSON's types.
    """

    start: Images
    goal: Images
    subgoals: Images
    segment_costs: tuple[float, ...]
    direct_cost: float
    facts: dict[str, Any]

    @property
    def title(self) -> str:
        """Costs in a line."""
        hardest = max(self.segment_costs)
        return f"hardest segment {hardest:.2g}; straight to the goal {self.direct_cost:.2g}"

    def write(self, out: Path) -> None:
        """Write a picture, and beside it a JSON file with the costs and one PNG for each subgoal.

        Raises:
            OSError: a file cannot be written.
        """
        costs = list(self.segment_costs)
        save_subgoals(self.start, self.subgoals, self.goal, costs, out, self.title)
        stem = out.with_suffix("")
        for k, image in enumerate(self.subgoals):
            write_png(stem.with_name(f"{stem.name}-{k + 1}.png"), np.ascontiguousarray(image))
        facts = {
            "segment_costs": costs,
            "cost_without_subgoals": self.direct_cost,
            **self.facts,
        }
        write_bytes(stem.with_suffix(".json"), (json.dumps(facts, indent=1) + "\n").encode())


def load_for(domain: Domain, world: World, planning: Planning) -> Loaded:
    """Models to search with, where nothing is simulated.

    Raises:
        FileNotFoundError, ValueError: as :func:`hvf.worlds.load.load`.
    """
    with domain.open() as place:
        return load(domain, world, planning, place)


def search_between(
    loaded: Loaded, planning: Planning, start: Images, goal: Images, subgoals: int, seed: int
) -> Between:
    """Search for subgoals between two images, and plan straight to the goal for comparison.

    Args:
        loaded: dynamics and generator.
        planning: how to search.
        start: uint8 ``[H, W, 3]``, of the size that the models were trained for.
        goal: the same.
        subgoals: how many, ``K``.
        seed: of the search.

    Raises:
        ValueError: images of different sizes, or of another than the models'.
    """
    if start.shape != goal.shape:
        raise ValueError(
            f"goal: must be as large as start {list(start.shape)}, got {list(goal.shape)}"
        )
    direct = planning.mpc.plan(loaded.world, start, goal, seed=seed)
    search = planning.search(subgoals)
    found = search.search(loaded.world, loaded.generator, start, goal, seed=seed)
    facts = {
        "seed": seed,
        "planning": dataclasses.asdict(planning),
        "weights": {
            part: {"model": file.model, "sha256": file.sha256}
            for part, file in loaded.weights.items()
        },
    }
    costs = tuple(float(cost) for cost in found.segment_costs)
    images = images_of(found.subgoals, loaded.world)
    return Between(start, goal, images, costs, float(direct.cost), facts)
