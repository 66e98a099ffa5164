"""Files of episodes of every kind: without states, of different lengths, of several cameras."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import h5py
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

from hvf.data.collect import CollectConfig, collect
from hvf.data.episodes import Episodes, Metadata
from hvf.data.formats import FORMATS, EpisodeReader, Format, open_episodes
from hvf.data.formats.hdf5 import EpisodeFile, join_files, write_episodes
from hvf.data.loader import EpisodePool, PairSampler, WindowSampler
from hvf.registry import Registry

T = 6


def ragged(lengths: list[int], seed: int = 0, states: bool = False) -> Episodes:
    """Episodes whose pixels say which episode and time they are of, and noise after the end."""
    rng = np.random.default_rng(seed)
    count = len(lengths)
    frames = rng.integers(200, 256, (count, T + 1, 8, 8, 3)).astype(np.uint8)
    actions = rng.random((count, T, 2)).astype(np.float32)
    for i, length in enumerate(lengths):
        frames[i, : length + 1, 0, 0, 0] = i
        frames[i, : length + 1, 0, 0, 1] = np.arange(length + 1)
        actions[i, :length] = np.stack([np.full(length, i), np.arange(length)], 1)
    known = rng.random((count, T + 1, 3)) if states else None
    return Episodes(frames, actions, known, 0, np.array(lengths))


def metadata(episodes: int, **fields: Any) -> Metadata:
    return Metadata("numbers", {}, None, T, episodes, {}, **fields)


def written(path: Path, episodes: Episodes, **fields: Any) -> Path:
    write_episodes(path, metadata(len(episodes), **fields), episodes)
    return path


# ---- what a file holds --------------------------------------------------------------------------


@given(
    lengths=st.lists(st.integers(1, T), min_size=1, max_size=5),
    states=st.booleans(),
    seed=st.integers(0, 2**63 - 1) | st.none(),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=25)
def test_what_is_written_is_read(
    lengths: list[int], states: bool, seed: int | None, tmp_path: Path
) -> None:
    path, episodes = tmp_path / "episodes.h5", ragged(lengths, states=states)
    about = dataclasses.replace(
        metadata(len(lengths)),
        seed=seed,
        cameras=("front",),
        action_names=("left", "right"),
        action_low=(-1.0, 0.0),
        action_high=(1.0, 2.5),
        versions={"hvf": "0"},
        parameters={"size": 8, "names": ["a"]},
    )
    write_episodes(path, about, episodes)
    with open_episodes(path, "numbers") as file:
        assert isinstance(file, EpisodeReader)
        assert file.metadata == about
        assert file.lengths.tolist() == lengths
        assert (file.frame_shape, file.action_dim, len(file)) == ((8, 8, 3), 2, len(lengths))
        found = file.read(0, len(lengths))
        assert found.lengths.tolist() == lengths
        assert (found.states is not None) == states
        frames, actions = np.empty((T + 1, 8, 8, 3), np.uint8), np.empty((T, 2), np.float32)
        for i, length in enumerate(lengths):
            file.read_into(i, frames, actions)
            for one, other, whole in (
                (found.frames[i], frames, episodes.frames[i]),
                (found.actions[i], actions, episodes.actions[i]),
            ):
                end = length + len(one) - T
                np.testing.assert_array_equal(one[:end], whole[:end])
                assert not one[end:].any()
                np.testing.assert_array_equal(one, other)
            if found.states is not None:
                assert episodes.states is not None
                np.testing.assert_array_equal(
                    found.states[i, : length + 1], episodes.states[i, : length + 1]
                )


def test_states_that_nobody_knows_are_an_error_where_they_are_needed() -> None:
    with pytest.raises(ValueError, match="states: these episodes have none"):
        _ = ragged([2, 3]).true_states
    known = ragged([2, 3], states=True)
    assert known.true_states is known.states


def test_a_file_of_version_1_is_read(tmp_path: Path) -> None:
    """Written as version 1 was, without this program."""
    path, rng = tmp_path / "old.h5", np.random.default_rng(0)
    arrays = {
        "frames": rng.integers(0, 256, (3, 5, 8, 8, 3)).astype(np.uint8),
        "actions": rng.random((3, 4, 2)).astype(np.float32),
        "states": rng.random((3, 5, 6)),
    }
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            file.create_dataset(name, data=array, chunks=(1, *array.shape[1:]), compression="gzip")
        for name, value in {
            "format": "hvf-episodes-1",
            "environment": "maze",
            "parameters": json.dumps({"image_size": 8}),
            "seed": 7,
            "steps": 4,
            "episodes": 3,
            "versions": json.dumps({"hvf": "0.1.0"}),
            "diverged": 0,
        }.items():
            file.attrs[name] = value
    with open_episodes(path, "maze") as old:
        expected = Metadata("maze", {"image_size": 8}, 7, 4, 3, {"hvf": "0.1.0"})
        assert old.metadata == expected
        assert old.lengths.tolist() == [4, 4, 4]
        found = old.read(0, 3)
    for name, array in arrays.items():
        np.testing.assert_array_equal(getattr(found, name), array)
    with h5py.File(path, "r+") as file:
        del file["states"]
    with pytest.raises(ValueError, match=r"old\.h5: damaged"):
        open_episodes(path)


def test_each_camera_has_its_frames_and_the_first_is_the_default(tmp_path: Path) -> None:
    path, episodes = tmp_path / "two.h5", ragged([6, 3])
    wrist = np.random.default_rng(1).integers(0, 256, (2, T + 1, 4, 5, 3)).astype(np.uint8)
    about = metadata(2, cameras=("front", "wrist"))
    write_episodes(path, about, episodes, views={"wrist": wrist})
    joined = tmp_path / "joined.h5"
    join_files(joined, dataclasses.replace(about, episodes=4), [path, path])
    for source, count in ((path, 2), (joined, 4)):
        for camera, frames in ((None, episodes.frames), ("front", episodes.frames)):
            with open_episodes(source, camera=camera) as file:
                np.testing.assert_array_equal(file.read(0, 1).frames[0], frames[0])
        with open_episodes(source, camera="wrist") as file:
            assert file.frame_shape == (4, 5, 3)
            found = file.read(count - 2, 2).frames
            np.testing.assert_array_equal(found[0], wrist[0])
            np.testing.assert_array_equal(found[1, :4], wrist[1, :4])
            assert not found[1, 4:].any()
        with pytest.raises(ValueError, match=r"no camera 'top'.*front.*wrist"):
            open_episodes(source, camera="top")
    pool = EpisodePool(joined, camera="wrist")
    pool.move_to(0)
    assert pool.frames.shape == (3, T + 1, 4, 5, 3)


@pytest.mark.parametrize(
    ("views", "error"),
    [
        ({}, "metadata names"),
        ({"top": np.zeros((2, T + 1, 4, 4, 3), np.uint8)}, "metadata names"),
        ({"wrist": np.zeros((2, T, 4, 4, 3), np.uint8)}, "camera 'wrist': frames must be"),
        ({"wrist": np.zeros((2, T + 1, 4, 4, 3), np.float32)}, "camera 'wrist': frames must be"),
    ],
)
def test_views_that_do_not_fit_are_named(views: Any, error: str, tmp_path: Path) -> None:
    about = metadata(2, cameras=("front", "wrist"))
    with pytest.raises((ValueError, TypeError), match=f"views: .*{error}|views: {error}"):
        write_episodes(tmp_path / "x.h5", about, ragged([2, 3]), views=views)


# ---- borders ------------------------------------------------------------------------------------


@given(
    dtype=st.sampled_from([np.int64, np.int32, np.float64, np.uint64]),
    lengths=st.lists(st.integers(0, T + 2), max_size=5),
)
def test_lengths_are_consistent_or_refused(dtype: Any, lengths: list[int]) -> None:
    good = ragged([T] * 3)
    array = np.array(lengths, dtype)
    if not lengths:
        assert Episodes(good.frames, good.actions, lengths=array).lengths.tolist() == [T] * 3
    elif dtype != np.int64:
        with pytest.raises(TypeError, match=r"^lengths must be int64"):
            Episodes(good.frames, good.actions, lengths=array)
    elif len(lengths) == 3 and all(1 <= length <= T for length in lengths):
        assert Episodes(good.frames, good.actions, lengths=array).lengths is array
    else:
        with pytest.raises(ValueError, match=r"^lengths must be"):
            Episodes(good.frames, good.actions, lengths=array)


def test_episodes_that_are_no_arrays_are_refused() -> None:
    good = ragged([2])
    for name in ("frames", "actions", "states", "lengths"):
        fields = {"frames": good.frames, "actions": good.actions, name: [1]}
        with pytest.raises(TypeError, match=f"^{name} must be an array, got list"):
            Episodes(**fields)  # type: ignore[arg-type]


@given(data=st.data())
def test_an_action_box_is_consistent_or_refused(data: st.DataObject) -> None:
    number = st.floats(-3, 3) | st.sampled_from([float("nan"), float("inf")])
    box = st.none() | st.lists(number, max_size=3).map(tuple)
    low, high = data.draw(box), data.draw(box)
    fits = (low is None) == (high is None)
    if low is not None and high is not None:
        fits = len(low) == len(high) and all(
            np.isfinite([a, b]).all() and a < b for a, b in zip(low, high, strict=True)
        )
    if fits:
        assert metadata(1, action_low=low, action_high=high).action_low == low
    else:
        with pytest.raises(ValueError, match=r"^action_low"):
            metadata(1, action_low=low, action_high=high)


@pytest.mark.parametrize("name", ["cameras", "action_names"])
@pytest.mark.parametrize("words", [("a", "a"), ("",), ("a/b",)])
def test_words_that_are_no_names_are_refused(name: str, words: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match=name):
        metadata(1, **{name: words})
    with pytest.raises(TypeError, match=name):
        metadata(1, **{name: "front"})


@pytest.mark.parametrize("name", ["steps", "episodes", "diverged"])
def test_metadata_out_of_range_is_named(name: str) -> None:
    with pytest.raises(ValueError, match=f"^{name} must be"):
        dataclasses.replace(metadata(1), **{name: -1})


@pytest.mark.parametrize(
    "fields", [{"action_names": ("x",)}, {"action_low": (0.0,) * 3, "action_high": (1.0,) * 3}]
)
def test_names_and_box_must_be_of_the_actions(fields: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"^action_(names|low): is for"):
        written(tmp_path / "x.h5", ragged([2, 3]), **fields)


@pytest.mark.parametrize(
    "damage",
    [
        lambda file: file.pop("lengths"),
        lambda file: file["lengths"].write_direct(np.array([0, 3])),
        lambda file: file["lengths"].write_direct(np.array([2, T + 1])),
        lambda file: file.attrs.modify("action_names", '["x"]'),
        lambda file: file.attrs.modify("action_low", "[2, 2]"),
        lambda file: file.attrs.modify("cameras", '["front", "wrist"]'),
        lambda file: file.attrs.modify("cameras", "7"),
        lambda file: file.attrs.pop("environment"),
        lambda file: file.pop("actions"),
        lambda file: file.move("actions", "states"),
    ],
)
def test_a_file_that_does_not_fit_together_is_damaged(damage: Any, tmp_path: Path) -> None:
    path = written(tmp_path / "bad.h5", ragged([2, 3]))
    with h5py.File(path, "r+") as file:
        damage(file)
    with pytest.raises(ValueError, match=r"bad\.h5: damaged"):
        open_episodes(path)


def test_sizes_beyond_what_the_file_can_hold_are_damage(tmp_path: Path) -> None:
    path = tmp_path / "huge.h5"
    with h5py.File(written(path, ragged([2, 3])), "r+") as file:
        del file["frames"]
        shape = (2, T + 1, 30_000, 30_000, 3)
        file.create_dataset("frames", shape, np.uint8, chunks=(1, 1, 100, 100, 3))
    with pytest.raises(ValueError, match=r"huge\.h5: damaged.*more than the file can hold"):
        open_episodes(path)


def test_another_version_is_refused_by_its_name(tmp_path: Path) -> None:
    path = written(tmp_path / "new.h5", ragged([2, 3]))
    with h5py.File(path, "r+") as file:
        file.attrs["format"] = "hvf-episodes-9"
    with pytest.raises(ValueError, match=r"new\.h5.*hvf-episodes-9.*expected 'hvf-episodes-2'"):
        open_episodes(path)


# ---- formats ------------------------------------------------------------------------------------


class Numbers:
    """A reader of episodes that are made up from a text file with their lengths."""

    def __init__(self, path: Path, camera: str | None) -> None:
        if camera not in (None, "eye"):
            raise ValueError(f"{path}: has no camera {camera!r}")
        self.path = path
        self._episodes = ragged([int(word) for word in path.read_text().split()[1:]])
        self.metadata = metadata(len(self._episodes), cameras=("eye",))
        self.lengths = self._episodes.lengths
        self.frame_shape = (8, 8, 3)
        self.action_dim = 2
        self.open = True

    def __len__(self) -> int:
        return len(self._episodes)

    def read(self, first: int, count: int) -> Episodes:
        frames, actions = self._episodes.frames, self._episodes.actions
        part = slice(first, first + count)
        return Episodes(frames[part], actions[part], lengths=self.lengths[part])

    def read_into(self, index: int, frames: Any, actions: Any) -> None:
        frames[...], actions[...] = self._episodes.frames[index], self._episodes.actions[index]

    def close(self) -> None:
        self.open = False

    def __enter__(self) -> Numbers:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def is_numbers(path: Path) -> bool:
    return path.is_file() and path.read_bytes()[:8] == b"numbers "


@pytest.fixture
def numbers_format(monkeypatch: pytest.MonkeyPatch) -> list[Numbers]:
    made: list[Numbers] = []

    def read(path: Path, camera: str | None) -> EpisodeReader:
        made.append(Numbers(path, camera))
        return made[-1]

    own = {name: f"hvf.data.formats.hdf5:{name.upper()}" for name in FORMATS}
    formats: Registry[Format] = Registry("format", "hvf.formats", own)
    formats.register("numbers", Format("numbers", (".txt", ".numbers"), is_numbers, read))
    monkeypatch.setattr("hvf.data.formats.FORMATS", formats)
    return made


def test_a_format_from_outside_is_read_by_everything(
    numbers_format: list[Numbers], tmp_path: Path
) -> None:
    path = tmp_path / "any name at all"
    path.write_text("numbers 3 6 2 5")
    with open_episodes(path, "numbers", camera="eye") as reader:
        assert isinstance(reader, Numbers)
    assert not reader.open
    pool = EpisodePool(path)
    pool.move_to(0)
    assert sorted(pool.lengths.tolist()) == [2, 3, 6]
    pool.close()
    assert not numbers_format[-1].open
    with pytest.raises(ValueError, match="expected 'maze'"):
        open_episodes(path, "maze")
    assert not numbers_format[-1].open
    own = written(tmp_path / "own.numbers", ragged([2, 3]))
    with open_episodes(own) as reader:
        assert isinstance(reader, EpisodeFile)  # by what it holds, not by its name


def test_a_file_that_no_format_knows_is_named_with_those_that_there_are(
    numbers_format: list[Numbers], tmp_path: Path
) -> None:
    path = tmp_path / "picture.png"
    path.write_bytes(b"\x89PNG")
    with pytest.raises(ValueError, match=r"picture\.png.*hvf \(\.h5 \.hdf5\), numbers \(\.txt"):
        open_episodes(path)
    with pytest.raises(ValueError, match=f"{tmp_path.name}: not a file of episodes"):
        open_episodes(tmp_path)
    with pytest.raises(FileNotFoundError, match="nothing: no such data file"):
        open_episodes(tmp_path / "nothing")
    assert numbers_format == []


def test_a_damaged_file_is_told_about_by_the_format_of_its_name(tmp_path: Path) -> None:
    for suffix in (".h5", ".hdf5"):
        path = tmp_path / f"cut{suffix}"
        path.write_bytes(b"\x89HDF\r\n\x1a\n")
        with pytest.raises(ValueError, match=f"cut{suffix}: not an HDF5 file, or truncated"):
            open_episodes(path)


@given(data=st.data())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40)
def test_a_truncated_file_of_any_name_is_one_clear_error(
    data: st.DataObject, tmp_path: Path
) -> None:
    content = written(tmp_path / "whole.h5", ragged([2, 3])).read_bytes()
    path = tmp_path / data.draw(st.sampled_from(["cut.h5", "cut"]))
    path.write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])
    with pytest.raises(ValueError, match="cut"):
        open_episodes(path)


def test_a_format_without_a_name_or_with_a_bare_suffix_is_refused() -> None:
    with pytest.raises(ValueError, match="name"):
        Format("", (".x",), is_numbers, Numbers)
    with pytest.raises(ValueError, match="suffixes"):
        Format("x", ("x",), is_numbers, Numbers)


# ---- different lengths, for training ------------------------------------------------------------


@pytest.fixture(scope="module")
def lengths() -> list[int]:
    return [1 + i * i % T for i in range(12)]


@pytest.fixture(scope="module")
def uneven(tmp_path_factory: pytest.TempPathFactory, lengths: list[int]) -> Path:
    return written(tmp_path_factory.mktemp("data") / "uneven.h5", ragged(lengths))


def small_pool(path: Path, episodes: int) -> EpisodePool:
    return EpisodePool(path, memory_gb=(episodes + 0.5) * (T + 1) * 8 * 8 * 3 / 1e9)


@pytest.mark.parametrize("held", [4, 100])
def test_pairs_are_only_of_times_that_there_are(
    held: int, uneven: Path, lengths: list[int]
) -> None:
    sampler = PairSampler(small_pool(uneven, held), 500)
    for step in range(5):
        batch = sampler.batch(step)
        scene, image = (batch[name][:, 0, 0].numpy().astype(int) for name in ("scene", "image"))
        np.testing.assert_array_equal(scene[:, 0], image[:, 0])
        ends = np.array(lengths)[scene[:, 0]]
        for times in (scene[:, 1], image[:, 1]):
            assert (times <= ends).all()  # what is after the end says 0 or at least 200
            for episode in np.unique(scene[:, 0]):
                seen = set(times[scene[:, 0] == episode])
                assert seen == set(range(lengths[episode] + 1))


@pytest.mark.parametrize("length", [1, 3, T - 1])
def test_windows_are_only_of_steps_that_there_are(
    length: int, uneven: Path, lengths: list[int]
) -> None:
    batch = WindowSampler(EpisodePool(uneven), 2000, length).batch(0)
    frames, actions = batch["frames"][:, :, 0, 0].numpy().astype(int), batch["actions"].numpy()
    np.testing.assert_array_equal(np.diff(frames[..., 1], axis=1), 1)
    np.testing.assert_array_equal(actions, frames[:, :length, :2])
    # Every window that there is, among those of training: the last episode is held out.
    windows = {(i, s) for i, n in enumerate(lengths[:-1]) for s in range(n - length + 1)}
    assert {(int(i), int(s)) for i, s in frames[:, 0, :2]} == windows


def test_windows_longer_than_all_episodes_are_refused(uneven: Path, lengths: list[int]) -> None:
    longest = max(lengths[:-1])
    with pytest.raises(ValueError, match=f"length must be from 1 to {longest}, got {longest + 1}"):
        WindowSampler(EpisodePool(uneven), 4, longest + 1)


def test_windows_longer_than_what_is_in_memory_are_an_error(uneven: Path) -> None:
    pool = small_pool(uneven, 1)
    sampler = WindowSampler(pool, 4, 5)
    found = set()
    for step in range(20):
        pool.move_to(step)
        if pool.lengths[0] >= 5:
            sampler.batch(step)
            found.add("long")
        else:
            found.add("short")
            with pytest.raises(ValueError, match=f"length: none of the 1 .* at step {step} has 5"):
                sampler.batch(step)
    assert found == {"long", "short"}


@pytest.mark.parametrize("stride", [1, 2, 4, T + 1])
def test_frames_of_a_pool_come_without_padding(
    stride: int, uneven: Path, lengths: list[int]
) -> None:
    pool = EpisodePool(uneven, "validation")
    pool.move_to(0)
    found = pool.frames_every(stride)[:, 0, 0].astype(int)
    expected = [(len(lengths) - 1, time) for time in range(0, lengths[-1] + 1, stride)]
    assert [(int(i), int(time)) for i, time in found[:, :2]] == expected
    with pytest.raises(ValueError, match="stride"):
        pool.frames_every(0)


def test_what_takes_equally_long_episodes_only_can_say_so(uneven: Path, tmp_path: Path) -> None:
    even = EpisodePool(written(tmp_path / "even.h5", ragged([T] * 8)))
    even.move_to(0)
    even.check_equal_lengths("layers")
    np.testing.assert_array_equal(
        even.frames_every(3), even.frames[:, ::3].reshape(-1, *even.frames.shape[2:])
    )
    message = rf"uneven\.h5: has episodes of 1 to {T} steps, layers takes equally"
    with pytest.raises(ValueError, match=message):
        EpisodePool(uneven).check_equal_lengths("layers")


def test_episodes_of_one_length_give_the_draws_that_they_always_gave(tmp_path: Path) -> None:
    """The formulas of before there were lengths, from the same generators."""
    episodes = ragged([T] * 8)
    pool = EpisodePool(written(tmp_path / "even.h5", episodes))
    pool.move_to(0)
    for step in range(20):
        rng = np.random.default_rng([3, step])
        which, times = rng.integers(7, size=50), rng.integers(T + 1, size=(2, 50))
        batch = PairSampler(pool, 50, seed=3).batch(step)
        np.testing.assert_array_equal(batch["scene"], pool.frames[which, times[0]])
        np.testing.assert_array_equal(batch["image"], pool.frames[which, times[1]])
        rng = np.random.default_rng([3, step])
        which, starts = rng.integers(7, size=(50, 1)), rng.integers(T - 2 + 1, size=(50, 1))
        batch = WindowSampler(pool, 50, 2, seed=3).batch(step)
        np.testing.assert_array_equal(batch["frames"], pool.frames[which, starts + np.arange(3)])
        np.testing.assert_array_equal(batch["actions"], pool.actions[which, starts + np.arange(2)])


def test_uneven_episodes_without_states_are_collected_in_parts(tmp_path: Path) -> None:
    def rollouts(seed: int, first: int, count: int, steps: int) -> Episodes:
        made = ragged([1 + (first + i) % T for i in range(count)])
        return Episodes(made.frames, made.actions, lengths=made.lengths)

    config = CollectConfig(tmp_path / "uneven.h5", 11, T, image_size=8, part=4)
    with open_episodes(collect(config, "numbers", {}, rollouts)) as file:
        assert file.lengths.tolist() == [1 + i % T for i in range(11)]
        assert file.read(4, 1).frames[0, 5, 0, 0].tolist()[:2] == [0, 5]


def test_parts_that_hold_other_arrays_are_refused(tmp_path: Path) -> None:
    one = written(tmp_path / "one.h5", ragged([2, 3]))
    two = written(tmp_path / "two.h5", ragged([2, 3], states=True))
    with pytest.raises(ValueError, match=r"two\.h5: holds other arrays than .*one\.h5"):
        join_files(tmp_path / "out.h5", metadata(4), [one, two])
