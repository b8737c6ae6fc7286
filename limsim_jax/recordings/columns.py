"""Followers from a table of one's own: which of its columns is what, and in which unit.

| field | what | unit |
|---|---|---|
| `time` | time; steps of 0.01 to 0.5 s | s |
| `x`, `x_lead` | position of the follower and of its leader along the road, of the same point of both | m |
| `gap` | from bumper to bumper; instead of `x_lead`, or of both positions together with speeds | m |
| `v`, `v_lead` | speeds; where they are missing, those of the positions | m/s |
| `length_lead` | length of the leader; or one number for all of them | m |
| `id`, `id_lead` | names of follower and leader; without them all rows are of one pair | |

`time` and one of these are needed: `x` and `x_lead` with the length of the leader; `x` and `gap`; or `gap`,
`v` and `v_lead`. Columns that are named like a field need not be named again.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from limsim_jax.recordings.checks import TOLERATED, checked
from limsim_jax.recordings.recording import CAR, Floats, Ints, Recording, RecordingError, build_recording
from limsim_jax.recordings.table import Table, header_of, numbered, read_bytes

FIELDS = ("time", "x", "x_lead", "gap", "v", "v_lead", "length_lead", "id", "id_lead")
"""Of a table of one's own."""

UNITS = {
    "m": {"m": 1.0, "km": 1000.0, "cm": 0.01, "ft": 0.3048, "mi": 1609.344},
    "m/s": {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704, "ft/s": 0.3048},
    "s": {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0},
}
"""Known units by what they measure, and how many SI units they are."""

_QUANTITY = {"time": "s", "v": "m/s", "v_lead": "m/s"}  # all others are metres
_LENGTH = 4.5  # m, of leaders where it means nothing


def read_columns(
    data: Any,
    *,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    length: float | None = None,
    tolerated: float = TOLERATED,
) -> Recording:
    """A recording from a table of one's own.

    Args:
      data: path of a CSV or Parquet file, a table (pyarrow, pandas, polars), or a mapping of arrays by name.
      columns: column of each field, as in `{"time": "t", "x_lead": "leader", "x": "follower"}`.
      units: of fields whose unit is not that of the module: km, cm, ft, mi; km/h, mph, ft/s; ms, min, h.
        That of `x` holds for `x_lead` and that of `v` for `v_lead` if these have none of their own.
      length: m, of the leaders, if no column tells it.
      tolerated: share of the rows that may have a leader behind or an overlap; they are left out.

    Raises:
      RecordingError: one line with the row and column: a column is missing, a value is no finite number, or
        values are impossible (a leader behind its follower, a speed above 70 m/s, a time twice).
    """
    table = _table(data)
    names = _fields(table, dict(columns or {}))
    scale = _scales(table.source, dict(units or {}))
    if length is not None and not 1.0 <= length <= 30.0:
        raise RecordingError(f"length: {length:g} m; the length of the leaders, 1 to 30 m, is expected")

    def numbers(field: str) -> Floats | None:
        return table.numbers(names[field]) * scale[field] if field in names else None

    time, x, x_lead, gap, v, v_lead = map(numbers, ("time", "x", "x_lead", "gap", "v", "v_lead"))
    assert time is not None
    names_, (vehicle, leader) = _pairs(table, names)
    order = np.lexsort((time, vehicle))
    lengths = numbers("length_lead")
    if lengths is None:
        if length is None and x_lead is not None and gap is None:
            raise RecordingError(
                f"{table.source}: the length of the leaders is missing; length=4.5 (m, --length 4.5) or a "
                "column length_lead is expected"
            )
        lengths = np.full(len(table), _LENGTH if length is None else length)
    if x is None or (x_lead is None and gap is None):
        assert gap is not None and v is not None and v_lead is not None
        # The leader's speed carries the pair along; the gap places the follower.
        x_lead = _travelled(time, v_lead, vehicle, order) + lengths
        x = x_lead - lengths - gap
    elif gap is not None:
        x_lead = x + gap + lengths
    assert x_lead is not None
    v = _speed(table, names.get("x"), time, x, vehicle, order) if v is None else v
    column = names.get("x_lead")
    v_lead = _speed(table, column, time, x_lead, vehicle, order) if v_lead is None else v_lead
    recording = build_recording(
        table.source,
        kind="table",
        names=names_,
        columns=names,
        row=table.row,
        values={
            "line": table.lines, "vehicle": vehicle, "leader": leader, "time": time, "x": x, "v": v,
            "x_lead": x_lead, "v_lead": v_lead, "length_lead": lengths,
            "vehicle_class": np.full(len(table), CAR),
        },
    )  # fmt: skip
    return checked(recording, tolerated)


def has_fields(columns: list[str]) -> bool:
    """Whether columns are named like the fields that are needed."""
    known = {name.lower() for name in columns}
    return "time" in known and any(need <= known for need in _NEEDS)


