"""What an SV2P is made of, and the schedules that it is trained by."""

from __future__ import annotations

import dataclasses
import math

from hvf.models.video import VideoConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class SV2PConfig(VideoConfig):
    """The defaults are those of the released model (tensor2tensor 1.13.4, ``next_frame_sv2p``).

    Attributes:
        stem: channels of the first convolution.
        widths: channels of the seven convolutional LSTMs.
        kernel: their kernels' width, odd.
        masks: images that a frame is put together from, beside the last frame: one that is drawn
            anew, and the last frame moved in ``masks - 1`` ways.
        move: width of the kernels that move it, pixels, odd.
        posterior: channels of the three convolutions of the posterior.
        frames: frames of a clip in training, which the posterior sees all at once.
        least_log_variance: of the posterior.
        posterior_from: step from which the latent comes from the posterior; before, from the prior.
        kl_from: step from which the KL divergence counts.
        kl_weight: its weight then.
        sampling_k: of scheduled sampling: at ``step``, of ``B`` sequences
            ``round(B * k / (k + exp(step / k)))`` go on from true frames, the others from predicted
            ones.

    Raises:
        ValueError: a field out of range, or images of a size that is no multiple of 8.
    """

    stem: int = 32
    widths: tuple[int, ...] = (32, 32, 64, 64, 128, 64, 32)
    kernel: int = 5
    masks: int = 10
    move: int = 5
    posterior: tuple[int, ...] = (32, 64, 64)
    frames: int = 11
    least_log_variance: float = -5.0
    posterior_from: int = 15_000
    kl_from: int = 30_000
    kl_weight: float = 1e-3
    sampling_k: float = 900.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, count in (("widths", 7), ("posterior", 3)):
            values = tuple(getattr(self, name))
            object.__setattr__(self, name, values)
            if len(values) != count or min(values) < 1:
                raise ValueError(f"{name} must be {count} numbers of channels, got {values}")
        for name in ("kernel", "move"):
            if getattr(self, name) < 1 or getattr(self, name) % 2 == 0:
                raise ValueError(f"{name} must be odd, got {getattr(self, name)}")
        for name, least in (
            ("stem", 1),
            ("masks", 2),
            ("frames", 2),
            ("posterior_from", 0),
            ("kl_from", 0),
            ("kl_weight", 0),
        ):
            if not least <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be at least {least}, got {getattr(self, name)}")
        if not 0 < self.sampling_k < math.inf:
            raise ValueError(f"sampling_k must be positive, got {self.sampling_k}")
        if not math.isfinite(self.least_log_variance):
            raise ValueError(f"least_log_variance must be finite, got {self.least_log_variance}")
        if any(size % 8 for size in self.image_size):
            raise ValueError(f"image_size must be multiples of 8, got {self.image_size}")

    @property
    def latent_size(self) -> tuple[int, int]:
        """Height and width of the latent, which has one channel: an eighth of the image's."""
        return self.image_size[0] // 8, self.image_size[1] // 8

    def true_frames(self, step: int, batch: int) -> int:
        """How many of ``batch`` sequences go on from true frames at ``step``."""
        # Beyond exp's range it is 0 long since.
        grown = math.exp(min(step / self.sampling_k, 700.0))
        return round(batch * self.sampling_k / (self.sampling_k + grown))

    def kl_weight_at(self, step: int) -> float:
        """Weight of the KL divergence at ``step``."""
        return self.kl_weight if step >= max(self.posterior_from, self.kl_from) else 0.0


SMALL = SV2PConfig(
    stem=8,
    widths=(8, 8, 16, 16, 32, 16, 8),
    posterior=(8, 16, 16),
    frames=6,
    posterior_from=2_000,
    kl_from=4_000,
    sampling_k=200.0,
)
"""A quarter of the widths, for two cores."""
