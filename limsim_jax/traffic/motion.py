"""One physics step: how vehicles move between two decisions.

Nothing is looked up on the map to follow a leader: the decision left a gap to every obstacle, and the
gap now is that gap plus what the obstacle has travelled since, less what the vehicle itself has.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.geometry import direction, polynomial
from limsim_jax.maps.lane_map import NO_LANE, LaneMap, pose, side_s, width
from limsim_jax.numerics import safe_divide
from limsim_jax.traffic.bodies import place_behind
from limsim_jax.traffic.car_following import NO_GAP, CarFollowing, ballistic
from limsim_jax.traffic.ego import overlay_boxes
from limsim_jax.traffic.neighbors import Obstacles
from limsim_jax.traffic.parameters import DRIVING, LANE_CHANGES
from limsim_jax.types import Config, State, Status
from limsim_jax.xla import column_min, computed_once

_NO_WHEELBASE = 0.1  # m: a body with axles closer than that has one
_STEEPEST = math.tan(LANE_CHANGES.steepest)
_GOAL = -2  # in place of the next lane, at the end of a goal
_HAND_OVERS = 3  # lanes that a vehicle may leave behind in one step


class Decision(NamedTuple):
    """What drivers have decided until the next decision."""

    obstacles: Obstacles
    v0: Float[Array, " N"]  # m/s, desired speed here
    v_ahead: Float[Array, " N"]  # m/s, lower speed needed further on
    ahead: Float[Array, " N"]  # m to there, at the decision
    courtesy: Obstacles  # the vehicle that is let in, and the one behind which a gap is looked for
    lanes: Int[Array, "N D"]  # the lanes that it drives on next, its own first
    beyond: Obstacles | None = None  # vehicles ahead of the leader; None: no driver looks so far


class Seen(NamedTuple):
    """Obstacles `K` of every vehicle as they are now; vehicles last: XLA vectorises along their axis."""

    moving: Bool[Array, "K N"]  # a vehicle, not a place to stop
    gap: Float[Array, "K N"]  # m; NO_GAP where there is none
    v_lead: Float[Array, "K N"]  # m/s
    a_lead: Float[Array, "K N"]  # m/s^2


@jax.named_scope("accelerations")
def accelerations(
    model: CarFollowing, state: State, decision: Decision, x: Float[Array, " N"]
) -> Float[Array, " N"]:
    """Acceleration (m/s^2) of every vehicle: the least that any obstacle asks.

    Args:
      model: car following.
      state: the world.
      decision: the last one.
      x: m travelled since then.
    """
    moving, gap, v_lead, a_lead = seen(state, decision.obstacles, x)
    v0 = desired(state, decision, x)
    each, v, v_free = jax.tree.map(lambda value: value[None], (state.driver, state.v, v0))
    a = column_min(model(each, gap=gap, v=v, v_lead=v_lead, a_lead=a_lead, v0=v_free))
    return attentive(model, state, decision, x, a, jnp.where(moving, NO_GAP, gap))


def seen(state: State, obstacles: Obstacles, x: Float[Array, " N"]) -> Seen:
    """Obstacles of a decision, now that vehicles have travelled `x` m."""
    index, gap0 = (x.T for x in obstacles)
    moving = index >= 0
    none = (gap0 >= NO_GAP) | (moving & ~state.active[index])  # a vehicle that leaves the map is no obstacle
    gap = jnp.where(none, NO_GAP, gap0 + jnp.where(moving, x[index], 0) - x[None])
    v_lead = jnp.where(none, state.v[None], jnp.where(moving, state.v[index], 0))
    a_lead = jnp.where(moving, state.a[index], 0)
    return Seen(moving, *computed_once((gap, v_lead, a_lead)))


def desired(state: State, decision: Decision, x: Float[Array, " N"]) -> Float[Array, " N"]:
    """Desired speed (m/s): lower speeds ahead are reached with a share of b."""
    return jnp.minimum(decision.v0, _in_time(state, decision, x))


def _in_time(state: State, decision: Decision, x: Float[Array, " N"]) -> Float[Array, " N"]:
    room = jnp.maximum(decision.ahead - x, 0)
    return jnp.sqrt(decision.v_ahead**2 + 2 * DRIVING.bend_braking * state.driver.b * room + 1e-6)


def attentive(
    model: CarFollowing,
    state: State,
    decision: Decision,
    x: Float[Array, " N"],
    a: Float[Array, " N"],
    line: Float[Array, "K N"],
) -> Float[Array, " N"]:
    """Acceleration (m/s^2) with all that vehicles mind apart from obstacles.

    These are bends and limits ahead, lines to stop at, and vehicles that are let in.

    Args:
      model: car following.
      state: the world.
      decision: the last one.
      x: m travelled since then.
      a: acceleration for the obstacles.
      line: m to places to stop; NO_GAP for none.
    """
    driver, reach = state.driver, _in_time(state, decision, x)
    room = jnp.maximum(decision.ahead - x, 0)
    # the models lag behind a desired speed that falls: a vehicle above it brakes as hard as that takes
    need = (state.v * state.v - decision.v_ahead**2) / (2 * jnp.maximum(room, 0.5))
    a = jnp.where(state.v > reach, jnp.minimum(a, -jnp.clip(need, 0, driver.b)), a)
    # the models roll on slowly within s0: a vehicle that comes to stand at a line stops before it
    near = line.min(0) - driver.s0 + DRIVING.line_room
    need = state.v * state.v / (2 * jnp.maximum(near, 0.02))
    rolls = (state.v < DRIVING.walking_speed) & (near < DRIVING.line_near) & (need > DRIVING.line_braking)
    a = jnp.where(rolls, jnp.minimum(a, -jnp.minimum(need, DRIVING.line_hardest)), a)
    index, gap0 = (x.T for x in decision.courtesy)
    minds = (index >= 0) & state.active[index]
    gap = jnp.where(minds, gap0 + jnp.where(index >= 0, x[index], 0) - x[None], NO_GAP)
    v_lead = jnp.where(minds, state.v[index], state.v[None])
    each, v, v_free = jax.tree.map(lambda value: value[None], (driver, state.v, desired(state, decision, x)))
    kind = column_min(model(each, gap=gap, v=v, v_lead=v_lead, a_lead=jnp.zeros_like(gap), v0=v_free))
    return jnp.minimum(a, jnp.maximum(kind, -LANE_CHANGES.courtesy_braking))


def smooth(config: Config, state: State, a: Float[Array, " N"]) -> Float[Array, " N"]:
    """Acceleration (m/s^2) that changes no faster than pedals do.

    A vehicle that has to brake hard does so at once, and one that has just entered drives as it wants.
    """
    most = DRIVING.jerk * config.dt
    limited = jnp.clip(a, state.a - most, state.a + most)
    at_once = (a < -DRIVING.emergency) | (config.time(state.step) - state.entered < config.dt / 2)
    return jnp.where(at_once, a, limited)


@jax.named_scope("advance")
def advance(
    config: Config,
    lane_map: LaneMap,
    state: State,
    a: Float[Array, " N"],
) -> tuple[State, Float[Array, " N"], Bool[Array, " N"]]:
    """Move all vehicles one step with acceleration `a` (m/s^2).

    Returns:
      The state, the distance that each travelled (m), and whether it has left at the end of its goal.
    """
    a = computed_once(jnp.where(state.active, a, 0))
    v, dx = computed_once(ballistic(state.v, a, config.dt))
    realised = (v - state.v) / config.dt
    hard = realised < -state.driver.b_max - 0.01
    moved, left = _hand_over(lane_map, state, computed_once(state.s + dx))
    state = replace(
        without(replace(moved, v=v, a=realised), left),
        distance=state.distance + dx,
        waiting=jnp.where(state.active & (v < DRIVING.walking_speed), state.waiting + config.dt, 0),
        rest=jnp.maximum(state.rest - config.dt, 0),
        status=state.status | jnp.where(hard & state.active, int(Status.HARD_BRAKE), 0),
    )
    return _move_sideways(config, lane_map, state), dx, left


def without(state: State, left: Bool[Array, " N"]) -> State:
    """The state without the vehicles that have `left`."""
    return replace(
        state,
        lane=jnp.where(left, NO_LANE, state.lane),
        previous=jnp.where(left, NO_LANE, state.previous),
        earlier=jnp.where(left[:, None], NO_LANE, state.earlier),
        s=jnp.where(left, 0, state.s),
        v=jnp.where(left, 0, state.v),
        a=jnp.where(left, 0, state.a),
        active=state.active & ~left,
    )


def _hand_over(lane_map: LaneMap, state: State, s: Float[Array, " N"]) -> tuple[State, Bool[Array, " N"]]:
    """Move vehicles to the next lane where their fronts (m) are beyond."""
    routes = lane_map.routes
    way = jnp.where(routes.is_goal, _GOAL, routes.next_lane)  # one look-up instead of two
    lane, previous, earlier = state.lane, state.previous, state.earlier
    left = jnp.zeros_like(state.active)
    for _ in range(_HAND_OVERS):
        length = lane_map.length[lane]
        over = state.active & (s > length) & ~left
        following = way[lane, state.goal]
        gone = over & (following == _GOAL)
        go_on = over & (following >= 0)
        left = left | gone
        shifted = jnp.concatenate([previous[:, None], earlier[:, :-1]], -1)
        earlier = jnp.where(go_on[:, None], shifted, earlier)
        previous = jnp.where(go_on, lane, previous)
        s = jnp.where(go_on, s - length, s)
        lane = jnp.where(go_on, following, lane)
        lane, previous, earlier, s, left = computed_once((lane, previous, earlier, s, left))
    return replace(state, lane=lane, previous=previous, earlier=earlier, s=s), left


def creep_speed(state: State) -> Float[Array, " N"]:
    """Speed (m/s) below which lane changes go on by distance.

    Above it they go on by time. A vehicle that stands does not slide aside.
    """
    way = jnp.maximum(LANE_CHANGES.least_way, LANE_CHANGES.long_way * state.shape.length)
    return way / jnp.maximum(state.driver.lane_change_time, 0.1)


def pace(state: State) -> Float[Array, " N"]:
    """Share of their full pace at which lane changes go on: 1 from `creep_speed` on.

    A vehicle that has no room to drive shunts to and fro after a while, which shifts it slowly aside.
    """
    shunts = state.waiting > DRIVING.patience
    least = jnp.where(shunts, state.driver.lane_change_time / LANE_CHANGES.shunt_time, 0)
    return jnp.clip(state.v / creep_speed(state), least, 1)


def smooth_step(u: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Quintic from 0 to 1; its first two derivatives vanish at both ends."""
    u = jnp.clip(u, 0, 1)
    return u * u * u * (10 + u * (-15 + 6 * u))


