"""Pictures of an ego's cameras, as PNG."""

from __future__ import annotations

import struct
import zlib

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, UInt8
from numpy.typing import NDArray

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.policies.base import scenery_of
from limsim_jax.policies.end_to_end.inputs import front_rig
from limsim_jax.sensors.camera import take_pictures
from limsim_jax.sensors.rig import Rig, front_cameras, six_cameras
from limsim_jax.sensors.scene import bodies_around, pose_of, scene_of
from limsim_jax.types import State

SIZE = 224, 126
"""Pixels of a picture: 6 of them are about 3 kB. LimSim++ stores 560 x 315."""

CAMERAS = ("front", "three", "six", "driver")
"""Names of rigs: the front camera, the three front ones and all six of LimSim++; those of `end_to_end`."""


def rig_of(cameras: Rig | str) -> Rig:
    """The rig of a name.

    Raises:
      ValueError: an unknown name, or a rig without cameras.
    """
    if isinstance(cameras, Rig):
        if not cameras.cameras:
            raise ValueError("cameras: the rig has none; expected at least one")
        return cameras
    if cameras not in CAMERAS:
        raise ValueError(f"cameras: '{cameras}'; known are {', '.join(CAMERAS)}, or a limsim_jax.Rig")
    if cameras == "driver":
        return front_rig()
    if cameras == "six":
        return six_cameras(*SIZE)
    rig = front_cameras(*SIZE)
    return rig if cameras == "three" else rig.only("front")


def look(rig: Rig, lane_map: LaneMap, state: State) -> UInt8[Array, "E C H W 3"]:
    """What the cameras of each ego see.

    Args:
      rig: of the egos; static.
      lane_map: with its scenery.
      state: of the world.

    Raises:
      ValueError: the map comes without scenery.
    """
    scenery = scenery_of(lane_map)
    scene = scene_of(lane_map, scenery, state)

    def one(slot: Array) -> Array:
        bodies = bodies_around(scene, scenery, slot)
        return take_pictures(rig, scenery, pose_of(scene, slot), bodies).color

    return jax.vmap(one)(jnp.asarray(state.egos.slot))


def png(picture: NDArray[np.uint8]) -> bytes:
    """A picture as PNG (ISO/IEC 15948, colour type 2, no filter).

    Args:
      picture: red, green and blue, `[H, W, 3]`.
    """
    height, width, _ = picture.shape

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    rows = np.concatenate([np.zeros((height, 1), np.uint8), picture.reshape(height, -1)], 1)
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    packed = zlib.compress(rows.tobytes(), 6)
    parts = chunk(b"IHDR", head), chunk(b"IDAT", packed), chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)
