"""Scenes as tables: `scenes_vehicles.csv` with the lanelets and their points in two tables beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from limsim_jax.maps import xml
from limsim_jax.recordings.lanelets import SPEED_LIMIT, Lanelet, lanelet_network
from limsim_jax.recordings.recording import Floats, Ints, RecordingError
from limsim_jax.recordings.table import Table, read_bytes
from limsim_jax.recordings.tracks import Rows, Tracks, tracks_from_rows


def read_scene_tables(
    path: Path, data: bytes, scenario: str | None = None, speed_limit: float = SPEED_LIMIT
) -> Tracks:
    """One scenario of the tables.

    Args:
      path: of the table of vehicles.
      data: its bytes.
      scenario: name; None if the table has only one.
      speed_limit: m/s, of all lanes.
    """
    table = Table.read(path, data)
    numbers = ("step", "t", "x", "y", "heading", "v", "length", "width")
    table.require("scenario", "vehicle_id", *numbers)
    scenarios = table.text("scenario")
    scenario = _chosen(table, scenario, list(dict.fromkeys(scenarios.tolist())))
    here = scenarios == scenario
    column = {name: table.numbers(name)[here] for name in numbers}
    line = table.lines[here]
    dt = _step(path, column["step"], column.pop("t"), line)
    rows = Rows(line=line, vehicle=table.text("vehicle_id")[here], **column)
    lanelets = _lanelets(path, scenario)
    network = lanelet_network(lanelets, scenario, str(path), xml.file_hash(data), speed_limit)
    return tracks_from_rows(path, scenario, dt, rows, network)


def _chosen(table: Table, scenario: str | None, known: list[str]) -> str:
    if scenario is None and len(known) == 1:
        return known[0]
    if scenario is None or scenario not in known:
        asked = "no scenario is named" if scenario is None else f"no scenario '{scenario}'"
        raise RecordingError(f"{table.source}: column scenario: {asked}; it has {', '.join(known)[:300]}")
    return scenario


def _step(path: Path, step: Floats, t: Floats, line: Ints) -> float:
    """Time step, s."""
    first, last = np.argmin(step), np.argmax(step)
    dt = (t[last] - t[first]) / max(step[last] - step[first], 1)
    wrong = np.abs(t - t[first] - (step - step[first]) * dt) > 1e-3
    if not 0 < dt <= 1 or wrong.any():
        k = int(np.argmax(wrong))
        raise RecordingError(
            f"{path}: line {int(line[k])}, column t: {t[k]:g} s at step {step[k]:g}; "
            "seconds that grow by one time step per step, at most 1 s, are expected"
        )
    return float(round(dt, 6))


def _lanelets(path: Path, scenario: str) -> list[Lanelet]:
    ending = path.name.split("_vehicles", 1)[-1]
    files = [path.with_name(f"scenes_{part}{ending}") for part in ("lanelets", "lanelet_points")]
    links, points = (Table.read(file, read_bytes(file)) for file in files)
    links.require("scenario", "lanelet_id", "left", "left_direction", "right", "right_direction")
    links.require("predecessors", "successors")
    points.require("scenario", "lanelet_id", "side", "index", "x", "y")
    side = points.text("side")
    for k in np.flatnonzero(~np.isin(side, ("left", "right")))[:1]:
        points.refuse("side", int(k), f"'{side[k]}'; left or right is expected")
    order = np.argsort(points.numbers("index"), kind="stable")
    order = order[points.text("scenario")[order] == scenario]
    xy = np.stack([points.numbers("x"), points.numbers("y")], -1)[order]
    owner, side = points.text("lanelet_id")[order], side[order]
    found = []
    names = ("lanelet_id", "left", "left_direction", "right", "right_direction", "predecessors", "successors")
    column = {name: links.text(name) for name in names}
    for k in np.flatnonzero(links.text("scenario") == scenario).tolist():
        row = {name: str(values[k]) for name, values in column.items()}
        bounds = []
        for which in ("left", "right"):
            bounds.append(xy[(owner == row["lanelet_id"]) & (side == which)])
            if len(bounds[-1]) < 2:
                links.refuse(
                    "lanelet_id",
                    k,
                    f"lanelet {row['lanelet_id']} has {len(bounds[-1])} points of its {which} bound in "
                    f"{files[1].name}; at least 2 are expected",
                )
        beside = [
            row[which] if row[which] and row[f"{which}_direction"] == "same" else None
            for which in ("left", "right")
        ]
        ends = [tuple(row[end].split()) for end in ("predecessors", "successors")]
        found.append(Lanelet(row["lanelet_id"], *bounds, *beside, *ends))
    return found


__all__ = ["read_scene_tables"]
