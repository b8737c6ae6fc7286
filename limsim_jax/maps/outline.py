"""What a drawing of a map shows: outlines, surfaces, marks, stop bars.

Pictures, videos and the interactive viewer stand on this module. It runs on the host in float64, in the
coordinates of the file, and draws nothing itself.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps.network import (
    DRIVABLE,
    Array,
    Control,
    Crosswalk,
    Lane,
    LaneType,
    MapError,
    Network,
)

if TYPE_CHECKING:
    from limsim_jax.maps.lane_map import LaneMap

Bounds = tuple[float, float, float, float]
"""x_min, y_min, x_max, y_max, m."""


class Surface(NamedTuple):
    """A kind of surface: its colour and the lane types that it covers."""

    color: str
    types: tuple[LaneType, ...]


# Hues after Okabe and Ito (2008), which the common colour deficiencies keep apart; areas in pale tints.
SURFACES: dict[str, Surface] = {
    "driving lane": Surface("#b3bac4", (LaneType.DRIVING, LaneType.SHARED, LaneType.SLIP_LANE)),
    "entry, exit, ramp": Surface(
        "#93a9c4",
        (
            LaneType.ENTRY,
            LaneType.EXIT,
            LaneType.ON_RAMP,
            LaneType.OFF_RAMP,
            LaneType.CONNECTING_RAMP,
        ),
    ),
    "bus, taxi, HOV lane": Surface("#dba58a", (LaneType.BUS, LaneType.TAXI, LaneType.HOV)),
    "bidirectional lane": Surface("#e0d27c", (LaneType.BIDIRECTIONAL,)),
    "cycle lane": Surface("#8fcfb6", (LaneType.BIKING,)),
    "sidewalk": Surface("#ebe3d3", (LaneType.SIDEWALK, LaneType.WALKING)),
    "shoulder, stop lane": Surface("#dde1e6", (LaneType.SHOULDER, LaneType.STOP)),
    "parking": Surface("#b5d8ee", (LaneType.PARKING,)),
    "median, border, curb": Surface("#d6e0c6", (LaneType.MEDIAN, LaneType.BORDER, LaneType.CURB)),
    "tram, rail": Surface("#d8b7cf", (LaneType.TRAM, LaneType.RAIL)),
    "closed or other lane": Surface(
        "#f1f1f1",
        (LaneType.RESTRICTED, LaneType.ROAD_WORKS, LaneType.SPECIAL, LaneType.NONE),
    ),
    "junction": Surface("#d3cde6", ()),  # drivable connectors of any type
}
"""Kinds of surface by name, in the order of legends."""

_SURFACE_OF = {type_: name for name, (_, types) in SURFACES.items() for type_ in types}
_TRAFFIC = DRIVABLE | {LaneType.BIDIRECTIONAL}

MarkKind = Literal["kerb", "edge", "solid", "dashed", "centre"]
Zones = dict[str, list[tuple[str, float, float]]]
"""Kind of conflict to its stretches: lane id, start and end (m)."""


@dataclass(frozen=True, eq=False)
class Outline:
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
        """Corners of the surface `[2 M, 2]`, m."""
        return np.concatenate([self.left, self.right[::-1]])

    def meets(self, bounds: Bounds) -> bool:
        """Whether the bounding box of the lane meets `bounds`."""
        low = np.minimum(self.left.min(0), self.right.min(0))
        high = np.maximum(self.left.max(0), self.right.max(0))
        return bool(
            low[0] <= bounds[2] and high[0] >= bounds[0] and low[1] <= bounds[3] and high[1] >= bounds[1]
        )

    def at(self, s: Any, border: Array) -> Array:
        """Points `[..., 2]` of a border or the centre.

        Args:
            s: arc length, m, clipped to the lane.
            border: `centre`, `left` or `right` of this outline.
        """
        return np.stack([np.interp(s, self.s, border[:, 0]), np.interp(s, self.s, border[:, 1])], -1)

    def heading_at(self, s: float) -> float:
        """Direction of travel (rad) at arc length `s` (m, clipped)."""
        return float(np.interp(s, self.s, self.heading))

    def stretch(self, s_in: float, s_out: float, share: float) -> Array:
        """Corners `[K, 2]` of the surface between two arc lengths (m).

        `share` of the width is kept, in the middle.
        """
        inside = self.s[(self.s > s_in) & (self.s < s_out)]
        s = np.concatenate([[s_in], inside, [s_out]])
        centre = self.at(s, self.centre)
        left, right = (centre + share * (self.at(s, side) - centre) for side in (self.left, self.right))
        return np.concatenate([left, right[::-1]])

    def bar(self, s: float, share: float = 1.0) -> Array:
        """A line `[2, 2]` across the lane at arc length `s` (m).

        It covers a share of the width, in the middle.
        """
        middle = self.at(s, self.centre)
        return middle + share * (np.stack([self.at(s, self.left), self.at(s, self.right)]) - middle)


def outline(lane: Lane) -> Outline:
    """The outline of one lane, with samples at most 3 degrees apart."""
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
    return Outline(lane, s, road_s, heading, centre, centre + half, centre - half)


@functools.lru_cache(maxsize=2)
def outlines(network: Network) -> Mapping[str, Outline]:
    """Outlines of all lanes by lane id; those of the last networks are kept, for a report draws one often.

    Raises `MapError` if the map has no lanes.
    """
    if not network.lanes:
        raise MapError("nothing to draw: the map has no lanes", file=network.source)
    return {id_: outline(lane) for id_, lane in network.lanes.items()}


def levels(shapes: Iterable[Outline]) -> dict[str, int]:
    """Storey of each lane by its mean height.

    Drawn storey by storey, a bridge hides the road below it.
    """
    height = {shape.lane.id: float(shape.lane.xyz[:, 2].mean()) for shape in shapes}
    low, high = min(height.values()), max(height.values())
    storey = max(3.0, (high - low) / 12)  # m, below the clearance of any bridge for cars unless steep
    return {lane: int((z - low) / storey) for lane, z in height.items()}


def surface(lane: Lane) -> str:
    """Name of the lane's kind of surface, a key of `SURFACES`."""
    if lane.drivable and lane.junction is not None:
        return "junction"
    if lane.type in DRIVABLE and not lane.drivable:
        return "closed or other lane"
    return _SURFACE_OF[lane.type]


