"""Lanes as device arrays, and the look-ups on them.

Each lane is cut into intervals of equal arc length `ds`, a power of two between 1/8 m and 16 m. `s / ds` and
`i * ds` are thus exact in float32. The last interval takes the remainder (0.5 to 1.5 `ds`). The intervals of
all lanes lie end to end in one pool, so a 10 km lane and a 5 m connector share one map.

An interval is one row of 16 float32, a cache line: the cubic Hermite curve through the exact end poses, the
width as a cubic, the curvature as a line. Each lane has the largest `ds` that keeps its rows within
`rasterise.TOLERANCE` of the lane of the network.

Look-ups take one `lane` and one `s`, or arrays of one shape. The last row of every array is an inert null
lane, so `NO_LANE` is a valid index everywhere. Look-ups are differentiable in everything but `lane`. Where a
lane is kinked, the gradient is that of the curve that rounds the kink.

Coordinates are relative to `LaneMap.origin`, a whole number of metres that is subtracted in float64.
float32 resolves 0.25 mm within 4 km of it and 0.5 mm within 8 km. `absolute` converts to file coordinates.

Cost on one CPU core: a pose reads 12 B of lane table and 36 B of one row, and is bound by arctan2 and these
gathers. A local projection reads five rows, and is bound by the dependent gathers of its Newton steps.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

from limsim_jax.geometry import derivative, direction, polynomial, wrap_angle
from limsim_jax.maps.conflicts import ConflictTable
from limsim_jax.maps.network import LaneType, Network
from limsim_jax.maps.route_table import RouteTable
from limsim_jax.maps.signal_table import SignalTable
from limsim_jax.numerics import safe_divide, safe_sqrt
from limsim_jax.xla import computed_once, mapped_like

if TYPE_CHECKING:
    from limsim_jax.maps.scenery import Scenery

NO_LANE = -1
"""Row of the null lane."""

Index = Int[Array, "*#b"] | Int[np.ndarray, "*#b"] | int
Number = Float[Array, "*#b"] | Float[np.ndarray, "*#b"] | float
Goals = Sequence[Sequence[str]] | Mapping[str, Sequence[str]]

EARLIER = 3
"""Lanes that a vehicle remembers beyond its own and the one before."""

VEHICLE_CLASSES = ("car", "van", "truck", "bus", "motorcycle", "emergency")
"""Vehicle classes in the order of the bits of `LaneMap.access`."""

LANE_TYPES = tuple(LaneType)
"""Lane types in the order of the codes in `LaneMap.lane_type`."""

REACH = 10.0
"""`project` finds lanes whose centre line is within this distance, m."""

CELL = 8.0
"""Side of the square cells that `project` looks up, m."""

_LOCAL_STEPS = 4  # Newton steps of `to_frenet` before the differentiable one
_GLOBAL_STEPS = 4  # Newton or bisection steps per candidate of `project`
_MIN_SLOPE = 0.1  # least 1 - kappa d that a Newton step divides by


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
    stop_s: Float[Array, " L"]  # m, where the front bumper stops: last stop line or end of the lane
    stand_back: Float[Array, " L"]  # m before `stop_s`, to wait out of the way of a path over the line
    start_s: Float[Array, " L"]  # m, where an opening lane becomes wide enough; otherwise 0
    end_s: Float[Array, " L"]  # m, where a closing lane becomes too narrow; otherwise its length
    curvature_max: Float[Array, " L"]  # 1/m, largest |mean curvature| over any `rasterise.TURN_WINDOW`
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
    junction: Int[Array, " L"]  # index into the network's junctions, or -1
    valid: Bool[Array, " L"]  # False for the null lane and padding
    chunk_lane: Int[Array, " C"]  # short stretches of lane: what `project` compares
    chunk: Float[Array, "C 6"]  # m, first and last s; x, y of the first and of the last
    cell_start: Int[Array, " H1"]  # hashed cell h holds cell_chunks[cell_start[h] : cell_start[h + 1]]
    cell_chunks: Int[Array, " Q"]
    conflicts: ConflictTable
    routes: RouteTable
    signals: SignalTable
    scenery: Scenery | None = None  # what sensors see of the map, where a policy needs it
    lanes_in_sight: int = struct.field(pytree_node=False, default=0)
    """Lanes that a vehicle may have to scan to see `rasterise.SIGHT` m ahead."""
    lanes_behind: int = struct.field(pytree_node=False, default=2)
    """Lanes behind its own on which a vehicle may have its tail."""
    approaches: int = struct.field(pytree_node=False, default=3)
    """Connectors that a vehicle looks at: those of a way across a junction, and two more."""


def lane_rows(network: Network) -> dict[str, int]:
    """Row of every drivable lane by lane id, in file order."""
    return {lane.id: row for row, lane in enumerate(network.drivable_lanes())}


def lane_ids(network: Network) -> list[str]:
    """Lane id of every row: the inverse of `lane_rows`."""
    return [lane.id for lane in network.drivable_lanes()]


def bucket(count: int, least: int = 1) -> int:
    """Size of a padded axis: 0, 1, 2, 3, 4, 6, 8, 12, 16, 24, ...

    It is the least of these that is at least `count` and `least`. Few sizes mean few compilations.
    """
    count = max(count, least)
    if count == 0:
        return 0
    power = 1 << (count - 1).bit_length()
    return 3 * power // 4 if power >= 4 and count <= 3 * power // 4 else power


# --- look-ups ----------------------------------------------------------------------------------------


def pose(
    lane_map: LaneMap, lane: Index, s: Number, d: Number = 0.0
) -> tuple[Float[Array, "*#b"], Float[Array, "*#b"], Float[Array, "*#b"]]:
    """Cartesian position of a place on a lane.

    Beyond its ends a lane continues straight.

    Args:
        lane_map: the map.
        lane: row of the lane.
        s: arc length, m.
        d: lateral offset, m, left > 0.

    Returns:
        x, y (m) in map coordinates, and the heading of the lane (rad).
    """
    s, d = _as_float(lane_map, s), _as_float(lane_map, d)
    row, u = _locate(lane_map, lane, s)
    curve = _curve(lane_map, row, u)
    tx, ty = _unit(curve.dx, curve.dy)
    return curve.x0 + (curve.x - d * ty), curve.y0 + (curve.y + d * tx), direction(curve.dx, curve.dy)


def curvature(lane_map: LaneMap, lane: Index, s: Number) -> Float[Array, "*#b"]:
    """Curvature of the centre line, 1/m, positive in a left bend.

    Beyond the ends of the lane it is that of the end.
    """
    row, u = _locate(lane_map, lane, _as_float(lane_map, s))
    u = _inside(lane_map, row, u)
    return polynomial(_columns(lane_map.rows, row, range(12, 14)), u)


def width(lane_map: LaneMap, lane: Index, s: Number) -> Float[Array, "*#b"]:
    """Lane width, m; beyond the ends of the lane that of the end."""
    row, u = _locate(lane_map, lane, _as_float(lane_map, s))
    return polynomial(_columns(lane_map.rows, row, range(8, 12)), _inside(lane_map, row, u))


def elevation(lane_map: LaneMap, lane: Index, s: Number) -> tuple[Float[Array, "*#b"], Float[Array, "*#b"]]:
    """Elevation z (m) and grade dz/ds of the centre line.

    Beyond the ends of the lane they are those of the end.
    """
    row, u = _locate(lane_map, lane, _as_float(lane_map, s))
    u = _inside(lane_map, row, u)
    cubic = _columns(lane_map.height, row, range(4))
    return polynomial(cubic, u), polynomial(derivative(cubic), u)


def neighbor(lane_map: LaneMap, lane: Index, side: Index) -> tuple[Int[Array, "*#b"], Bool[Array, "*#b"]]:
    """The adjacent lane, and whether a vehicle may change to it.

    It runs in the same direction; `side` > 0 is the left. It is NO_LANE where there is none.
    """
    left = jnp.asarray(side) > 0
    return (
        jnp.where(left, lane_map.left[lane], lane_map.right[lane]),
        jnp.where(left, lane_map.may_change_left[lane], lane_map.may_change_right[lane]),
    )


def side_s(lane_map: LaneMap, lane: Index, s: Number, side: Index) -> Float[Array, "*#b"]:
    """Arc length (m) on the adjacent lane, level with `s` on `lane`.

    `side` > 0 is the left. Without an adjacent lane the result is `s` itself.
    """
    row, u = _locate(lane_map, lane, _as_float(lane_map, s))
    start_l, slope_l, start_r, slope_r = _columns(lane_map.side, row, range(4))
    left = jnp.asarray(side) > 0
    return jnp.where(left, start_l, start_r) + u * jnp.where(left, slope_l, slope_r)


def room_beside(lane_map: LaneMap, lane: Index, s: Number, side: Index) -> Float[Array, "*#b"]:
    """Distance (m) from `s` on which the adjacent lane runs beside.

    `side` > 0 is the left. Lanes that follow count while both continue side by side.
    """
    beside = lane_map.beside_s[lane]
    return jnp.where(jnp.asarray(side) > 0, beside[..., 0], beside[..., 1]) - _as_float(lane_map, s)


def turn_speed(lane_map: LaneMap, lane: Index, lateral_acceleration: Number) -> Float[Array, "*#b"]:
    """Speed (m/s) through the tightest bend, at most the speed limit.

    SUMO limits junctions by a lateral acceleration of 5.5 m/s^2. Comfortable driving stays within 2 to
    3 m/s^2.
    """
    return jnp.minimum(bend_speed(lane_map, lane, lateral_acceleration), lane_map.speed_limit[lane])


def bend_speed(lane_map: LaneMap, lane: Index, lateral_acceleration: Number) -> Float[Array, "*#b"]:
    """Speed (m/s) at which the tightest bend takes this lateral acceleration (m/s^2).

    It is 1e6 on straight lanes.
    """
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
    """Project a point onto a known lane.

    Newton steps find the foot of the perpendicular nearest to `s_guess`; they may cross any number of
    intervals. A point before the start has `s < 0` and one past the end `s > length`, measured along the
    end tangent. The caller may then continue with a predecessor (`s + its length`) or a successor
    (`s - length`).

    The result is valid where `1 - kappa d > 0`: the point is nearer than the centre of curvature.
    Gradients are those of the exact projection (implicit function theorem); that of `s_guess` is zero.

    Args:
        lane_map: the map.
        lane: row of the lane.
        s_guess: the last known arc length, m.
        x: map coordinates of the point, m.
        y: the same.

    Returns:
        Arc length `s` (m), lateral offset `d` (m, left > 0), heading of the lane there (rad).
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
    """Project a point onto the nearest lane.

    Candidates are the feet of all perpendiculars on centre lines, and the ends of lanes, within `REACH`.
    Of equal distances the lower row wins. A point beyond the centre of a bend sees two ends of it and no
    foot between; with `heading`, only the nearer end is a candidate.

    Meant for the start of a run: `to_frenet` is some hundred times faster.

    Args:
        lane_map: the map.
        x: map coordinates of the point, m.
        y: the same.
        heading: direction of the vehicle, rad; without it, lanes of any direction are candidates.
        max_heading: largest difference between `heading` and that of the lane, rad.

    Returns:
        Row of the lane (NO_LANE if there is none), `s` and `d` (m), heading of the lane there (rad).
    """
    x, y = _as_float(lane_map, x), _as_float(lane_map, y)
    frozen, px, py = lax.stop_gradient((lane_map, x, y))
    cell = cell_row(jnp.floor(px / CELL), jnp.floor(py / CELL), lane_map.cell_start.shape[0] - 1)
    start, count = frozen.cell_start[cell], frozen.cell_start[cell + 1] - frozen.cell_start[cell]

    def compare(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        k, best, best_lane, best_s = carry
        chunk = frozen.cell_chunks[start + jnp.minimum(k, count - 1)]
        lane = frozen.chunk_lane[chunk]
        low, high, x0, y0, x1, y1 = _columns(frozen.chunk, chunk, range(6))
        # Downhill from the nearer end: inside a bend the distance has its maximum between two ends.
        s = jnp.where(jnp.hypot(px - x0, py - y0) <= jnp.hypot(px - x1, py - y1), low, high)
        s = _search(frozen, lane, s, low, high, px, py, _GLOBAL_STEPS)
        # An end of the stretch is no foot: continue to the foot, whose heading has to fit.
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
    """Map to file coordinates (m), on the host in float64."""
    x0, y0 = np.asarray(lane_map.origin, np.float64)
    return np.asarray(x, np.float64) + x0, np.asarray(y, np.float64) + y0


def relative(lane_map: LaneMap, x: Any, y: Any) -> tuple[Any, Any]:
    """File to map coordinates (m), on the host: the inverse of `absolute`."""
    x0, y0 = np.asarray(lane_map.origin, np.float64)
    return np.float32(np.asarray(x, np.float64) - x0), np.float32(np.asarray(y, np.float64) - y0)


def _as_float(lane_map: LaneMap, value: Any) -> Float[Array, "*#b"]:
    return jnp.asarray(value, lane_map.rows.dtype)


def _at(table: Array, index: Any) -> Array:
    """The entries at indices that are there. Others are indexed alike, but XLA has more to compile."""
    return jnp.asarray(table).at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _columns(table: Float[Array, "S W"], row: Int[Array, "*#b"], columns: Iterable[int]) -> list[Any]:
    # One gather per column: XLA fuses them with the arithmetic; whole rows would go through memory first.
    return [_at(table, (row, x)) for x in columns]


def _locate(
    lane_map: LaneMap, lane: Index, s: Float[Array, "*#b"]
) -> tuple[Int[Array, "*#b"], Float[Array, "*#b"]]:
    """Row of the interval at `s`, and distance from its start (m)."""
    k = jnp.asarray(lane)
    k = jnp.where(k < 0, k + lane_map.ds.shape[0], k)  # once, for all tables
    ds, count, first = (_at(table, k) for table in (lane_map.ds, lane_map.count, lane_map.first))
    index = jnp.clip(jnp.floor(s / ds).astype(jnp.int32), 0, count - 1)
    return computed_once((first + index, s - index.astype(s.dtype) * ds))


def _inside(lane_map: LaneMap, row: Int[Array, "*#b"], u: Float[Array, "*#b"]) -> Float[Array, "*#b"]:
    # Not jnp.clip: its gradient on the bounds is a half.
    end = _at(lane_map.rows, (row, 14))
    return jnp.where(u < 0, 0, jnp.where(u > end, end, u))


class _Curve(NamedTuple):
    """The centre line at a place: position relative to the start of its interval, and derivatives by s."""

    x0: Any  # start of the interval, m; kept apart so that differences to it stay exact in float32
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

    def once(_: Int[Array, ""], found: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        s, behind, ahead = found
        step = _newton_step(_curve(lane_map, *_locate(lane_map, lane, s)), x, y)
        behind, ahead = jnp.where(step > 0, s, behind), jnp.where(step < 0, s, ahead)
        there = jnp.clip(s + step, low, high)
        return jnp.where((there >= behind) & (there <= ahead), there, (behind + ahead) / 2), behind, ahead

    s = jnp.broadcast_to(s, jnp.broadcast_shapes(*(jnp.shape(v) for v in (lane, s, low, high, x, y))))
    limits = jnp.full_like(s, low), jnp.full_like(s, high)
    # not unrolled: half of the programs that search would be this
    return lax.fori_loop(0, steps, once, mapped_like(s + x, (s, *limits)))[0]


def cell_row(ix: Any, iy: Any, size: int) -> Any:
    """Row of a grid cell in a table of `size` rows; cells that collide share a row.

    `ix` and `iy` count cells along x and y, as NumPy or JAX arrays of whole numbers.
    """
    integer = np.int32 if isinstance(ix, np.ndarray) else jnp.int32
    unsigned = np.uint32 if isinstance(ix, np.ndarray) else jnp.uint32
    mixed = ix.astype(integer).astype(unsigned) * unsigned(73856093) ^ iy.astype(integer).astype(
        unsigned
    ) * unsigned(19349663)
    return ((mixed ^ (mixed >> unsigned(15))) % unsigned(size)).astype(integer)
