"""inD and relatives (rounD, exiD, uniD): centres in a plane, no lanes."""

from __future__ import annotations

import numpy as np

from limsim_jax.recordings.leaders import InPlane, leaders_on_paths
from limsim_jax.recordings.levelx import read_meta
from limsim_jax.recordings.recording import CLASSES, Recording, RecordingError
from limsim_jax.recordings.table import Table


def read_ind(table: Table) -> Recording:
    """Motor vehicles; the leader is the next vehicle on the follower's own path."""
    meta = read_meta(table.source, "trackId")
    ident = table.numbers("trackId").astype(np.int64)
    kinds = meta.per_track(table, ident, "class")
    keep = np.isin(kinds, list(CLASSES))  # no pedestrians and bicycles
    if not keep.any():
        raise RecordingError(f"{table.source}: no motor vehicle among its tracks; tracksMeta has the classes")
    speed = "lonVelocity" if "lonVelocity" in table else "xVelocity"
    v = table.numbers(speed)
    if speed == "xVelocity":
        v = np.hypot(v, table.numbers("yVelocity"))
    columns = {
        "line": table.lines,
        "ident": ident,
        "time": table.numbers("frame") / meta.frame_rate,
        "x": table.numbers("xCenter"),
        "y": table.numbers("yCenter"),
        "heading": np.radians(table.numbers("heading")),
        "v": v,
        "length": table.numbers("length"),
        "vehicle_class": np.array([CLASSES.get(kind, -1) for kind in kinds]),
    }
    return leaders_on_paths(
        table.source,
        "inD",
        {"time": "frame", "x": "xCenter", "v": speed, "length": "length"},
        InPlane(**{name: column[keep] for name, column in columns.items()}),
        speed_limit=meta.speed_limit,
    )


__all__ = ["read_ind"]
