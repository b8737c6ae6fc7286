"""Stretches of two lanes on which vehicles would touch.

Such a stretch crosses, merges or diverges. Two lanes may also keep clear of each other while the ends of
long bodies in bends touch: these sweep, which is a conflict of long bodies alone.
"""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.ndimage import label
from scipy.spatial.distance import cdist
from shapely import LineString, STRtree

from limsim_jax.maps.conflicts.table import ConflictType
from limsim_jax.maps.network import Lane, Network

Floats = NDArray[np.float64]

CLEARANCE = 3.5
"""Difference of elevation (m) above which one lane passes over the other."""

LONGEST = 12.0
"""Length (m) of the longest body that sweeps."""

SHARPEST = 1.9
"""Turn (rad) within `_BEND` above which a body swings round on the spot: a U-turn of 2.6 m radius."""

TOUCHING = 1.7
"""Distance (m) of centre lines below which cars of 1.8 m touch, for lanes that no junction joins."""

_SWING = 1.8  # m, by which the corners of a car stand out more when it turns on the spot than along its way
_KINK = 1.2  # rad, turn within `_SPOT`, also into the next lane, above which the ends of a body swing out ...
_SPOT = 1.0  # m
_KINK_SWING = 1.0  # m: ... as far as this
_STEP = 0.25  # m, sampling of the centre lines
_BESIDE = 5.0  # m, centre lines of lanes that end side by side
_REACH = 200.0  # m, from a merge or split outside junctions, on which two lanes are compared
_FRINGE = 25.0  # m at both ends of a lane outside junctions that may belong to a junction
_STEP_ASIDE = 8.0  # m at the end of a lane that jumps aside to another one
_BEND = 5.0  # m, over which curvature is averaged for sweeps: the length of a car
_TOUCH = 0.05  # m, a stretch that starts or ends this close to an end of its lane reaches it


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

    The drivable lanes inside junctions, those outside that share a successor or a predecessor
    with another drivable lane, and those over which a junction lies that is not theirs (`strangers`).
    """
    lanes = {lane.id: lane for lane in network.drivable_lanes()}
    shared = {
        lane.id
        for siblings in (*sharing(lanes, "successors").values(), *sharing(lanes, "predecessors").values())
        for lane in siblings
    }
    shared |= {name for pair in strangers(lanes.values()) for name in pair}
    return [lane for lane in lanes.values() if lane.junction is not None or lane.id in shared]


def strangers(lanes: Iterable[Lane], reach: float = TOUCHING) -> set[tuple[str, str]]:
    """Lanes that lie over each other without being of one junction.

    Junctions that are too near to each other, or drawn too wide, lie over lanes of others. Of a lane outside
    junctions only the `_FRINGE` at both ends counts: a road may cross a junction on a bridge, and many files
    give no height.

    Args:
        lanes: All lanes of a network.
        reach: Distance (m) of centre lines below which vehicles touch.

    Returns:
        Ids of both, each pair once. Lanes of roads that follow each other, or of the same junction or
        road, are no strangers.
    """
    by_id = {lane.id: lane for lane in lanes if lane.drivable}
    every = list(by_id.values())
    if not every:
        return set()
    lines = [LineString(lane.xyz[:, :2]) for lane in every]
    near = STRtree(lines).query(lines, "dwithin", reach)
    joined: dict[tuple[str, int, bool], set[tuple[str, int, bool]]] = defaultdict(set)  # carriageways
    for lane in every:
        for other in lanes_within(lane, by_id, 2 * reach):  # a path that bends comes closer than its length
            after = by_id[other].carriageway
            joined[lane.carriageway].add(after)
            joined[after].add(lane.carriageway)
    found: set[tuple[str, str]] = set()
    for a, b in near.T[near[0] < near[1]].tolist():
        one, two = every[a], every[b]
        if one.road == two.road or (one.junction is not None and one.junction == two.junction):
            continue
        if two.carriageway not in joined[one.carriageway] and _touch(one, two, reach):
            found.add((one.id, two.id))
    return found


def _touch(one: Lane, two: Lane, reach: float) -> bool:
    """Whether parts that count come closer than `reach` (m)."""
    p, q = (_part(lane) for lane in (one, two))
    close = cdist(p[:, :2], q[:, :2]) < reach
    return bool((close & (np.abs(p[:, None, 2] - q[None, :, 2]) <= CLEARANCE)).any())


def _part(lane: Lane) -> Floats:
    """Points of a lane that count, `[samples, 3]`."""
    s = np.linspace(0, lane.length, max(2, math.ceil(lane.length / _STEP) + 1))
    if lane.junction is None:
        s = s[(s < _FRINGE) | (s > lane.length - _FRINGE)]
    return lane.pose(s)[0]


def find_overlaps(
    lanes: Sequence[Lane], width: float, margin: float, network: Mapping[str, Lane] | None = None
) -> list[Overlap]:
    """All stretches on which two of these lanes come too close.

    Ends are exact to about 1 cm for paths that cross at more than 30 degrees. At flat angles the
    distance itself is exact to 5 mm.

    Args:
        lanes: The lanes to compare, see `connectors`.
        width: Width of vehicles, m.
        margin: Free space that they need between them, m.
        network: Lanes before and after these, by id: kinks between lanes count if they are known.

    Returns:
        Overlaps, each once; `first` and `second` are positions in `lanes`, first < second.
    """
    curves, reach = _Curves(lanes), width + margin
    regions = []
    around = {lane.id: lane for lane in lanes} if network is None else network
    strange = strangers(around.values())
    swing = [_swing(curves, a, lanes[k], around) for a, k in enumerate(curves.owner)]
    for a, b in _candidates(lanes, curves, reach + max(swing, default=0.0), strange):
        regions.extend(curves.regions(a, b, reach + max(swing[a], swing[b])))
    stretches = curves.refine(regions)
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
    found = _classify(lanes, overlaps)
    return [*found, *_merges_with_a_jump(lanes, found), *_sweeps(lanes, curves, overlaps, width, strange)]


def _swing(curves: _Curves, a: int, lane: Lane, network: Mapping[str, Lane]) -> float:
    """How far (m) a car turned on the spot stands out.

    0 where it turns along its way."""
    if curves.sharpest(a, _BEND) > SHARPEST:
        return _SWING
    ahead = [network[name].heading[0] - lane.heading[-1] for name in lane.successors if name in network]
    behind = [lane.heading[0] - network[name].heading[-1] for name in lane.predecessors if name in network]
    kinks = [abs(math.remainder(turn, 2 * math.pi)) for turn in (*ahead, *behind)]
    return _KINK_SWING if max([curves.sharpest(a, _SPOT), *kinks]) > _KINK else 0.0


def _merges_with_a_jump(lanes: Sequence[Lane], overlaps: Sequence[Overlap]) -> Iterator[Overlap]:
    """Merges of lanes that do not come close to each other.

    In some files a lane ends beside another one and continues as that one: vehicles step aside there.
    """
    index = {lane.id: k for k, lane in enumerate(lanes)}
    known = {(o.first, o.second) for o in overlaps if o.type is ConflictType.MERGE}
    for siblings in sharing({lane.id: lane for lane in lanes}, "successors").values():
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
    lanes: Sequence[Lane],
    curves: _Curves,
    overlaps: Sequence[Overlap],
    width: float,
    strange: Collection[tuple[str, str]],
) -> Iterator[Overlap]:
    """Stretches on which only the ends of long bodies meet.

    A body of length l that lies on the lane at its centre, along the lane, stands out by kappa l^2 / 8 in
    a bend of curvature kappa. Bodies of `LONGEST` meet while both centres are within the stretch.
    `_between_ends` turns these centres into the stretch of fronts and rears.
    """
    known = {(o.first, o.second) for o in overlaps}
    most = math.pi / 8 * LONGEST  # m, two bodies together, each in a turn of 90 degrees
    for a, b in _candidates(lanes, curves, width + most, strange):
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
        # where the shortest two bodies of equal length meet
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
    """Where fronts enter a sweep, and rears leave it (m).

    `meet` are the samples at which the centre of a body of `LONGEST` is while it touches the other.
    """
    begin, end = float(s[meet.min()]), float(s[meet.max()])
    middle, half = (begin + end) / 2, max((end - begin - LONGEST) / 2, 0.5)
    return max(middle - half, float(s[0])), min(middle + half, float(s[-1]))


def sharing(lanes: Mapping[str, Lane], links: str) -> dict[str, list[Lane]]:
    """Lanes by successor (or predecessor), where at least two share it."""
    groups: dict[str, list[Lane]] = defaultdict(list)
    for lane in lanes.values():
        for other in getattr(lane, links):
            groups[other].append(lane)
    return {other: members for other, members in groups.items() if len(members) > 1}


@dataclass(frozen=True)
class _Region:
    """Samples of two curves that are close: p0..p1 of a and q0..q1 of b."""

    a: int
    b: int
    p0: int
    p1: int
    q0: int
    q1: int
    reach: float  # m


class _Curves:
    """Sampled centre lines: a whole connector, or the end of a lane outside junctions that matters."""

    def __init__(self, lanes: Sequence[Lane]) -> None:
        self.owner: list[int] = []
        self.s: list[Floats] = []
        self.xyz: list[Floats] = []
        self.direction: list[Floats] = []  # rad
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
        xyz, heading = lane.pose(s)
        self.xyz.append(xyz)
        self.direction.append(np.unwrap(heading))
        return len(self.owner) - 1

    def boxes_meet(self, a: NDArray[np.int_], b: NDArray[np.int_], reach: float) -> Any:
        """Whether bounding boxes come closer than `reach` (m).

        In height they come closer than `CLEARANCE`.
        """
        room = np.array([reach, reach, CLEARANCE])
        return ((self.low[a] <= self.high[b] + room) & (self.low[b] <= self.high[a] + room)).all(-1)

    def sweep(self, a: int) -> Floats:
        """kappa / 8 (1/m) towards the outside of the bend, `[samples, 2]`.

        Times l^2 it is how far the ends of a body of length l stand out.
        """
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
            return [_Region(a, b, int(p[0]), int(p[-1]), int(q[0]), int(q[-1]), reach)]
        parts, count = cast("tuple[NDArray[np.int32], int]", label(near, structure=np.ones((3, 3))))
        found = []
        for part in range(1, count + 1):
            p, q = np.nonzero(parts == part)
            found.append(_Region(a, b, int(p.min()), int(p.max()), int(q.min()), int(q.max()), reach))
        return found

    def distance(self, a: int, b: int) -> Floats:
        """Distance in plan between all samples of two curves, m.

        It is infinite where one curve passes over the other.
        """
        distance = np.asarray(cdist(self.xyz[a][:, :2], self.xyz[b][:, :2]), np.float64)
        top, bottom = max(self.high[a, 2], self.high[b, 2]), min(self.low[a, 2], self.low[b, 2])
        if top - bottom > CLEARANCE:
            over = np.abs(self.xyz[a][:, None, 2] - self.xyz[b][None, :, 2]) > CLEARANCE
            distance[over] = np.inf
        return distance

    def sharpest(self, a: int, within: float) -> float:
        """Largest turn (rad) of a curve within a stretch (m)."""
        s, heading = self.s[a], self.direction[a]
        return float(np.abs(np.interp(s + within, s, heading) - heading).max())

    def refine(self, regions: Sequence[_Region]) -> Float[np.ndarray, "R 4"]:
        """s_in, s_out, f_in, f_out (m) of every region, interpolated between samples.

        The distance of a sample from the other curve is that from the chords next to its nearest
        sample within the region. Between the last sample outside and the first one inside, it is linear.
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
        reach = np.repeat([r.reach for r in regions], 4)
        start = np.cumsum([0, *map(len, self.s)])
        s, xyz = np.concatenate(self.s), np.concatenate(self.xyz)
        curve, inside, step, other, lo, hi = np.array(edges).T
        at_end = (inside + step < 0) | (inside + step >= np.diff(start)[curve])
        i = start[curve] + inside
        o = np.where(at_end, i, i + step)
        # More samples on both sides: the one nearest to the sample outside may lie just beyond.
        lo = start[other] + np.maximum(lo - 3, 0)
        hi = np.minimum(start[other] + hi + 3, start[other + 1] - 1)
        d_in, d_out = (_distance_to_curve(xyz, point, lo, hi) for point in (i, o))
        # Chords may be a little closer than samples: then the end lies beyond the sample outside. A
        # sample outside that is far too close was cut off by a bridge.
        away = ~at_end & (d_out > d_in) & (d_out > reach - 0.01)
        u = np.clip((reach - d_in) / np.where(away, d_out - d_in, np.inf), 0.0, 2.0)
        ends = s[i] + u * (s[o] - s[i])
        return np.clip(ends, s[start[curve]], s[start[curve + 1] - 1]).reshape(-1, 4)


