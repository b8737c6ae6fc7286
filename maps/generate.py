"""Write the five bundled OpenDRIVE maps that lie beside this script.

    python maps/generate.py           write them
    python maps/generate.py --check   fail unless the files are what would be written

The maps are OpenDRIVE 1.7, right-hand traffic, European marking and signs (country DE). Roads are
lines, arcs and clothoids only, so that every importer measures the same lengths. Widths, lane
offsets and heights change along smoothsteps, whose ends are level: at every link the edges and
centre lines of lanes continue in position and heading.

Units: metres, radians, km/h. Files hold micrometres, so that they do not depend on the last bit of
a platform's `sin`.
"""

from __future__ import annotations

import argparse
import functools
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from lxml import etree

FOLDER = Path(__file__).parent
DATE = "2025-01-01T00:00:00"
GEO_REFERENCE = "+proj=tmerc +lat_0=0 +lon_0=0 +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +vunits=m +no_defs"

# A lane that opens or closes gets a section border where it is this wide: narrower is paint, not a
# lane to drive on. It is also where SUMO's netconvert begins a lane (its default `min-width`).
NARROWEST = 1.8

# ---------------------------------------------------------------------------------------- geometry


class Pose(NamedTuple):
    """A point with a heading."""

    x: float
    y: float
    heading: float

    def move(self, ahead: float = 0.0, left: float = 0.0, turn: float = 0.0) -> Pose:
        """The pose this far ahead and to the left, then turned counter-clockwise."""
        c, s = math.cos(self.heading), math.sin(self.heading)
        return Pose(self.x + ahead * c - left * s, self.y + ahead * s + left * c, self.heading + turn)

    def local(self, other: Pose) -> tuple[float, float]:
        """Where `other` lies: (ahead, left)."""
        dx, dy = other.x - self.x, other.y - self.y
        c, s = math.cos(self.heading), math.sin(self.heading)
        return dx * c + dy * s, dy * c - dx * s


class Piece(NamedTuple):
    """Line, arc or clothoid: curvature runs linearly from `k0` to `k1`."""

    length: float
    k0: float = 0.0
    k1: float = 0.0


NODES, WEIGHTS = (tuple(float(v) for v in a) for a in np.polynomial.legendre.leggauss(12))


def advance(pose: Pose, piece: Piece) -> Pose:
    """The end of a piece that starts at `pose`."""
    length, k0, k1 = piece
    turn = 0.5 * (k0 + k1) * length
    if k0 == k1:
        # chord of the arc; its direction is the mean heading
        chord = length if k0 == 0 else 2 * math.sin(turn / 2) / k0
        end = pose.move(turn=turn / 2).move(ahead=chord)
        return Pose(end.x, end.y, pose.heading + turn)
    panels = 1 + math.ceil(max(abs(k0), abs(k1)) * length)
    x, y = pose.x, pose.y
    for i in range(panels):
        for node, weight in zip(NODES, WEIGHTS, strict=True):
            s = (i + 0.5 + 0.5 * node) * length / panels
            heading = pose.heading + k0 * s + 0.5 * (k1 - k0) * s * s / length
            x += 0.5 * weight * length / panels * math.cos(heading)
            y += 0.5 * weight * length / panels * math.sin(heading)
    return Pose(x, y, pose.heading + turn)


class Curve:
    """A reference line: pieces one after another."""

    def __init__(self, start: Pose, pieces: Sequence[Piece]) -> None:
        kept: list[Piece] = []
        for length, k0, k1 in pieces:
            if kept and k0 == k1 == kept[-1].k0 == kept[-1].k1:
                kept[-1] = Piece(round(kept[-1].length + length, 6), k0, k1)
            elif length > 1e-4:
                kept.append(Piece(round(length, 6), k0, k1))
        self.start = start
        self.pieces = tuple(kept)
        self.length = round(sum(p.length for p in self.pieces), 6)

    def records(self) -> Iterator[tuple[float, Pose, Piece]]:
        """Where along the curve each piece starts, its first pose, and the piece."""
        s, pose = 0.0, self.start
        for piece in self.pieces:
            yield round(s, 6), pose, piece
            s, pose = s + piece.length, advance(pose, piece)

    def pose(self, s: float) -> Pose:
        """The pose at arc length `s`."""
        last = None
        for last in self.records():
            if s <= last[0] + last[2].length:
                break
        assert last is not None
        at, pose, (length, k0, k1) = last
        u = s - at
        return advance(pose, Piece(u, k0, k0 + (k1 - k0) * u / length)) if u else pose

    @property
    def end(self) -> Pose:
        """The last pose."""
        return self.pose(self.length)

    def cut(self, s0: float, s1: float) -> Curve:
        """The stretch between two arc lengths."""
        pieces = []
        for at, _, (length, k0, k1) in self.records():
            a, b = max(s0 - at, 0.0), min(s1 - at, length)
            if b > a:
                slope = (k1 - k0) / length
                pieces.append(Piece(b - a, k0 + slope * a, k0 + slope * b))
        return Curve(self.pose(s0), pieces)

    def reversed(self) -> Curve:
        """The same line, run the other way."""
        back = [Piece(p.length, -p.k1, -p.k0) for p in reversed(self.pieces)]
        return Curve(self.end.move(turn=math.pi), back)


def wrap(angle: float) -> float:
    """The angle in [-pi, pi]."""
    return math.remainder(angle, 2 * math.pi)


def arc(radius: float, degrees: float, clothoid: float) -> list[Piece]:
    """Clothoid, arc, clothoid that turn by `degrees` (left positive) in all."""
    k = math.copysign(1 / radius, degrees)
    length = abs(math.radians(degrees)) * radius - clothoid
    return [Piece(clothoid, 0, k), Piece(length, k, k), Piece(clothoid, k, 0)]


