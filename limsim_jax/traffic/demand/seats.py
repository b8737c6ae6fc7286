"""Places for vehicles at the start of a tables."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray
from scipy.spatial import KDTree

from limsim_jax.geometry import box_separation
from limsim_jax.maps.lane_map import (
    NO_LANE,
    bucket,
)
from limsim_jax.maps.network import Lane
from limsim_jax.traffic.demand.tables import Tables, cumulative
from limsim_jax.traffic.vehicles import SIDE_ROOM

EGO_ROOM = 10.0
"""m before and behind an ego that are free on its lane at the start."""

_CLEAR = 3.0  # m, least gap between vehicles at the start
_CERTAIN = 1e6  # logarithm of a weight that decides whatever is drawn
_MARGIN = 2.0  # m from the bodies of vehicles at the start to both ends of their lane


def lay_out_seats(
    tables: Tables, density: float, wanted: NDArray[np.float64], taken: NDArray[np.float64]
) -> dict[str, Any]:
    """Lay out places at the start, about two per vehicle.

    `wanted` is the traffic to every goal: goals are drawn in these proportions where they can be reached.
    `taken` are lanes and places (m) of front bumpers of vehicles that stand there already, `[2 P]`.
    """
    lanes = [lane for lane in tables.network.drivable_lanes() if lane.junction is None]
    open_to = {lane.id: tables.allowed[tables.rows[lane.id]] @ tables.shares for lane in lanes}
    lanes = [lane for lane in lanes if open_to[lane.id] > 0]
    initial = round(density * sum(lane.length for lane in lanes) / 1000)
    row, s, slack = np.zeros(0, int), np.zeros(0), np.zeros(0)
    if initial:
        least = tables.lengths[1] + _CLEAR
        pitch = max(least, 500 / density)
        goals = tables.common | (wanted > 0)
        row, s, slack = _places(tables, lanes, pitch, taken, goals)
        while len(row) < 1.5 * initial and pitch > least:
            pitch = max(least, 0.85 * pitch)
            row, s, slack = _places(tables, lanes, pitch, taken, goals)
    if len(row) < initial:
        raise ValueError(
            f"density = {density:g} veh/km puts {initial} vehicles on the roads at the start, "
            f"but there are only {len(row)} places"
        )
    feasible = tables.leaves_room(row, s + slack)
    share = np.where(feasible, wanted, 0)
    share = np.where(share.any(1, keepdims=True), share, feasible & tables.common)
    types = tables.allowed[row] * tables.shares * _fits(tables, lanes, row, s, slack)
    weight = types.sum(1)
    return {
        "seat_lane": row.astype(np.int32),
        "seat_s": s.astype(np.float32),
        "seat_slack": slack.astype(np.float32),
        "seat_weight": np.log(weight).astype(np.float32),
        "seat_goals": cumulative(share.astype(float)).astype(np.float32),
        "seat_types": cumulative(types).astype(np.float32),
        "initial": initial,
    }


def with_room(seats: dict[str, Any], count: int, vehicles: int) -> dict[str, Any]:
    """The same seats, padded.

    Seats that are always taken, by nothing, fill up the `vehicles` at the start. Seats that are never taken
    fill up the `count`.
    """
    empty = max(vehicles - seats["initial"], 0)
    spare = max(bucket(len(seats["seat_lane"]) + empty, count) - len(seats["seat_lane"]) - empty, 0)
    if not count and not vehicles:
        return seats
    fills = {"seat_lane": NO_LANE, "seat_s": 0.0, "seat_slack": 0.0, "seat_goals": 1.0, "seat_types": 1.0}
    padded = {
        name: np.concatenate(
            [seats[name], np.full((empty + spare, *seats[name].shape[1:]), fill, seats[name].dtype)]
        )
        for name, fill in fills.items()
    }
    weight = np.repeat(np.array([_CERTAIN, -_CERTAIN], np.float32), [empty, spare])
    padded["seat_weight"] = np.concatenate([seats["seat_weight"], weight])
    return padded | {"initial": seats["initial"] + empty}


def _places(
    tables: Tables,
    lanes: list[Lane],
    pitch: float,
    taken: NDArray[np.float64],
    goals: NDArray[np.bool_],
) -> tuple[NDArray[np.int_], NDArray[np.float64], NDArray[np.float64]]:
    """Places `pitch` m apart: row, hindmost front bumper (m) and room from there (m).

    Bodies lie within one lane, one of these goals can be reached, and no two bodies of any size overlap.
    """
    longest = tables.lengths[1]
    row, s, slack = [], [], []
    for lane in lanes:
        front = np.arange(longest + _MARGIN, lane.length - _MARGIN, pitch)
        row += [tables.rows[lane.id]] * len(front)
        s += front.tolist()
        slack += np.minimum(pitch - longest - _CLEAR, lane.length - _MARGIN - front).tolist()
    row, s, slack = np.array(row, int), np.array(s), np.array(slack)
    useful = (tables.leaves_room(row, s + slack) & goals).any(1)
    useful &= (tables.allowed[row] & _fits(tables, lanes, row, s, slack) & (tables.shares > 0)).any(1)
    row, s, slack = row[useful], s[useful], slack[useful]
    # places that are taken come first, and of two places that touch the first is kept
    near = (row[:, None] == taken[0]) & (s[:, None] - longest < taken[1] + EGO_ROOM)
    near &= (s + slack)[:, None] > taken[1] - longest - EGO_ROOM
    row, s, slack = (x[~near.any(1)] for x in (row, s, slack))
    count = taken.shape[1]
    row = np.concatenate([taken[0].astype(int), row])
    s, slack = np.concatenate([taken[1], s]), np.concatenate([np.zeros(count), slack])
    apart = _apart(tables, row, s, slack)
    apart[:count] = False
    return row[apart], s[apart], slack[apart]


def _fits(
    tables: Tables,
    lanes: list[Lane],
    row: NDArray[np.int_],
    s: NDArray[np.float64],
    slack: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Types narrow enough for the lane at each place, `[S, Y]`."""
    by_row = {tables.rows[lane.id]: lane for lane in lanes}
    share = np.linspace(0, 1, 7)
    rear = s - tables.lengths[1]
    along = rear[:, None] + share * (s + slack - rear)[:, None]
    width = [by_row[r].width_at(x).min() for r, x in zip(row.tolist(), along, strict=True)]
    return np.reshape(width, (-1, 1)) >= tables.widths + SIDE_ROOM


