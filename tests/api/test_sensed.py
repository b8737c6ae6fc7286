"""What a vehicle of a recorded world senses."""

import dataclasses
import math
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from fake_traces import HIT, LATE, N, T, small_trace

from limsim_jax.api.map import load_map
from limsim_jax.api.world import World
from limsim_jax.maps.scenery import Label
from limsim_jax.policies.base import LikeTraffic, Wrapper, sensors_of
from limsim_jax.sensors.faults import Faults
from limsim_jax.sensors.objects import Detector
from limsim_jax.sensors.rig import LAYERS_16, Camera, Rig, rig_named

RIG = Rig(cameras=(Camera(name="ahead"), Camera(name="behind", x=-1.5, yaw=math.pi)), lidar=LAYERS_16)


@pytest.fixture(scope="module")
def world():
    network, _, trace = small_trace("intersection")
    # slot 1 behind slot 0, on one line and standing
    box = np.array(trace.box)
    box[:, :, 0], box[:, :, 1], box[:, :, 2] = -12.0 * np.arange(N), 0.4, 0.0
    trace = trace._replace(box=box, vehicle_class=np.zeros((T, N), np.int32))
    return World("scene", "policy", 0, 0, load_map(network), trace, {}, [])


@pytest.mark.engine
def test_a_vehicle_behind_is_seen_behind(world, tmp_path):
    sensed = world.sense(0.6, RIG, detector=Detector(misses=0.0, false_tracks=0.0))
    assert sensed.time == pytest.approx(0.6)
    assert not (sensed.pictures.slot[0] == HIT).any() and (sensed.pictures.slot[1] == HIT).any()
    assert (sensed.pictures.label[1] == Label.CAR).any()
    objects = sensed.objects
    assert HIT in objects.id[objects.there] and 2 not in objects.id[objects.there]
    assert objects.x[objects.id == HIT][0] == pytest.approx(-12, abs=1)
    assert (sensed.scan.slot == HIT).sum() >= 3
    path = tmp_path / "sheet.png"
    sensed.draw(path, dpi=40)
    assert path.read_bytes()[:4] == b"\x89PNG" and sensed._repr_png_()[:4] == b"\x89PNG"


@pytest.mark.engine
def test_a_rig_may_have_no_camera(world):
    sensed = world.sense(0.6, Rig(lidar=LAYERS_16), slot=HIT)
    assert sensed.pictures is None and sensed.scan is not None
    assert sensed._repr_png_()[:4] == b"\x89PNG"


@pytest.mark.engine
def test_a_film_has_what_is_sensed_at_its_moments(world, tmp_path):
    film = world.film(RIG, every=0.3)
    np.testing.assert_allclose(film.time, [0.1, 0.3, 0.6, 0.9, 1.2], atol=1e-5)
    assert (
        len(film) == 5
        and film.pictures.color.shape == (5, 2, 36, 64, 3)
        and film.spacing == pytest.approx(0.3)
    )
    assert film.bev.shape[:2] == (5, 6) and film.objects.x.shape[0] == film.truth.x.shape[0] == 5
    now = world.sense(0.6, RIG)
    for one in (film[2], list(film)[2]):
        assert one.title == now.title and one.size == now.size
        for name in ("pictures", "scan", "bev", "objects", "truth"):
            jax.tree.map(np.testing.assert_array_equal, getattr(one, name), getattr(now, name))
    with pytest.raises(IndexError):
        film[5]
    part = world.film(RIG, every=0.3, begin=0.3, end=0.6)
    np.testing.assert_array_equal(part.pictures.depth, film.pictures.depth[1:3])
    stored = np.load(film.save(tmp_path / "film.npz"))
    np.testing.assert_array_equal(stored["scan_range"], film.scan.range)
    np.testing.assert_array_equal(stored["truth_slot"], film.truth.slot)


@pytest.mark.engine
def test_a_film_ends_with_the_vehicle_and_not_with_its_slot(world):
    """From step 6 on the slot has another vehicle; another slot is empty for a while."""
    film = world.film(RIG, every=0.3, slot=LATE)
    np.testing.assert_allclose(film.time, [0.1, 0.3, 0.6], atol=1e-5)
    active = world.trace.active.copy()
    active[:4, HIT] = False
    late = dataclasses.replace(world, trace=world.trace._replace(active=active))
    np.testing.assert_allclose(late.film(RIG, every=0.3, slot=HIT).time, [0.6, 0.9, 1.2], atol=1e-5)


