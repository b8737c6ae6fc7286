"""Elements of an OpenDRIVE file to plain records.

Every child element is either taken or counted as ignored, so that the import report can name it.
"""

from __future__ import annotations

from dataclasses import replace

from limsim_jax.maps.network import ImportReport
from limsim_jax.maps.opendrive.curves import Cubics, Geometry, Kind, ReferenceLine
from limsim_jax.maps.opendrive.records import (
    SPEED_UNITS,
    Mark,
    RawConnection,
    RawController,
    RawJunction,
    RawLane,
    RawObject,
    RawRoad,
    RawSection,
    RawSignal,
    RoadLink,
)
from limsim_jax.maps.xml import Element, XmlReader

# without a meaning for motion: appearance, surface friction, sound, tool-specific data
_NO_MEANING = {
    "userData": "tool-specific data",
    "include": "included files are not opened",
    "dataQuality": "data quality",
    "surface": "road surface",
    "railroad": "railway data",
    "material": "lane surface",
    "height": "lane height above the road plane",
    "crossfall": "cross slope",
    "shape": "road cross section",
    "crossSectionSurface": "road cross section",
    "rule": "free-text rule",
    "fillet": "tool-specific data",
    "planElevation": "junction surface",
    "elevationGrid": "junction surface",
    "boundary": "junction boundary",
    "surfaceStrip": "road surface",
}


