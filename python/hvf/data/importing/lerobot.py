"""LeRobot's data sets (Hugging Face), versions 2.0, 2.1 and 3.0: tables in Parquet, videos in MP4.

The ``lerobot`` package holds torch and NumPy back at older versions than this program runs with, so
its files are read directly: ``meta/info.json`` says where everything is. Version 2 has a table and
a video for each episode, version 3 has many episodes in one, and a table of where each begins.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hvf.data.importing.importer import Held, Import, Recording, Source, checked
from hvf.data.importing.rlds import decode_image

_NEEDED = "LeRobot's data sets are read with pyarrow and av: pip install 'hvf[lerobot]'"


@dataclasses.dataclass(frozen=True, kw_only=True)
class LeRobotImport(Import):
    """Import a data set of LeRobot (versions 2.0, 2.1 and 3.0), with pip install 'hvf[lerobot]'.

    PATH is the folder that holds meta, data and videos. Its splits are kept: train is for training,
    all others are for tests. For example:

        hvf data import lerobot pusht --out data/pusht.h5 --size 64x64

    Attributes:
        image: names of the features that hold images or videos, a camera each; all that there are
            if none is named.
        action: name of the feature that holds actions.
        state: name of the feature that holds states, for probes; left out if there is none.
    """

    image: tuple[str, ...] = ()
    action: str = "action"
    state: str = "observation.state"

    def sources(self) -> Mapping[Held, Source]:
        """The splits, as ``meta/info.json`` has them."""
        try:
            import av  # noqa: F401
            import pyarrow  # noqa: F401
        except ImportError as error:
            raise ImportError(_NEEDED) from error
        whole = LeRobotSource(self.path, self.image, self.action, self.state)
        found: dict[Held, list[int]] = {}
        for number in range(len(whole.episodes)):
            found.setdefault(whole.held(number), []).append(number)
        return {held: whole.only(numbers) for held, numbers in found.items()}


class LeRobotSource(Source):
    """Episodes of a LeRobot data set (:class:`~hvf.data.importing.importer.Source`).

    Attributes:
        episodes: what the data set says of each: its number, length, and where it is.
    """

    def __init__(self, path: Path, images: tuple[str, ...], action: str, state: str) -> None:
        info = path / "meta" / "info.json"
        if not info.is_file():
            raise FileNotFoundError(f"path: there is no data set of LeRobot at {path} (no {info})")
        self._path, self._action = path, action
        try:
            self._info: dict[str, Any] = json.loads(info.read_text())
            self._features: dict[str, Any] = dict(self._info["features"])
            self._version = str(self._info["codebase_version"])
            self._fps = float(self._info["fps"])
            self._splits = dict(self._info.get("splits") or {})
            drawn = tuple(n for n, f in self._features.items() if f["dtype"] in ("image", "video"))
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{info}: is not what LeRobot writes ({error!r})") from error
        if not self._version.startswith(("v2.", "v3.")):
            raise ValueError(f"{info}: is of version {self._version}, known are v2.0 to v3.0")
        self._images = images or drawn
        for name in (*self._images, action):
            if name not in self._features or (name != action and name not in drawn):
                raise ValueError(f"{info}: has no {name!r} of the kind wanted, only {drawn}")
        self._state = state if state in self._features else None
        self.cameras = tuple(name.rpartition(".")[2].replace("/", "-") for name in self._images)
        self.action_names = _names(self._features[action])
        self.state_names = _names(self._features[self._state]) if self._state else ()
        self.episodes = self._read_episodes()
        self.files = [info]
        self.lengths = self._all_lengths()

    def only(self, numbers: list[int]) -> LeRobotSource:
        """Some of the episodes."""
        some = object.__new__(LeRobotSource)
        some.__dict__ |= self.__dict__
        some.episodes = [self.episodes[number] for number in numbers]
        some.lengths = [self.lengths[number] for number in numbers]
        return some

    def held(self, number: int) -> Held:
        """What the data set has an episode for."""
        index = int(self.episodes[number]["episode_index"])
        for name, which in self._splits.items():
            first, _, end = str(which).partition(":")
            if first.isdigit() and end.isdigit() and int(first) <= index < int(end):
                return "train" if name == "train" else "test"
        return "train"

    def name_of(self, number: int) -> str:
        """A recording, for errors."""
        return f"{self._path}: episode {self.episodes[number].get('episode_index', number)}"

    def read(self, number: int) -> Recording:
        """Read an episode; see :class:`~hvf.data.importing.importer.Source`."""
        episode, what = self.episodes[number], self.name_of(number)
        try:
            table = self._table(episode)
            actions = _rows(table[self._action])
            states = _rows(table[self._state]).astype(np.float64) if self._state else None
            views = {
                camera: self._frames(episode, name, table)
                for camera, name in zip(self.cameras, self._images, strict=True)
            }
        except FileNotFoundError as error:
            raise ValueError(f"{what}: {error}") from error
        except Exception as error:  # for damage, readers raise whatever they come upon
            raise ValueError(f"{what}: is damaged ({error})") from error
        if len(actions) != self.lengths[number] + 1:
            raise ValueError(f"{what}: has {len(actions)} steps, not {self.lengths[number] + 1}")
        return checked(what, views, actions, states)

    def _read_episodes(self) -> list[dict[str, Any]]:
        """What the data set says of its episodes."""
        meta = self._path / "meta"
        try:
            if self._version.startswith("v2."):
                listed = (meta / "episodes.jsonl").read_text().splitlines()
                return [dict(json.loads(line)) for line in listed if line.strip()]
            import pyarrow.parquet as pq

            found: list[dict[str, Any]] = []
            for file in sorted((meta / "episodes").rglob("*.parquet")):
                names = [n for n in pq.read_schema(file).names if not n.startswith("stats/")]
                found += pq.read_table(file, columns=names).to_pylist()
            return found
        except FileNotFoundError as error:
            raise ValueError(f"{meta}: has no list of episodes ({error})") from error
        except Exception as error:  # as above
            raise ValueError(f"{meta}: its list of episodes is damaged ({error})") from error

    def _all_lengths(self) -> list[int]:
        if not self.episodes:
            raise ValueError(f"{self._path}: has no episodes")
        lengths = []
        for number, episode in enumerate(self.episodes):
            steps = episode.get("length")
            if not isinstance(steps, int) or steps < 2:
                what = self.name_of(number)
                raise ValueError(f"{what}: has {steps} frames, an episode needs 2")
            lengths.append(steps - 1)
        return lengths

    def _table(self, episode: Mapping[str, Any]) -> dict[str, list[Any]]:
        """The rows of an episode, by column."""
        import pyarrow.parquet as pq

        path = _there(self._path / self._info["data_path"].format(**self._place(episode, "data")))
        schema = pq.read_schema(path).names
        wanted = [n for n in (self._action, self._state, *self._images) if n in schema]
        index = int(episode["episode_index"])
        filters = [("episode_index", "==", index)]
        rows: dict[str, list[Any]] = pq.read_table(
            path, columns=wanted, filters=filters
        ).to_pydict()
        return rows

    def _frames(
        self, episode: Mapping[str, Any], name: str, table: Mapping[str, list[Any]]
    ) -> NDArray[np.uint8]:
        """What a camera saw in an episode."""
        count = int(episode["length"])
        if name in table:
            return np.stack([decode_image(_encoded(self._path, cell)) for cell in table[name]])
        place = self._place(episode, f"videos/{name}")
        path = _there(self._path / self._info["video_path"].format(video_key=name, **place))
        begin = float(episode.get(f"videos/{name}/from_timestamp", 0.0))
        return _video_part(path, begin, count, self._fps)

    def _place(self, episode: Mapping[str, Any], what: str) -> dict[str, int]:
        """Numbers of the file of an episode, by the names that paths have for them."""
        index = int(episode["episode_index"])
        if self._version.startswith("v2."):
            chunk = index // int(self._info.get("chunks_size", 1000))
            return {"episode_chunk": chunk, "episode_index": index}
        names = ("chunk_index", "file_index")
        return {name: int(episode[f"{what}/{name}"]) for name in names}


def _there(path: Path) -> Path:
    if not path.is_file():
        raise FileNotFoundError(f"{path} is not there")
    return path


def _names(feature: Mapping[str, Any]) -> tuple[str, ...]:
    """Names of the dimensions of a feature, if it has any that can be told apart."""
    names = feature.get("names")
    while isinstance(names, dict):
        names = next(iter(names.values()), None)
    size = (feature.get("shape") or [0])[0]
    words = tuple(str(name).replace("/", "-") for name in names or ())
    return words if len(words) == size == len(set(words)) and all(words) else ()


def _rows(column: list[Any]) -> NDArray[np.float32]:
    """Numbers of all steps, ``[T, A]``."""
    array = np.array(column, np.float32)
    return array.reshape(len(array), -1)


def _encoded(path: Path, cell: Mapping[str, Any]) -> bytes:
    """An image of a table: in it, or in a file that it names."""
    inside = cell.get("bytes")
    return bytes(inside) if inside else (path / str(cell["path"])).read_bytes()


def _video_part(path: Path, begin: float, count: int, fps: float) -> NDArray[np.uint8]:
    """``count`` frames of a video from ``begin`` seconds on, uint8 ``[count, H, W, 3]``."""
    import av

    found: list[NDArray[np.uint8]] = []
    early = begin - 0.5 / fps
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        if begin and stream.time_base:
            # To the key frame before.
            container.seek(int(begin / stream.time_base), stream=stream)
        for frame in container.decode(stream):
            if frame.time is None or frame.time < early:
                continue
            found.append(frame.to_ndarray(format="rgb24"))
            if len(found) == count:
                return np.stack(found)
    raise ValueError(f"{path} ends after {len(found)} of {count} frames")
