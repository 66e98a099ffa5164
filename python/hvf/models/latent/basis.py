"""What the latent model sees of a frame: principal components of the blurred, reduced frame.

Planning compares frames through a blur, which gives the cost a slope where an object does not yet
overlap its goal. A blurred frame is smooth: averages over cells of a few pixels keep nearly all of
it, and far fewer principal components than it has pixels keep nearly all of these. The components
are orthonormal, so that the squared distance of two reduced frames is that of their coefficients,
plus what lies outside the components, which for a goal is a constant.

Letters in shapes: ``N`` frames of ``H x W`` pixels, ``P`` numbers of a reduced frame (three to a
cell), ``Z`` components.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor, nn

from hvf.blur import blur_matrix
from hvf.models.latent.config import LatentConfig

# Coefficients are divided by a power of their standard deviation: 1 would blow noise up until it
# is as loud as the scene, 0 would leave the network to find out that small ones matter too.
_EQUALISING = 0.5


class BlurredBasis(nn.Module):
    """From frames to scaled coefficients, and back to reduced frames.

    A coefficient is scaled so that those of the training data have comparable sizes; ``scale``
    takes that back: ``coefficients * scale`` are distances in reduced frames.
    """

    rows: Tensor
    columns: Tensor
    mean: Tensor
    components: Tensor
    scale: Tensor
    variance: Tensor

    def __init__(self, config: LatentConfig) -> None:
        super().__init__()
        height, width = config.image_size
        self.grid = config.grid
        numbers = 3 * config.cells
        self.register_buffer("rows", _reduction(height, config.blur, config.cell))
        self.register_buffer("columns", _reduction(width, config.blur, config.cell))
        self.register_buffer("mean", torch.zeros(numbers))
        self.register_buffer("components", torch.eye(numbers)[:, : config.components].contiguous())
        self.register_buffer("scale", torch.ones(config.components))
        self.register_buffer("variance", torch.ones(()))

    def reduced(self, images: Tensor) -> Tensor:
        """Reduced frames ``[N, P]`` of ``images [N, 3, H, W]`` in [0, 1]."""
        return (self.rows @ images @ self.columns.T).flatten(1)

    def fit(self, parts: Iterable[Tensor]) -> BlurredBasis:
        """Take mean and principal components of images, float ``[N, 3, H, W]`` a part.

        Raises:
            ValueError: no images, or all the same.
        """
        count, numbers = 0, len(self.mean)
        total = torch.zeros(numbers, dtype=torch.float64, device=self.mean.device)
        products = torch.zeros(numbers, numbers, dtype=torch.float64, device=self.mean.device)
        first: Tensor | None = None
        for images in parts:
            reduced = self.reduced(images).double()
            # Differences to any one frame: less is lost in the subtraction below.
            first = reduced[0] if first is None else first
            reduced = reduced - first
            count += len(reduced)
            total += reduced.sum(0)
            products += reduced.T @ reduced
        if first is None:
            raise ValueError("images: there are none to take components of")
        mean = total / count
        variance, basis = torch.linalg.eigh(products / count - mean[:, None] * mean)
        kept = self.components.shape[1]
        whole = variance.clamp_min(0).sum()
        if whole < 1e-12:
            raise ValueError("images: all are the same")
        variance, basis = variance[-kept:].flip(0), basis[:, -kept:].flip(1)
        # The sign of an eigenvector means nothing; the same one on every machine.
        biggest = basis.gather(0, basis.abs().argmax(0, keepdim=True))
        deviation = variance.clamp_min(1e-6 * float(variance[0])).sqrt()
        scale = deviation**_EQUALISING
        self.mean.copy_(mean + first)
        self.components.copy_(basis * biggest.sign())
        # So that scaled coefficients have a mean square of 1.
        self.scale.copy_(scale * ((deviation / scale).square().mean()).sqrt())
        self.variance.copy_(whole)
        return self

    def forward(self, images: Tensor) -> Tensor:
        """Scaled coefficients ``[N, Z]`` of ``images [N, 3, H, W]`` in [0, 1]."""
        scaled: Tensor = ((self.reduced(images) - self.mean) @ self.components) / self.scale
        return scaled

    def outside(self, images: Tensor) -> Tensor:
        """Squared distance of reduced frames from what the components can show, ``[N]``."""
        centred = self.reduced(images) - self.mean
        shown = (centred @ self.components).square().sum(1)
        return (centred.square().sum(1) - shown).clamp_min(0)

    def frames(self, coefficients: Tensor) -> Tensor:
        """Reduced frames ``[N, 3, *grid]`` of scaled ``coefficients [N, Z]``."""
        flat = (coefficients * self.scale) @ self.components.T + self.mean
        return flat.reshape(len(flat), 3, *self.grid)

    def error(self, found: Tensor, truth: Tensor) -> Tensor:
        """Squared distances of reduced frames, as a part of the data's variance: ``[...]``.

        Args:
            found: scaled coefficients ``[..., Z]``.
            truth: scaled coefficients ``[..., Z]``.
        """
        weights = self.scale.square() / self.variance
        return ((found - truth).square() * weights).sum(-1)


def _reduction(size: int, blur: float, cell: int) -> Tensor:
    """Blur along an axis, as the planner's, then means of cells: ``[G, size]``.

    The last cell is smaller where the size is no multiple of it.
    """
    blurred = blur_matrix(size, blur) if blur > 0 else np.eye(size)
    cells = [blurred[i : i + cell].mean(0) for i in range(0, size, cell)]
    return torch.from_numpy(np.stack(cells)).float()
