"""The record of every physics step, for pictures, videos and tables."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.maps.lane_map import NO_LANE, LaneMap
from limsim_jax.traffic.engine import Tick
from limsim_jax.types import State


class Trace(NamedTuple):
    """The record of a step: `N` slots, `E` rows of `Egos`.

    What is None is not known: nothing of egos in a world without, no plans of a policy that gives no
    trajectories.
    """

    time: Float[Array, ""]  # s
    active: Bool[Array, " N"]
    vehicle: Int[Array, " N"]  # row of the schedule; -1: was there at the start
    lane: Int[Array, " N"]
    s: Float[Array, " N"]
    d: Float[Array, " N"]
    v: Float[Array, " N"]
    a: Float[Array, " N"]
    box: Float[Array, "N 5"]  # x, y (m), heading (rad), length, width (m)
    status: Int[Array, " N"]
    phase: Int[Array, " P"]  # of the signal programs
    vehicle_class: Int[Array, " N"] | None = None  # row of `maps.lane_map.VEHICLE_CLASSES`
    driven: Int[Array, " E"] | None = None  # slot that the policy drives, egos first; -1: none
    to_go: Float[Array, ""] | None = None  # m of the first ego to its goal (`routes.distance`); NaN: none
    plan: Float[Array, "E H 2"] | None = None  # m, x and y planned at the decision; NaN: no trajectory
    plan_time: Float[Array, " H"] | None = None  # s, when


def trace(lane_map: LaneMap) -> Callable[[Tick], Trace]:
    """A `record` that keeps everything that a picture or a table needs."""

    def record(tick: Tick) -> Trace:
        state = tick.state
        some = state.egos.slot.shape[0] > 0
        seen = moment(state, tick.time, tick.box)
        plan, plan_time = _plan(tick, seen.driven)
        to_go = _to_go(lane_map, tick) if some else None
        return seen._replace(to_go=to_go, plan=plan, plan_time=plan_time)

    return record


def moment(state: State, time: Float[Array, ""], box: Float[Array, "N 5"]) -> Trace:
    """A world at one moment, without plans.

    Args:
      state: the world.
      time: s.
      box: `motion.boxes` of the state.
    """
    slot = state.egos.slot
    return Trace(
        time=time,
        active=state.active,
        vehicle=state.vehicle,
        lane=state.lane,
        s=state.s,
        d=state.d,
        v=state.v,
        a=state.a,
        box=box,
        status=state.status,
        phase=state.lights.phase,
        vehicle_class=state.shape.vehicle_class,
        driven=jnp.where(state.active[slot], slot, -1) if slot.shape[0] else None,
    )


def _plan(tick: Tick, driven: Int[Array, " E"] | None) -> tuple[Array | None, Array | None]:
    """Planned trajectories, and the times of their samples (s)."""
    planned, egos = tick.command.trajectory, tick.state.egos
    if planned is None or driven is None:
        return None, None
    follows = (egos.free & (driven >= 0))[:, None, None]
    plan = jnp.where(follows, jnp.stack([planned.x, planned.y], -1), jnp.nan)
    return plan, planned.t0 + planned.dt * jnp.arange(plan.shape[1], dtype=plan.dtype)


def _to_go(lane_map: LaneMap, tick: Tick) -> Float[Array, ""]:
    """Metres from the first ego to the end of its goal.

    0 in the step in which it leaves there; NaN: gone, or no way there.
    """
    state = tick.state
    slot = state.egos.slot[0]
    lane = state.lane[slot]
    routes, goal = lane_map.routes, state.goal[slot]
    known = state.active[slot] & (lane != NO_LANE) & routes.reachable[lane, goal]
    to_go = jnp.where(known, jnp.maximum(routes.distance[lane, goal] - state.s[slot], 0), jnp.nan)
    return jnp.where(tick.left[slot], 0, to_go)
