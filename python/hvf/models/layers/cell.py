"""One step of the desk's dynamics: the hand, then what slides, then what is pushed.

All of it is local. The hand depends on itself, on the action and on the sliders (which hold it
back); a slider on itself and the hand; a part that roams on where the hand is beside it. What the
hand does not come near does not move: that is exact, and such a part costs nothing to predict.

The hand's code is in units of actions and parts are in pixels. Where the hand meets parts, in
pixels, is a quadratic function of its code (`contact`), fitted to moments at which a part moved.

Letters in shapes: `N` frames, `A` action dimensions, `G` sliders, `R` parts that roam, `C` length
of a part's memory.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

# Pixels and full actions that count as one in the inputs.
_PIXELS, _HALF_IMAGE = 8.0, 32.0


@dataclass(frozen=True)
class CellConfig:
    """Sizes of the networks.

    Attributes:
        hand_hidden: width of the two hidden layers of the hand's network, and of each slider's.
        part_hidden: width of the two hidden layers of the network of parts.
        memory: numbers carried along for each part, `C`: how it is turned, for example.
        reach: pixels from the hand's way beyond which a part does not move.
    """

    hand_hidden: int = 64
    part_hidden: int = 128
    memory: int = 4
    reach: float = 9.0

    def __post_init__(self) -> None:
        for name in ("hand_hidden", "part_hidden"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.memory < 0:
            raise ValueError(f"memory must not be negative, got {self.memory}")
        if not 0 < self.reach < float("inf"):
            raise ValueError(f"reach must be positive, got {self.reach}")


@dataclass(frozen=True)
class Moving:
    """What moves.

    Attributes:
        hand: codes, in full actions, `[N, A]`.
        sliders: coordinates, 0 to 1, `[N, G]`.
        parts: row and column in pixels and presence, 0 to 1: `[N, R, 3]`.
        memory: `[N, R, C]`.
    """

    hand: Tensor
    sliders: Tensor
    parts: Tensor
    memory: Tensor


class Cell(nn.Module):
    """The networks; see the module's documentation."""

    contact: Tensor

    def __init__(self, config: CellConfig, action_dim: int, sliders: int) -> None:
        super().__init__()
        self.config = config
        self.hand = _network(2 * action_dim + sliders, config.hand_hidden, action_dim)
        self.sliders = nn.ModuleList(
            _network(sliders + 3 * action_dim, config.hand_hidden, 1) for _ in range(sliders)
        )
        # Where the hand is beside the part, how it moves; hand, motion, action; the part itself.
        inputs = 2 + 2 + 3 * action_dim + 3 + config.memory
        self.parts = _network(inputs, config.part_hidden, 3 + config.memory)
        terms = 1 + action_dim + action_dim * (action_dim + 1) // 2
        self.register_buffer("contact", torch.zeros(terms, 2))

    def place(self, hand: Tensor) -> Tensor:
        """Row and column `[N, 2]`, pixels, at which a hand at `hand [N, A]` meets parts."""
        place: Tensor = quadratic(hand) @ self.contact
        return place

    def start(self, hand: Tensor, sliders: Tensor, parts: Tensor) -> Moving:
        """The beginning of a rollout: memories are empty."""
        return Moving(hand, sliders, parts, parts.new_zeros(*parts.shape[:2], self.config.memory))

    def forward(self, now: Moving, actions: Tensor) -> Moving:
        """What `now` is after `actions [N, A]`."""
        seen = torch.cat([now.hand, actions, now.sliders], dim=1)
        hand = now.hand + self.hand(seen)
        way = torch.cat([now.sliders, now.hand, hand - now.hand, actions], dim=1)
        change = torch.cat([network(way) for network in self.sliders], dim=1)
        sliders = (now.sliders + 0.1 * change).clamp(0, 1)
        before, after = self.place(now.hand), self.place(hand)
        beside = before[:, None] - now.parts[..., :2]
        shared = torch.cat([(after - before) / _PIXELS, now.hand, hand - now.hand, actions], dim=1)
        inputs = torch.cat(
            [
                beside / _PIXELS,
                shared[:, None].expand(-1, beside.shape[1], -1),
                now.parts[..., :2] / _HALF_IMAGE - 1,
                now.parts[..., 2:],
                now.memory,
            ],
            dim=2,
        )
        near = _distance(beside, (after - before)[:, None]) < self.config.reach
        pushed = self.parts(inputs) * near[..., None]
        parts = torch.cat(
            [
                now.parts[..., :2] + _PIXELS * pushed[..., :2],
                (now.parts[..., 2:] + pushed[..., 2:3]).clamp(0, 1),
            ],
            dim=2,
        )
        return Moving(hand, sliders, parts, now.memory + pushed[..., 3:])


def quadratic(hand: Tensor) -> Tensor:
    """Terms of a quadratic function of `hand [N, A]`: `[N, 1 + A + A (A + 1) / 2]`."""
    size = hand.shape[1]
    rows, columns = torch.triu_indices(size, size, device=hand.device)
    return torch.cat([torch.ones_like(hand[:, :1]), hand, hand[:, rows] * hand[:, columns]], dim=1)


def _distance(beside: Tensor, way: Tensor) -> Tensor:
    """Distance of a part from the segment that begins `beside` it and goes along `way`."""
    share = -(beside * way).sum(dim=-1) / way.square().sum(dim=-1).clamp_min(1e-6)
    distance: Tensor = (beside + share.clamp(0, 1)[..., None] * way).norm(dim=-1)
    return distance


def _network(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    last = nn.Linear(hidden, outputs)
    nn.init.normal_(last.weight, std=0.1 / hidden**0.5)
    nn.init.zeros_(last.bias)
    return nn.Sequential(
        nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), last
    )
