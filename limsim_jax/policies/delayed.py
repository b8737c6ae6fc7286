"""A fault of actuators: a policy whose commands take effect late."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.policies.base import PolicyLike, Wrapper, memory_rows, sighted, variants
from limsim_jax.policies.predict import Predictor
from limsim_jax.sensors.chance import delay_line, delayed, whole_steps
from limsim_jax.traffic.command import Command
from limsim_jax.types import Config, State


class _Late(NamedTuple):
    line: Any  # commands on their way, [steps, ...]
    begun: Any  # bool, there was a decision
    policy: Any  # the memory of the policy


@dataclass(frozen=True)
class Delayed(Wrapper):
    """A policy whose commands take effect some decisions later.

    It sees the present, and what it commands is carried out `delay` s from now. The first command holds from
    the start on. A late trajectory keeps its times: the ego goes on along the older plan.

    Attributes:
      policy: decides; by its own view.
      delay: s, in whole decisions.

    Raises:
      ValueError: a delay below 0, or a policy that drives vehicles around the egos.
    """

    delay: float = 0.5
    privileged: bool = field(default=True, kw_only=True)

    def __post_init__(self) -> None:
        if not self.delay >= 0:
            raise ValueError(f"delay: {self.delay} s; expected 0 or more")
        if self.others:
            raise ValueError("delay: the policy drives vehicles around the egos; only egos can be late")

    @property
    def knows(self) -> str:
        """What the policy knows."""
        from limsim_jax.policies.base import knows

        return knows(self.policy)

    def init(self, config: Config, lane_map: LaneMap, state: State) -> _Late:
        """No command is on its way.

        Raises:
          ValueError: a delay that is not a whole number of decisions.
        """
        steps = whole_steps(self.delay, config.decision_time, "delay")
        policy = sighted(self.policy)
        memory = policy.init(config, lane_map, state)
        key = jax.random.key(0)
        shapes = jax.eval_shape(
            lambda state, memory: policy(config, lane_map, state, memory, key)[0], state, memory
        )
        none = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        return _Late(delay_line(none, steps), jnp.bool_(False), memory)

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: _Late, key: jax.Array
    ) -> tuple[Command, _Late]:
        """The command of before."""
        command, inner = sighted(self.policy)(config, lane_map, state, memory.policy, key)
        line = jax.tree.map(lambda old, new: jnp.where(memory.begun, old, new[None]), memory.line, command)
        then, line = delayed(line, command)
        return then, _Late(line, jnp.bool_(True), inner)

    def memory_rows(self, memory: _Late) -> Any:
        """Those of the policy."""
        rows = memory_rows(sighted(self.policy), memory.policy)
        return _Late(jax.tree.map(lambda _: False, memory.line), False, rows)

    def variants(self, seen: Predictor) -> dict[str, PolicyLike]:
        """Those of the policy, as late; and `actuation`, at once."""
        found: dict[str, PolicyLike] = {
            name: Delayed(other, self.delay) for name, other in variants(self.policy, seen).items()
        }
        return {"actuation": self.policy} | found if self.delay else found
