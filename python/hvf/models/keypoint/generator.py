"""Where the moving part may be in a scene: a small CVAE on keypoints.

The second generator of subgoals, beside the paper's CVAE on images: it draws a keypoint given a
code of the scene map of the compact dynamics model, and that model's sprite draws the image. Images
are sharp, and planning starts from the keypoint without encoding the image again.

Letters in shapes: `N` samples, `S` image size, `E` scene code, `L` latent dimensions. Keypoints are
(row, column) in pixels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from hvf.models.keypoint.scene_code import SceneCode
from hvf.models.vae import gaussian_kl


@dataclass(frozen=True)
class GeneratorConfig:
    """Sizes of the keypoint generator.

    Attributes:
        image_size: height and width of the images, `S`, in pixels (even).
        scene_dim: length of the scene code, `E`.
        latent_dim: latent dimensions, `L`.
        hidden: width of the hidden layers.
        precision: standard deviation to which a keypoint should be rebuilt, in pixels.
    """

    image_size: int = 64
    scene_dim: int = 16
    latent_dim: int = 8
    hidden: int = 128
    precision: float = 0.6

    def __post_init__(self) -> None:
        for name in ("scene_dim", "latent_dim", "hidden"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.image_size < 2 or self.image_size % 2:
            raise ValueError(f"image_size must be even, at least 2; got {self.image_size}")
        if not 0 < self.precision < float("inf"):
            raise ValueError(f"precision must be positive, got {self.precision}")


class KeypointGenerator(nn.Module):
    """CVAE of keypoints; see the module's documentation."""

    config_type: ClassVar[type[GeneratorConfig]] = GeneratorConfig

    def __init__(self, config: GeneratorConfig) -> None:
        super().__init__()
        self.config = config
        hidden = config.hidden
        self.code = SceneCode(config.image_size, config.scene_dim)
        self.posterior = nn.Sequential(
            nn.Linear(2 + config.scene_dim, hidden),
            nn.ReLU(),
            nn.Linear(hidden, hidden),
            nn.ReLU(),
            nn.Linear(hidden, 2 * config.latent_dim),
        )
        self.decoder = nn.Sequential(
            nn.Linear(config.latent_dim + config.scene_dim, hidden),
            nn.ReLU(),
            nn.Linear(hidden, hidden),
            nn.ReLU(),
            nn.Linear(hidden, 2),
        )

    def decode(self, latents: Tensor, codes: Tensor) -> Tensor:
        """Keypoints `[N, 2]` for `latents [N, L]` in scenes of `codes [N, E]`."""
        half = 0.5 * (self.config.image_size - 1)
        keypoints: Tensor = half * (1.0 + self.decoder(torch.cat([latents, codes], dim=1)))
        return keypoints

    def encode(self, keypoints: Tensor, codes: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log variance `[N, L]` of the latents of `keypoints [N, 2]`."""
        half = 0.5 * (self.config.image_size - 1)
        inputs = torch.cat([keypoints / half - 1.0, codes], dim=1)
        mean, log_variance = self.posterior(inputs).chunk(2, dim=1)
        return mean, log_variance.clamp(-12.0, 4.0)

    def loss(
        self, batch: Mapping[str, Tensor], generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Negative evidence lower bound, in nats, of `keypoints [N, 2]` given `codes [N, E]`."""
        keypoints, codes = batch["keypoints"], batch["codes"]
        mean, log_variance = self.encode(keypoints, codes)
        noise = torch.randn(mean.shape, generator=generator, device=mean.device)
        rebuilt = self.decode(mean + noise * (0.5 * log_variance).exp(), codes)
        missed = (rebuilt - keypoints).square().sum(dim=1)
        distortion = (0.5 * missed / self.config.precision**2).mean()
        kl = gaussian_kl(mean, log_variance).mean()
        parts = {"kl": kl, "missed": missed.mean().sqrt()}
        return distortion + kl, {name: value.detach() for name, value in parts.items()}
