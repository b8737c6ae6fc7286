"""Networks of streets: junctions at random angles and the roads between them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from mapbuilder.curves import Curve, Piece, Pose, arc, join, wrap

from random_roads.junctions import RULES, Map, Style, Unfit, crossing, regulate
from random_roads.roads import Contact, Road, Steps, Strip

Rng = np.random.Generator

LEAST_GAP = math.radians(48)
"""Between two arms of a junction."""


class LanePlan(NamedTuple):
    """A lane of one direction: there all along, or on a part of the road."""

    role: str  # base, pocket (opens before the end), closing (ends after the start), opening (in the middle)
    width: float  # m
    at: float = 0.0  # m, length of the pocket or of the lane that closes
    taper: float = 0.0  # m

    def steps(self, length: float, smooth: bool) -> Steps:
        """Width along the direction of travel."""
        at, taper = min(self.at, 0.4 * length), min(self.taper, 0.3 * length)
        match self.role:
            case "pocket":
                return Steps((length - at - taper, 0), (length - at, self.width), smooth=smooth)
            case "closing":
                return Steps((at, self.width), (at + taper, 0), smooth=smooth)
            case "opening":
                return Steps((0.4 * length, 0), (0.4 * length + taper, self.width), smooth=smooth)
            case _:
                return Steps((0, self.width))


def lane_plans(
    rng: Rng, count: int, *, to_junction: bool, from_junction: bool, through: bool
) -> list[LanePlan]:
    """Lanes of a direction from the middle outwards; `through`: the road leads from junction to junction."""
    width = float(rng.uniform(2.9, 3.75))
    inner: list[LanePlan] = []
    outer: list[LanePlan] = []

    def some(role: str, low: float, high: float) -> None:
        plan = LanePlan(
            role, float(rng.uniform(2.8, width)), float(rng.uniform(low, high)), float(rng.uniform(12, 45))
        )
        (inner if rng.random() < 0.6 else outer).append(plan)

    if to_junction and rng.random() < 0.35:
        some("pocket", 12, 60)
    if to_junction and count < 3 and rng.random() < 0.2:
        some("pocket", 12, 45)
    if from_junction and count < 3 and rng.random() < 0.25:
        some("closing", 12, 60)
    if through and count < 3 and rng.random() < 0.12:
        some("opening", 0, 0)
    return [*inner, *(LanePlan("base", width) for _ in range(count)), *outer]


@dataclass
class RoadPlan:
    """A road before its length is known: lanes of both directions."""

    right: list[LanePlan]
    left: list[LanePlan]
    smooth: bool
    speed: float
    marks: str
    median: float  # m, 0 for none
    verge: tuple[str, float]  # type and width (m) of the outermost strips
    steady: bool  # the lane offset takes up an inner pocket

    @staticmethod
    def draw(rng: Rng, *, start: bool, end: bool, one_way: int = 0, most: int = 3) -> RoadPlan:
        """Any road; `start`, `end`: these ends are at junctions. `one_way`: +1 or -1."""
        chances = np.array([0.5, 0.35, 0.15][:most])
        count = int(rng.choice(most, p=chances / chances.sum())) + 1
        other = count if rng.random() < 0.75 else int(rng.choice(most)) + 1
        through = start and end
        verge = (
            ("none", 0.0)
            if rng.random() < 0.6
            else (str(rng.choice(["sidewalk", "shoulder", "border"])), 1.5)
        )
        right = lane_plans(rng, count, to_junction=end, from_junction=start, through=through)
        left = lane_plans(rng, other, to_junction=start, from_junction=end, through=through)
        return RoadPlan(
            right=right if one_way >= 0 else [],
            left=left if one_way <= 0 else [],
            smooth=bool(rng.random() < 0.5),
            speed=float(rng.choice([30, 50, 50, 60, 80])),
            marks=str(rng.choice(["broken", "broken", "broken", "solid"])),
            median=float(rng.uniform(1, 4)) if not one_way and rng.random() < 0.2 else 0.0,
            verge=verge,
            steady=bool(rng.random() < 0.3),
        )

    def half_width(self) -> float:
        """Most on one side, m."""
        sides = [sum(x.width for x in lanes) + self.verge[1] for lanes in (self.right, self.left)]
        shift = sum(x.width for x in self.right if x.role == "pocket") if self.steady else 0.0
        return max(sides) + self.median + shift

    def build(self, m: Map, name: str, line: Curve) -> Road:
        """The road along a line."""
        length = line.length
        right = [Strip(x.steps(length, self.smooth)) for x in self.right]
        left = [Strip(x.steps(length, self.smooth).mirrored(length)) for x in self.left]
        offset = Steps((0, 0))
        if self.steady and self.right and self.right[0].role == "pocket":
            offset = right[0].width
        if self.median:
            right.insert(0, Strip(Steps((0, self.median)), "none"))
        kind, width = self.verge
        if width:
            for strips in (right, left):
                if strips:
                    strips.append(Strip(Steps((0, width)), kind))
        return m.road(name, line, right, left, speed=self.speed, marks=self.marks, offset=offset)


def bends(rng: Rng, length: float) -> list[Piece]:
    """Lines, arcs, clothoids and S-curves of this length, about."""
    pieces: list[Piece] = []
    done, sign = 0.0, 1.0 if rng.random() < 0.5 else -1.0
    while done < length:
        radius = float(np.exp(rng.uniform(math.log(45), math.log(400))))
        turn = math.degrees(min(rng.uniform(0.15, 0.7), 0.6 * length / radius))
        run = math.radians(turn) * radius
        match int(rng.integers(4)):
            case 0:
                new = [Piece(float(rng.uniform(20, 80)))]
            case 1:
                new = [Piece(run, sign / radius, sign / radius)]
            case 2:
                new = arc(radius, sign * turn, 0.4 * run)
            case _:
                new = [*arc(radius, sign * turn, 0.4 * run), *arc(radius, -sign * turn, 0.4 * run)]
        sign = -sign
        pieces += new
        done += sum(p.length for p in new)
    return pieces


@dataclass
class Node:
    """A junction in the plan: its place, and arms by direction."""

    x: float
    y: float
    z: float = 0.0
    arms: list[tuple[float, RoadPlan, int | None]] = field(default_factory=list)  # rad, road, node beyond

    def mouths(self, rng: Rng) -> list[Pose]:
        """Where each arm ends, heading away from the junction."""
        order = sorted(range(len(self.arms)), key=lambda k: wrap(self.arms[k][0]))
        room = [self.arms[k][1].half_width() * 0.5 + 2 for k in range(len(self.arms))]
        for k, n in zip(order, [*order[1:], order[0]], strict=True):
            gap = (self.arms[n][0] - self.arms[k][0]) % (2 * math.pi)
            if gap < LEAST_GAP:
                raise Unfit("arms too close")
            if gap < 3.0:
                a, b = self.arms[k][1].half_width(), self.arms[n][1].half_width()
                kerb = float(rng.uniform(4, 9)) / math.tan(gap / 2)
                room[k] = max(room[k], (b + a * math.cos(gap)) / math.sin(gap) + kerb)
                room[n] = max(room[n], (a + b * math.cos(gap)) / math.sin(gap) + kerb)
        more = rng.uniform(0, 1) ** 2 * 8
        shift = rng.uniform(-1.5, 1.5, len(room)) * (rng.random() < 0.3)
        return [
            Pose(self.x, self.y, angle).move(ahead=r + more, left=float(d))
            for (angle, _, _), r, d in zip(self.arms, room, shift, strict=True)
        ]


def free_angles(rng: Rng, taken: Sequence[float], count: int) -> list[float]:
    """Directions of further arms, about in the middle of the widest gap."""
    angles = sorted(a % (2 * math.pi) for a in taken)
    found = []
    for _ in range(count):
        gaps = [
            (b - a) % (2 * math.pi) or 2 * math.pi
            for a, b in zip(angles, [*angles[1:], angles[0]], strict=True)
        ]
        k = int(np.argmax(gaps))
        slack = max(gaps[k] / 2 - LEAST_GAP, 0.0)
        new = (angles[k] + gaps[k] / 2 + float(rng.uniform(-slack, slack)) * 0.8) % (2 * math.pi)
        found.append(new)
        angles = sorted([*angles, new])
    return found


def build(rng: Rng, nodes: list[Node], edges: Sequence[tuple[int, int]], arms: Sequence[int]) -> Map:
    """Junctions and roads of a plan; `arms`: roads that lead out of the map, by node."""
    m = Map(left_hand=bool(rng.random() < 0.2))
    for a, b in edges:
        plan = RoadPlan.draw(rng, start=True, end=True, most=2 if len(edges) > 2 else 3)
        angle = math.atan2(nodes[b].y - nodes[a].y, nodes[b].x - nodes[a].x)
        jitter = rng.uniform(-0.25, 0.25, 2)
        nodes[a].arms.append((angle + float(jitter[0]), plan, b))
        nodes[b].arms.append((angle + math.pi + float(jitter[1]), plan, a))
    for k, node in enumerate(nodes):
        taken = [angle for angle, _, _ in node.arms] or [float(rng.uniform(0, 2 * math.pi))]
        count = arms[k] - (0 if node.arms else 1)
        ways = [1] * (arms[k])
        if arms[k] + len(edges) > 2 and rng.random() < 0.2:
            ways[-1] = 0
        angles = free_angles(rng, taken, count)
        for angle, way in zip(angles if node.arms else [*taken, *angles], ways, strict=True):
            one_way = 0 if way else int(rng.choice([-1, 1]))
            node.arms.append((angle, RoadPlan.draw(rng, start=True, end=False, one_way=one_way), None))
    mouths = [node.mouths(rng) for node in nodes]
    steep = float(rng.uniform(0.5, 4)) if rng.random() < 0.3 else 0.0  # m
    for node in nodes:
        node.z = steep * float(rng.uniform(-1, 1))
    ends: list[list[Contact | None]] = [[None] * len(node.arms) for node in nodes]
    for a, node in enumerate(nodes):
        for i, (_, plan, b) in enumerate(node.arms):
            if b is None:
                ends[a][i] = outer_arm(
                    m, rng, plan, mouths[a][i], (node.z, node.z + steep * float(rng.uniform(-1, 1)))
                )
            elif a < b:
                j = next(j for j, arm in enumerate(nodes[b].arms) if arm[1] is plan)
                there = mouths[b][j].move(turn=math.pi)
                if mouths[a][i].local(there)[0] < 6:
                    raise Unfit("junctions too close")
                line = join(mouths[a][i], there)
                if line.length > 1.4 * math.hypot(node.x - nodes[b].x, node.y - nodes[b].y):
                    raise Unfit("a detour")
                if max(abs(k) for piece in line.pieces for k in piece[1:]) > 0.7 / plan.half_width():
                    raise Unfit("a road bent too sharply")
                road = plan.build(m, f"{a} to {b}", line)
                road.height = Steps((0, node.z), (line.length, nodes[b].z))
                ends[a][i], ends[b][j] = road.start, road.end
    for found in ends:
        contacts = [x for x in found if x is not None]
        ways = crossing(m, rng, contacts, Style.draw(rng))
        regulate(m, rng, contacts, ways, str(rng.choice(RULES)))
    return m


def outer_arm(
    m: Map, rng: Rng, plan: RoadPlan, mouth: Pose, heights: tuple[float, float] = (0.0, 0.0)
) -> Contact:
    """A road out of the map, or two in a row."""
    line = Curve(mouth, bends(rng, float(rng.uniform(80, 200))))
    road = plan.build(m, f"arm {len(m.roads) + 1}", line)
    road.height = Steps((0, heights[0]), (line.length, heights[1]))
    if rng.random() < 0.35:
        beyond = Curve(line.end, bends(rng, float(rng.uniform(40, 120))))
        right = [
            Strip(Steps((0, x.width(road.length))), x.kind) for x in road.right if x.width(road.length) > 0
        ]
        left = [
            Strip(Steps((0, x.width(road.length))), x.kind) for x in road.left if x.width(road.length) > 0
        ]
        shift = road.offset(road.length)
        if rng.random() < 0.5:
            more = m.road(
                f"beyond {road.name}", beyond, right, left, speed=plan.speed, offset=Steps((0, shift))
            )
            m.link(road.end, more.start)
        else:
            line = beyond.reversed()
            more = m.road(
                f"beyond {road.name}", line, left, right, speed=plan.speed, offset=Steps((0, -shift))
            )
            m.link(road.end, more.end)
        more.height = Steps((0, heights[1]))
    return road.start


def one_crossing(rng: Rng) -> Map:
    """A junction of three to five arms."""
    return build(rng, [Node(0, 0)], [], [int(rng.integers(3, 6))])


def chain(rng: Rng) -> Map:
    """Two or three junctions in a row."""
    count = int(rng.integers(2, 4))
    space = float(rng.uniform(45, 180))
    nodes = [Node(k * space, float(rng.uniform(-0.2, 0.2)) * space) for k in range(count)]
    ends = [k in (0, count - 1) for k in range(count)]
    return build(
        rng,
        nodes,
        [(k, k + 1) for k in range(count - 1)],
        [int(rng.integers(2, 4)) if end else int(rng.integers(1, 3)) for end in ends],
    )


def blocks(rng: Rng) -> Map:
    """Four junctions around a block, with arms outwards."""
    space = rng.uniform(90, 190, 2)
    corners = [np.array([x, y]) + rng.uniform(-0.1, 0.1, 2) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))]
    nodes = [Node(float(x), float(y)) for x, y in (corner * space for corner in corners)]
    return build(rng, nodes, [(0, 1), (1, 2), (3, 2), (0, 3)], [int(x) for x in rng.integers(1, 3, 4)])
