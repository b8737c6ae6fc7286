"""The fifteen proposals: three paths times five IDM drivers, as poses in the plane."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from limsim_jax.policies.pdm.road import DT, FAR, LOOK_EVERY, OFFSETS, SPACING, Body, Others, Road
from limsim_jax.policies.reference import to_cartesian
from limsim_jax.xla import computed_once, mapped_like

FRACTIONS = (0.2, 0.4, 0.6, 0.8, 1.0)
"""Desired speeds of the five drivers, as shares of the speed limit."""

S0, HEADWAY, ACCELERATION, DECELERATION, HARDEST = 1.0, 1.5, 1.5, 3.0, 3.0
"""IDM: standstill gap (m), time gap (s), acceleration, comfortable deceleration, braking limit (m/s^2)."""

LATE_STOP, HARDEST_BEHIND = 1.0, 6.0
"""Unless strict: m that the tracker needs beyond the standstill gap; braking limit behind others (m/s^2)."""

_LEAST_GAP = 0.1  # m, least gap in the IDM: below the standstill gap it brakes hard
_MERGE_TIME, _MERGE_LEAST = 3.0, 12.0  # s, and at least m, in which a path reaches an offset 2 m away
_KEEP_SHARE = 0.66  # least share of that distance, for nearer offsets
_COARSE = 4  # points of the centerline per start point of a projection


class Leaders(NamedTuple):
    """Others along the centerline, at `H` moments."""

    rear: Float[Array, "H V 3 K"]  # m, of vehicles on the corridor of a path; otherwise far away
    centre: Float[Array, "H V K"]  # m
    v: Float[Array, "H V K"]  # m/s along the centerline


@jax.named_scope("pdm_leaders")
def leaders(road: Road, body: Body, others: Others, steps: int) -> Leaders:
    """Vehicles on the corridor of each path, as wide as the body."""
    centerline = road.centerline
    others = others._replace(**{n: getattr(others, n)[:steps:LOOK_EVERY] for n in ("x", "y", "cos", "sin")})
    looks = others.x.shape[0]
    x, y = (jnp.moveaxis(v, 0, 1).reshape(v.shape[1], -1) for v in (others.x, others.y))  # [V, H K]
    coarse_x, coarse_y = centerline.x[:, ::_COARSE], centerline.y[:, ::_COARSE]
    apart = (x[:, None] - coarse_x[..., None]) ** 2 + (y[:, None] - coarse_y[..., None]) ** 2  # [V M' HK]
    least = jnp.min(apart, 1)
    number = jnp.arange(coarse_x.shape[1], dtype=x.dtype)[None, :, None]
    s = jnp.min(jnp.where(apart <= least[:, None], number, FAR), 1) * (SPACING * _COARSE)
    s = computed_once(s)
    for _ in range(2):
        place = to_cartesian(centerline, s, jnp.zeros_like(s))
        cos, sin = jnp.cos(place.heading), jnp.sin(place.heading)
        dx, dy = x - place.x, y - place.y
        across = cos * dy - sin * dx
        step = (cos * dx + sin * dy) / jnp.maximum(1 - place.curvature * across, 0.3)
        s = computed_once(s + jnp.clip(step, -2 * SPACING * _COARSE, 2 * SPACING * _COARSE))
    place = to_cartesian(centerline, s, jnp.zeros_like(s))
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
    on &= (others.there[None] & (s < road.centerline.reach) & (s > 0))[:, :, None]
    return Leaders(rear=jnp.where(on, (s - reach)[:, :, None], FAR), centre=s, v=others.v[None] * along)


class Proposals(NamedTuple):
    """Motion of the IDM drivers on each path: `P` = 15, path by path, `T` moments."""

    s: Float[Array, "V P T"]  # m along the centerline, rear axle
    v: Float[Array, "V P T"]  # m/s


@jax.named_scope("pdm_idm")
def idm(road: Road, body: Body, along: Leaders, strict: bool) -> Proposals:
    """Integrate the fifteen drivers.

    Each looks for its leader every second step.
    """
    limit = road.centerline.limit
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
        # lights and limits are known in advance, the braking of a leader is not
        behind = jnp.maximum(ACCELERATION * (1 - z * z), -HARDEST_BEHIND)
        return jnp.where(at < wall, jnp.minimum(a, behind), a)

    def look(carry: tuple[Array, ...], seen: Leaders) -> tuple[tuple[Array, ...], tuple[Array, Array]]:
        s, v, first = carry
        # the leader has the nearest rear among vehicles ahead of the own centre
        ahead = seen.centre[:, None, None] > (s + centre)[..., None]
        rear = jnp.where(ahead, seen.rear[:, :, None], FAR)  # [V 3 5 K]
        nearest_rear = jnp.min(rear, -1)
        v_rear = jnp.max(jnp.where(rear <= nearest_rear[..., None], seen.v[:, None, None], -FAR), -1)
        at = jnp.minimum(nearest_rear, wall)
        v_lead = jnp.where(nearest_rear < wall, v_rear, 0)
        if strict:
            here = jnp.maximum(limit[:, :1, None], 0.1)
        else:
            k = jnp.clip(((s + front) / SPACING).astype(jnp.int32), 0, last)
            here = jnp.take_along_axis(limit, k.reshape(k.shape[0], -1), -1).reshape(k.shape)
        v0 = fraction * here
        states = []
        for sub in range(LOOK_EVERY):
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


class Poses(NamedTuple):
    """Proposals in the plane: poses of the rear axle, to be tracked."""

    x: Float[Array, "V P T"]  # m
    y: Float[Array, "V P T"]
    heading: Float[Array, "V P T"]  # rad, without jumps
    v: Float[Array, "V P T"]  # m/s
    curvature: Float[Array, "V P T"]  # 1/m


@jax.named_scope("pdm_poses")
def poses(road: Road, body: Body, proposals: Proposals, strict: bool) -> Poses:
    """Poses of the proposals on their paths."""
    offset = jnp.repeat(road.offset, len(FRACTIONS), 1)[..., None]  # [V P 1]
    s, v = proposals
    if strict:
        d = jnp.broadcast_to(offset, s.shape)
        slope = bend = jnp.zeros_like(s)
    else:
        # a cubic from the present position and heading; a lane change is longer than a correction
        shift = road.d[:, None, None] - offset
        share = jnp.clip(jnp.abs(shift) / 2, _KEEP_SHARE, 1)
        reach = share * jnp.maximum(_MERGE_TIME * body.v, _MERGE_LEAST)[:, None, None]
        u = jnp.clip((s - road.s[:, None, None]) / reach, 0, 1)
        slope0 = road.slope[:, None, None] * reach
        d = offset + shift * (1 - u * u * (3 - 2 * u)) + slope0 * u * (1 - u) ** 2
        slope = (shift * 6 * u * (u - 1) + slope0 * (1 - u) * (1 - 3 * u)) / reach
        bend = (shift * (12 * u - 6) + slope0 * (6 * u - 4)) / (reach * reach)
        bend = jnp.where(u < 1, bend, 0)
    place = to_cartesian(road.centerline, s, d)
    stretch = jnp.maximum(1 - place.curvature * d, 0.2)
    return Poses(
        x=place.x,
        y=place.y,
        heading=place.heading + jnp.arctan(slope / stretch),
        v=v * stretch,
        curvature=place.curvature / stretch + bend,
    )
