"""Frames as bytes and images as floats: the one place where one becomes the other."""

from __future__ import annotations

import torch


def to_unit(frames: torch.Tensor) -> torch.Tensor:
    """Frames uint8 ``[B, H, W, 3]`` as float ``[B, 3, H, W]`` in [0, 1], channels last."""
    return frames.permute(0, 3, 1, 2).float() / 255


def to_frames(images: torch.Tensor) -> torch.Tensor:
    """Images float ``[B, 3, H, W]`` in [0, 1] as frames uint8 ``[B, H, W, 3]``."""
    return (images.permute(0, 2, 3, 1) * 255).round().clamp(0, 255).to(torch.uint8).contiguous()


def mean_image(frames: torch.Tensor, image_size: tuple[int, int]) -> torch.Tensor:
    """Mean of ``frames``, uint8 ``[N, H, W, 3]``, as an image float64 ``[3, H, W]`` in [0, 1].

    Raises:
        ValueError: no frames, or of another size than ``image_size``, (H, W).
        TypeError: another dtype.
    """
    if frames.dtype != torch.uint8:
        raise TypeError(f"frames must be uint8, got {frames.dtype}")
    if frames.ndim != 4 or frames.shape[1:] != (*image_size, 3) or not len(frames):
        raise ValueError(
            f"frames must be [N, {image_size[0]}, {image_size[1]}, 3], got {tuple(frames.shape)}"
        )
    total = torch.zeros(frames.shape[1:], dtype=torch.float64)
    for first in range(0, len(frames), 256):
        total += frames[first : first + 256].sum(0, dtype=torch.float64)
    return (total / len(frames) / 255).permute(2, 0, 1)
