"""A folder of videos, or of folders of images, with a table of actions for each."""

from __future__ import annotations

import csv
import dataclasses
import itertools
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from numpy.typing import NDArray

from hvf.data.importing.importer import Held, Import, Recording, Source, checked
from hvf.images import read_image

_IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
_VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")
_TABLE = ".csv"


@dataclasses.dataclass(frozen=True, kw_only=True)
class FolderImport(Import):
    """Import a folder of videos or image folders, with a CSV of actions for each.

    Each of these in PATH is an episode, in the order of their names (2 before 10):

        NAME.mp4 (mov, avi, mkv, webm, gif)   with NAME.csv beside it

        NAME/ of images (png, jpg, ...)       with NAME.csv beside it, or NAME/actions.csv in it

    A row of the CSV is an action, a column a dimension of it; a first row of names is possible. Row
    t is what was done between frame t and frame t + 1: one row less than there are frames, or as
    many, and the last one is left out. Where no episode has a CSV, nobody knows what was done:
    generators of subgoals can learn from that, dynamics cannot. Folders train and test in PATH are
    splits. Videos need pip install 'hvf[video]'. Example:

        hvf data import folder recordings --out data/mine.h5 --size 64x64
    """

    def sources(self) -> Mapping[Held, Source]:
        """The folders ``train`` and ``test``, or all of the folder for training."""
        if not self.path.is_dir():
            raise FileNotFoundError(f"path: there is no folder {self.path}")
        splits: tuple[Held, ...] = ("train", "test")
        found: dict[Held, Source] = {
            split: FolderSource(self.path / split)
            for split in splits
            if (self.path / split).is_dir()
        }
        if "test" in found and "train" not in found:
            raise ValueError(f"path: {self.path} has a folder test, but no folder train")
        return found if "train" in found else {"train": FolderSource(self.path)}


class FolderSource(Source):
    """Episodes of a folder (:class:`~hvf.data.importing.importer.Source`)."""

    def __init__(self, path: Path) -> None:
        self._episodes = sorted(filter(_is_episode, path.iterdir()), key=_natural)
        if not self._episodes:
            raise ValueError(f"path: {path} has neither videos nor folders of images")
        tables = [_table_of(episode) for episode in self._episodes]
        without = [e for e, table in zip(self._episodes, tables, strict=True) if table is None]
        if without and len(without) < len(tables):
            raise ValueError(f"{without[0]}: has no CSV of actions, others have")
        self.files = [*self._episodes, *(table for table in tables if table)]
        self._actions = [_rows(table) if table else None for table in tables]
        names = {names for read in self._actions if read for names in [read[0]]}
        widths = {read[1].shape[1] for read in self._actions if read}
        if len(widths) > 1 or len(names) > 1:
            raise ValueError(f"path: tables in {path} have different columns")
        self.action_names = names.pop() if names else ()
        self.lengths = [_count(episode) - 1 for episode in self._episodes]

    def name_of(self, number: int) -> str:
        """A recording, for errors."""
        return str(self._episodes[number])

    def read(self, number: int) -> Recording:
        """Read an episode; see :class:`~hvf.data.importing.importer.Source`."""
        path, read = self._episodes[number], self._actions[number]
        frames = np.stack(list(_equal(path)))
        actions = np.empty((len(frames), 0), np.float32) if read is None else read[1]
        return checked(path, {"main": frames}, actions)


def _is_episode(path: Path) -> bool:
    if path.is_dir():
        return any(file.suffix.lower() in _IMAGES for file in path.iterdir())
    return path.suffix.lower() in (*_VIDEOS, ".gif")


def _natural(path: Path) -> list[tuple[int, str]]:
    """Names with numbers in the order of the numbers."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]


def _table_of(episode: Path) -> Path | None:
    inside, beside = episode / "actions.csv", episode.with_suffix(_TABLE)
    if episode.is_dir():
        beside = episode.with_name(episode.name + _TABLE)
        if inside.is_file():
            return inside
    return beside if beside.is_file() else None


def _images(folder: Path) -> list[Path]:
    found = [file for file in folder.iterdir() if file.suffix.lower() in _IMAGES]
    return sorted(found, key=_natural)


def _count(episode: Path) -> int:
    """Frames of an episode. What the header of a video says of their number may be wrong."""
    if episode.is_dir():
        return len(_images(episode))
    return sum(1 for _ in _frames(episode))


def _equal(episode: Path) -> Iterator[NDArray[np.uint8]]:
    """Frames of an episode, all of one size."""
    frames = _frames(episode)
    first = next(frames, None)
    if first is None:
        raise ValueError(f"{episode}: has no frames")
    for number, frame in enumerate(itertools.chain([first], frames)):
        if frame.shape != first.shape:
            raise ValueError(
                f"{episode}: frame {number} is {list(frame.shape)}, the first {list(first.shape)}"
            )
        yield frame


def _frames(episode: Path) -> Iterator[NDArray[np.uint8]]:
    if episode.is_dir():
        for number, file in enumerate(_images(episode)):
            yield read_image(f"{episode}: frame {number}", file)
        return
    yield from read_video(episode)


def read_video(path: Path) -> Iterator[NDArray[np.uint8]]:
    """Frames of a video, uint8 ``[H, W, 3]`` each.

    Raises:
        ImportError: what reads videos is not installed; says how to.
        ValueError: it is no video, or damaged; names it.
    """
    gif = path.suffix.lower() == ".gif"
    try:
        frames = iio.imiter(path, **({"plugin": "pillow", "mode": "RGB"} if gif else _PYAV))
        for frame in frames:
            yield np.asarray(frame, np.uint8)
    except ImportError as error:
        raise ImportError(f"{path}: to read videos, pip install 'hvf[video]'") from error
    except Exception as error:  # for damage, readers raise whatever they come upon
        raise ValueError(f"{path}: is no video, or damaged ({error})") from error


_PYAV = {"plugin": "pyav"}


def _rows(table: Path) -> tuple[tuple[str, ...], NDArray[np.float32]]:
    """Names of the columns, or nothing, and the numbers of a CSV."""
    try:
        with table.open(newline="", encoding="utf-8-sig") as file:
            lines = [(number, row) for number, row in enumerate(csv.reader(file), 1) if row]
    except (csv.Error, UnicodeDecodeError) as error:
        raise ValueError(f"{table}: is no CSV ({error})") from error
    names: tuple[str, ...] = ()
    if lines and not all(map(_is_number, lines[0][1])):
        names = tuple(word.strip() for word in lines.pop(0)[1])
    if not lines:
        raise ValueError(f"{table}: has no rows of actions")
    width = len(lines[0][1])
    for number, row in lines:
        if len(row) != width or (names and len(names) != width):
            raise ValueError(f"{table}: row {number} has {len(row)} columns, expected {width}")
        if not all(map(_is_number, row)):
            raise ValueError(f"{table}: row {number} is not all numbers: {', '.join(row)[:80]}")
    return names, np.array([row for _, row in lines], np.float32)


def _is_number(word: str) -> bool:
    try:
        return bool(np.isfinite(np.float32(word)))
    except ValueError:
        return False
