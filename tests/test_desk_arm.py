"""The arm at the desk: what its code is trained for, its sketch, and the gallery of its images."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import Tensor

import toy_desk as toy
from hvf.models.frames import to_unit
from hvf.models.layers.arm import Arm, ArmConfig
from hvf.models.layers.gallery import Gallery, GalleryConfig

Arms = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]
PAIR = st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(0.05, 1), st.booleans())


def arm_of(codes: Tensor, **settings: float) -> Arm:
    """An arm that sees `codes [N, 1]`."""
    config = ArmConfig(action_dim=1, channels=(4, 8), hidden=8, features=6, patch_rank=3)
    arm = Arm(ArmConfig(**{**vars(config), **settings}), 16)
    arm.forward = lambda images, opacity: codes  # type: ignore[method-assign]
    return arm


def nothing(count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Images, backdrops and hidden pixels of frames without an arm."""
    return (
        torch.zeros(count, 3, 16, 16),
        torch.zeros(count, 3, 16, 16),
        torch.zeros(count, 16, 16) > 0,
    )


# ---- the code ----------------------------------------------------------------------------------


def test_the_hand_pays_in_full_for_going_too_far_or_back() -> None:
    codes = torch.tensor([[0.0], [0.7], [0.0], [0.2], [0.0], [-0.4]])
    loss, _ = arm_of(codes, sketch=0.0).loss(*nothing(6), torch.full((3, 1), 0.5))
    # 0.2 too far; 0.3 short, at 0.6 of the price; 0.4 back, and 0.9 short.
    assert float(loss.detach()) == pytest.approx((0.2 + 0.6 * 0.3 + 0.4 + 0.6 * 0.9) / 3, rel=1e-5)


@settings(max_examples=50)
@given(pairs=st.lists(PAIR, min_size=1, max_size=6), price=st.floats(0, 2))
def test_motion_costs_by_how_it_differs_from_the_action(
    pairs: list[tuple[float, float, float, bool]], price: float
) -> None:
    expected, codes, actions = 0.0, [], []
    for before, after, size, forward in pairs:
        action = size if forward else -size
        codes += [[before], [after]]
        actions.append([action])
        moved = (after - before) * (1 if forward else -1)
        if moved > size:
            expected += moved - size
        elif moved >= 0:
            expected += price * (size - moved)
        else:
            expected += -moved + price * (size - moved)
    arm = arm_of(torch.tensor(codes), sketch=0.0, shortfall=price)
    loss, _ = arm.loss(*nothing(len(codes)), torch.tensor(actions))
    assert float(loss.detach()) == pytest.approx(expected / len(pairs), rel=1e-4, abs=1e-5)


def test_codes_of_the_toy_learn_to_follow_the_hand() -> None:
    torch.manual_seed(0)
    actions, states = toy.make(1, 60, 20)
    images, behind = (clear_frames(states.reshape(-1, 14), arm) for arm in (True, False))
    arm = Arm(toy.TINY.perception.arm, 32)
    optimiser = torch.optim.Adam(arm.parameters(), 5e-3)
    rng = np.random.default_rng(2)
    for _ in range(150):
        episode, time = rng.integers(60, size=32), rng.integers(20, size=32)
        pair = (21 * episode + time)[:, None] + np.arange(2)
        shown, back = images[pair.ravel()], behind[pair.ravel()]
        loss, _ = arm.loss(shown, back, unhidden(64), torch.from_numpy(actions[episode, time]))
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        optimiser.step()
    _, fresh = toy.make(3, 20, 20)
    hands = fresh.reshape(-1, 14)
    frames, clean = (clear_frames(hands, arm) for arm in (True, False))
    with torch.inference_mode():
        codes = arm(frames, arm.opacity(frames, clean, unhidden(len(frames)))).numpy()
    for axis, least in ((0, 0.8), (1, 0.95)):
        slope, _ = np.polyfit(hands[:, axis], codes[:, axis], 1)
        assert np.corrcoef(hands[:, axis], codes[:, axis])[0, 1] > least
        # In full actions, and on the way there: less is cheaper than more.
        assert 0.2 < slope < 1.1


