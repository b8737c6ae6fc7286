"""The bird's-eye view: a raster around the vehicle with what stands and moves there."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from limsim_jax.maps.scenery import DRIVABLE, Label, Scenery, ground
from limsim_jax.sensors.scene import Bodies, Pose

CHANNELS = ("occupied", "vx", "vy", "drivable", "mark", "route")
"""Channels of the raster: shares 0 or 1, and m/s along the axes of the vehicle."""


@dataclass(frozen=True, kw_only=True)
class Raster:
    """Extent of a bird's-eye view; rows from ahead to behind, columns from left to right.

    Attributes:
      ahead, behind, side: m from the vehicle.
      cell: m, side of a cell.
      route_width: m, of the band around the route.

    Raises:
      ValueError: an extent without a cell.
    """

    ahead: float = 32.0
    behind: float = 8.0
    side: float = 16.0
    cell: float = 0.5
    route_width: float = 3.5

    def __post_init__(self) -> None:
        if not self.cell > 0 or min(self.shape) < 1:
            raise ValueError(f"raster: {self}; expected at least one cell each way")

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return round((self.ahead + self.behind) / self.cell), round(2 * self.side / self.cell)

    @property
    def middles(self) -> tuple[np.ndarray, np.ndarray]:
        """Middles of the cells: x `[H, 1]` and y `[1, W]`.

        In m, in the frame of the vehicle.
        """
        rows, columns = self.shape
        x = self.ahead - (np.arange(rows) + 0.5) * self.cell
        y = self.side - (np.arange(columns) + 0.5) * self.cell
        return x[:, None].astype(np.float32), y[None].astype(np.float32)


@jax.named_scope("bev")
def birds_eye(
    raster: Raster,
    scenery: Scenery,
    pose: Pose,
    bodies: Bodies,
    route: Float[Array, "P 2"] | None = None,
) -> Float[Array, "6 H W"]:
    """The bird's-eye view, one layer for each of `CHANNELS`.

    Args:
      raster: extent; static.
      scenery: of the map.
      pose: of the vehicle.
      bodies: around it; of those that overlap the nearest counts.
      route: points along the way ahead, m in the frame of the vehicle; None: none.
    """
    x, y = (jnp.asarray(v) for v in raster.middles)
    cos, sin = jnp.cos(pose.heading), jnp.sin(pose.heading)
    label = ground(scenery, pose.x + (cos * x - sin * y), pose.y + (sin * x + cos * y))
    drivable = jnp.isin(label, jnp.asarray([int(name) for name in DRIVABLE], label.dtype))
    marks = jnp.asarray([int(Label.MARK), int(Label.CENTRE_LINE), int(Label.STOP_LINE)], label.dtype)
    occupied = jnp.zeros(raster.shape, bool)
    vx = vy = jnp.zeros(raster.shape, jnp.float32)
    for k in reversed(range(bodies.x.shape[0])):
        cos, sin = jnp.cos(bodies.heading[k]), jnp.sin(bodies.heading[k])
        dx, dy = x - bodies.x[k], y - bodies.y[k]
        within = (jnp.abs(cos * dx + sin * dy) <= bodies.length[k] / 2) & (
            jnp.abs(cos * dy - sin * dx) <= bodies.width[k] / 2
        )
        within &= bodies.there[k] & (bodies.slot[k] >= 0)
        occupied |= within
        vx, vy = jnp.where(within, bodies.vx[k], vx), jnp.where(within, bodies.vy[k], vy)
    way = jnp.zeros(raster.shape, bool) if route is None else _near(x, y, route, raster.route_width / 2)
    layers = (occupied, vx, vy, drivable, jnp.isin(label, marks), way)
    return jnp.stack([layer.astype(jnp.float32) for layer in layers])


def _near(x: Array, y: Array, route: Array, most: float) -> Array:
    """Cells within a distance (m) of a line."""
    ax, ay, bx, by = (v[:, None, None] for ends in (route[:-1], route[1:]) for v in ends.T)
    long = jnp.maximum((bx - ax) ** 2 + (by - ay) ** 2, 1e-6)
    dx, dy = x[None] - ax, y[None] - ay
    along = jnp.clip((dx * (bx - ax) + dy * (by - ay)) / long, 0, 1)
    dx, dy = dx - along * (bx - ax), dy - along * (by - ay)
    return (dx * dx + dy * dy <= most * most).any(0)
