"""Lanes across gaps: no vehicle leaps from the end of a lane to the start of another.

A file may link lanes whose ends lie apart: SUMO networks without internal lanes, junctions that connect
ordinary roads. Where the gap is wider than a lane and a vehicle can steer across it, a curve becomes a lane.
Otherwise the link goes.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np

from limsim_jax.maps.network import ImportReport, Lane, LaneType, Movement, Network, Road

LEAP = 1.05
"""Gap between two lanes that needs a bridge, as a share of the narrower one's width there."""

LONGEST = 100.0
"""Longest bridge, m along the straight line: no junction is wider."""

TIGHTEST = 3.0
"""Least radius of a bridge, m: a car at full lock."""

COINCIDE = 1.0
"""Largest distance (m) between two lane ends that are one place."""

AHEAD = math.radians(45.0)
"""Largest change of heading (rad) from a lane to the one that it leads to."""

_SAMPLE = 0.25  # m between samples of a bridge
_BACK = 2.0  # rad, turn on the spot beyond which the next lane leads back ...
_ASIDE = 0.5  # m: ... if it is as far away
_REACH = 0.6  # length of the tangents of the cubic at both ends, as a share of the gap, on a straight way


Pair = tuple[str, str]
"""Ids of a lane and of one that it leads to."""


def bridge_lanes(
    lanes: dict[str, Lane], across: Mapping[Pair, str], report: ImportReport, *, back: bool = True
) -> tuple[dict[Pair, Lane], set[Pair]]:
    """Put a lane across every gap between linked lanes.

    Where no vehicle can steer across, the link goes.

    Args:
      lanes: of a map, by id; changed in place.
      across: junctions that links between lanes outside cross.
      report: receives a note for every gap.
      back: whether to look at lanes that lead back beside the end of another, too. SUMO's networks without
        lanes in junctions turn round like that.

    Returns:
      The new lanes by the pair that they join, and the pairs whose link is gone.
    """
    made: dict[Pair, Lane] = {}
    cut: set[Pair] = set()
    instead: set[Pair] = set()
    for before in [lane for lane in lanes.values() if lane.drivable]:
        for after in (lanes[name] for name in before.successors):
            gap = _gap(before, after)
            leaps = gap > LEAP * max(min(before.width[-1], after.width[0]), 1.0)
            leaps |= back and gap > _ASIDE and _turn(before, after) > _BACK
            if not after.drivable or not leaps:
                continue
            if goes_on_beside(lanes, before, after) is not None:
                continue  # traffic changes lanes before
            pair = before.id, after.id
            junction = across.get(pair, before.junction if before.junction is not None else after.junction)
            found = _curve(before, after, junction) if gap <= LONGEST else None
            where = f"{before.id} to {after.id}"
            other = _begins_at(lanes, before, after) if found is None else None
            if other is not None:
                cut.add(pair)
                instead.add((before.id, other.id))
                message = f"the lanes are {gap:.1f} m apart: linked to {other.id} instead, which begins there"
                report.repaired("lane link", where, message)
            elif found is None:
                cut.add(pair)
                message = f"the lanes are {gap:.1f} m apart, and no vehicle can steer across: not linked"
                report.unusable("lane link", where, message)
            else:
                made[pair] = found
                message = f"the lanes are {gap:.1f} m apart: a lane of {found.length:.1f} m leads across"
                report.repaired("lane link", where, message)
    for pair in cut:
        _relink(lanes, pair, None)
    for pair, lane in made.items():
        lanes[lane.id] = lane
        _relink(lanes, pair, lane.id)
    for first, second in sorted(instead):
        before, after = lanes[first], lanes[second]
        lanes[first] = replace(before, successors=tuple(dict.fromkeys((*before.successors, second))))
        after = lanes[second]
        lanes[second] = replace(after, predecessors=tuple(dict.fromkeys((*after.predecessors, first))))
    return made, cut


def goes_on_beside(lanes: Mapping[str, Lane], before: Lane, after: Lane) -> Lane | None:
    """The lane beside `before` that leads straight into `after`.

    None where `before` does so itself."""
    if side_step(before, after) <= before.width[-1] / 2:
        return None
    beside = [lanes[name] for name in (before.left, before.right) if name and name in lanes]
    going = (x for x in beside if after.id in x.successors and side_step(x, after) <= before.width[-1] / 2)
    return next(going, None)


def side_step(before: Lane, after: Lane) -> float:
    """Lateral distance (m) from the end of a lane to the next."""
    off = after.xyz[0, :2] - before.xyz[-1, :2]
    heading = before.heading[-1]
    return abs(float(off[1] * np.cos(heading) - off[0] * np.sin(heading)))


def _begins_at(lanes: Mapping[str, Lane], before: Lane, after: Lane) -> Lane | None:
    """The lane beside `after` that begins where `before` ends."""
    found = [
        lane
        for lane in lanes.values()
        if lane.carriageway == after.carriageway
        and lane.drivable
        and lane.id not in before.successors
        and _gap(before, lane) <= min(COINCIDE, lane.width[0] / 2)
        and _turn(before, lane) <= AHEAD
    ]
    return min(found, key=lambda lane: _gap(before, lane), default=None)


def _gap(before: Lane, after: Lane) -> float:
    """Distance (m) from the end of a lane to another, from above."""
    return float(np.linalg.norm(after.xyz[0, :2] - before.xyz[-1, :2]))


def _turn(before: Lane, after: Lane) -> float:
    """Angle (rad) between the end of a lane and another."""
    return abs(math.remainder(after.heading[0] - before.heading[-1], 2 * math.pi))


