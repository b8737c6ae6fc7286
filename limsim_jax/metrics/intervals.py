"""Confidence intervals over seeds, on the host. The seed is the unit, never the frame or the vehicle.

- Wilson (1927) score interval for shares: for reports. Clopper and Pearson (1934): never covers less than
  its level, for claims. Zero events in n: the share is below `1 - (1 - level)^(1/n)`, about 3 / n at
  95 % (the "rule of three").
- Means and other statistics: bootstrap, bias-corrected and accelerated (BCa, Efron 1987), or percentile.
- Two policies on the same seeds: the bootstrap of the differences by seed.

A value that is not finite is no sample: leave it out and say how many were.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Statistic = Callable[..., Any]

RESAMPLES = 10_000
"""Of the bootstrap, unless told."""

_BATCH = 2**22  # resampled values at a time: bounds the memory


class Interval(NamedTuple):
    """An estimate and where the truth lies with the stated confidence."""

    estimate: float
    low: float
    high: float


def wilson(events: int, trials: int, level: float = 0.95) -> Interval:
    """Score interval for the probability of an event that happened `events` times in `trials`.

    Raises `ValueError` for counts that are no counts, or a level outside (0, 1).
    """
    _check_counts(events, trials)
    z = _z(level)
    p = events / trials
    middle = p + z * z / (2 * trials)
    half = z * math.sqrt(p * (1 - p) / trials + z * z / (4 * trials * trials))
    scale = 1 + z * z / trials
    low = 0.0 if events == 0 else (middle - half) / scale
    high = 1.0 if events == trials else (middle + half) / scale
    return Interval(p, low, high)


def clopper_pearson(events: int, trials: int, level: float = 0.95) -> Interval:
    """Exact interval for a probability; conservative. Raises `ValueError` as `wilson`."""
    from scipy.special import betaincinv

    _check_counts(events, trials)
    _check_level(level)
    tail = (1 - level) / 2
    low = 0.0 if events == 0 else float(betaincinv(events, trials - events + 1, tail))
    high = 1.0 if events == trials else float(betaincinv(events + 1, trials - events, 1 - tail))
    return Interval(events / trials, low, high)


def zero_event_bound(trials: int, level: float = 0.95) -> float:
    """What the probability of an event that never happened in `trials` does not exceed, one-sided."""
    _check_counts(0, trials)
    _check_level(level)
    return -math.expm1(math.log1p(-level) / trials)


def bootstrap(
    values: ArrayLike,
    statistic: Statistic = np.mean,
    *,
    level: float = 0.95,
    resamples: int = RESAMPLES,
    method: Literal["BCa", "percentile"] = "BCa",
    seed: int = 0,
) -> Interval:
    """Interval for a statistic of one value per seed; `statistic(x, axis=-1)` as `numpy.mean`.

    The same input gives the same interval. One value, or equal ones, give an interval without width
    for equal values and without bounds (NaN) for a single one. Raises `ValueError` for no values, or
    values that are not finite.
    """
    x = _samples(values, "values")
    _check_level(level)
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
        # all resamples on one side of the estimate, as with the largest value: no correction exists
        return bootstrap(x, statistic, level=level, resamples=resamples, method="percentile", seed=seed)
    return Interval(estimate, float(found.low), float(found.high))


def paired_difference(
    values: ArrayLike,
    others: ArrayLike,
    statistic: Statistic = np.mean,
    *,
    level: float = 0.95,
    resamples: int = RESAMPLES,
    method: Literal["BCa", "percentile"] = "BCa",
    seed: int = 0,
) -> Interval:
    """Interval for `values - others`, seed by seed: both lists are in the order of the same seeds.

    Raises `ValueError` if they differ in length.
    """
    x, y = _samples(values, "values"), _samples(others, "others")
    if x.size != y.size:
        raise ValueError(f"{x.size} values but {y.size} others; pairs need the same seeds in the same order")
    return bootstrap(x - y, statistic, level=level, resamples=resamples, method=method, seed=seed)


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


def _check_level(level: float) -> None:
    if not 0 < level < 1:
        raise ValueError(f"the level must lie between 0 and 1, not {level!r}; 95 % is 0.95")


def _z(level: float) -> float:
    from scipy.special import ndtri

    _check_level(level)
    return float(ndtri((1 + level) / 2))
