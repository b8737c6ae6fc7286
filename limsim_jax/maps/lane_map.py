"""Lanes as device arrays, and the look-ups on them.

Each lane is cut into intervals of equal arc length `ds`, a power of two between 1/8 m and 16 m, so that
`s / ds` and `i * ds` are exact in float32; the last interval takes the remainder (0.5 to 1.5 `ds`). The
intervals of all lanes lie end to end in one pool, so a 10 km lane and a 5 m connector share one map. An
interval is one row of 16 float32, a cache line: the cubic Hermite curve through the exact end poses, the
width as a cubic, the curvature as a line. `ds` is per lane the largest that keeps the row within
`TOLERANCE` of the host lane.

Look-ups take one `lane` and one `s`, or arrays of one shape. The last row of every array is an inert null
lane, so `NO_LANE` may be used as an index everywhere. All are differentiable in everything but `lane`;
where a lane is kinked, the gradient is that of the curve that rounds the kink.

Coordinates are relative to `LaneMap.origin`, a whole number of metres that is subtracted in float64:
float32 resolves 0.25 mm within 4 km of it and 0.5 mm within 8 km. `absolute` gives file coordinates back.

Cost on one CPU core: a pose reads 12 B of lane table and 36 B of one row and is bound by arctan2 and these
gathers; a local projection reads five rows and is bound by the dependent gathers of its Newton steps.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

from limsim_jax.geometry import derivative, direction, polynomial, wrap_angle
from limsim_jax.maps.conflicts import ConflictTable, build_conflicts
from limsim_jax.maps.network import ImportReport, Lane, LaneType, MapError, Network
from limsim_jax.maps.routing import RouteTable, build_routes, default_goals
from limsim_jax.maps.signals import SignalTable, build_signals
from limsim_jax.numerics import safe_divide, safe_sqrt
from limsim_jax.xla import computed_once

Floats = NDArray[np.float64]

NO_LANE = -1
"""Row of the null lane."""

Index = Int[Array, "*#b"] | Int[np.ndarray, "*#b"] | int
Number = Float[Array, "*#b"] | Float[np.ndarray, "*#b"] | float
Goals = Sequence[Sequence[str]] | Mapping[str, Sequence[str]]

VEHICLE_CLASSES = ("car", "van", "truck", "bus", "motorcycle", "emergency")
"""Vehicle classes in the order of the bits of `LaneMap.access`."""

LANE_TYPES = tuple(LaneType)
"""Lane types in the order of the codes in `LaneMap.lane_type`."""

SPACINGS = tuple(2.0**power for power in range(4, -4, -1))
"""Interval lengths to choose from, longest first, m."""

TOLERANCE = {"position": 1e-3, "width": 1e-3, "elevation": 1e-2, "heading": math.radians(0.25)}
"""Largest deviation of a device lane from its host lane, m and rad, unless `ds` is already the least."""

WORST_DEVIATION = 0.05
"""A map with a lane that deviates by more, at the least `ds`, is refused, m."""

REACH = 10.0
"""`project` finds lanes whose centre line is within this distance, m."""

TURN_WINDOW = 4.0
"""`curvature_max` is the mean over a stretch of this length, m: about a wheelbase and a half."""

MIN_WIDTH = 2.7
"""m, of a lane on which any vehicle finds room: a bus is 2.55 m wide."""

SIGHT = 50.0
"""m that everybody has to see along its way: what it takes to stop from 70 km/h with 4 m/s^2."""

_MOST = 12  # lanes that anybody looks over
_BESIDE = 500.0  # m, beyond which it does not matter how far lanes run side by side
_CELL = 8.0  # m, side of the cells that `project` looks up
_CHUNK_LENGTH, _CHUNK_TURN = 32.0, 0.6  # m, rad: a candidate of `project` has at most about one closest point
_JUMP = 1.5e-3  # m: closer host samples are a kink or a step
_JUMP_ZONE = 0.5  # m: around a kink or a step, heading and width are not judged
_LOCAL_STEPS = 4  # Newton steps of `to_frenet` before the differentiable one
_GLOBAL_STEPS = 4  # Newton or bisection steps per candidate of `project`
_MIN_SLOPE = 0.1  # least 1 - kappa d that a Newton step divides by
_CURVATURE_SLIP = 1e-3  # rad: curvature and turn between two host samples that differ by more show a jump
_MAX_ROWS = 2**24
_LEAST = {  # least sizes of tables, so that all small maps have the same shapes
    "lanes": 64,
    "rows": 4096,
    "neighbors": 4,
    "chunks": 256,
    "cells": 1024,
    "candidates": 8192,
    "connectors": 64,
    "foes": 0,
    "goals": 16,
    "programs": 16,
    "phases": 16,
    "links": 32,
    "movements": 64,
    "sight": 4,
}


@struct.dataclass(frozen=True, kw_only=True)
class LaneMap:
    """Lanes of a map on the device: `L` lanes and `S` intervals, padded to buckets, null lane last."""

    origin: Int[Array, " 2"]  # m, file coordinates of (0, 0)
    rows: Float[Array, "S 16"]  # x0..x3, y0..y3, width 0..3, curvature 0..1, length (m), grade
    height: Float[Array, "S 4"]  # m, elevation as a cubic
    side: Float[Array, "S 4"]  # s on the left lane, its slope, s on the right lane, its slope
    first: Int[Array, " L"]  # row of the first interval
    count: Int[Array, " L"]  # number of intervals
    ds: Float[Array, " L"]  # m, interval length
    length: Float[Array, " L"]  # m
    speed_limit: Float[Array, " L"]  # m/s
    stop_s: Float[Array, " L"]  # m, where the front bumper stops: last stop line, else end of the lane
    end_s: Float[Array, " L"]  # m, as far as a vehicle can go on a lane that leads nowhere: it may taper off
    curvature_max: Float[Array, " L"]  # 1/m, largest |mean curvature| over any `TURN_WINDOW`
    left: Int[Array, " L"]  # neighbour in the same direction
    right: Int[Array, " L"]
    opposite: Int[Array, " L"]  # oncoming lane beside it
    may_change_left: Bool[Array, " L"]
    may_change_right: Bool[Array, " L"]
    beside_s: Float[Array, "L 2"]  # m from its start that the left and the right neighbour run beside it
    successors: Int[Array, "L K"]  # padded with NO_LANE
    predecessors: Int[Array, "L K"]
    lane_type: Int[Array, " L"]  # index into LANE_TYPES
    access: Int[Array, " L"]  # bit i: VEHICLE_CLASSES[i] may use it
    is_connector: Bool[Array, " L"]  # lies inside a junction
    junction: Int[Array, " L"]  # index into the network's junctions, else -1
    valid: Bool[Array, " L"]  # False for the null lane and padding
    chunk_lane: Int[Array, " C"]  # short stretches of lane: what `project` compares
    chunk: Float[Array, "C 6"]  # m, first and last s; x, y of the first and of the last
    cell_start: Int[Array, " H1"]  # hashed cell h holds cell_chunks[cell_start[h] : cell_start[h + 1]]
    cell_chunks: Int[Array, " Q"]
    conflicts: ConflictTable
    routes: RouteTable
    signals: SignalTable
    lanes_in_sight: int = struct.field(pytree_node=False, default=0)
    """Lanes that a vehicle may have to look over to see `SIGHT` m ahead."""


# --- look-ups ----------------------------------------------------------------------------------------


def pose(
    lane_map: LaneMap, lane: Index, s: Number, d: Number = 0.0
) -> tuple[Float[Array, "*#b"], Float[Array, "*#b"], Float[Array, "*#b"]]:
    """Position x, y (m) at arc length `s` and lateral offset `d` (m, left > 0), and the lane's heading (rad).

    Beyond its ends a lane goes on straight.
    """
    s, d = _as_float(lane_map, s), _as_float(lane_map, d)
    row, u = _locate(lane_map, lane, s)
    curve = _curve(lane_map, row, u)
    tx, ty = _unit(curve.dx, curve.dy)
    return curve.x0 + (curve.x - d * ty), curve.y0 + (curve.y + d * tx), direction(curve.dx, curve.dy)


def curvature(lane_map: LaneMap, lane: Index, s: Number) -> Float[Array, "*#b"]:
    """Curvature of the centre line, 1/m, positive where it bends left; beyond the ends that of the end."""
    row, u = _locate(lane_map, lane, _as_float(lane_map, s))
    u = _inside(lane_map, row, u)
    return polynomial(_columns(lane_map.rows, row, range(12, 14)), u)


def width(lane_map: LaneMap, lane: Index, s: Number) -> Float[Array, "*#b"]:
    """Lane width, m; beyond the ends that of the end."""
    row, u = _locate(lane_map, lane, _as_float(lane_map, s))
    return polynomial(_columns(lane_map.rows, row, range(8, 12)), _inside(lane_map, row, u))


def elevation(lane_map: LaneMap, lane: Index, s: Number) -> tuple[Float[Array, "*#b"], Float[Array, "*#b"]]:
    """Elevation z (m) and grade dz/ds of the centre line; beyond the ends those of the end."""
    row, u = _locate(lane_map, lane, _as_float(lane_map, s))
    u = _inside(lane_map, row, u)
    cubic = _columns(lane_map.height, row, range(4))
    return polynomial(cubic, u), polynomial(derivative(cubic), u)


def neighbor(lane_map: LaneMap, lane: Index, side: Index) -> tuple[Int[Array, "*#b"], Bool[Array, "*#b"]]:
    """Lane on the left (`side` > 0) or right in the same direction, else NO_LANE; whether one may change."""
    left = jnp.asarray(side) > 0
    return (
        jnp.where(left, lane_map.left[lane], lane_map.right[lane]),
        jnp.where(left, lane_map.may_change_left[lane], lane_map.may_change_right[lane]),
    )


def side_s(lane_map: LaneMap, lane: Index, s: Number, side: Index) -> Float[Array, "*#b"]:
    """Arc length (m) on the left (`side` > 0) or right neighbour, level with `s` on `lane`.

    Where there is no neighbour, `s` itself.
    """
    row, u = _locate(lane_map, lane, _as_float(lane_map, s))
    start_l, slope_l, start_r, slope_r = _columns(lane_map.side, row, range(4))
    left = jnp.asarray(side) > 0
    return jnp.where(left, start_l, start_r) + u * jnp.where(left, slope_l, slope_r)


def room_beside(lane_map: LaneMap, lane: Index, s: Number, side: Index) -> Float[Array, "*#b"]:
    """m from `s` on `lane` to where its left (`side` > 0) or right neighbour no longer runs beside it."""
    beside = lane_map.beside_s[lane]
    return jnp.where(jnp.asarray(side) > 0, beside[..., 0], beside[..., 1]) - _as_float(lane_map, s)


def turn_speed(lane_map: LaneMap, lane: Index, lateral_acceleration: Number) -> Float[Array, "*#b"]:
    """Speed (m/s) at which the tightest bend takes this lateral acceleration (m/s^2), at most the limit.

    SUMO limits junctions by 5.5 m/s^2; comfortable driving stays within 2 to 3 m/s^2.
    """
    return jnp.minimum(bend_speed(lane_map, lane, lateral_acceleration), lane_map.speed_limit[lane])


def bend_speed(lane_map: LaneMap, lane: Index, lateral_acceleration: Number) -> Float[Array, "*#b"]:
    """Speed (m/s) at which the tightest bend takes this lateral acceleration (m/s^2); 1e6 if straight."""
    bend = lane_map.curvature_max[lane]
    speed = safe_sqrt(safe_divide(_as_float(lane_map, lateral_acceleration), bend))
    return jnp.where(bend > 0, speed, 1e6)


def to_frenet(
    lane_map: LaneMap,
    lane: Index,
    s_guess: Number,
    x: Number,
    y: Number,
) -> tuple[Float[Array, "*#b"], Float[Array, "*#b"], Float[Array, "*#b"]]:
    """Arc length `s`, lateral offset `d` (m, left > 0) of a point, and the lane's heading there (rad).

    Finds the foot of the perpendicular nearest to `s_guess`, the last known arc length, by Newton steps
    that may cross any number of intervals. A point before the start has `s < 0` and one past the end
    `s > length`, measured along the end tangent: then it is the caller's turn to go on with a
    predecessor (`s + its length`) or a successor (`s - length`).

    Sound where `1 - kappa d > 0`, that is where the point is nearer than the centre of curvature.
    Gradients are those of the exact projection (implicit function theorem); that of `s_guess` is zero.
    """
    x, y = _as_float(lane_map, x), _as_float(lane_map, y)
    frozen, s, px, py = lax.stop_gradient((lane_map, _as_float(lane_map, s_guess), x, y))
    s = _search(frozen, lane, s, -jnp.inf, jnp.inf, px, py, _LOCAL_STEPS)

    # One more step, this one differentiated: at the fixed point its derivative is the implicit one.
    row, u = _locate(lane_map, lane, s)
    step = _newton_step(_curve(lane_map, row, u), x, y)
    foot = _curve(lane_map, row, u + step)
    tx, ty = _unit(foot.dx, foot.dy)
    d = tx * ((y - foot.y0) - foot.y) - ty * ((x - foot.x0) - foot.x)
    return s + step, d, direction(foot.dx, foot.dy)


def project(
    lane_map: LaneMap,
    x: Number,
    y: Number,
    heading: Number | None = None,
    max_heading: float = math.pi / 2,
) -> tuple[Int[Array, "*#b"], Float[Array, "*#b"], Float[Array, "*#b"], Float[Array, "*#b"]]:
    """Nearest lane of a point, and `s`, `d` (m) and the lane's heading (rad) there.

    Compares the feet of all perpendiculars on centre lines, and the ends of lanes, within `REACH`; with
    `heading`, those where the lane's heading differs by less than `max_heading`. Of equal distances the
    lower row wins. NO_LANE where there is none. A point beyond the centre of a bend sees two ends of it
    and no foot between; with `heading`, only the nearer end is compared.

    Meant for the start of a run: `to_frenet` is some hundred times faster.
    """
    x, y = _as_float(lane_map, x), _as_float(lane_map, y)
    frozen, px, py = lax.stop_gradient((lane_map, x, y))
    cell = _hash(jnp.floor(px / _CELL), jnp.floor(py / _CELL), lane_map.cell_start.shape[0] - 1)
    start, count = frozen.cell_start[cell], frozen.cell_start[cell + 1] - frozen.cell_start[cell]

    def compare(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        k, best, best_lane, best_s = carry
        chunk = frozen.cell_chunks[start + jnp.minimum(k, count - 1)]
        lane = frozen.chunk_lane[chunk]
        low, high, x0, y0, x1, y1 = _columns(frozen.chunk, chunk, range(6))
        # Downhill from the nearer end: inside a bend the distance has its maximum between two ends.
        s = jnp.where(jnp.hypot(px - x0, py - y0) <= jnp.hypot(px - x1, py - y1), low, high)
        s = _search(frozen, lane, s, low, high, px, py, _GLOBAL_STEPS)
        # An end of the stretch is no foot: go on to the foot, whose heading it is that has to fit.
        s = _search(frozen, lane, s, -jnp.inf, jnp.inf, px, py, _GLOBAL_STEPS)
        s = jnp.clip(s, 0, frozen.length[lane])
        foot = _curve(frozen, *_locate(frozen, lane, s))
        gap = jnp.hypot((px - foot.x0) - foot.x, (py - foot.y0) - foot.y)
        better = (k < count) & (gap < best)
        if heading is not None:
            turn = wrap_angle(lax.stop_gradient(_as_float(lane_map, heading)) - direction(foot.dx, foot.dy))
            better &= jnp.abs(turn) < max_heading
        return (
            k + 1,
            jnp.where(better, gap, best),
            jnp.where(better, lane, best_lane),
            jnp.where(better, s, best_s),
        )

    nothing = (jnp.int32(0), jnp.full_like(px, REACH), jnp.full_like(cell, NO_LANE), jnp.zeros_like(px))
    _, _, lane, s = lax.while_loop(lambda carry: carry[0] < jnp.max(count), compare, nothing)
    s, d, lane_heading = to_frenet(lane_map, lane, s, x, y)
    return lane, s, d, lane_heading


def absolute(lane_map: LaneMap, x: Any, y: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Map coordinates (m) in the coordinates of the file, on the host in float64."""
    x0, y0 = np.asarray(lane_map.origin, np.float64)
    return np.asarray(x, np.float64) + x0, np.asarray(y, np.float64) + y0


