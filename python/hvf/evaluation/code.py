"""Which code runs: recorded with every result, and compared before one is gone on with.

The commit is that of the repository that this file is part of, and of no other: an installed
package inside somebody else's repository has a version and a checksum, no commit.
"""

from __future__ import annotations

import functools
import hashlib
import platform
import subprocess
import sys
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

_PACKAGE = Path(__file__).resolve().parent.parent
_PROGRAMS = ("numpy", "torch", "gymnasium", "mujoco")


def code_of() -> dict[str, Any]:
    """Version, commit, uncommitted changes, and programs.

    Returns:
        ``version`` of this package; ``commit`` of its repository, None outside of one; ``changes``,
        a checksum of what is not committed (inside the repository) or of the package's files
        (outside), None where nothing is; ``packages``, ``python``, ``machine``.
    """
    commit, changes = _repository()
    return {
        "version": _version("hvf"),
        "commit": commit,
        "changes": changes,
        "packages": {name: _version(name) for name in _PROGRAMS},
        "python": platform.python_version(),
        "machine": f"{platform.machine()} {sys.platform}",
    }


def same_code(a: Mapping[str, Any], b: Mapping[str, Any]) -> bool:
    """Whether two records are of the same code and programs."""
    keys = ("version", "commit", "changes", "packages")
    return all(a.get(key) == b.get(key) for key in keys)


@functools.cache
def _repository() -> tuple[str | None, str | None]:
    """Commit and checksum of changes of the repository that holds this package."""
    try:
        top = Path(_git(_PACKAGE, "rev-parse", "--show-toplevel").strip())
        if not _is_ours(top):
            raise OSError("another project's repository")
        commit = _git(top, "rev-parse", "HEAD").strip()
        changed = _git(top, "diff", "HEAD", "--", "python", "crates", "Cargo.toml", "Cargo.lock")
        new = _git(top, "ls-files", "--others", "--exclude-standard", "--", "python", "crates")
    except (OSError, subprocess.SubprocessError):
        return None, _checksum(sorted(_PACKAGE.rglob("*.py")))
    if not changed and not new.strip():
        return commit, None
    digest = hashlib.sha256(changed.encode())
    for name in new.split("\n"):
        if name and (top / name).is_file():
            digest.update(name.encode() + (top / name).read_bytes())
    return commit, digest.hexdigest()[:16]


def _is_ours(top: Path) -> bool:
    """Whether a repository is this project's: it holds this package, and says its name."""
    project = top / "pyproject.toml"
    return (
        project.is_file()
        and 'name = "hvf"' in project.read_text()
        and top / "python" / "hvf" == _PACKAGE
    )


def _checksum(paths: list[Path]) -> str:
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.relative_to(_PACKAGE).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def _git(folder: Path, *arguments: str) -> str:
    result = subprocess.run(
        ["git", *arguments], cwd=folder, capture_output=True, text=True, check=True, timeout=10
    )
    return result.stdout


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"
