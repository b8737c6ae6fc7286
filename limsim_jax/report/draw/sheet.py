"""A page with a map: title, legend, scale bar, strips and windows on details."""

from __future__ import annotations

import math
from collections.abc import Sized
from pathlib import Path
from typing import TYPE_CHECKING, Any

from limsim_jax.maps.network import Action, MapError, Network
from limsim_jax.maps.outline import SURFACES, Bounds, conflict_zones, levels, outlines
from limsim_jax.report.draw.layout import LEGEND, MARGINS, plan_page
from limsim_jax.report.draw.painter import EDGE, INK, TRAFFIC_ZORDER, TURNS, Painter

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SUFFIXES = (".png", ".svg", ".pdf")
"""Kinds of file that `draw_map` writes."""


def draw_map(
    network: Network,
    path: str | Path | None = None,
    *,
    conflicts: bool = False,
    labels: bool = False,
    bounds: Bounds | None = None,
    dpi: float = 160.0,
    size: tuple[float, float] | None = None,
) -> Figure:
    """Draw a map on a page with title, legend and scale bar.

    The title has counts and the import report; the axes are in metres. Lanes keep their true proportions.
    A long thin map is cut into strips of one scale. Where the scale of the whole map is too small for its
    marks, windows below show details.

    Args:
        network: the map.
        path: file to write; `.png`, `.svg` or `.pdf`. Nothing is written without it.
        conflicts: shade the conflict stretches of connectors by type.
        labels: write road and junction ids.
        bounds: x_min, y_min, x_max, y_max of the view, m; the whole map if not given.
        dpi: pixels per inch of a PNG.
        size: width and height of the page in inches; chosen from the map if not given.

    Returns:
        The figure.

    Raises:
        MapError: unknown suffix, a file that cannot be written, a map without lanes, `bounds` that are no
            rectangle or show no lane, or a `size` that leaves no room.
        ModuleNotFoundError: matplotlib is not installed.
    """
    target = None if path is None else _checked_target(path)
    try:
        from matplotlib.figure import Figure
        from matplotlib.ticker import MaxNLocator
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "drawing needs matplotlib, which is not installed: pip install 'limsim-jax[viz]'"
        ) from error

    shapes = outlines(network)
    storeys = levels(shapes.values())
    page = plan_page(network, shapes, bounds, size)
    figure = Figure(figsize=page.size, dpi=dpi, facecolor="white")
    legend: dict[str, dict[str, Any]] = {}
    zones = conflict_zones(network) if conflicts else None

    def panel(place: Bounds, box: Bounds, name: str) -> Axes:
        """Axes at x, y, width, height (inches) that show a box (m)."""
        x, y, width, height = place
        ax = figure.add_axes(
            (x / page.size[0], y / page.size[1], width / page.size[0], height / page.size[1])
        )
        painter = Painter(ax, network, shapes, storeys, box, name)
        painter.paint(zones=zones, labels=labels)
        legend.update(painter.legend)
        ax.set_facecolor("#fbfbf9")
        ax.tick_params(labelsize=7, colors=INK, length=2.5)
        ax.ticklabel_format(useOffset=False, style="plain")
        ax.xaxis.set_major_locator(MaxNLocator(max(2, int(width / 0.9))))
        ax.yaxis.set_major_locator(MaxNLocator(max(1, int(height / 0.45))))
        ax.spines[:].set_color("#c5cad1")
        return ax

    overview = []
    for i, (place, box) in enumerate(page.strips):
        ax = panel(place, box, f"map{i}-")
        if not page.stacked or i == len(page.strips) - 1:
            ax.set_xlabel("x / m", fontsize=8, color=INK)
        if page.stacked or i == 0:
            ax.set_ylabel("y / m", fontsize=8, color=INK)
        overview.append(ax)
    for letter, (place, box) in zip("ABCDEFGH", page.details, strict=False):
        ax = panel(place, box, f"detail{letter}-")
        ax.set_title(letter, fontsize=9, weight="bold", color=INK, loc="left", pad=3)
        for ax in overview:
            _frame(ax, box, letter)

    _title(figure, network, len(page.strips))
    _legend(figure, legend)
    _scale_bar(figure, page.scale)
    if target is not None:
        _write(figure, target, dpi)
    return figure


def _frame(ax: Axes, window: Bounds, letter: str) -> None:
    """Mark a detail window on a map that shows its middle."""
    from matplotlib.patches import Rectangle

    x0, y0, x1, y1 = window
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    if left <= (x0 + x1) / 2 <= right and bottom <= (y0 + y1) / 2 <= top:
        style = {"facecolor": "none", "edgecolor": INK, "linewidth": 0.8, "linestyle": (0, (4, 2))}
        ax.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, zorder=TRAFFIC_ZORDER - 2, **style))
        ax.annotate(
            letter,
            (x0, y1),
            xytext=(-1, 1),
            textcoords="offset points",
            ha="right",
            fontsize=9,
            weight="bold",
            color=INK,
            zorder=TRAFFIC_ZORDER - 1,
            clip_on=True,
        )


