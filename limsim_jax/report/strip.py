"""What an ego senses as a strip of pixels: its cameras, point cloud and bird's-eye view side by side.

Videos and pictures have it below the traffic. Pillow is imported when something is drawn.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps.scenery import Label
from limsim_jax.report.draw.painter import INK
from limsim_jax.sensors.bev import CHANNELS, Raster
from limsim_jax.sensors.camera import COLORS, Pictures
from limsim_jax.sensors.lidar import Scan, points_of
from limsim_jax.sensors.objects import Objects
from limsim_jax.sensors.rig import Lidar, Rig
from limsim_jax.sensors.scene import Pose

REACH = 40.0
"""m around the ego that the point cloud shows."""

SURFACES = (COLORS[Label.TERRAIN], (150, 154, 160), (120, 190, 150), (245, 245, 240), (44, 92, 160))
"""Red, green, blue of a cell of the bird's-eye view: country, drivable, route, mark, occupied."""

INKS = {
    "night": "#14181d",
    "ground": "#6c7a89",
    "body": "#ffd166",
    "found": "#7fd1ff",
    "false": "#ff9d76",
    "found_by_day": "#0072b2",
    "false_by_day": "#d55e00",
}
"""Of the point cloud: its dark ground, and points of the road and of vehicles.

Then of the object list: true entries and false tracks there, and the same in the bird's-eye view.
"""

_MOST_HEIGHT = 320  # pixels of a strip that is 1,280 wide
_GAP = 4  # pixels


class FilmLike(Protocol):
    """What an ego senses over time: `api.sensed.Film`; frames are the first axis."""

    @property
    def time(self) -> NDArray[Any]:
        """Of the frames, s."""
        ...

    @property
    def rig(self) -> Rig:
        """Of the ego."""
        ...

    @property
    def pictures(self) -> Pictures | None:
        """Of its cameras."""
        ...

    @property
    def scan(self) -> Scan | None:
        """Of its LiDAR."""
        ...

    @property
    def bev(self) -> NDArray[Any]:
        """The bird's-eye view."""
        ...

    @property
    def objects(self) -> Objects:
        """The object list."""
        ...

    @property
    def pose(self) -> Pose:
        """Where the ego is."""
        ...

    @property
    def raster(self) -> Raster:
        """Extent of the bird's-eye view."""
        ...

    @property
    def size(self) -> tuple[float, float]:
        """Length and width of the ego, m."""
        ...


def frame_at(time: NDArray[Any], at: float) -> int:
    """The last frame that is not later than a time (s); the first one before it."""
    return max(0, int(np.searchsorted(time, at + 1e-4, side="right")) - 1)


def grid(rig: Rig) -> tuple[int, int]:
    """Columns and rows of the pictures of a rig."""
    columns = min(3, len(rig.cameras))
    return columns, math.ceil(len(rig.cameras) / max(columns, 1))


def surfaces(bev: NDArray[Any]) -> NDArray[np.uint8]:
    """Which of `SURFACES` the cells of a bird's-eye view show: `[..., 6, H, W]` to `[..., H, W]`."""
    layer: dict[str, NDArray[Any]] = dict(zip(CHANNELS, np.moveaxis(np.asarray(bev), -3, 0), strict=True))
    found = (layer["drivable"] > 0).astype(np.uint8)
    for value, name in ((2, "route"), (3, "mark"), (4, "occupied")):
        found[layer[name] > 0] = value
    return found


def cloud(lidar: Lidar, scan: Scan) -> tuple[NDArray[Any], NDArray[np.bool_], NDArray[np.bool_]]:
    """Points `[R, A, 3]` in the frame of the ego; whether they came back, and from a vehicle."""
    points, back = points_of(lidar, scan)
    back = np.asarray(back)
    return np.asarray(points), back, back & (np.asarray(scan.slot) >= 0)


def corners(x: float, y: float, heading: float, length: float, width: float) -> NDArray[np.float64]:
    """Corners of a box, closed, `[5, 2]`."""
    unit = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1), (1, 1)]) / 2 * (length, width)
    cos, sin = np.cos(heading), np.sin(heading)
    return np.array([x, y]) + unit @ np.array([[cos, sin], [-sin, cos]])


