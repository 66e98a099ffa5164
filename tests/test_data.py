"""Episodes on disk: collected, resumed, refused when damaged, and sampled for training."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import h5py
import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

import hvf_core
import processes
from hvf.data.collect import CollectConfig, collect, program_versions
from hvf.data.episodes import Episodes, Metadata
from hvf.data.formats.hdf5 import EpisodeFile, write_episodes
from hvf.data.loader import EpisodePool, PairSampler, WindowSampler
from hvf.domains.maze_collection import MazeCollection

STEPS = 6


def numbered(seed: int, first: int, count: int, steps: int) -> Episodes:
    """Episodes whose first pixel says which episode and which time it is."""
    frames = np.zeros((count, steps + 1, 8, 8, 3), np.uint8)
    frames[..., 0, 0, 0] = np.arange(first, first + count)[:, None]
    frames[..., 0, 0, 1] = np.arange(steps + 1)
    actions = frames[:, :-1, 0, 0, :2].astype(np.float32)
    states = np.random.default_rng([seed, first]).random((count, steps + 1, 3))
    return Episodes(frames, actions, states)


def collected(path: Path, episodes: int = 40, **options: int) -> Path:
    config = CollectConfig(path, episodes, STEPS, image_size=8, **options)
    return collect(config, "numbers", {}, numbered)


@pytest.fixture(scope="module")
def numbers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return collected(tmp_path_factory.mktemp("data") / "numbers.h5")


# ---- collecting --------------------------------------------------------------------------------


def test_a_collected_file_holds_what_the_maze_gives(tmp_path: Path) -> None:
    path = MazeCollection(tmp_path / "maze.h5", 7, 5, seed=3, part=2).run()
    frames, actions, states = hvf_core.maze_collect(3, 0, 7, 5, 64)
    with h5py.File(path) as file:  # as any HDF5 program reads it
        np.testing.assert_array_equal(file["frames"][...], frames)
        np.testing.assert_array_equal(file["actions"][...], actions)
        np.testing.assert_array_equal(file["states"][...], states)
        assert file["frames"].chunks == (1, 6, 64, 64, 3)
    with EpisodeFile(path, "maze") as episodes:
        assert (episodes.metadata.seed, episodes.metadata.steps, len(episodes)) == (3, 5, 7)
        assert "hvf_core" in episodes.metadata.versions
        assert (episodes.metadata.cameras, episodes.metadata.action_names) == (
            ("above",),
            ("x", "y"),
        )
        assert (episodes.metadata.action_low, episodes.metadata.action_high) == (
            (-3.0, -3.0),
            (3.0, 3.0),
        )


def test_the_parts_it_was_collected_in_do_not_show(tmp_path: Path) -> None:
    one = MazeCollection(tmp_path / "one.h5", 9, 4, part=9).run()
    many = MazeCollection(tmp_path / "many.h5", 9, 4, part=2).run()
    assert one.read_bytes() == many.read_bytes()


def test_a_killed_collection_goes_on_to_the_same_file(tmp_path: Path) -> None:
    whole = MazeCollection(tmp_path / "whole.h5", 150, 10, part=5).run()
    out = tmp_path / "killed.h5"
    words = ("collect", "maze", "--out", str(out), "--episodes", "150", "--steps", "10")
    parts = tmp_path / "killed.h5.parts"
    with processes.started([*processes.HVF, *words, "--part", "5"]) as child:
        child.wait_until(lambda: len(list(parts.glob("0*.h5"))) >= 5)
        child.tell(signal.SIGKILL)
        child.wait()
    assert not out.exists()
    done = sorted(parts.glob("0*.h5"))
    kept = {path.name: path.stat().st_mtime_ns for path in done[:5]}
    (parts / f".{done[-1].name}.tmp").write_bytes(b"half a part")

    calls = []
    maze_collect = hvf_core.maze_collect
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hvf_core, "maze_collect", lambda *a: calls.append(a[1]) or maze_collect(*a))
        MazeCollection(out, 150, 10, part=5).run()
    assert len(kept) == 5
    assert len(calls) <= 30 - 5
    assert out.read_bytes() == whole.read_bytes()
    assert not parts.exists()


def test_ctrl_c_keeps_the_parts_done(tmp_path: Path) -> None:
    def stop_at_20(seed: int, first: int, count: int, steps: int) -> Episodes:
        if first == 20:
            os.kill(os.getpid(), signal.SIGINT)
        return numbered(seed, first, count, steps)

    config = CollectConfig(tmp_path / "numbers.h5", 40, STEPS, image_size=8, part=10)
    with pytest.raises(KeyboardInterrupt):
        collect(config, "numbers", {}, stop_at_20)
    assert not config.out.exists()
    assert len(list((tmp_path / "numbers.h5.parts").iterdir())) == 2
    collect(config, "numbers", {}, numbered)
    assert config.out.read_bytes() == collected(tmp_path / "other.h5", part=10).read_bytes()


def test_a_full_disk_leaves_what_was_there(tmp_path: Path) -> None:
    out = MazeCollection(tmp_path / "maze.h5", 2, 4).run()
    before = out.read_bytes()
    limited = (
        "import resource, signal, sys; from hvf.cli import main;"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN);"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000));"
        "sys.exit(main())"
    )
    words = ["collect", "maze", "--out", str(out), "--episodes", "60", "--steps", "100"]
    run = processes.run([*processes.python(limited), *words, "--overwrite"])
    assert run.returncode == 1
    assert "cannot write" in run.stderr
    assert "maze.h5" in run.stderr
    assert "Traceback" not in run.stderr
    assert out.read_bytes() == before
    assert not list(tmp_path.rglob("*.tmp"))


def test_a_complete_file_is_left_alone_and_a_different_one_is_not_replaced(tmp_path: Path) -> None:
    path = collected(tmp_path / "numbers.h5")
    before = path.stat().st_mtime_ns
    collected(path)
    assert path.stat().st_mtime_ns == before
    with pytest.raises(FileExistsError, match=r"numbers\.h5"):
        collected(path, seed=1)
    collected(path, seed=1, overwrite=True)
    with EpisodeFile(path) as file:
        assert file.metadata.seed == 1


def test_parts_of_another_collection_are_refused(tmp_path: Path) -> None:
    def fail_late(seed: int, first: int, count: int, steps: int) -> Episodes:
        if first:
            raise RuntimeError("stopped")
        return numbered(seed, first, count, steps)

    config = CollectConfig(tmp_path / "numbers.h5", 40, STEPS, image_size=8, part=10)
    with pytest.raises(RuntimeError, match="stopped"):
        collect(config, "numbers", {}, fail_late)
    with pytest.raises(ValueError, match="another collection"):
        collected(tmp_path / "numbers.h5", seed=5, part=10)


def stopped(config: CollectConfig, parts: int) -> list[Path]:
    """The parts of a collection that ended after some of them."""

    def rollouts(seed: int, first: int, count: int, steps: int) -> Episodes:
        if first >= parts * config.part:
            raise RuntimeError("stopped")
        return numbered(seed, first, count, steps)

    with pytest.raises(RuntimeError, match="stopped"):
        collect(config, "numbers", {}, rollouts)
    return sorted(config.out.with_name(f"{config.out.name}.parts").glob("0*.h5"))


def test_parts_of_another_version_of_the_program_are_refused(tmp_path: Path) -> None:
    config = CollectConfig(tmp_path / "numbers.h5", 40, STEPS, image_size=8, part=10)
    part = stopped(config, 2)[1]
    with h5py.File(part, "r+") as file:
        file.attrs["versions"] = json.dumps({**program_versions(), "numpy": "1.0", "extra": "3"})
    with pytest.raises(ValueError) as caught:
        collect(config, "numbers", {}, numbered)
    message = str(caught.value)
    assert str(part) in message
    assert f"extra 3, now not there; numpy 1.0, now {np.__version__}" in message
    assert f"remove {part.parent}" in message
    part.unlink()
    collect(config, "numbers", {}, numbered)
    assert config.out.read_bytes() == collected(tmp_path / "other.h5", part=10).read_bytes()


def test_a_part_of_an_older_format_is_refused(tmp_path: Path) -> None:
    config = CollectConfig(tmp_path / "numbers.h5", 40, STEPS, image_size=8, part=10)
    part = stopped(config, 1)[0]
    with h5py.File(part, "r+") as file:
        file.attrs["format"] = "hvf-episodes-1"
    with pytest.raises(ValueError, match="format hvf-episodes-1, now hvf-episodes-2"):
        collect(config, "numbers", {}, numbered)


def test_a_part_that_went_away_is_missing_and_not_a_failed_write(tmp_path: Path) -> None:
    config = CollectConfig(tmp_path / "numbers.h5", 40, STEPS, image_size=8, part=10)
    first = stopped(config, 1)[0]

    def rollouts(seed: int, number: int, count: int, steps: int) -> Episodes:
        first.unlink(missing_ok=True)
        return numbered(seed, number, count, steps)

    with pytest.raises(FileNotFoundError) as caught:
        collect(config, "numbers", {}, rollouts)
    assert str(caught.value) == f"{first}: no such data file"
    assert not config.out.exists()
    assert collect(config, "numbers", {}, numbered) == config.out


def test_a_directory_is_no_place_for_a_file(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    with pytest.raises(ValueError, match=r"out: .*data is a directory; name a file in it"):
        collected(tmp_path / "data")
    with pytest.raises(ValueError, match=r"out: .*data is a directory"):
        collected(tmp_path / "data", overwrite=True)
    (tmp_path / "x.h5.parts").write_bytes(b"")
    with pytest.raises(ValueError, match=r"out: .*x\.h5\.parts, where parts go"):
        collected(tmp_path / "x.h5")


def test_a_domain_that_does_not_say_how_collects_nothing(tmp_path: Path) -> None:
    with pytest.raises(NotImplementedError, match="CollectConfig does not say"):
        CollectConfig(tmp_path / "x.h5").run()


@given(
    field=st.sampled_from(["episodes", "steps", "image_size", "part", "seed"]),
    value=st.integers(-(2**40), -1),
)
def test_collect_config_names_a_bad_number(field: str, value: int) -> None:
    with pytest.raises(ValueError, match=field):
        CollectConfig(Path("x.h5"), **{field: value})


# ---- files -------------------------------------------------------------------------------------


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"nothing\.h5"):
        EpisodeFile(tmp_path / "nothing.h5")


def test_a_file_of_another_environment_is_refused(numbers: Path) -> None:
    with pytest.raises(ValueError, match=r"numbers.*expected 'maze'"):
        EpisodeFile(numbers, "maze")


@given(data=st.data())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
def test_a_truncated_file_is_one_clear_error(
    data: st.DataObject, numbers: Path, tmp_path: Path
) -> None:
    content = numbers.read_bytes()
    path = tmp_path / "cut.h5"
    path.write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])
    with pytest.raises(ValueError, match=r"cut\.h5"):
        EpisodeFile(path)


@pytest.mark.parametrize("content", [b"", b"hello", b"\x89HDF\r\n\x1a\n" + bytes(100)])
def test_a_file_that_is_not_hdf5_is_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "foreign.h5"
    path.write_bytes(content)
    with pytest.raises(ValueError, match="not an HDF5 file, or truncated"):
        EpisodeFile(path)


def test_hdf5_of_another_program_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "foreign.h5"
    with h5py.File(path, "w") as file:
        file["sim/ims"] = np.zeros(3)
    with pytest.raises(ValueError, match="not a file of episodes"):
        EpisodeFile(path)


@pytest.mark.parametrize(
    ("attribute", "value"),
    [("episodes", 41), ("steps", 3), ("episodes", 0), ("parameters", "{"), ("seed", "x")],
)
def test_metadata_that_does_not_fit_is_damage(
    attribute: str, value: object, tmp_path: Path
) -> None:
    path = collected(tmp_path / "numbers.h5")
    with h5py.File(path, "r+") as file:
        file.attrs[attribute] = value
    with pytest.raises(ValueError, match="damaged"):
        EpisodeFile(path)


def test_a_damaged_episode_names_the_file(tmp_path: Path) -> None:
    path = collected(tmp_path / "numbers.h5")
    with h5py.File(path, "r+") as file:
        file["frames"].id.write_direct_chunk((3, 0, 0, 0, 0), b"this is not deflate")
    with EpisodeFile(path) as file:
        file.read(0, 3)
        with pytest.raises(ValueError, match=r"numbers\.h5"):
            file.read(2, 3)
        frames, actions = np.empty((STEPS + 1, 8, 8, 3), np.uint8), np.empty((STEPS, 2), np.float32)
        with pytest.raises(ValueError, match="episode 3 is damaged"):
            file.read_into(3, frames, actions)
        with pytest.raises(IndexError):
            file.read(39, 2)


@given(
    frames=hnp.arrays(np.uint8, hnp.array_shapes(min_dims=4, max_dims=5, max_side=3)),
    actions=hnp.arrays(np.float32, hnp.array_shapes(min_dims=2, max_dims=3, max_side=3)),
    states=hnp.arrays(np.float64, hnp.array_shapes(min_dims=2, max_dims=3, max_side=3)),
)
def test_episodes_are_consistent_or_refused(
    frames: np.ndarray, actions: np.ndarray, states: np.ndarray
) -> None:
    count, steps = actions.shape[:2]
    fits = (frames.ndim, actions.ndim, states.ndim) == (5, 3, 3)
    fits = fits and frames.shape[:2] == states.shape[:2] == (count, steps + 1)
    fits = fits and frames.shape[4] == 3
    if fits and np.isfinite(actions).all():
        assert len(Episodes(frames, actions, states)) == count
    else:
        with pytest.raises(ValueError, match=r"^(frames|actions|states) must"):
            Episodes(frames, actions, states)


def test_episodes_of_another_dtype_are_refused() -> None:
    good = numbered(0, 0, 2, 3)
    with pytest.raises(TypeError, match="frames must be uint8"):
        Episodes(good.frames.astype(np.float32), good.actions, good.states)
    with pytest.raises(TypeError, match="actions must be float32"):
        Episodes(good.frames, good.actions.astype(np.float64), good.states)


def test_metadata_and_episodes_must_agree(tmp_path: Path) -> None:
    metadata = Metadata("numbers", {}, 0, 3, 5, {})
    with pytest.raises(ValueError, match="5 episodes of 3 steps"):
        write_episodes(tmp_path / "x.h5", metadata, numbered(0, 0, 2, 3))


# ---- loading -----------------------------------------------------------------------------------


def held(pool: EpisodePool) -> list[int]:
    return [int(n) for n in pool.frames[:, 0, 0, 0, 0]]


def small_pool(path: Path, episodes: int, refresh: int = 1, seed: int = 0) -> EpisodePool:
    memory = (episodes + 0.5) * (STEPS + 1) * 8 * 8 * 3 / 1e9
    return EpisodePool(path, memory_gb=memory, refresh=refresh, seed=seed)


def test_training_and_validation_share_no_episode(numbers: Path) -> None:
    train, validation = EpisodePool(numbers), EpisodePool(numbers, "validation")
    train.move_to(0)
    validation.move_to(0)
    assert sorted(held(train)) == list(range(38))
    assert sorted(held(validation)) == [38, 39]


@given(steps=st.lists(st.integers(0, 200), min_size=1, max_size=6), refresh=st.integers(0, 3))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=25)
def test_what_a_pool_holds_depends_on_the_step_alone(
    steps: list[int], refresh: int, numbers: Path
) -> None:
    wandering, direct = small_pool(numbers, 7, refresh), small_pool(numbers, 7, refresh)
    for step in steps:
        wandering.move_to(step)
    direct.move_to(steps[-1])
    np.testing.assert_array_equal(wandering.frames, direct.frames)
    np.testing.assert_array_equal(wandering.actions, direct.actions)


def test_every_episode_passes_through_a_small_pool(numbers: Path) -> None:
    pool = small_pool(numbers, 5)
    seen = []
    for step in range(38 - 5 + 1):
        pool.move_to(step)
        assert len(set(held(pool))) == 5
        seen += held(pool)
    assert set(seen) == set(range(38))


def test_pairs_are_of_one_episode_at_uniform_times(numbers: Path) -> None:
    sampler = PairSampler(EpisodePool(numbers), 2000)
    batch = sampler.batch(3)
    scene, image = (batch[name][:, 0, 0].numpy() for name in ("scene", "image"))
    np.testing.assert_array_equal(scene[:, 0], image[:, 0])
    for times in (scene[:, 1], image[:, 1]):
        counts = np.bincount(times, minlength=STEPS + 1)
        assert len(counts) == STEPS + 1
        # 2000 draws over 7 times: 286 +- 16; five deviations.
        assert np.abs(counts - 2000 / 7).max() < 80
    assert np.abs(np.corrcoef(scene[:, 1], image[:, 1])[0, 1]) < 0.12


def test_windows_are_consecutive_and_carry_their_actions(numbers: Path) -> None:
    batch = WindowSampler(EpisodePool(numbers), 300, length=3).batch(0)
    frames, actions = batch["frames"][:, :, 0, 0].numpy(), batch["actions"].numpy()
    assert frames.shape == (300, 4, 3)
    np.testing.assert_array_equal(np.diff(frames[..., 1].astype(int), axis=1), 1)
    np.testing.assert_array_equal(actions, frames[:, :3, :2])
    assert set(frames[:, 0, 1]) == {0, 1, 2, 3}


def test_the_same_step_gives_the_same_batch_and_another_another(numbers: Path) -> None:
    first, second = (PairSampler(small_pool(numbers, 5), 16, seed=1) for _ in range(2))
    second.batch(2)
    for name in ("scene", "image"):
        assert first.batch(7)[name].equal(second.batch(7)[name])
    assert not first.batch(7)["scene"].equal(first.batch(8)["scene"])


def test_bad_arguments_of_the_loader_are_named(numbers: Path, tmp_path: Path) -> None:
    pool = EpisodePool(numbers)
    for call, name in (
        (lambda: EpisodePool(numbers, memory_gb=0), "memory_gb"),
        (lambda: EpisodePool(numbers, memory_gb=float("nan")), "memory_gb"),
        (lambda: EpisodePool(numbers, refresh=-1), "refresh"),
        (lambda: PairSampler(pool, 0), "batch_size"),
        (lambda: WindowSampler(pool, 0, 1), "batch_size"),
        (lambda: WindowSampler(pool, 1, STEPS + 1), "length"),
        (lambda: EpisodePool(collected(tmp_path / "one.h5", 1)), r"one\.h5.*2 episodes"),
        (lambda: EpisodePool(numbers, "test"), r"numbers\.h5: split: 'test'"),
        (lambda: EpisodePool(numbers, camera="top"), "no camera 'top'"),
    ):
        with pytest.raises(ValueError, match=name):
            call()
