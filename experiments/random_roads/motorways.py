"""Roads without crossings: motorways with ramps, lane drops and weaving, and roads of changing lanes."""

from __future__ import annotations

import math

import numpy as np
from mapbuilder.curves import Curve, Piece, Pose, arc

from random_roads.junctions import Junction, Map, Style, Unfit
from random_roads.roads import Road, Steps, Strip
from random_roads.streets import RoadPlan, bends

Rng = np.random.Generator
EDGE = 1.0
"""m, width of the shoulders of a motorway."""


def wide_bends(rng: Rng, length: float) -> list[Piece]:
    """Lines and wide bends of this length, about."""
    pieces: list[Piece] = []
    while (done := sum(p.length for p in pieces)) < length:
        if rng.random() < 0.5 or not done:
            pieces.append(Piece(float(rng.uniform(100, 400))))
        else:
            radius, turn = float(rng.uniform(400, 1500)), float(rng.uniform(6, 16)) * rng.choice([-1, 1])
            pieces += arc(radius, float(turn), 0.3 * abs(math.radians(turn)) * radius)
    return pieces


def motorway(rng: Rng) -> Map:
    """A carriageway with two to four events, perhaps with another beside it."""
    m = Map(left_hand=bool(rng.random() < 0.2))
    speed = float(rng.choice([80, 100, 120]))
    width, count = float(rng.uniform(3.25, 3.75)), int(rng.integers(1, 4))
    events = [
        str(x)
        for x in rng.choice(["on", "off", "drop", "gain", "exit lane", "weave", "open"], rng.integers(2, 5))
    ]
    spaces = [float(rng.uniform(180, 420)) for _ in range(len(events) + 1)]
    nose = float(rng.uniform(25, 80))
    base = Curve(Pose(0, 0, float(rng.uniform(-3, 3))), wide_bends(rng, sum(spaces) + 500.0 * len(events)))
    builder = _Motorway(m, rng, base, width, speed, nose, count)
    for event, space in zip(events, spaces, strict=False):
        builder.event(event, space)
    builder.finish(spaces[-1])
    if rng.random() < 0.4:
        lanes = [Strip(Steps((0, width)), speed=speed) for _ in range(max(count, 2))]
        line = base.cut(0, builder.at).reversed()
        drop = rng.random() < 0.5
        if drop:
            at, taper = 0.4 * line.length, float(rng.uniform(60, 250))
            lanes[-1] = Strip(Steps((at, width), (at + taper, 0), smooth=bool(rng.random() < 0.5)))
        m.road("opposite", line, lanes, kind="motorway", speed=speed, offset=Steps((0, -3.0)))
    return m


