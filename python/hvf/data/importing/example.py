"""``tf.train.Example`` without TensorFlow: what a record of most robot data sets is.

A message of three kinds of lists by name (``tensorflow/core/example/feature.proto``). It is read
here from its wire format, and not by the ``protobuf`` library, which would need the compiled
descriptors that come with TensorFlow, copies every image twice, and is slower on BAIR's records of
120 features.

    Example   1: Features                 message
    Features  1: map of Feature by name   entries of 1: name, 2: Feature
    Feature   1: BytesList, 2: FloatList, 3: Int64List, each with its values in field 1
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Feature: TypeAlias = "list[memoryview] | NDArray[np.float32] | NDArray[np.int64]"
"""Byte strings (which look into the record), or numbers."""

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
# Which lists there are, by their fields, and how their values may be written.
_LISTS = {1: (_BYTES,), 2: (_BYTES, _FIXED32), 3: (_BYTES, _VARINT)}
_NO_FLOATS = np.empty(0, np.float32)


class Example(Mapping[str, Feature]):
    """The features of an example by name; each is decoded when it is asked for.

    Args:
        record: as it was written.

    Raises:
        ValueError: it is no example, or damaged; also when a feature is asked for.
    """

    def __init__(self, record: bytes) -> None:
        self._data, self._view = record, memoryview(record)
        self._places: dict[str, tuple[int, int]] = {}
        for field, wire, start, end in _fields(record, 0, len(record)):
            if field != 1 or wire != _BYTES:
                continue
            for key, kind, first, last in _fields(record, start, end):
                if key == 1 and kind == _BYTES:
                    name, place = _entry(record, first, last)
                    self._places[name] = place

    def __getitem__(self, name: str) -> Feature:
        return _values(self._data, self._view, *self._places[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)

    def __contains__(self, name: object) -> bool:
        return name in self._places


def floats(features: Mapping[str, Feature], name: str) -> NDArray[np.float32]:
    """A feature of numbers, float32 ``[N]``.

    Raises:
        ValueError: it is not there, or of another kind.
    """
    found = _feature(features, name)
    if isinstance(found, list) or found.dtype != np.float32:
        raise ValueError(f"feature {name!r} holds {_kind(found)}, expected floats")
    return found  # type: ignore[return-value]


def byte_strings(features: Mapping[str, Feature], name: str) -> list[memoryview]:
    """A feature of byte strings.

    Raises:
        ValueError: it is not there, or of another kind.
    """
    found = _feature(features, name)
    if not isinstance(found, list):
        raise ValueError(f"feature {name!r} holds {_kind(found)}, expected bytes")
    return found


def _feature(features: Mapping[str, Feature], name: str) -> Feature:
    if name in features:
        return features[name]
    names = sorted(features)
    shown = ", ".join(names[:20]) + (", ..." if len(names) > 20 else "")
    raise ValueError(f"has no feature {name!r}, only {shown or 'none'}")


def _kind(feature: Feature) -> str:
    if isinstance(feature, list):
        return "bytes"
    return "floats" if feature.dtype == np.float32 else "integers"


def _entry(data: bytes, start: int, end: int) -> tuple[str, tuple[int, int]]:
    """Name of an entry of the map, and where its feature is."""
    name, place = b"", (0, 0)
    # Nearly all are a short name and a feature: a shortcut of twice the speed.
    middle = start + 2 + data[start + 1] if end - start > 1 else end
    if middle < end and data[start] == 10 and data[start + 1] < 0x80:
        inside = _only(data, middle, end, 2)
        if inside is not None:
            name, place, start = data[start + 2 : middle], (inside, end), end
    for field, wire, first, last in _fields(data, start, end):
        if field == 1 and wire == _BYTES:
            name = data[first:last]
        elif field == 2 and wire == _BYTES:
            place = first, last
    try:
        return name.decode(), place
    except UnicodeDecodeError as error:
        raise ValueError("is no tf.train.Example (a name that is no UTF-8)") from error


def _values(data: bytes, view: memoryview, start: int, end: int) -> Feature:
    """A feature: the last list counts, as in every protocol buffer's `oneof`."""
    found: Feature = []
    for field in (1, 2):  # the same for a list of one image, or of packed floats
        inside = _only(data, start, end, field)
        value = None if inside is None else _only(data, inside, end, 1)
        if value is not None and field == 1:
            return [view[value:end]]
        if value is not None and not (end - value) % 4:
            return np.frombuffer(view[value:end], "<f4")
    for field, wire, first, last in _fields(data, start, end):
        if field not in _LISTS or wire != _BYTES:
            continue
        places = []
        for key, kind, a, b in _fields(data, first, last):
            if key != 1:
                continue
            if kind not in _LISTS[field]:
                raise ValueError("is no tf.train.Example (a list of values of another kind)")
            places.append((a, b))
        if field == 1:
            found = [view[a:b] for a, b in places]
        elif field == 2:
            if any((b - a) % 4 for a, b in places):
                raise ValueError("is no tf.train.Example (floats of other than 4 bytes)")
            parts = [np.frombuffer(view[a:b], "<f4") for a, b in places]
            found = parts[0] if len(parts) == 1 else np.concatenate([_NO_FLOATS, *parts])
        else:
            found = np.array(list(_integers(data, places)), np.uint64).view(np.int64)
    return found


def _integers(data: bytes, places: list[tuple[int, int]]) -> Iterator[int]:
    for place, end in places:
        while place < end:
            value, place = _varint(data, place, end)
            yield value


def _fields(data: bytes, place: int, end: int) -> Iterator[tuple[int, int, int, int]]:
    """Fields of a message in `data[place:end]`: number, wire type, and where the value is."""
    while place < end:
        key = data[place]
        place += 1
        if key >= 0x80:
            key, place = _varint(data, place - 1, end)
        field, wire = key >> 3, key & 7
        if wire == _BYTES:
            size, place = _varint(data, place, end)
        elif wire == _VARINT:
            size = _varint(data, place, end)[1] - place
        elif wire == _FIXED32:
            size = 4
        elif wire == _FIXED64:
            size = 8
        else:
            raise ValueError(f"is no tf.train.Example (a field of wire type {wire})")
        if not field or size > end - place:
            raise ValueError("is no tf.train.Example (a field that is longer than its message)")
        yield field, wire, place, place + size
        place += size


def _only(data: bytes, start: int, end: int, field: int) -> int | None:
    """Where the value begins, if `data[start:end]` is this one field of bytes to its end."""
    if start >= end or data[start] != field << 3 | _BYTES:
        return None
    size, place = _varint(data, start + 1, end)
    return place if place + size == end else None


def _varint(data: bytes, place: int, end: int) -> tuple[int, int]:
    """A number of 7 bits a byte, lowest first, and where the next field begins."""
    value = shift = 0
    while place < end and shift < 70:
        byte = data[place]
        place += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            if value >= 1 << 64:
                break
            return value, place
        shift += 7
    raise ValueError("is no tf.train.Example (a number that does not end)")
