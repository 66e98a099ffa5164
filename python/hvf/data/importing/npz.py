"""Episodes as NumPy arrays in one ``.npz`` file."""

from __future__ import annotations

import dataclasses
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hvf.data.importing.importer import Held, Import, Recording, Source, checked

_ACTIONS = ".actions"


@dataclasses.dataclass(frozen=True, kw_only=True)
class NpzImport(Import):
    """Import episodes from the arrays of an .npz file.

    Each array NAME, uint8 [T + 1, height, width, 3], is an episode, in the order of the file; its
    actions are NAME.actions, [T, A] or with one more that leads nowhere. Where no episode has any,
    nobody knows what was done: generators of subgoals can learn from that, dynamics cannot.

    For example:

        hvf data import npz sequences.npz --out data/sequences.h5 --hold-out 1
    """

    def sources(self) -> Mapping[Held, Source]:
        """All for training."""
        return {"train": NpzSource(self.path)}


class NpzSource(Source):
    """Episodes of an ``.npz`` file (:class:`~hvf.data.importing.importer.Source`)."""

    def __init__(self, path: Path) -> None:
        self.files = [path]
        self._path = path
        if not path.is_file():
            raise FileNotFoundError(f"path: there is no file {path}")
        try:
            with np.load(path) as arrays:
                if not isinstance(arrays, np.lib.npyio.NpzFile):
                    raise ValueError("a single array")
                listed = list(arrays.files)
        except (OSError, EOFError, ValueError, zipfile.BadZipFile) as error:
            raise ValueError(f"{path}: is no file of NumPy arrays ({error})") from error
        self._names = [name for name in listed if not name.endswith(_ACTIONS)]
        acted = {name.removesuffix(_ACTIONS) for name in listed if name.endswith(_ACTIONS)}
        if acted and acted != set(self._names):
            odd = min(acted ^ set(self._names))
            raise ValueError(f"{path}: {odd!r} has only frames, or only actions")
        self._acted = bool(acted)
        if not self._names:
            raise ValueError(f"{path}: is empty")
        self.lengths = [len(self.read(number).actions) for number in range(len(self._names))]

    def name_of(self, number: int) -> str:
        """A recording, for errors."""
        return f"{self._path}: {self._names[number]}"

    def read(self, number: int) -> Recording:
        """Read an episode; see :class:`~hvf.data.importing.importer.Source`."""
        what, name = self.name_of(number), self._names[number]
        frames = self._array(name)
        if frames.dtype != np.uint8 or frames.ndim != 4 or frames.shape[3] != 3:
            raise ValueError(f"{what}: expected uint8 [T, H, W, 3], got {_kind(frames)}")
        actions = self._array(name + _ACTIONS) if self._acted else np.empty((len(frames), 0))
        if actions.ndim != 2 or actions.dtype.kind not in "fiu":
            raise ValueError(f"{what}: actions must be numbers [T, A], got {_kind(actions)}")
        return checked(what, {"main": frames.astype(np.uint8)}, actions.astype(np.float32))

    def _array(self, name: str) -> NDArray[np.generic]:
        try:
            with np.load(self._path) as arrays:
                found: NDArray[np.generic] = arrays[name]
                return found
        except (OSError, EOFError, ValueError, zipfile.BadZipFile, zlib.error) as error:
            raise ValueError(f"{self._path}: {name} is damaged ({error})") from error


def _kind(array: NDArray[np.generic]) -> str:
    return f"{array.dtype} {list(array.shape)}"