class _Motorway:
    """A carriageway that grows in the direction of travel."""

    def __init__(
        self, m: Map, rng: Rng, base: Curve, width: float, speed: float, nose: float, count: int
    ) -> None:
        self.m, self.rng, self.base, self.width, self.speed = m, rng, base, width, speed
        self.nose, self.count = nose, count
        self.at, self.before = 0.0, None  # m along; the last road
        self.smooth = bool(rng.random() < 0.5)
        self.joint = bool(rng.random() < 0.6)
        typed = rng.random() < 0.3
        self.entry, self.exit = ("entry", "exit") if typed else ("driving", "driving")
        self.on_ramp, self.off_ramp = ("onRamp", "offRamp") if typed else ("driving", "driving")

    def event(self, event: str, space: float) -> None:
        """A stretch of road that ends with something."""
        rng = self.rng
        taper = float(rng.uniform(40, 160))
        match event:
            case "drop" if self.count > 1:
                self._road(space, {"closing": taper})
                self.count -= 1
            case "open" if self.count < 4:
                self._road(space, {"opening": taper})
                self.count += 1
            case "off":
                road = self._road(space, {"pocket": min(taper, 0.3 * space)})
                self._diverge(road, self.count)
            case "exit lane" if self.count > 1:
                road = self._road(space, {})
                self.count -= 1
                self._diverge(road, self.count)
            case "gain" if self.count < 4:
                self._merge(self._road(space, {}))
                self.count += 1
            case "weave" if self.count < 4:
                self._merge(self._road(space, {}))
                self.count += 1
                road = self._road(float(rng.uniform(120, 350)), {})
                self.count -= 1
                self._diverge(road, self.count)
            case _:
                self._merge(self._road(space, {}))
                self._road(space, {"merge": float(rng.uniform(60, 220)), "closing": taper})

    def finish(self, space: float) -> None:
        """The last road."""
        self._road(space, {})

    def _road(self, length: float, changes: dict[str, float]) -> Road:
        """The next road, linked to the one before or to its junction."""
        rng, width, count = self.rng, self.width, self.count
        line = self.base.cut(self.at, self.at + length)
        length = line.length
        steps = [Steps((0, width)) for _ in range(count)]
        if "merge" in changes:
            keep, taper = min(changes["merge"], 0.5 * length), min(changes["closing"], 0.4 * length)
            steps.append(Steps((keep, width), (keep + taper, 0), smooth=self.smooth))
        elif "closing" in changes:
            taper = min(changes["closing"], 0.5 * length)
            closing = Steps((0.3 * length, width), (0.3 * length + taper, 0), smooth=self.smooth)
            steps[0 if rng.random() < 0.3 else -1] = closing
        elif "opening" in changes:
            taper = min(changes["opening"], 0.5 * length)
            opening = Steps((0.3 * length, 0), (0.3 * length + taper, width), smooth=self.smooth)
            steps.insert(0 if rng.random() < 0.3 else count, opening)
        elif "pocket" in changes:
            taper, long = changes["pocket"], 0.4 * length
            steps.append(Steps((length - long - taper, 0), (length - long, width), smooth=self.smooth))
        strips = [Strip(x) for x in steps] + [Strip(Steps((0, EDGE)), "shoulder")]
        if "merge" in changes or "pocket" in changes:
            strips[-2] = strips[-2]._replace(kind=self.entry if "merge" in changes else self.exit)
        road = self.m.road(f"main {len(self.m.roads) + 1}", line, strips, kind="motorway", speed=self.speed)
        if self.before is not None:
            self.m.link(self.before.end, road.start)
        self.at, self.before = self.at + length, road
        return road

    def _nose(self) -> Curve:
        line = self.base.cut(self.at, self.at + self.nose)
        self.at, self.before = self.at + line.length, None
        return line

    def _merge(self, before: Road) -> None:
        """A junction at which a ramp comes in; the next road has a lane more."""
        junction = self.m.junction()
        gap, angle = float(self.rng.uniform(1.5, 4)), float(self.rng.uniform(0.04, 0.12))
        main = self.count * self.width
        mouth = self.base.pose(self.at).move(left=-main - EDGE - gap, turn=angle)
        away = mouth.move(turn=math.pi)
        ramp = Curve(away, self._ramp(-1)).reversed()
        road = self._ramp_road("on-ramp", ramp, self.on_ramp)
        line = self._nose()
        after = self._peek()
        self._through(junction, before, after, line, self.count)
        style = Style("cubic", False, 1.0, False, self.smooth, (), 0, 0, 0)
        lane = after.start.entering()[self.count]
        curve = style.line(road.end.inner_edge(-1), after.start.inner_edge(lane), self.width)
        low = self.m.connect(
            junction,
            road.end,
            [-1],
            after.start,
            [lane],
            line=curve,
            speed=min(80.0, self.speed),
            kind="motorway",
        )
        if self.rng.random() < 0.5:
            junction.priorities.append((junction.roads[0], low))

    def _peek(self) -> Road:
        """A short road behind a merge, with the lanes of both."""
        steps = [Strip(Steps((0, self.width))) for _ in range(self.count + 1)]
        line = self.base.cut(self.at, self.at + 30.0)
        strips = [*steps, Strip(Steps((0, EDGE)), "shoulder")]
        road = self.m.road(f"main {len(self.m.roads) + 1}", line, strips, kind="motorway", speed=self.speed)
        self.at, self.before = self.at + line.length, road
        return road

    def _diverge(self, before: Road, keep: int) -> None:
        """A junction at which the outermost lane becomes a ramp."""
        junction = self.m.junction()
        line = self._nose()
        strips = [*(Strip(Steps((0, self.width))) for _ in range(keep)), Strip(Steps((0, EDGE)), "shoulder")]
        main = self.base.cut(self.at, self.at + 30.0)
        after = self.m.road(f"main {len(self.m.roads) + 1}", main, strips, kind="motorway", speed=self.speed)
        self._through(junction, before, after, line, keep)
        gap, angle = float(self.rng.uniform(1.5, 4)), float(self.rng.uniform(0.04, 0.12))
        mouth = self.base.pose(self.at).move(left=-keep * self.width - EDGE - gap, turn=-angle)
        road = self._ramp_road("off-ramp", Curve(mouth, self._ramp(-1)), self.off_ramp)
        lane = before.end.leaving()[keep]
        style = Style("cubic", False, 1.0, False, self.smooth, (), 0, 0, 0)
        curve = style.line(before.end.inner_edge(lane), road.start.inner_edge(-1), self.width)
        self.m.connect(
            junction,
            before.end,
            [lane],
            road.start,
            [-1],
            line=curve,
            speed=min(80.0, self.speed),
            kind="motorway",
        )
        self.at, self.before = self.at + main.length, after

    def _through(self, junction: Junction, before: Road, after: Road, line: Curve, count: int) -> None:
        sources, targets = before.end.leaving()[:count], after.start.entering()[:count]
        more = {"speed": self.speed, "kind": "motorway"}
        if self.joint:
            self.m.connect(junction, before.end, sources, after.start, targets, line=line, **more)
            return
        style = Style("cubic", True, 1.0, False, self.smooth, (), 0, 0, 0)
        for a, b in zip(sources, targets, strict=True):
            curve = style.line(before.end.inner_edge(a), after.start.inner_edge(b), self.width)
            self.m.connect(junction, before.end, [a], after.start, [b], line=curve, **more)

    def _ramp(self, side: float) -> list[Piece]:
        """From the nose outwards."""
        rng = self.rng
        radius, turn = float(rng.uniform(60, 200)), float(rng.uniform(15, 50))
        run = math.radians(turn) * radius
        return [
            Piece(float(rng.uniform(20, 60))),
            *arc(radius, side * turn, 0.4 * run),
            Piece(float(rng.uniform(30, 120))),
        ]

    def _ramp_road(self, name: str, line: Curve, kind: str) -> Road:
        width = Steps((0, float(self.rng.uniform(3.25, 4.0))))
        strips = [Strip(width, kind), Strip(Steps((0, EDGE)), "shoulder")]
        speed = float(self.rng.choice([60, 80]))
        return self.m.road(f"{name} {len(self.m.roads) + 1}", line, strips, kind="motorway", speed=speed)


