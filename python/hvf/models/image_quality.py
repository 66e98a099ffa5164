"""How like a true image a predicted one is: PSNR, SSIM, and a learned measure (ST-LPIPS).

The learned one is shift-tolerant LPIPS (Ghildyal & Liu, ECCV 2022), the only one of its kind whose
network comes inside its package. It is optional: ``pip install "hvf[metrics]"``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

Measure: TypeAlias = Callable[[NDArray[np.uint8], NDArray[np.uint8]], NDArray[np.float64]]
"""Of images uint8 ``[..., S, S, 3]``, predicted and true: ``[...]``."""

_AT_ONCE = 64


def psnr(guess: NDArray[Any], truth: NDArray[Any]) -> NDArray[np.float64]:
    """Peak signal-to-noise ratio, dB, of images `[..., S, S, 3]` from 0 to 255, at most 60."""
    squared = ((guess.astype(np.float64) - truth) / 255) ** 2
    result: NDArray[np.float64] = -10 * np.log10(squared.mean(axis=(-1, -2, -3)).clip(1e-6))
    return result


def image_psnr(guess: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Peak signal-to-noise ratio, dB, of images float `[N, 3, S, S]` in [0, 1], at most 90: `[N]`.

    For training, where images are not yet bytes; published figures are those of :func:`psnr`.
    """
    squared = (guess - truth).square().mean(dim=(1, 2, 3))
    return -10 * squared.clamp_min(1e-9).log10()


def ssim(guess: NDArray[np.uint8], truth: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Structural similarity of images uint8 `[..., S, S, 3]` (Wang et al., 2004): `[...]`.

    Gaussian window of 11 pixels, standard deviation 1.5; colours one by one, mean over all.
    """
    line = torch.exp(-0.5 * (torch.arange(11, dtype=torch.float64) - 5).square() / 1.5**2)
    line = line / line.sum()
    shape = guess.shape[:-3]

    def planes(images: NDArray[np.uint8]) -> torch.Tensor:
        tensor = torch.from_numpy(np.ascontiguousarray(images)).double() / 255
        return tensor.reshape(-1, *images.shape[-3:]).permute(0, 3, 1, 2).flatten(0, 1)[:, None]

    def smooth(x: torch.Tensor) -> torch.Tensor:
        return F.conv2d(F.conv2d(x, line[None, None, :, None]), line[None, None, None, :])

    a, b = planes(guess), planes(truth)
    mean_a, mean_b = smooth(a), smooth(b)
    variance_a, variance_b = smooth(a * a) - mean_a**2, smooth(b * b) - mean_b**2
    covariance = smooth(a * b) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    alike = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    alike = alike / ((mean_a**2 + mean_b**2 + c1) * (variance_a + variance_b + c2))
    result: NDArray[np.float64] = alike.mean(dim=(1, 2, 3)).reshape(*shape, 3).mean(dim=-1).numpy()
    return result


def perceptual_distance() -> Measure:
    """Load ST-LPIPS, 0 for equal images.

    Raises:
        ModuleNotFoundError: it is not installed; says how to.
    """
    try:
        from stlpips_pytorch import stlpips
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"ST-LPIPS needs {error.name}: pip install 'hvf[metrics]'", name=error.name
        ) from error
    network = stlpips.LPIPS(net="alex", variant="shift_tolerant", verbose=False)

    def planes(images: NDArray[np.uint8]) -> torch.Tensor:
        tensor = torch.from_numpy(np.ascontiguousarray(images))
        return tensor.reshape(-1, *images.shape[-3:]).permute(0, 3, 1, 2) / 127.5 - 1

    def distance(guess: NDArray[np.uint8], truth: NDArray[np.uint8]) -> NDArray[np.float64]:
        parts = (torch.split(planes(images), _AT_ONCE) for images in (guess, truth))
        with torch.inference_mode():
            apart = torch.cat([network(a, b).flatten() for a, b in zip(*parts, strict=True)])
        result: NDArray[np.float64] = apart.double().numpy().reshape(guess.shape[:-3])
        return result

    return distance
