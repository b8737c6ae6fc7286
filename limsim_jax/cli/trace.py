"""Traces as files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from limsim_jax.maps.lane_map import LaneMap
    from limsim_jax.maps.network import Network
    from limsim_jax.simulation.trace import Trace


def write_trace(path: Path, network: Network, lane_map: LaneMap, trace: Trace) -> None:
    """Every step as arrays (.npz) or one row per step and vehicle (.parquet); x, y as in the map file.

    Plans, `[T, E, H]` for the vehicles in the slots of `plan_slot`, are in arrays only.
    """
    import numpy as np

    from limsim_jax.maps.lane_map import VEHICLE_CLASSES, absolute, lane_ids

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
    ids_of = {"lane": ids}
    if trace.vehicle_class is not None:
        columns["vehicle_class"] = trace.vehicle_class
        ids_of["vehicle_class"] = np.array(VEHICLE_CLASSES)
    if trace.driven is not None:
        columns["driven"] = (slot[..., None] == trace.driven[:, None, :]).any(-1)
        if trace.to_go is not None:
            ego = slot == trace.driven[:, :1]
            columns["to_go"] = np.where(ego, trace.to_go[:, None], np.float32(np.nan))
    if path.suffix.lower() == ".npz":
        arrays: dict[str, Any] = columns | {"time": trace.time, "active": trace.active, "phase": trace.phase}
        arrays |= {f"{name}_ids": names for name, names in ids_of.items()}
        del arrays["slot"]
        if trace.plan is not None:
            plan = absolute(lane_map, trace.plan[..., 0], trace.plan[..., 1])
            arrays |= {"plan_x": plan[0], "plan_y": plan[1], "plan_time": trace.plan_time}
            arrays["plan_slot"] = trace.driven
        with path.open("wb") as file:
            np.savez_compressed(file, **arrays)
        return
    import pyarrow  # pyright: ignore[reportMissingImports]
    import pyarrow.parquet  # pyright: ignore[reportMissingImports]

    rows = {name: np.ascontiguousarray(column[trace.active]) for name, column in columns.items()}
    rows |= {name: names[rows[name]] for name, names in ids_of.items()}
    pyarrow.parquet.write_table(pyarrow.table(rows), path)
