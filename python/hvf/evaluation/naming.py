"""Names of files: what a thing is, and all settings that differ from its preset's.

Settings that differ have names that differ, so that sweeps do not collide.
"""

from __future__ import annotations

import dataclasses
import hashlib
import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any


def slug(words: Sequence[str]) -> str:
    """Words as one name, of small letters, digits, dots and dashes."""
    return re.sub(r"[^a-z0-9.]+", "-", " ".join(words).lower()).strip("-")


def changes(a: Any, b: Any) -> Mapping[str, Any]:
    """Fields of ``a`` that differ from those of ``b``."""
    names = [field.name for field in dataclasses.fields(a)]
    return {name: getattr(a, name) for name in names if getattr(a, name) != getattr(b, name)}


def word(value: Any, names: Collection[str]) -> str:
    """A value in a file's name, with a checksum where the word does not tell it exactly."""
    said = short(str(value))
    number = isinstance(value, int | float) and value >= 0
    plain = number or value is None or value in names or re.fullmatch(r"[a-z0-9.]+", said)
    if plain and said == str(value):
        return said
    return f"{said}-{hashlib.sha256(repr(value).encode()).hexdigest()[:6]}"


def short(name: str) -> str:
    """A model's name; a checkpoint by its run."""
    if "/" not in name and not name.endswith(".safetensors"):
        return name
    words = name.removesuffix(".safetensors").removesuffix("/model").split("/")
    return words[-1]
