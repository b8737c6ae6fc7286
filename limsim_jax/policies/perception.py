"""What planners see: right of way by the traffic engine, and the vehicles around."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.policies.predict import Prediction
from limsim_jax.policies.reference import ReferencePath, project_onto
from limsim_jax.traffic.command import Command
from limsim_jax.traffic.ego import at_slots
from limsim_jax.traffic.engine import Decision, Traffic, decide
from limsim_jax.types import Config, State

_NEXT_LANE = 5.0  # m off the path, within which a vehicle may be changing to it


class Around(NamedTuple):
    """The `K` most relevant others of `V` vehicles, along their paths."""

    slot: Int[Array, "V K"]
    there: Bool[Array, "V K"]
    s: Float[Array, "V K"]  # m from centre to centre along the path
    d: Float[Array, "V K"]  # m off the path
    gap: Float[Array, "V K"]  # m between bumpers; positive for leaders and followers
    v: Float[Array, "V K"]  # m/s along the path
    on_path: Bool[Array, "V K"]  # its body is on the lane of the path


def rules(
    config: Config, traffic: Traffic, lane_map: LaneMap, state: State, side: Int[Array, " E"]
) -> tuple[Int[Array, " E"], Decision]:
    """Decisions of the traffic engine: leaders, right of way, lights, lane changes by MOBIL.

    Args:
      config: steps and look-ahead.
      traffic: behaviour.
      lane_map: the map.
      state: the world now.
      side: lane changes of the egos in progress: +1 left, -1 right, 0 none.

    Returns:
      Lane changes that the egos would begin now, and the decision for all vehicles.
    """
    egos = replace(state.egos, free=jnp.zeros_like(state.egos.free))
    now = at_slots(egos, side, state.side, side != 0)
    before = replace(state, egos=egos, side=now)
    after, decision = decide(config, traffic, lane_map, before, Command())
    return jnp.where(now[egos.slot] == 0, after.side[egos.slot], 0), decision


def around(
    state: State, prediction: Prediction, path: ReferencePath, slot: Int[Array, " V"], count: int
) -> Around:
    """The `count` others that come nearest within the prediction, along the path."""
    number = state.lane.shape[0]
    x, y = prediction.x, prediction.y  # [N H]
    mine = jnp.arange(number)[None] == slot[:, None]
    picks = (0, x.shape[1] // 3, 2 * x.shape[1] // 3)
    away = jnp.stack(
        [
            (x[:, k][None] - x[slot, k][:, None]) ** 2 + (y[:, k][None] - y[slot, k][:, None]) ** 2
            for k in picks
        ]
    )
    away = jnp.where(mine | ~state.active[None], 1e12, away.min(0))
    near, index = lax.top_k(-away, min(count, number))
    there = near > -1e11
    ox, oy = x[index, 0], y[index, 0]
    s, d, along = project_onto(path, ox, oy)
    turned = prediction.heading[index, 0] - along
    half = (
        jnp.abs(jnp.cos(turned)) * state.shape.width[index]
        + jnp.abs(jnp.sin(turned)) * state.shape.length[index]
    )
    on_path = (
        there & (jnp.abs(d) < half / 2 + state.shape.width[slot][:, None] / 2 + 0.1) & (jnp.cos(turned) > 0.3)
    )
    joins = there & (state.side[index] * jnp.sign(d).astype(jnp.int32) < 0) & (jnp.abs(d) < _NEXT_LANE)
    on_path = (on_path | joins) & (jnp.abs(s) < path.reach)
    lengths = (state.shape.length[index] + state.shape.length[slot][:, None]) / 2
    return Around(index, there, s, d, jnp.abs(s) - lengths, state.v[index] * jnp.cos(turned), on_path)
