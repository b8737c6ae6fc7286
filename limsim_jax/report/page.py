"""A self-contained page of a sweep: one HTML file, no network, light and dark, for desk and phone.

In this order: what happened and the worst crash; the main metrics with intervals; the worst seeds, each
with pictures of its key moment, who is responsible, and its replay; key moments by kind; metrics by scenario;
distributions; all metrics; provenance. Plots are SVG in the page; pictures need matplotlib (extra `viz`),
and only if a replayer is given.
"""

from __future__ import annotations

import base64
import io
import json
import math
import re
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import quote

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from limsim_jax.files import write_whole
from limsim_jax.report.tables import (
    CRASH_RATE,
    MAIN,
    Group,
    Main,
    better,
    bound_text,
    columns,
    groups,
    lookup,
    metrics_of,
    number_text,
    summary,
    worst,
)

if TYPE_CHECKING:
    from limsim_jax.maps.lane_map import LaneMap
    from limsim_jax.maps.network import Network
    from limsim_jax.simulation.trace import Trace
    from limsim_jax.sweeps.store import Results

Replayer = Callable[[str, str, int], tuple[Any, ...]]
"""(scenario, policy, seed) -> (network, lane_map, trace, slot of the ego, moments, ...)."""

LISTED = 40
"""Worst seeds in the table, with and without a picture."""

_PARTIES = ("ego", "other", "shared", "unavoidable")
_BEFORE = 2.0  # s, of the first of the two pictures
_OTHER = "#1d6fd1"
_HALF = (30.0, 21.0)  # m, half the view of a picture, at least

_DISTRIBUTIONS = (
    ("min_ttc", "Least TTC, s"),
    ("min_thw", "Least time headway, s"),
    ("min_pet", "Least post-encroachment time, s"),
    ("min_distance", "Least distance to another body, m"),
    ("max_drac", "Highest DRAC, m/s²"),
    ("max_delta_v", "Delta-v of the worst contact, m/s"),
    ("completion_time", "Time to the goal, s"),
    ("mean_speed", "Mean speed of the ego, m/s"),
    ("min_acceleration", "Hardest braking, m/s²"),
    ("max_lateral_acceleration", "Highest lateral acceleration, m/s²"),
    ("max_jerk", "Highest jerk, m/s³"),
    ("nuplan_score", "nuPlan score"),
    ("carla_score", "CARLA driving score"),
    ("limsim_corrected_total", "LimSim score, corrected"),
    ("traffic_mean_speed", "Mean speed of the traffic, m/s"),
)

_KINDS = {
    "contact": "contact",
    "near_miss": "near miss",
    "hard_brake": "hard braking",
    "off_road": "off the road",
    "red_light": "red light run",
    "unsafe": "unsafe distance (RSS)",
    "score_drop": "drop of the score",
}
_VALUES = {
    "contact": "delta-v {:.1f} m/s",
    "near_miss": "TTC {:.2f} s",
    "hard_brake": "{:.1f} m/s²",
    "score_drop": "{:.0f} of 100",
}
_BLAME = {
    "ego": "the ego",
    "other": "the other vehicle",
    "shared": "both",
    "unavoidable": "nobody (unavoidable)",
}


class _Names(NamedTuple):
    """How scenario and policy are written, and which flags tell them apart."""

    scenarios: bool  # there are several
    policies: bool
    path: str

    def of(self, group: Group) -> str:
        return f"{group[0]} / {group[1]}" if self.policies else group[0]

    def head(self, group: Group, kind: str = "") -> str:
        policy = f"<small>{escape(group[1])}</small>" if self.policies else ""
        return f'<th class="{kind}">{escape(group[0])}{policy}</th>'

    def command(self, group: Group, seed: int | str) -> str:
        words = ["limsim-jax", "replay", self.path]
        words += ["--scenario", group[0]] if self.scenarios else []
        words += ["--policy", group[1]] if self.policies else []
        return f"{shlex.join(words)} --seed {seed}"


