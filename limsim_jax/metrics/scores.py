"""Driving scores: nuPlan, CARLA leaderboard, LimSim++, from reduced quantities.

**nuPlan closed loop** (`nuplan-devkit`, `metric_aggregator/*closed_loop*.yaml`): the product of four
multipliers and a weighted mean (`NUPLAN_WEIGHTS`) of four metrics. As in the code, where the documents
differ: driving direction is a multiplier, the progress threshold is 2 m, the TTC must exceed 0.95 s on a
grid of 0.1 s. nuPlan's expert is a recorded human; the progress of the reference is the caller's choice.

**CARLA leaderboard 2.0** (`leaderboard`, `statistics_manager.py`): route completion in percent times a
coefficient for each infraction (`CARLA_PENALTIES`).

**LimSim++** (arXiv 2402.01246), the "driving score" of arXiv 2502.09170, in two versions.
`limsim_faithful` is what the released code computes, once a second, from means over the second:
comfort, efficiency and safety weigh 0.25, 0.25 and 0.5; red lights take 0.7 each, seconds with
speeding 0.9^(10 x their share), failure 0.6; times route completion. `limsim_corrected` differs in:

======================  ===================================  =======================================
term                    faithful                             corrected
======================  ===================================  =======================================
comfort                 score of the mean over a second:     mean of the scores of all samples, of
                        oscillation cancels, jerk is just    accelerations and jerks filtered as in
                        the difference of the ends           `motion`
efficiency at a red     0, unless the others stand, too      1
light
red light               noticed only if the ego is still in  every crossing on red
                        the junction when the second ends
speeding                speed of the last second against     each speed against its own limit
                        the limit at its end
failure                 0.6 whenever the goal is not         0.6 for a contact by the ego's fault or
                        reached without contact: crash and   for leaving the road; not for others'
                        standstill alike                     fault; standing still costs completion
======================  ===================================  =======================================

Two differences from the released code remain in both: its TTC moves boxes along lane centre lines with
their present heading, ours goes straight on (see `safety.ttc_2d`); and it counts every speed above the
limit, we those above it by `OVER_LIMIT`, since rounding would decide at the limit itself.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.metrics.motion import Filtered
from limsim_jax.metrics.reductions import Least, Mean
from limsim_jax.metrics.safety import NONE
from limsim_jax.numerics import masked_sum, safe_divide

NUPLAN_WEIGHTS = {"progress": 5.0, "ttc": 5.0, "speed_limit": 4.0, "comfort": 2.0}
"""Of the weighted mean in nuPlan's score."""

NUPLAN_TTC = (0.95, 0.1)
"""s: TTC to exceed, and step of the projection; its horizon of 3 s is beyond that."""

NUPLAN_PROGRESS = (2.0, 0.2)
"""m, below which progress counts as this; ratio to the reference that counts as making progress."""

NUPLAN_DIRECTION = (2.0, 6.0)
"""m driven against the flow within a second: up to the first costs nothing, up to the second half."""

NUPLAN_OVERSPEED = 2.23
"""m/s: mean excess over the limit at which the speed limit metric is 0."""

CARLA_PENALTIES = {
    "pedestrians": 0.50,
    "vehicles": 0.60,
    "static": 0.65,
    "red_lights": 0.70,
    "stop_signs": 0.80,
    "scenario_timeouts": 0.70,
    "emergency_vehicles": 0.70,
}
"""Coefficient of each infraction in the CARLA leaderboard 2.0."""

CARLA_RADIUS = 5.0
"""m: contacts nearer than this to the place of the last one are the same collision."""

CARLA_STANDS = 0.1
"""m/s: an ego that is slower is hit, and does not collide."""

CARLA_MIN_SPEED = 0.70
"""Coefficient for no speed at all against that of the traffic; in proportion between."""

LIMSIM_BOUNDS = {
    "acceleration": (0.9, 1.47, 3.07),  # m/s^2
    "deceleration": (0.9, 2.0, 5.08),
    "lateral": (0.9, 4.0, 5.6),
    "jerk": (0.6, 0.9, 2.0),  # m/s^3, along and across
}
"""Cautious, normal and aggressive driving in LimSim++'s comfort."""

LIMSIM_TTC = 5.0
"""s: TTC at which LimSim++'s safety is 1."""

OVER_LIMIT = 0.01
"""m/s above the limit that do not count: rounding brings a vehicle at the limit above it."""

