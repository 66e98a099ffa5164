"""Importing: from the recordings of a source to the project's own file of episodes.

A source says which recordings there are, and reads one of them. Everything else is the same for
all: frames are made smaller, what is for tests goes to a file of its own, and files are written in
parts (:mod:`hvf.data.parts`), so that a stopped import goes on. A recording that cannot be read
ends the import with its name, and nothing of that file stays.
"""

from __future__ import annotations

import dataclasses
import hashlib
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console

from hvf.action_box import box_around, extremes
from hvf.data.episodes import Episodes, Metadata
from hvf.data.formats.hdf5 import EpisodeFile
from hvf.data.importing.resize import area_resized, size_of
from hvf.data.parts import Made, parts_folder, program_versions, write_in_parts

Held: TypeAlias = Literal["train", "test"]
"""What a file is for; validation episodes are the last of those for training."""


@dataclasses.dataclass(frozen=True)
class Recording:
    """One recorded episode.

    Attributes:
        views: frames by camera, uint8 ``[T+1, H, W, 3]`` each.
        actions: float32 ``[T, A]``; ``A`` is 0 where nobody knows what was done.
        states: float64 ``[T+1, S]``, or None.
    """

    views: Mapping[str, NDArray[np.uint8]]
    actions: NDArray[np.float32]
    states: NDArray[np.float64] | None = None


class Source:
    """Recordings of one split of a data set, by their numbers.

    Attributes:
        cameras: their names; frames of the first one are read unless another is asked for.
        lengths: steps of each recording, ``[N]``.
        action_names: what each dimension of an action is, or nothing.
        state_names: what each dimension of a state is, or nothing.
        files: what the recordings are read from, for the import to know them again.
    """

    cameras: tuple[str, ...] = ("main",)
    lengths: Sequence[int]
    action_names: tuple[str, ...] = ()
    state_names: tuple[str, ...] = ()
    files: Sequence[Path]

    def name_of(self, number: int) -> str:
        """What a recording is called in errors: its file, and where in it."""
        raise NotImplementedError

    def read(self, number: int) -> Recording:
        """Read a recording.

        Raises:
            ValueError: it is damaged, or not what it should be; names it.
        """
        raise NotImplementedError


@dataclasses.dataclass(frozen=True, kw_only=True)
class Import:
    """What all imports have to know.

    Attributes:
        path: the data set.
        out: HDF5 file to write; episodes for tests go beside it, to NAME-test.h5.
        name: of the data set, which models trained on it will remember; by default that of the
            source, or of the path.
        split: write the episodes for training, for tests, or both.
        hold_out: the last episodes, so many, are for tests; of data sets without a split of their
            own.
        size: height x width of the frames that are written, by the area filter; as they are if not
            said.
        compress: compress frames; those of real cameras hardly shrink, and are then slow to read.
        part: episodes written at a time; a stop loses no more than these.
        overwrite: replace other files that are already there.
    """

    path: Annotated[Path, tyro.conf.Positional]
    out: Path
    name: str = ""
    split: Literal["all", "train", "test"] = "all"
    hold_out: int = 0
    size: str | None = None
    compress: bool = False
    part: int = 64
    overwrite: bool = False

    def __post_init__(self) -> None:
        if self.hold_out < 0:
            raise ValueError(f"hold_out: must not be negative, got {self.hold_out}")
        if self.part < 1:
            raise ValueError(f"part: must be at least 1, got {self.part}")
        if self.size is not None:
            size_of(self.size)

    def sources(self) -> Mapping[Held, Source]:
        """What there is, by split; called once.

        Raises:
            FileNotFoundError: nothing at the path.
            ValueError: another kind of data, or damaged; names the file and what is in it.
        """
        raise NotImplementedError(f"{type(self).__name__} does not say what is imported")

    @property
    def environment(self) -> str:
        """Name of the data set."""
        return self.name or self.path.resolve().name.split(".")[0] or "video"

    def run(self, console: Console | None = None) -> list[Path]:
        """Import.

        Returns:
            The files written.

        Raises:
            FileNotFoundError: nothing at the path.
            FileExistsError: something else is where a file should go.
            ValueError: data that is damaged or of another kind; names file and record. Nothing of
                the file that was being written stays.
            OSError: a full disk; what was written so far is used again.
            KeyboardInterrupt: stopped; the same call goes on from there.
        """
        console = console or Console()
        written = []
        for split, source in self._split().items():
            out = self.out if split == "train" else file_for_tests(self.out)
            written.append(self._write(source, split, out, console))
        return written

    def _split(self) -> dict[Held, Source]:
        """The sources to write."""
        found = dict(self.sources())
        if self.hold_out:
            if "test" in found:
                raise ValueError("hold_out: this data set has episodes for tests of its own")
            source = found["train"]
            train = len(source.lengths) - self.hold_out
            if train < 1:
                raise ValueError(f"hold_out: there are {len(source.lengths)} episodes in all")
            found["train"] = _Some(source, range(train))
            found["test"] = _Some(source, range(train, len(source.lengths)))
        chosen = {name: part for name, part in found.items() if self.split in ("all", name)}
        if not chosen:
            raise ValueError(f"split: {self.path} has no episodes for {self.split}")
        return chosen

    def _write(self, source: Source, split: Held, out: Path, console: Console) -> Path:
        parameters: dict[str, Any] = {
            "split": split,
            "source": _fingerprint(source.files),
            "cameras": list(source.cameras),
        }
        if self.size is not None:
            parameters |= {"size": list(size_of(self.size)), "filter": "area"}
        if source.state_names:
            parameters["states"] = list(source.state_names)
        steps, count = max(source.lengths), len(source.lengths)
        wanted = Metadata(
            self.environment, parameters, None, steps, count, program_versions(),
            cameras=source.cameras, action_names=source.action_names,
        )  # fmt: skip

        def make(first: int, count: int) -> Made:
            try:
                return self._read(source, range(first, first + count), steps)
            except ValueError:
                shutil.rmtree(parts_folder(out))
                raise

        return write_in_parts(
            out,
            wanted,
            make,
            part=self.part,
            overwrite=self.overwrite,
            compress=self.compress,
            about=f"importing {self.environment} for {split}",
            finish=_with_action_box,
            console=console,
        )

    def _read(self, source: Source, numbers: range, steps: int) -> Made:
        """Some recordings, padded to ``steps``."""
        made: dict[str, NDArray[Any]] = {}
        for place, number in enumerate(numbers):
            recording = source.read(number)
            arrays: dict[str, NDArray[Any]] = {"actions": recording.actions}
            if recording.states is not None:
                arrays["states"] = recording.states
            for camera in source.cameras:
                frames = recording.views[camera]
                if self.size is not None:
                    frames = area_resized(frames, size_of(self.size))
                arrays[f"frames of {camera}"] = frames
            for name, array in arrays.items():
                if name not in made:
                    long = steps if name == "actions" else steps + 1
                    made[name] = np.zeros((len(numbers), long, *array.shape[1:]), array.dtype)
                if array.shape[1:] != made[name].shape[2:]:
                    raise ValueError(
                        f"{source.name_of(number)}: {name} are {list(array.shape[1:])}, those "
                        f"before are {list(made[name].shape[2:])}"
                        + (" (use --size)" if name.startswith("frames") else "")
                    )
                made[name][place, : len(array)] = array
        lengths = np.array([source.lengths[number] for number in numbers], np.int64)
        first, *others = source.cameras
        frames = made[f"frames of {first}"]
        episodes = Episodes(frames, made["actions"], made.get("states"), 0, lengths)
        return episodes, {camera: made[f"frames of {camera}"] for camera in others}


