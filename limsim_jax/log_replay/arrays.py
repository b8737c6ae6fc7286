"""A recorded scene as arrays: the log, and how paths lie to each other.

A vehicle that is taken over keeps to the path of its own log and only shifts in time, so it is one number,
metres along its path. Where every path lies seen from every other one does not depend on what happens: it
is looked up here once, on the host, and a thousand variants of the scene share it.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.spatial import KDTree

from limsim_jax.maps.lane_map import NO_LANE, LaneMap, lane_ids, project, relative
from limsim_jax.maps.network import Network
from limsim_jax.recordings.tracks import Tracks
from limsim_jax.types import Driver
from limsim_jax.xla import interval

GRID = 1.0
"""m between the points of a path."""

ONWARD = 100.0
"""m for which paths go on beyond the end of their log, along the lanes."""

FAR = 1e3
"""m, offset of what is not beside a path at all."""

MARGIN = 0.3
"""m beside the two bodies within which one is in the way of the other."""

_REACH = 10.0  # m beside a path within which others are placed on it
_STEADY = 5  # points over which the heading of a path is the mean: recorded bodies jitter
_TIGHTER = 0.75  # factor on the gaps in the log down to which car following does not act on a return
_MOST_PAIRS = 5e8  # numbers in the table of paths

Floats = NDArray[np.float64]


@struct.dataclass(frozen=True, kw_only=True)
class Log:
    """What was recorded, at `T` moments, of `N` vehicles; harmless numbers where not `valid`."""

    x: Float[Array, "T N"]  # m, middle of the body, in coordinates of the lane map
    y: Float[Array, "T N"]
    heading: Float[Array, "T N"]  # rad, without jumps
    v: Float[Array, "T N"]  # m/s
    lane: Int[Array, "T N"]  # row of the lane map on which the middle is, or NO_LANE
    s: Float[Array, "T N"]  # m, of the middle along that lane
    d: Float[Array, "T N"]  # m, left > 0
    valid: Bool[Array, "T N"]
    length: Float[Array, " N"]  # m
    width: Float[Array, " N"]  # m
    dt: float = struct.field(pytree_node=False)  # s


@struct.dataclass(frozen=True, kw_only=True)
class SceneArrays:
    """A log and what follows from it; `P` points `GRID` m apart on the path of every vehicle."""

    log: Log
    first: Int[Array, " N"]  # moment of the first and of the last entry
    last: Int[Array, " N"]
    p: Float[Array, "T N"]  # m along the own path
    path: Float[Array, "N P 4"]  # x, y (m), heading (rad), recorded speed (m/s)
    limit: Float[Array, " N"]  # m along the path, where the road or what was recorded of it ends
    lane: Int[Array, "N P"]  # row of the lane map under each point of the path, or NO_LANE
    lane_s: Float[Array, "N P"]  # m along it
    goal: Int[Array, " N"]  # column of the route table: where the log leads
    seen: Float[Array, "N P 4 N"]
    """[j, k, :, i]: point k of path j seen from path i: m along, m beside (left > 0), cos and sin of the
    angle between the two."""
    clearance: Float[Array, "T N N"]  # m between bodies of the log as `separation`
    touched: Bool[Array, "N N"]  # pairs that overlap in the log
    driver: Driver  # [N], as they drive in the log
    v0: Float[Array, " N"]  # m/s, desired speed of those taken over
    keeps: Bool[Array, " N"] | None = None  # never taken over: parked vehicles, pedestrians, cycles


def build_arrays(recorded: Tracks, lane_map: LaneMap) -> SceneArrays:
    """Arrays of a recorded scene; `lane_map`: of `recorded.network`.

    Raises:
      ValueError: a vehicle that is there at one moment only, or a scene too large for tables of pairs.
    """
    count, number = recorded.x.shape
    valid = recorded.valid
    first, last = valid.argmax(0), count - 1 - valid[::-1].argmax(0)
    for k in np.flatnonzero(first == last)[:1]:
        raise ValueError(
            f"{recorded.source}: vehicle {recorded.vehicles[k]}: one entry; at least two are expected"
        )
    x, y = relative(lane_map, np.nan_to_num(recorded.x), np.nan_to_num(recorded.y))
    x, y = x.astype(float), y.astype(float)
    heading, v = np.zeros_like(x), np.nan_to_num(recorded.v)
    p = np.zeros_like(x)
    for i in range(number):
        there = slice(first[i], last[i] + 1)
        heading[there, i] = np.unwrap(recorded.heading[there, i])
        # standing bodies jitter in recordings; a path leads forward only
        h = (heading[first[i] : last[i], i] + heading[first[i] + 1 : last[i] + 1, i]) / 2
        step = np.diff(x[there, i]) * np.cos(h) + np.diff(y[there, i]) * np.sin(h)
        p[first[i] + 1 : last[i] + 1, i] = np.cumsum(np.maximum(step, 0))
        p[last[i] + 1 :, i] = p[last[i], i]
    lane, s, d = _places(lane_map, x, y, heading)
    lane, s, d = np.where(valid, lane, NO_LANE), np.where(valid, s, 0), np.where(valid, d, 0)
    size = math.ceil((p[-1].max() + ONWARD) / GRID / 16) * 16
    if 4 * size * number**2 > _MOST_PAIRS:
        raise ValueError(
            f"{recorded.source}: {number} vehicles on paths of up to {p[-1].max():.0f} m; a shorter period "
            f"or fewer vehicles, up to {math.sqrt(_MOST_PAIRS / 4 / size):.0f} of them, are expected"
        )
    rows = _Onward(recorded.network, lane_map)
    path = np.zeros((number, size, 4))
    limit = np.zeros(number)
    for i in range(number):
        there = slice(first[i], last[i] + 1)
        values = np.stack([a[there, i] for a in (x, y, heading, v)], -1)
        at = last[i]
        onward, limit[i] = rows.walk(values[-1], lane[at, i], s[at, i], d[at, i])
        limit[i] += p[-1, i]
        way, once = np.unique(p[there, i], return_index=True)
        way = np.append(way, p[-1, i] + GRID * np.arange(1, len(onward) + 1))
        values = np.concatenate([values[once], onward])
        path[i] = _resampled(way, values, size)
    path[..., 2] = uniform_filter1d(path[..., 2], _STEADY, axis=-1, mode="nearest")
    path_lane, path_s, _ = _places(lane_map, *np.moveaxis(path[..., :3], -1, 0))
    seen = _seen(path)
    limit = np.minimum(limit, _edge(p, valid, seen))
    body = recorded.length, recorded.width
    boxes = np.stack([x, y, heading], -1)
    clearance = np.stack([_clearance(boxes[t], *body, valid[t]) for t in range(count)])
    # boxes are apart if they are in the frame of either
    touched = ((clearance < 0) & (clearance < 0).swapaxes(1, 2)).any(0)
    driver, v0 = _drivers(recorded, p, v, valid, seen)

    def floats(array: NDArray[Any]) -> Array:
        return jnp.asarray(array, jnp.float32)

    log = Log(
        x=floats(x), y=floats(y), heading=floats(heading), v=floats(v), lane=jnp.asarray(lane, jnp.int32),
        s=floats(s), d=floats(d), valid=jnp.asarray(valid), length=floats(recorded.length),
        width=floats(recorded.width), dt=recorded.dt,
    )  # fmt: skip
    return SceneArrays(
        log=log, first=jnp.asarray(first, jnp.int32), last=jnp.asarray(last, jnp.int32), p=floats(p),
        path=floats(path), limit=floats(limit),
        lane=jnp.asarray(path_lane, jnp.int32), lane_s=floats(path_s),
        goal=jnp.asarray(_goals(lane_map, lane[last, np.arange(number)]), jnp.int32),
        seen=floats(seen), clearance=floats(clearance),
        touched=jnp.asarray(touched), driver=driver, v0=floats(v0),
    )  # fmt: skip


def pose(scene: SceneArrays, p: Float[Array, " N"]) -> Float[Array, "N 4"]:
    """x, y (m), heading (rad) and recorded speed (m/s) along the paths.

    Args:
      scene: what was recorded.
      p: m along its own path, of every vehicle.
    """
    row = jnp.arange(p.shape[0])
    k, u = _cell(scene, p)
    return scene.path[row, k] * (1 - u)[:, None] + scene.path[row, k + 1] * u[:, None]


class Sight(NamedTuple):
    """Every vehicle j seen from the path of every i: `[j, i]`."""

    along: Float[Array, "N N"]  # m along the path of i
    beside: Float[Array, "N N"]  # m from it, left > 0; `FAR` where it is not near
    cos: Float[Array, "N N"]  # of the angle between them
    sin: Float[Array, "N N"]


def sight(scene: SceneArrays, p: Float[Array, " N"]) -> Sight:
    """All vehicles, `p` m along their own paths, seen from all paths."""
    place = jnp.clip(p / GRID, 0, scene.path.shape[1] - 1)
    k = jnp.round(place)
    # straight on from the nearest point; in a bend of radius R that is off by half a metre times d / R
    along, beside, cos, sin = jnp.moveaxis(scene.seen[jnp.arange(p.shape[0]), k.astype(jnp.int32)], 1, 0)
    rest = (p - k * GRID)[:, None]
    return Sight(along + rest * cos, beside + rest * sin, cos, sin)


def sight_of(
    scene: SceneArrays, x: Float[Array, ""], y: Float[Array, ""], heading: Float[Array, ""]
) -> tuple[Float[Array, " N"], ...]:
    """The fields of `Sight` of one body anywhere in the plane."""
    dx, dy = x - scene.path[..., 0], y - scene.path[..., 1]
    k = jnp.argmin(dx * dx + dy * dy, -1)
    row = jnp.arange(k.shape[0])
    angle = scene.path[row, k, 2]
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    dx, dy = dx[row, k], dy[row, k]
    ahead, beside = cos * dx + sin * dy, cos * dy - sin * dx
    off = (jnp.abs(ahead) > 2 * GRID) | (jnp.abs(beside) > _REACH)
    beside = jnp.where(off, FAR, beside)
    turn = heading - angle
    return k.astype(x.dtype) * GRID + ahead, beside, jnp.cos(turn), jnp.sin(turn)


def separation(length: Any, width: Any, dx: Any, dy: Any, angle: tuple[Any, Any]) -> tuple[Any, Any]:
    """Gaps along and across bodies i to j, `[i, j]`, m; of NumPy arrays or of JAX's.

    They are apart if one of the gaps is positive; not if none is in the frames of both (separating axes).

    Args:
      length: m, `[N]`.
      width: m, `[N]`.
      dx: m, to the middle of j, ahead in the frame of i, `[i, j]`.
      dy: to the left.
      angle: cos and sin of the angle between them.
    """
    cos, sin = abs(angle[0]), abs(angle[1])
    along = abs(dx) - (length[:, None] + cos * length[None, :] + sin * width[None, :]) / 2
    across = abs(dy) - (width[:, None] + sin * length[None, :] + cos * width[None, :]) / 2
    return along, across


def _cell(scene: SceneArrays, p: Array) -> tuple[Array, Array]:
    last = scene.path.shape[1] - 1
    return interval(jnp.clip(p / GRID, 0, last - 0.001), last)


# --- on the host -------------------------------------------------------------------------------------


def _places(
    lane_map: LaneMap, x: Floats, y: Floats, heading: Floats
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Lane, s and d of all entries."""
    found = jax.jit(project)(lane_map, *(jnp.asarray(a.ravel(), jnp.float32) for a in (x, y, heading)))
    lane, s, d = (np.asarray(a).reshape(x.shape) for a in found[:3])
    return lane, s, d


