"""Speeds that roads ask for: limits and bends of the lanes to come."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from limsim_jax.maps.lane_map import NO_LANE, LaneMap, bend_speed, curvature
from limsim_jax.traffic.car_following import NO_GAP
from limsim_jax.types import Driver

BEND_POINTS = 4
"""Places ahead on the own lane at which the bend is looked at."""


def lane_speed(lane_map: LaneMap, driver: Driver, lane: Int[Array, "*b"]) -> Float[Array, "*b"]:
    """Speed (m/s) on whole lanes, by their limits and tightest bends; NO_GAP for NO_LANE.

    Of every driver `[N]` on one lane, or on several `[N, K]`.
    """

    def of_driver(x: Float[Array, " N"]) -> Array:
        return x if lane.ndim == 1 else x[:, None]

    limit = of_driver(driver.speed_factor) * lane_map.speed_limit[lane]
    speed = jnp.minimum(limit, bend_speed(lane_map, lane, of_driver(driver.a_lat)))
    return jnp.where(lane == NO_LANE, NO_GAP, speed)


def bend_squares(
    lane_map: LaneMap, driver: Driver, lane: Int[Array, "N 1"], s: Float[Array, "N K"]
) -> Float[Array, "N K"]:
    """Squared speeds ((m/s)^2) in the bends at `s` (m) of the lanes."""
    bend = curvature(lane_map, lane, s)
    return driver.a_lat[:, None] / jnp.maximum(jnp.abs(bend), 1e-6)  # 1/m: straight
