"""Files of TFRecords: byte strings one after another, each with two checksums.

A record is its length (8 bytes, little-endian), a checksum of these, its bytes, and a checksum of
those (TensorFlow, ``tensorflow/core/lib/io/record_writer.h``). Checksums are masked CRC-32C, which
``google-crc32c`` computes at 6 GB/s here: in NumPy it would take most of the time of an import.
"""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Iterable
from pathlib import Path

import google_crc32c

_HEADER = struct.Struct("<QI")
_FOOTER = struct.Struct("<I")
_GZIP = b"\x1f\x8b"


@dataclasses.dataclass(frozen=True)
class RecordFile:
    """A file of records whose lengths are known.

    Attributes:
        path: the file.
        starts: where the bytes of each record begin in it.
        sizes: how many bytes each record has.
    """

    path: Path
    starts: tuple[int, ...]
    sizes: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.starts)

    def read(self, number: int) -> bytes:
        """The bytes of a record, which are as they were written.

        Raises:
            ValueError: they are not; names file and record.
            FileNotFoundError: somebody took the file away.
        """
        size = self.sizes[number]
        with self.path.open("rb", buffering=0) as file:
            file.seek(self.starts[number])
            data = file.read(size)
            footer = file.read(_FOOTER.size)
        if len(data) < size or len(footer) < _FOOTER.size:
            raise ValueError(f"{self.path}: record {number} is truncated")
        if _FOOTER.unpack(footer)[0] != masked_crc32c(data):
            raise ValueError(f"{self.path}: record {number} is damaged (its checksum is another)")
        return data


def open_records(path: Path) -> RecordFile:
    """Find the records of a file; their lengths are checked, their bytes when they are read.

    Raises:
        FileNotFoundError: no such file.
        ValueError: it is no file of records, damaged, truncated or empty; names file and record.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file of records")
    total = path.stat().st_size
    starts: list[int] = []
    sizes: list[int] = []
    place = 0
    with path.open("rb", buffering=0) as file:
        while place < total:
            file.seek(place)
            header = file.read(_HEADER.size)
            number = len(starts)
            if not number and header.startswith(_GZIP):
                raise ValueError(f"{path}: is compressed; unpack it with gunzip first")
            if len(header) < _HEADER.size:
                raise ValueError(f"{path}: record {number} is truncated")
            size, checksum = _HEADER.unpack(header)
            if checksum != masked_crc32c(header[:8]):
                what = "is damaged (its length is another)" if number else "is no TFRecord"
                raise ValueError(f"{path}: record {number} {what}")
            start = place + _HEADER.size
            place = start + size + _FOOTER.size
            if place > total:
                raise ValueError(f"{path}: record {number} is truncated")
            starts.append(start)
            sizes.append(size)
    if not starts:
        raise ValueError(f"{path}: is empty")
    return RecordFile(path, tuple(starts), tuple(sizes))


def find_record_files(path: Path) -> list[Path]:
    """A file itself, or all files of records below a folder (``*.tfrecord*``), by name.

    Raises:
        FileNotFoundError: nothing at ``path``, or no such file below it.
    """
    if path.is_file():
        return [path]
    if not path.exists():
        raise FileNotFoundError(f"path: there is nothing at {path}")
    found = sorted(file for file in path.rglob("*.tfrecord*") if file.is_file())
    if not found:
        raise FileNotFoundError(f"path: no file *.tfrecord* in {path}")
    return found


def masked_crc32c(data: bytes) -> int:
    """CRC-32C of ``data``, rotated by 15 bits and moved, as TFRecords have it."""
    value = int(google_crc32c.value(data))
    return ((value >> 15 | value << 17) + 0xA282EAD8) & 0xFFFFFFFF


@dataclasses.dataclass(frozen=True)
class Record:
    """A record of a file, by its number.

    Attributes:
        file: where it is.
        number: from 0.
    """

    file: RecordFile
    number: int

    def __str__(self) -> str:
        return f"{self.file.path}: record {self.number}"

    def read(self) -> bytes:
        """Its bytes; see :meth:`RecordFile.read`."""
        return self.file.read(self.number)


def records_of(paths: Iterable[Path]) -> list[Record]:
    """All records of some files, in order.

    Raises:
        FileNotFoundError, ValueError: as :func:`open_records`.
    """
    files = [open_records(path) for path in paths]
    return [Record(file, number) for file in files for number in range(len(file))]
