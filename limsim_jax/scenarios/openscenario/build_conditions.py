"""Conditions as rows of arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from limsim_jax.scenarios.openscenario import storyboard as sb
from limsim_jax.scenarios.openscenario.arrays import Along, Change, Frame, Phase, Rule, Test
from limsim_jax.scenarios.openscenario.padding import no_condition
from limsim_jax.scenarios.openscenario.scenario import names_element

if TYPE_CHECKING:
    from limsim_jax.scenarios.openscenario.build import Builder

RULES = {
    "equalTo": Rule.EQUAL,
    "notEqualTo": Rule.NOT_EQUAL,
    "greaterThan": Rule.GREATER,
    "greaterOrEqual": Rule.GREATER_EQUAL,
    "lessThan": Rule.LESS,
    "lessOrEqual": Rule.LESS_EQUAL,
}
_PHASES = {
    "standbyState": Phase.STANDBY,
    "runningState": Phase.RUNNING,
    "completeState": Phase.COMPLETE,
}
_CHANGES = {
    "startTransition": Change.START,
    "endTransition": Change.END,
    "stopTransition": Change.STOP,
    "skipTransition": Change.SKIP,
}
_FRAMES = {"world": Frame.WORLD, "entity": Frame.ENTITY}
_ALONG = {"longitudinal": Along.LONGITUDINAL, "lateral": Along.LATERAL}
BODIES = {"vehicle": 0, "pedestrian": 1, "miscellaneous": 2, "external": 3}
"""Numbers of kinds of entities."""


def condition_row(builder: Builder, condition: sb.Condition) -> dict[str, Any]:
    """The columns of `Conditions` that the test itself fills."""
    row, test = no_condition(), condition.test
    if isinstance(test, sb.Compare):
        row |= {"rule": RULES[test.rule], "value": test.value}

    def target(where: str | sb.Position) -> dict[str, Any]:
        if isinstance(where, str):
            return {"entity": builder.index(where)}
        return {"place": builder.place_row(where)}

    def measured(gap: sb.Gap) -> dict[str, Any]:
        return {
            "frame": _FRAMES.get(gap.coordinates, Frame.ROAD),
            "along": _ALONG.get(gap.direction, Along.EUCLIDEAN),
            "freespace": gap.freespace,
        }

    def direction(name: str | None) -> int:
        return _ALONG.get(name or "", Along.EUCLIDEAN)

    match test:
        case sb.SimulationTime():
            row["test"] = Test.TIME
        case sb.ValueCondition():
            names = list(builder.values)
            row |= {"test": Test.VALUE, "variable": names.index(test.name), "rule": RULES[test.rule]}
            row["value"] = builder.number(test.value)
        case sb.ElementState():
            row |= {"test": Test.ELEMENT, "phase": _PHASES.get(test.state, -1)}
            row["change"] = _CHANGES.get(test.state, 0)
            row["elements"] = [
                kind == test.kind and names_element(test.element, full) for kind, full in builder.tables.names
            ]
        case sb.TimeHeadway():
            row |= {"test": Test.HEADWAY} | target(test.entity) | measured(test.gap)
        case sb.TimeToCollision():
            row |= {"test": Test.COLLISION_TIME} | target(test.target) | measured(test.gap)
        case sb.Distance():
            row |= {"test": Test.DISTANCE} | target(test.target) | measured(test.gap)
        case sb.ReachPosition():
            row |= {"test": Test.REACH, "value": test.tolerance} | target(test.position)
        case sb.Speed():
            row |= {"test": Test.SPEED, "along": direction(test.direction)}
        case sb.RelativeSpeed():
            row |= {"test": Test.RELATIVE_SPEED, "along": direction(test.direction)} | target(test.entity)
        case sb.Acceleration():
            row |= {"test": Test.ACCELERATION, "along": direction(test.direction)}
        case sb.StandStill():
            row |= {"test": Test.STAND_STILL, "value": test.duration}
        case sb.TraveledDistance():
            row |= {"test": Test.TRAVELED, "value": test.value}
        case sb.EndOfRoad():
            row |= {"test": Test.END_OF_ROAD, "value": test.duration}
        case sb.Offroad():
            row |= {"test": Test.OFFROAD, "value": test.duration}
        case sb.Collision():
            row["test"] = Test.COLLISION
            if test.entity is not None:
                row["entity"] = builder.index(test.entity)
            elif test.kind is not None:
                row["kind"] = BODIES[test.kind]
        case sb.Angle():
            row |= {"test": Test.ANGLE, "value": test.angle, "tolerance": test.tolerance}
            row["entity"] = builder.index(test.entity)
            row["frame"] = _FRAMES.get(test.coordinates, Frame.ROAD)
        case sb.Never():
            row["test"] = Test.NEVER
    return row
