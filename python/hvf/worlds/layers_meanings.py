"""What an image of the desk may mean: a part that is not seen may be gone, or behind the arm."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from hvf.models.layers.perception import LayerPerception
from hvf.models.layers.states import THERE

# Opacity of the arm, over the place of a part, from which on it may hide it.
_COVERED = 0.6


def meanings(perception: LayerPerception, start: Tensor, goal: Tensor) -> Tensor:
    """States `[N, X]` that what is seen of `goal [X]` may mean after `start [X]`.

    A part that is not seen in the goal is gone, or, where the arm covers the place that it had in
    the start, it may still be there.
    """
    count = perception.config.roaming
    was, seen = (states[-3 * count :].reshape(count, 3) for states in (start, goal))
    covered = perception.covered(goal[None], was[None, :, :2])[0]
    gone = was * was.new_tensor([1.0, 1.0, 0.0])
    choices = []
    for part in range(count):
        if seen[part, 2] > THERE:
            choices.append([seen[part]])
        elif was[part, 2] <= THERE or covered[part] <= _COVERED:
            choices.append([gone[part]])
        else:
            choices.append([gone[part], was[part]])
    fixed = goal[: -3 * count]
    return torch.stack([torch.cat([fixed, *each]) for each in itertools.product(*choices)])
