"""Files that were made to break whoever opens them are refused by name (``attacks/README.md``)."""

from __future__ import annotations

import functools
import importlib
import json
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("torch")

import processes

RUN = Path(__file__).parent / "attacks" / "run.py"
FAMILIES = ("checkpoints", "episodes", "pictures", "reports")
CASES = [
    (family, name)
    for family in FAMILIES
    for name in importlib.import_module(f"attacks.{family}").ATTACKS
]


@functools.cache
def came_of(family: str) -> dict[str, dict[str, Any]]:
    """What came of each attack of a family that was reached, opened in a process of its own."""
    done = processes.run((sys.executable, str(RUN), family))
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    return {line["attack"]: line for line in lines}


@pytest.mark.parametrize(("family", "name"), CASES)
def test_an_attack_is_refused_by_the_name_of_its_file(family: str, name: str) -> None:
    outcome = came_of(family).get(name)
    assert outcome is not None, f"{family} ended before {name!r}"
    assert (outcome["raised"], outcome["named"]) == ("ValueError", True), outcome["words"]
