"""A small trace made by hand, for tests of pictures, videos and pages."""

from typing import Any

import numpy as np
from traffic_worlds import bundled

from limsim_jax.simulation.trace import Trace
from limsim_jax.types import Status

T, N = 12, 5
HIT, OWN, LATE, GONE = 1, 2, 3, 4  # slots: collided, an ego, another vehicle from step 6 on, never there


def small_trace(name: str) -> Any:
    """A map, and a trace made by hand: every slot with its own speed, size, heading and place."""
    network, lane_map = bundled(name)
    step, slot = np.arange(T)[:, None], np.arange(N)[None]
    v = (1.0 + 2.0 * slot + 0 * step).astype(np.float32)
    heading = 0.4 * slot + 0 * step
    x, y = 10.0 * slot + 0.1 * step * v * np.cos(heading), 5.0 * slot + 0.1 * step * v * np.sin(heading)
    box = np.stack([x, y, heading, 4.0 + slot + 0 * step, 1.5 + 0.2 * slot + 0 * step], -1)
    zero, whole = np.zeros((T, N), np.float32), np.zeros((T, N), np.int32)
    fields: dict[str, Any] = dict(
        time=np.float32(0.1) * np.arange(1, T + 1, dtype=np.float32),
        active=(slot != GONE) & (step >= 0),
        vehicle=np.where((slot == LATE) & (step < 6), 7, slot + 0 * step).astype(np.int32),
        lane=whole,
        s=zero,
        d=zero,
        v=v,
        a=zero,
        box=box.astype(np.float32),
        status=np.where(slot == HIT, int(Status.COLLIDED), 0) + whole,
        phase=np.zeros((T, lane_map.signals.duration.shape[0]), np.int32),
    )
    trace = Trace(**fields)
    return network, lane_map, trace
