"""RIG: TD3 against slow code, hindsight goals, acting while learning, and the method."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from numpy.typing import NDArray
from rich.console import Console

import firefly
from blind import Blind
from hvf.cli import main
from hvf.data.episodes import Episodes, Metadata
from hvf.data.formats.hdf5 import write_episodes
from hvf.domains.domain import Place
from hvf.evaluation.evaluation import Evaluation
from hvf.evaluation.run import evaluate
from hvf.evaluation.task import Task
from hvf.models.checkpoint import load_model
from hvf.models.rig import RIG, RIGConfig
from hvf.models.vae import VAE, CVAEConfig
from hvf.models.vae_config import RIG_VAE
from hvf.registry import DOMAINS, MODELS
from hvf.training.exploring import Exploration, Explorer
from hvf.training.loop import Interactive, LoopConfig, seeded
from hvf.training.recipe import train
from hvf.training.recipes.rig import RIGRecipe
from hvf.training.recipes.vae import VAERecipe
from hvf.training.replay import Relabelling, Replay
from hvf.worlds.policy import LatentPolicy

QUIET = Console(quiet=True)
SMALL_VAE = dataclasses.replace(
    RIG_VAE, image_size=(16, 16), channels=(8, 16), strides=(2, 2), latent_dim=2, centred=True,
    pyramid_levels=2, pyramid_weight=1.0,
)  # fmt: skip
SMALL = RIGConfig(SMALL_VAE, (-2.0, -2.0), (2.0, 2.0), layers=(32, 16))
PLANE = firefly.MEADOW


def small(config: RIGConfig = SMALL, seed: int = 0) -> RIG:
    return seeded(seed, lambda: RIG(config)).eval()


def transitions(size: int = 6, seed: int = 0, config: RIGConfig = SMALL) -> dict[str, torch.Tensor]:
    rng = np.random.default_rng(seed)
    latent = config.vae.latent_dim
    batch = {name: rng.normal(size=(size, latent)) for name in ("latent", "after", "goal")}
    batch["action"] = rng.uniform(-1, 1, (size, len(config.action_low)))
    return {name: torch.from_numpy(x.astype(np.float32)) for name, x in batch.items()}


# ---- TD3 ---------------------------------------------------------------------------------------


def dense(network: torch.nn.Module, x: NDArray[Any]) -> NDArray[Any]:
    """Linear layers with ReLU between them, one number after the other."""
    layers = [layer for layer in network if isinstance(layer, torch.nn.Linear)]  # type: ignore[attr-defined]
    for number, layer in enumerate(layers):
        w, b = layer.weight.detach().double().numpy(), layer.bias.detach().double().numpy()
        out = np.zeros((len(x), len(w)))
        for n, o in itertools.product(range(len(x)), range(len(w))):
            out[n, o] = b[o] + sum(w[o, i] * x[n, i] for i in range(x.shape[1]))
        x = out if number == len(layers) - 1 else np.maximum(out, 0)
    return x


def test_targets_are_td3s_written_out() -> None:
    model = small(dataclasses.replace(SMALL, discount=0.9))
    with torch.no_grad():  # The targets are other networks than those that learn.
        for weights in [*model.target_policy.parameters(), *model.target_critics.parameters()]:
            weights += 0.3 * torch.randn(weights.shape, generator=torch.Generator().manual_seed(3))
    batch = transitions()
    noise = np.random.default_rng(5).normal(0, 0.2, (6, 2)).clip(-0.5, 0.5)
    found = model.targets(batch, torch.from_numpy(noise.astype(np.float32)))
    after, goal = (batch[name].double().numpy() for name in ("after", "goal"))
    seen = np.concatenate([after, goal], axis=1)
    done = np.concatenate([seen, np.tanh(dense(model.target_policy, seen)) + noise], axis=1)
    values = np.stack([dense(critic, done)[:, 0] for critic in model.target_critics])
    expected = -np.sqrt(((after - goal) ** 2).sum(1)) + 0.9 * values.min(0)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    assert (values.argmin(0) == 0).any()
    assert (values.argmin(0) == 1).any()


def test_steps_are_those_of_networks_with_optimisers_of_their_own() -> None:
    """Nine steps, against three optimisers, targets moved after each step of the policy."""
    config = dataclasses.replace(SMALL, tau=0.1, delay=3)
    model, other = small(config), small(config)
    learning = [weights for weights in model.parameters() if weights.requires_grad]
    together = torch.optim.AdamW(learning, 1e-2, weight_decay=0)
    apart = [
        torch.optim.Adam(network.parameters(), 1e-2) for network in (other.policy, *other.critics)
    ]
    for step in range(9):
        batch = transitions(seed=step)
        together.zero_grad()
        model.loss(batch, torch.Generator().manual_seed(step), step)[0].backward()
        together.step()
        # The other way: all gradients from before this step, each network by itself.
        draw = torch.randn((6, 2), generator=torch.Generator().manual_seed(step))
        aims = other.targets(batch, (0.2 * draw).clamp(-0.5, 0.5))
        seen = torch.cat([batch["latent"], batch["goal"]], 1)
        gradients = []
        if step % 3 == 0:
            worth = -other.critics[0](torch.cat([seen, other.act(seen[:, :2], seen[:, 2:])], 1))
            policy = list(other.policy.parameters())
            gradients.append((policy, torch.autograd.grad(worth.mean(), policy)))
        for critic in other.critics:
            value = critic(torch.cat([seen, batch["action"]], 1))[:, 0]
            weights = list(critic.parameters())
            gradients.append((weights, torch.autograd.grad(((value - aims) ** 2).mean(), weights)))
        for weights, found in gradients:
            for weight, gradient in zip(weights, found, strict=True):
                weight.grad = gradient
        for optimiser in apart if step % 3 == 0 else apart[1:]:
            optimiser.step()
        if step % 3 == 0:
            with torch.no_grad():
                for target, network in (
                    (other.target_policy, other.policy),
                    (other.target_critics, other.critics),
                ):
                    for old, new in zip(target.parameters(), network.parameters(), strict=True):
                        old.copy_(0.9 * old + 0.1 * new)
    one, two = model.state_dict(), other.state_dict()
    for name in one:
        torch.testing.assert_close(one[name], two[name], rtol=1e-4, atol=1e-6, msg=name)


def test_the_networks_are_rlkits() -> None:
    model = RIG(RIGConfig())
    widths = [w.shape for name, w in model.policy.named_parameters() if "weight" in name]
    assert widths == [(400, 8), (300, 400), (2, 300)]
    widths = [w.shape for name, w in model.critics[1].named_parameters() if "weight" in name]
    assert widths == [(400, 10), (300, 400), (1, 300)]
    assert abs(model.act(torch.randn(9, 4), torch.randn(9, 4))).max() < 0.2
    config = model.config
    assert (config.discount, config.tau, config.target_noise) == (0.99, 0.005, 0.2)
    assert (config.noise_clip, config.delay) == (0.5, 2)
    learning = {name.split(".")[0] for name, w in model.named_parameters() if w.requires_grad}
    assert learning == {"policy", "critics"}


def test_actions_go_from_one_edge_of_the_box_to_the_other() -> None:
    model = small(dataclasses.replace(SMALL, action_low=(0.0, -3.0), action_high=(1.0, 5.0)))
    edges = torch.tensor([[-1.0, -1.0], [0.0, 0.0], [1.0, 1.0]])
    assert model.in_the_box(edges).tolist() == [[0, -3], [0.5, 1], [1, 5]]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"vae": CVAEConfig()}, "vae: must not be conditional"),
        ({"action_low": (1.0, 2.0)}, "action_low must be below"),
        ({"action_high": (1.0,)}, "action_low must be below"),
        ({"layers": ()}, "layers must be positive"),
        ({"discount": 1.0}, "discount must be"),
        ({"tau": 0.0}, "tau must be"),
        ({"target_noise": -1.0}, "target_noise must not be negative"),
        ({"delay": 0}, "delay must be at least 1"),
    ],
)
def test_a_config_that_cannot_be_is_refused(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(SMALL, **changed)


def test_a_vae_of_another_config_is_refused() -> None:
    vae = VAE(dataclasses.replace(SMALL_VAE, latent_dim=3))
    with pytest.raises(ValueError, match="vae: must have the config"):
        small().see_with(vae)


# ---- hindsight ---------------------------------------------------------------------------------


def filled(lengths: list[int], capacity: int = 10**6, steps: int = 9) -> Replay:
    """Paths whose latents say which they are, and when: (path, time)."""
    replay = Replay(capacity, steps, 2, 1)
    for path, length in enumerate(lengths):
        place = np.array([[path, 0]], np.float32)
        slots = replay.begin(place, np.array([[1000 + path, -1]], np.float32))
        for step in range(length):
            place = place + np.array([[0, 1]], np.float32)
            replay.add(slots, np.array([[step / 10]], np.float32), place)
    return replay


@given(
    lengths=st.lists(st.integers(0, 9), min_size=1, max_size=8),
    size=st.integers(1, 200),
    rollout=st.floats(0, 1),
    prior=st.floats(0, 1),
    seed=st.integers(0, 2**31),
)
@settings(max_examples=60, deadline=None)
def test_goals_are_put_in_place_in_the_parts_that_were_asked_for(
    lengths: list[int], size: int, rollout: float, prior: float, seed: int
) -> None:
    if rollout + prior > 1:
        with pytest.raises(ValueError, match="rollout and prior must be at most 1"):
            Relabelling(rollout, prior)
        return
    relabelling = Relabelling(rollout, prior)
    replay = filled(lengths)
    assert len(replay) == sum(lengths)
    if not sum(lengths):
        with pytest.raises(ValueError, match="there are no transitions yet"):
            replay.sample(size, relabelling, np.random.default_rng(seed))
        return
    batch = replay.sample(size, relabelling, np.random.default_rng(seed))
    latent, after, goal, action = (
        batch[name].double().numpy() for name in ("latent", "after", "goal", "action")
    )
    kept, imagined, future = relabelling.counts(size)
    assert (kept, imagined) == (int(size * rollout), int(size * prior))
    assert kept + imagined + future == size
    path, time = latent.T.astype(int)
    assert (time < np.array(lengths)[path]).all()
    np.testing.assert_array_equal(after, latent + np.array([0, 1]))
    np.testing.assert_allclose(action[:, 0], time / 10, atol=1e-6)
    np.testing.assert_array_equal(goal[:kept, 0], 1000 + path[:kept])
    late = slice(kept + imagined, size)
    np.testing.assert_array_equal(goal[late, 0], path[late])
    assert (goal[late, 1] > time[late]).all()
    assert (goal[late, 1] <= np.array(lengths)[path[late]]).all()


def test_the_parts_are_rigs_and_its_imagined_goals_are_standard_normal() -> None:
    assert Relabelling().counts(128) == (12, 64, 52)
    replay = filled([9] * 5)
    batch = replay.sample(20_000, Relabelling(), np.random.default_rng(0))
    imagined = batch["goal"][2000:12_000].double().numpy()
    assert abs(imagined.mean(0)).max() < 0.05
    assert abs(np.cov(imagined.T) - np.eye(2)).max() < 0.05
    # Every later time of a path is as likely, its own end too.
    late = slice(12_000, 20_000)
    ahead = (batch["goal"][late, 1] - batch["latent"][late, 1])[batch["latent"][late, 1] == 5]
    counts = np.bincount(ahead.long().numpy(), minlength=5)[1:]
    assert len(counts) == 4
    assert abs(counts / counts.sum() - 0.25).max() < 0.1
    # And every transition.
    where = (batch["latent"] @ torch.tensor([9.0, 1.0])).long().numpy()
    assert abs(np.bincount(where, minlength=45) / 20_000 - 1 / 45).max() < 0.01


def test_the_oldest_paths_are_forgotten_and_all_else_survives_a_copy() -> None:
    replay = filled([9, 8, 7, 6, 5], capacity=27)  # three paths of nine steps
    batch = replay.sample(500, Relabelling(), np.random.default_rng(1))
    assert set(batch["latent"][:, 0].tolist()) == {2, 3, 4}
    copy = Replay(27, 9, 2, 1)
    copy.recall(replay.memory())
    again = copy.sample(500, Relabelling(), np.random.default_rng(1))
    assert all(torch.equal(batch[name], again[name]) for name in batch)
    for each in (replay, copy):
        each.begin(np.full((1, 2), 9, np.float32), np.zeros((1, 2), np.float32))
        assert len(each) == 6 + 5
    with pytest.raises(ValueError, match="replay: latents has shape"):
        Replay(27, 8, 2, 1).recall(replay.memory())
    with pytest.raises(ValueError, match="capacity: keeps 3 paths, 4 are begun"):
        replay.begin(np.zeros((4, 2), np.float32), np.zeros((4, 2), np.float32))


# ---- acting while learning ---------------------------------------------------------------------


class Watched(Place):
    """The meadow; keeps what trials were made and what was done in them."""

    def __init__(self) -> None:
        self.made: list[tuple[str, int, int, int]] = []
        self.done: list[tuple[list[int], NDArray[Any]]] = []

    def trials(self, task: str, seed: int, first: int, count: int) -> Any:
        self.made.append((task, seed, first, count))
        inside = PLANE.open_with(0).trials(task, seed, first, count)
        place = self

        class Noted:
            def __len__(self) -> int:
                return len(inside)

            def step(self, which: Any, actions: Any) -> Any:
                place.done.append((which.tolist(), actions))
                return inside.step(which, actions)

            def __getattr__(self, name: str) -> Any:
                assert name in ("observe", "success"), f"read {name}"
                return getattr(inside, name)

        return Noted()


def explorer(place: Place, model: RIG | None = None, **changed: Any) -> Explorer:
    exploration = dataclasses.replace(
        Exploration(trials=4, steps_before=20, updates_per_step=2, path_steps=6), **changed
    )
    tasks = [("near", 6), ("far", 6)]
    return Explorer(model or small(), place, tasks, exploration, Relabelling(), 32, 7, 99)


def test_trials_act_as_often_as_updates_ask_for_and_tasks_take_turns() -> None:
    place = Watched()
    sampler = explorer(place)
    assert isinstance(sampler, Interactive)
    for step in range(101):
        batch = sampler.batch(step)
        # All trials step together, so up to three steps ahead.
        assert 20 + step // 2 <= sampler.taken < 20 + step // 2 + 4
        assert {name: tuple(x.shape) for name, x in batch.items()} == {
            "latent": (32, 2), "action": (32, 2), "after": (32, 2), "goal": (32, 2),
        }  # fmt: skip
    assert sampler.taken == sum(len(which) for which, _ in place.done)
    assert place.made[:3] == [("near", 99, 0, 4), ("far", 99, 4, 4), ("near", 99, 8, 4)]
    assert all(abs(actions).max() <= 2 for _, actions in place.done)


def test_latents_are_of_what_trials_see_and_actions_are_those_done() -> None:
    place, model = Watched(), small()
    sampler = explorer(place, model, steps_before=24, noise=0.0)
    sampler.batch(0)
    trials = PLANE.open_with(0).trials("near", 99, 0, 4)
    latents, actions, goals, lengths = sampler._replay.path(np.arange(4))
    rng = np.random.default_rng([7, 2, 0])
    np.testing.assert_array_equal(goals, rng.standard_normal((4, 2), np.float32))
    for step in range(2):
        which = np.flatnonzero(lengths > step)
        seen = model.latents(torch.from_numpy(trials.observe(np.arange(4))))
        np.testing.assert_allclose(latents[which, step], seen[which].detach(), atol=1e-5)
        wanted = model.act(seen, torch.from_numpy(goals)).detach().numpy()
        np.testing.assert_allclose(actions[which, step], wanted[which], atol=1e-5)
        trials.step(which, 2 * actions[which, step])


def test_noise_is_an_ornstein_uhlenbeck_process() -> None:
    place = Watched()
    sampler = explorer(place, trials=500, steps_before=3000, noise=0.2)
    with torch.no_grad():
        for weights in sampler._model.policy.parameters():
            weights.zero_()
    sampler.batch(0)
    # Of trials that never ended, since the noise belongs to places among the trials.
    *_, lengths = sampler._replay.path(np.arange(500))
    _, actions, _, _ = sampler._replay.path(np.flatnonzero(lengths == 6))
    variance = 0.0
    for step in range(6):
        variance = 0.85**2 * variance + 0.2**2
        assert actions[:, step].std() == pytest.approx(np.sqrt(variance), rel=0.15)
    first, second = (actions[:, step].ravel() for step in (4, 5))
    assert np.corrcoef(first, second)[0, 1] == pytest.approx(
        0.85 * first.std() / second.std(), abs=0.1
    )


def test_first_actions_may_be_uniform() -> None:
    place = Watched()
    sampler = explorer(place, steps_before=400, uniform_before=True)
    sampler.batch(0)
    done = np.concatenate([actions for _, actions in place.done])
    assert abs(np.sort(done.ravel() / 2) - np.linspace(-1, 1, done.size)).max() < 0.1


def test_trials_that_all_break_down_at_once_are_an_error_and_no_endless_loop() -> None:
    class Broken(Place):
        def trials(self, task: str, seed: int, first: int, count: int) -> Any:
            inside = PLANE.open_with(0).trials(task, seed, first, count)
            inside.step = lambda which, actions: dict.fromkeys(map(int, which), "no battery")
            return inside

    with pytest.raises(RuntimeError, match="trials: none can take a step: no battery"):
        explorer(Broken()).batch(0)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"trials": 0}, "trials must be at least 1"),
        ({"updates_per_step": 0}, "updates_per_step must be at least 1"),
        ({"path_steps": 0}, "path_steps must be at least 1"),
        ({"noise": float("nan")}, "noise must not be negative"),
        ({"noise_decay": 2.0}, "noise_decay must be from 0 to 1"),
    ],
)
def test_explorations_that_cannot_be_are_refused(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Exploration(**changed)


# ---- training ----------------------------------------------------------------------------------


@pytest.fixture(scope="module", autouse=True)
def registered() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for registry in (DOMAINS, MODELS):
            patch.setattr(registry, "_targets", dict(registry._targets))
        firefly.register()
        yield


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Lights at random places on the meadow."""
    rng = np.random.default_rng(0)
    episodes, steps = 60, 5
    frames = firefly.draw(rng.uniform(0, 15, (episodes * (steps + 1), 2)))
    frames = frames.reshape(episodes, steps + 1, *frames.shape[1:])
    path = tmp_path_factory.mktemp("rig") / "meadow.h5"
    actions = np.zeros((episodes, steps, 2), np.float32)
    write_episodes(path, Metadata("meadow", {}, 0, steps, episodes, {}), Episodes(frames, actions))
    return path