Scalar = Float[Array, "*b"]
Number = Float[Array, "*#b"] | Int[Array, "*#b"] | float | int


# --- nuPlan ------------------------------------------------------------------------------------------


class NuPlanScore(NamedTuple):
    """The score and its parts, each 0 to 1."""

    score: Scalar
    no_at_fault_collisions: Scalar  # multipliers
    drivable_area: Scalar
    driving_direction: Scalar
    making_progress: Scalar
    progress: Scalar  # weighted metrics
    ttc: Scalar
    speed_limit: Scalar
    comfort: Scalar


class NuPlanEpisode(NamedTuple):
    """What nuPlan's score needs to know of an episode."""

    at_fault: Number  # contacts with vehicles by the ego's fault
    off_road: Bool[Array, "*b"]  # a corner of the ego was more than 0.3 m outside the drivable area
    against_flow: Scalar  # m, the most driven against the flow of the lane within a second
    progress: Scalar  # m along the route
    reference_progress: Scalar  # m, of the driver that the ego is compared with
    ttc_within_bound: Bool[Array, "*b"]  # `nuplan_ttc` held at every step
    overspeed: Scalar  # m, integral of the excess over the limit
    duration: Scalar  # s
    comfortable: Bool[Array, "*b"]  # all quantities within `motion.COMFORT`
    at_fault_vru: Number = 0  # contacts at fault with pedestrians and cyclists
    at_fault_object: Number = 0  # with cones and the like


def nuplan_score(episode: NuPlanEpisode) -> NuPlanScore:
    """nuPlan's closed-loop score of one episode.

    No contact at fault is allowed with vehicles, pedestrians or cyclists; one with an object costs half.
    """
    progress, reference_progress = episode.progress, episode.reference_progress
    against_flow = episode.against_flow

    def collisions(count: Number, allowed: int) -> Scalar:
        count = jnp.broadcast_to(jnp.asarray(count, progress.dtype), progress.shape)
        return jnp.maximum(1 - count / (allowed + 1), 0)

    floor, least_ratio = NUPLAN_PROGRESS
    ratio = jnp.maximum(progress, floor) / jnp.maximum(reference_progress, floor)
    ratio = jnp.where(progress < -floor, 0, jnp.minimum(ratio, 1))
    compliance, violation = NUPLAN_DIRECTION
    direction = jnp.where(against_flow < compliance, 1.0, jnp.where(against_flow < violation, 0.5, 0.0))
    no_collisions = collisions(episode.at_fault, 0) * collisions(episode.at_fault_vru, 0)
    no_collisions = no_collisions * collisions(episode.at_fault_object, 1)
    excess = safe_divide(episode.overspeed, NUPLAN_OVERSPEED * episode.duration)
    parts = {
        "progress": ratio,
        "ttc": episode.ttc_within_bound.astype(ratio.dtype),
        "speed_limit": jnp.maximum(1 - excess, 0),
        "comfort": episode.comfortable.astype(ratio.dtype),
    }
    weighted = sum((weight * parts[name] for name, weight in NUPLAN_WEIGHTS.items()), jnp.zeros_like(ratio))
    drivable = (~episode.off_road).astype(ratio.dtype)
    making_progress = (ratio > least_ratio).astype(ratio.dtype)
    product = no_collisions * drivable * direction * making_progress
    score = product * weighted / sum(NUPLAN_WEIGHTS.values())
    return NuPlanScore(score, no_collisions, drivable, direction, making_progress, **parts)


def nuplan_ttc(
    begin: Float[Array, "*b"], cease: Float[Array, "*b"], relevant: Bool[Array, "*b"]
) -> Bool[Array, "*b"]:
    """Whether contact intervals keep nuPlan's bound on the TTC.

    Intervals as of `safety.contact_interval`. nuPlan checks 0.1, 0.2, ... s only: it misses a shorter
    touch between two of these times, and a contact at 0.92 s is found at 1.0 s.
    """
    bound, step = NUPLAN_TTC
    first = jnp.maximum(jnp.ceil(begin / step - 1e-4), 1) * step
    return ~(relevant & (first <= cease + 1e-4 * step) & (first <= bound))


def against_flow_init(window: int) -> Float[Array, " W"]:
    """Before the first step; `window` displacements are summed, 11 at 10 Hz."""
    return jnp.zeros(window)