def relative(lane_map: LaneMap, x: Any, y: Any) -> tuple[Any, Any]:
    """File coordinates (m) in the coordinates of the map, on the host: the inverse of `absolute`."""
    x0, y0 = np.asarray(lane_map.origin, np.float64)
    return np.float32(np.asarray(x, np.float64) - x0), np.float32(np.asarray(y, np.float64) - y0)


def _as_float(lane_map: LaneMap, value: Any) -> Float[Array, "*#b"]:
    return jnp.asarray(value, lane_map.rows.dtype)


def _columns(table: Float[Array, "S W"], row: Int[Array, "*#b"], columns: Iterable[int]) -> list[Any]:
    # One gather per column: XLA fuses them with the arithmetic; whole rows would go through memory first.
    return [table[row, column] for column in columns]


def _locate(
    lane_map: LaneMap, lane: Index, s: Float[Array, "*#b"]
) -> tuple[Int[Array, "*#b"], Float[Array, "*#b"]]:
    """Row of the interval that holds `s`, and arc length from its start, m."""
    ds = lane_map.ds[lane]
    index = jnp.clip(jnp.floor(s / ds).astype(jnp.int32), 0, lane_map.count[lane] - 1)
    return computed_once((lane_map.first[lane] + index, s - index.astype(s.dtype) * ds))


