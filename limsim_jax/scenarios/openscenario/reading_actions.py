"""From elements to values: actions."""

from __future__ import annotations

from limsim_jax.scenarios.openscenario.expressions import Value
from limsim_jax.scenarios.openscenario.reading import Reader
from limsim_jax.scenarios.openscenario.source import Node
from limsim_jax.scenarios.openscenario.storyboard import (
    ControllerAction,
    Does,
    Dynamics,
    EntityAction,
    FollowTrajectoryAction,
    LaneChangeAction,
    LaneOffsetAction,
    LateralDistanceAction,
    Limits,
    LongitudinalDistanceAction,
    NoAction,
    Route,
    RouteAction,
    SpeedAction,
    SpeedProfileAction,
    SynchronizeAction,
    TeleportAction,
    Trajectory,
    ValueAction,
    VisibilityAction,
)

SHAPES = ("step", "linear", "sinusoidal", "cubic")
DIMENSIONS = ("time", "rate", "distance")
_SIDES = ("any", "leftToReferencedEntity", "rightToReferencedEntity")
_ENDS = ("any", "trailingReferencedEntity", "leadingReferencedEntity")
_SYSTEMS = ("entity", "lane", "road", "trajectory", "world")


class ActionReader:
    """Reads actions of one scenario.

    Attributes:
      read: positions, entities and routes.
      values: names of parameters and variables that actions may change.
    """

    def __init__(self, read: Reader, values: set[str]) -> None:
        self.read, self.values = read, values

    def action(self, node: Node) -> list[Does]:
        """The actions within `<Action>`, `<GlobalAction>` or `<PrivateAction>`.

        There is more than one where a controller is assigned and overridden at once.
        """
        if node.tag == "Action":
            one = node.only(("PrivateAction", "GlobalAction", "UserDefinedAction"))
            return [NoAction(element="Action")] if one is None else self.action(one)
        if node.tag == "UserDefinedAction":
            node.skip("ignored: what it asks for is not known")
            return [NoAction(element=node.tag)]
        if node.tag == "GlobalAction":
            return [self._global(node)]
        return self._private(node)

    # --- of the world

    def _global(self, node: Node) -> Does:
        one = node.only(
            ("EnvironmentAction", "EntityAction", "ParameterAction", "VariableAction", "SetMonitorAction")
        )
        if one is None:
            return NoAction(element=node.tag)
        if one.tag == "EnvironmentAction":
            for reference in one.children("CatalogReference"):
                self.read.catalogs.entry(reference, "Environment").pass_over()
            one.skip("ignored: weather, light and wet roads change nothing")
            return NoAction(element=one.tag)
        if one.tag == "SetMonitorAction":
            one.skip("ignored: monitors change nothing")
            return NoAction(element=one.tag)
        if one.tag == "EntityAction":
            entity = self.read.entity(one.text("entityRef"), one)
            does = one.only(("AddEntityAction", "DeleteEntityAction"))
            if does is None:
                return NoAction(element=one.tag)
            add = does.tag == "AddEntityAction"
            place = self.read.position(does.child("Position")) if add else None
            return EntityAction(entity=entity, position=place)
        return self._value(one)

    def _value(self, node: Node) -> Does:
        kind = node.tag.removesuffix("Action")  # "Parameter" or "Variable"
        name = node.raw(f"{kind.lower()}Ref").removeprefix("$")
        if name not in self.values:
            raise node.error(f"{kind.lower()} '{name}' is not declared")
        one = node.only(("SetAction", "ModifyAction"))
        if one is None:
            return NoAction(element=node.tag)
        if one.tag == "SetAction":
            value: Value = one.value("value")
            return ValueAction(name=name, how="set", value=value)
        rule = one.child("Rule").only(("AddValue", "MultiplyByValue"))
        if rule is None:
            return NoAction(element=node.tag)
        how = "add" if rule.tag == "AddValue" else "multiply"
        return ValueAction(name=name, how=how, value=rule.number("value"))

    # --- of an entity

    def _private(self, node: Node) -> list[Does]:
        known = (
            "LongitudinalAction", "LateralAction", "VisibilityAction", "SynchronizeAction",
            "ActivateControllerAction", "ControllerAction", "TeleportAction", "RoutingAction",
            "AppearanceAction",
        )  # fmt: skip
        one = node.only(known)
        if one is None:
            return [NoAction(element=node.tag)]
        if one.tag == "AppearanceAction":
            one.skip("ignored: lights and gestures change nothing")
            return [NoAction(element=one.tag)]
        if one.tag == "ControllerAction":
            return self._controller(one)
        if one.tag == "ActivateControllerAction":
            return [self._activate(one)]
        if one.tag == "TeleportAction":
            return [TeleportAction(position=self.read.position(one.child("Position")))]
        if one.tag == "VisibilityAction":
            for flag in ("graphics", "sensors"):
                one.flag(flag)
            for sensors in one.children("SensorReferenceSet"):
                sensors.skip("ignored: no single sensor is switched off")
            return [VisibilityAction(traffic=one.flag("traffic"))]
        if one.tag == "SynchronizeAction":
            return [self._synchronize(one)]
        if one.tag == "RoutingAction":
            return [self._routing(one)]
        if one.tag == "LateralAction":
            return [self._lateral(one)]
        return [self._longitudinal(one)]

    def _controller(self, node: Node) -> list[Does]:
        found: list[Does] = []
        for one in node.every():
            if one.tag == "AssignControllerAction":
                active = bool(one.flag("activateLateral", False)) or bool(
                    one.flag("activateLongitudinal", False)
                )
                self.read.read_controller(one)
                found.append(ControllerAction(active=True) if active else NoAction(element=one.tag))
            elif one.tag == "ActivateControllerAction":
                found.append(self._activate(one))
            elif one.tag == "OverrideControllerValueAction":
                active = any(x.flag("active", False) for x in one.every())
                if active:
                    one.skip("ignored: pedals and the steering wheel of a controller are its own")
                else:
                    one.pass_over()
                found.append(NoAction(element=one.tag))
            else:
                node.source.refuse(one, "is no action of a controller")
        if not found:
            raise node.error("is empty")
        return found

    def _activate(self, node: Node) -> Does:
        both = [node.flag(x, None) for x in ("longitudinal", "lateral")]
        if all(x is None for x in both):
            return NoAction(element=node.tag)
        return ControllerAction(active=any(both))

    def _dynamics(self, node: Node) -> Dynamics:
        shape = node.choice("dynamicsShape", SHAPES)
        dimension = node.choice("dynamicsDimension", DIMENSIONS)
        following = node.choice("followingMode", ("position", "follow"), "position")
        if following == "follow":
            node.source.note(f"<{node.tag}>: followingMode 'follow' is treated as 'position'")
        value = node.number("value", infinite=True) if shape != "step" else node.number("value", 0.0)
        if dimension != "rate" and value < 0:
            raise node.error(f"attribute 'value' is {value:g}; at least 0 is expected")
        return Dynamics(shape=shape, dimension=dimension, value=abs(value))

    def _limits(self, node: Node) -> Limits | None:
        one = node.optional("DynamicConstraints")
        if one is None:
            return None
        names = ("maxAcceleration", "maxDeceleration", "maxSpeed")
        a, b, v = (one.number(name, float("inf"), least=0, infinite=True) for name in names)
        return Limits(acceleration=a, deceleration=b, speed=v)

    def _longitudinal(self, node: Node) -> Does:
        one = node.only(("SpeedAction", "LongitudinalDistanceAction", "SpeedProfileAction"))
        if one is None:
            return NoAction(element=node.tag)
        if one.tag == "SpeedProfileAction":
            entity = one.text("entityRef", None)
            one.choice("followingMode", ("position", "follow"), "position")
            speeds, times = [], []
            for entry in one.children("SpeedProfileEntry"):
                speeds.append(entry.number("speed"))
                time = entry.number("time", None, least=0)
                if time is None:
                    raise entry.error("not supported: an entry without a time")
                times.append(time)
            if not speeds:
                raise one.error("has no entries")
            if one.optional("DynamicConstraints") is not None:
                self._limits(one)
                one.source.note("<SpeedProfileAction>: <DynamicConstraints> are not applied")
            relative = None if entity is None else self.read.entity(entity, one)
            return SpeedProfileAction(speeds=tuple(speeds), times=tuple(times), entity=relative)
        if one.tag == "SpeedAction":
            return self._speed(one)
        distance, gap = one.number("distance", None, least=0), one.number("timeGap", None, least=0)
        if (distance is None) == (gap is None):
            raise one.error("one of 'distance' and 'timeGap' is expected")
        one.choice("coordinateSystem", _SYSTEMS, "entity")
        return LongitudinalDistanceAction(
            entity=self.read.entity(one.text("entityRef"), one),
            distance=distance,
            time_gap=gap,
            freespace=one.flag("freespace"),
            displacement=one.choice("displacement", _ENDS, "trailingReferencedEntity"),
            continuous=one.flag("continuous"),
            limits=self._limits(one),
        )

    def _speed(self, node: Node) -> Does:
        dynamics = self._dynamics(node.child("SpeedActionDynamics"))
        target = node.child("SpeedActionTarget").only(("AbsoluteTargetSpeed", "RelativeTargetSpeed"))
        if target is None:
            return NoAction(element=node.tag)
        value = target.number("value")
        if target.tag == "AbsoluteTargetSpeed":
            return SpeedAction(dynamics=dynamics, value=value)
        return SpeedAction(
            dynamics=dynamics,
            value=value,
            entity=self.read.entity(target.text("entityRef"), target),
            factor=target.choice("speedTargetValueType", ("delta", "factor"), "delta") == "factor",
            continuous=target.flag("continuous", False),
        )

    def _lateral(self, node: Node) -> Does:
        one = node.only(("LaneChangeAction", "LaneOffsetAction", "LateralDistanceAction"))
        if one is None:
            return NoAction(element=node.tag)
        if one.tag == "LaneChangeAction":
            dynamics = self._dynamics(one.child("LaneChangeActionDynamics"))
            target = one.child("LaneChangeTarget").only(("AbsoluteTargetLane", "RelativeTargetLane"))
            if target is None:
                return NoAction(element=one.tag)
            relative = target.tag == "RelativeTargetLane"
            return LaneChangeAction(
                dynamics=dynamics,
                lane=target.integer("value"),
                entity=self.read.entity(target.text("entityRef"), target) if relative else None,
                offset=one.number("targetLaneOffset", 0.0),
            )
        if one.tag == "LaneOffsetAction":
            how = one.child("LaneOffsetActionDynamics")
            target = one.child("LaneOffsetTarget").only(
                ("AbsoluteTargetLaneOffset", "RelativeTargetLaneOffset")
            )
            if target is None:
                return NoAction(element=one.tag)
            relative = target.tag == "RelativeTargetLaneOffset"
            return LaneOffsetAction(
                shape=how.choice("dynamicsShape", SHAPES),
                max_acceleration=how.number("maxLateralAcc", None, above=0, infinite=True),
                value=target.number("value"),
                entity=self.read.entity(target.text("entityRef"), target) if relative else None,
                continuous=one.flag("continuous", False),
            )
        one.choice("coordinateSystem", _SYSTEMS, "entity")
        return LateralDistanceAction(
            entity=self.read.entity(one.text("entityRef"), one),
            distance=one.number("distance", 0.0, least=0),
            freespace=one.flag("freespace"),
            displacement=one.choice("displacement", _SIDES, "any"),
            continuous=one.flag("continuous"),
            limits=self._limits(one),
        )

    def _synchronize(self, node: Node) -> Does:
        speed, relative, steady, steady_time = None, None, 0.0, 0.0
        final = node.optional("FinalSpeed")
        if final is not None:
            one = final.only(("AbsoluteSpeed", "RelativeSpeedToMaster"))
            if one is not None:
                speed = one.number("value")
                if one.tag == "RelativeSpeedToMaster":
                    relative = one.choice("speedTargetValueType", ("delta", "factor"))
                for last in one.children("TargetDistanceSteadyState"):
                    steady = last.number("distance", least=0)
                for last in one.children("TargetTimeSteadyState"):
                    steady_time = last.number("time", least=0)
        return SynchronizeAction(
            master=self.read.entity(node.text("masterEntityRef"), node),
            master_target=self.read.position(node.child("TargetPositionMaster")),
            target=self.read.position(node.child("TargetPosition")),
            speed=speed,
            relative=relative,
            steady=steady,
            steady_time=steady_time,
            master_tolerance=node.number("targetToleranceMaster", 0.0, least=0),
            tolerance=node.number("targetTolerance", 0.0, least=0),
        )

    def _routing(self, node: Node) -> Does:
        one = node.only(("AssignRouteAction", "FollowTrajectoryAction", "AcquirePositionAction"))
        if one is None:
            return NoAction(element=node.tag)
        if one.tag == "AssignRouteAction":
            return RouteAction(route=self.read.route(one))
        if one.tag == "AcquirePositionAction":
            place = self.read.position(one.child("Position"))
            return RouteAction(route=Route(name="", waypoints=(place,)), acquire=True)
        timing = one.child("TimeReference").only(("None", "Timing"))
        mode = one.optional("TrajectoryFollowingMode")
        if mode is not None and mode.choice("followingMode", ("position", "follow")) == "follow":
            one.source.note("<FollowTrajectoryAction>: followingMode 'follow' is treated as 'position'")
        reference = one.optional("TrajectoryRef")
        if reference is not None:
            trajectory = self.read.trajectory(reference)
        else:
            trajectory = self._old_trajectory(one)
        if timing is not None and timing.tag == "Timing":
            relative = timing.choice("domainAbsoluteRelative", ("absolute", "relative")) == "relative"
            scale, offset = timing.number("scale", above=0), timing.number("offset")
            if trajectory.times is None:
                one.source.note("<FollowTrajectoryAction>: without times of all vertices, by its own speed")
            return FollowTrajectoryAction(
                trajectory=trajectory, timed=trajectory.times is not None, relative=relative,
                scale=scale, offset=offset, start=one.number("initialDistanceOffset", 0.0, least=0),
            )  # fmt: skip
        return FollowTrajectoryAction(
            trajectory=trajectory, timed=False, start=one.number("initialDistanceOffset", 0.0, least=0)
        )

    def _old_trajectory(self, node: Node) -> Trajectory:
        """The trajectory of version 1.0, which stands in the action itself."""
        found = node.children("Trajectory", "CatalogReference")
        if len(found) != 1:
            raise node.error("one of TrajectoryRef, Trajectory, CatalogReference is expected")
        return self.read.trajectory_of(found[0])
