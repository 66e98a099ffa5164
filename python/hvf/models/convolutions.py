"""Stacks of 3x3 convolutions that shrink an image to features, and their mirror images.

What the paper's generators, time-agnostic prediction and the temporal distance of the released code
have in common.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Literal, TypeAlias

from torch import Tensor, nn

Padding: TypeAlias = Literal["same", "valid"]
"""``same`` halves an image at a stride of 2; ``valid`` sees only what is inside."""


def sizes_after(
    image_size: tuple[int, int], strides: Sequence[int], padding: Padding
) -> list[tuple[int, int]]:
    """Height and width of an image, and after each convolution of these ``strides``.

    Below 1 where an image is too small to be convolved without padding.
    """
    sizes = [image_size]
    # A window of 3 pixels begins on every stride-th pixel, of all or of those where it fits.
    lost = 0 if padding == "same" else 2
    for stride in strides:
        height, width = sizes[-1]
        sizes.append((-(-(height - lost) // stride), -(-(width - lost) // stride)))
    return sizes


@dataclasses.dataclass(frozen=True)
class StackConfig:
    """Images that go through convolutions of stride 2 without padding, as in the released code.

    Attributes:
        image_size: height and width in pixels, at least 31 for four convolutions.
        channels: of the 3x3 convolutions.

    Raises:
        ValueError: channels below 1, or images that are too small.
    """

    image_size: tuple[int, int] = (64, 64)
    channels: tuple[int, ...] = (16, 32, 64, 128)

    def __post_init__(self) -> None:
        if not self.channels or min(self.channels) < 1:
            raise ValueError(f"channels must be positive, got {self.channels}")
        if len(self.image_size) != 2 or min(map(min, self.sizes)) < 1:
            raise ValueError(
                f"image_size must be (height, width), enough for {len(self.channels)} convolutions "
                f"without padding; got {self.image_size}"
            )

    @property
    def strides(self) -> tuple[int, ...]:
        """Of the convolutions."""
        return (2,) * len(self.channels)

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """Height and width of the image, and after each convolution."""
        return sizes_after(self.image_size, self.strides, "valid")

    def check_pair(self, **images: Tensor) -> None:
        """Refuse two batches of images that are not of this size, or not as many.

        Raises:
            ValueError: it is so; names the one that does not fit.
        """
        for name, batch in images.items():
            if batch.ndim != 4 or batch.shape[1:] != (3, *self.image_size):
                height, width = self.image_size
                raise ValueError(
                    f"{name}: expected shape [B, 3, {height}, {width}], got {list(batch.shape)}"
                )
        (one, first), (other, second) = images.items()
        if len(first) != len(second):
            raise ValueError(
                f"{other}: must be {len(first)} images, as many as {one}; got {len(second)}"
            )


def encoder_of(
    channels: Sequence[int],
    strides: Sequence[int],
    padding: Padding,
    *,
    inputs: int = 3,
    activate_final: bool = False,
) -> nn.Sequential:
    """Convolutions with ReLU between them: images ``[B, inputs, H, W]`` to features.

    Args:
        channels: of each convolution.
        strides: of each.
        padding: of all.
        inputs: channels of the image.
        activate_final: rectify what the last one gives, too.
    """
    layers: list[nn.Module] = []
    for (before, after), stride in zip(pairwise((inputs, *channels)), strides, strict=True):
        layers += [nn.Conv2d(before, after, 3, stride, padding=_pixels(padding)), nn.ReLU()]
    return nn.Sequential(*(layers if activate_final else layers[:-1]))


def decoder_of(
    channels: Sequence[int],
    strides: Sequence[int],
    padding: Padding,
    sizes: Sequence[tuple[int, int]],
) -> nn.Sequential:
    """The mirror image of :func:`encoder_of`: features to logits of images ``[B, 3, H, W]``.

    Args:
        channels: of the encoder's convolutions.
        strides: of the encoder's.
        padding: of the encoder's.
        sizes: before, between and after the encoder's convolutions (:func:`sizes_after`).
    """
    layers: list[nn.Module] = []
    pad = _pixels(padding)
    for i, (after, before) in reversed(list(enumerate(pairwise((3, *channels))))):
        stride = strides[i]
        # Pixels that the transposed convolution alone would not give back.
        extra = (
            sizes[i][0] - 3 + 2 * pad - (sizes[i + 1][0] - 1) * stride,
            sizes[i][1] - 3 + 2 * pad - (sizes[i + 1][1] - 1) * stride,
        )
        layers += [
            nn.ConvTranspose2d(before, after, 3, stride, padding=pad, output_padding=extra),
            nn.ReLU(),
        ]
    return nn.Sequential(*layers[:-1])


def fully_connected(*widths: int) -> nn.Sequential:
    """Linear layers of these widths with ReLU between them."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Linear(inputs, outputs), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def initialise_as_sonnet(network: nn.Module) -> None:
    """First weights as the library that the released code was written with has them (Sonnet 1).

    A normal distribution of 1 / sqrt(inputs), cut at two standard deviations; biases are 0.
    """
    for module in network.modules():
        if isinstance(module, nn.Conv2d | nn.ConvTranspose2d | nn.Linear):
            inputs = float(module.weight[0].numel())
            if isinstance(module, nn.ConvTranspose2d):
                inputs = module.weight.shape[0] * 9
            std = 1 / math.sqrt(inputs)
            nn.init.trunc_normal_(module.weight, std=std, a=-2 * std, b=2 * std)
            if module.bias is not None:
                nn.init.zeros_(module.bias)


def initialise_after_he(network: nn.Module) -> None:
    """First weights that keep the variance through rectified layers (He et al., 2015)."""
    for module in network.modules():
        if isinstance(module, nn.Conv2d | nn.ConvTranspose2d | nn.Linear):
            inputs = float(module.weight[0].numel())
            if isinstance(module, nn.ConvTranspose2d):
                inputs = module.weight.shape[0] * 9 / module.stride[0] ** 2
            nn.init.normal_(module.weight, std=math.sqrt(2 / inputs))
            if module.bias is not None:
                nn.init.zeros_(module.bias)


def _pixels(padding: Padding) -> int:
    return 1 if padding == "same" else 0
