"""Cross-validation of a population in closed loop, and its report."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from limsim_jax.calibration.cleaning import Segment
from limsim_jax.calibration.closed_loop.chains import Linked
from limsim_jax.calibration.closed_loop.descent import (
    SPEED_LIMIT,
    WEIGHTS,
    default_drivers,
    descend,
    drawn,
    loss_scale,
    moved,
    scores,
    start_populations,
    usual_population,
)
from limsim_jax.calibration.closed_loop.distances import (
    UNITS,
    Distances,
    distances,
    floor,
    from_own,
    samples,
    simulate_samples,
)
from limsim_jax.calibration.fit import fit, model_name
from limsim_jax.calibration.parameters import PARAMETERS
from limsim_jax.calibration.population import Law, estimate, write_population
from limsim_jax.traffic.car_following import ACC, IDM, CarFollowing

TURNS = 3
"""In which periods are held out."""

LEAST = 15.0
"""s of a follower, of which shorter periods have cut a part, for a fit of its own."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class ClosedLoop:
    """Result of `calibrate_closed_loop`; distances by population: `default`, `start` and `closed_loop`."""

    law: Law  # the adjusted population, of all periods
    start: Law  # of fits to single drivers
    model: CarFollowing
    sources: tuple[str, ...]  # files
    folds: tuple[tuple[str, ...], ...]  # names of the periods that were held out together
    fitted: dict[str, Distances]  # of the populations of all periods
    held_out: dict[str, Distances]  # of each period from those fitted without it
    floor: Distances  # between halves of the recorded drivers
    from_own: Distances  # of a record made by the adjusted populations from them
    overlaps: dict[str, float]  # share of the samples held out in which bodies overlap
    samples: int
    losses: Floats  # of every iteration
    seconds: float

    def falls(self) -> dict[str, float]:
        """Share of the default population's distances that is left, on held-out periods."""
        return self._of_default(self.held_out["closed_loop"])

    def reachable(self) -> dict[str, float]:
        """Share that would be left if the population were exactly right."""
        return self._of_default(self.from_own)

    def _of_default(self, found: Distances) -> dict[str, float]:
        before = self.held_out["default"]
        return {name: float(getattr(found, name) / getattr(before, name)) for name in Distances._fields}

    def as_json(self) -> dict[str, Any]:
        """Plain values."""

        def plain(found: Distances) -> dict[str, float]:
            return {name: float(x) for name, x in found._asdict().items()}

        return {
            "model": model_name(self.model),
            "units": UNITS,
            "folds": [list(names) for names in self.folds],
            "samples": self.samples,
            "fitted": {name: plain(x) for name, x in self.fitted.items()},
            "held_out": {name: plain(x) for name, x in self.held_out.items()},
            "floor": plain(self.floor),
            "from_own": plain(self.from_own),
            "left_of_default": self.falls(),
            "reachable": self.reachable(),
            "overlaps": self.overlaps,
            "population": {
                name: {"median": law.median, "spread": law.spread}
                for name, law in (("start", self.start), ("closed_loop", self.law))
            },
            "losses": self.losses.tolist(),
            "seconds": self.seconds,
        }

    def text(self) -> str:
        """For the terminal."""
        lines = [
            f"closed loop, {model_name(self.model).upper()}: {sum(map(len, self.folds))} periods, "
            f"held out in {len(self.folds)} turns ({self.samples} samples)",
            f"{'':34}" + "".join(f"{f'{name}, {UNITS[name]}':>18}" for name in Distances._fields),
        ]
        names = {
            "default": "default drivers",
            "start": "fits of single drivers",
            "closed_loop": "closed loop",
        }
        rows = [(f"fitted, {names[key]}", row) for key, row in self.fitted.items()]
        rows += [(f"held out, {names[key]}", row) for key, row in self.held_out.items()]
        rows += [("between halves of the record", self.floor), ("of a record of its own", self.from_own)]
        for name, row in rows:
            lines.append(f"{name:38}" + "".join(f"{float(x):>16.3f}  " for x in row)[4:])
        of = self.reachable()
        left = ", ".join(f"{name} {share:.0%} ({of[name]:.0%})" for name, share in self.falls().items())
        lines.append(f"left of the default drivers' distances, held out (if exactly right): {left}")
        values = ", ".join(
            f"{name} {self.law.median[name]:.2f} x/ {np.exp(self.law.spread[name]):.2f}"
            for name in PARAMETERS
        )
        return "\n".join([*lines, f"population in closed loop: {values}"])

    def write_population(
        self,
        path: str | Path,
        *,
        classes: Sequence[str] = ("car",),
        speed_limit: float | None = None,
    ) -> None:
        """The adjusted population as a file for scenarios, see `population.write_population`."""
        write_population(self.law, path, sources=self.sources, classes=classes, speed_limit=speed_limit)


