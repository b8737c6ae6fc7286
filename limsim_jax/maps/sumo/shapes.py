"""Smooth curves over the polylines of SUMO.

SUMO draws a lane as a polyline, and a polyline has no curvature. `fit_polyline` lays a chain of circular
arcs and straight lines over it that is continuous in position and heading.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float
from numpy.typing import NDArray

from limsim_jax.maps.network import Array

RESOLUTION = 0.01  # m, what two decimals resolve: netconvert's default precision
MAX_BEND = math.radians(100.0)  # rad, a sharper turn at one vertex is a corner, not a sample of a bend
SPIKE = math.radians(150.0)  # rad, a sharper turn folds the lane back over itself
SAMPLE_ERROR = 5e-5  # m, of cubic Hermite interpolation between the samples of a lane
STEP = 1e-3  # m, between two samples that bracket a jump of curvature


@dataclass(frozen=True, kw_only=True, eq=False)
class Curve:
    """A chain of `A` circular arcs, continuous in position and heading.

    Arcs of curvature 0 are straight lines.
    """

    xy: Float[Array, "A 2"]  # m, where each arc starts
    heading: Float[Array, " A"]  # rad, there, unwrapped
    curvature: Float[Array, " A"]  # 1/m
    length: Float[Array, " A"]  # m
    vertex_s: Float[Array, " K"]  # m, arc length abreast of each vertex of the polyline
    deviation: float  # m, largest distance from the polyline
    spikes: int  # vertices left out because the polyline folds back there

    @property
    def total(self) -> float:
        """Arc length of the whole curve, m."""
        return float(self.length.sum())

    def heading_at(self, s: float) -> float:
        """Heading (rad, unwrapped) at arc length `s` (m)."""
        return float(self.at(np.array([s]))[1][0])

    def at(self, s: Float[Array, " M"]) -> tuple[Float[Array, "M 2"], Float[Array, " M"], Float[Array, " M"]]:
        """Position (m), heading (rad, unwrapped) and curvature (1/m) at `s`."""
        start = np.concatenate([[0.0], np.cumsum(self.length)])
        i = np.clip(np.searchsorted(start, s, side="right") - 1, 0, len(self.length) - 1)
        half = 0.5 * self.curvature[i] * (s - start[i])
        chord = (s - start[i]) * np.sinc(half / np.pi)
        direction = self.heading[i] + half
        xy = self.xy[i] + chord[:, None] * np.stack([np.cos(direction), np.sin(direction)], -1)
        return xy, self.heading[i] + 2 * half, self.curvature[i]

    def samples(self, lo: float = 0.0, hi: float = math.inf) -> Float[Array, " M"]:
        """Arc lengths (m) for cubic Hermite interpolation from `lo` to `hi`.

        Its error is at most `SAMPLE_ERROR`. A jump of curvature lies between two samples 1 mm apart, so
        that linear interpolation keeps it.
        """
        kappa = np.abs(self.curvature)
        # Over an arc of angle t and radius R the cubic is off by R t^4 / 384.
        angle = np.minimum((384 * SAMPLE_ERROR * np.maximum(kappa, 1e-12)) ** 0.25, 0.5)
        count = np.maximum(np.ceil(kappa * self.length / angle), 1).astype(int)
        end = np.cumsum(self.length)
        step = self.length / count
        arc = np.repeat(np.arange(len(count)), count)
        nth = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        jump = np.append(np.abs(np.diff(self.curvature)) > 1e-6, False) & (step > 1.5 * STEP)
        s = np.sort(np.concatenate([(end - self.length)[arc] + nth * step[arc], end[jump] - STEP]))
        hi = min(hi, float(end[-1]))
        return np.concatenate([[lo], s[(s > lo + STEP / 2) & (s < hi - STEP / 2)], [hi]])


def wrap(angle: Any) -> Any:
    """Angle in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _simplify(points: Float[Array, "K 3"], tolerance: float) -> NDArray[np.int64]:
    """Indices of the vertices that the Douglas-Peucker algorithm keeps.

    Distances are in space: `shapely.simplify` would ignore the height.
    """
    keep = {0, len(points) - 1}
    stack = [(0, len(points) - 1)]
    while stack:
        i, j = stack.pop()
        if j - i < 2:
            continue
        chord, inner = points[j] - points[i], points[i + 1 : j] - points[i]
        u = np.clip(inner @ chord / max(chord @ chord, 1e-300), 0.0, 1.0)
        distance = np.linalg.norm(inner - u[:, None] * chord, axis=1)
        k = int(distance.argmax())
        if distance[k] > tolerance:
            middle = i + 1 + k
            keep.add(middle)
            stack += [(i, middle), (middle, j)]
    return np.array(sorted(keep))


