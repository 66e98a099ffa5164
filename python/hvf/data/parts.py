"""Writing a file of episodes in parts, so that long work survives being stopped.

Parts of a few episodes are written to ``<out>.parts/``, each whole or not at all, and joined to
``out`` at the end.
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TypeAlias

import h5py
import numpy as np
from rich.console import Console

import hvf_core
from hvf.cores import cores
from hvf.data.episodes import Episodes, Metadata
from hvf.data.formats import open_episodes
from hvf.data.formats.hdf5 import FORMAT, EpisodeFile, Views, join_files, write_episodes
from hvf.files import replacing
from hvf.interrupts import Interrupts
from hvf.progress import progress

Made: TypeAlias = tuple[Episodes, Views]
"""Episodes, and what further cameras saw of them."""


def write_in_parts(
    out: Path,
    wanted: Metadata,
    make: Callable[[int, int], Made],
    *,
    part: int,
    overwrite: bool = False,
    compress: bool = True,
    about: str = "",
    finish: Callable[[Metadata, Sequence[Path]], Metadata] | None = None,
    console: Console | None = None,
) -> Path:
    """Write ``wanted.episodes`` episodes to ``out``; go on with what is there of them.

    Args:
        out: HDF5 file to write.
        wanted: what it will be; parts of anything else are refused.
        make: makes episodes ``first..first + count``, a function of these two alone.
        part: episodes written at a time; a stop loses no more than these.
        overwrite: replace other episodes that are already at ``out``.
        compress: whether frames are compressed; those of real cameras hardly shrink.
        about: what is being done, in a few words.
        finish: what ``wanted`` becomes in view of all parts, in order.
        console: where progress goes.

    Returns:
        The file written.

    Raises:
        FileExistsError: ``out`` holds something else.
        ValueError: ``out`` is a directory; or ``<out>.parts`` holds parts of another collection,
            parts that another version of a program made, or damaged ones.
        FileNotFoundError: somebody took a part away.
        OSError: full disk, no permission; what was written so far stays, and is used again.
        KeyboardInterrupt: stopped; the same call goes on from there.
    """
    console = console or Console()
    folder = parts_folder(out)
    if out.is_dir():
        raise ValueError(f"out: {out} is a directory; name a file in it")
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"out: {folder}, where parts go, is not a directory")
    if out.exists() and not overwrite:
        if _is_complete(out, wanted):
            console.print(f"{out}: already complete")
            return out
        raise FileExistsError(f"{out}: holds something else; choose another out, or overwrite")
    folder.mkdir(parents=True, exist_ok=True)
    parts = [
        (folder / f"{first:09d}-{part}.h5", first) for first in range(0, wanted.episodes, part)
    ]
    with (
        progress(console, about, wanted.episodes, "episodes", transient=False) as bar,
        Interrupts(at_once=True) as interrupts,
    ):
        diverged = 0
        try:
            for path, first in parts:
                count = min(part, wanted.episodes - first)
                if not path.exists():
                    made, views = make(first, count)
                    with replacing(path) as temporary:
                        write_episodes(
                            temporary,
                            dataclasses.replace(wanted, episodes=count, diverged=made.diverged),
                            made,
                            cores(),
                            views,
                            compress=compress,
                        )
                diverged += _check_part(path, wanted, count)
                interrupts.check()  # one that a destructor swallowed
                bar.advance(count, note=f"{diverged} diverged" if diverged else None)
            with replacing(out) as temporary:
                total = dataclasses.replace(wanted, diverged=diverged)
                written = [path for path, _ in parts]
                join_files(temporary, finish(total, written) if finish else total, written)
        except KeyboardInterrupt:
            console.print(f"{out}: stopped; the same command goes on from there")
            raise
    shutil.rmtree(folder)
    if diverged:
        console.print(f"{out}: {diverged} simulations diverged, and were drawn anew")
    return out


def parts_folder(out: Path) -> Path:
    """Where parts of ``out`` are kept while it is being made."""
    return out.with_name(f"{out.name}.parts")


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
