"""A short code of a scene: whitened principal components of what does not move.

(A code that a network learned end to end collapsed to a constant: what depends on it is rare.)
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

_POOL = 2


class SceneCode(nn.Module):
    """Linear code of scene maps.

    Args:
        image_size: height and width of the maps, `S` (even).
        dim: length of the code, `E`.
    """

    mean: Tensor
    basis: Tensor

    def __init__(self, image_size: int, dim: int) -> None:
        super().__init__()
        pixels = (image_size // _POOL) ** 2
        self.register_buffer("mean", torch.zeros(pixels))
        self.register_buffer("basis", torch.zeros(pixels, dim))

    def fit(self, maps: Tensor) -> SceneCode:
        """Take the principal components of `maps [N, S, S]`.

        Components of the pixels' noise (the smallest ones) are not blown up.
        """
        pooled = self._pooled(maps).double()
        mean = pooled.mean(dim=0)
        centred = pooled - mean
        variance, basis = torch.linalg.eigh(centred.T @ centred / len(pooled))
        count = self.basis.shape[1]
        variance, basis = variance[-count:].flip(0), basis[:, -count:].flip(1)
        self.mean.copy_(mean)
        self.basis.copy_(basis * (variance + 1e-3 * variance[0]).rsqrt())
        return self

    def forward(self, maps: Tensor) -> Tensor:
        """Codes `[N, E]` of `maps [N, S, S]`."""
        return (self._pooled(maps) - self.mean) @ self.basis

    @staticmethod
    def _pooled(maps: Tensor) -> Tensor:
        return F.avg_pool2d(maps[:, None], _POOL).flatten(1)
