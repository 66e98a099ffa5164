"""The parts of the spatial latent model: what sees, what moves, what draws."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from hvf.models.convolutions import encoder_of, fully_connected


class Encoder(nn.Module):
    """Convolutions that halve an image again and again, and a residual block on the smallest grid.

    Args:
        widths: channels of each convolution.
    """

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        self.levels = nn.ModuleList(
            encoder_of((after,), (2,), "same", inputs=before, activate_final=True)
            for before, after in pairwise((3, *widths))
        )
        last = widths[-1]
        self.block = encoder_of((last, last), (1, 1), "same", inputs=last)

    def forward(self, images: Tensor) -> list[Tensor]:
        """Features of ``images [N, 3, H, W]``, from the largest grid to the smallest."""
        features = [images - 0.5]
        for level in self.levels:
            features.append(level(features[-1]))
        features[-1] = features[-1] + self.block(features[-1])
        return features[1:]


class KnowingBlock(nn.Module):
    """A residual block of two 3x3 convolutions, between which features are scaled and shifted.

    Args:
        width: features of a cell.
        known: numbers by which they are, linearly.
    """

    def __init__(self, width: int, known: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)
        self.acted = nn.Linear(known, 2 * width)

    def forward(self, hidden: Tensor, known: Tensor) -> Tensor:
        """``hidden [N, width, h, w]`` with what is ``known [N, known]``, of the same shape."""
        gain, shift = self.acted(known)[:, :, None, None].chunk(2, dim=1)
        between = F.relu(self.first(hidden) * (1 + gain) + shift)
        return F.relu(hidden + self.second(between))


class Dynamics(nn.Module):
    """What an action adds to a grid of features.

    Two ways lead from cell to cell. What is near acts on what is near, everywhere in the same
    manner: convolutions. And some things go far in one step, such as an arm that one action swings
    through the whole image: a small network is told the action and, by a few features of each
    cell, the whole grid. What it makes of them scales and shifts the convolutions' features, and
    is painted on the grid before them.

    Args:
        width: features of a cell.
        grid: height and width, cells.
        actions: numbers of an action.
        blocks: residual blocks.
        known: units of the small network.
    """

    def __init__(
        self, width: int, grid: tuple[int, int], actions: int, blocks: int, known: int
    ) -> None:
        super().__init__()
        few, cells = max(1, width // 4), grid[0] * grid[1]
        self.squeeze = nn.Conv2d(width, few, 1)
        self.known = fully_connected(few * cells + actions, known, known)
        self.paint = nn.Linear(known, cells * width)
        self.input = nn.Conv2d(width, width, 1)
        self.blocks = nn.ModuleList(KnowingBlock(width, known) for _ in range(blocks))
        self.output = nn.Conv2d(width, width, 1)

    def forward(self, grid: Tensor, units: Tensor) -> Tensor:
        """The change of ``grid [N, width, h, w]`` by actions ``units [N, A]``, from -1 to 1."""
        count, width, height, across = grid.shape
        seen = self.squeeze(grid).flatten(1)
        known = F.relu(self.known(torch.cat([units, seen], dim=1)))
        painted = self.paint(known).reshape(count, height, across, width).permute(0, 3, 1, 2)
        hidden = F.relu(self.input(grid) + painted)
        for block in self.blocks:
            hidden = block(hidden, known)
        change: Tensor = self.output(hidden)
        return change

    def quiet(self) -> Iterator[nn.Conv2d | nn.Linear]:
        """The layers whose output is added to what was there."""
        yield self.output
        for block in self.blocks:
            assert isinstance(block, KnowingBlock)
            yield from (block.second, block.acted)


class Decoder(nn.Module):
    """Draws a grid of features over the frame that the rollout began with.

    From grid to grid it doubles the size (sub-pixel convolution, Shi et al., 2016), and adds what
    was seen of the first frame at that size (:meth:`seen`, the same for all that is drawn of one
    start). At last it gives colours, and a mask: what part of each pixel is drawn, where the rest
    is the first frame's.

    Args:
        widths: of the encoder.
    """

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        self.first = nn.Conv2d(widths[-1], widths[-1], 3, padding=1)
        self.larger = nn.ModuleList(
            nn.Conv2d(before, 4 * after, 1) for before, after in pairwise(widths[::-1])
        )
        self.here = nn.ModuleList(nn.Conv2d(width, width, 3, padding=1) for width in widths[-2::-1])
        self.skips = nn.ModuleList(nn.Conv2d(width, width, 1) for width in widths[::-1])
        self.last = nn.Conv2d(widths[0], 4 * 4, 3, padding=1)

    def seen(self, features: Sequence[Tensor]) -> list[Tensor]:
        """What is added at each size, from the smallest, of the first frame's features."""
        pairs = zip(self.skips, reversed(features), strict=True)
        return [skip(feature) for skip, feature in pairs]

    def forward(self, grid: Tensor, seen: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Colours ``[N, 3, H, W]`` and logits of the mask ``[N, 1, H, W]``.

        Args:
            grid: what to draw, ``[N, widths[-1], h, w]``.
            seen: from :meth:`seen`.
        """
        hidden = F.relu(self.first(grid) + seen[0])
        for larger, here, skip in zip(self.larger, self.here, seen[1:], strict=True):
            hidden = F.relu(F.pixel_shuffle(larger(hidden), 2) + skip)
            hidden = F.relu(hidden + here(hidden))
        drawn = F.pixel_shuffle(self.last(hidden), 2)
        return drawn[:, :3], drawn[:, 3:]
