"""Where paths across a junction meet, and who goes first: geometry and right of way, once per map.

Two lanes conflict where vehicles centred on them come too close: the distance between the centre
lines is below `vehicle_width + margin`. The stretch of both lanes where that holds, its kind (cross,
merge, diverge) and the priority between the two are rows of a `ConflictTable`, fixed-size arrays for
the device. Where that holds nowhere, but long bodies in bends would touch, they sweep: a row that matters
to those only. Everything here runs on the host in float64.
"""

from __future__ import annotations

import enum
import itertools
import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import flax.struct
import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy.ndimage import label
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial.distance import cdist

from limsim_jax.maps.network import Control, Lane, LaneType, Movement, Network, Turn

Array = np.ndarray | jax.Array
Floats = NDArray[np.float64]

VEHICLE_WIDTH = 2.0
"""Width (m) of the car for which swept paths are compared."""

MARGIN = 0.3
"""Free space (m) between two cars below which their paths conflict."""

CLEARANCE = 3.5
"""Difference of elevation (m) above which one lane passes over the other."""

ABSENT = 1e6
"""Arc length (m) of an entry that is not there: far ahead of everything."""

LONGEST = 12.0
"""Length (m) of the longest body whose sweep is looked at."""

_STEP = 0.25  # m, sampling of the centre lines
_REACH = 200.0  # m, how far from a merge or split outside junctions two lanes are compared
_STEP_ASIDE = 8.0  # m at the end of a lane that jumps aside to another one
_BEND = 5.0  # m, over which the curvature that bodies sweep by is averaged: that of a car
_TOUCH = 0.05  # m, a stretch that starts or ends this close to an end of its lane reaches it


class ConflictType(enum.IntEnum):
    """How two paths meet."""

    NONE = 0  # padding
    CROSS = 1
    MERGE = 2  # they end in the same lane
    DIVERGE = 3  # they start in the same lane
    SWEEP = 4  # only the ends of bodies in bends meet: of those that are long enough


@flax.struct.dataclass(kw_only=True)
class ConflictTable:
    """Conflicts of every connector, with all that is needed to decide who waits where.

    Rows are the `K - 1` connectors and, last, an inert null connector, so that -1 is a safe index:
    lanes inside junctions, and lanes elsewhere that share a successor or a predecessor with another.
    The `C` slots of a row hold its conflicts by ascending `s_in`; free slots have `foe` -1, type
    `NONE` and arc lengths `ABSENT`. Two lanes that meet in several separate stretches have several
    entries. Every entry has a mirror image in the row of its foe, with `prio` and `tie` negated.

    All arc lengths are in metres from the start of the lane that they belong to.
    """

    lane: Int[Array, " K"]  # lane row of each connector, -1 in the null row
    connector: Int[Array, " L"]  # connector of each lane row, -1 for other lanes and the null lane
    movement: Int[Array, " K"]  # the movement through the connector; -1 if there is none or several
    length: Float[Array, " K"]  # m
    wait_s: Float[Array, " K"]  # m from here along the movement, where to wait for foes inside; 0: nowhere
    clear_s: Float[Array, " K"]  # m, end of the last crossing or merging stretch; 0 without any
    cross_s: Float[Array, " K"]  # m, end of the last crossing stretch, to be kept clear; 0 without any
    must_stop: Bool[Array, " K"]  # begins at a stop sign
    foe: Int[Array, "K C"]  # connector
    s_in: Float[Array, "K C"]  # m, the stretch on the connector itself
    s_out: Float[Array, "K C"]
    f_in: Float[Array, "K C"]  # m, the stretch on the foe
    f_out: Float[Array, "K C"]
    type: Int[Array, "K C"]  # ConflictType
    prio: Int[Array, "K C"]  # +1 goes before the foe, 0 equal, -1 yields
    tie: Int[Array, "K C"]  # the same between equals that arrive together (right before left), else 0
    # 1/m^2: two bodies of lengths l and l_foe meet in a sweep where l^2 sweep + l_foe^2 f_sweep > 1
    sweep: Float[Array, "K C"]
    f_sweep: Float[Array, "K C"]

    def pad(self, *, lanes: int, connectors: int, foes: int) -> ConflictTable:
        """The same table with these numbers of rows (null rows included) and slots.

        Raises `ValueError` if the table does not fit.
        """

        def null_last(x: Array, rows: int, fill: float) -> np.ndarray:
            x = np.asarray(x)
            shape = (rows, *x.shape[1:2]) if x.ndim == 1 else (rows, foes)
            if rows < x.shape[0] or (x.ndim == 2 and foes < x.shape[1]):
                raise ValueError(f"table of shape {x.shape} does not fit into {shape}")
            out = np.full(shape, fill, x.dtype)
            out[tuple(slice(n) for n in (x.shape[0] - 1, *x.shape[1:]))] = x[:-1]
            return out

        fills = {"foe": -1, "lane": -1, "connector": -1, "movement": -1, "length": 1.0}
        fills |= dict.fromkeys(("s_in", "s_out", "f_in", "f_out"), ABSENT)
        return ConflictTable(
            **{
                name: null_last(x, lanes if name == "connector" else connectors, fills.get(name, 0))
                for name, x in vars(self).items()
            }
        )


