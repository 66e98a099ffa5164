"""Frames as bytes and images as floats: the one place where one becomes the other."""

from __future__ import annotations

import torch


def to_unit(frames: torch.Tensor) -> torch.Tensor:
    """Frames uint8 ``[B, H, W, 3]`` as float ``[B, 3, H, W]`` in [0, 1], channels last."""
    return frames.permute(0, 3, 1, 2).float() / 255


def to_frames(images: torch.Tensor) -> torch.Tensor:
    """Images float ``[B, 3, H, W]`` in [0, 1] as frames uint8 ``[B, H, W, 3]``."""
    return (images.permute(0, 2, 3, 1) * 255).round().clamp(0, 255).to(torch.uint8).contiguous()
