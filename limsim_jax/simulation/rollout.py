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
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Int, Key

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
from limsim_jax.xla import mapped_like, row, with_row

KEPT = 40
"""Decisions that many worlds run on before they are measured, at most."""

_KEPT_ROWS = 2600  # rows of vehicles that decisions leave behind until then

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

    def init(self, config: Config, lane_map: LaneMap, state: State) -> tuple[Any, Any]:
        """The carry with nothing measured yet, and the record of the start; None: it does not count."""
        ...

    def record(self, config: Config, lane_map: LaneMap, tick: Tick) -> Any:
        """What `update` needs to know of a physics step."""
        ...

    def update(
        self,
        config: Config,
        lane_map: LaneMap,
        carry: Any,
        records: Any,
        *,
        start: bool | Bool[Array, ""] = False,
    ) -> Any:
        """The carry after a decision and its physics steps, `records` `[decision_every, ...]`.

        `start`: the last record is that of the start, and the others do not count.
        """
        ...

    def result(self, config: Config, lane_map: LaneMap, carry: Any) -> Any:
        """What was found, at the end."""
        ...


def measured_start(measure: Measure, config: Config, lane_map: LaneMap, state: State) -> Any:
    """The carry of a measure after the start."""
    carry, record = measure.init(config, lane_map, state)
    if record is None:
        return carry
    return measure.update(config, lane_map, carry, jax.tree.map(lambda x: x[None], record), start=True)


@struct.dataclass(frozen=True)
class Kept:
    """A tree whose leaves are partly the same arrays, each held once: loops write it twice as fast."""

    arrays: list[Any]
    place: tuple[int, ...] = struct.field(pytree_node=False)  # of each leaf among the arrays
    structure: Any = struct.field(pytree_node=False)

    @classmethod
    def of(cls, tree: Any) -> Kept:
        """Leaves that are one object are the same."""
        leaves, structure = jax.tree.flatten(tree)
        first = {id(x): x for x in leaves}
        order = list(first)
        return cls(list(first.values()), tuple(order.index(id(x)) for x in leaves), structure)

    @property
    def tree(self) -> Any:
        """The tree."""
        return jax.tree.unflatten(self.structure, [self.arrays[k] for k in self.place])


