"""The player: a scenario one physics step on, on the device.

`step` looks at all entities, runs the storyboard and moves the entities that the scenario holds. The motion
is exact for every action that has a formula: positions are integrals of the speeds, not sums of them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from limsim_jax.scenarios.openscenario.arrays import Board, Memory
from limsim_jax.scenarios.openscenario.begin import begin
from limsim_jax.scenarios.openscenario.conditions import STANDING, look, raw
from limsim_jax.scenarios.openscenario.lookups import (
    angle,
    at_end,
    center_of,
    column_at,
    on_road,
    project,
)
from limsim_jax.scenarios.openscenario.motion import move
from limsim_jax.scenarios.openscenario.storyline import advance, complete

__all__ = ["Bodies", "step"]


class Bodies(NamedTuple):
    """Entities as the traffic has them; only those count that the scenario does not hold."""

    pose: Float[Array, "K 3"]  # x, y (m), heading (rad) of the reference points
    v: Float[Array, " K"]  # m/s
    a: Float[Array, " K"]  # m/s^2
    there: Bool[Array, " K"]


@jax.named_scope("openscenario")
def step(dt: float, board: Board, memory: Memory, bodies: Bodies | None = None) -> Memory:
    """The scenario `dt` s later.

    Args:
      dt: s.
      board: the scenario.
      memory: now.
      bodies: where the entities are now that the scenario does not hold; None: it holds all.

    Returns:
      The memory after the step. Entities that are not held are where they were.
    """
    memory = observe(dt, board, memory, bodies)
    time = memory.step.astype(memory.v.dtype) * dt
    memory = complete(board, memory)
    geometry = look(board, memory)
    truth, each = raw(board, memory, geometry, time)
    started = advance(board, memory, truth, each)
    memory = begin(board, started.memory, geometry, time, started.begins, started.stops)
    memory = move(dt, board, memory, geometry, time)
    return replace(memory, step=memory.step + 1)


def observe(dt: float, board: Board, memory: Memory, bodies: Bodies | None) -> Memory:
    """What entities have done since the last step.

    Also for how long they stand, or are off the road.
    """
    corridors = board.corridors
    if bodies is not None:
        held = memory.held
        on = project(corridors, memory.corridor, bodies.pose[:, 0], bodies.pose[:, 1])
        column = column_at(corridors, memory.corridor, on.s, on.t)
        off = on.t - center_of(corridors, memory.corridor, on.s, column)
        moved = jnp.hypot(*(bodies.pose[:, k] - memory.pose[:, k] for k in range(2)))
        first = memory.step == 0

        def seen(old: Array, new: Array) -> Array:
            mine = held if old.ndim == 1 else held[:, None]
            return jnp.where(mine, old, new)

        memory = replace(
            memory,
            pose=seen(memory.pose, bodies.pose),
            s=seen(memory.s, on.s),
            t=seen(memory.t, on.t),
            yaw=seen(memory.yaw, angle(bodies.pose[:, 2], on.h)),
            v=seen(memory.v, bodies.v),
            a=seen(memory.a, bodies.a),
            across=seen(memory.across, jnp.where(first, 0, (on.t - memory.t) / dt)),
            column=seen(memory.column, column),
            off=seen(memory.off, off),
            travelled=seen(memory.travelled, memory.travelled + jnp.where(first, 0, moved)),
            there=seen(memory.there, bodies.there),
        )

    def lasted(since: Array, now: Array) -> Array:
        return jnp.where(now, jnp.where(since < 0, 0, since + dt), -1)

    return replace(
        memory,
        stood=lasted(memory.stood, jnp.abs(memory.v) < STANDING),
        ended=lasted(memory.ended, at_end(corridors, memory.corridor, memory.s)),
        off_road=lasted(memory.off_road, ~on_road(corridors, memory.corridor, memory.s, memory.t)),
    )
