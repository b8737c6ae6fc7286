"""Maps to OpenDRIVE files."""

from __future__ import annotations

import math
from collections.abc import Sequence

from lxml import etree

from mapbuilder.curves import wrap
from mapbuilder.junctions import Junction, Map
from mapbuilder.roads import Contact, Lane, Road, mark_between, text

DATE = "2025-01-01T00:00:00"
GEO_REFERENCE = "+proj=tmerc +lat_0=0 +lon_0=0 +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +vunits=m +no_defs"


def write(m: Map) -> bytes:
    """The OpenDRIVE file."""
    root = etree.Element("OpenDRIVE")
    every = [*m.roads, *(r for j in m.junctions for r in j.roads)]
    points = [
        pose.move(left=side * 20.0)
        for road in every
        for pose in (road.curve.pose(f * road.curve.length / 8) for f in range(9))
        for side in (-1, 1)
    ]
    header = etree.SubElement(root, "header", revMajor="1", revMinor="7", name=m.name)
    header.set("version", "1")
    header.set("date", DATE)
    header.set("north", str(math.ceil(max(p.y for p in points))))
    header.set("south", str(math.floor(min(p.y for p in points))))
    header.set("east", str(math.ceil(max(p.x for p in points))))
    header.set("west", str(math.floor(min(p.x for p in points))))
    header.set("vendor", "limsim-jax")
    etree.SubElement(header, "geoReference").text = etree.CDATA(GEO_REFERENCE)
    for road in every:
        root.append(road_element(road))
    for number, (name, lights) in enumerate(m.controllers, 1):
        element = etree.SubElement(root, "controller", id=str(number), name=name)
        element.set("sequence", str(number - 1))
        for light in lights:
            etree.SubElement(element, "control", signalId=str(light), type="0")
    for junction in m.junctions:
        root.append(junction_element(junction))
    return etree.tostring(root, xml_declaration=True, encoding="UTF-8", pretty_print=True)


def add_cubic(parent: etree._Element, tag: str, at: str, s: float, cubic: Sequence[float]) -> None:
    """A polynomial record."""
    values = dict(zip("abcd", (f"{v:.12g}" for v in cubic), strict=True))
    etree.SubElement(parent, tag, {at: text(s), **values})


def road_element(road: Road) -> etree._Element:
    """A road as XML."""
    element = etree.Element("road", name=road.name, length=text(road.curve.length), id=str(road.id))
    element.set("junction", str(road.junction.id) if road.junction else "-1")
    element.set("rule", "RHT")
    link = etree.SubElement(element, "link")
    for at, tag in (("start", "predecessor"), ("end", "successor")):
        neighbour = road.ends.get(at)
        if isinstance(neighbour, Junction):
            etree.SubElement(link, tag, elementType="junction", elementId=str(neighbour.id))
        elif neighbour:
            other = etree.SubElement(link, tag, elementType="road", elementId=str(neighbour.road.id))
            other.set("contactPoint", neighbour.at)
    kind = etree.SubElement(element, "type", s="0", type=road.kind, country="DE")
    etree.SubElement(kind, "speed", max=text(road.speed), unit="km/h")
    plan = etree.SubElement(element, "planView")
    for s, pose, (length, k0, k1) in road.curve.records():
        geometry = etree.SubElement(plan, "geometry", s=text(s), x=text(pose.x), y=text(pose.y))
        geometry.set("hdg", text(wrap(pose.heading), 9))
        geometry.set("length", text(length))
        if k0 != k1:
            etree.SubElement(geometry, "spiral", curvStart=text(k0, 12), curvEnd=text(k1, 12))
        elif k0:
            etree.SubElement(geometry, "arc", curvature=text(k0, 12))
        else:
            etree.SubElement(geometry, "line")
    elevation = etree.SubElement(element, "elevationProfile")
    for s, cubic in road.height.records(0.0, road.curve.length):
        add_cubic(elevation, "elevation", "s", s, cubic)
    etree.SubElement(element, "lateralProfile")
    lanes = etree.SubElement(element, "lanes")
    if any(v for _, v in road.offset.knots):
        for s, cubic in road.offset.records(0.0, road.curve.length):
            add_cubic(lanes, "laneOffset", "s", s, cubic)
    for index in range(len(road.sections)):
        lanes.append(section_element(road, index))
    for tag, items in (("objects", road.objects), ("signals", road.signals)):
        if items:
            etree.SubElement(element, tag).extend(items)
    return element


