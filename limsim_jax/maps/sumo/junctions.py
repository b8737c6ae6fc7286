"""Junctions of a SUMO network: movements, right of way, stop lines and lights."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

from limsim_jax.maps.network import Control, Junction, Lane, LaneSpot, Movement, StopLine, TrafficLight
from limsim_jax.maps.sumo.elements import Elements, connection_name, polyline
from limsim_jax.maps.sumo.links import Links
from limsim_jax.maps.xml import Element

_WITHOUT_REQUESTS = frozenset({"dead_end", "unregulated", "district", "rail_signal"})
"""Types of junctions that need none."""


def build_movements(elements: Elements, links: Links) -> tuple[tuple[Movement, ...], dict[str, Junction]]:
    """All movements, and all junctions by id. Raises `MapError`."""
    xml, report = elements.xml, elements.report
    movements: list[Movement] = []
    junctions = {}
    dark: set[str] = set()
    inside: dict[str, list[str]] = defaultdict(list)
    for edge in elements.edges.values():
        if edge.junction is not None:
            inside[edge.junction] += [lane.id for lane in edge.lanes]
    for element in elements.junction_elements.values():
        if xml.text(element, "type") == "internal":  # a place to wait: the chains of via lanes state it, too
            for name in ("type", "x", "y", "z", "incLanes", "intLanes", "shape"):
                xml.text(element, name, "")
            xml.ignore_children(element)
            elements.done(element)
    for junction, found in links.of_junction.items():
        element = elements.junction_elements[junction]
        requests = _requests(elements, element, len(found))
        base = len(movements)
        for i, connection in enumerate(found):
            response, foes, cont = requests[i] if requests else ("", "", False)
            chain = links.chains[connection]
            outgoing = connection.target
            if outgoing.edge.function == "crossing":  # pedestrians: on to the far side
                onward = [c.target for c in outgoing.outgoing]
                outgoing = onward[0] if onward else outgoing
            light = connection.light
            if light is not None and light not in elements.programs:
                if light not in dark:
                    dark.add(light)
                    message = "has no program; its links are controlled as if the light were off"
                    report.approximated("tlLogic", light, message, connection.element.sourceline)
                light = None
            movements.append(
                Movement(
                    index=base + i,
                    junction=junction,
                    incoming=connection.source.id,
                    outgoing=outgoing.id,
                    via=tuple(lane.id for lane in chain if lane is not outgoing),
                    turn=connection.turn,
                    control=Control.SIGNAL if light is not None else connection.control,
                    program=light,
                    link=connection.link if light is not None else None,
                    yields_to=frozenset(base + j for j in _bits(response)),
                    foes=frozenset(base + j for j in _bits(foes)),
                    waits_inside=cont,
                    keep_clear=connection.keep_clear,
                )
            )
        outline = polyline(xml, element, "shape")
        xml.number(element, "z", 0.0)
        junctions[junction] = Junction(
            id=junction,
            name=xml.text(element, "name", ""),
            type=xml.text(element, "type"),
            movements=tuple(range(base, len(movements))),
            connectors=tuple(inside[junction]),
            center=(xml.number(element, "x"), xml.number(element, "y")),
            outline=tuple((float(x), float(y)) for x, y, _ in outline),
            roundabout=junction in elements.roundabouts,
        )
        xml.ignore_children(element, "request")
        elements.done(element)
    _count_left_out(elements, links)
    return tuple(movements), junctions


def _count_left_out(elements: Elements, links: Links) -> None:
    """Report connections between lanes outside junctions that no junction lists."""
    listed = {c for found in links.of_junction.values() for c in found}
    for lane in elements.lanes.values():
        for c in lane.outgoing:
            if c not in listed and lane.edge.function == c.target.edge.function == "normal":
                message = "from a lane that is incoming to no junction; kept as a successor only"
                elements.report.approximated(
                    "connection", connection_name(c.element), message, c.element.sourceline
                )


def _requests(elements: Elements, element: Element, count: int) -> list[tuple[str, str, bool]]:
    """Response bits, foe bits and `cont` per link; empty if the junction has none."""
    xml = elements.xml
    rows: dict[int, tuple[str, str, bool]] = {}
    for child in element.findall("request"):
        index = xml.integer(child, "index")
        response, foes = xml.text(child, "response"), xml.text(child, "foes")
        if index in rows:
            raise xml.error(child, f"junction '{element.get('id')}' has a second request {index}")
        for name, bits in (("response", response), ("foes", foes)):
            if set(bits) - {"0", "1"}:
                raise xml.error(child, f"{name}='{bits[:40]}' has letters other than 0 and 1")
            if len(bits) != count:
                message = f"{len(bits)} bits of {name}, but junction '{element.get('id')}' has {count} links"
                raise xml.error(child, message)
        itself = index in _bits(response) or index in _bits(foes)
        if itself:
            message = f"link {index} was its own foe; left out"
            elements.report.repaired("request", element.get("id"), message, child.sourceline)
            at = count - 1 - index  # the last letter is index 0
            response, foes = (f"{bits[:at]}0{bits[at + 1 :]}" for bits in (response, foes))
        rows[index] = response, foes, xml.flag(child, "cont")
        elements.done(child, count=not itself)
    if not rows:
        if count and xml.text(element, "type") not in _WITHOUT_REQUESTS:
            message = f"no requests for its {count} links: no movement has to yield"
            elements.report.approximated("junction", element.get("id"), message, element.sourceline)
        return []
    if sorted(rows) != list(range(count)):
        raise xml.error(element, f"{len(rows)} requests for {count} links")
    return [rows[i] for i in range(count)]


def stop_positions(
    elements: Elements, movements: tuple[Movement, ...], lanes: dict[str, Lane]
) -> tuple[tuple[StopLine, ...], tuple[TrafficLight, ...]]:
    """Stop lines and light heads, at the ends of lanes."""
    regulated = {Control.SIGNAL, Control.STOP, Control.ALL_WAY_STOP, Control.YIELD}
    stop_lines: dict[str, StopLine] = {}
    lights: dict[tuple[str, str], TrafficLight] = {}
    for movement in movements:
        source, lane = elements.lanes[movement.incoming], lanes[movement.incoming]
        if source.edge.function == "walkingarea":
            continue
        offset = source.stop_offset * (lane.length / source.length if source.length > 0 else 1.0)
        spot = LaneSpot(lane=lane.id, s=max(lane.length - offset, 0.0))
        if movement.control in regulated or offset > 0:
            stop_lines[lane.id] = StopLine(id=lane.id, spot=spot, line=source.element.sourceline)
        if movement.program is not None:
            xyz, heading = lane.pose(spot.s)
            lights[movement.program, lane.id] = TrafficLight(
                id=f"{movement.program}:{lane.id}",
                position=(float(xyz[0]), float(xyz[1]), float(xyz[2])),
                heading=float(heading),
                spots=(spot,),
                controller=movement.program,
                line=source.element.sourceline,
            )
    return tuple(stop_lines.values()), tuple(lights.values())


def _bits(text: str) -> Iterator[int]:
    """Indices of the ones in a bit string, from its last letter."""
    return (i for i, bit in enumerate(reversed(text)) if bit == "1")
