"""Where a vehicle can wait inside a junction."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps.conflicts.overlaps import Overlap, lanes_within
from limsim_jax.maps.conflicts.priority import RightOfWay
from limsim_jax.maps.conflicts.table import ConflictTable, ConflictType
from limsim_jax.maps.network import Lane, Movement, Network

CAR = 5.0
"""Length (m) of a car that waits inside a junction."""

FARTHEST = 20.0
"""How far (m) before the end of its lane traffic waits at most, out of the way of another junction."""


def waiting_points(
    network: Network,
    lanes: Sequence[Lane],
    entries: Sequence[Sequence[tuple[Overlap, int, int]]],
    right_of_way: RightOfWay,
    *,
    before: float = 1.0,
    at_least: float = 6.0,
) -> list[float]:
    """Where traffic can wait inside the junction.

    The point lies `before` m ahead of the first conflict with a foe that has priority, and no less than
    `at_least` m into the junction. The file names the movements that have one. In a file that names none,
    every turn across opposing traffic has one.

    Returns:
        Arc length (m) from the start of each connector, 0 for nowhere.
    """
    index = {lane.id: k for k, lane in enumerate(lanes)}
    waiting = [0.0] * len(lanes)
    told = any(movement.waits_inside for movement in network.movements)
    for movement in network.movements:
        chain = [index[name] for name in movement.via if name in index]
        if len(chain) != len(movement.via) or not chain:
            continue
        offsets = np.cumsum([0.0, *(lanes[k].length for k in chain)])
        foes = [
            (offset + o.s_in, o.second)
            for k, offset in zip(chain, offsets, strict=False)
            for o, prio, _ in entries[k]
            if prio < 0
        ]
        waits = movement.waits_inside or (not told and _opposed(movement, chain[0], foes, right_of_way))
        point = min((s for s, _ in foes), default=0.0) - before
        if waits and point >= at_least:
            for k, offset in zip(chain, offsets, strict=False):
                if point > offset:
                    waiting[k] = float(point - offset)
    return waiting


def hold_back(place: float, across: Sequence[tuple[float, float]]) -> float:
    """Where to wait before a place, out of the way of others.

    The last place (m) before it at which a car lies across no path that has priority over its own. Cars that
    wait in each other's way inside a junction would hold one another for good.

    Args:
        place: m along the connector.
        across: begin and end (m) of those paths, from `stretches_across`.
    """
    while True:
        lower = min((begin for begin, end in across if begin < place and end > place - CAR), default=place)
        if lower == place:
            return place
        place = lower


def stretches_across(
    network: Network, lanes: Sequence[Lane], entries: Sequence[Sequence[tuple[Overlap, int, int]]]
) -> list[list[tuple[float, float]]]:
    """Of every connector where it crosses paths with priority: begin and end, m from its start.

    A way through a junction may have several pieces. What the pieces before have is below 0; where several
    lead to a connector, only what it has itself counts.
    """
    index = {lane.id: k for k, lane in enumerate(lanes)}
    own = [
        [(o.s_in, o.s_out) for o, prio, _ in row if prio < 0 and o.type is ConflictType.CROSS]
        for row in entries
    ]
    found = []
    for lane, mine in zip(lanes, own, strict=True):
        both, at, start = list(mine), lane, 0.0
        while len(at.predecessors) == 1 and start > -CAR and at.predecessors[0] in index:
            at = network.lanes[at.predecessors[0]]
            start -= at.length
            both += [(start + begin, start + end) for begin, end in own[index[at.id]]]
        found.append(both)
    return found


def stand_back(
    network: Network, rows: Mapping[str, int], table: ConflictTable, stop_s: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How far before the stop lines traffic waits.

    A lane that leads into a junction may lie over a path of that junction. A car that waits at its line would
    stand in the way of those that it waits for, so it waits before that path.

    Args:
        network: the map.
        rows: row of every drivable lane.
        table: the conflicts of the map.
        stop_s: the stop line of every lane (m).

    Returns:
        m for every row of `rows`; 0 where the line itself is clear, or where that would be too far away.
    """
    back = np.zeros(len(rows))
    lanes = list(network.drivable_lanes())
    junction = np.array([lanes[row].junction or "" for row in table.lane[:-1]] + [""])
    foreign = (table.type == ConflictType.CROSS) & (table.prio < 0)
    foreign &= (junction[table.foe] != junction[:, None]) & (junction[table.foe] != "")
    across: dict[str, list[tuple[str, float, float]]] = {}
    for k, c in zip(*np.nonzero(foreign), strict=True):
        stretch = str(junction[table.foe[k, c]]), float(table.s_in[k, c]), float(table.s_out[k, c])
        across.setdefault(lanes[table.lane[k]].id, []).append(stretch)
    if not across:
        return back
    for lane in lanes:
        into = {network.lanes[name].junction for name in lane.successors if name in rows}
        into -= {lane.junction, None}
        line = lane.length - float(stop_s[rows[lane.id]])
        before = lanes_within(lane, network.lanes, FARTHEST - lane.length, "predecessors")
        ends = {lane.id: lane.length}  # m from the start of a lane to the end of this one
        ends |= {name: lane.length + gap + network.lanes[name].length for name, gap in before.items()}
        stretches = [
            (end - s_out, end - s_in)
            for name, end in ends.items()
            for other, s_in, s_out in across.get(name, ())
            if other in into
        ]
        place = line
        while further := [far for near, far in stretches if near < place + CAR and far > place]:
            place = max(further)
        if place <= FARTHEST:
            back[rows[lane.id]] = place - line
    return back


def _opposed(movement: Movement, k: int, foes: Iterable[tuple[float, int]], right_of_way: RightOfWay) -> bool:
    """Whether a movement turns across opposing traffic that has priority."""
    own = next(path for path in right_of_way.paths(k) if path.movement is movement)
    return own.far_side and any(
        abs(math.remainder(path.approach - own.approach, math.tau)) > math.radians(120)
        for _, foe in foes
        for path in right_of_way.paths(foe)
    )
