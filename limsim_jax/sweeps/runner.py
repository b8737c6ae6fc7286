"""The sweep: chunks of seeds through scenarios and policies, kept as they are finished.

A sweep may be killed at any moment. Run again, it takes up the worlds that are missing; run with more seeds,
it adds them; run as shards i/n, at the same time or not, it does a part of the chunks. What is on disk in
the end is the same in every case, because a world depends on its seed alone.

Stopping early (`until_ci`): an interval that is looked at often, with the right to stop each time, misleads
more often than its level says. The sweep looks after `LOOKS_FROM` worlds and at every doubling from there
to the last seed. It splits the error evenly over these K looks (Bonferroni): each uses the level 1 - 0.05 /
K. With 95 % none of the K intervals misses the truth, wherever the sweep stops. That holds as far as the
interval keeps its level: Wilson's does on average over shares, the bootstrap's for large samples. The
summary has this wider interval. A plain 95 % interval of the same worlds, as in tables, is narrower and
somewhat optimistic. The estimate is drawn a little towards values with little spread (shares near 0 or 1):
a sweep stops early when it happens to see few failures. A look counts the first worlds in the order of the
seeds, whatever else is on disk, so that an interrupted sweep stops at the same place.
"""

from __future__ import annotations

import difflib
import itertools
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, get_args

import numpy as np

from limsim_jax.metrics.answers import METERED
from limsim_jax.statistics import Interval, bootstrap, wilson
from limsim_jax.sweeps.answers import check_seeds, recall
from limsim_jax.sweeps.store import (
    NOT_COMPARED,
    DamagedError,
    Entry,
    Outcome,
    Results,
    ResultsError,
    Shards,
    register,
)

LOOKS_FROM = 128
"""Worlds, rounded up to whole chunks, before the first look at an interval."""

COMPILERS = 3
"""Scenarios that compile at the same time; of those that share a program, all but one wait."""

LEVEL = 0.95
"""Probability that no look at an interval misses."""


class Episodes(Protocol):
    """Worlds of one scenario under one policy."""

    @property
    def scenario(self) -> str:
        """Name of letters, digits, `_` and `-`."""
        ...

    @property
    def policy(self) -> str:
        """Name of letters, digits, `_` and `-`."""
        ...

    @property
    def chunk(self) -> int:
        """Worlds per call, at most."""
        ...

    @property
    def units(self) -> Mapping[str, str]:
        """What each metric means; "1 if ..." marks a share."""
        ...

    def provenance(self) -> Mapping[str, Any]:
        """How rows come about, as JSON. All but `store.NOT_COMPARED` must agree within a directory."""
        ...

    def compile(self) -> None:
        """Get ready; may take a minute."""
        ...

    def run(self, seeds: Sequence[int]) -> Outcome:
        """1 to `chunk` worlds, in the order of their seeds."""
        ...


class Progress(NamedTuple):
    """How far a sweep is with one scenario and policy; what was on disk before counts."""

    scenario: str
    policy: str
    stage: str  # "compiling", "running" or "finished"
    done: int  # worlds
    wanted: int  # worlds; fewer may do with `until_ci`
    km: float  # driven by all vehicles; where that is not measured, by the ego
    contacts: float  # of the ego, so far
    elapsed: float  # s
    eta: float  # s; NaN as long as unknown


class Part(NamedTuple):
    """What a sweep did for one scenario and policy."""

    scenario: str
    policy: str
    wanted: int  # worlds
    done: int  # of them, on disk now
    ran: int  # of them, run now
    elapsed: float  # s
    reached: bool  # the interval was narrow enough
    interval: Interval | None  # at the last look, at its level


class SweepSummary(NamedTuple):
    """What a sweep did."""

    path: Path
    parts: tuple[Part, ...]
    damaged: tuple[str, ...]  # files that were found damaged, set aside as *.damaged and replaced


RunChunks = Callable[[Episodes, Iterable[Sequence[int]]], Iterator[Outcome]]
"""Back end: runs chunks of seeds, and gives outcomes in any order."""


def run_here(episodes: Episodes, chunks: Iterable[Sequence[int]]) -> Iterator[Outcome]:
    """Run chunks in this process."""
    return (episodes.run(chunk) for chunk in chunks)


OnError = Literal["record", "stop"]


class PolicyFailedError(ValueError):
    """A policy that failed, in one line: in which world, when and why."""


