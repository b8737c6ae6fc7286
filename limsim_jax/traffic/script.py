"""What an experiment orders: actions of single vehicles, and zones with another limit or friction.

Conditions of actions are looked at in every physics step; lane changes start at the next decision.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.maps.lane_map import NO_LANE, LaneMap, pose
from limsim_jax.numerics import safe_norm
from limsim_jax.traffic.bodies import body_place
from limsim_jax.traffic.ego import Limits
from limsim_jax.traffic.motion import Decision
from limsim_jax.traffic.parameters import DRIVING
from limsim_jax.types import Actions, Config, Driver, Order, Progress, Schedule, State, Zones

_NO_LIMIT = 1e3  # m/s, in place of a desired speed
_GRAVITY = 9.81  # m/s^2
_SAME = 1e-4  # s, within which two times are the same


def no_progress(actions: Actions) -> Progress:
    """The progress of a script before its start."""
    nothing = jnp.zeros_like(actions.at)
    return Progress(begun=nothing + jnp.inf, made=nothing > 0)


# ---- actions


@jax.named_scope("script")
def begin(config: Config, lane_map: LaneMap, actions: Actions, state: State) -> State:
    """The state in which those actions have begun whose conditions hold now."""
    assert state.script is not None
    now, begun = config.time(state.step), state.script.begun
    first = actions.before < 0
    since = now - jnp.where(first, -jnp.inf, begun[actions.before])
    due = (first | (since >= actions.after - _SAME)) & (now >= actions.at - _SAME)
    due &= _there(actions, state) & (state.distance[actions.slot] >= actions.travelled)
    due &= _to_ego(lane_map, actions, state) <= actions.within
    return replace(state, script=replace(state.script, begun=jnp.where(due, jnp.minimum(begun, now), begun)))


def _there(actions: Actions, state: State) -> Bool[Array, " A"]:
    """Whether the vehicle of an action is on the road: its slot may have another one."""
    return state.active[actions.slot] & (state.vehicle[actions.slot] < 0)


def _to_ego(lane_map: LaneMap, actions: Actions, state: State) -> Float[Array, " A"]:
    """Distance (m) from middle to middle to the nearest ego."""
    egos = state.egos.slot
    if not egos.shape[0]:
        return jnp.full_like(actions.at, jnp.inf)

    def middle(slot: Array) -> tuple[Array, Array]:
        lane, s = body_place(lane_map, state, slot)
        x, y, _ = pose(lane_map, lane, s, state.d[slot])
        return x, y

    (x, y), (ego_x, ego_y) = middle(actions.slot), middle(egos)
    away = safe_norm(jnp.stack([x[:, None] - ego_x[None], y[:, None] - ego_y[None]], -1))
    return jnp.min(jnp.where(state.active[egos][None], away, jnp.inf), -1)


def _ruling(config: Config, actions: Actions, state: State) -> Bool[Array, " A"]:
    """Actions that say now how fast their vehicle drives: the last one of each vehicle that has begun."""
    assert state.script is not None
    now, begun = config.time(state.step), state.script.begun
    speed = (actions.order == int(Order.BRAKE)) | (actions.order == int(Order.SPEED))
    has = jnp.isfinite(begun) & speed & _there(actions, state)
    number = jnp.arange(has.shape[0])
    later = (actions.slot[:, None] == actions.slot[None]) & (number[None] > number[:, None])
    replaced = (later & (jnp.isfinite(begun) & speed)[None]).any(-1)
    return has & ~replaced & (now - begun < actions.duration - _SAME)


def _at_slots(actions: Actions, which: Bool[Array, " A"], number: int) -> tuple[Array, Array]:
    """Vehicle slots with one of these actions, and which of them."""
    mine = (actions.slot[:, None] == jnp.arange(number)[None]) & which[:, None]
    return mine.any(0), jnp.argmax(mine, 0)


class SpeedOrders(NamedTuple):
    """What vehicles are told about their speed now, `[N]`."""

    here: Bool[Array, " N"]  # whether anything
    order: Int[Array, " N"]
    value: Float[Array, " N"]
    rate: Float[Array, " N"]  # m/s^2
    careful: Bool[Array, " N"]


def speed_orders(config: Config, actions: Actions, state: State) -> SpeedOrders:
    """What vehicles are told about their speed now."""
    here, k = _at_slots(actions, _ruling(config, actions, state), state.lane.shape[0])
    return SpeedOrders(here, actions.order[k], actions.value[k], actions.rate[k], actions.careful[k])


def without_speed(orders: SpeedOrders, decision: Decision) -> Decision:
    """The decision without the desired speeds of vehicles that are told theirs."""
    speed = orders.here & (orders.order == int(Order.SPEED))
    return decision._replace(v0=jnp.where(speed, _NO_LIMIT, decision.v0))


def accelerate(
    config: Config, orders: SpeedOrders, state: State, a: Float[Array, " N"]
) -> Float[Array, " N"]:
    """Accelerations (m/s^2) of all vehicles, by order where there is one.

    Args:
      config: of the run.
      orders: what vehicles are told.
      state: the world.
      a: m/s^2, of traffic without orders.
    """
    here, order, value, rate, careful = orders
    driver = state.driver
    up, down = (jnp.where(rate > 0, rate, x) for x in (driver.a, driver.b))
    wanted = jnp.clip((value - state.v) / config.dt, -down, up)
    brakes = order == int(Order.BRAKE)
    wanted = jnp.where(brakes, -jnp.where(value > 0, value, driver.b), wanted)
    wanted = jnp.maximum(wanted, -driver.b_max)
    return jnp.where(here, jnp.where(careful, jnp.minimum(a, wanted), wanted), a)


def leaves(actions: Actions, state: State) -> Bool[Array, " N"]:
    """Vehicles that are told to leave the road."""
    assert state.script is not None
    told = (actions.order == int(Order.LEAVE)) & jnp.isfinite(state.script.begun) & _there(actions, state)
    return _at_slots(actions, told, state.lane.shape[0])[0]


def ordered_change(
    lane_map: LaneMap, actions: Actions, state: State
) -> tuple[State, Array, Bool[Array, " N"]]:
    """Lane changes that start by order: now, whatever marks and others say.

    A vehicle waits with it in junctions, during another lane change, and where there is no lane.

    Returns:
      The state with the durations that the orders say, sides `[N]` (+1 left, -1 right), and which vehicles
      change.
    """
    assert state.script is not None
    slot = actions.slot
    left = actions.value > 0
    beside = jnp.where(left, lane_map.left[state.lane[slot]], lane_map.right[state.lane[slot]])
    due = (actions.order == int(Order.CHANGE_LANE)) & jnp.isfinite(state.script.begun) & ~state.script.made
    due &= _there(actions, state) & (beside != NO_LANE) & (state.side[slot] == 0)
    due &= ~lane_map.is_connector[state.lane[slot]]
    number = jnp.arange(due.shape[0])
    earlier = (slot[:, None] == slot[None]) & (number[None] < number[:, None])
    due &= ~(earlier & due[None]).any(-1)  # one at a time
    here, k = _at_slots(actions, due, state.lane.shape[0])
    time = jnp.where(
        here & jnp.isfinite(actions.duration[k]), actions.duration[k], state.driver.lane_change_time
    )
    state = replace(
        state,
        script=replace(state.script, made=state.script.made | due),
        driver=replace(state.driver, lane_change_time=time),
    )
    return state, jnp.where(actions.value[k] > 0, 1, -1).astype(state.side.dtype), here


# ---- zones


def lanes_now(config: Config, lane_map: LaneMap, schedule: Schedule, step: Int[Array, ""]) -> LaneMap:
    """The map with the speed limits after some physics steps."""
    zones = None if schedule.script is None else schedule.script.zones
    if zones is None:
        return lane_map
    there = zones.lanes & _in_force(config, zones, step)[:, None] & jnp.isfinite(zones.limit)[:, None]
    limit = jnp.min(jnp.where(there, zones.limit[:, None], jnp.inf), 0)
    return replace(lane_map, speed_limit=jnp.where(there.any(0), limit, lane_map.speed_limit))


def _in_force(config: Config, zones: Zones, step: Int[Array, ""]) -> Bool[Array, " Z"]:
    now = config.time(step)
    return (zones.begin <= now + _SAME) & (now + _SAME < zones.end)


def grip(config: Config, zones: Zones, state: State) -> Float[Array, " N"]:
    """Acceleration (m/s^2) that the road allows each vehicle in any direction; inf on dry roads."""
    there = zones.lanes.T[state.lane] & _in_force(config, zones, state.step)[None]
    return _GRAVITY * jnp.min(jnp.where(there, zones.friction[None], jnp.inf), -1)


def with_grip(driver: Driver, most: Float[Array, " N"]) -> Driver:
    """Drivers on roads that allow at most `most` m/s^2."""
    kept = DRIVING.grip_share * most
    return replace(
        driver,
        a=jnp.minimum(driver.a, kept),
        b=jnp.minimum(driver.b, kept),
        b_max=jnp.minimum(driver.b_max, most),
        b_safe=jnp.minimum(driver.b_safe, most),
        a_lat=jnp.minimum(driver.a_lat, kept),
    )


def limits_with_grip(limits: Limits, most: Float[Array, " E"]) -> Limits:
    """What the actuators of free egos can do there."""
    names = ("acceleration", "deceleration", "lateral_acceleration")
    return replace(limits, **{name: jnp.minimum(getattr(limits, name), most) for name in names})
