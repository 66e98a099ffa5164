"""Episodes in one HDF5 file.

Shapes: ``N`` episodes of ``T`` steps, frames of ``H`` x ``W`` pixels, ``A`` action dimensions,
``S`` state dimensions.

====================  ========================  ==================================================
``frames``            uint8 ``[N,T+1,H,W,3]``   gzip, one chunk per episode
``actions``           float32 ``[N,T,A]``       action ``t`` leads from frame ``t`` to ``t + 1``
``states``            float64 ``[N,T+1,S]``     true states, for probes and evaluation, never for
                                                training
====================  ========================  ==================================================

Attributes of the file: ``format``, ``environment``, ``parameters`` (JSON), ``seed``, ``steps``,
``episodes``, ``versions`` (JSON), ``diverged``. Episodes repeat most of their pixels, which gzip's
32 KB window sees across frames of 12 KB: 100 steps of the maze take about 30 KB, and decode at
100,000 frames/s.
"""

from __future__ import annotations

import contextlib
import errno
import json
import zlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from hvf.data.episodes import Episodes, Metadata

FORMAT = "hvf-episodes-1"
_DATASETS = ("frames", "actions", "states")
# Level 1 compresses at 400 MB/s a core here, level 4 at 170 MB/s to 60% of the size.
_GZIP_LEVEL = 1


def write_episodes(path: Path, metadata: Metadata, episodes: Episodes, threads: int = 2) -> None:
    """Write a new file at ``path``, in place: wrap with :func:`hvf.files.replacing`.

    Raises:
        ValueError: ``metadata`` and ``episodes`` disagree.
        OSError: the file cannot be written.
    """
    if (metadata.episodes, metadata.steps) != episodes.actions.shape[:2]:
        raise ValueError(
            f"metadata says {metadata.episodes} episodes of {metadata.steps} steps, "
            f"actions has {episodes.actions.shape}"
        )

    def compress(frames: NDArray[np.uint8]) -> bytes:
        return zlib.compress(np.ascontiguousarray(frames).data, _GZIP_LEVEL)

    with _create(path, metadata) as file, ThreadPoolExecutor(max(1, threads)) as pool:
        frames = _dataset(file, "frames", episodes.frames.shape, np.uint8)
        for i, chunk in enumerate(pool.map(compress, episodes.frames)):
            frames.id.write_direct_chunk((i, 0, 0, 0, 0), chunk)
        _dataset(file, "actions", episodes.actions.shape, np.float32)[...] = episodes.actions
        _dataset(file, "states", episodes.states.shape, np.float64)[...] = episodes.states


def join_files(path: Path, metadata: Metadata, parts: list[Path]) -> None:
    """Write the episodes of ``parts``, in order, to a new file at ``path``, in place.

    Compressed chunks are copied as they are.

    Raises:
        ValueError: ``parts`` do not hold ``metadata.episodes`` episodes, or one is damaged.
        OSError: the file cannot be written.
    """
    with _create(path, metadata) as file:
        for name in _DATASETS:
            first = 0
            for part in parts:
                with EpisodeFile(part) as source:
                    old = source.dataset(name)
                    shape = (metadata.episodes, *old.shape[1:])
                    new = file[name] if first else _dataset(file, name, shape, old.dtype)
                    rest = (0,) * (len(shape) - 1)
                    for i in range(min(len(source), metadata.episodes - first)):
                        mask, chunk = old.id.read_direct_chunk((i, *rest))
                        new.id.write_direct_chunk((first + i, *rest), chunk, mask)
                    first += len(source)
            if first < metadata.episodes:
                raise ValueError(f"parts hold {first} episodes, expected {metadata.episodes}")


