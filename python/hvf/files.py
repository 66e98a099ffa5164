"""A file appears whole, or not at all: written beside its place, then renamed over it."""

from __future__ import annotations

import contextlib
import errno
import os
import platform
import re
import secrets
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

# What only writing fails with; such an error often does not name the file.
_WRITING = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS})
# Seconds after which a file that nobody has touched is nobody's, on whatever machine.
_ABANDONED = 24 * 3600.0
# Temporary files of this process's other threads.
_own: set[Path] = set()


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Give a temporary path beside ``path`` to write to, and rename it to ``path`` at the end.

    When the block fails, the temporary file is removed and whatever was at ``path`` is untouched.
    Several writers of one path do not disturb each other; the last one to end wins. A process
    that is killed leaves at most one hidden file, ``.<name>.<writer>.tmp``, which the next write
    of ``path`` removes.

    Raises:
        OSError: the file cannot be written (full disk, no permission); names ``path``. An OSError
            that the block raises for another reason passes as it is.
    """
    path = Path(path)
    temporary = path.with_name(
        f".{path.name}.{_machine()}-{os.getpid()}-{secrets.token_hex(4)}.tmp"
    )
    _own.add(temporary)
    try:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            _remove_abandoned(path)
        except OSError as error:
            raise _cannot_write(path, error) from error
        try:
            yield temporary
        except OSError as error:
            if _is_about(temporary, error):
                raise _cannot_write(path, error) from error
            raise
        try:
            with temporary.open("rb+") as written:
                os.fsync(written.fileno())
            temporary.replace(path)
        except OSError as error:
            raise _cannot_write(path, error) from error
    except BaseException:
        _remove(temporary)
        raise
    finally:
        _own.discard(temporary)


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write ``content`` to ``path``, whole or not at all.

    Raises:
        OSError: the file cannot be written; names ``path``.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def _cannot_write(path: Path, error: OSError) -> OSError:
    reason = error.strerror or str(error)
    return OSError(
        error.errno, f"cannot write ({reason}); nothing at this path was changed", str(path)
    )


def _is_about(temporary: Path, error: OSError) -> bool:
    """Whether an error says that ``temporary`` could not be written."""
    if error.filename is None:
        # HDF5 names the file in its message only.
        return error.errno in _WRITING or str(temporary) in str(error)
    return str(temporary) in (os.fsdecode(error.filename), os.fsdecode(error.filename2 or ""))


def _machine() -> str:
    return f"{zlib.crc32(platform.node().encode()):08x}"


def _remove_abandoned(path: Path) -> None:
    """Remove temporary files of ``path`` whose writers are dead."""
    pattern = re.compile(rf"\.{re.escape(path.name)}\.([0-9a-f]{{8}})-(\d+)-[0-9a-f]{{8}}\.tmp")
    with os.scandir(path.parent) as entries:
        found = [(entry, match) for entry in entries if (match := pattern.fullmatch(entry.name))]
    for entry, match in found:
        file = path.parent / entry.name
        here = match[1] == _machine()
        if file not in _own and ((here and not _lives(int(match[2]))) or _is_old(file)):
            _remove(file)


def _lives(process: int) -> bool:
    if process == os.getpid():  # whose files are known, so this is a namesake's from before
        return False
    if os.name != "posix":  # where asking is not harmless
        return True
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True


def _is_old(path: Path) -> bool:
    try:
        return time.time() - path.stat().st_mtime > _ABANDONED
    except OSError:  # gone meanwhile
        return False


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)
