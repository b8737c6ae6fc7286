"""Speeds that roads ask for: limits and bends of the lanes to come."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from limsim_jax.maps.lane_map import NO_LANE, LaneMap, bend_speed, curvature
from limsim_jax.traffic.car_following import NO_GAP
from limsim_jax.types import Driver

BEND_POINTS = 4
"""Places ahead on the own lane at which the bend is looked at."""


def lane_speed(
    lane_map: LaneMap,
    lane: Int[Array, "*b"],
    speed_factor: Float[Array, "*#b"],
    a_lat: Float[Array, "*#b"],
) -> Float[Array, "*b"]:
    """Speed (m/s) on whole lanes, by their limits and tightest bends; NO_GAP for NO_LANE.

    `speed_factor` and `a_lat` (m/s^2) are those of the drivers.
    """
    speed = jnp.minimum(speed_factor * lane_map.speed_limit[lane], bend_speed(lane_map, lane, a_lat))
    return jnp.where(lane == NO_LANE, NO_GAP, speed)


def bend_squares(
    lane_map: LaneMap, driver: Driver, lane: Int[Array, " N"], s: Float[Array, "N K"]
) -> Float[Array, "N K"]:
    """Squared speeds ((m/s)^2) in the bends at `s` (m) of the lanes."""
    bend = curvature(lane_map, lane[:, None], s)
    return driver.a_lat[:, None] / jnp.maximum(jnp.abs(bend), 1e-6)  # 1/m: straight
