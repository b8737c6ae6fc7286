"""Which vehicle of SUMO is in which slot of a shared world."""

from __future__ import annotations

from dataclasses import fields
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from limsim_jax.bridges.sumo.messages import Newcomer, Reading, Started, SumoError
from limsim_jax.bridges.sumo.program import Seen
from limsim_jax.bridges.sumo.ways import Lights, Ways
from limsim_jax.maps.cut import pieces_of
from limsim_jax.maps.lane_map import NO_LANE, VEHICLE_CLASSES, LaneMap
from limsim_jax.maps.network import Network
from limsim_jax.maps.sumo.classes import ENGINE_CLASS
from limsim_jax.traffic.vehicles import BODY, PARAMETERS, uniform_population
from limsim_jax.types import Driver, Shape

SMALL = "motorcycle"
"""Class of bicycles, scooters and whatever else SUMO lets onto our lanes; bodies are those of SUMO."""

LENGTH_ERROR = 0.1
"""m by which lanes of SUMO and of the map may differ in length: files round."""


class Places:
    """SUMO's lanes as rows of the map; one may be several pieces (`maps.cut`).

    Args:
      network, lane_map: the map.
      there: what SUMO has.

    Raises:
      SumoError: SUMO runs another network.
    """

    def __init__(self, network: Network, lane_map: LaneMap, there: Started) -> None:
        rows = {lane.id: k for k, lane in enumerate(network.drivable_lanes())}
        pieces = [pieces_of(network.lanes, name) if name in network.lanes else [] for name in there.lanes]
        unknown = rows.keys() - {x for found in pieces for x in found}
        if unknown:
            name = min(unknown, key=rows.__getitem__)
            raise SumoError(f"SUMO has no lane '{name}' of {network.source}: it runs another network")
        shape = len(pieces) + 1, max(map(len, pieces), default=1)
        self._row = np.full(shape, NO_LANE, np.int32)  # [SUMO's lane or none, piece]
        self._begin = np.full(shape, np.inf)  # m along SUMO's lane
        self._begin[:, 0] = 0.0
        self._scale = np.ones(shape)  # our m per m of SUMO
        for k, (name, length, found) in enumerate(zip(there.lanes, there.lengths, pieces, strict=True)):
            lanes = [network.lanes[x] for x in found]
            ends = np.cumsum([x.length if x.declared_length is None else x.declared_length for x in lanes])
            if any(x in rows for x in found) and abs(ends[-1] - length) > LENGTH_ERROR:
                raise SumoError(
                    f"lane '{name}' is {length:.2f} m long in SUMO and {ends[-1]:.2f} m in "
                    f"{network.source}: SUMO runs another network"
                )
            begins = np.concatenate([[0.0], ends[:-1]])
            self._begin[k, : len(lanes)] = begins
            self._row[k, : len(lanes)] = [rows.get(x, NO_LANE) for x in found]
            known = np.maximum(np.diff([*begins, length]), 1e-3)
            self._scale[k, : len(lanes)] = [x.length for x in lanes] / known
        self.origin = np.asarray(lane_map.origin, np.float64)

    def on(self, lane: NDArray[Any], s: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Rows of the map and m along them, from SUMO's lanes (-1: none) and m along those; `[n]` each."""
        piece = np.sum(self._begin[lane] <= s[:, None], -1) - 1
        return self._row[lane, piece], (s - self._begin[lane, piece]) * self._scale[lane, piece]


class Seats:
    """The slots of one world, and the vehicles in them.

    Args:
      places: of SUMO's lanes.
      ways: columns for routes; shared by all worlds of a call.
      lights: phases of lights; shared as well.
      slots: N.
      everyone: we drive all vehicles with a seat.
    """

    def __init__(
        self, places: Places, ways: Ways, lights: Lights, slots: int, *, everyone: bool = False
    ) -> None:
        self.everyone = everyone
        self.places, self.ways, self.lights, self.slots = places, ways, lights, slots
        self.known: dict[int, Newcomer] = {}
        self.egos: tuple[int, ...] = ()
        self.slot: dict[int, int] = {}
        self.column: dict[int, int] = {}
        self.lost = 0  # most vehicles without a slot at a time
        self.elsewhere = 0  # most vehicles on lanes that the map has not
        self.pathless = 0  # vehicles whose route cannot be driven on the map
        self._count = 0
        self._busy = np.full(slots, -1, np.int64)  # handle in the slot
        zero = np.zeros(slots, np.float32)
        self._driver: dict[str, Any] = {f.name: zero.copy() for f in fields(Driver)}
        self._shape: dict[str, Any] = {f.name: zero.copy() for f in fields(Shape)}
        self._shape["vehicle_class"] = np.zeros(slots, np.int32)
        for k in range(slots):
            self._fit(k, typical())
        self._number = np.full(slots, -1, np.int32)
        self._goal = np.zeros(slots, np.int32)

    def meet(self, reading: Reading) -> None:
        """Take note of newcomers, and forget vehicles that have gone."""
        for one in reading.new:
            self.known[one.handle] = one
        for handle in reading.gone:
            self.known.pop(handle, None)

    def start(self, reading: Reading, egos: tuple[int, ...]) -> Seen:
        """The first moment, with these vehicles as egos."""
        self.egos = egos
        for k, handle in enumerate(egos):
            self._sit(handle, k)
            self._number[k] = -1
        return self.see(reading)

    def see(self, reading: Reading, *, alive: bool = True) -> Seen:
        """A moment as arrays: seats are given and given back."""
        arrived, fresh = (np.zeros(self.slots, bool) for _ in range(2))
        row, s = self.places.on(reading.lane, reading.s)
        kept = reading.owned & self.slot.keys()  # ours keep their seat wherever SUMO sees them
        on = {h: k for k, h in enumerate(reading.handle.tolist()) if row[k] >= 0 or h in kept}
        self.elsewhere = max(self.elsewhere, int(np.sum((row < 0) & (reading.lane >= 0))))
        others = [h for h in on if h not in self.egos]
        room = self.slots - len(self.egos)
        if len(others) > room:
            others = self._nearest(reading, on, others, room)
        wanted = set(others)
        taken = self._busy >= 0
        for handle in [h for h in self.slot if h not in wanted and h not in self.egos]:
            arrived[self.slot[handle]] = reading.gone.get(handle, False)
            self._leave(handle)
        free = [k for k in range(len(self.egos), self.slots) if not taken[k]]
        for handle in others:
            if handle not in self.slot and free:
                slot = free.pop(0)
                self._sit(handle, slot)
                self._number[slot] = self._count
                self._count += 1
                fresh[slot] = True
        lost = len(on) - sum(h in on for h in self.slot)
        self.lost = max(self.lost, lost)
        for handle, edges in reading.routes.items():
            if handle in self.slot and handle not in self.egos:
                self._follow(handle, edges)
        return self._arrays(reading, on, row, s, arrived, fresh, lost, alive)

    def _arrays(
        self, reading: Reading, on: dict[int, int], row: np.ndarray, s: np.ndarray, arrived: np.ndarray,
        fresh: np.ndarray, lost: int, alive: bool,
    ) -> Seen:  # fmt: skip
        pairs = [(slot, on[h]) for h, slot in self.slot.items() if h in on]
        slot, k = np.array(pairs, int).reshape(-1, 2).T
        x0, y0 = self.places.origin
        columns = {
            "lane": (row, np.int32, NO_LANE),
            "s": (s, np.float32, 0),
            "x": (reading.x - x0, np.float32, 0),
            "y": (reading.y - y0, np.float32, 0),
            "heading": (heading_of(reading.angle), np.float32, 0),
            "v": (reading.v, np.float32, 0),
            "a": (reading.a, np.float32, 0),
        }
        found: dict[str, Any] = {}
        for name, (values, kind, empty) in columns.items():
            found[name] = np.full(self.slots, empty, kind)
            found[name][slot] = values[k]
        present = np.zeros(self.slots, bool)
        present[slot] = True
        there = set(reading.handle.tolist())
        driver: dict[str, Any] = {name: x.copy() for name, x in self._driver.items()}
        shape: dict[str, Any] = {name: x.copy() for name, x in self._shape.items()}
        found |= {
            "present": present,
            "fresh": fresh,
            "arrived": arrived,
            "number": self._number.copy(),
            "goal": self._goal.copy(),
            "driver": Driver(**driver),
            "shape": Shape(**shape),
            "phase": self.lights.phases(reading.lights),
            "lost": np.int32(lost),
            "ended": np.array([h not in there for h in self.egos], bool),
            "alive": np.bool_(alive),
            "everyone": np.bool_(self.everyone),
        }
        return Seen(**found)

    def _nearest(self, reading: Reading, on: dict[int, int], others: list[int], room: int) -> list[int]:
        """Those that are nearest to an ego."""
        eyes = [k for k, h in enumerate(reading.handle.tolist()) if h in self.egos]
        rows = [on[h] for h in others]
        place = np.stack([reading.x, reading.y], -1)
        if not eyes:
            return sorted(others, key=lambda h: h not in self.slot)[:room]
        away = np.min(np.sum((place[rows][:, None] - place[eyes][None]) ** 2, -1), 1)
        return [others[i] for i in np.argsort(away, kind="stable")[:room]]

    def _sit(self, handle: int, slot: int) -> None:
        one = self.known[handle]
        self.slot[handle] = slot
        self._busy[slot] = handle
        self._fit(slot, one)
        self._follow(handle, one.edges)

    def _leave(self, handle: int) -> None:
        slot = self.slot.pop(handle)
        self._busy[slot] = -1
        self.ways.give_back(self.column.pop(handle))

    def _follow(self, handle: int, edges: tuple[str, ...]) -> None:
        """Give a vehicle the column of its route."""
        if handle in self.column:
            self.ways.give_back(self.column[handle])
        self.known[handle] = self.known[handle]._replace(edges=edges)
        column = self.ways.take(edges, class_of(self.known[handle]))
        self.pathless += column == 0
        self.column[handle] = column
        self._goal[self.slot[handle]] = column

    def _fit(self, slot: int, one: Newcomer) -> None:
        """Write the driver and the body of a vehicle."""
        for name, value in driver_of(one).items():
            self._driver[name][slot] = value
        for name, value in shape_of(one).items():
            self._shape[name][slot] = value

    def close(self) -> None:
        """Give all columns back."""
        for handle in list(self.slot):
            self._leave(handle)


def typical() -> Newcomer:
    """SUMO's default vehicle: for empty slots."""
    return Newcomer(-1, "", "passenger", 5.0, 1.8, 1.0, 2.5, 2.6, 4.5, 9.0, 55.55, 1.0, ())


def class_of(one: Newcomer) -> str:
    """Our class of a vehicle."""
    return ENGINE_CLASS.get(one.kind, SMALL)


@cache
def _medians(vehicle_class: str) -> dict[str, float]:
    """What SUMO does not say of a driver: the medians of the class."""
    population = uniform_population(vehicle_class)
    return {name: float(population.median[0, k]) for k, name in enumerate(PARAMETERS)}


def driver_of(one: Newcomer) -> dict[str, float]:
    """Parameters of SUMO's driver under our names; others are the medians of the class."""
    medians = {name: x for name, x in _medians(class_of(one)).items() if name not in BODY}
    return medians | {
        "speed_factor": one.speed_factor, "v_max": one.max_speed, "T": one.tau, "s0": one.min_gap,
        "a": one.accel, "b": one.decel, "b_max": max(one.emergency_decel, one.decel),
    }  # fmt: skip


def shape_of(one: Newcomer) -> dict[str, float]:
    """The body of a vehicle; its wheelbase scales with its length."""
    medians = _medians(class_of(one))
    return {
        "length": one.length, "width": one.width,
        "wheelbase": one.length * medians["wheelbase"] / medians["length"],
        "vehicle_class": VEHICLE_CLASSES.index(class_of(one)),
    }  # fmt: skip


def heading_of(angle: Any) -> Any:
    """SUMO's angle (degrees clockwise from north) as a heading (rad)."""
    heading = np.radians(90.0 - np.asarray(angle, np.float64))
    return np.arctan2(np.sin(heading), np.cos(heading))


def angle_of(heading: Any) -> Any:
    """The inverse of `heading_of`, within 0 and 360."""
    return np.mod(90.0 - np.degrees(np.asarray(heading, np.float64)), 360.0)
