"""How entities move in one step: along and across the road, or on trajectories.

Shapes run from 0 to 1 over u = 0..1: linear u; sinusoidal (1 - cos(pi u)) / 2; cubic 3 u^2 - 2 u^3. Their
integrals are exact, so positions are.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from limsim_jax.scenarios.openscenario.arrays import ActionRows, Board, Kind, Memory, Shape
from limsim_jax.scenarios.openscenario.begin import rules_side, rules_speed
from limsim_jax.scenarios.openscenario.conditions import SAME, Geometry
from limsim_jax.scenarios.openscenario.lookups import angle, bend, center_of, column_at, point, project

_NARROW = 0.1  # least width of an arc against its base line
_CLOSE = 0.05  # m and m/s: a distance is reached
_ARRIVED = 1.0  # m before the end of a route
_SLOWEST = 0.1  # m/s, of a master that still gets somewhere
_STEEP = 0.1  # m/s, from which a body turns with its motion


def shaped(shape: Int[Array, "*#b"], u: Float[Array, "*#b"]) -> Float[Array, "*#b"]:
    """The share of a change after a share `u` of its duration."""
    u = jnp.clip(u, 0, 1)
    return jnp.select(
        [shape == int(Shape.LINEAR), shape == int(Shape.SINUSOIDAL), shape == int(Shape.CUBIC)],
        [u, (1 - jnp.cos(jnp.pi * u)) / 2, u * u * (3 - 2 * u)],
        1.0,
    )


def summed(shape: Int[Array, "*#b"], u: Float[Array, "*#b"]) -> Float[Array, "*#b"]:
    """The integral of `shaped` from 0 to `u`."""
    u = jnp.clip(u, 0, 1)
    return jnp.select(
        [shape == int(Shape.LINEAR), shape == int(Shape.SINUSOIDAL), shape == int(Shape.CUBIC)],
        [u * u / 2, u / 2 - jnp.sin(jnp.pi * u) / (2 * jnp.pi), u * u * u * (1 - u / 2)],
        u,
    )


class _Along(NamedTuple):
    v: Array  # m/s after the step
    way: Array  # m in it
    done: Array  # the action that rules


def _rows(actions: ActionRows, row: Int[Array, " K"]) -> ActionRows:
    """The action of each entity."""
    fields = {name: getattr(actions, name)[row] for name in actions.__dataclass_fields__}
    return ActionRows(**fields)


def move(dt: float, board: Board, memory: Memory, geometry: Geometry, time: Float[Array, ""]) -> Memory:
    """The memory after all entities that are held have moved."""
    along = _along(dt, board, memory, geometry, time)
    row_v, row_d = jnp.maximum(memory.longitudinal, 0), jnp.maximum(memory.lateral, 0)
    moves = memory.held & memory.there
    corridors, c = board.corridors, memory.corridor
    narrow = jnp.maximum(1 - bend(corridors, c, memory.s) * memory.t, _NARROW)
    s = memory.s + along.way / narrow
    t, done_side, besides = _across(dt, board, memory, geometry, time, s, along)
    across = (t - memory.t) / dt

    # bodies turn with their motion, but not on the spot
    v = along.v
    turn = jnp.where(jnp.abs(v) > _STEEP, jnp.arctan2(across, jnp.abs(v)) * jnp.sign(v), 0)
    turn = jnp.where(memory.lateral >= 0, turn, 0)
    pose = point(corridors, c, s, t)
    pose = pose.at[:, 2].add(memory.yaw + turn)

    follows, path, path_v, path_done = _on_path(dt, board, memory, time, along)
    on = project(corridors, c, path[:, 0], path[:, 1])
    pose = jnp.where(follows[:, None], path, pose)
    s, t = jnp.where(follows, on.s, s), jnp.where(follows, on.t, t)
    column = column_at(corridors, c, s, t)
    off = t - center_of(corridors, c, s, column)
    strays = follows | besides
    v = jnp.where(follows, path_v, v)
    way = jnp.where(follows, jnp.hypot(*(path[:, k] - memory.pose[:, k] for k in range(2))), along.way)

    def moved(new: Array, old: Array) -> Array:
        return jnp.where(moves if new.ndim == 1 else moves[:, None], new, old)

    # which actions have come to their end
    a = board.actions
    entity = jnp.maximum(a.entity, 0)
    number = jnp.arange(a.kind.shape[0])
    speed = rules_speed(a) & (memory.longitudinal[entity] == number) & jnp.where(
        a.kind == int(Kind.TRAJECTORY), path_done[entity], along.done[entity]
    )  # fmt: skip
    side = rules_side(a) & (memory.lateral[entity] == number) & jnp.where(
        a.kind == int(Kind.TRAJECTORY), path_done[entity], done_side[entity]
    )  # fmt: skip
    route = (a.kind == int(Kind.ROUTE)) & jnp.isfinite(memory.at) & _arrived(board, memory, geometry)
    done = memory.done | speed | side | route
    runs = jnp.isfinite(memory.at) & ~memory.done

    def still(now: Array, row: Array) -> Array:
        return jnp.where((now >= 0) & done[row], -1, now)

    return replace(
        memory,
        s=moved(s, memory.s),
        t=moved(t, memory.t),
        pose=moved(pose, memory.pose),
        v=moved(v, memory.v),
        a=moved((v - memory.v) / dt, memory.a),
        across=moved(jnp.where(follows, (t - memory.t) / dt, across), memory.across),
        yaw=moved(jnp.where(follows, angle(pose[:, 2], on.h), memory.yaw), memory.yaw),
        column=moved(jnp.where(strays, column, memory.column), memory.column),
        off=moved(jnp.where(strays, off, memory.off), memory.off),
        travelled=moved(memory.travelled + jnp.abs(way), memory.travelled),
        went=jnp.where(runs, memory.went + jnp.abs(along.way)[entity], memory.went),
        done=done,
        longitudinal=still(memory.longitudinal, row_v),
        lateral=still(memory.lateral, row_d),
    )


# --- along


def _along(dt: float, board: Board, memory: Memory, geometry: Geometry, time: Float[Array, ""]) -> _Along:
    """Speed and metres along the road of every entity."""
    rules = memory.longitudinal >= 0
    row = jnp.maximum(memory.longitudinal, 0)
    a = _rows(board.actions, row)
    at, v0, target, span = memory.at[row], memory.base[row], memory.target[row], memory.span[row]
    since = jnp.maximum(time - at, 0)
    over = since + dt >= span - SAME
    v = memory.v

    # a speed by its shape
    now = memory.v[jnp.maximum(a.other, 0)]
    relative = jnp.where(a.factor, now * a.value, now + a.value)
    goal = jnp.where(a.continuous & (a.other >= 0), relative, target)
    length = jnp.maximum(span, 1e-6)

    def run(tau: Array) -> Array:
        """m after `tau` s."""
        rest = jnp.maximum(tau - span, 0)
        rise = jnp.where(span > 1e-6, length * summed(a.shape, tau / length), 0)
        return v0 * tau + (goal - v0) * (rise + rest)

    speed = v0 + (goal - v0) * jnp.where(over, 1.0, shaped(a.shape, (since + dt) / length))
    found = {Kind.SPEED: _Along(speed, run(since + dt) - run(since), over & ~(a.continuous & (a.other >= 0)))}

    # a profile of speeds
    times = jnp.concatenate([jnp.zeros_like(a.times[:, :1]), a.times], -1)
    speeds = jnp.concatenate([v0[:, None], a.speeds + target[:, None]], -1)
    steps = jnp.diff(times)
    areas = jnp.concatenate(
        [jnp.zeros_like(steps[:, :1]), jnp.cumsum(steps * (speeds[:, 1:] + speeds[:, :-1]) / 2, -1)], -1
    )

    def profile(tau: Array) -> tuple[Array, Array]:
        k = jnp.clip((times <= tau[:, None] + 1e-6).sum(-1) - 1, 0, times.shape[1] - 2)[:, None]
        (t0, t1), (u0, u1) = (
            (jnp.take_along_axis(z, k, 1)[:, 0], jnp.take_along_axis(z, k + 1, 1)[:, 0])
            for z in (times, speeds)
        )
        inside = jnp.clip(tau - t0, 0, t1 - t0)
        slope = jnp.where(t1 > t0, (u1 - u0) / jnp.maximum(t1 - t0, 1e-6), 0)
        rest = jnp.maximum(tau - t1, 0)
        v = jnp.where(tau >= t1 - 1e-6, u1, u0 + slope * inside)
        area = jnp.take_along_axis(areas, k, 1)[:, 0] + u0 * inside + slope * inside**2 / 2 + u1 * rest
        return v, area

    (after, area), (_, area0) = profile(since + dt), profile(since)
    found[Kind.PROFILE] = _Along(after, area - area0, over)
    found[Kind.GAP] = _gap(dt, board, memory, geometry, a)
    found[Kind.SYNCHRONIZE] = _synchronize(dt, board, memory, geometry, a)
    kinds = [rules & (a.kind == int(k)) for k in found]
    free = _Along(v, v * dt, jnp.zeros_like(rules))
    return _Along(*(jnp.select(kinds, [x[k] for x in found.values()], free[k]) for k in range(3)))


def _gap(dt: float, board: Board, memory: Memory, geometry: Geometry, a: ActionRows) -> _Along:
    """Keeps a distance along the road: at once, or within limits of speed and acceleration."""
    e = board.entities
    o = jnp.maximum(a.other, 0)
    me = jnp.arange(o.shape[0])
    s, s_other = memory.s, geometry.s[me, o]
    v_other = memory.v[o]
    ahead = jnp.where(a.side == 0, s >= s_other, a.side > 0)
    follower = jnp.where(ahead, v_other, memory.v)
    wanted = jnp.where(a.time_gap, a.value * jnp.abs(follower), a.value)
    bodies = (e.length + e.length[o]) / 2 + jnp.where(ahead, e.ahead[o] - e.ahead, e.ahead - e.ahead[o])
    wanted = wanted + jnp.where(a.freespace, bodies, 0)
    goal = s_other + jnp.where(ahead, wanted, -wanted)
    # where the other will be after the step
    at_once = a.shape == int(Shape.STEP)
    up, down, most = a.limits[:, 0], a.limits[:, 1], a.limits[:, 2]
    miss = goal + v_other * dt - (s + memory.v * dt)
    soft = jnp.minimum(jnp.where(jnp.isfinite(down), down, 10.0), jnp.where(jnp.isfinite(up), up, 10.0))
    # the speed from which the rest of the way suffices to reach that of the other
    rest = jnp.sign(miss) * jnp.minimum(jnp.sqrt(2 * 0.8 * soft * jnp.abs(miss)), 1.0 * jnp.abs(miss) / dt)
    wish = jnp.clip(v_other + rest, -most, most)
    v = memory.v + jnp.clip(wish - memory.v, -down * dt, up * dt)
    way = (memory.v + v) / 2 * dt
    v = jnp.where(at_once, v_other, v)
    way = jnp.where(at_once, goal + v_other * dt - s, way)
    there = (jnp.abs(miss) < _CLOSE) & (jnp.abs(v - v_other) < _CLOSE)
    return _Along(v, way, (at_once | there) & ~a.continuous)


def _synchronize(dt: float, board: Board, memory: Memory, geometry: Geometry, a: ActionRows) -> _Along:
    """Is at its place when the master is at its own.

    The rest of the way is a cubic in time, with the speed of now at its start and that asked for at its
    end; it is planned anew at every step.
    """
    count = memory.v.shape[0]
    me = jnp.arange(count)
    o = jnp.maximum(a.other, 0)
    place, place_o = count + jnp.maximum(a.place, 0), count + jnp.maximum(a.place_other, 0)
    far = jnp.hypot(*(geometry.pose[place, k] - memory.pose[:, k] for k in range(2)))
    far_o = jnp.hypot(*(geometry.pose[place_o, k] - memory.pose[o, k] for k in range(2)))
    # along the own way where the place lies on it
    near = jnp.abs(geometry.t[me, place] - memory.t) < 3.0
    near_o = jnp.abs(geometry.t[o, place_o] - memory.t[o]) < 3.0
    rest = jnp.where(near, geometry.s[me, place] - memory.s, far)
    rest_o = jnp.where(near_o, geometry.s[o, place_o] - memory.s[o], far_o)
    v_o = memory.v[o]
    until = jnp.maximum(rest_o, 0) / jnp.maximum(v_o, _SLOWEST)
    relative = jnp.where(a.factor, v_o * a.value, v_o + a.value)
    last = jnp.where(a.continuous, relative, a.value)
    steady = jnp.maximum(a.steady[:, 0], last * a.steady[:, 1])
    ahead, left = rest - steady, until - steady / jnp.maximum(last, _SLOWEST)
    ahead = jnp.where(steady > 0, ahead, rest)
    left = jnp.where(steady > 0, left, until)
    with_end = a.side > 0
    # position u^2 (3 - 2u) way + ...: the acceleration at the start of the cubic
    time = jnp.maximum(left, dt)
    cubic = (6 * ahead - 2 * time * (2 * memory.v + last)) / time**2
    change = 12 * (time * (memory.v + last) / 2 - ahead) / time**3
    v_cubic = memory.v + cubic * dt + change * dt**2 / 2
    way_cubic = memory.v * dt + cubic * dt**2 / 2 + change * dt**3 / 6
    mean = ahead / time
    v = jnp.where(with_end, v_cubic, mean)
    way = jnp.where(with_end, way_cubic, mean * dt)
    at_speed = with_end & ((left <= dt) | (ahead <= 0))
    v = jnp.where(at_speed, last, jnp.maximum(v, 0))
    final = jnp.where(left > 0, jnp.maximum(ahead, 0) + last * jnp.maximum(dt - left, 0), last * dt)
    way = jnp.where(at_speed, final, jnp.maximum(way, 0))
    over = (rest <= jnp.maximum(way, 1e-3)) | (rest_o <= jnp.maximum(v_o * dt, 1e-3))
    return _Along(v, way, over)


# --- across


def _across(
    dt: float,
    board: Board,
    memory: Memory,
    geometry: Geometry,
    time: Float[Array, ""],
    s: Array,
    along: _Along,
) -> tuple[Array, Array, Array]:
    """m to the left of the base line after the step.

    Also whether the action that rules is done, and whether it is one that has no lane as its target.
    """
    corridors, c = board.corridors, memory.corridor
    rules = memory.lateral >= 0
    row = jnp.maximum(memory.lateral, 0)
    a = _rows(board.actions, row)
    keeps = center_of(corridors, c, s, memory.column) + memory.off
    distance = a.dimension == 2
    so_far = jnp.where(
        distance, memory.went[row] + jnp.abs(along.way), jnp.maximum(time - memory.at[row], 0) + dt
    )
    span = memory.span[row]
    over = so_far >= span - SAME
    u = jnp.where(over, 1.0, shaped(a.shape, so_far / jnp.maximum(span, 1e-6)))
    came = center_of(corridors, c, s, memory.column_from[row]) + memory.off_from[row]
    shift = (a.kind == int(Kind.LANE)) | (a.kind == int(Kind.OFFSET))
    t = jnp.where(rules & shift, came + u * (keeps - came), keeps)
    done = over & shift & ~(a.continuous & (a.kind == int(Kind.OFFSET)))

    # a distance beside another entity
    e, o = board.entities, jnp.maximum(a.other, 0)
    me = jnp.arange(o.shape[0])
    t_other = geometry.t[me, o]
    left = jnp.where(a.side == 0, memory.t >= t_other, a.side > 0)
    wanted = a.value + jnp.where(a.freespace, (e.width + e.width[o]) / 2, 0)
    goal = t_other + jnp.where(left, wanted, -wanted)
    most = jnp.where(a.shape == int(Shape.STEP), jnp.inf, a.limits[:, 2]) * dt
    beside = memory.t + jnp.clip(goal - memory.t, -most, most)
    besides = rules & (a.kind == int(Kind.BESIDE))
    t = jnp.where(besides, beside, t)
    done |= besides & ~a.continuous & (jnp.abs(beside - goal) < 1e-3)
    return t, done, besides


def _arrived(board: Board, memory: Memory, geometry: Geometry) -> Array:
    """Rows of routes whose entity is at the end."""
    a = board.actions
    k = jnp.maximum(a.entity, 0)
    place = memory.v.shape[0] + jnp.maximum(a.place, 0)
    rest = jnp.take_along_axis(geometry.s[k], place[:, None], 1)[:, 0] - memory.s[k]
    return (a.place < 0) | (rest < _ARRIVED)


# --- trajectories


def _on_path(
    dt: float, board: Board, memory: Memory, time: Float[Array, ""], along: _Along
) -> tuple[Array, Array, Array, Array]:
    """Entities that follow a trajectory.

    Also their pose and speed after the step, and whether it has ended.
    """
    row = jnp.maximum(memory.lateral, 0)
    a = _rows(board.actions, row)
    follows = (memory.lateral >= 0) & (a.kind == int(Kind.TRAJECTORY))
    path = board.trajectories
    j = jnp.maximum(a.trajectory, 0)
    points, way, times, last = path.points[j], path.way[j], path.time[j], path.last[j]
    since = jnp.where(a.absolute, time, jnp.maximum(time - memory.at[row], 0)) + dt
    metres = memory.base[row] + memory.went[row] + jnp.abs(along.way)
    measure = jnp.where(a.timed[:, None], times, way)
    real = jnp.arange(points.shape[1])[None] <= last[:, None]
    measure = jnp.where(real, measure, jnp.inf)
    at = jnp.where(a.timed, since, metres)
    k = jnp.clip((measure <= at[:, None]).sum(-1) - 1, 0, last - 1)

    def pick(table: Array, index: Array) -> Array:
        return jnp.take_along_axis(table, index.reshape(-1, *[1] * (table.ndim - 1)), 1)[:, 0]

    low, high = pick(measure, k), pick(measure, k + 1)
    u = jnp.clip((at - low) / jnp.maximum(high - low, 1e-6), 0, 1)
    p, q = pick(points, k), pick(points, k + 1)
    place = p[:, :2] + u[:, None] * (q[:, :2] - p[:, :2])
    steps = pick(way, k + 1) - pick(way, k)
    h = p[:, 2] + jnp.where(steps < 1.0, u * angle(q[:, 2], p[:, 2]), 0)  # pieces of curves turn evenly
    anchor = memory.anchor[row]
    cos, sin = jnp.cos(anchor[:, 2]), jnp.sin(anchor[:, 2])
    local = path.local[j]
    x = jnp.where(local, anchor[:, 0] + cos * place[:, 0] - sin * place[:, 1], place[:, 0])
    y = jnp.where(local, anchor[:, 1] + sin * place[:, 0] + cos * place[:, 1], place[:, 1])
    h = h + jnp.where(local, anchor[:, 2], 0)
    speed = jnp.where((at >= low) & (high > low), steps / jnp.maximum(high - low, 1e-6), 0)
    v = jnp.where(a.timed, speed, along.v)
    end = pick(measure, last)
    done = at >= end - jnp.where(a.timed, SAME, 1e-3)
    return follows, jnp.stack([x, y, h], -1), v, done
