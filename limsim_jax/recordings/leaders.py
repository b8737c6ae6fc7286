"""Leaders of vehicles that are recorded in the plane: on the follower's own path, or on lanelets."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from limsim_jax.recordings.lanelets import Lanelet, centre_line
from limsim_jax.recordings.recording import (
    Floats,
    Ints,
    Recording,
    RecordingError,
    build_recording,
    time_step,
)

REACH = 150.0
"""m, farther leaders are not looked for."""

BESIDE = 1.2
"""m, vehicles whose centres are farther apart across the lane do not follow each other."""

_SAME_WAY = 0.5  # cosine of the angle between vehicles, or between a vehicle and its lane, at least


@dataclass(frozen=True, kw_only=True)
class InPlane:
    """Rows `R`, one per vehicle and time."""

    line: Ints  # of the file
    ident: Ints
    time: Floats  # s
    x: Floats  # m, middle of the body
    y: Floats  # m
    heading: Floats  # rad
    v: Floats  # m/s
    length: Floats  # m
    vehicle_class: Ints

    def sorted(self) -> InPlane:
        """By vehicle and time."""
        order = np.lexsort((self.time, self.ident))
        return InPlane(**{field.name: getattr(self, field.name)[order] for field in fields(self)})


def leaders_on_paths(
    source: str, kind: str, columns: Mapping[str, str], rows: InPlane, *, speed_limit: float = math.nan
) -> Recording:
    """Leaders where there are no lanes: the next vehicle on the path that the follower itself took.

    Args:
      source: file.
      kind: of the file.
      columns: see `Recording`.
      rows: of all vehicles.
      speed_limit: m/s.
    """
    rows = rows.sorted()
    time = rows.time
    names, vehicle = np.unique(rows.ident, return_inverse=True)
    time_step(source, columns["time"], time, vehicle, rows.line)
    point = np.stack([rows.x, rows.y], -1)
    heading, length = rows.heading, rows.length
    starts = np.searchsorted(vehicle, np.arange(len(names) + 1))
    tick = np.round(time / np.median(np.diff(time)[np.diff(vehicle) == 0])).astype(np.int64)
    x, x_lead = np.zeros(len(time)), np.full(len(time), np.nan)
    lead_row = np.full(len(time), -1)
    first, last = tick[starts[:-1]], tick[starts[1:] - 1]
    for i in range(len(names)):
        own = slice(starts[i], starts[i + 1])
        track = point[own]
        s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(track, axis=0), axis=-1))])
        x[own] = s + length[own] / 2
        tree, best = KDTree(track), np.full(len(track), np.inf)
        for j in np.flatnonzero((first <= last[i]) & (last >= first[i])):
            if j == i:
                continue
            other = np.arange(starts[j], starts[j + 1])
            at = np.searchsorted(tick[own], tick[other])
            other = other[(at < len(track)) & (tick[own][np.minimum(at, len(track) - 1)] == tick[other])]
            at = np.searchsorted(tick[own], tick[other])
            apart, nearest = map(np.asarray, tree.query(point[other], distance_upper_bound=2 * BESIDE))
            hit = np.isfinite(apart)
            other, at, nearest = other[hit], at[hit], nearest[hit]
            offset, course = point[other] - track[nearest], heading[own][nearest]
            along = offset[:, 0] * np.cos(course) + offset[:, 1] * np.sin(course)
            across = offset[:, 1] * np.cos(course) - offset[:, 0] * np.sin(course)
            # A vehicle abreast of the path, or beyond one of its ends, is no leader.
            hit = (np.abs(across) <= BESIDE) & (np.abs(along) <= BESIDE)
            other, at, nearest, along = other[hit], at[hit], nearest[hit], along[hit]
            turned = np.cos(heading[other] - heading[own][nearest]) > _SAME_WAY
            front = s[nearest] + along + length[other] / 2
            gap = front - length[other] - x[own][at]
            ahead = turned & (s[nearest] > s[at]) & (gap < np.minimum(best[at], REACH))
            best[at[ahead]] = gap[ahead]
            x_lead[own.start + at[ahead]] = front[ahead]
            lead_row[own.start + at[ahead]] = other[ahead]
    return _recording(source, kind, columns, names, vehicle, rows, x, lead_row, x_lead, speed_limit)


def _recording(
    source: str,
    kind: str,
    columns: Mapping[str, str],
    names: NDArray[np.int64],
    vehicle: Ints,
    rows: InPlane,
    x: Floats,
    lead: Ints,
    x_lead: Floats,
    speed_limit: float = math.nan,
    **more: NDArray[Any],
) -> Recording:
    """A recording of sorted rows. `lead`: row of each leader, or -1."""
    there = lead >= 0
    return build_recording(
        source,
        kind=kind,
        names=tuple(str(name) for name in names),
        columns=columns,
        speed_limit=speed_limit,
        values={
            "line": rows.line,
            "vehicle": vehicle,
            "time": rows.time,
            "x": x,
            "v": rows.v,
            "length": rows.length,
            "vehicle_class": rows.vehicle_class,
            "leader": np.where(there, vehicle[lead], -1),
            "x_lead": np.where(there, x_lead, np.nan),
            "v_lead": np.where(there, rows.v[lead], np.nan),
            "length_lead": np.where(there, rows.length[lead], np.nan),
            **more,
        },
    )


# --- on lanelets -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Chains:
    """Lanelets one after another: points of their centre lines."""

    point: Floats  # [P 2]
    s: Floats  # [P], along the chain
    chain: Ints  # [P]
    half_width: Floats  # [P]
    heading: Floats  # [P]


def leaders_on_lanelets(
    source: str, kind: str, columns: Mapping[str, str], rows: InPlane, lanelets: Sequence[Lanelet]
) -> Recording:
    """Positions along chains of lanelets; the leader is the next vehicle on the same chain.

    Args:
      source: file.
      kind: of the file.
      columns: see `Recording`.
      rows: of all vehicles.
      lanelets: of the file.

    Raises:
      RecordingError: there are no lanelets.
    """
    chains = _chains(source, lanelets)
    rows = rows.sorted()
    point = np.stack([rows.x, rows.y], -1)
    # Among the nearest centre points one whose lane goes the same way.
    apart, near = KDTree(chains.point).query(point, k=min(8, len(chains.point)))
    turn = np.cos(rows.heading[:, None] - chains.heading[near])
    pick = np.argmin(np.where(turn > _SAME_WAY, apart, apart + 1e3), axis=-1)
    near = np.take_along_axis(near, pick[:, None], -1)[:, 0]
    offset = point - chains.point[near]
    tangent = np.stack([np.cos(chains.heading[near]), np.sin(chains.heading[near])], -1)
    along = np.sum(offset * tangent, -1)
    across = tangent[:, 0] * offset[:, 1] - tangent[:, 1] * offset[:, 0]
    on = (np.abs(across) <= chains.half_width[near] + 0.5) & (np.abs(along) < 3)
    names, vehicle = np.unique(rows.ident, return_inverse=True)
    lane = np.where(on, chains.chain[near], -1)
    length = rows.length
    x = chains.s[near] + along + length / 2
    dt = time_step(source, columns["time"], rows.time, vehicle, rows.line)
    tick = np.round(rows.time / dt).astype(np.int64)
    ahead = np.lexsort((x, lane, tick))
    same = (np.diff(tick[ahead]) == 0) & (np.diff(lane[ahead]) == 0) & (lane[ahead][1:] >= 0)
    lead = np.full(len(x), -1)
    lead[ahead[:-1][same]] = ahead[1:][same]
    lead[np.where(lead >= 0, x[lead] - x, 0) > REACH] = -1
    # Side by side on one chain, where lanes merge or a vehicle changes lanes, there is no leader.
    beside = (lead >= 0) & (x[lead] - length[lead] <= x) & (np.abs(across[lead] - across) > BESIDE)
    lead[beside] = -1
    return _recording(source, kind, columns, names, vehicle, rows, x, lead, x[lead], y=across, lane=lane)


def _chains(source: str, lanelets: Sequence[Lanelet]) -> _Chains:
    """Chains of lanelets, in points 1 m apart.

    Each is continued by the first successor that is in no chain yet.
    """
    if not lanelets:
        raise RecordingError(f"{source}: no <lanelet>; a map of the lanes is expected")
    lines = {lanelet.id: centre_line(lanelet) for lanelet in lanelets}
    successors = {lanelet.id: lanelet.successors for lanelet in lanelets}
    followed = {name for after in successors.values() for name in after}
    free = dict.fromkeys(lines)
    parts = []
    # First from lanelets without predecessors; a loop has none, and begins anywhere.
    for name in [*(name for name in lines if name not in followed), *lines]:
        chain, at = len(parts), 0.0
        pieces = []
        while name in free:
            del free[name]
            line, width = lines[name]
            along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=-1))])
            fine = np.linspace(0, along[-1], max(int(along[-1]) + 1, 2))
            xy = np.stack([np.interp(fine, along, line[:, k]) for k in range(2)], -1)
            pieces.append((xy, at + fine, np.full(len(fine), chain), np.interp(fine, along, width / 2)))
            at += along[-1]
            name = next((after for after in successors[name] if after in free), "")
        if pieces:
            xy, s, chains, half = (np.concatenate(column) for column in zip(*pieces, strict=True))
            step = np.gradient(xy, axis=0)
            parts.append((xy, s, chains, half, np.arctan2(step[:, 1], step[:, 0])))
    return _Chains(*(np.concatenate(column) for column in zip(*parts, strict=True)))


__all__ = ["BESIDE", "REACH", "InPlane", "leaders_on_lanelets", "leaders_on_paths"]
