"""Intervals against published values, SciPy, and what they promise: their coverage."""

import math
from typing import Any, cast

import numpy as np
import pytest
from scipy import stats

from limsim_jax.statistics import (
    bootstrap,
    holm,
    mcnemar,
    mean_intervals,
    median_interval,
    paired_t,
    poisson_rate,
    rate_difference,
    rate_test,
    wilson,
    zero_event_bound,
)


@pytest.mark.parametrize(
    ("events", "trials", "low", "high", "digits"),
    [
        # Newcombe (1998), Statistics in Medicine 17:857, table I, method 3
        (81, 263, 0.2553, 0.3662, 4),
        (15, 148, 0.0624, 0.1605, 4),
        (0, 20, 0.0, 0.1611, 4),
        (1, 29, 0.0061, 0.1718, 4),
        (10, 10, 0.7225, 1.0, 4),
        (9, 10, 0.5958, 0.9821, 4),
        (8, 10, 0.4902, 0.9433, 4),
        (3, 1000, 0.0010, 0.0088, 4),
    ],
)
def test_wilson_is_as_published(events, trials, low, high, digits):
    found = wilson(events, trials)
    assert found.estimate == events / trials
    assert (round(found.low, digits), round(found.high, digits)) == (low, high)


@pytest.mark.parametrize("level", [0.9, 0.95, 0.99])
def test_intervals_of_shares_are_scipys(level):
    for trials in (1, 7, 200, 10_000):
        for events in {0, 1, trials // 3, trials - 1, trials}:
            result = stats.binomtest(events, trials)
            theirs = result.proportion_ci(level, method="wilson")
            found = wilson(events, trials, level)
            assert found[0] == pytest.approx(events / trials)
            assert found.low == pytest.approx(theirs.low, abs=1e-12)
            assert found.high == pytest.approx(theirs.high, abs=1e-12)


def test_no_event_in_many_trials():
    assert zero_event_bound(1000) == pytest.approx(1 - 0.05 ** (1 / 1000), rel=1e-9)
    assert zero_event_bound(1000) == pytest.approx(3 / 1000, rel=4e-3)  # the rule of three
    assert zero_event_bound(1, 0.9) == pytest.approx(0.9)
    # just so many trials without an event happen with probability 1 - level
    assert stats.binom.pmf(0, 300, zero_event_bound(300, 0.99)) == pytest.approx(0.01)


def test_coverage_of_shares():
    """The true share lies in the interval about as often as promised, averaged over shares."""
    n, shares = 40, np.linspace(0.02, 0.98, 25)
    k = np.arange(n + 1)
    mass = stats.binom.pmf(k[:, None], n, shares[None])
    intervals = [wilson(int(i), n) for i in k]
    inside = np.array([(i.low <= shares) & (shares <= i.high) for i in intervals])
    assert 0.945 < (mass * inside).sum(0).mean() < 0.96


def skewed(n, seed):
    return np.random.default_rng(seed).lognormal(0.0, 0.9, n)


@pytest.mark.parametrize("method", ["BCa", "percentile"])
@pytest.mark.parametrize("statistic", [np.mean, np.median])
def test_bootstrap_is_scipys(method: Any, statistic):
    x = skewed(80, 0)
    found = bootstrap(x, statistic, method=method, resamples=4000, seed=3)
    theirs = stats.bootstrap(
        (x,), statistic, method=method, n_resamples=4000, rng=np.random.default_rng(11)
    ).confidence_interval
    width = theirs.high - theirs.low
    assert found.estimate == statistic(x)
    assert found.low == pytest.approx(theirs.low, abs=0.08 * width)
    assert found.high == pytest.approx(theirs.high, abs=0.08 * width)
    assert found == bootstrap(x, statistic, method=method, resamples=4000, seed=3)  # the same bits


def test_bootstrap_covers_the_mean():
    """BCa on skewed samples: near its level, and better than the percentiles on the long side."""
    truth = math.exp(0.9**2 / 2)
    misses = {"BCa": [0, 0], "percentile": [0, 0]}
    for seed in range(200):
        method: Any
        for method, count in misses.items():
            found = bootstrap(skewed(40, seed), method=method, resamples=600, seed=seed)
            count[0] += truth < found.low
            count[1] += truth > found.high
    assert sum(misses["BCa"]) < 0.14 * 200
    assert misses["BCa"][1] < misses["percentile"][1]


def test_bootstrap_of_few_or_equal_values():
    assert bootstrap([2.0, 2.0, 2.0]) == (2.0, 2.0, 2.0)
    single = bootstrap([2.0])
    assert single.estimate == 2.0 and math.isnan(single.low) and math.isnan(single.high)
    found = bootstrap([1.0, 2.0, 5.0], np.max)  # no correction exists for the largest value
    assert found.estimate == found.high == 5.0
    assert 1.0 <= found.low < 5.0
    two = bootstrap([0.0, 1.0])
    assert two.low <= 0.5 <= two.high


def test_pairs_take_out_what_seeds_share():
    rng = np.random.default_rng(0)
    easy = rng.normal(size=300) * 10  # how hard each seed is
    a, b = easy + 0.5 + rng.normal(size=300) * 0.3, easy + rng.normal(size=300) * 0.3
    found = bootstrap(a - b, resamples=2000)
    assert found.estimate == pytest.approx(np.mean(a - b))
    assert found.low > 0.4 and found.high < 0.6
    t = stats.ttest_rel(a, b).confidence_interval()
    assert found.low == pytest.approx(t.low, abs=0.01) and found.high == pytest.approx(t.high, abs=0.01)
    back = bootstrap(b - a, resamples=2000)
    assert back.estimate == pytest.approx(-found.estimate)


def test_rates_have_garwoods_interval():
    assert poisson_rate(3, 1.0)[1:] == pytest.approx((0.6187, 8.7673), abs=1e-4)
    assert poisson_rate(0, 2.0).high == pytest.approx(3.6889 / 2, abs=1e-4)
    assert poisson_rate(10, 1.0)[1:] == pytest.approx((4.7954, 18.3904), abs=1e-4)


def test_medians_lie_between_order_statistics():
    """Ranks 2 and 9 of 10, 40 and 61 of 100: the usual"""
    rng = np.random.default_rng(3)
    for n, ranks in ((10, (2, 9)), (100, (40, 61)), (6, (1, 6))):
        x = rng.permutation(np.arange(1.0, n + 1))
        assert median_interval(x) == (np.median(x), *ranks)
    assert np.isnan(median_interval(np.arange(5.0))[1:]).all()  # 5 values never reach 95 %


@pytest.mark.parametrize("level", [0.8, 0.99])
def test_many_means_at_once_are_each_as_scipy_has_it(level):
    """Columns that differ in scale, skew and in which seeds have a value."""
    rng = np.random.default_rng(2)
    values: Any = np.stack(
        [rng.normal(1e4, 1, 80), -rng.exponential(1e-3, 80), rng.poisson(0.2, 80) * 1.0], -1
    )
    values[rng.random((80, 3)) < (0.0, 0.3, 0.1)] = math.nan
    for column, found in zip(values.T, mean_intervals(values, level=level, resamples=20_000), strict=True):
        x = column[~np.isnan(column)]
        expected = bootstrap(x, level=level, resamples=20_000)
        width = expected.high - expected.low
        assert found.estimate == pytest.approx(x.mean(), rel=1e-12)
        assert [found.low, found.high] == pytest.approx(expected[1:], abs=0.04 * width)


def test_many_means_of_equal_values_of_one_and_of_none():
    nan = math.nan
    values = np.array([[2.0, nan, nan, 1.0], [2.0, nan, 5.0, 2.0], [2.0, nan, nan, 4.0]])
    equal, none, one, _ = mean_intervals(values)
    assert equal == (2.0, 2.0, 2.0)
    assert np.isnan(none).all()
    assert one.estimate == 5.0 and np.isnan(one[1:]).all()


def test_p_values():
    assert mcnemar(5, 0) == 0.0625
    assert mcnemar(1, 9) == mcnemar(9, 1) == pytest.approx(22 / 1024)
    assert mcnemar(0, 0) == mcnemar(4, 4) == 1.0
    assert paired_t(np.array([1.0, 2.0, 3.0]))[1] == pytest.approx(0.0741799, abs=1e-6)
    assert paired_t(np.zeros(5)) == (0.0, 1.0)
    assert paired_t(np.full(5, -2.0)) == (-np.inf, 0.0)
    assert paired_t(np.array([3.0])) == (0.0, 1.0)
    # Holm's own steps: 4 p1, 3 p2, 2 p3, p4, never falling
    assert holm([0.02, 0.005, 0.9, 0.021]) == pytest.approx([0.06, 0.02, 0.9, 0.06])


def test_rates_of_pairs():
    """Equal exposure and rare events: the difference is that of the means, and its interval as SciPy's."""
    rng = np.random.default_rng(6)
    x, y = (rng.random((2, 300)) < [[0.2], [0.1]]) * 1.0
    one = np.ones(300)
    found = rate_difference(x, one, y, 2 * one, resamples=20_000)
    expected = stats.bootstrap((y / 2 - x,), np.mean, method="percentile", rng=rng).confidence_interval
    assert found.estimate == pytest.approx((y / 2 - x).mean())
    assert [found.low, found.high] == pytest.approx([expected.low, expected.high], abs=4e-3)
    assert rate_test(5, 1.0, 5, 1.0) == 1.0 == rate_test(0, 1.0, 0, 1.0)
    assert rate_test(0, 1.0, 6, 1.0) == pytest.approx(2 * 0.5**6)
    with pytest.raises(ValueError, match="exposure above 0"):
        rate_difference(x, 0 * one, y, one)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: wilson(3, 2), r"3 events in 2 trials: need 0 <= events <= trials and trials >= 1"),
        (lambda: wilson(0, 0), r"0 events in 0 trials"),
        (lambda: wilson(-1, 5), r"-1 events in 5 trials"),
        (lambda: wilson(cast(Any, 0.5), 2), r"events must be a whole number, not 0.5"),
        (lambda: wilson(1, 2, 1.5), r"the level must lie between 0 and 1, not 1.5"),
        (lambda: wilson(1, 2, 95), r"the level must lie between 0 and 1, not 95; 95 % is 0.95"),
        (lambda: zero_event_bound(0), r"0 events in 0 trials"),
        (lambda: poisson_rate(1, 0.0), r"1 events in 0: the exposure must be above 0"),
        (lambda: median_interval([]), r"it has shape \(0,\)"),
        (lambda: bootstrap([]), r"values must be a list of numbers, one per seed; it has shape \(0,\)"),
        (lambda: bootstrap([1.0, math.nan]), r"1 of 2 values are not finite; leave them out"),
    ],
)
def test_wrong_input_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
