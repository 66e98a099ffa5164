"""How many steps of random play lie between two states of the desk: a temporal distance.

Pixels say how much looks different, the generator's likelihood how rarely play leads from one
state to another; this says how long it takes. A classifier is shown two states and says how many
steps were between them, in classes that double in width, or that they are not of one episode. The
latter is what a search needs to know: trained on pairs of one episode alone, the classifier has
never seen what cannot be reached, and a search on it finds subgoals that it has no idea of. So half
of what it is shown has one or two things where they were in another episode
(:mod:`hvf.training.tracks.transplants`).

Letters in shapes: `N` pairs, `A` action dimensions, `G` sliders, `R` parts that roam, `X` length of
a state (:mod:`hvf.models.layers.perception`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from hvf.models.doublings import class_of, expected_class
from hvf.models.layers.states import StateNetwork, StateSizes

# Changes of scaled states are shown times so much, too, up to 1: a pixel of a part's way counts.
_CLOSE_UP = 8.0


@dataclass(frozen=True)
class LayerDistanceConfig(StateSizes):
    """Sizes.

    Attributes:
        part_hidden: width of the network that all parts share.
        hidden: width of the two hidden layers after it.
        classes: of numbers of steps (:mod:`hvf.models.doublings`).
    """

    part_hidden: int = 64
    hidden: int = 128
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
        fixed = config.action_dim + config.sliders
        self.part = nn.Sequential(
            nn.Linear(2 * config.action_dim + 8, config.part_hidden),
            nn.SiLU(),
            nn.Linear(config.part_hidden, config.part_hidden),
            nn.SiLU(),
        )
        self.layers = nn.Sequential(
            nn.Linear(config.part_hidden + 3 * fixed, config.hidden),
            nn.SiLU(),
            nn.Linear(config.hidden, config.hidden),
            nn.SiLU(),
            nn.Linear(config.hidden, config.classes + 1),
        )

    def logits(self, before: Tensor, after: Tensor) -> Tensor:
        """Logits `[N, classes + 1]` of `before` and `after [N, X]`; the last: of two episodes."""
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
        seen = [self.part(parts).sum(dim=1), was[:, :fixed], will[:, :fixed], change[:, :fixed]]
        scores: Tensor = self.layers(torch.cat(seen, dim=1))
        return scores

    def forward(self, before: Tensor, after: Tensor) -> Tensor:
        """Distance from `before` to `after [N, X]`: about the binary logarithm of twice the steps.

        The expected class of pairs of one episode, and the binary logarithm of how seldom such a
        pair is one: play that gets there in one of `q` tries takes `q` times as long. Not bounded,
        so that a search knows which of two ways that are both unheard of is the better one.
        """
        logits = self.logits(before, after)
        steps = logits[:, :-1]
        seldom = torch.logsumexp(logits, dim=1) - torch.logsumexp(steps, dim=1)
        return expected_class(steps) + seldom / math.log(2.0)

    def loss(
        self, batch: Mapping[str, Tensor], generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Cross entropy, in nats.

        The batch holds `scenes` and `states` `[N, X]`, `steps [N]` from one to the other, and bool
        `apart [N]`: whether they are of two episodes.
        """
        logits = self.logits(batch["scenes"], batch["states"])
        labels = self.labels(batch)
        right = (logits.argmax(dim=1) == labels).float().mean()
        return F.cross_entropy(logits, labels), {"right": right.detach()}

    def labels(self, batch: Mapping[str, Tensor]) -> Tensor:
        """Classes int64 `[N]` of a batch of :meth:`loss`."""
        classes = self.config.classes
        return torch.where(batch["apart"], classes, class_of(batch["steps"], classes))
