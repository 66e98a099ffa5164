"""How many cores there are to work with, in a container as well."""

from __future__ import annotations

import os
from pathlib import Path, PurePosixPath


def cores(root: str | Path = "/") -> int:
    """Cores that this process may use, at least 1.

    The least of what its affinity mask holds and what the quotas of its control groups come to,
    rounded down: the rule of Rust's ``available_parallelism``, so that processes of Python and
    threads of the native code agree. Linux keeps both; elsewhere it is the number of cores.

    Args:
        root: where ``proc`` and ``sys`` are found.
    """
    try:
        allowed = len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        allowed = os.cpu_count() or 1
    quota = _quota(Path(root))
    return allowed if quota is None else max(1, min(allowed, int(quota)))


def _quota(root: Path) -> float | None:
    """The least quota of this process's control groups and those above them, in cores."""
    mounts = root / "sys/fs/cgroup"
    found: list[float] = []
    for line in _read(root / "proc/self/cgroup").splitlines():
        # "0::/path" is version 2, "4:cpu,cpuacct:/path" version 1.
        _, controllers, path = (*line.split(":", 2), "", "")[:3]
        if controllers and "cpu" not in controllers.split(","):
            continue
        # Version 2 lies at the mount point, or in unified/ where both versions are mounted.
        names = (controllers, "cpu") if controllers else ("", "unified")
        for group in _upwards(path):
            for name in names:
                folder = mounts / name / group
                words = _read(folder / "cpu.max").split() if not controllers else _old_words(folder)
                quota = _cores(words)
                if quota is not None:
                    found.append(quota)
    return min(found, default=None)


def _upwards(path: str) -> list[str]:
    """A group's path relative to its mount point, and those of the groups it is in."""
    parts = PurePosixPath(path.lstrip("/")).parts
    # A container may name a group outside of what it sees: its own is then at the mount point.
    return ["/".join(parts[:length]) for length in range(len(parts), -1, -1)]


def _old_words(folder: Path) -> list[str]:
    return [_read(folder / f"cpu.cfs_{name}_us").strip() for name in ("quota", "period")]


def _cores(words: list[str]) -> float | None:
    """Quota / period, both in microseconds; None without one ("max", -1, no such file)."""
    try:
        quota, period = (int(word) for word in words)
    except ValueError:
        return None
    return quota / period if quota > 0 and period > 0 else None


def _read(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""