def bend(angle: float, tangent: float) -> list[Piece]:
    """The clothoid-arc-clothoid turn by `angle` whose legs to the corner are `tangent` long.

    A quarter of the angle falls to the clothoids. All such turns are similar: the unit one is scaled.
    """
    if abs(angle) < 1e-9:
        return [Piece(2 * tangent)]
    k, quarter = math.copysign(1.0, angle), abs(angle) / 4
    unit = [Piece(quarter, 0, k), Piece(3 * quarter, k, k), Piece(quarter, k, 0)]
    end = functools.reduce(advance, unit, Pose(0, 0, 0))
    radius = tangent / (end.x - end.y / math.tan(angle))
    return [Piece(p.length * radius, p.k0 / radius, p.k1 / radius) for p in unit]


def join(a: Pose, b: Pose) -> Curve:
    """A smooth curve from `a` to `b`: one bend if the legs allow it, else two of opposite sense."""
    ahead, left = a.local(b)
    angle = wrap(b.heading - a.heading)
    if abs(math.sin(angle)) > 1e-6:
        second = left / math.sin(angle)
        first = ahead - second * math.cos(angle)
        leg = min(first, second)
        if leg > 0.2 * max(first, second):
            return Curve(a, [Piece(first - leg), *bend(angle, leg), Piece(second - leg)])
    # two bends with equal legs `d` that meet in the middle of the line between their corners
    c, s = math.cos(angle), math.sin(angle)
    p, q, r = 2 * (c - 1), -2 * (ahead * (1 + c) + left * s), ahead**2 + left**2
    d = 2 * r / (-q + math.sqrt(q * q - 4 * p * r))
    middle = math.atan2(left - d * s, ahead - d * (1 + c))
    return Curve(a, [*bend(middle, d), *bend(wrap(angle - middle), d)])


class Profile:
    """A quantity along a road: constant, then smoothsteps from knot to knot, then constant."""

    def __init__(self, *knots: tuple[float, float]) -> None:
        self.knots = tuple((round(s, 6), v) for s, v in knots)

    def cubic(self, s: float) -> tuple[float, float, float, float]:
        """Coefficients of the cubic in (ds from `s`) that holds from `s` on."""
        for (s0, v0), (s1, v1) in zip(self.knots, self.knots[1:], strict=False):
            if s0 <= s < s1:
                length, rise, u = s1 - s0, v1 - v0, (s - s0) / (s1 - s0)
                return (
                    v0 + rise * u * u * (3 - 2 * u),
                    6 * rise * u * (1 - u) / length,
                    3 * rise * (1 - 2 * u) / length**2,
                    -2 * rise / length**3,
                )
        return (self.knots[0][1] if s < self.knots[0][0] else self.knots[-1][1], 0, 0, 0)

    def __call__(self, s: float) -> float:
        """The value at `s`."""
        return self.cubic(s)[0]

    def records(self, s0: float, s1: float) -> Iterator[tuple[float, tuple[float, float, float, float]]]:
        """(s, cubic) from `s0` up to `s1`, without records that only repeat a constant."""
        last = None
        for s in [s0, *(k for k, _ in self.knots if s0 < k < s1)]:
            cubic = self.cubic(s)
            if cubic != last or any(cubic[1:]):
                yield s, cubic
            last = cubic

    def narrow_at(self) -> float | None:
        """Where a lane that opens or closes passes `NARROWEST`, rounded to where it is wider."""
        for (s0, v0), (s1, v1) in zip(self.knots, self.knots[1:], strict=False):
            if (v0 == 0) != (v1 == 0):
                u = 0.5 - math.sin(math.asin(1 - 2 * NARROWEST / max(v0, v1)) / 3)
                cut = u * (s1 - s0)
                return math.ceil(1e3 * (s0 + cut)) / 1e3 if v0 == 0 else math.floor(1e3 * (s1 - cut)) / 1e3
        return None


# ------------------------------------------------------------------------------------------- roads

# mark on the outer border of a lane; "" chooses by the lane beyond it
Mark = str | tuple[tuple[float, str], ...]


class Lane(NamedTuple):
    """A lane of a section. `key` tells which lane it continues at section borders and links."""

    key: str
    width: float | Profile
    kind: str = "driving"
    mark: Mark = ""
    speed: float | None = None  # where it differs from the road's

    def profile(self) -> Profile:
        """The width along the road."""
        return self.width if isinstance(self.width, Profile) else Profile((0, self.width))


class Section(NamedTuple):
    """A lane section from `s` on; lanes are listed from the reference line outwards."""

    s: float
    right: Sequence[Lane]
    left: Sequence[Lane] = ()
    centre: str = "solid"