def _checked_target(path: str | Path) -> Path:
    target = Path(path)
    if target.suffix.lower() not in SUFFIXES:
        known = ", ".join(SUFFIXES)
        raise MapError(f"cannot draw to '{target.suffix or target.name}': use one of {known}", file=target)
    return target


def _write(figure: Figure, target: Path, dpi: float) -> None:
    from matplotlib import rc_context

    kind = target.suffix.lower().lstrip(".")
    # Fixed ids and no date: the same map gives the same file.
    date = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind, {})
    with rc_context({"svg.hashsalt": "limsim_jax", "svg.fonttype": "none"}):
        try:
            figure.savefig(target, format=kind, dpi=dpi, metadata=date)
        except OSError as error:
            raise MapError(f"cannot write the drawing: {error.strerror or error}", file=target) from error


def _count(things: Sized, noun: str) -> str:
    return f"{len(things)} {noun}{'' if len(things) == 1 else 's'}"


def _title(figure: Figure, network: Network, strips: int) -> None:
    drivable = list(network.drivable_lanes())
    km = sum(lane.length for lane in drivable) / 1000
    own_programs = [p for p in network.programs.values() if not p.generated]
    counts = " · ".join(
        [
            network.format,
            _count(network.roads, "road"),
            _count(network.lanes, "lane"),
            f"{km:.2f} km of driving lanes",
            _count(network.junctions, "junction"),
            _count(network.traffic_lights, "traffic light"),
            *([_count(own_programs, "signal program")] if own_programs else []),
        ]
    )
    if strips > 1:
        counts += f" · {strips} strips, one scale"
    totals = ", ".join(f"{network.report.total(action)} {action.value}" for action in Action)
    width, height = figure.get_size_inches()
    x = MARGINS[0] / width
    file = Path(network.source).name
    name = network.name if network.name and network.name != file.split(".")[0] else ""
    figure.text(x, 1 - 0.30 / height, f"{file}   {name}".strip(), fontsize=13, weight="bold", color=INK)
    figure.text(x, 1 - 0.53 / height, counts, fontsize=8.5, color=INK)
    figure.text(x, 1 - 0.73 / height, f"import report: {totals}", fontsize=8.5, color=EDGE)


def _legend(figure: Figure, entries: dict[str, dict[str, Any]]) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    order = [
        *SURFACES,
        "crossing allowed",
        "crossing forbidden",
        "between directions",
        *TURNS,
        "connector without movement",
    ]
    names = [n for n in order if n in entries] + [n for n in entries if n not in order]
    handles: list[Any] = []
    for name in names:
        entry = entries[name]
        if "area" in entry:
            handles.append(
                Patch(facecolor=entry["area"], alpha=entry.get("alpha"), edgecolor="#c5cad1", lw=0.5)
            )
        elif "marker" in entry:
            style = entry["marker"]
            handles.append(
                Line2D(
                    [],
                    [],
                    linestyle="none",
                    marker=style["marker"],
                    markersize=9 if style["marker"] == "8" else 7,
                    markerfacecolor=style["facecolor"],
                    markeredgecolor=style["edgecolor"],
                )
            )
        elif "zebra" in entry:
            handles.append(Patch(facecolor="white", edgecolor="#7b8490", hatch="|||||", lw=0.5))
        elif "on" in entry:
            pavement = Patch(facecolor=entry["on"], edgecolor="none")
            mark = Line2D([], [], color=entry["line"], lw=1.4, linestyle="--" if entry.get("dashed") else "-")
            handles.append((pavement, mark))
        else:
            line = Line2D([], [], color=entry["line"], lw=entry.get("width", 1.6))
            inner = entry.get("inner")
            handles.append((line, Line2D([], [], color=inner, lw=1.2)) if inner else line)
    width, height = figure.get_size_inches()
    figure.legend(
        handles,
        names,
        loc="upper left",
        bbox_to_anchor=((width - LEGEND + 0.1) / width, 1 - MARGINS[2] / height + 0.02),
        frameon=False,
        fontsize=8,
        labelcolor=INK,
        borderaxespad=0,
        handlelength=1.8,
        labelspacing=0.45,
    )


def _scale_bar(figure: Figure, scale: float) -> None:
    from matplotlib.lines import Line2D

    most = (LEGEND - 0.8) / scale  # m that fit above the legend
    unit = 10.0 ** math.floor(math.log10(most))
    metres = max(m for m in (unit, 2 * unit, 5 * unit) if m <= most)
    width, height = figure.get_size_inches()
    x0 = width - LEGEND + 0.15
    x1, y = x0 + metres * scale, height - 0.62
    for xs, ys in (((x0, x1), (y, y)), ((x0, x0), (y, y + 0.07)), ((x1, x1), (y, y + 0.07))):
        bar = Line2D([x / width for x in xs], [v / height for v in ys], color=INK, lw=1.5)
        figure.add_artist(bar)
    text = f"{metres:g} m" if metres < 1000 else f"{metres / 1000:g} km"
    figure.text(
        (x0 + x1) / 2 / width, (y + 0.05) / height, text, fontsize=8, ha="center", va="bottom", color=INK
    )
