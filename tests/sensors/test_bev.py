"""The bird's-eye view against polygons of shapely."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
import shapely.affinity
from sensed_worlds import bodies_of, pose_at, random_boxes, scenery

from limsim_jax.maps.scenery import DRIVABLE, ground
from limsim_jax.sensors.bev import CHANNELS, Raster, birds_eye

RASTER = Raster(ahead=20, behind=10, side=12, cell=0.5)


def test_cells_are_where_things_are():
    rng = np.random.default_rng(0)
    boxes = [box._replace(z=0.0) for box in random_boxes(rng, 6, 18)]
    vx, vy = rng.normal(size=(2, 6)).astype(np.float32)
    route = np.array([[0, 0], [6, 1], [12, 5], [14, 11]], np.float32)
    pose = pose_at(-12.0, 3.0, 0.7)
    view = jax.jit(birds_eye, static_argnums=0)(
        RASTER, scenery(), pose, bodies_of(boxes, vx=jnp.asarray(vx), vy=jnp.asarray(vy)), jnp.asarray(route)
    )
    layer = dict(zip(CHANNELS, np.asarray(view), strict=True))
    rows, columns = RASTER.shape
    x = RASTER.ahead - (np.arange(rows)[:, None] + 0.5) * 0.5 + np.zeros((1, columns))
    y = RASTER.side - (np.arange(columns)[None] + 0.5) * 0.5 + np.zeros((rows, 1))

    shapes = []
    for box in boxes:
        flat = shapely.box(-box.length / 2, -box.width / 2, box.length / 2, box.width / 2)
        turned = shapely.affinity.rotate(flat, box.heading, origin=(0, 0), use_radians=True)
        shapes.append(shapely.affinity.translate(turned, box.x, box.y))
    covers = np.array([np.asarray(shapely.contains_xy(shape, x, y)) for shape in shapes])
    near = [shapely.distance(s.exterior, shapely.points(x, y)) for s in shapes]
    edge = np.asarray(np.stack(near).min(0) < 1e-3)
    assert covers.any() and not edge.all()
    np.testing.assert_array_equal(layer["occupied"][~edge] > 0, np.asarray(covers.any(0))[~edge])
    alone = covers.sum(0) == 1
    owner = covers.argmax(0)
    np.testing.assert_allclose(layer["vx"][alone], vx[owner[alone]])
    np.testing.assert_allclose(layer["vy"][alone], vy[owner[alone]])

    away = np.asarray(shapely.distance(shapely.LineString(route), shapely.points(x, y)))
    sure = abs(away - RASTER.route_width / 2) > 1e-3
    np.testing.assert_array_equal(layer["route"][sure] > 0, (away < RASTER.route_width / 2)[sure])

    cos, sin = math.cos(0.7), math.sin(0.7)
    place = (-12 + cos * x - sin * y, 3 + sin * x + cos * y)
    there = ground(scenery(), *(jnp.asarray(v, jnp.float32) for v in place))
    drivable = np.isin(np.asarray(there), [int(label) for label in DRIVABLE])
    assert (drivable != (layer["drivable"] > 0)).mean() < 1e-3 and drivable.any() and not drivable.all()


def test_a_raster_without_cells_is_refused():
    with pytest.raises(ValueError, match="at least one cell"):
        Raster(ahead=0.0, behind=0.0)
