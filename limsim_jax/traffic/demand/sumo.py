"""SUMO's vehicles, trips and flows as a schedule: time, place, speed and route."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key
from numpy.typing import NDArray

from limsim_jax.maps.lane_map import NO_LANE, VEHICLE_CLASSES, LaneMap, bucket, lane_rows
from limsim_jax.maps.network import Lane, MapError, Network
from limsim_jax.maps.route_table import RouteTable
from limsim_jax.maps.routing import build_fixed_routes, build_routes
from limsim_jax.maps.signal_table import SignalTable
from limsim_jax.maps.sumo.records import Demand, Distribution, Flow, Vehicle, VehicleType
from limsim_jax.traffic.demand.arrays import LEAST_ORIGINS, LEAST_ROWS, NEVER
from limsim_jax.traffic.demand.sample import departure_place, entry_speed, typical_vehicles
from limsim_jax.traffic.state import start_state
from limsim_jax.traffic.vehicles import Population, from_vtypes, sample_vehicles
from limsim_jax.types import Queues, Scenario, Schedule

FEW = 8.0
"""Standard deviations by which a random flow may exceed its mean before its last vehicles have no room."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SumoScenario:
    """A SUMO demand as a scenario: an empty road, and a schedule of departures."""

    lane_map: LaneMap
    """With the routes of these vehicles as `routes`; its signal programs start where they are at `begin`."""
    scenario: Scenario
    vehicles: tuple[str, ...]
    """Ids of the vehicles in the rows of the schedule; those of a flow have its id and a number."""
    routes: tuple[tuple[str, ...], ...]
    """Edges of every goal; only the last one where the way there is free."""
    notes: tuple[str, ...]
    """One line, with counts, per thing that is left out or done in another way than in SUMO."""


def sumo_scenario(
    network: Network,
    lane_map: LaneMap,
    demand: Demand,
    *,
    slots: int,
    begin: float | None = None,
    end: float | None = None,
    seed: int = 0,
) -> SumoScenario:
    """Turn SUMO's demand into a scenario.

    Vehicles follow the edges of their routes on lanes that their class may use; trips find their way by
    `maps.routing`. What SUMO leaves to chance (flows, distributions, drivers) is drawn here from `seed`.
    There is one queue per departure lane.

    Args:
      network: the map.
      lane_map: of that map; its routes are replaced, and the offsets of its signal programs moved.
      demand: from `maps.sumo.read_demand`.
      slots: vehicle slots of the world.
      begin: time of the files at which the scenario starts, s; default: that of the first departure.
      end: s; no vehicle departs from then on.
      seed: of all draws.

    Raises:
      MapError: a vehicle type that no file defines, or a flow without an end.
      ValueError: no vehicle departs.
    """
    notes = _Notes()
    if begin is None:
        departures = _departures(demand, end, np.random.default_rng([seed, 0]), _Notes())
        begin = math.floor(min((d.time for d in departures), default=0.0))
    ways = _Ways(network, lane_map)
    placed = _drawn(network, ways, demand, begin, end, [seed], notes)
    if not placed:
        raise ValueError("the demand has no vehicle that departs: " + "; ".join(notes.lines()))
    placed.sort(key=lambda d: (d.row, d.time))
    lane_map = replace(lane_map, routes=ways.table(), signals=_signals_from(lane_map, begin))
    types = list(dict.fromkeys(d.type for d in placed))
    lanes = sorted({d.row for d in placed})
    rows = jax.tree.map(jnp.asarray, _rows(placed, lanes, types, begin, bucket(len(placed), LEAST_ROWS)))
    population = from_vtypes([demand.types[name] for name in types])
    schedule = jax.jit(_schedule)(lane_map, population, rows, jax.random.key(seed))
    zero = jnp.zeros(slots, jnp.float32)
    nowhere, nothing = jnp.full(slots, NO_LANE), jnp.zeros(slots, jnp.int32)
    vehicles = typical_vehicles(population, slots)
    state = start_state(lane_map, *vehicles, lane=nowhere, s=zero, v=zero, goal=nothing)
    return SumoScenario(
        lane_map=lane_map,
        scenario=with_schedule(Scenario(start=state, schedule=schedule), schedule),
        vehicles=tuple(d.id for d in placed),
        routes=tuple(ways.routes),
        notes=tuple(notes.lines()),
    )


