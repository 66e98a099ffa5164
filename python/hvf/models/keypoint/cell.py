"""What an action does to a point of a scene, given what is near it: the cell of the dynamics.

One action is a few substeps. In each, two small layers look at the patch of the scene around the
point, at the action, and at a short memory (a velocity, say), and move point and memory on. Motion
is local: a wall acts where it is touched, wherever in the scene that is. What the cell learns at
one wall it therefore knows of all; a network that was given the whole scene and the absolute
position had to learn every gap anew and let the agent pass where it could not.

Letters in shapes: `G` scenes, `B` points in each, `S` image size, `A` action dimensions, `C` length
of the memory. Points are (row, column) in pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F


@dataclass(frozen=True)
class CellConfig:
    """Sizes of the cell.

    Attributes:
        hidden: width of the two hidden layers (a multiple of 4).
        taps: rows and columns of the patch, odd.
        spacing: pixels between them. A patch has to reach as far as a substep moves and what moves
            is wide.
        substeps: substeps of an action.
        memory: numbers carried from substep to substep, `C`.
    """

    hidden: int = 48
    taps: int = 7
    spacing: int = 2
    substeps: int = 4
    memory: int = 6

    def __post_init__(self) -> None:
        if self.hidden < 4 or self.hidden % 4:
            raise ValueError(f"hidden must be a positive multiple of 4, got {self.hidden}")
        if self.taps < 1 or not self.taps % 2:
            raise ValueError(f"taps must be positive and odd, got {self.taps}")
        for name in ("spacing", "substeps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.memory < 0:
            raise ValueError(f"memory must not be negative, got {self.memory}")


class Cell(nn.Module):
    """The network; see the module's documentation. `hvf_core.KeypointWorld` is its twin in Rust.

    Args:
        config: sizes.
        action_dim: action dimensions, `A`.
    """

    offsets: Tensor

    def __init__(self, config: CellConfig, action_dim: int) -> None:
        super().__init__()
        self.config = config
        self.patch = nn.Linear(config.taps**2, config.hidden)
        self.context = nn.Linear(action_dim + config.memory, config.hidden, bias=False)
        self.middle = nn.Linear(config.hidden, config.hidden)
        self.output = nn.Linear(config.hidden, 2 + config.memory)
        self.free = nn.Linear(action_dim, 2, bias=False)
        nn.init.zeros_(self.free.weight)
        line = (torch.arange(config.taps) - config.taps // 2).float() * config.spacing
        offsets = torch.stack(torch.meshgrid(line, line, indexing="ij"), dim=-1).reshape(-1, 2)
        self.register_buffer("offsets", offsets, persistent=False)

    def smooth(self, scenes: Tensor) -> Tensor:
        """`scenes [G, S, S]` averaged over squares as wide as the taps are apart.

        Taps then see all of a patch, not a few of its pixels.
        """
        width = self.config.spacing
        before = (width - 1) // 2
        padding = (before, width - 1 - before) * 2
        padded = F.pad(scenes[:, None], padding, mode="replicate")
        return F.avg_pool2d(padded, width, stride=1)[:, 0]

    def patches(self, maps: Tensor, points: Tensor) -> Tensor:
        """What is around `points [G, B, 2]` in `maps [G, S, S]`, bilinearly: `[G, B, taps**2]`."""
        last = maps.shape[-1] - 1
        at = points.clamp(0, last)[:, :, None] + self.offsets
        grid = (at * (2.0 / last) - 1.0).flip(-1)
        return F.grid_sample(
            maps[:, None], grid, mode="bilinear", padding_mode="border", align_corners=True
        )[:, 0]

    def forward(self, maps: Tensor, points: Tensor, actions: Tensor) -> Tensor:
        """Points `[G, B, 2]` one action later.

        Args:
            maps: smoothed scenes `[G, S, S]`.
            points: `[G, B, 2]`.
            actions: `[G, B, A]`, in [-1, 1].
        """
        memory = points.new_zeros(*points.shape[:2], self.config.memory)
        free = self.free(actions)
        for _ in range(self.config.substeps):
            context = self.context(torch.cat([actions, memory], dim=-1))
            hidden = F.relu(self.patch(self.patches(maps, points)) + context)
            change = self.output(F.relu(self.middle(hidden)))
            points = points + free + change[..., :2]
            memory = memory + change[..., 2:]
        return points
