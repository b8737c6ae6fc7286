"""Charts of a page: SVG by matplotlib whose colours follow the style sheet, by day and by night."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from limsim_jax.report.formats import number_text

if TYPE_CHECKING:
    from markupsafe import Markup
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH = 340
"""Units of the drawing across, a CSS pixel each in a column of that width."""

# What matplotlib draws in these colours takes the value on the right in the page.
_INK, _SOFT, _LINE, _PAPER = "#010203", "#020304", "#030405", "#040506"
_SERIES = [f"#0a0b{k:02x}" for k in range(8)]
_CSS = {_INK: "currentColor", _SOFT: "var(--soft)", _LINE: "var(--line)", _PAPER: "var(--paper)"}
_CSS |= {color: f"var(--c{k})" for k, color in enumerate(_SERIES)}

_FONT = 11
_SHARES = np.unique(np.concatenate([np.linspace(0, 1, 101), [0.002, 0.005, 0.015, 0.985, 0.995, 0.998]]))


class Point(NamedTuple):
    """An estimate with its interval, if it has one."""

    name: str
    value: float
    low: float | None
    high: float | None


def intervals(points: Sequence[Point], axis: str, title: str) -> Markup:
    """Estimates with intervals, one below the other; `axis` is the axis title."""
    figure, ax = _axes(22 * len(points) + 42)
    for k, (name, value, low, high) in enumerate(points):
        color = _SERIES[k % 8]
        if low is not None and high is not None:
            ax.plot([low, high], [k, k], color=color, lw=2.4, solid_capstyle="round")
        (dot,) = ax.plot(value, k, "o", color=color, ms=8, mec=_PAPER, mew=1)
        dot.set_gid(f"say:{name}: {number_text(value, low, high)}")
    names = [_short(point.name) for point in points]
    ax.set_yticks(range(len(points)), names, color=_INK, parse_math=False)
    ax.set_ylim(len(points) - 0.4, -0.6)
    ax.grid(axis="x", color=_LINE, lw=1)
    low, high = ax.get_xlim()
    if 0 < low < 0.3 * high:
        ax.set_xlim(0, high)
    ax.set_xlabel(axis, color=_SOFT, parse_math=False)
    return _svg(figure, title)


def distributions(samples: Sequence[NDArray[Any]], names: Sequence[str], axis: str, title: str) -> Markup:
    """Empirical distributions: quantiles at fixed shares, so the drawing does not grow with the seeds."""
    figure, ax = _axes(190)
    low, high = np.quantile(np.concatenate(samples), [0.002, 0.998])
    for k, (x, name) in enumerate(zip(samples, names, strict=True)):
        if not x.size:
            continue
        value = np.clip(np.quantile(x, _SHARES, method="inverted_cdf"), low, high)
        (line,) = ax.plot(value, 100 * _SHARES, color=_SERIES[k % 8], lw=1.6, solid_joinstyle="round")
        line.set_gid(f"say:{name}: median {np.median(x):.3g}, {x.size:,} episodes")
    ax.set_ylim(0, 100)
    ax.set_yticks([0, 25, 50, 75, 100])
    ax.grid(axis="y", color=_LINE, lw=1)
    ax.set_xlabel(axis, color=_SOFT, parse_math=False)
    ax.set_ylabel("episodes, %", color=_SOFT)
    return _svg(figure, title)


def curve(x: NDArray[Any], y: NDArray[Any], across: str, up: str, title: str) -> Markup:
    """One line from 0 on; `across` and `up` are the titles of the axes."""
    figure, ax = _axes(190)
    ax.plot(x, y, color=_SERIES[0], lw=1.6, solid_joinstyle="round")
    ax.set_xlim(0, max(float(x[-1]), 1))
    ax.set_ylim(bottom=0)
    ax.grid(axis="y", color=_LINE, lw=1)
    ax.set_xlabel(across, color=_SOFT)
    ax.set_ylabel(up, color=_SOFT)
    return _svg(figure, title)


def _axes(height: float) -> tuple[Figure, Axes]:
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator, StrMethodFormatter

    figure = Figure(figsize=(WIDTH / 72, height / 72), dpi=72, layout="constrained")
    engine: Any = figure.get_layout_engine()
    engine.set(w_pad=3 / 72, h_pad=3 / 72)
    ax: Any = figure.add_subplot()
    figure.patch.set_visible(False)
    ax.patch.set_visible(False)
    for spine in ax.spines.values():
        spine.set_visible(False)
    ax.tick_params(length=0, labelsize=_FONT, labelcolor=_SOFT)
    ax.xaxis.label.set_size(_FONT)
    ax.yaxis.label.set_size(_FONT)
    ax.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    ax.xaxis.set_major_formatter(StrMethodFormatter("{x:,g}"))
    ax.set_axisbelow(True)
    return figure, ax


def _short(name: str, most: int = 22) -> str:
    return name if len(name) <= most else name[: most - 1] + "…"


def _svg(figure: Figure, title: str) -> Markup:
    """The drawing as an element of the page: no ids, colours by style sheet, names to hover over."""
    from lxml import etree
    from markupsafe import Markup
    from matplotlib import rc_context

    file = io.StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "limsim-jax", "path.simplify": False}):
        figure.savefig(file, format="svg", metadata={"Date": None})
    root: Any = etree.fromstring(
        file.getvalue().encode(), etree.XMLParser(resolve_entities=False, remove_blank_text=True)
    )
    space = "{http://www.w3.org/2000/svg}"
    for unwanted in (*root.iter(f"{space}metadata"), *root.iter(f"{space}style")):
        unwanted.getparent().remove(unwanted)
    link = "{http://www.w3.org/1999/xlink}href"
    shapes: dict[str, Any] = {shape.get("id"): shape for defs in root.iter(f"{space}defs") for shape in defs}
    for use in list(root.iter(f"{space}use")):  # markers: their shapes stand in their place
        shape = shapes[use.get(link)[1:]]
        place = f"translate({use.get('x', '0')} {use.get('y', '0')})"
        use.getparent().replace(
            use, etree.Element(shape.tag, d=shape.get("d"), transform=place, style=use.get("style", ""))
        )
    for defs in list(root.iter(f"{space}defs")):
        defs.getparent().remove(defs)
    for element in root.iter():
        said = element.attrib.pop("id", "")
        if said.startswith("say:"):
            etree.SubElement(element, f"{space}title").text = said[4:]
        element.attrib.pop("clip-path", None)
        style = element.get("style")
        if style is not None:
            element.set("style", _style(style))
    for name in ("width", "height", "version"):
        root.attrib.pop(name, None)
    root.set("role", "img")
    head = etree.Element(f"{space}title")
    head.text = title
    root.insert(0, head)
    etree.cleanup_namespaces(root)
    return Markup(etree.tostring(root, encoding="unicode"))


def _style(style: str) -> str:
    """Colours of the style sheet; the font is that of the page."""
    kept = []
    for part in filter(None, map(str.strip, style.split(";"))):
        name, _, value = part.partition(":")
        value = value.strip()
        if name == "font":
            name, value = "font-size", f"{_FONT}px"
        elif name in ("font-family", "stroke-linejoin", "stroke-miterlimit"):
            continue
        kept.append(f"{name}:{_CSS.get(value, value)}")
    return ";".join(kept)
