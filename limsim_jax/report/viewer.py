"""Interactive replay of a trace: one HTML file for any browser, without a network or a server.

The file holds the map, the traffic and the plots as whole numbers (centimetres, 0.01 m/s, 0.1 mrad),
differences from step to step, deflated, in base64; `viewer.html` beside this module draws them. Text from
files is inside that block, too, so that nothing in it can be taken for HTML.

The fragment of the address chooses what is shown first: `replay.html#t=12.3&select=5&follow=1`.
"""

from __future__ import annotations

import base64
import html
import json
import math
import re
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike, NDArray

from limsim_jax.files import write_whole
from limsim_jax.maps.lane_map import NO_LANE, VEHICLE_CLASSES, LaneMap, absolute, lane_ids
from limsim_jax.maps.network import Network
from limsim_jax.maps.outline import (
    SURFACES,
    Outline,
    crosswalk_stripes,
    held_ends,
    levels,
    marks,
    outlines,
    signal_bars,
    surface,
    surface_rank,
    view,
)
from limsim_jax.maps.signals import SignalState, lane_states
from limsim_jax.metrics.safety import NO_GAP, NONE, encounter, ttc_1d, ttc_2d
from limsim_jax.report.video import COLLIDED, EGO, SIGNALS
from limsim_jax.simulation.trace import Trace
from limsim_jax.types import Status

LOOK_AHEAD = 150.0
"""m: a leader further away is none."""

LONGEST_TTC = 60.0
"""s: a longer time to collision is shown as none."""

SUFFIXES = (".html", ".htm")

DRIVEN = "#ff7a00"
"""Colour of vehicles around the ego that the policy drives, and of their plans."""

# A kind of moment in words, and how its value reads: not at all where it would need an explanation.
_MOMENTS = {
    "contact": ("contact", "delta-v {:.2f} m/s"),
    "near_miss": ("near miss", "TTC {:.2f} s"),
    "hard_brake": ("hard braking", "{:.2f} m/s²"),
    "off_road": ("off the road", ""),
    "red_light": ("red light run", ""),
    "unsafe": ("unsafe distance (RSS)", ""),
    "score_drop": ("drop of the score", "{:.3g}"),
}
_RESPONSIBLE = {
    "ego": "the ego",
    "other": "the other vehicle",
    "shared": "both",
    "unavoidable": "nobody (unavoidable)",
}
_STATUS = {
    Status.COLLIDED: "collided",
    Status.OFF_ROAD: "was off the road",
    Status.WRONG_WAY: "drove the wrong way",
    Status.RED_LIGHT: "ran a red light",
    Status.MISSED_ROUTE: "missed its route",
    Status.NOT_FINITE: "numbers that are not finite",
    Status.HARD_BRAKE: "braked beyond its limit",
}
_THIN = 0.03  # m, a drawn border may deviate from its lane's by this
_DOUBLE = 0.12  # m, from a border to each line of a double mark
_AHEAD_LANES = 5  # lanes on which a leader is looked for
_PLAN_POINTS = 4  # of a plan per second: a chord of a bend is 0.1 m off at most at 10 m/s and r = 10 m
_PAIRS = 2**18  # pairs of vehicles measured at once


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
      ego: slot whose first vehicle is highlighted, and selected and followed at first. Its distance to the
        goal is shown if the trace has it. Other vehicles that the policy drives are outlined, and the plan
        of each is shown, in points 1 / 4 s apart, until its next decision.
      moments: what to mark on the time line: rows with `kind` and `time` (s) and, where known, `value`,
        `other` (slot), `responsible`, `module`, `rank` (1: the worst).
      interest: the area of interest: `[T, N]`, whether a vehicle is in it; or times (s), ascending, and
        polygons `[K, 2]`, x and y (m) in the coordinates of the lane map, each shown until the next one.
      title: at the top; the name of the map by default.
      every: keep one of so many steps.

    Raises:
      ValueError: an unknown suffix, a trace that is empty or does not fit together or to the map, a slot
        that it does not have, a moment without kind or time, or other input that makes no sense.
      OSError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"cannot write '{path}': use .html")
    if every < 1:
        raise ValueError(f"every {every} steps? at least 1")
    kept = _check_trace(network, lane_map, trace)
    steps, slots = trace.active.shape
    if ego is not None:
        _check_slot(ego, slots, "ego")
    inside, polygons = _check_interest(interest, steps, slots)
    chosen = np.arange(0, kept, every)
    shown: Any = jax.tree.map(lambda x: np.asarray(x)[chosen], jax.device_get(trace))
    time = shown.time.astype(float)
    rows = [_moment(row, i, time, slots) for i, row in enumerate(moments)]

    pack = _Pack()
    meta = {
        "title": title or network.name or Path(network.source).stem,
        "map": Path(network.source).name,
        "ego": None if ego is None else int(ego),
        "slots": slots,
        "steps": len(chosen),
        "moments": sorted(rows, key=lambda row: row["time"]),
        "interest": _polygons(pack, lane_map, polygons),
        "classes": VEHICLE_CLASSES,
        "status": {int(bit): text for bit, text in _STATUS.items()},
        "colors": {
            "ego": EGO,
            "driven": DRIVEN,
            "collided": COLLIDED,
            "signals": [SIGNALS[state] for state in SignalState],
        },
    }
    _add_traffic(pack, lane_map, shown)
    if inside is not None:
        pack.add("inside", _held(inside[chosen], shown.active).T, 1)
    meta["plan"] = _add_driven(pack, lane_map, shown, ego)
    meta["network"] = _add_map(pack, network, lane_map, shown.phase)
    _write(path, meta, pack)


