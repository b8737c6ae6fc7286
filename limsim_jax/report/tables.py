"""Tables of a sweep: every metric with its interval, a short list of the main ones, the worst seeds, CSV.

The seed is the unit. Shares (metrics that are 0 or 1) have Wilson's interval; means have the BCa bootstrap
(Efron 1987) over seeds, seeded, so that the same results give the same table; crashes per distance have
the exact interval of a Poisson rate (Garwood 1936); medians have that of order statistics (Conover 1999,
3.2). A metric that was not measured in an episode is null there: it is left out, and `measured` says of
how many seeds the rest speaks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from limsim_jax.metrics.blame import Responsibility
from limsim_jax.metrics.catalog import DERIVED, describe, headlines
from limsim_jax.metrics.description import Kind
from limsim_jax.report.formats import estimate_text
from limsim_jax.statistics import (
    check_level,
    mean_intervals,
    median_interval,
    poisson_rate,
    wilson,
    zero_event_bound,
)

if TYPE_CHECKING:
    from limsim_jax.sweeps.store import Results

Floats = NDArray[np.float64]
Group = tuple[str, str]
"""Scenario and policy."""

KEYS = ("scenario", "policy", "seed", "ego", "digest")
"""Columns of episodes that are no metrics."""

CRASH_RATE = "crashes_per_1000_km"
AT_FAULT_RATE = "at_fault_crashes_per_1000_km"

_SHARES = {x.name: (x.of, x.meaning) for x in DERIVED if x.kind == "proportion"}
"""Shares that follow from metrics: an episode counts once, however many bodies it touched."""

RATES = {x.name: (x.of, x.meaning) for x in DERIVED if x.kind == "rate"}
"""Rates per distance: the metric that counts the events, and the meaning."""


class Main(NamedTuple):
    """A metric of the short list."""

    metric: str
    label: str
    statistic: Literal["estimate", "median"] = "estimate"
    unit: str = ""
    scale: float = 1.0
    plain: bool = False
    rare: bool = False


MAIN = tuple(Main(x.name, *x.headline[1:]) for x in headlines() if x.headline)
"""The short list, in order."""

COMPARED = (
    "success", "had_contact", "had_at_fault_contact", CRASH_RATE, "had_near_miss", "left_road",
    "ran_red_light", "min_ttc", "nuplan_score", "carla_score", "limsim_corrected_total",
)  # fmt: skip
"""Metrics that a comparison tells first, in order."""


def groups(results: Results) -> dict[Group, pa.Table]:
    """Episodes of each (scenario, policy), sorted by seed.

    Raises `ValueError` if there are none.
    """
    table = results.episodes
    if not table.num_rows:
        raise ValueError(f"{results.path} holds no finished episodes")
    pairs = table.select(["scenario", "policy"]).group_by(["scenario", "policy"]).aggregate([])
    found = {(row["scenario"], row["policy"]) for row in pairs.to_pylist()}
    order = [group for group in results.provenance if group in found]
    order += sorted(found - set(order))
    parts = {}
    for scenario, policy in order:
        rows = (pc.field("scenario") == scenario) & (pc.field("policy") == policy)
        part = table.filter(rows).sort_by([("seed", "ascending"), ("ego", "ascending")])
        names = results.provenance.get((scenario, policy), {}).get("policies")
        if names is None:
            parts[scenario, policy] = part
        for k, name in enumerate(names or ()):  # each ego has a policy of its own
            parts[scenario, ego_label(name, k)] = part.filter(pc.field("ego") == k)
    return parts


def ego_label(policy: str, number: int) -> str:
    """Name of the policy of one of several egos in tables."""
    return f"{policy} (ego {number})"


def provenance_of(results: Results, group: Group) -> dict[str, Any]:
    """How the rows of a group were made; empty if that is not known."""
    if group in results.provenance:
        return results.provenance[group]
    for (scenario, _), about in results.provenance.items():
        for k, (name, known) in enumerate(
            zip(about.get("policies", ()), about.get("each_knows", ()), strict=True)
        ):
            if (scenario, ego_label(name, k)) == group:
                return about | {"knows": known}
    return {}


def columns(episodes: pa.Table, names: Sequence[str]) -> Floats:
    """Columns as `[rows, names]`, NaN where not measured."""
    values = np.full((episodes.num_rows, len(names)), np.nan)
    for k, name in enumerate(names):
        column = episodes[name].cast(pa.float64())
        found = column.fill_null(math.nan).to_numpy()
        values[:, k] = np.where(np.isfinite(found), found, np.nan)
    return values


def metrics_of(episodes: pa.Table) -> list[str]:
    """Names of the metrics among the columns."""
    return [name for name in episodes.column_names if name not in KEYS]


def with_shares(episodes: pa.Table, units: Mapping[str, str]) -> tuple[pa.Table, dict[str, str]]:
    """Episodes with the shares that follow from their metrics, and all units."""
    units = dict(units)
    for name, (source, meaning) in _SHARES.items():
        if source in episodes.column_names and name not in episodes.column_names:
            count = columns(episodes, [source])[:, 0]
            happened = pa.array(np.where(np.isnan(count), np.nan, count > 0), from_pandas=True)
            episodes = episodes.append_column(name, happened)
            units[name] = meaning
    return episodes, units


def better(metric: str, meaning: str = "") -> int:
    """1: more is better, -1: less is better, 0: neither.

    `meaning`: of an own metric, as results keep it.
    """
    return describe(metric, meaning).sign


_SCHEMA = pa.schema(
    [
        ("scenario", pa.string()),
        ("policy", pa.string()),
        ("metric", pa.string()),
        ("meaning", pa.string()),
        ("kind", pa.string()),
        ("seeds", pa.int64()),
        ("measured", pa.int64()),
        *((name, pa.float64()) for name in ("estimate", "lower", "upper", "bound", "minimum")),
        *((name, pa.float64()) for name in ("median", "median_lower", "median_upper", "maximum")),
    ]
)


def summary(results: Results, *, level: float = 0.95) -> pa.Table:
    """One row per (scenario, policy, metric).

    Columns: scenario, policy, metric, meaning, kind ("proportion", "mean", "rate"), seeds, measured
    (seeds in which there was a value: the others are left out), estimate with lower and upper at
    `level`, bound, minimum, median with median_lower and median_upper, maximum. What does not exist
    is null. Metrics that are labels (a slot, a type) are not summarised.

    `bound`: where nothing happened in any measured episode, the one-sided bound on the share of episodes
    in which it does (1 - (1 - level)^(1/n)); for rates, on the rate. Where a 0/1 metric was 1 in all, how
    low its share may be.

    Raises `ValueError` for no episodes or a level outside (0, 1).
    """
    check_level(level)
    rows: list[dict[str, Any]] = []
    for (scenario, policy), part in groups(results).items():
        part, units = with_shares(part, results.units)
        names = [name for name in metrics_of(part) if describe(name, units.get(name, "")).kind != "label"]
        values = columns(part, names)
        kinds = [_kind(name, units.get(name, ""), values[:, k]) for k, name in enumerate(names)]
        means = [k for k, kind in enumerate(kinds) if kind == "mean"]
        intervals = dict(zip(means, mean_intervals(values[:, means], level=level), strict=True))
        for k, (name, kind) in enumerate(zip(names, kinds, strict=True)):
            x = values[:, k]
            x = x[~np.isnan(x)]
            row: dict[str, Any] = dict(scenario=scenario, policy=policy, metric=name, kind=kind)
            row |= dict(meaning=units.get(name, ""), seeds=len(values), measured=x.size)
            if x.size:
                found = wilson(int(x.sum()), x.size, level) if kind == "proportion" else intervals[k]
                row |= dict(zip(("estimate", "lower", "upper"), found, strict=True))
                row["bound"] = _bound(x, kind, level)
                row |= dict(minimum=x.min(), maximum=x.max())
                names_of_median = ("median", "median_lower", "median_upper")
                row |= dict(zip(names_of_median, median_interval(x, level), strict=True))
            rows.append(row)
        rows += [
            dict(scenario=scenario, policy=policy, **row) for row in _rates(part, level) if row is not None
        ]
    clean = [{name: null(row.get(name)) for name in _SCHEMA.names} for row in rows]
    return pa.Table.from_pylist(clean, _SCHEMA)


def _kind(name: str, meaning: str, x: Floats) -> Kind:
    kind = describe(name, meaning).kind
    fits = np.isin(x[~np.isnan(x)], (0.0, 1.0)).all()
    return "mean" if kind == "proportion" and not fits else kind


def null(value: Any) -> Any:
    """None for NaN."""
    return None if isinstance(value, float) and math.isnan(value) else value


def _bound(x: Floats, kind: str, level: float) -> float | None:
    if not x.any():
        return zero_event_bound(x.size, level)
    if kind == "proportion" and x.all():
        return 1 - zero_event_bound(x.size, level)
    return None


def _rates(part: pa.Table, level: float) -> list[dict[str, Any]]:
    rows = []
    for name, (source, meaning) in RATES.items():
        if not {source, "distance"} <= set(part.column_names):
            continue
        events, distance = columns(part, [source, "distance"]).T
        measured = ~np.isnan(events) & ~np.isnan(distance)
        row: dict[str, Any] = dict(metric=name, meaning=meaning, kind="rate")
        row |= dict(seeds=len(events), measured=int(measured.sum()))
        thousands = float(distance[measured].sum()) / 1e6
        if thousands > 0:
            count = int((events[measured] > 0).sum())
            row |= dict(
                zip(("estimate", "lower", "upper"), poisson_rate(count, thousands, level), strict=True)
            )
            row["bound"] = -math.log1p(-level) / thousands if count == 0 else None
        rows.append(row)
    return rows


class TextTable(NamedTuple):
    """A table to print; notebooks show it as one."""

    header: list[str]
    rows: list[list[str]]
    notes: list[str]

    def _repr_markdown_(self) -> str:
        marks = ["---", *["---:"] * (len(self.header) - 1)]
        lines = [" | ".join(cells).join(("| ", " |")) for cells in (self.header, marks, *self.rows)]
        return "\n".join([*lines, "", *(f"{note}  " for note in self.notes)])

    def __str__(self) -> str:
        rows = [self.header, *self.rows]
        widths = [max(len(row[k]) for row in rows) for k in range(len(self.header))]
        lines = [
            "  ".join(
                x.rjust(n) if k else x.ljust(n) for k, (x, n) in enumerate(zip(row, widths, strict=True))
            )
            for row in rows
        ]
        rule = "-" * (sum(widths) + 2 * (len(widths) - 1))
        return "\n".join([lines[0].rstrip(), rule, *(line.rstrip() for line in lines[1:]), "", *self.notes])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        def row(cells: Sequence[str], tag: str) -> str:
            inner = (
                f'<{tag} style="text-align: {"right" if k else "left"}">{escape(x)}</{tag}>'
                for k, x in enumerate(cells)
            )
            return f"<tr>{''.join(inner)}</tr>"

        head, body = row(self.header, "th"), "".join(row(cells, "td") for cells in self.rows)
        notes = "".join(f"<div>{escape(note)}</div>" for note in self.notes)
        return f"<table><thead>{head}</thead><tbody>{body}</tbody></table>{notes}"


def headline(results: Results, *, level: float = 0.95, table: pa.Table | None = None) -> TextTable:
    """The main metrics as text: a label, then "estimate [lower, upper]" for every (scenario, policy).

    Rows without any value are left out. `table`: the summary, if there is one already.
    """
    found = lookup(summary(results, level=level) if table is None else table)
    order = list(dict.fromkeys((scenario, policy) for scenario, policy, _ in found))
    several = len({policy for _, policy in order}) > 1
    header = ["", *(f"{scenario} / {policy}" if several else scenario for scenario, policy in order)]
    rows = [["seeds", *(f"{max(r['seeds'] for g, r in found.items() if g[:2] == o):,}" for o in order)]]
    told = [knows(results, group) for group in order]
    if any(told):
        rows.append([KNOWS, *told])
    for main in short_list(found):
        cells = [cell(main, found.get((*group, main.metric))) for group in order]
        if any(cells):
            label = f"{main.label}, {main.unit}" if main.unit else main.label
            rows.append([label, *cells])
    parts = groups(results)
    notes = [_causes_note(group, part, several) for group, part in parts.items()]
    notes = [note for note in notes if note] + demand_notes(parts)
    notes += [
        f"Brackets: {100 * level:g} % intervals over seeds: Wilson for shares, BCa bootstrap for means, "
        "exact for rates and medians."
    ]
    if any("(of " in text for row in rows for text in row):
        notes.append("(of n): measured in n episodes only; the others are not in the number.")
    if any("at least" in text or "at most" in text for row in rows for text in row):
        notes.append(
            f"At least, at most: one-sided {100 * level:g} % bounds for what happened in all or none."
        )
    return TextTable(header, rows, notes)


_OUTSIDE = 0.02  # share of the vehicles still outside, from which on it is said


def demand_notes(parts: Mapping[Group, pa.Table]) -> list[str]:
    """Scenarios whose roads or slots did not take the demand."""
    notes = {}
    for (scenario, _), part in parts.items():
        names = ["traffic_entered", "traffic_waiting", "traffic_full"]
        if scenario in notes or not set(names) <= set(part.column_names):
            continue
        entered, waiting, full = np.nanmean(columns(part, names), 0)
        if waiting > _OUTSIDE * (entered + waiting):
            why = "all slots were taken: more `slots` let them in" if full else "the roads took no more"
            notes[scenario] = (
                f"{scenario}: {waiting:,.0f} of {entered + waiting:,.0f} vehicles per episode were still "
                f"outside at the end; {why}."
            )
    return list(notes.values())


KNOWS = "knows of other vehicles"


def knows(results: Results, group: Group) -> str:
    """What the policy of a group knows: all, what it sees, or what its sensors give.

    Empty without an ego, and in results that do not say it.
    """
    words = {"state": "all", "view": "what it sees", "sensors": "what its sensors give"}
    return words.get(provenance_of(results, group).get("knows", ""), "")


def _causes_note(group: Group, part: pa.Table, several: bool) -> str:
    """How many episodes are without success, and why; empty where all have it."""
    cause = causes(part)
    total = int((cause != "").sum())
    if not total:
        return ""
    counted = [(int((cause == name).sum()), words) for name, words in CAUSES.items()]
    why = ", ".join(f"{n:,} {words}" for n, words in counted if n)
    label = f"{group[0]} / {group[1]}" if several else group[0]
    return f"{label}: {total:,} of {part.num_rows:,} without success: {why}."


def short_list(found: Mapping[tuple[str, str, str], Any]) -> list[Main]:
    """The main metrics of a summary.

    Those of plain traffic only where there is no ego, and those that are rare only where they happened.
    """
    plain = not any(metric == "success" for *_, metric in found)
    happened = {metric for (*_, metric), row in found.items() if row["maximum"]}
    return [main for main in MAIN if (plain or not main.plain) and (main.metric in happened or not main.rare)]


def lookup(table: pa.Table) -> dict[tuple[str, str, str], dict[str, Any]]:
    """Rows of a summary by scenario, policy and metric."""
    return {(row["scenario"], row["policy"], row["metric"]): row for row in table.to_pylist()}


def cell(main: Main, row: Mapping[str, Any] | None) -> str:
    """What the short list says of a row of the summary; empty if it was never measured."""
    if row is None or not row["measured"] or row[main.statistic] is None:
        return ""
    text = " ".join(filter(None, estimate_text(row, main.statistic, main.scale)))
    if row["measured"] < row["seeds"]:
        text += f" (of {row['measured']:,})"
    return text


_WORST_SCHEMA = pa.schema(
    [
        ("place", pa.int64()),
        ("scenario", pa.string()),
        ("policy", pa.string()),
        ("seed", pa.int64()),
        ("ego", pa.int32()),
        ("metric", pa.float64()),
        ("policy_failed", pa.bool_()),
        ("contact", pa.bool_()),
        ("at_fault", pa.bool_()),
        ("delta_v", pa.float64()),
        ("min_ttc", pa.float64()),
        ("left_road", pa.bool_()),
        ("failed", pa.bool_()),
        ("kind", pa.string()),
        ("time", pa.float64()),
        ("other", pa.int32()),
        ("value", pa.float64()),
        ("responsible", pa.string()),
        ("module", pa.string()),
        ("avoidable_by_ego", pa.bool_()),
        ("avoidable_by_other", pa.bool_()),
        ("reason", pa.string()),
    ]
)


def worst(results: Results, metric: str | None = None, k: int = 10) -> pa.Table:
    """The k worst episodes of all scenarios and policies, the worst first.

    In this order: episodes in which the policy failed; contacts at the ego's fault (by nuPlan's rules, or by
    responsibility, alone or shared), other contacts, both by delta-v; episodes off the road; episodes without
    success; the rest by the least TTC. With `metric`: by its value, without the episodes in which it was not
    measured.

    Columns: place, scenario, policy, seed, ego, metric (its value), policy_failed, contact, at_fault, delta_v
    (m/s), min_ttc (s), left_road, failed (no success), and of the episode's worst moment kind, time (s),
    other (slot), value, responsible, module, avoidable_by_ego, avoidable_by_other, reason.

    Raises `ValueError` for an unknown metric, or one of which neither more nor less is worse.
    """
    table, _ = with_shares(results.episodes, results.units)
    sign = 0
    if metric is not None:
        known = metrics_of(table)
        if metric not in known:
            raise ValueError(f"no metric '{metric}' in {results.path}; there are {', '.join(known)}")
        sign = better(metric, results.units.get(metric, ""))
        if not sign:
            raise ValueError(f"neither more nor less of '{metric}' is worse; name another metric")
    view = _severity(table)
    seeds = table["seed"].to_numpy()
    ranked = None if metric is None else columns(table, [metric])[:, 0]
    if metric is None or ranked is None:
        order = np.lexsort((seeds, view["min_ttc"], -view["failed"], -view["left_road"], -view["delta_v"],
                            -view["at_fault"], -view["contact"], -view["policy_failed"]))  # fmt: skip
    else:
        order = np.lexsort((seeds, sign * ranked))
        order = order[~np.isnan(ranked[order])]
    order = order[: max(k, 0)]
    chosen = table.select(["scenario", "policy", "seed", "ego"]).take(order).to_pylist()
    moments = first_moments(results, [episode_key(row) for row in chosen])
    rows = []
    for place, (i, row) in enumerate(zip(order, chosen, strict=True), 1):
        key = episode_key(row)
        row |= dict(place=place, metric=None if ranked is None else float(ranked[i]))
        flags = ("policy_failed", "contact", "at_fault", "left_road", "failed")
        row |= {name: bool(view[name][i]) for name in flags}
        row["delta_v"] = float(view["delta_v"][i]) if row["contact"] else None
        row["min_ttc"] = float(view["min_ttc"][i]) if np.isfinite(view["min_ttc"][i]) else None
        moment = moments.get(key, {})
        row |= {name: moment.get(name) for name in _WORST_SCHEMA.names[13:]}
        if row["time"] is None:
            when = view["contact_time"][i] if row["contact"] else view["min_ttc_time"][i]
            row["time"] = null(float(when))
        if row["responsible"] is None and row["contact"]:
            row["responsible"] = _RESPONSIBLE.get(int(view["responsible"][i]))
        rows.append(row)
    return pa.Table.from_pylist(rows, _WORST_SCHEMA)


_RESPONSIBLE = {
    int(party): party.name.lower() for party in Responsibility if party is not Responsibility.NONE
}


def _severity(table: pa.Table) -> dict[str, NDArray[Any]]:
    """Columns of the ranking; 0 (TTC inf, times NaN) where not measured."""

    def read(name: str, otherwise: float) -> Floats:
        if name not in table.column_names:
            return np.full(table.num_rows, otherwise)
        return np.nan_to_num(columns(table, [name])[:, 0], nan=otherwise)

    responsible = read("contact_responsibility", 0)
    involved = np.isin(responsible, (int(Responsibility.EGO), int(Responsibility.SHARED)))
    contact = read("contacts", 0) > 0
    return {
        "policy_failed": (read("policy_failed", 0) > 0) * 1.0,
        "contact": contact * 1.0,
        "at_fault": (contact & (involved | (read("at_fault_contacts", 0) > 0))) * 1.0,
        "delta_v": np.maximum(read("max_delta_v", 0), read("contact_delta_v", 0)) * contact,
        "left_road": (read("off_road", 0) > 0) * 1.0,
        "failed": (read("success", 1) == 0) * 1.0,
        "out_of_time": read("out_of_time", 0),
        "arrived": read("arrived", 0),
        "min_ttc": read("min_ttc", math.inf),
        "contact_time": read("contact_time", math.nan),
        "min_ttc_time": read("min_ttc_time", math.nan),
        "responsible": responsible,
    }


CAUSES: Mapping[str, str] = {
    "policy_failed": "the policy failed",
    "at_fault": "contact at the ego's fault",
    "contact": "other contact",
    "left_road": "off the road",
    "out_of_time": "out of time",
    "elsewhere": "left elsewhere than at its goal",
    "criteria": "arrived against the criteria of success",
}
"""Why an episode is without success, the first that holds, in words."""


def causes(part: pa.Table) -> NDArray[Any]:
    """The cause of each episode without success, of `CAUSES`; "" where there is success or it is unknown."""
    severity = {name: values > 0 for name, values in _severity(part).items()}
    severity |= {"elsewhere": ~severity["arrived"], "criteria": severity["arrived"]}
    cause = np.select([severity[name] for name in CAUSES], list(CAUSES), "")
    return np.where(severity["failed"], cause, "")


class Failure(NamedTuple):
    """A reason for which a policy failed."""

    group: Group
    reason: str
    seeds: list[int]
    episodes: int  # of the group

    @property
    def text(self) -> str:
        """As one line."""
        (scenario, policy), n = self.group, len(self.seeds)
        some = ", ".join(map(str, self.seeds[:6])) + (", ..." if n > 6 else "")
        return (
            f"policy {policy} failed in {n:,} of {self.episodes:,} episodes of {scenario}: {self.reason} "
            f"(seed{'s' if n > 1 else ''} {some})"
        )


def failed_policies(results: Results, parts: Mapping[Group, pa.Table] | None = None) -> list[Failure]:
    """Episodes in which the policy failed, by reason, most of them first.

    `parts`: the `groups` of the results, if they are known already.
    """
    rows = results.moments.filter(pc.field("kind") == "policy_failed").to_pylist()
    if not rows:
        return []
    parts = groups(results) if parts is None else parts
    found: dict[tuple[Group, str], list[int]] = {}
    for row in rows:
        key = (row["scenario"], row["policy"]), row["reason"] or ""
        found.setdefault(key, []).append(row["seed"])
    failures = [
        Failure(group, reason, sorted(set(seeds)), parts[group].num_rows)
        for (group, reason), seeds in found.items()
    ]
    return sorted(failures, key=lambda failure: -len(failure.seeds))


EpisodeKey = tuple[str, str, int, int]
"""Scenario, policy, seed and number of the ego."""


def episode_key(row: Mapping[str, Any]) -> EpisodeKey:
    """The episode that a row of any table is about."""
    return row["scenario"], row["policy"], row["seed"], row.get("ego") or 0


def first_moments(results: Results, episodes: Sequence[EpisodeKey]) -> dict[EpisodeKey, dict[str, Any]]:
    """The worst moment of each of these episodes that has one."""
    moments = results.moments
    if not episodes or not moments.num_rows:
        return {}
    wanted = set(episodes)
    rows = moments.filter(pc.field("seed").isin(sorted({seed for _, _, seed, _ in wanted})))
    found: dict[EpisodeKey, dict[str, Any]] = {}
    for row in rows.sort_by([("rank", "descending")]).to_pylist():
        key = episode_key(row)
        if key in wanted:
            found[key] = row
    return found


def write_csv(results: Results, folder: str | Path, *, table: pa.Table | None = None) -> list[Path]:
    """Write summary.csv, worst.csv (100), episodes.csv and moments.csv; returns their paths.

    `table`: the summary, if there is one already. Raises `OSError` if they cannot be written.
    """
    from pyarrow.csv import write_csv as write

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    tables = {
        "summary": summary(results) if table is None else table,
        "worst": worst(results, k=100).drop_columns(["metric"]),
        "episodes": results.episodes,
        "moments": results.moments,
    }
    paths = []
    for name, content in tables.items():
        path = folder / f"{name}.csv"
        write(content, str(path))
        paths.append(path)
    return paths
