"""Streets, intersections and roundabouts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from mapbuilder.curves import Curve, Piece, Pose, Profile
from mapbuilder.junctions import Junction, Map
from mapbuilder.roads import Contact, Lane, Road, Section

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
    """A curve towards an intersection, described outwards from it.

    `start` looks inwards.
    """
    return Curve(start.move(turn=math.pi), pieces).reversed()


def mirrored(profile: Profile | float, length: float) -> Profile | float:
    """A profile along the same road, run the other way."""
    if isinstance(profile, Profile):
        return Profile(*((length - s, v) for s, v in reversed(profile.knots)))
    return profile


class Arm(NamedTuple):
    """An arm of an intersection: the road ends that enter and leave it."""

    enter: Contact | None
    leave: Contact | None


def approach(
    m: Map, name: str, curve: Curve, *, right_turn: float, far: float, height: Profile | float
) -> Road:
    """A one-way carriageway with a left-turn pocket before an intersection.

    The pocket opens in the median. The reference line is the left edge of the pocket. `far` is the width
    of the median to its right at the far end. With `right_turn` (width) a right lane opens too.
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
    """A dual carriageway, two lanes each way, that widens to an intersection."""
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
    """Build movements (from arm, lanes, to arm, lanes).

    Returns the connecting roads by the arm they come from.
    """
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
    """A signalised intersection.

    The main road W-E has lanes left, t1, t2 and perhaps right, the minor road N-S left and t1. Four
    signal groups: main through and right, main left, minor through and right, minor left.
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


RING = (Lane("inner", 4.25), Lane("outer", 4.75), walk(2.0))
RING_RADIUS = 25.0  # edge of the central island
RING_MOUTH = 40.0  # from the centre to the ends of the arms
SPLITTER = 4.0  # half of the splitter island at the ring
MOUTH_ANGLE = math.radians(35)  # a junction spans this much of the ring on both sides of its arm


def ring_arm(m: Map, name: str, curve: Curve, height: Profile | float = 0.0) -> Arm:
    """A two-way road whose median widens to a splitter island."""
    median = Lane("median", Profile((curve.length - 60.0, 1.0), (curve.length, SPLITTER)), "median")
    lanes_in = [median, Lane("in1", 3.25), Lane("in2", 3.5), walk(2.0)]
    lanes_out = [median, Lane("out1", 3.5), Lane("out2", 3.75), walk(2.0)]
    road = m.road(name, curve, [Section(0, lanes_in, lanes_out, centre="none")], height=height)
    return Arm(road.end, road.end)


def roundabout(
    m: Map, name: str, centre: Pose, arms: Sequence[tuple[float, Arm]], height: float = 0.0
) -> None:
    """A two-lane ring with one junction per arm.

    Arms are (direction from the centre, arm), counter-clockwise. The right lane enters the outer ring
    lane and leaves from it, the left lane the inner one.
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