def _stopping(run_chunks: RunChunks) -> RunChunks:
    """The same back end; it raises `PolicyFailedError` where the policy fails."""

    def run(episodes: Episodes, chunks: Iterable[Sequence[int]]) -> Iterator[Outcome]:
        for outcome in run_chunks(episodes, chunks):
            moments = outcome.moments
            for k, kind in enumerate(moments.get("kind", ())):
                if kind == "policy_failed":
                    raise PolicyFailedError(
                        f"{episodes.scenario}/{episodes.policy}: the policy failed in seed "
                        f"{moments['seed'][k]} at {moments['time'][k]:.1f} s: {moments['reason'][k]}; "
                        "finished chunks are kept"
                    )
            yield outcome

    return run


def sweep(
    episodes: Sequence[Episodes],
    seeds: Sequence[int],
    out: str | Path,
    *,
    shard: tuple[int, int] | None = None,
    until_ci: tuple[float, str] | None = None,
    progress: Callable[[Progress], None] | None = None,
    on_error: OnError = "record",
    fresh: bool = False,
    run_chunks: RunChunks = run_here,
) -> SweepSummary:
    """Run all worlds that are not on disk yet.

    Args:
      episodes: scenarios and policies, in turn.
      seeds: which worlds of each; within 0 and 2^31 - 1.
      out: results directory; made, or gone on with.
      shard: (i, n) with 0 <= i < n: every n-th chunk, from the i-th on. All n together are the whole.
      until_ci: (half-width, metric): stop once the interval of the metric is so narrow; see the module.
      progress: is told before and after every chunk.
      on_error: "record" keeps an episode in which the policy fails as a failed one; "stop" ends the sweep
        there, without its chunk.
      fresh: remove what `out` holds of these scenarios and policies.
      run_chunks: back end.

    Raises:
      PolicyFailedError: the policy has failed, with `on_error="stop"`.
      ValueError: seeds, shard or until_ci that make no sense, before anything is compiled.
      ResultsError: `out` cannot be written or holds other results. What is finished stays.
    """
    out = Path(out)
    seeds = _checked_seeds(seeds)
    _check(episodes, shard, until_ci, fresh)
    if on_error not in get_args(OnError):
        raise ValueError(f"on_error: '{on_error}'; known are {', '.join(get_args(OnError))}")
    for one in episodes:
        check_seeds(one, seeds)
    entries = [_entry(one) for one in episodes]
    register(out, entries, fresh=fresh)
    damaged: list[str] = []
    jobs: list[tuple[Episodes, Shards, list[int], set[int], _Teller]] = []
    for one, entry in zip(episodes, entries, strict=True):
        mine = _of_shard(seeds, one.chunk, shard)
        tell, shards = _Teller(one, len(mine), progress), Shards(out, entry)
        jobs.append((one, shards, mine, _missing(shards, mine, tell, damaged), tell))
    run_chunks = _stopping(run_chunks) if on_error == "stop" else run_chunks
    with ThreadPoolExecutor(COMPILERS) as pool:
        # The next scenario compiles while this one runs; but one that may stop early may need no more worlds.
        ready = [
            pool.submit(one.compile).result if missing and until_ci is None else one.compile
            for one, _, _, missing, _ in jobs
        ]
        try:
            parts = [
                _sweep_one(*job, compiled, until_ci, run_chunks)
                for job, compiled in zip(jobs, ready, strict=True)
            ]
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
    register(out, entries)  # once more: another sweep may have written the index at the same moment
    return SweepSummary(out, tuple(parts), tuple(damaged))


def _of_shard(seeds: list[int], chunk: int, shard: tuple[int, int] | None) -> list[int]:
    if shard is None:
        return seeds
    i, n = shard
    return [
        seed for first in range(i * chunk, len(seeds), n * chunk) for seed in seeds[first : first + chunk]
    ]


def _missing(shards: Shards, seeds: list[int], tell: _Teller, damaged: list[str]) -> set[int]:
    """Seeds that are not on disk; damaged files are set aside."""
    shards.clean()
    wanted, missing = frozenset(seeds), set(seeds)
    for chunk in shards.chunks():
        if isinstance(chunk, DamagedError):
            damaged.append(str(chunk))
            shards.set_aside(chunk)
            continue
        found = chunk.episodes.column("seed").to_pylist()
        missing.difference_update(found)
        mine = np.array([seed in wanted for seed in found], bool)
        worlds = len({seed for seed in found if seed in wanted})
        tell.count(worlds, {name: chunk.column(name)[mine] for name in _Teller.SUMS})
    return missing


