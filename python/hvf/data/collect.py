"""Collecting random interaction, in parts that survive being stopped (:mod:`hvf.data.parts`).

An episode is a function of (seed, number), so a collection that was stopped goes on where it was
and ends in the same file.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from hvf.data.episodes import Episodes, Metadata
from hvf.data.parts import Made, program_versions, write_in_parts

# (seed, first episode, number of episodes, steps) to episodes.
Rollouts = Callable[[int, int, int, int], Episodes]


@dataclasses.dataclass(frozen=True)
class CollectConfig:
    """How much to collect, and where to put it: what the collections of all domains share.

    Attributes:
        out: HDF5 file to write.
        episodes: number of episodes.
        steps: actions per episode.
        seed: episode ``i`` is a function of (seed, i).
        image_size: pixels on each side of a frame.
        part: episodes written at a time; a stop loses no more than these.
        overwrite: replace a different collection that is already at ``out``.
    """

    out: Path
    episodes: int = 10_000
    steps: int = 100
    seed: int = 0
    image_size: int = 64
    part: int = 50
    overwrite: bool = False

    def __post_init__(self) -> None:
        for name, least in (("episodes", 1), ("steps", 1), ("image_size", 8), ("part", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be at least {least}, got {getattr(self, name)}")
        if not 0 <= self.seed < 2**63:
            raise ValueError(f"seed must be from 0 to 2^63 - 1, got {self.seed}")

    def run(self, console: Console | None = None) -> Path:
        """Collect; a domain's own config says how, most likely by :func:`collect`.

        Returns:
            The file written.
        """
        raise NotImplementedError(f"{type(self).__name__} does not say what is collected")


def collect(
    config: CollectConfig,
    environment: str,
    parameters: Mapping[str, Any],
    rollouts: Rollouts,
    console: Console | None = None,
    versions: Mapping[str, str] | None = None,
    *,
    cameras: tuple[str, ...] = (),
    action_names: tuple[str, ...] = (),
    action_low: tuple[float, ...] | None = None,
    action_high: tuple[float, ...] | None = None,
) -> Path:
    """Collect ``config.episodes`` episodes of any environment.

    Args:
        config: how much, and where.
        environment: name of the environment.
        parameters: what identifies its settings; JSON's types.
        rollouts: makes episodes; shorter ones than ``steps`` are padded, see
            :class:`~hvf.data.episodes.Episodes`.
        console: where progress goes.
        versions: name to version of the programs that the environment itself needs.
        cameras: name of the camera, if it has one.
        action_names: what each dimension of an action is.
        action_low: lowest action.
        action_high: highest action.

    Returns:
        The file written.

    Raises:
        FileExistsError: ``config.out`` holds something else.
        ValueError: ``config.out`` is a directory; or ``<out>.parts`` holds parts of another
            collection, parts that another version of a program made, or damaged ones.
        FileNotFoundError: somebody took a part away.
        OSError: full disk, no permission; what was written so far stays, and is used again.
        KeyboardInterrupt: stopped; the same call goes on from there.
    """
    wanted = Metadata(
        environment,
        parameters,
        config.seed,
        config.steps,
        config.episodes,
        {**program_versions(), **(versions or {})},
        0,
        cameras,
        action_names,
        action_low,
        action_high,
    )

    def made(first: int, count: int) -> Made:
        return rollouts(config.seed, first, count, config.steps), {}

    return write_in_parts(
        config.out,
        wanted,
        made,
        part=config.part,
        overwrite=config.overwrite,
        about=f"collecting {environment}",
        console=console,
    )