def write_report(
    results: Results,
    path: str | Path,
    *,
    replayer: Replayer | None = None,
    worst: int = 6,
    say: Callable[[str], None] | None = None,
    level: float = 0.95,
    table: pa.Table | None = None,
) -> Path:
    """Write the page, and beside it replays/<scenario>-<policy>-<seed>.html of the worst episodes.

    Args:
      results: of a sweep.
      path: the .html file to write; its folder is made.
      replayer: regenerates an episode: (scenario, policy, seed) -> (network, lane_map, trace, slot of the
        ego, moments). Without one there are neither pictures nor replays, only the commands for them.
      worst: how many of the worst episodes to show with pictures.
      say: called with a line before each replay.
      level: of the intervals.
      table: the summary at that level, if there is one already.

    Returns:
      The path.

    Raises:
      ValueError: no episodes.
      OSError: a file cannot be written.
      ModuleNotFoundError: pictures are wanted but matplotlib is not installed.
    """
    path = Path(path)
    if replayer is not None and worst > 0:
        from limsim_jax.report.video import PICTURE_SUFFIXES, check_suffix

        check_suffix("picture.png", PICTURE_SUFFIXES)
    parts = groups(results)
    table = summary(results, level=level) if table is None else table
    path.parent.mkdir(parents=True, exist_ok=True)
    names = _Names(len({s for s, _ in parts}) > 1, len({p for _, p in parts}) > 1, str(results.path))
    listed, shown = _worst_lists(results, max(worst, 0))
    found = lookup(table)
    sections = [
        _verdict(results, parts, found, shown, names, level),
        _headline(parts, found, names, level),
        _worst(results, listed, shown, names, path, replayer, say),
        _moments(results, parts, names),
        _by_scenario(parts, found, names, level),
        _distributions(parts, names),
        _all_metrics(parts, found, names),
        _provenance(results, parts, names),
    ]
    template = Template((Path(__file__).with_name("page.html")).read_text(encoding="utf-8"))
    title = f"{Path(names.path).name or names.path}: sweep report"
    text = template.substitute(title=escape(title), body="\n".join(sections))
    write_whole(path, text)
    return path


def _worst_lists(results: Results, shown: int) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """The table's rows, and those with pictures: the most severe crash is always among them."""
    listed = worst(results, k=max(LISTED, shown)).to_pylist()
    first = listed[:shown]
    hardest = worst_crash(results)
    if hardest is not None and first and all(_key(row) != _key(hardest) for row in first):
        first[-1] = hardest
    return listed, first


def worst_crash(results: Results) -> dict[str, Any] | None:
    """The episode with the highest delta-v, whoever is at fault, as a row of `tables.worst`."""
    if "max_delta_v" not in metrics_of(results.episodes):
        return None
    rows = worst(results, "max_delta_v", k=1).to_pylist()
    return rows[0] if rows and rows[0]["contact"] else None


def _key(row: Mapping[str, Any]) -> tuple[str, str, int]:
    return row["scenario"], row["policy"], row["seed"]


# --- what happened


def _verdict(
    results: Results,
    parts: Mapping[Group, pa.Table],
    found: Mapping[tuple[str, str, str], dict[str, Any]],
    shown: Sequence[Mapping[str, Any]],
    names: _Names,
    level: float,
) -> str:
    episodes = sum(part.num_rows for part in parts.values())
    scenarios, policies = ({group[k]: None for group in parts} for k in (0, 1))
    distance = sum(_total(part, "distance") for part in parts.values()) / 1000
    about = [
        _count(len(scenarios), "scenario"),
        f"policy {next(iter(policies))}"
        if len(policies) == 1
        else _count(len(policies), "policy", "policies"),
        _count(episodes, "episode"),
    ]
    if distance:
        about.append(f"{distance:,.0f} km driven by the ego")
    contacts = sum(_episodes_with(part, "contacts") for part in parts.values())
    faults = sum(_episodes_with(part, "at_fault_contacts") for part in parts.values())
    lines = []
    if contacts:
        text = f"<b>{contacts:,} of {_count(episodes, 'episode')} had a contact</b>"
        fault = f"{faults:,} by the ego's fault (nuPlan's rules)"
        lines.append(f"<p>{text}, {fault}.{_responsible_text(results)}</p>")
    elif any("contacts" in part.column_names for part in parts.values()):
        bound = -math.expm1(math.log1p(-level) / episodes)
        lines.append(
            f"<p><b>No contact in {_count(episodes, 'episode')}</b>: with {100 * level:g} % confidence it "
            f"happens in less than {100 * bound:.2g} %.</p>"
        )
    hardest = worst_crash(results)
    if hardest is not None:
        group = (hardest["scenario"], hardest["policy"])
        where = f"{escape(names.of(group))}, seed {hardest['seed']}"
        anchor = _anchor(hardest)
        if any(_key(row) == _key(hardest) for row in shown):
            where = f'<a href="#{anchor}">{where}</a>'
        lines.append(f"<p><b>Worst crash:</b> {where}: {_what(hardest)} {_badge(hardest)}</p>")
    calm = "" if contacts else " calm"
    links = {"main": "Main metrics", "worst": "Worst seeds", "moments": "Key moments",
             "scenarios": "By scenario", "distributions": "Distributions", "all": "All metrics",
             "provenance": "Provenance"}  # fmt: skip
    nav = "".join(f'<a href="#{name}">{text}</a>' for name, text in links.items())
    title = Path(names.path).name or names.path
    return (
        f'<header><h1>{escape(title)}</h1><p class="soft">{escape(", ".join(about))}</p></header>'
        f'<div class="verdict{calm}">{"".join(lines)}</div><nav>{nav}</nav>'
    )


def _responsible_text(results: Results) -> str:
    counts = _by_party(_contacts(results))
    if not counts:
        return ""
    parts = [
        f'<span class="{who}">{_BLAME[who]}</span> {counts[who]:,}' for who in _PARTIES if counts.get(who)
    ]
    unknown = counts.get("", 0)
    parts += [f"not told {unknown:,}"] if unknown and parts else []
    return f" Responsible: {', '.join(parts)}." if parts else ""


