"""What happens at the moment at which actions begin or are stopped."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.scenarios.openscenario.arrays import (
    LATERAL,
    LONGITUDINAL,
    ActionRows,
    Board,
    Dimension,
    Kind,
    Memory,
    Shape,
)
from limsim_jax.scenarios.openscenario.conditions import Geometry
from limsim_jax.scenarios.openscenario.lookups import angle, center_of, column_at, lanes, project
from limsim_jax.scenarios.openscenario.roads import SIDE

_AT_ONCE = (
    Kind.NOTHING, Kind.TELEPORT, Kind.CONTROL, Kind.SEEN, Kind.APPEAR, Kind.DISAPPEAR, Kind.VALUE,
)  # fmt: skip
_OPPOSITE = -0.5  # cosine between two directions, from which left and right are swapped


def rules_speed(actions: ActionRows) -> Bool[Array, " A"]:
    """Rows that rule the motion along the road."""
    timed = (actions.kind == int(Kind.TRAJECTORY)) & actions.timed
    return among(actions.kind, LONGITUDINAL[:-1]) | timed


def rules_side(actions: ActionRows) -> Bool[Array, " A"]:
    """Rows that rule the motion across the road."""
    return among(actions.kind, LATERAL)


def among(kind: Int[Array, " A"], kinds: tuple[Kind, ...]) -> Bool[Array, " A"]:
    """Rows of one of these kinds."""
    return jnp.isin(kind, jnp.array([int(x) for x in kinds]))


def last_of(actions: ActionRows, which: Bool[Array, " A"], count: int) -> Int[Array, " K"]:
    """The last of these rows for each entity; -1: none."""
    mine = which[None] & (actions.entity[None] == jnp.arange(count)[:, None])
    return jnp.max(jnp.where(mine, jnp.arange(which.shape[0])[None], -1), -1).astype(jnp.int32)


def begin(
    board: Board,
    memory: Memory,
    geometry: Geometry,
    time: Float[Array, ""],
    begins: Bool[Array, " A"],
    stops: Bool[Array, " A"],
) -> Memory:
    """The memory after actions have begun or were stopped.

    Args:
      board: the scenario.
      memory: of the storyboard of this step.
      geometry: how entities lie to each other.
      time: s.
      begins: rows that begin.
      stops: rows that are stopped.
    """
    actions = board.actions
    count = memory.v.shape[0]
    # an action that begins ends what ruled the same motion of its entity
    speed, side = rules_speed(actions), rules_side(actions)
    new_speed, new_side = (last_of(actions, begins & x, count) for x in (speed, side))
    entity = jnp.maximum(actions.entity, 0)
    number = jnp.arange(actions.kind.shape[0])
    running = jnp.isfinite(memory.at) & ~memory.done & ~begins
    ousted = running & (
        (speed & (new_speed[entity] >= 0) & (memory.longitudinal[entity] == number))
        | (side & (new_side[entity] >= 0) & (memory.lateral[entity] == number))
    )
    # of two that begin at once the last one counts
    late = begins & ((speed & (new_speed[entity] != number)) | (side & (new_side[entity] != number)))
    moved = last_of(actions, begins & among(actions.kind, (Kind.TELEPORT, Kind.ROUTE, Kind.APPEAR)), count)
    ousted |= running & side & (moved[entity] >= 0)
    gone = stops | ousted
    done = jnp.where(begins, among(actions.kind, _AT_ONCE) | late, memory.done | gone)

    def ruled(now: Array, new: Array) -> Array:
        ended = (now >= 0) & (gone | done)[jnp.maximum(now, 0)]
        return jnp.where(new >= 0, new, jnp.where(ended, -1, now))

    memory = _begun(board, memory, geometry, time, begins)
    memory = replace(
        memory,
        done=done,
        longitudinal=ruled(memory.longitudinal, new_speed),
        lateral=ruled(memory.lateral, new_side),
    )
    return _at_once(board, memory, geometry, begins, moved)


def _begun(
    board: Board, memory: Memory, geometry: Geometry, time: Float[Array, ""], begins: Bool[Array, " A"]
) -> Memory:
    """What actions remember of their begin: start, target and duration."""
    a, corridors = board.actions, board.corridors
    k, o = jnp.maximum(a.entity, 0), jnp.maximum(a.other, 0)
    c, s, t = memory.corridor[k], memory.s[k], memory.t[k]
    v, v_other = memory.v[k], memory.v[o]
    column = memory.column[k]

    # speeds
    relative = jnp.where(a.factor, v_other * a.value, v_other + a.value)
    target = jnp.where(a.other >= 0, relative, a.value)
    target = jnp.where(a.kind == int(Kind.PROFILE), jnp.where(a.other >= 0, v_other, 0), target)

    # lanes and offsets
    here = lanes(corridors, c, s)
    named = (here.number == a.lane[:, None]) & (here.half > 0)
    absolute = jnp.where(named.any(-1), jnp.argmax(named, -1).astype(jnp.int32), column)
    s_other, t_other, h_other = (jnp.take_along_axis(x[k], o[:, None], 1)[:, 0] for x in (
        geometry.s, geometry.t, geometry.h
    ))  # fmt: skip
    column_other = column_at(corridors, c, s_other, t_other)
    swapped = jnp.cos(memory.pose[o, 2] - h_other) < _OPPOSITE
    beside = column_other + jnp.where(swapped, -a.lane, a.lane)
    column_to = jnp.where(a.other >= 0, jnp.clip(beside, 0, 2 * SIDE), absolute)
    off_other = t_other - center_of(corridors, c, s_other, column_other)
    aside = jnp.where(swapped, -a.value, a.value)
    off_to = jnp.where(a.other >= 0, off_other + aside, a.value * here.sign)
    change = a.kind == int(Kind.LANE)
    offset = a.kind == int(Kind.OFFSET)
    column_to = jnp.where(change, column_to, column)
    off_to = jnp.where(change, a.offset * here.sign, off_to)
    way = center_of(corridors, c, s, column_to) + off_to - t
    off_from = t - center_of(corridors, c, s, column)

    lateral = change | offset
    span = _span(a, jnp.where(lateral, way, target - v), v, target, lateral)
    span = jnp.where(a.kind == int(Kind.PROFILE), a.times[:, -1], span)
    base = jnp.where((a.kind == int(Kind.TRAJECTORY)) & ~a.timed, a.offset, v)

    def fresh(old: Array, new: Array) -> Array:
        return jnp.where(begins if old.ndim == 1 else begins[:, None], new, old)

    memory = replace(
        memory,
        at=fresh(memory.at, jnp.broadcast_to(time, memory.at.shape)),
        base=fresh(memory.base, base),
        target=fresh(memory.target, jnp.where(lateral, off_to, target)),
        span=fresh(memory.span, span),
        went=fresh(memory.went, jnp.zeros_like(memory.went)),
        column_from=fresh(memory.column_from, column),
        off_from=fresh(memory.off_from, off_from),
        anchor=fresh(memory.anchor, memory.pose[k]),
    )
    row = last_of(a, begins & lateral, memory.v.shape[0])
    mine = row >= 0
    row = jnp.maximum(row, 0)
    return replace(
        memory,
        column=jnp.where(mine, column_to[row], memory.column),
        off=jnp.where(mine, off_to[row], memory.off),
    )


def _span(a: ActionRows, way: Array, v: Array, target: Array, lateral: Array) -> Float[Array, " A"]:
    """How long actions take: s, or m for lateral ones over a distance.

    A rate is the peak of the change: the duration is that over which the shape has this peak slope. A
    distance in which a speed is reached is covered at the mean of both speeds. A lateral acceleration is
    the peak of the second derivative.
    """
    way = jnp.abs(way)
    shape = a.shape
    slope = jnp.select([shape == int(Shape.SINUSOIDAL), shape == int(Shape.CUBIC)], [jnp.pi / 2, 1.5], 1.0)
    peak = jnp.select([shape == int(Shape.SINUSOIDAL), shape == int(Shape.CUBIC)], [jnp.pi**2 / 2, 6.0], 4.0)
    over = jnp.maximum(a.over, 1e-9)
    mean = jnp.maximum(jnp.abs(v + target) / 2, 1e-6)
    span = jnp.select(
        [a.dimension == int(x) for x in (Dimension.RATE, Dimension.DISTANCE, Dimension.ACCELERATION)],
        [slope * way / over, jnp.where(lateral, a.over, a.over / mean), jnp.sqrt(peak * way / over)],
        a.over,
    )
    return jnp.where(shape == int(Shape.STEP), 0, jnp.where(way > 0, span, jnp.where(
        (a.dimension == int(Dimension.TIME)) | (lateral & (a.dimension == int(Dimension.DISTANCE))), span, 0
    )))  # fmt: skip


def _at_once(
    board: Board, memory: Memory, geometry: Geometry, begins: Bool[Array, " A"], moved: Int[Array, " K"]
) -> Memory:
    """Effects of actions that take no time, and of routes."""
    a, corridors, places = board.actions, board.corridors, board.places
    count = memory.v.shape[0]

    def of(*kinds: Kind) -> tuple[Array, Array]:
        row = last_of(a, begins & among(a.kind, kinds), count)
        return row >= 0, jnp.maximum(row, 0)

    appears, _ = of(Kind.APPEAR)
    vanishes, _ = of(Kind.DISAPPEAR)
    seen, seen_row = of(Kind.SEEN)
    handed, handed_row = of(Kind.CONTROL)
    held = jnp.where(handed & board.entities.policy, a.value[handed_row] <= 0, memory.held)

    # somewhere else, or on another way
    row = jnp.maximum(moved, 0)
    route = (moved >= 0) & (a.kind[row] == int(Kind.ROUTE))
    jumps = (moved >= 0) & ~route
    place = jnp.maximum(a.place[row], 0)
    pose = jnp.where(jumps[:, None], geometry.pose[count + place], memory.pose)
    by_entity = memory.corridor[jnp.maximum(places.entity[place], 0)]
    there = jnp.where(places.corridor[place] >= 0, places.corridor[place], by_entity)
    corridor = jnp.where(route, a.corridor[row], jnp.where(jumps, there, memory.corridor))
    on = project(corridors, corridor, pose[:, 0], pose[:, 1])
    column = column_at(corridors, corridor, on.s, on.t)
    off = on.t - center_of(corridors, corridor, on.s, column)
    anew = moved >= 0

    def fresh(old: Array, new: Array) -> Array:
        return jnp.where(anew if old.ndim == 1 else anew[:, None], new, old)

    variable = jnp.arange(memory.values.shape[0])
    on_value = begins & (a.kind == int(Kind.VALUE))
    hit = on_value[None] & (a.variable[None] == variable[:, None])
    value_row = jnp.max(jnp.where(hit, jnp.arange(hit.shape[1])[None], -1), -1)
    by, old = a.value[value_row], memory.values
    new = jnp.select([a.how[value_row] == 1, a.how[value_row] == 2], [old + by, old * by], by)
    return replace(
        memory,
        there=(memory.there | appears) & ~vanishes,
        seen=jnp.where(seen, a.value[seen_row] > 0, memory.seen),
        held=held,
        pose=pose,
        corridor=corridor,
        s=fresh(memory.s, on.s),
        t=fresh(memory.t, on.t),
        yaw=fresh(memory.yaw, angle(pose[:, 2], on.h)),
        column=fresh(memory.column, column),
        off=fresh(memory.off, off),
        values=jnp.where(value_row >= 0, new, old),
    )
