"""Futures: a world that is stopped at some moments, from which several worlds go on."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa

from limsim_jax.api.world import World
from limsim_jax.metrics.reductions import on_host
from limsim_jax.policies.base import PolicyLike, named
from limsim_jax.sweeps.build import policy_of
from limsim_jax.sweeps.experiment import with_policy
from limsim_jax.sweeps.reruns import of_ego
from limsim_jax.sweeps.what_if import futures, stopped

if TYPE_CHECKING:
    from limsim_jax.sweeps.episode import Episodes
    from limsim_jax.types import State


class Futures(Sequence[World]):
    """Worlds that go on from one moment or from several.

    Attributes:
      worlds: policy by policy, moment by moment, copy by copy.
      at: s, the moment of each world.
    """

    def __init__(self, worlds: Sequence[World], at: Sequence[float]) -> None:
        self.worlds, self.at = list(worlds), list(at)

    def __len__(self) -> int:
        return len(self.worlds)

    def __getitem__(self, k: Any) -> Any:
        return self.worlds[k]

    def __iter__(self) -> Iterator[World]:
        return iter(self.worlds)

    def table(self) -> pa.Table:
        """A row per future: policy, moment (s), copy, and every metric from the fork on."""
        names = list(self.worlds[0].metrics)
        count: dict[tuple[str, float], int] = {}
        rows = []
        for world, at in zip(self.worlds, self.at, strict=True):
            copy = count[world.policy, at] = count.get((world.policy, at), -1) + 1
            rows.append({"policy": world.policy, "at": at, "copy": copy})
            rows[-1] |= {name: world.metrics[name] for name in names}
        return pa.Table.from_pylist(rows)

    def trajectories(self) -> pa.Table:
        """All vehicles of all futures in one long table.

        Columns `policy`, `at` and `copy` come first.
        """
        keys = self.table().select(["policy", "at", "copy"]).to_pylist()
        parts = []
        for key, world in zip(keys, self.worlds, strict=True):
            part = world.trajectories()
            for place, (name, value) in enumerate(key.items()):
                part = part.add_column(place, name, pa.array([value] * part.num_rows))
            parts.append(part)
        return pa.concat_tables(parts, promote_options="default")

    def __repr__(self) -> str:
        names = ", ".join(dict.fromkeys(world.policy for world in self.worlds))
        times = ", ".join(f"{at:g}" for at in dict.fromkeys(self.at))
        return f"{len(self)} futures from {times} s on ({names})"


def run_futures(
    world: World,
    at: float | Sequence[float],
    policies: Sequence[PolicyLike | str | None],
    count: int,
    change: Callable[[State, Any], State] | None,
    seconds: float | None,
) -> Futures:
    """What `World.fork` returns."""
    if count < 1 or not policies:
        raise ValueError("count: at least one copy of at least one policy is needed")
    episodes = world.episodes
    assert episodes is not None
    moments = np.atleast_1d(np.asarray(at, float))
    begun, begin = stopped(episodes, world.seed, moments.tolist())
    run = episodes.rollout
    every = run.config.decision_time
    left = run.decisions - max(begin)
    decisions = left if seconds is None else min(left, max(1, round(seconds / every)))
    if decisions < 1:
        raise ValueError(f"at: {moments.max():g} s; nothing is left of {run.horizon:g} s")
    begun = jax.tree.map(lambda x: jnp.repeat(x, count, 0), begun)
    copies = np.tile(np.arange(count, dtype=np.int32), len(moments))
    found = []
    for policy in policies:
        same = policy is None
        driven = episodes if policy is None else episodes.under(_driver(episodes, policy))
        result = futures(driven, begun, decisions, same=same, change=change, copies=copies)
        columns = of_ego(on_host(result.measures), max(world.ego, 0))
        for k in range(len(moments) * count):
            found.append(
                replace(
                    world,
                    policy=driven.policy,
                    trace=jax.tree.map(lambda x: x[k], result.trace),  # noqa: B023
                    metrics={metric: float(np.asarray(x)[k]) for metric, x in columns.items()},
                    moments=[],
                    episodes=None,
                )
            )
    at_each = np.repeat(np.asarray(begin) * every, count)
    return Futures(found, np.tile(at_each, len(policies)).tolist())


def _driver(episodes: Episodes, policy: PolicyLike | str) -> PolicyLike:
    """The policy itself, or the one of this name."""
    if not isinstance(policy, str):
        return policy
    file = episodes.experiment
    egos = [ego.model_dump() for ego in file.ego]
    found = type(file).model_validate(file.model_dump() | {"ego": with_policy(egos, policy, file.name)})
    return named(found.policy, policy_of(found))
