"""Many worlds on all local devices.

totals = Worlds(run, lane_map, sampler).run_totals(range(1000))
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int, Key

from limsim_jax.files import no_garbage_collection
from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.simulation.rollout import Result, Rollout, Started, started
from limsim_jax.simulation.totals import Totals
from limsim_jax.types import Scenario
from limsim_jax.xla import enable_compilation_cache, run_once


def over_worlds(
    one: Callable[[LaneMap, Any], Any], mesh: Mesh, compiler_options: dict[str, Any] | None = None
) -> Any:
    """A function of one world, jitted for `[B, ...]` worlds.

    The batch is divided among the devices of the mesh."""
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

        def advance(lane_map: LaneMap, world: Started) -> Result:
            return run.advance(lane_map, *world)[0]

        self._start: Any = over_worlds(start, self.mesh, run_once())
        self._advance: Any = over_worlds(advance, self.mesh)

    def compile(self) -> Worlds:
        """Compile now; otherwise the first chunk does."""
        enable_compilation_cache()
        seeds = jnp.zeros(self.chunk, jnp.int32)
        with ThreadPoolExecutor(1) as pool, no_garbage_collection():
            start = self._start.lower(self.lane_map, seeds)
            compiled = pool.submit(start.compile)  # while the other is traced and compiled
            self._advance = self._advance.lower(self.lane_map, start.out_info).compile()
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
            result = jax.device_get(self._advance(self.lane_map, self._start(self.lane_map, padded)))
            yield some, jax.tree.map(lambda x: x[: len(some)], result)  # noqa: B023

    def run_totals(self, seeds: Sequence[int]) -> Totals:
        """Totals of all worlds `[len(seeds)]`, on the host."""
        parts = [result.totals for _, result in self.chunks(seeds)]
        return jax.tree.map(lambda *x: np.concatenate(x), *parts)
