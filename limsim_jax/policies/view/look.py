"""The view of a planner: sensors with a range, noise, misses, latency and occlusion; beliefs for the rest."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from limsim_jax.maps.lane_map import NO_LANE, LaneMap
from limsim_jax.policies.view.drivers import Seen, believed, nothing_seen, watch
from limsim_jax.policies.view.routes import believed_goals
from limsim_jax.traffic.collision import CLEARANCE, level
from limsim_jax.traffic.motion import boxes, without
from limsim_jax.types import Config, State

_MOTION = (
    "active", "lane", "previous", "s", "d", "v", "a", "side", "crossed", "progress", "shift", "waiting",
    "stopped", "yielding", "entered",
)  # fmt: skip
_HIDDEN = {"vehicle": -1, "rest": 0, "distance": 0, "status": 0, "struck": -1, "struck_at": 0}
_PURPOSE = 0x5EE  # of the random keys


class Sight(NamedTuple):
    """What a view remembers."""

    drivers: Seen
    past: tuple[Array, ...] | None  # the fields of `_MOTION` at the last decisions, `[L, N]`, oldest first


@dataclass(frozen=True)
class View:
    """What a planner sees and believes of other vehicles.

    It sees positions, sizes, speeds, accelerations, lane changes in progress and how long a vehicle stands,
    within `range` of any vehicle that it drives. Of its own vehicles it knows everything. It sees the lights,
    but not how long they last. It believes in typical drivers, corrected by what it has seen (`drivers`), and
    in routes by turn signals (`routes`). Errors are drawn by world, vehicle and decision.

    Attributes:
      range: m between centres; long-range lidar and radar of test vehicles reach 200 to 300 m.
      occlusion: whether bodies hide what is behind them.
      signals: share of the vehicles that signal their turns.
      signal_distance: m before a turn from which a vehicle signals (100 ft: California Vehicle Code 22108).
      position_noise: m, standard deviation along and across the lane.
      speed_noise: m/s, standard deviation.
      misses: probability that a vehicle is not detected in a look.
      latency: s that the picture of the others is old, in whole decisions.

    Raises:
      ValueError: a value out of range.
    """

    range: float = 200.0
    occlusion: bool = False
    signals: float = 1.0
    signal_distance: float = 30.5
    position_noise: float = 0.0
    speed_noise: float = 0.0
    misses: float = 0.0
    latency: float = 0.0

    def __post_init__(self) -> None:
        for name in ("signals", "misses"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"view.{name}: {getattr(self, name)}; expected a share within 0 and 1")
        units = {"signal_distance": "m", "position_noise": "m", "speed_noise": "m/s", "latency": "s"}
        for name, unit in units.items():
            if not (0 <= getattr(self, name) < math.inf):
                raise ValueError(f"view.{name}: {getattr(self, name)} {unit}; expected 0 or more")
        if not self.range > 0:
            raise ValueError(f"view.range: {self.range} m; expected more than 0")

    def without_errors(self) -> View:
        """The same view of all within its range, exact and at once."""
        errors = ("position_noise", "speed_noise", "misses", "latency")
        return replace(self, occlusion=False, **dict.fromkeys(errors, 0.0))

    def late(self, config: Config) -> int:
        """Decisions that the picture is old.

        Raises:
          ValueError: a latency that is not a whole number of decisions.
        """
        count = round(self.latency / config.decision_time)
        if abs(count * config.decision_time - self.latency) > 1e-6:
            raise ValueError(
                f"view.latency: {self.latency} s; expected a multiple of {config.decision_time:g} s, "
                "the time of a decision"
            )
        return count

    def init(self, config: Config, state: State) -> Sight:
        """Nothing is known yet; the past was as the present."""
        count, past = self.late(config), None
        if count:
            past = tuple(
                jnp.broadcast_to(getattr(state, n), (count, *getattr(state, n).shape)) for n in _MOTION
            )
        return Sight(nothing_seen(state), past)

    @jax.named_scope("view")
    def look(
        self, config: Config, lane_map: LaneMap, state: State, sight: Sight, key: Key[Array, ""]
    ) -> tuple[State, Sight]:
        """The world as the planner sees it, and its memory.

        Args:
          config: of the run.
          lane_map: the map.
          state: the world now; `state.egos` are the vehicles that the planner drives.
          sight: the memory.
          key: of this decision.
        """
        number = state.lane.shape[0]
        mine = (jnp.arange(number)[:, None] == state.egos.slot[None]).any(-1)
        seen, past = state, sight.past
        if past is not None:
            now = tuple(getattr(state, name) for name in _MOTION)
            seen = _before(state, mine, dict(zip(_MOTION, (x[0] for x in past), strict=True)))
            past = tuple(jnp.concatenate([old[1:], new[None]]) for old, new in zip(past, now, strict=True))
        keys = jax.random.split(jax.random.fold_in(key, _PURPOSE), 3)
        seen = without(seen, ~(mine | self._visible(lane_map, seen, mine, keys[0])))
        signals = ~mine & self._signalling(seen)
        goal = believed_goals(lane_map, seen, mine, signals, self.signal_distance)
        seen = self._blurred(lane_map, replace(seen, goal=goal), mine, keys[1:])
        drivers = watch(config, lane_map, seen, sight.drivers)
        return _believed(seen, mine, drivers), Sight(drivers, past)

    def _visible(
        self, lane_map: LaneMap, state: State, mine: Bool[Array, " N"], key: Key[Array, ""]
    ) -> Bool[Array, " N"]:
        """Vehicles that the sensors find."""
        found = jnp.ones_like(mine)
        if self.range < math.inf or self.occlusion:
            box = boxes(lane_map, state)
            slot = state.egos.slot
            eyes = box[slot, :2]  # [E 2]
            drives = (slot >= 0) & state.active[slot]
            away = jnp.sum((box[None, :, :2] - eyes[:, None]) ** 2, -1)  # [E N]
            near = (away <= self.range**2) & drives[:, None]
            if self.occlusion:
                near &= ~_hidden(eyes, slot, box, level(lane_map, state), state.active)
            found = near.any(0)
        if self.misses > 0:
            found &= ~jax.random.bernoulli(key, self.misses, found.shape)
        return found

    def _blurred(
        self, lane_map: LaneMap, state: State, mine: Bool[Array, " N"], keys: Key[Array, " 2"]
    ) -> State:
        """The vehicles with errors of measurement, on their believed routes."""
        sees = state.active & ~mine
        if self.position_noise > 0:
            error = jax.random.normal(keys[0], (2, *mine.shape), state.s.dtype) * self.position_noise
            s, d = state.s + jnp.where(sees, error[0], 0), state.d + jnp.where(sees, error[1], 0)
            # beyond the ends of its lane a vehicle is on the lane before or after
            after = lane_map.routes.next_lane[state.lane, state.goal]
            over = sees & (s > lane_map.length[state.lane]) & (after != NO_LANE)
            under = sees & (s < 0) & (state.previous != NO_LANE)
            moved = jnp.where(over, s - lane_map.length[state.lane], s)
            moved = jnp.where(under, s + lane_map.length[state.previous], moved)
            lane = jnp.where(over, after, jnp.where(under, state.previous, state.lane))
            moved = jnp.where(sees, jnp.clip(moved, 0, lane_map.length[lane]), moved)
            previous = jnp.where(over, state.lane, jnp.where(under, NO_LANE, state.previous))
            earlier = jnp.where((over | under)[:, None], NO_LANE, state.earlier)
            state = replace(state, lane=lane, previous=previous, earlier=earlier, s=moved, d=d)
        if self.speed_noise > 0:
            error = jax.random.normal(keys[1], mine.shape, state.v.dtype) * self.speed_noise
            state = replace(state, v=jnp.where(sees, jnp.maximum(state.v + error, 0), state.v))
        return state

    def _signalling(self, state: State) -> Bool[Array, " N"]:
        """Vehicles that signal their turns: always the same share of them."""
        # a fraction that differs from vehicle to vehicle
        number = jnp.arange(state.lane.shape[0], dtype=state.s.dtype)
        lot = number * 0.61803399 + state.entered * 0.7548777 + state.shape.length * 97.409
        return lot - jnp.floor(lot) < self.signals


def view_of(table: Mapping[str, Any]) -> View:
    """The view of a table of names and values.

    Raises:
      ValueError: an unknown name, or a value out of range.
    """
    known = {field.name: field.type for field in fields(View)}
    for name, value in table.items():
        if name not in known:
            raise ValueError(f"{name}: no such field; known are {', '.join(known)}")
        kinds, words = _KINDS[str(known[name])]
        if not isinstance(value, kinds) or isinstance(value, bool) != (kinds is bool):
            raise ValueError(f"view.{name}: {value!r}; expected {words}")
    return View(**table)


_KINDS: dict[str, tuple[Any, str]] = {
    "bool": (bool, "true or false"),
    "float": ((int, float), "a number"),
}


def _believed(state: State, mine: Bool[Array, " N"], drivers: Seen) -> State:
    """The state with beliefs about all that cannot be seen but routes."""

    def own(true: Array, guess: Array | float) -> Array:
        return jnp.where(mine, true, jnp.asarray(guess, true.dtype))

    lights, none = state.lights, jnp.zeros_like(state.lights.elapsed)
    return replace(
        state,
        driver=jax.tree.map(own, state.driver, believed(drivers, state.shape.vehicle_class)),
        queues=jax.tree.map(jnp.zeros_like, state.queues),
        lights=replace(lights, elapsed=none, gap=none),
        script=None,
        **{name: own(getattr(state, name), guess) for name, guess in _HIDDEN.items()},
    )


def _before(state: State, mine: Bool[Array, " N"], past: dict[str, Array]) -> State:
    """The state with the others as they were; vehicles that came since are not there yet."""
    same = state.active & past["active"] & (state.entered == past["entered"])
    keep = mine | ~same
    then = {
        name: jnp.where(keep, getattr(state, name), old) for name, old in past.items() if name != "entered"
    }
    return without(replace(state, **then), ~mine & ~same)


def _hidden(
    eyes: Float[Array, "E 2"], slot: Array, box: Float[Array, "N 5"], z: Float[Array, " N"], active: Array
) -> Bool[Array, "E N"]:
    """Whether other bodies hide a body from an eye: its centre and all corners.

    Bodies hide whatever their height, except on other levels (bridges).
    """
    number = box.shape[0]
    cos, sin = jnp.cos(box[:, 2]), jnp.sin(box[:, 2])
    half_l, half_w = box[:, 3] / 2, box[:, 4] / 2
    corners = [(0.0, 0.0)] + [(a, b) for a in (0.95, -0.95) for b in (0.95, -0.95)]
    x = jnp.stack([box[:, 0] + a * half_l * cos - b * half_w * sin for a, b in corners])  # [P N]
    y = jnp.stack([box[:, 1] + a * half_l * sin + b * half_w * cos for a, b in corners])

    def blocked(eye: Array, own: Array, point_x: Array, point_y: Array) -> Bool[Array, " N"]:
        """Whether a body lies between the eye and a point of another."""
        c, s, x, y, long, wide = (z[None] for z in (cos, sin, box[:, 0], box[:, 1], half_l, half_w))
        dx, dy = eye[0] - x, eye[1] - y  # in the frame of each body
        ex, ey = c * dx + s * dy, c * dy - s * dx
        px, py = point_x[:, None] - x, point_y[:, None] - y
        tx, ty = c * px + s * py - ex, c * py - s * px - ey  # [N targets, N bodies]

        def within(start: Array, way: Array, half: Array) -> tuple[Array, Array]:
            way = jnp.where(jnp.abs(way) < 1e-6, 1e-6, way)
            a, b = (-half - start) / way, (half - start) / way
            return jnp.minimum(a, b), jnp.maximum(a, b)

        (first, last), (enters, leaves) = within(ex, tx, long), within(ey, ty, wide)
        first = jnp.maximum(jnp.maximum(first, enters), 0)
        last = jnp.minimum(jnp.minimum(last, leaves), 1)
        body = jnp.arange(number)
        counts = active[None] & (body[None] != body[:, None]) & (body[None] != own)
        counts &= jnp.abs(z[None] - z[:, None]) <= CLEARANCE
        return ((first < last) & counts).any(-1)

    each = jax.vmap(jax.vmap(blocked, (None, None, 0, 0)), (0, 0, None, None))
    return each(eyes, slot, x, y).all(1)
