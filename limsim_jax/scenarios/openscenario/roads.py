"""Places of a scenario on a map, and corridors of its entities.

A corridor is a chain of lanes, one after the other, with the lanes beside it: its base line is the middle of
the chain. An entity is `s` m along the base line and `t` m to its left. All in float64, in the coordinates
of the file.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections import Counter, defaultdict
from collections.abc import Iterable
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps.map import Map
from limsim_jax.maps.network import ImportReport, Lane
from limsim_jax.maps.opendrive.lanes import RoadShape
from limsim_jax.maps.opendrive.parser import Parser
from limsim_jax.maps.xml import XmlReader, read_bytes

Floats = NDArray[np.float64]

SPACING = 4.0
"""m between the points of a corridor; between them it is a cubic with the right tangents."""

AHEAD = 3000.0
"""m of a corridor ahead of its entity, at most; straight on from there."""

BEHIND = 400.0
"""m of a corridor behind."""

SIDE = 7
"""Lanes to either side of the base line that a corridor knows."""

ACROSS = math.radians(40)
"""Angle to its lane from which an entity moves straight on, not along the lane."""

_TRIES = 3  # nearest points of a lane that point one way, from which its foot is searched
_NEAR = 30.0  # m from a lane within which a place is on its corridor
_STRAIGHT = 1000.0  # m of a corridor that is no road


class Pose(NamedTuple):
    """A place in the plane."""

    x: float  # m
    y: float  # m
    h: float  # rad


class Spot(NamedTuple):
    """A place on a lane of the network."""

    lane: Lane
    s: float  # m along the lane
    d: float  # m, left > 0 in the direction of the lane


class PlaceError(ValueError):
    """What is wrong with a place: a road or lane that is not there."""


class Corridor(NamedTuple):
    """A chain of lanes as points; `P` points, `M` = 2 SIDE + 1 lanes, the base in column SIDE."""

    x: Floats  # [P] m
    y: Floats
    h: Floats  # [P] rad
    center: Floats  # [P, M] m, middle of each lane to the left of the base line
    half: Floats  # [P, M] m, half its width; 0: no lane
    number: NDArray[np.int64]  # [P, M], in the file; 0: no lane
    sign: Floats  # [P], 1 where the road's coordinate grows, -1 where it falls
    start: float  # m of the first point along the corridor: its entity starts near 0
    roads: tuple[tuple[str, float, float], ...]  # road, and its coordinate at the start and the end


class Roads:
    """Look-ups on the host."""

    def __init__(self, town: Map) -> None:
        self.town, self.network = town, town.network
        # variants of a scenario start in few places
        self.nearest = lru_cache(4096)(self._nearest)
        self._corridor_of = lru_cache(256)(self._made_corridor)
        self._lanes: dict[str, dict[int, list[Lane]]] = defaultdict(lambda: defaultdict(list))
        for lane in self.network.lanes.values():
            self._lanes[lane.road][lane.number].append(lane)

    # --- places

    def lane(self, road: str, number: int, s: float) -> Lane:
        """The lane of a road at its coordinate `s`.

        Raises:
          PlaceError: there is none.
        """
        if road not in self._lanes:
            known = ", ".join(sorted(self._lanes)[:8])
            raise PlaceError(f"there is no road '{road}'; roads are {known}")
        if number not in self._lanes[road]:
            known = ", ".join(str(x) for x in sorted(self._lanes[road]))
            raise PlaceError(f"road '{road}' has no lane {number}; lanes are {known}")

        def away(lane: Lane) -> float:
            low, high = sorted((lane.road_s[0], lane.road_s[-1]))
            return max(low - s, s - high, 0.0)

        found = min(self._lanes[road][number], key=away)
        if away(found) > 1.0:
            low = min(min(x.road_s[0], x.road_s[-1]) for x in self._lanes[road][number])
            high = max(max(x.road_s[0], x.road_s[-1]) for x in self._lanes[road][number])
            raise PlaceError(f"s = {s:g} is not on lane {number} of road '{road}', from {low:g} to {high:g}")
        return found

    def on_lane(self, road: str, number: int, s: float, offset: float) -> tuple[Pose, Spot]:
        """A place on a lane, heading along the lane; `offset` to the left of the road's direction."""
        lane = self.lane(road, number, s)
        arc = float(lane.s_at_road(s))
        d = offset if forward(lane) else -offset
        return self.at(Spot(lane, arc, d)), Spot(lane, arc, d)

    def at(self, spot: Spot) -> Pose:
        """Where a spot is, heading along its lane."""
        (x, y, _), h = spot.lane.pose(spot.s)
        h = float(h)
        return Pose(float(x) - spot.d * math.sin(h), float(y) + spot.d * math.cos(h), h)

    @cached_property
    def _shapes(self) -> dict[str, RoadShape]:
        """Reference lines of an OpenDRIVE file."""
        path = self.network.source
        reader = XmlReader(path)
        parser = Parser(reader, ImportReport())
        return {
            str(element.get("id")): RoadShape(parser.road(element))
            for _, element in reader.children(read_bytes(path), "OpenDRIVE")
            if element.tag == "road"
        }

    def on_road(self, road: str, s: float, t: float) -> Pose:
        """A place by road coordinates, heading along the road.

        Raises:
          PlaceError: there is no such road, or the map is no OpenDRIVE.
        """
        if not self.network.format.lower().startswith("opendrive"):
            raise PlaceError("road coordinates need an OpenDRIVE map")
        if road not in self._shapes:
            raise PlaceError(f"there is no road '{road}'; roads are {', '.join(sorted(self._shapes)[:8])}")
        length = self._shapes[road].road.length
        if not -1e-3 <= s <= length + 1e-3:
            raise PlaceError(f"s = {s:g} is not on road '{road}', which is {length:g} m long")
        x, y, _, h = self._shapes[road].point(s, t)
        return Pose(x, y, h)

    @cached_property
    def _points(self) -> tuple[Floats, list[tuple[Lane, float, float]]]:
        """Points of all lanes that carry motor traffic, about 5 m apart: lane, m along it, its heading."""
        where, what = [], []
        for lane in self.network.lanes.values():
            if not lane.drivable:
                continue
            places = np.linspace(0, lane.length, max(2, int(lane.length / 5) + 1))
            xyz, heading = lane.pose(places)
            where.append(xyz[:, :2])
            what += [(lane, float(s), float(h)) for s, h in zip(places, heading, strict=True)]
        return np.concatenate(where), what

    def _nearest(self, pose: Pose) -> Spot | None:
        """The lane on which a pose is: of those near, one that points the same way."""
        where, what = self._points
        away = np.hypot(where[:, 0] - pose.x, where[:, 1] - pose.y)
        best: tuple[float, Spot] | None = None
        near = np.flatnonzero(away <= _NEAR)
        seen: Counter[tuple[str, bool]] = Counter()
        for k in near[np.argsort(away[near])]:
            lane, s, h = what[k]
            key = lane.id, math.cos(h - pose.h) > 0
            if seen[key] == _TRIES:
                continue
            seen[key] += 1
            spot = foot(lane, s, pose)
            misfit = abs(spot.d) + 5 * max(-spot.s, spot.s - lane.length, 0.0)
            h = self.at(spot._replace(s=min(max(spot.s, 0.0), lane.length))).h
            misfit += 0.0 if math.cos(h - pose.h) > 0 else 1.6
            if best is None or misfit < best[0]:
                best = misfit, spot
        return None if best is None else best[1]

    # --- corridors

    def corridor(self, spot: Spot | None, pose: Pose, route: Iterable[Lane] = ()) -> Corridor:
        """The corridor of an entity that starts in a pose.

        It goes on over the straightest ways, or over the lanes of a route. An entity that points across its
        lane moves straight on; one that points against it drives the chain the other way.
        """
        if spot is None:
            return straight(pose)
        return self._corridor_of(spot.lane.id, spot.s, spot.d, pose, tuple(x.id for x in route))

    def _made_corridor(self, lane: str, s: float, d: float, pose: Pose, route: tuple[str, ...]) -> Corridor:
        spot = Spot(self.network.lanes[lane], s, d)
        h = self.at(spot).h
        turned = abs(math.remainder(pose.h - h, 2 * math.pi))
        if ACROSS < turned < math.pi - ACROSS:
            return straight(pose)
        against = turned > math.pi / 2
        chain, start = self._chain(spot, [self.network.lanes[x] for x in route], against)
        return self._points_of(chain, start, against)

    def _chain(self, spot: Spot, route: list[Lane], against: bool) -> tuple[list[Lane], float]:
        """Lanes in the direction of travel, and where the spot is (m)."""
        here = spot.lane
        first = spot.lane.length - spot.s if against else spot.s
        chain, length = [here], here.length - first
        way = route[route.index(here) + 1 :] if here in route else []
        while length < AHEAD:
            last = chain[-1]
            if way:
                following: Lane | None = way.pop(0)
            else:
                following = self._next(last, last.predecessors if against else last.successors, against)
            if following is None or following in chain:
                break
            chain.append(following)
            length += following.length
        before = first
        while before < BEHIND:
            head = chain[0]
            previous = self._next(head, head.successors if against else head.predecessors, not against)
            if previous is None or previous in chain:
                break
            chain.insert(0, previous)
            before += previous.length
        return chain, before

    def _next(self, lane: Lane, names: Iterable[str], backwards: bool) -> Lane | None:
        """The lane by which the way goes straight on."""
        others = [self.network.lanes[x] for x in names if x in self.network.lanes]
        if not others:
            return None
        leaving = lane.heading[0] if backwards else lane.heading[-1]

        def turn(other: Lane) -> float:
            far = other.heading[0] if backwards else other.heading[-1]
            return abs(math.remainder(float(far - leaving), 2 * math.pi))

        return min(others, key=turn)

    def _points_of(self, chain: list[Lane], start: float, against: bool) -> Corridor:
        """Points along a chain, from `BEHIND` m before its start on."""
        ends = np.cumsum([lane.length for lane in chain])
        low, high = max(start - BEHIND, 0.0), min(start + AHEAD, float(ends[-1]))
        count = max(2, math.ceil((high - low) / SPACING) + 1)
        at = low + SPACING * np.arange(count)
        which = np.minimum(np.searchsorted(ends, at, side="left"), len(chain) - 1)
        along = at - np.concatenate([[0.0], ends])[which]
        columns = 2 * SIDE + 1
        x, y, h = np.zeros(count), np.zeros(count), np.zeros(count)
        center, half = np.zeros((count, columns)), np.zeros((count, columns))
        number, sign = np.zeros((count, columns), np.int64), np.ones(count)
        roads = []
        for k, lane in enumerate(chain):
            mine = np.flatnonzero(which == k)
            if not mine.size:
                continue
            s = lane.length - along[mine] if against else along[mine]
            beyond = np.maximum(along[mine] - lane.length, 0)  # the last point may lie past the end
            xyz, heading = lane.pose(s)
            heading = heading + (math.pi if against else 0.0)
            x[mine] = xyz[:, 0] + beyond * np.cos(heading)
            y[mine] = xyz[:, 1] + beyond * np.sin(heading)
            h[mine] = heading
            ahead = forward(lane) != against
            sign[mine] = 1 if ahead else -1
            road_s = np.interp(s, lane.s, lane.road_s)
            roads.append((lane.road, float(road_s[0]), float(road_s[-1])))
            normal = np.stack([-np.sin(heading), np.cos(heading)], -1)
            for column, other in self._beside(lane, ahead):
                place, width = self._section(other, road_s)
                there = np.isfinite(width)
                offset = ((place - xyz[:, :2]) * normal).sum(-1)
                rows = mine[there]
                center[rows, column] = offset[there]
                half[rows, column] = width[there] / 2
                number[rows, column] = other[0].number
        _fill(center, half)
        return Corridor(x, y, np.unwrap(h), center, half, number, sign, low - start, tuple(roads))

    def _beside(self, lane: Lane, ahead: bool) -> list[tuple[int, list[Lane]]]:
        """Lanes of the same road by their column."""

        def rank(number: int) -> int:
            return number if number < 0 else number - 1

        found = []
        for number, lanes in self._lanes[lane.road].items():
            if number == 0:
                continue
            column = SIDE + (rank(number) - rank(lane.number)) * (1 if ahead else -1)
            if 0 <= column < 2 * SIDE + 1:
                found.append((column, lanes))
        return found

    def _section(self, lanes: list[Lane], road_s: Floats) -> tuple[Floats, Floats]:
        """Middle `[n, 2]` and width `[n]` of a lane along its road.

        NaN where there is none.
        """
        place, width = np.full((len(road_s), 2), np.nan), np.full(len(road_s), np.nan)
        for lane in lanes:
            low, high = sorted((lane.road_s[0], lane.road_s[-1]))
            mine = (road_s >= low - 1e-3) & (road_s <= high + 1e-3)
            if mine.any():
                s = lane.s_at_road(road_s[mine])
                place[mine] = lane.pose(s)[0][:, :2]
                width[mine] = lane.width_at(s)
        return place, width

    # --- routes

    def route(self, stops: list[Spot]) -> list[Lane]:
        """The shortest row of lanes past some places.

        Raises:
          PlaceError: there is no way.
        """
        way = [stops[0].lane]
        for before, after in itertools.pairwise(stops):
            found = self._way(way[-1], before.s, after)
            if found is None:
                raise PlaceError(f"there is no way from lane {way[-1].id} to lane {after.lane.id}")
            way[-1:] = found  # it may begin on a lane beside the last one, which is then left at once
        return way

    def _way(self, start: Lane, s: float, goal: Spot) -> list[Lane] | None:
        """Dijkstra over successors; a lane beside the goal does as well, on the same road."""
        ends = {goal.lane.id} | {
            lane.id
            for lane in self.network.lanes.values()
            if lane.drivable and lane.carriageway == goal.lane.carriageway
        }
        starts = [
            x for x in self.network.lanes.values() if x.drivable and x.carriageway == start.carriageway
        ] or [start]
        queue: list[Any] = [(0.0 if x is start else 50.0, k, x.id, (x.id,)) for k, x in enumerate(starts)]
        heapq.heapify(queue)
        done: set[str] = set()
        while queue:
            cost, tie, name, path = heapq.heappop(queue)
            if name in done:
                continue
            done.add(name)
            lane = self.network.lanes[name]
            if name in ends and (len(path) > 1 or goal.s >= s - 1.0):
                return [self.network.lanes[x] for x in path]
            for other in lane.successors:
                if other in self.network.lanes:
                    wrong = 20.0 if other in ends and other != goal.lane.id else 0.0
                    heapq.heappush(queue, (cost + lane.length + wrong, tie, other, (*path, other)))
        return None