def _contacts(results: Results) -> pa.Table:
    import pyarrow.compute as pc

    return results.moments.filter(pc.field("kind") == "contact")


def _by_party(moments: pa.Table) -> dict[str, int]:
    """Episodes by who is responsible for their worst moment of this kind; "" where that is not told."""
    first = moments.sort_by([("rank", "ascending")]).select(["scenario", "policy", "seed", "responsible"])
    worst_of: dict[tuple[str, str, int], str] = {}
    for row in first.to_pylist():
        worst_of.setdefault(_key(row), row["responsible"] or "")
    counts: dict[str, int] = {}
    for who in worst_of.values():
        who = who if who in _PARTIES else ""
        counts[who] = counts.get(who, 0) + 1
    return counts


def _count(number: int, one: str, many: str = "") -> str:
    return f"{number:,} {one if number == 1 else many or one + 's'}"


def _total(part: pa.Table, name: str) -> float:
    return float(np.nansum(columns(part, [name]))) if name in part.column_names else 0.0


def _episodes_with(part: pa.Table, name: str) -> int:
    return int((columns(part, [name]) > 0).sum()) if name in part.column_names else 0


# --- main metrics


def _headline(
    parts: Mapping[Group, pa.Table],
    found: Mapping[tuple[str, str, str], dict[str, Any]],
    names: _Names,
    level: float,
) -> str:
    single = " single" if len(parts) == 1 else ""
    head = "".join(names.head(group) for group in parts)
    rows = [
        "<tr><th>episodes</th>" + "".join(f"<td>{part.num_rows:,}</td>" for part in parts.values()) + "</tr>"
    ]
    for main in MAIN:
        cells = [_main_cell(main, found.get((*group, main.metric))) for group in parts]
        if any(cells):
            rows.append(f"<tr><th>{_label(main)}</th>{''.join(f'<td>{x}</td>' for x in cells)}</tr>")
    return (
        f'<h2 id="main">Main metrics</h2><div class="scroll"><table class="wide{single}"><thead><tr><th></th>'
        f"{head}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
        f'<p class="soft">Brackets: {100 * level:g} % intervals; the seed is the unit. Shares: Wilson. '
        "Means: BCa bootstrap. Rates and medians: exact. &lt; and &gt;: one-sided bounds where something "
        "happened in no episode or in all. <i>n</i>: episodes in which the metric was measured, where that "
        "is not all; the others are not in the number.</p>"
    )


def _label(main: Main) -> str:
    unit = f" <small>{escape(main.unit)}</small>" if main.unit else ""
    return f"{escape(main.label)}{unit}"


def _main_cell(main: Main, row: Mapping[str, Any] | None) -> str:
    if row is None or not row["measured"] or row[main.statistic] is None:
        return ""
    prefix = "median_" if main.statistic == "median" else ""
    value, interval = _value_and_interval(
        row[main.statistic], row[f"{prefix}lower"], row[f"{prefix}upper"], main.scale
    )
    if row["bound"] is not None:
        interval = f"{interval} {escape(bound_text(row, main.scale))}"
    return f"<b>{value}</b><small>{interval}{_measured(row)}</small>"


def _value_and_interval(value: float, low: float | None, high: float | None, scale: float) -> tuple[str, str]:
    value_text, _, rest = number_text(value, low, high, scale).partition(" ")
    return value_text, rest


def _measured(row: Mapping[str, Any]) -> str:
    return f" <i>n</i> {row['measured']:,}" if row["measured"] < row["seeds"] else ""


# --- the worst seeds


def _worst(
    results: Results,
    listed: Sequence[Mapping[str, Any]],
    shown: Sequence[Mapping[str, Any]],
    names: _Names,
    path: Path,
    replayer: Replayer | None,
    say: Callable[[str], None] | None,
) -> str:
    cards, replays = [], {}
    for number, row in enumerate(shown, 1):
        views = ""
        if replayer is not None:
            if say is not None:
                say(
                    f"replay {number} of {len(shown)}: {row['scenario']}, {row['policy']}, seed {row['seed']}"
                )
            try:
                views, replays[_key(row)], found = _replayed(row, names, path, replayer)
                row = {**row, **found}
            except ValueError as error:  # one episode that cannot be shown is no reason to lose the page
                views = f'<div class="none">No picture: {escape(str(error))}</div>'
        cards.append(_card(row, views, replays.get(_key(row)), names))
    anywhere = names.command(("SCENARIO", "POLICY"), "N")
    return (
        '<h2 id="worst">Worst seeds</h2><p class="soft">Contacts first, those by the ego\'s fault before '
        "others, then by delta-v; then who left the road; then by the least TTC. In the pictures the ego has "
        'a <span class="ego">magenta</span> outline and the other vehicle a <span class="other">blue</span> '
        "ring; who has collided is outlined in red.</p>"
        f'<div class="cards">{"".join(cards)}</div>{_worst_table(listed, replays, names)}'
        f"<p>Any episode can be seen: <code>{escape(anywhere)}</code></p>"
    )


