"""Vehicles that something outside of the traffic moves: the entities of a scenario.

They have slots like all vehicles, so traffic, policies and metrics see them. Where they are is told in the
plane; lane, `s` and `d` of their slots follow, as with free egos.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from limsim_jax.maps.lane_map import NO_LANE, LaneMap
from limsim_jax.traffic.ego import at_slots, find_lane, outside_rows
from limsim_jax.types import Config, Egos, Outside, State

Player = Callable[[Config, Any, State], Outside]
"""Moves vehicles on by a physics step: given the run, what the schedule says of them, and the world now."""


def is_held(state: State) -> Bool[Array, " N"]:
    """Slots of vehicles that are moved from outside now."""
    if state.outside is None:
        return jnp.zeros_like(state.active)
    mine = outside_rows(state.outside)
    return at_slots(mine, mine.free, jnp.zeros_like(state.active))


@jax.named_scope("outside")
def put(config: Config, lane_map: LaneMap, before: State, moved: State, outside: Outside) -> State:
    """The world after a step in which vehicles were moved from outside.

    Args:
      config: of the run.
      lane_map: where.
      before: the world before the step.
      moved: after it, as the traffic has moved all vehicles.
      outside: after it.
    """
    egos = outside_rows(outside)
    slot = egos.slot
    mine = egos.free
    was = outside if before.outside is None else before.outside
    way = jnp.hypot(outside.x - was.x, outside.y - was.y)
    seen = replace(before, egos=egos)
    place = find_lane(lane_map, seen, outside.x, outside.y, outside.heading, way)

    def write(new: Array, old: Array) -> Array:
        return at_slots(egos, new, old, mine)

    nothing = jnp.zeros_like(outside.v)
    off = jnp.zeros_like(mine)
    here = at_slots(egos, mine, jnp.zeros_like(moved.active), mine)
    # a vehicle that the scenario still moves is there as long as the scenario says so
    gone = at_slots(egos, outside.held & ~outside.there, jnp.zeros_like(moved.active), slot >= 0)
    fields: dict[str, Any] = {
        "lane": place.lane,
        "previous": place.previous,
        "s": place.s,
        "d": place.d,
        "v": outside.v,
        "a": outside.a,
        "side": place.side,
        "crossed": off,
        "progress": nothing,
        "shift": nothing,
        "distance": before.distance[slot] + way,
        "yielding": off,
    }
    state = replace(moved, **{name: write(new, getattr(moved, name)) for name, new in fields.items()})
    state = replace(
        state,
        earlier=jnp.where(here[:, None], NO_LANE, state.earlier),
        active=(state.active | here) & ~gone,
        outside=outside,
    )
    return replace(state, egos=_with_poses(state.egos, outside, mine))


def _with_poses(egos: Egos, outside: Outside, mine: Bool[Array, " K"]) -> Egos:
    """Egos with those poses that come from outside: a policy goes on from there."""
    if not egos.slot.shape[0]:
        return egos
    same = (egos.slot[:, None] == outside.slot[None]) & mine[None] & (egos.slot >= 0)[:, None]
    here, k = same.any(1), jnp.argmax(same, 1)

    def write(new: Float[Array, " K"], old: Float[Array, " E"]) -> Float[Array, " E"]:
        return jnp.where(here, new[k], old)

    return replace(
        egos,
        x=write(outside.x, egos.x),
        y=write(outside.y, egos.y),
        heading=write(outside.heading, egos.heading),
        steering=jnp.where(here, 0, egos.steering),
        a=write(outside.a, egos.a),
    )
