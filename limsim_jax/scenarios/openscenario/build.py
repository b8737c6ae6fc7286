"""From a scenario and its map to arrays: `build`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from limsim_jax.scenarios.openscenario.arrays import (
    ActionRows,
    Board,
    Conditions,
    Dimension,
    Edge,
    Elements,
    Entities,
    Kind,
    Level,
    Memory,
    Phase,
    PlaceKind,
    Places,
    Priority,
    Shape,
)
from limsim_jax.scenarios.openscenario.build_conditions import BODIES, condition_row
from limsim_jax.scenarios.openscenario.expressions import Value
from limsim_jax.scenarios.openscenario.padding import (
    NO_ELEMENT,
    NO_PLACE,
    Sizes,
    columns,
    corridors_rows,
    no_action,
    no_condition,
    padded,
    sizes_of,
    trajectories_rows,
)
from limsim_jax.scenarios.openscenario.places import (
    RELATIVE,
    Placed,
    Placer,
    column_center,
    nearest_column,
    point,
    project,
    row_of,
    ways,
)
from limsim_jax.scenarios.openscenario.roads import (
    ACROSS,
    SIDE,
    SPACING,
    Corridor,
    PlaceError,
    Pose,
    Roads,
    Spot,
    foot,
)
from limsim_jax.scenarios.openscenario.source import OpenScenarioError, one_line
from limsim_jax.scenarios.openscenario.storyboard import (
    ELEMENTS,
    Act,
    Action,
    ControllerAction,
    Does,
    EntityAction,
    Event,
    FollowTrajectoryAction,
    LaneChangeAction,
    LaneOffsetAction,
    LateralDistanceAction,
    Limits,
    LongitudinalDistanceAction,
    Maneuver,
    ManeuverGroup,
    NoAction,
    Position,
    RelativeLanePosition,
    RelativeObjectPosition,
    RelativeRoadPosition,
    Route,
    RouteAction,
    Scenario,
    SpeedAction,
    SpeedProfileAction,
    Story,
    SynchronizeAction,
    TeleportAction,
    Trigger,
    ValueAction,
    VisibilityAction,
    changed,
)

SHAPES = {"step": Shape.STEP, "linear": Shape.LINEAR, "sinusoidal": Shape.SINUSOIDAL, "cubic": Shape.CUBIC}
DIMENSIONS = {"time": Dimension.TIME, "rate": Dimension.RATE, "distance": Dimension.DISTANCE}
EDGES = {"none": Edge.NONE, "rising": Edge.RISING, "falling": Edge.FALLING, "risingOrFalling": Edge.BOTH}
PRIORITIES = {"parallel": Priority.PARALLEL, "override": Priority.OVERRIDE, "skip": Priority.SKIP}
AT_START = "start"  # name of the story that holds actions of the start that take time

MOST_RING = 4096
"""Steps that delays look back, at most."""


class Start(NamedTuple):
    """An entity at the start."""

    name: str
    pose: Pose  # of the reference point, in the coordinates of the file
    spot: Spot | None
    v: float  # m/s
    there: bool


class Built(NamedTuple):
    """A scenario for the device, on the host's side of the border: NumPy arrays."""

    board: Board
    memory: Memory
    starts: tuple[Start, ...]  # in the order of the entities
    sizes: Sizes


@dataclass
class _Tables:
    """Rows in the making."""

    corridors: list[Corridor] = field(default_factory=list)
    routed: list[bool] = field(default_factory=list)
    places: list[dict[str, Any]] = field(default_factory=list)
    paths: list[Any] = field(default_factory=list)
    actions: list[dict[str, Any]] = field(default_factory=list)
    elements: list[dict[str, Any]] = field(default_factory=list)
    names: list[tuple[str, str]] = field(default_factory=list)  # kind and full name of elements
    conditions: list[dict[str, Any]] = field(default_factory=list)
    groups: list[int] = field(default_factory=list)
    triggers: int = 0


