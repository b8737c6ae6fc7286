"""nuPlan's tracker (two LQRs) and a kinematic bicycle: how a proposal would be driven."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from limsim_jax.geometry import wrap_angle
from limsim_jax.policies.pdm.proposals import Poses
from limsim_jax.policies.pdm.road import DT, Body
from limsim_jax.traffic.ego import Limits
from limsim_jax.xla import mapped_like

STOPPING_SPEED = 0.2
"""m/s, below which nuPlan's tracker brings the vehicle to a stop."""

_LOOK = 10  # steps that the tracker looks ahead
_Q_LONGITUDINAL, _R_LONGITUDINAL = 10.0, 1.0
_Q_LATERAL, _R_LATERAL = (1.0, 10.0, 0.0), 1.0
_STOPPING_GAIN = 0.5  # 1/s
_LAG_ACCELERATION, _LAG_STEERING = 0.2, 0.05  # s
_MOST_STEERING = np.pi / 3  # rad
_CAR = Limits()


def fitted(reference: Poses) -> Poses:
    """Speed and curvature fitted to the poses, as nuPlan's tracker does.

    Regularised least squares: jerk 1e-4, curvature rate 1e-2, initial curvature 1e-10.
    """
    dx, dy = jnp.diff(reference.x), jnp.diff(reference.y)
    heading = reference.heading[..., :-1]
    n = heading.shape[-1]
    # speed before each step, from the first speed and the accelerations
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


class Motion(NamedTuple):
    """Tracked proposals: motion of the rear axle at `T` moments."""

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
    stopping = (v <= STOPPING_SPEED) & (v_ahead <= STOPPING_SPEED)
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
def drive_along(reference: Poses, body: Body, steps: int, strict: bool = False) -> Motion:
    """Track all proposals with the LQR and a kinematic bicycle.

    The bicycle is nuPlan's if `strict` (Euler steps), otherwise that of the egos (`traffic.ego.step_free`).
    """
    shape = reference.x.shape[:2]

    def ahead(values: Array) -> Array:
        """Windows `[T, V, P, LOOK]`; the last value is repeated."""
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
            # an early or late vehicle is compared with the pose at another time, farther along the bend
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
            distance = (v + faster) / 2 * DT
            most = _CAR.lateral_acceleration / jnp.maximum(v * v, 0.1)
            turn = distance * jnp.clip(jnp.tan((steering + turned) / 2) / wheelbase, -most, most)
            course = heading + turn / 2
            x, y, heading = x + distance * jnp.cos(course), y + distance * jnp.sin(course), heading + turn
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
