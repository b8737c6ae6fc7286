"""CommonRoad scenarios, XML 2020a: lanelets, recorded vehicles and a planning problem per ego."""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Iterable
from xml.sax.saxutils import quoteattr

import numpy as np

from limsim_jax import __version__
from limsim_jax.bridges.formats.motion import Body, Motion
from limsim_jax.maps.network import Lane, LaneType, Network
from limsim_jax.maps.outline import outline

_TYPES = {
    "car": "car", "van": "car", "truck": "truck", "bus": "bus", "motorcycle": "motorcycle",
    "emergency": "priorityVehicle",
}  # fmt: skip
_ROADS = {"town": "urban", "rural": "country", "motorway": "highway", "lowSpeed": "urban"}
_LANES = {
    LaneType.BUS: "busLane",
    LaneType.ENTRY: "accessRamp",
    LaneType.ON_RAMP: "accessRamp",
    LaneType.EXIT: "exitRamp",
    LaneType.OFF_RAMP: "exitRamp",
}
_SPEED_SIGN = "274"  # of Germany and of CommonRoad's own country ZAM
_NARROW = 0.05  # m, least width of a lanelet: where a lane begins it may have none


def commonroad(motion: Motion) -> str:
    """A scenario as commonroad-io reads it.

    Every lane for motor traffic is a lanelet with its neighbours, successors and speed limit, every vehicle a
    dynamic obstacle. The ids of the egos are the lowest of the obstacles. A planning problem asks to go from
    the first place of an ego to the lanelet of its last. Step 0 is the first moment of the recording.
    Traffic lights and junction areas are left out.

    Args:
      motion: of the world.
    """
    network = motion.network
    lanes = {lane.id: k for k, lane in enumerate(network.drivable_lanes(), 1)}
    limits = sorted({network.lanes[lane].speed_limit for lane in lanes})
    signs = {limit: len(lanes) + k for k, limit in enumerate(limits, 1)}
    bodies = [body for body in motion.bodies if len(body.x) > 1]
    first = len(lanes) + len(signs) + 1
    problem = first + len(bodies)
    name = re.sub(r"[^A-Za-z0-9]", "", motion.scenario) or "World"
    head = {
        "commonRoadVersion": "2020a", "benchmarkID": f"ZAM_{name}-1_{motion.seed + 1}_T-1",
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(), "author": "limsim_jax",
        "affiliation": "", "source": f"limsim_jax {__version__}: {motion.title}",
        "timeStepSize": f"{motion.step:g}",
    }  # fmt: skip
    attributes = " ".join(f"{key}={quoteattr(value)}" for key, value in head.items())
    parts = [
        f'<?xml version="1.0" encoding="UTF-8"?>\n<commonRoad {attributes}>\n',
        "<location><geoNameId>-999</geoNameId><gpsLatitude>999</gpsLatitude>"
        "<gpsLongitude>999</gpsLongitude></location>\n<scenarioTags><simulated/></scenarioTags>\n",
        *(_lanelet(network, network.lanes[lane], lanes, signs) for lane in lanes),
        *(_sign(limit, number, network, lanes) for limit, number in signs.items()),
        *(_obstacle(body, first + k) for k, body in enumerate(bodies)),
        *(_problem(body, problem + k, lanes) for k, body in enumerate(bodies) if body.ego),
    ]
    return "".join([*parts, "</commonRoad>\n"])


