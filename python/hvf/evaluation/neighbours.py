"""The nearest of recorded frames: what a drawn image is compared with.

Distances are those of the planning cost: squared L2 of colours in [0, 1], per pixel.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

import hvf_core
from hvf.data.formats import EpisodeReader
from hvf.protocols import Images


@dataclasses.dataclass(frozen=True)
class Neighbours:
    """The frames that are nearest to some images, one each.

    Attributes:
        images: uint8 ``[Q, H, W, 3]``.
        episodes: their episodes, int64 ``[Q]``.
        times: their numbers in these, int64 ``[Q]``.
        distances: to the images, float64 ``[Q]``.
    """

    images: Images
    episodes: NDArray[np.int64]
    times: NDArray[np.int64]
    distances: NDArray[np.float64]

    def facts(self) -> list[dict[str, Any]]:
        """Where each is, and how far; JSON's types."""
        found = zip(self.episodes, self.times, self.distances, strict=True)
        return [{"episode": int(e), "frame": int(t), "distance": float(d)} for e, t, d in found]


def nearest_frames(file: EpisodeReader, episodes: Iterable[int], images: Images) -> Neighbours:
    """The frames of some episodes that are nearest to ``images``; of equal ones the first.

    Args:
        file: where the episodes are.
        episodes: their numbers.
        images: uint8 ``[Q, H, W, 3]``, of the size of the frames.

    Raises:
        ValueError: images of another size, or no episodes.
    """
    count = len(images)
    found = Neighbours(
        np.empty_like(images),
        np.full(count, -1),
        np.full(count, -1),
        np.full(count, np.inf),
    )
    for number in episodes:
        frames = frames_of(file, number)
        distances = frame_distances(images, frames)
        times = distances.argmin(axis=1)
        least = distances[np.arange(count), times]
        nearer = least < found.distances
        found.images[nearer] = frames[times[nearer]]
        found.episodes[nearer] = number
        found.times[nearer] = times[nearer]
        found.distances[nearer] = least[nearer]
    if (found.episodes < 0).any():
        raise ValueError(f"{file.path}: there are no episodes to look for neighbours in")
    return found


def frame_distances(images: Images, frames: Images) -> NDArray[np.float64]:
    """How far each of ``images [Q, H, W, 3]`` is from each of ``frames [N, H, W, 3]``: ``[Q, N]``.

    Raises:
        ValueError: images of different sizes.
    """
    if images.shape[1:] != frames.shape[1:]:
        raise ValueError(
            f"images: are {list(images.shape[1:3])}, frames are {list(frames.shape[1:3])}"
        )
    a, b = np.ascontiguousarray(images), np.ascontiguousarray(frames)
    distances: NDArray[np.float64] = hvf_core.image_cost(a, b, mode="all_pairs")
    return distances.reshape(len(images), len(frames))


def frames_of(file: EpisodeReader, number: int) -> Images:
    """The frames of an episode, uint8 ``[length + 1, H, W, 3]``, without padding."""
    episode = file.read(number, 1)
    return episode.frames[0, : int(episode.lengths[0]) + 1]
