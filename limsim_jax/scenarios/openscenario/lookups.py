"""Look-ups along corridors, on the device; all of them broadcast over leading axes."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from limsim_jax.geometry import wrap_angle
from limsim_jax.numerics import safe_norm
from limsim_jax.scenarios.openscenario.arrays import Corridors
from limsim_jax.scenarios.openscenario.roads import SIDE, SPACING

F = TypeVar("F")

_STRIDE = 2  # points that the first look at a corridor passes over
_NEWTON = 6  # steps from there to the foot


def _once(function: F) -> F:
    """The function, traced once for equal shapes."""
    traced: Any = jax.jit(function)  # pyright: ignore[reportArgumentType, reportCallIssue]
    return traced


class On(NamedTuple):
    """Where something is on a corridor."""

    s: Array  # m
    t: Array  # m, left > 0
    h: Array  # rad, direction of the corridor there


class Lanes(NamedTuple):
    """Lanes of a corridor at one place, `[..., M]`."""

    center: Array  # m
    half: Array  # m; 0: no lane
    number: Array
    sign: Array  # [...]


def _cell(corridors: Corridors, c: Array, s: Array) -> tuple[Array, Array]:
    """Point before `s` m, and how far beyond it."""
    at = (s - corridors.start[c]) / SPACING
    k = jnp.clip(jnp.floor(at).astype(jnp.int32), 0, corridors.last[c] - 1)
    return k, at - k.astype(at.dtype)


@_once
def base(corridors: Corridors, c: Array, s: Array) -> tuple[Array, Array, Array]:
    """x, y (m) and direction (rad) of the base line; straight on beyond its ends."""
    k, u = _cell(corridors, c, s)
    p, q = corridors.line[c, k], corridors.line[c, k + 1]
    v = jnp.clip(u, 0, 1)
    rest = (u - v) * SPACING
    m0 = SPACING * jnp.stack([jnp.cos(p[..., 2]), jnp.sin(p[..., 2])], -1)
    m1 = SPACING * jnp.stack([jnp.cos(q[..., 2]), jnp.sin(q[..., 2])], -1)
    step = q[..., :2] - p[..., :2]
    w = v[..., None]
    # relative to the point before, so that far from the origin no digits are lost
    move = step * w**2 * (3 - 2 * w) + m0 * w * (1 - w) ** 2 - m1 * w**2 * (1 - w)
    slope = 6 * w * (1 - w) * step + m0 * (1 - w) * (1 - 3 * w) - m1 * w * (2 - 3 * w)
    h = jnp.arctan2(slope[..., 1], slope[..., 0])
    x = p[..., 0] + move[..., 0] + rest * jnp.cos(h)
    y = p[..., 1] + move[..., 1] + rest * jnp.sin(h)
    return x, y, h


def point(corridors: Corridors, c: Array, s: Array, t: Array) -> Float[Array, "*#b 3"]:
    """Pose at a place of a corridor, heading along it."""
    x, y, h = base(corridors, c, s)
    return jnp.stack([x - t * jnp.sin(h), y + t * jnp.cos(h), h], -1)


@_once
def bend(corridors: Corridors, c: Array, s: Array) -> Array:
    """Curvature of the base line, 1/m."""
    k, u = _cell(corridors, c, s)
    turn = corridors.line[c, k + 1, 2] - corridors.line[c, k, 2]
    return jnp.where((u >= 0) & (u <= 1), turn / SPACING, 0)


@_once
def lanes(corridors: Corridors, c: Array, s: Array) -> Lanes:
    """The lanes across a corridor."""
    k, u = _cell(corridors, c, s)
    v = jnp.clip(u, 0, 1)[..., None]
    center = corridors.center[c, k] + v * (corridors.center[c, k + 1] - corridors.center[c, k])
    half = corridors.half[c, k]
    return Lanes(center, half, corridors.number[c, k], corridors.sign[c, k])


@_once
def center_of(corridors: Corridors, c: Array, s: Array, column: Int[Array, "*#b"]) -> Array:
    """Middle of a lane, m to the left of the base line."""
    found = lanes(corridors, c, s)
    return jnp.take_along_axis(found.center, jnp.clip(column, 0, 2 * SIDE)[..., None], -1)[..., 0]


@_once
def column_at(corridors: Corridors, c: Array, s: Array, t: Array) -> Array:
    """The lane at a place, or the nearest beside all."""
    found = lanes(corridors, c, s)
    away = jnp.where(found.half > 0, jnp.abs(found.center - t[..., None]), jnp.inf)
    none = ~(found.half > 0).any(-1)
    return jnp.where(none, SIDE, jnp.argmin(away, -1)).astype(jnp.int32)


def on_road(corridors: Corridors, c: Array, s: Array, t: Array) -> Array:
    """Whether a place is on any lane of the road."""
    found = lanes(corridors, c, s)
    on = (jnp.abs(found.center - t[..., None]) <= found.half + 1e-3) & (found.half > 0)
    return on.any(-1) & ~at_end(corridors, c, s)


def at_end(corridors: Corridors, c: Array, s: Array) -> Array:
    """Whether the road ends there."""
    end = corridors.start[c] + SPACING * corridors.last[c].astype(s.dtype)
    return (s >= end - 1e-3) & ~corridors.free[c]


@_once
def project(corridors: Corridors, c: Array, x: Array, y: Array) -> On:
    """The place of points on corridors: a look at all points, then Newton's method.

    `c`, `x`, `y` have the same shape.
    """
    line = lax.stop_gradient(corridors.line)[:, ::_STRIDE]
    count = line.shape[1]
    real = jnp.arange(count)[None] * _STRIDE <= corridors.last[:, None]
    mine = line[c]  # [..., P, 3]
    away = (mine[..., 0] - x[..., None]) ** 2 + (mine[..., 1] - y[..., None]) ** 2
    away = jnp.where(real[c], away, jnp.inf)
    k = jnp.argmin(away, -1)
    s = corridors.start[c] + SPACING * _STRIDE * k.astype(x.dtype)

    def nearer(_: int, s: Array) -> Array:
        bx, by, h = base(corridors, c, s)
        ahead = (x - bx) * jnp.cos(h) + (y - by) * jnp.sin(h)
        beside = (y - by) * jnp.cos(h) - (x - bx) * jnp.sin(h)
        narrow = jnp.clip(1 - bend(corridors, c, s) * beside, 0.3, 3.0)
        return s + jnp.clip(ahead / narrow, -2 * SPACING * _STRIDE, 2 * SPACING * _STRIDE)

    s = lax.fori_loop(0, _NEWTON, nearer, s)
    bx, by, h = base(corridors, c, s)
    return On(s, (y - by) * jnp.cos(h) - (x - bx) * jnp.sin(h), h)


# --- boxes


def corners(pose: Array, ahead: Array, length: Array, width: Array) -> Float[Array, "*#b 4 2"]:
    """Corners of bodies by the pose of their reference points."""
    x, y, h = pose[..., 0], pose[..., 1], pose[..., 2]
    c, s = jnp.cos(h), jnp.sin(h)
    found = []
    for i, j in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
        u, v = ahead + i * length / 2, j * width / 2
        found.append(jnp.stack([x + u * c - v * s, y + u * s + v * c], -1))
    return jnp.stack(found, -2)


@_once
def between(
    pose: Array, ahead: Array, length: Array, width: Array,
    pose2: Array, ahead2: Array, length2: Array, width2: Array,
) -> Array:  # fmt: skip
    """Distance (m) between two bodies; 0 where they overlap."""
    a, b = corners(pose, ahead, length, width), corners(pose2, ahead2, length2, width2)
    near = jnp.minimum(
        _to_box(b, pose, ahead, length, width).min(-1), _to_box(a, pose2, ahead2, length2, width2).min(-1)
    )
    # bodies may cross without a corner of one in the other
    apart = jnp.zeros(near.shape, bool)
    for one, other, h in ((a, b, pose[..., 2]), (b, a, pose2[..., 2])):
        for axis in (jnp.stack([jnp.cos(h), jnp.sin(h)], -1), jnp.stack([-jnp.sin(h), jnp.cos(h)], -1)):
            u, v = ((z * axis[..., None, :]).sum(-1) for z in (one, other))
            apart |= (u.max(-1) < v.min(-1)) | (v.max(-1) < u.min(-1))
    return jnp.where(apart, near, 0)


def _to_box(points: Array, pose: Array, ahead: Array, length: Array, width: Array) -> Array:
    """Distance from points `[..., 4, 2]` to a body."""
    c, s = jnp.cos(pose[..., 2])[..., None], jnp.sin(pose[..., 2])[..., None]
    dx, dy = points[..., 0] - pose[..., 0, None], points[..., 1] - pose[..., 1, None]
    u = jnp.maximum(jnp.abs(c * dx + s * dy - ahead[..., None]) - length[..., None] / 2, 0)
    v = jnp.maximum(jnp.abs(c * dy - s * dx) - width[..., None] / 2, 0)
    return safe_norm(jnp.stack([u, v], -1))


def angle(a: Any, b: Any) -> Array:
    """Angle from `b` to `a`, within -pi and pi."""
    return wrap_angle(a - b)