def _replayed(
    row: Mapping[str, Any], names: _Names, path: Path, replayer: Replayer
) -> tuple[str, str, dict[str, Any]]:
    """Pictures of an episode's key moment, the relative address of its replay, which is written, and who
    could have avoided it."""
    from limsim_jax.report.viewer import write_viewer

    network, lane_map, trace, ego, moments, *_ = replayer(row["scenario"], row["policy"], row["seed"])
    name = f"{_file_name(row['scenario'])}-{_file_name(row['policy'])}-{int(row['seed'])}.html"
    folder = path.parent / "replays"
    folder.mkdir(parents=True, exist_ok=True)
    title = f"{names.of((row['scenario'], row['policy']))}, seed {row['seed']}"
    write_viewer(folder / name, network, lane_map, trace, ego=ego, moments=moments, title=title)
    views = pictures(network, lane_map, trace, ego=ego, time=row["time"], other=row["other"])
    figures = "".join(
        f'<figure><img alt="{escape(title)}, {caption}" src="data:image/png;base64,'
        f'{base64.b64encode(png).decode()}"><figcaption>{caption}</figcaption></figure>'
        for caption, png in views
    )
    worst = next((m for m in moments if m["kind"] == row["kind"]), {})
    found = {key: worst[key] for key in ("avoidable_by_ego", "avoidable_by_other", "module") if key in worst}
    return f'<div class="views">{figures}</div>', f"replays/{quote(name)}", found


def _file_name(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_]+", "_", name) or "_"


def _card(row: Mapping[str, Any], views: str, replay: str | None, names: _Names) -> str:
    group = (row["scenario"], row["policy"])
    link = f' <a href="{escape(replay)}">Open the replay</a>' if replay else ""
    return (
        f'<article class="card" id="{_anchor(row)}">{views}<div class="body">'
        f"<h3>{escape(names.of(group))}, seed {row['seed']} {_badge(row)}</h3>"
        f"<p>{_what(row)}{_avoidable(row)}</p>{link}"
        f"<code>{escape(names.command(group, row['seed']))}</code></div></article>"
    )


def _anchor(row: Mapping[str, Any]) -> str:
    return f"{_file_name(row['scenario'])}-{_file_name(row['policy'])}-{int(row['seed'])}"


def _kind(kind: str) -> str:
    return escape(_KINDS.get(kind, kind))


def _badge(row: Mapping[str, Any]) -> str:
    who = row["responsible"]
    if who not in _PARTIES:
        return ""
    text = "unavoidable" if who == "unavoidable" else f"responsible: {_BLAME[who]}"
    return f'<span class="badge {who}">{text}</span>'


def _what(row: Mapping[str, Any]) -> str:
    """What happened in a sentence."""
    kind = row["kind"] or ("contact" if row["contact"] else "closest moment")
    text = _kind(kind)
    text = text[:1].upper() + text[1:]
    if row["other"] is not None:
        text += f" with vehicle {row['other']}"
    if row["time"] is not None:
        text += f" at {row['time']:.1f} s"
    if row["contact"] and row["delta_v"] is not None:
        text += f", delta-v <b>{row['delta_v']:.1f} m/s</b>"
    elif kind in _VALUES and row["value"] is not None:
        text += f", <b>{_VALUES[kind].format(row['value'])}</b>"
    elif row["min_ttc"] is not None:
        text += f", least TTC {row['min_ttc']:.2f} s"
    if row["contact"]:
        text += ", at fault by nuPlan's rules" if row["at_fault"] and row["responsible"] == "other" else ""
    if row["module"]:
        text += f". A reference <b>{escape(row['module'])}</b> module would have avoided it"
    return f"{text}."


def _avoidable(row: Mapping[str, Any]) -> str:
    """Who could have avoided it, by re-simulation."""
    parts = [
        f"by {who}: {'yes' if row[name] else 'no'}"
        for who, name in (("the ego", "avoidable_by_ego"), ("the other vehicle", "avoidable_by_other"))
        if row[name] is not None
    ]
    return f" Avoidable {'; '.join(parts)} (simulated again from before it)." if parts else ""


