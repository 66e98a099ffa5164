"""The generator of the desk's states: what it draws, learns from, and how it is trained."""

from __future__ import annotations

import copy
import dataclasses
import functools
import io
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from torch import Tensor, nn

import toy_desk as toy
from hvf.data.episodes import Episodes, Metadata
from hvf.data.formats.hdf5 import write_episodes
from hvf.data.loader import EpisodePool
from hvf.models.checkpoint import load_model, read_tensors, save_model
from hvf.models.layers.dynamics import LayerDynamics
from hvf.models.layers.generator import LayerGenerator, LayerGeneratorConfig
from hvf.models.layers.perception import LayerPerception
from hvf.training.loop import LoopConfig
from hvf.training.recipe import train as train_model
from hvf.training.recipes.layers_generator import validate_layers_generator
from hvf.training.tracks.layers import LayerTracks
from hvf.training.tracks.pairs import StatePairs
from hvf.worlds.layers import LayerWorld
from hvf.worlds.layers_subgoals import StateSubgoals
from hvf_core import LayerFrames
from layered_desk import SIZE, random_dynamics

EPISODES, STEPS = toy.EPISODES, toy.STEPS
SMALL = LayerGeneratorConfig(image_size=toy.SIZE, latent_dim=4, hidden=16)
SHORT = LoopConfig(
    steps=8, learning_rate=1e-3, precision="float32", validate_every=8, checkpoint_every=4
)
QUIET = Console(file=io.StringIO())


@pytest.fixture(scope="module")
def perception() -> LayerPerception:
    return toy.seen()[0]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return toy.recorded(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def tracks(data: Path, perception: LayerPerception) -> LayerTracks:
    """Tracks of which every state bears its number: episode and frame, in place of the hand."""
    found = LayerTracks(data, perception, EPISODES)
    found.truth[..., 0] = np.arange(EPISODES)[:, None]
    found.truth[..., 1] = np.arange(STEPS + 1)
    return found


@pytest.fixture(scope="module")
def dynamics(perception: LayerPerception, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("dynamics") / "model.safetensors"
    model = LayerDynamics(toy.TINY).freeze_perception(perception)
    save_model(path, model, environment="desk")
    return path


def restless(seed: int) -> LayerGenerator:
    """A generator that nobody trained, of which everything moves somewhat."""
    torch.manual_seed(seed)
    model = LayerGenerator(SMALL).requires_grad_(False)
    last_layer(model).weight.normal_(std=0.3)
    before = scenes(seed, 300)
    change = (model.rebuild(torch.randn(300, 4), before) - before) / model.scale
    last_layer(model).bias.sub_(change.mean(dim=0))
    last_layer(model).bias[[7, 10, 13]] -= 0.4
    return model


def last_layer(model: LayerGenerator) -> nn.Linear:
    layer = model.decoder[-1]
    assert isinstance(layer, nn.Linear)
    return layer


def scenes(seed: int, count: int) -> Tensor:
    """States of the toy, some squares of which are gone."""
    rng = np.random.default_rng(seed)
    states = toy.scattered(rng, count)
    states[:, 7::3] = rng.random((count, 3)) < 0.7
    return torch.from_numpy(states).float()


# ---- what is drawn -----------------------------------------------------------------------------


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1))
def test_what_hardly_moves_does_not_move_by_a_bit(seed: int) -> None:
    model, before = restless(seed % 7), scenes(seed, 60)
    latents = torch.randn(60, 4, generator=torch.Generator().manual_seed(seed % 2**31))
    drawn, rebuilt = model.decode(latents, before), model.rebuild(latents, before)
    assert torch.equal(drawn[:, :3], rebuilt[:, :3])
    for n in range(60):
        for i in (3, 4):
            was, wish, now = (float(x[n, i]) for x in (before, rebuilt, drawn))
            wish = min(max(wish, 0.0), 1.0)
            if abs(abs(wish - was) - 0.03) > 1e-5:
                assert now == (was if abs(wish - was) < 0.03 else wish)
        for i in (5, 8, 11):
            start, idea, end = (x[n, i : i + 3] for x in (before, rebuilt, drawn))
            far = float((idea - start)[:2].double().norm())
            if abs(far - 1.5) > 1e-4:
                assert torch.equal(end[:2], start[:2] if far < 1.5 else idea[:2])
            # What is gone does not come back.
            assert float(end[2]) == (1.0 if idea[2] > 0.5 and start[2] else 0.0)