def _biarc(p0: Array, h0: float, p1: Array, h1: float) -> list[tuple[Array, float, float, float]]:
    """Two arcs from pose to pose, or one line.

    Each has its start, heading, curvature and length. The two distances from the ends to the control
    points are equal (Bolton 1975, 'Biarc curves').
    """
    v = p1 - p0
    t0 = np.array([math.cos(h0), math.sin(h0)])
    t1 = np.array([math.cos(h1), math.sin(h1)])
    if abs(t0[0] * v[1] - t0[1] * v[0]) < 1e-9 and abs(wrap(h1 - h0)) < 1e-9:
        return [(p0, h0, 0.0, float(np.hypot(*v)))]
    a, b, c = 2 * (1 - float(t0 @ t1)), float(v @ (t0 + t1)), float(v @ v)
    # a d^2 + 2 b d - c = 0 in the form that does not cancel as a goes to 0
    d = c / (b + math.sqrt(b * b + a * c))
    joint = 0.5 * (p0 + p1 + d * (t0 - t1))
    arcs = []
    for start, end, heading, at_start in ((p0, joint, h0, True), (joint, p1, h1, False)):
        chord = end - start
        c = float(np.hypot(*chord))
        half = float(wrap(math.atan2(chord[1], chord[0]) - heading))  # chord against tangent
        if not at_start:
            half = -half
        length = c / float(np.sinc(half / np.pi))
        arcs.append((start, heading if at_start else heading - 2 * half, 2 * half / length, length))
    return arcs


