"""Proximity: time to collision, headway, braking needed, post-encroachment time, distance."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.metrics.description import Description, Headline, Plot
from limsim_jax.metrics.measure import Derived, Measure, Summary
from limsim_jax.metrics.reductions import Episodes, Least, LeastWith, Measured, measured
from limsim_jax.metrics.safety import (
    EXPOSED,
    NEAR_MISS,
    NO_GAP,
    NONE,
    PetCarry,
    distance,
    drac,
    pet_init,
    pet_update,
    time_headway,
)
from limsim_jax.metrics.step import StepView

_HAYWARD = "Hayward 1972"
_NO_COLLISION = "No vehicle was on a course to collide with the ego."
_NO_NEAR_MISS = "No TTC that counts was below 1.5 s."
_NO_LEADER = "No vehicle led the ego on its lane."


class TtcCarry(NamedTuple):
    """Memory of `TimeToCollision`."""

    both: LeastWith
    lane: Least
    boxes: Least
    exposed: Float[Array, ""]  # s
    urgent: LeastWith
    near: Episodes
    near_contact: Bool[Array, ""]  # the near miss that goes on has become a contact
    near_contacts: Int[Array, ""]


class TimeToCollision(Measure):
    """Least times to collision, and near misses."""

    name = "ttc"
    columns = (
        Description(
            "min_ttc", "s, least time to collision of both kinds", "Safety", "higher",
            formula="Least of min_ttc_1d and min_ttc_2d over all steps.",
            source=_HAYWARD,
            missing=_NO_COLLISION,
            headline=Headline(10, "least TTC, median", "median", "s"),
            plot=Plot("Least TTC", "s"),
        ),
        Description(
            "min_ttc_time", "s, when", "Safety",
            formula="Time of the first step with the value of min_ttc.",
            missing=_NO_COLLISION,
        ),
        Description(
            "min_ttc_other", "slot of the vehicle with min_ttc", "Safety", kind="label",
            formula="At min_ttc_time.",
            missing=_NO_COLLISION,
        ),
        Description(
            "min_ttc_1d", "s, least TTC with the leader on the lane", "Safety", "higher",
            formula="gap / (v - v of the leader) where the ego is faster.",
            source=_HAYWARD,
            missing="The ego was never faster than a leader.",
        ),
        Description(
            "min_ttc_2d", "s, least TTC of bodies in the plane", "Safety", "higher",
            formula="First time at which boxes that keep their velocity overlap, by the separating axes of "
            "moving boxes. Below 5 s the boxes must also meet along their lanes and lane changes, looked at "
            "every 0.25 s; the later time counts. A follower counts if it would have to brake harder than "
            "3.4 m/s^2.",
            source=_HAYWARD,
            missing=_NO_COLLISION,
        ),
        Description(
            "ttc_exposed", "s with a TTC below 3 s", "Safety", "lower",
            formula="Time of all steps with a TTC below 3 s.",
            source="Minderhoud and Bovy 2001 (time exposed TTC)",
        ),
        Description(
            "near_misses", "times that the TTC fell below 1.5 s, without those that ended in a contact",
            "Safety",
            "lower",
            formula="Begins when the TTC falls below 1.5 s and ends when it exceeds 2 s. Of two vehicles one "
            "behind the other it counts if the one behind would have to brake harder than 3.4 m/s^2.",
        ),
        Description(
            "near_miss_ttc", "s, least TTC of a near miss or contact", "Safety", "higher",
            formula="Least TTC that counts for near_misses.",
            missing=_NO_NEAR_MISS,
        ),
        Description(
            "near_miss_time", "s, when", "Safety",
            formula="Time of the first step with the value of near_miss_ttc.",
            missing=_NO_NEAR_MISS,
        ),
        Description(
            "near_miss_other", "slot of the vehicle with near_miss_ttc", "Safety", kind="label",
            formula="At near_miss_time.",
            missing=_NO_NEAR_MISS,
        ),
    )  # fmt: skip

    def init(self, slots: int, zones: int) -> TtcCarry:
        """Nothing met."""
        empty, no = Least.empty(), jnp.zeros((), bool)
        return TtcCarry(
            both=LeastWith.empty(),
            lane=empty,
            boxes=empty,
            exposed=jnp.zeros(()),
            urgent=LeastWith.empty(),
            near=Episodes.empty(),
            near_contact=no,
            near_contacts=jnp.zeros((), jnp.int32),
        )

    def update(self, carry: TtcCarry, step: StepView, derived: Derived) -> TtcCarry:
        """Add the times to collision of this step."""
        t, least = step.time, step.least_ttc
        urgent, urgent_other = step.urgent_ttc
        near = carry.near.add(urgent < NEAR_MISS[0], urgent > NEAR_MISS[1])
        near_contact = near.inside & (carry.near_contact | derived.hit)
        begun = (near_contact & ~carry.near_contact).astype(jnp.int32)
        return TtcCarry(
            both=carry.both.add(least, t, least < NONE, step.least_ttc_other),
            lane=carry.lane.add(step.least_ttc_1d, t, step.least_ttc_1d < NONE),
            boxes=carry.boxes.add(step.least_ttc_2d, t, step.least_ttc_2d < NONE),
            exposed=carry.exposed + jnp.where(step.drove & (least < EXPOSED), step.dt, 0),
            urgent=carry.urgent.add(urgent, t, urgent < NEAR_MISS[0], urgent_other),
            near=near,
            near_contact=near_contact,
            near_contacts=carry.near_contacts + begun,
        )

    def result(self, carry: TtcCarry, summary: Summary) -> dict[str, Measured]:
        """All columns."""
        both, urgent = carry.both, carry.urgent
        return {
            "min_ttc": both.least.result(),
            "min_ttc_time": both.least.when(),
            "min_ttc_other": both.other(),
            "min_ttc_1d": carry.lane.result(),
            "min_ttc_2d": carry.boxes.result(),
            "ttc_exposed": measured(carry.exposed, summary.started),
            "near_miss_ttc": urgent.least.result(),
            "near_miss_time": urgent.least.when(),
            "near_miss_other": urgent.other(),
            "near_misses": summary.number(carry.near.number - carry.near_contacts),
        }


class FollowingCarry(NamedTuple):
    """Memory of `Following`."""

    thw: Least
    drac: LeastWith  # of the negative


class Following(Measure):
    """Headway to the leader, and the braking that it asks for."""

    name = "following"
    columns = (
        Description(
            "min_thw", "s, least time headway", "Safety", "higher",
            formula="gap / v.",
            missing=_NO_LEADER,
            plot=Plot("Least time headway", "s"),
        ),
        Description(
            "max_drac", "m/s^2, hardest braking that the leader asked for (1-D)", "Safety", "lower",
            formula="(v - v of the leader)^2 / (2 gap) where the ego is faster; a gap counts as 1 cm at "
            "least.",
            source="Cooper and Ferguson 1976",
            missing=_NO_LEADER,
            plot=Plot("Highest DRAC", "m/s²"),
        ),
        Description(
            "max_drac_time", "s, when", "Safety",
            formula="Time of the first step with the value of max_drac.",
            missing=_NO_LEADER,
        ),
        Description(
            "max_drac_other", "slot of that leader", "Safety", kind="label",
            formula="At max_drac_time.",
            missing=_NO_LEADER,
        ),
    )  # fmt: skip

    def init(self, slots: int, zones: int) -> FollowingCarry:
        """No leader yet."""
        return FollowingCarry(Least.empty(), LeastWith.empty())

    def update(self, carry: FollowingCarry, step: StepView, derived: Derived) -> FollowingCarry:
        """Add headway and braking of this step."""
        t, thw = step.time, time_headway(step.gap, step.v)
        asked = drac(step.gap, step.v, step.v_leader)
        return FollowingCarry(
            thw=carry.thw.add(thw, t, thw < NONE),
            drac=carry.drac.add(-asked, t, step.has_leader, step.leader),
        )

    def result(self, carry: FollowingCarry, summary: Summary) -> dict[str, Measured]:
        """All columns."""
        least = carry.drac.least.result()
        return {
            "min_thw": carry.thw.result(),
            "max_drac": measured(-least.value, least.valid),
            "max_drac_time": carry.drac.least.when(),
            "max_drac_other": carry.drac.other(),
        }


class PostEncroachment(Measure):
    """Post-encroachment time in the conflict zones of the ego."""

    name = "pet"
    columns = (
        Description(
            "min_pet", "s, least post-encroachment time", "Safety", "higher",
            formula="Time from one vehicle leaving a conflict zone to the other entering it; 0 if both are "
            "inside.",
            source="Allen, Shin and Cooper 1978",
            missing="No conflict zone was passed by both the ego and another vehicle.",
            plot=Plot("Least post-encroachment time", "s"),
        ),
        Description(
            "min_pet_time", "s, when", "Safety",
            formula="Time at which the second vehicle enters.",
            missing="As min_pet.",
        ),
    )  # fmt: skip

    def init(self, slots: int, zones: int) -> PetCarry:
        """No zone has been entered."""
        return pet_init(zones)

    def update(self, carry: PetCarry, step: StepView, derived: Derived) -> PetCarry:
        """Add the zones of this step."""
        return pet_update(carry, step.time, step.record.zones)

    def result(self, carry: PetCarry, summary: Summary) -> dict[str, Measured]:
        """All columns."""
        return {"min_pet": carry.least.result(), "min_pet_time": carry.least.when()}


class Distance(Measure):
    """Least distance between bodies."""

    name = "distance"
    columns = (
        Description(
            "min_distance", "m, least distance to another body", "Safety", "higher",
            formula="Euclidean distance of the boxes, on the level of the ego; 0 where they overlap.",
            missing="No other vehicle was there.",
            plot=Plot("Least distance to another body", "m"),
        ),
    )  # fmt: skip

    def init(self, slots: int, zones: int) -> Least:
        """No other vehicle yet."""
        return Least.empty()

    def update(self, carry: Least, step: StepView, derived: Derived) -> Least:
        """Add the nearest body of this step."""
        nearest = jnp.min(jnp.where(step.apart, distance(step.encounter, step.touches), NO_GAP))
        return carry.add(nearest, step.time, nearest < NO_GAP)

    def result(self, carry: Least, summary: Summary) -> dict[str, Measured]:
        """The column."""
        return {"min_distance": carry.result()}
