"""Vehicles that stand for good, and how others pass them."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.maps.lane_map import LaneMap, width
from limsim_jax.traffic.car_following import NO_GAP
from limsim_jax.traffic.motion import creep_speed
from limsim_jax.traffic.neighbors import Pair
from limsim_jax.traffic.parameters import DRIVING, LANE_CHANGES
from limsim_jax.types import State, Status
from limsim_jax.xla import computed_once


class Obstructed(NamedTuple):
    """Vehicles that stand for good, and those that can pass one."""

    stands: Bool[Array, " N"]  # for good
    behind: Bool[Array, " N"]  # such a vehicle, or the next in the queue
    stop: Float[Array, " N"]  # m to where it stops, to pull out from there; NO_GAP elsewhere


def for_good(lane_map: LaneMap, state: State, own: Pair) -> Bool[Array, " N"]:
    """Whether each vehicle stands for no reason that traffic has: others need not wait for it.

    Args:
      lane_map: where.
      state: the world.
      own: neighbours on the own lane.
    """
    lane = state.lane
    crashed = (state.status & int(Status.COLLIDED)) != 0
    alone = (own.lead < 0) | (own.lead_gap > DRIVING.stand_room)
    elsewhere = lane_map.stop_s[lane] - state.s > DRIVING.stand_room  # it does not wait at a line
    on_way = (lane_map.routes.lanes_to_go[lane, state.goal] == 0) & (state.side == 0)
    idle = alone & elsewhere & on_way & ~state.yielding & ~lane_map.is_connector[lane]
    idle &= state.waiting > DRIVING.stand_time
    return state.active & (state.v < DRIVING.stand_speed) & (crashed | idle)


def obstructed(lane_map: LaneMap, state: State, own: Pair) -> Obstructed:
    """Vehicles that come to one that stands for good.

    Args:
      lane_map: where.
      state: the world.
      own: neighbours on the own lane.
    """
    stands = computed_once(for_good(lane_map, state, own))
    lead, lane = own.lead, state.lane
    # on a single lane none can get past
    passes = (lead >= 0) & ~stands & (lane_map.may_change_left[lane] | lane_map.may_change_right[lane])
    first = passes & stands[lead] & ~lane_map.is_connector[lane]
    # the next in the queue does not follow a vehicle that pulls out to where it could not do so itself
    second = passes & first[lead] & ~first & (lane[lead] == lane)
    room = own.lead_gap + jnp.where(second, state.shape.length[lead] + own.lead_gap[lead], 0)
    # the way of a lane change at walking pace
    way = creep_speed(state) * state.driver.lane_change_time + state.driver.s0
    braking = state.v * state.v / (2 * DRIVING.stand_braking)
    stop = jnp.maximum(room - way, jnp.minimum(room, braking)) + state.driver.s0
    behind = (first | second) & (room < DRIVING.stand_sight)
    return Obstructed(stands, behind, jnp.where(behind & (state.side == 0), stop, NO_GAP))


@jax.named_scope("beside_leaders")
def pulling_out(
    lane_map: LaneMap,
    state: State,
    stands: Bool[Array, " N"],
    own: Pair,
    second: Pair,
    other: Int[Array, " N"],
    other_s: Float[Array, " N"],
) -> tuple[Pair, Pair]:
    """Leaders of vehicles that change lanes.

    On the lane that it leaves, a vehicle minds no leader that it is clear of to the side, and comes nearer to
    one that stands for good.

    Args:
      lane_map: where.
      state: the world.
      stands: for good.
      own: neighbours on the lane of the vehicle.
      second: on the other lane of a vehicle that changes lanes.
      other: that lane, of `neighbors.other_lane`.
      other_s: m along it.
    """
    between = (width(lane_map, state.lane, state.s) + width(lane_map, other, other_s)) / 2

    def left_behind(pair: Pair, lane: Array, d: Array, leaves: Array) -> Pair:
        lead = pair.lead
        keeps_lane = (state.side[lead] == 0) & (state.lane[lead] == lane)
        apart = jnp.abs(d - state.d[lead]) - (state.shape.width + state.shape.width[lead]) / 2
        clear = (lead >= 0) & leaves & keeps_lane & (apart > LANE_CHANGES.beside_room)
        nearer = (lead >= 0) & leaves & stands[lead]
        gap = pair.lead_gap + jnp.where(nearer, LANE_CHANGES.nearer * state.driver.s0, 0)
        return pair._replace(lead=jnp.where(clear, -1, lead), lead_gap=jnp.where(clear, NO_GAP, gap))

    changes = state.side != 0
    # a vehicle that has crossed came from the other side
    d_other = state.d + state.side.astype(between.dtype) * between
    return (
        left_behind(own, state.lane, state.d, changes & ~state.crossed),
        left_behind(second, other, d_other, changes & state.crossed),
    )