def _distance_to_curve(
    xyz: Floats, point: NDArray[np.int_], lo: NDArray[np.int_], hi: NDArray[np.int_]
) -> Floats:
    """Distance in plan from points to polylines, m.

    `point`, `lo` and `hi` count samples: each polyline runs through samples lo..hi. Only
    the chords next to the nearest sample count.
    """
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


def _candidates(
    lanes: Sequence[Lane], curves: _Curves, reach: float, strange: Collection[tuple[str, str]]
) -> list[tuple[int, int]]:
    """Pairs of curves that can conflict, first < second."""
    index = {lane.id: k for k, lane in enumerate(lanes)}
    by_id = {lane.id: lane for lane in lanes}
    followers = [lanes_within(lane, by_id, reach) for lane in lanes]
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
            # Lanes of one road count only side by side: the others follow each other, or are oncoming.
            if lanes[i].road != lanes[j].road or lanes[i].carriageway == lanes[j].carriageway:
                add(i, j, curves.head)
    for links, curve in (("successors", curves.tail), ("predecessors", curves.head)):
        for siblings in sharing(by_id, links).values():
            for one, two in itertools.combinations(siblings, 2):
                add(index[one.id], index[two.id], curve)
    for one, two in strange:
        if one in index and two in index:
            for curve in (curves.head, curves.tail):
                add(index[one], index[two], curve)
    found = np.array(sorted(pairs), int).reshape(-1, 2)
    meet = curves.boxes_meet(found[:, 0], found[:, 1], reach)
    return [(int(a), int(b)) for a, b in found[meet]]


