"""Predictions of all vehicles: against the engine's own motion, closed forms, and NumPy loops."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_worlds import bundled, scattered

from limsim_jax.maps.lane_map import width
from limsim_jax.policies.predict import (
    Plans,
    Replayed,
    along_route,
    constant_velocity,
    nearest,
    shared,
)
from limsim_jax.traffic.ego import Trajectory
from limsim_jax.traffic.motion import advance, boxes
from limsim_jax.types import Config

pytestmark = pytest.mark.engine

CONFIG = Config(dt=0.1)
TIMES = jnp.arange(9, dtype=jnp.float32) * 0.5
N = 12


def world(name, seed=0):
    """Vehicles at several speeds, one of them standing; two change lanes if the map has room for that."""
    state = scattered(name, N, seed)
    lane_map = bundled(name)[1]
    v = jnp.linspace(0.0, 22.0, N)
    left = np.asarray(lane_map.left)[np.asarray(state.lane)]
    side = np.zeros(N, np.int32)
    side[np.nonzero(left >= 0)[0][:2]] = 1
    between = (width(lane_map, state.lane, state.s) + width(lane_map, left, state.s)) / 2
    shift = jnp.where(jnp.asarray(side) == 1, -between, 0.0)
    return dataclasses.replace(state, v=v, side=jnp.asarray(side), shift=shift)


@jax.jit
def moved(lane_map, state):
    """The engine's boxes at the times without acceleration, and which vehicles are active."""

    def step(state, _):
        state, _, _ = advance(CONFIG, lane_map, state, jnp.zeros_like(state.v))
        return state, (boxes(lane_map, state), state.active)

    _, (box, active) = jax.lax.scan(step, state, None, length=40)
    first = boxes(lane_map, state)[None]
    return jnp.concatenate([first, box])[::5], jnp.concatenate([state.active[None], active])[::5]


predict = jax.jit(along_route)


@pytest.mark.parametrize("name", ["highway", "intersection"])
def test_along_route_is_the_engine_without_acceleration(name):
    state, lane_map = world(name), bundled(name)[1]
    found = predict(lane_map, state, TIMES)
    box, active = (np.asarray(x) for x in moved(lane_map, state))
    assert active.any(1).all() and (name != "highway" or np.asarray(state.side).sum() == 2)
    for k, (values, tolerance) in enumerate(((found.x, 0.12), (found.y, 0.12), (found.heading, 0.03))):
        off = np.asarray(values).T - box[..., k]
        off = off if k < 2 else np.remainder(off + np.pi, 2 * np.pi) - np.pi
        assert np.abs(np.where(active, off, 0)).max() < tolerance, k
    np.testing.assert_array_equal(found.length, state.shape.length)


def test_replayed_motion_continues_from_present_positions():
    state, lane_map = world("highway"), bundled("highway")[1]
    here = np.asarray(boxes(lane_map, state))
    t = np.arange(1, 81)[:, None] * 0.1  # rows are after steps
    box = np.tile(here, (80, 1, 1))
    speeds = np.linspace(1.0, 12.0, N)
    box[:, :, 0] += 100.0 + t * speeds - 0.3 * t * t
    box[:, :, 2] += 0.02 * t
    recall = Replayed(jnp.asarray(box, jnp.float32), 0.1)
    at = 2.0  # s: the first run is known up to 8 s, so that the last of the times is past its end
    found = recall(lane_map, dataclasses.replace(state, step=jnp.int32(20)), TIMES + 3.0)
    later = np.minimum(at + np.asarray(TIMES) + 3.0, 8.0)

    def way(t):
        return speeds[:, None] * t - 0.3 * t * t

    np.testing.assert_allclose(found.x, here[:, :1] + way(later) - way(np.float64(at)), atol=2e-3)
    np.testing.assert_allclose(found.y, np.repeat(here[:, 1:2], len(later), 1), atol=1e-3)
    np.testing.assert_allclose(
        found.heading - here[:, 2:3], 0.02 * (later - at)[None].repeat(N, 0), atol=1e-4
    )


def test_offset_fades_and_stop_is_kept():
    state = dataclasses.replace(scattered("highway", N, 3), d=jnp.linspace(-1.0, 1.0, N))
    lane_map = bundled("highway")[1]
    stop = jnp.full(N, 1e6).at[2].set(30.0).at[3].set(4.0)
    found = predict(lane_map, state, TIMES, stop=stop)
    free = predict(lane_map, dataclasses.replace(state, d=jnp.zeros(N)), TIMES)
    apart = np.hypot(found.x - free.x, found.y - free.y)
    np.testing.assert_allclose(apart[:, 0], np.abs(np.linspace(-1, 1, N)), atol=1e-3)
    np.testing.assert_allclose(np.delete(apart[:, -2], [2, 3]), 0, atol=1e-3)
    way = np.hypot(found.x - found.x[:, :1], found.y - found.y[:, :1])
    # 15 m/s: braking with 15^2 / 60 = 3.75 m/s^2 at once; 4 m are not enough for anything but standing there
    t = np.minimum(np.asarray(TIMES), 4.0)
    np.testing.assert_allclose(way[2], 15 * t - 3.75 * t * t / 2, atol=0.3)
    assert way[3].max() < 4.4 and way[4, -1] == pytest.approx(60.0, rel=1e-2)