def settings_of(steps: int, vae_steps: int = 20, **changed: Any) -> dict[str, Any]:
    return {
        "console": QUIET,
        "vae": SMALL_VAE,
        "vae_loop": LoopConfig(steps=vae_steps, learning_rate=3e-3, device="cpu", threads=1),
        "model": {"layers": (64, 64), "discount": 0.9, "tau": 0.02},
        "exploration": Exploration(
            trials=8, steps_before=200, path_steps=None, uniform_before=True, updates_per_step=2
        ),
        "loop": LoopConfig(
            steps=steps, learning_rate=2e-3, checkpoint_every=10, validate_every=steps,
            device="cpu", threads=1,
        ),
        **changed,
    }  # fmt: skip


@pytest.fixture(scope="module")
def trained(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """RIG on the meadow, for seconds."""
    out = tmp_path_factory.mktemp("run")
    settings = settings_of(1500, vae_steps=500)
    settings["loop"] = dataclasses.replace(settings["loop"], checkpoint_every=500)
    train("rig", data, out=out, **settings)
    return out


def test_it_learns_to_reach_goals_that_it_only_imagined(trained: Path) -> None:
    header = (trained / "model.safetensors").read_bytes()[:20_000].decode(errors="ignore")
    assert "hvf train rig" in header
    assert (trained / "vae" / "model.safetensors").is_file()
    model = load_model(trained / "model.safetensors", RIG)
    reports = [
        evaluate(
            Evaluation.of("meadow", method=method, task="far", **more), 30, console=QUIET
        ).success_rate
        for method, more in (
            ("rig", {"method_model": str(trained / "model.safetensors")}),
            ("random", {}),
        )
    ]
    assert model.config.action_high == (2.0, 2.0)
    assert reports[0] > reports[1] + 0.3, reports


def test_a_run_that_was_stopped_ends_as_one_that_was_not(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    through = train("rig", data, out=tmp_path / "through", **settings_of(60)).state_dict()
    again = train("rig", data, out=tmp_path / "again", **settings_of(60)).state_dict()
    assert all(torch.equal(through[name], again[name]) for name in through)
    batch = Explorer.batch

    def failing(self: Explorer, step: int) -> Any:
        if step == 37:
            raise OSError("somebody pulled the plug")
        return batch(self, step)

    monkeypatch.setattr(Explorer, "batch", failing)
    with pytest.raises(OSError, match="plug"):
        train("rig", data, out=tmp_path / "stopped", **settings_of(60))
    monkeypatch.setattr(Explorer, "batch", batch)
    # From step 30, in the middle of a round.
    resumed = train("rig", data, out=tmp_path / "stopped", **settings_of(60)).state_dict()
    assert all(torch.equal(through[name], resumed[name]) for name in through)
    other = settings_of(60)
    other["loop"] = dataclasses.replace(other["loop"], seed=1)
    different = train("rig", data, out=tmp_path / "other", **other).state_dict()
    assert not torch.equal(through["policy.0.weight"], different["policy.0.weight"])


def test_any_gymnasium_environment_with_goal_images_will_do(data: Path, tmp_path: Path) -> None:
    """Environments that end at success, and one set of trials at a time."""
    settings = settings_of(30, domain="firefly", task="reach")
    model = train("rig", data, out=tmp_path / "run", **settings)
    assert isinstance(model, RIG)


def test_data_and_domains_that_do_not_go_together_are_named(data: Path, tmp_path: Path) -> None:
    out: dict[str, Any] = {"out": tmp_path / "run", **settings_of(5)}
    with pytest.raises(ValueError, match=r"domain: a policy learns by acting, and 'woods' is none"):
        train("rig", data, **out, domain="woods")
    with pytest.raises(ValueError, match="task: must be one of near, far; got 'up'"):
        train("rig", data, **out, task="up")
    with pytest.raises(ValueError, match="domain: desk has 3 action dimensions, the data has 2"):
        train("rig", data, **out, domain="desk")
    with pytest.raises(ValueError, match=r"has images of \(16, 16\), maze of \(64, 64\)"):
        train("rig", data, **out, domain="maze")


def test_the_papers_preset_is_rlkits() -> None:
    recipe = RIGRecipe.of("paper", data=Path("x.h5"))
    tried = recipe.exploration
    assert (tried.trials, tried.steps_before, tried.updates_per_step) == (1, 4_000, 4)
    assert (tried.path_steps, tried.noise, tried.noise_decay) == (100, 0.2, 0.15)
    assert (tried.capacity, tried.uniform_before) == (1_000_000, False)
    assert recipe.loop.steps == 505 * 1000 * 4
    assert (recipe.batch_size, recipe.loop.learning_rate) == (128, 1e-3)
    vae = VAERecipe.of("rig", data=Path("x.h5"))
    assert (recipe.vae, recipe.vae_batch) == (vae.model, vae.batch_size) == (RIG_VAE, 128)
    assert recipe.vae_loop == vae.loop
    assert vae.loop.steps == 501 * 100
    assert (vae.model.latent_dim, vae.model.kl_weight_at(0)) == (4, 10 / 128)


# ---- the method --------------------------------------------------------------------------------


def test_the_method_reads_images_only_and_acts_the_same_alone(trained: Path) -> None:
    settings = {"method": "rig", "method_model": str(trained / "model.safetensors")}
    evaluation = Evaluation.of("meadow", **settings)
    together = evaluate(evaluation, 6, chunk=6, console=QUIET)
    alone = evaluate(evaluation, 6, chunk=1, console=QUIET)
    assert [(t.success, t.steps) for t in together.trials] == [
        (t.success, t.steps) for t in alone.trials
    ]
    assert (together.kind, together.name) == ("video", "meadow far: RIG")
    assert together.world == {"method": settings["method_model"]}
    assert together.weights["method"]["model"] == "rig"
    with Task.open(evaluation) as task:
        seen = Blind(task.trials(0, 2))
        task.trials = lambda first, count: seen  # type: ignore[method-assign]
        assert len(task.run(0, 2).trials) == 2
    assert seen.refused == []


def test_the_policy_takes_images_of_its_size_only() -> None:
    policy = LatentPolicy(small())
    image = np.zeros((16, 16, 3), np.uint8)
    action = policy.act(image, image)
    assert (action.shape, action.dtype) == ((2,), np.float32)
    with pytest.raises(ValueError, match=r"goal: expected shape \[16, 16, 3\]"):
        policy.act(image, image[:8])


def test_it_is_trained_and_evaluated_by_the_command_line(
    data: Path, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    checkpoint = str(trained / "model.safetensors")
    words = ["--method", "rig", "--method-model", checkpoint, "--trials", "2"]
    assert main(["eval", "meadow", *words, "--out", str(tmp_path / "report.json")]) == 0
    assert "RIG" in capsys.readouterr().out
    options = ["--vae-loop.steps", "2", "--loop.steps", "4", "--exploration.steps-before", "16"]
    sizes = ["--vae.channels", "8", "16", "--vae.strides", "2", "2", "--vae.pyramid-levels", "1"]
    where = ["--data", str(data), "--out", str(tmp_path / "run"), "--task", "near"]
    assert main(["train", "rig", *where, *options, *sizes]) == 0
    assert load_model(tmp_path / "run" / "model.safetensors", RIG).config.action_low == (-2, -2)
