"""SUMO demand (`.rou.xml`, `.add.xml`, `.sumocfg`) as plain host records.

The format is the one of https://sumo.dlr.de/docs/Definition_of_Vehicles,_Vehicle_Types,_and_Routes.html.
Values stand as the files give them; nothing is drawn, routed or expanded here. What is not read is
counted in the report, and attributes without a field of their own are kept under `parameters`.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lxml import etree

from limsim_jax.maps.network import ImportReport, MapError, Network
from limsim_jax.maps.sumo import (
    DEMAND_ROOTS,
    ENGINE_CLASS,
    OLD_CLASSES,
    VEHICLE_CLASSES,
    XmlFile,
    parse_xml,
    stream_xml,
)

DEFAULT_TYPE = "DEFAULT_VEHTYPE"
"""Type of a vehicle that names none."""


@dataclass(frozen=True, kw_only=True)
class SpeedFactor:
    """Normal distribution of the factor on the speed limit, cut off at both ends."""

    mean: float = 1.0
    deviation: float = 0.1
    minimum: float = 0.2
    maximum: float = 2.0


@dataclass(frozen=True, kw_only=True)
class VehicleType:
    """A `<vType>`, with SUMO's defaults of its vehicle class for what the file leaves open."""

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
    apparent_decel: float  # m/s^2, what others take `decel` to be
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
    """A `<busStop>`, `<trainStop>`, `<containerStop>`, `<chargingStation>` or `<parkingArea>`."""

    id: str
    kind: str
    lane: str
    start_pos: float | None = None  # m
    end_pos: float | None = None  # m
    parameters: Mapping[str, str] = field(default_factory=dict)
    line: int | None = None


@dataclass(frozen=True, kw_only=True)
class Route:
    """A `<route>`: the edges in order. One inside a vehicle has the id of the vehicle behind a `!`."""

    id: str
    edges: tuple[str, ...]
    repeat: int = 0
    probability: float = 1.0
    stops: tuple[Stop, ...] = ()
    parameters: Mapping[str, str] = field(default_factory=dict)
    line: int | None = None


@dataclass(frozen=True, kw_only=True)
class Vehicle:
    """A `<vehicle>` (with a route), a `<trip>` (with origin and destination), or what a flow emits.

    Departure and arrival values are numbers or SUMO's words for how to choose one ("best", "random",
    "max", ...), as the file has them.
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
    """A `<flow>`: vehicles from `begin` to `end`, by the one of `number`, ... that is given.

    With `number` alone they are evenly spaced.
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
    """Everything that route and additional files say about vehicles, in file order."""

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


def read_demand(paths: str | Path | Iterable[str | Path], network: Network | None = None) -> Demand:
    """Read route and additional files, in the order in which SUMO would load them.

    Args:
      paths: one file or several that refer to one another, plain or gzipped.
      network: if given, every edge and lane that the demand names has to be in it.

    Raises:
      MapError: a file cannot be used, or refers to what does not exist; names file, line and element.
    """
    reader = _Reader()
    for path in [paths] if isinstance(paths, str | Path) else paths:
        reader.read(Path(path))
    return reader.demand(network)


