"""Comfort: accelerations, jerk and yaw of one vehicle, filtered as nuPlan filters them, step by step.

nuPlan (`nuplan-devkit`, `state_extractors.py`) smooths with Savitzky-Golay filters, sampled at 10 Hz:

- acceleration along and across: window 8, order 2;
- jerk: that smoothed acceleration, then the first derivative with window 15, order 2; "jerk" without
  a direction is the derivative of the smoothed magnitude of the acceleration;
- yaw rate and yaw acceleration: first and second derivative of the heading, window 5, order 2 and 3.

The even window of 8 is nuPlan's: it shifts the middle of a record by half a sample against its ends, so
that a ramp of the acceleration has a jerk an eighth too high near both ends.

All of these are linear, so that each is a fixed row of weights on the last samples. At both ends of an
episode SciPy's `mode="interp"` evaluates the polynomial of the outermost window; `head` and `tail` hold
those weights, so that the stream gives what `scipy.signal.savgol_filter` gives on the whole record. Of a
record that a filter looks beyond, one polynomial of the same order is fitted to all samples (`fitted`), as
nuPlan does with records shorter than a window: an episode that fails early has its values, too. Other time
steps keep the length of the windows in seconds.

Units: m/s^2, m/s^3, rad/s, rad/s^2. Lateral acceleration is speed times yaw rate, left > 0.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

from limsim_jax.geometry import wrap_angle
from limsim_jax.metrics.reductions import Least, Mean, Measured, measured
from limsim_jax.numerics import masked_sum, safe_divide, safe_norm, safe_sqrt
from limsim_jax.standards import COMFORT

Floats = NDArray[np.float64]


class Filter(NamedTuple):
    """A linear filter of a stream: it sees `M` samples and filters the one at `H`."""

    head: Floats
    """[H+1, M], from the first M samples to the values at the first H + 1; the last row is that of
    the middle of an episode."""
    tail: Floats
    """[M-1-H, M], from the last M samples to the values at those after the last filtered one."""
    order: int
    """Of the polynomial."""
    derivative: int
    """Of it."""
    dt: float
    """s between samples."""

    @property
    def window(self) -> int:
        """M."""
        return self.head.shape[1]


def stream(
    filter_all: Callable[[Floats], Floats], longest: int, order: int, derivative: int, dt: float
) -> Filter:
    """The weights of a linear filter that is given as a function.

    The function filters a whole record, samples along axis 0; no output may look further than `longest` of
    them. The weights are found by filtering unit impulses. Order, derivative and time step are those of the
    polynomial for short records.

    Raises `ValueError` if outputs at the ends of a record look further than those in its middle.
    """
    n = 6 * longest
    a = filter_all(np.eye(n))
    a[np.abs(a) < 1e-12 * np.abs(a).max()] = 0.0
    middle = n // 2
    reach = np.nonzero(a[middle])[0]
    back, ahead = middle - reach[0], reach[-1] - middle

    def inner(i: int) -> bool:
        moved = np.roll(a[middle], i - middle)
        return bool(i >= back and i + ahead < n and np.allclose(moved, a[i], atol=1e-9))

    first = next(i for i in range(n) if inner(i))
    last = next(i for i in reversed(range(n)) if inner(i))
    h, after = max(back, first), max(ahead, n - 1 - last)
    m = h + 1 + after
    if a[: h + 1, m:].any() or a[n - after :, : n - m].any():
        raise ValueError("the edges of the filter look further than its middle")
    return Filter(a[: h + 1, :m], a[n - after :, n - m :], order, derivative, dt)


class FilterCarry(NamedTuple):
    """The samples in sight, oldest first, and how many there have been."""

    samples: Float[Array, "M C"]
    taken: Int[Array, ""]


def filter_init(filter: Filter, channels: int) -> FilterCarry:
    """No samples yet."""
    return FilterCarry(jnp.zeros((filter.window, channels)), jnp.zeros((), jnp.int32))


def filter_update(
    filter: Filter, carry: FilterCarry, x: Float[Array, " C"], where: Bool[Array, ""]
) -> tuple[FilterCarry, Float[Array, "H1 C"], Bool[Array, " H1"]]:
    """Take one sample, if `where`; return filtered values and which of them are new."""
    samples = jnp.where(where, jnp.concatenate([carry.samples[1:], x[None, :]]), carry.samples)
    taken = carry.taken + where.astype(jnp.int32)
    rows = filter.head.shape[0]
    last = jnp.arange(rows) == rows - 1
    new = where & ((taken == filter.window) | (last & (taken > filter.window)))
    return FilterCarry(samples, taken), _apply(filter.head, samples), new


def filter_result(filter: Filter, carry: FilterCarry) -> tuple[Float[Array, "R C"], Bool[Array, " R"]]:
    """The values known only at the end of a record, with validity; all of them in a short record."""
    m, rest = filter.window, filter.tail.shape[0]
    short = carry.taken < m
    known: Any = jnp.where(short, carry.taken, rest)
    whole = _apply(np.concatenate([np.zeros((m - rest, m)), filter.tail]), carry.samples)
    found = jnp.where(short, fitted(filter, carry), whole)
    return found, jnp.arange(m) >= m - known


def fitted(filter: Filter, carry: FilterCarry) -> Float[Array, "M C"]:
    """Values of one polynomial fitted to all samples so far.

    Or of its derivative; the samples are fewer than `M`. Least squares in Gram's polynomials, which are
    orthogonal on evenly spaced points (Abramowitz and Stegun, 22.17). The norms of those whose order the
    samples do not bear are 0.
    """
    m, n = filter.window, carry.taken.astype(carry.samples.dtype)
    place = jnp.arange(m, dtype=n.dtype) - (m - n)
    there = (place >= 0)[:, None]
    t, one, square = (place - (n - 1) / 2)[:, None], jnp.ones((m, 1)), n * n
    bend = (3 * square - 7) / 20
    gram = (  # each with its first two derivatives
        (one, 0 * one, 0 * one),
        (t, one, 0 * one),
        (t * t - (square - 1) / 12, 2 * t, 2 * one),
        (t * t * t - bend * t, 3 * t * t - bend, 6 * t),
    )
    norms = [n]
    for k, scale in zip((1, 2, 3), (12, 15, 140 / 9), strict=True):
        norms.append(norms[-1] * (square - k * k) / scale)
    level = carry.samples[-1:]
    samples = jnp.where(there, carry.samples - level, 0)  # what is common to all does not cost digits
    found = level * one if filter.derivative == 0 else 0 * level * one
    for polynomial, norm in list(zip(gram, norms, strict=True))[: filter.order + 1]:
        share = safe_divide(jnp.sum(samples * jnp.where(there, polynomial[0], 0), 0, keepdims=True), norm)
        found += share * polynomial[filter.derivative]
    return found / filter.dt**filter.derivative


def _apply(weights: Floats, samples: Float[Array, "M C"]) -> Float[Array, "K C"]:
    # against the newest sample: what is common to all samples does not cost digits; nor do GPUs round
    newest = samples[-1:]
    change = jnp.matmul(jnp.asarray(weights, samples.dtype), samples - newest, precision="highest")
    return change + jnp.asarray(weights.sum(1)[:, None], samples.dtype) * newest


class Filters(NamedTuple):
    """The filters of this module for one time step."""

    acceleration: Filter
    jerk: Filter
    yaw_rate: Filter
    yaw_acceleration: Filter


@functools.cache
def filters(dt: float) -> Filters:
    """nuPlan's filters at time step `dt` (s), with windows as long."""
    from scipy.signal import savgol_filter

    def window(samples: int, order: int) -> int:
        return max(order + 1, round(samples * 0.1 / dt))

    def savgol(x: Floats, samples: int, order: int, derivative: int) -> Floats:
        length = window(samples, order)
        return np.asarray(savgol_filter(x, length, order, deriv=derivative, delta=dt, axis=0))

    smooth = functools.partial(savgol, samples=8, order=2, derivative=0)
    return Filters(
        acceleration=stream(smooth, window(8, 2), 2, 0, dt),
        jerk=stream(lambda x: savgol(smooth(x), 15, 2, 1), window(15, 2) + window(8, 2), 2, 1, dt),
        yaw_rate=stream(lambda x: savgol(x, 5, 2, 1), window(5, 2), 2, 1, dt),
        yaw_acceleration=stream(lambda x: savgol(x, 5, 3, 2), window(5, 3), 3, 2, dt),
    )


