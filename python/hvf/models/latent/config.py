"""Sizes of the latent model."""

from __future__ import annotations

import dataclasses
import math

from hvf.models.video import VideoConfig

_COUNTS = (
    "cell",
    "components",
    "state",
    "encoder_width",
    "dynamics_width",
    "readout_width",
    "decoder_channels",
    "hold",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class LatentConfig(VideoConfig):
    """Sizes of the latent model; they fit any scene, a richer one wants more of each.

    Attributes:
        blur: standard deviation, pixels, of the Gaussian blur through which it sees frames.
        cell: pixels, along each side, whose mean is one pixel of a reduced frame.
        components: principal components of reduced frames that are kept, ``Z``.
        state: numbers that it remembers, ``S``.
        encoder_width: units in the layers of the encoder.
        encoder_blocks: residual blocks of the encoder.
        dynamics_width: units in the layers of the dynamics.
        dynamics_blocks: residual blocks of the dynamics.
        readout_width: units in the only hidden layer of the read-out.
        decoder_channels: of the network that draws states, for pictures.
        hold: steps of the environment that one of its steps is long (a macro-step).

    Raises:
        ValueError: a number out of range.
    """

    blur: float = 3.0
    cell: int = 4
    components: int = 128
    state: int = 32
    encoder_width: int = 256
    encoder_blocks: int = 2
    dynamics_width: int = 160
    dynamics_blocks: int = 2
    readout_width: int = 256
    decoder_channels: int = 24
    hold: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in _COUNTS:
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("encoder_blocks", "dynamics_blocks"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        if not 0 <= self.blur < math.inf:
            raise ValueError(f"blur must be finite and not negative, got {self.blur}")
        if self.components > 3 * self.cells:
            raise ValueError(
                f"components must be at most {3 * self.cells}, the numbers of a reduced frame; "
                f"got {self.components}"
            )

    @property
    def grid(self) -> tuple[int, int]:
        """Height and width of a reduced frame."""
        height, width = self.image_size
        return -(-height // self.cell), -(-width // self.cell)

    @property
    def cells(self) -> int:
        """Pixels of a reduced frame."""
        return self.grid[0] * self.grid[1]
