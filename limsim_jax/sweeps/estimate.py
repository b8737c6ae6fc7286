"""The probability of a rare event in the worlds of an experiment.

The random numbers of a world are one array of standard normals (`traffic.demand.draws.Layout`). Samplers of
`rare_events` move through it, and every array they ask for is a world that the program of a sweep runs. What
a policy draws hangs on the array, too, so an array is a world that can be run again.

    DIR/estimate.json            how it is made, and what was found
    DIR/worlds/000012.npz        metrics of a batch of worlds: an interrupted estimate goes on from these
    DIR/failures.npz             worlds with the event: random numbers, weights, metrics
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from limsim_jax.rare_events.estimate import LEAST_SAMPLES, RUNS, RareEvent, check_settings, rare_event
from limsim_jax.rare_events.samplers import LEVEL
from limsim_jax.statistics import Interval
from limsim_jax.sweeps.asked import Asked, Log, Tell, event_in
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.sweeps.events import Event
from limsim_jax.sweeps.numbered import names_of

Method = Literal["subset", "crude", "cross-entropy"]

LEAST = 1e-4
"""Probability per episode below which an event is not followed, unless told."""


def worlds_per_level(worlds: int, method: Method, least: float, runs: int = RUNS) -> int:
    """Worlds per level and run; at most `worlds` run in all.

    Raises:
      ValueError: too few, or an unknown method; one line.
    """
    if method not in get_args(Method):
        raise ValueError(f"method: '{method}'; known are {', '.join(get_args(Method))}")
    if not 0 < least < 1:
        raise ValueError(f"least: {least:g}; a probability between 0 and 1, such as {LEAST:g}")
    levels = max(round(np.log(least) / np.log(LEVEL)), 1)
    if method == "crude":
        share = float(runs)
    elif method == "subset":
        share = runs * (1 + (1 - LEVEL) * (levels + 1))  # one more: points of a chain that are equal
    else:
        share = runs * (2 * levels + 1)
    samples = int(worlds / share)
    if samples < LEAST_SAMPLES:
        needed = int(np.ceil(LEAST_SAMPLES * share))
        raise ValueError(
            f"worlds: {worlds} are too few for {method} down to {least:g}; at least {needed}, "
            "or a larger least probability"
        )
    return samples


class Failure(NamedTuple):
    """A world with the event."""

    number: int  # among the failures
    weight: float  # share among all worlds with the event
    metrics: dict[str, float]  # of its ego that is nearest to the event, or beyond it farthest


class Shift(NamedTuple):
    """How a random number differs in worlds with the event."""

    what: str
    mean: Interval  # standard deviations; 0 in all worlds together
    p: float  # two-sided, adjusted for all numbers that were looked at


@dataclass(frozen=True, eq=False)
class Estimate:
    """How probable an event is under a policy.

    Attributes:
      scenario, policy: names.
      event: what is looked for.
      found: the probability per episode, and how it came about.
      hours, km: of an episode, on average; of all egos of a world together.
      failures: worlds with the event, the most telling first.
      shifts: what sets them apart.
      worlds: that ran, or were on disk.
    """

    scenario: str
    policy: str
    event: Event
    found: RareEvent
    hours: float
    km: float
    failures: tuple[Failure, ...]
    shifts: tuple[Shift, ...]
    worlds: int
    values: NDArray[np.float32] = field(repr=False)  # [M, D] random numbers of the failures
    episodes: Episodes = field(repr=False)  # of the failures: seed k is failure k

    @property
    def probability(self) -> Interval:
        """Per episode."""
        return self.found.probability

    @property
    def per_hour(self) -> Interval:
        """Events per hour of driving."""
        return _over(self.probability, self.hours)

    @property
    def per_million_km(self) -> Interval:
        """Events per million km."""
        return _over(self.probability, self.km / 1e6)

    def rows(self) -> list[tuple[str, str]]:
        """The table in two columns."""
        level = f"{self.found.level * 100:g} %"
        found = self.found
        cost = f"{found.method}, {len(found.runs)} runs, {self.worlds:,} worlds"
        rows = [
            ("event", self.event.meaning),
            ("per episode", f"{_said(self.probability)}  ({level})"),
            ("per hour", _said(self.per_hour)),
            ("per million km", _said(self.per_million_km)),
            ("exposure", f"{self.hours * 3600:.1f} s and {self.km:.3f} km per episode"),
            ("method", cost),
        ]
        rows += [("note", note) for note in found.notes]
        if self.failures:
            rows.append(("worlds with the event", f"{len(self.failures)} different ones"))
            for shift in self.shifts:
                rows.append(("what sets them apart", _shift_said(shift)))
            if not self.shifts:
                rows.append(("what sets them apart", "no single random number"))
        return rows

    def __str__(self) -> str:
        rows = [(f"{self.scenario}, {self.policy}", ""), *self.rows()]
        width = max(len(name) for name, _ in rows[1:])
        return "\n".join([rows[0][0], *(f"  {name:<{width}}  {text}" for name, text in rows[1:])])

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "scenario": self.scenario,
            "policy": self.policy,
            "event": self.event.name,
            "meaning": self.event.meaning,
            "level": self.found.level,
            "per_episode": self.probability._asdict(),
            "per_hour": self.per_hour._asdict(),
            "per_million_km": self.per_million_km._asdict(),
            "hours_per_episode": self.hours,
            "km_per_episode": self.km,
            "method": self.found.method,
            "runs": self.found.runs.tolist(),
            "worlds": self.worlds,
            "notes": list(self.found.notes),
            "shifts": [{"what": x.what, **x.mean._asdict(), "p": x.p} for x in self.shifts],
            "failures": len(self.failures),
        }

    def telling(self, count: int = 3) -> list[int]:
        """Failures to look at: of each kind of contact the most probable, then by weight."""
        order = sorted(range(len(self.failures)), key=lambda k: -self.failures[k].weight)
        kinds: dict[Any, int] = {}
        for k in order:
            metrics = self.failures[k].metrics
            kinds.setdefault(str((metrics.get("contact_type"), metrics.get("contact_other"))), k)
        first = list(kinds.values())
        return [*first, *(k for k in order if k not in first)][:count]


def _over(p: Interval, exposure: float) -> Interval:
    return Interval(*(x / exposure if exposure > 0 else np.nan for x in p))


def _said(x: Interval) -> str:
    if x.estimate == 0:
        return f"below {x.high:.3g}"
    return f"{x.estimate:.3g} [{x.low:.3g}, {x.high:.3g}]"


def _shift_said(shift: Shift) -> str:
    word = "higher" if shift.mean.estimate > 0 else "lower"
    low, high = sorted((abs(shift.mean.low), abs(shift.mean.high)))
    return f"{shift.what}: {abs(shift.mean.estimate):.1f} [{low:.1f}, {high:.1f}] standard deviations {word}"


def estimate(
    episodes: Episodes,
    event: str,
    out: Path | None,
    *,
    method: Method = "subset",
    worlds: int = 5000,
    runs: int = RUNS,
    least: float = LEAST,
    level: float = 0.95,
    seed: int = 0,
    fresh: bool = False,
    tell: Tell | None = None,
) -> Estimate:
    """Estimate the probability of an event; see `api.estimate.estimate`."""
    wanted, layout = event_in(episodes, event), episodes.layout
    samples = worlds_per_level(worlds, method, least, runs)
    check_settings(layout.size, method, samples, runs, least, None, level)
    settings = {
        "event": wanted.name, "method": method, "samples": samples, "runs": runs, "least": least,
        "seed": seed, "level": level,
    }  # fmt: skip
    log = Log(out, "estimate.json", {**episodes.provenance(), "estimate": settings}, fresh)
    ask = Asked(episodes, wanted, log, tell, worlds)
    begin = time.perf_counter()
    found = rare_event(
        ask, layout.size, method=method, samples=samples, runs=runs, least=least, level=level, seed=seed
    )
    seconds = time.perf_counter() - begin
    values, weights, metrics = _distinct(ask, found)
    hours, km = ask.exposure or (np.nan, np.nan)
    done = Estimate(
        scenario=episodes.scenario,
        policy=episodes.policy,
        event=wanted,
        found=found,
        hours=hours,
        km=km,
        failures=tuple(Failure(k, float(weights[k]), metrics[k]) for k in range(len(weights))),
        shifts=shifts_of(episodes, found),
        worlds=found.calls,
        values=values,
        episodes=ask.show(values),
    )
    log.write({**done.as_json(), "ran_now": ask.ran, "seconds": round(seconds, 1)})
    log.failures(values, metrics, list(episodes.units), weights=weights)
    return done


def _distinct(
    ask: Asked, found: RareEvent
) -> tuple[NDArray[np.float32], NDArray[np.float64], list[dict[str, float]]]:
    """Different worlds with the event by falling weight: chains stay at places."""
    values = ask.layout.from_normals(found.points)
    if not len(values):
        return values, np.zeros(0), []
    kept, which = np.unique(values, axis=0, return_inverse=True)
    weights = np.bincount(which.ravel(), found.weights, len(kept)).astype(np.float64)
    order = np.argsort(-weights, kind="stable")
    return kept[order], weights[order], [ask.found[kept[k].tobytes()] for k in order]


def shifts_of(episodes: Episodes, found: RareEvent, most: int = 5) -> tuple[Shift, ...]:
    """What sets worlds with the event apart: means of random numbers, from run to run.

    In all worlds together each number has mean 0 and standard deviation 1. The means of a kind over all
    vehicles count as numbers, too. Tests are Student's over the runs, adjusted for their number (Holm).
    """
    from scipy.stats import t

    from limsim_jax.statistics import holm

    runs = [found.run == k for k in range(len(found.runs))]
    runs = [there for there in runs if there.any()]
    if len(runs) < 3:
        return ()
    numbers = episodes.layout.numbers
    kinds = sorted({number.what for number in numbers})
    member = np.array([[number.what == kind for number in numbers] for kind in kinds], float)
    member /= np.sqrt(member.sum(1, keepdims=True))
    means = []
    for there in runs:
        w = found.weights[there]
        w = w / w.sum() if w.sum() > 0 else np.full(len(w), 1 / len(w))
        mean = w @ found.points[there]
        means.append(np.concatenate([member @ mean, mean]))
    x, n = np.array(means), len(means)
    middle, error = x.mean(0), x.std(0, ddof=1) / np.sqrt(n)
    p = 2 * t.sf(np.abs(middle) / np.maximum(error, 1e-12), n - 1)
    adjusted, half = holm(p.tolist()), t.ppf(0.975, n - 1) * error
    names = [f"{kind} of all vehicles" for kind in kinds] + names_of(episodes)
    order = [k for k in np.argsort(-np.abs(middle)) if adjusted[k] < 0.05][:most]
    return tuple(
        Shift(
            names[k],
            Interval(*map(float, (middle[k], middle[k] - half[k], middle[k] + half[k]))),
            adjusted[k],
        )
        for k in order
    )


def failures_of(folder: Path) -> tuple[NDArray[np.float32], Sequence[float]]:
    """Random numbers `[M, D]` and weights of the failures in a folder."""
    with np.load(folder / "failures.npz") as kept:
        return kept["values"], kept["weights"].tolist()
