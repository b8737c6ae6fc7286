"""From what the network says to what the vehicle does: pure pursuit, a speed profile and the safety filter.

All in the frame of each ego: x ahead of the middle of its body, y to the left.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from limsim_jax.geometry import boxes_overlap, wrap_angle
from limsim_jax.policies.end_to_end.network import (
    CELL,
    DENSITY,
    DENSITY_GRID,
    LENGTH,
    SPEED,
    TARGET_TIME,
    WIDTH,
)
from limsim_jax.policies.reference import ReferencePath
from limsim_jax.traffic.ego import Limits
from limsim_jax.xla import mapped_like

DT, SAMPLES = 0.1, 21
"""s between samples of a trajectory, and their number: 2 s."""

LOOK_TIME, LEAST_LOOK = 0.8, 3.0
"""Look-ahead of pure pursuit: s at the present speed, and m at least (reference specification)."""

ACCELERATING, BRAKING = 2.5, 6.0
"""Most that the speed profile asks for, m/s^2 (reference specification: 2 and 6)."""

_LAY = 64  # places along a path between which it is straight


class Way(NamedTuple):
    """A path of each ego: points evenly spaced along the route."""

    x: Float[Array, "E M"]  # m
    y: Float[Array, "E M"]
    heading: Float[Array, "E M"]  # rad
    step: Float[Array, " E"]  # m


class Motion(NamedTuple):
    """Driven motion of each ego, of the middle of its body."""

    x: Float[Array, "E T"]  # m
    y: Float[Array, "E T"]
    heading: Float[Array, "E T"]  # rad
    v: Float[Array, "E T"]  # m/s


def way_along(
    path: ReferencePath,
    pose: tuple[Array, Array, Array],
    places: Float[Array, "E K"],
    offsets: Float[Array, "E K"],
    offset: Float[Array, " E"],
) -> Way:
    """The path through predicted points, in the frames of the egos.

    Args:
      path: the routes.
      pose: x, y (m) and heading (rad) of each ego.
      places: m along the route of the points, evenly spaced, the first one a step ahead.
      offsets: m left of the route there.
      offset: m left of the route now.
    """
    share = jnp.linspace(0.0, 1.0, _LAY, dtype=jnp.float32)
    s = places[:, -1:] * share[None]
    knots = jnp.concatenate([jnp.zeros_like(places[:, :1]), places], -1)
    values = jnp.concatenate([offset[:, None], offsets], -1)
    d = jax.vmap(jnp.interp)(s, knots, values)
    place = path.at(s, d)
    x0, y0, heading = (value[:, None] for value in pose)
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    dx, dy = place.x - x0, place.y - y0
    x, y = cos * dx + sin * dy, cos * dy - sin * dx
    return way_through(x, y, places[:, -1] / (_LAY - 1))


def way_through(x: Float[Array, "E M"], y: Float[Array, "E M"], step: Float[Array, " E"]) -> Way:
    """A path through points that are `step` m apart."""
    turn = jnp.arctan2(jnp.diff(y), jnp.diff(x))
    return Way(x, y, jnp.concatenate([turn, turn[:, -1:]], -1), step)


def pursue(
    way: Way,
    v: Float[Array, " E"],
    target: Float[Array, " E"],
    wheelbase: Float[Array, " E"],
    braking: Float[Array, " E"] | float = BRAKING,
) -> Motion:
    """The motion of a bicycle that pursues a path and a speed.

    Steering is pure pursuit (Coulter 1992, CMU-RI-TR-92-01): the rear axle takes the arc through the point of
    the path that is `LOOK_TIME` ahead. The speed changes evenly, to reach the target in `TARGET_TIME` within
    `ACCELERATING` and `braking`.

    Args:
      way: the path.
      v: m/s, now.
      target: m/s.
      wheelbase: m.
      braking: m/s^2, at most.
    """
    rate = jnp.clip((target - v) / TARGET_TIME, -braking, ACCELERATING)
    t = DT * jnp.arange(SAMPLES, dtype=jnp.float32)[None]
    speed = v[:, None] + rate[:, None] * t
    low, high = jnp.minimum(v, target)[:, None], jnp.maximum(v, target)[:, None]
    speed = jnp.clip(speed, low, high)
    most = jnp.tan(jnp.float32(Limits().steering)) / wheelbase
    last = way.x.shape[-1] - 1

    def step(carry: tuple[Array, ...], now: tuple[Array, Array]) -> tuple[tuple[Array, ...], Any]:
        x, y, heading, done = carry  # of the rear axle; m along the path of the middle of the body
        here, then = now
        look = jnp.maximum(LOOK_TIME * here, LEAST_LOOK)
        at = jnp.clip((done + look) / way.step, 0, last)
        k = jnp.clip(jnp.floor(at).astype(jnp.int32), 0, last - 1)
        u = at - k.astype(at.dtype)
        point = [
            jnp.take_along_axis(values, k[:, None], -1)[:, 0] * (1 - u)
            + jnp.take_along_axis(values, k[:, None] + 1, -1)[:, 0] * u
            for values in (way.x, way.y)
        ]
        bend = jnp.clip(arc_through(x, y, heading, point[0], point[1]), -most, most)
        distance = (here + then) / 2 * DT
        turn = bend * distance
        course = heading + turn / 2
        new = x + distance * jnp.cos(course), y + distance * jnp.sin(course), heading + turn, done + distance
        return new, new[:3]

    zero = jnp.zeros_like(v)
    start = mapped_like(v, (-wheelbase / 2, zero, zero, zero))
    _, rest = lax.scan(step, start, (speed[:, :-1].T, speed[:, 1:].T))
    x, y, heading = (
        jnp.concatenate([begin[:, None], after.T], -1) for begin, after in zip(start[:3], rest, strict=True)
    )
    axle = wheelbase[:, None] / 2
    return Motion(x + axle * jnp.cos(heading), y + axle * jnp.sin(heading), heading, speed)


def arc_through(x: Array, y: Array, heading: Array, to_x: Array, to_y: Array) -> Array:
    """Curvature (1/m) of the arc from a pose through a point."""
    dx, dy = to_x - x, to_y - y
    across = jnp.cos(heading) * dy - jnp.sin(heading) * dx
    return 2 * across / jnp.maximum(dx * dx + dy * dy, 1.0)


# --- the safety filter -------------------------------------------------------------------------------

SEEN = 0.5
"""Probability from which a cell of the density map is an object."""

OBJECTS = 12
"""Objects that the filter looks at, the surest ones."""

MOMENTS = (0.0, 0.5, 1.0, 1.5, 2.0)
"""s at which objects are extrapolated (InterFuser: 0, 0.5, 0.75, 1, 1.5, 2)."""

MARGIN = 2.0
"""m that are left to an object (InterFuser)."""

WIDER = 0.6
"""m by which the body of the ego is widened (InterFuser: from 2.0 to 2.45 and buffers). Chosen."""

TOO_NEAR = 2.0
"""m on the path to an object that is there now, below which the ego brakes. Chosen: a standstill gap."""

ALONG = 0.2
"""rad to the path, within which an object moves along it: at 30 m/s an error of 0.1 rad in the density map
would move it aside by 6 m in 2 s. Chosen: above the errors of the map, below most turns."""

UNBLOCK = 12.0
"""s that the filter alone may hold a standing ego (InterFuser: 60 s). Chosen: shorter than a red phase."""

PASS = 3.0
"""s for which it then lets the ego go. Chosen: enough to get past what is not there."""

RED, AT_JUNCTION = 0.7, 0.5
"""Probabilities of a red light and of a junction from which the ego stops, and stays (InterFuser: 0.3 for
both). Chosen: with 0.3 it waits for lights that have turned green in 6 % of the worlds."""

_PLACES = 32  # poses along the path that are tried


class Objects(NamedTuple):
    """What the density map holds, in the frames of the egos."""

    x: Float[Array, "E K"]  # m
    y: Float[Array, "E K"]
    heading: Float[Array, "E K"]  # rad
    length: Float[Array, "E K"]  # m
    width: Float[Array, "E K"]
    v: Float[Array, "E K"]  # m/s
    there: Bool[Array, "E K"]


def objects_of(density: Float[Array, "E R S 8"]) -> Objects:
    """The surest objects of a density map."""
    egos, rows, columns, _ = density.shape
    flat = density.reshape(egos, -1, len(DENSITY))
    x, y = (jnp.asarray(np.broadcast_to(m, (rows, columns)).ravel()) for m in DENSITY_GRID.middles())
    sure, which = lax.top_k(flat[..., 0], OBJECTS)
    found = jnp.take_along_axis(flat, which[..., None], 1)
    value = {name: found[..., k] for k, name in enumerate(DENSITY)}
    return Objects(
        x=x[which] + value["x"] * CELL,
        y=y[which] + value["y"] * CELL,
        heading=jnp.arctan2(value["sine"], value["cosine"] + 1e-6),
        length=jnp.clip(value["length"] * LENGTH, 1.0, 20.0),
        width=jnp.clip(value["width"] * WIDTH, 0.5, 3.0),
        v=jnp.clip(value["speed"] * SPEED, 0.0, 50.0),
        there=sure > math.log(SEEN / (1 - SEEN)),
    )


def free_distances(
    way: Way, objects: Objects, length: Float[Array, " E"], width: Float[Array, " E"]
) -> Float[Array, "E 5"]:
    """Distances (m) on the path to an object, at `MOMENTS`.

    An object that comes to overlap the ego where it stands does not count from then on: standing still does
    not avoid it. It is a follower, or an error of the density map.
    """
    share = np.linspace(0, way.x.shape[-1] - 1, _PLACES + 1).round().astype(int)[1:]
    place = way.step[:, None] * jnp.asarray(share, jnp.float32)[None]  # m, [E P]
    time = jnp.asarray(MOMENTS, jnp.float32)

    def one(
        x: Array, y: Array, heading: Array, place: Array, o: Objects, length: Array, width: Array
    ) -> Array:
        zero, one = jnp.zeros_like(length), jnp.ones_like(x)
        near = jnp.argmin(jnp.square(o.x[:, None] - x[None]) + jnp.square(o.y[:, None] - y[None]), -1)
        turned = wrap_angle(o.heading - heading[near])
        course = jnp.where(jnp.abs(turned) < ALONG, heading[near], o.heading)
        at = jnp.stack([x, y, heading, length * one, (width + WIDER) * one], -1)  # [P 5]
        body = jnp.stack([zero, zero, zero, length, width])
        ox = o.x[None] + time[:, None] * (o.v * jnp.cos(course))[None]  # [M K]
        oy = o.y[None] + time[:, None] * (o.v * jnp.sin(course))[None]
        rest = (jnp.broadcast_to(z[None], ox.shape) for z in (course, o.length, o.width))
        box = jnp.stack([ox, oy, *rest], -1)  # [M K 5]
        hit = jax.vmap(lambda a: jax.vmap(jax.vmap(lambda b: boxes_overlap(a, b)))(box))(at)  # [P M K]
        inside = jax.vmap(jax.vmap(lambda b: boxes_overlap(body, b)))(box)  # [M K]
        hit &= o.there[None, None] & ~lax.cummax(inside.astype(jnp.int32)).astype(bool)[None]
        return jnp.min(jnp.where(hit.any(-1), place[:, None], 1e3), 0)

    return jax.vmap(one)(
        way.x[:, share], way.y[:, share], way.heading[:, share], place, objects, length, width
    )


def safe_speed(v: Float[Array, " E"], free: Float[Array, "E 5"]) -> Float[Array, " E"]:
    """The largest speed (m/s) that keeps off all objects.

    A vehicle that changes its speed evenly from `v` to `w` within `t` drives (v + w) t / 2. That has to end
    `MARGIN` before the object at each moment (after InterFuser's safety controller, solved for w). An object
    nearer than `TOO_NEAR` now asks for 0.
    """
    time = jnp.asarray(MOMENTS[1:], jnp.float32)[None]
    most = jnp.min(2 * (free[:, 1:] - MARGIN) / time - v[:, None], -1)
    return jnp.where(free[:, 0] < TOO_NEAR, 0.0, jnp.maximum(most, 0.0))


def filtered(
    v: Float[Array, " E"],
    target: Float[Array, " E"],
    free: Float[Array, "E 5"],
    rules: Float[Array, "E 3"],
    held: Float[Array, " E"],
    dt: float,
) -> tuple[Float[Array, " E"], Float[Array, " E"]]:
    """The target speed after the filter, and how long that has held.

    Only time counts in which the network alone would have gone.

    Args:
      v: m/s, now.
      target: m/s, of the network.
      free: see `free_distances`.
      rules: logits of `network.RULES`.
      held: s so far.
      dt: s until the next decision.
    """
    chance = jax.nn.sigmoid(rules)
    red = (chance[:, 1] > RED) & (chance[:, 0] > AT_JUNCTION)
    safe = jnp.where(red, 0.0, jnp.minimum(target, safe_speed(v, free)))
    holds = (v < 0.5) & (target > 0.5) & (safe < 0.5) & ~red & (held < UNBLOCK)
    passes = (held >= UNBLOCK) & (held < UNBLOCK + PASS) & ~red
    return jnp.where(passes, target, safe), jnp.where(passes | holds, held + dt, 0.0)
