"""Roundabouts: a ring of short roads, with a junction at each arm."""

from __future__ import annotations

import math

import numpy as np
from mapbuilder.curves import Curve, Piece, Pose

from random_roads.junctions import Map, Style, Unfit
from random_roads.roads import Contact, Road, Steps, Strip
from random_roads.streets import RoadPlan, free_angles, outer_arm

Rng = np.random.Generator


def roundabout(rng: Rng) -> Map:
    """A ring with three to five arms."""
    m = Map(left_hand=bool(rng.random() < 0.2))
    radius, count = float(rng.uniform(10, 24)), int(rng.choice([1, 1, 2]))
    width = float(rng.uniform(3.5, 4.5))
    arms = int(rng.integers(3, 6))
    first = float(rng.uniform(0, 2 * math.pi))
    angles = sorted(a % (2 * math.pi) for a in [first, *free_angles(rng, [first], arms - 1)])
    outer = radius + count * width
    ring_speed = float(rng.choice([25, 30, 40]))
    plans = [RoadPlan.draw(rng, start=True, end=False, most=2) for _ in angles]
    halves = [(plan.half_width() + float(rng.uniform(4, 8))) / outer for plan in plans]
    gaps = [(b - a) % (2 * math.pi) for a, b in zip(angles, [*angles[1:], angles[0]], strict=True)]
    rings: list[Road] = []
    for k, gap in enumerate(gaps):
        long = gap - halves[k] - halves[(k + 1) % arms]
        if long * radius < 1.5:
            raise Unfit("arms too close")
        line = _arc(radius, angles[k] + halves[k], long)
        strips = [Strip(Steps((0, width))) for _ in range(count)]
        rings.append(m.road(f"ring {k}", line, strips, speed=ring_speed))
    style = Style.draw(rng)
    style.joint = False
    rule = str(rng.choice(["yield", "yield", "priority", "nothing"]))
    back = float(rng.uniform(4, 10))
    for k, (angle, plan) in enumerate(zip(angles, plans, strict=True)):
        mouth = Pose(0, 0, angle).move(ahead=outer + back)
        arm = outer_arm(m, rng, plan, mouth)
        through = _arc(radius, angle - halves[k], 2 * halves[k])
        _mouth(m, arm, (rings[k - 1], rings[k]), through, style, rule)
    return m


def _arc(radius: float, angle: float, turn: float) -> Curve:
    """A stretch of a circle, counter-clockwise from `angle`."""
    start = Pose(radius * math.cos(angle), radius * math.sin(angle), angle + math.pi / 2)
    return Curve(start, [Piece(radius * turn, 1 / radius, 1 / radius)])


def _mouth(m: Map, arm: Contact, rings: tuple[Road, Road], through: Curve, style: Style, rule: str) -> None:
    """The junction of an arm: around, in and out."""
    junction = m.junction()
    before, after = rings[0].end, rings[1].start
    inside, outside = before.leaving(), after.entering()
    speed = rings[0].speed
    around = m.connect(junction, before, inside, after, outside, line=through, speed=speed)
    lanes = arm.leaving()
    for a, b in zip(reversed(lanes), reversed(outside), strict=False):
        line = style.line(arm.inner_edge(a), after.inner_edge(b), arm.width(a))
        way = m.connect(junction, arm, [a], after, [b], line=line, speed=speed, smooth=style.smooth)
        if rule == "priority":
            junction.priorities.append((around, way))
    for a in lanes[: max(len(lanes) - len(outside), 0)]:
        line = style.line(arm.inner_edge(a), after.inner_edge(outside[0]), arm.width(a))
        m.connect(junction, arm, [a], after, [outside[0]], line=line, speed=speed, smooth=style.smooth)
    exits = arm.entering()
    for a, b in zip(reversed(inside), reversed(exits), strict=False):
        line = style.line(before.inner_edge(a), arm.inner_edge(b), arm.width(b))
        m.connect(junction, before, [a], arm, [b], line=line, speed=speed, smooth=style.smooth)
    if rule == "yield" and lanes:
        m.signal(arm, lanes, 1.0, type="205")
