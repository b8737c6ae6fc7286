"""SUMO in this process, and the owners of its vehicles.

libsumo holds one simulation per process: a second one replaces the first in silence. So `process.SumoProcess`
runs each in a process of its own. Facts about `moveToXY` and modes are measured with SUMO 1.28.
"""

from __future__ import annotations

import contextlib
import importlib
import math
from typing import Any

import numpy as np

from limsim_jax.bridges.sumo.messages import (
    GHOST,
    Body,
    Move,
    Newcomer,
    Orders,
    Reading,
    Start,
    Started,
    SumoError,
)

OLDEST = 20
"""TraCI version of SUMO 1.4, which first knew `getCollisions` and friends; older ones are refused."""

OUR_SPEED_MODE, SUMO_SPEED_MODE = 32, 31
"""Speed modes of vehicles of ours (nothing is checked) and of SUMO (its default)."""

OUR_LANE_CHANGE_MODE, SUMO_LANE_CHANGE_MODE = 0, 1621
"""Lane change modes of vehicles of ours (SUMO changes none of their lanes) and of SUMO (its default)."""

KEEP_EXACTLY = 2
"""`keepRoute` of `moveToXY`: the exact place counts, also beside the middle of the lane."""

MATCH_WITHIN = 5.0
"""m from a place within which SUMO looks for its lane. Its own 100 m take 5 to 50 times as long: up to 20 ms
for a vehicle on CARLA's Town05."""

NATIVE_NEAR = 50.0
"""m around a body on two lanes within which a vehicle of SUMO makes it worth a ghost."""

GHOST_WIDTH = 0.2
"""m; a ghost is a leader on its lane whatever its width, and touches nothing beside it."""

LOOK_AT_ROUTES = 1.0
"""s after which routes are read again: SUMO's rerouting devices change them."""

OPTIONS = (
    "--no-step-log", "--duration-log.disable", "--no-warnings",
    "--collision.action", "warn", "--collision.check-junctions", "--collision.mingap-factor", "0",
)  # fmt: skip
"""SUMO reports collisions and leaves vehicles where they are, so that both sides tell the same story."""