def against_flow_update(
    moved: Float[Array, " W"], ds: Float[Array, ""]
) -> tuple[Float[Array, " W"], Float[Array, ""]]:
    """Displacement `ds` (m) along the direction of the lane in this step; the net loss in the window, m.

    nuPlan sums the displacements of one second and one step (`driving_direction_compliance.py`).
    """
    moved = jnp.concatenate([moved[1:], ds[None]])
    return moved, jnp.maximum(-jnp.sum(moved), 0)


# --- CARLA -------------------------------------------------------------------------------------------


class CarlaScore(NamedTuple):
    """Driving score and route completion in percent, penalty 0 to 1."""

    score: Scalar
    completion: Scalar
    penalty: Scalar


def carla_score(
    completion: Scalar,
    counts: dict[str, Number],
    *,
    outside: Scalar | None = None,
    speed_ratio: Scalar | None = None,
) -> CarlaScore:
    """Driving score of the CARLA leaderboard 2.0 for one route.

    Args:
        completion: Share of the route that was completed, 0 to 1.
        counts: How often each of `CARLA_PENALTIES` happened; those left out, never.
        outside: Share of the way driven outside the lanes of the route; it does not count as driven.
        speed_ratio: Mean speed over that of the surrounding traffic, 0 to 1 (minimum speed infraction).

    Raises `ValueError` for an unknown infraction.
    """
    unknown = sorted(set(counts) - set(CARLA_PENALTIES))
    if unknown:
        raise ValueError(f"unknown infraction '{unknown[0]}'; there are {', '.join(CARLA_PENALTIES)}")
    penalty = jnp.ones_like(completion)
    for name, count in counts.items():
        penalty = penalty * CARLA_PENALTIES[name] ** jnp.asarray(count, completion.dtype)
    if outside is not None:
        penalty = penalty * (1 - outside)
    if speed_ratio is not None:
        penalty = penalty * (1 - (1 - CARLA_MIN_SPEED) * (1 - jnp.clip(speed_ratio, 0, 1)))
    return CarlaScore(100 * completion * penalty, 100 * completion, penalty)


# --- LimSim++ ----------------------------------------------------------------------------------------


def limsim_piecewise(x: Scalar, bounds: tuple[float, float, float]) -> Scalar:
    """Score of |x|: 1 up to the cautious bound, 0 from the aggressive one on.

    Linear from 1 to 0.6 at the normal bound, and from there to 0.
    """
    cautious, normal, aggressive = bounds
    x = jnp.abs(x)
    first = jnp.clip((x - cautious) / (normal - cautious), 0, 1)
    return 1 - 0.4 * first - 0.6 * jnp.clip((x - normal) / (aggressive - normal), 0, 1)


