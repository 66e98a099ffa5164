"""Compact dynamics model: a moving keypoint, a sprite, and a small local network.

What moves in an image is described by one keypoint (`keypoint_perception`); what does not move is
copied from the start frame:

    predicted frame = start frame + colour * (sprite(keypoint_h) - sprite(keypoint_0))

The sprite is an outer product of two profiles, so the squared pixel distance to a goal image has a
closed form and planning never decodes a frame. The planner runs this model in Rust
(`hvf_core.KeypointWorld`); this module is what is trained, and the reference for tests.

How an action moves the keypoint is learned by a network that sees the scene around it (`cell`),
from the keypoints that perception found in consecutive frames.

Letters in shapes: `N` frames, `S` image size, `A` action dimensions, `H` steps, `G` scenes with `B`
transitions each. Keypoints are (row, column) in pixels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor, nn

from hvf.models.frames import to_unit
from hvf.models.keypoint.cell import Cell, CellConfig
from hvf.models.keypoint.perception import KeypointPerception, PerceptionConfig


@dataclass(frozen=True)
class DynamicsConfig:
    """Sizes and loss weights of the compact dynamics model.

    Attributes:
        perception: the keypoint detector.
        cell: the network that moves keypoints.
        action_dim: action dimensions, `A`.
        action_scale: largest absolute action; actions are divided by it.
        outlier_weight: weight of the squared error, in pixels, beside the linear one.
    """

    perception: PerceptionConfig = field(default_factory=PerceptionConfig)
    cell: CellConfig = field(default_factory=CellConfig)
    action_dim: int = 2
    action_scale: float = 3.0
    outlier_weight: float = 0.1

    def __post_init__(self) -> None:
        if self.action_dim < 1:
            raise ValueError(f"action_dim must be at least 1, got {self.action_dim}")
        if not 0 < self.action_scale < float("inf"):
            raise ValueError(f"action_scale must be positive, got {self.action_scale}")
        if not self.outlier_weight >= 0:
            raise ValueError(f"outlier_weight must not be negative, got {self.outlier_weight}")


class KeypointDynamics(nn.Module):
    """Perception and cell; see the module's documentation."""

    config_type: ClassVar[type[DynamicsConfig]] = DynamicsConfig
    background_mean: Tensor
    background_scale: Tensor

    def __init__(self, config: DynamicsConfig) -> None:
        super().__init__()
        self.config = config
        self.perception = KeypointPerception(config.perception)
        self.register_buffer("background_mean", torch.zeros(()))
        self.register_buffer("background_scale", torch.ones(()))
        self.cell = Cell(config.cell, config.action_dim)

    def freeze_perception(self, perception: KeypointPerception) -> KeypointDynamics:
        """Take over a trained perception and keep it as it is."""
        self.perception.load_state_dict(perception.state_dict())
        self.perception.requires_grad_(False)
        return self

    def observe(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Keypoints `[N, 2]` and scene maps `[N, S, S]` of uint8 `images [N, S, S, 3]`.

        Warns once if the images look like nothing that perception was trained on.
        """
        unit = to_unit(images)
        keypoints, sprite = self.perception.find(unit)
        return keypoints, self.maps((unit - self.perception.tint(sprite)).mean(dim=1))

    def background(self, images: Tensor, keypoints: Tensor) -> Tensor:
        """What does not move in `images [N, 3, S, S]`, grey: `[N, S, S]`.

        The sprite at `keypoints [N, 2]` is taken away.
        """
        return self.perception.background(images, keypoints).mean(dim=1)

    def fit_backgrounds(self, backgrounds: Tensor) -> KeypointDynamics:
        """Note mean and scale of `backgrounds [N, S, S]`; maps have mean 0 and variance 1."""
        self.background_mean.copy_(backgrounds.double().mean())
        self.background_scale.copy_(1.0 / backgrounds.double().std().clamp_min(1e-6))
        return self

    def maps(self, backgrounds: Tensor) -> Tensor:
        """Scene maps `[N, S, S]`, what the cell looks at, of `backgrounds [N, S, S]`."""
        return self.cell.smooth((backgrounds - self.background_mean) * self.background_scale)

    def draw(self, images: Tensor, before: Tensor, after: Tensor) -> Tensor:
        """Frames `[N, 3, S, S]` in which the moving part went from `before` to `after` `[N, 2]`."""
        base = self.perception.background(images, before)
        return base + self.perception.tint(self.perception.sprite(after))

    def step(self, keypoints: Tensor, maps: Tensor, actions: Tensor) -> Tensor:
        """Keypoints `[G, B, 2]` one action `[G, B, A]` later, in scenes of `maps [G, S, S]`."""
        moved: Tensor = self.cell(maps, keypoints, actions / self.config.action_scale)
        return moved

    def rollout(self, keypoints: Tensor, maps: Tensor, actions: Tensor) -> Tensor:
        """Keypoints `[G, B, H, 2]` after each of `actions [G, B, H, A]`."""
        path = []
        for h in range(actions.shape[2]):
            keypoints = self.step(keypoints, maps, actions[:, :, h])
            path.append(keypoints)
        return torch.stack(path, dim=2)

    def loss(
        self, batch: Mapping[str, Tensor], generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Error of one predicted step, in pixels.

        The batch holds `backgrounds [G, S, S]`, `before` and `after` `[G, B, 2]` (keypoints), and
        `actions [G, B, A]`.
        """
        maps = self.maps(batch["backgrounds"].float())
        missed = self.step(batch["before"], maps, batch["actions"]) - batch["after"]
        squared = missed.square().sum(dim=-1)
        # The linear part makes free motion and sliding exact. Passing a gap is rare and far from
        # what happens otherwise: without the squared part it would be left out as an outlier.
        error = (squared + 1e-2).sqrt().mean()
        loss = error + self.config.outlier_weight * squared.mean()
        return loss, {"step_pixels": error.detach(), "squared": squared.mean().detach()}