def surface_rank(lane: Lane) -> tuple[bool, bool, bool]:
    """Key that sorts the surfaces of one storey from the bottom up."""
    return lane.drivable, lane.junction is None, lane.type is not LaneType.NONE


def view(network: Network, shapes: Mapping[str, Outline], bounds: Bounds | None) -> Bounds:
    """The rectangle to show: `bounds`, or all lanes, lights and signs with a margin.

    Raises `MapError` if `bounds` are no rectangle, or show no lane.
    """
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


# --- marks -------------------------------------------------------------------------------------------


class Mark(NamedTuple):
    """A line along a border of a lane outside junctions.

    `solid` forbids crossing and `dashed` allows it, `centre` parts the directions, `edge` bounds the
    carriageway, `kerb` bounds everything else.
    """

    kind: MarkKind
    outline: Outline
    side: int  # 0 left, 1 right
    shift: int  # -1 and 1: the line of a double mark inside and outside the border; 0: the only line

    @property
    def border(self) -> Array:
        """The border `[M, 2]`, m."""
        return self.outline.right if self.side else self.outline.left

    def line(self, gap: float) -> Array:
        """The line `[M, 2]`; a line of a double mark is `gap` m off the border."""
        if not self.shift:
            return self.border
        heading = self.outline.heading
        outward = np.stack([-np.sin(heading), np.cos(heading)], -1)
        outward = gap * (-outward if self.side else outward)
        return self.border + self.shift * outward


def marks(network: Network, shapes: Iterable[Outline]) -> Iterator[Mark]:
    """The marks of these lanes; a border that two of them share is marked once."""
    done: set[frozenset[str]] = set()
    # Lanes with traffic first: the border that they share with others is theirs.
    for shape in sorted(shapes, key=lambda shape: not shape.lane.drivable):
        lane = shape.lane
        if lane.junction is not None:
            continue
        road = network.roads.get(lane.road)
        towards_oncoming = 1 if road is not None and road.left_hand else 0
        for side, neighbour in enumerate((lane.left, lane.right)):
            oncoming = lane.opposite if side == towards_oncoming else None
            other = neighbour or oncoming
            if other is not None:
                pair = frozenset((lane.id, other))
                if pair in done:
                    continue
                done.add(pair)
            for kind, shift in _mark_lines(network, lane, side, neighbour, oncoming):
                yield Mark(kind, shape, side, shift)


