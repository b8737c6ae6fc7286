"""Junctions: which lanes meet, the curves between them, and the rules."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from mapbuilder.curves import Curve, Pose, join, wrap

from random_roads.roads import Contact, Cubics, Line, Road, Steps, Strip

LEAST_RADIUS = 4.0
"""m, of the centre line of a connecting lane; sharper junctions are drawn anew."""

U_TURN = math.radians(150)
"""Sharper turns are left out."""


class Unfit(Exception):
    """A drawing that makes no sensible map: it is drawn anew."""


class Way(NamedTuple):
    """A connecting road and the traffic that it carries."""

    source: int  # number of the arm
    target: int
    turn: float  # rad, positive to the left
    road: Road


@dataclass(eq=False)
class Junction:
    """A junction and its connecting roads."""

    id: int
    roads: list[Road] = field(default_factory=list)
    links: list[tuple[Road, Road, list[tuple[int, int]]]] = field(default_factory=list)
    priorities: list[tuple[Road, Road]] = field(default_factory=list)
    controllers: list[int] = field(default_factory=list)


class Map:
    """A map in the making."""

    def __init__(self, *, left_hand: bool = False) -> None:
        self.left_hand = left_hand
        self.roads: list[Road] = []
        self.junctions: list[Junction] = []
        self.controllers: list[list[int]] = []
        self.signals = 0

    def all_roads(self) -> list[Road]:
        """Roads outside and inside junctions."""
        return [*self.roads, *(road for junction in self.junctions for road in junction.roads)]

    def road(
        self, name: str, line: Line, right: list[Strip], left: Sequence[Strip] = (), **more: object
    ) -> Road:
        """Add a road."""
        road = Road(len(self.roads) + 1, name, line, right, list(left), **more)  # pyright: ignore[reportArgumentType]
        self.roads.append(road)
        return road

    def junction(self) -> Junction:
        """Add a junction."""
        self.junctions.append(Junction(1000 * (len(self.junctions) + 1)))
        return self.junctions[-1]

    def link(self, a: Contact, b: Contact) -> None:
        """Link two roads; lanes of the same number continue each other."""
        a.road.ends[a.at] = b
        b.road.ends[b.at] = a

    def connect(
        self,
        junction: Junction,
        source: Contact,
        lanes: Sequence[int],
        target: Contact,
        onto: Sequence[int],
        *,
        line: Line,
        speed: float,
        breaks: Sequence[float] = (),
        smooth: bool = True,
        kind: str = "town",
    ) -> Road:
        """Connect lanes, listed from the middle outwards, along their inner edge."""
        source.road.ends[source.at] = junction
        target.road.ends[target.at] = junction
        ends = [0.0, line.length]
        if line.length > 2.0 and not smooth:
            ends = [0.5, line.length - 0.5]
        strips = [
            Strip(Steps((ends[0], source.width(a)), (ends[1], target.width(b)), smooth=smooth))
            for a, b in zip(lanes, onto, strict=True)
        ]
        number = junction.id + 1 + len(junction.roads)
        road = Road(number, f"way {number}", line, strips, kind=kind, speed=speed, junction=junction)
        road.breaks = [s for s in breaks if 0.1 < s < line.length - 0.1]
        road.ends = {"start": source, "end": target}
        road.height = Steps((0, source.road.height(source.s)))
        for i, (a, b) in enumerate(zip(lanes, onto, strict=True), 1):
            road.joined["start", -i] = a
            road.joined["end", -i] = b
        junction.roads.append(road)
        junction.links.append((source.road, road, [(a, -i) for i, a in enumerate(lanes, 1)]))
        return road

    def signal(self, contact: Contact, lanes: Sequence[int], back: float, **values: str) -> int:
        """Add a light or sign for lanes that leave a road here.

        It stands `back` metres before the end of the road.
        """
        self.signals += 1
        road, at_end = contact.road, contact.at == "end"
        s = min(max(contact.s - back if at_end else back, 0.0), road.length)
        right, left = road.reach(min(s, road.length - 1e-6))
        place = {"id": str(self.signals), "s": f"{s:.3f}", "t": f"{right - 1 if at_end else left + 1:.3f}"}
        place |= {"zOffset": "2", "orientation": "+" if at_end else "-", "name": f"signal {self.signals}"}
        place |= {"subtype": "-1", "value": "-1", "dynamic": "no", "country": "DE"}
        place |= {"from": str(min(lanes)), "to": str(max(lanes))}
        road.signals.append(place | values)
        return self.signals


@dataclass
class Style:
    """How the connecting roads of a junction are drawn."""

    curve: str  # cubic, two cubics, or lines and arcs
    by_length: bool
    tension: float
    joint: bool  # lanes side by side share a road
    smooth: bool  # cubic, not linear changes of width
    breaks: tuple[float, ...]  # m from the start; negative: from the end
    dropped: float  # chance that a turn is missing
    shared: float  # chance that a lane serves a further turn
    spread: float  # chance that a lane leads to several lanes

    @staticmethod
    def draw(rng: np.random.Generator) -> Style:
        """Any style."""
        short = ((), (), (0.3, 0.8, 1.3), (-0.4, -0.9), (0.5, 1.0, -1.1, -0.55), (0.2, 0.5, 0.8))
        return Style(
            curve=str(rng.choice(["cubic", "cubic", "two", "arcs"])),
            by_length=bool(rng.random() < 0.5),
            tension=float(rng.uniform(0.9, 1.1)),
            joint=bool(rng.random() < 0.4),
            smooth=bool(rng.random() < 0.6),
            breaks=short[rng.integers(len(short))],
            dropped=float(rng.choice([0.0, 0.0, 0.15, 0.3])),
            shared=float(rng.choice([0.0, 0.3, 0.7])),
            spread=float(rng.choice([0.0, 0.0, 0.3])),
        )

    def line(self, start: Pose, end: Pose, width: float) -> Line:
        """A curve for a lane that lies to the right of it."""
        ahead, _ = start.local(end)
        if math.hypot(start.x - end.x, start.y - end.y) < 0.5 or ahead < -30:
            raise Unfit("ends of roads meet")
        if self.curve == "arcs":
            try:
                line = join(start, end)
            except (ValueError, ZeroDivisionError):
                line = None
            if line is not None and line.length < 3 * math.hypot(start.x - end.x, start.y - end.y) + 1:
                bends = [k for piece in line.pieces for k in piece[1:]]
                if _fits(min(bends), max(bends), width):
                    return _closed(line, end)
        line = Cubics(
            start,
            end,
            tension=self.tension,
            split=2 if self.curve == "two" else 1,
            by_length=self.by_length,
        )
        if not _fits(*line.sharpest(), width):
            raise Unfit("a bend too sharp")
        return line


def _closed(line: Curve, end: Pose) -> Curve:
    off = line.end.local(end)
    if math.hypot(*off) > 1e-3 or abs(wrap(line.end.heading - end.heading)) > 1e-4:
        raise Unfit("a curve that misses its end")
    return line


def _fits(least: float, largest: float, width: float) -> bool:
    """Whether a lane to the right of a bend keeps `LEAST_RADIUS`."""
    right = -1 / least - width / 2 if least < 0 else math.inf
    left = 1 / largest + width / 2 if largest > 0 else math.inf
    return min(right, left) >= LEAST_RADIUS


def turn_between(source: Contact, target: Contact) -> float:
    """rad by which traffic turns, positive to the left."""
    return wrap(target.outwards().heading + math.pi - source.outwards().heading)


def allot(turns: Sequence[float], lanes: int, rooms: Sequence[int], shared: Sequence[bool]) -> list[range]:
    """Lanes for each turn, such that no paths cross.

    Turns are listed from the left, lanes from the middle.
    """
    count = len(turns)
    if lanes < count:
        return [
            range(min(k * lanes // count, lanes - 1), min(k * lanes // count, lanes - 1) + 1)
            for k in range(count)
        ]
    sizes = [1] * count
    ahead = sorted(range(count), key=lambda k: abs(turns[k]))
    for _ in range(lanes - count):
        free = [k for k in ahead if sizes[k] < rooms[k]]
        sizes[free[0] if free else ahead[0]] += 1
    first = np.cumsum([0, *sizes])
    found = [range(int(a), int(b)) for a, b in itertools.pairwise(first)]
    for k, also in enumerate(shared):
        # a turn also takes the next lane of the way ahead
        if also and k != ahead[0] and rooms[k] > len(found[k]):
            low, high = found[k].start, found[k].stop
            found[k] = range(low, min(high + 1, lanes)) if k < ahead[0] else range(max(low - 1, 0), high)
    return found


def crossing(m: Map, rng: np.random.Generator, arms: Sequence[Contact], style: Style) -> list[Way]:
    """Connect the arms of a junction."""
    junction = m.junction()
    ways: list[Way] = []
    for i, source in enumerate(arms):
        lanes = source.leaving()
        targets = [j for j, arm in enumerate(arms) if j != i and arm.entering()]
        targets = [j for j in targets if abs(turn_between(source, arms[j])) < U_TURN]
        kept = [j for j in targets if rng.random() >= style.dropped]
        targets = kept or targets
        if not lanes or not targets:
            if lanes:
                raise Unfit("an arm without a way on")
            continue
        targets.sort(key=lambda j: -turn_between(source, arms[j]))
        turns = [turn_between(source, arms[j]) for j in targets]
        rooms = [len(arms[j].entering()) for j in targets]
        shared = [bool(rng.random() < style.shared) for _ in targets]
        for j, turn, part in zip(targets, turns, allot(turns, len(lanes), rooms, shared), strict=True):
            pairs = _pairs(rng, [lanes[k] for k in part], arms[j].entering(), turn, style)
            for a, b in _grouped(pairs, style.joint):
                ways.append(Way(i, j, turn, _way(m, junction, source, a, arms[j], b, turn, style)))
    if any(arm.entering() and all(way.target != j for way in ways) for j, arm in enumerate(arms)):
        raise Unfit("an arm that no way leads to")
    return ways


def _pairs(
    rng: np.random.Generator, lanes: list[int], onto: list[int], turn: float, style: Style
) -> list[tuple[int, int]]:
    """Which lane leads to which."""
    many = min(len(lanes), len(onto))
    if turn > math.radians(30):
        first = 0
    elif turn < -math.radians(30):
        first = len(onto) - many
    else:
        first = int(rng.integers(0, len(onto) - many + 1)) if rng.random() < 0.3 else len(onto) - many
    pairs = [(a, onto[min(first + k, len(onto) - 1)]) for k, a in enumerate(lanes)]
    if len(lanes) == 1 and rng.random() < style.spread:
        pairs = [(lanes[0], b) for b in onto]
    return pairs


def _grouped(pairs: list[tuple[int, int]], joint: bool) -> list[tuple[list[int], list[int]]]:
    """Pairs of lanes per connecting road."""
    a, b = [p[0] for p in pairs], [p[1] for p in pairs]
    if joint and len(set(a)) == len(pairs) == len(set(b)):
        return [(a, b)]
    return [([x], [y]) for x, y in pairs]


def _way(
    m: Map,
    junction: Junction,
    source: Contact,
    lanes: list[int],
    target: Contact,
    onto: list[int],
    turn: float,
    style: Style,
) -> Road:
    start, end = source.inner_edge(lanes[0]), target.inner_edge(onto[0])
    width = max(sum(source.width(n) for n in lanes), sum(target.width(n) for n in onto))
    line = style.line(start, end, width)
    breaks = [s if s > 0 else line.length + s for s in style.breaks]
    slow = 30.0 if abs(turn) > math.radians(50) else min(source.road.speed, target.road.speed)
    return m.connect(
        junction, source, lanes, target, onto, line=line, speed=slow, breaks=breaks, smooth=style.smooth
    )


RULES = ("lights", "lights", "stop", "yield", "priority", "all-way stop", "nothing")
"""Rules of a junction, with their chances."""


def regulate(
    m: Map, rng: np.random.Generator, arms: Sequence[Contact], ways: Sequence[Way], rule: str
) -> None:
    """Lights, signs, priorities or nothing."""
    junction = m.junctions[-1]
    major = _major(arms)
    back = float(rng.choice([0.0, 1.0, 3.0]))
    if rule == "lights":
        by_lane, grouping = rng.random() < 0.3, str(rng.choice(["pairs", "arms", "none"]))
        groups: dict[int, list[int]] = {}
        for i, arm in enumerate(arms):
            lanes = arm.leaving()
            for some in [[n] for n in lanes] if by_lane else [lanes]:
                if not some:
                    continue
                light = m.signal(arm, some, back, dynamic="yes", country="OpenDRIVE", type="1000001")
                groups.setdefault((0 if i in major else 1) if grouping == "pairs" else i, []).append(light)
        if grouping != "none":
            for lights in groups.values():
                m.controllers.append(lights)
                junction.controllers.append(len(m.controllers))
    elif rule in ("stop", "yield", "all-way stop"):
        for i, arm in enumerate(arms):
            if arm.leaving() and (rule == "all-way stop" or i not in major):
                m.signal(arm, arm.leaving(), back, type="205" if rule == "yield" else "206")
            elif arm.leaving() and rng.random() < 0.5:
                m.signal(arm, arm.leaving(), back, type="306")
    elif rule == "priority":
        high = [way.road for way in ways if way.source in major]
        low = [way.road for way in ways if way.source not in major]
        junction.priorities += [(a, b) for a in high for b in low]


def _major(arms: Sequence[Contact]) -> set[int]:
    """The two arms that are most nearly opposite."""
    pairs = [(i, j) for i in range(len(arms)) for j in range(i)]
    return set(min(pairs, key=lambda p: abs(turn_between(arms[p[0]], arms[p[1]]))))
