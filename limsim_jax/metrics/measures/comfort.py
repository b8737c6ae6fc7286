"""Comfort: extremes and root mean squares of accelerations, jerk and yaw, filtered as nuPlan does."""

from __future__ import annotations

from dataclasses import dataclass

from limsim_jax.metrics.description import Better, Description, Plot
from limsim_jax.metrics.measure import Derived, Measure, Summary
from limsim_jax.metrics.motion import Filtered, MotionCarry, motion_init, motion_update
from limsim_jax.metrics.reductions import Measured
from limsim_jax.metrics.step import StepView

_SOURCE = "nuplan-devkit, state_extractors.py"
_SHORT = "The ego was on the road for no full step."


def _column(name: str, meaning: str, better: Better, formula: str, plot: Plot | None = None) -> Description:
    return Description(
        name, meaning, "Comfort", better, formula=formula, source=_SOURCE, missing=_SHORT, plot=plot
    )


@dataclass(frozen=True)
class Comfort(Measure):
    """Filtered accelerations, jerk and yaw.

    Attributes:
      dt: s between steps.
    """

    dt: float

    name = "motion"
    columns = (
        _column(
            "min_acceleration", "m/s^2, hardest braking, filtered", "higher",
            "Least acceleration along the heading, after a Savitzky-Golay filter (window 0.8 s, order 2).",
            Plot("Hardest braking", "m/s²"),
        ),
        _column(
            "max_acceleration", "m/s^2, filtered", "neither",
            "Greatest acceleration along the heading, filtered as min_acceleration.",
        ),
        _column(
            "max_lateral_acceleration", "m/s^2, absolute, filtered", "lower",
            "Greatest |v x yaw rate|, filtered as min_acceleration.",
            Plot("Highest lateral acceleration", "m/s²"),
        ),
        _column(
            "max_jerk", "m/s^3, absolute, of the magnitude of the acceleration, filtered", "lower",
            "Greatest |derivative| (window 1.5 s, order 2) of the filtered magnitude of the acceleration.",
            Plot("Highest jerk", "m/s³"),
        ),
        _column(
            "max_longitudinal_jerk", "m/s^3, absolute, filtered", "lower",
            "Greatest |derivative| (window 1.5 s, order 2) of the filtered acceleration along the heading.",
        ),
        _column(
            "max_yaw_acceleration", "rad/s^2, absolute, filtered", "lower",
            "Greatest |second derivative| of the heading (window 0.5 s, order 3).",
        ),
        _column(
            "max_yaw_rate", "rad/s, absolute, filtered", "lower",
            "Greatest |first derivative| of the heading (window 0.5 s, order 2).",
        ),
        _column(
            "rms_acceleration", "m/s^2, along, filtered", "lower",
            "Root mean square of the filtered acceleration."
        ),
        _column("rms_jerk", "m/s^3, along, filtered", "lower", "Root mean square of the filtered jerk along "
        "the heading."),
        Description(
            "comfortable", "1 if within nuPlan's bounds of comfort", "Comfort", "higher", "proportion",
            formula="All extremes above within limsim_jax.metrics.motion.COMFORT at all times.",
            source="nuplan-devkit, ego_*.yaml",
            missing=_SHORT,
        ),
    )  # fmt: skip

    def init(self, slots: int, zones: int) -> MotionCarry:
        """No sample."""
        return motion_init(self.dt)

    def advance(self, carry: MotionCarry, step: StepView) -> tuple[MotionCarry, Filtered]:
        """Filter the samples of this step; the other measures read what comes out."""
        return motion_update(self.dt, carry, t=step.time, v=step.v, a=step.a, heading=step.ego_box[2])

    def update(self, carry: MotionCarry, step: StepView, derived: Derived) -> MotionCarry:
        """What `advance` found."""
        return derived.motion

    def result(self, carry: MotionCarry, summary: Summary) -> dict[str, Measured]:
        """All columns."""
        return summary.comfort
