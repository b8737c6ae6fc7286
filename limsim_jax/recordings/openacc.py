"""OpenACC: platoons by GNSS, with spacings bumper to bumper; missing values are empty."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps import xml
from limsim_jax.recordings.checks import looks_like_feet
from limsim_jax.recordings.lanelets import BEND, SAMPLE, SPEED_LIMIT, Lanelet, lanelet_network
from limsim_jax.recordings.recording import (
    CAR,
    CAR_LENGTHS,
    Floats,
    Recording,
    RecordingError,
    time_step,
)
from limsim_jax.recordings.table import Table, read_bytes
from limsim_jax.recordings.tracks import Rows, Tracks, tracks_from_rows

_CAR_SIZE = (4.5, 1.8)  # m, length and width, where a recording tells none
_LANE = 3.5  # m, width of a lane


@dataclass(frozen=True)
class OpenACC:
    """The facts before the header, and the table."""

    facts: Mapping[str, Sequence[str]]
    table: Table

    @classmethod
    def read(cls, path: Path, data: bytes) -> OpenACC:
        """Parse the bytes of a file. Raises `RecordingError` without a header or rows."""
        lines = data.decode("utf-8", "replace").splitlines()
        header = next((k for k, line in enumerate(lines[:20]) if line.startswith("Time,")), None)
        if header is None:
            raise RecordingError(
                f"{path}: no line starts with 'Time,'; the header of OpenACC is expected in line 6"
            )
        facts = {row[0]: row[1:] for row in csv.reader(lines[:header]) if row}
        return cls(facts, Table.read(path, data, header + 1))


def read_openacc(path: Path, data: bytes) -> Recording:
    """Each car behind the one ahead of it."""
    file = OpenACC.read(path, data)
    table = file.table
    order = file.facts.get("Vehicle_order", [])
    time = table.numbers("Time")
    human = ([*file.facts.get("ACC", []), "0"])[0].strip() == "0"
    spacings = sorted(int(name[3:]) for name in table.columns if re.fullmatch(r"IVS\d+", name))
    if not spacings:
        raise RecordingError(f"{path}: line {table.header}: no column IVS1, IVS2, ...; spacings are expected")
    parts = []
    for k in spacings:
        if f"Speed{k}" not in table or f"Speed{k + 1}" not in table:
            continue
        gap = table.numbers(f"IVS{k}", missing=True)
        v, lead = (table.numbers(f"Speed{j}", missing=True) for j in (k + 1, k))
        there = np.isfinite(gap) & np.isfinite(v) & np.isfinite(lead)
        if not there.any():
            continue
        length = _length(table, k, gap, there)
        # The Doppler speed of the leader carries the pair along; the spacing places the follower.
        travelled = np.zeros(len(time))
        speeds = np.where(np.isfinite(lead), lead, 0.0)
        travelled[1:] = np.cumsum(0.5 * (speeds[1:] + speeds[:-1]) * np.diff(time))
        x_lead = travelled + length
        name = [order[j - 1] if j <= len(order) else f"vehicle {j}" for j in (k + 1, k)]
        parts.append((k, there, name, travelled - gap, v, x_lead, lead, np.full(len(time), length)))
    if not parts:
        raise RecordingError(f"{path}: no spacing with the speeds of both its vehicles")
    names = tuple(dict.fromkeys(name for part in parts for name in part[2]))
    count = [int(part[1].sum()) for part in parts]

    def column(values: Sequence[NDArray[Any]]) -> NDArray[Any]:
        return np.concatenate([x[part[1]] for x, part in zip(values, parts, strict=True)])

    nothing = np.full(sum(count), np.nan)
    return Recording(
        source=str(path),
        kind="OpenACC",
        human=human,
        dt=time_step(path, "Time", time, np.zeros(len(time), np.int64), table.lines),
        names=names,
        columns={"time": "Time", "x": "IVS", "v": "Speed", "x_lead": "IVS", "v_lead": "Speed"},
        line=column([table.lines] * len(parts)).astype(np.int64),
        vehicle=np.repeat([names.index(part[2][0]) for part in parts], count),
        leader=np.repeat([names.index(part[2][1]) for part in parts], count),
        time=column([time] * len(parts)),
        x=column([part[3] for part in parts]),
        v=column([part[4] for part in parts]),
        y=nothing,
        a=nothing,
        lane=np.zeros(sum(count), np.int64),
        length=nothing,
        vehicle_class=np.full(sum(count), CAR),
        x_lead=column([part[5] for part in parts]),
        v_lead=column([part[6] for part in parts]),
        length_lead=column([part[7] for part in parts]),
    )


def _length(table: Table, k: int, gap: Floats, there: NDArray[np.bool_]) -> float:
    """Length of a car, m: what spacing `k` leaves of the distance between the antennas."""
    length = _CAR_SIZE[0]
    if all(f"{axis}{j}" in table for axis in "EN" for j in (k, k + 1)):
        ahead, behind = (
            np.stack([table.numbers(f"{axis}{j}", missing=True) for axis in "EN"]) for j in (k, k + 1)
        )
        apart = np.hypot(*(ahead - behind)) - gap
        length = float(np.median(apart[np.isfinite(apart)])) if np.isfinite(apart).any() else length
        if not CAR_LENGTHS[0] <= length <= CAR_LENGTHS[1]:
            table.refuse(
                f"IVS{k}",
                int(np.argmax(there)),
                f"spacing and positions leave {length:.1f} m for the length of a car"
                f"{looks_like_feet(length)}; 3 to 7 m are expected",
            )
    return length


def read_platoon(
    path: str | Path, start: float, seconds: float, *, speed_limit: float = SPEED_LIMIT
) -> Tracks:
    """A stretch of a recording: cars behind one another, and the one lane that they drive along.

    Such files have no lanes; the lane follows the way of the last car, then that of the first. Choose
    stretches in which no car comes by the same place twice.

    Args:
      path: the file.
      start: s from its first row.
      seconds: length of the stretch; cars whose record has a gap in it are left out.
      speed_limit: m/s.

    Raises:
      RecordingError: one line that names file, line and column, and what is expected.
    """
    path = Path(path)
    data = read_bytes(path)
    table = OpenACC.read(path, data).table
    cars = [name[5:] for name in table.columns if name.startswith("Speed")]
    table.require(*(f"{axis}{car}" for car in cars for axis in "EN"))
    time = table.numbers("Time", missing=True)
    dt = float(np.round(np.median(np.diff(time)), 6))
    rows = np.flatnonzero((time - time[0] >= start - 1e-6) & (time - time[0] < start + seconds - 1e-6))
    if len(rows) < max(2, seconds / dt - 1) or np.abs(np.diff(time[rows]) - dt).max() > 1e-3:
        last = time[-1] - time[0]
        raise RecordingError(
            f"{path}: column Time: {start:g} to {start + seconds:g} s has {len(rows)} rows; "
            f"steps of {dt:g} s without a gap, within 0 to {last:.0f} s, are expected"
        )
    tracks = {
        car: np.stack([table.numbers(f"{c}{car}", missing=True)[rows] for c in ("E", "N", "Speed")])
        for car in cars
    }
    tracks = {car: track for car, track in tracks.items() if np.isfinite(track).all()}
    if len(tracks) < 2:
        raise RecordingError(f"{path}: {len(tracks)} cars without a gap in this stretch; 2 are expected")
    count = len(tracks)
    x, y, v = (np.concatenate([track[k] for track in tracks.values()]) for k in range(3))
    size = np.full((count * len(rows), 2), _CAR_SIZE)
    found = Rows(
        line=np.tile(table.lines[rows], count),
        vehicle=np.repeat(list(tracks), len(rows)),
        step=np.tile(np.arange(len(rows), dtype=float), count),
        x=x,
        y=y,
        heading=np.concatenate([_course(*track[:2]) for track in tracks.values()]),
        v=np.maximum(v, 0.0),
        length=size[:, 0],
        width=size[:, 1],
    )
    first, last = (tracks[list(tracks)[k]][:2].T for k in (0, -1))
    name = f"{path.name.split('.')[0]}, {start:g} to {start + seconds:g} s"
    network = lanelet_network([_lane(first, last)], name, str(path), xml.file_hash(data), speed_limit)
    return tracks_from_rows(path, name, dt, found, network)


def _lane(first: Floats, last: Floats) -> Lanelet:
    """The lane along the last car, then the first, `[T 2]` each."""
    onward = int(np.argmin(np.linalg.norm(first - last[-1], axis=-1)))
    line = np.concatenate([last, first[onward + 1 :]])
    line = line[np.append(True, _forward(line))]
    line = np.concatenate([line, line[-1:] + (line[-1:] - line[-2:-1]) * 10])
    across = np.gradient(line, axis=0)
    across = np.stack([-across[:, 1], across[:, 0]], -1) / np.linalg.norm(across, axis=-1)[:, None]
    return Lanelet("lane", line + across * _LANE / 2, line - across * _LANE / 2)


def _course(x: Floats, y: Floats) -> Floats:
    """Heading of a body by its way over `BEND` m; a standing one keeps it."""
    way = np.append(0.0, np.cumsum(np.hypot(np.diff(x), np.diff(y))))
    grid, once = np.unique(way, return_index=True)
    ends = [np.clip(way + side * BEND / 2, 0, way[-1]) for side in (-1, 1)]
    (x0, y0), (x1, y1) = ((np.interp(end, grid, x[once]), np.interp(end, grid, y[once])) for end in ends)
    return np.unwrap(np.arctan2(y1 - y0, x1 - x0))


def _forward(line: Floats) -> NDArray[np.bool_]:
    """Points of a way that are `SAMPLE` m apart at least."""
    taken = np.zeros(len(line) - 1, bool)
    at = line[0]
    for k, point in enumerate(line[1:]):
        if np.linalg.norm(point - at) >= SAMPLE:
            taken[k], at = True, point
    return taken


__all__ = ["OpenACC", "read_openacc", "read_platoon"]
