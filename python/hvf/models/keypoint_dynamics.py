"""Compact dynamics model: a moving keypoint, a sprite, and a small residual network.

What moves in an image is described by one keypoint found without labels; what does not move is
copied from the start frame:

    predicted frame = start frame + colour * (sprite(keypoint_h) - sprite(keypoint_0))

The sprite is an outer product of two learned profiles, so the squared pixel distance to a goal
image has a closed form and planning never decodes a frame (the planner runs this model in Rust,
`hvf_core.KeypointWorld`; this module is what is trained and the reference it is tested against).

The keypoint is the centroid of a learned motion mask. Mask, sprite and colour are learned from
pairs of frames of one episode: whatever differs between the two must be explained by moving the
mask. The residual network ("cell") then learns how actions move the keypoint, given a code of the
scene (where the walls are), from keypoints that the encoder found in the following frames.

Letters in shapes: `N` frames, `S` image size, `E` scene code, `A` action dimensions, `H` steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F


@dataclass(frozen=True)
class KeypointConfig:
    """Sizes of the compact dynamics model."""

    image_size: int = 64
    """Height and width of the images, `S`, in pixels (a multiple of 8)."""
    action_dim: int = 2
    """Action dimensions, `A`."""
    action_scale: float = 3.0
    """Largest absolute action; actions are divided by it before the network sees them."""
    scene_dim: int = 16
    """Length of the scene code, `E`."""
    hidden: int = 128
    """Width of the two hidden layers of the cell (a multiple of 8)."""

    def __post_init__(self) -> None:
        """Refuse sizes that cannot be built."""
        if self.image_size < 16 or self.image_size % 8:
            raise ValueError(f"image_size: must be a multiple of 8, at least 16; got {self.image_size}")
        if self.action_dim < 1:
            raise ValueError(f"action_dim: must be at least 1, got {self.action_dim}")
        if not self.action_scale > 0:
            raise ValueError(f"action_scale: must be positive, got {self.action_scale}")
        if self.scene_dim < 1:
            raise ValueError(f"scene_dim: must be at least 1, got {self.scene_dim}")
        if self.hidden < 8 or self.hidden % 8:
            raise ValueError(f"hidden: must be a multiple of 8, at least 8; got {self.hidden}")


class KeypointDynamics(nn.Module):
    """Encoder, sprite and cell; see the module's documentation."""

    def __init__(self, config: KeypointConfig) -> None:
        super().__init__()
        self.config = config
        size, hidden = config.image_size, config.hidden
        self.mask = nn.Sequential(
            nn.Conv2d(3, 8, 3, padding=1), nn.ReLU(), nn.Conv2d(8, 1, 1)
        )
        self.scene = nn.Sequential(
            nn.Conv2d(3, 16, 5, stride=2, padding=2), nn.ReLU(),
            nn.Conv2d(16, 16, 3, stride=2, padding=1), nn.ReLU(),
            nn.Conv2d(16, 32, 3, stride=2, padding=1), nn.ReLU(),
            nn.Flatten(),
            nn.Linear(32 * (size // 8) ** 2, 128), nn.ReLU(),
            nn.Linear(128, config.scene_dim),
        )
        self.input = nn.Linear(2 + config.action_dim + config.scene_dim, hidden)
        self.middle = nn.Linear(hidden, hidden)
        self.output = nn.Linear(hidden, 2)
        # Sprite: half-size and edge width of the profiles along y and x in pixels, and colour
        # relative to the background. A soft, wide start gives gradients from far away.
        self.half_size = nn.Parameter(torch.full((2,), 4.0))
        self.edge = nn.Parameter(torch.full((2,), 4.0))
        self.colour = nn.Parameter(torch.tensor([0.1, 0.3, 0.0]))
        grid = torch.arange(size, dtype=torch.float32)
        self.register_buffer("grid", grid, persistent=False)

    # --- images to keypoints and scene codes ---

    def motion_mask(self, images: Tensor) -> Tensor:
        """Mask of what moves, `[N, S, S]`, not negative, from `images [N, 3, S, S]` in [0, 1]."""
        return F.relu(self.mask(images - 0.5).squeeze(1))

    def centroid(self, mask: Tensor) -> Tensor:
        """Keypoints `[N, 2]` as (row, column) in pixels from a mask `[N, S, S]`."""
        total = mask.sum(dim=(1, 2)).clamp_min(1e-4)
        row = (mask.sum(dim=2) * self.grid).sum(dim=1) / total
        column = (mask.sum(dim=1) * self.grid).sum(dim=1) / total
        return torch.stack([row, column], dim=1)

    def keypoints(self, images: Tensor) -> Tensor:
        """Keypoints `[N, 2]` (row, column) in pixels from `images [N, 3, S, S]` in [0, 1]."""
        return self.centroid(self.motion_mask(images))

    def scene_code(self, images: Tensor) -> Tensor:
        """Scene codes `[N, E]` from `images [N, 3, S, S]` in [0, 1]."""
        code: Tensor = self.scene(images - 0.5)
        return code

    # --- keypoints to frames ---

    def profiles(self, keypoints: Tensor) -> tuple[Tensor, Tensor]:
        """Row and column profile of the sprite, `[N, S]` each, in [0, 1].

        Pixel `i` is covered by `clamp((half_size - |i - keypoint|) / edge + 1/2, 0, 1)`: with
        an edge of one pixel this is the exact area coverage of a box.
        """
        distance = (self.grid - keypoints[..., None]).abs()
        half, edge = self.half_size[:, None], self.edge.clamp_min(0.25)[:, None]
        profile = ((half - distance) / edge + 0.5).clamp(0, 1)
        return profile[..., 0, :], profile[..., 1, :]

    def sprite(self, keypoints: Tensor) -> Tensor:
        """Coverage of each pixel by the sprite, `[N, S, S]`, from keypoints `[N, 2]`."""
        row, column = self.profiles(keypoints)
        return row[..., :, None] * column[..., None, :]

    def move(self, images: Tensor, before: Tensor, after: Tensor) -> Tensor:
        """Frames `[N, 3, S, S]` in which coverage `before` became `after` (`[N, S, S]` each)."""
        return images + self.colour[:, None, None] * (after - before)[:, None]

    # --- actions to keypoints ---

    def unit(self, keypoints: Tensor) -> Tensor:
        """Keypoints in [-1, 1] instead of pixels."""
        return keypoints * (2.0 / (self.config.image_size - 1)) - 1.0

    def step(self, keypoints: Tensor, scene: Tensor, actions: Tensor) -> Tensor:
        """Keypoints `[N, 2]` in [-1, 1] one action `[N, A]` later, given scene codes `[N, E]`."""
        inputs = torch.cat([keypoints, actions / self.config.action_scale, scene], dim=-1)
        hidden = F.relu(self.input(inputs))
        hidden = F.relu(self.middle(hidden))
        moved: Tensor = keypoints + self.output(hidden)
        return moved

    def rollout(self, keypoints: Tensor, scene: Tensor, actions: Tensor) -> Tensor:
        """Keypoints `[N, H, 2]` in [-1, 1] after each of `actions [N, H, A]`."""
        path = []
        for h in range(actions.shape[1]):
            keypoints = self.step(keypoints, scene, actions[:, h])
            path.append(keypoints)
        return torch.stack(path, dim=1)
