"""Interactive replay of a trace: one HTML file for any browser, without a network or a server.

The file holds the map, the traffic and the plots as whole numbers (centimetres, 0.01 m/s, 0.1 mrad),
differences from step to step, deflated, in base64; `viewer.html` beside this module draws them. Text from
files is inside that block, too, so that nothing in it can be taken for HTML.

The fragment of the address chooses what is shown first: `replay.html#t=12.3&select=5&follow=1`.
"""

from __future__ import annotations

import base64
import json
import math
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from numpy.typing import ArrayLike, NDArray

from limsim_jax.files import write_whole
from limsim_jax.maps.lane_map import VEHICLE_CLASSES, LaneMap, absolute, lane_ids
from limsim_jax.maps.network import Network
from limsim_jax.maps.signal_table import SignalState
from limsim_jax.metrics.moments import RESPONSIBLE, value_text, words
from limsim_jax.report.frames import COLLIDED, DRIVEN, EGO, SIGNALS
from limsim_jax.report.strip import FilmLike
from limsim_jax.report.templates import read, render
from limsim_jax.report.viewer.answers import answer_rows
from limsim_jax.report.viewer.pack import Pack, held, origin
from limsim_jax.report.viewer.roads import add_map
from limsim_jax.report.viewer.sensed import add_sensed
from limsim_jax.report.viewer.traffic import add_driven, add_traffic
from limsim_jax.simulation.ending import ending, shown_steps
from limsim_jax.simulation.trace import Trace
from limsim_jax.types import Status

if TYPE_CHECKING:
    from limsim_jax.policies.language.store import Answer

SUFFIXES = (".html", ".htm")

MOMENT_COLORS = {
    "contact": "#d7191c", "off_road": "#8c510a", "red_light": "#c2185b", "near_miss": "#e66100",
    "hard_brake": "#b8860b", "unsafe": "#7b3fa0", "score_drop": "#2b7bba", "policy_failed": "#000000",
    "arrived": "#138a5e", "other": "#6b7683",
}  # fmt: skip
"""Colours of key moments by kind; "other" is for kinds that are not known here."""

_STATUS = {
    Status.COLLIDED: "collided",
    Status.OFF_ROAD: "was off the road",
    Status.WRONG_WAY: "drove the wrong way",
    Status.RED_LIGHT: "ran a red light",
    Status.MISSED_ROUTE: "missed its route",
    Status.NOT_FINITE: "numbers that are not finite",
    Status.HARD_BRAKE: "braked beyond its limit",
}


