"""Several policies in one world: commands as one, and rows of results by ego."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fake_results import made
from traffic_worlds import bundled, scattered

from limsim_jax.policies.area import AreaOfInterest
from limsim_jax.policies.base import LikeTraffic, policy_name, views
from limsim_jax.policies.pdm import PDMClosed
from limsim_jax.policies.several import Several, joined
from limsim_jax.policies.simple import ConstantSpeed
from limsim_jax.policies.view import View
from limsim_jax.report.tables import groups, knows, provenance_of
from limsim_jax.traffic.command import Command, without_broken
from limsim_jax.traffic.ego import Control, Trajectory, from_lane
from limsim_jax.traffic.engine import Traffic, drive
from limsim_jax.traffic.motion import boxes
from limsim_jax.types import Config, Status

CONFIG = Config(dt=0.1)


def straight(rows, samples, dt, v):
    """Trajectories along x from 10 m per row on."""
    x = 10.0 * jnp.arange(1.0, rows + 1)[:, None] + v * dt * jnp.arange(float(samples))[None]
    zero = jnp.zeros_like(x)
    return Trajectory(x=x, y=zero, heading=zero, v=zero + v, t0=jnp.float32(2.0), dt=dt)


def test_rows_of_all_commands_come_in_order():
    first = Command(trajectory=straight(2, 9, 0.5, 8.0))
    second = Command(meta=jnp.array([3]))
    third = Command(trajectory=straight(1, 5, 0.25, 4.0), signal=jnp.array([-1]))
    fourth = Command(control=Control(acceleration=jnp.array([1.5, 2.5]), steering=jnp.array([0.1, 0.2])))
    command = joined([(first, 2), (second, 1), (third, 1), (fourth, 2)])
    found = command.trajectory
    assert found is not None and found.dt == 0.25 and found.x.shape == (6, 5)
    time = 0.25 * np.arange(5)
    np.testing.assert_allclose(found.x[0], 10 + 8 * time, rtol=1e-6)
    np.testing.assert_allclose(found.x[1], 20 + 8 * time, rtol=1e-6)
    np.testing.assert_allclose(found.x[3], 10 + 4 * time, rtol=1e-6)
    np.testing.assert_array_equal(command.meta, [-1, -1, 3, -1, -1, -1])
    np.testing.assert_array_equal(command.signal, [0, 0, 0, -1, 0, 0])
    assert command.control is not None
    np.testing.assert_allclose(command.control.acceleration, [0, 0, 0, 0, 1.5, 2.5])
    np.testing.assert_array_equal(command.by_control, [False] * 4 + [True] * 2)


def test_commands_of_one_kind_need_no_others():
    command = joined([(Command(), 1), (Command(meta=jnp.array([2])), 1)])
    assert command.trajectory is None and command.control is None and command.by_control is None
    np.testing.assert_array_equal(command.meta, [-1, 2])
    brakes = [Command(brake=jnp.array([True, False])), Command(brake=jnp.array([False, False])), Command()]
    np.testing.assert_array_equal(joined([(x, 1) for x in brakes]).brake, [True, False])


def world():
    """Three egos among eight vehicles; the second keeps to lanes."""
    state = scattered("highway", 8, seed=3)
    lane_map = bundled("highway")[1]
    free = jnp.array([True, False, True])
    return lane_map, dataclasses.replace(
        state, egos=from_lane(lane_map, state, boxes(lane_map, state), range(3), free)
    )


def test_each_policy_decides_as_if_it_were_alone():
    lane_map, state = world()
    policies = ConstantSpeed(12.0), LikeTraffic(), ConstantSpeed(7.0)
    both = Several(policies)
    assert both.frees == (True, False, True) and both.free
    memory = both.init(CONFIG, lane_map, state)
    command, after = both(CONFIG, lane_map, state, memory, jax.random.key(0))
    assert jax.tree.structure(after) == jax.tree.structure(memory)
    assert command.control is not None and command.trajectory is None
    for k in (0, 2):
        alone = dataclasses.replace(state, egos=jax.tree.map(lambda x: x[k : k + 1], state.egos))  # noqa: B023
        mine, _ = policies[k](
            CONFIG, lane_map, alone, policies[k].init(CONFIG, lane_map, alone), jax.random.key(0)
        )
        assert mine.control is not None
        np.testing.assert_allclose(
            command.control.steering[k], mine.control.steering[0], rtol=1e-5, atol=1e-6
        )
        np.testing.assert_allclose(command.control.acceleration[k], mine.control.acceleration[0], rtol=1e-5)


@pytest.mark.engine
def test_trajectories_and_controls_drive_side_by_side():
    lane_map, state = world()
    here, there = (state.v[state.egos.slot[k]] for k in (0, 2))
    x, y, heading = (value[:1, None] for value in (state.egos.x, state.egos.y, state.egos.heading))
    s = here * 0.2 * jnp.arange(16.0)[None]
    way = Trajectory(
        x=x + s * jnp.cos(heading), y=y + s * jnp.sin(heading),
        heading=jnp.zeros_like(s) + heading, v=jnp.zeros_like(s) + here, t0=jnp.float32(0), dt=0.2,
    )  # fmt: skip
    holds = Control(acceleration=jnp.array([-2.0]), steering=jnp.array([0.0]))
    command = joined([(Command(trajectory=way), 1), (Command(), 1), (Command(control=holds), 1)])
    after, _ = jax.jit(lambda state: drive(CONFIG, Traffic(), lane_map, state, command=command))(state)
    slow, fast = after.v[state.egos.slot[2]], after.v[state.egos.slot[0]]
    assert fast == pytest.approx(float(here), abs=0.3)
    assert slow == pytest.approx(float(there) - 0.4, abs=0.35) and slow < there - 0.2


def test_a_broken_row_is_that_of_its_own_command():
    _, state = world()
    way, still = (
        straight(1, 4, 0.2, 3.0),
        Control(acceleration=jnp.array([0.0]), steering=jnp.array([jnp.nan])),
    )
    parts = [(Command(trajectory=way), 1), (Command(), 1), (Command(control=still), 1)]
    after, _, broken = without_broken(state, joined(parts))
    np.testing.assert_array_equal(broken, [False, False, True])
    assert int(after.status[state.egos.slot[2]]) == int(Status.NOT_FINITE)
    parts[0] = (Command(trajectory=dataclasses.replace(way, x=way.x * jnp.nan)), 1)
    parts[2] = (Command(control=dataclasses.replace(still, steering=jnp.zeros(1))), 1)
    np.testing.assert_array_equal(without_broken(state, joined(parts))[2], [True, False, False])


def test_planners_that_drive_others_stand_alone():
    with pytest.raises(ValueError, match="area_of_interest drives other vehicles, too"):
        Several((LikeTraffic(), AreaOfInterest()))
    with pytest.raises(ValueError, match="policies: none; expected one per ego"):
        Several(())


def test_names_and_views_are_those_of_the_policies():
    both = Several((PDMClosed(view=View(range=80.0)), LikeTraffic()))
    assert both.names == ("pdm_closed", "like_traffic") and policy_name(both) == "several"
    assert [view.range for view in views(both)] == [80.0]
    assert both.knows == "view and state"


def test_results_of_egos_with_their_own_policies_are_told_apart():
    group = ("highway", "a-and-b")
    about = {"policies": ["a", "b"], "each_knows": ["view", "state"], "knows": "view and state", "chunk": 4}
    results = made(
        {group: {"seed": [0, 0, 1, 1], "ego": [0, 1, 0, 1], "success": [1, 0, 1, 0]}},
        provenance={group: about},
    )
    found = groups(results)
    assert list(found) == [("highway", "a (ego 0)"), ("highway", "b (ego 1)")]
    assert [part["success"].to_pylist() for part in found.values()] == [[1.0, 1.0], [0.0, 0.0]]
    assert [knows(results, one) for one in found] == ["what it sees", "all"]
    assert provenance_of(results, ("highway", "b (ego 1)"))["chunk"] == 4
    assert provenance_of(results, ("highway", "c (ego 1)")) == {}
