"""Conditions on the device: how entities lie to each other, and which tests are true."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.scenarios.openscenario.arrays import Along, Board, Frame, Memory, PlaceKind, Rule, Test
from limsim_jax.scenarios.openscenario.lookups import (
    angle,
    at_end,
    between,
    center_of,
    column_at,
    lanes,
    on_road,
    point,
    project,
)

SAME = 1e-4
"""s, within which two times are the same."""

STANDING = 1e-3
"""m/s, below which an entity stands."""

_EXACT = 1e-5  # of other values that are the same
_NEVER = 1e9  # s, of a gap that does not close


class Geometry(NamedTuple):
    """How `K` entities see `N` = K + L targets: entities, then places."""

    pose: Float[Array, "N 3"]
    speed: Float[Array, " N"]
    s: Float[Array, "K N"]  # targets on the corridor of each entity
    t: Float[Array, "K N"]
    h: Float[Array, "K N"]  # rad, of the corridor there
    distance: Float[Array, "K N 3 3 2"]  # by `Frame`, `Along`, freespace or not
    ahead: Float[Array, "K N 3"]  # m, signed, by `Frame`
    beside: Float[Array, "K N 3"]


def place_poses(board: Board, memory: Memory) -> Float[Array, "L 3"]:
    """Where places are now."""
    places, corridors = board.places, board.corridors
    k = jnp.maximum(places.entity, 0)
    c, s, t, pose = memory.corridor[k], memory.s[k], memory.t[k], memory.pose[k]
    s_there = s + places.along
    lane = column_at(corridors, c, s, t) + places.lanes
    sign = lanes(corridors, c, s_there).sign
    beside = center_of(corridors, c, s_there, lane) + places.beside * sign
    t_there = jnp.where(places.kind == int(PlaceKind.LANE), beside, t + places.beside)
    road = point(corridors, c, s_there, t_there)
    cos, sin = jnp.cos(pose[:, 2]), jnp.sin(pose[:, 2])
    own = jnp.stack(
        [
            pose[:, 0] + cos * places.along - sin * places.beside,
            pose[:, 1] + sin * places.along + cos * places.beside,
            pose[:, 2],
        ],
        -1,
    )
    world = jnp.stack([pose[:, 0] + places.along, pose[:, 1] + places.beside, pose[:, 2]], -1)
    on_lane = (places.kind == int(PlaceKind.LANE)) | (places.kind == int(PlaceKind.ROAD))
    moved = jnp.where(
        on_lane[:, None], road, jnp.where((places.kind == int(PlaceKind.OBJECT))[:, None], own, world)
    )
    direction = moved[:, 2] + jnp.where(on_lane & (sign < 0), jnp.pi, 0)  # of the road, not of travel
    h = jnp.where(
        places.turned == 0,
        moved[:, 2],
        places.pose[:, 2] + jnp.where(places.turned == 1, direction, 0),
    )
    moved = jnp.concatenate([moved[:, :2], h[:, None]], -1)
    return jnp.where((places.kind == int(PlaceKind.FIXED))[:, None], places.pose, moved)


def look(board: Board, memory: Memory) -> Geometry:
    """How all entities lie to each other and to the places now."""
    entities, corridors = board.entities, board.corridors
    count = entities.length.shape[0]
    places = place_poses(board, memory)
    nothing = jnp.zeros(places.shape[0], places.dtype)
    pose = jnp.concatenate([memory.pose, places])
    speed = jnp.concatenate([memory.v, nothing])
    length, width, front = (
        jnp.concatenate([x, nothing]) for x in (entities.length, entities.width, entities.ahead)
    )
    total = pose.shape[0]

    def wide(x: Array) -> Array:
        return jnp.broadcast_to(x[:, None], (count, total, *x.shape[1:]))

    def high(x: Array) -> Array:
        return jnp.broadcast_to(x[None], (count, *x.shape))

    own, other = wide(memory.pose), high(pose)
    on = project(corridors, wide(memory.corridor), other[..., 0], other[..., 1])
    me = jnp.arange(count)
    s_own, t_own, h_own = (x[me, me][:, None] for x in (on.s, on.t, on.h))

    dx, dy = other[..., 0] - own[..., 0], other[..., 1] - own[..., 1]
    cos, sin = jnp.cos(own[..., 2]), jnp.sin(own[..., 2])
    ahead = jnp.stack([cos * dx + sin * dy, on.s - s_own, dx], -1)
    beside = jnp.stack([cos * dy - sin * dx, on.t - t_own, dy], -1)
    far = jnp.hypot(dx, dy)

    # half extents and middles of both bodies along and across the axes of each frame
    axis = jnp.stack([own[..., 2], on.h, jnp.zeros_like(far)], -1)
    axis_own = jnp.stack([own[..., 2], jnp.broadcast_to(h_own, far.shape), jnp.zeros_like(far)], -1)
    turn, turn_own = other[..., 2, None] - axis, own[..., 2, None] - axis_own

    def extents(turn: Array, length: Array, width: Array, front: Array) -> tuple[Array, ...]:
        c, s = jnp.abs(jnp.cos(turn)), jnp.abs(jnp.sin(turn))
        along = (c * length[..., None] + s * width[..., None]) / 2
        across = (s * length[..., None] + c * width[..., None]) / 2
        return along, across, jnp.cos(turn) * front[..., None], jnp.sin(turn) * front[..., None]

    sizes = [(high(length), high(width), high(front)), tuple(wide(x[:count]) for x in (length, width, front))]
    (along, across, middle, off), (along0, across0, middle0, off0) = (
        extents(z, *size) for z, size in zip((turn, turn_own), sizes, strict=True)
    )
    free_ahead = jnp.maximum(jnp.abs(ahead + middle - middle0) - along - along0, 0)
    free_beside = jnp.maximum(jnp.abs(beside + off - off0) - across - across0, 0)
    apart = between(
        own, wide(entities.ahead), wide(entities.length), wide(entities.width),
        other, high(front), high(length), high(width),
    )  # fmt: skip
    three = (*far.shape, 3)
    distance = jnp.stack(
        [
            jnp.stack([jnp.broadcast_to(far[..., None], three), jnp.abs(ahead), jnp.abs(beside)], -1),
            jnp.stack([jnp.broadcast_to(apart[..., None], three), free_ahead, free_beside], -1),
        ],
        -1,
    )
    return Geometry(pose, speed, on.s, on.t, on.h, distance, ahead, beside)


def compare(a: Array, rule: Int[Array, "*#b"], b: Array, same: Array | float = _EXACT) -> Bool[Array, "*#b"]:
    """Whether `a rule b`; values within `same` are equal."""
    equal = jnp.abs(a - b) <= same
    return jnp.select(
        [rule == int(x) for x in (Rule.EQUAL, Rule.NOT_EQUAL, Rule.GREATER, Rule.GREATER_EQUAL, Rule.LESS)],
        [equal, ~equal, (a > b) & ~equal, (a > b) | equal, (a < b) & ~equal],
        (a < b) | equal,
    )


def raw(
    board: Board, memory: Memory, geometry: Geometry, time: Float[Array, ""]
) -> tuple[Bool[Array, " Q"], Bool[Array, "Q K"]]:
    """Whether tests are true now, before edges and delays; and for which entities."""
    q, entities = board.conditions, board.entities
    count = entities.length.shape[0]
    target = jnp.where(q.entity >= 0, q.entity, count + jnp.maximum(q.place, 0))
    other = jnp.maximum(q.entity, 0)

    def of_target(table: Array) -> Array:  # [K, N, ...] to [Q, K, ...]
        return jnp.moveaxis(table[:, target], 0, 1)

    def pick(table: Array, index: Array) -> Array:  # last axis, by condition
        return jnp.take_along_axis(table, jnp.broadcast_to(index[:, None, None], (*table.shape[:2], 1)), -1)[
            ..., 0
        ]

    gaps = of_target(geometry.distance)  # [Q, K, 3, 3, 2]
    gaps = gaps.reshape(*gaps.shape[:2], 18)
    gap = pick(gaps, (q.frame * 3 + q.along) * 2 + q.freespace.astype(q.frame.dtype))
    v, v_other = memory.v[None], geometry.speed[target][:, None]
    h, h_other = memory.pose[None, :, 2], geometry.pose[target][:, None, 2]
    lane, lane_other = jnp.diagonal(geometry.h)[None], of_target(geometry.h)
    frame, along = q.frame[:, None], q.along[:, None]
    axis = jnp.select([frame == int(Frame.ENTITY), frame == int(Frame.ROAD)], [h, lane], 0.0)
    axis_other = jnp.select([frame == int(Frame.ENTITY), frame == int(Frame.ROAD)], [h, lane_other], 0.0)
    ahead, beside = (pick(of_target(x), q.frame) for x in (geometry.ahead, geometry.beside))
    closing_ahead = jnp.sign(ahead) * (v * jnp.cos(h - axis) - v_other * jnp.cos(h_other - axis_other))
    closing_beside = jnp.sign(beside) * (v * jnp.sin(h - axis) - v_other * jnp.sin(h_other - axis_other))
    seen = geometry.pose[target][:, None, :2] - memory.pose[None, :, :2]
    length = jnp.maximum(jnp.hypot(seen[..., 0], seen[..., 1]), 1e-6)
    relative = jnp.stack(
        [v * jnp.cos(h) - v_other * jnp.cos(h_other), v * jnp.sin(h) - v_other * jnp.sin(h_other)], -1
    )
    closing = (relative * seen).sum(-1) / length
    closing = jnp.select(
        [along == int(Along.LONGITUDINAL), along == int(Along.LATERAL)],
        [closing_ahead, closing_beside],
        closing,
    )
    headway = jnp.where(jnp.abs(v) > STANDING, gap / jnp.maximum(jnp.abs(v), STANDING), _NEVER)
    to_contact = jnp.where(closing > STANDING, gap / jnp.maximum(closing, STANDING), _NEVER)
    own_speed = jnp.where(along == int(Along.LATERAL), memory.across[None], v)
    v_seen = jnp.where(along == int(Along.LONGITUDINAL), v_other * jnp.cos(h_other - h), v_other)
    v_seen = jnp.where(along == int(Along.LATERAL), v_other * jnp.sin(h_other - h), v_seen)
    slower = jnp.where(along == int(Along.LATERAL), 0, v) - v_seen
    near = pick(of_target(geometry.distance[..., 0, 0, 0:1]), jnp.zeros_like(q.frame))

    wide = jnp.ones_like(gap)
    number = {
        Test.TIME: time * wide,
        Test.VALUE: memory.values[jnp.maximum(q.variable, 0)][:, None] * wide,
        Test.HEADWAY: headway,
        Test.COLLISION_TIME: to_contact,
        Test.DISTANCE: gap,
        Test.SPEED: own_speed * wide,
        Test.RELATIVE_SPEED: slower,
        Test.ACCELERATION: memory.a[None] * wide,
    }
    test, rule, value = q.test[:, None], q.rule[:, None], q.value[:, None]
    measured = jnp.select([test == int(k) for k in number], list(number.values()), 0.0)
    same = jnp.where(test == int(Test.TIME), SAME, _EXACT)
    holds = compare(measured, rule, value, same)

    touching = geometry.distance[:, :count, 0, 0, 1] <= 0
    touching &= ~jnp.eye(count, dtype=bool) & memory.there[None] & memory.there[:, None]
    hit_one = touching.T[other]
    kinds = (q.kind[:, None] < 0) | (entities.kind[None] == q.kind[:, None])  # [Q, K]
    hit_any = (touching[None] & kinds[:, None]).any(-1)
    reference = jnp.select(
        [(q.entity >= 0)[:, None], frame == int(Frame.WORLD)], [h_other, jnp.zeros_like(h)], lane
    )
    turned = jnp.abs(angle(angle(h, reference), value)) <= q.tolerance[:, None] + _EXACT
    phase = (q.phase[:, None] >= 0) & (memory.phase[None] == q.phase[:, None])
    changes = (memory.change[None] & q.change[:, None]) != 0
    element = (q.elements & (phase | changes)).any(-1)[:, None]
    truth = {
        Test.ELEMENT: element & (wide > 0),
        Test.REACH: near <= value + _EXACT,
        Test.STAND_STILL: (memory.stood[None] >= value - SAME) & (jnp.abs(v) < STANDING),
        Test.TRAVELED: memory.travelled[None] >= value - SAME,
        Test.END_OF_ROAD: _lasted(memory.ended, value, at_end(board.corridors, memory.corridor, memory.s)),
        Test.OFFROAD: _lasted(
            memory.off_road, value, ~on_road(board.corridors, memory.corridor, memory.s, memory.t)
        ),
        Test.COLLISION: jnp.where((q.entity >= 0)[:, None], hit_one, hit_any),
        Test.ANGLE: turned,
    }
    holds = jnp.select([test == int(k) for k in truth], list(truth.values()), holds)
    holds &= test != int(Test.NEVER)
    there = memory.there[None] & q.who
    there &= (q.entity < 0)[:, None] | memory.there[other][:, None]
    each = holds & there
    alone = ~q.who.any(-1)
    all_of = (each | ~q.who).all(-1)
    both = jnp.where(alone, holds[:, 0], jnp.where(q.every, all_of, each.any(-1)))
    return both, each


def _lasted(since: Array, value: Array, now: Array) -> Array:
    return (since[None] >= value - SAME) & now[None]
