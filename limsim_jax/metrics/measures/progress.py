"""Progress: whether, how far and how fast the ego drives along its route."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from limsim_jax.metrics.description import Description, Headline, Plot
from limsim_jax.metrics.measure import Derived, Measure, Summary
from limsim_jax.metrics.reductions import Measured, measured
from limsim_jax.metrics.step import StepView
from limsim_jax.numerics import safe_divide


class ProgressCarry(NamedTuple):
    """Memory of `Progress`."""

    to_go: Float[Array, " 2"]  # m along the route to the goal, at the start and now
    distance: Float[Array, ""]  # m


class Progress(Measure):
    """Arrival, route completion, distance and speed."""

    name = "progress"
    columns = (
        Description(
            "arrived", "1 if the ego reached its goal", "Drive and rules", "higher", "proportion",
            formula="The front bumper passes the end of a lane of the goal, or the ego leaves the map there.",
        ),
        Description(
            "success", "1 if it did without any contact and without leaving the road", "Drive and rules",
            "higher", "proportion",
            formula="arrived, contacts = 0, never off_road and no policy_failed; an experiment may set its "
            "own criteria in [success], which an episode with policy_failed never meets.",
            headline=Headline(1, "success", unit="%", scale=100),
        ),
        Description(
            "out_of_time", "1 if the ego was still on its way when the time was up", "Drive and rules",
            "lower", "proportion",
            formula="On the road at the horizon, without arrival, contact, departure from the road or "
            "policy_failed.",
            headline=Headline(2, "out of time", unit="%", scale=100, rare=True),
        ),
        Description(
            "completion", "share of the route driven", "Drive and rules", "higher",
            formula="progress / length of the route at the start, limited to 0 to 1; 1 on arrival.",
            headline=Headline(3, "route completed", unit="%", scale=100),
        ),
        Description(
            "completion_time", "s until the goal", "Drive and rules", "lower",
            formula="Time from the first step of the ego to its arrival.",
            missing="The ego did not arrive.",
            plot=Plot("Time to the goal", "s"),
        ),
        Description(
            "duration", "s that the ego was there", "Drive and rules",
            formula="Time from the first step of the ego to its last one.",
        ),
        Description(
            "distance", "m driven", "Drive and rules",
            formula="Sum of speed x dt over all steps after the start."
        ),
        Description(
            "progress", "m nearer to the goal along the route", "Drive and rules", "higher",
            formula="Length of the route to the goal at the start less that at the end.",
        ),
        Description(
            "mean_speed", "m/s", "Drive and rules", "higher",
            formula="distance / duration.",
            missing="The ego was on the road for no full step.",
            headline=Headline(14, "mean speed", unit="m/s"),
            plot=Plot("Mean speed of the ego", "m/s"),
        ),
        Description(
            "policy_failed", "1 if the policy raised an exception or gave a command that is not finite",
            "Drive and rules", "lower", "proportion",
            formula="Status.NOT_FINITE of the ego. The episode ends there, without success and with "
            "scores of 0; the ego brakes to a standstill.",
            headline=Headline(0, "POLICY FAILED", unit="%", scale=100, rare=True),
        ),
        Description(
            "policy_failed_time", "s, when it did", "Drive and rules",
            formula="Time of the first step after the broken command.",
            missing="The policy did not fail.",
        ),
    )  # fmt: skip

    def init(self, slots: int, zones: int) -> ProgressCarry:
        """Nothing driven."""
        return ProgressCarry(jnp.zeros(2), jnp.zeros(()))

    def update(self, carry: ProgressCarry, step: StepView, derived: Derived) -> ProgressCarry:
        """Add the distance of this step."""
        to_go = step.record.to_go
        first = jnp.where(step.drove, carry.to_go[0], to_go)
        return self.advance(carry._replace(to_go=jnp.stack([first, to_go])), to_go, step.driven)

    def advance(
        self, carry: ProgressCarry, to_go: Float[Array, ""], moved: Float[Array, ""]
    ) -> ProgressCarry:
        """Add `moved` (m), after which there are `to_go` (m) left."""
        return ProgressCarry(jnp.stack([carry.to_go[0], to_go]), carry.distance + moved)

    def result(self, carry: ProgressCarry, summary: Summary) -> dict[str, Measured]:
        """All columns."""
        speed = safe_divide(carry.distance, summary.duration)
        return {
            "arrived": summary.number(summary.arrived),
            "success": summary.number(summary.arrived & ~summary.failed),
            "out_of_time": summary.number(summary.there & ~summary.failed),
            "completion": measured(summary.completion, summary.started),
            "completion_time": measured(summary.duration, summary.arrived),
            "duration": measured(summary.duration, summary.started),
            "distance": measured(carry.distance, summary.started),
            "progress": measured(summary.progress, summary.started),
            "mean_speed": measured(speed, summary.judged),
            "policy_failed": summary.number(summary.broken),
            "policy_failed_time": measured(summary.now, summary.broken),
        }
