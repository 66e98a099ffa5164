"""Object models on scenes that they were not made for: they work, or they say that they do not."""

from __future__ import annotations

import dataclasses
import functools
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import hvf
import hvf_core
import toy_desk as toy
from hvf.models.checkpoint import load_model
from hvf.models.frames import to_unit
from hvf.models.keypoint.dynamics import KeypointDynamics
from hvf.models.keypoint.perception import KeypointPerception, PerceptionConfig
from hvf.models.layers.colours import ColoursConfig
from hvf.models.layers.dynamics import LayerDynamics
from hvf.models.layers.perception import LayerPerception
from hvf.models.unfamiliar import LOOKED_AT, every, warn_of_unfamiliar
from hvf.models.vae import CVAE
from hvf.worlds.keypoint import KeypointWorld
from hvf.worlds.layers import LayerWorld

WEIGHTS = Path(hvf.__file__).parent / "weights"
FLOOR, WALL, GREEN = (
    np.array(colour, float) for colour in ((24, 36, 92), (130, 180, 235), (60, 200, 90))
)

Images = NDArray[np.uint8]
Floats = NDArray[np.float64]


# ---- mazes of other colours --------------------------------------------------------------------


def layers_of(frames: Images) -> tuple[Floats, Floats]:
    """How much of each pixel agent and walls cover, `[..., S, S, 1]` each."""
    colours = np.stack([GREEN - FLOOR, WALL - FLOOR], axis=1)
    flat = (frames - FLOOR).reshape(-1, 3).T
    covered = np.linalg.lstsq(colours, flat, rcond=None)[0].T
    assert np.abs(colours @ covered.T - flat).max() < 1.0
    covered = covered.reshape(*frames.shape[:-1], 2)
    return covered[..., :1], covered[..., 1:]


def painted(
    agent: Floats, walls: Floats, colour: object = GREEN, floor: object = FLOOR, wall: object = WALL
) -> Images:
    """A maze in other colours; a floor may be an image."""
    colour, floor, wall = (np.asarray(x, float) for x in (colour, floor, wall))
    image = floor + agent * (colour - floor) + walls * (wall - floor)
    return np.rint(image.clip(0, 255)).astype(np.uint8)


@functools.cache
def small_mazes() -> tuple[Floats, Floats, Floats]:
    """Agents and walls `[E, T, S, S, 1]` in images of 32 pixels, and where the agents are."""
    frames, _, states = hvf_core.maze_collect(11, 0, 40, 8, 32)
    # Pixels of 2 cm, from the middle of an image that shows 0.64 m.
    places = np.stack([16 - 50 * states[..., 1], 16 + 50 * states[..., 0]], axis=-1) - 0.5
    return *layers_of(frames), places


def trained_on(frames: Images) -> KeypointPerception:
    """A perception after a short training on pairs of frames `[E, T, S, S, 3]`."""
    torch.manual_seed(0)
    model = KeypointPerception(PerceptionConfig(image_size=32, sprite_from=150))
    optimiser = torch.optim.Adam(model.parameters(), lr=1e-2)
    draw = torch.Generator().manual_seed(1)
    images = torch.from_numpy(frames)
    for step in range(300):
        episode = torch.randint(0, len(frames), (16,), generator=draw)
        times = torch.randint(0, frames.shape[1], (2, 16), generator=draw)
        batch = {"scene": images[episode, times[0]], "image": images[episode, times[1]]}
        loss, _ = model.loss(batch, draw, step)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return model.eval()


def missed(model: KeypointPerception, frames: Images, places: Floats) -> float:
    """Median distance in pixels of keypoints from where the agents are."""
    with torch.inference_mode():
        found = model.keypoints(to_unit(torch.from_numpy(frames[:, 0]))).numpy()
    return float(np.median(np.linalg.norm(found - places[:, 0], axis=1)))


def pairs_of(frames: Images) -> torch.Tensor:
    return torch.from_numpy(frames[:, [0, -1]])


def test_training_starts_without_a_hint_of_the_colour_of_what_moves() -> None:
    colour = KeypointPerception(PerceptionConfig()).colour.detach()
    assert (colour == colour[0]).all()


