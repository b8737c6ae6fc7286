"""What the ego senses in a replay: pictures by a palette, point clouds, bird's-eye views, object lists."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps.lane_map import LaneMap, absolute
from limsim_jax.report.strip import INKS, REACH, SURFACES, FilmLike, grid, pack_colors, palette, surfaces
from limsim_jax.report.viewer.pack import Pack, held, origin

UNIT = 0.1
"""m, resolution of a point cloud; finer ones hardly deflate."""

_STRUCK = 1 << 15  # a ray that met a vehicle


def add_sensed(pack: Pack, lane_map: LaneMap, film: FilmLike) -> dict[str, Any]:
    """Add the frames of a film.

    Each camera has its frames one after the other, an index of a colour per pixel: what stands still
    deflates. Ranges of the LiDAR are whole `UNIT`s.
    """
    time = np.asarray(film.time, float)
    pack.add("sense_time", time[None], 10_000)
    meta: dict[str, Any] = {"frames": len(time), "size": list(film.size), "reach": REACH}
    meta["colors"] = INKS
    if film.pictures is not None:
        colors = palette(film)
        pack.add_bytes("pictures", np.moveaxis(_indices(film.pictures.color, colors), 1, 0))
        camera = film.rig.cameras[0]
        meta["cameras"] = {
            "names": [name.replace("_", " ") for name in film.rig.names],
            "width": camera.width,
            "height": camera.height,
            "grid": grid(film.rig),
            "palette": colors.tolist(),
        }
    if film.scan is not None and film.rig.lidar is not None:
        lidar = film.rig.lidar
        away = np.asarray(film.scan.range, float)
        back = away < lidar.range
        code = np.where(back, np.clip(np.round(away / UNIT), 1, _STRUCK - 1), 0).astype(np.uint16)
        code += np.where(back & (np.asarray(film.scan.slot) >= 0), _STRUCK, 0).astype(np.uint16)
        pack.add_bytes("ranges", np.stack([code & 255, code >> 8]))
        meta["lidar"] = {
            "x": lidar.x, "y": lidar.y, "elevations": list(lidar.elevations), "columns": lidar.columns,
            "unit": UNIT,
        }  # fmt: skip
    raster = film.raster
    pack.add_bytes("bev", surfaces(film.bev))
    meta["raster"] = {
        "ahead": raster.ahead, "behind": raster.behind, "side": raster.side, "shape": raster.shape,
        "palette": SURFACES,
    }  # fmt: skip
    meta["objects"] = _add_objects(pack, film)
    believed = film.objects.pose
    pack.add_points("sense", np.stack(absolute(lane_map, believed.x, believed.y), -1), origin(lane_map))
    pack.add("sense_heading", np.asarray(believed.heading)[None], 10_000)
    return meta


def _add_objects(pack: Pack, film: FilmLike) -> int:
    """Add the object list, and return its number of rows."""
    objects = film.objects
    there = np.asarray(objects.there)
    pack.add("object_there", there.T, 1)
    columns = {
        "id": 1,
        "x": 100,
        "y": 100,
        "heading": 1000,
        "length": 100,
        "width": 100,
        "vx": 100,
        "vy": 100,
    }
    for name, scale in columns.items():
        pack.add(f"object_{name}", held(np.asarray(getattr(objects, name), float), there).T, scale)
    return there.shape[1]


def _indices(color: Any, colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The nearest colour of the palette for every pixel."""
    packed, where = np.unique(pack_colors(color), return_inverse=True)
    wanted = np.stack([packed >> 16, packed >> 8 & 255, packed & 255], -1)
    away = ((wanted[:, None].astype(int) - colors[None]) ** 2).sum(-1)
    return away.argmin(-1).astype(np.uint8)[where].reshape(np.shape(color)[:-1])