def _inside(lane_map: LaneMap, row: Int[Array, "*#b"], u: Float[Array, "*#b"]) -> Float[Array, "*#b"]:
    # Not jnp.clip: its gradient on the bounds is a half.
    end = lane_map.rows[row, 14]
    return jnp.where(u < 0, 0, jnp.where(u > end, end, u))


class _Curve(NamedTuple):
    """The centre line at a place: position relative to the start of its interval, and derivatives by s."""

    x0: Any  # start of the interval, m; apart, so that differences to it stay exact in float32
    y0: Any
    x: Any
    y: Any
    dx: Any
    dy: Any
    ddx: Any
    ddy: Any


def _curve(lane_map: LaneMap, row: Int[Array, "*#b"], u: Float[Array, "*#b"]) -> _Curve:
    """Evaluate a row at `u` m from the start of its interval; straight beyond its ends."""
    inside = _inside(lane_map, row, u)
    beyond = u - inside

    def axis(c0: Any, *c: Any) -> tuple[Any, Any, Any, Any]:
        first = derivative((c0, *c))
        slope = polynomial(first, inside)
        bend = jnp.where(beyond == 0, polynomial(derivative(first), inside), 0)
        return c0, inside * polynomial(c, inside) + beyond * slope, slope, bend

    x0, x, dx, ddx = axis(*_columns(lane_map.rows, row, range(4)))
    y0, y, dy, ddy = axis(*_columns(lane_map.rows, row, range(4, 8)))
    return _Curve(x0, y0, x, y, dx, dy, ddx, ddy)


