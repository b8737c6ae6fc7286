"""OpenDRIVE's formulas, evaluated directly at one place at a time.

A second referee beside CARLA's parser, for the places where CARLA is no oracle, and the truth of the
property tests. It shares no code with `limsim_jax.maps.opendrive` and is slow and plain on purpose:
Fresnel integrals for spirals, adaptive quadrature for the arc length of poly3.
"""

from __future__ import annotations

import itertools
import math
from bisect import bisect_right
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import quad, solve_ivp
from scipy.special import fresnel, roots_legendre

Element = Any  # lxml's element type has no stubs
Array = NDArray[np.float64]
LaneEnd = tuple[str, int]  # road, lane number
LaneKey = tuple[str, int, int]  # road, section, lane number
LaneEdge = tuple[str, int, int, bool]  # road, section, lane number, whether its end at larger s


def _number(element: Element, name: str, default: float = 0.0) -> float:
    return float(element.get(name, default))


@lru_cache
def _legendre(order: int) -> tuple[Array, Array]:
    nodes, weights = roots_legendre(order)
    return np.asarray(nodes), np.asarray(weights)


@dataclass(frozen=True)
class Cubics:
    """Cubic records `a b c d`, each from its `s0` on."""

    s0: Array
    coefficients: Array  # [K, 4]

    @classmethod
    def read(cls, elements: list[Element], start: str) -> Cubics:
        """Records in ascending order of their start; of two with the same start the later one holds."""
        elements = sorted(elements, key=lambda e: _number(e, start))
        return cls(
            np.array([_number(e, start) for e in elements]),
            np.array([[_number(e, k) for k in "abcd"] for e in elements]).reshape(-1, 4),
        )

    def __call__(self, s: Array) -> tuple[Array, Array]:
        """Value and slope. Before the first record, and without records, both are zero."""
        if not len(self.s0):
            return np.zeros_like(s), np.zeros_like(s)
        i = np.searchsorted(self.s0, s, side="right") - 1
        a, b, c, d = np.where(i[:, None] >= 0, self.coefficients[np.maximum(i, 0)], 0.0).T
        u = s - self.s0[np.maximum(i, 0)]
        return a + u * (b + u * (c + u * d)), b + u * (2 * c + u * 3 * d)


@dataclass(frozen=True)
class Geometry:
    """One record of the plan view."""

    s0: float
    x: float
    y: float
    heading: float
    length: float
    shape: Element

    def __call__(self, s: Array) -> tuple[Array, Array, Array, Array, Array]:
        """x, y, heading and the derivatives of path and heading at `s`."""
        u = s - self.s0
        kind = self.shape.tag
        if kind == "line":
            return self._place(u, np.zeros_like(u), np.zeros_like(u), np.ones_like(u), np.zeros_like(u))
        if kind in ("arc", "spiral"):
            k0 = _number(self.shape, "curvature" if kind == "arc" else "curvStart")
            k1 = k0 if kind == "arc" else _number(self.shape, "curvEnd")
            rate = (k1 - k0) / self.length
            turn = k0 * u + rate * u * u / 2
            x, y = _clothoid(k0, rate, u)
            return self._place(x, y, turn, np.ones_like(u), k0 + rate * u)
        if kind in ("poly3", "paramPoly3"):
            return self._parametric(u)
        raise ValueError(f"line {self.shape.sourceline}: no formula for <{kind}>")

    def _place(
        self, x: Array, y: Array, turn: Array, speed: Array, turn_rate: Array
    ) -> tuple[Array, Array, Array, Array, Array]:
        c, s = math.cos(self.heading), math.sin(self.heading)
        return self.x + c * x - s * y, self.y + s * x + c * y, self.heading + turn, speed, turn_rate

    @cached_property
    def _curve(self) -> tuple[Array, Array, float, Any]:
        """Cubics of a parametric record, its stretch, and the parameter along it.

        `s` is arc length (OpenDRIVE 1.8, 7.1), not the parameter: dp/ds = 1 / |r'(p)|. Where the curve of
        a paramPoly3 is longer or shorter than its record says, the difference is spread evenly.
        """
        stretch = 1.0
        if self.shape.tag == "poly3":
            x, y = np.array([0.0, 1.0, 0.0, 0.0]), np.array([_number(self.shape, k) for k in "abcd"])
        else:
            x, y = (np.array([_number(self.shape, k + axis) for k in "abcd"]) for axis in "UV")
            p_end = self.length if self.shape.get("pRange") == "arcLength" else 1.0
            total, _ = quad(_speed, 0.0, p_end, (x, y), epsabs=1e-12, epsrel=1e-12, limit=200)
            stretch = total / self.length
        path = solve_ivp(
            lambda _, p: stretch / _speed(p, x, y),
            (0.0, self.length + 1.0),
            [0.0],
            rtol=1e-12,
            atol=1e-12,
            method="DOP853",
            dense_output=True,
        )
        return x, y, stretch, path.sol

    def _parametric(self, u: Array) -> tuple[Array, Array, Array, Array, Array]:
        x_, y_, stretch, parameter = self._curve
        p = parameter(u)[0] if len(u) else u
        (x, dx, ddx), (y, dy, ddy) = _cubic(x_, p), _cubic(y_, p)
        turn_rate = (dx * ddy - dy * ddx) / _speed(p, x_, y_) ** 3 * stretch
        return self._place(x, y, np.arctan2(dy, dx), np.full_like(u, stretch), turn_rate)


