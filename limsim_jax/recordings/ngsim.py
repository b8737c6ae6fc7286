"""NGSIM: as published, in feet, and the metric table of pairs of the I-80 recordings."""

from __future__ import annotations

from typing import Any

import numpy as np

from limsim_jax.recordings.recording import (
    CAR,
    FOOT,
    MOTORCYCLE,
    TRUCK,
    Floats,
    Ints,
    Recording,
    build_recording,
    with_leaders,
)
from limsim_jax.recordings.table import Table, numbered

FRAME = 0.1
"""s."""

_AGAIN = 60.0  # s of absence after which an id belongs to another vehicle


def read_pairs(table: Table) -> Recording:
    """The metric table of pairs, one row per follower and frame."""
    frame = table.numbers("frame_id")
    names, (vehicle, leader) = numbered(table.text("vehicle_id"), table.text("preceding"))
    columns = {
        "time": "frame_id",
        "x": "local_y",
        "v": "v_vel",
        "length": "v_length",
        "x_lead": "preceding_local_y",
        "v_lead": "preceding_vel",
        "length_lead": "preceding_length",
    }
    numbers: dict[str, Any] = {
        name: table.numbers(column) for name, column in columns.items() if name != "time"
    }
    values = numbers | {
        "line": table.lines,
        "vehicle": vehicle,
        "leader": leader,
        "time": frame * FRAME,
        "y": table.numbers("local_x"),
        "a": table.numbers("v_acc"),
        "lane": table.numbers("lane_id").astype(np.int64),
        "vehicle_class": _classes(table),
    }
    return build_recording(table.source, kind="NGSIM pairs", names=names, columns=columns, values=values)


def read_ngsim(table: Table) -> Recording:
    """As published: feet, frames of 0.1 s, ids that come again; `Location` must be one."""
    if "location" in table and len(set(table.text("location"))) > 1:
        places = ", ".join(sorted(set(table.text("location"))))
        table.refuse("location", 0, f"several sites in one file ({places}); one site is expected")
    ident, frame = table.numbers("vehicle_id"), table.numbers("frame_id")
    time = frame * FRAME
    if "global_time" in table:
        epoch = table.numbers("global_time") / 1000
        # of one vehicle id, seconds of both clocks agree but for a constant
        order = np.lexsort((frame, ident))
        same = np.diff(ident[order]) == 0
        drift = np.abs(np.diff(epoch[order]) - np.diff(time[order])) > 0.05
        # An id that comes again has both clocks jump; only a wrong unit makes most steps differ.
        if same.any() and np.mean(drift[same]) > 0.5:
            k = int(order[1:][same & drift][0])
            table.refuse("global_time", k, "disagrees with Frame_ID; milliseconds, 100 a frame, are expected")
    # An id may come again in another period of the survey: that is another vehicle.
    period = _periods(ident, time, limit=_AGAIN)
    vehicles = np.char.add(
        ident.astype(np.int64).astype(str), np.where(period > 0, np.char.add("/", period.astype(str)), "")
    )
    names, (vehicle,) = numbered(vehicles)
    columns = {"time": "frame_id", "x": "local_y", "v": "v_vel", "length": "v_length", "leader": "preceding"}
    recording = build_recording(
        table.source,
        kind="NGSIM",
        names=names,
        columns=columns,
        values={
            "line": table.lines,
            "vehicle": vehicle,
            "leader": table.numbers("preceding").astype(np.int64),  # ids, for now
            "time": time,
            "x": table.numbers("local_y") * FOOT,
            "y": table.numbers("local_x") * FOOT,
            "v": table.numbers("v_vel") * FOOT,
            "a": table.numbers("v_acc") * FOOT,
            "lane": table.numbers("lane_id").astype(np.int64),
            "length": table.numbers("v_length") * FOOT,
            "vehicle_class": _classes(table),
        },
    )
    ids = np.array([int(name.split("/")[0]) for name in names])[recording.vehicle]
    return with_leaders(recording, ids)


def _classes(table: Table) -> Ints:
    kind = table.numbers("v_class")
    for k in np.flatnonzero(~np.isin(kind, (1, 2, 3)))[:1]:
        table.refuse("v_class", int(k), f"{kind[k]:g}; 1 (motorcycle), 2 (car) or 3 (truck) is expected")
    return np.array([-1, MOTORCYCLE, CAR, TRUCK])[kind.astype(np.int64)]


def _periods(ident: Floats, time: Floats, limit: float) -> Ints:
    """How often each id was gone for over `limit` s before."""
    order = np.lexsort((time, ident))
    new = np.diff(ident[order], prepend=np.nan) != 0
    again = ~new & (np.diff(time[order], prepend=time[order][:1]) > limit)
    total = np.cumsum(again)
    first = np.maximum.accumulate(np.where(new, np.arange(len(order)), 0))
    period = np.empty(len(order), np.int64)
    period[order] = total - total[first]
    return period


__all__ = ["read_ngsim", "read_pairs"]
