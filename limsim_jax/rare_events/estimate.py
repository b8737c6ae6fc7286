"""The probability of an event, with an interval from independent runs.

    found = lj.rare_event(lambda z: 4.75 - z.sum(-1) / z.shape[-1] ** 0.5, dim=100)
    found.probability      # Interval(estimate=1.0e-06, low=..., high=...)

One run of a sampler errs by 20 to 50 %, and no formula says by how much in a given case. So there are at
least ten runs, and the interval comes from their spread alone: that of the mean of a log-normal distribution
(Cox's method with Student's t, Olsson 2005), which keeps its level where runs are skewed. Runs that are plain
counts have Wilson's interval of all draws together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from limsim_jax.rare_events.samplers import (
    CROSS_ENTROPY_MOST,
    Floats,
    Run,
    Sampler,
    cross_entropy,
    crude,
    splitting,
    subset,
)
from limsim_jax.statistics import Interval, check_level, wilson, zero_event_bound

Method = Literal["auto", "crude", "subset", "cross-entropy", "splitting"]

RUNS = 10
"""Independent runs, at least: fewer say too little about their spread."""

LEAST_SAMPLES = 20
"""Points of a level, at least."""

LEAST = 1e-9
"""Probability below which an event is not followed."""

PILOT_EVENTS = 10
"""Events among the draws of a pilot from which on plain counting does."""

_PILOT = 2**32 - 1  # number of the pilot among the runs


@dataclass(frozen=True)
class RareEvent:
    """How probable an event is.

    Attributes:
      probability: estimate and bounds; 0 and an upper bound where the event was not seen.
      method: of the samplers.
      runs: `[R]` estimates of the runs.
      calls: points at which the limit state was evaluated, pilot included.
      levels: of the runs, on average.
      points: `[M, D]` standard normals within the event, of all runs.
      weights: `[M]` of these points; they add up to 1.
      run: `[M]` of which run they are.
      notes: what to know about the figures.
      level: of confidence.
    """

    probability: Interval
    method: str
    runs: Floats
    calls: int
    levels: float
    points: Floats = field(repr=False)
    weights: Floats = field(repr=False)
    run: NDArray[np.int64] = field(repr=False)
    notes: tuple[str, ...] = ()
    level: float = 0.95

    def __str__(self) -> str:
        p, percent = self.probability, f"{self.level:.0%}".replace("%", " %")
        said = f"{p.estimate:.3g} [{p.low:.3g}, {p.high:.3g}] ({percent})"
        if p.estimate == 0:
            said = f"below {p.high:.3g}"
        lines = [f"{said}, {self.method}, {len(self.runs)} runs, {self.calls} calls"]
        return "\n".join([*lines, *self.notes])


def rare_event(
    f: Callable[[Any], Any],
    dim: int,
    *,
    method: Method = "auto",
    samples: int = 1000,
    runs: int = RUNS,
    least: float = LEAST,
    born: ArrayLike | None = None,
    level: float = 0.95,
    seed: int = 0,
) -> RareEvent:
    """How probable it is that `f(z) <= 0`, for standard normals `z`.

    Args:
      f: limit state of many points at once, `[n, D] -> [n]`: how far a point is from the event. It has to
        lead there: a function with two values tells no method but "crude" where to go.
      dim: `D`, numbers of a point.
      method: "crude", "subset", "cross-entropy" or "splitting"; "auto": plain counting where a pilot of
        `samples` draws sees the event ten times, and subset simulation otherwise.
      samples: points per level and run.
      runs: independent runs, at least 10.
      least: probability below which an event is not followed; the result is a bound then.
      born: `[D]` for "splitting": the moment at which each number is drawn. `f` returns paths then,
        `[n, T]`, and the event is that a path gets to 0. What a path does before a moment must not depend
        on the numbers of that moment.
      level: of confidence.
      seed: of all random numbers.

    Raises:
      ValueError: a number out of range, or a limit state of another shape or with NaN; one line.
    """
    moments = check_settings(dim, method, samples, runs, least, born, level)
    ask = _Meter(f, paths=moments is not None)
    if method == "auto":
        pilot = _lockstep([crude(np.random.default_rng([seed, _PILOT]), dim, samples)], ask)
        method = "crude" if pilot[0].probability * samples >= PILOT_EVENTS else "subset"

    def sampler(run: int) -> Sampler:
        rng = np.random.default_rng([seed, run])
        if method == "crude":
            return crude(rng, dim, samples)
        if moments is not None:
            return splitting(rng, dim, samples, least, moments)
        return (subset if method == "subset" else cross_entropy)(rng, dim, samples, least)

    found = _lockstep([sampler(run) for run in range(runs)], ask)
    probability, notes = summarise(found, samples, level)
    points = np.concatenate([run.points for run in found])
    weights = np.concatenate([run.weights * run.probability for run in found])
    return RareEvent(
        probability=probability,
        method=method,
        runs=np.array([run.probability for run in found]),
        calls=ask.calls,
        levels=float(np.mean([run.levels for run in found])),
        points=points,
        weights=weights / weights.sum() if weights.any() else np.zeros(len(points)),
        run=np.repeat(np.arange(runs), [len(run.points) for run in found]),
        notes=notes,
        level=level,
    )


def summarise(found: Sequence[Run], samples: int, level: float) -> tuple[Interval, tuple[str, ...]]:
    """The interval of a probability from independent runs, and notes.

    Args:
      found: the runs, of `samples` points per level each.
      samples: see above.
      level: of confidence.
    """
    p = np.array([run.probability for run in found])
    draws = len(found) * samples
    notes = tuple(sorted({run.note for run in found if run.note}))
    if all(run.ended and run.levels == 0 for run in found):  # each is a count
        events = round(float(p.sum()) * samples)
        if events:
            return wilson(events, draws, level), notes
        return Interval(0.0, 0.0, zero_event_bound(draws, level)), notes
    missed = sum(not run.ended for run in found)
    if not p.any():
        plain = zero_event_bound(draws, level)
        bound = max(run.bound for run in found)
        sure = f"{plain:.2g} is sure whatever the limit state is: {draws} draws without the event"
        if bound >= plain or notes:
            return Interval(0.0, 0.0, plain), (f"no run came to the event; {sure}", *notes)
        said = f"no run came to the event; {bound:.2g} holds if the limit state leads there, {sure}"
        return Interval(0.0, 0.0, bound), (said, *notes)
    if not p.all():
        said = f"{missed} of {len(found)} runs did not come to the event; more samples help"
        low, high = _of_mean(p, level)
        return Interval(float(p.mean()), max(low, 0.0), high), (said, *notes)
    return _of_log_normal(p, level), notes


def _of_log_normal(p: Floats, level: float) -> Interval:
    """Mean of log-normal values: Cox's method with Student's t (Olsson 2005); `p` above 0."""
    from scipy.stats import t

    y, n = np.log(p), len(p)
    variance = float(y.var(ddof=1))
    middle = float(y.mean()) + variance / 2
    half = float(t.ppf((1 + level) / 2, n - 1)) * math.sqrt(variance / n + variance**2 / (2 * (n - 1)))
    return Interval(float(p.mean()), math.exp(middle - half), min(math.exp(middle + half), 1.0))


def _of_mean(p: Floats, level: float) -> tuple[float, float]:
    """Bounds of the mean by Student's t."""
    from scipy.stats import t

    half = float(t.ppf((1 + level) / 2, len(p) - 1)) * float(p.std(ddof=1)) / math.sqrt(len(p))
    return float(p.mean()) - half, min(float(p.mean()) + half, 1.0)


