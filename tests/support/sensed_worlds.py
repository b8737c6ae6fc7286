"""Bodies and places for tests of sensors."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from ray_tracer import Box
from traffic_worlds import bundled

from limsim_jax.maps.scenery import Label, Scenery, build_scenery
from limsim_jax.sensors.camera import Pictures, take_pictures
from limsim_jax.sensors.rig import Rig
from limsim_jax.sensors.scene import Bodies, Pose


@functools.cache
def scenery(name: str = "intersection") -> Scenery:
    """The scenery of a bundled map."""
    return build_scenery(*bundled(name))


SIX = 6
"""Bodies in all tests, so that they share programs."""


def look(rig: Rig, bodies: Bodies, pose: Pose | None = None) -> Pictures:
    """The pictures of a rig in a bundled map."""
    return _look(rig, scenery(), pose_at() if pose is None else pose, bodies)


_look = jax.jit(take_pictures, static_argnums=0)


def six_bodies_of(boxes: list[Box], **changes: Any) -> Bodies:
    """Cars in these boxes, and some that are not there."""
    rest = [Box(0, 0, 0, 0, 1, 1, 1)] * (SIX - len(boxes))
    padded = {name: jnp.pad(jnp.asarray(x), (0, len(rest))) for name, x in changes.items()}
    there = jnp.arange(SIX) < len(boxes)
    return bodies_of([*boxes, *rest], **({"there": there} | padded))


def bodies_of(boxes: list[Box], **changes: Any) -> Bodies:
    """Cars in these boxes, slots in their order."""
    columns = {name: jnp.asarray([getattr(b, name) for b in boxes], jnp.float32) for name in Box._fields}
    count = len(boxes)
    rest = {
        "vx": jnp.zeros(count, jnp.float32), "vy": jnp.zeros(count, jnp.float32),
        "label": jnp.full(count, int(Label.CAR), jnp.int32), "lamps": jnp.zeros(count, jnp.int32),
        "slot": jnp.arange(count, dtype=jnp.int32), "there": jnp.ones(count, bool),
    }  # fmt: skip
    return Bodies(**(columns | rest | changes))


def pose_at(x: float = 0.0, y: float = 0.0, heading: float = 0.0) -> Pose:
    """A pose in the map."""
    return Pose(x=jnp.float32(x), y=jnp.float32(y), heading=jnp.float32(heading))


def random_boxes(rng: np.random.Generator, count: int, reach: float = 30.0) -> list[Box]:
    """Boxes apart from the origin, some of them above the ground, as lights are."""
    boxes: list[Box] = []
    while len(boxes) < count:
        x, y = rng.uniform(-reach, reach, 2)
        if np.hypot(x, y) > 8:
            z = 4.0 if rng.random() < 0.1 else 0.0
            size = rng.uniform((2, 1, 1), (12, 2.6, 3.5))
            boxes.append(Box(x, y, z, rng.uniform(-3.2, 3.2), *size))
    return boxes
