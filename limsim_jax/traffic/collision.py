"""Contacts, vehicles off the road, wrong-way driving: recorded, never removed.

`record` writes the bits of `State.status`; `AfterCollision` says what collided vehicles do.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt

from limsim_jax.geometry import box_corners
from limsim_jax.maps.lane_map import (
    NO_LANE,
    LaneMap,
    curvature,
    elevation,
    pose,
    project,
    side_s,
    to_frenet,
    width,
)
from limsim_jax.traffic.bodies import body_place
from limsim_jax.traffic.ego import at_slots
from limsim_jax.types import Config, State, Status
from limsim_jax.xla import computed_once

REACH = 1.0
"""m, range of `contacts`; what is farther away counts as this far."""

OVERHANG = 0.3
"""m that a body may stand out from the lanes, as in nuPlan's drivable-area metric."""

AfterCollision = Literal["stop", "continue", "end"]
"""What collided vehicles do: brake to a standstill and stay, continue as if nothing had happened, or end the
episode (they continue until the caller stops, see `collided`)."""

_TILT = 0.5  # rad: the sweep runs at an angle to streets, which mostly run north or east
_QUANTUM = 16.0  # levels of a sort key per metre
_FAR = 1e9  # m
_CLOSE = 4.0  # m: a corner that is farther from the centre is looked up in the map


CLEARANCE = 3.0
"""m between the roads on and below a bridge, from which vehicles on them cannot touch."""


class Contacts(NamedTuple):
    """The nearest other body of every vehicle."""

    other: Int[Array, " N"]  # slot of the nearest body if they touch, -1 otherwise
    nearest: Int[Array, " N"]  # slot of the nearest body within `REACH`, -1 if there is none
    separation: Float[
        Array, " N"
    ]  # m to it as `geometry.box_separation`, negative in contact; at most `REACH`


class _Bodies(NamedTuple):
    x: Array
    y: Array
    cos: Array
    sin: Array
    length: Array  # m, halves
    width: Array
    z: Array  # m


