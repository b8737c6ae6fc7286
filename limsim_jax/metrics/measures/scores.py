"""Driving scores of nuPlan, the CARLA leaderboard and LimSim++ as measures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.metrics.blame import ahead, behind
from limsim_jax.metrics.description import Better, Description, Headline, Kind, Plot
from limsim_jax.metrics.measure import Derived, Measure, Summary
from limsim_jax.metrics.reductions import Measured, measured
from limsim_jax.metrics.scores import (
    CARLA_RADIUS,
    CARLA_STANDS,
    LimSimCarry,
    LimSimStep,
    Number,
    NuPlanEpisode,
    carla_score,
    limsim_corrected,
    limsim_faithful,
    limsim_init,
    limsim_update,
    nuplan_score,
    nuplan_ttc,
)
from limsim_jax.metrics.step import StepView
from limsim_jax.numerics import safe_divide, safe_norm

_NO_STEP = "The ego was on the road for no full step, and did not fail."


def _nuplan(
    name: str, meaning: str, formula: str, kind: Kind = "mean", *, score: bool = False
) -> Description:
    return Description(
        name, meaning, "Scores", "higher", kind, formula, "nuplan-devkit, closed-loop metric aggregator",
        _NO_STEP, Headline(11, "nuPlan score", unit="of 1") if score else None,
        Plot("nuPlan score", "of 1") if score else None,
    )  # fmt: skip


class NuPlanCarry(NamedTuple):
    """Memory of `NuPlan`."""

    ttc_kept: Bool[Array, ""]
    reference: Float[Array, ""]  # m, at the speed limit


class NuPlan(Measure):
    """nuPlan's closed-loop score and its parts."""

    name = "nuplan"
    columns = (
        _nuplan(
            "nuplan_score", "0 to 1",
            "Product of the multipliers times the weighted mean of progress (5), ttc (5), speed_limit (4) "
            "and comfort (2); 0 with policy_failed.",
            score=True,
        ),
        _nuplan(
            "nuplan_no_at_fault_collisions", "0, 0.5 or 1, multiplier",
            "0 with a contact at the ego's fault, 1 without."
        ),
        _nuplan(
            "nuplan_drivable_area", "0 or 1, multiplier", "0 if the ego was ever off the drivable area.",
            "proportion"
        ),
        _nuplan(
            "nuplan_driving_direction", "0, 0.5 or 1, multiplier",
            "1 for against_flow below 2 m, 0.5 below 6 m, 0 above."
        ),
        _nuplan(
            "nuplan_making_progress", "0 or 1, multiplier", "1 if nuplan_progress is above 0.2.", "proportion"
        ),
        _nuplan(
            "nuplan_progress", "0 to 1, weight 5",
            "progress / that of the reference, at most 1; the reference drives at the speed limit for the "
            "same time, "
            "at most to the goal.",
        ),
        _nuplan(
            "nuplan_ttc", "0 or 1, weight 5",
            "1 if the TTC, on a grid of 0.1 s, never was 0.95 s or less to a vehicle ahead, or beside in a "
            "junction "
            "or a lane change.",
            "proportion",
        ),
        _nuplan("nuplan_speed_limit", "0 to 1, weight 4", "1 - overspeed / (2.23 m/s x duration), at least "
        "0."),
        _nuplan("nuplan_comfort", "0 or 1, weight 2", "comfortable.", "proportion"),
    )  # fmt: skip

    def init(self, slots: int, zones: int) -> NuPlanCarry:
        """Nothing broken."""
        return NuPlanCarry(jnp.ones((), bool), jnp.zeros(()))

    def update(self, carry: NuPlanCarry, step: StepView, derived: Derived) -> NuPlanCarry:
        """Add nuPlan's view of the TTC, and the distance of the reference."""
        record, contacts = step.record, derived.contacts
        e, (begin, cease) = step.encounter, step.contact_interval
        sideways = (record.changing[step.slot] | record.in_junction) & ~behind(e, record.rear_axle)
        watched = step.others & ~contacts.touched & (ahead(e, record.rear_axle) | sideways)
        kept = jnp.all(nuplan_ttc(begin, cease, watched & record.relevant)) | (step.ego_speed <= 0.005)
        kept &= ~contacts.fault_now
        at_limit = jnp.where(step.drove, record.speed_limit * step.dt, 0)
        return NuPlanCarry(carry.ttc_kept & kept, carry.reference + at_limit)

    def result(self, carry: NuPlanCarry, summary: Summary) -> dict[str, Measured]:
        """All columns."""
        reference = summary.reference_progress
        if reference is None:
            reference = jnp.minimum(carry.reference, summary.route)
        found = nuplan_score(
            NuPlanEpisode(
                at_fault=summary.faults,
                off_road=summary.off_road,
                against_flow=summary.against_flow,
                progress=summary.progress,
                reference_progress=reference,
                ttc_within_bound=carry.ttc_kept,
                overspeed=summary.overspeed,
                duration=summary.duration,
                comfortable=summary.comfort["comfortable"].value > 0.5,
            )
        )
        found = found._replace(score=jnp.where(summary.broken, 0, found.score))
        names = {name: "nuplan_score" if name == "score" else f"nuplan_{name}" for name in found._fields}
        return {names[name]: measured(value, summary.judged) for name, value in found._asdict().items()}