def bridge(network: Network) -> Network:
    """The network with lanes across the gaps between linked lanes.

    Where no vehicle can steer across, the link goes. Notes go to the report of the network.
    """
    lanes = dict(network.lanes)
    across = {(m.incoming, m.outgoing): m.junction for m in network.movements if not m.via}
    made, cut = bridge_lanes(lanes, across, network.report, back=False)
    if not made and not cut:
        return network
    roads = network.roads | bridge_roads(network.roads, lanes, made)
    return _with_movements(replace(network, lanes=lanes, roads=roads), made, cut)


def bridge_roads(
    roads: Mapping[str, Road], lanes: Mapping[str, Lane], made: Mapping[Pair, Lane]
) -> dict[str, Road]:
    """A road for each bridge, by id."""
    return {
        lane.road: replace(
            roads[lanes[before].road], id=lane.road, name="", length=lane.length, junction=lane.junction
        )
        for (before, _), lane in made.items()
    }


def _relink(lanes: dict[str, Lane], pair: Pair, middle: str | None) -> None:
    """Let `middle` stand between two linked lanes, or nothing."""
    before, after = (lanes[name] for name in pair)
    new = () if middle is None else (middle,)
    lanes[before.id] = replace(before, successors=_instead(before.successors, after.id, new))
    after = lanes[after.id]  # a lane may lead into itself
    lanes[after.id] = replace(after, predecessors=_instead(after.predecessors, before.id, new))


def _instead(names: tuple[str, ...], old: str, new: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(x for name in names for x in (new if name == old else (name,)))


def _with_movements(network: Network, made: dict[Pair, Lane], cut: set[Pair]) -> Network:
    """The network with bridges on ways across junctions, none across cuts."""
    kept: list[Movement] = []
    for movement in network.movements:
        way = (movement.incoming, *movement.via, movement.outgoing)
        steps = list(pairwise(way))
        if any(step in cut for step in steps):
            continue
        via = [name for step in steps for name in ((made[step].id,) if step in made else ()) + (step[1],)]
        kept.append(replace(movement, via=tuple(via[:-1])))
    number = {movement.index: k for k, movement in enumerate(kept)}

    def renumbered(old: frozenset[int]) -> frozenset[int]:
        return frozenset(number[x] for x in old if x in number)

    inside: dict[str, list[str]] = defaultdict(list)
    for lane in made.values():
        if lane.junction is not None:
            inside[lane.junction].append(lane.id)
    return replace(
        network,
        movements=tuple(
            replace(m, index=k, yields_to=renumbered(m.yields_to), foes=renumbered(m.foes))
            for k, m in enumerate(kept)
        ),
        junctions={
            name: replace(
                junction,
                movements=tuple(number[m] for m in junction.movements if m in number),
                connectors=(*junction.connectors, *inside[name]),
            )
            for name, junction in network.junctions.items()
        },
        programs={
            name: replace(
                program,
                movements=tuple(tuple(number[m] for m in link if m in number) for link in program.movements),
            )
            for name, program in network.programs.items()
        },
    )


def _curve(before: Lane, after: Lane, junction: str | None) -> Lane | None:
    """A lane from one to another; None if it cannot be steered."""
    p, q = before.xyz[-1], after.xyz[0]
    begin, end = float(before.heading[-1]), float(after.heading[0])
    gap = float(np.linalg.norm((q - p)[:2]))
    turn = math.remainder(end - begin, 2 * math.pi)
    # tangents as a circular arc through both ends would have them; a half turn has no finite one
    reach = gap * 3 * _REACH / max(1.0 + math.cos(turn / 2), 0.5)
    tangents = reach * np.array([[math.cos(begin), math.sin(begin)], [math.cos(end), math.sin(end)]])
    u = np.linspace(0.0, 1.0, max(int(2 * gap / _SAMPLE), 8) + 1)[:, None]
    cubic = [2 * u**3 - 3 * u**2 + 1, u**3 - 2 * u**2 + u, 3 * u**2 - 2 * u**3, u**3 - u**2]
    slope = [6 * u**2 - 6 * u, 3 * u**2 - 4 * u + 1, 6 * u - 6 * u**2, 3 * u**2 - 2 * u]
    bend = [12 * u - 6, 6 * u - 4, 6 - 12 * u, 6 * u - 2]
    points = (p[:2], tangents[0], q[:2], tangents[1])
    xy, first, second = (
        sum(weight * point for weight, point in zip(weights, points, strict=True))
        for weights in (cubic, slope, bend)
    )
    assert isinstance(xy, np.ndarray) and isinstance(first, np.ndarray) and isinstance(second, np.ndarray)
    speed = np.hypot(first[:, 0], first[:, 1])
    if speed.min() < 0.05 * gap:
        return None
    curvature = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / speed**3
    if np.abs(curvature).max() > 1 / TIGHTEST:
        return None
    steps = np.diff(u[:, 0]) * (speed[:-1] + speed[1:]) / 2
    s = np.concatenate([[0.0], np.cumsum(steps)])
    share = s / s[-1]
    heading = np.unwrap(np.concatenate([[begin], np.arctan2(first[1:, 1], first[1:, 0])]))
    name = f"{before.id}~{after.id}"
    return Lane(
        id=name,
        road=name,
        number=before.number,
        type=before.type if before.type is after.type else LaneType.DRIVING,
        s=s,
        xyz=np.column_stack([xy, p[2] + share * (q[2] - p[2])]),
        heading=heading,
        curvature=curvature,
        width=before.width[-1] + share * (after.width[0] - before.width[-1]),
        road_s=s.copy(),
        speed_limit=min(before.speed_limit, after.speed_limit),
        access=before.access & after.access,
        successors=(after.id,),
        predecessors=(before.id,),
        junction=junction,
    )
