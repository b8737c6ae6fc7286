"""Two policies, or two versions, on the same seeds: differences seed by seed.

A seed draws the same traffic whatever drives the ego (common random numbers), so that what the traffic does
to a metric cancels in the difference of two rows. Means: BCa bootstrap of the differences, and the paired
t-test. Shares: the same interval, and McNemar's test (1947) in its exact form, on the seeds in which one
succeeds and the other does not. p-values of one comparison are adjusted together by Holm (1979).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pyarrow as pa

from limsim_jax.metrics.catalog import describe
from limsim_jax.report.formats import number, number_text, p_text
from limsim_jax.report.tables import (
    COMPARED,
    RATES,
    Group,
    TextTable,
    better,
    columns,
    groups,
    metrics_of,
    null,
    provenance_of,
    with_shares,
)
from limsim_jax.statistics import (
    check_level,
    holm,
    mcnemar,
    mean_intervals,
    paired_t,
    rate_difference,
    rate_test,
)

if TYPE_CHECKING:
    from limsim_jax.sweeps.store import Results

_UNDER_TEST = {"name", "description", "ego.policy", "ego.options", "ego.driver"}
_VERSION = ("version", "source", "platform", "machine", "jax", "jaxlib")

_SCHEMA = pa.schema(
    [
        *((name, pa.string()) for name in ("scenario", "policy_a", "policy_b", "metric", "meaning", "kind")),
        *((name, pa.int64()) for name in ("pairs", "measured_a_only", "measured_b_only")),
        *((name, pa.float64()) for name in ("mean_a", "mean_b", "difference", "lower", "upper")),
        *((name, pa.int64()) for name in ("a_not_b", "b_not_a")),
        *((name, pa.float64()) for name in ("p", "p_adjusted")),
        ("better", pa.string()),
    ]
)


class Comparison(NamedTuple):
    """What differs between A and B.

    `table` has a row per scenario and metric: the main metrics first (`tables.COMPARED`), then the strongest
    evidence. Columns:

    - scenario, policy_a, policy_b, metric, meaning, kind ("mean", "proportion", "rate");
    - pairs (seeds in which both measured it), measured_a_only, measured_b_only (seeds left out);
    - mean_a and mean_b over the pairs, difference (B - A) with lower and upper;
    - for proportions a_not_b and b_not_a (seeds with 1 in one only);
    - p, and p_adjusted over all rows;
    - better: "A", "B", or null where neither more nor less is better, or where the evidence is weak
      (p_adjusted above 1 - level).
    """

    table: pa.Table
    notes: list[str]

    def text(self, k: int | None = None) -> TextTable:
        """Its main metrics to print, or its first `k` rows."""
        return comparison_text(self, k)

    def __str__(self) -> str:
        return str(self.text())

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return self.text()._repr_html_()


def compare(
    a: Results,
    b: Results | None = None,
    *,
    policies: tuple[str, str] | None = None,
    level: float = 0.95,
) -> Comparison:
    """Compare B with A, seed by seed, in their common scenarios.

    Args:
      a: results.
      b: other results; without them, two policies of `a`.
      policies: of A and of B. By default those of the same name, or where each has one only, that one.
      level: of the intervals.

    Raises:
      ValueError: nothing in common, or another map, demand or rule in A than in B; one line that names it.
    """
    check_level(level)
    b = a if b is None else b
    parts_a, parts_b = groups(a), groups(b)
    pairs = _pairs(a, b, parts_a, parts_b, policies)
    rows: list[dict[str, Any]] = []
    notes: list[str] = []
    for first, second in pairs:
        _check_same_world(a, b, first, second)
        notes += _version_notes(provenance_of(a, first), provenance_of(b, second), first[0])
        found, said = _compared(a, b, parts_a[first], parts_b[second], first, second, level)
        rows += found
        notes += said
    for row, p in zip(rows, holm([row["p"] for row in rows]), strict=True):
        row["p_adjusted"] = p
        sign = better(row["metric"], row["meaning"]) * float(np.sign(row["difference"]))
        row["better"] = {1: "B", -1: "A"}.get(int(sign)) if p <= 1 - level else None
    first_rows = {metric: place for place, metric in enumerate(COMPARED)}
    rows.sort(key=lambda row: (first_rows.get(row["metric"], len(COMPARED)), row["p"], -row.pop("strength")))
    left_out = sorted({s for s, _ in (*parts_a, *parts_b)} - {first[0] for first, _ in pairs})
    if left_out:
        notes.append(f"not in both, left out: {', '.join(left_out)}")
    clean = [{name: null(value) for name, value in row.items()} for row in rows]
    return Comparison(pa.Table.from_pylist(clean, _SCHEMA), list(dict.fromkeys(notes)))


def comparison_text(comparison: Comparison, k: int | None = None) -> TextTable:
    """The main metrics as text; with `k` so many rows: these, then the strongest evidence."""
    rows = comparison.table.to_pylist()
    if k is None:
        k = sum(row["metric"] in COMPARED for row in rows) or len(rows)
    rows = rows[:k]
    scenarios = {row["scenario"] for row in comparison.table.select(["scenario"]).to_pylist()}
    several = len(scenarios) > 1
    header = ["scenario"] * several + ["metric", "A", "B", "B - A", "seeds", "p", "p adjusted", "better"]
    lines = []
    for row in rows:
        seeds = f"{row['pairs']:,}"
        if row["a_not_b"] is not None:
            seeds += f" ({row['a_not_b']:,} A only, {row['b_not_a']:,} B only)"
        numbers = [number(row[name], 4) for name in ("mean_a", "mean_b")]
        difference = number_text(row["difference"], row["lower"], row["upper"])
        tests = [p_text(row[name]) for name in ("p", "p_adjusted")]
        scenario = [row["scenario"]] * several
        lines.append([*scenario, row["metric"], *numbers, difference, seeds, *tests, row["better"] or ""])
    rest = comparison.table.num_rows - len(rows)
    notes = [
        *comparison.notes,
        "better: only where p, adjusted for the number of all rows (Holm), is small.",
    ]
    notes += [f"{rest:,} more rows, by evidence: --rows {len(rows) + rest}"] if rest else []
    return TextTable(header, lines, notes)


def _pairs(
    a: Results,
    b: Results,
    parts_a: Mapping[Group, pa.Table],
    parts_b: Mapping[Group, pa.Table],
    policies: tuple[str, str] | None,
) -> list[tuple[Group, Group]]:
    same = a is b or a.path == b.path
    own = {s: [p for scenario, p in parts_a if scenario == s] for s, _ in parts_a}
    others = {s: [p for scenario, p in parts_b if scenario == s] for s, _ in parts_b}
    common = [scenario for scenario in own if scenario in others]
    if not common:
        raise ValueError(
            f"no scenario in common: {a.path} has {', '.join(own)}; {b.path} has {', '.join(others)}"
        )
    pairs: list[tuple[Group, Group]] = []
    for s in common:
        if policies is not None:
            chosen = [policies] if policies[0] in own[s] and policies[1] in others[s] else []
        elif same:
            chosen = [(own[s][0], own[s][1])] if len(own[s]) == 2 else []
        elif len(own[s]) == len(others[s]) == 1:
            chosen = [(own[s][0], others[s][0])]
        else:
            chosen = [(p, p) for p in own[s] if p in others[s]]
        pairs += [((s, first), (s, second)) for first, second in chosen]
    if not pairs:
        wanted = f"policies {policies[0]} and {policies[1]}" if policies else "no pair of policies"
        known = ", ".join(sorted({p for some in (*own.values(), *others.values()) for p in some}))
        if same and policies is None and all(len(found) == 1 for found in own.values()):
            raise ValueError(f"{a.path} holds one policy, {known}; give the results of another one, too")
        where = f"{a.path}" if same else f"{a.path} and {b.path}"
        raise ValueError(f"{wanted} to compare in {where}; name two of {known}")
    return pairs


def _check_same_world(a: Results, b: Results, first: Group, second: Group) -> None:
    """The same seed must be the same world, judged alike."""
    here, there = provenance_of(a, first), provenance_of(b, second)
    for part in ("map", "experiment"):
        own, other = _flat(here.get(part)), _flat(there.get(part))
        if part == "map" and "hash" in own and "hash" in other:
            own, other = {"hash": own["hash"]}, {"hash": other["hash"]}
        for field in sorted(own.keys() | other.keys()):
            free = part == "experiment" and any(f"{field}.".startswith(f"{name}.") for name in _UNDER_TEST)
            if not free and own.get(field) != other.get(field):
                name = ".".join(filter(None, (part, field)))
                raise ValueError(
                    f"{first[0]}: the same seed is not the same world: {name} is {_short(own.get(field))} in "
                    f"{a.path} ({first[1]}) and {_short(other.get(field))} in {b.path} ({second[1]})"
                )


def _flat(value: Any, name: str = "") -> dict[str, Any]:
    """A tree as dotted names to leaves."""
    if not isinstance(value, Mapping):
        return {} if value is None and not name else {name: value}
    found: dict[str, Any] = {}
    for key, inner in value.items():
        found |= _flat(inner, f"{name}.{key}" if name else str(key))
    return found


def _short(value: Any) -> str:
    text = "not set" if value is None else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _version_notes(here: Mapping[str, Any], there: Mapping[str, Any], scenario: str) -> list[str]:
    differ = [name for name in _VERSION if here.get(name) != there.get(name)]
    if not differ:
        return []
    text = ", ".join(f"{name} {_short(here.get(name))} and {_short(there.get(name))}" for name in differ)
    return [f"{scenario}: A and B were not made by the same program: {text}"]


_EGOS = 1 << 20  # more than egos in a world


def _compared(
    a: Results, b: Results, part_a: pa.Table, part_b: pa.Table, first: Group, second: Group, level: float
) -> tuple[list[dict[str, Any]], list[str]]:
    part_a, units = with_shares(part_a, a.units)
    part_b, _ = with_shares(part_b, b.units)
    seeds_a, seeds_b = (np.asarray(part["seed"].to_numpy()) for part in (part_a, part_b))
    keys = [part["seed"].to_numpy() * _EGOS + part["ego"].to_numpy() for part in (part_a, part_b)]
    seeds, at_a, at_b = np.intersect1d(*keys, return_indices=True)  # one key per seed and ego
    if not seeds.size:
        raise ValueError(
            f"{first[0]}: no seed in common: {seeds_a.min()} to {seeds_a.max()} in {a.path}, "
            f"{seeds_b.min()} to {seeds_b.max()} in {b.path}"
        )
    where = f"{first[0]}: {seeds.size:,} seeds in both"
    notes = []
    alone = (len(seeds_a) - seeds.size, len(seeds_b) - seeds.size)
    if any(alone):
        notes.append(f"{where}; left out {alone[0]:,} only in A and {alone[1]:,} only in B")
    same = int(np.sum(part_a["digest"].to_numpy()[at_a] == part_b["digest"].to_numpy()[at_b]))
    if same:
        notes.append(f"{where}; in {same:,} of them the two episodes are the same, bit by bit")
    common = [name for name in metrics_of(part_a) if name in part_b.column_names]
    names = [name for name in common if describe(name, units.get(name, "")).kind != "label"]
    x, y = columns(part_a, names)[at_a], columns(part_b, names)[at_b]
    intervals = mean_intervals(y - x, level=level)
    rows = []
    for k, name in enumerate(names):
        in_a, in_b = ~np.isnan(x[:, k]), ~np.isnan(y[:, k])
        both = in_a & in_b
        if not both.any():
            continue
        own, other = x[both, k], y[both, k]
        meaning = units.get(name, "")
        proportion = describe(name, meaning).kind == "proportion" and np.isin((own, other), (0, 1)).all()
        row: dict[str, Any] = dict(scenario=first[0], policy_a=first[1], policy_b=second[1], metric=name)
        row |= dict(meaning=meaning, kind="proportion" if proportion else "mean", pairs=own.size)
        row |= dict(measured_a_only=int((in_a & ~in_b).sum()), measured_b_only=int((in_b & ~in_a).sum()))
        row |= dict(mean_a=float(own.mean()), mean_b=float(other.mean()))
        row |= dict(zip(("difference", "lower", "upper"), intervals[k], strict=True))
        t, row["p"] = paired_t(other - own)
        row["strength"] = abs(t)
        if proportion:
            lost, won = int((own > other).sum()), int((other > own).sum())
            row |= dict(a_not_b=lost, b_not_a=won, p=mcnemar(lost, won))
        rows.append(row)
    rows += _rates(part_a.take(at_a), part_b.take(at_b), first, second, level)
    return rows, notes


def _rates(
    part_a: pa.Table, part_b: pa.Table, first: Group, second: Group, level: float
) -> list[dict[str, Any]]:
    """Crashes per distance, over the seeds in which both measured it."""
    rows = []
    for name, (source, meaning) in RATES.items():
        wanted = [source, "distance"]
        if not set(wanted) <= set(part_a.column_names) & set(part_b.column_names):
            continue
        values = np.stack([columns(part, wanted) for part in (part_a, part_b)])  # [2, seeds, 2]
        both = ~np.isnan(values).any((0, 2))
        events, distance = (values[:, both, 0] > 0) * 1.0, values[:, both, 1] / 1e6
        if not (both.any() and (distance.sum(1) > 0).all()):
            continue
        (own, other), (x, y) = distance, events
        row: dict[str, Any] = dict(scenario=first[0], policy_a=first[1], policy_b=second[1], metric=name)
        row |= dict(meaning=meaning, kind="rate", pairs=int(both.sum()), measured_a_only=0, measured_b_only=0)
        row |= dict(mean_a=x.sum() / own.sum(), mean_b=y.sum() / other.sum(), strength=0.0)
        found = rate_difference(x, own, y, other, level=level)
        row |= dict(zip(("difference", "lower", "upper"), found, strict=True))
        row["p"] = rate_test(int(x.sum()), own.sum(), int(y.sum()), other.sum())
        rows.append(row)
    return rows
