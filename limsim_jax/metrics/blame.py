"""Contacts: type, fault, responsibility, and whether braking would have avoided them.

**Type and fault** follow nuPlan (`nuplan-devkit`, `no_ego_at_fault_collisions.py`). The first rule that
holds decides; a body counts once.

=================  ===========================================================  ==========================
type               rule                                                         ego at fault
=================  ===========================================================  ==========================
STOPPED_EGO        ego's speed <= 0.05 m/s                                      no
STOPPED_OTHER      other's speed <= 0.05 m/s                                    yes
REAR               centre of the other > 150 degrees off the ego's heading,     no
                   seen from the ego's rear axle
FRONT              the ego's front edge touches the other                       yes
LATERAL            otherwise                                                    if in several lanes or off
                                                                                the drivable area
=================  ===========================================================  ==========================

**Responsibility** (`Responsibility`) goes further, and treats both sides alike. A vehicle is a *hazard* from
the first step of the latest unbroken time in which the 2-D TTC with it was at most `HAZARD` s. At that
step two facts are noted for each side. The first is whether full braking (`b_max`, at once, along its
heading) would have avoided the contact with another vehicle of constant velocity
(`avoidable_by_braking`). The second is whether it was in several lanes. A side is responsible if

1. it broke a rule that gives the other priority (red light, wrong way, right of way), or
2. it is at fault by its type, and braking would have avoided the contact or it was changing lanes itself;
   a vehicle that keeps its lane and meets the front or the side of one that changes lanes is excused, or
3. it was changing lanes and the other side could not avoid the contact by braking.

Both sides: SHARED. Neither: UNAVOIDABLE. No braking would have avoided the contact from the first moment of
the hazard on, and neither side had broken a rule or caused the hazard by a lane change.
"""

from __future__ import annotations

import enum
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.metrics.reductions import Measured, measured
from limsim_jax.metrics.safety import (
    Encounter,
    delta_v,
    first_touch,
    greater,
    lesser,
    mirrored,
    overlaps,
    reach,
)

STOPPED = 0.05
"""m/s: a vehicle that is not faster stands, by nuPlan."""

HAZARD = 3.0
"""s: a vehicle with a TTC of at most this is a hazard."""


class ContactType(enum.IntEnum):
    """How the ego met the other vehicle, from the ego's side."""

    NONE = 0
    STOPPED_EGO = 1
    STOPPED_OTHER = 2
    FRONT = 3
    REAR = 4
    LATERAL = 5


class Responsibility(enum.IntEnum):
    """Side that is to blame for a contact."""

    NONE = 0
    EGO = 1
    OTHER = 2
    SHARED = 3
    UNAVOIDABLE = 4


def ahead(e: Encounter, rear_axle: Float[Array, "*#b"]) -> Bool[Array, "*b"]:
    """Whether the other vehicle is ahead: within 30 degrees of the ego's heading.

    Its centre counts, seen from the rear axle of the ego. `rear_axle`: m from the centre of the ego back to
    its axle.
    """
    x = e.x + rear_axle
    return (x > 0) & (x * x > 3 * e.y * e.y)  # tan(30 degrees)^2 = 1/3


def behind(e: Encounter, rear_axle: Float[Array, "*#b"]) -> Bool[Array, "*b"]:
    """Whether the other vehicle is behind: more than 150 degrees off the ego's heading."""
    x = e.x + rear_axle
    return (x < 0) & (x * x > 3 * e.y * e.y)


def contact_type(
    e: Encounter,
    v: Float[Array, "*b"],
    v_other: Float[Array, "*b"],
    rear_axle: Float[Array, "*#b"],
) -> Int[Array, "*b"]:
    """`ContactType` of boxes that touch; `v`, `v_other`: their speeds, m/s."""
    # the front edge is a box without length
    edge = e._replace(x=e.x - e.length / 2, length=jnp.zeros_like(e.length))
    kind = jnp.where(overlaps(edge), int(ContactType.FRONT), int(ContactType.LATERAL))
    kind = jnp.where(behind(e, rear_axle), int(ContactType.REAR), kind)
    kind = jnp.where(jnp.abs(v_other) <= STOPPED, int(ContactType.STOPPED_OTHER), kind)
    return jnp.where(jnp.abs(v) <= STOPPED, int(ContactType.STOPPED_EGO), kind)


