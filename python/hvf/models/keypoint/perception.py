"""Where the moving part of an image is, learned without labels from pairs of frames.

Two frames of one episode differ only in what moved. A convolutional mask and a sprite each have to
explain that difference:

    image - scene  =  colour * (mask(image) - mask(scene))
    image - scene  =  colour * (sprite(keypoint(image)) - sprite(keypoint(scene)))

where the keypoint is the mask's centroid and the sprite is a soft box of learned size, so that the
keypoint becomes the position of what moves, to a few hundredths of a pixel.

Letters in shapes: `N` frames, `S` image size.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from hvf.models.frames import to_unit

_SHARPNESS = 10.0
"""Of the softplus that keeps the mask positive: a rectifier would die before the mask forms."""


@dataclass(frozen=True)
class PerceptionConfig:
    """Sizes and loss weights of the keypoint detector.

    Attributes:
        image_size: height and width of the images, `S`, in pixels (a multiple of 8).
        channels: features of the mask's hidden layer.
        sparsity: weight of the mask's sum, which keeps it empty where nothing moves.
        sprite_from: step at which the sprite's loss begins to count, once the mask has formed.
    """

    image_size: int = 64
    channels: int = 8
    sparsity: float = 1e-3
    sprite_from: int = 300

    def __post_init__(self) -> None:
        if self.image_size < 16 or self.image_size % 8:
            raise ValueError(
                f"image_size must be a multiple of 8, at least 16; got {self.image_size}"
            )
        if self.channels < 1:
            raise ValueError(f"channels must be at least 1, got {self.channels}")
        if not self.sparsity >= 0:
            raise ValueError(f"sparsity must not be negative, got {self.sparsity}")
        if self.sprite_from < 0:
            raise ValueError(f"sprite_from must not be negative, got {self.sprite_from}")


class KeypointPerception(nn.Module):
    """Mask, keypoint and sprite; see the module's documentation."""

    config_type: ClassVar[type[PerceptionConfig]] = PerceptionConfig
    grid: Tensor

    def __init__(self, config: PerceptionConfig) -> None:
        super().__init__()
        self.config = config
        last = nn.Conv2d(config.channels, 1, 1)
        self.mask = nn.Sequential(nn.Conv2d(3, config.channels, 3, padding=1), nn.ReLU(), last)
        # Nearly empty to begin with, but not so empty that nothing can grow.
        nn.init.constant_(cast(Tensor, last.bias), -0.2)
        # A wide, soft sprite to begin with: its gradient reaches further.
        self.log_half_size = nn.Parameter(torch.full((2,), 3.0).log())
        self.log_edge = nn.Parameter(torch.full((2,), 3.0).log())
        self.colour = nn.Parameter(torch.tensor([0.1, 0.3, 0.1]))
        self.register_buffer(
            "grid", torch.arange(config.image_size, dtype=torch.float32), persistent=False
        )

    @property
    def half_size(self) -> Tensor:
        """Half the sprite's size along rows and columns, `[2]`, in pixels."""
        return self.log_half_size.exp()

    @property
    def edge(self) -> Tensor:
        """Width of the sprite's soft edge along rows and columns, `[2]`, in pixels."""
        return self.log_edge.exp()

    def motion_mask(self, images: Tensor) -> Tensor:
        """Mask of what moves, `[N, S, S]`, not negative, from `images [N, 3, S, S]` in [0, 1]."""
        return F.softplus(self.mask(4.0 * (images - 0.25)).squeeze(1), beta=_SHARPNESS)

    def centroid(self, mask: Tensor) -> Tensor:
        """Keypoints `[N, 2]` as (row, column) in pixels from a mask `[N, S, S]`."""
        total = mask.sum(dim=(1, 2)).clamp_min(1.0)
        row = (mask.sum(dim=2) * self.grid).sum(dim=1) / total
        column = (mask.sum(dim=1) * self.grid).sum(dim=1) / total
        return torch.stack([row, column], dim=1)

    def keypoints(self, images: Tensor) -> Tensor:
        """Keypoints `[N, 2]` (row, column) in pixels from `images [N, 3, S, S]` in [0, 1]."""
        return self.centroid(self.motion_mask(images))

    def profiles(self, keypoints: Tensor) -> tuple[Tensor, Tensor]:
        """Row and column profile of the sprite, `[N, S]` each, in [0, 1].

        Pixel `i` is covered by `clamp((half_size - |i - keypoint|) / edge + 1/2, 0, 1)`: with an
        edge of one pixel this is the exact area coverage of a box.
        """
        distance = (self.grid - keypoints[..., None]).abs()
        profile = ((self.half_size[:, None] - distance) / self.edge[:, None] + 0.5).clamp(0, 1)
        return profile[..., 0, :], profile[..., 1, :]

    def sprite(self, keypoints: Tensor) -> Tensor:
        """Coverage of each pixel by the sprite, `[N, S, S]`, for keypoints `[N, 2]` in pixels."""
        row, column = self.profiles(keypoints)
        return row[..., :, None] * column[..., None, :]

    def tint(self, coverage: Tensor) -> Tensor:
        """What a coverage `[N, S, S]` adds to a frame, `[N, 3, S, S]`."""
        return self.colour[:, None, None] * coverage[:, None]

    def background(self, images: Tensor, keypoints: Tensor) -> Tensor:
        """Images `[N, 3, S, S]` with the sprite at `keypoints [N, 2]` (pixels) taken away."""
        return images - self.tint(self.sprite(keypoints))

    def loss(
        self, batch: Mapping[str, Tensor], generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """How well mask and sprite explain the difference of `scene` and `image`.

        Both are uint8 `[B, S, S, 3]`. The sprite's error also counts on average-pooled images:
        pixel by pixel, a sprite that is far from where it should be has no gradient.
        """
        count = batch["scene"].shape[0]
        images = to_unit(torch.cat([batch["scene"], batch["image"]]))
        mask = self.motion_mask(images)
        sprite = self.sprite(self.centroid(mask))
        difference = images[count:] - images[:count]
        unexplained = difference - self.tint(mask[count:] - mask[:count])
        mask_error = unexplained.square().sum(dim=(1, 2, 3)).mean()
        unexplained = difference - self.tint(sprite[count:] - sprite[:count])
        sprite_error = unexplained.square().sum(dim=(1, 2, 3)).mean()
        coarse_error = sum(
            F.avg_pool2d(unexplained, size).square().sum(dim=(1, 2, 3)).mean() * size**2
            for size in (4, 8, 16)
        )
        area = mask.sum(dim=(1, 2)).mean()
        # To begin with: a pixel that changed is covered in one frame or the other. This alone says
        # which of mask and background is which.
        changed = difference.norm(dim=1)
        changed = changed / changed.amax().clamp_min(1e-3)
        covered = mask[count:] + mask[:count]
        change_error = (covered - changed).square().sum(dim=(1, 2)).mean()
        late = min(1.0, max(0.0, (step - self.config.sprite_from) / 200.0))
        loss = (
            mask_error
            + (1.0 - late) * change_error
            + late * (sprite_error + coarse_error)
            + self.config.sparsity * area
        )
        parts = {"mask": mask_error, "sprite": sprite_error, "area": area}
        return loss, {name: value.detach() for name, value in parts.items()}
