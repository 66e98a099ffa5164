"""Compact dynamics model: a moving keypoint, a sprite, and a small residual network.

What moves in an image is described by one keypoint (`keypoint_perception`); what does not move is
copied from the start frame:

    predicted frame = start frame + colour * (sprite(keypoint_h) - sprite(keypoint_0))

The sprite is an outer product of two profiles, so the squared pixel distance to a goal image has a
closed form and planning never decodes a frame. The planner runs this model in Rust
(`hvf_core.KeypointWorld`); this module is what is trained, and the reference for tests.

The residual network ("cell") learns how an action moves the keypoint, given a code of what does
not move (the walls), from the keypoints that perception found in consecutive frames. The code is
the whitened principal components of the backgrounds (a learned code collapsed: passing a gap is
too rare to hold it up).

Letters in shapes: `N` frames, `S` image size, `E` scene code, `A` action dimensions, `H` steps.
Keypoints here are (row, column) in [-1, 1], pixel centres of the first and last row at -1 and 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from hvf.models.frames import to_unit
from hvf.models.keypoint_perception import KeypointPerception, PerceptionConfig

POOLED_COLUMNS = 4
"""Columns of the background that are averaged into one before the scene is encoded."""


@dataclass(frozen=True)
class DynamicsConfig:
    """Sizes and loss weights of the compact dynamics model.

    Attributes:
        perception: the keypoint detector.
        action_dim: action dimensions, `A`.
        action_scale: largest absolute action; actions are divided by it.
        scene_dim: length of the scene code, `E`: principal components of the backgrounds.
        hidden: width of the cell's two hidden layers (a multiple of 4).
        outlier_weight: weight of the squared error, in pixels, beside the linear one.
    """

    perception: PerceptionConfig = field(default_factory=PerceptionConfig)
    action_dim: int = 2
    action_scale: float = 3.0
    scene_dim: int = 16
    hidden: int = 96
    outlier_weight: float = 0.1

    def __post_init__(self) -> None:
        if self.action_dim < 1:
            raise ValueError(f"action_dim must be at least 1, got {self.action_dim}")
        if not 0 < self.action_scale < float("inf"):
            raise ValueError(f"action_scale must be positive, got {self.action_scale}")
        if self.scene_dim < 1:
            raise ValueError(f"scene_dim must be at least 1, got {self.scene_dim}")
        if not self.outlier_weight >= 0:
            raise ValueError(f"outlier_weight must not be negative, got {self.outlier_weight}")
        if self.hidden < 4 or self.hidden % 4:
            raise ValueError(f"hidden must be a positive multiple of 4, got {self.hidden}")


class KeypointDynamics(nn.Module):
    """Perception, scene code and cell; see the module's documentation."""

    config_type: ClassVar[type[DynamicsConfig]] = DynamicsConfig
    scene_mean: Tensor
    scene_basis: Tensor

    def __init__(self, config: DynamicsConfig) -> None:
        super().__init__()
        self.config = config
        size, hidden = config.perception.image_size, config.hidden
        self.perception = KeypointPerception(config.perception)
        pooled = size * (size // POOLED_COLUMNS)
        self.register_buffer("scene_mean", torch.zeros(pooled))
        self.register_buffer("scene_basis", torch.zeros(pooled, config.scene_dim))
        self.input = nn.Linear(2 + config.action_dim + config.scene_dim, hidden)
        self.middle = nn.Linear(hidden, hidden)
        self.output = nn.Linear(hidden, 2)

    def freeze_perception(self, perception: KeypointPerception) -> KeypointDynamics:
        """Take over a trained perception and keep it as it is."""
        self.perception.load_state_dict(perception.state_dict())
        self.perception.requires_grad_(False)
        return self

    def to_pixels(self, keypoints: Tensor) -> Tensor:
        """Keypoints in [-1, 1] to pixels."""
        return (keypoints + 1.0) * (0.5 * (self.config.perception.image_size - 1))

    def to_keypoints(self, pixels: Tensor) -> Tensor:
        """Pixels to keypoints in [-1, 1]."""
        return pixels * (2.0 / (self.config.perception.image_size - 1)) - 1.0

    def observe(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Keypoints `[N, 2]` and scene codes `[N, E]` of uint8 `images [N, S, S, 3]`."""
        unit = to_unit(images)
        pixels = self.perception.keypoints(unit)
        return self.to_keypoints(pixels), self.scene_code(self.pooled_background(unit, pixels))

    def pooled_background(self, images: Tensor, pixels: Tensor) -> Tensor:
        """What does not move in `images [N, 3, S, S]`, small and grey: `[N, S * S / 4]`.

        `pixels [N, 2]` are the keypoints in pixels; the sprite there is taken away first.
        """
        grey = self.perception.background(images, pixels).mean(dim=1, keepdim=True)
        return F.avg_pool2d(grey, (1, POOLED_COLUMNS)).flatten(1)

    def scene_code(self, pooled: Tensor) -> Tensor:
        """Scene codes `[N, E]` from `pooled [N, S * S / 4]` backgrounds."""
        return (pooled - self.scene_mean) @ self.scene_basis

    def fit_scene_basis(self, pooled: Tensor) -> KeypointDynamics:
        """Set the scene's principal components, whitened, from `pooled [P, S * S / 4]`.

        Components of the pixels' noise (the smallest ones) are not blown up.
        """
        mean = pooled.double().mean(dim=0)
        centred = pooled.double() - mean
        variance, basis = torch.linalg.eigh(centred.T @ centred / len(pooled))
        count = self.config.scene_dim
        variance, basis = variance[-count:].flip(0), basis[:, -count:].flip(1)
        scale = (variance + 1e-3 * variance[0]).rsqrt()
        self.scene_mean.copy_(mean)
        self.scene_basis.copy_(basis * scale)
        return self

    def draw(self, images: Tensor, before: Tensor, after: Tensor) -> Tensor:
        """Frames `[N, 3, S, S]` in which the moving part went from `before` to `after` `[N, 2]`."""
        base = self.perception.background(images, self.to_pixels(before))
        return base + self.perception.tint(self.perception.sprite(self.to_pixels(after)))

    def step(self, keypoints: Tensor, codes: Tensor, actions: Tensor) -> Tensor:
        """Keypoints `[N, 2]` one action `[N, A]` later, given scene codes `[N, E]`."""
        inputs = torch.cat([keypoints, actions / self.config.action_scale, codes], dim=-1)
        hidden = F.relu(self.middle(F.relu(self.input(inputs))))
        moved: Tensor = keypoints + self.output(hidden)
        return moved

    def rollout(self, keypoints: Tensor, codes: Tensor, actions: Tensor) -> Tensor:
        """Keypoints `[N, H, 2]` after each of `actions [N, H, A]`."""
        path = []
        for h in range(actions.shape[1]):
            keypoints = self.step(keypoints, codes, actions[:, h])
            path.append(keypoints)
        return torch.stack(path, dim=1)

    def loss(
        self, batch: Mapping[str, Tensor], generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Error of one predicted step, in pixels.

        The batch holds, for `G` scenes with `B` transitions each: `pooled [G, S * S / 4]`
        (backgrounds), `before` and `after` `[G, B, 2]` (keypoints), `actions [G, B, A]`.
        """
        codes = self.scene_code(batch["pooled"])
        predicted = self.step(
            batch["before"].flatten(0, 1),
            codes.repeat_interleave(batch["before"].shape[1], dim=0),
            batch["actions"].flatten(0, 1),
        )
        missed = self.to_pixels(predicted) - self.to_pixels(batch["after"].flatten(0, 1))
        squared = missed.square().sum(dim=-1)
        # The linear part makes free motion and sliding exact. Passing a gap is rare and far from
        # what happens otherwise: without the squared part it would be left out as an outlier.
        error = (squared + 1e-2).sqrt().mean()
        loss = error + self.config.outlier_weight * squared.mean()
        return loss, {"step_pixels": error.detach(), "squared": squared.mean().detach()}
