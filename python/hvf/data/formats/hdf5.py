"""The project's own format: episodes in one HDF5 file.

Letters in shapes are those of :mod:`hvf.data.episodes`.

====================  ========================  ==================================================
``frames``            uint8 ``[N,T+1,H,W,3]``   of the first camera; one chunk per episode, gzip
                                                or as it is
``frames of <name>``  uint8 ``[N,T+1,H,W,3]``   of each further camera; other H and W are possible
``actions``           float32 ``[N,T,A]``       action ``t`` leads from frame ``t`` to ``t + 1``;
                                                ``A`` is 0 where nobody knows what was done
``states``            float64 ``[N,T+1,S]``     true states, for probes and evaluation, never for
                                                training; not there where nobody knows them
``lengths``           int64 ``[N]``             steps of each episode, 1 to T; the rest is zeros
====================  ========================  ==================================================

Attributes of the file: ``format`` (``hvf-episodes-2``), ``environment``, ``parameters`` (JSON),
``seed`` (not there for what was recorded in the world), ``steps``, ``episodes``, ``versions``
(JSON), ``diverged``, ``cameras`` (JSON), ``action_names`` (JSON), ``action_low`` and
``action_high`` (JSON, null if not known). Version 1 has neither ``lengths`` nor the last four, and
always has states; it can be read.

Episodes repeat most of their pixels, which gzip's 32 KB window sees across frames of 12 KB: 100
steps of the maze take about 30 KB, and decode at 100,000 frames/s. Padding takes next to nothing.
Frames of real cameras are written as they are, unless somebody asks: their noise does not repeat.
"""

from __future__ import annotations

import contextlib
import errno
import json
import zlib
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from hvf.closing import Closing
from hvf.data.episodes import Episodes, Metadata
from hvf.data.formats import Format, check_environment

FORMAT = "hvf-episodes-2"
_VERSION_1 = "hvf-episodes-1"
# Level 1 compresses at 400 MB/s a core here, level 4 at 170 MB/s to 60% of the size.
_GZIP_LEVEL = 1
# More than gzip ever makes of a byte.
_MOST_DEFLATED = 1100
# What h5py and json make of damage, beside an OSError.
_DAMAGE = (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError)

Views = Mapping[str, NDArray[np.uint8]]


def write_episodes(
    path: Path,
    metadata: Metadata,
    episodes: Episodes,
    threads: int = 2,
    views: Views | None = None,
    *,
    compress: bool = True,
) -> None:
    """Write a new file at ``path``, in place: wrap with :func:`hvf.files.replacing`.

    Args:
        path: file to write.
        metadata: where the episodes come from.
        episodes: the episodes, as the first of ``metadata.cameras`` saw them.
        threads: how many compress frames.
        views: frames of the further cameras by their names, in the order of ``metadata.cameras``.
        compress: whether frames are compressed; gzip finds nothing in a camera's noise, and takes
            many times longer to read than the file.

    Raises:
        ValueError: ``metadata``, ``episodes`` and ``views`` disagree.
        TypeError: views of another dtype.
        OSError: the file cannot be written.
    """
    if (metadata.episodes, metadata.steps) != episodes.actions.shape[:2]:
        raise ValueError(
            f"metadata says {metadata.episodes} episodes of {metadata.steps} steps, "
            f"actions has {episodes.actions.shape}"
        )
    metadata.check_actions(episodes.actions.shape[2])
    views = dict(views or {})
    if metadata.cameras[1:] != tuple(views):
        raise ValueError(f"views: metadata names {metadata.cameras[1:]}, got {tuple(views)}")
    for name, frames in views.items():
        # As Episodes does it.
        try:
            Episodes(frames, episodes.actions)
        except (ValueError, TypeError) as error:
            raise type(error)(f"views: camera {name!r}: {error}") from error

    lengths = episodes.lengths

    def packed(frames: NDArray[np.uint8], length: int) -> bytes | NDArray[np.uint8]:
        whole = np.ascontiguousarray(_ended(frames[None], np.array([length + 1])))
        return zlib.compress(whole.data, _GZIP_LEVEL) if compress else whole

    with _create(path, metadata) as file, ThreadPoolExecutor(max(1, threads)) as pool:
        seen = {"frames": episodes.frames, **{_seen_by(name): views[name] for name in views}}
        for name, frames in seen.items():
            written = _dataset(file, name, frames.shape, np.uint8, compress)
            for i, chunk in enumerate(pool.map(packed, frames, lengths)):
                written.id.write_direct_chunk((i, 0, 0, 0, 0), chunk)
        actions = _dataset(file, "actions", episodes.actions.shape, np.float32)
        actions[...] = _ended(episodes.actions, lengths)
        if episodes.states is not None:
            states = _dataset(file, "states", episodes.states.shape, np.float64)
            states[...] = _ended(episodes.states, lengths + 1)
        file.create_dataset("lengths", data=lengths, track_times=False)


