"""A file appears whole, or not at all: written beside its place, then renamed over it."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Give a temporary path beside ``path`` to write to, and rename it to ``path`` at the end.

    When the block fails, the temporary file is removed and whatever was at ``path`` is untouched.
    A process that is killed leaves at most ``.<name>.tmp``, which the next write replaces.

    Raises:
        OSError: the file cannot be written (full disk, no permission); names ``path``.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        with temporary.open("rb+") as written:
            os.fsync(written.fileno())
        temporary.replace(path)
    except OSError as error:
        _remove(temporary)
        reason = error.strerror or str(error)
        raise OSError(
            error.errno, f"cannot write ({reason}); nothing at this path was changed", str(path)
        ) from error
    except BaseException:
        _remove(temporary)
        raise


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write ``content`` to ``path``, whole or not at all.

    Raises:
        OSError: the file cannot be written; names ``path``.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)
