"""Trajectory planning along a path: the cheapest sample of a lattice.

The lattice combines speeds, horizons and offsets (Werling, Ziegler, Kammel, Thrun, ICRA 2010). Along the path
samples are quartics and quintics in time. Across it they are quintics over the distance driven, which slow
vehicles can follow, too. Car following with several desired speeds and braking (mild and as hard as possible)
are always among the samples, so that at least one is drivable.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.policies.reference import Frenet, Place, ReferencePath, to_cartesian
from limsim_jax.traffic.car_following import NO_GAP, CarFollowing
from limsim_jax.types import Driver
from limsim_jax.xla import computed_once, interval, mapped_like


class Task(NamedTuple):
    """What `V` vehicles have ahead of them."""

    path: ReferencePath  # of the own lane, or of the target lane of a lane change
    start: Frenet
    length: Float[Array, " V"]  # m
    width: Float[Array, " V"]
    driver: Driver  # [V]
    lead_gap: Float[Array, "V J"]  # m from the front bumper to each leader; NO_GAP: none
    lead_v: Float[Array, "V J"]  # m/s
    lead_a: Float[Array, "V J"]  # m/s^2; a braking leader is assumed to keep braking
    wall: Float[Array, " V"]  # m from the front bumper to the stop obstacle
    other: Others
    merge: Merge
    wanted: Float[Array, "V H"]  # m/s, speed that the search chose; very high without a search
    steering: Float[Array, " V"]  # rad, largest while driving; with `wheelbase` it bounds the curvature
    wheelbase: Float[Array, " V"]


class Others(NamedTuple):
    """Predictions of `K` others for `V` vehicles, at `H` moments."""

    x: Float[Array, "V K H"]  # m
    y: Float[Array, "V K H"]
    heading: Float[Array, "V K H"]  # rad
    length: Float[Array, "V K"]  # m
    width: Float[Array, "V K"]
    counts: Bool[Array, "V K"]  # False: ignored


class Merge(NamedTuple):
    """Traffic on the lane that the route needs next.

    The vehicle adapts its speed to it.
    """

    s: Float[Array, "V K"]  # m from centre to centre along the path, now
    v: Float[Array, "V K"]  # m/s
    length: Float[Array, "V K"]  # m
    there: Bool[Array, "V K"]
    urgency: Float[Array, " V"]  # 0: no lane change needed, 1: must change now


class Plan(NamedTuple):
    """The chosen trajectories of the centres of the bodies, from now on."""

    x: Float[Array, "V H"]  # m
    y: Float[Array, "V H"]
    heading: Float[Array, "V H"]  # rad, of the motion
    v: Float[Array, "V H"]  # m/s
    cost: Float[Array, " V"]
    sample: Int[Array, " V"]  # index of the chosen sample
    safe: Bool[Array, " V"]  # no bound is broken, and there is no contact


class Samples(NamedTuple):
    """All trajectories of the lattice with their costs: `S` samples at `H` moments."""

    s: Float[Array, "V S H"]  # m
    d: Float[Array, "V S H"]  # m
    x: Float[Array, "V S H"]  # m
    y: Float[Array, "V S H"]
    heading: Float[Array, "V S H"]  # rad
    v: Float[Array, "V S H"]  # m/s
    curvature: Float[Array, "V S H"]  # 1/m
    cost: Float[Array, "V S"]
    broken: Float[Array, "V S"]  # excess over the bounds; 0: feasible


@dataclass(frozen=True)
class Lattice:
    """Samples and weights. All static.

    Attributes:
      horizon: s.
      dt: s between moments.
      speeds: end speeds of the quartics, between a standstill and the desired speed.
      horizons: s in which they are reached.
      stops: durations of stops at the stop obstacle, as multiples of the duration with constant
        deceleration, or of moving up to it from a standstill.
      following: desired speeds of the car-following samples, as shares.
      braking: m/s^2, constant; the hardest is the driver's `b_max`.
      offsets: m off the middle of the path at the end.
      distances: over which each offset is reached, as a share of the usual distance.
      lateral_time: s for a change of offset, at driving speed.
    """

    horizon: float = 5.0
    dt: float = 0.2
    speeds: int = 6
    horizons: tuple[float, ...] = (2.5, 4.5)
    stops: tuple[float, ...] = (1.0, 1.3)
    following: tuple[float, ...] = (1.0, 0.75, 0.5)
    braking: tuple[float, ...] = (2.0, 4.0)
    offsets: tuple[float, ...] = (0.0, -0.4, 0.4, 0.0)
    distances: tuple[float, ...] = (1.0, 1.0, 1.0, 0.5)
    lateral_time: float = 4.0
    # weights
    efficiency: float = 0.3
    speeding: float = 1.0
    acceleration: float = 0.25
    jerk: float = 0.1
    offset: float = 0.5
    bending: float = 40.0
    headway: float = 8.0
    proximity: float = 0.6
    decision: float = 0.05
    merging: float = 6.0

    @property
    def moments(self) -> int:
        """Number of moments, from now to the end of the horizon."""
        return round(self.horizon / self.dt) + 1

    def times(self) -> Float[Array, " H"]:
        """s from now."""
        return self.dt * jnp.arange(self.moments, dtype=jnp.float32)


_BROKEN = 1e3  # cost of a broken bound, per unit of excess
_TOUCH = 5e3  # cost of an immediate contact
_FORGET = 2.0  # s, time constant with which later contacts count less
_MARGIN = 0.5  # m kept ahead of and behind others
_SIDE = 0.25  # m kept beside others
_REACTION = 0.5  # s at the present speed before braking hard (RSS)
_RSS_UNTIL = 1.5  # s; beyond that another plan will be in force
_APPROACH = 0.6  # share of the comfortable deceleration, before bends and speed limits
_STOPPING, _STOPPING_LATE = 0.8, 1.5  # shares of it: at stop lines; at the end of a lane to be left
_ONSET = 1.0  # s in which this braking builds up
_MERGE_BRAKING = 2.0  # m/s^2
_STRETCH = 30.0  # m
_HURRY = 2.5  # factor of the weight of efficiency before a required lane change
_SLOW = 3.0  # m/s, below which the factor grows, too, so that queues move up
_AT_LAST = 0.3  # extra weight of speeding at the end of the horizon: braking would have to follow
_MOVE_UP = 10 / 3**0.5  # a quintic from rest to rest takes sqrt(this * distance / its greatest acceleration)
_MIN_LATERAL = 10.0  # m, least distance in which the offset changes
_ROLLING = 1.5  # m/s, below which the wheels can be turned before the vehicle has moved much


def quartic(
    v0: Array, a0: Array, v1: Array, end: Array | float, t: Array
) -> tuple[Array, Array, Array, Array]:
    """Quartic in time from one speed to another.

    From speed `v0` and acceleration `a0` to speed `v1` at `end`, without acceleration there. It keeps `v1`
    after `end`. Returns distance, speed, acceleration and jerk at `t`, in SI units.
    """
    dv, da = v1 - v0 - a0 * end, -a0
    a3 = (3 * dv - da * end) / (3 * end**2)
    a4 = (-2 * dv + da * end) / (4 * end**3)
    u = jnp.minimum(t, end)
    s = u * (v0 + u * (a0 / 2 + u * (a3 + u * a4)))
    on = t <= end
    v = jnp.where(on, v0 + u * (a0 + u * (3 * a3 + u * 4 * a4)), v1)
    a = jnp.where(on, a0 + u * (6 * a3 + u * 12 * a4), 0)
    return s + jnp.maximum(t - end, 0) * v1, v, a, jnp.where(on, 6 * a3 + 24 * a4 * u, 0)


def quintic(
    x0: Array, v0: Array, a0: Array, x1: Array, v1: Array | float, a1: Array | float, end: Array, t: Array
) -> tuple[Array, Array, Array, Array]:
    """Quintic between two points with given derivatives, `end` apart.

    Returns its value and three derivatives at `t`. After `end` it stays at `x1` if `v1` is 0.
    """
    d0, d1, d2 = x1 - x0 - v0 * end - a0 / 2 * end**2, v1 - v0 - a0 * end, a1 - a0
    a3 = (10 * d0 - 4 * d1 * end + d2 / 2 * end**2) / end**3
    a4 = (-15 * d0 + 7 * d1 * end - d2 * end**2) / end**4
    a5 = (6 * d0 - 3 * d1 * end + d2 / 2 * end**2) / end**5
    u = jnp.minimum(t, end)
    on = t <= end
    x = x0 + u * (v0 + u * (a0 / 2 + u * (a3 + u * (a4 + u * a5))))
    v = v0 + u * (a0 + u * (3 * a3 + u * (4 * a4 + u * 5 * a5)))
    a = a0 + u * (6 * a3 + u * (12 * a4 + u * 20 * a5))
    j = 6 * a3 + u * (24 * a4 + u * 60 * a5)
    return x, jnp.where(on, v, v1), jnp.where(on, a, 0), jnp.where(on, j, 0)


def speed_envelope(task: Task) -> Float[Array, "V M"]:
    """Highest speed at every point of the path, m/s.

    From it, mild braking suffices for all speed limits, bends and the stop obstacle ahead.
    """
    path, driver = task.path, task.driver
    fastest = jnp.minimum(driver.speed_factor[:, None] * path.limit, driver.v_max[:, None])
    bend = jnp.sqrt(driver.a_lat[:, None] / jnp.maximum(jnp.abs(path.curvature), 1e-5))
    top = jnp.minimum(fastest, bend)
    b = 2 * _APPROACH * driver.b[:, None]
    at = path.step * jnp.arange(path.x.shape[-1], dtype=top.dtype)[None]
    square = lax.cummin(top * top + b * at, axis=1, reverse=True) - b * at
    room = jnp.maximum(task.wall[:, None] - at, 0)
    return jnp.sqrt(jnp.maximum(jnp.minimum(square, 2 * _stopping(task)[:, None] * room), 0))


def _stopping(task: Task) -> Float[Array, " V"]:
    """Braking before the stop obstacle, m/s^2.

    A vehicle that still has to merge brakes late, to keep the speed of the traffic that it joins.
    """
    return task.driver.b * jnp.where(task.merge.urgency > 0, _STOPPING_LATE, _STOPPING)


def leaders(task: Task, t: Float[Array, "*#b"]) -> tuple[Float[Array, "*b J"], Float[Array, "*b J"]]:
    """Distance (m) and speed (m/s) of the leaders `t` s from now.

    Distances count from where the front bumper is now. Leaders keep their speed, or brake at constant
    deceleration to a standstill (constant-acceleration heuristic: Kesting, Treiber, Helbing, Phil. Trans. R.
    Soc. A 368, 2010).
    """
    shape = (task.lead_v.shape[0],) + (1,) * (t.ndim - 1) + (task.lead_v.shape[1],)
    gap, v, a = (x.reshape(shape) for x in (task.lead_gap, task.lead_v, task.lead_a))
    braking = jnp.maximum(-a, 0)
    until = jnp.minimum(t[..., None], v / jnp.maximum(braking, 1e-3))
    return gap + until * (v - braking * until / 2), v - braking * until


def sample(lattice: Lattice, model: CarFollowing, task: Task) -> Samples:
    """All samples of the lattice with their costs: each motion along the path with each offset.

    Terms that depend on the motion along the path alone are computed once for all offsets.
    """
    envelope = speed_envelope(task)
    s, v, a, jerk = _along(lattice, model, task, envelope)  # [V A H]
    start = task.start
    goal = jnp.asarray(lattice.offsets, s.dtype)[None, :, None]
    end = jnp.maximum(start.v * lattice.lateral_time, _MIN_LATERAL + 4 * jnp.abs(start.d))
    end = end[:, None, None] * jnp.asarray(lattice.distances, s.dtype)[None, :, None]
    first = _first_bend(task, goal, end)
    d0, slope0 = (x[:, None, None, None] for x in (start.d, start.slope))
    d, slope, bend, _ = quintic(
        d0, slope0, first[:, None], goal[:, None], 0.0, 0.0, end[:, None], s[:, :, None]
    )  # [V A O H]
    place = Place(*(x[:, :, None] for x in to_cartesian(task.path, s, jnp.zeros_like(s))))
    stretch = jnp.maximum(1 - place.curvature * d, 0.2)
    skew = slope / stretch
    turned = lax.rsqrt(1 + skew * skew)  # cosine of the angle to the path
    cos_way, sin_way = jnp.cos(place.heading), jnp.sin(place.heading)
    x, y = place.x - d * sin_way, place.y + d * cos_way
    cos, sin = turned * (cos_way - skew * sin_way), turned * (sin_way + skew * cos_way)
    curvature = ((bend + place.curvature * slope * skew) * turned**2 / stretch + place.curvature) * (
        turned / stretch
    )
    speed = v[:, :, None] * stretch / turned
    # used many times by the costs
    d, bend, x, y, cos, sin, curvature, speed = computed_once((d, bend, x, y, cos, sin, curvature, speed))
    cost, broken, room = _costs_along(lattice, task, envelope, s, v, a, jerk)
    more, worse = _costs_across(lattice, task, room, d, x, y, cos, sin, speed, curvature, bend)

    def flat(values: Array) -> Array:
        values = jnp.broadcast_to(values, d.shape[: values.ndim])
        return values.reshape(values.shape[0], -1, *values.shape[3:])

    return Samples(
        *(flat(z) for z in (s[:, :, None], d, x, y, place.heading + jnp.arctan(skew), speed, curvature)),
        cost=flat(cost[:, :, None] + more),
        broken=flat(broken[:, :, None] + worse),
    )


def _first_bend(task: Task, goal: Array, end: Array) -> Float[Array, "V O 1"]:
    """Second derivative of the offset at the start of samples, 1/m.

    Samples reach the offset `goal` after `end` (m). They begin with the present curvature of the motion. A
    stopped vehicle can turn its wheels first, so that its samples begin like a cubic, within the steering
    limit.
    """
    d, slope, bend, here, v, most = (
        x[:, None, None]
        for x in (
            task.start.d, task.start.slope, task.start.bend, task.path.curvature[:, 0], task.start.v,
            _tightest(task),
        )
    )  # fmt: skip
    free = jnp.clip(6 * (goal - d) / end**2 - 4 * slope / end, -0.9 * most - here, 0.9 * most - here)
    return bend + jnp.clip(1 - v / _ROLLING, 0, 1) * (free - bend)


def _tightest(task: Task) -> Float[Array, " V"]:
    """Largest curvature, 1/m; the full lock is for stopped or rolling vehicles."""
    more = 1 + 0.2 * jnp.clip(1 - task.start.v / _ROLLING, 0, 1)
    return more * jnp.tan(task.steering) / task.wheelbase


def plan(lattice: Lattice, model: CarFollowing, task: Task) -> Plan:
    """The cheapest sample for every vehicle."""
    samples = sample(lattice, model, task)
    total = samples.cost + _BROKEN * samples.broken
    best = jnp.argmin(total, -1)

    def pick(x: Array) -> Array:
        index = best.reshape(best.shape + (1,) * (x.ndim - 1))
        return jnp.take_along_axis(x, index, 1)[:, 0]

    return Plan(
        *(pick(x) for x in (samples.x, samples.y, samples.heading, samples.v)),
        cost=pick(total),
        sample=best.astype(jnp.int32),
        safe=pick(samples.broken) == 0,
    )


def _fastest(task: Task, envelope: Float[Array, "V M"]) -> Float[Array, " V"]:
    """Highest allowed speed within the next `_STRETCH` m, m/s."""
    return jnp.max(envelope[:, : max(2, int(_STRETCH / task.path.step))], -1)


def _along(
    lattice: Lattice, model: CarFollowing, task: Task, envelope: Float[Array, "V M"]
) -> tuple[Array, Array, Array, Array]:
    """Motion along the path `[V A H]`: m, m/s, m/s^2, m/s^3."""
    start, t = task.start, lattice.times()[None, None]
    v0, a0 = start.v[:, None, None], jnp.clip(start.a, -8.0, 4.0)[:, None, None]
    # end speeds from a standstill to the highest that is allowed ahead
    top = _fastest(task, envelope)
    share = jnp.linspace(0.0, 1.0, lattice.speeds)
    parts = []
    for end in lattice.horizons:
        reach = jnp.minimum(top, start.v + 1.5 * end)[:, None]
        low = jnp.maximum(start.v - 3.0 * end, 0)[:, None]
        parts.append(quartic(v0, a0, (low + share[None] * (reach - low))[:, :, None], end, t))
        # the speed of the nearest leader, or the present speed
        behind = jnp.where(task.lead_gap < NO_GAP / 2, task.lead_v, start.v[:, None])
        first = jnp.take_along_axis(behind, jnp.argmin(task.lead_gap, -1)[:, None], 1)
        parts.append(quartic(v0, a0, first[:, :, None], end, t))
    parts.append(quartic(v0, a0, v0, 2.0, t))
    # stops at the stop obstacle
    distance = jnp.maximum(task.wall, 0.05)[:, None, None]
    move_up = jnp.sqrt(_MOVE_UP * distance / task.driver.a[:, None, None])
    stop = jnp.minimum(2 * distance / jnp.maximum(v0, 0.5), move_up)
    stop = jnp.asarray(lattice.stops, v0.dtype)[None, :, None] * stop
    parts.append(quintic(jnp.zeros_like(v0), v0, a0, distance, 0.0, 0.0, jnp.clip(stop, 1.0, 60.0), t))
    # braking
    hard = [jnp.full_like(start.v, b) for b in lattice.braking] + [task.driver.b_max]
    b = jnp.stack(hard, -1)[:, :, None]
    u = jnp.minimum(t, v0 / b)
    v = v0 - b * u
    parts.append((u * (v0 - b * u / 2), v, jnp.where(v > 0, -b, 0), jnp.zeros_like(v)))
    parts.append(_late_stop(lattice, task))
    parts.append(_follow(lattice, model, task, envelope))
    shape = (*start.v.shape, -1, lattice.moments)
    s, v, a, jerk = (
        jnp.concatenate(
            [jnp.broadcast_to(part[k], (shape[0], part[0].shape[1], shape[2])) for part in parts], 1
        )
        for k in range(4)
    )
    return lax.cummax(s, axis=2), jnp.maximum(v, 0), a, jerk


def _late_stop(lattice: Lattice, task: Task) -> tuple[Array, Array, Array, Array]:
    """Keep the present speed as long as possible, then stop."""
    t, v0 = lattice.times()[None], task.start.v[:, None]
    room = jnp.maximum(task.wall[:, None] - v0 * _ONSET / 2, 0.1)
    b = jnp.clip(v0 * v0 / (2 * room), _stopping(task)[:, None], task.driver.b_max[:, None])
    begins = jnp.maximum(room - v0 * v0 / (2 * b), 0) / jnp.maximum(v0, 0.1)
    since = jnp.maximum(t - begins, 0)
    rising = jnp.minimum(since, _ONSET)
    v = v0 - b * (rising * rising / (2 * _ONSET) + since - rising)
    a = jnp.where(v > 0, -b * rising / _ONSET, 0)
    v = jnp.maximum(v, 0)
    moved = jnp.cumsum((v[:, 1:] + v[:, :-1]) / 2 * lattice.dt, -1)
    s = jnp.pad(moved, ((0, 0), (1, 0)))
    jerk = jnp.where((since > 0) & (since < _ONSET) & (v > 0), -b / _ONSET, 0)
    return s[:, None], v[:, None], a[:, None], jerk[:, None]


def _follow(
    lattice: Lattice, model: CarFollowing, task: Task, envelope: Array
) -> tuple[Array, Array, Array, Array]:
    """Car following behind all leaders, with several shares of the desired speed.

    The stop obstacle counts as a standing leader.
    """
    start, path, dt = task.start, task.path, lattice.dt
    driver = jax.tree.map(lambda x: x[:, None, None], task.driver)
    share = jnp.asarray(lattice.following, start.v.dtype)[None]
    v = jnp.broadcast_to(start.v[:, None], (start.v.shape[0], share.shape[1]))
    none = jnp.zeros_like(v)
    wall = (task.wall + task.driver.s0)[:, None, None]
    is_lead = jnp.concatenate([task.lead_gap[:, None], wall], -1) < NO_GAP / 2  # [V 1 J]

    def step(carry: tuple[Array, ...], t: Array) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        s, v, a = carry
        k = jnp.clip((s / path.step).astype(jnp.int32), 0, path.x.shape[-1] - 1)
        v0 = share * jnp.take_along_axis(envelope, k, 1)
        far, lead_v = leaders(task, jnp.broadcast_to(t, (1, 1)))
        far, lead_v = jnp.concatenate([far, wall], -1), jnp.concatenate([lead_v, jnp.zeros_like(wall)], -1)
        gap = jnp.where(is_lead, far - s[..., None], NO_GAP)
        ahead = jnp.where(is_lead, lead_v, v[..., None])
        wish = model(
            driver, gap=gap, v=v[..., None], v_lead=ahead, a_lead=jnp.zeros_like(gap), v0=v0[..., None]
        ).min(-1)
        wish = jnp.clip(wish, a - 6.0 * dt, a + 3.0 * dt)  # the drive train limits the jerk
        new = jnp.maximum(v + wish * dt, 0)
        return (s + (v + new) / 2 * dt, new, wish), (s, v, wish, (wish - a) / dt)

    a = jnp.broadcast_to(jnp.clip(start.a, -8.0, 4.0)[:, None], v.shape)
    _, found = lax.scan(step, (none, v, a), lattice.times())
    s, v, a, jerk = (jnp.moveaxis(x, 0, -1) for x in found)
    return s, v, a, jerk


def _costs_along(
    lattice: Lattice, task: Task, envelope: Array, s: Array, v: Array, a: Array, jerk: Array
) -> tuple[Float[Array, "V A"], Float[Array, "V A"], tuple[Float[Array, "V A H"], Float[Array, "V A H"]]]:
    """Costs of all motions along the path.

    Returns cost, excess over bounds, and the room to the left and right, m.
    """
    path, driver, t = task.path, task.driver, lattice.times()[None, None]
    each = lambda value: value[:, None, None]  # noqa: E731
    flat = (s.shape[0], -1)
    k, u = interval(s.reshape(flat) / path.step, path.x.shape[-1] - 1)

    def along(table: Float[Array, "V M"]) -> Array:
        low, high = jnp.take_along_axis(table, k, 1), jnp.take_along_axis(table, k + 1, 1)
        return (low + jnp.clip(u, 0, 1) * (high - low)).reshape(s.shape)

    # relative to one speed for all samples: reaching a higher speed limit must not raise the cost
    slow = jnp.maximum(each(_fastest(task, envelope)) - v, 0)
    over = jnp.maximum(v - along(envelope), 0)
    far, lead_v = leaders(task, t)
    gap = jnp.minimum(far - s[..., None], NO_GAP)  # [V A H J]
    # the IDM's desired gap, which grows with the approach rate
    approach = v[..., None] - lead_v
    dynamic = each(driver.T)[..., None] + approach / (2 * jnp.sqrt(each(driver.a * driver.b)))[..., None]
    wanted = each(driver.s0)[..., None] + jnp.maximum(v[..., None] * dynamic, 0)
    close = jnp.maximum(1 - gap / wanted, 0).max(-1)
    # merging vehicles should match the traffic's speed, and queues should move up
    slowly = jnp.clip(1 - task.start.v / _SLOW, 0, 1)
    hurry = jnp.where(task.merge.urgency > 0, _HURRY, 1.0 + (_HURRY - 1.0) * slowly)[:, None]
    # braking that would be needed after the horizon counts now
    closing = jnp.maximum(approach[:, :, -1], 0)
    remaining = jnp.maximum(gap[:, :, -1] - driver.s0[:, None, None], 0.1)
    later = jnp.minimum(closing * closing / (2 * remaining), driver.b_max[:, None, None]).max(-1)
    missing = _no_gap(task, s, v, t)
    cost = (
        lattice.efficiency * hurry * jnp.mean(slow, -1)
        + lattice.speeding * (jnp.mean(over * over, -1) + _AT_LAST * over[..., -1] ** 2)
        + lattice.acceleration * jnp.mean(a * a, -1)
        + lattice.jerk * jnp.mean(jerk * jerk, -1)
        + lattice.acceleration * later * later
        + lattice.headway * jnp.mean(close * close, -1)
        + lattice.decision * jnp.mean(jnp.square(jnp.maximum(v - task.wanted[:, None], 0)), -1)
        + lattice.merging * task.merge.urgency[:, None] * jnp.min(missing + 0.05 * t, -1)
    )

    beyond = jnp.maximum(s - jnp.maximum(each(task.wall), 0) - 0.3, 0)
    b_ego, b_lead = each(jnp.minimum(driver.b_max, 7.0)), 8.0
    need = (v * _REACTION + v * v / (2 * b_ego) + 1.0)[..., None] - lead_v**2 / (2 * b_lead)
    rss = jnp.where(t <= _RSS_UNTIL, jnp.maximum(jnp.maximum(need, 0.5) - gap, 0).max(-1), 0)
    acceleration = jnp.maximum(a - 4.0, 0) + jnp.maximum(-a - each(driver.b_max) - 0.5, 0)
    broken = 0.5 * jnp.max(beyond, -1) + 0.1 * jnp.max(rss, -1) + jnp.max(acceleration, -1)
    return cost, broken, (along(path.left), along(path.right))


def _costs_across(
    lattice: Lattice,
    task: Task,
    room: tuple[Array, Array],
    d: Array,
    x: Array,
    y: Array,
    cos: Array,
    sin: Array,
    speed: Array,
    curvature: Array,
    bend: Array,
) -> tuple[Float[Array, "V A O"], Float[Array, "V A O"]]:
    """Cost and excess over bounds due to offsets, bends and other vehicles.

    Arrays are `[V A O H]`; `cos` and `sin` are those of the heading.
    """
    each = lambda value: value[:, None, None, None]  # noqa: E731
    tightest = each(_tightest(task))
    tight = jnp.maximum(jnp.abs(curvature) - tightest, 0)
    lateral = jnp.maximum(jnp.abs(curvature) * speed * speed - each(task.driver.a_lat) - 1.0, 0)
    half = each(task.width) / 2
    edge = jnp.zeros_like(d)
    for side, free in zip((1.0, -1.0), room, strict=True):
        # a vehicle that is over the edge may return, and one that points there may turn first
        out = jnp.maximum(side * d + half - free[:, :, None], 0)
        turning = jnp.maximum(side * each(task.start.slope), 0) ** 2 / tightest
        edge = jnp.maximum(edge, out - jnp.maximum(out[..., :1], 0.05) - turning)
    touch, near = _meet(task, x, y, cos, sin)
    fade = jnp.exp(-lattice.times() / _FORGET)[None, None, None]
    cost = (
        lattice.offset * jnp.mean(d * d, -1)
        + lattice.bending * jnp.mean((bend * speed) ** 2, -1) / 25
        + lattice.proximity * jnp.mean(near, -1)
    )
    broken = (
        10 * jnp.max(tight, -1)
        + 0.1 * jnp.max(lateral, -1)
        + jnp.max(edge, -1)
        + _TOUCH / _BROKEN * jnp.max(touch * fade, -1)
        + 0.2 * jnp.sum(touch * fade, -1)
    )
    return cost, broken


def room_needed(
    v: Float[Array, "*#b"],
    v_ahead: Float[Array, "*#b"],
    braking: Float[Array, "*#b"] | float,
    headway: Float[Array, "*#b"] | float = 0.3,
) -> Float[Array, "*#b"]:
    """Gap (m) that a lane change needs between follower and leader.

    Room to react, to brake to the leader's speed, and for a short headway after that. A faster leader opens
    this headway by itself.

    Args:
      v: speed of the follower, m/s.
      v_ahead: speed of the leader, m/s.
      braking: m/s^2 that the follower brakes with.
      headway: s.
    """
    faster = jnp.maximum(v - v_ahead, 0)
    short = jnp.maximum(headway * v - jnp.maximum(v_ahead - v, 0), 0)
    return 2.0 + short + 0.5 * faster + faster * faster / (2 * braking)


def _no_gap(task: Task, s: Array, v: Array, t: Array) -> Float[Array, "V A H"]:
    """Shortfall of the gap beside the vehicle, before a merge.

    It is 0 if the follower in each pair can brake to its leader's speed with `_MERGE_BRAKING`.
    """
    merge, missing = task.merge, jnp.zeros_like(s)
    for k in range(merge.s.shape[1]):
        its_v, its_length = merge.v[:, k, None, None], merge.length[:, k, None, None]
        ahead = merge.s[:, k, None, None] + its_v * t - s
        rear: Array = jnp.where(ahead > 0, v, its_v)
        front: Array = jnp.where(ahead > 0, its_v, v)
        need = room_needed(rear, front, _MERGE_BRAKING)
        gap = jnp.abs(ahead) - (its_length + task.length[:, None, None]) / 2
        short = jnp.clip((need - gap) / 10.0, 0, 3.0)
        missing = jnp.maximum(missing, jnp.where(merge.there[:, k, None, None], short, 0))
    return missing


def _meet(
    task: Task, x: Array, y: Array, cos: Array, sin: Array
) -> tuple[Float[Array, "V A O H"], Float[Array, "V A O H"]]:
    """Contact (0 or 1) and proximity beside the vehicle (0 to 1).

    Boxes are compared along the axes of the vehicle, with a margin: slightly conservative.
    """
    each = lambda value: value[:, None, None, None]  # noqa: E731
    at_times = lambda value: value[:, None, None]  # noqa: E731
    half_length, half_width = each(task.length) / 2, each(task.width) / 2

    def look(seen: tuple[Array, Array], one: tuple[Array, ...]) -> tuple[tuple[Array, Array], None]:
        touch, near = seen
        its_x, its_y, its_cos, its_sin = (at_times(z) for z in one[:4])
        its_length, its_width, counts = each(one[4]) / 2, each(one[5]) / 2, each(one[6])
        dx, dy = its_x - x, its_y - y
        c, s = jnp.abs(cos * its_cos + sin * its_sin), jnp.abs(cos * its_sin - sin * its_cos)
        ahead = jnp.abs(dx * cos + dy * sin) - half_length - c * its_length - s * its_width
        aside = jnp.abs(dy * cos - dx * sin) - half_width - s * its_length - c * its_width
        level = counts & (ahead < _MARGIN)
        touch = jnp.maximum(touch, (level & (aside < _SIDE)).astype(x.dtype))
        near = jnp.maximum(near, jnp.where(level, jnp.clip(1 - aside, 0, 1), 0))
        return (touch, near), None

    # a loop over the others: unrolled, XLA would compute the positions of all samples again for each
    other = task.other
    cos_k, sin_k = jnp.cos(other.heading), jnp.sin(other.heading)
    each_of = (other.x, other.y, cos_k, sin_k, other.length, other.width, other.counts)
    nobody = mapped_like(x, (jnp.zeros_like(x), jnp.zeros_like(x)))
    return lax.scan(look, nobody, tuple(jnp.moveaxis(z, 1, 0) for z in each_of))[0]