def with_schedule(world: Scenario, schedule: Schedule) -> Scenario:
    """The world with other departures than it has; its script stays."""
    queues = Queues(next=schedule.start[:-1], full=jnp.int32(0))
    schedule = replace(schedule, script=world.schedule.script)
    return Scenario(start=replace(world.start, queues=queues), schedule=schedule)


def _signals_from(lane_map: LaneMap, begin: float) -> SignalTable:
    """Signal programs, as they are when a scenario begins at this time."""
    signals = lane_map.signals
    return replace(signals, offset=jnp.mod(signals.offset - begin, signals.cycle))


class SumoDemand:
    """SUMO's demand on a map, from which worlds are drawn: what it leaves to chance differs by key.

    Args:
      network: the map.
      lane_map: of that map. Its goals stay the first ones; the routes of the demand follow.
      demand: from `maps.sumo.read_demand`.
      seconds: for how long vehicles depart.
      begin: time of the files at which worlds start, s; default: that of the first departure.

    Raises:
      MapError: a vehicle type that no file defines.
      ValueError: no vehicle departs.
    """

    lane_map: LaneMap
    """With the goals of the map and the routes of the demand as `routes`; signal programs start where they
    are at `begin`."""
    notes: tuple[str, ...]
    """One line, with counts, per thing that is left out or done in another way than in SUMO."""

    def __init__(
        self,
        network: Network,
        lane_map: LaneMap,
        demand: Demand,
        *,
        seconds: float,
        begin: float | None = None,
    ) -> None:
        timed = [v.depart for v in demand.vehicles.values() if not isinstance(v.depart, str)]
        first = min([*timed, *(flow.begin for flow in demand.flows.values())], default=0.0)
        self.begin = math.floor(first) if begin is None else begin
        self._end, self._network, self._demand = self.begin + seconds, network, demand
        self._ways = _Ways(network, lane_map)
        self._types = self._every_way()
        self.random = _leaves_to_chance(demand)
        """Whether departures, types, routes or places are drawn; drivers always are."""
        departures = self._draw([0], notes := _Notes())
        if not self._ways.columns or not (departures or self.random):
            why = "; ".join(notes.lines()) or f"from {self.begin:g} to {self._end:g} s none is due"
            raise ValueError(f"the demand has no vehicle that departs: {why}")
        self.notes = tuple(notes.lines())
        edges = {network.lanes[lane].road for lane in self._ways.starts}
        self._lanes = sorted(
            self._ways.rows[x.id] for edge in edges for x in network.road_lanes(edge) if x.drivable
        )
        self._size = bucket(self._most(len(departures)), LEAST_ROWS)
        self._population = from_vtypes([demand.types[name] for name in self._types])
        self._first_goal = lane_map.routes.distance.shape[1]
        routes = self._ways.table(lane_map.routes)
        self.lane_map = replace(lane_map, routes=routes, signals=_signals_from(lane_map, self.begin))
        self._fixed = self._as_rows(departures)

    @property
    def tables(self) -> tuple[Any, Population]:
        """What worlds are made of where only drivers are drawn."""
        return self._fixed, self._population

    def at_once(self) -> int:
        """Vehicles on the road at once, at half the limits."""
        rows, distance = self._fixed, np.asarray(self.lane_map.routes.distance)
        come = rows.lane != NO_LANE
        lane, goal, time = rows.lane[come], rows.goal[come], rows.time[come]
        limit = np.median([x.speed_limit for x in self._network.drivable_lanes()])
        leave = time + distance[lane, goal] / (0.5 * limit)
        order = np.argsort([*time, *leave], kind="stable")
        return int(np.max(np.cumsum(np.where(order < len(time), 1, -1)), initial=0))

    def schedule(self, key: Key[Array, ""]) -> Schedule:
        """The departures of a world."""
        rows = self._fixed
        if self.random:
            shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), rows)
            rows = jax.pure_callback(self._of_key, shapes, jax.random.key_data(key), vmap_method="sequential")
        return _schedule(self.lane_map, self._population, jax.tree.map(jnp.asarray, rows), key)

    def _of_key(self, words: Array) -> _Rows:
        return self._as_rows(self._draw(np.asarray(words).tolist(), _Notes()))

    def _as_rows(self, departures: list[_Departure]) -> _Rows:
        rows = _rows(departures, self._lanes, self._types, self.begin, self._size)
        return rows._replace(
            goal=np.where(rows.lane != NO_LANE, rows.goal + self._first_goal, 0).astype(np.int32)
        )

    def _draw(self, seed: list[int], notes: _Notes) -> list[_Departure]:
        """What departs in one world, placed."""
        return _drawn(self._network, self._ways, self._demand, self.begin, self._end, seed, notes)

    def _every_way(self) -> list[str]:
        """Find the ways of all types on all routes; return the types."""
        demand, rng = self._demand, np.random.default_rng(0)
        ways: dict[tuple[str, tuple[str, ...], bool], Vehicle] = {}
        for vehicle in [*demand.vehicles.values(), *(flow.vehicle for flow in demand.flows.values())]:
            types = _members(demand.type_distributions, vehicle.type)
            for route in _members(demand.route_distributions, vehicle.route):
                edges = _edges(demand, replace(vehicle, route=route), rng)
                for name in types if edges else []:
                    ways.setdefault((name, edges, route is None), vehicle)
        found: dict[str, None] = {}
        for (name, edges, _), vehicle in sorted(ways.items(), key=lambda way: -len(way[0][1])):
            kind = demand.types.get(name)
            if kind is not None and kind.engine_class is not None:  # otherwise it is said where it is drawn
                found[name] = None
                one = _Departure(id=vehicle.id, number=0, time=0, vehicle=vehicle, type=name)
                _way(self._network, self._ways, one, edges, kind, {}, rng, _Notes())
        return list(found)

    def _most(self, drawn: int) -> int:
        """Vehicles that depart in any world, at most."""
        most = drawn
        for flow in self._demand.flows.values():
            rate = flow.probability or flow.poisson_rate
            if rate:
                until = min(self._end, math.inf if flow.end is None else flow.end)
                mean = rate * max(until - max(flow.begin, self.begin), 0)
                bound = mean + FEW * math.sqrt(mean) + FEW
                most += math.ceil(min(bound, math.inf if flow.number is None else flow.number))
        return most


