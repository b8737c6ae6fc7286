"""Vehicles under test: motion in the plane, trajectories, meta-actions.

A free ego obeys the kinematic bicycle model. Its place is known twice, in the plane (`Egos`) and on a
lane (its slot of `State`), so traffic and metrics see it like any other vehicle:

    free = step_free(config, lane_map, limits, state, control)
    moved = advance(config, lane_map, state, jnp.where(is_free(state), free.a, a))  # all vehicles
    state = with_free(moved, free)

`State.s` is the front bumper along the lane and `State.d` the offset of the body's centre, at which
`Egos.x`, `Egos.y` lie. The body is level with its axles' middle: the rear axle is half a wheelbase behind
the centre.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Shaped

from limsim_jax.geometry import direction, wrap_angle
from limsim_jax.maps.lane_map import NO_LANE, LaneMap, curvature, pose, project, side_s, to_frenet, width
from limsim_jax.numerics import safe_divide, safe_norm
from limsim_jax.traffic.bodies import body_place
from limsim_jax.traffic.car_following import ballistic
from limsim_jax.types import Config, Egos, Outside, State
from limsim_jax.xla import interval

_AGAINST = 3.5  # m: a lane fits worse by this much if the ego points against it
_NOT_AT_ALL = 1e9  # m
_WANTED = 1e-3  # m by which the lane that is ahead by the route wins over others that fit as well
_LOST = 0.1  # m off all lanes around from which the lane is looked up in the whole map
_FOOT = 0.01  # m: a projection that misses the point by more has not found its foot
_OVER_LINE = 0.1  # m of the body beyond the line from which the lane beside is taken, too


# ---- motion in the plane


@struct.dataclass(frozen=True, kw_only=True)
class Control:
    """What a driver of free egos asks for; `Limits` say what it gets."""

    acceleration: Float[Array, " E"]  # m/s^2
    steering: Float[Array, " E"]  # rad, angle of the front wheels, left > 0


@struct.dataclass(frozen=True, kw_only=True)
class Limits:
    """What the actuators can do; a number for all egos or one each `[E]`. Defaults: a passenger car.

    Lags are those of nuPlan's kinematic bicycle; the steering rate is that of the CommonRoad vehicle models
    (Althoff, Koschi, Manzinger, IV 2017). The others follow from round figures: 0 to 100 km/h in 7 s,
    a friction of 0.8, full braking built up within 0.2 s, a turning circle of 11 m.
    """

    acceleration: Float[Array, "*E"] | float = 4.0  # m/s^2, largest
    deceleration: Float[Array, "*E"] | float = 8.0  # m/s^2, largest, positive
    jerk: Float[Array, "*E"] | float = 40.0  # m/s^3
    acceleration_lag: Float[Array, "*E"] | float = 0.2  # s, time constant
    steering: Float[Array, "*E"] | float = 0.6  # rad, largest angle of the front wheels
    steering_rate: Float[Array, "*E"] | float = 0.4  # rad/s
    steering_lag: Float[Array, "*E"] | float = 0.05  # s, time constant
    lateral_acceleration: Float[Array, "*E"] | float = 8.0  # m/s^2: beyond it the front wheels slide


@jax.named_scope("step_free")
def step_free(config: Config, lane_map: LaneMap, limits: Limits, state: State, control: Control) -> State:
    """Move the free egos one physics step; everything else in the state stays.

    Actuators follow the control with a first-order lag within their rates. The rear axle then runs along
    an arc, exact for the mean steering angle of the step: of radius wheelbase / tan(steering). Speed is
    that of the rear axle; an ego that brakes to a standstill stays there.

    The lane is the one that the centre of the body is on: at its end the successor that it lies on (of
    several, the one of the route), beside it the neighbour beyond the line, past both the next of that by
    the route. Off all lanes it stays with the last one, and `s` and `d` go on along that. On the goal lane
    `s` grows beyond the end: see `arrived`.
    `side` tells that the body reaches over the line to a neighbour, whose traffic then sees it, too.
    """
    egos, dt = state.egos, config.dt
    steering_command = jnp.clip(control.steering, -limits.steering, limits.steering)
    steering = _follow(egos.steering, steering_command, limits.steering_lag, limits.steering_rate, dt)
    command = jnp.clip(control.acceleration, -limits.deceleration, limits.acceleration)
    a = _follow(egos.a, command, limits.acceleration_lag, limits.jerk, dt)

    v0, wheelbase = state.v[egos.slot], state.shape.wheelbase[egos.slot]
    v, distance = ballistic(v0, (egos.a + a) / 2, dt)
    a = jnp.where((v == 0) & (a < 0), 0, a)
    bend = safe_divide(jnp.tan((egos.steering + steering) / 2), wheelbase)
    most = limits.lateral_acceleration / jnp.maximum(v0 * v0, 0.1)
    dx, dy, turn = _arc(egos.heading, distance, jnp.clip(bend, -most, most), wheelbase)
    x, y, heading = egos.x + dx, egos.y + dy, wrap_angle(egos.heading + turn)
    place = find_lane(lane_map, state, x, y, heading, distance)

    moves = egos.free & state.active[egos.slot]

    def write(new: Array, old: Array) -> Array:
        return at_slots(egos, new, old, moves)

    none = jnp.zeros_like(egos.slot)
    return replace(
        state,
        lane=write(place.lane, state.lane),
        previous=write(place.previous, state.previous),
        earlier=jnp.where(
            at_slots(egos, moves, jnp.zeros_like(state.active), moves)[:, None], NO_LANE, state.earlier
        ),
        s=write(place.s, state.s),
        d=write(place.d, state.d),
        v=write(v, state.v),
        a=write((v - v0) / dt, state.a),
        distance=write(state.distance[egos.slot] + distance, state.distance),
        side=write(place.side, state.side),
        crossed=write(none > 0, state.crossed),
        progress=write(jnp.zeros_like(v), state.progress),
        shift=write(jnp.zeros_like(v), state.shift),
        egos=replace(
            egos,
            x=jnp.where(moves, x, egos.x),
            y=jnp.where(moves, y, egos.y),
            heading=jnp.where(moves, heading, egos.heading),
            steering=jnp.where(moves, steering, egos.steering),
            a=jnp.where(moves, a, egos.a),
        ),
    )


def _follow(value: Array, command: Array, lag: Array | float, rate: Array | float, dt: float) -> Array:
    """An actuator after `dt` s: exact first-order lag, then the limit of its rate."""
    share = 1 - jnp.exp(-dt / jnp.maximum(lag, 1e-6))
    most = jnp.asarray(rate, value.dtype) * dt
    return value + jnp.clip((command - value) * share, -most, most)


def _arc(heading: Array, distance: Array, bend: Array, wheelbase: Array) -> tuple[Array, Array, Array]:
    """Displacement (m) and turn (rad) of the body on an arc."""
    turn = bend * distance
    half = turn / 2
    small = jnp.abs(half) < 0.5
    h = jnp.where(small, half, 0.5)
    q = h * h
    series = 1 - q / 6 * (1 - q / 20 * (1 - q / 42))  # sin(h) / h to 1e-8
    chord = distance * jnp.where(small, series, safe_divide(jnp.sin(half), half, 1.0))
    swing = wheelbase * jnp.sin(half)  # the centre swings around the rear axle, half a wheelbase ahead of it
    c, s = jnp.cos(heading + half), jnp.sin(heading + half)
    return chord * c - swing * s, chord * s + swing * c, turn


# ---- which lane


class Place(NamedTuple):
    """Where egos are on lanes."""

    lane: Int[Array, " E"]  # of the front bumper
    previous: Int[Array, " E"]
    s: Float[Array, " E"]
    d: Float[Array, " E"]
    side: Int[Array, " E"]


def find_lane(lane_map: LaneMap, state: State, x: Array, y: Array, heading: Array, distance: Array) -> Place:
    """Places of egos now, `distance` m after those of `state`."""
    slot = state.egos.slot
    length, breadth = state.shape.length[slot], state.shape.width[slot]
    was, was_before, goal = state.lane[slot], state.previous[slot], state.goal[slot]
    start, s = body_place(lane_map, state, slot)
    here = lax.stop_gradient((x, y, heading))
    *_, along = pose(lane_map, start, s)
    s = lax.stop_gradient(s + distance * jnp.cos(heading - along))
    lanes, guess = _around(lane_map, start, s)
    misfit, places = _misfit(lane_map, lanes, guess, here)
    wanted = jnp.where(was == start, lane_map.routes.next_lane[start, goal], was)
    best = jnp.argmin(misfit - jnp.where(lanes == wanted[:, None], _WANTED, 0), -1)
    lane, s, misfit = _take(lanes, best), _take(places, best), _take(misfit, best)
    lost = state.egos.free & state.active[slot] & (misfit > _LOST)
    beside, beside_s = lanes[:, 1:3], guess[:, 1:3]
    onward = jnp.where(beside == NO_LANE, NO_LANE, lane_map.routes.next_lane[beside, goal[:, None]])
    lane, s = _anywhere(lane_map, lost, lane, s, here, onward, beside_s - lane_map.length[beside])
    s, d, along = to_frenet(lane_map, lane, s, x, y)

    # The front bumper may be on the next lane already: the same as before, or of the route, or any.
    front = s + length / 2
    to_go = front - lane_map.length[lane]
    following, route = lane_map.successors[lane], lane_map.routes.next_lane[lane, goal]
    kept = (following == was[:, None]).any(-1)
    onto = jnp.where(kept, was, jnp.where(route != NO_LANE, route, following[:, 0]))
    over = (to_go > 0) & (s <= lane_map.length[lane]) & ~lane_map.routes.is_goal[lane, goal]
    over &= onto != NO_LANE

    # The tail may be on the lane before: one of those that we come from, if it leads here.
    before = lane_map.predecessors[lane]
    came = jnp.stack([was_before, start, before[:, 0]], -1)
    leads = (came[:, :, None] == before[:, None, :]).any(-1) & (came != NO_LANE)
    previous = jnp.where(leads.any(-1) & (s >= 0), _take(came, jnp.argmax(leads, -1)), NO_LANE)

    turned = wrap_angle(heading - along)
    half = (jnp.abs(jnp.sin(turned)) * length + jnp.abs(jnp.cos(turned)) * breadth) / 2
    over_line = half + jnp.abs(d) - width(lane_map, lane, s) / 2 > _OVER_LINE
    return Place(
        lane=jnp.where(over, onto, lane),
        previous=jnp.where(over, lane, previous),
        s=jnp.where(over, to_go, front),
        d=d,
        side=jnp.where(over_line, jnp.where(d > 0, 1, -1), 0),
    )


def _around(lane_map: LaneMap, lane: Array, s: Array) -> tuple[Array, Array]:
    """Lanes on which a body can be, and where on them (m); `[E, C]`.

    It is near `s` (m) on `lane`: candidates are that lane, those beside it, and those past its nearer end.
    """
    before, after = lane_map.predecessors[lane], lane_map.successors[lane]
    count = max(before.shape[-1], after.shape[-1])

    def padded(lanes: Array) -> Array:
        return jnp.pad(lanes, ((0, 0), (0, count - lanes.shape[-1])), constant_values=NO_LANE)

    length = lane_map.length[lane]
    ahead = (s > length / 2)[:, None]
    linked = jnp.where(ahead, padded(after), padded(before))
    linked_s = _columns(s, linked) + jnp.where(ahead, -length[:, None], lane_map.length[linked])
    opposite = lane_map.opposite[lane]
    lanes = jnp.stack([lane, lane_map.left[lane], lane_map.right[lane], opposite], -1)
    places = [
        s,
        side_s(lane_map, lane, s, jnp.ones_like(lane)),
        side_s(lane_map, lane, s, -jnp.ones_like(lane)),
        (1 - s / length) * lane_map.length[opposite],
    ]
    return jnp.concatenate([lanes, linked], -1), jnp.concatenate([jnp.stack(places, -1), linked_s], -1)


def _misfit(lane_map: LaneMap, lanes: Array, guess: Array, here: tuple[Array, ...]) -> tuple[Array, Array]:
    """Distance (m) from lanes `[E, C]`, and arc length (m) there."""
    x, y, heading = (_columns(value, lanes) for value in here)
    s, d, along = to_frenet(lane_map, lanes, guess, x, y)
    foot_x, foot_y, _ = pose(lane_map, lanes, s, d)
    astray = jnp.abs(foot_x - x) + jnp.abs(foot_y - y)
    misfit = jnp.maximum(jnp.maximum(-s, s - lane_map.length[lanes]), 0)
    misfit += jnp.maximum(jnp.abs(d) - width(lane_map, lanes, s) / 2, 0)
    misfit += jnp.where(astray > _FOOT, astray, 0)
    misfit += jnp.where(jnp.cos(heading - along) < 0, _AGAINST, 0)
    return jnp.where(lanes == NO_LANE, _NOT_AT_ALL, misfit), s


def _anywhere(
    lane_map: LaneMap,
    lost: Array,
    lane: Array,
    s: Array,
    here: tuple[Array, ...],
    onward: Int[Array, "E 2"],
    guess: Float[Array, "E 2"],
) -> tuple[Array, Array]:
    """Look for the lane of `lost` egos in the whole map.

    Off all lanes they keep the last one. An ego that has crossed a line where the lanes end is on a lane
    `onward`, the next by the route from the lanes beside, near `guess` m. Where those part they overlap with
    others, and the nearest may lead elsewhere.

    A loop of at most one pass: it costs nothing while no ego is lost, in any world of a batch.
    """

    def look(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        lost, lane, s = carry
        x, y, heading = here
        other, other_s, d, _ = project(lane_map, x, y, heading)
        found = lost & (other != NO_LANE) & (jnp.abs(d) <= width(lane_map, other, other_s) / 2)
        found &= (other_s >= 0) & (other_s <= lane_map.length[other])
        misfit, places = _misfit(lane_map, onward, guess, here)
        best = jnp.argmin(misfit, -1)
        past = lost & (_take(misfit, best) <= _LOST)
        other = jnp.where(past, _take(onward, best), other)
        other_s = jnp.where(past, _take(places, best), other_s)
        found |= past
        return jnp.zeros_like(lost), jnp.where(found, other, lane), jnp.where(found, other_s, s)

    _, lane, s = lax.while_loop(lambda carry: carry[0].any(), look, (lost, lane, s))
    return lane, s


def _columns(value: Array, like: Array) -> Array:
    return jnp.broadcast_to(value[:, None], like.shape)


def _take(table: Array, column: Array) -> Array:
    return jnp.take_along_axis(table, column[:, None], -1)[:, 0]


# ---- both kinds of coordinates


def at_slots(
    egos: Egos, value: Shaped[Array, " E"], into: Shaped[Array, " N"], which: Bool[Array, " E"] | None = None
) -> Shaped[Array, " N"]:
    """Write values of the egos (in `which`) into their slots."""
    if egos.slot.shape[0] == 0:
        return into
    mine = egos.slot[:, None] == jnp.arange(into.shape[0], dtype=egos.slot.dtype)[None, :]
    mine = mine if which is None else mine & which[:, None]
    if egos.slot.shape[0] == 1:
        return jnp.where(mine[0], value[0], into)
    return jnp.where(mine.any(0), value[jnp.argmax(mine, 0)], into)


def is_free(state: State) -> Bool[Array, " N"]:
    """Slots of egos that move in the plane."""
    return at_slots(state.egos, state.egos.free, jnp.zeros_like(state.active)) & state.active


def with_free(moved: State, free: State) -> State:
    """The state after a step: `free` for free egos, `moved` for all other traffic.

    `free` is from `step_free`. Waiting times, hard braking and `step` are taken from `moved`, which should
    have been moved with the acceleration of `free`.
    """
    mine = is_free(free)
    own = "active", "lane", "previous", "s", "d", "v", "a", "side", "crossed", "progress", "shift", "distance"
    fields = {name: jnp.where(mine, getattr(free, name), getattr(moved, name)) for name in own}
    return replace(moved, egos=free.egos, **fields)


def overlay_boxes(state: State, box: Float[Array, "N 5"]) -> Float[Array, "N 5"]:
    """Boxes with bodies in the plane where they are there; m, rad.

    Those are free egos and vehicles from outside.
    """
    place = list(box[:, :3].T)
    for rows in [state.egos] if state.outside is None else [state.egos, outside_rows(state.outside)]:
        poses = rows.x, rows.y, rows.heading
        place = [at_slots(rows, v, place[k], rows.free) for k, v in enumerate(poses)]
    return jnp.concatenate([jnp.stack(place, -1), box[:, 3:]], -1)


def outside_rows(outside: Outside) -> Egos:
    """Vehicles from outside as rows of `Egos`; free are those that are moved from outside."""
    return Egos(
        slot=outside.slot,
        free=outside.held & outside.there & (outside.slot >= 0),
        x=outside.x,
        y=outside.y,
        heading=outside.heading,
        steering=jnp.zeros_like(outside.x),
        a=outside.a,
    )


def from_lane(
    lane_map: LaneMap,
    state: State,
    box: Float[Array, "N 5"],
    slot: Sequence[int],
    free: Sequence[bool] | Bool[Array, " E"] | bool,
) -> Egos:
    """Egos in these slots, where `state` has them on lanes; `box`: `motion.boxes` of that state.

    Raises:
      ValueError: a slot that is not there, or twice.
    """
    count = state.lane.shape[0]
    for k, i in enumerate(slot):
        if not 0 <= i < count:
            raise ValueError(f"ego {k} is in slot {i}; slots go from 0 to {count - 1}")
        if i in slot[:k]:
            raise ValueError(f"slot {i} has two egos")
    slot_ = jnp.asarray(slot, jnp.int32)
    zero = jnp.zeros(slot_.shape, box.dtype)
    bound = jnp.zeros(slot_.shape, bool)
    egos = Egos(slot=slot_, free=bound, x=zero, y=zero, heading=zero, steering=zero, a=zero)
    egos = sync(lane_map, replace(state, egos=egos), box).egos
    return replace(egos, free=jnp.broadcast_to(jnp.asarray(free, bool), slot_.shape))


def sync(lane_map: LaneMap, state: State, box: Float[Array, "N 5"]) -> State:
    """Update the Cartesian state of egos that keep to lanes.

    Their wheels point along the lane, so an ego may be set free at any moment. `box`: `motion.boxes`.
    """
    egos, slot = state.egos, state.egos.slot
    wheelbase = state.shape.wheelbase[slot]
    lane, s = body_place(lane_map, state, slot)
    wheels = jnp.arctan(wheelbase * curvature(lane_map, lane, s))

    def bound(new: Array, old: Array) -> Array:
        return jnp.where(egos.free, old, new)

    return replace(
        state,
        egos=replace(
            egos,
            x=bound(box[slot, 0], egos.x),
            y=bound(box[slot, 1], egos.y),
            heading=bound(wrap_angle(box[slot, 2]), egos.heading),
            steering=bound(wheels, egos.steering),
            a=bound(state.a[slot], egos.a),
        ),
    )


def with_rows(egos: Egos, more: int) -> Egos:
    """Egos and `more` rows without a vehicle: `assign` gives them vehicles."""
    if not more:
        return egos
    pad = {name: jnp.zeros(more, getattr(egos, name).dtype) for name in ("free", "x", "y", "heading")}
    pad |= {"steering": pad["x"], "a": pad["x"], "slot": jnp.full(more, -1, egos.slot.dtype)}
    return Egos(**{name: jnp.concatenate([getattr(egos, name), value]) for name, value in pad.items()})


def assign(lane_map: LaneMap, state: State, box: Float[Array, "N 5"], slot: Int[Array, " E"]) -> State:
    """Let the rows of `Egos` drive these vehicles.

    A new vehicle starts in the plane where it is, at its speed and acceleration. A vehicle that is released
    continues along its lane from where it is; off the middle it drifts back (`motion.advance`). Rows that
    keep their vehicle are not touched. `slot`: -1 for none. `box`: `motion.boxes`.
    """
    egos = state.egos
    new = (slot != egos.slot) & (slot >= 0)
    taken = sync(lane_map, replace(state, egos=replace(egos, slot=slot, free=egos.free & ~new)), box).egos
    drives = jnp.where(new, True, egos.free & (slot == egos.slot)) & (slot >= 0)
    state = replace(state, egos=replace(taken, free=drives))
    # a free body has no lane change in progress: a vehicle that becomes free gives its lane change up
    nothing = jnp.zeros_like(slot)
    side = at_slots(state.egos, nothing, state.side, new)
    released = (egos.slot >= 0) & (egos.slot[:, None] != slot[None, :]).all(1) & egos.free
    side = at_slots(egos, nothing, side, released)
    return replace(state, side=side)


def hand_over(
    lane_map: LaneMap, state: State, box: Float[Array, "N 5"], count: int, *, free: bool, others: int
) -> State:
    """Give the first `count` rows of `Egos` to another policy: all other vehicles return to the traffic.

    Args:
      lane_map: where.
      state: the world now.
      box: `motion.boxes`.
      count: number of egos.
      free: whether they move in the plane from now on.
      others: rows for more vehicles that the new policy can drive.
    """
    egos = state.egos
    slot, bound = egos.slot[:count], ~egos.free[:count]
    # egos that stay in the plane keep their pose and steering there
    stay = jnp.where(jnp.arange(egos.slot.shape[0]) < count, egos.slot if free else -1, -1)
    state = assign(lane_map, state, box, stay)
    kept = jax.tree.map(lambda x: x[:count], state.egos)
    state = replace(
        state, egos=with_rows(replace(kept, slot=jnp.where(bound | (not free), -1, slot)), others)
    )
    wanted = jnp.concatenate([slot, jnp.full(others, -1, slot.dtype)])
    if free:
        return assign(lane_map, state, box, wanted)
    return sync(lane_map, replace(state, egos=replace(state.egos, slot=wanted)), box)


def arrived(lane_map: LaneMap, state: State) -> Bool[Array, " E"]:
    """Egos whose front bumper has passed the end of their goal."""
    slot = state.egos.slot
    lane = state.lane[slot]
    there = lane_map.routes.is_goal[lane, state.goal[slot]] & (state.s[slot] > lane_map.length[lane])
    return there & state.active[slot]


# ---- following a trajectory


@struct.dataclass(frozen=True, kw_only=True)
class Trajectory:
    """Places of the centres of the egos at `H` >= 2 moments.

    `heading` may be that of the body or of the path: only how it changes counts at driving speed.
    Between samples the path is straight: space them by 0.2 s or less in bends. Wheels are turned for a
    bend that changes evenly from the middle of one step between samples to that of the next.
    """

    x: Float[Array, "E H"]  # m
    y: Float[Array, "E H"]
    heading: Float[Array, "E H"]  # rad
    v: Float[Array, "E H"]  # m/s
    t0: Float[Array, ""]  # s, time of the first sample
    dt: float = struct.field(pytree_node=False, default=0.1)  # s between samples

    def at(self, time: Float[Array, " M"]) -> Float[Array, "E M 4"]:
        """x, y (m), heading (rad, continuous), v (m/s) at these times (s).

        Linear between samples; before the first one as at it, beyond the last straight on at its speed.
        """
        last = self.x.shape[-1] - 1
        place = jnp.maximum((time - self.t0) / self.dt, 0)[None]
        k, u = interval(place, last)
        k, u = k[0], jnp.clip(u, 0, 1)
        beyond = jnp.maximum(place - last, 0) * self.dt
        x, y, heading, v = (
            z[:, k] + u * (z[:, k + 1] - z[:, k]) for z in (self.x, self.y, jnp.unwrap(self.heading), self.v)
        )
        way = beyond * v
        return jnp.stack([x + way * jnp.cos(heading), y + way * jnp.sin(heading), heading, v], -1)


_LOOK = 0.8  # s: the lateral error fades with v * _LOOK m as its length scale ...
_LEAST_LOOK = 3.0  # m: ... but no less
_SETTLE = 1.0  # s: the longitudinal error fades with this time constant
_CLEAR = 0.5  # m: samples farther apart than that tell the direction of the path
_CREEPING = 0.5  # m/s
_LATE = 0.5  # m/s: a place that is due a second sooner or later counts as this much farther away


def track(
    config: Config, limits: Limits, state: State, trajectory: Trajectory, t: Float[Array, ""] | float
) -> Control:
    """Control that follows a trajectory, at time `t` (s).

    Curvature of the path ahead plus feedback of lateral offset e and course error f over the distance,
    kappa = kappa_ref - 2 f / l - e / l^2: both poles of the linearised error at -1 / l. They are those to
    the nearest place on the path, wherever the ego should be by now. Along the path,
    a = a_ref + 2 (v_ref - v) / T + behind / T^2. What is ahead in time makes up for the lags of the
    actuators. After its end a trajectory goes on straight with its last speed.
    """
    egos = state.egos
    v, wheelbase = state.v[egos.slot], state.shape.wheelbase[egos.slot]
    now = jnp.broadcast_to(jnp.asarray(t, v.dtype), v.shape)

    time = trajectory.t0 + trajectory.dt * jnp.arange(trajectory.x.shape[-1], dtype=v.dtype)
    away = (trajectory.x - egos.x[:, None]) ** 2 + (trajectory.y - egos.y[:, None]) ** 2
    near = time[jnp.argmin(away + (_LATE * (time[None, :] - now[:, None])) ** 2, -1)]
    place = _sample(trajectory, near)
    along = (egos.x - place.x) * jnp.cos(place.course) + (egos.y - place.y) * jnp.sin(place.course)
    level = near + along / jnp.maximum(place.v, 1)
    here, goal = _sample(trajectory, level), _sample(trajectory, now)
    behind = goal.way - (place.way + along)
    a = _sample(trajectory, now + limits.acceleration_lag + config.dt / 2).a
    a = a + 2 * (goal.v - v) / _SETTLE + behind / _SETTLE**2

    offset = (egos.y - here.y) * jnp.cos(here.course) - (egos.x - here.x) * jnp.sin(here.course)
    slip = jnp.arctan(jnp.tan(egos.steering) / 2)  # the centre does not move where the body points
    error = wrap_angle(egos.heading + slip - here.course)
    look = jnp.maximum(v * _LOOK, _LEAST_LOOK)
    bend = _sample(trajectory, level + limits.steering_lag + config.dt / 2).bend
    bend = bend - 2 * error / look - offset / look**2
    # an ego that hardly moves turns its wheels as slowly: a path without length has no direction
    present = 2 * jnp.sin(slip) / wheelbase
    bend = present + jnp.clip(here.v / _CREEPING, 0, 1) * (bend - present)
    # of the centre's path: sin(slip) = bend * wheelbase / 2, and tan(steering) = 2 tan(slip)
    sine = jnp.clip(bend * wheelbase / 2, -0.9, 0.9)
    steering = jnp.arctan(2 * sine / jnp.sqrt(1 - sine * sine))
    return Control(
        acceleration=jnp.clip(a, -limits.deceleration, limits.acceleration),
        steering=jnp.clip(steering, -limits.steering, limits.steering),
    )


class _Sample(NamedTuple):
    x: Float[Array, " E"]
    y: Float[Array, " E"]
    course: Float[Array, " E"]  # rad, direction in which the centre moves
    v: Float[Array, " E"]
    bend: Float[Array, " E"]  # 1/m
    a: Float[Array, " E"]
    way: Float[Array, " E"]  # m from the first sample


def _sample(trajectory: Trajectory, time: Float[Array, " E"]) -> _Sample:
    """The trajectory at a time (s) of each ego.

    Its bend in the middle of a step between samples is the step's turn over its length; elsewhere it is
    that of a mixture of the two steps around, so that a step of hardly any length counts for as little.
    If a step had the same bend all along, a look one step ahead would still find the present bend, and
    a planner that replans at every step would never turn the wheels.
    """
    dt, count = trajectory.dt, trajectory.x.shape[-1]
    steps = jnp.stack([jnp.diff(trajectory.x), jnp.diff(trajectory.y)], -1)
    chords = safe_norm(steps)
    way = jnp.cumsum(chords, -1)
    place = (time - trajectory.t0) / dt
    k, u = interval(place, count - 1)
    u = jnp.clip(u, 0, 1)
    x0, y0, h0, v0, v1 = (
        _take(values, k + n)
        for values, n in (
            (trajectory.x, 0), (trajectory.y, 0), (trajectory.heading, 0),
            (trajectory.v, 0), (trajectory.v, 1),
        )
    )  # fmt: skip
    turns = wrap_angle(jnp.diff(trajectory.heading))
    turn, dx, dy, chord = (_take(values, k) for values in (turns, steps[..., 0], steps[..., 1], chords))
    # the two steps with this place between their middles
    before, share = interval(place - 0.5, count - 1)
    after, share = jnp.minimum(before + 1, count - 2), jnp.clip(share, 0, 1)
    turned, went = ((1 - share) * _take(z, before) + share * _take(z, after) for z in (turns, chords))
    clear = jnp.clip(chord / _CLEAR, 0, 1)
    course = h0 + u * turn + clear * wrap_angle(direction(dx, dy) - h0 - turn / 2)
    v = v0 + u * (v1 - v0)
    outside = place - k.astype(place.dtype) - u
    rest = outside * dt * v
    inside = outside == 0
    return _Sample(
        x=x0 + u * dx + rest * jnp.cos(course),
        y=y0 + u * dy + rest * jnp.sin(course),
        course=course,
        v=v,
        bend=jnp.where(inside, turned / jnp.maximum(went, 1e-3), 0),
        a=jnp.where(inside, (v1 - v0) / dt, 0),
        way=_take(way, k) - (1 - u) * chord + rest,
    )


# ---- meta-actions


class Meta(enum.IntEnum):
    """Commands to an ego that keeps to lanes, until the next decision."""

    KEEP = 0  # the speed
    ACCELERATE = 1
    DECELERATE = 2
    LEFT = 3  # change lanes, at this speed
    RIGHT = 4
    STOP = 5


META_ACCELERATION = (0.0, 1.5, -2.0, 0.0, 0.0, -4.0)
"""m/s^2 for each `Meta`."""


def meta_acceleration(
    meta: Int[Array, " E"], state: State, a_follow: Float[Array, " N"], raw: bool = False
) -> Float[Array, " E"]:
    """Acceleration of egos that take a meta-action, m/s^2.

    At most `a_follow`, that of traffic in their place, which minds leaders, limits and bends; `raw`: not
    even that.
    """
    wish = jnp.asarray(META_ACCELERATION, a_follow.dtype)[meta]
    return wish if raw else jnp.minimum(wish, a_follow[state.egos.slot])


def meta_lane(lane_map: LaneMap, state: State, meta: Int[Array, " E"]) -> Int[Array, " E"]:
    """Side of the lane change that a meta-action asks for: +1 left, -1 right, 0 none.

    0 where the marks or the kind of lane forbid it, during another change, and for free egos. Whether there
    is room is not checked.
    """
    egos = state.egos
    lane, vehicle = state.lane[egos.slot], state.shape.vehicle_class[egos.slot]
    left = meta == Meta.LEFT
    beside = jnp.where(left, lane_map.left[lane], lane_map.right[lane])
    allowed = jnp.where(left, lane_map.may_change_left[lane], lane_map.may_change_right[lane])
    allowed &= (beside != NO_LANE) & (((lane_map.access[beside] >> vehicle) & 1) == 1)
    allowed &= state.active[egos.slot] & (state.side[egos.slot] == 0) & ~egos.free
    asked = jnp.where(left, 1, jnp.where(meta == Meta.RIGHT, -1, 0))
    return jnp.where(allowed, asked, 0)