def lanes_within(
    lane: Lane, lanes: Mapping[str, Lane], reach: float, links: str = "successors"
) -> dict[str, float]:
    """Lanes that start within `reach` m after one, and the way there.

    With `links` "predecessors", those that end as little before it.
    """
    found: dict[str, float] = {}
    todo = [(name, 0.0) for name in getattr(lane, links)]
    while todo:
        name, gap = todo.pop()
        if name in lanes and name not in found and gap < reach:
            found[name] = gap
            todo.extend((after, gap + lanes[name].length) for after in getattr(lanes[name], links))
    found.pop(lane.id, None)
    return found


def _classify(lanes: Sequence[Lane], overlaps: list[Overlap]) -> list[Overlap]:
    """Find the kind of each stretch: crossing, merging or diverging.

    A stretch diverges if both lanes start there and come from the same lane. It merges if both end there
    and lead to the same lane, or end side by side too close for vehicles to pass. Lanes of one road that
    come too close side by side merge, too: vehicles pass one behind the other. Where a movement runs over
    several lanes, the kind carries over from one lane to the next.
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
        same = bool(set(i.successors) & set(j.successors))
        if joins and (same or (not parts and _side_by_side(i, j))):
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

    # Lanes that diverge at the end of one lane still do so at the start of the next. Merging carries
    # over in the same way, against the direction of travel.
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

    found = [replace(o, type=kind) for o, kind in zip(overlaps, kinds, strict=True)]
    return [_level(lanes, o) for o in found]


def _side_by_side(i: Lane, j: Lane) -> bool:
    """Whether two lanes end beside each other, in about the same direction."""
    apart = float(np.hypot(*(i.xyz[-1] - j.xyz[-1])[:2]))
    turned = math.remainder(i.heading[-1] - j.heading[-1], math.tau)
    return apart < _BESIDE and abs(turned) < math.pi / 2


def _level(lanes: Sequence[Lane], o: Overlap) -> Overlap:
    """Begin or end the stretch level on both lanes.

    Where one lane continues beside the other, its end is near a whole piece of that one. Vehicles
    that follow each other through a merge or a split measure their gap from there.
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


def _closest(lane: Lane, start: float, end: float, point: Floats) -> float:
    """Arc length (m), from `start` to `end`, nearest to a point."""
    s = np.linspace(start, end, max(2, math.ceil((end - start) / 0.05) + 1))
    return float(s[np.argmin(np.hypot(*(lane.pose(s)[0][:, :2] - point[:2]).T))])
