"""When two vehicles meet that go on along their lanes.

A straight line through a bend leads into the oncoming lane, and one from the middle of a turn into a vehicle
that waits beside it. A lane change ends in the middle of the next lane, but a straight line through it goes
on across. So a time to collision of boxes that keep their velocities counts only if the bodies also meet
along their paths.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.maps.lane_map import NO_LANE, LaneMap, pose, side_s, width
from limsim_jax.metrics.safety import NONE, encounter, overlaps
from limsim_jax.numerics import safe_divide
from limsim_jax.traffic.ego import at_slots, is_free
from limsim_jax.traffic.motion import lateral_speed, pace
from limsim_jax.types import State
from limsim_jax.xla import mapped_like

COURSE = 5.0
"""s for which paths are followed; a longer time to collision is not checked."""

_EVERY = 0.25  # s between looks: at 20 m/s less than the length of a body
_AT_ONCE = 8  # vehicles that are looked at together
_ROUNDING = 0.1  # m


class Course(NamedTuple):
    """How others drive relative to the ego, `[N]`."""

    meets: Float[Array, " N"]  # s from now, not before that bodies touch along their lanes; `NONE`
    follows: Bool[Array, " N"]  # it drives behind the ego on a path that leads over the ego's lane
    leads: Bool[Array, " N"]  # it drives ahead of the ego on the ego's path


class Aside(NamedTuple):
    """How vehicles go on across their lanes, `[N]`; `to` 0: they keep their offset."""

    to: Float[Array, " N"]  # m, left > 0: from here to the middle of the lane that they move to
    pace: Float[Array, " N"]  # m/s, how fast


class OnLanes(NamedTuple):
    """Vehicles on their lanes, `N` slots."""

    way: Int[Array, "N D"]  # lanes to come, the own one first
    lane: Int[Array, " N"]  # one of them, now
    s: Float[Array, " N"]  # m, front bumper
    v: Float[Array, " N"]  # m/s
    box: Float[Array, "N 5"]  # x, y (m), heading (rad), length, width (m)
    aside: Aside
    other: Int[Array, " N"]  # the second lane of a vehicle that changes lanes, `NO_LANE` for all others


@jax.named_scope("aside")
def aside(lane_map: LaneMap, state: State) -> Aside:
    """How vehicles go on across their lanes.

    A lane change ends in the middle of the lane that it leads to, in the time that it still takes. An ego in
    the plane that is over a line, or signals, goes on as fast as now: to the middle of the lane that lies
    there, or across, if there is none.
    """
    egos, free = state.egos, is_free(state)
    heading = pose(lane_map, state.lane[egos.slot], state.s[egos.slot])[2]
    across = state.v[egos.slot] * jnp.sin(egos.heading - heading)
    w = at_slots(egos, across, lateral_speed(state), egos.free)
    half = width(lane_map, state.lane, state.s) / 2
    over = jnp.abs(state.d) + state.shape.width / 2 > half
    shown = state.side.astype(w.dtype)
    leaves = ((state.d * w > 0) & over) | (shown * w > 0)
    side = jnp.where(free, jnp.where(leaves, jnp.sign(w), 0), jnp.where(state.crossed, 0, shown))
    beside = jnp.where(side > 0, lane_map.left[state.lane], lane_map.right[state.lane])
    between = half + width(lane_map, beside, side_s(lane_map, state.lane, state.s, side)) / 2
    to = jnp.where(beside == NO_LANE, w * COURSE, side * between - state.d)
    to = jnp.where(side == 0, -state.d, to)
    goes = state.active & jnp.where(free, leaves | (over & (state.d * w < 0)), state.side != 0)
    left = (1 - state.progress) * state.driver.lane_change_time  # s, at least
    across = pace(state) * safe_divide(jnp.abs(to), left)
    return Aside(to=jnp.where(goes, to, 0), pace=jnp.where(free, jnp.abs(w), across))


@jax.named_scope("course")
def course(
    lane_map: LaneMap, slot: Int[Array, ""], vehicles: OnLanes, near: Bool[Array, " N"] | None = None
) -> Course:
    """The course of all vehicles relative to the ego in `slot`.

    Bodies keep their offset and their angle to the lane, but for what they still go `aside`. A vehicle that
    has changed lanes since its `way` was known goes on along its lane; one without a lane may meet any.

    Args:
      lane_map: where.
      slot: of the ego.
      vehicles: all of them.
      near: those whose `meets` is wanted; the others get `NONE`. None: all.
    """
    way, lane = vehicles.way, vehicles.lane
    here, known = way == lane[:, None], lane != NO_LANE
    alone = jnp.full_like(way, NO_LANE).at[:, 0].set(lane)
    way = jnp.where(here.any(-1)[:, None], way, alone)
    wanted = jnp.ones_like(known) if near is None else near
    meets = _meets(lane_map, slot, vehicles._replace(way=way), jnp.argmax(here, -1), wanted)
    same = lane == lane[slot]
    mine = (lane[:, None] == way[slot][None, :]).any(-1) & known
    over = (way == lane[slot]).any(-1) & known[slot]
    follows = over & ~(mine & ~same) & ~(same & (vehicles.s >= vehicles.s[slot]))
    leads = mine & ~(same & (vehicles.s <= vehicles.s[slot]))
    joins, ahead = _beside(vehicles, slot)
    return Course(
        meets=jnp.where(known & known[slot], meets, 0),
        follows=follows | (joins & (ahead < 0)),
        leads=leads | (joins & (ahead > 0)),
    )


def comes_near(
    slot: Int[Array, ""], box: Float[Array, "N 5"], velocity: Float[Array, "N 2"]
) -> Bool[Array, " N"]:
    """Vehicles that may touch the one in `slot` on straight lines.

    All keep their velocities for `COURSE` s. Circles around their bodies meet; boxes of all others do not.
    """
    place, motion = box[:, :2] - box[slot, None, :2], velocity - velocity[slot, None]
    square = jnp.sum(motion * motion, -1)
    nearest = safe_divide(-jnp.sum(place * motion, -1), square)
    apart = place + motion * jnp.clip(nearest, 0, COURSE)[:, None]
    radius = jnp.sqrt(jnp.sum(box[:, 3:] * box[:, 3:], -1)) / 2
    reach = radius + radius[slot] + _ROUNDING
    return jnp.sum(apart * apart, -1) <= reach * reach


def _meets(
    lane_map: LaneMap,
    slot: Int[Array, ""],
    vehicles: OnLanes,
    first: Int[Array, " N"],
    near: Bool[Array, " N"],
) -> Float[Array, " N"]:
    """s from now, not before that bodies touch along their lanes; of those not `near` the ego `NONE`.

    `first`: column of `way` of the own lane. Few vehicles are near, so some are looked at at once, and then
    the next ones, if there are more.
    """
    rows, slots = lax.stop_gradient((vehicles, first)), jnp.arange(near.shape[0])
    rank = jnp.where(near, jnp.cumsum(near) - 1, -1)

    def boxes(which: Int[Array, " K"]) -> Float[Array, "T K 5"]:
        some, column = jax.tree.map(lambda x: x[which], rows)
        return jnp.moveaxis(_ahead(lane_map, some, column), 0, 1)

    ego = boxes(slot[None])[:, 0]
    still = jnp.zeros_like(ego[0, :2])

    def touching(ego: Float[Array, " 5"], others: Float[Array, "K 5"]) -> Bool[Array, " K"]:
        return overlaps(encounter(ego, still, others, jnp.broadcast_to(still, others[:, :2].shape)))

    def look(turn: Int[Array, ""], meets: Float[Array, " N"]) -> Float[Array, " N"]:
        those = rank[:, None] == turn * _AT_ONCE + jnp.arange(_AT_ONCE)[None]  # [N, K]
        which = jnp.max(jnp.where(those, slots[:, None], 0), 0)
        touches = jax.vmap(touching)(ego, boxes(which))  # [T, K]
        looks = jnp.arange(touches.shape[0], dtype=meets.dtype)
        touch = jnp.min(jnp.where(touches, looks[:, None], NONE), 0)
        time = jnp.where(touch < NONE, jnp.maximum(touch - 1, 0) * _EVERY, NONE)  # or since the last look
        return jnp.where(those.any(-1), jnp.min(jnp.where(those, time[None], NONE), -1), meets)

    turns = (jnp.sum(near, dtype=jnp.int32) + _AT_ONCE - 1) // _AT_ONCE
    return lax.fori_loop(0, turns, look, mapped_like(vehicles.s, jnp.full(near.shape, NONE)))


def _beside(vehicles: OnLanes, slot: Int[Array, ""]) -> tuple[Bool[Array, " N"], Float[Array, " N"]]:
    """Vehicles on the lane of a lane change, and m ahead."""
    lane, other, x, y = vehicles.lane, vehicles.other, vehicles.box[:, 0], vehicles.box[:, 1]
    joins = (other == lane[slot]) & (other != NO_LANE)
    joined = (lane == other[slot]) & (lane != NO_LANE)
    heading = vehicles.box[slot, 2]
    ahead = jnp.cos(heading) * (x - x[slot]) + jnp.sin(heading) * (y - y[slot])
    return joins | joined, ahead


def _ahead(lane_map: LaneMap, vehicles: OnLanes, first: Int[Array, " N"]) -> Float[Array, "N T 5"]:
    """Boxes at moments from now to `COURSE` s ahead; `first`: column of `way` of the own lane."""
    way, box = vehicles.way, vehicles.box
    length = jnp.where(way == NO_LANE, 0, lane_map.length[way])
    end = jnp.cumsum(length, -1)
    start = end - length
    time = jnp.arange(0, COURSE + _EVERY / 2, _EVERY, dtype=box.dtype)
    along = jnp.take_along_axis(start, first[:, None], -1) + vehicles.s[:, None]
    along = along + vehicles.v[:, None] * time[None]
    beyond = (along[:, :, None] > end[:, None, :-1]) & (way != NO_LANE)[:, None, 1:]
    column = jnp.sum(beyond, -1, dtype=jnp.int32)
    lane = jnp.take_along_axis(way, column, -1)
    x, y, heading = pose(lane_map, lane, along - jnp.take_along_axis(start, column, -1))
    # where the body is as its path sees it stays the same, until it has gone aside
    to, pace = (value[:, None] for value in vehicles.aside)
    gone = jnp.minimum(pace * time[None], jnp.abs(to))
    turned = jnp.where((to != 0) & (gone >= jnp.abs(to)), 0, box[:, 2:3] - heading[:, :1])
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    dx, dy = box[:, :1] - x[:, :1], box[:, 1:2] - y[:, :1]
    ahead, left = cos[:, :1] * dx + sin[:, :1] * dy, cos[:, :1] * dy - sin[:, :1] * dx
    left = left + jnp.sign(to) * gone
    shape = jnp.broadcast_to(box[:, None, 3:], (*x.shape, 2))
    place = (
        x + cos * ahead - sin * left,
        y + sin * ahead + cos * left,
        heading + turned,
    )
    return jnp.concatenate([jnp.stack(place, -1), shape], -1)
