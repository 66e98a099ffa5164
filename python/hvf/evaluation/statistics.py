"""Success rates with intervals, and what two methods differ by.

All intervals are of 95% and are built from Wilson's score interval of one rate, so that they say
the same of the same numbers: Newcombe's "method 10" for two rates, of separate episodes
(Statistics in Medicine 17:873-890, 1998) or of the same ones (17:2635-2650, 1998).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """95% confidence interval of a success rate (Wilson score interval).

    Raises:
        ValueError: no trials, or more successes than trials.
    """
    from scipy import stats  # slow to import, and every command imports this file

    if not 0 <= successes <= trials or trials == 0:
        raise ValueError(f"successes: must be from 0 to {trials} of 1 or more, got {successes}")
    interval = stats.binomtest(successes, trials).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def difference_interval(
    successes: int, trials: int, other_successes: int, other_trials: int
) -> tuple[float, float]:
    """95% confidence interval of one rate less another, of separate episodes.

    Newcombe's hybrid score interval (method 10 of his eleven for independent samples).

    Raises:
        ValueError: no trials, or more successes than trials.
    """
    low, high = wilson_interval(successes, trials)
    other_low, other_high = wilson_interval(other_successes, other_trials)
    rate, other_rate = successes / trials, other_successes / other_trials
    difference = rate - other_rate
    return (
        difference - math.hypot(rate - low, other_high - other_rate),
        difference + math.hypot(high - rate, other_rate - other_low),
    )


@dataclass(frozen=True)
class Paired:
    """Two methods, ``a`` and ``b``, on the same episodes.

    Attributes:
        n: episodes.
        both: that both did.
        only_a: that only ``a`` did.
        only_b: that only ``b`` did.
        neither: that neither did.
        difference: success rate of ``a`` less that of ``b``.
        low: of its 95% confidence interval (Newcombe's method 10 for paired data).
        high: of the same.
        p: McNemar's exact two-sided p: how likely episodes of which just one method did are to be
            shared between the two so unevenly, or more, if neither is better.
    """

    n: int
    both: int
    only_a: int
    only_b: int
    neither: int
    difference: float
    low: float
    high: float
    p: float

    @classmethod
    def of_counts(cls, both: int, only_a: int, only_b: int, neither: int) -> Paired:
        """From the numbers of episodes.

        Raises:
            ValueError: a negative number, or no episodes.
        """
        from scipy import stats

        counts = (both, only_a, only_b, neither)
        if min(counts) < 0 or not sum(counts):
            raise ValueError(f"counts: must be 0 or more, and one at least, got {counts}")
        low, high = _newcombe_paired(*counts)
        odd = only_a + only_b
        p = float(stats.binomtest(only_a, odd).pvalue) if odd else 1.0
        n = sum(counts)
        return cls(n, *counts, (only_a - only_b) / n, low, high, p)


def paired(a: Mapping[int, bool], b: Mapping[int, bool], *, common: bool = False) -> Paired:
    """Two methods on the same episodes.

    Args:
        a: success by the number of the episode.
        b: the same of the other method.
        common: compare on the episodes that both have, where one has more.

    Raises:
        ValueError: other episodes (unless ``common``), or none in common.
    """
    if a.keys() != b.keys() and not common:
        only = len(a.keys() - b.keys()), len(b.keys() - a.keys())
        raise ValueError(
            f"episodes: must be the same for both, but {only[0]} are only the first's and {only[1]}"
            " only the second's; common=True compares on those that both have"
        )
    episodes = sorted(a.keys() & b.keys())
    if not episodes:
        raise ValueError("episodes: none in common")
    outcomes = [(bool(a[episode]), bool(b[episode])) for episode in episodes]
    return Paired.of_counts(
        outcomes.count((True, True)),
        outcomes.count((True, False)),
        outcomes.count((False, True)),
        outcomes.count((False, False)),
    )


def _newcombe_paired(both: int, only_a: int, only_b: int, neither: int) -> tuple[float, float]:
    """Newcombe's method 10 for paired data: the hybrid interval with the rates' correlation.

    A positive correlation, which makes the interval narrower, is taken with a continuity
    correction.
    """
    n = both + only_a + only_b + neither
    of_a, of_b = both + only_a, both + only_b
    (low_a, high_a), (low_b, high_b) = wilson_interval(of_a, n), wilson_interval(of_b, n)
    a, b = of_a / n, of_b / n
    margins = of_a * (n - of_a) * of_b * (n - of_b)
    covariance = float(both * neither - only_a * only_b)
    if covariance > 0:
        covariance = max(covariance - n / 2, 0.0)
    phi = covariance / math.sqrt(margins) if margins else 0.0

    def width(one: float, other: float) -> float:
        # Rounding must not make it negative when both are equal and phi is 1.
        return math.sqrt(max(one**2 - 2 * phi * one * other + other**2, 0.0))

    difference = (only_a - only_b) / n
    return (
        max(difference - width(a - low_a, high_b - b), -1.0),
        min(difference + width(high_a - a, b - low_b), 1.0),
    )
