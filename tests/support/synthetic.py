"""Small networks built in memory, for tests of what is computed from a `Network`."""

import dataclasses
import math

import numpy as np

from limsim_jax.maps.network import Control, Junction, Lane, LaneType, Movement, Network, Road, Turn


def lane_along(points, lane_id, heading=None, **fields):
    """A lane through dense points [M, 2 or 3] (m)."""
    xyz = np.asarray(points, float)
    if xyz.shape[1] == 2:
        xyz = np.column_stack([xyz, np.zeros(len(xyz))])
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xyz[:, :2], axis=0), axis=1))])
    if heading is None:
        heading = np.unwrap(np.arctan2(np.gradient(xyz[:, 1], s), np.gradient(xyz[:, 0], s)))
    curvature = np.gradient(heading, s)
    defaults = {"road": f"r{lane_id}", "number": -1, "speed_limit": 13.9, "width": np.full(len(s), 3.5)}
    return Lane(
        id=lane_id, s=s, xyz=xyz, heading=heading, curvature=curvature, road_s=s, **{**defaults, **fields}
    )


def straight(lane_id, start, heading, length, z=0.0, **fields):
    """A straight lane from `start` (x, y)."""
    s = np.linspace(0, length, max(2, math.ceil(length / 10) + 1))
    x, y = start
    xyz = np.column_stack([x + s * math.cos(heading), y + s * math.sin(heading), np.full(len(s), z)])
    return lane_along(xyz, lane_id, np.full(len(s), heading), **fields)


def arc(lane_id, center, radius, start, sweep, **fields):
    """A lane on a circle from polar angle `start` over `sweep` (rad, positive to the left)."""
    angle = start + np.linspace(0, sweep, max(8, math.ceil(abs(sweep) * radius / 0.25)))
    xy = np.column_stack([center[0] + radius * np.cos(angle), center[1] + radius * np.sin(angle)])
    return lane_along(xy, lane_id, angle + math.copysign(math.pi / 2, sweep), **fields)


def curve(lane_id, p0, h0, p1, h1, **fields):
    """A smooth lane (cubic Bezier) from pose to pose."""
    p0, p1 = np.asarray(p0, float), np.asarray(p1, float)
    turned = abs(math.remainder(h1 - h0, math.tau))
    reach = np.linalg.norm(p1 - p0) * (0.34 + 0.1 * turned / math.pi)
    a, b = (
        p0 + reach * np.array([math.cos(h0), math.sin(h0)]),
        p1 - reach * np.array([math.cos(h1), math.sin(h1)]),
    )
    u = np.linspace(0, 1, 200)[:, None]
    points = (1 - u) ** 3 * p0 + 3 * u * (1 - u) ** 2 * a + 3 * u**2 * (1 - u) * b + u**3 * p1
    return lane_along(points, lane_id, **fields)


def network(lanes, movements=(), roads=(), **fields):
    """A network of these lanes; predecessors follow from the successors, junctions from the lanes."""
    lanes = {lane.id: lane for lane in lanes}
    for lane in list(lanes.values()):
        for name in lane.successors:
            after = lanes[name]
            lanes[name] = dataclasses.replace(after, predecessors=(*after.predecessors, lane.id))
    known = {road.id: road for road in roads}
    roads = {
        lane.road: known.get(lane.road, Road(id=lane.road, junction=lane.junction)) for lane in lanes.values()
    }
    junctions = {
        j: Junction(
            id=j,
            connectors=tuple(lane.id for lane in lanes.values() if lane.junction == j),
            movements=tuple(m.index for m in movements if m.junction == j),
        )
        for j in dict.fromkeys(lane.junction for lane in lanes.values() if lane.junction is not None)
    }
    return Network(
        name="synthetic",
        source="synthetic",
        file_hash="",
        format="synthetic",
        lanes=lanes,
        roads=roads,
        movements=tuple(movements),
        junctions=junctions,
        **fields,
    )


def turn_of(angle):
    angle = math.degrees(math.remainder(angle, math.tau))
    if abs(angle) > 150:
        return Turn.U_TURN
    if abs(angle) < 30:
        return Turn.STRAIGHT
    return Turn.LEFT if angle > 0 else Turn.RIGHT


