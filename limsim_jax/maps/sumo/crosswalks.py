"""Crosswalks: pedestrian crossings of a net and the lanes below them."""

from __future__ import annotations

import math
from collections import defaultdict

import numpy as np
import shapely
from jaxtyping import Float

from limsim_jax.maps.network import Array, Crosswalk, Lane
from limsim_jax.maps.sumo.elements import Elements, polyline


def build_crosswalks(elements: Elements, lanes: dict[str, Lane]) -> tuple[Crosswalk, ...]:
    """Every pedestrian crossing, with the stretches (m) of lanes below it."""
    crosswalks = []
    inside: dict[str | None, list[Lane]] = defaultdict(list)
    for lane in lanes.values():
        if elements.edges[lane.road].function == "internal":
            inside[lane.junction].append(lane)
    for edge in elements.edges.values():
        if edge.function != "crossing":
            continue
        source, lane = edge.lanes[0], lanes[edge.lanes[0].id]
        outline = polyline(elements.xml, source.element, "outlineShape")[:, :2]
        if len(outline) < 3:
            side = np.stack([-np.sin(lane.heading), np.cos(lane.heading)], -1) * lane.width[:, None] / 2
            outline = np.concatenate([lane.xyz[:, :2] + side, (lane.xyz[:, :2] - side)[::-1]])
        crossed = elements.xml.text(edge.element, "crossingEdges", "").split()
        near = inside[edge.junction] + [
            lanes[x.id] for road in crossed if road in elements.edges for x in elements.edges[road].lanes
        ]
        spans = [(other.id, lo, hi) for other in near for lo, hi in _spans(other, outline)]
        crosswalks.append(
            Crosswalk(id=edge.id, outline=outline, spans=tuple(spans), line=edge.element.sourceline)
        )
    return tuple(crosswalks)


def _spans(lane: Lane, outline: Float[Array, "K 2"]) -> list[tuple[float, float]]:
    """Stretches (m) of a lane's centre line inside a polygon."""
    s = np.union1d(lane.s, np.linspace(0.0, lane.length, max(2, math.ceil(lane.length / 0.5) + 1)))
    xy = lane.pose(s)[0][:, :2]
    a, da = xy[:-1, None], np.diff(xy, axis=0)[:, None]
    b = outline[None]
    db = np.roll(outline, -1, axis=0)[None] - b
    cross = da[..., 0] * db[..., 1] - da[..., 1] * db[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = b - a
        u = (offset[..., 0] * db[..., 1] - offset[..., 1] * db[..., 0]) / cross  # along the lane
        v = (offset[..., 0] * da[..., 1] - offset[..., 1] * da[..., 0]) / cross  # along the outline
        hit = (u >= 0) & (u < 1) & (v >= 0) & (v < 1)
    i, j = np.nonzero(hit)
    cuts = np.concatenate([[0.0], np.sort(s[i] + u[i, j] * (s[i + 1] - s[i])), [lane.length]])
    middle = lane.pose((cuts[1:] + cuts[:-1]) / 2)[0][:, :2]
    area = shapely.Polygon(outline)
    inside = shapely.contains_xy(area, middle[:, 0], middle[:, 1])
    along = shapely.distance(shapely.points(middle), area.exterior) < 0.05  # along the border, not across it
    spans: list[tuple[float, float]] = []
    for lo, hi, covered in zip(cuts[:-1], cuts[1:], inside & ~along, strict=True):
        if covered and hi - lo > 1e-6:
            if spans and abs(spans[-1][1] - lo) < 1e-6:
                lo = spans.pop()[0]
            spans.append((float(lo), float(hi)))
    return spans
