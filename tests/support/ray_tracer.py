"""A ray tracer in float64: the six rectangles of every box, one by one. Nothing of it is shared with ours."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Box(NamedTuple):
    """A box on the ground: middle, heading, sizes (m)."""

    x: float
    y: float
    z: float
    heading: float
    length: float
    width: float
    height: float

    def faces(self) -> list[tuple[Floats, Floats, Floats, Floats]]:
        """Middle, normal, and two half edges of each face: front, back, left, right, top, bottom."""
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        ahead, left, up = np.array([cos, sin, 0]), np.array([-sin, cos, 0]), np.array([0, 0, 1.0])
        middle = np.array([self.x, self.y, self.z + self.height / 2])
        a, b, c = self.length / 2 * ahead, self.width / 2 * left, self.height / 2 * up
        return [
            (middle + a, ahead, b, c), (middle - a, -ahead, b, c), (middle + b, left, a, c),
            (middle - b, -left, a, c), (middle + c, up, a, b), (middle - c, -up, a, b),
        ]  # fmt: skip


class Found(NamedTuple):
    """The first box of each ray: length in units of the direction, box, face; -1 and inf: none."""

    length: Floats
    box: NDArray[np.int64]
    face: NDArray[np.int64]
    across: Floats  # [..., 2], place on the face, -1 to 1 along its two half edges


def trace(origin: Floats, way: Floats, boxes: list[Box]) -> Found:
    """Trace rays `way [..., 3]` from one origin."""
    shape = way.shape[:-1]
    best, which, side = np.full(shape, np.inf), np.full(shape, -1), np.full(shape, -1)
    across = np.zeros((*shape, 2))
    for k, box in enumerate(boxes):
        for f, (middle, normal, u, v) in enumerate(box.faces()):
            slope = way @ normal
            with np.errstate(divide="ignore", invalid="ignore"):
                length = ((middle - origin) @ normal) / slope
                point = origin + length[..., None] * way - middle
                p, q = (point @ e / (e @ e) for e in (u, v))
                met = (slope < 0) & (length > 0) & (abs(p) <= 1) & (abs(q) <= 1) & (length < best)
            best[met], which[met], side[met] = length[met], k, f
            across[met] = np.stack([p, q], -1)[met]
    return Found(best, which, side, across)


def pixel_ways(camera: Any) -> Floats:
    """Rays through the middles of pixels `[H, W, 3]`, of length 1 along the axis, by rotation matrices."""
    yaw, pitch, roll = camera.yaw, camera.pitch, camera.roll
    about_z = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
    about_y = np.array(
        [[math.cos(pitch), 0, -math.sin(pitch)], [0, 1, 0], [math.sin(pitch), 0, math.cos(pitch)]]
    )
    about_x = np.array([[1, 0, 0], [0, math.cos(roll), -math.sin(roll)], [0, math.sin(roll), math.cos(roll)]])
    tangent = math.tan(camera.fov / 2)
    left = tangent * (1 - 2 * (np.arange(camera.width) + 0.5) / camera.width)
    up = tangent * (camera.height - 2 * (np.arange(camera.height) + 0.5)) / camera.width
    local = np.stack(np.broadcast_arrays(1.0, left[None], up[:, None]), -1)
    return local @ (about_z @ about_y @ about_x).T
