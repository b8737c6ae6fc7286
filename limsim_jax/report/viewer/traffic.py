"""The traffic of a replay as columns of numbers: vehicles, plans, and what is measured of them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps.lane_map import LaneMap, absolute
from limsim_jax.report.viewer.measures import measure
from limsim_jax.report.viewer.pack import Pack, held, origin

LONGEST_TTC = 60.0
"""s: a longer time to collision is shown as none."""

_PLAN_POINTS = 4  # of a plan per second: a chord of a bend is 0.1 m off at most at 10 m/s and r = 10 m


def add_traffic(pack: Pack, lane_map: LaneMap, trace: Any) -> None:
    """Add a trace of NumPy arrays, and what is measured of it."""
    active = trace.active
    finite = active & np.isfinite(trace.box).all(-1) & np.isfinite(trace.v) & np.isfinite(trace.s)
    x, y, heading, length, width = np.moveaxis(trace.box.astype(float), -1, 0)
    lead, gap, ttc, soonest, other = measure(lane_map, trace, finite)

    pack.add("time", trace.time.astype(float)[None], 10_000)
    # 0: empty, 1: there at the start, 2 and more: row of the schedule
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
        pack.add(name, held(values, known).T, scale)


def add_driven(pack: Pack, lane_map: LaneMap, trace: Any, ego: int | None) -> Any:
    """Add classes, driven vehicles, plans, and the way to the goal.

    Returns the rows and points of plans, and the points per second. A plan is stored when it is made.
    """
    if trace.vehicle_class is not None:
        pack.add("class", held(trace.vehicle_class, trace.active).T, 1)
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
            f"plan_{letter}", absolute(lane_map, xy[..., 0], xy[..., 1])[axis] - origin(lane_map)[axis], 100
        )
    return {"points": count, "per_second": _PLAN_POINTS}


def _shown(ttc: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.where(ttc < LONGEST_TTC, ttc, np.float32(-1))