@dataclass(eq=False)
class Road:
    """A road; `ends` says what lies before its start and beyond its end."""

    id: int
    name: str
    curve: Curve
    sections: list[Section]
    kind: str
    speed: float
    offset: Profile
    height: Profile
    junction: Junction | None = None
    ends: dict[str, Junction | Contact] = field(default_factory=dict)
    lane_ends: dict[tuple[str, int], int] = field(default_factory=dict)  # connecting roads
    objects: list[etree._Element] = field(default_factory=list)
    signals: list[etree._Element] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Split sections where a driving lane that opens or closes becomes too narrow."""
        split = []
        for i, section in enumerate(self.sections):
            end = self.sections[i + 1].s if i + 1 < len(self.sections) else self.curve.length
            cuts = {lane.profile().narrow_at() for lane in section.right if lane.kind == "driving"}
            split.append(section)
            split += [section._replace(s=s) for s in sorted(c for c in cuts if c) if section.s < s < end]
        self.sections = split

    @property
    def start(self) -> Contact:
        """The end of the road where s = 0."""
        return Contact(self, "start")

    @property
    def end(self) -> Contact:
        """The end of the road where s is its length."""
        return Contact(self, "end")


class Contact(NamedTuple):
    """The start or the end of a road."""

    road: Road
    at: str

    @property
    def s(self) -> float:
        """Where it is along the road."""
        return 0.0 if self.at == "start" else self.road.curve.length

    @property
    def section(self) -> Section:
        """The first or last lane section."""
        return self.road.sections[0 if self.at == "start" else -1]

    def leaving(self, keys: Sequence[str]) -> list[int]:
        """Lane numbers of the lanes whose traffic leaves the road here."""
        return self._numbers(keys, right=self.at == "end")

    def entering(self, keys: Sequence[str]) -> list[int]:
        """Lane numbers of the lanes whose traffic enters the road here."""
        return self._numbers(keys, right=self.at == "start")

    def keys(self, *, leaving: bool, kind: str = "driving") -> list[str]:
        """Lanes of a kind whose traffic leaves (or enters) the road here, from the left."""
        right = leaving == (self.at == "end")
        lanes = self.section.right if right else self.section.left
        return [lane.key for lane in lanes if lane.kind == kind]

    def _numbers(self, keys: Sequence[str], *, right: bool) -> list[int]:
        lanes = [lane.key for lane in (self.section.right if right else self.section.left)]
        missing = [k for k in keys if k not in lanes]
        assert not missing, f"{self.road.name} has no lanes {missing} at its {self.at}"
        return [(-1 if right else 1) * (lanes.index(k) + 1) for k in keys]

    def lane(self, number: int) -> Lane:
        """The lane with this number."""
        side = self.section.right if number < 0 else self.section.left
        return side[abs(number) - 1]

    def width(self, number: int) -> float:
        """The width of a lane here."""
        return self.lane(number).profile()(self.s)

    def t(self, number: int, across: float = 0.0) -> float:
        """Lateral coordinate in a lane, from its inner (0) to its outer border (1)."""
        inner = sum(self.width(int(math.copysign(i, number))) for i in range(1, abs(number)))
        t = inner + across * self.width(number)
        return self.road.offset(self.s) + math.copysign(t, number)

    def left_edge(self, number: int) -> Pose:
        """The inner border of a lane, which is on the left of its traffic, headed as it drives."""
        pose = self.road.curve.pose(self.s).move(left=self.t(number))
        return pose if number < 0 else pose.move(turn=math.pi)


def mark_between(lane: Lane, beyond: Lane | None, between: str, outside: str = "solid") -> str:
    """The usual mark between two lanes."""
    kinds = (lane.kind, beyond.kind if beyond else "")
    if "sidewalk" in kinds:
        return "curb" if "driving" in kinds else "none"
    if kinds == ("driving", "driving"):
        return between
    return outside if "driving" in kinds else "none"


# --------------------------------------------------------------------------------- junctions, maps


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
        """Connect lanes of `source` with lanes of `target`, both listed from the left.

        `None` stands for a lane that is not there on that side: it opens or closes on the way.
        `curve` is the reference line where both roads share one; else it is the left edge. Only roads
        with a `curve` are marked: `between` lanes and on the `outside`.
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
    """A map in the making. Roads are numbered from 1, junctions 100, 200, ..., their roads from 101."""

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
        """Add a signal for traffic that leaves the road at `contact`, `back` metres before it does."""
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
        """A sign to the right of the road, for traffic that leaves at `contact`."""
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
        """Paint a rectangle across the road: `depth` along it, from `t0` to `t1`."""
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
        """A stop line half a metre deep; traffic stops `back` metres before the end of the road."""
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
        """A crosswalk 4 m wide over all driving lanes, whose far edge is `back` metres from the end."""
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

    # --------------------------------------------------------------------------------------- file

    def write(self) -> bytes:
        """The OpenDRIVE file."""
        root = etree.Element("OpenDRIVE")
        every = [*self.roads, *(r for j in self.junctions for r in j.roads)]
        points = [
            pose.move(left=side * 20.0)
            for road in every
            for pose in (road.curve.pose(f * road.curve.length / 8) for f in range(9))
            for side in (-1, 1)
        ]
        header = etree.SubElement(root, "header", revMajor="1", revMinor="7", name=self.name)
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
        for number, (name, lights) in enumerate(self.controllers, 1):
            element = etree.SubElement(root, "controller", id=str(number), name=name)
            element.set("sequence", str(number - 1))
            for light in lights:
                etree.SubElement(element, "control", signalId=str(light), type="0")
        for junction in self.junctions:
            root.append(junction_element(junction))
        return etree.tostring(root, xml_declaration=True, encoding="UTF-8", pretty_print=True)


# ------------------------------------------------------------------------------------------ writer


def text(value: float, digits: int = 6) -> str:
    """A number with `digits` decimals, without trailing zeros."""
    out = f"{value:.{digits}f}".rstrip("0").rstrip(".")
    return "0" if out in ("-0", "") else out


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
    """The lane that continues this one beyond the start or end of its section."""
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
    for number, (incoming, road, lanes) in enumerate(junction.links):
        connection = etree.SubElement(element, "connection", id=str(number), incomingRoad=str(incoming.id))
        connection.set("connectingRoad", str(road.id))
        connection.set("contactPoint", "start")
        for a, b in lanes:
            etree.SubElement(connection, "laneLink", {"from": str(a), "to": str(b)})
    for high, low in junction.priorities:
        etree.SubElement(element, "priority", high=str(high.id), low=str(low.id))
    for sequence, controller in enumerate(junction.controllers):
        etree.SubElement(element, "controller", id=str(controller), type="0", sequence=str(sequence))
    return element


