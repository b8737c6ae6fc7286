"""What an end-to-end driver is given: pictures, LiDAR rasters, its route and its own motion.

Written for one world with `E` egos. Nothing here reads other vehicles or lights from the state but by the
sensors. The route is the middle of the lane along it, as a navigation system has it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt8

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.policies.base import scenery_of
from limsim_jax.policies.reference import ReferencePath, project_onto, reference_path
from limsim_jax.sensors.camera import Pictures, take_pictures
from limsim_jax.sensors.lidar import Scan, points_of, scan_around
from limsim_jax.sensors.rig import Lidar, Rig, front_cameras
from limsim_jax.sensors.scene import Bodies, Pose, bodies_around, pose_of, scene_of
from limsim_jax.types import State

FOCUS = math.radians(40)
"""Horizontal view of the middle camera: a light has a pixel from 88 m on, and no gap to the outer ones."""

LAYERS = (-8.0, -3.0, -1.0)
"""Elevations of the LiDAR's layers, degrees: they meet the roofs of cars from 4, 10 and 29 m on."""

LIDAR_RANGE = 80.0
"""m; sees a car that is 10 m/s faster 8 s before it is here."""

GROUND = 0.3
"""Points below this height are the ground, m. Chosen: below every bumper."""

POINTS, STEP = 20, 2.0
"""Points of the route, and m between them (reference specification of InterFuser-like drivers)."""

REACH = 96.0
"""m of the route that LiDAR points are related to."""

