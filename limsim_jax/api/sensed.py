"""`Sensed` and `Film`: what a vehicle of a recorded world senses, at a moment and over an episode."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps.scenery import Scenery
from limsim_jax.policies.base import sensors_of
from limsim_jax.sensors.bev import Raster, birds_eye
from limsim_jax.sensors.camera import Pictures, take_pictures
from limsim_jax.sensors.faults import Faults
from limsim_jax.sensors.lidar import Scan, hits_per_body, scan_around
from limsim_jax.sensors.objects import Detector, Objects, detect, seen_from
from limsim_jax.sensors.rig import LAYERS_16, Rig, rig_named, six_cameras
from limsim_jax.sensors.scene import Bodies, Pose, Scene, bodies_around, pose_of, scene_of_trace

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from limsim_jax.api.world import World
    from limsim_jax.sweeps.episode import Episodes

EVERY = 0.5
"""s between frames of a film of a world without decisions."""

MOST_FRAMES = 240
"""Frames of a film that is shown beside the traffic."""

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


@dataclass(frozen=True, eq=False)
class Film:
    """What a vehicle senses over an episode: a sequence of `F` `Sensed`, or arrays.

    Attributes:
      time: s, `[F]`.
      step: of the trace, `[F]`.
      rig: of the vehicle.
      pictures: of its cameras, `[F, C, H, W]`; None: it has none.
      scan: of its LiDAR, `[F, R, A]`; None: it has none.
      bev: the bird's-eye view, `[F, 6, H, W]`, see `sensors.bev.CHANNELS`.
      objects: its object list, `[F, D]`. `objects.pose` is where the vehicle believes to be.
      truth: the bodies that are there, `[F, K]`.
      hits: rays of the LiDAR of the detector, without errors, that meet each body, `[F, K]`.
      pose: where the vehicle is, `[F]`.
      raster: extent of `bev`.
      size: length and width of the vehicle, m.
      title: of the world.
    """

    time: NDArray[Any]
    step: NDArray[Any]
    rig: Rig
    pictures: Pictures | None
    scan: Scan | None
    bev: NDArray[Any]
    objects: Objects
    truth: Bodies
    hits: NDArray[Any]
    pose: Pose
    raster: Raster
    size: tuple[float, float]
    title: str

    @property
    def spacing(self) -> float:
        """Median time between frames, s."""
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else 0.0

    def __len__(self) -> int:
        return len(self.time)

    def __getitem__(self, k: int) -> Sensed:
        """What is sensed in frame `k`."""
        if not -len(self) <= k < len(self):
            raise IndexError(f"frame {k}; the film has {len(self)}")
        pictures, scan, bev, objects, truth = jax.tree.map(
            lambda x: x[k], (self.pictures, self.scan, self.bev, self.objects, self.truth)
        )
        at = float(self.time[k])
        return Sensed(
            at, self.rig, pictures, scan, bev, objects, truth, self.raster, self.size,
            f"{self.title}, {at:.1f} s",
        )  # fmt: skip

    def __iter__(self) -> Iterator[Sensed]:
        return (self[k] for k in range(len(self)))

    def save(self, path: str | Path, *, fps: float | None = None) -> Path:
        """Write the film to a file.

        Args:
          path: .gif or .mp4 (pictures, point cloud and bird's-eye view), or .npz (arrays).
          fps: frames per second of a video; None: as fast as it happened.

        Raises:
          ValueError: another suffix.
        """
        path = Path(path)
        suffix = path.suffix.lower()
        if suffix not in (".gif", ".mp4", ".npz"):
            raise ValueError(f"cannot write '{path}': use .gif, .mp4 or .npz")
        path.parent.mkdir(parents=True, exist_ok=True)
        if suffix == ".npz":
            np.savez_compressed(path, allow_pickle=False, **self.arrays())
            return path
        from limsim_jax.report.strip import write_strips

        write_strips(path, self, fps=fps)
        return path

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All arrays by name, such as `pictures_depth` and `objects_x`; frames are the first axis."""
        found: dict[str, Any] = {"time": self.time, "step": self.step, "bev": self.bev, "hits": self.hits}
        groups = {"pictures": self.pictures, "scan": self.scan}
        for group, of in groups.items():
            if of is not None:
                found |= {f"{group}_{name}": value for name, value in of._asdict().items()}
        for group, of in {"objects": self.objects, "truth": self.truth, "pose": self.pose}.items():
            for field in fields(of):
                value = getattr(of, field.name)
                if isinstance(value, Pose):
                    found |= {f"believed_{name.name}": getattr(value, name.name) for name in fields(value)}
                else:
                    found[f"{group}_{field.name}"] = value
        return found

    def __repr__(self) -> str:
        seen = [name for name in (*self.rig.names, "lidar" if self.rig.lidar else "") if name]
        return f"Film of {self.title}: {len(self)} frames, {', '.join(seen)}"


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
    slot = _slot(world, slot)
    if not world.trace.active[step, slot]:
        raise ValueError(f"slot: no vehicle in slot {slot} at {at:g} s")
    rig = six_cameras(384, 216, LAYERS_16) if rig is None else rig
    return _shots(world, rig, slot, np.array([step]), detector, raster, None)[0]


def film(
    world: World,
    rig: Rig | str = "six",
    *,
    slot: int | None = None,
    every: float | None = None,
    begin: float | None = None,
    end: float | None = None,
    detector: Detector | None = None,
    raster: Raster | None = None,
    faults: Faults | None = None,
) -> Film:
    """What a vehicle of a recorded world senses over time, see `World.film`."""
    rig = check_sensors(world.episodes, rig)
    slot = _slot(world, slot)
    every = _decision_time(world) if every is None else every
    return _shots(world, rig, slot, _frames(world, slot, every, begin, end), detector, raster, faults)


def watch(world: World, rig: Rig | str) -> Film:
    """A film to look at: a frame per decision, or per few of them if the episode is long."""
    rig = check_sensors(world.episodes, rig)
    every = _decision_time(world)
    frames = len(_frames(world, _slot(world, None), every, None, None))
    return film(world, rig, every=every * math.ceil(frames / MOST_FRAMES))


def check_sensors(episodes: Episodes | None, rig: Rig | str) -> Rig:
    """The rig that is meant; `own` is that of the policy. Nothing is compiled.

    Raises:
      ValueError: an unknown name, a policy without sensors, or an experiment without an ego.
    """
    if isinstance(rig, Rig):
        return rig
    if rig != "own":
        try:
            return rig_named(rig)
        except ValueError as error:
            raise ValueError(f"sensors: {error}, own") from None
    found = None if episodes is None else sensors_of(episodes.rollout.policy)
    if found is None:
        name = "none" if episodes is None else episodes.policy
        raise ValueError(f"sensors: own: policy '{name}' declares no sensors; use six, front or one")
    return found


def _slot(world: World, slot: int | None) -> int:
    slot = world.ego if slot is None else slot
    if slot < 0:
        raise ValueError("slot: the world has no ego; name the slot of a vehicle")
    if slot >= world.trace.active.shape[1]:
        raise ValueError(f"slot: no vehicle in slot {slot}; there are {world.trace.active.shape[1]} slots")
    return slot


def _decision_time(world: World) -> float:
    return EVERY if world.episodes is None else world.episodes.rollout.config.decision_time


def _frames(world: World, slot: int, every: float, begin: float | None, end: float | None) -> NDArray[Any]:
    """Steps of the trace at multiples of a time, s.

    Its first step comes first."""
    if not (0 < every < np.inf):
        raise ValueError(f"every: {every:g} s; expected more than 0")
    time = np.asarray(world.trace.time, float)
    at = np.arange(1, int(time[-1] / every + 1e-6) + 1) * every
    after = np.searchsorted(time, at - 1e-4)
    steps = np.unique([0, *after[after < len(time)]])
    active, vehicle = world.trace.active[:, slot], world.trace.vehicle[:, slot]
    low, high = (-np.inf if begin is None else begin - 1e-4), (np.inf if end is None else end + 1e-4)
    steps = steps[(time[steps] >= low) & (time[steps] <= high) & active[steps]]
    if not steps.size:
        begin, end = time[0] if begin is None else begin, time[-1] if end is None else end
        raise ValueError(f"slot: no vehicle in slot {slot} in any frame from {begin:g} to {end:g} s")
    return steps[vehicle[steps] == vehicle[steps[0]]]  # another one may get the slot


def _shots(
    world: World,
    rig: Rig,
    slot: int,
    steps: NDArray[Any],
    detector: Detector | None,
    raster: Raster | None,
    faults: Faults | None,
) -> Film:
    """One look per step; a list of objects that is late was made some steps before."""
    detector = detector or Detector(lidar=rig.lidar or LAYERS_16)
    raster = raster or Raster()
    time = np.asarray(world.trace.time, float)
    late = detector.late(float(time[1] - time[0]) if len(time) > 1 else EVERY)
    scenery, key = world.map.scenery, jax.random.key(world.seed)
    first = int(np.argmax(world.trace.active[:, slot] & (world.trace.vehicle[:, slot] ==
                                                         world.trace.vehicle[steps[0], slot])))  # fmt: skip
    seen, memory, before = [], None, float(time[steps[0]])
    for step in steps.tolist():
        was = max(step - late, first)
        past = _scene(world, scenery, was) if late else None
        pictures, scan, bev, objects, bodies, hits, pose = _look(
            rig, detector, raster, scenery, _scene(world, scenery, step), past, slot, key, (step, was)
        )
        if faults is not None:
            shown = _no_pictures() if pictures is None else pictures
            memory = faults.init(rig, shown) if memory is None else memory
            shown, believed, memory = _spoil(
                faults, memory, shown, pose, float(time[step]) - before, key, step
            )
            pictures, objects = None if pictures is None else shown, replace(objects, pose=believed)
            before = float(time[step])
        seen.append(jax.tree.map(np.asarray, (pictures, scan, bev, objects, bodies, hits, pose)))
    stacked = jax.tree.map(lambda *x: np.stack(x), *seen)
    length, width = (float(x) for x in world.trace.box[steps[0], slot, 3:])
    pictures, scan, bev, objects, bodies, hits, pose = stacked
    return Film(
        time=time[steps], step=steps, rig=rig, pictures=pictures, scan=scan, bev=bev, objects=objects,
        truth=bodies, hits=hits, pose=pose, raster=raster, size=(length, width), title=world.title,
    )  # fmt: skip


def _scene(world: World, scenery: Scenery, step: int) -> Scene:
    return scene_of_trace(world.map.lanes, scenery, world.trace, step)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _look(
    rig: Rig,
    detector: Detector,
    raster: Raster,
    scenery: Scenery,
    scene: Scene,
    past: Scene | None,
    slot: Any,
    key: Any,
    steps: tuple[Any, Any],
) -> tuple[Any, ...]:
    """What there is to see now.

    The object list is that of the past in the frame of now."""
    step, was = steps

    def around(scene: Scene) -> Bodies:
        return bodies_around(scene, scenery, slot, objects=_OBJECTS, lights=_LIGHTS)

    pose, bodies = pose_of(scene, slot), around(scene)
    pictures = take_pictures(rig, scenery, pose, bodies) if rig.cameras else None
    scan = None if rig.lidar is None else scan_around(rig.lidar, bodies, key, step)
    if past is None:
        objects = detect(detector, pose, bodies, key, was)
    else:
        objects = seen_from(detect(detector, pose_of(past, slot), around(past), key, was), pose)
    hits = hits_per_body(scan_around(detector.lidar, bodies), bodies)
    return pictures, scan, birds_eye(raster, scenery, pose, bodies), objects, bodies, hits, pose


@partial(jax.jit, static_argnums=(0,))
def _spoil(faults: Faults, *rest: Any) -> tuple[Any, ...]:
    return faults.spoil(*rest)


def _no_pictures() -> Pictures:
    """Those of a rig without cameras."""
    none = jnp.zeros((0, 1, 1), jnp.float32)
    return Pictures(none.astype(jnp.uint8), none, jnp.zeros((0, 1, 1, 3), jnp.uint8), none.astype(jnp.int32))