def _leaves_to_chance(demand: Demand) -> bool:
    """Whether anything but the drivers differs from world to world."""
    flows = demand.flows.values()
    vehicles = [*demand.vehicles.values(), *(flow.vehicle for flow in flows)]
    return any(flow.probability or flow.poisson_rate for flow in flows) or any(
        "random" in (x.depart_lane, x.depart_pos, x.depart_speed)
        or x.type in demand.type_distributions
        or x.route in demand.route_distributions
        for x in vehicles
    )


def _members(distributions: Mapping[str, Distribution], name: Any) -> list[Any]:
    """What a name may stand for: itself, or the members of a distribution, and theirs."""
    if name not in distributions:
        return [name]
    return [x for member in distributions[name].members for x in _members(distributions, member)]


@dataclass
class _Notes:
    """Messages, and the ids that they concern."""

    found: dict[str, list[str]] = field(default_factory=dict)

    def add(self, message: str, ids: Sequence[str]) -> None:
        if ids:
            self.found.setdefault(message, []).extend(ids)

    def lines(self) -> list[str]:
        return [f"{len(ids)} x {message} ('{ids[0]}' first)" for message, ids in self.found.items()]


@dataclass(frozen=True, kw_only=True)
class _Departure:
    """One vehicle."""

    id: str
    number: int  # in the order of the files
    time: float  # s
    vehicle: Vehicle
    type: str = ""
    row: int = NO_LANE
    s: float | None = None  # m; None: where the lane starts
    v: float = math.inf  # m/s, wanted
    goal: int = -1


