"""One world through time.

    run = Rollout(config, traffic, horizon=60.0)
    result = jax.jit(run)(lane_map, scenario, key)

A world depends on its seed alone, not on its companions in a batch. The same package version, backend and
chunk shape give the same bits. A run that is saved and resumed ends as an uninterrupted one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int, Key

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.policies.base import LikeTraffic, PolicyLike, sighted
from limsim_jax.simulation.totals import Stood, Totals, count, no_totals
from limsim_jax.traffic.collision import collided
from limsim_jax.traffic.demand import delayed
from limsim_jax.traffic.ego import with_rows
from limsim_jax.traffic.engine import Tick, Traffic, drive
from limsim_jax.traffic.human import first_memory
from limsim_jax.traffic.script import lanes_now
from limsim_jax.types import Config, Scenario, Schedule, State
from limsim_jax.xla import mapped_like

KEPT = 10
"""Decisions whose records a run of any length keeps: the last ones; of fewer, from the first on."""

_DRIVERS = 1  # for the errors of drivers, of all that is drawn from the key of a decision


class Result(NamedTuple):
    """The end of a run."""

    state: State
    totals: Totals
    trace: Any  # what `record` returned, [steps, ...]
    measures: Any  # what `measure` found


class Carry(NamedTuple):
    """A run that goes on: all that `Rollout.advance` needs to know of the past."""

    state: State
    memory: Any  # of the policy
    totals: Totals
    stood: Stood
    measured: Any  # by `measure` so far


class Measure(Protocol):
    """Metrics that are kept up while a world runs; written for one world."""

    def init(self, config: Config, lane_map: LaneMap, state: State) -> Any:
        """The carry at the start."""
        ...

    def record(self, config: Config, lane_map: LaneMap, tick: Tick) -> Any:
        """What `update` needs to know of a physics step."""
        ...

    def update(self, config: Config, lane_map: LaneMap, carry: Any, records: Any) -> Any:
        """The carry after a decision and its physics steps, `records` `[decision_every, ...]`."""
        ...

    def result(self, config: Config, lane_map: LaneMap, carry: Any) -> Any:
        """What was found, at the end."""
        ...


@dataclass(frozen=True)
class Rollout:
    """A run of one world from a scenario: a pure function, for `jit` and `vmap`.

    Attributes:
      config: steps and look-ahead.
      traffic: behaviour of the others.
      horizon: s; rounded up to whole decisions.
      policy: drives the egos, by its view of the world unless it is privileged.
      record: of every physics step, given the lane map: `trace`, or None for none.
      measure: metrics, or None.
    """

    config: Config
    traffic: Traffic
    horizon: float
    policy: PolicyLike = field(default_factory=LikeTraffic)
    record: Callable[[LaneMap], Callable[[Tick], Any]] | None = None
    measure: Measure | None = None

    def __post_init__(self) -> None:
        if not self.horizon > 0 or not math.isfinite(self.horizon):
            raise ValueError(f"a horizon of {self.horizon} s? it must be above 0")

    @property
    def decisions(self) -> int:
        """Decisions within the horizon."""
        return math.ceil(self.horizon / self.config.decision_time - 1e-6)

    @property
    def _free(self) -> bool:
        """Whether any vehicle may leave the lanes."""
        return self.policy.free or getattr(self.policy, "others", 0) > 0

    def __call__(self, lane_map: LaneMap, scenario: Scenario, key: Key[Array, ""]) -> Result:
        """Run from the start. `key` is the policy's."""
        return self.advance(lane_map, scenario.schedule, key, self.init(lane_map, scenario.start))[0]

    def init(self, lane_map: LaneMap, state: State) -> Carry:
        """Before the first decision."""
        egos = with_rows(state.egos, getattr(self.policy, "others", 0))
        if not self._free:
            egos = replace(egos, free=jnp.zeros_like(egos.free))
        human = self.traffic.human
        memory = None if human is None else first_memory(human, self.config, state.s.shape[0])
        state = replace(state, egos=egos, human=memory)
        return self.restart(lane_map, state, sighted(self.policy).init(self.config, lane_map, state))

    def restart(self, lane_map: LaneMap, state: State, memory: Any) -> Carry:
        """Before a decision of a world that runs already: totals and metrics begin here."""
        measured = None if self.measure is None else self.measure.init(self.config, lane_map, state)
        stood = Stood(state.distance, jnp.full_like(state.distance, self.config.time(state.step)))
        return mapped_like(state.s, Carry(state, memory, no_totals(state), stood, measured))

    def advance(
        self,
        lane_map: LaneMap,
        schedule: Schedule,
        key: Key[Array, ""],
        carry: Carry,
        decisions: int | Int[Array, ""] | None = None,
    ) -> tuple[Result, Carry]:
        """Run on to the horizon or for a number of decisions.

        One program serves all numbers if the number is an array. It keeps the records of `KEPT` decisions,
        and has no gradient in reverse.

        Returns the result, and the carry to run on from there."""
        config, measure, policy = self.config, self.measure, sighted(self.policy)
        trace = None if self.record is None else self.record(lane_map)

        def record(lanes: LaneMap, tick: Tick) -> tuple[Any, Any]:
            kept = None if trace is None else trace(tick)
            return kept, None if measure is None else measure.record(config, lanes, tick)

        def decide(carry: Carry, _: None) -> tuple[Carry, Any]:
            state, memory, totals, stood, measured = carry
            now = jax.random.fold_in(key, state.step)
            lanes = lanes_now(config, lane_map, schedule, state)
            command, memory = policy(config, lanes, state, memory, now)
            after, (kept, records) = drive(
                config, self.traffic, lanes, state, schedule, command, partial(record, lanes),
                free=self._free,
                key=None if self.traffic.human is None else jax.random.fold_in(now, _DRIVERS),
            )  # fmt: skip
            if measure is not None:
                measured = measure.update(config, lanes, measured, records)
            totals, stood = count(config, totals, stood, state, after)
            new = Carry(after, memory, totals, stood, measured)
            ends = [collided(state)] if self.traffic.after_collision == "end" else []
            ends += [] if state.outside is None else [state.outside.over]
            if ends:
                over = jnp.stack(ends).any()
                new = jax.tree.map(lambda x, y: jnp.where(over, x, y), carry, new)
            return new, kept

        length = self.decisions if decisions is None else decisions
        if isinstance(length, int):
            carry, records = lax.scan(decide, carry, None, length=length)
        else:
            once = jax.jit(decide)  # traced once for both uses
            shapes = jax.eval_shape(once, carry, None)[1]
            none = jax.tree.map(lambda x: jnp.zeros((KEPT, *x.shape), x.dtype), shapes)

            def keep(i: Array, both: tuple[Carry, Any]) -> tuple[Carry, Any]:
                carry, kept = once(both[0], None)
                return carry, jax.tree.map(lambda x, new: x.at[i % KEPT].set(new), both[1], kept)

            carry, records = lax.fori_loop(0, length, keep, (carry, mapped_like(carry.state.s, none)))
        records = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), records)
        late = delayed(schedule, carry.state, config.time(carry.state.step))
        carry = carry._replace(totals=replace(carry.totals, waiting=jnp.sum(late, dtype=jnp.int32)))
        found = None if measure is None else measure.result(config, lane_map, carry.measured)
        return Result(carry.state, carry.totals, records, found), carry