def _unit(dx: Any, dy: Any) -> tuple[Any, Any]:
    norm = safe_sqrt(dx * dx + dy * dy)
    return safe_divide(dx, norm), safe_divide(dy, norm)


def _newton_step(curve: _Curve, x: Number, y: Number) -> Float[Array, "*#b"]:
    """Newton step (m) towards the s whose normal passes through the point."""
    ex, ey = (x - curve.x0) - curve.x, (y - curve.y0) - curve.y
    ahead = ex * curve.dx + ey * curve.dy
    slope = curve.dx**2 + curve.dy**2 - (ex * curve.ddx + ey * curve.ddy)  # 1 - kappa d on a smooth lane
    return ahead / jnp.maximum(slope, _MIN_SLOPE)


def _search(
    lane_map: LaneMap,
    lane: Index,
    s: Float[Array, "*#b"],
    low: Number,
    high: Number,
    x: Number,
    y: Number,
    steps: int,
) -> Float[Array, "*#b"]:
    """Newton steps for the foot of the perpendicular within [low, high].

    Between two places that point at each other (the legs of a kink) a step that leaves them is halved.
    """
    behind, ahead = jnp.full_like(s, low), jnp.full_like(s, high)
    for _ in range(steps):
        step = _newton_step(_curve(lane_map, *_locate(lane_map, lane, s)), x, y)
        behind, ahead = jnp.where(step > 0, s, behind), jnp.where(step < 0, s, ahead)
        there = jnp.clip(s + step, low, high)
        s = jnp.where((there >= behind) & (there <= ahead), there, (behind + ahead) / 2)
    return s


def _hash(ix: Any, iy: Any, size: int) -> Any:
    """Row of a grid cell in the table of cells, of a NumPy or JAX cell; cells that collide share a row."""
    integer = np.int32 if isinstance(ix, np.ndarray) else jnp.int32
    unsigned = np.uint32 if isinstance(ix, np.ndarray) else jnp.uint32
    mixed = ix.astype(integer).astype(unsigned) * unsigned(73856093) ^ iy.astype(integer).astype(
        unsigned
    ) * unsigned(19349663)
    return ((mixed ^ (mixed >> unsigned(15))) % unsigned(size)).astype(integer)


# --- building, on the host ---------------------------------------------------------------------------


def lane_rows(network: Network) -> dict[str, int]:
    """Row of every lane that motor traffic uses, by lane id, in file order."""
    return {lane.id: row for row, lane in enumerate(network.drivable_lanes())}


def lane_ids(network: Network) -> list[str]:
    """Lane id of every row: the inverse of `lane_rows`."""
    return [lane.id for lane in network.drivable_lanes()]


def bucket(count: int, least: int = 1) -> int:
    """Least of 0, 1, 2, 3, 4, 6, 8, 12, 16, 24, ... that is below neither `count` nor `least`."""
    count = max(count, least)
    if count == 0:
        return 0
    power = 1 << (count - 1).bit_length()
    return 3 * power // 4 if power >= 4 and count <= 3 * power // 4 else power


def build_lane_map(
    network: Network, goals: Goals | None = None, *, report: ImportReport | None = None
) -> LaneMap:
    """Rasterise the lanes of a network for the device, with its conflict, routing and signal tables.

    Args:
        network: the map.
        goals: lane ids of each goal of `routes`, in the order of its columns or by name; default: the
            ways out of the map, see `routing.default_goals`.
        report: takes a note for every lane that misses `TOLERANCE` at the least interval length.

    Raises:
        MapError: no lane for motor traffic, numbers that are not finite, a link to a lane that is not
            there, or a lane that cannot be followed within `WORST_DEVIATION`.
    """
    goals = default_goals(network) if goals is None else goals  # those of the map as it is
    network = _without_side_steps(network, report)
    lanes = list(network.drivable_lanes())
    if not lanes:
        raise MapError("no lane that motor traffic may use", file=network.source)
    host = _HostLanes.join(network, lanes)
    raster = _rasterise(network, host, report)
    tables = _lane_tables(network, lanes)
    origin = np.round((host.xyz[:, :2].min(0) + host.xyz[:, :2].max(0)) / 2)
    if np.abs(origin).max() >= 2**31:
        raise MapError("coordinates beyond 2^31 m", file=network.source)
    if len(raster.lane) >= _MAX_ROWS:
        raise MapError(f"{len(raster.lane)} intervals; at most {_MAX_ROWS} fit", file=network.source)

    num_rows, num_lanes = (
        bucket(len(raster.lane) + 1, _LEAST["rows"]),
        bucket(len(lanes) + 1, _LEAST["lanes"]),
    )
    rows = raster.rows.copy()
    rows[:, [0, 4]] -= origin
    straight = np.zeros(16)
    straight[[1, 8, 14]] = 1.0  # along x, 1 m wide, 1 m long
    inert = {
        "first": num_rows - 1,
        "access": 0,
        "count": 1,
        "ds": 1.0,
        "length": 1.0,
        "speed_limit": 1.0,
        "stop_s": 1.0,
        "end_s": 1.0,
    }
    tables |= {
        "first": raster.first,
        "count": raster.count,
        "ds": raster.ds,
        "length": host.length,
        "curvature_max": _curvature_max(host),
    }
    arrays = {
        "origin": origin.astype(np.int32),
        "rows": _pad(rows, num_rows, straight),
        "height": _pad(raster.height, num_rows, 0.0),
        "side": _pad(raster.side, num_rows, np.array([0.0, 1.0, 0.0, 1.0])),
        **{name: _pad(table, num_lanes, inert.get(name, _inert(table))) for name, table in tables.items()},
        **_grid(raster, rows),
    }
    sight = max(_lanes_in_sight(lanes, lane_rows(network)), _LEAST["sight"])
    lane_map = LaneMap(**arrays, **_rule_tables(network, goals, num_lanes), lanes_in_sight=sight)
    return jax.tree.map(lambda array: jnp.asarray(_device_type(array)), lane_map)


