"""Worlds without the engine: vehicles that drive along their lanes at constant speed."""

from __future__ import annotations

from typing import Any

import numpy as np

from limsim_jax.api.world import World
from limsim_jax.maps.lane_map import NO_LANE, lane_ids
from limsim_jax.maps.map import Map
from limsim_jax.simulation.trace import Trace

SIZES = {0: (4.6, 1.85), 2: (9.0, 2.5), 3: (11.0, 2.55), 4: (2.2, 0.8)}
"""Length and width (m) by index into `VEHICLE_CLASSES`."""


def lane_world(
    town: Map, *, vehicles: int = 12, seconds: float = 4.0, dt: float = 0.1, speed: float = 9.0, seed: int = 0
) -> World:
    """A vehicle on each of some lanes; every second one comes in later, and each leaves at its lane's end."""
    rng = np.random.default_rng(seed)
    ids = lane_ids(town.network)
    longest = sorted(range(len(ids)), key=lambda k: -town.network.lanes[ids[k]].length)
    rows = rng.choice(longest[: max(vehicles, len(ids) // 2)], vehicles, replace=False)
    time = np.arange(round(seconds / dt) + 1) * dt
    shape = len(time), vehicles
    kinds = np.array([list(SIZES)[k % len(SIZES)] for k in range(vehicles)])
    size = np.array([SIZES[k] for k in kinds.tolist()])
    box, lane_s = np.zeros((*shape, 5)), np.zeros(shape)
    active = np.ones(shape, bool)
    origin = np.asarray(town.lanes.origin, float)
    for n, row in enumerate(rows):
        lane = town.network.lanes[ids[row]]
        start = rng.uniform(size[n, 0], max(size[n, 0] + 0.1, lane.length - 20))
        entry = 0.0 if n % 2 == 0 else 0.35 * seconds
        s = start + speed * np.maximum(time - entry, 0)
        active[:, n] = (time >= entry) & (s < lane.length)
        xyz, heading = lane.pose(s - size[n, 0] / 2)
        box[:, n] = np.column_stack([xyz[:, :2] - origin, heading, np.broadcast_to(size[n], (len(s), 2))])
        lane_s[:, n] = s
    programs = np.asarray(town.lanes.signals.duration).shape[0]
    number = np.where(np.arange(vehicles) % 2 == 0, -1, np.arange(vehicles))
    steps = np.arange(len(time), dtype=np.int32)[:, None]
    columns: dict[str, Any] = dict(
        time=time.astype(np.float32),
        active=active,
        vehicle=np.broadcast_to(number, shape).astype(np.int32),
        lane=np.where(active, rows, NO_LANE).astype(np.int32),
        s=lane_s.astype(np.float32),
        d=np.zeros(shape, np.float32),
        v=np.full(shape, speed, np.float32),
        a=np.zeros(shape, np.float32),
        box=box.astype(np.float32),
        status=np.zeros(shape, np.int32),
        phase=np.broadcast_to(steps // 20 % 2, (len(time), programs)).astype(np.int32),
        vehicle_class=np.broadcast_to(kinds, shape).astype(np.int32),
        driven=np.where(active[:, :1], 0, -1).astype(np.int32),
    )
    return World("lanes", "constant", 0, 0, town, Trace(**columns), {}, [])
