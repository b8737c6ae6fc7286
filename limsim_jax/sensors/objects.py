"""The object list of a tracker: what LiDAR rays meet, with errors, misses, false tracks and latency."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, Key

from limsim_jax.maps.scenery import Label
from limsim_jax.sensors.chance import Purpose, key_of, whole_steps
from limsim_jax.sensors.lidar import hits_per_body, scan_around
from limsim_jax.sensors.rig import LAYERS_16, Lidar
from limsim_jax.sensors.scene import Bodies, Pose


@struct.dataclass(frozen=True, kw_only=True)
class Objects:
    """`D` entries of an object list.

    They are in the frame of the ego at the moment of the look.
    """

    there: Bool[Array, " D"]
    id: Int[Array, " D"]  # slot of the vehicle; below 0: a false track
    label: Int[Array, " D"]  # `Label`
    score: Float[Array, " D"]  # 0 to 1, confidence
    x: Float[Array, " D"]  # m
    y: Float[Array, " D"]
    heading: Float[Array, " D"]  # rad
    length: Float[Array, " D"]  # m
    width: Float[Array, " D"]
    vx: Float[Array, " D"]  # m/s
    vy: Float[Array, " D"]
    pose: Pose  # of the ego at that moment


@dataclass(frozen=True, kw_only=True)
class Detector:
    """How an object list comes from a scene.

    A vehicle is seen if enough rays of the LiDAR meet it. Errors are normal, and drawn by world, step,
    purpose and vehicle. Table "Object list" of the reference says where the defaults come from.

    Attributes:
      lidar: whose rays tell what can be seen.
      hits: rays that must meet a vehicle.
      position_noise: m, standard deviation along each axis at no distance.
      position_growth: m more of it per m of distance.
      heading_noise: rad.
      size_noise: m, of length and width.
      speed_noise: m/s, along each axis.
      misses: probability that a vehicle is missed in a look.
      false_tracks: false tracks in a look, on average.
      false_range: m, of false tracks.
      false_steps: steps that a false track lasts.
      slots: false tracks at most.
      latency: s that the list is old; a whole number of steps. `delay_line` and `delayed` of
        `sensors.chance` hold it back in a policy, and `seen_from` moves it into the frame of now.

    Raises:
      ValueError: a value out of range.
    """

    lidar: Lidar = LAYERS_16
    hits: int = 3
    position_noise: float = 0.1
    position_growth: float = 0.004
    heading_noise: float = 0.05
    size_noise: float = 0.1
    speed_noise: float = 0.2
    misses: float = 0.05
    false_tracks: float = 0.1
    false_range: float = 40.0
    false_steps: int = 2
    slots: int = 2
    latency: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self)[2:]:
            value = getattr(self, field.name)
            if not 0 <= value < math.inf:
                raise ValueError(f"detector: {field.name}: {value}; expected 0 or more")
        if self.hits < 1 or self.false_steps < 1:
            raise ValueError(
                f"detector: hits {self.hits}, false_steps {self.false_steps}; expected 1 or more"
            )
        if self.misses > 1:
            raise ValueError(f"detector: misses: {self.misses}; expected a probability")
        if self.false_tracks > self.slots:
            raise ValueError(
                f"detector: false_tracks: {self.false_tracks}; expected at most {self.slots}, the slots"
            )

    def late(self, dt: float) -> int:
        """Steps (of `dt` s) that the list is old.

        Raises:
          ValueError: a latency that is not a whole number of steps.
        """
        return whole_steps(self.latency, dt, "detector: latency")

    def without_errors(self) -> Detector:
        """The same detector, exact and at once for what it sees."""
        names = ("position_noise", "position_growth", "heading_noise", "size_noise", "speed_noise")
        return replace(self, **dict.fromkeys((*names, "misses", "false_tracks", "latency"), 0.0), slots=0)


@jax.named_scope("object_list")
def detect(
    detector: Detector, pose: Pose, bodies: Bodies, key: Key[Array, ""], step: Int[Array, ""] | int
) -> Objects:
    """The object list of a look: the vehicles first, then false tracks.

    Args:
      detector: static.
      pose: of the ego.
      bodies: around it.
      key: of the world.
      step: of the run, part of the random numbers.
    """
    hits = hits_per_body(scan_around(detector.lidar, bodies), bodies)
    vehicle = bodies.slot >= 0
    draw = key_of(key, step, Purpose.DETECTION)
    # by vehicle, not by its place in the list
    keys = jax.vmap(lambda slot: jax.random.fold_in(draw, slot))(jnp.maximum(bodies.slot, 0))
    noise = jax.vmap(lambda k: jax.random.normal(k, (7,), jnp.float32))(keys)
    missed = jax.vmap(lambda k: jax.random.uniform(jax.random.fold_in(k, 1), (), jnp.float32))(keys)
    away = jnp.hypot(bodies.x, bodies.y)
    spread = detector.position_noise + detector.position_growth * away
    found = Objects(
        there=bodies.there & vehicle & (hits >= detector.hits) & (missed >= detector.misses),
        id=bodies.slot,
        label=bodies.label,
        score=hits.astype(jnp.float32) / (hits + 2 * detector.hits).astype(jnp.float32),
        x=bodies.x + spread * noise[:, 0],
        y=bodies.y + spread * noise[:, 1],
        heading=bodies.heading + detector.heading_noise * noise[:, 2],
        length=jnp.maximum(bodies.length + detector.size_noise * noise[:, 3], 0.1),
        width=jnp.maximum(bodies.width + detector.size_noise * noise[:, 4], 0.1),
        vx=bodies.vx + detector.speed_noise * noise[:, 5],
        vy=bodies.vy + detector.speed_noise * noise[:, 6],
        pose=pose,
    )
    if not detector.slots:
        return found
    false = _false_tracks(detector, key, step)
    columns = {
        field.name: jnp.concatenate([getattr(found, field.name), false[field.name]])
        for field in fields(found)
        if field.name != "pose"
    }
    return Objects(**columns, pose=pose)


def _false_tracks(detector: Detector, key: Key[Array, ""], step: Int[Array, ""] | int) -> dict[str, Array]:
    """Cars that are not there. Each stays at its place beside the ego for some steps."""
    count = detector.slots
    epoch = jnp.asarray(step, jnp.int32) // detector.false_steps
    keys = jax.random.split(key_of(key, epoch, Purpose.FALSE_TRACKS), 3)
    draws = jax.random.uniform(keys[0], (4, count), jnp.float32)
    away, around = detector.false_range * jnp.sqrt(draws[1]), 2 * math.pi * draws[2]
    one = jnp.ones(count, jnp.float32)
    return {
        "there": draws[0] < detector.false_tracks / count,
        "id": -2 - (epoch * count + jnp.arange(count, dtype=jnp.int32)),
        "label": jnp.full(count, int(Label.CAR), jnp.int32),
        "score": jax.random.uniform(keys[1], (count,), jnp.float32, maxval=0.5),
        "x": away * jnp.cos(around),
        "y": away * jnp.sin(around),
        "heading": 2 * math.pi * draws[3],
        "length": 4.6 * one,
        "width": 1.8 * one,
        "vx": 0 * one,
        "vy": 0 * one,
    }


def seen_from(objects: Objects, pose: Pose) -> Objects:
    """The object list in the frame of a later pose."""
    old = objects.pose
    cos, sin = jnp.cos(old.heading), jnp.sin(old.heading)
    x = old.x - pose.x + cos * objects.x - sin * objects.y
    y = old.y - pose.y + sin * objects.x + cos * objects.y
    turned = old.heading - pose.heading
    c, s = jnp.cos(pose.heading), jnp.sin(pose.heading)
    ct, st = jnp.cos(turned), jnp.sin(turned)
    return replace(
        objects,
        x=c * x + s * y,
        y=c * y - s * x,
        heading=objects.heading + turned,
        vx=ct * objects.vx - st * objects.vy,
        vy=st * objects.vx + ct * objects.vy,
        pose=pose,
    )