class CarlaCarry(NamedTuple):
    """Memory of `Carla`."""

    collisions: Int[Array, ""]
    place: Float[Array, " 2"]  # m, of the ego at the last one, until it is `CARLA_RADIUS` away from there
    near: Bool[Array, ""]  # it is not yet


class Carla(Measure):
    """Driving score of the CARLA leaderboard 2.0."""

    name = "carla"
    columns = (
        Description(
            "carla_score", "0 to 100", "Scores", "higher",
            formula="100 x completion x carla_penalty; 0 with policy_failed.",
            source="CARLA leaderboard 2.0, statistics_manager.py",
            missing=_NO_STEP,
            headline=Headline(12, "CARLA score", unit="of 100"),
            plot=Plot("CARLA driving score", "of 100"),
        ),
        Description(
            "carla_penalty", "0 to 1", "Scores", "higher",
            formula="0.6 for each of carla_collisions, 0.7 for each red light, 0.8 for each stop sign, times "
            "1 - off_route.",
            source="CARLA leaderboard 2.0, statistics_manager.py",
            missing=_NO_STEP,
        ),
        Description(
            "carla_collisions", "contacts by CARLA's criterion", "Scores", "lower",
            formula="New contacts while the ego drives 0.1 m/s or more; those within 5 m of the last one "
            "count once, until the ego has been farther away.",
            source="CARLA scenario_runner, CollisionTest in atomic_criteria.py",
        ),
    )  # fmt: skip

    def init(self, slots: int, zones: int) -> CarlaCarry:
        """No collision."""
        return CarlaCarry(jnp.zeros((), jnp.int32), jnp.zeros(2), jnp.zeros((), bool))

    def update(self, carry: CarlaCarry, step: StepView, derived: Derived) -> CarlaCarry:
        """Count a collision that is new."""
        here = step.ego_box[:2]
        near = carry.near & (safe_norm(here - carry.place) <= CARLA_RADIUS)
        counts = derived.hit & ~near & (step.ego_speed >= CARLA_STANDS)
        return CarlaCarry(
            collisions=carry.collisions + counts.astype(jnp.int32),
            place=jnp.where(counts, here, carry.place),
            near=near | counts,
        )

    def result(self, carry: CarlaCarry, summary: Summary) -> dict[str, Measured]:
        """All columns."""
        counts: dict[str, Number] = {
            "vehicles": carry.collisions,
            "red_lights": summary.red_lights,
            "stop_signs": summary.stop_signs,
        }
        outside = safe_divide(summary.off_route, summary.distance)
        found = carla_score(summary.completion, counts, outside=outside)
        return {
            "carla_score": measured(jnp.where(summary.broken, 0, found.score), summary.judged),
            "carla_penalty": measured(found.penalty, summary.judged),
            "carla_collisions": summary.number(carry.collisions),
        }