def _without_side_steps(network: Network, report: ImportReport | None) -> Network:
    """The network without links by which a vehicle would leap sideways, where a lane beside goes on instead.

    Some files let two lanes go on as one where one of them ends beside it. Who is on that one changes lanes.
    """
    lanes = dict(network.lanes)
    for lane in network.drivable_lanes():
        beside = [lanes[name] for name in (lane.left, lane.right) if name in lanes]
        most = lane.width[-1] / 2
        for name in lane.successors:
            going = [x for x in beside if name in x.successors and _side_step(x, lanes[name]) <= most]
            if not going or (step := _side_step(lane, lanes[name])) <= most:
                continue
            before, after = lanes[lane.id], lanes[name]
            lanes[lane.id] = replace(before, successors=tuple(x for x in before.successors if x != name))
            lanes[name] = replace(after, predecessors=tuple(x for x in after.predecessors if x != lane.id))
            if report is not None:
                report.repaired(
                    "lane link",
                    f"{lane.id} -> {name}",
                    f"{name} begins {step:.1f} m beside the end of {lane.id}: traffic changes to "
                    f"{going[0].id}, which goes on as it",
                )
    return network if lanes == network.lanes else replace(network, lanes=lanes)


def _side_step(before: Lane, after: Lane) -> float:
    """m across the track from the end of a lane to the start of the next."""
    off = after.xyz[0, :2] - before.xyz[-1, :2]
    heading = before.heading[-1]
    return abs(float(off[1] * np.cos(heading) - off[0] * np.sin(heading)))


def _rule_tables(network: Network, goals: Goals | None, num_lanes: int) -> dict[str, Any]:
    """Conflicts, routes and signals, padded to buckets."""
    rows = lane_rows(network)
    conflicts = build_conflicts(network, rows)
    routes = build_routes(network, rows, goals)
    signals = build_signals(network, rows)
    (connectors, foes), (_, num_goals) = conflicts.foe.shape, routes.distance.shape
    programs, phases, links = signals.state.shape
    size = {
        name: bucket(count, _LEAST[name])
        for name, count in {
            "connectors": connectors,
            "foes": foes,
            "goals": num_goals,
            "programs": programs,
            "phases": phases,
            "links": links,
            "movements": len(signals.movement_link),
        }.items()
    }
    return {
        "conflicts": conflicts.pad(lanes=num_lanes, connectors=size["connectors"], foes=size["foes"]),
        "routes": routes.pad(lanes=num_lanes, goals=size["goals"]),
        "signals": signals.pad(
            programs=size["programs"],
            phases=size["phases"],
            links=size["links"],
            lanes=num_lanes,
            movements=size["movements"],
        ),
    }


def _device_type(array: NDArray[Any]) -> NDArray[Any]:
    kinds = {"f": np.float32, "i": np.int32, "b": np.bool_}
    return array.astype(kinds[array.dtype.kind])


def _inert(table: NDArray[Any]) -> Any:
    """What the null lane has in a table of lanes: False, NO_LANE, no curvature."""
    return {"b": False, "i": NO_LANE, "f": 0.0}[table.dtype.kind]


def _pad(table: NDArray[Any], size: int, value: Any) -> NDArray[Any]:
    padded = np.empty((size, *table.shape[1:]), table.dtype)
    padded[: len(table)] = table
    padded[len(table) :] = value
    return padded


def _lane_tables(network: Network, lanes: list[Lane]) -> dict[str, NDArray[Any]]:
    """What the network says about each lane, as arrays by row."""
    rows = {lane.id: row for row, lane in enumerate(lanes)}
    junctions = {junction: index for index, junction in enumerate(network.junctions)}
    stop_s = np.array([lane.length for lane in lanes])
    last_line: dict[str, float] = {}
    for line in network.stop_lines:
        last_line[line.spot.lane] = max(line.spot.s, last_line.get(line.spot.lane, 0.0))
    for lane, s in last_line.items():
        if lane in rows:
            stop_s[rows[lane]] = min(s, stop_s[rows[lane]])

    def row_of(lane: Lane, other: str | None) -> int:
        if other is not None and other not in network.lanes:
            raise MapError(
                f"refers to lane '{other}', which does not exist",
                file=network.source,
                element=f"lane '{lane.id}'",
            )
        return rows.get(other, NO_LANE) if other is not None else NO_LANE

    def links(which: str) -> NDArray[np.int64]:
        found = [
            [r for other in getattr(lane, which) if (r := row_of(lane, other)) != NO_LANE] for lane in lanes
        ]
        table = np.full((len(lanes), bucket(max(map(len, found)), _LEAST["neighbors"])), NO_LANE)
        for row, others in enumerate(found):
            table[row, : len(others)] = others
        return table

    left = np.array([row_of(lane, lane.left) for lane in lanes])
    right = np.array([row_of(lane, lane.right) for lane in lanes])
    return {
        "speed_limit": np.array([lane.speed_limit for lane in lanes], float),
        "stop_s": stop_s,
        "end_s": np.array([_wide_until(lane) for lane in lanes]),
        "left": left,
        "right": right,
        "opposite": np.array([row_of(lane, lane.opposite) for lane in lanes]),
        "may_change_left": np.array([lane.may_change_left for lane in lanes]) & (left != NO_LANE),
        "may_change_right": np.array([lane.may_change_right for lane in lanes]) & (right != NO_LANE),
        "beside_s": np.stack([_beside(lanes, rows, "left"), _beside(lanes, rows, "right")], -1),
        "successors": links("successors"),
        "predecessors": links("predecessors"),
        "lane_type": np.array([LANE_TYPES.index(lane.type) for lane in lanes]),
        "access": np.array(
            [sum(1 << i for i, c in enumerate(VEHICLE_CLASSES) if c in lane.access) for lane in lanes]
        ),
        "is_connector": np.array([lane.junction is not None for lane in lanes]),
        "junction": np.array([junctions.get(lane.junction or "", -1) for lane in lanes]),
        "valid": np.ones(len(lanes), bool),
    }