@dataclass(frozen=True, kw_only=True)
class Overlap:
    """A stretch where the swept paths of two lanes overlap."""

    first: int  # connector
    second: int
    s_in: float  # m, on the first
    s_out: float
    f_in: float  # m, on the second
    f_out: float
    type: ConflictType
    sweep: float = 0.0  # 1/m^2, as in `ConflictTable`
    f_sweep: float = 0.0

    def mirrored(self) -> Overlap:
        """The same, seen from the second lane."""
        return Overlap(
            first=self.second,
            second=self.first,
            s_in=self.f_in,
            s_out=self.f_out,
            f_in=self.s_in,
            f_out=self.s_out,
            type=self.type,
            sweep=self.f_sweep,
            f_sweep=self.sweep,
        )


def connectors(network: Network) -> list[Lane]:
    """Lanes that have a row in the conflict table, in file order.

    The drivable lanes inside junctions, and those outside that share a successor or a predecessor
    with another drivable lane.
    """
    lanes = {lane.id: lane for lane in network.drivable_lanes()}
    shared = {
        lane.id
        for siblings in (*_sharing(lanes, "successors").values(), *_sharing(lanes, "predecessors").values())
        for lane in siblings
    }
    return [lane for lane in lanes.values() if lane.junction is not None or lane.id in shared]


def build_conflicts(
    network: Network,
    rows: Mapping[str, int],
    *,
    vehicle_width: float = VEHICLE_WIDTH,
    margin: float = MARGIN,
    break_cycles: bool = True,
) -> ConflictTable:
    """Find all conflicts of a network, and who goes first.

    Args:
        network: The map.
        rows: Row of every drivable lane (`lane_map.lane_rows`).
        vehicle_width: Width (m) of the vehicles whose swept paths are compared.
        margin: Free space (m) that they need between them.
        break_cycles: Make equal what general rules (not the file, not signs) order in a circle, as
            right before left does when four cars meet; `tie` keeps the rule. Without it, the circles
            stay in `prio`.

    Compared are lanes of the same junction, of one road only those side by side, and lanes anywhere that
    share a successor or a predecessor. Outside junctions the 200 m next to the shared lane count.
    Lanes more than 3.5 m apart in elevation pass over each other.

    Diverging paths need no priority, and those that sweep are equal. For the others the first rule that
    tells them apart decides:

    1. what the file says (`Movement.yields_to`); where both yield to each other they are equal;
    2. control: priority before none or signal before yield, stop and all-way stop; zipper is equal;
    3. roundabouts: lanes that leave the ring or stay on it before lanes that enter. A ring is a
       closed path of at most 600 m that turns evenly once round;
    4. merging lanes: through lanes before entry, ramp and slip lanes;
    5. turns: straight before turning, U-turns last; of opposing turns the one to the near side first;
    6. lanes that merge at less than 45 degrees: the road with more lanes, then the faster one first;
    7. right before left (left before right with left-hand traffic) between 30 and 165 degrees.

    Signals set no priority: the rules hold between movements that are green together, and for all
    when the lights are off.
    """
    lanes = connectors(network)
    index = {lane.id: k for k, lane in enumerate(lanes)}
    overlaps = find_overlaps(network, lanes, vehicle_width, margin)
    right_of_way = _RightOfWay(network, lanes)
    equal = _Decision(0, _Rule.NONE, 0)
    decisions = [equal if o.type is ConflictType.SWEEP else right_of_way.decide(o) for o in overlaps]
    movement = np.array([right_of_way.only_movement(k) for k in range(len(lanes))] + [-1], np.int32)
    prio = np.array([d.prio for d in decisions], int)
    tie = np.array([d.tie for d in decisions], int)
    if break_cycles:
        nodes = _nodes(movement)
        ends = np.array([(o.first, o.second) for o in overlaps], int).reshape(-1, 2)
        prio = _break_cycles(nodes[ends], prio, np.array([d.rule for d in decisions], int))

    entries: list[list[tuple[Overlap, int, int]]] = [[] for _ in lanes]
    for overlap, p, t in zip(overlaps, prio.tolist(), tie.tolist(), strict=True):
        t = 0 if p else t
        entries[overlap.first].append((overlap, p, t))
        entries[overlap.second].append((overlap.mirrored(), -p, -t))
    num, slots = len(lanes) + 1, max([0, *map(len, entries)])
    floats = {name: np.full((num, slots), ABSENT, np.float32) for name in ("s_in", "s_out", "f_in", "f_out")}
    floats |= {name: np.zeros((num, slots), np.float32) for name in ("sweep", "f_sweep")}
    ints = {name: np.zeros((num, slots), np.int32) for name in ("foe", "type", "prio", "tie")}
    ints["foe"][:] = -1
    clear_s, cross_s = np.zeros(num, np.float32), np.zeros(num, np.float32)
    must_stop = np.zeros(num, bool)
    for way in network.movements:
        if way.via and way.via[0] in index:
            must_stop[index[way.via[0]]] |= way.control in (Control.STOP, Control.ALL_WAY_STOP)
    for k, row in enumerate(entries):
        row.sort(key=lambda entry: (entry[0].s_in, entry[0].s_out, entry[0].second))
        for c, (overlap, p, t) in enumerate(row):
            for name in floats:
                floats[name][k, c] = getattr(overlap, name)
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
        wait_s=np.array([*_waiting_points(network, lanes, entries, right_of_way), 0.0], np.float32),
        clear_s=clear_s,
        cross_s=cross_s,
        must_stop=must_stop,
        **floats,
        **ints,
    )


