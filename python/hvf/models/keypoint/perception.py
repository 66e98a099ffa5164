"""Where the moving part of an image is, learned without labels from pairs of frames.

Two frames of one episode differ only in what moved. A convolutional mask and a sprite each have to
explain that difference:

    image - scene  =  colour * (mask(image) - mask(scene))
    image - scene  =  colour * (sprite(keypoint(image)) - sprite(keypoint(scene)))

where the keypoint is the mask's centroid and the sprite is a soft box of learned size, so that the
keypoint becomes the position of what moves, to a few hundredths of a pixel.

Nothing tells the detector beforehand what it looks for: the sprite's colour starts at grey, the
mask's weights at random. What it can find is one box of one colour that moves before a floor of one
colour and still surroundings. How far that holds is measured, not assumed: `unexplained` is the
part of all changes that a trained detector leaves over, and `misfit` says of single images whether
they look like what it was trained on.

Letters in shapes: `N` frames, `S` image size.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from hvf.models.frames import to_unit
from hvf.models.unfamiliar import every, warn_of_unfamiliar

EXPECTED = "one box of one colour that moves before a still floor of one colour"
"""What this model takes for granted."""

_GREY = 0.2
"""What the sprite adds to each colour before training: it is brighter than the floor, or darker."""
_UNEXPLAINED = 0.1
"""Of the changes; a detector that leaves more of them over has not found what moves."""
_MISFIT = 0.3
"""Of mask and colour, at the bound. In 21,300 images of the maze at most 0.008, in images that the
paper's CVAE draws of it 0.2 on average; 0.5 to 30 in images of other agents and floors."""
_SIDES = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], np.float32)
"""The middle of the sprite, and what is beside it."""
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
        # Grey: no hint of what colour it is that moves.
        self.colour = nn.Parameter(torch.full((3,), _GREY))
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

    def find(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Keypoints `[N, 2]` and sprites `[N, S, S]` of `images [N, 3, S, S]` in [0, 1].

        Warns once if the images look unfamiliar; see :mod:`hvf.models.unfamiliar` for which of
        them count, and why it is a warning.
        """
        mask = self.motion_mask(images)
        keypoints = self.centroid(mask)
        sprite = self.sprite(keypoints)
        some = every(len(images))
        misfit = self.misfit(images[some], mask[some], keypoints[some], sprite[some])
        warn_of_unfamiliar(self, misfit, EXPECTED)
        return keypoints, sprite

    def misfit(
        self, images: Tensor, mask: Tensor, keypoints: Tensor, sprite: Tensor
    ) -> NDArray[np.float32]:
        """How badly mask and sprite explain single images, `[N]`: 1 and more is unfamiliar.

        The larger of two errors, over a bound that holds for any trained detector: how far the mask
        is from the sprite at its centroid (squared, as a part of the sprite), and how far what is
        there is from floor and colour. The floor is what is beside the sprite, on that one of its
        four sides which fits best: there may be walls on the others.

        In NumPy: this is asked at every step of a plan, and for few images torch is slower.

        Args:
            images: `[N, 3, S, S]` in [0, 1].
            mask: their masks, `[N, S, S]`.
            keypoints: their keypoints, `[N, 2]` in pixels.
            sprite: the sprites there, `[N, S, S]`.
        """
        reach = self.half_size + self.edge
        tensors = (images, mask, keypoints, sprite, reach, self.colour)
        image, seen, middle, drawn, beside, colour = (x.detach().cpu().numpy() for x in tensors)
        apart = seen - drawn
        shape = np.einsum("nij,nij->n", apart, apart)
        shape = shape / np.einsum("nij,nij->n", drawn, drawn).clip(1.0)
        at = np.rint(middle[:, None] + _SIDES * beside).clip(0, self.config.image_size - 1)
        row, column = at.astype(np.int64).transpose(2, 0, 1)
        there = image[np.arange(len(image))[:, None], :, row, column]
        wrong = there[:, :1] - there[:, 1:] - colour
        squared = np.einsum("nsc,nsc->ns", wrong, wrong).min(axis=1)
        colours = np.sqrt(squared / max(float(colour @ colour), 1e-6))
        misfit: NDArray[np.float32] = np.maximum(shape, colours) / _MISFIT
        return misfit

    def unexplained(self, pairs: Tensor) -> float:
        """Part of what differs between frames that the sprite does not explain, 0 to 1 and more.

        Args:
            pairs: two frames of an episode each, uint8 `[N, 2, S, S, 3]`.
        """
        images = to_unit(pairs.flatten(0, 1))
        left = self.background(images, self.keypoints(images))
        left = left.reshape(-1, 2, *left.shape[1:])
        frames = images.reshape(-1, 2, *images.shape[1:])
        return float(
            (left[:, 0] - left[:, 1]).square().sum()
            / (frames[:, 0] - frames[:, 1]).square().sum().clamp_min(1e-9)
        )

    def warn_of_unexplained(self, pairs: Tensor) -> float:
        """Measure :meth:`unexplained` at the end of training, and warn if it is more than a tenth.

        It is no error: a detector that was trained for a few steps, to see whether all runs, has
        not explained anything either.
        """
        with torch.inference_mode():
            unexplained = self.unexplained(pairs)
        if not unexplained <= _UNEXPLAINED:
            warnings.warn(
                f"perception: {unexplained:.0%} of what changes between frames is not explained "
                f"(at most {_UNEXPLAINED:.0%} expected). This model is for {EXPECTED}; where "
                "several things move, or what they look like varies, keypoints mean nothing: "
                "train a video model",
                UserWarning,
                stacklevel=2,
            )
        return unexplained

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
