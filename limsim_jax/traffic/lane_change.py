"""Lane changes: MOBIL for those that pay, urgency for those that the route needs.

Kesting, Treiber, Helbing, Transp. Res. Rec. 1999 (2007) 86: eq. numbers below. Route term and courtesy
are ours, after the lane-change bias of Treiber & Kesting, Traffic Flow Dynamics (2013), ch. 14. The numbers
are in `parameters.LaneChanging`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.maps.lane_map import NO_LANE, LaneMap, room_beside, side_s, width
from limsim_jax.traffic.car_following import NO_GAP, CarFollowing
from limsim_jax.traffic.motion import creep_speed
from limsim_jax.traffic.neighbors import Obstacles, Pair
from limsim_jax.traffic.parameters import DRIVING, LANE_CHANGES
from limsim_jax.types import State
from limsim_jax.xla import computed_once


class LaneChoice(NamedTuple):
    """What a vehicle decides about its lane, from the present state alone."""

    side: Int[Array, " N"]  # +1 left, -1 right, 0 stay
    courtesy: Obstacles  # the vehicle that each one lets in, and the leader on the lane that it has to reach
    stops_before: Float[Array, " N"]  # m before the end of a wrong lane, so that another vehicle can leave it


def urgency(
    lanes_to_go: Int[Array, " N"],
    room: Float[Array, " N"],
    v: Float[Array, " N"],
    lane_change_time: Float[Array, " N"],
) -> Float[Array, " N"]:
    """Urgency of the lane changes that the route needs, 0 to 1.

    Args:
      lanes_to_go: lanes to cross, positive to the left.
      room: m to the last place to change.
      v: m/s.
      lane_change_time: s.
    """
    count = jnp.abs(lanes_to_go).astype(v.dtype)
    way = count * (v * lane_change_time + LANE_CHANGES.change_room)
    spare = jnp.maximum(LANE_CHANGES.caution, count * v * v / (2 * LANE_CHANGES.ease_off))
    pressing = jnp.clip((way + spare - room) / jnp.maximum(way, 1.0), 0, 1)
    return jnp.where(lanes_to_go != 0, pressing, 0)


def incentive(
    *,
    own_now: Float[Array, " N"],
    own_then: Float[Array, " N"],
    new_now: Float[Array, " N"],
    new_then: Float[Array, " N"],
    old_now: Float[Array, " N"],
    old_then: Float[Array, " N"],
    politeness: Float[Array, " N"],
) -> Float[Array, " N"]:
    """Advantage of a lane change, m/s^2 (eq. 7): own, and with politeness that of both followers.

    `now` and `then`: accelerations before and after of the vehicle itself, the follower on the new
    lane and the one on the old lane. The change pays where it exceeds MOBIL's threshold.
    """
    return own_then - own_now + politeness * (new_then - new_now + old_then - old_now)


def closing(
    v: Float[Array, " N"], v_lead: Float[Array, " N"], a_lead: Float[Array, " N"], gap: Float[Array, " N"]
) -> Float[Array, " N"]:
    """Braking (m/s^2) down to the leader's speed within the gap.

    The leader is taken to go on braking as now. Speeds in m/s, `a_lead` in m/s^2, `gap` in m.
    """
    faster = jnp.maximum(v - v_lead, 0)
    slows = jnp.where(faster > 0, jnp.maximum(-a_lead, 0), 0)
    return faster * faster / (2 * jnp.maximum(gap, LANE_CHANGES.room)) + slows


def side_to_look(lane_map: LaneMap, state: State, turn: Int[Array, ""]) -> Int[Array, " N"]:
    """The side on which every vehicle looks for a gap: +1 left, -1 right.

    Sides take turns. A vehicle that must change lanes soon keeps looking where it has to go, so that the
    vehicle that lets it in goes on to do so.
    """
    press = _urgency(lane_map, state)
    to_go = lane_map.routes.lanes_to_go[state.lane, state.goal]
    return jnp.where(press > LANE_CHANGES.intent, jnp.sign(to_go), turn)


def _urgency(lane_map: LaneMap, state: State) -> Float[Array, " N"]:
    """Urgency of every vehicle; the taper at the end of a lane does not count as room."""
    to_go = lane_map.routes.lanes_to_go[state.lane, state.goal]
    taper = (lane_map.length - lane_map.end_s)[state.lane]
    room = lane_map.routes.change_distance[state.lane, state.goal] - taper - state.s
    return urgency(to_go, room, state.v, state.driver.lane_change_time)


def place_beside(
    lane_map: LaneMap, state: State, side: Int[Array, " N"]
) -> tuple[Int[Array, " N"], Float[Array, " N"], Bool[Array, " N"]]:
    """The place beside every vehicle, and whether it may change there.

    It may not where road marks forbid it, in junctions, by vehicle class, during another change, or too
    late to finish before the lanes part, or where the other lane is narrow.

    Args:
      lane_map: where.
      state: the world.
      side: +1 left, -1 right.

    Returns:
      The lane, NO_LANE where the vehicle may not change; s (m) on it; and whether the vehicle may change.
    """
    left = side > 0
    lane = jnp.where(left, lane_map.left[state.lane], lane_map.right[state.lane])
    allowed = jnp.where(left, lane_map.may_change_left[state.lane], lane_map.may_change_right[state.lane])
    usable = ((lane_map.access[lane] >> state.shape.vehicle_class) & 1) == 1
    allowed &= usable & state.active & (state.side == 0) & ~lane_map.is_connector[state.lane]
    # time to finish before the lanes part: mean speed while braking with two thirds of b
    time = state.driver.lane_change_time
    mean = jnp.maximum(state.v - state.driver.b * time / 3, LANE_CHANGES.slowed * state.v)
    # a vehicle that has stopped too near to the end turns harder after a while
    share = jnp.where(state.waiting > DRIVING.patience, LANE_CHANGES.way_least, LANE_CHANGES.way_over)
    needed = jnp.maximum(mean, share * creep_speed(state)) * time
    allowed &= room_beside(lane_map, state.lane, state.s, side) > needed
    # where it crosses the border, in the middle of the change, its rear is on a lane that is wide enough
    s = side_s(lane_map, state.lane, state.s, side)
    allowed &= s + needed / 2 - state.shape.length >= lane_map.start_s[lane]
    # and it does not end on a lane that has become too narrow
    allowed &= (s + needed <= lane_map.end_s[lane]) | (lane_map.end_s[lane] >= lane_map.length[lane])
    return jnp.where(allowed, lane, NO_LANE), s, allowed


@jax.named_scope("choose_lane")
def choose_lane(
    model: CarFollowing,
    lane_map: LaneMap,
    state: State,
    v0: Float[Array, " N"],
    own: Pair,
    pair: Pair,
    lane: Int[Array, " N"],
    s: Float[Array, " N"],
    allowed: Bool[Array, " N"],
    side: Int[Array, " N"],
    turn: Int[Array, ""],
    blocked: Bool[Array, " N"],
) -> LaneChoice:
    """The lane change that each vehicle wants and may start now.

    All vehicles choose from the same state. Two that enter the same gap come from the same lane and keep
    the distance that they have.

    Args:
      model: car following.
      lane_map: where.
      state: the world.
      v0: m/s, desired speeds.
      own: neighbours on the own lane.
      pair: neighbours on the lane beside.
      lane: beside every vehicle, from `place_beside`.
      s: m along that lane.
      allowed: whether the vehicle may change to it.
      side: of that lane, +1 left, -1 right.
      turn: the side to which changes may start at this decision.
      blocked: behind a vehicle that stands for good.
    """
    driver, shape = state.driver, state.shape
    me = jnp.arange(state.lane.shape[0], dtype=jnp.int32)
    routes = lane_map.routes
    to_go = routes.lanes_to_go[state.lane, state.goal]
    press = _urgency(lane_map, state)
    wanted = jnp.sign(to_go)
    reachable = routes.reachable[lane, state.goal]
    # a lane on the wanted side may be the wrong one: the change may be possible only further on
    farther = routes.distance[lane, state.goal] > routes.distance[state.lane, state.goal]
    back_to_go = routes.lanes_to_go[lane, state.goal]
    back = routes.change_distance[lane, state.goal] - s
    # past a vehicle that stands for good either side will do
    passes = blocked & (to_go == 0)
    way = urgency(jnp.ones_like(to_go), own.lead_gap, state.v, driver.lane_change_time)
    press = jnp.where(passes, way, press)
    wanted, farther = jnp.where(passes & allowed, side, wanted), farther & ~passes
    found = wanted, reachable, farther, back_to_go, back, press
    wanted, reachable, farther, back_to_go, back, press = computed_once(found)

    # six accelerations in one call: vehicle i follows vehicle j (-1: free road) at a gap
    between = pair.lag_gap + shape.length + pair.lead_gap  # from the new follower to the new leader
    around = own.lag_gap + shape.length + own.lead_gap
    cases = [
        (me, own.lead, own.lead_gap),
        (me, pair.lead, pair.lead_gap),
        (pair.lag, pair.lead, between),
        (pair.lag, me, pair.lag_gap),
        (own.lag, me, own.lag_gap),
        (own.lag, own.lead, around),
    ]
    i, j, gap = (jnp.stack(column) for column in zip(*cases, strict=True))
    free = j < 0
    follows, v = jax.tree.map(lambda x: x[i], driver), state.v[i]
    v_lead, a_lead = jnp.where(free, v, state.v[j]), jnp.where(free, 0, state.a[j])
    gap = jnp.where(free, NO_GAP, gap)
    follows, gap, v, v_lead, a_lead, v_free = computed_once((follows, gap, v, v_lead, a_lead, v0[i]))
    accelerations = computed_once(model(follows, gap=gap, v=v, v_lead=v_lead, a_lead=a_lead, v0=v_free))
    own_now, own_then, new_now, new_then, old_now, old_then = (accelerations[k] for k in range(6))
    follower, old = pair.lag >= 0, own.lag >= 0
    advantage = incentive(
        own_now=own_now,
        own_then=own_then,
        new_now=jnp.where(follower, new_now, 0),
        new_then=jnp.where(follower, new_then, 0),
        old_now=jnp.where(old, old_now, 0),
        old_then=jnp.where(old, old_then, 0),
        politeness=driver.politeness * (1 - press),
    )
    towards = (wanted == side) & ~farther
    with_route = jnp.where(towards, 1, jnp.where(wanted * side < 0, -1, 0)).astype(advantage.dtype)
    advantage += with_route * (LANE_CHANGES.route_base + LANE_CHANGES.route_urgent * press)
    advantage -= side.astype(advantage.dtype) * driver.keep_right
    advantage = computed_once(advantage)

    # safety (eq. 2): no vehicle has to brake harder than b_safe, and there is room
    room = LANE_CHANGES.room
    b_safe = driver.b_safe + LANE_CHANGES.safe_urgent * press
    # the models are mild where a cut-in leaves a short gap; what the speeds ask for must not be hard either
    b_lag, b_own = (LANE_CHANGES.hardest * jnp.where(i[k] < 0, 0, driver.b_max[i[k]]) for k in (3, 1))
    # the follower sees the change a moment later
    lag_gap = gap[3] - LANE_CHANGES.unseen * jnp.maximum(v[3] - v_lead[3], 0)
    need_lag = closing(v[3], v_lead[3], a_lead[3], lag_gap)
    need_own = closing(v[1], v_lead[1], a_lead[1], gap[1])
    safe = (~follower | ((new_then > -b_safe) & (need_lag < b_lag) & (lag_gap > room))) & (
        (pair.lead < 0) | ((own_then > -b_safe) & (need_own < b_own) & (pair.lead_gap > room))
    )
    # a change away from the route must leave time to come back
    away = (wanted * side < 0) | ((wanted == side) & farther) | ((wanted == 0) & (back_to_go != 0))
    count = jnp.abs(back_to_go).astype(back.dtype)
    speed = jnp.maximum(state.v, LANE_CHANGES.jam_speed)
    late = back < LANE_CHANGES.return_factor * speed * driver.lane_change_time * (count + 1)
    late |= back < LANE_CHANGES.detour_time * lane_map.speed_limit[state.lane]
    late &= away | (passes & (back_to_go != 0))
    late &= ~(passes & (state.waiting > DRIVING.patience))
    rested = (state.rest <= 0) | (press > 0)
    starts = allowed & reachable & safe & ~late & rested & (advantage > driver.threshold) & (side == turn)

    asks = towards & (press > LANE_CHANGES.courteous) & allowed & ~starts
    starts, asks = computed_once((starts, asks))

    # Courtesy: a vehicle that needs the other lane takes its pace, and falls behind a vehicle abreast. The
    # one that would be its new follower lets it in, also while it starts: from the next decision on it is
    # the leader there.
    n = me.shape[0]
    minds = (asks | (starts & towards)) & follower
    letting = jnp.full(n + 1, -1, jnp.int32).at[jnp.where(minds, pair.lag, n)].max(me)[:n]
    letting_gap = pair.lag_gap[letting]
    # above walking speed a vehicle beside it falls back, too
    beside = (letting_gap > -shape.length) & (state.v > LANE_CHANGES.yielding_speed)
    # a vehicle that has stopped too near lets nothing in, nor does one for good
    lets = (letting >= 0) & ((letting_gap > room) | beside) & (state.waiting < LANE_CHANGES.let_time)
    letting_gap = jnp.maximum(letting_gap, room)
    courtesy = Obstacles(
        jnp.stack([jnp.where(lets, letting, -1), jnp.where(asks, pair.lead, -1)], -1),
        jnp.stack([jnp.where(lets, letting_gap, NO_GAP), jnp.where(asks, pair.lead_gap, NO_GAP)], -1),
    )

    # Of two vehicles abreast that need each other's lanes, the one that will be behind stops behind the
    # other. Otherwise both would wait at the ends of their lanes for good.
    lead = (pair.lead >= 0) & (pair.lead_gap < room)
    abreast = jnp.where(lead, pair.lead, jnp.where(pair.lag_gap < room, pair.lag, -1))
    ahead = jnp.where(lead, pair.lead_gap + shape.length[pair.lead], -pair.lag_gap - shape.length)
    ahead += LANE_CHANGES.abreast_time * (state.v[abreast] - state.v)
    behind = (ahead > 0) | ((ahead == 0) & (me > abreast))
    swaps = towards & (press > LANE_CHANGES.intent) & (abreast >= 0) & behind
    swaps &= (wanted[abreast] == -wanted) & (press[abreast] > 0)
    return LaneChoice(
        side=jnp.where(starts, side, 0),
        courtesy=courtesy,
        stops_before=jnp.where(swaps, shape.length[abreast] + LANE_CHANGES.behind_room, 0),
    )


def start(lane_map: LaneMap, state: State, choice: LaneChoice) -> State:
    """Start the lane changes that were chosen."""
    begins = choice.side != 0
    # after a change that the route needs, as from an acceleration lane, the next may follow at once
    needed = jnp.sign(lane_map.routes.lanes_to_go[state.lane, state.goal]) == choice.side
    rest = jnp.where(needed, 0, LANE_CHANGES.rest) + state.driver.lane_change_time
    beside = jnp.where(choice.side > 0, lane_map.left[state.lane], lane_map.right[state.lane])
    s_beside = side_s(lane_map, state.lane, state.s, choice.side)
    between = (width(lane_map, state.lane, state.s) + width(lane_map, beside, s_beside)) / 2
    shift = state.d - choice.side.astype(between.dtype) * between
    return replace(
        state,
        side=jnp.where(begins, choice.side, state.side),
        crossed=state.crossed & ~begins,
        progress=jnp.where(begins, 0, state.progress),
        shift=jnp.where(begins, shift, state.shift),
        rest=jnp.where(begins, rest, state.rest),
    )
