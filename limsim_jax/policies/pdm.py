"""PDM-Closed: fifteen ways to go on, simulated and scored, and the best one is driven.

Dauner, Hallgarten, Geiger, Chitta, Parting with Misconceptions about Learning-based Vehicle Motion Planning,
CoRL 2023, and its public implementation (tuplan_garage). Three paths (the middle of the lane and one metre
to either side) times five IDM drivers (0.2 to 1.0 of the speed limit) make proposals over 4 s. Each is
driven by nuPlan's LQR tracker and kinematic bicycle, and scored on contacts by its own fault, drivable area,
direction, progress, time to collision and comfort against a forecast of everybody at constant speed along
its heading. Who stands in front of a contact brakes.

By default a few things differ from the public implementation, whose conventions `strict_tuplan` brings back:

=====================  ====================================  =======================================
                       default                               strict
=====================  ====================================  =======================================
leader at the start    known                                 none: all brake hard for 0.1 s
speed                  not below 0                           may fall below 0 for a moment
standstill gap         2 m; who is nearer brakes hard        1 m; who is nearer brakes as at that gap
braking limit          6 m/s^2 behind others, else 3         3 m/s^2
speed limit            where the proposal is by then         of the lane at the start
path                   led from where the vehicle is,        one metre aside at once
                       with all of the body on the road
required lane change   a path in the lane beside replaces    none: stands at the end of the lane
                       one of the three, minds those behind,
                       too, and signals
lights                 red, and yellow that one can obey     red
edge of the road       0.1 m of the 0.3 m that nuPlan's      to the centimetre
                       own metric allows
profiles to track      those of the IDM and of the path      least squares over the poses
errors in bends        against the path beside the vehicle   against the pose of that time
bicycle                the simulator's                       nuPlan's (Euler steps)
scores                 equal within 0.001                    exact
emergency braking      at any speed, 7 m/s^2 along the       up to 5 m/s, poses straight on at a
                       proposal                              corrected speed
=====================  ====================================  =======================================

Paths are laid anew at every decision, in both.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

from limsim_jax.geometry import wrap_angle
from limsim_jax.maps.lane_map import NO_LANE, LaneMap, side_s, width
from limsim_jax.maps.signals import SignalState, lane_states
from limsim_jax.numerics import safe_norm
from limsim_jax.policies.base import Policy
from limsim_jax.policies.predict import Predictor, nearest, straight
from limsim_jax.policies.reference import Place, Way, place_on, way_ahead
from limsim_jax.policies.simple import FollowLane
from limsim_jax.traffic.collision import OVERHANG
from limsim_jax.traffic.ego import Limits, Trajectory
from limsim_jax.traffic.engine import Command
from limsim_jax.types import Config, State
from limsim_jax.xla import computed_once, mapped_like

DT = 0.1
"""s between the poses of a proposal."""

STEPS = 40
"""Steps of a proposal."""

FRACTIONS = (0.2, 0.4, 0.6, 0.8, 1.0)
"""Of the speed limit: what the five drivers wish for."""

OFFSETS = (0.0, -1.0, 1.0)
"""m, of the three paths from the middle of the lane."""

S0, HEADWAY, ACCELERATION, DECELERATION, HARDEST = 1.0, 1.5, 1.5, 3.0, 3.0
"""IDM: standstill gap (m), time gap (s), acceleration, comfortable deceleration, braking limit (m/s^2)."""

LATE_STOP, HARDEST_BEHIND = 1.0, 6.0
"""Unless strict: m that the tracker needs beyond the standstill gap; braking limit behind others (m/s^2)."""

COMFORT = {
    "acceleration": (-4.05, 2.40),  # m/s^2
    "lateral_acceleration": (-4.89, 4.89),
    "jerk": (-8.37, 8.37),  # m/s^3
    "longitudinal_jerk": (-4.13, 4.13),
    "yaw_acceleration": (-1.93, 1.93),  # rad/s^2
    "yaw_rate": (-0.95, 0.95),  # rad/s
}
"""nuPlan's bounds of comfort."""

TTC = (0.0, 0.3, 0.6, 0.9)
"""s that everybody is moved on to look for contacts."""

EMERGENCY_TIME, EMERGENCY_SPEED, EMERGENCY_BRAKING = 2.0, 5.0, 7.0
"""s to a contact by the own fault that lead to emergency braking; m/s up to which they do in the public
implementation; m/s^2 of braking in ours."""

_POINTS, _STEP = 121, 2.0  # of the way: 240 m
_KEEPS = 61  # points of the way on which all of the body keeps to the road: 120 m
_OVERSHOOT = 0.2  # m of that which a proposal leaves, as the next one may come out farther
_EDGE = 0.3  # m from there to the edge, for what the tracker does not manage
_LANES = 6  # of the way, beyond the first
_LOOK = 10  # steps that the tracker looks ahead
_EVERY = 2  # steps between two looks at the others
_FAR = 1e6  # m
_LEAST_GAP = 0.1  # m: who is nearer than the standstill gap brakes as hard as it can
_STANDS = 0.05  # m/s: who is slower stands (nuPlan)
_MERGE_TIME, _MERGE_LEAST = 3.0, 12.0  # s and m in which a path comes to an offset 2 m away, or farther,
_KEEP_SHARE = 0.66  # and the least share of that for one that is nearer
_CHANGE_WITHIN = 300.0  # m to the last place for a lane change, within which it is wished for
_CHANGE_ROOM = 20.0  # m before that place, kept free to change lanes from a standstill
_CHANGE_WORTH = 15.0  # m of progress that a required lane change counts for
_YELLOW = 3.0  # m/s^2: who can stop with this stops at yellow
_CANNOT = 6.0  # m/s^2: who would have to brake harder to stop at red drives on
_AS_GOOD = 1e-3  # scores that differ by less are equal
_COARSE = 4  # points of the way per point where a projection starts


