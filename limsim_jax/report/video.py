"""Pictures and videos of traffic, from a `simulation.trace.Trace`.

Videos as .mp4 need imageio-ffmpeg (extra `viz`). matplotlib is imported when something is drawn.
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
from limsim_jax.maps.outline import Bounds
from limsim_jax.report.draw.painter import INK
from limsim_jax.report.frames import COLLIDED, EGO, SIGNALS, Scene, step_at
from limsim_jax.report.stills import DPI, Camera, Captions, MapPage
from limsim_jax.report.strip import FilmLike, Strip, frame_at, palette
from limsim_jax.simulation.ending import shown_steps
from limsim_jax.simulation.trace import Trace

VIDEO_SUFFIXES = (".gif", ".mp4")
PICTURE_SUFFIXES = (".png",)


def write_picture(
    path: str | Path,
    network: Network,
    lane_map: LaneMap,
    trace: Trace,
    at: float | None = None,
    *,
    follow: int | None = None,
    egos: Sequence[int] = (),
    moments: Iterable[Mapping[str, Any]] = (),
    tail: float = 4.0,
    bounds: Bounds | None = None,
    dpi: float = 1.5 * DPI,
    sensors: FilmLike | None = None,
) -> None:
    """Write one moment as .png, 1,920 pixels wide.

    Args:
      path: file to write.
      network: the map.
      lane_map: of that map.
      trace: `[T, ...]`.
      at: s, the step nearest to it; the last one by default.
      follow: slot; the view shows its surroundings. Without it, the whole map; long thin maps in strips.
      egos: slots to outline.
      moments: rows with `kind` and `time` (s) and, where known, `value` and `other` (slot): the caption.
      tail: s, how far back to show where vehicles came from.
      bounds: x_min, y_min, x_max, y_max of the view, m, instead of the whole map.
      dpi: dots per inch of a picture that is 12.8 inches wide.
      sensors: what the ego senses, a `Film`: below the traffic.

    Raises:
      ValueError: an unknown suffix, an empty trace, a time outside it, or a slot that it does not have.
      OSError: the file cannot be written.
    """
    from PIL import Image

    check_suffix(path, PICTURE_SUFFIXES)
    k = step_at(trace, at)
    scene = Scene(network, lane_map, trace, egos if follow is None else {*egos, follow})
    captions = Captions(scene, moments)
    if follow is None:
        page: MapPage | Camera = MapPage(network, scene, captions, tail, bounds, dpi)
    else:
        page = Camera(network, scene, captions, follow, tail, dpi)
    frames = _with_sensors(page.frames([k]), scene.time[[k]], sensors)
    Image.fromarray(next(iter(frames))).save(path, format="PNG")


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
    moments: Iterable[Mapping[str, Any]] = (),
    begin: float | None = None,
    end: float | None = None,
    bounds: Bounds | None = None,
    sensors: FilmLike | None = None,
) -> None:
    """Write a video, .gif or .mp4, of 1,280 x 720 pixels.

    With sensors it is higher.

    With an ego (`follow`, or the first of `egos`) it ends 2 s after that has arrived or left.

    Args:
      path: file to write.
      network: the map.
      lane_map: of that map.
      trace: `[T, ...]`.
      fps: frames per second of the video.
      every: steps of the trace per frame.
      follow: slot; the camera stays above it.
      egos: slots to outline.
      moments: rows with `kind` and `time` (s) and, where known, `value` and `other` (slot): captions.
      begin: s, the first moment shown; the start of the trace by default.
      end: s, the last moment shown, whatever the ego does.
      bounds: x_min, y_min, x_max, y_max of the view, m, instead of the whole map.
      sensors: what the ego senses, a `Film`: below the traffic, at each moment the last frame.

    Raises:
      ValueError: an unknown suffix, an empty trace, a slot that it does not have, no step between `begin`
        and `end`, or numbers that must be above 0.
      OSError: the file cannot be written.
      ModuleNotFoundError: imageio-ffmpeg is not installed and .mp4 is wanted.
    """
    path = Path(path)
    if every < 1:
        raise ValueError(f"every {every} steps: at least 1")
    check_video(path, fps)
    scene = Scene(network, lane_map, trace, egos if follow is None else {*egos, follow})
    captions = Captions(scene, moments)
    chief = follow if follow is not None else next(iter(egos), None)
    last = len(scene.time) if chief is None else shown_steps(scene.time, scene.ends[chief], captions.times)
    if end is not None:
        last = int(np.searchsorted(scene.time, end + 1e-6, side="right"))
    first = 0 if begin is None else int(np.searchsorted(scene.time, begin - 1e-6))
    if first >= last:
        raise ValueError(f"begin {begin} and end {end}: no step in between; the trace goes from "
                         f"{scene.time[0]:g} to {scene.time[-1]:g} s")  # fmt: skip
    if follow is None:
        page: MapPage | Camera = MapPage(network, scene, captions, 0.0, bounds, DPI)
    else:
        page = Camera(network, scene, captions, follow, 0.0, DPI)
    steps = range(first, last, every)
    frames = _with_sensors(page.frames(steps), scene.time[steps], sensors)
    write_frames(path, frames, fps, None if sensors is None else palette(sensors))


def _with_sensors(
    frames: Iterable[NDArray[np.uint8]], times: NDArray[Any], sensors: FilmLike | None
) -> Iterator[NDArray[np.uint8]]:
    """Frames with the strip of the sensors below."""
    if sensors is None:
        yield from frames
        return
    strip, drawn = None, (-1, np.zeros((0, 0, 3), np.uint8))
    for pixels, time in zip(frames, times, strict=True):
        strip = strip or Strip(sensors, pixels.shape[1])
        if (k := frame_at(sensors.time, float(time))) != drawn[0]:
            drawn = k, strip.draw(k)
        yield np.concatenate([pixels, drawn[1]])


def check_video(path: Path, fps: float) -> None:
    """Raise `ValueError` unless a video can be written like this; `ModuleNotFoundError` if a writer lacks."""
    check_suffix(path, VIDEO_SUFFIXES)
    if not (fps > 0 and math.isfinite(fps)):
        raise ValueError(f"{fps:g} frames per second: it must be above 0")
    if fps > 100:
        raise ValueError(f"{fps:g} frames per second: at most 100")


def write_frames(
    path: Path, frames: Iterator[NDArray[np.uint8]], fps: float, colors: NDArray[np.uint8] | None = None
) -> None:
    """Write frames as .gif or .mp4; `colors` `[K, 3]` are some that a .gif has to show."""
    if path.suffix.lower() == ".gif":
        _write_gif(path, frames, fps, colors)
    else:
        _write_mp4(path, frames, fps)


def check_suffix(path: str | Path, known: Sequence[str]) -> None:
    """Raise `ValueError` unless the path ends in one of these; `ModuleNotFoundError` if a writer lacks."""
    suffix = Path(path).suffix.lower()
    if suffix not in known:
        raise ValueError(f"cannot write '{path}': use {' or '.join(known)}")
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


def _write_gif(
    path: Path, frames: Iterator[NDArray[np.uint8]], fps: float, more: NDArray[np.uint8] | None
) -> None:
    from matplotlib import colormaps
    from matplotlib.colors import to_rgb
    from PIL import Image

    first = next(frames)
    # One palette for all frames, so that what stands still stays the same: colours of the first frame and
    # every colour that traffic may get.
    named = [to_rgb(color) for color in (*SIGNALS.values(), EGO, COLLIDED, INK)]
    colors = np.concatenate([colormaps["viridis"](np.linspace(0, 1, 48))[:, :3], named])
    colors = np.concatenate([(255 * colors).astype(np.uint8), *([] if more is None else [more])])
    rows = np.repeat(colors, -(-first.shape[1] // len(colors)), 0)[: first.shape[1]]
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
