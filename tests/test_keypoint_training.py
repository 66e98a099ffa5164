"""The compact models from data to plans: training, scene codes, distances."""

from __future__ import annotations

import io
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

import hvf_core
from hvf.data.episodes import Episodes, Metadata
from hvf.data.formats.hdf5 import write_episodes
from hvf.domains.maze_collection import MazeCollection
from hvf.protocols import Judging
from hvf.registry import DOMAINS, MODELS
from hvf.settings import Planning, World

torch = pytest.importorskip("torch")

from hvf.models.checkpoint import load_any, save_model  # noqa: E402
from hvf.models.entry import ModelEntry  # noqa: E402
from hvf.models.frames import to_unit  # noqa: E402
from hvf.models.keypoint.dynamics import DynamicsConfig, KeypointDynamics  # noqa: E402
from hvf.models.keypoint.generator import GeneratorConfig, KeypointGenerator  # noqa: E402
from hvf.models.keypoint.perception import KeypointPerception  # noqa: E402
from hvf.models.keypoint.scene_code import SceneCode  # noqa: E402
from hvf.models.temporal_distance import TemporalDistance, TemporalDistanceConfig  # noqa: E402
from hvf.models.vae import CVAE, CVAEConfig  # noqa: E402
from hvf.training.loop import LoopConfig  # noqa: E402
from hvf.training.recipe import train  # noqa: E402
from hvf.training.recipes.temporal_distance import KeypointPairs  # noqa: E402
from hvf.training.tracks.keypoints import Transitions, TransitionSampler  # noqa: E402
from hvf.worlds.distances import ImageDistanceWorld, LatentDistance  # noqa: E402
from hvf.worlds.keypoint import KeypointSubgoals, KeypointWorld  # noqa: E402
from hvf.worlds.load import load  # noqa: E402
from hvf.worlds.steps import KeypointStepsWorld, keypoint_segments, keypoint_steps  # noqa: E402

QUIET = Console(quiet=True)
SHORT = LoopConfig(
    steps=8, learning_rate=1e-3, validate_every=8, checkpoint_every=4, precision="float32"
)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "maze.h5"
    MazeCollection(path, episodes=60, steps=10).run(Console(file=io.StringIO()))
    return path


