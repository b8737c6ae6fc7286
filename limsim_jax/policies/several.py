"""Several policies in one world, each with its own egos."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.policies.base import Policy, PolicyLike, knows, policy_name, sighted
from limsim_jax.traffic.command import Command
from limsim_jax.traffic.ego import Control, Trajectory
from limsim_jax.types import Config, State


@dataclass(frozen=True)
class Several(Policy):
    """Each ego has a policy of its own.

    It sees the other egos as vehicles of the traffic.

    Attributes:
      policies: one per ego, in the order of the experiment.

    Raises:
      ValueError: none, or one that drives other vehicles as well.
    """

    policies: tuple[PolicyLike, ...]
    privileged: bool = field(default=True, kw_only=True)  # every policy has a view of its own

    def __post_init__(self) -> None:
        if not self.policies:
            raise ValueError("policies: none; expected one per ego")
        for policy in self.policies:
            if getattr(policy, "others", 0):
                raise ValueError(
                    f"{policy_name(policy)} drives other vehicles, too; it can be the only policy"
                )

    @property
    def free(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether any ego moves in the plane."""
        return any(self.frees)

    @property
    def frees(self) -> tuple[bool, ...]:
        """Whether each ego moves in the plane."""
        return tuple(policy.free for policy in self.policies)

    @property
    def names(self) -> tuple[str, ...]:
        """The name of the policy of each ego."""
        return tuple(policy_name(policy) for policy in self.policies)

    @property
    def knows(self) -> str:
        """What the policies know."""
        return " and ".join(dict.fromkeys(knows(policy) for policy in self.policies))

    def _parts(self, state: State) -> Iterator[tuple[Policy | PolicyLike, State]]:
        for k, policy in enumerate(self.policies):
            egos = jax.tree.map(lambda x: x[k : k + 1], state.egos)  # noqa: B023
            yield sighted(policy), replace(state, egos=egos)

    def init(self, config: Config, lane_map: LaneMap, state: State) -> tuple[Any, ...]:
        """The memories of all policies."""
        return tuple(policy.init(config, lane_map, own) for policy, own in self._parts(state))

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: tuple[Any, ...], key: jax.Array
    ) -> tuple[Command, tuple[Any, ...]]:
        """The commands of all policies."""
        found = [
            policy(config, lane_map, own, mine, jax.random.fold_in(key, k))
            for k, ((policy, own), mine) in enumerate(zip(self._parts(state), memory, strict=True))
        ]
        return joined([(command, 1) for command, _ in found]), tuple(memory for _, memory in found)

    def memory_rows(self, memory: Any) -> Any:
        """No array has a row per ego: each policy has a memory of its own."""
        return jax.tree.map(lambda _: False, memory)


def joined(parts: Sequence[tuple[Command, int]]) -> Command:
    """One command for the rows of several, in their order.

    Trajectories are at the moments of the last one that has any.

    Args:
      parts: commands, each with the number of its rows.
    """
    commands = [command for command, _ in parts]
    trajectory = [c.trajectory for c in commands if c.trajectory is not None]

    def rows(of: Callable[[Command], Array | None], nothing: int) -> Array | None:
        """A field of all commands, `nothing` where a command has none."""
        found = [of(command) for command in commands]
        if all(x is None for x in found):
            return None
        dtype = next(x.dtype for x in found if x is not None)
        fill = [jnp.full(count, nothing, dtype) for _, count in parts]
        return jnp.concatenate([y if x is None else x for x, y in zip(found, fill, strict=True)])

    a = rows(lambda c: None if c.control is None else c.control.acceleration, 0)
    steering = rows(lambda c: None if c.control is None else c.control.steering, 0)
    control = None if a is None or steering is None else Control(acceleration=a, steering=steering)
    by_control = None
    if trajectory and control is not None:
        by_control = jnp.concatenate(
            [jnp.full(n, c.trajectory is None and c.control is not None) for c, n in parts]
        )
    brake = [c.brake for c in commands if c.brake is not None]
    return Command(
        trajectory=_at_moments(trajectory[-1], parts) if trajectory else None,
        control=control,
        by_control=by_control,
        meta=rows(lambda c: c.meta, -1),
        signal=rows(lambda c: c.signal, 0),
        brake=jnp.stack(brake).any(0) if brake else None,
    )


def _at_moments(like: Trajectory, parts: Sequence[tuple[Command, int]]) -> Trajectory:
    """All trajectories at the moments of one of them; zeros for rows without any."""
    time = like.t0 + like.dt * jnp.arange(like.x.shape[1], dtype=like.x.dtype)
    found = []
    for command, count in parts:
        mine = command.trajectory
        if mine is None:
            found.append([jnp.zeros((count, len(time)), like.x.dtype)] * 4)
        elif mine is like:
            found.append([mine.x, mine.y, mine.heading, mine.v])
        else:
            values = mine.at(time)
            found.append([values[..., k] for k in range(4)])
    x, y, heading, v = (jnp.concatenate(values) for values in zip(*found, strict=True))
    return replace(like, x=x, y=y, heading=heading, v=v)