# --------------------------------------------------------------------------------- urban building

POCKET = 3.25  # left-turn lane; it takes the place of the median but for a narrow island
ISLAND = 0.75
SHIFT = (POCKET - ISLAND) / 2  # from the middle of the median to the edge between the two
STORAGE, TAPER = 70.0, 45.0  # length of turn lanes, and of their opening
SOLID = 35.0  # before the stop line lanes must not be changed
STOP_BACK = 6.0  # stop line to end of road; the crosswalk lies between them


def walk(width: float = 2.5) -> Lane:
    """A sidewalk."""
    return Lane("walk", width, "sidewalk")


def inwards(start: Pose, pieces: Sequence[Piece]) -> Curve:
    """A curve towards an intersection, described outwards from it. `start` looks inwards."""
    return Curve(start.move(turn=math.pi), pieces).reversed()


def mirrored(profile: Profile | float, length: float) -> Profile | float:
    """A profile along the same road, run the other way."""
    if isinstance(profile, Profile):
        return Profile(*((length - s, v) for s, v in reversed(profile.knots)))
    return profile


class Arm(NamedTuple):
    """An arm of an intersection: the end where traffic enters it and the one where it leaves."""

    enter: Contact | None
    leave: Contact | None


def approach(
    m: Map, name: str, curve: Curve, *, right_turn: float, far: float, height: Profile | float
) -> Road:
    """A one-way carriageway towards an intersection, where a left-turn pocket opens in the median.

    The reference line is the left edge of the pocket. `far` is the width of the median to its right
    at the far end. With `right_turn` (width) a right lane opens too.
    """
    length = curve.length
    s0, s1, s2 = 60.0, length - STORAGE - TAPER, length - STORAGE
    solid = ((0.0, "broken"), (length - SOLID, "solid"))
    left = Lane("left", Profile((s1, 0), (s2, POCKET)), mark=solid)
    through = [Lane("t1", 3.5, mark=solid), Lane("t2", 3.25)]
    right: list[Lane] = []
    before = [Lane("median", Profile((0, far or POCKET), (s0, POCKET)), "median"), *through, walk()]
    if right_turn:
        right = [Lane("right", Profile((s1, 0), (s2, right_turn)))]
        through[1] = through[1]._replace(mark=solid)
    closing = Lane("median", Profile((s1, POCKET), (s2, 0)), "median")
    sections = [
        Section(0, before, centre="none"),
        Section(s1, [closing, left, *through, *right, walk()], centre="none"),
        Section(s2, [left, *through, *right, walk()]),
    ]
    return m.road(name, curve, sections, height=height)


def departure(m: Map, name: str, curve: Curve, *, far: float, height: Profile | float) -> Road:
    """A one-way carriageway away from an intersection, beside the pocket of `approach`."""
    island = Profile((curve.length - 60.0, ISLAND), (curve.length, far or ISLAND))
    lanes = [Lane("median", island, "median"), Lane("out1", 3.5), Lane("out2", 3.25), walk()]
    return m.road(name, curve, [Section(0, lanes, centre="none")], height=height)


def main_arm(
    m: Map,
    name: str,
    curve: Curve,
    *,
    right_turn: float = 0.0,
    far: float = 0.0,
    height: Profile | float = 0.0,
) -> Arm:
    """A dual carriageway with two lanes each way that widens towards the intersection."""
    towards = approach(m, f"{name} in", curve, right_turn=right_turn, far=far, height=height)
    away = departure(m, f"{name} out", curve.reversed(), far=far, height=mirrored(height, curve.length))
    return Arm(towards.end, away.start)


def street(
    m: Map,
    name: str,
    curve: Curve,
    lanes_in: Sequence[Lane],
    lanes_out: Sequence[Lane],
    *,
    height: Profile | float = 0.0,
) -> Arm:
    """A two-way road towards an intersection."""
    solid = ((0.0, "broken"), (curve.length - SOLID, "solid"))
    marked = [lane._replace(mark=solid) for lane in lanes_in[:-1]]
    section = Section(0, [*marked, lanes_in[-1], walk()], [*lanes_out, walk()])
    road = m.road(name, curve, [section], height=height)
    return Arm(road.end, road.end)


def minor_arm(m: Map, name: str, curve: Curve, height: Profile | float = 0.0) -> Arm:
    """A two-way street, two lanes in and one out."""
    lanes = [Lane("left", 3.0), Lane("t1", 3.25)]
    return street(m, name, curve, lanes, [Lane("out1", 3.5)], height=height)


Moves = Sequence[tuple[str, Sequence[str], str, Sequence[str]]]


def connect_all(junction: Junction, arms: dict[str, Arm], moves: Moves) -> dict[str, list[Road]]:
    """Build movements (from arm, lanes, to arm, lanes); the connecting roads by arm they come from."""
    made: dict[str, list[Road]] = {name: [] for name in arms}
    for a, lanes, b, onto in moves:
        source, target = arms[a].enter, arms[b].leave
        assert source and target, f"{junction.name}: no way from {a} to {b}"
        made[a].append(junction.connect(source, lanes, target, onto))
    return made


def furnish(m: Map, arm: Arm, *, stop: bool = True) -> None:
    """Crosswalk and stop line."""
    if arm.leave and (arm.enter is None or arm.leave.road is not arm.enter.road):
        m.crosswalk(arm.leave, 1.0)
    if arm.enter:
        m.crosswalk(arm.enter, 1.0)
        if stop:
            m.stop_line(arm.enter, STOP_BACK, arm.enter.keys(leaving=True))