def forward(lane: Lane) -> bool:
    """Whether the lane runs in the direction of its road."""
    return bool(lane.road_s[-1] >= lane.road_s[0])


def foot(lane: Lane, s: float, pose: Pose) -> Spot:
    """The place on a lane nearest to a pose, from a guess."""
    for _ in range(8):
        clipped = min(max(s, 0.0), lane.length)
        (x, y, _), h = lane.pose(clipped)
        ahead = (pose.x - x) * math.cos(h) + (pose.y - y) * math.sin(h)
        s = clipped + float(ahead)
        if abs(ahead) < 1e-6 or s <= 0 or s >= lane.length:
            break
    clipped = min(max(s, 0.0), lane.length)
    (x, y, _), h = lane.pose(clipped)
    d = (pose.y - float(y)) * math.cos(h) - (pose.x - float(x)) * math.sin(h)
    return Spot(lane, s, float(d))


def straight(pose: Pose) -> Corridor:
    """A corridor that is no road: straight on."""
    count = int(_STRAIGHT / SPACING) + 1
    s = SPACING * (np.arange(count) - count // 4)
    columns = 2 * SIDE + 1
    nothing = np.zeros((count, columns))
    return Corridor(
        np.asarray(pose.x + s * math.cos(pose.h), np.float64),
        np.asarray(pose.y + s * math.sin(pose.h), np.float64),
        np.full(count, pose.h),
        nothing,
        nothing.copy(),
        np.zeros((count, columns), np.int64),
        np.ones(count),
        float(s[0]),
        (),
    )


def _fill(center: Floats, half: Floats) -> None:
    """Give lanes that are not there a middle: the edge of the road."""
    for step in (1, -1):
        for k in range(1, SIDE + 1):
            column, inner = SIDE + step * k, SIDE + step * (k - 1)
            missing = half[:, column] == 0
            center[missing, column] = center[missing, inner] + step * half[missing, inner]
