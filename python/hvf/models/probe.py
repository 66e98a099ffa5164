"""Where things are in an image of any domain whose data has states; no model learns from it.

A small convolutional network, trained on true frames and the recorded state. What it reads in a
predicted frame says whether the frame shows things where they will be.

Letters in shapes: `N` frames, `S` image size, `O` observables.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import torch
from torch import Tensor, nn

from hvf.models.frames import to_unit


@dataclass(frozen=True)
class PositionProbeConfig:
    """Sizes of the probe.

    Attributes:
        image_size: height and width of the images, `S`, in pixels.
        observables: numbers to read, `O`.
        channels: of the 3x3 convolutions of stride 2.
        hidden: width of the fully connected layer.
    """

    image_size: int = 64
    observables: int = 17
    channels: tuple[int, ...] = (16, 32, 48, 64)
    hidden: int = 256

    def __post_init__(self) -> None:
        if not self.channels or min(self.channels) < 1:
            raise ValueError(f"channels must be positive, got {self.channels}")
        if self.image_size < 16 or self.image_size % 2 ** len(self.channels):
            raise ValueError(
                f"image_size must be a multiple of {2 ** len(self.channels)}, got {self.image_size}"
            )
        for name in ("observables", "hidden"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")


class PositionProbe(nn.Module):
    """The network; see the module's documentation."""

    config_type: ClassVar[type[PositionProbeConfig]] = PositionProbeConfig
    mean: Tensor
    scale: Tensor

    def __init__(self, config: PositionProbeConfig) -> None:
        super().__init__()
        self.config = config
        layers: list[nn.Module] = []
        for before, after in pairwise((3, *config.channels)):
            layers += [nn.Conv2d(before, after, 3, 2, padding=1), nn.ReLU()]
        side = config.image_size // 2 ** len(config.channels)
        self.network = nn.Sequential(
            *layers,
            nn.Flatten(),
            nn.Linear(config.channels[-1] * side**2, config.hidden),
            nn.ReLU(),
            nn.Linear(config.hidden, config.observables),
        )
        self.register_buffer("mean", torch.zeros(config.observables))
        self.register_buffer("scale", torch.ones(config.observables))

    def fit_scale(self, states: Tensor) -> PositionProbe:
        """Note mean and spread of the observables in `states [N, O]`."""
        self.mean.copy_(states.double().mean(dim=0))
        # What hardly varies, as the depth of a button, must not be blown up.
        self.scale.copy_(states.double().std(dim=0).clamp_min(2e-3))
        return self

    def forward(self, frames: Tensor) -> Tensor:
        """Observables `[N, O]`, m, in uint8 `frames [N, S, S, 3]`."""
        read: Tensor = self.network(4.0 * (to_unit(frames) - 0.5)) * self.scale + self.mean
        return read

    def loss(
        self, batch: Mapping[str, Tensor], generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Absolute error in `frames` uint8 `[N, S, S, 3]` of `states [N, O]`, in spreads."""
        error = ((self(batch["frames"]) - batch["states"]) / self.scale).abs().mean()
        return error, {}
