"""Images that lie: start and goal of a user's own."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

from hvf.images import read_image


def attempt(path: Path) -> object:
    """Open an attack as a user would."""
    return read_image("start", path)


def png(path: Path, width: int, height: int, data: bytes = b"", *, right: bool = True) -> None:
    """A PNG file that says how large it is, true or not."""

    def chunk(name: bytes, content: bytes) -> bytes:
        check = zlib.crc32(name + content) if right else 7
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", check)

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + body)


ATTACKS: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.write_bytes(b""),
    "no image": lambda path: path.write_text("GIF, or so it says"),
    "of 2**31 pixels a side": lambda path: png(path, 2**31 - 1, 2**31 - 1),
    "of 100,000 pixels a side": lambda path: png(path, 100_000, 100_000),
    "of 10,000 pixels a side, nearly all missing": lambda path: png(path, 10_000, 10_000, b"\0"),
    "of no pixels": lambda path: png(path, 0, 0),
    "with wrong checksums": lambda path: png(path, 2, 2, b"\0" * 14, right=False),
    "cut short": lambda path: png(path, 64, 64, b"\0" * 100),
    "script": lambda path: path.write_text("%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n"),
}