def world_key(seed: int | Int[Array, ""]) -> Key[Array, ""]:
    """The key of a world. All that is random in it is drawn from this, by purpose, entity and step."""
    return jax.random.fold_in(jax.random.key(0), seed)


def decision_key(seed: int, step: int) -> Key[Array, ""]:
    """The key of a policy's decision in a world.

    `step`: physics steps before it."""
    return jax.random.fold_in(jax.random.split(world_key(seed))[1], step)


Sampler = Callable[[Key[Array, ""]], Scenario]
"""Draws the scenario of a world from its key."""


class Started(NamedTuple):
    """A world before its first decision."""

    schedule: Schedule
    key: Key[Array, ""]  # of the policy
    carry: Carry


def started(run: Rollout, lane_map: LaneMap, sampler: Sampler, seed: int | Int[Array, ""]) -> Started:
    """Draw the scenario of a seed and put it on the map."""
    scenario_key, policy_key = jax.random.split(world_key(seed))
    scenario = sampler(scenario_key)
    return Started(scenario.schedule, policy_key, run.init(lane_map, scenario.start))


def one_world(run: Rollout, lane_map: LaneMap, sampler: Sampler, seed: int | Int[Array, ""]) -> Result:
    """The world of a seed from start to end; the same whether it runs alone or in a batch."""
    return run.advance(lane_map, *started(run, lane_map, sampler, seed))[0]
