"""Surrogate safety measures: time to collision, headway, distance, DRAC, PET, RSS, delta-v.

All functions take one pair or arrays of pairs alike. Metres, seconds, m/s, m/s^2; absent times are
`NONE`, absent gaps `NO_GAP`.

- TTC, 1-D: gap over closing speed (Hayward 1972); 2-D: the first time at which two boxes that go on with
  their present velocity and heading touch, exactly, by the separating-axis theorem for moving boxes:
  on each of four directions the shadows of the boxes overlap during an interval; the boxes touch while
  all four do.
- THW, time headway: gap over the follower's speed. DRAC, deceleration rate to avoid a crash:
  closing speed squared over twice the gap (Cooper and Ferguson 1976).
- PET, post-encroachment time: from one vehicle leaving a conflict zone to another one entering it
  (Allen, Shin and Cooper 1978); 0 if the second enters before the first has left.
- RSS: safe distances of Shalev-Shwartz, Shammah and Shashua (2017), arXiv 1708.06374, Lemmas 2 and 4.
- Delta-v: change of velocity of the ego in a plastic impact, as in nuPlan's `collision_utils.py`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.metrics.reductions import Least
from limsim_jax.numerics import safe_sqrt
from limsim_jax.traffic.car_following import NO_GAP
from limsim_jax.xla import computed_once

NONE = 1e6
"""s: no collision, no conflict."""

FORESIGHT = 1000.0
"""s: a contact later than this is none."""

STILL = 1e-4
"""m/s: bodies with a lower relative speed along an axis do not move along it. Rounding alone makes 1e-5."""

NEAR_MISS = (1.5, 2.0)
"""s: a near miss begins when the TTC falls below the first and ends when it exceeds the second."""

FIRM_BRAKING = 3.4
"""m/s^2: comfortable for most drivers (AASHTO, Green Book, stopping sight distance); harder is firm."""

EXPOSED = 3.0
"""s: the usual threshold of the time exposed to a short TTC (Minderhoud and Bovy 2001)."""


def lesser(a: Float[Array, "*b"], b: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """The lesser of two numbers; faster on CPUs than `jnp.minimum`, which checks for NaN."""
    return jnp.where(a < b, a, b)


def greater(a: Float[Array, "*b"], b: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """The greater of two numbers, as `lesser`."""
    return jnp.where(a > b, a, b)


class Encounter(NamedTuple):
    """Another vehicle as the ego sees it: in the ego's axes, x ahead and y to the left."""

    x: Float[Array, "*b"]  # m, centre of the other from the centre of the ego
    y: Float[Array, "*b"]
    u: Float[Array, "*b"]  # m/s, velocity of the other less that of the ego, along x
    w: Float[Array, "*b"]  # along y
    cos: Float[Array, "*b"]  # of the other's heading in these axes
    sin: Float[Array, "*b"]
    length: Float[Array, "*b"]  # m, of the ego
    width: Float[Array, "*b"]
    other_length: Float[Array, "*b"]
    other_width: Float[Array, "*b"]


def encounter(
    box: Float[Array, " 5"],
    velocity: Float[Array, " 2"],
    others: Float[Array, "*b 5"],
    velocities: Float[Array, "*b 2"],
) -> Encounter:
    """How `others` stand and move relative to one vehicle; boxes as in `limsim_jax.geometry`."""
    cos, sin = jnp.cos(box[2]), jnp.sin(box[2])
    dx, dy = others[..., 0] - box[0], others[..., 1] - box[1]
    du, dw = velocities[..., 0] - velocity[0], velocities[..., 1] - velocity[1]
    turn = others[..., 2] - box[2]
    return Encounter(
        x=cos * dx + sin * dy,
        y=cos * dy - sin * dx,
        u=cos * du + sin * dw,
        w=cos * dw - sin * du,
        cos=jnp.cos(turn),
        sin=jnp.sin(turn),
        length=jnp.broadcast_to(box[3], dx.shape),
        width=jnp.broadcast_to(box[4], dx.shape),
        other_length=others[..., 3],
        other_width=others[..., 4],
    )


