"""`Scenery`: what sensors see of a map. Painted ground, traffic lights, and where roads turn.

The ground is a raster of `Label`s in square tiles; places without a tile are open country. Built on the host
in float64 and padded to size classes. Where roads cross at different heights, the upper one is painted.
"""

from __future__ import annotations

import enum
import itertools
import math
from collections.abc import Iterator, Mapping

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int, UInt8
from numpy.typing import NDArray

from limsim_jax.maps.lane_map import LaneMap, bucket, lane_rows
from limsim_jax.maps.network import LaneType, MapError, Network
from limsim_jax.maps.outline import (
    Outline,
    crosswalk_outline,
    crosswalk_stripes,
    dashes,
    held_ends,
    levels,
    marks,
    outlines,
    surface,
    surface_rank,
)

Floats = NDArray[np.float64]

PIXEL = 0.25
"""Side of a pixel of the ground, m."""

TILE = 64
"""Pixels along the side of a tile, a power of two."""

_BITS = TILE.bit_length() - 1

_LEAST_TILES = 192, 48
"""Columns and rows of the table of tiles at least, 3 km by 768 m: maps of like size share programs."""

MARK_WIDTH = 0.15
"""Lane marks, m (RMS 1993: 0.12 to 0.15); at least a pixel is painted."""

STOP_WIDTH = 0.5
"""Stop lines, m (RMS 1993, Zeichen 294)."""

DASH = {"town": 6.0, "motorway": 12.0}
"""A dash and a gap of lane marks, m: up to and above 70 km/h. Chosen; RMS 1993 has 9 and 18."""

HOLE = 40.0
"""Gaps between the lanes of a junction up to this area are paved, m^2. Chosen: below a small island."""

SLIVER = 1.0
"""Gaps between them that are narrower than twice this are paved as well, m. Chosen."""

LIGHT_AHEAD = 12.2
"""A light stands this far beyond its stop line, m (MUTCD 2009, 4D.14: at least 40 ft)."""

LIGHT_BOTTOM = 4.6
"""Lower edge of a light, m (MUTCD 2009, 4D.15: at least 15 ft above the road)."""

LIGHT_SIZE = (0.2, 0.61, 1.32)
"""Depth, width and height of a light, m: three 12 in lenses with a backplate of 5 in (ITE VTCSH)."""

TURN = math.radians(30)
"""A way across a junction with more bend than this is a turn, rad. Chosen."""

MOST_TILES = 2**15
"""A map with more tiles is refused: 128 MiB."""


class Label(enum.IntEnum):
    """What a pixel of a camera or of the ground shows."""

    SKY = 0
    TERRAIN = 1
    ROAD = 2
    SHOULDER = 3
    SIDEWALK = 4
    CYCLE_LANE = 5
    PARKING = 6
    MEDIAN = 7
    RAIL = 8
    MARK = 9
    CENTRE_LINE = 10
    STOP_LINE = 11
    CROSSWALK = 12
    CAR = 13
    VAN = 14
    TRUCK = 15
    BUS = 16
    MOTORCYCLE = 17
    EMERGENCY = 18
    PEDESTRIAN = 19
    BRAKE_LIGHT = 20
    TURN_SIGNAL = 21
    LIGHT_RED = 22
    LIGHT_YELLOW = 23
    LIGHT_GREEN = 24
    LIGHT_OFF = 25


FIRST_VEHICLE = Label.CAR
"""Labels of vehicles follow in the order of `lane_map.VEHICLE_CLASSES`."""

DRIVABLE = (Label.ROAD, Label.MARK, Label.CENTRE_LINE, Label.STOP_LINE, Label.CROSSWALK)
"""Ground on which motor traffic drives."""

_GROUND = {
    "cycle lane": Label.CYCLE_LANE,
    "sidewalk": Label.SIDEWALK,
    "shoulder, stop lane": Label.SHOULDER,
    "parking": Label.PARKING,
    "median, border, curb": Label.MEDIAN,
    "tram, rail": Label.RAIL,
    "closed or other lane": Label.SHOULDER,
}  # all others are roads


@struct.dataclass(frozen=True, kw_only=True)
class Scenery:
    """What sensors see of a map; positions in map coordinates, m."""

    corner: Float[Array, " 2"]  # m, of tile (0, 0)
    tile: Int[Array, "Y X"]  # row of `paint`; 0: open country
    paint: UInt8[Array, "K P P"]  # `Label` of each pixel: rows along y, columns along x
    light: Float[Array, "M 3"]  # x, y (m) of the middle, heading of the traffic that looks at it (rad)
    light_lane: Int[Array, " M"]  # lane behind the light, whose state it shows; -1: padding
    turn: Int[Array, " L"]  # +1 for lanes that turn left across a junction, -1 right, 0 others
    pixel: float = struct.field(pytree_node=False, default=PIXEL)  # m


