"""Pairs of states of one episode, and pairs in which things are where other episodes had them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray

from hvf.models.layers.states import THERE
from hvf.training.tracks.layers import LayerTracks
from hvf.training.tracks.pairs import MOVED, PLACED, SLID, StatePairs

# Chance that a thing is transplanted, and that a part is gone then.
_EACH, _GONE = 0.5, 0.25
# Places of parts that count as one, pixels, and of sliders, parts of their way.
_PIXELS, _WAY = 4.0, 0.1

Floats = NDArray[np.float32]


class Transplants:
    """Pairs of states, in a share of which things are where other episodes have them.

    Each slider and each part that roams is transplanted with an even chance, from anywhere in the
    data, rare places as often as common ones: if a thing is somewhere as rarely in its own episode
    as in others, whose it is says nothing of how long it takes to get there. The hand can be
    anywhere soon.

    Batches hold ``scenes`` and ``states``, float32 ``[N, X]``, ``steps`` from one to the other,
    int64 ``[N]``, and bool ``transplanted [N, G + R]``: which sliders and parts can be seen to be
    elsewhere than where their own episode has them.

    Args:
        pairs: of one episode each.
        tracks: what they are drawn from.
        share: of pairs that are changed, from 0 to 1.
        seed: of the draws.
    """

    def __init__(self, pairs: StatePairs, tracks: LayerTracks, share: float, seed: int) -> None:
        self._pairs, self._share, self._seed = pairs, share, seed
        states = tracks.truth.reshape(-1, tracks.truth.shape[2])
        self._roaming = tracks.known.shape[2]
        self._hand, self._fixed = tracks.hand.stop, states.shape[1] - 3 * self._roaming
        parts = states[:, self._fixed :].reshape(-1, self._roaming, 3)
        placed = tracks.known.reshape(-1, self._roaming) == PLACED
        self._places = _Evenly(parts[placed][:, :2], _PIXELS)
        self._slides = [
            _Evenly(states[:, [slider]], _WAY) for slider in range(self._hand, self._fixed)
        ]

    def batch(self, step: int) -> Mapping[str, torch.Tensor]:
        """The batch of training step ``step``, a function of (seed, step)."""
        rng = np.random.default_rng([self._seed, step])
        own = self._pairs.batch(step)
        states = own["states"].numpy()
        count = len(states)
        changed = rng.random((count, 1)) < self._share
        things = self._fixed - self._hand + self._roaming
        chosen = changed & (rng.random((count, things)) < _EACH)
        elsewhere = states.copy()
        for number, slides in enumerate(self._slides):
            elsewhere[:, self._hand + number] = slides.draw(rng, count)[:, 0]
        parts = elsewhere[:, self._fixed :].reshape(count, self._roaming, 3)
        parts[..., :2] = self._places.draw(rng, count * self._roaming).reshape(count, -1, 2)
        parts[..., 2] = rng.random((count, self._roaming)) >= _GONE
        elsewhere[:, self._fixed :] = parts.reshape(count, -1)
        where = np.zeros(states.shape, bool)
        sliders = self._fixed - self._hand
        where[:, self._hand : self._fixed] = chosen[:, :sliders]
        where[:, self._fixed :] = np.repeat(chosen[:, sliders:], 3, axis=1)
        found = np.where(where, elsewhere, states)
        return {
            **own,
            "states": torch.from_numpy(found),
            "transplanted": torch.from_numpy(self._differ(states, found)),
        }

    def _differ(self, a: Floats, b: Floats) -> NDArray[np.bool_]:
        """Which things can be seen to be elsewhere in states ``[N, X]``: ``[N, G + R]``."""
        slid = np.abs(a - b)[:, self._hand : self._fixed] > SLID
        first, second = (x[:, self._fixed :].reshape(len(x), self._roaming, 3) for x in (a, b))
        there = [x[..., 2] > THERE for x in (first, second)]
        moved = np.linalg.norm((first - second)[..., :2], axis=2) > MOVED
        differs = (there[0] != there[1]) | (there[0] & there[1] & moved)
        return np.concatenate([slid, differs], axis=1)


class _Evenly:
    """Draws from ``values [N, D]``, every cell of so many units of them as often."""

    def __init__(self, values: Floats, cell: float) -> None:
        _, cells = np.unique(np.round(values / cell).astype(np.int64), axis=0, return_inverse=True)
        order = np.argsort(cells.ravel(), kind="stable")
        self._values = values[order]
        self._counts = np.bincount(cells.ravel())
        self._firsts = np.cumsum(self._counts) - self._counts

    def draw(self, rng: np.random.Generator, count: int) -> Floats:
        """Values ``[count, D]``."""
        cells = rng.integers(len(self._counts), size=count)
        drawn: Floats = self._values[self._firsts[cells] + rng.integers(self._counts[cells])]
        return drawn