@jax.named_scope("contacts")
def contacts(
    box: Float[Array, "N 5"], active: Bool[Array, " N"], z: Float[Array, " N"] | None = None
) -> Contacts:
    """The nearest body of every vehicle, and whether they touch.

    Exact for any number of vehicles. Sweep and prune: bodies are sorted by where they begin along one
    direction. Each is compared with the first, second, ... one after and before it, as long as any two of
    them can be within `REACH`. So only the time depends on how dense the traffic is. The comparison is the
    separating-axis test. Bodies with numbers that are not finite touch none. There is no gradient; that of
    `geometry.box_separation` to `nearest` is meaningful.

    Args:
      box: x, y (m), heading (rad), length, width (m).
      active: vehicles that count.
      z: m, elevation; bodies more than `CLEARANCE` apart in height are out of reach.
    """
    n = box.shape[0]
    box = lax.stop_gradient(box)
    active = active & jnp.isfinite(box).all(-1)
    me = jnp.arange(n, dtype=jnp.int32)
    far = _FAR * (1 + me.astype(box.dtype))  # inactive ones are out of the reach of all, and of one another
    x, y, heading, length, breadth = (jnp.where(active, box[:, k], 0) for k in range(5))
    z = jnp.zeros_like(x) if z is None else jnp.where(active, lax.stop_gradient(z), 0)
    bodies = computed_once(_Bodies(x, y, jnp.cos(heading), jnp.sin(heading), length / 2, breadth / 2, z))
    order, begin, end = _sweep(bodies, active)
    bodies = bodies._replace(x=jnp.where(active, x, far))
    bodies = computed_once(_Bodies(*(values[order] for values in bodies)))
    ring = _Bodies(*(jnp.concatenate([values, values]) for values in bodies))

    begin = jnp.concatenate([begin, jnp.full(n, 2**32 - 1, begin.dtype)])  # none follows the last

    def meet(step: Array) -> Array:
        # whether any two that are `step` places apart can; if none do, none that are farther apart do
        return (step <= n // 2) & (lax.dynamic_slice(begin, (step,), (n,)) <= end).any()

    def compare(carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        step, _, nearest, least = carry
        after = _Bodies(*(lax.dynamic_slice(v, (step,), (n,)) for v in ring))
        gap = computed_once(_separation(bodies, after))  # the same from both
        before = lax.dynamic_slice(jnp.concatenate([gap, gap]), (n - step,), (n,))
        for start, gap_there in ((step, gap), (n - step, before)):
            closer = gap_there < least
            nearest, least = jnp.where(closer, me + start, nearest), jnp.where(closer, gap_there, least)
        return step + 1, meet(step + 1), nearest, least

    first = jnp.int32(1)
    alone = (first, meet(first), jnp.full(n, -1, jnp.int32), jnp.full(n, REACH, box.dtype))
    _, _, nearest, least = lax.while_loop(lambda carry: carry[1], compare, alone)
    nearest = jnp.where(nearest >= 0, order[nearest % n], -1)
    place = jnp.zeros(n, jnp.int32).at[order].set(me, unique_indices=True)
    nearest, least = nearest[place], least[place]
    return Contacts(jnp.where(least <= 0, nearest, -1), nearest, least)


def _sweep(
    bodies: _Bodies, active: Bool[Array, " N"]
) -> tuple[Int[Array, " N"], UInt[Array, " N"], UInt[Array, " N"]]:
    """Slots in order along the sweep, and where each begins and ends.

    Ends are in levels of the key. One integer holds place and slot: sorting those is ten times as fast as
    sorting pairs.
    """
    n = active.shape[0]
    bits = max(1, (n - 1).bit_length())
    top = (1 << (32 - bits)) - 1
    c, s = math.cos(_TILT), math.sin(_TILT)
    ahead, across = c * bodies.x + s * bodies.y, c * bodies.y - s * bodies.x

    def spread(place: Array) -> Array:
        return jnp.max(jnp.where(active, place, -_FAR)) - jnp.min(jnp.where(active, place, _FAR))

    along = spread(ahead) >= spread(across)
    middle = jnp.where(along, ahead, across)
    dx, dy = jnp.where(along, c, -s), jnp.where(along, s, c)
    half = jnp.abs(bodies.cos * dx + bodies.sin * dy) * bodies.length
    half += jnp.abs(bodies.cos * dy - bodies.sin * dx) * bodies.width
    # a corner can be sqrt(2) times as far from another as any of the four directions tells
    half += REACH * math.sqrt(0.5) + 0.01

    def level(place: Array) -> Array:
        # rounding and clipping keep the order, so no pair is lost to them
        steps = jnp.clip(jnp.floor(place * _QUANTUM), -1e9, 1e9).astype(jnp.int32)
        return (jnp.clip(steps, -(top // 2), top // 2 - 1) + top // 2).astype(jnp.uint32)

    begin = jnp.where(active, level(middle - half), top)
    end = computed_once(jnp.where(active, level(middle + half), jnp.uint32(0)))
    key = lax.sort((begin << bits) | jnp.arange(n, dtype=jnp.uint32))
    order = (key & ((1 << bits) - 1)).astype(jnp.int32)
    return computed_once((order, key >> bits, end[order]))


def _separation(a: _Bodies, b: _Bodies) -> Float[Array, " N"]:
    """`geometry.box_separation` of many pairs at once, m."""
    dx, dy = b.x - a.x, b.y - a.y
    c = jnp.abs(a.cos * b.cos + a.sin * b.sin)
    s = jnp.abs(a.cos * b.sin - a.sin * b.cos)
    gaps = [
        jnp.abs(a.cos * dx + a.sin * dy) - (a.length + c * b.length + s * b.width),
        jnp.abs(a.cos * dy - a.sin * dx) - (a.width + s * b.length + c * b.width),
        jnp.abs(b.cos * dx + b.sin * dy) - (b.length + c * a.length + s * a.width),
        jnp.abs(b.cos * dy - b.sin * dx) - (b.width + s * a.length + c * a.width),
    ]
    gap = jnp.maximum(jnp.maximum(gaps[0], gaps[1]), jnp.maximum(gaps[2], gaps[3]))
    return jnp.maximum(gap, jnp.where(jnp.abs(a.z - b.z) > CLEARANCE, REACH, -_FAR))


# ---- the road


def off_road(
    lane_map: LaneMap, state: State, box: Float[Array, "N 5"], *, free: bool = True
) -> Bool[Array, " N"]:
    """Vehicles of which more than `OVERHANG` is off the road.

    The road is the lanes for motor traffic: shoulders do not count, and in a junction only its lanes do. At
    the edge of the map the road is taken to go on. Traffic that keeps to lanes is checked by its offset and
    the widths of its lane and the neighbour; a body wider than its lane does not count for that. Until it
    has left the lane before a junction, the road goes on as wide as there. Of free
    egos every corner of the box is checked against the lane and its neighbours, then against the nearest
    lane of the map and its neighbours.

    Args:
      lane_map: where.
      state: the world.
      box: `motion.boxes`.
      free: False is for worlds without free egos, and compiles much faster.
    """
    half, own = state.shape.width / 2, width(lane_map, state.lane, state.s) / 2
    side = jnp.where(state.d > 0, 1, -1)
    before = _beside(lane_map, state.previous, lane_map.length[state.previous], side)
    enters = (lane_map.junction[state.lane] >= 0) & (lane_map.junction[state.previous] < 0)
    before = jnp.where(enters & (state.s < state.shape.length), before, 0)
    edge = jnp.maximum(own, half) + jnp.maximum(_beside(lane_map, state.lane, state.s, side), before)
    off = state.active & (jnp.abs(state.d) + half > edge + OVERHANG)
    if not free or state.egos.slot.shape[0] == 0:
        return off
    return at_slots(state.egos, _corner_off(lane_map, state, box), off, state.egos.free) & state.active


def _beside(lane_map: LaneMap, lane: Array, s: Array, side: Array) -> Array:
    """Width (m) of the lane on a side, 0 for none."""
    other = jnp.where(side > 0, lane_map.left[lane], lane_map.right[lane])
    return jnp.where(other != NO_LANE, width(lane_map, other, side_s(lane_map, lane, s, side)), 0)


class _Section(NamedTuple):
    """The road at the centre of each free ego: `E`."""

    lane: Array
    s: Array  # m
    heading: Array  # rad
    own: Array  # m, half the width of the lane
    left: Array  # m, width of the neighbour
    right: Array


def _section(lane_map: LaneMap, state: State) -> _Section:
    slot = state.egos.slot
    lane, s = body_place(lane_map, state, slot)
    one = jnp.ones_like(lane)
    return _Section(
        lane,
        s,
        pose(lane_map, lane, s)[2],
        width(lane_map, lane, s) / 2,
        _beside(lane_map, lane, s, one),
        _beside(lane_map, lane, s, -one),
    )


def _corner_off(lane_map: LaneMap, state: State, box: Float[Array, "N 5"]) -> Bool[Array, " E"]:
    """Whether a corner of each ego's box is off the road."""
    egos = state.egos
    body = lax.stop_gradient(box[egos.slot])
    corner = jax.vmap(box_corners)(body)  # [E, 4, 2]
    x, y = corner[..., 0], corner[..., 1]
    road = _section(lane_map, state)

    # Offset of the corners if the lane goes on with the curvature that it has here: near the centre, the
    # error is far below OVERHANG. Past the ends of the lane its neighbours do not count.
    across = (-jnp.sin(road.heading), jnp.cos(road.heading))
    rel_x, rel_y = x - body[:, :1], y - body[:, 1:2]
    ahead = rel_x * across[1][:, None] - rel_y * across[0][:, None]
    beside = rel_x * across[0][:, None] + rel_y * across[1][:, None] + state.d[egos.slot][:, None]
    bend = curvature(lane_map, road.lane, road.s)[:, None]
    root = jnp.sqrt((1 - bend * beside) ** 2 + (bend * ahead) ** 2)
    d = (2 * beside - bend * (beside**2 + ahead**2)) / (1 + root)
    s = road.s[:, None] + ahead
    inside = (s >= 0) & (s <= lane_map.length[road.lane][:, None])
    left, right = (road.own[:, None] + jnp.where(inside, w[:, None], 0) for w in (road.left, road.right))
    off = (d > left) | (d < -right) | (rel_x * rel_x + rel_y * rel_y > _CLOSE**2)

    # What that leaves open is looked up in the whole map, as long as it would be news.
    known = (state.status[egos.slot] & int(Status.OFF_ROAD)) != 0
    unsure = off & (egos.free & state.active[egos.slot] & ~known)[:, None]

    def look(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        unsure, off = carry
        lane, s, d, _ = project(lane_map, x, y)
        edge = width(lane_map, lane, s) / 2 + _beside(lane_map, lane, s, jnp.where(d > 0, 1, -1))
        on = (lane != NO_LANE) & (jnp.abs(d) <= edge + OVERHANG)
        return jnp.zeros_like(unsure), off & ~(unsure & on)

    _, off = lax.while_loop(lambda carry: carry[0].any(), look, (unsure, off))
    return off.any(-1)


def wrong_way(lane_map: LaneMap, state: State, box: Float[Array, "N 5"]) -> Bool[Array, " N"]:
    """Free egos that point against their lanes, by more than 90 degrees.

    These are the lanes on which their centre is: the own one and its neighbours, or the oncoming one beside
    it. Off all of them no direction is wrong, and traffic that keeps to lanes never drives the wrong way.
    """
    egos = state.egos
    none = jnp.zeros_like(state.active)
    if egos.slot.shape[0] == 0:
        return none
    x, y, heading = (lax.stop_gradient(box[egos.slot, k]) for k in range(3))
    d = state.d[egos.slot]
    road = _section(lane_map, state)
    with_us = (d <= road.own + road.left) & (d >= -road.own - road.right)
    oncoming = lane_map.opposite[road.lane]
    level = (1 - road.s / lane_map.length[road.lane]) * lane_map.length[oncoming]
    s, offset, _ = to_frenet(lane_map, oncoming, level, x, y)
    to_us = (oncoming != NO_LANE) & (jnp.abs(offset) <= width(lane_map, oncoming, s) / 2)
    along = jnp.cos(heading - road.heading) >= 0
    return at_slots(egos, jnp.where(with_us, ~along, to_us & along), none, egos.free) & state.active


# ---- what has happened


def record(
    config: Config, lane_map: LaneMap, state: State, box: Float[Array, "N 5"], *, free: bool = True
) -> tuple[State, Bool[Array, " N"]]:
    """Record contacts, vehicles off the road, wrong ways and broken numbers.

    Sets bits of `status`. `struck` and `struck_at` hold the first contact only, by slot: a vehicle that
    enters there later is another one. No vehicle is moved or removed.

    Args:
      config: of the run.
      lane_map: where.
      state: the world.
      box: as `motion.boxes`.
      free: False is for worlds without free egos.

    Returns:
      The state, and the vehicles off the road.
    """
    touched = contacts(box, state.active, level(lane_map, state)).other
    hit = touched >= 0
    first = hit & (state.struck < 0)
    numbers = jnp.stack([state.s, state.d, state.v, state.a], -1)
    broken = state.active & ~(jnp.isfinite(numbers).all(-1) & jnp.isfinite(box).all(-1))
    off = computed_once(off_road(lane_map, state, box, free=free))
    wrong = wrong_way(lane_map, state, box) if free else jnp.zeros_like(off)
    status = state.status
    for which, bit in (
        (hit, Status.COLLIDED),
        (off, Status.OFF_ROAD),
        (wrong, Status.WRONG_WAY),
        (broken, Status.NOT_FINITE),
    ):
        status |= jnp.where(which, int(bit), 0)
    after = replace(
        state,
        status=status,
        struck=jnp.where(first, touched, state.struck),
        struck_at=jnp.where(first, config.time(state.step), state.struck_at),
    )
    return after, off


def level(lane_map: LaneMap, state: State) -> Float[Array, " N"]:
    """Elevation (m) of the road under every vehicle: above or below a bridge."""
    return elevation(lane_map, state.lane, state.s)[0]


def collided(state: State) -> Bool[Array, ""]:
    """Whether any vehicle on the road has touched another body."""
    return (state.active & ((state.status & int(Status.COLLIDED)) != 0)).any()


def after_collision(
    state: State,
    a: Float[Array, "*n"],
    option: AfterCollision,
    slot: Int[Array, "*n"] | None = None,
) -> Float[Array, "*n"]:
    """Acceleration (m/s^2) of vehicles in view of the collisions they have had.

    Args:
      state: the world, which knows what has collided.
      a: m/s^2, what vehicles do otherwise; of all slots, or of those in `slot` (the control of egos).
      option: with "stop", collided vehicles brake with `b_max` until they stand, and stay.
      slot: the slots that `a` is for.

    Raises:
      ValueError: unknown option.
    """
    if option not in get_args(AfterCollision):
        raise ValueError(
            f"after_collision = '{option}' is unknown; known are {', '.join(get_args(AfterCollision))}"
        )
    if option != "stop":
        return a
    status, b_max = (x if slot is None else x[slot] for x in (state.status, state.driver.b_max))
    return jnp.where((status & int(Status.COLLIDED)) != 0, -b_max, a)
