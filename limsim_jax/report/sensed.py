"""A sheet with what an ego senses: its cameras, point cloud and bird's-eye view."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from limsim_jax.report.draw.painter import INK
from limsim_jax.report.strip import INKS, REACH, SURFACES, cloud, corners, surfaces
from limsim_jax.sensors.bev import Raster
from limsim_jax.sensors.camera import Pictures
from limsim_jax.sensors.lidar import Scan
from limsim_jax.sensors.objects import Objects
from limsim_jax.sensors.rig import Rig

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDTH = 12.0  # inches


def draw_sheet(
    rig: Rig,
    pictures: Pictures | None,
    scan: Scan | None,
    bev: NDArray[Any],
    objects: Objects,
    *,
    raster: Raster,
    size: tuple[float, float],
    title: str = "",
    path: str | Path | None = None,
    dpi: float = 100.0,
) -> Figure:
    """Draw what an ego senses.

    Args:
      rig: of the ego.
      pictures: of its cameras; None: it has none.
      scan: of its LiDAR; None: it has none.
      bev: the bird's-eye view, see `sensors.bev`.
      objects: its object list.
      raster: extent of `bev`.
      size: length and width of the ego, m.
      title: above all.
      path: .png file to write as well.
      dpi: pixels per inch.
    """
    from matplotlib.figure import Figure

    columns = min(3, len(rig.cameras)) or 1
    rows = -(-len(rig.cameras) // columns)
    picture = _WIDTH / columns * (rig.cameras[0].height / rig.cameras[0].width) if rig.cameras else 0.0
    top, below = 0.35 if title else 0.05, 4.3
    tall = top + rows * picture + below
    figure = Figure(figsize=(_WIDTH, tall), dpi=dpi, facecolor="white")
    if title:
        figure.text(0.008, 1 - 0.23 / tall, title, fontsize=12, weight="bold", color=INK)
    for k, camera in enumerate(rig.cameras):
        row, column = divmod(k, columns)
        box = (column / columns, 1 - (top + (row + 1) * picture) / tall, 1 / columns, picture / tall)
        ax = figure.add_axes((box[0] + 0.002, box[1] + 0.004, box[2] - 0.004, box[3] - 0.008))
        assert pictures is not None
        ax.imshow(np.asarray(pictures.color[k]), interpolation="nearest", aspect="auto")
        ax.set_axis_off()
        ax.text(
            0.01, 0.97, camera.name.replace("_", " "), transform=ax.transAxes, va="top", fontsize=9,
            color=INK, bbox={"facecolor": "white", "alpha": 0.75, "linewidth": 0, "pad": 1.5},
        )  # fmt: skip
    place = [(0.045, 0.43), (0.545, 0.43)]
    axes = [figure.add_axes((x, 0.42 / tall, w, (below - 0.8) / tall)) for x, w in place]
    _draw_points(axes[0], rig, scan, objects, size)
    _draw_raster(axes[1], bev, raster, objects, size)
    for ax in axes:
        ax.tick_params(labelsize=7, colors=INK, length=2.5)
        ax.spines[:].set_color("#c5cad1")
        ax.set_xlabel("m to the left of the vehicle", fontsize=8, color=INK, labelpad=1)
    if path is not None:
        figure.savefig(path, dpi=dpi)
    return figure


def _draw_points(ax: Axes, rig: Rig, scan: Scan | None, objects: Objects, size: tuple[float, float]) -> None:
    """The point cloud from above, ahead is up; boxes of the object list."""
    ax.set_facecolor(INKS["night"])
    ax.set_aspect("equal")
    half = REACH * 1.28
    ax.set_xlim(half, -half)
    ax.set_ylim(-REACH, REACH)
    words = "no LiDAR"
    if scan is not None and rig.lidar is not None:
        points, back, struck = cloud(rig.lidar, scan)
        for mask, color, dot in ((back & ~struck, INKS["ground"], 0.5), (struck, INKS["body"], 2.2)):
            ax.scatter(points[mask, 1], points[mask, 0], s=dot, c=color, linewidths=0)
        layers = len(rig.lidar.elevations)
        words = f"LiDAR, {layers} layer{'s' * (layers > 1)}: {int(back.sum()):,} points"
    _boxes(ax, objects, INKS["found"], INKS["false"])
    _own(ax, size, "white")
    ax.set_title(f"{words}, and the object list", fontsize=9, color=INK, loc="left", pad=3)


def _draw_raster(
    ax: Axes, bev: NDArray[Any], raster: Raster, objects: Objects, size: tuple[float, float]
) -> None:
    """The bird's-eye view in colours; velocities of the object list as lines of a second."""
    image = np.asarray(SURFACES, np.uint8)[surfaces(bev)]
    extent = (raster.side, -raster.side, -raster.behind, raster.ahead)
    ax.imshow(image, extent=extent, interpolation="nearest", aspect="equal")
    half = (raster.ahead + raster.behind) / 2 * 1.28
    ax.set_facecolor("#f4f4f1")
    ax.set_xlim(half, -half)
    for k in np.flatnonzero(np.asarray(objects.there)):
        x, y, vx, vy = (float(v[k]) for v in (objects.x, objects.y, objects.vx, objects.vy))
        if abs(y) < raster.side and -raster.behind < x < raster.ahead:
            ax.plot([y, y + vy], [x, x + vx], color=INK, lw=1.2)
    _boxes(ax, objects, INKS["found_by_day"], INKS["false_by_day"], clip=raster)
    _own(ax, size, INK)
    ax.set_title(
        f"bird's-eye view, {raster.cell:g} m cells; object list with a second of way",
        fontsize=9, color=INK, loc="left", pad=3,
    )  # fmt: skip


def _boxes(ax: Axes, objects: Objects, true: str, false: str, clip: Raster | None = None) -> None:
    for k in np.flatnonzero(np.asarray(objects.there)):
        x, y = float(objects.x[k]), float(objects.y[k])
        if clip is not None and not (abs(y) < clip.side and -clip.behind < x < clip.ahead):
            continue
        box = corners(x, y, *(float(v[k]) for v in (objects.heading, objects.length, objects.width)))
        real = int(objects.id[k]) >= 0
        ax.plot(box[:, 1], box[:, 0], color=true if real else false, lw=1.1, ls="-" if real else ":")


def _own(ax: Axes, size: tuple[float, float], color: str) -> None:
    box = corners(0, 0, 0, *size)
    ax.fill(box[:, 1], box[:, 0], color=color)
