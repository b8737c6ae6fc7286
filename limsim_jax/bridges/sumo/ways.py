"""SUMO's routes as columns of the route table; its lights as phases."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from limsim_jax.bridges.sumo.messages import SumoError
from limsim_jax.maps.lane_map import VEHICLE_CLASSES, LaneMap, bucket, lane_rows
from limsim_jax.maps.network import MapError, Network
from limsim_jax.maps.route_table import RouteTable
from limsim_jax.maps.routing import build_fixed_routes, build_routes
from limsim_jax.maps.signal_table import SignalState

PHASES = 16
"""Phases of a light beyond those of its program that can be shown: actuated ones and states set by hand."""

LETTERS = {
    "r": SignalState.RED, "y": SignalState.YELLOW, "Y": SignalState.YELLOW, "g": SignalState.GREEN_MINOR,
    "G": SignalState.GREEN_MAJOR, "u": SignalState.RED_YELLOW, "s": SignalState.STOP,
    "o": SignalState.OFF_BLINKING, "O": SignalState.OFF,
}  # fmt: skip


class Ways:
    """Columns of the route table for the routes of vehicles.

    Column 0 leads nowhere: that of vehicles whose route cannot be driven on this map.

    Args:
      network: the map.
      lane_map: of that map.
      size: columns at the same time.
    """

    def __init__(self, network: Network, lane_map: LaneMap, size: int) -> None:
        self.network, self.rows = network, lane_rows(network)
        lanes = lane_map.length.shape[0]
        nowhere = build_routes(network, self.rows, [])
        self._table = nowhere.pad(lanes=lanes, goals=bucket(size))
        self._table = RouteTable(**{k: np.array(x) for k, x in vars(self._table).items()})
        self._known: dict[tuple[Any, tuple[str, ...]], int] = {}
        self._keys: dict[int, list[tuple[Any, tuple[str, ...]]]] = {}
        self._users: dict[int, int] = {}
        self._edges: dict[int, tuple[str, ...]] = {}
        self._free = list(range(self._table.distance.shape[1] - 1, 0, -1))
        self._idle: dict[int, None] = {}  # columns without a user, the one that is longest so first
        self.changed = True
        groups: dict[tuple[bool, ...], str] = {}
        drivable = list(network.drivable_lanes())
        self._like = {
            name: groups.setdefault(tuple(name in lane.access for lane in drivable), name)
            for name in VEHICLE_CLASSES
        }

    def take(self, edges: tuple[str, ...], vehicle_class: str) -> int:
        """Column of a route for one more user."""
        key = (self._like[vehicle_class], edges)
        if key not in self._known:
            self._known[key] = self._made(key, vehicle_class)
        column = self._known[key]
        if column:
            self._idle.pop(column, None)
            self._users[column] = self._users.get(column, 0) + 1
        return column

    def give_back(self, column: int) -> None:
        """One user less."""
        if column:
            self._users[column] -= 1
            if not self._users[column]:
                del self._users[column]
                self._idle[column] = None

    def edges(self, column: int) -> tuple[str, ...]:
        """The route of a column."""
        return self._edges.get(column, ())

    def reaches(self, lane: int, column: int) -> bool:
        """Whether a lane leads to the end of the route."""
        return bool(self._table.reachable[lane, column])

    def to_go(self, lane: int, column: int) -> float:
        """From the start of a lane to the route's end, m."""
        return float(self._table.distance[lane, column])

    def table(self) -> RouteTable:
        """All columns, on the device."""
        self.changed = False
        return jax.tree.map(jnp.asarray, self._table)

    def _made(self, key: tuple[Any, tuple[str, ...]], vehicle_class: str) -> int:
        """Find the way; 0 where there is none."""
        edges = key[1]
        for one_class in (vehicle_class, None):
            try:
                found = build_fixed_routes(self.network, self.rows, [edges], vehicle_class=one_class)
                break
            except MapError:
                continue
        else:
            try:
                ends = [lane.id for lane in self.network.road_lanes(edges[-1]) if lane.drivable]
                found = build_routes(self.network, self.rows, [ends])
            except (MapError, IndexError):
                return 0
        column = self._place()
        lanes = self._table.distance.shape[0]
        padded = found.pad(lanes=lanes, goals=1)
        for name, values in vars(self._table).items():
            values[:, column] = vars(padded)[name][:, 0]
        self._edges[column] = edges
        # the rest of a route is served by its column as well
        keys = [key, *((key[0], edges[i:]) for i in range(1, len(edges)))]
        self._keys[column] = [x for x in keys if x == key or x not in self._known]
        self._known |= dict.fromkeys(self._keys[column], column)
        self.changed = True
        return column

    def _place(self) -> int:
        """A free column, or the one that is idle for longest."""
        if self._free:
            return self._free.pop()
        if not self._idle:
            raise SumoError(
                f"more than {self._table.distance.shape[1] - 1} routes at the same time; "
                "fewer worlds per call (chunk) or fewer slots are needed"
            )
        column = next(iter(self._idle))
        del self._idle[column]
        for key in self._keys.pop(column):
            self._known.pop(key, None)
        return column


