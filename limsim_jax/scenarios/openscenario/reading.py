"""From elements to values: entities, positions, routes, trajectories."""

from __future__ import annotations

import itertools

from limsim_jax.scenarios.openscenario.catalogs import Catalogs, with_parameters
from limsim_jax.scenarios.openscenario.source import Node
from limsim_jax.scenarios.openscenario.storyboard import (
    Box,
    Clothoid,
    Entity,
    LanePosition,
    Nurbs,
    Orientation,
    Position,
    RelativeLanePosition,
    RelativeObjectPosition,
    RelativeRoadPosition,
    RelativeWorldPosition,
    RoadPosition,
    Route,
    RoutePosition,
    Trajectory,
    TrajectoryPosition,
    WorldPosition,
)

_KINDS = {"Vehicle": "vehicle", "Pedestrian": "pedestrian", "MiscObject": "miscellaneous"}
SMALLEST = 0.5
"""m, in place of a length or width of 0: of a person."""

_NESTED = 8  # positions within positions


class Reader:
    """Reads the parts of one scenario.

    Attributes:
      catalogs: of the scenario.
      entities: those read so far, by name.
      selections: names of entities by the name of their selection.
    """

    def __init__(self, catalogs: Catalogs) -> None:
        self.catalogs = catalogs
        self.entities: dict[str, Entity] = {}
        self.selections: dict[str, tuple[str, ...]] = {}

    # --- entities

    def read_entities(self, root: Node) -> None:
        """All `<ScenarioObject>` and `<EntitySelection>`."""
        block = root.optional("Entities")
        for one in [] if block is None else block.every():
            name = one.text("name")
            if not name:
                raise one.error("an entity needs a name")
            if name in self.entities or name in self.selections:
                raise one.error(f"'{name}' is there twice")
            if one.tag == "ScenarioObject":
                self.entities[name] = self._entity(one, name)
            elif one.tag == "EntitySelection":
                members = one.child("Members")
                found = [self.entity(x.text("entityRef"), x) for x in members.children("EntityRef")]
                kinds = [x.text("objectType") for x in members.children("ByType")]
                found += [x.name for x in self.entities.values() if x.kind in kinds]
                self.selections[name] = tuple(dict.fromkeys(found))
            else:
                raise one.error("is no entity")

    def _entity(self, node: Node, name: str) -> Entity:
        controllers = node.children("ObjectController")
        for controller in controllers:
            self.read_controller(controller)
        body = node.only([*_KINDS, "CatalogReference"], beside=("ObjectController",))
        if body is None:
            raise node.error("its body is not supported")
        if body.tag == "CatalogReference":
            body = self.catalogs.entry(body, *_KINDS)
        else:
            body = with_parameters(body, {})
        entity = self._body(body, name, bool(controllers))
        self.catalogs.notes_and_check(body)
        return entity

    def _body(self, node: Node, name: str, controlled: bool) -> Entity:
        kind = _KINDS[node.tag]
        for passive in node.children("Properties", "TrailerHitch", "TrailerCoupler"):
            passive.pass_over()
        for trailer in node.children("Trailer"):
            named = [x for x in trailer.children("TrailerRef") if x.text("entityRef", "")]
            if named or len(trailer.element) > len(trailer.children("TrailerRef")):
                node.source.refuse(trailer, "not supported: vehicles have no trailers")
        box_node = node.child("BoundingBox")
        center, size = box_node.child("Center"), box_node.child("Dimensions")
        length, width = (self._size(size, side) for side in ("length", "width"))
        box = Box(
            length=length,
            width=width,
            x=center.number("x"),
            y=center.number("y"),
        )
        if kind == "pedestrian":
            category = node.text("pedestrianCategory", "pedestrian")
            return Entity(name=name, kind=kind, category=category, box=box, controlled=controlled)
        if kind == "miscellaneous":
            return Entity(name=name, kind=kind, category=node.text("miscObjectCategory"), box=box)
        performance, axles = node.optional("Performance"), node.optional("Axles")
        bounds = {}
        if performance is not None:
            bounds = {
                "max_speed": performance.number("maxSpeed", above=0, infinite=True),
                "max_acceleration": performance.number("maxAcceleration", above=0, infinite=True),
                "max_deceleration": performance.number("maxDeceleration", above=0, infinite=True),
            }
        wheelbase = 0.0
        if axles is not None:
            front, rear = axles.optional("FrontAxle"), axles.optional("RearAxle")
            for axle in axles.children("AdditionalAxle"):
                axle.pass_over()
            places = [x.number("positionX") for x in (rear, front) if x is not None]
            wheelbase = abs(places[1] - places[0]) if len(places) == 2 else 0.0
        return Entity(
            name=name,
            kind=kind,
            category=node.text("vehicleCategory"),
            box=box,
            wheelbase=wheelbase,
            controlled=controlled,
            **bounds,
        )

    def _size(self, node: Node, name: str) -> float:
        size = node.number(name, least=0)
        if size == 0:
            node.source.note(f"<Dimensions>: {name} 0 is taken as {SMALLEST:g} m")
        return size or SMALLEST

    def read_controller(self, node: Node) -> None:
        """A controller: only that there is one matters."""
        for one in node.every():
            if one.tag == "ObjectController":
                self.read_controller(one)
            elif one.tag == "CatalogReference":
                found = self.catalogs.entry(one, "Controller")
                found.pass_over()
            elif one.tag == "Controller":
                one.pass_over()
            else:
                node.source.refuse(one, "is no controller")

    def entity(self, name: str, node: Node) -> str:
        """The name of an entity, if there is one.

        Raises:
          OpenScenarioError: there is none of that name.
        """
        if name in self.selections and len(self.selections[name]) == 1:
            return self.selections[name][0]
        if name not in self.entities:
            known = ", ".join(self.entities) or "none"
            raise node.error(f"unknown entity '{name}'; known are {known}")
        return name

    def members(self, name: str, node: Node) -> tuple[str, ...]:
        """The entities of a name: of an entity or of a selection."""
        return self.selections[name] if name in self.selections else (self.entity(name, node),)

    # --- positions

    def position(self, node: Node, depth: int = 0) -> Position:
        """The position within `<Position>` or another element that holds one."""
        if depth > _NESTED:
            raise node.error(f"positions nested more than {_NESTED} levels deep")
        known = (
            "WorldPosition", "RelativeWorldPosition", "RelativeObjectPosition", "RoadPosition",
            "RelativeRoadPosition", "LanePosition", "RelativeLanePosition", "RoutePosition",
            "TrajectoryPosition",
        )  # fmt: skip
        one = node.only(known)
        if one is None:
            raise node.error("its position is not supported")
        if one.tag == "WorldPosition":
            return WorldPosition(x=one.number("x"), y=one.number("y"), h=one.number("h", 0.0))
        facing = self._orientation(one)
        if one.tag == "LanePosition":
            return LanePosition(
                road=one.text("roadId"),
                lane=one.integer("laneId"),
                s=one.number("s"),
                offset=one.number("offset", 0.0),
                orientation=facing,
            )
        if one.tag == "RoadPosition":
            return RoadPosition(
                road=one.text("roadId"), s=one.number("s"), t=one.number("t"), orientation=facing
            )
        if one.tag == "RoutePosition":
            return self._route_position(one, facing, depth)
        if one.tag == "TrajectoryPosition":
            trajectory = self.trajectory(one.child("TrajectoryRef"), depth + 1)
            s, t = one.number("s", least=0), one.number("t", 0.0)
            return TrajectoryPosition(trajectory=trajectory, s=s, t=t, orientation=facing)
        entity = self.entity(one.text("entityRef"), one)
        if one.tag == "RelativeLanePosition":
            ds = one.number("dsLane", None)
            return RelativeLanePosition(
                entity=entity,
                lanes=one.integer("dLane"),
                ds=one.number("ds", 0.0) if ds is None else ds,
                offset=one.number("offset", 0.0),
                orientation=facing,
            )
        if one.tag == "RelativeRoadPosition":
            return RelativeRoadPosition(
                entity=entity, ds=one.number("ds"), dt=one.number("dt"), orientation=facing
            )
        dx, dy = one.number("dx"), one.number("dy")
        one.number("dz", 0.0)
        kind = RelativeWorldPosition if one.tag == "RelativeWorldPosition" else RelativeObjectPosition
        return kind(entity=entity, dx=dx, dy=dy, orientation=facing)

    def _orientation(self, node: Node) -> Orientation | None:
        one = node.optional("Orientation")
        if one is None:
            return None
        relative = one.choice("type", ("absolute", "relative"), "absolute") == "relative"
        return Orientation(h=one.number("h", 0.0), relative=relative)

    def _route_position(self, node: Node, facing: Orientation | None, depth: int) -> RoutePosition:
        route = self.route(node.child("RouteRef"), depth + 1)
        block = node.child("InRoutePosition")
        names = ("FromRoadCoordinates", "FromLaneCoordinates", "RoadCoordinates", "LaneCoordinates")
        place = block.only(names)
        if place is None:
            raise node.error("its position is not supported")
        s = place.number("pathS", least=0)
        if place.tag.endswith("LaneCoordinates"):
            lane, t = place.integer("laneId"), place.number("laneOffset", 0.0)
        else:
            lane, t = None, place.number("t")
        return RoutePosition(route=route, s=s, lane=lane, t=t, orientation=facing)

    def route(self, node: Node, depth: int = 0) -> Route:
        """The route within an element, or from a catalog."""
        one = node.only(("Route", "CatalogReference"))
        if one is None:
            raise node.error("its route is not supported")
        if one.tag == "CatalogReference":
            one = self.catalogs.entry(one, "Route")
        else:
            one = with_parameters(one, {})
        one.flag("closed", False)
        found = []
        for waypoint in one.children("Waypoint"):
            waypoint.text("routeStrategy", "shortest")
            found.append(self.position(waypoint.child("Position"), depth + 1))
        if len(found) < 1:
            raise one.error("a route needs waypoints")
        self.catalogs.notes_and_check(one)
        return Route(name=one.label(), waypoints=tuple(found))

    def trajectory(self, node: Node, depth: int = 0) -> Trajectory:
        """The trajectory within an element, or from a catalog.

        Raises:
          OpenScenarioError: its shape is none of straight pieces.
        """
        one = node.only(("Trajectory", "CatalogReference"))
        if one is None:
            raise node.error("its trajectory is not supported")
        return self.trajectory_of(one, depth)

    def trajectory_of(self, one: Node, depth: int = 0) -> Trajectory:
        """The trajectory that this element is or names."""
        if one.tag == "CatalogReference":
            one = self.catalogs.entry(one, "Trajectory")
        else:
            one = with_parameters(one, {})
        one.flag("closed", False)
        shape = one.child("Shape").only(("Polyline", "Clothoid", "ClothoidSpline", "Nurbs"))
        if shape is None:
            raise one.error("its shape is not supported")
        times: list[float | None] = []
        points: list[Position] = []
        clothoids: list[Clothoid] = []
        nurbs = None
        if shape.tag == "Polyline":
            for vertex in shape.children("Vertex"):
                points.append(self.position(vertex.child("Position"), depth + 1))
                times.append(vertex.number("time", None))
            if len(points) < 2:
                raise shape.error(f"{len(points)} vertices; a trajectory needs two")
        elif shape.tag == "Nurbs":
            order, weights = shape.integer("order", least=2), []
            for control in shape.children("ControlPoint"):
                points.append(self.position(control.child("Position"), depth + 1))
                times.append(control.number("time", None))
                weights.append(control.number("weight", 1.0, above=0))
            knots = tuple(x.number("value") for x in shape.children("Knot"))
            if len(points) < order or len(knots) != len(points) + order:
                raise shape.error(
                    f"{len(points)} control points of order {order} need {len(points) + order} knots, "
                    f"not {len(knots)}"
                )
            if any(b < a for a, b in itertools.pairwise(knots)):
                raise shape.error("its knots do not grow")
            nurbs = Nurbs(order=order, weights=tuple(weights), knots=knots)
        elif shape.tag == "Clothoid":
            length, begin = shape.number("length", above=0), shape.number("curvature")
            change = shape.number("curvaturePrime", None)
            change = shape.number("curvatureDot", 0.0) if change is None else change
            place = self.position(shape.child("Position"), depth + 1)
            clothoids.append(Clothoid(length=length, begin=begin, end=begin + change * length, start=place))
            times = [shape.number("startTime", None), shape.number("stopTime", None)]
        else:
            for piece in shape.children("ClothoidSplineSegment"):
                start = piece.optional("PositionStart")
                clothoids.append(
                    Clothoid(
                        length=piece.number("length", above=0),
                        begin=piece.number("curvatureStart"),
                        end=piece.number("curvatureEnd"),
                        turn=piece.number("hOffset", 0.0),
                        start=None if start is None else self.position(start, depth + 1),
                    )
                )
                times.append(piece.number("timeStart", None))
            if not clothoids:
                raise shape.error("has no segments")
            times.append(shape.number("timeEnd", None))
        known = [x for x in times if x is not None]
        timed = len(known) == len(times)
        if timed and any(b < a for a, b in itertools.pairwise(known)):
            raise shape.error("its times do not grow")
        self.catalogs.notes_and_check(one)
        return Trajectory(
            name=one.label(),
            points=tuple(points),
            times=tuple(known) if timed else None,
            clothoids=tuple(clothoids),
            nurbs=nurbs,
        )
