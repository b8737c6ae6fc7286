"""Car following: IDM, IIDM and ACC-IDM, and the ballistic step that integrates them.

Sources: IDM: Treiber, Hennecke, Helbing, Phys. Rev. E 62 (2000) 1805. IIDM: Treiber, Kesting, Traffic
Flow Dynamics (2013), ch. 11. ACC-IDM: Kesting, Treiber, Helbing, Phil. Trans. R. Soc. A 368 (2010) 4585,
on the IIDM as in the book. Ballistic step: Treiber, Kanagaraj, Physica A 419 (2015) 183.

A model is a frozen value, called as

    model(driver, gap=gap, v=v, v_lead=v_lead, a_lead=a_lead, v0=v0)  # m/s^2

with the leaves of `driver` and the other arguments of one shape, or of shapes that broadcast against one
another: `[N]`, or `[N, K]` for several obstacles each (`per_obstacle(driver)`, and the least of the K
accelerations counts). `gap` is bumper to bumper in m and `NO_GAP` where there is no leader, with
`v_lead = v` and `a_lead = 0`; `a_lead` is what the leader did, `(v_new - v) / dt`, not what it wanted.
`v0` is the desired speed of the moment, `desired_speed(...)`; `v0 = 0` brings a vehicle to rest.

Results lie in [-b_max, a]; a `gap` of 0 or less gives `-b_max`. All values and gradients are finite for
any finite arguments with `v, v_lead, v0 >= 0`, also for a driver of zeros in an empty slot. Formulas are
exact, not smoothed: the gradient is one-sided at kinks (`s* = s`, `v = v0`), and 0 with respect to all
but `b_max` where the braking limit acts. It means nothing across a change of leader.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from limsim_jax.numerics import safe_divide, safe_sqrt
from limsim_jax.types import Driver

NO_GAP = 1e6
"""m, the gap where there is no leader: finite, for infinity times zero is NaN in a gradient."""

_MIN_GAP = 0.01  # m; below it, formulas are evaluated here
_MIN_SPEED = 1e-3  # m/s, the least desired speed of a vehicle that wants to move
_MAX_RATIO = 100.0  # of speed to desired speed
_MIN_RATE = 1e-3  # m/s^2, floor under accelerations that divide

Values = Float[Array, "*#b"]


@runtime_checkable
class CarFollowing(Protocol):
    """What the models have in common; the module's docstring tells what the arguments mean."""

    def __call__(
        self, driver: Driver, *, gap: Values, v: Values, v_lead: Values, a_lead: Values, v0: Values
    ) -> Float[Array, "*b"]:
        """Acceleration, m/s^2."""
        ...


@dataclass(frozen=True)
class IDM:
    """Intelligent driver model. Brakes hard above `v0` and after cut-ins; meant for calibration."""

    def __call__(
        self, driver: Driver, *, gap: Values, v: Values, v_lead: Values, a_lead: Values, v0: Values
    ) -> Float[Array, "*b"]:
        """Acceleration, m/s^2; does not depend on `a_lead`."""
        del a_lead
        z = _desired_gap(driver, v, v_lead) / jnp.maximum(gap, _MIN_GAP)
        return _limited(driver, gap, driver.a * (1 - _power(_speed_ratio(v, v0), driver.delta) - z * z))


@dataclass(frozen=True)
class IIDM:
    """Improved IDM: keeps the gap s0 + v T in equilibrium and brakes with at most `b` above `v0`."""

    def __call__(
        self, driver: Driver, *, gap: Values, v: Values, v_lead: Values, a_lead: Values, v0: Values
    ) -> Float[Array, "*b"]:
        """Acceleration, m/s^2; does not depend on `a_lead`."""
        del a_lead
        return _limited(driver, gap, _iidm(driver, gap, v, v_lead, v0))


@dataclass(frozen=True)
class ACC:
    """IIDM that trusts the leader not to brake at once: mild where a cut-in leaves a short gap.

    Where the IIDM brakes harder than the constant-acceleration heuristic asks for, a mean of both weighted
    with `driver.coolness`. The default for traffic.
    """

    def __call__(
        self, driver: Driver, *, gap: Values, v: Values, v_lead: Values, a_lead: Values, v0: Values
    ) -> Float[Array, "*b"]:
        """Acceleration, m/s^2."""
        iidm = _iidm(driver, gap, v, v_lead, v0)
        cah = _constant_acceleration_heuristic(driver, gap, v, v_lead, a_lead)
        b = jnp.maximum(driver.b, _MIN_RATE)
        cool = cah + b * jnp.tanh((iidm - cah) / b)
        mixed = (1 - driver.coolness) * iidm + driver.coolness * cool
        return _limited(driver, gap, jnp.where(iidm >= cah, iidm, mixed))


