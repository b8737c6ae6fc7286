"""On which assumption about the other drivers a result hangs.

Every parameter of the drivers is shifted by up to `RANGE` standard deviations of its population, for all
vehicles at once; more arrivals count as one more parameter. The shifts are changes of the random numbers of a
world, so one compiled program runs them all.

A seed gives a world, and two points A and B of shifts. It runs under A, and for each parameter under A with
the value of B (radial design, Campolongo, Saltelli and Cariboni 2011). From these come, for each metric:

- the slope: change of the metric per standard deviation, by least squares over the pairs;
- the total index: share of the variance that a parameter takes part in, `E[(f(A) - f(AB))^2] / (2 Var f(A))`
  (Jansen 1999). The traffic itself, another seed under the same shifts, has one, too. It tells how much of
  the variance is chance, and what an index means: a parameter that changes traffic as another seed does has
  the same index, whatever its slope.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from limsim_jax.statistics import Interval
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.sweeps.numbered import Numbered

RANGE = 1.0
"""Standard deviations by which parameters are shifted, at most, up or down."""

TRAFFIC = "traffic (another seed)"
"""Name of chance among the parameters."""

ARRIVALS = "arrivals"
"""Name of the gaps among the parameters: up means fewer vehicles."""

_NOT_SHIFTED = ("goal", "type", "seat", "place", "gap")
LEAST_SEEDS = 8


class Effect(NamedTuple):
    """What a parameter does to a metric."""

    metric: str
    parameter: str
    slope: Interval  # unit of the metric per standard deviation; NaN for `TRAFFIC`
    total: Interval  # share of the variance, 0 to 1 and beyond by chance
    p: float  # of the slope, two-sided, adjusted for all parameters of the metric


class Sensitivity(NamedTuple):
    """Effects of parameters on metrics, the strongest of each metric first."""

    scenario: str
    policy: str
    seeds: int
    worlds: int
    effects: tuple[Effect, ...]
    means: dict[str, float]  # of the metrics, over the worlds A

    def of(self, metric: str) -> list[Effect]:
        """Effects on a metric, the strongest slope first, the traffic last."""
        return [effect for effect in self.effects if effect.metric == metric]

    def __str__(self) -> str:
        lines = [f"{self.scenario}, {self.policy}: {self.worlds:,} worlds of {self.seeds} seeds"]
        for metric, mean in self.means.items():
            lines.append(f"  {metric} (mean {mean:.4g})")
            for effect in self.of(metric)[:5]:
                if effect.parameter != TRAFFIC:
                    lines.append(f"    {effect.parameter:<18} {slope_text(effect)}")
        return "\n".join(lines)

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "scenario": self.scenario,
            "policy": self.policy,
            "seeds": self.seeds,
            "worlds": self.worlds,
            "range": RANGE,
            "means": self.means,
            "effects": [
                {
                    "metric": x.metric, "parameter": x.parameter, "p": x.p, "slope": list(x.slope),
                    "total": list(x.total),
                }
                for x in self.effects
            ],
        }  # fmt: skip


def slope_text(effect: Effect) -> str:
    """The slope with its interval, marked where it is one."""
    slope = effect.slope
    sure = "" if effect.p < 0.05 else "  (may be none)"
    return f"{slope.estimate:+.3g} [{slope.low:+.3g}, {slope.high:+.3g}] per standard deviation{sure}"


def parameters_of(episodes: Episodes) -> dict[str, NDArray[np.int64]]:
    """Parameters that can be shifted, and their places in the array."""
    found: dict[str, list[int]] = {}
    for k, number in enumerate(episodes.layout.numbers):
        name = ARRIVALS if number.what == "gap" else number.what
        if name == ARRIVALS or name not in _NOT_SHIFTED:
            found.setdefault(name, []).append(k)
    return {name: np.array(places) for name, places in found.items()}


def sensitivity(
    episodes: Episodes,
    metrics: Sequence[str],
    *,
    seeds: int,
    seed: int = 0,
    tell: Callable[[int, int], None] | None = None,
) -> Sensitivity:
    """Slopes and indices of all parameters.

    Args:
      episodes: of the experiment and policy.
      metrics: columns.
      seeds: of the traffic, from 0 on; each costs a world per parameter, and two.
      seed: of the shifts.
      tell: is told how many worlds have run, and how many will.

    Raises:
      ValueError: too few seeds, or an unknown metric; one line.
    """
    if seeds < LEAST_SEEDS:
        raise ValueError(f"seeds: {seeds}; at least {LEAST_SEEDS}, as intervals come from their spread")
    unknown = [name for name in metrics if name not in episodes.units]
    if unknown or not metrics:
        raise ValueError(f"metrics: no metric '{(unknown or [''])[0]}'; the page of metrics lists all")
    parameters = parameters_of(episodes)
    if not parameters:
        raise ValueError(f"{episodes.scenario}: no other driver is drawn, so nothing can be shifted")
    names, layout = list(parameters), episodes.layout
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(-RANGE, RANGE, (2, seeds, len(names)))
    base = layout.to_normals(episodes.numbers(range(2 * seeds)))
    runner = Numbered(episodes)
    rows = []  # of a seed: A, then A with each parameter of B, then another seed under A
    for k in range(seeds):
        shift = np.repeat(a[k][None], len(names) + 2, 0)
        shift[np.arange(1, len(names) + 1), np.arange(len(names))] = b[k]
        world = np.repeat(base[k][None], len(names) + 2, 0)
        world[-1] = base[seeds + k]
        for j, name in enumerate(names):
            world[:, parameters[name]] += shift[:, j : j + 1]
        rows.append(layout.from_normals(world))
    worlds = seeds * (len(names) + 2)
    # the policy draws the same under all shifts of a seed
    drawn = np.repeat(np.arange(seeds, dtype=np.int32), len(names) + 2)
    columns = runner.run(np.concatenate(rows), drawn, tell and (lambda done: tell(done, worlds)))
    effects, means = [], {}
    for metric in metrics:
        # [seeds, P + 2]; of several egos the mean
        y = columns[metric].reshape(seeds, len(names) + 2, runner.each).mean(-1)
        there = ~np.isnan(y).any(1)  # a metric that is not measured in a world costs its seed
        if there.sum() < LEAST_SEEDS or np.ptp(y[there]) == 0:
            continue
        means[metric] = float(y[there, 0].mean())
        effects += _effects(metric, names, y[there], (b - a)[there])
    return Sensitivity(episodes.scenario, episodes.policy, seeds, worlds, tuple(effects), means)


def _effects(
    metric: str, names: Sequence[str], y: NDArray[np.float64], step: NDArray[np.float64]
) -> list[Effect]:
    """Effects on one metric, `y` `[S, P + 2]`, `step` `[S, P]`."""
    from scipy.stats import t

    from limsim_jax.statistics import holm

    change = y[:, 1:] - y[:, :1]
    n, rng = len(y), np.random.default_rng(0)
    draws = rng.integers(0, n, (2000, n))
    variance = y[:, 0].var(ddof=1)
    resampled = np.maximum(y[draws, 0].var(1, ddof=1), 1e-30)
    totals = []
    for j in range(len(names) + 1):
        square = change[:, j] ** 2
        low, high = np.quantile(square[draws].mean(1) / (2 * resampled), (0.025, 0.975))
        totals.append(Interval(float(square.mean() / (2 * max(variance, 1e-30))), float(low), float(high)))
    x, dy = step, change[:, :-1]
    energy = (x * x).sum(0)
    slope = (x * dy).sum(0) / energy
    rest = dy - slope * x
    # robust to a spread that grows with the step
    error = np.sqrt(((x * rest) ** 2).sum(0) * n / (n - 1)) / energy
    half = t.ppf(0.975, n - 1) * error
    p = 2 * t.sf(np.abs(slope) / np.maximum(error, 1e-30), n - 1)
    adjusted = holm(p.tolist())
    order = sorted(range(len(names)), key=lambda j: (adjusted[j] >= 0.05, -abs(slope[j])))
    found = [
        Effect(
            metric, names[j], Interval(*map(float, (slope[j], slope[j] - half[j], slope[j] + half[j]))),
            totals[j], adjusted[j],
        )
        for j in order
    ]  # fmt: skip
    return [*found, Effect(metric, TRAFFIC, Interval(np.nan, np.nan, np.nan), totals[-1], np.nan)]
