"""Generative model of the images that are possible in a scene (paper, section 4.1 and appendix).

A variational autoencoder, conditional on an image of the scene: the latent says what may change
(the agent), the scene says what may not (the gaps). The same class without the scene is the VAE of
the desk; other channels and strides make the CVAE of the BAIR robot.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from itertools import pairwise
from typing import ClassVar, cast

import torch
import torch.nn.functional as F
from torch import nn

from hvf.models.frames import to_unit


@dataclasses.dataclass(frozen=True)
class CVAEConfig:
    """Sizes of the networks and weights of the loss. The defaults are the paper's maze CVAE.

    Attributes:
        image_size: height and width in pixels.
        conditional: decode with the image of the scene; False is a plain VAE.
        channels: of the 3x3 convolutions of the encoder; the decoder mirrors them.
        strides: of the same convolutions.
        latent_dim: dimensions of the latent, ``L``.
        posterior_layers: fully connected layers between the encoder and the posterior.
        scene_layers: fully connected layers on the scene's features; empty without a scene.
        image_layers: fully connected layers between latent (and scene) and decoder.
        pyramid_levels: the reconstruction is also compared after 1, 2, ... average poolings by 2:
            without them the decoder learns the background and nothing else for a long time.
        pyramid_weight: weight of each of these levels.
        kl_weight: weight of the KL divergence to N(0, I), in nats, beside the reconstruction's
            cross-entropy, summed over pixels and channels.
        kl_start: its weight at step 0.
        kl_steps: steps over which it grows, geometrically, to ``kl_weight``.
    """

    image_size: tuple[int, int] = (64, 64)
    conditional: bool = True
    channels: tuple[int, ...] = (16, 32, 64, 128)
    strides: tuple[int, ...] = (2, 2, 2, 2)
    latent_dim: int = 8
    posterior_layers: tuple[int, ...] = (512,)
    scene_layers: tuple[int, ...] = (512, 512, 256)
    image_layers: tuple[int, ...] = (256, 256, 256)
    pyramid_levels: int = 4
    pyramid_weight: float = 1.0
    kl_weight: float = 5.0
    kl_start: float = 0.05
    kl_steps: int = 2_000

    def __post_init__(self) -> None:
        if len(self.image_size) != 2 or min(self.image_size) < 8:
            raise ValueError(f"image_size must be (height, width) >= 8, got {self.image_size}")
        if not self.channels or min(self.channels) < 1:
            raise ValueError(f"channels must be positive, got {self.channels}")
        if len(self.strides) != len(self.channels) or not set(self.strides) <= {1, 2}:
            raise ValueError(
                f"strides must be 1 or 2 for each of {len(self.channels)} channels, "
                f"got {self.strides}"
            )
        if self.latent_dim < 1:
            raise ValueError(f"latent_dim must be at least 1, got {self.latent_dim}")
        for name in ("posterior_layers", "scene_layers", "image_layers"):
            if any(width < 1 for width in getattr(self, name)):
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if self.conditional != bool(self.scene_layers):
            raise ValueError("scene_layers must be given if, and only if, conditional")
        if self.pyramid_levels < 0 or 2**self.pyramid_levels > min(self.image_size):
            raise ValueError(
                f"pyramid_levels must be from 0 to log2 of the image, got {self.pyramid_levels}"
            )
        for name in ("pyramid_weight", "kl_weight", "kl_start", "kl_steps"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        if self.kl_steps and min(self.kl_start, self.kl_weight) <= 0:
            raise ValueError("kl_start and kl_weight must be positive for a growing weight")

    def kl_weight_at(self, step: int) -> float:
        """Weight of the KL divergence at a training step."""
        if step >= self.kl_steps:
            return self.kl_weight
        return float(self.kl_start * (self.kl_weight / self.kl_start) ** (step / self.kl_steps))


# Differences to the mean image are about a quarter where there is something.
_INPUT_SCALE = 4.0

DESK_VAE = CVAEConfig(
    conditional=False,
    channels=(8, 16, 32, 32, 32, 64, 128),
    strides=(1, 2, 1, 2, 1, 2, 1),
    posterior_layers=(512,),
    scene_layers=(),
    image_layers=(512,),
)
BAIR_CVAE = CVAEConfig(
    image_size=(48, 64),
    channels=(8, 16, 32, 64, 64, 128, 128, 256, 512),
    strides=(1, 1, 1, 1, 1, 1, 2, 2, 2),
)


class CVAE(nn.Module):
    """Images that are possible in a scene; the planner's subgoal generator decodes its latents.

    Letters: ``B`` images, ``L`` latent dimensions. Images inside are float, in [0, 1],
    ``[B, 3, height, width]``.
    """

    config_type: ClassVar[type[CVAEConfig]] = CVAEConfig
    mean_image: torch.Tensor

    def __init__(self, config: CVAEConfig) -> None:
        super().__init__()
        self.config = config
        sizes = [config.image_size]
        for stride in config.strides:
            sizes.append((-(-sizes[-1][0] // stride), -(-sizes[-1][1] // stride)))
        widths = (3, *config.channels)
        self._spatial = (config.channels[-1], *sizes[-1])
        features = math.prod(self._spatial)

        encoder: list[nn.Module] = []
        decoder: list[nn.Module] = []
        for i, stride in enumerate(config.strides):
            encoder += [nn.Conv2d(widths[i], widths[i + 1], 3, stride, padding=1), nn.ReLU()]
            extra = (
                sizes[i][0] - 1 - (sizes[i + 1][0] - 1) * stride,
                sizes[i][1] - 1 - (sizes[i + 1][1] - 1) * stride,
            )
            up = nn.ConvTranspose2d(
                widths[i + 1], widths[i], 3, stride, padding=1, output_padding=extra
            )
            decoder = [nn.ReLU(), up, *decoder]
        self.encoder = nn.Sequential(*encoder)
        self.decoder = nn.Sequential(*decoder[1:])  # it starts from features that are not rectified
        images = 2 if config.conditional else 1
        self.posterior = _fully_connected(
            images * features, *config.posterior_layers, 2 * config.latent_dim
        )
        scene = config.scene_layers[-1] if config.conditional else 0
        if config.conditional:
            self.scene = _fully_connected(features, *config.scene_layers)
        self.image = _fully_connected(config.latent_dim + scene, *config.image_layers, features)
        self.register_buffer("mean_image", torch.full((3, *config.image_size), 0.5))
        self._initialise()

    def centre(self, frames: torch.Tensor) -> CVAE:
        """Take the mean of ``frames``, uint8 ``[N, H, W, 3]``, as the image to start from.

        The encoder sees differences to it and the decoder's logits are added to its own. What all
        images share, most of the maze, is then known before the first step; otherwise it is all
        that the first thousands of steps learn, while the latents die.

        Raises:
            ValueError: another shape than the config's; TypeError: another dtype.
        """
        if frames.dtype != torch.uint8:
            raise TypeError(f"frames must be uint8, got {frames.dtype}")
        if frames.ndim != 4 or frames.shape[1:] != (*self.config.image_size, 3) or not len(frames):
            raise ValueError(
                f"frames must be [N, {self.config.image_size[0]}, {self.config.image_size[1]}, 3], "
                f"got {tuple(frames.shape)}"
            )
        total = torch.zeros(frames.shape[1:], dtype=torch.float64)
        for first in range(0, len(frames), 256):
            total += frames[first : first + 256].sum(0, dtype=torch.float64)
        self.mean_image.copy_((total / len(frames) / 255).permute(2, 0, 1))
        return self

    def encode(
        self, image: torch.Tensor, scene: torch.Tensor | None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and log variance of the posterior, ``[B, L]`` each, of images in a scene ``[B]``."""
        parts = [image] if scene is None else [scene, image]
        features = self._encode(torch.cat(parts)).flatten(1)
        return self._posterior(torch.cat(features.chunk(len(parts)), 1))

    def decode_logits(self, latent: torch.Tensor, scene: torch.Tensor | None) -> torch.Tensor:
        """Logits of the images of ``latent [B, L]`` in the scene of ``scene [B]``."""
        spatial = None if scene is None else self._encode(scene)
        return self._decode(latent, spatial)

    def decode(self, latent: torch.Tensor, scene: torch.Tensor | None = None) -> torch.Tensor:
        """Images of latents in a scene.

        Args:
            latent: float ``[B, L]``.
            scene: images of the scene, float ``[B, 3, H, W]`` or ``[1, 3, H, W]``, in [0, 1]; None
                without a scene.

        Returns:
            Images in [0, 1], ``[B, 3, H, W]``.

        Raises:
            ValueError: another shape, or a scene where there must be none.
        """
        if latent.ndim != 2 or latent.shape[1] != self.config.latent_dim:
            raise ValueError(
                f"latent must be [B, {self.config.latent_dim}], got {tuple(latent.shape)}"
            )
        if (scene is not None) != self.config.conditional:
            raise ValueError(
                "scene must be given" if self.config.conditional else "scene must be None"
            )
        if scene is not None and (
            scene.shape[1:] != (3, *self.config.image_size)
            or scene.shape[0] not in (1, latent.shape[0])
        ):
            raise ValueError(
                f"scene must be [1 or {latent.shape[0]}, 3, {self.config.image_size[0]}, "
                f"{self.config.image_size[1]}], got {tuple(scene.shape)}"
            )
        return torch.sigmoid(self.decode_logits(latent, scene).float())

    def loss(
        self, batch: Mapping[str, torch.Tensor], generator: torch.Generator, step: int
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Negative evidence bound, with a growing weight on the KL divergence.

        Args:
            batch: ``image`` and, if conditional, ``scene``, uint8 ``[B, H, W, 3]``. Each image of
                a pair is also the scene of the other, which saves half of the encoding.
            generator: of the posterior's noise.
            step: for the weight of the KL divergence.
        """
        image = to_unit(batch["image"])
        if self.config.conditional:
            image = torch.cat([image, to_unit(batch["scene"])])
        spatial = self._encode(image)
        flat = spatial.flatten(1)
        scene = None
        if self.config.conditional:
            scene = spatial.roll(len(image) // 2, 0)
            flat = torch.cat([scene.flatten(1), flat], 1)
        mean, log_variance = self._posterior(flat)
        noise = torch.randn(mean.shape, generator=generator, device=mean.device, dtype=mean.dtype)
        logits = self._decode(mean + noise * torch.exp(0.5 * log_variance), scene).float()

        size = len(image)
        pixel = F.binary_cross_entropy_with_logits(logits, image, reduction="sum") / size
        prediction = torch.sigmoid(logits)
        pyramid = pyramid_loss(prediction, image, self.config.pyramid_levels)
        kl = gaussian_kl(mean, log_variance).mean()
        total = pixel + self.config.pyramid_weight * pyramid
        total = total + self.config.kl_weight_at(step) * kl
        return total, {
            "pixel": pixel.detach(),
            "pyramid": pyramid.detach(),
            "kl": kl.detach(),
            "mse": F.mse_loss(prediction.detach(), image),
        }

    def _initialise(self) -> None:
        """Keep the variance through rectified layers (He et al., 2015), and begin nearly noiseless.

        With torch's default the signal fades over ten layers, and with a variance of 1 it drowns in
        the posterior's noise: the decoder learns to ignore the latent before it carries anything.
        """
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.ConvTranspose2d | nn.Linear):
                inputs = float(module.weight[0].numel())
                if isinstance(module, nn.ConvTranspose2d):
                    inputs = module.weight.shape[0] * 9 / module.stride[0] ** 2
                nn.init.normal_(module.weight, std=math.sqrt(2 / inputs))
                if module.bias is not None:
                    nn.init.zeros_(module.bias)
        posterior, last = cast(nn.Linear, self.posterior[-1]), self.decoder[-1]
        with torch.no_grad():
            posterior.weight[self.config.latent_dim :] *= 0.1
            posterior.bias[self.config.latent_dim :] = -5.0
            cast(nn.ConvTranspose2d, last).weight *= 0.1

    def _encode(self, images: torch.Tensor) -> torch.Tensor:
        features: torch.Tensor = self.encoder((images - self.mean_image) * _INPUT_SCALE)
        return features

    def _posterior(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mean, log_variance = self.posterior(features).float().chunk(2, 1)
        return mean, log_variance.clamp(-12, 4)

    def _decode(self, latent: torch.Tensor, spatial: torch.Tensor | None) -> torch.Tensor:
        if spatial is None:
            grown = self.image(latent).unflatten(1, self._spatial)
        else:
            scene = self.scene(spatial.flatten(1)).expand(len(latent), -1)
            grown = self.image(torch.cat([scene, latent], 1)).unflatten(1, self._spatial) + spatial
        change: torch.Tensor = self.decoder(grown.contiguous(memory_format=torch.channels_last))
        return change + torch.logit(self.mean_image, eps=1e-2)


def gaussian_kl(mean: torch.Tensor, log_variance: torch.Tensor) -> torch.Tensor:
    """KL divergence of N(mean, exp(log_variance)) to N(0, I) in nats: ``[B, L]`` to ``[B]``."""
    return 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(1)


def pyramid_loss(prediction: torch.Tensor, image: torch.Tensor, levels: int) -> torch.Tensor:
    """Squared error after 1 to ``levels`` average poolings by 2.

    Summed over cells, channels and levels, each cell weighted by the pixels that it stands for;
    mean over the batch. A wrong place costs less the nearer it is to the right one.
    """
    difference = prediction - image
    total = difference.new_zeros(())
    for level in range(1, levels + 1):
        difference = F.avg_pool2d(difference, 2, ceil_mode=True, count_include_pad=False)
        total = total + difference.square().sum() * 8.0**level
    return total / len(image)


def _fully_connected(*widths: int) -> nn.Sequential:
    """Linear layers of these widths with ReLU between them."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Linear(inputs, outputs), nn.ReLU()]
    return nn.Sequential(*layers[:-1])
