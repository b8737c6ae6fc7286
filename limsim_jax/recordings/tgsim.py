"""TGSIM: pairs of a leader and a follower along the road, in metres."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from limsim_jax.recordings.recording import CAR, Recording, build_recording
from limsim_jax.recordings.table import Table, numbered


def read_tgsim(table: Table) -> Recording:
    """Positions along the road; the length of the leader is what `spacing` leaves of their distance."""
    run = table.text("run_no")
    names, (vehicle, leader) = numbered(
        _joined("run ", run, " vehicle ", table.text("follower_id")),
        _joined("run ", run, " vehicle ", table.text("leader_id")),
    )
    columns = {
        "time": "timestamp",
        "x": "xFollowerReal",
        "v": "vFollowerReal",
        "a": "aFollowerReal",
        "x_lead": "xLeaderReal",
        "v_lead": "vLeaderReal",
        "length_lead": "spacing",
    }
    values: dict[str, Any] = {name: table.numbers(column) for name, column in columns.items()}
    values["length_lead"] = values["x_lead"] - values["x"] - values["length_lead"]
    values |= {
        "line": table.lines,
        "vehicle": vehicle,
        "leader": leader,
        "vehicle_class": np.full(len(table), CAR),
    }
    return build_recording(table.source, kind="TGSIM pairs", names=names, columns=columns, values=values)


def _joined(*parts: Any) -> NDArray[np.str_]:
    joined = parts[0]
    for part in parts[1:]:
        joined = np.char.add(joined, part)
    return np.char.strip(joined)


__all__ = ["read_tgsim"]
