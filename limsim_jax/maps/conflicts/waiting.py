"""Where a vehicle can wait inside a junction."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from limsim_jax.maps.conflicts.overlaps import Overlap
from limsim_jax.maps.conflicts.priority import RightOfWay
from limsim_jax.maps.conflicts.table import ConflictType
from limsim_jax.maps.network import Lane, Movement, Network

CAR = 5.0
"""Length (m) of a car that waits inside a junction."""


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


def hold_back(place: float, row: Sequence[tuple[Overlap, int, int]]) -> float:
    """Where to wait before a place, out of the way of others.

    The last place (m) before it at which a car lies across no path that has priority over its own. Cars that
    wait in each other's way inside a junction would hold one another for good.

    Args:
        place: m along the connector.
        row: the conflicts of the connector, with their priority.
    """
    across = [(o.s_in, o.s_out) for o, prio, _ in row if prio < 0 and o.type is ConflictType.CROSS]
    while True:
        lower = min((begin for begin, end in across if begin < place and end > place - CAR), default=place)
        if lower == place:
            return place
        place = lower


def _opposed(movement: Movement, k: int, foes: Iterable[tuple[float, int]], right_of_way: RightOfWay) -> bool:
    """Whether a movement turns across opposing traffic that has priority."""
    own = next(path for path in right_of_way.paths(k) if path.movement is movement)
    return own.far_side and any(
        abs(math.remainder(path.approach - own.approach, math.tau)) > math.radians(120)
        for _, foe in foes
        for path in right_of_way.paths(foe)
    )
