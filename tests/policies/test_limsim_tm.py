"""LimSim-TM in the engine: corridors of real lanes, and an ego that gets through traffic."""

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_worlds import bundled, drivers, shapes, state_of

from limsim_jax.maps.lane_map import NO_LANE, lane_rows
from limsim_jax.maps.origins import origins
from limsim_jax.maps.routing import default_goals
from limsim_jax.policies.area import AreaOfInterest
from limsim_jax.policies.base import LikeTraffic, Policy, variants
from limsim_jax.policies.limsim_tm import LimSimTM
from limsim_jax.policies.limsim_tm.decide import corridor, grouped
from limsim_jax.policies.limsim_tm.plan import room_needed
from limsim_jax.policies.limsim_tm.search import Settings
from limsim_jax.policies.pdm import PDMClosed
from limsim_jax.policies.predict import along_route, constant_velocity
from limsim_jax.policies.simple import ConstantSpeed, FollowLane
from limsim_jax.policies.view import View
from limsim_jax.simulation.rollout import Rollout, one_world
from limsim_jax.simulation.trace import trace
from limsim_jax.traffic.demand import EgoStart, Flow, build_demand, sample_scenario
from limsim_jax.traffic.ego import from_lane
from limsim_jax.traffic.engine import Traffic
from limsim_jax.traffic.motion import boxes
from limsim_jax.traffic.vehicles import default_population, restrict_to_map
from limsim_jax.types import Config

pytestmark = pytest.mark.engine


def entrance():
    """Rows of the acceleration lane of the ramp and of the lanes to its left, and the goal straight on."""
    network, lane_map = bundled("ramp")
    goals = list(default_goals(network))
    dead = [
        row for row in lane_rows(network).values()
        if bool(lane_map.valid[row]) and int(lane_map.successors[row, 0]) == NO_LANE
        and int(lane_map.left[row]) != NO_LANE and float(lane_map.length[row]) > 200
        and not bool(lane_map.routes.is_goal[row].any())
    ]  # fmt: skip
    lane = dead[0]
    goal = next(g for g in range(len(goals)) if int(lane_map.routes.lanes_to_go[lane, g]) == 1)
    return lane, int(lane_map.left[lane]), goal


def test_a_corridor_knows_the_lanes_that_lead_to_the_goal():
    lane_map = bundled("ramp")[1]
    lane, beside, goal = entrance()
    rows, places = jnp.asarray([lane, beside]), jnp.asarray([40.0, 55.0])
    found = corridor(lane_map, rows, places, jnp.full(2, goal), jnp.zeros(2, jnp.int32))
    # the acceleration lane ends: one to the left, before its end
    assert int(found.wanted_right[0]) == int(found.wanted_left[0]) == 1
    assert int(found.left[0]) >= 1 and int(found.right[0]) == 0
    np.testing.assert_allclose(found.to_go[0], lane_map.routes.change_distance[lane, goal] - 40.0)
    # from beside it, nothing to the right leads on
    assert int(found.wanted_right[1]) == 0 and int(found.right[1]) in (0, 1)


def test_groups_include_each_neighbor_once():
    lane = entrance()[1]
    state = state_of("ramp", [lane] * 4, [60.0, 80.0, 100.0, 250.0], [20.0] * 4, [0] * 4)
    lane_map = bundled("ramp")[1]
    slot = jnp.asarray([0, 3, -1], jnp.int32)
    near = jnp.asarray([[1, 2], [2, 1], [0, 1]], jnp.int32)
    counts = jnp.asarray([[True, True], [False, False], [True, True]])
    members = grouped(
        lane_map, state, slot, slot >= 0, jnp.where(slot >= 0, lane, NO_LANE), jnp.zeros(3, jnp.int32),
        state.s, 0 * state.s, near, counts,
    )  # fmt: skip
    np.testing.assert_array_equal(np.sort(members, -1), [[0, 1, 2], [-1, -1, 3], [-1, -1, -1]])


def test_room_for_a_lane_change():
    v = jnp.asarray([20.0, 20.0, 20.0])
    ahead = jnp.asarray([20.0, 14.0, 30.0])
    # to brake from 6 m/s more to the other's speed with 2 m/s^2 takes 9 m, and half a second of reaction 3 m
    np.testing.assert_allclose(room_needed(v, ahead, 2.0, 0.3), [8.0, 8.0 + 3.0 + 9.0, 2.0])


@functools.cache
def runs():
    """Two worlds of the roundabout with an ego that LimSim-TM drives."""
    network, lane_map = bundled("roundabout")
    flows = [Flow(origin=name, rate=350.0) for name in origins(network)]
    population = restrict_to_map(default_population(), lane_map)
    egos = EgoStart(driver=drivers(1), shape=shapes(1), free=jnp.asarray([True]))
    demand = build_demand(
        network, lane_map, default_goals(network), flows, population, horizon=30.0, density=4.0, egos=egos
    )
    policy = LimSimTM(search=Settings(simulations=10))
    run = Rollout(Config(dt=0.1), Traffic(), 30.0, policy, record=trace)
    sampler = lambda key: sample_scenario(demand, lane_map, key, 24, egos)  # noqa: E731
    return jax.jit(jax.vmap(functools.partial(one_world, run, lane_map, sampler)))(jnp.asarray([0, 4]))