def _apart(
    tables: Tables,
    row: NDArray[np.int_],
    s: NDArray[np.float64],
    slack: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Mask of places whose bodies touch no body of another kept place.

    Bodies may have any size, and be anywhere in their place.
    """
    if not len(s):
        return np.ones(0, bool)
    by_row = {tables.rows[lane.id]: lane for lane in tables.network.drivable_lanes()}
    lengths = np.linspace(*tables.lengths, 3)
    share = np.linspace(0, 1, 3)
    # boxes of three lengths at three positions each; their centres
    center = (s[:, None, None] + slack[:, None, None] * share[:, None] - lengths / 2).reshape(len(s), 9)
    size = np.broadcast_to(np.array([0, tables.widths.max()]), (len(s), 9, 2)).copy()
    size[..., 0] = np.tile(lengths, 3)
    poses = [by_row[r].pose(x) for r, x in zip(row.tolist(), center, strict=True)]
    xy = np.array([p[0][:, :2] for p in poses]).reshape(-1, 2)
    heading = np.array([p[1] for p in poses]).reshape(-1, 1)
    boxes = np.concatenate([xy - xy.mean(0, keepdims=True), heading, size.reshape(-1, 2)], 1)
    reach = math.hypot(tables.lengths[1], tables.widths.max()) + 0.1
    pairs = KDTree(xy).query_pairs(reach, output_type="ndarray")
    pairs = pairs[pairs[:, 0] // 9 != pairs[:, 1] // 9]
    padded = np.zeros((bucket(len(pairs), 1024), 2), int)
    padded[: len(pairs)] = pairs
    gaps = np.asarray(_separations(*(jnp.asarray(boxes[padded[:, k]], jnp.float32) for k in (0, 1))))
    touching = np.unique(np.sort(pairs[gaps[: len(pairs)] < 0.1] // 9, axis=1), axis=0)
    kept = np.ones(len(s), bool)
    for a, b in touching.tolist():
        kept[b] &= not kept[a]
    return kept


@jax.jit
def _separations(a: Float[Array, "P 5"], b: Float[Array, "P 5"]) -> Float[Array, " P"]:
    return jax.vmap(box_separation)(a, b)
