"""Scenes of states and of traces."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sensed_worlds import scenery
from traffic_worlds import bundled, scattered

from limsim_jax.maps.lane_map import VEHICLE_CLASSES
from limsim_jax.maps.scenery import Label
from limsim_jax.maps.signal_table import SignalState
from limsim_jax.maps.signals import lane_states_on_host
from limsim_jax.sensors.scene import HEIGHTS, LIGHTS, Lamp, bodies_around, scene_of

SLOTS = 12
_scene = jax.jit(scene_of)
_around = jax.jit(bodies_around, static_argnames=("objects", "lights"))


@pytest.fixture(scope="module")
def state():
    return scattered("intersection", SLOTS, 4)


@pytest.fixture(scope="module")
def lane_map():
    return bundled("intersection")[1]


def test_bodies_are_the_nearest_in_the_frame_of_the_ego(state, lane_map):
    scene = _scene(lane_map, scenery(), state)
    ego = 3
    found = _around(scene, scenery(), ego, objects=5)
    box = np.asarray(scene.box, float)
    turn = np.exp(-1j * box[ego, 2])
    place = (box[:, 0] + 1j * box[:, 1] - (box[ego, 0] + 1j * box[ego, 1])) * turn
    order = [n for n in np.argsort(abs(place)) if n != ego and scene.active[n]][:5]
    assert found.slot[:5].tolist() == order and found.there[:5].all()
    assert (found.slot[5:] == -1).all() and found.x.shape == (5 + LIGHTS,)
    np.testing.assert_allclose(found.x[:5], place[order].real, atol=2e-3)
    np.testing.assert_allclose(found.y[:5], place[order].imag, atol=2e-3)
    np.testing.assert_allclose(found.heading[:5], box[order, 2] - box[ego, 2], atol=1e-5)
    speed = np.asarray(scene.v)[order] * np.exp(1j * (box[order, 2] - box[ego, 2]))
    np.testing.assert_allclose(found.vx[:5], speed.real, atol=1e-4)
    np.testing.assert_allclose(found.vy[:5], speed.imag, atol=1e-4)


def test_bodies_on_another_level_are_out_of_sight(state, lane_map):
    scene = _scene(lane_map, scenery(), state)
    near = int(_around(scene, scenery(), 3, objects=5).slot[0])
    above = replace(scene, z=scene.z.at[near].add(6.0))
    assert near not in _around(above, scenery(), 3, objects=5).slot.tolist()


def test_classes_have_their_heights(state, lane_map):
    kinds = jnp.arange(SLOTS, dtype=jnp.int32) % len(VEHICLE_CLASSES)
    mixed = replace(state, shape=replace(state.shape, vehicle_class=kinds))
    found = _around(_scene(lane_map, scenery(), mixed), scenery(), 0, objects=SLOTS)
    for k in np.flatnonzero(np.asarray(found.slot) >= 0):
        name = VEHICLE_CLASSES[int(kinds[int(found.slot[k])])]
        assert found.height[k] == np.float32(HEIGHTS[name])
        assert Label(int(found.label[k])).name.lower() == name


def test_brakes_shine_by_deceleration_and_at_rest(state, lane_map):
    a = jnp.zeros(SLOTS).at[1].set(-2.0).at[2].set(-1.0)
    v = jnp.full(SLOTS, 8.0).at[3].set(0.0)
    lamps = np.asarray(_scene(lane_map, scenery(), replace(state, a=a, v=v)).lamps)
    on = (lamps & Lamp.BRAKE) != 0
    assert np.flatnonzero(on).tolist() == [1, 3]


def test_turns_and_lane_changes_are_signalled(state, lane_map):
    turn = np.asarray(scenery().turn)
    for side, lamp in ((1, Lamp.LEFT), (-1, Lamp.RIGHT)):
        connector = int(np.flatnonzero(turn == side)[0])
        before = int(np.asarray(lane_map.predecessors)[connector, 0])
        reach = np.asarray(lane_map.routes.next_lane)[before] == connector
        goal = int(np.flatnonzero(reach)[0])
        length = float(lane_map.length[before])
        moved = replace(
            state,
            lane=state.lane.at[:3].set(jnp.asarray([before, before, connector])),
            s=state.s.at[:3].set(jnp.asarray([length - 10, length - 45, 2.0])),
            goal=state.goal.at[:3].set(goal),
            side=state.side.at[:].set(0).at[3].set(side),
        )
        lamps = np.asarray(_scene(lane_map, scenery(), moved).lamps)
        both = int(Lamp.LEFT | Lamp.RIGHT)
        assert lamps[0] & both == lamp and lamps[1] & both == 0 and lamps[2] & both == lamp
        assert lamps[3] & both == lamp


def test_lights_show_their_phase(state, lane_map):
    behind = np.asarray(scenery().light_lane)
    names = {
        SignalState.RED: Label.LIGHT_RED, SignalState.YELLOW: Label.LIGHT_YELLOW,
        SignalState.GREEN_MAJOR: Label.LIGHT_GREEN, SignalState.GREEN_MINOR: Label.LIGHT_GREEN,
    }  # fmt: skip
    seen = set()
    for phase in range(int(lane_map.signals.num_phases[0])):
        phases = jnp.zeros_like(state.lights.phase).at[0].set(phase)
        scene = _scene(lane_map, scenery(), replace(state, lights=replace(state.lights, phase=phases)))
        states = lane_states_on_host(lane_map.signals, np.asarray(phases)[None])[0]
        for k in np.flatnonzero(behind >= 0):
            expected = names[SignalState(int(states[behind[k]]))]
            assert scene.light[k] == expected
            seen.add(expected)
    assert len(seen) == 3


def test_an_ego_sees_the_lights_that_it_comes_to(state, lane_map):
    place = scenery()
    k = int(np.flatnonzero(np.asarray(place.light_lane) >= 0)[0])
    x, y, heading = (float(v) for v in place.light[k])
    for offset, sees in ((-20.0, True), (20.0, False)):
        scene = _scene(lane_map, place, state)
        at = jnp.asarray([x + offset * np.cos(heading), y + offset * np.sin(heading), heading, 4.5, 1.8])
        found = _around(replace(scene, box=scene.box.at[0].set(at.astype(jnp.float32))), place, 0, objects=2)
        near = np.hypot(found.x[2:] - 20, found.y[2:]) < 1e-2
        assert bool((near & np.asarray(found.there[2:])).any()) is sees