class Filtered(NamedTuple):
    """Filtered values that have become known: `K` of them, the `new` ones. Columns as named."""

    accelerations: Float[Array, "K1 3"]  # along, across, magnitude
    new_accelerations: Bool[Array, " K1"]
    jerks: Float[Array, "K2 3"]  # of the same
    new_jerks: Bool[Array, " K2"]


class MotionCarry(NamedTuple):
    """State of `motion_update`."""

    heading: Float[Array, ""]  # rad, unwrapped, since the start
    last: Float[Array, ""]  # rad, as given
    started: Bool[Array, ""]
    lateral: Float[Array, ""]  # m/s^2, of the last step, unfiltered
    acceleration: FilterCarry
    jerk: FilterCarry
    yaw_rate: FilterCarry
    yaw_acceleration: FilterCarry
    least: Least  # [6], in the order of `COMFORT`
    most: Least  # [6], of the negatives
    square_acceleration: Mean
    square_jerk: Mean


def motion_init(dt: float) -> MotionCarry:
    """Before the first step."""
    f = filters(dt)
    zero = jnp.zeros(())
    return MotionCarry(
        heading=zero,
        last=zero,
        started=jnp.zeros((), bool),
        lateral=zero,
        acceleration=filter_init(f.acceleration, 3),
        jerk=filter_init(f.jerk, 3),
        yaw_rate=filter_init(f.yaw_rate, 1),
        yaw_acceleration=filter_init(f.yaw_acceleration, 1),
        least=Least.empty(len(COMFORT)),
        most=Least.empty(len(COMFORT)),
        square_acceleration=Mean.empty(),
        square_jerk=Mean.empty(),
    )