def at_fault(kind: Int[Array, "*b"], several_lanes: Bool[Array, "*#b"]) -> Bool[Array, "*b"]:
    """Whether nuPlan blames the ego; `several_lanes`: its corners are in several lanes or off the road."""
    lateral = (kind == int(ContactType.LATERAL)) & several_lanes
    return (kind == int(ContactType.FRONT)) | (kind == int(ContactType.STOPPED_OTHER)) | lateral


def avoidable_by_braking(
    e: Encounter, v: Float[Array, "*#b"], b_max: Float[Array, "*#b"]
) -> Bool[Array, "*b"]:
    """Whether the ego avoids the other vehicle by braking from now on.

    The ego drives at `v` (m/s) and brakes with `b_max` (m/s^2) along its heading; the other vehicle keeps its
    velocity. In the axes of the ego both overlap in y during one interval of time only. With x the distance
    of the centres ahead, `x(t) = x0 + u_o t - (v t - b t^2 / 2)` until the ego stands, then a line. x is
    convex. Its values in the interval lie between its least (at an end, or where the speeds are equal) and
    the greater of those at the ends. The boxes meet if that range meets [-E, E], with E the sum of their
    half lengths along x. An oblique box counts with its bounding box in the axes of the ego.
    """
    along, across = reach(e)
    v = jnp.broadcast_to(v, e.x.shape)
    speed = jnp.where(v > 0, v, 0)
    brake = jnp.broadcast_to(b_max, e.x.shape)
    zero = jnp.zeros_like(e.x)
    horizon = jnp.full_like(e.x, 30.0)  # s: by then a braking ego stands
    # when the other is in the way
    still = jnp.abs(e.w) < 1e-6
    inverse = 1 / jnp.where(still, 1.0, e.w)
    middle, half = -e.y * inverse, across * jnp.abs(inverse)
    low = jnp.where(still, 0, greater(middle - half, zero))
    high = jnp.where(still, jnp.where(jnp.abs(e.y) <= across, horizon, -1), lesser(middle + half, horizon))
    other_speed = e.u + v
    stop = speed / brake

    def x(t: Float[Array, "*b"]) -> Float[Array, "*b"]:
        moving = lesser(t, stop)
        return e.x + other_speed * t - (speed - brake / 2 * moving) * moving

    equal = jnp.where(other_speed < 0, high, (speed - other_speed) / brake)
    least = x(greater(lesser(equal, high), low))
    most = greater(x(low), x(high))
    meets = (high >= low) & (least <= along) & (most >= -along)
    return ~meets


class Onset(NamedTuple):
    """How a hazard began."""

    avoidable: Bool[Array, "*b"]  # by the ego's braking
    other_avoidable: Bool[Array, "*b"]  # by the other's braking
    changing: Bool[Array, "*b"]  # the ego was in several lanes
    other_changing: Bool[Array, "*b"]


class ContactCarry(NamedTuple):
    """Memory of `contact_update`; it describes the worst contact of the first step with any."""

    notes: Int[Array, " N"]  # bits: `Onset`, is a hazard, has touched the ego since it entered
    contacts: Int[Array, ""]
    faults: Int[Array, ""]  # those at fault by nuPlan's rules
    fault_now: Bool[Array, ""]  # one of them in this step
    time: Float[Array, ""]  # s, of the first contact
    other: Int[Array, ""]  # slot of the other, -1 for none
    kind: Int[Array, ""]  # ContactType
    fault: Bool[Array, ""]
    responsibility: Int[Array, ""]
    severity: Float[Array, ""]  # m/s, delta-v
    most_severe: Float[Array, ""]  # m/s, of all contacts

    @property
    def touched(self) -> Bool[Array, " N"]:
        """Vehicles that have touched the ego since they entered."""
        return (self.notes & _TOUCHED) > 0


