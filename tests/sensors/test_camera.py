"""Pictures against closed forms and against another ray tracer."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ray_tracer import Box, pixel_ways, trace
from sensed_worlds import bodies_of, look, pose_at, random_boxes, scenery, six_bodies_of

from limsim_jax.maps.scenery import TILE, Label
from limsim_jax.sensors.camera import COLORS, FAR, take_pictures
from limsim_jax.sensors.rig import Camera, Rig, six_cameras
from limsim_jax.sensors.scene import Lamp

FRONT = Rig(cameras=(Camera(width=33, height=19),))
NOWHERE = pose_at(5000.0, 5000.0)  # open country


def picture(rig, bodies, pose=NOWHERE):
    return look(rig, bodies, pose)


def test_depth_of_a_face_across_the_view():
    """A face 20 m ahead of the vehicle is 18.5 m before the camera, wherever on it a pixel looks."""
    found = picture(FRONT, six_bodies_of([Box(22, 0, 0, 0, 4, 60, 30)]))
    assert (np.asarray(found.slot[0]) == 0)[:10].all()
    np.testing.assert_allclose(found.depth[0][:10], 18.5, atol=1e-3)


def test_depth_of_the_ground():
    """A row `v` pixels below the horizon sees the ground at `z f / v`."""
    found = picture(FRONT, six_bodies_of([Box(22, 900, 0, 0, 4, 2, 2)]))
    camera = FRONT.cameras[0]
    below = np.arange(10, 19) + 0.5 - camera.height / 2
    expected = camera.z * camera.focal / below
    np.testing.assert_allclose(found.depth[0][10:], np.tile(expected[:, None], (1, 33)), atol=1e-3)
    assert (np.asarray(found.label[0][:9]) == Label.SKY).all()
    np.testing.assert_array_equal(found.depth[0][:9], FAR)
    assert (np.asarray(found.label[0][10:]) == Label.TERRAIN).all()


def test_depth_of_a_slanted_face():
    """A wall turned by an angle `t` through (20, 0): `depth = 18.5 cos t / (cos t + u sin t)`.

    `u` is the slope of a ray to the left.
    """
    turn = math.radians(30)
    # the near face of a box with this heading contains (20, 0)
    x, y = 20.0 + 2.0 * math.cos(turn), 2.0 * math.sin(turn)
    found = picture(FRONT, six_bodies_of([Box(x, y, 0, turn, 4, 200, 30)]))
    camera = FRONT.cameras[0]
    u = (camera.width / 2 - np.arange(33) - 0.5) / camera.focal
    expected = 18.5 * math.cos(turn) / (math.cos(turn) + u * math.sin(turn))
    np.testing.assert_allclose(found.depth[0][5], expected, atol=1e-3)


def oracle(camera, pose, boxes, labels, lamps):
    """Label and depth by the other ray tracer, and by reading the raster in float64."""
    place = scenery()
    origin, way = np.array([camera.x, camera.y, camera.z]), pixel_ways(camera)
    found = trace(origin, way, boxes)
    with np.errstate(divide="ignore"):
        floor = np.where(way[..., 2] < 0, -camera.z / way[..., 2], np.inf)
    near = np.minimum(floor, FAR)[..., None] * way + origin
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    x = pose[0] + cos * near[..., 0] - sin * near[..., 1]
    y = pose[1] + sin * near[..., 0] + cos * near[..., 1]
    tiles, paint, corner = np.asarray(place.tile), np.asarray(place.paint), np.asarray(place.corner, float)
    i, j = (np.floor((v - c) / place.pixel).astype(int) for v, c in ((x, corner[0]), (y, corner[1])))
    inside = (i >= 0) & (j >= 0) & (i < tiles.shape[1] * TILE) & (j < tiles.shape[0] * TILE)
    i, j = np.where(inside, i, 0), np.where(inside, j, 0)
    ground = np.where(inside, paint[tiles[j // TILE, i // TILE], j % TILE, i % TILE], Label.TERRAIN)
    depth = np.minimum(found.length, floor)
    label = np.where(found.length < floor, np.asarray(labels)[found.box], ground)
    # lamps: squares at the corners of the front (turn signals) and of the back, left is positive
    heights = np.array([b.height for b in boxes])[found.box]
    level = (found.across[..., 1] + 1) / 2 * heights / np.minimum(heights, 2.0)
    corner_ = (found.length < floor) & (abs(found.across[..., 0]) > 0.7) & (level > 0.3) & (level < 0.62)
    shining = np.asarray(lamps)[found.box]
    back = corner_ & (found.face == 1)
    label = np.where(back & (shining & Lamp.BRAKE > 0), Label.BRAKE_LIGHT, label)
    side = np.where(found.across[..., 0] > 0, Lamp.LEFT, Lamp.RIGHT)
    signal = corner_ & (found.face <= 1) & (found.face >= 0) & (shining & side > 0)
    label = np.where(signal, Label.TURN_SIGNAL, label)
    return np.where(depth < FAR, label, Label.SKY), np.minimum(depth, FAR)


TILTED = Camera(x=-1, y=0.5, z=1.6, yaw=2.2, pitch=-0.2, roll=0.3, fov=1.8, width=20, height=12)


@pytest.mark.parametrize(
    "rig", [six_cameras(20, 12).only("back_left"), Rig(cameras=(TILTED,))], ids=["level", "tilted"]
)
def test_another_ray_tracer_sees_the_same(rig):
    """1,000 scenes with 6 boxes: the pixels that differ lie on edges."""
    rng = np.random.default_rng(7)
    scenes = 500
    boxes = [random_boxes(rng, 6) for _ in range(scenes)]
    poses = rng.uniform((-60, -60, -3), (60, 60, 3), (scenes, 3)).astype(np.float32)
    labels = rng.integers(int(Label.CAR), int(Label.PEDESTRIAN), (scenes, 6)).astype(np.int32)
    lamps = rng.integers(0, 8, (scenes, 6)).astype(np.int32)
    every = [
        bodies_of(b, label=jnp.asarray(k), lamps=jnp.asarray(m))
        for b, k, m in zip(boxes, labels, lamps, strict=True)
    ]
    stacked = jax.tree.map(lambda *x: np.stack(x), *every)
    pose = pose_at()
    pose = type(pose)(**{name: jnp.asarray(poses[:, k]) for k, name in enumerate(("x", "y", "heading"))})
    batch = jax.jit(jax.vmap(lambda s, p, b: take_pictures(rig, s, p, b), (None, 0, 0)))
    found = jax.tree.map(np.asarray, batch(scenery(), pose, stacked))
    same = near = total = 0
    for n in range(scenes):
        for c, camera in enumerate(rig.cameras):
            label, depth = oracle(camera, poses[n].astype(float), boxes[n], labels[n], lamps[n])
            agrees = found.label[n, c] == label
            close = abs(found.depth[n, c] - depth) < 1e-3 + 2e-6 * depth
            same, near, total = same + agrees.sum(), near + close.sum(), total + label.size
    assert same / total > 0.999, f"{1 - same / total:.5f} of {total} pixels have another label"
    assert near / total > 0.9995, f"{1 - near / total:.5f} of {total} pixels have another depth"


def test_the_order_of_bodies_does_not_matter():
    rng = np.random.default_rng(3)
    boxes, order = random_boxes(rng, 6), rng.permutation(6)
    one = picture(six_cameras(16, 9), bodies_of(boxes))
    turned = bodies_of([boxes[k] for k in order], slot=jnp.asarray(order, jnp.int32))
    other = picture(six_cameras(16, 9), turned)
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_an_empty_scene_is_finite():
    nobody = six_bodies_of([])
    found = picture(six_cameras(16, 9), nobody)
    assert np.isfinite(found.depth).all()
    assert (np.asarray(found.slot) == -1).all()


def test_a_batch_is_its_worlds():
    rng = np.random.default_rng(1)
    rig = six_cameras(16, 9)
    worlds = [bodies_of(random_boxes(rng, 6)) for _ in range(3)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *worlds)
    batch = jax.jit(jax.vmap(lambda s, b: take_pictures(rig, s, pose_at(), b), (None, 0)))
    found = batch(scenery(), stacked)
    for n, world in enumerate(worlds):
        alone = picture(rig, world, pose_at())
        jax.tree.map(lambda a, b, n=n: np.testing.assert_array_equal(a[n], b), found, alone)


def test_lights_shine_towards_their_traffic():
    """The side from which its traffic comes has the colour of a light; its other sides are dark."""
    light = Box(20, 0, 1.4, 0, 0.2, 6, 1.32)
    kind = {"label": jnp.asarray([int(Label.LIGHT_GREEN)]), "slot": jnp.asarray([-1])}
    towards = picture(FRONT, six_bodies_of([light], **kind))
    away = picture(FRONT, six_bodies_of([light._replace(heading=math.pi)], **kind))
    row, column = 9, 16
    assert towards.label[0, row, column] == Label.LIGHT_GREEN
    assert tuple(np.asarray(towards.color[0, row, column])) == COLORS[Label.LIGHT_GREEN]
    assert away.label[0, row, column] == Label.LIGHT_OFF
    assert towards.slot[0, row, column] == -1


def test_lamps_are_seen_from_behind():
    car = six_bodies_of([Box(12, 0, 0, 0, 4.6, 1.8, 1.5)], lamps=jnp.asarray([int(Lamp.BRAKE | Lamp.LEFT)]))
    rig = Rig(cameras=(Camera(width=128, height=72),))
    label = np.asarray(picture(rig, car).label[0])
    rows, columns = np.nonzero(label == Label.TURN_SIGNAL)
    assert len(columns) and (columns < 64).all()
    rows, columns = np.nonzero(label == Label.BRAKE_LIGHT)
    assert len(columns) and (columns >= 64).all() and (rows > 36).all()


def test_too_many_bodies_are_refused():
    with pytest.raises(ValueError, match="129 bodies; expected at most 128"):
        picture(FRONT, bodies_of([Box(9, 0, 0, 0, 1, 1, 1)] * 129))
