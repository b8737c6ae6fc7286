"""From elements to values: conditions and the storyboard."""

from __future__ import annotations

from collections.abc import Callable

from limsim_jax.scenarios.openscenario.catalogs import with_parameters
from limsim_jax.scenarios.openscenario.parameters import RULES, read_declarations, settle
from limsim_jax.scenarios.openscenario.reading import Reader
from limsim_jax.scenarios.openscenario.reading_actions import ActionReader
from limsim_jax.scenarios.openscenario.source import Node
from limsim_jax.scenarios.openscenario.storyboard import (
    ELEMENTS,
    Acceleration,
    Act,
    Action,
    Angle,
    Collision,
    Condition,
    Distance,
    ElementState,
    EndOfRoad,
    Event,
    Gap,
    Maneuver,
    ManeuverGroup,
    Never,
    Offroad,
    Position,
    ReachPosition,
    RelativeSpeed,
    SimulationTime,
    Speed,
    StandStill,
    Story,
    Storyboard,
    Test,
    TimeHeadway,
    TimeToCollision,
    TraveledDistance,
    Trigger,
    ValueCondition,
)

EDGES = ("none", "rising", "falling", "risingOrFalling")
STATES = (
    "standbyState", "runningState", "completeState", "startTransition", "endTransition", "stopTransition",
    "skipTransition",
)  # fmt: skip
_DIRECTIONS = ("longitudinal", "lateral", "euclidianDistance", "cartesianDistance")
_SYSTEMS = ("entity", "lane", "road", "trajectory", "world")
_PRIORITIES = {"overwrite": "override", "override": "override", "parallel": "parallel", "skip": "skip"}
MOST_TIMES = 1000
"""Times that something of the storyboard is executed, at most."""


