"""Steps of play between two states of the desk: the network, what it learns from, its uses."""

from __future__ import annotations

import io
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from torch import Tensor

import toy_desk as toy
from hvf.data.temporal import doubling_steps
from hvf.evaluation.evaluation import Evaluation
from hvf.models.checkpoint import load_any, save_model
from hvf.models.doublings import class_of, expected_class
from hvf.models.layers.distance import LayerDistance, LayerDistanceConfig
from hvf.models.layers.dynamics import LayerDynamics
from hvf.models.layers.generator import LayerGenerator, LayerGeneratorConfig
from hvf.models.layers.perception import LayerPerception
from hvf.protocols import Judging
from hvf.settings import OverHorizon, Planning
from hvf.training.loop import LoopConfig
from hvf.training.recipe import train as train_model
from hvf.training.tracks.layers import LayerTracks
from hvf.training.tracks.pairs import StatePairs
from hvf.training.tracks.transplants import Transplants
from hvf.worlds.layers import LayerWorld
from hvf.worlds.layers_meanings import meanings
from hvf.worlds.layers_subgoals import StateSubgoals
from hvf.worlds.steps import LayerStepsWorld, layer_segments, layer_steps
from hvf_core import HVF, VisualMPC
from layered_desk import SIZE, random_dynamics, random_states

LATENT = 4