def priority_cycles(table: ConflictTable) -> list[list[int]]:
    """Circles in which everyone yields to the next: a shortest one of every cyclic group.

    Each is a list of connectors of which every one yields to the one that follows, and the last to
    the first. An empty list means that somebody can always go. Consecutive connectors of the same
    movement count as one. Circles remain only where the file or signs set them.
    """
    foe, prio, movement = (np.asarray(x) for x in (table.foe, table.prio, table.movement))
    nodes = _nodes(movement)
    k, c = np.nonzero(prio < 0)
    member = {int(nodes[i]): int(i) for i in reversed(range(len(nodes) - 1))}
    graph = _graph(nodes[k], nodes[foe[k, c]], len(nodes))
    cycles = []
    for group in _cyclic_groups(graph):
        hops, before = dijkstra(graph[group][:, group], unweighted=True, return_predecessors=True)
        back = hops.T + np.where(graph[group][:, group].toarray() > 0, 1, np.inf)  # edge u -> v and back
        u, v = np.unravel_index(np.argmin(back), back.shape)
        path = [u]
        while path[-1] != v:
            path.append(before[v, path[-1]])
        cycles.append([member[int(group[i])] for i in reversed(path)])
    return cycles


def find_overlaps(network: Network, lanes: Sequence[Lane], width: float, margin: float) -> list[Overlap]:
    """All stretches where centre lines of `lanes` come closer than `width` and `margin` (m), each pair once.

    `first` and `second` are positions in `lanes`, first < second. Ends are exact to about 1 cm for
    paths that cross at more than 30 degrees; at flat angles the closeness itself is exact to 5 mm.
    """
    curves, reach = _Curves(lanes), width + margin
    regions = []
    for a, b in _candidates(lanes, curves, reach):
        regions.extend(curves.regions(a, b, reach))
    stretches = curves.refine(regions, reach)
    overlaps = [
        Overlap(
            first=curves.owner[region.a],
            second=curves.owner[region.b],
            s_in=s[0],
            s_out=s[1],
            f_in=s[2],
            f_out=s[3],
            type=ConflictType.NONE,
        )
        for region, s in zip(regions, stretches.tolist(), strict=True)
    ]
    found = _classify(network, lanes, overlaps)
    return [*found, *_merges_with_a_jump(lanes, found), *_sweeps(lanes, curves, overlaps, width)]


def _merges_with_a_jump(lanes: Sequence[Lane], overlaps: Sequence[Overlap]) -> Iterator[Overlap]:
    """Ends of lanes that lead to the same lane though they are too far apart for their paths to meet.

    Some files let a lane end beside another one and go on as it: vehicles step aside there.
    """
    index = {lane.id: k for k, lane in enumerate(lanes)}
    known = {(o.first, o.second) for o in overlaps if o.type is ConflictType.MERGE}
    for siblings in _sharing({lane.id: lane for lane in lanes}, "successors").values():
        for i, j in itertools.combinations(sorted(index[lane.id] for lane in siblings), 2):
            if (i, j) not in known:
                known.add((i, j))
                ends = [(max(0.0, lanes[k].length - _STEP_ASIDE), lanes[k].length) for k in (i, j)]
                yield Overlap(
                    first=i,
                    second=j,
                    s_in=ends[0][0],
                    s_out=ends[0][1],
                    f_in=ends[1][0],
                    f_out=ends[1][1],
                    type=ConflictType.MERGE,
                )


def _sweeps(
    lanes: Sequence[Lane], curves: _Curves, overlaps: Sequence[Overlap], width: float
) -> Iterator[Overlap]:
    """Lanes that keep clear of each other, but not of the ends of long bodies.

    In a bend of curvature kappa these stand out by kappa l^2 / 8, for bodies that lie on the lane at their
    centre, along it. Bodies of `LONGEST` meet while both centres are within the stretch: that much of it is
    left at its ends for fronts and rears.
    """
    known = {(o.first, o.second) for o in overlaps}
    most = math.pi / 8 * LONGEST  # m, two bodies together, each in a turn of 90 degrees
    for a, b in _candidates(lanes, curves, width + most):
        first, second = curves.owner[a], curves.owner[b]
        if (first, second) in known:
            continue
        distance = curves.distance(a, b)
        if distance.min() > width + most:
            continue
        towards = curves.xyz[b][None, :, :2] - curves.xyz[a][:, None, :2]
        towards /= np.maximum(distance, 1e-9)[..., None]
        out = np.maximum(np.einsum("pqi,pi->pq", towards, curves.sweep(a)), 0)
        out_foe = np.maximum(-np.einsum("pqi,qi->pq", towards, curves.sweep(b)), 0)
        room = np.maximum(distance - width, 1e-3)
        near = LONGEST**2 * (out + out_foe) > room
        if not near.any():
            continue
        p, q = np.nonzero(near)
        s_in, s_out = _between_ends(curves.s[a], p)
        f_in, f_out = _between_ends(curves.s[b], q)
        # where the shortest of equal bodies meet
        meet = np.unravel_index(np.argmax((out + out_foe) / room), room.shape)
        yield Overlap(
            first=first,
            second=second,
            s_in=s_in,
            s_out=s_out,
            f_in=f_in,
            f_out=f_out,
            type=ConflictType.SWEEP,
            sweep=float(out[meet] / room[meet]),
            f_sweep=float(out_foe[meet] / room[meet]),
        )


