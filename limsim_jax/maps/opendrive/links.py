"""From the links of a file to a directed graph of lanes.

OpenDRIVE states links twice or more, on both sides, in terms of road direction. Here every statement
is first reduced to one fact, "this end of that lane touches that end of this lane"; travel
directions then make it a directed edge. It does not matter which side states it.
"""

from __future__ import annotations

import itertools
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from limsim_jax.maps.network import (
    DRIVABLE,
    Control,
    ImportReport,
    Junction,
    Lane,
    LaneType,
    Movement,
    Turn,
)
from limsim_jax.maps.opendrive.completion import End, Stated, complete
from limsim_jax.maps.opendrive.lanes import MIN_SECTION, MIN_WIDTH, LaneKey, Piece, lane_id
from limsim_jax.maps.opendrive.records import RawConnection, RawJunction, RawRoad, RoadLink

BEND = 40.0  # m; traffic that turns at a junction drives tighter than this


@dataclass(frozen=True)
class _Contact:
    a: End
    b: End
    line: int | None
    junction: str | None = None  # stated by this junction


class Linker:
    """Turns contacts between lane ends into successors, neighbours and movements."""

    def __init__(
        self,
        roads: dict[str, RawRoad],
        junctions: dict[str, RawJunction],
        pieces: dict[str, list[Piece]],
        piece_at: dict[tuple[str, int], list[Piece]],
        lanes: dict[str, Lane],
        report: ImportReport,
    ) -> None:
        self.roads, self.junctions, self.pieces = roads, junctions, pieces
        self.piece_at, self.lanes, self.report = piece_at, lanes, report
        self.contacts: dict[tuple[End, End], _Contact] = {}
        self.stated: list[Stated] = []
        self.through: dict[tuple[str, str], set[str]] = defaultdict(set)  # lane pair -> direct junctions

    def run(self) -> None:
        """Fill `lanes` with successors, predecessors and neighbours."""
        for road in self.roads.values():
            self._within(road)
            self._road_link(road, road.predecessor, "start")
            self._road_link(road, road.successor, "end")
        for junction in self.junctions.values():
            for connection in junction.connections:
                self._connection(junction, connection)
        for a, b, link in list(complete(self.stated, self.contacts, self.roads, self.report)):
            self._touch(a, b, link.line, link.junction)
        self._pass_through_dropped()
        self._direct_edges()
        self._neighbours()

    # --- collecting -----------------------------------------------------------------------------

    def _touch(self, a: End, b: End, line: int | None, junction: str | None = None) -> None:
        for end in (a, b):
            road, section, number, _ = end
            sections = self.roads[road].sections
            if number not in sections[section].lanes:
                self.report.ignored(
                    "lane link",
                    f"road {a[0]} lane {a[2]} to road {b[0]} lane {b[2]}",
                    f"road {road} has no lane {number} at its {end[3]}",
                    line,
                )
                return
        key = (a, b) if a <= b else (b, a)
        if a == b:
            return
        known = self.contacts.get(key)
        if known is None or (known.junction is None and junction is not None):  # a road may state it, too
            self.contacts[key] = _Contact(*key, line, junction)

    def _within(self, road: RawRoad) -> None:
        for k, section in enumerate(road.sections[:-1]):
            following = road.sections[k + 1]
            where = f"road {road.id} s={following.s:g}"
            first, second = (road.id, k, "end"), (road.id, k + 1, "start")
            self.stated.append(Stated(first=first, second=second, where=where, line=following.line))
            for number, lane in section.lanes.items():
                for other in lane.successors:
                    if number and other:
                        self._touch((road.id, k, number, "end"), (road.id, k + 1, other, "start"), lane.line)
            for number, lane in following.lanes.items():
                for other in lane.predecessors:
                    if number and other:
                        self._touch((road.id, k, other, "end"), (road.id, k + 1, number, "start"), lane.line)

    def _road_link(self, road: RawRoad, link: RoadLink | None, end: str) -> None:
        if link is None:
            return
        element = "road link"
        where = f"road {road.id} {'predecessor' if end == 'start' else 'successor'}"
        if link.is_junction:
            if link.id not in self.junctions:
                self.report.ignored(element, where, f"junction {link.id} is not in the file", link.line)
            return
        if link.id not in self.roads:
            self.report.ignored(element, where, f"road {link.id} is not in the file", link.line)
            return
        other = self.roads[link.id]
        section = 0 if end == "start" else len(road.sections) - 1
        contact, index = link.contact, 0
        if link.s is None:
            contact = contact or self._nearest_end(road, end, other, where, link)
            index = 0 if contact == "start" else len(other.sections) - 1
            first, second = (road.id, section, end), (other.id, index, contact)
            self.stated.append(Stated(first=first, second=second, where=where, line=link.line))
        for number, lane in road.sections[section].lanes.items():
            for target in lane.predecessors if end == "start" else lane.successors:
                if not number or not target:
                    continue
                mine = (road.id, section, number, end)
                if link.s is not None:
                    self._touch_inside(mine, other, target, link)
                    continue
                self._touch(mine, (other.id, index, target, contact), lane.line)

    def _nearest_end(self, road: RawRoad, end: str, other: RawRoad, where: str, link: RoadLink) -> str:
        """The nearer end, for links without a contact point."""

        def at(r: RawRoad, e: str) -> np.ndarray:
            s = np.array([0.0 if e == "start" else r.length])
            x, y, *_ = r.reference.frame(s, s)
            return np.array([x[0], y[0]])

        here = at(road, end)
        nearest = min(("start", "end"), key=lambda e: float(np.hypot(*(at(other, e) - here))))
        self.report.repaired(
            "road link", where, f"no contactPoint: took the {nearest} of road {other.id}, which is nearer",
            link.line,
        )  # fmt: skip
        return nearest

    def _touch_inside(self, mine: End, other: RawRoad, target: int, link: RoadLink) -> None:
        """A virtual junction: touch the main road where it was cut at `elementS`."""
        assert link.s is not None
        # leaving (or entering) in + direction touches the end of the piece before (start of the one after)
        leaves = mine[3] == "start"
        before = (link.direction != "-") == leaves
        for piece in self.pieces[other.id]:
            edge = piece.end if before else piece.start
            if abs(edge - link.s) < 2 * MIN_SECTION:
                section, _, _ = piece.parts[-1 if before else 0]
                k = next(i for i, s in enumerate(other.sections) if s is section)
                side = "end" if before else "start"
                self._touch(mine, (other.id, k, target, f"{side}@{piece.index}"), link.line)
                return
        self.report.ignored(
            "road link", f"road {mine[0]}", f"road {other.id} has no place s = {link.s:g}", link.line
        )

    def _connection(self, junction: RawJunction, connection: RawConnection) -> None:
        where = f"junction {junction.id}"
        if junction.type == "virtual" and connection.incoming is None:
            return  # the connecting road's own links are complete
        if connection.incoming is None:
            self.report.ignored("connection", where, "names no incomingRoad", connection.line)
            return
        for road in (connection.incoming, connection.road):
            if road not in self.roads:
                self.report.ignored("connection", where, f"road {road} is not in the file", connection.line)
                return
        incoming, connecting = self.roads[connection.incoming], self.roads[connection.road]
        if junction.type == "virtual":
            return
        end = self._end_at_junction(incoming, junction, connecting, connection)
        if end is None:
            return
        links = connection.lanes
        if not links:
            links = tuple(self._links_from_roads(incoming, end, connecting, connection.contact))
            if links:
                self.report.repaired(
                    "connection", f"{where} road {incoming.id} to road {connecting.id}",
                    "has no laneLink: took the links that its roads state", connection.line,
                )  # fmt: skip
        own = 0 if connection.contact == "start" else len(connecting.sections) - 1
        theirs = 0 if end == "start" else len(incoming.sections) - 1
        direct = junction.id if junction.type == "direct" or connecting.junction is None else None
        self.stated.append(
            Stated(
                first=(incoming.id, theirs, end),
                second=(connecting.id, own, connection.contact),
                where=f"{where} road {incoming.id} to road {connecting.id}",
                line=connection.line,
                junction=direct,
            )
        )
        for a, b in links:
            if a and b:
                self._touch(
                    (incoming.id, theirs, a, end),
                    (connecting.id, own, b, connection.contact),
                    connection.line,
                    direct,
                )

    def _end_at_junction(
        self, incoming: RawRoad, junction: RawJunction, connecting: RawRoad, connection: RawConnection
    ) -> str | None:
        """Which end of the incoming road lies at the junction."""
        ends = [
            end
            for end, link in (("start", incoming.predecessor), ("end", incoming.successor))
            if link is not None and link.is_junction and link.id == junction.id
        ]
        if len(ends) == 1:
            return ends[0]
        s = np.array([0.0 if connection.contact == "start" else connecting.length])
        x, y, *_ = connecting.reference.frame(s, s)
        candidates = ends or ["start", "end"]

        def distance(end: str) -> float:
            at = np.array([0.0 if end == "start" else incoming.length])
            x1, y1, *_ = incoming.reference.frame(at, at)
            return float(np.hypot(x1[0] - x[0], y1[0] - y[0]))

        nearest = min(candidates, key=distance)
        if not ends:
            where = f"junction {junction.id} road {incoming.id} to road {connecting.id}"
            if distance(nearest) > 20.0:
                self.report.ignored(
                    "connection",
                    where,
                    f"road {incoming.id} has no link to the junction and ends {distance(nearest):.0f} m away",
                    connection.line,
                )
                return None
            self.report.repaired(
                "connection",
                where,
                f"road {incoming.id} does not link to the junction: took its {nearest}, which is nearer",
                connection.line,
            )
        return nearest

    def _links_from_roads(
        self, incoming: RawRoad, end: str, connecting: RawRoad, contact: str
    ) -> Iterator[tuple[int, int]]:
        section = connecting.sections[0 if contact == "start" else -1]
        for number, lane in section.lanes.items():
            for other in lane.predecessors if contact == "start" else lane.successors:
                if number and other:
                    yield other, number

    # --- resolving ------------------------------------------------------------------------------

    def _lane(self, end: End) -> tuple[LaneKey, str] | None:
        """The sampled lane at one end of a record, and that end."""
        road, section, number, side = end
        side, _, index = side.partition("@")
        if index:
            return (road, int(index), number), side
        pieces = self.piece_at.get((road, section))
        if not pieces:
            return None
        at = 0 if side == "start" else -1
        piece = pieces[at]
        if piece.parts[at][0] is not self.roads[road].sections[section]:
            return None  # joined to the section beyond: the lane goes on
        return (road, piece.index, number), side

    def _pass_through_dropped(self) -> None:
        """Connect the lanes on both sides of a dropped lane section."""
        dropped = {
            (road.id, k)
            for road in self.roads.values()
            for k in range(len(road.sections))
            if (road.id, k) not in self.piece_at
        }
        touching: dict[End, dict[End, int | None]] = defaultdict(dict)
        for c in self.contacts.values():
            touching[c.a][c.b] = touching[c.b][c.a] = c.line
        for road_id, k in sorted(dropped):  # ascending: what is passed on is passed on again
            for number in self.roads[road_id].sections[k].lanes:
                start, end = (touching.pop((road_id, k, number, side), {}) for side in ("start", "end"))
                for a, line in start.items():
                    for b in end:
                        touching[a][b] = touching[b][a] = line
                        self._touch(a, b, line)
        self.contacts = {
            key: c
            for key, c in self.contacts.items()
            if (c.a[0], c.a[1]) not in dropped and (c.b[0], c.b[1]) not in dropped
        }

    def _direct_edges(self) -> None:
        successors: dict[str, dict[str, None]] = defaultdict(dict)
        predecessors: dict[str, dict[str, None]] = defaultdict(dict)
        for contact in self.contacts.values():
            a, b = self._lane(contact.a), self._lane(contact.b)
            if a is None or b is None or a == b:
                continue
            leaves_a, leaves_b = self._leaves(*a), self._leaves(*b)
            if leaves_a == leaves_b:
                kind = "end" if leaves_a else "begin"
                lane_a, lane_b = self.lanes[lane_id(a[0])], self.lanes[lane_id(b[0])]
                if lane_a.drivable or lane_b.drivable:
                    self.report.ignored(
                        "lane link",
                        f"road {a[0][0]} lane {a[0][2]} to road {b[0][0]} lane {b[0][2]}",
                        f"both lanes {kind} there: traffic cannot pass",
                        contact.line,
                    )
                continue
            first, second = (a, b) if leaves_a else (b, a)
            from_id, to_id = lane_id(first[0]), lane_id(second[0])
            successors[from_id][to_id] = None
            predecessors[to_id][from_id] = None
            if contact.junction is not None:
                self.through[from_id, to_id].add(contact.junction)
        # cuts inside a section: the piece simply goes on
        for road_id, pieces in self.pieces.items():
            for before, after in itertools.pairwise(pieces):
                if before.parts[-1][0] is not after.parts[0][0]:
                    continue
                for number in before.attributes:
                    pair = lane_id((road_id, before.index, number)), lane_id((road_id, after.index, number))
                    if not before.attributes[number].forward:
                        pair = pair[::-1]
                    successors[pair[0]][pair[1]] = None
                    predecessors[pair[1]][pair[0]] = None
        for key, lane in self.lanes.items():
            self.lanes[key] = replace(
                lane,
                successors=tuple(successors.get(key, ())),
                predecessors=tuple(predecessors.get(key, ())),
            )

    def _leaves(self, key: LaneKey, side: str) -> bool:
        """Whether traffic leaves the lane at this end."""
        road, piece, number = key
        forward = self.pieces[road][piece].attributes[number].forward
        return forward == (side == "end")

    def _neighbours(self) -> None:
        for road_id, pieces in self.pieces.items():
            road = self.roads[road_id]
            for piece in pieces:
                wide = [
                    n
                    for n in sorted(piece.attributes)
                    if self.lanes[lane_id((road_id, piece.index, n))].width.max() >= MIN_WIDTH
                ]
                for i, number in enumerate(wide):
                    own = piece.attributes[number]
                    beside: dict[str, int | None] = {
                        "up": wide[i + 1] if i + 1 < len(wide) else None,
                        "down": wide[i - 1] if i > 0 else None,
                    }
                    along: dict[str, str | None] = {}
                    against: dict[str, str | None] = {}
                    for side, n in beside.items():
                        along[side] = against[side] = None
                        if n is None:
                            continue
                        other, name = piece.attributes[n], lane_id((road_id, piece.index, n))
                        if other.forward == own.forward:
                            along[side] = name
                        elif other.type in DRIVABLE or other.type is LaneType.BIDIRECTIONAL:
                            against[side] = name
                    left, right = ("up", "down") if own.forward else ("down", "up")
                    may = {"up": own.change_up, "down": own.change_down}
                    key = lane_id((road_id, piece.index, number))
                    self.lanes[key] = replace(
                        self.lanes[key],
                        left=along[left],
                        right=along[right],
                        may_change_left=may[left] and along[left] is not None,
                        may_change_right=may[right] and along[right] is not None,
                        opposite=against[right if road.left_hand else left],
                    )


