"""The planner's pixel cost in torch, for images that a model on any device has drawn.

The numbers are those of :func:`hvf_core.image_cost`: squared L2 distance of colours in [0, 1],
summed over pixels and colours and divided by the number of pixels (paper, section 3), after a
Gaussian blur that is ``scipy.ndimage.gaussian_filter``'s.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hvf.blur import blur_matrix
from hvf.settings import check_blur


class PixelCost:
    """How far images are from each other.

    Args:
        height: of the images, pixels.
        width: of the images, pixels.
        blur: standard deviation of the Gaussian blur, pixels; 0 for none.
        device: where the images are.
    """

    def __init__(self, height: int, width: int, blur: float, device: torch.device) -> None:
        check_blur("blur", blur)
        self._pixels = height * width
        self._matrices: tuple[Tensor, Tensor] | None = None
        if blur > 1e-15:  # as in SciPy, which leaves an axis alone below
            down, across = (torch.from_numpy(blur_matrix(n, blur)) for n in (height, width))
            self._matrices = (down.float().to(device), across.float().T.contiguous().to(device))

    def features(self, images: Tensor) -> Tensor:
        """What is compared: images float ``[N, 3, H, W]`` in [0, 1], blurred, of the same shape."""
        images = images.float()
        if self._matrices is None:
            return images.contiguous()
        down, across = self._matrices
        return down @ images.contiguous() @ across

    def between(self, features: Tensor, aims: Tensor) -> Tensor:
        """Costs ``[N]`` of ``features [N, 3, H, W]`` to those of goals, ``[N or 1, 3, H, W]``."""
        return (features - aims).square().flatten(1).sum(dim=1) / self._pixels
