"""A table of rules over the facts of a description.

It drives where a model gives no answer. As a policy in JAX it is also the reference of a model that reads
descriptions and answers by the same rules.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.maps.signal_table import SignalState
from limsim_jax.policies.base import Policy
from limsim_jax.policies.language.scene import Facts, LookAround, Neighbour, facts, time_to_collision
from limsim_jax.traffic.command import Command
from limsim_jax.traffic.ego import Meta
from limsim_jax.types import Config, State

# Our own round figures; the safe gaps are near the 2 s of the rule of thumb for drivers.
_STOP_TTC = 1.5  # s
_SLOW_TTC = 4.0  # s
_SLOW_HEADWAY = 0.8  # s
_FREE_HEADWAY = 1.8  # s
_STANDSTILL = 5.0  # m
_BEHIND_HEADWAY = 1.0  # s, to a vehicle behind on the lane beside
_BRAKING = 2.5  # m/s^2, at which a red light is approached
_SLOWER = 3.0  # m/s below the limit at which a leader is overtaken
_MARGIN = 0.5  # m/s around the limit


def rule_action(told: Facts, xp: ModuleType = np) -> Any:
    """The `Meta` action of each ego.

    Args:
      told: of any axes.
      xp: `numpy` or `jax.numpy`.
    """
    ahead = told.ahead
    ttc = time_to_collision(ahead.gap, told.v - ahead.v, xp)
    shown = (told.light == int(SignalState.RED)) | (told.light == int(SignalState.YELLOW))
    halt = shown & (told.light_distance < told.v**2 / (2 * _BRAKING) + _STANDSTILL)
    near = (ttc < _SLOW_TTC) | (ahead.gap < _SLOW_HEADWAY * told.v)
    room_left = told.left & _room(told, told.left_ahead, told.left_behind, xp)
    room_right = told.right & _room(told, told.right_ahead, told.right_behind, xp)
    slow_leader = (ahead.v < told.limit - _SLOWER) & (ahead.gap < 2 * _FREE_HEADWAY * told.v)
    gain = told.left_ahead.gap > ahead.gap + 2 * _STANDSTILL
    free = ahead.gap > _FREE_HEADWAY * told.v + _STANDSTILL
    rules = (
        ((ttc < _STOP_TTC) | halt, Meta.STOP),
        (near, Meta.DECELERATE),
        ((told.to_go > 0) & room_left, Meta.LEFT),
        ((told.to_go < 0) & room_right, Meta.RIGHT),
        ((told.to_go == 0) & slow_leader & gain & room_left, Meta.LEFT),
        (told.v > told.limit + _MARGIN, Meta.DECELERATE),
        ((told.v < told.limit - _MARGIN) & free, Meta.ACCELERATE),
    )
    action = xp.zeros_like(told.to_go) + int(Meta.KEEP)
    for holds, then in reversed(rules):
        action = xp.where(holds, int(then), action)
    return action


def _room(told: Facts, ahead: Neighbour, behind: Neighbour, xp: ModuleType) -> Any:
    front = time_to_collision(ahead.gap, told.v - ahead.v, xp) > _SLOW_TTC
    back = time_to_collision(behind.gap, behind.v - told.v, xp) > _SLOW_TTC
    wide = (ahead.gap > _SLOW_HEADWAY * told.v) & (behind.gap > _BEHIND_HEADWAY * behind.v)
    return front & back & wide & (ahead.gap > _STANDSTILL) & (behind.gap > _STANDSTILL)


@dataclass(frozen=True)
class RuleTable(Policy):
    """Drives by the table, in JAX.

    Attributes:
      period: s between decisions; in between the speed is kept.
      look: makes the scene.
    """

    period: float = 1.0
    look: LookAround = field(default_factory=LookAround)

    free = False

    def init(self, config: Config, lane_map: LaneMap, state: State) -> Any:
        """Time of the last decision (s) and its action, of each ego."""
        del config, lane_map
        count = state.egos.slot.shape[0]
        return jnp.full(count, -NEVER), jnp.zeros(count, jnp.int32)

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: Any, key: jax.Array
    ) -> tuple[Command, Any]:
        """The action of the rules."""
        del key
        last, held = memory
        scene = self.look(config, lane_map, state)
        time = jnp.broadcast_to(scene.seen.time, last.shape)
        due = is_due(time, last, self.period)
        action = jnp.where(due, rule_action(facts(scene, jnp), jnp).astype(jnp.int32), between(held, jnp))
        return Command(meta=action), (jnp.where(due, time, last), action)


NEVER = 1e6
"""s: before the start by this much no question was asked."""


def is_due(time: Any, last: Any, period: float) -> Any:
    """Whether a question is due, with 1 ms to spare for rounding."""
    return time - last >= period - 1e-3


def between(action: Any, xp: ModuleType = np) -> Any:
    """The action until the next answer: a lane change is asked for once."""
    change = (action == int(Meta.LEFT)) | (action == int(Meta.RIGHT))
    return xp.where(change, int(Meta.KEEP), action)