def clear_frames(states: toy.Floats, arm: bool) -> Tensor:
    """Frames float `[N, 3, S, S]`."""
    return to_unit(toy.frames_of(states, arm=arm)).contiguous()


def unhidden(count: int) -> Tensor:
    """Hidden pixels, bool `[N, S, S]`: none."""
    return torch.zeros(count, 32, 32, dtype=torch.bool)


def test_opacity_rises_with_the_difference_to_the_backdrop() -> None:
    arm = Arm(ArmConfig(channels=(4, 8)), 16)
    differences = torch.linspace(0, 0.3, 256)
    images = torch.full((1, 3, 16, 16), 0.4)
    backdrop = images.clone()
    backdrop[0, 1] += 0.5 * differences.reshape(16, 16)
    # The colour that differs most counts, whichever way.
    images[0, 2] -= differences.reshape(16, 16)
    hidden = torch.zeros(1, 16, 16, dtype=torch.bool)
    hidden[0, 12] = True
    opacity = arm.opacity(images, backdrop, hidden)[0]
    expected = ((differences.numpy() - 0.06) / 0.12).clip(0, 1).reshape(16, 16)
    expected[12] = 0
    np.testing.assert_allclose(opacity.numpy(), expected, atol=1e-6)


# ---- the sketch --------------------------------------------------------------------------------


