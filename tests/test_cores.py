"""How many cores there are, by quotas in files made up in the layout of Linux."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from hvf.cores import cores

UNIFIED, OLD = "0::/jobs/mine\n", "9:memory:/x\n4:cpu,cpuacct:/jobs/mine\n1:name=systemd:/\n"


@pytest.fixture(autouse=True)
def sixteen_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(16)), raising=False)


def tree(root: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


def unified(quota: str, group: str = "jobs/mine") -> dict[str, str]:
    return {
        "proc/self/cgroup": UNIFIED,
        f"sys/fs/cgroup/{group}/cpu.max": quota,
    }


def old(quota: str, period: str = "100000", group: str = "cpu,cpuacct/jobs/mine") -> dict[str, str]:
    return {
        "proc/self/cgroup": OLD,
        f"sys/fs/cgroup/{group}/cpu.cfs_quota_us": f"{quota}\n",
        f"sys/fs/cgroup/{group}/cpu.cfs_period_us": f"{period}\n",
    }


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({}, 16),
        (unified("max 100000\n"), 16),
        (unified("400000 100000\n"), 4),
        (unified("250000 100000\n"), 2),
        (unified("50000 100000\n"), 1),
        (unified("9900000 100000\n"), 16),
        (unified("nonsense"), 16),
        (unified("300000 100000\n", "jobs"), 3),
        # A container: its group has another name outside, and is the mount point inside.
        (unified("300000 100000\n", "."), 3),
        (unified("300000 100000\n", "unified/jobs/mine"), 3),
        (old("-1"), 16),
        (old("500000"), 5),
        (old("120000", "50000"), 2),
        (old("500000", group="cpu/jobs"), 5),
        (old("500000", group="cpu"), 5),
        (old("500000", "0"), 16),
        # Of a hierarchy that is not about cores.
        (old("500000", group="memory/x"), 16),
    ],
)
def test_cores_are_those_of_the_least_quota(
    tmp_path: Path, files: dict[str, str], expected: int
) -> None:
    assert cores(tree(tmp_path, files)) == expected


def test_the_group_above_counts_as_well(tmp_path: Path) -> None:
    tree(tmp_path, unified("800000 100000\n") | unified("200000 100000\n", "jobs"))
    assert cores(tmp_path) == 2


def test_affinity_counts_as_well(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {3}, raising=False)
    assert cores(tree(tmp_path, unified("400000 100000\n"))) == 1


def test_this_machine_has_some() -> None:
    assert 1 <= cores() <= 16
