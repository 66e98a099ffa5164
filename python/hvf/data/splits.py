"""Three disjoint splits: which episodes each has, and the seeds of each.

*train* is what models learn from. *validation* is what designs, settings, weights and defaults are
chosen on. *test* is what published figures are made of, once; nothing is chosen on it.

Within a file of recorded episodes, validation is its last twentieth and train the rest. Test is a
file of its own: a second collection, with another seed (:data:`DATA_SEEDS`), or the part of a
public data set that its makers held out; files of recorded data say which they are, as ``split``
among the parameters of their metadata (``hvf data import``).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, TypeAlias, get_args

from hvf.data.episodes import Metadata

Split: TypeAlias = Literal["train", "validation", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)

EPISODE_SEEDS: Mapping[str, int] = {
    "train": 1_000_000_021,
    "validation": 1_000_000_009,
    "test": 1_000_000_007,
}
"""Seeds of simulated episodes to act in."""

DATA_SEEDS: Mapping[str, int] = {"train": 0, "test": 1}
"""Seeds of collections: of training data (with its validation episodes), and of a second one that
figures of prediction are measured on."""

_MOST_HELD_OUT = 200


def held_out(total: int) -> int:
    """How many of the ``total`` episodes of a file are for validation: a twentieth, 1 to 200.

    Raises:
        ValueError: fewer than 2 episodes, so that none would be left.
    """
    if total < 2:
        raise ValueError(f"needs at least 2 episodes to hold one out, has {total}")
    return min(max(total // 20, 1), _MOST_HELD_OUT)


def episodes_of(split: Split, metadata: Metadata) -> range:
    """The numbers of the episodes of a file that belong to a split.

    Raises:
        ValueError: an unknown split; a file too short to hold an episode out; ``"test"`` of a
            collection with the seed of training data, or of recorded data that is for training;
            or another split of recorded data that is for tests.
    """
    if split not in SPLITS:
        raise ValueError(f"split: must be one of {', '.join(SPLITS)}; got {split!r}")
    total = metadata.episodes
    made_for = metadata.parameters.get("split")
    if made_for in SPLITS and (made_for == "test") != (split == "test"):
        raise ValueError(f"split: {split!r} is asked for, but these episodes are for {made_for}")
    if split == "test":
        if metadata.seed == DATA_SEEDS["train"]:
            raise ValueError(
                f"split: 'test' is a collection of its own, with seed {DATA_SEEDS['test']}; "
                f"this one has seed {metadata.seed}, that of training data"
            )
        return range(total)
    first = total - held_out(total)
    return range(first) if split == "train" else range(first, total)
