"""The area of interest: assignment of places, hand-overs without a jump, unchanged traffic."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_worlds import bundled, scattered

from limsim_jax.maps.origins import origins
from limsim_jax.maps.routing import default_goals
from limsim_jax.policies import POLICIES
from limsim_jax.policies.area import AreaOfInterest
from limsim_jax.policies.base import LikeTraffic
from limsim_jax.policies.simple import FollowLane
from limsim_jax.simulation.rollout import Rollout, one_world
from limsim_jax.simulation.trace import trace
from limsim_jax.traffic.demand import EgoStart, Flow, build_demand, sample_scenario
from limsim_jax.traffic.ego import assign, from_lane, with_rows
from limsim_jax.traffic.engine import Traffic
from limsim_jax.traffic.motion import boxes
from limsim_jax.traffic.vehicles import (
    default_population,
    restrict_to_map,
    sample_vehicles,
    uniform_population,
)
from limsim_jax.types import Config

pytestmark = pytest.mark.engine

CONFIG = Config(dt=0.1)
PLACES = 4


@functools.cache
def crowd():
    """Vehicles scattered over the roundabout; the ego in slot 2."""
    lane_map = bundled("roundabout")[1]
    state = scattered("roundabout", 20, seed=3)
    egos = from_lane(lane_map, state, boxes(lane_map, state), [2], False)
    return dataclasses.replace(state, egos=with_rows(egos, PLACES))


def area(**options):
    return AreaOfInterest(FollowLane(), ego=LikeTraffic(), slots=PLACES, **options)


def chosen(policy, state, memory, now):
    return policy._choose(bundled("roundabout")[1], state, memory, jnp.float32(now))


def away(state):
    lane_map = bundled("roundabout")[1]
    here = np.asarray(boxes(lane_map, state))[:, :2]
    return np.hypot(*(here - here[2]).T)


def test_the_nearest_vehicles_within_the_radius_get_the_places():
    state = crowd()
    policy = area(radius=90.0)
    memory = policy.init(CONFIG, bundled("roundabout")[1], state)
    found = chosen(policy, state, memory, 0.0)
    got = [int(k) for k in found.slot if k >= 0]
    assert len(got) == len(set(got)) and 2 not in got and got
    distance = away(state)
    assert all(distance[k] < 90.0 for k in got)
    lane_map = bundled("roundabout")[1]
    left = np.asarray(lane_map.length[state.lane] - state.s)
    last = np.asarray(lane_map.routes.is_goal[state.lane, state.goal])
    stays = ~(last & (left < 3 * np.asarray(state.v) + 10))
    fit = np.asarray(state.active) & stays & (np.asarray(state.s) > np.asarray(state.shape.length))
    fit[2] = False
    nearest = sorted(np.nonzero(fit & (distance < 90.0))[0], key=lambda k: distance[k])[:PLACES]
    assert sorted(got) == sorted(int(k) for k in nearest)
    assert int(found.switches) == len(got)
    # without vehicles nearby no place is given
    alone = chosen(area(radius=1e-3), state, memory, 0.0)
    assert (alone.slot == -1).all()


def test_places_are_kept_for_a_while_and_given_up_far_away():
    state = crowd()
    wide, narrow = area(radius=90.0), area(radius=1e-3, leave=2e-3, dwell=3.0)
    memory = wide.init(CONFIG, bundled("roundabout")[1], state)
    first = chosen(wide, state, memory, 10.0)
    again = chosen(wide, state, first, 10.5)
    np.testing.assert_array_equal(first.slot, again.slot)
    assert int(again.switches) == int(first.switches)
    young = chosen(narrow, state, first, 12.0)  # out of the area, but not long enough in it
    np.testing.assert_array_equal(first.slot, young.slot)
    old = chosen(narrow, state, first, 14.0)
    assert (old.slot == -1).all() and int(old.switches) == 2 * int(first.switches)
    # between two lanes a vehicle keeps its place: the traffic would see it on one of them only
    a, b = (int(k) for k in first.slot[:2])
    between = dataclasses.replace(state, d=state.d.at[a].set(-1.5), side=state.side.at[b].set(1))
    np.testing.assert_array_equal(chosen(narrow, between, first, 14.0).slot[:2], [a, b])
    assert (chosen(narrow, between, first, 14.0).slot[2:] == -1).all()
    # another vehicle in the same slot does not inherit the place
    late = dataclasses.replace(state, entered=state.entered + 5.0)
    assert not np.isin(
        np.asarray(chosen(narrow, late, first, 10.5).slot), np.asarray(first.slot[first.slot >= 0])
    ).any()


def test_a_vehicle_that_gets_a_place_continues_from_its_position():
    lane_map = bundled("roundabout")[1]
    state = crowd()
    box = boxes(lane_map, state)
    slot = jnp.asarray([2, 7, -1, 5, -1], jnp.int32)
    taken = assign(lane_map, state, box, slot)
    np.testing.assert_array_equal(taken.egos.free, [False, True, False, True, False])
    np.testing.assert_allclose(taken.egos.x[jnp.asarray([1, 3])], box[jnp.asarray([7, 5]), 0], rtol=1e-6)
    np.testing.assert_allclose(boxes(lane_map, taken), box, atol=1e-4)
    back = assign(lane_map, taken, boxes(lane_map, taken), jnp.asarray([2, -1, -1, 5, -1], jnp.int32))
    np.testing.assert_array_equal(back.egos.free, [False, False, False, True, False])
    for name in ("lane", "s", "d", "v", "a"):
        np.testing.assert_array_equal(getattr(back, name), getattr(state, name), err_msg=name)


@functools.cache
def runs():
    """The same three worlds without and with an area in which traffic drives in the plane."""
    network, lane_map = bundled("roundabout")
    flows = [Flow(origin=name, rate=350.0) for name in origins(network)]
    population = restrict_to_map(default_population(), lane_map)
    typical = uniform_population("car")
    vehicle = jnp.argmax(typical.share)[None].astype(jnp.int32)
    driver, shape = sample_vehicles(typical, jax.random.key(0), jnp.zeros(1, jnp.int32), vehicle)
    egos = EgoStart(driver=driver, shape=shape, free=jnp.asarray([False]))
    demand = build_demand(
        network, lane_map, default_goals(network), flows, population, horizon=30.0, density=4.0, egos=egos
    )
    found = []
    for policy in (LikeTraffic(), area(radius=60.0)):
        run = Rollout(CONFIG, Traffic(), 30.0, policy, record=trace)
        one = functools.partial(
            one_world, run, lane_map, lambda key: sample_scenario(demand, lane_map, key, 24, egos)
        )
        found.append(jax.jit(jax.vmap(one))(jnp.arange(3)))
    return found


def test_hand_overs_cause_no_jump_and_no_contact():
    plain, with_area = runs()
    assert (with_area.state.egos.slot[:, 1:] >= 0).any()
    for result in (plain, with_area):
        box, v, active, lane, vehicle = (
            np.asarray(getattr(result.trace, name)) for name in ("box", "v", "active", "lane", "vehicle")
        )
        stays = active[:, 1:] & active[:, :-1] & (vehicle[:, 1:] == vehicle[:, :-1])
        gone = np.hypot(np.diff(box[..., 0], axis=1), np.diff(box[..., 1], axis=1))
        error = np.abs(gone - (v[:, 1:] + v[:, :-1]) / 2 * CONFIG.dt)
        # in bends lanes differ in length: a lane change across the line is not quite continuous in the plane
        assert error[stays & (lane[:, 1:] == lane[:, :-1])].max() < 0.12 and error[stays].max() < 0.3
        turned = np.abs(np.angle(np.exp(1j * np.diff(box[..., 2], axis=1))))
        assert turned[stays].max() < 0.15
        assert not np.asarray(result.totals.collided).any() and not np.asarray(result.totals.off_road).any()


def test_traffic_is_the_same_with_the_area_driven_like_traffic():
    plain, with_area = runs()
    for name in ("distance", "entered"):
        one, two = (np.asarray(getattr(x.totals, name), float).sum() for x in (plain, with_area))
        assert two == pytest.approx(one, rel=0.02), name


def test_wrong_options_are_refused():
    with pytest.raises(ValueError, match="slots: 0; expected at least 1"):
        AreaOfInterest(FollowLane(), slots=0)
    with pytest.raises(ValueError, match="radius"):
        AreaOfInterest(FollowLane(), radius=0.0)
    with pytest.raises(ValueError, match=r"unknown policy 'pilot'; known are .*limsim_tm"):
        POLICIES["area_of_interest"]("pilot")
    with pytest.raises(ValueError, match="moves in the plane"):
        AreaOfInterest(LikeTraffic())