class StoryReader:
    """Reads the storyboard of one scenario."""

    def __init__(self, read: Reader, values: set[str]) -> None:
        self.read, self.values = read, values
        self.actions = ActionReader(read, values)

    def storyboard(self, node: Node) -> Storyboard:
        """The whole of it."""
        start: list[tuple[str, Action]] = []
        init = node.optional("Init")
        block = None if init is None else init.optional("Actions")
        for one in [] if block is None else block.every():
            if one.tag in ("GlobalAction", "UserDefinedAction"):
                start += [("", Action(name="", does=x)) for x in self.actions.action(one)]
            elif one.tag == "Private":
                entities = self.read.members(one.text("entityRef"), one)
                for action in one.children("PrivateAction"):
                    does = self.actions.action(action)
                    start += [(entity, Action(name="", does=x)) for entity in entities for x in does]
            else:
                node.source.refuse(one, "is no action of the start")
        stories = tuple(self._story(x) for x in node.children("Story"))
        stop = node.optional("StopTrigger")
        return Storyboard(
            start=tuple(start), stories=stories, stop=() if stop is None else self.trigger(stop)
        )

    def _story(self, node: Node) -> Story:
        node = node.scoped(settle(read_declarations(node), None, node.scope))
        return Story(name=node.label(), acts=tuple(self._act(x) for x in node.children("Act")))

    def _act(self, node: Node) -> Act:
        start, stop = node.optional("StartTrigger"), node.optional("StopTrigger")
        return Act(
            name=node.label(),
            groups=tuple(self._group(x) for x in node.children("ManeuverGroup")),
            start=None if start is None else self.trigger(start),
            stop=() if stop is None else self.trigger(stop),
        )

    def _times(self, node: Node) -> int:
        times = node.integer("maximumExecutionCount", 1, least=0)
        if times > MOST_TIMES:
            node.source.note(f"<{node.tag}>: maximumExecutionCount {times} is treated as {MOST_TIMES}")
        return min(times, MOST_TIMES)

    def _group(self, node: Node) -> ManeuverGroup:
        block = node.child("Actors")
        actors: list[str] = []
        for one in block.children("EntityRef"):
            actors += self.read.members(one.text("entityRef"), one)
        maneuvers = []
        for one in node.children("CatalogReference", "Maneuver"):
            found = (
                self.read.catalogs.entry(one, "Maneuver")
                if one.tag == "CatalogReference"
                else with_parameters(one, {})
            )
            maneuvers.append(self._maneuver(found))
            self.read.catalogs.notes_and_check(found)
        return ManeuverGroup(
            name=node.label(),
            actors=tuple(dict.fromkeys(actors)),
            maneuvers=tuple(maneuvers),
            triggering=block.flag("selectTriggeringEntities", False),
            most=self._times(node),
        )

    def _maneuver(self, node: Node) -> Maneuver:
        return Maneuver(name=node.label(), events=tuple(self._event(x) for x in node.children("Event")))

    def _event(self, node: Node) -> Event:
        actions: list[Action] = []
        for one in node.children("Action"):
            actions += [Action(name=one.label(), does=x) for x in self.actions.action(one)]
        if not actions:
            raise node.error("has no action")
        start = node.optional("StartTrigger")
        return Event(
            name=node.label(),
            actions=tuple(actions),
            start=None if start is None else self.trigger(start),
            priority=_PRIORITIES[node.choice("priority", _PRIORITIES, "parallel")],
            most=self._times(node),
        )

    # --- conditions

    def trigger(self, node: Node) -> Trigger:
        """Groups of conditions."""
        groups = []
        for group in node.children("ConditionGroup"):
            found = tuple(self._condition(x) for x in group.children("Condition"))
            if found:
                groups.append(found)
        return tuple(groups)

    def _condition(self, node: Node) -> Condition:
        name, edge = node.label(), node.choice("conditionEdge", EDGES, "none")
        delay = node.number("delay", 0.0, least=0)
        one = node.only(("ByEntityCondition", "ByValueCondition"))
        if one is None:
            return Condition(name=name, test=Never(element=node.tag))
        if one.tag == "ByValueCondition":
            return Condition(name=name, test=self._by_value(one), edge=edge, delay=delay)
        who = one.child("TriggeringEntities")
        every = who.choice("triggeringEntitiesRule", ("any", "all")) == "all"
        entities: list[str] = []
        for x in who.children("EntityRef"):
            entities += self.read.members(x.text("entityRef"), x)
        if not entities:
            raise who.error("names no entity")
        test = self._by_entity(one.child("EntityCondition"))
        return Condition(
            name=name, test=test, edge=edge, delay=delay, entities=tuple(dict.fromkeys(entities)), every=every
        )

    def _by_value(self, node: Node) -> Test:
        one = node.only(
            (
                "ParameterCondition",
                "VariableCondition",
                "SimulationTimeCondition",
                "StoryboardElementStateCondition",
                "UserDefinedValueCondition",
            )
        )
        if one is None:
            return Never(element=node.tag)
        if one.tag == "SimulationTimeCondition":
            return SimulationTime(rule=one.choice("rule", RULES), value=one.number("value"))
        if one.tag == "StoryboardElementStateCondition":
            return ElementState(
                kind=one.choice("storyboardElementType", ELEMENTS),
                element=one.label("storyboardElementRef"),
                state=one.choice("state", STATES),
            )
        if one.tag == "UserDefinedValueCondition":
            one.skip("never true: what it asks for is not known")
            return Never(element=one.tag)
        kind = "parameterRef" if one.tag == "ParameterCondition" else "variableRef"
        name = one.raw(kind).removeprefix("$")
        rule, value = one.choice("rule", RULES), one.value("value")
        if name not in self.values:
            one.source.note(f"<{one.tag}>: never true: '{name}' is not declared")
            return Never(element=one.tag)
        return ValueCondition(name=name, rule=rule, value=value)

    def _gap(self, node: Node, direction: str = "euclidianDistance") -> Gap:
        along = node.flag("alongRoute", None)
        system = node.choice("coordinateSystem", _SYSTEMS, "entity")
        if along and not node.has("coordinateSystem"):
            system, direction = "road", "longitudinal"
        elif along is not None and not along and not node.has("coordinateSystem"):
            direction = "euclidianDistance"
        direction = node.choice("relativeDistanceType", _DIRECTIONS, direction)
        direction = "euclidianDistance" if direction == "cartesianDistance" else direction
        if node.has("routingAlgorithm"):
            node.text("routingAlgorithm")
        return Gap(coordinates=system, direction=direction, freespace=node.flag("freespace"))

    def _by_entity(self, node: Node) -> Test:
        one = node.only(_ENTITY)
        return Never(element=node.tag) if one is None else _ENTITY[one.tag](self, one)

    def _compare(self, node: Node) -> tuple[str, float]:
        return node.choice("rule", RULES), node.number("value")

    def _headway(self, node: Node) -> Test:
        rule, value = self._compare(node)
        entity = self.read.entity(node.text("entityRef"), node)
        return TimeHeadway(rule=rule, value=value, entity=entity, gap=self._gap(node))

    def _collision_time(self, node: Node) -> Test:
        rule, value = self._compare(node)
        one = node.child("TimeToCollisionConditionTarget").only(("EntityRef", "Position"))
        if one is None:
            return Never(element=node.tag)
        named = one.tag == "EntityRef"
        target = self.read.entity(one.text("entityRef"), one) if named else self._place(one)
        return TimeToCollision(rule=rule, value=value, target=target, gap=self._gap(node))

    def _place(self, node: Node) -> Position:
        """`<Position>` itself, or an element that holds one."""
        inner = [x for x in node.element if x.tag == "Position"]
        return self.read.position(node.child("Position") if inner else node)

    def _distance(self, node: Node) -> Test:
        rule, value = self._compare(node)
        place = self.read.position(node.child("Position"))
        return Distance(rule=rule, value=value, target=place, gap=self._gap(node))

    def _relative_distance(self, node: Node) -> Test:
        rule, value = self._compare(node)
        entity = self.read.entity(node.text("entityRef"), node)
        node.choice("relativeDistanceType", _DIRECTIONS)
        return Distance(rule=rule, value=value, target=entity, gap=self._gap(node))

    def _reach(self, node: Node) -> Test:
        place = self.read.position(node.child("Position"))
        return ReachPosition(position=place, tolerance=node.number("tolerance", least=0))

    def _direction(self, node: Node) -> str | None:
        return node.choice("direction", ("longitudinal", "lateral", "vertical"), None)

    def _speed(self, node: Node) -> Test:
        rule, value = self._compare(node)
        return Speed(rule=rule, value=value, direction=self._direction(node))

    def _relative_speed(self, node: Node) -> Test:
        rule, value = self._compare(node)
        entity = self.read.entity(node.text("entityRef"), node)
        return RelativeSpeed(rule=rule, value=value, entity=entity, direction=self._direction(node))

    def _acceleration(self, node: Node) -> Test:
        rule, value = self._compare(node)
        return Acceleration(rule=rule, value=value, direction=self._direction(node))

    def _stand_still(self, node: Node) -> Test:
        return StandStill(duration=node.number("duration", least=0))

    def _traveled(self, node: Node) -> Test:
        return TraveledDistance(value=node.number("value", least=0))

    def _end_of_road(self, node: Node) -> Test:
        return EndOfRoad(duration=node.number("duration", least=0))

    def _offroad(self, node: Node) -> Test:
        return Offroad(duration=node.number("duration", least=0))

    def _angle(self, node: Node) -> Test:
        if node.choice("angleType", ("heading", "pitch", "roll")) != "heading":
            node.source.refuse(node, "not supported: pitch and roll, bodies are level here")
            return Never(element=node.tag)
        system = node.choice(
            "coordinateSystem", _SYSTEMS, "lane" if node.tag == "AngleCondition" else "entity"
        )
        relative = node.tag == "RelativeAngleCondition"
        return Angle(
            angle=node.number("angle"),
            tolerance=node.number("angleTolerance", least=0),
            entity=self.read.entity(node.text("entityRef"), node) if relative else None,
            coordinates=system,
        )

    def _collision(self, node: Node) -> Test:
        one = node.only(("EntityRef", "ByType"))
        if one is None:
            return Never(element=node.tag)
        if one.tag == "EntityRef":
            return Collision(entity=self.read.entity(one.text("entityRef"), one))
        kind = one.choice("type", ("vehicle", "pedestrian", "miscellaneous", "external"))
        return Collision(kind=kind)


_ENTITY: dict[str, Callable[[StoryReader, Node], Test]] = {
    "TimeHeadwayCondition": StoryReader._headway,
    "TimeToCollisionCondition": StoryReader._collision_time,
    "DistanceCondition": StoryReader._distance,
    "RelativeDistanceCondition": StoryReader._relative_distance,
    "ReachPositionCondition": StoryReader._reach,
    "SpeedCondition": StoryReader._speed,
    "RelativeSpeedCondition": StoryReader._relative_speed,
    "AccelerationCondition": StoryReader._acceleration,
    "StandStillCondition": StoryReader._stand_still,
    "TraveledDistanceCondition": StoryReader._traveled,
    "EndOfRoadCondition": StoryReader._end_of_road,
    "OffroadCondition": StoryReader._offroad,
    "CollisionCondition": StoryReader._collision,
    "AngleCondition": StoryReader._angle,
    "RelativeAngleCondition": StoryReader._angle,
}
