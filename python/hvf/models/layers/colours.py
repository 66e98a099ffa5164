"""Coloured parts of a scene: soft masks by colour, and where each part is.

Cubes, door and drawer differ in colour. The colours are found without labels: pixels that change
from one frame of an episode to another are clustered by chroma (colour without brightness). A mask
is then a softmax over one affine function of the pixel's colour for each cluster and one for grey,
and a part is described by how much of it is seen and where the middle of that is.

A part that is nowhere often roams (a cube); the others are fixtures (a door, its shaded side, the
table), and their masks count only where their colour is often seen.

A part is what has one colour: two cubes of the same colour would be one part, and a grey thing is
none. That is this model's prior knowledge of the desk.

Letters in shapes: `N` frames, `S` image size, `P` parts. Rows and columns are in pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

# Red, green, blue to chroma: an orthogonal plane across the axis of greys.
_CHROMA = ((1.0, 0.0), (-0.5, 3**0.5 / 2), (-0.5, -(3**0.5) / 2))
_ROUNDS = 60
_SAMPLE = 60_000
# Difference in 256 grey levels from which on a pixel has changed.
_CHANGED = 20
_AT_ONCE = 512
# Chroma that no colour has.
_NONE = 10.0
# A mask below this is the seam of two other colours; over a frame such pixels would add up.
_SEAM = 0.2
# Part of all frames in which a fixture's colour is seen where the fixture can be.
_OFTEN = 0.08
# A part that is seen somewhere in more than this part of all frames does not roam.
_FIXED = 0.4
# Nor does one of which this much less is seen than of the largest that does.
_THING = 0.5


@dataclass(frozen=True)
class ColoursConfig:
    """How parts are told apart.

    Attributes:
        image_size: height and width of the images, `S`, in pixels.
        parts: colours, `P`. More than there are things: a thing may have a shaded side.
        least_chroma: chroma (0 to 1) below which a pixel that changes is not clustered.
        width: how far, in chroma, from a cluster's centre a colour still counts.
    """

    image_size: int = 64
    parts: int = 8
    least_chroma: float = 0.12
    width: float = 0.06

    def __post_init__(self) -> None:
        if self.image_size < 16 or self.image_size % 16:
            raise ValueError(f"image_size must be a multiple of 16, got {self.image_size}")
        if self.parts < 1:
            raise ValueError(f"parts must be at least 1, got {self.parts}")
        for name in ("least_chroma", "width"):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(f"{name} must be between 0 and 1, got {getattr(self, name)}")


class Colours(nn.Module):
    """Masks and centres; see the module's documentation. Nothing here is trained by gradient.

    Attributes:
        colours: chroma of each part, `[P, 2]`.
        often: 1 where a part counts, `[P, S, S]`: everywhere, if it roams.
        roams: which parts roam, bool `[P]`.
        full: pixels of a part that is seen whole, `[P]`.
    """

    colours: Tensor
    often: Tensor
    roams: Tensor
    full: Tensor
    chroma_of: Tensor

    def __init__(self, config: ColoursConfig) -> None:
        super().__init__()
        self.config = config
        size, parts = config.image_size, config.parts
        self.register_buffer("colours", torch.zeros(parts, 2))
        self.register_buffer("often", torch.ones(parts, size, size))
        self.register_buffer("roams", torch.zeros(parts, dtype=torch.bool))
        self.register_buffer("full", torch.ones(parts))
        self.register_buffer("chroma_of", torch.tensor(_CHROMA), persistent=False)

    @property
    def roaming(self) -> list[int]:
        """Numbers of the parts that roam."""
        return [int(part) for part in self.roams.nonzero()[:, 0]]

    def fit(self, first: Tensor, second: Tensor, seed: int = 0) -> Colours:
        """Find the colours, and which of them roam.

        Args:
            first: frames uint8 `[N, S, S, 3]`.
            second: later frames of the same episodes.
            seed: of the clustering's start.

        Raises:
            ValueError: fewer coloured pixels change than there are parts.
        """
        changed = (first.int() - second.int()).abs().amax(dim=-1) > _CHANGED
        pixels = torch.cat([first[changed], second[changed]]).float() / 255
        chroma = pixels @ self.chroma_of
        chroma = chroma[chroma.norm(dim=1) > self.config.least_chroma]
        if len(chroma) < self.config.parts:
            raise ValueError("frames: too few coloured pixels change to find parts by")
        generator = torch.Generator().manual_seed(seed)
        chroma = chroma[torch.randperm(len(chroma), generator=generator)[:_SAMPLE]]
        centres = _clusters(chroma, self.config.parts, generator)
        # Seams of opposite colours have a mean that is grey, as much else is: it must match none.
        centres[centres.norm(dim=1) < self.config.least_chroma] = _NONE
        self.colours.copy_(centres)
        seen = torch.zeros_like(self.often)
        for frames in torch.split(first, _AT_ONCE):
            seen += self.masks(frames).sum(dim=0)
        seen /= len(first)
        seldom = seen.amax(dim=(1, 2)) < _FIXED
        # The seams of a part with what is behind it may have got a colour of their own.
        size = seen.sum(dim=(1, 2)) * seldom
        self.roams.copy_(seldom & (size > _THING * size.max()))
        self.often.copy_((seen > _OFTEN) | self.roams[:, None, None])
        mass = torch.cat([self(frames)[..., 0] for frames in torch.split(first, _AT_ONCE)])
        self.full.copy_((mass.quantile(0.75, dim=0) * self.full).clamp_min(1.0))
        return self

    def masks(self, frames: Tensor) -> Tensor:
        """Masks `[N, P, S, S]` in [0, 1] of uint8 `frames [N, S, S, 3]`, by colour alone."""
        # The squared distance to a cluster, but for what is common to all of them, is affine.
        centres = torch.cat([self.colours.new_zeros(1, 2), self.colours])
        scale = 2.0 / self.config.width**2
        weight = scale * centres @ self.chroma_of.T / 255
        bias = -0.5 * scale * centres.square().sum(dim=1)
        image = frames.permute(0, 3, 1, 2).float().contiguous()
        return F.conv2d(image, weight[:, :, None, None], bias).softmax(dim=1)[:, 1:]

    def forward(self, frames: Tensor, masks: Tensor | None = None) -> Tensor:
        """Mass (1 is all of it), row and column of each part: `[N, P, 3]`.

        Row and column of what is not seen are those of the image's middle.

        Args:
            frames: uint8 `[N, S, S, 3]`.
            masks: their masks `[N, P, S, S]`, where they are known.
        """
        found = self.masks(frames) if masks is None else masks
        found = F.relu(found - _SEAM) / (1 - _SEAM) * self.often
        line = torch.arange(self.config.image_size, dtype=torch.float32, device=found.device)
        rows, columns = found.sum(dim=3), found.sum(dim=2)
        mass = rows.sum(dim=2)
        middle = 0.5 * (self.config.image_size - 1)
        row = (rows @ line + 1e-3 * middle) / (mass + 1e-3)
        column = (columns @ line + 1e-3 * middle) / (mass + 1e-3)
        return torch.stack([mass / self.full, row, column], dim=2)


def _clusters(points: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Centres `[count, 2]` of `points [N, 2]`: k-means from far-apart seeds (Arthur, 2007)."""
    centres = points[torch.randint(len(points), (1,), generator=generator)]
    for _ in range(count - 1):
        far = torch.cdist(points, centres).amin(dim=1).square() + 1e-9
        centres = torch.cat([centres, points[torch.multinomial(far, 1, generator=generator)]])
    for _ in range(_ROUNDS):
        nearest = torch.cdist(points, centres).argmin(dim=1)
        counts = torch.bincount(nearest, minlength=count)
        sums = torch.zeros_like(centres).index_add_(0, nearest, points)
        means = sums / counts.clamp_min(1)[:, None]
        centres = torch.where((counts > 0)[:, None], means, centres)
    return centres
