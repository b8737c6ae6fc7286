"""Followers and their leaders as one table, whatever file they come from. All numbers are SI."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps.lane_map import VEHICLE_CLASSES

FOOT = 0.3048
"""m."""

CAR, TRUCK, MOTORCYCLE = (VEHICLE_CLASSES.index(name) for name in ("car", "truck", "motorcycle"))
CLASSES = {
    "car": CAR,
    "truck": TRUCK,
    "truck_bus": TRUCK,
    "trailer": TRUCK,
    "van": VEHICLE_CLASSES.index("van"),
    "bus": VEHICLE_CLASSES.index("bus"),
    "motorcycle": MOTORCYCLE,
}
"""Names of motor vehicles in recordings, and their index into `VEHICLE_CLASSES`."""

CAR_LENGTHS = (3.0, 7.0)
"""m, the median length of the cars of a recording lies between these."""

FASTEST = 70.0
"""m/s, a recorded speed is at most this."""

STEPS = (0.01, 0.5)
"""s, bounds of the time step of a recording."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class RecordingError(ValueError):
    """A recording that cannot be used; one line that names file, line and column, and what is expected."""


@dataclass(frozen=True)
class Defect:
    """A flaw of a recording at one place."""

    kind: str  # "time", "speed", "overlap", "behind", "spacing"
    vehicle: str
    line: int  # of the file, the header being line 1
    rows: int  # that it concerns
    message: str


@dataclass(frozen=True, kw_only=True)
class Recording:
    """Rows `R`, one per vehicle and time, sorted by vehicle and time; NaN and -1: unknown or none."""

    source: str  # file
    kind: str
    human: bool  # followers are driven by humans
    dt: float  # s
    names: tuple[str, ...]  # of vehicles
    columns: Mapping[str, str]  # names in the file of the fields below
    row: str = "line"  # what a row is called in messages; of a table without lines "row"
    defects: tuple[Defect, ...] = ()
    speed_limit: float = math.nan  # m/s
    line: Ints  # of the file
    vehicle: Ints  # index into `names`
    time: Floats  # s
    x: Floats  # m, front bumper along the lane or path
    y: Floats  # m, across
    v: Floats  # m/s
    a: Floats  # m/s^2
    lane: Ints
    length: Floats  # m
    vehicle_class: Ints  # index into VEHICLE_CLASSES
    leader: Ints  # index into `names`
    x_lead: Floats  # m, front bumper, seen along the same lane or path as `x`
    v_lead: Floats  # m/s
    length_lead: Floats  # m

    @property
    def gap(self) -> Floats:
        """Bumper to bumper, m."""
        return self.x_lead - self.length_lead - self.x

    def __len__(self) -> int:
        return len(self.time)


Source = str | Path | Recording
"""Of recorded data: a file, or what was read from one."""

ROWS = ("line", "vehicle", "time", "x", "y", "v", "a", "lane", "length", "vehicle_class", "leader")
ROWS += ("x_lead", "v_lead", "length_lead")
"""Fields of a `Recording` that have one value per row."""


def build_recording(
    source: str | Path,
    *,
    kind: str,
    names: tuple[str, ...],
    columns: Mapping[str, str],
    values: Mapping[str, NDArray[Any]],
    human: bool = True,
    speed_limit: float = math.nan,
    row: str = "line",
) -> Recording:
    """A recording with its rows in order.

    Args:
      source: file.
      kind: of the file.
      names: of vehicles.
      columns: names in the file of the fields.
      values: of the `ROWS`, `[R]` each; missing ones are unknown.
      human: followers are driven by humans.
      speed_limit: m/s.
      row: what a row is called in messages.

    Raises:
      RecordingError: see `time_step`.
    """
    count = len(values["time"])
    unknown = {
        name: np.full(count, -1) if name in ("lane", "leader") else np.full(count, np.nan) for name in ROWS
    }
    rows = unknown | dict(values)
    order = np.lexsort((rows["time"], rows["vehicle"]))
    ordered: dict[str, Any] = {name: np.asarray(rows[name])[order] for name in ROWS}
    dt = time_step(source, columns["time"], ordered["time"], ordered["vehicle"], ordered["line"], row)
    return Recording(
        source=str(source), kind=kind, human=human, row=row, dt=dt, names=names, columns=columns,
        speed_limit=speed_limit, **ordered,
    )  # fmt: skip


def time_step(
    source: str | Path, column: str, time: Floats, vehicle: Ints, line: Ints, row: str = "line"
) -> float:
    """Time step of rows that are sorted by vehicle and time, s.

    Raises:
      RecordingError: a vehicle has a time twice, no vehicle has two rows, or the step is outside `STEPS`.
    """
    same = np.diff(vehicle) == 0
    steps = np.diff(time)
    twice = same & (steps < 1e-4)
    if twice.any():
        k = int(np.argmax(twice)) + 1
        raise RecordingError(
            f"{source}: {row} {max(line[k], line[k - 1])}, column {column}: this vehicle is at t = "
            f"{time[k]:.2f} s already in {row} {min(line[k], line[k - 1])}; one row per vehicle "
            "and time is expected"
        )
    if not same.any():
        raise RecordingError(f"{source}: {row} {line[0]}: no vehicle has two rows; trajectories are expected")
    dt = round(float(np.median(steps[same])), 5)
    if not STEPS[0] <= dt <= STEPS[1]:
        raise RecordingError(
            f"{source}: {row} {line[0]}, column {column}: steps of {dt:g} s; "
            f"{STEPS[0]:g} to {STEPS[1]:g} s are expected"
        )
    return dt


def with_leaders(recording: Recording, ident: Ints) -> Recording:
    """The recording with the states of its leaders.

    Args:
      recording: its `leader` has ids of the file, 0 for none.
      ident: id of the vehicle of each row, `[R]`.
    """
    r = recording
    tick = np.round(r.time / r.dt).astype(np.int64)
    width = int(tick.max() - min(tick.min(), 0)) + 2
    key = ident * width + tick - tick.min()
    order = np.argsort(key, kind="stable")
    wanted = r.leader * width + tick - tick.min()
    at = np.minimum(np.searchsorted(key[order], wanted), len(key) - 1)
    row = order[at]
    found = (r.leader > 0) & (key[row] == wanted)
    return replace(
        r,
        leader=np.where(found, r.vehicle[row], -1),
        x_lead=np.where(found, r.x[row], np.nan),
        v_lead=np.where(found, r.v[row], np.nan),
        length_lead=np.where(found, r.length[row], np.nan),
    )


__all__ = [
    "CAR",
    "CAR_LENGTHS",
    "CLASSES",
    "FASTEST",
    "FOOT",
    "MOTORCYCLE",
    "TRUCK",
    "Defect",
    "Recording",
    "RecordingError",
    "Source",
    "build_recording",
    "time_step",
    "with_leaders",
]
