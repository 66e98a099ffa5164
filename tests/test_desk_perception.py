"""What is seen at a toy of the desk, and drawn, against the toy's own truth."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import Tensor

import toy_desk as toy
from hvf.models.frames import to_unit
from hvf.models.layers.backdrop import Backdrop, BackdropConfig
from hvf.models.layers.colours import Colours, ColoursConfig
from hvf.models.layers.dynamics import LayerDynamicsConfig
from hvf.models.layers.gallery import GalleryConfig
from hvf.models.layers.perception import LayerPerception, LayerPerceptionConfig

Toy = tuple[LayerPerception, toy.Floats]


@pytest.fixture(scope="module")
def toy_seen() -> Toy:
    return toy.seen()


def anywhere(seed: int, count: int) -> toy.Floats:
    """States in which squares are between pixels and sliders anywhere."""
    rng = np.random.default_rng(seed)
    states = toy.scattered(rng, count)
    states[:, 3:5] = rng.uniform(0, 1, (count, 2))
    squares = states[:, 5:].reshape(count, 3, 3)
    squares[..., :2] += rng.uniform(-0.5, 0.5, (count, 3, 2))
    return states


def error(images: Tensor, truth: Tensor) -> NDArray[np.float32]:
    """Largest difference of a pixel's colours, in 256 levels: `[N, S, S]`."""
    found: NDArray[np.float32] = (255 * (images - to_unit(truth)).abs().amax(dim=1)).numpy()
    return found


def mostly_free(states: toy.Floats) -> NDArray[np.bool_]:
    """Pixels before which the arm is seldom, `[S, S]`, for every place of the table.

    In less than a third of those of its frames in which no square is near them.
    """
    flat = states.reshape(-1, 14)
    rows, columns = np.mgrid[:32, :32]
    squares = flat[:, 5:].reshape(-1, 3, 3)[..., None, None]
    far = np.maximum(abs(rows - squares[:, :, 0]), abs(columns - squares[:, :, 1])) > 3.6
    free = far.all(axis=1).astype(float)
    covered = free * toy.arm_opacity(flat[:, :3])
    both = [
        x.reshape(-1, toy.PLACES, states.shape[1], 32, 32).sum(axis=(0, 2)) for x in (covered, free)
    ]
    seldom: NDArray[np.bool_] = (both[0] < 0.32 * both[1]).all(axis=0)
    return seldom


# ---- coloured parts ----------------------------------------------------------------------------


def test_the_colours_of_what_changes_are_found_and_three_of_them_roam(toy_seen: Toy) -> None:
    colours = toy_seen[0].colours
    true = torch.tensor([*toy.SQUARES, toy.DOOR, toy.DRAWER]) / 255 @ colours.chroma_of
    distance, which = torch.cdist(colours.colours, true).min(dim=1)
    assert sorted(which.tolist()) == [0, 1, 2, 3, 4]
    assert float(distance.max()) < 0.01
    assert colours.roams.tolist() == [number < 3 for number in which.tolist()]
    assert sorted(toy.squares_in(toy_seen[0])) == [0, 1, 2]


@pytest.mark.parametrize("seed", [0, 2, 4])
def test_colours_of_seams_do_not_roam(seed: int) -> None:
    # Squares between pixels blend with the wood, and two colours more look for such pixels.
    states = [toy.scattered(np.random.default_rng(number), 200) for number in (1, 2)]
    for number, some in enumerate(states):
        some[::4] = anywhere(number, 50)
    first, second = (toy.frames_of(some) for some in states)
    colours = Colours(ColoursConfig(image_size=toy.SIZE, parts=7)).fit(first, second, seed)
    roaming = colours.colours[colours.roams]
    true = torch.tensor([*toy.SQUARES]) / 255 @ colours.chroma_of
    assert len(roaming) == 3
    assert float(torch.cdist(true, roaming).amin(dim=1).max()) < 0.05


