"""Files that appear whole or not at all: writers that fail, die, or write at the same time."""

from __future__ import annotations

import errno
import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import hypothesis.strategies as st
import pytest
from hypothesis import HealthCheck, given, settings

import processes
from hvf.files import replacing, write_bytes


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def write_and(path: Path, then: Callable[[Path], object]) -> None:
    with replacing(path) as temporary:
        temporary.write_bytes(b"half")
        then(temporary)


def raiser(error: BaseException) -> Callable[[Path], object]:
    def fail(_: Path) -> None:
        raise error

    return fail


# ---- which errors are about the file ------------------------------------------------------------


@pytest.mark.parametrize(
    "error",
    [
        FileNotFoundError("part-7.h5: no such data file"),
        FileNotFoundError(errno.ENOENT, "No such file or directory", "input.png"),
        PermissionError(errno.EACCES, "Permission denied", "elsewhere/input.h5"),
        OSError(errno.ENOSPC, "No space left on device", "/elsewhere/log"),
        OSError(errno.EIO, "Input/output error"),
        ConnectionResetError(errno.ECONNRESET, "Connection reset by peer"),
        OSError("no OpenGL"),
    ],
    ids=str,
)
def test_an_error_of_other_work_passes_as_it_is(error: OSError, tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"good")
    with pytest.raises(OSError) as caught:
        write_and(path, raiser(error))
    assert caught.value is error
    assert names(tmp_path) == ["file"]
    assert path.read_bytes() == b"good"


def test_a_file_that_other_work_misses_keeps_its_name(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"nothing\.png") as caught:
        write_and(tmp_path / "file", lambda _: (tmp_path / "nothing.png").read_bytes())
    assert "cannot write" not in str(caught.value)


@pytest.mark.parametrize(
    "make",
    [
        lambda temporary: OSError(errno.ENOSPC, "No space left on device"),
        lambda temporary: OSError(errno.EFBIG, "File too large"),
        lambda temporary: PermissionError(errno.EACCES, "Permission denied", str(temporary)),
        lambda temporary: OSError(errno.EIO, "Input/output error", os.fsencode(temporary)),
        lambda temporary: OSError(f"Unable to create file (name = '{temporary}')"),
    ],
)
def test_an_error_of_writing_names_the_path(
    make: Callable[[Path], OSError], tmp_path: Path
) -> None:
    def fail(temporary: Path) -> None:
        raise make(temporary)

    with pytest.raises(OSError, match="cannot write") as caught:
        write_and(tmp_path / "file", fail)
    assert caught.value.filename == str(tmp_path / "file")
    assert names(tmp_path) == []


def test_what_hdf5_cannot_create_names_the_path(tmp_path: Path) -> None:
    def fail(temporary: Path) -> None:
        temporary.unlink()
        temporary.mkdir()
        try:
            h5py.File(temporary, "w")
        finally:
            temporary.rmdir()

    with pytest.raises(OSError, match=r"cannot write.*/file'"):
        write_and(tmp_path / "file", fail)


def test_a_block_that_writes_nothing_is_an_error_of_this_path(tmp_path: Path) -> None:
    with (
        pytest.raises(FileNotFoundError, match="cannot write") as caught,
        replacing(tmp_path / "file"),
    ):
        pass
    assert caught.value.filename == str(tmp_path / "file")


# ---- several writers ----------------------------------------------------------------------------


def test_writers_of_one_path_at_the_same_time_all_succeed(tmp_path: Path) -> None:
    path, ready, failed = tmp_path / "file", threading.Barrier(8), []

    def write(content: bytes) -> None:
        try:
            for _ in range(20):
                with replacing(path) as temporary:
                    temporary.write_bytes(content)
                    ready.wait(60)
                    assert temporary.read_bytes() == content
        except BaseException as error:
            failed.append(error)
            ready.abort()

    threads = [threading.Thread(target=write, args=(bytes([i]) * 1000,)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert failed == []
    assert names(tmp_path) == ["file"]
    assert path.read_bytes() in {bytes([i]) * 1000 for i in range(8)}


def other_writer(path: Path, until: Path) -> list[str]:
    """A program that writes ``path`` until there is a file ``until``."""
    return processes.python(
        "import os, time; from hvf.files import replacing\n"
        f"with replacing({str(path)!r}) as temporary:\n"
        "    temporary.write_bytes(b'of the other process')\n"
        "    print('writing', flush=True)\n"
        f"    while not os.path.exists({str(until)!r}): time.sleep(0.01)\n"
    )


def test_another_process_may_write_the_same_path(tmp_path: Path) -> None:
    path, until = tmp_path / "folder/file", tmp_path / "done"
    with processes.started(other_writer(path, until)) as child:
        child.wait_for("writing")
        write_bytes(path, b"mine")
        assert path.read_bytes() == b"mine"
        assert len(names(path.parent)) == 2
        until.touch()
        assert child.wait() == 0, child.errors
    assert path.read_bytes() == b"of the other process"
    assert names(path.parent) == ["file"]


def test_what_a_killed_process_leaves_goes_with_the_next_write(tmp_path: Path) -> None:
    path = tmp_path / "file"
    with processes.started(other_writer(path, tmp_path / "never")) as child:
        child.wait_for("writing")
        child.tell(signal.SIGKILL)
        child.wait()
    assert len(names(tmp_path)) == 1
    assert not path.exists()
    write_bytes(tmp_path / "another", b"leaves it alone")
    assert len(names(tmp_path)) == 2
    write_bytes(path, b"whole")
    assert names(tmp_path) == ["another", "file"]


def test_a_forgotten_file_of_another_machine_goes_after_a_day(tmp_path: Path) -> None:
    fresh, old = (tmp_path / f".file.0123abcd-12-{n}.tmp" for n in ("00000001", "00000002"))
    for file in (fresh, old):
        file.write_bytes(b"half")
    before = time.time() - 25 * 3600
    os.utime(old, (before, before))
    write_bytes(tmp_path / "file", b"whole")
    assert names(tmp_path) == sorted([fresh.name, "file"])


@given(name=st.text(st.characters(categories=["L", "N", "P"]), min_size=1, max_size=20))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=50)
def test_only_temporary_files_of_this_very_path_are_removed(name: str, tmp_path: Path) -> None:
    name = name.replace("/", "_").replace(".", "_")
    with replacing(tmp_path / "file") as temporary:
        temporary.write_bytes(b"")
        # The same writer, as if it were dead: no process has this number.
        dead = temporary.name.replace(f"-{os.getpid()}-", "-99999999-")
        mine = tmp_path / dead.replace(".file.", f".{name}.", 1)
        others = [tmp_path / f".{name}{tail}" for tail in ("x" + dead[5:], ".tmp", ".x.tmp")]
        others.append(tmp_path / dead.replace(".file.", f".{name}.more.", 1))
        for file in (mine, *others):
            file.write_bytes(b"")
        write_bytes(tmp_path / name, b"whole")
        assert not mine.exists()
        for file in others:
            file.unlink()
    for file in tmp_path.iterdir():
        file.unlink()