def _worst_table(
    listed: Sequence[Mapping[str, Any]], replays: Mapping[tuple[str, str, int], str], names: _Names
) -> str:
    def number(value: float | None, digits: int = 1) -> str:
        if value is None:
            return '<td class="number" data-value=""></td>'
        return f'<td class="number" data-value="{value:.9g}">{value:.{digits}f}</td>'

    rows = []
    for row in listed:
        seed = f"{row['seed']}"
        replay = replays.get(_key(row))
        linked = f'<a href="{escape(replay)}">{seed}</a>' if replay else seed
        who = row["responsible"] if row["responsible"] in _PARTIES else ""
        kind = row["kind"] or ("contact" if row["contact"] else "")
        group = escape(names.of((row["scenario"], row["policy"])))
        rows.append(
            f'<tr><td class="number">{row["place"]}</td><td>{group}</td>'
            f'<td class="number" data-value="{seed}">{linked}</td><td>{_kind(kind)}</td>'
            f"{number(row['time'])}{number(row['delta_v'])}{number(row['min_ttc'], 2)}"
            f'<td class="{who}">{who}</td><td>{"yes" if row["at_fault"] else ""}</td>'
            f"<td>{escape(row['module'] or '')}</td></tr>"
        )
    head = (("number", "#"), ("", "scenario"), ("number", "seed"), ("", "what"), ("number", "at, s"),
            ("number", "delta-v, m/s"), ("number", "least TTC, s"), ("", "responsible"), ("", "ego at fault"),
            ("", "module"))  # fmt: skip
    heads = "".join(f'<th class="{kind}">{text}</th>' for kind, text in head)
    return (
        f'<details open><summary>The worst {len(listed)}</summary><div class="scroll">'
        f'<table class="sortable"><thead><tr>{heads}</tr></thead><tbody>{"".join(rows)}</tbody></table>'
        "</div></details>"
    )


def pictures(
    network: Network,
    lane_map: LaneMap,
    trace: Trace,
    *,
    ego: int,
    time: float | None,
    other: int | None = None,
) -> list[tuple[str, bytes]]:
    """Two views around an ego, 2 s before a moment and at it: caption and PNG of each.

    The view holds the ego at both times, and the other vehicle where it is within 60 m. Without a time:
    the end. Raises `ValueError` for an empty trace or a slot that it does not have.
    """
    from limsim_jax.maps.lane_map import absolute

    times, active = np.asarray(trace.time), np.asarray(trace.active)
    if not times.size:
        raise ValueError("the trace is empty")
    if not 0 <= ego < active.shape[1]:
        raise ValueError(f"slot {ego}? the trace has slots 0 to {active.shape[1] - 1}")
    at = len(times) - 1 if time is None else int(np.argmin(np.abs(times - time)))
    there = np.flatnonzero(active[: at + 1, ego])
    at = int(there[-1]) if there.size else at  # the ego may have left at the moment
    before = max(int(np.searchsorted(times, times[at] - _BEFORE)), int(there[0]) if there.size else 0)
    box = np.asarray(trace.box)
    xy = np.stack(absolute(lane_map, box[..., 0], box[..., 1]), -1)
    if other is not None and not 0 <= other < active.shape[1]:
        other = None
    points = [xy[at, ego], xy[before, ego]]
    if other is not None and active[at, other] and np.hypot(*(xy[at, other] - xy[at, ego])) < 60:
        points.append(xy[at, other])
    low, high = np.min(points, 0), np.max(points, 0)
    middle = (low + high) / 2
    grow = max(1.0, *((high - low) / 2 + 12) / np.array(_HALF))
    half = grow * np.array(_HALF)
    bounds = (*(middle - half).tolist(), *(middle + half).tolist())
    views = []
    for k, caption in ((before, f"{times[at] - times[before]:.1f} s before"), (at, f"at {times[at]:.1f} s")):
        if k == before and before == at:
            continue
        png = _picture(network, lane_map, trace, xy, k, ego, other, bounds)
        views.append((caption, png))
    return views


def _picture(
    network: Network,
    lane_map: LaneMap,
    trace: Trace,
    xy: NDArray[Any],
    k: int,
    ego: int,
    other: int | None,
    bounds: tuple[float, float, float, float],
) -> bytes:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patheffects import withStroke

    from limsim_jax.report.video import EGO, draw_frame

    figure = Figure(figsize=(4.8, 4.8 * _HALF[1] / _HALF[0]), dpi=130, facecolor="white")
    FigureCanvasAgg(figure)
    ax = figure.add_axes((0, 0, 1, 1))
    ax.set_axis_off()
    time = float(np.asarray(trace.time)[k])
    draw_frame(ax, network, lane_map, trace, time, egos=[ego], tail=3.0, bounds=bounds)
    for slot, name, color, above in ((ego, "ego", EGO, 1), (other, f"vehicle {other}", _OTHER, -1)):
        if slot is None or not np.asarray(trace.active)[k, slot]:
            continue
        x, y = xy[k, slot]
        if not (bounds[0] < x < bounds[2] and bounds[1] < y < bounds[3]):
            continue
        if slot == other:
            ax.plot(x, y, "o", ms=34, mfc="none", mec=color, mew=1.5, zorder=999, scalex=False, scaley=False)
        text = f"{name}, {float(np.asarray(trace.v)[k, slot]):.1f} m/s"
        style: dict[str, Any] = dict(color=color, fontsize=11, fontweight="bold", ha="center", va="center")
        style["path_effects"] = [withStroke(linewidth=3, foreground="white")]
        ax.annotate(text, (x, y), (0, 24 * above), textcoords="offset points", zorder=1000, **style)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=130, metadata={"Software": None})
    return file.getvalue()


