"""Records of an ego among vehicles on straight ways."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from limsim_jax.metrics.safety import NO_GAP, Zones
from limsim_jax.metrics.step import EgoStep

DT = 0.1
LENGTH, WIDTH = 5.0, 2.0
PER_VEHICLE = (
    "box",
    "velocity",
    "active",
    "b_max",
    "relevant",
    "meets",
    "follows",
    "leads",
    "changing",
    "violation",
)
FLAGS = (
    "on_lane",
    "on_route",
    "arrived",
    "off_road",
    "in_junction",
    "red_light",
    "stop_sign",
    "waits_at_red",
    "broken",
)


def record(steps, ego, others=(), **changes) -> dict[str, Any]:
    """Vehicles on straight ways, the ego in slot 0: (x, y, heading, v), v a number or one per step."""
    vehicles = [ego, *others]
    n = len(vehicles)
    boxes, velocity, v = np.zeros((steps, n, 5)), np.zeros((steps, n, 2)), np.zeros((steps, n))
    for k, (x, y, heading, speed) in enumerate(vehicles):
        v[:, k] = speed
        way = np.concatenate([[0.0], np.cumsum(v[1:, k] * DT)])
        ahead = np.array([np.cos(heading), np.sin(heading)])
        boxes[:, k, :2] = np.array([x, y]) + way[:, None] * ahead
        boxes[:, k, 2:] = heading, LENGTH, WIDTH
        velocity[:, k] = v[:, k, None] * ahead
    way = np.concatenate([[0.0], np.cumsum(v[1:, 0] * DT)])
    r = {
        "t": 3.0 + np.arange(steps) * DT,  # time need not start at 0
        "box": boxes,
        "velocity": velocity,
        "active": np.ones((steps, n), bool),
        "b_max": np.full((steps, n), 8.0),
        "relevant": np.ones((steps, n), bool),
        "meets": np.zeros((steps, n)),
        "follows": np.zeros((steps, n), bool),
        "leads": np.zeros((steps, n), bool),
        "changing": np.zeros((steps, n), bool),
        "violation": np.zeros((steps, n), bool),
        "slot": np.zeros(steps, np.int32),
        "v": v[:, 0],
        "a": np.concatenate([[0.0], np.diff(v[:, 0]) / DT]),
        "rear_axle": np.full(steps, 1.4),
        "lead": np.full(steps, -1, np.int32),
        "lead_gap": np.full(steps, NO_GAP),
        "lane_heading": np.full(steps, float(ego[2])),
        "speed_limit": np.full(steps, 15.0),
        "to_go": 200.0 - way,
        "moved": np.diff(way, prepend=0.0),
        "v_others": np.zeros(steps),
        "others": np.zeros(steps, bool),
        "zone": np.full((steps, 2), -1, np.int32),
        "zone_ego": np.zeros((steps, 2), bool),
        "zone_other": np.zeros((steps, 2), bool),
    }
    r |= {name: np.full(steps, name in ("on_lane", "on_route")) for name in FLAGS}
    unknown = set(changes) - set(r)
    assert not unknown
    return r | changes


def as_steps(r) -> EgoStep:
    arrays: dict[str, Any] = {
        k: jnp.asarray(x, jnp.float32 if np.asarray(x).dtype == np.float64 else None) for k, x in r.items()
    }
    zones = Zones(arrays.pop("zone"), arrays.pop("zone_ego"), arrays.pop("zone_other"))
    return EgoStep(zones=zones, **arrays)


def free(steps=61, v: Any = 10.0, **changes):
    return record(steps, (0, 0, 0, v), **changes)