_HAZARD, _TOUCHED = 16, 32
_SLOTS = 2**12  # slots at most, in the low bits of a key
_SEVERITY = 16.0  # steps per m/s in a key, up to 256 m/s


def contact_init(vehicles: int) -> ContactCarry:
    """No contact, no hazard. Raises `ValueError` for more than 4096 slots."""
    if vehicles > _SLOTS:
        raise ValueError(f"{vehicles} slots; contacts are distinguished in up to {_SLOTS}")
    zero, none, no = jnp.zeros(()), jnp.zeros((), jnp.int32), jnp.zeros((), bool)
    return ContactCarry(
        notes=jnp.zeros(vehicles, jnp.int32),
        contacts=none,
        faults=none,
        fault_now=no,
        time=zero,
        other=none - 1,
        kind=none,
        fault=no,
        responsibility=none,
        severity=zero,
        most_severe=zero,
    )


def responsibility(
    *,
    kind: Int[Array, "*b"],
    other_kind: Int[Array, "*b"],
    violation: Bool[Array, "*b"],
    other_violation: Bool[Array, "*b"],
    onset: Onset,
) -> Int[Array, "*b"]:
    """`Responsibility` by the rules of this module; `other_kind` is the type from the other's side."""

    def to_blame(
        kind: Int[Array, "*b"],
        met: Int[Array, "*b"],
        violation: Bool[Array, "*b"],
        changing: Bool[Array, "*b"],
        avoidable: Bool[Array, "*b"],
        met_changing: Bool[Array, "*b"],
        met_avoidable: Bool[Array, "*b"],
    ) -> Bool[Array, "*b"]:
        driven_into = (met == int(ContactType.FRONT)) | (met == int(ContactType.LATERAL))
        excused = met_changing & ~changing & driven_into
        by_type = at_fault(kind, changing) & (avoidable | changing) & ~excused
        return violation | by_type | (changing & ~met_avoidable)

    mine = (onset.changing, onset.avoidable)
    theirs = (onset.other_changing, onset.other_avoidable)
    ego = to_blame(kind, other_kind, violation, *mine, *theirs)
    other = to_blame(other_kind, kind, other_violation, *theirs, *mine)
    one = jnp.where(ego, int(Responsibility.EGO), int(Responsibility.UNAVOIDABLE))
    two = jnp.where(ego, int(Responsibility.SHARED), int(Responsibility.OTHER))
    return jnp.where(other, two, one)


class ContactStep(NamedTuple):
    """A step of one ego among `N` others, for `contact_update`."""

    t: Float[Array, ""]  # s
    e: Encounter  # [N]
    begin: Float[Array, " N"]  # s from now, `safety.contact_interval` of `e`
    cease: Float[Array, " N"]
    there: Bool[Array, " N"]  # not the ego itself, not an empty slot
    v: Float[Array, ""]  # m/s
    v_others: Float[Array, " N"]
    changing: Bool[Array, ""]  # in several lanes, or off the drivable area
    others_changing: Bool[Array, " N"]
    violation: Bool[Array, ""]  # drives where another one has priority
    other_violations: Bool[Array, " N"]
    rear_axle: Float[Array, ""]  # m, from the centre of the body back to the axle
    b_max: Float[Array, ""]  # m/s^2, hardest braking
    others_b_max: Float[Array, " N"]


