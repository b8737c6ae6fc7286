"""Ray casting: which oriented box each ray of a sensor meets first, and where.

Slab tests in the frame of each box (Kay and Kajiya 1986). Sides are upright and rays of a level sensor share
their horizontal direction by columns, so the tests with the sides are made once per column.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from limsim_jax.sensors.scene import Bodies
from limsim_jax.xla import computed_once

NOTHING = 1e9
"""Ray length of a ray that meets nothing."""

_TINY = 1e-9  # of a direction: less is along the side of a box


class Rays(NamedTuple):
    """Rays of `C` sensors with `H` rows and `W` columns.

    They are in the frame of the vehicle. Axes `H1` and `W1` of size 1 stand for all rows or columns.
    Directions have any length; the length of a ray is in units of its direction.
    """

    x: Float[Array, " C"]  # m, origin
    y: Float[Array, " C"]
    z: Float[Array, " C"]
    dx: Float[Array, "C H1 W"]
    dy: Float[Array, "C H1 W"]
    dz: Float[Array, "C H W1"]


class Hits(NamedTuple):
    """What rays meet first."""

    length: Float[Array, "C H W"]  # in units of the direction; NOTHING: nothing
    body: Int[Array, "C H W"]  # -1: nothing


def cast(rays: Rays, bodies: Bodies) -> Hits:
    """The first box that each ray meets. Boxes around an origin are not met.

    Lengths are rounded so that a number carries the body as well: to 1e-6 of themselves for up to 16 boxes,
    and twice that for each doubling of them.
    """
    enter, leave = _sides(rays, bodies)
    low, high = _lids(rays, bodies)
    # a body that is not there is left before it is entered
    leave = jnp.where(bodies.there[:, None, None, None], leave, -NOTHING)
    enter, leave, low, high = computed_once((enter, leave, low, high))
    count = bodies.x.shape[0]
    # Positive floats and their bits have one order. One minimum of integers takes half the time of two
    # selections, and its loop over boxes, unrolled, an eighth of that of a scan.
    bits = (1 << count.bit_length()) - 1
    nothing = lax.bitcast_convert_type(jnp.float32(NOTHING), jnp.int32) | bits
    best = jnp.full(jnp.broadcast_shapes(rays.dx.shape, rays.dz.shape), nothing, jnp.int32)
    for k in range(count):
        first, last = jnp.maximum(enter[k], low[k]), jnp.minimum(leave[k], high[k])
        key = lax.bitcast_convert_type(first, jnp.int32) & ~bits | k
        best = jnp.where((first <= last) & (first > 0), jnp.minimum(best, key), best)
    best = computed_once(best)
    body = best & bits
    length = lax.bitcast_convert_type(best & ~bits | (bits + 1) // 2, jnp.float32)
    return Hits(jnp.where(body == bits, NOTHING, length), jnp.where(body == bits, -1, body))


def _sides(rays: Rays, bodies: Bodies) -> tuple[Array, Array]:
    """Lengths to the upright sides, in and out, `[K, C, H1, W]`."""
    cos, sin = (f(bodies.heading)[:, None] for f in (jnp.cos, jnp.sin))
    x, y = rays.x[None] - bodies.x[:, None], rays.y[None] - bodies.y[:, None]  # [K C]
    place = cos * x + sin * y, cos * y - sin * x
    cos, sin = cos[..., None, None], sin[..., None, None]
    way = cos * rays.dx[None] + sin * rays.dy[None], cos * rays.dy[None] - sin * rays.dx[None]
    spans = [
        _slab(p[..., None, None], 1 / _sure(w), size[:, None, None, None] / 2)
        for p, w, size in zip(place, way, (bodies.length, bodies.width), strict=True)
    ]
    return jnp.maximum(spans[0][0], spans[1][0]), jnp.minimum(spans[0][1], spans[1][1])


def _lids(rays: Rays, bodies: Bodies) -> tuple[Array, Array]:
    """Lengths to top and bottom, in and out, `[K, C, H, W1]`."""
    half = (bodies.height / 2)[:, None, None, None]
    place = rays.z[None] - (bodies.z + bodies.height / 2)[:, None]
    return _slab(place[..., None, None], (1 / _sure(rays.dz))[None], half)


def _slab(place: Array, inverse: Array, half: Array) -> tuple[Array, Array]:
    middle, reach = -place * inverse, half * jnp.abs(inverse)
    return middle - reach, middle + reach


def _sure(way: Array) -> Array:
    return jnp.where(jnp.abs(way) < _TINY, _TINY, way)
