"""A world that was stopped goes on as if it had not been; futures are changed at will."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from limsim_jax.policies.base import LikeTraffic
from limsim_jax.policies.simple import ConstantSpeed
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.sweeps.experiment import EgoTable, ExperimentFile, TrafficTable
from limsim_jax.sweeps.what_if import futures, stopped

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
    return Episodes(ExperimentFile(**values, ego=(ego,), traffic=traffic), chunk=3, policy=Counting())


@pytest.fixture(scope="module")
def now(episodes):
    return stopped(episodes, SEED, [0.0, 4.0, 2.6])


def rows(worlds, which):
    return jax.tree.map(lambda x: x[jnp.asarray(which)], worlds)


def test_a_stopped_world_goes_on_as_in_the_sweep(episodes, now):
    both = rows(now[0], [1, 1])
    seen = both.carry.memory.policy  # with what the view remembers
    speed, count = seen.policy
    memory = both.carry.memory._replace(policy=seen._replace(policy=(speed.at[1].mul(0.2), count)))
    both = both._replace(carry=both.carry._replace(memory=memory))
    found = futures(episodes, both, 12, same=True)
    whole = episodes.replay(SEED)
    np.testing.assert_array_equal(found.trace.box[0], whole.trace.box[40:])  # to the last bit
    np.testing.assert_array_equal(found.trace.time[0], whole.trace.time[40:])
    ego = whole.ego
    assert found.trace.v[1, -1, ego] < 0.5 * found.trace.v[0, -1, ego]  # the future in which it slowed down


def test_times_are_rounded_to_decisions(now):
    worlds, decisions = now
    assert decisions == [0, 8, 5]  # 2.6 s is no decision, 2.5 s is
    np.testing.assert_array_equal(worlds.carry.state.step, [0, 40, 25])


def test_policies_remember_and_totals_begin_anew(episodes, now):
    worlds, _ = now
    np.testing.assert_array_equal(worlds.carry.memory.policy.policy[1], [0, 8, 5])
    found = futures(episodes, worlds, 2, same=True)
    assert 0 < found.totals.time.max() <= 8.01  # s, of 8 vehicles in 1 s


def check_that_nothing_jumps(found, start):
    ego = found.state.egos.slot[0, 0]
    first = np.asarray(found.trace.box[0, 0, ego, :2])
    there = np.asarray([start.carry.state.egos.x[0, 0], start.carry.state.egos.y[0, 0]])
    np.testing.assert_allclose(first, there, atol=1.6)  # m, within 0.1 s at 15 m/s
    assert np.abs(np.diff(found.trace.box[0, :, ego, :2], axis=0)).max() < 1.6


def test_a_policy_gives_the_wheel_back(episodes, now):
    worlds = rows(now[0], [1])
    meek = futures(episodes.under(LikeTraffic()), worlds, 8, same=False)
    assert meek.trace.plan is None and not bool(meek.state.egos.free[0, 0])
    check_that_nothing_jumps(meek, worlds)


@pytest.mark.slow
def test_another_policy_takes_the_wheel(episodes):
    traffic = Episodes(episodes.experiment, chunk=1, policy=LikeTraffic())
    before, _ = stopped(traffic, SEED, [4.0])
    assert not bool(before.carry.state.egos.free[0, 0])
    fast = futures(traffic.under(ConstantSpeed(speed=15.0)), before, 8, same=False)
    ego = fast.state.egos.slot[0, 0]
    assert bool(fast.state.egos.free[0, 0]) and abs(fast.trace.v[0, -1, ego] - 15.0) < 0.1
    check_that_nothing_jumps(fast, before)


@pytest.mark.slow
def test_places_of_planned_vehicles_stay_as_many():
    options = {"slots": 3, "around": "follow_lane"}
    ego = EgoTable(start="1-", s=40.0, goal="3+", policy="area_of_interest", options=options)
    values = {"name": "small", "map": "roundabout", "horizon": 10.0, "slots": 8}
    episodes = Episodes(ExperimentFile(**values, ego=(ego,), traffic=TrafficTable(vehicles=6)), chunk=1)
    worlds, _ = stopped(episodes, SEED, [1.0])
    assert worlds.carry.state.egos.slot.shape == (1, 4)
    assert futures(episodes, worlds, 1, same=True).state.egos.slot.shape == (1, 4)
    alone = futures(episodes.under(LikeTraffic()), worlds, 1, same=False).state.egos
    assert alone.slot.shape == (1, 1) and alone.slot[0, 0] == worlds.carry.state.egos.slot[0, 0]


@pytest.mark.parametrize(
    ("times", "message"), [([], "no times"), ([-1.0], "from -1"), ([4.0, 10.6], "within 0 and 10 s")]
)
def test_bad_times(episodes, times, message):
    with pytest.raises(ValueError, match=message):
        stopped(episodes, SEED, times)
