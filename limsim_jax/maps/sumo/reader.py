"""The SUMO reader: from elements to a `Network`."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from limsim_jax.maps.bridges import bridge
from limsim_jax.maps.network import ImportReport, Network, Road
from limsim_jax.maps.sumo.crosswalks import build_crosswalks
from limsim_jax.maps.sumo.elements import Elements, FileEdge
from limsim_jax.maps.sumo.junctions import build_movements, stop_positions
from limsim_jax.maps.sumo.lanes import build_lanes, report_kinks
from limsim_jax.maps.sumo.links import find_links
from limsim_jax.maps.xml import XmlReader, file_hash, read_bytes


def read_sumo(path: str | Path, additional: Iterable[str | Path] = ()) -> Network:
    """Read a SUMO network (`.net.xml` or `.net.xml.gz`).

    Args:
      path: the network file.
      additional: additional files whose `<tlLogic>` programs join those of the network.

    Returns:
      The network. Of several programs of a traffic light the last one is in use, as in SUMO, and has the id
      of the light. The others are kept as `light:program`.

    Raises:
      MapError: the file cannot be used; names file, line, element and reason.
    """
    data, xml, report = read_bytes(path), XmlReader(path), ImportReport()
    elements = Elements(xml, xml.parse(data, "net"), report)
    for extra in additional:
        elements.programs.read_additional(extra)
    links = find_links(elements)
    lanes = build_lanes(elements, links)
    movements, junctions = build_movements(elements, links)
    programs = elements.programs.assign(movements)
    stop_lines, lights = stop_positions(elements, movements, lanes)
    crosswalks = build_crosswalks(elements, lanes)
    report_kinks(elements, lanes)
    noted = {note.where for note in report.notes if note.element == "lane"}
    report.read("lane", len(lanes) - len(noted))
    xml.ignored.summarise(report)
    network = Network(
        name=re.sub(r"(\.net)?\.xml(\.gz)?$", "", Path(path).name),
        source=str(path),
        file_hash=file_hash(data),
        format=f"SUMO {elements.version}".strip(),
        geo_reference=elements.geo_reference,
        lanes=lanes,
        roads={edge.id: _road(elements, edge) for edge in elements.edges.values()},
        movements=movements,
        junctions=junctions,
        programs=programs,
        traffic_lights=lights,
        stop_lines=stop_lines,
        crosswalks=crosswalks,
        report=report,
    )
    return bridge(network)


def _road(elements: Elements, edge: FileEdge) -> Road:
    return Road(
        id=edge.id,
        name=elements.xml.text(edge.element, "name", ""),
        type=elements.xml.text(edge.element, "type", ""),
        length=edge.lanes[0].length,
        junction=edge.junction,
        left_hand=elements.left_hand,
        priority=elements.xml.integer(edge.element, "priority", -1),
        line=edge.element.sourceline,
    )
