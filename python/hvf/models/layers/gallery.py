"""What the arm looks like: a gallery of its images on a grid of hand positions.

A thin thing that moves is not a sum of a few images, so it is not drawn by a network but looked up.
Each image of the gallery is the mean of what is seen of the arm in frames whose hand is near that
place of the grid, and between places images are interpolated. Images are stored as square patches,
since most of an image is empty.

Letters in shapes: `N` frames, `S` image size, `A` = 3 action dimensions, `V` places of the grid,
`M` patches, `w` patch size.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

# Less mean opacity than this is the noise of other edges.
_NOISE = 0.15
_TAIL = 0.003
# Where the hand's code does not vary, all places but the first are beyond it.
_LEAST_STEP = 1e-3
# Frames that a place needs for an image of its own; weights of frames in between count in part.
_ENOUGH = 1.0


@dataclass(frozen=True)
class GalleryConfig:
    """How finely the arm's images are known.

    Attributes:
        places: of the grid, for each dimension of the hand's code.
        patch: pixels on each side of a patch, `w`.
        patches: patches that are kept, `M`; those with most of the arm, if there are more.
    """

    places: tuple[int, int, int] = (18, 43, 5)
    patch: int = 8
    patches: int = 30_000

    def __post_init__(self) -> None:
        if min(self.places) < 2:
            raise ValueError(f"places must be at least 2, got {self.places}")
        if self.patch < 1:
            raise ValueError(f"patch must be at least 1, got {self.patch}")
        if not 1 <= self.patches < 2**15:
            raise ValueError(f"patches must be from 1 to {2**15 - 1}, got {self.patches}")


class Gallery(nn.Module):
    """Images of the arm; see the module's documentation.

    Attributes:
        low, step: the hand's code at the first place of the grid, and from one place to the next,
            `[A]`.
        patches: opacity and colour times opacity, uint8 `[M, 4, w, w]`; the first is empty.
        index: number of the patch at each square of each place's image, int16
            `[V, (S / w)^2]`, rows first.
    """

    low: Tensor
    step: Tensor
    patches: Tensor
    index: Tensor

    def __init__(self, config: GalleryConfig, image_size: int) -> None:
        super().__init__()
        if image_size % config.patch:
            raise ValueError(f"image_size must be a multiple of {config.patch}, got {image_size}")
        self.config = config
        self.image_size = image_size
        first, second, third = config.places
        squares = (image_size // config.patch) ** 2
        self.register_buffer("low", -torch.ones(3))
        self.register_buffer("step", torch.ones(3))
        shape = (config.patches, 4, config.patch, config.patch)
        self.register_buffer("patches", torch.zeros(shape, dtype=torch.uint8))
        self.register_buffer("index", torch.zeros(first * second * third, squares).short())

    def fit_grid(self, codes: Tensor) -> Gallery:
        """Lay the grid over `codes [N, 3]` of the hand."""
        tails = torch.tensor([_TAIL, 1 - _TAIL])
        low, high = codes.quantile(tails, dim=0)
        self.low.copy_(low)
        step = (high - low) / (torch.tensor(self.config.places) - 1)
        self.step.copy_(step.clamp_min(_LEAST_STEP))
        return self

    def fit(self, seen: Iterable[tuple[Tensor, Tensor, Tensor, Tensor]]) -> Gallery:
        """Take the mean images.

        Args:
            seen: of frames, a few at a time: codes of the hand `[n, 3]`, opacity `[n, S, S]`,
                images `[n, 3, S, S]`, and where neither can be trusted, bool `[n, S, S]`.
        """
        count, size = len(self.index), self.image_size
        sums, weights = torch.zeros(count, 4, size, size), torch.zeros(count, size, size)
        frames = torch.zeros(count)
        for codes, opacity, images, hidden in seen:
            arm = torch.cat([opacity[:, None], images * opacity[:, None]], dim=1)
            free = (~hidden).float()
            for place, share in self.corners(codes):
                sums.index_add_(
                    0, place, arm * (share[:, None] * free.flatten(1)).reshape(-1, 1, size, size)
                )
                weights.index_add_(0, place, free * share[:, None, None])
                frames.index_add_(0, place, share)
        means = sums / weights.clamp_min(1e-3)[:, None]
        clean = ((means[:, :1] - _NOISE) / (1 - _NOISE)).clamp_min(0)
        means = torch.cat([clean, means[:, 1:] * clean / means[:, :1].clamp_min(1e-3)], dim=1)
        self._store((means * 255).round().to(torch.uint8), frames >= _ENOUGH)
        return self

    def _store(self, images: Tensor, known: Tensor) -> None:
        """Cut `images [V, 4, S, S]` to patches; what is not known looks like the nearest place."""
        width, side = self.config.patch, self.image_size // self.config.patch
        cut = images.reshape(len(images), 4, side, width, side, width).permute(0, 2, 4, 1, 3, 5)
        flat = cut.reshape(-1, 4, width, width)
        amount = flat[:, 0].sum(dim=(1, 2), dtype=torch.int64)
        amount *= known.repeat_interleave(side * side)
        kept = amount.argsort(descending=True, stable=True)[: self.config.patches - 1]
        kept = kept[amount[kept] > 0]
        self.patches.zero_()
        self.patches[1 : len(kept) + 1] = flat[kept]
        number = torch.zeros(len(flat), dtype=torch.int16)
        number[kept] = torch.arange(1, len(kept) + 1, dtype=torch.int16)
        index = number.reshape(len(images), -1)
        axes = [torch.arange(n).float() for n in self.config.places]
        grid = torch.cartesian_prod(*axes)
        for some in torch.split((~known).nonzero()[:, 0], 1024):
            nearest = torch.cdist(grid[some], grid[known]).argmin(dim=1)
            index[some] = index[known][nearest]
        self.index.copy_(index)

    def corners(self, codes: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Places around `codes [N, 3]`: eight times their numbers and shares, `[N]` each."""
        places = torch.tensor(self.config.places, device=codes.device)
        where = ((codes - self.low) / self.step).clamp_min(0)
        where = torch.minimum(where, (places - 1).to(where.dtype))
        lower = torch.minimum(where.floor().long(), places - 2)
        beyond = where - lower
        found = []
        for corner in itertools.product((0, 1), repeat=3):
            each = lower + torch.tensor(corner, device=codes.device)
            share = torch.ones_like(beyond[:, 0])
            for axis, at in enumerate(corner):
                share = share * (beyond[:, axis] if at else 1 - beyond[:, axis])
            number = (each[:, 0] * places[1] + each[:, 1]) * places[2] + each[:, 2]
            found.append((number, share))
        return found

    def forward(self, codes: Tensor) -> tuple[Tensor, Tensor]:
        """Opacity `[N, 1, S, S]` and colour times opacity `[N, 3, S, S]` of hands at `codes`."""
        width, side = self.config.patch, self.image_size // self.config.patch
        cells = codes.new_zeros(len(codes), side * side, 4, width, width)
        for place, share in self.corners(codes):
            cells += (
                self.patches[self.index[place].long()] * (share / 255)[:, None, None, None, None]
            )
        cells = cells.reshape(-1, side, side, 4, width, width).permute(0, 3, 1, 4, 2, 5)
        drawn = cells.reshape(-1, 4, self.image_size, self.image_size)
        return drawn[:, :1], drawn[:, 1:]
