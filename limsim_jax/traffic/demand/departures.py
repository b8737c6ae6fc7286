"""Entering while a world runs: the first vehicle of every queue, when there is room."""

from __future__ import annotations

from dataclasses import fields, replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.maps.lane_map import (
    NO_LANE,
    LaneMap,
)
from limsim_jax.traffic.bodies import tails
from limsim_jax.traffic.car_following import safe_speed
from limsim_jax.traffic.neighbors import follow_routes, look_ahead, other_lane
from limsim_jax.traffic.state import start_state
from limsim_jax.types import Config, Queues, Schedule, State
from limsim_jax.xla import computed_once

AT_ONCE = 16
"""Departures that a decision looks at, at most."""

_REAR_ROOM = 1.0  # m, least gap between a vehicle that enters and its follower
_FAR = 1e6  # m, distance of empty slots
_NOWHERE = -2  # lane of empty slots: not even the null lane


@jax.named_scope("enter")
def enter(config: Config, lane_map: LaneMap, schedule: Schedule, state: State) -> State:
    """Let due vehicles enter, if there is room and a free slot.

    Call it once per decision, before `decide`. The first vehicle of every queue enters if there is room for
    it. The leader, on the departure lane or along the route beyond it, must leave a gap of s0 + v T at the
    smaller of both speeds, and followers along their routes must not need to brake with more than b. The
    entry speed is at most `schedule.v` and `safe_speed`. Headways are not rounded to decisions: a vehicle
    that could have entered since the last decision starts further on accordingly. Without room a vehicle
    waits; with room but without a slot it is counted in `queues.full`, once per decision. Slots of egos stay
    free.

    Origins take turns when slots are short, when two vehicles would enter right behind one another, and when
    more than `AT_ONCE` origins have a vehicle that is due.
    """
    n, origins = state.lane.shape[0], state.queues.next.shape[0]
    if not origins:
        return state
    now = config.time(state.step)
    row = jnp.minimum(state.queues.next, schedule.time.shape[0] - 1)
    due = (state.queues.next < schedule.start[1:]) & (schedule.time[row] <= now)

    # the `P` vehicles that are due and next in turn
    number = jnp.arange(origins, dtype=jnp.int32)
    turn = (number + AT_ONCE * (state.step // config.decision_every)) % origins
    count = jnp.cumsum(due[turn], dtype=jnp.int32)
    place = jnp.arange(1, min(origins, AT_ONCE) + 1, dtype=jnp.int32)
    origin = turn[jnp.minimum(jnp.searchsorted(count, place), origins - 1)]
    row = row[origin]
    lane, s = schedule.lane[row], schedule.s[row]
    ahead, start = follow_routes(config, lane_map, lane, s, schedule.goal[row])
    late = jnp.minimum(now - schedule.time[row], config.decision_time)
    room, shift, v = _room_ahead(config, lane_map, schedule, state, row, ahead, start, late)
    ready = (place <= count[-1]) & room & _room_behind(config, lane_map, schedule, state, row, v)

    # of vehicles that would enter close to one another, the first in turn
    meet = (ahead[:, :, None] == lane[None, None]).any(1)
    meet = (meet | meet.T) & (place[None] < place[:, None])
    ready &= ~(meet & ready[None]).any(1)

    # the free slot of rank r takes the entering vehicle of rank r
    slot = jnp.arange(n, dtype=jnp.int32)
    free = ~state.active & ~(slot[:, None] == state.egos.slot[None]).any(1)
    if state.outside is not None:
        free &= ~(slot[:, None] == state.outside.slot[None]).any(1)
    slot_rank, rank = (jnp.cumsum(x, dtype=jnp.int32) for x in (free, ready))
    enters = ready & (rank <= slot_rank[-1])
    match = free[:, None] & enters[None] & (slot_rank[:, None] == rank[None])  # [N, P]
    taken, which = match.any(1), jnp.argmax(match, 1)
    mine = row[which]
    pick = lambda x: x[mine]  # noqa: E731
    fresh = start_state(
        lane_map,
        jax.tree.map(pick, schedule.driver),
        jax.tree.map(pick, schedule.shape),
        lane=lane[which],
        s=(s + shift)[which],
        v=v[which],
        goal=pick(schedule.goal),
        active=taken,
    )
    fresh = replace(fresh, vehicle=mine, entered=jnp.full(n, now))
    world = {"step", "queues", "lights", "egos", "script", "human"}

    def chosen(new: Array, old: Array) -> Array:
        return jnp.where(taken.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    changed = {
        x.name: jax.tree.map(chosen, getattr(fresh, x.name), getattr(state, x.name))
        for x in fields(State)
        if x.name not in world
    }
    gone = ((origin[:, None] == number[None]) & enters[:, None]).any(0)
    queues = Queues(
        next=state.queues.next + gone.astype(jnp.int32),
        full=state.queues.full + jnp.sum(ready & ~enters, dtype=jnp.int32),
    )
    return replace(state, queues=queues, **changed)


def delayed(schedule: Schedule, state: State, t: Float[Array, ""] | float) -> Int[Array, " O"]:
    """Vehicles per origin that are due at `t` (s) and still wait."""
    row = jnp.arange(schedule.time.shape[0], dtype=jnp.int32)
    waits = (
        (row[None] >= state.queues.next[:, None])
        & (row[None] < schedule.start[1:, None])
        & (schedule.time <= t)[None]
    )
    return jnp.sum(waits, 1, dtype=jnp.int32)


def _room_ahead(
    config: Config,
    lane_map: LaneMap,
    schedule: Schedule,
    state: State,
    row: Int[Array, " P"],
    ahead: Int[Array, "P D"],
    start: Float[Array, "P D"],
    late: Float[Array, " P"],
) -> tuple[Bool[Array, " P"], Float[Array, " P"], Float[Array, " P"]]:
    """Room to the leaders: whether, where and how fast a vehicle enters.

    It starts where it would be now had it entered up to `late` s ago, as far as leaders let it.

    Returns:
      Whether there is room, m beyond its place, and m/s.
    """
    gap = jnp.full((row.shape[0], state.lane.shape[0]), _FAR)  # m to the rear of every vehicle
    # every vehicle on its lane, on the other one if it changes lanes, and on those that its tail is on
    behind = zip(*(x.T for x in tails(lane_map, state)), strict=True)
    for lane, front in ((state.lane, state.s), other_lane(lane_map, state), *behind):
        here = jnp.where(state.active & (lane != NO_LANE), lane, _NOWHERE)[None]
        rear = (front - state.shape.length)[None]
        beyond = front[None] > schedule.s[row, None]
        for k in range(ahead.shape[1]):
            there = (ahead[:, k, None] == here) & (beyond | (k > 0))
            gap = jnp.minimum(gap, jnp.where(there, start[:, k, None] + rear, _FAR))
    gap = jnp.where(gap < config.look_ahead, gap, _FAR)
    driver = jax.tree.map(lambda x: x[row, None], schedule.driver)
    wanted, speed = schedule.v[row, None], state.v[None]
    spare = jnp.min(gap - driver.s0 - driver.T * jnp.minimum(wanted, speed), 1)
    wanted, brake = schedule.v[row], 2 * schedule.driver.b[row]
    lane = schedule.lane[row]
    end = lane_map.stop_s[lane] - schedule.s[row] - wanted * wanted / brake  # can still stop on the lane
    shift = jnp.maximum(jnp.minimum(jnp.minimum(spare, end), wanted * late), 0)
    v = jnp.min(safe_speed(driver, gap - shift[:, None], speed), 1)
    return spare >= 0, shift, jnp.minimum(v, wanted)


def _room_behind(
    config: Config,
    lane_map: LaneMap,
    schedule: Schedule,
    state: State,
    row: Int[Array, " P"],
    v: Float[Array, " P"],
) -> Bool[Array, " P"]:
    """Whether vehicles from behind can follow one that enters at `v` (m/s)."""
    driver = state.driver
    ahead = look_ahead(config, lane_map, state)
    other, other_s = other_lane(lane_map, state)
    ways = [(ahead.lane[:, k], ahead.start[:, k]) for k in range(ahead.lane.shape[1])]
    distance = jnp.full((row.shape[0], state.lane.shape[0]), _FAR)  # m from front bumper to front bumper
    for lane, start in [*ways, (other, -other_s)]:
        here = jnp.where(state.active & (lane != NO_LANE), lane, _NOWHERE)[None]
        way = start[None] + schedule.s[row, None]
        # a body that is only just beyond the place still covers it
        there = (here == schedule.lane[row, None]) & (way > -1)
        distance = jnp.minimum(distance, jnp.where(there, way, _FAR))
    gap = distance - schedule.shape.length[row, None]
    # own speed <= `safe_speed`, squared
    asks = state.v * (state.v + 2 * driver.b * driver.T) + 2 * driver.b * driver.s0
    follows = (gap >= _REAR_ROOM) & (asks[None] - 2 * driver.b[None] * gap <= (v * v)[:, None])
    return jnp.all(computed_once(follows), 1)