@pytest.mark.parametrize(
    ("colour", "floor", "wall"),
    [
        pytest.param((200, 40, 40), FLOOR, WALL, id="red agent"),
        pytest.param((30, 30, 30), (225, 220, 205), (150, 120, 90), id="dark agent, bright floor"),
    ],
)
def test_perception_finds_an_agent_of_any_colour_on_a_floor_of_any_colour(
    colour: object, floor: object, wall: object
) -> None:
    agent, walls, places = small_mazes()
    frames = painted(agent, walls, colour, floor, wall)
    model = trained_on(frames)
    assert missed(model, frames, places) < 0.25
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert model.warn_of_unexplained(pairs_of(frames)) < 0.1


def test_perception_says_that_it_does_not_explain_two_moving_things() -> None:
    agent, walls, places = small_mazes()
    other = np.roll(agent, 1, axis=0)
    frames = painted(np.maximum(agent, other), walls)
    model = trained_on(frames)
    assert missed(model, frames, places) > 3.0
    with pytest.warns(UserWarning, match=r"% of what changes.* one box of one colour"):
        assert model.warn_of_unexplained(pairs_of(frames)) > 0.5


def test_perception_says_how_much_of_what_an_agent_uncovers_of_a_textured_floor_it_leaves() -> None:
    agent, walls, places = small_mazes()
    floor = (FLOOR + np.random.default_rng(0).uniform(-60, 60, (32, 32, 3))).clip(0, 255)
    frames = painted(agent, walls, floor=floor)
    model = trained_on(frames)
    # It is found all the same, but what is drawn of it is wrong.
    assert missed(model, frames, places) < 0.25
    with pytest.warns(UserWarning, match="of what changes between frames is not explained"):
        assert 0.1 < model.warn_of_unexplained(pairs_of(frames)) < 0.4


def test_what_is_unexplained_is_what_is_left_of_differences_without_the_sprite() -> None:
    torch.manual_seed(1)
    model = KeypointPerception(PerceptionConfig(image_size=32)).eval()
    agent, walls, _ = small_mazes()
    frames = painted(agent[:5], walls[:5])
    left = whole = 0.0
    with torch.inference_mode():
        for first, last in pairs_of(frames):
            images = to_unit(torch.stack([first, last]))
            free = images - model.tint(model.sprite(model.keypoints(images)))
            left += float((free[0] - free[1]).square().sum())
            whole += float((images[0] - images[1]).square().sum())
        found = model.unexplained(pairs_of(frames))
    assert found == pytest.approx(left / whole, rel=1e-4)


# ---- the model of the maze that ships ----------------------------------------------------------


@pytest.fixture
def maze() -> KeypointWorld:
    return KeypointWorld(load_model(WEIGHTS / "maze_dynamics.safetensors", KeypointDynamics))


