"""Sizes of the spatial latent model, and how it weighs errors."""

from __future__ import annotations

import dataclasses
import math

from hvf.models.video import VideoConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class SpatialConfig(VideoConfig):
    """The defaults fit any scene; a richer one wants more channels.

    Attributes:
        widths: channels of the encoder's convolutions, each of which halves the image; the last is
            the number of features in a cell of the state.
        blocks: residual blocks of the dynamics.
        known: units of the network that tells all cells of the dynamics what is far.
        hold: steps of the environment that one of its steps is long (a macro-step).
        blur: standard deviation, pixels, of the Gaussian blur of the blurred part of the loss.
        blur_weight: weight of that part beside the sharp one.
        change_weight: what the error of a pixel that changes counts more than that of one that
            stays as it was in the first frame.
        change: difference of a colour, in [0, 1], from which a pixel has changed wholly.
        drawn: predicted frames of a stretch that are drawn and compared, at most.

    Raises:
        ValueError: a number out of range, or images that cannot be halved so often.
    """

    widths: tuple[int, ...] = (16, 32, 48)
    blocks: int = 2
    known: int = 128
    hold: int = 1
    blur: float = 3.0
    blur_weight: float = 4.0
    change_weight: float = 4.0
    change: float = 0.2
    drawn: int = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "widths", tuple(self.widths))
        if len(self.widths) < 2 or min(self.widths) < 1:
            raise ValueError(f"widths must be two or more numbers of channels, got {self.widths}")
        for name in ("known", "hold", "drawn"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("blocks", "blur", "blur_weight", "change_weight"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(
                    f"{name} must be finite and not negative, got {getattr(self, name)}"
                )
        if not 0 < self.change < math.inf:
            raise ValueError(f"change must be positive, got {self.change}")
        if any(size % self.cell for size in self.image_size):
            raise ValueError(f"image_size must be multiples of {self.cell}, got {self.image_size}")

    @property
    def cell(self) -> int:
        """Height and width of a cell, pixels."""
        return 1 << len(self.widths)

    @property
    def grid(self) -> tuple[int, int]:
        """Height and width of a state, cells."""
        return self.image_size[0] // self.cell, self.image_size[1] // self.cell
