"""Right of way: which of two paths that meet has priority."""

from __future__ import annotations

import enum
import itertools
import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from limsim_jax.maps.conflicts.overlaps import Overlap, lanes_within
from limsim_jax.maps.conflicts.table import ConflictTable, ConflictType
from limsim_jax.maps.network import Control, Lane, LaneType, Movement, Network, Turn

Floats = NDArray[np.float64]


class Rule(enum.IntEnum):
    """Rules of right of way, the weakest first.

    Cycles are broken in this order, up to `WAY_OUT`.
    """

    NONE = 0
    SIDE = 1
    ROAD = 2
    TURN = 3
    RAMP = 4
    ROUNDABOUT = 5
    WAY_OUT = 6
    CONTROL = 7
    FILE = 8


@dataclass(frozen=True)
class Decision:
    """Priority between two paths, seen from the first: +1 goes first, 0 equal, -1 yields."""

    prio: int
    rule: Rule
    tie: int  # between equals that arrive together, see `ConflictTable`


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
_NEAR = 30.0  # m from a junction, within which lanes lead into it or out of it
_LEFT, _RIGHT = (Turn.LEFT, Turn.SLIGHT_LEFT), (Turn.RIGHT, Turn.SLIGHT_RIGHT)


@dataclass(frozen=True)
class Path:
    """One path over a connector: a movement, or the connector alone."""

    movement: Movement | None
    approach: float  # rad, heading with which it comes in
    turn: Turn
    control: Control
    ramp: bool
    size: tuple[int, float]  # lanes and speed limit (m/s) of the road it comes from
    left_hand: bool

    @property
    def near_side(self) -> bool:
        """Whether it turns without crossing oncoming traffic."""
        return self.turn in (_LEFT if self.left_hand else _RIGHT)

    @property
    def far_side(self) -> bool:
        """Whether it turns across oncoming traffic."""
        return self.turn in (_RIGHT if self.left_hand else _LEFT)


class RightOfWay:
    """Decides which of two connectors has priority where they meet."""

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
        on_roundabout = roundabout_lanes(network, lanes)
        self.from_roundabout = [bool(on_roundabout & {lane.id, *lane.predecessors}) for lane in lanes]
        self._paths: dict[int, list[Path]] = {}

    def only_movement(self, k: int) -> int:
        """Index of the only movement over a connector; -1 for none or several."""
        movements = self.through[self.lanes[k].id]
        return movements[0].index if len(movements) == 1 else -1

    def paths(self, k: int) -> list[Path]:
        """All paths over a connector: its movements, or the connector alone."""
        if k not in self._paths:
            lane = self.lanes[k]
            movements = self.through[lane.id] or self.direct[lane.id]
            self._paths[k] = [self._path(lane, movement) for movement in movements or [None]]
        return self._paths[k]

    def _path(self, lane: Lane, movement: Movement | None) -> Path:
        lanes, road = self.network.lanes, self.network.roads.get(lane.road)
        if movement is not None:
            turn, source = movement.turn, lanes[movement.incoming]
        elif lane.junction is not None:
            turn = _turn(float(lane.heading[-1] - lane.heading[0]))
            source = lanes[lane.predecessors[0]] if lane.predecessors else lane
        else:
            turn, source = Turn.STRAIGHT, lane
        from_start = source is lane and lane.junction is not None
        return Path(
            movement=movement,
            approach=float(source.heading[0 if from_start else -1]),
            turn=turn,
            control=movement.control if movement is not None else Control.NONE,
            ramp=source.type in _RAMPS or lane.type in _RAMPS,
            size=(self.road_lanes[source.carriageway], source.speed_limit),
            left_hand=road.left_hand if road is not None else False,
        )

    def decide(self, overlap: Overlap) -> Decision:
        """Priority in a stretch, seen from its first lane.

        Where several movements run over a lane, the strongest rule between any two of them counts.
        """
        if overlap.type is ConflictType.DIVERGE:
            return Decision(0, Rule.NONE, 0)
        i, j = overlap.first, overlap.second
        out = self._way_out(self.lanes[i], self.lanes[j]) - self._way_out(self.lanes[j], self.lanes[i])
        if out:
            return Decision(_sign(out), Rule.WAY_OUT, 0)
        found = [
            self._between(one, two, overlap) for one, two in itertools.product(self.paths(i), self.paths(j))
        ]
        strongest = max(decision.rule for decision in found)
        found = [decision for decision in found if decision.rule is strongest]
        return Decision(_sign(sum(d.prio for d in found)), strongest, _sign(sum(d.tie for d in found)))

    def _way_out(self, lane: Lane, other: Lane) -> int:
        """1 on the way out of that junction, -1 into it."""
        if other.junction is None or lane.junction == other.junction:
            return 0
        if set(lane.successors) & set(other.successors) or set(lane.predecessors) & set(other.predecessors):
            return 0  # they merge or part
        lanes = self.network.lanes
        comes, leads = (
            any(lanes[name].junction == other.junction for name in lanes_within(lane, lanes, _NEAR, links))
            for links in ("predecessors", "successors")
        )
        return comes - leads

    def _between(self, one: Path, two: Path, overlap: Overlap) -> Decision:
        turned = math.remainder(two.approach - one.approach, 2 * math.pi)  # > 0: two comes from the right
        side = 0
        if math.radians(30) < abs(turned) < math.radians(165):
            side = -1 if (turned > 0) != one.left_hand else 1
        if one.movement is not None and two.movement is not None:
            yields = two.movement.index in one.movement.yields_to
            foe_yields = one.movement.index in two.movement.yields_to
            if yields or foe_yields:
                return Decision(foe_yields - yields, Rule.FILE, side)
        if one.control is two.control is Control.ZIPPER:
            return Decision(0, Rule.CONTROL, 0)
        if one.control is two.control is Control.ALL_WAY_STOP:
            return Decision(0, Rule.CONTROL, side)
        merges = overlap.type is ConflictType.MERGE
        flat = merges and abs(turned) < math.radians(45)
        opposing = abs(turned) > math.radians(120)
        comparisons = (
            (Rule.CONTROL, _CONTROL_RANK[one.control] - _CONTROL_RANK[two.control]),
            (Rule.ROUNDABOUT, self.from_roundabout[overlap.first] - self.from_roundabout[overlap.second]),
            (Rule.RAMP, (two.ramp - one.ramp) if merges else 0),
            (Rule.TURN, _turn_rank(one, opposing) - _turn_rank(two, opposing)),
            (Rule.ROAD, (one.size > two.size) - (one.size < two.size) if flat else 0),
            (Rule.SIDE, side),
        )
        for rule, difference in comparisons:
            if difference:
                return Decision(_sign(difference), rule, side)
        return Decision(0, Rule.NONE, side)


