"""Rules of the road: speed limits, drivable area and route, direction of lanes, lights and signs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from limsim_jax.metrics.description import Description
from limsim_jax.metrics.measure import Derived, Measure, Summary
from limsim_jax.metrics.reductions import Least, Mean, Measured, measured
from limsim_jax.metrics.scores import OVER_LIMIT, against_flow_init, against_flow_update
from limsim_jax.metrics.step import StepView
from limsim_jax.numerics import safe_divide

_NO_STEP = "The ego was on the road for no full step."


class SpeedingCarry(NamedTuple):
    """Memory of `Speeding`."""

    share: Mean
    most: Float[Array, ""]  # m/s
    total: Float[Array, ""]  # m


class Speeding(Measure):
    """Speed above the limit of the lane."""

    name = "speeding"
    columns = (
        Description(
            "speeding", "share of the time more than 0.01 m/s above the limit", "Drive and rules", "lower",
            formula="Steps with v > limit of the lane + 0.01 m/s, of all steps; off all lanes there is no "
            "limit.",
            missing=_NO_STEP,
        ),
        Description(
            "max_overspeed", "m/s above the limit", "Drive and rules", "lower",
            formula="Greatest v - limit, at least 0."
        ),
        Description(
            "overspeed", "m, integral of the speed above the limit", "Drive and rules", "lower",
            formula="Sum of max(v - limit, 0) x dt.",
            source="nuplan-devkit, speed_limit_compliance.py",
        ),
    )  # fmt: skip

    def init(self, slots: int, zones: int) -> SpeedingCarry:
        """Nothing driven."""
        return SpeedingCarry(Mean.empty(), jnp.zeros(()), jnp.zeros(()))

    def update(self, carry: SpeedingCarry, step: StepView, derived: Derived) -> SpeedingCarry:
        """Add the speed of this step."""
        record = step.record
        over = jnp.where(record.on_lane, jnp.maximum(step.ego_speed - record.speed_limit, 0), 0)
        return SpeedingCarry(
            share=carry.share.add((over > OVER_LIMIT).astype(step.time.dtype), step.drove),
            most=jnp.maximum(carry.most, over),
            total=carry.total + jnp.where(step.drove, over * step.dt, 0),
        )

    def result(self, carry: SpeedingCarry, summary: Summary) -> dict[str, Measured]:
        """All columns."""
        return {
            "speeding": carry.share.result(),
            "max_overspeed": measured(carry.most, summary.started),
            "overspeed": measured(carry.total, summary.started),
        }


class RoadCarry(NamedTuple):
    """Memory of `Road`."""

    off_road: Mean
    left_road: Least
    off_route: Float[Array, ""]  # m


class Road(Measure):
    """Drivable area, and lanes of the route."""

    name = "road"
    columns = (
        Description(
            "off_road", "share of the time off the drivable area", "Drive and rules", "lower",
            formula="Steps with a corner of the ego more than 0.3 m outside the drivable area, of all steps.",
            source="nuplan-devkit, drivable_area_compliance.py",
            missing=_NO_STEP,
        ),
        Description(
            "off_road_time", "s, when it first left the drivable area", "Drive and rules",
            formula="Time of the first step that counts for off_road.",
            missing="The ego stayed on the drivable area.",
        ),
        Description(
            "off_route", "share of the distance driven off the road or off the lanes of the route",
            "Drive and rules",
            "lower",
            formula="Distance driven off the drivable area, or on a lane from which the goal cannot be "
            "reached, "
            "of distance.",
            source="CARLA leaderboard 2.0, OutsideRouteLanesTest",
            missing="The ego did not move.",
        ),
    )  # fmt: skip

    def init(self, slots: int, zones: int) -> RoadCarry:
        """Nothing driven."""
        return RoadCarry(Mean.empty(), Least.empty(), jnp.zeros(()))

    def update(self, carry: RoadCarry, step: StepView, derived: Derived) -> RoadCarry:
        """Add the place of this step."""
        record, t = step.record, step.time
        outside = record.off_road | ~record.on_route
        return RoadCarry(
            off_road=carry.off_road.add(record.off_road.astype(t.dtype), step.drove),
            left_road=carry.left_road.add(t, t, record.off_road),
            off_route=carry.off_route + jnp.where(outside, step.driven, 0),
        )

    def result(self, carry: RoadCarry, summary: Summary) -> dict[str, Measured]:
        """All columns."""
        off_route = safe_divide(carry.off_route, summary.distance)
        return {
            "off_road": carry.off_road.result(),
            "off_road_time": carry.left_road.when(),
            "off_route": measured(off_route, summary.distance > 0),
        }


class DirectionCarry(NamedTuple):
    """Memory of `Direction`."""

    moved: Float[Array, " W"]  # m along the lane, the last steps
    most: Float[Array, ""]  # m
    wrong_way: Mean


@dataclass(frozen=True)
class Direction(Measure):
    """Driving against the direction of the lane.

    Attributes:
      dt: s between steps.
    """

    dt: float

    name = "direction"
    columns = (
        Description(
            "against_flow", "m, most driven against the lane's direction within a second", "Drive and rules",
            "lower",
            formula="Greatest net displacement against the lane in a window of one second and one step.",
            source="nuplan-devkit, driving_direction_compliance.py",
        ),
        Description(
            "wrong_way", "share of the time driving against the lane's direction", "Drive and rules", "lower",
            formula="Steps in which the ego moves against its lane faster than 0.1 m/s, of all steps.",
            missing=_NO_STEP,
        ),
    )  # fmt: skip

    def init(self, slots: int, zones: int) -> DirectionCarry:
        """Nothing driven."""
        return DirectionCarry(against_flow_init(round(1 / self.dt) + 1), jnp.zeros(()), Mean.empty())

    def update(self, carry: DirectionCarry, step: StepView, derived: Derived) -> DirectionCarry:
        """Add the displacement of this step."""
        cos, sin = step.lane_direction
        along = (cos * step.ego_velocity[0] + sin * step.ego_velocity[1]) * step.dt
        ds = jnp.where(step.record.on_lane & step.drove, along, 0)
        moved, against = against_flow_update(carry.moved, ds)
        return DirectionCarry(
            moved=moved,
            most=jnp.maximum(carry.most, against),
            wrong_way=carry.wrong_way.add((ds < -0.1 * step.dt).astype(step.time.dtype), step.drove),
        )

    def result(self, carry: DirectionCarry, summary: Summary) -> dict[str, Measured]:
        """All columns."""
        return {
            "against_flow": measured(carry.most, summary.started),
            "wrong_way": carry.wrong_way.result(),
        }


class SignalsCarry(NamedTuple):
    """Memory of `Signals`."""

    red_lights: Int[Array, ""]
    first_red: Least
    stop_signs: Int[Array, ""]


class Signals(Measure):
    """Red lights and stop signs."""

    name = "signals"
    columns = (
        Description(
            "red_lights", "stop lines crossed on red", "Drive and rules", "lower",
            formula="Steps in which the front bumper crosses the stop line of a lane whose light is red.",
        ),
        Description(
            "red_light_time", "s, when it first did", "Drive and rules",
            formula="Time of the first step that counts for red_lights.",
            missing="No stop line was crossed on red.",
        ),
        Description(
            "stop_signs", "stop signs passed without a stop", "Drive and rules", "lower",
            formula="Connectors with a stop sign entered without a stop before them.",
        ),
    )  # fmt: skip

    def init(self, slots: int, zones: int) -> SignalsCarry:
        """Nothing passed."""
        none = jnp.zeros((), jnp.int32)
        return SignalsCarry(none, Least.empty(), none)

    def update(self, carry: SignalsCarry, step: StepView, derived: Derived) -> SignalsCarry:
        """Add lights and signs of this step."""
        record, t = step.record, step.time
        return SignalsCarry(
            red_lights=carry.red_lights + record.red_light.astype(jnp.int32),
            first_red=carry.first_red.add(t, t, record.red_light),
            stop_signs=carry.stop_signs + record.stop_sign.astype(jnp.int32),
        )

    def result(self, carry: SignalsCarry, summary: Summary) -> dict[str, Measured]:
        """All columns."""
        return {
            "red_lights": summary.number(carry.red_lights),
            "red_light_time": carry.first_red.when(),
            "stop_signs": summary.number(carry.stop_signs),
        }
