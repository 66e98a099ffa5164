"""The arm: what stands out before the backdrop, where its hand is, and what it looks like.

The code of a frame has as many numbers as an action, and is trained so that an action adds itself
to it: what an action moves is the hand, and the code becomes its position, in units of a full
action. A hand that is held back (at the border of its workspace, where most vertical moves end)
moves less than asked, never more and never back; so too little motion costs little, too much or
motion the other way costs in full.

From the code alone the arm is sketched, as colour and opacity before the backdrop, which keeps in
the code what actions hardly show: the height. Planning draws it sharper (:mod:`gallery`).

Letters in shapes: `N` frames, `S` image size, `A` action dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

# Largest difference of a colour to the backdrop (0 to 1) that is nothing, and that is all arm.
_NOTHING, _ALL = 0.06, 0.18
_COARSE = 0.3


@dataclass(frozen=True)
class ArmConfig:
    """Sizes and loss weights.

    Attributes:
        action_dim: action dimensions, `A`.
        channels: of the encoder's 3x3 convolutions of stride 2.
        hidden: width of fully connected layers.
        waves: each coordinate of the code is also seen as sines and cosines of as many wavelengths.
        features: numbers from which patches are sketched.
        patch: pixels on each side of the patches that the arm is sketched of.
        patch_rank: images of one patch; a sketch is a sum of these.
        shortfall: cost of too little motion, beside 1 for too much.
        sketch: weight of the squared error of sketched pixels.
        sketch_share: part of its gradient that reaches the encoder.
    """

    action_dim: int = 3
    channels: tuple[int, ...] = (16, 32, 32, 64)
    hidden: int = 128
    waves: int = 4
    features: int = 96
    patch: int = 8
    patch_rank: int = 24
    shortfall: float = 0.6
    sketch: float = 0.05
    sketch_share: float = 0.1

    def __post_init__(self) -> None:
        if not self.channels or min(self.channels) < 1:
            raise ValueError(f"channels must be positive, got {self.channels}")
        for name in ("action_dim", "hidden", "waves", "features", "patch", "patch_rank"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("shortfall", "sketch", "sketch_share"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")


class Arm(nn.Module):
    """Encoder and sketch of the arm; see the module's documentation."""

    def __init__(self, config: ArmConfig, image_size: int) -> None:
        super().__init__()
        if image_size % 2 ** len(config.channels) or image_size % config.patch:
            raise ValueError(
                f"image_size must be a multiple of {2 ** len(config.channels)} and of the patch "
                f"{config.patch}, got {image_size}"
            )
        self.config = config
        self.image_size = image_size
        layers: list[nn.Module] = []
        for before, after in pairwise((2, *config.channels)):
            layers += [nn.Conv2d(before, after, 3, 2, padding=1), nn.ReLU()]
        side = image_size // 2 ** len(config.channels)
        self.encoder = nn.Sequential(
            *layers,
            nn.Flatten(),
            nn.Linear(config.channels[-1] * side**2, config.hidden),
            nn.ReLU(),
            nn.Linear(config.hidden, config.action_dim),
        )
        inputs = config.action_dim * (1 + 2 * config.waves)
        self.features = nn.Sequential(
            nn.Linear(inputs, config.hidden),
            nn.ReLU(),
            nn.Linear(config.hidden, config.features),
            nn.ReLU(),
        )
        cells = (image_size // config.patch) ** 2
        self.patches = nn.Linear(config.features, cells * config.patch_rank)
        self.patch = nn.Parameter(torch.randn(config.patch_rank, 4 * config.patch**2) * 0.05)

    def opacity(self, images: Tensor, backdrop: Tensor, hidden: Tensor) -> Tensor:
        """How surely each pixel is the arm's, 0 to 1: `[N, S, S]`.

        Args:
            images: `[N, 3, S, S]` in [0, 1].
            backdrop: what is behind, `[N, 3, S, S]`.
            hidden: where something else than the backdrop is, bool `[N, S, S]`.
        """
        apart = (images - backdrop).abs().amax(dim=1)
        return ((apart - _NOTHING) / (_ALL - _NOTHING)).clamp(0, 1) * ~hidden

    def forward(self, images: Tensor, opacity: Tensor) -> Tensor:
        """Codes `[N, A]`, in units of a full action."""
        seen = torch.stack([opacity, 2.0 * opacity * (images.mean(dim=1) - 0.5)], dim=1)
        code: Tensor = self.encoder(2.0 * seen)
        return code

    def sketch(self, code: Tensor) -> tuple[Tensor, Tensor]:
        """Opacity `[N, 1, S, S]` and colour times opacity `[N, 3, S, S]` of a hand at `code`."""
        config = self.config
        scales = 0.5 * torch.pi * 2.0 ** torch.arange(config.waves, device=code.device)
        phases = (_COARSE * code[..., None] * scales).flatten(-2)
        seen = torch.cat([_COARSE * code, phases.sin(), phases.cos()], dim=1)
        side, patch = self.image_size // config.patch, config.patch
        weights = self.patches(self.features(seen)).reshape(len(code), side * side, -1)
        cells = (weights @ self.patch).reshape(-1, side, side, 4, patch, patch)
        drawn = cells.permute(0, 3, 1, 4, 2, 5).reshape(-1, 4, self.image_size, self.image_size)
        return drawn[:, :1], drawn[:, 1:]

    def loss(
        self, images: Tensor, backdrop: Tensor, hidden: Tensor, actions: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """How far codes are from moving with the action, and sketched arms from seen ones.

        Args:
            images: pairs of frames a step apart, one after the other: `[2N, 3, S, S]` in [0, 1].
            backdrop: what is behind them, the same shape.
            hidden: where something else than the backdrop is, bool `[2N, S, S]`.
            actions: between the frames of a pair, `[N, A]`.
        """
        opacity = self.opacity(images, backdrop, hidden)
        code = self(images, opacity)
        pair = code.reshape(len(actions), 2, -1)
        along = (pair[:, 1] - pair[:, 0]) * actions.sign()
        short = actions.abs() - along
        held_back = (self.config.shortfall * F.relu(short)).sum(dim=1).mean()
        wrong = (F.relu(-short) + F.relu(-along)).sum(dim=1).mean()
        # Mostly actions shape the code; in full, the sketch's gradient would keep it from growing.
        share = self.config.sketch_share
        drawn, colour = self.sketch(share * code + (1 - share) * code.detach())
        free = ~hidden[:, None]
        missed = (backdrop * (1 - drawn.clamp(0, 1)) + colour - images) * free
        shape = (drawn[:, 0] - opacity) * free[:, 0]
        # The shape too: an arm of the colour of what is behind it still hides what is in between.
        error = missed.square().sum(dim=(1, 2, 3)) + 0.3 * shape.square().sum(dim=(1, 2))
        loss = held_back + wrong + self.config.sketch * error.mean()
        parts = {"held_back": held_back, "wrong": wrong, "missed": missed.square().mean()}
        return loss, {name: value.detach() for name, value in parts.items()}
