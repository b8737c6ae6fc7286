"""Parameters without gradients: what the whole engine is compared with, statistics of many worlds.

`match` makes the distance of named statistics from their targets least with CMA-ES (Hansen 2016, arXiv
1604.00772), a batch of candidates at a time. `Engine` is such a simulation: factors on the medians of a
population's parameters in, saturation flow, lane-change rate and other results of a measure. All
candidates see the same seeds (common random numbers), so their differences are not those of the draws; and
the factors are arrays, so that there is one compiled program.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from cmaes import CMA
from jax import lax
from jaxtyping import Array, Bool, Float
from numpy.typing import NDArray

from limsim_jax.files import write_whole
from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.metrics.reductions import Measured, on_host
from limsim_jax.metrics.traffic import Detectors, TrafficCarry, TrafficMetrics, TrafficStep
from limsim_jax.numerics import safe_divide
from limsim_jax.simulation.rollout import Rollout, one_world
from limsim_jax.traffic.demand import Demand, sample_scenario
from limsim_jax.traffic.engine import Tick
from limsim_jax.traffic.population_file import FORMAT, read_population
from limsim_jax.traffic.vehicles import NORMAL, PARAMETERS, Population, default_population
from limsim_jax.types import Config, State

Floats = NDArray[np.float64]

_WORST = 1e6  # distance of what cannot be measured


# --- the optimiser -----------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Match:
    """Result of `match`."""

    parameters: dict[str, float]
    start: dict[str, float]
    targets: dict[str, float]
    before: dict[str, float]  # statistics at the start
    after: dict[str, float]
    distance: tuple[float, float]  # before and after
    history: Floats  # least distance of every generation
    evaluations: int


def match(
    simulate: Callable[[Floats], Mapping[str, Any]],
    targets: Mapping[str, float],
    start: Mapping[str, float],
    bounds: Mapping[str, tuple[float, float]],
    *,
    scales: Mapping[str, float] | None = None,
    tame: float = 0.0,
    members: int = 8,
    generations: int = 10,
    width: float = 0.2,
    seed: int = 0,
) -> Match:
    """Parameters whose statistics are nearest to the targets.

    Args:
      simulate: statistics by name, `[M]` each, of candidates `[M P]`; always as many, the same random numbers
        for all. NaN: could not be measured.
      targets: by name, some or all of these statistics.
      start: parameters by name, in the order of the columns of the candidates.
      bounds: least and largest value; a parameter with positive bounds is searched in logarithms.
      scales: differences that are equally bad; default: a tenth of the target.
      tame: added to the distance per squared distance from the start, bounds being 1 apart: where targets
        leave parameters open, they stay.
      members: candidates at once, at least 4.
      generations: times that they are replaced.
      width: standard deviation of the first candidates, bounds being 1 apart.
      seed: of the search.

    Returns:
      What was found; the distance is the root of the sum of squared differences over `scales`.

    Raises:
      ValueError: names that do not fit, or a start outside its bounds; one line.
    """
    names = tuple(start)
    if set(bounds) != set(names) or not names:
        raise ValueError(
            f"bounds of {', '.join(bounds)}; bounds of {', '.join(names)}, as the start, are expected"
        )
    if not targets:
        raise ValueError("no targets; at least one statistic is needed")
    if members < 4 or generations < 1:
        raise ValueError(f"{members} members, {generations} generations; at least 4 and 1 are needed")
    low, high = (np.array([bounds[name][k] for name in names], float) for k in (0, 1))
    first = np.array([start[name] for name in names], float)
    for name, a, x, b in zip(names, low, first, high, strict=True):
        if not (a < b and a <= x <= b and math.isfinite(b - a)):
            raise ValueError(f"{name}: start {x:g}, bounds {a:g} to {b:g}; lower <= start <= upper is needed")
    ratio = low > 0

    def unit(x: Floats) -> Floats:
        logs = [np.log(np.where(ratio, value, 1)) for value in (x, low, high)]
        return np.where(
            ratio, (logs[0] - logs[1]) / np.where(ratio, logs[2] - logs[1], 1), (x - low) / (high - low)
        )

    def real(u: Floats) -> Floats:
        grown = np.where(ratio, low, 1) * (np.where(ratio, high, 1) / np.where(ratio, low, 1)) ** u
        return np.where(ratio, grown, low + (high - low) * u)

    goal = np.array(list(targets.values()), float)
    scale = np.array([(scales or {}).get(name, max(abs(x) / 10, 1e-9)) for name, x in targets.items()])
    origin = unit(first)
    best: tuple[float, Floats, Floats] = (math.inf, origin, goal * np.nan)
    before: tuple[float, Floats] | None = None
    history = []
    size = max(len(names), 2)  # CMA-ES wants two; the second of one means nothing
    mean = np.append(origin, np.full(size - len(names), 0.5))
    box = np.tile([0.0, 1.0], (size, 1))
    search = CMA(mean, width, bounds=box, seed=seed, population_size=members)
    for generation in range(generations):
        points = np.stack([search.ask() for _ in range(members)])
        if generation == 0:
            points[0] = mean
        inside = points[:, : len(names)]
        found = simulate(real(inside))
        missing = [name for name in targets if name not in found]
        if missing:
            raise ValueError(f"statistic '{missing[0]}' is unknown; known are {', '.join(found)}")
        values = np.stack([np.asarray(found[name], float) for name in targets], -1)
        if values.shape != (members, len(goal)):
            raise ValueError(
                f"statistics of shape {values.shape[:1]}; one number for each of {members} candidates"
            )
        off = np.sum(((values - goal) / scale) ** 2, axis=-1)
        off = np.where(np.isfinite(off), off, _WORST)
        cost = off + tame * np.sum((inside - origin) ** 2, axis=-1)
        search.tell(list(zip(points, cost.tolist(), strict=True)))
        if before is None:
            before = math.sqrt(off[0]), values[0]
        k = int(np.argmin(cost))
        if cost[k] < best[0]:
            best = float(cost[k]), inside[k].copy(), values[k]
        history.append(best[0])
    assert before is not None
    after = float(np.sqrt(np.sum(((best[2] - goal) / scale) ** 2)))
    return Match(
        parameters=dict(zip(names, real(best[1]).tolist(), strict=True)),
        start=dict(zip(names, first.tolist(), strict=True)),
        targets=dict(zip(targets, goal.tolist(), strict=True)),
        before=dict(zip(targets, before[1].tolist(), strict=True)),
        after=dict(zip(targets, best[2].tolist(), strict=True)),
        distance=(before[0], after),
        history=np.sqrt(np.asarray(history)),
        evaluations=members * generations,
    )


# --- the engine --------------------------------------------------------------------------------------


def scaled(population: Population, names: Sequence[str], factors: Float[Array, " P"]) -> Population:
    """The population with medians and bounds of some parameters multiplied.

    The spread of a log-normal parameter is relative and stays; that of a normal one is multiplied as well.

    Raises:
      ValueError: a parameter is unknown.
    """
    for name in names:
        if name not in PARAMETERS:
            raise ValueError(f"parameter '{name}' is unknown; known are {', '.join(PARAMETERS)}")
    times = jnp.ones(len(PARAMETERS)).at[np.array([PARAMETERS.index(name) for name in names])].set(factors)
    normal = jnp.asarray([name in NORMAL for name in PARAMETERS])
    return replace(
        population,
        median=population.median * times[None],
        lower=population.lower * times[None],
        upper=population.upper * times[None],
        spread=population.spread * jnp.where(normal, times, 1)[None],
    )


@dataclass(frozen=True)
class TrafficFlow:
    """Measures the flow of worlds, with or without egos, for `Rollout.measure`.

    Attributes:
      detectors: lane row and s, m, of each.
      begin: s, when measuring starts.
    """

    detectors: tuple[tuple[int, float], ...] = ()
    begin: float = 0.0

    def init(self, config: Config, lane_map: LaneMap, state: State) -> tuple[TrafficCarry, None]:
        """Before the first step. The start does not count."""
        del lane_map
        return TrafficMetrics(config.dt).init(state.lane.shape[0], len(self.detectors)), None

    def record(self, config: Config, lane_map: LaneMap, tick: Tick) -> TrafficStep:
        """A physics step of the traffic."""
        del config, lane_map
        state, nobody = tick.state, jnp.zeros_like(tick.left)
        return TrafficStep(
            t=tick.time, active=state.active, lane=state.lane, s=state.s, dx=tick.dx, v=state.v,
            v_free=tick.decision.v0, inside=~nobody, changed=nobody, left=tick.left, entered=state.entered,
        )  # fmt: skip

    def update(
        self,
        config: Config,
        lane_map: LaneMap,
        carry: TrafficCarry,
        records: TrafficStep,
        *,
        start: bool | Bool[Array, ""] = False,
    ) -> TrafficCarry:
        """The steps since the last decision."""
        del lane_map, start
        metrics = TrafficMetrics(config.dt)
        lane, s = ([row[k] for row in self.detectors] for k in (0, 1))
        places = Detectors(jnp.asarray(lane, jnp.int32), jnp.asarray(s, jnp.float32))

        def step(carry: TrafficCarry, now: TrafficStep) -> tuple[TrafficCarry, None]:
            beside = now.active & carry.active & (now.lane != carry.lane) & (now.s > now.dx)
            new = metrics.update(carry, places, now._replace(changed=beside))
            waits = now.t < self.begin
            return jax.tree.map(lambda x, y: jnp.where(waits, x, y), carry, new), None

        return lax.scan(step, carry, records)[0]

    def result(self, config: Config, lane_map: LaneMap, carry: TrafficCarry) -> dict[str, Measured]:
        """All of `metrics.traffic.NAMES`, and with detectors `saturation_flow_per_hour`, over all of them."""
        length = jnp.sum(jnp.where(lane_map.valid, lane_map.length, 0))
        found = TrafficMetrics(config.dt).result(carry, length)
        if self.detectors:
            time, number = jnp.sum(carry.discharge.total), jnp.sum(carry.discharge.weight)
            found["saturation_flow_per_hour"] = Measured(3600 * safe_divide(number, time), number > 0)
        return found


@dataclass(frozen=True)
class Engine:
    """Worlds of the simulator by factors on the medians of its population.

    Attributes:
      run: with a `measure`.
      lane_map: where.
      demand: of vehicles; the factors multiply its population.
      slots: of vehicles.
      names: parameters of the population that have a factor.
    """

    run: Rollout
    lane_map: LaneMap
    demand: Demand
    slots: int
    names: tuple[str, ...]

    @cached_property
    def _worlds(self) -> Any:
        def one(factors: Array, seed: Array, lane_map: LaneMap, demand: Demand) -> Any:
            who = scaled(demand.population, self.names, factors)
            changed = replace(demand, population=who)
            sampler = lambda key: sample_scenario(changed, lane_map, key, self.slots)  # noqa: E731
            return one_world(self.run, lane_map, sampler, seed).measures

        over_seeds = jax.vmap(one, in_axes=(None, 0, None, None))
        return jax.jit(jax.vmap(over_seeds, in_axes=(0, None, None, None)))

    def measure(self, factors: Floats, seeds: Sequence[int]) -> dict[str, Floats]:
        """Measured values of candidates `[M P]` in every world, `[M S]`; NaN: none."""
        found = self._worlds(
            jnp.asarray(factors, jnp.float32), jnp.asarray(seeds, jnp.int32), self.lane_map, self.demand
        )
        return on_host(found)

    def means(self, seeds: Sequence[int]) -> Callable[[Floats], dict[str, Floats]]:
        """For `match`: means over these seeds, `[M]`."""

        def simulate(factors: Floats) -> dict[str, Floats]:
            return {name: np.mean(x, axis=-1) for name, x in self.measure(factors, seeds).items()}

        return simulate


def write_scaled(
    factors: Mapping[str, float],
    path: str | Path,
    *,
    base: str | Path | None = None,
    classes: Sequence[str] = ("car",),
    sources: Sequence[str] = (),
) -> None:
    """Write a population with the medians of some parameters multiplied.

    Args:
      factors: by parameter.
      path: of the new file.
      base: file of the population that is changed; None: the default one.
      classes: vehicle classes that drive like this, if there is no `base`.
      sources: names of what the factors come from.

    Raises:
      ValueError: a parameter is unknown, or the base is not as it should be.
    """
    if base is None:
        content: dict[str, Any] = {
            "format": FORMAT,
            "sources": [],
            "classes": list(classes),
            "parameters": {},
        }
        content["correlation"] = []
    else:
        read_population(base)  # refuses what is no such file
        content = json.loads(Path(base).read_text(encoding="utf-8"))
    rows = content["parameters"]
    who = default_population({content["classes"][0]: 1.0})
    kind = int(np.argmax(np.asarray(who.share)))
    old = np.asarray(content["correlation"], float).reshape(len(rows), len(rows))
    for name, factor in factors.items():
        if name not in PARAMETERS:
            raise ValueError(f"parameter '{name}' is unknown; known are {', '.join(PARAMETERS)}")
        k = PARAMETERS.index(name)
        row = rows.get(name) or {
            field: float(np.asarray(getattr(who, field))[kind, k])
            for field in ("median", "spread", "lower", "upper")
        }
        also = ("spread",) if name in NORMAL else ()
        rows[name] = row | {field: row[field] * factor for field in ("median", "lower", "upper", *also)}
    correlation = np.eye(len(rows))
    correlation[: len(old), : len(old)] = old
    content |= {"correlation": correlation.tolist(), "sources": [*content.get("sources", []), *sources]}
    write_whole(path, json.dumps(content, indent=1) + "\n")


__all__ = ["Engine", "Match", "TrafficFlow", "match", "scaled", "write_scaled"]
