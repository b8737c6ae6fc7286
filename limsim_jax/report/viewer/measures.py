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
    way, start = _way_ahead(lane_map, trace, valid)
    size = max(1, min(64, _PAIRS // slots**2))  # steps at once, the same for all traces with these slots
    found = []
    for k in range(0, steps, size):
        part = slice(k, min(k + size, steps))
        spare = size - (part.stop - k)
        arrays = [trace.box[part], trace.v[part], trace.s[part], valid[part], way[part], start[part]]
        arrays = [np.pad(x, [(0, spare)] + [(0, 0)] * (x.ndim - 1)) for x in arrays]
        arrays = [np.nan_to_num(x).astype(np.float32) if x.dtype.kind == "f" else x for x in arrays]
        found.append([np.asarray(x)[: part.stop - k] for x in _measured(*arrays)])
    return tuple(np.concatenate(x) for x in zip(*found, strict=True))


@jax.jit
@jax.vmap
def _measured(
    box: Float[Array, "N 5"],
    v: Float[Array, " N"],
    s: Float[Array, " N"],
    valid: Bool[Array, " N"],
    way: Int[Array, "N D"],
    start: Float[Array, "N D"],
) -> tuple[Int[Array, " N"], Float[Array, " N"], Float[Array, " N"], Float[Array, " N"], Int[Array, " N"]]:
    """Leader and gap, 1-D TTC behind it; least 2-D TTC, and with which slot."""
    apart = valid[:, None] & valid[None, :] & ~jnp.eye(len(v), dtype=bool)
    lead, gap = _leaders(s, box[:, 3], apart, way, start)
    velocity = v[:, None] * jnp.stack([jnp.cos(box[:, 2]), jnp.sin(box[:, 2])], -1)
    pairs = jax.vmap(encounter, (0, 0, None, None))(box, velocity, box, velocity)
    ttc = jnp.where(apart, ttc_2d(pairs), NONE)
    least, other = jnp.min(ttc, -1), jnp.argmin(ttc, -1).astype(jnp.int32)
    behind = ttc_1d(gap, v, jnp.where(lead >= 0, v[lead], 0))
    return lead, gap, behind, least, jnp.where(least < NONE, other, -1)


def _leaders(
    s: Float[Array, " N"],
    length: Float[Array, " N"],
    apart: Bool[Array, "N N"],
    way: Int[Array, "N D"],
    start: Float[Array, "N D"],
) -> tuple[Int[Array, " N"], Float[Array, " N"]]:
    """Leader (slot, -1: none) and the gap to its rear (m)."""
    ahead = start[:, :, None] + s[None, None, :]  # [N, D, N], m to the front of the other
    there = (way[None, None, :, 0] == way[:, :, None]) & (way != NO_LANE)[:, :, None] & apart[:, None, :]
    flat = jnp.where(there & (ahead > 0), ahead, jnp.inf).reshape(len(s), -1)
    nearest, lead = jnp.min(flat, -1), jnp.argmin(flat, -1).astype(jnp.int32) % len(s)
    gap = nearest - length[lead]
    found = gap < LOOK_AHEAD
    return jnp.where(found, lead, -1), jnp.where(found, gap, NO_GAP)


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
