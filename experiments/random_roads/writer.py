"""Maps to OpenDRIVE files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from lxml import etree
from mapbuilder.curves import Pose, wrap
from mapbuilder.roads import text
from mapbuilder.writer import add_connections

from random_roads.junctions import Junction, Map
from random_roads.roads import DRIVABLE, Contact, Cubics, Road


def write(m: Map, path: Path) -> None:
    """Write a map."""
    root = etree.Element("OpenDRIVE")
    header = etree.SubElement(root, "header", revMajor="1", revMinor="6", name=path.stem, version="1")
    for side in ("north", "south", "east", "west"):
        header.set(side, "0")
    for road in m.all_roads():
        root.append(_road(road))
    for number, lights in enumerate(m.controllers, 1):
        element = etree.SubElement(root, "controller", id=str(number), name=f"group {number}")
        for light in lights:
            etree.SubElement(element, "control", signalId=str(light), type="0")
    for junction in m.junctions:
        root.append(_junction(junction))
    if m.left_hand:
        _mirror(root)
    path.write_bytes(etree.tostring(root, xml_declaration=True, encoding="UTF-8", pretty_print=True))


_text = partial(text, digits=9)


def _cubic(parent: etree._Element, tag: str, at: str, s: float, cubic: Sequence[float]) -> None:
    values = dict(zip("abcd", (f"{v:.14g}" for v in cubic), strict=True))
    etree.SubElement(parent, tag, {at: _text(s), **values})


def _road(road: Road) -> etree._Element:
    element = etree.Element("road", name=road.name, length=_text(road.length), id=str(road.id))
    element.set("junction", str(road.junction.id) if road.junction else "-1")
    element.set("rule", "RHT")
    link = etree.SubElement(element, "link")
    for at, tag in (("start", "predecessor"), ("end", "successor")):
        neighbour = road.ends.get(at)
        if isinstance(neighbour, Contact):
            other = etree.SubElement(link, tag, elementType="road", elementId=str(neighbour.road.id))
            other.set("contactPoint", neighbour.at)
        elif neighbour is not None:
            etree.SubElement(link, tag, elementType="junction", elementId=str(neighbour.id))
    kind = etree.SubElement(element, "type", s="0", type=road.kind)
    etree.SubElement(kind, "speed", max=_text(road.speed), unit="km/h")
    _plan(road, etree.SubElement(element, "planView"))
    if any(v for _, v in road.height.knots):
        profile = etree.SubElement(element, "elevationProfile")
        for s, cubic in road.height.records(0.0, road.length):
            _cubic(profile, "elevation", "s", s, cubic)
    lanes = etree.SubElement(element, "lanes")
    if any(v for _, v in road.offset.knots):
        for s, cubic in road.offset.records(0.0, road.length):
            _cubic(lanes, "laneOffset", "s", s, cubic)
    for index in range(len(road.sections())):
        lanes.append(_section(road, index))
    if road.signals:
        signals = etree.SubElement(element, "signals")
        for values in road.signals:
            kept = {key: value for key, value in values.items() if key not in ("from", "to")}
            signal = etree.SubElement(signals, "signal", kept)
            if "from" in values:
                etree.SubElement(signal, "validity", fromLane=values["from"], toLane=values["to"])
    return element


def _plan(road: Road, plan: etree._Element) -> None:
    s = 0.0
    if isinstance(road.line, Cubics):
        for pose, length, u, v in road.line.parts:
            geometry = _geometry(plan, s, pose, length)
            scale = [(1 / length) ** k if road.line.by_length else 1.0 for k in range(4)]
            shape = etree.SubElement(geometry, "paramPoly3")
            shape.set("pRange", "arcLength" if road.line.by_length else "normalized")
            for axis, c in (("U", u), ("V", v)):
                for name, value, factor in zip("abcd", c, scale, strict=True):
                    shape.set(name + axis, f"{value * factor:.14g}")
            s += length
        return
    for s, pose, (length, k0, k1) in road.line.records():
        geometry = _geometry(plan, s, pose, length)
        if k0 != k1:
            etree.SubElement(geometry, "spiral", curvStart=f"{k0:.14g}", curvEnd=f"{k1:.14g}")
        elif k0:
            etree.SubElement(geometry, "arc", curvature=f"{k0:.14g}")
        else:
            etree.SubElement(geometry, "line")


def _geometry(plan: etree._Element, s: float, pose: Pose, length: float) -> etree._Element:
    x, y, heading = pose
    places = {"s": s, "x": x, "y": y, "hdg": wrap(heading), "length": length}
    return etree.SubElement(plan, "geometry", {key: _text(value) for key, value in places.items()})


def _section(road: Road, index: int) -> etree._Element:
    begin, end = road.sections()[index]
    lanes = road.numbers(index)
    element = etree.Element("laneSection", s=_text(begin))
    for side, sign in (("left", 1), ("center", 0), ("right", -1)):
        numbers = sorted((n for n in lanes if n * sign > 0), reverse=True)
        if sign and not numbers:
            continue
        parent = etree.SubElement(element, side)
        if not sign:
            centre = etree.SubElement(parent, "lane", id="0", type="none", level="false")
            mark = "none" if road.junction else "solid"
            etree.SubElement(centre, "roadMark", sOffset="0", type=mark, laneChange="none")
        for number in numbers:
            parent.append(_lane(road, index, number, begin, end))
    return element


def _lane(road: Road, index: int, number: int, begin: float, end: float) -> etree._Element:
    strip = road.numbers(index)[number]
    element = etree.Element("lane", id=str(number), type=strip.kind, level="false")
    link = etree.SubElement(element, "link")
    for tag, at, other in (("predecessor", "start", index - 1), ("successor", "end", index + 1)):
        to = _beyond(road, number, at, other)
        if to is not None:
            etree.SubElement(link, tag, id=str(to))
    for s, cubic in strip.width.records(begin, end):
        _cubic(element, "width", "sOffset", s - begin, cubic)
    outer = road.numbers(index).get(number + (1 if number > 0 else -1))
    inside = outer is not None and outer.kind in DRIVABLE and strip.kind in DRIVABLE
    mark = (road.marks if inside else "solid") if not road.junction or inside else "none"
    change = "both" if mark == "broken" else "none"
    etree.SubElement(element, "roadMark", sOffset="0", type=mark, laneChange=change)
    if strip.kind in DRIVABLE:
        etree.SubElement(element, "speed", sOffset="0", max=_text(strip.speed or road.speed), unit="km/h")
    return element


def _beyond(road: Road, number: int, at: str, other: int) -> int | None:
    """Number of the lane that continues this one beyond its section."""
    count = len(road.sections())
    if 0 <= other < count:
        strip = road.numbers(other - 1 if at == "end" else other + 1)[number]
        return next((n for n, x in road.numbers(other).items() if x is strip), None)
    if road.junction:
        return road.joined.get((at, number))
    neighbour = road.ends.get(at)
    if not isinstance(neighbour, Contact):
        return None
    # where two starts or two ends meet, right lanes continue as left lanes
    to = number if neighbour.at != at else -number
    lanes, mine = neighbour.lanes(), Contact(road, at).lanes()
    if to not in lanes:
        return None
    kinds = {lanes[to].kind, mine[number].kind}
    return to if len(kinds) == 1 or kinds <= DRIVABLE else None


def _junction(junction: Junction) -> etree._Element:
    element = etree.Element("junction", id=str(junction.id), name=f"junction {junction.id}", type="default")
    add_connections(
        element,
        [(incoming.id, road.id, lanes) for incoming, road, lanes in junction.links],
        [(high.id, low.id) for high, low in junction.priorities],
    )
    for number in junction.controllers:
        etree.SubElement(element, "controller", id=str(number), type="0")
    return element


_NEGATED = {
    "geometry": ("y", "hdg"),
    "arc": ("curvature",),
    "spiral": ("curvStart", "curvEnd"),
    "paramPoly3": ("aV", "bV", "cV", "dV"),
    "laneOffset": ("a", "b", "c", "d"),
    "lane": ("id",),
    "signal": ("t",),
    "validity": ("fromLane", "toLane"),
    "laneLink": ("from", "to"),
}


def _mirror(root: etree._Element) -> None:
    """Turn right-hand into left-hand traffic: mirror the whole map."""
    for tag, names in _NEGATED.items():
        for element in root.iter(tag):
            for name in names:
                value = element.get(name, "0")
                element.set(
                    name,
                    value[1:] if value.startswith("-") else (value if float(value) == 0 else f"-{value}"),
                )
    for element in root.iter("validity"):
        first, last = element.get("fromLane", "0"), element.get("toLane", "0")
        low, high = sorted((int(first), int(last)))
        element.set("fromLane", str(low))
        element.set("toLane", str(high))
    for lane in root.iter("lane"):
        for tag in ("predecessor", "successor"):
            for link in lane.iterfind(f"link/{tag}"):
                link.set("id", str(-int(link.get("id", "0"))))
    for road in root.iter("road"):
        road.set("rule", "LHT")
    for section in root.iter("laneSection"):
        parts = {part.tag: part for part in section}
        for part in parts.values():
            section.remove(part)
        for old, new in (("right", "left"), ("center", "center"), ("left", "right")):
            if old in parts:
                part = parts[old]
                part.tag = new
                part[:] = sorted(part, key=lambda x: -int(x.get("id", "0")))
                section.append(part)


def footprint(road: Road, step: float = 4.0) -> list[tuple[float, float]]:
    """The outline of a road, as corners."""
    count = max(2, math.ceil(road.length / step))
    sides: tuple[list[tuple[float, float]], list[tuple[float, float]]] = ([], [])
    for k in range(count + 1):
        s = road.length * k / count
        pose = road.line.pose(s)
        for side, t in zip(sides, road.reach(min(s, road.length - 1e-6)), strict=True):
            at = pose.move(left=t)
            side.append((at.x, at.y))
    return [*sides[0], *reversed(sides[1])]
