"""A scenario of OpenSCENARIO as values: entities, positions, actions, conditions, the storyboard.

All parameters are resolved. SI units, radians; lanes and roads are those of the map file.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from limsim_jax.scenarios.openscenario.expressions import Value


@dataclass(frozen=True, kw_only=True)
class Box:
    """A body about its reference point.

    That of a vehicle is the middle of its rear axle.
    """

    length: float  # m
    width: float  # m
    x: float = 0.0  # m, middle of the box ahead of the reference point
    y: float = 0.0  # m, to the left


@dataclass(frozen=True, kw_only=True)
class Entity:
    """Something that moves or stands in the scenario."""

    name: str
    kind: str  # "vehicle", "pedestrian", "miscellaneous"
    category: str  # such as "car", "truck", "pedestrian", "obstacle"
    box: Box
    wheelbase: float = 0.0  # m, 0: no axles
    max_speed: float = 1e3  # m/s
    max_acceleration: float = 1e3  # m/s^2
    max_deceleration: float = 1e3  # m/s^2, positive
    controlled: bool = False  # has a controller


# --- positions


@dataclass(frozen=True, kw_only=True)
class Orientation:
    """A heading, relative to the direction of the position's reference or not."""

    h: float = 0.0  # rad
    relative: bool = False


@dataclass(frozen=True, kw_only=True)
class WorldPosition:
    """A place in the map's coordinates."""

    x: float  # m
    y: float  # m
    h: float = 0.0  # rad


@dataclass(frozen=True, kw_only=True)
class LanePosition:
    """A place on a lane, `s` along the road's reference line."""

    road: str
    lane: int
    s: float  # m
    offset: float = 0.0  # m to the left of the middle of the lane, seen along the reference line
    orientation: Orientation | None = None


@dataclass(frozen=True, kw_only=True)
class RoadPosition:
    """A place by `s` and `t` of a road's reference line."""

    road: str
    s: float  # m
    t: float  # m, left > 0
    orientation: Orientation | None = None


@dataclass(frozen=True, kw_only=True)
class RelativeLanePosition:
    """Lanes and metres from where another entity is."""

    entity: str
    lanes: int  # to the left of it
    ds: float = 0.0  # m along the road
    offset: float = 0.0  # m
    orientation: Orientation | None = None


@dataclass(frozen=True, kw_only=True)
class RelativeRoadPosition:
    """Metres along and across the road from where another entity is."""

    entity: str
    ds: float  # m
    dt: float  # m, left > 0
    orientation: Orientation | None = None


@dataclass(frozen=True, kw_only=True)
class RelativeObjectPosition:
    """Metres ahead and to the left of another entity."""

    entity: str
    dx: float  # m
    dy: float  # m
    orientation: Orientation | None = None


@dataclass(frozen=True, kw_only=True)
class RelativeWorldPosition:
    """Metres east and north of another entity."""

    entity: str
    dx: float  # m
    dy: float  # m
    orientation: Orientation | None = None


@dataclass(frozen=True, kw_only=True)
class RoutePosition:
    """A place on a route, by metres from its start."""

    route: Route
    s: float  # m along the route
    lane: int | None = None  # number; None: by `t`
    t: float = 0.0  # m, offset in the lane or from the reference line
    orientation: Orientation | None = None


@dataclass(frozen=True, kw_only=True)
class TrajectoryPosition:
    """A place on a trajectory, by metres from its start."""

    trajectory: Trajectory
    s: float  # m
    t: float = 0.0  # m, left > 0
    orientation: Orientation | None = None


Position = (
    WorldPosition
    | LanePosition
    | RoadPosition
    | RelativeLanePosition
    | RelativeRoadPosition
    | RelativeObjectPosition
    | RelativeWorldPosition
    | RoutePosition
    | TrajectoryPosition
)


@dataclass(frozen=True, kw_only=True)
class Route:
    """Places to drive to, one after the other."""

    name: str
    waypoints: tuple[Position, ...]


@dataclass(frozen=True, kw_only=True)
class Clothoid:
    """A piece of a path whose curvature changes evenly."""

    length: float  # m
    begin: float  # 1/m, curvature at its start
    end: float  # 1/m
    turn: float = 0.0  # rad, of the heading at its start against the end of the piece before
    start: Position | None = None  # None: where the piece before ends, or where the entity is