# --- movements ----------------------------------------------------------------------------------


def build_movements(
    lanes: dict[str, Lane],
    junctions: dict[str, RawJunction],
    through: dict[tuple[str, str], set[str]],
    report: ImportReport,
) -> tuple[tuple[Movement, ...], dict[str, Junction]]:
    """All movements across the junctions, and the junctions."""
    found: list[Movement] = []

    def add(junction: str, incoming: str, outgoing: str, via: tuple[str, ...]) -> None:
        found.append(
            Movement(
                index=len(found),
                junction=junction,
                incoming=incoming,
                outgoing=outgoing,
                via=via,
            )
        )

    for lane in lanes.values():
        if not lane.drivable:
            continue
        for following in lane.successors:
            for junction in sorted(through.get((lane.id, following), ())):
                if lanes[following].drivable:
                    add(junction, lane.id, following, ())
            inner = lanes[following]
            if inner.junction is None or inner.junction == lane.junction or not inner.drivable:
                continue
            stack: list[tuple[str, ...]] = [(following,)]
            while stack:
                via = stack.pop()
                last = lanes[via[-1]]
                for after in reversed(last.successors):
                    if not lanes[after].drivable:
                        continue
                    if lanes[after].junction == inner.junction:
                        if after not in via:
                            stack.append((*via, after))
                    else:
                        add(inner.junction, lane.id, after, via)

    by_junction: dict[str, list[int]] = defaultdict(list)
    inside: dict[str, list[str]] = defaultdict(list)
    for movement in found:
        by_junction[movement.junction].append(movement.index)
    for lane in lanes.values():
        if lane.junction is not None:
            inside[lane.junction].append(lane.id)

    used = {via for movement in found for via in movement.via}
    for lane in lanes.values():
        if lane.junction is not None and lane.drivable and lane.id not in used:
            missing = "no lane leads into it" if not lane.predecessors else "it leads nowhere"
            report.approximated(
                "connector", f"road {lane.road} lane {lane.number}", f"{missing}: no movement uses it"
            )

    records: dict[str, Junction] = {}
    names = list(junctions) + [j for j in inside if j not in junctions]
    for name in names:
        raw = junctions.get(name)
        if raw is None:
            report.repaired("junction", name, "roads name it, but the file has no such junction: made up")
        ends = [lanes[v].xyz[:, :2] for v in inside.get(name, ())]
        if not ends:
            ends = [lanes[found[m].incoming].xyz[-1:, :2] for m in by_junction.get(name, ())]
        center = np.concatenate(ends).mean(0) if ends else np.zeros(2)
        records[name] = Junction(
            id=name,
            name=raw.name if raw else "",
            type=raw.type if raw else "default",
            movements=tuple(by_junction.get(name, ())),
            connectors=tuple(inside.get(name, ())),
            center=(float(center[0]), float(center[1])),
        )
    turned = with_turns(tuple(found), lanes)
    return with_priorities(turned, lanes, junctions, report), records