def read_sumocfg(path: str | Path) -> SumoConfig:
    """Read which files a SUMO configuration loads, and for what time.

    Raises:
      MapError: the file cannot be used, names no network, or names files that do not exist.
    """
    report = ImportReport()
    xml, root, _ = parse_xml(path, ("configuration", "sumoConfiguration"), report)
    options: dict[str, tuple[str, Any]] = {}
    for element in root.iter():
        name = _OPTION_NAMES.get(element.tag)
        value = element.get("value", element.get("v"))
        if name is not None and value is not None:
            report.read(element.tag)
            options[name] = value, element
        elif value is not None:
            xml.ignore(element, "not an input of the simulation")
    missing: list[str] = []

    def files(name: str) -> tuple[Path, ...]:
        names = [part.strip() for part in re.split(r"[,;]", options[name][0])] if name in options else []
        found = tuple(Path(path).parent / part for part in names if part)
        missing.extend(str(file) for file in found if not file.is_file())
        return found

    def time(name: str, default: float | None) -> float | None:
        if name not in options:
            return default
        value = _time(xml, options[name][1], name, options[name][0])
        return default if value < 0 else value

    nets = files("net-file")
    routes, additional = files("route-files"), files("additional-files")
    if missing:
        raise MapError(f"it names files that do not exist: {', '.join(missing)}", file=str(path))
    if len(nets) != 1:
        raise MapError(f"it names {len(nets)} networks, not one (<net-file value=...>)", file=str(path))
    xml.summarise()
    return SumoConfig(
        network=nets[0],
        routes=routes,
        additional=additional,
        begin=time("begin", 0.0) or 0.0,
        end=time("end", None),
        step_length=time("step-length", 1.0) or 1.0,
        report=report,
    )


_OPTION_NAMES = {
    name: names[0]
    for names in (
        ("net-file", "net", "n"),
        ("route-files", "route", "r"),
        ("additional-files", "additional", "a"),
        ("begin", "b"),
        ("end", "e"),
        ("step-length",),
    )
    for name in names
}

# https://sumo.dlr.de/docs/Vehicle_Type_Parameter_Defaults.html: length, width, height, min_gap (m), accel,
# decel, emergency_decel (m/s^2), max_speed (km/h), sigma, deviation of the speed factor.
_DEFAULTS = {
    "passenger": (5.0, 1.8, 1.5, 2.5, 2.6, 4.5, 9.0, 200.0, 0.5, 0.1),  # and all that are not listed
    "taxi": (5.0, 1.8, 1.5, 2.5, 2.6, 4.5, 9.0, 200.0, 0.5, 0.05),
    "authority": (5.0, 1.8, 1.5, 2.5, 2.6, 4.5, 9.0, 200.0, 0.5, 0.0),
    "army": (5.0, 1.8, 1.5, 2.5, 2.6, 4.5, 9.0, 200.0, 0.5, 0.0),
    "ignoring": (5.0, 1.8, 1.5, 2.5, 2.6, 4.5, 9.0, 200.0, 0.5, 0.0),
    "emergency": (6.5, 2.16, 2.86, 2.5, 2.6, 4.5, 9.0, 200.0, 0.5, 0.0),
    "delivery": (6.5, 2.16, 2.86, 2.5, 2.6, 4.5, 9.0, 200.0, 0.5, 0.05),
    "truck": (7.1, 2.4, 2.4, 2.5, 1.3, 4.0, 7.0, 130.0, 0.5, 0.05),
    "trailer": (16.5, 2.55, 4.0, 2.5, 1.1, 4.0, 7.0, 130.0, 0.5, 0.05),
    "bus": (12.0, 2.5, 3.4, 2.5, 1.2, 4.0, 7.0, 100.0, 0.5, 0.0),
    "coach": (14.0, 2.6, 4.0, 2.5, 2.0, 4.0, 7.0, 100.0, 0.5, 0.05),
    "motorcycle": (2.2, 0.9, 1.5, 2.5, 6.0, 10.0, 10.0, 200.0, 0.5, 0.1),
    "moped": (2.1, 0.78, 1.7, 2.5, 1.1, 7.0, 10.0, 60.0, 0.5, 0.1),
    "bicycle": (1.6, 0.65, 1.7, 0.5, 1.2, 3.0, 7.0, 50.0, 0.5, 0.1),
    "scooter": (1.2, 0.5, 1.7, 0.5, 1.2, 3.0, 7.0, 25.0, 0.5, 0.1),
    "pedestrian": (0.215, 0.478, 1.719, 0.25, 1.5, 2.0, 5.0, 37.58, 0.5, 0.1),
    "wheelchair": (1.2, 0.72, 1.2, 0.5, 1.5, 2.0, 5.0, 30.0, 0.5, 0.1),
    "tram": (22.0, 2.4, 3.2, 2.5, 1.0, 3.0, 7.0, 80.0, 0.0, 0.0),
    "rail_urban": (109.5, 3.0, 3.6, 5.0, 1.0, 3.0, 7.0, 100.0, 0.0, 0.0),
    "subway": (109.5, 3.0, 3.6, 5.0, 2.6, 4.5, 9.0, 100.0, 0.5, 0.0),
    "rail": (135.0, 2.84, 3.75, 5.0, 0.25, 1.3, 5.0, 160.0, 0.0, 0.0),
    "rail_electric": (200.0, 2.95, 3.89, 5.0, 0.5, 1.3, 5.0, 220.0, 0.0, 0.0),
    "rail_fast": (200.0, 2.95, 3.89, 5.0, 0.5, 1.3, 5.0, 330.0, 0.0, 0.0),
    "ship": (17.0, 4.0, 4.0, 2.5, 0.1, 0.15, 1.0, 3.6 * 8 / 1.94, 0.0, 0.1),
    "container": (6.096, 2.438, 2.591, 2.5, 2.6, 4.5, 9.0, 200.0, 0.5, 0.0),
    "cable_car": (5.0, 1.8, 1.5, 2.5, 2.6, 4.5, 9.0, 200.0, 0.5, 0.0),
    "aircraft": (72.7, 79.8, 1.5, 2.5, 2.6, 4.5, 9.0, 200.0, 0.5, 0.0),
    "drone": (0.5, 0.5, 1.5, 2.5, 2.6, 4.5, 9.0, 200.0, 0.5, 0.0),
}


