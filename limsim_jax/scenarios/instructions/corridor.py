"""Stretches of road for scenarios, and places where ways meet."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from limsim_jax.maps.map import Map
from limsim_jax.maps.network import Control, Lane, Movement, Network, Turn

MOTORWAY_LIMIT, TOWN_LIMIT = 22.0, 17.0
"""m/s: least limit of motorways, and limit below which roads are streets."""

NEAR = 1.0
"""m between the middles of two ways, at which they cross."""

AROUND = 300.0
"""m of the longest circle of a roundabout."""

AHEAD = 30.0
"""m of a corridor beyond a junction."""


@dataclass(frozen=True)
class Corridor:
    """Lanes one after the other, with neighbours that run along.

    Attributes:
      map: of the lanes.
      lanes: ids, in the direction of travel.
      begins: m along the corridor where each lane begins.
      length: m.
      place: which lane this is among those of its direction, from the right; and how many there are.
    """

    map: Map
    lanes: tuple[str, ...]
    begins: tuple[float, ...]
    length: float
    place: tuple[int, int]

    def at(self, x: float, side: int = 0) -> tuple[Lane, float] | None:
        """A lane beside `x` m, and m along it."""
        k = int(np.searchsorted(self.begins, x, side="right")) - 1
        if k < 0 or x > self.length:
            return None
        network = self.map.network
        lane = network.lanes[self.lanes[k]]
        s = x - self.begins[k]
        road_s = float(np.interp(s, lane.s, lane.road_s))
        for _ in range(abs(side)):
            name = lane.left if side > 0 else lane.right
            if name is None or not network.lanes[name].drivable or "car" not in network.lanes[name].access:
                return None
            lane = network.lanes[name]
        return lane, s if side == 0 else float(lane.s_at_road(road_s))

    def sides(self, low: float, high: float) -> tuple[int, int]:
        """Lanes to the right (0 or less) and to the left."""
        marks = [low, high, *(b + 0.1 for b in self.begins if low < b < high)]
        right, left = 0, 0
        while all(self.at(x, right - 1) for x in marks) and right > -8:
            right -= 1
        while all(self.at(x, left + 1) for x in marks) and left < 8:
            left += 1
        return right, left

    @property
    def limit(self) -> float:
        """Least speed limit, m/s."""
        return min(self.map.network.lanes[name].speed_limit for name in self.lanes)

    @property
    def both_ways(self) -> bool:
        """Whether a road on the way has oncoming traffic."""
        network = self.map.network
        roads = {network.lanes[name].road for name in self.lanes}
        signs = {(x.road, x.number < 0) for x in network.drivable_lanes() if x.road in roads}
        return len(signs) > len(roads)

    def goals(self) -> list[str]:
        """Goals in reach of the end, those of all lanes there first."""
        from limsim_jax.maps.lane_map import lane_rows

        rows, reachable = lane_rows(self.map.network), np.asarray(self.map.lanes.routes.reachable)
        names = list(self.map.goals)
        lanes = {
            x.id for side in range(-8, 9) if (found := self.at(self.length - 0.1, side)) for x in found[:1]
        }
        share = reachable[[rows[x] for x in lanes]].mean(0)[: len(names)]
        own = reachable[rows[self.lanes[-1]]][: len(names)]
        return [names[k] for k in np.argsort(-share, kind="stable") if own[k]]


def corridors(town: Map, shortest: float) -> Iterator[Corridor]:
    """Stretches without a crossing, of `shortest` m or more, longest first."""
    network = town.network
    found = []
    for lane in network.drivable_lanes():
        if lane.junction is None and "car" in lane.access and not _goes_on_from(network, lane):
            chain = list(_chain(network, lane))
            found.append(_corridor(town, chain))
    yield from sorted((x for x in found if x.length >= shortest), key=lambda x: (-x.length, x.lanes))


def _goes_on_from(network: Network, lane: Lane) -> bool:
    """Whether another corridor leads into this lane."""
    before = [network.lanes[x] for x in lane.predecessors if x in network.lanes]
    return any(x.successors == (lane.id,) and x.drivable and x.junction is None for x in before)


def _chain(network: Network, lane: Lane) -> Iterator[Lane]:
    seen = set()
    while lane.id not in seen and lane.junction is None:
        seen.add(lane.id)
        yield lane
        after = [
            network.lanes[x] for x in lane.successors if x in network.lanes and network.lanes[x].drivable
        ]
        if len(after) != 1:
            return
        lane = after[0]


def _corridor(town: Map, chain: list[Lane]) -> Corridor:
    ends = np.cumsum([x.length for x in chain])
    begins = (0.0, *ends[:-1].tolist())
    right, left = _beside(town.network, chain[0])
    return Corridor(town, tuple(x.id for x in chain), begins, float(ends[-1]), (right, right + left + 1))


def _beside(network: Network, lane: Lane) -> tuple[int, int]:
    count = []
    for side in ("right", "left"):
        n, name = 0, getattr(lane, side)
        while name is not None and network.lanes[name].drivable:
            n, name = n + 1, getattr(network.lanes[name], side)
        count.append(n)
    return count[0], count[1]


# ---- junctions


@dataclass(frozen=True)
class Way:
    """A way across a junction: a corridor up to it, the connectors, and the lane beyond.

    Attributes:
      movement: of the map.
      approach: up to the stop line.
      crossing: m from the stop line to the place where the other way crosses or joins.
    """

    movement: Movement
    approach: Corridor
    crossing: float

    def goal(self, town: Map) -> str | None:
        """A way out that leads over this movement; None: there is none."""
        network = town.network
        beyond = _corridor(town, [network.lanes[self.movement.outgoing]])
        goals = beyond.goals()
        return goals[0] if goals else None


@dataclass(frozen=True)
class Meeting:
    """Two ways that meet: that of the ego, and that of another vehicle."""

    ego: Way
    other: Way
    angle: float
    """rad, direction of the other one at the stop line as the ego sees it; pi/2 comes from the right."""

    @property
    def comes_from(self) -> str:
        """Where the other one comes from: "left", "right" or "ahead"."""
        if abs(self.angle) > 0.75 * math.pi:
            return "ahead"
        return "right" if self.angle > 0 else "left"


def meetings(town: Map, shortest: float, *, ring: bool = False) -> Iterator[Meeting]:
    """Pairs of ways that cross or join.

    Args:
      town: the map.
      shortest: m of the approach of both, at least.
      ring: only entries of roundabouts, where the other one has come in before and passes by.
    """
    network = town.network
    lines, approaches, inside = {}, {}, _rings(network) if ring else set()
    for lane in network.drivable_lanes():
        if lane.junction is None:
            approaches[lane.id] = _approach(town, lane)
    for movement in network.movements:
        if not movement.via or movement.turn is Turn.U_TURN:
            continue
        lines[movement.index] = _line(network, movement)
    for a in network.movements:
        for b in network.movements:
            if a.junction != b.junction or a.incoming == b.incoming or not {a.index, b.index} <= set(lines):
                continue
            ends = network.lanes[a.incoming], network.lanes[b.incoming]
            if ends[0].road == ends[1].road and ends[0].carriageway == ends[1].carriageway:
                continue
            if ends[0].junction is not None or ends[1].junction is not None:
                continue
            turned = ends[1].heading[-1] - ends[0].heading[-1]
            if ring and ends[1].id in inside and ends[0].id not in inside:
                approaches[ends[1].id] = _around(town, ends[1], inside, shortest)
            elif ring:
                continue
            angle = float(np.arctan2(np.sin(turned), np.cos(turned)))
            where = _crossing(lines[a.index], lines[b.index])
            ways = [approaches[x.id] for x in ends]
            if where is None or min(x.length for x in ways) < shortest or abs(angle) < 0.25 * math.pi:
                continue
            yield Meeting(Way(a, ways[0], where[0]), Way(b, ways[1], where[1]), angle)


def signalled(meeting: Meeting) -> bool:
    """Whether lights rule the meeting."""
    return Control.SIGNAL in (meeting.ego.movement.control, meeting.other.movement.control)


def light_at(network: Network, movement: Movement, time: float) -> str | None:
    """What the light of a movement shows `time` s after the start.

    A letter of SUMO; None: it has no light.

    Actuated lights are taken to run their nominal durations, as they do until vehicles change them.
    """
    if movement.program is None or movement.link is None:
        return None
    program = network.programs[movement.program]
    into = (time - program.offset) % sum(phase.duration for phase in program.phases)
    for phase in program.phases:
        into -= phase.duration
        if into < 0:
            return phase.state[movement.link]
    return program.phases[-1].state[movement.link]


def _approach(town: Map, lane: Lane, *, through: bool = False) -> Corridor:
    """The lanes that lead to a lane without a choice.

    They begin at a junction or the edge; with `through`, at the edge.
    """
    network, chain = town.network, [lane]
    while True:
        before = [network.lanes[x] for x in chain[0].predecessors if x in network.lanes]
        before = [x for x in before if x.drivable and x not in chain and (through or x.junction is None)]
        if len(before) != 1:
            return _corridor(town, chain)
        chain.insert(0, before[0])


# ---- roundabouts


def _rings(network: Network) -> set[str]:
    """Lanes on a circle: a vehicle on them comes back to where it is within `AROUND` m."""
    found: set[str] = set()
    for lane in network.drivable_lanes():
        if lane.junction is None and lane.id not in found and lane.length < AROUND:
            todo, seen = [(lane.id, 0.0)], set()
            while todo:
                name, far = todo.pop()
                here = network.lanes[name]
                if far and name == lane.id:
                    found.add(name)
                    break
                if name not in seen and far < AROUND and here.drivable:
                    seen.add(name)
                    todo += [(x, far + here.length) for x in here.successors if x in network.lanes]
    return found


def _around(town: Map, lane: Lane, inside: set[str], shortest: float) -> Corridor:
    """The lanes from the last way into a roundabout before a lane."""
    network = town.network
    todo = [[lane]]
    while todo:
        chain = todo.pop(0)
        if chain[0].id not in inside and chain[0].junction is None:
            whole = _approach(town, chain[0])
            names = [*whole.lanes[:-1], *(x.id for x in chain)]
            found = _corridor(town, [network.lanes[x] for x in names])
            if found.length >= shortest:
                return found
            continue
        if len(chain) < 12:
            before = [network.lanes[x] for x in chain[0].predecessors if x in network.lanes]
            todo += [[x, *chain] for x in before if x.drivable and x not in chain]
    return _approach(town, lane)


# ---- ramps


@dataclass(frozen=True)
class Merge:
    """A lane that ends beside one that leads on.

    Attributes:
      ramp: corridor to the end of the lane that ends.
      main: corridor beside it.
      ramp_at, main_at: m along both where changing lanes becomes possible.
    """

    ramp: Corridor
    main: Corridor
    ramp_at: float
    main_at: float


def merges(town: Map, shortest: float) -> Iterator[Merge]:
    """Places where a ramp joins, `shortest` m or more from both starts."""
    network = town.network

    def leads_on(lane: Lane) -> bool:
        return any(x in network.lanes and network.lanes[x].drivable for x in lane.successors)

    def main_of(lane: Lane) -> Lane | None:
        beside = [network.lanes[x] for x in (lane.left, lane.right) if x is not None and x in network.lanes]
        return next((x for x in beside if x.drivable), None)

    for last in network.drivable_lanes():
        beside = main_of(last)
        if last.junction is not None or leads_on(last) or beside is None or not leads_on(beside):
            continue
        ramp, first = _approach(town, last, through=True), last
        for name in reversed(ramp.lanes):
            lane = network.lanes[name]
            if main_of(lane) is None or lane.junction is not None:
                break
            first = lane
        other = main_of(first)
        if first.id == ramp.lanes[0] or other is None:  # a lane that is dropped, no ramp
            continue
        main = _approach(town, beside, through=True)
        if other.id not in main.lanes:
            continue
        found = Merge(
            ramp, main, ramp.begins[ramp.lanes.index(first.id)], main.begins[main.lanes.index(other.id)]
        )
        if min(found.ramp_at, found.main_at) >= shortest:
            yield found


def _line(network: Network, movement: Movement) -> np.ndarray:
    """Points 0.5 m apart on the way across: x, y, and m from the stop line."""
    parts, done = [], 0.0
    names = [*movement.via, movement.outgoing]
    for name in names:
        lane = network.lanes[name]
        end = min(lane.length, AHEAD) if name == movement.outgoing else lane.length
        s = np.arange(0, end, 0.5)
        parts.append(np.column_stack([lane.pose(s)[0][:, :2], done + s]))
        done += lane.length
    return np.concatenate(parts)


def _crossing(a: np.ndarray, b: np.ndarray) -> tuple[float, float] | None:
    """m along both ways where they first come as near as `NEAR`; None: never."""
    apart = np.hypot(a[:, None, 0] - b[None, :, 0], a[:, None, 1] - b[None, :, 1])
    if apart.min() > NEAR:
        return None
    i = int(np.argmax((apart <= NEAR).any(1)))
    j = int(np.argmin(apart[i]))
    return float(a[i, 2]), float(b[j, 2])
