"""One moment of the traffic above a map, on axes of matplotlib.

matplotlib is imported when something is drawn, never before.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps.lane_map import LaneMap, absolute
from limsim_jax.maps.network import Network
from limsim_jax.maps.outline import Bounds, signal_bars
from limsim_jax.maps.signal_table import SignalState
from limsim_jax.maps.signals import lane_states_on_host
from limsim_jax.report.draw import TRAFFIC_ZORDER, draw_network
from limsim_jax.report.draw.painter import INK
from limsim_jax.simulation.ending import ending
from limsim_jax.simulation.trace import Trace
from limsim_jax.types import Status

if TYPE_CHECKING:
    from matplotlib.axes import Axes

EGO = "#d81b8c"
DRIVEN = "#ff7a00"
"""Colour of vehicles around the ego that the policy drives, and of their plans."""
COLLIDED = "#e3000f"
SIGNALS = {
    SignalState.RED: "#d7191c",
    SignalState.RED_YELLOW: "#f46d1b",
    SignalState.YELLOW: "#ffb000",
    SignalState.GREEN_MINOR: "#7ed957",
    SignalState.GREEN_MAJOR: "#12a150",
    SignalState.STOP: "#7b2d8b",
    SignalState.OFF_BLINKING: "#c9a227",
    SignalState.OFF: "#9aa3ad",
}

_LEAST = 7.0  # pixels, length at which a car is drawn where the scale would make it shorter
_CAR = 4.6  # m
# A box whose front corners are cut off, so that one sees where it heads.
_OUTLINE = np.array([[-0.5, -0.5], [0.36, -0.5], [0.5, -0.28], [0.5, 0.28], [0.36, 0.5], [-0.5, 0.5]])


def draw_frame(
    ax: Axes,
    network: Network,
    lane_map: LaneMap,
    trace: Trace,
    time: float | None = None,
    *,
    egos: Sequence[int] = (),
    tail: float = 0.0,
    bounds: Bounds | None = None,
) -> dict[str, Any]:
    """Draw the map and one moment of the traffic, in file coordinates.

    Args:
      ax: axes of the caller, placed and sized before.
      network: the map.
      lane_map: of that map.
      trace: `[T, ...]`.
      time: s, the step nearest to it; the last one by default.
      egos: slots to outline.
      tail: s, how far back to show where vehicles came from.
      bounds: x_min, y_min, x_max, y_max of the view, m; the whole map if not given.

    Returns:
      The artists of the traffic: `tails`, `plans`, `signals`, `vehicles`, `collided`.

    Raises:
      ValueError: an empty trace, a time outside it, or a slot that it does not have.
    """
    draw_map_only(ax, network, bounds)
    layer = Layer(ax, Scene(network, lane_map, trace, egos), tail)
    layer.update(step_at(trace, time))
    return layer.artists


def draw_map_only(ax: Axes, network: Network, bounds: Bounds | None) -> None:
    """The map without its traffic lights, whose colours would look like signals."""
    for artist in draw_network(ax, network, bounds=bounds).get("lights", ()):
        artist.remove()


def step_at(trace: Trace, time: float | None) -> int:
    """The step nearest to a time (s), the last one by default; raises `ValueError` outside the trace."""
    times = np.asarray(trace.time)
    if not times.size:
        raise ValueError("the trace is empty")
    if time is None:
        return len(times) - 1
    step = times[1] - times[0] if len(times) > 1 else 1.0
    if not times[0] - 1.01 * step <= time <= times[-1] + 0.01 * step:
        raise ValueError(f"time = {time:g} s; the trace goes from {times[0]:g} to {times[-1]:g} s")
    return int(np.argmin(np.abs(times - time)))


class Scene:
    """A trace on the host, in file coordinates: all that a frame needs."""

    def __init__(
        self, network: Network, lane_map: LaneMap, trace: Trace, egos: Sequence[int] | set[int]
    ) -> None:
        trace = jax.device_get(trace)
        times = np.asarray(trace.time)
        if times.ndim != 1 or not times.size:
            raise ValueError("the trace is empty" if times.ndim else "the trace has no axis of time")
        slots = trace.active.shape[1]
        for ego in egos:
            if not 0 <= ego < slots:
                raise ValueError(f"slot {ego}: the trace has slots 0 to {slots - 1}")
        self.lane_map = lane_map
        self.ends = {ego: ending(trace, ego) for ego in egos}
        self.ego = np.isin(np.arange(slots), list(egos))
        self.egos_first = np.argsort(self.ego, kind="stable")  # drawn last, so on top
        limits = [lane.speed_limit for lane in network.drivable_lanes()]
        self.top_speed = 5.0 * math.ceil(max(limits, default=10.0) / 5.0)  # m/s
        self.bars, self.bar_rows = signal_bars(network, lane_map)  # [B, 2, 2]
        self.show(trace)

    def show(self, trace: Trace) -> None:
        """Take another trace of as many slots, on the host."""
        self.time = np.asarray(trace.time)
        self.v, self.vehicle = trace.v, trace.vehicle
        self.active = np.asarray(trace.active, bool)
        self.plans_of = None if trace.driven is None else trace.driven  # [T, E], slots
        self.plan_xy = (
            None
            if trace.plan is None
            else np.stack(absolute(self.lane_map, trace.plan[..., 0], trace.plan[..., 1]), -1)
        )
        x, y = absolute(self.lane_map, trace.box[..., 0], trace.box[..., 1])
        self.xy = np.stack([x, y], -1)  # [T, N, 2]
        self.heading, self.size = trace.box[..., 2], trace.box[..., 3:]
        self.collided = (trace.status & int(Status.COLLIDED)) != 0
        self.signals = lane_states_on_host(self.lane_map.signals, trace.phase)[:, self.bar_rows]  # [T, B]

    def outlines(self, k: int, scale: float) -> tuple[NDArray[Any], NDArray[Any]]:
        """Slots on the road, and their polygons `[M, 6, 2]` times `scale`."""
        slots = self.egos_first[self.active[k][self.egos_first]]
        corner = _OUTLINE * self.size[k, slots, None] * scale
        cos, sin = np.cos(self.heading[k, slots])[:, None], np.sin(self.heading[k, slots])[:, None]
        turned = np.stack([cos * corner[..., 0] - sin * corner[..., 1],
                           sin * corner[..., 0] + cos * corner[..., 1]], -1)  # fmt: skip
        return slots, self.xy[k, slots, None] + turned

    def plans(self, k: int) -> tuple[list[NDArray[Any]], list[bool]]:
        """What driven vehicles plan at step `k`: lines `[H, 2]`, and whether each is that of an ego."""
        lines: list[NDArray[Any]] = []
        own: list[bool] = []
        if self.plan_xy is None or self.plans_of is None:
            return lines, own
        for row, slot in enumerate(self.plans_of[k]):
            if slot >= 0 and self.active[k, slot] and np.isfinite(self.plan_xy[k, row]).all():
                lines.append(self.plan_xy[k, row])
                own.append(bool(self.ego[slot]))
        return lines, own

    def tails(self, k: int, seconds: float) -> list[NDArray[Any]]:
        """The last seconds of the vehicles of step `k`, `[K, 2]` each."""
        first = int(np.searchsorted(self.time, self.time[k] - seconds))
        lines = []
        for slot in np.flatnonzero(self.active[k]):
            same = self.active[first : k + 1, slot] & (
                self.vehicle[first : k + 1, slot] == self.vehicle[k, slot]
            )
            since = len(same) - int(np.argmin(same[::-1])) if not same.all() else 0
            lines.append(self.xy[first + since : k + 1, slot])
        return lines


class Layer:
    """The traffic on one pair of axes that already show the map."""

    def __init__(self, ax: Axes, scene: Scene, tail: float = 0.0) -> None:
        from matplotlib.collections import LineCollection, PolyCollection

        self.scene, self.tail = scene, tail
        extent = ax.get_window_extent()
        (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
        figure = ax.get_figure(root=True)
        assert figure is not None
        pixels = min(extent.width / (x1 - x0), extent.height / (y1 - y0))
        self.scale = max(1.0, _LEAST / (_CAR * pixels))
        points = 72.0 / figure.dpi * pixels
        self._tails = LineCollection([], colors=INK, linewidths=max(0.6, 0.25 * points), alpha=0.45)
        self._plans = LineCollection([], linewidths=max(1.2, 0.35 * points), alpha=0.85)
        self._signals = LineCollection([], linewidths=min(max(2.0, 0.9 * points), 6.0), capstyle="butt")
        self._vehicles = PolyCollection([], cmap="viridis")
        self._vehicles.set_clim(0, scene.top_speed)
        (self._collided,) = ax.plot(
            [], [], "x", color=COLLIDED, markersize=9, markeredgewidth=2, scalex=False, scaley=False
        )
        self.artists: dict[str, Any] = {
            "tails": self._tails,
            "plans": self._plans,
            "signals": self._signals,
            "vehicles": self._vehicles,
            "collided": self._collided,
        }
        for layer, (name, artist) in enumerate(self.artists.items()):
            artist.set_zorder(TRAFFIC_ZORDER + layer)
            artist.set_gid(name)
            if artist is not self._collided:
                ax.add_collection(artist, autolim=False)

    def update(self, k: int) -> None:
        """Show step `k`."""
        scene = self.scene
        if self.tail > 0:
            self._tails.set_segments(scene.tails(k, self.tail))
        plans, own = scene.plans(k)
        self._plans.set_segments(plans)
        self._plans.set_color([EGO if mine else DRIVEN for mine in own])
        self._signals.set_segments(list(scene.bars))
        self._signals.set_color([SIGNALS[SignalState(state)] for state in scene.signals[k]])
        slots, outlines = scene.outlines(k, self.scale)
        struck, ego = scene.collided[k, slots], scene.ego[slots]
        self._vehicles.set_verts(list(outlines))
        self._vehicles.set_array(scene.v[k, slots])
        self._vehicles.set_edgecolor(
            [COLLIDED if hit else EGO if own else INK for hit, own in zip(struck, ego, strict=True)]
        )
        self._vehicles.set_linewidth(np.where(struck | ego, 1.8, 0.4).tolist())
        self._collided.set_data(*scene.xy[k, slots[struck]].T)