_NEEDS = ({"x", "x_lead"}, {"x", "gap"}, {"gap", "v", "v_lead"})


def _table(data: Any) -> Table:
    if isinstance(data, (str, Path)):
        if Path(data).suffix.lower() in (".parquet", ".pq"):
            try:
                return Table(data, pq.read_table(data), None)
            except (OSError, pa.ArrowInvalid) as error:
                raise RecordingError(f"{data}: no Parquet file ({str(error).splitlines()[0]})") from None
        content = read_bytes(data)
        header_of(content)
        return Table.read(data, content)
    try:
        if isinstance(data, Mapping):
            data = {str(name): np.asarray(values) for name, values in data.items()}
        return Table("data", pa.table(data), None)
    except (pa.ArrowInvalid, pa.ArrowTypeError, TypeError, ValueError) as error:
        raise RecordingError(
            f"data: a path, a table (pyarrow, pandas) or a mapping of arrays of one length is expected, not "
            f"{type(data).__name__} ({str(error).splitlines()[0][:120]})"
        ) from None


def _fields(table: Table, columns: dict[str, str]) -> dict[str, str]:
    """Column of each field that there is."""
    for field in columns:
        if field not in FIELDS:
            raise RecordingError(f"columns: '{field}' is no field; known are {', '.join(FIELDS)}")
    for column in columns.values():
        table.require(column)
    taken = {column.lower() for column in columns.values()}
    found = {field: field for field in FIELDS if field in table and field not in taken} | columns
    if "time" not in found or not any(need <= set(found) for need in _NEEDS):
        missing = [field for field in ("time", "x", "x_lead") if field not in found]
        raise RecordingError(
            f"{table.source}: no column for {', '.join(missing)}; found are "
            f"{', '.join(table.columns)[:200]}; {example(table.columns)}"
        )
    return found


def example(columns: list[str]) -> str:
    """How to say which column of a file is what."""
    fields = dict(zip(("time", "x_lead", "x"), [*columns, "?", "?", "?"], strict=False))
    text = ",".join(f"{field}={column}" for field, column in fields.items())
    return f'say which is what, as in --columns "{text}" --length 4.5 (Python: columns={fields}, length=4.5)'


def _scales(source: str, units: dict[str, str]) -> dict[str, float]:
    for field, same in (("x_lead", "x"), ("v_lead", "v")):
        if same in units:
            units.setdefault(field, units[same])
    scale: dict[str, float] = dict.fromkeys(FIELDS, 1.0)
    for field, unit in units.items():
        if field not in FIELDS or field.startswith("id"):
            known = ", ".join(name for name in FIELDS if not name.startswith("id"))
            raise RecordingError(f"units: '{field}' is no field with a unit; known are {known}")
        known = UNITS[_QUANTITY.get(field, "m")]
        if unit not in known:
            raise RecordingError(
                f"{source}: units: {field} in '{unit}'; one of {', '.join(known)} is expected"
            )
        scale[field] = known[unit]
    return scale


def _pairs(table: Table, names: Mapping[str, str]) -> tuple[tuple[str, ...], list[Ints]]:
    """Names of all vehicles; follower and leader of each row."""
    count = len(table)
    follower = table.text(names["id"]) if "id" in names else np.full(count, "follower")
    if "id_lead" in names:
        leader = table.text(names["id_lead"])
    elif "id" in names:
        leader = np.char.add("leader of ", follower)
    else:
        leader = np.full(count, "leader")
    for field, values in (("id", follower), ("id_lead", leader)):
        if (values == "").any():
            table.refuse(names[field], int(np.argmax(values == "")), "no value; a name is expected")
    return numbered(follower, leader)


def _speed(table: Table, column: str | None, time: Floats, x: Floats, vehicle: Ints, order: Ints) -> Floats:
    """Speeds of positions, m/s, never negative."""
    v = np.zeros(len(x))
    for own in np.split(order, np.flatnonzero(np.diff(vehicle[order])) + 1):
        if len(own) < 2 or (np.diff(time[own]) <= 0).any():
            continue  # is refused as no trajectory, or as a time twice
        if x[own[-1]] < x[own[0]] - 1.0 and column is not None:
            table.refuse(
                column, int(own[-1]), "positions fall; positions that grow along the road are expected"
            )
        v[own] = np.maximum(np.gradient(x[own], time[own]), 0.0)
    return v


def _travelled(time: Floats, v: Floats, vehicle: Ints, order: Ints) -> Floats:
    """Way at these speeds since the first row of each vehicle, m."""
    way = np.zeros(len(v))
    for own in np.split(order, np.flatnonzero(np.diff(vehicle[order])) + 1):
        steps = 0.5 * (v[own][1:] + v[own][:-1]) * np.diff(time[own])
        way[own] = np.append(0.0, np.cumsum(steps))
    return way


__all__ = ["FIELDS", "UNITS", "example", "has_fields", "read_columns"]
