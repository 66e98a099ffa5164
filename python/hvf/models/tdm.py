"""The temporal distance of Nair & Finn (2020): images a few steps apart, or many.

A classifier of pairs of images, whose probability of "far" is a planning cost. Network and loss are
those of the authors' released code (google-research, ``hierarchical_foresight/models/tdm.py``,
``train_tdm.py``).

Letters in shapes: ``B`` pairs of images, ``H x W`` pixels.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from hvf.models.convolutions import (
    StackConfig,
    encoder_of,
    fully_connected,
    initialise_as_sonnet,
)
from hvf.models.frames import to_unit


@dataclasses.dataclass(frozen=True)
class TDMConfig(StackConfig):
    """Sizes of the network and its loss; the defaults are the released code's.

    That network has 1,115,346 parameters.

    Attributes:
        image_size: height and width in pixels, at least 31 for four convolutions.
        channels: of the 3x3 convolutions of stride 2, without padding, over both images at once.
        layers: widths of the rectified layers after them.
        near: images fewer steps apart than this are near.
        noise: inputs are changed by up to this much, uniformly, while learning.
        mixup: weight of the mixup term.

    Raises:
        ValueError: a number out of range, or images that are too small.
    """

    layers: tuple[int, ...] = (512, 512, 256, 128)
    near: int = 3
    noise: float = 0.05
    mixup: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.layers or min(self.layers) < 1:
            raise ValueError(f"layers must be positive, got {self.layers}")
        if self.near < 1:
            raise ValueError(f"near must be at least 1, got {self.near}")
        for name in ("noise", "mixup"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")


class TDM(nn.Module):
    """Tells near pairs of images from far ones."""

    config_type: ClassVar[type[TDMConfig]] = TDMConfig

    def __init__(self, config: TDMConfig) -> None:
        super().__init__()
        self.config = config
        features = config.channels[-1] * math.prod(config.sizes[-1])
        self.encoder = encoder_of(config.channels, config.strides, "valid", inputs=6)
        self.layers = fully_connected(features, *config.layers, 2)
        initialise_as_sonnet(self)

    def logits(self, first: Tensor, second: Tensor) -> Tensor:
        """Of "far" and "near", ``[B, 2]``, for images float ``[B, 3, H, W]`` in [0, 1]."""
        found: Tensor = self.layers(self.encoder(torch.cat([first, second], 1)).flatten(1)).float()
        return found

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        """How likely ``first`` and ``second`` are far apart: ``[B]``, from 0 to 1.

        Args:
            first: float ``[B, 3, H, W]`` in [0, 1]; when planning, what is predicted.
            second: the same; when planning, the goal.

        Raises:
            ValueError: images of other shapes.
        """
        self.config.check_pair(first=first, second=second)
        return self.logits(first, second).softmax(1)[:, 0]

    def loss(
        self, batch: Mapping[str, Tensor], generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Cross entropy of both pairs, and how far the network is from linear between them.

        With an anchor ``s1`` and its partners ``s2`` and ``s3``, logits ``f``, and ``l`` from
        U(0, 1): ``CE(f(s1, s2)) + CE(f(s1, s3)) + |f(s1, l s2 + (1 - l) s3) - l f(s1, s2) -
        (1 - l) f(s1, s3)|^2``, means over the batch.

        Args:
            batch: ``anchor``, ``first`` and ``second``, uint8 ``[B, H, W, 3]``, and ``steps``,
                int64 ``[B, 2]``, from the anchor to the two.
            generator: of the noise on the inputs and of ``l``.
            step: not used.
        """
        anchor, first, second = (
            self._noisy(to_unit(batch[name]), generator) for name in ("anchor", "first", "second")
        )
        near = (batch["steps"].abs() < self.config.near).long()
        share = torch.rand(len(near), 1, generator=generator, device=anchor.device)
        spread = share[:, :, None, None]
        mixed = spread * first + (1 - spread) * second
        each = self.logits(anchor.repeat(3, 1, 1, 1), torch.cat([first, second, mixed]))
        one, other, between = each.chunk(3)
        entropy = F.cross_entropy(one, near[:, 0]) + F.cross_entropy(other, near[:, 1])
        bent = (between - share * one - (1 - share) * other).square().sum(1).mean()
        right = (one.argmax(1) == near[:, 0]).float().mean()
        return entropy + self.config.mixup * bent, {
            "entropy": entropy.detach() / 2,
            "mixup": bent.detach(),
            "right": right,
        }

    def _noisy(self, images: Tensor, generator: torch.Generator) -> Tensor:
        draw = torch.rand(images.shape, generator=generator, device=images.device)
        return images + self.config.noise * (2 * draw - 1)
