"""The BAIR robot pushing data set (Ebert et al., 2017), as it is published: ``softmotion30_44k``.

TFRecords of one ``tf.train.Example`` an episode: 30 frames ``{i}/image_main/encoded`` and
``{i}/image_aux1/encoded`` (raw bytes of 64x64x3), ``{i}/action`` (4 numbers) and
``{i}/endeffector_pos`` (3 numbers). Its folders ``train`` and ``test`` are the makers' splits.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hvf.data.importing.example import Example, Feature, byte_strings, floats
from hvf.data.importing.importer import Held, Import, Recording, Source, checked
from hvf.data.importing.records import RecordSource
from hvf.data.importing.tfrecord import find_record_files

FRAMES = 30
_SHAPE = (64, 64, 3)
_ACTIONS, _STATES = 4, 3
# Files say how many episodes they have. Cut off between two records, a file shows no other sign.
_NAMED = re.compile(r"traj_(\d+)_to_(\d+)\.")


@dataclasses.dataclass(frozen=True, kw_only=True)
class BairImport(Import):
    """Import the BAIR robot pushing data set as it is published (softmotion30_44k).

    PATH is the folder that holds train and test, one of these two, or a single file. Actions (4
    numbers) and cameras (main and aux1) are as recorded, the place of the gripper becomes the
    states. The paper's size of frames is --size 48x64. Example:

        hvf data import bair softmotion30_44k --out data/bair.h5 --size 48x64

    Attributes:
        cameras: whose frames to take: main, aux1 or both; models see the first one.
    """

    cameras: tuple[str, ...] = ("main", "aux1")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.cameras or not set(self.cameras) <= {"main", "aux1"}:
            raise ValueError(f"cameras: must be among main, aux1; got {self.cameras}")
        if len(set(self.cameras)) < len(self.cameras):
            raise ValueError(f"cameras: each one once, got {self.cameras}")

    @property
    def environment(self) -> str:
        """Name of the data set."""
        return self.name or "bair"

    def sources(self) -> Mapping[Held, Source]:
        """The folders ``train`` and ``test``; a file or another folder is for training."""
        splits: tuple[Held, ...] = ("train", "test")
        found: dict[Held, Source] = {
            split: BairSource(find_record_files(self.path / split), self.cameras)
            for split in splits
            if (self.path / split).is_dir()
        }
        if not found:
            folder = self.path if self.path.is_dir() else self.path.parent
            held: Held = "test" if folder.resolve().name == "test" else "train"
            found[held] = BairSource(find_record_files(self.path), self.cameras)
        return found


class BairSource(RecordSource):
    """Episodes of BAIR's files (:class:`~hvf.data.importing.importer.Source`)."""

    state_names = ("endeffector_x", "endeffector_y", "endeffector_z")

    def __init__(self, files: Sequence[Path], cameras: tuple[str, ...]) -> None:
        super().__init__(files)
        self.cameras = cameras
        for file in {record.file.path: record.file for record in self._records}.values():
            named = _NAMED.search(file.path.name)
            if named and len(file) != (count := int(named[2]) - int(named[1]) + 1):
                raise ValueError(f"{file.path}: has {len(file)} of {count} records, is truncated")
        self.lengths = [FRAMES - 1] * len(self._records)

    def read(self, number: int) -> Recording:
        """Read an episode; see :class:`~hvf.data.importing.importer.Source`."""
        views, actions, states = self._parsed(number, self._arrays)
        return checked(self.name_of(number), views, actions, states.astype(np.float64))

    def _arrays(
        self, features: Example
    ) -> tuple[dict[str, NDArray[np.uint8]], NDArray[np.float32], NDArray[np.float32]]:
        """Frames by camera, actions and states."""
        return (
            {camera: _frames(features, camera) for camera in self.cameras},
            _numbers(features, "action", _ACTIONS),
            _numbers(features, "endeffector_pos", _STATES),
        )


def _frames(features: Mapping[str, Feature], camera: str) -> NDArray[np.uint8]:
    frames = np.empty((FRAMES, *_SHAPE), np.uint8)
    for i, frame in enumerate(frames):
        name = f"{i}/image_{camera}/encoded"
        images = byte_strings(features, name)
        if len(images) != 1 or len(images[0]) != frame.size:
            raise ValueError(f"feature {name!r} is not one image of {frame.size} bytes")
        frame[...] = np.frombuffer(images[0], np.uint8).reshape(_SHAPE)
    return frames


def _numbers(features: Mapping[str, Feature], name: str, size: int) -> NDArray[np.float32]:
    rows = np.empty((FRAMES, size), np.float32)
    for i, row in enumerate(rows):
        found = floats(features, f"{i}/{name}")
        if found.shape != row.shape:
            raise ValueError(f"feature '{i}/{name}' has {len(found)} numbers, expected {size}")
        row[...] = found
    return rows
