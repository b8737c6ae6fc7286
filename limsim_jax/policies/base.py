"""What a policy is: it looks at the world once per decision and commands the egos."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import jax
from jaxtyping import Array, Key

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.policies.predict import Predictor
from limsim_jax.traffic.engine import Command
from limsim_jax.types import Config, State


class Policy(Protocol):
    """A pure function of the world with a memory of its own; written for one world."""

    @property
    def free(self) -> bool:
        """Whether its egos move in the plane, by a trajectory or by controls, or keep to lanes."""
        ...

    @property
    def others(self) -> int:
        """How many vehicles of the traffic it can drive at a time beside the egos: rows of `State.egos`."""
        ...

    def init(self, config: Config, lane_map: LaneMap, state: State) -> Any:
        """The memory at the start: any pytree, of the same shapes ever after."""
        ...

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: Any, key: Key[Array, ""]
    ) -> tuple[Command, Any]:
        """What the egos do until the next decision, and the new memory. `key` is of this decision."""
        ...


def build_policy(factory: Callable[..., Policy], options: Mapping[str, Any]) -> Policy:
    """The policy that an experiment file describes.

    Raises:
      ValueError: an option that there is not, or a value that makes no sense.
    """
    takes = inspect.signature(factory).parameters
    anything = any(x.kind is inspect.Parameter.VAR_KEYWORD for x in takes.values())
    for name in options:
        if name not in takes and not anything:
            raise ValueError(f"{name}: no such option; there are {', '.join(takes) or 'none'}")
    return factory(**options)


def variants(policy: Any, seen: Predictor) -> dict[str, Policy]:
    """The policy with a reference in the place of one module, by what the module does; or nothing.

    That is asked for after a failure: a module is to blame if its reference would have avoided it. A policy
    that is made of modules has a method of this name. `seen` predicts what came to pass.
    """
    found = getattr(policy, "variants", None)
    return {} if found is None else found(seen)


class LikeTraffic:
    """The egos drive as all traffic does: car following, lane changes, right of way."""

    free = False
    others = 0

    def init(self, config: Config, lane_map: LaneMap, state: State) -> Any:
        """Nothing to remember."""
        del config, lane_map, state

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: Any, key: jax.Array
    ) -> tuple[Command, Any]:
        """No command."""
        del config, lane_map, state, key
        return Command(), memory
