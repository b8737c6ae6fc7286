"""Lanes of a SUMO network: geometry, type, permissions and neighbours."""

from __future__ import annotations

import math
from collections import defaultdict

import numpy as np
from jaxtyping import Float

from limsim_jax.maps.network import Array, ImportReport, Lane, LaneType
from limsim_jax.maps.sumo.classes import ENGINE_CLASS, MOTOR, SPECIAL_RIGHTS, TYPE_OF_CLASSES
from limsim_jax.maps.sumo.curves import fit_lanes
from limsim_jax.maps.sumo.elements import DRIVEN, Elements, FileEdge, FileLane
from limsim_jax.maps.sumo.links import Links
from limsim_jax.maps.sumo.programs import short_list
from limsim_jax.maps.sumo.shapes import wrap

KINK = 5.0  # degrees; a larger angle between a lane and the next is reported

_UNUSED_TYPES = frozenset("shoulder border stop restricted parking median curb sidewalk".split())


def build_lanes(elements: Elements, links: Links) -> dict[str, Lane]:
    """Every lane of the file, by id. Raises `MapError`."""
    curves = fit_lanes(elements, links)
    onward = {
        lane.id: tuple(dict.fromkeys((c.via or c.target).id for c in lane.outgoing))
        for lane in elements.lanes.values()
    }
    back: dict[str, list[str]] = defaultdict(list)
    for lane_id, targets in onward.items():
        for target in targets:
            back[target].append(lane_id)
    result = {}
    for edge in elements.edges.values():
        sampled = []
        for curve, lo, hi, _ in (curves[lane.id] for lane in edge.lanes):
            at = curve.samples(lo, hi)
            sampled.append((at - lo, *curve.at(at)))
        middle = sampled[len(sampled) // 2][:3]
        for lane, (s, xy, heading, curvature) in zip(edge.lanes, sampled, strict=True):
            z = np.interp(s, curves[lane.id].vertex_s, lane.points[:, 2])
            road_s = _along_road(edge, middle, s, xy)
            left, right = _neighbours(elements, lane)
            result[lane.id] = Lane(
                id=lane.id,
                road=edge.id,
                number=lane.index,
                type=_lane_type(elements, lane),
                s=s,
                xyz=np.column_stack([xy, z]),
                heading=heading,
                curvature=curvature,
                width=np.full(len(s), lane.width),
                road_s=road_s,
                declared_length=lane.length,
                speed_limit=lane.speed,
                access=_access(lane),
                successors=onward[lane.id],
                predecessors=tuple(back[lane.id]),
                left=left.id if left else None,
                right=right.id if right else None,
                may_change_left=_may_change(elements.report, lane, left, lane.change_left),
                may_change_right=_may_change(elements.report, lane, right, lane.change_right),
                opposite=_opposite(elements, lane),
                junction=edge.junction,
            )
    return result


def report_kinks(elements: Elements, lanes: dict[str, Lane]) -> None:
    """Report lanes that meet at an angle: they stay as in the file."""
    kinks = []
    for lane in lanes.values():
        for other in (lanes[target] for target in lane.successors):
            if elements.edges[lane.road].function in DRIVEN and elements.edges[other.road].function in DRIVEN:
                meet = np.hypot(*(other.xyz[0] - lane.xyz[-1])[:2]) < 0.1
                angle = abs(math.degrees(wrap(other.heading[0] - lane.heading[-1])))
                if meet and angle > KINK:
                    kinks.append((angle, lane.id, other.id))
    if kinks:
        angle, lane_id, other_id = max(kinks)
        message = f"{len(kinks)} joints have kinks of more than {KINK:g} degrees, up to {angle:.1f}"
        elements.report.approximated("lane@joint", f"{lane_id} to {other_id}", message)


def _access(lane: FileLane) -> frozenset[str]:
    """Vehicle classes of SUMO and the engine on a lane."""
    extra = {ENGINE_CLASS[c] for c in ("passenger", "delivery") if c in lane.allowed}
    return lane.allowed | extra


def _lane_type(elements: Elements, lane: FileLane) -> LaneType:
    allowed = lane.allowed
    if lane.edge.function in {"crossing", "walkingarea"}:
        return LaneType.SIDEWALK
    if lane.edge.function == "connector":
        return LaneType.NONE  # joins a district to the net; no road for vehicles
    if not allowed:  # nets made from OpenDRIVE keep its type
        kind = elements.xml.text(lane.element, "type", "")
        return LaneType(kind) if kind in _UNUSED_TYPES else LaneType.NONE
    if allowed & MOTOR:
        entry = elements.xml.flag(lane.element, "acceleration")
        return LaneType.ENTRY if entry else LaneType.DRIVING
    for classes, kind in TYPE_OF_CLASSES:
        if allowed & classes:
            return kind
    return LaneType.SPECIAL


def _neighbours(elements: Elements, lane: FileLane) -> tuple[FileLane | None, FileLane | None]:
    """Left and right neighbour.

    Index 0 lies at the edge of the road: on the left with left-hand traffic.
    """
    if lane.edge.function not in DRIVEN:
        return None, None
    lanes = lane.edge.lanes
    inner = lanes[lane.index + 1] if lane.index + 1 < len(lanes) else None
    outer = lanes[lane.index - 1] if lane.index else None
    return (outer, inner) if elements.left_hand else (inner, outer)


def _may_change(
    report: ImportReport, lane: FileLane, other: FileLane | None, granted: frozenset[str]
) -> bool:
    """Whether ordinary motor vehicles may change to a neighbour.

    `granted`: classes that may leave `lane` to that side.
    """
    if other is None:
        return False
    common = lane.allowed & other.allowed & ENGINE_CLASS.keys()
    ordinary = common - SPECIAL_RIGHTS
    if granted & ordinary and ordinary - granted:
        message = f"only {short_list(sorted(granted & ordinary))} may change to {other.id}; here all may"
        report.approximated("lane", lane.id, message, lane.element.sourceline)
    return bool(granted & (ordinary or common))  # vehicles with special rights count on their own lanes


def _opposite(elements: Elements, lane: FileLane) -> str | None:
    if lane.opposite is not None and lane.opposite not in elements.lanes:
        raise elements.xml.error(lane.element, f"there is no lane '{lane.opposite}' to be its neighbour")
    return lane.opposite


def _along_road(
    edge: FileEdge, middle: tuple[Array, Array, Array], s: Array, xy: Array
) -> Float[Array, " M"]:
    """Coordinate along the edge (m) of the samples of a lane.

    It is that of the middle lane abreast of them. `middle` is its s, xy and heading. Where a lane reaches
    beyond the ends of the middle one, the coordinate goes on below 0 or above the length of the edge.
    """
    s_ref, xy_ref, heading_ref = middle
    scale = edge.lanes[0].length / s_ref[-1]
    if s is s_ref:
        return s * scale
    p, start = xy @ (1, 1j), xy_ref[:-1] @ (1, 1j)
    chord = np.diff(xy_ref @ (1, 1j))
    offset = p[:, None] - start
    u = (offset * (chord.conj() / np.abs(chord) ** 2)).real
    inside = np.clip(u, 0.0, 1.0)
    s_near = s_ref[:-1] + inside * np.diff(s_ref)
    # Where the edge runs past itself the nearest point may be on another stretch of it.
    expected = s * (s_ref[-1] / s[-1])
    far = np.abs(s_near - expected[:, None]) > 20.0 + 0.1 * s_ref[-1]
    distance = np.where(far, np.inf, np.abs(offset - inside * chord))
    found = s_near[np.arange(len(p)), distance.argmin(1)]
    for end, beyond in ((0, -1.0), (-1, 1.0)):  # tangents carry the middle lane on at both ends
        tangent = np.exp(1j * heading_ref[end])
        ahead = ((p - xy_ref[end] @ (1, 1j)) * tangent.conjugate()).real
        outside = (found == s_ref[end]) & (beyond * ahead > 0)
        found = np.where(outside, found + ahead, found)
    rising = np.maximum.accumulate(found)
    return rising * scale