def signalised(m: Map, name: str, arms: dict[str, Arm], height: float = 0.0) -> None:
    """An intersection with lights: main road W-E (left, t1, t2, perhaps right), minor road N-S (left, t1).

    Four signal groups: main through and right, main left, minor through and right, minor left.
    """
    junction = m.junction(name, height)
    moves: list[tuple[str, Sequence[str], str, Sequence[str]]] = [
        ("W", ["left"], "N", ["out1"]),
        ("W", ["t1", "t2"], "E", ["out1", "out2"]),
        ("E", ["left"], "S", ["out1"]),
        ("E", ["t1", "t2"], "W", ["out1", "out2"]),
        ("N", ["left"], "E", ["out1"]),
        ("N", ["t1"], "S", ["out1"]),
        ("N", ["t1", "walk"], "W", ["out2", "walk"]),
        ("S", ["left"], "W", ["out1"]),
        ("S", ["t1"], "N", ["out1"]),
        ("S", ["t1", "walk"], "E", ["out2", "walk"]),
    ]
    lights: dict[str, list[int]] = {}
    for arm, right_to in (("W", "S"), ("E", "N"), ("N", ""), ("S", "")):
        enter = arms[arm].enter
        assert enter
        through = [key for key in enter.keys(leaving=True) if key in ("t1", "t2")]
        groups = [["left"], through]
        if right_to:
            own = "right" in enter.keys(leaving=True)
            groups += [["right"]] if own else []
            moves.append((arm, ["right" if own else "t2", "walk"], right_to, ["out1", "walk"]))
        furnish(m, arms[arm])
        lights[arm] = [m.light(enter, STOP_BACK, group) for group in groups]
    connect_all(junction, arms, moves)
    for road, pair in (("main road", "WE"), ("minor road", "NS")):
        junction.control(f"{name}, {road}", [light for arm in pair for light in lights[arm][1:]])
        junction.control(f"{name}, {road} left", [lights[arm][0] for arm in pair])


# -------------------------------------------------------------------------------------- roundabout

RING = (Lane("inner", 4.25), Lane("outer", 4.75), walk(2.0))
RING_RADIUS = 25.0  # edge of the central island
RING_MOUTH = 40.0  # from the centre to the ends of the arms
SPLITTER = 4.0  # half of the splitter island at the ring
MOUTH_ANGLE = math.radians(35)  # a junction spans this much of the ring on both sides of its arm


def ring_arm(m: Map, name: str, curve: Curve, height: Profile | float = 0.0) -> Arm:
    """A two-way road with two lanes each way, whose median widens to a splitter island."""
    median = Lane("median", Profile((curve.length - 60.0, 1.0), (curve.length, SPLITTER)), "median")
    lanes_in = [median, Lane("in1", 3.25), Lane("in2", 3.5), walk(2.0)]
    lanes_out = [median, Lane("out1", 3.5), Lane("out2", 3.75), walk(2.0)]
    road = m.road(name, curve, [Section(0, lanes_in, lanes_out, centre="none")], height=height)
    return Arm(road.end, road.end)


def roundabout(
    m: Map, name: str, centre: Pose, arms: Sequence[tuple[float, Arm]], height: float = 0.0
) -> None:
    """A two-lane ring, one junction per arm; arms are (direction from the centre, arm), counter-clockwise.

    The right lane enters the outer ring lane and leaves from it, the left lane the inner one.
    """

    def ring_arc(a: float, b: float) -> Curve:
        start = Pose(centre.x, centre.y, a).move(ahead=RING_RADIUS, turn=math.pi / 2)
        return Curve(start, [Piece((b - a) * RING_RADIUS, 1 / RING_RADIUS, 1 / RING_RADIUS)])

    segments = []
    for i, (a, _) in enumerate(arms):
        b = arms[(i + 1) % len(arms)][0]
        curve = ring_arc(a + MOUTH_ANGLE, a + (b - a) % (2 * math.pi) - MOUTH_ANGLE)
        segments.append(m.road(f"{name} ring {i + 1}", curve, [Section(0, RING)], speed=30, height=height))
    for i, (angle, arm) in enumerate(arms):
        junction = m.junction(f"{name} arm {i + 1}", height)
        before, after = segments[i - 1].end, segments[i].start
        ring = junction.connect(
            before,
            ["inner", "outer"],
            after,
            ["inner", "outer"],
            curve=ring_arc(angle - MOUTH_ANGLE, angle + MOUTH_ANGLE),
            between="broken",
            outside="broken",
        )
        if arm.leave:
            left, right = arm.leave.keys(leaving=False)
            pavement = arm.leave.keys(leaving=False, kind="sidewalk")
            junction.connect(before, ["inner"], arm.leave, [left], speed=30)
            junction.connect(before, ["outer", *pavement], arm.leave, [right, *pavement], speed=30)
            if arm.enter and arm.leave.road is not arm.enter.road:
                m.crosswalk(arm.leave, 7.0)
        if arm.enter:
            left, right = arm.enter.keys(leaving=True)
            low = [
                junction.connect(arm.enter, [left], after, ["inner"], speed=30),
                junction.connect(arm.enter, [right, "walk"], after, ["outer", "walk"], speed=30),
            ]
            junction.priorities += [(ring, road) for road in low]
            m.sign(arm.enter, 0.5, [left, right], "205", name="yield")
            m.crosswalk(arm.enter, 7.0)


# ------------------------------------------------------------------------------------- expressways

