"""A self-contained page of a sweep: one HTML file, no network, light and dark, for desk and phone.

In this order:

1. what happened, and the worst crash;
2. the main metrics with intervals;
3. the worst seeds, each with pictures of its key moment, the responsible party, and its replay;
4. of scenario files, where variants pass in the space of parameters;
5. episodes without success by cause, key moments by kind;
6. metrics by scenario, where there are several columns;
7. distributions, all metrics, provenance.

The text stands in `page.html.j2`, which escapes every value.
"""

from __future__ import annotations

import base64
import contextlib
import importlib
import json
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from limsim_jax.files import write_whole
from limsim_jax.metrics.catalog import catalog, describe
from limsim_jax.metrics.description import SECTIONS
from limsim_jax.report.formats import estimate_text, number, with_bounds
from limsim_jax.report.page import charts
from limsim_jax.report.page.boundary import boundary
from limsim_jax.report.page.content import (
    Key,
    Names,
    card,
    failures,
    file_name,
    key_of,
    moments,
    notable,
    responsible_counts,
    verdict,
    worst_crash,
    worst_row,
)
from limsim_jax.report.tables import (
    KNOWS,
    Group,
    better,
    columns,
    demand_notes,
    groups,
    knows,
    lookup,
    provenance_of,
    short_list,
    summary,
    worst,
)
from limsim_jax.report.templates import read, render

if TYPE_CHECKING:
    from limsim_jax.sweeps.store import Results

Replayer = Callable[[str, str, Sequence[int]], Sequence[tuple[Any, ...]]]
"""(scenario, policy, seed) -> (network, lane_map, trace, slot of the ego, moments, ...)."""

PARTS = (
    "limsim_jax.report.pictures", "limsim_jax.report.viewer", "lxml.etree", "matplotlib.backends.backend_agg",
    "matplotlib.backends.backend_svg", "matplotlib.figure", "scipy.stats",
)  # fmt: skip
"""Modules that `write_report` imports once it needs them."""

Found = Mapping[tuple[str, str, str], dict[str, Any]]

LISTED = 40
"""Worst seeds in the table, with and without a picture."""

LEAD = 3.0
"""s before its key moment at which a replay opens."""


def get_ready() -> None:
    """Import all that `write_report` needs, for a thread beside other work.

    What is missing is told where it is needed."""
    for name in PARTS:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)


def write_report(
    results: Results,
    path: str | Path,
    *,
    replayer: Replayer | None = None,
    worst: int = 6,
    seconds: float = math.inf,
    say: Callable[[str], None] | None = None,
    level: float = 0.95,
    table: pa.Table | None = None,
) -> Path:
    """Write the page, and beside it `replays/SCENARIO-POLICY-SEED.html` of the worst episodes.

    Args:
      results: of a sweep.
      path: the .html file to write; its folder is made.
      replayer: regenerates episodes: (scenario, policy, seeds) -> a (network, lane_map, trace, slot of the
        ego, moments) of each, with metrics and answers of a model behind them where there are any. Without
        one there are neither pictures nor replays, only commands for them.
      worst: how many of the worst episodes to show with pictures.
      seconds: s, after which no further scenario or policy is replayed; the first one always is.
      say: called with a line before the replays of each.
      level: of the intervals.
      table: the summary at that level, if there is one already.

    Returns:
      The path.

    Raises:
      ValueError: no episodes.
      OSError: a file cannot be written.
    """
    path = Path(path)
    parts = groups(results)
    table = summary(results, level=level) if table is None else table
    path.parent.mkdir(parents=True, exist_ok=True)
    names = Names.of(parts, results)
    listed, shown = _worst_lists(results, max(worst, 0))
    cards, replays = _cards(shown, names, path, replayer, seconds, say)
    found = lookup(table)
    text = render(
        "page/page.html.j2",
        style=read("page/page.css"),
        script=read("page/page.js"),
        title=names.title,
        path=names.path,
        level=f"{100 * level:g} %",
        heads=[names.head(group) for group in parts],
        verdict=verdict(results, parts, {key_of(row) for row in shown}, names, level),
        episodes=[part.num_rows for part in parts.values()],
        main=_main(results, parts, found),
        demand=demand_notes(parts),
        cards=cards,
        listed=[worst_row(row, replays.get(key_of(row)), names) for row in listed],
        failures=failures(parts, replays),
        command=names.command(("SCENARIO", "POLICY"), "N"),
        boundary=boundary(results, parts, names, replays),
        moments=moments(results, parts),
        parties=responsible_counts(results, parts, names),
        scenarios=_by_scenario(parts, found, names) if len(parts) > 1 else [],
        distributions=_distributions(parts, names),
        legend=[names.label(group) for group in parts],
        sections=_all_metrics(parts, found),
        provenance=[_provenance(results, group, part, names) for group, part in parts.items()],
    )
    write_whole(path, text)
    return path


