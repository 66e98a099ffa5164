"""Importing recordings: files as others write them, damaged ones, and the real sample."""

from __future__ import annotations

import contextlib
import io
import json
import re
from fractions import Fraction
from pathlib import Path
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from numpy.typing import NDArray
from PIL import Image

pytest.importorskip("google.protobuf")

import recordings
from hvf.cli import main
from hvf.data.formats import open_episodes
from hvf.data.importing.bair import BairImport, BairSource
from hvf.data.importing.example import Example
from hvf.data.importing.folder import FolderImport
from hvf.data.importing.npz import NpzImport
from hvf.data.importing.resize import area_resized, size_of
from hvf.data.importing.rlds import RldsImport
from hvf.data.importing.tfrecord import masked_crc32c, open_records
from hvf.data.loader import EpisodePool, PairSampler, WindowSampler
from hvf.data.splits import episodes_of

SHARED = Path(__file__).parents[2] / "shared" / "real"
real = pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/real is not here")
one_folder = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)


# ---- records -----------------------------------------------------------------------------------


def test_checksums_are_those_of_the_standard_masked_as_in_records() -> None:
    # RFC 3720, B.4, and the check value of the CRC catalogue.
    assert recordings.crc32c(b"123456789") == 0xE3069283
    assert recordings.crc32c(bytes(32)) == 0x8A9136AA
    for data in (b"", b"123456789", bytes(range(256))):
        assert masked_crc32c(data).to_bytes(4, "little") == recordings.masked(data)


@given(records=st.lists(st.binary(max_size=40), min_size=1, max_size=5))
@one_folder
def test_records_are_read_as_they_were_written(records: list[bytes], tmp_path: Path) -> None:
    file = open_records(recordings.write(tmp_path / "a.tfrecord", recordings.tfrecords(records)))
    assert [file.read(number) for number in range(len(file))] == records


RECORDS = [b"first", b"", b"the third record"]
WHOLE = recordings.tfrecords(RECORDS)
BORDERS = {len(recordings.tfrecords(RECORDS[:n])): n for n in range(1, 4)}


def read_all(path: Path) -> list[bytes]:
    file = open_records(path)
    return [file.read(number) for number in range(len(file))]


@given(end=st.integers(0, len(WHOLE) - 1))
@one_folder
def test_a_file_cut_off_anywhere_is_refused(end: int, tmp_path: Path) -> None:
    path = recordings.write(tmp_path / "a.tfrecord", WHOLE[:end])
    if end in BORDERS:  # which nobody can see
        assert read_all(path) == RECORDS[: BORDERS[end]]
        return
    with pytest.raises(ValueError, match=re.escape(str(path))) as caught:
        read_all(path)
    assert re.search(r"record \d|is empty", str(caught.value))


