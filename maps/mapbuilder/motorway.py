"""Motorways and their ramps."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mapbuilder.curves import Curve, Profile
from mapbuilder.junctions import Map
from mapbuilder.roads import Lane, Road, Section
from mapbuilder.urban import mirrored

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
    """A one-way carriageway with three lanes.

    `accelerate` and `decelerate`: lengths of auxiliary lanes at its start and end.
    """

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
    """Distance from the reference line to a ramp nose."""
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
