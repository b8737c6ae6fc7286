"""Pictures and videos of traffic, from the standard record of a rollout (`rollout.Trace`).

The map is drawn once; per frame only vehicles, signals and the clock are drawn above it.

matplotlib (extra `viz`) is imported when something is drawn, never before.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps.lane_map import LaneMap, absolute
from limsim_jax.maps.network import Network
from limsim_jax.maps.outline import Bounds, outlines, signal_bars, view
from limsim_jax.maps.signals import SignalState, lane_states
from limsim_jax.report.draw import TRAFFIC_ZORDER, draw_network
from limsim_jax.report.draw.layout import strips
from limsim_jax.report.draw.painter import INK
from limsim_jax.simulation.trace import Trace
from limsim_jax.types import Status

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

VIDEO_SUFFIXES = (".gif", ".mp4")
PICTURE_SUFFIXES = (".png",)

EGO = "#d81b8c"
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

_PAGE = (12.0, 7.6)  # inches, at most
_DPI = 100
_MARGINS = (0.1, 0.1, 1.0, 0.4)  # inches: left, bottom, right (colour bar), top (clock)
_GAP = 0.08  # inches between strips
_CAMERA = 60.0  # m from the middle of the view to its top when a vehicle is followed
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
    """Draw the map and one moment of the traffic on axes that the caller owns, in file coordinates.

    Args:
      ax: axes, placed and sized before.
      network: the map.
      lane_map: of that map.
      trace: `[T, ...]`.
      time: s, the step nearest to it; the last one by default.
      egos: slots to outline.
      tail: s, how far back to show where vehicles came from.
      bounds: x_min, y_min, x_max, y_max of the view, m; the whole map if not given.

    Returns:
      The artists of the traffic: `tails`, `signals`, `vehicles`, `collided`.

    Raises:
      ValueError: an empty trace, a time outside it, or a slot that it does not have.
    """
    _draw_map(ax, network, bounds)
    layer = _Layer(ax, _Moments(network, lane_map, trace, egos), tail)
    layer.update(_step(trace, time))
    return layer.artists


def write_picture(
    path: str | Path,
    network: Network,
    lane_map: LaneMap,
    trace: Trace,
    time: float | None = None,
    *,
    egos: Sequence[int] = (),
    tail: float = 4.0,
    bounds: Bounds | None = None,
    dpi: float = 1.5 * _DPI,
) -> None:
    """Write one moment as .png; arguments as for `draw_frame`. Long thin maps are cut into strips.

    Raises:
      ValueError: an unknown suffix, or as for `draw_frame`.
      OSError: the file cannot be written.
      ModuleNotFoundError: matplotlib is not installed.
    """
    check_suffix(path, PICTURE_SUFFIXES)
    k = _step(trace, time)
    page = _Page(network, _Moments(network, lane_map, trace, egos), tail, bounds, dpi)
    page.update(k)
    page.figure.savefig(path, dpi=dpi, metadata={"Software": None})


def write_video(
    path: str | Path,
    network: Network,
    lane_map: LaneMap,
    trace: Trace,
    *,
    fps: float = 10.0,
    every: int = 1,
    follow: int | None = None,
    egos: Sequence[int] = (),
    bounds: Bounds | None = None,
) -> None:
    """Write a video, .gif or .mp4.

    Args:
      path: file to write.
      network: the map.
      lane_map: of that map.
      trace: `[T, ...]`.
      fps: frames per second of the video.
      every: steps of the trace per frame.
      follow: slot; the view shows its surroundings, and moves on when it comes near the edge.
      egos: slots to outline.
      bounds: x_min, y_min, x_max, y_max of the view, m; the whole map if not given.

    Raises:
      ValueError: an unknown suffix, an empty trace, a slot that it does not have, or numbers below 1.
      OSError: the file cannot be written.
      ModuleNotFoundError: matplotlib, or for .mp4 imageio-ffmpeg, is not installed.
    """
    path = Path(path)
    check_suffix(path, VIDEO_SUFFIXES)
    if not (fps > 0 and math.isfinite(fps) and every >= 1):
        raise ValueError(f"{fps:g} frames per second, every {every} steps? both must be above 0")
    if not 1 / 100 <= 1 / fps:
        raise ValueError(f"{fps:g} frames per second? at most 100")
    moments = _Moments(network, lane_map, trace, egos if follow is None else {*egos, follow})
    write = _write_gif if path.suffix.lower() == ".gif" else _write_mp4
    write(path, _frames(network, moments, range(0, len(moments.time), every), follow, bounds), fps)


def check_suffix(path: str | Path, known: Sequence[str]) -> None:
    """Raise `ValueError` unless the path ends in one of these; `ModuleNotFoundError` if a writer lacks."""
    suffix = Path(path).suffix.lower()
    if suffix not in known:
        raise ValueError(f"cannot write '{path}': use {' or '.join(known)}")
    _need("matplotlib", "viz")
    if suffix == ".mp4":
        _need("imageio_ffmpeg", "viz")


def _need(module: str, extra: str) -> None:
    import importlib

    try:
        importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is not None and error.name.partition(".")[0] != module:
            raise
        raise ModuleNotFoundError(
            f"this needs {module.replace('_', '-')}: pip install 'limsim-jax[{extra}]'"
        ) from None


def _draw_map(ax: Axes, network: Network, bounds: Bounds | None) -> None:
    """The map without its traffic lights, whose colour would be taken for what they show."""
    for artist in draw_network(ax, network, bounds=bounds).get("lights", ()):
        artist.remove()


def _step(trace: Trace, time: float | None) -> int:
    times = np.asarray(trace.time)
    if not times.size:
        raise ValueError("the trace is empty")
    if time is None:
        return len(times) - 1
    step = times[1] - times[0] if len(times) > 1 else 1.0
    if not times[0] - 1.01 * step <= time <= times[-1] + 0.01 * step:
        raise ValueError(f"time = {time:g} s; the trace goes from {times[0]:g} to {times[-1]:g} s")
    return int(np.argmin(np.abs(times - time)))


class _Moments:
    """A trace on the host, in file coordinates: all that a frame needs."""

    def __init__(
        self, network: Network, lane_map: LaneMap, trace: Trace, egos: Sequence[int] | set[int]
    ) -> None:
        trace = jax.device_get(trace)
        self.time = np.asarray(trace.time)
        if self.time.ndim != 1 or not self.time.size:
            raise ValueError("the trace is empty" if self.time.ndim else "the trace has no axis of time")
        slots = trace.active.shape[1]
        for ego in egos:
            if not 0 <= ego < slots:
                raise ValueError(f"slot {ego}? the trace has slots 0 to {slots - 1}")
        self.active, self.v, self.vehicle = trace.active, trace.v, trace.vehicle
        x, y = absolute(lane_map, trace.box[..., 0], trace.box[..., 1])
        self.xy = np.stack([x, y], -1)  # [T, N, 2]
        self.heading, self.size = trace.box[..., 2], trace.box[..., 3:]
        self.collided = (trace.status & int(Status.COLLIDED)) != 0
        self.ego = np.isin(np.arange(slots), list(egos))
        self.egos_first = np.argsort(self.ego, kind="stable")  # drawn last, so on top
        limits = [lane.speed_limit for lane in network.drivable_lanes()]
        self.top_speed = 5.0 * math.ceil(max(limits, default=10.0) / 5.0)  # m/s
        self.bars, rows = signal_bars(network, lane_map)  # [B, 2, 2]
        states = jax.vmap(lane_states, (None, 0))(lane_map.signals, trace.phase)
        self.signals = np.asarray(states)[:, rows]  # [T, B]

    def outlines(self, k: int, scale: float) -> tuple[NDArray[Any], NDArray[Any]]:
        """Slots on the road, and their polygons `[M, 6, 2]`, enlarged by `scale`."""
        slots = self.egos_first[self.active[k][self.egos_first]]
        corner = _OUTLINE * self.size[k, slots, None] * scale
        cos, sin = np.cos(self.heading[k, slots])[:, None], np.sin(self.heading[k, slots])[:, None]
        turned = np.stack([cos * corner[..., 0] - sin * corner[..., 1],
                           sin * corner[..., 0] + cos * corner[..., 1]], -1)  # fmt: skip
        return slots, self.xy[k, slots, None] + turned

    def tails(self, k: int, seconds: float) -> list[NDArray[Any]]:
        """Where those who are on the road at step `k` came from in the last seconds."""
        first = int(np.searchsorted(self.time, self.time[k] - seconds))
        lines = []
        for slot in np.flatnonzero(self.active[k]):
            same = self.active[first : k + 1, slot] & (
                self.vehicle[first : k + 1, slot] == self.vehicle[k, slot]
            )
            since = len(same) - int(np.argmin(same[::-1])) if not same.all() else 0
            lines.append(self.xy[first + since : k + 1, slot])
        return lines


class _Layer:
    """The traffic on one pair of axes that already show the map."""

    def __init__(self, ax: Axes, moments: _Moments, tail: float = 0.0) -> None:
        from matplotlib.collections import LineCollection, PolyCollection

        self.moments, self.tail = moments, tail
        extent = ax.get_window_extent()
        (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
        figure = ax.get_figure(root=True)
        assert figure is not None
        pixels = min(extent.width / (x1 - x0), extent.height / (y1 - y0))
        self.scale = max(1.0, _LEAST / (_CAR * pixels))
        points = 72.0 / figure.dpi * pixels
        self._tails = LineCollection([], colors=INK, linewidths=max(0.6, 0.25 * points), alpha=0.45)
        self._signals = LineCollection([], linewidths=min(max(2.0, 0.9 * points), 6.0), capstyle="butt")
        self._vehicles = PolyCollection([], cmap="viridis")
        self._vehicles.set_clim(0, moments.top_speed)
        (self._collided,) = ax.plot(
            [], [], "x", color=COLLIDED, markersize=9, markeredgewidth=2, scalex=False, scaley=False
        )
        self.artists: dict[str, Any] = {
            "tails": self._tails,
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
        moments = self.moments
        if self.tail > 0:
            self._tails.set_segments(moments.tails(k, self.tail))
        self._signals.set_segments(list(moments.bars))
        self._signals.set_color([SIGNALS[SignalState(state)] for state in moments.signals[k]])
        slots, outlines = moments.outlines(k, self.scale)
        struck, ego = moments.collided[k, slots], moments.ego[slots]
        self._vehicles.set_verts(list(outlines))
        self._vehicles.set_array(moments.v[k, slots])
        self._vehicles.set_edgecolor(
            [COLLIDED if hit else EGO if own else INK for hit, own in zip(struck, ego, strict=True)]
        )
        self._vehicles.set_linewidth(np.where(struck | ego, 1.8, 0.4).tolist())
        self._collided.set_data(*moments.xy[k, slots[struck]].T)


class _Page:
    """A figure that shows the whole map (in strips if it is long and thin) or one window of it."""

    def __init__(
        self, network: Network, moments: _Moments, tail: float, bounds: Bounds | None, dpi: float
    ) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self.moments = moments
        width, height = _PAGE
        left, bottom, right, top = _MARGINS
        room = (width - left - right, height - bottom - top)
        shapes = outlines(network)
        windows, stacked, _ = strips(shapes, view(network, shapes, bounds), room)
        if bounds is not None:
            windows, stacked = [bounds], True
        if len(windows) == 1:
            x0, y0, x1, y1 = windows[0]
            width = min(max(room[1] * (x1 - x0) / (y1 - y0), 5.0), room[0]) + left + right
            height = min(max(room[0] * (y1 - y0) / (x1 - x0), 2.5), room[1]) + bottom + top
            room = (width - left - right, height - bottom - top)
        rows, columns = (len(windows), 1) if stacked else (1, len(windows))
        cell = (room[0] - (columns - 1) * _GAP) / columns, (room[1] - (rows - 1) * _GAP) / rows
        self.figure: Figure = Figure(figsize=(width, height), dpi=dpi, facecolor="white")
        self.canvas = FigureCanvasAgg(self.figure)
        self.layers: list[_Layer] = []
        for i, box in enumerate(windows):
            x = left + (0 if stacked else i) * (cell[0] + _GAP)
            y = bottom + (rows - 1 - i if stacked else 0) * (cell[1] + _GAP)
            ax = self.figure.add_axes((x / width, y / height, cell[0] / width, cell[1] / height))
            ax.set_xticks([])
            ax.set_yticks([])
            for spine in ax.spines.values():
                spine.set_color("#c5cad1")
            _draw_map(ax, network, box)
            self.layers.append(_Layer(ax, moments, tail))
        bar = self.figure.add_axes((1 - 0.75 / width, 0.12, 0.16 / width, 0.72))
        self.figure.colorbar(self.layers[0].artists["vehicles"], cax=bar, label="speed, m/s")
        self.clock = self.figure.text(left / width, 1 - 0.28 / height, "", fontsize=11, color=INK)
        self.name = Path(network.source).name or network.name

    def update(self, k: int) -> None:
        moments = self.moments
        for layer in self.layers:
            layer.update(k)
        active = moments.active[k]
        text = f"{self.name}   {moments.time[k]:6.1f} s   {active.sum()} vehicles"
        if collided := int((moments.collided[k] & active).sum()):
            text += f"   {collided} collided"
        if self.layers[0].scale > 1.05:
            text += f"   (drawn {self.layers[0].scale:.1f} times as large)"
        self.clock.set_text(text)

    def frames(self, steps: Sequence[int]) -> Iterator[NDArray[np.uint8]]:
        """Pixels `[H, W, 3]` of steps: what moves is drawn on a copy of what does not."""
        moving = [(layer, artist) for layer in self.layers for artist in layer.artists.values()]
        for artist in (*(artist for _, artist in moving), self.clock):
            artist.set_animated(True)
        self.canvas.draw()
        still = self.canvas.copy_from_bbox(self.figure.bbox)
        for k in steps:
            self.canvas.restore_region(still)
            self.update(k)
            for _, artist in moving:
                artist.axes.draw_artist(artist)
            self.figure.draw_artist(self.clock)
            pixels = np.asarray(self.canvas.buffer_rgba())[..., :3]
            yield pixels[: len(pixels) // 2 * 2, : pixels.shape[1] // 2 * 2].copy()  # H.264 needs even sizes


def _frames(
    network: Network, moments: _Moments, steps: Sequence[int], follow: int | None, bounds: Bounds | None
) -> Iterator[NDArray[np.uint8]]:
    if follow is None:
        yield from _Page(network, moments, 0.0, bounds, _DPI).frames(steps)
        return
    shape = (_PAGE[0] - _MARGINS[0] - _MARGINS[2]) / (_PAGE[1] - _MARGINS[1] - _MARGINS[3])
    half = np.array([shape * _CAMERA, _CAMERA])
    steps = list(steps)
    while steps:
        # one view for as long as the vehicle stays in its middle part
        first = steps[0]
        heading = moments.heading[first, follow]
        middle = moments.xy[first, follow] + 0.5 * _CAMERA * np.array([math.cos(heading), math.sin(heading)])
        inside = (np.abs(moments.xy[steps, follow] - middle) < 0.75 * half).all(-1)
        inside |= ~moments.active[steps, follow]
        count = len(steps) if inside.all() else max(1, int(np.argmin(inside)))
        low, high = middle - half, middle + half
        window = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
        yield from _Page(network, moments, 0.0, window, _DPI).frames(steps[:count])
        steps = steps[count:]


def _write_gif(path: Path, frames: Iterator[NDArray[np.uint8]], fps: float) -> None:
    from matplotlib import colormaps
    from matplotlib.colors import to_rgb
    from PIL import Image

    first = next(frames)
    # One palette for all frames, so that what stands still stays the same: colours of the first frame and
    # every colour that traffic may get.
    named = [to_rgb(color) for color in (*SIGNALS.values(), EGO, COLLIDED, INK)]
    colors = np.concatenate([colormaps["viridis"](np.linspace(0, 1, 48))[:, :3], named])
    rows = np.repeat(np.uint8(255 * colors), -(-first.shape[1] // len(colors)), 0)[: first.shape[1]]
    sample = np.concatenate([first, np.repeat(rows[None], max(1, len(first) // 4), 0)])
    palette = Image.fromarray(sample).quantize(256, method=Image.Quantize.MEDIANCUT)

    def images() -> Iterator[Any]:
        for pixels in frames:
            yield Image.fromarray(pixels).quantize(palette=palette, dither=Image.Dither.NONE)

    start = Image.fromarray(first).quantize(palette=palette, dither=Image.Dither.NONE)
    duration = 10 * max(1, round(100 / fps))  # ms; GIF counts in hundredths of a second
    start.save(path, format="GIF", save_all=True, append_images=images(), duration=duration, loop=0)


def _write_mp4(path: Path, frames: Iterator[NDArray[np.uint8]], fps: float) -> None:
    import subprocess

    import imageio_ffmpeg

    path.touch()  # a file that cannot be written is our error, not one line of many from ffmpeg
    first = next(frames)
    size = f"{first.shape[1]}x{first.shape[0]}"
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", f"{fps:g}", "-i", "-"]
    coded = ["-an", "-c:v", "libx264", "-crf", "20", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", *raw, *coded, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None and process.stderr is not None
        try:
            process.stdin.write(first.tobytes())
            for pixels in frames:
                process.stdin.write(pixels.tobytes())
            process.stdin.close()
        except BrokenPipeError:  # ffmpeg gave up, and says why
            pass
        said = process.stderr.read().decode(errors="replace")
    if process.returncode:
        raise OSError(None, " ".join(said.split()) or "ffmpeg failed", str(path))
