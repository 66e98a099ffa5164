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
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

_PACKAGE = Path(__file__).resolve().parent.parent
_SOURCE = ("python", "crates", "Cargo.toml", "Cargo.lock")
_PATIENCE = 120.0
_PROGRAMS = ("numpy", "torch", "gymnasium", "mujoco")


def code_of() -> dict[str, Any]:
    """Version, commit, source, uncommitted changes, and programs.

    Returns:
        ``version`` of this package; ``commit`` of its repository, None outside of one; ``source``,
        a checksum of the package's files (as committed, inside the repository; with the compiled
        extension, outside of one); ``changes``, a checksum of what is not committed, None where
        nothing is; ``packages``, ``python``, ``machine``.
    """
    commit, source, changes = _repository()
    return {
        "version": _version("hvf"),
        "commit": commit,
        "source": source,
        "changes": changes,
        "packages": {name: _version(name) for name in _PROGRAMS},
        "python": platform.python_version(),
        "machine": f"{platform.machine()} {sys.platform}",
    }


def same_code(a: Mapping[str, Any], b: Mapping[str, Any]) -> bool:
    """Whether two records are of the same code and programs.

    A commit that changes nothing but documentation or results is the same code.
    """
    keys = ("version", "source", "changes", "packages")
    return all(a.get(key) == b.get(key) for key in keys)


@functools.cache
def _repository() -> tuple[str | None, str, str | None]:
    """Commit, checksum of the source, and that of changes, of the repository of this package."""
    try:
        top = Path(_git(_PACKAGE, "rev-parse", "--show-toplevel").strip())
        if not _is_ours(top):
            raise OSError("another project's repository")
        commit = _git(top, "rev-parse", "HEAD").strip()
        trees = _git(top, "rev-parse", *(f"HEAD:{path}" for path in _SOURCE))
        changed = _git(top, "diff", "HEAD", "--", *_SOURCE)
        new = _git(top, "ls-files", "--others", "--exclude-standard", "--", *_SOURCE)
    except (OSError, subprocess.SubprocessError):
        return None, _checksum([*sorted(_PACKAGE.rglob("*.py")), *_extensions()]), None
    source = hashlib.sha256(trees.encode()).hexdigest()[:16]
    if not changed and not new.strip():
        return commit, source, None
    digest = hashlib.sha256(changed.encode())
    for name in new.split("\n"):
        if name and (top / name).is_file():
            digest.update(name.encode() + (top / name).read_bytes())
    return commit, source, digest.hexdigest()[:16]


def _is_ours(top: Path) -> bool:
    """Whether a repository is this project's: it holds this package, and says its name."""
    project = top / "pyproject.toml"
    return (
        project.is_file()
        and 'name = "hvf"' in project.read_text()
        and top / "python" / "hvf" == _PACKAGE
    )


def _extensions() -> list[Path]:
    """The compiled half of the package: what it was compiled from is not installed."""
    found = find_spec("hvf_core")
    folders = found.submodule_search_locations if found is not None else None
    return sorted(
        path
        for folder in folders or ()
        for path in Path(folder).iterdir()
        if path.name.endswith(tuple(EXTENSION_SUFFIXES))
    )


def _checksum(paths: list[Path]) -> str:
    digest = hashlib.sha256()
    for path in paths:
        inside = path.is_relative_to(_PACKAGE)
        name = path.relative_to(_PACKAGE).as_posix() if inside else path.name
        digest.update(name.encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def _git(folder: Path, *arguments: str) -> str:
    # On a busy machine it may take many seconds. Without an answer there must be no other identity:
    # a stopped evaluation would be one by other code.
    try:
        result = subprocess.run(
            ["git", *arguments],
            cwd=folder,
            capture_output=True,
            text=True,
            check=True,
            timeout=_PATIENCE,
        )
    except subprocess.TimeoutExpired as error:
        raise RuntimeError(f"git {arguments[0]}: no answer in {_PATIENCE:g} s") from error
    return result.stdout


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"