def _write(path: Path, meta: dict[str, Any], pack: _Pack) -> None:
    head = json.dumps(meta | {"columns": pack.columns}, separators=(",", ":"), allow_nan=False).encode()
    block = zlib.compress(len(head).to_bytes(4, "little") + head + b"".join(pack.parts), 9)
    parts = {"TITLE": html.escape(meta["title"]), "DATA": base64.b64encode(block).decode()}
    template = Path(__file__).with_name("viewer.html").read_text("utf-8")
    page = re.sub("{{(TITLE|DATA)}}", lambda found: parts[found[1]], template)
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
            raise ValueError(f"{name} of shape {np.shape(x)} instead of {shape}: of {reason}?")
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
        raise ValueError(f"{name} {slot}? the trace has slots 0 to {slots - 1}")


def _check_interest(interest: Any, steps: int, slots: int) -> tuple[NDArray[np.int64] | None, Any]:
    """Slots inside `[T, N]`, or else polygons."""
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
    label, reads = _MOMENTS.get(kind, (str(kind).replace("_", " "), "{:.3g}"))
    value, other, rank = number("value"), number("other"), number("rank")
    if other is not None and other < 0:
        other = None
    if other is not None:
        _check_slot(int(other), slots, f"moment {i} ({kind}): other vehicle")
    responsible, module = row.get("responsible"), row.get("module")
    return {
        "time": float(np.clip(at, time[0], time[-1])),
        "kind": kind if kind in _MOMENTS else "other",
        "label": label,
        "value": None if value is None else reads.format(value),
        "other": None if other is None else int(other),
        "rank": None if rank is None else int(rank),
        "who": None if responsible in (None, "none") else _RESPONSIBLE.get(responsible, str(responsible)),
        "module": None if module is None else str(module),
    }


def _polygons(pack: _Pack, lane_map: LaneMap, polygons: Any) -> Any:
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
    pack.add_points("interest", np.concatenate(points), _shift(lane_map))
    return {"time": times, "count": counts}


# --- numbers -----------------------------------------------------------------------------------------


