"""Intervals against published values, SciPy, and what they promise: their coverage."""

import math
from typing import Any, cast

import numpy as np
import pytest
from scipy import stats

from limsim_jax.metrics.intervals import (
    bootstrap,
    clopper_pearson,
    paired_difference,
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


@pytest.mark.parametrize(
    ("events", "trials", "low", "high"),
    # Newcombe (1998), table I, method 5
    [(81, 263, 0.2527, 0.3676), (15, 148, 0.0578, 0.1617), (0, 20, 0.0, 0.1684), (1, 29, 0.0009, 0.1776)],
)
def test_clopper_pearson_is_as_published(events, trials, low, high):
    found = clopper_pearson(events, trials)
    assert (round(found.low, 4), round(found.high, 4)) == (low, high)


@pytest.mark.parametrize("level", [0.9, 0.95, 0.99])
def test_intervals_of_shares_are_scipys(level):
    for trials in (1, 7, 200, 10_000):
        for events in {0, 1, trials // 3, trials - 1, trials}:
            result = stats.binomtest(events, trials)
            for ours, method in ((wilson, "wilson"), (clopper_pearson, "exact")):
                theirs = result.proportion_ci(level, method=method)
                found = ours(events, trials, level)
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
    for method, least, most in ((wilson, 0.945, 0.96), (clopper_pearson, 0.955, 1.0)):
        intervals = [method(int(i), n) for i in k]
        inside = np.array([(i.low <= shares) & (shares <= i.high) for i in intervals])
        coverage = (mass * inside).sum(0)
        assert least < coverage.mean() < most
        if method is clopper_pearson:
            assert coverage.min() >= 0.95


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
    found = paired_difference(a, b, resamples=2000)
    assert found.estimate == pytest.approx(np.mean(a - b))
    assert found.low > 0.4 and found.high < 0.6
    t = stats.ttest_rel(a, b).confidence_interval()
    assert found.low == pytest.approx(t.low, abs=0.01) and found.high == pytest.approx(t.high, abs=0.01)
    back = paired_difference(b, a, resamples=2000)
    assert back.estimate == pytest.approx(-found.estimate)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: wilson(3, 2), r"3 events in 2 trials: need 0 <= events <= trials and trials >= 1"),
        (lambda: wilson(0, 0), r"0 events in 0 trials"),
        (lambda: clopper_pearson(-1, 5), r"-1 events in 5 trials"),
        (lambda: wilson(cast(Any, 0.5), 2), r"events must be a whole number, not 0.5"),
        (lambda: wilson(1, 2, 1.5), r"the level must lie between 0 and 1, not 1.5"),
        (lambda: wilson(1, 2, 95), r"the level must lie between 0 and 1, not 95; 95 % is 0.95"),
        (lambda: zero_event_bound(0), r"0 events in 0 trials"),
        (lambda: bootstrap([]), r"values must be a list of numbers, one per seed; it has shape \(0,\)"),
        (lambda: bootstrap([1.0, math.nan]), r"1 of 2 values are not finite; leave them out"),
        (lambda: paired_difference([1.0, 2.0], [1.0]), r"2 values but 1 others; pairs need the same seeds"),
    ],
)
def test_wrong_input_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
