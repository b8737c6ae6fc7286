"""Worlds that run again: every step of them, and which vehicle or module could have avoided a failure."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.maps.network import Network
from limsim_jax.metrics.reductions import on_host
from limsim_jax.metrics.safety import Rss
from limsim_jax.policies.base import PolicyLike, variants
from limsim_jax.policies.predict import Replayed, constant_velocity
from limsim_jax.simulation.rollout import Carry, Result, Rollout, Sampler, Started, started
from limsim_jax.simulation.trace import Trace, trace
from limsim_jax.traffic.engine import Command
from limsim_jax.types import Config, State
from limsim_jax.xla import enable_compilation_cache, run_once

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


class Reruns:
    """Runs single worlds of a rollout again, with changes.

    Args:
      rollout: of the sweep, with its policy and measure.
      lane_map: where.
      sample: scenario of a world from its key.
    """

    def __init__(self, rollout: Rollout, lane_map: LaneMap, sample: Sampler) -> None:
        self.rollout, self.lane_map, self.policy = rollout, lane_map, rollout.policy

        def start(lane_map: LaneMap, seed: jax.Array) -> Started:
            return started(rollout, lane_map, sample, seed)

        def advance(lane_map: LaneMap, world: Started, slot: jax.Array, at: jax.Array) -> Result:
            run = replace(rollout, record=trace, policy=_Braking(rollout.policy, slot, at))
            return run.advance(lane_map, *world)[0]

        enable_compilation_cache()
        self._start = jax.jit(start, compiler_options=run_once())
        self._advance = jax.jit(advance)
        self._references = {
            module: jax.jit(partial(self._with_reference, module))
            for module in variants(rollout.policy, constant_velocity)
        }

    def run(self, seed: int, slot: int = -1, at: float = np.inf) -> Result:
        """One world with its trace; the vehicle in `slot` brakes as hard as it can from `at` s on."""
        world = self._start(self.lane_map, np.int32(seed))
        result = jax.device_get(self._advance(self.lane_map, world, np.int32(slot), np.float32(at)))
        single = jax.tree.map(lambda x: x[None], (result.measures, result.totals))
        return result._replace(measures=single[0], totals=single[1])

    def explain(
        self, seed: int, ego: int, metrics: dict[str, float], kind: str, seen: Trace
    ) -> dict[str, Any]:
        """Which vehicle and module could have avoided a failure.

        After a contact the world runs twice more, in which the ego, or the other vehicle, brakes as hard as
        it can. Braking starts at the response time of RSS after the first unsafe moment, at most `UNSAFE` s
        before the contact. A policy made of modules (`policies.base.variants`) drives again from that moment
        on with a reference in the place of each module. A module is named if its reference avoids the failure
        for at least `UNSAFE` s more.

        Args:
          seed: of the world.
          ego: number and slot of the ego.
          metrics: of that world and ego.
          kind: of the failure.
          seen: trace of the world.

        Returns:
          `avoidable_by_ego`, `avoidable_by_other` (after a contact) and `module`.
        """
        found: dict[str, Any] = {}
        event, unsafe = metrics[f"{kind}_time"], metrics["rss_first_time"]
        start = max(event - UNSAFE, 0.0)
        if kind == "contact":
            start = max(start, 0.0 if np.isnan(unsafe) else min(unsafe, event))
            for who, slot in (("ego", ego), ("other", int(metrics["contact_other"]))):
                changed = of_ego(on_host(self.run(seed, slot, start + Rss().response).measures), ego)
                same = changed["contact_other"][0] == metrics["contact_other"]
                later = changed["contact_time"][0] > event + UNSAFE
                found[f"avoidable_by_{who}"] = bool(changed["contacts"][0] == 0 or not same or later)
        blamed = self._modules(seed, ego, kind, start, event + UNSAFE, seen)
        return found | {"module": " or ".join(blamed) or None}

    def _modules(self, seed: int, ego: int, kind: str, start: float, end: float, seen: Trace) -> list[str]:
        """Modules whose references from `start` s on avoid the failure."""
        every = self.rollout.config.decision_time
        first = int(start / every)
        more = min(math.ceil(end / every), self.rollout.decisions) - first
        world = self._start(self.lane_map, np.int32(seed))
        found = []
        for module, advance in self._references.items():
            measures = advance(self.lane_map, world, np.int32(first), np.int32(more), seen.box)
            single = jax.tree.map(lambda x: x[None], jax.device_get(measures))
            if np.isnan(of_ego(on_host(single), ego)[f"{kind}_time"][0]):
                found.append(module)
        return found

    def _with_reference(
        self,
        module: str,
        lane_map: LaneMap,
        world: Started,
        first: jax.Array,
        more: jax.Array,
        box: jax.Array,
    ) -> Any:
        """Metrics of a world with a reference in place of a module.

        The reference drives from decision `first` on, for `more` decisions."""

        def decisions(run: Rollout, count: jax.Array, carry: Carry) -> Carry:
            def one(_: Any, carry: Carry) -> Carry:
                return run.advance(lane_map, world.schedule, world.key, carry, 1)[1]

            return jax.lax.fori_loop(0, count, one, carry)

        run = self.rollout
        assert run.measure is not None
        carry = decisions(run, first, world.carry)
        other = variants(self.policy, Replayed(box, run.config.dt))[module]
        carry = carry._replace(memory=other.init(run.config, lane_map, carry.state))
        carry = decisions(replace(run, policy=other), more, carry)
        return run.measure.result(run.config, lane_map, carry.measured)


def of_ego(metrics: dict[str, Any], ego: int) -> dict[str, Any]:
    """Columns `[W]` of one ego; those that have an axis of egos are `[W, E]`."""
    return {name: x[:, ego] if np.ndim(x) == 2 else x for name, x in metrics.items()}


class _Braking:
    """A policy beside which one vehicle brakes hard."""

    def __init__(self, policy: PolicyLike, slot: jax.Array, at: jax.Array) -> None:
        self.free, self.others = policy.free, getattr(policy, "others", 0)
        self.init = policy.init
        self.policy, self.slot, self.at = policy, slot, at

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: Any, key: jax.Array
    ) -> tuple[Command, Any]:
        command, memory = self.policy(config, lane_map, state, memory, key)
        brakes = (jnp.arange(state.lane.shape[0]) == self.slot) & (config.time(state.step) >= self.at)
        return replace(command, brake=brakes), memory
