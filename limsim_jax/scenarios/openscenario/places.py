"""Positions of a scenario as poses on a map, at its start."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import BSpline

from limsim_jax.scenarios.openscenario.roads import (
    SIDE,
    SPACING,
    Corridor,
    PlaceError,
    Pose,
    Roads,
    Spot,
    foot,
    forward,
)
from limsim_jax.scenarios.openscenario.storyboard import (
    LanePosition,
    Orientation,
    Position,
    RelativeLanePosition,
    RelativeObjectPosition,
    RelativeRoadPosition,
    RelativeWorldPosition,
    RoadPosition,
    RoutePosition,
    Trajectory,
    TrajectoryPosition,
    WorldPosition,
)

Floats = NDArray[np.float64]

_CURVE = 0.5
"""m between the points of a clothoid or spline."""


class Placed(NamedTuple):
    """A pose, and the lane on which it is."""

    pose: Pose
    spot: Spot | None


class Path(NamedTuple):
    """A trajectory as points: x, y (m), heading (rad); times (s) or NaN."""

    points: Floats  # [V, 3]
    times: Floats  # [V]
    local: bool  # from where the entity is


RELATIVE = (
    RelativeLanePosition,
    RelativeRoadPosition,
    RelativeObjectPosition,
    RelativeWorldPosition,
)


class Placer:
    """Resolves positions.

    Attributes:
      roads: the map.
      at: where entities are at the start, as far as it is known.
      corridors: of those entities.
    """

    def __init__(self, roads: Roads) -> None:
        self.roads = roads
        self.at: dict[str, Placed] = {}
        self.corridors: dict[str, Corridor] = {}

    def put(self, name: str, placed: Placed) -> None:
        """Place an entity."""
        self.at[name] = placed
        self.corridors[name] = self.roads.corridor(placed.spot, placed.pose)

    def known(self, position: Position) -> bool:
        """Whether the entity that a position is relative to has its place."""
        return not isinstance(position, RELATIVE) or position.entity in self.at

    def place(self, position: Position) -> Placed:
        """The pose of a position at the start.

        Raises:
          PlaceError: a road, lane or way that is not there.
        """
        if isinstance(position, WorldPosition):
            return self._near(Pose(position.x, position.y, position.h))
        if isinstance(position, LanePosition):
            pose, spot = self.roads.on_lane(position.road, position.lane, position.s, position.offset)
            road = pose.h + (0.0 if forward(spot.lane) else math.pi)
            return Placed(pose._replace(h=turned(position.orientation, pose.h, road)), spot)
        if isinstance(position, RoadPosition):
            pose = self.roads.on_road(position.road, position.s, position.t)
            placed = self._near(pose)
            lane = pose.h if placed.spot is None else self.roads.at(placed.spot).h
            aligned = lane if abs(math.cos(lane - pose.h)) > 0.5 else pose.h
            return placed._replace(pose=pose._replace(h=turned(position.orientation, aligned, pose.h)))
        if isinstance(position, RoutePosition):
            return self._on_route(position)
        if isinstance(position, TrajectoryPosition):
            path = self.path(position.trajectory)
            x, y, h = at_way(path.points, position.s)
            pose = Pose(x - position.t * math.sin(h), y + position.t * math.cos(h), h)
            return self._near(pose._replace(h=turned(position.orientation, h, h)))
        if position.entity not in self.at:
            raise PlaceError(f"'{position.entity}' has no place yet")
        return self._relative(position)

    def _relative(self, position: Position) -> Placed:
        assert isinstance(position, RELATIVE)
        pose = self.at[position.entity].pose
        if isinstance(position, RelativeWorldPosition):
            moved = Pose(pose.x + position.dx, pose.y + position.dy, pose.h)
            return self._near(moved._replace(h=turned(position.orientation, pose.h, pose.h)))
        if isinstance(position, RelativeObjectPosition):
            c, s = math.cos(pose.h), math.sin(pose.h)
            moved = Pose(
                pose.x + c * position.dx - s * position.dy, pose.y + s * position.dx + c * position.dy, pose.h
            )
            return self._near(moved._replace(h=turned(position.orientation, pose.h, pose.h)))
        corridor = self.corridors[position.entity]
        s, t = project(corridor, pose)
        if isinstance(position, RelativeRoadPosition):
            s, t = s + position.ds, t + position.dt
        else:
            column = nearest_column(corridor, s, t) + position.lanes
            s = s + position.ds
            row = row_of(corridor, s)
            if not 0 <= column < 2 * SIDE + 1 or corridor.half[row, column] == 0:
                raise PlaceError(f"there is no lane {position.lanes:+d} beside '{position.entity}'")
            t = float(column_center(corridor, s, column)) + position.offset * corridor.sign[row]
        found = point(corridor, s, t)
        sign = corridor.sign[row_of(corridor, s)]
        road = found.h + (0.0 if sign > 0 else math.pi)
        placed = self._near(found)
        return placed._replace(pose=found._replace(h=turned(position.orientation, found.h, road)))

    def _on_route(self, position: RoutePosition) -> Placed:
        spots = []
        for stop in position.route.waypoints:
            placed = self.place(stop)
            if placed.spot is None:
                raise PlaceError(f"a waypoint of route '{position.route.name}' is on no lane")
            spots.append(placed)
        first = spots[0]
        lanes = self.roads.route([x.spot for x in spots if x.spot is not None])
        start = foot(lanes[0], first.spot.s, first.pose)
        corridor = self.roads.corridor(start, self.roads.at(start), lanes)
        s = position.s
        row = row_of(corridor, s)
        if position.lane is None:
            t = position.t * corridor.sign[row]
        else:
            columns = np.flatnonzero(corridor.number[row] == position.lane)
            if not columns.size:
                raise PlaceError(f"route '{position.route.name}' has no lane {position.lane} at {s:g} m")
            t = float(column_center(corridor, s, int(columns[0]))) + position.t * corridor.sign[row]
        pose = point(corridor, s, t)
        return self._near(pose._replace(h=turned(position.orientation, pose.h, pose.h)))

    def _near(self, pose: Pose) -> Placed:
        return Placed(pose, self.roads.nearest(pose))

    # --- trajectories

    def path(self, trajectory: Trajectory) -> Path:
        """The points of a trajectory."""
        if trajectory.clothoids:
            return self._clothoids(trajectory)
        poses = [self.place(x).pose for x in trajectory.points]
        corners = np.array([[x.x, x.y] for x in poses])
        if trajectory.nurbs is not None:
            return self._nurbs(trajectory, corners)
        times = np.full(len(corners), np.nan) if trajectory.times is None else np.array(trajectory.times)
        return Path(with_headings(corners), times, False)

    def _nurbs(self, trajectory: Trajectory, corners: Floats) -> Path:
        nurbs = trajectory.nurbs
        assert nurbs is not None
        weight = np.array(nurbs.weights)
        knots, degree = np.array(nurbs.knots, float), nurbs.order - 1
        low, high = knots[degree], knots[len(corners)]
        if not high > low:
            raise PlaceError(f"trajectory '{trajectory.name}': its knots span nothing")
        around = np.hypot(*np.diff(corners, axis=0).T).sum()
        u = np.linspace(low, high, max(2, min(4000, int(around / _CURVE) + 2)))
        above = BSpline(knots, corners * weight[:, None], degree)(u)
        below = BSpline(knots, weight, degree)(u)
        found = above / below[:, None]
        times = np.full(len(u), np.nan)
        if trajectory.times is not None:
            given = np.array(trajectory.times)
            greville = np.array([knots[k + 1 : k + degree + 1].mean() for k in range(len(corners))])
            times = np.interp(u, greville, given)
        return Path(with_headings(found), times, False)

    def _clothoids(self, trajectory: Trajectory) -> Path:
        first = trajectory.clothoids[0]
        local = first.start is None
        pose = Pose(0.0, 0.0, 0.0) if first.start is None else self.place(first.start).pose
        points, times = [np.array([[pose.x, pose.y, pose.h]])], [np.array([0.0])]
        for k, piece in enumerate(trajectory.clothoids):
            if piece.start is not None and k:
                pose = self.place(piece.start).pose
            pose = pose._replace(h=pose.h + piece.turn)
            count = max(1, math.ceil(piece.length / _CURVE))
            s = np.linspace(0, piece.length, count + 1)
            fine = np.linspace(0, piece.length, 16 * count + 1)
            heading = pose.h + piece.begin * fine + (piece.end - piece.begin) / piece.length * fine**2 / 2
            xs = pose.x + cumulative_trapezoid(np.cos(heading), fine, initial=0)
            ys = pose.y + cumulative_trapezoid(np.sin(heading), fine, initial=0)
            found = np.stack([xs, ys, heading], -1)[::16]
            points.append(found[1:])
            if trajectory.times is not None:
                low, high = trajectory.times[k], trajectory.times[k + 1]
                times.append(low + (high - low) * s[1:] / piece.length)
                times[0][0] = trajectory.times[0]
            else:
                times.append(np.full(count, np.nan))
            pose = Pose(*(float(x) for x in found[-1]))
        return Path(np.concatenate(points), np.concatenate(times), local)


def turned(orientation: Orientation | None, along: float, road: float) -> float:
    """A heading: along the lane, relative to the road, or absolute."""
    if orientation is None:
        return along
    return road + orientation.h if orientation.relative else orientation.h


def with_headings(corners: Floats) -> Floats:
    """Points with the direction of the piece that follows; pieces without length take that before."""
    steps = np.diff(corners, axis=0)
    headings = np.arctan2(steps[:, 1], steps[:, 0])
    for k in range(len(headings)):
        if np.hypot(*steps[k]) < 1e-9:
            headings[k] = headings[k - 1] if k else 0.0
    headings = np.append(headings, headings[-1])
    return np.concatenate([corners, np.unwrap(headings)[:, None]], -1)


def ways(points: Floats) -> Floats:
    """m from the start of a path to each of its points."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points[:, :2], axis=0).T))])