def ground(scenery: Scenery, x: Float[Array, "*b"], y: Float[Array, "*b"]) -> UInt8[Array, "*b"]:
    """The `Label` of the ground at places in map coordinates (m)."""
    size = 1 / scenery.pixel
    rows, columns = scenery.tile.shape
    # beyond the raster all is open country, as in its outermost tiles
    i = jnp.clip(jnp.floor((x - scenery.corner[0]) * size), 0, columns * TILE - 1).astype(jnp.int32)
    j = jnp.clip(jnp.floor((y - scenery.corner[1]) * size), 0, rows * TILE - 1).astype(jnp.int32)
    tile = scenery.tile.reshape(-1).at[(j >> _BITS) * columns + (i >> _BITS)].get(mode="promise_in_bounds")
    place = (((tile << _BITS) + (j & (TILE - 1))) << _BITS) + (i & (TILE - 1))
    return scenery.paint.reshape(-1).at[place].get(mode="promise_in_bounds")


def build_scenery(network: Network, lane_map: LaneMap, *, pixel: float = PIXEL) -> Scenery:
    """Paint the ground of a map and place its lights.

    Args:
        network: the map.
        lane_map: its arrays, whose coordinates and signals are used.
        pixel: side of a pixel, m.

    Raises:
        MapError: a map without lanes, or with more ground than `MOST_TILES`.
        ValueError: a pixel that is not above 0.
    """
    if not pixel > 0:
        raise ValueError(f"pixel: {pixel} m; expected more than 0")
    canvas = _Canvas(pixel, np.asarray(lane_map.origin, float), network.source)
    _paint(canvas, network)
    corner, tile, paint = canvas.tiles()
    lights, behind = _lights(network, lane_map)
    count = bucket(len(behind), 16)
    light, light_lane = np.zeros((count, 3), np.float32), np.full(count, -1, np.int32)
    light[: len(behind)], light_lane[: len(behind)] = lights, behind
    return Scenery(
        corner=jnp.asarray(corner, jnp.float32),
        tile=jnp.asarray(tile),
        paint=jnp.asarray(paint),
        light=jnp.asarray(light),
        light_lane=jnp.asarray(light_lane),
        turn=jnp.asarray(_turns(network, lane_map.length.shape[0])),
        pixel=pixel,
    )


# --- the ground --------------------------------------------------------------------------------------


def _paint(canvas: _Canvas, network: Network) -> None:
    """Paint from the lowest storey up: surfaces, marks; then crosswalks and stop lines."""
    shapes = outlines(network)
    storey = levels(shapes.values())
    junctions = {lane: junction for junction, lane in _pavements(network, shapes)}
    order = sorted(shapes.values(), key=lambda shape: storey[shape.lane.id])
    for _, group in itertools.groupby(order, key=lambda shape: storey[shape.lane.id]):
        level = sorted(group, key=lambda shape: surface_rank(shape.lane))
        for shape in level:
            if shape.lane.type is LaneType.NONE:
                continue
            for corners in junctions.pop(shape.lane.id, ()):
                canvas.fill(corners, Label.ROAD)
            canvas.strip(shape.left, shape.right, _GROUND.get(surface(shape.lane), Label.ROAD))
        for mark in marks(network, level):
            if mark.kind == "kerb" or len(mark.border) < 2:
                continue
            label = Label.CENTRE_LINE if mark.kind == "centre" else Label.MARK
            line = mark.line(max(MARK_WIDTH, canvas.pixel))
            lines = [line]
            if mark.kind == "dashed":
                fast = mark.outline.lane.speed_limit > 70 / 3.6
                lines = list(dashes(line, mark.outline.road_s, DASH["motorway" if fast else "town"]))
            for piece in lines:
                canvas.line(piece, MARK_WIDTH, label)
    for crosswalk in network.crosswalks:
        corners = crosswalk_outline(crosswalk)
        if corners is not None:
            canvas.fill(corners, Label.ROAD)
            for stripe in crosswalk_stripes(network, crosswalk):
                canvas.fill(stripe, Label.CROSSWALK)
    for bar, broken in _bars(network, shapes):
        share = np.linspace(0, 1, 12 if broken else 2)[:, None]
        ends = bar[0] + share * (bar[1] - bar[0])
        for k in range(0, len(ends) - 1, 2):
            canvas.line(ends[k : k + 2], STOP_WIDTH, Label.STOP_LINE)


