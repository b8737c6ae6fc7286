"""A long table: a row per time and vehicle, every column with its unit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from limsim_jax.bridges.formats.motion import Body, Motion

COLUMNS: dict[str, tuple[str, str]] = {
    "time": ("s", "since the start of the episode"),
    "vehicle": ("", "ego, ego_1, ...: the egos; vehicle_N: came in later; start_N: was there at the start"),
    "ego": ("", "whether it is an ego"),
    "class": ("", "car, van, truck, bus, motorcycle or emergency"),
    "x": ("m", "middle of the body, coordinates of the map file"),
    "y": ("m", "middle of the body, coordinates of the map file"),
    "heading": ("rad", "counter-clockwise from the x axis, between -pi and pi"),
    "speed": ("m/s", "along the body"),
    "acceleration": ("m/s^2", "of the last step"),
    "lane": ("", "id in the map; null beside all lanes"),
    "s": ("m", "of the front bumper along the lane"),
    "d": ("m", "of the body from the centre of the lane, left is positive"),
    "length": ("m", "of the body"),
    "width": ("m", "of the body"),
}  # fmt: skip
"""Columns of the table: unit and meaning. Both are in the metadata of the Parquet fields."""


def table(motion: Motion) -> pa.Table:
    """The columns of `COLUMNS`, in the order of time; egos come first at each time."""
    parts = [_rows(motion, body) for body in motion.bodies]
    columns = {name: np.concatenate([part[name] for part in parts]) for name in COLUMNS}
    order = np.argsort(columns["time"], kind="stable")
    arrays = [pa.array(columns[name][order], from_pandas=True) for name in COLUMNS]
    fields = [
        pa.field(name, array.type, metadata={"unit": unit, "meaning": meaning})
        for array, (name, (unit, meaning)) in zip(arrays, COLUMNS.items(), strict=True)
    ]
    about = {"title": motion.title, "map": motion.network.source, "map_hash": motion.network.file_hash}
    return pa.table(arrays, schema=pa.schema(fields, metadata=about))


def parquet(motion: Motion) -> bytes:
    """The table as a Parquet file."""
    sink = pa.BufferOutputStream()
    pq.write_table(table(motion), sink, compression="zstd")
    return sink.getvalue().to_pybytes()


def _rows(motion: Motion, body: Body) -> dict[str, Any]:
    count = len(body.x)
    equal = {
        "vehicle": body.name, "ego": body.ego, "class": body.vehicle_class,
        "length": body.length, "width": body.width,
    }  # fmt: skip
    names = ("x", "y", "speed", "acceleration", "s", "d")
    return {
        "time": motion.time[body.first : body.last + 1],
        **{name: np.full(count, value) for name, value in equal.items()},
        **{name: getattr(body, name) for name in names},
        "heading": (body.heading + np.pi) % (2 * np.pi) - np.pi,
        "lane": np.array(body.lane, object),
    }


__all__ = ["COLUMNS", "parquet", "table"]
