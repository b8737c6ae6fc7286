"""Windows of a map on a page: strips of long thin maps, and details."""

from __future__ import annotations

import itertools

import numpy as np

from limsim_jax.maps.network import Array, Network
from limsim_jax.maps.outline import Bounds, Outline

GAP = 0.42
"""Space between strips for the ticks, inches."""

CLEAR = 0.03
"""Scale at which a lane and its marks are easy to read, inches per metre."""


def strips(
    shapes: dict[str, Outline], view: Bounds, room: tuple[float, float]
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


def detail_windows(network: Network, shapes: dict[str, Outline], count: int, most: float) -> list[Bounds]:
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