def _stalled(lane_map: LaneMap, state: State) -> State:
    """Give up lane changes that stand at their start: they block two lanes.

    Those that the route asks for go on while they leave a lane.
    """
    asked = jnp.sign(lane_map.routes.lanes_to_go[state.lane, state.goal]) == state.side
    stalls = (state.crossed | ~asked) & (state.side != 0) & state.active
    stalls &= (jnp.abs(state.d) < LANE_CHANGES.stall_offset) & (state.waiting > LANE_CHANGES.stall_time)
    stalls &= state.waiting < DRIVING.patience
    return replace(
        state,
        side=jnp.where(stalls, 0, state.side),
        crossed=state.crossed & ~stalls,
        progress=jnp.where(stalls, 0, state.progress),
        shift=jnp.where(stalls, 0, state.shift),
    )


def _turn_back(lane_map: LaneMap, state: State) -> State:
    """Return to the own lane if the other lane ends."""
    beside = jnp.where(state.side > 0, lane_map.left[state.lane], lane_map.right[state.lane])
    lost = state.active & (state.side != 0) & ~state.crossed & (beside == NO_LANE)
    return replace(
        state,
        side=jnp.where(lost, -state.side, state.side),
        crossed=state.crossed | lost,
        progress=jnp.where(lost, 0, state.progress),
        shift=jnp.where(lost, state.d, state.shift),
    )


