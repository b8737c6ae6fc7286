"""The driver population under which simulated traffic is distributed as the recorded one.

Fits of single drivers follow *recorded* leaders. Here followers drive behind the *simulated* vehicles ahead
of them, as in the simulator, so that what one driver does wrong reaches all behind: only who has no leader in
the recording follows its log. Vehicles enter, change lanes and get other leaders when they did so in the
recording. Their drivers are drawn from the population, not fitted: the medians and spreads of its parameters
are adjusted until time headways, speeds, gaps and the fundamental diagram have the recorded distributions.

The scores of the drivers are the same whatever the population is (common random numbers), and the distance of
two distributions is the mean distance of their sorted samples (Wasserstein-1), so the loss has gradients by
the population, through the rollout. It is descended from two populations, that of fits to single drivers and
the simulator's own, to the lower end.

All periods are held out in turns (cross-validation): each is simulated with a population that was fitted
without it. `ClosedLoop` has the distances of all of them together, before and after, and two yardsticks: how
far apart two halves of the recorded vehicles themselves are, and how far a record is from the population that
made it, which is as near as one comes that is exactly right.

What has no gradient is for `matching`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray
from scipy.stats import truncnorm, wasserstein_distance

from limsim_jax.calibration.cleaning import Segment, segments
from limsim_jax.calibration.fit import LOWER, MODELS, PARAMETERS, UPPER, driver, fit
from limsim_jax.calibration.population import IDENTIFIED, Law, estimate, write_population
from limsim_jax.recordings import RecordingError, Source, as_recording
from limsim_jax.traffic.car_following import CarFollowing, ballistic
from limsim_jax.traffic.vehicles import CUT, default_population, sample_vehicles

PERIOD = 60.0
"""s, after which everybody is put where it was recorded again."""

SETTLE = 5.0
"""s after the start or entry of a vehicle that do not count: it is where it was recorded."""

LONGEST = 10.0
"""s, time headways are cut off here."""

SLOWEST = 1.0
"""m/s, least speed that a gap is divided by for a time headway."""

SLICE = 15.0
"""s of a chain of vehicles that make one point of the fundamental diagram."""

SPEED_LIMIT = 30.0
"""m/s, where the recording tells none; only the default population asks for it."""

WEIGHTS = {"headway": 1.0, "speed": 2.0, "gap": 1.0, "mean_speed": 1.0, "flow": 1.0}
"""Of the distances in the loss, each over the spread of its quantity: three of them tell of spacing, two of
speed."""

UNITS = {"headway": "s", "speed": "m/s", "gap": "m", "mean_speed": "m/s", "flow": "veh/h"}
"""Of the distances."""

TURNS = 3
"""In which periods are held out."""

LEAST = 15.0
"""s of a follower, of which shorter periods have cut a part, for a fit of its own."""

_SHORT = 1.0  # s, shorter segments are left out
_EVERY = 1.0  # s between the samples of a vehicle that are compared
_TAME = 0.05  # weight of what the population has moved, in standard deviations of its parameters

Floats = NDArray[np.float64]


class Chains(NamedTuple):
    """Followers behind one another, `W` periods of `T` steps with rows for `V` vehicles; or `[T, V]` of one.

    Where a row does not follow, all its numbers are harmless.
    """

    gap: Float[Array, "*W T V"]  # m, bumper to bumper
    v: Float[Array, "*W T V"]  # m/s
    v_lead: Float[Array, "*W T V"]  # m/s
    a_lead: Float[Array, "*W T V"]  # m/s^2, of the step before
    length_lead: Float[Array, "*W T V"]  # m
    leader: Int[Array, "*W T V"]  # row of the leader, -1 if it follows nobody in this period
    follows: Bool[Array, "*W T V"]
    fresh: Bool[Array, "*W T V"]  # begins to follow this leader


class Linked(NamedTuple):
    """Recorded traffic as chains."""

    chains: Chains  # [W T V]
    drivers: tuple[str, ...]  # [D]
    who: NDArray[np.int64]  # [W V], driver of the row
    periods: tuple[str, ...]  # names, [W]
    sources: tuple[str, ...]  # files, [W]
    spans: NDArray[np.float64]  # s, [W 2], begin and end in the time of the file
    dt: float  # s
    counts: NDArray[np.bool_]  # [W T V], what is compared
    slice: NDArray[np.int64]  # [W T V], which point of the fundamental diagram it belongs to

    def part(self, periods: Sequence[int]) -> Linked:
        """Some of the periods."""
        at = np.asarray(periods)
        return self._replace(
            chains=jax.tree.map(lambda x: x[at], self.chains),
            who=self.who[at],
            periods=tuple(self.periods[k] for k in periods),
            sources=tuple(self.sources[k] for k in periods),
            spans=self.spans[at],
            counts=self.counts[at],
            slice=self.slice[at],
        )


def link(found: Sequence[Segment], *, period: float = PERIOD, settle: float = SETTLE) -> Linked:
    """Chains of followers.

    Args:
      found: segments of one or more recordings, of `cleaning.segments(..., margins=False)`; a segment's
        leader is simulated where it is the driver of another segment of the same source.
      period: s, see `PERIOD`.
      settle: s, see `SETTLE`; at most a quarter of a period.

    Raises:
      ValueError: no segments, or their time steps differ.
    """
    steps = sorted({segment.dt for segment in found})
    if len(steps) != 1:
        raise ValueError(
            f"segments in steps of {', '.join(f'{dt:g}' for dt in steps)} s; one is needed"
            if found
            else "no segments; recorded followers are needed to build chains from"
        )
    dt = steps[0]
    length = round(period / dt)
    names = sorted({(segment.source, segment.driver) for segment in found})
    index = {name: i for i, name in enumerate(names)}
    begins = {s: min(x.time for x in found if x.source == s) for s in {x.source for x in found}}
    # Pieces of segments by source and period: piece, first step within the period.
    windows: dict[tuple[str, int], list[tuple[Segment, int]]] = {}
    for segment in sorted(found, key=lambda x: (x.source, x.driver, x.time)):
        first = round((segment.time - begins[segment.source]) / dt)
        at = 0
        while at < len(segment):
            window, offset = divmod(first + at, length)
            end = min(at + length - offset, len(segment))
            windows.setdefault((segment.source, window), []).append((segment.part(at, end), offset))
            at = end
    wide = max(len({piece.driver for piece, _ in pieces}) for pieces in windows.values())
    who = np.zeros((len(windows), wide), np.int64)
    parts, spans = [], []
    for k, ((source, window), pieces) in enumerate(sorted(windows.items())):
        rows = {name: i for i, name in enumerate(dict.fromkeys(piece.driver for piece, _ in pieces))}
        who[k, : len(rows)] = [index[source, name] for name in rows]
        parts.append(_window(pieces, rows, (length, wide), dt))
        spans.append((begins[source] + window * period, begins[source] + (window + 1) * period))
    chains = Chains(*(np.stack(leaves) for leaves in zip(*parts, strict=True)))  # pyright: ignore[reportArgumentType]
    counts, point = _samples(chains, dt, min(settle, period / 4))
    if not counts.any():
        raise ValueError(
            f"nobody follows for longer than {min(settle, period / 4):g} s; a shorter 'settle' is needed"
        )
    sources = tuple(source for source, _ in sorted(windows))
    periods = tuple(f"{Path(source).name.split('.')[0]} {k * period:g} s" for source, k in sorted(windows))
    linked = Linked(
        chains, tuple(name for _, name in names), who, periods, sources, np.array(spans), dt, counts, point
    )
    return linked.part(np.flatnonzero(counts.any(axis=(1, 2))).tolist())


def _window(
    pieces: list[tuple[Segment, int]], rows: Mapping[str, int], shape: tuple[int, int], dt: float
) -> Chains:
    """One period, `[T V]`; a follower without a segment is at rest 10 m behind a leader at rest."""
    values: dict[str, Any] = {name: np.zeros(shape, np.float32) for name in Chains._fields[:5]}
    values["gap"] += 10
    values["length_lead"] += 4.5
    leader = np.full(shape, -1, np.int32)
    follows, fresh = np.zeros(shape, bool), np.zeros(shape, bool)
    for piece, offset in pieces:
        i, there = rows[piece.driver], slice(offset, offset + len(piece))
        values["gap"][there, i], values["v"][there, i] = piece.gap, piece.v
        values["v_lead"][there, i] = piece.v_lead
        if len(piece) > 1:
            first = 2 * piece.v_lead[0] - piece.v_lead[1]
            values["a_lead"][there, i] = np.diff(piece.v_lead, prepend=first) / dt
        values["length_lead"][there, i] = piece.length_lead
        leader[there, i] = rows.get(piece.leader, -1)
        follows[there, i] = True
        fresh[offset, i] = True
    return Chains(**values, leader=leader, follows=follows, fresh=fresh)  # pyright: ignore[reportArgumentType]


def _samples(chains: Chains, dt: float, settle: float) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """What is compared, and the point of the fundamental diagram that each sample belongs to."""
    follows = np.asarray(chains.follows)
    count, length, _ = follows.shape
    step = np.arange(length)[None, :, None]
    # steps since the vehicle was put where it was recorded
    begin = follows & ~np.concatenate([np.zeros_like(follows[:, :1]), follows[:, :-1]], axis=1)
    since = step - np.maximum.accumulate(np.where(begin, step, 0), axis=1)
    counts = follows & (since * dt >= settle - 1e-6) & (step % max(round(_EVERY / dt), 1) == 0)
    slices = math.ceil(length * dt / SLICE)
    point = np.arange(count)[:, None, None] * slices + (step * dt / SLICE).astype(int)
    return counts, np.broadcast_to(point, follows.shape)


# --- rollouts ----------------------------------------------------------------------------------------


def simulate(
    model: CarFollowing, parameters: Float[Array, "V P"], chains: Chains, dt: float
) -> tuple[Float[Array, "T V"], Float[Array, "T V"]]:
    """Gap, m, and speed, m/s, of the followers of one period behind each other.

    A vehicle starts at its recorded speed and place; from then on it is `u` metres ahead of its record.
    When it gets another leader, its gap is the recorded one and what both are ahead.

    Args:
      model: of car following.
      parameters: of the driver in each row, in the order of `PARAMETERS`.
      chains: of one period, `[T V]`.
      dt: s.
    """
    who, v0 = driver(parameters.T)

    def onward(x: Array) -> Array:
        return jnp.concatenate([x[1:], x[-1:]])

    class Carry(NamedTuple):
        gap: Array
        v: Array
        a: Array  # of the step before
        u: Array
        follows: Array

    @jax.checkpoint
    def step(carry: Carry, now: tuple[Chains, Array, Array, Array]) -> tuple[Carry, tuple[Array, Array]]:
        at, v_next, v_lead_next, stays = now
        lead = at.leader
        v = jnp.where(at.follows & carry.follows, carry.v, at.v)
        known = (lead >= 0) & at.follows[lead]
        ahead = jnp.where(lead >= 0, carry.u[lead], 0)
        gap = jnp.where(at.fresh, at.gap + ahead - carry.u, carry.gap)
        v_lead = jnp.where(known, v[lead], at.v_lead)
        a_lead = jnp.where(known & carry.follows[lead], carry.a[lead], at.a_lead)
        a = model(who, gap=gap, v=v, v_lead=v_lead, a_lead=a_lead, v0=v0)
        v_new, distance = ballistic(v, a, dt)
        of_leader = jnp.where(known, distance[lead], 0.5 * dt * (at.v_lead + v_lead_next))
        u = carry.u + jnp.where(stays, distance - 0.5 * dt * (at.v + v_next), 0)
        new = Carry(gap + of_leader - distance, v_new, (v_new - v) / dt, u, at.follows)
        return new, (gap, v)

    zero = jnp.zeros_like(v0)
    first = Carry(chains.gap[0] + zero, chains.v[0] + zero, zero, zero, jnp.zeros_like(chains.follows[0]))
    stays = chains.follows & onward(chains.follows)
    return jax.lax.scan(step, first, (chains, onward(chains.v), onward(chains.v_lead), stays))[1]


# --- distances ---------------------------------------------------------------------------------------


def wasserstein(x: Float[Array, " M"], y: Float[Array, " K"]) -> Float[Array, ""]:
    """Wasserstein-1 distance of two samples; the size of one is a multiple of the other's.

    The mean distance of sorted samples, which has gradients by them.
    """
    x, y = (x, y) if x.shape[0] >= y.shape[0] else (y, x)
    if x.shape[0] % y.shape[0]:
        raise ValueError(f"samples of {x.shape[0]} and {y.shape[0]}; one a multiple of the other is needed")
    return jnp.mean(jnp.abs(jnp.sort(x) - jnp.repeat(jnp.sort(y), x.shape[0] // y.shape[0])))


class Distances(NamedTuple):
    """How far simulated traffic is from recorded traffic, in the `UNITS`."""

    headway: Float[Array, ""] | float  # Wasserstein-1 of time headways, front to front
    speed: Float[Array, ""] | float  # of speeds
    gap: Float[Array, ""] | float  # of gaps, bumper to bumper
    mean_speed: Float[Array, ""] | float  # difference of the means
    flow: Float[Array, ""] | float  # of the flows at equal densities, mean


class Samples(NamedTuple):
    """Recorded numbers and where they are, `M` samples, `F` points of the fundamental diagram."""

    who: Int[Array, "W V"]  # driver of the row
    at: Int[Array, " M"]  # in a period, step and vehicle, flat
    gap: Float[Array, " M"]
    v: Float[Array, " M"]
    length_lead: Float[Array, " M"]
    point: Int[Array, " M"]
    density: Float[Array, " Q"]  # 1/m, where flows are compared


def samples(linked: Linked) -> Samples:
    """What is compared of the record."""
    at = np.flatnonzero(linked.counts)
    gap, v, length = (
        jnp.asarray(np.asarray(x).reshape(-1)[at], jnp.float32)
        for x in (linked.chains.gap, linked.chains.v, linked.chains.length_lead)
    )
    point = np.unique(linked.slice.reshape(-1)[at], return_inverse=True)[1]
    found = Samples(
        jnp.asarray(linked.who), jnp.asarray(at), gap, v, length, jnp.asarray(point), jnp.zeros(0)
    )
    density, _ = _edie(found, gap[None], v[None], int(point.max()) + 1)
    return found._replace(density=jnp.quantile(density.reshape(-1), jnp.linspace(0.1, 0.9, 9)))


def _edie(
    recorded: Samples, gap: Array, v: Array, points: int, counts: Array | None = None
) -> tuple[Array, Array]:
    """Density, 1/m, and flow, 1/s, of the points `[K F]`, by Edie's definitions.

    A vehicle covers the road from its front to the front of its leader; the region of a point are these
    stretches over a slice of time: density is the time spent in it by its area, flow the distance.
    """

    def total(x: Array) -> Array:
        x = x if counts is None else jnp.where(counts[None], x, 0)
        return jax.vmap(lambda x: jax.ops.segment_sum(x, recorded.point, points))(x)

    area = jnp.maximum(total(jnp.maximum(gap + recorded.length_lead[None], 1.0)), 1.0)
    return total(jnp.ones_like(gap)) / area, total(v) / area


def _flow_at(density: Array, k: Array, q: Array) -> Array:
    """Flow at some densities, from points: kernel regression, a tenth wide."""
    off = (jnp.log(jnp.maximum(k.reshape(-1), 1e-9))[None] - jnp.log(density)[:, None]) / 0.1
    # Somebody is nearest: of far points the nearest count.
    return jax.nn.softmax(-0.5 * off * off, axis=-1) @ q.reshape(-1)


@partial(jax.jit, static_argnames="points")
def _recorded_flow(recorded: Samples, counts: Array, points: int) -> Array:
    """Flow of some of the recorded samples at the densities that are compared."""
    k, q = _edie(recorded, recorded.gap[None], recorded.v[None], points, counts)
    return _flow_at(recorded.density, k, q)


def headway(gap: Array, v: Array, length_lead: Array) -> Array:
    """Time headway from front to front, s, at most `LONGEST`; bodies that overlap count as touching."""
    return jnp.minimum((jnp.maximum(gap, 0) + length_lead) / jnp.maximum(v, SLOWEST), LONGEST)


@partial(jax.jit, static_argnames="points")
def distances(recorded: Samples, gap: Float[Array, "K M"], v: Float[Array, "K M"], points: int) -> Distances:
    """Of `K` simulations from the record, given gaps and speeds at its samples."""
    flat = headway(gap, v, recorded.length_lead[None]).reshape(-1), v.reshape(-1), gap.reshape(-1)
    log = headway(recorded.gap, recorded.v, recorded.length_lead), recorded.v, recorded.gap
    flow, known = (
        _flow_at(recorded.density, *_edie(recorded, *one, points))
        for one in ((gap, v), (recorded.gap[None], recorded.v[None]))
    )
    return Distances(
        *(wasserstein(x, y) for x, y in zip(flat, log, strict=True)),
        mean_speed=jnp.abs(jnp.mean(v) - jnp.mean(recorded.v)),
        flow=3600 * jnp.mean(jnp.abs(flow - known)),
    )


@partial(jax.jit, static_argnames=("model", "dt"))
def simulate_samples(
    model: CarFollowing, parameters: Float[Array, "K D P"], chains: Chains, recorded: Samples, dt: float
) -> tuple[Float[Array, "K M"], Float[Array, "K M"]]:
    """Gaps, m, and speeds, m/s, of `K` simulations of all periods, where the record is compared.

    Args:
      model: of car following.
      parameters: of every driver in every simulation.
      chains: all periods, `[W T V]`.
      recorded: from `samples`.
      dt: s.
    """
    rows = parameters[:, recorded.who]  # [K W V P]
    each = jax.vmap(lambda p, chains: simulate(model, p, chains, dt))
    gap, v = jax.vmap(each, in_axes=(0, None))(rows, chains)
    gap, v = (x.reshape(x.shape[0], -1)[:, recorded.at] for x in (gap, v))
    return gap, v


@partial(jax.jit, static_argnames="points")
def from_own(recorded: Samples, gap: Float[Array, "K M"], v: Float[Array, "K M"], points: int) -> Distances:
    """Distances of one of `K` >= 2 simulations, as if it were the record, from the others; the mean.

    Other drivers are drawn each time, so this is left when a population is exactly right, of a record of
    this size and with these leaders. Arguments as of `distances`.
    """

    def one(k: Array) -> Distances:
        others = jnp.arange(gap.shape[0] - 1)
        others = jnp.where(others >= k, others + 1, others)
        return distances(recorded._replace(gap=gap[k], v=v[k]), gap[others], v[others], points)

    found = jax.lax.map(one, jnp.arange(gap.shape[0]))
    return jax.tree.map(lambda x: jnp.mean(x), found)


def floor(linked: Linked, splits: int = 8, seed: int = 0) -> Distances:
    """Distances between two halves of the recorded drivers, the mean over random splits."""
    rng = np.random.default_rng(seed)
    recorded = samples(linked)
    points = int(recorded.point.max()) + 1
    who = np.broadcast_to(linked.who[:, None], linked.counts.shape).reshape(-1)[np.asarray(recorded.at)]
    gap, v, length = (np.asarray(x, float) for x in (recorded.gap, recorded.v, recorded.length_lead))
    times = np.minimum((np.maximum(gap, 0) + length) / np.maximum(v, SLOWEST), LONGEST)
    found = []
    for _ in range(splits):
        half = rng.permutation(len(linked.drivers))[who] % 2 == 0
        if half.all() or not half.any():
            continue
        flow, other = (_recorded_flow(recorded, jnp.asarray(side), points) for side in (half, ~half))
        apart = [wasserstein_distance(x[half], x[~half]) for x in (times, v, gap)]
        apart += [abs(v[half].mean() - v[~half].mean()), 3600 * float(jnp.mean(jnp.abs(flow - other)))]
        found.append(apart)
    return Distances(*np.mean(found, axis=0).tolist()) if found else Distances(*[math.nan] * 5)


# --- fitting -----------------------------------------------------------------------------------------


def scores(draws: int, drivers: int, seed: int) -> Float[Array, "K D P"]:
    """Standard normal scores of all drivers, cut at `CUT` as those of the simulator."""
    rng = np.random.default_rng(seed)
    drawn = truncnorm.rvs(-CUT, CUT, size=(draws, drivers, len(PARAMETERS)), random_state=rng)
    return jnp.asarray(drawn, jnp.float32)


def drawn(
    mean: Float[Array, " P"], root: Float[Array, "P P"], z: Float[Array, "K D P"]
) -> Float[Array, "K D P"]:
    """Drivers with these scores: log-normal parameters within the box of `fit`."""
    low, high, mean = (jnp.broadcast_to(jnp.asarray(x, z.dtype), z.shape) for x in (LOWER, UPPER, mean))
    return jnp.clip(jnp.exp(mean + z @ root.T), low, high)


def default_drivers(draws: int, drivers: int, seed: int, speed_limit: float) -> Float[Array, "K D P"]:
    """Drivers of cars as the simulator has them by default, in the order of `PARAMETERS`."""
    them = sample_vehicles(
        default_population({"car": 1.0}), jax.random.key(seed), jnp.arange(draws * drivers)
    )[0]
    v0 = jnp.minimum(them.speed_factor * speed_limit, them.v_max)
    return jnp.stack([v0, them.T, them.s0, them.a, them.b], -1).reshape(draws, drivers, -1)


class _Point(NamedTuple):
    """Where in the space of populations, seen from the start."""

    shift: Array  # [P], of the medians, in logarithms
    wider: Array  # [P], logarithm of the factor on the spreads


@partial(jax.jit, static_argnames=("model", "dt", "points", "iterations"))
def _descend(
    model: CarFollowing,
    mean: Array,
    root: Array,
    z: Array,
    chains: Chains,
    recorded: Samples,
    scale: Array,
    dt: float,
    points: int,
    iterations: int,
) -> tuple[_Point, Array]:
    """Adam from the start; the best point and the losses."""

    def loss(point: _Point) -> Array:
        parameters = drawn(*_moved(mean, root, point), z)
        gap, v = simulate_samples(model, parameters, chains, recorded, dt)
        found = distances(recorded, gap, v, points)
        tame = jnp.sum(point.shift**2 / jnp.sum(root * root, axis=-1)) + jnp.sum(point.wider**2)
        return jnp.sum(jnp.stack(found) * scale) + _TAME * tame

    def rate(count: Any) -> Any:
        return 0.03 * (1 + jnp.cos(jnp.pi / iterations * count.astype(mean.dtype)))

    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate))

    def step(carry: tuple[Any, ...], _: None) -> tuple[tuple[Any, ...], Array]:
        point, state, best, least = carry
        value, g = jax.value_and_grad(loss)(point)
        g = jax.tree.map(jnp.nan_to_num, g)
        better = value < least
        best = jax.tree.map(lambda x, y: jnp.where(better, x, y), point, best)
        updates, state = optimizer.update(g, state)
        return (optax.apply_updates(point, updates), state, best, jnp.minimum(value, least)), value

    zero = jnp.zeros_like(mean)
    point = _Point(zero, zero)
    with jax.numpy_dtype_promotion("standard"):  # optax counts in integers
        first = (point, optimizer.init(point), point, jnp.asarray(jnp.inf, mean.dtype))
        carry, losses = jax.lax.scan(step, first, None, length=iterations)
    return carry[2], losses


def _moved(mean: Array, root: Array, point: _Point) -> tuple[Array, Array]:
    return mean + point.shift, jnp.exp(point.wider)[:, None] * root


@dataclass(frozen=True, kw_only=True)
class ClosedLoop:
    """Result of `calibrate_closed_loop`; distances by population: `default`, `start` and `closed_loop`."""

    law: Law  # the adjusted population, of all periods
    start: Law  # of fits to single drivers
    model: str
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
        """What is left of each distance from the default population, on held-out periods: 0.5 is a half."""
        return self._of_default(self.held_out["closed_loop"])

    def reachable(self) -> dict[str, float]:
        """What would be left if the population were exactly right: as far as the record has it, the least."""
        return self._of_default(self.from_own)

    def _of_default(self, found: Distances) -> dict[str, float]:
        before = self.held_out["default"]
        return {name: float(getattr(found, name) / getattr(before, name)) for name in Distances._fields}

    def as_json(self) -> dict[str, Any]:
        """Plain values."""

        def plain(found: Distances) -> dict[str, float]:
            return {name: float(x) for name, x in found._asdict().items()}

        return {
            "model": self.model,
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
            f"closed loop, {self.model.upper()}: {sum(map(len, self.folds))} periods, held out in "
            f"{len(self.folds)} turns ({self.samples} samples)",
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
    """What of the segments is not in these periods: parts of at least `LEAST` s, or as long as they were."""
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
        parts = [segment.part(i, j) for i, j in zip(edges[::2], edges[1::2], strict=True)]
        left += [part for part in parts if part.duration >= least]
    return left


def linked_recordings(
    sources: Sequence[Source], *, period: float = PERIOD, settle: float = SETTLE, dt: float = 0.1
) -> Linked:
    """Chains of all recordings but those that cannot be used.

    Raises:
      RecordingError: none can.
    """
    found: list[Segment] = []
    refused: list[RecordingError] = []
    for source in sources:
        try:
            found += segments(as_recording(source), dt=dt, shortest=_SHORT, margins=False)[0]
        except RecordingError as error:
            refused.append(error)
    if refused and not found:
        raise refused[0]
    return link(found, period=period, settle=settle)


def single_fits(
    found: Sequence[Segment], model: str = "idm", *, starts: int | None = 4, **options: Any
) -> Law:
    """The population of fits to single drivers; arguments as of `fit.fit`."""
    return estimate(fit(found, model, starts=starts, **options), found, rounds=1)


def calibrate_closed_loop(
    linked: Linked,
    found: Sequence[Segment],
    *,
    population: Callable[[Sequence[Segment]], Law] = single_fits,
    model: str = "acc",
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
      model: that drives: "idm", "iidm", or "acc" as the simulator by default.
      turns: see `hold_out`.
      speed_limit: m/s, for the default population, and for desired speeds that the data do not tell.
      draws: simulations with other drivers, in the fit; twice as many others, in the comparison.
      iterations: of Adam, from each of two populations.
      seed: of the drivers' scores.
      weights: of distances, instead of those in `WEIGHTS`.

    Raises:
      ValueError: an unknown model or distance, fewer than three drivers, or nothing to hold out.
    """
    begin = time.perf_counter()
    if model not in MODELS:
        raise ValueError(f"model '{model}' is unknown; known are {', '.join(MODELS)}")
    for name in weights or {}:
        if name not in Distances._fields:
            raise ValueError(f"distance '{name}' is unknown; known are {', '.join(Distances._fields)}")
    folds = [tuple(held) for held in hold_out(linked, turns)]
    drive, count, every = MODELS[model], len(linked.drivers), range(len(linked.periods))
    followers = {held: outside(found, linked, held) for held in ((), *folds)}
    for held, some in followers.items():
        if (left := len({segment.driver for segment in some})) < 3:
            without = f" without {', '.join(linked.periods[k] for k in held)}" if held else ""
            raise ValueError(f"{left} drivers to fit{without}; at least 3 are needed")
    z = scores(2 * draws, count, seed + 1)
    z_fit = scores(draws, count, seed)
    default = default_drivers(2 * draws, count, seed + 1, speed_limit)
    usual = _usual(speed_limit)

    def fitted(held: tuple[int, ...]) -> tuple[Law, Law, Floats]:
        """Populations of all other periods: of single fits, and in closed loop; the losses."""
        start = population(followers[held])
        part = linked.part([k for k in every if k not in held])
        recorded = samples(part)
        chains = jax.tree.map(jnp.asarray, part.chains)
        scale = _scale(recorded, WEIGHTS | dict(weights or {}))
        ends = []
        for mean, root in _starts(start, *usual):
            point, losses = _descend(
                drive, mean, root, z_fit, chains, recorded, scale, linked.dt,
                int(recorded.point.max()) + 1, iterations,
            )  # fmt: skip
            ends.append((float(jnp.min(losses)), _moved(mean, root, point), losses))
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
            drivers[name] = drawn(mean, root, z)
        return {
            name: jax.device_get(simulate_samples(drive, p, chains, recorded, linked.dt))
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


def _usual(speed_limit: float) -> tuple[Floats, Floats]:
    """Mean and covariance of the log-parameters of the simulator's drivers."""
    drivers = np.log(np.asarray(default_drivers(64, 64, 0, speed_limit), float)).reshape(-1, len(PARAMETERS))
    return drivers.mean(axis=0), np.cov(drivers.T) + 1e-6 * np.eye(len(PARAMETERS))


def _starts(law: Law, mean: Floats, covariance: Floats) -> list[tuple[Array, Array]]:
    """Means and roots of the covariances of log-parameters to start from: the law's, the simulator's.

    Of desired speeds that few of the drivers tell, as in congestion, the simulator's are taken in both.
    """
    own_mean, own = law.mean.copy(), law.covariance.copy()
    if law.identified[0] <= IDENTIFIED:
        own_mean[0], own[0], own[:, 0] = mean[0], 0.0, 0.0
        own[0, 0] = covariance[0, 0]
    return [
        (jnp.asarray(m, jnp.float32), jnp.asarray(np.linalg.cholesky(c), jnp.float32))
        for m, c in ((own_mean, own), (mean, covariance))
    ]


def _on_host(found: Distances) -> Distances:
    return Distances(*(float(x) for x in found))


def _scale(recorded: Samples, weights: Mapping[str, float]) -> Array:
    """What the distances are multiplied with in the loss."""
    times = headway(recorded.gap, recorded.v, recorded.length_lead)
    q = _edie(recorded, recorded.gap[None], recorded.v[None], int(recorded.point.max()) + 1)[1]
    speed = jnp.std(recorded.v)
    spread = jnp.stack([jnp.std(times), speed, jnp.std(recorded.gap), speed, 3600 * jnp.mean(q)])
    return jnp.asarray([weights[name] for name in Distances._fields]) / jnp.maximum(spread, 1e-3)


__all__ = [
    "Chains",
    "ClosedLoop",
    "Distances",
    "Linked",
    "Samples",
    "calibrate_closed_loop",
    "default_drivers",
    "distances",
    "drawn",
    "floor",
    "from_own",
    "headway",
    "hold_out",
    "link",
    "linked_recordings",
    "outside",
    "samples",
    "scores",
    "simulate",
    "simulate_samples",
    "single_fits",
    "wasserstein",
]
