"""What egos sense as arrays: the input of a learned policy that looks for itself."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.policies.base import scenery_of
from limsim_jax.policies.host import Observe
from limsim_jax.policies.vector import SPEED
from limsim_jax.sensors.bev import CHANNELS, Raster, birds_eye
from limsim_jax.sensors.camera import FAR, take_pictures
from limsim_jax.sensors.lidar import scan_around
from limsim_jax.sensors.rig import Rig, front_cameras
from limsim_jax.sensors.scene import bodies_around, pose_of, scene_of
from limsim_jax.types import Config, State

GIVES = ("bev", "cameras", "depth", "lidar")
"""What `ObserveScaled` can give."""

_POINTS, _STEP = 20, 5.0  # of the route in the bird's-eye view: points, and m between them


@dataclass(frozen=True)
class ObserveScaled:
    """Makes sensor arrays for learning: one array per ego, or a dictionary of several.

    All numbers are float32 within -1 and 1, without noise. An ego that has left the road sees zeros.

    - "bev": the bird's-eye view, `[E, 6, H, W]`; speeds are divided by `policies.vector.SPEED`;
    - "cameras": red, green and blue, `[E, C, H, W, 3]`, 1 is full;
    - "depth": of the pixels, `[E, C, H, W]`, 1 is `sensors.camera.FAR` m;
    - "lidar": ranges, `[E, R, A]`, 1 is the range of the LiDAR.

    Attributes:
      gives: which of them; one name makes an array, several make a dictionary.
      rig: cameras and LiDAR; the three front cameras of 64 x 36 pixels without LiDAR, unless told.
      raster: extent of the bird's-eye view.

    Raises:
      ValueError: an unknown name, or a rig without the sensor.
    """

    gives: str | tuple[str, ...] = "bev"
    rig: Rig = field(default_factory=front_cameras)
    raster: Raster = field(default_factory=Raster)

    needs_scenery: ClassVar[bool] = True

    def __post_init__(self) -> None:
        for name in self.names:
            if name not in GIVES:
                raise ValueError(f"gives: '{name}'; known are {', '.join(GIVES)}")
        if not self.names:
            raise ValueError(f"gives: nothing; expected some of {', '.join(GIVES)}")
        if not self.rig.cameras and {"cameras", "depth"} & set(self.names):
            raise ValueError("rig: no camera, and gives names pictures")
        if self.rig.lidar is None and "lidar" in self.names:
            raise ValueError("rig: no lidar, and gives names it")

    @property
    def names(self) -> tuple[str, ...]:
        """What it gives."""
        return (self.gives,) if isinstance(self.gives, str) else tuple(self.gives)

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State
    ) -> Float[Array, "E ..."] | dict[str, Float[Array, "E ..."]]:
        """The arrays of one world.

        Raises:
          ValueError: the map comes without scenery.
        """
        scenery = scenery_of(lane_map)
        scene, slot = scene_of(lane_map, scenery, state), state.egos.slot
        ways = Observe(nearest=1, points=_POINTS, step=_STEP)(config, lane_map, state)
        routes = jnp.stack([ways.way_x, ways.way_y], -1)

        def one(slot: Int[Array, ""], route: Float[Array, "P 2"]) -> dict[str, Array]:
            pose, bodies = pose_of(scene, slot), bodies_around(scene, scenery, slot)
            found = {}
            if "bev" in self.names:
                speeds = jnp.asarray([SPEED if name in ("vx", "vy") else 1.0 for name in CHANNELS])
                found["bev"] = birds_eye(self.raster, scenery, pose, bodies, route) / speeds[:, None, None]
            if {"cameras", "depth"} & set(self.names):
                pictures = take_pictures(self.rig, scenery, pose, bodies)
                found["cameras"] = pictures.color.astype(jnp.float32) / 255
                found["depth"] = pictures.depth / FAR
            if "lidar" in self.names and self.rig.lidar is not None:
                found["lidar"] = scan_around(self.rig.lidar, bodies).range / self.rig.lidar.range
            there = state.active[slot]
            return {name: jnp.where(there, jnp.clip(found[name], -1, 1), 0.0) for name in self.names}

        arrays = jax.vmap(one)(slot, jnp.nan_to_num(routes))
        return arrays[self.gives] if isinstance(self.gives, str) else arrays