class _Pack:
    """Columns of whole numbers, as differences along their rows with the signs in the last bit.

    The four bytes of the numbers lie in four planes: the upper ones are almost all 0 and vanish in
    deflate.
    """

    def __init__(self) -> None:
        self.columns: dict[str, list[int]] = {}  # offset (bytes), numbers, numbers per row, scale
        self.parts: list[bytes] = []
        self.size = 0

    def add(self, name: str, values: ArrayLike, scale: int) -> None:
        """Add `[..., K]`, rounded to 1 / `scale`."""
        values = np.atleast_1d(np.asarray(values, np.float64))
        whole = np.round(np.clip(values * scale, -(2**30), 2**30)).astype(np.int64)
        delta = np.diff(whole, axis=-1, prepend=0)
        unsigned = ((delta << 1) ^ (delta >> 63)).astype("<u4").reshape(-1)
        self.columns[name] = [self.size, unsigned.size, whole.shape[-1], scale]
        self.parts.append(unsigned.view(np.uint8).reshape(-1, 4).T.tobytes())
        self.size += len(self.parts[-1])

    def add_points(self, name: str, xy: NDArray[np.float64], shift: NDArray[np.float64]) -> None:
        """Add points `[K, 2]` in file coordinates, to the centimetre, as `name`_x and `name`_y."""
        for axis, letter in enumerate("xy"):
            self.add(f"{name}_{letter}", xy[:, axis] - shift[axis], 100)


def _shift(lane_map: LaneMap) -> NDArray[np.float64]:
    return np.asarray(lane_map.origin, np.float64)


def _held(x: NDArray[Any], valid: NDArray[np.bool_]) -> NDArray[Any]:
    """`x [T, N]` where it is valid; elsewhere the last valid value, which costs no bytes."""
    steps = np.arange(len(x))[:, None]
    last = np.maximum.accumulate(np.where(valid, steps, -1))
    return np.where(last >= 0, np.take_along_axis(x, np.maximum(last, 0), 0), 0)


def _add_traffic(pack: _Pack, lane_map: LaneMap, trace: Any) -> None:
    """Add a trace of NumPy arrays, and what is worked out from it."""
    active = trace.active
    finite = active & np.isfinite(trace.box).all(-1) & np.isfinite(trace.v) & np.isfinite(trace.s)
    x, y, heading, length, width = np.moveaxis(trace.box.astype(float), -1, 0)
    lead, gap, ttc, soonest, other = _measure(lane_map, trace, finite)

    pack.add("time", trace.time.astype(float)[None], 10_000)
    # 0: nobody, 1: there at the start, 2 and more: row of the schedule
    pack.add("vehicle", np.where(active, trace.vehicle + 2, 0).T, 1)
    columns: dict[str, tuple[NDArray[Any], int]] = {
        "x": (x, 100), "y": (y, 100), "heading": (heading, 10_000), "length": (length, 100),
        "width": (width, 100), "v": (trace.v, 100), "a": (trace.a, 100), "s": (trace.s, 100),
        "d": (trace.d, 100), "lane": (trace.lane, 1), "status": (trace.status, 1), "lead": (lead, 1),
        "gap": (np.where(lead >= 0, gap, 0), 100), "ttc": (_shown(ttc), 100),
        "soonest": (_shown(soonest), 100), "soonest_of": (np.where(soonest < LONGEST_TTC, other, -1), 1),
    }  # fmt: skip
    for name, (values, scale) in columns.items():
        known = finite & np.isfinite(values)
        pack.add(name, _held(values, known).T, scale)