def _goals(lane_map: LaneMap, lane: Any) -> NDArray[np.int64]:
    """The goal that is nearest from each lane, [N]; 0 where there is none."""
    distance = np.asarray(lane_map.routes.distance)[lane]
    return np.where(np.asarray(lane_map.routes.reachable)[lane], distance, np.inf).argmin(-1)


class _Onward:
    """How paths go on where their logs end: along the lanes."""

    def __init__(self, network: Network, lane_map: LaneMap) -> None:
        self.network, self.ids = network, lane_ids(network)
        self.origin = np.asarray(lane_map.origin, float)

    def walk(self, end: Floats, row: Any, s: Any, d: Any) -> tuple[Floats, float]:
        """Points `GRID` m apart after the `end`, and m of road left.

        Args:
          end: x, y, heading, v.
          row: lane of the end.
          s, d: m, place on that lane.
        """
        count = int(ONWARD / GRID)
        points = []
        lane = self.network.lanes[self.ids[row]] if row != NO_LANE else None
        for _ in range(count):
            if lane is None:
                break
            s += GRID
            while lane is not None and s > lane.length:
                s -= lane.length
                lane = self.network.lanes[lane.successors[0]] if lane.successors else None
            if lane is None:
                break
            xyz, heading = lane.pose(s)
            x, y = xyz[:2] - self.origin
            points.append((x - d * np.sin(heading), y + d * np.cos(heading), float(heading), end[3]))
        limit = len(points) * GRID
        x, y, heading, v = points[-1] if points else end
        for k in range(1, count - len(points) + 1):
            way = k * GRID
            points.append((x + way * np.cos(heading), y + way * np.sin(heading), heading, v))
        values = np.array(points)
        values[:, 2] = np.unwrap(np.append(end[2], values[:, 2]))[1:]
        return values, limit


