"""Pictures of a moment: the ego and the other vehicle, 2 s before it and at it."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from limsim_jax.maps.lane_map import LaneMap
    from limsim_jax.maps.network import Network
    from limsim_jax.simulation.trace import Trace

OTHER = "#1d6fd1"
"""Colour of the ring around the other vehicle."""

_BEFORE = 2.0  # s, of the first of the two pictures
_HALF = (30.0, 21.0)  # m, half the view of a picture, at least


def pictures(
    network: Network,
    lane_map: LaneMap,
    trace: Trace,
    *,
    ego: int,
    time: float | None,
    other: int | None = None,
) -> list[tuple[str, bytes]]:
    """Two views around an ego: 2 s before a moment, and at it.

    Both views hold the ego at both times, and the other vehicle where it is within 60 m. Without a time:
    the end. Raises `ValueError` for an empty trace or a slot that it does not have.
    """
    from limsim_jax.maps.lane_map import absolute

    times, active = np.asarray(trace.time), np.asarray(trace.active)
    if not times.size:
        raise ValueError("the trace is empty")
    if not 0 <= ego < active.shape[1]:
        raise ValueError(f"slot {ego}: the trace has slots 0 to {active.shape[1] - 1}")
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
        png = _one(network, lane_map, trace, xy, k, ego, other, bounds)
        views.append((caption, png))
    return views


def _one(
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

    from limsim_jax.report.frames import EGO, draw_frame

    figure = Figure(figsize=(4.8, 4.8 * _HALF[1] / _HALF[0]), dpi=130, facecolor="white")
    FigureCanvasAgg(figure)
    ax = figure.add_axes((0, 0, 1, 1))
    ax.set_axis_off()
    time = float(np.asarray(trace.time)[k])
    draw_frame(ax, network, lane_map, trace, time, egos=[ego], tail=3.0, bounds=bounds)
    for slot, name, color, above in ((ego, "ego", EGO, 1), (other, f"vehicle {other}", OTHER, -1)):
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