def _between_ends(s: Floats, meet: NDArray[np.intp]) -> tuple[float, float]:
    """Where fronts enter and rears leave, of bodies of `LONGEST` that meet with centres at these samples."""
    begin, end = float(s[meet.min()]), float(s[meet.max()])
    middle, half = (begin + end) / 2, max((end - begin - LONGEST) / 2, 0.5)
    return max(middle - half, float(s[0])), min(middle + half, float(s[-1]))


def _sharing(lanes: Mapping[str, Lane], links: str) -> dict[str, list[Lane]]:
    """Lanes by successor (or predecessor), where at least two share it."""
    groups: dict[str, list[Lane]] = defaultdict(list)
    for lane in lanes.values():
        for other in getattr(lane, links):
            groups[other].append(lane)
    return {other: members for other, members in groups.items() if len(members) > 1}


# --- geometry ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Region:
    """Samples p0..p1 of curve a and q0..q1 of curve b between which the distance is short."""

    a: int
    b: int
    p0: int
    p1: int
    q0: int
    q1: int


class _Curves:
    """Sampled centre lines: a whole connector, or the end of a lane outside junctions that matters."""

    def __init__(self, lanes: Sequence[Lane]) -> None:
        self.owner: list[int] = []
        self.s: list[Floats] = []
        self.xyz: list[Floats] = []
        self.head: dict[int, int] = {}  # connector -> curve with its start
        self.tail: dict[int, int] = {}  # connector -> curve with its end
        for k, lane in enumerate(lanes):
            if lane.junction is not None or lane.length <= 2 * _REACH:
                self.head[k] = self.tail[k] = self._add(k, lane, 0.0, lane.length)
            else:
                self.head[k] = self._add(k, lane, 0.0, _REACH)
                self.tail[k] = self._add(k, lane, lane.length - _REACH, lane.length)
        self.low = np.array([xyz.min(0) for xyz in self.xyz]).reshape(-1, 3)
        self.high = np.array([xyz.max(0) for xyz in self.xyz]).reshape(-1, 3)

    def _add(self, k: int, lane: Lane, start: float, end: float) -> int:
        s = np.linspace(start, end, max(2, math.ceil((end - start) / _STEP) + 1))
        self.owner.append(k)
        self.s.append(s)
        self.xyz.append(lane.pose(s)[0])
        return len(self.owner) - 1

    def boxes_meet(self, a: NDArray[np.int_], b: NDArray[np.int_], reach: float) -> Any:
        """Whether the bounding boxes of the curves come closer than `reach`, and `CLEARANCE` in z."""
        room = np.array([reach, reach, CLEARANCE])
        return ((self.low[a] <= self.high[b] + room) & (self.low[b] <= self.high[a] + room)).all(-1)

    def sweep(self, a: int) -> Floats:
        """kappa / 8 (1/m) to the outside of the bend, `[samples, 2]`: times l^2, how far ends stand out."""
        s, xy = self.s[a], self.xyz[a][:, :2]
        heading = np.unwrap(np.arctan2(*np.gradient(xy, axis=0).T[::-1]))
        bend = np.interp(s + _BEND / 2, s, heading) - np.interp(s - _BEND / 2, s, heading)
        return (bend / _BEND / 8)[:, None] * np.stack([np.sin(heading), -np.cos(heading)], -1)

    def regions(self, a: int, b: int, reach: float) -> list[_Region]:
        """Separate stretches where two curves are closer than `reach`."""
        near = self.distance(a, b) < reach
        p, q = np.flatnonzero(near.any(1)), np.flatnonzero(near.any(0))
        if not len(p):
            return []
        if p[-1] - p[0] + 1 == len(p) and q[-1] - q[0] + 1 == len(q):
            return [_Region(a, b, *map(int, (p[0], p[-1], q[0], q[-1])))]
        parts, count = cast("tuple[NDArray[np.int32], int]", label(near, structure=np.ones((3, 3))))
        found = []
        for part in range(1, count + 1):
            p, q = np.nonzero(parts == part)
            found.append(_Region(a, b, *map(int, (p.min(), p.max(), q.min(), q.max()))))
        return found

    def distance(self, a: int, b: int) -> Floats:
        """Distance in plan between all samples of two curves, infinite where one passes over."""
        distance = np.asarray(cdist(self.xyz[a][:, :2], self.xyz[b][:, :2]), np.float64)
        top, bottom = max(self.high[a, 2], self.high[b, 2]), min(self.low[a, 2], self.low[b, 2])
        if top - bottom > CLEARANCE:
            over = np.abs(self.xyz[a][:, None, 2] - self.xyz[b][None, :, 2]) > CLEARANCE
            distance[over] = np.inf
        return distance

    def refine(self, regions: Sequence[_Region], reach: float) -> Float[np.ndarray, "R 4"]:
        """s_in, s_out, f_in, f_out (m) of every region, interpolated between the samples.

        The distance of a sample from the other curve is taken to the chords next to its nearest
        sample within the region; between the last sample out and the first one in it is linear.
        """
        edges = [
            edge
            for r in regions
            for edge in (
                (r.a, r.p0, -1, r.b, r.q0, r.q1),
                (r.a, r.p1, +1, r.b, r.q0, r.q1),
                (r.b, r.q0, -1, r.a, r.p0, r.p1),
                (r.b, r.q1, +1, r.a, r.p0, r.p1),
            )
        ]
        if not edges:
            return np.empty((0, 4))
        start = np.cumsum([0, *map(len, self.s)])
        s, xyz = np.concatenate(self.s), np.concatenate(self.xyz)
        curve, inside, step, other, lo, hi = np.array(edges).T
        at_end = (inside + step < 0) | (inside + step >= np.diff(start)[curve])
        i = start[curve] + inside
        o = np.where(at_end, i, i + step)
        # Some samples more on both sides: what is nearest to the sample outside may lie just beyond.
        lo = start[other] + np.maximum(lo - 3, 0)
        hi = np.minimum(start[other] + hi + 3, start[other + 1] - 1)
        d_in, d_out = (_distance_to_curve(xyz, point, lo, hi) for point in (i, o))
        # Chords may be a little closer than samples: then the end lies beyond the sample outside. If
        # that is much too close, a bridge has ended the stretch.
        away = ~at_end & (d_out > d_in) & (d_out > reach - 0.01)
        u = np.clip((reach - d_in) / np.where(away, d_out - d_in, np.inf), 0.0, 2.0)
        ends = s[i] + u * (s[o] - s[i])
        return np.clip(ends, s[start[curve]], s[start[curve + 1] - 1]).reshape(-1, 4)