def hold_out(linked: Linked, turns: int = TURNS) -> list[list[int]]:
    """Periods to hold out in turns: of every recording one stretch each time.

    Recordings of fewer periods than turns are held out period by period, in turns over all of them.

    Raises:
      ValueError: fewer than two turns, or nothing is left to fit.
    """
    if turns < 2:
        raise ValueError(f"{turns} turns? at least 2, so that some periods are fitted and others held out")
    of: dict[str, list[int]] = {}
    for k, source in enumerate(linked.sources):
        of.setdefault(source, []).append(k)
    found: list[list[int]] = [[] for _ in range(turns)]
    short: list[int] = []
    for these in of.values():
        if len(these) < turns:
            short += these
            continue
        for turn, some in enumerate(np.array_split(these, turns)):
            found[turn] += some.tolist()
    for i, k in enumerate(short):
        found[i % turns].append(k)
    found = [sorted(some) for some in found if some]
    if len(found) < 2:
        raise ValueError(
            f"one period only ({linked.periods[0]}); a shorter 'period' or another recording is needed "
            "to hold one out"
        )
    return found


def outside(found: Sequence[Segment], linked: Linked, periods: Sequence[int]) -> list[Segment]:
    """Parts of the segments outside these periods, of at least `LEAST` s.

    A segment that was shorter stays if it is whole.
    """
    spans = {source: [] for source in linked.sources}
    for k in periods:
        spans[linked.sources[k]].append(linked.spans[k])
    left = []
    for segment in found:
        at = segment.time + segment.dt * (np.arange(len(segment)) + 1e-3)
        keep = np.ones(len(segment), bool)
        for begin, end in spans.get(segment.source, []):
            keep &= (at < begin) | (at >= end)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], keep, [False]]).astype(int)))
        least = min(LEAST, segment.duration) - 1.5 * segment.dt
        parts = [segment.part(i, j) for i, j in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)]
        left += [part for part in parts if part.duration >= least]
    return left


def single_fits(
    found: Sequence[Segment], model: CarFollowing = IDM(), *, starts: int | None = 4, **options: Any
) -> Law:
    """The population of fits to single drivers; arguments as of `fit.fit`."""
    return estimate(fit(found, model, starts=starts, **options), found, rounds=1)