def test_places_are_found_within_a_fraction_of_a_pixel(toy_seen: Toy) -> None:
    perception, _ = toy_seen
    states = anywhere(3, 300)
    parts = perception.colours(toy.frames_of(states, arm=False))[:, perception.colours.roams]
    truth = toy.as_seen(states, perception)[:, 5:].reshape(-1, 3, 3)
    assert float((parts[..., 1:] - truth[..., :2]).norm(dim=2).max()) < 0.6
    whole = toy.jumbled(4, 30, 2).reshape(-1, 14)
    parts = perception.colours(toy.frames_of(whole, arm=False))[:, perception.colours.roams]
    truth = toy.as_seen(whole, perception)[:, 5:].reshape(-1, 3, 3)
    assert float((parts[..., 1:] - truth[..., :2]).norm(dim=2).max()) < 0.01
    torch.testing.assert_close(parts[..., 0], torch.ones(60, 3), atol=0.01, rtol=0)


def test_a_part_that_is_not_seen_has_no_mass_and_the_middle_as_its_place(toy_seen: Toy) -> None:
    perception, _ = toy_seen
    states = toy.scattered(np.random.default_rng(5), 4)
    frames = toy.frames_of(states, squares=False)
    parts = perception.colours(frames)[:, perception.colours.roams]
    np.testing.assert_allclose(parts[..., 0], 0, atol=1e-6)
    np.testing.assert_allclose(parts[..., 1:], 15.5, atol=1e-3)
    _, _, observed = perception.split(perception.observe(frames))
    np.testing.assert_array_equal(observed[..., 2], 0)


def test_grey_frames_have_no_parts_to_find() -> None:
    grey = torch.randint(0, 255, (4, 32, 32, 1), dtype=torch.uint8).expand(-1, -1, -1, 3)
    with pytest.raises(ValueError, match="too few coloured pixels change"):
        Colours(ColoursConfig(image_size=32)).fit(grey[:2], grey[2:])


def test_other_numbers_of_parts_than_expected_are_an_error() -> None:
    states = toy.jumbled(0, toy.PLACES, 2)
    frames = toy.frames_of(states.reshape(-1, 14)).reshape(toy.PLACES, 2, 32, 32, 3)
    config = dataclasses.replace(toy.TINY.perception, roaming=2)
    with pytest.raises(ValueError, match="frames: 3 parts roam, expected 2"):
        LayerPerception(config).fit(frames[:, :2], frames)


# ---- what slides, and the backdrop -------------------------------------------------------------


def test_coordinates_of_sliders_follow_the_truth(toy_seen: Toy) -> None:
    perception, _ = toy_seen
    for slider, way in enumerate(toy.WAYS):
        states = np.repeat(toy.scattered(np.random.default_rng(6), 1), 8 * way + 1, axis=0)
        true = np.linspace(0, 1, 8 * way + 1)
        states[:, 3 + slider] = true
        found = perception.backdrop(perception.colours(toy.frames_of(states, arm=False)))
        coordinate = found[:, slider].numpy()
        assert np.diff(coordinate).min() > -1e-4
        assert np.corrcoef(coordinate, true)[0, 1] > 0.99
        # Where edges are between pixels, colours are not a slider's any more.
        np.testing.assert_allclose(coordinate[::8], true[::8], atol=0.01)
        np.testing.assert_allclose(coordinate, true, atol=0.6 / way)
        assert np.ptp(found[:, 1 - slider].numpy()) < 1e-4


def test_too_few_things_that_slide_are_an_error(toy_seen: Toy) -> None:
    perception, _ = toy_seen
    colours = perception.colours
    seen = torch.rand(5, 4, len(colours.roams), 3)
    # All fixtures are one and the same thing.
    seen[:, :, ~colours.roams] = seen[:, :, ~colours.roams][:, :, :1]
    with pytest.raises(ValueError, match="frames: 1 things slide, expected 2"):
        Backdrop(toy.TINY.perception.backdrop, 32).fit_sliders(seen, colours)


def test_backdrops_are_true_at_places_of_the_table_and_between(toy_seen: Toy) -> None:
    perception, states = toy_seen
    known = mostly_free(states)
    assert known.mean() > 0.8
    door, drawer = (np.linspace(0, 1, 2 * way + 1) for way in toy.WAYS)
    wanted = np.zeros((len(door) * len(drawer), 14))
    wanted[:, 3:5] = np.stack(np.meshgrid(door, drawer, indexing="ij"), axis=2).reshape(-1, 2)
    drawn = perception.backdrop.draw(torch.from_numpy(wanted[:, 3:5]).float())
    # A place is a pixel from the next: between, a mean of images is the image of the mean.
    wrong = error(drawn, toy.frames_of(wanted, arm=False, squares=False))
    assert wrong[:, known].max() < 1.0