def join_files(path: Path, metadata: Metadata, parts: Sequence[Path]) -> None:
    """Write the episodes of ``parts``, in order, to a new file at ``path``, in place.

    Compressed chunks are copied as they are.

    Raises:
        ValueError: ``parts`` do not hold ``metadata.episodes`` episodes, one is damaged, or they
            hold other arrays than the first.
        FileNotFoundError: one is not there.
        OSError: the file cannot be written.
    """
    with _create(path, metadata) as file:
        with EpisodeFile(parts[0]) as source:
            shapes = _kinds(source)
        lengths = np.zeros(metadata.episodes, np.int64)
        for name, (shape, dtype, compression) in shapes.items():
            whole = (metadata.episodes, *shape)
            new = _dataset(file, name, whole, dtype, compression is not None)
            rest = (0,) * len(shape)
            first = 0
            for part in parts:
                with EpisodeFile(part) as source:
                    if _kinds(source) != shapes:
                        raise ValueError(f"{part}: holds other arrays than {parts[0]}")
                    array = source.arrays()[name]
                    count = min(len(source), metadata.episodes - first)
                    for i in range(count if array.size else 0):
                        mask, chunk = array.id.read_direct_chunk((i, *rest))
                        new.id.write_direct_chunk((first + i, *rest), chunk, mask)
                    lengths[first : first + count] = source.lengths[:count]
                    first += len(source)
            if first < metadata.episodes:
                raise ValueError(f"parts hold {first} episodes, expected {metadata.episodes}")
        file.create_dataset("lengths", data=lengths, track_times=False)


