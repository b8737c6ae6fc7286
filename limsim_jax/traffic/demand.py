"""Who is on the road at the start, and who comes later.

On the host `build_demand` turns `Flow`s and a density into a `Demand`, arrays for the device. Of that
`sample_scenario` draws a world: a start state, and a `Schedule` with one queue per departure lane. While
a world runs, `enter` lets the first of every queue in when there is room; nobody is dropped.

Draws are keyed by place and number: vehicle k of a queue is the same whatever the other flows are.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, UInt
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.special import gammainc

from limsim_jax.geometry import box_separation
from limsim_jax.maps.lane_map import (
    NO_LANE,
    VEHICLE_CLASSES,
    LaneMap,
    bend_speed,
    bucket,
    curvature,
    lane_ids,
    lane_rows,
)
from limsim_jax.maps.network import Lane, Network
from limsim_jax.numerics import safe_sqrt
from limsim_jax.traffic.car_following import desired_speed
from limsim_jax.traffic.ego import from_lane
from limsim_jax.traffic.motion import boxes, tails
from limsim_jax.traffic.neighbors import lanes_ahead, look_ahead, neighbors, other_lane, sort_vehicles
from limsim_jax.traffic.vehicles import BODY, PARAMETERS, Population, sample_vehicles
from limsim_jax.types import Config, Driver, Egos, Lights, Queues, Scenario, Schedule, Shape, State

NEVER = 1e9
"""s, time of the rows of a schedule that nobody uses."""

CHANGE_ROOM, CHANGE_TIME = 60.0, 6.0
"""m, and s at the speed limit, per lane to cross: who starts or enters is given no goal that leaves less."""

RARE = 1e-9
"""Chance per flow and lane that more vehicles arrive than the schedule has rows for; see `overflow`."""

EGO_ROOM = 10.0
"""m before and behind an ego that are free on its lane at the start."""

AT_ONCE = 16
"""Departures that a decision looks at, at most."""

_PATTERNS = ("poisson", "uniform", "platoon")
_NARROW = 2.0  # m: no vehicle enters on a narrower lane
_CLEAR = 3.0  # m, least gap between vehicles at the start
_MARGIN = 2.0  # m from the bodies of vehicles at the start to both ends of their lane
_WALL_ROOM = 12.0  # m before the end of a lane that leads nowhere, kept free to change lanes
_REAR_ROOM = 1.0  # m, least gap to the follower of who enters
_LOOK = 4  # lanes ahead of the departure lane that limit the speed
_BEND_POINTS = 4  # places on the departure lane at which the bend is looked at
_LOOK_CONFIG = Config(dt=0.1)  # how far vehicles at the start look for their leaders; only that counts
_SWEEPS = 8  # times that the speeds at the start are adjusted to those of the leaders
_FAR = 1e6  # m, of who is not there
_NOWHERE = -2  # lane of who is not there: not even the null lane
_FLOW_BITS = 16  # of the number that keys a draw: the flow or the place in the queue; above: the lane

# Purposes of keys.
_ARRIVALS, _SEATS, _ROLES, _VEHICLES = range(4)


# --- what the user says, on the host -----------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Flow:
    """Vehicles from one or several origins.

    The flow of an origin is spread over its lanes: to every goal evenly over those from which it can be
    reached with room to change lanes, `CHANGE_ROOM` and `CHANGE_TIME` (or, if there are none, those with
    the fewest lanes to cross), in proportion to the share of vehicles that may use the lane.

    Patterns, each independent on every lane: `poisson`: exponential headways. `uniform`: equal headways
    from a random phase. `platoon`: groups of `platoon` vehicles `headway` s apart, between the groups
    an exponential time on top of that.
    """

    origin: str | Sequence[str]
    """Names as `entries` has them, road ids (`+` or `-` behind them chooses the direction, by the sign of
    the lane numbers in OpenDRIVE) or lane ids."""
    rate: float
    """Vehicles per hour, of each origin."""
    goal: str | Mapping[str, float] | None = None
    """Name of a goal, or shares by name (turning ratios); None: all that can be reached, in equal shares."""
    pattern: str = "poisson"
    begin: float = 0.0
    """s"""
    end: float | None = None
    """s; None: to the horizon."""
    speed: float | None = None
    """m/s at entry, where that is safe; None: the speed limit."""
    classes: Mapping[str, float] | None = None
    """Weights of vehicle classes; None: those of the population."""
    platoon: int = 5
    headway: float = 2.0
    """s within a platoon"""


def entries(network: Network) -> dict[str, tuple[str, ...]]:
    """The ways into a map: groups of lane ids by name.

    One per road and direction by which traffic comes in: the first lanes, none of which has a drivable
    predecessor. (A lane that begins beside one that goes on is no entry, nor is one narrower than a car.)
    Closed maps have none. Names are road ids, with `+` or `-` for the sign of the lane numbers where a
    road has traffic both ways (OpenDRIVE).
    """
    return {
        name: tuple(lane.id for lane in lanes if lane.width_at(min(5.0, lane.length)) >= _NARROW)
        for name, lanes in _beginnings(network).items()
        if all(lane.junction is None for lane in lanes)
        and not any(_drivable(network, x) for lane in lanes for x in lane.predecessors)
    }


def beginnings(network: Network, count: int) -> list[str]:
    """Names of at most `count` roads on which traffic can come in where there are no `entries`.

    Spread evenly over the map's list of roads; none is shorter than `CHANGE_ROOM`.
    """
    names = [
        name
        for name, lanes in _beginnings(network).items()
        if all(lane.junction is None and lane.length > CHANGE_ROOM for lane in lanes)
    ]
    return names[:: -(-len(names) // count)] if names else []


def _drivable(network: Network, name: str) -> bool:
    return name in network.lanes and network.lanes[name].drivable


def _beginnings(network: Network) -> dict[str, list[Lane]]:
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


# --- what the device gets ----------------------------------------------------------------------------


@struct.dataclass(frozen=True, kw_only=True)
class Demand:
    """Flows as streams, and seats for the traffic at the start.

    `K` streams, one per flow and departure lane; `O` origins, one per departure lane; `V` rows of the
    schedule; `S` seats; `G` goals; `Y` types of the population. All padded but `S`. Shares are cumulative
    and end in 1. Rates may be changed on the device (`idle`, `headway`); `overflow` tells if the rows
    still suffice.
    """

    population: Population
    # a stream: groups of `size` arrivals `headway` apart, and after each an exponential time
    stream: UInt[Array, " K"]  # number that keys its draws
    begin: Float[Array, " K"]  # s
    end: Float[Array, " K"]  # s
    headway: Float[Array, " K"]  # s
    size: Int[Array, " K"]
    idle: Float[Array, " K"]  # s, mean of the exponential time
    speed: Float[Array, " K"]  # m/s, wanted at entry
    goals: Float[Array, "K G"]  # cumulative shares
    types: Float[Array, "K Y"]  # cumulative shares
    capacity: Int[Array, " K"]  # rows
    # rows, before they are put in order of time within their origin
    row_origin: Int[Array, " V"]
    row_stream: Int[Array, " V"]
    row_arrival: Int[Array, " V"]  # which arrival of its stream
    start: Int[Array, " O1"]  # rows start[o] .. start[o + 1] - 1 belong to origin o
    lane: Int[Array, " O"]
    # seats
    seat_lane: Int[Array, " S"]
    seat_s: Float[Array, " S"]  # m, hindmost place of the front bumper
    seat_slack: Float[Array, " S"]  # m to the foremost
    seat_weight: Float[Array, " S"]  # logarithm of the share of vehicles that may use the lane
    seat_goals: Float[Array, "S G"]  # cumulative shares
    seat_types: Float[Array, "S Y"]  # cumulative shares
    initial: int = struct.field(pytree_node=False)  # vehicles at the start
    arrivals: int = struct.field(pytree_node=False)  # drawn per stream


@struct.dataclass(frozen=True, kw_only=True)
class EgoStart:
    """Where vehicles under test begin, `E` of them; they take the first slots.

    Without a lane they take the places, goals and speeds of others that would be there at the start, so
    every world has them elsewhere.
    """

    lane: Int[Array, " E"] | None = None
    s: Float[Array, " E"] | None = None  # m, front bumper
    goal: Int[Array, " E"] | None = None  # column of the route table
    v: Float[Array, " E"] | None = None  # m/s, where road and leader allow it; None: as fast as they do
    driver: Driver  # [E]
    shape: Shape  # [E]
    free: Bool[Array, " E"]  # moves in the plane, not on lanes

    @property
    def count(self) -> int:
        """How many there are."""
        return self.free.shape[0]


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
) -> Demand:
    """Check flows and density, and lay them out for `sample_scenario`.

    Args:
      network: the map.
      lane_map: of that map and these goals.
      goals: lane ids by name, in the order of the columns of `lane_map.routes`
        (`maps.routing.default_goals` if the map was built without any).
      flows: who comes later. Several may use one lane; they share its queue.
      population: whom to draw from.
      horizon: s; nobody comes after it.
      density: vehicles at the start per km of lane outside junctions.
      vehicles: instead of that, how many there are at the start.
      egos: vehicles under test; nobody else starts on top of them, nor within `EGO_ROOM` on their lanes.

    Raises:
      ValueError: an origin or goal that is not there or not reachable, a number that makes no sense, a
        lane that is open to none of the vehicles, or a density that does not fit; one line that says which.
    """
    if not 0 < horizon < math.inf:
        raise ValueError(f"horizon = {horizon:g} s; it has to be positive and finite")
    if not 0 <= density < math.inf:
        raise ValueError(f"density = {density:g} veh/km; it has to be 0 or more, and finite")
    if vehicles is not None and vehicles < 0:
        raise ValueError(f"{vehicles} vehicles at the start? 0 or more")
    world = _World.of(network, lane_map, goals, population)
    streams: list[_Stream] = []
    for i, flow in enumerate(flows):
        streams += _streams(world, flow, i, horizon)
    wanted = sum((s.rate * s.goals for s in streams), np.zeros(world.reachable.shape[1]))
    if vehicles is None:
        seats = _seats(world, density, wanted, egos)
    else:
        km = sum(lane.length for lane in network.drivable_lanes() if lane.junction is None) / 1e3
        density = vehicles / max(km, 1e-3)
        seats = _seats(world, density, wanted, egos)
        if seats["initial"] not in (0, vehicles):  # lanes that are closed to all types have no places
            seats = _seats(world, density * vehicles / seats["initial"], wanted, egos)
    arrays = _lay_out(world, streams) | seats
    return jax.tree.map(jnp.asarray, Demand(population=population, **arrays))


@dataclass(frozen=True)
class _World:
    """Tables on the host: `L` rows and `G` goals of the lane map, `Y` types of vehicles."""

    network: Network
    goals: tuple[str, ...]
    rows: dict[str, int]
    classes: NDArray[np.int_]  # of the types of the population
    shares: NDArray[np.float64]  # of the types of the population, adding up to 1
    lengths: tuple[float, float]  # m, of the shortest and the longest vehicle
    widths: NDArray[np.float64]  # [Y] m, of the widest vehicle of a type
    allowed: NDArray[np.bool_]  # [L, Y] types on lanes
    reachable: NDArray[np.bool_]  # [L, G]
    lanes_to_go: NDArray[np.int_]  # [L, G]
    change_distance: NDArray[np.float64]  # [L, G] m
    speed_limit: NDArray[np.float64]  # [L] m/s

    @staticmethod
    def of(
        network: Network, lane_map: LaneMap, goals: Mapping[str, Sequence[str]], population: Population
    ) -> _World:
        rows = lane_rows(network)
        is_goal = np.asarray(lane_map.routes.is_goal)
        for column, (name, lanes) in enumerate(goals.items()):
            ends = [rows[lane] for lane in lanes if lane in rows]
            if column >= is_goal.shape[1] or not ends or not is_goal[ends, column].all():
                raise ValueError(
                    f"goal '{name}' is not number {column} of the lane map, which has other goals"
                )
        share = np.asarray(population.share, float)
        classes = np.asarray(population.vehicle_class)
        length, width = PARAMETERS.index("length"), PARAMETERS.index("width")
        least, most = np.asarray(population.lower, float), np.asarray(population.upper, float)
        access = np.asarray(lane_map.access)
        return _World(
            network=network,
            goals=tuple(goals),
            rows=rows,
            classes=classes,
            shares=share / share.sum(),
            lengths=(float(least[share > 0, length].min()), float(most[share > 0, length].max())),
            widths=most[:, width],
            allowed=(access[:, None] >> classes) & 1 == 1,
            reachable=np.asarray(lane_map.routes.reachable),
            lanes_to_go=np.asarray(lane_map.routes.lanes_to_go),
            change_distance=np.asarray(lane_map.routes.change_distance, float),
            speed_limit=np.asarray(lane_map.speed_limit, float),
        )

    def leaves_room(self, row: Any, s: Any) -> NDArray[np.bool_]:
        """Goals `[*b, G]` that leave room to change lanes to who is at `s` (m) of `row`."""
        room = self.change_distance[row] - np.asarray(s)[..., None]
        per_lane = np.maximum(CHANGE_ROOM, CHANGE_TIME * self.speed_limit[row])[..., None]
        return self.reachable[row] & (room > per_lane * np.abs(self.lanes_to_go[row]))


@dataclass(frozen=True)
class _Stream:
    """A flow on one departure lane."""

    flow: Flow
    number: int  # of the flow
    row: int
    rate: float  # veh/s
    begin: float
    end: float
    goals: NDArray[np.float64]  # shares
    types: NDArray[np.float64]  # shares
    # groups of `size` arrivals `headway` apart, then an exponential time of mean `idle` s
    size: int = field(init=False)
    headway: float = field(init=False)
    idle: float = field(init=False)

    def __post_init__(self) -> None:
        match self.flow.pattern:
            case "uniform":
                size, headway, idle = 1, 1 / self.rate, 0.0
            case "platoon":
                size, headway = self.flow.platoon, self.flow.headway
                idle = size / self.rate - size * headway
                idle = 0.0 if abs(idle) < 1e-6 else idle
            case _:
                size, headway, idle = 1, 0.0, 1 / self.rate
        for name, value in {"size": size, "headway": headway, "idle": idle}.items():
            object.__setattr__(self, name, value)

    def capacity(self) -> int:
        """Rows that suffice but for a chance of `RARE`, and one more: if the last is taken, more may come.

        `k` groups take `k size headway` s and a gamma-distributed time.
        """
        duration = self.end - self.begin
        block = self.size * self.headway
        most = 8 + duration / block if block else math.inf
        if self.idle:
            # A Poisson process without the blocks is an upper bound, and it needs at most this many.
            mean = duration / self.idle
            most = min(most, mean + 10 * math.sqrt(mean) + 40)
        k = np.arange(1, math.ceil(most) + 1)
        left = np.maximum(duration - (k - 1) * block, 0)
        chance = gammainc(k, left / self.idle) if self.idle else (left > 0).astype(float)
        groups = int(np.argmax(chance < RARE)) + 1 if (chance < RARE).any() else len(k)
        return self.size * groups + 1


def _streams(world: _World, flow: Flow, number: int, horizon: float) -> list[_Stream]:
    """A flow on all its departure lanes."""
    origins = [flow.origin] if isinstance(flow.origin, str) else list(flow.origin)
    who = f"flow {number} from {_some(origins)}"
    _check_numbers(who, flow)
    if not origins:
        raise ValueError(f"flow {number}: it has no origin")
    end = horizon if flow.end is None else min(flow.end, horizon)
    lanes = [_departure_lanes(world, who, origin) for origin in origins]
    types = _type_weights(world, who, flow.classes)
    found = []
    for origin, rows in zip(origins, lanes, strict=True):
        weight = (world.allowed[rows] * types).sum(1)  # [R]
        if not weight.any():
            raise ValueError(f"{who}: no lane of '{origin}' is open to its vehicle classes")
        share = _goal_shares(world, who, flow, rows, weight)  # [G]
        to_lane = np.zeros((len(rows), len(share)))
        for g in np.nonzero(share)[0]:
            to_lane[:, g] = share[g] * _spread(world, rows, int(g), weight)
        if flow.rate == 0 or end <= flow.begin:
            continue
        for row, to_goal in zip(rows, to_lane, strict=True):
            if not to_goal.any():
                continue
            allowed = types * world.allowed[row]
            stream = _Stream(
                flow=flow,
                number=number,
                row=row,
                rate=flow.rate / 3600 * to_goal.sum(),
                begin=flow.begin,
                end=end,
                goals=to_goal / to_goal.sum(),
                types=allowed / allowed.sum(),
            )
            if stream.idle < 0:
                raise ValueError(
                    f"{who}: {stream.rate * 3600:.0f} veh/h on lane '{lane_ids(world.network)[row]}' do not "
                    f"fit a headway of {flow.headway:g} s, at most {3600 / flow.headway:.0f} veh/h do"
                )
            found.append(stream)
    return found


def _check_numbers(who: str, flow: Flow) -> None:
    if flow.pattern not in _PATTERNS:
        raise ValueError(f"{who}: pattern '{flow.pattern}' is unknown; known are {', '.join(_PATTERNS)}")
    if not 0 <= flow.rate < math.inf:
        raise ValueError(f"{who}: rate = {flow.rate:g} veh/h; it has to be 0 or more, and finite")
    if not 0 <= flow.begin < math.inf:
        raise ValueError(f"{who}: begin = {flow.begin:g} s; it has to be 0 or more, and finite")
    if flow.end is not None and not flow.begin <= flow.end:
        raise ValueError(f"{who}: it ends at {flow.end:g} s, before it begins at {flow.begin:g} s")
    if flow.speed is not None and not 0 <= flow.speed < math.inf:
        raise ValueError(f"{who}: speed = {flow.speed:g} m/s; it has to be 0 or more, and finite")
    if flow.pattern == "platoon" and not (flow.platoon >= 1 and 0 < flow.headway < math.inf):
        raise ValueError(
            f"{who}: platoons of {flow.platoon} with a headway of {flow.headway:g} s; it takes 1 or more "
            "vehicles and a positive headway"
        )


def _departure_lanes(world: _World, who: str, origin: str) -> list[int]:
    """Rows of the lanes of an origin."""
    network, ways = world.network, _beginnings(world.network)
    ways_in = entries(network)
    if origin in ways_in:
        return [world.rows[lane] for lane in ways_in[origin]]
    if origin in network.lanes:
        lane = network.lanes[origin]
        if not lane.drivable or lane.junction is not None:
            what = "lies inside a junction" if lane.drivable else "is not for motor traffic"
            raise ValueError(f"{who}: lane '{origin}' {what}")
        return [world.rows[origin]]
    both = [name for name in (f"{origin}+", f"{origin}-") if name in ways]
    inwards = [name for name in both if name in ways_in]
    if len(inwards) == 1:
        return [world.rows[lane] for lane in ways_in[inwards[0]]]
    if both:
        raise ValueError(f"{who}: road '{origin}' has traffic both ways; name one: {_some(both)}")
    lanes = [lane for lane in ways.get(origin, []) if lane.junction is None]
    if not lanes:
        known = ", ".join(list(ways_in or ways)[:5])
        raise ValueError(f"{who}: no road or lane '{origin}' to depart from; there are {known}")
    return [world.rows[lane.id] for lane in lanes]


def _type_weights(world: _World, who: str, classes: Mapping[str, float] | None) -> NDArray[np.float64]:
    """Shares of the types of the population, with these weights of classes."""
    if classes is None:
        return world.shares
    weights = np.zeros(len(world.shares))
    for name, weight in classes.items():
        if name not in VEHICLE_CLASSES:
            known = ", ".join(VEHICLE_CLASSES)
            raise ValueError(f"{who}: vehicle class '{name}' is unknown; known are {known}")
        if not 0 <= weight < math.inf:
            raise ValueError(f"{who}: vehicle class '{name}' has the weight {weight:g}")
        mine = world.classes == VEHICLE_CLASSES.index(name)
        if weight > 0 and not mine.any():
            raise ValueError(f"{who}: the population has no vehicles of class '{name}'")
        of_class = np.where(mine, world.shares, 0)
        # a class that the population has but never draws: its types in equal shares
        of_class = of_class if of_class.any() else mine.astype(float)
        weights += weight * of_class / max(of_class.sum(), 1e-30)
    if not weights.any():
        raise ValueError(f"{who}: no vehicle class has a positive weight")
    return weights / weights.sum()


def _goal_shares(
    world: _World, who: str, flow: Flow, rows: list[int], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Shares of the goals of a flow, adding up to 1."""
    reachable = np.any(world.reachable[rows] & (weight > 0)[:, None], axis=0)
    if flow.goal is None:
        if not reachable.any():
            raise ValueError(f"{who}: it can reach none of the goals {_some(world.goals)}")
        return reachable / reachable.sum()
    shares = {flow.goal: 1.0} if isinstance(flow.goal, str) else dict(flow.goal)
    wanted = np.zeros(world.reachable.shape[1])
    for name, share in shares.items():
        if name not in world.goals:
            raise ValueError(f"{who}: no goal '{name}'; there are {_some(world.goals)}")
        if not 0 <= share < math.inf:
            raise ValueError(f"{who}: goal '{name}' has the share {share:g}; it has to be 0 or more")
        goal = world.goals.index(name)
        if share > 0 and not reachable[goal]:
            can = _some([world.goals[g] for g in np.nonzero(reachable)[0]]) or "none"
            raise ValueError(f"{who}: no way to goal '{name}'; it can reach {can}")
        wanted[goal] = share
    if not wanted.any():
        raise ValueError(f"{who}: no goal has a positive share")
    return wanted / wanted.sum()


