"""How many steps of random play lie between two states of the desk: a temporal distance.

Pixels say how much looks different, the generator's likelihood how rarely play leads from one
state to another; this says how long it takes. A classifier is shown two states and says how many
steps were between them, in classes that double in width. Trained on pairs of one episode alone it
has never seen what cannot be reached, and a search on it finds subgoals that it has no idea of. So
it also says of each slider and part whether it is where its own episode had it, or another one did:
half of what it is shown has things transplanted (:mod:`hvf.training.tracks.transplants`). Things
are judged one by one, so that two that do not fit are worse than one, which few pairs could teach.

Letters in shapes: `N` pairs, `A` action dimensions, `G` sliders, `R` parts that roam, `X` length of
a state (:mod:`hvf.models.layers.perception`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn import functional as F

from hvf.models.doublings import class_of, expected_class
from hvf.models.layers.states import StateNetwork, StateSizes, perceptron

# Changes of scaled states are shown times so much, too, up to 1: a pixel of a part's way counts.
_CLOSE_UP = 8.0


@dataclass(frozen=True)
class LayerDistanceConfig(StateSizes):
    """Sizes.

    Attributes:
        part_hidden: width of the network that all parts share.
        hidden: width of the two hidden layers of the other networks.
        classes: of numbers of steps (:mod:`hvf.models.doublings`).
    """

    part_hidden: int = 64
    hidden: int = 80
    classes: int = 8

    def __post_init__(self) -> None:
        super().__post_init__()
        self.at_least_one("part_hidden", "hidden")
        if self.classes < 2:
            raise ValueError(f"classes must be at least 2, got {self.classes}")


class LayerDistance(StateNetwork):
    """The classifier; see the module's documentation."""

    config_type: ClassVar[type[LayerDistanceConfig]] = LayerDistanceConfig

    def __init__(self, config: LayerDistanceConfig) -> None:
        super().__init__(config)
        self.config = config
        fixed = 3 * (config.action_dim + config.sliders)
        part, hidden = config.part_hidden, config.hidden
        self.part = perceptron(2 * config.action_dim + 8, part, part + 1, 2)
        self.fixed = perceptron(fixed, hidden, config.sliders, 2)
        self.steps = perceptron(part + fixed, hidden, config.classes, 2)

    def logits(self, before: Tensor, after: Tensor) -> tuple[Tensor, Tensor]:
        """What is said of `before` and `after [N, X]`.

        Returns:
            Logits of the classes of steps, `[N, classes]`, if nothing is transplanted; and of each
            slider and part being so, `[N, G + R]`.
        """
        config = self.config
        fixed = config.action_dim + config.sliders
        was, will = self.normal(before), self.normal(self.seen_from(before, after))
        change = torch.tanh(_CLOSE_UP * (will - was))
        hands = torch.cat([was[:, : config.action_dim], will[:, : config.action_dim]], dim=1)
        parts = torch.cat(
            [
                self.parts(was),
                self.parts(will),
                self.parts(change)[..., :2],
                hands[:, None].expand(-1, config.roaming, -1),
            ],
            dim=2,
        )
        rest = torch.cat([each[:, :fixed] for each in (was, will, change)], dim=1)
        seen = self.part(parts)
        steps = self.steps(torch.cat([seen[..., 1:].sum(dim=1), rest], dim=1))
        return steps, torch.cat([self.fixed(rest), seen[..., 0]], dim=1)

    def forward(self, before: Tensor, after: Tensor) -> Tensor:
        """Distance from `before` to `after [N, X]`: about the binary logarithm of twice the steps.

        The expected class of pairs of one episode, and the binary logarithm of how seldom such a
        pair is one: play that gets there in one of `q` tries takes `q` times as long. Not bounded,
        so that a search knows which of two ways that are both unheard of is the better one.
        """
        steps, transplanted = self.logits(before, after)
        return expected_class(steps) + F.softplus(transplanted).sum(dim=1) / math.log(2.0)

    def loss(
        self, batch: Mapping[str, Tensor], generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Cross entropies, in nats: of what is transplanted, and of the steps where nothing is.

        The batch holds `scenes` and `states` `[N, X]`, `steps [N]` from one to the other, and bool
        `transplanted [N, G + R]`.
        """
        steps, apart = self.logits(batch["scenes"], batch["states"])
        labels = batch["transplanted"]
        whole = ~labels.any(dim=1)
        entropies = F.binary_cross_entropy_with_logits(apart, labels.float(), reduction="none")
        classes = class_of(batch["steps"], self.config.classes)
        each = F.cross_entropy(steps, classes, reduction="none")
        pieces = {
            "transplants": entropies.sum(dim=1).mean(),
            "steps": (each * whole).sum() / whole.sum().clamp_min(1),
        }
        loss = pieces["transplants"] + pieces["steps"]
        return loss, {name: value.detach() for name, value in pieces.items()}
