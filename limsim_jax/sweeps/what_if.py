"""What if: a world of a sweep is stopped at some moments, and futures go on from there.

Worlds run up to the moment and on from it by the program of their sweep, so nothing new is compiled.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.policies.base import sighted
from limsim_jax.simulation.rollout import Result, Started
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.traffic.ego import hand_over
from limsim_jax.traffic.motion import boxes
from limsim_jax.types import State
from limsim_jax.xla import run_once


def stopped(episodes: Episodes, seed: int, times: Sequence[float]) -> tuple[Started, list[int]]:
    """The world of a seed at some times of its episode.

    Args:
      episodes: whose world it is.
      seed: of the world.
      times: s, rounded to whole decisions.

    Returns:
      The worlds `[M, ...]`, and the decisions at which they stand.

    Raises:
      ValueError: no times, or one before the start or after the horizon.
    """
    run, worlds = episodes.rollout, episodes.worlds
    wanted = [round(float(time) / run.config.decision_time) for time in times]
    if not wanted:
        raise ValueError("no times to stop at; at least one is needed")
    if min(wanted) < 0 or max(wanted) > run.decisions:
        raise ValueError(
            f"times from {min(times):g} to {max(times):g} s; they must be within 0 and {run.horizon:g} s"
        )
    chunk, at, then = worlds.start([seed]), 0, {}
    for decision in sorted(set(wanted)):
        chunk, at = worlds.advance(chunk, decision - at)[0], decision
        then[decision] = jax.tree.map(lambda x: x[0], chunk)
    return jax.tree.map(lambda *x: jnp.stack(x), *(then[decision] for decision in wanted)), wanted


def futures(
    episodes: Episodes,
    begun: Started,
    decisions: int,
    *,
    same: bool,
    change: Callable[[State, Any], State] | None = None,
    copies: Int[np.ndarray, " W"] | None = None,
) -> Result:
    """Run worlds on, with every step; their metrics count from here on.

    Args:
      episodes: whose policy drives from now on.
      begun: worlds `[W, ...]`, as `stopped` gives them.
      decisions: how long.
      same: whether the policy is the one of before, which goes on with its memory.
      change: `change(state, copy)` is the state from which a world goes on. It is traced.
      copies: numbers for `change`.

    Returns:
      Results `[W, ...]` on the host; traces are `[W, T, ...]`.
    """
    worlds, egos = episodes.worlds, episodes.egos
    run = worlds.rollout

    def begin(lane_map: LaneMap, world: Started, copy: Any) -> Started:
        state, memory = world.carry.state, world.carry.memory
        if not same:
            box = boxes(lane_map, state)
            policy = run.policy
            state = hand_over(lane_map, state, box, egos, free=policy.free, others=policy.others)
        if change is not None:
            state = change(state, copy)
        if not same:
            memory = sighted(run.policy).init(run.config, lane_map, state)
        return world._replace(carry=run.restart(lane_map, state, memory))

    count = len(begun.carry.state.step)
    number = np.zeros(count, np.int32) if copies is None else copies
    ready = jax.jit(jax.vmap(begin, (None, 0, 0)), compiler_options=run_once())
    return worlds.replay(ready(episodes.lane_map, begun, number), decisions)
