"""From a file of episodes to training batches.

A full data set of decoded frames (12 GB for the maze) need not fit into memory: a pool holds a
window of decoded episodes that slides over an endless random order of them. What the pool holds at
a step depends on (seed, step) alone, so that a run can be resumed.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from hvf.data.formats import check_equal_lengths, open_episodes
from hvf.data.splits import Split, episodes_of


class EpisodePool:
    """Decoded episodes in memory.

    Args:
        path: file of episodes, of any registered format.
        split: which of its episodes, see :mod:`hvf.data.splits`: ``validation`` is the last
            twentieth (1 to 200 episodes), ``train`` the rest.
        environment: the environment that the file must be from.
        memory_gb: memory for decoded frames; when all episodes fit, they are all held.
        refresh: episodes exchanged at every step when they do not fit.
        seed: of the order in which episodes pass through the pool.
        camera: whose frames to read; the file's first one by default.

    Attributes:
        frames: uint8 ``[P, T+1, H, W, 3]``, the episodes that the pool holds now.
        actions: float32 ``[P, T, A]``.
        lengths: int64 ``[P]``, steps of each of them; what is after its end is zero.
        longest: steps of the longest episode of the split.
        metadata: where the episodes of the file come from.

    Raises:
        ValueError, FileNotFoundError: as :func:`~hvf.data.formats.open_episodes`; or an argument
            out of range.
    """

    def __init__(
        self,
        path: str | Path,
        split: Split = "train",
        *,
        environment: str | None = None,
        memory_gb: float = 2.0,
        refresh: int = 1,
        seed: int = 0,
        camera: str | None = None,
    ) -> None:
        if not (np.isfinite(memory_gb) and memory_gb > 0):
            raise ValueError(f"memory_gb must be positive, got {memory_gb}")
        if refresh < 0:
            raise ValueError(f"refresh must not be negative, got {refresh}")
        self._file = open_episodes(path, environment, camera=camera)
        self.metadata = self._file.metadata
        try:
            self._episodes = episodes_of(split, self.metadata)
        except ValueError as error:
            self._file.close()
            raise ValueError(f"{path}: {error}") from error
        self.longest = int(self._file.lengths[self._episodes].max())
        steps = self.metadata.steps
        episode = (steps + 1) * int(np.prod(self._file.frame_shape))
        total = len(self._episodes)
        capacity = max(1, min(total, int(memory_gb * 1e9 / episode)))
        self._refresh = 0 if capacity == total else refresh
        self._seed = seed
        self._orders: dict[int, NDArray[np.int64]] = {}
        self._held = np.full(capacity, -1)
        self.frames = np.empty((capacity, steps + 1, *self._file.frame_shape), np.uint8)
        self.actions = np.empty((capacity, steps, self._file.action_dim), np.float32)
        self.lengths = np.zeros(capacity, np.int64)

    def __len__(self) -> int:
        return len(self._held)

    def move_to(self, step: int) -> None:
        """Make the pool hold the episodes of training step ``step``, decoding what is new."""
        size = len(self._held)
        begin = step * self._refresh
        # Place q of the endless order lives in slot q % size.
        places = begin + (np.arange(size) - begin) % size
        wanted = np.array([self._episode(int(place)) for place in places[self._stale(places)]])
        for slot, episode in zip(np.flatnonzero(self._stale(places)), wanted, strict=True):
            self._file.read_into(int(episode), self.frames[slot], self.actions[slot])
            self.lengths[slot] = self._file.lengths[episode]
        self._held = places

    def frames_every(self, stride: int) -> NDArray[np.uint8]:
        """Each ``stride``-th frame of the episodes that the pool holds, without padding.

        Returns:
            uint8 ``[F, H, W, 3]``, one episode after another.

        Raises:
            ValueError: a stride below 1.
        """
        if stride < 1:
            raise ValueError(f"stride must be at least 1, got {stride}")
        times = np.arange(0, self.frames.shape[1], stride)
        chosen: NDArray[np.uint8] = self.frames[:, ::stride][times <= self.lengths[:, None]]
        return chosen

    def check_equal_lengths(self, what: str) -> None:
        """Refuse a file of episodes of different lengths, for what would take padding for frames.

        Raises:
            ValueError: they differ in length; names the file and ``what``.
        """
        check_equal_lengths(self._file, what)

    def long_enough(self, steps: int, what: str, step: int) -> NDArray[np.int64]:
        """Places in the pool of the episodes that have at least so many ``steps``.

        Raises:
            ValueError: there is none now, at training step ``step``; names ``what`` asks for it.
        """
        enough = np.flatnonzero(self.lengths >= steps)
        if not len(enough):
            raise ValueError(
                f"{what}: none of the {len(self)} episodes in memory at step {step} has "
                f"{steps} steps; hold more of them (memory_gb)"
            )
        return enough

    def close(self) -> None:
        """Close the file; what the pool holds stays."""
        self._file.close()

    def _stale(self, places: NDArray[np.int64]) -> NDArray[np.bool_]:
        return np.asarray(places != self._held)

    def _episode(self, place: int) -> int:
        """The episode at ``place`` of the endless order: one permutation after another."""
        lap, offset = divmod(place, len(self._episodes))
        if lap not in self._orders:
            rng = np.random.default_rng([self._seed, lap])
            self._orders = {
                **{old: order for old, order in self._orders.items() if old >= lap - 1},
                lap: rng.permutation(len(self._episodes)),
            }
        return self._episodes[int(self._orders[lap][offset])]


class PairSampler:
    """Two images of one episode: the scene, and an image that is possible in it.

    Batches hold ``scene`` and ``image``, uint8 ``[B, H, W, 3]``: an episode drawn uniformly, and
    two of its times.
    """

    def __init__(self, pool: EpisodePool, batch_size: int, seed: int = 0) -> None:
        if batch_size < 1:
            raise ValueError(f"batch_size must be at least 1, got {batch_size}")
        self._pool = pool
        self._batch_size = batch_size
        self._seed = seed

    def batch(self, step: int) -> Mapping[str, torch.Tensor]:
        """The batch of training step ``step``, a function of (seed, step)."""
        self._pool.move_to(step)
        rng = np.random.default_rng([self._seed, step])
        episodes = rng.integers(len(self._pool), size=self._batch_size)
        times = rng.integers(self._pool.lengths[episodes] + 1, size=(2, self._batch_size))
        frames = self._pool.frames
        return {
            "scene": torch.from_numpy(frames[episodes, times[0]]),
            "image": torch.from_numpy(frames[episodes, times[1]]),
        }


class WindowSampler:
    """Stretches of frames with the actions between them.

    Batches hold ``frames``, uint8 ``[B, L+1, H, W, 3]``, and ``actions``, float32 ``[B, L, A]``,
    for ``L`` = ``length``: an episode drawn uniformly among those that are long enough, and a start
    in it. With ``hold`` the frames are so many steps apart, and a stretch begins where an action
    begins that is held.
    """

    def __init__(
        self, pool: EpisodePool, batch_size: int, length: int, seed: int = 0, *, hold: int = 1
    ) -> None:
        for name, value in (("batch_size", batch_size), ("hold", hold)):
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        if not pool.actions.shape[2]:
            raise ValueError(
                "data: has no actions, nobody knows what was done; only generators of subgoals "
                "can learn from it"
            )
        if not 1 <= length <= pool.longest // hold:
            raise ValueError(f"length must be from 1 to {pool.longest // hold}, got {length}")
        self._pool = pool
        self._batch_size = batch_size
        self._length = length
        self._hold = hold
        self._seed = seed

    def batch(self, step: int) -> Mapping[str, torch.Tensor]:
        """The batch of training step ``step``, a function of (seed, step).

        Raises:
            ValueError: no episode that is in memory at this step is long enough.
        """
        self._pool.move_to(step)
        rng = np.random.default_rng([self._seed, step])
        enough = self._pool.long_enough(self._length * self._hold, "length", step)
        episodes = enough[rng.integers(len(enough), size=(self._batch_size, 1))]
        starts = rng.integers(self._pool.lengths[episodes] // self._hold - self._length + 1)
        times = (starts + np.arange(self._length + 1)) * self._hold
        return {
            "frames": torch.from_numpy(self._pool.frames[episodes, times]),
            "actions": torch.from_numpy(self._pool.actions[episodes, times[:, :-1]]),
        }
