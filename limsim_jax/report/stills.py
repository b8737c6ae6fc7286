"""Frames of pictures and videos as pixels: a whole map, or a camera above a vehicle.

What stands still is drawn once; per frame only vehicles, signals and texts are drawn above it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.maps.network import Network
from limsim_jax.maps.outline import Bounds, outlines, view
from limsim_jax.metrics.moments import value_text, words
from limsim_jax.report.draw.layout import strips
from limsim_jax.report.draw.painter import INK
from limsim_jax.report.frames import Layer, Scene, draw_map_only
from limsim_jax.report.pictures import OTHER
from limsim_jax.simulation.trace import Trace

DPI = 100
"""Dots per inch of a video; a page is 12.8 x 7.2 inches."""

_PAGE = (12.8, 7.2)  # inches
_MARGINS = (0.1, 0.1, 1.0, 0.4)  # inches: left, bottom, right (colour bar), top (clock)
_GAP = 0.08  # inches between strips
_CAMERA = 35.0  # m from the middle of the view to its top where a vehicle is followed
_TILE = 2.0  # sizes of the view: the part of the map that the camera draws at once
_CAPTION = (-1.5, 2.5)  # s before and after a key moment in which its caption is shown
_STEADY = 0.5  # s before and after a frame over whose mean position the camera stands


class Captions:
    """Key moments in words while they happen."""

    def __init__(self, scene: Scene, moments: Iterable[Mapping[str, Any]]) -> None:
        self.rows: list[tuple[float, str, int | None]] = []  # time, words, slot of the other vehicle
        for row in moments:
            value, other = row.get("value"), row.get("other")
            known = value is not None and math.isfinite(value)
            text = ", ".join(
                filter(
                    None, (words(row["kind"]), value_text(row["kind"], float(row["value"])) if known else "")
                )
            )
            slot = None if other is None or not 0 <= other < scene.v.shape[1] else int(other)
            self.rows.append((float(row["time"]), text, slot))
        for end in scene.ends.values():
            if end is not None and end.arrived:
                self.rows.append((float(scene.time[end.step + 1]), "arrived", None))
        self.times = np.array([time for time, *_ in self.rows])

    def at(self, time: float) -> tuple[str, int | None]:
        """Caption and slot of the other vehicle at a time (s)."""
        before, after = _CAPTION
        near = [row for row in self.rows if before <= time - row[0] <= after]
        if not near:
            return "", None
        at, text, slot = min(near, key=lambda row: abs(row[0] - time))
        return f"{text}, at {at:.1f} s", slot


class MapPage:
    """The whole map (in strips if long and thin), or one window."""

    def __init__(
        self,
        network: Network,
        scene: Scene,
        captions: Captions,
        tail: float,
        bounds: Bounds | None,
        dpi: float,
    ) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self.scene, self.captions = scene, captions
        width, height = _PAGE
        left, bottom, right, top = _MARGINS
        room = (width - left - right, height - bottom - top)
        shapes = outlines(network)
        windows, stacked, _ = strips(shapes, view(network, shapes, bounds), room)
        if bounds is not None:
            windows, stacked = [bounds], True
        if len(windows) == 1:
            windows = [_grown(windows[0], room[0] / room[1])]
        rows, columns = (len(windows), 1) if stacked else (1, len(windows))
        cell = (room[0] - (columns - 1) * _GAP) / columns, (room[1] - (rows - 1) * _GAP) / rows
        self.figure: Any = Figure(figsize=(width, height), dpi=dpi, facecolor="white")
        self.canvas = FigureCanvasAgg(self.figure)
        self.layers: list[Layer] = []
        for i, box in enumerate(windows):
            x = left + (0 if stacked else i) * (cell[0] + _GAP)
            y = bottom + (rows - 1 - i if stacked else 0) * (cell[1] + _GAP)
            ax = self.figure.add_axes((x / width, y / height, cell[0] / width, cell[1] / height))
            ax.set_xticks([])
            ax.set_yticks([])
            for spine in ax.spines.values():
                spine.set_color("#c5cad1")
            draw_map_only(ax, network, box)
            self.layers.append(Layer(ax, scene, tail))
        bar = self.figure.add_axes((1 - 0.75 / width, 0.12, 0.16 / width, 0.72))
        self.figure.colorbar(self.layers[0].artists["vehicles"], cax=bar, label="speed, m/s")
        line = 1 - 0.28 / height
        self.clock = self.figure.text(left / width, line, "", fontsize=11, color=INK)
        self.caption = self.figure.text(
            1 - right / width, line, "", fontsize=11, fontweight="bold", ha="right", color=INK
        )
        self.name = Path(network.source).name or network.name

    def update(self, k: int) -> None:
        """Show step `k`."""
        scene = self.scene
        for layer in self.layers:
            layer.update(k)
        active = scene.active[k]
        text = f"{self.name}   {scene.time[k]:6.1f} s   {active.sum()} vehicles"
        if collided := int((scene.collided[k] & active).sum()):
            text += f"   {collided} collided"
        if self.layers[0].scale > 1.05:
            text += f"   (drawn {self.layers[0].scale:.1f} times as large)"
        self.clock.set_text(text)
        self.caption.set_text(self.captions.at(float(scene.time[k]))[0])

    def frames(self, steps: Sequence[int]) -> Iterator[NDArray[np.uint8]]:
        """Pixels `[H, W, 3]` of steps, with even sizes (H.264 needs them)."""
        moving = [(layer, artist) for layer in self.layers for artist in layer.artists.values()]
        texts = (self.clock, self.caption)
        for artist in (*(artist for _, artist in moving), *texts):
            artist.set_animated(True)
        self.canvas.draw()
        still = self.canvas.copy_from_bbox(self.figure.bbox)
        for k in steps:
            self.canvas.restore_region(still)
            self.update(k)
            for _, artist in moving:
                artist.axes.draw_artist(artist)
            for text in texts:
                self.figure.draw_artist(text)
            yield _even(np.asarray(self.canvas.buffer_rgba())[..., :3])


class Camera:
    """A view that stays above a vehicle: pixels of a part of the map that is drawn anew now and then."""

    def __init__(
        self, network: Network, scene: Scene, captions: Captions, slot: int, tail: float, dpi: float
    ) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self.network, self.scene, self.captions, self.slot = network, scene, captions, slot
        self.dpi = dpi
        self.size = np.round(np.array(_PAGE) * dpi).astype(int)  # pixels across and up
        self.scale = float(self.size[1] / (2 * _CAMERA))  # pixels per m
        self.figure: Any = Figure(figsize=_PAGE, dpi=dpi)
        self.canvas = FigureCanvasAgg(self.figure)
        self.ax = self.figure.add_axes((0, 0, 1, 1))
        self.ax.set_axis_off()
        self._look_at(scene.xy[0, slot])
        self.layer = Layer(self.ax, scene, tail)
        (self.ring,) = self.ax.plot(
            [], [], "o", ms=34, mfc="none", mec=OTHER, mew=2, zorder=999, scalex=False, scaley=False
        )
        box = {"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 4}
        self.clock = self.figure.text(0.012, 0.965, "", fontsize=12, va="top", color=INK, bbox=box)
        self.caption = self.figure.text(
            0.5, 0.04, "", fontsize=15, fontweight="bold", ha="center", color=INK, bbox=box
        )
        self.places = self._places()
        self.tile, self.corner = np.zeros((0, 0, 4), np.uint8), np.zeros(2)
        self.bar = self._speed_bar()

    def _places(self) -> NDArray[np.float64]:
        """Where the camera stands at every step, `[T, 2]`: the mean of the positions around it."""
        scene, slot = self.scene, self.slot
        there = np.flatnonzero(scene.active[:, slot])
        if not there.size:
            return np.repeat(scene.xy[:1, slot], len(scene.time), 0).astype(float)
        steps = np.clip(np.arange(len(scene.time)), there[0], there[-1])
        xy = scene.xy[steps, slot].astype(float)
        first = np.searchsorted(scene.time, scene.time - _STEADY)
        last = np.searchsorted(scene.time, scene.time + _STEADY, side="right")
        total = np.concatenate([np.zeros((1, 2)), np.cumsum(xy - xy[0], 0)])
        return xy[0] + (total[last] - total[first]) / (last - first)[:, None]

    def _look_at(self, low: NDArray[Any]) -> None:
        """Let the view begin at a corner (m)."""
        high = low + self.size / self.scale
        self.ax.set_xlim(low[0], high[0])
        self.ax.set_ylim(low[1], high[1])

    def _draw_tile(self, middle: NDArray[np.float64]) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        half = _TILE * self.size / self.scale / 2
        low, high = middle - half, middle + half
        figure = Figure(figsize=(_TILE * _PAGE[0], _TILE * _PAGE[1]), dpi=self.dpi, facecolor="white")
        canvas = FigureCanvasAgg(figure)
        ax = figure.add_axes((0, 0, 1, 1))
        ax.set_axis_off()
        draw_map_only(ax, self.network, (float(low[0]), float(low[1]), float(high[0]), float(high[1])))
        ax.set_xlim(low[0], high[0])
        ax.set_ylim(low[1], high[1])
        ax.set_aspect("auto")
        canvas.draw()
        self.tile, self.corner = np.array(canvas.buffer_rgba()), low

    def _speed_bar(self) -> NDArray[np.uint8]:
        """The scale of the colours of speed, as pixels."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.cm import ScalarMappable
        from matplotlib.figure import Figure

        figure = Figure(figsize=(2.4, 0.55), dpi=self.dpi, facecolor="white")
        canvas = FigureCanvasAgg(figure)
        ax: Any = figure.add_axes((0.07, 0.62, 0.86, 0.24))
        vehicles = self.layer.artists["vehicles"]
        colors = ScalarMappable(vehicles.norm, vehicles.cmap)
        figure.colorbar(colors, cax=ax, orientation="horizontal", label="speed, m/s")
        ax.tick_params(labelsize=8, length=2, pad=1)
        ax.xaxis.label.set_size(8)
        ax.xaxis.labelpad = 0
        canvas.draw()
        return np.array(canvas.buffer_rgba())

    def _background(self, middle: NDArray[np.float64]) -> NDArray[np.uint8]:
        """The map around a place, to whole pixels; the axes follow."""
        while True:
            room = np.array(self.tile.shape[1::-1])
            first = np.round((middle - self.corner) * self.scale - self.size / 2).astype(int)
            if (first >= 0).all() and (first + self.size <= room).all():
                break
            self._draw_tile(middle)
        self._look_at(self.corner + first / self.scale)
        top = room[1] - first[1] - self.size[1]
        part = self.tile[top : top + self.size[1], first[0] : first[0] + self.size[0]].copy()
        high, wide = self.bar.shape[:2]
        part[-high - 10 : -10, -wide - 10 : -10] = self.bar
        return part

    def frames(self, steps: Sequence[int]) -> Iterator[NDArray[np.uint8]]:
        """Pixels `[H, W, 3]` of steps, with even sizes (H.264 needs them)."""
        scene = self.scene
        self.canvas.draw()
        pixels = np.asarray(self.canvas.buffer_rgba())
        for k in steps:
            pixels[:] = self._background(self.places[k])
            self.layer.update(k)
            caption, other = self.captions.at(float(scene.time[k]))
            there = scene.active[k, self.slot]
            speed = f"   {scene.v[k, self.slot]:.1f} m/s" if there else ""
            self.clock.set_text(f"{scene.time[k]:6.1f} s{speed}   {scene.active[k].sum()} vehicles")
            self.caption.set_text(caption)
            shown = [] if other is None or not scene.active[k, other] else [other]
            self.ring.set_data(*scene.xy[k, shown].T)
            for artist in (*self.layer.artists.values(), self.ring):
                self.ax.draw_artist(artist)
            for text in (self.clock, self.caption) if caption else (self.clock,):
                self.figure.draw_artist(text)
            yield _even(pixels[..., :3])


