"""Data sets in RLDS, the form of Open X-Embodiment: one ``tf.train.Example`` an episode.

A feature holds a value of all steps: images as PNG or JPEG, numbers one step after another. The
action of a step leads to the next step's image, that of the last step to nothing.
"""

from __future__ import annotations

import dataclasses
import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hvf.data.importing.example import Example, Feature, byte_strings, floats
from hvf.data.importing.importer import Held, Import, Recording, Source, checked
from hvf.data.importing.records import RecordSource
from hvf.data.importing.tfrecord import find_record_files

_SPLIT = re.compile(r"-(train|val|validation|test)\.tfrecord")


@dataclasses.dataclass(frozen=True, kw_only=True)
class RldsImport(Import):
    """Import a data set in RLDS (TensorFlow Datasets, Open X-Embodiment), without TensorFlow.

    PATH is a file of records or a folder of them. Files whose names say -val, -validation or -test
    are for tests, all others for training. Example:

        hvf data import rlds bridge --image steps/observation/image_0 --action steps/action
        --out data/bridge.h5 --size 64x64

    Attributes:
        image: names of the features that hold images, a camera each; models see the first one.
        action: names of the features that hold actions, joined if there are several; none for
            video of which nobody knows what was done.
        state: names of the features that hold states, joined, for probes.
    """

    image: tuple[str, ...]
    action: tuple[str, ...] = ()
    state: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.image:
            raise ValueError("image: name at least one feature that holds images")
        cameras = [name.rpartition("/")[2] for name in self.image]
        if not all(cameras) or len(set(cameras)) < len(cameras):
            raise ValueError(f"image: must be features of different last names, got {self.image}")

    def sources(self) -> Mapping[Held, Source]:
        """Files for tests by their names, all others for training."""
        files: dict[Held, list[Path]] = {}
        for file in find_record_files(self.path):
            match = _SPLIT.search(file.name)
            held: Held = "test" if match and match[1] != "train" else "train"
            files.setdefault(held, []).append(file)
        return {
            held: RldsSource(found, self.image, self.action, self.state)
            for held, found in files.items()
        }


class RldsSource(RecordSource):
    """Episodes of RLDS files (:class:`~hvf.data.importing.importer.Source`).

    Every record is read once to know how many steps it has; images are decoded later.
    """

    def __init__(
        self,
        files: Sequence[Path],
        images: tuple[str, ...],
        actions: tuple[str, ...],
        states: tuple[str, ...],
    ) -> None:
        super().__init__(files)
        self.cameras = tuple(name.rpartition("/")[2] for name in images)
        self._images, self._actions, self._states = images, actions, states
        self.lengths = [self._steps(number) for number in range(len(self._records))]

    def read(self, number: int) -> Recording:
        """Read an episode; see :class:`~hvf.data.importing.importer.Source`."""
        views, actions, states = self._parsed(number, self._arrays)
        return checked(
            self.name_of(number), views, actions, None if states is None else states.astype(float)
        )

    def _arrays(
        self, features: Example
    ) -> tuple[dict[str, NDArray[np.uint8]], NDArray[np.float32], NDArray[np.float32] | None]:
        """Frames by camera, actions and states."""
        views = {
            camera: np.stack([decode_image(image) for image in byte_strings(features, name)])
            for camera, name in zip(self.cameras, self._images, strict=True)
        }
        count = len(next(iter(views.values())))
        actions = _joined(features, self._actions, count)
        states = _joined(features, self._states, count) if self._states else None
        return views, actions, states

    def _steps(self, number: int) -> int:
        frames = self._parsed(number, lambda features: len(byte_strings(features, self._images[0])))
        if frames < 2:
            raise ValueError(f"{self.name_of(number)}: has {frames} frames, an episode needs 2")
        return frames - 1


def decode_image(data: bytes | memoryview) -> NDArray[np.uint8]:
    """A PNG, JPEG or anything else that Pillow reads, as uint8 ``[H, W, 3]``.

    Raises:
        ValueError: it is no image, or damaged.
    """
    try:
        with Image.open(io.BytesIO(data)) as image:
            return np.array(image.convert("RGB"))
    except Exception as error:  # for damage, Pillow's readers raise whatever they come upon
        raise ValueError(f"an image of {len(data)} bytes cannot be decoded ({error})") from error


def _joined(
    features: Mapping[str, Feature], names: tuple[str, ...], count: int
) -> NDArray[np.float32]:
    """Numbers of all steps, ``[count, A]``."""
    parts = [np.empty((count, 0), np.float32)]
    for name in names:
        numbers = floats(features, name)
        if not len(numbers) or len(numbers) % count:
            raise ValueError(f"feature {name!r} has {len(numbers)} numbers for {count} steps")
        parts.append(numbers.reshape(count, -1))
    return np.concatenate(parts, axis=1)