def _time(xml: XmlFile, element: Any, name: str, value: str) -> float:
    """Seconds, or [days:]hours:minutes:seconds."""
    parts = value.split(":")
    if len(parts) not in (1, 3, 4):
        raise xml.error(element, f"{name}='{value[:40]}' is neither seconds nor h:m:s nor d:h:m:s")
    numbers = [xml.parse_number(element, name, part) for part in parts]
    sign = -1.0 if parts[0].lstrip().startswith("-") else 1.0
    scales = (1.0, 60.0, 3600.0, 86400.0)
    return sign * sum(abs(n) * scale for n, scale in zip(reversed(numbers), scales, strict=False))


# What becomes of elements that are not demand of vehicles.
_IGNORED = {
    "person": "pedestrians and passengers are not simulated",
    "personFlow": "pedestrians and passengers are not simulated",
    "container": "containers are not simulated",
    "containerFlow": "containers are not simulated",
    "tlLogic": "a signal program: give the file to read_sumo(additional=...)",
}
_STOP_PLACES = ("busStop", "trainStop", "containerStop", "chargingStation", "parkingArea")
_MODEL_PREFIX = "carFollowing-"
_PREDEFINED = {
    DEFAULT_TYPE: "passenger",
    "DEFAULT_PEDTYPE": "pedestrian",
    "DEFAULT_BIKETYPE": "bicycle",
    "DEFAULT_TAXITYPE": "taxi",
    "DEFAULT_RAILTYPE": "rail",
    "DEFAULT_CONTAINERTYPE": "container",
}


