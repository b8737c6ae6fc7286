"""Junctions and maps in the making, with the furniture of their roads."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from lxml import etree

from mapbuilder.curves import Curve, Profile, join
from mapbuilder.roads import Contact, Lane, Road, Section, mark_between, text


@dataclass(eq=False)
class Junction:
    """A junction and its connecting roads."""

    id: int
    name: str
    map: Map
    height: float = 0.0
    roads: list[Road] = field(default_factory=list)
    links: list[tuple[Road, Road, list[tuple[int, int]]]] = field(default_factory=list)
    priorities: list[tuple[Road, Road]] = field(default_factory=list)
    controllers: list[int] = field(default_factory=list)

    def connect(
        self,
        source: Contact,
        lanes: Sequence[str | None],
        target: Contact,
        onto: Sequence[str | None],
        *,
        speed: float | None = None,
        curve: Curve | None = None,
        between: str = "none",
        outside: str = "solid",
    ) -> Road:
        """Connect lanes of `source` with lanes of `target`.

        Both are listed from the left. `None` stands for a lane that is not there on that side: it opens
        or closes on the way. `curve` is the reference line where both roads share one; otherwise it is
        the left edge. Only roads with a `curve` are marked: `between` lanes and on the `outside`.
        """
        self.map.attach(source, self)
        self.map.attach(target, self)
        out_ids = iter(source.leaving([k for k in lanes if k]))
        in_ids = iter(target.entering([k for k in onto if k]))
        pairs = [
            (next(out_ids) if a else None, next(in_ids) if b else None)
            for a, b in zip(lanes, onto, strict=True)
        ]
        first = source.left_edge(next(a for a, _ in pairs if a))
        last = target.left_edge(next(b for _, b in pairs if b))
        marked = curve is not None
        curve = curve or join(first, last)
        offset = Profile((0, 0))
        if marked:
            (ds0, t0), (ds1, t1) = curve.start.local(first), curve.end.local(last)
            assert abs(ds0) < 1e-4 and abs(ds1) < 1e-4, f"{source.road.name}: curve does not fit"
            offset = Profile((0, t0), (curve.length, t1))
        made = []
        for a, b in pairs:
            lane = source.lane(a) if a else target.lane(b or 0)
            width = Profile((0, source.width(a) if a else 0.0), (curve.length, target.width(b) if b else 0.0))
            made.append(Lane(lane.key, width, lane.kind))
        named = []
        for lane, beyond in zip(made, [*made[1:], None], strict=True):
            mark = mark_between(lane, beyond, between, outside)
            named.append(lane._replace(mark=mark if marked or mark == "curb" else "none"))
        road = Road(
            id=self.id + len(self.roads) + 1,
            name=f"{source.road.name} to {target.road.name}",
            curve=curve,
            sections=[Section(0, named, centre="solid" if marked and made[0].kind == "driving" else "none")],
            kind=source.road.kind,
            speed=speed or min(source.road.speed, target.road.speed),
            offset=offset,
            height=Profile((0, self.height)),
            junction=self,
            ends={"start": source, "end": target},
        )
        for i, (a, b) in enumerate(pairs, 1):
            if a:
                road.lane_ends["start", -i] = a
            if b:
                road.lane_ends["end", -i] = b
        self.roads.append(road)
        self.links.append((source.road, road, [(a, -i) for i, (a, _) in enumerate(pairs, 1) if a]))
        return road

    def control(self, name: str, lights: Sequence[int]) -> None:
        """Lights that show the same: one signal group."""
        self.controllers.append(self.map.controller(name, lights))


class Map:
    """A map in the making.

    Roads are numbered from 1, junctions 100, 200, ..., their roads from 101.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.roads: list[Road] = []
        self.junctions: list[Junction] = []
        self.controllers: list[tuple[str, Sequence[int]]] = []
        self.items = 0  # signals and objects so far

    def road(
        self,
        name: str,
        curve: Curve,
        sections: list[Section],
        *,
        kind: str = "town",
        speed: float = 50,
        offset: Profile | float = 0.0,
        height: Profile | float = 0.0,
    ) -> Road:
        """Add a road."""
        offset = offset if isinstance(offset, Profile) else Profile((0, offset))
        height = height if isinstance(height, Profile) else Profile((0, height))
        road = Road(len(self.roads) + 1, name, curve, sections, kind, speed, offset, height)
        self.roads.append(road)
        return road

    def junction(self, name: str, height: float = 0.0) -> Junction:
        """Add a junction."""
        self.junctions.append(Junction(100 * (len(self.junctions) + 1), name, self, height))
        return self.junctions[-1]

    def attach(self, contact: Contact, neighbour: Junction | Contact) -> None:
        """Note what lies beyond an end of a road."""
        known = contact.road.ends.setdefault(contact.at, neighbour)
        assert known is neighbour or known == neighbour, f"{contact.road.name} has two neighbours"

    def link(self, a: Contact, b: Contact) -> None:
        """Link two roads; lanes of the same key continue each other."""
        self.attach(a, b)
        self.attach(b, a)

    def new_id(self) -> int:
        """A number for a signal or an object."""
        self.items += 1
        return self.items

    def controller(self, name: str, lights: Sequence[int]) -> int:
        """Add a signal group; its number."""
        self.controllers.append((name, lights))
        return len(self.controllers)

    # ------------------------------------------------------------------------- things on the road

    def signal(self, contact: Contact, back: float, lanes: Sequence[str], t: float, **attributes: str) -> int:
        """Add a signal for traffic that leaves the road at `contact`.

        It stands `back` metres before that end.
        """
        at_end = contact.at == "end"
        number = self.new_id()
        element = etree.Element("signal", id=str(number))
        element.set("s", text(contact.s - back if at_end else back))
        element.set("t", text(t))
        element.set("orientation", "+" if at_end else "-")
        defaults = {"dynamic": "no", "country": "DE", "countryRevision": "2017", "subtype": "-1"}
        for key, value in (defaults | {"zOffset": "2"} | attributes).items():
            element.set(key, value)
        numbers = sorted(contact.leaving(lanes))
        etree.SubElement(element, "validity", fromLane=str(numbers[0]), toLane=str(numbers[-1]))
        contact.road.signals.append(element)
        return number

    def light(self, contact: Contact, back: float, lanes: Sequence[str]) -> int:
        """A traffic light above lanes."""
        numbers = contact.leaving(lanes)
        t = 0.5 * (contact.t(numbers[0]) + contact.t(numbers[-1], 1.0))
        return self.signal(
            contact,
            back,
            lanes,
            t,
            name=f"light {contact.road.name} {'+'.join(lanes)}",
            dynamic="yes",
            country="OpenDRIVE",
            countryRevision="",
            type="1000001",
            zOffset="5.2",
            height="0.9",
            width="0.3",
        )

    def sign(self, contact: Contact, back: float, lanes: Sequence[str], kind: str, **attributes: str) -> None:
        """A sign to the right of traffic that leaves at `contact`."""
        number = contact.leaving([lanes[-1]])[0]
        t = contact.t(number, 1.0)
        attributes |= {"type": kind, "height": "0.6", "width": "0.6"}
        self.signal(contact, back, lanes, t + math.copysign(0.75, number), **attributes)

    def speed_sign(self, contact: Contact, back: float, lanes: Sequence[str], limit: int) -> None:
        """A speed limit sign."""
        self.sign(contact, back, lanes, "274", name=f"limit {limit}", value=str(limit), unit="km/h")

    def flat_object(
        self,
        road: Road,
        s: float,
        t0: float,
        t1: float,
        depth: float,
        lanes: Sequence[int],
        **attributes: str,
    ) -> None:
        """Paint a rectangle, `depth` along the road and from `t0` to `t1`."""
        half_u, half_v = depth / 2, abs(t1 - t0) / 2
        element = etree.Element("object", id=str(self.new_id()))
        sizes = {"length": depth, "width": 2 * half_v, "height": 0.0, "hdg": 0.0, "pitch": 0.0, "roll": 0.0}
        for key, value in ({"s": s, "t": (t0 + t1) / 2, "zOffset": 0.0} | sizes).items():
            element.set(key, text(value))
        for key, value in attributes.items():
            element.set(key, value)
        outline = etree.SubElement(element, "outline", id="0", closed="true", outer="true")
        for u, v in ((-half_u, -half_v), (half_u, -half_v), (half_u, half_v), (-half_u, half_v)):
            etree.SubElement(outline, "cornerLocal", u=text(u), v=text(v), z="0", height="0")
        etree.SubElement(element, "validity", fromLane=str(min(lanes)), toLane=str(max(lanes)))
        road.objects.append(element)

    def stop_line(self, contact: Contact, back: float, lanes: Sequence[str]) -> None:
        """A stop line, `back` metres before the end of the road."""
        numbers = contact.leaving(lanes)
        s = contact.s - back + 0.25 if contact.at == "end" else back - 0.25
        self.flat_object(
            contact.road,
            s,
            contact.t(numbers[0]),
            contact.t(numbers[-1], 1.0),
            0.5,
            numbers,
            type="roadMark",
            subtype="signalLines",
            name="StopLine",
            orientation="+" if contact.at == "end" else "-",
        )

    def crosswalk(self, contact: Contact, back: float) -> None:
        """A crosswalk 4 m wide over all driving lanes.

        Its far edge is `back` metres from the end.
        """
        numbers = [
            sign * (i + 1)
            for sign, side in ((-1, contact.section.right), (1, contact.section.left))
            for i, lane in enumerate(side)
            if lane.kind == "driving"
        ]
        edges = [contact.t(n, across) for n in numbers for across in (0.0, 1.0)]
        s = contact.s - back - 2.0 if contact.at == "end" else back + 2.0
        self.flat_object(
            contact.road,
            s,
            min(edges),
            max(edges),
            4.0,
            numbers,
            type="crosswalk",
            name="Crosswalk",
            orientation="none",
        )