def calibrate_closed_loop(
    linked: Linked,
    found: Sequence[Segment],
    *,
    population: Callable[[Sequence[Segment]], Law] = single_fits,
    model: CarFollowing = ACC(),
    turns: int = TURNS,
    speed_limit: float = SPEED_LIMIT,
    draws: int = 8,
    iterations: int = 120,
    seed: int = 0,
    weights: Mapping[str, float] | None = None,
) -> ClosedLoop:
    """Adjust a population until simulated traffic is distributed as recorded traffic.

    Args:
      linked: from `linked_recordings`.
      found: followers of the same recordings, from `report.gather`.
      population: of followers, to start from; called with those of the periods of each fit.
      model: of car following, that drives.
      turns: see `hold_out`.
      speed_limit: m/s, for the default population, and for desired speeds that the data do not tell.
      draws: simulations with other drivers, in the fit; twice as many others, in the comparison.
      iterations: of Adam, from each of two populations.
      seed: of the drivers' scores.
      weights: of distances, instead of those in `WEIGHTS`.

    Raises:
      ValueError: an unknown distance, fewer than three drivers, or nothing to hold out.
    """
    begin = time.perf_counter()
    for name in weights or {}:
        if name not in Distances._fields:
            raise ValueError(f"distance '{name}' is unknown; known are {', '.join(Distances._fields)}")
    folds = [tuple(held) for held in hold_out(linked, turns)]
    count, every = len(linked.drivers), range(len(linked.periods))
    followers = {held: outside(found, linked, held) for held in ((), *folds)}
    for held, some in followers.items():
        if (left := len({segment.driver for segment in some})) < 3:
            without = f" without {', '.join(linked.periods[k] for k in held)}" if held else ""
            raise ValueError(f"{left} drivers to fit{without}; at least 3 are needed")
    z = scores(2 * draws, count, seed + 1)
    z_fit = scores(draws, count, seed)
    default = default_drivers(2 * draws, count, seed + 1, speed_limit)
    usual = usual_population(speed_limit)

    def fitted(held: tuple[int, ...]) -> tuple[Law, Law, Floats]:
        """Populations of all other periods: of single fits, and in closed loop; the losses."""
        start = population(followers[held])
        part = linked.part([k for k in every if k not in held])
        recorded = samples(part)
        chains = jax.tree.map(jnp.asarray, part.chains)
        scale = loss_scale(recorded, WEIGHTS | dict(weights or {}))
        ends = []
        for mean, root in start_populations(start, *usual):
            point, losses = descend(
                model, mean, root, z_fit, chains, recorded, scale, linked.dt,
                int(recorded.point.max()) + 1, iterations, start.box,
            )  # fmt: skip
            ends.append((float(jnp.min(losses)), moved(mean, root, point), losses))
        _, (mean, root), losses = min(ends, key=lambda end: end[0])
        factor = np.asarray(root, float)
        law = replace(start, mean=np.asarray(mean, float), covariance=factor @ factor.T, model=model)
        return start, law, np.asarray(losses, float)

    def simulated(laws: tuple[Law, Law], periods: Sequence[int]) -> dict[str, tuple[Floats, Floats]]:
        """Gaps and speeds `[K M]` of these periods, by population."""
        part = linked.part(periods)
        recorded, chains = samples(part), jax.tree.map(jnp.asarray, part.chains)
        drivers = {"default": default}
        for name, law in zip(("start", "closed_loop"), laws, strict=True):
            mean, root = (jnp.asarray(x, jnp.float32) for x in (law.mean, np.linalg.cholesky(law.covariance)))
            drivers[name] = drawn(mean, root, z, law.box)
        return {
            name: jax.device_get(simulate_samples(model, p, chains, recorded, linked.dt))
            for name, p in drivers.items()
        }

    log = samples(linked)
    points = int(log.point.max()) + 1
    of = np.asarray(log.at) // math.prod(linked.counts.shape[1:])  # period of each sample
    start, law, losses = fitted(())
    all_fitted = simulated((start, law), every)
    held_out = {name: (np.zeros_like(gap), np.zeros_like(v)) for name, (gap, v) in all_fitted.items()}
    for held in folds:
        for name, both in simulated(fitted(held)[:2], held).items():
            for values, x in zip(held_out[name], both, strict=True):
                values[:, np.isin(of, held)] = x

    def apart(made: Mapping[str, tuple[Floats, Floats]]) -> dict[str, Distances]:
        return {name: _on_host(distances(log, *both, points)) for name, both in made.items()}

    return ClosedLoop(
        law=law,
        start=start,
        model=model,
        sources=tuple(dict.fromkeys(linked.sources)),
        folds=tuple(tuple(linked.periods[k] for k in held) for held in folds),
        fitted=apart(all_fitted),
        held_out=apart(held_out),
        floor=floor(linked),
        from_own=_on_host(from_own(log, *held_out["closed_loop"], points)),
        overlaps={name: float(np.mean(gap <= 0)) for name, (gap, _) in held_out.items()},
        samples=len(log.at),
        losses=losses,
        seconds=time.perf_counter() - begin,
    )


def _on_host(found: Distances) -> Distances:
    return Distances(*(float(x) for x in found))


__all__ = ["ClosedLoop", "calibrate_closed_loop", "hold_out", "outside", "single_fits"]
