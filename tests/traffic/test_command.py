"""Commands that are broken: found, taken out, and driven to a standstill."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_worlds import bundled, motorway, state_of

from limsim_jax.traffic.command import Command, without_broken
from limsim_jax.traffic.ego import Control, Meta, Trajectory, from_lane
from limsim_jax.traffic.engine import Traffic, drive
from limsim_jax.traffic.motion import boxes
from limsim_jax.types import Config, State, Status

CONFIG = Config(dt=0.1)
NAN, INF = float("nan"), float("inf")
N = 6


def world(free: bool = True, v: float = 12.0) -> State:
    """Five vehicles in a row on the motorway; egos in slots 3, 1, 0, and in 5 one that is gone."""
    lane_map = bundled("highway")[1]
    row, goal = motorway()
    state = state_of(
        "highway", [row] * N, [400.0 - 60 * k for k in range(N)], [v] * N, [goal] * N,
        active=jnp.arange(N) != 5,
    )  # fmt: skip
    return dataclasses.replace(
        state, egos=from_lane(lane_map, state, boxes(lane_map, state), [3, 1, 0, 5], free)
    )


def slots_of(state: State) -> list[int]:
    return np.flatnonzero(np.asarray(state.status & int(Status.NOT_FINITE))).tolist()


def control(**changes) -> Control:
    values = {
        name: jnp.asarray(changes.get(name, [0.1] * 4), jnp.float32) for name in ("acceleration", "steering")
    }
    return Control(**values)


def straight(state: State, **changes) -> Trajectory:
    """Straight on at the present speed."""
    t = 0.1 * jnp.arange(11.0)
    egos, v = state.egos, state.v[state.egos.slot]
    way = v[:, None] * t[None]
    values = {
        "x": egos.x[:, None] + jnp.cos(egos.heading)[:, None] * way,
        "y": egos.y[:, None] + jnp.sin(egos.heading)[:, None] * way,
        "heading": jnp.broadcast_to(egos.heading[:, None], way.shape),
        "v": jnp.broadcast_to(v[:, None], way.shape),
        "t0": CONFIG.time(state.step),
    }
    return Trajectory(**(values | changes), dt=0.1)


@pytest.mark.parametrize("bad", [NAN, INF, -INF])
@pytest.mark.parametrize("field", ["acceleration", "steering"])
def test_a_control_that_is_not_finite_is_broken(field, bad):
    state = world()
    given = control(**{field: [0.2, bad, 0.3, bad]})  # the last one is of an ego that is gone
    after, command, broken = without_broken(state, Command(control=given))
    assert broken.tolist() == [False, True, False, False] and slots_of(after) == [1]
    assert command.control is not None
    assert jnp.isfinite(command.control.acceleration).all() and jnp.isfinite(command.control.steering).all()
    np.testing.assert_array_equal(getattr(command.control, field)[::2], getattr(given, field)[::2])


@pytest.mark.parametrize("field", ["x", "y", "heading", "v"])
def test_a_trajectory_is_broken_by_any_sample(field):
    state = world()
    whole = straight(state)
    given = dataclasses.replace(whole, **{field: getattr(whole, field).at[2, 10].set(NAN)})
    after, command, broken = without_broken(state, Command(trajectory=given))
    assert broken.tolist() == [False, False, True, False] and slots_of(after) == [0]
    assert command.trajectory is not None
    assert all(
        bool(jnp.isfinite(getattr(command.trajectory, name)).all()) for name in ("x", "y", "heading", "v")
    )
    np.testing.assert_array_equal(command.trajectory.x[:2], whole.x[:2])
    never = dataclasses.replace(whole, t0=jnp.float32(NAN))
    after, command, broken = without_broken(state, Command(trajectory=never))
    assert broken.tolist() == [True, True, True, False] and slots_of(after) == [0, 1, 3]


def test_meta_actions_count_on_lanes_and_controls_in_the_plane():
    bound = world(free=False)
    meta = jnp.array([-1, -2, max(Meta) + 1, -2])
    after, command, broken = without_broken(bound, Command(meta=meta))
    assert broken.tolist() == [False, True, True, False] and slots_of(after) == [0, 1]
    np.testing.assert_array_equal(command.meta, [-1, Meta.STOP, Meta.STOP, Meta.STOP])
    assert not without_broken(world(), Command(meta=meta))[2].any()  # free egos take no meta-actions
    assert not without_broken(bound, Command(control=control(steering=[NAN] * 4)))[2].any()
    after, _, broken = without_broken(bound, Command())
    assert not broken.any() and slots_of(after) == []


def driven(state: State, command: Command, decisions: int = 1) -> State:
    lane_map = bundled("highway")[1]
    one = jax.jit(lambda state: drive(CONFIG, Traffic(), lane_map, state, None, command)[0])
    for _ in range(decisions):
        state = one(state)
    return state


@pytest.mark.engine
def test_a_broken_ego_brakes_with_its_wheel_held_and_the_others_go_on():
    state = world()
    steering = jnp.array([0.0, 0.01, 0.0, 0.0])
    state = dataclasses.replace(state, egos=dataclasses.replace(state.egos, steering=steering))
    still = {"acceleration": [0.0] * 4, "steering": [0.0, 0.01, 0.0, 0.0]}
    whole = driven(state, Command(control=control(**still)))
    end = driven(
        state, Command(control=control(acceleration=[0.0, NAN, 0.0, NAN], steering=still["steering"]))
    )
    assert slots_of(end) == [1] and slots_of(whole) == []
    np.testing.assert_array_equal(end.egos.steering[1], steering[1])
    braked = np.delete(np.arange(N), [1, 2])  # the one behind it reacts
    np.testing.assert_array_equal(end.v[braked], whole.v[braked])
    assert float(end.v[1]) < float(whole.v[1]) - 2.0
    stood = driven(end, Command(control=control(acceleration=[NAN] * 4)), 6)
    assert slots_of(stood) == [0, 1, 3] and float(jnp.max(stood.v[jnp.array([0, 1, 3])])) == 0.0
    assert all(
        bool(jnp.isfinite(x).all()) for x in (stood.s, stood.d, stood.v, stood.egos.x, stood.egos.heading)
    )


@pytest.mark.engine
def test_numbers_too_large_to_follow_are_broken_when_they_are_used():
    state = world()
    whole = straight(state)
    wild = dataclasses.replace(whole, x=whole.x.at[0].multiply(1e30), v=whole.v.at[0].set(3e38))
    end = driven(state, Command(trajectory=wild), 2)
    assert slots_of(end) == [3]
    assert all(bool(jnp.isfinite(x).all()) for x in (end.s, end.d, end.v, end.egos.x, end.egos.heading))


@pytest.mark.engine
def test_free_egos_leave_where_they_arrive():
    lane_map = bundled("highway")[1]
    end_lane = np.flatnonzero(np.asarray(lane_map.routes.is_goal).any(1) & np.asarray(lane_map.valid))[0]
    goal = int(np.flatnonzero(np.asarray(lane_map.routes.is_goal[end_lane]))[0])
    near = float(lane_map.length[end_lane]) - 3.0
    state = state_of("highway", [end_lane] * 2, [near, near - 50.0], [20.0, 20.0], [goal] * 2)
    state = dataclasses.replace(state, egos=from_lane(lane_map, state, boxes(lane_map, state), [0, 1], True))
    steady = Command(control=Control(acceleration=jnp.zeros(2), steering=jnp.zeros(2)))
    end, left = jax.jit(
        lambda state: drive(CONFIG, Traffic(), lane_map, state, None, steady, lambda tick: tick.left)
    )(state)
    assert np.asarray(left).tolist() == [[False, False], [True, False], *[[False, False]] * 3]  # 2 m a step
    assert end.active.tolist() == [False, True] and int(end.lane[0]) == -1
    assert float(end.distance[0]) == pytest.approx(4.0, abs=1e-3)