def _drawn(
    network: Network,
    ways: _Ways,
    demand: Demand,
    begin: float,
    end: float | None,
    seed: Sequence[int],
    notes: _Notes,
) -> list[_Departure]:
    """What departs from `begin` to `end`: type, lane, place, speed and goal."""
    departures = _departures(demand, end, np.random.default_rng([*seed, 0]), notes)
    early = [d for d in departures if d.time < begin]
    notes.add("departs before the scenario begins; left out", [d.id for d in early])
    departures = [d for d in departures if d.time >= begin]
    departures = _with_types(demand, departures, np.random.default_rng([*seed, 1]), notes)
    return _place(network, ways, demand, departures, np.random.default_rng([*seed, 2]), notes)


def _departures(
    demand: Demand, end: float | None, rng: np.random.Generator, notes: _Notes
) -> list[_Departure]:
    """All departures before `end`, in the order of the files."""
    found: list[tuple[str, float, Vehicle]] = []
    for vehicle in demand.vehicles.values():
        if isinstance(vehicle.depart, str):
            notes.add(f"departs '{vehicle.depart}', not at a time; left out", [vehicle.id])
        else:
            found.append((vehicle.id, vehicle.depart, vehicle))
    for flow in demand.flows.values():
        times = _flow_times(flow, end, rng)
        found += [(f"{flow.vehicle.id}.{i}", float(time), flow.vehicle) for i, time in enumerate(times)]
    late = [name for name, time, _ in found if end is not None and time >= end]
    notes.add("departs after the scenario ends; left out", late)
    return [
        _Departure(id=name, number=number, time=time, vehicle=vehicle)
        for number, (name, time, vehicle) in enumerate(found)
        if end is None or time < end
    ]


def _flow_times(flow: Flow, end: float | None, rng: np.random.Generator) -> list[float]:
    """Departure times of a flow before `end`, s."""
    rates = (flow.probability, flow.poisson_rate, flow.vehicles_per_hour)
    if 0 in (*rates, flow.number):
        return []
    until = end if flow.end is None else flow.end
    period = 3600 / flow.vehicles_per_hour if flow.vehicles_per_hour is not None else flow.period
    evenly = period is None and rates == (None, None, None)
    if flow.number is not None and evenly and until is not None:
        period = (until - flow.begin) / flow.number
    if (until is None and (flow.number is None or evenly)) or (flow.number is None and period == 0):
        raise MapError(
            "it emits vehicles without end; give it an end, or the scenario",
            file=flow.vehicle.file or None,
            line=flow.vehicle.line,
            element=f"flow {flow.vehicle.id}",
        )

    def gap() -> float:
        if flow.probability is not None:
            return float(rng.geometric(flow.probability))
        return period if period is not None else rng.exponential(1 / (flow.poisson_rate or 1.0))

    times: list[float] = []
    # a chance in the first second, too; at regular times the first vehicle comes at once
    time = flow.begin + (gap() - 1 if flow.probability is not None else 0.0 if period is not None else gap())
    last = min((t for t in (flow.end, end) if t is not None), default=math.inf)
    while time < last and len(times) < (math.inf if flow.number is None else flow.number):
        times.append(time)
        time += gap()
    return times


def _with_types(
    demand: Demand, departures: list[_Departure], rng: np.random.Generator, notes: _Notes
) -> list[_Departure]:
    """The departures of motor vehicles, with their types; distributions are drawn."""
    kept = []
    for departure in departures:
        name = departure.vehicle.type
        while name in demand.type_distributions:
            choices = demand.type_distributions[name]
            weights = np.array(choices.weights)
            name = choices.members[rng.choice(len(weights), p=weights / weights.sum())]
        if name not in demand.types:
            raise MapError(
                f"no file defines vehicle type '{name}'; read the one that does, too",
                file=departure.vehicle.file or None,
                line=departure.vehicle.line,
                element=f"vehicle {departure.id}",
            )
        kind = demand.types[name]
        if kind.engine_class is None:
            notes.add(f"vClass '{kind.vehicle_class}' is no motor traffic on roads; left out", [departure.id])
        else:
            kept.append(replace(departure, type=name))
    return kept