class _Reader:
    def __init__(self) -> None:
        self.report = ImportReport()
        self.types: dict[str, VehicleType] = {}
        self.type_distributions: dict[str, Distribution] = {}
        self.routes: dict[str, Route] = {}
        self.route_distributions: dict[str, Distribution] = {}
        self.vehicles: dict[str, Vehicle] = {}
        self.flows: dict[str, Flow] = {}
        self.stop_places: dict[str, StopPlace] = {}
        self.open_files: list[Path] = []
        self.route_files: dict[str, str] = {}

    def read(self, path: Path) -> None:
        if path.resolve() in self.open_files:
            raise MapError("it includes itself", file=str(path))
        self.open_files.append(path.resolve())
        for xml, element in stream_xml(path, DEMAND_ROOTS, self.report):
            self._element(xml, element)
        self.open_files.pop()

    def _element(self, xml: XmlFile, element: Any) -> None:
        match element.tag:
            case "vType":
                self._type(xml, element)
            case "vTypeDistribution":
                self._type_distribution(xml, element)
            case "route":
                self._route(xml, element, xml.text(element, "id"))
            case "routeDistribution":
                self._route_distribution(xml, element, xml.text(element, "id"))
            case "vehicle" | "trip":
                vehicle = self._vehicle(xml, element, self._time(xml, element, "depart"))
                self._new(xml, element, vehicle.id, self.vehicles, self.flows)
                self.vehicles[vehicle.id] = vehicle
            case "flow":
                self._flow(xml, element, 0.0, None)
            case "interval":
                begin = _time(xml, element, "begin", xml.text(element, "begin"))
                end = _time(xml, element, "end", xml.text(element, "end"))
                self.report.read("interval")
                for child in element:
                    if child.tag == "flow":
                        self._flow(xml, child, begin, end)
                    else:
                        xml.ignore(child, "not used within <interval>")
            case "include":
                self.report.read("include")
                self.read(Path(xml.path).parent / xml.text(element, "href"))
            case tag if tag in _STOP_PLACES:
                self._stop_place(xml, element)
            case tag:
                xml.ignore(element, _IGNORED.get(tag, "not demand of vehicles"))

    def _new(self, xml: XmlFile, element: Any, name: str, *tables: Mapping[str, Any]) -> None:
        """Raise `MapError` if an id is taken."""
        if any(name in table for table in tables):
            raise xml.error(element, f"its id '{name}' is taken")

    def _rest(self, xml: XmlFile, element: Any) -> dict[str, str]:
        """Attributes without a field of their own, and `<param>` children."""
        rest = {name: value for name, value in element.attrib.items() if name not in xml.known[element.tag]}
        for child in element:
            if child.tag == "param":
                rest[xml.text(child, "key")] = xml.text(child, "value", "")
                self.report.read("param")
        return rest

    def _time(self, xml: XmlFile, element: Any, name: str) -> float | str:
        value = xml.text(element, name)
        return value if value[:1].isalpha() else _time(xml, element, name, value)

    def _weight(self, xml: XmlFile, element: Any) -> float:
        return xml.number(element, "probability", 1.0, minimum=0.0)

    # ---- vehicle types

    def _type(self, xml: XmlFile, element: Any) -> str:
        name = xml.text(element, "id")
        self._new(xml, element, name, self.types, self.type_distributions)
        self.types[name] = self._vehicle_type(xml, element)
        for child in element:
            if child.tag.startswith(_MODEL_PREFIX):
                self.report.read(child.tag)
            elif child.tag != "param":
                xml.ignore(child, "not used within <vType>")
        self.report.read("vType")
        return name

    def _vehicle_type(self, xml: XmlFile, element: Any) -> VehicleType:
        models = [child for child in element if str(child.tag).startswith(_MODEL_PREFIX)]
        for child in models:  # the old way to give parameters of the car-following model
            for key, value in child.attrib.items():
                element.set(key, value)
            element.set("carFollowModel", child.tag.removeprefix(_MODEL_PREFIX))
        vehicle_class = xml.text(element, "vClass", "passenger")
        vehicle_class = OLD_CLASSES.get(vehicle_class, vehicle_class)
        if vehicle_class not in VEHICLE_CLASSES | {"ignoring"}:
            raise xml.error(element, f"vClass='{vehicle_class[:40]}' is unknown")
        defaults = _DEFAULTS.get(vehicle_class, _DEFAULTS["passenger"])
        length, width, height, min_gap, accel, decel, emergency_decel, max_speed, sigma, deviation = defaults

        def number(attribute: str, value: float, minimum: float = 0.0) -> float:
            return xml.number(element, attribute, value, minimum=minimum)

        decel = number("decel", decel)
        tiny = 1e-9  # these divide
        return VehicleType(
            id=xml.text(element, "id"),
            vehicle_class=vehicle_class,
            engine_class=ENGINE_CLASS.get(vehicle_class),
            model=xml.text(element, "carFollowModel", "Krauss"),
            length=number("length", length, tiny),
            width=number("width", width, tiny),
            height=number("height", height),
            min_gap=number("minGap", min_gap),
            accel=number("accel", accel, tiny),
            decel=decel,
            emergency_decel=number("emergencyDecel", max(decel, emergency_decel)),
            apparent_decel=number("apparentDecel", decel),
            max_speed=number("maxSpeed", max_speed / 3.6, tiny),
            tau=number("tau", 1.0),
            sigma=number("sigma", sigma),
            speed_factor=self._speed_factor(xml, element, deviation),
            probability=self._weight(xml, element),
            parameters=self._rest(xml, element),
            line=element.sourceline,
        )

    def _speed_factor(self, xml: XmlFile, element: Any, deviation: float) -> SpeedFactor:
        text = xml.text(element, "speedFactor", "1").strip()
        deviation = xml.number(element, "speedDev", deviation, minimum=0.0)
        given = re.fullmatch(r"(norm|normc)\(([^()]*)\)", text)
        if given is None:
            return SpeedFactor(mean=xml.parse_number(element, "speedFactor", text, 0.0), deviation=deviation)
        numbers = [xml.parse_number(element, "speedFactor", part) for part in given[2].split(",")]
        if not 2 <= len(numbers) <= 4 or (given[1] == "norm" and len(numbers) != 2):
            raise xml.error(element, f"speedFactor='{text[:40]}' has {len(numbers)} parameters")
        if numbers[1] < 0:
            raise xml.error(element, f"speedFactor='{text[:40]}' has a negative deviation")
        bounds = [0.2, 2.0] if given[1] == "normc" else [-math.inf, math.inf]
        bounds[: len(numbers) - 2] = numbers[2:]
        if bounds[0] > bounds[1]:
            raise xml.error(element, f"speedFactor='{text[:40]}' has its bounds the wrong way round")
        return SpeedFactor(mean=numbers[0], deviation=numbers[1], minimum=bounds[0], maximum=bounds[1])

    def _type_distribution(self, xml: XmlFile, element: Any) -> None:
        name = xml.text(element, "id")
        self._new(xml, element, name, self.types, self.type_distributions)
        members = []
        for child in element:
            if child.tag != "vType":
                xml.ignore(child, "not used within <vTypeDistribution>")
            elif "refId" in child.attrib:
                members.append((xml.text(child, "refId"), self._weight(xml, child)))
                self.report.read("vType")
            else:
                added = self._type(xml, child)
                members.append((added, self.types[added].probability))
        members += self._listed(xml, element, "vTypes", {n: t.probability for n, t in self.types.items()})
        self.type_distributions[name] = self._distribution(xml, element, name, members)

    def _listed(
        self, xml: XmlFile, element: Any, attribute: str, known: dict[str, float]
    ) -> list[tuple[str, float]]:
        """Members by reference: `vTypes="a b" probabilities="1 2"`."""
        names = xml.text(element, attribute, "").replace(",", " ").split()
        texts = xml.text(element, "probabilities", "").replace(",", " ").split()
        weights = [xml.parse_number(element, "probabilities", text, 0.0) for text in texts]
        if weights and len(weights) != len(names):
            raise xml.error(element, f"{len(weights)} probabilities for {len(names)} {attribute}")
        for member in names:
            if member not in known:
                raise xml.error(element, f"{attribute} names '{member}', which is not defined before it")
        return list(zip(names, weights or [known[name] for name in names], strict=True))

    def _distribution(
        self, xml: XmlFile, element: Any, name: str, members: list[tuple[str, float]]
    ) -> Distribution:
        if not members:
            raise xml.error(element, "the distribution is empty")
        if not sum(weight for _, weight in members) > 0:
            raise xml.error(element, "its probabilities add up to 0")
        xml.count_unused(element)
        self.report.read(element.tag)
        ids, weights = zip(*members, strict=True)
        return Distribution(id=name, members=ids, weights=weights, line=element.sourceline)

    # ---- routes and stops

    def _route(self, xml: XmlFile, element: Any, name: str) -> str:
        self._new(xml, element, name, self.routes, self.route_distributions)
        xml.text(element, "id", None)
        edges = tuple(xml.text(element, "edges").replace(",", " ").split())
        if not edges:
            raise xml.error(element, f"route '{name}' has no edges")
        repeat = xml.integer(element, "repeat", 0)
        weight = self._weight(xml, element)
        self.routes[name] = Route(
            id=name,
            edges=edges,
            repeat=repeat,
            probability=weight,
            stops=self._stops(xml, element),
            parameters=self._rest(xml, element),
            line=element.sourceline,
        )
        self.route_files[name] = xml.path
        self._children(xml, element, "stop", "param")
        self.report.read("route")
        return name

    def _route_distribution(self, xml: XmlFile, element: Any, name: str) -> str:
        self._new(xml, element, name, self.routes, self.route_distributions)
        xml.text(element, "id", None)
        members = []
        for i, child in enumerate(element):
            if child.tag != "route":
                xml.ignore(child, "not used within <routeDistribution>")
            elif "refId" in child.attrib:
                target = xml.text(child, "refId")
                if target not in self.routes:
                    raise xml.error(element, f"it names route '{target}', which is not defined before it")
                default = self.routes[target].probability
                members.append((target, xml.number(child, "probability", default, minimum=0.0)))
                self.report.read("route")
            else:
                added = self._route(xml, child, child.get("id") or f"{name}#{i}")
                members.append((added, self.routes[added].probability))
        members += self._listed(xml, element, "routes", {n: r.probability for n, r in self.routes.items()})
        xml.text(element, "last", None)  # which alternative the router chose
        self.route_distributions[name] = self._distribution(xml, element, name, members)
        return name

    def _stops(self, xml: XmlFile, element: Any) -> tuple[Stop, ...]:
        return tuple(self._stop(xml, child) for child in element if child.tag == "stop")

    def _stop(self, xml: XmlFile, element: Any) -> Stop:
        def time(name: str) -> float | None:
            value = xml.text(element, name, None)
            return None if value is None else _time(xml, element, name, value)

        places = [xml.text(element, name, None) for name in _STOP_PLACES]
        stop = Stop(
            place=next((place for place in places if place), None),
            lane=xml.text(element, "lane", None),
            edge=xml.text(element, "edge", None),
            start_pos=xml.number(element, "startPos", None),
            end_pos=xml.number(element, "endPos", None),
            duration=time("duration"),
            until=time("until"),
            parameters=self._rest(xml, element),
            line=element.sourceline,
        )
        if stop.place is None and stop.lane is None and stop.edge is None:
            message = "says neither stopping place, lane nor edge; kept with its parameters"
            self.report.approximated("stop", element.getparent().get("id", ""), message, element.sourceline)
        else:
            self.report.read("stop")
        self._children(xml, element, "param")
        return stop

    def _stop_place(self, xml: XmlFile, element: Any) -> None:
        name = xml.text(element, "id")
        self._new(xml, element, name, self.stop_places)
        self.stop_places[name] = StopPlace(
            id=name,
            kind=element.tag,
            lane=xml.text(element, "lane"),
            start_pos=xml.number(element, "startPos", None),
            end_pos=xml.number(element, "endPos", None),
            parameters=self._rest(xml, element),
            line=element.sourceline,
        )
        self._children(xml, element, "param")
        self.report.read(element.tag)

    # ---- vehicles

    def _vehicle(self, xml: XmlFile, element: Any, depart: float | str) -> Vehicle:
        name = xml.text(element, "id")

        def typed(attribute: str, default: Any, kind: type = float) -> Any:
            value = xml.text(element, attribute, None)
            if value is None:
                return default
            if value[:1].isalpha() and value.lower() not in {"nan", "inf", "infinity"}:
                return value
            return xml.integer(element, attribute) if kind is int else xml.number(element, attribute)

        stops = self._stops(xml, element)
        route = xml.text(element, "route", None)
        inline = [child for child in element if child.tag in ("route", "routeDistribution")]
        if len(inline) + (route is not None) > 1:
            raise xml.error(element, "it has more than one route")
        for child in inline:
            read = self._route if child.tag == "route" else self._route_distribution
            route = read(xml, child, f"!{name}")
        origin, destination = xml.text(element, "from", None), xml.text(element, "to", None)
        vehicle = Vehicle(
            id=name,
            type=xml.text(element, "type", DEFAULT_TYPE),
            depart=depart,
            route=route,
            origin=origin,
            destination=destination,
            via=tuple(xml.text(element, "via", "").replace(",", " ").split()),
            depart_lane=typed("departLane", "first", int),
            depart_pos=typed("departPos", "base"),
            depart_pos_lat=typed("departPosLat", "center"),
            depart_speed=typed("departSpeed", 0.0),
            arrival_lane=typed("arrivalLane", "current", int),
            arrival_pos=typed("arrivalPos", "max"),
            arrival_speed=typed("arrivalSpeed", "current"),
            stops=stops,
            speed_factor=xml.number(element, "speedFactor", None, minimum=0.0),
            parameters=self._rest(xml, element),
            file=xml.path,
            line=element.sourceline,
        )
        self._children(xml, element, "route", "routeDistribution", "stop", "param")
        if route is not None or (origin is not None and destination is not None):
            self.report.read(element.tag)
        elif any(key.startswith(("from", "to")) for key in vehicle.parameters):
            message = "origin or destination is no edge; kept with its parameters, to be resolved by a router"
            self.report.approximated(element.tag, name, message, element.sourceline)
        else:
            raise xml.error(element, "it has neither a route nor an origin and a destination")
        return vehicle

    def _flow(self, xml: XmlFile, element: Any, begin: float, end: float | None) -> None:
        def positive(attribute: str) -> float | None:
            return xml.number(element, attribute, None, minimum=0.0)

        if (text := xml.text(element, "begin", None)) is not None:
            begin = _time(xml, element, "begin", text)
        if (text := xml.text(element, "end", None)) is not None:
            end = _time(xml, element, "end", text)
        if end is not None and end < begin:
            raise xml.error(element, f"it ends at {end:g} s, before it begins at {begin:g} s")
        number = xml.integer(element, "number", None)
        period, rate = None, None
        if (text := xml.text(element, "period", None)) is not None:
            if given := re.fullmatch(r"\s*exp\(([^()]*)\)\s*", text):
                rate = xml.parse_number(element, "period", given[1], 0.0)
            else:
                period = xml.parse_number(element, "period", text, 0.0)
        per_hour = positive("vehsPerHour")
        if per_hour is None:
            per_hour = positive("perHour")
        else:
            xml.text(element, "perHour", None)
        probability = positive("probability")
        if probability is not None and probability > 1:
            raise xml.error(element, f"probability {probability:g} is above 1")
        rates = [x for x in (period, rate, per_hour, probability) if x is not None]
        if len(rates) > 1:
            raise xml.error(element, "it has more than one of period, vehsPerHour, probability")
        if not rates and number is None:
            raise xml.error(element, "it has none of number, period, vehsPerHour, probability")
        if number is not None and number < 0:
            raise xml.error(element, "number is negative")
        vehicle = self._vehicle(xml, element, begin)
        self._new(xml, element, vehicle.id, self.flows, self.vehicles)
        self.flows[vehicle.id] = Flow(
            vehicle=vehicle,
            begin=begin,
            end=end,
            number=number,
            period=period,
            vehicles_per_hour=per_hour,
            probability=probability,
            poisson_rate=rate,
        )

    def _children(self, xml: XmlFile, element: Any, *used: str) -> None:
        for child in element:
            if child.tag not in used:
                xml.ignore(child, f"not used within <{element.tag}>")

    # ---- the whole

    def demand(self, network: Network | None) -> Demand:
        self._check_types()
        self._check_routes()
        if network is not None:
            self._check_network(network)
        return Demand(
            types=self.types,
            type_distributions=self.type_distributions,
            routes=self.routes,
            route_distributions=self.route_distributions,
            vehicles=self.vehicles,
            flows=self.flows,
            stop_places=self.stop_places,
            report=self.report,
        )

    def _all(self) -> list[tuple[str, Vehicle]]:
        emitted = [("flow", flow.vehicle) for flow in self.flows.values()]
        return [("vehicle", vehicle) for vehicle in self.vehicles.values()] + emitted

    def _check_types(self) -> None:
        """Add the predefined types that are used; report those that no file defines."""
        wanted = Counter(vehicle.type for _, vehicle in self._all())
        wanted.update(member for d in self.type_distributions.values() for member in d.members)
        for name, count in wanted.items():
            if name in self.types or name in self.type_distributions:
                continue
            if name in _PREDEFINED:
                element = etree.Element("vType", id=name, vClass=_PREDEFINED[name])
                self.types[name] = self._vehicle_type(XmlFile("", ImportReport()), element)
            else:
                message = f"used {count} times, but none of the files defines it"
                self.report.approximated("vType", name, message)

    def _check_routes(self) -> None:
        for kind, vehicle in self._all():
            known = vehicle.route in self.routes or vehicle.route in self.route_distributions
            if vehicle.route is not None and not known:
                message = f"there is no route '{vehicle.route}'"
                raise MapError(message, file=vehicle.file, line=vehicle.line, element=f"{kind} {vehicle.id}")

    def _check_network(self, network: Network) -> None:
        """Every edge and lane that is named has to be in the network."""
        good: set[str] = set()  # routes checked

        def check_route(name: str, who: str, file: str, line: int | None) -> None:
            if name in good:
                return
            good.add(name)
            if name in self.route_distributions:
                for member in self.route_distributions[name].members:
                    check_route(member, who, file, line)
                return
            route = self.routes[name]
            check_edges(route.edges, f" of route '{name}'", who, file, line)
            check_stops(route.stops, who, file)

        def check_edges(edges: Iterable[str], what: str, who: str, file: str, line: int | None) -> None:
            for edge in edges:
                if edge not in network.roads:
                    message = f"edge '{edge}'{what} is not in network {network.source}"
                    raise MapError(message, file=file, line=line, element=who)

        def check_stops(stops: Iterable[Stop], who: str, file: str) -> None:
            for stop in stops:
                if stop.lane is not None and stop.lane not in network.lanes:
                    message = f"lane '{stop.lane}' of a stop is not in network {network.source}"
                    raise MapError(message, file=file, line=stop.line, element=who)
                if stop.edge is not None:
                    check_edges([stop.edge], " of a stop", who, file, stop.line)
                if stop.place is not None and stop.place not in self.stop_places:
                    message = f"stopping place '{stop.place}' is not in the files"
                    self.report.approximated("stop", who, message, stop.line)

        for kind, vehicle in self._all():
            who = f"{kind} {vehicle.id}"
            if vehicle.route is not None:
                check_route(vehicle.route, who, vehicle.file, vehicle.line)
            ends = (vehicle.origin, *vehicle.via, vehicle.destination)
            check_edges((e for e in ends if e is not None), "", who, vehicle.file, vehicle.line)
            check_stops(vehicle.stops, who, vehicle.file)
        for name, route in self.routes.items():
            check_route(name, f"route {name}", self.route_files[name], route.line)
        for place in self.stop_places.values():
            if place.lane not in network.lanes:
                message = f"its lane '{place.lane}' is not in network {network.source}"
                raise MapError(message, line=place.line, element=f"{place.kind} {place.id}")
