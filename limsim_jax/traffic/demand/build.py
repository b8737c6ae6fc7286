"""From flows and a density to a `Demand` for the device."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps.lane_map import (
    NO_LANE,
    LaneMap,
    bucket,
)
from limsim_jax.maps.network import Network
from limsim_jax.traffic.demand.arrays import (
    LEAST,
    NEVER,
    Demand,
    EgoStart,
    draw_number,
)
from limsim_jax.traffic.demand.flows import Flow, Stream, streams_of
from limsim_jax.traffic.demand.seats import lay_out_seats, with_room
from limsim_jax.traffic.demand.tables import Tables, cumulative
from limsim_jax.traffic.vehicles import Population


def build_demand(
    network: Network,
    lane_map: LaneMap,
    goals: Mapping[str, Sequence[str]],
    flows: Iterable[Flow],
    population: Population,
    *,
    horizon: float,
    density: float = 0.0,
    vehicles: int | None = None,
    egos: EgoStart | None = None,
    placed: EgoStart | None = None,
    common: Collection[str] | None = None,
    least: Mapping[str, int] | None = None,
) -> Demand:
    """Check flows and density, and lay them out for the device.

    Args:
      network: the map.
      lane_map: of that map and these goals.
      goals: lane ids by name, in the order of the columns of `lane_map.routes`
        (`maps.routing.default_goals` if the map was built without any).
      flows: vehicles that enter later. Several flows may use one lane; they share its queue.
      population: from which vehicles are drawn.
      horizon: s; no vehicle enters after it.
      density: vehicles at the start per km of lane outside junctions.
      vehicles: instead of that, how many there are at the start.
      egos: vehicles under test; no other vehicle starts within `EGO_ROOM` on their lanes, or touches them.
      placed: other vehicles with a place of their own, for which the same holds.
      common: goals of flows without one, and of vehicles at the start; None: all.
      least: least sizes of tables by the names in `LEAST`, so that demands share compiled programs. Those
        of `seats` and `vehicles` change the draws of vehicles at the start.

    Raises:
      KeyError: an unknown name in `least`.
      ValueError: an unknown or unreachable origin or goal, a number out of range, a lane that is open to
        none of the vehicles, or a density that does not fit; one line that says which.
    """
    if not 0 < horizon < math.inf:
        raise ValueError(f"horizon = {horizon:g} s; it has to be positive and finite")
    if not 0 <= density < math.inf:
        raise ValueError(f"density = {density:g} veh/km; it has to be 0 or more, and finite")
    if vehicles is not None and vehicles < 0:
        raise ValueError(f"vehicles = {vehicles}; it has to be 0 or more")
    least = dict(least or {})
    if unknown := sorted(set(least) - set(LEAST)):
        raise KeyError(f"no table '{unknown[0]}'; there are {', '.join(LEAST)}")
    size = {name: max(count, least.get(name, 0)) for name, count in LEAST.items()}
    tables = Tables.of(network, lane_map, goals, population, common)
    streams: list[Stream] = []
    for i, flow in enumerate(flows):
        streams += streams_of(tables, flow, i, horizon)
    kept = [(x.lane, x.s) for x in (egos, placed) if x is not None and x.lane is not None]
    taken = np.concatenate([np.array(x, float) for x in [np.zeros((2, 0)), *kept]], 1)
    wanted = sum((s.rate * s.goals for s in streams), np.zeros(tables.reachable.shape[1]))
    if vehicles is None:
        seats = lay_out_seats(tables, density, wanted, taken)
    else:
        km = sum(lane.length for lane in network.drivable_lanes() if lane.junction is None) / 1e3
        density = vehicles / max(km, 1e-3)
        seats = lay_out_seats(tables, density, wanted, taken)
        if seats["initial"] not in (0, vehicles):  # lanes that are closed to all types have no places
            seats = lay_out_seats(tables, density * vehicles / seats["initial"], wanted, taken)
    seats = with_room(seats, size["seats"], size["vehicles"])
    arrays = _lay_out(tables, streams, size) | seats
    return jax.tree.map(jnp.asarray, Demand(population=population, **arrays))


def _lay_out(tables: Tables, streams: list[Stream], least: Mapping[str, int]) -> dict[str, Any]:
    """Streams and rows as arrays; origins in order of their lanes."""
    streams = sorted(streams, key=lambda stream: (stream.row, stream.number))
    lanes = sorted({stream.row for stream in streams})
    origin_of = np.array([lanes.index(stream.row) for stream in streams], int)
    capacity = np.array([stream.capacity() for stream in streams], int)
    rows = int(capacity.sum())
    num_streams = bucket(len(streams), least["streams"])
    num_origins, num_rows = bucket(len(lanes), least["origins"]), bucket(rows, least["rows"])

    def of_streams(values: list[Any], fill: Any, dtype: Any) -> NDArray[Any]:
        table = np.full((num_streams, *np.shape(fill)), fill, dtype)
        if values:
            table[: len(values)] = np.array(values)
        return table

    def of_rows(values: NDArray[np.int_], fill: int) -> NDArray[np.int32]:
        return np.concatenate([values, np.full(num_rows - rows, fill)]).astype(np.int32)

    first = np.cumsum(capacity) - capacity
    start = np.full(num_origins + 1, rows)
    start[: len(lanes)] = first[np.searchsorted(origin_of, np.arange(len(lanes)))]
    lane = np.full(num_origins, NO_LANE)
    lane[: len(lanes)] = lanes
    goal_fill, type_fill = np.ones(tables.reachable.shape[1]), np.ones(len(tables.shares))
    return {
        "stream": of_streams([draw_number(s.row, s.number) for s in streams], 0, np.uint32),
        "begin": of_streams([s.begin for s in streams], NEVER, np.float32),
        "end": of_streams([s.end for s in streams], 0.0, np.float32),
        "headway": of_streams([s.headway for s in streams], 0.0, np.float32),
        "size": of_streams([s.size for s in streams], 1, np.int32),
        "idle": of_streams([s.idle for s in streams], 1.0, np.float32),
        "speed": of_streams(
            [NEVER if s.flow.speed is None else s.flow.speed for s in streams], 0.0, np.float32
        ),
        "goals": of_streams([cumulative(s.goals) for s in streams], goal_fill, np.float32),
        "types": of_streams([cumulative(s.types) for s in streams], type_fill, np.float32),
        "capacity": of_streams(capacity.tolist(), 1, np.int32),
        "row_origin": of_rows(np.repeat(origin_of, capacity), num_origins),
        "row_stream": of_rows(np.repeat(np.arange(len(streams)), capacity), num_streams - 1),
        "row_arrival": of_rows(np.arange(rows) - np.repeat(first, capacity), 0),
        "start": start.astype(np.int32),
        "lane": lane.astype(np.int32),
        "arrivals": bucket(int(capacity.max(initial=1)), least["arrivals"]),
    }
