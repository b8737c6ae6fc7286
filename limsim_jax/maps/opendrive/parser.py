"""Elements of an OpenDRIVE file to plain records.

Every child element is either taken or counted as ignored, so that the import report can name it. A broken
record that a map can do without costs that record; broken ids and broken geometry refuse the map.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from limsim_jax.maps.network import ImportReport, MapError
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

NO_LENGTH = 1e-6
"""Length (m) of a road that has none: it is left out, and its links pass through."""


class Parser:
    """Elements of one file to records."""

    def __init__(self, reader: XmlReader, report: ImportReport) -> None:
        self.get, self.report = reader, report

    def ignore(self, element: Element) -> None:
        """Count an element, with all that is in it, as left out."""
        self.get.ignore(element, _NO_MEANING.get(element.tag, "not known to this reader"))

    @contextmanager
    def _optional(self, element: Element, where: str) -> Iterator[None]:
        """Within it, a broken element is left out, with a note."""
        try:
            yield
        except MapError as error:
            self.report.ignored(element.tag, where, f"left out: {error.reason}", element.sourceline)

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
        if road.length < 0:
            raise get.error(e, f"attribute 'length' is {road.length:g}: a road cannot be shorter than 0")
        road.length = max(road.length, NO_LENGTH)
        if road.length > 1e6:
            raise get.error(e, f"attribute 'length' is {road.length:g}: no road is longer than 1000 km")
        self.report.read("road")
        for child in e:
            match child.tag:
                case "link":
                    self._road_links(child, road)
                case "type":
                    with self._optional(child, f"road {road.id}"):
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
        for child in e:
            if child.tag not in ("predecessor", "successor"):
                self.ignore(child)
                continue
            with self._optional(child, f"road {road.id}"):
                setattr(road, child.tag, self._road_link(child, road))
                self.report.read("road link")

    def _road_link(self, e: Element, road: RawRoad) -> RoadLink:
        get = self.get
        kind = get.text(e, "elementType", "road")
        if kind not in ("road", "junction"):
            raise get.error(e, f"attribute 'elementType' is '{kind}', not road or junction")
        contact = get.text(e, "contactPoint", "")
        if contact not in ("", "start", "end"):
            self.report.repaired(
                "road link",
                f"road {road.id} {e.tag}",
                f"contactPoint '{contact}' is not start or end: left out",
                e.sourceline,
            )
            contact = ""
        name = get.text(e, "elementId")
        if not name:
            raise get.error(e, "attribute 'elementId' is empty")
        return RoadLink(
            is_junction=kind == "junction",
            id=name,
            contact=contact,
            s=get.number(e, "elementS") if e.get("elementS") else None,
            direction=get.text(e, "elementDir", ""),
            line=e.sourceline,
        )

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
            if road.length <= NO_LENGTH:  # only its place counts
                records.append(
                    Geometry(
                        s=0.0, x=x, y=y, heading=heading, length=NO_LENGTH, kind=Kind.CLOTHOID,
                        line=child.sourceline,
                    )
                )  # fmt: skip
                break
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
                        with self._optional(link, where):
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
                    with self._optional(child, where):
                        lane.marks.append(self._mark(child))
                case "speed":
                    with self._optional(child, where):
                        speed = self._speed(child)
                        if speed is not None:
                            lane.speeds.append((get.number(child, "sOffset", 0.0), speed))
                case "access":
                    who = tuple(r.get("type", "") for r in child if r.tag == "restriction")
                    who += (child.get("restriction"),) if child.get("restriction") else ()
                    with self._optional(child, where):
                        rule = get.text(child, "rule", "")
                        lane.access.append((get.number(child, "sOffset", 0.0), rule, who))
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
        for child in e:
            if child.tag not in ("signal", "signalReference"):
                self.ignore(child)
                continue
            with self._optional(child, f"road {road.id}"):
                road.signals.append(self._signal(child))
                self.report.read(child.tag)
                for inner in child:
                    if inner.tag != "validity":
                        self.ignore(inner)

    def _signal(self, e: Element) -> RawSignal:
        get = self.get
        value = e.get("value")
        return RawSignal(
            id=get.text(e, "id"),
            s=get.number(e, "s"),
            t=get.number(e, "t", 0.0),
            z=get.number(e, "zOffset", 0.0),
            orientation=get.text(e, "orientation", "none"),
            validity=self._validity(e),
            reference=e.tag == "signalReference",
            name=get.text(e, "name", ""),
            type=get.text(e, "type", ""),
            subtype=get.text(e, "subtype", ""),
            country=get.text(e, "country", "").upper(),
            dynamic=get.text(e, "dynamic", "no").lower() in ("yes", "true"),
            value=get.number(e, "value") if value is not None and value.strip() else None,
            unit=get.text(e, "unit", ""),
            heading_offset=get.number(e, "hOffset", 0.0),
            line=e.sourceline,
        )

    def _objects(self, e: Element, road: RawRoad) -> None:
        for child in e:
            if child.tag != "object":
                self.ignore(child)
                continue
            with self._optional(child, f"road {road.id}"):
                road.objects.append(self._object(child))
                for inner in child:
                    if inner.tag not in ("outline", "outlines", "validity"):
                        self.ignore(inner)

    def _object(self, e: Element) -> RawObject:
        get = self.get
        return RawObject(
            id=get.text(e, "id", ""),
            type=get.text(e, "type", "").lower(),
            subtype=get.text(e, "subtype", "").lower(),
            name=get.text(e, "name", ""),
            s=get.number(e, "s", 0.0),
            t=get.number(e, "t", 0.0),
            z=get.number(e, "zOffset", 0.0),
            heading=get.number(e, "hdg", 0.0),
            length=get.number(e, "length", 0.0),
            width=get.number(e, "width", 0.0),
            height=get.number(e, "height", 0.0),
            outlines=[points for o in e.iter("outline") if len(points := self._outline(o)) >= 2],
            validity=self._validity(e),
            line=e.sourceline,
        )

    def _outline(self, e: Element) -> list[tuple[bool, float, float]]:
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
        where = f"junction {junction.id}"
        for child in e:
            match child.tag:
                case "connection":
                    with self._optional(child, where):
                        self._connection(child, junction)
                case "priority":
                    with self._optional(child, where):
                        junction.priorities.append(
                            (get.text(child, "high"), get.text(child, "low"), child.sourceline)
                        )
                case "controller":
                    with self._optional(child, where):
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
        where = f"junction {junction.id} road {road}"
        links: list[tuple[int, int]] = []
        for child in e:
            if child.tag == "laneLink":
                with self._optional(child, where):
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
        name = self.get.text(e, "id")
        signals: list[str] = []
        for child in e:
            if child.tag == "control":
                with self._optional(child, f"controller {name}"):
                    signals.append(self.get.text(child, "signalId"))
            else:
                self.ignore(child)
        self.report.read("controller")
        sequence: int | None = None
        with self._optional(e, f"controller {name}"):
            sequence = self.get.integer(e, "sequence", None)
        return RawController(
            id=name,
            name=self.get.text(e, "name", ""),
            sequence=sequence,
            signals=tuple(dict.fromkeys(signals)),
            line=e.sourceline,
        )