def limsim_comfort(
    acceleration: Scalar, lateral: Scalar, jerk: Scalar, lateral_jerk: Scalar
) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Scores of accelerations (m/s^2) and jerks (m/s^3); comfort is their mean."""
    ahead = limsim_piecewise(acceleration, LIMSIM_BOUNDS["acceleration"])
    braking = limsim_piecewise(acceleration, LIMSIM_BOUNDS["deceleration"])
    return (
        jnp.where(acceleration > 0, ahead, braking),
        limsim_piecewise(lateral, LIMSIM_BOUNDS["lateral"]),
        limsim_piecewise(jerk, LIMSIM_BOUNDS["jerk"]),
        limsim_piecewise(lateral_jerk, LIMSIM_BOUNDS["jerk"]),
    )


def limsim_efficiency(v: Scalar, v_others: Scalar, others: Bool[Array, "*b"], limit: Scalar) -> Scalar:
    """Speed over that of the traffic around, at most the limit; 1 where that traffic stands.

    `v_others`: mean speed of the cars on the same road or on the next lane, if there are `others`.
    """
    reference = jnp.where(others, jnp.minimum(v_others, limit), limit)
    stand = others & (v_others <= 0.1)
    return jnp.where(stand, 1, jnp.minimum(safe_divide(v, reference, 1.0), 1))


class LimSimSecond(NamedTuple):
    """Sums over the second that runs."""

    steps: Int[Array, ""]
    acceleration: Float[Array, ""]
    lateral: Float[Array, ""]
    v: Float[Array, ""]
    v_others: Mean
    ttc: Float[Array, ""]  # s, least
    fastest: Float[Array, ""]  # m/s
    red: Bool[Array, ""]
    waits: Bool[Array, ""]  # at a red light, at the end


class LimSimCarry(NamedTuple):
    """State of `limsim_update`."""

    started: Bool[Array, ""]
    begin: Float[Array, " 2"]  # m/s^2, along and across, at the end of the second before
    second: LimSimSecond
    # over seconds
    worst: Least  # score of a second, 0 to 100
    comfort: Mean
    efficiency: Mean
    corrected_efficiency: Mean
    safety: Mean
    speeding: Mean
    reds: Int[Array, ""]
    # over steps
    corrected_comfort: Mean  # [4], one for each score
    corrected_speeding: Mean
    corrected_reds: Int[Array, ""]


def _no_second() -> LimSimSecond:
    zero, no = jnp.zeros(()), jnp.zeros((), bool)
    none = jnp.zeros((), jnp.int32)
    return LimSimSecond(none, zero, zero, zero, Mean.empty(), jnp.full((), NONE), zero, no, no)


def limsim_init() -> LimSimCarry:
    """Before the first step."""
    none = jnp.zeros((), jnp.int32)
    return LimSimCarry(
        started=jnp.zeros((), bool),
        begin=jnp.zeros(2),
        second=_no_second(),
        worst=Least.empty(),
        comfort=Mean.empty(),
        efficiency=Mean.empty(),
        corrected_efficiency=Mean.empty(),
        safety=Mean.empty(),
        speeding=Mean.empty(),
        reds=none,
        corrected_comfort=Mean.empty(4),
        corrected_speeding=Mean.empty(),
        corrected_reds=none,
    )


class LimSimStep(NamedTuple):
    """A step of the ego, for `limsim_update`."""

    t: Float[Array, ""]  # s
    a: Float[Array, ""]  # m/s^2, along, unfiltered
    lateral: Float[Array, ""]  # m/s^2, across, unfiltered
    v: Float[Array, ""]  # m/s
    v_others: Float[Array, ""]  # m/s, mean of the cars on the same road or on the next lane
    others: Bool[Array, ""]  # there are some
    limit: Float[Array, ""]  # m/s
    ttc: Float[Array, ""]  # s, least
    red_light: Bool[Array, ""]  # crosses a stop line on red in this step
    in_junction: Bool[Array, ""]
    waits_at_red: Bool[Array, ""]  # stands within 15 m of a red light


def limsim_update(dt: float, carry: LimSimCarry, filtered: Filtered, step: LimSimStep) -> LimSimCarry:
    """One step; the first call sets the start. A second that is not full at the end does not count."""
    counts, limit, a = carry.started, step.limit, step.a
    now = jnp.stack([a, step.lateral])
    begin = jnp.where(counts, carry.begin, now)
    second = _where(counts, _with_step(carry.second, step), carry.second)

    full = counts & (second.steps == round(1 / dt))
    steps = jnp.maximum(second.steps, 1).astype(a.dtype)
    jerk = (now - begin) / (steps * dt)
    comfort = limsim_comfort(second.acceleration / steps, second.lateral / steps, jerk[0], jerk[1])
    around = second.v_others.result()
    efficiency = limsim_efficiency(second.v / steps, around.value, around.valid, limit)
    corrected = jnp.where(second.waits, 1, efficiency)
    safety = jnp.minimum(second.ttc / LIMSIM_TTC, 1)
    over, over_now = (v > limit + OVER_LIMIT for v in (second.fastest, step.v))
    mean_comfort = jnp.mean(jnp.stack(comfort))
    score = 100 * (0.25 * mean_comfort + 0.25 * corrected + 0.5 * safety)

    carry = _add_samples(carry, filtered)
    return carry._replace(
        started=jnp.ones((), bool),
        begin=jnp.where(full, now, begin),
        second=_where(full, _no_second(), second),
        worst=carry.worst.add(score, step.t, full),
        comfort=carry.comfort.add(mean_comfort, full),
        efficiency=carry.efficiency.add(efficiency, full),
        corrected_efficiency=carry.corrected_efficiency.add(corrected, full),
        safety=carry.safety.add(safety, full),
        speeding=carry.speeding.add(over.astype(a.dtype), full),
        reds=carry.reds + (full & second.red & step.in_junction).astype(jnp.int32),
        corrected_speeding=carry.corrected_speeding.add(over_now.astype(a.dtype), counts),
        corrected_reds=carry.corrected_reds + step.red_light.astype(jnp.int32),
    )


def _with_step(old: LimSimSecond, step: LimSimStep) -> LimSimSecond:
    return LimSimSecond(
        steps=old.steps + 1,
        acceleration=old.acceleration + step.a,
        lateral=old.lateral + step.lateral,
        v=old.v + step.v,
        v_others=old.v_others.add(step.v_others, step.others),
        ttc=jnp.minimum(old.ttc, step.ttc),
        fastest=jnp.maximum(old.fastest, step.v),
        red=old.red | step.red_light,
        waits=step.waits_at_red,
    )


def _where(condition: Bool[Array, ""], new: LimSimSecond, old: LimSimSecond) -> LimSimSecond:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def _add_samples(carry: LimSimCarry, filtered: Filtered) -> LimSimCarry:
    """Score the filtered values that have become known.

    Accelerations and jerks become known at different times.
    """
    accelerations, new_a, jerks, new_j = filtered
    scores = (
        *limsim_comfort(accelerations[:, 0], accelerations[:, 1], accelerations[:, 0], accelerations[:, 0])[
            :2
        ],
        *limsim_comfort(jerks[:, 0], jerks[:, 0], jerks[:, 0], jerks[:, 1])[2:],
    )
    new = (new_a, new_a, new_j, new_j)
    total = jnp.stack([masked_sum(x, mask) for x, mask in zip(scores, new, strict=True)])
    weight = jnp.stack([jnp.sum(mask, dtype=total.dtype) for mask in new])
    mean = carry.corrected_comfort
    return carry._replace(corrected_comfort=Mean(mean.total + total, mean.weight + weight))


class LimSimScore(NamedTuple):
    """The score of an episode and its parts.

    `total` and `drive` are 0 to 100, the parts 0 to 1.
    """

    total: Float[Array, ""]
    drive: Float[Array, ""]
    comfort: Float[Array, ""]
    efficiency: Float[Array, ""]
    safety: Float[Array, ""]
    red_lights: Float[Array, ""]  # factors
    speeding: Float[Array, ""]
    failure: Float[Array, ""]
    valid: Bool[Array, ""]  # there was a full second


def limsim_score(
    *,
    comfort: Scalar,
    efficiency: Scalar,
    safety: Scalar,
    reds: Number,
    speeding: Scalar,
    failed: Bool[Array, "*b"],
    completion: Scalar,
    valid: Bool[Array, "*b"] | bool = True,
) -> LimSimScore:
    """The formula that both versions share; `speeding` is the share of the time, `completion` 0 to 1."""
    red = 0.7 ** jnp.broadcast_to(jnp.asarray(reds, comfort.dtype), comfort.shape)
    slow = 0.9 ** (10 * speeding)
    failure = jnp.where(failed, 0.6, 1.0)
    drive = 100 * (0.25 * comfort + 0.25 * efficiency + 0.5 * safety) * red * slow * failure
    valid = jnp.broadcast_to(jnp.asarray(valid), comfort.shape)
    return LimSimScore(drive * completion, drive, comfort, efficiency, safety, red, slow, failure, valid)


def limsim_faithful(
    carry: LimSimCarry, *, success: Bool[Array, ""], completion: Float[Array, ""]
) -> LimSimScore:
    """LimSim++'s score as released. `success`: reached the goal without any contact."""
    return limsim_score(
        comfort=carry.comfort.result().value,
        efficiency=carry.efficiency.result().value,
        safety=carry.safety.result().value,
        reds=carry.reds,
        speeding=carry.speeding.result().value,
        failed=~success,
        completion=jnp.where(success, 1, completion),
        valid=carry.comfort.weight > 0,
    )


def limsim_corrected(
    carry: LimSimCarry, rest: Filtered, *, failed: Bool[Array, ""], completion: Float[Array, ""]
) -> LimSimScore:
    """The corrected version. `rest`: of `motion_flush`; `failed`: at fault, or off the road."""
    comfort = _add_samples(carry, rest).corrected_comfort.result()
    return limsim_score(
        comfort=comfort.value.mean(),
        efficiency=carry.corrected_efficiency.result().value,
        safety=carry.safety.result().value,
        reds=carry.corrected_reds,
        speeding=carry.corrected_speeding.result().value,
        failed=failed,
        completion=completion,
        valid=comfort.valid.all() & (carry.safety.weight > 0),
    )
