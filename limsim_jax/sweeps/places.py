"""Places and kinds of vehicles that an experiment names."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from limsim_jax.maps.cut import piece_at
from limsim_jax.maps.lane_map import lane_rows
from limsim_jax.maps.map import Map, route_name
from limsim_jax.maps.network import Lane, MapError
from limsim_jax.maps.routing import build_fixed_routes
from limsim_jax.sweeps.experiment import ExperimentError, ExperimentFile
from limsim_jax.sweeps.script_file import PlacedTable
from limsim_jax.traffic.vehicles import sample_vehicles, uniform_population
from limsim_jax.types import Driver, Shape
from limsim_jax.xla import run_once


def vehicles_of(where: str, tables: Sequence[PlacedTable]) -> tuple[Driver, Shape]:
    """Drivers and bodies of vehicles that are named one by one, `[E]`."""
    found = [_vehicle(_field(where, k, tables), table) for k, table in enumerate(tables)]
    return jax.tree.map(lambda *x: jnp.concatenate(x), *found)


def placed(
    where: str, tables: Sequence[PlacedTable], shape: Shape, town: Map, *, goes: bool = True
) -> dict[str, Any]:
    """Lane, place and goal of vehicles: fields of `EgoStart`.

    Args:
      where: experiment and field, for messages.
      tables: of the vehicles.
      shape: of their bodies.
      town: the map.
      goes: whether they go anywhere; otherwise any goal will do.

    Raises:
      ExperimentError: a place or goal that the map does not have; one line.
    """
    lanes, places, goals = [], [], []
    rows = lane_rows(town.network)
    for k, (table, length) in enumerate(zip(tables, shape.length.tolist(), strict=True)):
        field = _field(where, k, tables)
        lane, s = spot(field, table.start, table.lane, max(table.s, length), town)
        row = rows[lane.id]
        lanes.append(row)
        places.append(max(s, length))  # the whole body is on its lane
        if goes:
            name = _route(field, table.route, lane) if table.route else table.goal
            goals.append(_goal(field, name, lane, row, town))
        else:
            goals.append(int(jnp.argmax(town.lanes.routes.reachable[row])))
    return {
        "lane": jnp.asarray(lanes, jnp.int32),
        "s": jnp.asarray(places, jnp.float32),
        "goal": jnp.asarray(goals, jnp.int32),
    }


def _field(where: str, number: int, tables: Sequence[Any]) -> str:
    """The field of a table in messages."""
    return where if len(tables) == 1 else f"{where}.{number}"


def _vehicle(where: str, table: PlacedTable) -> Any:
    try:
        population = uniform_population(table.vehicle, **table.driver)
    except ValueError as error:
        raise ExperimentError(f"{where}: {error}") from None
    vehicle = jnp.argmax(population.share)[None].astype(jnp.int32)
    # compiled as one program: operation by operation it takes seconds
    sample = jax.jit(sample_vehicles, compiler_options=run_once())
    return sample(population, jax.random.key(0), jnp.zeros(1, jnp.int32), vehicle)


def spot(where: str, start: str, lane: int, s: float, town: Map) -> tuple[Lane, float]:
    """A lane and m along it.

    Args:
      where: experiment and field, for messages.
      start: an entry of the map, a road or lane id.
      lane: which of the lanes there, from the right.
      s: m along the lane, as the map file has it.
      town: the map.

    Raises:
      ExperimentError: no such place; one line.
    """
    lanes = town.network.lanes
    name, along = piece_at(lanes, _start_lane(where, start, lane, town), s)
    if not along < lanes[name].length:
        whole = s - along + lanes[name].length
        raise ExperimentError(f"{where}.s: {s:g} m, but lane '{name}' is only {whole:.1f} m long")
    if not lanes[name].drivable:
        raise ExperimentError(f"{where}.start: lane '{name}' is no lane to start on")
    return lanes[name], along


def _start_lane(where: str, start: str, number: int, town: Map) -> str:
    network, known = town.network, town.origins
    if start in network.lanes:
        lanes = [start]
    elif start in known:
        lanes = list(known[start])
    else:
        road = [lane for lane in network.drivable_lanes() if lane.road == start and lane.junction is None]
        first = [lane for lane in road if lane.section == min(x.section for x in road)]
        if len({lane.number < 0 for lane in first}) > 1:
            raise ExperimentError(
                f"{where}.start: road '{start}' has traffic both ways; name one of its lanes, as "
                f"'{first[0].id}'"
            )
        lanes = [lane.id for lane in first]
    if not lanes:
        raise ExperimentError(
            f"{where}.start: no origin, road or lane '{start}'; origins are {', '.join(known)}"
        )
    rightmost = [lane for lane in lanes if network.lanes[lane].right not in lanes]
    ordered = rightmost[:1]
    while ordered and network.lanes[ordered[-1]].left in lanes:
        ordered.append(str(network.lanes[ordered[-1]].left))
    if number >= len(ordered):
        raise ExperimentError(f"{where}.lane: {number}, but '{start}' has lanes 0 to {len(ordered) - 1}")
    if network.lanes[ordered[number]].junction is not None:
        raise ExperimentError(f"{where}.start: lane '{ordered[number]}' is no lane to start on")
    return ordered[number]


def check_routes(experiment: ExperimentFile, town: Map) -> None:
    """Raise `ExperimentError` where a route cannot be driven on the map; one line."""
    rows = lane_rows(town.network)
    for name, tables in ("ego", experiment.ego), ("vehicle", experiment.vehicle):
        for k, table in enumerate(tables):
            where = f"{_field(f'{experiment.name}: {name}', k, tables)}.route"
            twice = [road for road in table.route if table.route.count(road) > 1]
            if twice:
                raise ExperimentError(f"{where}: visits road '{twice[0]}' twice; once is possible")
            try:
                if table.route:
                    build_fixed_routes(town.network, rows, [table.route])
            except MapError as error:
                raise ExperimentError(f"{where}: {error.reason}") from None


def _route(where: str, roads: Sequence[str], lane: Lane) -> str:
    if lane.road != roads[0]:
        raise ExperimentError(
            f"{where}.route: begins with road '{roads[0]}', but the vehicle starts on road '{lane.road}'"
        )
    return route_name(roads)


def _goal(where: str, goal: str | None, lane: Lane, row: int, town: Map) -> int:
    """Column of the goal; of a vehicle without one, of the only goal that it can reach."""
    goals = list(town.goals)
    can = [name for k, name in enumerate(goals) if bool(town.lanes.routes.reachable[row, k])]
    if goal is None and len(can) == 1:
        return goals.index(can[0])
    if goal not in goals:
        wanted = "a goal is missing" if goal is None else f"no goal or lane '{goal}'"
        raise ExperimentError(f"{where}.goal: {wanted}; goals are {', '.join(goals if goal else can)}")
    if goal not in can:
        raise ExperimentError(
            f"{where}.goal: '{goal}' cannot be reached from lane '{lane.id}'; "
            f"from there it goes to {', '.join(can) or 'nowhere'}"
        )
    return goals.index(goal)
