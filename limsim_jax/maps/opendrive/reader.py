"""The OpenDRIVE reader: one pass over the file, then geometry, links, furniture."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from limsim_jax.maps.bridges import bridge_lanes, bridge_roads
from limsim_jax.maps.check import GAP, KINK, seams
from limsim_jax.maps.network import ImportReport, Lane, MapError, Network, Road
from limsim_jax.maps.opendrive.furniture import Furnisher, extend_lights, fit_arrows, regulate
from limsim_jax.maps.opendrive.lanes import Cutter, Piece, lane_id, sample_piece
from limsim_jax.maps.opendrive.links import Linker, build_movements
from limsim_jax.maps.opendrive.parser import Parser
from limsim_jax.maps.opendrive.records import RawController, RawJunction, RawRoad
from limsim_jax.maps.signals import generate_programs
from limsim_jax.maps.xml import XmlReader, file_hash, read_bytes

LARGEST = 1e8  # m, coordinates beyond this are not on Earth

T = TypeVar("T", RawRoad, RawJunction, RawController)


@np.errstate(all="ignore")  # what overflows is found by `_sound`
def read_opendrive(path: str | Path) -> Network:
    """Read an OpenDRIVE file (.xodr, or gzipped) of any revision 1.x.

    Geometry is evaluated in float64 from the file's own polynomials and clothoids, at every record of
    every element, and sampled so that `Lane.pose` is within 0.1 mm of it. What is approximated,
    ignored or repaired is in `Network.report`.

    Raises:
        MapError: the file cannot be read as a road network; names file, line, element and reason.
    """
    path = Path(path)
    data = read_bytes(path)
    reader, report = XmlReader(path), ImportReport()
    parser = Parser(reader, report)
    raw_roads: list[RawRoad] = []
    raw_junctions: list[RawJunction] = []
    controllers: list[RawController] = []
    version, name, geo_reference = "1.4", "", ""
    for _, element in reader.children(data, "OpenDRIVE"):
        match element.tag:
            case "header":
                version = f"{reader.text(element, 'revMajor', '1')}.{reader.text(element, 'revMinor', '4')}"
                name = reader.text(element, "name", "")
                for child in element:
                    if child.tag == "geoReference":
                        geo_reference = (child.text or "").strip()
                    elif child.tag == "offset":
                        report.ignored(
                            "header offset",
                            "header",
                            "coordinates are kept as in the file; the offset leads to the geoReference",
                            child.sourceline,
                        )
                    else:
                        parser.ignore(child)
            case "road":
                raw_roads.append(parser.road(element))
            case "junction":
                raw_junctions.append(parser.junction(element))
            case "controller":
                controllers.append(parser.controller(element))
            case _:
                parser.ignore(element)
    if not raw_roads:
        raise MapError("has no <road>", file=path)
    roads, junctions = _by_id(raw_roads, "road", path), _by_id(raw_junctions, "junction", path)

    cutter = Cutter(report)
    pieces = {road.id: cutter.pieces(road, _attachments(road, roads)) for road in raw_roads}
    lanes: dict[str, Lane] = {}
    for road in raw_roads:
        _report_road(road, pieces[road.id], report)
        for piece in pieces[road.id]:
            for lane in sample_piece(road, piece, report).values():
                if not _sound(lane):
                    raise MapError(
                        f"lane {lane.number} has no finite geometry below {LARGEST:g} m",
                        file=path,
                        line=road.line,
                        element=f"<road {road.id}>",
                    )
                lanes[lane.id] = lane
    if not lanes:
        raise MapError("has no lanes", file=path)

    linker = Linker(roads, junctions, pieces, cutter.piece_at, lanes, report)
    linker.run()
    made, cut = bridge_lanes(lanes, {pair: min(names) for pair, names in linker.through.items()}, report)
    for pair in (*made, *cut):
        linker.through.pop(pair, None)
    _connector_speeds(lanes, pieces, roads, report)
    movements, junction_records = build_movements(lanes, junctions, linker.through, report)
    furniture = Furnisher(roads, pieces, lanes, movements, controllers, report).run()
    furniture.lights = extend_lights(furniture.lights, movements, lanes, report)
    furniture.lights = fit_arrows(furniture.lights, movements, lanes, report)
    movements = regulate(movements, lanes, furniture.lights, furniture.signs, report)
    reader.ignored.summarise(report)
    road_records = {
        road.id: Road(
            id=road.id,
            name=road.name,
            type=road.types[0][1] if road.types else "",
            length=road.length,
            junction=road.junction,
            left_hand=road.left_hand,
            line=road.line,
        )
        for road in raw_roads
    }
    network = Network(
        name=name or path.name.partition(".")[0],
        source=str(path),
        file_hash=file_hash(data),
        format=f"OpenDRIVE {version}",
        geo_reference=geo_reference,
        lanes=lanes,
        roads=road_records | bridge_roads(road_records, lanes, made),
        movements=movements,
        junctions=junction_records,
        traffic_lights=tuple(furniture.lights),
        signs=tuple(furniture.signs),
        stop_lines=tuple(furniture.stop_lines),
        crosswalks=tuple(furniture.crosswalks),
        report=report,
    )
    for seam in seams(network):  # positions stay as they are in the file
        report.approximated(
            "lane link",
            f"{seam.before} to {seam.after}",
            f"the lanes meet {seam.gap:.3f} m apart and at {np.degrees(abs(seam.kink)):.2f} degrees: kept so",
        )
    return generate_programs(network)


def _by_id(records: Iterable[T], tag: str, path: Path) -> dict[str, T]:
    found: dict[str, T] = {}
    for record in records:
        if record.id in found:
            raise MapError(
                f"id '{record.id}' is taken by line {found[record.id].line}",
                file=path,
                line=record.line,
                element=f"<{tag} {record.id}>",
            )
        found[record.id] = record
    return found


def _attachments(road: RawRoad, roads: dict[str, RawRoad]) -> set[float]:
    """Places (m) where virtual junctions attach other roads to this one."""
    return {
        link.s
        for other in roads.values()
        for link in (other.predecessor, other.successor)
        if link is not None and link.s is not None and not link.is_junction and link.id == road.id
    }


def _sound(lane: Lane) -> bool:
    return (
        bool(np.isfinite(lane.xyz).all())
        and bool((np.abs(lane.xyz) < LARGEST).all())
        and bool(np.isfinite(lane.heading).all())
        and bool(np.isfinite(lane.curvature).all())
        and bool(np.isfinite(lane.width).all())
        and bool((np.diff(lane.s) > 0).all())
    )


def _report_road(road: RawRoad, pieces: list[Piece], report: ImportReport) -> None:
    """Report oddities in the geometry of a whole road."""
    where = f"road {road.id}"
    if road.superelevation.coefficients.any():
        s = np.linspace(0.0, road.length, 65)
        steepest = float(np.abs(road.superelevation(s, s)).max())
        report.approximated(
            "superelevation",
            where,
            f"up to {steepest:.3f} rad: lanes are kept level across the road",
            road.line,
        )
    records = road.reference.records
    total = records[-1].s + records[-1].length - records[0].s
    if abs(total - road.length) > max(0.01, 1e-4 * road.length) or records[0].s > 0.01:
        report.approximated(
            "planView",
            where,
            f"the geometry covers {total:.3f} m of a road of {road.length:.3f} m: "
            f"{'the last record is extended' if total < road.length else 'the rest is cut off'}",
            road.line,
        )
    for record in records:
        stretch = float(road.reference.stretch(np.array([record.s + record.length / 2]))[0])
        if abs(stretch - 1) * record.length > 0.01:
            report.approximated(
                "geometry",
                f"{where} s={record.s:g}",
                f"the curve is {stretch * record.length:.3f} m long, the record says {record.length:.3f} m: "
                "s is spread evenly along it",
                record.line,
            )
    for before, after in itertools.pairwise(records):
        s = np.array([after.s, after.s])
        at = np.array([before.s + before.length / 2, after.s + after.length / 2])
        x, y, heading, _, _ = road.reference.frame(s, at)
        gap = float(np.hypot(x[1] - x[0], y[1] - y[0]))
        kink = abs(float(np.angle(np.exp(1j * (heading[1] - heading[0])))))
        if gap > GAP or kink > KINK:
            report.approximated(
                "geometry",
                f"{where} s={after.s:g}",
                f"does not continue the record before: {gap:.3f} m apart, {np.degrees(kink):.2f} degrees",
                after.line,
            )
    if not pieces:
        report.repaired("road", where, "all its lane sections are empty or too short: no lanes", road.line)


def _connector_speeds(
    lanes: dict[str, Lane], pieces: dict[str, list[Piece]], roads: dict[str, RawRoad], report: ImportReport
) -> None:
    """Give connectors without a limit the lower one of their neighbours."""
    assumed = {
        lane_id((road, piece.index, number))
        for road, found in pieces.items()
        for piece in found
        for number, attributes in piece.attributes.items()
        if attributes.speed_assumed
    }
    taken: dict[str, set[float]] = defaultdict(set)
    for name in sorted(assumed):
        lane = lanes[name]
        if lane.junction is None or not lane.drivable:
            continue
        joined = [lanes[n] for n in (*lane.predecessors, *lane.successors)]
        known = [other.speed_limit for other in joined if other.junction is None or other.id not in assumed]
        if known:
            lanes[name] = replace(lane, speed_limit=min(known))
        taken[lane.road].add(round(lanes[name].speed_limit * 3.6, 1))
    for road, limits in taken.items():
        report.approximated(
            "speed limit",
            f"road {road}",
            f"the file gives none for this connecting road: {' and '.join(f'{v:g}' for v in sorted(limits))} "
            "km/h as on the lanes it joins",
            roads[road].line,
        )
