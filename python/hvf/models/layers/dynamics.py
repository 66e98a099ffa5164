"""Compact dynamics of the desk: what is seen (`perception`), and how an action changes it (`cell`).

Letters in shapes: `N` frames, `A` action dimensions, `G` sliders, `R` parts that roam, `H` steps,
`X` = A + G + 3R length of a state (:mod:`hvf.models.layers.perception`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor, nn

from hvf.models.layers.cell import Cell, CellConfig, quadratic
from hvf.models.layers.perception import LayerPerception, LayerPerceptionConfig


@dataclass(frozen=True)
class LayerDynamicsConfig:
    """Sizes and loss weights.

    Attributes:
        perception: what is seen.
        cell: the networks of one step.
        slider_pixels: pixels that an error of a slider's whole way counts as.
        hand_pixels: pixels that an error of one full action of the hand counts as.
    """

    perception: LayerPerceptionConfig = field(default_factory=LayerPerceptionConfig)
    cell: CellConfig = field(default_factory=CellConfig)
    slider_pixels: float = 20.0
    hand_pixels: float = 6.0

    def __post_init__(self) -> None:
        for name in ("slider_pixels", "hand_pixels"):
            if not 0 < getattr(self, name) < float("inf"):
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")


class LayerDynamics(nn.Module):
    """Perception and cell; see the module's documentation."""

    config_type: ClassVar[type[LayerDynamicsConfig]] = LayerDynamicsConfig
    # Axes and grids that coordinates are read off by: half precision has 11 bits.
    keep_float32: ClassVar[tuple[str, ...]] = (
        "cell.contact",
        "perception.backdrop.axis",
        "perception.backdrop.offset",
        "perception.gallery.low",
        "perception.gallery.step",
    )

    def __init__(self, config: LayerDynamicsConfig) -> None:
        super().__init__()
        self.config = config
        self.perception = LayerPerception(config.perception)
        perception = config.perception
        self.cell = Cell(config.cell, perception.arm.action_dim, perception.sliders)

    def freeze_perception(self, perception: LayerPerception) -> LayerDynamics:
        """Take over a trained perception and keep it as it is."""
        self.perception.load_state_dict(perception.state_dict())
        self.perception.requires_grad_(False)
        return self

    def fit_contact(self, hands: Tensor, places: Tensor) -> LayerDynamics:
        """Note where the hand meets parts: at `places [N, 2]`, pixels, with codes `hands [N, A]`.

        Raises:
            ValueError: fewer moments than the fit has terms.
        """
        terms = quadratic(hands.double())
        if len(terms) < terms.shape[1]:
            raise ValueError(f"hands: {len(hands)} moments at which a part moved are too few")
        self.cell.contact.copy_(torch.linalg.lstsq(terms, places.double()).solution)
        return self

    def rollout(self, states: Tensor, actions: Tensor, last: bool = False) -> Tensor:
        """States after each of `actions [N, H, A]`, from `states [N, X]`: `[N, H, X]`.

        Args:
            states: where to start.
            actions: in [-1, 1].
            last: only the last state, `[N, 1, X]`.
        """
        now = self.cell.start(*self.perception.split(states))
        path = []
        for h in range(actions.shape[1]):
            now = self.cell(now, actions[:, h])
            if not last or h == actions.shape[1] - 1:
                path.append(torch.cat([now.hand, now.sliders, now.parts.flatten(1)], dim=1))
        return torch.stack(path, dim=1)

    def loss(
        self, batch: Mapping[str, Tensor], generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean distance of predicted states from observed ones, pixels.

        The batch holds `states [N, H+1, X]`, `actions [N, H, A]`, and `known [N, H+1, R]`: 1 where
        it is known where a part is, of 2 where it is known whether it is there.
        """
        states, known = batch["states"], batch["known"]
        path = self.rollout(states[:, 0], batch["actions"]).flatten(0, 1)
        hand, sliders, parts = self.perception.split(path)
        true_hand, true_sliders, true_parts = self.perception.split(states[:, 1:].flatten(0, 1))
        seen = known[:, 1:] * (known[:, :1] > 0.5)
        seen = seen.flatten(0, 1)
        place = _length(parts[..., :2] - true_parts[..., :2]) * (seen > 1.5)
        there = (parts[..., 2] - true_parts[..., 2]).abs() * (seen > 0.5)
        error = {
            "hand": self.config.hand_pixels * _length(hand - true_hand).mean(),
            "sliders": self.config.slider_pixels * (sliders - true_sliders).abs().sum(1).mean(),
            "parts": place.sum(dim=1).mean(),
            "there": 5.0 * there.sum(dim=1).mean(),
        }
        loss = torch.stack(list(error.values())).sum()
        return loss, {name: value.detach() for name, value in error.items()}


def _length(x: Tensor) -> Tensor:
    """Length of the last dimension, smooth at zero."""
    return (x.square().sum(dim=-1) + 1e-2).sqrt() - 0.1