@jax.named_scope("lane_change_motion")
def _move_sideways(config: Config, lane_map: LaneMap, state: State) -> State:
    """Continue lane changes: d follows a quintic; half-way the lane becomes the other one."""
    state = _turn_back(lane_map, _stalled(lane_map, state))
    changing = state.active & (state.side != 0)
    rate = pace(state)
    done = state.progress + rate * safe_divide(jnp.full_like(rate, config.dt), state.driver.lane_change_time)
    progress = jnp.where(changing, jnp.minimum(done, 1), 0)
    # a vehicle off the middle without a lane change, as after a planner has driven it, drifts back
    drift = jnp.sign(state.d) * jnp.maximum(jnp.abs(state.d) - LANE_CHANGES.drift * rate * config.dt, 0)
    offset = state.shift * (1 - smooth_step(progress))  # from the centre of the lane that it moves to
    beside = jnp.where(state.side > 0, lane_map.left[state.lane], lane_map.right[state.lane])
    s_beside = side_s(lane_map, state.lane, state.s, state.side)
    own_width = width(lane_map, state.lane, state.s)
    between = jnp.where(
        beside == NO_LANE, own_width, (own_width + width(lane_map, beside, s_beside)) / 2
    )  # m from centre to centre
    side = state.side.astype(offset.dtype)
    d = jnp.where(state.crossed, offset, offset + side * between)
    crosses = changing & ~state.crossed & (side * d > own_width / 2) & (beside != NO_LANE)
    finished = changing & (progress >= 1) & (state.crossed | crosses)
    crosses, finished, d, s_beside = computed_once((crosses, finished, d, s_beside))
    return replace(
        state,
        lane=jnp.where(crosses, beside, state.lane),
        previous=jnp.where(
            crosses,
            jnp.where(state.side > 0, lane_map.left[state.previous], lane_map.right[state.previous]),
            state.previous,
        ),
        earlier=jnp.where(crosses[:, None], NO_LANE, state.earlier),
        s=jnp.where(crosses, s_beside, state.s),
        d=jnp.where(
            changing,
            jnp.where(finished, 0, jnp.where(crosses, d - side * between, d)),
            jnp.where(state.active, drift, 0),
        ),
        side=jnp.where(finished, 0, state.side),
        crossed=(state.crossed | crosses) & changing & ~finished,
        progress=jnp.where(finished, 0, progress),
        shift=jnp.where(finished, 0, state.shift),
    )


