"""SUMO demand (`.rou.xml`, `.add.xml`) as plain host records.

The format is the one of https://sumo.dlr.de/docs/Definition_of_Vehicles,_Vehicle_Types,_and_Routes.html.
What is not read is counted in the report, and attributes without a field of their own are kept under
`parameters`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from limsim_jax.maps.network import MapError, Network
from limsim_jax.maps.sumo.checks import check_network, check_routes, check_types
from limsim_jax.maps.sumo.programs import DEMAND_ROOTS
from limsim_jax.maps.sumo.records import (
    DEFAULT_TYPE,
    Demand,
    Distribution,
    Flow,
    Route,
    Stop,
    StopPlace,
    Vehicle,
)
from limsim_jax.maps.sumo.vehicle_types import MODEL_PREFIX, parameters, parse_time, read_vehicle_type, weight
from limsim_jax.maps.xml import Element, XmlReader, read_bytes


def read_demand(paths: str | Path | Iterable[str | Path], network: Network | None = None) -> Demand:
    """Read route and additional files, in the order of SUMO's options.

    Args:
      paths: one file or several that refer to one another, plain or gzipped.
      network: if given, it must have every edge and lane that the demand names.

    Raises:
      MapError: a file cannot be used, or refers to a missing part; names file, line and element.
    """
    reader = _Reader()
    for path in [paths] if isinstance(paths, str | Path) else paths:
        reader.read(Path(path))
    demand = reader.demand
    check_types(demand)
    check_routes(demand)
    if network is not None:
        check_network(demand, network)
    return demand


_IGNORED = {
    "person": "pedestrians and passengers are not simulated",
    "personFlow": "pedestrians and passengers are not simulated",
    "container": "containers are not simulated",
    "containerFlow": "containers are not simulated",
    "tlLogic": "a signal program: give the file to read_sumo(additional=...)",
}
_STOP_PLACES = ("busStop", "trainStop", "containerStop", "chargingStation", "parkingArea")


class _Reader:
    def __init__(self) -> None:
        self.demand = Demand()
        self.report = self.demand.report
        self.open_files: list[Path] = []

    def read(self, path: Path) -> None:
        if path.resolve() in self.open_files:
            raise MapError("it includes itself", file=str(path))
        self.open_files.append(path.resolve())
        xml = XmlReader(path)
        for _, element in xml.children(read_bytes(path), *DEMAND_ROOTS):
            self._element(xml, element)
        xml.ignored.summarise(self.report)
        self.open_files.pop()

    def _element(self, xml: XmlReader, element: Element) -> None:
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
                self._new(xml, element, vehicle.id, self.demand.vehicles, self.demand.flows)
                self.demand.vehicles[vehicle.id] = vehicle
            case "flow":
                self._flow(xml, element, 0.0, None)
            case "interval":
                begin = parse_time(xml, element, "begin", xml.text(element, "begin"))
                end = parse_time(xml, element, "end", xml.text(element, "end"))
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

    def _new(self, xml: XmlReader, element: Element, name: str, *tables: Mapping[str, Any]) -> None:
        """Raise `MapError` if an id is taken."""
        if any(name in table for table in tables):
            raise xml.error(element, f"its id '{name}' is taken")

    def _time(self, xml: XmlReader, element: Element, name: str) -> float | str:
        value = xml.text(element, name)
        return value if value[:1].isalpha() else parse_time(xml, element, name, value)

    # ---- vehicle types

    def _type(self, xml: XmlReader, element: Element) -> str:
        name = xml.text(element, "id")
        self._new(xml, element, name, self.demand.types, self.demand.type_distributions)
        self.demand.types[name] = read_vehicle_type(xml, element, self.report)
        for child in element:
            if child.tag.startswith(MODEL_PREFIX):
                self.report.read(child.tag)
            elif child.tag != "param":
                xml.ignore(child, "not used within <vType>")
        self.report.read("vType")
        return name

    def _type_distribution(self, xml: XmlReader, element: Element) -> None:
        name = xml.text(element, "id")
        self._new(xml, element, name, self.demand.types, self.demand.type_distributions)
        members = []
        for child in element:
            if child.tag != "vType":
                xml.ignore(child, "not used within <vTypeDistribution>")
            elif "refId" in child.attrib:
                members.append((xml.text(child, "refId"), weight(xml, child)))
                self.report.read("vType")
            else:
                added = self._type(xml, child)
                members.append((added, self.demand.types[added].probability))
        known = {n: kind.probability for n, kind in self.demand.types.items()}
        members += self._listed(xml, element, "vTypes", known)
        self.demand.type_distributions[name] = self._distribution(xml, element, name, members)

    def _listed(
        self, xml: XmlReader, element: Element, attribute: str, known: dict[str, float]
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
        self, xml: XmlReader, element: Element, name: str, members: list[tuple[str, float]]
    ) -> Distribution:
        if not members:
            raise xml.error(element, "the distribution is empty")
        if not sum(weight for _, weight in members) > 0:
            raise xml.error(element, "its probabilities add up to 0")
        xml.ignore_unasked(element)
        self.report.read(element.tag)
        ids, weights = zip(*members, strict=True)
        return Distribution(id=name, members=ids, weights=weights, line=element.sourceline)

    # ---- routes and stops

    def _route(self, xml: XmlReader, element: Element, name: str) -> str:
        self._new(xml, element, name, self.demand.routes, self.demand.route_distributions)
        xml.text(element, "id", None)
        edges = tuple(xml.text(element, "edges").replace(",", " ").split())
        if not edges:
            raise xml.error(element, f"route '{name}' has no edges")
        repeat = xml.integer(element, "repeat", 0)
        self.demand.routes[name] = Route(
            id=name,
            edges=edges,
            repeat=repeat,
            probability=weight(xml, element),
            stops=self._stops(xml, element),
            parameters=parameters(xml, element, self.report),
            file=str(xml.path),
            line=element.sourceline,
        )
        xml.ignore_children(element, "stop", "param")
        self.report.read("route")
        return name

    def _route_distribution(self, xml: XmlReader, element: Element, name: str) -> str:
        self._new(xml, element, name, self.demand.routes, self.demand.route_distributions)
        xml.text(element, "id", None)
        members = []
        for i, child in enumerate(element):
            if child.tag != "route":
                xml.ignore(child, "not used within <routeDistribution>")
            elif "refId" in child.attrib:
                target = xml.text(child, "refId")
                if target not in self.demand.routes:
                    raise xml.error(element, f"it names route '{target}', which is not defined before it")
                default = self.demand.routes[target].probability
                members.append((target, xml.number(child, "probability", default, minimum=0.0)))
                self.report.read("route")
            else:
                added = self._route(xml, child, xml.text(child, "id", None) or f"{name}#{i}")
                members.append((added, self.demand.routes[added].probability))
        known = {n: route.probability for n, route in self.demand.routes.items()}
        members += self._listed(xml, element, "routes", known)
        xml.text(element, "last", None)  # which alternative the router chose
        self.demand.route_distributions[name] = self._distribution(xml, element, name, members)
        return name

    def _stops(self, xml: XmlReader, element: Element) -> tuple[Stop, ...]:
        return tuple(self._stop(xml, child) for child in element if child.tag == "stop")

    def _stop(self, xml: XmlReader, element: Element) -> Stop:
        def time(name: str) -> float | None:
            value = xml.text(element, name, None)
            return None if value is None else parse_time(xml, element, name, value)

        places = [xml.text(element, name, None) for name in _STOP_PLACES]
        stop = Stop(
            place=next((place for place in places if place), None),
            lane=xml.text(element, "lane", None),
            edge=xml.text(element, "edge", None),
            start_pos=xml.number(element, "startPos", None),
            end_pos=xml.number(element, "endPos", None),
            duration=time("duration"),
            until=time("until"),
            parameters=parameters(xml, element, self.report),
            line=element.sourceline,
        )
        if stop.place is None and stop.lane is None and stop.edge is None:
            message = "says neither stopping place, lane nor edge; kept with its parameters"
            self.report.approximated("stop", element.getparent().get("id", ""), message, element.sourceline)
        else:
            self.report.read("stop")
        xml.ignore_children(element, "param")
        return stop

    def _stop_place(self, xml: XmlReader, element: Element) -> None:
        name = xml.text(element, "id")
        self._new(xml, element, name, self.demand.stop_places)
        self.demand.stop_places[name] = StopPlace(
            id=name,
            kind=element.tag,
            lane=xml.text(element, "lane"),
            start_pos=xml.number(element, "startPos", None),
            end_pos=xml.number(element, "endPos", None),
            parameters=parameters(xml, element, self.report),
            line=element.sourceline,
        )
        xml.ignore_children(element, "param")
        self.report.read(element.tag)

    # ---- vehicles

    def _vehicle(self, xml: XmlReader, element: Element, depart: float | str) -> Vehicle:
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
            parameters=parameters(xml, element, self.report),
            file=str(xml.path),
            line=element.sourceline,
        )
        xml.ignore_children(element, "route", "routeDistribution", "stop", "param")
        if route is not None or (origin is not None and destination is not None):
            self.report.read(element.tag)
        elif any(key.startswith(("from", "to")) for key in vehicle.parameters):
            message = "origin or destination is no edge; kept with its parameters, to be resolved by a router"
            self.report.approximated(element.tag, name, message, element.sourceline)
        else:
            raise xml.error(element, "it has neither a route nor an origin and a destination")
        return vehicle

    def _flow(self, xml: XmlReader, element: Element, begin: float, end: float | None) -> None:
        def positive(attribute: str) -> float | None:
            return xml.number(element, attribute, None, minimum=0.0)

        if (text := xml.text(element, "begin", None)) is not None:
            begin = parse_time(xml, element, "begin", text)
        if (text := xml.text(element, "end", None)) is not None:
            end = parse_time(xml, element, "end", text)
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
        self._new(xml, element, vehicle.id, self.demand.flows, self.demand.vehicles)
        self.demand.flows[vehicle.id] = Flow(
            vehicle=vehicle,
            begin=begin,
            end=end,
            number=number,
            period=period,
            vehicles_per_hour=per_hour,
            probability=probability,
            poisson_rate=rate,
        )