def with_turns(movements: tuple[Movement, ...], lanes: dict[str, Lane]) -> tuple[Movement, ...]:
    """Turn of every movement: its change of heading relative to the road.

    A motorway that bends inside a junction is no left turn: of the movements of an incoming road that
    follow a bend of more than `BEND` radius, the one to the road with the most lanes (then the
    straightest) counts as straight on.
    """
    angle = {
        m.index: sum(float(lanes[v].heading[-1] - lanes[v].heading[0]) for v in m.via) for m in movements
    }
    length = {m.index: sum(lanes[v].length for v in m.via) for m in movements}
    by_road: dict[tuple[str, str], list[int]] = defaultdict(list)
    for m in movements:
        by_road[m.junction, lanes[m.incoming].road].append(m.index)
    straight: dict[int, float] = {}
    for members in by_road.values():
        lanes_to = Counter(lanes[movements[m].outgoing].road for m in members)
        wide = [m for m in members if length[m] > BEND * abs(angle[m])]
        best = max(
            wide, key=lambda m: (lanes_to[lanes[movements[m].outgoing].road], -abs(angle[m])), default=None
        )
        straight.update({m: 0.0 if best is None else angle[best] for m in members})
    return tuple(replace(m, turn=_turn(angle[m.index] - straight[m.index])) for m in movements)