def _speed(p: Any, x: Array, y: Array) -> Any:
    return np.hypot(_cubic(x, p)[1], _cubic(y, p)[1])


def _cubic(c: Array, p: Any) -> tuple[Any, Any, Any]:
    """Value and derivatives of a cubic."""
    return (
        c[0] + p * (c[1] + p * (c[2] + p * c[3])),
        c[1] + p * (2 * c[2] + 3 * c[3] * p),
        2 * c[2] + 6 * c[3] * p,
    )


def _clothoid(k0: float, rate: float, u: Array) -> tuple[Array, Array]:
    """x, y of a clothoid with curvature `k0 + rate * u`."""
    if rate and abs(k0 * k0 / rate) < 100:
        # Complete the square of the heading; the Fresnel integrals take pi/2 t^2.
        scale, shift = math.sqrt(abs(rate) / math.pi), k0 / rate
        sin1, cos1 = fresnel(scale * (u + shift))
        sin0, cos0 = fresnel(scale * shift)
        x, y = (cos1 - cos0) / scale, math.copysign(1.0, rate) * (sin1 - sin0) / scale
        tilt = -k0 * k0 / (2 * rate)
        return x * math.cos(tilt) - y * math.sin(tilt), x * math.sin(tilt) + y * math.cos(tilt)
    # Almost an arc: the square is far away and the difference of Fresnel integrals loses its digits.
    nodes, weights = _legendre(60)
    t = u[:, None] * (nodes + 1) / 2
    turn = k0 * t + rate * t * t / 2
    return u / 2 * (np.cos(turn) @ weights), u / 2 * (np.sin(turn) @ weights)


@dataclass(frozen=True)
class LaneRecord:
    """A lane of one lane section as the file has it."""

    road: str
    section: int
    number: int
    type: str
    s0: float
    s1: float


@dataclass(frozen=True)
class LanePlace:
    """Lane centre at some places: position (m), direction of travel (rad), width (m)."""

    x: Array
    y: Array
    heading: Array
    width: Array
    speed: Array  # metres along the lane centre per metre of road coordinate
    valid: NDArray[np.bool_]  # False where this lane or one between it and lane 0 has a negative width

    @property
    def pose(self) -> Array:
        """x, y and heading `[K, 3]`."""
        return np.stack([self.x, self.y, self.heading], -1)