class EpisodeFile:
    """A file of episodes, open for reading.

    Args:
        path: a file that ``hvf collect`` wrote.
        environment: if given, the environment that the file must be from.

    Raises:
        FileNotFoundError: no file at ``path``.
        ValueError: not HDF5, truncated, of another program or version, inconsistent, or from
            another environment; names ``path``.
    """

    def __init__(self, path: str | Path, environment: str | None = None) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise FileNotFoundError(f"{path}: no such data file")
        try:
            self._file = h5py.File(self.path, "r")
        except OSError as error:
            raise ValueError(f"{path}: not an HDF5 file, or truncated ({error})") from error
        try:
            self.metadata = self._check(environment)
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> EpisodeFile:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

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
        """The h5py dataset ``frames``, ``actions`` or ``states``."""
        return self._file[name]

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
            return Episodes(*(self.dataset(name)[first:last] for name in _DATASETS))
        except OSError as error:
            raise ValueError(f"{self.path}: a damaged episode ({error})") from error

    def read_into(self, index: int, frames: NDArray[np.uint8], actions: NDArray[Any]) -> None:
        """Decode episode ``index`` into ``frames [T+1,H,W,3]`` and ``actions [T,A]``.

        Raises:
            ValueError: a damaged episode; names the file.
        """
        try:
            self.dataset("frames").read_direct(frames, np.s_[index])
            self.dataset("actions").read_direct(actions, np.s_[index])
        except OSError as error:
            raise ValueError(f"{self.path}: episode {index} is damaged ({error})") from error

    def _check(self, environment: str | None) -> Metadata:
        attributes = self._file.attrs
        found = attributes.get("format")
        if found != FORMAT:
            raise ValueError(
                f"{self.path}: is not a file of episodes of this program "
                f"(format {found!r}, expected {FORMAT!r})"
            )
        try:
            metadata = Metadata(
                environment=str(attributes["environment"]),
                parameters=json.loads(attributes["parameters"]),
                seed=int(attributes["seed"]),
                steps=int(attributes["steps"]),
                episodes=int(attributes["episodes"]),
                versions=json.loads(attributes["versions"]),
                diverged=int(attributes.get("diverged", 0)),
            )
            shapes = [self._file[name].shape for name in _DATASETS]
            dtypes = [self._file[name].dtype for name in _DATASETS]
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise ValueError(f"{self.path}: damaged metadata ({error})") from error
        n, t = metadata.episodes, metadata.steps
        sizes = [shape[:2] for shape in shapes]
        ranks = [len(shape) for shape in shapes]
        if (
            n < 1
            or sizes != [(n, t + 1), (n, t), (n, t + 1)]
            or ranks != [5, 3, 3]
            or dtypes != [np.uint8, np.float32, np.float64]
        ):
            raise ValueError(
                f"{self.path}: damaged: {n} episodes of {t} steps do not fit arrays {shapes}"
            )
        if environment is not None and metadata.environment != environment:
            raise ValueError(
                f"{self.path}: is from environment {metadata.environment!r}, "
                f"expected {environment!r}"
            )
        return metadata


@contextlib.contextmanager
def _create(path: Path, metadata: Metadata) -> Iterator[Any]:
    try:
        with h5py.File(path, "w") as file:
            file.attrs["format"] = FORMAT
            file.attrs["environment"] = metadata.environment
            file.attrs["parameters"] = json.dumps(dict(metadata.parameters), sort_keys=True)
            file.attrs["seed"] = metadata.seed
            file.attrs["steps"] = metadata.steps
            file.attrs["episodes"] = metadata.episodes
            file.attrs["versions"] = json.dumps(dict(metadata.versions), sort_keys=True)
            file.attrs["diverged"] = metadata.diverged
            yield file
    except RuntimeError as error:  # what h5py makes of a full disk when it closes the file
        raise OSError(errno.EIO, str(error)) from error


def _dataset(file: Any, name: str, shape: tuple[int, ...], dtype: Any) -> Any:
    """A new dataset with one chunk per episode."""
    compression = {"compression": "gzip", "compression_opts": _GZIP_LEVEL}
    return file.create_dataset(
        name,
        shape,
        dtype,
        chunks=(1, *shape[1:]),
        track_times=False,
        **(compression if name == "frames" else {}),
    )
