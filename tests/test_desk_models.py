"""The learned models of the desk: parts, hand, closed-form costs, training, planning."""

from __future__ import annotations

import dataclasses
import io
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from rich.console import Console

import hvf_core
from hvf.data.store import Episodes, Metadata, write_episodes
from hvf.protocols import Observer, RolloutSharer, WorldModel

torch = pytest.importorskip("torch")

from hvf.evaluation.desk_models import psnr, ssim  # noqa: E402
from hvf.models.checkpoint import load_model  # noqa: E402
from hvf.models.cvae import CVAEConfig  # noqa: E402
from hvf.models.hand import Hand, HandConfig  # noqa: E402
from hvf.models.parts import Parts, PartsConfig  # noqa: E402
from hvf.models.parts_dynamics import PartsDynamics, PartsDynamicsConfig  # noqa: E402
from hvf.training.desk_dynamics import DeskDynamicsTraining, train_desk_dynamics  # noqa: E402
from hvf.training.desk_states import DeskSampler, DeskStates  # noqa: E402
from hvf.training.loop import LoopConfig  # noqa: E402
from hvf.training.subgoals import DeskSubgoalTraining, train_subgoals  # noqa: E402
from hvf.worlds.desk_learned import DeskLearnedWorld  # noqa: E402
from hvf.worlds.learned import ImageSubgoals  # noqa: E402

TINY = PartsDynamicsConfig(
    parts=PartsConfig(image_size=32, parts=3),
    hand=HandConfig(image_size=32, channels=(4, 8), hidden=16),
    hidden=12,
    memory=2,
    part_features=10,
    hand_features=14,
    patch_rank=5,
)
SHORT = LoopConfig(steps=8, learning_rate=1e-3, validate_every=8, checkpoint_every=4)
COLOURS = np.array([[220, 30, 30], [30, 160, 50], [240, 160, 20]], np.uint8)


