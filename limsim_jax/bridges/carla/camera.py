"""Cameras of a CARLA server as arrays."""

from __future__ import annotations

import queue
import time
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

Kind = Literal["rgb", "depth", "semantic"]

FARTHEST = 1000.0
"""m, depth of a pixel of full value (CARLA documentation, "Depth camera")."""

_BLUEPRINTS = {
    "rgb": "sensor.camera.rgb",
    "depth": "sensor.camera.depth",
    "semantic": "sensor.camera.semantic_segmentation",
}


class Mount(NamedTuple):
    """Where a camera sits on its vehicle.

    From the middle of the body, on the road; `y` and `yaw` to the left."""

    x: float = 0.8  # m
    y: float = 0.0
    z: float = 1.6
    yaw: float = 0.0  # rad
    pitch: float = 0.0  # rad, up is positive


class Camera:
    """A camera of a server, and its last picture.

    Args:
      vehicle: number of the vehicle that carries it.
      kind: rgb, depth or semantic.
      width: pixels.
      height: pixels.

    Raises:
      ValueError: another kind.
    """

    def __init__(self, vehicle: int, kind: Kind, width: int, height: int) -> None:
        if kind not in _BLUEPRINTS:
            raise ValueError(f"camera: '{kind}'; known are {', '.join(_BLUEPRINTS)}")
        self.vehicle, self.width, self.height = vehicle, width, height
        self.kind: Kind = kind
        self.blueprint = _BLUEPRINTS[kind]
        self.picture: NDArray[Any] | None = None
        self._come: queue.SimpleQueue[tuple[int, NDArray[Any]]] = queue.SimpleQueue()

    def put(self, image: Any) -> None:
        """Take an image of the server (`carla.Image`), on any thread."""
        self._come.put((int(image.frame), decoded(self.kind, image.raw_data, image.height, image.width)))

    def wait(self, frame: int, seconds: float) -> bool:
        """Wait for the picture of a frame; whether it came within `seconds`."""
        until = time.monotonic() + seconds
        while True:
            try:
                number, picture = self._come.get(timeout=max(until - time.monotonic(), 1e-3))
            except queue.Empty:
                return False
            if number >= frame:  # older ones are of ticks before
                self.picture = picture
                return True


def decoded(kind: Kind, raw: Any, height: int, width: int) -> NDArray[Any]:
    """A picture from the bytes of CARLA, blue, green, red and alpha.

    Args:
      kind: of the camera.
      raw: bytes, four per pixel.
      height: pixels.
      width: pixels.

    Returns:
      `[H, W, 3]` uint8 RGB; `[H, W, 1]` float32 m of depth, or uint8 classes.

    Raises:
      ValueError: another number of bytes.
    """
    data = np.frombuffer(raw, np.uint8)
    if data.size != 4 * height * width:
        raise ValueError(f"{data.size} bytes; {4 * height * width} are expected of {width} x {height} pixels")
    bgra = data.reshape(height, width, 4)
    if kind == "rgb":
        return np.ascontiguousarray(bgra[..., 2::-1])
    if kind == "semantic":
        return bgra[..., 2:3].copy()  # the class is in the red channel
    blue, green, red = (bgra[..., k].astype(np.float64) for k in range(3))
    share = (red + 256 * green + 65536 * blue) / (256**3 - 1)
    return (FARTHEST * share)[..., None].astype(np.float32)


__all__ = ["Camera", "Kind", "Mount", "decoded"]
