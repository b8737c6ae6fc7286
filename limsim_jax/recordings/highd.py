"""highD: boxes by their upper left corner, `width` along the road, two directions of travel."""

from __future__ import annotations

import numpy as np

from limsim_jax.recordings.levelx import classes_of, read_meta
from limsim_jax.recordings.recording import Recording, build_recording, with_leaders
from limsim_jax.recordings.table import Table, numbered


def read_highd(table: Table) -> Recording:
    """The tracks of a recording, with leaders as the file names them."""
    meta = read_meta(table.source, "id")
    frame, ident = table.numbers("frame"), table.numbers("id").astype(np.int64)
    direction = meta.per_track(table, ident, "drivingDirection").astype(float)
    forward = direction == 2  # 1: towards smaller x
    sign = np.where(forward, 1.0, -1.0)
    length = table.numbers("width")
    x = table.numbers("x") + np.where(forward, length, 0.0)
    kinds = meta.per_track(table, ident, "class")
    names, (vehicle,) = numbered(ident.astype(str))
    recording = build_recording(
        table.source,
        kind="highD",
        names=names,
        columns={"time": "frame", "x": "x", "v": "xVelocity", "length": "width", "leader": "precedingId"},
        speed_limit=meta.speed_limit,
        values={
            "line": table.lines,
            "vehicle": vehicle,
            "leader": table.numbers("precedingId").astype(np.int64),  # ids, for now
            "time": frame / meta.frame_rate,
            "x": sign * x,
            "y": sign * (table.numbers("y") + table.numbers("height") / 2),
            "v": sign * table.numbers("xVelocity"),
            "a": sign * table.numbers("xAcceleration"),
            "lane": table.numbers("laneId").astype(np.int64),
            "length": length,
            "vehicle_class": classes_of(table, kinds),
        },
    )
    return with_leaders(recording, np.array([int(name) for name in names])[recording.vehicle])


__all__ = ["read_highd"]
