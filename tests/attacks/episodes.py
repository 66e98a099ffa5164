"""Episodes that lie: HDF5 files of this program's format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from hvf.data.episodes import Episodes, Metadata
from hvf.data.formats import open_episodes
from hvf.data.formats.hdf5 import write_episodes

N, T = 2, 3


def attempt(path: Path) -> object:
    """Open an attack as a user would, and read it."""
    with open_episodes(path) as file:
        return file.read(0, len(file))


def changed(path: Path, change: Callable[[Any], object]) -> None:
    """A genuine file, changed."""
    frames = np.zeros((N, T + 1, 4, 4, 3), np.uint8)
    metadata = Metadata("maze", {}, 0, T, N, {})
    write_episodes(path, metadata, Episodes(frames, np.zeros((N, T, 2), np.float32)))
    with h5py.File(path, "r+") as file:
        change(file)


def replaced(path: Path, name: str, **how: Any) -> None:
    """A genuine file with another dataset of that name."""

    def change(file: Any) -> None:
        del file[name]
        file.create_dataset(name, **how)

    changed(path, change)


def linked(path: Path, name: str, link: Any) -> None:
    """A genuine file with a link in place of a dataset."""

    def change(file: Any) -> None:
        del file[name]
        file[name] = link

    changed(path, change)


def other(path: Path) -> Path:
    """A genuine file beside this one, which the other points to."""
    beside = path.with_name(f"{path.stem}-secret.h5")
    changed(beside, lambda file: None)
    return beside


def virtual(path: Path) -> None:
    """Frames that are those of another file."""
    shape = (N, T + 1, 4, 4, 3)
    layout = h5py.VirtualLayout(shape, np.uint8)
    layout[...] = h5py.VirtualSource(str(other(path)), "frames", shape, np.uint8)

    def change(file: Any) -> None:
        del file["frames"]
        file.create_virtual_dataset("frames", layout)

    changed(path, change)


def outside(path: Path) -> None:
    """Frames whose bytes are in any other file."""
    shape = (N, T + 1, 4, 4, 3)
    secret = [(str(other(path)), 0, int(np.prod(shape)))]
    replaced(path, "frames", shape=shape, dtype=np.uint8, external=secret)


def attribute(path: Path, name: str, value: Any) -> None:
    """A genuine file with another attribute."""
    changed(path, lambda file: file.attrs.__setitem__(name, value))


def bomb(path: Path) -> None:
    """Frames of a terabyte, none of which was ever written."""
    shape = (N, T + 1, 2**18, 2**18, 3)
    replaced(path, "frames", shape=shape, dtype=np.uint8, chunks=(1, 1, 64, 64, 3))


ATTACKS: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.write_bytes(b""),
    "half a file": lambda path: (
        changed(path, lambda file: None),
        path.write_bytes(path.read_bytes()[:1500]),
    ),
    "frames of a terabyte": bomb,
    "link to another file": lambda path: linked(
        path, "frames", h5py.ExternalLink(str(other(path)), "/frames")
    ),
    "link to itself": lambda path: linked(path, "frames", h5py.SoftLink("/frames")),
    "frames that are those of another file": virtual,
    "bytes of any other file": outside,
    "group in place of a dataset": lambda path: changed(
        path, lambda file: (file.__delitem__("actions"), file.create_group("actions"))
    ),
    "actions of words": lambda path: replaced(
        path, "actions", data=np.full((N, T, 2), b"words", dtype="S5")
    ),
    "actions of objects": lambda path: replaced(
        path, "actions", shape=(N, T, 2), dtype=h5py.vlen_dtype(np.float32)
    ),
    "lengths below zero": lambda path: replaced(path, "lengths", data=np.array([-1, 3])),
    "lengths beyond the steps": lambda path: replaced(path, "lengths", data=np.array([3, 2**62])),
    "2**62 episodes": lambda path: attribute(path, "episodes", 2**62),
    "fewer than no episodes": lambda path: attribute(path, "episodes", -1),
    "episodes that are words": lambda path: attribute(path, "episodes", "many"),
    "parameters that nest 100,000 deep": lambda path: attribute(
        path, "parameters", "[" * 50_000
    ),
    "parameters that are no JSON": lambda path: attribute(path, "parameters", "import os"),
    "cameras that are a number": lambda path: attribute(path, "cameras", "3"),
    "names of cameras that are numbers": lambda path: attribute(path, "cameras", "[1, 2]"),
    "box of NaN": lambda path: attribute(path, "action_low", "[NaN, NaN]"),
    "camera that is not there": lambda path: attribute(path, "cameras", '["a", "../../b"]'),
}  # fmt: skip