class _Meter:
    """The limit state, with its calls counted and its values checked."""

    def __init__(self, f: Callable[[Any], Any], *, paths: bool) -> None:
        self._f, self._paths, self.calls = f, paths, 0

    def __call__(self, z: Floats) -> Floats:
        g = np.asarray(self._f(z), np.float64)
        self.calls += len(z)
        wanted = f"[{len(z)}, T], a path per point" if self._paths else f"[{len(z)}], a value per point"
        if g.ndim != 1 + self._paths or len(g) != len(z) or g.size == 0:
            raise ValueError(
                f"f: it returned the shape {list(g.shape)} for {len(z)} points; {wanted} is needed"
            )
        if np.isnan(g).any():
            first = int(np.flatnonzero(np.isnan(g.reshape(len(z), -1)).any(1))[0])
            raise ValueError(f"f: its value is NaN at {np.array2string(z[first][:5], precision=3)}...")
        return g


def _lockstep(samplers: Sequence[Sampler], ask: Callable[[Floats], Floats]) -> list[Run]:
    """Run samplers side by side: what they ask for at the same time is one call."""
    found: dict[int, Run] = {}
    asked = {k: next(sampler) for k, sampler in enumerate(samplers)}
    while asked:
        values = ask(np.concatenate(list(asked.values())))
        ends = np.cumsum([len(z) for z in asked.values()])
        parts = np.split(values, ends[:-1])
        waiting: dict[int, Floats] = {}
        for k, part in zip(asked, parts, strict=True):
            try:
                waiting[k] = samplers[k].send(part)
            except StopIteration as stop:
                found[k] = stop.value
        asked = waiting
    return [found[k] for k in range(len(samplers))]


def check_settings(
    dim: int, method: str, samples: int, runs: int, least: float, born: ArrayLike | None, level: float
) -> NDArray[np.int64] | None:
    """Refuse settings that make no sense; the moments of the numbers for splitting.

    Raises `ValueError` with one line.
    """
    check_level(level)
    if method not in get_args(Method):
        raise ValueError(f"method: '{method}'; known are {', '.join(get_args(Method))}")
    if dim < 1:
        raise ValueError(f"dim: {dim}; at least 1")
    if samples < LEAST_SAMPLES:
        raise ValueError(f"samples: {samples}; at least {LEAST_SAMPLES} per level and run")
    if runs < RUNS:
        raise ValueError(f"runs: {runs}; at least {RUNS}, as the interval comes from their spread")
    if not 0 < least < 1:
        raise ValueError(f"least: {least:g}; a probability between 0 and 1, such as {LEAST:g}")
    if method == "cross-entropy" and dim > CROSS_ENTROPY_MOST:
        raise ValueError(
            f"method: cross-entropy serves {CROSS_ENTROPY_MOST} dimensions at most, and there are {dim}; "
            "take subset"
        )
    if method != "splitting":
        if born is not None:
            raise ValueError(f"born: of the method 'splitting', not of '{method}'")
        return None
    moments = None if born is None else np.asarray(born)
    if moments is None or moments.shape != (dim,) or moments.dtype.kind not in "iu":
        raise ValueError(f"born: splitting needs a whole number per dimension, {dim} of them")
    if moments.min() == moments.max():
        raise ValueError("born: all numbers are drawn at the same moment, so no future can be drawn anew")
    return moments.astype(np.int64)


__all__ = [
    "LEAST",
    "LEAST_SAMPLES",
    "RUNS",
    "Method",
    "RareEvent",
    "check_settings",
    "rare_event",
    "summarise",
]
