"""What if: a world of a sweep, stopped at some moments, from which `Rollout.advance` branches.

now = stopped(episodes, seed=7, times=[11.0, 12.0])
futures = fork(now.carry, 5)  # [5, 2, ...]: five copies of both moments, to be changed at will
advance = lambda carry: now.run.advance(now.lane_map, now.schedule, now.key, carry, decisions=20)[0]
found = jax.jit(jax.vmap(jax.vmap(advance)))(futures).measures  # metrics [5, 2] of the next 20 decisions
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.simulation.rollout import Carry, Rollout, Started, started
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.types import Schedule
from limsim_jax.xla import enable_compilation_cache, run_once


class Stopped(NamedTuple):
    """A world at some moments, ready to run on."""

    run: Rollout
    lane_map: LaneMap
    schedule: Schedule
    key: Key[Array, ""]  # of the policy
    carry: Carry  # [moments, ...]; totals and metrics begin there


def stopped(episodes: Episodes, seed: int, times: Sequence[float]) -> Stopped:
    """The world of a seed at some times of its episode.

    Args:
      episodes: whose world it is.
      seed: of the world.
      times: s, rounded to whole decisions.

    Raises:
      ValueError: no times, or one before the start or after the horizon.
    """
    run, lane_map = episodes.rollout, episodes.lane_map
    wanted = [round(float(time) / run.config.decision_time) for time in times]
    if not wanted:
        raise ValueError("no times to stop at; at least one is needed")
    if min(wanted) < 0 or max(wanted) > run.decisions:
        raise ValueError(
            f"times from {min(times):g} to {max(times):g} s; they must be within 0 and {run.horizon:g} s"
        )
    enable_compilation_cache()
    bare = replace(run, measure=None, record=None)

    def start(lane_map: LaneMap, seed: int) -> Started:
        return started(bare, lane_map, episodes.sample, seed)

    schedule, key, begun = jax.jit(start, compiler_options=run_once())(lane_map, seed)

    @jax.jit
    def decide(lane_map: LaneMap, schedule: Schedule, carry: Carry) -> Carry:
        return bare.advance(lane_map, schedule, key, carry, 1)[1]

    carries = [begun]
    for _ in range(max(wanted)):
        carries.append(decide(lane_map, schedule, carries[-1]))
    then = jax.tree.map(lambda *x: jnp.stack(x), *(carries[k] for k in wanted))
    fresh = jax.jit(jax.vmap(run.restart, (None, 0, 0)))(lane_map, then.state, then.memory)
    return Stopped(run, lane_map, schedule, key, fresh)
