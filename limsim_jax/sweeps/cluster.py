"""Sweeps on a Ray cluster: the same chunks, run by workers and kept by the process that asked for them.

    sweep_on_ray(functools.partial(read_and_build, "paper.toml"), range(10_000), "out", workers=8)

Every worker builds the episodes itself, from what the factory reads, so nothing large travels. A chunk whose
worker dies is given to another one, and a new worker takes the place of the dead one. Only the process that
calls writes files.

Ray is the extra `ray`; it is imported when a sweep starts.
"""

from __future__ import annotations

import collections
import contextlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from limsim_jax.sweeps.runner import Episodes, OnError, Progress, SweepSummary, sweep
from limsim_jax.sweeps.store import Entry, Outcome

RETRIES = 3
"""Times that a chunk is given to another worker before the sweep gives up."""


def sweep_on_ray(
    factory: Callable[[], Sequence[Episodes]],
    seeds: Sequence[int],
    out: str | Path,
    *,
    workers: int,
    address: str | None = None,
    resources: Mapping[str, float] | None = None,
    shard: tuple[int, int] | None = None,
    until_ci: tuple[float, str] | None = None,
    progress: Callable[[Progress], None] | None = None,
    on_error: OnError = "record",
    fresh: bool = False,
) -> SweepSummary:
    """`runner.sweep` with Ray workers.

    Args:
      factory: makes the episodes on a worker; picklable. Must make the same everywhere.
      seeds, out, shard, until_ci, progress, on_error, fresh: as of `runner.sweep`.
      workers: how many; each runs a chunk at a time.
      address: of the cluster, as for `ray.init`; without one a cluster on this machine for this call.
        A Ray that is initialised already is used as it is.
      resources: options of a worker for Ray: `num_cpus` (1 unless told), `num_gpus`, ...

    Raises:
      ValueError: as `runner.sweep`, or what the factory raises, or workers that are not alike.
      RuntimeError: workers died again and again over the same chunk.
    """
    try:
        import ray
    except ImportError:
        raise ValueError("a sweep on a cluster needs Ray: pip install 'limsim-jax[ray]'") from None
    if workers < 1:
        raise ValueError(f"{workers} workers? at least 1")
    own = not ray.is_initialized()
    if own:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # a cluster of ours reports nothing
        local = {"num_cpus": workers, "include_dashboard": False, "object_store_memory": 2**27}
        ray.init(address or "local", log_to_driver=False, **({} if address else local))
    pool = _Pool(factory, workers, {"num_cpus": 1, "max_restarts": 0, **(resources or {})})
    try:
        options: dict[str, Any] = {"shard": shard, "until_ci": until_ci, "progress": progress}
        options |= {"on_error": on_error, "fresh": fresh}
        return sweep(pool.describe(), seeds, out, run_chunks=pool.run_chunks, **options)
    finally:
        pool.close()
        if own:
            ray.shutdown()


@dataclass(frozen=True)
class _Remote:
    """Episodes that are elsewhere."""

    index: int  # in what the factory makes
    entry: Entry
    chunk: int

    @property
    def scenario(self) -> str:
        return self.entry.scenario

    @property
    def policy(self) -> str:
        return self.entry.policy

    @property
    def units(self) -> Mapping[str, str]:
        return self.entry.units

    def provenance(self) -> Mapping[str, Any]:
        return self.entry.provenance

    def compile(self) -> None:
        """Workers compile with their first chunk."""

    def run(self, seeds: Sequence[int]) -> Outcome:
        raise NotImplementedError("runs on workers")


class _Worker:
    """The actor."""

    def __init__(self) -> None:
        self.episodes: Sequence[Episodes] = ()
        self.compiled: set[int] = set()

    def start(self, factory: Callable[[], Sequence[Episodes]]) -> list[_Remote]:
        # not in __init__: what a method raises comes through as it is
        self.episodes = list(factory())
        return [
            _Remote(i, Entry(one.scenario, one.policy, dict(one.provenance()), dict(one.units)), one.chunk)
            for i, one in enumerate(self.episodes)
        ]

    def run(self, index: int, seeds: Sequence[int]) -> Outcome:
        one = self.episodes[index]
        if index not in self.compiled:
            one.compile()
            self.compiled.add(index)
        return one.run(seeds)


