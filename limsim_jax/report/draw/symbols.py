"""Symbols of a drawing: arrows."""

from __future__ import annotations

import numpy as np

from limsim_jax.maps.network import Array


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
