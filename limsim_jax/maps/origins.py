"""Where traffic comes into a map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool

from limsim_jax.maps.conflicts.overlaps import CLEARANCE
from limsim_jax.maps.lane_map import lane_rows
from limsim_jax.maps.network import Lane, Network
from limsim_jax.maps.routing import Round, default_goals

LEAST_LENGTH = 60.0
"""m: `road_origins` names no shorter road."""

_NARROW = 2.0  # m: no vehicle enters on a narrower lane
_CAR = 5.0  # m, length of a car


def origins(network: Network) -> dict[str, tuple[str, ...]]:
    """The ways into a map: groups of lane ids by name.

    One per road and direction by which traffic comes in: the first lanes, none of which has a drivable
    predecessor. A lane that starts beside one that continues is no origin, nor is one narrower than a car,
    or so short that a car that comes in would lie on another road. Closed maps have none. Names are road
    ids, with `+` or `-` for the sign of the lane numbers where a road has traffic both ways (OpenDRIVE).
    """
    found = {
        name: tuple(lane.id for lane in lanes if lane.width_at(min(_CAR, lane.length)) >= _NARROW)
        for name, lanes in road_starts(network).items()
        if all(lane.junction is None for lane in lanes)
        and not any(_drivable(network, x) for lane in lanes for x in lane.predecessors)
    }
    return {
        name: lanes
        for name, lanes in found.items()
        if not any(_lies_on_others(network, network.lanes[x]) for x in lanes)
    }


def _lies_on_others(network: Network, lane: Lane) -> bool:
    """Whether a car at its start lies on another road."""
    if lane.length >= _CAR:
        return False
    back = np.arange(0.5, _CAR - lane.length, 0.5)
    ahead = np.array([np.cos(lane.heading[0]), np.sin(lane.heading[0])])
    body = lane.xyz[0, :2] - back[:, None] * ahead
    for other in network.drivable_lanes():
        if other.road == lane.road or abs(other.xyz[:, 2].mean() - lane.xyz[0, 2]) > CLEARANCE:
            continue
        s = np.linspace(0.0, other.length, 2 + int(other.length))
        away = np.linalg.norm(other.pose(s)[0][None, :, :2] - body[:, None], axis=-1)
        if away.min() < other.width_at(s[away.argmin() % len(s)]) / 2:
            return True
    return False


def leading(
    network: Network, ways: Mapping[str, Sequence[str]], reachable: Bool[np.ndarray, "L G"]
) -> list[str]:
    """Names of the ways in from which some goal can be reached; all of them if there is none.

    Args:
      network: the map.
      ways: as `origins`.
      reachable: goals by row of the lane map, as in its `routes`.
    """
    rows = lane_rows(network)
    return [x for x, lanes in ways.items() if reachable[[rows[y] for y in lanes]].any()] or list(ways)


def road_origins(network: Network, count: int) -> list[str]:
    """Names of roads that serve as origins on a map without `origins`.

    At most `count` of them, spread evenly over the map's list of roads. None is shorter than
    `LEAST_LENGTH`. Rings have none: what is on them stays there.
    """
    if any(isinstance(lanes, Round) for lanes in default_goals(network).values()):
        return []
    names = [
        name
        for name, lanes in road_starts(network).items()
        if all(lane.junction is None and lane.length > LEAST_LENGTH for lane in lanes)
    ]
    return names[:: -(-len(names) // count)] if names else []


def _drivable(network: Network, name: str) -> bool:
    return name in network.lanes and network.lanes[name].drivable


def road_starts(network: Network) -> dict[str, list[Lane]]:
    """The first lanes of every road and direction, by name."""
    sides: dict[tuple[str, int, bool], list[Lane]] = {}
    for lane in network.drivable_lanes():
        sides.setdefault((lane.road, lane.section, lane.number < 0), []).append(lane)
    ways = {(road, backward) for road, _, backward in sides}
    first: dict[str, list[Lane]] = {}
    for (road, _, backward), lanes in sides.items():
        both = (road, not backward) in ways
        name = road + (("-" if backward else "+") if both else "")
        comes_from = {
            network.lanes[x].road for lane in lanes for x in lane.predecessors if x in network.lanes
        }
        if road not in comes_from:
            first.setdefault(name, []).extend(lanes)
    return first