# --- the worst seeds


def _worst_lists(results: Results, shown: int) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """The table's rows, and those with pictures: the most severe crash is always among them."""
    listed = [row for row in worst(results, k=max(LISTED, shown)).to_pylist() if notable(row)]
    first = listed[:shown]
    hardest = worst_crash(results)
    if hardest is not None and first and all(key_of(row) != key_of(hardest) for row in first):
        first[-1] = hardest
    return listed, first


def _cards(
    shown: Sequence[Mapping[str, Any]],
    names: Names,
    path: Path,
    replayer: Replayer | None,
    seconds: float,
    say: Callable[[str], None] | None,
) -> tuple[list[dict[str, Any]], dict[Key, str]]:
    """Cards of the worst episodes, and the addresses of their replays."""
    cards, replays, start = [], {}, time.monotonic()
    again: dict[Group, dict[int, tuple[Any, ...]] | str] = {}  # replays by seed, or what went wrong
    written: list[Future[None]] = []
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for row in shown:
            group = row["scenario"], row["policy"]
            views, fault = [], ""
            in_time = not again or time.monotonic() - start < seconds
            if replayer is not None and (group in again or in_time):
                if group not in again:
                    seeds = [int(one["seed"]) for one in shown if (one["scenario"], one["policy"]) == group]
                    if say is not None:
                        say(f"replays of {group[0]}, {group[1]}: seeds {', '.join(map(str, seeds))}")
                    try:
                        again[group] = made = dict(zip(seeds, replayer(*group, seeds), strict=True))
                    except ValueError as error:  # what cannot be shown is no reason to lose the page
                        again[group] = str(error)
                    else:
                        written += _write_replays(pool, group, made, names, path)
                found = again[group]
                if isinstance(found, str):
                    fault = found
                else:
                    views, replays[key_of(row)], said = _shown(row, names, found[int(row["seed"])])
                    row = {**row, **said}
            cards.append(card(row, names, views=views, fault=fault, replay=replays.get(key_of(row))))
    for one in written:
        one.result()
    return cards, replays


def _write_replays(
    pool: Executor, group: Group, found: Mapping[int, tuple[Any, ...]], names: Names, path: Path
) -> list[Future[None]]:
    """Begin to write the replays of some seeds beside the page."""
    from limsim_jax.report.viewer import write_viewer

    folder = path.parent / "replays"
    folder.mkdir(parents=True, exist_ok=True)
    jobs = []
    for seed, (network, lane_map, trace, ego, marked, *more) in found.items():
        answers = more[1] if len(more) > 1 else ()
        jobs.append(
            pool.submit(
                write_viewer, folder / _replay_name(group, seed), network, lane_map, trace, ego=ego,
                moments=marked, title=_title(names, group, seed), answers=answers,
            )
        )  # fmt: skip
    return jobs


def _replay_name(group: Group, seed: int) -> str:
    return f"{file_name(group[0])}-{file_name(group[1])}-{seed}.html"


def _title(names: Names, group: Group, seed: int) -> str:
    return f"{names.label(group)}, seed {seed}"


def _shown(
    row: Mapping[str, Any], names: Names, replay: tuple[Any, ...]
) -> tuple[list[dict[str, str]], str, dict[str, Any]]:
    """Pictures of a key moment, the address of the replay, avoidability."""
    from limsim_jax.report.pictures import pictures

    network, lane_map, trace, ego, moments, *_ = replay
    group, seed = (row["scenario"], row["policy"]), int(row["seed"])
    title = _title(names, group, seed)
    views = [
        {
            "alt": f"{title}, {caption}",
            "caption": caption,
            "source": f"data:image/png;base64,{base64.b64encode(png).decode()}",
        }
        for caption, png in pictures(network, lane_map, trace, ego=ego, time=row["time"], other=row["other"])
    ]
    worst = next((m for m in moments if m["kind"] == row["kind"]), {})
    known = ("avoidable_by_ego", "avoidable_by_other", "module")
    found = {key: worst[key] for key in known if key in worst}
    at = "" if row["time"] is None else f"#t={max(row['time'] - LEAD, 0):.1f}"
    return views, f"replays/{quote(_replay_name(group, seed))}{at}", found


# --- metrics