class _Ways:
    """Columns of a route table, found as they are asked for."""

    def __init__(self, network: Network, lane_map: LaneMap) -> None:
        self.network = network
        self.rows = lane_rows(network)
        self.size = lane_map.length.shape[0]
        self.lanes = list(network.drivable_lanes())
        self.routes: list[tuple[str, ...]] = []
        self.columns: list[RouteTable] = []
        self.known: dict[tuple[str | None, tuple[str, ...]], int] = {}
        self.starts: set[str] = set()  # lanes on which vehicles depart
        # classes that may use the same lanes share columns
        groups: dict[tuple[bool, ...], str] = {}
        self.like = {
            name: groups.setdefault(tuple(name in lane.access for lane in self.lanes), name)
            for name in VEHICLE_CLASSES
        }

    def along(self, edges: tuple[str, ...], vehicle_class: str | None) -> int:
        """Column of a route. Raises `MapError` if it cannot be driven."""
        key = (self.like.get(vehicle_class or ""), edges)
        if key not in self.known:
            table = build_fixed_routes(self.network, self.rows, [edges], vehicle_class=vehicle_class)
            self._add(table, edges, key[0])
        return self.known[key]

    def towards(self, edge: str, vehicle_class: str | None) -> int:
        """Column of a destination. Raises `MapError` if no lane of it is for motor traffic."""
        key = (self.like.get(vehicle_class or ""), (edge,))
        if key not in self.known:
            ends = [lane.id for lane in self.network.road_lanes(edge) if lane.drivable]
            table = build_routes(self.network, self.rows, [ends], vehicle_class=vehicle_class)
            self._add(table, (edge,), key[0])
        return self.known[key]

    def _add(self, table: RouteTable, edges: tuple[str, ...], group: str | None) -> None:
        """Add a column: it serves the rest of its route, but not its destination by itself."""
        column = len(self.columns)
        self.columns.append(table)
        self.routes.append(edges)
        self.known[group, edges] = column
        for i in range(1, len(edges) - 1):
            self.known.setdefault((group, edges[i:]), column)

    def table(self, first: RouteTable | None = None) -> RouteTable:
        """All columns behind those of `first`, padded to the lane map."""
        parts = [column.pad(lanes=self.size, goals=column.distance.shape[1]) for column in self.columns]
        parts = parts if first is None else [first, *parts]
        whole = RouteTable(**{name: np.hstack([vars(x)[name] for x in parts]) for name in vars(parts[0])})
        padded = whole.pad(lanes=self.size, goals=bucket(whole.distance.shape[1], 16))
        return jax.tree.map(jnp.asarray, padded)


def _place(
    network: Network,
    ways: _Ways,
    demand: Demand,
    departures: list[_Departure],
    rng: np.random.Generator,
    notes: _Notes,
) -> list[_Departure]:
    """The departures with lane, place, speed and goal; long routes first, so that others share theirs."""
    routed = [(d, _edges(demand, d.vehicle, rng)) for d in departures]
    placed = []
    usage: dict[int, int] = {}
    for departure, edges in sorted(routed, key=lambda pair: -len(pair[1])):
        _note_what_is_not_used(departure, demand, notes)
        kind = demand.types[departure.type]
        if not edges:
            notes.add("has neither a route nor an origin and a destination edge; left out", [departure.id])
            continue
        lane, goal = _way(network, ways, departure, edges, kind, usage, rng, notes)
        if lane is None:
            continue
        row = ways.rows[lane.id]
        usage[row] = usage.get(row, 0) + 1
        s, v = _depart_pos(departure, lane, rng, notes), _depart_speed(departure, lane, rng)
        placed.append(replace(departure, row=row, s=s, v=v, goal=goal))
    return placed


