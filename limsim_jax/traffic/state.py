"""Start states: a world at its first moment."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.maps.lane_map import EARLIER, NO_LANE, LaneMap
from limsim_jax.types import Driver, Egos, Lights, Queues, Shape, State


def start_state(
    lane_map: LaneMap,
    driver: Driver,
    shape: Shape,
    *,
    lane: Int[Array, " N"],
    s: Float[Array, " N"],
    v: Float[Array, " N"],
    goal: Int[Array, " N"],
    active: Bool[Array, " N"] | None = None,
    origins: int = 0,
) -> State:
    """A world at its first moment: vehicles in the middle of their lanes.

    Args:
      lane_map: where.
      driver: of every slot.
      shape: of every slot.
      lane: row of the lane; NO_LANE in empty slots.
      s: front bumper, m.
      v: m/s.
      goal: column of the route table.
      active: which slots hold a vehicle; all that have a lane by default.
      origins: number of queues that vehicles will enter from.
    """
    lane = jnp.asarray(lane, jnp.int32)
    n = lane.shape[0]
    zero, zeros, off = jnp.zeros(n, jnp.float32), jnp.zeros(n, jnp.int32), jnp.zeros(n, bool)
    programs = lane_map.signals.duration.shape[0]
    return State(
        step=jnp.int32(0),
        driver=driver,
        shape=shape,
        active=lane != NO_LANE if active is None else jnp.asarray(active),
        vehicle=zeros - 1,
        lane=lane,
        previous=zeros + NO_LANE,
        earlier=jnp.full((n, EARLIER), NO_LANE, jnp.int32),
        s=jnp.asarray(s, jnp.float32),
        d=zero,
        v=jnp.asarray(v, jnp.float32),
        a=zero,
        goal=jnp.asarray(goal, jnp.int32),
        side=zeros,
        crossed=off,
        progress=zero,
        shift=zero,
        rest=zero,
        waiting=zero,
        yielding=off,
        stopped=off,
        distance=zero,
        entered=zero,
        status=zeros,
        struck=zeros - 1,
        struck_at=zero,
        queues=Queues(next=jnp.zeros(origins, jnp.int32), full=jnp.int32(0)),
        lights=Lights(
            phase=jnp.zeros(programs, jnp.int32),
            elapsed=jnp.zeros(programs, jnp.float32),
            gap=jnp.zeros(programs, jnp.float32),
        ),
        egos=no_egos(),
    )


def no_egos() -> Egos:
    """Egos of a world without any."""
    none = jnp.zeros(0, jnp.float32)
    return Egos(
        slot=jnp.zeros(0, jnp.int32),
        free=jnp.zeros(0, bool),
        x=none,
        y=none,
        heading=none,
        steering=none,
        a=none,
    )
