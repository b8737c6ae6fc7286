"""Whether what an instruction names happens: a predicate per act, over the record of a world."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.scenarios.instructions.intent import Act
from limsim_jax.scenarios.instructions.plans import CUT_IN, STEADY
from limsim_jax.simulation.trace import Trace
from limsim_jax.types import Status

STOOD = 0.3
"""m/s below which a vehicle stands."""

SHARE = 0.8
"""Of the braking that is asked for, which counts as it."""

NEAR, MEETS = 60.0, 40.0
"""m to the ego: of vehicles that matter to it along a road, and at junctions."""

IN_LANE, ASIDE = 1.5, 1.5
"""m beside the ego's axis: up to the first a vehicle is ahead of it, from the second on it is beside."""

CLOSE, LASTS = 1.0, 2.0
"""s: time gap below which a vehicle tailgates, and for how long."""

TURNED = 0.6
"""Sine of the angle between two directions that cross."""

SLOW = 2.0
"""m/s less than the ego at the start."""


def happened(seen: Trace, lanes: LaneMap, act: Act, actor: int, ego: int) -> float:
    """The time (s) at which an act of a vehicle has happened; NaN: it has not.

    Args:
      seen: record of a world, `[T, ...]`.
      lanes: the map.
      act: what is to happen.
      actor: slot of the vehicle.
      ego: slot of the ego.
    """
    now = _now(seen, lanes, act, actor, ego)
    there = np.asarray(seen.active)[:, actor] & np.asarray(seen.active)[:, ego]
    when = np.flatnonzero(now & there)
    return float(np.asarray(seen.time)[when[0]]) if when.size else float("nan")


def _now(seen: Trace, lanes: LaneMap, act: Act, actor: int, ego: int) -> Bool[NDArray, " T"]:
    box, time = np.asarray(seen.box), np.asarray(seen.time)
    lane, v = np.asarray(seen.lane)[:, actor], np.asarray(seen.v)[:, actor]
    v_ego = np.asarray(seen.v)[:, ego]
    x, y = _in_axes(box[:, ego], box[:, actor])
    lengths = (box[:, actor, 3] + box[:, ego, 3]) / 2
    gap, near = x - lengths, np.hypot(x, y)
    direction = box[:, actor, 2] - box[:, ego, 2]
    along = np.cos(direction) > 0.7
    leads = (gap > -lengths) & (x > 0) & (np.abs(y) < IN_LANE) & along
    across = np.abs(np.sin(direction)) > TURNED
    inside = np.asarray(lanes.is_connector)[lane]
    left, right = (_moved(lane, np.asarray(side)) for side in (lanes.left, lanes.right))
    most, least = np.maximum.accumulate(v), np.minimum.accumulate(v)
    rate = STEADY if act.rate is None else act.rate
    match act.kind:
        case "cut_in":
            asked = CUT_IN if act.gap is None else act.gap[1]
            return _once(~leads & (np.abs(y) > ASIDE)) & leads & (gap <= 2 * asked + 5)
        case "cut_out":
            return _once(leads) & (x > 0) & (np.abs(y) > ASIDE)
        case "change_lane":
            return {"left": left, "right": right, None: left | right}[act.side]
        case "merge":
            return (left | right) & (near < 2 * NEAR)
        case "brake":
            hard = _once(-np.gradient(v, time) >= SHARE * rate)
            return hard & (v <= (STOOD if act.speed == 0 else np.maximum(most - 2.0, 0.7 * most)))
        case "stop":
            return (most > 1.0) & (v < STOOD)
        case "accelerate":
            target = least + 2.0 if act.speed is None else np.full_like(v, act.speed - 1.0)
            return (v >= target) & (v >= least + 1.0)
        case "slow":
            return (x > 0) & (near < NEAR) & (v < v_ego[0] - SLOW)
        case "stand":
            return (x > 0) & (v < STOOD) & (near < np.maximum(3 * v_ego, 30.0)) & (np.abs(y) < 4 * IN_LANE)
        case "tailgate":
            close = (x < 0) & (np.abs(y) < IN_LANE) & (-x - lengths < CLOSE * v_ego)
            return _lasting(close, time) >= LASTS
        case "overtake":
            return _once(x < -lengths) & (x > lengths) & (np.abs(y) < 8)
        case "cross":
            return inside & (near < MEETS) & (across | (np.cos(direction) < -0.7))
        case "turn_across":
            return inside & (near < MEETS) & across
        case "run_red":
            return ((np.asarray(seen.status)[:, actor] & Status.RED_LIGHT) > 0) & (near < 2 * MEETS)
        case _:
            return near >= 0


def _in_axes(ego: Float[NDArray, "T 5"], other: Float[NDArray, "T 5"]) -> tuple[NDArray, NDArray]:
    """m from the middle of the ego ahead and to the left."""
    away = other[:, :2] - ego[:, :2]
    cos, sin = np.cos(ego[:, 2]), np.sin(ego[:, 2])
    return away[:, 0] * cos + away[:, 1] * sin, away[:, 1] * cos - away[:, 0] * sin


def _once(found: Bool[NDArray, " T"]) -> Bool[NDArray, " T"]:
    """True from the first time on."""
    return np.maximum.accumulate(found)


def _moved(lane: NDArray, beside: NDArray) -> Bool[NDArray, " T"]:
    """Steps in which a vehicle comes to the lane beside its own."""
    before = np.concatenate([lane[:1], lane[:-1]])
    return (lane >= 0) & (before >= 0) & (lane == beside[before]) & (lane != before)


def _lasting(found: Bool[NDArray, " T"], time: NDArray) -> NDArray:
    """s for which something has been so without a break."""
    since = np.where(found, -np.inf, time)
    return np.where(found, time - np.maximum.accumulate(np.where(np.isinf(since), time[0], since)), 0.0)
