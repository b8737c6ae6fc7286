"""What a learned policy sees, against a NumPy loop."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_worlds import bundled, motorway, scattered, state_of

from limsim_jax.policies.vector import ALONG, EGO, LIGHT, OTHER, ROUTE, SPEED, ObserveVector, may_change
from limsim_jax.traffic.ego import from_lane
from limsim_jax.traffic.motion import boxes
from limsim_jax.types import Config

CONFIG = Config(dt=0.1)


def world(name="roundabout", n=24, egos=(2, 5)):
    lane_map = bundled(name)[1]
    state = scattered(name, n, seed=3)
    egos = from_lane(lane_map, state, boxes(lane_map, state), list(egos), False)
    return lane_map, dataclasses.replace(state, egos=egos)


def parts(vector, observe):
    """The four blocks of a vector."""
    first = len(EGO)
    second = first + observe.points * len(ROUTE)
    third = second + observe.nearest * len(OTHER)
    assert vector.shape == (third + len(LIGHT),) == (observe.size,)
    return (
        dict(zip(EGO, vector[:first], strict=True)),
        vector[first:second].reshape(-1, len(ROUTE)),
        vector[second:third].reshape(-1, len(OTHER)),
        dict(zip(LIGHT, vector[third:], strict=True)),
    )


@pytest.mark.engine
def test_vectors_show_what_a_loop_finds():
    observe = ObserveVector()
    lane_map, state = world()
    seen = np.asarray(jax.jit(lambda m, s: observe(CONFIG, m, s))(lane_map, state))
    assert observe.size == 12 + 20 * 3 + 16 * 8 + 5
    assert np.isfinite(seen).all() and (np.abs(seen) <= 1).all()
    box, v = np.asarray(boxes(lane_map, state)), np.asarray(state.v)
    for row, slot in enumerate(np.asarray(state.egos.slot)):
        ego, route, others, light = parts(seen[row], observe)
        np.testing.assert_allclose(ego["speed"], v[slot] / SPEED, rtol=1e-5)
        np.testing.assert_allclose(route[0, 0], 0, atol=5 / ALONG)
        assert (np.diff(route[:10, 0]) > 0).all() and sum(light[name] for name in LIGHT[:-1]) == 1
        x, y, heading = box[slot, :3]
        turn = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
        away = (box[:, :2] - (x, y)) @ turn.T
        near = np.hypot(*away.T) - box[:, 3] / 2
        near[slot] = np.inf
        order = np.argsort(near)[: observe.nearest]
        assert (others[:, 0] == 1).all() and (np.abs(others[:, 1]) < 1).any()
        for k, other in enumerate(order):
            np.testing.assert_allclose(others[k, 1:3], np.clip(away[other] / (ALONG, 20.0), -1, 1), atol=1e-4)
            relative = box[other, 2] - heading
            np.testing.assert_allclose(others[k, 3:5], [np.cos(relative), np.sin(relative)], atol=1e-4)
            np.testing.assert_allclose(others[k, 6:], box[other, 3:] / (20.0, 3.0), rtol=1e-5)


@pytest.mark.engine
def test_who_is_gone_sees_zeros_and_broken_numbers_stay_within():
    lane_map, state = world(egos=(2, 5))
    egos = dataclasses.replace(state.egos, a=jnp.full(2, jnp.inf, jnp.float32))
    state = dataclasses.replace(state, active=state.active.at[2].set(False), egos=egos)
    seen = np.asarray(ObserveVector(nearest=30)(CONFIG, lane_map, state))
    assert (seen[0] == 0).all() and np.isfinite(seen).all() and (np.abs(seen) <= 1).all()
    others = parts(seen[1], ObserveVector(nearest=30))[2]
    assert (others[:22, 0] == 1).all() and (others[22:] == 0).all()  # itself and the one that is gone


@pytest.mark.engine
def test_lane_changes_follow_the_marks():
    lane_map = bundled("highway")[1]
    lane, goal = motorway()
    left = int(lane_map.left[lane])
    state = state_of("highway", [lane, left], [100.0, 200.0], [20.0, 20.0], [goal, goal])
    egos = from_lane(lane_map, state, boxes(lane_map, state), [0, 1], True)
    state = dataclasses.replace(state, egos=egos)
    assert np.asarray(may_change(lane_map, state)).tolist() == [[True, False], [True, True]]
