"""How many steps of random play lie between two keypoints: a classifier used as a planning cost.

Two points on two sides of a wall are few pixels but many steps apart. The classifier is given two
frames of one episode, as keypoints with the code of their scene, and says how many steps were
between them, in classes that double in width. The expected class is the distance.

Letters in shapes: `N` pairs, `S` image size, `E` scene code. Keypoints are (row, column) in pixels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from hvf.models.doublings import class_of, expected_class
from hvf.models.keypoint.scene_code import SceneCode


@dataclass(frozen=True)
class TemporalDistanceConfig:
    """Sizes of the temporal distance.

    Attributes:
        image_size: height and width of the images, `S`, in pixels (even).
        scene_dim: length of the scene code, `E`.
        hidden: width of the two hidden layers.
        classes: class 0 is no step, class `c` from `2^(c-1)` to `2^c - 1` steps, the last also
            everything beyond.
    """

    image_size: int = 64
    scene_dim: int = 16
    hidden: int = 128
    classes: int = 8

    def __post_init__(self) -> None:
        if self.image_size < 2 or self.image_size % 2:
            raise ValueError(f"image_size must be even, at least 2; got {self.image_size}")
        for name in ("scene_dim", "hidden"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.classes < 2:
            raise ValueError(f"classes must be at least 2, got {self.classes}")


class TemporalDistance(nn.Module):
    """The classifier; see the module's documentation."""

    config_type: ClassVar[type[TemporalDistanceConfig]] = TemporalDistanceConfig

    def __init__(self, config: TemporalDistanceConfig) -> None:
        super().__init__()
        self.config = config
        self.code = SceneCode(config.image_size, config.scene_dim)
        self.layers = nn.Sequential(
            nn.Linear(4 + config.scene_dim, config.hidden),
            nn.ReLU(),
            nn.Linear(config.hidden, config.hidden),
            nn.ReLU(),
            nn.Linear(config.hidden, config.classes),
        )

    def classes(self, steps: Tensor) -> Tensor:
        """Class `[N]`, int64, of a number of steps `[N]`."""
        return class_of(steps, self.config.classes)

    def logits(self, before: Tensor, after: Tensor, codes: Tensor) -> Tensor:
        """Logits `[..., classes]` of `before` and `after [..., 2]` in scenes `codes [..., E]`."""
        half = 0.5 * (self.config.image_size - 1)
        inputs = torch.cat([before / half - 1.0, after / half - 1.0, codes], dim=-1)
        scores: Tensor = self.layers(inputs)
        return scores

    def forward(self, before: Tensor, after: Tensor, codes: Tensor) -> Tensor:
        """Expected class `[...]`: about the binary logarithm of twice the number of steps."""
        return expected_class(self.logits(before, after, codes))

    def loss(
        self, batch: Mapping[str, Tensor], generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Cross entropy, in nats.

        The batch holds `before` and `after` `[N, 2]`, `codes [N, E]` and `steps [N]`.
        """
        logits = self.logits(batch["before"], batch["after"], batch["codes"])
        labels = self.classes(batch["steps"])
        right = (logits.argmax(dim=1) == labels).float().mean()
        return F.cross_entropy(logits, labels), {"right": right.detach()}