def _mark_lines(
    network: Network, lane: Lane, side: int, neighbour: str | None, oncoming: str | None
) -> list[tuple[MarkKind, int]]:
    """Kind and shift of the lines on one border."""
    lanes = network.lanes
    if not lane.drivable:
        return [("kerb", 0)]
    if neighbour in lanes and lanes[neighbour].drivable:
        other = lanes[neighbour]
        may_leave = (lane.may_change_left, lane.may_change_right)[side]
        may_enter = (other.may_change_right, other.may_change_left)[side]
        if may_leave == may_enter:
            return [("dashed" if may_leave else "solid", 0)]
        # The line next to a lane is the one that binds its traffic.
        return [("dashed" if may_leave else "solid", -1), ("dashed" if may_enter else "solid", 1)]
    if oncoming in lanes and lanes[oncoming].type in _TRAFFIC:
        return [("centre", 0)]
    return [("edge", 0)]


def dashes(line: Array, road_s: Array, period: float) -> Array:
    """Segments `[K, 2, 2]` of a dashed line: the painted half of each period.

    Args:
        line: points `[M, 2]`, m.
        road_s: reference-line distance of each point `[M]`, m; dashes of lanes side by side are level.
        period: a dash and a gap, m.
    """
    if road_s[-1] < road_s[0]:
        line, road_s = line[::-1], road_s[::-1]
    half = period / 2
    first, last = math.ceil(road_s[0] / half), math.floor(road_s[-1] / half)
    u = np.union1d(road_s, np.arange(first, last + 1) * half)
    xy = np.stack([np.interp(u, road_s, line[:, 0]), np.interp(u, road_s, line[:, 1])], -1)
    painted = np.floor(0.5 * (u[:-1] + u[1:]) / half) % 2 == 0
    return np.stack([xy[:-1], xy[1:]], 1)[painted]


# --- bars and stripes --------------------------------------------------------------------------------

Held = Literal["signal", "stop", "yield"]
_HELD: dict[Held, frozenset[Control]] = {
    "signal": frozenset({Control.SIGNAL}),
    "stop": frozenset({Control.STOP, Control.ALL_WAY_STOP}),
    "yield": frozenset({Control.YIELD}),
}


def held_ends(network: Network, marked: Collection[str]) -> list[tuple[str, Held]]:
    """Ids of lanes that end at a control, and its kind.

    Every movement out of such a lane has the same kind. Lanes in `marked` are left out.
    """
    controls: dict[str, set[Control]] = {}
    for movement in network.movements:
        controls.setdefault(movement.incoming, set()).add(movement.control)
    return [
        (lane, held)
        for lane, found in controls.items()
        for held, kinds in _HELD.items()
        if lane not in marked and found <= kinds
    ]


def signal_bars(network: Network, lane_map: LaneMap) -> tuple[NDArray[Any], NDArray[Any]]:
    """Bars at stop lines that show traffic lights.

    There is one bar for each lane behind the stop line that has a light. Several of them share the width
    of the lane from left to right.

    Returns:
        Bars `[B, 2, 2]` in file coordinates (m), and the row of the lane behind each `[B]`.
    """
    from limsim_jax.maps.lane_map import lane_rows

    rows = lane_rows(network)
    program, stop_s = np.asarray(lane_map.signals.lane_program), np.asarray(lane_map.stop_s)
    bars, behind = [], []
    for name, row in rows.items():
        lane = network.lanes[name]
        after = [x for x in lane.successors if x in rows and program[rows[x]] >= 0]
        if not after:
            continue
        s = float(stop_s[row])
        xyz, heading = lane.pose(np.array([s]))
        x, y, heading = xyz[0, 0], xyz[0, 1], float(np.asarray(heading).reshape(-1)[0])
        ahead = np.array([math.cos(heading), math.sin(heading)])
        left = np.array([-math.sin(heading), math.cos(heading)])
        ways = [network.lanes[other].xyz[-1, :2] - (x, y) for other in after]
        order = np.argsort([-math.atan2(way @ left, way @ ahead) for way in ways])
        half = 0.45 * float(lane.width_at(s))
        edges = np.linspace(half, -half, len(after) + 1)
        for k, other in enumerate(order):
            bars.append([(x, y) + edges[k] * left, (x, y) + edges[k + 1] * left])
            behind.append(rows[after[other]])
    return np.array(bars).reshape(-1, 2, 2), np.array(behind, int)