class Seen(NamedTuple):
    """What a decision leaves behind for pictures and metrics."""

    before: Int[Array, ""]  # physics steps before it
    over: Bool[Array, ""] | None  # the world has ended before it; None: none does
    trace: Any  # what `record` returned, [decision_every, ...]
    records: Any  # what `measure.record` returned, [decision_every, ...]


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
        measured = None
        if self.measure is not None:
            measured = measured_start(self.measure, self.config, lane_map, state)
        stood = Stood(state.distance, jnp.full_like(state.distance, self.config.time(state.step)))
        return mapped_like(state.s, Carry(state, memory, no_totals(state), stood, measured))

    def before(self, lane_map: LaneMap, state: State) -> tuple[Carry, Any]:
        """As `init`, but the start is not measured: the record of it, for `look`."""
        carry = replace(self, measure=None).init(lane_map, state)
        if self.measure is None:
            return carry, None
        measured, record = self.measure.init(self.config, lane_map, carry.state)
        return carry._replace(measured=measured), record

    def kept(self, state: State) -> int:
        """Decisions that `drive` runs on at most: few where there are many vehicles."""
        return max(1, min(KEPT, _KEPT_ROWS // max(state.s.shape[-1], 1)))

    def advance(
        self,
        lane_map: LaneMap,
        schedule: Schedule,
        key: Key[Array, ""],
        carry: Carry,
        decisions: int | Int[Array, ""] | None = None,
    ) -> tuple[Result, Carry]:
        """Run on to the horizon or for a number of decisions.

        One program serves all numbers if the number is an array. It keeps no records, and has no gradient in
        reverse.

        Returns the result, and the carry to run on from there."""

        def decide(carry: Carry, _: None) -> tuple[Carry, Any]:
            new, seen = self._decide(lane_map, schedule, key, carry)
            return new._replace(measured=self._look(lane_map, schedule, carry.measured, seen)), seen.trace

        length = self.decisions if decisions is None else decisions
        if isinstance(length, int):
            carry, trace = lax.scan(decide, carry, None, length=length)
            trace = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), trace)
        else:
            carry, trace = lax.fori_loop(0, length, lambda _, x: decide(x, None)[0], carry), None
        carry = self._with_waiting(schedule, carry)
        found = None if self.measure is None else self.measure.result(self.config, lane_map, carry.measured)
        return Result(carry.state, carry.totals, trace, found), carry

    def drive(
        self,
        lane_map: LaneMap,
        schedule: Schedule,
        key: Key[Array, ""],
        carry: Carry,
        decisions: Int[Array, ""],
    ) -> tuple[Carry, Kept]:
        """Run on for at most `kept` decisions without measuring.

        Returns:
          The carry, and what `Seen` the decisions leave behind, `[kept, ...]`.
        """

        @jax.jit  # traced once for both uses
        def once(carry: Carry) -> tuple[Carry, Kept]:
            carry, seen = self._decide(lane_map, schedule, key, carry)
            return carry, Kept.of(seen)

        shapes = jax.eval_shape(once, carry)[1]
        most = self.kept(carry.state)
        none = jax.tree.map(lambda x: jnp.zeros((most, *x.shape), x.dtype), shapes)

        def keep(i: Array, both: tuple[Carry, Kept]) -> tuple[Carry, Kept]:
            carry, seen = once(both[0])
            return carry, with_row(both[1], i, seen)

        carry, seen = lax.fori_loop(0, decisions, keep, (carry, mapped_like(carry.state.s, none)))
        return self._with_waiting(schedule, carry), seen

    def look(
        self,
        lane_map: LaneMap,
        schedule: Schedule,
        measured: Any,
        seen: Seen,
        first: Any,
        decisions: Int[Array, ""],
        start: Bool[Array, ""],
    ) -> tuple[Any, Any]:
        """Measure what some decisions have left behind, or the start.

        Args:
          lane_map: where.
          schedule: of the world.
          measured: the carry of the measure.
          seen: by `drive`, `[kept, ...]`.
          first: the record of the start, by `before`; None: it does not count.
          decisions: how many; 1 for the start.
          start: whether to measure the start instead of what was seen.

        Returns:
          The carry of the measure, and what it has found so far.
        """
        assert self.measure is not None

        def one(i: Array, measured: Any) -> Any:
            now = row(seen, i)
            if first is None:
                return self._look(lane_map, schedule, measured, now)
            records = jax.tree.map(lambda x, y: jnp.where(start, x[None], y), first, now.records)
            if now.over is not None:
                now = now._replace(over=now.over & ~start)
            return self._look(lane_map, schedule, measured, now._replace(records=records), start)

        measured = lax.fori_loop(0, decisions, one, measured)
        return measured, self.measure.result(self.config, lane_map, measured)

    def _decide(
        self, lane_map: LaneMap, schedule: Schedule, key: Key[Array, ""], carry: Carry
    ) -> tuple[Carry, Seen]:
        """One decision and its physics steps; `measured` stays."""
        config, measure, policy = self.config, self.measure, sighted(self.policy)
        trace = None if self.record is None else self.record(lane_map)
        state, memory, totals, stood, _ = carry
        now = jax.random.fold_in(key, state.step)
        lanes = lanes_now(config, lane_map, schedule, state.step)

        def record(tick: Tick) -> Kept:
            drawn = None if trace is None else trace(tick)
            return Kept.of((drawn, None if measure is None else measure.record(config, lanes, tick)))

        command, memory = policy(config, lanes, state, memory, now)
        after, kept = drive(
            config, self.traffic, lanes, state, schedule, command, record,
            free=self._free,
            key=None if self.traffic.human is None else jax.random.fold_in(now, _DRIVERS),
        )  # fmt: skip
        totals, stood = count(config, totals, stood, state, after)
        new = Carry(after, memory, totals, stood, None)
        over = self._over(state)
        if over is not None:
            new = jax.tree.map(lambda x, y: jnp.where(over, x, y), carry._replace(measured=None), new)
        return new._replace(measured=carry.measured), Seen(state.step, over, *kept.tree)

    def _look(
        self,
        lane_map: LaneMap,
        schedule: Schedule,
        measured: Any,
        seen: Seen,
        start: bool | Bool[Array, ""] = False,
    ) -> Any:
        """The metrics after one decision."""
        if self.measure is None:
            return measured
        lanes = lanes_now(self.config, lane_map, schedule, seen.before)
        new = self.measure.update(self.config, lanes, measured, seen.records, start=start)
        over = seen.over
        return new if over is None else jax.tree.map(lambda x, y: jnp.where(over, x, y), measured, new)

    def _over(self, state: State) -> Bool[Array, ""] | None:
        """Whether a world has ended; None: none does."""
        ends = [collided(state)] if self.traffic.after_collision == "end" else []
        ends += [] if state.outside is None else [state.outside.over]
        return jnp.stack(ends).any() if ends else None

    def _with_waiting(self, schedule: Schedule, carry: Carry) -> Carry:
        late = delayed(schedule, carry.state, self.config.time(carry.state.step))
        return carry._replace(totals=replace(carry.totals, waiting=jnp.sum(late, dtype=jnp.int32)))


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


def drawn(sampler: Sampler, seed: int | Int[Array, ""]) -> tuple[Scenario, Key[Array, ""]]:
    """The scenario of a seed, and the key of its policy."""
    scenario_key, policy_key = jax.random.split(world_key(seed))
    return sampler(scenario_key), policy_key


def started(run: Rollout, lane_map: LaneMap, sampler: Sampler, seed: int | Int[Array, ""]) -> Started:
    """Draw the scenario of a seed and put it on the map."""
    scenario, key = drawn(sampler, seed)
    return Started(scenario.schedule, key, run.init(lane_map, scenario.start))


def one_world(run: Rollout, lane_map: LaneMap, sampler: Sampler, seed: int | Int[Array, ""]) -> Result:
    """The world of a seed from start to end."""
    return run.advance(lane_map, *started(run, lane_map, sampler, seed))[0]