def per_obstacle(driver: Driver) -> Driver:
    """The driver `[N]` as `[N, 1]`, for arguments of several obstacles.

    These are `[N, K]`, with `v` and `v0` as `[N, 1]`.
    """
    return jax.tree.map(lambda x: x[..., None], driver)


def desired_speed(driver: Driver, speed_limit: Values, curvature: Values) -> Float[Array, "*b"]:
    """Speed that the driver would hold on a free road here, m/s.

    Args:
      driver: `speed_factor`, `v_max` and `a_lat` count.
      speed_limit: m/s.
      curvature: of the path, 1/m, of either sign.
    """
    # 1e-6 1/m: straight, and its speed above all others
    bend = safe_sqrt(driver.a_lat / jnp.maximum(jnp.abs(curvature), 1e-6))
    return jnp.minimum(jnp.minimum(driver.speed_factor * speed_limit, driver.v_max), bend)


def ballistic(
    v: Values, a: Values, dt: float | Float[Array, ""]
) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """One step of constant acceleration; a vehicle that stops stays there.

    Exact for a constant acceleration; with a model behind it, of first order in `dt`, like Euler's method
    but with a smaller error (Treiber, Kanagaraj 2015). Never reverses: where the vehicle stops within the
    step, the new speed is 0 with zero gradient and the distance is v^2 / (2 |a|).

    Args:
      v: speed, m/s, not negative.
      a: acceleration, m/s^2.
      dt: s.

    Returns:
      New speed, m/s, and distance travelled, m.
    """
    v_new = v + a * dt
    stops = v_new < 0
    braking = jnp.where(stops, jnp.maximum(-a, 1e-6), 1)  # floor: its square divides in the gradient
    distance = jnp.where(stops, v * v / (2 * braking), (v + 0.5 * a * dt) * dt)
    return jnp.where(stops, 0, v_new), distance


def equilibrium_gap(model: CarFollowing, driver: Driver, v: Values, v0: Values) -> Float[Array, "*b"]:
    """Gap (m) to a leader of the same constant speed.

    IDM: (s0 + v T) / sqrt(1 - (v / v0)^delta), and `NO_GAP` from v = v0 on; others: s0 + v T.
    """
    if not isinstance(model, IDM):
        return _desired_gap(driver, v, v)
    z = safe_sqrt(1 - _power(_speed_ratio(v, v0), driver.delta))
    return jnp.minimum(safe_divide(_desired_gap(driver, v, v), z, NO_GAP), NO_GAP)


def equilibrium_flow(
    model: CarFollowing, driver: Driver, length: Values, v: Values, v0: Values
) -> Float[Array, "*b"]:
    """Flow (vehicles/s) of equal vehicles in equilibrium: the fundamental diagram.

    `length` in m, `v` in m/s.
    """
    return v / (equilibrium_gap(model, driver, v, v0) + length)


def string_stability(driver: Driver, v: Values, v0: Values) -> Float[Array, "*b"]:
    """String stability of the IDM in equilibrium at `v < v0`: f_v^2 - f_l^2 - 2 f_s, 1/s^2.

    f_s, f_v, f_l: derivatives of the acceleration by gap, own and leader's speed. Platoons amplify
    perturbations from vehicle to vehicle where it is negative (Treiber, Kesting 2013, ch. 15). The IIDM
    and the ACC-IDM have a kink in equilibrium and no such linearisation.
    """
    s = equilibrium_gap(IDM(), driver, v, v0)
    v = jnp.broadcast_to(v, s.shape)

    def acceleration(s: Array, v: Array, v_lead: Array) -> Array:
        return IDM()(driver, gap=s, v=v, v_lead=v_lead, a_lead=jnp.zeros_like(s), v0=v0)

    def derivative(*direction: float) -> Array:
        tangents = tuple(jnp.full_like(s, x) for x in direction)
        return jax.jvp(acceleration, (s, v, v), tangents)[1]

    f_s, f_v, f_l = derivative(1.0, 0.0, 0.0), derivative(0.0, 1.0, 0.0), derivative(0.0, 0.0, 1.0)
    return f_v * f_v - f_l * f_l - 2 * f_s