def test_some_of_everything_is_drawn() -> None:
    model, before = restless(1), scenes(1, 500)
    drawn = model.decode(torch.randn(500, 4), before)
    for i in (3, 4, 5, 8, 11):
        assert 0.02 < float((drawn[:, i] != before[:, i]).float().mean()) < 0.98
    there = before[:, 7::3] == 1
    assert 0.02 < float((drawn[:, 7::3] == 0)[there].float().mean()) < 0.98


def test_the_loss_is_the_negative_evidence_lower_bound() -> None:
    model = restless(2)
    batch = {"scenes": scenes(3, 50), "states": scenes(4, 50)}
    found, parts = model.loss(batch, torch.Generator().manual_seed(5), 0)
    mean, log_variance = model.encode(batch["states"], batch["scenes"])
    noise = torch.randn(mean.shape, generator=torch.Generator().manual_seed(5))
    rebuilt = model.rebuild(mean + noise * (log_variance / 2).exp(), batch["scenes"])
    guess, truth = rebuilt.double().numpy(), batch["states"].double().numpy()
    m, v = mean.double().numpy(), np.exp(log_variance.double().numpy())
    kl = 0.5 * (m**2 + v - np.log(v) - 1).sum(axis=1).mean()
    distortion = 0.0
    for n in range(50):
        error = (guess[n] - truth[n]) ** 2
        distortion += 0.5 * (error[:3].sum() / 0.25**2 + error[3:5].sum() / 0.03**2) / 50
        for i in (5, 8, 11):
            # Where a part is that is gone does not matter.
            distortion += 0.5 * error[i : i + 2].sum() * truth[n, i + 2] / 50
            distortion += 0.5 * error[i + 2] / 0.2**2 / 50
    assert float(parts["kl"]) == pytest.approx(kl, rel=1e-4)
    assert float(parts["distortion"]) == pytest.approx(distortion, rel=1e-4)
    assert float(found) == pytest.approx(kl + distortion, rel=1e-4)


def test_surprise_is_the_negative_log_likelihood() -> None:
    """Against the integral over the one latent, summed on a grid."""
    torch.manual_seed(11)
    model = LayerGenerator(
        dataclasses.replace(
            SMALL, latent_dim=1, hand_precision=4.0, slider_precision=1.0, part_precision=9.0,
            presence_precision=1.0,
        )
    ).requires_grad_(False)  # fmt: skip
    before, after = scenes(12, 30), scenes(13, 30)
    grid = torch.linspace(-6, 6, 1201, dtype=torch.float64)
    likelihood = np.zeros(30)
    for latent in grid:
        rebuilt = model.rebuild(latent.float().expand(30, 1), before)
        error = ((rebuilt - after).double().numpy()) ** 2
        there = after[:, 7::3].double().numpy()
        distortion = error[:, :3].sum(axis=1) / 4.0**2 + error[:, 3:5].sum(axis=1)
        distortion += ((error[:, 5::3] + error[:, 6::3]) * there / 9.0**2).sum(axis=1)
        distortion += error[:, 7::3].sum(axis=1)
        density = np.exp(-0.5 * float(latent) ** 2) / np.sqrt(2 * np.pi)
        likelihood += np.exp(-0.5 * distortion) * density * float(grid[1] - grid[0])
    found = model.surprise(after, before, draws=4000)
    np.testing.assert_allclose(found.numpy(), -np.log(likelihood), atol=0.05)


def test_a_trained_generator_takes_two_changes_at_once_for_unlikely() -> None:
    """It has seen the door open or a square move, and never both."""
    model, first = half_trained()
    door, square, both = first.clone(), first.clone(), first.clone()
    for states in (door, both):
        states[:, 3] = 1 - states[:, 3]
    for states in (square, both):
        states[:, 6] += 6.0
    one = torch.maximum(model.surprise(door, first), model.surprise(square, first))
    assert float((model.surprise(both, first) > one + 1).float().mean()) > 0.9
    assert float((model.surprise(both, first) - one).median()) > 8


def test_a_trained_generator_rebuilds_what_it_is_shown() -> None:
    model, first = half_trained()
    later = first.clone()
    later[::2, 6] += 6.0
    later[1::2, 3] = 1 - later[1::2, 3]
    latents, _ = model.encode(later, first)
    drawn = model.decode(latents, first)
    # A square and a door that moved are where they went, the others exactly where they were.
    assert float((drawn[::2, 6] - later[::2, 6]).abs().mean()) < 1.5
    still = (drawn[:, 8:10] == first[:, 8:10]).all(dim=1).float().mean()
    assert float(still) > 0.8