def _edges(demand: Demand, vehicle: Vehicle, rng: np.random.Generator) -> tuple[str, ...]:
    """Edges of the route; of a trip origin and destination; empty if there are none."""
    name = vehicle.route
    while name in demand.route_distributions:
        choices = demand.route_distributions[name]
        weights = np.array(choices.weights)
        name = choices.members[rng.choice(len(weights), p=weights / weights.sum())]
    if name is not None:
        route = demand.routes[name]
        return route.edges * (route.repeat + 1)
    if vehicle.origin is None or vehicle.destination is None:
        return ()
    return (vehicle.origin, vehicle.destination)


def _note_what_is_not_used(departure: _Departure, demand: Demand, notes: _Notes) -> None:
    vehicle = departure.vehicle
    route = demand.routes.get(vehicle.route or "")
    used = {
        "stops are not made": vehicle.stops or (route is not None and route.stops),
        "via edges are not visited": vehicle.via,
        "departPosLat is not used: vehicles enter in the middle of the lane": vehicle.depart_pos_lat
        not in ("center", 0.0),
        "arrivalLane, arrivalPos and arrivalSpeed are not used: vehicles leave at the end of the last edge": (
            vehicle.arrival_lane != "current"
            or vehicle.arrival_pos != "max"
            or vehicle.arrival_speed != "current"
        ),
    }
    used |= {f"attribute {name} is not used": True for name in vehicle.parameters}
    for message, says in used.items():
        if says:
            notes.add(message, [departure.id])


def _way(
    network: Network,
    ways: _Ways,
    departure: _Departure,
    edges: tuple[str, ...],
    kind: VehicleType,
    usage: dict[int, int],
    rng: np.random.Generator,
    notes: _Notes,
) -> tuple[Lane | None, int]:
    """Departure lane and column; no lane if there is no way."""
    free = None if kind.vehicle_class == "ignoring" else kind.engine_class
    is_trip = departure.vehicle.route is None
    choices = []
    if not is_trip and len(set(edges)) == len(edges):
        choices.append((ways.along, edges, free, ""))
        choices.append((ways.along, edges, None, "goes along lanes that are not open to its class"))
    twice = "its route visits an edge twice; it takes the shortest way to the last edge"
    other = "its route cannot be driven; it takes the shortest way to the last edge"
    why = "" if is_trip else twice if len(set(edges)) < len(edges) else other
    choices.append((ways.towards, edges[-1], free, why))
    for find, target, vehicle_class, note in choices:
        try:
            goal = find(target, vehicle_class)
        except MapError:
            continue
        lane = _depart_lane(network, ways, departure, edges[0], goal, vehicle_class, usage, rng, notes)
        if lane is not None:
            notes.add(note, [departure.id] if note else [])
            ways.starts.add(lane.id)
            return lane, goal
    notes.add("there is no way from its first edge to its last one; left out", [departure.id])
    return None, -1


def _depart_lane(
    network: Network,
    ways: _Ways,
    departure: _Departure,
    edge: str,
    goal: int,
    vehicle_class: str | None,
    usage: dict[int, int],
    rng: np.random.Generator,
    notes: _Notes,
) -> Lane | None:
    """The lane of departLane, or the nearest that leads to the goal."""
    table = ways.columns[goal]
    lanes = [
        lane
        for lane in network.road_lanes(edge)
        if lane.drivable and (vehicle_class is None or vehicle_class in lane.access)
    ]
    usable = [lane for lane in lanes if table.reachable[ways.rows[lane.id], 0]]
    if not usable:
        return None
    wish = departure.vehicle.depart_lane
    if wish == "random":
        return usable[rng.integers(len(usable))]
    if wish in ("best", "free", "allowed"):
        change = np.array([table.change_distance[ways.rows[lane.id], 0] for lane in usable])
        crowd = [usage.get(ways.rows[lane.id], 0) for lane in usable]
        good = [i for i in range(len(usable)) if wish == "allowed" or change[i] >= change.max() - 1.0]
        return usable[min(good, key=lambda i: (crowd[i], usable[i].number))]
    number = min(lane.number for lane in lanes) if wish == "first" else wish
    if not isinstance(number, int):
        notes.add(f"departLane '{wish}' is unknown; taken as 'first'", [departure.id])
        number = min(lane.number for lane in lanes)
    nearest = min(usable, key=lambda lane: (abs(lane.number - number), lane.number))
    if nearest.number != number:
        notes.add("there is no way from its departLane; it departs on the nearest lane", [departure.id])
    return nearest