def mirrored(e: Encounter) -> Encounter:
    """The same encounter as the other vehicle sees it."""
    return Encounter(
        x=-(e.cos * e.x + e.sin * e.y),
        y=e.sin * e.x - e.cos * e.y,
        u=-(e.cos * e.u + e.sin * e.w),
        w=e.sin * e.u - e.cos * e.w,
        cos=e.cos,
        sin=-e.sin,
        length=e.other_length,
        width=e.other_width,
        other_length=e.length,
        other_width=e.width,
    )


def reach(e: Encounter) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """Half extents of both boxes together along x and y: nearer centres overlap on that axis, m."""
    c, s = jnp.abs(e.cos), jnp.abs(e.sin)
    along = (e.length + c * e.other_length + s * e.other_width) / 2
    return along, (e.width + s * e.other_length + c * e.other_width) / 2


def _axes(e: Encounter) -> tuple[tuple[Float[Array, "*b"], ...], ...]:
    """Offsets, relative speeds and half extents along the four side axes."""
    m = mirrored(e)  # signs do not matter: the other's axes are those of the mirrored encounter
    ex, ey = reach(e)
    mx, my = reach(m)
    return (e.x, e.y, m.x, m.y), (e.u, e.w, m.u, m.w), (ex, ey, mx, my)


def overlaps(e: Encounter) -> Bool[Array, "*b"]:
    """Whether the boxes share a point; touching counts."""
    offsets, _, extents = _axes(e)
    inside = [jnp.abs(offset) <= extent for offset, extent in zip(offsets, extents, strict=True)]
    return inside[0] & inside[1] & inside[2] & inside[3]


def distance(e: Encounter, touching: Bool[Array, "*b"] | None = None) -> Float[Array, "*b"]:
    """Euclidean distance between the boxes, m; 0 if they overlap (`touching`, if that is known already).

    Boxes apart are nearest at a corner of one of them, so eight distances from a corner to a box do.
    """

    def corners(e: Encounter) -> Float[Array, "*b"]:
        ahead_x, ahead_y = e.cos * e.other_length / 2, e.sin * e.other_length / 2
        left_x, left_y = -e.sin * e.other_width / 2, e.cos * e.other_width / 2
        squares = []
        for forward in (1.0, -1.0):
            for left in (1.0, -1.0):
                x = jnp.abs(e.x + forward * ahead_x + left * left_x) - e.length / 2
                y = jnp.abs(e.y + forward * ahead_y + left * left_y) - e.width / 2
                squares.append(jnp.where(x > 0, x * x, 0) + jnp.where(y > 0, y * y, 0))
        return lesser(lesser(squares[0], squares[1]), lesser(squares[2], squares[3]))

    square = lesser(corners(e), corners(mirrored(e)))
    return jnp.where(overlaps(e) if touching is None else touching, 0, safe_sqrt(square))


def contact_interval(e: Encounter) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """When moving boxes begin and cease to touch, s from now.

    They keep velocity and heading. Negative times lie in the past. If they never touch, `begin > cease`.
    """
    # Fractions are compared by cross multiplication, and divided last: one division instead of four, and
    # XLA keeps the result of a division instead of computing it again for each use.
    # Compilers may compute a speed twice and round it differently. So its sign, which is that of its error
    # where bodies stand still, does not matter there: bodies apart stay apart, and the others in touch.
    begins, ceases = [], []
    for offset, speed, extent in zip(*computed_once(_axes(e)), strict=True):
        still, far = jnp.abs(speed) < STILL, jnp.abs(offset)
        toward = jnp.where(speed < 0, -offset, offset)
        fast = jnp.where(still, 1e-9, jnp.abs(speed))
        begins.append((jnp.where(still, far, -toward) - extent, fast))
        ceases.append((extent - jnp.where(still, far, toward), fast))
    begin, cease = begins[0], ceases[0]
    for one, other in zip(begins[1:], ceases[1:], strict=True):
        begin = _pick(one[0] * begin[1] > begin[0] * one[1], one, begin)
        cease = _pick(other[0] * cease[1] < cease[0] * other[1], other, cease)
    return begin[0] / begin[1], cease[0] / cease[1]