def at_way(points: Floats, s: float) -> tuple[float, float, float]:
    """x, y, heading at some metres from the start of a path."""
    way = ways(points)
    k = int(np.clip(np.searchsorted(way, s, side="right") - 1, 0, len(way) - 2))
    length = way[k + 1] - way[k]
    u = (s - way[k]) / length if length > 0 else 0.0
    x, y = points[k, :2] + u * (points[k + 1, :2] - points[k, :2])
    return float(x), float(y), float(points[k, 2])


# --- corridors on the host


def row_of(corridor: Corridor, s: float) -> int:
    """The point of a corridor before `s` m."""
    return int(np.clip(math.floor((s - corridor.start) / SPACING), 0, len(corridor.x) - 1))


def point(corridor: Corridor, s: float, t: float) -> Pose:
    """A place on a corridor: cubic between its points, straight on beyond them."""
    k = min(row_of(corridor, s), len(corridor.x) - 2)
    u = (s - corridor.start) / SPACING - k
    inside = min(max(u, 0.0), 1.0)
    p = np.stack([corridor.x, corridor.y], -1)[k : k + 2]
    m = SPACING * np.stack([np.cos(corridor.h), np.sin(corridor.h)], -1)[k : k + 2]
    v = inside
    place = p[0] * (1 + 2 * v) * (1 - v) ** 2 + m[0] * v * (1 - v) ** 2
    place = place + p[1] * v**2 * (3 - 2 * v) - m[1] * v**2 * (1 - v)
    slope = 6 * v * (1 - v) * (p[1] - p[0]) + m[0] * (1 - v) * (1 - 3 * v) - m[1] * v * (2 - 3 * v)
    h = math.atan2(slope[1], slope[0])
    rest = (u - inside) * SPACING
    x = float(place[0]) + rest * math.cos(h) - t * math.sin(h)
    y = float(place[1]) + rest * math.sin(h) + t * math.cos(h)
    return Pose(x, y, h)