def _sweep_one(
    episodes: Episodes,
    shards: Shards,
    seeds: list[int],
    missing: set[int],
    tell: _Teller,
    compiled: Callable[[], None],
    until_ci: tuple[float, str] | None,
    run_chunks: RunChunks,
) -> Part:
    size = episodes.chunk
    looks = _looks(len(seeds), size) if until_ci else [len(seeds)]
    interval, reached, waited, ran = None, False, False, 0
    tell.start()
    for first, last in zip([0, *looks], looks, strict=False):
        todo = [seed for seed in seeds[first:last] if seed in missing]
        if todo and not waited:
            tell("compiling")
            compiled()
            waited = True
            tell.begin()
        if todo:
            tell("running")
        chunks = [todo[i : i + size] for i in range(0, len(todo), size)]
        due = set(todo)
        for outcome in run_chunks(episodes, chunks):
            shards.write(outcome)
            due.difference_update(outcome.seeds.tolist())
            worlds = len(np.unique(outcome.seeds))
            ran += worlds
            tell.count(worlds, outcome.metrics, fresh=True)
            tell("running")
        if due:
            raise RuntimeError(f"{shards.entry.label}: seed {min(due)} was asked for and never came back")
        if until_ci:
            half_width, metric = until_ci
            values = shards.values(metric)
            share = _is_share(episodes.units[metric])
            interval = _interval([values[seed] for seed in seeds[:last]], share, 1 - (1 - LEVEL) / len(looks))
            reached = (interval.high - interval.low) / 2 <= half_width
            if reached:
                break
    tell("finished")
    names = episodes.scenario, episodes.policy
    return Part(*names, len(seeds), tell.done, ran, tell.elapsed, reached, interval)


class _Teller:
    """Keeps the figures of `Progress`."""

    SUMS = ("traffic_vehicle_km", "distance", "contacts")

    def __init__(self, episodes: Episodes, wanted: int, progress: Callable[[Progress], None] | None) -> None:
        self.names = episodes.scenario, episodes.policy
        self.wanted = wanted
        self.progress = progress
        self.done = self.fresh = 0
        self.km = self.contacts = 0.0
        self.start()

    def start(self) -> None:
        """It is the turn of this scenario."""
        self.started = self.began = time.monotonic()

    def begin(self) -> None:
        """From here on worlds run: the ETA leaves out what it took to compile."""
        self.began = time.monotonic()

    def count(self, worlds: int, metrics: Mapping[str, Any], *, fresh: bool = False) -> None:
        km, metres, contacts = (
            float(np.nansum(metrics[name])) if name in metrics else 0.0 for name in self.SUMS
        )
        if self.SUMS[0] in metrics and np.size(metrics[self.SUMS[0]]):
            km *= worlds / np.size(metrics[self.SUMS[0]])  # each ego of a world has a row with that number
        self.done += worlds
        self.fresh += worlds if fresh else 0
        self.km += km or metres / 1000
        self.contacts += contacts

    @property
    def elapsed(self) -> float:
        return time.monotonic() - self.started

    def __call__(self, stage: str) -> None:
        if self.progress is None:
            return
        left = self.wanted - self.done
        running = time.monotonic() - self.began
        eta = running / self.fresh * left if self.fresh else math.nan
        if stage == "finished" or not left:
            eta = 0.0
        now = (self.done, self.wanted, self.km, self.contacts, self.elapsed, eta)
        self.progress(Progress(*self.names, stage, *now))


# --- stopping early ------------------------------------------------------------------------------------


