"""Pictures for a vision-language driver: those of the cameras of each ego."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from traffic_worlds import bundled, scattered

from limsim_jax.maps.map import load_map
from limsim_jax.policies.language.pictures import look, rig_of
from limsim_jax.policies.language.scene import LookAround
from limsim_jax.sensors.camera import take_pictures
from limsim_jax.sensors.scene import bodies_around, pose_of, scene_of
from limsim_jax.traffic.ego import from_lane
from limsim_jax.traffic.motion import boxes
from limsim_jax.types import Config

pytestmark = pytest.mark.engine  # a state and a map are made


def world():
    lane_map = bundled("roundabout")[1]
    state = scattered("roundabout", 20, seed=3)
    egos = from_lane(lane_map, state, boxes(lane_map, state), [2, 5], True)
    return replace(lane_map, scenery=load_map("roundabout").scenery), replace(state, egos=egos)


def test_without_scenery_there_are_no_pictures():
    lane_map, state = world()
    with pytest.raises(ValueError, match="no scenery"):
        jax.eval_shape(lambda state: look(rig_of("front"), replace(lane_map, scenery=None), state), state)
    assert not LookAround().needs_scenery and LookAround(rig=rig_of("six")).needs_scenery


def test_each_ego_sees_by_its_own_cameras():
    lane_map, state = world()
    rig = rig_of("three").sized(64, 36)
    seen = jax.jit(LookAround(rig=rig), static_argnums=0)(Config(dt=0.1), lane_map, state)
    assert seen.pictures.shape == (2, 3, 36, 64, 3) and seen.pictures.dtype == np.uint8
    scenery = lane_map.scenery
    assert scenery is not None
    scene = scene_of(lane_map, scenery, state)
    for row, slot in enumerate((2, 5)):
        bodies = bodies_around(scene, scenery, slot)
        own = take_pictures(rig, scenery, pose_of(scene, slot), bodies).color
        same = (np.asarray(own) == np.asarray(seen.pictures[row])).all(-1)
        assert same.mean() > 0.999  # rounding at edges
    assert (np.asarray(seen.pictures[0]) != np.asarray(seen.pictures[1])).any(-1).mean() > 0.1
