"""Cameras and LiDARs as values: where they are on the vehicle and what they cover."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A pinhole camera with square pixels.

    Attributes:
      name: of the camera.
      x, y, z: m in the frame of the vehicle: ahead of the middle, left, above the ground.
      yaw: rad, left > 0.
      pitch: rad, up > 0.
      roll: rad, clockwise as seen from behind > 0.
      fov: rad, from the left to the right edge of the picture.
      width, height: pixels.

    Raises:
      ValueError: a value out of range.
    """

    name: str = "front"
    x: float = 1.5
    y: float = 0.0
    z: float = 2.0
    yaw: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0
    fov: float = math.radians(70)
    width: int = 64
    height: int = 36

    def __post_init__(self) -> None:
        _finite(f"camera '{self.name}'", self, "x", "y", "z", "yaw", "pitch", "roll")
        if not self.z > 0:
            raise ValueError(f"camera '{self.name}': z: {self.z} m; expected above the ground")
        if not 0 < self.fov < math.pi:
            raise ValueError(f"camera '{self.name}': fov: {self.fov} rad; expected within 0 and pi")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"camera '{self.name}': {self.width} x {self.height} pixels; expected 1 or more")

    @property
    def focal(self) -> float:
        """Focal length, pixels."""
        return self.width / 2 / math.tan(self.fov / 2)

    @property
    def level(self) -> bool:
        """Whether it looks along the horizon."""
        return self.pitch == 0 and self.roll == 0

    @property
    def axes(self) -> Floats:
        """Its directions ahead, left and up, rows `[3, 3]`."""
        (cy, sy), (cp, sp), (cr, sr) = (
            (math.cos(angle), math.sin(angle)) for angle in (self.yaw, self.pitch, self.roll)
        )
        ahead = np.array([cp * cy, cp * sy, sp])
        left, up = np.array([-sy, cy, 0.0]), np.array([-sp * cy, -sp * sy, cp])
        return np.stack([ahead, cr * left + sr * up, cr * up - sr * left])

    def project(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Where points appear.

        Args:
          points: `[..., 3]`, m in the frame of the vehicle.

        Returns:
          Column and row (pixels from the upper left corner of the picture), and depth along the axis of the
          camera (m; behind it below 0, where column and row mean nothing), `[...]` each.
        """
        away = np.asarray(points, float) - (self.x, self.y, self.z)
        depth, left, up = np.moveaxis(away @ self.axes.T, -1, 0)
        scale = self.focal / np.where(depth == 0, np.nan, depth)
        return self.width / 2 - scale * left, self.height / 2 - scale * up, depth


@dataclass(frozen=True, kw_only=True)
class Lidar:
    """A LiDAR that turns: `columns` directions around, one ray per layer in each.

    Attributes:
      x, y, z: m in the frame of the vehicle.
      elevations: rad of the layers, up > 0, each within a right angle.
      columns: directions around, the first ahead, counter-clockwise.
      range: m, beyond which nothing comes back.
      noise: m, standard deviation of the range (VLP-16: accuracy 3 cm).
      dropout: share of the rays that get lost.

    Raises:
      ValueError: a value out of range.
    """

    x: float = 0.0
    y: float = 0.0
    z: float = 2.0
    elevations: tuple[float, ...] = tuple(math.radians(2 * k - 15) for k in range(16))
    columns: int = 360
    range: float = 100.0
    noise: float = 0.03
    dropout: float = 0.0

    def __post_init__(self) -> None:
        _finite("lidar", self, "x", "y", "z")
        if not self.z > 0:
            raise ValueError(f"lidar: z: {self.z} m; expected above the ground")
        if not self.elevations or not all(abs(e) < math.pi / 2 for e in self.elevations):
            raise ValueError(f"lidar: elevations {self.elevations}; expected within -pi/2 and pi/2")
        if self.columns < 1:
            raise ValueError(f"lidar: {self.columns} columns; expected 1 or more")
        if not 0 < self.range < math.inf:
            raise ValueError(f"lidar: range {self.range} m; expected more than 0")
        if not (0 <= self.noise < math.inf and 0 <= self.dropout <= 1):
            raise ValueError(f"lidar: noise {self.noise} m, dropout {self.dropout}; expected 0 or more")


def _finite(what: str, of: object, *names: str) -> None:
    for name in names:
        if not math.isfinite(getattr(of, name)):
            raise ValueError(f"{what}: {name}: {getattr(of, name)}; expected a finite number")


@dataclass(frozen=True, kw_only=True)
class Rig:
    """Sensors of a vehicle.

    Attributes:
      cameras: all of one size in pixels, with different names.
      lidar: or None.

    Raises:
      ValueError: no sensor, two cameras of one name, or pictures of different sizes.
    """

    cameras: tuple[Camera, ...] = ()
    lidar: Lidar | None = None

    def __post_init__(self) -> None:
        if not self.cameras and self.lidar is None:
            raise ValueError("rig: no sensor; expected a camera or a lidar")
        names = [camera.name for camera in self.cameras]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"rig: two cameras are named '{name}'")
        for camera in self.cameras:
            first = self.cameras[0]
            if (camera.width, camera.height) != (first.width, first.height):
                raise ValueError(
                    f"rig: camera '{camera.name}' has {camera.width} x {camera.height} pixels; "
                    f"expected {first.width} x {first.height} as '{first.name}'"
                )

    @property
    def names(self) -> tuple[str, ...]:
        """Of the cameras."""
        return tuple(camera.name for camera in self.cameras)

    def only(self, *names: str) -> Rig:
        """The rig with some of its cameras.

        Raises:
          ValueError: a camera that it does not have.
        """
        self.check(*names)
        return replace(self, cameras=tuple(c for c in self.cameras if c.name in names))

    def check(self, *names: str) -> None:
        """Raise `ValueError` if the rig lacks one of these cameras."""
        for name in names:
            if name not in self.names:
                known = ", ".join(self.names) or "none"
                raise ValueError(f"rig: no camera '{name}'; its cameras are {known}")

    def sized(self, width: int, height: int) -> Rig:
        """The rig with pictures of another size, in pixels."""
        return replace(self, cameras=tuple(replace(c, width=width, height=height) for c in self.cameras))


def six_cameras(width: int = 64, height: int = 36, lidar: Lidar | None = None) -> Rig:
    """The surround view of LimSim++: six cameras, from the front left round to the back right.

    Source: mountings and fields of view of LimSim++'s camera manager (github.com/PJLab-ADG/LimSim), whose
    pictures have 1600 x 900 pixels. There y points right and yaw turns right; here both are to the left.
    """
    places = {
        "front_left": (1.5, 0.7, 55, 70),
        "front": (1.5, 0.0, 0, 70),
        "front_right": (1.5, -0.7, -55, 70),
        "back_left": (-0.7, 0.0, 110, 70),
        "back": (-1.5, 0.0, 180, 110),
        "back_right": (-0.7, 0.0, -110, 70),
    }
    cameras = tuple(
        Camera(name=name, x=x, y=y, yaw=math.radians(yaw), fov=math.radians(fov), width=width, height=height)
        for name, (x, y, yaw, fov) in places.items()
    )
    return Rig(cameras=cameras, lidar=lidar)


def front_cameras(width: int = 64, height: int = 36, lidar: Lidar | None = None) -> Rig:
    """The three front cameras of LimSim++, which its vision-language driver sees."""
    return replace(six_cameras(width, height, lidar).only("front_left", "front", "front_right"))


def rig_named(name: str) -> Rig:
    """A rig to watch by: `six`, `front` or `one` cameras with a LiDAR of 16 layers.

    Pictures have 160 x 90, 224 x 126 and 320 x 180 pixels.

    Raises:
      ValueError: another name.
    """
    rigs = {
        "six": six_cameras(160, 90, LAYERS_16),
        "front": front_cameras(224, 126, LAYERS_16),
        "one": six_cameras(320, 180, LAYERS_16).only("front"),
    }
    if name not in rigs:
        raise ValueError(f"rig '{name}'; known are {', '.join(rigs)}")
    return rigs[name]


LAYERS_16 = Lidar()
"""16 layers, 2 degrees apart (Velodyne VLP-16: -15 to 15 degrees, 3 cm), on the roof."""

LAYERS_1 = Lidar(z=0.6, elevations=(0.0,))
"""One level layer at the height of a bumper."""