@dataclass(frozen=True, kw_only=True)
class Nurbs:
    """How the points of a trajectory control a rational B-spline."""

    order: int
    weights: tuple[float, ...]
    knots: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """A path of straight pieces, of clothoids, or a rational B-spline; with times or without."""

    name: str
    points: tuple[Position, ...]  # corners, or control points; none where there are clothoids
    times: tuple[float, ...] | None  # s, of points, or of the ends of clothoids
    clothoids: tuple[Clothoid, ...] = ()
    nurbs: Nurbs | None = None


# --- actions


@dataclass(frozen=True, kw_only=True)
class Dynamics:
    """How a value goes from what it is to its target."""

    shape: str  # "step", "linear", "sinusoidal", "cubic"
    dimension: str  # "time" (s), "rate" (peak, per s), "distance" (m)
    value: float


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Bounds of a motion that keeps a distance; inf: none."""

    acceleration: float = float("inf")  # m/s^2
    deceleration: float = float("inf")  # m/s^2, positive
    speed: float = float("inf")  # m/s


@dataclass(frozen=True, kw_only=True)
class SpeedAction:
    """Drive at a speed, or at one relative to another entity."""

    dynamics: Dynamics
    value: float  # m/s, or a factor
    entity: str | None = None  # that it is relative to
    factor: bool = False  # times the other's speed, not plus
    continuous: bool = False  # goes on following the other's speed: has no end


@dataclass(frozen=True, kw_only=True)
class SpeedProfileAction:
    """Drive at given speeds after given times; straight between them."""

    speeds: tuple[float, ...]  # m/s
    times: tuple[float, ...]  # s, each since the one before
    entity: str | None = None  # speeds are relative to its


@dataclass(frozen=True, kw_only=True)
class LongitudinalDistanceAction:
    """Keep a distance along the road to another entity."""

    entity: str
    distance: float | None  # m
    time_gap: float | None  # s, in place of a distance
    freespace: bool  # between bodies, not between reference points
    displacement: str  # "leadingReferencedEntity", "trailingReferencedEntity", "any"
    continuous: bool
    limits: Limits | None  # None: at once


@dataclass(frozen=True, kw_only=True)
class LateralDistanceAction:
    """Keep a distance across the road to another entity."""

    entity: str
    distance: float  # m
    freespace: bool
    displacement: str  # "leftToReferencedEntity", "rightToReferencedEntity", "any"
    continuous: bool
    limits: Limits | None  # None: at once


@dataclass(frozen=True, kw_only=True)
class LaneChangeAction:
    """Move to another lane."""

    dynamics: Dynamics
    lane: int  # its number, or how many lanes to the left of another entity
    entity: str | None = None
    offset: float = 0.0  # m to the left of the middle of that lane


@dataclass(frozen=True, kw_only=True)
class LaneOffsetAction:
    """Move to another place in the lane."""

    shape: str
    max_acceleration: float | None  # m/s^2 across; None: at once
    value: float  # m to the left
    entity: str | None = None  # that it is relative to
    continuous: bool = False


@dataclass(frozen=True, kw_only=True)
class TeleportAction:
    """Be somewhere else."""

    position: Position


@dataclass(frozen=True, kw_only=True)
class FollowTrajectoryAction:
    """Move along a trajectory, by its times or with one's own speed."""

    trajectory: Trajectory
    timed: bool
    relative: bool = True  # times begin with the action, not with the scenario
    scale: float = 1.0
    offset: float = 0.0  # s
    start: float = 0.0  # m from the start of the trajectory


@dataclass(frozen=True, kw_only=True)
class RouteAction:
    """Drive along a route from now on; `acquire`: its end is the end of the action."""

    route: Route
    acquire: bool = False


@dataclass(frozen=True, kw_only=True)
class SynchronizeAction:
    """Be at a place when another entity is at its own."""

    master: str
    master_target: Position
    target: Position
    speed: float | None = None  # m/s at the end
    relative: str | None = None  # "delta" or "factor" of the master's speed, in `speed`
    steady: float = 0.0  # m before the target, from which it drives at that speed
    steady_time: float = 0.0  # s, in place of that
    master_tolerance: float = 0.0  # m
    tolerance: float = 0.0  # m


