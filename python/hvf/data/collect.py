"""Collecting random interaction, in parts that survive being stopped.

Parts of a few episodes are written to ``<out>.parts/``, each whole or not at all, and joined to
``out`` at the end. An episode is a function of (seed, number), so a collection that was stopped
goes on where it was and ends in the same file.
"""

from __future__ import annotations

import dataclasses
import os
import shutil
from collections.abc import Callable, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

import hvf_core
from hvf.data.episodes import Episodes, Metadata
from hvf.data.formats.hdf5 import EpisodeFile, join_files, write_episodes
from hvf.files import replacing

# (seed, first episode, number of episodes, steps) to episodes.
Rollouts = Callable[[int, int, int, int], Episodes]


@dataclasses.dataclass(frozen=True)
class CollectConfig:
    """How much to collect, and where to put it.

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


def collect_maze(config: CollectConfig, console: Console | None = None) -> Path:
    """Collect episodes of the maze under uniformly random actions.

    Raises:
        FileExistsError: ``config.out`` holds something else.
        ValueError: ``<out>.parts`` holds parts of another collection, or damaged ones.
        OSError: full disk, no permission; what was written so far stays, and is used again.
        KeyboardInterrupt: stopped; the same call goes on from there.
    """

    def rollouts(seed: int, first: int, count: int, steps: int) -> Episodes:
        return Episodes(*hvf_core.maze_collect(seed, first, count, steps, config.image_size))

    parameters = {"image_size": config.image_size, "policy": "uniform"}
    return collect(config, "maze", parameters, rollouts, console)


def collect(
    config: CollectConfig,
    environment: str,
    parameters: dict[str, Any],
    rollouts: Rollouts,
    console: Console | None = None,
    versions: Mapping[str, str] | None = None,
) -> Path:
    """Collect ``config.episodes`` episodes of any environment; see :func:`collect_maze`.

    Args:
        config: how much, and where.
        environment: name of the environment.
        parameters: what identifies its settings; JSON's types.
        rollouts: makes episodes.
        console: where progress goes.
        versions: name to version of the programs that the environment itself needs.

    Returns:
        The file written.
    """
    console = console or Console()
    wanted = Metadata(
        environment,
        parameters,
        config.seed,
        config.steps,
        config.episodes,
        {**program_versions(), **(versions or {})},
    )
    if config.out.exists() and not config.overwrite:
        if _same_collection(config.out, wanted):
            console.print(f"{config.out}: already complete")
            return config.out
        raise FileExistsError(
            f"{config.out}: holds something else; choose another out, or overwrite"
        )
    folder = config.out.with_name(f"{config.out.name}.parts")
    folder.mkdir(parents=True, exist_ok=True)
    parts = [
        (folder / f"{first:09d}-{config.part}.h5", first)
        for first in range(0, config.episodes, config.part)
    ]
    with Progress(
        TextColumn(f"collecting {environment}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("episodes, left"),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
    ) as progress:
        task = progress.add_task("", total=config.episodes)
        diverged = 0
        try:
            for path, first in parts:
                count = min(config.part, config.episodes - first)
                if not path.exists():
                    made = rollouts(config.seed, first, count, config.steps)
                    with replacing(path) as temporary:
                        write_episodes(
                            temporary,
                            dataclasses.replace(wanted, episodes=count, diverged=made.diverged),
                            made,
                            os.cpu_count() or 1,
                        )
                diverged += _check_part(path, wanted, count)
                progress.advance(task, count)
            with replacing(config.out) as temporary:
                total = dataclasses.replace(wanted, diverged=diverged)
                join_files(temporary, total, [path for path, _ in parts])
        except KeyboardInterrupt:
            console.print(f"{config.out}: stopped; the same command goes on from there")
            raise
    shutil.rmtree(folder)
    if diverged:
        console.print(f"{config.out}: {diverged} simulations diverged, and were drawn anew")
    return config.out


def program_versions() -> dict[str, str]:
    """Versions of the programs that shape the data."""
    try:
        own = version("hvf")
    except PackageNotFoundError:
        own = "unknown"
    return {
        "hvf": own,
        "hvf_core": hvf_core.__version__,
        "numpy": np.__version__,
        "h5py": h5py.__version__,
    }


def _same_collection(path: Path, wanted: Metadata) -> bool:
    try:
        with EpisodeFile(path) as file:
            return _source(file.metadata) == _source(wanted) and len(file) == wanted.episodes
    except ValueError:
        return False


def _check_part(path: Path, wanted: Metadata, count: int) -> int:
    """Refuse a part of another collection; how many simulations diverged in this one."""
    with EpisodeFile(path) as file:
        if _source(file.metadata) != _source(wanted) or len(file) < count:
            raise ValueError(
                f"{path}: is a part of another collection; remove {path.parent} or choose "
                "another out"
            )
        return file.metadata.diverged


def _source(metadata: Metadata) -> tuple[Any, ...]:
    """What makes two collections the same, apart from their length."""
    return metadata.environment, dict(metadata.parameters), metadata.seed, metadata.steps
