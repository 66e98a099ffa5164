"""Where the hand is, learned from actions alone.

The code of a frame has as many numbers as an action, and is trained so that an action adds itself
to it: what an action moves is the hand, and the code becomes its position, in units of a full
action. A hand that is held back (at the border of its workspace, where most vertical moves end)
moves less than asked, never more and never back; so too little motion costs little, too much or
motion the other way costs in full.

Hands that look different must differ in code, or height would be lost, which shows in few pixels
and is mostly held back: from the codes of two frames a small network has to draw their difference
at a quarter of the resolution.

Letters in shapes: `N` frames, `S` image size, `A` action dimensions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from hvf.models.frames import to_unit

# Differences to the mean image are about a quarter where there is something.
_INPUT_SCALE = 4.0
_COARSE = 4


@dataclass(frozen=True)
class HandConfig:
    """Sizes and loss weights of the hand's perception.

    Attributes:
        image_size: height and width of the images, `S`, in pixels.
        action_dim: action dimensions, `A`.
        channels: of the 3x3 convolutions of stride 2.
        hidden: width of the fully connected layer, and of the drawing's.
        shortfall: cost of too little motion, beside 1 for too much.
        drawing: weight of the drawn difference.
    """

    image_size: int = 64
    action_dim: int = 3
    channels: tuple[int, ...] = (16, 32, 32, 64)
    hidden: int = 128
    shortfall: float = 0.6
    drawing: float = 0.05

    def __post_init__(self) -> None:
        if not self.channels or min(self.channels) < 1:
            raise ValueError(f"channels must be positive, got {self.channels}")
        if self.image_size < 16 or self.image_size % 2 ** len(self.channels):
            raise ValueError(
                f"image_size must be a multiple of {2 ** len(self.channels)}, got {self.image_size}"
            )
        for name in ("action_dim", "hidden"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("shortfall", "drawing"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")


class Hand(nn.Module):
    """The network; see the module's documentation."""

    config_type: ClassVar[type[HandConfig]] = HandConfig
    mean_image: Tensor

    def __init__(self, config: HandConfig) -> None:
        super().__init__()
        self.config = config
        layers: list[nn.Module] = []
        for before, after in pairwise((3, *config.channels)):
            layers += [nn.Conv2d(before, after, 3, 2, padding=1), nn.ReLU()]
        side = config.image_size // 2 ** len(config.channels)
        self.encoder = nn.Sequential(
            *layers,
            nn.Flatten(),
            nn.Linear(config.channels[-1] * side**2, config.hidden),
            nn.ReLU(),
            nn.Linear(config.hidden, config.action_dim),
        )
        pixels = 3 * (config.image_size // _COARSE) ** 2
        self.drawing = nn.Sequential(
            nn.Linear(config.action_dim, config.hidden),
            nn.ReLU(),
            nn.Linear(config.hidden, config.hidden),
            nn.ReLU(),
            nn.Linear(config.hidden, pixels),
        )
        shape = (3, config.image_size, config.image_size)
        self.register_buffer("mean_image", torch.full(shape, 0.5))

    def centre(self, frames: Tensor) -> Hand:
        """Take the mean of `frames`, uint8 `[N, S, S, 3]`; the network sees differences to it."""
        self.mean_image.copy_(
            (frames.sum(0, dtype=torch.float64) / len(frames) / 255).permute(2, 0, 1)
        )
        return self

    def forward(self, frames: Tensor) -> Tensor:
        """Codes `[N, A]`, in units of a full action, of uint8 `frames [N, S, S, 3]`."""
        code: Tensor = self.encoder((to_unit(frames) - self.mean_image) * _INPUT_SCALE)
        return code

    def loss(
        self, batch: Mapping[str, Tensor], generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """How far codes are from moving with the action.

        The batch holds `frames` uint8 `[N, 2, S, S, 3]`, one step apart, and `actions [N, 1, A]`.
        """
        frames, actions = batch["frames"], batch["actions"][:, 0]
        code = self(frames.flatten(0, 1)).reshape(len(frames), 2, -1)
        along = (code[:, 1] - code[:, 0]) * actions.sign()
        short = actions.abs() - along
        held_back = (self.config.shortfall * F.relu(short)).sum(dim=1).mean()
        wrong = (F.relu(-short) + F.relu(-along)).sum(dim=1).mean()
        drawn = self.drawing(code[:, 1]) - self.drawing(code[:, 0])
        coarse = F.avg_pool2d(to_unit(frames.flatten(0, 1)), _COARSE).reshape(len(frames), 2, -1)
        missed = (drawn - (coarse[:, 1] - coarse[:, 0])).square().sum(dim=1).mean()
        loss = held_back + wrong + self.config.drawing * missed
        parts = {"held_back": held_back, "wrong": wrong, "drawing": missed}
        return loss, {name: value.detach() for name, value in parts.items()}
