"""The network that the latent model is made of three times."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class Block(nn.Module):
    """``relu(h + second(relu(first(h))))``."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Linear(width, width)
        self.second = nn.Linear(width, width)

    def forward(self, hidden: Tensor) -> Tensor:
        """``[N, width]`` to ``[N, width]``."""
        return F.relu(hidden + self.second(F.relu(self.first(hidden))))


class Residual(nn.Module):
    """A linear layer, rectified; residual blocks; a linear layer.

    Args:
        inputs: numbers that go in.
        width: units of the layers between.
        blocks: residual blocks.
        outputs: numbers that come out.
    """

    def __init__(self, inputs: int, width: int, blocks: int, outputs: int) -> None:
        super().__init__()
        self.input = nn.Linear(inputs, width)
        self.blocks = nn.ModuleList(Block(width) for _ in range(blocks))
        self.output = nn.Linear(width, outputs)

    def forward(self, numbers: Tensor) -> Tensor:
        """``[N, inputs]`` to ``[N, outputs]``."""
        hidden = F.relu(self.input(numbers))
        for block in self.blocks:
            hidden = block(hidden)
        out: Tensor = self.output(hidden)
        return out


class Waves(nn.Module):
    """Sums of sines of linear functions: ``output(sin(input(x)))``.

    The coefficients of a smooth thing that moves are waves in its position (as in a Fourier
    series), which rectified units would have to put together from many pieces.

    Args:
        inputs: numbers that go in.
        width: waves.
        outputs: numbers that come out.
    """

    def __init__(self, inputs: int, width: int, outputs: int) -> None:
        super().__init__()
        self.input = nn.Linear(inputs, width)
        self.output = nn.Linear(width, outputs)
        # States have numbers of about 1: waves of several lengths, at all phases.
        nn.init.normal_(self.input.weight)
        nn.init.uniform_(self.input.bias, -math.pi, math.pi)

    def forward(self, numbers: Tensor) -> Tensor:
        """``[N, inputs]`` to ``[N, outputs]``."""
        out: Tensor = self.output(torch.sin(self.input(numbers)))
        return out