@dataclass(frozen=True, kw_only=True)
class ControllerAction:
    """Hand over to the controller of an entity, or take back."""

    active: bool


@dataclass(frozen=True, kw_only=True)
class VisibilityAction:
    """Be seen by other traffic, or not."""

    traffic: bool


@dataclass(frozen=True, kw_only=True)
class EntityAction:
    """An entity appears at a place, or disappears (`position` is None)."""

    entity: str
    position: Position | None


@dataclass(frozen=True, kw_only=True)
class ValueAction:
    """Set or change a parameter or a variable."""

    name: str
    how: str  # "set", "add", "multiply"
    value: Value


@dataclass(frozen=True, kw_only=True)
class NoAction:
    """Something that changes nothing here; it is complete at once."""

    element: str


Does = (
    SpeedAction
    | SpeedProfileAction
    | LongitudinalDistanceAction
    | LateralDistanceAction
    | LaneChangeAction
    | LaneOffsetAction
    | TeleportAction
    | FollowTrajectoryAction
    | RouteAction
    | SynchronizeAction
    | ControllerAction
    | VisibilityAction
    | EntityAction
    | ValueAction
    | NoAction
)


@dataclass(frozen=True, kw_only=True)
class Action:
    """A named action."""

    name: str
    does: Does


# --- conditions


@dataclass(frozen=True, kw_only=True)
class Compare:
    """A rule and the value that it compares with."""

    rule: str
    value: float


@dataclass(frozen=True, kw_only=True)
class SimulationTime(Compare):
    """s since the start."""


@dataclass(frozen=True, kw_only=True)
class ValueCondition:
    """A parameter or variable against a value."""

    name: str
    rule: str
    value: Value


@dataclass(frozen=True, kw_only=True)
class ElementState:
    """A part of the storyboard is in a state or transition."""

    kind: str  # "story", "act", "maneuverGroup", "maneuver", "event", "action"
    element: str
    state: str


@dataclass(frozen=True, kw_only=True)
class Gap:
    """How a distance between two things is measured."""

    coordinates: str = "entity"  # "entity", "lane", "road", "trajectory", "world"
    direction: str = "euclidianDistance"  # or "longitudinal", "lateral"
    freespace: bool = False


@dataclass(frozen=True, kw_only=True)
class TimeHeadway(Compare):
    """Distance to another entity over one's own speed, s."""

    entity: str
    gap: Gap


@dataclass(frozen=True, kw_only=True)
class TimeToCollision(Compare):
    """Distance over closing speed, s."""

    target: str | Position
    gap: Gap


@dataclass(frozen=True, kw_only=True)
class Distance(Compare):
    """m to an entity or a place."""

    target: str | Position
    gap: Gap


@dataclass(frozen=True, kw_only=True)
class ReachPosition:
    """Within some metres of a place."""

    position: Position
    tolerance: float


@dataclass(frozen=True, kw_only=True)
class Speed(Compare):
    """m/s; of one direction of the entity, or all."""

    direction: str | None = None


@dataclass(frozen=True, kw_only=True)
class RelativeSpeed(Compare):
    """Own speed minus that of another entity, m/s."""

    entity: str
    direction: str | None = None


@dataclass(frozen=True, kw_only=True)
class Acceleration(Compare):
    """m/s^2."""

    direction: str | None = None


@dataclass(frozen=True, kw_only=True)
class StandStill:
    """Has stood for so long, s."""

    duration: float


@dataclass(frozen=True, kw_only=True)
class TraveledDistance:
    """Has moved so far since the start, m."""

    value: float


@dataclass(frozen=True, kw_only=True)
class EndOfRoad:
    """Has been at the end of its road for so long, s."""

    duration: float


@dataclass(frozen=True, kw_only=True)
class Offroad:
    """Has been off all lanes for so long, s."""

    duration: float


@dataclass(frozen=True, kw_only=True)
class Collision:
    """Touches an entity, or any of a kind ("vehicle", "pedestrian", "miscellaneous")."""

    entity: str | None = None
    kind: str | None = None


