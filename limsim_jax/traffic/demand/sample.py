"""A world from a seed, on the device: start state and schedule.

Draws are keyed by place and number: vehicle k of a queue is the same whatever the other flows are.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from limsim_jax.maps.lane_map import (
    NO_LANE,
    LaneMap,
    curvature,
)
from limsim_jax.numerics import safe_sqrt
from limsim_jax.traffic.car_following import desired_speed, safe_speed
from limsim_jax.traffic.demand.arrays import NEVER, Demand, EgoStart
from limsim_jax.traffic.demand.draws import Draws, draw, draw_arrivals
from limsim_jax.traffic.ego import from_lane
from limsim_jax.traffic.motion import boxes
from limsim_jax.traffic.neighbors import neighbors, sort_vehicles
from limsim_jax.traffic.script import no_progress
from limsim_jax.traffic.speeds import BEND_POINTS, bend_squares, lane_speed
from limsim_jax.traffic.state import start_state
from limsim_jax.traffic.vehicles import BODY, PARAMETERS, Population, vehicles_of
from limsim_jax.types import Config, Driver, Queues, Scenario, Schedule, Script, Shape, State, Status

_DEAD_END_ROOM = 12.0  # m before the end of a lane that leads nowhere, kept free to change lanes
_LOOK = 4  # lanes ahead of the departure lane that limit the speed
_LOOK_CONFIG = Config(dt=0.1)  # how far vehicles at the start look for their leaders; only that counts
_SWEEPS = 8  # times that the speeds at the start are adjusted to those of the leaders
_FAR = 1e6  # m, where there is none


def sample_scenario(
    demand: Demand,
    lane_map: LaneMap,
    key: Key[Array, ""] | Draws,
    slots: int,
    egos: EgoStart | None = None,
    *,
    vehicles: EgoStart | None = None,
    script: Script | None = None,
) -> Scenario:
    """Draw one world: the vehicles at the start, and those that enter later.

    Args:
      demand: from `build_demand`.
      lane_map: the one that the demand was built for.
      key: of the world, or its random numbers.
      slots: number of vehicle slots `N`.
      egos: the ones that the demand was built with; they are in slots 0 to `E - 1`.
      vehicles: of the script, in the slots behind the egos, with the speeds that they have; NaN: as fast as
        road and leader allow.
      script: what happens by order.

    Raises:
      ValueError: more vehicles at the start than slots.
    """
    placed = egos is not None and egos.lane is not None
    initial = demand.initial + (egos.count if egos is not None and placed else 0)
    initial += 0 if vehicles is None else vehicles.count
    if egos is not None and initial < egos.count:
        raise ValueError(f"{egos.count} egos cannot take the places of {initial} vehicles at the start")
    if initial > slots:
        raise ValueError(f"{initial} vehicles at the start do not fit into {slots} slots")
    draws = key if isinstance(key, Draws) else draw(demand, key)
    time, lane, stream = _sample_queues(demand, draws.arrivals)
    seat, shift = _sample_seats(demand, draws)
    # vehicles of the queues first, then those in the seats
    row = jnp.concatenate([jnp.arange(time.shape[0], dtype=jnp.int32), time.shape[0] + seat])
    goals = jnp.concatenate([demand.goals[stream], demand.seat_goals[seat]])
    types = jnp.concatenate([demand.types[stream], demand.seat_types[seat]])
    goal, vehicle_type = _roles(draws.roles[row], goals, types)
    driver, shape = vehicles_of(demand.population, draws.vehicles[row], vehicle_type)
    rows = time.shape[0]
    lane = jnp.concatenate([lane, demand.seat_lane[seat]])
    s = jnp.concatenate(
        [
            departure_place(lane_map, lane[:rows], shape.length[:rows]),
            demand.seat_s[seat] + shift * demand.seat_slack[seat],
        ]
    )
    v = entry_speed(lane_map, driver, lane, s, goal)
    later, now = (
        jax.tree.map(lambda x: x[part], (driver, shape, lane, s, v, goal))  # noqa: B023
        for part in (slice(rows), slice(rows, None))
    )
    driver, shape, lane, s, v, goal = later
    v = jnp.minimum(v, demand.speed[stream])
    schedule = Schedule(
        time=time, lane=lane, s=s, v=v, goal=goal, driver=driver, shape=shape, start=demand.start
    )
    first = 0 if egos is None else egos.count
    if egos is not None:
        now = _with_egos(lane_map, egos, now)
    if vehicles is not None:
        now = _with_vehicles(lane_map, vehicles, first, now)
    state = _start(demand, lane_map, slots, *now)
    if vehicles is not None:
        state = _by_script(state, vehicles, first)
    if script is not None:
        schedule = replace(schedule, script=script)
        state = replace(state, script=None if script.actions is None else no_progress(script.actions))
    if egos is not None:
        box = boxes(lane_map, state)
        state = replace(state, egos=from_lane(lane_map, state, box, range(egos.count), egos.free))
    return Scenario(start=state, schedule=schedule)


def _with_egos(lane_map: LaneMap, egos: EgoStart, others: tuple[Any, ...]) -> tuple[Any, ...]:
    """Put egos before the other vehicles at the start."""
    _, _, lane, s, _, goal = jax.tree.map(lambda x: x[: egos.count], others)
    rest = jax.tree.map(lambda x: x[egos.count :], others)
    if egos.lane is not None and egos.s is not None and egos.goal is not None:
        lane, s, goal, rest = egos.lane, egos.s, egos.goal, others
    v = entry_speed(lane_map, egos.driver, lane, s, goal)
    v = v if egos.v is None else jnp.minimum(egos.v, v)
    first = egos.driver, egos.shape, lane, s, v, goal
    return jax.tree.map(lambda x, y: jnp.concatenate([x, y]), first, rest)


def _with_vehicles(
    lane_map: LaneMap, vehicles: EgoStart, first: int, others: tuple[Any, ...]
) -> tuple[Any, ...]:
    """Put the vehicles of a script behind the `first` ones."""
    lane, s, goal = vehicles.lane, vehicles.s, vehicles.goal
    assert lane is not None and s is not None and goal is not None
    v = entry_speed(lane_map, vehicles.driver, lane, s, goal)
    mine = vehicles.driver, vehicles.shape, lane, s, v, goal
    return jax.tree.map(lambda x, new: jnp.concatenate([x[:first], new, x[first:]]), others, mine)


def _by_script(state: State, vehicles: EgoStart, first: int) -> State:
    """The state with the speeds that a script says."""
    part = slice(first, first + vehicles.count)
    assert vehicles.v is not None
    v = jnp.where(jnp.isnan(vehicles.v), state.v[part], vehicles.v)
    status = state.status.at[part].set(int(Status.SCRIPTED))
    return replace(state, v=state.v.at[part].set(v), status=status)


def overflow(demand: Demand, key: Key[Array, ""]) -> Bool[Array, ""]:
    """Whether more vehicles enter than the schedule has rows for.

    The host should raise then. The chance is `RARE` per flow and lane, unless rates were changed after
    `build_demand`.
    """
    time = _arrivals(demand, draw_arrivals(demand, key))
    last = jnp.take_along_axis(time, demand.capacity[:, None] - 1, 1)[:, 0]
    return (last < NEVER).any()


def _arrivals(demand: Demand, draws: Float[Array, "K A1"]) -> Float[Array, "K A"]:
    """Arrival times (s) of every stream in order, `NEVER` after its end.

    The process is stationary from `begin` on: that moment falls into a platoon, or between two, in
    proportion to their durations.
    """
    headway, size = demand.headway[:, None], demand.size[:, None]
    block = size.astype(headway.dtype) * headway
    # s since the last platoon began (its whole block between platoons), and vehicles of it that passed
    passed = jnp.minimum(draws[:, :1] * (block + demand.idle[:, None]), block)
    done = jnp.ceil(passed / jnp.where(headway > 0, headway, 1)).astype(jnp.int32)
    place = jnp.minimum(done, size) + jnp.arange(demand.arrivals, dtype=jnp.int32)[None]
    pause = jnp.where(place % size == 0, -jnp.log1p(-draws[:, 1:]) * demand.idle[:, None], 0)
    since = jnp.cumsum(pause, -1) + place.astype(headway.dtype) * headway - passed
    time = demand.begin[:, None] + since
    return jnp.where(time < demand.end[:, None], time, NEVER)


def _sample_queues(
    demand: Demand, draws: Float[Array, "K A1"]
) -> tuple[Float[Array, " V"], Int[Array, " V"], Int[Array, " V"]]:
    """Time (s), lane and stream of every row."""
    time = _arrivals(demand, draws)[demand.row_stream, demand.row_arrival]
    time = jnp.where(demand.row_origin < demand.lane.shape[0], time, NEVER)
    origin, time, stream = lax.sort((demand.row_origin, time, demand.row_stream), num_keys=2)
    lane = demand.lane.at[origin].get(mode="fill", fill_value=NO_LANE)
    return time, lane, stream


def _sample_seats(demand: Demand, draws: Draws) -> tuple[Int[Array, " M"], Float[Array, " M"]]:
    """Seats that are taken, and the place in each (0..1)."""
    # weighted sampling without replacement: the largest sums of logarithm and Gumbel noise
    chance = demand.seat_weight + draws.order
    seat = lax.top_k(chance, demand.initial)[1] if demand.initial else jnp.zeros(0, jnp.int32)
    return seat, draws.place[seat]


def _roles(
    chance: Float[Array, "V 2"], goals: Float[Array, "V G"], types: Float[Array, "V Y"]
) -> tuple[Int[Array, " V"], Int[Array, " V"]]:
    """Goal and type of every vehicle, by cumulative shares."""
    goal, vehicle_type = (
        jnp.sum(chance[:, k, None] >= shares, -1, dtype=jnp.int32) for k, shares in enumerate((goals, types))
    )
    return goal, vehicle_type


def departure_place(
    lane_map: LaneMap, lane: Int[Array, " V"], length: Float[Array, " V"]
) -> Float[Array, " V"]:
    """Front bumper (m) of vehicles that enter where a lane starts.

    The whole body is on the lane if that is long enough. `length` in m.
    """
    most = lane_map.length[lane]
    return jnp.minimum(length, jnp.maximum(most - 0.5, 0.5 * most))


def entry_speed(
    lane_map: LaneMap,
    driver: Driver,
    lane: Int[Array, " V"],
    s: Float[Array, " V"],
    goal: Int[Array, " V"],
) -> Float[Array, " V"]:
    """Speed (m/s) at which the road alone lets a vehicle start.

    At most the desired speed here. Braking with `b` must suffice for the limits and bends of the next lanes,
    and to stop before a junction or the end of a lane that does not lead on.

    Args:
      lane_map: where.
      driver: of the vehicles.
      lane: on which they start.
      s: m along it.
      goal: column of the route table.
    """
    here = lane_map.speed_limit[lane], curvature(lane_map, lane, s)
    speed = desired_speed(driver, *here)
    square = speed * speed
    brake = 2 * driver.b
    share = jnp.arange(1, BEND_POINTS + 1, dtype=speed.dtype)[None] / BEND_POINTS
    reach = jnp.minimum(square / brake, lane_map.length[lane] - s)
    slow = bend_squares(lane_map, driver, lane[:, None], s[:, None] + reach[:, None] * share)
    square = jnp.minimum(square, (slow + (brake * reach)[:, None] * share).min(-1))
    start = -s
    for _ in range(_LOOK):
        after = lane_map.routes.next_lane[lane, goal]
        end = start + lane_map.length[lane]
        dead_end = (after == NO_LANE) & ~lane_map.routes.is_goal[lane, goal] & (lane != NO_LANE)
        stop = start + lane_map.stop_s[lane] - 1
        stop = jnp.where(lane_map.is_connector[after] & ~lane_map.is_connector[lane], stop, _FAR)
        stop = jnp.minimum(stop, jnp.where(dead_end, end - _DEAD_END_ROOM, _FAR))
        square = jnp.minimum(square, brake * jnp.maximum(stop, 0))
        slow = lane_speed(lane_map, driver, after)
        square = jnp.minimum(square, slow * slow + brake * jnp.maximum(end, 0))
        lane, start = after, end
    return safe_sqrt(square)


def _start(
    demand: Demand,
    lane_map: LaneMap,
    slots: int,
    driver: Driver,
    shape: Shape,
    lane: Int[Array, " M"],
    s: Float[Array, " M"],
    free: Float[Array, " M"],
    goal: Int[Array, " M"],
) -> State:
    """The world before any vehicle enters; `free`: m/s on an empty road."""

    def fill(x: Array, empty: Any) -> Array:
        return jnp.concatenate([x, jnp.full(slots - x.shape[0], empty, x.dtype)])

    rest = typical_vehicles(demand.population, slots - lane.shape[0])
    driver, shape = jax.tree.map(lambda x, y: jnp.concatenate([x, y]), (driver, shape), rest)
    zero = jnp.zeros(slots, jnp.float32)
    lane, s, goal = fill(lane, NO_LANE), fill(s, 0), fill(goal, 0)
    state = start_state(lane_map, driver, shape, lane=lane, s=s, v=zero, goal=goal)
    queues = Queues(next=demand.start[:-1], full=jnp.int32(0))
    return replace(state, v=_start_speed(lane_map, state, fill(free, 0)), queues=queues)


def _start_speed(lane_map: LaneMap, state: State, free: Float[Array, " N"]) -> Float[Array, " N"]:
    """Speeds (m/s) at which vehicles can follow their leaders, at most `free`."""
    order = sort_vehicles(lane_map, state)
    n = state.lane.shape[0]
    here = state.lane[:, None], state.s[:, None], order.rank[:n, None] + 1
    found = neighbors(_LOOK_CONFIG, lane_map, order, state, *here)
    lead, gap = found.lead[:, 0], found.lead_gap[:, 0]
    # From below: as the leader is at least that fast in the end, every speed on the way is safe.
    v = jnp.zeros_like(free)
    for _ in range(_SWEEPS):
        v = jnp.where(lead >= 0, jnp.minimum(free, safe_speed(state.driver, gap, v[lead])), free)
    return v


def typical_vehicles(population: Population, n: int) -> tuple[Driver, Shape]:
    """Medians of the first type of a population, `[n]`, for empty slots."""
    values = {name: jnp.full(n, population.median[0, k]) for k, name in enumerate(PARAMETERS)}
    body = {name: values.pop(name) for name in BODY}
    return Driver(**values), Shape(**body, vehicle_class=jnp.full(n, population.vehicle_class[0]))
