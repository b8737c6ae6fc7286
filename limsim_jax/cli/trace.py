"""Traces as files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from limsim_jax.maps.lane_map import LaneMap
    from limsim_jax.maps.network import Network
    from limsim_jax.rollout import Trace


def write_trace(path: Path, network: Network, lane_map: LaneMap, trace: Trace) -> None:
    """Every step as arrays (.npz) or one row per step and vehicle (.parquet); x, y as in the map file."""
    import numpy as np

    from limsim_jax.maps.lane_map import absolute, lane_ids

    x, y = absolute(lane_map, trace.box[..., 0], trace.box[..., 1])
    ids = np.array(lane_ids(network))
    slot = np.broadcast_to(np.arange(trace.active.shape[1]), trace.active.shape)
    columns = {
        "time": np.broadcast_to(trace.time[:, None], trace.active.shape),
        # those of the start have no row of the schedule: numbers below 0
        "vehicle": np.where(trace.vehicle < 0, -1 - slot, trace.vehicle),
        "slot": slot,
        "lane": trace.lane,
        **{name: getattr(trace, name) for name in ("s", "d", "v", "a")},
        "x": x,
        "y": y,
        "heading": trace.box[..., 2],
        "length": trace.box[..., 3],
        "width": trace.box[..., 4],
        "status": trace.status,
    }
    if path.suffix.lower() == ".npz":
        arrays = columns | {"time": trace.time, "active": trace.active, "phase": trace.phase, "lane_ids": ids}
        del arrays["slot"]
        with path.open("wb") as file:
            np.savez_compressed(file, **arrays)
        return
    import pyarrow  # pyright: ignore[reportMissingImports]
    import pyarrow.parquet  # pyright: ignore[reportMissingImports]

    rows = {name: np.ascontiguousarray(column[trace.active]) for name, column in columns.items()}
    rows["lane"] = ids[rows["lane"]]
    pyarrow.parquet.write_table(pyarrow.table(rows), path)
