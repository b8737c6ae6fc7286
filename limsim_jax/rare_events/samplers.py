"""Samplers of rare events: generators that ask for points and are told the limit state there.

A sampler yields standard normals `[n, D]` and is sent the limit state `[n]` of each: the event is where it is
0 or less. It returns a `Run`. A generator holds no function, so that many runs share one batch, and a run
that is fed the values of an earlier one ends as that one did.

- `crude`: independent draws.
- `subset`: subset simulation (Au and Beck 2001) with conditional sampling (Papaioannou et al. 2015): levels
  of the limit state, each a tenth as probable as the one before; Markov chains whose moves keep the normal
  distribution, with a step that adapts to an acceptance of 44 %.
- `cross_entropy`: importance sampling from a normal distribution that is fitted to the event in steps
  (Rubinstein and Kroese 2004), mixed with the plain one so that no weight exceeds `1 / DEFENSIVE`.
- `splitting`: adaptive multilevel splitting in time (Cérou and Guyader 2007). A world that has come far is
  cloned, and its clones draw their future anew. Unbiased for any number of clones (Bréhier et al. 2016).
"""

from __future__ import annotations

import math
from collections.abc import Generator
from itertools import count
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Sampler = Generator[Floats, Floats, "Run"]

LEVEL = 0.1
"""Probability of a level, given the one before (Au and Beck 2001: 0.1 to 0.3)."""

ACCEPTANCE = 0.44
"""Share of moves that the step of a chain aims at (Papaioannou et al. 2015, section 4)."""

FIRST_STEP = 0.6
"""Step of the first move of a chain, in standard deviations."""

DEFENSIVE = 0.1
"""Share of the plain distribution in that of the importance sampling (Hesterberg 1995)."""

WIDER = 1.5
"""Factor on fitted standard deviations below 1: the tail of an event is longer than a normal one."""

NARROWEST = 0.05
"""Least standard deviation of the fitted distribution."""

CROSS_ENTROPY_MOST = 30
"""Dimensions up to which weights of importance samples keep a useful spread."""


_ROUNDING = 1 + 1e-9  # of a product of levels


class Run(NamedTuple):
    """What one run of a sampler found."""

    probability: float
    calls: int  # points at which the limit state was asked for
    levels: int  # beyond the first sample
    ended: bool  # False: it gave up before it came to the event
    bound: float  # of the probability, where it gave up: that of the last level
    points: Floats  # [M, D] in the event
    weights: Floats  # [M] of these points; they add up to 1
    note: str = ""


def _event(z: Floats, g: Floats, weights: Floats | None = None) -> tuple[Floats, Floats]:
    """Points within the event, and weights that add up to 1."""
    inside = g <= 0
    weights = np.ones(len(g)) if weights is None else weights
    kept = weights[inside]
    return z[inside], kept / kept.sum() if len(kept) else kept


def crude(rng: np.random.Generator, dim: int, samples: int) -> Sampler:
    """Independent draws."""
    z = rng.standard_normal((samples, dim))
    g = yield z
    return Run(float(np.mean(g <= 0)), samples, 0, True, 1.0, *_event(z, g))


def subset(rng: np.random.Generator, dim: int, samples: int, least: float) -> Sampler:
    """Subset simulation: `samples` points per level, down to a probability of `least`."""
    seeds = max(2, math.floor(LEVEL * samples))
    z = rng.standard_normal((samples, dim))
    g = yield z
    probability, calls, step, last = 1.0, samples, FIRST_STEP, math.inf
    for level in count():
        order = np.argsort(g, kind="stable")
        threshold = float(g[order[seeds - 1]])
        if threshold <= 0:
            inside = float(np.mean(g <= 0))
            return Run(probability * inside, calls, level, True, probability, *_event(z, g))
        reached = g <= threshold
        if threshold >= last and bool(reached.all()):
            note = f"the limit state stays at {threshold:.3g} and leads no further"
            return Run(0.0, calls, level, False, probability, *_event(z, g), note)
        probability *= float(np.mean(reached))
        if probability <= least * _ROUNDING:
            return Run(0.0, calls, level, False, probability, *_event(z, g))
        begin = rng.permutation(np.flatnonzero(reached))[:seeds]
        z, g = z[begin], g[begin]
        chains, values = [z], [g]
        while sum(len(x) for x in chains) < samples:
            kept = math.sqrt(1 - step * step)
            moved = kept * z + step * rng.standard_normal(z.shape)
            found = yield moved
            calls += len(moved)
            accepted = found <= threshold
            z, g = np.where(accepted[:, None], moved, z), np.where(accepted, found, g)
            chains.append(z)
            values.append(g)
            step = min(max(step * math.exp(float(accepted.mean()) - ACCEPTANCE), 1e-3), 1.0)
        z, g, last = np.concatenate(chains)[:samples], np.concatenate(values)[:samples], threshold
    raise AssertionError("levels without end")