def intersection(
    arms=(0.0, 90.0, 180.0, 270.0),
    lanes=1,
    control=None,
    radius=15.0,
    width=3.5,
    u_turns=False,
    junction="J",
    length=100.0,
    separate_left=False,
):
    """Arms at these angles (degrees) around the origin, right-hand traffic, `lanes` each way.

    Lane ids: `in{arm}_{k}` and `out{arm}_{k}`, k = 0 at the right; connectors `{in}>{out}`. Going
    straight keeps the lane, turns use the outer or inner lane (`separate_left`: the innermost lane
    turns left only).
    """
    control = control or {}
    built, movements = [], []
    ends = {}
    for a, degrees in enumerate(arms):
        angle = math.radians(degrees)
        along, left = (
            np.array([math.cos(angle), math.sin(angle)]),
            np.array([-math.sin(angle), math.cos(angle)]),
        )
        for k in range(lanes):
            offset = (lanes - k - 0.5) * width  # k = 0 is the outermost
            ends["in", a, k] = along * radius + left * offset, angle + math.pi
            ends["out", a, k] = along * radius - left * offset, angle
    successors = {key: [] for key in ends}
    for a, b in [(a, b) for a in range(len(arms)) for b in range(len(arms))]:
        turn = turn_of(math.radians(arms[b] - arms[a]) - math.pi)
        if a == b and not u_turns:
            continue
        if turn is Turn.STRAIGHT:
            used = range(lanes - 1) if separate_left and lanes > 1 else range(lanes)
        else:
            used = [0] if turn is Turn.RIGHT else [lanes - 1]
        for k in used:
            name = f"in{a}_{k}>out{b}_{k}"
            (p0, h0), (p1, h1) = ends["in", a, k], ends["out", b, k]
            successors["in", a, k].append(name)
            built.append(
                curve(name, p0, h0, p1, h1, road=name, junction=junction, successors=(f"out{b}_{k}",))
            )
            movements.append(
                Movement(
                    index=len(movements),
                    junction=junction,
                    incoming=f"in{a}_{k}",
                    outgoing=f"out{b}_{k}",
                    via=(name,),
                    turn=turn,
                    control=control.get(a, Control.NONE),
                )
            )
    for (side, a, k), (point, heading) in ends.items():
        way = np.array([math.cos(heading), math.sin(heading)])
        start = point - length * way if side == "in" else point
        left = f"{side}{a}_{k + 1}" if k + 1 < lanes else None
        right = f"{side}{a}_{k - 1}" if k else None
        built.append(
            straight(
                f"{side}{a}_{k}",
                start,
                heading,
                length,
                road=f"{side}{a}",
                number=k,
                successors=tuple(successors[side, a, k]),
                left=left,
                right=right,
                may_change_left=left is not None,
                may_change_right=right is not None,
            )
        )
    return network(built, movements)


def roundabout(arms=4, radius=20.0):
    """A one-lane ring, counter-clockwise, with an entry and an exit per arm and no priority in the file.

    Ring lanes: `ring{a}` between the entry of arm a and the exit of arm a + 1, and the connectors
    `{a}:on` (through), `{a}:enter`, `{a}:leave` of junction `J{a}`.
    """
    built, movements = [], []
    step, half = math.tau / arms, math.tau / arms / 4
    for a in range(arms):
        angle, junction = a * step, f"J{a}"
        before, after = f"ring{(a - 1) % arms}", f"ring{a}"
        out = np.array([math.cos(angle), math.sin(angle)])
        left = np.array([-out[1], out[0]])
        on_ring = {
            side: (radius * np.array([math.cos(t), math.sin(t)]), t + math.pi / 2)
            for side, t in (("in", angle - half), ("out", angle + half))
        }
        entry = (radius + 15) * out + 3 * left
        leave = (radius + 15) * out - 3 * left
        fields = {"junction": junction}
        built += [
            arc(
                after,
                (0, 0),
                radius,
                angle + half,
                step - 2 * half,
                successors=tuple(f"{(a + 1) % arms}:{x}" for x in ("on", "leave")),
            ),
            arc(
                f"{a}:on",
                (0, 0),
                radius,
                angle - half,
                2 * half,
                road=f"{a}:on",
                successors=(after,),
                **fields,
            ),
            curve(
                f"{a}:enter",
                entry,
                angle + math.pi,
                *on_ring["out"],
                road=f"{a}:enter",
                successors=(after,),
                **fields,
            ),
            curve(
                f"{a}:leave",
                *on_ring["in"],
                leave,
                angle,
                road=f"{a}:leave",
                successors=(f"exit{a}",),
                **fields,
            ),
            straight(f"entry{a}", entry + 80 * out, angle + math.pi, 80, successors=(f"{a}:enter",)),
            straight(f"exit{a}", leave, angle, 80),
        ]
        for name, incoming, outgoing, turn in (
            ("on", before, after, Turn.STRAIGHT),
            ("enter", f"entry{a}", after, Turn.RIGHT),
            ("leave", before, f"exit{a}", Turn.RIGHT),
        ):
            movements.append(
                Movement(
                    index=len(movements),
                    junction=junction,
                    incoming=incoming,
                    outgoing=outgoing,
                    via=(f"{a}:{name}",),
                    turn=turn,
                )
            )
    return network(built, movements)


_MIRROR = {
    Turn.LEFT: Turn.RIGHT,
    Turn.RIGHT: Turn.LEFT,
    Turn.SLIGHT_LEFT: Turn.SLIGHT_RIGHT,
    Turn.SLIGHT_RIGHT: Turn.SLIGHT_LEFT,
}


def mirrored(net):
    """The network seen in a mirror (y -> -y): left-hand traffic becomes right-hand traffic."""
    lanes = {
        lane.id: dataclasses.replace(
            lane,
            xyz=lane.xyz * [1, -1, 1],
            heading=-lane.heading,
            curvature=-lane.curvature,
            left=lane.right,
            right=lane.left,
            may_change_left=lane.may_change_right,
            may_change_right=lane.may_change_left,
        )
        for lane in net.lanes.values()
    }
    movements = tuple(dataclasses.replace(m, turn=_MIRROR.get(m.turn, m.turn)) for m in net.movements)
    roads = {r.id: dataclasses.replace(r, left_hand=not r.left_hand) for r in net.roads.values()}
    return dataclasses.replace(net, lanes=lanes, movements=movements, roads=roads)


def shuffled(net, seed):
    """The same network with its lanes in another order."""
    names = list(net.lanes)
    np.random.default_rng(seed).shuffle(names)
    return dataclasses.replace(net, lanes={name: net.lanes[name] for name in names})


def rows(net):
    return {lane.id: i for i, lane in enumerate(net.drivable_lanes())}


__all__ = [
    "LaneType",
    "arc",
    "curve",
    "intersection",
    "lane_along",
    "mirrored",
    "network",
    "roundabout",
    "rows",
    "shuffled",
    "straight",
    "turn_of",
]