def lateral_speed(state: State) -> Float[Array, " N"]:
    """Speed across the lane (m/s) of vehicles that change lanes."""
    u = jnp.clip(state.progress, 0, 1)
    slope = 30 * u * u * (1 - u) * (1 - u)
    rate = safe_divide(pace(state), state.driver.lane_change_time)
    return jnp.where(state.side != 0, -state.shift * slope * rate, 0)


def boxes(lane_map: LaneMap, state: State) -> Float[Array, "N 5"]:
    """Oriented boxes: x, y (m) of the centre, heading (rad), length, width (m).

    A body is rigid, and both axles are on the path of the vehicle, which may run over lanes behind. It is
    turned by the direction of a lane change. Free egos are where they are in the plane.
    """
    shape = state.shape
    trail = state.lane, state.previous, state.earlier
    half = shape.length / 2
    axles = [
        place_behind(lane_map, *trail, state.s - half + x)
        for x in (shape.wheelbase / 2, -shape.wheelbase / 2)
    ]
    lane, s = (jnp.stack(column, -1) for column in zip(*axles, strict=True))
    x, y, along = pose(lane_map, lane, s, state.d[:, None])
    dx, dy = x[:, 0] - x[:, 1], y[:, 0] - y[:, 1]
    # axles of a vehicle without a wheelbase are in one place
    apart = shape.wheelbase > _NO_WHEELBASE
    heading = jnp.where(apart, direction(dx, dy), along[:, 0])
    x, y = x.mean(-1), y.mean(-1)
    slope = jnp.clip(lateral_speed(state) / jnp.maximum(state.v, 0.5), -_STEEPEST, _STEEPEST)
    turned = slope * polynomial((1, -1 / 3, 1 / 5, -1 / 7), slope * slope)  # the arc tangent, to 1e-7
    x, y, heading = computed_once((x, y, heading + turned))
    return overlay_boxes(state, jnp.stack([x, y, heading, shape.length, shape.width], -1))
