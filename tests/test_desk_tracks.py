"""Where everything is in recorded episodes, in hindsight, and the stretches learned from."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import toy_desk as toy
from hvf.data.episodes import Episodes, Metadata
from hvf.data.formats.hdf5 import write_episodes
from hvf.models.layers.perception import LayerPerception
from hvf.training.tracks.layers import LayerSampler, LayerTracks, track

EPISODES, STEPS = toy.EPISODES, toy.STEPS
Floats = NDArray[np.float32]


@pytest.fixture(scope="module")
def perception() -> LayerPerception:
    return toy.seen()[0]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return toy.recorded(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def tracks(data: Path, perception: LayerPerception) -> LayerTracks:
    return LayerTracks(data, perception, EPISODES)


# ---- hindsight ---------------------------------------------------------------------------------


def slow_track(places: Floats, mass: Floats) -> list[tuple[int, Floats | None]]:
    """For each frame of one part: 2 and where it is, 1 if it is gone (and from where), or 0."""
    count = len(mass)
    seen = []
    for t in range(count):
        around = mass[max(0, t - 10) : t + 11]
        seen.append(mass[t] > 0.25 and mass[t] > np.float32(0.65) * around.max())
    found: list[tuple[int, Floats | None]] = []
    for t in range(count):
        before = [i for i in range(t + 1) if seen[i]]
        after = [i for i in range(t, count) if seen[i]]
        if seen[t]:
            found.append((2, places[t]))
        elif before and after and np.hypot(*(places[before[-1]] - places[after[0]])) < 1.5:
            found.append((2, (places[before[-1]] + places[after[0]]) / 2))
        elif not after and not before:
            found.append((1, None))
        elif not after and count - before[-1] > 10:
            found.append((1, places[before[-1]]))
        else:
            found.append((0, None))
    return found


@settings(max_examples=150)
@given(
    shape=st.tuples(st.integers(1, 2), st.integers(5, 30), st.integers(1, 2)),
    seed=st.integers(0, 2**32 - 1),
    hiding=st.floats(0.02, 0.5),
    moving=st.floats(0, 0.3),
)
def test_hindsight_is_that_of_a_slow_copy(
    shape: tuple[int, int, int], seed: int, hiding: float, moving: float
) -> None:
    rng = np.random.default_rng(seed)
    # Hidden and seen for a while each, in full, nearly so, half, hardly or not at all.
    switches = rng.random(shape) < hiding
    hidden = np.cumsum(switches, axis=1) % 2 == 1
    mass = np.where(hidden, rng.choice([0, 0.1, 0.3, 0.6], shape), rng.choice([0.9, 1.0], shape))
    mass = mass.astype(np.float32)
    jumps = rng.integers(-2, 3, (*shape, 2)) * (rng.random((*shape, 1)) < moving)
    places = 10 + np.cumsum(jumps, axis=1)
    presence = (mass > 0.12)[..., None]
    parts = np.concatenate([places, presence], axis=3).astype(np.float32)
    given_parts, given_mass = parts.copy(), mass.copy()
    filled, known = track(parts, mass)
    np.testing.assert_array_equal(parts, given_parts)
    np.testing.assert_array_equal(mass, given_mass)
    assert filled.dtype == np.float32
    assert known.dtype == np.uint8
    for e in range(shape[0]):
        for r in range(shape[2]):
            for t, (word, where) in enumerate(slow_track(parts[e, :, r, :2], mass[e, :, r])):
                assert known[e, t, r] == word
                assert filled[e, t, r, 2] == (word == 2 if word else presence[e, t, r, 0])
                if where is not None:
                    np.testing.assert_array_equal(filled[e, t, r, :2], where)


def test_a_part_behind_the_arm_was_there_all_the_time() -> None:
    parts = np.zeros((1, 30, 2, 3), np.float32)
    parts[0, :, :, :2] = [[8, 9], [20, 5]]
    mass = np.ones((1, 30, 2), np.float32)
    mass[0, 4:9] = 0
    # The second comes out from behind the arm elsewhere, and is gone in the end.
    parts[0, 9:, 1, 0] = 25
    mass[0, 15:, 1] = 0.05
    parts[..., 2] = mass > 0.12
    filled, known = track(parts, mass)
    assert known[0, :, 0].tolist() == [2] * 30
    np.testing.assert_array_equal(filled[0, :, 0], np.tile([8, 9, 1], (30, 1)))
    assert known[0, :, 1].tolist() == [2] * 4 + [0] * 5 + [2] * 6 + [1] * 15
    np.testing.assert_array_equal(filled[0, 15:, 1], np.tile([25, 5, 0], (15, 1)))


# ---- tracks of the toy -------------------------------------------------------------------------


def parts_of(states: NDArray[np.floating], perception: LayerPerception) -> NDArray[np.float64]:
    """Squares `[E, T+1, R, 3]` of the toy's states, in the perception's order."""
    flat = toy.as_seen(states.reshape(-1, 14).astype(np.float64), perception)[:, 5:]
    parts: NDArray[np.float64] = flat.double().numpy().reshape(*states.shape[:2], 3, 3)
    return parts


def test_tracks_of_the_toy_are_true(tracks: LayerTracks, perception: LayerPerception) -> None:
    actions, states = toy.make(0, EPISODES, STEPS)
    np.testing.assert_array_equal(tracks.actions, actions)
    true, found = parts_of(states, perception), tracks.truth[..., 5:].reshape(EPISODES, -1, 3, 3)
    assert (tracks.known == 2).mean() > 0.9
    error = np.linalg.norm((found - true)[..., :2], axis=3)
    sure = tracks.known == 2
    assert np.quantile(error[sure], 0.99) < 0.8
    assert (found[..., 2] == 1)[sure].all()
    assert (true[..., 2] == 1)[sure].mean() > 0.995
    # All that fell, but for what did so in the last ten frames, is known to be gone.
    fell = (true[:, :-12, :, 2] == 0) & (tracks.known[:, :-12] != 2)
    assert fell.sum() >= 10
    assert (tracks.known[:, :-12][fell] == 1).all()
    assert (found[..., 2] == 0)[tracks.known == 1].all()
    assert (true[..., 2] == 0)[tracks.known == 1].mean() > 0.8


def test_tracks_may_begin_anywhere_in_the_file(
    data: Path, tracks: LayerTracks, perception: LayerPerception
) -> None:
    some = LayerTracks(data, perception, 3, first=5)
    for name in ("states", "truth", "known", "actions", "mass"):
        np.testing.assert_allclose(
            getattr(some, name), getattr(tracks, name)[5:8], atol=1e-4, rtol=1e-5
        )


def test_tracks_are_perceived_once(
    tmp_path: Path, perception: LayerPerception, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "desk.h5"
    toy.write(path, 0, 4, 6)
    own = copy.deepcopy(perception)
    first = LayerTracks(path, own, 4)
    looked: list[int] = []
    look = LayerPerception.look

    def counted(model: LayerPerception, frames: torch.Tensor) -> object:
        looked.append(len(frames))
        return look(model, frames)

    monkeypatch.setattr(LayerPerception, "look", counted)
    again, part = LayerTracks(path, own, 4), LayerTracks(path, own, 3)
    assert looked == []
    for name in ("states", "actions", "mass", "truth", "known"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name))
    for name in ("states", "actions", "mass"):
        np.testing.assert_array_equal(getattr(part, name), getattr(first, name)[:3])
    own.sprites.mul_(0.5)
    LayerTracks(path, own, 4)
    assert looked == [7] * 4
    assert len(list((tmp_path / "desk.h5.tracks").iterdir())) == 2


def test_contacts_are_the_middles_of_steps_in_which_a_part_moves(tracks: LayerTracks) -> None:
    hands, places = tracks.contacts()
    expected = []
    for e in range(EPISODES):
        for t in range(STEPS):
            for r in range(3):
                if tracks.known[e, t, r] != 2 or tracks.known[e, t + 1, r] != 2:
                    continue
                a, b = (tracks.truth[e, i, 5 + 3 * r : 7 + 3 * r] for i in (t, t + 1))
                if np.hypot(*(b - a)) > 1:
                    hand = (tracks.truth[e, t, :3] + tracks.truth[e, t + 1, :3]) / 2
                    expected.append([*hand, *(a + b) / 2])
    assert len(expected) >= 10
    np.testing.assert_allclose(np.concatenate([hands, places], axis=1), expected, rtol=1e-5)


@pytest.mark.parametrize("length", [1, 5, STEPS])
def test_windows_of_pushed_and_slid_contain_such_events(tracks: LayerTracks, length: int) -> None:
    pushed, slid = set(), set()
    for e in range(EPISODES):
        for t in range(STEPS + 1 - length):
            a, b = tracks.truth[e, t].astype(float), tracks.truth[e, t + length].astype(float)
            if np.abs(a[3:5] - b[3:5]).max() > np.float32(0.05):
                slid.add((e, t))
            for r in range(3):
                before, after = tracks.known[e, t, r], tracks.known[e, t + length, r]
                went = np.hypot(*(a - b)[5 + 3 * r : 7 + 3 * r])
                if before == 2 and (after == 1 or (after == 2 and went > 1)):
                    pushed.add((e, t))
    assert len(pushed) >= 10
    assert len(slid) >= 10
    assert set(map(tuple, tracks.pushed(length).tolist())) == pushed
    assert set(map(tuple, tracks.slid(length).tolist())) == slid


def test_episodes_that_are_not_there_are_an_error(data: Path, perception: LayerPerception) -> None:
    for first, episodes in ((0, EPISODES + 1), (EPISODES - 2, 3), (1, 0), (3, -1)):
        with pytest.raises(ValueError, match=rf"episodes must be from 1 to {EPISODES - first}"):
            LayerTracks(data, perception, episodes, first)


def test_frames_and_actions_of_another_kind_are_an_error(
    tmp_path: Path, perception: LayerPerception
) -> None:
    for size, actions, message in ((48, 3, "frames are"), (32, 2, "actions have 2 dimensions")):
        path = tmp_path / f"{size}-{actions}.h5"
        frames = np.zeros((2, 5, size, size, 3), np.uint8)
        moves, states = np.zeros((2, 4, actions), np.float32), np.zeros((2, 5, 1))
        metadata = Metadata("desk", {}, 0, 4, 2, {})
        write_episodes(path, metadata, Episodes(frames, moves, states))
        with pytest.raises(ValueError, match=message):
            LayerTracks(path, perception, 2)


# ---- stretches ---------------------------------------------------------------------------------


def where_from(tracks: LayerTracks, actions: Floats) -> tuple[int, int]:
    """Episode and first frame of a stretch, told by its actions."""
    (episode, time), *others = np.argwhere((tracks.actions == actions[0]).all(axis=2))
    assert not others
    return int(episode), int(time)


@pytest.mark.parametrize(("step", "count", "length"), [(0, 36, 2), (4, 36, 2), (5, 12, 6)])
def test_batches_are_what_the_tracks_hold(
    tracks: LayerTracks, step: int, count: int, length: int
) -> None:
    batch = LayerSampler(tracks, 12, 6, short_steps=5, seed=3).batch(step)
    again = LayerSampler(tracks, 12, 6, short_steps=5, seed=3).batch(step)
    assert {name: tuple(x.shape) for name, x in batch.items()} == {
        "states": (count, length + 1, 14),
        "known": (count, length + 1, 3),
        "actions": (count, length, 3),
    }
    for name, tensor in batch.items():
        assert tensor.dtype == torch.float32
        assert torch.equal(tensor, again[name])
    for n in range(count):
        states, known, actions = (batch[name][n].numpy() for name in ("states", "known", "actions"))
        episode, time = where_from(tracks, actions)
        times = slice(time, time + length + 1)
        np.testing.assert_array_equal(actions, tracks.actions[episode, times][:length])
        # It begins with what is seen, and goes on with what is true.
        np.testing.assert_array_equal(states[0], tracks.states[episode, time])
        np.testing.assert_array_equal(states[1:], tracks.truth[episode, times][1:])
        np.testing.assert_array_equal(known[1:], tracks.known[episode, times][1:])
        for r in range(3):
            seen, true = (
                x[episode, time, 5 + 3 * r : 8 + 3 * r] for x in (tracks.states, tracks.truth)
            )
            wrong = (np.abs(seen - true) >= [1.5, 1.5, 0.45]).any()
            assert known[0, r] == (0 if wrong else tracks.known[episode, time, r])


def test_a_third_of_stretches_is_pushed_and_a_sixth_slides(tracks: LayerTracks) -> None:
    pushed, slid = (
        set(map(tuple, events.tolist())) for events in (tracks.pushed(4), tracks.slid(4))
    )
    sampler = LayerSampler(tracks, 60, 4, short_steps=0, seed=1)
    for step in range(3):
        actions = sampler.batch(step)["actions"].numpy()
        found = [where_from(tracks, some) for some in actions]
        assert all(place in pushed for place in found[:20])
        assert all(place in slid for place in found[20:30])
        # The rest is drawn from everything.
        assert 0 < sum(place in pushed for place in found[30:]) < 30
        assert len(set(found[30:])) > 20


def test_without_events_all_stretches_are_drawn_from_everything(tracks: LayerTracks) -> None:
    still = copy.copy(tracks)
    still.known = np.zeros_like(tracks.known)
    still.truth = tracks.truth.copy()
    still.truth[..., 3:5] = 0.5
    assert len(still.pushed(3)) == len(still.slid(3)) == 0
    batch = LayerSampler(still, 200, 3, short_steps=0, seed=2).batch(0)
    episodes = [where_from(tracks, actions)[0] for actions in batch["actions"].numpy()]
    assert len(set(episodes)) == EPISODES


@pytest.mark.parametrize(
    ("windows", "length", "message"),
    [
        (0, 3, "windows must be at least 1"),
        (3, 0, "length must be from 1 to 30"),
        (3, 31, "got 31"),
    ],
)
def test_stretches_out_of_range_are_named(
    tracks: LayerTracks, windows: int, length: int, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        LayerSampler(tracks, windows, length, 0, 0)
