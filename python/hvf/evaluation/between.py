"""Subgoals between two images, with nothing to act in: for recorded video, and for your own."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hvf.agents.frames import images_of, observed, remembered
from hvf.data.formats import EpisodeReader
from hvf.data.splits import DATA_SEEDS, episodes_of
from hvf.domains.domain import Domain
from hvf.evaluation.neighbours import Neighbours
from hvf.evaluation.pictures import save_subgoals
from hvf.files import write_bytes
from hvf.images import write_png
from hvf.protocols import Images, Remembering
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
        nearest: recorded frames that are nearest to the subgoals, if they were looked for.
    """

    start: Images
    goal: Images
    subgoals: Images
    segment_costs: tuple[float, ...]
    direct_cost: float
    facts: dict[str, Any]
    nearest: Neighbours | None = None

    @property
    def title(self) -> str:
        """Costs in a line."""
        hardest = max(self.segment_costs)
        return f"hardest segment {hardest:.2g}; straight to the goal {self.direct_cost:.2g}"

    @property
    def costs(self) -> dict[str, Any]:
        """Planning costs, with and without subgoals, and the neighbours; JSON's types."""
        found: dict[str, Any] = {
            "segment_costs": list(self.segment_costs),
            "cost_without_subgoals": self.direct_cost,
        }
        if self.nearest is not None:
            found["nearest_training_frames"] = self.nearest.facts()
        return found

    def write(self, out: Path) -> None:
        """Write a picture, and beside it a JSON file with the costs and one PNG for each subgoal.

        Raises:
            OSError: a file cannot be written.
        """
        costs = list(self.segment_costs)
        below = []
        if self.nearest is not None:
            below = [
                (f"nearest in training\n(episode {episode}, frame {time})", image)
                for image, episode, time in zip(
                    self.nearest.images, self.nearest.episodes, self.nearest.times, strict=True
                )
            ]
        save_subgoals(self.start, self.subgoals, self.goal, costs, out, self.title, below)
        stem = out.with_suffix("")
        for k, image in enumerate(self.subgoals):
            write_png(stem.with_name(f"{stem.name}-{k + 1}.png"), np.ascontiguousarray(image))
        facts = {**self.costs, **self.facts}
        write_bytes(stem.with_suffix(".json"), (json.dumps(facts, indent=1) + "\n").encode())


def load_for(domain: Domain, world: World, planning: Planning, *, generator: bool = True) -> Loaded:
    """Models to search with, where nothing is simulated.

    Raises:
        FileNotFoundError, ValueError: as :func:`hvf.worlds.load.load`.
    """
    with domain.open() as place:
        return load(domain, world, planning, place, generator=generator)


def search_between(
    loaded: Loaded,
    planning: Planning,
    start: Images,
    goal: Images,
    subgoals: int,
    seed: int,
    before: tuple[Images, NDArray[np.float32]] | None = None,
    progress: Callable[[int, int, float], object] | None = None,
) -> Between:
    """Search for subgoals between two images, and plan straight to the goal for comparison.

    Args:
        loaded: dynamics and generator.
        planning: how to search.
        start: uint8 ``[H, W, 3]``, of the size that the models were trained for.
        goal: the same.
        subgoals: how many, ``K``.
        seed: of the search.
        before: frames before the start, uint8 ``[N, H, W, 3]``, and the actions that lead from each
            to the next, ``[N, A]``, for dynamics with context.
        progress: told how the search goes on: iteration, of how many, lowest cost so far.

    Raises:
        ValueError: images of different sizes, or of another than the models'.
    """
    if start.shape != goal.shape:
        raise ValueError(
            f"goal: must be as large as start {list(start.shape)}, got {list(goal.shape)}"
        )
    ends: tuple[Any, Any] = start, goal
    if before is not None and isinstance(loaded.world, Remembering):
        seen = np.concatenate([before[0], start[None]])
        now = remembered(loaded.world, seen[None], before[1][None])
        ends = now, observed(loaded.world, goal[None])
    direct = planning.mpc.plan(loaded.world, *ends, seed=seed)
    search = planning.search(subgoals)
    found = search.search(loaded.world, loaded.generator, *ends, seed=seed, progress=progress)
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


@dataclasses.dataclass(frozen=True)
class Recorded:
    """A recorded episode to plan in.

    Attributes:
        frames: uint8 ``[T+1, H, W, 3]``, without padding.
        actions: float32 ``[T, A]``.
    """

    frames: Images
    actions: NDArray[np.float32]

    @classmethod
    def read(cls, file: EpisodeReader, number: int) -> Recorded:
        """An episode of a file.

        Raises:
            ValueError: a number that there is not, or a damaged episode.
        """
        if not 0 <= number < len(file):
            raise ValueError(f"episode: {file.path} has {len(file)}, got {number}")
        episode = file.read(number, 1)
        length = int(episode.lengths[0])
        return cls(episode.frames[0, : length + 1], episode.actions[0, :length])

    def at(self, name: str, time: int) -> int:
        """The number of a frame; negative ones count from the end.

        Args:
            name: of the argument, for errors.
            time: the number.

        Raises:
            ValueError: there is no such frame.
        """
        count = len(self.frames)
        if not -count <= time < count:
            raise ValueError(f"{name}: the episode has {count} frames, got {time}")
        return range(count)[time]

    def search(
        self,
        loaded: Loaded,
        planning: Planning,
        ends: tuple[int, int],
        subgoals: int,
        seed: int,
        progress: Callable[[int, int, float], object] | None = None,
    ) -> Between:
        """Search for subgoals between two of its frames; see :func:`search_between`."""
        first, last = ends
        before = self.frames[:first], self.actions[:first]
        known = before if first and self.actions.shape[1] == len(loaded.world.action_low) else None
        start, goal = self.frames[first], self.frames[last]
        return search_between(
            loaded, planning, start, goal, subgoals, seed, known, progress=progress
        )


def training_episodes(file: EpisodeReader) -> range | None:
    """The numbers of the training episodes of a file; None if it is for tests."""
    metadata = file.metadata
    if metadata.parameters.get("split") == "test" or metadata.seed == DATA_SEEDS["test"]:
        return None
    return episodes_of("train", metadata) if metadata.episodes > 1 else None
