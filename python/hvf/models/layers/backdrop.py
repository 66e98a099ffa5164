"""What is behind everything: the scene without arm and cubes, for every place of what slides.

A slider (a door, a drawer) is a fixture with one degree of freedom: how much is seen of it, and
where, lies on a curve. Its coordinate is the first principal component of these three numbers,
from 0 to 1. Of all fixtures, sliders are those whose component differs most between episodes, set
against how much it changes from one frame to the next: what only the arm hides does the opposite.

The backdrop is a table of images over the sliders' coordinates. Each is the median, pixel by
pixel, over the frames with the sliders near that place; arm and cubes are seldom at one pixel.

Letters in shapes: `N` frames, `S` image size, `P` parts, `G` sliders, `E` episodes, `T` frames of
an episode.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from hvf.models.layers.colours import Colours

# Frames of one cell of the table that are looked at.
_FRAMES = 400
# Sliders whose coordinates are correlated more than this are one thing.
_SAME = 0.5
# Part of all coordinates beyond either end: most of these are a slider half hidden by the arm.
_TAIL = 0.02
# A coordinate further out than this is no place to take a backdrop from.
_BEYOND = 0.02


@dataclass(frozen=True)
class BackdropConfig:
    """How finely the backdrop is known.

    Attributes:
        bins: places of each slider, the most conspicuous slider first; as many as sliders.
    """

    bins: tuple[int, int] = (40, 8)

    def __post_init__(self) -> None:
        if min(self.bins) < 2:
            raise ValueError(f"bins must be at least 2, got {self.bins}")


class Backdrop(nn.Module):
    """Coordinates of sliders, and what is behind; see the module's documentation.

    Attributes:
        part: number of each slider's coloured part, int64 `[G]`.
        axis: direction and offset that give the coordinate: `[G, 3]` and `[G]`.
        table: images uint8 `[bins..., 3, S, S]`.
    """

    part: Tensor
    axis: Tensor
    offset: Tensor
    table: Tensor

    def __init__(self, config: BackdropConfig, image_size: int) -> None:
        super().__init__()
        self.config = config
        sliders = len(config.bins)
        self.register_buffer("part", torch.zeros(sliders, dtype=torch.int64))
        self.register_buffer("axis", torch.zeros(sliders, 3))
        self.register_buffer("offset", torch.zeros(sliders))
        shape = (*config.bins, 3, image_size, image_size)
        self.register_buffer("table", torch.zeros(shape, dtype=torch.uint8))

    def forward(self, observed: Tensor) -> Tensor:
        """Coordinates of the sliders `[N, G]`, of what :class:`Colours` sees, `[N, P, 3]`.

        They are from 0 to 1, but for sliders that are half hidden.
        """
        return (observed[:, self.part] * self.axis).sum(dim=2) + self.offset

    def fit_sliders(self, observed: Tensor, colours: Colours) -> Backdrop:
        """Find the sliders.

        Args:
            observed: what :class:`Colours` sees, `[E, T, P, 3]`.
            colours: the parts.

        Raises:
            ValueError: fewer fixtures than sliders move, or episodes of a single frame.
        """
        if observed.shape[1] < 2:
            raise ValueError("frames: to find what slides, 2 of an episode are needed, got 1")
        found = []
        for part in (~colours.roams).nonzero()[:, 0].tolist():
            seen = observed[:, :, part].double()
            # Mass as a length: as many pixels as the part is long.
            scale = torch.tensor([float(colours.full[part]) ** 0.5, 1.0, 1.0]).double()
            mean = seen.mean(dim=(0, 1))
            centred = ((seen - mean) * scale).flatten(0, 1)
            direction = torch.linalg.eigh(centred.T @ centred).eigenvectors[:, -1]
            coordinate = (centred @ direction).reshape(seen.shape[:2])
            # A sign of its own, whatever the linear algebra chose.
            if direction[direction.abs().argmax()] < 0:
                direction, coordinate = -direction, -coordinate
            jitter = coordinate.diff(dim=1).square().mean()
            score = float(coordinate.mean(dim=1).var() / jitter.clamp_min(1e-9))
            found.append((score, part, direction * scale, mean, coordinate.flatten()))
        found.sort(key=lambda one: -one[0])
        chosen: list[tuple[float, int, Tensor, Tensor, Tensor]] = []
        for one in found:
            pairs = [torch.stack([one[4], other[4]]) for other in chosen]
            if all(float(torch.corrcoef(pair)[0, 1].abs()) < _SAME for pair in pairs):
                chosen.append(one)
        if len(chosen) < len(self.part):
            raise ValueError(
                f"frames: {len(chosen)} things slide, expected {len(self.part)}: this model takes "
                "a fixed number of coloured things that slide for granted"
            )
        for i, (_, part, direction, mean, coordinate) in enumerate(chosen[: len(self.part)]):
            places = coordinate.float()[:1_000_000]
            low, high = places.quantile(_TAIL), places.quantile(1 - _TAIL)
            span = (high - low).double().clamp_min(1e-6)
            self.part[i] = part
            self.axis[i] = direction / span
            self.offset[i] = -((mean * direction).sum() + low) / span
        return self

    def fit_table(self, frames: Tensor, coordinates: Tensor, hidden: Tensor) -> Backdrop:
        """Take the medians.

        Args:
            frames: uint8 `[N, S, S, 3]`.
            coordinates: of the sliders in them, `[N, G]`.
            hidden: pixels that are not the backdrop's for certain, bool `[N, S, S]`.

        Raises:
            ValueError: no frame.
        """
        sure = ((coordinates - 0.5).abs() < 0.5 + _BEYOND).all(dim=1)
        frames, coordinates, hidden = frames[sure], coordinates[sure].clamp(0, 1), hidden[sure]
        if not len(frames):
            raise ValueError("frames: none to take a backdrop from")
        first, second = self.config.bins
        cell = (coordinates * (coordinates.new_tensor(self.config.bins) - 1)).round().long()
        number = cell[:, 0] * second + cell[:, 1]
        flat = self.table.flatten(0, 1)
        whole = _median(frames[:: max(1, len(frames) // _FRAMES)], None)
        filled = torch.zeros(len(flat), dtype=torch.bool)
        for k in range(len(flat)):
            these = (number == k).nonzero()[:, 0]
            if not len(these):
                continue
            these = these[:: max(1, len(these) // _FRAMES)]
            flat[k] = _median(frames[these], hidden[these], whole).permute(2, 0, 1)
            filled[k] = True
        places = torch.cartesian_prod(torch.arange(first), torch.arange(second)).float()
        known = filled.nonzero()[:, 0]
        nearest = torch.cdist(places, places[known]).argmin(dim=1)
        self.table.copy_(flat[known[nearest]].reshape(self.table.shape))
        return self

    def draw(self, coordinates: Tensor) -> Tensor:
        """Images `[N, 3, S, S]` in [0, 1] of sliders at `coordinates [N, G]`."""
        low, share = self.corners(coordinates)
        image = coordinates.new_zeros(len(coordinates), *self.table.shape[2:])
        for i in (0, 1):
            for j in (0, 1):
                weight = (1 - i - share[:, 0]).abs() * (1 - j - share[:, 1]).abs()
                image += weight[:, None, None, None] * self.table[low[:, 0] + i, low[:, 1] + j]
        return image / 255

    def corners(self, coordinates: Tensor) -> tuple[Tensor, Tensor]:
        """Lower corner of the table's cell, int64 `[N, G]`, and how far beyond it, 0 to 1."""
        bins = torch.tensor(self.config.bins, device=coordinates.device)
        place = coordinates.clamp(0, 1) * (bins - 1)
        low = torch.minimum(place.floor().long(), bins - 2)
        return low, place - low


def _median(frames: Tensor, hidden: Tensor | None, otherwise: Tensor | None = None) -> Tensor:
    """Median of uint8 `frames [N, S, S, 3]` without what is hidden: `[S, S, 3]`."""
    values = frames.float()
    if hidden is None or otherwise is None:
        return values.quantile(0.5, dim=0, interpolation="lower").to(torch.uint8)
    values[hidden] = torch.nan
    median = values.nanmedian(dim=0).values
    return torch.where(median.isnan(), otherwise.float(), median).to(torch.uint8)
