"""Figures of notebooks in one call each: matplotlib axes in, axes out.

Every function takes arrays or tables, and optional axes to draw on; without them it makes a figure.
`results` may be those of the public API or those of `sweeps.store`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import ArrayLike, NDArray

from limsim_jax.metrics.catalog import describe
from limsim_jax.metrics.moments import ORDER, words
from limsim_jax.report.tables import columns, groups, metrics_of, with_shares
from limsim_jax.statistics import median_interval, paired_t, wilson

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from limsim_jax.sweeps.store import Results

Floats = NDArray[np.float64]


def time_space(
    table: pa.Table, *, along: Sequence[Any], ax: Axes | None = None, seed: int | None = None
) -> Axes:
    """Time-space diagram: the way of every vehicle along lanes, coloured by speed.

    Args:
      table: long table of trajectories with the columns time (s), vehicle, lane, s (m) and v (m/s), and
        seed where it holds several worlds. A vehicle may stand in `slot` where `vehicle` is missing.
      along: the lanes of a route in order, as the column lane names them. Vehicles on other lanes are left
        out. A lane that follows begins where the last one ends, by the greatest s in the table.
      ax: axes.
      seed: the world to show.

    Returns:
      The axes; its line collection has the speeds (m/s) as array.

    Raises:
      ValueError: a column is missing, no vehicle is on these lanes, or several worlds without a `seed`.
    """
    from matplotlib.collections import LineCollection

    name = "vehicle" if "vehicle" in table.column_names else "slot"
    wanted = ("time", name, "lane", "s", "v")
    missing = [column for column in wanted if column not in table.column_names]
    if missing:
        raise ValueError(
            f"the table has no column {', '.join(missing)}; it has {', '.join(table.column_names)}"
        )
    if seed is not None:
        table = table.filter(pc.field("seed") == seed)
    elif "seed" in table.column_names and len(set(table["seed"].to_pylist())) > 1:
        raise ValueError("the table holds several worlds; name one as seed")
    lanes = np.asarray(table["lane"].to_pylist(), object)
    s_of_all, start, offset = np.asarray(table["s"], float), 0.0, {}
    for lane in along:
        offset[lane] = start
        on = s_of_all[lanes == lane]
        start += float(on.max()) if on.size else 0.0
    inside = np.array([lane in offset for lane in lanes], bool)
    if not inside.any():
        raise ValueError(f"no vehicle is on {', '.join(map(str, along))}")
    time, vehicle, v = (np.asarray(table[column])[inside] for column in ("time", name, "v"))
    place = s_of_all[inside] + np.array([offset[lane] for lane in lanes[inside]])
    order = np.lexsort((time, vehicle))
    time, vehicle, v, place = (x[order] for x in (time, vehicle, v, place))
    step = np.diff(np.unique(time)).min(initial=np.inf)
    joined = (vehicle[1:] == vehicle[:-1]) & (np.diff(time) < 1.5 * step)
    points = np.stack([time, place], -1)
    segments = np.stack([points[:-1], points[1:]], 1)[joined]
    ax = _axes(ax)
    lines = LineCollection(list(segments), cmap="viridis", linewidths=1.0)
    lines.set_array(v[1:][joined])
    ax.add_collection(lines)
    ax.autoscale()
    ax.set(xlabel="time, s", ylabel="distance along the route, m")
    ax.figure.colorbar(lines, ax=ax, label="speed, m/s")
    return ax


def distribution(results: Results, metric: str, *, ax: Axes | None = None, label: str | None = None) -> Axes:
    """Cumulative distribution of a metric of every scenario and policy.

    A thick bar is the 95 % interval of the median. Episodes in which the metric was not measured are left
    out.

    Args:
      results: of a sweep.
      metric: a column of its episodes.
      ax: axes.
      label: title of the axis; the metric and its unit by default.

    Raises:
      ValueError: no such metric, or no episodes.
    """
    _check_metric(results, metric)
    ax = _axes(ax)
    for k, (name, part) in enumerate(_parts(results).items()):
        x = columns(part, [metric])[:, 0]
        x = x[~np.isnan(x)]
        if not x.size:
            continue
        ax.ecdf(x, color=f"C{k}", label=name)
        low, high = median_interval(x)[1:]
        if np.isfinite([low, high]).all():
            ax.plot([low, high], [0.5, 0.5], color=f"C{k}", lw=6, alpha=0.35, solid_capstyle="butt")
    ax.set(
        xlabel=_label(results, metric) if label is None else label, ylabel="share of episodes", ylim=(0, 1)
    )
    ax.legend()
    return ax


def share_by_seeds(results: Results, metric: str, *, ax: Axes | None = None) -> Axes:
    """Share of episodes with a metric above 0, over the seeds (%).

    The band is Wilson's 95 % interval.

    Args and errors as for `distribution`.
    """
    _check_metric(results, metric)
    ax = _axes(ax)
    for k, (name, part) in enumerate(_parts(results).items()):
        x = columns(part, [metric])[:, 0]
        happened = x[~np.isnan(x)] > 0
        if not happened.size:
            continue
        n = np.arange(1, happened.size + 1)
        found = [wilson(int(e), int(m)) for e, m in zip(happened.cumsum(), n, strict=True)]
        share, low, high = 100 * np.array(found).T
        ax.fill_between(n, low, high, color=f"C{k}", alpha=0.25, lw=0)
        ax.plot(n, share, color=f"C{k}", label=name)
    ax.set(xlabel="seeds", ylabel=f"episodes with {metric.replace('_', ' ')}, %", ylim=(-1, 101))
    ax.legend()
    return ax


def paired(
    results: Results,
    metric: str,
    policies: tuple[str, str],
    *,
    scenario: str | None = None,
    marked: str | None = "contacts",
    ax: Axes | None = None,
) -> Axes:
    """Policy B against policy A, a dot per seed.

    The title tells the mean difference and the p-value of the paired t-test.

    Args:
      results: of a sweep with both policies.
      metric: a column of its episodes.
      policies: A (across) and B (up).
      scenario: where there are several.
      marked: a metric that is above 0 in the episodes of B that are drawn in red; None for none.
      ax: axes.

    Raises:
      ValueError: no such metric, policy or scenario, or no seed in which both were measured.
    """
    _check_metric(results, metric)
    parts = groups(_stored(results))
    scenarios = [s for s in dict.fromkeys(s for s, _ in parts) if scenario in (None, s)]
    if len(scenarios) != 1:
        known = ", ".join(dict.fromkeys(s for s, _ in parts))
        raise ValueError(f"scenario {scenario}: name one of {known}")
    for policy in policies:
        if (scenarios[0], policy) not in parts:
            known = ", ".join(p for s, p in parts if s == scenarios[0])
            raise ValueError(f"no policy '{policy}' in {scenarios[0]}; there are {known}")
    a, b = (parts[scenarios[0], policy] for policy in policies)
    a, b = with_shares(a, {})[0], with_shares(b, {})[0]
    seeds = [part["seed"].to_numpy() for part in (a, b)]
    _, at_a, at_b = np.intersect1d(*seeds, return_indices=True)
    x, y = columns(a, [metric])[at_a, 0], columns(b, [metric])[at_b, 0]
    both = ~np.isnan(x) & ~np.isnan(y)
    if not both.any():
        raise ValueError(f"no seed in which both policies measured {metric}")
    hit = np.zeros(len(x), bool)
    if marked is not None and marked in b.column_names:
        hit = columns(b, [marked])[at_b, 0] > 0
    ax = _axes(ax)
    for pick, color, name in ((both & ~hit, "k", "seed"), (both & hit, "C3", f"B with {marked}")):
        if pick.any():
            ax.plot(x[pick], y[pick], "o", color=color, alpha=0.6, label=name)
    ends = [min(x[both].min(), y[both].min()), max(x[both].max(), y[both].max())]
    ax.plot(ends, ends, "0.6", lw=1, label="equal")
    difference = y[both] - x[both]
    p = paired_t(difference)[1]
    label = _label(results, metric)
    ax.set(
        xlabel=f"{policies[0]}: {label}",
        ylabel=f"{policies[1]}: {label}",
        title=f"mean difference {difference.mean():+.3g}, p {'< 0.0001' if p < 1e-4 else f'= {p:.2g}'}",
    )
    ax.legend()
    return ax


def moments(results: Results, *, ax: Axes | None = None) -> Axes:
    """When key moments happen: a stroke each, a row per kind, a colour per scenario and policy."""
    ax = _axes(ax)
    table = results.moments
    found = set(table["kind"].to_pylist())
    kinds = [kind for kind in ORDER if kind in found] + sorted(found - set(ORDER))
    parts = groups(_stored(results))
    several = len({scenario for scenario, _ in parts}) > 1
    high = 0.8 / len(parts)
    for k, (scenario, policy) in enumerate(parts):
        own = table.filter((pc.field("scenario") == scenario) & (pc.field("policy") == policy)).to_pylist()
        place = [kinds.index(row["kind"]) - 0.4 + (k + 0.5) * high for row in own]
        name = f"{scenario} / {policy}" if several else policy
        ax.plot([row["time"] for row in own], place, "|", ms=10, color=f"C{k}", label=name)
    ax.set_yticks(range(len(kinds)), [words(kind) for kind in kinds])
    ax.invert_yaxis()
    ax.set(xlabel="time in the episode, s")
    ax.legend()
    return ax


def fundamental_diagram(
    points: Mapping[str, tuple[ArrayLike, ArrayLike]],
    *,
    ax: Axes | None = None,
    speed: bool = False,
) -> Axes:
    """Flow over density, or speed over density.

    Args:
      points: by name: density (veh/km) and flow (veh/h), `[K]` each.
      ax: axes.
      speed: draw the speed (km/h), which is flow over density, instead of the flow.

    Raises:
      ValueError: lists of different length.
    """
    ax = _axes(ax)
    for k, (name, (density, flow)) in enumerate(points.items()):
        x, y = np.asarray(density, float), np.asarray(flow, float)
        if x.shape != y.shape:
            raise ValueError(f"{name}: {x.size} densities but {y.size} flows")
        if speed:
            y = np.divide(y, x, out=np.full_like(y, np.nan), where=x > 0)
        ax.plot(x, y, "o", ms=5, color=f"C{k}", alpha=0.7, label=name)
    ax.set(xlabel="density, veh/km", ylabel="speed, km/h" if speed else "flow, veh/h")
    ax.set_xlim(left=0)
    ax.set_ylim(bottom=0)
    ax.legend()
    return ax


def around(
    trace: Any,
    slots: Mapping[str, int],
    at: float,
    *,
    before: float = 8.0,
    after: float = 2.0,
    ax: Any = None,
) -> Any:
    """Speeds of vehicles around a moment, and the distance of two.

    Args:
      trace: `simulation.trace.Trace`, `[T, ...]`.
      slots: name to slot; time is cut to the steps in which the first one is on the road.
      at: s.
      before: s before it.
      after: s after it.
      ax: two axes, or one for the speeds alone.

    Returns:
      The axes, as many as there are panels.
    """
    import matplotlib.pyplot as plt

    if ax is None:
        _, ax = plt.subplots(1, min(len(slots), 2), figsize=(10, 3), sharex=True, layout="constrained")
    panels = np.atleast_1d(ax)
    time = np.asarray(trace.time)
    order = list(slots.values())
    shown = (time > at - before) & (time < at + after) & np.asarray(trace.active)[:, order[0]]
    for k, (name, slot) in enumerate(slots.items()):
        panels[0].plot(time[shown], np.asarray(trace.v)[shown, slot], color=f"C{k}", label=name)
    panels[0].set(ylabel="speed, m/s")
    panels[0].legend()
    if len(panels) > 1:
        xy = np.asarray(trace.box)[shown][:, order[:2], :2]
        panels[1].plot(time[shown], np.hypot(*(xy[:, 0] - xy[:, 1]).T), "k")
        panels[1].set(ylabel="distance of centres, m")
    for panel in panels:
        panel.axvline(at, color="0.6", ls=":", lw=1)
        panel.set(xlabel="time, s", ylim=(0, None))
    return ax


# --- helpers


def _axes(ax: Axes | None) -> Axes:
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots(layout="constrained")[1]


def _stored(results: Any) -> Results:
    """Stored results, also those behind the public `Results`."""
    return getattr(results, "stored", results)


def _parts(results: Results) -> dict[str, pa.Table]:
    """Episodes with their shares, by the shortest name that tells them apart."""
    stored = _stored(results)
    parts = groups(stored)
    several = len({scenario for scenario, _ in parts}) > 1
    return {
        f"{scenario} / {policy}" if several else policy: with_shares(part, stored.units)[0]
        for (scenario, policy), part in parts.items()
    }


def _check_metric(results: Results, metric: str) -> None:
    stored = _stored(results)
    known = metrics_of(with_shares(stored.episodes, stored.units)[0])
    if metric not in known:
        raise ValueError(f"no metric '{metric}' in {stored.path}; there are {', '.join(known)}")


def _label(results: Results, metric: str) -> str:
    """A metric and its unit, where its meaning begins with one."""
    meaning = _stored(results).units.get(metric, "")
    first = meaning.replace(",", ";").partition(";")[0].strip()
    name = metric.replace("_", " ")
    return f"{name}, {first}" if describe(metric, meaning).kind == "mean" and 0 < len(first) <= 8 else name
