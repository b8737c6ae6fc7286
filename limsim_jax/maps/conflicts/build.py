"""A network to its `ConflictTable`."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from limsim_jax.maps.conflicts.overlaps import Overlap, connectors, find_overlaps
from limsim_jax.maps.conflicts.priority import Decision, RightOfWay, Rule, movement_groups, without_cycles
from limsim_jax.maps.conflicts.table import ABSENT, ConflictTable, ConflictType
from limsim_jax.maps.conflicts.waiting import hold_back, stretches_across, waiting_points
from limsim_jax.maps.network import Control, Network

VEHICLE_WIDTH = 2.0
"""Width (m) of the car for which swept paths are compared."""

MARGIN = 0.3
"""Free space (m) between two cars below which their paths conflict."""


def build_conflicts(
    network: Network,
    rows: Mapping[str, int],
    *,
    vehicle_width: float = VEHICLE_WIDTH,
    margin: float = MARGIN,
    break_cycles: bool = True,
) -> ConflictTable:
    """Find all conflicts of a network and their right of way.

    The comparison covers lanes of the same junction (of one road only those side by side), lanes
    anywhere that share a successor or a predecessor, and lanes that lie over each other without being of
    one junction (`strangers`). Outside junctions the 200 m next to the shared lane count. Lanes more than
    3.5 m apart in elevation pass over each other.

    Diverging paths need no priority, and paths that sweep are equal. For the others the first rule that
    distinguishes them decides:

    1. where a lane lies over one of another junction: on the way out of that before inside before into it;
    2. the file (`Movement.yields_to`); two movements that yield to each other are equal;
    3. control: priority before none or signal before yield, stop and all-way stop; zipper is equal;
    4. roundabouts: lanes that leave the ring or stay on it before lanes that enter. A ring is a
       closed path of at most 600 m that turns evenly once round;
    5. merging lanes: through lanes before entry, ramp and slip lanes;
    6. turns: straight before turning, U-turns last; of opposing turns the one to the near side first;
    7. lanes that merge at less than 45 degrees: the road with more lanes, then the faster one first;
    8. right before left (left before right with left-hand traffic) between 30 and 165 degrees.

    Signals set no priority: the rules hold between movements that are green together, and for all
    when the lights are off.

    Args:
        network: The map.
        rows: Row of every drivable lane (`lane_map.lane_rows`).
        vehicle_width: Width (m) of the vehicles whose swept paths are compared.
        margin: Free space (m) that they need between them.
        break_cycles: Make the connectors of a cycle equal where general rules order them, not the file
            or signs: right before left makes a cycle when four cars meet. `tie` keeps the rule.
            Without `break_cycles` the cycles stay in `prio`.
    """
    lanes = connectors(network)
    index = {lane.id: k for k, lane in enumerate(lanes)}
    overlaps = find_overlaps(lanes, vehicle_width, margin, network.lanes)
    right_of_way = RightOfWay(network, lanes)
    equal = Decision(0, Rule.NONE, 0)
    decisions = [equal if o.type is ConflictType.SWEEP else right_of_way.decide(o) for o in overlaps]
    movement = np.array([right_of_way.only_movement(k) for k in range(len(lanes))] + [-1], np.int32)
    prio = np.array([d.prio for d in decisions], int)
    tie = np.array([d.tie for d in decisions], int)
    if break_cycles:
        nodes = movement_groups(movement)
        ends = np.array([(o.first, o.second) for o in overlaps], int).reshape(-1, 2)
        prio = without_cycles(nodes[ends], prio, np.array([d.rule for d in decisions], int))

    entries: list[list[tuple[Overlap, int, int]]] = [[] for _ in lanes]
    for overlap, p, t in zip(overlaps, prio.tolist(), tie.tolist(), strict=True):
        t = 0 if p else t
        entries[overlap.first].append((overlap, p, t))
        entries[overlap.second].append((overlap.mirrored(), -p, -t))
    num, slots = len(lanes) + 1, max([0, *map(len, entries)])
    stretches = "s_in", "s_out", "f_in", "f_out"
    floats = {name: np.full((num, slots), ABSENT, np.float32) for name in (*stretches, "hold")}
    floats |= {name: np.zeros((num, slots), np.float32) for name in ("sweep", "f_sweep")}
    ints = {name: np.zeros((num, slots), np.int32) for name in ("foe", "type", "prio", "tie")}
    ints["foe"][:] = -1
    clear_s, cross_s = np.zeros(num, np.float32), np.zeros(num, np.float32)
    must_stop = np.zeros(num, bool)
    for way in network.movements:
        if way.via and way.via[0] in index:
            must_stop[index[way.via[0]]] |= way.control in (Control.STOP, Control.ALL_WAY_STOP)
    across = stretches_across(network, lanes, entries)
    for k, row in enumerate(entries):
        row.sort(key=lambda entry: (entry[0].s_in, entry[0].s_out, entry[0].second))
        for c, (overlap, p, t) in enumerate(row):
            for name in (*stretches, "sweep", "f_sweep"):
                floats[name][k, c] = getattr(overlap, name)
            floats["hold"][k, c] = hold_back(overlap.s_in, across[k])
            ints["foe"][k, c], ints["type"][k, c] = overlap.second, overlap.type
            ints["prio"][k, c], ints["tie"][k, c] = p, t
        met = [o.s_out for o, _, _ in row if o.type in (ConflictType.CROSS, ConflictType.MERGE)]
        clear_s[k] = max(met, default=0.0)
        cross_s[k] = max([o.s_out for o, _, _ in row if o.type is ConflictType.CROSS], default=0.0)

    connector = np.full(len(rows) + 1, -1, np.int32)
    for lane_id, k in index.items():
        connector[rows[lane_id]] = k
    return ConflictTable(
        lane=np.array([rows[lane.id] for lane in lanes] + [-1], np.int32),
        connector=connector,
        movement=movement,
        length=np.array([lane.length for lane in lanes] + [1.0], np.float32),
        wait_s=np.array([*waiting_points(network, lanes, entries, right_of_way), 0.0], np.float32),
        clear_s=clear_s,
        cross_s=cross_s,
        must_stop=must_stop,
        approach=np.array([*(right_of_way.paths(k)[0].approach for k in range(len(lanes))), 0.0], np.float32),
        **floats,
        **ints,
    )