def write_viewer(
    path: str | Path,
    network: Network,
    lane_map: LaneMap,
    trace: Trace,
    *,
    ego: int | None = None,
    moments: Iterable[Mapping[str, Any]] = (),
    interest: ArrayLike | Sequence[tuple[float, ArrayLike]] | None = None,
    title: str = "",
    every: int = 1,
    sensors: FilmLike | None = None,
    answers: Iterable[Answer] = (),
) -> None:
    """Write a replay of a trace as one HTML file; whole or not at all.

    Times to collision are worked out here, once for all vehicles. 1-D: behind the next vehicle ahead on the
    lane and on those that follow it, as far as the trace shows where the vehicle drives on, or there is
    only one way. 2-D: of the boxes of any two vehicles that keep speed and heading.

    Args:
      path: file to write, .html.
      network: the map.
      lane_map: of that map.
      trace: `[T, ...]`, `N` slots. What follows a step at which its clock stands still is left out.
      ego: slot whose first vehicle is highlighted, and selected and followed at first. The replay ends 2 s
        after it has arrived or left. Its distance to the goal is shown if the trace has it. Other vehicles
        that the policy drives are outlined, and the plan
        of each is shown, in points 1 / 4 s apart, until its next decision.
      moments: what to mark on the time line: rows with `kind` and `time` (s) and, where known, `value`,
        `other` (slot), `responsible`, `module`, `rank` (1: the worst).
      interest: the area of interest: `[T, N]`, whether a vehicle is in it; or times (s), ascending, and
        polygons `[K, 2]`, x and y (m) in the coordinates of the lane map, each shown until the next one.
      title: at the top; the name of the map by default.
      every: steps of the trace per step of the replay.
      sensors: what the ego senses, a `Film`: its pictures, point clouds, bird's-eye views and object lists
        stand below the map, at each moment the last frame.
      answers: of a language model that drives the ego, each shown from its time on until the next one.

    Raises:
      ValueError: an unknown suffix, a trace that is empty or does not fit together or to the map, a slot
        that it does not have, a moment without kind or time, or other input that makes no sense.
      OSError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"cannot write '{path}': use .html")
    if every < 1:
        raise ValueError(f"every {every} steps: at least 1")
    kept = _check_trace(network, lane_map, trace)
    steps, slots = trace.active.shape
    if ego is not None:
        _check_slot(ego, slots, "ego")
    inside, polygons = _check_interest(interest, steps, slots)
    trace = jax.device_get(trace)
    time = np.asarray(trace.time, float)[:kept]
    rows = [_moment(row, i, time, slots) for i, row in enumerate(moments)]
    fields: Any = [None if x is None else x[:kept] for x in trace]
    end = None if ego is None else ending(Trace(*fields), ego)
    gone = None
    if end is not None:
        if end.arrived:
            gone = round(float(time[end.step + 1]), 4)  # the step in which it has left
            rows.append(_moment({"kind": "arrived", "time": gone}, len(rows), time, slots))
        kept = shown_steps(time, end, np.array([row["time"] for row in rows]))
    chosen = np.arange(0, kept, every)
    shown: Any = jax.tree.map(lambda x: np.asarray(x)[chosen], trace)

    pack = Pack()
    meta = {
        "title": title or network.name or Path(network.source).stem,
        "map": Path(network.source).name,
        "ego": None if ego is None else int(ego),
        "arrived": gone,
        "slots": slots,
        "steps": len(chosen),
        "moments": sorted(rows, key=lambda row: row["time"]),
        "interest": _polygons(pack, lane_map, polygons),
        "answers": answer_rows(answers),
        "classes": VEHICLE_CLASSES,
        "status": {int(bit): text for bit, text in _STATUS.items()},
        "colors": {
            "ego": EGO,
            "driven": DRIVEN,
            "collided": COLLIDED,
            "signals": [SIGNALS[state] for state in SignalState],
        },
    }
    add_traffic(pack, lane_map, shown)
    if inside is not None:
        pack.add("inside", held(inside[chosen], shown.active).T, 1)
    meta["plan"] = add_driven(pack, lane_map, shown, ego)
    meta["network"] = add_map(pack, network, lane_map, shown.phase)
    meta["sense"] = None if sensors is None else add_sensed(pack, lane_map, sensors)
    _write(path, meta, pack)


def _write(path: Path, meta: dict[str, Any], pack: Pack) -> None:
    head = json.dumps(
        meta | {"columns": pack.columns, "blocks": pack.blocks}, separators=(",", ":"), allow_nan=False
    ).encode()
    block = zlib.compress(len(head).to_bytes(4, "little") + head + b"".join(pack.parts), 6)
    page = render(
        "viewer/viewer.html.j2",
        title=meta["title"],
        data=base64.b64encode(block).decode(),
        style=read("viewer/viewer.css") + read("viewer/answers.css"),
        script=read("viewer/viewer.js")
        + read("viewer/scene.js")
        + read("viewer/sense.js")
        + read("viewer/answers.js")
        + read("viewer/panel.js"),
    )
    write_whole(path, page)


# --- what comes in -----------------------------------------------------------------------------------


def _check_trace(network: Network, lane_map: LaneMap, trace: Trace) -> int:
    """The number of steps before the clock stands still; raises `ValueError`."""
    time = np.asarray(trace.time)
    if time.ndim != 1 or not time.size:
        raise ValueError("the trace is empty" if time.ndim else "the trace has no axis of time")
    steps, slots = len(time), np.shape(trace.active)[-1]
    lanes, programs = len(lane_ids(network)), lane_map.signals.duration.shape[0]
    rows = 0 if trace.driven is None else np.shape(trace.driven)[-1]
    moments = 0 if trace.plan_time is None else np.shape(trace.plan_time)[-1]
    wanted = {"time": (steps,), "phase": (steps, programs), "box": (steps, slots, 5),
              "driven": (steps, rows), "to_go": (steps,), "plan": (steps, rows, moments, 2),
              "plan_time": (steps, moments)}  # fmt: skip
    for name, x in trace._asdict().items():
        if x is None:
            continue
        shape = wanted.get(name, (steps, slots))
        if np.shape(x) != shape:
            reason = "another map" if name == "phase" and np.shape(x)[:1] == (steps,) else "another trace"
            raise ValueError(f"{name} of shape {np.shape(x)} instead of {shape}: it is of {reason}")
    on = np.asarray(trace.lane)[np.asarray(trace.active)]
    if on.size and on.max() >= lanes:
        raise ValueError(f"a vehicle is on lane {on.max()}; the map has lanes 0 to {lanes - 1}: another map?")
    if trace.vehicle_class is not None:
        classes = np.asarray(trace.vehicle_class)[np.asarray(trace.active)]
        if classes.size and not 0 <= classes.min() <= classes.max() < len(VEHICLE_CLASSES):
            raise ValueError(
                f"classes from {classes.min()} to {classes.max()}; they are 0 to {len(VEHICLE_CLASSES) - 1}"
            )
    driven = np.zeros(0) if trace.driven is None else np.asarray(trace.driven)
    if driven.size and not -1 <= driven.min() <= driven.max() < slots:
        raise ValueError(f"driven: slots beyond those of the trace, 0 to {slots - 1}")
    if trace.plan is not None and moments < 2:
        raise ValueError(f"plan of {moments} moments; it takes 2 or more")
    if not np.isfinite(time).all():
        raise ValueError("the trace has times that are not finite")
    stands = np.flatnonzero(np.diff(time) <= 0)
    return int(stands[0]) + 1 if stands.size else steps


def _check_slot(slot: int, slots: int, name: str) -> None:
    if not 0 <= slot < slots:
        raise ValueError(f"{name} {slot}: the trace has slots 0 to {slots - 1}")


def _check_interest(interest: Any, steps: int, slots: int) -> tuple[NDArray[np.int64] | None, Any]:
    """Slots inside `[T, N]`, or polygons."""
    if interest is None or not hasattr(interest, "shape"):
        return None, interest
    if interest.shape != (steps, slots):
        raise ValueError(f"interest of shape {interest.shape}; the trace has {(steps, slots)}")
    return np.asarray(interest).astype(bool).astype(np.int64), None


def _moment(row: Mapping[str, Any], i: int, time: NDArray[np.float64], slots: int) -> dict[str, Any]:
    """A moment as the page shows it."""

    def number(name: str) -> float | None:
        value = row.get(name)
        return None if value is None or not math.isfinite(value) else float(value)

    at, kind = number("time"), row.get("kind")
    if at is None or kind is None:
        raise ValueError(f"moment {i} has no {'time' if at is None else 'kind'}: {dict(row)}")
    step = time[1] - time[0] if len(time) > 1 else 1.0
    if not min(0.0, time[0]) <= at <= time[-1] + step:
        raise ValueError(f"moment {i} ({kind}) is at {at:g} s; the trace goes to {time[-1]:g} s")
    value, other, rank = number("value"), number("other"), number("rank")
    if other is not None and other < 0:
        other = None
    if other is not None:
        _check_slot(int(other), slots, f"moment {i} ({kind}): other vehicle")
    responsible, module = row.get("responsible"), row.get("module")
    return {
        "time": float(np.clip(at, time[0], time[-1])),
        "color": MOMENT_COLORS.get(kind, MOMENT_COLORS["other"]),
        "label": words(str(kind)),
        "value": None if value is None else value_text(kind, value),
        "other": None if other is None else int(other),
        "rank": None if rank is None else int(rank),
        "who": None if responsible in (None, "none") else RESPONSIBLE.get(responsible, str(responsible)),
        "module": None if module is None else str(module),
    }


def _polygons(pack: Pack, lane_map: LaneMap, polygons: Any) -> Any:
    """Add polygons that begin to be shown at their times; returns times and numbers of points."""
    if polygons is None:
        return None
    times, counts, points = [], [], [np.zeros((0, 2))]
    for i, (at, line) in enumerate(polygons):
        line, name = np.asarray(line, float), f"polygon of interest {i}"
        if line.ndim != 2 or line.shape[1] != 2 or len(line) < 3:
            raise ValueError(f"{name} of shape {line.shape}; it takes 3 or more points x, y")
        if not (math.isfinite(at) and np.isfinite(line).all()):
            raise ValueError(f"{name} has numbers that are not finite")
        if times and at < times[-1]:
            raise ValueError(f"{name} is at {at:g} s, before the one at {times[-1]:g} s")
        times.append(float(at))
        counts.append(len(line))
        points.append(np.stack(absolute(lane_map, line[:, 0], line[:, 1]), -1))
    pack.add_points("interest", np.concatenate(points), origin(lane_map))
    return {"time": times, "count": counts}