@pytest.mark.engine
def test_a_late_object_list_is_that_of_before_in_the_frame_of_now(world):
    """The ego turns and drives on; what stands is where it is, what drives is where it was."""
    box = world.trace.box.copy()
    box[:, 0, 0] = 0.5 * np.arange(T)
    box[:, 0, 2] = 0.05 * np.arange(T)
    moving = dataclasses.replace(world, trace=world.trace._replace(box=box))
    late = Detector(latency=0.3).without_errors()
    assert late.latency == 0
    late = dataclasses.replace(late, latency=0.3)
    film = moving.film(RIG, every=0.3, detector=late)
    exact = moving.film(RIG, every=0.3, detector=late.without_errors())
    k = 2  # at 0.6 s, step 5; the list is of step 2
    for name in ("x", "y"):
        slot = film.objects.id[k].tolist().index(HIT)
        same = exact.objects.id[k].tolist().index(HIT)
        assert getattr(film.objects, name)[k, slot] == pytest.approx(
            getattr(exact.objects, name)[k, same], abs=1e-4
        )
    assert film.objects.pose.x[k] == pytest.approx(2.5)
    # a vehicle that drives is seen where it was
    box[:, HIT, 0] += 1.0 * np.arange(T)
    moving = dataclasses.replace(world, trace=world.trace._replace(box=box))
    film, exact = (moving.film(RIG, every=0.3, detector=d) for d in (late, late.without_errors()))
    was, now = (
        np.array([getattr(f.objects, n)[k][f.objects.id[k] == HIT][0] for n in ("x", "y")])
        for f in (film, exact)
    )
    heading = 0.05 * 5
    back = -3.0 * np.array([np.cos(heading), -np.sin(heading)])
    np.testing.assert_allclose(was - now, back, atol=1e-4)
    first = film.objects.id[0].tolist().index(HIT)  # there is no earlier look than the first one
    assert film.objects.x[0, first] == pytest.approx(exact.objects.x[0, first], abs=1e-4)
    with pytest.raises(ValueError, match=r"detector: latency: 0.25 s; expected a multiple of 0.1 s"):
        world.film(RIG, detector=Detector(latency=0.25))


@pytest.mark.engine
def test_faults_spoil_a_film(world):
    box = world.trace.box.copy()
    box[:, 0, 0] = 0.7 * np.arange(T)
    moving = dataclasses.replace(world, trace=world.trace._replace(box=box))
    plain = moving.film(RIG, every=0.3)
    bad = moving.film(
        RIG, every=0.3, faults=Faults(dropped=("ahead",), frozen=("behind",), position_drift=0.5)
    )
    assert (bad.pictures.color[:, 0] == 0).all()
    assert not (plain.pictures.depth[3, 1] == plain.pictures.depth[0, 1]).all()
    for k in range(5):
        np.testing.assert_array_equal(bad.pictures.color[k, 1], plain.pictures.color[0, 1])
    np.testing.assert_array_equal(bad.pose.x, plain.pose.x)
    off = np.hypot(bad.objects.pose.x - plain.pose.x, bad.objects.pose.y - plain.pose.y)
    assert off[0] == 0 and off[-1] > 0.05
    blind = moving.film(Rig(lidar=LAYERS_16), every=0.6, faults=Faults(position_drift=0.5))
    assert blind.pictures is None and blind.objects.pose.x[-1] != blind.pose.x[-1]
    with pytest.raises(ValueError, match="no camera 'roof'"):
        moving.film(RIG, faults=Faults(dropped=("roof",)))


def test_the_rig_of_a_policy_is_found_wherever_it_is():
    class Sees(LikeTraffic):
        sensors = RIG

    with_object = SimpleNamespace(sensors=SimpleNamespace(rig=RIG), rig=None)
    for policy in (Sees(), Wrapper(Wrapper(Sees())), SimpleNamespace(rig=RIG), with_object):
        assert sensors_of(policy) is RIG
    for policy in (LikeTraffic(), Wrapper(LikeTraffic()), None, SimpleNamespace(sensors=3)):
        assert sensors_of(policy) is None


def test_rigs_to_watch_by_have_names():
    for name, cameras in (("six", 6), ("front", 3), ("one", 1)):
        rig = rig_named(name)
        assert len(rig.cameras) == cameras and rig.lidar is LAYERS_16
        assert rig.cameras[0].width * 9 == rig.cameras[0].height * 16


@pytest.mark.parametrize(
    ("rig", "options", "words"),
    [
        ("seven", {}, "sensors: rig 'seven'; known are six, front, one, own"),
        ("own", {}, "sensors: own: policy 'none' declares no sensors; use six, front or one"),
        (RIG, {"every": 0}, "every: 0 s; expected more than 0"),
        (RIG, {"slot": N - 1}, f"no vehicle in slot {N - 1} in any frame"),
        (RIG, {"begin": 50.0}, "no vehicle in slot 0 in any frame from 50 to"),
    ],
)
def test_films_that_cannot_be_made_say_why(world, rig, options, words):
    with pytest.raises(ValueError, match=words):
        world.film(rig, **options)


@pytest.mark.parametrize(
    ("at", "options", "words"),
    [
        (99.0, {}, r"at: 99 s; the world was recorded from 0.1 to 1.2 s"),
        (0.6, {"slot": N - 1}, f"no vehicle in slot {N - 1} at 0.6 s"),
        (0.6, {"slot": 77}, "no vehicle in slot 77"),
    ],
)
def test_moments_that_are_not_there_are_named(world, at, options, words):
    with pytest.raises(ValueError, match=words):
        world.sense(at, RIG, **options)


def test_a_world_without_an_ego_asks_for_a_vehicle(world):
    plain = World("scene", "", 0, -1, world.map, world.trace, {}, [])
    with pytest.raises(ValueError, match="the world has no ego; name the slot"):
        plain.sense(0.6)
