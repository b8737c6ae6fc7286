"""A film made by hand, every frame another, for tests of what shows it."""

import math
from typing import Any

import numpy as np

from limsim_jax.api.sensed import Film
from limsim_jax.sensors.bev import CHANNELS, Raster
from limsim_jax.sensors.camera import Pictures
from limsim_jax.sensors.lidar import Scan
from limsim_jax.sensors.objects import Objects
from limsim_jax.sensors.rig import Camera, Lidar, Rig
from limsim_jax.sensors.scene import Bodies, Pose

HUES = np.array([(250, 10, 20), (20, 240, 30), (15, 25, 245), (240, 230, 10), (90, 90, 90)], np.uint8)
WIDE, HIGH = 16, 8  # pixels of a camera
RASTER = Raster(ahead=20.0, behind=4.0, side=6.0, cell=2.0)


def film_of(time, pose, *, names=("front", "back"), layers=(-0.1, 0.0), size=(4.0, 1.7)) -> Film:
    """A film with frames at these times (s), along these poses `[F, 3]`.

    Colours, ranges, cells and objects all depend on the frame.
    """
    time, pose = np.asarray(time, float), np.asarray(pose, np.float32)
    rng = np.random.default_rng(5)
    frames, cameras = len(time), len(names)
    rig = Rig(
        cameras=tuple(
            Camera(name=name, yaw=k * math.pi / max(cameras, 1), width=WIDE, height=HIGH)
            for k, name in enumerate(names)
        ),
        lidar=Lidar(x=1.0, elevations=layers, columns=12, range=60.0) if layers else None,
    )
    hue: Any = rng.integers(0, len(HUES), (frames, cameras, HIGH, WIDE))
    label: Any = np.zeros_like(hue, np.uint8)
    color: Any = HUES[hue]
    pictures = Pictures(label, label.astype(np.float32), color, label.astype(np.int32)) if names else None
    away: Any = rng.uniform(3, 80, (frames, len(layers), 12)).astype(np.float32)
    away[..., 0] = 60.0  # nothing came back
    slot: Any = rng.integers(-1, 3, away.shape)
    scan = Scan(np.minimum(away, 60.0), slot) if layers else None
    bev: Any = (rng.random((frames, len(CHANNELS), *RASTER.shape)) < 0.3).astype(np.float32)
    zero = np.zeros((frames, 3), np.float32)
    poses: Any = pose
    place = Pose(x=poses[:, 0], y=poses[:, 1], heading=poses[:, 2])
    columns: dict[str, Any] = dict(
        there=np.array([[True, True, False]] * frames),
        id=np.array([[3, -2, 4]] * frames),
        label=zero.astype(int),
        score=zero,
        x=zero + np.array((8.0, -6.0, 1e9)) + np.arange(frames)[:, None] * 0.5,
        y=zero + np.array((1.5, -2.0, np.nan)),
        heading=zero + np.array((0.2, 0.0, 0.0)),
        length=zero + np.array((4.5, 4.0, 4.0)),
        width=zero + 1.8,
        vx=zero + 2.0,
        vy=zero,
        pose=place,
    )
    there: Any = np.zeros((frames, 1), bool)
    none: Any = np.zeros((frames, 1), np.float32)
    names_of = ("x", "y", "z", "heading", "length", "width", "height", "vx", "vy", "label", "lamps", "slot")
    bodies: dict[str, Any] = dict.fromkeys(names_of, none)
    truth = Bodies(**bodies, there=there)
    return Film(
        time=time, step=np.arange(frames), rig=rig, pictures=pictures, scan=scan, bev=bev,
        objects=Objects(**columns),
        truth=truth, hits=np.zeros((frames, 1), int), pose=place, raster=RASTER, size=size, title="a scene",
    )  # fmt: skip
