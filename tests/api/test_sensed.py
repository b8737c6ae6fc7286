"""What a vehicle of a recorded world senses."""

import math

import numpy as np
import pytest
from fake_traces import HIT, N, T, small_trace

from limsim_jax.api.map import load_map
from limsim_jax.api.world import World
from limsim_jax.maps.scenery import Label
from limsim_jax.sensors.objects import Detector
from limsim_jax.sensors.rig import LAYERS_16, Camera, Rig

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
