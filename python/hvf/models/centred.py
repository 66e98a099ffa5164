"""Models that take images, and draw them, as differences to the mean image."""

from __future__ import annotations

from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from hvf.models.frames import mean_image

# Differences to the mean image are about a quarter where there is something.
_INPUT_SCALE = 4.0

CentredT = TypeVar("CentredT", bound="Centred")


class Centred(nn.Module):
    """A model whose config says, as ``centred``, whether images are differences to their mean.

    What all images share, most of a maze, is then known before the first step; otherwise it is
    all that the first thousands of steps learn. Letters: ``B`` images, ``H x W`` pixels.
    """

    mean_image: Tensor

    def __init__(self, config: Any) -> None:
        super().__init__()
        self.config = config
        if config.centred:
            self.register_buffer("mean_image", torch.full((3, *config.image_size), 0.5))

    def centre(self: CentredT, frames: Tensor) -> CentredT:
        """Take the mean of ``frames``, uint8 ``[N, H, W, 3]``, as the image to start from.

        Raises:
            ValueError: another shape than the config's, or a config that is not centred.
            TypeError: another dtype.
        """
        if not self.config.centred:
            raise ValueError("centre: the config says that images are taken as they are")
        self.mean_image.copy_(mean_image(frames, self.config.image_size))
        return self

    def taken(self, images: Tensor) -> Tensor:
        """``images [B, 3, H, W]`` in [0, 1] as an encoder sees them."""
        return (images - self.mean_image) * _INPUT_SCALE if self.config.centred else images

    def drawn(self, logits: Tensor) -> Tensor:
        """Logits of images from the ``logits [B, 3, H, W]`` that a decoder gives."""
        if not self.config.centred:
            return logits
        return logits + torch.logit(self.mean_image, eps=1e-2)
