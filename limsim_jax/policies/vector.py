"""What egos see, as one vector of numbers each: the input of a learned policy."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.maps.signal_table import SignalState
from limsim_jax.policies.host import Observe
from limsim_jax.traffic.ego import Limits, Meta, meta_lane
from limsim_jax.types import Config, State

EGO = (
    "speed", "acceleration", "steering", "speed limit", "offset from the middle of the lane",
    "heading against the lane", "lanes to cross for the route", "distance within which to cross them",
    "side of a lane change that runs", "a lane to the left may be entered",
    "a lane to the right may be entered", "distance to the goal",
)  # fmt: skip
"""Numbers of the ego itself, in their order."""

ROUTE = ("x", "y", "speed limit")
"""Numbers of a point of the route."""

OTHER = ("there", "x", "y", "cos heading", "sin heading", "speed less that of the ego", "length", "width")
"""Numbers of another vehicle, the nearest one first; zeros where there is none."""

LIGHT = ("none", "stop", "yellow", "green", "distance")
"""Numbers of the next light: which one it is, and the distance to its stop line."""

# what 1 stands for
SPEED = 40.0  # m/s, a motorway without a limit
ACROSS = 20.0  # m, five lanes
ALONG = 100.0  # m, three seconds at that speed
FAR = 1000.0  # m, of lane changes and goals
LANES = 4.0
LANE = 4.0  # m, width of a lane
LENGTH = 20.0  # m, the longest vehicles
WIDTH = 3.0  # m, the widest ones

_STOP = (SignalState.RED, SignalState.RED_YELLOW, SignalState.STOP)
_GREEN = (SignalState.GREEN_MINOR, SignalState.GREEN_MAJOR)


@dataclass(frozen=True)
class ObserveVector:
    """Makes a vector per ego: itself, its route, the nearest others and the next light.

    All numbers are finite and within [-1, 1]: each is divided by a typical size, and what is larger is
    clipped. Positions are in the frame of the ego, x ahead and y to the left. The order is `EGO`, `points`
    times `ROUTE`, `nearest` times `OTHER`, `LIGHT`. An ego that has left the road sees zeros.

    Attributes:
      nearest: other vehicles.
      points: of the route, the middle of its lane.
      step: m between points.
    """

    nearest: int = 16
    points: int = 20
    step: float = 5.0

    @property
    def size(self) -> int:
        """Numbers per ego, `D`."""
        return len(EGO) + self.points * len(ROUTE) + self.nearest * len(OTHER) + len(LIGHT)

    def __call__(self, config: Config, lane_map: LaneMap, state: State) -> Float[Array, "E D"]:
        """The vectors of one world."""
        seen = Observe(nearest=self.nearest, points=self.points, step=self.step)(config, lane_map, state)
        slot, limits = state.egos.slot, Limits()
        lane, goal = state.lane[slot], state.goal[slot]
        room = may_change(lane_map, state)
        ego = [
            seen.v / SPEED,
            seen.a / limits.deceleration,
            seen.steering / limits.steering,
            seen.limit / SPEED,
            state.d[slot] / LANE,
            -seen.way_heading[:, 0] / (jnp.pi / 2),
            seen.to_go.astype(jnp.float32) / LANES,
            seen.to_go_within / FAR,
            state.side[slot],
            room[:, 0],
            room[:, 1],
            (lane_map.routes.distance[lane, goal] - state.s[slot]) / FAR,
        ]
        route = [seen.way_x / ALONG, seen.way_y / ACROSS, seen.way_limit / SPEED]
        other = [
            seen.there,
            seen.other_x / ALONG,
            seen.other_y / ACROSS,
            jnp.cos(seen.other_heading),
            jnp.sin(seen.other_heading),
            (seen.other_v - seen.v[:, None]) / (SPEED / 2),
            seen.other_length / LENGTH,
            seen.other_width / WIDTH,
        ]
        stop, yellow, green = (
            jnp.isin(seen.light, jnp.asarray([int(x) for x in which], seen.light.dtype))
            for which in (_STOP, (SignalState.YELLOW,), _GREEN)
        )
        light = [~(stop | yellow | green), stop, yellow, green, seen.light_distance / (2 * ALONG)]
        ego, route, other, light = (
            jnp.stack([jnp.asarray(x, jnp.float32) for x in part], -1) for part in (ego, route, other, light)
        )
        other = jnp.where(seen.there[..., None], other, 0.0)
        rows = [x.reshape(x.shape[0], -1) for x in (ego, route, other, light)]
        vector = jnp.nan_to_num(jnp.concatenate(rows, -1), nan=0.0, posinf=1.0, neginf=-1.0)
        return jnp.where(state.active[slot][:, None], jnp.clip(vector, -1.0, 1.0), 0.0)


def may_change(lane_map: LaneMap, state: State) -> Bool[Array, "E 2"]:
    """Whether marks and lanes allow a change to the left, right."""
    kept = replace(state, egos=replace(state.egos, free=jnp.zeros_like(state.egos.free)))
    every = jnp.zeros_like(state.egos.slot)
    sides = (meta_lane(lane_map, kept, every + int(meta)) for meta in (Meta.LEFT, Meta.RIGHT))
    return jnp.stack([side != 0 for side in sides], -1)