def _depart_pos(departure: _Departure, lane: Lane, rng: np.random.Generator, notes: _Notes) -> float | None:
    """Front bumper, m; None: as far back as the body fits."""
    wish = departure.vehicle.depart_pos
    if wish == "random":
        return rng.uniform(0, lane.length)
    if isinstance(wish, str):
        if wish != "base":
            notes.add(f"departPos '{wish}' is taken as 'base'", [departure.id])
        return None
    return min(max(wish + lane.length if wish < 0 else wish, 0.0), lane.length)


def _depart_speed(departure: _Departure, lane: Lane, rng: np.random.Generator) -> float:
    """m/s; infinite for as fast as is safe."""
    wish = departure.vehicle.depart_speed
    if wish == "random":
        return rng.uniform(0, lane.speed_limit)
    return math.inf if isinstance(wish, str) else wish


class _Rows(NamedTuple):
    """Departures sorted by lane and time, arrays `[V]`; rows that are not used come never."""

    time: Any  # s since the scenario begins
    number: Any  # in the order of the files
    type: Any  # row of the population
    lane: Any
    goal: Any
    factor: Any  # on the speed limit; NaN: that of the driver
    s: Any  # m; -1: as far back as the body fits
    v: Any  # m/s, wanted
    start: Any  # first row of each lane, and the end of the last


def _rows(placed: list[_Departure], lanes: list[int], types: list[str], begin: float, rows: int) -> _Rows:
    """Departures as arrays of `rows` rows, with a queue for each lane."""
    first = sorted(placed, key=lambda d: d.time)[:rows]  # all, but for draws beyond `FEW`
    placed = sorted(first, key=lambda d: (d.row, d.time))

    def table(values: list[float], fill: float, dtype: type) -> NDArray[Any]:
        return np.array(values + [fill] * (rows - len(values)), dtype)

    start = np.searchsorted([d.row for d in placed], lanes).tolist()
    start += [len(placed)] * (bucket(len(lanes), LEAST_ORIGINS) + 1 - len(lanes))
    return _Rows(
        time=table([d.time - begin for d in placed], NEVER, np.float32),
        number=table([d.number for d in placed], 0, np.int32),
        type=table([types.index(d.type) for d in placed], 0, np.int32),
        lane=table([d.row for d in placed], NO_LANE, np.int32),
        goal=table([d.goal for d in placed], 0, np.int32),
        factor=table([d.vehicle.speed_factor or math.nan for d in placed], math.nan, np.float32),
        s=table([-1.0 if d.s is None else d.s for d in placed], -1.0, np.float32),
        v=table([min(d.v, NEVER) for d in placed], 0.0, np.float32),
        start=np.array(start, np.int32),
    )


def _schedule(lane_map: LaneMap, population: Population, rows: _Rows, key: Key[Array, ""]) -> Schedule:
    """A schedule of departures; the key draws drivers and bodies."""
    driver, shape = sample_vehicles(population, key, rows.number, rows.type)
    own = jnp.where(jnp.isnan(rows.factor), driver.speed_factor, rows.factor)
    driver = replace(driver, speed_factor=own)
    base = departure_place(lane_map, rows.lane, shape.length)
    s = jnp.clip(rows.s, base, jnp.maximum(base, lane_map.length[rows.lane] - 0.5))
    return Schedule(
        time=rows.time,
        lane=rows.lane,
        s=s,
        v=jnp.minimum(rows.v, entry_speed(lane_map, driver, rows.lane, s, rows.goal)),
        goal=rows.goal,
        driver=driver,
        shape=shape,
        start=rows.start,
    )
