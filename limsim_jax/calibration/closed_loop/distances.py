"""Distances of simulated traffic from recorded traffic: distributions and the fundamental diagram."""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.stats import wasserstein_distance

from limsim_jax.calibration.closed_loop.chains import Chains, Linked, simulate
from limsim_jax.traffic.car_following import CarFollowing

LONGEST = 10.0
"""s, time headways are cut off here."""

SLOWEST = 1.0
"""m/s, least speed that a gap is divided by for a time headway."""

UNITS = {"headway": "s", "speed": "m/s", "gap": "m", "mean_speed": "m/s", "flow": "veh/h"}
"""Of the distances."""


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
    """Recorded numbers: `M` samples, `F` points of the fundamental diagram."""

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
    density, _ = edie(found, gap[None], v[None], int(point.max()) + 1)
    return found._replace(density=jnp.quantile(density.reshape(-1), jnp.linspace(0.1, 0.9, 9)))


def edie(
    recorded: Samples, gap: Array, v: Array, points: int, counts: Array | None = None
) -> tuple[Array, Array]:
    """Density, 1/m, and flow, 1/s, `[K F]`, by Edie's definitions.

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
    # One point is always nearest: of far points the nearest count.
    return jax.nn.softmax(-0.5 * off * off, axis=-1) @ q.reshape(-1)


@partial(jax.jit, static_argnames="points")
def _recorded_flow(recorded: Samples, counts: Array, points: int) -> Array:
    """Flow of some recorded samples at the compared densities."""
    k, q = edie(recorded, recorded.gap[None], recorded.v[None], points, counts)
    return _flow_at(recorded.density, k, q)


def headway(gap: Array, v: Array, length_lead: Array) -> Array:
    """Time headway from front to front, s, at most `LONGEST`; bodies that overlap count as touching."""
    return jnp.minimum((jnp.maximum(gap, 0) + length_lead) / jnp.maximum(v, SLOWEST), LONGEST)


@partial(jax.jit, static_argnames="points")
def distances(recorded: Samples, gap: Float[Array, "K M"], v: Float[Array, "K M"], points: int) -> Distances:
    """Distances of `K` simulations from the record, over its samples."""
    flat = headway(gap, v, recorded.length_lead[None]).reshape(-1), v.reshape(-1), gap.reshape(-1)
    log = headway(recorded.gap, recorded.v, recorded.length_lead), recorded.v, recorded.gap
    flow, known = (
        _flow_at(recorded.density, *edie(recorded, *one, points))
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
    """Gaps, m, and speeds, m/s, of `K` simulations at the compared samples.

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
    """Mean distance of one of `K` >= 2 simulations from the others.

    Each is taken for the record once. Other drivers are drawn each time, so an exactly right population is
    as far from a record of this size and with these leaders. Arguments as of `distances`.
    """

    def one(k: Array) -> Distances:
        others = jnp.arange(gap.shape[0] - 1)
        others = jnp.where(others >= k, others + 1, others)
        return distances(recorded._replace(gap=gap[k], v=v[k]), gap[others], v[others], points)

    found = jax.lax.map(one, jnp.arange(gap.shape[0]))
    return jax.tree.map(lambda x: jnp.mean(x), found)


def floor(linked: Linked, splits: int = 8, seed: int = 0) -> Distances:
    """Mean distances between two halves of the recorded drivers."""
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


__all__ = [
    "UNITS",
    "Distances",
    "Samples",
    "distances",
    "edie",
    "floor",
    "from_own",
    "headway",
    "samples",
    "simulate_samples",
    "wasserstein",
]