# --- key moments


def _moments(results: Results, parts: Mapping[Group, pa.Table], names: _Names) -> str:
    moments = results.moments
    if not moments.num_rows:
        return '<h2 id="moments">Key moments</h2><p>None: nothing went wrong, nor nearly.</p>'
    keys = ["scenario", "policy", "seed", "kind"]
    episodes = moments.select(keys).group_by(keys).aggregate([])
    counted = episodes.group_by(["scenario", "policy", "kind"]).aggregate([("seed", "count")]).to_pylist()
    counts = {((r["scenario"], r["policy"]), r["kind"]): r["seed_count"] for r in counted}
    kinds = [kind for kind in _KINDS if any(k == kind for _, k in counts)]
    kinds += sorted({kind for _, kind in counts} - set(kinds))
    head = "".join(names.head(group, "number") for group in parts)
    rows = []
    for kind in kinds:
        cells = []
        for group, part in parts.items():
            n = counts.get((group, kind), 0)
            share = f"{100 * n / part.num_rows:.3g} %"
            cells.append(f'<td class="number">{n:,}<small>{share}</small></td>')
        rows.append(f"<tr><th>{_kind(kind)}</th>{''.join(cells)}</tr>")
    kind_table = (
        f'<div class="scroll"><table class="wide"><thead><tr><th>episodes with</th>{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )
    return f'<h2 id="moments">Key moments</h2>{kind_table}{_parties(results, parts, names)}'


def _parties(results: Results, parts: Mapping[Group, pa.Table], names: _Names) -> str:
    """Who is responsible for contacts, by scenario, as bars; and which module of the policy."""
    import pyarrow.compute as pc

    contacts = _contacts(results)
    rows = []
    for group in parts:
        own = contacts.filter((pc.field("scenario") == group[0]) & (pc.field("policy") == group[1]))
        counts = _by_party(own)
        total = sum(counts.values())
        if not total:
            continue
        bars = "".join(
            f'<i class="{who or "nobody"}" style="flex: {counts[who]}" title="{who or "not told"}: '
            f'{counts[who]}"></i>'
            for who in (*_PARTIES, "")
            if counts.get(who)
        )
        cells = "".join(f'<td class="number">{counts.get(who, 0):,}</td>' for who in _PARTIES)
        rows.append(
            f'<tr><th>{escape(names.of(group))}</th><td class="bars"><div class="bar">{bars}</div></td>'
            f'{cells}<td class="number">{counts.get("", 0):,}</td><td class="number">{total:,}</td></tr>'
        )
    if not rows:
        return ""
    head = "".join(f'<th class="number"><span class="{who}">{who}</span></th>' for who in _PARTIES)
    text = (
        "<h3>Who is responsible for the contacts</h3>"
        f'<div class="scroll"><table><thead><tr><th></th><th></th>{head}<th class="number">not told</th>'
        f'<th class="number">all</th></tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
    )
    modules = results.moments.filter(pc.field("module").is_valid())
    if modules.num_rows:
        counted = modules.group_by(["kind", "module"]).aggregate([("seed", "count")])
        lines = ", ".join(
            f"<b>{escape(str(row['module']))}</b> {row['seed_count']:,} ({_kind(str(row['kind']))})"
            for row in counted.sort_by([("seed_count", "descending")]).to_pylist()
        )
        text += f"<p>Modules whose replacement by a reference one avoids the moment: {lines}.</p>"
    return text


# --- plots


def _by_scenario(
    parts: Mapping[Group, pa.Table],
    found: Mapping[tuple[str, str, str], dict[str, Any]],
    names: _Names,
    level: float,
) -> str:
    figures = []
    for main in MAIN:
        rows = [(group, found.get((*group, main.metric))) for group in parts]
        prefix = "median_" if main.statistic == "median" else ""
        points: list[tuple[str, float, float | None, float | None]] = []
        for group, row in rows:
            if row is not None and row["measured"] and row[main.statistic] is not None:
                ends = (row[main.statistic], row[f"{prefix}lower"], row[f"{prefix}upper"])
                value, low, high = (None if x is None else main.scale * x for x in ends)
                points.append((names.of(group), value or 0.0, low, high))
        if points and any(value or (high or 0) > 0 for _, value, _, high in points):
            direction = {1: "more is better", -1: "less is better", 0: ""}[_direction(main.metric)]
            about = ", ".join(filter(None, (main.unit, direction)))
            figures.append(
                f"<figure><figcaption>{escape(main.label)}<small>{about}</small></figcaption>"
                f"{_dots(points, list(range(len(points))))}</figure>"
            )
    return (
        f'<h2 id="scenarios">By scenario</h2><p class="soft">Estimates with {100 * level:g} % intervals.</p>'
        f'<div class="plots">{"".join(figures)}</div>'
    )


def _direction(metric: str) -> int:
    return -1 if metric == CRASH_RATE else better(metric)


def _dots(points: Sequence[tuple[str, float, float | None, float | None]], colors: Sequence[int]) -> str:
    width, row = 340, 22
    left = min(8 + 6.3 * max(len(name) for name, *_ in points), 150)
    height = row * len(points) + 26
    ends = [x for _, value, low, high in points for x in (value, low, high) if x is not None]
    ticks, to_x = _axis(min(ends), max(ends), left + 6, width - 12)
    shapes = [
        f'<line class="grid" x1="{to_x(t):.1f}" x2="{to_x(t):.1f}" y1="2" y2="{height - 20}"/>'
        f'<text x="{to_x(t):.1f}" y="{height - 6}" text-anchor="middle">{_tick(t, ticks)}</text>'
        for t in ticks
    ]
    longest = int(left / 6.3)
    for k, (name, value, low, high) in enumerate(points):
        y = row * k + row / 2 + 2
        text = f"{name}: {number_text(value, low, high)}"
        short = name if len(name) <= longest else name[: longest - 1] + "…"
        shapes.append(
            f'<g class="g{colors[k] % 8}"><title>{escape(text)}</title>'
            f'<text class="name" x="0" y="{y + 4:.1f}">{escape(short)}</text>'
        )
        if low is not None and high is not None:
            shapes.append(
                f'<line class="interval" x1="{to_x(low):.1f}" x2="{to_x(high):.1f}" y1="{y}" y2="{y}"/>'
            )
        shapes.append(f'<circle class="dot" cx="{to_x(value):.1f}" cy="{y}" r="4.5"/></g>')
    return f'<svg viewBox="0 0 {width} {height}" role="img">{"".join(shapes)}</svg>'


def _distributions(parts: Mapping[Group, pa.Table], names: _Names) -> str:
    legend = "".join(f'<li class="g{k % 8}"><i></i>{escape(names.of(g))}</li>' for k, g in enumerate(parts))
    figures = []
    for metric, label in _DISTRIBUTIONS:
        samples, missing, total = [], 0, 0
        for part in parts.values():
            x = columns(part, [metric])[:, 0] if metric in part.column_names else np.empty(0)
            total += part.num_rows
            missing += part.num_rows - int((~np.isnan(x)).sum())
            samples.append(np.sort(x[~np.isnan(x)]))
        if not any(x.size > 1 for x in samples):
            continue
        note = f"not measured in {missing:,} of {_count(total, 'episode')}" if missing else ""
        figures.append(
            f"<figure><figcaption>{escape(label)}<small>{note}</small></figcaption>"
            f"{_curves(samples, [names.of(group) for group in parts])}</figure>"
        )
    return (
        '<h2 id="distributions">Distributions</h2><p class="soft">Share of the episodes in which the metric '
        f'is at most the value below.</p><ul class="legend">{legend}</ul>'
        f'<div class="plots">{"".join(figures)}</div>'
    )


def _curves(samples: Sequence[NDArray[Any]], names: Sequence[str]) -> str:
    """Empirical distributions: quantiles at fixed shares; the drawing does not grow with the seeds."""
    width, height, left, bottom = 340, 170, 40, 22
    everything = np.concatenate(samples)
    low, high = np.quantile(everything, [0.002, 0.998])
    ticks, to_x = _axis(float(low), float(high), left + 4, width - 12)

    def to_y(share: float) -> float:
        return height - bottom - share * (height - bottom - 8)

    shapes = [
        f'<line class="grid" x1="{left}" x2="{width - 6}" y1="{to_y(q):.1f}" y2="{to_y(q):.1f}"/>'
        f'<text x="{left - 4}" y="{to_y(q) + 4:.1f}" text-anchor="end">{100 * q:g} %</text>'
        for q in (0, 0.25, 0.5, 0.75, 1)
    ]
    shapes += [
        f'<text x="{to_x(t):.1f}" y="{height - 6}" text-anchor="middle">{_tick(t, ticks)}</text>'
        for t in ticks
    ]
    for k, (x, name) in enumerate(zip(samples, names, strict=True)):
        if not x.size:
            continue
        share = np.unique(
            np.concatenate([np.linspace(0, 1, 101), [0.002, 0.005, 0.015, 0.985, 0.995, 0.998]])
        )
        value = np.clip(np.quantile(x, share, method="inverted_cdf"), low, high)
        points = " ".join(f"{to_x(v):.1f},{to_y(q):.1f}" for v, q in zip(value, share, strict=True))
        median = f"{name}: median {np.median(x):.3g}, {x.size:,} episodes"
        shapes.append(
            f'<polyline class="curve g{k % 8}" points="{points}"><title>{escape(median)}</title></polyline>'
        )
    return f'<svg viewBox="0 0 {width} {height}" role="img">{"".join(shapes)}</svg>'


def _axis(low: float, high: float, left: float, right: float) -> tuple[list[float], Callable[[float], float]]:
    """Round ticks within a range, and the way from values to places on the page."""
    if not high > low:
        pad = abs(low) * 0.1 or 0.5
        low, high = low - pad, high + pad
    if 0 < low < 0.3 * high:
        low = 0.0
    raw = (high - low) / 5
    power = 10.0 ** math.floor(math.log10(raw))
    step = power * next(m for m in (1, 2, 5, 10) if m * power >= raw * 0.999)
    ticks = [k * step for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]

    def place(value: float) -> float:
        return left + (right - left) * (value - low) / (high - low)

    return ticks, place


def _tick(value: float, ticks: Sequence[float]) -> str:
    step = ticks[1] - ticks[0] if len(ticks) > 1 else abs(value) or 1.0
    return f"{value + 0.0:,.{max(0, -math.floor(math.log10(step) + 1e-9))}f}"


# --- all metrics, provenance


def _all_metrics(
    parts: Mapping[Group, pa.Table],
    found: Mapping[tuple[str, str, str], dict[str, Any]],
    names: _Names,
) -> str:
    metrics = list(dict.fromkeys(metric for *_, metric in found))
    head = "".join(names.head(group) for group in parts)
    blocks = []
    for title, own in _sections(metrics):
        rows = []
        for metric in own:
            of_groups = [found.get((*group, metric)) for group in parts]
            meaning = next((row["meaning"] for row in of_groups if row is not None), "")
            cells = "".join(f"<td>{_full_cell(row)}</td>" for row in of_groups)
            rows.append(f"<tr><th>{escape(metric)}<small>{escape(meaning)}</small></th>{cells}</tr>")
        if rows:
            blocks.append(
                f'<details><summary>{title} ({len(rows)})</summary><div class="scroll"><table class="wide">'
                f"<thead><tr><th></th>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table></div></details>"
            )
    return (
        '<h2 id="all">All metrics</h2><p class="soft">Estimate with interval; below it least, median and '
        f"greatest value. <i>n</i>: episodes in which it was measured.</p>{''.join(blocks)}"
    )


def _sections(metrics: Iterable[str]) -> list[tuple[str, list[str]]]:
    """Titles, and their metrics by how the names begin; what fits nowhere is of the drive."""
    starts = {
        "Drive and rules": (),
        "Safety": ("min_ttc", "ttc_", "near_miss", "min_thw", "max_drac", "min_pet", "min_distance", "rss_",
                   "contact", "at_fault", "had_", "max_delta_v", "crashes_"),
        "Comfort": ("min_acceleration", "max_acceleration", "max_lateral", "max_jerk", "max_longitudinal",
                    "max_yaw", "rms_", "comfortable"),
        "Scores": ("nuplan_", "carla_", "limsim_"),
        "Traffic": ("traffic_",),
    }  # fmt: skip
    sections: dict[str, list[str]] = {title: [] for title in starts}
    for metric in metrics:
        fits = [title for title, start in starts.items() if metric.startswith(start)]
        sections[fits[0] if fits else "Drive and rules"].append(metric)
    return list(sections.items())


def _full_cell(row: Mapping[str, Any] | None) -> str:
    if row is None:
        return ""
    if not row["measured"] or row["estimate"] is None:
        return "<small>never measured</small>"
    scale, unit = (100.0, " %") if row["kind"] == "proportion" else (1.0, "")
    value, interval = _value_and_interval(row["estimate"], row["lower"], row["upper"], scale)
    text = f"<b>{value}{unit}</b> {interval}"
    if row["kind"] == "mean":
        text += f"<small>{row['minimum']:.4g} · {row['median']:.4g} · {row['maximum']:.4g}</small>"
    if row["measured"] < row["seeds"]:
        text += f"<small><i>n</i> {row['measured']:,} of {row['seeds']:,}</small>"
    return text


def _provenance(results: Results, parts: Mapping[Group, pa.Table], names: _Names) -> str:
    blocks = []
    for group in parts:
        facts = results.provenance.get(group, {})
        rows = "".join(f"<tr><th>{escape(str(k))}</th><td>{_fact(v)}</td></tr>" for k, v in facts.items())
        seeds = parts[group]["seed"].to_numpy()
        rows = f"<tr><th>seeds</th><td>{_seeds(seeds)}</td></tr>{rows}"
        blocks.append(
            f'<details><summary>{escape(names.of(group))}</summary><div class="scroll"><table><tbody>{rows}'
            "</tbody></table></div></details>"
        )
    where = f"<p>Results in <code>{escape(names.path)}</code></p>"
    return f'<h2 id="provenance">Provenance</h2>{where}{"".join(blocks)}'


def _seeds(seeds: NDArray[Any]) -> str:
    first, last = int(seeds.min()), int(seeds.max())
    whole = last - first + 1 == len(seeds)
    return f"{first} to {last}" if whole else f"{len(seeds):,} from {first} to {last}"


def _fact(value: Any) -> str:
    if isinstance(value, str) and "\n" in value:
        return f"<pre>{escape(value.strip())}</pre>"
    if isinstance(value, (dict, list, tuple)):
        return f"<pre>{escape(json.dumps(value, indent=1, ensure_ascii=False, default=str))}</pre>"
    return escape(str(value))