def _distance_to_curve(
    xyz: Floats, point: NDArray[np.int_], lo: NDArray[np.int_], hi: NDArray[np.int_]
) -> Floats:
    """Distance in plan from samples `point` to the polylines through the samples lo..hi."""
    xy = xyz[:, :2]
    count = hi - lo + 1
    first = np.cumsum(count) - count
    which = np.repeat(np.arange(len(point)), count)
    sample = np.arange(count.sum()) - first[which] + lo[which]
    to_sample = np.hypot(*(xy[sample] - xy[point[which]]).T)
    order = np.lexsort((to_sample, which))
    nearest = sample[order[first]]
    best = to_sample[order[first]]
    for a, b in ((np.maximum(nearest - 1, lo), nearest), (nearest, np.minimum(nearest + 1, hi))):
        along = xy[b] - xy[a]
        norm = np.maximum((along**2).sum(-1), 1e-12)
        u = np.clip(((xy[point] - xy[a]) * along).sum(-1) / norm, 0, 1)
        best = np.minimum(best, np.hypot(*(xy[a] + u[:, None] * along - xy[point]).T))
    return best


def _candidates(lanes: Sequence[Lane], curves: _Curves, reach: float) -> list[tuple[int, int]]:
    """Pairs of curves that may conflict."""
    index = {lane.id: k for k, lane in enumerate(lanes)}
    by_id = {lane.id: lane for lane in lanes}
    followers = [_followers(lane, by_id, reach) for lane in lanes]
    pairs: set[tuple[int, int]] = set()

    def add(i: int, j: int, curve: Mapping[int, int]) -> None:
        if lanes[j].id not in followers[i] and lanes[i].id not in followers[j]:
            a, b = sorted((curve[i], curve[j]))
            pairs.add((a, b))

    inside: dict[str, list[int]] = defaultdict(list)
    for k, lane in enumerate(lanes):
        if lane.junction is not None:
            inside[lane.junction].append(k)
    for members in inside.values():
        for i, j in itertools.combinations(members, 2):
            # Of one road only lanes side by side: the others follow each other, or are oncoming.
            if lanes[i].road != lanes[j].road or lanes[i].carriageway == lanes[j].carriageway:
                add(i, j, curves.head)
    for links, curve in (("successors", curves.tail), ("predecessors", curves.head)):
        for siblings in _sharing(by_id, links).values():
            for one, two in itertools.combinations(siblings, 2):
                add(index[one.id], index[two.id], curve)
    found = np.array(sorted(pairs), int).reshape(-1, 2)
    meet = curves.boxes_meet(found[:, 0], found[:, 1], reach)
    return [(int(a), int(b)) for a, b in found[meet]]


def _followers(lane: Lane, lanes: Mapping[str, Lane], reach: float) -> set[str]:
    """Lanes whose start is nearer than `reach` beyond the end of this one on the way ahead."""
    found: set[str] = set()
    todo = [(name, 0.0) for name in lane.successors]
    while todo:
        name, gap = todo.pop()
        if name in lanes and name not in found and gap < reach:
            found.add(name)
            todo.extend((after, gap + lanes[name].length) for after in lanes[name].successors)
    return found - {lane.id}