@pytest.fixture(scope="module")
def runs(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Models trained for a few steps by each of the three trainings."""
    folder = tmp_path_factory.mktemp("runs")
    quiet = Console(file=io.StringIO())
    loops = {"perception_loop": SHORT, "loop": SHORT}
    train("keypoint", data, out=folder / "dynamics", episodes=30, console=quiet, **loops)
    dynamics = folder / "dynamics" / "model.safetensors"
    small = {"dynamics": dynamics, "episodes": 30, "loop": SHORT, "console": quiet}
    train("keypoint-generator", data, out=folder / "generator", **small)
    train("temporal-distance", data, out=folder / "steps", **small)
    return folder


def test_trained_models_plan_with_every_cost(runs: Path) -> None:
    images = hvf_core.maze_collect(3, 0, 2, 1)[0][:, 0]
    mpc = hvf_core.VisualMPC(horizon=2, samples=8, elites=2, iterations=2)
    search = hvf_core.HVF(mpc=mpc, subgoals=1, samples=6, elites=2, iterations=2)
    models = {
        name: load_any(runs / name / "model.safetensors", environment="maze")
        for name in ("dynamics", "generator", "steps")
    }
    made = {name: model.entry.resolved("plannable") for name, model in models.items()}
    for over_horizon in ("last", "min"):
        planning = Planning(over_horizon=over_horizon)
        world = made["dynamics"](models["dynamics"].module, planning)
        generator = made["generator"](models["generator"].module, world)
        for cost in ("pixel", "temporal"):
            steps = models["steps"].module
            costly = world if cost == "pixel" else made["steps"](steps, world, planning)
            found = search.search(costly, generator, images[0], images[1], seed=1)
            assert np.isfinite(found.cost)


def test_a_finished_training_is_not_done_again(data: Path, runs: Path) -> None:
    checkpoint = runs / "dynamics" / "model.safetensors"
    before = checkpoint.read_bytes()
    said = io.StringIO()
    loops = {"perception_loop": SHORT, "loop": SHORT}
    console = Console(file=said, width=300)
    train("keypoint", data, out=runs / "dynamics", episodes=30, console=console, **loops)
    assert checkpoint.read_bytes() == before
    assert said.getvalue().count("already trained for 8 steps") == 2


def test_a_second_start_perceives_nothing(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.manual_seed(0)
    model = KeypointDynamics(DynamicsConfig()).eval()
    own = shutil.copy(data, tmp_path / "maze.h5")
    first = Transitions(own, model, episodes=6, first=2)
    seen = KeypointPerception.keypoints
    calls: list[int] = []

    def counted(perception: KeypointPerception, images: torch.Tensor) -> torch.Tensor:
        calls.append(len(images))
        return seen(perception, images)

    monkeypatch.setattr(KeypointPerception, "keypoints", counted)
    again = Transitions(own, model, episodes=6, first=2)
    whole_groups = Transitions(own, model, episodes=4, first=2)
    assert not calls
    for name in ("keypoints", "actions", "backgrounds"):
        assert (getattr(again, name) == getattr(first, name)).all()
        assert (getattr(whole_groups, name) == getattr(first, name)[:4]).all()
    # Fewer than were looked at together might differ in the last bit.
    Transitions(own, model, episodes=3, first=2)
    assert calls == [33]
    assert len(list((tmp_path / "maze.h5.tracks").glob("*.h5"))) == 2


def test_another_perception_or_other_data_is_looked_at_again(data: Path, tmp_path: Path) -> None:
    torch.manual_seed(0)
    model = KeypointDynamics(DynamicsConfig()).eval()
    own = Path(shutil.copy(data, tmp_path / "maze.h5"))
    folder = tmp_path / "maze.h5.tracks"
    before = Transitions(own, model, episodes=2).keypoints
    with torch.no_grad():
        model.perception.mask[0].weight.mul_(1.01)
    assert not (Transitions(own, model, episodes=2).keypoints == before).all()
    assert len(list(folder.iterdir())) == 2
    MazeCollection(own, episodes=60, steps=10, seed=1, overwrite=True).run(QUIET)
    Transitions(own, model, episodes=2)
    assert len(list(folder.iterdir())) == 3


def test_damaged_tracks_are_made_again_and_a_place_that_refuses_them_is_no_error(
    data: Path, tmp_path: Path
) -> None:
    torch.manual_seed(0)
    model = KeypointDynamics(DynamicsConfig()).eval()
    own = Path(shutil.copy(data, tmp_path / "maze.h5"))
    expected = Transitions(own, model, episodes=2).keypoints
    (kept,) = (tmp_path / "maze.h5.tracks").iterdir()
    whole = kept.read_bytes()
    kept.write_bytes(whole[: len(whole) // 2])
    np.testing.assert_array_equal(Transitions(own, model, episodes=2).keypoints, expected)
    assert kept.stat().st_size == len(whole)
    shutil.rmtree(kept.parent)
    kept.parent.write_text("in the way")
    said = io.StringIO()
    console = Console(file=said, width=300)
    found = Transitions(own, model, episodes=2, console=console).keypoints
    np.testing.assert_array_equal(found, expected)
    assert "not kept" in said.getvalue()


def test_the_keypoint_model_takes_its_sizes_from_the_data(tmp_path: Path) -> None:
    data = MazeCollection(tmp_path / "small.h5", 20, 10, image_size=32).run(QUIET)
    loops = {"perception_loop": SHORT, "loop": SHORT}
    model = train("keypoint", data, out=tmp_path / "run", console=QUIET, **loops)
    assert model.config.perception.image_size == 32
    assert model.config.action_dim == 2


# A model of a few steps has not found what moves, and says so twice.
@pytest.mark.filterwarnings("ignore:images. the model explains")
def test_short_episodes_are_enough_or_one_clear_error(tmp_path: Path) -> None:
    loops = {"perception_loop": SHORT, "loop": SHORT}
    for steps in (5, 4):
        data = MazeCollection(tmp_path / f"{steps}.h5", 20, steps).run(QUIET)
        if steps == 5:
            with pytest.warns(UserWarning, match="of what changes between frames"):
                train("keypoint", data, out=tmp_path / "run", console=QUIET, **loops)
        else:
            with pytest.raises(ValueError, match=r"4\.h5: episodes have 4 steps, .* needs 5"):
                train("keypoint", data, out=tmp_path / "none", console=QUIET, **loops)


def test_images_that_the_keypoint_model_cannot_take_are_one_clear_error(tmp_path: Path) -> None:
    for size, message in (((16, 24), "square"), ((20, 20), "multiple of 8")):
        path = tmp_path / f"{size[1]}.h5"
        frames = np.zeros((4, 13, *size, 3), np.uint8)
        moves, states = np.zeros((4, 12, 2), np.float32), np.zeros((4, 13, 1))
        write_episodes(path, Metadata("other", {}, 0, 12, 4, {}), Episodes(frames, moves, states))
        with pytest.raises(ValueError, match=rf"{size[1]}\.h5: .*{message}"):
            train("keypoint", path, out=tmp_path / "run", console=QUIET)


def test_transitions_are_what_the_file_holds(data: Path) -> None:
    torch.manual_seed(0)
    model = KeypointDynamics(DynamicsConfig()).eval()
    found = Transitions(data, model, episodes=6, first=2)
    frames, actions, _ = hvf_core.maze_collect(0, 2, 6, 10)
    np.testing.assert_array_equal(found.actions, actions)
    with torch.inference_mode():
        keypoints = model.perception.keypoints(to_unit(torch.from_numpy(frames[4])))
        background = model.background(to_unit(torch.from_numpy(frames[4, [10]])), keypoints[10:])
    np.testing.assert_allclose(found.keypoints[4], keypoints.numpy(), atol=1e-4)
    np.testing.assert_allclose(found.backgrounds[4, 1], background[0].numpy(), atol=1e-3)
    batch = TransitionSampler(found, scenes=5, transitions=7, seed=3).batch(11)
    again = TransitionSampler(found, scenes=5, transitions=7, seed=3).batch(11)
    for name in batch:
        assert torch.equal(batch[name], again[name])
    for scene in range(5):
        drawn = batch["backgrounds"][scene].numpy()
        (episode, _), *_ = np.argwhere((found.backgrounds == drawn).all(axis=(2, 3)))
        for before, action, after in zip(
            batch["before"][scene], batch["actions"][scene], batch["after"][scene], strict=True
        ):
            time = np.flatnonzero((found.actions[episode] == action.numpy()).all(axis=1))[0]
            np.testing.assert_array_equal(found.keypoints[episode, time], before)
            np.testing.assert_array_equal(found.keypoints[episode, time + 1], after)


def test_scene_codes_are_whitened_principal_components() -> None:
    rng = np.random.default_rng(0)
    factors = rng.standard_normal((400, 3))
    maps = (factors @ rng.standard_normal((3, 64 * 64)) + 5.0).reshape(-1, 64, 64)
    maps += 0.01 * rng.standard_normal(maps.shape)
    tensor = torch.from_numpy(maps).float()
    code = SceneCode(64, 3).fit(tensor)
    codes = code(tensor).numpy()
    pooled = maps.reshape(-1, 32, 2, 32, 2).mean(axis=(2, 4)).reshape(400, -1)
    left, values, _ = np.linalg.svd(pooled - pooled.mean(axis=0), full_matrices=False)
    variance = values[:3] ** 2 / 400
    expected = left[:, :3] * values[:3] / np.sqrt(variance + 1e-3 * variance[0])
    signs = np.sign((codes * expected).sum(axis=0))
    np.testing.assert_allclose(codes, expected * signs, atol=2e-3)


@settings(max_examples=50)
@given(steps=st.lists(st.integers(0, 10_000), min_size=1, max_size=20), classes=st.integers(2, 12))
def test_classes_of_steps_double_in_width(steps: list[int], classes: int) -> None:
    model = TemporalDistance(TemporalDistanceConfig(classes=classes))
    found = model.classes(torch.tensor(steps)).tolist()
    assert found == [min(step.bit_length(), classes - 1) for step in steps]


def test_pairs_are_as_many_steps_apart_as_they_say() -> None:
    clock = np.arange(20.0, dtype=np.float32)
    keypoints = np.stack([np.stack([clock, clock], axis=1)] * 3)
    batch = KeypointPairs(keypoints, np.zeros((3, 4), np.float32), 500, seed=0).batch(2)
    apart = (batch["after"] - batch["before"])[:, 0]
    np.testing.assert_array_equal(apart.abs(), batch["steps"].float())
    assert set(batch["steps"].tolist()) >= {0, 1, 2, 19} - {19}
    assert (apart > 0).any()
    assert (apart < 0).any()


def test_latent_distance_is_between_posterior_means_of_drawn_frames() -> None:
    torch.manual_seed(1)
    world = KeypointWorld(KeypointDynamics(DynamicsConfig()))
    cvae = CVAE(CVAEConfig()).eval()
    distances = ImageDistanceWorld(world, LatentDistance(cvae), "sum")
    images = hvf_core.maze_collect(5, 0, 4, 1)[0][:, 0]
    frames = world.observe(images)
    starts, goals = frames[np.array([0, 1])], frames[np.array([2, 3])]
    actions = np.random.default_rng(0).uniform(-3, 3, (2, 3, 2, 2)).astype(np.float32)
    found = distances.rollout_costs(starts, goals, actions)
    path = world.native.rollout(starts, actions)
    with torch.inference_mode():
        for b in range(2):
            scene = to_unit(torch.from_numpy(images[b : b + 1]))
            aim = cvae.encode(to_unit(torch.from_numpy(images[2 + b : 3 + b])), scene)[0]
            before = torch.from_numpy(starts.keypoints[b : b + 1])
            for d in range(3):
                total = 0.0
                for h in range(2):
                    after = torch.from_numpy(path[b, d, h : h + 1])
                    drawn = world.dynamics.draw(scene, before, after).clamp(0, 1)
                    total += float((cvae.encode(drawn, scene)[0] - aim).square().sum())
                assert found[b, d] == pytest.approx(total, rel=1e-3)


def test_temporal_distance_is_the_expected_class() -> None:
    torch.manual_seed(2)
    world = KeypointWorld(KeypointDynamics(DynamicsConfig()))
    model = TemporalDistance(TemporalDistanceConfig(classes=4)).eval()
    frames = world.observe(hvf_core.maze_collect(5, 0, 2, 1)[0][:, 0])
    start, goal = frames[np.array([0])], frames[np.array([1])]
    actions = np.random.default_rng(0).uniform(-3, 3, (1, 5, 3, 2)).astype(np.float32)
    found = KeypointStepsWorld(world, model, "min").rollout_costs(start, goal, actions)
    path = world.native.rollout(start, actions)
    with torch.inference_mode():
        code = model.code(torch.from_numpy(start.maps))
        for d in range(5):
            costs = []
            for h in range(3):
                logits = model.logits(
                    torch.from_numpy(path[0, d, h : h + 1]), torch.from_numpy(goal.keypoints), code
                )[0].double()
                weights = np.exp(logits.numpy()) / np.exp(logits.numpy()).sum()
                costs.append(float(weights @ np.arange(4)))
            assert found[0, d] == pytest.approx(min(costs), rel=1e-4)


def test_segments_judged_by_keypoints_cost_what_the_model_says_of_their_ends() -> None:
    torch.manual_seed(3)
    world = KeypointWorld(KeypointDynamics(DynamicsConfig()))
    model = TemporalDistance(TemporalDistanceConfig(classes=4)).eval()
    subgoals = KeypointSubgoals(KeypointGenerator(GeneratorConfig()), world)
    frames = world.observe(hvf_core.maze_collect(5, 0, 2, 1)[0][:, 0])
    start, goal = frames[np.array([0])], frames[np.array([1])]
    latents = np.random.default_rng(0).normal(size=(4, 2, subgoals.latent_dim)).astype(np.float32)
    judging = keypoint_segments(model, subgoals)
    assert isinstance(judging, Judging)
    found = judging.segment_costs(start, goal, latents)
    assert found.shape == (4, 3)
    drawn = subgoals.decode(start, latents).keypoints.reshape(4, 2, 2)
    np.testing.assert_array_equal(judging.decode(start, latents).keypoints.reshape(4, 2, 2), drawn)
    with torch.inference_mode():
        code = model.code(torch.from_numpy(start.maps))
        for sample in range(4):
            path = np.concatenate([start.keypoints, drawn[sample], goal.keypoints])
            for segment in range(3):
                before, after = (torch.from_numpy(path[[segment + k]]) for k in range(2))
                expected = float(model(before, after, code)[0])
                assert found[sample, segment] == pytest.approx(expected, rel=1e-4)


def test_a_checkpoint_of_ones_own_is_measured_by_the_distance_of_its_kind() -> None:
    domain = DOMAINS["maze"]
    own = World(str(domain.weights["keypoint"]), "keypoint-generator", cost="temporal")
    with domain.open(1) as place:
        loaded = load(domain, own, Planning(), place, generator=False)
        assert isinstance(loaded.world, KeypointStepsWorld)
        assert loaded.weights["cost"].model == "temporal-distance"
        with pytest.raises(ValueError, match="cost_model: name one for the cost 'temporal'; none"):
            load(domain, World("latent", cost="temporal"), Planning(), place, generator=False)
        # A VAE measures images, and is no distance in steps.
        images = World("keypoint", cost="temporal", cost_model="cvae")
        with pytest.raises(ValueError, match=r"'temporal' needs a distance in steps; .* a cvae"):
            load(domain, images, Planning(), place, generator=False)


def test_a_distance_of_another_package_makes_its_own_world(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Halved(TemporalDistance):
        pass

    asked = []

    def halved(model: Any, world: Any, planning: Planning) -> Any:
        asked.append((type(model), type(world), planning.over_horizon))
        return world

    monkeypatch.setattr(MODELS, "_targets", dict(MODELS._targets))
    own = ModelEntry("halves", "object", "distance", Halved, halved, in_steps=True)
    MODELS.register("halved", own)
    save_model(tmp_path / "halved", Halved(TemporalDistanceConfig()), environment="maze")
    world = World("keypoint", cost="temporal", cost_model=str(tmp_path / "halved"))
    with DOMAINS["maze"].open(1) as place:
        planning = Planning(over_horizon="sum")
        loaded = load(DOMAINS["maze"], world, planning, place, generator=False)
    assert asked == [(Halved, KeypointWorld, "sum")]
    assert loaded.weights["cost"].model == "halved"


def test_distances_in_steps_refuse_what_they_are_not_for() -> None:
    model, planning = TemporalDistance(TemporalDistanceConfig()), Planning()
    with pytest.raises(ValueError, match="'temporal' needs keypoint dynamics, got object"):
        keypoint_steps(model, object(), planning)
    with pytest.raises(ValueError, match="segment_model: temporal-distance is for keypoint-gener"):
        keypoint_segments(model, object())
