"""What a replay tells of every vehicle: its leader, the gap, and times to collision."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

from limsim_jax.maps.lane_map import NO_LANE, LaneMap
from limsim_jax.metrics.safety import NO_GAP, NONE, encounter, ttc_1d, ttc_2d

LOOK_AHEAD = 150.0
"""m: a leader further away is none."""

_AHEAD_LANES = 5  # lanes on which a leader is looked for
_PAIRS = 2**18  # pairs of vehicles measured at once


def measure(lane_map: LaneMap, trace: Any, valid: NDArray[np.bool_]) -> tuple[NDArray[Any], ...]:
    """Per vehicle `[T, N]`: leader, gap, 1-D TTC, least 2-D TTC and the slot (-1, `NO_GAP`, `NONE`)."""
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
    """1-D TTC behind the leader; least 2-D TTC, and with which slot."""

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
    """Lanes ahead of every vehicle, and their distances (m), `[T, N, D]`.

    The first lane is its own.

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
    """Leader (slot, -1: none) and the gap to its rear (m), `[K, N]`."""
    lane = way[..., 0]
    nearest = np.full(s.shape, np.inf)
    lead = np.full(s.shape, -1)
    myself = np.eye(s.shape[1], dtype=bool)
    for i in range(way.shape[-1]):
        ahead = start[..., i, None] + s[:, None, :]  # [K, N, N], m to the front of the other
        there = (lane[:, None, :] == way[..., i, None]) & (way[..., i, None] != NO_LANE)
        there &= valid[:, None, :] & ~myself & (ahead > 0)
        ahead = np.where(there, ahead, np.inf)
        nearby = ahead.argmin(-1)
        distance = np.take_along_axis(ahead, nearby[..., None], -1)[..., 0]
        lead = np.where(distance < nearest, nearby, lead)
        nearest = np.minimum(distance, nearest)
    gap = nearest - np.where(lead >= 0, np.take_along_axis(length, np.maximum(lead, 0), 1), 0)
    lead = np.where(gap < LOOK_AHEAD, lead, -1)
    return lead, np.where(lead >= 0, gap, NO_GAP)
