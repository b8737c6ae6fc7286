"""Object lists: what is hidden is not in them, and errors are as stated."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ray_tracer import Box
from sensed_worlds import pose_at, six_bodies_of

from limsim_jax.maps.scenery import Label
from limsim_jax.sensors.objects import Detector, detect, seen_from

BUS, HIDDEN, BESIDE = (
    Box(14, 0, 0, 0, 12, 2.5, 3.4),
    Box(30, 0, 0, 0, 4.6, 1.8, 1.5),
    Box(12, 5, 0, 1, 4, 1.8, 1.5),
)
STEPS = jnp.arange(2000)
KEY = jax.random.key(11)
_once = jax.jit(detect, static_argnums=0)
_many = jax.jit(
    lambda detector, bodies, steps: jax.vmap(lambda k: detect(detector, pose_at(), bodies, KEY, k))(steps),
    static_argnums=0,
)


def looks(detector, boxes, **changes):
    return jax.tree.map(np.asarray, _many(detector, six_bodies_of(boxes, **changes), STEPS))


def ids(found):
    return set(found.id[found.there].tolist())


def test_a_hidden_vehicle_is_never_in_the_list():
    sharp = replace(Detector(), misses=0.0, hits=1)
    assert 1 not in ids(looks(sharp, [BUS, HIDDEN, BESIDE]))
    open_ = looks(sharp, [BESIDE, HIDDEN])
    assert open_.there[:, 1].all() and {0, 1} <= ids(open_)


def test_a_light_hides_but_is_no_object():
    wall = six_bodies_of([BESIDE, BESIDE], slot=jnp.asarray([-1, 1]), label=jnp.asarray([22, 13]))
    found = _once(Detector(), pose_at(), wall, KEY, 3)
    assert not found.there[0]


def test_errors_are_as_stated():
    detector = Detector(
        position_noise=0.2,
        position_growth=0.01,
        heading_noise=0.1,
        size_noise=0.05,
        speed_noise=0.3,
        misses=0.25,
    )
    found = looks(detector, [BUS, BESIDE], vx=jnp.asarray([3.0, 4.0]), vy=jnp.asarray([0.0, 1.0]))
    for k, box in enumerate((BUS, BESIDE)):
        spread = 0.2 + 0.01 * math.hypot(box.x, box.y)
        for name, true, sigma in (
            ("x", box.x, spread), ("y", box.y, spread), ("heading", box.heading, 0.1),
            ("length", box.length, 0.05), ("width", box.width, 0.05), ("vx", 3.0 + k, 0.3),
            ("vy", float(k), 0.3),
        ):  # fmt: skip
            error = getattr(found, name)[:, k] - true
            assert abs(error.mean()) < 4 * sigma / math.sqrt(len(STEPS)), name
            assert error.std() == pytest.approx(sigma, rel=0.06), name
        assert found.there[:, k].mean() == pytest.approx(0.75, abs=0.03)


def test_errors_belong_to_the_vehicle_not_to_its_place_in_the_list():
    one = looks(Detector(), [BUS, BESIDE])
    other = looks(Detector(), [BESIDE, BUS], slot=jnp.asarray([1, 0]))
    np.testing.assert_array_equal(one.x[:, 0], other.x[:, 1])
    np.testing.assert_array_equal(one.there[:, 1], other.there[:, 0])


def test_false_tracks_come_at_their_rate_and_last():
    detector = Detector(false_tracks=0.5, false_steps=4, slots=2, false_range=30.0)
    found = looks(detector, [])
    false = found.there & (found.id < 0)
    assert false.sum(-1).mean() == pytest.approx(0.5, abs=0.06)
    np.testing.assert_array_equal(false[:4], np.tile(false[:1], (4, 1)))
    assert (np.hypot(found.x, found.y)[false] <= 30).all()
    lasting = found.id[false]
    assert len(np.unique(lasting)) * 4 == len(lasting)
    assert (found.label[false] == Label.CAR).all()
    assert not looks(replace(detector, false_tracks=0.0), []).there.any()


def test_an_exact_detector_lists_the_truth():
    found = looks(Detector().without_errors(), [BUS, BESIDE])
    assert found.there.shape == (len(STEPS), 6) and found.there[:, :2].all() and not found.there[:, 2:].any()
    for name in ("x", "y", "heading", "length", "width"):
        np.testing.assert_allclose(
            getattr(found, name)[0, :2], [getattr(BUS, name), getattr(BESIDE, name)], rtol=1e-6
        )


def test_an_old_list_moves_with_the_ego():
    """A point in the map has one place in both frames."""
    found = _once(Detector(), pose_at(10, 5, 0.4), six_bodies_of([BUS, BESIDE]), KEY, 0)
    later = pose_at(13, 4, 0.7)
    moved = seen_from(found, later)

    def in_map(objects, pose):
        turn = complex(math.cos(float(pose.heading)), math.sin(float(pose.heading)))
        place = (np.asarray(objects.x) + 1j * np.asarray(objects.y)) * turn + complex(pose.x, pose.y)
        velocity = (np.asarray(objects.vx) + 1j * np.asarray(objects.vy)) * turn
        return place, velocity, np.asarray(objects.heading) + float(pose.heading)

    for a, b in zip(in_map(found, pose_at(10, 5, 0.4)), in_map(moved, later), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-5)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"misses": 1.5}, "misses: 1.5; expected a probability"),
        ({"position_noise": -1.0}, "position_noise: -1.0"),
        ({"hits": 0}, "hits 0"),
        ({"false_tracks": 3.0}, "expected at most 2, the slots"),
    ],
)
def test_faulty_detectors_are_named(values, words):
    with pytest.raises(ValueError, match=words):
        Detector(**values)
