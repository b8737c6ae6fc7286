"""Lanelets: pieces of lane between two bounds, and their network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NoReturn

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from limsim_jax.maps.network import ImportReport, Lane, MapError, Network, Road

SPEED_LIMIT = 30.0
"""m/s, of lanes whose recording tells none."""

SAMPLE = 1.0
"""m between samples of the lanes that are built."""

BEND = 4.0
"""m over which headings of points along a lane are taken."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Lanelet:
    """A piece of lane between two bounds, in the direction of travel."""

    id: str
    left_bound: Float[np.ndarray, "K 2"]  # m
    right_bound: Float[np.ndarray, "M 2"]
    left: str | None = None  # neighbour in the same direction
    right: str | None = None
    predecessors: tuple[str, ...] = ()
    successors: tuple[str, ...] = ()


def centre_line(lanelet: Lanelet) -> tuple[Floats, Floats]:
    """Points in the middle between the bounds, `[K 2]`, and widths, `[K]`; m."""
    left, right = matched_bounds(lanelet.left_bound, lanelet.right_bound)
    return (left + right) / 2, np.linalg.norm(left - right, axis=-1)


def matched_bounds(left: Floats, right: Floats) -> tuple[Floats, Floats]:
    """Both bounds with as many points.

    Points go together by index if there are as many already, otherwise by share of the length.
    """
    if len(left) == len(right):
        return left, right
    count = max(len(left), len(right))

    def resampled(line: Floats) -> Floats:
        share = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=-1)))
        place = np.linspace(0, share[-1], count)
        return np.stack([np.interp(place, share, line[:, k]) for k in range(2)], -1)

    return resampled(left), resampled(right)


def lanelet_network(
    lanelets: Sequence[Lanelet], name: str, source: str, file_hash: str = "", speed_limit: float = SPEED_LIMIT
) -> Network:
    """A network with the middle lines of lanelets as lanes.

    Lanelets that are neighbours make a road; links to lanelets that are not there are dropped and reported.
    Lane changes are allowed wherever a neighbour drives the same way: recordings tell no markings.

    Args:
      lanelets: of the recording.
      name: of the network.
      source: file, for errors.
      file_hash: of the file.
      speed_limit: m/s, of all lanes.

    Raises:
      MapError: no lanelet, an id twice, one without length or width, or two that call one another
        neighbours on different sides.
    """
    if not lanelets:
        raise MapError("no lanelet; a map of the lanes is expected", file=source)
    known: dict[str, Lanelet] = {}
    for lanelet in lanelets:
        if lanelet.id in known:
            raise MapError("is there twice; ids have to differ", file=source, element=f"lanelet {lanelet.id}")
        known[lanelet.id] = lanelet
    report = ImportReport()
    report.added("speed limit", "all lanes", f"{speed_limit:g} m/s; the recording tells none")
    lanelets = [_linked(lanelet, known, report) for lanelet in lanelets]
    known = {lanelet.id: lanelet for lanelet in lanelets}
    road_of = _roads(lanelets, known, source)
    lanes = {}
    for lanelet in lanelets:
        report.read("lanelet")
        lanes[lanelet.id] = _lane(lanelet, road_of[lanelet.id], source, speed_limit)
    roads = {
        road: Road(id=road, length=max(lane.length for lane in lanes.values() if lane.road == road))
        for road in dict.fromkeys(road for road, _ in road_of.values())
    }
    return Network(
        name=name,
        source=source,
        file_hash=file_hash,
        format="lanelets",
        lanes=lanes,
        roads=roads,
        report=report,
    )


def _linked(lanelet: Lanelet, known: dict[str, Lanelet], report: ImportReport) -> Lanelet:
    """The lanelet with links to lanelets that are there."""

    def there(other: str | None, what: str) -> bool:
        if other is not None and other not in known:
            report.ignored(what, f"lanelet {lanelet.id}", f"leads to lanelet {other}, which is not there")
        return other in known

    return replace(
        lanelet,
        left=lanelet.left if there(lanelet.left, "neighbour") else None,
        right=lanelet.right if there(lanelet.right, "neighbour") else None,
        predecessors=tuple(other for other in lanelet.predecessors if there(other, "predecessor")),
        successors=tuple(other for other in lanelet.successors if there(other, "successor")),
    )


def _roads(lanelets: Sequence[Lanelet], known: dict[str, Lanelet], source: str) -> dict[str, tuple[str, int]]:
    """Road and number of every lanelet: neighbours make a road, numbered from the right edge."""
    found: dict[str, tuple[str, int]] = {}
    for lanelet in lanelets:
        for other, back in ((lanelet.left, "right"), (lanelet.right, "left")):
            if other is not None and getattr(known[other], back) not in (None, lanelet.id):
                raise MapError(
                    f"is beside lanelet {other}, whose {back} neighbour is {getattr(known[other], back)}",
                    file=source,
                    element=f"lanelet {lanelet.id}",
                )
        if lanelet.id in found:
            continue
        edge, seen = lanelet, {lanelet.id}
        while edge.right is not None and edge.right not in seen:
            edge = known[edge.right]
            seen.add(edge.id)
        number, road, at = 0, edge.id, edge
        while at.id not in found:
            found[at.id] = (road, number)
            number += 1
            if at.left is None:
                break
            at = known[at.left]
        found.setdefault(lanelet.id, (lanelet.id, 0))
    return found


def _lane(lanelet: Lanelet, place: tuple[str, int], source: str, speed_limit: float) -> Lane:
    def fail(reason: str) -> NoReturn:
        raise MapError(reason, file=source, element=f"lanelet {lanelet.id}")

    left, right = matched_bounds(lanelet.left_bound, lanelet.right_bound)
    xy, across = (left + right) / 2, np.linalg.norm(left - right, axis=-1)
    chord = np.linalg.norm(np.diff(xy, axis=0), axis=-1)
    if chord.sum() < 0.5:
        fail(f"is {chord.sum():.2f} m long; at least 0.5 m is expected")
    if np.median(across) < 0.5:
        fail(f"is {np.median(across):.2f} m wide; at least 0.5 m is expected")
    along = np.append(0.0, np.cumsum(chord))
    s = np.linspace(0, along[-1], max(round(along[-1] / SAMPLE) + 1, 3))
    # the direction over a few metres: points of recorded maps are centimetres apart and uneven
    reach = min(BEND, along[-1]) / 2
    ends = [np.clip(s + side * reach, 0, along[-1]) for side in (-1, 1)]
    first, last = (np.stack([np.interp(e, along, xy[:, k]) for k in range(2)], -1) for e in ends)
    step = last - first
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    to_left = np.stack([np.interp(s, along, (left - xy)[:, k]) for k in range(2)], -1)
    if np.median(step[:, 0] * to_left[:, 1] - step[:, 1] * to_left[:, 0]) < 0:
        fail("has its left bound on the right; bounds in the direction of travel are expected")
    points = np.stack([np.interp(s, along, xy[:, k]) for k in range(2)] + [np.zeros_like(s)], -1)
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=-1)))
    return Lane(
        id=lanelet.id, road=place[0], number=place[1], s=length, xyz=points, heading=heading,
        curvature=np.gradient(heading, length), width=np.interp(s, along, across), road_s=length,
        speed_limit=speed_limit, successors=lanelet.successors, predecessors=lanelet.predecessors,
        left=lanelet.left, right=lanelet.right,
        may_change_left=lanelet.left is not None, may_change_right=lanelet.right is not None,
    )  # fmt: skip


__all__ = ["BEND", "SAMPLE", "SPEED_LIMIT", "Lanelet", "centre_line", "lanelet_network", "matched_bounds"]