def project(corridor: Corridor, pose: Pose) -> tuple[float, float]:
    """`s`, `t` (m) of a pose on a corridor."""
    k = int(np.argmin((corridor.x - pose.x) ** 2 + (corridor.y - pose.y) ** 2))
    s = corridor.start + SPACING * k
    for _ in range(12):
        base = point(corridor, s, 0.0)
        ahead = (pose.x - base.x) * math.cos(base.h) + (pose.y - base.y) * math.sin(base.h)
        s += ahead
        if abs(ahead) < 1e-9:
            break
    base = point(corridor, s, 0.0)
    return s, (pose.y - base.y) * math.cos(base.h) - (pose.x - base.x) * math.sin(base.h)


def column_center(corridor: Corridor, s: float, column: int) -> float:
    """Middle (m) of a lane at `s` m, linear between points."""
    at = (s - corridor.start) / SPACING
    return float(np.interp(at, np.arange(len(corridor.x)), corridor.center[:, column]))


def nearest_column(corridor: Corridor, s: float, t: float) -> int:
    """The lane at a place; the nearest one beside all."""
    row = row_of(corridor, s)
    there = corridor.half[row] > 0
    if not there.any():
        return SIDE
    return int(np.argmin(np.where(there, np.abs(corridor.center[row] - t), np.inf)))