def motion_update(
    dt: float,
    carry: MotionCarry,
    *,
    t: Float[Array, ""],
    v: Float[Array, ""],
    a: Float[Array, ""],
    heading: Float[Array, ""],
) -> tuple[MotionCarry, Filtered]:
    """One step: speed `v` (m/s), acceleration `a` (m/s^2) of the step just made, heading (rad).

    The first call sets the start; accelerations count from the second on. Times of extremes are those
    at which they became known, half a window late.
    """
    f = filters(dt)
    first = ~carry.started
    turn = jnp.where(first, 0, wrap_angle(heading - carry.last))
    unwrapped = carry.heading + turn
    lateral = v * turn / dt
    raw = jnp.stack([a, lateral, safe_norm(jnp.stack([a, lateral]))])
    acceleration, accelerations, new_a = filter_update(f.acceleration, carry.acceleration, raw, ~first)
    jerk, jerks, new_j = filter_update(f.jerk, carry.jerk, raw, ~first)
    yaw, always = unwrapped[None], jnp.ones((), bool)
    yaw_rate, rates, new_r = filter_update(f.yaw_rate, carry.yaw_rate, yaw, always)
    yaw_acceleration, turns, new_y = filter_update(f.yaw_acceleration, carry.yaw_acceleration, yaw, always)
    filtered = Filtered(accelerations, new_a, jerks, new_j)
    carry = carry._replace(
        heading=unwrapped,
        last=heading,
        started=jnp.ones((), bool),
        lateral=lateral,
        acceleration=acceleration,
        jerk=jerk,
        yaw_rate=yaw_rate,
        yaw_acceleration=yaw_acceleration,
    )
    return _reduce(carry, t, filtered, rates, new_r, turns, new_y), filtered


def motion_flush(dt: float, carry: MotionCarry) -> tuple[MotionCarry, Filtered]:
    """The values at the end of the record: half a window that `motion_update` could not know yet."""
    f = filters(dt)
    filtered = Filtered(
        *filter_result(f.acceleration, carry.acceleration), *filter_result(f.jerk, carry.jerk)
    )
    yaw = filter_result(f.yaw_rate, carry.yaw_rate)
    turn = filter_result(f.yaw_acceleration, carry.yaw_acceleration)
    return _reduce(carry, jnp.zeros(()), filtered, *yaw, *turn), filtered


def _reduce(
    carry: MotionCarry,
    t: Float[Array, ""],
    filtered: Filtered,
    rates: Float[Array, "K3 1"],
    new_r: Bool[Array, " K3"],
    turns: Float[Array, "K4 1"],
    new_y: Bool[Array, " K4"],
) -> MotionCarry:
    accelerations, new_a, jerks, new_j = filtered
    columns = (
        (accelerations[:, 0], new_a),
        (accelerations[:, 1], new_a),
        (jerks[:, 2], new_j),
        (jerks[:, 0], new_j),
        (turns[:, 0], new_y),
        (rates[:, 0], new_r),
    )
    low = jnp.stack([jnp.min(jnp.where(new, x, jnp.inf), initial=jnp.inf) for x, new in columns])
    high = jnp.stack([jnp.max(jnp.where(new, x, -jnp.inf), initial=-jnp.inf) for x, new in columns])
    found = jnp.stack([new.any() for _, new in columns])
    now = jnp.broadcast_to(t, low.shape)

    def square(mean: Mean, x: Float[Array, " K"], new: Bool[Array, " K"]) -> Mean:
        return Mean(mean.total + masked_sum(x * x, new), mean.weight + jnp.sum(new, dtype=x.dtype))

    return carry._replace(
        least=carry.least.add(low, now, found),
        most=carry.most.add(-high, now, found),
        square_acceleration=square(carry.square_acceleration, accelerations[:, 0], new_a),
        square_jerk=square(carry.square_jerk, jerks[:, 0], new_j),
    )


def motion_result(dt: float, carry: MotionCarry) -> tuple[dict[str, Measured], Filtered]:
    """Extremes, root mean squares, and whether all stay within `COMFORT`.

    Also the values of `motion_flush`.
    """
    carry, rest = motion_flush(dt, carry)
    low, high, found = carry.least.value, -carry.most.value, carry.least.found
    results = {
        "min_acceleration": measured(low[0], found[0]),
        "max_acceleration": measured(high[0], found[0]),
    }
    largest = jnp.maximum(jnp.abs(low), jnp.abs(high))
    for k, name in list(enumerate(COMFORT))[1:]:
        results[f"max_{name}"] = measured(largest[k], found[k])
    bounds = np.array(list(COMFORT.values()), np.float32)
    within = (low > bounds[:, 0]) & (high < bounds[:, 1])
    for name, mean in (("acceleration", carry.square_acceleration), ("jerk", carry.square_jerk)):
        square = mean.result()
        results[f"rms_{name}"] = measured(safe_sqrt(square.value), square.valid)
    results["comfortable"] = measured(within.all().astype(low.dtype), found.all())
    return results, rest
