"""Three disjoint splits, and the seeds of each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, TypeAlias

Split: TypeAlias = Literal["train", "validation", "test"]

EPISODE_SEEDS: Mapping[str, int] = {
    "train": 1_000_000_021,
    "validation": 1_000_000_009,
    "test": 1_000_000_007,
}
"""Seeds of simulated episodes. *validation* is what designs, settings and weights are chosen on,
*test* what published tables are made of, once."""
