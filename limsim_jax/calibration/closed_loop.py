"""The driver population under which simulated traffic is distributed as the recorded one.

Fits of single drivers follow *recorded* leaders. Here followers drive behind the *simulated* vehicles ahead
of them, as in the simulator, so that what one driver does wrong reaches all behind: only who has no leader in
the recording follows its log. Vehicles enter, change lanes and get other leaders when they did so in the
recording. Their drivers are drawn from the population, not fitted: the medians and spreads of its parameters
are adjusted until time headways, speeds, gaps and the fundamental diagram have the recorded distributions.

The scores of the drivers are the same whatever the population is (common random numbers), and the distance of
two distributions is the mean distance of their sorted samples (Wasserstein-1), so the loss has gradients by
the population, through the rollout. Periods are held out; `ClosedLoop` has the distances there, before and
after, and two yardsticks: how far apart two halves of the recorded vehicles themselves are, and how far a
record is from the population that made it, which is as near as one comes that is exactly right.

What has no gradient is for `matching`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
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
from limsim_jax.calibration.fit import LOWER, MODELS, PARAMETERS, UPPER, driver
from limsim_jax.calibration.population import Law, write_population
from limsim_jax.calibration.recordings import RecordingError, Source, as_recording
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
    parts = []
    for k, ((source, _), pieces) in enumerate(sorted(windows.items())):
        rows = {name: i for i, name in enumerate(dict.fromkeys(piece.driver for piece, _ in pieces))}
        who[k, : len(rows)] = [index[source, name] for name in rows]
        parts.append(_window(pieces, rows, (length, wide), dt))
    chains = Chains(*(np.stack(leaves) for leaves in zip(*parts, strict=True)))  # pyright: ignore[reportArgumentType]
    counts, point = _samples(chains, dt, min(settle, period / 4))
    if not counts.any():
        raise ValueError(
            f"nobody follows for longer than {min(settle, period / 4):g} s; a shorter 'settle' is needed"
        )
    sources = tuple(source for source, _ in sorted(windows))
    periods = tuple(f"{Path(source).name.split('.')[0]} {k * period:g} s" for source, k in sorted(windows))
    linked = Linked(chains, tuple(name for _, name in names), who, periods, sources, dt, counts, point)
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

    law: Law  # the adjusted population
    start: Law
    model: str
    sources: tuple[str, ...]  # files
    periods: tuple[tuple[str, ...], tuple[str, ...]]  # names of those fitted and of those held out
    fitted: dict[str, Distances]  # of the periods of the fit
    held_out: dict[str, Distances]
    floors: tuple[Distances, Distances]  # between halves of the recorded drivers, in both
    from_own: tuple[Distances, Distances]  # of records made by the adjusted population from it, in both
    overlaps: dict[str, float]  # share of the samples held out in which bodies overlap
    samples: tuple[int, int]
    losses: Floats  # of every iteration
    seconds: float

    def falls(self) -> dict[str, float]:
        """What is left of each distance from the default population, on held-out periods: 0.5 is a half."""
        before, after = self.held_out["default"], self.held_out["closed_loop"]
        return {name: float(getattr(after, name) / getattr(before, name)) for name in Distances._fields}

    def as_json(self) -> dict[str, Any]:
        """Plain values."""

        def plain(found: Distances) -> dict[str, float]:
            return {name: float(x) for name, x in found._asdict().items()}

        return {
            "model": self.model,
            "units": UNITS,
            "periods": {"fitted": list(self.periods[0]), "held_out": list(self.periods[1])},
            "samples": list(self.samples),
            "fitted": {name: plain(x) for name, x in self.fitted.items()},
            "held_out": {name: plain(x) for name, x in self.held_out.items()},
            "floor": {"fitted": plain(self.floors[0]), "held_out": plain(self.floors[1])},
            "from_own": {"fitted": plain(self.from_own[0]), "held_out": plain(self.from_own[1])},
            "left_of_default": self.falls(),
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
            f"closed loop, {self.model.upper()}: {len(self.periods[0])} periods fitted, "
            f"{len(self.periods[1])} held out ({self.samples[0]} and {self.samples[1]} samples)",
            f"{'':34}" + "".join(f"{f'{name}, {UNITS[name]}':>18}" for name in Distances._fields),
        ]
        for where, found, least, own in (
            ("fitted", self.fitted, self.floors[0], self.from_own[0]),
            ("held out", self.held_out, self.floors[1], self.from_own[1]),
        ):
            rows = [("default drivers", found["default"]), ("fits of single drivers", found["start"])]
            rows += [("closed loop", found["closed_loop"]), ("between halves of the record", least)]
            rows += [("of a record of its own", own)]
            for name, row in rows:
                lines.append(f"{f'{where}, {name}':38}" + "".join(f"{float(x):>16.3f}  " for x in row)[4:])
        left = ", ".join(f"{name} {share:.0%}" for name, share in self.falls().items())
        lines.append(f"left of the default drivers' distances, held out: {left}")
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


def hold_out(linked: Linked, share: float = 0.6) -> tuple[list[int], list[int]]:
    """Periods to fit and to hold out: of every recording the first `share` and the rest.

    Recordings of one period only are fitted and held out in turns.

    Raises:
      ValueError: nothing is left to hold out.
    """
    of: dict[str, list[int]] = {}
    for k, source in enumerate(linked.sources):
        of.setdefault(source, []).append(k)
    early, late, single = [], [], []
    for these in of.values():
        if len(these) == 1:
            single += these
            continue
        cut = min(max(round(share * len(these)), 1), len(these) - 1)
        early += these[:cut]
        late += these[cut:]
    early, late = sorted(early + single[::2]), sorted(late + single[1::2])
    if not late:
        raise ValueError(
            f"one period only ({linked.periods[0]}); a shorter 'period' or another recording is needed "
            "to hold one out"
        )
    return early, late


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


def calibrate_closed_loop(
    linked: Linked,
    start: Law,
    *,
    model: str = "acc",
    share: float = 0.6,
    speed_limit: float = SPEED_LIMIT,
    draws: int = 8,
    iterations: int = 120,
    seed: int = 0,
    weights: Mapping[str, float] | None = None,
) -> ClosedLoop:
    """Adjust a population until simulated traffic is distributed as recorded traffic.

    Args:
      linked: from `linked_recordings`.
      start: the population to start from, and to stay near: from `population.estimate`.
      model: that drives: "idm", "iidm", or "acc" as the simulator by default.
      share: see `hold_out`.
      speed_limit: m/s, for the default population that the result is compared with.
      draws: simulations with other drivers, in the fit; twice as many others, in the comparison.
      iterations: of Adam.
      seed: of the drivers' scores.
      weights: of distances, instead of those in `WEIGHTS`.

    Raises:
      ValueError: an unknown model or distance, or nothing to hold out.
    """
    begin = time.perf_counter()
    if model not in MODELS:
        raise ValueError(f"model '{model}' is unknown; known are {', '.join(MODELS)}")
    for name in weights or {}:
        if name not in Distances._fields:
            raise ValueError(f"distance '{name}' is unknown; known are {', '.join(Distances._fields)}")
    split = hold_out(linked, share)
    parts = [linked.part(periods) for periods in split]
    recorded = [samples(part) for part in parts]
    points = [int(one.point.max()) + 1 for one in recorded]
    fields = [jax.tree.map(jnp.asarray, part.chains) for part in parts]
    drive = MODELS[model]
    mean = jnp.asarray(start.mean, jnp.float32)
    root = jnp.asarray(np.linalg.cholesky(start.covariance), jnp.float32)
    count = len(linked.drivers)
    scale = _scale(recorded[0], WEIGHTS | dict(weights or {}))
    point, losses = _descend(
        drive, mean, root, scores(draws, count, seed), fields[0], recorded[0], scale, linked.dt, points[0],
        iterations,
    )  # fmt: skip
    after = _moved(mean, root, point)
    z = scores(2 * draws, count, seed + 1)
    drivers = {
        "default": default_drivers(2 * draws, count, seed + 1, speed_limit),
        "start": drawn(mean, root, z),
        "closed_loop": drawn(*after, z),
    }
    apart, own, overlaps = [], [], {}
    for chains, log, n in zip(fields, recorded, points, strict=True):
        made = {name: simulate_samples(drive, p, chains, log, linked.dt) for name, p in drivers.items()}
        apart.append({name: _on_host(distances(log, *both, n)) for name, both in made.items()})
        own.append(_on_host(from_own(log, *made["closed_loop"], n)))
        overlaps = {name: float(jnp.mean(gap <= 0)) for name, (gap, _) in made.items()}
    factor = np.asarray(after[1], float)
    law = replace(start, mean=np.asarray(after[0], float), covariance=factor @ factor.T, model=model)
    return ClosedLoop(
        law=law,
        start=start,
        model=model,
        sources=tuple(dict.fromkeys(linked.sources)),
        periods=(parts[0].periods, parts[1].periods),
        fitted=apart[0],
        held_out=apart[1],
        floors=(floor(parts[0]), floor(parts[1])),
        from_own=(own[0], own[1]),
        overlaps=overlaps,  # of the last: the periods held out
        samples=(len(recorded[0].at), len(recorded[1].at)),
        losses=np.asarray(losses, float),
        seconds=time.perf_counter() - begin,
    )


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
    "samples",
    "scores",
    "simulate",
    "simulate_samples",
    "wasserstein",
]
