"""Curves under the lanes of a SUMO network."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from limsim_jax.maps.network import Array
from limsim_jax.maps.sumo.elements import Elements, FileLane
from limsim_jax.maps.sumo.links import Links
from limsim_jax.maps.sumo.shapes import RESOLUTION, Curve, fit_polyline

BEND_SHARE = (
    0.1  # largest deviation of a curve from the shape of an ordinary lane, as a share of the lane width
)


class LaneCurve(NamedTuple):
    """A curve, and the part of it that is the lane."""

    curve: Curve
    start: float  # m along the curve
    end: float  # m along the curve
    vertex_s: Float[Array, " K"]  # m from the start of the lane, of the vertices of its shape


def fit_lanes(elements: Elements, links: Links) -> dict[str, LaneCurve]:
    """Fit a curve to every lane, by id. Raises `MapError` for an empty shape."""
    curves: dict[str, LaneCurve] = {}
    worst: dict[str, tuple[float, int, str]] = {}

    def add(lane: FileLane, curve: Curve, lo: float, hi: float, vertex_s: Float[Array, " K"]) -> None:
        curves[lane.id] = LaneCurve(curve, lo, hi, np.clip(vertex_s - lo, 0.0, hi - lo))

    def note(lanes: tuple[FileLane, ...], curve: Curve) -> None:
        if curve.spikes:
            for lane in lanes:
                message = f"the shape folds back on itself; {curve.spikes} points left out"
                elements.report.repaired("lane", lane.id, message, lane.element.sourceline)
        if curve.deviation > RESOLUTION:
            kind = lanes[0].edge.function
            deviation, count, where = worst.get(kind, (0.0, 0, ""))
            if curve.deviation > deviation:
                deviation, where = curve.deviation, lanes[0].id
            worst[kind] = deviation, count + len(lanes), where

    _compare_lengths(elements)
    for lane in elements.lanes.values():
        lane.points = _clean(elements, lane)
    for lane in elements.lanes.values():
        if lane.edge.function != "internal":
            share = RESOLUTION if lane.edge.function == "walkingarea" else BEND_SHARE * lane.width
            curve = fit_polyline(lane.points, tolerance=share)
            add(lane, curve, 0.0, curve.total, curve.vertex_s)
            note((lane,), curve)
    # Inside junctions netconvert samples a curve that is tangent to the lanes at both ends, and cuts it
    # where vehicles wait. So the lanes of a movement form one curve.
    for connection in (c for lane in elements.lanes.values() for c in lane.outgoing if c in links.chains):
        chain = links.chains[connection]
        if not chain or any(lane.edge.function != "internal" or lane.id in curves for lane in chain):
            continue
        gaps = [np.hypot(*(b.points[0] - a.points[-1])[:2]) for a, b in pairwise(chain)]
        joined = max(gaps, default=0.0) < 1.5 * RESOLUTION
        for lanes in [chain] if joined else [(lane,) for lane in chain]:
            parts = [lane.points if i == 0 else lane.points[1:] for i, lane in enumerate(lanes)]
            before, after = curves[connection.source.id], curves[connection.target.id]
            curve = fit_polyline(
                np.concatenate(parts),
                start_heading=float(before.curve.heading_at(before.end)) if lanes[0] is chain[0] else None,
                end_heading=float(after.curve.heading_at(after.start)) if lanes[-1] is chain[-1] else None,
            )
            note(lanes, curve)
            first = 0
            for lane in lanes:
                vertex_s = curve.vertex_s[first : first + len(lane.points)]
                add(lane, curve, float(vertex_s[0]), float(vertex_s[-1]), vertex_s)
                first += len(lane.points) - 1
    for lane in elements.lanes.values():  # internal lanes that no movement uses
        if lane.id not in curves:
            curve = fit_polyline(lane.points)
            add(lane, curve, 0.0, curve.total, curve.vertex_s)
            note((lane,), curve)
    for kind, (deviation, count, where) in worst.items():
        message = f"arcs and lines for {count} polylines, which they leave by up to {deviation:.3f} m"
        elements.report.approximated("lane@shape", f"{kind} lanes, worst {where}", message)
    return curves


def _compare_lengths(elements: Elements) -> None:
    """Report declared lengths that differ from those of the shapes.

    More than 1 % and 0.1 m count. The lanes of an edge share one length: netconvert writes the mean of
    their shapes.
    """
    parallel: list[tuple[float, str]] = []
    for edge in elements.edges.values():
        if edge.function == "walkingarea":
            continue
        sizes = [float(np.linalg.norm(np.diff(lane.points, axis=0), axis=1).sum()) for lane in edge.lanes]
        mean = sum(sizes) / len(sizes)
        for lane, size in zip(edge.lanes, sizes, strict=True):
            limit = max(0.01 * lane.length, 0.1)
            if abs(mean - lane.length) > limit:
                message = f"declared length {lane.length:.2f} m, but the shape is {size:.2f} m long"
                elements.report.approximated("lane@length", lane.id, message, lane.element.sourceline)
            elif abs(size - lane.length) > limit:
                parallel.append((abs(size - lane.length), lane.id))
    if parallel:
        worst, where = max(parallel)
        message = f"{len(parallel)} lanes in bends differ from their edge's length by up to {worst:.2f} m"
        elements.report.approximated("lane@length", f"lane {where}", message)


def _clean(elements: Elements, lane: FileLane) -> Float[Array, "K 3"]:
    """The shape without repeated points, at least 1 cm long."""
    line = lane.element.sourceline
    points = lane.points
    if not len(points):
        raise elements.xml.error(lane.element, "the shape is empty")
    step = np.hypot(*np.diff(points[:, :2], axis=0).T)
    keep = np.append(True, step > 1e-6)
    if not keep.all():
        message = f"{(~keep).sum()} repeated points in its shape left out"
        elements.report.repaired("lane", lane.id, message, line)
        points = points[keep]
    if len(points) == 1:
        heading = _heading_around(elements, lane)
        elements.report.repaired("lane", lane.id, "the shape has no extent; made 1 cm long", line)
        step_on = RESOLUTION * np.array([np.cos(heading), np.sin(heading), 0.0])
        points = np.stack([points[0], points[0] + step_on])
    return points


def _heading_around(elements: Elements, lane: FileLane) -> float:
    """Direction (rad) for a lane without extent, from its neighbours."""
    lanes = elements.lanes.values()
    sources = [other.points[-2:] for other in lanes for c in other.outgoing if c.via is lane]
    targets = [(c.via or c.target).points[:2] for c in lane.outgoing]
    for points in sources + targets:
        if len(points) == 2 and np.hypot(*(points[1] - points[0])[:2]) > 1e-6:
            return float(np.arctan2(*(points[1] - points[0])[1::-1]))
    return 0.0
