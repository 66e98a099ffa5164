"""Sizes and losses of the generators of subgoal images: the paper's, and ours.

Layers and widths are the paper's in every configuration. ``PAPER_CVAE`` follows the authors'
released code (google-research, ``hierarchical_foresight/models/vae.py``) in the rest too, our
default does not:

======================  ======================================  ==================================
what                    ``PAPER_CVAE`` (``--preset paper``)     ours (the default)
======================  ======================================  ==================================
convolutions            no padding: 64 pixels to 3              padded: 64 pixels to 4
last convolution, last  linear                                  rectified
of ``image_layers``
posterior               mean, rectified standard deviation      mean, logarithm of the variance
likelihood              Bernoulli, probabilities kept 1e-5      Bernoulli, from logits
                        from 0 and 1
loss                    evidence lower bound                    KL weight 5, grown from 0.05 over
                                                                2,000 steps; squared error of four
                                                                halved images beside the likelihood
images                  as they are                             less the mean of all images, which
                                                                is added to the decoder's logits
a pair                  the second given the first              each given the other
first weights           truncated normal, 1 / sqrt(fan in)      normal after He; a quiet posterior
training                Adam, 1e-4, constant; batches of 256    Adam, 1e-3, warmed up, then half a
                        pairs; 100,000 steps                    cosine; 16 pairs; 16,000 steps
======================  ======================================  ==================================

In both, pairs are two frames of one episode at random times and features of the scene are added
to the decoder's, as in the released code; the paper's text has the scene's first frame in the
pairs, and concatenates the features. The code of the desk's VAE and of BAIR's CVAE was not
released: ``PAPER_VAE`` and ``PAPER_BAIR`` take over what is above; ``DESK_VAE`` and ``BAIR_CVAE``
have the same layers and our loss. ``RIG_VAE`` is that of another paper, whose policy
is a baseline (:mod:`hvf.models.rig`).
"""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

from hvf.models.convolutions import Padding, sizes_after


@dataclasses.dataclass(frozen=True)
class CVAEConfig:
    """Sizes of the networks and weights of the loss.

    The defaults are ours, with the layers of the paper's maze CVAE; see the module's table.

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
        padding: of the convolutions: ``same`` halves an image at a stride of 2, ``valid`` sees
            only what is inside.
        posterior: what its second half is: the logarithm of the variance, or the standard
            deviation before it is rectified.
        centred: images are taken, and drawn, as differences to the mean image.
        activate_final: rectify what the last convolution gives, and the last of
            ``image_layers`` too.
        both_ways: learn each image of a pair given the other, not only the second.
        initialisation: of the weights: for rectified layers, with a quiet posterior (``he``), or a
            normal distribution cut at two standard deviations of 1 / sqrt(fan in).
        least_probability: probabilities of the likelihood are kept this far from 0 and 1.
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
    padding: Padding = "same"
    posterior: Literal["log-variance", "relu-std"] = "log-variance"
    centred: bool = True
    activate_final: bool = True
    both_ways: bool = True
    initialisation: Literal["he", "truncated-normal"] = "he"
    least_probability: float = 0.0

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
        for name, choices in (
            ("padding", ("same", "valid")),
            ("posterior", ("log-variance", "relu-std")),
            ("initialisation", ("he", "truncated-normal")),
        ):
            if getattr(self, name) not in choices:
                raise ValueError(
                    f"{name} must be one of {', '.join(choices)}, got {getattr(self, name)!r}"
                )
        if not 0 <= self.least_probability < 0.5:
            raise ValueError(
                f"least_probability must be from 0 to 0.5, got {self.least_probability}"
            )
        if min(map(min, self.sizes)) < 1:
            raise ValueError(
                f"image_size {self.image_size} is too small for {len(self.channels)} convolutions "
                "without padding"
            )

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """Height and width of the image, and after each convolution of the encoder."""
        return sizes_after(self.image_size, self.strides, self.padding)

    def kl_weight_at(self, step: int) -> float:
        """Weight of the KL divergence at a training step."""
        if step >= self.kl_steps:
            return self.kl_weight
        return float(self.kl_start * (self.kl_weight / self.kl_start) ** (step / self.kl_steps))


DESK_VAE = CVAEConfig(
    conditional=False,
    channels=(8, 16, 32, 32, 32, 64, 128),
    strides=(1, 2, 1, 2, 1, 2, 1),
    posterior_layers=(512,),
    scene_layers=(),
    image_layers=(512,),
)
DESK_CVAE = CVAEConfig(
    channels=(16, 32, 64, 32),
    strides=(2, 2, 2, 1),
    posterior_layers=(128,),
    scene_layers=(256,),
    image_layers=(256,),
)
"""Ours, where the paper has :data:`DESK_VAE`: it is shown the start, and keeps what stays."""
BAIR_CVAE = CVAEConfig(
    image_size=(48, 64),
    channels=(8, 16, 32, 64, 64, 128, 128, 256, 512),
    strides=(1, 1, 1, 1, 1, 1, 2, 2, 2),
)
PAPER_CVAE = CVAEConfig(
    pyramid_levels=0,
    pyramid_weight=0.0,
    kl_weight=1.0,
    kl_start=1.0,
    kl_steps=0,
    padding="valid",
    posterior="relu-std",
    centred=False,
    activate_final=False,
    both_ways=False,
    initialisation="truncated-normal",
    least_probability=1e-5,
)
PAPER_VAE = dataclasses.replace(
    PAPER_CVAE,
    conditional=False,
    channels=DESK_VAE.channels,
    strides=DESK_VAE.strides,
    scene_layers=(),
    image_layers=DESK_VAE.image_layers,
)
PAPER_BAIR = dataclasses.replace(
    PAPER_CVAE,
    image_size=BAIR_CVAE.image_size,
    channels=BAIR_CVAE.channels,
    strides=BAIR_CVAE.strides,
)
RIG_VAE = CVAEConfig(
    conditional=False,
    latent_dim=4,
    posterior_layers=(),
    scene_layers=(),
    image_layers=(),
    pyramid_levels=0,
    pyramid_weight=0.0,
    kl_weight=10 / 128,
    kl_start=10 / 128,
    kl_steps=0,
    centred=False,
)
"""The VAE that RIG sees with: latent, loss and weight of the KL divergence as in rlkit's
``examples/rig/pusher/rig.py``. The convolutions are ours: rlkit's are for images of 48 and 84."""