@functools.cache
def half_trained() -> tuple[LayerGenerator, Tensor]:
    """A generator that learned two changes, each in half of all pairs, and the scenes.

    A square goes to the right in some; the door opens or closes in the others.
    """
    torch.manual_seed(6)
    model = LayerGenerator(dataclasses.replace(SMALL, hidden=48, hand_precision=1.0))
    optimiser = torch.optim.Adam(model.parameters(), 6e-3)
    first = scenes(7, 300)
    first[:, 7::3] = 1
    later = first.clone()
    later[::2, 6] += 6.0
    later[1::2, 3] = 1 - later[1::2, 3]
    losses = []
    for step in range(200):
        generator = torch.Generator().manual_seed(step)
        loss, _ = model.loss({"scenes": first, "states": later}, generator, step)
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.1 * losses[0]
    return model.requires_grad_(False), first


# ---- pairs of states ---------------------------------------------------------------------------


def parts_of(states: np.ndarray) -> np.ndarray:
    """Row, column and presence of each part, in an order that does not depend on theirs."""
    parts = states[..., 5:].reshape(*states.shape[:-1], 3, 3)
    return np.take_along_axis(parts, np.lexsort(parts.T, axis=0).T[..., None], axis=-2)


def places_of(tracks: LayerTracks, states: Tensor) -> list[tuple[int, int]]:
    """Episodes and frames that these states are those of, but for the order of the parts."""
    places = [(int(state[0]), int(state[1])) for state in states]
    for place, state in zip(places, states.numpy(), strict=True):
        np.testing.assert_array_equal(tracks.truth[place][:5], state[:5])
        np.testing.assert_array_equal(parts_of(tracks.truth[place]), parts_of(state))
    return places


def kind_of(tracks: LayerTracks, episode: int, first: int, later: int) -> int:
    """What changes between two frames, the slow way."""
    before, after = tracks.truth[episode, first], tracks.truth[episode, later]
    known, then = tracks.known[episode, first], tracks.known[episode, later]
    kind = int(any(abs(after[i] - before[i]) > 0.05 for i in (3, 4)))
    for part in range(3):
        at = slice(5 + 3 * part, 7 + 3 * part)
        if known[part] == then[part] == 2 and np.linalg.norm(after[at] - before[at]) > 1.5:
            kind = max(kind, 2)
        if known[part] == 2 and then[part] == 1:
            kind = 3
    return kind


def test_pairs_are_of_one_episode_and_every_kind_of_change_has_its_share(
    tracks: LayerTracks,
) -> None:
    kinds, apart = [], []
    for step in range(20):
        batch = StatePairs(tracks, 40, seed=1).batch(step)
        again = StatePairs(tracks, 40, seed=1).batch(step)
        assert all(torch.equal(batch[name], again[name]) for name in ("scenes", "states"))
        before, after = (places_of(tracks, batch[name]) for name in ("scenes", "states"))
        for (episode, first), (same, later) in zip(before, after, strict=True):
            assert episode == same
            assert first + 5 <= later <= first + 30 or first < later == STEPS
            assert (tracks.known[episode, [first, later]] > 0).all()
            kinds.append(kind_of(tracks, episode, first, later))
            apart.append(later - first)
    shares = np.bincount(kinds, minlength=4) / len(kinds)
    np.testing.assert_allclose(shares, [0.2, 0.25, 0.35, 0.2], atol=5 * np.sqrt(0.25 / 800))
    assert len(set(apart)) > 8


def test_parts_change_places_alike_in_both_states_of_a_pair(tracks: LayerTracks) -> None:
    batch = StatePairs(tracks, 200, seed=3).batch(0)
    orders = set()
    for before, after in zip(batch["scenes"].numpy(), batch["states"].numpy(), strict=True):
        was, will = (tracks.truth[int(x[0]), int(x[1])] for x in (before, after))
        for order in itertools.permutations(range(3)):
            moved = [np.concatenate([x[5 + 3 * i : 8 + 3 * i] for i in order]) for x in (was, will)]
            if (moved[0] == before[5:]).all() and (moved[1] == after[5:]).all():
                orders.add(order)
                break
        else:
            raise AssertionError("parts of the two states are in different orders")
    assert len(orders) == 6


@pytest.mark.parametrize("known", [0.9, 0.6, 0.1])
def test_pairs_are_known_however_little_is(tracks: LayerTracks, known: float) -> None:
    blind = copy.copy(tracks)
    rng = np.random.default_rng(8)
    seen = rng.random(tracks.known.shape) < known ** (1 / 3)
    blind.known = np.where(seen, tracks.known.clip(1), 0).astype(np.uint8)
    sampler = StatePairs(blind, 64, seed=2)
    for step in range(3):
        batch = sampler.batch(step)
        for name in ("scenes", "states"):
            assert batch[name].shape == (64, 14)
            assert all(seen[place].all() for place in places_of(tracks, batch[name]))


