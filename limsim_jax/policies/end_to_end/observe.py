"""The arrays of the sensors for planners outside JAX: `HostPolicy(function, observe=ObserveSensors())`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt8

from limsim_jax.geometry import wrap_angle
from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.policies.end_to_end.inputs import Sensors, front_rig, route_of
from limsim_jax.sensors.rig import Rig
from limsim_jax.types import Config, State

ROUTE_POINTS = 48
"""Points of the route, 2 m apart."""


class SensorArrays(NamedTuple):
    """What the sensors of the egos give.

    A planner on the host gets `[B, E, ...]`. `C` cameras of `H` x `W` pixels, `R` layers and `A` directions
    of the LiDAR. The route is in the frame of the ego: x ahead of the middle of its body, y to the left.
    """

    cameras: UInt8[Array, "E C H W 3"]  # red, green, blue
    lidar: Float[Array, "E R A"]  # m; the range of the sensor: nothing came back
    route_x: Float[Array, "E 48"]  # m
    route_y: Float[Array, "E 48"]
    route_heading: Float[Array, "E 48"]  # rad
    route_limit: Float[Array, "E 48"]  # m/s
    v: Float[Array, " E"]  # m/s
    a: Float[Array, " E"]  # m/s^2
    steering: Float[Array, " E"]  # rad
    wheelbase: Float[Array, " E"]  # m


@dataclass(frozen=True)
class ObserveSensors:
    """Makes the `SensorArrays` of one world.

    Attributes:
      rig: of the vehicles; it has cameras of one size and a LiDAR.

    Raises:
      ValueError: a rig without one of both.
    """

    rig: Rig = field(default_factory=front_rig)

    needs_scenery = True
    knows = "sensors"

    def __post_init__(self) -> None:
        if not self.rig.cameras or self.rig.lidar is None:
            raise ValueError("rig: cameras and a lidar are needed")

    def __call__(self, config: Config, lane_map: LaneMap, state: State) -> SensorArrays:
        """What the sensors give now."""
        key = jax.random.fold_in(jax.random.key(0), state.step)
        look = Sensors(self.rig, own_network=False).look(lane_map, state, key)
        path, egos, slot = route_of(lane_map, state), state.egos, state.egos.slot
        cos, sin = jnp.cos(egos.heading)[:, None], jnp.sin(egos.heading)[:, None]
        dx, dy = (x[:, :ROUTE_POINTS] - x0[:, None] for x, x0 in ((path.x, egos.x), (path.y, egos.y)))
        return SensorArrays(
            cameras=look.pictures.color,
            lidar=look.scan.range,
            route_x=cos * dx + sin * dy,
            route_y=cos * dy - sin * dx,
            route_heading=wrap_angle(path.heading[:, :ROUTE_POINTS] - egos.heading[:, None]),
            route_limit=path.limit[:, :ROUTE_POINTS],
            v=state.v[slot],
            a=egos.a,
            steering=egos.steering,
            wheelbase=state.shape.wheelbase[slot],
        )