class EpisodeFile(Closing):
    """A file of episodes, open for reading.

    Args:
        path: a file that ``hvf collect`` or :func:`write_episodes` wrote.
        environment: if given, the environment that the file must be from.
        camera: whose frames to read; the first one's by default.

    Attributes:
        path: the file.
        metadata: where the episodes come from.
        lengths: steps of each episode, int64 ``[N]``.
        version: format and version of the file, such as ``hvf-episodes-2``.

    Raises:
        FileNotFoundError: no file at ``path``.
        ValueError: not HDF5, truncated, of another program or version, inconsistent, from another
            environment, or without this camera; names ``path``.
    """

    lengths: NDArray[np.int64]

    def __init__(
        self, path: str | Path, environment: str | None = None, camera: str | None = None
    ) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise FileNotFoundError(f"{path}: no such data file")
        try:
            self._file = h5py.File(self.path, "r")
        except OSError as error:
            raise ValueError(f"{path}: not an HDF5 file, or truncated ({error})") from error
        try:
            self.metadata, self.lengths = self._check()
            check_environment(self.path, self.metadata, environment)
            self._frames = self._frames_of(camera)
        except BaseException:
            self._file.close()
            raise

    def __len__(self) -> int:
        return self.metadata.episodes

    def close(self) -> None:
        """Close the file; reading after that is an error."""
        self._file.close()

    @property
    def frame_shape(self) -> tuple[int, int, int]:
        """Height, width and channels of a frame."""
        height, width, channels = self.dataset("frames").shape[2:]
        return int(height), int(width), int(channels)

    @property
    def action_dim(self) -> int:
        """Dimensions of an action, ``A``."""
        return int(self.dataset("actions").shape[2])

    def dataset(self, name: str) -> Any:
        """The h5py dataset ``frames`` (of this camera), ``actions`` or ``states``.

        Raises:
            KeyError: there are no states.
        """
        return self._file[self._frames if name == "frames" else name]

    def arrays(self) -> dict[str, Any]:
        """All datasets of the file but the lengths, by name, with one chunk per episode."""
        names = ["frames", *map(_seen_by, self.metadata.cameras[1:]), "actions", *self._states()]
        return {name: self._file[name] for name in names}

    def read(self, first: int, count: int) -> Episodes:
        """Decode episodes ``first`` to ``first + count``.

        Raises:
            IndexError: beyond the file.
            ValueError: a damaged episode; names the file.
        """
        if first < 0 or count < 1 or first + count > len(self):
            raise IndexError(f"episodes {first} to {first + count} of {self.path}: has {len(self)}")
        last = first + count
        try:
            return Episodes(
                self.dataset("frames")[first:last],
                self.dataset("actions")[first:last],
                self.dataset("states")[first:last] if self._states() else None,
                lengths=self.lengths[first:last],
            )
        except _DAMAGE as error:
            raise ValueError(f"{self.path}: a damaged episode ({error})") from error

    def read_into(self, index: int, frames: NDArray[np.uint8], actions: NDArray[Any]) -> None:
        """Decode episode ``index`` into ``frames [T+1,H,W,3]`` and ``actions [T,A]``.

        What is after its end is filled with zeros.

        Raises:
            ValueError: a damaged episode; names the file.
        """
        try:
            self.dataset("frames").read_direct(frames, np.s_[index])
            if actions.size:
                self.dataset("actions").read_direct(actions, np.s_[index])
        except (OSError, RuntimeError) as error:
            raise ValueError(f"{self.path}: episode {index} is damaged ({error})") from error

    def _states(self) -> list[str]:
        return ["states"] if "states" in self._file else []

    def _frames_of(self, camera: str | None) -> str:
        """Name of the dataset of a camera's frames."""
        cameras = self.metadata.cameras
        if camera is not None and camera not in cameras:
            raise ValueError(f"{self.path}: has no camera {camera!r}, only {list(cameras)}")
        return "frames" if camera is None or camera == cameras[0] else _seen_by(camera)

    def _check(self) -> tuple[Metadata, NDArray[np.int64]]:
        try:
            self.version = str(self._file.attrs.get("format"))
        except _DAMAGE as error:
            raise ValueError(f"{self.path}: damaged ({error})") from error
        if self.version not in (FORMAT, _VERSION_1):
            raise ValueError(
                f"{self.path}: is not a file of episodes that this version of the program reads "
                f"(format {self.version!r}, expected {FORMAT!r})"
            )
        first = self.version == _VERSION_1
        try:
            metadata = _read_metadata(self._file.attrs, first)
            names = ["actions", "frames", *map(_seen_by, metadata.cameras[1:])]
            if first or self._states():
                names.append("states")
            n, t = metadata.episodes, metadata.steps
            size = self.path.stat().st_size
            for name in names if first else [*names, "lengths"]:
                _check_own(self._file, name)
            for name in names:
                array = self._file[name]
                _check_array(name, array.shape, array.dtype, n, t)
                if array.nbytes > _MOST_DEFLATED * size:
                    raise ValueError(f"{name} {array.shape} are more than the file can hold")
            metadata.check_actions(self._file["actions"].shape[2])
            lengths = np.full(n, t, np.int64)
            if not first:
                array = self._file["lengths"]
                if array.dtype != np.int64 or array.shape != (n,):
                    raise ValueError(f"lengths are {array.dtype} {array.shape}")
                array.read_direct(lengths)
            if lengths.min() < 1 or lengths.max() > t:
                raise ValueError(f"lengths are {lengths.min()} to {lengths.max()} of {t} steps")
        except _DAMAGE as error:
            raise ValueError(f"{self.path}: damaged ({error})") from error
        return metadata, lengths


def _sniff(path: Path) -> bool:
    try:
        with h5py.File(path, "r") as file:
            return str(file.attrs.get("format")).startswith("hvf-episodes-")
    except _DAMAGE:
        return False