def test_plans_replace_predictions():
    state, lane_map = world("highway"), bundled("highway")[1]
    line = jnp.broadcast_to(jnp.arange(9.0), (2, 9))
    plans = Plans(slot=jnp.array([4, -1]), x=line, y=line + 1, heading=line * 0)
    found, free = predict(lane_map, state, TIMES, plans=plans), predict(lane_map, state, TIMES)
    np.testing.assert_array_equal(found.x[4], line[0])
    np.testing.assert_array_equal(found.y[4], line[0] + 1)
    others = np.delete(np.arange(N), 4)
    np.testing.assert_array_equal(np.asarray(found.x)[others], np.asarray(free.x)[others])


def test_shared_plans_continue_from_present_positions():
    state, lane_map = world("roundabout", 1), bundled("roundabout")[1]
    box = np.asarray(boxes(lane_map, state))
    # chosen at 7 s, it is 7.5 s now: an arc of 30 m to the left, at 6 m/s, for 4 s
    t, radius, v = np.arange(9) * 0.5, 30.0, 6.0

    def arc(row, at, turned):
        angle = box[row, 2] + turned + v * at / radius
        x = box[row, 0] + radius * (np.sin(angle) - np.sin(box[row, 2]))
        y = box[row, 1] - radius * (np.cos(angle) - np.cos(box[row, 2]))
        return np.stack([x, y, np.remainder(angle + np.pi, 2 * np.pi) - np.pi, 0 * at + v])

    begun = -v * 0.5 / radius  # half a second ago it was that much short of its heading
    rows = np.stack([arc(k, t, begun) for k in (3, 5, 6, 7)])
    rows[0, 0] += 0.7  # driven to one side of it
    rows[2, 1] += 3.0  # strayed
    x, y, heading, speed = (jnp.asarray(rows[:, k], jnp.float32) for k in range(4))
    plan = Trajectory(x=x, y=y, heading=heading, v=speed, t0=jnp.float32(7.0), dt=0.5)
    slot = jnp.asarray([3, 5, 6, -1])
    plans = shared(lane_map, state, slot, plan, jnp.float32(7.5), TIMES)
    np.testing.assert_array_equal(plans.slot, [3, 5, -1, -1])
    found, free = predict(lane_map, state, TIMES, plans=plans), predict(lane_map, state, TIMES)
    for k, row in enumerate((3, 5)):
        ahead = arc(row, np.asarray(TIMES), 0.0)
        # beyond the end of the plan, half a second straight on
        over = v * 0.5 * np.stack([np.cos(ahead[2, 7]), np.sin(ahead[2, 7])])
        ahead[:2, 8], ahead[2, 8] = ahead[:2, 7] + over, ahead[2, 7]
        np.testing.assert_allclose(found.x[row], ahead[0], atol=2e-3, err_msg=str(k))
        np.testing.assert_allclose(found.y[row], ahead[1], atol=2e-3)
        turned = np.asarray(found.heading[row]) - ahead[2]
        np.testing.assert_allclose(np.remainder(turned + np.pi, 2 * np.pi) - np.pi, 0, atol=1e-4)
    others = np.delete(np.arange(N), [3, 5])
    np.testing.assert_array_equal(np.asarray(found.x)[others], np.asarray(free.x)[others])


def test_constant_velocity_keeps_the_heading():
    state, lane_map = world("roundabout", 1), bundled("roundabout")[1]
    found, box = constant_velocity(lane_map, state, TIMES), np.asarray(boxes(lane_map, state))
    t, v = np.asarray(TIMES)[None], np.asarray(state.v)[:, None]
    np.testing.assert_allclose(found.x, box[:, :1] + v * t * np.cos(box[:, 2:3]), atol=1e-3)
    np.testing.assert_allclose(found.y, box[:, 1:2] + v * t * np.sin(box[:, 2:3]), atol=1e-3)


def test_nearest_is_a_sort_of_distances():
    state, lane_map = world("highway", 4), bundled("highway")[1]
    state = dataclasses.replace(state, active=state.active.at[5].set(False))
    found = predict(lane_map, state, TIMES)
    slot = jnp.array([3, -1, 0])
    got = np.asarray(nearest(lane_map, state, found, slot, 14))
    x, y = np.asarray(found.x), np.asarray(found.y)
    for row, me in ((0, 3), (2, 0)):
        apart = {
            j: np.hypot(x[j] - x[me], y[j] - y[me]).min() - float(found.length[j]) / 2
            for j in range(N)
            if j not in (me, 5)
        }
        assert list(got[row]) == [*sorted(apart, key=lambda j: apart[j]), -1, -1, -1, -1]
    assert (got[1] == -1).all()