def _add_driven(pack: _Pack, lane_map: LaneMap, trace: Any, ego: int | None) -> Any:
    """Add vehicle classes, whom the policy drives, what it plans and how far the ego has to go.

    Returns the rows and points of plans, and the points per second. A plan is stored when it is made.
    """
    if trace.vehicle_class is not None:
        pack.add("class", _held(trace.vehicle_class, trace.active).T, 1)
    if trace.driven is None or not trace.driven.shape[1]:
        return None
    pack.add("driven", trace.driven.T, 1)
    if trace.to_go is not None and ego is not None and trace.driven[0, 0] == ego:
        known = np.isfinite(trace.to_go)
        pack.add("to_go", np.where(known, trace.to_go, -1)[None], 100)
    if trace.plan is None:
        return None
    plan, time = trace.plan.astype(float), trace.plan_time.astype(float)  # [T, E, H, 2], [T, H]
    there = np.isfinite(plan).all((-1, -2)) & (trace.driven >= 0)
    if not there.any():
        return None
    new = there.copy()
    same = (plan[1:] == plan[:-1]).all((-1, -2)) & (trace.driven[1:] == trace.driven[:-1])
    new[1:] &= ~(same & (time[1:, :1] == time[:-1, :1]))
    number = np.cumsum(new).reshape(new.shape) - 1  # of those made until then, by any row
    step = np.maximum.accumulate(np.where(new, np.arange(len(new))[:, None], -1))
    number = np.where(there, np.take_along_axis(number, np.maximum(step, 0), 0), -1)
    pack.add("plan_of", number.T, 1)

    between = (time[0, -1] - time[0, 0]) / (plan.shape[2] - 1)  # s
    count = max(2, math.floor((plan.shape[2] - 1) * between * _PLAN_POINTS + 1e-3) + 1)
    at = np.minimum(np.arange(count) / (_PLAN_POINTS * between), plan.shape[2] - 1)
    k = np.minimum(at.astype(int), plan.shape[2] - 2)
    made = plan[new]
    xy = made[:, k] + (at - k)[:, None] * (made[:, k + 1] - made[:, k])
    for axis, letter in enumerate("xy"):
        pack.add(
            f"plan_{letter}", absolute(lane_map, xy[..., 0], xy[..., 1])[axis] - _shift(lane_map)[axis], 100
        )
    return {"points": count, "per_second": _PLAN_POINTS}


