"""Worlds for tests of the engine: maps, drivers, and vehicles placed at random."""

from __future__ import annotations

import functools
import math

import jax.numpy as jnp
import numpy as np

from limsim_jax.maps import build_lane_map, bundled_map, read_network
from limsim_jax.maps.lane_map import LaneMap, lane_rows
from limsim_jax.maps.network import Network
from limsim_jax.maps.routing import default_goals
from limsim_jax.traffic.demand import Demand, build_demand
from limsim_jax.traffic.state import start_state
from limsim_jax.traffic.vehicles import uniform_population
from limsim_jax.types import Driver, Schedule, Shape, State


@functools.cache
def bundled(name: str) -> tuple[Network, LaneMap]:
    """A bundled map and its lane map."""
    network = read_network(bundled_map(name), cache=False)
    return network, build_lane_map(network)


@functools.cache
def motorway() -> tuple[int, int]:
    """A long rightmost lane of the bundled motorway, and a goal without a lane change."""
    network, lane_map = bundled("highway")
    right, length = np.asarray(lane_map.right), np.asarray(lane_map.length)  # concrete, also while tracing
    lane = next(row for row in lane_rows(network).values() if right[row] == -1 and length[row] > 500)
    reachable, to_go = np.asarray(lane_map.routes.reachable), np.asarray(lane_map.routes.lanes_to_go)
    return lane, int(np.flatnonzero(reachable[lane] & (to_go[lane] == 0))[0])


def drivers(n: int, **changes: float) -> Driver:
    """Equal drivers."""
    values = {
        "speed_factor": 1.0, "v_max": 60.0, "T": 1.2, "s0": 2.0, "a": 1.5, "b": 2.0, "delta": 4.0,
        "b_max": 8.0, "coolness": 0.99, "politeness": 0.2, "threshold": 0.15, "b_safe": 3.0,
        "keep_right": 0.0, "lane_change_time": 4.5, "a_lat": 2.5, "gap_factor": 1.0, "svo": 0.0,
    } | changes  # fmt: skip
    return Driver(**{name: jnp.full(n, value, jnp.float32) for name, value in values.items()})


def shapes(n: int, length: float = 5.0) -> Shape:
    """Equal cars."""
    return Shape(
        length=jnp.full(n, length, jnp.float32),
        width=jnp.full(n, 1.9, jnp.float32),
        wheelbase=jnp.full(n, 2.8, jnp.float32),
        vehicle_class=jnp.zeros(n, jnp.int32),
    )


def state_of(name, lane, s, v, goal, active=None, driver=None, shape=None) -> State:
    """Vehicles that keep their lanes on a bundled map."""
    n = len(lane)
    return start_state(
        bundled(name)[1], drivers(n) if driver is None else driver, shapes(n) if shape is None else shape,
        lane=jnp.asarray(lane), s=jnp.asarray(s), v=jnp.asarray(v), goal=jnp.asarray(goal), active=active,
    )  # fmt: skip


def scattered(name: str, n: int, seed: int, spacing: float = 30.0, v: float = 15.0) -> State:
    """`n` vehicles at random seats `spacing` m apart on the lanes of a map, each with a goal it can reach."""
    network, lane_map = bundled(name)
    rng = np.random.default_rng(seed)
    rows = lane_rows(network)
    seats = [
        (row, s)
        for lane, row in rows.items()
        if network.lanes[lane].junction is None
        for s in np.arange(12.0, network.lanes[lane].length - 6.0, spacing)
    ]
    reachable = np.asarray(lane_map.routes.reachable)
    pick = [seats[i] for i in rng.permutation(len(seats))[:n]]
    goal = [rng.choice(np.nonzero(reachable[row])[0]) for row, _ in pick]
    jitter = rng.uniform(-5.0, 5.0, len(pick))
    return state_of(
        name, [row for row, _ in pick], np.array([s for _, s in pick]) + jitter, np.full(len(pick), v), goal
    )


def no_arrivals(state: State) -> Schedule:
    """A schedule without departures, for the world of this state."""
    zero = jnp.zeros(1, jnp.int32)
    return Schedule(
        time=jnp.full(1, 1e9), lane=zero - 1, s=jnp.zeros(1), v=jnp.zeros(1), goal=zero,
        driver=drivers(1), shape=shapes(1), start=jnp.zeros(1 + state.queues.next.shape[0], jnp.int32),
    )  # fmt: skip


def demand_of(name, flows, population=None, horizon=3600.0, density=0.0) -> Demand:
    """Demand on a bundled map; equal cars unless a population is given."""
    population = uniform_population() if population is None else population
    network, lane_map = bundled(name)
    goals = default_goals(network)
    return build_demand(network, lane_map, goals, flows, population, horizon=horizon, density=density)


def _corners(box):
    x, y, heading, length, width = box
    c, s = math.cos(heading), math.sin(heading)
    return np.array([
        (x + a * length / 2 * c - b * width / 2 * s, y + a * length / 2 * s + b * width / 2 * c)
        for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))
    ])  # fmt: skip


def overlap(a, b) -> bool:
    """Whether two boxes share a point: no edge of either separates their corners."""
    p, q = _corners(a), _corners(b)
    for shape in (p, q):
        for i in range(4):
            edge = shape[(i + 1) % 4] - shape[i]
            normal = np.array([-edge[1], edge[0]])
            if (p @ normal).max() < (q @ normal).min() or (q @ normal).max() < (p @ normal).min():
                return False
    return True
