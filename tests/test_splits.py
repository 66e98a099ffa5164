"""Which episodes are for training, validation and test."""

from __future__ import annotations

import hypothesis.strategies as st
import pytest
from hypothesis import given

from hvf.data.episodes import Metadata
from hvf.data.splits import DATA_SEEDS, EPISODE_SEEDS, SPLITS, episodes_of, held_out


def metadata(episodes: int, seed: int | None = 0) -> Metadata:
    return Metadata("numbers", {}, seed, 5, episodes, {})


@given(total=st.integers(2, 100_000))
def test_training_and_validation_share_nothing_and_leave_nothing(total: int) -> None:
    train, validation = (list(episodes_of(s, metadata(total))) for s in ("train", "validation"))
    assert train + validation == list(range(total))
    assert len(train) >= 1
    assert len(validation) == held_out(total)


@pytest.mark.parametrize(
    ("total", "count"), [(2, 1), (39, 1), (40, 2), (3999, 199), (4000, 200), (10_000, 200)]
)
def test_validation_is_the_last_twentieth_at_most_200(total: int, count: int) -> None:
    assert episodes_of("validation", metadata(total)) == range(total - count, total)


def test_test_data_is_a_whole_second_collection() -> None:
    assert episodes_of("test", metadata(1, DATA_SEEDS["test"])) == range(1)
    assert episodes_of("test", metadata(30, None)) == range(30)  # recorded in the world
    with pytest.raises(ValueError, match=r"split: 'test'.*seed 1.*has seed 0"):
        episodes_of("test", metadata(30, DATA_SEEDS["train"]))


def test_seeds_of_splits_differ() -> None:
    assert len(set(EPISODE_SEEDS.values())) == len(SPLITS)
    assert DATA_SEEDS["train"] != DATA_SEEDS["test"]
    assert tuple(EPISODE_SEEDS) == SPLITS


def test_an_unknown_split_and_a_file_too_short_are_named() -> None:
    with pytest.raises(ValueError, match="split: must be one of train, validation, test; got 'x'"):
        episodes_of("x", metadata(5))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="2 episodes"):
        episodes_of("train", metadata(1))
