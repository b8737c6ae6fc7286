"""The rules of the road at junctions, put together."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.maps.lane_map import LaneMap, turn_speed
from limsim_jax.maps.signals import lane_states
from limsim_jax.traffic.car_following import NO_GAP
from limsim_jax.traffic.neighbors import Pair
from limsim_jax.traffic.parameters import JUNCTIONS
from limsim_jax.traffic.right_of_way.approaches import Approaches, throughout
from limsim_jax.traffic.right_of_way.meet import meet
from limsim_jax.traffic.right_of_way.passage import Observed
from limsim_jax.traffic.right_of_way.stops import (
    exit_full,
    keeps_clear,
    stop_signs,
    stops_at_conflicts,
    stops_at_lights,
)
from limsim_jax.types import Lights, State


class RightOfWay(NamedTuple):
    """What the right of way asks of every vehicle."""

    stop: Float[Array, " N"]  # m to where the front bumper has to stop, NO_GAP if nowhere
    lead: Int[Array, " N"]  # slot of a vehicle to follow through a merge or a split, -1 for none
    lead_gap: Float[Array, " N"]  # m to it
    yielding: Bool[Array, " N"]  # stands for the right of way, a sign or a full exit, not for a light
    stopped: Bool[Array, " N"]  # has stopped at the stop sign ahead


@jax.named_scope("right_of_way")
def give_way(
    lane_map: LaneMap, state: State, approaches: Approaches, own: Pair, lights: Lights
) -> RightOfWay:
    """Where every vehicle has to wait, and which vehicle it follows.

    Args:
      lane_map: where.
      state: the world.
      approaches: the connectors to come.
      own: leader and follower on the own route.
      lights: of the decision.
    """
    table, driver = lane_map.conflicts, state.driver
    shows = jnp.asarray(lane_states(lane_map.signals, lights.phase))  # at the entry of every lane
    n = state.lane.shape[0]
    brake = state.v * state.v / (2 * JUNCTIONS.firm_braking)

    speed = turn_speed(lane_map, approaches.lane, driver.a_lat[:, None])
    since = lights.elapsed[lane_map.signals.lane_program[approaches.lane]]
    at_light, light = stops_at_lights(state, approaches, speed, shows, since)
    full = exit_full(lane_map, state, approaches, own)
    stands = JUNCTIONS.standstill
    standing = (own.lead >= 0) & (state.v[own.lead] < stands) & (state.v < stands)
    queued = standing & (own.lead_gap < JUNCTIONS.queue_gap * driver.s0 + JUNCTIONS.queue_room)
    starts = state.a > JUNCTIONS.starting
    # it stands for long and does not yield, so it waits for something that others do not see
    queued |= (state.v < stands) & (state.waiting > JUNCTIONS.tie_time) & ~state.yielding & ~starts
    sign, stopped = stop_signs(lane_map, state, approaches)
    # a vehicle that has yet to stop at a sign does not come before it has
    held = throughout(approaches, (at_light < NO_GAP) | full | sign)

    def everywhere(x: Array) -> Array:
        return jnp.broadcast_to(x[:, None] if x.ndim == 1 else x, approaches.connector.shape).astype(
            jnp.float32
        )

    a = jnp.maximum(driver.a, 0.5)  # m/s^2: times stay finite
    observed = Observed(
        front=approaches.x,
        length=everywhere(state.shape.length),
        v=everywhere(state.v),
        top_speed=jnp.maximum(state.v[:, None], speed),
        turn_speed=speed,
        a=everywhere(a),
        brake=everywhere(brake),
        waiting=everywhere(state.waiting),
        line=approaches.line,
        blocked=everywhere(held | queued[:, None]),
        yielding=everywhere(state.yielding),
        slowing=everywhere(state.a < -JUNCTIONS.slowing),
        starts=everywhere(starts & (state.v > 0)),
        light=light.astype(jnp.float32),
        slot=everywhere(jnp.arange(n)),
        soonest=approaches.soonest,
    )
    if table.foe.shape[1]:
        until, lead, lead_gap = meet(lane_map, state, approaches, observed)
    else:  # a map where paths never meet
        until = jnp.full(approaches.connector.shape, NO_GAP, jnp.float32)
        lead, lead_gap = jnp.full(n, -1, jnp.int32), jnp.full(n, NO_GAP, jnp.float32)
    wait_s = table.wait_s[approaches.connector]
    stop, waits = stops_at_conflicts(wait_s, approaches, observed.brake, until, sign | full)
    stop = jnp.minimum(stop, at_light)
    if table.foe.shape[1]:
        stop, has_no_room = keeps_clear(lane_map, state, approaches, own, observed.brake, stop)
        waits |= has_no_room
    yielding = state.active & waits.any(-1) & (state.v < stands)  # a vehicle that moves may yet come
    stop = stop.min(-1)
    return RightOfWay(
        stop=jnp.where(state.active, stop, NO_GAP),
        lead=lead,
        lead_gap=lead_gap,
        yielding=yielding,
        stopped=stopped,
    )