class Strip:
    """Draws the frames of a film, each `[height, width, 3]`.

    Args:
      film: what the ego senses.
      width: pixels.
    """

    def __init__(self, film: FilmLike, width: int = 1280) -> None:
        self.film, self.width = film, width
        columns, rows = grid(film.rig)
        wide = 0.0
        if columns:
            camera = film.rig.cameras[0]
            wide = columns * camera.width / camera.height / rows
        raster = film.raster
        shares = [wide, 1.0 if film.rig.lidar else 0.0, 2 * raster.side / (raster.ahead + raster.behind)]
        used = sum(share > 0 for share in shares)
        height = min((width - _GAP * (used + 1)) / sum(shares), _MOST_HEIGHT * width / 1280)
        inner = int(height) // 2 * 2
        self.height = inner + 2 * _GAP
        self.widths = [int(share * inner) for share in shares]
        self._inner = inner

    def draw(self, k: int) -> NDArray[np.uint8]:
        """Frame `k`."""
        from PIL import Image

        page = Image.new("RGB", (self.width, self.height), "#ffffff")
        free = self.width - sum(self.widths) - _GAP * (sum(w > 0 for w in self.widths) - 1)
        x = max(_GAP, free // 2)
        for wide, part in zip(self.widths, (self._pictures, self._points, self._raster), strict=True):
            if wide:
                page.paste(part(k, wide), (x, _GAP))
                x += wide + _GAP
        return np.asarray(page)

    def _pictures(self, k: int, wide: int) -> Any:
        from PIL import Image, ImageDraw

        film, pictures = self.film, self.film.pictures
        assert pictures is not None
        columns, rows = grid(film.rig)
        page = Image.new("RGB", (wide, self._inner), "#ffffff")
        pen = ImageDraw.Draw(page)
        w, h = wide / columns, self._inner / rows
        for i, camera in enumerate(film.rig.cameras):
            row, column = divmod(i, columns)
            x0, y0 = round(column * w), round(row * h)
            x1, y1 = round((column + 1) * w) - 2, round((row + 1) * h) - 2
            picture = Image.fromarray(np.asarray(pictures.color[k, i]))
            page.paste(picture.resize((x1 - x0, y1 - y0), Image.Resampling.NEAREST), (x0, y0))
            _label(pen, x0, y0, camera.name.replace("_", " "))
        return page

    def _points(self, k: int, wide: int) -> Any:
        from PIL import Image, ImageDraw

        film = self.film
        assert film.scan is not None and film.rig.lidar is not None
        page = Image.new("RGB", (wide, self._inner), INKS["night"])
        pen = ImageDraw.Draw(page)
        scale = min(wide, self._inner) / 2 / REACH
        middle = np.array([wide / 2, self._inner / 2])
        scan = Scan(*(np.asarray(x)[k] for x in film.scan))
        points, back, struck = cloud(film.rig.lidar, scan)
        at = np.round(middle - scale * points[..., 1::-1]).astype(int)  # ahead is up, left is left
        inside = back & (at >= 1).all(-1) & (at < (wide - 1, self._inner - 1)).all(-1)
        pen.point([tuple(p) for p in at[inside & ~struck].tolist()], fill=INKS["ground"])
        for x, y in at[inside & struck].tolist():
            pen.rectangle((x - 1, y - 1, x, y), fill=INKS["body"])
        self._boxes(pen, k, scale, middle, INKS["found"], INKS["false"])
        self._own(pen, scale, middle, "#ffffff")
        _label(pen, 0, 0, f"LiDAR, {int(back.sum()):,} points")
        return page

    def _raster(self, k: int, wide: int) -> Any:
        from PIL import Image, ImageDraw

        film, raster = self.film, self.film.raster
        image = np.asarray(SURFACES, np.uint8)[surfaces(film.bev[k])]
        page = Image.fromarray(image).resize((wide, self._inner), Image.Resampling.NEAREST)
        pen = ImageDraw.Draw(page)
        scale = self._inner / (raster.ahead + raster.behind)
        middle = np.array([wide / 2, scale * raster.ahead])
        self._boxes(pen, k, scale, middle, INKS["found_by_day"], INKS["false_by_day"])
        self._own(pen, scale, middle, INK)
        _label(pen, 0, 0, "bird's-eye view")
        return page

    def _boxes(self, pen: Any, k: int, scale: float, middle: NDArray[Any], found: str, false: str) -> None:
        objects = self.film.objects
        for i in np.flatnonzero(np.asarray(objects.there[k])):
            box = [
                float(np.asarray(x)[k, i])
                for x in (objects.x, objects.y, objects.heading, objects.length, objects.width)
            ]
            at = middle - scale * corners(*box)[:, ::-1]
            color = found if int(objects.id[k, i]) >= 0 else false
            pen.line([tuple(p) for p in at.tolist()], fill=color, width=2)

    def _own(self, pen: Any, scale: float, middle: NDArray[Any], color: str) -> None:
        at = middle - scale * corners(0, 0, 0, *self.film.size)[:, ::-1]
        pen.polygon([tuple(p) for p in at.tolist()], fill=color)


def _label(pen: Any, x: int, y: int, text: str) -> None:
    from PIL import ImageFont

    font = ImageFont.load_default(12)
    pen.rectangle((x, y, x + pen.textlength(text, font=font) + 7, y + 16), fill="#ffffff")
    pen.text((x + 3, y + 1), text, fill=INK, font=font)


def palette(film: FilmLike) -> NDArray[np.uint8]:
    """Colours of the pictures of a film, `[K, 3]`, at most 256: the most frequent ones if there are more."""
    if film.pictures is None:
        return np.zeros((1, 3), np.uint8)
    packed, count = np.unique(pack_colors(film.pictures.color), return_counts=True)
    kept = np.sort(packed[np.argsort(-count, kind="stable")[:256]])
    return np.stack([kept >> 16, kept >> 8 & 255, kept & 255], -1).astype(np.uint8)


def pack_colors(color: Any) -> NDArray[np.int32]:
    """Red, green, blue `[..., 3]` as one number."""
    color = np.asarray(color).astype(np.int32)
    return color[..., 0] << 16 | color[..., 1] << 8 | color[..., 2]


def write_strips(path: Path, film: FilmLike, *, fps: float | None = None) -> None:
    """Write a film as a video, .gif or .mp4.

    Args:
      path: file to write.
      film: what the ego senses.
      fps: frames per second; None: as fast as it happened.

    Raises:
      ValueError: another suffix, or frames per second beyond 0 to 100.
      ModuleNotFoundError: imageio-ffmpeg is not installed and .mp4 is wanted.
    """
    from limsim_jax.report.video import check_video, write_frames

    time = np.asarray(film.time, float)
    if fps is None:
        fps = float(np.clip(1 / np.median(np.diff(time)), 0.1, 100)) if len(time) > 1 else 1.0
    check_video(path, fps)
    strip = Strip(film)
    write_frames(path, (strip.draw(k) for k in range(len(time))), fps, palette(film))