def _some(names: Sequence[str]) -> str:
    return ", ".join(f"'{name}'" for name in names[:8]) + (", ..." if len(names) > 8 else "")


def _spread(world: _World, rows: list[int], goal: int, weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shares of the lanes of an origin in its traffic to a goal."""
    usable = world.reachable[rows, goal] & (weight > 0)
    easy = usable & world.leaves_room(rows, np.full(len(rows), world.lengths[1]))[:, goal]
    if not easy.any():
        lanes = np.where(usable, np.abs(world.lanes_to_go[rows, goal]), np.iinfo(np.int32).max)
        easy = usable & (lanes == lanes.min())
    share = np.where(easy, weight, 0)
    return share / share.sum()


def _lay_out(world: _World, streams: list[_Stream]) -> dict[str, Any]:
    """Streams and rows as arrays; origins in order of their lanes."""
    streams = sorted(streams, key=lambda stream: (stream.row, stream.number))
    lanes = sorted({stream.row for stream in streams})
    origin_of = np.array([lanes.index(stream.row) for stream in streams], int)
    capacity = np.array([stream.capacity() for stream in streams], int)
    rows = int(capacity.sum())
    num_streams, num_origins, num_rows = bucket(len(streams), 4), bucket(len(lanes), 4), bucket(rows, 64)

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
    goal_fill, type_fill = np.ones(world.reachable.shape[1]), np.ones(len(world.shares))
    return {
        "stream": of_streams([_number(s.row, s.number) for s in streams], 0, np.uint32),
        "begin": of_streams([s.begin for s in streams], NEVER, np.float32),
        "end": of_streams([s.end for s in streams], 0.0, np.float32),
        "headway": of_streams([s.headway for s in streams], 0.0, np.float32),
        "size": of_streams([s.size for s in streams], 1, np.int32),
        "idle": of_streams([s.idle for s in streams], 1.0, np.float32),
        "speed": of_streams(
            [NEVER if s.flow.speed is None else s.flow.speed for s in streams], 0.0, np.float32
        ),
        "goals": of_streams([_cumulative(s.goals) for s in streams], goal_fill, np.float32),
        "types": of_streams([_cumulative(s.types) for s in streams], type_fill, np.float32),
        "capacity": of_streams(capacity.tolist(), 1, np.int32),
        "row_origin": of_rows(np.repeat(origin_of, capacity), num_origins),
        "row_stream": of_rows(np.repeat(np.arange(len(streams)), capacity), num_streams - 1),
        "row_arrival": of_rows(np.arange(rows) - np.repeat(first, capacity), 0),
        "start": start.astype(np.int32),
        "lane": lane.astype(np.int32),
        "arrivals": bucket(int(capacity.max(initial=1)), 8),
    }


def _number(row: int, part: int) -> int:
    return (row << _FLOW_BITS) + part


def _cumulative(shares: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cumulative shares along the last axis, exactly 1 from the last positive one on."""
    total = np.cumsum(shares, -1)
    return np.where(total >= total[..., -1:] * (1 - 1e-12), 1.0, total / total[..., -1:])


def _seats(
    world: _World, density: float, wanted: NDArray[np.float64], egos: EgoStart | None
) -> dict[str, Any]:
    """Places for vehicles at the start, about twice as many as there are vehicles.

    `wanted` has the traffic to every goal: goals are drawn in these proportions, where it can be.
    """
    lanes = [lane for lane in world.network.drivable_lanes() if lane.junction is None]
    open_to = {lane.id: world.allowed[world.rows[lane.id]] @ world.shares for lane in lanes}
    lanes = [lane for lane in lanes if open_to[lane.id] > 0]
    initial = round(density * sum(lane.length for lane in lanes) / 1000)
    row, s, slack = np.zeros(0, int), np.zeros(0), np.zeros(0)
    if initial:
        least = world.lengths[1] + _CLEAR
        pitch = max(least, 500 / density)
        row, s, slack = _places(world, lanes, pitch, egos)
        while len(row) < 1.5 * initial and pitch > least:
            pitch = max(least, 0.85 * pitch)
            row, s, slack = _places(world, lanes, pitch, egos)
    if len(row) < initial:
        raise ValueError(
            f"density = {density:g} veh/km puts {initial} vehicles on the roads at the start, "
            f"but there are only {len(row)} places"
        )
    feasible = world.leaves_room(row, s + slack)
    share = np.where(feasible, wanted, 0)
    share = np.where(share.any(1, keepdims=True), share, feasible)
    types = world.allowed[row] * world.shares * _fits(world, lanes, row, s, slack)
    weight = types.sum(1)
    return {
        "seat_lane": row.astype(np.int32),
        "seat_s": s.astype(np.float32),
        "seat_slack": slack.astype(np.float32),
        "seat_weight": np.log(weight).astype(np.float32),
        "seat_goals": _cumulative(share.astype(float)).astype(np.float32),
        "seat_types": _cumulative(types).astype(np.float32),
        "initial": initial,
    }


def _places(
    world: _World, lanes: list[Lane], pitch: float, egos: EgoStart | None
) -> tuple[NDArray[np.int_], NDArray[np.float64], NDArray[np.float64]]:
    """Row, hindmost front bumper and room from there (m) of places `pitch` m apart.

    Bodies lie within one lane, some goal can be reached, and no two bodies of any size overlap.
    """
    longest = world.lengths[1]
    row, s, slack = [], [], []
    for lane in lanes:
        front = np.arange(longest + _MARGIN, lane.length - _MARGIN, pitch)
        row += [world.rows[lane.id]] * len(front)
        s += front.tolist()
        slack += np.minimum(pitch - longest - _CLEAR, lane.length - _MARGIN - front).tolist()
    row, s, slack = np.array(row, int), np.array(s), np.array(slack)
    useful = world.leaves_room(row, s + slack).any(1)
    useful &= (world.allowed[row] & _fits(world, lanes, row, s, slack) & (world.shares > 0)).any(1)
    row, s, slack = row[useful], s[useful], slack[useful]
    # egos come first, and of two places that touch the first is kept
    taken = np.zeros((2, 0))
    if egos is not None and egos.lane is not None:
        taken = np.array([egos.lane, egos.s], float)
    near = (row[:, None] == taken[0]) & (s[:, None] - longest < taken[1] + EGO_ROOM)
    near &= (s + slack)[:, None] > taken[1] - longest - EGO_ROOM
    row, s, slack = (x[~near.any(1)] for x in (row, s, slack))
    count = taken.shape[1]
    row = np.concatenate([taken[0].astype(int), row])
    s, slack = np.concatenate([taken[1], s]), np.concatenate([np.zeros(count), slack])
    apart = _apart(world, row, s, slack)
    apart[:count] = False
    return row[apart], s[apart], slack[apart]


def _fits(
    world: _World,
    lanes: list[Lane],
    row: NDArray[np.int_],
    s: NDArray[np.float64],
    slack: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Which types `[S, Y]` are narrow enough for the lane along the whole place."""
    by_row = {world.rows[lane.id]: lane for lane in lanes}
    share = np.linspace(0, 1, 7)
    rear = s - world.lengths[1]
    along = rear[:, None] + share * (s + slack - rear)[:, None]
    width = [by_row[r].width_at(x).min() for r, x in zip(row.tolist(), along, strict=True)]
    return np.reshape(width, (-1, 1)) >= world.widths + 0.2


def _apart(
    world: _World,
    row: NDArray[np.int_],
    s: NDArray[np.float64],
    slack: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Mask of places whose bodies, of any size and anywhere in their place, touch none of another place."""
    by_row = {world.rows[lane.id]: lane for lane in world.network.drivable_lanes()}
    lengths = np.linspace(*world.lengths, 3)
    share = np.linspace(0, 1, 3)
    # boxes of three lengths at three positions each; their centres
    center = (s[:, None, None] + slack[:, None, None] * share[:, None] - lengths / 2).reshape(len(s), 9)
    size = np.broadcast_to(np.array([0, world.widths.max()]), (len(s), 9, 2)).copy()
    size[..., 0] = np.tile(lengths, 3)
    poses = [by_row[r].pose(x) for r, x in zip(row.tolist(), center, strict=True)]
    xy = np.array([p[0][:, :2] for p in poses]).reshape(-1, 2)
    heading = np.array([p[1] for p in poses]).reshape(-1, 1)
    boxes = np.concatenate(
        [xy - xy.mean(0, keepdims=True) if len(xy) else xy, heading, size.reshape(-1, 2)], 1
    )
    reach = math.hypot(world.lengths[1], world.widths.max()) + 0.1
    pairs = KDTree(xy).query_pairs(reach, output_type="ndarray") if len(xy) else np.zeros((0, 2), int)
    pairs = pairs[pairs[:, 0] // 9 != pairs[:, 1] // 9]
    padded = np.zeros((bucket(len(pairs), 1024), 2), int)
    padded[: len(pairs)] = pairs
    gaps = np.asarray(_separations(*(jnp.asarray(boxes[padded[:, k]], jnp.float32) for k in (0, 1))))
    touching = np.unique(np.sort(pairs[gaps[: len(pairs)] < 0.1] // 9, axis=1), axis=0)
    kept = np.ones(len(s), bool)
    for a, b in touching.tolist():
        kept[b] &= not kept[a]
    return kept


@jax.jit
def _separations(a: Float[Array, "P 5"], b: Float[Array, "P 5"]) -> Float[Array, " P"]:
    return jax.vmap(box_separation)(a, b)


# --- on the device: a world from a seed --------------------------------------------------------------


def sample_scenario(
    demand: Demand, lane_map: LaneMap, key: Key[Array, ""], slots: int, egos: EgoStart | None = None
) -> Scenario:
    """Draw one world: who is there at the start, and who comes later.

    Args:
      demand: from `build_demand`.
      lane_map: the one that the demand was built for.
      key: of the world.
      slots: number of vehicle slots `N`.
      egos: the ones that the demand was built with; they are in slots 0 to `E - 1`.

    Raises:
      ValueError: more vehicles at the start than slots.
    """
    placed = egos is not None and egos.lane is not None
    initial = demand.initial + (egos.count if egos is not None and placed else 0)
    if egos is not None and initial < egos.count:
        raise ValueError(f"{egos.count} egos cannot take the places of {initial} vehicles at the start")
    if initial > slots:
        raise ValueError(f"{initial} vehicles at the start do not fit into {slots} slots")
    time, lane, place, stream = _sample_queues(demand, key)
    seat, shift = _sample_seats(demand, key)
    # those of the queues first, then those in the seats
    number = jnp.concatenate([(lane << _FLOW_BITS) + place, -1 - seat])
    goals = jnp.concatenate([demand.goals[stream], demand.seat_goals[seat]])
    types = jnp.concatenate([demand.types[stream], demand.seat_types[seat]])
    goal, vehicle_type = _sample_roles(jax.random.fold_in(key, _ROLES), number, goals, types)
    key = jax.random.fold_in(key, _VEHICLES)
    driver, shape = sample_vehicles(demand.population, key, number, vehicle_type)
    rows = time.shape[0]
    lane = jnp.concatenate([lane, demand.seat_lane[seat]])
    s = jnp.concatenate(
        [
            departure_place(lane_map, lane[:rows], shape.length[:rows]),
            demand.seat_s[seat] + shift * demand.seat_slack[seat],
        ]
    )
    v = entry_speed(lane_map, driver, lane, s, goal)
    later, now = (
        jax.tree.map(lambda x: x[part], (driver, shape, lane, s, v, goal))  # noqa: B023
        for part in (slice(rows), slice(rows, None))
    )
    driver, shape, lane, s, v, goal = later
    v = jnp.minimum(v, demand.speed[stream])
    schedule = Schedule(
        time=time, lane=lane, s=s, v=v, goal=goal, driver=driver, shape=shape, start=demand.start
    )
    if egos is not None:
        now = _with_egos(lane_map, egos, now)
    state = _start(demand, lane_map, slots, *now)
    if egos is not None:
        box = boxes(lane_map, state)
        state = replace(state, egos=from_lane(lane_map, state, box, range(egos.count), egos.free))
    return Scenario(start=state, schedule=schedule)


def _with_egos(lane_map: LaneMap, egos: EgoStart, others: tuple[Any, ...]) -> tuple[Any, ...]:
    """Driver, shape, lane, s, v and goal of who is there at the start, egos first."""
    _, _, lane, s, _, goal = jax.tree.map(lambda x: x[: egos.count], others)
    rest = jax.tree.map(lambda x: x[egos.count :], others)
    if egos.lane is not None and egos.s is not None and egos.goal is not None:
        lane, s, goal, rest = egos.lane, egos.s, egos.goal, others
    v = entry_speed(lane_map, egos.driver, lane, s, goal)
    v = v if egos.v is None else jnp.minimum(egos.v, v)
    them = egos.driver, egos.shape, lane, s, v, goal
    return jax.tree.map(lambda x, y: jnp.concatenate([x, y]), them, rest)


def overflow(demand: Demand, key: Key[Array, ""]) -> Bool[Array, ""]:
    """Whether more vehicles come in this world than the schedule has rows for (the host should raise).

    The chance is `RARE` per flow and lane, unless rates were changed after `build_demand`.
    """
    time = _sample_arrivals(demand, key)
    last = jnp.take_along_axis(time, demand.capacity[:, None] - 1, 1)[:, 0]
    return (last < NEVER).any()


def _sample_arrivals(demand: Demand, key: Key[Array, ""]) -> Float[Array, "K A"]:
    """Times of the arrivals of every stream in order, `NEVER` after its end.

    The process is stationary from `begin` on: that falls into a platoon or between two by their shares.
    """
    key = jax.random.fold_in(key, _ARRIVALS)
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, demand.stream)
    draws = jax.vmap(lambda k: jax.random.uniform(k, (demand.arrivals + 1,)))(keys)
    headway, size = demand.headway[:, None], demand.size[:, None]
    block = size.astype(headway.dtype) * headway
    # s since the last platoon began, and how many of it have passed; its whole block between platoons
    passed = jnp.minimum(draws[:, :1] * (block + demand.idle[:, None]), block)
    done = jnp.ceil(passed / jnp.where(headway > 0, headway, 1)).astype(jnp.int32)
    place = jnp.minimum(done, size) + jnp.arange(demand.arrivals, dtype=jnp.int32)[None]
    pause = jnp.where(place % size == 0, -jnp.log1p(-draws[:, 1:]) * demand.idle[:, None], 0)
    since = jnp.cumsum(pause, -1) + place.astype(headway.dtype) * headway - passed
    time = demand.begin[:, None] + since
    return jnp.where(time < demand.end[:, None], time, NEVER)


def _sample_queues(
    demand: Demand, key: Key[Array, ""]
) -> tuple[Float[Array, " V"], Int[Array, " V"], Int[Array, " V"], Int[Array, " V"]]:
    """Time, lane, place in the queue and stream of every row of the schedule."""
    time = _sample_arrivals(demand, key)[demand.row_stream, demand.row_arrival]
    time = jnp.where(demand.row_origin < demand.lane.shape[0], time, NEVER)
    origin, time, stream = lax.sort((demand.row_origin, time, demand.row_stream), num_keys=2)
    lane = demand.lane.at[origin].get(mode="fill", fill_value=NO_LANE)
    return time, lane, jnp.arange(time.shape[0], dtype=jnp.int32) - demand.start[origin], stream


def _sample_seats(demand: Demand, key: Key[Array, ""]) -> tuple[Int[Array, " M"], Float[Array, " M"]]:
    """Seats that are taken, and where in them (0..1)."""
    key = jax.random.fold_in(key, _SEATS)
    seats = demand.seat_weight.shape
    # weighted sampling without replacement: the largest sums of logarithm and Gumbel noise
    chance = demand.seat_weight + jax.random.gumbel(jax.random.fold_in(key, 0), seats)
    seat = lax.top_k(chance, demand.initial)[1] if demand.initial else jnp.zeros(0, jnp.int32)
    return seat, jax.random.uniform(jax.random.fold_in(key, 1), seats)[seat]


def _sample_roles(
    key: Key[Array, ""], number: Int[Array, " V"], goals: Float[Array, "V G"], types: Float[Array, "V Y"]
) -> tuple[Int[Array, " V"], Int[Array, " V"]]:
    """Goal and type of every vehicle, by cumulative shares."""
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, number)
    chance = jax.vmap(lambda k: jax.random.uniform(k, (2,)))(keys)
    goal, vehicle_type = (
        jnp.sum(chance[:, k, None] >= shares, -1, dtype=jnp.int32) for k, shares in enumerate((goals, types))
    )
    return goal, vehicle_type


def departure_place(
    lane_map: LaneMap, lane: Int[Array, " V"], length: Float[Array, " V"]
) -> Float[Array, " V"]:
    """Front bumper (m) of vehicles that enter where a lane starts: bodies on it, if it is long enough."""
    most = lane_map.length[lane]
    return jnp.minimum(length, jnp.maximum(most - 0.5, 0.5 * most))


def entry_speed(
    lane_map: LaneMap,
    driver: Driver,
    lane: Int[Array, " V"],
    s: Float[Array, " V"],
    goal: Int[Array, " V"],
) -> Float[Array, " V"]:
    """Speed (m/s) at which the road alone lets a vehicle start at `s` (m) of `lane` on its way to `goal`.

    At most what its driver wants here, and what braking with `b` brings down in time to the limits and
    bends of the next lanes, and to rest before a junction or the end of a lane that does not lead on.
    """
    here = lane_map.speed_limit[lane], curvature(lane_map, lane, s)
    speed = desired_speed(driver, *here)
    square = speed * speed
    brake = 2 * driver.b
    share = jnp.arange(1, _BEND_POINTS + 1, dtype=speed.dtype)[None] / _BEND_POINTS
    reach = jnp.minimum(square / brake, lane_map.length[lane] - s)
    bend = curvature(lane_map, lane[:, None], s[:, None] + reach[:, None] * share)
    slow = driver.a_lat[:, None] / jnp.maximum(jnp.abs(bend), 1e-6)
    square = jnp.minimum(square, (slow + (brake * reach)[:, None] * share).min(-1))
    start = -s
    for _ in range(_LOOK):
        after = lane_map.routes.next_lane[lane, goal]
        end = start + lane_map.length[lane]
        wall = (after == NO_LANE) & ~lane_map.routes.is_goal[lane, goal] & (lane != NO_LANE)
        stop = start + lane_map.stop_s[lane] - 1
        stop = jnp.where(lane_map.is_connector[after] & ~lane_map.is_connector[lane], stop, _FAR)
        stop = jnp.minimum(stop, jnp.where(wall, end - _WALL_ROOM, _FAR))
        square = jnp.minimum(square, brake * jnp.maximum(stop, 0))
        slow = jnp.minimum(
            driver.speed_factor * lane_map.speed_limit[after], bend_speed(lane_map, after, driver.a_lat)
        )
        slow = jnp.where(after == NO_LANE, _FAR, slow)
        square = jnp.minimum(square, slow * slow + brake * jnp.maximum(end, 0))
        lane, start = after, end
    return safe_sqrt(square)


def _start(
    demand: Demand,
    lane_map: LaneMap,
    slots: int,
    driver: Driver,
    shape: Shape,
    lane: Int[Array, " M"],
    s: Float[Array, " M"],
    free: Float[Array, " M"],
    goal: Int[Array, " M"],
) -> State:
    """The world before anybody enters; `free`: m/s on an empty road."""

    def fill(x: Array, empty: Any) -> Array:
        return jnp.concatenate([x, jnp.full(slots - x.shape[0], empty, x.dtype)])

    rest = typical_vehicles(demand.population, slots - lane.shape[0])
    driver, shape = jax.tree.map(lambda x, y: jnp.concatenate([x, y]), (driver, shape), rest)
    zero = jnp.zeros(slots, jnp.float32)
    lane, s, goal = fill(lane, NO_LANE), fill(s, 0), fill(goal, 0)
    state = start_state(lane_map, driver, shape, lane=lane, s=s, v=zero, goal=goal)
    queues = Queues(next=demand.start[:-1], full=jnp.int32(0))
    return replace(state, v=_start_speed(lane_map, state, fill(free, 0)), queues=queues)


def _start_speed(lane_map: LaneMap, state: State, free: Float[Array, " N"]) -> Float[Array, " N"]:
    """Speeds at which everybody can follow whoever is ahead, m/s, at most `free`."""
    order = sort_vehicles(lane_map, state)
    n = state.lane.shape[0]
    here = state.lane[:, None], state.s[:, None], order.rank[:n, None] + 1
    found = neighbors(_LOOK_CONFIG, lane_map, order, state, *here)
    lead, gap = found.lead[:, 0], found.lead_gap[:, 0]
    # From below: as the leader is at least that fast in the end, every speed on the way is safe.
    v = jnp.zeros_like(free)
    for _ in range(_SWEEPS):
        v = jnp.where(lead >= 0, jnp.minimum(free, safe_speed(state.driver, gap, v[lead])), free)
    return v


def typical_vehicles(population: Population, n: int) -> tuple[Driver, Shape]:
    """Medians of the first type of a population, `[n]`: harmless values for empty slots."""
    values = {name: jnp.full(n, population.median[0, k]) for k, name in enumerate(PARAMETERS)}
    body = {name: values.pop(name) for name in BODY}
    return Driver(**values), Shape(**body, vehicle_class=jnp.full(n, population.vehicle_class[0]))


def safe_speed(driver: Driver, gap: Float[Array, " N"], v_lead: Float[Array, " N"]) -> Float[Array, " N"]:
    """Speed (m/s) from which a driver who reacts after T and brakes with b keeps s0 behind the leader.

    Gipps (1981), Transp. Res. B 15, 105, eq. 8, for a leader that brakes as hard. At the leader's speed
    where the gap is s0 + v T.
    """
    bt = driver.b * driver.T
    square = bt * bt + v_lead * v_lead + 2 * driver.b * (gap - driver.s0)
    return jnp.maximum(safe_sqrt(square) - bt, 0)


def start_state(
    lane_map: LaneMap,
    driver: Driver,
    shape: Shape,
    *,
    lane: Int[Array, " N"],
    s: Float[Array, " N"],
    v: Float[Array, " N"],
    goal: Int[Array, " N"],
    active: Bool[Array, " N"] | None = None,
    origins: int = 0,
) -> State:
    """A world at its first moment: vehicles in the middle of their lanes, nobody changing lanes.

    Args:
      lane_map: where.
      driver: of every slot.
      shape: of every slot.
      lane: row of the lane; NO_LANE in empty slots.
      s: front bumper, m.
      v: m/s.
      goal: column of the route table.
      active: which slots hold a vehicle; all that have a lane by default.
      origins: number of queues that vehicles will enter from.
    """
    lane = jnp.asarray(lane, jnp.int32)
    n = lane.shape[0]
    zero, zeros, off = jnp.zeros(n, jnp.float32), jnp.zeros(n, jnp.int32), jnp.zeros(n, bool)
    programs = lane_map.signals.duration.shape[0]
    return State(
        step=jnp.int32(0),
        driver=driver,
        shape=shape,
        active=lane != NO_LANE if active is None else jnp.asarray(active),
        vehicle=zeros - 1,
        lane=lane,
        previous=zeros + NO_LANE,
        s=jnp.asarray(s, jnp.float32),
        d=zero,
        v=jnp.asarray(v, jnp.float32),
        a=zero,
        goal=jnp.asarray(goal, jnp.int32),
        side=zeros,
        crossed=off,
        progress=zero,
        shift=zero,
        rest=zero,
        waiting=zero,
        held=off,
        stopped=off,
        distance=zero,
        entered=zero,
        status=zeros,
        struck=zeros - 1,
        struck_at=zero,
        queues=Queues(next=jnp.zeros(origins, jnp.int32), full=jnp.int32(0)),
        lights=Lights(
            phase=jnp.zeros(programs, jnp.int32),
            elapsed=jnp.zeros(programs, jnp.float32),
            gap=jnp.zeros(programs, jnp.float32),
        ),
        egos=no_egos(),
    )


def no_egos() -> Egos:
    """Nobody is under test."""
    none = jnp.zeros(0, jnp.float32)
    return Egos(
        slot=jnp.zeros(0, jnp.int32),
        free=jnp.zeros(0, bool),
        x=none,
        y=none,
        heading=none,
        steering=none,
        a=none,
    )


# --- on the device: entering -------------------------------------------------------------------------


@jax.named_scope("enter")
def enter(config: Config, lane_map: LaneMap, schedule: Schedule, state: State) -> State:
    """Let the first of every queue in whose time has come, if there is room and a free slot.

    Call it once per decision, before `decide` looks around. Room is there if the leader, on the departure
    lane or along the route beyond it, leaves a gap of s0 + v T at the smaller of the speeds of both, and
    followers who come along their routes need not brake with more than b. The entry speed is at most
    `schedule.v` and `safe_speed`. Headways are not rounded to decisions: who could have entered since the
    last one stands further on accordingly. Who finds no room waits; who finds room but no slot is counted
    in `queues.full`, once per decision. Slots of egos stay free.

    Origins go in turn: when slots are short, when two would enter right behind one another, and when
    more than `AT_ONCE` have somebody whose time has come.
    """
    n, origins = state.lane.shape[0], state.queues.next.shape[0]
    if not origins:
        return state
    now = config.time(state.step)
    row = jnp.minimum(state.queues.next, schedule.time.shape[0] - 1)
    due = (state.queues.next < schedule.start[1:]) & (schedule.time[row] <= now)

    # those `P` that are due and next in turn
    number = jnp.arange(origins, dtype=jnp.int32)
    turn = (number + AT_ONCE * (state.step // config.decision_every)) % origins
    count = jnp.cumsum(due[turn], dtype=jnp.int32)
    place = jnp.arange(1, min(origins, AT_ONCE) + 1, dtype=jnp.int32)
    origin = turn[jnp.minimum(jnp.searchsorted(count, place), origins - 1)]
    row = row[origin]
    lane, s = schedule.lane[row], schedule.s[row]
    ahead, start = _lanes_ahead(config, lane_map, lane, s, schedule.goal[row])
    late = jnp.minimum(now - schedule.time[row], config.decision_time)
    room, shift, v = _room_ahead(config, lane_map, schedule, state, row, ahead, start, late)
    ready = (place <= count[-1]) & room & _room_behind(config, lane_map, schedule, state, row, v)

    # of those that would enter close to one another the first in turn
    meet = (ahead[:, :, None] == lane[None, None]).any(1)
    meet = (meet | meet.T) & (place[None] < place[:, None])
    ready &= ~(meet & ready[None]).any(1)

    # the free slot of rank r takes the entering vehicle of rank r
    slot = jnp.arange(n, dtype=jnp.int32)
    free = ~state.active & ~(slot[:, None] == state.egos.slot[None]).any(1)
    slot_rank, rank = (jnp.cumsum(x, dtype=jnp.int32) for x in (free, ready))
    enters = ready & (rank <= slot_rank[-1])
    match = free[:, None] & enters[None] & (slot_rank[:, None] == rank[None])  # [N, P]
    taken, which = match.any(1), jnp.argmax(match, 1)
    mine = row[which]
    pick = lambda x: x[mine]  # noqa: E731
    fresh = start_state(
        lane_map,
        jax.tree.map(pick, schedule.driver),
        jax.tree.map(pick, schedule.shape),
        lane=lane[which],
        s=(s + shift)[which],
        v=v[which],
        goal=pick(schedule.goal),
        active=taken,
    )
    fresh = replace(fresh, vehicle=mine, entered=jnp.full(n, now))
    world = {"step", "queues", "lights", "egos"}
    changed = {
        x.name: jax.tree.map(
            lambda new, old: jnp.where(taken, new, old), getattr(fresh, x.name), getattr(state, x.name)
        )
        for x in fields(State)
        if x.name not in world
    }
    gone = ((origin[:, None] == number[None]) & enters[:, None]).any(0)
    queues = Queues(
        next=state.queues.next + gone.astype(jnp.int32),
        full=state.queues.full + jnp.sum(ready & ~enters, dtype=jnp.int32),
    )
    return replace(state, queues=queues, **changed)


def delayed(schedule: Schedule, state: State, t: Float[Array, ""] | float) -> Int[Array, " O"]:
    """Vehicles per origin whose time has come at `t` (s) and that have not entered."""
    row = jnp.arange(schedule.time.shape[0], dtype=jnp.int32)
    waits = (
        (row[None] >= state.queues.next[:, None])
        & (row[None] < schedule.start[1:, None])
        & (schedule.time <= t)[None]
    )
    return jnp.sum(waits, 1, dtype=jnp.int32)


def _lanes_ahead(
    config: Config, lane_map: LaneMap, lane: Int[Array, " P"], s: Float[Array, " P"], goal: Int[Array, " P"]
) -> tuple[Int[Array, "P D"], Float[Array, "P D"]]:
    """Lanes from the departure lane on, and m from the front bumper to their starts."""
    lanes, starts = [lane], [-s]
    for _ in range(lanes_ahead(config, lane_map)):
        starts.append(starts[-1] + lane_map.length[lanes[-1]])
        lanes.append(lane_map.routes.next_lane[lanes[-1], goal])
    return jnp.stack(lanes, -1), jnp.stack(starts, -1)


def _room_ahead(
    config: Config,
    lane_map: LaneMap,
    schedule: Schedule,
    state: State,
    row: Int[Array, " P"],
    ahead: Int[Array, "P D"],
    start: Float[Array, "P D"],
    late: Float[Array, " P"],
) -> tuple[Bool[Array, " P"], Float[Array, " P"], Float[Array, " P"]]:
    """Whether leaders leave enough room; how far (m) beyond its place a vehicle enters, and how fast (m/s).

    It stands where it would be now had it entered up to `late` s ago, as far as leaders let it.
    """
    gap = jnp.full((row.shape[0], state.lane.shape[0]), _FAR)  # m to the rear of every vehicle
    # every vehicle on its lane, on the other one if it changes lanes, and on those that its tail is on
    behind = zip(*(x.T for x in tails(lane_map, state)), strict=True)
    for lane, front in ((state.lane, state.s), other_lane(lane_map, state), *behind):
        here = jnp.where(state.active & (lane != NO_LANE), lane, _NOWHERE)[None]
        rear = (front - state.shape.length)[None]
        beyond = front[None] > schedule.s[row, None]
        for k in range(ahead.shape[1]):
            there = (ahead[:, k, None] == here) & (beyond | (k > 0))
            gap = jnp.minimum(gap, jnp.where(there, start[:, k, None] + rear, _FAR))
    gap = jnp.where(gap < config.look_ahead, gap, _FAR)
    driver = jax.tree.map(lambda x: x[row, None], schedule.driver)
    wanted, speed = schedule.v[row, None], state.v[None]
    spare = jnp.min(gap - driver.s0 - driver.T * jnp.minimum(wanted, speed), 1)
    wanted, brake = schedule.v[row], 2 * schedule.driver.b[row]
    lane = schedule.lane[row]
    end = lane_map.stop_s[lane] - schedule.s[row] - wanted * wanted / brake  # can still stop on the lane
    shift = jnp.maximum(jnp.minimum(jnp.minimum(spare, end), wanted * late), 0)
    v = jnp.min(safe_speed(driver, gap - shift[:, None], speed), 1)
    return spare >= 0, shift, jnp.minimum(v, wanted)


def _room_behind(
    config: Config,
    lane_map: LaneMap,
    schedule: Schedule,
    state: State,
    row: Int[Array, " P"],
    v: Float[Array, " P"],
) -> Bool[Array, " P"]:
    """Whether those who come from behind can follow a vehicle that enters at `v` (m/s)."""
    driver = state.driver
    ahead = look_ahead(config, lane_map, state)
    other, other_s = other_lane(lane_map, state)
    ways = [(ahead.lane[:, k], ahead.start[:, k]) for k in range(ahead.lane.shape[1])]
    distance = jnp.full((row.shape[0], state.lane.shape[0]), _FAR)  # m from front bumper to front bumper
    for lane, start in [*ways, (other, -other_s)]:
        here = jnp.where(state.active & (lane != NO_LANE), lane, _NOWHERE)[None]
        way = start[None] + schedule.s[row, None]
        # a body that is only just beyond the place still covers it
        there = (here == schedule.lane[row, None]) & (way > -1)
        distance = jnp.minimum(distance, jnp.where(there, way, _FAR))
    gap = distance - schedule.shape.length[row, None]
    # own speed <= `safe_speed`, squared
    asks = state.v * (state.v + 2 * driver.b * driver.T) + 2 * driver.b * driver.s0
    follows = (gap >= _REAR_ROOM) & (asks[None] - 2 * driver.b[None] * gap <= (v * v)[:, None])
    return jnp.all(follows, 1)
