"""A physics step as metrics see it: `EgoStep` is the record, `StepView` what follows from it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.metrics.course import COURSE
from limsim_jax.metrics.safety import (
    FIRM_BRAKING,
    NO_GAP,
    NONE,
    Encounter,
    Zones,
    contact_interval,
    drac,
    encounter,
    first_touch,
    greater,
    reach,
    ttc_1d,
)
from limsim_jax.numerics import safe_norm
from limsim_jax.types import State
from limsim_jax.xla import computed_once


class EgoStep(NamedTuple):
    """The world after a step, around one ego: `N` slots, `Z` conflict zones."""

    t: Float[Array, ""]  # s
    box: Float[Array, "N 5"]  # x, y (m), heading (rad), length, width (m)
    velocity: Float[Array, "N 2"]  # m/s
    active: Bool[Array, " N"]  # on the road, and on the level of the ego
    b_max: Float[Array, " N"]  # m/s^2, hardest braking
    relevant: Bool[Array, " N"]  # their path may meet the ego's: not those that keep to another lane
    meets: Float[Array, " N"]  # s, time from which they may meet the ego along their lanes; `NONE`
    follows: Bool[Array, " N"]  # they drive behind the ego on its path
    leads: Bool[Array, " N"]  # they drive ahead of the ego on its path
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
    moved: Float[Array, ""]  # m travelled in this step, also in that of arrival
    broken: Bool[Array, ""]  # its policy, or the policy's commands, have failed
    off_road: Bool[Array, ""]  # a corner is more than 0.3 m off the drivable area
    in_junction: Bool[Array, ""]
    red_light: Bool[Array, ""]  # crossed a stop line on red in this step
    stop_sign: Bool[Array, ""]  # passed a stop sign without a stop in this step
    waits_at_red: Bool[Array, ""]  # stands within 15 m of a red light
    v_others: Float[Array, ""]  # m/s, mean speed on the same road or on the next lane
    others: Bool[Array, ""]  # there are vehicles there
    zones: Zones
    state: State | None = None  # of all vehicles; kept for metrics of one's own only


@dataclass(frozen=True)
class StepView:
    """A physics step of one ego, with what several metrics need; `N` slots.

    Properties are computed when they are first read. Units: m, s, m/s, m/s^2, rad.

    Attributes:
      record: the step itself.
      dt: s, length of a step.
      drove: False for the record of the start, before anything has been driven.
      touched: vehicles that have touched the ego before this step.
      known_map: the map, where it is known.
    """

    record: EgoStep
    dt: float
    drove: Bool[Array, ""]
    touched: Bool[Array, " N"]
    known_map: LaneMap | None = None

    # --- the ego

    @property
    def time(self) -> Float[Array, ""]:
        """Time since the start of the world, s."""
        return self.record.t

    @property
    def slot(self) -> Int[Array, ""]:
        """Slot of the ego."""
        return self.record.slot

    @property
    def v(self) -> Float[Array, ""]:
        """Speed of the ego along its heading, m/s."""
        return self.record.v

    @property
    def a(self) -> Float[Array, ""]:
        """Acceleration of the ego in this step, m/s^2."""
        return self.record.a

    @cached_property
    def ego_box(self) -> Float[Array, " 5"]:
        """Body of the ego: x, y (m), heading (rad), length, width (m)."""
        return self.record.box[self.slot]

    @cached_property
    def ego_velocity(self) -> Float[Array, " 2"]:
        """Velocity of the ego along x and y, m/s."""
        return self.record.velocity[self.slot]

    @cached_property
    def ego_speed(self) -> Float[Array, ""]:
        """Magnitude of the velocity of the ego, m/s."""
        return self.speeds[self.slot]

    @cached_property
    def driven(self) -> Float[Array, ""]:
        """Distance that the ego has driven in this step, m."""
        return jnp.where(self.drove, self.ego_speed * self.dt, 0)

    @cached_property
    def lane_direction(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Cosine and sine of the heading of the lane at the ego."""
        return jnp.cos(self.record.lane_heading), jnp.sin(self.record.lane_heading)

    # --- all vehicles

    @property
    def box(self) -> Float[Array, "N 5"]:
        """Bodies of all vehicles: x, y (m), heading (rad), length, width (m)."""
        return self.record.box

    @property
    def velocity(self) -> Float[Array, "N 2"]:
        """Velocities along x and y, m/s."""
        return self.record.velocity

    @cached_property
    def speeds(self) -> Float[Array, " N"]:
        """Magnitudes of the velocities, m/s."""
        return safe_norm(self.record.velocity)

    @cached_property
    def others(self) -> Bool[Array, " N"]:
        """Vehicles on the road other than the ego, on its level."""
        slots = jnp.arange(self.record.active.shape[0])
        return self.record.active & (slots != self.slot)

    @cached_property
    def apart(self) -> Bool[Array, " N"]:
        """Other vehicles that have not touched the ego before."""
        return self.others & ~self.touched

    # --- others as the ego sees them

    @cached_property
    def encounter(self) -> Encounter:
        """All vehicles in the axes of the ego, `[N]`."""
        return computed_once(
            encounter(self.ego_box, self.ego_velocity, self.record.box, self.record.velocity)
        )

    @cached_property
    def contact_interval(self) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
        """When bodies begin and cease to touch the ego, s from now.

        Bodies keep their velocities.
        """
        return contact_interval(self.encounter)

    @cached_property
    def ttc(self) -> Float[Array, " N"]:
        """Time to collision of boxes that keep their velocities, s; `NONE` without a collision."""
        return first_touch(*self.contact_interval)

    @cached_property
    def touches(self) -> Bool[Array, " N"]:
        """Boxes that overlap that of the ego now."""
        begin, cease = self.contact_interval
        return (begin <= 0) & (cease >= 0)

    # --- the leader on the lane

    @property
    def leader(self) -> Int[Array, ""]:
        """Slot of the leader, -1 for none."""
        return self.record.lead

    @cached_property
    def has_leader(self) -> Bool[Array, ""]:
        """Whether a vehicle leads the ego on its lane."""
        return (self.leader >= 0) & self.record.active[self.leader]

    @cached_property
    def gap(self) -> Float[Array, ""]:
        """Distance to the leader, bumper to bumper, m; `NO_GAP` for none."""
        return jnp.where(self.has_leader, self.record.lead_gap, NO_GAP)

    @cached_property
    def v_leader(self) -> Float[Array, ""]:
        """Speed of the leader, m/s; 0 for none."""
        return jnp.where(self.has_leader, self.speeds[self.leader], 0)

    # --- least times to collision

    @cached_property
    def least_ttc_1d(self) -> Float[Array, ""]:
        """Time to collision with the leader on the lane, s; `NONE` if the gap does not close."""
        apart = self.has_leader & ~self.touched[self.leader]
        return jnp.where(apart, ttc_1d(self.gap, self.v, self.v_leader), NONE)

    @cached_property
    def ttc_on_course(self) -> Float[Array, " N"]:
        """Time to collision on straight lines and along lanes, s.

        The later of both, `NONE` for none. From `COURSE` s on only straight lines count. A vehicle counts if
        it touches the ego, or if all of these hold:

        - its path may meet that of the ego, or the ego leaves its lane;
        - it meets the ego on straight lines, and within `COURSE` s along the lanes and lane changes of both;
        - it does not close up calmly behind the ego: it would have to brake harder than `FIRM_BRAKING`.
        """
        record = self.record
        leaving = record.changing[self.slot]
        along = record.meets - self.time
        along = jnp.where(self.touches | (self.ttc >= COURSE), 0, along)
        calm = record.follows & self._calm(-1.0)
        counts = ((record.relevant | leaving) & (along < COURSE) & ~calm) | self.touches
        return computed_once(jnp.where(self.apart & counts, greater(self.ttc, along), NONE))

    @cached_property
    def least_ttc_2d(self) -> Float[Array, ""]:
        """Least of `ttc_on_course`, s; `NONE` for none."""
        return jnp.min(self.ttc_on_course)

    @cached_property
    def least_ttc(self) -> Float[Array, ""]:
        """The lesser of both, s."""
        return jnp.minimum(self.least_ttc_2d, self.least_ttc_1d)

    @cached_property
    def least_ttc_other(self) -> Int[Array, ""]:
        """Slot of the vehicle with that time."""
        other = _first(self.ttc_on_course == self.least_ttc_2d).astype(self.leader.dtype)
        return jnp.where(self.least_ttc_1d < self.least_ttc_2d, self.leader, other)

    @cached_property
    def urgent_ttc(self) -> tuple[Float[Array, ""], Int[Array, ""]]:
        """Least urgent time to collision, s, and slot of that vehicle.

        As `least_ttc`, but a vehicle that the ego closes up to from behind counts only if the ego must brake
        harder than `FIRM_BRAKING`.
        """
        ttc = computed_once(jnp.where(self.record.leads & self._calm(1.0), NONE, self.ttc_on_course))
        lane = jnp.where(drac(self.gap, self.v, self.v_leader) > FIRM_BRAKING, self.least_ttc_1d, NONE)
        least = jnp.min(ttc)
        other = _first(ttc == least).astype(self.leader.dtype)
        return jnp.minimum(least, lane), jnp.where(lane < least, self.leader, other)

    def _calm(self, side: float) -> Bool[Array, " N"]:
        """Whether the rear one of two vehicles can brake calmly.

        The other one is ahead of the ego (`side` 1) or behind it (-1). Calm is up to `FIRM_BRAKING`.
        """
        e = self.encounter
        room = jnp.maximum(side * e.x - reach(e)[0], 0)  # m, from front to tail
        return drac(room, -side * e.u, jnp.zeros_like(e.u)) <= FIRM_BRAKING

    # --- for metrics of one's own

    @property
    def state(self) -> State:
        """State of all vehicles, signals and queues after the step."""
        if self.record.state is None:
            raise ValueError("this record keeps no state; EvaluateEgo keeps it for its own `metrics`")
        return self.record.state

    @property
    def lane_map(self) -> LaneMap:
        """The map."""
        if self.known_map is None:
            raise ValueError("this step knows no map; EvaluateEgo hands it to its own `metrics`")
        return self.known_map

    @property
    def lane(self) -> Int[Array, ""]:
        """Lane of the ego, a row of the map; -1 off all lanes."""
        return self.state.lane[self.slot]

    @property
    def s(self) -> Float[Array, ""]:
        """Front bumper of the ego along its lane, m."""
        return self.state.s[self.slot]

    @property
    def d(self) -> Float[Array, ""]:
        """Offset of the ego from its lane centre, m, left > 0."""
        return self.state.d[self.slot]


def _first(flags: Bool[Array, " N"]) -> Int[Array, ""]:
    """The first one that is set; vectorised, which `argmax` is not."""
    return jnp.min(jnp.where(flags, jnp.arange(flags.shape[0]), flags.shape[0] - 1))
