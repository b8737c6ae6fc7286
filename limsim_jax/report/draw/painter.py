"""Draws a network on axes, layer by layer."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from limsim_jax.maps.network import Array, LaneSpot, LaneType, Network, SignKind, Turn
from limsim_jax.maps.outline import (
    SURFACES,
    Bounds,
    Outline,
    Zones,
    conflict_zones,
    crosswalk_outline,
    crosswalk_stripes,
    dashes,
    held_ends,
    levels,
    marks,
    outlines,
    surface,
    surface_rank,
    view,
)
from limsim_jax.report.draw.symbols import arrows, darts

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

TRAFFIC_ZORDER = 100.0
"""Everything that `draw_network` draws lies below this."""

INK = "#2f3742"
EDGE = "#5d6773"
MARK = "#ffffff"
CENTRE = "#f0b400"
RED = "#c1121f"
TURNS: dict[str, tuple[str, tuple[Turn, ...]]] = {
    "straight": ("#0072b2", (Turn.STRAIGHT,)),
    "left": ("#d55e00", (Turn.LEFT, Turn.SLIGHT_LEFT)),
    "right": ("#007a57", (Turn.RIGHT, Turn.SLIGHT_RIGHT)),
    "u-turn": ("#b0528f", (Turn.U_TURN,)),
}
"""Colours of connectors by turn."""

_TURN_OF = {turn: name for name, (_, turns) in TURNS.items() for turn in turns}
_CONFLICTS = {"diverge": "#56b4e9", "merge": "#e69f00", "cross": "#d55e00"}  # in drawing order
_HELD = {
    "signal": ("held by signals", RED),
    "stop": ("has to stop", "#7b2d8b"),
    "yield": ("yields", "#0b5fa5"),
}
_POINT = 72.0  # points per inch


class Painter:
    """Draws one network on one pair of axes.

    The axes are set to show `bounds` with equal aspect. Every `draw_*` method adds one layer.
    """

    def __init__(
        self,
        ax: Axes,
        network: Network,
        shapes: Mapping[str, Outline],
        storeys: dict[str, int],
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
        self.levels = storeys
        self.ppm = pixels * _POINT / figure.dpi  # scale in points per metre
        self.layers: dict[str, list[Artist]] = {}
        self.legend: dict[str, dict[str, Any]] = {}  # label -> style of its sample

    def paint(self, *, zones: Zones | None, labels: bool) -> None:
        """Draw all layers from the ground up; `zones` and `labels` are optional."""
        self.draw_surfaces()
        self.draw_marks()
        self.draw_arrows()
        self.draw_connectors(faint=zones is not None)
        if zones is not None:
            self.draw_conflicts(zones)
        self.draw_crosswalks()
        self.draw_stops()
        self.draw_lights()
        self.draw_signs()
        if labels:
            self.draw_labels()

    def keep(self, layer: str, artist: Any, zorder: float) -> Any:
        """Register an artist under a layer. Its `gid` names it in SVG files."""
        artist.set_zorder(zorder)
        artist.set_gid(f"{self.name}{layer}-{len(self.layers.setdefault(layer, []))}")
        self.layers[layer].append(artist)
        return artist

    def points(self, metres: float, least: float, most: float) -> float:
        """A length in metres as points, clipped to `least` and `most` (points)."""
        return min(max(metres * self.ppm, least), most)

    def lines(self, layer: str, segments: Sequence[Any] | Array, zorder: float, **style: Any) -> None:
        """Draw polylines `[M, 2]` (m); style as for matplotlib's `LineCollection`."""
        from matplotlib.collections import LineCollection

        if len(segments):
            style = {"capstyle": "butt", **style}
            collection = LineCollection(list(segments), **style)
            self.ax.add_collection(collection, autolim=False)
            self.keep(layer, collection, zorder)

    def areas(self, layer: str, polygons: Sequence[Any] | Array, zorder: float, **style: Any) -> None:
        """Draw polygons `[K, 2]` (m); style as for matplotlib's `PolyCollection`."""
        from matplotlib.collections import PolyCollection

        if len(polygons):
            collection = PolyCollection(list(polygons), **style)
            self.ax.add_collection(collection, autolim=False)
            self.keep(layer, collection, zorder)

    def by_level(self, shapes: Iterable[Outline]) -> Iterator[tuple[int, list[Outline]]]:
        """Storeys from the lowest up, and the outlines on each."""
        groups: dict[int, list[Outline]] = {}
        for shape in shapes:
            groups.setdefault(self.levels[shape.lane.id], []).append(shape)
        yield from sorted(groups.items())

    def visible(self, position: Any) -> bool:
        """Whether a position `[2]` (m) lies within the bounds."""
        x0, y0, x1, y1 = self.bounds
        return x0 <= position[0] <= x1 and y0 <= position[1] <= y1

    def bar(self, spot: LaneSpot, share: float = 1.0) -> Array | None:
        """A bar `[2, 2]` across the lane at a spot; None out of view.

        It covers a share of the width.
        """
        shape = self.shapes.get(spot.lane)
        return None if shape is None else shape.bar(spot.s, share)

    # What is drawn, from the ground up.

    def draw_surfaces(self) -> None:
        """Areas of lanes in the colour of their kind."""
        for level, shapes in self.by_level(self.shapes.values()):
            shapes = sorted(shapes, key=lambda shape: surface_rank(shape.lane))
            colors = []
            for shape in shapes:
                kind = surface(shape.lane)
                colors.append(SURFACES[kind].color)
                self.legend[kind] = {"area": colors[-1]}
            # The hairline in the colour of the face closes the seams between neighbours.
            self.areas(
                "surfaces",
                [shape.polygon for shape in shapes],
                level,
                facecolors=colors,
                edgecolors=colors,
                linewidths=0.3,
            )

    def draw_marks(self) -> None:
        """Borders of lanes outside junctions, see `outline.Mark`."""
        width = self.points(0.15, 0.25, 1.8)
        gap = max(0.12, 0.9 * width / self.ppm)  # m, half the distance of the lines of a double mark
        period = max(6.0, 5.0 / self.ppm)
        road = SURFACES["driving lane"].color
        for level, shapes in self.by_level(self.shapes.values()):
            lines: dict[str, list[Array]] = {
                kind: [] for kind in ("solid", "dashed", "centre", "edge", "kerb")
            }
            for mark in marks(self.network, shapes):
                line = mark.line(gap)
                is_dashed = mark.kind == "dashed"
                lines[mark.kind].extend(dashes(line, mark.outline.road_s, period) if is_dashed else [line])
            self.lines("marks", lines["kerb"], level + 0.20, colors="#b9bfc7", linewidths=0.6 * width)
            self.lines("marks", lines["edge"], level + 0.22, colors=EDGE, linewidths=width)
            # Marks on lanes that are thinner would hide the lanes.
            if 3.5 * self.ppm > 2.0:
                self.lines("marks", lines["solid"], level + 0.24, colors=MARK, linewidths=width)
                self.lines("marks", lines["dashed"], level + 0.24, colors=MARK, linewidths=width)
                if lines["solid"]:
                    self.legend["crossing forbidden"] = {"line": MARK, "on": road}
                if lines["dashed"]:
                    self.legend["crossing allowed"] = {"line": MARK, "on": road, "dashed": True}
            self.lines("marks", lines["centre"], level + 0.26, colors=CENTRE, linewidths=1.2 * width)
            if lines["centre"]:
                self.legend["between directions"] = {"line": CENTRE, "on": road}

    def draw_arrows(self) -> None:
        """Directions of travel, evenly spaced along roads.

        Neighbouring lanes share an arrow where it is wider than a lane.
        """
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
                make = arrows if slim else darts
                polygons = make(np.array(places), np.array(headings), length, width)
                self.areas("arrows", polygons, level + 0.5, facecolors=INK, linewidths=0)

    @staticmethod
    def _arrow_places(shape: Outline, spacing: float, length: float) -> Array:
        lane = shape.lane
        low, high = sorted((float(shape.road_s[0]), float(shape.road_s[-1])))
        # Arrows of both directions in one place would hide each other.
        phase = 0.25 if shape.road_s[-1] >= shape.road_s[0] else 0.75
        k = np.arange(math.ceil(low / spacing - phase), math.floor(high / spacing - phase) + 1)
        s = np.atleast_1d(lane.s_at_road((k + phase) * spacing))
        s = s[(s > 0.5 * length) & (s < lane.length - 0.5 * length)]
        if not len(s) and lane.length > 1.5 * length:
            s = np.array([0.5 * lane.length])
        return s[lane.width_at(s) > 1.0]

    def draw_connectors(self, faint: bool) -> None:
        """Paths across junctions, coloured by turn."""
        turn_of: dict[str, str] = {}
        for movement in self.network.movements:
            for lane in movement.via:
                turn_of[lane] = _TURN_OF[movement.turn]
        width = self.points(0.3, 0.45, 1.6)
        length = max(1.8, 4.5 / self.ppm)
        for level, shapes in self.by_level(self.shapes.values()):
            groups: dict[str, list[Outline]] = {}
            for shape in shapes:
                if shape.lane.junction is not None and shape.lane.drivable:
                    groups.setdefault(turn_of.get(shape.lane.id, "connector without movement"), []).append(
                        shape
                    )
            for turn, members in groups.items():
                color = TURNS[turn][0] if turn in TURNS else "#000000"
                style = {"colors": "#8d93a1" if faint else color, "linewidths": width}
                self.lines("connectors", [m.centre for m in members], level + 0.6, **style)
                if not faint:
                    self.legend[turn] = {"line": color}
                if self.ppm > 1.5 and not faint:
                    # Near the exit, where paths have diverged.
                    long = [m for m in members if m.lane.length > 3 * length]
                    places = [m.at(0.8 * m.lane.length, m.centre) for m in long]
                    headings = [m.heading_at(0.8 * m.lane.length) for m in long]
                    if long:
                        heads = darts(np.array(places), np.array(headings), length, 0.7 * length)
                        self.areas("connectors", heads, level + 0.61, facecolors=color, linewidths=0)
        self._direct_movements(width, faint)

    def _direct_movements(self, width: float, faint: bool) -> None:
        """Movements without a connector, between lanes that do not touch."""
        top = max(self.levels.values(), default=0)
        for name, (color, turns) in TURNS.items():
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

    def draw_crosswalks(self) -> None:
        """Crosswalks with bars along the traffic."""
        top = max(self.levels.values(), default=0)
        stripes: list[Array] = []
        areas: list[Array] = []
        for crosswalk in self.network.crosswalks:
            corners = crosswalk_outline(crosswalk)
            if corners is not None and any(self.visible(p) for p in corners):
                areas.append(corners)
                stripes += crosswalk_stripes(self.network, crosswalk, max(1.0, 2.5 / self.ppm))
        self.areas("crosswalks", areas, top + 0.70, facecolors="#7b8490", linewidths=0)
        self.areas("crosswalks", stripes, top + 0.71, facecolors=MARK, linewidths=0)
        if areas:
            self.legend["crosswalk"] = {"zebra": True}

    def draw_stops(self) -> None:
        """Stop lines, and ends of lanes at lights or signs."""
        network = self.network
        top = max(self.levels.values(), default=0)
        width = self.points(0.5, 1.3, 3.5)
        bars = [bar for line in network.stop_lines if (bar := self.bar(line.spot)) is not None]
        self.lines("stop_lines", bars, top + 0.74, colors=RED, linewidths=width)
        if width > 2.0:
            self.lines("stop_lines", bars, top + 0.75, colors=MARK, linewidths=0.45 * width)
        if bars:
            self.legend["stop line"] = {"line": RED, "inner": MARK if width > 2.0 else None, "width": 3.0}
        marked = {line.spot.lane for line in network.stop_lines}
        marked |= {spot.lane for light in network.traffic_lights for spot in light.spots}
        marked |= {spot.lane for sign in network.signs for spot in sign.spots}
        # Many files put the heads on the connectors, just behind the lane that they hold.
        marked |= {m.incoming for m in network.movements if marked.intersection(m.via)}
        held = [(lane, by) for lane, by in held_ends(network, marked) if lane in self.shapes]
        for kind, (label, color) in _HELD.items():
            ends = [self.shapes[lane].bar(network.lanes[lane].length, 0.8) for lane, by in held if by == kind]
            self.lines("stop_lines", ends, top + 0.73, colors=color, linewidths=0.8 * width)
            if ends:
                self.legend[label] = {"line": color, "width": 2.5}

    def draw_lights(self) -> None:
        """Lights, and links to the lanes that they govern.

        A tick at each light points along the traffic that looks at it.
        """
        top = max(self.levels.values(), default=0)
        size = self.points(1.4, 3.2, 8.0)
        links, bars, ticks, dots = [], [], [], []
        for light in self.network.traffic_lights:
            here = np.array(light.position[:2])
            for spot in light.spots:
                bar = self.bar(spot, 0.8)
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

    def draw_signs(self) -> None:
        """Signs by kind; speed limits with their number, where it can be read."""
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

    def draw_conflicts(self, zones: Zones) -> None:
        """Stretches where paths cross, merge or diverge, as bands along them."""
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

    def draw_labels(self) -> None:
        """Ids of roads and junctions, each where there is room."""
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
        longest: dict[str, Outline] = {}
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
        """Write a text at a position `[2]` (m), with a white rim."""
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


def draw_network(
    ax: Axes,
    network: Network,
    *,
    conflicts: bool = False,
    labels: bool = False,
    bounds: Bounds | None = None,
) -> dict[str, list[Artist]]:
    """Draw a network on given axes: the base layer for maps, traffic and animations.

    Sets limits and an equal aspect. The sizes of symbols (marks, arrows, lights) fit the scale that the
    axes have now, so place and size the axes first. Without `bounds` the whole map is on the axes: a camera
    that moves at this scale only changes the limits.

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
    shapes = outlines(network)
    window = view(network, shapes, bounds)
    painter = Painter(ax, network, shapes, levels(shapes.values()), window)
    painter.paint(zones=conflict_zones(network) if conflicts else None, labels=labels)
    return painter.layers
