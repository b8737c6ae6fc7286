"""Belief about drivers: those of a typical population, corrected by how each vehicle has been seen to drive.

Two parameters can be read off the motion of a vehicle. On a free road its speed over the limit is its
`speed_factor`. Behind a leader at equal speed its gap tells its time gap `T`, by the equilibrium of the IDM
(Treiber, Hennecke, Helbing, Phys. Rev. E 62, 2000, eq. 4). Both start from the population's mean and spread,
and each observation is a normal update of known variance.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.maps.lane_map import LaneMap, curvature
from limsim_jax.numerics import safe_sqrt
from limsim_jax.traffic.car_following import NO_GAP
from limsim_jax.traffic.vehicles import DEFAULTS
from limsim_jax.types import Config, Driver, State

INDEPENDENT = 5.0
"""s between two independent observations of one driver; looks in between count in proportion."""

SPEED_ERROR, GAP_ERROR = 0.05, 0.4
"""Standard deviation of one independent observation: of `speed_factor`, and of `T` (s)."""

FREE_TIME, FREE_ROOM = 4.0, 20.0
"""s at the own speed, and m in addition, without a leader and before the end of the lane: a free road."""

FOLLOWING_TIME, EQUAL_SPEED = 3.0, 0.5
"""s at the own speed within which a leader is followed; m/s, difference of speeds in equilibrium."""

STEADY, DRIVING_SPEED, STRAIGHT = 0.3, 3.0, 0.5
"""Bounds of an observation: m/s^2 along, at least m/s, m/s^2 across."""

_NAMES = tuple(x.name for x in fields(Driver))
_MEAN = {name: np.array(DEFAULTS[name].median, np.float32) for name in _NAMES}
_CLASSES = len(_MEAN["T"])
_SPREAD_SPEED, _SPREAD_T = (
    np.broadcast_to(np.asarray(DEFAULTS[name].spread, np.float32), _CLASSES) for name in ("speed_factor", "T")
)
_SPREAD_T = _SPREAD_T * _MEAN["T"]  # log-normal: a share of the median
_BOUNDS_T = DEFAULTS["T"].bounds


class Seen(NamedTuple):
    """Observations of the vehicles in `N` slots so far: weights, and weighted sums."""

    entered: Float[Array, " N"]  # s, tells vehicles in one slot apart
    speed_weight: Float[Array, " N"]
    speed_sum: Float[Array, " N"]
    gap_weight: Float[Array, " N"]  # 1/s^2
    gap_sum: Float[Array, " N"]  # 1/s


def nothing_seen(state: State) -> Seen:
    """No vehicle has been observed."""
    zero = jnp.zeros_like(state.s)
    return Seen(state.entered, zero, zero, zero, zero)


def typical(vehicle_class: Int[Array, " N"]) -> Driver:
    """The typical driver of each class of vehicle."""
    return Driver(**{name: jnp.asarray(mean)[vehicle_class] for name, mean in _MEAN.items()})


def believed(seen: Seen, vehicle_class: Int[Array, " N"]) -> Driver:
    """Drivers as far as they are known: means of the posterior distributions."""
    driver = typical(vehicle_class)

    def mean(prior: Array, spread: np.ndarray, weight: Array, total: Array) -> Array:
        certainty = 1 / jnp.square(jnp.asarray(spread)[vehicle_class])
        return (prior * certainty + total) / (certainty + weight)

    return replace(
        driver,
        speed_factor=mean(driver.speed_factor, _SPREAD_SPEED, seen.speed_weight, seen.speed_sum),
        T=mean(driver.T, _SPREAD_T, seen.gap_weight, seen.gap_sum),
    )


def watch(config: Config, lane_map: LaneMap, state: State, seen: Seen) -> Seen:
    """What is known after one more look at the vehicles."""
    same = state.entered == seen.entered
    seen = Seen(state.entered, *(jnp.where(same, x, 0) for x in seen[1:]))
    driver = believed(seen, state.shape.vehicle_class)
    v, limit = state.v, lane_map.speed_limit[state.lane]
    gap, lead_v = _leader(state)
    bend = jnp.abs(curvature(lane_map, state.lane, state.s)) * v * v
    steady = state.active & (jnp.abs(state.a) < STEADY) & (v > DRIVING_SPEED) & (bend < STRAIGHT)
    steady &= state.side == 0
    room = FREE_TIME * v + FREE_ROOM
    free = steady & (gap > room) & (lane_map.length[state.lane] - state.s > room)
    follows = steady & (gap < FOLLOWING_TIME * v) & (jnp.abs(v - lead_v) < EQUAL_SPEED)

    share = v / jnp.maximum(driver.speed_factor * limit, 0.1)
    stretch = safe_sqrt(jnp.maximum(1 - share**4, 0))
    time_gap = jnp.clip((gap * stretch - driver.s0) / jnp.maximum(v, DRIVING_SPEED), *_BOUNDS_T)
    weight = config.decision_time / INDEPENDENT

    def add(counts: Bool[Array, " N"], value: Array, error: float) -> tuple[Array, Array]:
        more = jnp.where(counts, weight / error**2, 0)
        return more, more * value

    speed = add(free, v / jnp.maximum(limit, 0.1), SPEED_ERROR)
    gaps = add(follows, time_gap, GAP_ERROR)
    return Seen(
        seen.entered,
        *(old + new for old, new in zip(seen[1:], (*speed, *gaps), strict=True)),
    )


def _leader(state: State) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
    """Gap to the next vehicle on the lane, and its speed.

    In m and m/s; the gap is NO_GAP without one."""
    rear = state.s - state.shape.length
    between = rear[None] - state.s[:, None]  # [follower, leader]
    ahead = (state.lane[None] == state.lane[:, None]) & (state.s[None] > state.s[:, None])
    between = jnp.where(ahead & state.active[None], between, NO_GAP)
    gap = jnp.min(between, -1)
    first = between <= gap[:, None]
    return gap, jnp.max(jnp.where(first, state.v[None], 0), -1)
