"""All metrics of one ego in one carry: `EgoMetrics` over a stream of `EgoStep`s.

An `EgoStep` is what the metrics need to see of a world after a physics step; the first one is the start.
Once the ego has arrived or left nothing changes any more, so an episode that ends early keeps its results,
and another vehicle may take the slot. `NAMES` lists what comes out, with units.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.metrics.blame import (
    ContactCarry,
    ahead,
    behind,
    contact_init,
    contact_result,
    contact_update,
)
from limsim_jax.metrics.motion import MotionCarry, motion_flush, motion_init, motion_result, motion_update
from limsim_jax.metrics.reductions import Episodes, Least, Mean, Measured, measured
from limsim_jax.metrics.safety import (
    EXPOSED,
    NEAR_MISS,
    NO_GAP,
    NONE,
    PetCarry,
    Rss,
    Zones,
    contact_interval,
    distance,
    drac,
    encounter,
    first_touch,
    pet_init,
    pet_update,
    reach,
    rss_lateral,
    rss_longitudinal,
    time_headway,
    ttc_1d,
)
from limsim_jax.metrics.scores import (
    OVER_LIMIT,
    LimSimCarry,
    against_flow_init,
    against_flow_update,
    carla_score,
    limsim_corrected,
    limsim_faithful,
    limsim_init,
    limsim_update,
    nuplan_score,
    nuplan_ttc,
)
from limsim_jax.numerics import safe_divide, safe_norm

NAMES = {
    "arrived": "1 if the ego reached its goal",
    "success": "1 if it did without any contact and without leaving the road",
    "completion": "share of the route driven",
    "completion_time": "s until the goal",
    "duration": "s that the ego was there",
    "distance": "m driven",
    "progress": "m nearer to the goal along the route",
    "mean_speed": "m/s",
    "min_ttc": "s, least time to collision of both kinds",
    "min_ttc_time": "s, when",
    "min_ttc_1d": "s, least TTC with the leader on the lane",
    "min_ttc_2d": "s, least TTC of boxes that keep their velocity",
    "ttc_exposed": "s with a TTC below 3 s",
    "near_misses": "times that the TTC fell below 1.5 s, without those that ended in a contact",
    "min_thw": "s, least time headway",
    "max_drac": "m/s^2, hardest braking that the leader asked for (1-D)",
    "max_drac_time": "s, when",
    "min_pet": "s, least post-encroachment time",
    "min_pet_time": "s, when",
    "min_distance": "m, least distance to another body",
    "rss_longitudinal": "share of the time too near to the leader by RSS",
    "rss_lateral": "share of the time too near to somebody beside by RSS",
    "rss_no_response": "share of the time too near to the leader beyond the response time and not braking",
    "rss_first_time": "s, when RSS was first broken",
    "contacts": "bodies touched",
    "at_fault_contacts": "of them by the ego's fault by nuPlan's rules",
    "contact_time": "s, first contact",
    "contact_other": "slot of the first body touched",
    "contact_type": "blame.ContactType of the first contact",
    "contact_at_fault": "1 if the first contact is the ego's fault by nuPlan's rules",
    "contact_responsibility": "blame.Responsibility for the first contact",
    "contact_delta_v": "m/s, severity of the first contact",
    "max_delta_v": "m/s, severity of the worst contact",
    "speeding": "share of the time more than 0.01 m/s above the limit",
    "max_overspeed": "m/s above the limit",
    "overspeed": "m, integral of the speed above the limit",
    "off_road": "share of the time off the drivable area",
    "off_road_time": "s, when it first left the drivable area",
    "off_route": "share of the distance driven off the road or off the lanes of the route",
    "against_flow": "m, most driven against the lane's direction within a second",
    "wrong_way": "share of the time driving against the lane's direction",
    "red_lights": "stop lines crossed on red",
    "red_light_time": "s, when it first did",
    "stop_signs": "stop signs passed without a stop",
    "min_acceleration": "m/s^2, hardest braking, filtered",
    "max_acceleration": "m/s^2, filtered",
    "max_lateral_acceleration": "m/s^2, absolute, filtered",
    "max_jerk": "m/s^3, absolute, of the magnitude of the acceleration, filtered",
    "max_longitudinal_jerk": "m/s^3, absolute, filtered",
    "max_yaw_acceleration": "rad/s^2, absolute, filtered",
    "max_yaw_rate": "rad/s, absolute, filtered",
    "rms_acceleration": "m/s^2, along, filtered",
    "rms_jerk": "m/s^3, along, filtered",
    "comfortable": "1 if within nuPlan's bounds of comfort",
    "nuplan_score": "0 to 1",
    "nuplan_no_at_fault_collisions": "0, 0.5 or 1, multiplier",
    "nuplan_drivable_area": "0 or 1, multiplier",
    "nuplan_driving_direction": "0, 0.5 or 1, multiplier",
    "nuplan_making_progress": "0 or 1, multiplier",
    "nuplan_progress": "0 to 1, weight 5",
    "nuplan_ttc": "0 or 1, weight 5",
    "nuplan_speed_limit": "0 to 1, weight 4",
    "nuplan_comfort": "0 or 1, weight 2",
    "carla_score": "0 to 100",
    "carla_penalty": "0 to 1",
    "limsim_faithful_total": "0 to 100, drive score times completion",
    "limsim_faithful_drive": "0 to 100",
    "limsim_faithful_comfort": "0 to 1",
    "limsim_faithful_efficiency": "0 to 1",
    "limsim_faithful_safety": "0 to 1",
    "limsim_corrected_total": "0 to 100, drive score times completion",
    "limsim_corrected_drive": "0 to 100",
    "limsim_corrected_comfort": "0 to 1",
    "limsim_corrected_efficiency": "0 to 1",
    "limsim_corrected_safety": "0 to 1",
    "worst_second": "0 to 100, LimSim's score of the worst second, as corrected, without its factors",
    "worst_second_time": "s, when it ended",
}
"""What `EgoMetrics.result` measures."""


class EgoStep(NamedTuple):
    """The world after a step, as one ego is judged by: `N` slots, `Z` conflict zones."""

    t: Float[Array, ""]  # s
    box: Float[Array, "N 5"]  # x, y (m), heading (rad), length, width (m)
    velocity: Float[Array, "N 2"]  # m/s
    active: Bool[Array, " N"]
    b_max: Float[Array, " N"]  # m/s^2, hardest braking
    relevant: Bool[Array, " N"]  # their path may meet the ego's: not those that keep to another lane
    changing: Bool[Array, " N"]  # in several lanes, or off the drivable area
    violation: Bool[Array, " N"]  # drives where another one has priority: red light, wrong way, right of way
    slot: Int[Array, ""]  # of the ego
    v: Float[Array, ""]  # m/s, along the heading of the ego
    a: Float[Array, ""]  # m/s^2, in the step just made
    rear_axle: Float[Array, ""]  # m, from the centre of the body back to the axle
    lead: Int[Array, ""]  # slot of the leader on the lane, -1 for none
    lead_gap: Float[Array, ""]  # m, bumper to bumper
    lane_heading: Float[Array, ""]  # rad, of the lane at the ego
    on_lane: Bool[Array, ""]  # there is one
    speed_limit: Float[Array, ""]  # m/s
    to_go: Float[Array, ""]  # m along the route to the goal
    on_route: Bool[Array, ""]  # on a lane of the route
    arrived: Bool[Array, ""]  # reached the goal in this step, whether or not it is still active
    off_road: Bool[Array, ""]  # a corner is more than 0.3 m off the drivable area
    in_junction: Bool[Array, ""]
    red_light: Bool[Array, ""]  # crossed a stop line on red in this step
    stop_sign: Bool[Array, ""]  # passed a stop sign without a stop in this step
    waits_at_red: Bool[Array, ""]  # stands within 15 m of a red light
    v_others: Float[Array, ""]  # m/s, mean speed on the same road or on the next lane
    others: Bool[Array, ""]  # there is somebody
    zones: Zones


class EgoCarry(NamedTuple):
    """State of `EgoMetrics.update`."""

    started: Bool[Array, ""]
    over: Bool[Array, ""]
    start: Float[Array, ""]  # s
    now: Float[Array, ""]
    to_go: Float[Array, " 2"]  # m, at the start and now
    arrived: Bool[Array, ""]
    distance: Float[Array, ""]  # m
    off_route: Float[Array, ""]  # m
    reference: Float[Array, ""]  # m, at the speed limit
    ttc: Least
    ttc_1d: Least
    ttc_2d: Least
    exposed: Float[Array, ""]  # s
    near: Episodes
    near_contact: Bool[Array, ""]  # the near miss that goes on has become a contact
    near_contacts: Int[Array, ""]
    thw: Least
    drac: Least  # of the negative
    pet: PetCarry
    nearest: Least
    rss_longitudinal: Mean
    rss_lateral: Mean
    rss_no_response: Mean
    rss_since: Float[Array, ""]  # s that the distance to the leader has been unsafe
    rss_first: Least
    contact: ContactCarry
    nuplan_ttc: Bool[Array, ""]
    speeding: Mean
    max_overspeed: Float[Array, ""]
    overspeed: Float[Array, ""]
    off_road: Mean
    left_road: Least
    moved: Float[Array, " W"]  # m along the lane, the last steps
    against_flow: Float[Array, ""]
    wrong_way: Mean
    red_lights: Int[Array, ""]
    red_light: Least
    stop_signs: Int[Array, ""]
    motion: MotionCarry
    limsim: LimSimCarry


@dataclass(frozen=True)
class EgoMetrics:
    """Metrics of one ego in one world.

    Attributes:
        dt: s between steps.
        rss: Parameters of RSS.
    """

    dt: float
    rss: Rss = field(default_factory=Rss)

    def init(self, vehicles: int, zones: int) -> EgoCarry:
        """Before the first step, for this many slots and conflict zones."""
        zero, none, no = jnp.zeros(()), jnp.zeros((), jnp.int32), jnp.zeros((), bool)
        return EgoCarry(
            started=no,
            over=no,
            start=zero,
            now=zero,
            to_go=jnp.zeros(2),
            arrived=no,
            distance=zero,
            off_route=zero,
            reference=zero,
            ttc=Least.empty(),
            ttc_1d=Least.empty(),
            ttc_2d=Least.empty(),
            exposed=zero,
            near=Episodes.empty(),
            near_contact=no,
            near_contacts=none,
            thw=Least.empty(),
            drac=Least.empty(),
            pet=pet_init(zones),
            nearest=Least.empty(),
            rss_longitudinal=Mean.empty(),
            rss_lateral=Mean.empty(),
            rss_no_response=Mean.empty(),
            rss_since=zero,
            rss_first=Least.empty(),
            contact=contact_init(vehicles),
            nuplan_ttc=~no,
            speeding=Mean.empty(),
            max_overspeed=zero,
            overspeed=zero,
            off_road=Mean.empty(),
            left_road=Least.empty(),
            moved=against_flow_init(round(1 / self.dt) + 1),
            against_flow=zero,
            wrong_way=Mean.empty(),
            red_lights=none,
            red_light=Least.empty(),
            stop_signs=none,
            motion=motion_init(self.dt),
            limsim=limsim_init(),
        )

    @jax.named_scope("ego_metrics")
    def update(self, carry: EgoCarry, step: EgoStep) -> EgoCarry:
        """One step. Nothing changes before the ego is active, nor after it arrived or left."""
        there = step.active[step.slot] & ~carry.over
        new = jax.tree.map(lambda a, b: jnp.where(there, a, b), self._update(carry, step), carry)
        arrives = new.started & ~carry.over & step.arrived
        return new._replace(
            arrived=carry.arrived | arrives,
            over=carry.over | arrives | (carry.started & ~there),
            now=jnp.where(arrives, step.t, new.now),
        )

    def _update(self, carry: EgoCarry, step: EgoStep) -> EgoCarry:
        t, dt = step.t, self.dt
        drove = carry.started  # the first step is the start: nothing has been driven yet
        slots = jnp.arange(step.active.shape[0])
        there = step.active & (slots != step.slot)
        box, velocity = step.box[step.slot], step.velocity[step.slot]
        speed = safe_norm(step.velocity)
        e = encounter(box, velocity, step.box, step.velocity)

        # --- time to collision, distances
        begin, cease = contact_interval(e)
        ttc, touches = first_touch(begin, cease), (begin <= 0) & (cease >= 0)
        touched = carry.contact.touched
        apart = there & ~touched
        # who touches, or is near an ego that leaves its lane, counts whatever way both meant to go
        meets = step.relevant | step.changing[step.slot] | touches
        ttc_2d = jnp.min(jnp.where(apart & meets, ttc, NONE))
        has_lead = (step.lead >= 0) & step.active[step.lead]
        gap = jnp.where(has_lead, step.lead_gap, NO_GAP)
        v_lead = jnp.where(has_lead, speed[step.lead], 0)
        ttc_lead = jnp.where(has_lead & ~touched[step.lead], ttc_1d(gap, step.v, v_lead), NONE)
        least = jnp.minimum(ttc_2d, ttc_lead)
        thw = time_headway(gap, step.v)
        nearest = jnp.min(jnp.where(apart, distance(e, touches), NO_GAP))

        # --- contacts and near misses
        contact = contact_update(
            carry.contact,
            t=t,
            e=e,
            begin=begin,
            cease=cease,
            there=there,
            v=step.v,
            v_others=speed,
            changing=step.changing[step.slot],
            others_changing=step.changing,
            violation=step.violation[step.slot],
            other_violations=step.violation,
            rear_axle=step.rear_axle,
            b_max=step.b_max[step.slot],
            others_b_max=step.b_max,
        )
        hit = contact.contacts > carry.contact.contacts
        near = carry.near.add(least < NEAR_MISS[0], least > NEAR_MISS[1])
        near_contact = near.inside & (carry.near_contact | hit)
        near_contacts = carry.near_contacts + (near_contact & ~carry.near_contact).astype(jnp.int32)

        # --- nuPlan's view of the others
        sideways = (step.changing[step.slot] | step.in_junction) & ~behind(e, step.rear_axle)
        watched = there & ~contact.touched & (ahead(e, step.rear_axle) | sideways)
        kept = jnp.all(nuplan_ttc(begin, cease, watched & step.relevant)) | (speed[step.slot] <= 0.005)
        kept &= ~contact.fault_now

        # --- RSS: towards the leader, and towards whoever is beside
        unsafe = has_lead & (gap < rss_longitudinal(step.v, v_lead, self.rss))
        along, across = reach(e)
        cos, sin = jnp.cos(step.lane_heading), jnp.sin(step.lane_heading)
        sideways_v = cos * step.velocity[:, 1] - sin * step.velocity[:, 0]
        side = jnp.sign(e.y)
        w = side * (cos * velocity[1] - sin * velocity[0])
        w_other = -side * sideways_v
        beside = apart & (jnp.abs(e.x) <= along) & (e.cos > 0.7)
        tight = (beside & (jnp.abs(e.y) - across < rss_lateral(w, w_other, self.rss))).any()
        since = jnp.where(unsafe, carry.rss_since + dt, 0)
        idle = (
            unsafe & (since > self.rss.response + dt / 2) & (step.a > -self.rss.brake + 0.01) & (step.v > 0.1)
        )

        # --- rules, progress
        ds = jnp.where(step.on_lane & drove, (cos * velocity[0] + sin * velocity[1]) * dt, 0)
        moved, against = against_flow_update(carry.moved, ds)
        over = jnp.where(step.on_lane, jnp.maximum(speed[step.slot] - step.speed_limit, 0), 0)
        way = jnp.where(drove, speed[step.slot] * dt, 0)
        outside = step.off_road | ~step.on_route
        motion, filtered = motion_update(dt, carry.motion, t=t, v=step.v, a=step.a, heading=box[2])
        limsim = limsim_update(
            dt,
            carry.limsim,
            filtered,
            t=t,
            a=step.a,
            lateral=motion.lateral,
            v=step.v,
            v_others=step.v_others,
            others=step.others,
            limit=step.speed_limit,
            ttc=least,
            red_light=step.red_light,
            in_junction=step.in_junction,
            waits_at_red=step.waits_at_red,
        )

        def share(mean: Mean, flag: Bool[Array, ""]) -> Mean:
            return mean.add(flag.astype(t.dtype), drove)

        return EgoCarry(
            started=jnp.ones((), bool),
            start=jnp.where(drove, carry.start, t),
            now=t,
            to_go=jnp.stack([jnp.where(drove, carry.to_go[0], step.to_go), step.to_go]),
            arrived=carry.arrived,
            over=carry.over,
            distance=carry.distance + way,
            off_route=carry.off_route + jnp.where(outside, way, 0),
            reference=carry.reference + jnp.where(drove, step.speed_limit * dt, 0),
            ttc=carry.ttc.add(least, t, least < NONE),
            ttc_1d=carry.ttc_1d.add(ttc_lead, t, ttc_lead < NONE),
            ttc_2d=carry.ttc_2d.add(ttc_2d, t, ttc_2d < NONE),
            exposed=carry.exposed + jnp.where(drove & (least < EXPOSED), dt, 0),
            near=near,
            near_contact=near_contact,
            near_contacts=near_contacts,
            thw=carry.thw.add(thw, t, thw < NONE),
            drac=carry.drac.add(-drac(gap, step.v, v_lead), t, has_lead),
            pet=pet_update(carry.pet, t, step.zones),
            nearest=carry.nearest.add(nearest, t, nearest < NO_GAP),
            rss_longitudinal=share(carry.rss_longitudinal, unsafe),
            rss_lateral=share(carry.rss_lateral, tight),
            rss_no_response=share(carry.rss_no_response, idle),
            rss_since=since,
            rss_first=carry.rss_first.add(t, t, unsafe | tight),
            contact=contact,
            nuplan_ttc=carry.nuplan_ttc & kept,
            speeding=share(carry.speeding, over > OVER_LIMIT),
            max_overspeed=jnp.maximum(carry.max_overspeed, over),
            overspeed=carry.overspeed + jnp.where(drove, over * dt, 0),
            off_road=share(carry.off_road, step.off_road),
            left_road=carry.left_road.add(t, t, step.off_road),
            moved=moved,
            against_flow=jnp.maximum(carry.against_flow, against),
            wrong_way=share(carry.wrong_way, ds < -0.1 * dt),
            red_lights=carry.red_lights + step.red_light.astype(jnp.int32),
            red_light=carry.red_light.add(t, t, step.red_light),
            stop_signs=carry.stop_signs + step.stop_sign.astype(jnp.int32),
            motion=motion,
            limsim=limsim,
        )

    def result(
        self, carry: EgoCarry, reference_progress: Float[Array, ""] | None = None
    ) -> dict[str, Measured]:
        """All of `NAMES`.

        `reference_progress`: m, what nuPlan's expert drove; without it, what the speed limit would have
        allowed in the same time, at most the whole route.
        """
        dtype = carry.now.dtype

        def number(x: Array) -> Measured:
            return measured(x.astype(dtype), carry.started)

        duration = carry.now - carry.start
        driven = carry.started & (duration > 0)
        progress = carry.to_go[0] - carry.to_go[1]
        completion = jnp.clip(safe_divide(progress, carry.to_go[0], 1.0), 0, 1)
        completion = jnp.where(carry.arrived, 1, completion)
        off_road = carry.left_road.found
        clean = (carry.contact.contacts == 0) & ~off_road
        motion = motion_result(self.dt, carry.motion)
        if reference_progress is None:
            reference_progress = jnp.minimum(carry.reference, carry.to_go[0])
        nuplan = nuplan_score(
            at_fault=carry.contact.faults,
            off_road=off_road,
            against_flow=carry.against_flow,
            progress=progress,
            reference_progress=reference_progress,
            ttc_within_bound=carry.nuplan_ttc,
            overspeed=carry.overspeed,
            duration=duration,
            comfortable=motion["comfortable"].value > 0.5,
        )
        carla = carla_score(
            completion,
            {
                "vehicles": carry.contact.contacts,
                "red_lights": carry.red_lights,
                "stop_signs": carry.stop_signs,
            },
            outside=safe_divide(carry.off_route, carry.distance),
        )
        _, rest = motion_flush(self.dt, carry.motion)
        limsim = {
            "faithful": limsim_faithful(
                carry.limsim, success=carry.arrived & (carry.contact.contacts == 0), completion=completion
            ),
            "corrected": limsim_corrected(
                carry.limsim, rest, failed=(carry.contact.faults > 0) | off_road, completion=completion
            ),
        }
        drac_least = carry.drac.result()
        near_misses = carry.near.number - carry.near_contacts
        results = {
            "arrived": number(carry.arrived),
            "success": number(carry.arrived & clean),
            "completion": measured(completion, carry.started),
            "completion_time": measured(duration, carry.arrived),
            "duration": measured(duration, carry.started),
            "distance": measured(carry.distance, carry.started),
            "progress": measured(progress, carry.started),
            "mean_speed": measured(safe_divide(carry.distance, duration), driven),
            "min_ttc": carry.ttc.result(),
            "min_ttc_time": carry.ttc.when(),
            "min_ttc_1d": carry.ttc_1d.result(),
            "min_ttc_2d": carry.ttc_2d.result(),
            "ttc_exposed": measured(carry.exposed, carry.started),
            "near_misses": number(near_misses),
            "min_thw": carry.thw.result(),
            "max_drac": measured(-drac_least.value, drac_least.valid),
            "max_drac_time": carry.drac.when(),
            "min_pet": carry.pet.least.result(),
            "min_pet_time": carry.pet.least.when(),
            "min_distance": carry.nearest.result(),
            "rss_longitudinal": carry.rss_longitudinal.result(),
            "rss_lateral": carry.rss_lateral.result(),
            "rss_no_response": carry.rss_no_response.result(),
            "rss_first_time": carry.rss_first.when(),
            **{
                name: measured(value, valid & carry.started)
                for name, (value, valid) in contact_result(carry.contact).items()
            },
            "speeding": carry.speeding.result(),
            "max_overspeed": measured(carry.max_overspeed, carry.started),
            "overspeed": measured(carry.overspeed, carry.started),
            "off_road": carry.off_road.result(),
            "off_road_time": carry.left_road.when(),
            "off_route": measured(safe_divide(carry.off_route, carry.distance), carry.distance > 0),
            "against_flow": measured(carry.against_flow, carry.started),
            "wrong_way": carry.wrong_way.result(),
            "red_lights": number(carry.red_lights),
            "red_light_time": carry.red_light.when(),
            "stop_signs": number(carry.stop_signs),
            **motion,
        }
        judged = driven & motion["comfortable"].valid
        for name, value in nuplan._asdict().items():
            name = "nuplan_score" if name == "score" else f"nuplan_{name}"
            results[name] = measured(value, judged)
        results["carla_score"] = measured(carla.score, driven)
        results["carla_penalty"] = measured(carla.penalty, driven)
        for version, score in limsim.items():
            for name in ("total", "drive", "comfort", "efficiency", "safety"):
                results[f"limsim_{version}_{name}"] = measured(getattr(score, name), score.valid)
        results["worst_second"] = carry.limsim.worst.result()
        results["worst_second_time"] = carry.limsim.worst.when()
        return results