def test_without_a_pair_there_is_one_clear_error(tracks: LayerTracks) -> None:
    blind = copy.copy(tracks)
    blind.known = np.zeros_like(tracks.known)
    # A single frame is no pair.
    blind.known[:, 7] = 2
    with pytest.raises(ValueError, match="tracks: no two frames in which all parts are known"):
        StatePairs(blind, 4, seed=0)


# ---- training ----------------------------------------------------------------------------------


def trained(data: Path, dynamics: Path, out: Path, **settings: Any) -> str:
    said = io.StringIO()
    small = {"episodes": 30, "batch_size": 16, "model": SMALL, "loop": SHORT, **settings}
    console = Console(file=said, width=300)
    train_model("layers-generator", data, dynamics=dynamics, out=out, console=console, **small)
    return said.getvalue()


def test_training_that_died_goes_on_to_the_same_result(
    data: Path, dynamics: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained(data, dynamics, tmp_path / "whole")
    assert "already trained for 8 steps" in trained(data, dynamics, tmp_path / "whole")
    draw = StatePairs.batch

    def die(sampler: StatePairs, step: int) -> object:
        if step == 6:
            raise MemoryError("killed")
        return draw(sampler, step)

    with monkeypatch.context() as patch:
        patch.setattr(StatePairs, "batch", die)
        with pytest.raises(MemoryError):
            trained(data, dynamics, tmp_path / "died")
    assert "resuming at step 4" in trained(data, dynamics, tmp_path / "died")
    whole, died = (
        read_tensors(tmp_path / name / "training.safetensors")[0] for name in ("whole", "died")
    )
    assert whole.keys() == died.keys()
    assert all(whole[name].equal(died[name]) for name in whole)


def test_the_model_takes_its_sizes_from_the_dynamics(
    data: Path, dynamics: Path, tmp_path: Path
) -> None:
    small = dataclasses.replace(SMALL, image_size=64, action_dim=1, sliders=1, roaming=1)
    model = train_model(
        "layers-generator", data, dynamics=dynamics, out=tmp_path, episodes=4, model=small,
        loop=SHORT, console=QUIET,
    )  # fmt: skip
    assert model.config == SMALL


def test_validation_counts_what_moves(data: Path, dynamics: Path) -> None:
    world = load_model(dynamics, LayerDynamics, environment="desk")
    held_out = EpisodePool(data, "validation", environment="desk")
    held_out.move_to(0)
    model = LayerGenerator(SMALL).requires_grad_(False)
    last_layer(model).weight.zero_()
    for slide, rows in ((0.0, 0.0), (0.7, 0.0), (0.0, 0.3)):
        # The first slider goes by a third of its way or so, the first part by five rows.
        last_layer(model).bias.zero_()
        last_layer(model).bias[3] = slide
        last_layer(model).bias[5] = rows
        found = validate_layers_generator(model, world, held_out, torch.Generator().manual_seed(0))
        at_end = np.mean(
            [
                bool(s)
                for s in (
                    world.perception.observe(torch.from_numpy(held_out.frames[:10, 0]))[:, 3] > 0.97
                )
            ]
        )
        assert found.metrics["moved"] == (1.0 if rows else 0.0)
        assert found.metrics["slid"] == pytest.approx((1.0 - at_end) if slide else 0.0)
        assert found.pictures["subgoals"].ndim == 3


def test_data_that_the_dynamics_does_not_fit_is_one_clear_error(
    dynamics: Path, data: Path, tmp_path: Path
) -> None:
    other = tmp_path / "other.h5"
    frames = np.zeros((4, 5, 16, 16, 3), np.uint8)
    moves, states = np.zeros((4, 4, 3), np.float32), np.zeros((4, 5, 1))
    write_episodes(other, Metadata("desk", {}, 0, 4, 4, {}), Episodes(frames, moves, states))
    with pytest.raises(ValueError, match=r"other\.h5: frames are \(16, 16\), the model takes"):
        trained(other, dynamics, tmp_path / "out")
    with pytest.raises(FileNotFoundError, match=r"no\.safetensors"):
        trained(data, tmp_path / "no.safetensors", tmp_path / "out")
    with pytest.raises(ValueError, match="batch_size must be at least 1"):
        trained(data, dynamics, tmp_path / "out", batch_size=0)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"latent_dim": 0}, "latent_dim must be at least 1"),
        ({"part_precision": 0.0}, "part_precision must be positive"),
        ({"least_move": -1.0}, "least_move must not be negative"),
    ],
)
def test_settings_out_of_range_are_named(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        LayerGeneratorConfig(**settings)  # type: ignore[arg-type]


# ---- as the planner's subgoals -----------------------------------------------------------------


def test_each_subgoal_of_a_sample_is_drawn_given_the_one_before_it() -> None:
    world = LayerWorld(random_dynamics())
    torch.manual_seed(3)
    model = LayerGenerator(LayerGeneratorConfig(image_size=SIZE, latent_dim=4, hidden=16))
    rng = np.random.default_rng(1)
    scene = world.observe(rng.integers(0, 256, (1, SIZE, SIZE, 3), dtype=np.uint8))
    latents = (3 * rng.standard_normal((5, 3, 4))).astype(np.float32)
    drawn = StateSubgoals(model, world).decode(scene, latents)
    assert len(drawn) == 15
    for sample in range(5):
        now = torch.from_numpy(scene.states)
        for k in range(3):
            with torch.no_grad():
                now = model.decode(torch.from_numpy(latents[sample, k : k + 1]), now)
            found = drawn.states[3 * sample + k]
            np.testing.assert_allclose(found, now[0].numpy(), rtol=1e-5, atol=1e-5)
            np.testing.assert_array_equal(
                drawn.images[3 * sample + k], world.changed(scene, now.numpy()).images[0]
            )


def test_segments_cost_what_the_generator_says_of_their_states() -> None:
    world, model, start, goal = judged()
    latents = np.random.default_rng(1).standard_normal((6, 2, 4)).astype(np.float32)
    subgoals = StateSubgoals(model, world)
    found = subgoals.segment_costs(start, goal, latents)
    assert (found.shape, found.dtype) == ((6, 3), np.float32)
    states = subgoals.decode(start, latents).states.reshape(6, 2, -1)
    way = torch.from_numpy(np.concatenate([start.states[None].repeat(6, 0), states], axis=1))
    for k in range(2):
        expected = model.surprise(way[:, k + 1], way[:, k])
        np.testing.assert_allclose(found[:, k], expected.detach().numpy(), rtol=1e-4)


def test_a_part_that_is_not_seen_in_the_goal_is_gone_or_hidden() -> None:
    """What is likelier counts; only where the arm is can it be hidden."""
    world, model, start, goal = judged()
    latents = np.zeros((1, 1, 4), np.float32)
    perception = world.dynamics.perception
    was, seen = start.states[0].copy(), goal.states[0].copy()
    was[7::3], seen[7::3] = 1.0, 0.0
    for covered in (0.0, 1.0):
        perception.covered = lambda *_, covered=covered: torch.full((1, 3), covered)  # type: ignore
        begin, end = world.changed(start, was[None]), world.changed(start, seen[None])
        subgoals = StateSubgoals(model, world)
        found = subgoals.segment_costs(begin, end, latents)[0, 1]
        before = torch.from_numpy(subgoals.decode(begin, latents).states)
        expected = []
        for hidden in itertools.product([False, True], repeat=3):
            if any(hidden) and not covered:
                continue
            meant = torch.from_numpy(seen.copy())
            for part, is_hidden in enumerate(hidden):
                at = slice(5 + 3 * part, 8 + 3 * part)
                meant[at] = torch.from_numpy(was[at])
                meant[at][2] = float(is_hidden)
            expected.append(float(model.surprise(meant[None], before)))
        assert found == pytest.approx(min(expected), rel=1e-4)


def judged() -> tuple[LayerWorld, LayerGenerator, LayerFrames, LayerFrames]:
    """A world, a generator that nobody trained, a start and a goal."""
    world = LayerWorld(random_dynamics())
    torch.manual_seed(3)
    model = LayerGenerator(LayerGeneratorConfig(image_size=SIZE, latent_dim=4, hidden=16))
    rng = np.random.default_rng(1)
    frames = world.observe(rng.integers(0, 256, (2, SIZE, SIZE, 3), dtype=np.uint8))
    return world, model, frames[[0]], frames[[1]]


def test_a_generator_of_other_states_than_the_worlds_is_refused() -> None:
    world = LayerWorld(random_dynamics())
    with pytest.raises(ValueError, match="generator: draws states of length 17, the world's: 14"):
        StateSubgoals(LayerGenerator(LayerGeneratorConfig(roaming=4)), world)