@pytest.fixture(scope="module")
def perception() -> LayerPerception:
    return toy.seen()[0]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return toy.recorded(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def tracks(data: Path, perception: LayerPerception) -> LayerTracks:
    return LayerTracks(data, perception, toy.EPISODES)


def network(seed: int, image_size: int = toy.SIZE, **sizes: Any) -> LayerDistance:
    torch.manual_seed(seed)
    config = LayerDistanceConfig(
        image_size=image_size, **{"part_hidden": 8, "hidden": 16, "classes": 5, **sizes}
    )
    return LayerDistance(config).requires_grad_(False).eval()


def states_of(seed: int, count: int) -> Tensor:
    return torch.from_numpy(random_states(count, seed))


# ---- numbers of steps --------------------------------------------------------------------------


@given(st.lists(st.integers(0, 5000), min_size=1), st.integers(2, 14))
def test_a_class_holds_twice_the_steps_of_the_one_before_it(steps: list[int], classes: int) -> None:
    found = class_of(torch.tensor(steps), classes)
    for number, label in zip(steps, found.tolist(), strict=True):
        expected = 0 if number == 0 else number.bit_length()
        assert label == min(expected, classes - 1)


@given(st.lists(st.floats(-20, 20), min_size=1, max_size=9))
def test_the_expected_class_is_the_mean_over_classes(logits: list[float]) -> None:
    weights = np.exp(np.array(logits) - max(logits))
    expected = float(weights @ np.arange(len(logits)) / weights.sum())
    found = float(expected_class(torch.tensor(logits, dtype=torch.float64)))
    assert found == pytest.approx(expected, abs=1e-9)


def test_every_doubling_of_steps_is_drawn_alike() -> None:
    steps = doubling_steps(np.random.default_rng(0), 63, 7000)
    assert steps.min() == 0
    assert steps.max() == 63
    counts = np.bincount(class_of(torch.from_numpy(steps), 7).numpy())
    np.testing.assert_allclose(counts, 1000, atol=5 * np.sqrt(1000))


# ---- the network -------------------------------------------------------------------------------


def test_distance_is_the_expected_class_and_how_seldom_nothing_is_transplanted() -> None:
    model = network(0)
    before, after = states_of(1, 30), states_of(2, 30)
    steps, transplanted = (each.double().numpy() for each in model.logits(before, after))
    assert steps.shape == (30, 5)
    assert transplanted.shape == (30, 5)
    odds = np.exp(steps)
    expected = (odds / odds.sum(axis=1, keepdims=True)) @ np.arange(5)
    fitting = np.prod(1 / (1 + np.exp(transplanted)), axis=1)
    np.testing.assert_allclose(model(before, after), expected - np.log2(fitting), rtol=1e-5)


def test_two_things_that_do_not_fit_are_as_far_as_both_are() -> None:
    model = network(6)
    before, after = states_of(1, 30), states_of(2, 30)
    after[:, :5] = before[:, :5]

    def seldom(changed: Tensor) -> Tensor:
        return torch.nn.functional.softplus(model.logits(before, changed)[1]).sum(dim=1)

    none = seldom(before)
    alone = []
    for part in range(3):
        one = before.clone()
        one[:, 5 + 3 * part : 8 + 3 * part] = after[:, 5 + 3 * part : 8 + 3 * part]
        alone.append(seldom(one) - none)
    torch.testing.assert_close(seldom(after), none + sum(alone), rtol=1e-4, atol=1e-4)


def test_it_does_not_matter_which_part_is_which() -> None:
    model = network(3)
    before, after = states_of(1, 20), states_of(2, 20)
    expected = model(before, after)
    for order in itertools.permutations(range(3)):
        columns = [*range(5), *(5 + 3 * part + k for part in order for k in range(3))]
        torch.testing.assert_close(model(before[:, columns], after[:, columns]), expected)


def test_where_a_part_was_last_seen_that_is_gone_does_not_matter() -> None:
    model = network(3)
    before, after = states_of(1, 40), states_of(2, 40)
    gone = after[:, 7] < 0.5
    assert 0 < int(gone.sum()) < 40
    other = after.clone()
    other[:, 5:7] += 4.0
    same = model(before, other) == model(before, after)
    assert same.equal(gone)


@pytest.mark.parametrize(
    "wrong", [{"part_hidden": 0}, {"hidden": 0}, {"classes": 1}, {"roaming": 0}, {"image_size": 0}]
)
def test_sizes_out_of_range_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        LayerDistanceConfig(**wrong)


# ---- what it learns from -----------------------------------------------------------------------


def same_thing(a: Any, b: Any, thing: int) -> bool:
    """Whether slider (0, 1) or part (2 to 4) `thing` looks alike in two states."""
    if thing < 2:
        return abs(a[3 + thing] - b[3 + thing]) <= 0.05
    at = 5 + 3 * (thing - 2)
    there, still = a[at + 2] > 0.5, b[at + 2] > 0.5
    if there != still:
        return False
    return not there or np.linalg.norm(a[at : at + 2] - b[at : at + 2]) <= 1.5


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_transplanted_things_are_where_other_episodes_have_them(
    tracks: LayerTracks, share: float
) -> None:
    pairs, counts, gone = StatePairs(tracks, 200, 7), [], []
    sampler = Transplants(pairs, tracks, share, 7)
    parts = tracks.truth[..., 5:].reshape(-1, 3, 3)
    places = {tuple(place) for place in parts[tracks.known.reshape(-1, 3) == 2][:, :2].tolist()}
    slides = [set(tracks.truth[..., slider].ravel().tolist()) for slider in (3, 4)]
    for step in range(4):
        batch, again = sampler.batch(step), sampler.batch(step)
        assert all(batch[name].equal(again[name]) for name in batch)
        own = pairs.batch(step)
        assert batch["scenes"].equal(own["scenes"])
        assert batch["steps"].equal(own["steps"])
        for n in range(200):
            was, found = own["states"][n].numpy(), batch["states"][n].numpy()
            assert (found[:3] == was[:3]).all()
            columns = [[3], [4], *([5 + 3 * part + k for k in range(3)] for part in range(3))]
            taken = [k for k, place in enumerate(columns) if (found[place] != was[place]).any()]
            for thing in taken:
                values = found[columns[thing]].tolist()
                if thing < 2:
                    assert values[0] in slides[thing]
                else:
                    assert tuple(values[:2]) in places
                    gone.append(1 - values[2])
            elsewhere = [not same_thing(found, was, thing) for thing in range(5)]
            assert batch["transplanted"][n].tolist() == elsewhere
            counts.append(len(taken))
    if share == 0:
        assert not any(counts)
        return
    # Five coins each, of which a few show no change.
    assert np.mean(counts) == pytest.approx(2.4 * share, abs=0.3)
    assert np.mean(gone) == pytest.approx(0.25, abs=0.06)


def test_rare_places_are_transplanted_as_often_as_common_ones(tracks: LayerTracks) -> None:
    sampler = Transplants(StatePairs(tracks, 500, 7), tracks, 1.0, 7)
    parts = tracks.truth[..., 5:].reshape(-1, 3, 3)
    known = np.round(parts[tracks.known.reshape(-1, 3) == 2][:, :2] / 4).astype(int)
    cells, common = np.unique(known, axis=0, return_counts=True)
    drawn = np.zeros(len(cells))
    for step in range(40):
        batch = sampler.batch(step)
        where = batch["transplanted"][:, 2:].numpy()
        found = batch["states"][:, 5:].reshape(-1, 3, 3).numpy()[where]
        for place in np.round(found[:, :2] / 4).astype(int):
            drawn += (cells == place).all(axis=1)
    # The most common cell holds far more of what was recorded than an even share.
    assert common.max() > 3 * common.mean()
    # A gone part may be drawn where it was, too, and a small change counts as none.
    assert drawn.max() < 1.6 * drawn.mean()
    assert drawn.min() > 0.4 * drawn.mean()


def test_pairs_tell_the_steps_between_them(tracks: LayerTracks) -> None:
    far = StatePairs(tracks, 50, 3, ahead=lambda rng, n: np.full(n, 4)).batch(0)
    assert set(far["steps"].tolist()) <= {1, 2, 3, 4}
    still = StatePairs(tracks, 50, 3, ahead=lambda rng, n: np.zeros(n, np.int64)).batch(0)
    assert still["scenes"].equal(still["states"])
    assert not still["steps"].any()


def train(data: Path, perception: LayerPerception, out: Path, **settings: Any) -> None:
    dynamics = out.parent / "dynamics.safetensors"
    if not dynamics.is_file():
        model = LayerDynamics(toy.TINY).freeze_perception(perception)
        save_model(dynamics, model, environment="desk")
    train_model(
        "layers-distance", data, dynamics=dynamics, out=out,
        console=Console(file=io.StringIO()), **settings,
    )  # fmt: skip


def test_what_is_trained_is_loaded_by_its_file_and_the_same_after_a_stop(
    data: Path, perception: LayerPerception, tmp_path: Path
) -> None:
    small: dict[str, Any] = {
        "batch_size": 16,
        "model": LayerDistanceConfig(part_hidden=4, hidden=8, roaming=1, image_size=64),
        "loop": LoopConfig(
            steps=8, learning_rate=1e-3, precision="float32", validate_every=8, checkpoint_every=4
        ),
    }
    draw = Transplants.batch

    def die(sampler: Transplants, step: int) -> object:
        if step == 6:
            raise MemoryError("killed")
        return draw(sampler, step)

    train(data, perception, tmp_path / "whole", **small)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Transplants, "batch", die)
        with pytest.raises(MemoryError):
            train(data, perception, tmp_path / "died", **small)
    train(data, perception, tmp_path / "died", **small)
    whole, died = (load_any(tmp_path / name / "model.safetensors") for name in ("whole", "died"))
    assert whole.name == "layers-distance"
    # The sizes of states are the dynamics'.
    assert whole.module.config.roaming == 3
    assert whole.module.config.image_size == toy.SIZE
    for name, value in whole.module.state_dict().items():
        assert value.equal(died.module.state_dict()[name]), name
    assert {"nats", "right", "told"} <= whole.header.training["validation"].keys()
    assert len(list((tmp_path / "whole" / "pictures").glob("distances*.png"))) == 1
    with pytest.raises(ValueError, match="transplants must be at least 0 and below 1"):
        train(data, perception, tmp_path / "wrong", transplants=1.0)


