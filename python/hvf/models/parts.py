"""Where the coloured parts of a scene are: soft masks by colour, and their centres.

Cubes, door and drawer differ in colour. The colours are found without labels: pixels that change
from one frame of an episode to another are clustered by chroma (colour without brightness). A mask
is then a softmax over one affine function of the pixel's colour for each cluster and one for grey,
and a part is described by how much of it is seen and where the middle of that is.

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
# A few pixels' worth of a part's usual place keeps the centre of what is hidden defined.
_PRIOR = 0.5
_ROUNDS = 60


@dataclass(frozen=True)
class PartsConfig:
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


class Parts(nn.Module):
    """Masks and centres; see the module's documentation. Nothing here is trained by gradient."""

    colours: Tensor
    usual: Tensor
    chroma_of: Tensor

    def __init__(self, config: PartsConfig) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("colours", torch.zeros(config.parts, 2))
        # Mass, row and column that a part has on average.
        middle = (config.image_size - 1) / 2
        self.register_buffer("usual", torch.tensor([1.0, middle, middle]).repeat(config.parts, 1))
        self.register_buffer("chroma_of", torch.tensor(_CHROMA), persistent=False)

    def fit(self, first: Tensor, second: Tensor, seed: int = 0) -> Parts:
        """Find the colours.

        Args:
            first: frames uint8 `[N, S, S, 3]`.
            second: later frames of the same episodes.
            seed: of the clustering's start.

        Raises:
            ValueError: fewer coloured pixels change than there are parts.
        """
        changed = (first.int() - second.int()).abs().amax(dim=-1) > 20
        pixels = torch.cat([first[changed], second[changed]]).float() / 255
        chroma = pixels @ self.chroma_of
        chroma = chroma[chroma.norm(dim=1) > self.config.least_chroma]
        if len(chroma) < self.config.parts:
            raise ValueError("frames: too few coloured pixels change to find parts by")
        generator = torch.Generator().manual_seed(seed)
        chroma = chroma[torch.randperm(len(chroma), generator=generator)[:60_000]]
        self.colours.copy_(_clusters(chroma, self.config.parts, generator))
        observed = torch.cat([self(part) for part in torch.split(first, 256)])
        seen = observed.mean(dim=0)
        # Places are weighted by what is seen there, mass is an absolute number of pixels.
        weight = observed[..., :1]
        seen[:, 1:] = (observed[..., 1:] * weight).sum(dim=0) / weight.sum(dim=0).clamp_min(1e-6)
        seen[:, 0] = (seen[:, 0] * self.usual[:, 0]).clamp_min(1.0)
        self.usual.copy_(seen)
        return self

    def masks(self, frames: Tensor) -> Tensor:
        """Masks `[N, P, S, S]` in [0, 1] of uint8 `frames [N, S, S, 3]`."""
        # The squared distance to a cluster, but for what is common to all of them, is affine.
        centres = torch.cat([self.colours.new_zeros(1, 2), self.colours])
        scale = 2.0 / self.config.width**2
        weight = scale * centres @ self.chroma_of.T / 255
        bias = -0.5 * scale * centres.square().sum(dim=1)
        image = frames.permute(0, 3, 1, 2).float().contiguous()
        return F.conv2d(image, weight[:, :, None, None], bias).softmax(dim=1)[:, 1:]

    def forward(self, frames: Tensor) -> Tensor:
        """Mass (1 is usual), row and column of each part: `[N, P, 3]`.

        Args:
            frames: uint8 `[N, S, S, 3]`.
        """
        # What is only a little like a colour, as the seam of two others is, adds up over a frame.
        masks = F.relu(self.masks(frames) - 0.2) * 1.25
        line = torch.arange(self.config.image_size, dtype=torch.float32, device=masks.device)
        rows, columns = masks.sum(dim=3), masks.sum(dim=2)
        mass = rows.sum(dim=2)
        total = mass + _PRIOR
        row = (rows @ line + _PRIOR * self.usual[:, 1]) / total
        column = (columns @ line + _PRIOR * self.usual[:, 2]) / total
        return torch.stack([mass / self.usual[:, 0], row, column], dim=2)


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