def _beside(lanes: list[Lane], rows: Mapping[str, int], side: Literal["left", "right"]) -> Floats:
    """m from the start of each lane to where its neighbour parts from it or a junction begins.

    Where lanes fork, the way on which that comes first counts; after this lane `_BESIDE` m are enough.
    """

    def goes_on(lane: Lane, after: str) -> bool:
        other = getattr(lanes[rows[after]], side)
        beside = getattr(lane, side)
        return (
            lanes[rows[after]].junction is None and other in rows and other in lanes[rows[beside]].successors
        )

    length = np.array([lane.length for lane in lanes])
    found = np.where([getattr(lane, side) in rows for lane in lanes], length, 0.0)
    on = [
        [rows[after] if goes_on(lane, after) else -1 for after in lane.successors if after in rows]
        if getattr(lane, side) in rows
        else []
        for lane in lanes
    ]
    while True:
        before = found.copy()
        for row, after in enumerate(on):
            if after:
                found[row] = length[row] + min(_BESIDE, *(found[k] if k >= 0 else 0.0 for k in after))
        if (found == before).all():
            return found


def _lanes_in_sight(lanes: list[Lane], rows: Mapping[str, int]) -> int:
    """Most lanes beyond its own one that a vehicle looks over to see `SIGHT` m ahead; at most `_MOST`."""
    reach = np.zeros(len(lanes))  # m that the shortest way over so many lanes has
    for count in range(_MOST):
        after = [[reach[rows[x]] for x in lane.successors if x in rows] for lane in lanes]
        if min((min(ways) for ways in after if ways), default=SIGHT) >= SIGHT:
            return count
        reach = np.array(
            [lane.length + min(ways, default=SIGHT) for lane, ways in zip(lanes, after, strict=True)]
        )
    return _MOST


def _wide_until(lane: Lane) -> float:
    """m from the start to where a lane without successors becomes too narrow; its length if it does not."""
    wide = np.nonzero(lane.width >= MIN_WIDTH)[0]
    if lane.successors or not len(wide) or wide[-1] == len(lane.width) - 1:
        return lane.length
    return float(lane.s[wide[-1]])


@dataclass(frozen=True)
class _HostLanes:
    """Samples of all lanes end to end on one axis, so that one search serves many lanes."""

    lanes: list[Lane]
    offset: Float[NDArray[np.float64], " L"]  # where each lane starts on the axis
    length: Float[NDArray[np.float64], " L"]
    first: Int[NDArray[np.int64], " L"]  # its first sample
    lane: Int[NDArray[np.int64], " M"]  # lane of each sample
    s: Float[NDArray[np.float64], " M"]
    t: Float[NDArray[np.float64], " M"]  # the same on the axis
    xyz: Float[NDArray[np.float64], "M 3"]
    heading: Float[NDArray[np.float64], " M"]
    curvature: Float[NDArray[np.float64], "M 2"]  # where the stretch to the next sample starts and ends
    width: Float[NDArray[np.float64], " M"]
    side_s: Float[NDArray[np.float64], "M 2"]  # s on the left and on the right lane

    @staticmethod
    def join(network: Network, lanes: list[Lane]) -> _HostLanes:
        for lane in lanes:
            values = (lane.s, lane.xyz.ravel(), lane.heading, lane.curvature, lane.width, lane.road_s)
            if (
                not np.isfinite(np.concatenate(values)).all()
                or len(lane.s) < 2
                or (np.diff(lane.s) <= 0).any()
            ):
                raise MapError(
                    "centre line needs two or more finite samples with rising s",
                    file=network.source,
                    element=f"lane '{lane.id}'",
                )
        length = np.array([lane.length for lane in lanes])
        offset = np.concatenate([[0.0], np.cumsum(length + 1.0)[:-1]])
        counts = np.array([len(lane.s) for lane in lanes])
        s, heading, curvature = (
            np.concatenate([getattr(lane, name) for lane in lanes]) for name in ("s", "heading", "curvature")
        )
        side_s = [
            network.lanes[other].s_at_road(lane.road_s) if other in network.lanes else lane.s
            for lane in lanes
            for other in (lane.left, lane.right)
        ]
        return _HostLanes(
            lanes=lanes,
            offset=offset,
            length=length,
            first=np.cumsum(counts) - counts,
            lane=np.repeat(np.arange(len(lanes)), counts),
            s=s,
            t=s + np.repeat(offset, counts),
            xyz=np.concatenate([lane.xyz for lane in lanes]),
            heading=heading,
            curvature=_one_sided_curvature(s, heading, curvature),
            width=np.concatenate([lane.width for lane in lanes]),
            side_s=np.stack([np.concatenate(side_s[0::2]), np.concatenate(side_s[1::2])], -1),
        )

    def at(self, lane: NDArray[np.int64], s: NDArray[np.float64], toward: float = 0.0) -> _Samples:
        """All quantities at `s` on `lane`; at a kink or step those on its far (+1) or near (-1) side."""
        t = self.offset[lane] + s
        last = np.append(self.first[1:], len(self.t))[lane] - 2
        j = np.clip(np.searchsorted(self.t, t + 1e-7 * toward, side="right") - 1, self.first[lane], last)
        h = self.s[j + 1] - self.s[j]
        w = np.clip((s - self.s[j]) / h, 0.0, 1.0)

        def linear(values: NDArray[np.float64], w: NDArray[np.float64]) -> NDArray[np.float64]:
            w = w.reshape(w.shape + (1,) * (values.ndim - 1))
            return values[j] * (1 - w) + values[j + 1] * w

        tangent = np.stack([np.cos(self.heading), np.sin(self.heading)], -1)
        w_, h_ = w[:, None], h[:, None]
        p0, p1, m0, m1 = self.xyz[j, :2], self.xyz[j + 1, :2], tangent[j] * h_, tangent[j + 1] * h_
        xy = (
            p0 * (1 + 2 * w_) * (1 - w_) ** 2
            + m0 * w_ * (1 - w_) ** 2
            + p1 * w_**2 * (3 - 2 * w_)
            - m1 * w_**2 * (1 - w_)
        )
        dxy = 6 * w_ * (1 - w_) * (p1 - p0) + m0 * (1 - w_) * (1 - 3 * w_) - m1 * w_ * (2 - 3 * w_)
        heading = np.arctan2(dxy[:, 1], dxy[:, 0])
        one_sided = w
        if toward:
            jump = h <= _JUMP
            one_sided = np.where(jump, float(toward > 0), w)
            heading = np.where(jump, self.heading[j + (toward > 0)], heading)
        return _Samples(
            xy=xy,
            z=linear(self.xyz[:, 2], w),
            heading=heading,
            curvature=self.curvature[j, 0] * (1 - one_sided) + self.curvature[j, 1] * one_sided,
            width=linear(self.width, one_sided),
            side_s=linear(self.side_s, w),
        )


