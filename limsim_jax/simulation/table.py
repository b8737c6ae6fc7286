"""Traces as long tables: a row per time and vehicle."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from limsim_jax.maps.lane_map import VEHICLE_CLASSES, LaneMap, absolute, lane_ids
from limsim_jax.maps.network import Network
from limsim_jax.simulation.trace import Trace
from limsim_jax.types import Status


def trajectory_table(network: Network, lane_map: LaneMap, trace: Trace, **constants: Any) -> pa.Table:
    """A row per time and vehicle, in the order of time.

    Columns: time (s), vehicle (number; below 0: there at the start), slot, class, driven (by a policy),
    lane (id), s (m along the lane, front bumper), d (m, left of its centre), x, y (m, centre of the body,
    coordinates of the map file), heading (rad, counter-clockwise), v (m/s), a (m/s^2), length, width (m),
    status (bits of `types.Status`), collided; for egos to_go (m to the goal).

    Args:
      network, lane_map: the map of the trace.
      trace: of one world, NumPy, `[T, ...]`.
      constants: columns of one value that come first, such as the seed.
    """
    columns, ids = _columns(network, lane_map, trace)
    rows = {name: np.ascontiguousarray(column[trace.active]) for name, column in columns.items()}
    found = {name: ids[name][values] if name in ids else values for name, values in rows.items()}
    count = int(trace.active.sum())
    first = {name: pa.array([value] * count) for name, value in constants.items()}
    return pa.table(first | {name: pa.array(values) for name, values in found.items()})


def write_trace(path: Path, network: Network, lane_map: LaneMap, trace: Trace) -> None:
    """Every step as arrays (.npz) or as the table of `trajectory_table` (.parquet).

    Plans, `[T, E, H]` for the vehicles in the slots of `plan_slot`, are in arrays only.
    """
    if path.suffix.lower() != ".npz":
        pq.write_table(trajectory_table(network, lane_map, trace), path)
        return
    columns, ids = _columns(network, lane_map, trace)
    arrays: dict[str, Any] = columns | {"time": trace.time, "active": trace.active, "phase": trace.phase}
    arrays |= {f"{name}_ids": names for name, names in ids.items()}
    del arrays["slot"]
    if trace.plan is not None:
        plan = absolute(lane_map, trace.plan[..., 0], trace.plan[..., 1])
        arrays |= {"plan_x": plan[0], "plan_y": plan[1], "plan_time": trace.plan_time}
        arrays["plan_slot"] = trace.driven
    with path.open("wb") as file:
        np.savez_compressed(file, **arrays)


def _columns(
    network: Network, lane_map: LaneMap, trace: Trace
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Arrays `[T, N]` by name, and what some numbers stand for."""
    x, y = absolute(lane_map, trace.box[..., 0], trace.box[..., 1])
    slot = np.broadcast_to(np.arange(trace.active.shape[1]), trace.active.shape)
    columns: dict[str, Any] = {
        "time": np.broadcast_to(trace.time[:, None], trace.active.shape),
        # vehicles of the start have no row of the schedule: numbers below 0
        "vehicle": np.where(trace.vehicle < 0, -1 - slot, trace.vehicle),
        "slot": slot,
    }
    ids = {"lane": np.array(lane_ids(network))}
    if trace.vehicle_class is not None:
        columns["vehicle_class"] = trace.vehicle_class
        ids["vehicle_class"] = np.array(VEHICLE_CLASSES)
    driven = np.zeros_like(trace.active) if trace.driven is None else _is_driven(slot, trace.driven)
    columns |= {
        "driven": driven,
        "lane": trace.lane,
        "s": trace.s,
        "d": trace.d,
        "x": np.asarray(x),
        "y": np.asarray(y),
        "heading": trace.box[..., 2],
        "v": trace.v,
        "a": trace.a,
        "length": trace.box[..., 3],
        "width": trace.box[..., 4],
        "status": trace.status,
        "collided": (trace.status & int(Status.COLLIDED)) != 0,
    }
    if trace.driven is not None and trace.to_go is not None:
        ego = slot == trace.driven[:, :1]
        columns["to_go"] = np.where(ego, trace.to_go[:, None], np.float32(np.nan))
    return columns, ids


def _is_driven(slot: np.ndarray, driven: Any) -> np.ndarray:
    return (slot[..., None] == driven[:, None, :]).any(-1)
