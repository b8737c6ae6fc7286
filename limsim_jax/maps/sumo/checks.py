"""Checks that all parts exist to which a SUMO demand refers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from lxml import etree

from limsim_jax.maps.network import ImportReport, MapError, Network
from limsim_jax.maps.sumo.records import Demand, Stop, Vehicle
from limsim_jax.maps.sumo.vehicle_types import PREDEFINED, read_vehicle_type
from limsim_jax.maps.xml import XmlReader


def _all(demand: Demand) -> list[tuple[str, Vehicle]]:
    emitted = [("flow", flow.vehicle) for flow in demand.flows.values()]
    return [("vehicle", vehicle) for vehicle in demand.vehicles.values()] + emitted


def check_types(demand: Demand) -> None:
    """Add the predefined types that are used; report those that no file defines."""
    wanted = Counter(vehicle.type for _, vehicle in _all(demand))
    wanted.update(member for d in demand.type_distributions.values() for member in d.members)
    for name, count in wanted.items():
        if name in demand.types or name in demand.type_distributions:
            continue
        if name in PREDEFINED:
            element = etree.Element("vType", id=name, vClass=PREDEFINED[name])
            demand.types[name] = read_vehicle_type(XmlReader(""), element, ImportReport())
        else:
            message = f"used {count} times, but none of the files defines it"
            demand.report.approximated("vType", name, message)


def check_routes(demand: Demand) -> None:
    """Raise `MapError` for a vehicle whose route does not exist."""
    for kind, vehicle in _all(demand):
        known = vehicle.route in demand.routes or vehicle.route in demand.route_distributions
        if vehicle.route is not None and not known:
            message = f"there is no route '{vehicle.route}'"
            raise MapError(message, file=vehicle.file, line=vehicle.line, element=f"{kind} {vehicle.id}")


def check_network(demand: Demand, network: Network) -> None:
    """Raise `MapError` for an edge or lane outside the network."""
    good: set[str] = set()  # routes checked

    def check_route(name: str, who: str, file: str, line: int | None) -> None:
        if name in good:
            return
        good.add(name)
        if name in demand.route_distributions:
            for member in demand.route_distributions[name].members:
                check_route(member, who, file, line)
            return
        route = demand.routes[name]
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
            if stop.place is not None and stop.place not in demand.stop_places:
                message = f"stopping place '{stop.place}' is not in the files"
                demand.report.approximated("stop", who, message, stop.line)

    for kind, vehicle in _all(demand):
        who = f"{kind} {vehicle.id}"
        if vehicle.route is not None:
            check_route(vehicle.route, who, vehicle.file, vehicle.line)
        ends = (vehicle.origin, *vehicle.via, vehicle.destination)
        check_edges((e for e in ends if e is not None), "", who, vehicle.file, vehicle.line)
        check_stops(vehicle.stops, who, vehicle.file)
    for name, route in demand.routes.items():
        check_route(name, f"route {name}", route.file, route.line)
    for place in demand.stop_places.values():
        if place.lane not in network.lanes:
            message = f"its lane '{place.lane}' is not in network {network.source}"
            raise MapError(message, line=place.line, element=f"{place.kind} {place.id}")
