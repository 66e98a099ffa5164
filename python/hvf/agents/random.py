"""Actions drawn uniformly from the box: the floor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hvf.agents.direct import DirectAgent
from hvf.protocols import Decision, Images, Indices


class RandomAgent(DirectAgent):
    """Acts at random; has no subgoals.

    Args:
        low: lowest action, ``[A]``.
        high: highest action, ``[A]``.
    """

    def __init__(self, low: NDArray[np.float32], high: NDArray[np.float32]) -> None:
        super().__init__()
        self.low = low
        self.high = high

    def act(
        self, which: Indices, observations: Images, aims: Indices, seeds: Sequence[int]
    ) -> Decision:
        """Return random actions."""
        draws = [np.random.default_rng(seed).uniform(self.low, self.high) for seed in seeds]
        return Decision(np.stack(draws).astype(np.float32))