class Link:
    """A running simulation.

    Raises:
      SumoError: libsumo is missing or too old, or SUMO does not start.
    """

    def __init__(self, start: Start) -> None:
        self.sumo = _library(start.gui)
        binary = "sumo-gui" if start.gui else "sumo"
        seeded = ("--step-length", f"{start.dt:g}", "--seed", str(start.seed))
        more = ("--start", "--quit-on-end") if start.gui else ()
        self.sumo.start([binary, *start.arguments, *OPTIONS, *seeded, *more])
        number, self.version = self.sumo.getVersion()
        if number < OLDEST:
            self.close()
            raise SumoError(f"{self.version} is too old for the bridge; SUMO 1.20 or newer is expected")
        self.dt = start.dt
        self._steps = 0
        self._lanes = tuple(self.sumo.lane.getIDList())
        self._row = {name: k for k, name in enumerate(self._lanes)}
        self._lights = tuple(self.sumo.trafficlight.getIDList())
        self._programs: dict[str, str] = {}
        self._handles: dict[str, int] = {}
        self._next = 0
        self._owned: dict[int, str] = {}
        self._route_of: dict[int, tuple[str, Any]] = {}  # what tells whether a route is another one
        self._ghosts: dict[int, str] = {}
        self._natives: list[tuple[float, float]] = []
        self._known_at, self._names = -1, frozenset[str]()

    def started(self) -> Started:
        """What there is."""
        lengths = np.array([self.sumo.lane.getLength(x) for x in self._lanes])
        now = self.sumo.simulation.getTime()
        return Started(self.version, now, self._lanes, lengths, self._lights)

    def step(self, orders: Orders) -> Reading:
        """Do what is ordered, and one step of the simulation."""
        for handle in orders.take:
            self._take(handle)
        for handle in orders.release:
            self._release(handle)
        for handle in orders.remove:
            self._remove(handle)
        for body in orders.add:
            self._add(body)
        for name, state in orders.lights.items():
            self._light(name, state)
        for handle, move in orders.move.items():
            if handle in self._owned:
                self._move(handle, move)
        self.sumo.simulationStep()
        self._steps += 1
        # SUMO derives speeds from ways along its lanes, which may be declared longer than they are
        for handle, move in orders.move.items():
            name = self._owned.get(handle)
            if move.v is not None and name in self._there():
                self.sumo.vehicle.setPreviousSpeed(name, move.v, move.a)
        return self.read()

    # --- owners

    def _there(self) -> frozenset[str]:
        """Vehicles on the road now."""
        if self._known_at != self._steps:
            self._known_at, self._names = self._steps, frozenset(self.sumo.vehicle.getIDList())
        return self._names

    def _take(self, handle: int) -> None:
        name = self._name(handle)
        self._owned[handle] = name
        self.sumo.vehicle.setSpeedMode(name, OUR_SPEED_MODE)
        self.sumo.vehicle.setLaneChangeMode(name, OUR_LANE_CHANGE_MODE)

    def _release(self, handle: int) -> None:
        name = self._owned.pop(handle, None)
        self._without_ghost(handle)
        if name is None or name not in self.sumo.vehicle.getIDList():
            return
        self.sumo.vehicle.setSpeedMode(name, SUMO_SPEED_MODE)
        self.sumo.vehicle.setLaneChangeMode(name, SUMO_LANE_CHANGE_MODE)
        self.sumo.vehicle.setSpeed(name, -1)

    def _remove(self, handle: int) -> None:
        name = self._owned.pop(handle, None)
        self._without_ghost(handle)
        if name is not None and name in self.sumo.vehicle.getIDList():
            self.sumo.vehicle.remove(name)
        if name is not None:
            self._forget(name)

    def _add(self, body: Body) -> None:
        vehicle = self.sumo.vehicle
        self._insert(body.id, body.edge, f"limsim.{body.kind}.{body.length:.2f}.{body.width:.2f}", body)
        vehicle.setSpeedMode(body.id, OUR_SPEED_MODE)
        vehicle.setLaneChangeMode(body.id, OUR_LANE_CHANGE_MODE)
        self._handles[body.id] = body.handle
        self._owned[body.handle] = body.id

    def _insert(self, name: str, edge: str, kind: str, body: Body) -> None:
        """A new vehicle; `moveToXY` places it in the same step."""
        sumo = self.sumo
        if kind not in sumo.vehicletype.getIDList():
            sumo.vehicletype.copy("DEFAULT_VEHTYPE", kind)
            sumo.vehicletype.setVehicleClass(kind, body.kind)
            sumo.vehicletype.setLength(kind, body.length)
            sumo.vehicletype.setWidth(kind, body.width)
            sumo.vehicletype.setMinGap(kind, 0.0)
        route = f"limsim.{edge}"
        if route not in sumo.route.getIDList():
            sumo.route.add(route, [edge])
        sumo.vehicle.add(name, route, typeID=kind, depart="now", departLane="best", departPos="last")

    def _move(self, handle: int, move: Move) -> None:
        name, vehicle = self._owned[handle], self.sumo.vehicle
        if move.edges:
            self._reroute(name, move.edges)
        vehicle.moveToXY(name, "", -1, move.x, move.y, move.angle, KEEP_EXACTLY, MATCH_WITHIN)
        if move.ghost is None or not self._native_near(move.x, move.y):
            self._without_ghost(handle)
        else:
            self._with_ghost(handle, name, move.ghost)

    def _reroute(self, name: str, edges: tuple[str, ...]) -> None:
        """Give a vehicle our route, from its present edge on.

        Within a junction SUMO takes no new route; on the edge before it needs the right one. Close to the
        end of an edge SUMO may refuse one; it gets it again in the next step."""
        vehicle = self.sumo.vehicle
        here = vehicle.getRoadID(name)
        if here in edges:
            wanted = edges[edges.index(here) :]
            if tuple(vehicle.getRoute(name))[vehicle.getRouteIndex(name) :] != wanted:
                with contextlib.suppress(self.sumo.TraCIException):
                    vehicle.setRoute(name, list(wanted))

    # --- ghosts

    def _native_near(self, x: float, y: float) -> bool:
        return any(math.hypot(px - x, py - y) < NATIVE_NEAR for px, py in self._natives)

    def _with_ghost(self, handle: int, name: str, place: tuple[float, float, float]) -> None:
        ghost, vehicle = GHOST + name, self.sumo.vehicle
        if handle not in self._ghosts:
            edge = vehicle.getRoadID(name)
            if not edge or edge.startswith(":"):
                return
            length = vehicle.getLength(name)
            body = Body(0, ghost, vehicle.getVehicleClass(name), length, GHOST_WIDTH, edge)
            self._insert(ghost, edge, f"limsim.ghost.{body.kind}.{length:.2f}", body)
            vehicle.setSpeedMode(ghost, OUR_SPEED_MODE)
            vehicle.setLaneChangeMode(ghost, OUR_LANE_CHANGE_MODE)
            self._ghosts[handle] = ghost
        elif ghost not in vehicle.getIDList():  # SUMO has let it arrive: a new one comes in the next step
            self._ghosts.pop(handle)
            return
        vehicle.moveToXY(ghost, "", -1, *place, KEEP_EXACTLY, MATCH_WITHIN)

    def _without_ghost(self, handle: int) -> None:
        ghost = self._ghosts.pop(handle, None)
        if ghost is not None and ghost in self.sumo.vehicle.getIDList():
            self.sumo.vehicle.remove(ghost)

    # --- signals

    def _light(self, name: str, state: str | None) -> None:
        lights = self.sumo.trafficlight
        if state is not None:
            self._programs.setdefault(name, lights.getProgram(name))
            lights.setRedYellowGreenState(name, state)
        elif name in self._programs:
            lights.setProgram(name, self._programs.pop(name))

    # --- reading

    def read(self) -> Reading:
        """The simulation as it is now."""
        sumo, vehicle = self.sumo, self.sumo.vehicle
        arrived = set(sumo.simulation.getArrivedIDList())
        names = [x for x in vehicle.getIDList() if not x.startswith(GHOST)]
        there = set(names)
        gone = {h: x in arrived for x, h in self._handles.items() if x not in there}
        for name in [x for x in self._handles if x not in there]:
            self._forget(name)
        new = tuple(self._newcomer(x) for x in names if x not in self._handles)
        known = [self._handles[x] for x in names]
        place = np.array([vehicle.getPosition(x) for x in names]).reshape(-1, 2)
        on = [self._row.get(vehicle.getLaneID(x), -1) for x in names]
        columns = [
            np.array([get(x) for x in names], np.float64)
            for get in (vehicle.getLanePosition, vehicle.getAngle, vehicle.getSpeed, vehicle.getAcceleration)
        ]
        self._natives = [
            (x, y)
            for handle, lane, (x, y) in zip(known, on, place.tolist(), strict=True)
            if handle not in self._owned and lane >= 0
        ]
        return Reading(
            time=sumo.simulation.getTime(),
            handle=np.array(known, np.int32),
            lane=np.array(on, np.int32),
            s=columns[0], x=place[:, 0], y=place[:, 1], angle=columns[1], v=columns[2], a=columns[3],
            new=new,
            routes=self._routes(names),
            gone=gone,
            lights=tuple(sumo.trafficlight.getRedYellowGreenState(x) for x in self._lights),
            collisions=self._collisions(),
            pending=len(sumo.simulation.getPendingVehicles()),
            expected=sumo.simulation.getMinExpectedNumber(),
            owned=frozenset(handle for handle, name in self._owned.items() if name in there),
        )  # fmt: skip

    def _newcomer(self, name: str) -> Newcomer:
        get = self.sumo.vehicle
        handle = self._next
        self._next += 1
        self._handles[name] = handle
        edges = self._edges(name)
        self._route_of[handle] = self._mark(name)
        return Newcomer(
            handle, name, get.getVehicleClass(name), get.getLength(name), get.getWidth(name),
            get.getTau(name), get.getMinGap(name), get.getAccel(name), get.getDecel(name),
            get.getEmergencyDecel(name), get.getMaxSpeed(name), get.getSpeedFactor(name), edges,
        )  # fmt: skip

    def _edges(self, name: str) -> tuple[str, ...]:
        """Edges to go, up to the first that comes twice."""
        route = self.sumo.vehicle.getRoute(name)[max(self.sumo.vehicle.getRouteIndex(name), 0) :]
        for k, edge in enumerate(route):
            if edge in route[:k]:
                return tuple(route[:k])
        return tuple(route)

    def _mark(self, name: str) -> tuple[str, Any]:
        """Changes when the vehicle has another way to go."""
        route = self.sumo.vehicle.getRoute(name)
        twice = len(set(route)) < len(route)
        return self.sumo.vehicle.getRouteID(name), self.sumo.vehicle.getRouteIndex(name) if twice else None

    def _routes(self, names: list[str]) -> dict[int, tuple[str, ...]]:
        if self._steps % max(round(LOOK_AT_ROUTES / self.dt), 1):
            return {}
        found = {}
        for name in names:
            handle, mark = self._handles[name], self._mark(name)
            if handle not in self._owned and self._route_of.get(handle) != mark:
                self._route_of[handle] = mark
                found[handle] = self._edges(name)
        return found

    def _collisions(self) -> tuple[tuple[int, int], ...]:
        """Pairs that SUMO says collide now."""
        found = {}
        for one in self.sumo.simulation.getCollisions():
            pair = tuple(self._handles.get(x.removeprefix(GHOST)) for x in (one.collider, one.victim))
            if None not in pair and pair[0] != pair[1]:
                found[pair] = None
        return tuple(found)

    def _name(self, handle: int) -> str:
        for name, known in self._handles.items():
            if known == handle:
                return name
        raise SumoError(f"vehicle {handle} is not there")

    def _forget(self, name: str) -> None:
        handle = self._handles.pop(name, None)
        if handle is not None:
            self._owned.pop(handle, None)
            self._route_of.pop(handle, None)
            self._without_ghost(handle)

    def close(self) -> None:
        """End the simulation."""
        self.sumo.close()


def _library(gui: bool) -> Any:
    """libsumo, or TraCI for SUMO with its window."""
    name = "traci" if gui else "libsumo"
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise SumoError(f'SUMO needs {name}: pip install "limsim-jax[sumo]" ({error})') from None