def _lanelet(network: Network, lane: Lane, lanes: dict[str, int], signs: dict[float, int]) -> str:
    shape = outline(lane)
    half = np.maximum(lane.width_at(shape.s), _NARROW)[:, None] / 2
    across = half * np.stack([-np.sin(shape.heading), np.cos(shape.heading)], -1)
    keep = np.append(True, np.diff(shape.s) > 1e-6)
    parts = [f'<lanelet id="{lanes[lane.id]}">\n']
    for side, border in (("left", shape.centre + across), ("right", shape.centre - across)):
        points = "".join(f"<point><x>{x:.4f}</x><y>{y:.4f}</y></point>" for x, y in border[keep].tolist())
        parts.append(f"<{side}Bound>{points}</{side}Bound>\n")
    for tag, links in (("predecessor", lane.predecessors), ("successor", lane.successors)):
        parts += [f'<{tag} ref="{lanes[link]}"/>\n' for link in links if link in lanes]
    left_hand = lane.road in network.roads and network.roads[lane.road].left_hand
    beside = {"Left": (lane.left, "same"), "Right": (lane.right, "same")}
    outer = "Right" if left_hand else "Left"
    if beside[outer][0] is None:
        beside[outer] = (lane.opposite, "opposite")
    for side, (other, direction) in beside.items():
        if other in lanes:
            parts.append(f'<adjacent{side} ref="{lanes[other]}" drivingDir="{direction}"/>\n')
    parts += [
        f"<laneletType>{_kind(network, lane)}</laneletType>\n",
        f'<trafficSignRef ref="{signs[lane.speed_limit]}"/>\n</lanelet>\n',
    ]
    return "".join(parts)


def _kind(network: Network, lane: Lane) -> str:
    if lane.junction is not None:
        return "intersection"
    road = network.roads[lane.road].type if lane.road in network.roads else ""
    return _LANES.get(lane.type) or _ROADS.get(road, "unknown")


def _sign(limit: float, number: int, network: Network, lanes: dict[str, int]) -> str:
    """A virtual sign at the first of the lanes with this limit."""
    lane = next(network.lanes[lane] for lane in lanes if network.lanes[lane].speed_limit == limit)
    x, y = lane.xyz[0, :2].tolist()
    return (
        f'<trafficSign id="{number}"><trafficSignElement><trafficSignID>{_SPEED_SIGN}</trafficSignID>'
        f"<additionalValue>{limit:.4f}</additionalValue></trafficSignElement><position><point>"
        f"<x>{x:.4f}</x><y>{y:.4f}</y></point></position><virtual>true</virtual></trafficSign>\n"
    )


def _obstacle(body: Body, number: int) -> str:
    states = list(_states(body))
    return "".join(
        [
            f"<!-- {body.name} -->\n"
            f'<dynamicObstacle id="{number}">\n<type>{_TYPES[body.vehicle_class]}</type>\n',
            f"<shape><rectangle><length>{body.length:.4f}</length><width>{body.width:.4f}</width></rectangle>"
            f"</shape>\n<initialState>{states[0]}</initialState>\n<trajectory>\n",
            *(f"<state>{state}</state>\n" for state in states[1:]),
            "</trajectory>\n</dynamicObstacle>\n",
        ]
    )


def _states(body: Body) -> Iterable[str]:
    heading = (body.heading + math.pi) % (2 * math.pi) - math.pi
    columns = np.stack([body.x, body.y, heading, body.speed, body.acceleration], -1)
    for k, (x, y, h, v, a) in enumerate(columns.tolist()):
        yield (
            f"<position><point><x>{x:.4f}</x><y>{y:.4f}</y></point></position>"
            f"<orientation><exact>{h:.6f}</exact></orientation><time><exact>{body.first + k}</exact></time>"
            f"<velocity><exact>{v:.4f}</exact></velocity><acceleration><exact>{a:.4f}</exact></acceleration>"
        )


def _problem(body: Body, number: int, lanes: dict[str, int]) -> str:
    start = next(iter(_states(body)))
    on_road = [lane for lane in body.lane if lane in lanes]
    place = f'<position><lanelet ref="{lanes[on_road[-1]]}"/></position>' if on_road else ""
    return (
        f'<planningProblem id="{number}">\n<initialState>{start}<yawRate><exact>0.0</exact></yawRate>'
        "<slipAngle><exact>0.0</exact></slipAngle></initialState>\n<goalState><time><intervalStart>"
        f"{body.first + 1}</intervalStart><intervalEnd>{body.last}</intervalEnd></time>{place}</goalState>\n"
        "</planningProblem>\n"
    )


__all__ = ["commonroad"]