class Builder:
    """Builds the arrays of one scenario.

    Args:
      scenario: resolved.
      roads: its map.
      dt: s, physics step.
      script: the ego keeps to its script; otherwise a policy drives it once its controller is active.
      controlled: a policy drives the ego from the start, whatever the scenario says of its controller.
    """

    def __init__(
        self, scenario: Scenario, roads: Roads, dt: float, *, script: bool, controlled: bool
    ) -> None:
        self.scenario, self.roads, self.dt = scenario, roads, dt
        self.names = [x.name for x in scenario.entities]
        self.ego = None if script else scenario.ego
        self.controlled = controlled
        self.placer = Placer(roads)
        self.tables = _Tables()
        self.values: dict[str, Value] = {**scenario.parameters, **scenario.variables}
        self.texts: dict[str, int] = {}
        self.speeds: dict[str, float] = dict.fromkeys(self.names, 0.0)
        self.there: dict[str, bool] = dict.fromkeys(self.names, False)
        self.seen: dict[str, bool] = dict.fromkeys(self.names, True)
        self.active: dict[str, bool] = dict.fromkeys(self.names, controlled)
        self.where = "the start"

    def error(self, reason: str) -> OpenScenarioError:
        """An error of one line."""
        return OpenScenarioError(one_line(f"{self.scenario.path}: {self.where}: {reason}"))

    def index(self, name: str | None) -> int:
        """The row of an entity; -1 for none."""
        return -1 if name is None else self.names.index(name)

    # --- the start

    def start(self) -> list[tuple[str, Does]]:
        """Carry out the actions of the start that take no time; the others are returned."""
        later: list[tuple[str, Does]] = []
        acts = [(name, x.does) for name, x in self.scenario.storyboard.start]
        self._teleport([(name, x.position) for name, x in acts if isinstance(x, TeleportAction)])
        for _, does in acts:
            if isinstance(does, EntityAction) and does.position is not None:
                self._teleport([(does.entity, does.position)])
            elif isinstance(does, EntityAction):
                self.there[does.entity] = False
        speeds = [(n, x) for n, x in acts if isinstance(x, SpeedAction) and x.dynamics.shape == "step"]
        for _ in range(len(speeds)):  # speeds relative to others, in any order
            for name, does in speeds:
                if not does.continuous:
                    self.speeds[name] = self._target(does)
        for name, does in acts:
            if isinstance(does, (TeleportAction, EntityAction, NoAction)):
                continue
            if isinstance(does, SpeedAction) and does.dynamics.shape == "step" and not does.continuous:
                continue
            if isinstance(does, LongitudinalDistanceAction) and does.limits is None and not does.continuous:
                self._keep_distance(name, does)
            elif isinstance(does, VisibilityAction):
                self.seen[name] = does.traffic
            elif isinstance(does, ControllerAction):
                self.active[name] = does.active or self.controlled
            elif isinstance(does, ValueAction):
                try:
                    self.values[does.name] = changed(self.values[does.name], does)
                except ValueError:
                    raise self.error(
                        f"'{does.name}' is a text, which cannot be changed by a number"
                    ) from None
            else:
                later.append((name, does))
        return later

    def _target(self, does: SpeedAction) -> float:
        if does.entity is None:
            return does.value
        other = self.speeds[does.entity]
        return other * does.value if does.factor else other + does.value

    def _teleport(self, wanted: list[tuple[str, Position]]) -> None:
        while wanted:
            ready = [x for x in wanted if self.placer.known(x[1])]
            if not ready:
                names = ", ".join(name for name, _ in wanted)
                raise self.error(f"places of {names} are relative to each other, or to what has no place")
            for name, position in ready:
                self.placer.put(name, self.place(position))
                self.there[name] = True
            wanted = [x for x in wanted if x not in ready]

    def place(self, position: Position) -> Placed:
        """The pose of a position.

        Raises:
          OpenScenarioError: what is not there on the map.
        """
        try:
            return self.placer.place(position)
        except PlaceError as error:
            raise self.error(str(error)) from None

    def _keep_distance(self, name: str, does: LongitudinalDistanceAction) -> None:
        """Put an entity at a distance of another along the road."""
        if name not in self.placer.at or does.entity not in self.placer.at:
            raise self.error(f"'{name}' keeps a distance, and '{name}' or '{does.entity}' has no place")
        own, other = self.scenario.entity(name), self.scenario.entity(does.entity)
        corridor = self.placer.corridors[name]
        s, t = project(corridor, self.placer.at[name].pose)
        s_other, _ = project(corridor, self.placer.at[does.entity].pose)
        ahead = s >= s_other if does.displacement == "any" else does.displacement.startswith("leading")
        behind = does.entity if ahead else name
        gap = does.distance if does.time_gap is None else does.time_gap * self.speeds[behind]
        assert gap is not None
        if does.freespace:
            gap += (own.box.length + other.box.length) / 2
            gap += (other.box.x - own.box.x) if ahead else (own.box.x - other.box.x)
        column = nearest_column(corridor, s, t)
        off = t - column_center(corridor, s, column)
        s = s_other + (gap if ahead else -gap)
        pose = self.placer.at[name].pose
        yaw = pose.h - point(corridor, project(corridor, pose)[0], 0.0).h
        found = point(corridor, s, column_center(corridor, s, column) + off)
        found = found._replace(h=found.h + yaw)
        self.placer.put(name, Placed(found, self.roads.nearest(found)))

    # --- corridors and places

    def corridor_of(self, placed: Placed, route: list[Any] | None = None) -> int:
        """The row of the corridor for an entity in this place; one is made if none fits."""
        tables = self.tables
        if route is None:
            for k, known in enumerate(tables.corridors):
                if not tables.routed[k] and self._fits(known, placed):
                    return k
            made = self.roads.corridor(placed.spot, placed.pose)
        else:
            start = foot(route[0], 0.0 if placed.spot is None else placed.spot.s, placed.pose)
            made = self.roads.corridor(start, self.roads.at(start), route)
        tables.corridors.append(made)
        tables.routed.append(route is not None)
        return len(tables.corridors) - 1

    def _fits(self, corridor: Corridor, placed: Placed) -> bool:
        if placed.spot is None or not corridor.roads:
            return False
        s, t = project(corridor, placed.pose)
        base = point(corridor, s, 0.0)
        row = row_of(corridor, s)
        if not corridor.start <= s <= corridor.start + SPACING * (len(corridor.x) - 1):
            return False
        on = np.abs(corridor.center[row] - t) <= corridor.half[row] + 0.5
        same = corridor.number[row][on & (corridor.half[row] > 0)] == placed.spot.lane.number
        roads = {name for name, _, _ in corridor.roads}
        return (
            bool(same.any())
            and placed.spot.lane.road in roads
            and math.cos(base.h - placed.pose.h) > math.cos(ACROSS)
        )

    def place_row(self, position: Position, *, drive: bool = False) -> int:
        """The row of a place; `drive`: an entity may go on from there, so that it needs a corridor."""
        row = dict(NO_PLACE)
        if isinstance(position, RELATIVE):
            row["entity"] = self.index(position.entity)
            facing = position.orientation
            row["turned"] = 0 if facing is None else 1 if facing.relative else 2
            row["pose"] = (0.0, 0.0, 0.0 if facing is None else facing.h)
            if isinstance(position, RelativeLanePosition):
                row |= {"kind": PlaceKind.LANE, "along": position.ds, "beside": position.offset}
                row["lanes"] = position.lanes
            elif isinstance(position, RelativeRoadPosition):
                row |= {"kind": PlaceKind.ROAD, "along": position.ds, "beside": position.dt}
            else:
                is_object = isinstance(position, RelativeObjectPosition)
                row |= {"kind": PlaceKind.OBJECT if is_object else PlaceKind.WORLD}
                row |= {"along": position.dx, "beside": position.dy}
        else:
            placed = self.place(position)
            row |= {"kind": PlaceKind.FIXED, "pose": self._local(placed.pose), "turned": 2}
            if drive:
                row["corridor"] = self.corridor_of(placed)
        self.tables.places.append(row)
        return len(self.tables.places) - 1

    def _local(self, pose: Pose) -> tuple[float, float, float]:
        x0, y0 = self._origin
        return pose.x - x0, pose.y - y0, pose.h

    def route_row(self, name: str, route: Route) -> int:
        """The row of the corridor along a route."""
        stops = [self.place(x) for x in route.waypoints]
        if any(x.spot is None for x in stops):
            raise self.error("a waypoint of the route is on no lane")
        start = self.placer.at.get(name)
        spots = [x.spot for x in stops if x.spot is not None]
        first, way = stops[0], None
        if start is not None and start.spot is not None:
            try:
                way, first = self.roads.route([start.spot, *spots]), start
            except PlaceError:
                way = None
        if way is None and len(spots) > 1:
            try:
                way = self.roads.route(spots)
            except PlaceError as error:
                raise self.error(f"route: {error}") from None
        if way is None:
            raise self.error(f"there is no way for '{name}' to the end of its route")
        return self.corridor_of(first, way)

    # --- the storyboard

    def storyboard(self, later: list[tuple[str, Does]]) -> int:
        """All elements, actions and conditions; returns the trigger that ends the scenario."""
        board = self.scenario.storyboard
        stories = list(board.stories)
        if later:
            groups = tuple(
                ManeuverGroup(
                    name=str(k),
                    actors=(name,) if name else (),
                    maneuvers=(
                        Maneuver(
                            name=AT_START,
                            events=(
                                Event(name=AT_START, actions=(Action(name=AT_START, does=does),), start=None),
                            ),
                        ),
                    ),
                )
                for k, (name, does) in enumerate(later)
            )
            stories.insert(0, Story(name=AT_START, acts=(Act(name=AT_START, groups=groups, start=None),)))
        pending: list[tuple[Trigger, int]] = []
        for story in stories:
            top = self._element(Level.STORY, -1, story.name)
            for act in story.acts:
                self._act(act, top, story.name, pending)
        for trigger, owner in pending:
            self._trigger(trigger, owner)
        return self._trigger(board.stop, -1) if board.stop else -1

    def _element(self, level: Level, parent: int, name: str, **fields: Any) -> int:
        self.tables.elements.append(NO_ELEMENT | {"level": level, "parent": parent} | fields)
        self.tables.names.append((ELEMENTS[level], name))
        return len(self.tables.elements) - 1

    def _later(self, trigger: Trigger | None, owner: int, pending: list[tuple[Trigger, int]]) -> int:
        if trigger is None:
            return -1
        pending.append((trigger, owner))
        return len(pending) - 1

    def _act(self, act: Act, parent: int, above: str, pending: list[tuple[Trigger, int]]) -> None:
        name = f"{above}::{act.name}"
        top = self._element(Level.ACT, parent, name)
        row = self.tables.elements[top]
        row["start"] = self._later(act.start, top, pending)
        row["stop"] = self._later(act.stop or None, top, pending)
        for group in act.groups:
            group_name = f"{name}::{group.name}"
            at_group = self._element(Level.GROUP, top, group_name, most=group.most)
            for maneuver in group.maneuvers:
                maneuver_name = f"{group_name}::{maneuver.name}"
                at_maneuver = self._element(Level.MANEUVER, at_group, maneuver_name)
                for event in maneuver.events:
                    self._event(event, group, at_maneuver, f"{maneuver_name}::{event.name}", pending)

    def _event(
        self, event: Event, group: ManeuverGroup, parent: int, name: str, pending: list[tuple[Trigger, int]]
    ) -> None:
        at = self._element(Level.EVENT, parent, name, most=event.most, priority=PRIORITIES[event.priority])
        self.tables.elements[at]["start"] = self._later(event.start, at, pending)
        for action in event.actions:
            row = self._element(Level.ACTION, at, f"{name}::{action.name}")
            self.where = f"action '{action.name}'" if action.name else "the start"
            self._rows(action.does, row, group)

    def _rows(self, does: Does, element: int, group: ManeuverGroup) -> None:
        """Rows of an action, one for each actor."""
        if isinstance(does, EntityAction):
            self._row(does, element, does.entity, False)
            return
        if isinstance(does, (ValueAction, NoAction)):
            self._row(does, element, None, False)
            return
        for name in group.actors:
            self._row(does, element, name, False)
        if group.triggering:
            for name in self.names:
                if name not in group.actors:
                    self._row(does, element, name, True)

    def _row(self, does: Does, element: int, name: str | None, only: bool) -> None:
        row = no_action() | {"element": element, "entity": self.index(name), "only_triggering": only}
        row |= self._fields(does, name)
        self.tables.actions.append(row)

    def _fields(self, does: Does, name: str | None) -> dict[str, Any]:
        """What an action asks for, by the columns of `ActionRows`."""
        match does:
            case SpeedAction():
                return _dynamics(does.dynamics.shape, does.dynamics.dimension, does.dynamics.value) | {
                    "kind": Kind.SPEED,
                    "value": does.value,
                    "other": self.index(does.entity),
                    "factor": does.factor,
                    "continuous": does.continuous,
                }
            case SpeedProfileAction():
                times = np.cumsum(does.times)
                return {
                    "kind": Kind.PROFILE,
                    "speeds": list(does.speeds),
                    "times": [float(x) for x in times],
                    "other": self.index(does.entity),
                }
            case LongitudinalDistanceAction():
                side = {"any": 0, "leadingReferencedEntity": 1, "trailingReferencedEntity": -1}
                timed = does.time_gap is not None
                return _limits(does.limits) | {
                    "kind": Kind.GAP,
                    "value": does.time_gap if timed else does.distance,
                    "time_gap": timed,
                    "other": self.index(does.entity),
                    "freespace": does.freespace,
                    "side": side[does.displacement],
                    "continuous": does.continuous,
                }
            case LateralDistanceAction():
                side = {"any": 0, "leftToReferencedEntity": 1, "rightToReferencedEntity": -1}
                return _limits(does.limits) | {
                    "kind": Kind.BESIDE,
                    "value": does.distance,
                    "other": self.index(does.entity),
                    "freespace": does.freespace,
                    "side": side[does.displacement],
                    "continuous": does.continuous,
                }
            case LaneChangeAction():
                return _dynamics(does.dynamics.shape, does.dynamics.dimension, does.dynamics.value) | {
                    "kind": Kind.LANE,
                    "lane": does.lane,
                    "other": self.index(does.entity),
                    "offset": does.offset,
                }
            case LaneOffsetAction():
                dynamics = _dynamics(does.shape, "time", 0.0)
                if does.max_acceleration is not None and math.isfinite(does.max_acceleration):
                    dynamics |= {"dimension": Dimension.ACCELERATION, "over": does.max_acceleration}
                return dynamics | {
                    "kind": Kind.OFFSET,
                    "value": does.value,
                    "other": self.index(does.entity),
                    "continuous": does.continuous,
                }
            case TeleportAction():
                return {"kind": Kind.TELEPORT, "place": self.place_row(does.position, drive=True)}
            case EntityAction():
                if does.position is None:
                    return {"kind": Kind.DISAPPEAR}
                return {"kind": Kind.APPEAR, "place": self.place_row(does.position, drive=True)}
            case FollowTrajectoryAction():
                return self._follow(does)
            case RouteAction():
                assert name is not None
                row: dict[str, Any] = {"kind": Kind.ROUTE, "corridor": self.route_row(name, does.route)}
                if does.acquire:
                    row["place"] = self.place_row(does.route.waypoints[-1])
                return row
            case SynchronizeAction():
                return {
                    "kind": Kind.SYNCHRONIZE,
                    "other": self.index(does.master),
                    "place": self.place_row(does.target),
                    "place_other": self.place_row(does.master_target),
                    "steady": (does.steady, does.steady_time),
                    "factor": does.relative == "factor",
                    "side": 0 if does.speed is None else 1,
                    "continuous": does.relative is not None,
                    "value": 0.0 if does.speed is None else does.speed,
                }
            case ControllerAction():
                return {"kind": Kind.CONTROL, "value": float(does.active)}
            case VisibilityAction():
                return {"kind": Kind.SEEN, "value": float(does.traffic)}
            case ValueAction():
                return {
                    "kind": Kind.VALUE,
                    "variable": list(self.values).index(does.name),
                    "how": ("set", "add", "multiply").index(does.how),
                    "value": self.number(does.value),
                }
            case NoAction():
                return {"kind": Kind.NOTHING}

    def _follow(self, does: FollowTrajectoryAction) -> dict[str, Any]:
        try:
            path = self.placer.path(does.trajectory)
        except PlaceError as error:
            raise self.error(str(error)) from None
        if path.local:
            points = path.points
        else:
            points = np.array([self._local(Pose(*(float(v) for v in x))) for x in path.points])
        way = ways(path.points)
        times = path.times * does.scale + does.offset
        if does.timed and does.start > 0:  # it begins some way along
            begin = float(np.interp(does.start, way, times))
            times = times - (begin if does.relative else 0.0)
        self.tables.paths.append((points, way, times, path.local))
        return {
            "kind": Kind.TRAJECTORY,
            "trajectory": len(self.tables.paths) - 1,
            "timed": does.timed,
            "absolute": not does.relative,
            "offset": does.start,
        }

    def number(self, value: Value) -> float:
        """A value as a number: texts by a number of their own."""
        if isinstance(value, str):
            try:
                return float(value)
            except ValueError:
                return float(1e6 + self.texts.setdefault(value.strip(), len(self.texts)))
        return float(value)

    # --- conditions

    def _trigger(self, trigger: Trigger, owner: int) -> int:
        mine = self.tables.triggers
        self.tables.triggers += 1
        for group in trigger:
            self.tables.groups.append(mine)
            for condition in group:
                self.where = f"condition '{condition.name}'"
                row = condition_row(self, condition)
                steps = round(condition.delay / self.dt)
                if steps > MOST_RING:
                    raise self.error(f"a delay of {condition.delay:g} s; at most {MOST_RING * self.dt:g} s")
                row |= {"group": len(self.tables.groups) - 1, "owner": owner, "delay": steps}
                row |= {"edge": EDGES[condition.edge], "every": condition.every}
                row["who"] = [name in condition.entities for name in self.names]
                self.tables.conditions.append(row)
        return mine

    # --- arrays

    def build(self, least: Sizes) -> Built:
        """The arrays, padded to sizes that are at least these."""
        later = self.start()
        for name in self.names:
            if name not in self.placer.at:  # not there at the start
                self.placer.put(name, Placed(Pose(*self._origin, 0.0), None))
        rows = [self.corridor_of(self.placer.at[name]) for name in self.names]
        stop = self.storyboard(later)
        t = self.tables
        sizes = self._sizes() | least
        entities = self._entities(sizes)
        tables: dict[str, Any] = dict(
            corridors=corridors_rows(t.corridors, self._origin, sizes),
            entities=entities,
            places=columns(Places, t.places, NO_PLACE, sizes.places),
            trajectories=trajectories_rows(t.paths, sizes),
            actions=self._actions(sizes),
            elements=columns(Elements, t.elements, NO_ELEMENT, sizes.elements),
            conditions=self._conditions(sizes),
            group_trigger=padded(t.groups, sizes.groups, -1),
            trigger_elements=np.zeros(sizes.triggers, np.int32),
            stop=np.int32(stop),
            ring=sizes.ring,
        )
        board = Board(**tables)
        starts = tuple(
            Start(x, self.placer.at[x].pose, self.placer.at[x].spot, self.speeds[x], self.there[x])
            for x in self.names
        )
        return Built(board, self._memory(board, rows, sizes), starts, sizes)

    def _sizes(self) -> Sizes:
        """The least sizes that hold all rows."""
        t = self.tables
        return sizes_of(
            entities=len(self.names),
            corridors=len(t.corridors),
            points=max(len(x.x) for x in t.corridors),
            places=len(t.places),
            trajectories=len(t.paths),
            vertices=max([2, *(len(x[0]) for x in t.paths)]),
            actions=len(t.actions),
            profile=max([1, *(len(x["speeds"]) for x in t.actions)]),
            elements=len(t.elements),
            conditions=len(t.conditions),
            groups=len(t.groups),
            triggers=t.triggers,
            values=len(self.values),
            delays=[x["delay"] for x in t.conditions],
        )

    @cached_property
    def _origin(self) -> tuple[float, float]:
        x0, y0 = np.asarray(self.roads.town.lanes.origin, np.float64)
        return float(x0), float(y0)

    def _entities(self, sizes: Sizes) -> Entities:
        count = sizes.entities
        bodies = self.scenario.entities

        def column(values: list[Any], fill: Any, kind: Any = np.float32) -> Any:
            return padded(values, count, fill, kind)

        return Entities(
            length=column([x.box.length for x in bodies], 1.0),
            width=column([x.box.width for x in bodies], 1.0),
            ahead=column([x.box.x for x in bodies], 0.0),
            kind=column([BODIES[x.kind] for x in bodies], 0, np.int32),
            policy=column([x.name == self.ego for x in bodies], False, bool),
            real=column([True] * len(bodies), False, bool),
        )

    def _actions(self, sizes: Sizes) -> ActionRows:
        rows = self.tables.actions
        longest = sizes.profile
        for row in rows:
            speeds, times = list(row["speeds"]) or [0.0], list(row["times"]) or [0.0]
            row["speeds"] = speeds + [speeds[-1]] * (longest - len(speeds))
            row["times"] = times + [times[-1]] * (longest - len(times))
        empty = no_action() | {"speeds": [0.0] * longest, "times": [0.0] * longest}
        return columns(ActionRows, rows, empty, sizes.actions)

    def _conditions(self, sizes: Sizes) -> Conditions:
        rows = self.tables.conditions
        entities, elements = sizes.entities, sizes.elements
        for row in rows:
            row["who"] = list(row["who"]) + [False] * (entities - len(row["who"]))
            row["elements"] = list(row["elements"]) + [False] * (elements - len(row["elements"]))
        empty = no_condition() | {"who": [False] * entities, "elements": [False] * elements}
        return columns(Conditions, rows, empty, sizes.conditions)

    def _memory(self, board: Board, corridor: list[int], sizes: Sizes) -> Memory:
        count = board.entities.real.shape[0]
        rows = board.actions.kind.shape[0]
        elements, conditions = board.elements.level.shape[0], board.conditions.test.shape[0]
        s, t, yaw, pose, column, off = ([] for _ in range(6))
        for k, name in enumerate(self.names):
            chain = self.tables.corridors[corridor[k]]
            place = self.placer.at[name].pose
            along, beside = project(chain, place)
            mine = nearest_column(chain, along, beside)
            s.append(along)
            t.append(beside)
            yaw.append(math.remainder(place.h - point(chain, along, 0.0).h, 2 * math.pi))
            pose.append(self._local(place))
            column.append(mine)
            off.append(beside - column_center(chain, along, mine))

        def numbers(values: list[Any], fill: float = 0.0) -> Any:
            return padded(values, count, fill)

        held = [not (name == self.ego and self.active[name]) for name in self.names]
        nothing, zeros = np.zeros(count, np.float32), np.zeros(rows, np.float32)
        values = [self.number(x) for x in self.values.values()]
        fields: dict[str, Any] = dict(
            step=np.int32(0),
            corridor=padded(corridor, count, 0, np.int32),
            s=numbers(s),
            t=numbers(t),
            yaw=numbers(yaw),
            pose=np.concatenate(
                [np.array(pose, np.float32).reshape(-1, 3), np.zeros((count - len(pose), 3))]
            ).astype(np.float32),
            v=numbers([self.speeds[x] for x in self.names]),
            a=nothing,
            across=nothing,
            column=padded(column, count, SIDE, np.int32),
            off=numbers(off),
            held=padded(held, count, True, bool),
            there=padded([self.there[x] for x in self.names], count, False, bool),
            seen=padded([self.seen[x] for x in self.names], count, True, bool),
            travelled=nothing,
            stood=nothing - 1,
            ended=nothing - 1,
            off_road=nothing - 1,
            longitudinal=np.full(count, -1, np.int32),
            lateral=np.full(count, -1, np.int32),
            at=np.full(rows, np.inf, np.float32),
            base=zeros,
            target=zeros,
            span=zeros,
            went=zeros,
            column_from=np.zeros(rows, np.int32),
            off_from=zeros,
            anchor=np.zeros((rows, 3), np.float32),
            done=np.zeros(rows, bool),
            phase=np.full(elements, int(Phase.STANDBY), np.int32),
            change=np.zeros(elements, np.int32),
            runs=np.zeros(elements, np.int32),
            before=np.zeros(conditions, bool),
            looked=np.zeros(conditions, bool),
            past=np.zeros((conditions, board.ring), bool),
            values=padded(values, sizes.values, 0.0),
            over=np.bool_(False),
        )
        return Memory(**fields)


