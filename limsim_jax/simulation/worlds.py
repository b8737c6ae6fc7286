"""Many worlds on all local devices.

totals = Worlds(run, lane_map, sampler).run_totals(range(1000))
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Int

from limsim_jax.files import no_garbage_collection
from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.simulation.rollout import Carry, Kept, Measure, Result, Rollout, Seen, Started, drawn
from limsim_jax.simulation.totals import Totals
from limsim_jax.types import Scenario
from limsim_jax.xla import (
    begin_program,
    enable_compilation_cache,
    held_program,
    run_often,
    run_once,
    without_compilation_cache,
)


class Names(NamedTuple):
    """All that programs depend on beside shapes; None: not known."""

    sampling: str | None = None
    running: str | None = None
    measuring: str | None = None


LOOKED_AT = 20
"""Decisions of a replay before it is asked whether they are `enough`."""

Given = Callable[[Int[np.ndarray, " B"]], tuple[Any, Int[np.ndarray, " B"]]]
"""Of seeds: what a sampler gets instead of keys, and the seeds of the policies."""


def over_worlds(
    one: Callable[..., Any],
    mesh: Mesh,
    compiler_options: dict[str, Any] | None = None,
    *,
    each: int = 1,
    consumes: int | None = None,
) -> Any:
    """A function of one world for `[B, ...]` worlds.

    Its arguments are shared data and `each` more of a world. The batch is divided among the devices of the
    mesh. `consumes`: the arrays of this argument are used for those of the result, and are gone.
    `compiler_options`: those of `run_often` by default.
    """
    everywhere, worlds = PartitionSpec(), PartitionSpec("worlds")
    many = jax.shard_map(
        jax.vmap(one, in_axes=(None, *[0] * each)),
        mesh=mesh,
        in_specs=(everywhere, *[worlds] * each),
        out_specs=worlds,
        check_vma=False,
    )
    here, there = (NamedSharding(mesh, spec) for spec in (everywhere, worlds))
    return jax.jit(
        many, in_shardings=(here, *[there] * each), out_shardings=there,
        donate_argnums=() if consumes is None else (consumes,),
        compiler_options=compiler_options or run_often(),
    )  # fmt: skip


class Worlds:
    """Many worlds of one shape: compiled once, run in chunks over all local devices.

    The same programs run whole chunks, and worlds decision by decision for a closer look. One starts worlds,
    one drives them, and one measures what was driven: the last two compile at the same time, and policies
    share the last.

    Args:
      run: the rollout. What it records is there for `replay`.
      lane_map: where.
      sampler: scenario of a world from its key; of the same shapes for all keys.
      chunk: worlds per call; rounded up to a multiple of the number of devices.
      devices: all local devices by default.
      names: all that the sampler, the run and its measure depend on beside shapes. Programs are kept on disk
        by these names; where one is None, they are not.
      given: what the sampler gets instead of a key: of seeds `[B]`, arrays `[B, ...]` made on the host, and
        the seeds of the policies. None: keys are made from the seeds.
    """

    def __init__(
        self,
        run: Rollout,
        lane_map: LaneMap,
        sampler: Callable[[Any], Scenario],
        *,
        chunk: int = 64,
        devices: Sequence[Any] | None = None,
        names: Names | None = None,
        given: Given | None = None,
    ) -> None:
        devices = list(jax.local_devices() if devices is None else devices)
        if chunk < 1:
            raise ValueError(f"a chunk of {chunk} worlds? at least 1")
        self.chunk = -(-chunk // len(devices)) * len(devices)
        self.mesh = Mesh(np.array(devices), ("worlds",))
        self.lane_map = jax.device_put(lane_map, NamedSharding(self.mesh, PartitionSpec()))
        self.rollout = run

        self._given, self._sampler = given, sampler

        def start(lane_map: LaneMap, of: Any) -> tuple[Started, Any]:
            scenario, key = drawn(sampler, of) if given is None else drawn(lambda _: sampler(of[0]), of[1])
            carry, first = run.before(lane_map, scenario.start)
            return Started(scenario.schedule, key, carry), first

        def drive(shared: Any, world: tuple[Any, Any], carry: Carry) -> tuple[Carry, Kept]:
            return run.drive(shared[0], *world, carry, shared[1])

        def look(shared: Any, world: tuple[Any, Any, Seen], measured: Any) -> tuple[Any, Any]:
            lane_map, decisions, start = shared
            schedule, first, seen = world
            return run.look(lane_map, schedule, measured, seen, first, decisions, start)

        self.names = names = names or Names()
        self._place = f"{self.chunk} {_shapes(lane_map)}"
        self._start_name = _name(names.running, names.measuring, names.sampling, self._place)
        self._drive_name: str | None = None  # known with the shapes of worlds
        self._look_name: str | None = None
        self._start_jit: Any = over_worlds(start, self.mesh, run_once())
        self._drive_jit: Any = over_worlds(drive, self.mesh, each=2, consumes=2)
        self._look_jit: Any = over_worlds(look, self.mesh, each=2, consumes=2)
        self._start: Any = None
        self._drive: Any = None
        self._look: Any = None

    def measuring(self, measure: Measure, name: str | None = None) -> Worlds:
        """The same worlds, measured by something else; programs of their own.

        `name`: all that the measure depends on; None: programs are not kept on disk.
        """
        return Worlds(
            replace(self.rollout, measure=measure), self.lane_map, self._sampler, chunk=self.chunk,
            devices=list(self.mesh.devices.flat), names=self.names._replace(measuring=name),
            given=self._given,
        )  # fmt: skip

    def compile(self) -> Worlds:
        """Get the programs ready; otherwise the first chunk does."""
        if self._drive is not None:
            return self
        enable_compilation_cache()
        names, lane_map, number = self.names, self.lane_map, np.int32(0)
        seeds = self._inputs(np.zeros(self.chunk, np.int32))

        aside = contextlib.nullcontext() if self._start_name is None else without_compilation_cache()
        with ThreadPoolExecutor(3) as pool, no_garbage_collection(), aside:
            (worlds, first), start = begin_program(
                self._start_name, lambda: self._start_jit.lower(lane_map, seeds), pool
            )
            fixed, measured = (worlds.schedule, worlds.key), worlds.carry.measured
            carry = worlds.carry._replace(measured=None)
            place = self._place, _shapes((fixed, carry.state, measured, first))
            self._drive_name = _name(names.running, names.measuring, *place, _shapes(carry.memory))
            ends = str(self.rollout.traffic.after_collision == "end")  # then it is seen when a world is over
            self._look_name = None if measured is None else _name(names.measuring, ends, *place)
            list(pool.map(held_program, (self._drive_name, self._look_name)))  # from disk, both at a time
            (_, kept), drive = begin_program(
                self._drive_name, lambda: self._drive_jit.lower((lane_map, number), fixed, carry), pool
            )
            if measured is not None:
                seen = kept.tree._replace(trace=None)
                of = (lane_map, number, np.bool_(False)), (worlds.schedule, first, seen), measured
                _, look = begin_program(self._look_name, lambda: self._look_jit.lower(*of), pool)
                self._look = look()
            self._start, self._drive = start(), drive()
        return self

    def start(self, seeds: Sequence[int]) -> Started:
        """At most `chunk` worlds before their first decision, on the devices; the last one fills the chunk.

        Raises:
          ValueError: no seeds, too many, or one below 0 or beyond 2^31 - 1.
        """
        _check(seeds)
        if len(seeds) > self.chunk:
            raise ValueError(f"{len(seeds)} seeds at once; at most {self.chunk}")
        self.compile()
        padded = np.array([*seeds, *[seeds[-1]] * (self.chunk - len(seeds))], np.int32)
        worlds, first = self._start(self.lane_map, self._inputs(padded))
        if self._look is None or first is None:
            return worlds
        shared, of = (self.lane_map, np.int32(1), np.bool_(True)), (worlds.schedule, first, self._nothing[1])
        measured, _ = self._look(shared, of, worlds.carry.measured)
        return worlds._replace(carry=worlds.carry._replace(measured=measured))

    @cached_property
    def _nothing(self) -> tuple[Any, Seen]:
        """A start and what is seen, for calls without them."""
        first, seen = self._start.out_info[1], self._drive.out_info[1].tree._replace(trace=None)
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype, device=x.sharding), (first, seen))

    def _inputs(self, seeds: Int[np.ndarray, " B"]) -> Any:
        """What the worlds of some seeds start from."""
        return jnp.asarray(seeds) if self._given is None else self._given(seeds)

    def advance(self, worlds: Started, decisions: int) -> tuple[Started, Result]:
        """A chunk some decisions later, on the devices; the carry of `worlds` is used up.

        Records are those of the last decisions, at most `Rollout.kept`: `[W, kept, decision_every, ...]`.
        """
        self.compile()
        schedule, key, carry = worlds
        measured, carry, found, left = carry.measured, carry._replace(measured=None), None, decisions
        while True:
            some = min(left, self.rollout.kept(carry.state))
            carry, kept = self._drive((self.lane_map, np.int32(some)), (schedule, key), carry)
            seen = kept.tree
            if self._look is not None:
                shared = self.lane_map, np.int32(some), np.bool_(False)
                of = schedule, self._nothing[0], seen._replace(trace=None)
                measured, found = self._look(shared, of, measured)
            left -= some
            if not left:
                break
        result = Result(carry.state, carry.totals, seen.trace, found)
        return Started(schedule, key, carry._replace(measured=measured)), result

    def run(self, worlds: Started, decisions: int | None = None) -> Result:
        """Run worlds `[W, ...]` to the horizon, or for some decisions.

        The result is on the host."""

        def run(chunk: Started, _: int) -> Result:
            result = self.advance(chunk, self.rollout.decisions if decisions is None else decisions)[1]
            return jax.device_get(result._replace(trace=None))

        return self._in_chunks(worlds, run)

    def replay(
        self,
        worlds: Started,
        decisions: int | None = None,
        *,
        count: int | None = None,
        enough: Callable[[Any], bool] | None = None,
    ) -> Result:
        """Worlds `[W, ...]` to the horizon, or for some decisions.

        Records are those of every step, `[W, T, ...]`. All else is the same as in `run`, to the last bit.

        Args:
          worlds: at their start.
          decisions: None: to the horizon.
          count: of the first worlds of a chunk, whose records alone are kept; None: all.
          enough: given the next records of a chunk, `[W, t, ...]`; its run ends once it returns True.
        """

        def run(chunk: Started, some: int) -> Result:
            kept = some if count is None else min(count, some)
            result, records, left = None, [], self.rollout.decisions if decisions is None else decisions
            while left:
                more = min(left, LOOKED_AT, self.rollout.kept(worlds.carry.state))
                chunk, result = self.advance(chunk, more)
                trace = jax.tree.map(lambda x: np.asarray(x)[:kept, :more], result.trace)  # noqa: B023
                records.append(jax.tree.map(lambda x: x.reshape(len(x), -1, *x.shape[3:]), trace))
                left = 0 if enough is not None and enough(records[-1]) else left - more
            assert result is not None
            whole = jax.device_get(result._replace(trace=None))
            return whole._replace(trace=jax.tree.map(lambda *x: np.concatenate(x, 1), *records))

        return self._in_chunks(worlds, run)

    def _in_chunks(self, worlds: Started, run: Callable[[Started, int], Result]) -> Result:
        """Whole chunks, one after the other; the last world fills the last one."""
        there = NamedSharding(self.mesh, PartitionSpec("worlds"))
        count = len(worlds.carry.state.step)
        parts = []
        for first in range(0, count, self.chunk):
            some = min(self.chunk, count - first)
            which = np.minimum(np.arange(first, first + self.chunk), count - 1)
            chunk = worlds if count == self.chunk else jax.tree.map(lambda x: x[which], worlds)  # noqa: B023
            if not all(getattr(x, "sharding", None) == there for x in jax.tree.leaves(chunk)):
                chunk = jax.device_put(chunk, there)
            result = run(chunk, some)
            parts.append(jax.tree.map(lambda x: x[:some], result))  # noqa: B023
        return parts[0] if len(parts) == 1 else jax.tree.map(lambda *x: np.concatenate(x), *parts)

    def chunks(self, seeds: Sequence[int]) -> Iterator[tuple[Sequence[int], Result]]:
        """Chunk by chunk: its seeds, and the results `[len(seeds), ...]` on the host."""
        _check(seeds)
        for first in range(0, len(seeds), self.chunk):
            some = seeds[first : first + self.chunk]
            result = self.run(self.start(some))  # whole chunks, so that no array is copied
            yield some, jax.tree.map(lambda x: x[: len(some)], result)  # noqa: B023

    def run_totals(self, seeds: Sequence[int]) -> Totals:
        """Totals of all worlds `[len(seeds)]`, on the host."""
        parts = [result.totals for _, result in self.chunks(seeds)]
        return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def _name(*parts: str | None) -> str | None:
    """All that a program depends on; None if a part of it is not known."""
    return None if None in parts else " ".join(part for part in parts if part is not None)


def _shapes(tree: Any) -> str:
    """Shapes, types and static parts of a tree."""
    leaves, structure = jax.tree.flatten(tree)
    return f"{structure} {[(x.shape, str(x.dtype)) for x in leaves]}"


def _check(seeds: Sequence[int]) -> None:
    if len(seeds) == 0:
        raise ValueError("no seeds; at least one is needed")
    if min(seeds) < 0 or max(seeds) >= 2**31:
        raise ValueError(f"seeds from {min(seeds)} to {max(seeds)}; they must be within 0 and 2^31 - 1")
