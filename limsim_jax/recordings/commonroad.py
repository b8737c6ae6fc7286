"""CommonRoad: lanelets and the recorded obstacles on them, from XML."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps import xml
from limsim_jax.recordings.lanelets import SPEED_LIMIT, Lanelet, lanelet_network
from limsim_jax.recordings.leaders import InPlane, leaders_on_lanelets
from limsim_jax.recordings.recording import CLASSES, Recording, RecordingError
from limsim_jax.recordings.tracks import Rows, Tracks, tracks_from_rows

_MOTOR = ("car", "truck", "bus", "motorcycle", "van", "priorityVehicle", "taxi")
"""Obstacles that are replayed."""


@dataclass(frozen=True)
class CommonRoad:
    """What is read of a file; `R` states of obstacles with a trajectory."""

    name: str
    file_hash: str
    dt: float  # s
    lanelets: tuple[Lanelet, ...]
    kind: NDArray[np.str_]  # [R]
    rows: Rows

    @classmethod
    def read(cls, path: Path, data: bytes) -> CommonRoad:
        """Parse the bytes of a file, one top-level element at a time.

        Raises:
          MapError: no XML, another root, or a value that is missing or no number.
        """
        name, dt = path.name, math.nan
        lanelets: list[Lanelet] = []
        states: list[tuple[Any, ...]] = []
        read = xml.XmlReader(path)
        for root, element in read.children(data, "commonRoad"):
            name = root.get("benchmarkID", path.name)
            if math.isnan(dt):
                dt = read.number(root, "timeStepSize")
                if not 0 < dt <= 1:
                    raise read.error(root, f"timeStepSize is {dt:g} s; more than 0 and at most 1 is expected")
            if element.tag == "lanelet" and element.find("leftBound") is not None:
                lanelets.append(_lanelet(read, element))
            elif element.tag in ("dynamicObstacle", "obstacle") and element.find("trajectory") is not None:
                kind = (element.findtext("type") or "").strip()
                if kind in _MOTOR or kind in CLASSES:
                    states += _states(read, element, kind)
        columns = list(zip(*states, strict=True)) or [()] * 10
        line, vehicle, kind, *numbers = columns
        names = ("step", "x", "y", "heading", "v", "length", "width")
        rows = Rows(
            line=np.array(line, np.int64),
            vehicle=np.array(vehicle, str),
            **{name: np.array(column, float) for name, column in zip(names, numbers, strict=True)},
        )
        return cls(name, xml.file_hash(data), dt, tuple(lanelets), np.array(kind, str), rows)


def _states(read: xml.XmlReader, obstacle: Any, kind: str) -> list[tuple[Any, ...]]:
    """Line, id, kind and the numbers of `Rows` of every state."""
    vehicle = read.text(obstacle, "id")
    size = [read.content(obstacle, f"shape/rectangle/{side}") for side in ("length", "width")]
    first = obstacle.find("initialState")
    if first is None:
        raise read.error(obstacle, "has no <initialState>")
    children = ("time/exact", "position/point/x", "position/point/y", "orientation/exact", "velocity/exact")
    return [
        (state.sourceline, vehicle, kind, *(read.content(state, child) for child in children), *size)
        for state in (first, *obstacle.iterfind("trajectory/state"))
    ]


def _lanelet(read: xml.XmlReader, element: Any) -> Lanelet:
    bounds = []
    for side in ("leftBound", "rightBound"):
        points = [
            [read.content(point, axis) for axis in ("x", "y")] for point in element.iterfind(f"{side}/point")
        ]
        if len(points) < 2:
            raise read.error(element, f"<{side}> has {len(points)} points; at least 2 are expected")
        bounds.append(np.array(points))

    def beside(side: str) -> str | None:
        link = element.find(side)
        return link.get("ref") if link is not None and link.get("drivingDir") == "same" else None

    links = [tuple(link.get("ref") for link in element.iterfind(end)) for end in ("predecessor", "successor")]
    return Lanelet(
        read.text(element, "id"),
        bounds[0],
        bounds[1],
        beside("adjacentLeft"),
        beside("adjacentRight"),
        *links,
    )


def read_commonroad(path: Path, data: bytes) -> Recording:
    """Followers: `x` runs along chains of lanelets, the lane is the chain."""
    found = CommonRoad.read(path, data)
    keep = np.isin(found.kind, list(CLASSES))
    if not keep.any():
        raise RecordingError(
            f"{path}: no <dynamicObstacle> with a <trajectory>; recorded vehicles are expected"
        )
    rows = found.rows.where(keep)
    try:
        ident = rows.vehicle.astype(float).astype(np.int64)
    except ValueError:
        raise RecordingError(f"{path}: an obstacle has an 'id' that is no number") from None
    in_plane = InPlane(
        line=rows.line, ident=ident, time=rows.step * found.dt, x=rows.x, y=rows.y, heading=rows.heading,
        v=rows.v, length=rows.length,
        vehicle_class=np.array([CLASSES[kind] for kind in found.kind[keep].tolist()]),
    )  # fmt: skip
    columns = {"time": "time", "x": "position", "v": "velocity", "length": "length"}
    return leaders_on_lanelets(str(path), "CommonRoad", columns, in_plane, found.lanelets)


def read_commonroad_tracks(path: Path, data: bytes, speed_limit: float = SPEED_LIMIT) -> Tracks:
    """All motor vehicles and the lanes. `speed_limit`: m/s, of all lanes."""
    found = CommonRoad.read(path, data)
    network = lanelet_network(found.lanelets, found.name, str(path), found.file_hash, speed_limit)
    keep = np.isin(found.kind, list(_MOTOR))
    return tracks_from_rows(path, found.name, found.dt, found.rows.where(keep), network)


__all__ = ["CommonRoad", "read_commonroad", "read_commonroad_tracks"]
