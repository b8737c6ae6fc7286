"""Demand that a random map can carry, and tables of few sizes.

Rates are in proportion to the lanes of an origin, times a draw of the map. From there every vehicle takes its
route, which gives the flow on each lane. Three bounds say what share of its capacity each place uses:

- a lane carries `SATURATION`;
- an approach to lights carries that during its green;
- where lanes cross or merge, the flow of a lane and of all its foes together is at most `SHARED`, by control.

The rates are scaled such that the place with the largest share uses the share of `LEVELS`. As many vehicles
are on the road at the start as these flows mean at `SLOWED` times the limits.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps import build_lane_map
from limsim_jax.maps.conflicts import ConflictType
from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.maps.network import Control, Network
from limsim_jax.maps.origins import origins
from limsim_jax.maps.routing import default_goals
from limsim_jax.maps.signal_table import SignalState
from limsim_jax.sweeps.build import plain_origins
from limsim_jax.traffic.demand import Demand, Flow, build_demand
from limsim_jax.traffic.vehicles import default_population, restrict_to_map

LEVELS = {"low": 0.25, "moderate": 0.5, "high": 0.85}
"""Largest share of a capacity that is used."""

SATURATION = 1700.0
"""veh/h on a lane without stops."""

SHARED = {Control.ALL_WAY_STOP: 800.0, Control.SIGNAL: 1100.0, Control.ZIPPER: 1500.0}
"""veh/h of lanes that cross or merge, together, by control; others: `CROSSED` or `MERGED`."""

CROSSED, MERGED = 1000.0, 1700.0
"""veh/h where lanes cross, and where they only merge."""

SLOWED = 0.7
"""Mean speed of traffic, as a share of the limits."""

LEAST_RATE = 10.0
"""veh/h per origin."""

FIRST_RATE = 100.0
"""veh/h per lane, from which rates are scaled."""


class Size(NamedTuple):
    """Sizes that all maps and demands of a class share."""

    maps: dict[str, int]  # of `rasterise.LEAST`
    demand: dict[str, int]  # of `demand.arrays.LEAST`
    slots: int  # vehicles at once


_TABLES = (
    "lanes", "rows", "neighbors", "chunks", "cells", "candidates", "connectors", "foes", "goals", "programs",
    "phases", "links", "movements", "sight", "behind", "approaches",
)  # fmt: skip
_DEMAND = "streams", "origins", "rows", "arrivals", "seats", "vehicles"


def _size(maps: tuple[int, ...], demand: tuple[int, ...], slots: int) -> Size:
    return Size(dict(zip(_TABLES, maps, strict=True)), dict(zip(_DEMAND, demand, strict=True)), slots)


SIZES = {
    "small": _size(
        (128, 8192, 4, 2048, 16384, 49152, 96, 16, 16, 16, 16, 32, 96, 6, 4, 5),
        (24, 24, 2048, 192, 256, 48),
        96,
    ),
    "medium": _size(
        (384, 8192, 6, 2048, 16384, 49152, 256, 24, 48, 24, 16, 32, 256, 8, 4, 5),
        (24, 24, 2048, 192, 512, 96),
        160,
    ),
    "large": _size(
        (1024, 16384, 8, 2048, 16384, 49152, 768, 32, 192, 32, 16, 48, 768, 12, 4, 6),
        (64, 64, 4096, 192, 1024, 128),
        256,
    ),
}
"""Size classes, the least first. A map that fits into none has a program of its own."""


class Loaded(NamedTuple):
    """A map with its tables, of a size class."""

    network: Network
    lane_map: LaneMap
    size: str
    """Name of the class, or `own`."""


def table_sizes(lane_map: LaneMap) -> dict[str, int]:
    """Sizes of the padded tables."""
    (connectors, foes), (programs, phases, links) = lane_map.conflicts.foe.shape, lane_map.signals.state.shape
    return {
        "lanes": lane_map.length.shape[0],
        "rows": lane_map.rows.shape[0],
        "neighbors": max(lane_map.successors.shape[1], lane_map.predecessors.shape[1]),
        "chunks": lane_map.chunk.shape[0],
        "cells": lane_map.cell_start.shape[0] - 1,
        "candidates": lane_map.cell_chunks.shape[0],
        "connectors": connectors,
        "foes": foes,
        "goals": lane_map.routes.distance.shape[1],
        "programs": programs,
        "phases": phases,
        "links": links,
        "movements": lane_map.signals.movement_link.shape[0],
        "sight": lane_map.lanes_in_sight,
        "behind": lane_map.lanes_behind,
        "approaches": lane_map.approaches,
    }


def load(network: Network) -> Loaded:
    """Tables of the least class that the network fits into."""
    count = sum(1 for _ in network.drivable_lanes())
    lane_map = None
    for name, size in SIZES.items():
        if count < size.maps["lanes"]:
            lane_map = build_lane_map(network, least=size.maps, cache=False)
            if table_sizes(lane_map) == size.maps:
                return Loaded(network, lane_map, name)
    return Loaded(network, lane_map or build_lane_map(network, cache=False), "own")


def demand_of(loaded: Loaded, level: str, seed: int, seconds: float) -> tuple[Demand, float]:
    """Demand of a level for the map of a seed.

    Returns it and the rate of all origins together, veh/h.
    """
    network, lane_map, _ = loaded
    names, lanes = plain_origins(network, lane_map), origins(network)
    rng = np.random.default_rng([seed, 1])
    rates = {name: FIRST_RATE * len(lanes.get(name, [""])) * float(rng.uniform(0.6, 1.4)) for name in names}
    if names:
        flow = _flows(lane_map, _build(loaded, rates, 0, seconds))
    else:  # a ring: what is on it stays there
        flow = np.where(np.asarray(lane_map.valid), SATURATION, 0.0)
    scale = LEVELS[level] / max(_used(network, lane_map, flow), 1e-6)
    rates = {name: max(rate * scale, LEAST_RATE) for name, rate in rates.items()}
    outside = np.asarray(lane_map.valid) & ~np.asarray(lane_map.is_connector)
    hours = np.asarray(lane_map.length) / np.asarray(lane_map.speed_limit) / SLOWED / 3600
    vehicles = round(float((flow * hours)[outside].sum()) * scale)
    size = SIZES.get(loaded.size)
    if size is not None:
        vehicles = min(vehicles, size.demand["vehicles"])
    while True:
        try:
            return _build(loaded, rates, vehicles, seconds), sum(rates.values())
        except ValueError as error:
            if "places" not in str(error) or not vehicles:
                raise
            vehicles //= 2


def _build(loaded: Loaded, rates: Mapping[str, float], vehicles: int, seconds: float) -> Demand:
    network, lane_map, size = loaded
    return build_demand(
        network,
        lane_map,
        default_goals(network),
        [Flow(origin=name, rate=rate) for name, rate in rates.items()],
        restrict_to_map(default_population(), lane_map),
        horizon=seconds,
        vehicles=vehicles,
        least=SIZES[size].demand if size in SIZES else None,
    )


def _flows(lane_map: LaneMap, demand: Demand) -> NDArray[np.float64]:
    """veh/h on each lane, by the routes from all origins."""
    routes = lane_map.routes
    next_lane, to_go = np.asarray(routes.next_lane), np.asarray(routes.lanes_to_go)
    due = np.asarray(routes.change_distance) <= np.asarray(lane_map.length)[:, None] + 0.1
    is_goal, beside = np.asarray(routes.is_goal), (np.asarray(lane_map.right), np.asarray(lane_map.left))
    flow = np.zeros(len(next_lane))
    rows = np.asarray(demand.row_origin)
    used = rows < demand.lane.shape[0]
    origin_of = dict(zip(np.asarray(demand.row_stream)[used].tolist(), rows[used].tolist(), strict=True))
    for stream, origin in origin_of.items():
        shares = np.diff(np.asarray(demand.goals[stream]), prepend=0.0)
        for goal in np.nonzero(shares > 0)[0]:
            rate = 3600 / float(demand.idle[stream]) * shares[goal]
            lane, way = int(demand.lane[origin]), set()
            while lane >= 0 and lane not in way:
                way.add(lane)
                if is_goal[lane, goal]:
                    break
                across, after = to_go[lane, goal], int(next_lane[lane, goal])
                change = across != 0 and (after < 0 or due[lane, goal])
                lane = int(beside[int(across > 0)][lane]) if change else after
            flow[list(way)] += rate
    return flow


def _used(network: Network, lane_map: LaneMap, flow: NDArray[np.float64]) -> float:
    """The largest share of a capacity that these flows use."""
    table, signals = lane_map.conflicts, lane_map.signals
    used = [float(flow.max()) / SATURATION]
    lane, foes = np.asarray(table.lane), np.asarray(table.foe)
    kind, movement = np.asarray(table.type), np.asarray(table.movement)
    by_connector = np.where(lane >= 0, flow[lane], 0.0)
    for k in np.nonzero(by_connector > 0)[0]:
        crossing = {int(f) for f, t in zip(foes[k], kind[k], strict=True) if t == ConflictType.CROSS}
        merging = {int(f) for f, t in zip(foes[k], kind[k], strict=True) if t == ConflictType.MERGE}
        if crossing | merging:
            control = network.movements[movement[k]].control if movement[k] >= 0 else None
            most = SHARED.get(control, CROSSED if crossing else MERGED) if control else MERGED
            used.append((by_connector[k] + sum(by_connector[f] for f in crossing | merging)) / most)
    state, duration = np.asarray(signals.state), np.asarray(signals.duration)
    program, link = np.asarray(signals.lane_program), np.asarray(signals.lane_link)
    before = np.asarray(lane_map.predecessors)
    approach = np.zeros(len(flow))
    for row in np.nonzero((program >= 0) & (flow > 0))[0]:
        shown = state[program[row], :, link[row]]
        green = np.where(
            shown == SignalState.GREEN_MAJOR, 1.0, np.where(shown == SignalState.GREEN_MINOR, 0.6, 0)
        )
        share = float((green * duration[program[row]]).sum() / max(duration[program[row]].sum(), 1e-6))
        approach[before[row, 0]] += flow[row] / (SATURATION * max(share, 0.02))
    return max([*used, float(approach.max())])
