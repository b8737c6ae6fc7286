"""Many worlds on all local devices.

totals = Worlds(run, lane_map, sampler).run_totals(range(1000))
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int

from limsim_jax.files import no_garbage_collection
from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.simulation.rollout import KEPT, Measure, Result, Rollout, Started, started
from limsim_jax.simulation.totals import Totals
from limsim_jax.types import Scenario
from limsim_jax.xla import (
    enable_compilation_cache,
    held_program,
    hold_program,
    keep_program,
    run_often,
    run_once,
    shared_program,
    without_compilation_cache,
)

Given = Callable[[Int[np.ndarray, " B"]], tuple[Any, Int[np.ndarray, " B"]]]
"""Of seeds: what a sampler gets instead of keys, and the seeds of the policies."""


def over_worlds(
    one: Callable[[Any, Any], Any],
    mesh: Mesh,
    compiler_options: dict[str, Any] | None = None,
    *,
    consumes: bool = False,
) -> Any:
    """A function of shared data and one world, for `[B, ...]` worlds.

    The batch is divided among the devices of the mesh. `consumes`: the arrays of the worlds are used for
    those of the result, and are gone. `compiler_options`: those of `run_often` by default.
    """
    everywhere, worlds = PartitionSpec(), PartitionSpec("worlds")
    many = jax.shard_map(
        jax.vmap(one, in_axes=(None, 0)),
        mesh=mesh,
        in_specs=(everywhere, worlds),
        out_specs=worlds,
        check_vma=False,
    )
    here, there = (NamedSharding(mesh, spec) for spec in (everywhere, worlds))
    return jax.jit(
        many, in_shardings=(here, there), out_shardings=there, donate_argnums=(1,) if consumes else (),
        compiler_options=compiler_options or run_often(),
    )  # fmt: skip


class Worlds:
    """Many worlds of one shape: compiled once, run in chunks over all local devices.

    The same program runs whole chunks, and worlds decision by decision for a closer look.

    Args:
      run: the rollout. What it records is there for `replay`.
      lane_map: where.
      sampler: scenario of a world from its key; of the same shapes for all keys.
      chunk: worlds per call; rounded up to a multiple of the number of devices.
      devices: all local devices by default.
      names: all that the sampler and the run depend on beside shapes. Programs are kept on disk by these
        names; where one is None, they are not.
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
        names: tuple[str | None, str | None] = (None, None),
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

        def start(lane_map: LaneMap, of: Any) -> Started:
            if given is None:
                return started(run, lane_map, sampler, of)
            values, seed = of
            return started(run, lane_map, lambda _: sampler(values), seed)

        def advance(shared: tuple[LaneMap, Int[Array, ""]], world: Started) -> tuple[Started, Result]:
            lane_map, decisions = shared
            result, carry = run.advance(lane_map, *world, decisions)
            return world._replace(carry=carry), result

        self.names = sampling, running = names
        self._advance_name = None if running is None else f"{running} {self.chunk} {_shapes(lane_map)}"
        self._start_name = None if sampling is None or running is None else f"{self._advance_name} {sampling}"
        self._start_jit: Any = over_worlds(start, self.mesh, run_once())
        self._advance_jit: Any = over_worlds(advance, self.mesh, consumes=True)
        self._start: Any = None
        self._advance: Any = None

    def measuring(self, measure: Measure, name: str | None = None) -> Worlds:
        """The same worlds, measured by something else; a program of their own.

        `name`: all that the measure depends on; None: the program is not kept on disk.
        """
        sampling, running = self.names
        running = None if running is None or name is None else f"{running} measured by {name}"
        return Worlds(
            replace(self.rollout, measure=measure), self.lane_map, self._sampler, chunk=self.chunk,
            devices=list(self.mesh.devices.flat), names=(sampling, running), given=self._given,
        )  # fmt: skip

    def compile(self) -> Worlds:
        """Get the programs ready; otherwise the first chunk does."""
        if self._advance is not None:
            return self
        enable_compilation_cache()
        seeds = self._inputs(np.zeros(self.chunk, np.int32))

        aside = contextlib.nullcontext() if self._advance_name is None else without_compilation_cache()
        with ThreadPoolExecutor(1) as pool, no_garbage_collection(), aside:
            start = held_program(self._start_name)
            if start is None:
                lowered = self._start_jit.lower(self.lane_map, seeds)
                kept = pool.submit(lambda: keep_program(self._start_name, lowered.compile()))
                worlds = lowered.out_info  # it compiles while the other program is traced
            else:
                kept, worlds = None, start.out_info
            name = None if self._advance_name is None else f"{self._advance_name} {_shapes(worlds)}"
            shared = self.lane_map, np.int32(0)
            advance = shared_program(name, lambda: self._advance_jit.lower(shared, worlds).compile())
            self._start = start if kept is None else hold_program(self._start_name, kept.result())
            self._advance = advance
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
        return self._start(self.lane_map, self._inputs(padded))

    def _inputs(self, seeds: Int[np.ndarray, " B"]) -> Any:
        """What the worlds of some seeds start from."""
        return jnp.asarray(seeds) if self._given is None else self._given(seeds)

    def advance(self, worlds: Started, decisions: int) -> tuple[Started, Result]:
        """A chunk some decisions later, on the devices; `worlds` themselves are used up.

        Records of the result are those of at most `KEPT` decisions.
        """
        self.compile()
        return self._advance((self.lane_map, np.int32(decisions)), worlds)

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
                more = min(left, KEPT)
                chunk, result = self.advance(chunk, more)
                trace = jax.device_get(result.trace)
                steps = more * self.rollout.config.decision_every
                records.append(jax.tree.map(lambda x: x[:kept, :steps].copy(), trace))  # noqa: B023
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


def _shapes(tree: Any) -> str:
    """Shapes, types and static parts of a tree."""
    leaves, structure = jax.tree.flatten(tree)
    return f"{structure} {[(x.shape, str(x.dtype)) for x in leaves]}"


def _check(seeds: Sequence[int]) -> None:
    if len(seeds) == 0:
        raise ValueError("no seeds; at least one is needed")
    if min(seeds) < 0 or max(seeds) >= 2**31:
        raise ValueError(f"seeds from {min(seeds)} to {max(seeds)}; they must be within 0 and 2^31 - 1")
