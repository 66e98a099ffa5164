"""Success rates with intervals, and what two methods differ by on the same episodes."""

from __future__ import annotations

from scipy import stats


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """95% confidence interval of a success rate (Wilson score interval).

    Raises:
        ValueError: no trials, or more successes than trials.
    """
    if not 0 <= successes <= trials or trials == 0:
        raise ValueError(f"successes: must be from 0 to {trials} of 1 or more, got {successes}")
    interval = stats.binomtest(successes, trials).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)
