"""Worlds through time: one, a batch, all devices; branched, saved, resumed.

    run = Rollout(config, traffic, horizon=60.0)
    result = jax.jit(run)(lane_map, scenario, key)                     # one world
    totals = Worlds(run, lane_map, sampler).run_totals(range(1000))    # many, on all local devices

A world depends on its seed alone, not on those beside it. The same package version, backend and chunk shape
give the same bits. A run that is saved and resumed ends as one that was not.
"""

from __future__ import annotations

import contextlib
import gc
import io
import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float, Int, Key

from limsim_jax.files import write_whole
from limsim_jax.maps.cache import directory
from limsim_jax.maps.lane_map import NO_LANE, LaneMap
from limsim_jax.numerics import mapped_like
from limsim_jax.policies.base import LikeTraffic, Policy
from limsim_jax.traffic.collision import collided
from limsim_jax.traffic.demand import delayed
from limsim_jax.traffic.ego import with_rows
from limsim_jax.traffic.engine import Tick, Traffic, drive
from limsim_jax.traffic.motion import boxes
from limsim_jax.types import Config, Scenario, Schedule, State, Status

GRIDLOCK = 120.0
"""s after which a vehicle that did not get on is stuck and its world gridlocked; longer than a red."""
GOT_ON = 5.0
"""m that a vehicle has to get on in that time, less than a place in a queue."""


@struct.dataclass(frozen=True, kw_only=True)
class Totals:
    """What happened in a world, kept up while it runs. Vehicles count once per kind of event."""

    entered: Int[Array, ""]  # those of the start included
    left: Int[Array, ""]  # at their goals
    waiting: Int[Array, ""]  # outside, for room to enter
    full: Int[Array, ""]  # decisions at which somebody could not enter for want of a slot
    collided: Int[Array, ""]
    off_road: Int[Array, ""]
    wrong_way: Int[Array, ""]
    ran_red: Int[Array, ""]
    missed: Int[Array, ""]  # took another goal for want of a gap to change lanes
    hard: Int[Array, ""]  # braked harder than `b_max`
    broken: Int[Array, ""]  # numbers that are not finite
    gridlock: Bool[Array, ""]
    deceleration: Float[Array, ""]  # m/s^2, the hardest
    longest_wait: Float[Array, ""]  # s
    distance: Float[Array, ""]  # m, of all vehicles
    time: Float[Array, ""]  # s, of all vehicles on the road
    travel_time: Float[Array, ""]  # s, of those who have left, together


class Result(NamedTuple):
    """The end of a run."""

    state: State
    totals: Totals
    trace: Any  # what `record` returned, [steps, ...]
    measures: Any  # what `measure` found


class Stood(NamedTuple):
    """Where and when each vehicle had last got on, for `N` slots."""

    at: Float[Array, " N"]  # m, of `State.distance`
    since: Float[Array, " N"]  # s


class Carry(NamedTuple):
    """A run that goes on: all that `Rollout.go_on` needs to know of the past."""

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


class Trace(NamedTuple):
    """The standard record of a step, for `N` slots and `E` rows of `Egos`.

    What is None is not known: nothing of egos in a world without, no plans of a policy that gives no
    trajectories.
    """

    time: Float[Array, ""]  # s
    active: Bool[Array, " N"]
    vehicle: Int[Array, " N"]  # row of the schedule; -1: was there at the start
    lane: Int[Array, " N"]
    s: Float[Array, " N"]
    d: Float[Array, " N"]
    v: Float[Array, " N"]
    a: Float[Array, " N"]
    box: Float[Array, "N 5"]  # x, y (m), heading (rad), length, width (m)
    status: Int[Array, " N"]
    phase: Int[Array, " P"]  # of the signal programs
    vehicle_class: Int[Array, " N"] | None = None  # row of `maps.lane_map.VEHICLE_CLASSES`
    driven: Int[Array, " E"] | None = None  # slot that the policy drives, egos first; -1: nobody
    to_go: Float[Array, ""] | None = None  # m of the first ego to its goal (`routes.distance`); NaN: none
    plan: Float[Array, "E H 2"] | None = None  # m, x and y planned at the decision; NaN: no trajectory
    plan_time: Float[Array, " H"] | None = None  # s, when


