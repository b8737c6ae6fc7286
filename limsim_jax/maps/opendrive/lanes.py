"""Lanes of an OpenDRIVE road: from polynomials to sampled centre lines.

A road is cut into pieces on which nothing changes but the geometry: at every lane section, speed,
access or lane-change permission that really differs. Sections that only continue each other are
joined, so that there are no lanes of a few centimetres.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps.network import DRIVABLE, MOTOR_CLASSES, ImportReport, Lane, LaneType
from limsim_jax.maps.opendrive.curves import Array, Cubics
from limsim_jax.maps.opendrive.records import Mark, RawLane, RawRoad, RawSection

MIN_SECTION = 1e-3  # m; a lane section shorter than this holds no traffic
MIN_WIDTH = 0.05  # m; a lane that nowhere gets wider does not exist for its neighbours
JUMP = 0.01  # m; where lane edges jump by more, the lane is cut
FOLD = 0.5  # m; the same where the reference line turns on the spot, and lanes beside it leap
_SHORTEST = 2e-3  # m; records that hold for less are rounding errors of the writer
_HERMITE = 1e-5  # m, tolerated error of cubic Hermite interpolation between samples
_LINEAR = 5e-4  # m, tolerated error of linear interpolation of widths between samples
_BRIDGE = 120.0  # a sideways jump is smoothed over this multiple of it: headings are off by 1.5 / 120 rad
_X, _W = np.polynomial.legendre.leggauss(4)
_X, _W = (_X + 1) / 2, _W / 2

DEFAULT_SPEED = {  # m/s where the file gives none, by road type
    "motorway": 130 / 3.6,
    "rural": 100 / 3.6,
    "townExpressway": 70 / 3.6,
    "lowSpeed": 30 / 3.6,
    "townPrivate": 30 / 3.6,
    "townLocal": 30 / 3.6,
    "townPlayStreet": 10 / 3.6,
    "bicycle": 25 / 3.6,
    "pedestrian": 5 / 3.6,
}
URBAN_SPEED = 50 / 3.6
NO_LIMIT_SPEED = 130 / 3.6

_TYPES = {t.value.lower(): t for t in LaneType} | {
    "mwyentry": LaneType.ENTRY,
    "mwyexit": LaneType.EXIT,
    "special1": LaneType.SPECIAL,
    "special2": LaneType.SPECIAL,
    "special3": LaneType.SPECIAL,
    "roadworks": LaneType.ROAD_WORKS,
}
_ACCESS = {
    LaneType.BUS: frozenset({"bus", "emergency"}),
    LaneType.TAXI: frozenset({"taxi", "emergency"}),
    LaneType.HOV: MOTOR_CLASSES - {"truck"},
    LaneType.BIKING: frozenset({"bicycle"}),
    LaneType.SIDEWALK: frozenset({"pedestrian"}),
    LaneType.WALKING: frozenset({"pedestrian"}),
    LaneType.BIDIRECTIONAL: MOTOR_CLASSES,
    LaneType.TRAM: frozenset({"tram"}),
    LaneType.RAIL: frozenset({"rail"}),
}
_RESTRICTIONS = {
    "passengercar": "car",
    "delivery": "van",
    "truck": "truck",
    "trucks": "truck",
    "bus": "bus",
    "emergency": "emergency",
    "motorcycle": "motorcycle",
    "taxi": "taxi",
    "bicycle": "bicycle",
    "pedestrian": "pedestrian",
}

LaneKey = tuple[str, int, int]  # road id, piece index, lane number


def lane_id(key: LaneKey) -> str:
    """The id of a lane in the network."""
    road, piece, number = key
    return f"{road}_{piece}_{number}"


@dataclass(frozen=True)
class Attributes:
    """What is constant along a lane of a piece."""

    type: LaneType
    forward: bool  # traffic runs towards larger s
    speed: float
    speed_assumed: bool  # the file gives none
    access: frozenset[str]
    change_up: bool  # may cross to the next lane at larger t, from this lane
    change_down: bool


@dataclass(frozen=True)
class Piece:
    """A stretch of road that becomes one lane per lane number."""

    index: int
    start: float
    end: float
    parts: tuple[tuple[RawSection, float, float], ...]  # sections, and the stretch taken of each
    attributes: dict[int, Attributes]


class RoadShape:
    """Positions on one road."""

    def __init__(self, road: RawRoad) -> None:
        self.road = road

    def point(self, s: float, t: float) -> tuple[float, float, float, float]:
        """`x, y, z, heading` of the road at one place `s, t`."""
        s_ = np.array([min(max(s, 0.0), self.road.length)])
        x, y, heading, _, _ = self.road.reference.frame(s_, s_)
        z = self.road.elevation(s_, s_)
        return (
            float(x[0] - t * np.sin(heading[0])),
            float(y[0] + t * np.cos(heading[0])),
            float(z[0]),
            float(heading[0]),
        )

    def profile(self, section: RawSection, s: Array, at: Array) -> dict[int, tuple[Array, Array]]:
        """Per lane number: centre offset t with its first two derivatives `[3, M]`, and width `[M]`."""
        offset = self.road.offset.jet(s, at)
        result: dict[int, tuple[Array, Array]] = {}
        local, local_at = s - section.s, at - section.s
        for side in (1, -1):
            inner = offset
            for number in sorted((n for n in section.lanes if n * side > 0), key=abs):
                lane = section.lanes[number]
                width = _width(lane, side, inner - offset, local, local_at)
                outer = inner + side * width
                result[number] = ((inner + outer) / 2, width[0])
                inner = outer
        return result

    def knots(self, section: RawSection, start: float, end: float) -> Array:
        """Where a record of any kind begins inside `(start, end)`."""
        cubics: list[tuple[float, Cubics | None]] = [
            (0.0, self.road.offset),
            (0.0, self.road.elevation),
        ]
        for lane in section.lanes.values():
            cubics += [(section.s, lane.width), (section.s, lane.border)]
        found = [self.road.reference.s, self.road.reference.cusps()] + [
            s0 + c.s for s0, c in cubics if c is not None
        ]
        knots = np.unique(np.concatenate(found))
        knots = knots[(knots > start + _SHORTEST) & (knots < end - _SHORTEST)]
        return knots[np.diff(knots, append=np.inf) > _SHORTEST]  # of records that close the last counts


def _width(lane: RawLane, side: int, inner: Array, s: Array, at: Array) -> Array:
    """Width and its first two derivatives `[3, M]`; never below zero. `inner` is relative to lane 0."""
    if lane.width is not None:
        width = lane.width.jet(s, at)
    elif lane.border is not None:
        width = side * (lane.border.jet(s, at) - inner)
    else:
        width = np.zeros((3, len(s)))
    return np.where(width[0] > 0, width, 0.0)


# --- pieces -------------------------------------------------------------------------------------


class Cutter:
    """Cuts roads into pieces and reports what it had to decide."""

    def __init__(self, report: ImportReport) -> None:
        self.report = report
        self.piece_at: dict[tuple[str, int], list[Piece]] = {}  # (road, section index) -> pieces, ascending
        self._wide: dict[tuple[str, int | None, float], list[int]] = {}
        self._said: set[tuple[str, str]] = set()

    def pieces(self, road: RawRoad, extra: set[float]) -> list[Piece]:
        """The pieces of a road, ascending in s. `extra` are places where it has to be cut."""
        shape = RoadShape(road)
        atoms: list[tuple[int, RawSection, float, float, bool]] = []
        for k, section in enumerate(road.sections):
            start, end = max(section.s, 0.0), min(section.end, road.length)
            if end - start < MIN_SECTION:
                self.report.repaired(
                    "laneSection",
                    f"road {road.id} s={section.s:g}",
                    f"is {round(max(end - start, 0.0), 5):g} m long: left out, its links pass through",
                    section.line,
                )
                continue
            changes = {section.s + r for lane in section.lanes.values() for r in _changes(lane)}
            changes |= {s for s, _, _ in road.types}
            jumps = self._jumps(shape, section, start, end)
            edges = [start]
            for s in sorted(changes | jumps | extra):
                if edges[-1] + MIN_SECTION < s < end - MIN_SECTION:
                    edges.append(s)
            edges.append(end)
            for a, b in itertools.pairwise(edges):
                atoms.append((k, section, a, b, _near(a, jumps) or _near(a, extra)))

        pieces: list[Piece] = []
        current: list[tuple[int, RawSection, float, float]] = []
        current_attributes: dict[int, Attributes] = {}

        def close() -> None:
            if current:
                piece = Piece(
                    len(pieces),
                    current[0][2],
                    current[-1][3],
                    tuple((section, a, b) for _, section, a, b in current),
                    current_attributes,
                )
                pieces.append(piece)
                for k in dict.fromkeys(k for k, *_ in current):
                    self.piece_at.setdefault((road.id, k), []).append(piece)

        for k, section, a, b, forced in atoms:
            attributes = self._attributes(road, shape, section, (a + b) / 2)
            joined = (
                bool(current)
                and not forced
                and attributes == current_attributes
                and self._continues(road, shape, current[-1], (k, section, a, b))
            )
            if not joined:
                close()
                current, current_attributes = [], attributes
            elif k != current[-1][0]:
                self.report.read("laneSection joined to the one before")
            current.append((k, section, a, b))
        close()
        return pieces

    def _jumps(self, shape: RoadShape, section: RawSection, start: float, end: float) -> set[float]:
        """Knots where a lane centre jumps sideways by more than `JUMP`."""
        knots = shape.knots(section, start, end)
        if not knots.size:
            return set()
        edges = np.concatenate([[start], knots, [end]])
        middle = (edges[:-1] + edges[1:]) / 2
        before = shape.profile(section, knots, middle[:-1])
        after = shape.profile(section, knots, middle[1:])
        jump = np.max([np.abs(before[n][0][0] - after[n][0][0]) for n in before] or [np.zeros(len(knots))], 0)
        reference = shape.road.reference
        x0, y0, h0, *_ = reference.frame(knots, middle[:-1])
        x1, y1, h1, *_ = reference.frame(knots, middle[1:])
        aside = np.max([np.abs(after[n][0][0]) for n in after] or [np.zeros(len(knots))], 0)
        fold = 2 * aside * np.abs(np.sin((h1 - h0) / 2))
        gap = np.where(fold > FOLD, fold, np.hypot(x1 - x0, y1 - y0))
        for s, lateral, along in zip(knots, jump, gap, strict=True):
            if lateral > JUMP or along > JUMP:
                self.report.approximated(
                    "lane geometry" if lateral > JUMP else "geometry",
                    f"road {shape.road.id} s={s:.3f}",
                    f"jumps by {max(lateral, along):.3f} m between two records: lanes are cut there",
                    section.line,
                )
        return {float(s) for s in knots[(jump > JUMP) | (gap > JUMP)]}

    def _continues(
        self,
        road: RawRoad,
        shape: RoadShape,
        before: tuple[int, RawSection, float, float],
        after: tuple[int, RawSection, float, float],
    ) -> bool:
        """Whether two stretches with equal attributes are one: same lanes, linked, without a jump."""
        (k0, section0, _, _), (k1, section1, s, _) = before, after
        if k0 == k1:
            return True
        if k1 != k0 + 1:  # a degenerate section between them: its links decide, keep them apart
            return False
        for number, lane in section0.lanes.items():
            if number == 0:
                continue
            linked = number in lane.successors or number in section1.lanes[number].predecessors
            extra = set(lane.successors) | set(section1.lanes[number].predecessors)
            others = {
                n for n, other in section1.lanes.items() if n != number and number in other.predecessors
            } | {n for n, other in section0.lanes.items() if n != number and number in other.successors}
            if not linked or extra - {number} or others:
                return False
        at = np.array([s])
        left = shape.profile(section0, at, at - 1e-6)
        right = shape.profile(section1, at, at + 1e-6)
        return all(abs(left[n][0][0, 0] - right[n][0][0, 0]) < JUMP for n in left)

    def _attributes(
        self, road: RawRoad, shape: RoadShape, section: RawSection, s: float
    ) -> dict[int, Attributes]:
        numbers = sorted(n for n in section.lanes if n != 0)
        types = {n: self._type(road, section.lanes[n]) for n in numbers}
        forward = {n: runs_forward(road, section.lanes[n]) for n in numbers}
        real = self._real(road.id, shape, section, numbers)
        result = {}
        for n in numbers:
            up = down = False
            if n in real:
                i = real.index(n)
                if i + 1 < len(real) and _may_mix(types, forward, n, real[i + 1]):
                    up = _permission(section, n, real[i + 1], s - section.s)[0]
                if i > 0 and _may_mix(types, forward, n, real[i - 1]):
                    down = _permission(section, real[i - 1], n, s - section.s)[1]
            speed, assumed = self._speed(road, section.lanes[n], section, s)
            result[n] = Attributes(
                type=types[n],
                forward=forward[n],
                speed=speed,
                speed_assumed=assumed,
                access=self._access(road, section.lanes[n], types[n], s - section.s),
                change_up=up,
                change_down=down,
            )
        return result

    def _real(self, road: str, shape: RoadShape, section: RawSection, numbers: list[int]) -> list[int]:
        """The lanes of a section that somewhere have a width."""
        key = (road, section.line, section.s)
        if key not in self._wide:
            s = np.linspace(section.s, max(section.end, section.s), 17)
            profile = shape.profile(section, s, s)
            self._wide[key] = [n for n in numbers if profile[n][1].max() >= MIN_WIDTH]
        return self._wide[key]

    def _type(self, road: RawRoad, lane: RawLane) -> LaneType:
        known = _TYPES.get(lane.type.lower())
        if known is not None:
            return known
        self._once(
            "approximated",
            "lane type",
            f"road {road.id} lane {lane.id}",
            f"type '{lane.type}' is not in the standard: taken as none",
            lane.line,
        )
        return LaneType.NONE

    def _speed(self, road: RawRoad, lane: RawLane, section: RawSection, s: float) -> tuple[float, bool]:
        """Speed limit at `s`, and whether it had to be assumed."""
        speed: float | None = None
        road_type = ""
        for start, kind, limit in road.types:
            if start <= s + 1e-9:
                road_type, speed = kind, limit
        for start, limit in lane.speeds:
            if section.s + start <= s + 1e-9:
                speed = limit
        if speed == float("inf"):
            self._once(
                "approximated",
                "speed limit",
                f"road {road.id}",
                f"'no limit': {NO_LIMIT_SPEED * 3.6:.0f} km/h assumed",
                road.line,
            )
            return NO_LIMIT_SPEED, False
        if speed is not None:
            return speed, False
        speed = DEFAULT_SPEED.get(road_type, URBAN_SPEED)
        if road.junction is None:  # connectors take over the limits of the lanes they join, see reader
            self._once(
                "approximated",
                "speed limit",
                f"road {road.id}",
                f"the file gives none for road type '{road_type}': {speed * 3.6:.0f} km/h assumed",
                road.line,
            )
        return speed, True

    def _access(self, road: RawRoad, lane: RawLane, kind: LaneType, s: float) -> frozenset[str]:
        access = _ACCESS.get(kind, MOTOR_CLASSES if kind in DRIVABLE else frozenset())
        active = [r for r in lane.access if r[0] <= s + 1e-9]
        if not active:
            return access
        latest = active[-1][0]
        for _, rule, who in (r for r in active if r[0] == latest):
            classes = {_RESTRICTIONS[w.lower()] for w in who if w.lower() in _RESTRICTIONS}
            unknown = [w for w in who if w.lower() not in _RESTRICTIONS and w.lower() != "none"]
            if unknown:
                self._once(
                    "ignored",
                    "lane access",
                    f"road {road.id} lane {lane.id}",
                    f"restriction '{unknown[0]}' names no vehicle class",
                    lane.line,
                )
            if rule == "allow":
                access = frozenset(classes)
            else:
                access = access - classes
        return access

    def _once(self, action: str, element: str, where: str, message: str, line: int | None) -> None:
        """Report every fact only once."""
        if (where, message) not in self._said:
            self._said.add((where, message))
            getattr(self.report, action)(element, where, message, line)


def _near(s: float, places: set[float]) -> bool:
    return any(abs(s - p) < MIN_SECTION for p in places)


def _changes(lane: RawLane) -> list[float]:
    """Where attributes of a lane may change, from the section start."""
    return [m.s for m in lane.marks] + [s for s, _ in lane.speeds] + [s for s, _, _ in lane.access]


def carries_traffic(lane: RawLane) -> bool:
    """Whether motor traffic runs on lanes of this type in one direction."""
    return _TYPES.get(lane.type.lower()) in DRIVABLE


def runs_forward(road: RawRoad, lane: RawLane) -> bool:
    """Whether traffic runs towards larger s."""
    forward = (lane.id < 0) != road.left_hand
    return not forward if lane.forward_sign == 1 else forward


def _may_mix(types: dict[int, LaneType], forward: dict[int, bool], a: int, b: int) -> bool:
    return types[a] in DRIVABLE and types[b] in DRIVABLE and forward[a] == forward[b]


def _permission(section: RawSection, low: int, high: int, s: float) -> tuple[bool, bool]:
    """Whether marks permit a change from `low` to `high`, and back."""
    up = down = True
    borders = [n for n in range(low, high + 1) if low < n <= 0 or 0 <= n < high]
    for number in borders:
        lane = section.lanes.get(number)
        mark = None
        for candidate in lane.marks if lane is not None else []:
            if candidate.s <= s + 1e-9:
                mark = candidate
        if mark is not None:
            mark_up, mark_down = crossing(mark, number)
            up, down = up and mark_up, down and mark_down
    return up, down


def crossing(mark: Mark, number: int) -> tuple[bool, bool]:
    """Whether an outer mark may be crossed towards larger and smaller t.

    `number`: of the lane on whose outer border the mark is.

    `laneChange` states it. Without it the lines decide: of two lines the one on the driver's side counts.
    Two-line types name the inner line first, on lane 0 the left one (OpenDRIVE 1.8, section 11.9).
    """
    match mark.change:
        case "both":
            return True, True
        case "none":
            return False, False
        case "increase":
            return True, False
        case "decrease":
            return False, True
    if "no passing" in mark.rules:
        return False, False
    lines = [line in ("broken", "none", "custom", "dots") for line in mark.type.replace("botts ", "").split()]
    if len(lines) < 2:
        allowed = bool(lines) and lines[0]
        return allowed, allowed
    first, second = lines[0], lines[1]
    # for right lanes and lane 0 the first line is the one at larger t
    high_side, low_side = (first, second) if number <= 0 else (second, first)
    return low_side, high_side


# --- sampling -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Samples:
    """Values of all lanes of a piece at common road coordinates; first axis lanes, last axis samples."""

    x: Array
    y: Array
    heading: Array
    curvature: Array
    width: Array
    along: Array  # d(position)/ds in road direction
    across: Array


Evaluate = Callable[[Array, NDArray[np.int64]], _Samples]


def sample_piece(road: RawRoad, piece: Piece, report: ImportReport) -> dict[int, Lane]:
    """The lanes of a piece by lane number, without links and neighbours."""
    shape = RoadShape(road)
    numbers = sorted(piece.attributes)
    if not numbers:
        return {}
    spans = [
        (section, a, b)
        for section, start, end in piece.parts
        for a, b in itertools.pairwise([start, *shape.knots(section, start, end), end])
    ]
    sections = [section for section, _, _ in spans]
    a, b = np.array([s[1] for s in spans]), np.array([s[2] for s in spans])
    middle = (a + b) / 2

    def evaluate(s: Array, span: NDArray[np.int64]) -> _Samples:
        return _evaluate(shape, numbers, sections, s, span, middle[span])

    # at every border of spans: how far do the left and right limits differ?
    here = np.arange(len(spans) - 1)
    before, after = evaluate(b[:-1], here), evaluate(a[1:], here + 1)
    dx, dy = after.x - before.x, after.y - before.y
    jump = np.hypot(dx, dy).max(0, initial=0.0)
    sideways = np.abs(dy * np.cos(before.heading) - dx * np.sin(before.heading)).max(0, initial=0.0)
    turn = np.abs(np.angle(np.exp(1j * (after.heading - before.heading)))).max(0, initial=0.0)
    step = np.abs(after.width - before.width).max(0, initial=0.0)
    kink = (jump > 1e-6) | (turn > 1e-5) | (step > 1e-6)
    half = np.maximum(_BRIDGE / 2 * np.maximum(sideways - 1e-5, 0.0), 1.5 * np.maximum(jump - 1e-5, 0.0))
    half = np.where(kink, np.maximum(5e-4, half), 0.0)
    start, end = _leave_out(a, b, half)
    far = jump > 1e-3
    for s, gap, room in zip(b[:-1][far], jump[far], half[far], strict=True):
        report.approximated(
            "lane geometry",
            f"road {road.id} s={s:.3f}",
            f"jumps by {gap * 1000:.1f} mm between two records: smoothed over {2 * room:.2f} m",
            road.line,
        )

    count = _intervals(shape, evaluate, start, end)
    s_list, span_list, bridge_list = [], [], []
    reached = start[0]
    for i in np.nonzero(end > start)[0]:
        s = np.linspace(start[i], end[i], count[i] + 1)
        bridged = start[i] > reached
        if s_list and not bridged:  # the last sample of the span before is this one
            s = s[1:]
        bridge_list.append(np.arange(len(s)) < bridged)
        s_list.append(s)
        span_list.append(np.full(len(s), i))
        reached = end[i]
    s, span, bridge = (np.concatenate(parts) for parts in (s_list, span_list, bridge_list))
    values = evaluate(s, span)
    z = road.elevation(s, middle[span])
    lengths = _lengths(evaluate, s, span, bridge, values)

    lanes: dict[int, Lane] = {}
    for row, number in enumerate(numbers):
        attributes = piece.attributes[number]
        _report_shape(report, road, piece, number, values, row)
        arc = np.concatenate([[0.0], np.cumsum(lengths[row])])
        heading = np.unwrap(values.heading[row])
        curvature = values.curvature[row]
        xyz = np.stack([values.x[row], values.y[row], z], -1)
        width, road_s = values.width[row], s
        if not attributes.forward:
            arc = (arc[-1] - arc)[::-1]
            heading = np.unwrap(heading[::-1] + np.pi)
            curvature, xyz, width, road_s = -curvature[::-1], xyz[::-1], width[::-1], road_s[::-1]
        lanes[number] = Lane(
            id=lane_id((road.id, piece.index, number)),
            road=road.id,
            section=piece.index,
            number=number,
            type=attributes.type,
            s=arc,
            xyz=np.ascontiguousarray(xyz),
            heading=heading,
            curvature=np.ascontiguousarray(curvature),
            width=np.ascontiguousarray(width),
            road_s=np.ascontiguousarray(road_s),
            speed_limit=attributes.speed,
            access=attributes.access,
            junction=road.junction,
        )
    return lanes


def _leave_out(a: Array, b: Array, half: Array) -> tuple[Array, Array]:
    """The part of every span at least `half` from its borders.

    A span `[a, b]` that is shorter than that is returned with start >= end.
    """
    border = b[:-1]
    half = np.minimum(half, np.minimum(border - a[0], b[-1] - border) / 2)
    start, end = a.copy(), b.copy()
    start[1:] = np.maximum(a[1:], np.maximum.accumulate(border + half))
    end[:-1] = np.minimum(b[:-1], np.minimum.accumulate((border - half)[::-1])[::-1])
    return start, end


def _evaluate(
    shape: RoadShape,
    numbers: list[int],
    sections: list[RawSection],
    s: Array,
    span: NDArray[np.int64],
    at: Array,
) -> _Samples:
    reference = shape.road.reference
    x, y, heading, k, dk = reference.frame(s, at)
    stretch = reference.stretch(at)
    t = np.empty((len(numbers), 3, len(s)))
    width = np.empty((len(numbers), len(s)))
    distinct = {id(section): section for section in sections}
    which = np.array([id(section) for section in sections])[span] if len(span) else np.zeros(0)
    for key, section in distinct.items():
        here = slice(None) if len(distinct) == 1 else np.nonzero(which == key)[0]
        profile = shape.profile(section, s[here], at[here])
        for row, number in enumerate(numbers):
            t[row][:, here], width[row, here] = profile[number]
    t0, t1, t2 = t[:, 0], t[:, 1], t[:, 2]
    along = stretch * (1 - k * t0)
    along_rate = -stretch * (dk * t0 + k * t1)
    speed2 = np.maximum(along**2 + t1**2, 1e-18)
    bend = along * (t2 + stretch * k * along) - t1 * (along_rate - stretch * k * t1)
    return _Samples(
        x=x - t0 * np.sin(heading),
        y=y + t0 * np.cos(heading),
        heading=heading + np.arctan2(t1, along),
        curvature=bend / speed2**1.5,
        width=width,
        along=along,
        across=t1,
    )


def _intervals(shape: RoadShape, evaluate: Evaluate, start: Array, end: Array) -> NDArray[np.int64]:
    """How many sample intervals each span needs for the Hermite tolerance."""
    index = np.repeat(np.arange(len(start)), 5)
    s = (start[:, None] + (end - start)[:, None] * np.linspace(0, 1, 5)).ravel()
    probe = evaluate(s, index)
    bend = np.abs(probe.curvature).max(0).reshape(-1, 5).max(1)
    varies = np.abs(probe.across).max(0).reshape(-1, 5).max(1) > 1e-9
    widths = probe.width.reshape(len(probe.width), -1, 5)
    quarter = np.maximum(end - start, 1e-9) / 4
    flare = np.abs(np.diff(widths, 2, axis=-1)).max((0, 2)) / quarter**2  # second derivative of width
    step = np.minimum(10.0, (384 * _HERMITE / np.maximum(bend, 1e-9) ** 3) ** 0.25)
    step = np.where(varies, np.minimum(step, 1.0), step)
    step = np.minimum(step, np.sqrt(8 * _LINEAR / np.maximum(flare, 1e-9)))
    middle = (start + end) / 2
    step = np.where(shape.road.reference.is_parametric(middle), np.minimum(step, 0.5), step)
    if not shape.road.elevation.constant:
        step = np.minimum(step, 5.0)
    return np.maximum(1, np.ceil((end - start) / np.maximum(step, 0.02)).astype(np.int64))


def _lengths(
    evaluate: Evaluate, s: Array, span: NDArray[np.int64], bridge: NDArray[np.bool_], values: _Samples
) -> Array:
    """Arc length `[lanes, M-1]` between consecutive samples, above zero."""
    step = np.diff(s)
    nodes = s[:-1, None] + step[:, None] * _X
    probe = evaluate(nodes.ravel(), np.repeat(span[1:], len(_X)))
    speed = np.hypot(probe.along, probe.across).reshape(len(values.x), -1, len(_X)) @ _W
    chord = np.hypot(np.diff(values.x), np.diff(values.y))
    return np.maximum(np.where(bridge[1:], chord, speed * step), 1e-9)


def _report_shape(
    report: ImportReport, road: RawRoad, piece: Piece, number: int, values: _Samples, row: int
) -> None:
    """Report lanes whose geometry no real lane has."""
    where = f"road {road.id} section {piece.index} lane {number}"
    if (values.along[row] <= 0).any():
        report.approximated(
            "lane geometry",
            where,
            "lies beyond the centre of the road's curve: its centre line runs backwards there",
            road.line,
        )
    for section, a, b in piece.parts:
        lane = section.lanes[number]
        if lane.width is None:
            if lane.border is not None and values.width[row].max() <= 0:
                report.approximated(
                    "lane border", where, "lies on the inner side of the lane: the width is 0", lane.line
                )
            continue
        s = np.linspace(a, b, 33)
        lowest = lane.width(s - section.s, s - section.s).min()
        if lowest < -1e-3:
            report.repaired(
                "lane width", where, f"falls to {lowest:.3f} m: taken as 0 where negative", lane.line
            )