def _one_sided_curvature(
    s: NDArray[np.float64], heading: NDArray[np.float64], curvature: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Curvature where the stretch from each sample to the next starts and ends.

    A sample where the curvature jumps has one value, right for one of its sides. The turn along the stretch
    tells when that is the other side; then the value that is nearer to the mean curvature holds, and the
    other follows from the mean.
    """
    pairs = np.stack([curvature, np.append(curvature[1:], curvature[-1])], -1)
    h = np.append(np.diff(s), 0.0)
    sound = h > _JUMP  # not a kink, nor the gap between two lanes
    mean = np.divide(np.append(np.diff(heading), 0.0), h, out=pairs.mean(1), where=sound)
    wrong = np.abs(pairs.mean(1) - mean) * h > _CURVATURE_SLIP
    start_holds = np.abs(pairs[:, 0] - mean) < np.abs(pairs[:, 1] - mean)
    pairs[:, 1] = np.where(wrong & start_holds, 2 * mean - pairs[:, 0], pairs[:, 1])
    pairs[:, 0] = np.where(wrong & ~start_holds, 2 * mean - pairs[:, 1], pairs[:, 0])
    return pairs


class _Samples(NamedTuple):
    xy: NDArray[np.float64]
    z: NDArray[np.float64]
    heading: NDArray[np.float64]
    curvature: NDArray[np.float64]
    width: NDArray[np.float64]
    side_s: NDArray[np.float64]


@dataclass(frozen=True)
class _Raster:
    """Intervals of some lanes, lane after lane, in file coordinates."""

    lane: NDArray[np.int64]  # of each interval
    start: NDArray[np.float64]  # s where it starts, m
    rows: NDArray[np.float64]
    height: NDArray[np.float64]
    side: NDArray[np.float64]
    first: NDArray[np.int64]  # first interval of each lane
    count: NDArray[np.int64]  # of intervals of each lane
    ds: NDArray[np.float64]  # of each lane


def _rasterise(network: Network, host: _HostLanes, report: ImportReport | None) -> _Raster:
    """Intervals of all lanes, for each at the longest spacing that keeps it within `TOLERANCE`."""
    check = _check_points(host)
    everything = todo = np.arange(len(host.lanes))
    ds = np.full(len(host.lanes), SPACINGS[-1])
    errors: dict[str, NDArray[np.float64]] = {}
    for spacing in SPACINGS:
        errors = _deviation(host, todo, _cut(host, todo, np.full(len(todo), spacing)), check)
        missed = np.any([errors[name] > limit for name, limit in TOLERANCE.items()], axis=0)
        ds[todo[~missed]] = spacing
        todo, errors = todo[missed], {name: error[missed] for name, error in errors.items()}
        if not len(todo):
            break
    else:
        for k, lane in enumerate(todo):
            error = {name: values[k] for name, values in errors.items() if values[k] > TOLERANCE[name]}
            if error.get("position", 0.0) > WORST_DEVIATION:
                raise MapError(
                    f"intervals of {SPACINGS[-1]:g} m leave the centre line by {error['position']:.3f} m",
                    file=network.source,
                    element=f"lane '{host.lanes[lane].id}'",
                )
            if report is not None:
                deviation = ", ".join(f"{name} {value:.2g}" for name, value in error.items())
                report.approximated(
                    "device lane",
                    host.lanes[lane].id,
                    f"deviates at {SPACINGS[-1]:g} m intervals (m, rad): {deviation}",
                )
    return _cut(host, everything, ds)


def _cut(host: _HostLanes, lanes: NDArray[np.int64], ds: NDArray[np.float64]) -> _Raster:
    """Intervals of `lanes`, each at its own spacing `ds`; `lane` counts within `lanes`."""
    length = host.length[lanes]
    counts = np.maximum(1, np.floor(length / ds + 0.5).astype(np.int64))
    first = np.cumsum(counts) - counts
    of = np.repeat(np.arange(len(lanes)), counts)
    index = np.arange(counts.sum()) - first[of]
    start = index * ds[of]
    end = np.where(index == counts[of] - 1, length[of], start + ds[of])
    h = end - start
    lane = lanes[of]
    a, b = host.at(lane, start, +1), host.at(lane, end, -1)
    inner = [host.at(lane, start + h * third) for third in (1 / 3, 2 / 3)]

    h_ = h[:, None]
    t0, t1 = (np.stack([np.cos(p.heading), np.sin(p.heading)], -1) for p in (a, b))
    chord = (b.xy - a.xy) / h_
    hermite = np.stack([a.xy, t0, (3 * chord - 2 * t0 - t1) / h_, (t0 + t1 - 2 * chord) / h_**2], -1)
    width = _cubic_through(h, a.width, inner[0].width, inner[1].width, b.width)
    height = _cubic_through(h, a.z, inner[0].z, inner[1].z, b.z)
    bend = np.stack([a.curvature, (b.curvature - a.curvature) / h], -1)
    rows = np.concatenate([hermite.reshape(-1, 8), width, bend, h_, ((b.z - a.z) / h)[:, None]], -1)
    side = np.stack([a.side_s, (b.side_s - a.side_s) / h_], -1).reshape(-1, 4)
    return _Raster(of, start, rows, height, side, first, counts, ds)


def _cubic_through(h: NDArray[np.float64], *values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coefficients in u of the cubic with these four values at u = 0, h/3, 2h/3, h."""
    nodes = np.linalg.inv(np.vander(np.arange(4) / 3, increasing=True))
    return np.stack(values, -1) @ nodes.T / h[:, None] ** np.arange(4)


class _Check(NamedTuple):
    """Places at which device lanes are compared with host lanes."""

    lane: NDArray[np.int64]
    s: NDArray[np.float64]
    truth: _Samples
    smooth: NDArray[np.bool_]  # away from kinks and steps


def _check_points(host: _HostLanes) -> _Check:
    """Host samples, places between them at most 0.25 m apart, and more around kinks and steps.

    The number of parts is odd: halves and quarters of host intervals tend to be bounds of ours.
    """
    gap = np.diff(host.t)
    same = host.lane[1:] == host.lane[:-1]
    parts = np.where(same, 2 * np.ceil(gap / 0.5).astype(np.int64) + 1, 1)
    segment = np.repeat(np.arange(len(gap)), parts)
    part = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    t = np.append(host.t[segment] + gap[segment] * part / parts[segment], host.t[-1])
    lane = np.append(host.lane[segment], host.lane[-1])

    jump = np.flatnonzero(same & (gap <= _JUMP))
    near = SPACINGS[-1] * np.arange(-1.0, 1.25, 0.25)
    t = np.append(t, (host.t[jump, None] + near).ravel())
    lane = np.append(lane, np.repeat(host.lane[jump], len(near)))
    s = np.clip(t - host.offset[lane], 0.0, host.length[lane])
    order = np.lexsort((s, lane))
    t, lane, s = t[order], lane[order], s[order]

    smooth = np.ones(len(t), bool)
    if len(jump):
        after = np.searchsorted(host.t[jump], t)
        for k in (np.maximum(after - 1, 0), np.minimum(after, len(jump) - 1)):
            smooth &= np.abs(t - host.t[jump[k]]) > _JUMP_ZONE
    return _Check(lane, s, host.at(lane, s), smooth)


def _deviation(
    host: _HostLanes, lanes: NDArray[np.int64], raster: _Raster, check: _Check
) -> dict[str, NDArray[np.float64]]:
    """Largest deviation of each of `lanes` from the host, by quantity."""
    place = np.full(len(host.lanes), -1)
    place[lanes] = np.arange(len(lanes))
    mine = np.flatnonzero(place[check.lane] >= 0)
    of, s = place[check.lane[mine]], check.s[mine]
    row = raster.first[of] + np.minimum((s / raster.ds[of]).astype(np.int64), raster.count[of] - 1)
    u = s - raster.start[row]
    c = raster.rows[row].T
    x, y, width = polynomial(c[:4], u), polynomial(c[4:8], u), polynomial(c[8:12], u)
    turn = (
        np.arctan2(polynomial(derivative(c[4:8]), u), polynomial(derivative(c[:4]), u))
        - check.truth.heading[mine]
    )
    smooth = check.smooth[mine]
    error = {
        "position": np.hypot(x - check.truth.xy[mine, 0], y - check.truth.xy[mine, 1]),
        "width": np.abs(width - check.truth.width[mine]) * smooth,
        "elevation": np.abs(polynomial(raster.height[row].T, u) - check.truth.z[mine]),
        "heading": np.abs(np.remainder(turn + np.pi, 2 * np.pi) - np.pi) * smooth,
    }
    begin = np.searchsorted(of, np.arange(len(lanes)))
    return {name: np.maximum.reduceat(values, begin) for name, values in error.items()}


def _curvature_max(host: _HostLanes) -> NDArray[np.float64]:
    """Largest |turn| per metre of each lane over any stretch of `TURN_WINDOW`, or the lane if it is shorter.

    A mean, because a polyline bends nowhere but at its kinks. Stretches below 1 m count as 1 m.
    """
    stretch = np.minimum(TURN_WINDOW, host.length)[host.lane]
    begin, end = host.offset[host.lane], (host.offset + host.length)[host.lane]
    largest = np.zeros(len(host.t))
    for ahead in (0.0, 1.0):  # the stretch that ends at the sample, and the one that starts there
        start = np.clip(host.t - (1 - ahead) * stretch, begin, end - stretch)
        turn = np.interp(start + stretch, host.t, host.heading) - np.interp(start, host.t, host.heading)
        largest = np.maximum(largest, np.abs(turn) / np.maximum(stretch, 1.0))
    return np.maximum.reduceat(largest, host.first)


def _grid(raster: _Raster, rows: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
    """Tables of `project`: short stretches of lane, and for each cell those within `REACH` of it."""
    c, h = rows.T, rows[:, 14]
    turn = np.arctan2(polynomial(derivative(c[4:8]), h), polynomial(derivative(c[:4]), h)) - np.arctan2(
        c[5], c[1]
    )
    turn = np.abs(np.remainder(turn + np.pi, 2 * np.pi) - np.pi)
    turned = np.cumsum(turn) - turn
    turned -= turned[raster.first][raster.lane]
    key = np.stack([raster.lane, raster.start // _CHUNK_LENGTH, turned // _CHUNK_TURN])
    head = np.flatnonzero(np.append(True, (np.diff(key) != 0).any(0)))  # first interval of each chunk
    tail = np.append(head[1:], len(h)) - 1
    chunk_lane = raster.lane[head]
    ends = np.stack([polynomial(c[:4, tail], h[tail]), polynomial(c[4:8, tail], h[tail])], -1)
    span = np.stack([raster.start[head], raster.start[tail] + h[tail]], -1)
    chunks = np.concatenate([span, rows[head][:, [0, 4]], ends], -1)

    # Points at most 2 m apart along each interval: no point of it is more than 1 m from one of them.
    parts = np.maximum(1, np.ceil(h / 2.0).astype(np.int64))
    row = np.repeat(np.arange(len(h)), parts)
    part = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    u = h[row] * (part + 0.5) / parts[row]
    xy = np.stack([polynomial(c[:4, row], u), polynomial(c[4:8, row], u)], -1)
    chunk = (np.searchsorted(head, np.arange(len(h)), side="right") - 1)[row]
    found = []
    base = np.floor(xy / _CELL)
    around = math.ceil((REACH + 1.01) / _CELL)
    for step in np.ndindex(2 * around + 1, 2 * around + 1):
        cell = base + step - around
        outside = np.maximum(np.maximum(cell * _CELL - xy, xy - (cell + 1) * _CELL), 0.0)
        near = np.hypot(*outside.T) <= REACH + 1.01
        found.append(np.column_stack([cell[near].astype(np.int64), chunk[near]]))
    entries = np.unique(np.concatenate(found), axis=0)
    cells = np.unique(entries[:, :2], axis=0)
    size = 1 << (max(2 * len(cells), _LEAST["cells"]) - 1).bit_length()
    keyed = np.unique(np.column_stack([_hash(entries[:, 0], entries[:, 1], size), entries[:, 2]]), axis=0)
    return {
        "chunk_lane": _pad(chunk_lane, bucket(len(chunk_lane), _LEAST["chunks"]), NO_LANE),
        "chunk": _pad(chunks, bucket(len(chunks), _LEAST["chunks"]), 0.0),
        "cell_start": np.searchsorted(keyed[:, 0], np.arange(size + 1)),
        "cell_chunks": _pad(keyed[:, 1], bucket(len(keyed), _LEAST["candidates"]), 0),
    }
