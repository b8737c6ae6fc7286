"""Lane links that a file states between roads, but not between lanes.

A link between the ends of two roads, or of two lane sections of a road, says that traffic can pass. Where
no lane link makes it true, lanes whose ends coincide are linked. Where there are none, the report says so.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from limsim_jax.maps.bridges import AHEAD, COINCIDE
from limsim_jax.maps.network import ImportReport
from limsim_jax.maps.opendrive.lanes import RoadShape, carries_traffic, runs_forward
from limsim_jax.maps.opendrive.records import RawRoad

NARROWEST = 0.5
"""Least width (m) of a lane end to be one."""

End = tuple[str, int, int, str]
"""An end of a lane record: road, section index, lane number, "start" or "end" in road s."""


@dataclass(frozen=True, kw_only=True)
class Stated:
    """A link between two ends of lane sections, as stated."""

    first: tuple[str, int, str]  # road, section index, "start" or "end"
    second: tuple[str, int, str]
    where: str
    line: int | None
    junction: str | None = None  # the direct junction that states it


@dataclass(frozen=True)
class _LaneEnd:
    """Where a lane of a section ends or begins."""

    key: End
    x: float
    y: float
    heading: float  # rad, of its traffic
    leaves: bool  # traffic leaves the lane here


def complete(
    stated: Iterable[Stated],
    linked: Container[tuple[End, End]],
    roads: dict[str, RawRoad],
    report: ImportReport,
) -> Iterator[tuple[End, End, Stated]]:
    """Yield lane links for stated links that have none.

    Args:
      stated: links between roads or sections.
      linked: pairs of lane ends that the file links, the lesser first.
      roads: of the file, by id.
      report: receives what was repaired, and what cannot be.
    """
    done: set[frozenset[tuple[str, int, str]]] = set()
    for link in stated:
        pair = frozenset((link.first, link.second))
        if pair in done or len(pair) < 2:
            continue
        done.add(pair)
        here, there = (list(_lane_ends(roads[end[0]], end[1], end[2])) for end in (link.first, link.second))
        if any((min(a.key, b.key), max(a.key, b.key)) in linked for a in here for b in there):
            continue
        found = [(a, b) for a in here for b in there if a.leaves != b.leaves]
        nearest = [
            (a, b) for a, b in found if _meet(a, b) and _gap(a, b) <= min(_gap(a, c) for _, c in found)
        ]
        for a, b in nearest:
            yield a.key, b.key, link
        roads_named = f"road {link.first[0]} and road {link.second[0]}"
        if nearest:
            message = f"states no lane links: linked {len(nearest)} whose ends coincide"
            report.repaired("lane link", link.where, message, link.line)
        elif found:
            gap = min(_gap(a, b) for a, b in found)
            message = (
                f"no lane of {roads_named} leads on: none is linked, and the nearest are {gap:.1f} m apart"
            )
            report.unusable("lane link", link.where, message, link.line)


def _lane_ends(road: RawRoad, section: int, side: str) -> Iterator[_LaneEnd]:
    """Ends of lanes for traffic, at one end of a section."""
    record = road.sections[section]
    s = np.array([min(max(record.s if side == "start" else record.end, 0.0), road.length)])
    inside = s + (1e-9 if side == "start" else -1e-9)
    x, y, heading, *_ = road.reference.frame(s, inside)
    for number, (t, width) in RoadShape(road).profile(record, s, inside).items():
        lane = record.lanes[number]
        if width[0] < NARROWEST or not carries_traffic(lane):
            continue
        forward = runs_forward(road, lane)
        yield _LaneEnd(
            (road.id, section, number, side),
            float(x[0] - t[0][0] * np.sin(heading[0])),
            float(y[0] + t[0][0] * np.cos(heading[0])),
            float(heading[0]) + (0.0 if forward else math.pi),
            forward == (side == "end"),
        )


def _gap(a: _LaneEnd, b: _LaneEnd) -> float:
    return math.hypot(a.x - b.x, a.y - b.y)


def _meet(a: _LaneEnd, b: _LaneEnd) -> bool:
    """Whether traffic can go from one to the other."""
    return _gap(a, b) <= COINCIDE and math.cos(a.heading - b.heading) >= math.cos(AHEAD)