@given(bit=st.integers(0, 8 * len(WHOLE) - 1))
@one_folder
def test_a_turned_bit_is_noticed_anywhere(bit: int, tmp_path: Path) -> None:
    content = bytearray(WHOLE)
    content[bit // 8] ^= 1 << bit % 8
    path = recordings.write(tmp_path / "a.tfrecord", bytes(content))
    with pytest.raises(ValueError, match=rf"{re.escape(str(path))}: record \d"):
        read_all(path)


def test_other_files_are_told_what_they_are_not(tmp_path: Path) -> None:
    for content, said in ((b"\x1f\x8b" + bytes(30), "compressed"), (b"P" * 64, "no TFRecord")):
        with pytest.raises(ValueError, match=said):
            open_records(recordings.write(tmp_path / "a.tfrecord", content))
    with pytest.raises(FileNotFoundError, match="no such file of records"):
        open_records(tmp_path / "nothing.tfrecord")


# ---- examples ----------------------------------------------------------------------------------

float32s = st.floats(width=32, allow_nan=False)
values = (
    st.lists(st.binary(max_size=20), max_size=4)
    | st.lists(float32s, min_size=1, max_size=6)
    | st.lists(st.integers(-(2**63), 2**63 - 1), min_size=1, max_size=6)
)


@given(features=st.dictionaries(st.text(max_size=12), values, max_size=4))
@settings(max_examples=60)
def test_examples_are_read_as_the_library_of_protocol_buffers_wrote_them(features: Any) -> None:
    found = Example(recordings.example(features))
    assert set(found) == set(features)
    for name, expected in features.items():
        values = found[name]
        if isinstance(values, list):
            assert [bytes(value) for value in values] == expected
        else:
            assert values.dtype == (np.float32 if isinstance(expected[0], float) else np.int64)
            assert values.tolist() == expected


def test_numbers_need_not_be_packed() -> None:
    # Field 1, wire type 5, twice; what proto2 wrote.
    numbers = b"\x0d" + np.float32(1.5).tobytes() + b"\x0d" + np.float32(-2).tobytes()
    entry = b"\x0a\x01a\x12" + bytes([len(numbers) + 2]) + b"\x12" + bytes([len(numbers)]) + numbers
    features = b"\x0a" + bytes([len(entry)]) + entry
    found = Example(b"\x0a" + bytes([len(features)]) + features)
    np.testing.assert_array_equal(found["a"], np.float32([1.5, -2]))


EXAMPLE = recordings.example({"a": [b"bytes", b""], "b": [1.0, 2.0], "c": [1, 300, -1]})


@given(
    turned=st.lists(st.integers(0, 8 * len(EXAMPLE) - 1), max_size=4),
    end=st.integers(0, len(EXAMPLE)),
    noise=st.binary(max_size=30),
)
@settings(max_examples=300)
def test_a_damaged_example_is_refused_or_read_but_nothing_else_happens(
    turned: list[int], end: int, noise: bytes
) -> None:
    content = bytearray(EXAMPLE)
    for bit in turned:
        content[bit // 8] ^= 1 << bit % 8
    for data in (bytes(content[:end]), noise, bytes(content) + noise):
        # Any other exception fails.
        with contextlib.suppress(ValueError):
            dict(Example(data))


# ---- the area filter ---------------------------------------------------------------------------


def slow_area(line: NDArray[Any], new: int) -> list[Any]:
    """A line of numbers made shorter, by hand."""
    old, made = len(line), []
    for i in range(new):
        begin, end = Fraction(i * old, new), Fraction((i + 1) * old, new)
        total: Any = 0
        for j in range(old):
            shared = min(end, Fraction(j + 1)) - max(begin, Fraction(j))
            total = total + max(shared, Fraction(0)) * line[j]
        made.append(total / (end - begin))
    return made


@given(
    old=st.tuples(st.integers(1, 9), st.integers(1, 9)),
    new=st.tuples(st.integers(1, 9), st.integers(1, 9)),
    seed=st.integers(0, 99),
)
@settings(max_examples=40)
def test_a_new_pixel_is_the_mean_of_what_it_covers(
    old: tuple[int, int], new: tuple[int, int], seed: int
) -> None:
    image = np.random.default_rng(seed).integers(0, 256, (*old, 3))
    exact = image.astype(object)
    tall = np.array(slow_area(exact, new[0]), object)
    wide = np.stack([np.array(slow_area(row, new[1]), object) for row in tall])
    expected = np.vectorize(lambda x: int(Fraction(x) + Fraction(1, 2)))(wide)
    found = area_resized(image[None].astype(np.uint8), new)
    np.testing.assert_array_equal(found[0], expected)


def test_large_pictures_are_summed_exactly_too() -> None:
    white = np.full((1, 480, 640, 3), 255, np.uint8)
    assert area_resized(white, (48, 64)).min() == 255
    assert size_of("48x64") == (48, 64)
    for text in ("48", "0x64", "48x64x3", "-1x2", "a x b"):
        with pytest.raises(ValueError, match="size: must be height x width"):
            size_of(text)


# ---- BAIR --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data set as it is published, of three episodes for training and one for tests."""
    root = tmp_path_factory.mktemp("bair") / "softmotion30_44k"
    for split, numbers in {"train": (0, 1, 2), "test": (3,)}.items():
        records = [recordings.bair_record(recordings.bair_episode(i)) for i in numbers]
        name = f"traj_0_to_{len(numbers) - 1}.tfrecords"
        recordings.write(root / split / name, recordings.tfrecords(records))
    return root


def test_bair_is_imported_as_it_was_recorded(bair: Path, tmp_path: Path) -> None:
    out = tmp_path / "bair.h5"
    assert main(["data", "import", "bair", str(bair), "--out", str(out), "--part", "2"]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bair-test.h5", "bair.h5"]
    for path, first, count in ((out, 0, 3), (tmp_path / "bair-test.h5", 3, 1)):
        for camera in ("main", "aux1"):
            with open_episodes(path, "bair", camera=camera) as file:
                assert (len(file), file.metadata.steps, file.metadata.seed) == (count, 29, None)
                assert file.metadata.cameras == ("main", "aux1")
                found = file.read(0, count)
            for i in range(count):
                episode = recordings.bair_episode(first + i)
                np.testing.assert_array_equal(found.frames[i], episode[camera])
                # The last action leads to no frame.
                np.testing.assert_array_equal(found.actions[i], episode["action"][:-1])
                np.testing.assert_array_equal(found.true_states[i], episode["endeffector_pos"])
    with open_episodes(out) as file:
        actions = file.read(0, 3).actions.reshape(-1, 4)
        assert file.metadata.action_low == tuple(actions.min(0).tolist())
        assert file.metadata.action_high == tuple(actions.max(0).tolist())


def test_the_makers_splits_are_kept(bair: Path, tmp_path: Path) -> None:
    train, test = BairImport(path=bair, out=tmp_path / "b.h5", cameras=("main",)).run()
    with open_episodes(train) as file, open_episodes(test) as held:
        assert list(episodes_of("train", file.metadata)) == [0, 1]
        assert list(episodes_of("validation", file.metadata)) == [2]
        assert list(episodes_of("test", held.metadata)) == [0]
        with pytest.raises(ValueError, match="'test' is asked for, but these episodes are for tra"):
            episodes_of("test", file.metadata)
        with pytest.raises(ValueError, match="these episodes are for test"):
            episodes_of("validation", held.metadata)
    only = BairImport(path=bair / "test", out=tmp_path / "c.h5", cameras=("aux1",), split="test")
    assert only.run() == [tmp_path / "c-test.h5"]


def test_frames_of_48_x_64_are_those_of_the_area_filter(bair: Path, tmp_path: Path) -> None:
    BairImport(path=bair, out=tmp_path / "b.h5", size="48x64", split="test").run()
    with open_episodes(tmp_path / "b-test.h5") as file:
        frame = file.read(0, 1).frames[0, 7]
        assert file.metadata.parameters["size"] == [48, 64]
        assert file.metadata.parameters["filter"] == "area"
    # Three new rows lie on four old ones.
    old = recordings.bair_episode(3)["main"][7].reshape(16, 4, 64, 3).astype(int)
    a, b, c, d = old.swapaxes(0, 1)
    rows = np.stack([3 * a + b, 2 * b + 2 * c, c + 3 * d], axis=1).reshape(48, 64, 3)
    np.testing.assert_array_equal(frame, (rows + 2) // 4)


def test_a_bad_record_is_named_and_nothing_half_imported_stays(bair: Path, tmp_path: Path) -> None:
    whole = bytearray((bair / "train" / "traj_0_to_2.tfrecords").read_bytes())
    whole[-1000] ^= 4
    records = [recordings.bair_record(recordings.bair_episode(0)), recordings.example({"a": [1.0]})]
    episode = recordings.bair_episode(0) | {"action": np.full((30, 4), np.nan, np.float32)}
    for content, said in (
        (bytes(whole), "record 2 is damaged"),
        (bytes(whole[:-100]), "record 2 is truncated"),
        (recordings.tfrecords(records), r"record 1: has no feature '0/image_main/encoded', only a"),
        (recordings.tfrecords([recordings.bair_record(episode)]), "record 0: .*not finite"),
        (recordings.tfrecords([b"\x0a\xff"]), "record 0: is no tf.train.Example"),
    ):
        file = recordings.write(tmp_path / "in" / "some.tfrecords", content)
        with pytest.raises(ValueError, match=f"some.tfrecords: {said}"):
            BairImport(path=file, out=tmp_path / "out" / "b.h5", part=1).run()
        assert not list((tmp_path / "out").glob("**/*.h5*"))
    for size, kept in ((64 * 64 * 3 - 1, 0), (64 * 64 * 3, 1)):
        features = {"0/image_main/encoded": [bytes(size)] * 2 if kept else [bytes(size)]}
        content = recordings.tfrecords([recordings.example(features)])
        file = recordings.write(tmp_path / "in" / "some.tfrecords", content)
        with pytest.raises(ValueError, match="is not one image of 12288 bytes"):
            BairSource([file], ("main",)).read(0)


def test_a_file_cut_off_between_records_is_noticed_by_its_name(bair: Path, tmp_path: Path) -> None:
    content = (bair / "test" / "traj_0_to_0.tfrecords").read_bytes()
    file = recordings.write(tmp_path / "traj_0_to_2.tfrecords", content)
    with pytest.raises(ValueError, match="has 1 of 3 records, is truncated"):
        BairImport(path=file, out=tmp_path / "b.h5").run()


def test_a_stopped_import_goes_on_and_ends_in_the_same_file(
    bair: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = BairImport(path=bair / "train", out=tmp_path / "b.h5", cameras=("main",), part=1)
    read, calls = BairSource.read, []

    def interrupted(source: BairSource, number: int) -> Any:
        calls.append(number)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return read(source, number)

    monkeypatch.setattr(BairSource, "read", interrupted)
    with pytest.raises(KeyboardInterrupt):
        config.run()
    assert not config.out.exists()
    config.run()
    assert calls == [0, 1, 2, 2]
    assert not config.out.with_name("b.h5.parts").exists()
    other = BairImport(path=bair / "train", out=tmp_path / "c.h5", cameras=("main",), part=3)
    other.run()
    assert config.out.read_bytes() == other.out.read_bytes()
    # Whole already: nothing is read again. Something else is not written over.
    config.run()
    assert len(calls) == 7
    with pytest.raises(FileExistsError, match="holds something else"):
        BairImport(path=bair / "train", out=config.out, cameras=("aux1",)).run()


def test_frames_may_be_compressed(bair: Path, tmp_path: Path) -> None:
    for name, compress in (("a", False), ("b", True)):
        out = tmp_path / f"{name}.h5"
        BairImport(path=bair / "train", out=out, cameras=("main",), compress=compress, part=2).run()
    with open_episodes(tmp_path / "a.h5") as a, open_episodes(tmp_path / "b.h5") as b:
        np.testing.assert_array_equal(a.read(0, 3).frames, b.read(0, 3).frames)


# ---- RLDS --------------------------------------------------------------------------------------

BRIDGE = {"image": ("steps/observation/image_0",), "action": ("steps/action",)}


@real
def test_the_real_bridge_episodes_are_imported(tmp_path: Path) -> None:
    sample = SHARED / "bridge_sample.tfrecord"
    words = ["data", "import", "rlds", str(sample), "--out", str(tmp_path / "b.h5"), "--hold-out=5"]
    words += ["--image", *BRIDGE["image"], "--action", *BRIDGE["action"], "--name", "bridge"]
    assert main([*words, "--state", "steps/observation/state"]) == 0
    # What the library of protocol buffers reads in it.
    truth = []
    for record in read_all(sample):
        features = recordings.EXAMPLE.FromString(record).features.feature
        images = features["steps/observation/image_0"].bytes_list.value
        frames = [np.array(Image.open(io.BytesIO(image)).convert("RGB")) for image in images]
        actions = np.float32(features["steps/action"].float_list.value).reshape(10, 7)
        truth.append((np.stack(frames), actions[:-1]))
    assert len(truth) == 25
    for path, part in (("b.h5", truth[:20]), ("b-test.h5", truth[20:])):
        with open_episodes(tmp_path / path, "bridge") as file:
            assert (len(file), file.frame_shape) == (len(part), (64, 64, 3))
            found = file.read(0, len(part))
        np.testing.assert_array_equal(found.frames, [frames for frames, _ in part])
        np.testing.assert_array_equal(found.actions, [actions for _, actions in part])
        assert found.true_states.shape == (len(part), 10, 7)


def jpeg(shade: int, size: tuple[int, int] = (6, 8)) -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", size, (shade, shade, shade)).save(buffer, "PNG")
    return buffer.getvalue()


def rlds(path: Path, *lengths: int, **more: Any) -> Path:
    records = []
    for i, length in enumerate(lengths):
        images = [jpeg(10 * i + t) for t in range(length)]
        acted = [float(10 * i + t) for t in range(length) for _ in range(2)]
        records.append(recordings.example({"image": images, "action": acted, **more}))
    return recordings.write(path, recordings.tfrecords(records))


def test_episodes_may_be_of_different_lengths_and_splits_are_told_by_names(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    rlds(folder / "set-train.tfrecord-00000-of-00002", 3, 5)
    rlds(folder / "set-train.tfrecord-00001-of-00002", 2)
    rlds(folder / "set-val.tfrecord-00000-of-00001", 4)
    out = tmp_path / "r.h5"
    RldsImport(path=folder, out=out, image=("image",), action=("action", "action")).run()
    with open_episodes(out) as file, open_episodes(tmp_path / "r-test.h5") as held:
        assert (file.lengths.tolist(), held.lengths.tolist()) == ([2, 4, 1], [3])
        assert (file.action_dim, file.metadata.environment) == (4, "data")
        episode = file.read(1, 1)
        assert episode.frames[0, :, 0, 0, 0].tolist() == [10, 11, 12, 13, 14]
        assert episode.actions[0, :, 3].tolist() == [10, 11, 12, 13]


def test_what_is_no_episode_is_refused_by_name(tmp_path: Path) -> None:
    def run(**more: Any) -> None:
        file = rlds(tmp_path / "a.tfrecord", 3, 3, **more)
        RldsImport(path=file, out=tmp_path / "r.h5", image=("image",), action=("action",)).run()

    png = jpeg(1)
    for more, said in (
        ({"image": [png, png[:40], png]}, r"record 0: an image of 40 bytes cannot be decoded"),
        ({"image": [png, jpeg(1, (7, 8)), png]}, "record 0: all input arrays must have the same"),
        ({"image": [png]}, "record 0: has 1 frames, an episode needs 2"),
        ({"image": [1.0]}, "record 0: feature 'image' holds floats, expected bytes"),
        ({"action": [1.0, 2.0]}, "record 0: feature 'action' has 2 numbers for 3 steps"),
        ({"action": [1, 2, 3]}, "record 0: feature 'action' holds integers, expected floats"),
        ({"action": [float("nan")] * 3}, "record 0: actions are not finite"),
    ):
        with pytest.raises(ValueError, match=rf"a\.tfrecord: {said}"):
            run(**more)
    assert [path.name for path in tmp_path.iterdir()] == ["a.tfrecord"]


@given(turned=st.integers(0, 8 * len(jpeg(1)) - 1), end=st.integers(0, len(jpeg(1))))
@one_folder
def test_a_damaged_image_is_refused_or_read(turned: int, end: int, tmp_path: Path) -> None:
    from hvf.data.importing.rlds import decode_image

    content = bytearray(jpeg(1))
    content[turned // 8] ^= 1 << turned % 8
    for data in (bytes(content), jpeg(1)[:end]):
        with contextlib.suppress(ValueError):
            assert decode_image(data).shape[2] == 3


def test_sizes_that_differ_between_episodes_need_a_size(tmp_path: Path) -> None:
    records = [
        recordings.example({"image": [jpeg(5, size)] * 3, "action": [1.0] * 3})
        for size in ((8, 6), (12, 9))
    ]
    file = recordings.write(tmp_path / "a.tfrecord", recordings.tfrecords(records))
    words = {"path": file, "out": tmp_path / "r.h5", "image": ("image",)}
    with pytest.raises(ValueError, match=r"record 1: frames of image are \[9, 12, 3\].*--size"):
        RldsImport(**words).run()
    RldsImport(**words, size="6x8").run()
    with open_episodes(tmp_path / "r.h5") as file:
        assert (file.frame_shape, file.action_dim) == ((6, 8, 3), 0)


# ---- folders and arrays ------------------------------------------------------------------------


def images(folder: Path, *shades: int) -> None:
    folder.mkdir(parents=True)
    for i, shade in enumerate(shades):
        Image.new("RGB", (8, 6), (shade, 0, 0)).save(folder / f"{i}.png")


def test_a_folder_of_images_with_tables_is_imported(tmp_path: Path) -> None:
    images(tmp_path / "in" / "b10", *range(12))
    images(tmp_path / "in" / "b9", 50, 51, 52)
    (tmp_path / "in" / "b9.csv").write_text("left,right\n1,2\n3,4\n")
    rows = "".join(f"{t},{-t}\r\n" for t in range(12))
    (tmp_path / "in" / "b10" / "actions.csv").write_text("left,right\r\n" + rows)
    out = tmp_path / "f.h5"
    assert main(["data", "import", "folder", str(tmp_path / "in"), "--out", str(out)]) == 0
    with open_episodes(out, "in") as file:
        assert file.metadata.action_names == ("left", "right")
        # Numbers in names count as numbers, here and among images.
        assert file.lengths.tolist() == [2, 11]
        found = file.read(0, 2)
    assert found.frames[1, :, 0, 0, 0].tolist() == list(range(12))
    assert found.frames[0, :3, 0, 0, 0].tolist() == [50, 51, 52]
    assert found.actions[0, :2].tolist() == [[1, 2], [3, 4]]
    assert found.actions[1, :, 1].tolist() == [-t for t in range(11)]


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ("1,2\n3\n", "row 2 has 1 columns, expected 2"),
        ("1,2\n3,x\n", "row 2 is not all numbers"),
        ("1,2\n3,nan\n", "row 2 is not all numbers"),
        ("a,b\n", "has no rows"),
        ("", "has no rows"),
        ("1,2\n", "has 3 frames and 1 actions"),
        ("1,2\n" * 4, "has 3 frames and 4 actions"),
    ],
)
def test_a_table_that_does_not_fit_is_refused(table: str, said: str, tmp_path: Path) -> None:
    images(tmp_path / "in" / "a", 1, 2, 3)
    (tmp_path / "in" / "a.csv").write_text(table)
    with pytest.raises(ValueError, match=said):
        FolderImport(path=tmp_path / "in", out=tmp_path / "f.h5").run()
    assert [path.name for path in tmp_path.iterdir()] == ["in"]


def test_a_damaged_picture_and_mixed_folders_are_refused(tmp_path: Path) -> None:
    images(tmp_path / "in" / "a", 1, 2, 3)
    images(tmp_path / "in" / "b", 1, 2, 3)
    (tmp_path / "in" / "a.csv").write_text("1\n2\n")
    config = FolderImport(path=tmp_path / "in", out=tmp_path / "f.h5")
    with pytest.raises(ValueError, match="b: has no CSV of actions, others have"):
        config.run()
    (tmp_path / "in" / "b.csv").write_text("1,2\n2,3\n")
    with pytest.raises(ValueError, match="have different columns"):
        config.run()
    (tmp_path / "in" / "b.csv").write_text("1\n2\n")
    (tmp_path / "in" / "b" / "1.png").write_bytes(b"not at all")
    with pytest.raises(ValueError, match=r"b: frame 1: .*1\.png is no image"):
        config.run()
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="neither videos nor folders of images"):
        FolderImport(path=tmp_path / "empty", out=tmp_path / "f.h5").run()


def test_videos_are_imported(tmp_path: Path) -> None:
    iio = pytest.importorskip("imageio.v3")
    pytest.importorskip("av")
    (tmp_path / "in").mkdir()
    frames = np.zeros((7, 32, 48, 3), np.uint8)
    for t in range(7):
        frames[t, :, :24] = 30 * t
        frames[t, :, 24:] = 255 - 30 * t
    iio.imwrite(tmp_path / "in" / "a.mp4", frames, plugin="pyav", codec="libx264", fps=5)
    iio.imwrite(tmp_path / "in" / "b.gif", frames, duration=200, loop=0)
    FolderImport(path=tmp_path / "in", out=tmp_path / "v.h5", size="16x24").run()
    with open_episodes(tmp_path / "v.h5") as file:
        assert (file.lengths.tolist(), file.frame_shape) == ([6, 6], (16, 24, 3))
        found = file.read(0, 2).frames.astype(int)
    # What MP4 loses is little.
    assert np.abs(found - frames[None, :, ::2, ::2]).max() < 12
    content = (tmp_path / "in" / "a.mp4").read_bytes()
    (tmp_path / "in" / "a.mp4").write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=r"a\.mp4: is no video, or damaged"):
        FolderImport(path=tmp_path / "in", out=tmp_path / "w.h5").run()


def test_arrays_without_actions_teach_generators_and_not_dynamics(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    frames = {f"e{i}": rng.integers(0, 256, (4, 8, 8, 3)).astype(np.uint8) for i in range(5)}
    np.savez(tmp_path / "a.npz", **frames)
    out = tmp_path / "n.h5"
    words = ["data", "import", "npz", str(tmp_path / "a.npz"), "--out", str(out), "--hold-out", "1"]
    assert main(words) == 0
    with open_episodes(out) as file, open_episodes(tmp_path / "n-test.h5") as held:
        assert (len(file), len(held), file.action_dim) == (4, 1, 0)
        assert file.read(1, 2).actions.shape == (2, 3, 0)
        np.testing.assert_array_equal(held.read(0, 1).frames[0], frames["e4"])
        assert file.metadata.action_low is None
    pool = EpisodePool(out)
    assert PairSampler(pool, 2).batch(0)["image"].shape == (2, 8, 8, 3)
    with pytest.raises(ValueError, match="data: has no actions"):
        WindowSampler(pool, 2, 1)
    pool.close()


def test_arrays_with_actions_are_imported_and_odd_ones_refused(tmp_path: Path) -> None:
    frames = np.zeros((4, 8, 8, 3), np.uint8)

    def run(**arrays: Any) -> Path:
        np.savez(tmp_path / "a.npz", **arrays)
        return NpzImport(path=tmp_path / "a.npz", out=tmp_path / "n.h5").run()[0]

    with open_episodes(run(a=frames, **{"a.actions": np.eye(3)})) as file:
        np.testing.assert_array_equal(file.read(0, 1).actions[0], np.eye(3, dtype=np.float32))
    (tmp_path / "n.h5").unlink()
    for arrays, said in (
        ({"a": frames[0]}, r"a: expected uint8 \[T, H, W, 3\]"),
        ({"a": frames.astype(float)}, "expected uint8"),
        ({"a": frames, "b": frames, "a.actions": np.eye(3)}, "'b' has only frames"),
        ({"a": frames, "a.actions": np.eye(2)}, "4 frames and 2 actions"),
        ({"a": frames[:1]}, "has 1 frames"),
        ({}, "is empty"),
    ):
        with pytest.raises(ValueError, match=said):
            run(**arrays)
    np.savez(tmp_path / "a.npz", a=np.array([{}], object))
    with pytest.raises(ValueError, match="a is damaged"):
        NpzImport(path=tmp_path / "a.npz", out=tmp_path / "n.h5").run()
    (tmp_path / "a.npz").write_bytes(b"nothing of the kind")
    with pytest.raises(ValueError, match="is no file of NumPy arrays"):
        NpzImport(path=tmp_path / "a.npz", out=tmp_path / "n.h5").run()


# ---- LeRobot -----------------------------------------------------------------------------------


def lerobot(root: Path, version: str, lengths: list[int], fps: int = 10) -> list[NDArray[Any]]:
    """A data set as LeRobot lays it out; the frames of its episodes."""
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    iio = pytest.importorskip("imageio.v3")
    pytest.importorskip("av")
    v3 = version == "v3.0"
    key = "observation.images.top"
    videos, tables, episodes, start = [], [], [], 0
    for i, length in enumerate(lengths):
        frames = np.full((length, 32, 32, 3), 20, np.uint8)
        for t in range(length):
            frames[t, :, : 4 * (t + 1)] = 60 + 40 * i
        videos.append(frames)
        steps = np.arange(length)
        tables.append(
            pa.table(
                {
                    "action": [[float(i), float(t)] for t in steps],
                    "observation.state": [[float(t)] for t in steps],
                    "episode_index": [i] * length,
                    "timestamp": (steps / fps).astype(np.float32),
                }
            )
        )
        episodes.append({"episode_index": i, "length": length, "tasks": ["push"]})
        if v3:
            place = {"chunk_index": 0, "file_index": 0}
            episodes[-1] |= {f"data/{name}": n for name, n in place.items()}
            episodes[-1] |= {f"videos/{key}/{name}": n for name, n in place.items()}
            episodes[-1][f"videos/{key}/from_timestamp"] = start / fps
            start += length
    numbered = "chunk-{chunk_index:03d}/file-{file_index:03d}"
    single = "chunk-{episode_chunk:03d}/"
    info = {
        "codebase_version": version,
        "fps": fps,
        "chunks_size": 1000,
        "splits": {"train": "0:2", "test": "2:3"},
        "data_path": f"data/{numbered}.parquet"
        if v3
        else "data/" + single + "episode_{episode_index:06d}.parquet",
        "video_path": "videos/{video_key}/" + numbered + ".mp4"
        if v3
        else "videos/" + single + "{video_key}/episode_{episode_index:06d}.mp4",
        "features": {
            key: {"dtype": "video", "shape": [32, 32, 3], "names": ["height", "width", "channels"]},
            "action": {"dtype": "float32", "shape": [2], "names": {"motors": ["x", "y"]}},
            "observation.state": {"dtype": "float32", "shape": [1], "names": None},
        },
    }
    recordings.write(root / "meta" / "info.json", json.dumps(info).encode())
    if v3:
        tables, videos_out = [pa.concat_tables(tables)], [np.concatenate(videos)]
        path = root / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
        path.parent.mkdir(parents=True)
        pq.write_table(pa.Table.from_pylist(episodes), path)
    else:
        videos_out = videos
        lines = "".join(json.dumps(episode) + "\n" for episode in episodes)
        recordings.write(root / "meta" / "episodes.jsonl", lines.encode())
    for i, (table, frames) in enumerate(zip(tables, videos_out, strict=True)):
        place = {"chunk_index": 0, "file_index": 0, "episode_chunk": 0, "episode_index": i}
        for name in ("data_path", "video_path"):
            file = root / str(info[name]).format(video_key=key, **place)
            file.parent.mkdir(parents=True, exist_ok=True)
            if name == "data_path":
                pq.write_table(table, file)
            else:
                iio.imwrite(file, frames, plugin="pyav", codec="libx264", fps=fps)
    return videos


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_data_sets_of_lerobot_are_imported(version: str, tmp_path: Path) -> None:
    videos = lerobot(tmp_path / "push", version, [5, 7, 4])
    out = tmp_path / "l.h5"
    words = ["data", "import", "lerobot", str(tmp_path / "push"), "--out", str(out)]
    assert main([*words, "--part", "1"]) == 0
    for path, first, lengths in ((out, 0, [4, 6]), (tmp_path / "l-test.h5", 2, [3])):
        with open_episodes(path, "push") as file:
            assert file.lengths.tolist() == lengths
            assert (file.metadata.cameras, file.metadata.action_names) == (("top",), ("x", "y"))
            for i, length in enumerate(lengths):
                found, true = file.read(i, 1), videos[first + i].astype(int)
                assert np.abs(found.frames[0, : length + 1] - true).mean() < 3
                expected = [[first + i, t] for t in range(length)]
                assert found.actions[0, :length].tolist() == expected
                assert found.true_states[0, : length + 1, 0].tolist() == list(range(length + 1))


def test_a_damaged_data_set_of_lerobot_is_named(tmp_path: Path, capsys: Any) -> None:
    root = tmp_path / "push"
    lerobot(root, "v2.1", [5, 5, 5])

    def refused(said: str) -> None:
        words = ["data", "import", "lerobot", str(root), "--out", str(tmp_path / "l.h5")]
        assert main([*words, "--split", "train"]) == 2
        assert re.search(said, " ".join(capsys.readouterr().err.split()))
        assert not list(tmp_path.glob("l*"))

    table = root / "data" / "chunk-000" / "episode_000001.parquet"
    content = table.read_bytes()
    table.write_bytes(content[:-20])
    refused("push: episode 1: is damaged")
    table.unlink()
    refused(r"push: episode 1: .*episode_000001\.parquet is not there")
    table.write_bytes(content)
    video = next(root.glob("videos/*/*/episode_000000.mp4"))
    video.write_bytes(video.read_bytes()[:200])
    refused("push: episode 0: is damaged")
    info = root / "meta" / "info.json"
    info.write_text(info.read_text().replace("v2.1", "v1.6"))
    refused("is of version v1.6")
    info.write_text("{}")
    refused("is not what LeRobot writes")


# ---- the command -------------------------------------------------------------------------------


def test_the_command_says_what_there_is(tmp_path: Path, capsys: Any) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["data", "--help"])
    assert stopped.value.code == 0
    said = capsys.readouterr().out
    assert all(name in said for name in ("bair", "rlds", "lerobot", "folder", "npz"))
    assert main(["data", "export"]) == 2
    assert main(["data", "import", "vcr"]) == 2
    assert "source: must be one of bair, rlds" in capsys.readouterr().err
    words = ["--out", str(tmp_path / "x.h5")]
    assert main(["data", "import", "bair", str(tmp_path / "nowhere"), *words]) == 2
    assert "there is nothing at" in capsys.readouterr().err
    for odd in ("--size=48", "--hold-out=-1", "--part=0", "--cameras=side"):
        assert main(["data", "import", "bair", str(tmp_path), *words, odd]) == 2
