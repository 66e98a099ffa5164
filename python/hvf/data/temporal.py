"""Training batches of frames of one episode that lie some steps apart.

Drawn as in the released code of Nair & Finn (2020): google-research, ``hierarchical_foresight``,
``utils.py``.

Letters in shapes: ``B`` samples, ``C`` candidates, ``H x W`` pixels.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray

from hvf.data.loader import EpisodePool


def doubling_steps(rng: np.random.Generator, longest: int, count: int) -> NDArray[np.int64]:
    """Numbers of steps ``[count]`` from 0 to ``longest``; 0, 1, 2 to 3, 4 to 7 ... as often."""
    drawn = np.exp2(rng.uniform(-1, np.log2(longest + 1), count))
    steps: NDArray[np.int64] = drawn.astype(np.int64)
    return steps


class BetweenSampler:
    """Two frames of an episode, and frames between them: what time-agnostic prediction learns from.

    Batches hold ``start`` and ``end``, uint8 ``[B, H, W, 3]``, and ``candidates``, uint8
    ``[B, C, H, W, 3]``: all frames from ``margin`` steps after the start to ``margin + 1`` before
    the end, in order. Where these are fewer than ``C``, the last one is repeated, which changes no
    minimum over them. An episode is drawn uniformly among those of more than ``furthest`` steps,
    then a start that has so many steps after it, then the steps to the end.

    Args:
        pool: episodes, of equal lengths or not.
        batch_size: samples per step, ``B``.
        nearest: fewest steps from start to end.
        furthest: most steps from start to end.
        margin: steps at both ends in which no candidate lies.
        seed: of all choices.

    Raises:
        ValueError: a number out of range, or episodes that are all too short.
    """

    def __init__(
        self,
        pool: EpisodePool,
        batch_size: int,
        nearest: int = 12,
        furthest: int = 19,
        margin: int = 5,
        seed: int = 0,
    ) -> None:
        if batch_size < 1:
            raise ValueError(f"batch_size must be at least 1, got {batch_size}")
        if margin < 0 or nearest <= 2 * margin:
            raise ValueError(
                f"nearest must be above twice the margin, {2 * margin}, so that a frame lies "
                f"between; got {nearest}"
            )
        if furthest < nearest:
            raise ValueError(f"furthest must be at least nearest, {nearest}; got {furthest}")
        # A start has a step to spare after it, as in the released code.
        self._needed = furthest + 1
        if pool.longest < self._needed:
            raise ValueError(
                f"furthest: the longest episode has {pool.longest} steps, which is fewer than "
                f"furthest + 1 = {self._needed}"
            )
        self._pool = pool
        self._batch_size = batch_size
        self._nearest, self._furthest, self._margin = nearest, furthest, margin
        self._seed = seed

    def batch(self, step: int) -> Mapping[str, torch.Tensor]:
        """The batch of training step ``step``, a function of (seed, step).

        Raises:
            ValueError: no episode that is in memory at this step is long enough.
        """
        self._pool.move_to(step)
        rng = np.random.default_rng([self._seed, step])
        enough = self._pool.long_enough(self._needed, "furthest", step)
        episodes = enough[rng.integers(len(enough), size=(self._batch_size, 1))]
        starts = rng.integers(self._pool.lengths[episodes] - self._furthest)
        ends = starts + rng.integers(self._nearest, self._furthest + 1, size=starts.shape)
        most = self._furthest - 2 * self._margin
        between = np.minimum(starts + self._margin + np.arange(most), ends - self._margin - 1)
        frames = self._pool.frames
        return {
            "start": torch.from_numpy(frames[episodes[:, 0], starts[:, 0]]),
            "end": torch.from_numpy(frames[episodes[:, 0], ends[:, 0]]),
            "candidates": torch.from_numpy(frames[episodes, between]),
        }


class PartnersSampler:
    """A frame of an episode, and two others of it: what the temporal distance learns from.

    Batches hold ``anchor``, ``first`` and ``second``, uint8 ``[B, H, W, 3]``, and
    ``steps``, int64 ``[B, 2]``: how many steps after the anchor the two are, negative before it.
    The anchor is any frame of any episode; the others are uniformly up to ``furthest`` steps from
    it, where the episode ends before that its first or last frame.

    Args:
        pool: episodes, of equal lengths or not.
        batch_size: samples per step, ``B``.
        furthest: most steps between an anchor and another frame.
        seed: of all choices.

    Raises:
        ValueError: a number out of range.
    """

    def __init__(
        self, pool: EpisodePool, batch_size: int, furthest: int = 30, seed: int = 0
    ) -> None:
        for name, value in (("batch_size", batch_size), ("furthest", furthest)):
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        self._pool = pool
        self._batch_size = batch_size
        self._furthest = furthest
        self._seed = seed

    def batch(self, step: int) -> Mapping[str, torch.Tensor]:
        """The batch of training step ``step``, a function of (seed, step)."""
        self._pool.move_to(step)
        rng = np.random.default_rng([self._seed, step])
        episodes = rng.integers(len(self._pool), size=self._batch_size)
        last = self._pool.lengths[episodes]
        anchors = rng.integers(last + 1)
        apart = rng.uniform(-self._furthest, self._furthest, size=(2, self._batch_size))
        # Cut to whole steps after the ends of the episode, as the released code does: an even
        # chance for every frame but the ends, which stand for all beyond.
        others = np.clip(anchors + apart, 0, last).astype(np.int64)
        frames = self._pool.frames
        return {
            "anchor": torch.from_numpy(frames[episodes, anchors]),
            "first": torch.from_numpy(frames[episodes, others[0]]),
            "second": torch.from_numpy(frames[episodes, others[1]]),
            "steps": torch.from_numpy((others - anchors).T.copy()),
        }
