"""Numbers of steps in classes that double in width: what temporal distances tell apart.

Class 0 is no step, class `c` from `2^(c-1)` to `2^c - 1` steps, the last also everything beyond:
about the binary logarithm of twice the number of steps.
"""

from __future__ import annotations

import torch
from torch import Tensor


def class_of(steps: Tensor, classes: int) -> Tensor:
    """Class `[N]`, int64, of numbers of steps `[N]`, of so many `classes`."""
    doublings = torch.log2(steps.clamp_min(1).double()).floor().long() + 1
    return torch.where(steps > 0, doublings, 0).clamp_max(classes - 1)


def expected_class(logits: Tensor) -> Tensor:
    """Expected class `[...]` of `logits [..., classes]`."""
    probabilities = logits.softmax(dim=-1)
    classes = torch.arange(
        probabilities.shape[-1], dtype=probabilities.dtype, device=probabilities.device
    )
    return probabilities @ classes