def plain_road(rng: Rng) -> Map:
    """Roads in a row with lanes that open and end."""
    m = Map(left_hand=bool(rng.random() < 0.2))
    one_way = 1 if rng.random() < 0.3 else 0
    pose = Pose(0, 0, float(rng.uniform(-3, 3)))
    before: Road | None = None
    count = int(rng.integers(2, 4))
    flip = False
    plan = RoadPlan.draw(rng, start=False, end=False, one_way=one_way)
    plan.median = 0.0
    for k in range(count):
        line = Curve(pose, bends(rng, float(rng.uniform(200, 350))))
        pose = line.end
        if max(abs(c) for piece in line.pieces for c in piece[1:]) > 0.6 / (plan.half_width() + 4):
            raise Unfit("a road bent too sharply")
        flip = rng.random() < 0.3
        right = [_changing(rng, x.width, line.length) for x in plan.right]
        left = [_changing(rng, x.width, line.length) for x in plan.left]
        first, second = (right, left) if not flip else (left, right)
        if flip:
            line = line.reversed()
        for strips in (first, second):
            if strips and all(x.width.borders() for x in strips):
                strips[0] = Strip(Steps((0, plan.right[0].width)))
        verge = Steps((0, max(plan.verge[1], 0.5)))
        more = [[*x, Strip(verge, "shoulder")] if x else [] for x in (first, second)]
        road = m.road(f"road {k}", line, *more, kind="rural", speed=plan.speed, marks="broken")
        if before is not None:
            last = before.end if before.name.endswith("+") else before.start
            m.link(last, road.start if not flip else road.end)
        road.name += "+" if not flip else "-"
        before = road
    return m


def _changing(rng: Rng, width: float, length: float) -> Strip:
    """A lane that is there at both ends; perhaps it ends and opens again, or swells."""
    smooth = bool(rng.random() < 0.5)
    a, b, c, d = (
        float(x) * length
        for x in (0.15, rng.uniform(0.25, 0.45), rng.uniform(0.55, 0.65), rng.uniform(0.7, 0.9))
    )
    match int(rng.integers(4)):
        case 0:
            return Strip(Steps((a, width), (b, 0), (c, 0), (d, width), smooth=smooth))
        case 1:
            return Strip(Steps((a, width), (b, width + 0.8), (c, width + 0.8), (d, width), smooth=smooth))
        case _:
            return Strip(Steps((0, width)))