def file_for_tests(out: Path) -> Path:
    """Where the episodes for tests go."""
    return out.with_name(f"{out.stem}-test{out.suffix}")


def checked(
    what: object,
    views: Mapping[str, NDArray[np.uint8]],
    actions: NDArray[np.float32],
    states: NDArray[np.float64] | None = None,
) -> Recording:
    """A recording whose last action is taken off if it leads to no frame.

    Args:
        what: its name, for errors.
        views: as in :class:`Recording`.
        actions: one for each frame but the last, or for that too.
        states: one for each frame.

    Raises:
        ValueError: numbers that do not fit, are not finite, or an episode of fewer than two frames.
    """
    counts = {len(frames) for frames in views.values()}
    frames = counts.pop()
    if counts:
        raise ValueError(f"{what}: cameras have {frames} and {counts.pop()} frames")
    if frames < 2:
        raise ValueError(f"{what}: has {frames} frames, an episode needs 2")
    if len(actions) not in (frames - 1, frames):
        raise ValueError(f"{what}: has {frames} frames and {len(actions)} actions")
    if states is not None and len(states) != frames:
        raise ValueError(f"{what}: has {frames} frames and {len(states)} states")
    for name, numbers in (("actions", actions), ("states", states)):
        if numbers is not None and not np.isfinite(numbers).all():
            raise ValueError(f"{what}: {name} are not finite")
    return Recording(views, actions[: frames - 1], states)


class _Some(Source):
    """Some recordings of a source."""

    def __init__(self, inner: Source, which: range) -> None:
        self.cameras, self.files = inner.cameras, inner.files
        self.action_names, self.state_names = inner.action_names, inner.state_names
        self.lengths = [inner.lengths[number] for number in which]
        self._inner, self._which = inner, which

    def name_of(self, number: int) -> str:
        return self._inner.name_of(self._which[number])

    def read(self, number: int) -> Recording:
        return self._inner.read(self._which[number])


def _fingerprint(files: Iterable[Path]) -> str:
    """What tells these files from others: their names and sizes."""
    listed = "\n".join(f"{file.name} {file.stat().st_size}" for file in files)
    return hashlib.sha256(listed.encode()).hexdigest()[:16]


def _with_action_box(metadata: Metadata, parts: Sequence[Path]) -> Metadata:
    """With the smallest box that all actions are in, a little wider where one never changes."""
    lows, highs = [], []
    for path in parts:
        with EpisodeFile(path) as file:
            if not file.action_dim:
                return metadata
            least, most = extremes(file.dataset("actions")[...], file.lengths)
            lows.append(least)
            highs.append(most)
    low, high = box_around(np.min(lows, axis=0), np.max(highs, axis=0))
    return dataclasses.replace(metadata, action_low=low, action_high=high)
