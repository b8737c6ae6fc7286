"""LiDAR: the range of every ray, and which vehicle it met."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from limsim_jax.sensors.cast import NOTHING, Rays, cast
from limsim_jax.sensors.chance import Purpose, key_of
from limsim_jax.sensors.rig import Lidar
from limsim_jax.sensors.scene import Bodies


class Scan(NamedTuple):
    """A turn of a LiDAR: `R` layers and `A` directions, the first ahead, counter-clockwise."""

    range: Float[Array, "R A"]  # m; the range of the sensor: nothing came back
    slot: Int[Array, "R A"]  # of the vehicle that was met; -1: ground, a light or nothing


def lidar_rays(lidar: Lidar) -> Rays:
    """Rays whose length is horizontal distance."""
    around = np.arange(lidar.columns) * (2 * np.pi / lidar.columns)
    rise = np.tan(np.asarray(lidar.elevations))
    fields = (
        [lidar.x], [lidar.y], [lidar.z], np.cos(around)[None, None], np.sin(around)[None, None],
        rise[None, :, None],
    )  # fmt: skip
    return Rays(*(jnp.asarray(field, jnp.float32) for field in fields))


@jax.named_scope("lidar")
def scan_around(
    lidar: Lidar,
    bodies: Bodies,
    key: Key[Array, ""] | None = None,
    step: Int[Array, ""] | int = 0,
) -> Scan:
    """The scan of a LiDAR.

    Args:
      lidar: static.
      bodies: around the vehicle.
      key: of the world; None: without noise and dropout.
      step: of the run, part of the random numbers.
    """
    rays = lidar_rays(lidar)
    hits = cast(rays, bodies)
    slant = jnp.sqrt(1 + rays.dz**2)[0]  # [R 1]
    down = rays.dz[0] < 0
    floor = jnp.where(down, lidar.z / jnp.where(down, -rays.dz[0], 1), NOTHING)
    body = jnp.where(hits.length[0] < floor, hits.body[0], -1)
    away = jnp.minimum(hits.length[0], floor) * slant
    back = away < lidar.range
    if key is not None:
        normal, lost = jax.random.split(key_of(key, step, Purpose.LIDAR))
        away = away + lidar.noise * jax.random.normal(normal, away.shape, away.dtype)
        if lidar.dropout > 0:
            back &= ~jax.random.bernoulli(lost, lidar.dropout, away.shape)
    slot = jnp.where(body >= 0, bodies.slot[jnp.maximum(body, 0)], -1)
    return Scan(jnp.where(back, jnp.clip(away, 0, lidar.range), lidar.range), jnp.where(back, slot, -1))


def points_of(lidar: Lidar, scan: Scan) -> tuple[Float[Array, "R A 3"], Array]:
    """Points in the frame of the vehicle, and which rays came back.

    In m, and as flags `[R, A]`.
    """
    rays = lidar_rays(lidar)
    flat = scan.range / jnp.sqrt(1 + rays.dz**2)[0]
    way = jnp.stack(jnp.broadcast_arrays(rays.dx[0], rays.dy[0], rays.dz[0]), -1)
    origin = jnp.asarray([lidar.x, lidar.y, lidar.z], jnp.float32)
    return origin[None, None] + flat[..., None] * way, scan.range < lidar.range


def hits_per_body(scan: Scan, bodies: Bodies) -> Int[Array, " K"]:
    """Rays that met each body."""
    met = scan.slot.reshape(-1)[None] == bodies.slot[:, None]
    return (met & bodies.there[:, None] & (bodies.slot >= 0)[:, None]).sum(-1, dtype=jnp.int32)
