"""Time-agnostic prediction: an image between a start and a goal (Jayaraman et al., ICLR 2019).

A baseline of Nair & Finn (2020): where HVF searches for subgoals, TAP proposes one in a single
pass. Network and loss are those of the authors' released code (google-research,
``hierarchical_foresight/models/tap.py``, ``train_tap.py``): of all frames between the two, the
prediction has to be one, whichever it is nearest to; so it becomes the frame that is easiest to
predict, such as the passage through a gap.

What the defaults of the recipe change is off in the released configuration, and the same as in our
CVAE (:mod:`hvf.models.vae_config` has a table): first weights after He, images taken and drawn as
differences to their mean, and a pyramid loss beside the likelihood. A small thing that moves is a
few pixels of that, and none of its gradient says which way it is to be moved.

Letters in shapes: ``B`` pairs of images, ``C`` candidates, ``H x W`` pixels.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import ClassVar, Literal, cast

import torch
from torch import Tensor, nn

from hvf.models.centred import Centred
from hvf.models.convolutions import (
    StackConfig,
    decoder_of,
    encoder_of,
    fully_connected,
    initialise_after_he,
    initialise_as_sonnet,
)
from hvf.models.frames import to_unit
from hvf.models.vae import pyramid_loss


@dataclasses.dataclass(frozen=True)
class TAPConfig(StackConfig):
    """Sizes of the network and its loss; the defaults are the released code's.

    That network has 1,389,387 parameters.

    Attributes:
        image_size: height and width in pixels, at least 31 for four convolutions.
        channels: of the 3x3 convolutions of stride 2, without padding, that both images go
            through; the decoder mirrors them.
        hidden: width of the layer that sees both.
        latent_dim: width of the linear layer between that and the decoder.
        least_probability: predicted probabilities are kept this far from 0 and 1.
        centred: images are taken, and drawn, as differences to the mean image.
        initialisation: of the weights: for rectified layers (``he``), or a normal distribution cut
            at two standard deviations of 1 / sqrt(fan in).
        pyramid_levels: the prediction is also compared with its nearest candidate after 1, 2, ...
            average poolings by 2 (:func:`~hvf.models.vae.pyramid_loss`); 0 as released.
        pyramid_weight: weight of each of these levels.

    Raises:
        ValueError: a number out of range, or images that are too small.
    """

    hidden: int = 512
    latent_dim: int = 8
    least_probability: float = 1e-3
    centred: bool = False
    initialisation: Literal["he", "truncated-normal"] = "truncated-normal"
    pyramid_levels: int = 0
    pyramid_weight: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("hidden", "latent_dim"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not 0 < self.least_probability < 0.5:
            raise ValueError(
                f"least_probability must be between 0 and 0.5, got {self.least_probability}"
            )
        if self.initialisation not in ("he", "truncated-normal"):
            raise ValueError(
                f"initialisation must be he or truncated-normal, got {self.initialisation!r}"
            )
        if not (math.isfinite(self.pyramid_weight) and self.pyramid_weight >= 0):
            raise ValueError(f"pyramid_weight must not be negative, got {self.pyramid_weight}")
        if self.pyramid_levels < 0 or 2**self.pyramid_levels > min(self.image_size):
            raise ValueError(
                f"pyramid_levels must be from 0 to log2 of the image, got {self.pyramid_levels}"
            )


class TAP(Centred):
    """Predicts an image that lies between two others in time."""

    config_type: ClassVar[type[TAPConfig]] = TAPConfig
    config: TAPConfig

    def __init__(self, config: TAPConfig) -> None:
        super().__init__(config)
        self._spatial = (config.channels[-1], *config.sizes[-1])
        features = math.prod(self._spatial)
        self.encoder = encoder_of(config.channels, config.strides, "valid")
        self.bottleneck = fully_connected(2 * features, config.hidden, config.latent_dim)
        self.features = nn.Linear(config.latent_dim, features)
        self.decoder = decoder_of(config.channels, config.strides, "valid", config.sizes)
        if config.initialisation == "he":
            initialise_after_he(self)
            with torch.no_grad():
                cast(nn.ConvTranspose2d, self.decoder[-1]).weight *= 0.1
        else:
            initialise_as_sonnet(self)

    def forward(self, start: Tensor, goal: Tensor) -> Tensor:
        """Images between ``start`` and ``goal``: float ``[B, 3, H, W]`` in [0, 1], all three.

        Raises:
            ValueError: images of other shapes.
        """
        self.config.check_pair(start=start, goal=goal)
        seen = self.encoder(self.taken(torch.cat([start, goal]))).flatten(1)
        latent = self.bottleneck(torch.cat(seen.chunk(2), 1))
        grown = self.features(latent).unflatten(1, self._spatial)
        decoded = self.decoder(grown.contiguous(memory_format=torch.channels_last))
        logits = self.drawn(decoded.float())
        least = self.config.least_probability
        return torch.sigmoid(logits).clamp(least, 1 - least)

    def loss(
        self, batch: Mapping[str, Tensor], generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Negative log likelihood of the nearest candidate, nats summed over pixels and colours.

        And, if the config asks for it, its pyramid loss.

        Args:
            batch: ``start`` and ``end``, uint8 ``[B, H, W, 3]``, and ``candidates``, uint8
                ``[B, C, H, W, 3]``.
            generator: not used: nothing is drawn.
            step: not used.
        """
        prediction = self(to_unit(batch["start"]), to_unit(batch["end"]))
        each = self.negative_likelihoods(prediction, batch["candidates"])
        least, which = each.min(1)
        chosen = to_unit(batch["candidates"][torch.arange(len(which), device=which.device), which])
        loss = pixel = least.mean()
        if self.config.pyramid_levels:
            pyramid = pyramid_loss(prediction, chosen, self.config.pyramid_levels)
            loss = loss + self.config.pyramid_weight * pyramid
        return loss, {
            "pixel": pixel.detach(),
            "mse": (prediction.detach() - chosen).square().mean(),
            "candidate": which.float().mean(),
        }

    def negative_likelihoods(self, prediction: Tensor, candidates: Tensor) -> Tensor:
        """Of ``candidates`` uint8 ``[B, C, H, W, 3]`` under Bernoulli distributions, ``[B, C]``.

        ``prediction``, float ``[B, 3, H, W]``, are their probabilities.
        """
        likely = prediction.permute(0, 2, 3, 1).flatten(1)
        # -sum(c log p + (1 - c) log(1 - p)), linear in c: one product instead of C images.
        off = torch.log1p(-likely)
        seen = candidates.flatten(2).float() / 255
        return -off.sum(1, keepdim=True) - torch.bmm(seen, (likely.log() - off)[:, :, None])[..., 0]
