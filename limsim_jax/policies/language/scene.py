"""What a language driver is told about: the ego, its lane, and the vehicles around it by lane.

Functions take NumPy or JAX arrays, so that a planner in JAX and a text are made of the same numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from limsim_jax.maps.lane_map import LaneMap, width
from limsim_jax.policies.host import Observation, Observe
from limsim_jax.policies.language.pictures import look
from limsim_jax.sensors.rig import Rig
from limsim_jax.traffic.ego import Meta, meta_lane
from limsim_jax.types import Config, State

NONE = 1e6
"""m to a vehicle where there is none."""
TTC_LIMIT = 99.0
"""s: longer times to a collision are told as none."""
_WITH = 0.5  # cosine: vehicles beside that point elsewhere by more than 60 degrees are not on a lane beside
_CLOSING = 0.1  # m/s: slower approaches have no time to a collision


class Scene(NamedTuple):
    """An observation and the lane changes that are possible, `[B, E]`."""

    seen: Observation
    left: Any  # bool: marks and lanes allow a change to the left now
    right: Any
    lane_width: Any  # m
    pictures: Any = None  # [B, E, C, H, W, 3], of the cameras; None: there are none


@dataclass(frozen=True)
class LookAround:
    """Makes the `Scene` of one world.

    Attributes:
      nearest: number of vehicles.
      points: points of the reference path.
      step: m between points.
      rig: whose cameras take pictures; None: none are taken.
    """

    nearest: int = 12
    points: int = 60
    step: float = 2.5
    rig: Rig | None = None

    @property
    def needs_scenery(self) -> bool:
        """Whether pictures are taken."""
        return self.rig is not None

    def __call__(self, config: Config, lane_map: LaneMap, state: State) -> Scene:
        """The world as its egos see it."""
        slot = state.egos.slot
        seen = Observe(self.nearest, self.points, self.step)(config, lane_map, state)

        def may(action: Meta) -> Any:
            return meta_lane(lane_map, state, jnp.full_like(slot, int(action))) != 0

        lane_width = width(lane_map, state.lane[slot], state.s[slot])
        pictures = None if self.rig is None else look(self.rig, lane_map, state)
        return Scene(seen, may(Meta.LEFT), may(Meta.RIGHT), lane_width, pictures)


class Neighbour(NamedTuple):
    """The nearest vehicle on one side, ahead or behind."""

    gap: Any  # m between bumpers, `NONE` without a vehicle
    v: Any  # m/s


class Facts(NamedTuple):
    """The numbers of a description, with the axes of the scene."""

    v: Any  # m/s
    limit: Any  # m/s
    ahead: Neighbour
    left_ahead: Neighbour
    left_behind: Neighbour
    right_ahead: Neighbour
    right_behind: Neighbour
    light: Any  # `SignalState`
    light_distance: Any  # m
    to_go: Any  # lanes to cross for the route, left > 0
    to_go_within: Any  # m
    left: Any  # bool
    right: Any


_AROUND = ("ahead", "left_ahead", "left_behind", "right_ahead", "right_behind")


def numbers(told: Facts) -> tuple[float, ...]:
    """The facts of one ego as a row of numbers, `[18]`."""
    flat = (x if isinstance(x, tuple) else (x,) for x in told)
    return tuple(float(number) for part in flat for number in part)


def facts_of(row: Sequence[float]) -> Facts:
    """The facts that `numbers` made a row of."""
    left = iter(row)
    values: dict[str, Any] = {
        name: Neighbour(next(left), next(left)) if name in _AROUND else next(left) for name in Facts._fields
    }
    values |= {name: int(values[name]) for name in ("light", "to_go")}
    values |= {name: bool(values[name]) for name in ("left", "right")}
    return Facts(**values)


def facts(scene: Scene, xp: ModuleType = np) -> Facts:
    """The facts of a scene.

    Vehicles are put on lanes by their distance from the reference path, in widths of the own lane.

    Args:
      scene: of any leading axes.
      xp: `numpy` or `jax.numpy`.
    """
    seen = scene.seen
    along, aside, turned = _on_path(seen, xp)
    lane = xp.round(aside / xp.maximum(scene.lane_width, 2.0)[..., None])
    apart = (seen.other_length + seen.length[..., None]) / 2
    gap = xp.maximum(xp.abs(along) - apart, 0.0)
    with_us = seen.there & (turned > _WITH)

    def nearest(which: Any) -> Neighbour:
        found = xp.where(which, gap, NONE)
        first = found.argmin(-1)[..., None]
        return Neighbour(
            xp.take_along_axis(found, first, -1)[..., 0],
            xp.where(which.any(-1), xp.take_along_axis(seen.other_v, first, -1)[..., 0], 0.0),
        )

    front = along > 0
    return Facts(
        v=seen.v,
        limit=seen.limit,
        ahead=nearest(seen.there & (lane == 0) & front),
        left_ahead=nearest(with_us & (lane == 1) & front),
        left_behind=nearest(with_us & (lane == 1) & ~front),
        right_ahead=nearest(with_us & (lane == -1) & front),
        right_behind=nearest(with_us & (lane == -1) & ~front),
        light=seen.light,
        light_distance=seen.light_distance,
        to_go=seen.to_go,
        to_go_within=seen.to_go_within,
        left=scene.left,
        right=scene.right,
    )


def time_to_collision(gap: Any, closing: Any, xp: ModuleType = np) -> Any:
    """Seconds at constant speeds, at most `TTC_LIMIT`.

    Args:
      gap: m.
      closing: m/s by which it shrinks.
      xp: `numpy` or `jax.numpy`.
    """
    found = gap / xp.maximum(closing, _CLOSING)
    return xp.where(closing > _CLOSING, xp.minimum(found, TTC_LIMIT), TTC_LIMIT)


def _on_path(seen: Observation, xp: ModuleType) -> tuple[Any, Any, Any]:
    """Others by the path: m along, m aside (left > 0), cosine."""
    dx = seen.other_x[..., :, None] - seen.way_x[..., None, :]
    dy = seen.other_y[..., :, None] - seen.way_y[..., None, :]
    near = (dx * dx + dy * dy).argmin(-1)[..., None]

    def pick(values: Any) -> Any:
        return xp.take_along_axis(values, near, -1)[..., 0]

    steps_x, steps_y = xp.diff(seen.way_x, axis=-1), xp.diff(seen.way_y, axis=-1)
    station = xp.cumsum(xp.sqrt(steps_x**2 + steps_y**2), axis=-1)
    station = xp.concatenate([xp.zeros_like(station[..., :1]), station], -1)[..., None, :]
    heading = pick(xp.broadcast_to(seen.way_heading[..., None, :], dx.shape))
    cos, sin = xp.cos(heading), xp.sin(heading)
    x, y = pick(dx), pick(dy)
    along = pick(xp.broadcast_to(station, dx.shape)) + cos * x + sin * y
    return along, cos * y - sin * x, xp.cos(seen.other_heading - heading)
