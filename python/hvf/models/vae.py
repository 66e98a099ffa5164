"""Generative model of the images that are possible in a scene (paper, section 4.1 and appendix).

A variational autoencoder, conditional on an image of the scene: the latent says what may change
(the agent), the scene says what may not (the gaps). Without the scene it is the VAE of the desk;
other channels and strides make the CVAE of the BAIR robot.

How the configurations differ is in :mod:`hvf.models.vae_config`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar, cast

import torch
import torch.nn.functional as F
from torch import nn

from hvf.models.centred import Centred
from hvf.models.convolutions import (
    decoder_of,
    encoder_of,
    fully_connected,
    initialise_after_he,
    initialise_as_sonnet,
)
from hvf.models.frames import to_unit
from hvf.models.vae_config import (
    BAIR_CVAE,
    DESK_VAE,
    PAPER_BAIR,
    PAPER_CVAE,
    PAPER_VAE,
    CVAEConfig,
)

__all__ = [
    "BAIR_CVAE",
    "CVAE",
    "DESK_VAE",
    "PAPER_BAIR",
    "PAPER_CVAE",
    "PAPER_VAE",
    "VAE",
    "CVAEConfig",
    "gaussian_kl",
    "pyramid_loss",
]

# Added to the variance under the logarithm, which a rectified standard deviation may make 0.
_LEAST_VARIANCE = 1e-5


class CVAE(Centred):
    """Images that are possible in a scene; the planner's subgoal generator decodes its latents.

    Letters: ``B`` images, ``L`` latent dimensions. Images inside are float, in [0, 1],
    ``[B, 3, height, width]``.
    """

    config_type: ClassVar[type[CVAEConfig]] = CVAEConfig
    config: CVAEConfig

    def __init__(self, config: CVAEConfig) -> None:
        super().__init__(config)
        sizes, padding = config.sizes, config.padding
        self._spatial = (config.channels[-1], *sizes[-1])
        features = math.prod(self._spatial)

        self.encoder = encoder_of(
            config.channels, config.strides, padding, activate_final=config.activate_final
        )
        self.decoder = decoder_of(config.channels, config.strides, padding, sizes)
        images = 2 if config.conditional else 1
        self.posterior = fully_connected(
            images * features, *config.posterior_layers, 2 * config.latent_dim
        )
        scene = config.scene_layers[-1] if config.conditional else 0
        if config.conditional:
            self.scene = fully_connected(features, *config.scene_layers)
        self.image = fully_connected(config.latent_dim + scene, *config.image_layers, features)
        if not config.activate_final and config.image_layers:
            del self.image[-2]
        self._initialise()

    def encode(
        self, image: torch.Tensor, scene: torch.Tensor | None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and log variance of the posterior, ``[B, L]`` each.

        Args:
            image: images ``[B, 3, H, W]`` in [0, 1].
            scene: the scene of each, or ``[1, 3, H, W]``, the scene of all; None without.
        """
        features = self._encode(image).flatten(1)
        if scene is None:
            mean, _, log_variance = self._posterior(self.posterior(features))
            return mean, log_variance
        # The first layer is linear in both, so that what it makes of a scene is made once.
        first = cast(nn.Linear, self.posterior[0])
        of_scene, of_image = first.weight.chunk(2, 1)
        context = F.linear(self._encode(scene).flatten(1), of_scene, first.bias)
        mean, _, log_variance = self._posterior(
            self.posterior[1:](context + F.linear(features, of_image))
        )
        return mean, log_variance

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
            batch: ``image`` and, if conditional, ``scene``, uint8 ``[B, H, W, 3]``. Learning both
                ways, each image of a pair is also the scene of the other, which saves half of the
                encoding.
            generator: of the posterior's noise.
            step: for the weight of the KL divergence.
        """
        image = to_unit(batch["image"])
        scene = None
        if self.config.conditional:
            both = torch.cat([image, to_unit(batch["scene"])])
            spatial = self._encode(both)
            if self.config.both_ways:
                image, scene = both, spatial.roll(len(image), 0)
            else:
                spatial, scene = spatial.chunk(2)
            flat = torch.cat([scene.flatten(1), spatial.flatten(1)], 1)
        else:
            flat = self._encode(image).flatten(1)
        mean, deviation, log_variance = self._posterior(self.posterior(flat))
        noise = torch.randn(mean.shape, generator=generator, device=mean.device, dtype=mean.dtype)
        logits = self._decode(mean + noise * deviation, scene).float()

        prediction = torch.sigmoid(logits)
        pixel = self._negative_likelihood(logits, prediction, image) / len(image)
        pyramid = pyramid_loss(prediction, image, self.config.pyramid_levels)
        kl = gaussian_kl(mean, log_variance, self._variance(deviation)).mean()
        total = pixel + self.config.pyramid_weight * pyramid
        total = total + self.config.kl_weight_at(step) * kl
        return total, {
            "pixel": pixel.detach(),
            "pyramid": pyramid.detach(),
            "kl": kl.detach(),
            "mse": F.mse_loss(prediction.detach(), image),
        }

    def _negative_likelihood(
        self, logits: torch.Tensor, prediction: torch.Tensor, image: torch.Tensor
    ) -> torch.Tensor:
        """In nats, summed over all that there is."""
        least = self.config.least_probability
        if least:
            kept = prediction.clamp(least, 1 - least)
            return -(image * kept.log() + (1 - image) * (1 - kept).log()).sum()
        return F.binary_cross_entropy_with_logits(logits, image, reduction="sum")

    def _initialise(self) -> None:
        if self.config.initialisation == "he":
            self._initialise_he()
            return
        initialise_as_sonnet(self)

    def _initialise_he(self) -> None:
        """Keep the variance through rectified layers (He et al., 2015), and begin nearly noiseless.

        With torch's default the signal fades over ten layers, and with a variance of 1 it drowns in
        the posterior's noise: the decoder learns to ignore the latent before it carries anything.
        """
        initialise_after_he(self)
        posterior, last = cast(nn.Linear, self.posterior[-1]), self.decoder[-1]
        with torch.no_grad():
            posterior.weight[self.config.latent_dim :] *= 0.1
            posterior.bias[self.config.latent_dim :] = -5.0
            cast(nn.ConvTranspose2d, last).weight *= 0.1

    def _encode(self, images: torch.Tensor) -> torch.Tensor:
        features: torch.Tensor = self.encoder(self.taken(images))
        return features

    def _posterior(self, outputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Mean, standard deviation and log variance from what the last layer gives."""
        mean, second = outputs.float().chunk(2, 1)
        if self.config.posterior == "relu-std":
            deviation = F.relu(second)
            return mean, deviation, (_LEAST_VARIANCE + deviation.square()).log()
        log_variance = second.clamp(-12, 4)
        return mean, torch.exp(0.5 * log_variance), log_variance

    def _variance(self, deviation: torch.Tensor) -> torch.Tensor | None:
        """The variance, where it is not that of the log variance to the last bit."""
        return deviation.square() if self.config.posterior == "relu-std" else None

    def _decode(self, latent: torch.Tensor, spatial: torch.Tensor | None) -> torch.Tensor:
        if spatial is None:
            grown = self.image(latent).unflatten(1, self._spatial)
        else:
            scene = self.scene(spatial.flatten(1)).expand(len(latent), -1)
            grown = self.image(torch.cat([scene, latent], 1)).unflatten(1, self._spatial) + spatial
        return self.drawn(self.decoder(grown.contiguous(memory_format=torch.channels_last)))


class VAE(CVAE):
    """Images that are possible in the only scene that there is: a :class:`CVAE` without a scene.

    Raises:
        ValueError: a config with a scene.
    """

    def __init__(self, config: CVAEConfig) -> None:
        if config.conditional:
            raise ValueError("conditional must be False for a VAE")
        super().__init__(config)


def gaussian_kl(
    mean: torch.Tensor, log_variance: torch.Tensor, variance: torch.Tensor | None = None
) -> torch.Tensor:
    """KL divergence of N(mean, exp(log_variance)) to N(0, I) in nats: ``[B, L]`` to ``[B]``.

    ``variance`` may be given where it is known better than by its logarithm.
    """
    variance = log_variance.exp() if variance is None else variance
    return 0.5 * (mean.square() + variance - 1 - log_variance).sum(1)


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