def _classify(network: Network, lanes: Sequence[Lane], overlaps: list[Overlap]) -> list[Overlap]:
    """Tell crossing, merging and diverging stretches apart.

    A stretch diverges if both lanes start there and come from the same lane, and merges if both end
    there and lead to the same lane (or end side by side, closer than vehicles can pass). Lanes of one
    road that come too close side by side merge there too: vehicles pass one behind the other. Where a
    movement runs over several lanes, the kind carries over from one of them to the next.
    """
    index = {lane.id: k for k, lane in enumerate(lanes)}
    ahead = [[index[x] for x in lane.successors if x in index] for lane in lanes]
    behind = [[index[x] for x in lane.predecessors if x in index] for lane in lanes]
    length = [lane.length for lane in lanes]

    def starts(k: int, s: float) -> bool:
        return s <= _TOUCH

    def ends(k: int, s: float) -> bool:
        return s >= length[k] - _TOUCH

    kinds: list[ConflictType] = []
    by_pair: dict[tuple[int, int], list[int]] = defaultdict(list)
    for n, o in enumerate(overlaps):
        i, j = lanes[o.first], lanes[o.second]
        parts = (
            set(i.predecessors) & set(j.predecessors) and starts(o.first, o.s_in) and starts(o.second, o.f_in)
        )
        joins = ends(o.first, o.s_out) and ends(o.second, o.f_out)
        if joins and (not parts or set(i.successors) & set(j.successors)):
            kinds.append(ConflictType.MERGE)
        else:
            beside = ConflictType.MERGE if i.carriageway == j.carriageway else ConflictType.CROSS
            kinds.append(ConflictType.DIVERGE if parts else beside)
        by_pair[o.first, o.second].append(n)

    def stretch(n: int, k: int) -> tuple[float, float]:
        o = overlaps[n]
        return (o.s_in, o.s_out) if o.first == k else (o.f_in, o.f_out)

    def between(i: int, j: int) -> list[int]:
        return by_pair.get((min(i, j), max(i, j)), [])

    # What diverges at the end of one lane still does so at the start of the next; merging likewise,
    # against the direction of travel.
    todo = [n for n, kind in enumerate(kinds) if kind is not ConflictType.CROSS]
    while todo:
        n = todo.pop()
        kind, pair = kinds[n], (overlaps[n].first, overlaps[n].second)
        if kind is ConflictType.DIVERGE:
            edge, reached, begun, neighbours = 1, ends, starts, ahead
        else:
            edge, reached, begun, neighbours = 0, starts, ends, behind
        for i, j in (pair, pair[::-1]):
            if not reached(i, stretch(n, i)[edge]):
                continue
            ours, theirs = neighbours[i], [j]
            if reached(j, stretch(n, j)[edge]):
                theirs = [j, *neighbours[j]]
            for i_next, j_next in itertools.product(ours, theirs):
                for m in between(i_next, j_next):
                    if kinds[m] is not ConflictType.CROSS or not begun(i_next, stretch(m, i_next)[1 - edge]):
                        continue
                    if j_next == j:
                        lo, hi = stretch(n, j)
                        goes_on = stretch(m, j)[0] <= hi + _TOUCH and stretch(m, j)[1] >= lo - _TOUCH
                    else:
                        goes_on = begun(j_next, stretch(m, j_next)[1 - edge])
                    if goes_on:
                        kinds[m] = kind
                        todo.append(m)

    def level(o: Overlap) -> Overlap:
        """Where one way goes on beside the other, the stretch begins (or ends) level on both.

        The end of the one is near a whole piece of the other: vehicles that follow each other through a
        merge or a split measure their gap from there.
        """
        i, j = lanes[o.first], lanes[o.second]
        diverges = o.type is ConflictType.DIVERGE
        links = "predecessors" if diverges else "successors"
        if o.type is ConflictType.CROSS or set(getattr(i, links)) & set(getattr(j, links)):
            return o
        edge, s, f = (0, "s_in", "f_in") if diverges else (-1, "s_out", "f_out")
        at_s = _closest(i, o.s_in, o.s_out, j.xyz[edge])
        at_f = _closest(j, o.f_in, o.f_out, i.xyz[edge])
        if abs(at_s - getattr(o, s)) > abs(at_f - getattr(o, f)):
            return replace(o, **{s: at_s})
        return replace(o, **{f: at_f})

    found = [replace(o, type=kind) for o, kind in zip(overlaps, kinds, strict=True)]
    return [level(o) for o in found]


def _closest(lane: Lane, start: float, end: float, point: Floats) -> float:
    """Arc length (m) between `start` and `end` at which a lane comes closest to a point."""
    s = np.linspace(start, end, max(2, math.ceil((end - start) / 0.05) + 1))
    return float(s[np.argmin(np.hypot(*(lane.pose(s)[0][:, :2] - point[:2]).T))])


# --- right of way -----------------------------------------------------------------------------


class _Rule(enum.IntEnum):
    """Rules of right of way, the weakest first: circles are broken in this order, up to `RING`."""

    NONE = 0
    SIDE = 1
    ROAD = 2
    TURN = 3
    RAMP = 4
    RING = 5
    CONTROL = 6
    FILE = 7


@dataclass(frozen=True)
class _Decision:
    prio: int
    rule: _Rule
    tie: int


_CONTROL_RANK = {
    Control.PRIORITY: 2,
    Control.NONE: 1,
    Control.SIGNAL: 1,
    Control.ZIPPER: 1,
    Control.YIELD: 0,
    Control.STOP: 0,
    Control.ALL_WAY_STOP: 0,
}
_RAMPS = frozenset(
    {LaneType.ENTRY, LaneType.ON_RAMP, LaneType.CONNECTING_RAMP, LaneType.SLIP_LANE, LaneType.OFF_RAMP}
)
_LEFT, _RIGHT = (Turn.LEFT, Turn.SLIGHT_LEFT), (Turn.RIGHT, Turn.SLIGHT_RIGHT)


@dataclass(frozen=True)
class _Path:
    """One way over a connector: a movement, or the connector alone where no movement has it."""

    movement: Movement | None
    approach: float  # rad, heading with which it comes in
    turn: Turn
    control: Control
    ramp: bool
    size: tuple[int, float]  # lanes and speed limit (m/s) of the road it comes from
    left_hand: bool

    @property
    def near_side(self) -> bool:
        """Whether it turns without crossing the opposite direction."""
        return self.turn in (_LEFT if self.left_hand else _RIGHT)

    @property
    def far_side(self) -> bool:
        """Whether it turns across the opposite direction."""
        return self.turn in (_RIGHT if self.left_hand else _LEFT)