def _resampled(way: Floats, values: Floats, size: int) -> Floats:
    """Values on the grid, going on straight after their end."""
    grid = GRID * np.arange(size)
    found = np.stack([np.interp(grid, way, values[:, k]) for k in range(values.shape[1])], -1)
    beyond = np.maximum(grid - way[-1], 0)
    found[:, 0] += beyond * np.cos(values[-1, 2])
    found[:, 1] += beyond * np.sin(values[-1, 2])
    return found


def _seen(path: Floats) -> Floats:
    """`SceneArrays.seen`."""
    number, size, _ = path.shape
    points = path.reshape(-1, 4)
    table = np.zeros((number, size, 4, number))
    for i in range(number):
        apart, near = KDTree(path[i, :, :2]).query(points[:, :2], distance_upper_bound=1.5 * _REACH)
        lost = ~np.isfinite(apart)
        foot = path[i, np.where(lost, 0, near)]
        cos, sin = np.cos(foot[:, 2]), np.sin(foot[:, 2])
        dx, dy = points[:, 0] - foot[:, 0], points[:, 1] - foot[:, 1]
        ahead, beside = cos * dx + sin * dy, cos * dy - sin * dx
        lost |= (np.abs(ahead) > 2 * GRID) | (np.abs(beside) > _REACH)
        turn = points[:, 2] - foot[:, 2]
        values = (near * GRID + ahead, np.where(lost, FAR, beside), np.cos(turn), np.sin(turn))
        for k, value in enumerate(values):
            table[:, :, k, i] = np.where(lost & (k == 0), 0, value).reshape(number, size)
    return table


