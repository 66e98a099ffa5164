"""Success rates, and differences between methods."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import optimize, stats

from hvf.evaluation.statistics import Paired, difference_interval, paired, wilson_interval

counts = st.tuples(*[st.integers(0, 60)] * 4).filter(any)


def rates(n: int) -> st.SearchStrategy[tuple[int, int]]:
    return st.integers(1, n).flatmap(lambda m: st.tuples(st.integers(0, m), st.just(m)))


def outcomes(both: int, only_a: int, only_b: int, neither: int) -> list[tuple[bool, bool]]:
    pairs = ((True, True), (True, False), (False, True), (False, False))
    return [
        pair
        for pair, n in zip(pairs, (both, only_a, only_b, neither), strict=True)
        for _ in "x" * n
    ]


@pytest.mark.parametrize(("successes", "trials"), [(0, 10), (3, 10), (50, 100), (100, 100)])
def test_wilson_interval_holds_the_rates_that_the_score_test_does_not_reject(
    successes: int, trials: int
) -> None:
    low, high = wilson_interval(successes, trials)
    z = stats.norm.ppf(0.975)
    for bound in (low, high):
        score = abs(successes / trials - bound) - z * math.sqrt(bound * (1 - bound) / trials)
        assert score == pytest.approx(0, abs=1e-12)


def test_published_example_of_separate_episodes() -> None:
    # Newcombe (1998), Statistics in Medicine 17:873-890, example (a), method 10: 56/70 - 48/80.
    assert difference_interval(56, 70, 48, 80) == pytest.approx((0.0524, 0.3339), abs=5e-5)


def test_published_example_of_the_same_episodes() -> None:
    # Response before and after therapy (Cavo et al., 2012) in Fagerland, Lydersen & Laake,
    # Statistical Analysis of Contingency Tables (2017), chapter 8: Newcombe's interval.
    found = Paired.of_counts(59, 6, 16, 80)
    assert (found.n, found.difference) == (161, pytest.approx(-10 / 161))
    assert (found.low, found.high) == pytest.approx((-0.1186, -0.0046), abs=5e-5)


@given(rates(80), rates(80))
def test_difference_of_separate_episodes_turns_its_sign_with_the_order(
    a: tuple[int, int], b: tuple[int, int]
) -> None:
    low, high = difference_interval(*a, *b)
    assert difference_interval(*b, *a) == pytest.approx((-high, -low))
    assert -1 - 1e-12 <= low <= a[0] / a[1] - b[0] / b[1] <= high <= 1 + 1e-12


@given(counts)
def test_paired_difference_turns_its_sign_with_the_order(
    numbers: tuple[int, int, int, int],
) -> None:
    both, only_a, only_b, neither = numbers
    found, turned = (
        Paired.of_counts(both, only_a, only_b, neither),
        Paired.of_counts(both, only_b, only_a, neither),
    )
    assert (turned.low, turned.high) == pytest.approx((-found.high, -found.low))
    assert (turned.difference, turned.p) == (-found.difference, pytest.approx(found.p))


@given(counts)
def test_paired_interval_holds_the_difference_and_no_impossible_one(
    numbers: tuple[int, int, int, int],
) -> None:
    found = Paired.of_counts(*numbers)
    assert -1 <= found.low <= found.difference <= found.high <= 1
    assert found.n == sum(numbers)
    assert found.difference == pytest.approx(
        (found.both + found.only_a) / found.n - (found.both + found.only_b) / found.n
    )


@given(counts)
def test_paired_interval_is_the_separate_one_where_outcomes_are_unrelated(
    numbers: tuple[int, int, int, int],
) -> None:
    # No correlation is taken where it is positive but within the continuity correction.
    both, only_a, only_b, neither = numbers
    n = sum(numbers)
    found = Paired.of_counts(*numbers)
    separate = difference_interval(both + only_a, n, both + only_b, n)
    product = both * neither - only_a * only_b
    if 0 <= product <= n / 2:
        assert (found.low, found.high) == pytest.approx(separate)
    elif product > 0:
        # What goes together says more of the difference.
        assert found.high - found.low <= separate[1] - separate[0] + 1e-12
    else:
        assert found.high - found.low >= separate[1] - separate[0] - 1e-12


def test_paired_interval_is_near_the_score_interval() -> None:
    # Tango (1998), an independent method: the differences that the score test does not reject.
    for numbers in [(40, 20, 10, 30), (5, 44, 21, 30), (90, 5, 2, 3), (10, 8, 15, 67)]:
        found = Paired.of_counts(*numbers)
        assert (found.low, found.high) == pytest.approx(tango(*numbers), abs=0.02)


def tango(both: int, only_a: int, only_b: int, neither: int) -> tuple[float, float]:
    """Tango's score interval, by finding where the score statistic is +-z."""
    n, b, c = both + only_a + only_b + neither, only_a, only_b
    z = stats.norm.ppf(0.975)

    def score(delta: float) -> float:
        # Rate of "only b" at this difference by maximum likelihood (Tango, 1998, equation 4).
        linear = -b - c + (2 * n - b + c) * delta
        q = (math.sqrt(linear**2 + 8 * n * c * delta * (1 - delta)) - linear) / (4 * n)
        return (b - c - n * delta) / math.sqrt(n * (2 * q + delta * (1 - delta)))

    middle = (b - c) / n
    low = optimize.brentq(lambda delta: score(delta) - z, -0.999, middle)
    high = optimize.brentq(lambda delta: score(delta) + z, middle, 0.999)
    return low, high


@pytest.mark.parametrize("only", [(0, 0), (1, 0), (4, 0), (3, 4), (8, 1), (2, 9)])
def test_mcnemars_p_counts_all_ways_to_swap_the_methods(only: tuple[int, int]) -> None:
    only_a, only_b = only
    # If neither is better, who did an episode that just one did is a coin's toss.
    observed = abs(only_a - only_b)
    tosses = list(itertools.product((-1, 1), repeat=only_a + only_b))
    as_uneven = sum(abs(sum(toss)) >= observed for toss in tosses)
    found = Paired.of_counts(7, only_a, only_b, 3)
    assert found.p == pytest.approx(as_uneven / len(tosses))


@given(counts, st.randoms())
def test_pairs_are_found_by_the_episodes_number(
    numbers: tuple[int, int, int, int], random: object
) -> None:
    found = outcomes(*numbers)
    random.shuffle(found)  # type: ignore[attr-defined]
    a = {index: pair[0] for index, pair in enumerate(found)}
    b = {index: found[index][1] for index in reversed(range(len(found)))}
    assert paired(a, b) == Paired.of_counts(*numbers)


def test_refuses_other_episodes_unless_asked_for_the_common_ones() -> None:
    a = {0: True, 1: True, 2: False, 5: True}
    b = {0: True, 1: False, 2: False, 7: True, 8: True}
    with pytest.raises(ValueError, match=r"1 are only the first's and 2 only the second's"):
        paired(a, b)
    found = paired(a, b, common=True)
    assert (found.both, found.only_a, found.only_b, found.neither) == (1, 1, 0, 1)
    with pytest.raises(ValueError, match="none in common"):
        paired({0: True}, {1: True}, common=True)
    with pytest.raises(ValueError, match="none in common"):
        paired({}, {})


@pytest.mark.parametrize("numbers", [(0, 0, 0, 0), (3, -1, 2, 4)])
def test_refuses_counts_of_nothing(numbers: tuple[int, int, int, int]) -> None:
    with pytest.raises(ValueError, match="counts"):
        Paired.of_counts(*numbers)
    with pytest.raises(ValueError, match="successes"):
        wilson_interval(3, 2)
