"""Where the bodies of vehicles lie behind their front bumpers."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from limsim_jax.maps.lane_map import NO_LANE, LaneMap
from limsim_jax.types import State


def tails(
    lane_map: LaneMap, state: State, beyond: float = 0.0
) -> tuple[Int[Array, "N 2"], Float[Array, "N 2"]]:
    """Lanes behind its own on which a vehicle still has its tail.

    Lanes may be shorter than vehicles, so there are `LaneMap.lanes_behind` of them. They are those that the
    vehicle has driven on. Where that is not known, as at the start and after a lane change, a lane behind
    counts if it is the only one that leads there.

    Args:
      lane_map: where.
      state: the world.
      beyond: m past the end of a lane, up to which a tail counts as on it.

    Returns:
      The lanes, NO_LANE where there is no tail, and the front bumper along them (m).
    """
    lane = lanes_behind(lane_map, state.previous, state.earlier)
    length = lane_map.length[lane]
    front = state.s[:, None] + jnp.cumsum(length, -1)
    there = state.active[:, None] & (front - length < state.shape.length[:, None] + beyond)
    return jnp.where(there, lane, NO_LANE), front


def lanes_behind(
    lane_map: LaneMap, previous: Int[Array, " N"], earlier: Int[Array, "N P"]
) -> Int[Array, "N Q"]:
    """Lanes behind that of a vehicle, the nearest first; NO_LANE where not known."""
    one = (lane_map.predecessors != NO_LANE).sum(-1) == 1
    lanes = [previous]
    for k in range(lane_map.lanes_behind - 1):
        only = jnp.where(one[lanes[-1]], lane_map.predecessors[lanes[-1], 0], NO_LANE)
        known = jnp.where(earlier[:, k] != NO_LANE, earlier[:, k], only)
        lanes.append(jnp.where(lanes[-1] == NO_LANE, NO_LANE, known))
    return jnp.stack(lanes, -1)


def body_place(
    lane_map: LaneMap, state: State, slot: Int[Array, " E"] | None = None
) -> tuple[Int[Array, " E"], Float[Array, " E"]]:
    """Lane and arc length (m) of the centres of bodies.

    All of them, or those in some slots.
    """
    half = state.shape.length / 2
    if slot is None:
        return place_behind(lane_map, state.lane, state.previous, state.earlier, state.s - half)
    here = (x[slot] for x in (state.lane, state.previous, state.earlier, state.s - half))
    return place_behind(lane_map, *here)


def place_behind(
    lane_map: LaneMap,
    lane: Int[Array, " N"],
    previous: Int[Array, " N"],
    earlier: Int[Array, "N P"],
    s: Float[Array, " N"],
) -> tuple[Int[Array, " N"], Float[Array, " N"]]:
    """Lane and arc length (m) of places, also on lanes behind.

    Places with `s` (m) below 0 lie there.
    """
    lanes = lanes_behind(lane_map, previous, earlier)
    for k in range(lanes.shape[1]):
        behind = lanes[:, k]
        back = (s < 0) & (behind != NO_LANE)
        lane = jnp.where(back, behind, lane)
        s = jnp.where(back, s + lane_map.length[behind], s)
    return lane, s
