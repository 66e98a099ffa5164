"""The paper's temporal distance: its network, loss and batches, and the cost made of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from numpy.typing import NDArray
from rich.console import Console

import hvf_core
from hvf.data.episodes import Episodes, Metadata
from hvf.data.formats.hdf5 import write_episodes
from hvf.data.loader import EpisodePool
from hvf.data.temporal import PartnersSampler
from hvf.evaluation.evaluation import Evaluation
from hvf.evaluation.run import evaluate
from hvf.models.checkpoint import load_model, save_model
from hvf.models.frames import to_unit
from hvf.models.keypoint.dynamics import KeypointDynamics
from hvf.models.tdm import TDM, TDMConfig
from hvf.models.vae import VAE
from hvf.models.vae_config import DESK_VAE
from hvf.protocols import Judging, Remembering
from hvf.registry import COSTS, DOMAINS, MODELS
from hvf.settings import Planning
from hvf.training.loop import LoopConfig, seeded
from hvf.training.recipe import train
from hvf.training.recipes.tdm import TDMRecipe
from hvf.worlds.distances import FarDistance, ImageDistanceWorld, tdm_of, tdm_world
from hvf.worlds.keypoint import KeypointWorld

QUIET = Console(quiet=True)
SMALL = TDMConfig(image_size=(16, 20), channels=(4, 8), layers=(16, 8))
SIZE = (16, 20)


def frames(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).integers(0, 256, (*shape, 3), np.uint8))


def small(config: TDMConfig = SMALL) -> TDM:
    return seeded(0, lambda: TDM(config)).eval()


def far(logits: torch.Tensor) -> NDArray[Any]:
    """The probability of the first of two classes, written out."""
    e = np.exp(logits.detach().double().numpy())
    return np.asarray(e[:, 0] / e.sum(1))


# ---- the network -------------------------------------------------------------------------------


def test_the_network_has_the_released_codes_layers_and_parameters() -> None:
    model = TDM(TDMConfig())
    assert sum(weights.numel() for weights in model.parameters()) == 1_115_346
    widths = [layer.out_features for layer in model.layers if hasattr(layer, "out_features")]
    assert widths == [512, 512, 256, 128, 2]
    kinds = [type(layer).__name__ for layer in model.encoder]
    assert kinds == ["Conv2d", "ReLU"] * 3 + ["Conv2d"]
    assert model.encoder(torch.zeros(1, 6, 64, 64)).shape == (1, 128, 3, 3)


def test_the_cost_is_the_probability_of_far_and_sees_both_images() -> None:
    model = small()
    a, b = (to_unit(frames(5, *SIZE, seed=seed)) for seed in (1, 2))
    with torch.no_grad():
        found = model(a, b)
        np.testing.assert_allclose(found, far(model.logits(a, b)), rtol=1e-5)
        assert not torch.allclose(found, model(b, a))
    assert ((found > 0) & (found < 1)).all()


def test_the_loss_is_the_released_codes_written_out() -> None:
    model = small(TDMConfig(image_size=SIZE, channels=(4, 8), layers=(16, 8), mixup=0.5))
    batch = {name: frames(4, *SIZE, seed=i) for i, name in enumerate(("anchor", "first", "second"))}
    batch["steps"] = torch.tensor([[0, 3], [-2, 2], [-3, 30], [29, -1]])
    loss, said = model.loss(batch, torch.Generator().manual_seed(7), 0)
    draws = torch.Generator().manual_seed(7)
    s1, s2, s3 = (
        to_unit(batch[name]) + torch.rand(4, 3, *SIZE, generator=draws) * 0.1 - 0.05
        for name in ("anchor", "first", "second")
    )
    share = torch.rand(4, 1, generator=draws)
    near = np.array([[1, 0], [1, 1], [0, 0], [0, 1]])  # |dt| < 3
    f2, f3 = model.logits(s1, s2), model.logits(s1, s3)
    mix = share[:, :, None, None]
    between = model.logits(s1, mix * s2 + (1 - mix) * s3)
    entropy = 0.0
    for column, logits in enumerate((f2, f3)):
        p = far(logits)
        entropy -= np.log(np.where(near[:, column] == 1, 1 - p, p)).mean()
    bent = ((between - (share * f2 + (1 - share) * f3)) ** 2).sum(1).mean().item()
    assert loss.item() == pytest.approx(entropy + 0.5 * bent, rel=1e-4)
    assert said["mixup"].item() == pytest.approx(bent, rel=1e-3)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"image_size": (30, 64)}, "image_size must be"),
        ({"channels": ()}, "channels must be positive"),
        ({"layers": (0,)}, "layers must be positive"),
        ({"near": 0}, "near must be at least 1"),
        ({"noise": -0.1}, "noise must not be negative"),
        ({"mixup": float("nan")}, "mixup must not be negative"),
    ],
)
def test_a_config_that_cannot_be_is_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TDMConfig(**settings)


def test_images_of_another_size_are_refused_by_name() -> None:
    model, good = small(), torch.zeros(2, 3, *SIZE)
    with pytest.raises(ValueError, match=r"first: expected shape \[B, 3, 16, 20\]"):
        model(torch.zeros(2, 3, 16, 16), good)
    with pytest.raises(ValueError, match="second: must be 2 images, as many as first; got 1"):
        model(good, good[:1])


# ---- batches -----------------------------------------------------------------------------------


def file_of(path: Path, lengths: list[int]) -> Path:
    """Episodes whose frames say which they are: red is the episode, green the time."""
    count, steps = len(lengths), max(lengths)
    seen = np.zeros((count, steps + 1, 2, 3, 3), np.uint8)
    seen[..., 0] = np.arange(count)[:, None, None, None]
    seen[..., 1] = np.arange(steps + 1)[None, :, None, None]
    episodes = Episodes(seen, np.zeros((count, steps, 1), np.float32), lengths=np.array(lengths))
    write_episodes(path, Metadata("own", {}, 0, steps, count, {}), episodes)
    return path


@given(
    lengths=st.lists(st.integers(1, 60), min_size=2, max_size=5),
    furthest=st.integers(1, 40),
    seed=st.integers(0, 2**31),
)
@settings(max_examples=30, deadline=None)
def test_partners_are_in_the_episode_and_as_far_as_they_say(
    tmp_path_factory: pytest.TempPathFactory, lengths: list[int], furthest: int, seed: int
) -> None:
    folder = tmp_path_factory.mktemp("partners")
    pool = EpisodePool(file_of(folder / "own.h5", [*lengths, 1]), seed=seed)
    sampler = PartnersSampler(pool, 100, furthest, seed)
    batch = {name: tensor.numpy() for name, tensor in sampler.batch(5).items()}
    again = sampler.batch(5)
    pool.close()
    assert all((again[name].numpy() == batch[name]).all() for name in batch)
    anchor = batch["anchor"][:, 0, 0].astype(int)
    for column, name in enumerate(("first", "second")):
        other = batch[name][:, 0, 0].astype(int)
        np.testing.assert_array_equal(other[:, 0], anchor[:, 0])
        np.testing.assert_array_equal(other[:, 1] - anchor[:, 1], batch["steps"][:, column])
        assert (abs(batch["steps"][:, column]) <= furthest).all()
        assert (other[:, 1] <= np.array(lengths)[anchor[:, 0]]).all()


def test_steps_have_the_distribution_of_the_released_code(tmp_path: Path) -> None:
    pool = EpisodePool(file_of(tmp_path / "own.h5", [99] * 3))
    batch = PartnersSampler(pool, 20_000).batch(0)
    pool.close()
    found = np.bincount(batch["steps"].numpy().ravel() + 30, minlength=61) / 40_000
    # utils.py: tstep2 = (tstep1 + uniform(-30, 30)).clip(0, last).astype(uint8)
    rng = np.random.default_rng(1)
    anchors = rng.integers(0, 100, 200_000)
    others = (anchors + rng.uniform(-30, 30, 200_000)).clip(0, 99).astype(np.uint8).astype(int)
    expected = np.bincount(others - anchors + 30, minlength=61) / 200_000
    assert abs(found - expected).max() < 5 * np.sqrt(expected.max() / 40_000 * 2)


# ---- the cost ----------------------------------------------------------------------------------


class Slide:
    """A world whose frames are images; an action adds itself to all pixels, and is seen at once."""

    action_low, action_high = np.full(1, -9, np.float32), np.full(1, 9, np.float32)

    class Seen:
        def __init__(self, images: NDArray[np.uint8]) -> None:
            self.images = images

        def __len__(self) -> int:
            return len(self.images)

        def __getitem__(self, index: Any) -> Slide.Seen:
            return Slide.Seen(self.images[index])

    def observe(self, images: NDArray[np.uint8]) -> Slide.Seen:
        return Slide.Seen(images)

    def predict(self, starts: Slide.Seen, actions: NDArray[np.float32]) -> NDArray[np.uint8]:
        moved = starts.images[:, None] + actions.cumsum(1)[..., None, None]
        return np.rint(moved).clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("over_horizon", ["last", "sum", "min"])
def test_any_world_that_draws_can_be_planned_with(over_horizon: Any) -> None:
    model, world = small(), Slide()
    planned = tdm_world(world, model, Planning(over_horizon=over_horizon))
    starts, goals = (world.observe(frames(2, *SIZE, seed=seed).numpy()) for seed in (1, 2))
    actions = np.random.default_rng(0).uniform(-9, 9, (2, 5, 3, 1)).astype(np.float32)
    found = planned.rollout_costs(starts, goals, actions)
    expected = np.zeros((2, 5))
    with torch.no_grad():
        for b in range(2):
            goal = to_unit(torch.from_numpy(goals.images[b : b + 1]))
            for d in range(5):
                image, costs = starts.images[b].astype(float), []
                for h in range(3):
                    image = image + actions[b, d, h]
                    seen = np.rint(image).clip(0, 255).astype(np.uint8)
                    costs.append(model(to_unit(torch.from_numpy(seen)[None]), goal).item())
                expected[b, d] = {"last": costs[-1], "sum": sum(costs), "min": min(costs)}[
                    over_horizon
                ]
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    assert planned.action_high == 9
    # The same for each problem alone, to the last bit.
    alone = [
        planned.rollout_costs(starts[[b]], goals[[b]], actions[b : b + 1])[0] for b in range(2)
    ]
    np.testing.assert_array_equal(np.stack(alone), found)
    # And through the planner.
    mpc = hvf_core.VisualMPC(horizon=2, samples=8, elites=3, iterations=2)
    plan = mpc.plan(planned, starts.images[0], goals.images[0], seed=1)
    assert plan.actions.shape == (2, 1)


@pytest.mark.parametrize("seen", [lambda images: images, Slide.Seen])
def test_segments_of_any_generator_can_be_judged(seen: Any) -> None:
    class Shades:
        """Draws the scene, lighter or darker."""

        latent_dim = 1

        def decode(self, scene: Any, latents: NDArray[np.float32]) -> Any:
            light = 40 * latents.reshape(-1, 1, 1, 1)
            shown = np.asarray(getattr(scene, "images", scene)) + light
            return seen(np.rint(shown).clip(0, 255).astype(np.uint8))

    model = small()
    subgoals = MODELS["tdm"].resolved("judge")(model, Shades())
    assert isinstance(subgoals, Judging)
    start, goal = (frames(1, *SIZE, seed=seed).numpy() for seed in (1, 2))
    # More samples than are measured at once.
    latents = np.random.default_rng(0).normal(size=(70, 2, 1)).astype(np.float32)
    found = subgoals.segment_costs(seen(start), seen(goal), latents)
    assert found.shape == (70, 3)
    drawn = Shades().decode(start, latents)
    drawn = np.asarray(getattr(drawn, "images", drawn)).reshape(70, 2, *start.shape[1:])
    with torch.no_grad():
        for sample in range(70):
            path = [to_unit(torch.from_numpy(x)) for x in (start, *drawn[sample][:, None], goal)]
            expected = [model(path[k], path[k + 1]).item() for k in range(3)]
            np.testing.assert_allclose(found[sample], expected, rtol=1e-4)
    search = hvf_core.HVF(
        mpc=hvf_core.VisualMPC(horizon=2, samples=8, elites=3, iterations=1), samples=20, elites=4,
        iterations=2, segment_cost="likelihood",
    )  # fmt: skip
    result = search.search(tdm_world(Slide(), model, Planning()), subgoals, start[0], goal[0])
    assert float(result.cost) <= found.max()


def test_noise_and_memory_are_those_of_the_world_inside() -> None:
    class Drift(Slide):
        """Moves by chance, too; remembers."""

        uses_seeds, context = True, 2

        def predict(self, starts: Any, actions: Any, seeds: Any = None) -> Any:
            chance = np.stack([np.random.default_rng(s).uniform(-9, 9, 1) for s in seeds])
            return super().predict(starts, actions + chance[:, None])

        def observe_history(self, images: Any, actions: Any) -> Any:
            assert actions.shape == (len(images), 1, 1)
            return Slide.Seen(images[:, -1])

    model, world = small(), Drift()
    planned = tdm_world(world, model, Planning())
    assert isinstance(planned, Remembering)
    assert not isinstance(tdm_world(Slide(), model, Planning()), Remembering)
    images = frames(3, 2, *SIZE).numpy()
    starts = planned.observe_history(images, np.zeros((3, 1, 1), np.float32))
    goals = world.observe(frames(3, *SIZE, seed=1).numpy())
    actions = np.random.default_rng(0).uniform(-9, 9, (3, 4, 2, 1)).astype(np.float32)
    seeds = np.arange(12).reshape(3, 4)
    found = planned.rollout_costs(starts, goals, actions, seeds=seeds)  # type: ignore[call-arg]
    seen = world.predict(starts[np.full(4, 1)], actions[1], seeds[1])[:, -1]
    with torch.no_grad():
        aim = to_unit(torch.from_numpy(goals.images[[1] * 4]))
        expected = model(to_unit(torch.from_numpy(seen)), aim)
    np.testing.assert_allclose(found[1], expected, rtol=1e-5)
    mpc = hvf_core.VisualMPC(horizon=2, samples=8, elites=3, iterations=2)
    alone = mpc.plan(planned, starts.images[0], goals.images[0], seed=1)
    both = mpc.plan_batch(planned, starts.images[:2], goals.images[:2], seeds=[1, 2])
    np.testing.assert_array_equal(alone.actions, both.actions[0])


def test_the_keypoint_world_draws_only_what_counts() -> None:
    path = DOMAINS["maze"].weights["keypoint"]
    world = KeypointWorld(load_model(path, KeypointDynamics))
    images = hvf_core.maze_collect(5, 0, 2, 1)[0][:, 0]
    seen = world.observe(images)
    start, goal = seen[np.array([0])], seen[np.array([1])]
    actions = np.random.default_rng(0).uniform(-3, 3, (1, 4, 3, 2)).astype(np.float32)
    repeated = start[np.zeros(4, np.int64)]
    path = world.rollout(start, actions)
    all_steps = world.drawn(start, path)[0]
    assert all_steps.shape == (4, 3, 3, 64, 64)
    copies = world.drawn(repeated, world.rollout(repeated, actions[0][:, None]))
    torch.testing.assert_close(copies[:, 0], all_steps, rtol=0, atol=0)
    last = world.drawn(start, path[:, :, -1:])[0]
    torch.testing.assert_close(last[:, 0], all_steps[:, -1], rtol=0, atol=0)
    np.testing.assert_array_equal(
        world.predict(repeated, actions[0])[:, 1],
        (all_steps[:, 1].clamp(0, 1) * 255).round().byte().permute(0, 2, 3, 1),
    )
    model = small(TDMConfig(channels=(4, 4, 8, 8), layers=(8,)))
    found = ImageDistanceWorld(world, FarDistance(model), "last").rollout_costs(
        start, goal, actions
    )
    with torch.no_grad():
        aim = to_unit(torch.from_numpy(images[1:])).expand(4, -1, -1, -1)
        expected = model(last[:, 0].clamp(0, 1), aim)
    np.testing.assert_allclose(found[0], expected, rtol=1e-4)


def test_worlds_and_models_that_cannot_are_named() -> None:
    class Blank:
        """Draws nothing."""

    with pytest.raises(ValueError, match="cost: 'tdm' needs dynamics that draw frames, got Blank"):
        tdm_of(small(), Blank(), Planning())
    with pytest.raises(ValueError, match="cost: 'tdm' needs a tdm model, got VAE"):
        tdm_world(Slide(), VAE(DESK_VAE), Planning())


def test_the_cost_is_evaluated_by_name(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    save_model(path, small(TDMConfig(channels=(4, 4, 8, 8), layers=(8,))), environment="maze")
    settings = {
        "cost": "tdm", "method": "none", "subgoals": 0, "samples": 8, "elites": 3, "iterations": 1,
        "horizon": 2, "steps": 2,
    }  # fmt: skip
    report = evaluate(Evaluation.of("maze", cost_model=str(path), **settings), 2, console=QUIET)
    assert report.world["cost"] == "tdm"
    assert report.weights["cost"]["model"] == "tdm"
    assert "tdm" in COSTS
    assert MODELS["tdm"].role == "distance"


# ---- training ----------------------------------------------------------------------------------


def test_the_papers_preset_is_the_released_training() -> None:
    recipe = TDMRecipe.of("paper", data=Path("x.h5"))
    assert (recipe.batch_size, recipe.furthest, recipe.model) == (256, 30, TDMConfig())
    loop = recipe.loop
    assert (loop.steps, loop.learning_rate, loop.schedule) == (10_000, 1e-3, "constant")
    assert (loop.warmup_steps, loop.weight_decay, loop.clip_norm) == (0, 0, 0)


def test_training_tells_near_from_far_and_repeats_to_the_bit(tmp_path: Path) -> None:
    """A dot that goes one pixel a step: how far apart two frames are can be seen."""
    rng = np.random.default_rng(0)
    episodes, steps = 24, 15
    seen = np.zeros((episodes, steps + 1, 16, 20, 3), np.uint8)
    for episode in range(episodes):
        row, time = rng.integers(1, 14), np.arange(steps + 1)
        for t in time:
            seen[episode, t, row : row + 2, t : t + 3] = 255
    data = tmp_path / "dots.h5"
    actions = np.zeros((episodes, steps, 1), np.float32)
    write_episodes(data, Metadata("own", {}, 0, steps, episodes, {}), Episodes(seen, actions))
    settings: dict[str, Any] = {
        "console": QUIET, "model": SMALL, "furthest": 8,
        "loop": LoopConfig(
            steps=300, learning_rate=3e-3, validate_every=150, device="cpu", threads=1
        ),
    }  # fmt: skip
    models = [train("tdm", data, out=tmp_path / out, **settings) for out in ("one", "two")]
    first, second = (model.state_dict() for model in models)
    assert all(torch.equal(first[name], second[name]) for name in first)
    images = to_unit(torch.from_numpy(seen[-1]))
    with torch.no_grad():
        apart = [
            float(models[0](images[: steps + 1 - dt], images[dt:]).mean()) for dt in (0, 1, 6, 8)
        ]
    assert max(apart[:2]) < 0.5 < min(apart[2:]), apart


def test_images_that_are_too_small_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"own\.h5: the model cannot take its images"):
        train("tdm", file_of(tmp_path / "own.h5", [5] * 3), out=tmp_path / "run", console=QUIET)
