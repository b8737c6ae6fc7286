"""The map of a replay: borders, marks, lines, crosswalks and lights as columns of numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.maps.network import Network
from limsim_jax.maps.outline import (
    SURFACES,
    Outline,
    crosswalk_stripes,
    held_ends,
    levels,
    marks,
    outlines,
    signal_bars,
    surface,
    surface_rank,
    view,
)
from limsim_jax.maps.signals import lane_states_on_host
from limsim_jax.report.viewer.pack import Pack, origin

_THIN = 0.03  # m, a drawn border may deviate from its lane's by this
_DOUBLE = 0.12  # m, from a border to each line of a double mark


def add_map(pack: Pack, network: Network, lane_map: LaneMap, phase: NDArray[Any]) -> dict[str, Any]:
    """Add borders, lines and lights, relative to the lane map's origin."""
    shapes = outlines(network)
    storeys = levels(shapes.values())
    x0, y0, x1, y1 = view(network, shapes, None)
    shift = origin(lane_map)
    drawn = sorted(shapes.values(), key=lambda shape: (storeys[shape.lane.id], *surface_rank(shape.lane)))
    number = {shape.lane.id: i for i, shape in enumerate(drawn)}
    borders, counts, areas = [], [], []
    kinds = list(SURFACES)
    connectors: list[tuple[int, int]] = []  # lane, junction
    junctions = {id_: j for j, id_ in enumerate(network.junctions)}
    for i, shape in enumerate(drawn):
        lane = shape.lane
        kept = _thinned(shape)
        borders += [shape.left[kept], shape.right[kept]]
        counts.append(len(kept))
        areas.append(kinds.index(surface(lane)))
        if lane.drivable and lane.junction is not None:
            connectors.append((i, junctions.get(lane.junction, -1)))
    pack.add_points("border", np.concatenate(borders), shift)

    stripes = [stripe for walk in network.crosswalks for stripe in crosswalk_stripes(network, walk)]
    lines = _held_lines(network, shapes)
    pack.add_points("stripe", np.concatenate([*stripes, np.zeros((0, 2))]), shift)
    pack.add_points("line", np.concatenate([*(bar for _, bar in lines), np.zeros((0, 2))]), shift)
    bars, rows = signal_bars(network, lane_map)
    pack.add_points("light", bars.reshape(-1, 2), shift)
    states = lane_states_on_host(lane_map.signals, phase)[:, rows]
    pack.add("light_state", states.T, 1)
    drivable = list(network.drivable_lanes())
    return {
        "bounds": [x0 - shift[0], y0 - shift[1], x1 - shift[0], y1 - shift[1]],
        "origin": shift.tolist(),
        "kinds": kinds,
        "colors": [kind.color for kind in SURFACES.values()],
        "count": counts,
        "area": areas,
        "level": [storeys[shape.lane.id] for shape in drawn],
        "connectors": connectors,
        # Kind, lane, side (0 left, 1 right), shift outward (m).
        "marks": [
            [mark.kind, number[mark.outline.lane.id], mark.side, _DOUBLE * mark.shift]
            for mark in marks(network, drawn)
        ],
        "stripes": [len(stripe) for stripe in stripes],
        "lines": [kind for kind, _ in lines],
        "lanes": [lane.id for lane in drivable],
        "limits": [round(lane.speed_limit, 2) for lane in drivable],
    }


def _held_lines(network: Network, shapes: Mapping[str, Outline]) -> list[tuple[str, NDArray[np.float64]]]:
    """Stop lines and the ends of lanes that must stop or yield.

    Kind and line `[2, 2]` of each."""
    lines = [("stop", shapes[line.spot.lane].bar(line.spot.s, 0.95)) for line in network.stop_lines]
    marked = {line.spot.lane for line in network.stop_lines}
    return lines + [
        (held, shapes[lane].bar(network.lanes[lane].length, 0.95))
        for lane, held in held_ends(network, marked)
        if held != "signal"
    ]


def _thinned(shape: Outline) -> list[int]:
    """Samples between which the borders are straight within `_THIN` (Ramer 1972)."""
    s, points = shape.s, np.concatenate([shape.left, shape.right], -1)
    kept, open_ = [0, len(s) - 1], [(0, len(s) - 1)]
    while open_:
        i, j = open_.pop()
        if j - i < 2 or s[j] <= s[i]:
            continue
        u = (s[i + 1 : j] - s[i]) / (s[j] - s[i])
        off = np.abs(points[i + 1 : j] - points[i] - u[:, None] * (points[j] - points[i])).max(-1)
        k = i + 1 + int(off.argmax())
        if off[k - i - 1] > _THIN:
            kept.append(k)
            open_ += [(i, k), (k, j)]
    return sorted(kept)