def test_training_tells_transplants_and_counts_steps(
    data: Path, perception: LayerPerception, tracks: LayerTracks, tmp_path: Path
) -> None:
    loop = LoopConfig(steps=300, learning_rate=5e-3, precision="float32", validate_every=300)
    train(data, perception, tmp_path / "run", batch_size=256, loop=loop,
          model=LayerDistanceConfig(part_hidden=16, hidden=32))  # fmt: skip
    model = load_any(tmp_path / "run" / "model.safetensors").module
    pairs = StatePairs(tracks, 1000, 1, ahead=lambda rng, n: doubling_steps(rng, 30, n))
    batch = Transplants(pairs, tracks, 0.5, 1).batch(9)
    with torch.inference_mode():
        distance = model(batch["scenes"], batch["states"])
    apart = batch["transplanted"].any(dim=1)
    # A coin would be right every second time.
    farther = (distance[apart][:, None] > distance[~apart][None]).float().mean()
    assert float(farther) > 0.85
    steps = batch["steps"][~apart]
    near, far = distance[~apart][steps <= 2], distance[~apart][steps >= 8]
    assert float((far[:, None] > near[None]).float().mean()) > 0.75


# ---- what it is good for -----------------------------------------------------------------------


def world_and_frames(hold: int = 1) -> tuple[LayerWorld, Any]:
    world = LayerWorld(random_dynamics(), hold=hold)
    images = np.random.default_rng(1).integers(0, 256, (4, SIZE, SIZE, 3), dtype=np.uint8)
    return world, world.observe(images)