EDGE = Lane("edge", 1.0, "shoulder")  # left edge strip
HARD = Lane("hard", 2.5, "shoulder")
LANES = ("l1", "l2", "l3")
FAST = (EDGE, Lane("l1", 3.5), Lane("l2", 3.5), Lane("l3", 3.75))  # lorries keep right
RESERVE = 4.0  # central reserve between the edge strips
AUXILIARY = 3.5  # acceleration and deceleration lanes
OPENING = 75.0  # their tapers
NOSE = 80.0  # length of the junction in which a ramp meets the main road
GORE = 4.25  # at its ramp end: from the main lanes to the ramp lane
GORE_ANGLE = math.radians(4.5)


def expressway(
    m: Map,
    name: str,
    curve: Curve,
    *,
    accelerate: float = 0.0,
    decelerate: float = 0.0,
    offset: float = 0.0,
    height: Profile | float = 0.0,
) -> Road:
    """A one-way carriageway with three lanes; auxiliary lanes of these lengths at its start and end."""

    def lanes(key: str, width: Profile) -> list[Lane]:
        return [*FAST, Lane(key, width, speed=100), HARD]

    sections = [Section(0, [*FAST, HARD], centre="none")]
    if accelerate:
        closing = lanes("merge", Profile((accelerate, AUXILIARY), (accelerate + OPENING, 0)))
        plain = sections[0]._replace(s=accelerate + OPENING)
        sections = [Section(0, closing, centre="none"), Section(accelerate, closing, centre="none"), plain]
    if decelerate:
        s1, s2 = curve.length - decelerate - OPENING, curve.length - decelerate
        opening = lanes("diverge", Profile((s1, 0), (s2, AUXILIARY)))
        sections += [Section(s1, opening, centre="none"), Section(s2, opening, centre="none")]
    return m.road(name, curve, sections, kind="motorway", speed=120, offset=offset, height=height)


def opposite(m: Map, name: str, base: Curve, height: Profile | float = 0.0) -> Road:
    """The carriageway of the other direction, across the central reserve."""
    return expressway(m, name, base.reversed(), offset=-RESERVE, height=mirrored(height, base.length))


def to_ramp() -> float:
    """From the reference line of an expressway to the edge strip of a ramp at its nose."""
    return sum(lane.profile()(0) for lane in FAST) + GORE - RAMP[0].profile()(0)


RAMP = (Lane("edge", 0.75, "shoulder"), Lane("ramp", 4.0), Lane("hard", 2.0, "shoulder"))


def at_speed(lanes: Sequence[Lane], speed: float) -> list[Lane]:
    """The same lanes with another limit."""
    return [lane._replace(speed=speed) if lane.kind == "driving" else lane for lane in lanes]


def merge(m: Map, name: str, before: Road, ramp: Road, after: Road, base: Curve, height: float = 0.0) -> None:
    """The junction where a ramp becomes the acceleration lane."""
    junction = m.junction(name, height)
    main = junction.connect(
        before.end,
        ["edge", *LANES, "hard"],
        after.start,
        ["edge", *LANES, None],
        curve=base,
        between="broken",
        speed=120,
    )
    low = junction.connect(ramp.end, ["edge", "ramp", "hard"], after.start, [None, "merge", "hard"], speed=80)
    junction.priorities.append((main, low))


def diverge(
    m: Map, name: str, before: Road, ramp: Road, after: Road, base: Curve, height: float = 0.0
) -> None:
    """The junction where the deceleration lane becomes a ramp."""
    junction = m.junction(name, height)
    junction.connect(
        before.end,
        ["edge", *LANES, None],
        after.start,
        ["edge", *LANES, "hard"],
        curve=base,
        between="broken",
        speed=120,
    )
    junction.connect(before.end, [None, "diverge", "hard"], ramp.start, ["edge", "ramp", "hard"], speed=80)


# -------------------------------------------------------------------------------------------- maps


def highway() -> Map:
    """Three kilometres of motorway, four lanes each way, bends to both sides."""
    m = Map("highway")
    shape = [
        *[Piece(350), *arc(1100, 28, 180), Piece(250), *arc(900, -33, 180)],
        *[Piece(220), *arc(1500, 14, 150), Piece(300)],
    ]
    base = Curve(Pose(0, 0, 0), shape)
    half = round(base.length / 2, 6)
    driving = [Lane("l1", 3.5), Lane("l2", 3.5), Lane("l3", 3.6), Lane("l4", 3.75, speed=100)]
    lanes = [Lane("median", 1.5, "median"), EDGE, *driving, HARD]
    sections = [Section(0, lanes, lanes, centre="none")]
    west, east = (
        m.road(f"motorway {name}", base.cut(a, b), sections, kind="motorway", speed=120)
        for name, a, b in (("west", 0, half), ("east", half, base.length))
    )
    m.link(west.end, east.start)
    for contact in (west.end, east.start):
        m.speed_sign(contact, contact.road.curve.length - 60, ["l1", "l2", "l3"], 120)
    return m