def trace(lane_map: LaneMap) -> Callable[[Tick], Trace]:
    """A `record` that keeps everything that a picture or a table needs."""

    def record(tick: Tick) -> Trace:
        state = tick.state
        some = state.egos.slot.shape[0] > 0
        driven = jnp.where(state.active[state.egos.slot], state.egos.slot, -1) if some else None
        plan, plan_time = _plan(tick, driven)
        return Trace(
            time=tick.time,
            active=state.active,
            vehicle=state.vehicle,
            lane=state.lane,
            s=state.s,
            d=state.d,
            v=state.v,
            a=state.a,
            box=boxes(lane_map, state),
            status=state.status,
            phase=state.lights.phase,
            vehicle_class=state.shape.vehicle_class,
            driven=driven,
            to_go=_to_go(lane_map, state) if some else None,
            plan=plan,
            plan_time=plan_time,
        )

    return record


def _plan(tick: Tick, driven: Int[Array, " E"] | None) -> tuple[Array | None, Array | None]:
    """Trajectories of those that follow one, and the times of their samples (s)."""
    planned, egos = tick.command.trajectory, tick.state.egos
    if planned is None or driven is None:
        return None, None
    follows = (egos.free & (driven >= 0))[:, None, None]
    plan = jnp.where(follows, jnp.stack([planned.x, planned.y], -1), jnp.nan)
    return plan, planned.t0 + planned.dt * jnp.arange(plan.shape[1], dtype=plan.dtype)


def _to_go(lane_map: LaneMap, state: State) -> Float[Array, ""]:
    """Metres from the front bumper of the first ego to the end of its goal; NaN: gone, or no way there."""
    slot = state.egos.slot[0]
    lane = state.lane[slot]
    routes, goal = lane_map.routes, state.goal[slot]
    known = state.active[slot] & (lane != NO_LANE) & routes.reachable[lane, goal]
    return jnp.where(known, jnp.maximum(routes.distance[lane, goal] - state.s[slot], 0), jnp.nan)


@dataclass(frozen=True)
class Rollout:
    """A run of one world from a scenario: a pure function, for `jit` and `vmap`.

    Attributes:
      config: steps and look-ahead.
      traffic: behaviour of the others.
      horizon: s; rounded up to whole decisions.
      policy: drives the egos.
      record: of every physics step, given the lane map: `trace`, or None for none.
      measure: metrics, or None.
    """

    config: Config
    traffic: Traffic
    horizon: float
    policy: Policy = field(default_factory=LikeTraffic)
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
        """Whether anybody may leave the lanes."""
        return self.policy.free or getattr(self.policy, "others", 0) > 0

    def __call__(self, lane_map: LaneMap, scenario: Scenario, key: Key[Array, ""]) -> Result:
        """Run from the start. `key` is the policy's."""
        return self.go_on(lane_map, scenario.schedule, key, self.begin(lane_map, scenario.start))[0]

    def begin(self, lane_map: LaneMap, state: State) -> Carry:
        """Before the first decision."""
        egos = with_rows(state.egos, getattr(self.policy, "others", 0))
        if not self._free:
            egos = replace(egos, free=jnp.zeros_like(egos.free))
        state = replace(state, egos=egos)
        return self.anew(lane_map, state, self.policy.init(self.config, lane_map, state))

    def anew(self, lane_map: LaneMap, state: State, memory: Any) -> Carry:
        """Before a decision of a world that runs already: totals and metrics begin here."""
        measured = None if self.measure is None else self.measure.init(self.config, lane_map, state)
        stood = Stood(state.distance, jnp.full_like(state.distance, self.config.time(state.step)))
        return mapped_like(state.s, Carry(state, memory, no_totals(state), stood, measured))

    def go_on(
        self,
        lane_map: LaneMap,
        schedule: Schedule,
        key: Key[Array, ""],
        carry: Carry,
        decisions: int | None = None,
    ) -> tuple[Result, Carry]:
        """Run on, up to the horizon or for so many decisions; gives back how to run on from there."""
        config, measure = self.config, self.measure
        trace = None if self.record is None else self.record(lane_map)

        def record(tick: Tick) -> tuple[Any, Any]:
            kept = None if trace is None else trace(tick)
            return kept, None if measure is None else measure.record(config, lane_map, tick)

        def decide(carry: Carry, _: None) -> tuple[Carry, Any]:
            state, memory, totals, stood, measured = carry
            now = jax.random.fold_in(key, state.step)
            command, memory = self.policy(config, lane_map, state, memory, now)
            after, (kept, records) = drive(
                config, self.traffic, lane_map, state, schedule, command, record, free=self._free
            )
            if measure is not None:
                measured = measure.update(config, lane_map, measured, records)
            totals, stood = count(config, totals, stood, state, after)
            new = Carry(after, memory, totals, stood, measured)
            if self.traffic.after_collision == "end":
                over = collided(state)
                new = jax.tree.map(lambda x, y: jnp.where(over, x, y), carry, new)
            return new, kept

        length = self.decisions if decisions is None else decisions
        carry, records = lax.scan(decide, carry, None, length=length)
        records = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), records)
        late = delayed(schedule, carry.state, config.time(carry.state.step))
        carry = carry._replace(totals=replace(carry.totals, waiting=jnp.sum(late, dtype=jnp.int32)))
        found = None if measure is None else measure.result(config, lane_map, carry.measured)
        return Result(carry.state, carry.totals, records, found), carry


