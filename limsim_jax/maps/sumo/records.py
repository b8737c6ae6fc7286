"""SUMO's demand as plain host records.

Values are those of the files; nothing is drawn, routed or expanded here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from limsim_jax.maps.network import ImportReport

DEFAULT_TYPE = "DEFAULT_VEHTYPE"
"""Type of a vehicle that names none."""


@dataclass(frozen=True, kw_only=True)
class SpeedFactor:
    """Truncated normal distribution of the factor on the speed limit."""

    mean: float = 1.0
    deviation: float = 0.1
    minimum: float = 0.2
    maximum: float = 2.0


@dataclass(frozen=True, kw_only=True)
class VehicleType:
    """A `<vType>`, with SUMO's defaults of its vehicle class."""

    id: str
    vehicle_class: str = "passenger"  # SUMO's abstract vehicle class
    engine_class: str | None = "car"  # class of the engine; None: no motor vehicle on roads
    model: str = "Krauss"  # car-following model
    length: float  # m
    width: float  # m
    height: float  # m
    min_gap: float  # m
    accel: float  # m/s^2
    decel: float  # m/s^2
    emergency_decel: float  # m/s^2
    apparent_decel: float  # m/s^2, `decel` as other vehicles estimate it
    max_speed: float  # m/s
    tau: float = 1.0  # s
    sigma: float = 0.5  # driver imperfection of Krauss' model
    speed_factor: SpeedFactor
    probability: float = 1.0  # weight within a distribution
    parameters: Mapping[str, str] = field(default_factory=dict)  # all other attributes, as they stand
    line: int | None = None


@dataclass(frozen=True, kw_only=True)
class Distribution:
    """A `<vTypeDistribution>` or `<routeDistribution>`: ids to draw from."""

    id: str
    members: tuple[str, ...]
    weights: tuple[float, ...]  # not normalised
    line: int | None = None


@dataclass(frozen=True, kw_only=True)
class Stop:
    """A `<stop>`: at a stopping place, or on a lane or edge."""

    place: str | None = None  # id of a stopping place
    lane: str | None = None
    edge: str | None = None
    start_pos: float | None = None  # m from the start of the lane, or from its end if negative
    end_pos: float | None = None  # m
    duration: float | None = None  # s
    until: float | None = None  # s
    parameters: Mapping[str, str] = field(default_factory=dict)
    line: int | None = None


@dataclass(frozen=True, kw_only=True)
class StopPlace:
    """A `<busStop>`, `<parkingArea>` or another stopping place."""

    id: str
    kind: str
    lane: str
    start_pos: float | None = None  # m
    end_pos: float | None = None  # m
    parameters: Mapping[str, str] = field(default_factory=dict)
    line: int | None = None


@dataclass(frozen=True, kw_only=True)
class Route:
    """A `<route>`: the edges in order.

    A route inside a vehicle has the id of the vehicle behind a `!`.
    """

    id: str
    edges: tuple[str, ...]
    repeat: int = 0
    probability: float = 1.0
    stops: tuple[Stop, ...] = ()
    parameters: Mapping[str, str] = field(default_factory=dict)
    file: str = ""
    line: int | None = None


@dataclass(frozen=True, kw_only=True)
class Vehicle:
    """A `<vehicle>`, a `<trip>`, or what a flow emits.

    Vehicles have a route, trips an origin and a destination. Departure and arrival values are numbers or
    SUMO's words for how to choose one ("best", "random", "max", ...), as the file has them.
    """

    id: str
    type: str = DEFAULT_TYPE  # id of a vehicle type or of a distribution of them
    depart: float | str = 0.0  # s
    route: str | None = None  # id of a route or of a distribution of them
    origin: str | None = None  # edge
    destination: str | None = None  # edge
    via: tuple[str, ...] = ()  # edges
    depart_lane: int | str = "first"
    depart_pos: float | str = "base"  # m
    depart_pos_lat: float | str = "center"  # m
    depart_speed: float | str = 0.0  # m/s
    arrival_lane: int | str = "current"
    arrival_pos: float | str = "max"  # m
    arrival_speed: float | str = "current"  # m/s
    stops: tuple[Stop, ...] = ()
    speed_factor: float | None = None
    parameters: Mapping[str, str] = field(default_factory=dict)
    file: str = ""
    line: int | None = None


@dataclass(frozen=True, kw_only=True)
class Flow:
    """A `<flow>`: vehicles from `begin` to `end`.

    One of `number`, `period` and the fields below it is given. With `number` alone they are evenly spaced.
    """

    vehicle: Vehicle  # what it emits; `depart` is `begin`
    begin: float = 0.0  # s
    end: float | None = None  # s; None: until the simulation ends
    number: int | None = None
    period: float | None = None  # s between vehicles
    vehicles_per_hour: float | None = None
    probability: float | None = None  # of a vehicle in each second
    poisson_rate: float | None = None  # 1/s, of exponentially distributed gaps: period="exp(rate)"


@dataclass(frozen=True, kw_only=True, eq=False)
class Demand:
    """All content of route and additional files, in file order."""

    types: dict[str, VehicleType] = field(default_factory=dict)
    type_distributions: dict[str, Distribution] = field(default_factory=dict)
    routes: dict[str, Route] = field(default_factory=dict)
    route_distributions: dict[str, Distribution] = field(default_factory=dict)
    vehicles: dict[str, Vehicle] = field(default_factory=dict)  # vehicles and trips
    flows: dict[str, Flow] = field(default_factory=dict)
    stop_places: dict[str, StopPlace] = field(default_factory=dict)
    report: ImportReport = field(default_factory=ImportReport)


@dataclass(frozen=True, kw_only=True)
class SumoConfig:
    """The inputs that a `.sumocfg` names, as paths that exist."""

    network: Path
    routes: tuple[Path, ...] = ()
    additional: tuple[Path, ...] = ()
    begin: float = 0.0  # s
    end: float | None = None  # s
    step_length: float = 1.0  # s
    report: ImportReport = field(default_factory=ImportReport)
