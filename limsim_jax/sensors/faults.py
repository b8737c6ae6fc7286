"""Faults of sensors and actuators, as switches: dark and frozen cameras, a drifting pose, late commands."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from limsim_jax.maps.scenery import Label
from limsim_jax.sensors.camera import FAR, Pictures
from limsim_jax.sensors.chance import Purpose, key_of, whole_steps
from limsim_jax.sensors.rig import Rig
from limsim_jax.sensors.scene import Pose


class FaultMemory(NamedTuple):
    """What faults remember, of `C` cameras."""

    left: Float[Array, " C"]  # s that the fault still lasts
    frozen: Bool[Array, " C"]  # it shows its last picture; otherwise it is dark
    last: Pictures
    drift: Float[Array, " 3"]  # m, m, rad


@dataclass(frozen=True, kw_only=True)
class Faults:
    """Which faults happen. All are off by default; Bench2Drive-Robust has the numbers in brackets.

    Attributes:
      dropped: names of cameras that are dark all the time.
      frozen: names of cameras that always show their first picture.
      drop_rate: faults per s and camera after which it is dark.
      freeze_rate: faults per s and camera after which it shows its last picture.
      shortest, longest: s that such a fault lasts, uniform [0.5, 3].
      position_drift: m per root of a s, random walk of the believed position along each axis [0.05].
      yaw_drift: rad per root of a s, of the believed heading [0.2 degrees].
      delay: s from a command to its effect [0 to 0.3]; `delay_line` and `delayed` make it.

    Raises:
      ValueError: a value out of range.
    """

    dropped: tuple[str, ...] = ()
    frozen: tuple[str, ...] = ()
    drop_rate: float = 0.0
    freeze_rate: float = 0.0
    shortest: float = 0.5
    longest: float = 3.0
    position_drift: float = 0.0
    yaw_drift: float = 0.0
    delay: float = 0.0

    def __post_init__(self) -> None:
        for name in ("drop_rate", "freeze_rate", "position_drift", "yaw_drift", "delay"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"faults: {name}: {getattr(self, name)}; expected 0 or more")
        if not 0 < self.shortest <= self.longest < math.inf:
            raise ValueError(
                f"faults: shortest {self.shortest} s, longest {self.longest} s; expected 0 < shortest"
            )

    def delay_steps(self, dt: float) -> int:
        """Steps from a command to its effect.

        Raises:
          ValueError: a delay that is not a whole number of steps.
        """
        return whole_steps(self.delay, dt, "faults: delay")

    def init(self, rig: Rig, first: Pictures) -> FaultMemory:
        """No fault yet but those that last all the time.

        Args:
          rig: of the vehicle.
          first: its pictures at the start.

        Raises:
          ValueError: a camera that the rig does not have.
        """
        rig.check(*self.dropped, *self.frozen)
        always = [name in (*self.dropped, *self.frozen) for name in rig.names]
        return FaultMemory(
            left=jnp.where(jnp.asarray(always, bool), jnp.inf, 0).astype(jnp.float32),
            frozen=jnp.asarray([name in self.frozen for name in rig.names], bool),
            last=first,
            drift=jnp.zeros(3, jnp.float32),
        )

    def spoil(
        self,
        memory: FaultMemory,
        pictures: Pictures,
        pose: Pose,
        dt: float | Float[Array, ""],
        key: Key[Array, ""],
        step: Int[Array, ""] | int,
    ) -> tuple[Pictures, Pose, FaultMemory]:
        """Pictures and pose as the vehicle gets them, and the memory.

        Args:
          memory: of the last step.
          pictures: as they should be.
          pose: as it is.
          dt: s since the last step.
          key: of the world.
          step: of the run, part of the random numbers.
        """
        cameras = memory.left.shape[0]
        keys = jax.random.split(key_of(key, step, Purpose.CAMERA_FAULTS), 3)
        left, frozen = jnp.maximum(memory.left - dt, 0), memory.frozen
        rate = self.drop_rate + self.freeze_rate
        if rate > 0:
            begins = (left == 0) & jax.random.bernoulli(keys[0], -jnp.expm1(-rate * dt), (cameras,))
            freezes = jax.random.bernoulli(keys[1], self.freeze_rate / rate, (cameras,))
            lasts = jax.random.uniform(
                keys[2], (cameras,), jnp.float32, minval=self.shortest, maxval=self.longest
            )
            left, frozen = jnp.where(begins, lasts, left), jnp.where(begins, freezes, frozen)
        faulty = left > 0

        def shown(now: Array, last: Array, dark: float) -> Array:
            bad, old = (x.reshape(-1, *[1] * (now.ndim - 1)) for x in (faulty, frozen))
            return jnp.where(bad, jnp.where(old, last, jnp.asarray(dark, now.dtype)), now)

        dark = (int(Label.SKY), FAR, 0, -1)
        given = Pictures(*map(shown, pictures, memory.last, dark))
        stuck = faulty & frozen
        last = jax.tree.map(
            lambda old, now: jnp.where(stuck.reshape(-1, *[1] * (now.ndim - 1)), old, now),
            memory.last,
            pictures,
        )
        walk = jax.random.normal(key_of(key, step, Purpose.DRIFT), (3,), jnp.float32)
        size = jnp.asarray([self.position_drift, self.position_drift, self.yaw_drift], jnp.float32)
        drift = memory.drift + walk * size * jnp.sqrt(jnp.asarray(dt, jnp.float32))
        believed = Pose(x=pose.x + drift[0], y=pose.y + drift[1], heading=pose.heading + drift[2])
        return given, believed, FaultMemory(left, frozen, last, drift)