@pytest.mark.parametrize("over", ["last", "sum", "min"])
@pytest.mark.parametrize("hold", [1, 2])
def test_as_a_planning_cost_it_is_asked_of_predicted_states(over: OverHorizon, hold: int) -> None:
    world, frames = world_and_frames(hold)
    model = network(5, SIZE)
    planned = layer_steps(model, world, Planning(over_horizon=over))
    assert isinstance(planned, LayerStepsWorld)
    starts, goals = frames[np.array([0, 1])], frames[np.array([2, 3])]
    actions = np.random.default_rng(0).uniform(-1, 1, (2, 5, 4, 3)).astype(np.float32)
    found = planned.rollout_costs(starts, goals, actions)
    path = torch.from_numpy(world.native.rollout(starts, actions))
    begin, end = torch.from_numpy(starts.states), torch.from_numpy(goals.states)
    for b in range(2):
        ends = meanings(world.dynamics.perception, begin[b], end[b])
        for d in range(5):
            each = [
                min(float(model(path[b, d, h][None], meaning[None])[0]) for meaning in ends)
                for h in range(hold - 1, 4, hold)
            ]
            expected = {"last": each[-1], "sum": sum(each), "min": min(each)}[over]
            assert found[b, d] == pytest.approx(expected, rel=1e-4)
    plan = VisualMPC(samples=8, elites=2, iterations=2, horizon=4).plan(
        planned, starts[[0]], goals[[0]]
    )
    assert np.isfinite(plan.cost)


def test_segments_cost_what_it_says_of_their_ends() -> None:
    world, frames = world_and_frames()
    torch.manual_seed(3)
    drawn_by = LayerGenerator(LayerGeneratorConfig(image_size=SIZE, latent_dim=LATENT, hidden=16))
    plain = StateSubgoals(drawn_by, world)
    model = network(5, SIZE)
    subgoals = layer_segments(model, plain)
    assert isinstance(subgoals, Judging)
    start, goal = frames[[0]], frames[[1]]
    latents = np.random.default_rng(2).normal(size=(6, 2, LATENT)).astype(np.float32)
    found = subgoals.segment_costs(start, goal, latents)
    assert found.shape == (6, 3)
    assert not np.allclose(found, plain.segment_costs(start, goal, latents))
    np.testing.assert_array_equal(
        subgoals.decode(start, latents).states, plain.decode(start, latents).states
    )
    begin, end = torch.from_numpy(start.states), torch.from_numpy(goal.states)
    ends = meanings(world.dynamics.perception, begin[0], end[0])
    for sample, cost in zip(torch.from_numpy(latents), found, strict=True):
        first = drawn_by.decode(sample[:1], begin)
        second = drawn_by.decode(sample[1:], first)
        last = min(float(model(second, meaning[None])[0]) for meaning in ends)
        expected = [float(model(begin, first)[0]), float(model(first, second)[0]), last]
        np.testing.assert_allclose(cost, expected, rtol=1e-4)
    search = HVF(
        mpc=VisualMPC(samples=8, elites=2, iterations=1), samples=30, elites=5, iterations=3,
        segment_cost="likelihood",
    )  # fmt: skip
    result = search.search(world, subgoals, start, goal)
    assert float(result.cost) <= found.max(axis=1).max()


def test_what_it_is_not_for_is_refused() -> None:
    world, _ = world_and_frames()
    other = LayerDistance(LayerDistanceConfig(image_size=SIZE, roaming=4))
    with pytest.raises(ValueError, match="distance: of states of length 17, the world's: 14"):
        layer_steps(other, world, Planning())
    with pytest.raises(ValueError, match="cost: 'temporal' needs layers dynamics, got object"):
        layer_steps(network(0), object(), Planning())
    drawn_by = LayerGenerator(LayerGeneratorConfig(image_size=SIZE))
    with pytest.raises(ValueError, match="distance: of states of length 17, the world's: 14"):
        layer_segments(other, StateSubgoals(drawn_by, world))
    with pytest.raises(ValueError, match="segment_model: layers-distance is for layers-generator"):
        layer_segments(network(0), object())


def test_an_evaluation_names_the_distance_only_where_segments_cost_it() -> None:
    likelihood = Evaluation.of("desk", segment_model="my.safetensors")
    assert "segment" not in likelihood.world_names
    assert likelihood.slug == Evaluation.of("desk").slug
    natural = Evaluation.of("desk", segment_cost="distance")
    assert natural.world_names["segment"] == "layers-distance"
    assert natural.slug.endswith("segment-cost-distance")
    mine = Evaluation.of("desk", segment_cost="distance", segment_model="my.safetensors")
    assert mine.world_names["segment"] == "my.safetensors"
    assert mine.slug not in (natural.slug, likelihood.slug)
    direct = Evaluation.of("desk", method="none", segment_cost="distance")
    assert "segment" not in direct.world_names
    assert Evaluation.of("maze", segment_cost="distance").world_names["segment"] == (
        "temporal-distance"
    )
    unnamed = Evaluation.of("desk", segment_cost="distance", dynamics="latent")
    with pytest.raises(ValueError, match=r"segment_model: name one .* none goes with latent"):
        assert unnamed.world_names
