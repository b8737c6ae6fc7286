"""`Map` as users have it: with its picture."""

from __future__ import annotations

import io
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from limsim_jax.maps import map as _map
from limsim_jax.maps.network import Network

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Drawing:
    """A figure that a notebook shows.

    Args:
      figure: of Matplotlib.
    """

    def __init__(self, figure: Figure) -> None:
        self.figure = figure

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        self.figure.savefig(file, format="png")
        return file.getvalue()


class Map(_map.Map):
    """A road map on the host and on the device.

    Attributes:
      network: what the file says, float64.
      lanes: arrays on the device, for look-ups such as `pose` and `to_frenet`.
      goals, origins: names of the ways out and in, with the ids of their lanes.
    """

    def draw(self, path: str | Path | None = None, **options: Any) -> Drawing:
        """Draw the map on a page with a scale bar; a notebook shows it.

        Args:
          path: file to write as well: .png, .svg or .pdf.
          options: of `report.draw.draw_map`: `bounds` (x_min, y_min, x_max, y_max, m), `labels`,
            `conflicts`, `dpi`, and `size` (inches).

        Raises:
          MapError: see `report.draw.draw_map`.
        """
        from limsim_jax.report.draw import draw_map

        return Drawing(draw_map(self.network, path, **options))


def load_map(source: str | Path | Network | _map.Map, *, cache: bool = True) -> Map:
    """Read a map.

    Args:
      source: an OpenDRIVE (`.xodr`) or SUMO (`.net.xml`) file, also gzipped; the name of a bundled map; or a
        `Network`.
      cache: keep what was read on disk, so that the next load of the same bytes is quick.

    Raises:
      MapError: one line with file, line, element and reason.
    """
    found = _map.load_map(source, cache=cache)
    return found if isinstance(found, Map) else Map(**{x.name: getattr(found, x.name) for x in fields(found)})