def section_element(road: Road, index: int) -> etree._Element:
    """A lane section as XML."""
    section = road.sections[index]
    end = road.sections[index + 1].s if index + 1 < len(road.sections) else road.curve.length
    element = etree.Element("laneSection", s=text(section.s))
    for side, lanes, sign in (("left", section.left, 1), ("center", (), 0), ("right", section.right, -1)):
        if side == "center":
            parent = etree.SubElement(element, side)
            centre = etree.SubElement(parent, "lane", id="0", type="none", level="false")
            add_mark(centre, 0.0, section.centre)
        elif lanes:
            parent = etree.SubElement(element, side)
            numbered = [(sign * (i + 1), lane) for i, lane in enumerate(lanes)]
            for number, lane in sorted(numbered, reverse=True):
                beyond = lanes[abs(number)] if abs(number) < len(lanes) else None
                parent.append(lane_element(road, index, end, number, lane, beyond))
    return element


def lane_element(
    road: Road, index: int, end: float, number: int, lane: Lane, beyond: Lane | None
) -> etree._Element:
    """A lane as XML."""
    section = road.sections[index]
    element = etree.Element("lane", id=str(number), type=lane.kind, level="false")
    link = etree.SubElement(element, "link")
    for tag, at, other in (("predecessor", "start", index - 1), ("successor", "end", index + 1)):
        if (to := linked_lane(road, number, lane, at, other)) is not None:
            etree.SubElement(link, tag, id=str(to))
    for s, cubic in lane.profile().records(section.s, end):
        add_cubic(element, "width", "sOffset", s - section.s, cubic)
    mark = lane.mark or mark_between(lane, beyond, "broken")
    current = ""
    for s, kind in ((0.0, mark),) if isinstance(mark, str) else mark:
        if s <= section.s:
            current = kind
    if current:
        add_mark(element, 0.0, current)
    for s, kind in () if isinstance(mark, str) else mark:
        if section.s < s < end:
            add_mark(element, s - section.s, kind)
    if lane.kind == "driving":
        etree.SubElement(element, "speed", sOffset="0", max=text(lane.speed or road.speed), unit="km/h")
    return element


def linked_lane(road: Road, number: int, lane: Lane, at: str, other: int) -> int | None:
    """Number of the lane that continues this one beyond its section."""
    if 0 <= other < len(road.sections):
        section = road.sections[other]
        keys = [n.key for n in (section.right if number < 0 else section.left)]
        return int(math.copysign(keys.index(lane.key) + 1, number)) if lane.key in keys else None
    if road.junction:
        return road.lane_ends.get((at, number))
    neighbour = road.ends.get(at)
    if not isinstance(neighbour, Contact):
        return None
    # where two starts or two ends meet, right lanes continue as left lanes
    right = (number < 0) == (neighbour.at != at)
    keys = [n.key for n in (neighbour.section.right if right else neighbour.section.left)]
    return (-1 if right else 1) * (keys.index(lane.key) + 1) if lane.key in keys else None


def add_mark(lane: etree._Element, s: float, kind: str) -> None:
    """A road mark; only broken ones may be crossed."""
    mark = etree.SubElement(lane, "roadMark", sOffset=text(s), type=kind, weight="standard", color="standard")
    if kind not in ("none", "curb"):
        mark.set("width", "0.15")
    mark.set("laneChange", "both" if kind == "broken" else "none")


def junction_element(junction: Junction) -> etree._Element:
    """A junction as XML."""
    element = etree.Element("junction", id=str(junction.id), name=junction.name, type="default")
    add_connections(
        element,
        [(incoming.id, road.id, lanes) for incoming, road, lanes in junction.links],
        [(high.id, low.id) for high, low in junction.priorities],
    )
    for sequence, controller in enumerate(junction.controllers):
        etree.SubElement(element, "controller", id=str(controller), type="0", sequence=str(sequence))
    return element


def add_connections(
    junction: etree._Element,
    links: Sequence[tuple[int, int, Sequence[tuple[int, int]]]],
    priorities: Sequence[tuple[int, int]],
) -> None:
    """Connections and priorities of a junction.

    `links`: incoming and connecting road, and pairs of lanes on both. `priorities`: roads, the higher first.
    """
    for number, (incoming, road, lanes) in enumerate(links):
        connection = etree.SubElement(junction, "connection", id=str(number), incomingRoad=str(incoming))
        connection.set("connectingRoad", str(road))
        connection.set("contactPoint", "start")
        for a, b in lanes:
            etree.SubElement(connection, "laneLink", {"from": str(a), "to": str(b)})
    for high, low in priorities:
        etree.SubElement(junction, "priority", high=str(high), low=str(low))
