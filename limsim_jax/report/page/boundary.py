"""Where variants of a scenario pass: maps over pairs of its parameters, and the worst variants."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from limsim_jax.report.page.content import Key, Names
from limsim_jax.report.tables import Group, columns
from limsim_jax.scenarios.openscenario.outcome import Variants, variants

if TYPE_CHECKING:
    import pyarrow as pa
    from markupsafe import Markup

    from limsim_jax.sweeps.store import Results

MAPS = 12
"""Maps of a scenario and policy, at most: those that tell most."""

CELLS = 12
"""Cells along an axis, at most; more values are put together."""

WORST = 5
"""Variants that are listed, at most."""

OPEN = 3
"""Scenarios and policies with failures up to which all are shown at once."""

_WIDTH, _LEFT, _BOTTOM, _TOP = 340.0, 74.0, 42.0, 4.0
_CELL = 21.0  # units up
_LETTER = 6.2  # units of a letter across


class Axis(NamedTuple):
    """A parameter that varies, in cells."""

    name: str
    cell: NDArray[np.int64]  # of each variant
    labels: tuple[str, ...]  # of the cells
    texts: bool  # the values are texts


def boundary(
    results: Results, parts: Mapping[Group, pa.Table], names: Names, replays: Mapping[Key, str]
) -> list[dict[str, Any]]:
    """Maps and worst variants of each scenario file and policy.

    Args:
      results: of a sweep.
      parts: rows by scenario and policy.
      names: how these are written.
      replays: addresses of replays.
    """
    found = [_one(group, one, parts[group], names, replays) for group, one in variants(results).items()]
    few = sum(not one["plain"] for one in found) <= OPEN
    return [one | {"open": few and not one["plain"]} for one in found]


def _one(
    group: Group, one: Variants, part: pa.Table, names: Names, replays: Mapping[Key, str]
) -> dict[str, Any]:
    count, passed = len(one.seed), int(one.passed.sum())
    said = f"{passed:,} of {count:,} variants pass, {int(one.collided.sum()):,} collide"
    if one.preventable is not None:
        said += f", {int(one.preventable.sum()):,} of these preventable"
    plain = passed in (0, count)
    along = axes(one)
    pairs: list[tuple[Axis, Axis | None]] = list(itertools.combinations(along, 2))
    if len(along) == 1:
        pairs = [(along[0], None)]
    pairs.sort(key=lambda pair: -telling(one.passed, *pair))
    shown = [] if plain else pairs[:MAPS]
    return {
        "label": names.label(group),
        "said": said,
        "plain": plain,
        "maps": [
            {"label": x.name if y is None else y.name, "over": "" if y is None else x.name,
             "svg": drawing(one, x, y)}
            for x, y in shown
        ],
        "more": 0 if plain else len(pairs) - len(shown),
        "worst": _worst(group, one, part, names, replays),
    }  # fmt: skip


def axes(one: Variants) -> list[Axis]:
    """Parameters that vary among these variants."""
    found = []
    for name, values in one.parameters.items():
        if np.isnan(values).any():
            continue
        distinct, cell = np.unique(values, return_inverse=True)
        if len(distinct) < 2:
            continue
        words = one.words.get(name)
        if words is None and len(distinct) > CELLS:
            edges = np.linspace(distinct[0], distinct[-1], CELLS + 1)
            cell = np.clip(np.searchsorted(edges, values, "right") - 1, 0, CELLS - 1)
            labels = tuple(f"{x:.3g}…" for x in edges[:-1])
        else:
            labels = tuple(f"{x:g}" if words is None else Path(words[int(x)]).stem for x in distinct)
        found.append(Axis(name, cell.astype(np.int64), labels, words is not None))
    return found


def counts(marked: NDArray[np.bool_], x: Axis, y: Axis | None) -> NDArray[np.int64]:
    """Variants that are marked, by cells of `y` and `x`."""
    rows = 1 if y is None else len(y.labels)
    flat = x.cell if y is None else y.cell * len(x.labels) + x.cell
    return np.bincount(flat[marked], minlength=rows * len(x.labels)).reshape(rows, len(x.labels))


def telling(passed: NDArray[np.bool_], x: Axis, y: Axis | None = None) -> float:
    """Share of the variance of passing that cells explain, adjusted."""
    total, good = counts(np.ones_like(passed), x, y), counts(passed, x, y)
    there = total > 0
    share, mean = good[there] / total[there], passed.mean()
    cells, number = int(there.sum()), len(passed)
    if number <= cells or mean in (0, 1):
        return 0.0
    explained = float((total[there] * (share - mean) ** 2).sum() / (number * mean * (1 - mean)))
    return 1 - (1 - explained) * (number - 1) / (number - cells)


def drawing(one: Variants, x: Axis, y: Axis | None) -> Markup:
    """A map as SVG: the darker a cell, the more of its variants fail.

    A cell has the number of failures, and a frame if any of them is preventable.
    """
    from markupsafe import Markup

    every = np.ones_like(one.passed)
    total, failed = counts(every, x, y), counts(~one.passed, x, y)
    prevented = counts(every if one.preventable is None else one.preventable, x, y)
    prevented = prevented * (one.preventable is not None)
    rows, wide = total.shape
    left = _LEFT if y is not None else 4.0
    size = (_WIDTH - left - 4) / wide
    bottom = _TOP + rows * _CELL
    parts = []
    for row, column in itertools.product(range(rows), range(wide)):
        at, up = left + column * size, bottom - (row + 1) * _CELL
        if not total[row, column]:
            continue
        share = failed[row, column] / total[row, column]
        where = f"{x.name} {x.labels[column]}" + ("" if y is None else f", {y.name} {y.labels[row]}")
        told = f"{where}: {failed[row, column]} of {total[row, column]} fail"
        told += f", {prevented[row, column]} preventable" if prevented[row, column] else ""
        frame = "stroke:var(--ego);stroke-width:2" if prevented[row, column] else "stroke:var(--line)"
        parts.append(
            f'<g><title>{escape(told)}</title><rect x="{at + 1:.1f}" y="{up + 1:.1f}" '
            f'width="{size - 2:.1f}" height="{_CELL - 2:.1f}" style="fill:color-mix(in srgb,'
            f'var(--c5) {100 * share:.0f}%,var(--panel));{frame}"/>'
        )
        if failed[row, column]:
            ink = "var(--paper)" if share > 0.5 else "currentColor"
            parts.append(
                f'<text x="{at + size / 2:.1f}" y="{up + _CELL / 2 + 4:.1f}" '
                f'style="fill:{ink};font-size:11px;text-anchor:middle">{failed[row, column]}</text>'
            )
        parts.append("</g>")
    if y is not None:
        parts += [
            _text(left - 5, bottom - (k + 0.5) * _CELL + 4, _short(label, left - 8), "end")
            for k, label in enumerate(y.labels)
        ]
    every_nth = max(1, -(-int(max(len(label) for label in x.labels) * _LETTER + 4) // int(size)))
    if x.texts:
        every_nth = 1
    parts += [
        _text(left + (k + 0.5) * size, bottom + 13, _short(label, size * every_nth), "middle")
        for k, label in enumerate(x.labels)
        if k % every_nth == 0
    ]
    parts.append(_text(_WIDTH - 4, bottom + 31, _short(x.name, _WIDTH - 8), "end"))
    title = f"Where variants fail: {x.name}" + ("" if y is None else f" and {y.name}")
    return Markup(
        f'<svg viewBox="0 0 {_WIDTH:g} {bottom + _BOTTOM:g}" role="img"><title>{escape(title)}</title>'
        f"{''.join(parts)}</svg>"
    )


def _text(x: float, y: float, text: str, anchor: str) -> str:
    style = f"fill:var(--soft);font-size:11px;text-anchor:{anchor}"
    return f'<text x="{x:.1f}" y="{y:.1f}" style="{style}">{escape(text)}</text>'


def _short(text: str, room: float) -> str:
    most = max(int(room / _LETTER), 2)
    return text if len(text) <= most else text[: most - 1] + "…"


def _worst(
    group: Group, one: Variants, part: pa.Table, names: Names, replays: Mapping[Key, str]
) -> list[dict[str, Any]]:
    """Variants that fail, the hardest contacts first."""
    hardest = np.full(len(one.seed), -1.0)
    if "max_delta_v" in part.column_names:
        found = dict(zip(part["seed"].to_pylist(), columns(part, ["max_delta_v"])[:, 0], strict=True))
        hardest = np.nan_to_num([found[seed] for seed in one.seed.tolist()], nan=-1.0)
    order = np.lexsort((one.seed, -np.where(one.collided, hardest, -1.0), ~one.collided))
    listed = [k for k in order if not one.passed[k]][:WORST]
    along = axes(one)
    rows = []
    for k in listed:
        seed = int(one.seed[k])
        ended = f"contact, delta-v {hardest[k]:.1f} m/s" if one.collided[k] else "no contact"
        if one.preventable is not None and one.collided[k]:
            ended += ", preventable" if one.preventable[k] else ", not preventable"
        values = [f"{axis.name} {_value(one, axis, k)}" for axis in along]
        rows.append(
            {
                "seed": seed,
                "ended": ended,
                "values": ", ".join(values),
                "replay": replays.get((*group, seed)),
                "command": names.command(group, seed),
            }
        )
    return rows


def _value(one: Variants, axis: Axis, k: int) -> str:
    value, words = one.parameters[axis.name][k], one.words.get(axis.name)
    return f"{value:g}" if words is None else Path(words[int(value)]).stem