def toy_frames(places: NDArray[np.int64], hand: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Squares of 6 pixels at `places [N, 3, 2]` (upper left corner) and a white one at `hand`."""
    frames = np.full((len(places), 32, 32, 3), 110, np.uint8)
    for frame, squares, white in zip(frames, places, hand, strict=True):
        for (row, column), colour in zip(squares, COLOURS, strict=True):
            frame[row : row + 6, column : column + 6] = colour
        frame[white[0] : white[0] + 4, white[1] : white[1] + 4] = 250
    return frames


def toy_places(rng: np.random.Generator, count: int) -> NDArray[np.int64]:
    """Three squares that do not overlap each other, nor a hand in the upper left corner."""
    columns = np.array([1, 11, 22]) + rng.integers(0, 4, (count, 3))
    return np.stack([rng.integers(5, 25, (count, 3)), columns], axis=2)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty episodes in which squares jump and a white hand moves with the action."""
    rng = np.random.default_rng(0)
    episodes, steps = 20, 9
    actions = rng.uniform(-1, 1, (episodes, steps, 3)).astype(np.float32)
    frames = np.empty((episodes, steps + 1, 32, 32, 3), np.uint8)
    for i in range(episodes):
        hand = np.cumsum(np.r_[[[14, 14]], np.rint(2 * actions[i, :, :2])], axis=0).clip(0, 28)
        frames[i] = toy_frames(toy_places(rng, steps + 1), hand.astype(np.int64))
    path = tmp_path_factory.mktemp("data") / "desk.h5"
    states = np.zeros((episodes, steps + 1, 17))
    metadata = Metadata("desk", {}, 0, steps, episodes, {})
    write_episodes(path, metadata, Episodes(frames, actions, states))
    return path


@pytest.fixture(scope="module")
def world(data: Path) -> DeskLearnedWorld:
    """A model with random weights that is not at rest."""
    torch.manual_seed(0)
    model = PartsDynamics(TINY)
    with torch.no_grad():
        model.drawing.patches.weight.normal_(0, 0.3)
        model.cell.last.weight.normal_(0, 0.3)
    read = DeskStates(data, model, 6)
    frames = torch.from_numpy(read.frames.reshape(-1, 32, 32, 3))
    model.parts.fit(frames[:-1], frames[1:])
    states = torch.cat([model.observe(frames)])
    return DeskLearnedWorld(model.fit_states(states))


def train_tiny(data: Path, out: Path, loop: LoopConfig, hand_loop: LoopConfig) -> str:
    said = io.StringIO()
    config = DeskDynamicsTraining(
        data, out, hand_batch=4, windows=4, length=3, pairs=4, apart=6, model=TINY, loop=loop,
        hand_loop=hand_loop,
    )  # fmt: skip
    train_desk_dynamics(config, Console(file=said, width=400))
    return said.getvalue()


def test_parts_are_found_by_colour_and_where_they_are() -> None:
    rng = np.random.default_rng(1)
    hand = np.zeros((200, 2), np.int64)
    places = toy_places(rng, 200)
    frames = torch.from_numpy(toy_frames(places, hand))
    parts = Parts(PartsConfig(image_size=32, parts=3)).fit(frames[:100], frames[100:])
    found = parts(frames)
    np.testing.assert_allclose(found[..., 0], 1.0, atol=0.02)
    centres = torch.from_numpy(places).float() + 2.5
    for colour in range(3):
        nearest = (found[..., 1:] - centres[:, None, colour]).norm(dim=2).mean(dim=0).min()
        assert nearest < 0.3


def test_a_part_that_is_hidden_has_no_mass_and_its_usual_place() -> None:
    rng = np.random.default_rng(2)
    frames = torch.from_numpy(toy_frames(toy_places(rng, 60), np.zeros((60, 2), np.int64)))
    parts = Parts(PartsConfig(image_size=32, parts=3)).fit(frames[:30], frames[30:])
    empty = parts(torch.full((1, 32, 32, 3), 110, dtype=torch.uint8))[0]
    np.testing.assert_allclose(empty[:, 0], 0.0, atol=1e-6)
    np.testing.assert_allclose(empty[:, 1:], parts.usual[:, 1:], atol=1e-4)


def test_grey_frames_have_no_parts_to_find() -> None:
    grey = torch.randint(0, 255, (4, 32, 32, 1), dtype=torch.uint8).expand(-1, -1, -1, 3)
    with pytest.raises(ValueError, match="too few coloured pixels change"):
        Parts(PartsConfig(image_size=32)).fit(grey[:2], grey[2:])


def test_the_hand_pays_in_full_for_going_too_far_or_back() -> None:
    hand = Hand(HandConfig(image_size=32, channels=(4, 8), action_dim=1, drawing=0.0))
    codes = torch.tensor([[0.0], [0.7], [0.0], [0.2], [0.0], [-0.4]])
    hand.forward = lambda frames: codes  # type: ignore[method-assign]
    frames = torch.zeros(3, 2, 32, 32, 3, dtype=torch.uint8)
    actions = torch.full((3, 1, 1), 0.5)
    loss, _ = hand.loss({"frames": frames, "actions": actions}, torch.Generator(), 0)
    # 0.2 too far; 0.3 short, at 0.6 of the price; 0.4 back, and 0.9 short.
    assert float(loss.detach()) == pytest.approx((0.2 + 0.6 * 0.3 + 0.4 + 0.6 * 0.9) / 3, rel=1e-5)


def test_closed_form_cost_is_that_of_the_drawn_frame(world: DeskLearnedWorld, data: Path) -> None:
    frames = world.observe(_images(data))
    starts, goals = frames[np.array([0, 3])], frames[np.array([1, 2])]
    actions = np.random.default_rng(0).uniform(-1, 1, (2, 5, 4, 3)).astype(np.float32)
    found = world.rollout_costs(starts, goals, actions)
    with torch.inference_mode():
        for b in range(2):
            image = torch.from_numpy(starts.images[b : b + 1]).permute(0, 3, 1, 2) / 255
            goal = torch.from_numpy(goals.images[b : b + 1]).permute(0, 3, 1, 2) / 255
            for d in range(5):
                state = starts.states[b : b + 1]
                path = world.dynamics.rollout(state, torch.from_numpy(actions[b, d : d + 1]))
                drawn = world.dynamics.draw(image, state, path[:, -1])
                expected = float((drawn - goal).double().square().sum()) / 32**2
                assert found[b, d] == pytest.approx(expected, rel=1e-4)


def test_shared_rollouts_cost_the_same(world: DeskLearnedWorld, data: Path) -> None:
    frames = world.observe(_images(data))
    actions = np.random.default_rng(1).uniform(-1, 1, (7, 6, 3)).astype(np.float32)
    shared = world.shared_rollout_costs(frames[np.array([4])], frames, actions)
    starts = frames[np.full(len(frames), 4)]
    alone = world.rollout_costs(starts, frames, np.stack([actions] * len(frames)))
    np.testing.assert_allclose(shared, alone, rtol=2e-4, atol=1e-5)
    assert shared.std() > 0


def test_a_part_heeds_the_hand_and_itself_alone(world: DeskLearnedWorld, data: Path) -> None:
    states = world.observe(_images(data)).states[:2]
    actions = torch.rand(2, 5, 3)
    other = states.clone()
    other[:, :3] += 4.0
    with torch.inference_mode():
        path, changed = (world.dynamics.rollout(x, actions) for x in (states, other))
    assert not torch.allclose(path[..., :3], changed[..., :3])
    torch.testing.assert_close(path[..., 3:], changed[..., 3:])


def test_no_motion_predicted_leaves_the_start_frame(world: DeskLearnedWorld, data: Path) -> None:
    frames = world.observe(_images(data))
    image = torch.from_numpy(frames.images).permute(0, 3, 1, 2) / 255
    with torch.inference_mode():
        drawn = world.dynamics.draw(image, frames.states, frames.states)
    torch.testing.assert_close(drawn, image)


def test_the_planner_searches_subgoals_in_learned_models(
    world: DeskLearnedWorld, data: Path, tmp_path: Path
) -> None:
    assert isinstance(world, WorldModel)
    assert isinstance(world, RolloutSharer)
    assert isinstance(world, Observer)
    vae = CVAEConfig(
        image_size=(32, 32), conditional=False, channels=(4, 8), strides=(2, 2), latent_dim=3,
        posterior_layers=(8,), scene_layers=(), image_layers=(8,),
    )  # fmt: skip
    quiet = Console(file=io.StringIO())
    generator = train_subgoals(
        DeskSubgoalTraining(data, tmp_path, batch_size=4, model=vae, loop=SHORT), quiet
    )
    images = _images(data)
    mpc = hvf_core.VisualMPC(horizon=3, samples=8, elites=2, iterations=2, action_repeat=3)
    for share in (True, False):
        search = hvf_core.HVF(
            mpc=mpc, subgoals=2, samples=6, elites=2, iterations=2, share_rollouts=share
        )
        found = search.search(world, ImageSubgoals(generator), images[0], images[1], seed=1)
        assert np.isfinite(found.cost)


def test_training_resumes_with_the_same_result(data: Path, tmp_path: Path) -> None:
    half = dataclasses.replace(SHORT, steps=8)
    train_tiny(data, tmp_path / "whole", half, half)
    assert "already trained for 8 steps" in train_tiny(data, tmp_path / "whole", half, half)
    # A run that is stopped goes on from its last checkpoint; here, from the end of the hand's.
    (tmp_path / "parts").mkdir()
    (tmp_path / "whole" / "hand").rename(tmp_path / "parts" / "hand")
    train_tiny(data, tmp_path / "parts", half, half)
    whole, parts = (
        load_model(tmp_path / name / "model.safetensors", PartsDynamics, environment="desk")
        for name in ("whole", "parts")
    )
    for name, tensor in whole.state_dict().items():
        assert torch.equal(tensor, parts.state_dict()[name]), name


def test_batches_are_what_the_file_holds(world: DeskLearnedWorld, data: Path) -> None:
    read = DeskStates(data, world.dynamics, 5, first=2)
    batch = DeskSampler(read, 6, 4, 8, 6, seed=3).batch(7)
    again = DeskSampler(read, 6, 4, 8, 6, seed=3).batch(7)
    for name in batch:
        assert torch.equal(batch[name], again[name])
    with torch.inference_mode():
        seen = world.dynamics.observe(batch["images"].flatten(0, 1)).reshape(8, 2, -1)
    torch.testing.assert_close(seen, batch["pairs"], atol=1e-3, rtol=1e-4)
    for states, actions in zip(batch["states"], batch["actions"], strict=True):
        (episode, time), *_ = np.argwhere((read.actions == actions[0].numpy()).all(axis=2))
        np.testing.assert_array_equal(read.actions[episode, time : time + 4], actions)
        np.testing.assert_array_equal(read.states[episode, time : time + 5], states)


def test_bad_input_is_named(world: DeskLearnedWorld, data: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"images: expected shape \[N, 32, 32, 3\]"):
        world.observe(np.zeros((1, 64, 64, 3), np.uint8))
    with pytest.raises(TypeError, match="images: must be uint8"):
        world.observe(np.zeros((1, 32, 32, 3), np.float32))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="the model takes"):
        train_desk_dynamics(DeskDynamicsTraining(data, tmp_path), Console(quiet=True))
    with pytest.raises(ValueError, match="parts must be at least 1"):
        PartsConfig(parts=0)
    with pytest.raises(ValueError, match="hand: images of 64 pixels, parts of 32"):
        PartsDynamicsConfig(parts=PartsConfig(image_size=32))
    with pytest.raises(ValueError, match="patch must divide 32, got 5"):
        dataclasses.replace(TINY, patch=5)
    with pytest.raises(ValueError, match="episodes must be at most 20"):
        DeskStates(data, world.dynamics, 21)


