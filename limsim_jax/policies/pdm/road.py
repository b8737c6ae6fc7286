"""The road ahead of the planned vehicles, its paths, and other vehicles."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.geometry import wrap_angle
from limsim_jax.maps.lane_map import NO_LANE, LaneMap, side_s, width
from limsim_jax.maps.signal_table import SignalState
from limsim_jax.maps.signals import lane_states
from limsim_jax.policies.predict import Predictor, nearest
from limsim_jax.policies.reference import ReferencePath, path_from
from limsim_jax.types import State
from limsim_jax.xla import computed_once

DT = 0.1
"""s between the poses of a proposal."""

STEPS = 40
"""Steps of a proposal."""

LOOK_EVERY = 2
"""Steps between two looks at the others."""

OFFSETS = (0.0, -1.0, 1.0)
"""m, of the three paths from the middle of the lane."""

SPACING = 2.0
"""m between points of the reference path."""

EDGE_MARGIN = 0.3
"""m between the body on a path and the edge of the road, for tracking errors."""

FAR = 1e6
"""m to an obstacle where there is none."""

_POINTS = 121  # of the reference path: 240 m
_KEEPS = 61  # points along which the whole body stays on the road: 120 m
_LANES = 6  # lanes of the centerline beyond the first
_CHANGE_WITHIN = 300.0  # m to the last place for a required lane change, within which it is wanted
_CHANGE_ROOM = 20.0  # m before that place, for a lane change from a standstill
_CHANGE_WORTH = 15.0  # m of progress that a required lane change is worth
_YELLOW = 3.0  # m/s^2, braking below which a vehicle stops at yellow
_CANNOT = 6.0  # m/s^2, braking above which a vehicle does not stop at red


class Body(NamedTuple):
    """The planned vehicles."""

    x: Float[Array, " V"]  # m, rear axle
    y: Float[Array, " V"]
    heading: Float[Array, " V"]  # rad
    v: Float[Array, " V"]  # m/s
    a: Float[Array, " V"]  # m/s^2
    steering: Float[Array, " V"]  # rad
    length: Float[Array, " V"]  # m
    width: Float[Array, " V"]
    wheelbase: Float[Array, " V"]

    @property
    def front(self) -> Float[Array, " V"]:
        """m from the rear axle to the front bumper; the axles lie around the centre."""
        return (self.wheelbase + self.length) / 2


class Road(NamedTuple):
    """The centerline ahead of the rear axle, and the paths along it."""

    centerline: ReferencePath
    s: Float[Array, " V"]  # m, of the rear axle
    d: Float[Array, " V"]  # m
    slope: Float[Array, " V"]  # m/m, of the heading against the centerline
    offset: Float[Array, "V 3"]  # m, of the paths from the centerline
    wall: Float[Array, "V 3"]  # m along the centerline to the stop obstacle of each path
    worth: Float[Array, "V 3"]  # m of progress that a path is worth in addition
    half: Float[Array, "V M"]  # m, half the width of the lane
    oncoming: Float[Array, "V M"]  # m, width of the oncoming lane beyond the left edge
    connector: Bool[Array, "V M"]  # inside a junction


class Others(NamedTuple):
    """The nearest others at `H` moments."""

    x: Float[Array, "H V K"]  # m
    y: Float[Array, "H V K"]
    cos: Float[Array, "H V K"]
    sin: Float[Array, "H V K"]
    length: Float[Array, "V K"]  # m
    width: Float[Array, "V K"]
    v: Float[Array, "V K"]  # m/s
    there: Bool[Array, "V K"]


def bodies(state: State, slot: Int[Array, " V"]) -> Body:
    """The vehicles of all rows of `Egos`."""
    egos, shape = state.egos, state.shape
    wheelbase = shape.wheelbase[slot]
    return Body(
        x=egos.x - wheelbase / 2 * jnp.cos(egos.heading),
        y=egos.y - wheelbase / 2 * jnp.sin(egos.heading),
        heading=egos.heading,
        v=state.v[slot],
        a=egos.a,
        steering=egos.steering,
        length=shape.length[slot],
        width=shape.width[slot],
        wheelbase=wheelbase,
    )


@jax.named_scope("pdm_road")
def road_ahead(lane_map: LaneMap, state: State, slot: Int[Array, " V"], body: Body, strict: bool) -> Road:
    """Centerline, paths, and stop obstacles: red lights and ends of lanes."""
    routes = lane_map.routes
    own, previous, goal, front = state.lane[slot], state.previous[slot], state.goal[slot], state.s[slot]
    to_go = routes.lanes_to_go[own, goal]
    within = routes.change_distance[own, goal] - front  # m to the last place to change lanes
    side = jnp.sign(to_go)
    beside = jnp.where(side > 0, lane_map.left[own], lane_map.right[own])
    may = jnp.where(side > 0, lane_map.may_change_left[own], lane_map.may_change_right[own])
    changes = (side != 0) & (beside != NO_LANE) & may & (within < _CHANGE_WITHIN)
    changes = changes & (not strict)
    lane = jnp.where(changes, beside, own)
    front = jnp.where(changes, side_s(lane_map, own, front, side), front)
    came_beside = jnp.where(side > 0, lane_map.left[previous], lane_map.right[previous])
    came = jnp.where(changes, came_beside, previous)

    # the centerline starts at the rear axle, which may be on the previous lane
    s = front - body.front
    behind = (s < 0) & (came != NO_LANE)
    first = jnp.where(behind, came, lane)
    after = jnp.where(behind, lane, NO_LANE)
    s = jnp.where(behind, s + lane_map.length[came], s)
    centerline = computed_once(
        path_from(lane_map, first, s, goal, points=_POINTS, step=SPACING, lanes=_LANES, after=after)
    )
    dx, dy = body.x - centerline.x[:, 0], body.y - centerline.y[:, 0]
    cos, sin = jnp.cos(centerline.heading[:, 0]), jnp.sin(centerline.heading[:, 0])
    d = cos * dy - sin * dx
    slope = jnp.tan(jnp.clip(wrap_angle(body.heading - centerline.heading[:, 0]), -0.5, 0.5))

    across = side.astype(d.dtype) * (width(lane_map, lane, front) + width(lane_map, own, state.s[slot])) / 2
    offset = jnp.broadcast_to(jnp.asarray(OFFSETS, d.dtype), (*d.shape, 3))
    if not strict:
        # in bends the corners swing out
        taken = (
            EDGE_MARGIN
            + body.width[:, None] / 2
            + jnp.abs(centerline.curvature) * body.length[:, None] ** 2 / 8
        )
        right, left = (
            jnp.min((x - taken)[:, :_KEEPS], 1)[:, None] for x in (centerline.right, centerline.left)
        )
        offset = jnp.clip(offset, -jnp.maximum(right, 0), jnp.maximum(left, 0))
    towards = jnp.stack([-across, jnp.sign(across) - across, jnp.zeros_like(across)], -1)
    offset = jnp.where(changes[:, None], towards, offset)
    ends = jnp.where(changes, body.front + within - _CHANGE_ROOM, FAR)
    own_end = jnp.stack([ends, ends, jnp.full_like(ends, FAR)], -1)
    wall = _wall(lane_map, state, body, first, s, goal, after, strict)
    worth = jnp.where(changes, _CHANGE_WORTH, 0.0)
    worth = jnp.stack([jnp.zeros_like(worth), jnp.zeros_like(worth), worth], -1)

    left_most = jnp.where(
        lane_map.left[centerline.lane] == NO_LANE, centerline.lane, lane_map.left[centerline.lane]
    )
    opposite = lane_map.opposite[left_most]
    return Road(
        centerline=centerline,
        s=cos * dx + sin * dy,
        d=d,
        slope=slope,
        offset=offset,
        wall=jnp.minimum(wall[:, None], own_end),
        worth=worth,
        half=_widths(lane_map, centerline.lane) / 2,
        oncoming=jnp.where(opposite == NO_LANE, 0, _widths(lane_map, opposite)),
        connector=lane_map.is_connector[centerline.lane],
    )


def _widths(lane_map: LaneMap, lane: Int[Array, "V M"]) -> Float[Array, "V M"]:
    """Width of lanes in their middle, m."""
    return width(lane_map, lane, lane_map.length[lane] / 2)


def _wall(
    lane_map: LaneMap,
    state: State,
    body: Body,
    lane: Int[Array, " V"],
    s: Float[Array, " V"],
    goal: Int[Array, " V"],
    after: Int[Array, " V"],
    strict: bool,
) -> Float[Array, " V"]:
    """m along the centerline to the first stop obstacle.

    It is a light that says stop, or the end of a lane that leads nowhere.
    """
    routes = lane_map.routes
    shows = lane_states(lane_map.signals, state.lights.phase)
    wall, start = jnp.full_like(s, FAR), -s
    for k in range(_LANES):
        end = start + lane_map.length[lane]
        following = routes.next_lane[lane, goal]
        if k == 0:
            following = jnp.where(after == NO_LANE, following, after)
        over = (following == NO_LANE) & (lane != NO_LANE) & ~routes.is_goal[lane, goal]
        wall = jnp.minimum(wall, jnp.where(over, end, FAR))
        line = end - (lane_map.length - lane_map.stop_s)[lane]
        room = line - body.front
        shown = shows[following]
        red = (shown == SignalState.RED) | (shown == SignalState.RED_YELLOW)
        if strict:
            stops = shown == SignalState.RED
        else:
            need = body.v * body.v / 2
            stops = red & (need <= _CANNOT * room)
            stops |= (shown == SignalState.YELLOW) & (need <= _YELLOW * room)
        stops &= (following != NO_LANE) & (room > 0)
        wall = jnp.minimum(wall, jnp.where(stops, line, FAR))
        start, lane = jnp.where(following == NO_LANE, FAR, end), following
    return wall


def others_around(
    lane_map: LaneMap,
    state: State,
    slot: Int[Array, " V"],
    predict: Predictor,
    count: int,
    moments: int,
    stop: Float[Array, " N"] | None = None,
) -> Others:
    """The `count` others that come nearest within the horizon, every `DT` s.

    `stop`: m to where each vehicle will stop, as for a `Predictor`.
    """
    times = jnp.arange(moments, dtype=state.v.dtype) * DT
    found = predict(lane_map, state, times, stop=stop)
    which = nearest(lane_map, state, _thinned(found), slot, count)
    heading = found.heading[which]
    pick = lambda values: jnp.moveaxis(values, -1, 0)  # noqa: E731
    return Others(
        x=pick(found.x[which]),
        y=pick(found.y[which]),
        cos=pick(jnp.cos(heading)),
        sin=pick(jnp.sin(heading)),
        length=found.length[which],
        width=found.width[which],
        v=state.v[which],
        there=which >= 0,
    )


def _thinned(prediction: Any) -> Any:
    """The prediction at every tenth moment, enough to find the nearest vehicles."""
    return prediction.replace(
        x=prediction.x[:, ::10],
        y=prediction.y[:, ::10],
        heading=prediction.heading[:, ::10],
        times=prediction.times[::10],
    )
