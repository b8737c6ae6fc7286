"""Cameras and LiDARs as values."""

import math

import numpy as np
import pytest
from ray_tracer import Box
from sensed_worlds import look, six_bodies_of

from limsim_jax.sensors.rig import Camera, Lidar, Rig, front_cameras, six_cameras


@pytest.mark.parametrize(
    ("name", "point", "column", "row"),
    [
        # 18.5 m ahead of the camera, 2 m left of it, on the ground: f = 800 / tan 35
        ("front", (20.0, 2.0, 0.0), 800 - 2 * 1142.5184 / 18.5, 450 + 2 * 1142.5184 / 18.5),
        # 10 m along the axis of the front left camera, and 1 m to its left, at its height
        (
            "front_left",
            (1.5 + 10 * 0.573576 - 0.819152, 0.7 + 10 * 0.819152 + 0.573576, 2.0),  # of 55 degrees
            800 - 114.25184,
            450.0,
        ),
        # behind: f = 800 / tan 55; what is right of the vehicle is left of the picture
        ("back", (-11.5, -3.0, 2.5), 800 - 3 * 560.16603 / 10, 450 - 0.5 * 560.16603 / 10),
    ],
)
def test_points_are_where_the_pinhole_formula_says(name, point, column, row):
    camera = next(c for c in six_cameras(1600, 900).cameras if c.name == name)
    u, v, depth = camera.project(np.array(point))
    assert (u, v) == (pytest.approx(column, abs=2e-2), pytest.approx(row, abs=2e-2))
    assert depth > 0


def test_pixels_are_where_points_are_projected():
    """A small box in each camera of the rig: the middle of its pixels is its projection."""
    rig = six_cameras(96, 54)
    for camera in rig.cameras:
        x, y = camera.x + 8 * math.cos(camera.yaw + 0.2), camera.y + 8 * math.sin(camera.yaw + 0.2)
        bodies = six_bodies_of([Box(x, y, 1.6, camera.yaw, 1e-3, 1.0, 1.0)])
        slot = np.asarray(look(rig, bodies).slot[rig.names.index(camera.name)])
        rows, columns = np.nonzero(slot == 0)
        u, v, _ = camera.project(np.array([x, y, 2.1]))
        assert columns.mean() + 0.5 == pytest.approx(u, abs=0.6)
        assert rows.mean() + 0.5 == pytest.approx(v, abs=0.6)


def test_axes_are_right_handed():
    camera = Camera(yaw=0.5, pitch=-0.2, roll=0.3)
    np.testing.assert_allclose(camera.axes @ camera.axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(camera.axes) == pytest.approx(1)


def test_rigs_of_limsim():
    rig = six_cameras()
    assert rig.names == ("front_left", "front", "front_right", "back_left", "back", "back_right")
    assert front_cameras().names == ("front_left", "front", "front_right")
    left, right = (next(c for c in rig.cameras if c.name == name) for name in ("front_left", "front_right"))
    assert (left.y, left.yaw) == (-right.y, -right.yaw) and left.y > 0 < left.yaw
    assert rig.sized(8, 4).cameras[3].height == 4


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Camera(fov=4.0), "camera 'front': fov: 4.0 rad; expected within 0 and pi"),
        (lambda: Camera(width=0), "0 x 36 pixels"),
        (lambda: Camera(z=-1.0), "above the ground"),
        (lambda: Camera(yaw=math.nan), "yaw: nan"),
        (lambda: Lidar(elevations=()), "elevations"),
        (lambda: Lidar(range=0.0), "range 0.0 m"),
        (lambda: Rig(), "no sensor"),
        (lambda: Rig(cameras=(Camera(), Camera())), "two cameras are named 'front'"),
        (lambda: Rig(cameras=(Camera(), Camera(name="b", width=9))), "camera 'b' has 9 x 36 pixels"),
        (lambda: six_cameras().only("roof"), "no camera 'roof'; its cameras are front_left"),
    ],
)
def test_faulty_sensors_are_named(make, words):
    with pytest.raises(ValueError, match=words):
        make()