def crosswalk_outline(crosswalk: Crosswalk) -> Array | None:
    """Corners `[K, 2]` (m) of a crosswalk; None without an area."""
    corners = np.asarray(crosswalk.outline, float)[:, :2]
    return corners if len(corners) >= 3 else None


def crosswalk_stripes(network: Network, crosswalk: Crosswalk, pitch: float = 1.0) -> list[Array]:
    """The stripes of a crosswalk, one every `pitch` m.

    Each is a polygon `[K, 2]` (m) along the traffic that crosses the walk.
    """
    corners = crosswalk_outline(crosswalk)
    if corners is None:
        return []
    along = _walk_direction(network, crosswalk, corners)
    offsets = corners @ along
    bars = [
        halfplane(halfplane(corners, -along, -start), along, start + 0.5 * pitch)
        for start in np.arange(offsets.min() + 0.25 * pitch, offsets.max(), pitch)
    ]
    return [bar for bar in bars if len(bar) >= 3]


def _walk_direction(network: Network, crosswalk: Crosswalk, corners: Array) -> Array:
    """Unit vector along the walk.

    Of the two axes of the outline it is the one that crosses the traffic; without traffic, the longer one.
    """
    edges = np.roll(corners, -1, 0) - corners
    longest = edges[np.argmax(np.hypot(*edges.T))]
    axis = longest / np.hypot(*longest)
    axes = np.array([axis, [-axis[1], axis[0]]])
    lanes = [(network.lanes.get(lane), 0.5 * (a + b)) for lane, a, b in crosswalk.spans]
    headings = [np.interp(s, lane.s, lane.heading) for lane, s in lanes if lane is not None]
    if not headings:
        return axis
    across = np.stack([-np.sin(headings), np.cos(headings)], -1)
    return axes[np.argmax(np.abs(across @ axes.T).sum(0))]


def halfplane(polygon: Array, normal: Array, offset: float) -> Array:
    """The part of a polygon `[K, 2]` where `normal . p <= offset` (Sutherland and Hodgman 1974)."""
    side = polygon @ normal - offset
    corners: list[Array] = []
    for p, q, a, b in zip(polygon, np.roll(polygon, -1, 0), side, np.roll(side, -1), strict=True):
        if a <= 0:
            corners.append(p)
        if a * b < 0:
            corners.append(p + (q - p) * a / (a - b))
    return np.array(corners).reshape(-1, 2)


# --- conflicts ---------------------------------------------------------------------------------------


def conflict_zones(network: Network) -> Zones:
    """The stretches that `conflicts.build_conflicts` finds, joined per lane and kind.

    Kinds are `diverge`, `merge` and `cross`, in this order.
    """
    from limsim_jax.maps.conflicts import ConflictType, build_conflicts
    from limsim_jax.maps.lane_map import lane_rows

    rows = lane_rows(network)
    ids = list(rows)
    table = build_conflicts(network, rows)
    zones: Zones = {}
    for kind in ("diverge", "merge", "cross"):
        zones[kind] = []
        for k, found in enumerate(np.asarray(table.type) == ConflictType[kind.upper()]):
            spans = zip(table.s_in[k][found].tolist(), table.s_out[k][found].tolist(), strict=True)
            zones[kind].extend((ids[int(table.lane[k])], a, b) for a, b in union(spans))
    return zones


def union(spans: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    """The union of intervals, ascending."""
    joined: list[tuple[float, float]] = []
    for start, end in sorted(spans):
        if joined and start <= joined[-1][1]:
            joined[-1] = (joined[-1][0], max(end, joined[-1][1]))
        else:
            joined.append((start, end))
    return joined
