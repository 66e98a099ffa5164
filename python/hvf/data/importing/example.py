"""``tf.train.Example`` without TensorFlow: what a record of most robot data sets is.

A message of three kinds of lists by name (``tensorflow/core/example/feature.proto``). It is read
here from its wire format, and not by the ``protobuf`` library, which would need the compiled
descriptors that come with TensorFlow and copies every image twice: a BAIR record of 120 features
takes half a millisecond, and its images stay where they are until somebody copies them.

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
_LISTS = {1: "bytes", 2: "floats", 3: "integers"}


def decode_example(record: bytes) -> dict[str, Feature]:
    """The features of an example by name.

    Raises:
        ValueError: it is no example, or damaged.
    """
    features: dict[str, Feature] = {}
    view = memoryview(record)
    for field, wire, start, end in _fields(record, 0, len(record)):
        if field != 1 or wire != _BYTES:
            continue
        for key, kind, first, last in _fields(record, start, end):
            if key == 1 and kind == _BYTES:
                name, feature = _entry(record, view, first, last)
                features[name] = feature
    return features


def floats(features: Mapping[str, Feature], name: str) -> NDArray[np.float32]:
    """A feature of finite numbers, float32 ``[N]``.

    Raises:
        ValueError: it is not there, or of another kind.
    """
    found = _feature(features, name)
    if isinstance(found, list) or found.dtype != np.float32:
        raise ValueError(f"feature {name!r} holds {_kind(found)}, expected floats")
    if not np.isfinite(found).all():
        raise ValueError(f"feature {name!r} has numbers that are not finite")
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


def _entry(data: bytes, view: memoryview, start: int, end: int) -> tuple[str, Feature]:
    """An entry of the map."""
    name, feature = "", None
    for field, wire, first, last in _fields(data, start, end):
        if wire != _BYTES:
            continue
        if field == 1:
            try:
                name = data[first:last].decode()
            except UnicodeDecodeError as error:
                raise ValueError("is no tf.train.Example (a name that is no UTF-8)") from error
        elif field == 2:
            feature = _values(data, view, first, last)
    return name, [] if feature is None else feature


def _values(data: bytes, view: memoryview, start: int, end: int) -> Feature:
    """A feature: the last list counts, as in every protocol buffer's `oneof`."""
    found: Feature = []
    for field, wire, first, last in _fields(data, start, end):
        if field not in _LISTS or wire != _BYTES:
            continue
        values = [value for value in _fields(data, first, last) if value[0] == 1]
        if field == 1:
            _check_wires(values, (_BYTES,))
            found = [view[a:b] for _, _, a, b in values]
        elif field == 2:
            _check_wires(values, (_BYTES, _FIXED32))
            packed = [view[a:b] for _, _, a, b in values]
            if any(len(part) % 4 for part in packed):
                raise ValueError("is no tf.train.Example (floats of other than 4 bytes)")
            parts = [np.frombuffer(part, "<f4") for part in packed]
            found = np.concatenate([np.empty(0, np.float32), *parts])
        else:
            _check_wires(values, (_BYTES, _VARINT))
            found = np.array(list(_integers(data, values)), np.uint64).view(np.int64)
    return found


def _check_wires(values: list[tuple[int, int, int, int]], allowed: tuple[int, ...]) -> None:
    if any(wire not in allowed for _, wire, _, _ in values):
        raise ValueError("is no tf.train.Example (a list of values of another kind)")


def _integers(data: bytes, values: list[tuple[int, int, int, int]]) -> Iterator[int]:
    for _, _, place, end in values:
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