def _turn(angle: float) -> Turn:
    degrees = np.degrees(angle)
    if abs(degrees) > 150:
        return Turn.U_TURN
    if abs(degrees) < 20:
        return Turn.STRAIGHT
    if abs(degrees) < 45:
        return Turn.SLIGHT_LEFT if degrees > 0 else Turn.SLIGHT_RIGHT
    return Turn.LEFT if degrees > 0 else Turn.RIGHT


def with_priorities(
    movements: tuple[Movement, ...],
    lanes: dict[str, Lane],
    junctions: dict[str, RawJunction],
    report: ImportReport,
) -> tuple[Movement, ...]:
    """Apply `<priority high= low=>` records.

    They name connecting roads or, in old files, incoming ones.
    """
    yields: dict[int, set[int]] = defaultdict(set)
    high_side: set[int] = set()
    for junction in junctions.values():
        own = [m for m in movements if m.junction == junction.id]
        for high, low, line in junction.priorities:

            def uses(m: Movement, road: str) -> bool:
                return lanes[m.incoming].road == road or any(lanes[v].road == road for v in m.via)

            first = [m.index for m in own if uses(m, high)]
            second = [m.index for m in own if uses(m, low)]
            if not first or not second:
                missing = high if not first else low
                report.ignored(
                    "junction priority",
                    f"junction {junction.id}",
                    f"road {missing} is on no movement of this junction",
                    line,
                )
                continue
            report.read("junction priority")
            high_side.update(first)
            for m in second:
                yields[m].update(n for n in first if n != m)
    result = []
    for m in movements:
        first = frozenset(yields.get(m.index, ()))
        if first:
            m = replace(m, control=Control.YIELD, yields_to=first)
        elif m.index in high_side:
            m = replace(m, control=Control.PRIORITY)
        result.append(m)
    return tuple(result)