BANDS = (-14.0, -9.0, -5.5, -3.5, -2.0, -0.9, 0.9, 2.0, 3.5, 5.5, 9.0, 14.0)
"""m left of the route: borders of bands in which the nearest points ahead and behind are told."""


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A raster in the frame of the vehicle, cells square.

    Rows run from behind to ahead, columns from right to left.

    Attributes:
      behind, ahead, side: m from the middle of the vehicle.
      cell: m, side of a cell.
    """

    behind: float = 16.0
    ahead: float = 48.0
    side: float = 24.0
    cell: float = 2.0

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return round((self.behind + self.ahead) / self.cell), round(2 * self.side / self.cell)

    def cells(self, x: Array, y: Array) -> tuple[Int[Array, "*b"], Int[Array, "*b"], Bool[Array, "*b"]]:
        """Row and column of places, and which are inside.

        Places are in m, in the frame of the vehicle.
        """
        row = jnp.floor((x + self.behind) / self.cell).astype(jnp.int32)
        column = jnp.floor((y + self.side) / self.cell).astype(jnp.int32)
        rows, columns = self.shape
        return row, column, (row >= 0) & (row < rows) & (column >= 0) & (column < columns)

    def middles(self) -> tuple[np.ndarray, np.ndarray]:
        """Middles of the cells, m, `[H, 1]` and `[1, W]`."""
        rows, columns = self.shape
        x = (np.arange(rows) + 0.5) * self.cell - self.behind
        y = (np.arange(columns) + 0.5) * self.cell - self.side
        return x[:, None].astype(np.float32), y[None].astype(np.float32)


RASTER = Grid()
"""Cells of the LiDAR raster."""


def front_rig() -> Rig:
    """The rig of the driver: three cameras of 64 x 36 pixels, 180 degrees together, and a LiDAR."""
    lidar = Lidar(elevations=tuple(math.radians(e) for e in LAYERS), range=LIDAR_RANGE)
    rig = front_cameras(lidar=lidar)
    cameras = tuple(replace(c, fov=FOCUS) if c.name == "front" else c for c in rig.cameras)
    return replace(rig, cameras=cameras)


class Inputs(NamedTuple):
    """What the network sees, `[E, ...]`; `P` LiDAR layers times directions are not among it."""

    cameras: UInt8[Array, "E C H W 3"]  # red, green, blue
    raster: UInt8[Array, "E 2 R S"]  # cells of `RASTER` with a LiDAR point: now, and at the last decision
    bands: Float[Array, "E 2 D 2"]  # m along the route to the nearest point of each band, ahead and behind
    route: Float[Array, "E 20 4"]  # x, y (m), cosine and sine of the heading in the frame of the ego
    ego: Float[Array, "E 9"]  # numbers of `EGO`


EGO = (
    "speed", "acceleration", "steering", "speed limit", "speed limit ahead", "offset from the route",
    "lanes to cross", "distance within which to cross them", "speed is told",
)  # fmt: skip
"""Numbers of the ego itself, each divided by a typical size, in their order."""

SPEED, ACCELERATION, ACROSS, LANES, FAR = 20.0, 4.0, 4.0, 2.0, 300.0
"""What 1 stands for: m/s, m/s^2, m, lanes, m."""


class Points(NamedTuple):
    """LiDAR points of a decision, in the map: the next decision uses them, too."""

    x: Float[Array, "E P"]  # m
    y: Float[Array, "E P"]
    there: Bool[Array, "E P"]


class Look(NamedTuple):
    """What the sensors of `E` egos gave; only labels of training use `bodies` and `label`."""

    pictures: Pictures  # [E, C, H, W]
    scan: Scan  # [E, R, A]
    pose: Pose  # [E]
    bodies: Bodies  # [E, K]


@dataclass(frozen=True)
class Sensors:
    """Takes the pictures and scans of all egos of a world.

    Attributes:
      rig: of the vehicles, with cameras and a LiDAR.
      own_network: whether the pictures are for our network, which is made for one size of them.

    Raises:
      ValueError: a rig without one of both, or with other pictures than the network is made for.
    """

    rig: Rig = field(default_factory=front_rig)
    own_network: bool = True

    def __post_init__(self) -> None:
        if not self.rig.cameras:
            raise ValueError("rig: no camera; the driver needs three of 64 x 36 pixels")
        if self.rig.lidar is None:
            raise ValueError("rig: no lidar; the driver needs one")
        first = self.rig.cameras[0]
        if self.own_network and (len(self.rig.cameras), first.width, first.height) != (3, 64, 36):
            raise ValueError(
                f"rig: {len(self.rig.cameras)} cameras of {first.width} x {first.height} pixels; "
                "the driver needs 3 of 64 x 36"
            )

    @jax.named_scope("sensors")
    def look(self, lane_map: LaneMap, state: State, key: Key[Array, ""]) -> Look:
        """What the sensors give now.

        Raises:
          ValueError: the map comes without scenery.
        """
        scenery, lidar = scenery_of(lane_map), self.rig.lidar
        assert lidar is not None
        scene = scene_of(lane_map, scenery, state)

        def one(slot: Int[Array, ""], key: Key[Array, ""]) -> tuple[Pictures, Scan, Pose, Bodies]:
            pose, bodies = pose_of(scene, slot), bodies_around(scene, scenery, slot)
            pictures, scan = take_pictures(self.rig, scenery, pose, bodies), scan_around(lidar, bodies, key)
            return pictures, scan, pose, bodies

        slot = state.egos.slot
        keys = jax.vmap(lambda k: jax.random.fold_in(key, k))(jnp.arange(slot.shape[0]))
        return Look(*jax.vmap(one)(slot, keys))


def points_at(sensors: Sensors, scan: Scan, pose: Pose) -> Points:
    """LiDAR points above the ground, in the map.

    Args:
      sensors: of the vehicles.
      scan: what their LiDAR gave, `[E, R, A]`.
      pose: where they take themselves to be, `[E]`.
    """
    lidar = sensors.rig.lidar
    assert lidar is not None

    def one(scan: Scan, pose: Pose) -> Points:
        place, back = points_of(lidar, scan)
        x, y, z = (place[..., k].reshape(-1) for k in range(3))
        cos, sin = jnp.cos(pose.heading), jnp.sin(pose.heading)
        there = back.reshape(-1) & (z > GROUND)
        return Points(pose.x + cos * x - sin * y, pose.y + sin * x + cos * y, there)

    return jax.vmap(one)(scan, pose)


def no_points(sensors: Sensors, state: State) -> Points:
    """No LiDAR point of any ego."""
    lidar = sensors.rig.lidar
    assert lidar is not None
    zero = jnp.zeros((state.egos.slot.shape[0], len(lidar.elevations) * lidar.columns), jnp.float32)
    return Points(zero, zero, zero > 0)


def route_of(lane_map: LaneMap, state: State) -> ReferencePath:
    """The routes of the egos ahead."""
    return reference_path(lane_map, state, points=round(REACH / STEP) + 1, step=STEP)


@jax.named_scope("inputs")
def inputs_of(
    lane_map: LaneMap,
    state: State,
    path: ReferencePath,
    color: UInt8[Array, "E C H W 3"],
    now: Points,
    before: Points,
) -> Inputs:
    """The inputs of the network.

    Args:
      lane_map: the map.
      state: with the egos where they take themselves to be; all else of it is left alone.
      path: their routes.
      color: of the pictures.
      now: LiDAR points.
      before: those of the last decision.
    """
    egos, slot = state.egos, state.egos.slot
    cos, sin = jnp.cos(egos.heading)[:, None], jnp.sin(egos.heading)[:, None]

    def framed(x: Array, y: Array) -> tuple[Array, Array]:
        dx, dy = x - egos.x[:, None], y - egos.y[:, None]
        return cos * dx + sin * dy, cos * dy - sin * dx

    rasters, bands = [], []
    for points in (now, before):
        rasters.append(_raster(*framed(points.x, points.y), points.there))
        s, d, _ = project_onto(path, points.x, points.y)
        bands.append(_nearest(s, d, points.there))
    x, y = framed(path.x[:, :POINTS], path.y[:, :POINTS])
    turned = path.heading[:, :POINTS] - egos.heading[:, None]
    _, offset, _ = project_onto(path, egos.x[:, None], egos.y[:, None])
    lane, goal = state.lane[slot], state.goal[slot]
    within = lane_map.routes.change_distance[lane, goal] - state.s[slot]
    own = (
        state.v[slot] / SPEED,
        egos.a / ACCELERATION,
        egos.steering,
        path.limit[:, 0] / SPEED,
        path.limit[:, POINTS] / SPEED,
        offset[:, 0] / ACROSS,
        jnp.clip(lane_map.routes.lanes_to_go[lane, goal].astype(jnp.float32), -4.0, 4.0) / LANES,
        jnp.clip(within / FAR, 0.0, 1.0),
        jnp.ones_like(egos.a),
    )
    return Inputs(
        cameras=color,
        raster=jnp.stack(rasters, 1),
        bands=jnp.stack(bands, 1),
        route=jnp.stack([x, y, jnp.cos(turned), jnp.sin(turned)], -1),
        ego=jnp.nan_to_num(jnp.stack(own, -1)),
    )


def _raster(
    x: Float[Array, "E P"], y: Float[Array, "E P"], there: Bool[Array, "E P"]
) -> UInt8[Array, "E R S"]:
    """1 where a cell holds a point."""
    row, column, inside = RASTER.cells(x, y)
    rows, columns = RASTER.shape
    cell = jnp.where(inside & there, row * columns + column, rows * columns)  # all others in one more cell

    def one(cell: Int[Array, " P"]) -> UInt8[Array, " Q"]:
        return jnp.zeros(rows * columns + 1, jnp.uint8).at[cell].set(1)

    return jax.vmap(one)(cell)[:, :-1].reshape(-1, rows, columns)


def _nearest(
    s: Float[Array, "E P"], d: Float[Array, "E P"], there: Bool[Array, "E P"]
) -> Float[Array, "E D 2"]:
    """Distance (m) along the route to the nearest point of each band.

    The last axis is ahead and behind.
    """
    edges = jnp.asarray(BANDS, jnp.float32)
    within = (d[:, None] > edges[None, :-1, None]) & (d[:, None] <= edges[None, 1:, None]) & there[:, None]
    along = jnp.broadcast_to(s[:, None], within.shape)
    ahead = jnp.min(jnp.where(within & (along >= 0), along, LIDAR_RANGE), -1)
    behind = jnp.min(jnp.where(within & (along < 0), -along, LIDAR_RANGE), -1)
    return jnp.minimum(jnp.stack([ahead, behind], -1), LIDAR_RANGE)
