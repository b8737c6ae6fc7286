"""The page of an exposure: heat maps of pairs, cells not covered, seeds that reach cells."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from limsim_jax.files import write_whole
from limsim_jax.report.formats import number, number_text
from limsim_jax.report.page.charts import curve
from limsim_jax.report.templates import read, render
from limsim_jax.sweeps.exposure import RARE, WAYS, Exposure, Visit

LEAST_SHARE = 1e-4
"""Share of the time from which on cells of heat maps get darker, by its logarithm."""

DARKEST = 60
"""Per cent of colour of a cell with all of the time: its number stays legible."""

LEAD = 2.0
"""s that a replay starts before a cell is reached."""

MOST_ROWS = 200
"""Rows of the tables of rare cells and of seeds; `exposure.json` has all."""


def write_page(path: Path, found: Exposure, replays: Mapping[int, str] | None = None) -> Path:
    """Write the page.

    Args:
      path: of the page.
      found: the exposure.
      replays: paths of replays from the page, by seed.
    """
    parts = list(found.parts())
    text = render(
        "page/exposure.html.j2",
        title=f"Exposure of {found.scenario}, {found.policy}",
        about=_about(found),
        coverage=_coverage(found),
        growth=_growth(found),
        margins=[_margin(part) for part in found.parts(1)],
        maps=[_heat_map(part) for part in parts] if len(found.domain.names) >= WAYS else [],
        searched=0 if found.more is None else len(found.more.seeds),
        missing=[_missing(part) for part in parts],
        whole=len(found.uncovered(searched=False)) if len(found.domain.names) > WAYS else 0,
        rare=_rare(parts, replays or {}),
        rare_worlds=RARE,
        cover=_cover(found, replays or {}),
        most=MOST_ROWS,
        style=read("page/page.css"),
    )
    write_whole(path, text.encode())
    return path


def _about(found: Exposure) -> str:
    worlds = len(found.seeds)
    return (
        f"{worlds:,} world{'s' if worlds != 1 else ''}, {found.total / 3600:.2f} h of driving, "
        f"counted every {found.dt:g} s."
    )


def _coverage(found: Exposure) -> list[tuple[str, str]]:
    """Names and values: what is covered, what further seeds would bring."""
    unseen = found.unseen()
    covered, all_ = int(found.covered.sum()), int((found.possible | found.covered).sum())
    names = len(found.domain.names)
    rows = [(f"cells of all {names} dimensions", f"{covered:,} of {all_:,}")]
    if names > WAYS:
        done, every = found.pairs()
        rows.append(("cells of all pairs of dimensions", f"{done:,} of {every:,}"))
    share = "-" if np.isnan(unseen.share) else f"{number(100 * unseen.share, 2)} %"
    rows += [
        ("time of a further seed in cells that are new", share),
        ("new cells of a further seed", number(unseen.cells, 2)),
    ]
    if found.more is not None:
        rows.append((f"cells that {len(found.more.seeds):,} further seeds add", f"{len(found.reached()):,}"))
    return rows


def _growth(found: Exposure) -> Any:
    seeds, cells = found.growth()
    return curve(seeds, cells, "seeds", "cells covered", "Cells covered by seeds, on average")


def _margin(part: Exposure) -> dict[str, Any]:
    """Time of the bins of a dimension."""
    (dimension,) = part.domain.dimensions
    shares, rows = part.shares(), []
    for k, name in enumerate(dimension.bins):
        seconds, worlds = float(part.seconds[k]), int(part.worlds[k])
        if not worlds and not part.possible[k]:
            continue
        estimate, low, high = shares[k]
        bounds = (None, None) if np.isnan(low) else (low, high)
        share = number_text(estimate, *bounds, scale=100) if worlds else ""
        rows.append({"name": name, "seconds": number(seconds), "share": share, "worlds": worlds,
                     "wide": f"{100 * estimate:.1f}"})  # fmt: skip
    return {"title": dimension.title, "rows": rows}


def _heat_map(part: Exposure) -> dict[str, Any]:
    """Two dimensions: the longer across."""
    rows, columns = part.domain.dimensions
    seconds, worlds, possible = part.seconds, part.worlds, part.possible.reshape(part.domain.shape)
    searched = {tuple(x.cell.values()): x.seed for x in part.reached()}
    known = part.visits_by_cell()
    lines = []
    for i, row in enumerate(rows.bins):
        cells = []
        for j, column in enumerate(columns.bins):
            place = f"{rows.name} {row}, {columns.name} {column}"
            if worlds[i, j]:
                share = float(seconds[i, j]) / part.total
                depth = 1 - np.log10(max(share, LEAST_SHARE)) / np.log10(LEAST_SHARE)
                seeds = ", ".join(str(x.seed) for x in known[i * columns.size + j][:RARE])
                cells.append({
                    "kind": "rare" if worlds[i, j] <= RARE else "seen",
                    "text": _short(float(seconds[i, j])), "depth": f"{4 + (DARKEST - 4) * depth:.0f}%",
                    "said": f"{place}: {number(float(seconds[i, j]))} s, {number(100 * share, 2)} %, "
                    f"{worlds[i, j]:,} worlds, seeds {seeds}{' ...' if worlds[i, j] > RARE else ''}",
                })  # fmt: skip
            elif not possible[i, j]:
                cells.append({"kind": "never", "text": "", "depth": "0%", "said": f"{place}: impossible"})
            elif (row, column) in searched:
                seed = searched[row, column]
                said = f"{place}: reached by the search, seed {seed}"
                cells.append({"kind": "searched", "text": f"seed {seed}", "depth": "0%", "said": said})
            else:
                cells.append({"kind": "open", "text": "0", "depth": "0%", "said": f"{place}: not covered"})
        lines.append({"name": row, "cells": cells})
    kept = [x for x in lines if any(cell["kind"] != "never" for cell in x["cells"])]
    there = [j for j in range(columns.size) if any(x["cells"][j]["kind"] != "never" for x in kept)]
    for line in kept:
        line["cells"] = [line["cells"][j] for j in there]
    names = [columns.bins[j] for j in there]
    return {"title": f"{rows.title} and {columns.title}", "columns": names, "rows": kept,
            "across": columns.title, "down": rows.title}  # fmt: skip


def _short(seconds: float) -> str:
    """Seconds in few letters."""
    if seconds < 9.95:
        return f"{seconds:.1f}"
    return f"{seconds:.0f}" if seconds < 9999.5 else f"{seconds / 1000:.0f}k"


def _missing(part: Exposure) -> dict[str, Any]:
    """Cells of a pair that no seed covers, and what searches found."""
    searched = {tuple(x.cell.values()): (x.seed, x.time) for x in part.reached()}
    rows = []
    for cell in part.uncovered(searched=False):
        seed = searched.get(tuple(cell.values()))
        rows.append([*cell.values(), "" if seed is None else f"seed {seed[0]} at {seed[1]:.1f} s"])
    title = " and ".join(x.title for x in part.domain.dimensions)
    many = int((part.possible | part.covered).sum())
    return {"title": title, "head": part.domain.names, "rows": rows, "many": many}


def _rare(parts: list[Exposure], replays: Mapping[int, str]) -> list[dict[str, Any]]:
    """Cells of pairs that few worlds reach."""
    rows = []
    for part in parts:
        for cell, visits in part.rare():
            words = ", ".join(f"{name} {value}" for name, value in cell.items())
            rows.append((len({x.seed for x in visits}), words, visits))
    rows.sort(key=lambda x: x[0])
    return [
        {"words": words, "seconds": number(sum(x.seconds for x in visits)),
         "visits": [_linked(x, replays) for x in visits]}
        for _, words, visits in rows
    ]  # fmt: skip


def _linked(visit: Visit, replays: Mapping[int, str]) -> dict[str, str]:
    link = replays.get(visit.seed)
    at = "" if link is None else f"{link}#t={max(visit.time - LEAD, 0):.1f}"
    return {"text": f"seed {visit.seed} at {visit.time:.1f} s", "link": at}


def _cover(found: Exposure, replays: Mapping[int, str]) -> dict[str, Any]:
    """Seeds that together cover all that all seeds cover."""
    pairs, rows, total = found.cover(WAYS), [], 0
    for seed, adds in pairs:
        total += adds
        rows.append({"seed": seed, "adds": adds, "total": total, "link": replays.get(seed, "")})
    return {"rows": rows, "whole": len(found.cover()), "seeds": len(found.seeds)}
