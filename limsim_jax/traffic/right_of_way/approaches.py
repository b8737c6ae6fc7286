"""The connectors that every vehicle comes to next."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.maps.lane_map import NO_LANE, LaneMap, bend_speed
from limsim_jax.traffic.car_following import NO_GAP
from limsim_jax.traffic.neighbors import Ahead
from limsim_jax.traffic.parameters import JUNCTIONS
from limsim_jax.types import Config, State


class Approaches(NamedTuple):
    """The next connectors of every vehicle, `R` of them: the one that it is on, and those it comes to."""

    connector: Int[Array, "N R"]  # -1 where there is none
    lane: Int[Array, "N R"]
    x: Float[Array, "N R"]  # m, front bumper along the connector; negative before it
    line: Float[Array, "N R"]  # m to the place to wait before the junction; negative once passed
    soonest: Float[Array, "N R"]  # s until the start of the connector, by what the lanes before it allow
    goes_on: Bool[Array, "N R"]  # through the same junction as the connector before


def approaches_ahead(config: Config, lane_map: LaneMap, state: State, ahead: Ahead) -> Approaches:
    """The first connectors on the route of every vehicle.

    Args:
      config: `look_ahead` limits how far away a connector may be.
      lane_map: where.
      state: the world.
      ahead: the lanes that every vehicle will drive on.
    """
    table = lane_map.conflicts
    connector = jnp.where(state.active[:, None], table.connector[ahead.lane], -1)
    connector = jnp.where(ahead.start < config.look_ahead, connector, -1)
    count = jnp.cumsum(connector >= 0, -1)
    junction = lane_map.junction[ahead.lane]
    setback = (lane_map.length - lane_map.stop_s)[ahead.lane]
    stand_back = lane_map.stand_back[ahead.lane]
    found, line = [], jnp.full_like(state.s, -NO_GAP)
    soonest = _soonest(lane_map, state, ahead)
    inside = jnp.full_like(state.lane, -1)
    for r in range(lane_map.approaches):
        here = (connector >= 0) & (count == r + 1)
        index = jnp.argmax(here, -1)[:, None]
        exists = here.any(-1)
        pick = lambda x, i: jnp.take_along_axis(x, i, -1)[:, 0]  # noqa: E731
        start, which = pick(ahead.start, index), pick(junction, index)
        before = jnp.maximum(index - 1, 0)
        enters = (index[:, 0] > 0) & (which >= 0) & (pick(junction, before) != which)
        # the line of a junction holds for all its connectors; a vehicle inside has none
        at_line = start - pick(setback, before)
        back = at_line - pick(stand_back, before)
        at_line = jnp.where(back > -JUNCTIONS.margin, back, at_line)
        goes_on = exists & ~enters & (which >= 0) & (which == inside)
        line = jnp.where(enters, at_line, jnp.where(goes_on, line, -NO_GAP))
        inside = which
        found.append(
            (
                jnp.where(exists, pick(connector, index), -1),
                jnp.where(exists, pick(ahead.lane, index), NO_LANE),
                jnp.where(exists, -start, -NO_GAP),
                jnp.where(exists, line, -NO_GAP),
                jnp.where(exists, pick(soonest, index), 0),
                goes_on,
            )
        )
    return Approaches(*(jnp.stack(column, -1) for column in zip(*found, strict=True)))


def throughout(approaches: Approaches, x: Array) -> Array:
    """Let what holds at the entry of a junction hold throughout it.

    Args:
      approaches: connectors ahead.
      x: `[N, R]`; 0 or False where a connector says nothing itself.
    """
    columns, says = [x[:, 0]], x.astype(bool)
    for r in range(1, x.shape[1]):
        columns.append(jnp.where(approaches.goes_on[:, r] & ~says[:, r], columns[-1], x[:, r]))
    return jnp.stack(columns, -1)


def _soonest(lane_map: LaneMap, state: State, ahead: Ahead) -> Float[Array, "N D"]:
    """Least time (s) to the start of every lane ahead: limits and turns on the way there are kept to.

    A vehicle that comes round a roundabout takes longer than its distance and its speed tell.
    """
    lane = ahead.lane[:, :-1]
    limit = state.driver.speed_factor[:, None] * lane_map.speed_limit[lane]
    turn = jnp.minimum(limit, bend_speed(lane_map, lane, state.driver.a_lat[:, None]) / JUNCTIONS.soonest)
    # on its own lane it may be faster than that
    limit = jnp.concatenate([jnp.maximum(limit[:, :1], state.v[:, None]), limit[:, 1:]], -1)
    turn = jnp.concatenate([jnp.maximum(turn[:, :1], state.v[:, None]), turn[:, 1:]], -1)
    way = ahead.start[:, 1:] - jnp.maximum(ahead.start[:, :-1], 0)
    # a long connector bends in a part of it only
    bend = jnp.where(lane_map.is_connector[lane], jnp.minimum(way, JUNCTIONS.turn_length), 0)
    time = bend / jnp.maximum(turn, 1.0) + (way - bend) / jnp.maximum(limit, 1.0)
    time = jnp.where(lane == NO_LANE, 0, time)
    return jnp.concatenate([jnp.zeros_like(time[:, :1]), jnp.cumsum(time, -1)], -1)
