"""What a page with a map shows where: strips of long thin maps, and windows on details."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from limsim_jax.maps.network import Array, MapError, Network
from limsim_jax.maps.outline import Bounds, Outline, view

GAP = 0.42
"""Space between strips for the ticks, inches."""

CLEAR = 0.03
"""Scale at which a lane and its marks are easy to read, inches per metre."""

LEGEND = 2.35
"""Width of the legend, inches."""

MARGINS = (0.75, 0.55, 0.95)
"""Left, bottom and top of the page, inches."""

_WIDTH, _HEIGHT = 14.0, 11.5  # inches, largest page without `size`

Panel = tuple[Bounds, Bounds]
"""Place on the page (x, y, width, height, inches) and the box that it shows (m)."""


@dataclass(frozen=True)
class Page:
    """Size (inches), scale (inches per metre) and panels of a page."""

    size: tuple[float, float]
    scale: float
    strips: list[Panel]
    stacked: bool  # strips lie below each other, otherwise side by side
    details: list[Panel]


def plan_page(
    network: Network, shapes: Mapping[str, Outline], bounds: Bounds | None, size: tuple[float, float] | None
) -> Page:
    """Arrange a map on a page.

    `size` is width and height in inches; without it the page fits the map. Windows on details lie below the
    map if `size` and `bounds` are free and the scale is below `CLEAR`.

    Raises `MapError` for `bounds` that are no rectangle or show no lane, and for a `size` without room for
    the map.
    """
    window = view(network, shapes, bounds)
    left, bottom, top = MARGINS
    page = size or (_WIDTH, _HEIGHT)
    room = (page[0] - left - LEGEND, page[1] - bottom - top)
    if min(room) < 0.5:
        raise MapError(f"size {page} inches leaves no room for the map", file=network.source)
    parts, stacked, scale = strips(shapes, window, room)
    wide, tall = parts[0][2] - parts[0][0], parts[0][3] - parts[0][1]
    rows, columns = (len(parts), 1) if stacked else (1, len(parts))
    details: list[Panel] = []
    lower = 0.0  # inches, height of the windows below the map
    if size is None:
        used = rows * tall * scale + (rows - 1) * GAP, columns * wide * scale + (columns - 1) * GAP
        room = (max(7.0, used[1]), max(2.8, used[0]))
        if bounds is None and scale < CLEAR:
            count = max(2, round(room[0] / 2.8))
            side = (room[0] - (count - 1) * GAP) / count
            details = [
                ((left + i * (side + GAP), bottom, side, side), box)
                for i, box in enumerate(detail_windows(network, shapes, count, 0.8 * side / scale))
            ]
            lower = side + bottom if details else 0.0
        page = (room[0] + left + LEGEND, room[1] + bottom + top + lower)
    cell = (room[0] - (columns - 1) * GAP) / columns, (room[1] - (rows - 1) * GAP) / rows
    # Spare room of a strip shows its surroundings, but never its neighbours.
    alone = len(parts) == 1
    spare_x = max(0.0, cell[0] / scale - wide) / 2 if alone or not stacked else 0.0
    spare_y = max(0.0, cell[1] / scale - tall) / 2 if alone or stacked else 0.0
    panels: list[Panel] = []
    for i, strip in enumerate(parts):
        row, column = (i, 0) if stacked else (0, i)
        x = left + column * (cell[0] + GAP)
        y = lower + bottom + (rows - 1 - row) * (cell[1] + GAP)
        box = (strip[0] - spare_x, strip[1] - spare_y, strip[2] + spare_x, strip[3] + spare_y)
        panels.append(((x, y, *cell), box))
    return Page(page, scale, panels, stacked, details)


def strips(
    shapes: Mapping[str, Outline], view: Bounds, room: tuple[float, float]
) -> tuple[list[Bounds], bool, float]:
    """Cut a view into strips along its longer side.

    Every strip follows the road: its window moves across to where the lanes are. More strips are taken
    while the scale is below `CLEAR` and grows by them.

    Args:
        shapes: outlines of the map.
        view: the rectangle to show, m.
        room: width and height on the page, inches.

    Returns:
        The strips in reading order, whether they lie below each other (otherwise side by side), and the
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
        scale = min(along / (long / count), max(0.0, across - (count - 1) * GAP) / (count * short))
        boxes = [
            (a, c, b, d) if wide else (c, a, d, b)
            for (a, b), (c, d) in zip(itertools.pairwise(edges), windows, strict=True)
        ]
        return boxes, scale

    best, scale = cut(1)
    for count in range(2, 15):
        boxes, larger = cut(count)
        short = boxes[0][3 - axis] - boxes[0][1 - axis]
        if scale >= CLEAR or long / count < 0.8 * short:
            break
        thin = long > 2.5 * (high - low) or short < 0.6 * (high - low)
        if thin and larger > 1.1 * scale:
            best, scale = boxes, larger
    return best, wide, scale


def detail_windows(network: Network, shapes: Mapping[str, Outline], count: int, most: float) -> list[Bounds]:
    """At most `count` square windows on details, which do not overlap.

    The busiest junctions come first, then lanes of varying width. `most` is the side (m) from which on a
    window would show no more than the map itself.
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
