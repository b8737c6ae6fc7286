"""The reference path of a vehicle: points along its route, along which planners plan.

A `ReferencePath` begins at the centre of the body (arc length 0) and follows the route along the middle of
the lanes.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.geometry import wrap_angle
from limsim_jax.maps.lane_map import NO_LANE, LaneMap, curvature, neighbor, pose, side_s, width
from limsim_jax.traffic.bodies import body_place
from limsim_jax.traffic.ego import Trajectory
from limsim_jax.traffic.motion import lateral_speed
from limsim_jax.types import State
from limsim_jax.xla import interval


@struct.dataclass(frozen=True, kw_only=True)
class ReferencePath:
    """Paths of `V` vehicles: `M` points, `step` m apart along the lanes of their routes."""

    x: Float[Array, "V M"]  # m
    y: Float[Array, "V M"]
    heading: Float[Array, "V M"]  # rad, without jumps along the path
    curvature: Float[Array, "V M"]  # 1/m
    limit: Float[Array, "V M"]  # m/s, speed limit
    left: Float[Array, "V M"]  # m from the middle of the lane to the edge of the roadway, both > 0
    right: Float[Array, "V M"]
    lane: Int[Array, "V M"]
    end: Float[Array, " V"]  # m to where the route leaves these lanes; beyond it the path is straight
    step: float = struct.field(pytree_node=False)

    @property
    def reach(self) -> float:
        """m from the first point to the last."""
        return self.step * (self.x.shape[-1] - 1)

    def at(self, s: Float[Array, "V ..."], d: Float[Array, "V ..."] | float = 0.0) -> Place:
        """Points `s` m along and `d` m left of each path; see `to_cartesian`."""
        return to_cartesian(self, s, jnp.broadcast_to(jnp.asarray(d, s.dtype), s.shape))

    def trajectory(
        self,
        s: Float[Array, "V H"],
        v: Float[Array, "V _"],
        t0: Float[Array, ""],
        dt: float,
        d: Float[Array, "V H"] | float = 0.0,
    ) -> Trajectory:
        """A trajectory along the path.

        Args:
          s: m along the path, of the centre of the body, at each sample.
          v: m/s, at each sample or one for all.
          t0: s, time of the first sample; `config.time(state.step)` is now.
          dt: s between samples.
          d: m left of the path.
        """
        place, v = self.at(s, d), jnp.broadcast_to(v, s.shape)
        return Trajectory(x=place.x, y=place.y, heading=place.heading, v=v, t0=t0, dt=dt)


class Frenet(NamedTuple):
    """Motion along and across a path, at its first point."""

    s: Float[Array, " V"]  # m
    v: Float[Array, " V"]  # m/s along
    a: Float[Array, " V"]  # m/s^2
    d: Float[Array, " V"]  # m, left > 0
    d_v: Float[Array, " V"]  # m/s across
    d_a: Float[Array, " V"]  # m/s^2
    slope: Float[Array, " V"]  # m/m, of d over s
    bend: Float[Array, " V"]  # 1/m, second derivative of d over s


def path_from(
    lane_map: LaneMap,
    lane: Int[Array, " V"],
    s: Float[Array, " V"],
    goal: Int[Array, " V"],
    *,
    points: int,
    step: float,
    lanes: int = 5,
    after: Int[Array, " V"] | None = None,
) -> ReferencePath:
    """Paths from `s` on `lane` along the route to `goal`.

    Args:
      lane_map: the map.
      lane: rows of the lane map; NO_LANE gives a path without meaning, but with finite numbers.
      s: m, arc length of the first point.
      goal: columns of the route table.
      points: of each path.
      step: m between points.
      lanes: lanes beyond the first; after the last the path is straight.
      after: the lane after the first, where the front is already on it; otherwise NO_LANE.
    """
    routes = lane_map.routes
    ids, starts, end = [lane], [-s], jnp.full_like(s, 1e6)
    for _ in range(lanes):
        start = starts[-1] + lane_map.length[ids[-1]]
        following = routes.next_lane[ids[-1], goal]
        if after is not None and len(ids) == 1:
            following = jnp.where(after == NO_LANE, following, after)
        end = jnp.where(following == NO_LANE, jnp.minimum(end, start), end)
        ids.append(following)
        starts.append(jnp.where(following == NO_LANE, 1e9, start))
    rows, begins = jnp.stack(ids, -1), jnp.stack(starts, -1)  # [V D]
    at = step * jnp.arange(points, dtype=s.dtype)
    which = jnp.sum(begins[:, None, :] <= at[None, :, None], -1) - 1  # [V M]
    which = jnp.maximum(which, 0)
    here = jnp.take_along_axis(rows, which, -1)
    there = at[None] - jnp.take_along_axis(begins, which, -1)
    x, y, heading = pose(lane_map, here, there)
    turn = wrap_angle(jnp.diff(heading, axis=-1))
    heading = jnp.concatenate([heading[:, :1], heading[:, :1] + jnp.cumsum(turn, -1)], -1)
    half = width(lane_map, here, there) / 2

    def beside(side: int) -> Float[Array, "V M"]:
        other = (lane_map.left if side > 0 else lane_map.right)[here]
        place = side_s(lane_map, here, there, jnp.full_like(here, side))
        return half + jnp.where(other == NO_LANE, 0, width(lane_map, other, place))

    inside = there <= lane_map.length[here]
    return ReferencePath(
        x=x,
        y=y,
        heading=heading,
        curvature=jnp.where(inside, curvature(lane_map, here, there), 0),
        limit=lane_map.speed_limit[here],
        left=beside(1),
        right=beside(-1),
        lane=here,
        end=end,
        step=step,
    )


def reference_path(
    lane_map: LaneMap,
    state: State,
    slot: Int[Array, " V"] | None = None,
    *,
    points: int = 60,
    step: float = 2.0,
) -> ReferencePath:
    """Reference paths of the egos, or of the vehicles in `slot`.

    Args:
      lane_map: the map.
      state: the world now.
      slot: of the vehicles; None: those of the egos.
      points: of each path.
      step: m between points.
    """
    slot = state.egos.slot if slot is None else slot
    lane, s = body_place(lane_map, state, slot)
    after = jnp.where(lane == state.lane[slot], NO_LANE, state.lane[slot])
    return path_from(lane_map, lane, s, state.goal[slot], points=points, step=step, after=after)


def beside(
    lane_map: LaneMap,
    lane: Int[Array, " V"],
    s: Float[Array, " V"],
    d: Float[Array, " V"],
    side: Int[Array, " V"],
) -> tuple[Int[Array, " V"], Float[Array, " V"], Float[Array, " V"], Bool[Array, " V"]]:
    """A position in coordinates of an adjacent lane.

    The lane to the left (`side` 1) or right (-1). Returns lane, s, d, and whether there is such a lane.
    Otherwise, and with `side` 0, nothing changes.
    """
    other, _ = neighbor(lane_map, lane, side)
    there = (side != 0) & (other != NO_LANE)
    other_s = side_s(lane_map, lane, s, side)
    between = (width(lane_map, lane, s) + width(lane_map, other, other_s)) / 2
    return (
        jnp.where(there, other, lane),
        jnp.where(there, other_s, s),
        jnp.where(there, d - side.astype(between.dtype) * between, d),
        there,
    )


def motion_on(path: ReferencePath, state: State, slot: Int[Array, " V"], d: Float[Array, " V"]) -> Frenet:
    """Motion of vehicles along and across their paths.

    They are `d` m off the first points.

    Free egos move by their heading in the plane, the others by the progress of their lane change.
    """
    v, a, egos = state.v[slot], state.a[slot], state.egos
    astray, steered = jnp.zeros_like(v), path.curvature[:, 0]
    free = jnp.zeros(slot.shape, bool)
    if egos.slot.shape[0]:
        mine = (egos.slot[None, :] == slot[:, None]) & egos.free[None, :]  # [V E]
        free, pick = mine.any(-1), jnp.argmax(mine, -1)
        slip = jnp.arctan(jnp.tan(egos.steering[pick]) / 2)
        off = wrap_angle(egos.heading[pick] + slip - path.heading[:, 0])
        astray = jnp.where(free, jnp.clip(off, -1.0, 1.0), astray)
        turned = jnp.sin(slip) * 2 / state.shape.wheelbase[slot]
        steered = jnp.where(free, turned, steered)
        a = jnp.where(free, egos.a[pick], a)
    stretch = jnp.maximum(1 - path.curvature[:, 0] * d, 0.2)
    slope = jnp.where(free, jnp.tan(astray), lateral_speed(state)[slot] / jnp.maximum(v, 0.5)) * stretch
    bend = steered - path.curvature[:, 0]
    along = v * jnp.cos(astray) / stretch
    return Frenet(
        s=jnp.zeros_like(v), v=along, a=a, d=d, d_v=slope * along, d_a=bend * along * along,
        slope=slope, bend=bend,
    )  # fmt: skip


class Place(NamedTuple):
    """Points in the plane; shapes as of the positions on the path."""

    x: Float[Array, ...]  # m
    y: Float[Array, "*b"]
    heading: Float[Array, ...]  # rad, of the path
    curvature: Float[Array, ...]  # 1/m, of the path


def to_cartesian(path: ReferencePath, s: Float[Array, "V ..."], d: Float[Array, "V ..."]) -> Place:
    """Cartesian position `s` m along and `d` m left of each path.

    Between its points a path is a cubic Hermite curve; before the first and beyond the last it is straight.
    """
    flat = (s.shape[0], -1)
    s_, d_ = s.reshape(flat), jnp.broadcast_to(d, s.shape).reshape(flat)
    k, u = interval(s_ / path.step, path.x.shape[-1] - 1)
    inside = jnp.clip(u, 0, 1)
    rest = (u - inside) * path.step

    def at(table: Float[Array, "V M"], n: int) -> Array:
        return jnp.take_along_axis(table, k + n, -1)

    x0, x1, y0, y1 = at(path.x, 0), at(path.x, 1), at(path.y, 0), at(path.y, 1)
    h0, h1, c0, c1 = at(path.heading, 0), at(path.heading, 1), at(path.curvature, 0), at(path.curvature, 1)
    h = path.step
    cos0, sin0, cos1, sin1 = jnp.cos(h0), jnp.sin(h0), jnp.cos(h1), jnp.sin(h1)
    t2 = inside * inside
    t3 = t2 * inside
    b1, b2, b3 = 3 * t2 - 2 * t3, inside - 2 * t2 + t3, t3 - t2
    x = x0 + b1 * (x1 - x0) + h * (b2 * cos0 + b3 * cos1)
    y = y0 + b1 * (y1 - y0) + h * (b2 * sin0 + b3 * sin1)
    heading = h0 + inside * (h1 - h0)
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    x = x + rest * cos - d_ * sin
    y = y + rest * sin + d_ * cos
    bend = jnp.where(rest == 0, c0 + inside * (c1 - c0), 0)
    return Place(*(value.reshape(s.shape) for value in (x, y, heading, bend)))


def project_onto(
    path: ReferencePath, x: Float[Array, "V ..."], y: Float[Array, "V ..."]
) -> tuple[Float[Array, "V ..."], Float[Array, "V ..."], Float[Array, "V ..."]]:
    """Positions relative to each path: s and d (m), and the path's heading (rad).

    Relative to the nearest point: exact on straights, and to half a step squared times the curvature in
    bends.
    """
    flat = (x.shape[0], -1)
    x_, y_ = x.reshape(flat), y.reshape(flat)
    far = (x_[..., None] - path.x[:, None]) ** 2 + (y_[..., None] - path.y[:, None]) ** 2
    k = jnp.argmin(far, -1)
    heading = jnp.take_along_axis(path.heading, k, 1)
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    dx, dy = x_ - jnp.take_along_axis(path.x, k, 1), y_ - jnp.take_along_axis(path.y, k, 1)
    s, d = k.astype(dx.dtype) * path.step + dx * cos + dy * sin, -dx * sin + dy * cos
    return s.reshape(x.shape), d.reshape(x.shape), heading.reshape(x.shape)
