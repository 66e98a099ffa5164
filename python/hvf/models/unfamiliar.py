"""Object models say so when they are shown a scene that they were not made for.

A model that knows the inventory of one scene finds a position for its parts in any image, of
anything: without a check it plans with nonsense and says nothing. Such a model measures how badly
it explains what it is shown (its `misfit`, 1 at its bound), and warns once.

A warning and not an error: what a scene may look like has no sharp border (a lamp lit, a new
camera's noise, images that a generator drew), the model itself is the only judge, and somebody who
tests how far a model carries has to be able to go on.

Of a call with several images a share of them has to be explained badly. Images come in calls by
kind: what is seen in many trials, or what a generator draws of one scene, where some are smudges.
And of all images so far more than half have to be in such calls, at least two: a single subgoal
that was drawn badly says nothing of the scene.
"""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray
from torch import nn

LOOKED_AT = 16
"""Images of a call that are looked at, at most."""
_LEAST = 2
"""Images that have to be explained badly."""


def every(count: int) -> slice:
    """Which of `count` images are looked at: spread evenly, all of them if they are few."""
    return slice(None, None, max(1, -(-count // LOOKED_AT)))


def warn_of_unfamiliar(
    model: nn.Module, misfit: NDArray[np.floating], expected: str, share: float = 0.5
) -> None:
    """Warn, once for each model, if more than a share of `misfit [N]` is above 1.

    In this call, and in calls with more than half of all images so far.

    Args:
        model: whose misfit it is.
        misfit: how badly it explains each image, 1 at its bound; NaN counts as badly.
        expected: what the model is made for, for the message.
        share: of the images, below 1.
    """
    if not len(misfit) or getattr(model, "_warned_of_unfamiliar", False):
        return
    deciding = float(np.sort(misfit)[int((1.0 - share) * (len(misfit) - 1))])
    seen, badly = getattr(model, "_images_seen", (0, 0))
    seen, badly = seen + len(misfit), badly + (0 if deciding <= 1.0 else len(misfit))
    model._images_seen = (seen, badly)  # type: ignore[assignment]
    if not deciding <= 1.0 and badly >= _LEAST and 2 * badly > seen:
        model._warned_of_unfamiliar = True  # type: ignore[assignment]
        warnings.warn(
            f"images: the model explains them badly ({deciding:.1f} times its bound), so what it "
            f"predicts in this scene means little. It is made for {expected}. This is said once.",
            UserWarning,
            stacklevel=3,
        )