class _Job(NamedTuple):
    """What a worker does."""

    worker: Any
    seeds: Sequence[int]  # none: it starts
    deaths: int  # of workers before it over the same


class _Pool:
    """Workers, made anew when they die."""

    def __init__(
        self, factory: Callable[[], Sequence[Episodes]], workers: int, options: Mapping[str, Any]
    ) -> None:
        import ray

        self.ray: Any = ray
        self.factory = factory
        self.workers = workers
        self.actor: Any = ray.remote(_Worker).options(**options)
        self.made: list[_Remote] = []
        self.jobs: dict[Any, _Job] = {}  # by what we wait for
        self.idle: list[Any] = []
        self.waiting: collections.deque[tuple[Sequence[int], int]] = collections.deque()

    def describe(self) -> list[_Remote]:
        """What the factory makes, as the first worker has it; the others start once it has."""
        self._hire()
        while not self.made:
            self._wait()
        for _ in range(self.workers - 1):
            self._hire()
        return self.made

    def run_chunks(self, episodes: Episodes, chunks: Iterable[Sequence[int]]) -> Iterator[Outcome]:
        """Back end of `runner.sweep`."""
        assert isinstance(episodes, _Remote)
        self.waiting.extend((seeds, 0) for seeds in chunks)
        self._assign(episodes)
        while any(job.seeds for job in self.jobs.values()) or self.waiting:
            outcome = self._wait()
            self._assign(episodes)  # before the outcome is written: no worker waits for that
            if outcome is not None:
                yield outcome

    def _assign(self, episodes: _Remote) -> None:
        while self.waiting and self.idle:
            worker, (seeds, deaths) = self.idle.pop(), self.waiting.popleft()
            self.jobs[worker.run.remote(episodes.index, seeds)] = _Job(worker, seeds, deaths)

    def close(self) -> None:
        """Let go of all workers, whatever they do."""
        for worker in [*self.idle, *(job.worker for job in self.jobs.values())]:
            self._dismiss(worker)

    def _hire(self, deaths: int = 0) -> None:
        worker = self.actor.remote()
        self.jobs[worker.start.remote(self.factory)] = _Job(worker, (), deaths)

    def _dismiss(self, worker: Any) -> None:
        with contextlib.suppress(Exception):  # dead already, or the cluster is gone
            self.ray.kill(worker)

    def _wait(self) -> Outcome | None:
        """Until a worker has started, finished its chunk (given back), or died."""
        (ready,), _ = self.ray.wait(list(self.jobs), num_returns=1)
        job = self.jobs.pop(ready)
        try:
            result = self.ray.get(ready)
        except self.ray.exceptions.RayTaskError as error:  # our code raised it; another worker would, too
            raise error.cause from error
        except self.ray.exceptions.RayError as error:  # the worker, its machine or its memory is gone
            self._dismiss(job.worker)
            if job.deaths >= RETRIES:
                what = f"the chunk of seed {job.seeds[0]}" if job.seeds else "their start"
                raise RuntimeError(f"{job.deaths + 1} workers died over {what}: {_line(error)}") from error
            self._hire(0 if job.seeds else job.deaths + 1)
            if job.seeds:
                self.waiting.appendleft((job.seeds, job.deaths + 1))
            return None
        self.idle.append(job.worker)
        if job.seeds:
            return result
        self.made = self.made or result
        for mine, other in zip(self.made, result, strict=True):
            if difference := mine.entry.difference(other.entry.provenance):
                raise ValueError(f"workers are not alike: {mine.entry.label}: {difference}")
        return None


def _line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__
