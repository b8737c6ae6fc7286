"""Exposure of an experiment: how long its egos are in each cell of their domain, seed by seed."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from limsim_jax.metrics.domain import Domain, places_of, possible
from limsim_jax.metrics.exposure import CountExposure, Sparse, joined, over, sparse
from limsim_jax.simulation.trace import Trace
from limsim_jax.simulation.worlds import Worlds
from limsim_jax.statistics import Interval
from limsim_jax.sweeps.coverage import Choice, Unseen, greedy_cover, growth, unseen
from limsim_jax.sweeps.episode import Episodes, source_hash
from limsim_jax.sweeps.identity import describe_program

Floats = NDArray[np.float64]

RARE = 3
"""Worlds, at most, that a rare cell is reached in. Chosen: so few seeds can be looked at one by one."""

RESAMPLES = 2000
"""Of worlds, for intervals of shares."""

LEAST_WORLDS = 8
"""Worlds below which a share has no interval, as it comes from their spread."""

WAYS = 2
"""Dimensions at a time of tables and pictures: pairs."""

Cell = Mapping[str, str | float]
"""Bins by dimension, by name or by a number within."""


class Visit(NamedTuple):
    """A world that reaches a cell."""

    seed: int
    ego: int
    time: float  # s since the start, first step there
    seconds: float  # there


class Reached(NamedTuple):
    """A cell, and a world that reaches it."""

    cell: dict[str, str]
    seed: int
    time: float  # s since the start


@dataclass(frozen=True, eq=False)
class Exposure:
    """Time of egos in the cells of a domain.

    Attributes:
      scenario, policy: names.
      seeds: of the worlds, W.
      egos: of each world.
      dt: s, physics step.
      domain: the cells, C.
      possible: `[C]`, cells that can be reached on the map.
      found: cells that were reached, by world.
      more: of further seeds that looked for cells not covered; None: none have.
    """

    scenario: str
    policy: str
    seeds: tuple[int, ...]
    egos: int
    dt: float
    domain: Domain
    possible: NDArray[np.bool_] = field(repr=False)
    found: Sparse = field(repr=False)
    more: Exposure | None = field(default=None, repr=False)
    again: Callable[[int, int], Any] | None = field(default=None, repr=False)

    # --- time

    @cached_property
    def seconds(self) -> Floats:
        """Time in each cell, s, an axis per dimension."""
        steps = np.bincount(self.found.cell, self.found.steps, self.domain.size)
        return (steps * self.dt).astype(np.float64).reshape(self.domain.shape)

    @property
    def total(self) -> float:
        """Time of all egos, s."""
        return float(self.found.steps.sum() * self.dt)

    @cached_property
    def worlds(self) -> NDArray[np.int64]:
        """Number of worlds that reach each cell, an axis per dimension."""
        _, cell = self._incidences
        return np.bincount(cell, minlength=self.domain.size).reshape(self.domain.shape)

    @cached_property
    def _incidences(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """World and cell, each pair once whatever the ego."""
        pairs = np.unique(np.stack([self.found.world, self.found.cell]), axis=1)
        return pairs[0], pairs[1]

    def over(self, *dimensions: str) -> Exposure:
        """The exposure over these dimensions alone.

        Raises:
          ValueError: none, or an unknown one; one line.
        """
        if not dimensions:
            raise ValueError(f"over: name dimensions, of {', '.join(self.domain.names)}")
        domain, cells = self.domain.over(dimensions)
        reachable = np.zeros(domain.size, bool)
        reachable[cells[self.possible]] = True
        more = None if self.more is None else self.more.over(*dimensions)
        return Exposure(
            self.scenario, self.policy, self.seeds, self.egos, self.dt, domain, reachable,
            over(self.found, cells), more, self.again,
        )  # fmt: skip

    def parts(self, ways: int = WAYS) -> Iterator[Exposure]:
        """The exposure over each choice of `ways` dimensions; where there are fewer, over all."""
        names = self.domain.names
        for some in itertools.combinations(names, min(ways, len(names))):
            yield self.over(*some)

    def shares(self, seed: int = 0) -> list[Interval]:
        """Share of the time in each cell, with 95 % intervals.

        Worlds are resampled (bootstrap, percentiles); of fewer than `LEAST_WORLDS` the bounds are NaN.

        Args:
          seed: of the resampling.
        """
        whole = max(self.total, self.dt)
        estimates = self.seconds.ravel() / whole
        many = len(self.seeds)
        bounds = np.full((2, self.domain.size), np.nan)
        if many >= LEAST_WORLDS:
            weights = np.random.default_rng(seed).multinomial(many, np.full(many, 1 / many), RESAMPLES)
            there = np.flatnonzero(self.covered)
            steps = np.zeros((many, len(there)))
            np.add.at(steps, (self.found.world, np.searchsorted(there, self.found.cell)), self.found.steps)
            drawn = weights @ steps
            drawn /= np.maximum(drawn.sum(1, keepdims=True), 1)
            bounds[:] = 0
            bounds[:, there] = np.quantile(drawn, (0.025, 0.975), axis=0)
        return [Interval(*map(float, x)) for x in zip(estimates, *bounds, strict=True)]

    # --- cells

    @property
    def covered(self) -> NDArray[np.bool_]:
        """Cells that were reached, `[C]`."""
        return self.worlds.ravel() > 0

    def uncovered(self, *, searched: bool = True) -> list[dict[str, str]]:
        """Cells that are possible and that no world reaches.

        Args:
          searched: without those that further seeds reach, if there was a search.
        """
        missing = self.possible & ~self.covered
        if searched and self.more is not None:
            missing &= ~self.more.covered
        return [self.domain.cell(k) for k in np.flatnonzero(missing)]

    def visits(self, cell: Cell) -> list[Visit]:
        """Worlds that reach a cell, those of a search behind the others.

        Args:
          cell: as `{"speed": 3.0, "gap": "no leader"}`: names of bins, or numbers within. A dimension that
            is not named may have any bin.

        Raises:
          ValueError: an unknown dimension or bin; one line.
        """
        wanted = self.domain.matching(cell)
        one = over(self.found, np.where(wanted, 0, 1))
        rows = [
            Visit(self.seeds[world], int(ego), first * self.dt, steps * self.dt)
            for world, ego, there, steps, first in zip(*(x.tolist() for x in one), strict=True)
            if there == 0
        ]
        return rows + ([] if self.more is None else self.more.visits(cell))

    def seeds_for(self, cell: Cell) -> list[int]:
        """Seeds that reach a cell; see `visits`."""
        return list(dict.fromkeys(visit.seed for visit in self.visits(cell)))

    def visits_by_cell(self) -> dict[int, list[Visit]]:
        """Of every cell that was reached, its visits by seed."""
        found: dict[int, list[Visit]] = {}
        for world, ego, cell, steps, first in zip(*(x.tolist() for x in self.found), strict=True):
            visit = Visit(self.seeds[world], ego, first * self.dt, steps * self.dt)
            found.setdefault(cell, []).append(visit)
        return found

    def rare(self, most: int = RARE) -> list[tuple[dict[str, str], list[Visit]]]:
        """Cells that at most `most` worlds reach, and their visits, rarest first."""
        worlds, visits = self.worlds.ravel(), self.visits_by_cell()
        order = sorted((k for k in visits if worlds[k] <= most), key=lambda k: (worlds[k], k))
        return [(self.domain.cell(k), visits[k]) for k in order]

    def reached(self) -> list[Reached]:
        """Cells that only the search reaches, and the first seed that does."""
        if self.more is None:
            return []
        rows: dict[int, Reached] = {}
        new, covered = self.more.found, self.covered
        for k in np.lexsort((new.first, new.world)):
            cell = int(new.cell[k])
            if not covered[cell] and cell not in rows:
                seed = self.more.seeds[new.world[k]]
                rows[cell] = Reached(self.domain.cell(cell), seed, float(new.first[k] * self.dt))
        return [rows[cell] for cell in sorted(rows)]

    # --- worlds

    def _cells(self, ways: int | None) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Incidences of cells of `ways` dimensions."""
        if ways is None or ways >= len(self.domain.names):
            return self._incidences
        if ways < 1:
            raise ValueError(f"ways: {ways}; at least 1 dimension")
        offset, parts = 0, []
        for part in self.parts(ways):
            world, cell = part._incidences
            parts.append((world, cell + offset))
            offset += part.domain.size
        worlds, cells = (np.concatenate(x) for x in zip(*parts, strict=True))
        return worlds, cells

    def cover(self, ways: int | None = None) -> list[Choice]:
        """A small set of seeds that reaches what all seeds reach.

        See `coverage.greedy_cover`.

        Args:
          ways: cells of this many dimensions at a time, as 2 for all pairs; None: of all dimensions.
        """
        return [Choice(self.seeds[world], adds) for world, adds in greedy_cover(*self._cells(ways))]

    def growth(self, ways: int | None = None) -> tuple[NDArray[np.int64], Floats]:
        """Numbers of seeds, and how many cells they cover on average; see `coverage.growth`."""
        at = np.arange(len(self.seeds) + 1)
        return at, growth(self._cells(ways)[1], len(self.seeds), at)

    def unseen(self) -> Unseen:
        """What further seeds would bring; see `coverage.unseen`."""
        cells = self.domain.size
        key = self.found.world * cells + self.found.cell
        pairs, row = np.unique(key, return_inverse=True)
        steps = np.bincount(row.ravel(), self.found.steps, len(pairs)).astype(np.int64)
        return unseen(pairs // cells, pairs % cells, steps, len(self.seeds))

    def replay(self, seed: int, ego: int = 0) -> Any:
        """The `World` of a seed, every step of it.

        It runs by the same program, and thus with equal bits.

        Raises:
          ValueError: an exposure that did not run here.
        """
        if self.again is None:
            raise ValueError("this exposure cannot make its worlds again")
        return self.again(seed, ego)

    # --- for others

    def table(self) -> pa.Table:
        """A row per possible cell, the longest time first.

        Columns are the dimensions, `seconds`, `share`, `worlds`, `first_seed` (null: none) and `searched`,
        the first seed of a search that reaches it.
        """
        seconds, worlds = self.seconds.ravel(), self.worlds.ravel()
        first: dict[int, int] = {}
        for world, cell in zip(*(x.tolist() for x in self._incidences), strict=True):
            first.setdefault(cell, self.seeds[world])
        searched = {tuple(x.cell.values()): x.seed for x in self.reached()}
        there = np.flatnonzero(self.possible | self.covered)
        rows = []
        for k in there[np.argsort(-seconds[there], kind="stable")]:
            cell = self.domain.cell(k)
            rows.append(cell | {
                "seconds": float(seconds[k]), "share": float(seconds[k] / max(self.total, self.dt)),
                "worlds": int(worlds[k]), "first_seed": first.get(int(k)),
                "searched": searched.get(tuple(cell.values())),
            })  # fmt: skip
        names = [(name, pa.string()) for name in self.domain.names]
        numbers = [("seconds", pa.float64()), ("share", pa.float64())]
        numbers += [(name, pa.int64()) for name in ("worlds", "first_seed", "searched")]
        return pa.Table.from_pylist(rows, pa.schema([*names, *numbers]))

    def __str__(self) -> str:
        unseen, worlds = self.unseen(), len(self.seeds)
        lines = [
            f"{self.scenario}, {self.policy}: {self.total / 3600:.2f} h in {worlds:,} worlds",
            f"  {self._said()}",
            f"  a further seed: {100 * unseen.share:.2g} % of its time and {unseen.cells:.2g} cells are new",
        ]
        for part in self.parts(1):
            lines.append(f"  {part.domain.dimensions[0].title}")
            shares = part.seconds / max(part.total, part.dt)
            for k in np.flatnonzero(part.covered):
                lines.append(f"    {part.domain.dimensions[0].bins[k]:<16} {100 * shares[k]:5.1f} %")
            new = {tuple(x.cell.values()): f" (seed {x.seed})" for x in part.reached()}
            missing = [
                f"{x}{new.get((x,), '')}" for cell in part.uncovered(searched=False) for x in cell.values()
            ]
            lines += [f"    not covered: {', '.join(missing)}"] if missing else []
        return "\n".join(lines)

    def _said(self) -> str:
        """How many cells are covered, in words."""
        said = f"{self.covered.sum():,} of {(self.possible | self.covered).sum():,} cells are covered"
        if len(self.domain.names) > WAYS:
            done, all_ = self.pairs()
            said += f", {done:,} of {all_:,} of pairs of dimensions"
        if self.more is not None:
            said += f"; {len(self.more.seeds):,} further seeds reach {len(self.reached()):,} more"
        return said

    def pairs(self) -> tuple[int, int]:
        """Cells of pairs of dimensions: how many are covered, and how many possible."""
        parts = list(self.parts())
        return (
            sum(int(x.covered.sum()) for x in parts), sum(int((x.possible | x.covered).sum()) for x in parts)
        )  # fmt: skip

    def as_json(self) -> dict[str, Any]:
        """Plain values: all cells of the domain as numbers, and tables of one and two dimensions."""
        seconds, worlds = self.seconds.ravel(), self.worlds.ravel()
        missing = self.possible & ~self.covered
        at, cells = self.growth()
        return {
            "scenario": self.scenario,
            "policy": self.policy,
            "seeds": list(self.seeds),
            "egos": self.egos,
            "dt": self.dt,
            "seconds": self.total,
            "dimensions": [
                {"name": x.name, "unit": x.unit, "edges": list(x.edges), "bins": list(x.bins)}
                for x in self.domain.dimensions
            ],
            "covered": [
                {"cell": _places(self.domain, k), "seconds": float(seconds[k]), "worlds": int(worlds[k])}
                for k in np.flatnonzero(self.covered)
            ],
            "not_covered": [_places(self.domain, k) for k in np.flatnonzero(missing)],
            "rare": [
                {"cell": cell, "visits": [x._asdict() for x in seen]}
                for part in (self, *(self.parts() if len(self.domain.names) > WAYS else ()))
                for cell, seen in part.rare()
            ],
            "tables": [
                {
                    "dimensions": list(part.domain.names), "seconds": part.seconds.tolist(),
                    "worlds": part.worlds.tolist(),
                    "possible": part.possible.reshape(part.domain.shape).tolist(),
                }
                for ways in (1, WAYS)
                for part in self.parts(ways)
            ],
            "cover": [x._asdict() for x in self.cover()],
            "cover_pairs": [x._asdict() for x in self.cover(WAYS)],
            "growth": {"seeds": at.tolist(), "cells": cells.tolist()},
            "unseen": self.unseen()._asdict(),
            "search": None if self.more is None else {
                "seeds": list(self.more.seeds), "reached": [x._asdict() for x in self.reached()],
            },
        }  # fmt: skip


def _places(domain: Domain, cell: int | np.integer) -> list[int]:
    """Numbers of the bins of a cell."""
    return [int(k) for k in np.unravel_index(int(cell), domain.shape)]


class Counter:
    """Counts the exposure of worlds of an experiment.

    Args:
      episodes: of the experiment and policy.
      domain: the cells.

    Raises:
      ValueError: an experiment without an ego; one line.
    """

    def __init__(self, episodes: Episodes, domain: Domain) -> None:
        if not episodes.egos:
            raise ValueError(f"{episodes.scenario}: exposure is that of an ego, and there is none")
        self.episodes, self.domain = episodes, domain
        places = places_of(episodes.network, episodes.lane_map)
        self.possible = possible(domain, places, episodes.lane_map)
        measure = CountExposure(domain, places, episodes.egos)
        name = describe_program(source_hash(), episodes.rollout.config, measure)
        self.worlds: Worlds = episodes.worlds.measuring(measure, name)

    def count(
        self,
        seeds: Sequence[int],
        *,
        tell: Callable[[int], None] | None = None,
        enough: Callable[[NDArray[np.int64]], bool] | None = None,
    ) -> Exposure:
        """Run the worlds of seeds.

        Args:
          seeds: which.
          tell: is told after each chunk how many worlds have run.
          enough: given the cells that a chunk has reached; it ends there once this returns True.
        """
        parts, done = [], 0
        for some, result in self.worlds.chunks(seeds):
            parts.append(sparse(result.measures, done))
            done += len(some)
            if tell is not None:
                tell(done)
            if enough is not None and enough(parts[-1].cell):
                break
        one = self.episodes
        return Exposure(
            one.scenario, one.policy, tuple(int(x) for x in seeds[:done]), one.egos, one.experiment.dt,
            self.domain, self.possible, joined(parts),
        )  # fmt: skip

    def trace(self, seed: int) -> Trace:
        """Every step of a world, `[T, ...]`, NumPy; by the program that counts."""
        result = self.worlds.replay(self.worlds.start([seed]), count=1)
        return jax.tree.map(lambda x: x[0], result.trace)


def exposure(
    episodes: Episodes,
    domain: Domain,
    seeds: Sequence[int],
    *,
    search: int = 0,
    tell: Callable[[int, int], None] | None = None,
) -> tuple[Exposure, Counter]:
    """The exposure of seeds; then further seeds, until they have reached all possible cells.

    Args:
      episodes: of the experiment and policy.
      domain: the cells.
      seeds: which.
      search: further seeds, at most, from the first beyond `seeds` on.
      tell: is told how many worlds have run, and how many will at most.

    Raises:
      ValueError: an experiment without an ego; one line.
    """
    counter, most = Counter(episodes, domain), len(seeds) + search

    def told(before: int) -> Callable[[int], None] | None:
        if tell is None:
            return None
        say = tell
        return lambda done: say(before + done, most)

    found = counter.count(seeds, tell=told(0))
    if search:
        missing = found.possible & ~found.covered
        further = _further(seeds, search)

        def enough(cells: Iterable[int]) -> bool:
            missing[np.asarray(cells, np.int64)] = False
            return not missing.any()

        if missing.any():
            more = counter.count(further, tell=told(len(seeds)), enough=enough)
            found = replace(found, more=more)
    return found, counter


def _further(seeds: Sequence[int], many: int) -> list[int]:
    """Seeds beyond these; at the end of all seeds, free ones from 0 on."""
    last = max(seeds)
    if last + many < 2**31:
        return list(range(last + 1, last + 1 + many))
    taken = set(seeds)
    return list(itertools.islice((k for k in itertools.count() if k not in taken), many))