_LIMSIM = "LimSim++, arXiv 2402.01246 and its released code; the driving score of arXiv 2502.09170"
_NO_SECOND = "The episode has no full second, and the ego did not fail: an ego that failed has 0."
_PARTS: dict[str, tuple[str, str]] = {
    "total": ("0 to 100, drive score times completion", "limsim_{version}_drive x completion."),
    "drive": (
        "0 to 100",
        "100 x (comfort / 4 + efficiency / 4 + safety / 2) x 0.7 per red light x 0.9^(10 x share of the "
        "time with "
        "speeding) x 0.6 on failure, as {version}: see limsim_jax.metrics.scores.",
    ),
    "comfort": ("0 to 1", "Mean score of accelerations and jerks, as {version}."),
    "efficiency": ("0 to 1", "Speed over that of the traffic around, at most the limit, as {version}."),
    "safety": ("0 to 1", "min(least TTC of a second / 5 s, 1), mean over seconds."),
}


def _limsim(version: str) -> list[Description]:
    found = []
    for part, (meaning, formula) in _PARTS.items():
        main = part == "total" and version == "corrected"
        found.append(
            Description(
                f"limsim_{version}_{part}", meaning, "Scores", "higher", "mean",
                formula.format(version=version),
                _LIMSIM, _NO_SECOND, Headline(13, "LimSim score, corrected", unit="of 100") if main else None,
                Plot("LimSim score, corrected", "of 100") if main else None,
            )
        )  # fmt: skip
    return found


def _second(name: str, meaning: str, better: Better, formula: str) -> Description:
    return Description(name, meaning, "Scores", better, "mean", formula, _LIMSIM, _NO_SECOND)


@dataclass(frozen=True)
class LimSim(Measure):
    """LimSim++'s score, as released and as corrected.

    Attributes:
      dt: s between steps.
    """

    dt: float

    name = "limsim"
    columns = (
        *_limsim("faithful"),
        *_limsim("corrected"),
        _second(
            "worst_second", "0 to 100, LimSim's score of the worst second, as corrected, without its factors",
            "higher",
            "Least 100 x (comfort / 4 + efficiency / 4 + safety / 2) of a second.",
        ),
        _second("worst_second_time", "s, when it ended", "neither", "Time of the last step of that second."),
    )  # fmt: skip

    def init(self, slots: int, zones: int) -> LimSimCarry:
        """No second."""
        return limsim_init()

    def update(self, carry: LimSimCarry, step: StepView, derived: Derived) -> LimSimCarry:
        """Add this step to the second that runs."""
        record = step.record
        return limsim_update(
            self.dt,
            carry,
            derived.filtered,
            LimSimStep(
                t=step.time,
                a=step.a,
                lateral=derived.motion.lateral,
                v=step.v,
                v_others=record.v_others,
                others=record.others,
                limit=record.speed_limit,
                ttc=step.least_ttc,
                red_light=record.red_light,
                in_junction=record.in_junction,
                waits_at_red=record.waits_at_red,
            ),
        )

    def result(self, carry: LimSimCarry, summary: Summary) -> dict[str, Measured]:
        """All columns."""
        completion = summary.completion
        arrived = summary.arrived & (summary.contacts == 0)
        failed = (summary.faults > 0) | summary.off_road
        found = {
            "faithful": limsim_faithful(carry, success=arrived, completion=completion),
            "corrected": limsim_corrected(carry, summary.rest, failed=failed, completion=completion),
        }
        # an ego that fails before its first second is over has earned nothing
        early = summary.started & summary.failed & ~carry.worst.found
        results: dict[str, Measured] = {}
        for version, score in found.items():
            for part in _PARTS:
                none = early | (summary.broken & (part in ("total", "drive")))
                earned: Any = jnp.where(none, 0, getattr(score, part))
                results[f"limsim_{version}_{part}"] = measured(earned, score.valid | none)
        worst, when = carry.worst.result(), carry.worst.when()
        at: Any = jnp.where(early, summary.now, when.value)
        return results | {
            "worst_second": measured(worst.value, worst.valid | early),
            "worst_second_time": measured(at, when.valid | early),
        }
