"""`Sensed`: what a vehicle of a recorded world senses at a moment."""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps.scenery import Scenery
from limsim_jax.sensors.bev import Raster, birds_eye
from limsim_jax.sensors.camera import Pictures, take_pictures
from limsim_jax.sensors.lidar import Scan, scan_around
from limsim_jax.sensors.objects import Detector, Objects, detect
from limsim_jax.sensors.rig import LAYERS_16, Rig, six_cameras
from limsim_jax.sensors.scene import Bodies, Scene, bodies_around, pose_of, scene_of_trace

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from limsim_jax.api.world import World

_OBJECTS, _LIGHTS = 32, 8


@dataclass(frozen=True, eq=False)
class Sensed:
    """What a vehicle senses at a moment; a notebook shows it.

    Attributes:
      time: s.
      rig: of the vehicle.
      pictures: of its cameras; None: it has none.
      scan: of its LiDAR; None: it has none.
      bev: the bird's-eye view, `[6, H, W]`, see `sensors.bev.CHANNELS`.
      objects: its object list.
      truth: the bodies that are there.
      raster: extent of `bev`.
      size: length and width of the vehicle, m.
      title: of the sheet.
    """

    time: float
    rig: Rig
    pictures: Pictures | None
    scan: Scan | None
    bev: NDArray[Any]
    objects: Objects
    truth: Bodies
    raster: Raster
    size: tuple[float, float]
    title: str

    def draw(self, path: str | Path | None = None, *, dpi: float = 100.0) -> Figure:
        """A sheet with pictures, point cloud and bird's-eye view.

        Args:
          path: .png file to write as well.
          dpi: pixels per inch; the sheet is 12 inches wide.
        """
        from limsim_jax.report.sensed import draw_sheet

        return draw_sheet(
            self.rig, self.pictures, self.scan, self.bev, self.objects, raster=self.raster, size=self.size,
            title=self.title, path=path, dpi=dpi,
        )  # fmt: skip

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        self.draw().savefig(file, format="png")
        return file.getvalue()


def sense(
    world: World,
    at: float,
    rig: Rig | None = None,
    *,
    slot: int | None = None,
    detector: Detector | None = None,
    raster: Raster | None = None,
) -> Sensed:
    """What a vehicle of a recorded world senses, see `World.sense`."""
    time = world.trace.time
    if not float(time[0]) - 0.5 <= at <= float(time[-1]) + 0.5:
        raise ValueError(f"at: {at:g} s; the world was recorded from {time[0]:g} to {time[-1]:g} s")
    step = int(np.argmin(np.abs(time - at)))
    slot = world.ego if slot is None else slot
    if slot < 0:
        raise ValueError("slot: the world has no ego; name the slot of a vehicle")
    if slot >= world.trace.active.shape[1] or not world.trace.active[step, slot]:
        raise ValueError(f"slot: no vehicle in slot {slot} at {at:g} s")
    rig = six_cameras(384, 216, LAYERS_16) if rig is None else rig
    detector = detector or Detector(lidar=rig.lidar or LAYERS_16)
    raster = raster or Raster()
    scenery = world.map.scenery
    scene = scene_of_trace(world.map.lanes, scenery, world.trace, step)
    key = jax.random.key(world.seed)
    found = _look(rig, detector, raster, scenery, scene, slot, key, step)
    pictures, scan, bev, objects, bodies = jax.tree.map(np.asarray, found)
    length, width = (float(x) for x in world.trace.box[step, slot, 3:])
    moment = float(time[step])
    return Sensed(
        moment, rig, pictures, scan, bev, objects, bodies, raster, (length, width),
        f"{world.title}, {moment:.1f} s",
    )  # fmt: skip


@partial(jax.jit, static_argnums=(0, 1, 2))
def _look(
    rig: Rig,
    detector: Detector,
    raster: Raster,
    scenery: Scenery,
    scene: Scene,
    slot: Any,
    key: Any,
    step: Any,
) -> tuple[Any, ...]:
    pose, bodies = pose_of(scene, slot), bodies_around(scene, scenery, slot, objects=_OBJECTS, lights=_LIGHTS)
    pictures = take_pictures(rig, scenery, pose, bodies) if rig.cameras else None
    scan = None if rig.lidar is None else scan_around(rig.lidar, bodies, key, step)
    return (
        pictures,
        scan,
        birds_eye(raster, scenery, pose, bodies),
        detect(detector, pose, bodies, key, step),
        bodies,
    )
