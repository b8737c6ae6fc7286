"""Intervals, rates and tests over seeds, on the host. The unit is the seed, never the frame or the vehicle.

- Shares: Wilson's score interval (1927). For zero events in n the one-sided bound is
  `1 - (1 - level)^(1/n)`, about 3 / n at 95 % (the "rule of three").
- Means and other statistics: bootstrap, bias-corrected and accelerated (BCa, Efron 1987).
- Rates: the exact interval of a Poisson rate (Garwood 1936).
- Medians: order statistics (Conover 1999, 3.2).
- Pairs on the same seeds: the t-test, and McNemar's test (1947) in its exact form; p-values of one
  comparison are adjusted together (Holm 1979).

SciPy does the work where it has the method. The exceptions are Holm's three lines and `mean_intervals`, which
resamples all columns of a table at once.

A value that is not finite is no sample: leave it out and report how many were left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Statistic = Callable[..., Any]

RESAMPLES = 10_000
"""Default number of resamples of a bootstrap."""

_BATCH = 2**22  # resampled values at a time: bounds the memory
_BLOCK = 2**20  # resampled weights at a time: bounds the memory


class Interval(NamedTuple):
    """An estimate and the bounds of its confidence interval."""

    estimate: float
    low: float
    high: float


# --- shares


def wilson(events: int, trials: int, level: float = 0.95) -> Interval:
    """Wilson's score interval of the probability of an event.

    Args:
      events: how often it happened.
      trials: in how many trials.
      level: in (0, 1).

    Raises:
      ValueError: counts that are no counts, or a level outside (0, 1).
    """
    from scipy.stats import binomtest

    _check_counts(events, trials)
    check_level(level)
    found = binomtest(int(events), int(trials)).proportion_ci(level, method="wilson")
    low = 0.0 if events == 0 else float(found.low)
    high = 1.0 if events == trials else float(found.high)
    return Interval(events / trials, low, high)


def zero_event_bound(trials: int, level: float = 0.95) -> float:
    """One-sided upper bound of a probability after no event in `trials`; raises as `wilson`."""
    _check_counts(0, trials)
    check_level(level)
    return -math.expm1(math.log1p(-level) / trials)


# --- rates and medians


def poisson_rate(events: int, exposure: float, level: float = 0.95) -> Interval:
    """Exact interval of events per unit of exposure; raises `ValueError` without exposure."""
    from scipy.special import gammaincinv

    check_level(level)
    if events < 0 or not (exposure > 0 and math.isfinite(exposure)):
        raise ValueError(f"{events} events in {exposure:g}: the exposure must be above 0, events at least 0")
    tail = (1 - level) / 2
    low = float(gammaincinv(events, tail)) if events else 0.0
    return Interval(events / exposure, low / exposure, float(gammaincinv(events + 1, 1 - tail)) / exposure)


def median_interval(values: ArrayLike, level: float = 0.95) -> Interval:
    """The median with bounds from order statistics; the bounds are NaN for too few values.

    Raises `ValueError` as `bootstrap`.
    """
    from scipy.stats import quantile_test

    x = _samples(values, "values")
    check_level(level)
    found = quantile_test(x).confidence_interval(level)
    low, high = float(found.low), float(found.high)
    if not (math.isfinite(low) and math.isfinite(high)):
        low = high = math.nan
    return Interval(float(np.median(x)), low, high)


# --- means


def bootstrap(
    values: ArrayLike,
    statistic: Statistic = np.mean,
    *,
    level: float = 0.95,
    resamples: int = RESAMPLES,
    method: Literal["BCa", "percentile"] = "BCa",
    seed: int = 0,
) -> Interval:
    """Bootstrap interval of a statistic of one value per seed.

    The same input gives the same interval. Equal values give an interval without width. A single value has
    no bounds (NaN).

    Args:
      values: `[n]`, one per seed.
      statistic: called as `statistic(x, axis=-1)`, like `numpy.mean`.
      level: in (0, 1).
      resamples: how many.
      method: "percentile" also replaces "BCa" where no correction exists, such as for the maximum.
      seed: of the resampling.

    Raises:
      ValueError: no values, values that are not finite, or a level outside (0, 1).
    """
    x = _samples(values, "values")
    check_level(level)
    estimate = float(statistic(x, axis=-1))
    if x.size == 1:
        return Interval(estimate, math.nan, math.nan)
    if np.all(x == x[0]):
        return Interval(estimate, estimate, estimate)
    from scipy.stats import bootstrap as resample

    batch = max(1, min(resamples, _BATCH // x.size))
    found = resample(
        (x,),
        statistic,
        n_resamples=resamples,
        batch=batch,
        vectorized=True,
        axis=-1,
        confidence_level=level,
        method=method,
        rng=np.random.default_rng(seed),
    ).confidence_interval
    if method == "BCa" and not (np.isfinite(found.low) and np.isfinite(found.high)):
        # all resamples lie on one side of the estimate, as for the maximum: no correction exists
        return bootstrap(x, statistic, level=level, resamples=resamples, method="percentile", seed=seed)
    return Interval(estimate, float(found.low), float(found.high))


def mean_intervals(
    values: Floats, *, level: float = 0.95, resamples: int = RESAMPLES, seed: int = 0
) -> list[Interval]:
    """BCa bootstrap of the mean of each column.

    All columns share the resampled seeds, so a thousand columns cost little more than one. Otherwise as
    `bootstrap`: no width for equal values, no bounds (NaN) for a single value.

    Args:
      values: `[seeds, metrics]`; NaN is not measured.
      level: in (0, 1).
      resamples: how many.
      seed: of the resampling.
    """
    from scipy.special import ndtr, ndtri

    m = values.shape[1]
    there = ~np.isnan(values)
    count = there.sum(0)
    x = np.where(there, values, 0.0)
    estimate = x.sum(0) / np.maximum(count, 1)
    deviation = np.where(there, values - estimate, 0.0)
    varied = (count > 1) & (np.where(there, values, -np.inf).max(0, initial=-np.inf)
                            > np.where(there, values, np.inf).min(0, initial=np.inf))  # fmt: skip
    some = np.flatnonzero(varied)
    means = _resampled(deviation[:, some], there[:, some], resamples, seed)
    z = float(ndtri((1 + level) / 2))
    found = []
    for k in range(m):
        if count[k] < 2 or not varied[k]:
            bounds = (estimate[k], estimate[k]) if count[k] > 1 else (math.nan, math.nan)
            found.append(Interval(float(estimate[k]) if count[k] else math.nan, *map(float, bounds)))
            continue
        sample = means[:, np.searchsorted(some, k)]
        sample = sample[~np.isnan(sample)]
        shift = float(ndtri(((sample < 0).mean() + (sample <= 0).mean()) / 2))
        u = deviation[:, k]
        skew = float((u**3).sum() / (6 * (u**2).sum() ** 1.5))
        ends = [ndtr(shift + (shift + q) / (1 - skew * (shift + q))) for q in (-z, z)]
        if not np.isfinite(ends).all():
            ends = [(1 - level) / 2, (1 + level) / 2]
        low, high = estimate[k] + np.quantile(sample, ends)
        found.append(Interval(float(estimate[k]), float(low), float(high)))
    return found


def _resampled(x: Floats, there: NDArray[np.bool_], resamples: int, seed: int) -> Floats:
    """Means of each column, `[resamples, metrics]`: counts of the draws times values, a block at a time."""
    n, m = x.shape
    means = np.empty((resamples, m))
    if not m:
        return means
    rng = np.random.default_rng(seed)
    complete = there.all(0)
    block = max(1, min(resamples, _BLOCK // n))
    for first in range(0, resamples, block):
        rows = min(block, resamples - first)
        drawn = rng.integers(0, n, (rows, n), np.int32) + n * np.arange(rows, dtype=np.int32)[:, None]
        weight = np.bincount(drawn.ravel(), minlength=rows * n).reshape(rows, n).astype(np.float64)
        number = np.full((rows, m), float(n))
        number[:, ~complete] = weight @ there[:, ~complete].astype(np.float64)
        means[first : first + rows] = (weight @ x) / np.where(number > 0, number, np.nan)
    return means


# --- pairs


def paired_t(differences: ArrayLike) -> tuple[float, float]:
    """t and the two-sided p-value of the paired t-test.

    0 and 1 where there is no difference to test; infinity and 0 where all pairs differ by the same amount.
    """
    from scipy.stats import ttest_1samp

    x = np.asarray(differences, np.float64)
    mean = float(x.mean())
    if x.size < 2 or mean == 0:
        return 0.0, 1.0
    if float(x.std(ddof=1)) == 0:
        return math.copysign(math.inf, mean), 0.0
    found: Any = ttest_1samp(x, 0.0)
    return float(found.statistic), float(found.pvalue)


def mcnemar(a_not_b: int, b_not_a: int) -> float:
    """Two-sided exact p-value of McNemar's test.

    Args:
      a_not_b: pairs in which only A has the event.
      b_not_a: pairs in which only B has it.
    """
    from scipy.stats import binomtest

    n = a_not_b + b_not_a
    return float(binomtest(a_not_b, n).pvalue) if n else 1.0


def rate_difference(
    events: Floats,
    exposure: Floats,
    other_events: Floats,
    other_exposure: Floats,
    *,
    level: float = 0.95,
    resamples: int = 2_000,
    seed: int = 0,
) -> Interval:
    """Other rate minus own, on the same seeds, by percentiles of resamples.

    Args:
      events, exposure, other_events, other_exposure: `[n]` each, one per seed, in the same order.
      level: in (0, 1).
      resamples: how many.
      seed: of the resampling.

    Raises:
      ValueError: a total exposure of 0, or a level outside (0, 1).
    """
    check_level(level)
    parts = np.stack([events, exposure, other_events, other_exposure]).astype(np.float64)
    total = parts.sum(1)
    if not (total[1] > 0 and total[3] > 0):
        raise ValueError("a rate needs an exposure above 0")
    n, rng = parts.shape[1], np.random.default_rng(seed)
    sums = np.empty((4, resamples))
    block = max(1, _BLOCK // n)
    for first in range(0, resamples, block):
        drawn = rng.integers(0, n, (min(block, resamples - first), n))
        sums[:, first : first + len(drawn)] = parts[:, drawn].sum(-1)
    there = (sums[1] > 0) & (sums[3] > 0)
    sample = sums[2, there] / sums[3, there] - sums[0, there] / sums[1, there]
    low, high = np.quantile(sample, [(1 - level) / 2, (1 + level) / 2])
    return Interval(float(total[2] / total[3] - total[0] / total[1]), float(low), float(high))


def rate_test(events: int, exposure: float, other_events: int, other_exposure: float) -> float:
    """Two-sided p-value of equal Poisson rates: exact, given the number of all events.

    Przyborowski and Wilenski (1940). Events on the same seeds that come together make it conservative.
    """
    from scipy.stats import binomtest

    n = events + other_events
    return float(binomtest(events, n, exposure / (exposure + other_exposure)).pvalue) if n else 1.0


def holm(p: Sequence[float]) -> list[float]:
    """Adjusted p-values (Holm 1979), in the order of `p`."""
    order = np.argsort(p, kind="stable")
    factors = len(p) - np.arange(len(p))
    adjusted = np.empty(len(p))
    adjusted[order] = np.minimum(np.maximum.accumulate(np.asarray(p)[order] * factors), 1)
    return adjusted.tolist()


# --- checks


def check_level(level: float) -> None:
    """Raise `ValueError` for a level of confidence outside (0, 1)."""
    if not 0 < level < 1:
        raise ValueError(f"the level must lie between 0 and 1, not {level!r}; 95 % is 0.95")


def _samples(values: ArrayLike, name: str) -> Floats:
    x = np.asarray(values, np.float64)
    if x.ndim != 1 or x.size == 0:
        raise ValueError(f"{name} must be a list of numbers, one per seed; it has shape {x.shape}")
    bad = int(np.sum(~np.isfinite(x)))
    if bad:
        raise ValueError(f"{bad} of {x.size} {name} are not finite; leave them out and report how many")
    return x


def _check_counts(events: int, trials: int) -> None:
    for name, count in (("events", events), ("trials", trials)):
        if not isinstance(count, (int, np.integer)) or isinstance(count, bool):
            raise ValueError(f"{name} must be a whole number, not {count!r}")
    if not 0 <= events <= trials or trials == 0:
        raise ValueError(f"{events} events in {trials} trials: need 0 <= events <= trials and trials >= 1")
