"""From the engine to the metrics: what an ego and the traffic look like after a physics step.

Everything here is without memory. `observer` adds what depends on the steps before.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.maps.conflicts import ConflictType
from limsim_jax.maps.lane_map import NO_LANE, LaneMap, pose, width
from limsim_jax.maps.signal_table import SignalState
from limsim_jax.maps.signals import lane_states
from limsim_jax.metrics.safety import NO_GAP, Zones
from limsim_jax.metrics.step import EgoStep
from limsim_jax.metrics.traffic import TrafficStep
from limsim_jax.traffic.bodies import body_place, tails
from limsim_jax.traffic.collision import CLEARANCE, level, off_road
from limsim_jax.traffic.ego import arrived
from limsim_jax.traffic.engine import Tick
from limsim_jax.traffic.motion import boxes
from limsim_jax.traffic.signals import crosses_on_red
from limsim_jax.types import Config, State, Status
from limsim_jax.xla import computed_once

AT_RED = 15.0
"""m before a red light within which a standing ego waits for it."""

_STANDS = 0.5  # m/s


class Snapshot(NamedTuple):
    """A world after a physics step, or at its start; `N` slots."""

    state: State
    box: Float[Array, "N 5"]  # as `motion.boxes`
    left: Bool[Array, " N"]  # has left at the end of its goal in this step
    off_road: Bool[Array, " N"]  # as `collision.off_road`
    time: Float[Array, ""]  # s since the start
    dx: Float[Array, " N"]  # m travelled in this step


def at_start(config: Config, lane_map: LaneMap, state: State) -> Snapshot:
    """A world before the first step that counts: of the world, or of a fork."""
    no = state.active & False
    nothing = jnp.zeros(state.lane.shape[0], jnp.float32)
    return Snapshot(state, boxes(lane_map, state), no, no, config.time(state.step), nothing)


def after(lane_map: LaneMap, tick: Tick) -> Snapshot:
    """A world after a step. Looks for vehicles off the road where the engine has not."""
    off = tick.off_road
    if off is None:
        off = off_road(lane_map, tick.state, tick.box)
    return Snapshot(tick.state, tick.box, tick.left, off, tick.time, tick.dx)


def traffic_step(
    state: State, left: Bool[Array, " N"], time: Float[Array, ""], dx: Float[Array, " N"]
) -> TrafficStep:
    """The traffic after a step that ends at `time` (s).

    Vehicles drove `dx` (m) in it, and some `left` the map. Free speeds are those of the drivers, without any
    road. Lane changes are not known yet.
    """
    return TrafficStep(
        t=time,
        active=state.active,
        lane=state.lane,
        s=state.s,
        dx=dx,
        v=state.v,
        v_free=state.driver.v_max,
        inside=jnp.ones_like(left),
        changed=jnp.zeros_like(left),
        left=left,
        entered=state.entered,
    )


def ego_step(
    lane_map: LaneMap, snapshot: Snapshot, ego: int | Int[Array, ""], *, keep_state: bool = False
) -> EgoStep:
    """The world around one ego, a row of `State.egos`. Its leader and its route are filled in later.

    `keep_state`: whether the record holds the whole state, for metrics of one's own.
    """
    state = snapshot.state
    slot = state.egos.slot[ego]
    box = snapshot.box
    z = level(lane_map, state)
    seen = state.active & (jnp.abs(z - z[slot]) < CLEARANCE)  # a vehicle on a bridge is out of reach
    lane, v = state.lane[slot], state.v[slot]
    following = lane_map.routes.next_lane[lane, state.goal[slot]]
    signals = _signals(lane_map, snapshot, slot, following)

    # the road at the ego
    at, at_s = (x[0] for x in body_place(lane_map, state, slot[None]))
    heading = pose(lane_map, at, at_s)[2]
    half = width(lane_map, state.lane, state.s) / 2
    straddles = jnp.abs(state.d) + state.shape.width / 2 > half
    v_others, others = _speed_around(lane_map, state, seen, slot, following)
    direction = jnp.stack([jnp.cos(box[:, 2]), jnp.sin(box[:, 2])], -1)

    return EgoStep(
        t=snapshot.time,
        box=box,
        velocity=state.v[:, None] * direction,
        active=seen,
        b_max=state.driver.b_max,
        relevant=seen,
        meets=jnp.zeros_like(state.v),
        follows=jnp.zeros_like(seen),
        leads=jnp.zeros_like(seen),
        changing=(state.side != 0) | straddles | snapshot.off_road,
        violation=signals.violation,
        slot=slot,
        v=v,
        a=state.a[slot],
        rear_axle=state.shape.wheelbase[slot] / 2,
        lead=jnp.int32(-1),
        lead_gap=jnp.float32(NO_GAP),
        lane_heading=heading,
        on_lane=lane != NO_LANE,
        speed_limit=lane_map.speed_limit[lane],
        to_go=jnp.float32(0),
        on_route=lane != NO_LANE,
        arrived=arrived(lane_map, state)[ego],
        moved=snapshot.dx[slot],
        broken=(state.status[slot] & int(Status.NOT_FINITE)) != 0,
        off_road=snapshot.off_road[slot],
        in_junction=lane_map.junction[at] >= 0,
        red_light=signals.red_light,
        stop_sign=signals.stop_sign,
        waits_at_red=signals.waits,
        v_others=v_others,
        others=others,
        zones=conflict_zones(lane_map, state, slot, following),
        state=state if keep_state else None,
    )


def with_leader(step: EgoStep, tick: Tick) -> EgoStep:
    """The step with the leader on the lane, where it is now."""
    other, gap = (x[step.slot, 0] for x in tick.decision.obstacles)
    gap = gap + tick.x[other] - tick.x[step.slot]
    ahead = (other >= 0) & tick.state.active[other]
    return step._replace(
        lead=jnp.where(ahead, other, -1), lead_gap=jnp.where(ahead, jnp.maximum(gap, 0), NO_GAP)
    )


class _Signals(NamedTuple):
    """Lights and signs in a step."""

    red_light: Bool[Array, ""]  # the ego crossed a stop line on red
    stop_sign: Bool[Array, ""]  # the ego passed a stop sign
    waits: Bool[Array, ""]  # the ego stands before a red light
    violation: Bool[Array, " N"]  # vehicles that drive where others have priority


def _signals(
    lane_map: LaneMap, snapshot: Snapshot, slot: Int[Array, ""], following: Int[Array, ""]
) -> _Signals:
    state, dx, table = snapshot.state, snapshot.dx, lane_map.conflicts
    lane, s, v = state.lane[slot], state.s[slot], state.v[slot]
    red = lane_states(lane_map.signals, state.lights.phase) == SignalState.RED
    # the lane that was entered in this step
    entered = state.active & (state.previous != NO_LANE) & (state.s <= dx) & (dx > 0)
    signed = table.must_stop[table.connector[lane]]
    # a vehicle in the junction after crossing on red has no right of way
    ran = ((state.status & int(Status.RED_LIGHT)) != 0) & (lane_map.junction[state.lane] >= 0)
    wrong = (state.status & int(Status.WRONG_WAY)) != 0
    waits = red[following] & (v < _STANDS) & (lane_map.stop_s[lane] - s < AT_RED)
    return _Signals(
        red_light=crosses_on_red(lane_map, state, dx, slot),
        stop_sign=entered[slot] & signed,
        waits=waits,
        violation=ran | wrong,
    )


def _speed_around(
    lane_map: LaneMap, state: State, seen: Bool[Array, " N"], slot: Int[Array, ""], following: Int[Array, ""]
) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """Mean speed of the vehicles around (m/s), and whether there are any.

    Those on its road and on its next lane count.
    """
    lane = state.lane[slot]
    sides = [lane, lane_map.left[lane], lane_map.right[lane]]
    sides += [lane_map.left[sides[1]], lane_map.right[sides[2]], following]
    near = (state.lane[:, None] == jnp.stack(sides)[None]) & (state.lane != NO_LANE)[:, None]
    near = near.any(-1) & seen & (jnp.arange(state.lane.shape[0]) != slot)
    count = jnp.sum(near, dtype=state.v.dtype)
    return jnp.sum(jnp.where(near, state.v, 0)) / jnp.maximum(count, 1), count > 0


def conflict_zones(lane_map: LaneMap, state: State, slot: Int[Array, ""], following: Int[Array, ""]) -> Zones:
    """Conflict zones of the ego in `slot`, and whether they are occupied.

    Those on its lane, on the previous and on the `following` one.
    """
    table = lane_map.conflicts
    if table.foe.shape[1] == 0:  # a map where paths never meet
        nowhere = jnp.zeros(1, bool)
        return Zones(jnp.full(1, -1, jnp.int32), nowhere, nowhere)
    ego = jnp.stack([state.previous[slot], state.lane[slot], following])
    end = lane_map.length[ego]
    front = jnp.stack([state.s[slot] + end[0], state.s[slot], jnp.float32(-1)])  # m along each of the three
    row = table.connector[ego]  # the null row where there is none: stretches that are absent are empty
    foe = jnp.where(table.type[row] == ConflictType.SWEEP, -1, table.foe[row])  # paths that keep apart
    count = foe.shape[1]
    zone = jnp.where(foe >= 0, row[:, None] * count + jnp.arange(count)[None], -1)

    def inside(front: Array, length: Array, begin: Array, end: Array) -> Array:
        return (front > begin) & (front - length < end)

    mine = inside(front[:, None], state.shape.length[slot], table.s_in[row], table.s_out[row])
    others = state.active & (jnp.arange(state.lane.shape[0]) != slot)
    behind, along = tails(lane_map, state)
    lane, begin, end = (
        x[..., None] for x in (table.lane[foe], table.f_in[row], table.f_out[row])
    )  # [3, C, 1]
    theirs = jnp.zeros((), bool)
    for at, front in ((state.lane, state.s), *zip(behind.T, along.T, strict=True)):
        at, front, length = (x[None, None] for x in (at, front, state.shape.length))
        theirs |= (lane == at) & inside(front, length, begin, end)
    theirs = (theirs & others[None, None]).any(-1)
    there = zone >= 0
    return Zones(zone.ravel(), (mine & there).ravel(), (theirs & there).ravel())


def meets_ego(
    lane_map: LaneMap, slot: Int[Array, ""], way: Int[Array, "N D"], other: Int[Array, " N"]
) -> Bool[Array, " N"]:
    """Vehicles whose path may meet that of the ego in `slot`; all others keep apart from it.

    Their lanes to come (`way`, and `other`, the second lane of a lane change) are those of the ego, or cross
    or join them.
    """
    table = lane_map.conflicts
    lanes = jnp.concatenate([way, other[:, None]], -1)
    mine = lanes[slot]
    foes = table.lane[table.foe[table.connector[mine]]].ravel()  # NO_LANE where there is none
    ours = jnp.zeros(lane_map.valid.shape, bool).at[jnp.concatenate([mine, foes])].set(True)
    return computed_once(ours[lanes] & (lanes != NO_LANE)).any(-1)