def _sign(x: int) -> int:
    return (x > 0) - (x < 0)


def _turn(angle: float) -> Turn:
    """Turn of a connector by its change of heading (rad)."""
    if abs(angle) < math.radians(30):
        return Turn.STRAIGHT
    if abs(angle) > math.radians(150):
        return Turn.U_TURN
    return Turn.LEFT if angle > 0 else Turn.RIGHT


def _turn_rank(path: Path, opposing: bool) -> int:
    if path.turn is Turn.STRAIGHT:
        return 3
    if path.turn is Turn.U_TURN:
        return 0
    return 2 if opposing and path.near_side else 1


def roundabout_lanes(
    network: Network, lanes: Sequence[Lane], *, longest: float = 600.0, uneven: float = 0.35
) -> set[str]:
    """Ids of lanes on roundabouts that contain one of `lanes`.

    The shortest path from such a lane back to itself is at most `longest` m long. It turns once to the left,
    or to the right with left-hand traffic, and its heading stays within `uneven` (rad) of that on a circle.
    Roundabouts stay below 0.15; a square with sharp corners is off by pi/4, an octagon by pi/8.
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
    """Whether a closed path makes one full turn at an even rate."""
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


def movement_groups(movement: NDArray[np.int32]) -> NDArray[np.int_]:
    """A number for each connector; connectors of one movement share it."""
    alone = np.arange(len(movement)) + movement.max(initial=0) + 1
    return np.unique(np.where(movement < 0, alone, movement), return_inverse=True)[1]


def without_cycles(
    ends: NDArray[np.int_], prio: NDArray[np.int_], rule: NDArray[np.int_]
) -> NDArray[np.int_]:
    """Make connectors on a cycle equal, the weakest rule first.

    Signs and the file stay as they are.

    Args:
        ends: the two connectors of each conflict `[O, 2]`.
        prio: priority of the first over the second `[O]`.
        rule: `Rule` that decided `[O]`.
    """
    prio = prio.copy()
    size = int(ends.max(initial=0)) + 1
    for weakest in (Rule.SIDE, Rule.ROAD, Rule.TURN, Rule.RAMP, Rule.ROUNDABOUT, Rule.WAY_OUT):
        yields = np.where(prio[:, None] < 0, ends, ends[:, ::-1])[prio != 0]
        group = connected_components(_graph(yields[:, 0], yields[:, 1], size), connection="strong")[1]
        prio[(rule == weakest) & (group[ends[:, 0]] == group[ends[:, 1]])] = 0
    return prio


def priority_cycles(table: ConflictTable) -> list[list[int]]:
    """Cycles of connectors that each yield to the next: a shortest one of every cyclic group.

    The last connector of a cycle yields to the first. Without a cycle, at least one vehicle at a junction
    can always go. Consecutive connectors of the same movement count as one. Cycles remain only where the
    file or signs set them.
    """
    foe, prio, movement = (np.asarray(x) for x in (table.foe, table.prio, table.movement))
    nodes = movement_groups(movement)
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


def _graph(tail: NDArray[Any], head: NDArray[Any], size: int) -> csr_array:
    return csr_array((np.ones(len(tail)), (tail, head)), shape=(size, size))


def _cyclic_groups(graph: csr_array) -> Iterator[NDArray[np.int_]]:
    """Strongly connected components of more than one node."""
    count, group = connected_components(graph, connection="strong")
    sizes = np.bincount(group, minlength=count)
    for g in np.flatnonzero(sizes > 1):
        yield np.flatnonzero(group == g)