class _RightOfWay:
    """Who goes first where paths meet."""

    def __init__(self, network: Network, lanes: Sequence[Lane]) -> None:
        self.network, self.lanes = network, lanes
        self.through: dict[str, list[Movement]] = defaultdict(list)
        self.direct: dict[str, list[Movement]] = defaultdict(list)  # movements without a lane of their own
        for movement in network.movements:
            for name in dict.fromkeys(movement.via):
                self.through[name].append(movement)
            if not movement.via:
                self.direct[movement.incoming].append(movement)
        self.road_lanes = Counter(lane.carriageway for lane in network.drivable_lanes())
        on_ring = ring_lanes(network, lanes)
        self.from_ring = [bool(on_ring & {lane.id, *lane.predecessors}) for lane in lanes]
        self._paths: dict[int, list[_Path]] = {}

    def only_movement(self, k: int) -> int:
        """Index of the movement over a connector if it is the only one, else -1."""
        movements = self.through[self.lanes[k].id]
        return movements[0].index if len(movements) == 1 else -1

    def paths(self, k: int) -> list[_Path]:
        """All ways over a connector."""
        if k not in self._paths:
            lane = self.lanes[k]
            movements = self.through[lane.id] or self.direct[lane.id]
            self._paths[k] = [self._path(lane, movement) for movement in movements or [None]]
        return self._paths[k]

    def _path(self, lane: Lane, movement: Movement | None) -> _Path:
        lanes, road = self.network.lanes, self.network.roads.get(lane.road)
        if movement is not None:
            turn, source = movement.turn, lanes[movement.incoming]
        elif lane.junction is not None:
            turn = _turn(float(lane.heading[-1] - lane.heading[0]))
            source = lanes[lane.predecessors[0]] if lane.predecessors else lane
        else:
            turn, source = Turn.STRAIGHT, lane
        from_start = source is lane and lane.junction is not None
        return _Path(
            movement=movement,
            approach=float(source.heading[0 if from_start else -1]),
            turn=turn,
            control=movement.control if movement is not None else Control.NONE,
            ramp=source.type in _RAMPS or lane.type in _RAMPS,
            size=(self.road_lanes[source.carriageway], source.speed_limit),
            left_hand=road.left_hand if road is not None else False,
        )

    def decide(self, overlap: Overlap) -> _Decision:
        """Who goes first in this stretch, seen from its first lane, and by which rule.

        Where several movements run over a lane, the strongest rule between any two of them counts.
        """
        if overlap.type is ConflictType.DIVERGE:
            return _Decision(0, _Rule.NONE, 0)
        i, j = overlap.first, overlap.second
        found = [
            self._between(one, two, overlap) for one, two in itertools.product(self.paths(i), self.paths(j))
        ]
        strongest = max(decision.rule for decision in found)
        found = [decision for decision in found if decision.rule is strongest]
        return _Decision(_sign(sum(d.prio for d in found)), strongest, _sign(sum(d.tie for d in found)))

    def _between(self, one: _Path, two: _Path, overlap: Overlap) -> _Decision:
        turned = math.remainder(two.approach - one.approach, 2 * math.pi)  # > 0: two comes from the right
        side = 0
        if math.radians(30) < abs(turned) < math.radians(165):
            side = -1 if (turned > 0) != one.left_hand else 1
        if one.movement is not None and two.movement is not None:
            yields = two.movement.index in one.movement.yields_to
            foe_yields = one.movement.index in two.movement.yields_to
            if yields or foe_yields:
                return _Decision(foe_yields - yields, _Rule.FILE, side)
        if one.control is two.control is Control.ZIPPER:
            return _Decision(0, _Rule.CONTROL, 0)
        if one.control is two.control is Control.ALL_WAY_STOP:
            return _Decision(0, _Rule.CONTROL, side)
        merges = overlap.type is ConflictType.MERGE
        flat = merges and abs(turned) < math.radians(45)
        opposing = abs(turned) > math.radians(120)
        comparisons = (
            (_Rule.CONTROL, _CONTROL_RANK[one.control] - _CONTROL_RANK[two.control]),
            (_Rule.RING, self.from_ring[overlap.first] - self.from_ring[overlap.second]),
            (_Rule.RAMP, (two.ramp - one.ramp) if merges else 0),
            (_Rule.TURN, _turn_rank(one, opposing) - _turn_rank(two, opposing)),
            (_Rule.ROAD, (one.size > two.size) - (one.size < two.size) if flat else 0),
            (_Rule.SIDE, side),
        )
        for rule, difference in comparisons:
            if difference:
                return _Decision(_sign(difference), rule, side)
        return _Decision(0, _Rule.NONE, side)


def _sign(x: int) -> int:
    return (x > 0) - (x < 0)


def _turn(angle: float) -> Turn:
    """Turn of a connector that no movement describes, from its change of heading (rad)."""
    if abs(angle) < math.radians(30):
        return Turn.STRAIGHT
    if abs(angle) > math.radians(150):
        return Turn.U_TURN
    return Turn.LEFT if angle > 0 else Turn.RIGHT


def _turn_rank(path: _Path, opposing: bool) -> int:
    if path.turn is Turn.STRAIGHT:
        return 3
    if path.turn is Turn.U_TURN:
        return 0
    return 2 if opposing and path.near_side else 1


