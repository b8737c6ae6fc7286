"""Elements of a SUMO network file, checked one by one."""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from limsim_jax.maps.network import Array, Control, ImportReport, MapError, Turn
from limsim_jax.maps.sumo.classes import OLD_CLASSES, VEHICLE_CLASSES
from limsim_jax.maps.sumo.programs import Programs
from limsim_jax.maps.xml import Element, XmlReader

DEFAULT_WIDTH = 3.2  # m, SUMO's lane width where the file has none

DRIVEN = frozenset({"normal", "internal"})
"""Functions of edges whose lanes are ways for vehicles."""

_TURNS = {
    "s": Turn.STRAIGHT,
    "t": Turn.U_TURN,
    "T": Turn.U_TURN,
    "l": Turn.LEFT,
    "r": Turn.RIGHT,
    "L": Turn.SLIGHT_LEFT,
    "R": Turn.SLIGHT_RIGHT,
}

CONTROLS = {
    "M": Control.PRIORITY,
    "m": Control.YIELD,
    "s": Control.STOP,
    "w": Control.ALL_WAY_STOP,
    "=": Control.NONE,
    "Z": Control.ZIPPER,
    "-": Control.NONE,  # dead end
    "O": Control.PRIORITY,  # lights switched off
    "o": Control.YIELD,  # lights blinking
}


@dataclass(kw_only=True)
class FileEdge:
    """An `<edge>`."""

    id: str
    function: str
    element: Element
    lanes: list[FileLane]
    junction: str | None = None


@dataclass(kw_only=True)
class FileLane:
    """A `<lane>`, and the connections that leave it."""

    id: str
    index: int
    edge: FileEdge
    element: Element
    speed: float
    length: float
    width: float
    allowed: frozenset[str]
    change_left: frozenset[str]
    change_right: frozenset[str]
    points: Float[Array, "K 3"]
    stop_offset: float = 0.0
    opposite: str | None = None
    outgoing: list[Connection] = field(default_factory=list)


@dataclass(kw_only=True, eq=False)
class Connection:
    """A `<connection>` from lane to lane, across a junction or inside one."""

    source: FileLane
    target: FileLane
    element: Element
    turn: Turn
    control: Control  # where no light controls it
    via: FileLane | None
    light: str | None
    link: int | None
    keep_clear: bool
    allowed: frozenset[str]


