"""Scores of the proposals: nuPlan's closed-loop metrics against a forecast."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Shaped
from numpy.typing import NDArray

from limsim_jax.geometry import wrap_angle
from limsim_jax.numerics import safe_norm
from limsim_jax.policies.pdm.proposals import FRACTIONS, Proposals
from limsim_jax.policies.pdm.road import DT, FAR, LOOK_EVERY, SPACING, Body, Others, Road
from limsim_jax.policies.pdm.tracker import Motion
from limsim_jax.policies.reference import Place, to_cartesian
from limsim_jax.standards import COMFORT
from limsim_jax.traffic.collision import OVERHANG
from limsim_jax.xla import computed_once, mapped_like

TTC = (0.0, 0.3, 0.6, 0.9)
"""s by which all vehicles are moved on to look for contacts."""

_OVERSHOOT = 0.2  # m of the tolerance that a proposal keeps, because the next one may go farther
_STANDS = 0.05  # m/s, standstill (nuPlan)


class Scores(NamedTuple):
    """Scores of all proposals; multipliers and metrics from 0 to 1."""

    total: Float[Array, "V P"]
    no_fault: Float[Array, "V P"]  # no at-fault contact
    drivable: Float[Array, "V P"]
    direction: Float[Array, "V P"]
    progress: Float[Array, "V P"]
    ttc: Float[Array, "V P"]
    comfort: Float[Array, "V P"]
    contact: Float[Array, "V P"]  # s to the first at-fault contact, 1e6 if there is none


class _Places(NamedTuple):
    """Positions of the bodies on the centerline, every `LOOK_EVERY` steps: `T2` moments."""

    s: Float[Array, "V P T2"]  # m, centre
    off: Bool[Array, "V P T2"]  # a corner is off the road
    wrong: Bool[Array, "V P T2"]  # the centre is in oncoming traffic
    several: Bool[Array, "V P T2"]  # over a lane line or off the road
    junction: Bool[Array, "V P T2"]


@jax.named_scope("pdm_places")
def _places(road: Road, body: Body, proposals: Proposals, motion: Motion, strict: bool) -> _Places:
    thin = lambda values: values[..., ::LOOK_EVERY]  # noqa: E731
    axle = body.wheelbase[:, None, None] / 2
    heading = thin(motion.heading)
    x = thin(motion.x) + axle * jnp.cos(heading)
    y = thin(motion.y) + axle * jnp.sin(heading)
    s = thin(proposals.s[..., : motion.x.shape[-1]]) + axle

    def project(s: Array) -> tuple[Place, Array, Array]:
        """Centerline at `s`, offset of the centre, and a better `s`."""
        place = computed_once(to_cartesian(road.centerline, s, jnp.zeros_like(s)))
        cos, sin = jnp.cos(place.heading), jnp.sin(place.heading)
        dx, dy = x - place.x, y - place.y
        d = cos * dy - sin * dx
        return place, d, s + (cos * dx + sin * dy) / jnp.maximum(1 - place.curvature * d, 0.3)

    place, d, s = project(project(s)[2])
    along = wrap_angle(heading - place.heading)
    c, n = jnp.cos(along), jnp.sin(along)
    half_l, half_w = body.length[:, None, None] / 2, body.width[:, None, None] / 2
    # offsets of the corners from a centerline of constant curvature
    corners = []
    for ahead, left in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        u = ahead * half_l * c - left * half_w * n
        w = d + ahead * half_l * n + left * half_w * c
        root = jnp.sqrt((1 - place.curvature * w) ** 2 + (place.curvature * u) ** 2)
        corners.append((2 * w - place.curvature * (w * w + u * u)) / (1 + root))
    most = functools.reduce(jnp.maximum, corners)
    least = functools.reduce(jnp.minimum, corners)

    k = jnp.clip((s / SPACING + 0.5).astype(jnp.int32), 0, road.half.shape[1] - 1)
    at = lambda table: jnp.take_along_axis(  # noqa: E731
        table, k.reshape(k.shape[0], -1), -1
    ).reshape(k.shape)
    left, right, half = at(road.centerline.left), at(road.centerline.right), at(road.half)
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
    """First contact with each other vehicle, now or at constant velocity."""

    contact: Float[Array, "V P K"]  # moment (of `T2`), or `FAR`
    overlap: Float[Array, "V P K"]  # moment times the number of `TTC` plus which of them, or `FAR`


@jax.named_scope("pdm_contacts")
def _meetings(body: Body, motion: Motion, others: Others) -> _Meetings:
    """Separating-axis tests of all proposals and others at all moments."""
    thin = lambda values: jnp.moveaxis(values[..., ::LOOK_EVERY], -1, 0)  # noqa: E731
    x, y, heading, v = (thin(values) for values in (motion.x, motion.y, motion.heading, motion.v))
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    axle = body.wheelbase[None, :, None] / 2
    moments = x.shape[0]
    index = LOOK_EVERY * np.arange(moments)[:, None] + np.round(np.array(TTC) / DT).astype(int)[None]
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
                contact = jnp.where(meet & (contact >= FAR), k, contact)
            counts = meet & (v >= 0.005) & (contact >= FAR)
            overlap = jnp.where(counts & (overlap >= FAR), k * len(TTC) + n, overlap)
        return (contact, overlap), None

    none = jnp.full((*x.shape[1:], others.x.shape[-1]), FAR, x.dtype)
    centre_x, centre_y = x + axle * cos, y + axle * sin
    start = mapped_like(body.v, (none, none))
    (contact, overlap), _ = lax.scan(look, start, (number, centre_x, centre_y, cos, sin, v, *theirs))
    return _Meetings(contact, overlap)


@jax.named_scope("pdm_score")
def score(
    road: Road, body: Body, others: Others, proposals: Proposals, motion: Motion, strict: bool = False
) -> Scores:
    """nuPlan's closed-loop metrics, as PDM scores proposals.

    The product of three multipliers and (5 progress + 5 TTC + 2 comfort) / 12.
    """
    places = computed_once(_places(road, body, proposals, motion, strict))
    meetings = computed_once(_meetings(body, motion, others))
    # before a lane change all others count, followers among them
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


def _at(values: Shaped[Array, "V P T2"], moment: Int[Array, "V P K"]) -> Array:
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
    """At-fault contacts, and s to the first of them.

    By nuPlan's classes of collisions. Vehicles that overlap at the start do not count.
    """
    meets = (meetings.contact < FAR) & (meetings.contact > 0)
    k = jnp.where(meets, meetings.contact, 0).astype(jnp.int32)
    thin = lambda values: values[..., ::LOOK_EVERY]  # noqa: E731
    x, y, heading, v = (_at(thin(values), k) for values in motion[:4])
    ox, oy, oc, os = (_theirs(values, k * LOOK_EVERY) for values in others[:4])
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
    time = jnp.min(jnp.where(fault, meetings.contact * (LOOK_EVERY * DT), FAR), -1)
    return fault.any(-1), time


def _behind(ahead: Array, left: Array) -> Array:
    """Whether the other is within 30 degrees of straight behind."""
    return (ahead < 0) & (3 * left * left < ahead * ahead)


def _ttc(
    motion: Motion,
    others: Others,
    places: _Places,
    meetings: _Meetings,
    careful: Bool[Array, "V P 1"],
) -> Float[Array, "V P"]:
    """1, or 0 where the time to collision is below 0.9 s."""
    meets = (meetings.overlap < FAR) & (meetings.contact != 0)
    code = jnp.where(meets, meetings.overlap, 0).astype(jnp.int32)
    k, n = code // len(TTC), code % len(TTC)
    thin = lambda values: values[..., ::LOOK_EVERY]  # noqa: E731
    x, y, heading, v = (_at(thin(values), k) for values in motion[:4])
    moment = k * LOOK_EVERY + n * round((TTC[1] - TTC[0]) / DT)
    dx, dy = _theirs(others.x, moment) - x, _theirs(others.y, moment) - y
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    moved = v * jnp.asarray(TTC, v.dtype)[n]
    forth, left = cos * dx + sin * dy - moved, cos * dy - sin * dx
    ahead = _behind(-forth, left)
    crossing = _at(places.several | places.junction, k) & ~_behind(forth, left)
    return jnp.where((meets & (ahead | crossing | careful)).any(-1), 0.0, 1.0)


def _direction(motion: Motion, places: _Places) -> Float[Array, "V P"]:
    """1; 0.5 from 2 m and 0 from 6 m of oncoming lane driven within a second."""
    window = round(1 / (LOOK_EVERY * DT))
    driven = jnp.where(places.wrong, motion.v[..., ::LOOK_EVERY] * (LOOK_EVERY * DT), 0)
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
    """1 if all bounds of `COMFORT` are kept, otherwise 0."""
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