def test_image_measures_agree_with_their_definitions() -> None:
    rng = np.random.default_rng(4)
    truth = rng.integers(0, 256, (2, 1, 14, 13, 3), dtype=np.uint8)
    guess = (0.7 * truth + 60 * rng.random(truth.shape)).astype(np.uint8)
    mse = ((guess / 255.0 - truth / 255.0) ** 2).mean(axis=(2, 3, 4))
    np.testing.assert_allclose(psnr(guess, truth), 10 * np.log10(1 / mse))
    assert ssim(truth, truth) == pytest.approx(np.ones((2, 1)))
    line = np.exp(-0.5 * ((np.arange(11) - 5) / 1.5) ** 2)
    window = np.outer(line, line) / line.sum() ** 2
    expected = []
    for colour in range(3):
        a, b = guess[1, 0, ..., colour] / 255.0, truth[1, 0, ..., colour] / 255.0
        for i in range(4):
            for j in range(3):
                x, y = a[i : i + 11, j : j + 11], b[i : i + 11, j : j + 11]
                mx, my = (window * x).sum(), (window * y).sum()
                vx, vy = (window * (x - mx) ** 2).sum(), (window * (y - my) ** 2).sum()
                both = (window * (x - mx) * (y - my)).sum()
                value = (2 * mx * my + 1e-4) * (2 * both + 9e-4)
                expected.append(value / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4)))
    assert ssim(guess, truth)[1, 0] == pytest.approx(np.mean(expected), rel=1e-9)


def _images(data: Path) -> NDArray[np.uint8]:
    from hvf.data.store import EpisodeFile

    with EpisodeFile(data) as file:
        return file.read(0, 1).frames[0, :5]
