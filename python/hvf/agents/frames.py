"""Frames of any world: images, what a world makes of images, and several in one batch."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hvf.protocols import Frames, Images, Remembering


def observed(world: Any, images: Images) -> Any:
    """What a world makes of ``images[N, H, W, 3]``: its own frames, or the images as they are."""
    observe = getattr(world, "observe", None)
    return images if observe is None else observe(images)


def remembered(world: Remembering[Any], history: Images, actions: NDArray[np.float32]) -> Any:
    """What a world with context makes of the last of its images, ``[N]``.

    Args:
        world: looks ``C`` frames back.
        history: images uint8 ``[N, L, H, W, 3]``, the last one being now. The first one is repeated
            where they are too few.
        actions: between them, float32 ``[N, L - 1, A]``.
    """
    missing = max(0, world.context - history.shape[1])
    images = np.concatenate([history[:, :1].repeat(missing, axis=1), history], axis=1)
    before = np.zeros((len(history), missing, actions.shape[2]), np.float32)
    done = np.concatenate([before, actions], axis=1)
    first = images.shape[1] - world.context
    return world.observe_history(images[:, first:], done[:, first:])


def begun(world: Any, images: Images) -> Any:
    """What a world starts from where trials have just begun: they see ``images[N, H, W, 3]``.

    For a world with context (:class:`~hvf.protocols.Remembering`) nothing moved before.
    """
    remembers = isinstance(world, Remembering)
    if not remembers:
        return observed(world, images)
    nothing = np.zeros((len(images), 0, len(world.action_low)), np.float32)
    return remembered(world, images[:, None], nothing)


def has_images(frames: Any) -> bool:
    """Whether frames are images, or keep those that they come from."""
    images = getattr(frames, "images", frames)
    return isinstance(images, np.ndarray) and images.dtype == np.uint8 and images.ndim == 4


def images_of(frames: Frames, world: Any = None) -> Images:
    """The images of frames, uint8 ``[N, H, W, 3]``.

    Args:
        frames: images, frames that keep ``images``, or frames that ``world.images`` draws.
        world: the world that they are of.

    Raises:
        TypeError: frames that are none of these.
    """
    if has_images(frames):
        return np.asarray(getattr(frames, "images", frames))
    draw = getattr(world, "images", None)
    if draw is None:
        kind = type(frames).__name__
        raise TypeError(
            f"frames: expected uint8 images, frames with such images, or a world that draws them "
            f"with images(frames); got {kind}"
        )
    images = np.asarray(draw(frames))
    if images.dtype != np.uint8 or images.ndim != 4:
        raise TypeError(
            f"images: must give uint8 [N, H, W, 3], got {images.dtype} {list(images.shape)}"
        )
    return images


def joined(parts: Sequence[Any], world: Any = None) -> Any:
    """Batches of frames as one batch.

    NumPy arrays and torch tensors are joined as they are; a world with frames of another class
    has ``join(parts)``.

    Raises:
        TypeError: frames that nobody can join.
    """
    first = parts[0]
    if len(parts) == 1:
        return first
    if isinstance(first, np.ndarray):
        return np.concatenate(parts)
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(first, torch.Tensor):
        return torch.cat(list(parts))
    join = getattr(world, "join", None)
    if join is None:
        kind = type(first).__name__
        raise TypeError(
            f"frames: {kind} of several trials cannot be joined; the world needs join(parts)"
        )
    return join(parts)