def _edge(p: Floats, valid: NDArray[np.bool_], seen: Floats) -> Floats:
    """End of the record on and beside each path, m along it."""
    number = p.shape[1]
    far = p[-1].copy()
    k = np.round(p / GRID).astype(int)
    for j in range(number):
        along, beside = np.moveaxis(seen[j, k[valid[:, j], j]][:, :2], 1, 0)
        far = np.maximum(far, np.where(np.abs(beside) < _REACH, along, 0).max(0))
    return far


def _clearance(pose: Floats, length: Floats, width: Floats, valid: NDArray[np.bool_]) -> Floats:
    """[i, j]: the larger of the gaps of `separation` of body j in the frame of body i, m."""
    dx, dy, turn = (pose[None, :, k] - pose[:, None, k] for k in range(3))
    cos, sin = np.cos(pose[:, None, 2]), np.sin(pose[:, None, 2])
    angle = np.cos(turn), np.sin(turn)
    along, across = separation(length, width, cos * dx + sin * dy, cos * dy - sin * dx, angle)
    both = valid[:, None] & valid[None, :] & ~np.eye(len(pose), dtype=bool)
    return np.where(both, np.maximum(along, across), FAR)


def _drivers(
    recorded: Tracks, p: Floats, v: Floats, valid: NDArray[np.bool_], seen: Floats
) -> tuple[Driver, Floats]:
    """Drivers with shorter gaps than those in the log, and desired speeds.

    With longer gaps they could never come back to the places of their logs.
    """
    count, number = v.shape
    gap = np.full((count, number), np.inf)
    length, width = recorded.length, recorded.width
    for t in range(count):
        k = np.floor(p[t] / GRID).astype(int)
        u = (p[t] / GRID - k)[:, None, None]
        row = np.arange(number)
        along, beside, *_ = np.moveaxis(seen[row, k] * (1 - u) + seen[row, k + 1] * u, 1, 0)
        ahead = along - p[t][None, :]
        there = valid[t][:, None] & valid[t][None, :] & (ahead > 0)
        there &= np.abs(beside) < (width[:, None] + width[None, :]) / 2 + MARGIN
        gaps = np.where(there, ahead - (length[:, None] + length[None, :]) / 2, np.inf)
        gap[t] = gaps.min(0)
    gap = np.where(gap > 0, gap, np.inf)
    shortest = np.quantile(gap, 0.02, axis=0, method="lower")
    s0 = np.clip(_TIGHTER * shortest, 0.5, 2.0)
    headway = (gap - s0) / np.maximum(v, 1.0)
    follows = valid & np.isfinite(headway)
    T = np.full(number, 1.2)
    for i in np.flatnonzero(follows.any(0)):
        T[i] = np.clip(_TIGHTER * np.quantile(headway[follows[:, i], i], 0.05), 0.25, 1.2)
    v0 = np.where(valid, v, 0).max(0) + 1.0
    values = {
        "speed_factor": 1.0, "v_max": 60.0, "a": 1.5, "b": 2.0, "delta": 4.0, "b_max": 8.0,
        "coolness": 0.99, "politeness": 0.0, "threshold": 0.1, "b_safe": 3.0, "keep_right": 0.0,
        "lane_change_time": 4.0, "a_lat": 2.5, "gap_factor": 1.0, "svo": 0.0,
    }  # fmt: skip
    equal = {name: jnp.full(number, value, jnp.float32) for name, value in values.items()}
    driver = Driver(T=jnp.asarray(T, jnp.float32), s0=jnp.asarray(s0, jnp.float32), **equal)
    return driver, v0


__all__ = [
    "FAR",
    "GRID",
    "MARGIN",
    "ONWARD",
    "Log",
    "SceneArrays",
    "Sight",
    "build_arrays",
    "pose",
    "separation",
    "sight",
    "sight_of",
]
