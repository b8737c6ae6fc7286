"""RSS: shares of the time in which the ego was too near to others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from limsim_jax.metrics.description import Description
from limsim_jax.metrics.measure import Derived, Measure, Summary
from limsim_jax.metrics.reductions import Least, Mean, Measured
from limsim_jax.metrics.safety import Rss, reach, rss_lateral, rss_longitudinal
from limsim_jax.metrics.step import StepView

_SOURCE = "Shalev-Shwartz, Shammah and Shashua 2017, arXiv 1708.06374"
_NO_STEP = "The ego was on the road for no full step."


class RssCarry(NamedTuple):
    """Memory of `ResponsibilityDistances`."""

    longitudinal: Mean
    lateral: Mean
    no_response: Mean
    since: Float[Array, ""]  # s that the distance to the leader has been unsafe
    first: Least


@dataclass(frozen=True)
class ResponsibilityDistances(Measure):
    """Safe distances of RSS, to the leader and to vehicles beside.

    Attributes:
      rss: parameters of RSS.
    """

    rss: Rss

    name = "rss"
    columns = (
        Description(
            "rss_longitudinal", "share of the time too near to the leader by RSS", "Safety", "lower",
            formula="Steps with a gap below the safe distance of Lemma 2, of all steps.",
            source=f"{_SOURCE}, Lemma 2",
            missing=_NO_STEP,
        ),
        Description(
            "rss_lateral", "share of the time too near to a vehicle beside by RSS", "Safety", "lower",
            formula="Steps with a lateral gap below the safe distance of Lemma 4, to a vehicle that "
            "overlaps the ego "
            "along its axis and drives the same way, of all steps.",
            source=f"{_SOURCE}, Lemma 4",
            missing=_NO_STEP,
        ),
        Description(
            "rss_no_response",
            "share of the time too near to the leader beyond the response time and not braking", "Safety",
            "lower",
            formula="Steps in which rss_longitudinal has been broken for longer than the response time "
            "while the ego "
            "brakes less than RSS asks for, of all steps.",
            source=_SOURCE,
            missing=_NO_STEP,
        ),
        Description(
            "rss_first_time", "s, when RSS was first broken", "Safety",
            formula="Time of the first step that counts for rss_longitudinal or rss_lateral.",
            missing="RSS was kept.",
        ),
    )  # fmt: skip

    def init(self, slots: int, zones: int) -> RssCarry:
        """No distance yet."""
        return RssCarry(Mean.empty(), Mean.empty(), Mean.empty(), jnp.zeros(()), Least.empty())

    def update(self, carry: RssCarry, step: StepView, derived: Derived) -> RssCarry:
        """Judge the distances of this step."""
        t, dt, rss = step.time, step.dt, self.rss
        unsafe = step.has_leader & (step.gap < rss_longitudinal(step.v, step.v_leader, rss))
        tight = self._tight(step)
        since = jnp.where(unsafe, carry.since + dt, 0)
        idle = unsafe & (since > rss.response + dt / 2) & (step.a > -rss.brake + 0.01) & (step.v > 0.1)

        def share(mean: Mean, flag: Bool[Array, ""]) -> Mean:
            return mean.add(flag.astype(t.dtype), step.drove)

        return RssCarry(
            longitudinal=share(carry.longitudinal, unsafe),
            lateral=share(carry.lateral, tight),
            no_response=share(carry.no_response, idle),
            since=since,
            first=carry.first.add(t, t, unsafe | tight),
        )

    def _tight(self, step: StepView) -> Bool[Array, ""]:
        """Whether a vehicle beside is nearer than RSS allows."""
        e = step.encounter
        along, across = reach(e)
        cos, sin = step.lane_direction
        sideways = cos * step.velocity[:, 1] - sin * step.velocity[:, 0]
        side = jnp.sign(e.y)
        w = side * (cos * step.ego_velocity[1] - sin * step.ego_velocity[0])
        w_other = -side * sideways
        beside = step.apart & (jnp.abs(e.x) <= along) & (e.cos > 0.7)
        return (beside & (jnp.abs(e.y) - across < rss_lateral(w, w_other, self.rss))).any()

    def result(self, carry: RssCarry, summary: Summary) -> dict[str, Measured]:
        """All columns."""
        return {
            "rss_longitudinal": carry.longitudinal.result(),
            "rss_lateral": carry.lateral.result(),
            "rss_no_response": carry.no_response.result(),
            "rss_first_time": carry.first.when(),
        }
