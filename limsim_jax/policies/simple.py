"""Simple policies for comparison."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from limsim_jax.maps.lane_map import LaneMap, pose
from limsim_jax.policies.base import Policy
from limsim_jax.policies.perception import rules
from limsim_jax.policies.reference import path_from
from limsim_jax.traffic.bodies import body_place
from limsim_jax.traffic.command import Command
from limsim_jax.traffic.ego import Control, Trajectory
from limsim_jax.traffic.engine import Traffic
from limsim_jax.traffic.motion import accelerations
from limsim_jax.types import Config, State


@dataclass(frozen=True)
class ConstantSpeed(Policy):
    """Steers along its route at one speed.

    It ignores other vehicles and lights: how dangerous is it not to look?

    Steering by the pure-pursuit law (Coulter 1992, CMU-RI-TR-92-01): the arc through the point of the lane
    `look_ahead` s ahead.

    Attributes:
      speed: m/s; None: the initial speed.
      look_ahead: s.

    Raises:
      ValueError: a negative speed, or no look-ahead.
    """

    speed: float | None = None
    look_ahead: float = 0.8

    def __post_init__(self) -> None:
        if self.speed is not None and not self.speed >= 0:
            raise ValueError(f"speed: {self.speed} m/s; expected 0 or more")
        if not self.look_ahead > 0:
            raise ValueError(f"look_ahead: {self.look_ahead} s; expected more than 0")

    def init(self, config: Config, lane_map: LaneMap, state: State) -> Any:
        """The speed to keep."""
        del config, lane_map
        v = state.v[state.egos.slot]
        return v if self.speed is None else jnp.full_like(v, self.speed)

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: Any, key: jax.Array
    ) -> tuple[Command, Any]:
        """Steer to the point ahead and hold the speed."""
        del key
        steering = steer_along(lane_map, state, self.look_ahead)
        wish = (memory - state.v[state.egos.slot]) / config.decision_time
        return Command(control=Control(acceleration=wish, steering=steering)), memory


def steer_along(lane_map: LaneMap, state: State, look_ahead: float = 0.8) -> Float[Array, " E"]:
    """Steering (rad) of egos along their routes by pure pursuit.

    Args:
      lane_map: the map.
      state: the world now.
      look_ahead: s to the point of the lane that is pursued.
    """
    egos, slot = state.egos, state.egos.slot
    wheelbase = state.shape.wheelbase[slot]
    v, lane, goal = state.v[slot], state.lane[slot], state.goal[slot]
    reach = jnp.maximum(look_ahead * v, 4.0)
    # the point ahead along the route, up to two lanes on
    there, s = lane, state.s[slot] - state.shape.length[slot] / 2 + reach
    for _ in range(2):
        after = lane_map.routes.next_lane[there, goal]
        beyond = (s > lane_map.length[there]) & (after >= 0)
        s = jnp.where(beyond, s - lane_map.length[there], s)
        there = jnp.where(beyond, after, there)
    x, y, _ = pose(lane_map, there, s)
    cos, sin = jnp.cos(egos.heading), jnp.sin(egos.heading)
    dx, dy = x - (egos.x - wheelbase / 2 * cos), y - (egos.y - wheelbase / 2 * sin)
    across = cos * dy - sin * dx
    bend = 2 * across / jnp.maximum(dx * dx + dy * dy, 1.0)
    return jnp.arctan(wheelbase * bend)


@dataclass(frozen=True)
class FollowLane(Policy):
    """Drives in the plane as the traffic model does on its lane.

    It changes no lanes.

    For comparison: differences from `LikeTraffic` are due to moving in the plane.

    Attributes:
      others: vehicles of the traffic that it can drive beside the egos.
      traffic: right of way and car following.
    """

    others: int = 0
    traffic: Traffic = field(default_factory=Traffic)
    privileged: bool = field(default=True, kw_only=True)

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: Any, key: jax.Array
    ) -> tuple[Command, Any]:
        """The traffic model's acceleration along the lane, held for two seconds."""
        del key
        slot = state.egos.slot
        _, decision = rules(config, self.traffic, lane_map, state, jnp.zeros_like(slot))
        a = accelerations(self.traffic.model, state, decision, jnp.zeros_like(state.s))[slot][:, None]
        lane, s = body_place(lane_map, state, slot)
        path = path_from(lane_map, lane, s, state.goal[slot], points=45, step=2.0)
        times = 0.2 * jnp.arange(11, dtype=jnp.float32)[None]
        v0, d0 = state.v[slot][:, None], state.d[slot][:, None]
        stops = jnp.where(a < 0, v0 / jnp.maximum(-a, 1e-3), 1e3)
        t = jnp.minimum(times, stops)
        along = v0 * t + a * t * t / 2
        place = path.at(along, d0 * jnp.exp(-along / 10.0))
        trajectory = Trajectory(
            x=place.x, y=place.y, heading=place.heading, v=v0 + a * t, t0=config.time(state.step), dt=0.2
        )
        return Command(trajectory=trajectory), memory