def no_totals(state: State) -> Totals:
    """Totals at the start."""
    zero, nothing = jnp.int32(0), jnp.float32(0)
    return Totals(
        entered=jnp.sum(state.active, dtype=jnp.int32),
        left=zero, waiting=zero, full=zero, collided=zero, off_road=zero, wrong_way=zero, ran_red=zero,
        missed=zero, hard=zero, broken=zero, gridlock=jnp.bool_(False), deceleration=nothing,
        longest_wait=nothing, distance=nothing, time=nothing, travel_time=nothing,
    )  # fmt: skip


@jax.named_scope("count")
def count(config: Config, totals: Totals, stood: Stood, before: State, after: State) -> tuple[Totals, Stood]:
    """Totals after one decision more, all but `waiting`; and who has got on."""
    now = config.time(after.step)
    same = (before.vehicle == after.vehicle) & (before.entered == after.entered) & before.active
    entered = jnp.sum(after.queues.next - before.queues.next, dtype=jnp.int32)
    fresh = ~same & ((after.entered > before.entered) | (after.vehicle != before.vehicle))
    was = before.active | fresh  # on the road at some time of this decision
    left = was & ~after.active
    new = jnp.where(was, after.status & ~jnp.where(same, before.status, 0), 0)
    driven = after.distance - jnp.where(fresh, 0, before.distance)

    got_on = ~(same & after.active) | (after.distance - stood.at >= GOT_ON)
    stood = Stood(jnp.where(got_on, after.distance, stood.at), jnp.where(got_on, now, stood.since))

    def events(bit: Status) -> Int[Array, ""]:
        return jnp.sum((new & int(bit)) != 0, dtype=jnp.int32)

    totals = Totals(
        entered=totals.entered + entered,
        left=totals.left + jnp.sum(left, dtype=jnp.int32),
        waiting=totals.waiting,
        full=after.queues.full,
        collided=totals.collided + events(Status.COLLIDED),
        off_road=totals.off_road + events(Status.OFF_ROAD),
        wrong_way=totals.wrong_way + events(Status.WRONG_WAY),
        ran_red=totals.ran_red + events(Status.RED_LIGHT),
        missed=totals.missed + events(Status.MISSED_ROUTE),
        hard=totals.hard + events(Status.HARD_BRAKE),
        broken=totals.broken + events(Status.NOT_FINITE),
        gridlock=totals.gridlock | (now - stood.since > GRIDLOCK).any(),
        deceleration=jnp.maximum(totals.deceleration, jnp.max(jnp.where(after.active, -after.a, 0))),
        longest_wait=jnp.maximum(totals.longest_wait, jnp.max(jnp.where(after.active, after.waiting, 0))),
        distance=totals.distance + jnp.sum(jnp.where(was, driven, 0)),
        time=totals.time + config.decision_time * jnp.sum(after.active, dtype=jnp.float32),
        travel_time=totals.travel_time + jnp.sum(jnp.where(left, now - after.entered, 0)),
    )
    return totals, stood