def _pavements(network: Network, shapes: Mapping[str, Outline]) -> Iterator[tuple[list[Floats], str]]:
    """Ground of junctions between their lanes.

    Outlines, each with the lane before which it is painted.
    """
    import shapely

    for junction in network.junctions.values():
        lanes = [shapes[id_] for id_ in junction.connectors if id_ in shapes and shapes[id_].lane.drivable]
        if not lanes:
            continue
        first = min(lanes, key=lambda shape: float(shape.lane.xyz[:, 2].mean())).lane.id
        if len(junction.outline) >= 3:
            yield [np.asarray(junction.outline, float)], first
            continue
        # Lanes cover the paved area but for slivers between their paths.
        whole = shapely.union_all([shapely.make_valid(shapely.Polygon(shape.polygon)) for shape in lanes])
        parts = [part for part in shapely.get_parts(whole) if part.geom_type == "Polygon"]
        rings = [ring.coords for part in parts for ring in part.interiors]
        holes = [np.asarray(ring) for ring in rings if shapely.Polygon(ring).area <= HOLE]
        closed = whole.buffer(SLIVER, join_style="mitre").buffer(-SLIVER, join_style="mitre")
        slivers = shapely.get_parts(closed.difference(whole))
        found = [np.asarray(x.exterior.coords) for x in slivers if x.geom_type == "Polygon" and x.area > 0]
        yield holes + found, first


def _bars(network: Network, shapes: Mapping[str, Outline]) -> Iterator[tuple[Floats, bool]]:
    """Lines `[2, 2]` where traffic stops, and whether they are broken.

    They are where it yields.
    """
    marked = {line.spot.lane for line in network.stop_lines}
    for line in network.stop_lines:
        if line.spot.lane in shapes:
            yield shapes[line.spot.lane].bar(line.spot.s, 0.95), False
    for lane, held in held_ends(network, marked):
        yield shapes[lane].bar(network.lanes[lane].length, 0.95), held == "yield"


