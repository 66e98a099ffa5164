"""States of the desk as networks see them.

Letters in shapes: `N` samples, `A` action dimensions, `G` sliders, `R` parts that roam, `X` = A + G
+ 3R length of a state (:mod:`hvf.models.layers.perception`).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class StateSizes:
    """Sizes of states.

    Attributes:
        image_size: pixels on each side of the images that parts move in.
        action_dim: action dimensions, `A`.
        sliders: sliders, `G`.
        roaming: parts that roam, `R`.
    """

    image_size: int = 64
    action_dim: int = 3
    sliders: int = 2
    roaming: int = 3

    def __post_init__(self) -> None:
        self.at_least_one("image_size", "action_dim", "sliders", "roaming")

    def at_least_one(self, *names: str) -> None:
        """Refuse sizes below 1.

        Raises:
            ValueError: one of these fields is.
        """
        for name in names:
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")

    @property
    def state_size(self) -> int:
        """Length of a state, `X`."""
        return self.action_dim + self.sliders + 3 * self.roaming


THERE = 0.5
"""Presence from which on a part is there."""


class StateNetwork(nn.Module):
    """A network of states, which it sees scaled to about -1 to 1.

    Args:
        sizes: of the states.
    """

    scale: Tensor

    def __init__(self, sizes: StateSizes) -> None:
        super().__init__()
        self._roaming = sizes.roaming
        half = 0.5 * sizes.image_size
        spread = [2.0] * sizes.action_dim + [0.5] * sizes.sliders
        self.register_buffer(
            "scale", torch.tensor(spread + [half, half, 1.0] * sizes.roaming), persistent=False
        )

    def normal(self, states: Tensor) -> Tensor:
        """Scaled states `[N, X]`, of `states [N, X]`."""
        scaled = states / self.scale
        parts = scaled[:, -3 * self._roaming :] - 0.5
        return torch.cat([scaled[:, : -3 * self._roaming], parts], dim=1)

    def parts(self, states: Tensor) -> Tensor:
        """Row, column and presence of each part, `[N, R, 3]`, in `states [N, X]`."""
        return states[:, -3 * self._roaming :].reshape(len(states), self._roaming, 3)

    def seen_from(self, scenes: Tensor, states: Tensor) -> Tensor:
        """`states [N, X]` in which parts that are gone lie where `scenes [N, X]` have them.

        Where something was last seen that is not there any more says nothing.
        """
        was, parts = self.parts(scenes), self.parts(states)
        there = parts[..., 2:] > THERE
        places = torch.where(there, parts[..., :2], was[..., :2])
        parts = torch.cat([places, parts[..., 2:]], dim=2).flatten(1)
        return torch.cat([states[:, : -3 * self._roaming], parts], dim=1)


def perceptron(
    inputs: int, hidden: int, outputs: int, depth: int, activation: type[nn.Module] = nn.SiLU
) -> nn.Sequential:
    """A network of ``depth`` hidden layers of one width."""
    layers: list[nn.Module] = []
    for _ in range(depth):
        layers += [nn.Linear(inputs, hidden), activation()]
        inputs = hidden
    return nn.Sequential(*layers, nn.Linear(inputs, outputs))