def ring_lanes(
    network: Network, lanes: Sequence[Lane], *, longest: float = 600.0, uneven: float = 0.35
) -> set[str]:
    """Ids of the lanes that circulate in a roundabout, as far as they lie on a ring with one of `lanes`.

    The shortest way from such a lane back to itself must be at most `longest` (m), turn once to the left
    (to the right with left-hand traffic), and its heading must stay within `uneven` (rad) of that on a
    circle. Roundabouts stay below 0.15; a square with sharp corners is off by pi/4, an octagon by pi/8.
    """
    everything = list(network.drivable_lanes())
    row = {lane.id: i for i, lane in enumerate(everything)}
    links = [(row[x.id], row[y]) for x in everything for y in x.successors if y in row]
    if not links or not lanes:
        return set()
    tail, head = np.array(links).T
    length = np.array([lane.length for lane in everything])
    graph = csr_array((np.maximum(length[tail], 1e-3), (tail, head)), shape=(len(row), len(row)))
    incoming = graph.tocsc()
    courses: dict[int, tuple[Floats, Floats]] = {}

    def course(i: int) -> tuple[Floats, Floats]:
        """A few arc lengths along a lane and its headings there."""
        if i not in courses:
            s = np.linspace(0, length[i], 9)
            courses[i] = s, np.interp(s, everything[i].s, everything[i].heading)
        return courses[i]

    found: set[str] = set()
    wanted = np.array([row[lane.id] for lane in lanes])
    for block in np.array_split(wanted, math.ceil(len(wanted) / 256)):
        distance, before = dijkstra(graph, indices=block, limit=longest, return_predecessors=True)
        for n, i in enumerate(block):
            last = incoming.indices[incoming.indptr[i] : incoming.indptr[i + 1]]
            if everything[i].id in found or not len(last):
                continue
            around = distance[n, last] + length[last]
            if not around.min() <= longest:
                continue
            cycle = [int(last[np.argmin(around)])]
            while cycle[-1] != i:
                cycle.append(int(before[n, cycle[-1]]))
            cycle.reverse()
            road = network.roads.get(everything[i].road)
            direction = -1 if road is not None and road.left_hand else 1
            if _turns_evenly([course(c) for c in cycle], direction, uneven):
                found.update(everything[c].id for c in cycle)
    return found


def _turns_evenly(courses: Iterable[tuple[Floats, Floats]], direction: int, uneven: float) -> bool:
    """Whether a closed path turns once round, at an even rate."""
    at, headings, base = [], [], 0.0
    for s, heading in courses:
        if headings:  # lanes join without full turns
            gap = heading[0] - headings[-1][-1]
            heading = heading + math.remainder(gap, math.tau) - gap
        at.append(s + base)
        headings.append(heading)
        base += s[-1]
    heading = np.concatenate(headings) * direction
    total = heading[-1] - heading[0]
    total += math.remainder(heading[0] - heading[-1], math.tau)
    deviation = heading - math.tau * np.concatenate(at) / base
    return bool(abs(total - math.tau) < 0.1 and np.ptp(deviation) < 2 * uneven)


def _nodes(movement: NDArray[np.int32]) -> NDArray[np.int_]:
    """A number per connector that those of one movement share."""
    alone = np.arange(len(movement)) + movement.max(initial=0) + 1
    return np.unique(np.where(movement < 0, alone, movement), return_inverse=True)[1]


def _graph(tail: NDArray[Any], head: NDArray[Any], size: int) -> csr_array:
    return csr_array((np.ones(len(tail)), (tail, head)), shape=(size, size))


def _cyclic_groups(graph: csr_array) -> Iterator[NDArray[np.int_]]:
    """Strongly connected components of more than one node."""
    count, group = connected_components(graph, connection="strong")
    sizes = np.bincount(group, minlength=count)
    for g in np.flatnonzero(sizes > 1):
        yield np.flatnonzero(group == g)


def _break_cycles(ends: NDArray[np.int_], prio: NDArray[np.int_], rule: NDArray[np.int_]) -> NDArray[np.int_]:
    """Make equal what lies on a circle, the weakest rule first; signs and the file are left alone."""
    prio = prio.copy()
    size = int(ends.max(initial=0)) + 1
    for weakest in (_Rule.SIDE, _Rule.ROAD, _Rule.TURN, _Rule.RAMP, _Rule.RING):
        yields = np.where(prio[:, None] < 0, ends, ends[:, ::-1])[prio != 0]
        group = connected_components(_graph(yields[:, 0], yields[:, 1], size), connection="strong")[1]
        prio[(rule == weakest) & (group[ends[:, 0]] == group[ends[:, 1]])] = 0
    return prio


# --- where to wait ----------------------------------------------------------------------------


def _waiting_points(
    network: Network,
    lanes: Sequence[Lane],
    entries: Sequence[Sequence[tuple[Overlap, int, int]]],
    right_of_way: _RightOfWay,
    *,
    before: float = 1.0,
    at_least: float = 6.0,
) -> list[float]:
    """Where traffic may wait inside the junction: arc length (m) from each connector, 0 for nowhere.

    The point lies 1 m before the first conflict with a foe that goes first, and at least 6 m into the
    junction. It exists for movements that the file lets wait inside; where the file does not speak of
    this at all, for turns across opposing traffic.
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


def _opposed(
    movement: Movement, k: int, foes: Iterable[tuple[float, int]], right_of_way: _RightOfWay
) -> bool:
    """Whether a movement turns across traffic from the opposite side that goes first."""
    own = next(path for path in right_of_way.paths(k) if path.movement is movement)
    return own.far_side and any(
        abs(math.remainder(path.approach - own.approach, math.tau)) > math.radians(120)
        for _, foe in foes
        for path in right_of_way.paths(foe)
    )
