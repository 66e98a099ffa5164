"""Pairs of states of one episode, and pairs in which things are where another episode had them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray

from hvf.training.tracks.layers import LayerTracks
from hvf.training.tracks.pairs import MOVED, SLID, StatePairs

# Chance that two things are transplanted, and not one.
_TWO = 0.5
_THERE = 0.5


class Transplants:
    """Pairs of states, in a share of which one or two things are where another pair has them.

    Such things are sliders and parts that roam; the hand can be anywhere soon. Where the change is
    too small to see, a pair counts as what it was.

    Batches hold ``scenes`` and ``states``, float32 ``[N, X]``, ``steps`` from one to the other,
    int64 ``[N]``, and bool ``apart [N]``: whether the states are of two episodes.

    Args:
        pairs: of one episode each.
        tracks: what they are drawn from.
        share: of pairs that are changed, from 0 to 1.
        seed: of the draws.
    """

    def __init__(self, pairs: StatePairs, tracks: LayerTracks, share: float, seed: int) -> None:
        self._pairs, self._share, self._seed = pairs, share, seed
        self._hand, self._roaming = tracks.hand.stop, tracks.known.shape[2]

    def batch(self, step: int) -> Mapping[str, torch.Tensor]:
        """The batch of training step ``step``, a function of (seed, step)."""
        rng = np.random.default_rng([self._seed, step])
        own, other = (self._pairs.batch(2 * step + k) for k in range(2))
        states, donors = own["states"].numpy(), other["states"].numpy()
        count, size = states.shape
        roam = 3 * self._roaming
        things = size - self._hand - roam + self._roaming
        order = rng.permuted(np.tile(np.arange(things), (count, 1)), axis=1)
        chosen = order < 1 + (rng.random((count, 1)) < _TWO)
        chosen &= rng.random((count, 1)) < self._share
        sliders = things - self._roaming
        where = np.zeros((count, size), bool)
        where[:, self._hand : size - roam] = chosen[:, :sliders]
        where[:, size - roam :] = np.repeat(chosen[:, sliders:], 3, axis=1)
        changed = np.where(where, donors, states)
        return {
            **own,
            "states": torch.from_numpy(changed),
            "apart": torch.from_numpy(self._differ(states, changed)),
        }

    def _differ(self, a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Whether something can be seen to be elsewhere in states ``[N, X]``, ``[N]``."""
        roam = a.shape[1] - 3 * self._roaming
        slid: NDArray[np.bool_] = (np.abs(a - b)[:, self._hand : roam] > SLID).any(axis=1)
        first, second = (x[:, roam:].reshape(len(x), self._roaming, 3) for x in (a, b))
        there = [x[..., 2] > _THERE for x in (first, second)]
        moved = np.linalg.norm((first - second)[..., :2], axis=2) > MOVED
        differs = (there[0] != there[1]) | (there[0] & there[1] & moved)
        slid |= differs.any(axis=1)
        return slid
