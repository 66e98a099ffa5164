"""What a perception sees in all frames of a file, kept beside the file.

Perceiving a million frames takes minutes; what came of it is a few megabytes. It is kept in
``<data>.tracks/<checksum>-<first>-<last>.h5``, so that a run which was stopped, and another model
on the same perception, begin at once. The checksum is of the perception's weights, of what the file
of episodes says of itself, and of its size and time of change: another perception, or other data,
makes another file. Files that are not needed any more can be deleted at any time.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console

from hvf.data.episodes import Metadata
from hvf.data.formats import EpisodeReader
from hvf.files import replacing

FORMAT = "hvf-tracks-1"

Arrays = Mapping[str, NDArray[Any]]


def checksum(module: torch.nn.Module) -> str:
    """SHA-256 of a module's class, weights and buffers."""
    found = hashlib.sha256(type(module).__name__.encode())
    for name, tensor in sorted(module.state_dict().items()):
        array = tensor.detach().cpu().contiguous().numpy()
        found.update(f"{name} {array.dtype} {array.shape}".encode())
        found.update(array.tobytes())
    return found.hexdigest()


def kept_beside(
    path: Path,
    metadata: Metadata,
    perception: torch.nn.Module,
    first: int,
    episodes: int,
    see: Callable[[], Arrays],
    *,
    at_once: int = 1,
    camera: str | None = None,
    console: Console | None = None,
) -> Arrays:
    """What ``see`` returns, or what it returned when it was called before.

    A file that holds more episodes than are asked for is good as well.

    Args:
        path: file of episodes.
        metadata: its metadata.
        perception: what sees.
        first: number of the first episode.
        episodes: number of episodes.
        see: looks at them; arrays whose first axis is episodes.
        at_once: episodes that ``see`` looks at together. Sums may differ in the last bit when
            fewer do, so a file with more episodes must have the same groups.
        camera: whose frames are seen.
        console: where it is said that nothing could be kept.
    """
    folder = path.with_name(f"{path.name}.tracks")
    key = _key(path, metadata, perception, camera)
    last = first + episodes
    for file in sorted(folder.glob(f"{key}-{first}-*.h5")):
        end = file.stem.rpartition("-")[2]
        whole = end.isdigit() and (int(end) == last or (int(end) > last and not episodes % at_once))
        found = _read(file, episodes) if whole else None
        if found is not None:
            return found
    arrays = see()
    try:
        _write(folder / f"{key}-{first}-{last}.h5", arrays)
    except OSError as error:
        # Data may lie where nothing can be written; the training goes on all the same.
        (console or Console()).print(f"{folder}: not kept ({error})", highlight=False)
    return arrays


def refuse_unequal(file: EpisodeReader) -> None:
    """Refuse episodes of different lengths: what is after the end of one is no image.

    Raises:
        ValueError: it is so; names the file.
    """
    if (file.lengths != file.metadata.steps).any():
        raise ValueError(
            f"{file.path}: episodes are {file.lengths.min()} to {file.metadata.steps} steps long; "
            "object models take episodes of one length"
        )


def _key(path: Path, metadata: Metadata, perception: torch.nn.Module, camera: str | None) -> str:
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    state = [(file.stat().st_size, file.stat().st_mtime_ns) for file in files]
    described = json.dumps([FORMAT, dataclasses.asdict(metadata), camera, state], sort_keys=True)
    whole = hashlib.sha256((checksum(perception) + described).encode())
    return whole.hexdigest()[:16]


def _read(file: Path, episodes: int) -> Arrays | None:
    """The first ``episodes`` that a file holds; None if it is damaged."""
    try:
        with h5py.File(file, "r") as store:
            if store.attrs.get("format") != FORMAT:
                return None
            found = {name: np.asarray(store[name][:episodes]) for name in store}
    except (OSError, KeyError, ValueError):
        return None
    return found if all(len(array) == episodes for array in found.values()) else None


def _write(file: Path, arrays: Arrays) -> None:
    try:
        with replacing(file) as temporary, h5py.File(temporary, "w") as store:
            store.attrs["format"] = FORMAT
            for name, array in arrays.items():
                store.create_dataset(name, data=array, track_times=False)
    except RuntimeError as error:  # what h5py makes of a full disk when it closes the file
        raise OSError(str(error)) from error
