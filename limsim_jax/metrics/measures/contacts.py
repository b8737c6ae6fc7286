"""Contacts: how many, how hard, and whose fault."""

from __future__ import annotations

from limsim_jax.metrics.blame import ContactCarry, ContactStep, contact_init, contact_result, contact_update
from limsim_jax.metrics.description import Description, Plot
from limsim_jax.metrics.measure import Derived, Measure, Summary
from limsim_jax.metrics.reductions import Measured, measured
from limsim_jax.metrics.step import StepView

_NUPLAN = "nuplan-devkit, no_ego_at_fault_collisions.py"
_NONE = "There was no contact."


class Contacts(Measure):
    """Bodies touched, and the first contact in detail."""

    name = "contacts"
    columns = (
        Description(
            "contacts", "bodies touched", "Safety", "lower",
            formula="Vehicles whose boxes overlapped that of the ego; each counts once.",
        ),
        Description(
            "at_fault_contacts", "of them by the ego's fault by nuPlan's rules", "Safety", "lower",
            formula="Contacts of type FRONT or STOPPED_OTHER, and LATERAL while the ego is in several lanes "
            "or off "
            "the road.",
            source=_NUPLAN,
        ),
        Description(
            "contact_time", "s, first contact", "Safety",
            formula="Time of the step with the first contact.",
            missing=_NONE,
        ),
        Description(
            "contact_other", "slot of the first body touched", "Safety", kind="label",
            formula="Of several in one step the one at the ego's fault, then the hardest.",
            missing=_NONE,
        ),
        Description(
            "contact_type", "blame.ContactType of the first contact", "Safety", kind="label",
            formula="1 STOPPED_EGO, 2 STOPPED_OTHER, 3 FRONT, 4 REAR, 5 LATERAL.",
            source=_NUPLAN,
            missing=_NONE,
        ),
        Description(
            "contact_at_fault", "1 if the first contact is the ego's fault by nuPlan's rules", "Safety",
            "lower",
            "proportion",
            formula="As at_fault_contacts.",
            source=_NUPLAN,
            missing=_NONE,
        ),
        Description(
            "contact_responsibility", "blame.Responsibility for the first contact", "Safety", kind="label",
            formula="1 EGO, 2 OTHER, 3 SHARED, 4 UNAVOIDABLE, by the rules of limsim_jax.metrics.blame.",
            missing=_NONE,
        ),
        Description(
            "contact_delta_v", "m/s, severity of the first contact", "Safety", "lower",
            formula="Change of the ego's velocity in a plastic impact of equal masses.",
            source="nuplan-devkit, collision_utils.py",
            missing=_NONE,
        ),
        Description(
            "max_delta_v", "m/s, severity of the worst contact", "Safety", "lower",
            formula="Greatest delta-v of all contacts.",
            source="nuplan-devkit, collision_utils.py",
            missing=_NONE,
            plot=Plot("Delta-v of the worst contact", "m/s"),
        ),
    )  # fmt: skip

    def init(self, slots: int, zones: int) -> ContactCarry:
        """No contact."""
        return contact_init(slots)

    def advance(self, carry: ContactCarry, step: StepView) -> ContactCarry:
        """Judge the contacts of this step; the other measures read what it finds."""
        record, slot = step.record, step.slot
        begin, cease = step.contact_interval
        return contact_update(
            carry,
            ContactStep(
                t=step.time,
                e=step.encounter,
                begin=begin,
                cease=cease,
                there=step.others,
                v=step.v,
                v_others=step.speeds,
                changing=record.changing[slot],
                others_changing=record.changing,
                violation=record.violation[slot],
                other_violations=record.violation,
                rear_axle=record.rear_axle,
                b_max=record.b_max[slot],
                others_b_max=record.b_max,
            ),
        )

    def update(self, carry: ContactCarry, step: StepView, derived: Derived) -> ContactCarry:
        """What `advance` found."""
        return derived.contacts

    def result(self, carry: ContactCarry, summary: Summary) -> dict[str, Measured]:
        """All columns."""
        found = contact_result(carry)
        return {name: measured(value, valid & summary.started) for name, (value, valid) in found.items()}