class Lights:
    """The phases of all lights: those of the programs, and others as SUMO shows them.

    Args:
      network: the map.
      lane_map: of that map.
      names: ids of SUMO's lights, in its order.
    """

    def __init__(self, network: Network, lane_map: LaneMap, names: Iterable[str]) -> None:
        table = jax.tree.map(np.array, lane_map.signals)
        programs = {program.id: k for k, program in enumerate(network.programs.values())}
        self.rows = [programs.get(name, -1) for name in names]
        self.names = list(names)
        count, phases, links = table.state.shape
        room = bucket(phases + PHASES)
        self._state = np.full((count, room, links), SignalState.OFF, np.int32)
        self._state[:, :phases] = table.state
        self._known: list[dict[str, int]] = [{} for _ in range(count)]
        for k, program in enumerate(network.programs.values()):
            for p, phase in enumerate(program.phases):
                self._known[k].setdefault(phase.state.replace("Y", "y"), p)
        self._used = [max(int(table.num_phases[k]), 1) for k in range(count)]
        self._table, self._room = table, room
        self.changed = True

    def phases(self, states: Iterable[str]) -> np.ndarray:
        """The phase of every program, `[G]`, from SUMO's states of all lights."""
        found = np.zeros(len(self._known), np.int32)
        for name, row, state in zip(self.names, self.rows, states, strict=True):
            if row >= 0:
                found[row] = self._phase(name, row, state.replace("Y", "y"))
        return found

    def _phase(self, name: str, row: int, state: str) -> int:
        known = self._known[row]
        if state not in known:
            if len(state) > self._state.shape[2]:
                raise SumoError(
                    f"light '{name}' shows {len(state)} links; the map has {self._state.shape[2]}"
                )
            if set(state) - set(LETTERS):
                raise SumoError(f"light '{name}' shows '{state}'; known letters are {''.join(LETTERS)}")
            if self._used[row] >= self._room:
                raise SumoError(f"light '{name}' shows more than {self._room} different phases")
            known[state] = self._used[row]
            self._state[row, known[state], : len(state)] = [LETTERS[x] for x in state]
            self._used[row] += 1
            self.changed = True
        return known[state]

    def put_on(self, lane_map: LaneMap) -> LaneMap:
        """The map with these phases, each 1 s long: see `program.with_lights`."""
        self.changed = False
        count, room = self._state.shape[:2]
        lit = np.zeros(count, bool)
        lit[[row for row in self.rows if row >= 0]] = True
        one = jnp.ones((count, room), jnp.float32)
        signals = replace(
            lane_map.signals,
            duration=one, min_duration=one, max_duration=one,
            next_phase=jnp.broadcast_to((jnp.arange(room, dtype=jnp.int32) + 1) % room, (count, room)),
            state=jnp.asarray(self._state),
            offset=jnp.zeros(count, jnp.float32),
            cycle=jnp.full(count, room, jnp.float32),
            num_phases=jnp.asarray(np.where(lit, room, 1).astype(np.int32)),
            actuated=jnp.zeros(count, bool),
        )  # fmt: skip
        return replace(lane_map, signals=signals)
