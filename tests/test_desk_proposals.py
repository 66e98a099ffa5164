"""Proposals of subgoals at the desk: the network, what it learns from, and what is made of it."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console
from torch import Tensor

import toy_desk as toy
from hvf.agents.subgoals import Amortised
from hvf.models.checkpoint import load_any, save_model
from hvf.models.layers.dynamics import LayerDynamics
from hvf.models.layers.generator import LayerGenerator, LayerGeneratorConfig
from hvf.models.layers.perception import LayerPerception
from hvf.models.layers.proposals import LayerProposals, ProposalsConfig
from hvf.protocols import Judging, Proposals, Proposing
from hvf.registry import METHODS
from hvf.training.loop import LoopConfig
from hvf.training.recipe import train as train_model
from hvf.training.recipes.layers_proposals import Recombined
from hvf.training.tracks.layers import LayerTracks
from hvf.training.tracks.pairs import StatePairs
from hvf.worlds.layers import LayerWorld
from hvf.worlds.layers_proposals import proposals_of
from hvf.worlds.layers_subgoals import StateSubgoals
from hvf_core import HVF, VisualMPC
from layered_desk import SIZE, random_dynamics

LATENT = 4
SMALL = LayerGeneratorConfig(image_size=toy.SIZE, latent_dim=LATENT, hidden=16)


@pytest.fixture(scope="module")
def perception() -> LayerPerception:
    return toy.seen()[0]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return toy.recorded(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def tracks(data: Path, perception: LayerPerception) -> LayerTracks:
    return LayerTracks(data, perception, toy.EPISODES)


def generator(seed: int, config: LayerGeneratorConfig = SMALL) -> LayerGenerator:
    torch.manual_seed(seed)
    return LayerGenerator(config).requires_grad_(False)


def network(seed: int, drawn_by: LayerGenerator, **sizes: Any) -> LayerProposals:
    torch.manual_seed(seed)
    config = ProposalsConfig(generator=drawn_by.config, **{"hidden": 16, "depth": 1, **sizes})
    return LayerProposals(config).learn_for(drawn_by)


def scenes(seed: int, count: int) -> Tensor:
    """States of the toy, some squares of which are gone."""
    rng = np.random.default_rng(seed)
    states = toy.scattered(rng, count)
    states[:, 7::3] = rng.random((count, 3)) < 0.7
    return torch.from_numpy(states).float()


# ---- the network -------------------------------------------------------------------------------


def test_where_a_part_lay_that_is_gone_from_the_goal_says_nothing() -> None:
    model = network(0, generator(0))
    start, goal = scenes(1, 20), scenes(2, 20)
    other = goal.clone()
    for part in range(3):
        gone = goal[:, 7 + 3 * part] < 0.5
        other[gone, 5 + 3 * part : 7 + 3 * part] = 3.0
    assert not other.equal(goal)
    for found, expected in zip(model(start, other, 1), model(start, goal, 1), strict=True):
        assert found.equal(expected)
    other = goal.clone()
    other[:, 5] += goal[:, 7] * 5
    assert not model(start, other, 1)[0].equal(model(start, goal, 1)[0])


def test_each_proposal_is_made_in_the_scene_that_the_one_before_it_draws() -> None:
    drawn_by = generator(3)
    model = network(3, drawn_by, most=3).requires_grad_(False)
    start, goal = scenes(1, 6), scenes(2, 6)
    noise = torch.randn(6, 3, LATENT)
    latents, log_std = model.chain(drawn_by, start, goal, noise)
    for n in range(6):
        now = start[n : n + 1]
        for k in range(3):
            mean, spread = model(now, goal[n : n + 1], 3 - k)
            expected = mean + spread.exp() * noise[n : n + 1, k]
            torch.testing.assert_close(latents[n : n + 1, k], expected, rtol=1e-4, atol=1e-5)
            torch.testing.assert_close(log_std[n : n + 1, k], spread, rtol=1e-4, atol=1e-5)
            now = drawn_by.decode(latents[n : n + 1, k], now)


def test_hindsight_is_least_at_the_mean_and_deviation_of_what_was_recorded() -> None:
    """A network of one answer: the loss is that of a Gaussian, and best at its moments."""
    drawn_by = generator(0)
    model = network(0, drawn_by)
    latents = 0.5 + 0.3 * torch.randn(400, 1, LATENT)
    path = scenes(1, 1).repeat(400, 1)[:, None].repeat(1, 3, 1)
    optimiser = torch.optim.Adam(model.parameters(), 0.02)
    for _ in range(300):
        optimiser.zero_grad()
        loss, _ = model.hindsight(path, latents)
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
    mean, log_std = model(path[:1, 0], path[:1, -1], 1)
    torch.testing.assert_close(mean[0], latents[:, 0].mean(dim=0), atol=0.03, rtol=0)
    torch.testing.assert_close(log_std[0].exp(), latents[:, 0].std(dim=0), atol=0.03, rtol=0)
    expected = -torch.distributions.Normal(mean, log_std.exp()).log_prob(latents[:, 0])
    assert float(loss.detach()) == pytest.approx(
        float(expected.sum(dim=1).mean().detach()), rel=1e-2
    )


def test_the_best_draws_are_those_whose_hardest_segment_is_easiest() -> None:
    drawn_by = generator(5)
    model = network(5, drawn_by, draws=9, elites=3).requires_grad_(False)
    start, goal = scenes(1, 8), scenes(2, 8)
    noise = torch.randn(8, 9, 2, LATENT)
    path, latents, costs = (x.reshape(8, 3, *x.shape[1:]) for x in model.best(start, goal, noise))
    for n in range(8):
        starts, goals = start[[n] * 9], goal[[n] * 9]
        drawn, _ = model.chain(drawn_by, starts, goals, noise[n])
        first = drawn_by.decode(drawn[:, 0], starts)
        second = drawn_by.decode(drawn[:, 1], first)
        # The posterior sees where a part lies that is gone: where it was.
        end = goals.clone()
        for part in range(3):
            at = slice(5 + 3 * part, 7 + 3 * part)
            end[:, at] = torch.where(goals[:, 7 + 3 * part, None] > 0.5, end[:, at], starts[:, at])
        each = [(starts, first), (first, second), (second, end)]
        hard = torch.stack([drawn_by.surprise(then, now) for now, then in each]).amax(dim=0)
        order = hard.argsort()[:3]
        torch.testing.assert_close(costs[n], hard[order], rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(latents[n], drawn[order], rtol=1e-4, atol=1e-5)
        whole = torch.stack([starts, first, second, goals], dim=1)
        torch.testing.assert_close(path[n], whole[order], rtol=1e-4, atol=1e-4)


def test_following_the_best_draws_finds_better_ones() -> None:
    drawn_by = generator(5)
    model = network(5, drawn_by, hidden=32)
    batch = {"path": torch.stack([scenes(1, 16), scenes(2, 16)], dim=1), "count": torch.tensor(1)}
    random = torch.Generator().manual_seed(0)
    optimiser = torch.optim.Adam(model.parameters(), 0.01)
    costs = []
    for step in range(60):
        optimiser.zero_grad()
        loss, pieces = model.loss(batch, random, step)
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        costs.append(float(pieces["best"]))
    assert np.mean(costs[-10:]) < np.mean(costs[:10])
    assert all(weights.grad is None for weights in drawn_by.parameters())


@pytest.mark.parametrize(
    "wrong", [{"most": 0}, {"hidden": 0}, {"depth": 0}, {"elites": 0}, {"draws": 3}]
)
def test_sizes_out_of_range_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        ProposalsConfig(**wrong)


# ---- what it learns from -----------------------------------------------------------------------


def test_recombined_changes_lead_from_one_state_to_the_next(tracks: LayerTracks) -> None:
    drawn_by = generator(0)
    changes = Recombined(StatePairs(tracks, 16, 0), drawn_by, 2, 4, 5, 0)
    for step in range(4):
        batch, count = changes.batch(step), 1 + step % 2
        path, latents = batch["path"], batch["latents"]
        assert path.shape == (16, count + 2, 14)
        assert latents.shape == (16, count, LATENT)
        for k in range(count):
            assert drawn_by.decode(latents[:, k], path[:, k]).equal(path[:, k + 1])
        again = changes.batch(step)
        assert all(batch[name].equal(again[name]) for name in batch)
    far = [changes.batch(step) for step in range(4, 10)]
    assert [int(batch["count"]) for batch in far] == [1, 2] * 3
    assert all(len(batch["path"]) == 5 for batch in far)
    changed = [batch["path"].shape[1] - 2 - int(batch["count"]) for batch in far]
    assert changed == [2, 2, 0, 0, 1, 1]


def test_what_is_trained_is_loaded_by_its_file_and_the_same_after_a_stop(
    data: Path, perception: LayerPerception, tmp_path: Path
) -> None:
    model = LayerDynamics(toy.TINY).freeze_perception(perception)
    save_model(tmp_path / "dynamics.safetensors", model, environment="desk")
    save_model(tmp_path / "generator.safetensors", generator(0), environment="desk")
    loop = LoopConfig(
        steps=8, learning_rate=1e-3, precision="float32", validate_every=8, checkpoint_every=4
    )
    draw = Recombined.batch

    def train(name: str) -> None:
        train_model(
            "layers-proposals", data, dynamics=tmp_path / "dynamics.safetensors",
            generator=tmp_path / "generator.safetensors", out=tmp_path / name, batch_size=8,
            hindsight_steps=4, model=ProposalsConfig(hidden=8, depth=1), loop=loop,
            console=Console(file=io.StringIO()),
        )  # fmt: skip

    def die(sampler: Recombined, step: int) -> object:
        if step == 6:
            raise MemoryError("killed")
        return draw(sampler, step)

    train("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Recombined, "batch", die)
        with pytest.raises(MemoryError):
            train("died")
    train("died")
    whole, died = (load_any(tmp_path / name / "model.safetensors") for name in ("whole", "died"))
    assert whole.name == "layers-proposals"
    for name, value in whole.module.state_dict().items():
        assert value.equal(died.module.state_dict()[name]), name
    validation = whole.header.training["validation"]
    assert {"means_1", "best_2", "changes_2"} <= validation.keys()


# ---- what is made of it ------------------------------------------------------------------------


def proposing() -> tuple[LayerWorld, Any, Any, Any]:
    world = LayerWorld(random_dynamics())
    drawn_by = generator(3, LayerGeneratorConfig(image_size=SIZE, latent_dim=LATENT, hidden=16))
    frames = world.observe(
        np.random.default_rng(1).integers(0, 256, (2, SIZE, SIZE, 3), dtype=np.uint8)
    )
    trained = proposals_of(network(3, drawn_by))
    assert isinstance(trained, Proposals)
    return world, trained.of(StateSubgoals(drawn_by, world)), frames[[0]], frames[[1]]


def test_a_search_from_proposals_begins_with_the_mean_of_each_subgoal() -> None:
    world, subgoals, start, goal = proposing()
    assert isinstance(subgoals, Proposing)
    assert isinstance(subgoals, Judging)
    mean, std = subgoals.proposals(start, goal, 2)
    assert mean.shape == std.shape == (2, LATENT)
    assert (std > 0).all()
    asked = []
    costs = subgoals.segment_costs
    subgoals.segment_costs = lambda *given: asked.append(given[2].copy()) or costs(*given)
    search = HVF(
        mpc=VisualMPC(samples=8, elites=2, iterations=1), samples=2000, elites=5, iterations=1,
        segment_cost="likelihood",
    )  # fmt: skip
    search.search(world, subgoals, start, goal)
    np.testing.assert_allclose(asked[0].mean(axis=0), mean, atol=0.15)
    np.testing.assert_allclose(asked[0].std(axis=0), std, rtol=0.1)
    with pytest.raises(ValueError, match="subgoals: must be from 1 to 2, got 3"):
        subgoals.proposals(start, goal, 3)


class OneTrial:
    """A trial that shows a start, and has a goal."""

    def __init__(self, start: Any, goal: Any) -> None:
        self.goals, self._start = goal, start

    def __len__(self) -> int:
        return 1

    def observe(self, which: Any) -> Any:
        return self._start


@pytest.mark.parametrize("reduction", ["max", "mean", "max-sum"])
def test_amortised_subgoals_are_the_best_of_a_few_draws(reduction: Any) -> None:
    world, subgoals, start, goal = proposing()

    def search(count: int) -> HVF:
        return HVF(subgoals=count, reduction=reduction)

    trials: Any = OneTrial(start.images, goal.images)
    for draws in (1, 50):
        found = Amortised(search, 2, world, subgoals, draws)(trials, 0, seed=4)
        mean, std = subgoals.proposals(start, goal, 2)
        noise = np.random.default_rng(4).standard_normal((draws, 2, LATENT))
        noise[0] = 0
        latents = (mean + std * noise).astype(np.float32)
        segments = np.asarray(subgoals.segment_costs(start, goal, latents))
        costs = {
            "max": segments.max(axis=1),
            "mean": segments.mean(axis=1),
            "max-sum": segments.max(axis=1) + 0.1 * segments.sum(axis=1),
        }[reduction]
        best = latents[[costs.argmin()]]
        np.testing.assert_allclose(found.states, subgoals.decode(start, best).states, atol=1e-5)


def test_proposals_for_another_generator_are_refused() -> None:
    world, _, _, _ = proposing()
    other = LayerGeneratorConfig(image_size=SIZE, latent_dim=LATENT, hidden=17)
    trained = proposals_of(network(3, generator(3)))
    with pytest.raises(ValueError, match="method_model: these proposals are for another generator"):
        trained.of(StateSubgoals(generator(0, other), world))
    with pytest.raises(ValueError, match="layers-proposals is for layers-generator, got object"):
        trained.of(object())
    with pytest.raises(ValueError, match="is not the one that these proposals are for"):
        network(3, generator(3)).learn_for(generator(0, other))


def test_both_methods_ask_for_proposals() -> None:
    assert {METHODS[name].asks for name in ("hvf-proposals", "amortised")} == {"layers-proposals"}
