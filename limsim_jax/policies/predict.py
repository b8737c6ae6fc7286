"""Predictions: positions of all vehicles at later moments, as arrays.

A `Predictor` is a function; planners take any. `along_route` keeps the speed and follows the routes of the
state, which are beliefs in a view (`view.routes`). `constant_velocity` keeps speed and heading, as in PDM
(Dauner et al., CoRL 2023). `Replayed` is the recorded future. All use the plans that planned vehicles share,
see `shared`. There is no gradient through the choice of the lane.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Float, Int

from limsim_jax.maps.lane_map import NO_LANE, LaneMap, pose, side_s
from limsim_jax.numerics import safe_divide
from limsim_jax.traffic.collision import CLEARANCE, level
from limsim_jax.traffic.ego import Trajectory, is_free
from limsim_jax.traffic.motion import boxes, pace, smooth_step
from limsim_jax.types import State
from limsim_jax.xla import computed_once

SETTLE = 3.0
"""s in which the offset of a vehicle that changes no lanes fades to the middle of its lane."""

STOPPING = 2.0
"""m/s^2, braking before a stop; harder if that is needed."""

_LANES = 4  # lanes beyond the own one that are looked at
_STRAYED = 2.0  # m, along x or y


@struct.dataclass(frozen=True, kw_only=True)
class Prediction:
    """Predicted positions of the bodies of `N` vehicles at `H` moments."""

    x: Float[Array, "N H"]  # m, centre of the body
    y: Float[Array, "N H"]
    heading: Float[Array, "N H"]  # rad
    length: Float[Array, " N"]  # m
    width: Float[Array, " N"]
    times: Float[Array, " H"]  # s from now


@struct.dataclass(frozen=True, kw_only=True)
class Plans:
    """Shared plans: positions of `V` planned vehicles at the times of a prediction."""

    slot: Int[Array, " V"]  # -1: no plan
    x: Float[Array, "V H"]  # m, centre of the body
    y: Float[Array, "V H"]
    heading: Float[Array, "V H"]  # rad


@runtime_checkable
class Predictor(Protocol):
    """Written for one world."""

    def __call__(
        self,
        lane_map: LaneMap,
        state: State,
        times: Float[Array, " H"],
        *,
        stop: Float[Array, " N"] | None = None,
        plans: Plans | None = None,
    ) -> Prediction:
        """Positions of all vehicles `times` s from now.

        Args:
          lane_map: the map.
          state: the world now.
          times: s from now.
          stop: m from each front bumper to where the vehicle will stop.
          plans: known plans, which replace predictions.
        """
        ...


@jax.named_scope("predict")
def along_route(
    lane_map: LaneMap,
    state: State,
    times: Float[Array, " H"],
    *,
    stop: Float[Array, " N"] | None = None,
    plans: Plans | None = None,
) -> Prediction:
    """All vehicles follow their routes at their speeds, and finish lane changes.

    An offset from the middle of the lane fades within `SETTLE` s. Before a `stop` a vehicle brakes with
    `STOPPING`, or harder if needed. Beyond the fifth lane of a route the prediction goes straight on.
    """
    start = _start(lane_map, state)
    rows, begins = _route(lane_map, state, start.lane)
    x, y, heading = _along(lane_map, state, start, rows, begins, times, stop)
    shape = state.shape
    prediction = Prediction(x=x, y=y, heading=heading, length=shape.length, width=shape.width, times=times)
    return _with(prediction, plans)


@jax.named_scope("predict")
def constant_velocity(
    lane_map: LaneMap,
    state: State,
    times: Float[Array, " H"],
    *,
    stop: Float[Array, " N"] | None = None,
    plans: Plans | None = None,
) -> Prediction:
    """All vehicles keep speed and heading; `stop` as in `along_route`."""
    box = boxes(lane_map, state)
    distance, _ = _travelled(state, times, stop)
    heading = jnp.broadcast_to(box[:, 2:3], distance.shape)
    prediction = Prediction(
        x=box[:, 0:1] + distance * jnp.cos(heading),
        y=box[:, 1:2] + distance * jnp.sin(heading),
        heading=heading,
        length=box[:, 3],
        width=box[:, 4],
        times=times,
    )
    return _with(prediction, plans)


def shared(
    lane_map: LaneMap,
    state: State,
    slot: Int[Array, " V"],
    trajectory: Trajectory,
    now: Float[Array, ""],
    times: Float[Array, " H"],
) -> Plans:
    """Plans of vehicles that go on with their previous trajectories.

    Positions continue from where the vehicle is now. A vehicle that is inactive, or more than `_STRAYED` m
    off its trajectory, has no plan.

    Args:
      lane_map: the map.
      state: the world now.
      slot: vehicles of the trajectories; -1: none.
      trajectory: of `V` rows; far away where there is none.
      now: s, present time.
      times: s from now.
    """
    box = boxes(lane_map, state)[slot, :3]
    here = trajectory.at(now[None])[:, 0, :3]
    moved = trajectory.at(now + times)[..., :3] - here[:, None]
    away = jnp.abs(box[:, :2] - here[:, :2]).max(-1)
    follows = (slot >= 0) & state.active[slot] & (away < _STRAYED)
    x, y, heading = (jnp.where(follows[:, None], box[:, k, None] + moved[..., k], 0) for k in range(3))
    return Plans(slot=jnp.where(follows, slot, -1), x=x, y=y, heading=heading)


@dataclass(frozen=True)
class Replayed:
    """The recorded future: a predictor for worlds that run a second time.

    Each vehicle moves as in the first run, from where it is now. If another vehicle took its slot meanwhile,
    the prediction continues with that vehicle's motion.

    Attributes:
      box: `[T, N, 5]` of the first run as in `Trace`, after every physics step.
      dt: s between physics steps.
    """

    box: Float[Array, "T N 5"]
    dt: float

    def __call__(
        self,
        lane_map: LaneMap,
        state: State,
        times: Float[Array, " H"],
        *,
        stop: Float[Array, " N"] | None = None,
        plans: Plans | None = None,
    ) -> Prediction:
        """Positions of all vehicles `times` s later; `stop` is not needed."""
        del stop
        last = self.box.shape[0] - 1
        now = state.step - 1  # the first row is after the first step
        then = jnp.clip(now + jnp.round(times / self.dt).astype(jnp.int32), 0, last)
        moved = self.box[then, :, :3] - self.box[jnp.clip(now, 0, last), :, :3][None]
        moved = jnp.moveaxis(moved, 0, 1)  # [N, H, 3]
        x, y, heading = (boxes(lane_map, state)[:, k, None] + moved[..., k] for k in range(3))
        shape = state.shape
        prediction = Prediction(
            x=x, y=y, heading=heading, length=shape.length, width=shape.width, times=times
        )
        return _with(prediction, plans)


def nearest(
    lane_map: LaneMap, state: State, prediction: Prediction, slot: Int[Array, " V"], k: int
) -> Int[Array, "V K"]:
    """Slots of the `k` others that come nearest to each vehicle.

    -1 stands for none. Distance is the least between predicted centres at one time, less half the other's
    length. Vehicles on another level (bridges) and inactive ones do not count.
    """
    n = state.active.shape[0]
    apart = (prediction.x[slot][:, None] - prediction.x[None]) ** 2
    apart = jnp.sqrt(jnp.min(apart + (prediction.y[slot][:, None] - prediction.y[None]) ** 2, -1))
    apart = apart - prediction.length[None] / 2
    z = level(lane_map, state)
    counts = state.active[None] & (jnp.abs(z[slot][:, None] - z[None]) <= CLEARANCE)
    counts &= (jnp.arange(n)[None] != slot[:, None]) & (slot[:, None] >= 0)
    apart = computed_once(jnp.where(counts, apart, jnp.inf))
    least, which = lax.top_k(-apart, min(k, n))
    found = jnp.where(jnp.isfinite(least), which.astype(slot.dtype), -1)
    return jnp.pad(found, ((0, 0), (0, k - min(k, n))), constant_values=-1)


# --- parts -------------------------------------------------------------------------------------------


class _Start(NamedTuple):
    """Positions on the own lane, or on the target lane."""

    lane: Int[Array, " N"]
    s: Float[Array, " N"]  # m, centre of the body; negative on the lane before
    changes: Array


def _start(lane_map: LaneMap, state: State) -> _Start:
    changes = (state.side != 0) & ~is_free(state)
    beside = jnp.where(state.side > 0, lane_map.left[state.lane], lane_map.right[state.lane])
    over = changes & ~state.crossed & (beside != NO_LANE)
    s = jnp.where(over, side_s(lane_map, state.lane, state.s, state.side), state.s)
    return _Start(jnp.where(over, beside, state.lane), s - state.shape.length / 2, changes)


def _route(lane_map: LaneMap, state: State, lane: Int[Array, " N"]) -> tuple[Array, Array]:
    """Lanes along the routes, and m to their starts; `[N D]`."""
    rows = [lane]
    begins = [jnp.zeros_like(state.s)]
    for _ in range(_LANES):
        after = lane_map.routes.next_lane[rows[-1], state.goal]
        begins.append(jnp.where(after == NO_LANE, 1e9, begins[-1] + lane_map.length[rows[-1]]))
        rows.append(after)
    return jnp.stack(rows, -1), jnp.stack(begins, -1)


def _travelled(
    state: State, times: Float[Array, " H"], stop: Float[Array, " N"] | None
) -> tuple[Float[Array, "N H"], Float[Array, "N H"]]:
    """Distances travelled by then, m, and speeds, m/s."""
    v, t = state.v[:, None], times[None, :]
    if stop is None:
        return v * t, jnp.broadcast_to(v, (v.shape[0], times.shape[0]))
    room = jnp.maximum(stop, 0)[:, None]
    b = jnp.maximum(STOPPING, v * v / jnp.maximum(2 * room, 0.1))
    begin = jnp.maximum(room - v * v / (2 * b), 0) / jnp.maximum(v, 1e-3)  # s from now
    braking = jnp.clip(t - begin, 0, v / b)
    distance = v * jnp.minimum(t, begin) + v * braking - b * braking * braking / 2
    return jnp.minimum(distance, room), v - b * braking


def _along(
    lane_map: LaneMap,
    state: State,
    start: _Start,
    rows: Int[Array, "N D"],
    begins: Float[Array, "N D"],
    times: Float[Array, " H"],
    stop: Float[Array, " N"] | None,
) -> tuple[Float[Array, "N H"], Float[Array, "N H"], Float[Array, "N H"]]:
    distance, v = _travelled(state, times, stop)
    at = start.s[:, None] + distance
    # lanes of the route count from the start of the first; before it is the previous lane
    begins = begins - begins[:, :1]
    which = jnp.maximum(jnp.sum(begins[:, None, :] <= at[:, :, None], -1) - 1, 0)
    lane = jnp.take_along_axis(rows, which, -1)
    s = at - jnp.take_along_axis(begins, which, -1)
    moved = start.lane != state.lane
    came = jnp.where(state.side > 0, lane_map.left[state.previous], lane_map.right[state.previous])
    came = jnp.where(moved, came, state.previous)[:, None]
    behind = (s < 0) & (came != NO_LANE)
    lane, s = jnp.where(behind, came, lane), jnp.where(behind, s + lane_map.length[came], s)

    # lane changes proceed with time; other offsets fade
    slow = pace(state)
    rate = safe_divide(slow, state.driver.lane_change_time)
    changes = start.changes[:, None]
    u = jnp.where(changes, state.progress[:, None], 0)
    rate = jnp.where(changes, rate[:, None], slow[:, None] / SETTLE)
    u = jnp.clip(u + rate * times[None], 0, 1)
    offset = jnp.where(start.changes, state.shift, state.d)[:, None]
    d = offset * (1 - smooth_step(u))
    across = -offset * 30 * u * u * (1 - u) * (1 - u) * rate
    x, y, heading = pose(lane_map, lane, s, d)
    return x, y, heading + jnp.arctan(jnp.clip(across / jnp.maximum(v, 0.5), -0.2, 0.2))


def _with(prediction: Prediction, plans: Plans | None) -> Prediction:
    """The prediction, replaced by plans where they are known."""
    if plans is None or plans.slot.shape[0] == 0:
        return prediction
    mine = plans.slot[:, None] == jnp.arange(prediction.x.shape[0], dtype=plans.slot.dtype)[None, :]
    planned, whose = mine.any(0)[:, None], jnp.argmax(mine, 0)

    def put(old: Array, new: Array) -> Array:
        return jnp.where(planned, new[whose], old)

    return Prediction(
        x=put(prediction.x, plans.x),
        y=put(prediction.y, plans.y),
        heading=put(prediction.heading, plans.heading),
        length=prediction.length,
        width=prediction.width,
        times=prediction.times,
    )