class _Canvas:
    """Tiles of labels that grow where something is painted.

    A pixel is painted if its middle is inside, by the nonzero winding rule.
    """

    def __init__(self, pixel: float, origin: Floats, source: str) -> None:
        self.pixel, self.origin, self.source = pixel, origin, source
        self.painted: dict[tuple[int, int], NDArray[np.uint8]] = {}

    def fill(self, corners: Floats, label: Label) -> None:
        """Paint a polygon `[K, 2]` in file coordinates, m; without an area nothing."""
        if len(corners) < 3:
            return
        p = (corners - self.origin) / self.pixel - 0.5  # middles of pixels are whole numbers
        i0, j0 = np.ceil(p.min(0)).astype(int)
        i1, j1 = np.floor(p.max(0)).astype(int) + 1
        if i1 <= i0 or j1 <= j0:
            return
        q = np.roll(p, -1, 0)
        low, high = np.ceil(np.minimum(p[:, 1], q[:, 1])), np.ceil(np.maximum(p[:, 1], q[:, 1]))
        count = (high - low).astype(int)  # rows that an edge crosses
        edge = np.repeat(np.arange(len(p)), count)
        row = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count) + low[edge].astype(int)
        way = q[edge] - p[edge]
        at = p[edge, 0] + (row - p[edge, 1]) / way[:, 1] * way[:, 0]
        column = np.clip(np.ceil(at).astype(int), i0, i1)
        winding = np.zeros((j1 - j0, i1 - i0 + 1), np.int32)
        np.add.at(winding, (row - j0, column - i0), np.sign(way[:, 1]).astype(np.int32))
        inside = np.cumsum(winding, 1)[:, :-1] != 0
        for ty in range(j0 // TILE, (j1 - 1) // TILE + 1):
            for tx in range(i0 // TILE, (i1 - 1) // TILE + 1):
                x, y = tx * TILE, ty * TILE
                part = inside[max(y - j0, 0) : y + TILE - j0, max(x - i0, 0) : x + TILE - i0]
                if part.any():
                    r, c = max(j0 - y, 0), max(i0 - x, 0)
                    self._tile(tx, ty)[r : r + part.shape[0], c : c + part.shape[1]][part] = label

    def strip(self, left: Floats, right: Floats, label: Label) -> None:
        """Paint between two borders `[M, 2]`, in pieces smaller than a tile."""
        length = np.append(0, np.cumsum(np.hypot(*np.diff(left, axis=0).T)))
        if not length[-1] > 0:
            length = np.append(0, np.cumsum(np.hypot(*np.diff(right, axis=0).T)))
        pieces = max(1, math.ceil(length[-1] / (TILE * self.pixel)))
        at = np.union1d(length, np.linspace(0, length[-1], pieces + 1))
        sides = [np.stack([np.interp(at, length, x[:, k]) for k in (0, 1)], -1) for x in (left, right)]
        cuts = np.unique(np.searchsorted(at, np.linspace(0, length[-1], pieces + 1)))
        for a, b in itertools.pairwise(np.minimum(cuts, len(at) - 1)):
            self.fill(np.concatenate([sides[0][a : b + 1], sides[1][a : b + 1][::-1]]), label)

    def line(self, line: Floats, width: float, label: Label) -> None:
        """Paint a line `[M, 2]` of a width (m)."""
        way = np.gradient(line, axis=0) if len(line) > 2 else np.diff(line, axis=0).repeat(2, 0)
        long = np.hypot(way[:, 0], way[:, 1])
        if not (long > 0).all():
            return
        across = max(width, self.pixel) / 2 * np.stack([-way[:, 1], way[:, 0]], -1) / long[:, None]
        self.strip(line + across, line - across, label)

    def _tile(self, x: int, y: int) -> NDArray[np.uint8]:
        tile = self.painted.get((x, y))
        if tile is None:
            if len(self.painted) >= MOST_TILES:
                raise MapError(
                    f"more than {MOST_TILES} tiles of ground; use a pixel above {self.pixel:g} m",
                    file=self.source,
                )
            tile = self.painted[x, y] = np.full((TILE, TILE), Label.TERRAIN, np.uint8)
        return tile

    def tiles(self) -> tuple[Floats, NDArray[np.int32], NDArray[np.uint8]]:
        """Corner (m, map coordinates), table and pool of tiles.

        The outermost rows and columns of the table are open country.
        """
        where = np.array(list(self.painted)).reshape(-1, 2)
        low = where.min(0) - 1
        size = zip(where.max(0) + 2 - low, _LEAST_TILES, strict=True)
        columns, rows = (bucket(int(n), least) for n, least in size)
        table = np.zeros((rows, columns), np.int32)
        table[where[:, 1] - low[1], where[:, 0] - low[0]] = np.arange(1, len(where) + 1)
        paint = np.full((bucket(len(where) + 1, 256), TILE, TILE), Label.TERRAIN, np.uint8)
        paint[1 : len(where) + 1] = list(self.painted.values())
        return low * (TILE * self.pixel), table, paint


# --- lights and turns --------------------------------------------------------------------------------


def _lights(network: Network, lane_map: LaneMap) -> tuple[Floats, list[int]]:
    """Lights `[M, 3]` in map coordinates, and the lane behind each.

    Ways out of one lane share a light if it shows the same to all of them at any time. Several lights of a
    lane hang side by side, the leftmost for the leftmost way.
    """
    rows = lane_rows(network)
    signals = lane_map.signals
    program, link = np.asarray(signals.lane_program), np.asarray(signals.lane_link)
    state, stop_s = np.asarray(signals.state), np.asarray(lane_map.stop_s)
    lights, behind = [], []
    for name, row in rows.items():
        lane = network.lanes[name]
        after = [x for x in lane.successors if x in rows and program[rows[x]] >= 0]
        if not after:
            continue
        xyz, heading = lane.pose(float(stop_s[row]))
        ahead = np.array([math.cos(heading), math.sin(heading)])
        left = np.array([-ahead[1], ahead[0]])
        ways = [network.lanes[other].xyz[-1, :2] - xyz[:2] for other in after]
        groups: dict[bytes, int] = {}
        for k in np.argsort([-math.atan2(way @ left, way @ ahead) for way in ways]):
            other = rows[after[k]]
            groups.setdefault(
                state[program[other], :, link[other]].tobytes() + bytes([program[other] % 256]), other
            )
        for k, other in enumerate(groups.values()):
            beside = ((len(groups) - 1) / 2 - k) * 2 * LIGHT_SIZE[1]
            x, y = xyz[:2] + LIGHT_AHEAD * ahead + beside * left - np.asarray(lane_map.origin, float)
            lights.append((x, y, float(heading)))
            behind.append(other)
    return np.array(lights).reshape(-1, 3), behind


def _turns(network: Network, lanes: int) -> NDArray[np.int32]:
    """Which way each lane turns across its junction: +1 left, -1 right, 0 neither."""
    rows = lane_rows(network)
    turn = np.zeros(lanes, np.int32)
    for movement in network.movements:
        via = [network.lanes[name] for name in movement.via if name in rows]
        bend = sum(float(lane.heading[-1] - lane.heading[0]) for lane in via)
        if abs(bend) > TURN:
            turn[[rows[lane.id] for lane in via]] = 1 if bend > 0 else -1
    return turn