def contact_update(carry: ContactCarry, step: ContactStep) -> ContactCarry:
    """One step.

    A slot must be seen empty before another vehicle counts as new in it. The rear axle of the others is
    taken to be where the ego's is.
    """
    there = step.there
    touching = there & (step.begin <= 0) & (step.cease >= 0)
    new = touching & ~carry.touched
    v_ego = jnp.broadcast_to(step.v, there.shape)
    fault = at_fault(contact_type(step.e, v_ego, step.v_others, step.rear_axle), step.changing)
    severity = delta_v(v_ego, step.v_others, step.e.cos)
    notes = _notes(carry, step, touching)
    worst = _worst(new, fault, severity)
    kind, blame = _judged(notes, step, worst)
    number = jnp.sum(new, dtype=jnp.int32)
    faults = jnp.sum(new & fault, dtype=jnp.int32)
    first = (number > 0) & (carry.contacts == 0)
    return ContactCarry(
        notes=notes,
        contacts=carry.contacts + number,
        faults=carry.faults + faults,
        fault_now=faults > 0,
        time=jnp.where(first, step.t, carry.time),
        other=jnp.where(first, worst, carry.other),
        kind=jnp.where(first, kind, carry.kind),
        fault=jnp.where(first, at_fault(kind, step.changing), carry.fault),
        responsibility=jnp.where(first, blame, carry.responsibility),
        severity=jnp.where(first, severity[worst], carry.severity),
        most_severe=jnp.maximum(carry.most_severe, jnp.max(jnp.where(new, severity, 0))),
    )


def _notes(carry: ContactCarry, step: ContactStep, touching: Bool[Array, " N"]) -> Int[Array, " N"]:
    """The notes after a step: how each hazard began, whether it goes on, contacts since entry."""
    there = step.there
    hazard = there & (first_touch(step.begin, step.cease) <= HAZARD)
    onset = (
        avoidable_by_braking(step.e, step.v, step.b_max),
        avoidable_by_braking(mirrored(step.e), step.v_others, step.others_b_max),
        jnp.broadcast_to(step.changing, there.shape),
        step.others_changing,
    )
    fresh = sum((jnp.where(flag, 1 << k, 0) for k, flag in enumerate(onset)), jnp.zeros_like(carry.notes))
    goes_on = (carry.notes & _HAZARD) > 0
    notes = jnp.where(goes_on, carry.notes, fresh) & (_HAZARD - 1)
    notes |= jnp.where(hazard, _HAZARD, 0)
    return notes | jnp.where(there & (touching | carry.touched), _TOUCHED, 0)


def _worst(new: Bool[Array, " N"], fault: Bool[Array, " N"], severity: Float[Array, " N"]) -> Int[Array, ""]:
    """Slot of the worst new contact in a step: at fault first, then the hardest, then the last slot."""
    slots = jnp.arange(new.shape[0], dtype=jnp.int32)
    rank = (severity * _SEVERITY).astype(jnp.int32) + jnp.where(fault, 2**13, 0)
    return jnp.max(jnp.where(new, rank * _SLOTS + slots, 0)) % _SLOTS


def _judged(
    notes: Int[Array, " N"], step: ContactStep, worst: Int[Array, ""]
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """`ContactType` and `Responsibility` of a contact with the vehicle in slot `worst`."""
    v, v_other = step.v, step.v_others[worst]
    pair: Encounter = jax.tree.map(lambda x: x[worst], step.e)
    kind = contact_type(pair, v, v_other, step.rear_axle)
    other_kind = contact_type(mirrored(pair), v_other, v, step.rear_axle)
    began = Onset(*((notes[worst] & (1 << k)) > 0 for k in range(4)))
    blame = responsibility(
        kind=kind,
        other_kind=other_kind,
        violation=step.violation,
        other_violation=step.other_violations[worst],
        onset=began._replace(
            changing=began.changing | step.changing,
            other_changing=began.other_changing | step.others_changing[worst],
        ),
    )
    return kind, blame


def contact_result(carry: ContactCarry) -> dict[str, Measured]:
    """Counts, and the first contact in detail, which is invalid without one."""
    any_contact = carry.contacts > 0

    def number(x: Array) -> Float[Array, ""]:
        return x.astype(carry.time.dtype)

    return {
        "contacts": measured(number(carry.contacts)),
        "at_fault_contacts": measured(number(carry.faults)),
        "contact_time": measured(carry.time, any_contact),
        "contact_other": measured(number(carry.other), any_contact),
        "contact_type": measured(number(carry.kind), any_contact),
        "contact_at_fault": measured(number(carry.fault), any_contact),
        "contact_responsibility": measured(number(carry.responsibility), any_contact),
        "contact_delta_v": measured(carry.severity, any_contact),
        "max_delta_v": measured(carry.most_severe, any_contact),
    }
