"""Drawings of a `Network`: lanes, marks, directions, junctions, lights, signs, crosswalks, conflicts.

`draw_map` makes a page with title, legend and scale bar. `draw_network` draws on axes that the caller owns
and is the base layer of animations: draw it once, keep the background, and blit traffic above it at
`TRAFFIC_ZORDER` or higher.

matplotlib (extra `viz`) is imported when something is drawn, never before.
"""

from limsim_jax.report.draw.painter import TRAFFIC_ZORDER, draw_network
from limsim_jax.report.draw.sheet import SUFFIXES, draw_map

__all__ = ["SUFFIXES", "TRAFFIC_ZORDER", "draw_map", "draw_network"]