HVF = Format("hvf", (".h5", ".hdf5"), _sniff, lambda path, camera: EpisodeFile(path, camera=camera))
"""This format, for the registry."""


def _check_own(file: Any, name: str) -> None:
    """Refuse what is in another file: a file of data has no business to open it."""
    array = file[name]
    if not isinstance(file.get(name, getlink=True), h5py.HardLink):
        raise ValueError(f"{name} is a link")
    if array.external or array.is_virtual:
        raise ValueError(f"{name} points to another file")


def _check_array(name: str, shape: tuple[int, ...], dtype: Any, n: int, t: int) -> None:
    rank, kind = {"actions": (3, "float32"), "states": (3, "float64")}.get(name, (5, "uint8"))
    wanted = (n, t if name == "actions" else t + 1)
    empty = 0 in (shape[:2] if name == "actions" else shape)
    if shape[:2] != wanted or len(shape) != rank or dtype != kind or empty:
        raise ValueError(f"{n} episodes of {t} steps do not fit {name}: {dtype} {shape}")
    if rank == 5 and shape[4] != 3:
        raise ValueError(f"{name} have {shape[4]} channels, expected 3")


def _read_metadata(attributes: Any, first: bool) -> Metadata:
    later: dict[str, Any] = {}
    if not first:
        for name in ("cameras", "action_names", "action_low", "action_high"):
            value = json.loads(attributes[name])
            later[name] = None if value is None else tuple(value)
    return Metadata(
        environment=str(attributes["environment"]),
        parameters=json.loads(attributes["parameters"]),
        seed=int(attributes["seed"]) if first or "seed" in attributes else None,
        steps=int(attributes["steps"]),
        episodes=int(attributes["episodes"]),
        versions=json.loads(attributes["versions"]),
        diverged=int(attributes.get("diverged", 0)),
        **later,
    )


@contextlib.contextmanager
def _create(path: Path, metadata: Metadata) -> Iterator[Any]:
    try:
        with h5py.File(path, "w") as file:
            file.attrs["format"] = FORMAT
            file.attrs["environment"] = metadata.environment
            file.attrs["parameters"] = json.dumps(dict(metadata.parameters), sort_keys=True)
            if metadata.seed is not None:
                file.attrs["seed"] = metadata.seed
            file.attrs["steps"] = metadata.steps
            file.attrs["episodes"] = metadata.episodes
            file.attrs["versions"] = json.dumps(dict(metadata.versions), sort_keys=True)
            file.attrs["diverged"] = metadata.diverged
            for name in ("cameras", "action_names", "action_low", "action_high"):
                file.attrs[name] = json.dumps(getattr(metadata, name))
            yield file
    except RuntimeError as error:  # what h5py makes of a full disk when it closes the file
        raise OSError(errno.EIO, str(error), str(path)) from error


def _dataset(
    file: Any, name: str, shape: tuple[int, ...], dtype: Any, compress: bool = False
) -> Any:
    """A new dataset with one chunk per episode."""
    return file.create_dataset(
        name,
        shape,
        dtype,
        # There are no chunks of nothing.
        chunks=None if 0 in shape else (1, *shape[1:]),
        track_times=False,
        **({"compression": "gzip", "compression_opts": _GZIP_LEVEL} if compress else {}),
    )


def _kinds(file: EpisodeFile) -> dict[str, tuple[Any, Any, Any]]:
    """Shape of an episode, type and compression of all arrays of a file."""
    return {
        name: (array.shape[1:], array.dtype, array.compression)
        for name, array in file.arrays().items()
    }


def _seen_by(camera: str) -> str:
    """Name of the dataset of a further camera's frames."""
    return f"frames of {camera}"


def _ended(array: NDArray[Any], ends: NDArray[np.int64]) -> NDArray[Any]:
    """``array`` with zeros from entry ``ends[i]`` of each ``array[i]`` on."""
    over = np.arange(array.shape[1]) >= ends[:, None]
    if not over.any():
        return array
    ended: NDArray[Any] = array.copy()
    ended[over] = 0
    return ended