def _limited(driver: Driver, gap: Array, acceleration: Array) -> Array:
    """No harder braking than `b_max`, and just that where bodies overlap."""
    return jnp.where(gap > 0, jnp.maximum(acceleration, -driver.b_max), -driver.b_max)


def _desired_gap(driver: Driver, v: Array, v_lead: Array) -> Array:
    """Desired gap of the IDM: s* = s0 + max(0, v T + v (v - v_lead) / (2 sqrt(a b)))."""
    root = 2 * jnp.sqrt(jnp.maximum(driver.a * driver.b, _MIN_RATE**2))
    return driver.s0 + jnp.maximum(v * (driver.T + (v - v_lead) / root), 0)


def _speed_ratio(v: Array, v0: Array) -> Array:
    """v / v0, bounded; the bound itself for a vehicle that should stand, also while it stands."""
    moves = v0 > _MIN_SPEED
    return jnp.where(moves, jnp.minimum(v / jnp.where(moves, v0, 1), _MAX_RATIO), _MAX_RATIO)


def _power(base: Array, exponent: Array) -> Array:
    """Power with finite derivatives at 0: base**exponent for base >= 0, exponent > 0."""
    positive = base > 1e-6
    return jnp.where(positive, jnp.exp(exponent * jnp.log(jnp.where(positive, base, 1))), 0)


def _free_acceleration(driver: Driver, v: Array, v0: Array) -> Array:
    """IIDM without a leader: a (1 - (v / v0)^delta) up to v0, -b (1 - (v0 / v)^(a delta / b)) above."""
    ratio = _speed_ratio(v, v0)
    above = ratio > 1
    exponent = driver.delta * jnp.where(above, driver.a / jnp.maximum(driver.b, _MIN_RATE), 1)
    base = jnp.where(above, 1 / jnp.where(above, ratio, 1), ratio)
    return jnp.where(above, -driver.b, driver.a) * (1 - _power(base, exponent))


def _iidm(driver: Driver, gap: Array, v: Array, v_lead: Array, v0: Array) -> Array:
    """Unlimited acceleration of the IIDM."""
    z = _desired_gap(driver, v, v_lead) / jnp.maximum(gap, _MIN_GAP)
    free = _free_acceleration(driver, v, v0)
    up = jnp.maximum(free, 0)
    # The exponent 2 a / free has a pole at v = v0, where its factor `up` is 0: a floor changes nothing.
    a = jnp.maximum(driver.a, _MIN_RATE)
    near = jnp.minimum(z, 1)
    far = free - up * _power(near, 2 * a / jnp.maximum(up, _MIN_RATE * a))
    return jnp.where(z < 1, far, jnp.minimum(free, 0) + driver.a * (1 - z * z))


def _constant_acceleration_heuristic(
    driver: Driver, gap: Array, v: Array, v_lead: Array, a_lead: Array
) -> Array:
    """Largest acceleration that avoids a crash if the leader keeps its acceleration."""
    s = jnp.maximum(gap, _MIN_GAP)
    a_lead = jnp.minimum(a_lead, driver.a)
    approach = v - v_lead
    pole = v_lead * v_lead - 2 * s * a_lead
    # Whether the leader stands by the time the gap is used up. Both formulas agree where `pole` is 0.
    leader_stops = (v_lead * approach <= -2 * s * a_lead) & (pole > 1e-6)
    stopping = v * v * a_lead / jnp.where(leader_stops, pole, 1)
    closing = jnp.maximum(approach, 0)
    return jnp.where(leader_stops, stopping, a_lead - closing * closing / (2 * s))


def safe_speed(driver: Driver, gap: Values, v_lead: Values) -> Float[Array, "*b"]:
    """Largest speed (m/s) that lets a driver stop s0 behind the leader.

    The driver reacts after T and brakes with b. Gipps (1981), Transp. Res. B 15, 105, eq. 8, for a
    leader that brakes as hard. Equals the leader's speed where the gap is s0 + v T. `gap` in m, `v_lead` in
    m/s.
    """
    bt = driver.b * driver.T
    square = bt * bt + v_lead * v_lead + 2 * driver.b * (gap - driver.s0)
    return jnp.maximum(safe_sqrt(square) - bt, 0)


__all__ = [
    "ACC",
    "IDM",
    "IIDM",
    "NO_GAP",
    "CarFollowing",
    "ballistic",
    "desired_speed",
    "equilibrium_flow",
    "equilibrium_gap",
    "per_obstacle",
    "safe_speed",
    "string_stability",
]