class Parser:
    """Elements of one file to records."""

    def __init__(self, reader: XmlReader, report: ImportReport) -> None:
        self.get, self.report = reader, report

    def ignore(self, element: Element) -> None:
        """Count an element, with all that is in it, as left out."""
        self.get.ignore(element, _NO_MEANING.get(element.tag, "not known to this reader"))

    # --- road -----------------------------------------------------------------------------------

    def road(self, e: Element) -> RawRoad:
        """A `<road>`."""
        get = self.get
        junction = get.text(e, "junction", "-1")
        rule = get.text(e, "rule", "RHT").upper()
        if rule not in ("RHT", "LHT"):
            raise get.error(e, f"attribute 'rule' is '{rule}', not RHT or LHT")
        road = RawRoad(
            id=get.text(e, "id"),
            name=get.text(e, "name", ""),
            length=get.number(e, "length"),
            junction=None if junction in ("-1", "") else junction,
            left_hand=rule == "LHT",
            line=e.sourceline,
        )
        if road.length <= 0:
            raise get.error(e, f"attribute 'length' is {road.length:g}: a road needs a length above zero")
        if road.length > 1e6:
            raise get.error(e, f"attribute 'length' is {road.length:g}: no road is longer than 1000 km")
        self.report.read("road")
        for child in e:
            match child.tag:
                case "link":
                    self._road_links(child, road)
                case "type":
                    road.types.append(self._road_type(child))
                    self.report.read("road type")
                case "planView":
                    road.reference = self._plan_view(child, road)
                case "elevationProfile":
                    road.elevation = self._cubics(child, "elevation")
                case "lateralProfile":
                    road.superelevation = self._cubics(child, "superelevation")
                case "lanes":
                    self._lanes(child, road)
                case "objects":
                    self._objects(child, road)
                case "signals":
                    self._signals(child, road)
                case _:
                    self.ignore(child)
        road.types.sort(key=lambda t: t[0])
        if not road.reference.records:
            raise get.error(e, "has no <planView> with a geometry record")
        if not road.sections:
            raise get.error(e, "has no <lanes> with a <laneSection>")
        return road

    def _road_links(self, e: Element, road: RawRoad) -> None:
        get = self.get
        for child in e:
            if child.tag not in ("predecessor", "successor"):
                self.ignore(child)
                continue
            kind = get.text(child, "elementType", "road")
            if kind not in ("road", "junction"):
                raise get.error(child, f"attribute 'elementType' is '{kind}', not road or junction")
            link = RoadLink(
                is_junction=kind == "junction",
                id=get.text(child, "elementId"),
                contact=get.text(child, "contactPoint", ""),
                s=get.number(child, "elementS") if child.get("elementS") else None,
                direction=get.text(child, "elementDir", ""),
                line=child.sourceline,
            )
            if link.contact not in ("", "start", "end"):
                raise get.error(child, f"attribute 'contactPoint' is '{link.contact}', not start or end")
            setattr(road, child.tag, link)
            self.report.read("road link")

    def _road_type(self, e: Element) -> tuple[float, str, float | None]:
        speed = None
        for child in e:
            if child.tag == "speed":
                speed = self._speed(child)
            else:
                self.ignore(child)
        return self.get.number(e, "s", 0.0), self.get.text(e, "type", ""), speed

    def _speed(self, e: Element) -> float | None:
        """Speed (m/s); None for 'undefined', infinity for 'no limit'."""
        raw = self.get.text(e, "max", "")
        if raw.lower() in ("", "undefined"):
            return None
        if raw.lower() in ("no limit", "nolimit", "unlimited"):
            return float("inf")
        unit = self.get.text(e, "unit", "")
        if unit.lower() not in SPEED_UNITS:
            raise self.get.error(e, f"attribute 'unit' is '{unit}', not m/s, km/h or mph")
        speed = self.get.number(e, "max") * SPEED_UNITS[unit.lower()]
        if speed <= 0:
            return None
        return speed

    def _cubics(self, e: Element, tag: str) -> Cubics:
        records = []
        for child in e:
            if child.tag == tag:
                records.append(self._cubic(child, "s"))
                self.report.read(tag)
            else:
                self.ignore(child)
        return Cubics(records)

    def _cubic(self, e: Element, key: str) -> tuple[float, float, float, float, float]:
        number = self.get.number
        return (
            number(e, key, 0.0),
            number(e, "a", 0.0),
            number(e, "b", 0.0),
            number(e, "c", 0.0),
            number(e, "d", 0.0),
        )

    def _plan_view(self, e: Element, road: RawRoad) -> ReferenceLine:
        get = self.get
        records: list[Geometry] = []
        for child in e:
            if child.tag != "geometry":
                self.ignore(child)
                continue
            s, x, y = (get.number(child, k) for k in ("s", "x", "y"))
            heading, length = get.number(child, "hdg"), get.number(child, "length")
            shapes = [c for c in child if c.tag != "userData"]
            for extra in [c for c in child if c.tag == "userData"] + shapes[1:]:
                self.ignore(extra)
            if not shapes:
                raise get.error(
                    child, "has no shape: one of line, spiral, arc, poly3, paramPoly3 must stand in it"
                )
            if length <= 0:
                self.report.repaired(
                    "geometry",
                    f"road {road.id} s={s:g}",
                    f"left out: its length is {length:g}",
                    child.sourceline,
                )
                continue
            if s < -1e-6 or s > road.length + 1.0:
                raise get.error(
                    child, f"attribute 's' is {s:g}, outside the road, which is {road.length:g} m long"
                )
            records.append(self._geometry(child, shapes[0], s, x, y, heading, length))
            self.report.read(f"geometry {shapes[0].tag}")
        return ReferenceLine(records)

    def _geometry(
        self, e: Element, shape: Element, s: float, x: float, y: float, heading: float, length: float
    ) -> Geometry:
        number = self.get.number
        base = Geometry(s=s, x=x, y=y, heading=heading, length=length, kind=Kind.CLOTHOID, line=e.sourceline)
        match shape.tag:
            case "line":
                return base
            case "arc":
                curvature = number(shape, "curvature")
                self._check_turn(shape, curvature * length)
                return replace(base, curvature=curvature)
            case "spiral":
                k0, k1 = number(shape, "curvStart"), number(shape, "curvEnd")
                self._check_turn(shape, max(abs(k0), abs(k1)) * length)
                return replace(base, curvature=k0, sharpness=(k1 - k0) / length)
            case "poly3":
                a, b, c, d = (number(shape, k, 0.0) for k in "abcd")
                return replace(base, kind=Kind.PARAMETRIC, u=(0.0, 1.0, 0.0, 0.0), v=(a, b, c, d))
            case "paramPoly3":
                p_range = self.get.text(shape, "pRange", "normalized")
                if p_range not in ("normalized", "arcLength"):
                    raise self.get.error(
                        shape, f"attribute 'pRange' is '{p_range}', not normalized or arcLength"
                    )
                u, v = (
                    (
                        number(shape, f"a{axis}", 0.0),
                        number(shape, f"b{axis}", 0.0),
                        number(shape, f"c{axis}", 0.0),
                        number(shape, f"d{axis}", 0.0),
                    )
                    for axis in "UV"
                )
                p_end = 1.0 if p_range == "normalized" else length
                if not any(u[1:]) and not any(v[1:]):
                    raise self.get.error(shape, "is a single point: all of bU..dU and bV..dV are zero")
                return replace(base, kind=Kind.PARAMETRIC, u=u, v=v, p_end=p_end)
        raise self.get.error(
            shape, "unknown shape: one of line, spiral, arc, poly3, paramPoly3 must stand here"
        )

    def _check_turn(self, e: Element, angle: float) -> None:
        if abs(angle) > 1000:
            raise self.get.error(e, f"turns by {angle:.3g} rad over its length: curvature is in 1/m")

    # --- lanes ----------------------------------------------------------------------------------

    def _lanes(self, e: Element, road: RawRoad) -> None:
        offsets = []
        for child in e:
            if child.tag == "laneOffset":
                offsets.append(self._cubic(child, "s"))
                self.report.read("laneOffset")
            elif child.tag == "laneSection":
                road.sections.append(self._section(child, road))
                self.report.read("laneSection")
            else:
                self.ignore(child)
        road.offset = Cubics(offsets)
        road.sections.sort(key=lambda section: section.s)
        for section, following in zip(road.sections, road.sections[1:], strict=False):
            section.end = following.s
        if road.sections:
            road.sections[-1].end = road.length

    def _section(self, e: Element, road: RawRoad) -> RawSection:
        section = RawSection(s=self.get.number(e, "s"), line=e.sourceline)
        if section.s < -1e-6 or section.s > road.length + 1.0:
            raise self.get.error(
                e, f"attribute 's' is {section.s:g}, outside the road, which is {road.length:g} m long"
            )
        for side in e:
            if side.tag not in ("left", "center", "right"):
                self.ignore(side)
                continue
            for child in side:
                if child.tag != "lane":
                    self.ignore(child)
                    continue
                lane = self._lane(child, road)
                if lane.id in section.lanes:
                    raise self.get.error(child, f"lane {lane.id} stands twice in this lane section")
                wrong_side = {"left": lane.id <= 0, "center": lane.id != 0, "right": lane.id >= 0}
                if wrong_side[side.tag]:
                    raise self.get.error(child, f"lane id {lane.id} cannot stand in <{side.tag}>")
                section.lanes[lane.id] = lane
                self.report.read("lane")
        return section

    def _lane(self, e: Element, road: RawRoad) -> RawLane:
        get, where = self.get, f"road {road.id} lane {e.get('id')}"
        lane = RawLane(id=get.integer(e, "id"), type=get.text(e, "type", "none"), line=e.sourceline)
        direction = get.text(e, "direction", "standard")
        lane.forward_sign = {"standard": 0, "reversed": 1, "both": 2}.get(direction, 0)
        widths, borders = [], []
        for child in e:
            match child.tag:
                case "link":
                    for link in child:
                        if link.tag == "predecessor":
                            lane.predecessors += (get.integer(link, "id"),)
                        elif link.tag == "successor":
                            lane.successors += (get.integer(link, "id"),)
                        else:
                            self.ignore(link)
                case "width":
                    widths.append(self._cubic(child, "sOffset"))
                case "border":
                    borders.append(self._cubic(child, "sOffset"))
                case "roadMark":
                    lane.marks.append(self._mark(child))
                case "speed":
                    speed = self._speed(child)
                    if speed is not None:
                        lane.speeds.append((get.number(child, "sOffset", 0.0), speed))
                case "access":
                    who = tuple(r.get("type", "") for r in child if r.tag == "restriction")
                    who += (child.get("restriction"),) if child.get("restriction") else ()
                    lane.access.append((get.number(child, "sOffset", 0.0), get.text(child, "rule", ""), who))
                case _:
                    self.ignore(child)
        if widths:
            lane.width = Cubics(widths, backwards=True)
            self.report.read("lane width", len(widths))
            if min(w[0] for w in widths) > 1e-6:
                self.report.repaired(
                    "lane width", where, "the first record starts late: extended backwards", lane.line
                )
            if borders:
                self.report.ignored(
                    "lane border",
                    where,
                    "the lane has width records too, and these prevail",
                    lane.line,
                    count=len(borders),
                )
        elif borders:
            lane.border = Cubics(borders, backwards=True)
            self.report.read("lane border", len(borders))
        elif lane.id != 0:
            self.report.repaired(
                "lane", where, "has neither width nor border records: width 0 assumed", lane.line
            )
        lane.marks.sort(key=lambda mark: mark.s)
        lane.speeds.sort()
        lane.access.sort()
        for element, found in (
            ("roadMark", lane.marks),
            ("lane speed", lane.speeds),
            ("lane access", lane.access),
        ):
            self.report.read(element, len(found))
        return lane

    def _mark(self, e: Element) -> Mark:
        rules: list[str] = []
        for child in e:
            if child.tag in ("type", "explicit"):
                rules += [line.get("rule", "") for line in child if line.tag == "line"]
            elif child.tag != "sway":
                self.ignore(child)
        return Mark(
            s=self.get.number(e, "sOffset", 0.0),
            type=self.get.text(e, "type", "none").lower(),
            change=e.get("laneChange"),
            rules=tuple(rules),
        )

    # --- things on the road ---------------------------------------------------------------------

    def _validity(self, e: Element) -> list[tuple[int, int]]:
        return [
            (self.get.integer(v, "fromLane"), self.get.integer(v, "toLane")) for v in e if v.tag == "validity"
        ]

    def _signals(self, e: Element, road: RawRoad) -> None:
        get = self.get
        for child in e:
            if child.tag not in ("signal", "signalReference"):
                self.ignore(child)
                continue
            reference = child.tag == "signalReference"
            value = child.get("value")
            signal = RawSignal(
                id=get.text(child, "id"),
                s=get.number(child, "s"),
                t=get.number(child, "t", 0.0),
                z=get.number(child, "zOffset", 0.0),
                orientation=get.text(child, "orientation", "none"),
                validity=self._validity(child),
                reference=reference,
                name=get.text(child, "name", ""),
                type=get.text(child, "type", ""),
                subtype=get.text(child, "subtype", ""),
                country=get.text(child, "country", "").upper(),
                dynamic=get.text(child, "dynamic", "no").lower() in ("yes", "true"),
                value=get.number(child, "value") if value is not None and value.strip() else None,
                unit=get.text(child, "unit", ""),
                heading_offset=get.number(child, "hOffset", 0.0),
                line=child.sourceline,
            )
            road.signals.append(signal)
            self.report.read("signalReference" if reference else "signal")
            for inner in child:
                if inner.tag != "validity":
                    self.ignore(inner)

    def _objects(self, e: Element, road: RawRoad) -> None:
        get = self.get
        for child in e:
            if child.tag != "object":
                self.ignore(child)
                continue
            raw = RawObject(
                id=get.text(child, "id", ""),
                type=get.text(child, "type", "").lower(),
                subtype=get.text(child, "subtype", "").lower(),
                name=get.text(child, "name", ""),
                s=get.number(child, "s", 0.0),
                t=get.number(child, "t", 0.0),
                z=get.number(child, "zOffset", 0.0),
                heading=get.number(child, "hdg", 0.0),
                length=get.number(child, "length", 0.0),
                width=get.number(child, "width", 0.0),
                height=get.number(child, "height", 0.0),
                outlines=[self._outline(o, road) for o in child.iter("outline")],
                validity=self._validity(child),
                line=child.sourceline,
            )
            raw.outlines = [outline for outline in raw.outlines if len(outline) >= 2]
            road.objects.append(raw)
            for inner in child:
                if inner.tag not in ("outline", "outlines", "validity"):
                    self.ignore(inner)

    def _outline(self, e: Element, road: RawRoad) -> list[tuple[bool, float, float]]:
        corners = []
        for child in e:
            if child.tag == "cornerRoad":
                corners.append((True, self.get.number(child, "s"), self.get.number(child, "t")))
            elif child.tag == "cornerLocal":
                corners.append((False, self.get.number(child, "u"), self.get.number(child, "v")))
            else:
                self.ignore(child)
        return corners

    # --- junctions and controllers --------------------------------------------------------------

    def junction(self, e: Element) -> RawJunction:
        """A `<junction>`."""
        get = self.get
        junction = RawJunction(
            id=get.text(e, "id"),
            name=get.text(e, "name", ""),
            type=get.text(e, "type", "default"),
            main_road=e.get("mainRoad"),
            line=e.sourceline,
        )
        self.report.read("junction")
        for child in e:
            match child.tag:
                case "connection":
                    self._connection(child, junction)
                case "priority":
                    junction.priorities.append(
                        (get.text(child, "high"), get.text(child, "low"), child.sourceline)
                    )
                case "controller":
                    junction.controllers.append(get.text(child, "id"))
                    self.report.read("junction controller")
                case _:
                    self.ignore(child)
        return junction

    def _connection(self, e: Element, junction: RawJunction) -> None:
        get = self.get
        road = e.get("connectingRoad") or e.get("linkedRoad")
        if road is None:
            raise get.error(e, "names neither a connectingRoad nor a linkedRoad")
        contact = get.text(e, "contactPoint", "start")
        if contact not in ("start", "end"):
            raise get.error(e, f"attribute 'contactPoint' is '{contact}', not start or end")
        links = []
        for child in e:
            if child.tag == "laneLink":
                links.append((get.integer(child, "from"), get.integer(child, "to")))
            elif child.tag not in ("predecessor", "successor"):  # virtual junctions: roads say the same
                self.ignore(child)
        junction.connections.append(
            RawConnection(
                incoming=e.get("incomingRoad"),
                road=road.strip(),
                contact=contact,
                lanes=tuple(links),
                line=e.sourceline,
            )
        )
        self.report.read("connection")
        self.report.read("laneLink", len(links))

    def controller(self, e: Element) -> RawController:
        """A `<controller>`."""
        signals = []
        for child in e:
            if child.tag == "control":
                signals.append(self.get.text(child, "signalId"))
            else:
                self.ignore(child)
        self.report.read("controller")
        sequence = e.get("sequence")
        return RawController(
            id=self.get.text(e, "id"),
            name=self.get.text(e, "name", ""),
            sequence=self.get.integer(e, "sequence") if sequence and sequence.strip() else None,
            signals=tuple(dict.fromkeys(signals)),
            line=e.sourceline,
        )