def ramp() -> Map:
    """A three-lane motorway with an on-ramp and, further on, an off-ramp."""
    m = Map("ramp")
    shape = [Piece(200), *arc(1300, -12, 150), Piece(640), *arc(1200, 14, 150), Piece(520)]
    base = Curve(Pose(0, 0, math.radians(8)), shape)
    on, off = 480.0, 1420.0
    first = expressway(m, "motorway west", base.cut(0, on))
    middle = expressway(m, "motorway middle", base.cut(on + NOSE, off), accelerate=250, decelerate=200)
    last = expressway(m, "motorway east", base.cut(off + NOSE, base.length))
    opposite(m, "motorway opposite", base)
    up = inwards(
        base.pose(on).move(left=-to_ramp(), turn=GORE_ANGLE),
        [Piece(60), *arc(180, 62, 60), Piece(40), *arc(140, -40, 50), Piece(90)],
    )
    down = Curve(
        base.pose(off + NOSE).move(left=-to_ramp(), turn=-GORE_ANGLE),
        [Piece(60), *arc(150, -70, 60), Piece(50), *arc(110, 45, 45), Piece(80)],
    )
    fast = at_speed(RAMP, 80)
    sections = [Section(0, RAMP, centre="none"), Section(up.length - 150, fast, centre="none")]
    on_ramp = m.road("on-ramp", up, sections, kind="motorway", speed=60)
    sections = [Section(0, fast, centre="none"), Section(100, RAMP, centre="none")]
    off_ramp = m.road("off-ramp", down, sections, kind="motorway", speed=60)
    merge(m, "on-ramp nose", first, on_ramp, middle, base.cut(on, on + NOSE))
    diverge(m, "off-ramp nose", middle, off_ramp, last, base.cut(off, off + NOSE))
    m.speed_sign(first.end, first.curve.length - 40, LANES, 120)
    m.speed_sign(on_ramp.end, up.length - 30, ["ramp"], 60)
    m.speed_sign(on_ramp.end, 150, ["ramp"], 80)
    m.speed_sign(off_ramp.end, down.length - 100, ["ramp"], 60)
    return m


def intersection() -> Map:
    """A signalised intersection with turn lanes; the south arm is bent and meets it at an angle."""
    m = Map("intersection")
    bent = [Piece(35), *arc(160, -30, 40), Piece(80)]
    arms = {
        "W": main_arm(m, "west", inwards(Pose(-18, SHIFT, 0), [Piece(200)]), right_turn=POCKET),
        "E": main_arm(m, "east", inwards(Pose(18, -SHIFT, math.pi), [Piece(200)])),
        "N": minor_arm(m, "north", inwards(Pose(1.5, 23, -math.pi / 2), [Piece(200)])),
        "S": minor_arm(m, "south", inwards(Pose(-3.0, -26, math.radians(84)), bent)),
    }
    signalised(m, "crossing", arms)
    return m


def roundabout_map() -> Map:
    """A two-lane roundabout with four arms that are not quite at right angles."""
    m = Map("roundabout")
    centre = Pose(0, 0, 0)
    shapes = {
        "east": (0.0, [Piece(150)]),
        "north": (94.0, [Piece(70), *arc(150, 18, 30), Piece(33)]),
        "west": (180.0, [Piece(150)]),
        "south": (268.0, [Piece(70), *arc(180, -16, 30), Piece(30)]),
    }
    arms = []
    for name, (degrees, pieces) in shapes.items():
        angle = math.radians(degrees)
        mouth = centre.move(turn=angle).move(ahead=RING_MOUTH, turn=math.pi)
        arms.append((angle, ring_arm(m, name, inwards(mouth, pieces))))
    roundabout(m, "roundabout", centre, arms)
    return m