class Elements:
    """The elements of one net file, linked by their ids."""

    def __init__(self, xml: XmlReader, root: Element, report: ImportReport) -> None:
        """Read all children of the root element. Raises `MapError`."""
        self.xml, self.root, self.report = xml, root, report
        self.left_hand = xml.flag(root, "lefthand")
        self.version = xml.text(root, "version", "")
        self.edges: dict[str, FileEdge] = {}
        self.lanes: dict[str, FileLane] = {}
        self.junction_elements: dict[str, Element] = {}
        self.programs = Programs(report)
        self.roundabouts: set[str] = set()
        self.geo_reference = ""
        self._read()

    def _read(self) -> None:
        by_tag: dict[str, list[Element]] = defaultdict(list)
        for element in self.root:
            by_tag[element.tag].append(element)
        for element in by_tag.pop("location", []):
            self._location(element)
        for element in by_tag.pop("edge", []):
            self._edge(element)
        for element in by_tag.pop("junction", []):
            name = self.xml.text(element, "id")
            if name in self.junction_elements:
                raise self.xml.error(element, "second junction of this id")
            self.junction_elements[name] = element
        for element in by_tag.pop("connection", []):
            self._connection(element)
        for element in by_tag.pop("tlLogic", []):
            self.programs.add(self.xml, element)
        for element in by_tag.pop("roundabout", []):
            nodes = self.xml.text(element, "nodes").split()
            self.xml.text(element, "edges", "")
            if missing := [n for n in nodes if n not in self.junction_elements]:
                raise self.xml.error(element, f"there is no junction '{missing[0]}'")
            self.roundabouts.update(nodes)
            self.done(element)
        messages = {
            "type": "edge types are defaults for building a net; the lanes carry their own values",
            "prohibition": "for building a net; the request matrices carry the outcome",
            "taz": "districts are demand",
            "district": "districts are demand",
        }
        for tag, elements in by_tag.items():
            for element in elements:
                self.xml.ignore(element, messages.get(tag, "not part of the road network"))
        if not self.edges:
            raise MapError("the net has no edges", file=self.xml.path)
        self.xml.ignore_unasked(self.root)

    def done(self, element: Element, count: bool = True) -> None:
        """Count an element as read, and its unused attributes as ignored."""
        if count:
            self.report.read(element.tag)
        self.xml.ignore_unasked(element)

    def _location(self, element: Element) -> None:
        offset = self.xml.text(element, "netOffset", "0,0")
        projection = self.xml.text(element, "projParameter", "!")
        for name in ("convBoundary", "origBoundary"):
            self.xml.text(element, name, "")
        if projection not in ("!", "", "-"):
            self.geo_reference = projection
            if any(float(x) for x in re.findall(r"[-+.\deE]+", offset) if _is_number(x)):
                message = f"coordinates are those of the projection shifted by netOffset {offset}"
                self.report.approximated("location", "", message, element.sourceline)
                self.done(element, count=False)
                return
        self.done(element)

    def _classes(self, element: Element, allow: str | None, disallow: str | None) -> frozenset[str]:
        def names(value: str) -> set[str]:
            found = set()
            for name in re.split(r"[\s|]+", value.strip()):
                name = OLD_CLASSES.get(name, name)
                if name == "all":
                    return set(VEHICLE_CLASSES)
                if name in VEHICLE_CLASSES:
                    found.add(name)
                elif name and name != "ignoring":  # vehicles of that class ignore all permissions
                    self.xml.ignore(element, f"vehicle class '{name}' is unknown")
            return found

        if allow is not None and allow.strip():
            return frozenset(names(allow))
        if disallow is not None:
            return VEHICLE_CLASSES - names(disallow)
        return VEHICLE_CLASSES

    def _permissions(self, element: Element) -> frozenset[str]:
        allow, disallow = (self.xml.text(element, name, None) for name in ("allow", "disallow"))
        return self._classes(element, allow, disallow)

    def _edge(self, element: Element) -> None:
        xml = self.xml
        edge = FileEdge(
            id=xml.text(element, "id"),
            function=xml.text(element, "function", "normal"),
            element=element,
            lanes=[],
        )
        if edge.function not in {"normal", "internal", "connector", "crossing", "walkingarea"}:
            raise xml.error(element, f"function='{edge.function}' is unknown")
        if edge.id in self.edges:
            raise xml.error(element, "second edge of this id")
        self.edges[edge.id] = edge
        for name in ("from", "to"):
            if edge.function == "normal":
                xml.text(element, name)
        for name in ("priority", "name", "type", "crossingEdges", "shape", "spreadType"):
            xml.text(element, name, None)  # netconvert built the lane shapes from the shape of the edge
        if bidi := xml.text(element, "bidi", None):
            message = f"shares its track with edge '{bidi}'; the two are independent here"
            self.report.approximated("edge", edge.id, message, element.sourceline)
        offset = self._stop_offset(element, 0.0)
        for child in element:
            if child.tag == "lane":
                self._lane(child, edge, offset)
        if not edge.lanes:
            raise xml.error(element, "the edge has no lanes")
        for position, lane in enumerate(edge.lanes):
            # SUMO goes by the order; netconvert writes index 0 for all lanes behind a place to wait.
            if lane.index != position:
                message = f"index {lane.index} taken as {position}, its place in the edge"
                self.report.repaired("lane", lane.id, message, lane.element.sourceline)
                lane.index = position
        fastest = max(lane.speed for lane in edge.lanes)
        for lane in edge.lanes:
            if lane.speed <= 0.0:
                if fastest <= 0.0:
                    message = (
                        f"speed='{lane.speed:g}' is not above 0, nor is that of another lane of its edge"
                    )
                    raise xml.error(lane.element, message)
                message = (
                    f"speed {lane.speed:g} m/s, taken as the {fastest:g} m/s of another lane of its edge"
                )
                self.report.repaired("lane", lane.id, message, lane.element.sourceline)
                lane.speed = fastest
        self.xml.ignore_children(element, "lane", "stopOffset")
        self.done(element, count=not bidi)

    def _stop_offset(self, element: Element, inherited: float) -> float:
        """Distance (m) for cars from the stop position to the lane end."""
        offset = inherited
        for child in element.findall("stopOffset"):
            value = self.xml.number(child, "value", minimum=0.0)
            chosen, spared = self.xml.text(child, "vClasses", None), self.xml.text(child, "exceptions", None)
            if chosen is not None or spared is not None:
                message = "for some vehicle classes; here for all of them if passenger cars are among them"
                self.report.approximated("stopOffset", element.get("id"), message, child.sourceline)
                if "passenger" not in self._classes(child, chosen, spared):
                    continue
            else:
                self.report.read("stopOffset")
            offset = value
        return offset

    def _lane(self, element: Element, edge: FileEdge, stop_offset: float) -> None:
        xml = self.xml
        lane = FileLane(
            id=xml.text(element, "id"),
            index=xml.integer(element, "index"),
            edge=edge,
            element=element,
            speed=xml.number(element, "speed"),
            length=xml.number(element, "length", minimum=0.0),
            width=xml.number(element, "width", DEFAULT_WIDTH),
            allowed=self._permissions(element),
            change_left=self._classes(element, xml.text(element, "changeLeft", None), None),
            change_right=self._classes(element, xml.text(element, "changeRight", None), None),
            points=polyline(xml, element, "shape"),
            stop_offset=self._stop_offset(element, stop_offset),
        )
        if lane.id in self.lanes:
            raise xml.error(element, "second lane of this id")
        if lane.width <= 0.0:
            message = f"width {lane.width:g} m, taken as the default of {DEFAULT_WIDTH} m"
            self.report.repaired("lane", lane.id, message, element.sourceline)
            lane.width = DEFAULT_WIDTH
        for name in ("type", "acceleration", "customShape"):
            xml.text(element, name, None)
        if edge.function == "crossing":
            polyline(xml, element, "outlineShape")
        for child in element.findall("neigh"):
            lane.opposite = xml.text(child, "lane")
            self.done(child)
        self.xml.ignore_children(element, "neigh", "stopOffset")
        edge.lanes.append(lane)
        self.lanes[lane.id] = lane
        self.done(element, count=False)

    def _lane_of(self, element: Element, edge_name: str, lane_name: str) -> FileLane:
        edge = self.edges.get(self.xml.text(element, edge_name))
        if edge is None:
            raise self.xml.error(element, f"there is no edge {edge_name}='{element.get(edge_name)}'")
        index = self.xml.integer(element, lane_name)
        if not 0 <= index < len(edge.lanes):
            raise self.xml.error(element, f"edge '{edge.id}' has no lane {lane_name}='{index}'")
        return edge.lanes[index]

    def _connection(self, element: Element) -> None:
        xml = self.xml
        via = xml.text(element, "via", None) or None
        if via is not None and via not in self.lanes:
            raise xml.error(element, f"there is no lane via='{via}'")
        light = xml.text(element, "tl", None) or None
        link = xml.integer(element, "linkIndex") if light else None
        if link is not None and link < 0:  # tracks at a level crossing: their signals are elsewhere
            light = link = None
        connection = Connection(
            source=self._lane_of(element, "from", "fromLane"),
            target=self._lane_of(element, "to", "toLane"),
            element=element,
            turn=xml.choice(element, "dir", _TURNS),
            control=xml.choice(element, "state", CONTROLS),
            via=self.lanes[via] if via else None,
            light=light,
            link=link,
            keep_clear=xml.flag(element, "keepClear", True),
            allowed=self._permissions(element),
        )
        xml.text(element, "uncontrolled", None)  # the light of the junction does not control it: it has no tl
        if connection.via is None and connection.allowed != VEHICLE_CLASSES:
            message = "no lane inside the junction that could carry its permissions"
            self.report.approximated("connection", connection_name(element), message, element.sourceline)
            self.done(element, count=False)
        else:
            self.done(element)
        connection.source.outgoing.append(connection)
        self.xml.ignore_children(element)


def polyline(xml: XmlReader, element: Element, name: str) -> Float[Array, "K 3"]:
    """The points `[K, 3]` (m) of a polyline `x,y[,z] x,y[,z] ...`.

    z is 0 where the file has none. An empty attribute has no points.
    """
    points = []
    for item in xml.text(element, name, "").split():
        parts = item.split(",")
        if len(parts) not in (2, 3):
            raise xml.error(element, f"{name}: '{item[:40]}' is not x,y or x,y,z")
        xyz = [xml.parse_number(element, name, part) for part in parts]
        if max(map(abs, xyz)) > 1e9:
            raise xml.error(element, f"{name}: '{item[:40]}' lies more than 1e9 m away")
        points.append(xyz if len(xyz) == 3 else [*xyz, 0.0])
    return np.array(points, float).reshape(-1, 3)


def connection_name(element: Element) -> str:
    """Name of a `<connection>`: the lanes that it joins."""
    get = element.get
    return f"from {get('from')}_{get('fromLane')} to {get('to')}_{get('toLane')}"


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