class RoadFormulas:
    """One <road>."""

    def __init__(self, element: Element) -> None:
        """Take the records of this element."""
        self.element = element
        self.id = element.get("id", "")
        self.length = _number(element, "length")
        self.left_hand = element.get("rule") == "LHT"
        self.geometries = sorted(
            (
                Geometry(
                    s0=_number(g, "s"),
                    x=_number(g, "x"),
                    y=_number(g, "y"),
                    heading=_number(g, "hdg"),
                    length=_number(g, "length"),
                    shape=next(g.iterchildren("*")),
                )
                for g in element.iterfind("planView/geometry")
            ),
            key=lambda g: g.s0,
        )
        self.offset = Cubics.read(element.findall("lanes/laneOffset"), "s")
        self.elevation = Cubics.read(element.findall("elevationProfile/elevation"), "s")
        self.sections = sorted(element.findall("lanes/laneSection"), key=lambda e: _number(e, "s"))
        self.starts = [_number(e, "s") for e in self.sections]

    def reference(self, s: ArrayLike) -> tuple[Array, Array, Array, Array, Array]:
        """Reference line: x, y, heading, |dr/ds|, dheading/ds at road coordinates `s`."""
        s = np.atleast_1d(np.asarray(s, float))
        out = np.zeros((5, len(s)))
        which = np.maximum(np.searchsorted([g.s0 for g in self.geometries], s, side="right") - 1, 0)
        for i in np.unique(which):
            out[:, which == i] = self.geometries[i](s[which == i])
        x, y, heading, speed, turn_rate = out
        return x, y, heading, speed, turn_rate

    def point(self, s: float, t: float, turn: float = 0.0, u: float = 0.0, v: float = 0.0) -> Array:
        """The place `[2]` at `u, v` in turned axes at (s, t)."""
        x, y, heading, _, _ = (float(a[0]) for a in self.reference(s))
        c, n = math.cos(heading + turn), math.sin(heading + turn)
        return np.array(
            [x - t * math.sin(heading) + u * c - v * n, y + t * math.cos(heading) + u * n + v * c]
        )

    def section_at(self, s: float) -> int:
        """Index of the lane section that holds at `s`."""
        return max(bisect_right(self.starts, s) - 1, 0)

    def runs_with_s(self, number: int) -> bool:
        """Whether traffic on this lane goes towards larger road coordinates."""
        return (number < 0) != self.left_hand

    def edge(self, number: int, at_end: bool) -> LaneEdge:
        """The end of a lane at one end of the road."""
        return self.id, len(self.sections) - 1 if at_end else 0, number, at_end

    @cached_property
    def lane_elements(self) -> dict[tuple[int, int], Element]:
        """(section, lane number) -> its element."""
        return {
            (i, int(lane.get("id", "0"))): lane
            for i, section in enumerate(self.sections)
            for lane in section.iterfind("*/lane")
        }

    def type(self, section: int, number: int) -> str:
        """Type of a lane record, or "" where there is none."""
        lane = self.lane_elements.get((section, number))
        return "" if lane is None else lane.get("type", "none")

    @cached_property
    def lanes(self) -> list[LaneRecord]:
        """All lane records except the centre lanes."""
        ends = [*self.starts[1:], self.length]
        return [
            LaneRecord(
                self.id, i, int(lane.get("id", "0")), lane.get("type", "none"), self.starts[i], ends[i]
            )
            for i, section in enumerate(self.sections)
            for side in ("left", "right")
            for lane in section.iterfind(f"{side}/lane")
        ]

    @cached_property
    def _profiles(self) -> dict[tuple[int, int], tuple[Cubics, bool]]:
        """(section, lane) -> width or border records, and whether they are borders."""
        found = {}
        for key, lane in self.lane_elements.items():
            widths, borders = lane.findall("width"), lane.findall("border")
            found[key] = Cubics.read(widths or borders, "sOffset"), bool(borders) and not widths
        return found

    def lane(self, section: int, number: int, s: ArrayLike) -> LanePlace:
        """Centre of a lane at road coordinates `s`."""
        s = np.atleast_1d(np.asarray(s, float))
        x, y, heading, speed, turn_rate = self.reference(s)
        shift, shift_slope = self.offset(s)
        side = 1 if number > 0 else -1
        inner, inner_slope = np.zeros_like(s), np.zeros_like(s)
        outer, outer_slope = inner, inner_slope
        valid = np.ones(len(s), bool)
        for n in range(side, number + side, side):
            if (section, n) not in self._profiles:
                continue
            records, is_border = self._profiles[section, n]
            value, slope = records(s - self.starts[section])
            inner, inner_slope = outer, outer_slope
            outer, outer_slope = (
                (side * value, side * slope) if is_border else (inner + value, inner_slope + slope)
            )
            valid &= outer - inner > -1e-9
        t = shift + side * (inner + outer) / 2
        t_slope = shift_slope + side * (inner_slope + outer_slope) / 2
        # d(r + t n)/ds = (|r'| - heading' t) T + t' n
        along = speed - turn_rate * t
        travel = heading + np.arctan2(t_slope, along)
        if not self.runs_with_s(number):
            travel = travel + math.pi
        return LanePlace(
            x - t * np.sin(heading),
            y + t * np.cos(heading),
            travel,
            outer - inner,
            np.hypot(along, t_slope),
            valid,
        )

    def mark(self, section: int, number: int, to_left: bool, s: float) -> str:
        """The road mark between a lane and its neighbour on one side."""
        towards = 1 if to_left == self.runs_with_s(number) else -1  # lanes ascend to the left of the road
        neighbour = number + towards
        # A lane bears the mark of its border away from lane 0; lane 0 bears that between -1 and 1.
        between = min(number, neighbour, key=abs)
        lane = self.lane_elements.get((section, between))
        marks = [] if lane is None else lane.findall("roadMark")
        marks = [m for m in marks if _number(m, "sOffset") <= s - self.starts[section] + 1e-9]
        if not marks:
            return "no mark"
        mark = max(marks, key=lambda m: _number(m, "sOffset"))
        change = mark.get("laneChange")
        return f"{mark.get('type')}, " + ("laneChange absent" if change is None else f"laneChange={change}")

    def breaks(self, number: int, s: float, reach: float) -> tuple[float, float]:
        """Largest gap (m) and kink (rad) within `reach` of `s`.

        Gaps of 5 cm and more do not count: there another lane begins.
        """
        side = 1 if number > 0 else -1
        knots = {g.s0 for g in self.geometries} | set(self.offset.s0.tolist()) | set(self.starts)
        for (section, n), (records, _) in self._profiles.items():
            if n * side > 0 and abs(n) <= abs(number):
                knots |= {self.starts[section] + float(b) for b in records.s0}
        gaps, kinks = [0.0], [0.0]
        for knot in (k for k in knots if abs(k - s) <= reach):
            before, after = max(knot - 1e-7, 0.0), min(knot + 1e-7, self.length)
            sections = self.section_at(before), self.section_at(after)
            if any((i, number) not in self.lane_elements for i in sections):
                continue
            a, b = (self.lane(i, number, at).pose[0] for i, at in zip(sections, (before, after), strict=True))
            (dx, dy, turn), heading = b - a, a[2]
            sideways = abs(dy * math.cos(heading) - dx * math.sin(heading))
            if sideways < 0.05:
                gaps.append(sideways)
                kinks.append(abs(math.remainder(turn, math.tau)))
        return max(gaps), max(kinks)

    def lane_length(self, record: LaneRecord) -> float:
        """Arc length (m) of a lane centre, by Gauss-Legendre between records."""
        breaks = {record.s0, record.s1}
        breaks |= {g.s0 for g in self.geometries} | set(self.offset.s0.tolist())
        for (section, _), (records, _) in self._profiles.items():
            if section == record.section:
                breaks |= {record.s0 + float(b) for b in records.s0}
        edges = np.array(sorted(b for b in breaks if record.s0 <= b <= record.s1))
        if len(edges) < 2:
            return 0.0
        pieces = [
            np.linspace(a, b, max(2, math.ceil((b - a) / 20) + 1)) for a, b in itertools.pairwise(edges)
        ]
        nodes, weights = _legendre(12)
        lo = np.concatenate([p[:-1] for p in pieces])
        hi = np.concatenate([p[1:] for p in pieces])
        at = lo[:, None] + (hi - lo)[:, None] * (nodes + 1) / 2
        speed = self.lane(record.section, record.number, at.ravel()).speed.reshape(at.shape)
        return float(((hi - lo) / 2) @ (speed @ weights))