def cross_entropy(rng: np.random.Generator, dim: int, samples: int, least: float) -> Sampler:
    """Importance sampling: `samples` points per step, as many steps as lead to `least`."""
    mean, spread, calls, last = np.zeros(dim), np.ones(dim), 0, math.inf
    steps = 2 * math.ceil(math.log(least) / math.log(LEVEL))
    for level in count():
        plain = rng.random((samples, 1)) < DEFENSIVE
        normal = rng.standard_normal((samples, dim))
        z = np.where(plain, normal, mean + spread * normal)
        g = yield z
        calls += samples
        weights = _ratio(z, mean, spread)
        threshold = float(np.quantile(g, LEVEL))
        if threshold <= 0 and level == 0:
            return Run(float(np.mean(g <= 0)), calls, 0, True, 1.0, *_event(z, g))
        if threshold <= 0 and last <= 0:  # fitted to the event itself; this sample is the result
            found = float(np.mean(np.where(g <= 0, weights, 0)))
            return Run(found, calls, level, True, 1.0, *_event(z, g, weights))
        if level == steps:
            note = "the fitted distribution did not get to the event"
            return Run(0.0, calls, level, False, 1.0, *_event(z, g), note)
        last, elite = threshold, g <= max(threshold, 0)
        w = np.where(elite, weights, 0)
        total = w.sum()
        mean = w @ z / total
        spread = np.sqrt(np.maximum(w @ (z - mean) ** 2 / total, NARROWEST**2))
        spread = np.where(spread < 1, np.minimum(WIDER * spread, 1), spread)
    raise AssertionError("steps without end")


def _ratio(z: Floats, mean: Floats, spread: Floats) -> Floats:
    """Weights: the plain density over that of the mixture."""
    fitted = np.sum(z * z - ((z - mean) / spread) ** 2, 1) / 2 - np.sum(np.log(spread))
    return 1 / (DEFENSIVE + (1 - DEFENSIVE) * np.exp(np.minimum(fitted, 700)))


def splitting(
    rng: np.random.Generator, dim: int, samples: int, least: float, born: NDArray[np.int64]
) -> Sampler:
    """Splitting in time; it is sent paths of the limit state, `[n, T]`.

    Args:
      rng: its random numbers.
      dim: numbers of a world.
      samples: worlds that are kept.
      least: probability at which it gives up.
      born: `[D]` moment at which each number is drawn. The path before it does not depend on it.
    """
    z = rng.standard_normal((samples, dim))
    path = yield z
    low = np.minimum.accumulate(path, 1)
    calls, probability = samples, 1.0
    kill = max(1, round(LEVEL * samples))
    for level in count():
        g = low[:, -1]
        threshold = float(np.sort(g)[::-1][kill - 1])  # of the worlds that come least far
        if threshold <= 0:
            return Run(probability * float(np.mean(g <= 0)), calls, level, True, 1.0, *_event(z, g))
        dead = g >= threshold
        alive = np.flatnonzero(~dead)
        if probability <= least * _ROUNDING or not len(alive):
            note = "" if len(alive) else f"the limit state stays at {threshold:.3g} and leads no further"
            return Run(0.0, calls, level, False, probability, *_event(z, g), note)
        probability *= len(alive) / samples
        parents = rng.choice(alive, int(dead.sum()))
        crossed = np.argmax(low[parents] < threshold, 1)  # when the parent got beyond the level
        fresh = rng.standard_normal((len(parents), dim))
        children = np.where(born[None] <= crossed[:, None], z[parents], fresh)
        path = yield children
        calls += len(children)
        z[dead], low[dead] = children, np.minimum.accumulate(path, 1)
    raise AssertionError("levels without end")