def real_mazes(seed: int, count: int) -> Images:
    """Starts and goals of all difficulties, and frames of play."""
    seen = [hvf_core.maze_collect(seed, 0, count // 10, 10)[0].reshape(-1, 64, 64, 3)]
    for difficulty in ("easy", "medium", "hard"):
        starts, targets = hvf_core.maze_episodes(seed, 0, count, difficulty)
        ends = np.concatenate([targets, starts[:, 2:]], axis=1)
        seen += [hvf_core.maze_render(starts), hvf_core.maze_render(ends)]
    return np.concatenate(seen)


def maze_misfit(world: KeypointWorld, images: Images) -> NDArray[np.float32]:
    perception, found = world.dynamics.perception, []
    with torch.inference_mode():
        for part in torch.split(torch.from_numpy(images), 256):
            unit = to_unit(part)
            mask = perception.motion_mask(unit)
            keypoints = perception.centroid(mask)
            found.append(perception.misfit(unit, mask, keypoints, perception.sprite(keypoints)))
    return np.concatenate(found)


def test_real_mazes_are_far_from_unfamiliar(maze: KeypointWorld) -> None:
    misfit = maze_misfit(maze, real_mazes(1_000_000_031, 500))
    assert len(misfit) > 3500
    assert misfit.max() < 0.5


def test_looking_whether_images_are_familiar_changes_no_bit(maze: KeypointWorld) -> None:
    images = real_mazes(5, 10)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = maze.observe(images)
    with torch.inference_mode():
        unit = to_unit(torch.from_numpy(images))
        keypoints = maze.dynamics.perception.keypoints(unit)
        maps = maze.dynamics.maps(maze.dynamics.background(unit, keypoints))
    np.testing.assert_array_equal(found.keypoints, keypoints.numpy())
    np.testing.assert_array_equal(found.maps, maps.numpy())


def foreign_mazes() -> Iterator[tuple[str, Images]]:
    rng = np.random.default_rng(0)
    frames = hvf_core.maze_collect(8, 0, 20, 1)[0][:, 0]
    agent, walls = layers_of(frames)
    yield "red agent", painted(agent, walls, colour=(200, 40, 40))
    yield "grey floor", painted(agent, walls, floor=(90, 90, 90))
    yield "inverted", 255 - frames
    floor = (FLOOR + rng.uniform(-40, 40, (8, 8, 3)).repeat(8, 0).repeat(8, 1)).clip(0, 255)
    yield "textured floor", painted(agent, walls, floor=floor)
    far = np.roll(agent, 25, axis=1)
    yield "two agents", painted(np.maximum(agent, far), walls)
    yield "no agent", painted(0 * agent, walls)
    yield "noise", rng.integers(0, 256, (20, 64, 64, 3), dtype=np.uint8)
    # Smooth and of all colours, as photographs are.
    coarse = torch.rand(20, 3, 6, 6, generator=torch.Generator().manual_seed(0))
    smooth = torch.nn.functional.interpolate(coarse, size=64, mode="bicubic").clamp(0, 1)
    yield "photograph", (255 * smooth.permute(0, 2, 3, 1)).to(torch.uint8).contiguous().numpy()
    yield "black", np.zeros((1, 64, 64, 3), np.uint8)


@pytest.mark.parametrize("name", [name for name, _ in foreign_mazes()])
def test_the_shipped_model_of_the_maze_warns_of_images_of_something_else(
    maze: KeypointWorld, name: str
) -> None:
    images = dict(foreign_mazes())[name]
    assert np.median(maze_misfit(maze, images)) > 1.1
    # Two images are enough, a start and a goal, and one warning.
    worst = images[[int(maze_misfit(maze, images).argmax())] * 2]
    with pytest.warns(UserWarning, match="made for one box of one colour"):
        maze.observe(worst)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        maze.observe(worst)


def test_a_few_smudges_among_what_a_generator_draws_are_no_reason_to_warn(
    maze: KeypointWorld,
) -> None:
    cvae = load_model(WEIGHTS / "maze_cvae.safetensors", CVAE)
    start = to_unit(torch.from_numpy(real_mazes(9, 10)[:1]))
    latents = torch.randn(400, 8, generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        images = (255 * cvae.decode(latents, start).clamp(0, 1)).to(torch.uint8)
    drawn = images.permute(0, 2, 3, 1).contiguous().numpy()
    assert maze_misfit(maze, drawn).max() > 1.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        maze.observe(drawn)


@pytest.mark.parametrize(
    ("misfit", "share", "warned"),
    [
        ([], 0.5, False),
        ([1.0], 0.5, False),
        ([1.1], 0.5, False),
        ([1.1, 1.2], 0.5, True),
        ([float("nan")] * 2, 0.5, True),
        ([0.1, 9.0, 0.2], 0.5, False),
        ([1.1, 0.1, 1.2], 0.5, True),
        ([0.1, 9.0, 0.2, 0.3, 0.4], 0.25, False),
        ([0.1, 9.0, 0.2, 9.0, 0.4], 0.25, True),
    ],
)
def test_more_than_a_share_of_images_has_to_be_unfamiliar(
    misfit: list[float], share: float, warned: bool
) -> None:
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        warn_of_unfamiliar(torch.nn.Identity(), np.array(misfit), "this", share)
    assert len(said) == warned
    assert all("made for this" in str(one.message) for one in said)


def test_one_odd_image_among_many_that_are_familiar_is_no_reason_to_warn() -> None:
    model = torch.nn.Identity()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        warn_of_unfamiliar(model, np.array([0.1]), "this")
        warn_of_unfamiliar(model, np.array([9.0]), "this")
        warn_of_unfamiliar(model, np.array([0.1]), "this")
        warn_of_unfamiliar(model, np.array([9.0]), "this")
        assert not said
        # Now five of seven.
        warn_of_unfamiliar(model, np.array([9.0, 9.0, 9.0]), "this")
    assert len(said) == 1


@pytest.mark.parametrize("count", [0, 1, 2, 16, 17, 31, 33, 500])
def test_few_images_of_a_call_are_looked_at(count: int) -> None:
    looked_at = np.arange(count)[every(count)]
    assert len(looked_at) <= LOOKED_AT
    assert len(looked_at) >= min(count, LOOKED_AT // 2)


# ---- desks of other things ---------------------------------------------------------------------


def jumbled_frames() -> tuple[toy.Floats, torch.Tensor]:
    states = toy.jumbled(0, 2 * toy.PLACES, 12)
    frames = toy.frames_of(states.reshape(-1, 14))
    return states, frames.reshape(*states.shape[:2], *frames.shape[1:])


def test_layers_find_parts_of_other_colours(monkeypatch: pytest.MonkeyPatch) -> None:
    colours = ((210, 60, 190), (40, 190, 190), (230, 220, 40))
    monkeypatch.setattr(toy, "SQUARES", colours)
    states, frames = jumbled_frames()
    with torch.inference_mode():
        perception = LayerPerception(toy.TINY.perception).fit(frames[:, :2], frames)
        still = states[:, 0]
        seen = perception.colours(toy.frames_of(still, arm=False))[:, perception.colours.roams]
        truth = toy.as_seen(still, perception)[:, 5:].reshape(-1, 3, 3)
    assert float((seen[..., 1:] - truth[..., :2]).norm(dim=2).max()) < 0.1


def test_layers_refuse_data_with_a_fourth_cube() -> None:
    _, frames = jumbled_frames()
    rng = np.random.default_rng(1)
    flat = frames.flatten(0, 1)
    for image, row, column in zip(
        flat, rng.integers(13, 26, len(flat)), rng.integers(20, 26, len(flat)), strict=True
    ):
        image[row : row + 5, column : column + 5] = torch.tensor([30, 190, 190], dtype=torch.uint8)
    config = toy.TINY.perception
    config = dataclasses.replace(config, colours=ColoursConfig(image_size=32, parts=6))
    with (
        pytest.raises(ValueError, match="4 parts roam, expected 3: this model takes a fixed"),
        torch.inference_mode(),
    ):
        LayerPerception(config).fit(frames[:, :2], frames)


def test_a_desk_that_is_drawn_well_has_no_misfit_and_a_thing_more_has() -> None:
    perception, _ = toy.seen()
    states = toy.scattered(np.random.default_rng(3), 40)
    frames = toy.frames_of(states, arm=False)
    with torch.inference_mode():
        assert float(perception.misfit(frames).max()) < 1.0
        more = frames.clone()
        more[:, 24:30, 22:28] = torch.tensor([30, 190, 190], dtype=torch.uint8)
        assert float(perception.misfit(more).min()) > 1.0
        shifted = frames.roll(8, dims=2)
        assert float(perception.misfit(shifted).median()) > 1.0


# ---- the model of the desk that ships ----------------------------------------------------------

mujoco = pytest.importorskip("mujoco", reason="the desk needs MuJoCo 4, of Python 3.11")

from hvf.envs.desk import rendering  # noqa: E402
from hvf.envs.desk.arrangement import random_arrangement, settled  # noqa: E402
from hvf.envs.desk.scene import BLOCK_SIZE, load_scene, scene_spec  # noqa: E402
from hvf.envs.desk.simulator import DeskSimulator  # noqa: E402


@pytest.fixture(scope="module")
def desk() -> LayerDynamics:
    return load_model(WEIGHTS / "desk_dynamics.safetensors", LayerDynamics)


def images_of(count: int, scene: Path | None = None) -> Images:
    """A desk at random arrangements."""
    simulator = DeskSimulator(scene)
    renderer = rendering.DeskRenderer(simulator.model)
    try:
        starts = [random_arrangement(np.random.default_rng([7, i]), None) for i in range(count)]
        return renderer.render(settled(simulator, starts))
    finally:
        renderer.close()


def desk_misfit(desk: LayerDynamics, images: Images) -> NDArray[np.float32]:
    with torch.inference_mode():
        misfit: NDArray[np.float32] = desk.perception.misfit(torch.from_numpy(images)).numpy()
    return misfit


def warns(desk: LayerDynamics, images: Images) -> bool:
    for model in (desk, desk.perception):
        model._warned_of_unfamiliar, model._images_seen = False, (0, 0)  # type: ignore[assignment]
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        LayerWorld(desk).observe(images)
    return any("one still camera and light, 3 coloured parts" in str(one.message) for one in said)


def saved(spec: object, path: Path) -> Path:
    path.write_text(spec.to_xml())  # type: ignore[attr-defined]
    return path


def test_real_desks_are_not_unfamiliar(desk: LayerDynamics) -> None:
    images = images_of(150)
    assert desk_misfit(desk, images).max() < 1.0
    assert not warns(desk, images[:1])


def test_the_shipped_model_of_the_desk_warns_of_a_moved_camera(
    desk: LayerDynamics, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours = rendering.camera

    def turned() -> object:
        camera = ours()
        camera.azimuth += 5
        return camera

    monkeypatch.setattr(rendering, "camera", turned)
    images = images_of(20)
    assert desk_misfit(desk, images).min() > 1.0
    assert warns(desk, images[:2])


def test_the_shipped_model_of_the_desk_warns_of_a_fourth_cube_in_plain_view(
    desk: LayerDynamics, tmp_path: Path
) -> None:
    spec = scene_spec()
    body = spec.worldbody.add_body(name="fourth", pos=[0.55, -0.1, BLOCK_SIZE / 2])
    half = [BLOCK_SIZE / 2] * 3
    colour = [0.9, 0.85, 0.1, 1]
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=half, rgba=colour, contype=0, conaffinity=0)
    spec.compile()
    images = images_of(40, saved(spec, tmp_path / "fourth.xml"))
    # Where the arm or a cube hides a part of it, nothing may be amiss.
    unfamiliar = desk_misfit(desk, images) > 1.0
    assert unfamiliar.mean() > 0.35
    assert warns(desk, images)
    assert warns(desk, images[unfamiliar][:2])


def test_the_shipped_model_of_the_desk_warns_of_another_table(
    desk: LayerDynamics, tmp_path: Path
) -> None:
    spec = scene_spec()
    next(geom for geom in spec.geoms if geom.name == "table").rgba = [0.3, 0.5, 0.35, 1]
    spec.compile()
    images = images_of(10, saved(spec, tmp_path / "table.xml"))
    assert desk_misfit(desk, images).min() > 1.0
    assert warns(desk, images)


def test_the_shipped_model_of_the_desk_warns_of_what_is_no_desk(desk: LayerDynamics) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (3, 64, 64, 3), dtype=np.uint8)
    assert warns(desk, noise)
    assert warns(desk, real_mazes(3, 10)[:2])


def test_a_fourth_cube_that_can_be_pushed_is_no_scene_of_the_simulator(tmp_path: Path) -> None:
    spec = scene_spec()
    body = spec.worldbody.add_body(name="fourth", pos=[0.55, -0.1, BLOCK_SIZE / 2])
    body.add_freejoint(name="fourth")
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[BLOCK_SIZE / 2] * 3, mass=0.1)
    spec.compile()
    with pytest.raises(ValueError, match=r"has the joints \[.*'fourth'\], expected"):
        load_scene(saved(spec, tmp_path / "pushed.xml"))
