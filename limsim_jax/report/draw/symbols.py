"""Symbols of a drawing: dashed lines and arrows."""

from __future__ import annotations

import math

import numpy as np

from limsim_jax.maps.network import Array


def dashes(line: Array, road_s: Array, period: float) -> Array:
    """Segments `[K, 2, 2]` of a dashed line: the painted half of each period.

    Args:
        line: points `[M, 2]`, m.
        road_s: reference-line distance of each point `[M]`, m; dashes of lanes side by side are level.
        period: a dash and a gap, m.
    """
    if road_s[-1] < road_s[0]:
        line, road_s = line[::-1], road_s[::-1]
    half = period / 2
    first, last = math.ceil(road_s[0] / half), math.floor(road_s[-1] / half)
    u = np.union1d(road_s, np.arange(first, last + 1) * half)
    xy = np.stack([np.interp(u, road_s, line[:, 0]), np.interp(u, road_s, line[:, 1])], -1)
    painted = np.floor(0.5 * (u[:-1] + u[1:]) / half) % 2 == 0
    return np.stack([xy[:-1], xy[1:]], 1)[painted]


def darts(xy: Array, heading: Array, length: float, width: float) -> Array:
    """Arrow heads `[K, 4, 2]`, centred on `xy [K, 2]`; the first corner is the tip."""
    outline = np.array([[0.5, 0.0], [-0.5, 0.5], [-0.25, 0.0], [-0.5, -0.5]]) * [length, width]
    return _placed(outline, xy, heading)


def arrows(xy: Array, heading: Array, length: float, width: float) -> Array:
    """Arrows with a shaft `[K, 7, 2]`; the first corner is the tip."""
    outline = np.array(
        [[0.5, 0.0], [0.0, 0.5], [0.0, 0.13], [-0.5, 0.13], [-0.5, -0.13], [0.0, -0.13], [0.0, -0.5]]
    )
    return _placed(outline * [length, width], xy, heading)


def _placed(outline: Array, xy: Array, heading: Array) -> Array:
    cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
    x, y = outline[:, 0], outline[:, 1]
    return xy[:, None, :] + np.stack([cos * x - sin * y, sin * x + cos * y], -1)
