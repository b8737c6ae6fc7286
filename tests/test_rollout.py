"""Worlds through time: totals, batches, resuming, branching."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_worlds import bundled

from limsim_jax.maps.routing import default_goals
from limsim_jax.rollout import Rollout, Worlds, fork, load, save, trace, world_key
from limsim_jax.traffic.demand import Flow, build_demand, entries, sample_scenario
from limsim_jax.traffic.engine import Traffic
from limsim_jax.traffic.vehicles import default_population, fitting
from limsim_jax.types import Config

SLOTS = 24
RUN = Rollout(Config(dt=0.1), Traffic(), horizon=30.0)


@functools.cache
def sampler():
    """Scenarios on the bundled roundabout."""
    network, lane_map = bundled("roundabout")
    flows = [Flow(origin=name, rate=350.0) for name in entries(network)]
    population = fitting(default_population(), lane_map)
    demand = build_demand(
        network, lane_map, default_goals(network), flows, population, horizon=RUN.horizon, density=4.0
    )
    return lambda key: sample_scenario(demand, lane_map, key, SLOTS)


@functools.cache
def worlds():
    """Compiled once for this module: four worlds at a time."""
    return Worlds(RUN, bundled("roundabout")[1], sampler(), chunk=4, devices=jax.local_devices()[:1])


@functools.cache
def part():
    """A quarter of the run of one world."""
    lane_map = bundled("roundabout")[1]
    run = dataclasses.replace(RUN, record=trace)
    return jax.jit(lambda schedule, key, carry: run.go_on(lane_map, schedule, key, carry, 15))


def test_totals_add_up_and_nothing_goes_wrong():
    totals = worlds().run_totals(range(6))
    assert totals.entered.shape == (6,)
    ends = [result.state for _, result in worlds().chunks(range(6))]
    on_the_road = np.concatenate([state.active.sum(-1) for state in ends])
    np.testing.assert_array_equal(totals.entered - totals.left, on_the_road)
    assert (totals.left > 0).all() and (totals.distance > 0).all()
    for name in ("collided", "off_road", "wrong_way", "ran_red", "hard", "broken"):
        assert not getattr(totals, name).any(), name
    assert (totals.deceleration < 9).all()
    assert (totals.distance / totals.time < 25).all()


def test_a_world_is_the_same_in_any_company():
    alone = worlds().run_totals([3])
    among = worlds().run_totals([7, 1, 3, 5])
    for name, x in vars(alone).items():
        np.testing.assert_array_equal(np.asarray(x)[0], np.asarray(getattr(among, name))[2], err_msg=name)
    assert float(among.distance[0]) != float(among.distance[2]), "other seeds are other worlds"


def test_saved_and_resumed_ends_as_run_through(tmp_path):
    scenario = jax.jit(sampler())(world_key(1))
    key = jax.random.key(5)
    start = RUN.begin(bundled("roundabout")[1], scenario.start)
    _, carry = part()(scenario.schedule, key, start)
    save(tmp_path / "world.npz", carry)
    through, _ = part()(scenario.schedule, key, carry)
    resumed, _ = part()(scenario.schedule, key, load(tmp_path / "world.npz", start))
    for one, two in zip(jax.tree.leaves(through), jax.tree.leaves(resumed), strict=True):
        np.testing.assert_array_equal(one, two)
    assert int(through.state.step) == 150 and through.trace.time.shape == (75,)
    np.testing.assert_allclose(np.asarray(through.trace.time)[[0, -1]], [7.6, 15.0], rtol=1e-5)
    assert list(tmp_path.iterdir()) == [tmp_path / "world.npz"], "no half-written file is left"
    other = jax.tree.map(lambda x: jnp.zeros((3, *jnp.shape(x)), jnp.result_type(x)), start)
    with pytest.raises(ValueError, match=r"world\.npz: .* is .*, not"):
        load(tmp_path / "world.npz", other)


def test_branches_of_a_world_begin_alike():
    scenario = jax.jit(sampler())(world_key(2))
    branches = fork(scenario.start, 3)
    for x, y in zip(jax.tree.leaves(branches), jax.tree.leaves(scenario.start), strict=True):
        assert x.shape == (3, *y.shape)
        np.testing.assert_array_equal(x[2], y)


def test_bad_input_is_named():
    with pytest.raises(ValueError, match="horizon of 0"):
        Rollout(Config(dt=0.1), Traffic(), horizon=0)
    with pytest.raises(ValueError, match="no seeds"):
        next(worlds().chunks([]))
    with pytest.raises(ValueError, match="seeds from -1"):
        next(worlds().chunks([-1]))
    with pytest.raises(ValueError, match="chunk of 0"):
        Worlds(RUN, bundled("roundabout")[1], sampler(), chunk=0)