class OpenDriveFormulas:
    """All roads of a file, by id."""

    def __init__(self, source: str | Path | bytes) -> None:
        """Parse a file or the bytes of one."""
        parser = etree.XMLParser(resolve_entities=False, no_network=True, huge_tree=True, recover=False)
        data = source if isinstance(source, bytes) else Path(source).read_bytes()
        root = etree.fromstring(data, parser)
        for element in root.iter("*"):  # some exporters put every element in a namespace
            element.tag = etree.QName(element).localname
        self.root = root
        self.roads = {road.id: road for road in map(RoadFormulas, root.iterfind("road"))}

    def driving_lanes(self) -> list[LaneRecord]:
        """Lane records of type driving."""
        return [lane for road in self.roads.values() for lane in road.lanes if lane.type == "driving"]

    def driving_length(self) -> float:
        """Summed arc length of the driving lanes, m."""
        return sum(self.roads[lane.road].lane_length(lane) for lane in self.driving_lanes())

    def signal_lanes(self) -> list[tuple[str, str, str, int]]:
        """The driving lanes that signals and their references govern.

        As (type, id, road, lane number). Lanes of the validity records, or, without these, of the
        direction that `orientation` gives.
        """
        kinds = {signal.get("id"): signal.get("type", "") for signal in self.root.iter("signal")}
        found = []
        for road in self.roads.values():
            for signal in road.element.iterfind("signals/*"):
                if signal.tag not in ("signal", "signalReference"):
                    continue
                kind = signal.get("type", "") if signal.tag == "signal" else kinds.get(signal.get("id"), "")
                section = road.section_at(min(max(_number(signal, "s"), 0.0), road.length))
                ranges = [
                    sorted((int(v.get("fromLane", "0")), int(v.get("toLane", "0"))))
                    for v in signal.iterfind("validity")
                ]
                way = signal.get("orientation", "none")
                for i, number in road.lane_elements:
                    if i != section or number == 0 or road.type(i, number) != "driving":
                        continue
                    if (
                        any(lo <= number <= hi for lo, hi in ranges)
                        if ranges
                        else way not in ("+", "-") or road.runs_with_s(number) == (way == "+")
                    ):
                        found.append((kind, signal.get("id", ""), road.id, number))
        return found

    def crosswalks(self) -> list[tuple[Array, Array]]:
        """Corners `[K, 2]` of every crosswalk, without and with the lane offset.

        `t` is measured from the reference line (OpenDRIVE 1.8, 7.3), to which the lane offset adds nothing.
        """
        found = []
        for road in self.roads.values():
            for thing in road.element.iterfind("objects/object"):
                if thing.get("type") != "crosswalk":
                    continue
                outline = next(thing.iter("outline"), ())
                on_road = [(_number(c, "s"), _number(c, "t")) for c in outline if c.tag == "cornerRoad"]
                local = [(_number(c, "u"), _number(c, "v")) for c in outline if c.tag == "cornerLocal"]
                if not on_road and not local:
                    u, v = _number(thing, "length") / 2, _number(thing, "width") / 2
                    local = [(-u, -v), (u, -v), (u, v), (-u, v)]
                s, t = _number(thing, "s"), _number(thing, "t")
                shift = float(road.offset(np.array([s]))[0][0])
                corners = [
                    [road.point(*corner) for corner in on_road]
                    or [road.point(s, t + by, _number(thing, "hdg"), *corner) for corner in local]
                    for by in (0.0, shift)
                ]
                found.append((np.array(corners[0]), np.array(corners[1])))
        return found

    def junction_ids(self) -> list[str]:
        """Ids of the junctions, in the order of the file."""
        return [junction.get("id", "") for junction in self.root.iterfind("junction")]

    def roads_inside(self, junction: str) -> set[str]:
        """Ids of the roads that cross a junction."""
        return {road.id for road in self.roads.values() if road.element.get("junction") == junction}

    def _joints(self) -> Iterator[tuple[LaneEdge, LaneEdge]]:
        """Pairs of lane ends that a link joins, in file order."""
        for road in self.roads.values():
            last = len(road.sections) - 1
            for (section, number), lane in road.lane_elements.items():
                for side in ("predecessor", "successor"):
                    target = lane.find(f"link/{side}")
                    if target is None:
                        continue
                    at_end = side == "successor"
                    here, other = (road.id, section, number, at_end), int(target.get("id", "0"))
                    if section != (last if at_end else 0):
                        yield here, (road.id, section + (1 if at_end else -1), other, not at_end)
                        continue
                    link = road.element.find(f"link/{side}")
                    after = self.roads.get(link.get("elementId", "")) if link is not None else None
                    if link is not None and after is not None and link.get("elementType") == "road":
                        yield here, after.edge(other, link.get("contactPoint") == "end")
        for junction in self.root.iterfind("junction"):
            for connection in junction.iterfind("connection"):
                incoming = self.roads.get(connection.get("incomingRoad", ""))
                road = self.roads.get(connection.get("linkedRoad") or connection.get("connectingRoad", ""))
                if incoming is None or road is None:
                    continue
                at_end = connection.get("contactPoint") == "end"
                links = [
                    (int(link.get("from", "0")), int(link.get("to", "0")))
                    for link in connection.iterfind("laneLink")
                ] or [(n, n) for _, _, n, _ in (road.edge(lane.number, at_end) for lane in road.lanes)]
                ends = [
                    side == "successor"
                    for side in ("predecessor", "successor")
                    for link in incoming.element.iterfind(f"link/{side}")
                    if link.get("elementType") == "junction" and link.get("elementId") == junction.get("id")
                ]
                for first, number in links:
                    # A road that touches the junction with both ends: this lane's traffic leaves by one.
                    end = ends[0] if len(ends) == 1 else incoming.runs_with_s(first)
                    yield incoming.edge(first, end), road.edge(number, at_end)

    def movements(self) -> dict[str, set[tuple[LaneEnd, LaneEnd]]]:
        """Junction id -> pairs of incoming and outgoing lanes (road, number).

        Driving lanes join them. A link says that two lane ends meet, whichever of the two roads records
        it; the traffic rule says which way it is driven. A connection without lane links joins lanes of
        equal numbers.
        """
        successors: dict[LaneKey, set[LaneKey]] = {}
        for a, b in self._joints():
            for (road, section, number, at_end), other in ((a, b), (b, a)):
                here = self.roads[road]
                leaves = here.type(section, number) == "driving" and at_end == here.runs_with_s(number)
                there = self.roads[other[0]]
                enters = there.type(*other[1:3]) == "driving" and other[3] != there.runs_with_s(other[2])
                if leaves and enters:
                    successors.setdefault((road, section, number), set()).add(other[:3])
        found: dict[str, set[tuple[LaneEnd, LaneEnd]]] = {}
        for junction in self.root.iterfind("junction"):
            id_ = junction.get("id", "")
            found[id_] = paths_across(successors, self.roads_inside(id_))
            if junction.get("type") == "direct":
                found[id_] |= {
                    ((a[0], a[2]), (b[0], b[2]))
                    for connection in junction.iterfind("connection")
                    for a, after in successors.items()
                    for b in after
                    if {a[0], b[0]} == {connection.get("incomingRoad"), connection.get("linkedRoad")}
                }
        return found


def paths_across(
    successors: Mapping[LaneKey, Iterable[LaneKey]], inside: Container[str]
) -> set[tuple[LaneEnd, LaneEnd]]:
    """Pairs of lanes outside these roads that lanes inside join."""
    found: set[tuple[LaneEnd, LaneEnd]] = set()
    for start, after in successors.items():
        if start[0] in inside:
            continue
        front, seen = [lane for lane in after if lane[0] in inside], set[LaneKey]()
        while front:
            lane = front.pop()
            if lane in seen:
                continue
            seen.add(lane)
            for following in successors.get(lane, ()):
                if following[0] in inside:
                    front.append(following)
                else:
                    found.add(((start[0], start[2]), (following[0], following[2])))
    return found