def test_medians_are_not_fooled_by_what_passes() -> None:
    rng = np.random.default_rng(7)
    truth = rng.integers(0, 256, (2, 3, 16, 16, 3), dtype=np.uint8)
    backdrop = Backdrop(BackdropConfig(bins=(2, 3)), 16)
    places = np.array([(i, j) for i in range(2) for j in range(3)])
    which = rng.permutation(np.repeat(np.arange(6), 21))
    frames = truth[places[which, 0], places[which, 1]]
    hidden = np.zeros(frames.shape[:3], bool)
    for place in range(6):
        own = np.flatnonzero(which == place)
        # Ten of 21 are covered at every pixel; half of the rest, and it is known.
        order = rng.permuted(np.tile(own[:, None, None], (1, 16, 16)), axis=0)
        rows, columns = np.mgrid[:16, :16]
        for rank in range(15):
            frames[order[rank], rows, columns] = rng.integers(0, 256, 3)
            if rank >= 4:
                hidden[order[rank], rows, columns] = True
    coordinates = places[which] / np.array([1, 2]) + rng.uniform(-0.01, 0.01, (len(which), 2))
    backdrop.fit_table(
        torch.from_numpy(frames), torch.from_numpy(coordinates).float(), torch.from_numpy(hidden)
    )
    np.testing.assert_array_equal(backdrop.table.permute(0, 1, 3, 4, 2).numpy(), truth)


def test_places_without_a_frame_look_like_the_nearest_that_has_some() -> None:
    backdrop = Backdrop(BackdropConfig(bins=(5, 4)), 16)
    corners = torch.tensor([[0.0, 0.0], [0.98, 1.0], [0.5, 1.5]])
    values = torch.tensor([10, 200, 90], dtype=torch.uint8)
    frames = values[:, None, None, None].expand(3, 16, 16, 3)
    backdrop.fit_table(frames, corners, torch.zeros(3, 16, 16, dtype=torch.bool))
    for i in range(5):
        for j in range(4):
            near = i**2 + j**2 < (4 - i) ** 2 + (3 - j) ** 2
            assert set(backdrop.table[i, j].flatten().tolist()) == {10 if near else 200}
    # The third frame's coordinates are beyond the ends: its slider is half hidden.
    with pytest.raises(ValueError, match="frames: none to take a backdrop from"):
        backdrop.fit_table(frames[2:], corners[2:], torch.zeros(1, 16, 16, dtype=torch.bool))


@settings(max_examples=30)
@given(
    coordinates=st.lists(
        st.tuples(st.floats(-0.2, 1.2), st.floats(-0.2, 1.2)), min_size=1, max_size=5
    ),
    bins=st.tuples(st.integers(2, 6), st.integers(2, 6)),
)
def test_between_places_backdrops_are_interpolated(
    coordinates: list[tuple[float, float]], bins: tuple[int, int]
) -> None:
    backdrop = Backdrop(BackdropConfig(bins=bins), 16)
    table = np.random.default_rng(8).integers(0, 256, (*bins, 3, 16, 16)).astype(np.uint8)
    backdrop.table.copy_(torch.from_numpy(table))
    drawn = backdrop.draw(torch.tensor(coordinates)).numpy()
    for image, pair in zip(drawn, coordinates, strict=True):
        u, v = (min(max(c, 0.0), 1.0) * (n - 1) for c, n in zip(pair, bins, strict=True))
        expected = np.zeros((3, 16, 16))
        for i in range(bins[0]):
            for j in range(bins[1]):
                weight = max(0.0, 1 - abs(u - i)) * max(0.0, 1 - abs(v - j))
                expected += weight * table[i, j] / 255
        np.testing.assert_allclose(image, expected, atol=1e-5)


# ---- squares, scenes, changes ------------------------------------------------------------------