def _dynamics(shape: str, dimension: str, value: float) -> dict[str, Any]:
    return {"shape": SHAPES[shape], "dimension": DIMENSIONS[dimension], "over": value}


def _limits(limits: Limits | None) -> dict[str, Any]:
    if limits is None:
        return {"shape": Shape.STEP}
    bounds = limits.acceleration, limits.deceleration, limits.speed
    return {"shape": Shape.LINEAR, "limits": bounds}


def build(
    scenario: Scenario,
    roads: Roads,
    dt: float,
    *,
    script: bool = False,
    controlled: bool = False,
    sizes: Sizes | None = None,
) -> Built:
    """A scenario as arrays.

    Args:
      scenario: with all parameters resolved.
      roads: its map.
      dt: s, physics step.
      script: the ego keeps to its script, too.
      controlled: the policy drives the ego from the start.
      sizes: that the arrays have at least.

    Raises:
      OpenScenarioError: what does not fit the map, in one line.
    """
    builder = Builder(scenario, roads, dt, script=script, controlled=controlled)
    return builder.build(Sizes() if sizes is None else sizes)


def as_device(tree: Any) -> Any:
    """Arrays on the device."""
    return jax.tree.map(jnp.asarray, tree)


__all__ = ["Built", "Sizes", "Start", "as_device", "build"]
