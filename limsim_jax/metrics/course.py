"""Whether two vehicles are on a course to meet: both go on along their lanes, not along straight lines.

A straight line through a bend leads into the oncoming lane, and one from the middle of a turn into a vehicle
that waits beside it. So a time to collision of boxes that keep their velocities counts only if the bodies
also meet along their paths.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.maps.lane_map import NO_LANE, LaneMap, pose
from limsim_jax.metrics.safety import encounter, overlaps

COURSE = 5.0
"""s for which paths are followed; a longer time to collision is not checked."""

_EVERY = 0.25  # s between looks: at 20 m/s less than the length of a body


class Course(NamedTuple):
    """How others drive relative to the ego, `[N]`."""

    meets: Bool[Array, " N"]  # bodies touch within `COURSE` s if both keep to their lanes and speeds
    follows: Bool[Array, " N"]  # it drives behind the ego on a path that leads over the ego's lane


class OnLanes(NamedTuple):
    """Vehicles on their lanes, `N` slots."""

    way: Int[Array, "N D"]  # lanes to come, the own one first
    lane: Int[Array, " N"]  # one of them, now
    s: Float[Array, " N"]  # m, front bumper
    v: Float[Array, " N"]  # m/s
    box: Float[Array, "N 5"]  # x, y (m), heading (rad), length, width (m)


@jax.named_scope("course")
def course(lane_map: LaneMap, slot: Int[Array, ""], vehicles: OnLanes) -> Course:
    """The course of all vehicles relative to the ego in `slot`.

    Bodies keep their offset and their angle to the lane. A vehicle whose lane is not among its `way` may
    meet any.
    """
    way, lane = vehicles.way, vehicles.lane
    here = (way == lane[:, None]) & (lane != NO_LANE)[:, None]
    known = here.any(-1)
    box = _ahead(lane_map, vehicles, jnp.argmax(here, -1))  # [N, T, 5]
    none = jnp.zeros_like(box[..., :2])

    def touching(ego: Float[Array, " 5"], others: Float[Array, "N 5"]) -> Bool[Array, " N"]:
        return overlaps(encounter(ego, none[0, 0], others, none[:, 0]))

    touches = jax.vmap(touching, (0, 1))(box[slot], box).any(0)
    mine, same = way[slot], lane == lane[slot]
    leads = (lane[:, None] == mine[None, :]).any(-1) & ~same
    over = (way == lane[slot]).any(-1) & (lane[slot] != NO_LANE)
    follows = over & ~leads & ~(same & (vehicles.s >= vehicles.s[slot]))
    return Course(meets=touches | ~known | ~known[slot], follows=follows)


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
    # where the body is as its path sees it stays the same
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    dx, dy = box[:, :1] - x[:, :1], box[:, 1:2] - y[:, :1]
    ahead, left = cos[:, :1] * dx + sin[:, :1] * dy, cos[:, :1] * dy - sin[:, :1] * dx
    shape = jnp.broadcast_to(box[:, None, 3:], (*x.shape, 2))
    place = (
        x + cos * ahead - sin * left,
        y + sin * ahead + cos * left,
        heading + box[:, 2:3] - heading[:, :1],
    )
    return jnp.concatenate([jnp.stack(place, -1), shape], -1)