def fit_polyline(
    points: Float[Array, "K 3"],
    *,
    tolerance: float = math.inf,
    start_heading: float | None = None,
    end_heading: float | None = None,
) -> Curve:
    """Fit a curve of arcs and lines to a polyline.

    Both have the same ends.

    1. Vertices that are within 1 cm of the line through the others are left out (Douglas-Peucker): at
       the usual two decimals they stem from rounding, not from the road.
    2. A vertex where the polyline turns is a sample of a bend: the curve goes through it, in the
       direction of the circle through it and its neighbours, and bulges over the segments as the
       bend did that was sampled. On a segment more than twice as long as the one beyond the vertex the
       bend takes only that much of it.
    3. If that would leave the polyline by more than `tolerance` (m), or the turn is beyond 100 degrees,
       the vertex is a corner: an arc rounds it off that leaves the vertex by `tolerance` or takes half
       of the shorter segment.
    4. Headings at the ends are those of the first and last segment. Where a heading (rad) is given and
       differs from the segment by no more than the turn at the next vertex, the segment is the
       first chord of a bend and the given heading is taken.

    `points` are at least two, with no two equal in a row.
    """
    kept = _simplify(points, RESOLUTION)
    spikes = 0
    while True:
        vertices = points[kept, :2]
        segment = np.diff(vertices, axis=0)
        size = np.hypot(segment[:, 0], segment[:, 1])
        direction = np.arctan2(segment[:, 1], segment[:, 0])
        turn = wrap(np.diff(direction))
        folds = np.flatnonzero((np.abs(turn) > SPIKE) | (size[1:] == 0))
        if not len(folds) or len(kept) == 2:
            break
        kept, spikes = np.delete(kept, folds[0] + 1), spikes + 1

    before, after = size[:-1], size[1:]
    reach = np.stack([np.minimum(before, 2 * after), np.minimum(after, 2 * before)])  # of bends
    turn_in = turn * reach[0] / reach.sum(0)
    turn_out = turn - turn_in
    bend = np.abs(turn) <= MAX_BEND
    while bend.any():
        # Over each segment: the part that a bend takes, or all of it if there is one at either end.
        at_start, at_end = np.where(bend, np.abs(turn_out), 0.0), np.where(bend, np.abs(turn_in), 0.0)
        a, b = np.append(0.0, at_start), np.append(at_end, 0.0)
        ra, rb = np.append(0.0, reach[1] * bend), np.append(reach[0] * bend, 0.0)
        # Largest distance from its chord of an arc that meets it at angles a and b: that of the cubic.
        whole = size * (0.148 * np.maximum(a, b) + 0.102 * np.minimum(a, b))
        bulge = np.where(ra + rb < size, 0.148 * np.maximum(ra * a, rb * b), whole)
        i = int(bulge.argmax())
        if bulge[i] <= tolerance:
            break
        bend[i if i < len(turn) and b[i] >= a[i] else i - 1] = False
    with np.errstate(divide="ignore"):
        cut = np.minimum(np.minimum(before, after) / 2, tolerance / np.tan(np.abs(turn) / 4))

    # Poses that the curve goes through, and the two of them that bracket each vertex.
    start = _end_heading(float(direction[0]), start_heading, turn[:1])
    end = _end_heading(float(direction[-1]), end_heading, turn[-1:])
    nodes = [(vertices[0], start)]
    brackets = [(0, 0)]
    reach = np.where(bend, reach, cut)
    taken = size[0] if start != direction[0] else 0.0  # of the segment, by the vertex behind
    for i, p in enumerate(vertices[1:-1]):
        h0, h1 = float(direction[i]), float(direction[i + 1])
        u0, u1 = segment[i] / size[i], segment[i + 1] / size[i + 1]
        if not bend[i]:
            nodes += [(p - cut[i] * u0, h0), (p + cut[i] * u1, h1)]
            brackets.append((len(nodes) - 2, len(nodes) - 1))
        else:
            if taken + reach[0, i] < size[i] - RESOLUTION:
                nodes.append((p - reach[0, i] * u0, h0))
            nodes.append((p, h0 + float(turn_in[i])))
            brackets.append((len(nodes) - 1, len(nodes) - 1))
            last = i + 1 == len(turn)
            ahead = (size[-1] if end != direction[-1] else 0.0) if last else reach[0, i + 1]
            if reach[1, i] + ahead < size[i + 1] - RESOLUTION:
                nodes.append((p + reach[1, i] * u1, h1))
        taken = reach[1, i]
    nodes.append((vertices[-1], end))
    brackets.append((len(nodes) - 1, len(nodes) - 1))

    arcs: list[tuple[Array, float, float, float]] = []
    node_s = [0.0]
    for (p0, h0), (p1, h1) in pairwise(nodes):
        new = _biarc(p0, h0, p1, h1) if np.hypot(*(p1 - p0)) > 1e-6 else []
        arcs += new
        node_s.append(node_s[-1] + sum(arc[3] for arc in new))
    curvature = np.array([arc[2] for arc in arcs])
    length = np.array([arc[3] for arc in arcs])
    turned = np.concatenate([[0.0], np.cumsum(curvature * length)[:-1]])

    # Vertices that were left out lie between their neighbours as they do on the polyline.
    polyline_s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points[:, :2], axis=0).T))])
    at_kept = np.array([0.5 * (node_s[a] + node_s[b]) for a, b in brackets])
    curve = Curve(
        xy=np.array([arc[0] for arc in arcs]),
        heading=arcs[0][1] + turned,
        curvature=curvature,
        length=length,
        vertex_s=np.interp(polyline_s, polyline_s[kept], at_kept),
        deviation=0.0,
        spikes=spikes,
    )
    half_way = np.cumsum(length) - 0.5 * length
    probes = np.concatenate([curve.xy, curve.at(half_way)[0]])
    return replace(curve, deviation=float(distance_to_polyline(probes, points[:, :2]).max()))


def _end_heading(segment: float, given: float | None, turn: Float[Array, " J"]) -> float:
    """Heading (rad) of a curve at its end.

    It is the given one if the end segment can be a chord of a bend with it, otherwise that of the segment.
    """
    if given is None or not len(turn):
        return segment
    return given if abs(wrap(given - segment)) <= abs(float(turn[0])) else segment


def distance_to_polyline(xy: Float[Array, "M 2"], points: Float[Array, "K 2"]) -> Float[Array, " M"]:
    """Distance (m) of each point from the nearest place on a polyline."""
    line = shapely.LineString(points)
    shapely.prepare(line)
    return np.asarray(shapely.distance(shapely.points(xy), line))