def test_a_sketch_is_put_together_of_patches() -> None:
    torch.manual_seed(1)
    arm = Arm(ArmConfig(channels=(4,), hidden=8, features=5, patch=8, patch_rank=3), 24)
    code = torch.randn(2, 3)
    opacity, colour = arm.sketch(code)
    waves = [np.pi / 2 * 2**i for i in range(4)]
    for n in range(2):
        coarse = 0.3 * code[n].double().numpy()
        phases = np.array([x * wave for x in coarse for wave in waves])
        seen = np.concatenate([coarse, np.sin(phases), np.cos(phases)])
        weights = arm.patches(arm.features(torch.from_numpy(seen).float())).reshape(9, 3)
        for square in range(9):
            patch = (weights[square] @ arm.patch).reshape(4, 8, 8)
            row, column = 8 * (square // 3), 8 * (square % 3)
            drawn = torch.cat([opacity, colour], dim=1)[n, :, row : row + 8, column : column + 8]
            torch.testing.assert_close(drawn, patch, atol=1e-5, rtol=1e-4)


def test_what_the_sketch_teaches_the_code_is_scaled_down() -> None:
    torch.manual_seed(2)
    images, backdrop = torch.rand(4, 3, 16, 16), torch.rand(4, 3, 16, 16)
    hidden = torch.rand(4, 16, 16) < 0.2
    gradients = {}
    for share in (1.0, 0.25, 0.0):
        codes = torch.tensor([[0.5], [1.0], [-0.25], [0.25]], requires_grad=True)
        torch.manual_seed(3)
        arm = arm_of(codes, sketch=1.0, sketch_share=share)
        # Every code moves as far as its action: but for the sketch there is nothing to learn.
        loss, _ = arm.loss(images, backdrop, hidden, torch.full((2, 1), 0.5))
        (gradients[share],) = torch.autograd.grad(loss, codes, allow_unused=True)
    assert float(gradients[1.0].abs().min()) > 0
    torch.testing.assert_close(gradients[0.25], 0.25 * gradients[1.0])
    torch.testing.assert_close(gradients[0.0], 0.0 * gradients[1.0])


def test_hidden_pixels_teach_the_sketch_nothing() -> None:
    torch.manual_seed(4)
    images, backdrop = torch.rand(2, 3, 16, 16), torch.rand(2, 3, 16, 16)
    hidden = torch.rand(2, 16, 16) < 0.5
    other = torch.where(hidden[:, None], torch.rand(2, 3, 16, 16), images)
    arm = arm_of(torch.tensor([[0.0], [0.5]]), sketch=1.0)
    losses = [arm.loss(x, backdrop, hidden, torch.full((1, 1), 0.5))[0] for x in (images, other)]
    torch.testing.assert_close(losses[0], losses[1])
    assert float(losses[0].detach()) > 1


# ---- the gallery -------------------------------------------------------------------------------


def gallery(patches: int = 300) -> Gallery:
    """A gallery of 2 x 3 x 2 places, one unit apart, from -1 on."""
    made = Gallery(GalleryConfig(places=(2, 3, 2), patches=patches), 16)
    made.low.fill_(-1.0)
    return made


def seen_arms(seed: int, each: int) -> Arms:
    """Codes at the places, `each` times; opacity and images of 16 pixels, and what is hidden."""
    rng = np.random.default_rng(seed)
    places = list(itertools.product((-1, 0), (-1, 0, 1), (-1, 0)))
    codes = np.repeat(np.array(places, np.float32), each, axis=0)
    opacity = rng.uniform(0, 1, (len(codes), 16, 16)).astype(np.float32)
    opacity[:, :8, :8] *= 0.2
    images = rng.uniform(0, 1, (len(codes), 3, 16, 16)).astype(np.float32)
    hidden = rng.random((len(codes), 16, 16)) < 0.3
    return codes, opacity, images, hidden


def stream(arrays: Arms) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """The same as tensors, five frames at a time."""
    codes, opacity, images, hidden = (torch.split(torch.from_numpy(x), 5) for x in arrays)
    return zip(codes, opacity, images, hidden, strict=True)


def expected_arm(opacity: NDArray[np.float32], images: NDArray[np.float32]) -> NDArray[np.float64]:
    """What the gallery keeps of frames of one place: mean, less the noise of other edges."""
    mean = opacity.mean(axis=0, dtype=np.float64)
    colour = (images * opacity[:, None]).mean(axis=0, dtype=np.float64)
    clean = ((mean - 0.15) / 0.85).clip(0)
    return np.concatenate([clean[None], colour * clean / mean.clip(1e-3)])


def drawn(model: Gallery, codes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Opacity and colour times opacity of hands at `codes [N, 3]`: `[N, 4, S, S]`."""
    found: NDArray[np.float32] = torch.cat(model(torch.from_numpy(codes)), dim=1).numpy()
    return found


def test_at_its_places_the_gallery_shows_mean_images() -> None:
    codes, opacity, images, hidden = seen_arms(0, 3)
    model = gallery().fit(stream((codes, opacity, images, np.zeros_like(hidden))))
    found = drawn(model, codes[::3])
    for k in range(12):
        own = slice(3 * k, 3 * k + 3)
        np.testing.assert_allclose(
            found[k], expected_arm(opacity[own], images[own]), atol=0.5 / 255 + 1e-5
        )
    # The upper left is never more than noise: nothing is kept of it.
    assert found[:, :, :8, :8].max() < 0.06
    assert found[:, 0, 8:, 8:].mean() > 0.3


def test_hidden_pixels_do_not_count_in_the_gallery() -> None:
    codes, opacity, images, hidden = seen_arms(1, 6)
    model = gallery().fit(stream((codes, opacity, images, hidden)))
    lost = np.where(hidden, np.float32(1), opacity)
    same = gallery().fit(stream((codes, lost, images, hidden)))
    np.testing.assert_array_equal(drawn(model, codes), drawn(same, codes))
    row, column = 12, 9
    for k in range(12):
        own = np.arange(6 * k, 6 * k + 6)
        own = own[~hidden[own, row, column].astype(bool)]
        if len(own):
            wanted = expected_arm(opacity[own], images[own])[:, row, column]
            np.testing.assert_allclose(
                drawn(model, codes)[6 * k, :, row, column], wanted, atol=0.5 / 255 + 1e-5
            )


@settings(max_examples=40)
@given(
    codes=st.lists(
        st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3)), min_size=1, max_size=4
    )
)
def test_between_places_the_gallery_is_linear_and_beyond_it_ends(
    codes: list[tuple[float, float, float]],
) -> None:
    model = gallery().fit(stream(seen_arms(2, 1)))
    places = seen_arms(2, 1)[0]
    images = drawn(model, places)
    for code, image in zip(codes, drawn(model, np.array(codes, np.float32)), strict=True):
        inside = np.clip(code, (-1, -1, -1), (0, 1, 0))
        weights = np.prod(np.maximum(0, 1 - np.abs(places - inside)), axis=1)
        assert weights.sum() == pytest.approx(1, abs=1e-5)
        np.testing.assert_allclose(image, np.tensordot(weights, images, axes=1), atol=1e-5)


def test_a_place_that_was_not_seen_looks_like_the_nearest() -> None:
    codes, opacity, images, hidden = seen_arms(3, 2)
    kept = (codes[:, 1] != 0) & (codes[:, 2] == -1)
    some = codes[kept], opacity[kept], images[kept], hidden[kept]
    model = gallery().fit(stream(some))
    full = gallery().fit(stream((codes, opacity, images, hidden)))
    for code in codes[::2]:
        shown = drawn(model, code[None])[0]
        if code[1] != 0:
            like = np.array([code[0], code[1], -1], np.float32)
            np.testing.assert_array_equal(shown, drawn(full, like[None])[0])
        else:
            sides = [np.array([code[0], side, -1], np.float32) for side in (-1, 1)]
            assert any((shown == drawn(full, like[None])[0]).all() for like in sides)


def test_patches_with_most_of_the_arm_are_kept() -> None:
    codes, opacity, images, hidden = seen_arms(4, 1)
    hidden = np.zeros_like(hidden)
    rich = gallery().fit(stream((codes, opacity, images, hidden)))
    poor = gallery(21).fit(stream((codes, opacity, images, hidden)))
    all_of_it, some_of_it = drawn(rich, codes), drawn(poor, codes)
    squares = all_of_it.reshape(12, 4, 2, 8, 2, 8).transpose(0, 2, 4, 1, 3, 5).reshape(48, -1)
    few = some_of_it.reshape(12, 4, 2, 8, 2, 8).transpose(0, 2, 4, 1, 3, 5).reshape(48, -1)
    most = np.argsort(-squares[:, :64].sum(axis=1))[:20]
    np.testing.assert_array_equal(few[most], squares[most])
    assert few[np.setdiff1d(np.arange(48), most)].max() == 0


def test_the_grid_lies_over_the_codes_but_for_their_tails() -> None:
    codes = torch.rand(2000, 3) * torch.tensor([2.0, 6.0, 0.5]) + torch.tensor([-1.0, 0, 3])
    model = gallery().fit_grid(codes)
    last = model.low + model.step * torch.tensor([1, 2, 1])
    for bound, share in ((model.low, 0.003), (last, 0.997)):
        np.testing.assert_allclose(bound, np.quantile(codes.numpy(), share, axis=0), atol=1e-4)


def test_a_code_that_never_changes_has_a_gallery_too() -> None:
    codes, opacity, images, hidden = seen_arms(5, 2)
    codes[:, 2] = 0.25
    model = gallery().fit_grid(torch.from_numpy(codes))
    shown = drawn(model.fit(stream((codes, opacity, images, hidden))), codes)
    assert np.isfinite(shown).all()
    assert shown[:, 0].max() > 0.3


def test_images_that_patches_do_not_fit_into_are_refused() -> None:
    with pytest.raises(ValueError, match="image_size must be a multiple of 8, got 20"):
        Gallery(GalleryConfig(), 20)
    with pytest.raises(ValueError, match="image_size must be a multiple of 16 and of the patch 8"):
        Arm(ArmConfig(), 24)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"channels": ()}, "channels must be positive"),
        ({"hidden": 0}, "hidden must be at least 1"),
        ({"shortfall": -0.1}, "shortfall must not be negative"),
        ({"sketch_share": float("inf")}, "sketch_share must not be negative"),
    ],
)
def test_settings_out_of_range_are_named(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ArmConfig(**settings)  # type: ignore[arg-type]