Fraction = tuple[Float[Array, "*b"], Float[Array, "*b"]]


def _pick(condition: Bool[Array, "*b"], one: Fraction, other: Fraction) -> Fraction:
    return jnp.where(condition, one[0], other[0]), jnp.where(condition, one[1], other[1])


def first_touch(begin: Float[Array, "*b"], cease: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """TTC of a contact interval, s; `NONE` if it is empty, over, or more than `FORESIGHT` away."""
    comes = (begin <= cease) & (cease >= 0) & (begin < FORESIGHT)
    return jnp.where(comes, jnp.where(begin > 0, begin, 0), NONE)


def ttc_2d(e: Encounter) -> Float[Array, "*b"]:
    """Time until the boxes first touch, s; 0 if they do, `NONE` if they will not."""
    return first_touch(*contact_interval(e))


def ttc_1d(gap: Float[Array, "*b"], v: Float[Array, "*b"], v_lead: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Time until a follower meets its leader, s; `NONE` if the gap does not close.

    `v`, `v_lead`: their speeds, m/s; `gap`: m, bumper to bumper.
    """
    closing = v - v_lead
    found = (closing > 0) & (gap < NO_GAP)
    time = jnp.maximum(gap, 0) / jnp.where(found, closing, 1)
    return jnp.where(found, jnp.minimum(time, NONE), NONE)


def time_headway(gap: Float[Array, "*b"], v: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Time in which a follower covers the gap to its leader, s; `NONE` at standstill.

    `v`: its speed, m/s; `gap`: m, bumper to bumper.
    """
    found = (v > 0) & (gap < NO_GAP)
    return jnp.where(found, jnp.minimum(jnp.maximum(gap, 0) / jnp.where(found, v, 1), NONE), NONE)


def drac(gap: Float[Array, "*b"], v: Float[Array, "*b"], v_lead: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Deceleration that just avoids a leader of constant speed, m/s^2.

    0 if the gap does not close. A gap below 1 cm counts as 1 cm.
    """
    closing = jnp.maximum(v - v_lead, 0)
    return jnp.where(gap < NO_GAP, closing * closing / (2 * jnp.maximum(gap, 0.01)), 0)


def delta_v(
    v: Float[Array, "*b"],
    v_other: Float[Array, "*b"],
    cos_turn: Float[Array, "*b"],
    mass_ratio: Float[Array, "*b"] | float = 0.5,
) -> Float[Array, "*b"]:
    """Change of the ego's velocity in a plastic impact, m/s.

    `cos_turn`: cosine of the angle between the headings; `mass_ratio`: mass of the other over that of
    both. nuPlan takes equal masses.
    """
    square = v * v + v_other * v_other - 2 * v * v_other * cos_turn
    return mass_ratio * safe_sqrt(square)


class Rss(NamedTuple):
    """Parameters of RSS; the paper leaves them to the regulator, these are usual in its evaluations."""

    response: float = 0.5  # s
    accelerate: float = 2.0  # m/s^2, hardest acceleration during the response
    brake: float = 4.0  # m/s^2, what the responding vehicle brakes at least
    brake_hardest: float = 8.0  # m/s^2, what the one ahead brakes at most
    lateral_accelerate: float = 0.2  # m/s^2
    lateral_brake: float = 0.8  # m/s^2
    margin: float = 0.1  # m, mu: for lateral fluctuations


def rss_longitudinal(
    v: Float[Array, "*b"], v_lead: Float[Array, "*b"], rss: Rss | None = None
) -> Float[Array, "*b"]:
    """Safe distance of a follower behind its leader, m (Lemma 2); speeds in m/s."""
    p = Rss() if rss is None else rss
    after = v + p.response * p.accelerate
    distance = v * p.response + p.accelerate * p.response**2 / 2 + after * after / (2 * p.brake)
    return jnp.maximum(distance - v_lead * v_lead / (2 * p.brake_hardest), 0)


def rss_lateral(
    w: Float[Array, "*b"], w_other: Float[Array, "*b"], rss: Rss | None = None
) -> Float[Array, "*b"]:
    """Safe lateral distance between two vehicles, m (Lemma 4).

    `w`, `w_other`: their lateral speeds, each positive towards the other (m/s). The lemma as printed
    assumes that after the response both still move towards each other; otherwise the braking distance
    of the one that moves away counts in its favour.
    """
    p = Rss() if rss is None else rss

    def way(w: Float[Array, "*b"]) -> Float[Array, "*b"]:
        after = w + p.response * p.lateral_accelerate
        return (w + after) / 2 * p.response + after * jnp.abs(after) / (2 * p.lateral_brake)

    return p.margin + jnp.maximum(way(w) + way(w_other), 0)


class Zones(NamedTuple):
    """Conflict zones near the ego in this step: `Z` places, in any order from step to step."""

    id: Int[Array, " Z"]  # which conflict zone; -1 for none, no other number twice
    ego: Bool[Array, " Z"]  # the ego is in it
    other: Bool[Array, " Z"]  # another vehicle is in it


class PetCarry(NamedTuple):
    """Memory of `pet_update`, for each zone."""

    id: Int[Array, " Z"]
    ego: Bool[Array, " Z"]
    other: Bool[Array, " Z"]
    ego_left: Float[Array, " Z"]  # s, the first step outside after the last one inside; -NONE if never
    other_left: Float[Array, " Z"]
    least: Least


def pet_init(zones: int) -> PetCarry:
    """No vehicle has been in any of the `zones`."""
    nothing, never = jnp.zeros(zones, bool), jnp.full(zones, -NONE)
    return PetCarry(jnp.full(zones, -1, jnp.int32), nothing, nothing, never, never, Least.empty())


def pet_update(carry: PetCarry, t: Float[Array, ""], zones: Zones) -> PetCarry:
    """One step at time `t` (s); the result is `carry.least`, exact to one step.

    A zone is forgotten once it is not among `zones`: keep it for as long as a PET may matter.
    """
    exists = zones.id >= 0
    same = (zones.id[:, None] == carry.id[None, :]) & exists[:, None]  # [now, before]

    def flag(x: Bool[Array, " Z"]) -> Bool[Array, " Z"]:
        return (same & x[None, :]).any(1)

    def time(x: Float[Array, " Z"]) -> Float[Array, " Z"]:
        return jnp.max(jnp.where(same, x[None, :], -NONE), 1)

    ego_in, other_in = zones.ego & exists, zones.other & exists
    ego_was, other_was = flag(carry.ego), flag(carry.other)
    ego_left = jnp.where(ego_was & ~ego_in, t, time(carry.ego_left))
    other_left = jnp.where(other_was & ~other_in, t, time(carry.other_left))
    ego_enters, other_enters = ego_in & ~ego_was, other_in & ~other_was
    together = ego_in & other_in & (ego_enters | other_enters)
    second = (ego_enters & (other_left > -NONE)) | (other_enters & (ego_left > -NONE))
    pet = jnp.where(together, 0, t - jnp.where(ego_enters, other_left, ego_left))
    found = together | second
    return PetCarry(
        id=zones.id,
        ego=ego_in,
        other=other_in,
        ego_left=ego_left,
        other_left=other_left,
        least=carry.least.add(jnp.min(jnp.where(found, pet, NONE)), t, found.any()),
    )
