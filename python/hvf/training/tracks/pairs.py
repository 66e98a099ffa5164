"""Pairs of states of one episode, one later than the other, rare changes beside common ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from hvf.training.tracks.layers import LayerTracks

Ahead: TypeAlias = Callable[[np.random.Generator, int], NDArray[np.int64]]
"""Draws numbers of steps from one frame to another, so many of them."""

# Pairs to a first frame, and of all.
_AHEAD, _MOST_PAIRS = 8, 4_000_000
# Shares of pairs in which the hand alone moves, something slides, a part moves, a part is gone.
_SHARES = (0.2, 0.25, 0.35, 0.2)
# A slider that moved by more of its way slid; a part that moved by more pixels moved.
SLID, MOVED = 0.05, 1.5
# What is known of a part (:class:`~hvf.training.tracks.layers.LayerTracks`).
GONE, PLACED = 1, 2


def within_reach(rng: np.random.Generator, count: int) -> NDArray[np.int64]:
    """Steps ``[count]`` as far as a plan reaches, and twice that: 5 to 30, each as often."""
    return rng.integers(5, 31, size=count)


class StatePairs:
    """Two states of one episode, a scene and what it is later, in balance.

    Most of what play does is to move the hand. Pairs are sorted by the rarest thing that changes
    between them (a part is gone; a part moved; something slid; nothing but the hand), and each
    kind is drawn with a share of its own, so that the generator learns, and its
    likelihood measures, the rare as well as the common. Parts change places at random: what one
    does is as likely of the others.

    Batches hold ``scenes`` and ``states``, float32 ``[N, X]``, and ``steps`` from one to the other,
    int64 ``[N]``.

    Args:
        tracks: recorded episodes.
        count: pairs per step.
        seed: of the draws.
        shares: of the four kinds, from the most common to the rarest.
        ahead: draws the steps between two states; where an episode ends before, they are fewer.

    Raises:
        ValueError: no pair whose parts are all known.
    """

    def __init__(
        self,
        tracks: LayerTracks,
        count: int,
        seed: int,
        shares: tuple[float, float, float, float] = _SHARES,
        ahead: Ahead = within_reach,
    ) -> None:
        self._tracks, self._count, self._seed = tracks, count, seed
        self._shares = shares
        pairs = _pairs(tracks, np.random.default_rng([seed, len(tracks.truth)]), ahead)
        if not pairs.shape[1]:
            raise ValueError("tracks: no two frames in which all parts are known, one later")
        kinds = changes(tracks, pairs)
        self._kinds = [pairs[:, kinds == kind] for kind in range(len(shares))]

    def batch(self, step: int) -> Mapping[str, torch.Tensor]:
        """The batch of training step ``step``, a function of (seed, step)."""
        rng = np.random.default_rng([self._seed, step])
        there = [pairs.shape[1] > 0 for pairs in self._kinds]
        shares = np.array(self._shares) * there
        counts = rng.multinomial(self._count, shares / shares.sum())
        drawn = [
            pairs[:, rng.integers(pairs.shape[1], size=count)]
            for pairs, count in zip(self._kinds, counts, strict=True)
            if count
        ]
        episode, first, later = np.concatenate(drawn, axis=1)
        truth, parts = self._tracks.truth, self._tracks.parts
        roaming = self._tracks.known.shape[2]
        order = rng.permuted(np.tile(np.arange(roaming), (self._count, 1)), axis=1)
        found = {"scenes": truth[episode, first], "states": truth[episode, later]}
        for states in list(found.values()):
            each = states[:, parts].reshape(self._count, roaming, 3)
            mixed = np.take_along_axis(each, order[:, :, None], axis=1)
            states[:, parts] = mixed.reshape(self._count, -1)
        found["steps"] = later - first
        return {name: torch.from_numpy(array) for name, array in found.items()}


def _pairs(tracks: LayerTracks, rng: np.random.Generator, ahead: Ahead) -> NDArray[np.int64]:
    """Episodes, first and later frames ``[3, N]`` of pairs in which all parts are known."""
    sure: NDArray[np.bool_] = np.asarray((tracks.known > 0).all(axis=2))
    starts, last = np.argwhere(sure[:, :-1]), tracks.actions.shape[1]
    starts = starts[rng.integers(len(starts), size=min(_AHEAD * len(starts), _MOST_PAIRS))]
    episode, first = starts.T
    later = np.minimum(first + ahead(rng, len(starts)), last)
    pairs: NDArray[np.int64] = np.stack([episode, first, later])
    return pairs[:, sure[pairs[0], pairs[2]]]


def changes(tracks: LayerTracks, pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """What changes in ``pairs [3, N]`` (episodes, first and later frames), ``[N]``.

    Returns:
        0 where it is the hand alone, 1 where something slid, 2 where a part moved, 3 where one is
        gone; of several the last.
    """
    episode, first, later = pairs
    kinds = np.zeros(pairs.shape[1], np.int64)
    before, after = (tracks.truth[episode, frame] for frame in (first, later))
    known, then = (tracks.known[episode, frame] for frame in (first, later))
    sliders = slice(tracks.hand.stop, tracks.parts.start)
    kinds[(np.abs(after - before)[:, sliders] > SLID).any(axis=1)] = 1
    apart = (after - before)[:, tracks.parts].reshape(*known.shape, 3)[..., :2]
    both = (known == PLACED) & (then == PLACED)
    kinds[(both & (np.linalg.norm(apart, axis=2) > MOVED)).any(axis=1)] = 2
    kinds[((known == PLACED) & (then == GONE)).any(axis=1)] = 3
    return kinds