def test_sprites_reproduce_the_squares(toy_seen: Toy) -> None:
    perception, _ = toy_seen
    for sprite, number in zip(perception.sprites, toy.squares_in(perception), strict=True):
        inside = sprite[:, 2:7, 2:7]
        colour = torch.tensor(toy.SQUARES[number]) / 255
        assert float(inside[0].min()) > 0.95
        assert float((inside[1:] - colour[:, None, None]).abs().max()) < 0.05
        outside = sprite.clone()
        outside[:, 2:7, 2:7] = 0
        # What little there is comes from arms beside the square.
        assert float(outside[0].max()) < 0.2
        assert float(outside[0].sum()) < 3
    states = toy.jumbled(9, 20, 1)[:, 0]
    pasted = perception.paste(
        to_unit(toy.frames_of(states, arm=False, squares=False)),
        toy.as_seen(states, perception)[:, 5:].reshape(-1, 3, 3),
    )
    wrong = error(pasted, toy.frames_of(states, arm=False))
    assert wrong.max() < 30
    assert wrong.mean() < 1


def test_a_sprite_between_pixels_is_a_mean_of_its_neighbours() -> None:
    perception = LayerPerception(dataclasses.replace(toy.TINY.perception, roaming=1))
    perception.sprites.copy_(torch.rand(1, 4, 9, 9))
    images = torch.zeros(5, 3, 32, 32)
    parts = torch.tensor([[10.0, 12.0], [10, 13], [11, 12], [11, 13], [10.25, 12.75]])
    parts = torch.cat([parts, torch.ones(5, 1)], dim=1)[:, None]
    drawn = perception.paste(images, parts)
    expected = 0.75 * 0.25 * drawn[0] + 0.75 * 0.75 * drawn[1]
    expected += 0.25 * 0.25 * drawn[2] + 0.25 * 0.75 * drawn[3]
    torch.testing.assert_close(drawn[4], expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(drawn[0, :, 6:15, 8:17], perception.sprites[0, 1:])
    assert float(drawn[0].sum()) == pytest.approx(float(perception.sprites[0, 1:].sum()), rel=1e-5)


def test_states_are_what_is_seen(toy_seen: Toy) -> None:
    perception, _ = toy_seen
    states = toy.scattered(np.random.default_rng(10), 70)
    frames = toy.frames_of(states)
    truth = toy.as_seen(states, perception)
    observed, mass = perception.look(frames)
    # The bar of the arm passes before squares: of some, too little is left.
    whole = mass > 0.99
    assert float(whole.float().mean()) > 0.5
    _, sliders, parts = perception.split(observed)
    _, true_sliders, true_parts = perception.split(truth)
    assert float((parts - true_parts)[whole].abs().max()) < 0.05
    np.testing.assert_array_equal(parts[..., 2], (mass > 0.12).float())
    row, column = toy.place(states[:, :3]).T
    clear = torch.from_numpy((row > 8.6) & (column + 3.1 < 27.5 - toy.DRAWER_WAY * states[:, 4]))
    assert int(clear.sum()) > 20
    assert float((sliders - true_sliders)[clear].abs().max()) < 0.02
    seen = perception.perceive(frames[:7])
    torch.testing.assert_close(seen.states, observed[:7], atol=1e-5, rtol=1e-5)
    arm = torch.from_numpy(toy.arm_opacity(states[:7, :3])).bool()
    squares = seen.regions.any(dim=1)
    assert float(((seen.opacity > 0.5) == arm)[~squares].float().mean()) > 0.98
    assert float(seen.opacity[squares].max()) == 0


def test_a_scene_is_the_frame_without_its_arm(toy_seen: Toy) -> None:
    perception, states = toy_seen
    known = mostly_free(states)
    # The arm right of the squares: nothing that is found is hidden.
    beside = toy.scattered(np.random.default_rng(11), 30)
    beside[:, 1] = np.linspace(1.5, 1.7, 30)
    beside[:, 4] = 0
    scenes = perception.scene(toy.frames_of(beside))
    assert (error(to_unit(toy.frames_of(beside)), scenes_of(beside)) > 60).sum() > 30 * 25
    assert error(scenes.image, scenes_of(beside))[:, known].max() < 15
    np.testing.assert_array_equal(
        scenes.states[:, 3:], perception.observe(toy.frames_of(beside))[:, 3:]
    )
    # The arm anywhere: squares that are half hidden are put where their other half is.
    some = toy.jumbled(12, 60, 1)[:, 0]
    wrong = error(perception.scene(toy.frames_of(some)).image, scenes_of(some)) > 60
    before = error(to_unit(toy.frames_of(some)), scenes_of(some)) > 60
    assert wrong[:, known].sum() < 0.25 * before[:, known].sum()


def scenes_of(states: toy.Floats) -> Tensor:
    """Frames without the arm."""
    return toy.frames_of(states, arm=False)


def test_a_scene_that_nothing_changes_stays_as_it_is(toy_seen: Toy) -> None:
    perception, _ = toy_seen
    scenes = perception.scene(toy.frames_of(toy.scattered(np.random.default_rng(12), 10)))
    same = perception.change(scenes, scenes.states)
    torch.testing.assert_close(same.image, scenes.image, atol=1e-6, rtol=0)
    torch.testing.assert_close(same.regions, scenes.regions)
    # The gallery is empty: there is no arm to draw.
    drawn = perception.draw(scenes, scenes.states)
    torch.testing.assert_close(drawn, scenes.image, atol=1e-6, rtol=0)
    little = scenes.states.clone()
    little[:, 5] += 0.4
    torch.testing.assert_close(perception.change(scenes, little).image, same.image)


def test_what_moves_is_gone_where_it_was_and_drawn_where_it_is(toy_seen: Toy) -> None:
    perception, known = toy_seen[0], mostly_free(toy_seen[1])
    before = np.zeros((1, 14))
    before[0] = [0, 0, 0, 0.2, 0.3, 20, 5, 1, 26, 12, 1, 15, 17, 1]
    # A square goes up and left, another right, the third is gone; door and drawer slide.
    for changes in ({5: 18.0, 6: 4.25}, {9: 19.5}, {13: 0.0}, {3: 0.85, 4: 0.9}):
        after = before.copy()
        for place, value in changes.items():
            after[0, place] = value
        scenes = perception.scene(toy.frames_of(before, arm=False))
        hand = scenes.states[:, :3]
        states = torch.cat([hand, toy.as_seen(after, perception)[:, 3:]], dim=1)
        wanted = toy.frames_of(after, arm=False)
        was = error(scenes.image, wanted)
        changed = perception.change(scenes, states)
        assert (was > 60).sum() >= 20
        assert error(changed.image, wanted)[:, known].max() < 15
        # On from there, and back.
        back = perception.change(changed, torch.cat([hand, scenes.states[:, 3:]], dim=1))
        assert error(back.image, toy.frames_of(before, arm=False))[:, known].max() < 15


def test_the_arm_is_drawn_before_everything(toy_seen: Toy) -> None:
    perception, _ = toy_seen
    scenes = perception.scene(toy.frames_of(toy.scattered(np.random.default_rng(13), 3)))
    opacity, colour = torch.rand(3, 1, 32, 32), 0.1 * torch.rand(3, 3, 32, 32)
    model = LayerPerception(toy.TINY.perception)
    model.load_state_dict(perception.state_dict())
    model.gallery.forward = lambda codes: (opacity, colour)  # type: ignore[method-assign]
    drawn = model.draw(scenes, scenes.states)
    expected = (scenes.image * (1 - opacity) + colour).clamp(0, 1)
    torch.testing.assert_close(drawn, expected, atol=1e-6, rtol=0)


# ---- settings ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "settings", "message"),
    [
        (ColoursConfig, {"image_size": 40}, "image_size must be a multiple of 16"),
        (ColoursConfig, {"parts": 0}, "parts must be at least 1"),
        (ColoursConfig, {"width": 0.0}, "width must be between 0 and 1"),
        (BackdropConfig, {"bins": (1, 4)}, "bins must be at least 2"),
        (GalleryConfig, {"places": (2, 2, 1)}, "places must be at least 2"),
        (GalleryConfig, {"patches": 2**15}, "patches must be from 1 to 32767"),
        (LayerPerceptionConfig, {"roaming": 0}, "roaming must be at least 1"),
        (LayerPerceptionConfig, {"sprite": 8}, "sprite must be odd"),
        (LayerDynamicsConfig, {"hand_pixels": -1.0}, "hand_pixels must be positive"),
        (LayerDynamicsConfig, {"slider_pixels": float("nan")}, "slider_pixels must be positive"),
    ],
)
def test_settings_out_of_range_are_named(
    kind: type[Any], settings: dict[str, object], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        kind(**settings)