def _main(results: Results, parts: Mapping[Group, pa.Table], found: Found) -> list[dict[str, Any]]:
    rows = []
    told = [knows(results, group) for group in parts]
    if any(told):
        cells = [{"value": words, "interval": "", "measured": None} if words else None for words in told]
        rows.append({"label": KNOWS, "unit": "", "cells": cells})
    for main in short_list(found):
        cells = []
        for group in parts:
            row = found.get((*group, main.metric))
            if row is None or not row["measured"] or row[main.statistic] is None:
                cells.append(None)
                continue
            value, interval = estimate_text(row, main.statistic, main.scale)
            few = row["measured"] if row["measured"] < row["seeds"] else None
            cells.append({"value": value, "interval": interval, "measured": few})
        if any(cells):
            rows.append({"label": main.label, "unit": main.unit, "cells": cells})
    return rows


def _by_scenario(parts: Mapping[Group, pa.Table], found: Found, names: Names) -> list[dict[str, Any]]:
    figures = []
    for main in short_list(found):
        prefix = "median_" if main.statistic == "median" else ""
        points = []
        for group in parts:
            row = found.get((*group, main.metric))
            if row is not None and row["measured"] and row[main.statistic] is not None:
                ends = (row[main.statistic], row[f"{prefix}lower"], row[f"{prefix}upper"])
                value, low, high = (None if x is None else main.scale * x for x in ends)
                points.append(charts.Point(names.label(group), value or 0.0, low, high))
        if points and any(point.value or (point.high or 0) > 0 for point in points):
            direction = {1: "more is better", -1: "less is better", 0: ""}[better(main.metric)]
            axis = ", ".join(filter(None, (main.unit, direction)))
            drawn = charts.intervals(points, axis, f"{main.label} by scenario")
            figures.append({"label": main.label, "note": "", "svg": drawn})
    return figures


def _distributions(parts: Mapping[Group, pa.Table], names: Names) -> list[dict[str, Any]]:
    figures = []
    labels = [names.label(group) for group in parts]
    plotted = [(x.name, *x.plot) for x in catalog() if x.plot is not None]
    for metric, label, unit in plotted:
        samples, missing, total = [], 0, 0
        for part in parts.values():
            x = columns(part, [metric])[:, 0] if metric in part.column_names else np.empty(0)
            total += part.num_rows
            missing += part.num_rows - int((~np.isnan(x)).sum())
            samples.append(np.sort(x[~np.isnan(x)]))
        if not any(x.size > 1 for x in samples):
            continue
        note = f"not measured in {missing:,} of {total:,} episodes" if missing else ""
        drawn = charts.distributions(samples, labels, unit, f"Distribution: {label}")
        figures.append({"label": label, "note": note, "svg": drawn})
    return figures


def _all_metrics(parts: Mapping[Group, pa.Table], found: Found) -> list[dict[str, Any]]:
    """Titles of sections, and their metrics."""
    sections: dict[str, list[dict[str, Any]]] = {title: [] for title in SECTIONS}
    for metric in dict.fromkeys(metric for *_, metric in found):
        of_groups = [found.get((*group, metric)) for group in parts]
        meaning = next((row["meaning"] for row in of_groups if row is not None), "")
        row = {"metric": metric, "meaning": meaning, "cells": [_full_cell(row) for row in of_groups]}
        sections[describe(metric, meaning).section].append(row)
    return [{"title": title, "rows": rows} for title, rows in sections.items() if rows]


def _full_cell(row: Mapping[str, Any] | None) -> dict[str, Any] | None:
    if row is None:
        return None
    if not row["measured"] or row["estimate"] is None:
        return {"value": None}
    scale, unit = (100.0, " %") if row["kind"] == "proportion" else (1.0, "")
    value, interval = with_bounds(row["estimate"], row["lower"], row["upper"], scale)
    if row["bound"] is not None and row["kind"] != "mean":
        value, interval = estimate_text(row, scale=scale)
    span = (
        [number(row[name], 4) for name in ("minimum", "median", "maximum")] if row["kind"] == "mean" else []
    )
    few = f"{row['measured']:,} of {row['seeds']:,}" if row["measured"] < row["seeds"] else None
    return {"value": f"{value}{unit}", "interval": interval, "span": span, "measured": few}


# --- provenance


def _provenance(results: Results, group: Group, part: pa.Table, names: Names) -> dict[str, Any]:
    facts = [("seeds", _seeds(part["seed"].to_numpy()), False)]
    facts += [(str(k), *_fact(v)) for k, v in provenance_of(results, group).items()]
    return {"label": names.label(group), "facts": facts}


def _seeds(seeds: NDArray[Any]) -> str:
    first, last = int(seeds.min()), int(seeds.max())
    whole = last - first + 1 == len(seeds)
    return f"{first} to {last}" if whole else f"{len(seeds):,} from {first} to {last}"


def _fact(value: Any) -> tuple[str, bool]:
    """A fact as text, and whether its line breaks matter."""
    if isinstance(value, (dict, list, tuple)):
        return json.dumps(value, indent=1, ensure_ascii=False, default=str), True
    text = str(value)
    return text.strip(), "\n" in text