@dataclass(frozen=True, kw_only=True)
class Angle:
    """Heading against the road, the map (`coordinates` "world") or another entity, rad."""

    angle: float
    tolerance: float
    entity: str | None = None
    coordinates: str = "lane"


@dataclass(frozen=True, kw_only=True)
class Never:
    """What is not known here: never true."""

    element: str


EntityTest = (
    TimeHeadway
    | TimeToCollision
    | Distance
    | ReachPosition
    | Speed
    | RelativeSpeed
    | Acceleration
    | StandStill
    | TraveledDistance
    | EndOfRoad
    | Offroad
    | Collision
    | Angle
)
Test = SimulationTime | ValueCondition | ElementState | EntityTest | Never


@dataclass(frozen=True, kw_only=True)
class Condition:
    """A test with its edge and delay."""

    name: str
    test: Test
    edge: str = "none"  # "none", "rising", "falling", "risingOrFalling"
    delay: float = 0.0  # s
    entities: tuple[str, ...] = ()
    every: bool = False  # of the entities; otherwise any of them


Trigger = tuple[tuple[Condition, ...], ...]
"""Groups of conditions: true where all conditions of any group are. Without groups it is never true."""


# --- the storyboard


ELEMENTS = ("story", "act", "maneuverGroup", "maneuver", "event", "action")
"""Kinds of its parts, from the top down, by the names of files."""


@dataclass(frozen=True, kw_only=True)
class Event:
    """Actions that start together; `start` is None where they start with their maneuver."""

    name: str
    actions: tuple[Action, ...]
    start: Trigger | None
    priority: str = "parallel"  # "override", "parallel", "skip"
    most: int = 1  # times that it is executed


@dataclass(frozen=True, kw_only=True)
class Maneuver:
    """Events of the same actors."""

    name: str
    events: tuple[Event, ...]


@dataclass(frozen=True, kw_only=True)
class ManeuverGroup:
    """Maneuvers and their actors."""

    name: str
    actors: tuple[str, ...]
    maneuvers: tuple[Maneuver, ...]
    triggering: bool = False  # entities that meet the condition of an event are actors, too
    most: int = 1


@dataclass(frozen=True, kw_only=True)
class Act:
    """Maneuver groups that start and stop together."""

    name: str
    groups: tuple[ManeuverGroup, ...]
    start: Trigger | None
    stop: Trigger = ()


@dataclass(frozen=True, kw_only=True)
class Story:
    """Acts."""

    name: str
    acts: tuple[Act, ...]


@dataclass(frozen=True, kw_only=True)
class Storyboard:
    """What happens. `start`: actions at the start by entity, "" for those of the world."""

    start: tuple[tuple[str, Action], ...]
    stories: tuple[Story, ...]
    stop: Trigger = ()


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """A scenario with all its parameters resolved."""

    name: str
    path: Path
    version: tuple[int, int]
    parameters: dict[str, Value]
    variables: dict[str, Value]
    map_file: str  # as the file has it; "": none
    entities: tuple[Entity, ...]
    storyboard: Storyboard
    notes: tuple[str, ...] = field(default=())  # what was left out

    def entity(self, name: str) -> Entity:
        """The entity of this name."""
        return next(x for x in self.entities if x.name == name)

    @property
    def ego(self) -> str | None:
        """The entity that is under test: by its name, by its controller, or the first vehicle."""
        return ego_of(self.entities)


_EGO_NAMES = ("ego", "hero", "ego_vehicle", "egovehicle", "host", "sut", "vut")


def ego_of(entities: tuple[Entity, ...]) -> str | None:
    """The vehicle under test.

    It is the one with such a name, or the first with a controller, or the first of all.
    """
    vehicles = [x for x in entities if x.kind == "vehicle"]
    named = [x for x in vehicles if x.name.lower() in _EGO_NAMES]
    named += [x for x in vehicles if x.controlled]
    found = named or vehicles
    return found[0].name if found else None


def changed(value: Value, does: ValueAction) -> Value:
    """A parameter or variable after an action."""
    if does.how == "set":
        return does.value
    number, by = float(value), float(does.value)
    return number + by if does.how == "add" else number * by