def _looks(seeds: int, chunk: int) -> list[int]:
    """Numbers of worlds at which a sweep may stop: doubling, whole chunks; the last is all."""
    first = -(-LOOKS_FROM // chunk) * chunk
    found = []
    while first < seeds:
        found.append(first)
        first *= 2
    return [*found, seeds]


def _is_share(unit: str) -> bool:
    return unit.startswith("1 if")


def _interval(values: Sequence[float], share: bool, level: float) -> Interval:
    """Of the values that were measured; without bounds where fewer than two were."""
    x = np.array(values)
    x = x[np.isfinite(x)]
    if x.size < 2:
        return Interval(math.nan, -math.inf, math.inf)
    share = share and bool(np.isin(x, (0.0, 1.0)).all())  # a mean over several egos is no share
    return wilson(int(np.sum(x > 0.5)), x.size, level) if share else bootstrap(x, level=level)


# --- bad input -----------------------------------------------------------------------------------------


def _checked_seeds(seeds: Sequence[int]) -> list[int]:
    if len(seeds) == 0:
        raise ValueError("no seeds; at least one is needed")
    if min(seeds) < 0 or max(seeds) >= 2**31:  # before a long range becomes a list
        raise ValueError(f"seeds from {min(seeds)} to {max(seeds)}; they must be within 0 and 2^31 - 1")
    found = [int(seed) for seed in seeds]
    if len(set(found)) < len(found):
        twice = next(a for a, b in itertools.pairwise(sorted(found)) if a == b)
        raise ValueError(f"seed {twice} is there twice; every world counts once")
    return found


def _check(
    episodes: Sequence[Episodes],
    shard: tuple[int, int] | None,
    until_ci: tuple[float, str] | None,
    fresh: bool,
) -> None:
    if not episodes:
        raise ValueError("no scenario to run")
    names = [f"{one.scenario}/{one.policy}" for one in episodes]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{name} is there twice; give every scenario a name of its own")
    if shard is not None and not (shard[1] >= 1 and 0 <= shard[0] < shard[1]):
        raise ValueError(f"shard {shard[0]}/{shard[1]}: the first must be from 0 to the second less 1")
    if fresh and shard is not None:
        raise ValueError("fresh would remove the results of other shards; use another directory")
    if until_ci is None:
        return
    if shard is not None:
        raise ValueError("until_ci looks at all worlds, a shard has only some; use one of the two")
    half_width, metric = until_ci
    for one in episodes:
        if metric not in one.units:
            raise ValueError(
                f"{one.scenario}/{one.policy}: no metric '{metric}'{_similar(metric, one.units)}"
            )
        limit = 0.5 if _is_share(one.units[metric]) else math.inf
        if not 0 < half_width < limit:
            right = "between 0 and 0.5" if limit == 0.5 else "above 0"
            raise ValueError(f"a half-width of {half_width} for '{metric}'? it must be {right}")


def _similar(name: str, names: Iterable[str]) -> str:
    found = difflib.get_close_matches(name, list(names), 1)
    return f"; did you mean '{found[0]}'?" if found else ""


def _entry(episodes: Episodes) -> Entry:
    provenance = {**episodes.provenance(), "chunk": episodes.chunk}
    return Entry(episodes.scenario, episodes.policy, provenance, episodes.units)


# --- verification --------------------------------------------------------------------------------------


class Mismatch(NamedTuple):
    """A stored world that does not come out again as it was."""

    scenario: str
    policy: str
    seed: int
    what: str  # "digest", and metrics that differ


class VerifyReport(NamedTuple):
    """Stored worlds that ran again, and how they differ."""

    checked: int  # worlds
    mismatches: tuple[Mismatch, ...]
    differences: tuple[str, ...]  # of the provenance between then and now: reasons why worlds may differ

    @property
    def ok(self) -> bool:
        """All came out as they were."""
        return not self.mismatches


def verify(results: Results, episodes: Sequence[Episodes], sample: int = 16, seed: int = 0) -> VerifyReport:
    """Run a random sample of stored worlds again and compare.

    Args:
      results: what is stored.
      episodes: those to check, as made from the experiment now.
      sample: worlds of each; all where there are fewer.
      seed: of the choice.

    Raises:
      ValueError: no worlds to check, or of something that the results do not hold.
    """
    if sample < 1:
        raise ValueError(f"a sample of {sample} worlds? at least 1")
    if not episodes:
        raise ValueError("no scenario to verify")
    scenarios, policies = (results.episodes.column(name).to_pylist() for name in ("scenario", "policy"))
    names = np.array([f"{a}/{b}" for a, b in zip(scenarios, policies, strict=True)])
    rng = np.random.default_rng(seed)
    checked, mismatches, differences = 0, [], []
    for one in episodes:
        entry = _entry(one)
        rows = np.flatnonzero(names == entry.label)
        if not rows.size:
            raise ResultsError(
                f"{results.path}: holds no worlds of {entry.label}; it has {', '.join(sorted(set(names)))}"
            )
        stored = results.provenance[one.scenario, one.policy]
        if difference := entry.difference(stored, NOT_COMPARED) or entry.difference(stored, frozenset()):
            differences.append(f"{entry.label}: {difference}")
        rows = np.sort(rng.permutation(rows)[:sample])
        one.compile()
        for first in range(0, rows.size, one.chunk):
            some = results.episodes.take(rows[first : first + one.chunk])
            seeds = list(dict.fromkeys(some.column("seed").to_pylist()))
            recall(one, results.path, seeds)
            outcome = one.run(seeds)
            places = {
                pair: i
                for i, pair in enumerate(zip(outcome.seeds.tolist(), outcome.egos.tolist(), strict=True))
            }
            for row in some.to_pylist():
                i = places[row["seed"], row["ego"]]
                what = ["digest"] * (row["digest"] != int(outcome.digest[i]))
                for name, values in outcome.metrics.items():
                    if name in METERED:
                        continue
                    value = None if np.isnan(values[i]) else float(values[i])
                    what += [name] * (row.get(name) != value)
                if what:
                    mismatches.append(Mismatch(one.scenario, one.policy, row["seed"], _shortened(what)))
                checked += 1
    return VerifyReport(checked, tuple(mismatches), tuple(differences))


def _shortened(names: Sequence[str], most: int = 5) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
