"""Checks of recordings: units that go together, and defects that real recordings have here and there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from limsim_jax.recordings.recording import (
    CAR,
    CAR_LENGTHS,
    FASTEST,
    FOOT,
    ROWS,
    Defect,
    Recording,
    RecordingError,
)

BACKWARDS = 0.5
"""m/s, recorded speeds below 0 by at most this are noise of a vehicle at rest."""

TOLERATED = 0.5
"""Share of the rows of followers that may have a leader behind or an overlap: more is a fault of the file."""

_HINTS = {
    3.281: "positions in feet",
    0.3048: "speeds in feet per second",
    0.2778: "speeds in km/h",
    10: "speeds per frame",
    0.1: "time in frames",
}
"""What it means if positions advance this many times as far as the speeds say."""


def checked(recording: Recording, tolerated: float = TOLERATED) -> Recording:
    """The recording with its defects.

    Args:
      recording: as read.
      tolerated: share of the rows of followers that may have a leader behind or an overlap.

    Raises:
      RecordingError: units are wrong, no vehicle follows another, or too many rows have defects.
    """
    if not 0 <= tolerated <= 1:
        raise RecordingError(f"tolerated: {tolerated:g}; a share within 0 and 1 is expected")
    _check_units(recording)
    defects = tuple(_defects(recording))
    recording = replace(recording, defects=defects)
    rows = int((recording.leader >= 0).sum())
    if not rows:
        raise RecordingError(
            f"{recording.source}: {recording.row} {recording.line[0]}: no vehicle follows another one"
        )
    found = [defect for defect in defects if defect.rows and defect.kind != "spacing"]
    bad = sum(defect.rows for defect in found)
    if bad > tolerated * rows:
        raise RecordingError(
            f"{recording.source}: {found[0].message}; so are {bad:,} of {rows:,} rows, and at most "
            f"{100 * tolerated:g} % are tolerated (tolerated, --tolerated)"
        )
    return recording


def check_rows(r: Recording) -> None:
    """Refuse rows of followers that cannot be: what no reader lets through.

    Raises:
      RecordingError: fields of unequal length, a value that is not finite, or times that do not grow.
    """
    for field in ROWS:
        if (count := len(getattr(r, field))) != len(r):
            raise RecordingError(
                f"{r.source}: {field} has {count} rows, time {len(r)}; equally many are expected"
            )
    finite = {name: np.isfinite(getattr(r, name)) for name in ("time", "x", "x_lead", "length_lead")}
    grows = np.diff(r.time, prepend=-np.inf) > 0
    grows |= np.diff(r.vehicle, prepend=-1) != 0
    for field, good, expected in (
        *((name, good, "a finite number") for name, good in finite.items()),
        ("time", grows, "a time after that of the row before"),
    ):
        bad = (r.leader >= 0) & ~good
        if bad.any():
            k = int(np.argmax(bad))
            raise RecordingError(
                f"{r.source}: {r.row} {r.line[k]}, column {r.columns.get(field, field)}: "
                f"'{getattr(r, field)[k]:g}'; {expected} is expected"
            )


def impossible(r: Recording, field: str) -> NDArray[np.bool_]:
    """Rows whose recorded speed no vehicle has; `field` is `v` or `v_lead`."""
    v = getattr(r, field)
    recorded = field in r.columns or r.kind != "table"  # others are derived from the positions
    return ((v < -BACKWARDS) | (v > FASTEST)) & recorded


def looks_like_feet(value: float, usual: float = 4.6) -> str:
    """A hint that a length is one in feet; `usual`: m."""
    return " (it looks like feet)" if 0.7 < value * FOOT / usual < 1.4 else ""


def _check_units(r: Recording) -> None:
    def refuse(row: int, field: str, message: str) -> NoReturn:
        raise RecordingError(
            f"{r.source}: {r.row} {r.line[row]}, column {r.columns.get(field, field)}: {message}"
        )

    for field in ("length", "length_lead"):
        cars = (r.vehicle_class == CAR) & np.isfinite(getattr(r, field))
        if field == "length_lead":  # whose class is that of its own rows
            cars &= r.leader >= 0
        if cars.any():
            middle = float(np.median(getattr(r, field)[cars]))
            if not CAR_LENGTHS[0] <= middle <= CAR_LENGTHS[1]:
                hint = (
                    " (it looks like metres where feet belong)"
                    if r.kind == "NGSIM" and middle < 2.2
                    else looks_like_feet(middle)
                )
                refuse(
                    int(np.argmax(cars)),
                    field,
                    f"cars are {middle:.1f} m long in the median{hint}; 3 to 7 m are expected",
                )
    for position, speed in (("x", "v"), ("x_lead", "v_lead")):
        x, v = getattr(r, position), getattr(r, speed)
        backwards = v < -BACKWARDS
        if np.mean(backwards) > 0.01:
            refuse(int(np.argmax(backwards)), speed, f"{v[backwards][0]:.2f} m/s; speeds are not negative")
        fast = float(np.nanquantile(v, 0.99)) if np.isfinite(v).any() else 0.0
        if fast > FASTEST:
            k = int(np.nanargmax(v))
            refuse(k, speed, f"{v[k]:.0f} m/s; at most {FASTEST:.0f} m/s are expected")
        if r.kind == "OpenACC" and position == "x_lead":
            continue  # these positions are integrals of the speeds
        step, odd = np.diff(r.time), impossible(r, speed)
        near = (
            (np.diff(r.vehicle) == 0)
            & (step < 1.5 * r.dt)
            & (np.diff(r.leader) == 0)
            & (np.diff(r.lane) == 0)
        )
        moved, driven = np.diff(x), 0.5 * (v[1:] + v[:-1]) * step
        # Positions against speeds, over rows where something moves.
        moving = near & (driven > 0.5 * r.dt) & np.isfinite(moved) & ~odd[1:] & ~odd[:-1]
        if moving.sum() >= 20:
            ratio = float(np.sum(moved[moving]) / np.sum(driven[moving]))
            if not 0.8 <= ratio <= 1.25:
                hint = next(
                    (f" (that is {text})" for k, text in _HINTS.items() if abs(ratio / k - 1) < 0.05), ""
                )
                refuse(
                    int(np.argmax(moving)) + 1,
                    position,
                    f"positions advance {ratio:.2f} times as far as the speeds in "
                    f"{r.columns.get(speed)} say{hint}; m and m/s are expected",
                )


def _defects(r: Recording) -> Iterator[Defect]:
    """Time that is missing, impossible speeds, leaders behind, bodies that overlap."""

    def column(field: str) -> str:
        return r.columns.get(field, field)

    step = np.diff(r.time)
    same = (np.diff(r.vehicle) == 0) & (r.leader[1:] >= 0) & (r.leader[:-1] == r.leader[1:])
    gapless = r.kind == "OpenACC"  # where missing values are part of the format
    for k in np.flatnonzero(same & (step > 1.5 * r.dt)) if not gapless else ():
        yield Defect(
            "time",
            r.names[r.vehicle[k]],
            int(r.line[k + 1]),
            0,
            f"{r.row} {r.line[k + 1]}, column {column('time')}: {step[k]:.1f} s are missing before this row "
            f"of vehicle {r.names[r.vehicle[k]]}; steps of {r.dt:g} s are expected",
        )
    following = r.leader >= 0
    for field in ("v", "v_lead"):
        v = getattr(r, field)
        for k in np.flatnonzero(following & impossible(r, field)):
            yield Defect(
                "speed",
                r.names[r.vehicle[k]],
                int(r.line[k]),
                1,
                f"{r.row} {r.line[k]}, column {column(field)}: {v[k]:g} m/s; 0 to {FASTEST:g} m/s "
                "are expected",
            )
    behind = following & (r.x_lead <= r.x)
    overlap = following & ~behind & (r.gap <= 0)
    for bad, kind in ((behind, "behind"), (overlap, "overlap")):
        first = bad & ~np.concatenate([[False], bad[:-1] & (np.diff(r.vehicle) == 0)])
        for k in np.flatnonzero(first):
            end = k + 1
            while end < len(bad) and bad[end] and r.vehicle[end] == r.vehicle[k]:
                end += 1
            name, leader = r.names[r.vehicle[k]], r.names[r.leader[k]]
            what = (
                f"leader {leader} is {r.x[k] - r.x_lead[k]:.1f} m behind its follower {name}; a leader ahead"
                if kind == "behind" and not gapless
                else f"{name} overlaps its leader {leader} by {-r.gap[k:end].min():.1f} m; a gap above 0"
            )
            field = "x_lead" if kind == "behind" and not gapless else "x"
            field = "gap" if "gap" in r.columns else field  # of a table that tells gaps
            yield Defect(
                "spacing" if gapless else kind,
                name,
                int(r.line[k]),
                int(end - k),
                f"{r.row} {r.line[k]}, column {column(field)}: {what} is expected",
            )


__all__ = ["BACKWARDS", "TOLERATED", "check_rows", "checked", "impossible", "looks_like_feet"]
