"""Kinds of files that episodes are read from, by name; :func:`open_episodes` finds the right one.

The project's own is ``hvf``, :mod:`hvf.data.formats.hdf5`. Another package adds one by
``FORMATS.register("mine", MINE)`` or by an entry point of the group ``hvf.formats``, where ``MINE``
is a :class:`Format`; everything that reads episodes can read it then.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from hvf.data.episodes import Episodes, Metadata
from hvf.registry import Registry


@runtime_checkable
class EpisodeReader(Protocol):
    """Recorded episodes, open for reading.

    Letters in shapes are those of :mod:`hvf.data.episodes`; ``N`` and ``T`` are
    ``metadata.episodes`` and ``metadata.steps``.

    Attributes:
        path: file or folder.
        metadata: where the episodes come from.
    """

    path: Path
    metadata: Metadata

    @property
    def lengths(self) -> NDArray[np.int64]:
        """Steps of each episode, int64 ``[N]``, 1 to ``T``."""
        ...

    @property
    def frame_shape(self) -> tuple[int, int, int]:
        """Height, width and channels (3) of a frame."""
        ...

    @property
    def action_dim(self) -> int:
        """Dimensions of an action, ``A``."""
        ...

    def __len__(self) -> int:
        """Number of episodes, ``N``."""
        ...

    def read(self, first: int, count: int) -> Episodes:
        """Episodes ``first`` to ``first + count``, each ``T`` steps long with its padding.

        Raises:
            IndexError: beyond the last.
            ValueError: a damaged episode; names ``path``.
        """
        ...

    def read_into(self, index: int, frames: NDArray[np.uint8], actions: NDArray[Any]) -> None:
        """Fill ``frames [T+1,H,W,3]`` and ``actions [T,A]`` with an episode, then with zeros.

        Raises:
            ValueError: a damaged episode; names ``path``.
        """
        ...

    def close(self) -> None:
        """Close it; reading after that is an error."""
        ...

    def __enter__(self) -> EpisodeReader: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...


@dataclass(frozen=True)
class Format:
    """A kind of files (or folders) of episodes.

    Attributes:
        name: as it is registered.
        suffixes: how names of such files end, with the dot; only for what ``sniff`` does not know.
        sniff: whether a path is certainly of this kind, by what is in it. Must be quick, and
            False, not an error, for anything else.
        read: opens a path, with the frames of a camera by name or of the first one (None). Raises
            ValueError, naming the path, for what is damaged or of another kind, and for a camera
            that there is not.
    """

    name: str
    suffixes: tuple[str, ...]
    sniff: Callable[[Path], bool]
    read: Callable[[Path, str | None], EpisodeReader]

    def __post_init__(self) -> None:
        if not self.name:
            raise ValueError("name: must not be empty")
        for suffix in self.suffixes:
            if not suffix.startswith("."):
                raise ValueError(f"suffixes: must begin with a dot, got {suffix!r}")


FORMATS: Registry[Format] = Registry("format", "hvf.formats", {"hvf": "hvf.data.formats.hdf5:HVF"})
"""Kinds of files of episodes."""


def open_episodes(
    path: str | Path, environment: str | None = None, *, camera: str | None = None
) -> EpisodeReader:
    """Open recorded episodes of any registered format, which is found by what the file holds.

    Args:
        path: file, or folder where a format has folders.
        environment: if given, the environment that the episodes must be from.
        camera: whose frames to read; the first one's by default.

    Raises:
        FileNotFoundError: nothing at ``path``.
        ValueError: no format knows the file, or it is damaged, from another environment, or
            without this camera; names ``path``.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such data file")
    reader = _format_of(path).read(path, camera)
    try:
        check_environment(path, reader.metadata, environment)
    except ValueError:
        reader.close()
        raise
    return reader


def check_environment(path: Path, metadata: Metadata, environment: str | None) -> None:
    """Refuse episodes from another environment, if one is wanted.

    Raises:
        ValueError: it is so; names ``path``.
    """
    if environment is not None and metadata.environment != environment:
        raise ValueError(
            f"{path}: is from environment {metadata.environment!r}, expected {environment!r}"
        )


def check_equal_lengths(reader: EpisodeReader, what: str) -> None:
    """Refuse episodes of different lengths, for what would take padding for frames.

    Args:
        reader: the episodes.
        what: takes equally long ones only.

    Raises:
        ValueError: they differ in length; names the path and ``what``.
    """
    shortest, steps = int(reader.lengths.min()), reader.metadata.steps
    if shortest != steps:
        raise ValueError(
            f"{reader.path}: has episodes of {shortest} to {steps} steps, {what} takes equally "
            "long ones"
        )


def _format_of(path: Path) -> Format:
    # One after another: a format that is not needed is not imported.
    for name in FORMATS:
        if FORMATS[name].sniff(path):
            return FORMATS[name]
    # What no format knows may be a damaged file of the one that its name tells: that one says what
    # is wrong with it.
    for name in FORMATS:
        if path.name.endswith(FORMATS[name].suffixes):
            return FORMATS[name]
    known = ", ".join(f"{name} ({' '.join(FORMATS[name].suffixes)})" for name in FORMATS)
    raise ValueError(f"{path}: not a file of episodes, or damaged; known formats: {known}")
