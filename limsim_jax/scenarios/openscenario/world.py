"""A built scenario as a world of the engine: slots, egos, and the player as a hook of the traffic."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from limsim_jax.maps.lane_map import lane_rows
from limsim_jax.maps.map import Map
from limsim_jax.scenarios.openscenario.arrays import Board, Kind, Memory
from limsim_jax.scenarios.openscenario.build import Built
from limsim_jax.scenarios.openscenario.player import Bodies, step
from limsim_jax.scenarios.openscenario.roads import Pose, Roads
from limsim_jax.scenarios.openscenario.storyboard import Entity, Scenario
from limsim_jax.sweeps.experiment import EgoTable
from limsim_jax.sweeps.places import vehicles_of
from limsim_jax.traffic.state import start_state
from limsim_jax.types import Config, Driver, Egos, Outside, Schedule, Shape, State
from limsim_jax.types import Scenario as World

CLASSES = {
    "car": "car",
    "van": "van",
    "truck": "truck",
    "semitrailer": "truck",
    "trailer": "truck",
    "bus": "bus",
    "motorbike": "motorcycle",
    "bicycle": "motorcycle",
}
"""Vehicle classes of the engine by categories of files; all others are cars with bodies of their own."""

_start = jax.jit(start_state)  # operation by operation it takes longer


@dataclass(frozen=True)
class Play:
    """The player of a scenario, as `Traffic.player`."""

    def __call__(self, config: Config, told: Any, state: State) -> Outside:
        """Where the entities are a step later."""
        board: Board = told
        outside = state.outside
        assert outside is not None
        memory: Memory = outside.memory
        slot = jnp.maximum(outside.slot, 0)
        box = outside.box
        ahead = board.entities.ahead
        back = jnp.stack([box[:, 0] - ahead * jnp.cos(box[:, 2]), box[:, 1] - ahead * jnp.sin(box[:, 2])], -1)
        pose = jnp.concatenate([back, box[:, 2:3]], -1)
        here = state.active[slot] & (outside.slot >= 0)
        bodies = Bodies(pose, state.v[slot], state.a[slot], here)
        after = step(config.dt, board, memory, bodies)
        return outside_of(board, after, outside.slot, box)


def outside_of(board: Board, memory: Memory, slot: Any, box: Any) -> Outside:
    """Entities as the traffic sees them."""
    x, y, h = memory.pose[:, 0], memory.pose[:, 1], memory.pose[:, 2]
    ahead = board.entities.ahead
    return Outside(
        slot=slot,
        held=memory.held & board.entities.real,
        there=memory.there & memory.seen & board.entities.real,
        x=x + ahead * jnp.cos(h),
        y=y + ahead * jnp.sin(h),
        heading=h,
        v=memory.v,
        a=memory.a,
        box=box,
        over=memory.over,
        memory=memory,
    )


def vehicles(entities: tuple[Entity, ...], count: int) -> tuple[Driver, Shape]:
    """Drivers and bodies of entities, `[count]`; padding is a car."""
    names = [CLASSES.get(x.category, "car") if x.kind == "vehicle" else "car" for x in entities]
    names += ["car"] * (count - len(entities))
    driver, shape = jax.tree.map(lambda *x: np.concatenate(x), *map(_of_class, names))

    def column(values: list[float], old: Any) -> Any:
        return np.array([*values, *old[len(values) :]], np.float32)

    bodies = [x.box for x in entities]
    bases = [x.wheelbase or min(2.7, 0.6 * x.box.length) for x in entities]
    return driver, Shape(
        length=column([x.length for x in bodies], shape.length),
        width=column([x.width for x in bodies], shape.width),
        wheelbase=column(bases, shape.wheelbase),
        vehicle_class=shape.vehicle_class,
    )


@cache
def _of_class(name: str) -> tuple[Driver, Shape]:
    """Driver and body of a class of vehicles, `[1]`, NumPy."""
    return jax.tree.map(np.asarray, vehicles_of("entities", [EgoTable(vehicle=name)]))


def world_of(
    scenario: Scenario, built: Built, roads: Roads, *, free: bool, slots: int | None = None
) -> World:
    """The world in which a scenario is played.

    Slots are those of the entities in the order of the file, but that of the ego is 0.

    Args:
      scenario: resolved.
      built: its arrays.
      roads: the map.
      free: whether the policy drives the ego in the plane.
      slots: of the world; by default as many as entities.
    """
    town = roads.town
    count = built.board.entities.real.shape[0]
    slots = count if slots is None else max(slots, count)
    ego = _ego_row(scenario, built)
    order = [ego, *(k for k in range(count) if k != ego)]  # entity of each slot
    slot = np.empty(count, np.int32)
    slot[order] = np.arange(count)
    driver, shape = vehicles(tuple(scenario.entities[k] for k in order if k < len(scenario.entities)), slots)
    lane, s, d, v, goal, active = _starts(built, roads, order, slots)
    state = _start(town.lanes, driver, shape, lane=lane, s=s, v=v, goal=goal, active=active)
    board, memory = built.board, built.memory
    here: Any = np.where(board.entities.real, slot, -1).astype(np.int32)
    outside = outside_of(board, memory, here, None)
    x, y, h = (np.asarray(z) for z in (outside.x, outside.y, outside.heading))
    box: Any = np.stack([x, y, h, board.entities.length, board.entities.width], -1)
    zero, mine = np.zeros(1, np.float32), slice(ego, ego + 1)
    egos: dict[str, Any] = dict(
        slot=np.zeros(1, np.int32), free=np.full(1, free), x=x[mine], y=y[mine], heading=h[mine],
        steering=zero, a=zero,
    )  # fmt: skip
    state = replace(state, d=d, egos=Egos(**egos), outside=replace(outside, box=box))
    return World(start=state, schedule=schedule_of(board, driver, shape))


def schedule_of(board: Board, driver: Driver, shape: Shape) -> Schedule:
    """A schedule without vehicles, with the scenario."""
    none, zero = np.zeros(1, np.float32), np.zeros(1, np.int32)
    first = jax.tree.map(lambda z: z[:1], (driver, shape))
    fields: dict[str, Any] = dict(
        time=none + np.float32(np.inf), lane=zero, s=none, v=none, goal=zero, driver=first[0], shape=first[1],
        start=zero, outside=board,
    )  # fmt: skip
    return Schedule(**fields)


def _ego_row(scenario: Scenario, built: Built) -> int:
    names = [x.name for x in built.starts]
    return names.index(scenario.ego) if scenario.ego in names else 0


def _starts(built: Built, roads: Roads, order: list[int], slots: int) -> tuple[Any, ...]:
    """Lane, s, d, speed, goal and presence of all slots."""
    rows = lane_rows(roads.network)
    town: Map = roads.town
    routes = town.lanes.routes
    next_lane, distance = np.asarray(routes.next_lane), np.asarray(routes.distance)
    is_goal = np.asarray(routes.is_goal)
    lane, s, d, v = (np.zeros(slots, kind) for kind in (np.int32, np.float32, np.float32, np.float32))
    goal, active = np.zeros(slots, np.int32), np.zeros(slots, bool)
    board = built.board
    for k, entity in enumerate(order):
        if entity >= len(built.starts):
            continue
        start = built.starts[entity]
        ahead, length = float(board.entities.ahead[entity]), float(board.entities.length[entity])
        pose = start.pose
        middle = Pose(pose.x + ahead * math.cos(pose.h), pose.y + ahead * math.sin(pose.h), pose.h)
        spot = roads.nearest(middle)
        v[k], active[k] = max(start.v, 0.0), start.there
        if spot is None:
            continue
        row = rows[spot.lane.id]
        lane[k], s[k], d[k] = row, spot.s + length / 2, spot.d
        leads = (next_lane[row] >= 0) | is_goal[row]
        cost = np.where(leads, distance[row], distance[row] + 1e7)
        end = roads.nearest(_end_of_way(built, roads, entity))
        if end is not None:  # the way out at the end of its way, if it can get there
            there = rows[end.lane.id]
            beyond = leads & ((next_lane[there] >= 0) | is_goal[there])
            cost = np.where(beyond, distance[there], np.inf) if beyond.any() else cost
        goal[k] = int(np.argmin(cost))
    return lane, s, d, v, goal, active


def _end_of_way(built: Built, roads: Roads, entity: int) -> Pose:
    """The end of the way of an entity: of its route, or straight on from its start."""
    board, actions = built.board, built.board.actions
    routes = np.flatnonzero((actions.kind == Kind.ROUTE) & (actions.entity == entity))
    way = int(actions.corridor[routes[0]] if len(routes) else built.memory.corridor[entity])
    x, y, h = np.asarray(board.corridors.line[way, board.corridors.last[way]], float)
    x0, y0 = np.asarray(roads.town.lanes.origin, float)
    return Pose(x + x0, y + y0, h)
