"""Layers of SV2P as TensorFlow 1 has them: normalisation, padding, the convolutional LSTM, CDNA."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

_SHIFT = 1e-12


def layer_norm(channels: int) -> nn.GroupNorm:
    """``tf.contrib.layers.layer_norm``: over channels and pixels, a scale and a bias a channel."""
    return nn.GroupNorm(1, channels, eps=1e-12)


class Down(nn.Conv2d):
    """A convolution of stride 2 with TensorFlow's ``SAME`` padding, for even sizes.

    An odd padding has its larger half below and to the right.
    """

    def __init__(self, inputs: int, outputs: int, kernel: int) -> None:
        super().__init__(inputs, outputs, kernel, stride=2)
        padding = kernel - 2
        self._sides = (padding // 2, padding - padding // 2) * 2

    def forward(self, x: Tensor) -> Tensor:
        """``[N, inputs, H, W]`` to ``[N, outputs, H / 2, W / 2]``."""
        return super().forward(F.pad(x, self._sides))


class Up(nn.ConvTranspose2d):
    """Twice the size: a transposed convolution, ReLU.

    The original is not padded, and drops the first row and column of ``2 n + 1``: the same as a
    padding of 1 on all sides and one more row and column at the end.
    """

    def __init__(self, channels: int) -> None:
        super().__init__(channels, channels, 3, stride=2, padding=1, output_padding=1)

    def forward(self, x: Tensor, output_size: list[int] | None = None) -> Tensor:
        """``[N, C, H, W]`` to ``[N, C, 2 H, 2 W]``."""
        return F.relu(super().forward(x, output_size))


class ConvLSTM(nn.Module):
    """``tf.contrib.rnn.ConvLSTMCell``: one convolution makes the gates i, j, f and o of [x, h].

    The forget gate has a bias of 1 beside the learned one.
    """

    def __init__(self, inputs: int, outputs: int, kernel: int) -> None:
        super().__init__()
        self.gates = nn.Conv2d(inputs + outputs, 4 * outputs, kernel, padding=kernel // 2)

    def forward(self, x: Tensor, cell: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """The next cell and hidden state, ``[N, outputs, H, W]``, of ``x [N, inputs, H, W]``."""
        gates = self.gates(torch.cat([x, hidden], dim=1)).chunk(4, dim=1)
        # Channels last, a gate is a few numbers of every pixel: vector units want it in one piece.
        i, j, f, o = (gate.contiguous(memory_format=torch.channels_last) for gate in gates)
        cell = torch.sigmoid(f + 1) * cell + torch.sigmoid(i) * torch.tanh(j)
        return cell, torch.tanh(cell) * torch.sigmoid(o)


class MovedImages(nn.Module):
    """CDNA: the last image moved in several ways, by kernels that are the same for all pixels.

    Kernels are not negative and sum to 1. There are ``count`` of them, of which the last is made
    and never used, as in the original, whose sum over masks ends before it.
    """

    def __init__(self, inputs: int, count: int, width: int) -> None:
        super().__init__()
        self.kernels = nn.Linear(inputs, count * width * width)
        self._shape = (count, width, width)

    def normalised(self, features: Tensor) -> Tensor:
        """Kernels that are used, ``[N, count - 1, width, width]``, of ``features [N, inputs]``."""
        raw = self.kernels(features).float().reshape(-1, *self._shape)[:, :-1]
        positive = F.relu(raw - _SHIFT) + _SHIFT
        return positive / positive.sum(dim=(2, 3), keepdim=True)

    def forward(self, image: Tensor, features: Tensor, masks: Tensor) -> Tensor:
        """The sum of moved images, each times its mask.

        Which is summed up the other way round: the masks times the kernels are one kernel a pixel,
        and the image is moved once.

        Args:
            image: ``[N, 3, H, W]``.
            features: ``[N, inputs]``.
            masks: ``[N, count - 1, H, W]``.
        """
        kernels = self.normalised(features).flatten(2)
        height, width = image.shape[2:]
        side = self._shape[1]
        padded = F.pad(image, (side // 2,) * 4)
        total = torch.zeros_like(image)
        # Colours have 8 bits, as many as bfloat16 has.
        with torch.autocast(image.device.type, enabled=False):
            per_pixel = kernels.transpose(1, 2) @ masks.flatten(2)
            per_pixel = per_pixel.reshape(len(image), -1, height, width)
            for tap in range(side * side):
                y, x = divmod(tap, side)
                shifted = padded[:, :, y : y + height, x : x + width]
                total = torch.addcmul(total, shifted, per_pixel[:, tap, None])
        return total


@torch.no_grad()
def initialise(module: nn.Module, gain: float = 1.3) -> None:
    """``uniform_unit_scaling``: uniform with a variance of gain / mean of inputs and outputs."""
    for layer in module.modules():
        if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d | nn.Linear):
            taps = layer.weight[0, 0].numel()
            limit = math.sqrt(3 * gain / (taps * sum(layer.weight.shape[:2]) / 2))
            nn.init.uniform_(layer.weight, -limit, limit)
            assert layer.bias is not None
            nn.init.zeros_(layer.bias)