def long_route() -> Map:
    """Town, lights, roundabout, on-ramp, motorway, off-ramp and a stop-controlled crossing in a row."""
    m = Map("long_route")

    # 1. a signalised intersection; the route starts on its west arm and leaves on the avenue
    start = [Piece(140), *arc(250, 15, 50), Piece(60)]
    avenue = [Piece(190), *arc(180, -34, 60), Piece(60), *arc(160, 22, 50), Piece(70)]
    avenue = inwards(Pose(18, -SHIFT, math.pi), avenue)
    south = [Piece(50), *arc(150, 20, 30), Piece(50)]
    z_ring = 3.0
    slope = Profile((70, z_ring), (avenue.length - 70, 0))
    arms = {
        "W": main_arm(m, "start", inwards(Pose(-18, SHIFT, 0), start)),
        "E": main_arm(m, "avenue", avenue, far=SPLITTER, height=slope),
        "N": minor_arm(m, "first north", inwards(Pose(1.5, 23, -math.pi / 2), [Piece(150)])),
        "S": minor_arm(m, "first south", inwards(Pose(-1.5, -23, math.pi / 2), south)),
    }
    signalised(m, "first crossing", arms)

    # 2. a roundabout; its arm opposite the avenue is the on-ramp
    towards, away = arms["E"].leave, arms["E"].enter
    assert towards and away
    centre = avenue.start.move(ahead=-RING_MOUTH)
    mouths = [centre.move(turn=math.radians(d)).move(ahead=RING_MOUTH) for d in (0, 92, 180, 272)]
    south = inwards(mouths[1].move(turn=math.pi), [Piece(80), *arc(200, 12, 20), Piece(30)])
    north = inwards(mouths[3].move(turn=math.pi), [Piece(150)])
    ring_south = ring_arm(m, "ring south", south, z_ring)
    ring_north = ring_arm(m, "ring north", north, z_ring)
    z_road = 8.0
    shape = [Piece(150), *arc(150, 38, 60), Piece(60), *arc(220, -48, 70), Piece(60)]
    up = Curve(mouths[2].move(left=-SPLITTER), shape)
    ending = Profile((90, 3.75), (150, 0))
    two = [RAMP[0], Lane("ramp", 3.5), Lane("ends", ending), RAMP[2]]
    widening = Lane("ramp", Profile((150, 3.5), (210, 4.0)))
    one = [RAMP[0], widening, RAMP[2]]
    on_ramp = m.road(
        "on-ramp",
        up,
        [
            Section(0, two, centre="none"),
            Section(90, two, centre="none"),
            Section(150, one, centre="none"),
            Section(up.length - 150, at_speed(one, 80), centre="none"),
        ],
        speed=60,
        height=Profile((40, z_ring), (up.length - 40, z_road)),
    )
    ring = [
        (centre.heading, Arm(towards.road.end, away.road.start)),
        (mouths[1].heading, ring_south),
        (mouths[2].heading, Arm(None, on_ramp.start)),
        (mouths[3].heading, ring_north),
    ]
    roundabout(m, "roundabout", centre, ring, z_ring)

    # 3. motorway: acceleration lane, bends over a hill and through a dip, deceleration lane
    on = 300.0
    begin = up.end.move(turn=-GORE_ANGLE).move(left=to_ramp(), ahead=-on)
    shape = [
        *[Piece(on + NOSE + 380), *arc(1000, 30, 200), Piece(150), *arc(1200, -36, 220)],
        *[Piece(200), *arc(900, 20, 160), Piece(900)],
    ]
    base = Curve(begin, shape)
    off = base.length - 400.0
    between = base.cut(on + NOSE, off)
    z_exit = 6.0
    hill = Profile((330, z_road), (800, 16), (1350, 3), (between.length - 280, z_exit))
    first = expressway(m, "motorway west", base.cut(0, on), height=z_road)
    middle = expressway(m, "motorway", between, accelerate=250, decelerate=200, height=hill)
    last = expressway(m, "motorway east", base.cut(off + NOSE, base.length), height=z_exit)
    whole = Profile(*((s + on + NOSE, z) for s, z in hill.knots))
    opposite(m, "motorway opposite", base, whole)
    merge(m, "on-ramp nose", first, on_ramp, middle, base.cut(on, on + NOSE), z_road)

    # 4. off-ramp to a crossing where it has to stop; the route ends on the left arm
    z_end = 1.5
    shape = [Piece(80), *arc(160, -64, 60), Piece(60), *arc(140, 30, 50), Piece(130)]
    down = Curve(base.pose(off + NOSE).move(left=-to_ramp(), turn=-GORE_ANGLE), shape)
    s1, s2 = down.length - 100, down.length - 60
    slow = [*at_speed(RAMP[:2], 50), walk(2.0)]
    solid = ((0.0, "broken"), (down.length - SOLID, "solid"))
    opening = [
        slow[0],
        slow[1]._replace(mark=solid),
        Lane("right", Profile((s1, 0), (s2, 3.5)), speed=50),
        slow[2],
    ]
    off_ramp = m.road(
        "off-ramp",
        down,
        [
            Section(0, at_speed(RAMP, 80), centre="none"),
            Section(120, RAMP, centre="none"),
            Section(s1 - 60, slow, centre="none"),
            Section(s1, opening, centre="none"),
            Section(s2, opening, centre="none"),
        ],
        speed=60,
        height=Profile((40, z_exit), (down.length - 80, z_end)),
    )
    diverge(m, "off-ramp nose", middle, off_ramp, last, base.cut(off, off + NOSE), z_exit)
    middle_of_crossing = down.end.move(ahead=17)
    ends = {
        name: middle_of_crossing.move(turn=math.radians(turn)).move(ahead=ahead, left=left, turn=math.pi)
        for name, turn, ahead, left in (("left", 90, 16, 0), ("right", -90, 21, 0), ("across", 0, 17, -0.75))
    }
    shapes = {
        "left": ("finish", [Piece(120), *arc(220, -16, 40), Piece(90)], 3.5),
        "right": ("last right", [Piece(150)], 3.5),
        "across": ("last across", [Piece(60), *arc(140, 14, 20), Piece(60)], 3.25),
    }
    last_arms = {"ramp": Arm(off_ramp.end, None)}
    for key, (name, shape, width) in shapes.items():
        curve = inwards(ends[key], shape)
        last_arms[key] = street(m, name, curve, [Lane("t1", width)], [Lane("out1", width)], height=z_end)
    crossing = m.junction("last crossing", z_end)
    moves: Moves = [
        ("ramp", ["ramp"], "left", ["out1"]),
        ("ramp", ["ramp"], "across", ["out1"]),
        ("ramp", ["right", "walk"], "right", ["out1", "walk"]),
        ("left", ["t1"], "right", ["out1"]),
        ("left", ["t1"], "across", ["out1"]),
        ("right", ["t1"], "left", ["out1"]),
        ("right", ["t1", "walk"], "across", ["out1", "walk"]),
        ("across", ["t1"], "right", ["out1"]),
        ("across", ["t1", "walk"], "left", ["out1", "walk"]),
    ]
    made = connect_all(crossing, last_arms, moves)
    minor = [*made["ramp"], *made["across"]]
    crossing.priorities += [(high, low) for high in [*made["left"], *made["right"]] for low in minor]
    stop, priority = ("206", "stop"), ("306", "priority road")
    for key, (sign, name) in {"ramp": stop, "across": stop, "left": priority, "right": priority}.items():
        enter = last_arms[key].enter
        assert enter
        furnish(m, last_arms[key], stop=sign == "206")
        m.sign(enter, STOP_BACK, enter.keys(leaving=True), sign, name=name)
    return m


MAPS = {
    "highway": highway,
    "ramp": ramp,
    "intersection": intersection,
    "roundabout": roundabout_map,
    "long_route": long_route,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the maps, or compare them with the files."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing; fail if a file differs")
    check = parser.parse_args(arguments).check
    stale = []
    for name, build in MAPS.items():
        path, data = FOLDER / f"{name}.xodr", build().write()
        if not check:
            path.write_bytes(data)
        elif not path.is_file() or path.read_bytes() != data:
            stale.append(path.name)
    if stale:
        print(f"not what generate.py writes: {', '.join(stale)}", file=sys.stderr)
    return 1 if stale else 0


if __name__ == "__main__":
    sys.exit(main())