# --- many worlds -------------------------------------------------------------------------------------


def use_all_cores(cores: int | None = None) -> int:
    """Make every CPU core a device of its own, so that a batch is shared among them.

    Call it before anything runs on the CPU backend; returns the number of devices.
    """
    if cores is None:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    jax.config.update("jax_num_cpu_devices", cores)
    return jax.local_device_count()


def enable_compilation_cache() -> None:
    """Keep compiled programs on disk, next to the maps' cache, unless JAX was told where already."""
    if jax.config.values["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", str(directory() / "xla"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)


def world_key(seed: int | Int[Array, ""]) -> Key[Array, ""]:
    """The key of a world. All that is random in it is drawn from this, by purpose, entity and step."""
    return jax.random.fold_in(jax.random.key(0), seed)


class Started(NamedTuple):
    """A world before its first decision, and all that `Rollout.go_on` needs beside the map."""

    schedule: Schedule
    key: Key[Array, ""]  # of the policy
    carry: Carry


def started(
    run: Rollout, lane_map: LaneMap, sampler: Callable[[Key[Array, ""]], Scenario], seed: int | Int[Array, ""]
) -> Started:
    """Draw the scenario of a seed and put it on the map."""
    scenario_key, policy_key = jax.random.split(world_key(seed))
    scenario = sampler(scenario_key)
    return Started(scenario.schedule, policy_key, run.begin(lane_map, scenario.start))


def one_world(
    run: Rollout, lane_map: LaneMap, sampler: Callable[[Key[Array, ""]], Scenario], seed: int | Int[Array, ""]
) -> Result:
    """The world of a seed from start to end; the same whether it runs alone or in a batch."""
    return run.go_on(lane_map, *started(run, lane_map, sampler, seed))[0]


def run_once() -> dict[str, Any] | None:
    """Compiler options for programs that run once per world, as `started`: compile fast, run slowly.

    Two programs that are to agree to the last bit need the same options.
    """
    if jax.default_backend() != "cpu":
        return None
    return {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}


def over_worlds(
    one: Callable[[LaneMap, Any], Any], mesh: Mesh, compiler_options: dict[str, Any] | None = None
) -> Any:
    """A function of the map and one world, jitted for the map and `[B, ...]` worlds shared among devices."""
    everywhere, worlds = PartitionSpec(), PartitionSpec("worlds")
    many = jax.shard_map(
        jax.vmap(one, in_axes=(None, 0)),
        mesh=mesh,
        in_specs=(everywhere, worlds),
        out_specs=worlds,
        check_vma=False,
    )
    here, there = (NamedSharding(mesh, spec) for spec in (everywhere, worlds))
    return jax.jit(many, in_shardings=(here, there), out_shardings=there, compiler_options=compiler_options)


class Worlds:
    """Many worlds of one shape: compiled once, run in chunks over all local devices.

    Args:
      run: the rollout.
      lane_map: where.
      sampler: scenario of a world from its key; of the same shapes for all keys.
      chunk: worlds per call; rounded up to a multiple of the number of devices.
      devices: all local devices by default.
    """

    def __init__(
        self,
        run: Rollout,
        lane_map: LaneMap,
        sampler: Callable[[Key[Array, ""]], Scenario],
        *,
        chunk: int = 64,
        devices: Sequence[Any] | None = None,
    ) -> None:
        devices = list(jax.local_devices() if devices is None else devices)
        if chunk < 1:
            raise ValueError(f"a chunk of {chunk} worlds? at least 1")
        self.chunk = -(-chunk // len(devices)) * len(devices)
        self.mesh = Mesh(np.array(devices), ("worlds",))
        self.lane_map = jax.device_put(lane_map, NamedSharding(self.mesh, PartitionSpec()))

        def start(lane_map: LaneMap, seed: Int[Array, ""]) -> Started:
            return started(run, lane_map, sampler, seed)

        def go_on(lane_map: LaneMap, world: Started) -> Result:
            return run.go_on(lane_map, *world)[0]

        self._start: Any = over_worlds(start, self.mesh, run_once())
        self._go_on: Any = over_worlds(go_on, self.mesh)

    def compile(self) -> Worlds:
        """Compile now; else the first chunk does."""
        enable_compilation_cache()
        seeds = jnp.zeros(self.chunk, jnp.int32)
        with ThreadPoolExecutor(1) as pool, _no_collections():
            start = self._start.lower(self.lane_map, seeds)
            compiled = pool.submit(start.compile)  # while the other is traced and compiled
            self._go_on = self._go_on.lower(self.lane_map, start.out_info).compile()
            self._start = compiled.result()
        return self

    def chunks(self, seeds: Sequence[int]) -> Iterator[tuple[Sequence[int], Result]]:
        """Chunk by chunk: its seeds, and the results `[len(seeds), ...]` on the host."""
        seeds = list(seeds)
        if not seeds:
            raise ValueError("no seeds; at least one is needed")
        if min(seeds) < 0 or max(seeds) >= 2**31:
            raise ValueError(f"seeds from {min(seeds)} to {max(seeds)}; they must be within 0 and 2^31 - 1")
        enable_compilation_cache()
        for first in range(0, len(seeds), self.chunk):
            some = seeds[first : first + self.chunk]
            padded = np.array(some + [some[-1]] * (self.chunk - len(some)), np.int32)
            result = jax.device_get(self._go_on(self.lane_map, self._start(self.lane_map, padded)))
            yield some, jax.tree.map(lambda x: x[: len(some)], result)  # noqa: B023

    def run_totals(self, seeds: Sequence[int]) -> Totals:
        """Totals of all worlds `[len(seeds)]`, on the host."""
        parts = [result.totals for _, result in self.chunks(seeds)]
        return jax.tree.map(lambda *x: np.concatenate(x), *parts)


@contextlib.contextmanager
def _no_collections() -> Iterator[None]:
    """Tracing makes millions of objects that stay: looking among them for garbage takes a third of it."""
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()


# --- branching, saving -------------------------------------------------------------------------------


def fork(tree: Any, n: int) -> Any:
    """`n` copies of a world (a state, or state, memory and totals) along a new first axis."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (n, *jnp.shape(x))), tree)


def save(path: str | Path, tree: Any) -> None:
    """Write any pytree of arrays (a state, a carry of `Rollout.go_on`) as .npz; never half a file."""
    found = jax.tree_util.tree_leaves_with_path(tree)
    leaves: dict[str, Any] = {jax.tree_util.keystr(where): np.asarray(x) for where, x in found}
    file = io.BytesIO()
    np.savez(file, **leaves)
    write_whole(path, file.getvalue())


def load(path: str | Path, like: Any) -> Any:
    """Read what `save` wrote into the structure of `like` (of the same shapes).

    Raises:
      ValueError: an array that is missing or of another shape or type.
    """
    with np.load(path) as file:
        stored = {name: file[name] for name in file.files}

    def read(where: Any, x: Any) -> Any:
        name = jax.tree_util.keystr(where)
        if name not in stored:
            raise ValueError(f"{path}: no array '{name}'")
        found = stored[name]
        if found.shape != jnp.shape(x) or found.dtype != jnp.result_type(x):
            raise ValueError(
                f"{path}: '{name}' is {found.dtype}{list(found.shape)}, "
                f"not {jnp.result_type(x)}{list(jnp.shape(x))}"
            )
        return jnp.asarray(found)

    return jax.tree_util.tree_map_with_path(read, like)
