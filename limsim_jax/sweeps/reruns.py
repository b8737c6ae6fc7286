"""Worlds that run again: every step of them, and which vehicle or module could have avoided a failure."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.maps.network import Network
from limsim_jax.metrics.reductions import on_host
from limsim_jax.metrics.safety import Rss
from limsim_jax.policies.base import Wrapper, sighted, variants
from limsim_jax.policies.language.store import Answer
from limsim_jax.policies.predict import Replayed, constant_velocity
from limsim_jax.simulation.rollout import Result, Rollout, Started
from limsim_jax.simulation.trace import Trace
from limsim_jax.simulation.worlds import Worlds
from limsim_jax.traffic.command import Command
from limsim_jax.types import Config, State

UNSAFE = 4.0
"""s before a contact at which braking may have begun, at most."""


class Replay(NamedTuple):
    """One world, every step of it."""

    network: Network
    lane_map: LaneMap
    trace: Trace  # [T, ...], NumPy
    ego: int  # slot; -1: a world without an ego
    moments: list[dict[str, Any]]
    metrics: dict[str, float]
    answers: Sequence[Answer] = ()  # of a language model that drives the ego


class Changed(NamedTuple):
    """A world to run again: the vehicle in `slot` brakes as hard as it can from `at` s on."""

    seed: int
    slot: int = -1
    at: float = math.inf


class Reruns:
    """Runs worlds of a sweep again by its program, with changes.

    Args:
      worlds: of a rollout that records `simulation.trace.trace` and whose policy is a `CanBrake`.
      rollout: the same, with the policy alone.
    """

    def __init__(self, worlds: Worlds, rollout: Rollout) -> None:
        self.worlds, self.rollout = worlds, rollout
        self._references = {
            module: jax.jit(partial(self._with_reference, module))
            for module in variants(rollout.policy, constant_velocity)
        }

    def replay(self, seeds: Sequence[int], enough: Callable[[Any], bool] | None = None) -> Result:
        """Worlds with their traces, `[W, T, ...]`.

        `enough` is that of `Worlds.replay`; with it, one chunk at most."""

        def run(worlds: Started, count: int) -> Result:
            return self.worlds.replay(worlds, count=count, enough=enough)

        return self._in_chunks(list(map(Changed, seeds)), run)

    def run(self, changed: Sequence[Changed], decisions: int | None = None) -> Result:
        """Worlds with changes, `[W, ...]`, without traces."""
        return self._in_chunks(changed, lambda worlds, _: self.worlds.run(worlds, decisions))

    def _in_chunks(self, changed: Sequence[Changed], run: Callable[[Started, int], Result]) -> Result:
        parts, size = [], self.worlds.chunk
        for first in range(0, len(changed), size):
            some = changed[first : first + size]
            worlds = self.worlds.start([one.seed for one in some])
            told = worlds.carry.memory
            slot, at = np.full(size, -1, np.int32), np.full(size, np.inf, np.float32)
            slot[: len(some)], at[: len(some)] = [one.slot for one in some], [one.at for one in some]
            told = told._replace(
                slot=jax.device_put(slot, told.slot.sharding), at=jax.device_put(at, told.at.sharding)
            )
            result = run(worlds._replace(carry=worlds.carry._replace(memory=told)), len(some))
            parts.append(jax.tree.map(lambda x: x[: len(some)], result))  # noqa: B023
        return parts[0] if len(parts) == 1 else jax.tree.map(lambda *x: np.concatenate(x), *parts)

    def avoidable(self, failures: Sequence[tuple[int, int, dict[str, float]]]) -> list[dict[str, bool]]:
        """Whether contacts could have been avoided by braking.

        Each world runs twice more, in which the ego, or the other vehicle, brakes as hard as it can. Braking
        starts at the response time of RSS after the first unsafe moment, at most `UNSAFE` s before the
        contact.

        Args:
          failures: seed, number of the ego and metrics of each.

        Returns:
          `avoidable_by_ego` and `avoidable_by_other` of each.
        """
        changed = []
        for seed, ego, metrics in failures:
            event, unsafe = metrics["contact_time"], metrics["rss_first_time"]
            start = max(event - UNSAFE, 0.0, 0.0 if np.isnan(unsafe) else min(unsafe, event))
            for slot in (ego, int(metrics["contact_other"])):
                changed.append(Changed(seed, slot, start + Rss().response))
        if not changed:
            return []
        last = max(metrics["contact_time"] for *_, metrics in failures) + UNSAFE
        measures = on_host(self.run(changed, self._decisions(last)).measures)
        found = []
        for k, (_, ego, metrics) in enumerate(failures):
            found.append({})
            for i, who in enumerate(("ego", "other")):
                now = {name: x[2 * k + i] for name, x in of_ego(measures, ego).items()}
                same = now["contact_other"] == metrics["contact_other"]
                later = now["contact_time"] > metrics["contact_time"] + UNSAFE
                found[-1][f"avoidable_by_{who}"] = bool(now["contacts"] == 0 or not same or later)
        return found

    def module(self, seed: int, ego: int, metrics: dict[str, float], kind: str, seen: Trace) -> str | None:
        """The modules of the policy that are to blame, joined by "or".

        A policy made of modules (`policies.base.variants`) drives again with a reference in the place of each
        module, from the first unsafe moment on, or from `UNSAFE` s before the failure if that is later. A
        module is named if its reference avoids the failure for at least `UNSAFE` s more.

        Args:
          seed: of the world.
          ego: number and slot of the ego.
          metrics: of that world and ego.
          kind: of the failure.
          seen: trace of the world.
        """
        if not self._references:
            return None
        event, unsafe = metrics[f"{kind}_time"], metrics["rss_first_time"]
        start = max(event - UNSAFE, 0.0)
        if kind == "contact" and not np.isnan(unsafe):
            start = max(start, min(unsafe, event))
        every = self.rollout.config.decision_time
        first = int(start / every)
        more = self._decisions(event + UNSAFE) - first
        chunk, _ = self.worlds.advance(self.worlds.start([seed]), first)
        world = jax.tree.map(lambda x: x[0], jax.device_get(chunk))
        steps = self.rollout.decisions * self.rollout.config.decision_every
        box = np.pad(seen.box, [(0, steps - len(seen.box)), (0, 0), (0, 0)], mode="edge")  # one shape for all
        blamed = []
        for module, advance in self._references.items():
            measures = advance(self.worlds.lane_map, world, np.int32(more), box)
            single = jax.tree.map(lambda x: x[None], jax.device_get(measures))
            if np.isnan(of_ego(on_host(single), ego)[f"{kind}_time"][0]):
                blamed.append(module)
        return " or ".join(blamed) or None

    def _decisions(self, until: float) -> int:
        """Decisions to a moment beyond `until` (s), or to the horizon."""
        return min(math.ceil(until / self.rollout.config.decision_time) + 1, self.rollout.decisions)

    def _with_reference(
        self, module: str, lane_map: LaneMap, world: Started, more: jax.Array, box: jax.Array
    ) -> Any:
        """Metrics after `more` decisions with a reference in place of a module."""
        run = self.rollout
        assert run.measure is not None
        other = variants(run.policy, Replayed(box, run.config.dt))[module]
        carry = world.carry._replace(memory=sighted(other).init(run.config, lane_map, world.carry.state))
        run = replace(run, policy=other)
        return run.advance(lane_map, world.schedule, world.key, carry, more)[0].measures


def of_ego(metrics: dict[str, Any], ego: int) -> dict[str, Any]:
    """Columns `[W]` of one ego; those that have an axis of egos are `[W, E]`."""
    return {name: x[:, ego] if np.ndim(x) == 2 else x for name, x in metrics.items()}


class Told(NamedTuple):
    """The memory of `CanBrake`: which vehicle brakes, and from when on."""

    slot: Int[Array, ""]  # -1: none
    at: Float[Array, ""]  # s
    policy: Any  # the memory of the policy


@dataclass(frozen=True)
class CanBrake(Wrapper):
    """A policy beside which one vehicle brakes as hard as it can. Its memory says which."""

    privileged: bool = field(default=True, kw_only=True)

    def init(self, config: Config, lane_map: LaneMap, state: State) -> Any:
        """No vehicle brakes."""
        return Told(jnp.int32(-1), jnp.float32(jnp.inf), sighted(self.policy).init(config, lane_map, state))

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: Any, key: jax.Array
    ) -> tuple[Command, Any]:
        """The command of the policy, and the braking."""
        command, inner = sighted(self.policy)(config, lane_map, state, memory.policy, key)
        brakes = (jnp.arange(state.lane.shape[0]) == memory.slot) & (config.time(state.step) >= memory.at)
        return replace(command, brake=brakes), memory._replace(policy=inner)