def _shown(ttc: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.where(ttc < LONGEST_TTC, ttc, np.float32(-1))


# --- leaders and times to collision ------------------------------------------------------------------


def _measure(lane_map: LaneMap, trace: Any, valid: NDArray[np.bool_]) -> tuple[NDArray[Any], ...]:
    """Per vehicle `[T, N]`: leader, gap, 1-D TTC, least 2-D TTC and with whom (-1, `NO_GAP`, `NONE`)."""
    steps, slots = valid.shape
    lane, start = _way_ahead(lane_map, trace, valid)
    size = max(1, min(64, _PAIRS // slots**2))  # steps at once, the same for all traces with these slots
    found = []
    for k in range(0, steps, size):
        part = slice(k, min(k + size, steps))
        lead, gap = _leaders(trace.s[part], trace.box[part, :, 3], valid[part], lane[part], start[part])
        lead_v = np.where(lead >= 0, np.take_along_axis(trace.v[part], np.maximum(lead, 0), 1), 0)
        arrays = [trace.box[part], trace.v[part], valid[part], gap, lead_v]
        spare = size - (part.stop - k)
        arrays = [np.pad(x, [(0, spare)] + [(0, 0)] * (x.ndim - 1)) for x in arrays]
        arrays = [x if x.dtype == bool else np.nan_to_num(x).astype(np.float32) for x in arrays]
        times = [np.asarray(x)[: part.stop - k] for x in _times(*arrays)]
        found.append((lead, gap, *times))
    return tuple(np.concatenate(x) for x in zip(*found, strict=True))


@jax.jit
def _times(
    box: Float[Array, "K N 5"],
    v: Float[Array, "K N"],
    valid: Bool[Array, "K N"],
    gap: Float[Array, "K N"],
    v_lead: Float[Array, "K N"],
) -> tuple[Float[Array, "K N"], Float[Array, "K N"], Int[Array, "K N"]]:
    """1-D TTC behind the leader; least 2-D TTC with anybody, and with whom."""

    def step(
        box: Float[Array, "N 5"], v: Float[Array, " N"], valid: Bool[Array, " N"]
    ) -> tuple[Float[Array, " N"], Int[Array, " N"]]:
        velocity = v[:, None] * jnp.stack([jnp.cos(box[:, 2]), jnp.sin(box[:, 2])], -1)
        pairs = jax.vmap(encounter, (0, 0, None, None))(box, velocity, box, velocity)
        apart = valid[:, None] & valid[None, :] & ~jnp.eye(len(v), dtype=bool)
        ttc = jnp.where(apart, ttc_2d(pairs), NONE)
        least, other = jnp.min(ttc, -1), jnp.argmin(ttc, -1).astype(jnp.int32)
        return least, jnp.where(least < NONE, other, -1)

    return ttc_1d(gap, v, v_lead), *jax.vmap(step)(box, v, valid)


def _way_ahead(
    lane_map: LaneMap, trace: Any, valid: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Lanes ahead of every vehicle `[T, N, D]`, its own first, and the metres to where each begins.

    The way is the one that the vehicle takes later in the trace. Where that does not show it, lanes go on
    while there is only one way.
    """
    lane, vehicle = np.where(valid, trace.lane, NO_LANE), trace.vehicle
    successors = np.asarray(lane_map.successors)
    only = np.where((successors != NO_LANE).sum(-1) == 1, successors.max(-1), NO_LANE)
    way = np.full((*lane.shape, _AHEAD_LANES), NO_LANE)
    way[..., 0] = lane
    for k in range(len(lane) - 2, -1, -1):
        stays = valid[k] & valid[k + 1] & (vehicle[k] == vehicle[k + 1])
        same = stays & (lane[k] == lane[k + 1])
        enters = stays & (successors[lane[k]] == lane[k + 1][:, None]).any(-1)
        way[k, same, 1:] = way[k + 1, same, 1:]
        way[k, enters & ~same, 1:] = way[k + 1, enters & ~same, :-1]
    for i in range(1, _AHEAD_LANES):
        unknown = (way[..., i] == NO_LANE) & (way[..., i - 1] != NO_LANE)
        way[..., i] = np.where(unknown, only[way[..., i - 1]], way[..., i])
    length = np.where(way == NO_LANE, 0.0, np.asarray(lane_map.length, float)[way])
    start = np.cumsum(length, -1) - length - np.nan_to_num(trace.s.astype(float))[..., None]
    return way, start


def _leaders(
    s: NDArray[Any],
    length: NDArray[Any],
    valid: NDArray[np.bool_],
    way: NDArray[np.int64],
    start: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Slot of the next vehicle ahead, -1 for none, and the gap to its rear (m), `[K, N]` each."""
    lane = way[..., 0]
    nearest = np.full(s.shape, np.inf)
    lead = np.full(s.shape, -1)
    myself = np.eye(s.shape[1], dtype=bool)
    for i in range(way.shape[-1]):
        ahead = start[..., i, None] + s[:, None, :]  # [K, N, N], m to the front of the other
        there = (lane[:, None, :] == way[..., i, None]) & (way[..., i, None] != NO_LANE)
        there &= valid[:, None, :] & ~myself & (ahead > 0)
        ahead = np.where(there, ahead, np.inf)
        who = ahead.argmin(-1)
        distance = np.take_along_axis(ahead, who[..., None], -1)[..., 0]
        lead = np.where(distance < nearest, who, lead)
        nearest = np.minimum(distance, nearest)
    gap = nearest - np.where(lead >= 0, np.take_along_axis(length, np.maximum(lead, 0), 1), 0)
    lead = np.where(gap < LOOK_AHEAD, lead, -1)
    return lead, np.where(lead >= 0, gap, NO_GAP)


# --- the map -----------------------------------------------------------------------------------------


def _add_map(pack: _Pack, network: Network, lane_map: LaneMap, phase: NDArray[Any]) -> dict[str, Any]:
    """Add lane borders, lines and lights in file coordinates less the origin of the lane map."""
    shapes = outlines(network)
    storeys = levels(shapes.values())
    x0, y0, x1, y1 = view(network, shapes, None)
    shift = _shift(lane_map)
    drawn = sorted(shapes.values(), key=lambda shape: (storeys[shape.lane.id], *surface_rank(shape.lane)))
    number = {shape.lane.id: i for i, shape in enumerate(drawn)}
    borders, counts, areas = [], [], []
    kinds = list(SURFACES)
    connectors: list[tuple[int, int]] = []  # lane, junction
    junctions = {id_: j for j, id_ in enumerate(network.junctions)}
    for i, shape in enumerate(drawn):
        lane = shape.lane
        kept = _thinned(shape)
        borders += [shape.left[kept], shape.right[kept]]
        counts.append(len(kept))
        areas.append(kinds.index(surface(lane)))
        if lane.drivable and lane.junction is not None:
            connectors.append((i, junctions.get(lane.junction, -1)))
    pack.add_points("border", np.concatenate(borders), shift)

    stripes = [stripe for walk in network.crosswalks for stripe in crosswalk_stripes(network, walk)]
    lines = _held_lines(network, shapes)
    pack.add_points("stripe", np.concatenate([*stripes, np.zeros((0, 2))]), shift)
    pack.add_points("line", np.concatenate([*(bar for _, bar in lines), np.zeros((0, 2))]), shift)
    bars, rows = signal_bars(network, lane_map)
    pack.add_points("light", bars.reshape(-1, 2), shift)
    states = np.asarray(jax.vmap(lane_states, (None, 0))(lane_map.signals, phase))[:, rows]
    pack.add("light_state", states.T, 1)
    drivable = list(network.drivable_lanes())
    return {
        "bounds": [x0 - shift[0], y0 - shift[1], x1 - shift[0], y1 - shift[1]],
        "origin": shift.tolist(),
        "kinds": kinds,
        "colors": [kind.color for kind in SURFACES.values()],
        "count": counts,
        "area": areas,
        "level": [storeys[shape.lane.id] for shape in drawn],
        "connectors": connectors,
        # Kind, lane, side (0 left, 1 right), shift outward (m).
        "marks": [
            [mark.kind, number[mark.outline.lane.id], mark.side, _DOUBLE * mark.shift]
            for mark in marks(network, drawn)
        ],
        "stripes": [len(stripe) for stripe in stripes],
        "lines": [kind for kind, _ in lines],
        "lanes": [lane.id for lane in drivable],
        "limits": [round(lane.speed_limit, 2) for lane in drivable],
    }


def _held_lines(network: Network, shapes: Mapping[str, Outline]) -> list[tuple[str, NDArray[np.float64]]]:
    """Stop lines of the file and the ends of lanes that must stop or yield: kind, `[2, 2]`."""
    lines = [("stop", shapes[line.spot.lane].bar(line.spot.s, 0.95)) for line in network.stop_lines]
    marked = {line.spot.lane for line in network.stop_lines}
    return lines + [
        (held, shapes[lane].bar(network.lanes[lane].length, 0.95))
        for lane, held in held_ends(network, marked)
        if held != "signal"
    ]


def _thinned(shape: Outline) -> list[int]:
    """Samples between which the borders are straight within `_THIN` (Ramer 1972)."""
    s, points = shape.s, np.concatenate([shape.left, shape.right], -1)
    kept, open_ = [0, len(s) - 1], [(0, len(s) - 1)]
    while open_:
        i, j = open_.pop()
        if j - i < 2 or s[j] <= s[i]:
            continue
        u = (s[i + 1 : j] - s[i]) / (s[j] - s[i])
        off = np.abs(points[i + 1 : j] - points[i] - u[:, None] * (points[j] - points[i])).max(-1)
        k = i + 1 + int(off.argmax())
        if off[k - i - 1] > _THIN:
            kept.append(k)
            open_ += [(i, k), (k, j)]
    return sorted(kept)