def test_an_ego_gets_through_traffic():
    result = runs()
    v, status = np.asarray(result.trace.v[:, :, 0]), np.asarray(result.trace.status[:, :, 0])
    assert not status.any()
    assert not np.asarray(result.totals.collided).any()
    assert (np.asarray(result.state.distance[:, 0]) > 100).all()
    assert v.max() < 0.985 * 50 / 3.6 + 0.5  # keeps to the limit
    a = np.asarray(result.trace.a[:, :, 0])
    assert a.min() > -4.5 and a.max() < 3.0
    assert np.isfinite(result.trace.box).all()


def test_planned_vehicles_know_the_trajectories_of_the_others():
    lane_map = bundled("ramp")[1]
    lane = entrance()[1]
    state = state_of("ramp", [lane] * 3, [60.0, 110.0, 160.0], [20.0, 14.0, 20.0], [0] * 3)
    egos = from_lane(lane_map, state, boxes(lane_map, state), [0, 1], True)
    state = replace(state, egos=egos)
    asked = []

    def spied(lane_map, state, times, *, stop=None, plans=None):
        asked.append(plans)
        return along_route(lane_map, state, times, stop=stop, plans=plans)

    config = Config(dt=0.1)
    policy = LimSimTM(search=None, predict=spied)

    @jax.jit
    def decide(memory):
        command, memory = policy(config, lane_map, state, memory, jax.random.key(0))
        return command, memory, asked.pop()

    command, memory, first = decide(policy.init(config, lane_map, state))
    _, _, second = decide(memory)
    np.testing.assert_array_equal(first.slot, [-1, -1])  # nothing chosen yet
    np.testing.assert_array_equal(second.slot, [0, 1])
    np.testing.assert_allclose(second.x, command.trajectory.x, atol=1e-3)
    np.testing.assert_allclose(second.y, command.trajectory.y, atol=1e-3)
    assert replace(policy, shares=False).init(config, lane_map, state).plan is None


def test_an_optional_lane_change_does_not_begin_shortly_before_a_junction():
    """Otherwise the vehicle stops between two lanes at the entry of a roundabout."""
    network, lane_map = bundled("long_route")
    routes, (goal, lane) = lane_map.routes, (2, lane_rows(network)["7_0_-3"])
    length = float(lane_map.length[lane])
    assert (
        int(routes.lanes_to_go[lane, goal]) == 2 and float(routes.change_distance[lane, goal]) > length + 100
    )
    # with `forced`, there is nothing behind the junction: the change has to be made here
    forced = replace(
        lane_map, routes=replace(routes, change_distance=jnp.minimum(routes.change_distance, length))
    )
    state = state_of("long_route", [lane] * 2, [20.0, length - 10.0], [7.0, 7.0], [goal] * 2)
    egos = from_lane(lane_map, state, boxes(lane_map, state), [0, 1], True)
    state, config, policy = replace(state, egos=egos), Config(dt=0.1), LimSimTM(search=None)

    @jax.jit
    def decide(lane_map):
        memory = policy.init(config, lane_map, state)
        return policy(config, lane_map, state, memory, jax.random.key(0))[1].side

    np.testing.assert_array_equal(decide(lane_map), [1, 0])
    np.testing.assert_array_equal(decide(forced), [1, 1])


def test_each_module_has_a_reference():
    policy = LimSimTM(others=2, search_every=2)
    found = variants(policy, constant_velocity)
    assert list(found) == ["prediction", "decision", "planning"]
    assert found["prediction"] == replace(policy, predict=constant_velocity)
    assert found["decision"] == replace(policy, search=None)
    assert found["planning"] == FollowLane(others=2)
    mine = variants(AreaOfInterest(around=policy, slots=2), constant_velocity)["decision"]
    assert isinstance(mine, AreaOfInterest) and isinstance(mine.around, LimSimTM)
    assert mine.ego == LimSimTM(search=None, search_every=2) and mine.around.search is not None
    assert list(variants(PDMClosed(), constant_velocity)) == ["prediction", "planning"]
    assert variants(LikeTraffic(), constant_velocity) == {}


def test_a_view_that_errs_is_a_module():
    poor = View(range=80.0, misses=0.3, position_noise=0.5, speed_noise=0.2, latency=0.5, occlusion=True)
    exact = View(range=80.0)
    assert poor.without_errors() == exact == exact.without_errors()
    policy = LimSimTM(search_every=2, view=poor)
    found = variants(policy, constant_velocity)
    assert list(found) == ["perception", "prediction", "decision", "planning"]
    assert found["perception"] == replace(policy, view=exact)
    others = [found[name] for name in ("prediction", "decision", "planning")]
    assert all(isinstance(x, Policy) and x.view == poor and not x.privileged for x in others)
    assert list(variants(ConstantSpeed(view=poor), constant_velocity)) == ["perception"]
    assert variants(ConstantSpeed(view=exact), constant_velocity) == {}
    assert variants(ConstantSpeed(view=poor, privileged=True), constant_velocity) == {}
    around = AreaOfInterest(around=policy, slots=2)
    mine = variants(around, constant_velocity)["perception"]
    assert isinstance(mine, AreaOfInterest) and mine.ego == LimSimTM(search_every=2, view=exact)
    assert mine.around == policy