class LiveCamera:
    """A camera above a vehicle of a world that is still running.

    Args:
      network: the map.
      lane_map: of that map.
      trace: of one step, `[1, ...]`.
      slot: of the vehicle.
      dpi: dots per inch of a page of 12.8 x 7.2 inches.
    """

    def __init__(
        self, network: Network, lane_map: LaneMap, trace: Trace, slot: int, dpi: float = 0.75 * DPI
    ) -> None:
        scene = Scene(network, lane_map, trace, [slot])
        self._camera = Camera(network, scene, Captions(scene, ()), slot, 0.0, dpi)

    def frame(self, trace: Trace) -> NDArray[np.uint8]:
        """Pixels `[H, W, 3]` of a step, `[1, ...]`; the view stays where the vehicle was last."""
        camera = self._camera
        camera.scene.show(trace)
        if camera.scene.active[0, camera.slot]:
            camera.places = camera.scene.xy[:1, camera.slot].astype(float)
        return next(camera.frames([0]))


def _grown(box: Bounds, ratio: float) -> Bounds:
    """The least box around another with this ratio of width to height."""
    x0, y0, x1, y1 = box
    wide = max(x1 - x0, ratio * (y1 - y0))
    more_x, more_y = (wide - (x1 - x0)) / 2, (wide / ratio - (y1 - y0)) / 2
    return x0 - more_x, y0 - more_y, x1 + more_x, y1 + more_y


def _even(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return pixels[: len(pixels) // 2 * 2, : pixels.shape[1] // 2 * 2].copy()
