"""The map of a replay: borders, marks, lines, crosswalks and lights as columns of numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps.draw import _KINDS, _TRAFFIC, JUNCTION, _halfplane, _kind, _prepare, _Shape, _view
from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.maps.network import Control, Network
from limsim_jax.maps.signals import lane_states
from limsim_jax.report.video import _stop_bars
from limsim_jax.report.viewer.pack import Pack, origin

_THIN = 0.03  # m, a drawn border may deviate from its lane's by this


def add_map(pack: Pack, network: Network, lane_map: LaneMap, phase: NDArray[Any]) -> dict[str, Any]:
    """Add lane borders, lines and lights in file coordinates less the origin of the lane map."""
    shapes, levels = _prepare(network)
    x0, y0, x1, y1 = _view(network, shapes, None)
    shift = origin(lane_map)

    def order(shape: _Shape) -> tuple[Any, ...]:
        lane = shape.lane
        return levels[lane.id], lane.drivable, lane.junction is None, lane.type.value != "none"

    drawn = sorted(shapes.values(), key=order)
    number = {shape.lane.id: i for i, shape in enumerate(drawn)}
    borders, counts, areas = [], [], []
    kinds = [*_KINDS, "junction"]
    connectors: list[tuple[int, int]] = []  # lane, junction
    junctions = {id_: j for j, id_ in enumerate(network.junctions)}
    for i, shape in enumerate(drawn):
        lane = shape.lane
        kept = _thinned(shape)
        borders += [shape.left[kept], shape.right[kept]]
        counts.append(len(kept))
        inside = lane.drivable and lane.junction is not None
        areas.append(len(_KINDS) if inside else kinds.index(_kind(lane)))
        if inside:
            connectors.append((i, junctions.get(lane.junction or "", -1)))
    pack.add_points("border", np.concatenate(borders), shift)

    stripes = [stripe for walk in network.crosswalks for stripe in _stripes(network, walk)]
    lines = _held_lines(network, shapes)
    pack.add_points("stripe", np.concatenate([*stripes, np.zeros((0, 2))]), shift)
    pack.add_points("line", np.concatenate([*(bar for _, bar in lines), np.zeros((0, 2))]), shift)
    bars, rows = _stop_bars(network, lane_map)
    pack.add_points("light", bars.reshape(-1, 2), shift)
    states = np.asarray(jax.vmap(lane_states, (None, 0))(lane_map.signals, phase))[:, rows]
    pack.add("light_state", states.T, 1)
    drivable = list(network.drivable_lanes())
    return {
        "bounds": [x0 - shift[0], y0 - shift[1], x1 - shift[0], y1 - shift[1]],
        "origin": shift.tolist(),
        "kinds": kinds,
        "colors": [color for color, _ in _KINDS.values()] + [JUNCTION],
        "count": counts,
        "area": areas,
        "level": [levels[shape.lane.id] for shape in drawn],
        "connectors": connectors,
        "marks": _marks(network, drawn, number),
        "stripes": [len(stripe) for stripe in stripes],
        "lines": [kind for kind, _ in lines],
        "lanes": [lane.id for lane in drivable],
        "limits": [round(lane.speed_limit, 2) for lane in drivable],
    }


def _thinned(shape: _Shape) -> list[int]:
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


def _marks(network: Network, drawn: Sequence[_Shape], number: Mapping[str, int]) -> list[Any]:
    """Borders of lanes outside junctions: kind, lane, side (0 left, 1 right), shift outward (m).

    Solid where crossing is forbidden, dashed where it is allowed; `centre` parts the directions.
    """
    lanes, marks = network.lanes, []
    done: set[frozenset[str]] = set()
    # Lanes with traffic first: the border that they share with others is theirs.
    for shape in sorted(drawn, key=lambda shape: not shape.lane.drivable):
        lane = shape.lane
        if lane.junction is not None:
            continue
        road = network.roads.get(lane.road)
        beyond = 1 if road is not None and road.left_hand else 0
        for side, neighbour in enumerate((lane.left, lane.right)):
            oncoming = lane.opposite if side == beyond else None
            other = neighbour or oncoming
            if other is not None:
                pair = frozenset((lane.id, other))
                if pair in done:
                    continue
                done.add(pair)
            back = lanes.get(neighbour or "")
            facing = lanes.get(oncoming or "")
            if not lane.drivable:
                kinds = [("kerb", 0.0)]
            elif back is not None and back.drivable:
                out = (lane.may_change_left, lane.may_change_right)[side]
                into = (back.may_change_right, back.may_change_left)[side]
                # The line next to a lane is the one that binds its traffic.
                if out == into:
                    kinds = [("dashed" if out else "solid", 0.0)]
                else:
                    kinds = [("dashed" if out else "solid", -0.12), ("dashed" if into else "solid", 0.12)]
            elif back is None and facing is not None and facing.type in _TRAFFIC:
                kinds = [("centre", 0.0)]
            else:
                kinds = [("edge", 0.0)]
            marks += [[kind, number[lane.id], side, shift] for kind, shift in kinds]
    return marks


def _held_lines(network: Network, shapes: Mapping[str, _Shape]) -> list[tuple[str, NDArray[np.float64]]]:
    """Stop lines of the file and the ends of lanes whose traffic has to stop or to yield: kind, `[2, 2]`."""

    def across(lane: str, s: float, share: float) -> NDArray[np.float64]:
        shape = shapes[lane]
        middle = shape.at(s, shape.centre)
        return middle + share * (np.stack([shape.at(s, shape.left), shape.at(s, shape.right)]) - middle)

    lines = [("stop", across(line.spot.lane, line.spot.s, 0.95)) for line in network.stop_lines]
    marked = {line.spot.lane for line in network.stop_lines}
    controls: dict[str, set[Control]] = {}
    for movement in network.movements:
        controls.setdefault(movement.incoming, set()).add(movement.control)
    for lane, found in controls.items():
        for kind, held in (("stop", {Control.STOP, Control.ALL_WAY_STOP}), ("yield", {Control.YIELD})):
            if found <= held and lane not in marked:
                lines.append((kind, across(lane, network.lanes[lane].length, 0.95)))
    return lines


def _stripes(network: Network, walk: Any) -> list[NDArray[np.float64]]:
    """The bars of a crosswalk `[K, 2]`, along the traffic that crosses it."""
    outline = np.asarray(walk.outline, float)[:, :2]
    if len(outline) < 3:
        return []
    spans = [(network.lanes[lane], 0.5 * (a + b)) for lane, a, b in walk.spans if lane in network.lanes]
    if spans:
        heading = float(np.interp(spans[0][1], spans[0][0].s, spans[0][0].heading))
        along = np.array([-math.sin(heading), math.cos(heading)])
    else:
        edges = np.roll(outline, -1, 0) - outline
        longest = edges[np.argmax(np.hypot(*edges.T))]
        along = longest / np.hypot(*longest)
    offsets = outline @ along
    bars = [
        _halfplane(_halfplane(outline, -along, -start), along, start + 0.5)
        for start in np.arange(offsets.min() + 0.25, offsets.max(), 1.0)
    ]
    return [bar for bar in bars if len(bar) >= 3]
