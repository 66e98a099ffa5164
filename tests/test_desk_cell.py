"""One step of the desk's dynamics, and rollouts of it, against a slow copy in NumPy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import Tensor, nn

from hvf.models.layers.cell import CellConfig, quadratic
from hvf.models.layers.dynamics import LayerDynamics
from layered_desk import ACTION, PARTS, random_dynamics, random_states

Floats = NDArray[np.float64]
FIXED = ACTION + 2
"""Numbers of a state before those of its parts."""


@pytest.fixture(scope="module")
def dynamics() -> LayerDynamics:
    return random_dynamics(1).requires_grad_(False)


def random_actions(seed: int, count: int, steps: int) -> Tensor:
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.uniform(-1, 1, (count, steps, ACTION)).astype(np.float32))


# ---- the slow copy -----------------------------------------------------------------------------


def answer(network: nn.Module, inputs: list[Floats]) -> Floats:
    """What a network says, layer by layer."""
    x: Floats = np.concatenate(inputs)
    linear = [layer for layer in network.modules() if isinstance(layer, nn.Linear)]
    for layer in linear:
        weight, bias = layer.weight.double().numpy(), layer.bias.double().numpy()
        x = weight @ x + bias
        if layer is not linear[-1]:
            x = np.maximum(x, 0)
    return x


def meets(dynamics: LayerDynamics, hand: Floats) -> Floats:
    """Where the hand meets parts."""
    terms = [1.0, *hand]
    terms += [hand[i] * hand[j] for i in range(len(hand)) for j in range(i, len(hand))]
    place: Floats = np.array(terms) @ dynamics.cell.contact.double().numpy()
    return place


def distance(point: Floats, start: Floats, end: Floats) -> float:
    """Of a point from the way between two others."""
    way = end - start
    length = float(np.hypot(*way))
    along = float((point - start) @ way) / max(length, 1e-9)
    if 0 < along < length:
        return abs(float(way[0] * (point - start)[1] - way[1] * (point - start)[0])) / length
    return float(min(np.hypot(*(point - start)), np.hypot(*(point - end))))


def slow_rollout(
    dynamics: LayerDynamics, state: NDArray[np.float32], actions: Tensor
) -> tuple[Floats, float]:
    """States `[H, X]`, and how near, at the nearest, a part is to the border of the reach."""
    cell = dynamics.cell
    hand, sliders = state[:ACTION].astype(float), state[ACTION:FIXED].astype(float)
    parts = state[FIXED:].astype(float).reshape(PARTS, 3)
    memory = np.zeros((PARTS, cell.config.memory))
    path, closest = [], np.inf
    for action in actions.double().numpy():
        moved = answer(cell.hand, [hand, action, sliders])
        slid = [answer(one, [sliders, hand, moved, action])[0] for one in cell.sliders]
        before, after = meets(dynamics, hand), meets(dynamics, hand + moved)
        for i in range(PARTS):
            part = parts[i].copy()
            apart = distance(part[:2], before, after)
            closest = min(closest, abs(apart - cell.config.reach))
            if apart >= cell.config.reach:
                continue
            pushed = answer(
                cell.parts,
                [
                    (before - part[:2]) / 8,
                    (after - before) / 8,
                    hand,
                    moved,
                    action,
                    part[:2] / 32 - 1,
                    part[2:],
                    memory[i],
                ],
            )
            parts[i, :2] += 8 * pushed[:2]
            parts[i, 2] = min(max(parts[i, 2] + pushed[2], 0), 1)
            memory[i] += pushed[3:]
        hand = hand + moved
        sliders = np.clip(sliders + 0.1 * np.array(slid), 0, 1)
        path.append(np.concatenate([hand, sliders, parts.ravel()]))
    return np.stack(path), closest


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1))
def test_rollouts_are_those_of_a_slow_copy(dynamics: LayerDynamics, seed: int) -> None:
    states, actions = random_states(4, seed), random_actions(seed, 4, 5)
    path = dynamics.rollout(torch.from_numpy(states), actions).numpy()
    assert path.shape == (4, 5, FIXED + 3 * PARTS)
    for found, state, action in zip(path, states, actions, strict=True):
        expected, closest = slow_rollout(dynamics, state, action)
        if closest > 1e-3:
            np.testing.assert_allclose(found, expected, atol=2e-3, rtol=1e-4)


def test_the_last_state_is_that_of_the_path(dynamics: LayerDynamics) -> None:
    states, actions = torch.from_numpy(random_states(6, 1)), random_actions(1, 6, 4)
    last = dynamics.rollout(states, actions, last=True)
    assert torch.equal(last, dynamics.rollout(states, actions)[:, -1:])


def test_rollouts_do_not_depend_on_their_neighbours(dynamics: LayerDynamics) -> None:
    states, actions = torch.from_numpy(random_states(9, 2)), random_actions(2, 9, 4)
    together = dynamics.rollout(states, actions)
    for i in range(9):
        alone = dynamics.rollout(states[i : i + 1], actions[i : i + 1])
        torch.testing.assert_close(together[i : i + 1], alone, atol=1e-4, rtol=1e-4)


# ---- what heeds what ---------------------------------------------------------------------------


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    share=st.floats(-0.5, 1.5),
    side=st.sampled_from([-1, 1]),
    away=st.floats(0.01, 30),
)
def test_a_part_out_of_reach_does_not_move_by_a_bit(
    dynamics: LayerDynamics, seed: int, share: float, side: int, away: float
) -> None:
    state, actions = random_states(1, seed), random_actions(seed, 1, 1)
    hand = state[0, :ACTION].astype(float)
    moved = answer(
        dynamics.cell.hand,
        [hand, actions[0, 0].double().numpy(), state[0, ACTION:FIXED].astype(float)],
    )
    before, after = meets(dynamics, hand), meets(dynamics, hand + moved)
    # Beside the hand's way, or before or behind it.
    across = side * np.array([-(after - before)[1], (after - before)[0]])
    across *= (dynamics.cell.config.reach + away) / max(float(np.hypot(*across)), 1e-9)
    place = before + share * (after - before) + across
    assume(distance(place, before, after) > dynamics.cell.config.reach + 1e-3)
    state[0, FIXED : FIXED + 2] = place
    path = dynamics.rollout(torch.from_numpy(state), actions)[0, 0].numpy()
    assert path[FIXED : FIXED + 3].tobytes() == state[0, FIXED : FIXED + 3].tobytes()
    # Within reach it moves: these networks say so of everything.
    near = state.copy()
    near[0, FIXED : FIXED + 2] = before + 0.5 * (after - before) + 0.1 * across / (1 + away)
    path = dynamics.rollout(torch.from_numpy(near), actions)[0, 0].numpy()
    assert not np.array_equal(path[FIXED : FIXED + 2], near[0, FIXED : FIXED + 2])


def test_a_part_heeds_the_hand_and_itself_alone(dynamics: LayerDynamics) -> None:
    states, actions = torch.from_numpy(random_states(50, 3)), random_actions(3, 50, 5)
    path = dynamics.rollout(states, actions)
    other = states.clone()
    other[:, FIXED : FIXED + 3] += torch.tensor([2.0, -1.0, -0.5])
    changed = dynamics.rollout(other, actions)
    assert not torch.equal(path[..., FIXED : FIXED + 2], changed[..., FIXED : FIXED + 2])
    assert torch.equal(path[..., FIXED + 3 :], changed[..., FIXED + 3 :])
    # Hand and sliders do not heed parts.
    assert torch.equal(path[..., :FIXED], changed[..., :FIXED])
    for number in range(ACTION):
        other = states.clone()
        other[:, number] += 0.5
        assert not torch.equal(path[..., FIXED:], dynamics.rollout(other, actions)[..., FIXED:])


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_sliders_and_presence_stay_between_nothing_and_all(
    dynamics: LayerDynamics, seed: int
) -> None:
    states, actions = torch.from_numpy(random_states(20, seed)), random_actions(seed, 20, 8)
    _, sliders, parts = dynamics.perception.split(dynamics.rollout(states, actions).flatten(0, 1))
    for bounded in (sliders, parts[..., 2]):
        assert float(bounded.min()) >= 0
        assert float(bounded.max()) <= 1


# ---- where the hand meets parts ----------------------------------------------------------------


def test_terms_of_a_quadratic_function_are_all_products() -> None:
    hand = np.random.default_rng(4).normal(size=(5, 4))
    expected = [
        [1.0, *h, *(h[i] * h[j] for i in range(4) for j in range(i, 4))] for h in hand.tolist()
    ]
    np.testing.assert_allclose(quadratic(torch.from_numpy(hand)).numpy(), expected)


@settings(max_examples=20)
@given(
    seed=st.integers(0, 2**32 - 1),
    scale=st.floats(0.01, 100),
    moments=st.integers(12, 60),
    noise=st.sampled_from([0.0, 1e-3]),
)
def test_the_place_of_contact_is_the_quadratic_function_that_fits(
    seed: int, scale: float, moments: int, noise: float
) -> None:
    rng = np.random.default_rng(seed)
    constant, linear = rng.normal(0, scale, 2), rng.normal(0, scale, (3, 2))
    square = rng.normal(0, scale, (2, 3, 3))

    def true_place(hands: Floats) -> Floats:
        curved = np.einsum("ni,kij,nj->nk", hands, square, hands)
        place: Floats = constant + hands @ linear + curved
        return place

    hands, fresh = rng.uniform(-2, 2, (moments, 3)), rng.uniform(-2, 2, (5, 3))
    places = true_place(hands) + noise * scale * rng.normal(size=(moments, 2))
    # Best, in the sum of squares: no other function of the kind comes nearer.
    model = random_dynamics(0).fit_contact(
        torch.from_numpy(hands).float(), torch.from_numpy(places).float()
    )
    if noise:
        left = model.cell.place(torch.from_numpy(hands).float()).detach().double().numpy() - places
        terms = quadratic(torch.from_numpy(hands)).numpy()
        assert np.abs(terms.T @ left).max() < 2e-4 * scale * moments
    else:
        found = model.cell.place(torch.from_numpy(fresh).float()).detach().numpy()
        np.testing.assert_allclose(found, true_place(fresh), atol=2e-3 * scale, rtol=1e-3)


def test_too_few_moments_of_contact_are_an_error() -> None:
    with pytest.raises(ValueError, match="hands: 9 moments at which a part moved are too few"):
        random_dynamics(0).fit_contact(torch.rand(9, 3), torch.rand(9, 2))


# ---- the loss ----------------------------------------------------------------------------------


def random_batch(seed: int) -> dict[str, Tensor]:
    """Stretches of three steps of four episodes."""
    rng = np.random.default_rng(seed)
    return {
        "states": torch.from_numpy(random_states(16, seed).reshape(4, 4, -1)),
        "known": torch.from_numpy(rng.integers(0, 3, (4, 4, PARTS)).astype(np.float32)),
        "actions": random_actions(seed, 4, 3),
    }


def test_the_loss_is_the_mean_distance_of_what_is_known(dynamics: LayerDynamics) -> None:
    batch = random_batch(5)
    found, parts = dynamics.loss(batch, torch.Generator(), 0)
    states, known = batch["states"].double().numpy(), batch["known"].numpy()

    def length(x: Floats) -> float:
        return float(np.sqrt((x**2).sum() + 0.01) - 0.1)

    expected = dict.fromkeys(("hand", "sliders", "parts", "there"), 0.0)
    for n in range(4):
        path, closest = slow_rollout(dynamics, batch["states"][n, 0].numpy(), batch["actions"][n])
        assert closest > 1e-3
        for h in range(3):
            true = states[n, h + 1]
            expected["hand"] += 6 * length(path[h, :ACTION] - true[:ACTION]) / 12
            slid = np.abs(path[h, ACTION:FIXED] - true[ACTION:FIXED]).sum()
            expected["sliders"] += 20 * float(slid) / 12
            for i in range(PARTS):
                guess, truth = (x[FIXED + 3 * i : FIXED + 3 * i + 3] for x in (path[h], true))
                if known[n, 0, i] and known[n, h + 1, i] == 2:
                    expected["parts"] += length(guess[:2] - truth[:2]) / 12
                if known[n, 0, i] and known[n, h + 1, i]:
                    expected["there"] += 5 * abs(guess[2] - truth[2]) / 12
    for name, value in expected.items():
        assert float(parts[name]) == pytest.approx(value, rel=1e-3), name
    assert float(found) == pytest.approx(sum(expected.values()), rel=1e-3)


def test_what_is_not_known_of_parts_teaches_nothing(dynamics: LayerDynamics) -> None:
    batch = random_batch(6)
    states = batch["states"].clone()
    parts = states[..., FIXED:].reshape(4, 4, PARTS, 3)[:, 1:]
    known = batch["known"][:, 1:]
    parts[known == 0] += 5.0
    parts[..., :2][known == 1] -= 7.0
    losses = [
        dynamics.loss({**batch, "states": some}, torch.Generator(), 0)[0]
        for some in (batch["states"], states)
    ]
    assert not torch.equal(states, batch["states"])
    assert float(losses[0]) == float(losses[1])
    # What is known does.
    parts[known == 2] += 1.0
    third, _ = dynamics.loss({**batch, "states": states}, torch.Generator(), 0)
    assert float(third) != float(losses[0])


def test_a_true_path_costs_nothing(dynamics: LayerDynamics) -> None:
    batch = random_batch(7)
    path = dynamics.rollout(batch["states"][:, 0], batch["actions"])
    batch["states"] = torch.cat([batch["states"][:, :1], path], dim=1)
    loss, _ = dynamics.loss(batch, torch.Generator(), 0)
    assert float(loss) == pytest.approx(0, abs=1e-5)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"hand_hidden": 0}, "hand_hidden must be at least 1"),
        ({"part_hidden": 0}, "part_hidden must be at least 1"),
        ({"memory": -1}, "memory must not be negative"),
        ({"reach": 0.0}, "reach must be positive"),
        ({"reach": float("nan")}, "reach must be positive"),
    ],
)
def test_settings_out_of_range_are_named(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CellConfig(**settings)  # type: ignore[arg-type]
