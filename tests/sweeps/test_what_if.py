"""A world that was stopped goes on as if it had not been; futures are changed at will."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from limsim_jax.policies.simple import ConstantSpeed
from limsim_jax.simulation.checkpoint import fork
from limsim_jax.simulation.rollout import one_world
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.sweeps.experiment import EgoTable, ExperimentFile, TrafficTable
from limsim_jax.sweeps.what_if import stopped

pytestmark = pytest.mark.engine

SEED = 3


class Counting(ConstantSpeed):
    """Remembers its speed, and how often it was asked."""

    def init(self, config, lane_map, state):
        return super().init(config, lane_map, state), jnp.int32(0)

    def __call__(self, config, lane_map, state, memory, key):
        command, speed = super().__call__(config, lane_map, state, memory[0], key)
        return command, (speed, memory[1] + 1)


@pytest.fixture(scope="module")
def episodes():
    ego = EgoTable(start="1-", s=40.0, goal="3+")
    traffic = TrafficTable(vehicles=6)
    values = {"name": "small", "map": "roundabout", "horizon": 10.0, "slots": 8}
    found = Episodes(ExperimentFile(**values, ego=(ego,), traffic=traffic), chunk=1, policy=Counting())
    found.rollout = replace(found.rollout, measure=None)  # metrics take long to compile
    return found


@pytest.fixture(scope="module")
def now(episodes):
    return stopped(episodes, SEED, [0.0, 4.0, 2.6])


def test_a_stopped_world_goes_on_as_in_the_sweep(episodes, now):
    run, left = now.run, now.run.decisions - 8

    def whole(lane_map):
        return one_world(run, lane_map, episodes.sample, SEED)

    def rest(lane_map, schedule, carry):
        return run.advance(lane_map, schedule, now.key, carry, left)[0]

    wanted = jax.jit(whole)(now.lane_map).state
    futures = fork(jax.tree.map(lambda x: x[1], now.carry), 2)
    speed, count = futures.memory
    changed = futures._replace(memory=(speed * jnp.asarray([1.0, 0.2])[:, None], count))
    found = jax.jit(jax.vmap(rest, (None, None, 0)))(now.lane_map, now.schedule, changed).state
    for x, y in zip(jax.tree.leaves(wanted), jax.tree.leaves(found), strict=True):
        np.testing.assert_allclose(np.asarray(x, float), np.asarray(y[0], float), rtol=1e-4, atol=1e-3)
    ego = int(wanted.egos.slot[0])
    assert found.v[1, ego] < 0.5 * found.v[0, ego]  # the future in which it slowed down


def test_times_are_rounded_to_decisions(now):
    np.testing.assert_array_equal(now.carry.state.step, [0, 40, 25])  # 2.6 s is no decision, 2.5 s is


def test_policies_remember_and_totals_begin_anew(now):
    np.testing.assert_array_equal(now.carry.memory[1], [0, 8, 5])
    np.testing.assert_array_equal(now.carry.totals.distance, np.zeros(3))


def test_places_of_planned_vehicles_stay_as_many():
    options = {"slots": 3, "around": "follow_lane"}
    ego = EgoTable(start="1-", s=40.0, goal="3+", policy="area_of_interest", options=options)
    values = {"name": "small", "map": "roundabout", "horizon": 10.0, "slots": 8}
    episodes = Episodes(ExperimentFile(**values, ego=(ego,), traffic=TrafficTable(vehicles=6)), chunk=1)
    episodes.rollout = replace(episodes.rollout, measure=None)
    run, lane_map, schedule, key, carry = stopped(episodes, SEED, [1.0])
    assert carry.state.egos.slot.shape == (1, 4)
    shapes = jax.eval_shape(
        lambda lane_map: run.advance(lane_map, schedule, key, jax.tree.map(lambda x: x[0], carry), 1),
        lane_map,
    )
    assert shapes[1].state.egos.slot.shape == (4,)


@pytest.mark.parametrize(
    ("times", "message"), [([], "no times"), ([-1.0], "from -1"), ([4.0, 10.6], "within 0 and 10 s")]
)
def test_bad_times(episodes, times, message):
    with pytest.raises(ValueError, match=message):
        stopped(episodes, SEED, times)
