"""Connections across junctions, and the lanes inside that carry them."""

from __future__ import annotations

from dataclasses import dataclass

from limsim_jax.maps.sumo.elements import Connection, Elements, FileLane
from limsim_jax.maps.xml import Element


@dataclass(frozen=True, kw_only=True)
class Links:
    """Connections across junctions."""

    of_junction: dict[str, list[Connection]]
    """Per junction in the order of its request indices."""
    chains: dict[Connection, tuple[FileLane, ...]]
    """Lanes inside the junction per connection, in order."""


def find_links(elements: Elements) -> Links:
    """Find the connections across all junctions. Raises `MapError`.

    The edges inside get the id of their junction.
    """
    links = {
        junction: _links(elements, element)
        for junction, element in elements.junction_elements.items()
        if elements.xml.text(element, "type") != "internal"
    }
    chains = {c: _chain(elements, c) for found in links.values() for c in found}
    found = Links(of_junction=links, chains=chains)
    _place_inside(elements, found)
    return found


def _links(elements: Elements, element: Element) -> list[Connection]:
    """Connections across a junction in the order of its request indices.

    SUMO counts the connections of its incoming lanes one after the other, without those on and off
    walking areas.
    """
    links = []
    for lane_id in elements.xml.text(element, "incLanes").split():
        lane = elements.lanes.get(lane_id)
        if lane is None:
            raise elements.xml.error(element, f"there is no incoming lane '{lane_id}'")
        if lane.edge.function == "internal":
            message = f"incoming lane '{lane_id}' is inside a junction: only for junctions of type 'internal'"
            raise elements.xml.error(element, message)
        from_area = lane.edge.function == "walkingarea"
        for connection in lane.outgoing:
            to = connection.target.edge.function
            if to == "internal":
                message = f"leads to lane '{connection.target.id}' inside a junction: name it as 'via'"
                raise elements.xml.error(connection.element, message)
            if to != "walkingarea" and (not from_area or to == "crossing"):
                links.append(connection)
    return links


def _chain(elements: Elements, connection: Connection) -> tuple[FileLane, ...]:
    """The lanes inside the junction, in order.

    There are several where a vehicle may wait inside.
    """
    if connection.target.edge.function == "crossing":
        return (connection.target,)
    chain: list[FileLane] = []
    via = connection.via
    while via is not None:
        if via in chain:
            raise elements.xml.error(connection.element, f"its via lanes run in a circle at '{via.id}'")
        chain.append(via)
        onward = [c for c in via.outgoing if c.target is connection.target]
        if not onward:
            message = f"lane '{via.id}' has no connection on to '{connection.target.id}'"
            raise elements.xml.error(connection.element, message)
        via = onward[0].via
    return tuple(chain)


def _place_inside(elements: Elements, links: Links) -> None:
    """Find the junction of every edge inside one."""
    for junction, found in links.of_junction.items():
        for connection in found:
            for lane in links.chains[connection]:
                lane.edge.junction = junction
        element = elements.junction_elements[junction]
        for lane_id in elements.xml.text(element, "intLanes", "").split():
            if lane_id not in elements.lanes:
                raise elements.xml.error(element, f"there is no internal lane '{lane_id}'")
            elements.lanes[lane_id].edge.junction = junction
    for edge in elements.edges.values():
        if edge.function in {"internal", "crossing", "walkingarea"} and edge.junction is None:
            stem = edge.id.removeprefix(":").rpartition("_")[0]
            if stem in links.of_junction:
                edge.junction = stem
            else:
                message = "inside a junction, but no junction names it"
                elements.report.approximated("edge", edge.id, message, edge.element.sourceline)
