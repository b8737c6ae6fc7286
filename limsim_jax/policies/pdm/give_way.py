"""Right of way for PDM-Closed: where the map demands to wait, and for whom.

The published planner knows lights only. At a crossing without them it drives into the gap that a forecast at
constant velocity leaves. With rules it waits where the traffic model would, behind the same stop line and for
the same vehicles.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.policies.pdm.proposals import Leaders
from limsim_jax.policies.pdm.road import DT, FAR, LOOK_EVERY, Body, Road
from limsim_jax.policies.perception import rules
from limsim_jax.traffic.engine import Traffic
from limsim_jax.types import Config, State

_YIELDS_TO = 2  # column of `Obstacles`: the vehicle that goes first


class Way(NamedTuple):
    """What the right of way asks of `V` planned vehicles."""

    wall: Float[Array, " V"]  # m from the front bumper to the stop obstacle
    gap: Float[Array, " V"]  # m from the front bumper to a vehicle that goes first, FAR for none
    v: Float[Array, " V"]  # m/s, of that vehicle
    stop: Float[Array, " N"]  # m from each front bumper to where the vehicle will stop

    def stopping(self, road: Road, body: Body) -> Road:
        """The road with its walls; none on the way to a lane that a route needs, which has its own."""
        own = (road.worth > 0).any(-1)
        wall = jnp.where(own, FAR, road.s + body.front + self.wall)
        return road._replace(wall=jnp.minimum(road.wall, wall[:, None]))


def way(config: Config, traffic: Traffic, lane_map: LaneMap, state: State, slot: Int[Array, " V"]) -> Way:
    """The right of way now, by the traffic engine."""
    _, decision = rules(config, traffic, lane_map, state, jnp.zeros_like(slot))
    found = decision.obstacles
    other = found.other[slot, _YIELDS_TO]
    return Way(
        wall=found.gap[slot, -1],
        gap=jnp.where(other >= 0, found.gap[slot, _YIELDS_TO], FAR),
        v=state.v[other],
        stop=found.gap[:, -1] - state.driver.s0,
    )


def along_with(along: Leaders, first: Way, road: Road, body: Body) -> Leaders:
    """The leaders with the vehicle that goes first, which keeps its speed."""
    moments = along.v.shape[0]
    moved = first.v[None] * (LOOK_EVERY * DT * jnp.arange(moments, dtype=first.v.dtype))[:, None]
    rear = (road.s + body.front + first.gap)[None] + moved  # [H V]
    rear = jnp.where(first.gap[None] < FAR / 2, rear, FAR)
    paths = jnp.broadcast_to(rear[:, :, None, None], (*along.rear.shape[:3], 1))
    v = jnp.broadcast_to(first.v[None, :, None], (*along.v.shape[:2], 1))
    return Leaders(
        rear=jnp.concatenate([along.rear, paths], -1),
        centre=jnp.concatenate([along.centre, rear[..., None]], -1),
        v=jnp.concatenate([along.v, v], -1),
    )


__all__ = ["Way", "along_with", "way"]
