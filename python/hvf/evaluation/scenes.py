"""Whether drawn images keep the scene of the image that they were drawn for.

Held-out episodes are scenes: an episode's frames show one place, whatever moves in it. For each of
them, a generator draws images given its first frame (the *conditioning image*). A drawn image
*keeps the scene* if, of all held-out episodes, the one with the frame nearest to it is its own;
the conditioning image itself does not count as a frame of its own episode. A generator that draws
the same for every scene is right once in as many times as there are episodes.

The same is asked of *retrieved* images: frames, at random times, of that training episode which
has the frame nearest to the conditioning image. That is what drawing by remembering would give. And
of the conditioning image *copied*, which keeps the scene and is no subgoal.

Distances are those of the planning cost: squared L2 of colours in [0, 1], per pixel. Letters in
shapes: ``E`` held-out episodes, ``S`` images.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hvf.data.formats import EpisodeReader
from hvf.evaluation.neighbours import frame_distances, frames_of, nearest_frames
from hvf.protocols import Images


def scene_figures(images: Images, own: int, episodes: Sequence[Images]) -> dict[str, float]:
    """How far images are from their own scene and from others.

    Args:
        images: drawn for the first frame of episode ``own``, uint8 ``[S, H, W, 3]``.
        own: number of their episode among ``episodes``.
        episodes: frames of all held-out episodes, uint8 ``[T+1, H, W, 3]`` each, at least two.

    Returns:
        ``kept``, the part of the images whose nearest episode is their own; ``own`` and ``other``,
        mean distances to the nearest frame of their own episode and of any other;
        ``conditioning``, to the conditioning image; and ``spread``, between two of the images.
    """
    if len(episodes) < 2:
        raise ValueError("episodes: a scene is told from others; needs at least 2 episodes")
    frames = [episode[1:] if i == own else episode for i, episode in enumerate(episodes)]
    nearest = np.stack([frame_distances(images, part).min(axis=1) for part in frames])
    others = np.delete(nearest, own, axis=0).min(axis=0)
    return {
        "kept": float((nearest[own] < others).mean()),
        "own": float(nearest[own].mean()),
        "other": float(others.mean()),
        "conditioning": float(frame_distances(images, episodes[own][:1]).mean()),
        "spread": spread(images),
    }


def spread(images: Images) -> float:
    """Mean distance between two different ones of ``images [S, H, W, 3]``; 0 for a single one."""
    count = len(images)
    if count < 2:
        return 0.0
    return float(frame_distances(images, images).sum() / (count * (count - 1)))


def retrieved(
    file: EpisodeReader,
    training: Sequence[int],
    conditioning: Images,
    count: int,
    seed: Sequence[int],
) -> Images:
    """What remembering would draw: frames of the training episode that is most like an image.

    Args:
        file: where the training episodes are.
        training: their numbers.
        conditioning: the image, uint8 ``[H, W, 3]``.
        count: how many to draw, with repeats if the episode is shorter.
        seed: of the times.

    Returns:
        uint8 ``[count, H, W, 3]``.
    """
    found = nearest_frames(file, training, conditioning[None])
    frames = frames_of(file, int(found.episodes[0]))
    times: NDArray[np.int64] = np.random.default_rng(seed).integers(len(frames), size=count)
    return np.asarray(frames[times])


def mean_figures(each: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Means of figures over episodes."""
    return {key: float(np.mean([figures[key] for figures in each])) for key in each[0]}