# --- what is around ----------------------------------------------------------------------------------


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
    """The way that the planned vehicles follow, from the rear axle on, and the paths along it."""

    way: Way
    s: Float[Array, " V"]  # m, of the rear axle
    d: Float[Array, " V"]  # m
    slope: Float[Array, " V"]  # m/m, direction of motion against the way
    offset: Float[Array, "V 3"]  # m, of the paths
    wall: Float[Array, "V 3"]  # m along the way, standing obstacle on each of them
    worth: Float[Array, "V 3"]  # m of progress that a path is worth besides
    half: Float[Array, "V M"]  # m, half the width of the lane
    oncoming: Float[Array, "V M"]  # m, width of the lane for the opposite direction beyond the left edge
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
    """Way, paths, and what stands on them: red lights, and the end of lanes that lead nowhere."""
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

    # the way starts at the rear axle, which may be on the lane before
    s = front - body.front
    behind = (s < 0) & (came != NO_LANE)
    first = jnp.where(behind, came, lane)
    after = jnp.where(behind, lane, NO_LANE)
    s = jnp.where(behind, s + lane_map.length[came], s)
    way = computed_once(
        way_ahead(lane_map, first, s, goal, points=_POINTS, step=_STEP, lanes=_LANES, after=after)
    )
    dx, dy = body.x - way.x[:, 0], body.y - way.y[:, 0]
    cos, sin = jnp.cos(way.heading[:, 0]), jnp.sin(way.heading[:, 0])
    d = cos * dy - sin * dx
    slope = jnp.tan(jnp.clip(wrap_angle(body.heading - way.heading[:, 0]), -0.5, 0.5))

    across = side.astype(d.dtype) * (width(lane_map, lane, front) + width(lane_map, own, state.s[slot])) / 2
    offset = jnp.broadcast_to(jnp.asarray(OFFSETS, d.dtype), (*d.shape, 3))
    if not strict:
        # in a bend the corners swing out
        taken = _EDGE + body.width[:, None] / 2 + jnp.abs(way.curvature) * body.length[:, None] ** 2 / 8
        right, left = (jnp.min((x - taken)[:, :_KEEPS], 1)[:, None] for x in (way.right, way.left))
        offset = jnp.clip(offset, -jnp.maximum(right, 0), jnp.maximum(left, 0))
    towards = jnp.stack([-across, jnp.sign(across) - across, jnp.zeros_like(across)], -1)
    offset = jnp.where(changes[:, None], towards, offset)
    ends = jnp.where(changes, body.front + within - _CHANGE_ROOM, _FAR)
    own_end = jnp.stack([ends, ends, jnp.full_like(ends, _FAR)], -1)
    wall = _wall(lane_map, state, body, first, s, goal, after, strict)
    worth = jnp.where(changes, _CHANGE_WORTH, 0.0)
    worth = jnp.stack([jnp.zeros_like(worth), jnp.zeros_like(worth), worth], -1)

    left_most = jnp.where(lane_map.left[way.lane] == NO_LANE, way.lane, lane_map.left[way.lane])
    opposite = lane_map.opposite[left_most]
    return Road(
        way=way,
        s=cos * dx + sin * dy,
        d=d,
        slope=slope,
        offset=offset,
        wall=jnp.minimum(wall[:, None], own_end),
        worth=worth,
        half=_widths(lane_map, way.lane) / 2,
        oncoming=jnp.where(opposite == NO_LANE, 0, _widths(lane_map, opposite)),
        connector=lane_map.is_connector[way.lane],
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
    """m along the way to the first light that says stop, or the end of a lane that leads nowhere."""
    routes = lane_map.routes
    shows = lane_states(lane_map.signals, state.lights.phase)
    wall, start = jnp.full_like(s, _FAR), -s
    for k in range(_LANES):
        end = start + lane_map.length[lane]
        following = routes.next_lane[lane, goal]
        if k == 0:
            following = jnp.where(after == NO_LANE, following, after)
        over = (following == NO_LANE) & (lane != NO_LANE) & ~routes.is_goal[lane, goal]
        wall = jnp.minimum(wall, jnp.where(over, end, _FAR))
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
        wall = jnp.minimum(wall, jnp.where(stops, line, _FAR))
        start, lane = jnp.where(following == NO_LANE, _FAR, end), following
    return wall


def others_around(
    lane_map: LaneMap,
    state: State,
    slot: Int[Array, " V"],
    predict: Predictor,
    count: int,
    moments: int,
) -> Others:
    """The `count` others that come nearest within the horizon, every `DT` s."""
    times = jnp.arange(moments, dtype=state.v.dtype) * DT
    found = predict(lane_map, state, times)
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
    """Every tenth moment: enough to tell who comes near."""
    return prediction.replace(
        x=prediction.x[:, ::10],
        y=prediction.y[:, ::10],
        heading=prediction.heading[:, ::10],
        times=prediction.times[::10],
    )


# --- proposals ---------------------------------------------------------------------------------------


class _Along(NamedTuple):
    """Others in coordinates of the way, at the looks of the IDM: `H`."""

    rear: Float[Array, "H V 3 K"]  # m, of those on the corridor of a path, else far away
    centre: Float[Array, "H V K"]  # m
    v: Float[Array, "H V K"]  # m/s along the way


@jax.named_scope("pdm_leaders")
def _along(road: Road, body: Body, others: Others, steps: int) -> _Along:
    """Who is on the corridor of each path: the width of the body around it."""
    way = road.way
    others = others._replace(**{n: getattr(others, n)[:steps:_EVERY] for n in ("x", "y", "cos", "sin")})
    looks = others.x.shape[0]
    x, y = (jnp.moveaxis(v, 0, 1).reshape(v.shape[1], -1) for v in (others.x, others.y))  # [V, H K]
    coarse_x, coarse_y = way.x[:, ::_COARSE], way.y[:, ::_COARSE]
    apart = (x[:, None] - coarse_x[..., None]) ** 2 + (y[:, None] - coarse_y[..., None]) ** 2  # [V M' HK]
    least = jnp.min(apart, 1)
    number = jnp.arange(coarse_x.shape[1], dtype=x.dtype)[None, :, None]
    s = jnp.min(jnp.where(apart <= least[:, None], number, _FAR), 1) * (_STEP * _COARSE)
    s = computed_once(s)
    for _ in range(2):
        place = place_on(way, s, jnp.zeros_like(s))
        cos, sin = jnp.cos(place.heading), jnp.sin(place.heading)
        dx, dy = x - place.x, y - place.y
        across = cos * dy - sin * dx
        step = (cos * dx + sin * dy) / jnp.maximum(1 - place.curvature * across, 0.3)
        s = computed_once(s + jnp.clip(step, -2 * _STEP * _COARSE, 2 * _STEP * _COARSE))
    place = place_on(way, s, jnp.zeros_like(s))
    cos, sin = jnp.cos(place.heading), jnp.sin(place.heading)
    d = cos * (y - place.y) - sin * (x - place.x)

    def back(values: Array) -> Array:
        return jnp.moveaxis(values.reshape(values.shape[0], looks, -1), 1, 0)

    s, d, cos, sin = computed_once(tuple(back(v) for v in (s, d, cos, sin)))
    along = cos * others.cos + sin * others.sin
    turned = jnp.abs(cos * others.sin - sin * others.cos)
    length, breadth = others.length[None] / 2, others.width[None] / 2
    reach = jnp.abs(along) * length + turned * breadth
    beside = turned * length + jnp.abs(along) * breadth + body.width[None, :, None] / 2
    on = jnp.abs(d[:, :, None] - road.offset[None, ..., None]) < beside[:, :, None]
    on &= (others.there[None] & (s < road.way.reach) & (s > 0))[:, :, None]
    return _Along(rear=jnp.where(on, (s - reach)[:, :, None], _FAR), centre=s, v=others.v[None] * along)


class Proposals(NamedTuple):
    """What the IDM drivers would do on each path: `P` = 15, path by path, `T` moments."""

    s: Float[Array, "V P T"]  # m along the way, rear axle
    v: Float[Array, "V P T"]  # m/s


@jax.named_scope("pdm_idm")
def idm(road: Road, body: Body, along: _Along, strict: bool) -> Proposals:
    """Integrate the fifteen drivers; each looks for its leader every second step."""
    limit = road.way.limit
    shape = (*body.v.shape, len(OFFSETS), len(FRACTIONS))
    fraction = jnp.broadcast_to(jnp.asarray(FRACTIONS, body.v.dtype), shape)
    last = limit.shape[1] - 1
    front = body.front[:, None, None]
    centre = body.wheelbase[:, None, None] / 2
    root = 2 * (ACCELERATION * DECELERATION) ** 0.5
    s0 = S0 if strict else S0 + LATE_STOP
    wall = road.wall[..., None]

    def acceleration(s: Array, v: Array, at: Array, v_lead: Array, v0: Array) -> Array:
        gap = jnp.maximum(at - s - front, s0 if strict else _LEAST_GAP)
        wish = s0 + HEADWAY * v + v * (v - v_lead) / root
        wish = wish if strict else jnp.maximum(wish, 0)
        ratio = v / v0
        ratio2 = ratio * ratio
        ratio4 = ratio2 * ratio2
        free = ratio4 * ratio4 * ratio2
        z = wish / gap
        a = jnp.clip(ACCELERATION * (1 - free - z * z), -HARDEST, ACCELERATION)
        if strict:
            return a
        # red lights and limits are known from afar, what a leader does is not
        behind = jnp.maximum(ACCELERATION * (1 - z * z), -HARDEST_BEHIND)
        return jnp.where(at < wall, jnp.minimum(a, behind), a)

    def look(carry: tuple[Array, ...], seen: _Along) -> tuple[tuple[Array, ...], tuple[Array, Array]]:
        s, v, first = carry
        # leaders: those ahead of the own centre, the nearest rear counts
        ahead = seen.centre[:, None, None] > (s + centre)[..., None]
        rear = jnp.where(ahead, seen.rear[:, :, None], _FAR)  # [V 3 5 K]
        nearest_rear = jnp.min(rear, -1)
        v_rear = jnp.max(jnp.where(rear <= nearest_rear[..., None], seen.v[:, None, None], -_FAR), -1)
        at = jnp.minimum(nearest_rear, wall)
        v_lead = jnp.where(nearest_rear < wall, v_rear, 0)
        if strict:
            here = jnp.maximum(limit[:, :1, None], 0.1)
        else:
            k = jnp.clip(((s + front) / _STEP).astype(jnp.int32), 0, last)
            here = jnp.take_along_axis(limit, k.reshape(k.shape[0], -1), -1).reshape(k.shape)
        v0 = fraction * here
        states = []
        for sub in range(_EVERY):
            a = acceleration(s, v, at, v_lead, v0)
            if strict and sub == 0:
                a = jnp.where(first, -HARDEST, a)
            s = s + v * DT
            v = v + a * DT
            v = v if strict else jnp.maximum(v, 0)
            states.append((s, v))
        ss, vs = (jnp.stack(x) for x in zip(*states, strict=True))
        return (s, v, jnp.zeros_like(first)), (ss, vs)

    first_s = jnp.broadcast_to(road.s[:, None, None], shape)
    first_v = jnp.broadcast_to(body.v[:, None, None], shape)
    start = mapped_like(body.v, (first_s, first_v, jnp.ones(shape, bool)))
    _, (s, v) = lax.scan(look, start, along)

    def gather(first: Array, rest: Array) -> Array:
        rest = jnp.moveaxis(rest.reshape(-1, *shape), 0, -1)
        return jnp.concatenate([first[..., None], rest], -1).reshape(shape[0], shape[1] * shape[2], -1)

    return Proposals(gather(first_s, s), gather(first_v, v))


class Reference(NamedTuple):
    """Proposals in the plane, to be tracked: poses of the rear axle."""

    x: Float[Array, "V P T"]  # m
    y: Float[Array, "V P T"]
    heading: Float[Array, "V P T"]  # rad, without jumps
    v: Float[Array, "V P T"]  # m/s
    curvature: Float[Array, "V P T"]  # 1/m


@jax.named_scope("pdm_poses")
def reference(road: Road, body: Body, proposals: Proposals, strict: bool) -> Reference:
    """Lay the proposals on their paths."""
    offset = jnp.repeat(road.offset, len(FRACTIONS), 1)[..., None]  # [V P 1]
    s, v = proposals
    if strict:
        d = jnp.broadcast_to(offset, s.shape)
        slope = bend = jnp.zeros_like(s)
    else:
        # a cubic from where the vehicle is and points to; a lane change takes longer than to keep the lane
        shift = road.d[:, None, None] - offset
        share = jnp.clip(jnp.abs(shift) / 2, _KEEP_SHARE, 1)
        reach = share * jnp.maximum(_MERGE_TIME * body.v, _MERGE_LEAST)[:, None, None]
        u = jnp.clip((s - road.s[:, None, None]) / reach, 0, 1)
        slope0 = road.slope[:, None, None] * reach
        d = offset + shift * (1 - u * u * (3 - 2 * u)) + slope0 * u * (1 - u) ** 2
        slope = (shift * 6 * u * (u - 1) + slope0 * (1 - u) * (1 - 3 * u)) / reach
        bend = (shift * (12 * u - 6) + slope0 * (6 * u - 4)) / (reach * reach)
        bend = jnp.where(u < 1, bend, 0)
    place = place_on(road.way, s, d)
    stretch = jnp.maximum(1 - place.curvature * d, 0.2)
    return Reference(
        x=place.x,
        y=place.y,
        heading=place.heading + jnp.arctan(slope / stretch),
        v=v * stretch,
        curvature=place.curvature / stretch + bend,
    )


def fitted(reference: Reference) -> Reference:
    """The same with speed and curvature fitted to the poses, as nuPlan's tracker does.

    Regularised least squares: jerk 1e-4, curvature rate 1e-2, initial curvature 1e-10.
    """
    dx, dy = jnp.diff(reference.x), jnp.diff(reference.y)
    heading = reference.heading[..., :-1]
    n = heading.shape[-1]
    # speed before each step: the first one, and accelerations
    sums = np.concatenate([np.ones((n, 1)), DT * np.tril(np.ones((n, n - 1)), -1)], 1)
    jerk = np.zeros((n - 2, n))
    jerk[np.arange(n - 2), np.arange(1, n - 1)], jerk[np.arange(n - 2), np.arange(2, n)] = -1, 1
    # (cos, sin) has norm 1, so both coordinates together weigh as the distance along the heading
    along = jnp.cos(heading) * dx + jnp.sin(heading) * dy
    gain = sums @ np.linalg.solve(DT * DT * sums.T @ sums + 1e-4 * jerk.T @ jerk, DT * sums.T)
    speed = along @ jnp.asarray(gain.T, along.dtype)
    sums = jnp.asarray(sums, along.dtype)
    turn = jnp.diff(reference.heading)
    weight = DT * speed[..., None] * sums[None, None]  # [V P n n]
    penalty = jnp.diag(jnp.full(n, 1e-2, along.dtype).at[0].set(1e-10))
    normal = jnp.einsum("...ij,...ik->...jk", weight, weight) + penalty[None, None]
    bend = jnp.linalg.solve(normal, jnp.einsum("...ij,...i->...j", weight, turn)[..., None])[..., 0]
    bend = bend @ sums.T

    def whole(values: Array) -> Array:
        return jnp.concatenate([values, values[..., -1:]], -1)

    return reference._replace(v=whole(speed), curvature=whole(bend))


# --- tracker -----------------------------------------------------------------------------------------

_Q_LONGITUDINAL, _R_LONGITUDINAL = 10.0, 1.0
_Q_LATERAL, _R_LATERAL = (1.0, 10.0, 0.0), 1.0
_STOPPING, _STOPPING_GAIN = 0.2, 0.5  # m/s, 1/s
_LAG_ACCELERATION, _LAG_STEERING = 0.2, 0.05  # s
_MOST_STEERING = np.pi / 3  # rad
_CAR = Limits()


class Motion(NamedTuple):
    """Proposals as driven: rear axle, `T` moments."""

    x: Float[Array, "V P T"]  # m
    y: Float[Array, "V P T"]
    heading: Float[Array, "V P T"]  # rad, without jumps
    v: Float[Array, "V P T"]  # m/s
    a: Float[Array, "V P T"]  # m/s^2
    steering: Float[Array, "V P T"]  # rad


def lqr(
    v: Float[Array, "*b"],
    steering: Float[Array, "*b"],
    lateral: Float[Array, "*b"],
    astray: Float[Array, "*b"],
    v_ahead: Float[Array, "*b"],
    bends: list[Float[Array, "*b"]],
    wheelbase: Float[Array, "*b"],
) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """nuPlan's two one-step regulators: acceleration (m/s^2) and steering rate (rad/s), held for 1 s.

    Args:
      v: speed, m/s.
      steering: rad.
      lateral: m left of the reference.
      astray: rad, heading against the reference.
      v_ahead: reference speed at the end of the second, m/s.
      bends: reference curvature at each step of the second, 1/m.
      wheelbase: m.
    """
    b = len(bends) * DT
    gain = _Q_LONGITUDINAL * b / (_Q_LONGITUDINAL * b * b + _R_LONGITUDINAL)
    stopping = (v <= _STOPPING) & (v_ahead <= _STOPPING)
    a = jnp.where(stopping, -_STOPPING_GAIN, -gain) * (v - v_ahead)
    # the lateral state (offset, heading error, steering) after the second is A x + B u + g;
    # A is [[1, p, q], [0, 1, r], [0, 0, 1]], and B ends with the length of the second
    zero = jnp.zeros_like(v)
    p, q, r, b0, b1, b2, g0, g1 = (zero,) * 8
    speed = v
    for bend in bends:
        ahead = speed * DT
        turn = ahead / wheelbase
        p, q, r = p + ahead, q + ahead * r, r + turn
        b0, b1, b2 = b0 + ahead * b1, b1 + turn * b2, b2 + DT
        g0, g1 = g0 + ahead * g1, g1 - ahead * bend
        speed = speed + a * DT
    off = lateral + p * astray + q * steering + g0
    error = wrap_angle(astray + r * steering + g1)
    q0, q1, q2 = _Q_LATERAL
    rate = -(q0 * b0 * off + q1 * b1 * error + q2 * b2 * steering)
    rate = rate / (q0 * b0 * b0 + q1 * b1 * b1 + q2 * b2 * b2 + _R_LATERAL)
    return a, jnp.where(stopping, 0, rate)


@jax.named_scope("pdm_track")
def drive_along(reference: Reference, body: Body, steps: int, strict: bool = False) -> Motion:
    """Track all proposals with the LQR and move them by a kinematic bicycle.

    It is nuPlan's if strict (Euler steps), else that which drives the egos (`traffic.ego.step_free`).
    """
    shape = reference.x.shape[:2]

    def ahead(values: Array) -> Array:
        """Windows `[T, V, P, LOOK]`; after the last value it stays."""
        values = jnp.concatenate([values, jnp.repeat(values[..., -1:], _LOOK + 1, -1)], -1)
        windows = jnp.stack([values[..., k : k + steps] for k in range(_LOOK)])
        return jnp.moveaxis(windows, -1, 0)

    first = lambda values: jnp.moveaxis(values[..., :steps], -1, 0)  # noqa: E731
    padded = jnp.concatenate([reference.v, jnp.repeat(reference.v[..., -1:], _LOOK, -1)], -1)
    v_ahead = first(padded[..., _LOOK:])
    wheelbase = jnp.broadcast_to(body.wheelbase[:, None], shape)
    lag_a, lag_steering = DT / (DT + _LAG_ACCELERATION), DT / (DT + _LAG_STEERING)

    def step(carry: tuple[Array, ...], now: tuple[Array, ...]) -> tuple[tuple[Array, ...], Any]:
        x, y, heading, v, a, steering = carry
        x0, y0, along, v_ref, bends = now
        cos, sin = jnp.cos(along), jnp.sin(along)
        lateral, astray = cos * (y - y0) - sin * (x - x0), wrap_angle(heading - along)
        if not strict:
            # who is early or late is where the reference is at another time, and that is round the bend
            early = cos * (x - x0) + sin * (y - y0)
            lateral, astray = lateral - bends[0] * early * early / 2, astray - bends[0] * early
        wish, rate = lqr(v, steering, lateral, astray, v_ref, list(bends), wheelbase)
        if strict:
            a = a + lag_a * (wish - a)
            turn = v * jnp.tan(steering) / wheelbase * DT
            x, y, heading = x + v * jnp.cos(heading) * DT, y + v * jnp.sin(heading) * DT, heading + turn
            v = v + a * DT
            steering = jnp.clip(steering + lag_steering * rate * DT, -_MOST_STEERING, _MOST_STEERING)
        else:
            reached = a + (1 - jnp.exp(-DT / _CAR.acceleration_lag)) * (wish - a)
            turned = steering + jnp.clip(rate, -_CAR.steering_rate, _CAR.steering_rate) * DT
            turned = jnp.clip(turned, -_CAR.steering, _CAR.steering)
            faster = jnp.maximum(v + (a + reached) / 2 * DT, 0)
            way = (v + faster) / 2 * DT
            most = _CAR.lateral_acceleration / jnp.maximum(v * v, 0.1)
            turn = way * jnp.clip(jnp.tan((steering + turned) / 2) / wheelbase, -most, most)
            course = heading + turn / 2
            x, y, heading = x + way * jnp.cos(course), y + way * jnp.sin(course), heading + turn
            v, a, steering = faster, reached, turned
        new = x, y, heading, v, a, steering
        return new, new

    start = tuple(
        jnp.broadcast_to(value[:, None], shape)
        for value in (body.x, body.y, body.heading, body.v, body.a, body.steering)
    )
    start = (start[0], start[1], _near(start[2], reference.heading[..., 0]), *start[3:])
    start = mapped_like(body.v, start)
    inputs = first(reference.x), first(reference.y), first(reference.heading), v_ahead
    _, path = lax.scan(step, start, (*inputs, ahead(reference.curvature)))
    return Motion(
        *(
            jnp.concatenate([begin[..., None], jnp.moveaxis(rest, 0, -1)], -1)
            for begin, rest in zip(start, path, strict=True)
        )
    )


def _near(angle: Array, other: Array) -> Array:
    """The same angle within half a turn of the other."""
    return other + wrap_angle(angle - other)


# --- scorer ------------------------------------------------------------------------------------------


class Scores(NamedTuple):
    """Of all proposals; multipliers and metrics from 0 to 1."""

    total: Float[Array, "V P"]
    no_fault: Float[Array, "V P"]  # no contact by the own fault
    drivable: Float[Array, "V P"]
    direction: Float[Array, "V P"]
    progress: Float[Array, "V P"]
    ttc: Float[Array, "V P"]
    comfort: Float[Array, "V P"]
    contact: Float[Array, "V P"]  # s to the first contact by the own fault, 1e6 if there is none


class _Places(NamedTuple):
    """Where the bodies are on the way, every `_EVERY` steps: `T2` moments."""

    s: Float[Array, "V P T2"]  # m, centre
    off: Bool[Array, "V P T2"]  # a corner is off the road
    wrong: Bool[Array, "V P T2"]  # the centre is in oncoming traffic
    several: Bool[Array, "V P T2"]  # over a lane line or off the road
    junction: Bool[Array, "V P T2"]


@jax.named_scope("pdm_places")
def _places(road: Road, body: Body, proposals: Proposals, motion: Motion, strict: bool) -> _Places:
    thin = lambda values: values[..., ::_EVERY]  # noqa: E731
    axle = body.wheelbase[:, None, None] / 2
    heading = thin(motion.heading)
    x = thin(motion.x) + axle * jnp.cos(heading)
    y = thin(motion.y) + axle * jnp.sin(heading)
    s = thin(proposals.s[..., : motion.x.shape[-1]]) + axle

    def project(s: Array) -> tuple[Place, Array, Array]:
        """The way there, how far left of it the centre is, and a better `s`."""
        place = computed_once(place_on(road.way, s, jnp.zeros_like(s)))
        cos, sin = jnp.cos(place.heading), jnp.sin(place.heading)
        dx, dy = x - place.x, y - place.y
        d = cos * dy - sin * dx
        return place, d, s + (cos * dx + sin * dy) / jnp.maximum(1 - place.curvature * d, 0.3)

    place, d, s = project(project(s)[2])
    along = wrap_angle(heading - place.heading)
    c, n = jnp.cos(along), jnp.sin(along)
    half_l, half_w = body.length[:, None, None] / 2, body.width[:, None, None] / 2
    # offset of the corners if the way goes on with the curvature that it has here
    corners = []
    for ahead, left in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        u = ahead * half_l * c - left * half_w * n
        w = d + ahead * half_l * n + left * half_w * c
        root = jnp.sqrt((1 - place.curvature * w) ** 2 + (place.curvature * u) ** 2)
        corners.append((2 * w - place.curvature * (w * w + u * u)) / (1 + root))
    most = functools.reduce(jnp.maximum, corners)
    least = functools.reduce(jnp.minimum, corners)

    k = jnp.clip((s / _STEP + 0.5).astype(jnp.int32), 0, road.half.shape[1] - 1)
    at = lambda table: jnp.take_along_axis(  # noqa: E731
        table, k.reshape(k.shape[0], -1), -1
    ).reshape(k.shape)
    left, right, half = at(road.way.left), at(road.way.right), at(road.half)
    slack = 0.0 if strict else OVERHANG - _OVERSHOOT
    off = (most > left + at(road.oncoming) + slack) | (least < -right - slack)
    lane_of = lambda value: (value > half).astype(jnp.int32) - (value < -half).astype(jnp.int32)  # noqa: E731
    return _Places(
        s=s,
        off=off,
        wrong=((d > left) & (at(road.oncoming) > 0)) | (c < 0),
        several=(lane_of(most) != lane_of(least)) | (most > left) | (least < -right),
        junction=at(road.connector),
    )


class _Meetings(NamedTuple):
    """First contact with every other, and the first one if all go on at their speed."""

    contact: Float[Array, "V P K"]  # moment (of `T2`), or `_FAR`
    overlap: Float[Array, "V P K"]  # moment times the number of `TTC` plus which of them, or `_FAR`


@jax.named_scope("pdm_contacts")
def _meetings(body: Body, motion: Motion, others: Others) -> _Meetings:
    """Separating axes of all proposals and others at all moments."""
    thin = lambda values: jnp.moveaxis(values[..., ::_EVERY], -1, 0)  # noqa: E731
    x, y, heading, v = (thin(values) for values in (motion.x, motion.y, motion.heading, motion.v))
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    axle = body.wheelbase[None, :, None] / 2
    moments = x.shape[0]
    index = _EVERY * np.arange(moments)[:, None] + np.round(np.array(TTC) / DT).astype(int)[None]
    theirs = tuple(values[index] for values in (others.x, others.y, others.cos, others.sin))  # [T D V K]
    le, we = body.length[:, None, None] / 2, body.width[:, None, None] / 2
    lo, wo = others.length[:, None] / 2, others.width[:, None] / 2
    there = others.there[:, None]
    number = jnp.arange(moments, dtype=x.dtype)

    def look(carry: tuple[Array, Array], now: tuple[Array, ...]) -> tuple[tuple[Array, Array], None]:
        contact, overlap = carry
        k, x, y, cos, sin, v, *theirs = now
        x, y, cos, sin, v = (values[..., None] for values in (x, y, cos, sin, v))  # [V P 1]
        for n, ahead in enumerate(TTC):
            ox, oy, oc, os = (values[n][:, None] for values in theirs)  # [V 1 K]
            dx, dy = ox - (x + v * ahead * cos), oy - (y + v * ahead * sin)
            c, s = jnp.abs(cos * oc + sin * os), jnp.abs(cos * os - sin * oc)
            gap = jnp.maximum(
                jnp.maximum(
                    jnp.abs(cos * dx + sin * dy) - (le + c * lo + s * wo),
                    jnp.abs(cos * dy - sin * dx) - (we + s * lo + c * wo),
                ),
                jnp.maximum(
                    jnp.abs(oc * dx + os * dy) - (lo + c * le + s * we),
                    jnp.abs(oc * dy - os * dx) - (wo + s * le + c * we),
                ),
            )
            meet = (gap <= 0) & there
            if n == 0:
                contact = jnp.where(meet & (contact >= _FAR), k, contact)
            counts = meet & (v >= 0.005) & (contact >= _FAR)
            overlap = jnp.where(counts & (overlap >= _FAR), k * len(TTC) + n, overlap)
        return (contact, overlap), None

    none = jnp.full((*x.shape[1:], others.x.shape[-1]), _FAR, x.dtype)
    centre_x, centre_y = x + axle * cos, y + axle * sin
    start = mapped_like(body.v, (none, none))
    (contact, overlap), _ = lax.scan(look, start, (number, centre_x, centre_y, cos, sin, v, *theirs))
    return _Meetings(contact, overlap)


@jax.named_scope("pdm_score")
def score(
    road: Road, body: Body, others: Others, proposals: Proposals, motion: Motion, strict: bool = False
) -> Scores:
    """nuPlan's closed-loop metrics as PDM scores proposals with them.

    The product of three multipliers and (5 progress + 5 TTC + 2 comfort) / 12.
    """
    places = computed_once(_places(road, body, proposals, motion, strict))
    meetings = computed_once(_meetings(body, motion, others))
    # who is about to change lanes minds everybody, also those behind
    careful = jnp.repeat(road.worth > 0, len(FRACTIONS), 1)[..., None]
    fault, contact = _faults(body, motion, others, places, meetings, careful)
    no_fault = jnp.where(fault, 0.0, 1.0)
    drivable = jnp.where(places.off.any(-1), 0.0, 1.0)
    direction = _direction(motion, places)
    multiplier = no_fault * drivable * direction

    made = jnp.maximum(places.s[..., -1] - places.s[..., 0], 0)
    made = jnp.where(made > 0.5, made + jnp.repeat(road.worth, len(FRACTIONS), 1), made)
    made = made * multiplier
    most = jnp.max(made, -1, keepdims=True)
    progress = jnp.where(most > 0.1, made / jnp.maximum(most, 0.1), jnp.where(multiplier > 0, 1.0, 0.0))
    ttc = _ttc(motion, others, places, meetings, careful)
    comfort = _comfort(body, motion)
    total = multiplier * (5 * progress + 5 * ttc + 2 * comfort) / 12
    return Scores(total, no_fault, drivable, direction, progress, ttc, comfort, contact)


def _at(values: Float[Array, "V P T2"], moment: Int[Array, "V P K"]) -> Array:
    return jnp.take_along_axis(values, moment, -1)


def _theirs(values: Float[Array, "H V K"], moment: Int[Array, "V P K"]) -> Float[Array, "V P K"]:
    """Values of the others at their moments of `DT`."""
    table = jnp.moveaxis(values, 0, -1)  # [V K H]
    found = jnp.take_along_axis(table, jnp.moveaxis(moment, 1, -1), -1)  # [V K P]
    return jnp.moveaxis(found, -1, 1)


def _faults(
    body: Body,
    motion: Motion,
    others: Others,
    places: _Places,
    meetings: _Meetings,
    careful: Bool[Array, "V P 1"],
) -> tuple[Bool[Array, "V P"], Float[Array, "V P"]]:
    """Contacts by the own fault, and the time of the first, s (nuPlan's classes of collisions).

    Who overlaps at the start does not count.
    """
    meets = (meetings.contact < _FAR) & (meetings.contact > 0)
    k = jnp.where(meets, meetings.contact, 0).astype(jnp.int32)
    thin = lambda values: values[..., ::_EVERY]  # noqa: E731
    x, y, heading, v = (_at(thin(values), k) for values in motion[:4])
    ox, oy, oc, os = (_theirs(values, k * _EVERY) for values in others[:4])
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    dx, dy = ox - x, oy - y  # from the rear axle
    behind = _behind(cos * dx + sin * dy, cos * dy - sin * dx)
    # the front edge as a box without length
    edge = body.front[:, None, None]
    dx, dy = dx - edge * cos, dy - edge * sin
    c, s = jnp.abs(cos * oc + sin * os), jnp.abs(cos * os - sin * oc)
    lo, wo = others.length[:, None] / 2, others.width[:, None] / 2
    we = body.width[:, None, None] / 2
    ahead = jnp.abs(cos * dx + sin * dy) <= c * lo + s * wo
    ahead &= jnp.abs(cos * dy - sin * dx) <= we + s * lo + c * wo
    ahead &= jnp.abs(oc * dx + os * dy) <= lo + s * we
    ahead &= jnp.abs(oc * dy - os * dx) <= wo + c * we
    stands = jnp.abs(v) <= _STANDS
    other_stands = (others.v <= _STANDS)[:, None]
    lateral = _at(places.several, k)
    fault = meets & ~stands & (other_stands | careful | (~behind & (ahead | lateral)))
    time = jnp.min(jnp.where(fault, meetings.contact * (_EVERY * DT), _FAR), -1)
    return fault.any(-1), time


def _behind(ahead: Array, left: Array) -> Array:
    """Within 30 degrees of straight behind."""
    return (ahead < 0) & (3 * left * left < ahead * ahead)


def _ttc(
    motion: Motion,
    others: Others,
    places: _Places,
    meetings: _Meetings,
    careful: Bool[Array, "V P 1"],
) -> Float[Array, "V P"]:
    """1, or 0 if the own front comes too near to somebody, 0.9 s at present speeds."""
    meets = (meetings.overlap < _FAR) & (meetings.contact != 0)
    code = jnp.where(meets, meetings.overlap, 0).astype(jnp.int32)
    k, n = code // len(TTC), code % len(TTC)
    thin = lambda values: values[..., ::_EVERY]  # noqa: E731
    x, y, heading, v = (_at(thin(values), k) for values in motion[:4])
    moment = k * _EVERY + n * round((TTC[1] - TTC[0]) / DT)
    dx, dy = _theirs(others.x, moment) - x, _theirs(others.y, moment) - y
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    moved = v * jnp.asarray(TTC, v.dtype)[n]
    forth, left = cos * dx + sin * dy - moved, cos * dy - sin * dx
    ahead = _behind(-forth, left)
    crossing = _at(places.several | places.junction, k) & ~_behind(forth, left)
    return jnp.where((meets & (ahead | crossing | careful)).any(-1), 0.0, 1.0)


def _direction(motion: Motion, places: _Places) -> Float[Array, "V P"]:
    """1, or 0.5 from 2 m, or 0 from 6 m in oncoming traffic within a second."""
    window = round(1 / (_EVERY * DT))
    driven = jnp.where(places.wrong, motion.v[..., ::_EVERY] * (_EVERY * DT), 0)
    total = jnp.cumsum(driven, -1)
    run = total - jnp.pad(total, ((0, 0), (0, 0), (window, 0)))[..., : total.shape[-1]]
    most = jnp.max(run, -1)
    return jnp.where(most < 2, 1.0, jnp.where(most < 6, 0.5, 0.0))


@functools.cache
def _filters(count: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Savitzky-Golay filters as nuPlan uses them, as matrices `[count, 2 count]`.

    For accelerations: smoothed, and their derivative; for headings: first and second derivative.
    """
    from scipy.signal import savgol_filter

    def savgol(x: NDArray[Any], window: int, order: int, derivative: int = 0) -> NDArray[Any]:
        return np.asarray(savgol_filter(x, window, order, deriv=derivative, delta=DT, axis=0))

    unit = np.eye(count)
    smooth = savgol(unit, 8, 2)
    jerk, rate, bend = savgol(smooth, 15, 2, 1), savgol(unit, 5, 2, 1), savgol(unit, 5, 3, 2)
    return (
        np.concatenate([smooth, jerk]).T.astype(np.float32),
        np.concatenate([rate, bend]).T.astype(np.float32),
    )


def _comfort(body: Body, motion: Motion) -> Float[Array, "V P"]:
    """1 if all of `COMFORT` is kept, else 0."""
    count = motion.x.shape[-1]
    of_a, of_heading = _filters(count)
    lateral = motion.v * motion.v * jnp.tan(motion.steering) / body.wheelbase[:, None, None]
    size = safe_norm(jnp.stack([motion.a, lateral]), 0)
    found = jnp.stack([motion.a, lateral, size]) @ of_a  # [3 V P 2T]
    turned = (motion.heading - motion.heading[..., :1]) @ of_heading
    values = {
        "acceleration": found[0, ..., :count],
        "lateral_acceleration": found[1, ..., :count],
        "jerk": found[2, ..., count:],
        "longitudinal_jerk": found[0, ..., count:],
        "yaw_acceleration": turned[..., count:],
        "yaw_rate": turned[..., :count],
    }
    fine = functools.reduce(
        jnp.logical_and,
        ((values[name] > low) & (values[name] < high) for name, (low, high) in COMFORT.items()),
    )
    return jnp.where(fine.all(-1), 1.0, 0.0)


# --- the policy --------------------------------------------------------------------------------------


class Plan(NamedTuple):
    """What was decided, for `V` vehicles."""

    trajectory: Trajectory  # [V T], centre of the body
    best: Int[Array, " V"]  # proposal
    signal: Int[Array, " V"]  # +1 or -1 if it leads into the lane to the left or right
    brakes: Bool[Array, " V"]  # emergency
    scores: Scores
    tail: Trajectory  # [V T'], the proposal beyond the trajectory


@dataclass(frozen=True)
class PDMClosed:
    """PDM-Closed as a policy; its egos move in the plane.

    Attributes:
      seen: the nearest others that count.
      strict_tuplan: the conventions of the public implementation; the module's docstring has them.
      predict: forecast of the others.
    """

    seen: int = 32
    strict_tuplan: bool = False
    predict: Predictor = straight

    free = True
    others = 0

    def __post_init__(self) -> None:
        if self.seen < 1:
            raise ValueError(f"seen: {self.seen} others; at least 1")

    def variants(self, seen: Predictor) -> dict[str, Policy]:
        """With a reference in the place of a module: what came to pass, car following on its lane."""
        return {"prediction": replace(self, predict=seen), "planning": FollowLane()}

    def init(self, config: Config, lane_map: LaneMap, state: State) -> Any:
        """Nothing to remember."""
        del config, lane_map, state

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: Any, key: jax.Array
    ) -> tuple[Command, Any]:
        """The best proposal as a trajectory over 4 s."""
        del key
        plan = self.plan(config, lane_map, state)
        return Command(trajectory=plan.trajectory, signal=plan.signal), memory

    def plan(self, config: Config, lane_map: LaneMap, state: State, beyond: int = 0) -> Plan:
        """The decision, and the chosen proposal for so many steps of `DT` beyond its trajectory."""
        strict, slot = self.strict_tuplan, state.egos.slot
        steps = STEPS + beyond
        body = computed_once(bodies(state, slot))
        road = computed_once(road_ahead(lane_map, state, slot, body, strict))
        moments = max(steps, STEPS + round(TTC[-1] / DT)) + 1
        others = others_around(lane_map, state, slot, self.predict, self.seen, moments)
        others = computed_once(others)
        along = computed_once(_along(road, body, others, steps))
        proposals = computed_once(idm(road, body, along, strict))
        lead = computed_once(reference(road, body, proposals, strict))
        motion = computed_once(drive_along(fitted(lead) if strict else lead, body, STEPS, strict))
        scores = score(road, body, others, proposals, motion, strict)
        # of proposals that are as good the first one: the middle of the lane, and the slower one
        slack = 0.0 if strict else _AS_GOOD
        best = jnp.argmax(scores.total >= jnp.max(scores.total, -1, keepdims=True) - slack, -1)
        pick = lambda values: jnp.take_along_axis(values, best[:, None, None], 1)[:, 0]  # noqa: E731
        x, y, heading, v = (pick(values) for values in motion[:4])
        path = (best // len(FRACTIONS))[:, None]
        leads, offset = (jnp.take_along_axis(x, path, 1)[:, 0] for x in (road.worth > 0, road.offset))
        brakes = jnp.take_along_axis(scores.contact, best[:, None], 1)[:, 0] <= EMERGENCY_TIME
        if strict:
            brakes &= body.v <= EMERGENCY_SPEED
            stop = _stop_straight(body)
        else:
            stop = _stop_along(body, x, y, heading)
        now = config.time(state.step)
        halt = brakes[:, None]
        driven = tuple(jnp.where(halt, a, b) for a, b in zip(stop, (x, y, heading, v), strict=True))
        rest = (pick(values)[:, STEPS + 1 :] for values in lead[:4])
        rest = tuple(jnp.where(halt, a[:, -1:], b) for a, b in zip(driven, rest, strict=True))
        return Plan(
            trajectory=_centred(body, driven, now),
            best=best,
            signal=jnp.where(leads, jnp.sign(offset - road.d), 0).astype(jnp.int32),
            brakes=brakes,
            scores=scores,
            tail=_centred(body, rest, now + (STEPS + 1) * DT),
        )


def _centred(body: Body, poses: tuple[Array, ...], t0: Array) -> Trajectory:
    """Poses of the rear axle (x, y, heading, and speed) as a trajectory of the centre of the body."""
    x, y, heading, v = poses
    axle = body.wheelbase[:, None] / 2
    return Trajectory(
        x=x + axle * jnp.cos(heading), y=y + axle * jnp.sin(heading), heading=heading, v=v, t0=t0, dt=DT
    )


def _stop_along(body: Body, x: Array, y: Array, heading: Array) -> tuple[Array, ...]:
    """The same path of the rear axle, braked with `EMERGENCY_BRAKING` to a standstill."""
    t, v0 = DT * jnp.arange(STEPS + 1, dtype=x.dtype)[None], body.v[:, None]
    braking = jnp.minimum(t, v0 / EMERGENCY_BRAKING)
    way = v0 * braking - EMERGENCY_BRAKING * braking * braking / 2
    steps = safe_norm(jnp.stack([jnp.diff(x), jnp.diff(y)]), 0)
    done = jnp.pad(jnp.cumsum(steps, -1), ((0, 0), (1, 0)))
    x, y, heading = (jax.vmap(jnp.interp)(way, done, values) for values in (x, y, heading))
    return x, y, heading, v0 - EMERGENCY_BRAKING * braking


def _stop_straight(body: Body) -> tuple[Array, ...]:
    """Poses of the rear axle straight on, at the speed that nuPlan's tracker is to be given."""
    t, v0 = DT * jnp.arange(STEPS + 1, dtype=body.v.dtype)[None], body.v[:, None]
    u = jnp.where(v0 > _STOPPING, -10 * v0, -4 * v0 - body.a[:, None])
    low, high = COMFORT["acceleration"]
    speed = 1.1 * (v0 + jnp.clip(u, low, high))
    heading = jnp.broadcast_to(body.heading[:, None], (*body.v.shape, STEPS + 1))
    way = speed * t
    return (
        body.x[:, None] + way * jnp.cos(heading),
        body.y[:, None] + way * jnp.sin(heading),
        heading,
        jnp.where(t > 0, speed, v0),
    )
