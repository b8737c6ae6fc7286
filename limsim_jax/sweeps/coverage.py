"""How much of a domain some worlds cover: seeds that cover it, how coverage grows, what is not yet seen.

Everything here is of incidences: world `world[k]` has been in cell `cell[k]`, each pair once.
"""

from __future__ import annotations

import heapq
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]


class Choice(NamedTuple):
    """A seed of a set that covers cells."""

    seed: int
    adds: int  # cells that those before it do not cover


class Unseen(NamedTuple):
    """What further worlds would bring, from those that have run."""

    share: float  # of the time of a further world, in cells that no world has been in; NaN: of no time
    cells: float  # that no world has been in, in a further world
    once: int  # cells that exactly one world has been in
    worlds: int


def greedy_cover(world: Ints, cell: Ints) -> list[tuple[int, int]]:
    """A small set of worlds that covers all cells: worlds, and cells added.

    Each time the world with the most new cells is taken, of equal ones the first. No set is smaller by more
    than a factor of 1 + ln(cells of the largest world) (Chvatal 1979).
    """
    order = np.argsort(world, kind="stable")
    names, begin = np.unique(world[order], return_index=True)
    sets = np.split(cell[order], begin[1:]) if len(names) else []
    left = np.ones(int(cell.max(initial=-1)) + 1, bool)
    # what a world adds only falls, so what it added at an earlier look is a bound
    heap = [(-len(some), k) for k, some in enumerate(sets)]
    heapq.heapify(heap)
    found = []
    while heap:
        _, k = heapq.heappop(heap)
        now = -int(left[sets[k]].sum()), k
        if not now[0]:
            continue
        if heap and heap[0] < now:
            heapq.heappush(heap, now)
            continue
        found.append((int(names[k]), -now[0]))
        left[sets[k]] = False
    return found


def growth(cell: Ints, worlds: int, at: Ints) -> Floats:
    """Cells that `at` worlds cover on average, whatever their order.

    `S - sum over cells of C(n - q, k) / C(n, k)`, of `n` worlds, `k` of them, and `q` that have been in a
    cell: sample-based rarefaction (Colwell, Mao and Chang 2004, equation 5).

    Args:
      cell: of the incidences.
      worlds: n, all that have run.
      at: numbers of worlds, 0 to n.
    """
    from scipy.special import gammaln

    visits = np.bincount(cell)
    q, many = np.unique(visits[visits > 0], return_counts=True)
    k, q = np.asarray(at, float)[:, None], np.asarray(q, float)[None]
    room = worlds - q - k  # below 0: none can miss the cell
    log = gammaln(worlds - q + 1) - gammaln(np.maximum(room, 0) + 1)
    log -= gammaln(worlds + 1) - gammaln(worlds - k + 1)
    return (many * (1 - np.where(room < 0, 0, np.exp(log)))).sum(1)


def unseen(world: Ints, cell: Ints, steps: Ints, worlds: int) -> Unseen:
    """What further worlds would bring (Good 1953, "The population frequencies of species").

    Good estimates the probability of what is not yet seen by the share of what was seen once. Here a world
    is a draw, as its steps are not independent. The share of time is that in cells of a single world: each
    world is judged by all others. The number of new cells is that of cells of a single world over worlds.
    """
    visits = np.bincount(cell, minlength=1)
    single = visits[cell] == 1
    total = int(steps.sum())
    share = float(steps[single].sum() / total) if total else float("nan")
    once = int(single.sum())
    return Unseen(share, once / worlds, once, worlds)
