"""Collecting random interaction, in parts that survive being stopped.

Parts of a few episodes are written to ``<out>.parts/``, each whole or not at all, and joined to
``out`` at the end. An episode is a function of (seed, number), so a collection that was stopped
goes on where it was and ends in the same file.
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from rich.console import Console

import hvf_core
from hvf.cores import cores
from hvf.data.episodes import Episodes, Metadata
from hvf.data.formats import open_episodes
from hvf.data.formats.hdf5 import FORMAT, EpisodeFile, join_files, write_episodes
from hvf.files import replacing
from hvf.progress import progress

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
    console = console or Console()
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
    folder = config.out.with_name(f"{config.out.name}.parts")
    if config.out.is_dir():
        raise ValueError(f"out: {config.out} is a directory; name a file in it")
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"out: {folder}, where parts go, is not a directory")
    if config.out.exists() and not config.overwrite:
        if _is_complete(config.out, wanted):
            console.print(f"{config.out}: already complete")
            return config.out
        raise FileExistsError(
            f"{config.out}: holds something else; choose another out, or overwrite"
        )
    folder.mkdir(parents=True, exist_ok=True)
    parts = [
        (folder / f"{first:09d}-{config.part}.h5", first)
        for first in range(0, config.episodes, config.part)
    ]
    description = f"collecting {environment}"
    with progress(console, description, config.episodes, "episodes", transient=False) as bar:
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
                            cores(),
                        )
                diverged += _check_part(path, wanted, count)
                bar.advance(count, note=f"{diverged} diverged" if diverged else None)
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


def _is_complete(path: Path, wanted: Metadata) -> bool:
    try:
        with open_episodes(path) as file:
            return _difference(file.metadata, wanted) is None and len(file) == wanted.episodes
    except ValueError:
        return False


def _check_part(path: Path, wanted: Metadata, count: int) -> int:
    """Refuse a part that does not belong here; how many simulations diverged in this one."""
    go_on = f"remove {path.parent} or choose another out"
    with EpisodeFile(path) as file:
        other = _difference(file.metadata, wanted)
        if other is None and len(file) < count:
            other = f"{len(file)} episodes, expected {count}"
        if other is not None:
            raise ValueError(f"{path}: is a part of another collection ({other}); {go_on}")
        found, expected = dict(file.metadata.versions), dict(wanted.versions)
        if file.version != FORMAT:
            found, expected = {"format": file.version}, {"format": FORMAT}
        changed = [
            f"{name} {found.get(name, 'not there')}, now {expected.get(name, 'not there')}"
            for name in sorted({*found, *expected})
            if found.get(name) != expected.get(name)
        ]
        if changed:
            raise ValueError(
                f"{path}: was made by another version of the program ({'; '.join(changed)}), and "
                f"its episodes may be others; {go_on}"
            )
        return file.metadata.diverged


def _difference(found: Metadata, wanted: Metadata) -> str | None:
    """What makes two collections different, apart from their length; None if nothing does."""
    for name in ("environment", "parameters", "seed", "steps"):
        one, other = getattr(found, name), getattr(wanted, name)
        if one != other:
            return f"{name} {one!r}, expected {other!r}"
    return None
