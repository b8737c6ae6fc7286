"""Drawings of a `Network`: lanes, marks, directions, junctions, lights, signs, crosswalks, conflicts.

`draw_map` makes a page (title, legend, scale bar, strips for long thin maps); `draw_network` draws on
axes that the caller owns and is the base layer of animations: draw it once, keep the background, and
blit traffic above it at `TRAFFIC_ZORDER` or higher.

matplotlib (extra `viz`) is imported when something is drawn, never before.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence, Sized
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from limsim_jax.maps.network import (
    DRIVABLE,
    Action,
    Array,
    Control,
    Lane,
    LaneSpot,
    LaneType,
    MapError,
    Network,
    SignKind,
    Turn,
)

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Bounds = tuple[float, float, float, float]

TRAFFIC_ZORDER = 100.0
"""Everything that `draw_network` draws lies below this."""

SUFFIXES = (".png", ".svg", ".pdf")

# Hues after Okabe and Ito (2008), which the common colour deficiencies keep apart; areas in pale tints.
INK = "#2f3742"
EDGE = "#5d6773"
MARK = "#ffffff"
CENTRE = "#f0b400"
JUNCTION = "#d3cde6"
RED = "#c1121f"
_KINDS: dict[str, tuple[str, tuple[LaneType, ...]]] = {
    "driving lane": ("#b3bac4", (LaneType.DRIVING, LaneType.SHARED, LaneType.SLIP_LANE)),
    "entry, exit, ramp": (
        "#93a9c4",
        (
            LaneType.ENTRY,
            LaneType.EXIT,
            LaneType.ON_RAMP,
            LaneType.OFF_RAMP,
            LaneType.CONNECTING_RAMP,
        ),
    ),
    "bus, taxi, HOV lane": ("#dba58a", (LaneType.BUS, LaneType.TAXI, LaneType.HOV)),
    "bidirectional lane": ("#e0d27c", (LaneType.BIDIRECTIONAL,)),
    "cycle lane": ("#8fcfb6", (LaneType.BIKING,)),
    "sidewalk": ("#ebe3d3", (LaneType.SIDEWALK, LaneType.WALKING)),
    "shoulder, stop lane": ("#dde1e6", (LaneType.SHOULDER, LaneType.STOP)),
    "parking": ("#b5d8ee", (LaneType.PARKING,)),
    "median, border, curb": ("#d6e0c6", (LaneType.MEDIAN, LaneType.BORDER, LaneType.CURB)),
    "tram, rail": ("#d8b7cf", (LaneType.TRAM, LaneType.RAIL)),
    "closed or other lane": (
        "#f1f1f1",
        (LaneType.RESTRICTED, LaneType.ROAD_WORKS, LaneType.SPECIAL, LaneType.NONE),
    ),
}
_KIND_OF = {type_: kind for kind, (_, types) in _KINDS.items() for type_ in types}
_TRAFFIC = DRIVABLE | {LaneType.BIDIRECTIONAL}
_TURNS: dict[str, tuple[str, tuple[Turn, ...]]] = {
    "straight": ("#0072b2", (Turn.STRAIGHT,)),
    "left": ("#d55e00", (Turn.LEFT, Turn.SLIGHT_LEFT)),
    "right": ("#007a57", (Turn.RIGHT, Turn.SLIGHT_RIGHT)),
    "u-turn": ("#b0528f", (Turn.U_TURN,)),
}
_TURN_OF = {turn: name for name, (_, turns) in _TURNS.items() for turn in turns}
_CONFLICTS = {"diverge": "#56b4e9", "merge": "#e69f00", "cross": "#d55e00"}  # in drawing order

_Zones = dict[str, list[tuple[str, float, float]]]  # kind -> lane id, s_in, s_out (m)

_POINT = 72.0  # points per inch


@dataclass(frozen=True, eq=False)
class _Shape:
    """A lane made ready for drawing: `[M, 2]` centre and borders (m), `[M]` s, road_s, heading."""

    lane: Lane
    s: Array
    road_s: Array
    heading: Array
    centre: Array
    left: Array
    right: Array

    @property
    def polygon(self) -> Array:
        return np.concatenate([self.left, self.right[::-1]])

    def meets(self, bounds: Bounds) -> bool:
        low = np.minimum(self.left.min(0), self.right.min(0))
        high = np.maximum(self.left.max(0), self.right.max(0))
        return bool(
            low[0] <= bounds[2] and high[0] >= bounds[0] and low[1] <= bounds[3] and high[1] >= bounds[1]
        )

    def at(self, s: Any, border: Array) -> Array:
        """Points `[..., 2]` of a border or the centre at arc length `s` (m, clipped)."""
        return np.stack([np.interp(s, self.s, border[:, 0]), np.interp(s, self.s, border[:, 1])], -1)

    def heading_at(self, s: float) -> float:
        """Direction of travel (rad) at arc length `s` (m, clipped)."""
        return float(np.interp(s, self.s, self.heading))

    def stretch(self, s_in: float, s_out: float, share: float) -> Array:
        """Outline `[K, 2]` of the middle share of the surface between two arc lengths (m)."""
        inside = self.s[(self.s > s_in) & (self.s < s_out)]
        s = np.concatenate([[s_in], inside, [s_out]])
        centre = self.at(s, self.centre)
        left, right = (centre + share * (self.at(s, side) - centre) for side in (self.left, self.right))
        return np.concatenate([left, right[::-1]])


def _shape(lane: Lane) -> _Shape:
    # Samples are sparse where the cubic bends between them; a drawing is made of straight pieces.
    pieces = np.maximum(1, np.ceil(np.abs(np.diff(lane.heading)) / math.radians(3.0)).astype(int))
    start = np.repeat(np.arange(len(pieces)), pieces)
    step = np.arange(len(start)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    s = np.append(lane.s[start] + step / pieces[start] * np.diff(lane.s)[start], lane.s[-1])
    xyz, _ = lane.pose(s)
    heading = np.interp(s, lane.s, lane.heading)  # the slope of the cubic is noise between twin samples
    normal = np.stack([-np.sin(heading), np.cos(heading)], -1)
    half = 0.5 * np.maximum(lane.width_at(s), 0.0)[:, None] * normal
    centre = xyz[:, :2]
    road_s = np.interp(s, lane.s, lane.road_s)
    return _Shape(lane, s, road_s, heading, centre, centre + half, centre - half)


def _kind(lane: Lane) -> str:
    if lane.type in DRIVABLE and not lane.drivable:
        return "closed or other lane"
    return _KIND_OF[lane.type]


def _levels(shapes: Iterable[_Shape]) -> dict[str, int]:
    """Storey of each lane by its mean height, so that a bridge hides the road below it."""
    height = {shape.lane.id: float(shape.lane.xyz[:, 2].mean()) for shape in shapes}
    low, high = min(height.values()), max(height.values())
    storey = max(3.0, (high - low) / 12)  # m, below the clearance of any bridge for cars unless steep
    return {lane: int((z - low) / storey) for lane, z in height.items()}


def _zones(network: Network) -> _Zones:
    """The stretches that `conflicts.build_conflicts` finds, joined per lane and kind."""
    from limsim_jax.maps.conflicts import ConflictType, build_conflicts
    from limsim_jax.maps.lane_map import lane_rows

    rows = lane_rows(network)
    ids = list(rows)
    table = build_conflicts(network, rows)
    zones: _Zones = {}
    for kind in _CONFLICTS:
        zones[kind] = []
        for k, found in enumerate(np.asarray(table.type) == ConflictType[kind.upper()]):
            spans = zip(table.s_in[k][found].tolist(), table.s_out[k][found].tolist(), strict=True)
            zones[kind].extend((ids[int(table.lane[k])], a, b) for a, b in _joined(spans))
    return zones


def _joined(spans: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    """The union of intervals, ascending."""
    union: list[tuple[float, float]] = []
    for start, end in sorted(spans):
        if union and start <= union[-1][1]:
            union[-1] = (union[-1][0], max(end, union[-1][1]))
        else:
            union.append((start, end))
    return union


def _dashes(line: Array, road_s: Array, period: float) -> Array:
    """Segments `[K, 2, 2]` of the painted halves of each period along a line `[M, 2]`."""
    if road_s[-1] < road_s[0]:
        line, road_s = line[::-1], road_s[::-1]
    half = period / 2
    first, last = math.ceil(road_s[0] / half), math.floor(road_s[-1] / half)
    u = np.union1d(road_s, np.arange(first, last + 1) * half)
    xy = np.stack([np.interp(u, road_s, line[:, 0]), np.interp(u, road_s, line[:, 1])], -1)
    painted = np.floor(0.5 * (u[:-1] + u[1:]) / half) % 2 == 0
    return np.stack([xy[:-1], xy[1:]], 1)[painted]


def _halfplane(polygon: Array, normal: Array, offset: float) -> Array:
    """The part of a polygon `[K, 2]` where `normal . p <= offset` (Sutherland and Hodgman 1974)."""
    side = polygon @ normal - offset
    corners: list[Array] = []
    for p, q, a, b in zip(polygon, np.roll(polygon, -1, 0), side, np.roll(side, -1), strict=True):
        if a <= 0:
            corners.append(p)
        if a * b < 0:
            corners.append(p + (q - p) * a / (a - b))
    return np.array(corners).reshape(-1, 2)


def _darts(xy: Array, heading: Array, length: float, width: float) -> Array:
    """Arrow polygons `[K, 4, 2]`, centred on `xy [K, 2]`; the first corner is the tip."""
    outline = np.array([[0.5, 0.0], [-0.5, 0.5], [-0.25, 0.0], [-0.5, -0.5]]) * [length, width]
    return _placed(outline, xy, heading)


def _arrows(xy: Array, heading: Array, length: float, width: float) -> Array:
    """Arrows with a shaft `[K, 7, 2]`; the first corner is the tip."""
    outline = np.array(
        [[0.5, 0.0], [0.0, 0.5], [0.0, 0.13], [-0.5, 0.13], [-0.5, -0.13], [0.0, -0.13], [0.0, -0.5]]
    )
    return _placed(outline * [length, width], xy, heading)


def _placed(outline: Array, xy: Array, heading: Array) -> Array:
    cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
    x, y = outline[:, 0], outline[:, 1]
    return xy[:, None, :] + np.stack([cos * x - sin * y, sin * x + cos * y], -1)


class _Painter:
    """Draws one network on one pair of axes, which it sets to show `bounds` with equal aspect."""

    def __init__(
        self,
        ax: Axes,
        network: Network,
        shapes: dict[str, _Shape],
        levels: dict[str, int],
        bounds: Bounds,
        name: str = "",
    ) -> None:
        ax.set_aspect("equal", adjustable="box")
        ax.set_xlim(bounds[0], bounds[2])
        ax.set_ylim(bounds[1], bounds[3])
        extent = ax.get_window_extent()
        pixels = min(extent.width / (bounds[2] - bounds[0]), extent.height / (bounds[3] - bounds[1]))
        figure = ax.get_figure(root=True)
        assert figure is not None
        self.ax, self.network, self.bounds, self.name = ax, network, bounds, name
        self.shapes = {id_: shape for id_, shape in shapes.items() if shape.meets(bounds)}
        self.levels = levels
        self.ppm = pixels * _POINT / figure.dpi  # scale in points per metre
        self.layers: dict[str, list[Artist]] = {}
        self.legend: dict[str, dict[str, Any]] = {}  # label -> style of its sample

    def paint(self, *, zones: _Zones | None, labels: bool) -> None:
        self.surfaces()
        self.marks()
        self.arrows()
        self.connectors(faint=zones is not None)
        if zones is not None:
            self.conflicts(zones)
        self.crosswalks()
        self.stops()
        self.lights()
        self.signs()
        if labels:
            self.labels()

    def keep(self, layer: str, artist: Any, zorder: float) -> Any:
        """Register an artist under a layer; its `gid` names it in SVG files."""
        artist.set_zorder(zorder)
        artist.set_gid(f"{self.name}{layer}-{len(self.layers.setdefault(layer, []))}")
        self.layers[layer].append(artist)
        return artist

    def points(self, metres: float, least: float, most: float) -> float:
        """A size in metres as points, held between two sizes that the eye can use (points)."""
        return min(max(metres * self.ppm, least), most)

    def lines(self, layer: str, segments: Sequence[Any] | Array, zorder: float, **style: Any) -> None:
        from matplotlib.collections import LineCollection

        if len(segments):
            style = {"capstyle": "butt", **style}
            collection = LineCollection(list(segments), **style)
            self.ax.add_collection(collection, autolim=False)
            self.keep(layer, collection, zorder)

    def areas(self, layer: str, polygons: Sequence[Any] | Array, zorder: float, **style: Any) -> None:
        from matplotlib.collections import PolyCollection

        if len(polygons):
            collection = PolyCollection(list(polygons), **style)
            self.ax.add_collection(collection, autolim=False)
            self.keep(layer, collection, zorder)

    def by_level(self, shapes: Iterable[_Shape]) -> Iterator[tuple[int, list[_Shape]]]:
        groups: dict[int, list[_Shape]] = {}
        for shape in shapes:
            groups.setdefault(self.levels[shape.lane.id], []).append(shape)
        yield from sorted(groups.items())

    def visible(self, position: Any) -> bool:
        x0, y0, x1, y1 = self.bounds
        return x0 <= position[0] <= x1 and y0 <= position[1] <= y1

    def spot(self, spot: LaneSpot, share: float = 1.0) -> Array | None:
        """A bar `[2, 2]` across the lane at a spot, over a share of its width."""
        shape = self.shapes.get(spot.lane)
        if shape is None:
            return None
        middle = shape.at(spot.s, shape.centre)
        bar = np.stack([shape.at(spot.s, shape.left), shape.at(spot.s, shape.right)])
        return middle + share * (bar - middle)

    # What is drawn, from the ground up.

    def surfaces(self) -> None:
        def rank(shape: _Shape) -> tuple[bool, bool, bool]:
            lane = shape.lane
            return lane.drivable, lane.junction is None, lane.type is not LaneType.NONE

        for level, shapes in self.by_level(self.shapes.values()):
            shapes = sorted(shapes, key=rank)
            colors = []
            for shape in shapes:
                lane, kind = shape.lane, _kind(shape.lane)
                inside = lane.drivable and lane.junction is not None
                colors.append(JUNCTION if inside else _KINDS[kind][0])
                label = "junction" if inside else kind
                self.legend[label] = {"area": colors[-1]}
            # The hairline in the colour of the face closes the seams between neighbours.
            self.areas(
                "surfaces",
                [shape.polygon for shape in shapes],
                level,
                facecolors=colors,
                edgecolors=colors,
                linewidths=0.3,
            )

    def marks(self) -> None:
        """Borders of lanes outside junctions: solid where crossing is forbidden, dashed where allowed."""
        width = self.points(0.15, 0.25, 1.8)
        gap = max(0.12, 0.9 * width / self.ppm)  # m, half the distance of the lines of a double mark
        period = max(6.0, 5.0 / self.ppm)
        lanes = self.network.lanes
        for level, shapes in self.by_level(self.shapes.values()):
            solid: list[Array] = []
            dashed: list[Array] = []
            centre: list[Array] = []
            edge: list[Array] = []
            kerb: list[Array] = []
            done: set[frozenset[str]] = set()
            # Lanes with traffic first: the border that they share with others is theirs.
            for shape in sorted(shapes, key=lambda shape: not shape.lane.drivable):
                lane = shape.lane
                if lane.junction is not None:
                    continue
                beyond_right = (road := self.network.roads.get(lane.road)) is not None and road.left_hand
                for side, neighbour in (("left", lane.left), ("right", lane.right)):
                    border = shape.left if side == "left" else shape.right
                    oncoming = lane.opposite if (side == "right") == beyond_right else None
                    other = neighbour or oncoming
                    if other is not None:
                        pair = frozenset((lane.id, other))
                        if pair in done:
                            continue
                        done.add(pair)
                    if not lane.drivable:
                        kerb.append(border)
                    elif neighbour in lanes and lanes[neighbour].drivable:
                        out = lane.may_change_left if side == "left" else lane.may_change_right
                        back = lanes[neighbour]
                        into = back.may_change_right if side == "left" else back.may_change_left
                        if out == into:
                            if out:
                                dashed.extend(_dashes(border, shape.road_s, period))
                            else:
                                solid.append(border)
                        else:
                            # The line next to a lane is the one that binds its traffic.
                            outward = np.stack([-np.sin(shape.heading), np.cos(shape.heading)], -1)
                            outward = gap * (outward if side == "left" else -outward)
                            near, far = border - outward, border + outward
                            solid.append(far if out else near)
                            dashed.extend(_dashes(near if out else far, shape.road_s, period))
                    elif oncoming in lanes and lanes[oncoming].type in _TRAFFIC:
                        centre.append(border)
                    else:
                        edge.append(border)
            self.lines("marks", kerb, level + 0.20, colors="#b9bfc7", linewidths=0.6 * width)
            self.lines("marks", edge, level + 0.22, colors=EDGE, linewidths=width)
            # Where lanes are thinner than the marks would be, marks hide the lanes.
            if 3.5 * self.ppm > 2.0:
                self.lines("marks", solid, level + 0.24, colors=MARK, linewidths=width)
                self.lines("marks", dashed, level + 0.24, colors=MARK, linewidths=width)
                if solid:
                    self.legend["crossing forbidden"] = {"line": MARK, "on": _KINDS["driving lane"][0]}
                if dashed:
                    self.legend["crossing allowed"] = {
                        "line": MARK,
                        "on": _KINDS["driving lane"][0],
                        "dashed": True,
                    }
            self.lines("marks", centre, level + 0.26, colors=CENTRE, linewidths=1.2 * width)
            if centre:
                self.legend["between directions"] = {"line": CENTRE, "on": _KINDS["driving lane"][0]}

    def arrows(self) -> None:
        """Directions of travel: evenly spaced along roads, at most one per patch of the page."""
        length = max(3.6, 4.8 / self.ppm)  # m
        slim = length * self.ppm > 9.0
        width = 0.42 * length if slim else 0.8 * length
        spacing = max(28.0, 4.0 * length, 30.0 / self.ppm)
        taken: set[tuple[int, int, int]] = set()
        for level, shapes in self.by_level(self.shapes.values()):
            places: list[Array] = []
            headings: list[float] = []
            for shape in shapes:
                lane = shape.lane
                if lane.junction is not None or not (lane.drivable or lane.type is LaneType.BIKING):
                    continue
                for s in self._arrow_places(shape, spacing, length):
                    xy = shape.at(s, shape.centre)
                    if not self.visible(xy):
                        continue
                    heading = shape.heading_at(s)
                    if length > 4.0:  # wider than a lane: neighbours share an arrow
                        octant = round(heading / (math.pi / 4)) % 8
                        cell = (int(xy[0] // (0.8 * spacing)), int(xy[1] // (0.8 * spacing)), octant)
                        if cell in taken:
                            continue
                        taken.add(cell)
                    places.append(xy)
                    headings.append(heading)
            if places:
                make = _arrows if slim else _darts
                polygons = make(np.array(places), np.array(headings), length, width)
                self.areas("arrows", polygons, level + 0.5, facecolors=INK, linewidths=0)

    @staticmethod
    def _arrow_places(shape: _Shape, spacing: float, length: float) -> Array:
        lane = shape.lane
        low, high = sorted((float(shape.road_s[0]), float(shape.road_s[-1])))
        # Both directions in one place would hide each other.
        phase = 0.25 if shape.road_s[-1] >= shape.road_s[0] else 0.75
        k = np.arange(math.ceil(low / spacing - phase), math.floor(high / spacing - phase) + 1)
        s = np.atleast_1d(lane.s_at_road((k + phase) * spacing))
        s = s[(s > 0.5 * length) & (s < lane.length - 0.5 * length)]
        if not len(s) and lane.length > 1.5 * length:
            s = np.array([0.5 * lane.length])
        return s[lane.width_at(s) > 1.0]

    def connectors(self, faint: bool) -> None:
        """Paths across junctions, coloured by the turn that they serve."""
        turn_of: dict[str, str] = {}
        for movement in self.network.movements:
            for lane in movement.via:
                turn_of[lane] = _TURN_OF[movement.turn]
        width = self.points(0.3, 0.45, 1.6)
        length = max(1.8, 4.5 / self.ppm)
        for level, shapes in self.by_level(self.shapes.values()):
            groups: dict[str, list[_Shape]] = {}
            for shape in shapes:
                if shape.lane.junction is not None and shape.lane.drivable:
                    groups.setdefault(turn_of.get(shape.lane.id, "connector without movement"), []).append(
                        shape
                    )
            for turn, members in groups.items():
                color = _TURNS[turn][0] if turn in _TURNS else "#000000"
                style = {"colors": "#8d93a1" if faint else color, "linewidths": width}
                self.lines("connectors", [m.centre for m in members], level + 0.6, **style)
                if not faint:
                    self.legend[turn] = {"line": color}
                if self.ppm > 1.5 and not faint:
                    # Near the exit, where paths have parted.
                    long = [m for m in members if m.lane.length > 3 * length]
                    places = [m.at(0.8 * m.lane.length, m.centre) for m in long]
                    headings = [m.heading_at(0.8 * m.lane.length) for m in long]
                    if long:
                        darts = _darts(np.array(places), np.array(headings), length, 0.7 * length)
                        self.areas("connectors", darts, level + 0.61, facecolors=color, linewidths=0)
        self._direct_movements(width, faint)

    def _direct_movements(self, width: float, faint: bool) -> None:
        """Movements without a connector, where the lanes that they join do not touch."""
        top = max(self.levels.values(), default=0)
        for name, (color, turns) in _TURNS.items():
            curves = []
            for movement in self.network.movements:
                a, b = self.shapes.get(movement.incoming), self.shapes.get(movement.outgoing)
                if movement.via or movement.turn not in turns or a is None or b is None:
                    continue
                p, q = a.centre[-1], b.centre[0]
                reach = float(np.hypot(*(q - p)))
                if reach > 0.5:
                    tangents = [[math.cos(h), math.sin(h)] for h in (a.heading[-1], b.heading[0])]
                    handles = p + 0.4 * reach * np.array(tangents[0]), q - 0.4 * reach * np.array(tangents[1])
                    t = np.linspace(0, 1, 17)[:, None]
                    curves.append(
                        (1 - t) ** 3 * p
                        + 3 * t * (1 - t) ** 2 * handles[0]
                        + 3 * t**2 * (1 - t) * handles[1]
                        + t**3 * q
                    )
            style = {"colors": "#8d93a1" if faint else color, "linewidths": width, "linestyles": "dashed"}
            self.lines("connectors", curves, top + 0.6, **style)
            if curves and not faint:
                self.legend[name] = {"line": color}

    def crosswalks(self) -> None:
        top = max(self.levels.values(), default=0)
        stripes: list[Array] = []
        outlines: list[Array] = []
        for crosswalk in self.network.crosswalks:
            outline = np.asarray(crosswalk.outline, float)[:, :2]
            if len(outline) < 3 or not any(self.visible(p) for p in outline):
                continue
            outlines.append(outline)
            along = self._walk_direction(crosswalk.spans, outline)
            offsets = outline @ along
            pitch = max(1.0, 2.5 / self.ppm)
            for start in np.arange(offsets.min() + 0.25 * pitch, offsets.max(), pitch):
                bar = _halfplane(_halfplane(outline, -along, -start), along, start + 0.5 * pitch)
                if len(bar) >= 3:
                    stripes.append(bar)
        self.areas("crosswalks", outlines, top + 0.70, facecolors="#7b8490", linewidths=0)
        self.areas("crosswalks", stripes, top + 0.71, facecolors=MARK, linewidths=0)
        if outlines:
            self.legend["crosswalk"] = {"zebra": True}

    def _walk_direction(self, spans: Sequence[tuple[str, float, float]], outline: Array) -> Array:
        """Unit vector along the walk: the axis of the outline that crosses the traffic, else the longer."""
        edges = np.roll(outline, -1, 0) - outline
        longest = edges[np.argmax(np.hypot(*edges.T))]
        axis = longest / np.hypot(*longest)
        axes = np.array([axis, [-axis[1], axis[0]]])
        lanes = [(self.network.lanes.get(lane), 0.5 * (a + b)) for lane, a, b in spans]
        headings = [np.interp(s, lane.s, lane.heading) for lane, s in lanes if lane is not None]
        if not headings:
            return axis
        across = np.stack([-np.sin(headings), np.cos(headings)], -1)
        return axes[np.argmax(np.abs(across @ axes.T).sum(0))]

    def stops(self) -> None:
        """Stop lines of the file, and the ends of lanes that lights or signs hold."""
        top = max(self.levels.values(), default=0)
        width = self.points(0.5, 1.3, 3.5)
        bars = [bar for line in self.network.stop_lines if (bar := self.spot(line.spot)) is not None]
        self.lines("stop_lines", bars, top + 0.74, colors=RED, linewidths=width)
        if width > 2.0:
            self.lines("stop_lines", bars, top + 0.75, colors=MARK, linewidths=0.45 * width)
        if bars:
            self.legend["stop line"] = {"line": RED, "inner": MARK if width > 2.0 else None, "width": 3.0}
        placed = {line.spot.lane for line in self.network.stop_lines}
        placed |= {spot.lane for light in self.network.traffic_lights for spot in light.spots}
        placed |= {spot.lane for sign in self.network.signs for spot in sign.spots}
        # Many files put the heads on the connectors, just behind the lane that they hold.
        placed |= {m.incoming for m in self.network.movements if placed.intersection(m.via)}
        controls: dict[str, set[Control]] = {}
        for movement in self.network.movements:
            controls.setdefault(movement.incoming, set()).add(movement.control)
        for label, control, color in (
            ("held by signals", {Control.SIGNAL}, RED),
            ("has to stop", {Control.STOP, Control.ALL_WAY_STOP}, "#7b2d8b"),
            ("yields", {Control.YIELD}, "#0b5fa5"),
        ):
            ends = []
            for lane, of_lane in controls.items():
                if lane in self.shapes and lane not in placed and of_lane <= control:
                    bar = self.spot(LaneSpot(lane=lane, s=self.network.lanes[lane].length), 0.8)
                    ends.append(bar)
            self.lines("stop_lines", ends, top + 0.73, colors=color, linewidths=0.8 * width)
            if ends:
                self.legend[label] = {"line": color, "width": 2.5}

    def lights(self) -> None:
        """Lights with a tick along the traffic that looks at them, and the lanes that they govern."""
        top = max(self.levels.values(), default=0)
        size = self.points(1.4, 3.2, 8.0)
        links, bars, ticks, dots = [], [], [], []
        for light in self.network.traffic_lights:
            here = np.array(light.position[:2])
            for spot in light.spots:
                bar = self.spot(spot, 0.8)
                if bar is not None:
                    bars.append(bar)
                    links.append(np.stack([here, bar.mean(0)]))
            if self.visible(here):
                dots.append(here)
                tick = np.array([math.cos(light.heading), math.sin(light.heading)])
                ticks.append(np.stack([here, here + 1.5 * size / self.ppm * tick]))
        self.lines("lights", links, top + 0.76, colors=INK, linewidths=0.4, alpha=0.55)
        self.lines("lights", bars, top + 0.77, colors=RED, linewidths=self.points(0.25, 0.8, 1.6))
        self.lines("lights", ticks, top + 0.80, colors=INK, linewidths=max(0.6, 0.16 * size))
        if dots:
            style = {"marker": "o", "facecolor": "#ffcf33", "edgecolor": "black"}
            self.scatter("lights", dots, size, top + 0.81, **style)
            self.legend["traffic light"] = {"marker": style}

    def signs(self) -> None:
        top = max(self.levels.values(), default=0)
        size = self.points(2.8, 3.0, 11.0)
        styles: dict[SignKind, tuple[str, dict[str, Any]]] = {
            SignKind.OTHER: (
                "other sign",
                {"marker": "s", "facecolor": "#c9ced6", "edgecolor": EDGE},
            ),
            SignKind.SPEED: (
                "speed limit, km/h",
                {"marker": "o", "facecolor": "white", "edgecolor": RED},
            ),
            SignKind.PRIORITY: (
                "priority sign",
                {"marker": "D", "facecolor": "#ffcf33", "edgecolor": INK},
            ),
            SignKind.YIELD: ("yield sign", {"marker": "v", "facecolor": "white", "edgecolor": RED}),
            SignKind.STOP: ("stop sign", {"marker": "8", "facecolor": RED, "edgecolor": "white"}),
        }
        for kind, (label, style) in styles.items():
            signs = [s for s in self.network.signs if s.kind is kind and self.visible(s.position)]
            if not signs:
                continue
            own = 0.6 * size if kind is SignKind.OTHER else size
            edge = max(0.5, 0.14 * size)
            self.scatter("signs", [s.position[:2] for s in signs], own, top + 0.82, linewidths=edge, **style)
            self.legend[label] = {"marker": style}
            if kind is SignKind.SPEED and size > 5.5:
                for sign in signs:
                    if sign.value is not None:
                        text = f"{sign.value * 3.6:.0f}"
                        self.text("signs", sign.position[:2], text, top + 0.83, fontsize=0.5 * size)

    def conflicts(self, zones: _Zones) -> None:
        """Stretches where paths cross, merge or part, as bands along them."""
        top = max(self.levels.values(), default=0)
        for order, (kind, color) in enumerate(_CONFLICTS.items()):
            bands = [
                shape.stretch(s_in, s_out, 0.5)
                for lane, s_in, s_out in zones[kind]
                if (shape := self.shapes.get(lane)) is not None
            ]
            zorder = top + 0.57 + 0.01 * order
            self.areas("conflicts", bands, zorder, facecolors=color, alpha=0.6, linewidths=0)
            if bands:
                self.legend[f"conflict: {kind}"] = {"area": color, "alpha": 0.6}

    def labels(self) -> None:
        """Ids of roads along them and of junctions on them, each where it finds room."""
        top = max(self.levels.values(), default=0)
        size = 7.0
        placed: list[Bounds] = []

        def room(xy: Any, text: str) -> bool:
            half_x, half_y = 0.32 * size * len(text) / self.ppm, 0.6 * size / self.ppm
            box = (xy[0] - half_x, xy[1] - half_y, xy[0] + half_x, xy[1] + half_y)
            if any(box[0] < b[2] and b[0] < box[2] and box[1] < b[3] and b[1] < box[3] for b in placed):
                return False
            placed.append(box)
            return True

        for junction in self.network.junctions.values():
            members = [self.shapes[c].centre.mean(0) for c in junction.connectors if c in self.shapes]
            xy = np.mean(members, 0) if members else np.array(junction.center)
            if self.visible(xy) and room(xy, junction.id):
                self.text(
                    "labels", xy, junction.id, top + 0.91, fontsize=size + 1, color="#5b3a9b", weight="bold"
                )
        longest: dict[str, _Shape] = {}
        for shape in self.shapes.values():
            best = longest.get(shape.lane.road)
            key = (shape.lane.drivable, shape.lane.length)
            if best is None or key > (best.lane.drivable, best.lane.length):
                longest[shape.lane.road] = shape
        # Roads outside junctions first, then the longer ones: they get the room.
        order = sorted(
            longest.items(), key=lambda item: (item[1].lane.junction is not None, -item[1].lane.length)
        )
        for road, shape in order:
            seen = [i for i, p in enumerate(shape.centre) if self.visible(p)]
            s = 0.5 * (shape.s[seen[0]] + shape.s[seen[-1]]) if len(seen) > 1 else 0.5 * shape.lane.length
            xy = shape.at(s, shape.centre)
            if self.visible(xy) and room(xy, road):
                angle = math.degrees(shape.heading_at(s)) % 180
                angle -= 180 if angle > 90 else 0
                self.text("labels", xy, road, top + 0.90, fontsize=size, rotation=angle)

    def text(self, layer: str, xy: Any, text: str, zorder: float, **style: Any) -> None:
        from matplotlib.patheffects import withStroke

        style = {"ha": "center", "va": "center_baseline", "color": INK, "clip_on": True, **style}
        artist = self.ax.text(float(xy[0]), float(xy[1]), text, **style)
        artist.set_path_effects([withStroke(linewidth=1.6, foreground="white")])
        self.keep(layer, artist, zorder)

    def scatter(self, layer: str, places: Sequence[Any], size: float, zorder: float, **style: Any) -> None:
        """Markers of one size (points) that do not scale with the map."""
        xy = np.asarray(places, float)
        style = {"linewidths": 0.12 * size, **style}
        self.keep(layer, self.ax.scatter(xy[:, 0], xy[:, 1], s=size**2, **style), zorder)


def _prepare(network: Network) -> tuple[dict[str, _Shape], dict[str, int]]:
    if not network.lanes:
        raise MapError("nothing to draw: the map has no lanes", file=network.source)
    shapes = {id_: _shape(lane) for id_, lane in network.lanes.items()}
    return shapes, _levels(shapes.values())


def draw_network(
    ax: Axes,
    network: Network,
    *,
    conflicts: bool = False,
    labels: bool = False,
    bounds: Bounds | None = None,
) -> dict[str, list[Artist]]:
    """Draw a network on given axes: the base layer for maps, traffic and animations.

    Sets limits and an equal aspect. Sizes that stand for no length on the road (marks, arrows, lights)
    fit the scale that the axes have now, so place and size the axes first. A camera that moves at that
    scale only has to change the limits: without `bounds` the whole map is on the axes.

    Args:
        ax: axes to draw on; x and y are metres.
        network: the map.
        conflicts: shade the conflict stretches of connectors by type.
        labels: write road and junction ids.
        bounds: x_min, y_min, x_max, y_max of the view, m; the whole map if not given.

    Returns:
        The artists by layer (`surfaces`, `marks`, `arrows`, `connectors`, `conflicts`, `crosswalks`,
        `stop_lines`, `lights`, `signs`, `labels`), all below `TRAFFIC_ZORDER`. `surfaces` has one
        polygon per visible lane.

    Raises:
        MapError: the map has no lanes, or `bounds` are not a rectangle that shows any.
    """
    shapes, levels = _prepare(network)
    view = _view(network, shapes, bounds)
    painter = _Painter(ax, network, shapes, levels, view)
    painter.paint(zones=_zones(network) if conflicts else None, labels=labels)
    return painter.layers


def _view(network: Network, shapes: dict[str, _Shape], bounds: Bounds | None) -> Bounds:
    """The rectangle to show: the one asked for, or all lanes and signs with a margin."""
    if bounds is not None:
        x0, y0, x1, y1 = bounds
        if not (np.isfinite(bounds).all() and x0 < x1 and y0 < y1):
            raise MapError(f"bounds {bounds} are not x_min, y_min, x_max, y_max", file=network.source)
        if not any(shape.meets(bounds) for shape in shapes.values()):
            whole = ", ".join(f"{v:.0f}" for v in network.bounds())
            raise MapError(f"bounds {bounds} show no lane; the map covers {whole}", file=network.source)
        return bounds
    xy = np.concatenate([shape.polygon for shape in shapes.values()])
    things = (*network.traffic_lights, *network.signs)
    xy = np.concatenate([xy, np.array([thing.position[:2] for thing in things]).reshape(-1, 2)])
    low, high = xy.min(0), xy.max(0)
    margin = 4.0 + 0.03 * float(min(high - low))
    return (
        float(low[0] - margin),
        float(low[1] - margin),
        float(high[0] + margin),
        float(high[1] + margin),
    )


# The page, in inches.
_LEGEND = 2.35
_MARGINS = (0.75, 0.55, 0.95)  # left, bottom, top
_GAP = 0.42  # between strips, for the ticks
_WIDTH, _HEIGHT = 14.0, 11.5  # largest page without `size`
_CLEAR = 0.03  # inches per metre at which a lane and its marks are easy to read


def _strips(
    shapes: dict[str, _Shape], view: Bounds, room: tuple[float, float]
) -> tuple[list[Bounds], bool, float]:
    """Cut a view into strips along its longer side so that the scale on the page is as large as it gets.

    Every strip follows the road: its window moves across to where the lanes are. Strips are only used
    while fewer do not give a clear scale.

    Returns the strips in reading order, whether they lie below each other (else side by side) and the
    scale in inches per metre.
    """
    x0, y0, x1, y1 = view
    wide = x1 - x0 >= y1 - y0
    axis = 0 if wide else 1
    start, long = view[axis], view[axis + 2] - view[axis]
    low, high = view[1 - axis], view[3 - axis]
    along, across = room if wide else room[::-1]
    step = long / 400
    points = np.concatenate(
        [
            shape.at(np.linspace(0, shape.s[-1], 2 + int(shape.s[-1] / step)), border)
            for shape in shapes.values()
            for border in (shape.left, shape.right)
        ]
    )
    margin = min(4.0 + step, 0.5 * (high - low))

    def cut(count: int) -> tuple[list[Bounds], float]:
        edges = np.linspace(start, start + long, count + 1).tolist()
        spans = []
        for a, b in itertools.pairwise(edges):
            inside = (points[:, axis] >= a - step) & (points[:, axis] <= b + step)
            seen = np.clip(points[inside, 1 - axis], low, high)
            spans.append((seen.min() - margin, seen.max() + margin) if seen.size else (low, low))
        short = high - low if count == 1 else max(b - a for a, b in spans)
        windows = [
            (low, high) if count == 1 else ((a + b - short) / 2, (a + b + short) / 2) for a, b in spans
        ]
        scale = min(along / (long / count), max(0.0, across - (count - 1) * _GAP) / (count * short))
        boxes = [
            (a, c, b, d) if wide else (c, a, d, b)
            for (a, b), (c, d) in zip(itertools.pairwise(edges), windows, strict=True)
        ]
        return boxes, scale

    best, scale = cut(1)
    for count in range(2, 15):
        boxes, larger = cut(count)
        short = boxes[0][3 - axis] - boxes[0][1 - axis]
        if scale >= _CLEAR or long / count < 0.8 * short:
            break
        thin = long > 2.5 * (high - low) or short < 0.6 * (high - low)
        if thin and larger > 1.1 * scale:
            best, scale = boxes, larger
    return best, wide, scale


def draw_map(
    network: Network,
    path: str | Path | None = None,
    *,
    conflicts: bool = False,
    labels: bool = False,
    bounds: Bounds | None = None,
    dpi: float = 160.0,
    size: tuple[float, float] | None = None,
) -> Figure:
    """Draw a map on a page: title with counts and the import report, legend, scale bar, axes in metres.

    Lanes keep their true proportions. A long thin map is cut into strips that share one scale. Where
    the scale of the whole map is too small to read its marks, windows below show details.

    Args:
        network: the map.
        path: file to write; `.png`, `.svg` or `.pdf`. Nothing is written without it.
        conflicts: shade the conflict stretches of connectors by type.
        labels: write road and junction ids.
        bounds: x_min, y_min, x_max, y_max of the view, m; the whole map if not given.
        dpi: pixels per inch of a PNG.
        size: width and height of the page in inches; chosen from the map if not given.

    Raises:
        MapError: unknown suffix, file that cannot be written, a map without lanes, or useless `bounds`.
        ModuleNotFoundError: matplotlib is not installed.
    """
    target = None if path is None else _checked_target(path)
    try:
        from matplotlib.figure import Figure
        from matplotlib.ticker import MaxNLocator
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "drawing needs matplotlib, which is not installed: pip install 'limsim-jax[viz]'"
        ) from error

    shapes, levels = _prepare(network)
    view = _view(network, shapes, bounds)
    left, bottom, top = _MARGINS
    page = size or (_WIDTH, _HEIGHT)
    room = (page[0] - left - _LEGEND, page[1] - bottom - top)
    if min(room) < 0.5:
        raise MapError(f"size {page} inches leaves no room for the map", file=network.source)
    strips, stacked, scale = _strips(shapes, view, room)
    wide, tall = strips[0][2] - strips[0][0], strips[0][3] - strips[0][1]
    rows, columns = (len(strips), 1) if stacked else (1, len(strips))
    windows: list[Bounds] = []
    detail = 0.0  # in, side of the windows below the map
    if size is None:
        used = rows * tall * scale + (rows - 1) * _GAP, columns * wide * scale + (columns - 1) * _GAP
        room = (max(7.0, used[1]), max(2.8, used[0]))
        if bounds is None and scale < _CLEAR:
            count = max(2, round(room[0] / 2.8))
            detail = (room[0] - (count - 1) * _GAP) / count
            windows = _details(network, shapes, count, 0.8 * detail / scale)
        lower = detail + bottom if windows else 0.0
        page = (room[0] + left + _LEGEND, room[1] + bottom + top + lower)
    else:
        lower = 0.0

    figure = Figure(figsize=page, dpi=dpi, facecolor="white")
    cell = (room[0] - (columns - 1) * _GAP) / columns, (room[1] - (rows - 1) * _GAP) / rows
    legend: dict[str, dict[str, Any]] = {}
    zones = _zones(network) if conflicts else None

    def panel(place: Bounds, box: Bounds, name: str) -> Axes:
        """Axes at x, y, width, height (inches) that show a box (m)."""
        x, y, width, height = place
        ax = figure.add_axes((x / page[0], y / page[1], width / page[0], height / page[1]))
        painter = _Painter(ax, network, shapes, levels, box, name)
        painter.paint(zones=zones, labels=labels)
        legend.update(painter.legend)
        ax.set_facecolor("#fbfbf9")
        ax.tick_params(labelsize=7, colors=INK, length=2.5)
        ax.ticklabel_format(useOffset=False, style="plain")
        ax.xaxis.set_major_locator(MaxNLocator(max(2, int(width / 0.9))))
        ax.yaxis.set_major_locator(MaxNLocator(max(1, int(height / 0.45))))
        ax.spines[:].set_color("#c5cad1")
        return ax

    overview = []
    for i, strip in enumerate(strips):
        row, column = (i, 0) if stacked else (0, i)
        # Room that a strip does not need shows its surroundings, but never its neighbours.
        alone = len(strips) == 1
        spare_x = max(0.0, cell[0] / scale - wide) / 2 if alone or not stacked else 0.0
        spare_y = max(0.0, cell[1] / scale - tall) / 2 if alone or stacked else 0.0
        box = (strip[0] - spare_x, strip[1] - spare_y, strip[2] + spare_x, strip[3] + spare_y)
        x = left + column * (cell[0] + _GAP)
        y = lower + bottom + (rows - 1 - row) * (cell[1] + _GAP)
        ax = panel((x, y, *cell), box, f"map{i}-")
        if row == rows - 1:
            ax.set_xlabel("x / m", fontsize=8, color=INK)
        if column == 0:
            ax.set_ylabel("y / m", fontsize=8, color=INK)
        overview.append(ax)
    for i, window in enumerate(windows):
        letter = "ABCDEFGH"[i]
        ax = panel((left + i * (detail + _GAP), bottom, detail, detail), window, f"detail{letter}-")
        ax.set_title(letter, fontsize=9, weight="bold", color=INK, loc="left", pad=3)
        for ax in overview:
            _frame(ax, window, letter)

    _title(figure, network, len(strips))
    _legend(figure, legend)
    _scale_bar(figure, scale)
    if target is not None:
        _write(figure, target, dpi)
    return figure


def _details(network: Network, shapes: dict[str, _Shape], count: int, most: float) -> list[Bounds]:
    """Square windows on what a small scale hides: the busiest junctions, then lanes of varying width.

    `most` is the side (m) from which on a window would show no more than the map itself.
    """
    places: list[tuple[Array, float]] = []  # middle and side
    busy = sorted(network.junctions.values(), key=lambda j: -len(j.movements))
    for junction in busy:
        inside = [shapes[c].polygon for c in junction.connectors if shapes[c].lane.drivable]
        if inside:
            low, high = np.concatenate(inside).min(0), np.concatenate(inside).max(0)
            places.append((0.5 * (low + high), float(max(high - low)) + 16.0))
    lanes = [s for s in shapes.values() if s.lane.drivable and s.lane.junction is None]
    lanes.sort(key=lambda shape: -float(np.ptp(shape.lane.width)))
    changing = [shape for shape in lanes if np.ptp(shape.lane.width) > 1.0]
    for shape in changing or lanes[:1]:
        places.append((shape.at(0.5 * shape.lane.length, shape.centre), 80.0))
    windows: list[Bounds] = []
    for (x, y), side in places:
        half = 0.5 * min(max(side, 40.0), 140.0, most)
        window = (float(x - half), float(y - half), float(x + half), float(y + half))
        apart = all(
            window[2] < w[0] or w[2] < window[0] or window[3] < w[1] or w[3] < window[1] for w in windows
        )
        if apart and len(windows) < count:
            windows.append(window)
    return windows


def _frame(ax: Axes, window: Bounds, letter: str) -> None:
    """Mark a detail window on the map where its middle is in view."""
    from matplotlib.patches import Rectangle

    x0, y0, x1, y1 = window
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    if left <= (x0 + x1) / 2 <= right and bottom <= (y0 + y1) / 2 <= top:
        style = {"facecolor": "none", "edgecolor": INK, "linewidth": 0.8, "linestyle": (0, (4, 2))}
        ax.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, zorder=TRAFFIC_ZORDER - 2, **style))
        ax.annotate(
            letter,
            (x0, y1),
            xytext=(-1, 1),
            textcoords="offset points",
            ha="right",
            fontsize=9,
            weight="bold",
            color=INK,
            zorder=TRAFFIC_ZORDER - 1,
            clip_on=True,
        )


def _checked_target(path: str | Path) -> Path:
    target = Path(path)
    if target.suffix.lower() not in SUFFIXES:
        known = ", ".join(SUFFIXES)
        raise MapError(f"cannot draw to '{target.suffix or target.name}': use one of {known}", file=target)
    return target


def _write(figure: Figure, target: Path, dpi: float) -> None:
    from matplotlib import rc_context

    kind = target.suffix.lower().lstrip(".")
    # Fixed ids and no date: the same map gives the same file.
    date = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind, {})
    with rc_context({"svg.hashsalt": "limsim_jax", "svg.fonttype": "none"}):
        try:
            figure.savefig(target, format=kind, dpi=dpi, metadata=date)
        except OSError as error:
            raise MapError(f"cannot write the drawing: {error.strerror or error}", file=target) from error


def _count(things: Sized, noun: str) -> str:
    return f"{len(things)} {noun}{'' if len(things) == 1 else 's'}"


def _title(figure: Figure, network: Network, strips: int) -> None:
    drivable = list(network.drivable_lanes())
    km = sum(lane.length for lane in drivable) / 1000
    own_programs = [p for p in network.programs.values() if not p.generated]
    counts = " · ".join(
        [
            network.format,
            _count(network.roads, "road"),
            _count(network.lanes, "lane"),
            f"{km:.2f} km of driving lanes",
            _count(network.junctions, "junction"),
            _count(network.traffic_lights, "traffic light"),
            *([_count(own_programs, "signal program")] if own_programs else []),
        ]
    )
    if strips > 1:
        counts += f" · {strips} strips, one scale"
    totals = ", ".join(f"{network.report.total(action)} {action.value}" for action in Action)
    width, height = figure.get_size_inches()
    x = _MARGINS[0] / width
    file = Path(network.source).name
    name = network.name if network.name and network.name != file.split(".")[0] else ""
    figure.text(x, 1 - 0.30 / height, f"{file}   {name}".strip(), fontsize=13, weight="bold", color=INK)
    figure.text(x, 1 - 0.53 / height, counts, fontsize=8.5, color=INK)
    figure.text(x, 1 - 0.73 / height, f"import report: {totals}", fontsize=8.5, color=EDGE)


def _legend(figure: Figure, entries: dict[str, dict[str, Any]]) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    order = [
        *_KINDS,
        "junction",
        "crossing allowed",
        "crossing forbidden",
        "between directions",
        *_TURNS,
        "connector without movement",
    ]
    names = [n for n in order if n in entries] + [n for n in entries if n not in order]
    handles: list[Any] = []
    for name in names:
        entry = entries[name]
        if "area" in entry:
            handles.append(
                Patch(facecolor=entry["area"], alpha=entry.get("alpha"), edgecolor="#c5cad1", lw=0.5)
            )
        elif "marker" in entry:
            style = entry["marker"]
            handles.append(
                Line2D(
                    [],
                    [],
                    linestyle="none",
                    marker=style["marker"],
                    markersize=9 if style["marker"] == "8" else 7,
                    markerfacecolor=style["facecolor"],
                    markeredgecolor=style["edgecolor"],
                )
            )
        elif "zebra" in entry:
            handles.append(Patch(facecolor="white", edgecolor="#7b8490", hatch="|||||", lw=0.5))
        elif "on" in entry:
            pavement = Patch(facecolor=entry["on"], edgecolor="none")
            mark = Line2D([], [], color=entry["line"], lw=1.4, linestyle="--" if entry.get("dashed") else "-")
            handles.append((pavement, mark))
        else:
            line = Line2D([], [], color=entry["line"], lw=entry.get("width", 1.6))
            inner = entry.get("inner")
            handles.append((line, Line2D([], [], color=inner, lw=1.2)) if inner else line)
    width, height = figure.get_size_inches()
    figure.legend(
        handles,
        names,
        loc="upper left",
        bbox_to_anchor=((width - _LEGEND + 0.1) / width, 1 - _MARGINS[2] / height + 0.02),
        frameon=False,
        fontsize=8,
        labelcolor=INK,
        borderaxespad=0,
        handlelength=1.8,
        labelspacing=0.45,
    )


def _scale_bar(figure: Figure, scale: float) -> None:
    from matplotlib.lines import Line2D

    most = (_LEGEND - 0.8) / scale  # m that fit above the legend
    unit = 10.0 ** math.floor(math.log10(most))
    metres = max(m for m in (unit, 2 * unit, 5 * unit) if m <= most)
    width, height = figure.get_size_inches()
    x0 = width - _LEGEND + 0.15
    x1, y = x0 + metres * scale, height - 0.62
    for xs, ys in (((x0, x1), (y, y)), ((x0, x0), (y, y + 0.07)), ((x1, x1), (y, y + 0.07))):
        bar = Line2D([x / width for x in xs], [v / height for v in ys], color=INK, lw=1.5)
        figure.add_artist(bar)
    text = f"{metres:g} m" if metres < 1000 else f"{metres / 1000:g} km"
    figure.text(
        (x0 + x1) / 2 / width, (y + 0.05) / height, text, fontsize=8, ha="center", va="bottom", color=INK
    )
