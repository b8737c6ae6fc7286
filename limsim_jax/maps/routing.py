"""Routes as tables: the way from every lane to every goal.

A vehicle carries one number, its goal. For its lane the tables say how far the goal is, which successor to
take, how many lanes to cross, and where at the latest. They are built on the host in float64 by Dijkstra's
algorithm on the reversed lane graph, from all goals at once.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from limsim_jax.maps.network import Lane, MapError, Network
from limsim_jax.maps.route_table import FAR, RouteTable
from limsim_jax.maps.widths import ends_narrow

Floats = NDArray[np.float64]


CHANGE_PENALTY = 30.0
"""Detour that is preferred to one lane change, m."""

ROOM_TO_CHANGE, SHORT_PENALTY = 30.0, 300.0
"""m: on a lane shorter than the first, a change costs more, up to a detour of the second at no length."""

NO_ROOM, NO_WAY = 10.0, 1e5
"""m: a lane shorter than the first is no place to change lanes.

A detour of the second is preferred to such a change. A vehicle that must change before such a lane does not
drive on to it.
"""

TOLERANCE = 5.0
"""Difference of length within which lanes to the same place are equally good, m."""


class Round(tuple[str, ...]):
    """Lanes of a goal that traffic passes: it goes round and round, and never arrives."""

    __slots__ = ()


def default_goals(network: Network) -> dict[str, tuple[str, ...]]:
    """The ways out of a map: groups of lane ids by name.

    There is one goal per road and direction on which traffic leaves the map: the last lanes, none of which
    has a drivable successor. A lane that ends beside one that continues is no goal, nor is one that narrows
    to nothing beside another. On a map without exits
    there is one goal per road and direction outside junctions: the last lanes on it. Where such a map has
    rings only, without a fork, traffic goes round: there is one goal per ring, a `Round`.

    Names are road ids. Where a road has traffic both ways, `+` or `-` follows, the sign of its lane numbers
    (OpenDRIVE). Goals of rings are named `round` and the name of their first road.
    """
    if rings := _rings(network):
        return rings
    lanes = {lane.id: lane for lane in network.drivable_lanes()}
    go_on = {lane.carriageway for lane in lanes.values() if any(name in lanes for name in lane.successors)}
    ends = [lane for lane in lanes.values() if lane.carriageway not in go_on]
    if not ends:
        ends = [
            lane
            for lane in lanes.values()
            if lane.junction is None
            and (lane.successors or lane.carriageway not in go_on)
            and not any(lanes[x].road == lane.road for x in lane.successors if x in lanes)
        ]
    goals: dict[str, tuple[str, ...]] = {}
    name_of = _way_names(network)
    for lane in _wide_ends(ends):
        name = name_of[lane.road, lane.number < 0]
        goals[name] = (*goals.get(name, ()), lane.id)
    return goals


def _way_names(network: Network) -> dict[tuple[str, bool], str]:
    """Names of roads and directions."""
    ways = {(lane.road, lane.number < 0) for lane in network.drivable_lanes()}
    return {
        (road, negative): road + (("-" if negative else "+") if (road, not negative) in ways else "")
        for road, negative in ways
    }


def _rings(network: Network) -> dict[str, tuple[str, ...]]:
    """Goals of a map of rings: closed ways that no road leaves or joins. Empty for other maps."""
    lanes = {lane.id: lane for lane in network.drivable_lanes()}
    onward: dict[tuple[str, bool], set[tuple[str, bool]]] = {}
    last: dict[tuple[str, bool], list[str]] = {}
    sections: dict[tuple[str, bool], set[int]] = {}
    for lane in lanes.values():
        sections.setdefault((lane.road, lane.number < 0), set()).add(lane.section)
    for lane in lanes.values():
        way = lane.road, lane.number < 0
        forward = lane.road_s[-1] >= lane.road_s[0]
        if lane.section == (max if forward else min)(sections[way]):
            after = [lanes[name] for name in lane.successors if name in lanes]
            onward.setdefault(way, set()).update((x.road, x.number < 0) for x in after)
            if after:
                last.setdefault(way, []).append(lane.id)
    if any(len(ways) != 1 for ways in onward.values()) or len(onward) < len(sections):
        return {}
    comes_after = {way: next(iter(ways)) for way, ways in onward.items()}
    if len(set(comes_after.values())) < len(comes_after):
        return {}
    name_of, goals, seen = _way_names(network), {}, set()
    for way in comes_after:
        if way not in seen:
            goals[f"round {name_of[way]}"] = Round(last[way])
        while way not in seen:
            seen.add(way)
            way = comes_after[way]
    return goals


def last_lanes(network: Network, road: str) -> tuple[str, ...]:
    """Ids of the drivable lanes at the ends of a road."""
    lanes = network.lanes
    ends = [
        lane
        for lane in network.drivable_lanes()
        if lane.road == road and all(lanes[x].road != road for x in lane.successors if x in lanes)
    ]
    return tuple(lane.id for lane in _wide_ends(ends))


def _wide_ends(ends: list[Lane]) -> list[Lane]:
    """Lanes without those that narrow to nothing beside another that does not."""
    wide = {lane.carriageway for lane in ends if not ends_narrow(lane)}
    return [lane for lane in ends if lane.carriageway not in wide or not ends_narrow(lane)]


def build_routes(
    network: Network,
    rows: Mapping[str, int],
    goals: Sequence[Sequence[str]] | Mapping[str, Sequence[str]] | None = None,
    *,
    prescribed: Mapping[str, Sequence[str]] | None = None,
    vehicle_class: str | None = None,
    change_penalty: float = CHANGE_PENALTY,
    short_penalty: float = SHORT_PENALTY,
    tolerance: float = TOLERANCE,
) -> RouteTable:
    """Tables of the way from every lane to every goal.

    Args:
        network: The map.
        rows: Row of every drivable lane (`lane_map.lane_rows`).
        goals: Groups of lane ids; a goal is reached at the end of any lane of its group. Default:
            `default_goals`.
        prescribed: By the name of a goal, all roads on the way to it: see `build_fixed_routes`.
        vehicle_class: Use only lanes that this class may use. Default: all drivable lanes.
        change_penalty: Cost of one lane change, m.
        short_penalty: Cost (m) that is added for a change on a lane of no length. It falls to nothing at
            `ROOM_TO_CHANGE`. With 0 short lanes are as good as others, also below `NO_ROOM`.
        tolerance: Prefer the own lane if its way is at most this much longer, m.

    Raises:
        MapError: a goal without lanes, or with one that is not a drivable lane of the map.
    """
    if goals is None:
        goals = default_goals(network)
    groups = list(goals.values()) if isinstance(goals, Mapping) else list(goals)
    for group in groups:
        if isinstance(group, str) or not group:
            raise MapError(f"a goal is a group of one or more lane ids, not {group!r}", file=network.source)
        for name in group:
            if name not in rows:
                raise MapError(_no_such_lane(network, name), file=network.source, element=f"goal {name!r}")
    graph = _LaneGraph(network, rows, vehicle_class)
    columns = [[rows[name] for name in group] for group in groups]
    table = graph.solve(columns, change_penalty, tolerance, short_penalty=short_penalty)
    for column, group in enumerate(groups):
        if isinstance(group, Round):
            graph.pass_goal(table, column)
    if prescribed:
        names = list(goals) if isinstance(goals, Mapping) else []
        ways = build_fixed_routes(
            network, rows, list(prescribed.values()), vehicle_class=vehicle_class,
            change_penalty=change_penalty, tolerance=tolerance,
        )  # fmt: skip
        for field, values in vars(ways).items():
            vars(table)[field][:, [names.index(name) for name in prescribed]] = values
    return table


def build_fixed_routes(
    network: Network,
    rows: Mapping[str, int],
    routes: Sequence[Sequence[str]],
    *,
    vehicle_class: str | None = None,
    change_penalty: float = CHANGE_PENALTY,
    tolerance: float = TOLERANCE,
) -> RouteTable:
    """Tables for routes that prescribe every road (SUMO edges): one column per route.

    A column knows only the lanes of its roads, and the connectors between one road and the next; its
    goal is the end of the last road. Cut routes that visit a road twice with `split_route`: the
    vehicle then switches to the column of the next leg.

    Raises:
        MapError: a road that is not on the map, comes twice in a route, or from which no lane leads to
            the next one.
    """
    graph = _LaneGraph(network, rows, vehicle_class)
    columns = []
    for roads in routes:
        links = graph.along(_checked_route(network, roads, vehicle_class))
        ends = [rows[lane.id] for lane in graph.ends(roads[-1])]
        column = graph.solve([ends], change_penalty, tolerance, links)
        for road, after in itertools.pairwise(roads):
            if not any(column.next_lane[rows[lane.id], 0] >= 0 for lane in graph.ends(road)):
                raise _dead_end(network, road, after, roads[-1])
        columns.append(column)
    if not columns:
        return graph.solve([], change_penalty, tolerance)
    return RouteTable(**{name: np.hstack([vars(c)[name] for c in columns]) for name in vars(columns[0])})


def split_route(roads: Sequence[str]) -> list[tuple[str, ...]]:
    """Cut a list of roads into legs that visit no road twice.

    Each leg begins with the last road of the one before:
    `["a", "b", "a", "c"]` becomes `[("a", "b"), ("b", "a", "c")]`.
    """
    legs: list[list[str]] = [[]]
    for road in roads:
        if road in legs[-1]:
            legs.append([legs[-1][-1]])
        legs[-1].append(road)
    return [tuple(leg) for leg in legs]


def _dead_end(network: Network, road: str, after: str, last: str) -> MapError:
    return MapError(f"no lane from road '{road}' leads to '{after}' and on to '{last}'", file=network.source)


def _no_such_lane(network: Network, name: str) -> str:
    if name in network.lanes:
        return f"lane '{name}' is not for motor traffic"
    return f"no lane '{name}'; ids look like {', '.join(list(network.lanes)[:5])}"


def _checked_route(
    network: Network, roads: Sequence[str], vehicle_class: str | None, *, repeats: bool = False
) -> tuple[str, ...]:
    """The route as a tuple. Raises `MapError` if it cannot be driven.

    Every road must exist and have a lane for this class. No road may come twice unless `repeats`.
    """
    if not roads:
        raise MapError("a route needs at least one road", file=network.source)
    usable = {lane.road for lane in network.drivable_lanes() if _may_use(lane, vehicle_class)}
    for road in roads:
        if road not in usable:
            network.road_lanes(road)  # raises if there is none of this name
            traffic = vehicle_class or "motor traffic"
            raise MapError(f"no lane of road '{road}' is for {traffic}", file=network.source)
    if len(set(roads)) < len(roads):
        twice = next(road for road in roads if list(roads).count(road) > 1)
        raise MapError(f"the route visits road '{twice}' twice; cut it with split_route", file=network.source)
    return tuple(roads)


def _may_use(lane: Lane, vehicle_class: str | None) -> bool:
    return vehicle_class is None or vehicle_class in lane.access


class _LaneGraph:
    """Lanes by row, and the links between them: to successors, to the left, to the right."""

    def __init__(self, network: Network, rows: Mapping[str, int], vehicle_class: str | None) -> None:
        self.network, self.rows = network, rows
        self.lanes = sorted(network.drivable_lanes(), key=lambda lane: rows[lane.id])
        usable = {lane.id: rows[lane.id] for lane in self.lanes if _may_use(lane, vehicle_class)}
        self.usable = usable

        def links(pairs: list[tuple[str, str | None]]) -> NDArray[np.int_]:
            found = [(usable[a], usable[b]) for a, b in pairs if a in usable and b in usable]
            return np.array(found, int).reshape(-1, 2)

        self.ahead = links([(lane.id, name) for lane in self.lanes for name in lane.successors])
        # vehicles do not change lanes within a junction, see `traffic.lane_change.place_beside`
        outside = [lane for lane in self.lanes if lane.junction is None]
        self.left = links([(lane.id, lane.left) for lane in outside if lane.may_change_left])
        self.right = links([(lane.id, lane.right) for lane in outside if lane.may_change_right])
        # Lanes side by side count with their mean length. Otherwise a route would change lanes at every
        # bend to save some metres, and long before it must.
        beside = links([(lane.id, name) for lane in self.lanes for name in (lane.left, lane.right)])
        size = len(self.lanes)
        group = connected_components(_matrix(beside, np.ones(len(beside)), size), directed=False)[1]
        self.length = np.array([lane.length for lane in self.lanes])
        self.cost = (np.bincount(group, self.length) / np.maximum(np.bincount(group), 1))[group]

    def ends(self, road: str) -> list[Lane]:
        """Lanes of a road with no successor on the same road."""
        last = last_lanes(self.network, road)
        return [lane for lane in self.lanes if lane.id in last and lane.id in self.usable]

    def along(self, roads: Sequence[str]) -> NDArray[np.bool_]:
        """Which of the links ahead belong to a route over these roads: a mask over `ahead`."""
        order = {road: i for i, road in enumerate(roads)}
        place = np.array([order.get(lane.road, -1) for lane in self.lanes])
        inside = np.array([lane.junction is not None for lane in self.lanes]) & (place < 0)
        tail, head = self.ahead.T
        allowed = (place[tail] >= 0) & ((place[head] == place[tail]) | (place[head] == place[tail] + 1))
        # A connector serves the step from road i to i + 1 if it can be entered from the one and leads
        # to the other by way of such connectors. Lanes on no path cost nothing.
        for i in range(len(roads) - 1):
            reached = _closure(place == i, tail, head, inside)
            leads = _closure(place == i + 1, head, tail, inside)
            via = inside & reached & leads
            enters, stays, leaves = (
                (place[tail] == i) & via[head],
                via[tail] & via[head],
                via[tail] & (place[head] == i + 1),
            )
            allowed |= enters | stays | leaves
        return allowed

    def _cost_to_go(
        self,
        ahead: NDArray[np.int_],
        is_goal: NDArray[np.bool_],
        change_penalty: float,
        short_penalty: float,
    ) -> Floats:
        """Cost (m) of the best way from each lane to each goal."""
        size, count = is_goal.shape
        # Reversed links, and from every goal (a node of its own) to the ends of its lanes.
        row, goal = np.nonzero(is_goal)
        links = np.concatenate([ahead, self.left, self.right, np.column_stack([row, size + goal])])
        # Where a lane is too short to change on, earlier is better.
        room = self.length[np.concatenate([self.left, self.right])[:, 0]]
        changes = max(change_penalty, 1e-6) + short_penalty * np.clip(1 - room / ROOM_TO_CHANGE, 0, 1)
        if short_penalty:
            changes += np.where(room < NO_ROOM, NO_WAY, 0)
        costs = np.concatenate([self.cost[ahead[:, 0]], changes, self.cost[row]])
        graph = _matrix(links[:, ::-1], np.maximum(costs, 1e-6), size + count)
        if not count:
            return np.full((size, count), np.inf)
        return dijkstra(graph, indices=size + np.arange(count))[:, :size].T

    def pass_goal(self, table: RouteTable, column: int) -> None:
        """Let the lanes of a goal lead on: no vehicle arrives there."""
        first = {tail: head for tail, head in self.ahead[::-1].tolist()}
        for row in np.nonzero(np.asarray(table.is_goal)[:, column])[0].tolist():
            np.asarray(table.next_lane)[row, column] = first[row]
            np.asarray(table.is_goal)[row, column] = False

    def solve(
        self,
        goals: Sequence[Sequence[int]],
        change_penalty: float,
        tolerance: float,
        mask: NDArray[np.bool_] | None = None,
        short_penalty: float = SHORT_PENALTY,
    ) -> RouteTable:
        """The tables of these goals, with the null lane last.

        `goals` are groups of rows of lanes. `mask` keeps some of the links ahead.
        """
        size, count = len(self.lanes), len(goals)
        ahead = self.ahead if mask is None else self.ahead[mask]
        is_goal = np.zeros((size, count), bool)
        for g, members in enumerate(goals):
            is_goal[[row for row in members if self.lanes[row].id in self.usable], g] = True

        cost = self._cost_to_go(ahead, is_goal, change_penalty, short_penalty)

        behind, next_lane = _best(ahead, cost)
        next_lane[is_goal] = -1
        own = self.cost[:, None]
        straight = np.where(is_goal, own, own + behind)
        next_lane[straight > cost + NO_WAY / 2] = -1
        # A vehicle stays in a lane where that costs almost nothing, half of the length of the lane at
        # most, so that the cost to go falls along the way.
        stays = straight <= cost + np.minimum(tolerance, 0.5 * own) + 1e-6
        cost_left, to_left = _best(self.left, cost)
        cost_right, to_right = _best(self.right, cost)
        reachable = np.isfinite(cost)
        changes_left = reachable & ~stays & (cost_left < cost_right)
        changes_right = reachable & ~stays & ~changes_left

        # Follow the successors, in jumps that double, to the lane where a change is due.
        itself = np.broadcast_to(np.arange(size)[:, None], (size, count))
        moves = reachable & stays & ~is_goal
        at = np.where(moves, next_lane, itself)
        passed = np.where(moves, self.length[:, None], 0.0)
        columns = np.broadcast_to(np.arange(count), (size, count))
        while True:
            further = at[at, columns]
            if (further == at).all():
                break
            passed, at = passed + passed[at, columns], further
        step = np.where(changes_left, 1, np.where(changes_right, -1, 0))
        beside = np.where(changes_left, to_left, np.where(changes_right, to_right, itself))
        aside = _count_changes(step, beside)
        lanes_to_go = aside[at, columns]
        due = lanes_to_go != 0
        table = RouteTable(
            distance=np.where(reachable, cost, FAR).astype(np.float32),
            next_lane=next_lane.astype(np.int32),
            lanes_to_go=lanes_to_go.astype(np.int32),
            change_distance=np.where(due, passed + self.length[at], FAR).astype(np.float32),
            reachable=reachable,
            is_goal=is_goal,
        )
        return table.pad(lanes=size + 1, goals=count)


def _best(pairs: NDArray[np.int_], cost: Floats) -> tuple[Floats, NDArray[np.int_]]:
    """Least cost behind the links of each lane, and the lane there.

    Both are `[lanes, goals]`. Lanes without a link have cost infinity and lane -1.
    """
    least, which = np.full(cost.shape, np.inf), np.full(cost.shape, -1)
    if not len(pairs):
        return least, which
    for n in range(int(np.bincount(pairs[:, 0]).max())):
        nth = _nth_of_each(pairs, n)
        tail, head = nth.T
        better = cost[head] < least[tail]
        which[tail] = np.where(better, head[:, None], which[tail])
        least[tail] = np.where(better, cost[head], least[tail])
    return least, which


def _count_changes(step: NDArray[np.int_], beside: NDArray[np.int_]) -> NDArray[np.int_]:
    """Consecutive lane changes from each lane, `[lanes, goals]`, left > 0.

    Args:
        step: the change on each lane: 1 left, -1 right, 0 none.
        beside: the lane behind that change.
    """
    size, count = step.shape
    columns = np.broadcast_to(np.arange(count), step.shape)
    aside = np.zeros(step.shape, int)
    lane = np.broadcast_to(np.arange(size)[:, None], step.shape)
    while True:
        continues = (step[lane, columns] == step) & (step != 0)
        if not continues.any():
            return aside
        aside, lane = aside + continues * step, np.where(continues, beside[lane, columns], lane)


def _matrix(links: NDArray[np.int_], costs: Floats, size: int) -> csr_array:
    """Sparse adjacency matrix; of parallel links the cheapest counts."""
    order = np.lexsort((costs, links[:, 1], links[:, 0]))
    links, costs = links[order], costs[order]
    first = np.ones(len(links), bool)
    first[1:] = (links[1:] != links[:-1]).any(1)
    return csr_array((costs[first], (links[first, 0], links[first, 1])), shape=(size, size))


def _nth_of_each(pairs: NDArray[np.int_], n: int) -> NDArray[np.int_]:
    """The n-th link of every lane that has more than n."""
    order = np.argsort(pairs[:, 0], kind="stable")
    pairs = pairs[order]
    first = np.searchsorted(pairs[:, 0], pairs[:, 0])
    return pairs[np.arange(len(pairs)) - first == n]


def _closure(
    start: NDArray[np.bool_], tail: NDArray[np.int_], head: NDArray[np.int_], within: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Nodes that are reached from `start` by links tail -> head.

    Only nodes of `within` count, as stops and on the way.
    """
    reached = start.copy()
    while True:
        more = np.zeros_like(reached)
        more[head[reached[tail]]] = True
        more &= within & ~reached
        if not more.any():
            return reached & within
        reached |= more
