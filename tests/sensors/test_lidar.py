"""Scans against shapely and against another ray tracer."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import shapely
import shapely.affinity
from ray_tracer import Box, trace
from sensed_worlds import bodies_of, random_boxes, six_bodies_of

from limsim_jax.sensors.lidar import hits_per_body, points_of, scan_around
from limsim_jax.sensors.rig import LAYERS_1, LAYERS_16, Lidar

EXACT = Lidar(x=0.4, y=-0.2, z=1.8, columns=90, elevations=LAYERS_16.elevations[::3], noise=0.0)
LEVEL = Lidar(x=0.4, y=-0.2, z=0.5, columns=72, elevations=(0.0,), noise=0.0)
_scan = jax.jit(scan_around, static_argnums=0)


def polygon(box: Box) -> shapely.Polygon:
    flat = shapely.box(-box.length / 2, -box.width / 2, box.length / 2, box.width / 2)
    return shapely.affinity.translate(
        shapely.affinity.rotate(flat, box.heading, origin=(0, 0), use_radians=True), box.x, box.y
    )


def test_a_level_layer_measures_the_distance_to_polygons():
    rng = np.random.default_rng(2)
    for _ in range(20):
        boxes = [box._replace(z=0.0) for box in random_boxes(rng, 6)]
        found = _scan(LEVEL, bodies_of(boxes))
        shapes = [polygon(box) for box in boxes]
        origin = np.array([LEVEL.x, LEVEL.y])
        for k in range(LEVEL.columns):
            angle = 2 * math.pi * k / LEVEL.columns
            ray = shapely.LineString(
                [origin, origin + LEVEL.range * np.array([math.cos(angle), math.sin(angle)])]
            )
            away = [shapely.distance(ray.intersection(s), shapely.Point(origin)) for s in shapes]
            away = np.where(np.isnan(away), np.inf, away)
            if any(0 < s.intersection(ray).length < 0.05 for s in shapes):
                continue  # a corner is grazed
            assert float(found.range[0, k]) == np.float32(min(away.min(), LEVEL.range)) or (
                abs(float(found.range[0, k]) - away.min()) < 1e-3
            )
            assert int(found.slot[0, k]) == (int(np.argmin(away)) if away.min() < LEVEL.range else -1)


def test_layers_agree_with_another_ray_tracer():
    rng = np.random.default_rng(5)
    around = 2 * np.pi * np.arange(EXACT.columns) / EXACT.columns
    rise = np.asarray(EXACT.elevations)[:, None]
    way = np.stack(
        np.broadcast_arrays(np.cos(rise) * np.cos(around), np.cos(rise) * np.sin(around), np.sin(rise)), -1
    )
    same = total = 0
    for _ in range(30):
        boxes = random_boxes(rng, 6)
        found = _scan(EXACT, bodies_of(boxes))
        truth = trace(np.array([EXACT.x, EXACT.y, EXACT.z]), way, boxes)
        floor = np.where(rise < 0, -EXACT.z / np.where(rise < 0, np.sin(rise), -1), np.inf)
        away = np.minimum(np.minimum(truth.length, floor), EXACT.range)
        slot = np.where((truth.length < floor) & (truth.length < EXACT.range), truth.box, -1)
        agrees = (abs(np.asarray(found.range) - away) < 1e-3 + 2e-6 * away) & (np.asarray(found.slot) == slot)
        same, total = same + agrees.sum(), total + away.size
    assert same / total > 0.999


def test_points_lie_on_what_was_met():
    box = Box(15, 3, 0, 0.3, 5, 2, 3)
    scan = _scan(EXACT, six_bodies_of([box]))
    points, back = (np.asarray(x) for x in points_of(EXACT, scan))
    met = np.asarray(scan.slot) == 0
    assert met.sum() > 5 and back[met].all()
    edge = polygon(box).exterior
    assert max(edge.distance(shapely.Point(*p[:2])) for p in points[met]) < 2e-3
    np.testing.assert_allclose(points[back & ~met][:, 2], 0, atol=2e-3)
    assert int(hits_per_body(scan, six_bodies_of([box]))[0]) == met.sum()


def test_nothing_is_met_in_open_country_by_a_level_layer():
    scan = _scan(LAYERS_1, six_bodies_of([]))
    np.testing.assert_array_equal(scan.range, LAYERS_1.range)
    np.testing.assert_array_equal(scan.slot, -1)


def test_noise_and_dropout_are_as_stated():
    noisy = Lidar(elevations=(-0.1, -0.2), noise=0.05, dropout=0.2)
    nobody, key = six_bodies_of([]), jax.random.key(4)
    scans = jax.jit(jax.vmap(lambda step: scan_around(noisy, nobody, key, step)))(jnp.arange(50))
    ranges = np.asarray(scans.range)
    back = ranges < noisy.range
    assert abs(back.mean() - 0.8) < 0.01
    for layer, rise in enumerate(noisy.elevations):
        error = ranges[:, layer][back[:, layer]] - noisy.z / math.sin(-rise)
        assert abs(error.mean()) < 0.002 and abs(error.std() - 0.05) < 0.002
    again = _scan(noisy, nobody, key, 7)
    np.testing.assert_array_equal(again.range, ranges[7])
    assert (ranges[7] != ranges[8]).any()
