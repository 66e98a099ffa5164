"""Recordings as other programs write them, for tests of importing: nothing here is the importer's.

Records and checksums are written byte by byte after their descriptions; examples by the library of
protocol buffers, from the messages' published definition.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from numpy.typing import NDArray


def _example_class() -> Any:
    """The class of ``tensorflow.Example``: core/example/example.proto and feature.proto."""
    file = descriptor_pb2.FileDescriptorProto(name="example.proto", package="t", syntax="proto3")
    field = descriptor_pb2.FieldDescriptorProto
    for name, kind in (
        ("BytesList", field.TYPE_BYTES),
        ("FloatList", field.TYPE_FLOAT),
        ("Int64List", field.TYPE_INT64),
    ):
        message = file.message_type.add(name=name)
        message.field.add(name="value", number=1, type=kind, label=field.LABEL_REPEATED)
    feature = file.message_type.add(name="Feature")
    feature.oneof_decl.add(name="kind")
    for number, (name, kind) in enumerate(
        (("bytes_list", "BytesList"), ("float_list", "FloatList"), ("int64_list", "Int64List")), 1
    ):
        feature.field.add(
            name=name,
            number=number,
            type=field.TYPE_MESSAGE,
            type_name=f".t.{kind}",
            label=field.LABEL_OPTIONAL,
            oneof_index=0,
        )
    features = file.message_type.add(name="Features")
    entry = features.nested_type.add(name="FeatureEntry")
    entry.options.map_entry = True
    entry.field.add(name="key", number=1, type=field.TYPE_STRING, label=field.LABEL_OPTIONAL)
    entry.field.add(
        name="value",
        number=2,
        type=field.TYPE_MESSAGE,
        type_name=".t.Feature",
        label=field.LABEL_OPTIONAL,
    )
    features.field.add(
        name="feature",
        number=1,
        type=field.TYPE_MESSAGE,
        type_name=".t.Features.FeatureEntry",
        label=field.LABEL_REPEATED,
    )
    example = file.message_type.add(name="Example")
    example.field.add(
        name="features",
        number=1,
        type=field.TYPE_MESSAGE,
        type_name=".t.Features",
        label=field.LABEL_OPTIONAL,
    )
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("t.Example"))


EXAMPLE = _example_class()


def example(features: Mapping[str, Sequence[bytes] | Sequence[float] | Sequence[int]]) -> bytes:
    """An example: lists of bytes, floats or integers by name."""
    made = EXAMPLE()
    for name, values in features.items():
        feature = made.features.feature[name]
        first = values[0] if len(values) else b""
        kind = {bytes: "bytes_list", float: "float_list", int: "int64_list"}[type(first)]
        getattr(feature, kind).value.extend(values)
    return bytes(made.SerializeToString(deterministic=True))


def crc32c(data: bytes) -> int:
    """CRC-32C (Castagnoli) a bit at a time, by a table of bytes."""
    value = 0xFFFFFFFF
    for byte in data:
        value = _TABLE[(value ^ byte) & 0xFF] ^ (value >> 8)
    return value ^ 0xFFFFFFFF


def _table() -> list[int]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = (value >> 1) ^ (0x82F63B78 if value & 1 else 0)
        table.append(value)
    return table


_TABLE = _table()


def masked(data: bytes) -> bytes:
    """A checksum as it stands in files."""
    value = crc32c(data)
    rotated = ((value >> 15) | (value << 17)) & 0xFFFFFFFF
    return struct.pack("<I", (rotated + 0xA282EAD8) & 0xFFFFFFFF)


def tfrecords(records: Iterable[bytes]) -> bytes:
    """A file of records."""
    out = b""
    for record in records:
        length = struct.pack("<Q", len(record))
        out += length + masked(length) + record + masked(record)
    return out


def bair_episode(seed: int) -> dict[str, NDArray[Any]]:
    """Frames of two cameras, actions and places of a gripper, of the size of BAIR's."""
    rng = np.random.default_rng(seed)
    return {
        "main": rng.integers(0, 256, (30, 64, 64, 3)).astype(np.uint8),
        "aux1": rng.integers(0, 256, (30, 64, 64, 3)).astype(np.uint8),
        "action": rng.normal(size=(30, 4)).astype(np.float32),
        "endeffector_pos": rng.normal(size=(30, 3)).astype(np.float32),
    }


def bair_record(episode: Mapping[str, NDArray[Any]]) -> bytes:
    """An episode as the BAIR data set has it."""
    features: dict[str, Any] = {}
    for i in range(30):
        for camera in ("main", "aux1"):
            features[f"{i}/image_{camera}/encoded"] = [episode[camera][i].tobytes()]
        for name in ("action", "endeffector_pos"):
            features[f"{i}/{name}"] = list(map(float, episode[name][i]))
    return example(features)


def write(path: Path, content: bytes) -> Path:
    """A file in a folder that is made for it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path
