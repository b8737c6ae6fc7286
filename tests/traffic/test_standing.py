"""Vehicles that stand for good are passed; those that wait are not."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_worlds import bundled, motorway, state_of

from limsim_jax.traffic.engine import Traffic, drive
from limsim_jax.traffic.motion import boxes
from limsim_jax.traffic.neighbors import Pair
from limsim_jax.traffic.parameters import LANE_CHANGES
from limsim_jax.traffic.standing import for_good, obstructed
from limsim_jax.types import Config, Status

pytestmark = pytest.mark.engine

CONFIG = Config(dt=0.1)
PLACE = 300.0  # m, front of the vehicle that stands


@pytest.fixture(scope="module")
def run():
    _, lane_map = bundled("highway")

    @jax.jit
    def run(state):
        def record(tick):
            return tick.state.s, tick.state.lane, boxes(lane_map, tick.state), tick.state.side

        def decision(state, _):
            return drive(CONFIG, Traffic(), lane_map, state, record=record)

        return jax.lax.scan(decision, state, None, length=120)

    return run


def world(s, v, crashed):
    """A vehicle that stands on the motorway, and others behind it."""
    lane, goal = motorway()
    n = len(s)
    state = state_of("highway", [lane] * n, s, v, [goal] * n)
    last = jnp.arange(n) == n - 1
    driver = dataclasses.replace(
        state.driver,
        v_max=jnp.where(last, 0.0, state.driver.v_max),
        threshold=jnp.where(last, 1000.0, state.driver.threshold),
        politeness=jnp.where(last, 0.0, state.driver.politeness),
    )
    status = jnp.where(last & crashed, int(Status.COLLIDED), 0)
    return dataclasses.replace(state, driver=driver, status=status), lane


@pytest.mark.parametrize("crashed", [False, True])
def test_a_queue_gets_past_a_vehicle_that_stands_for_good(run, crashed):
    """The first has stopped as near as in a queue, and two more stand behind it; one comes at speed."""
    s = [PLACE - 150.0, PLACE - 20.0, PLACE - 13.5, PLACE - 7.0, PLACE]
    state, lane = world(s, [20.0, 0.0, 0.0, 0.0, 0.0], crashed)
    end, (at, lanes, box, _) = run(state)
    at, lanes, box = (np.asarray(x).reshape(-1, *x.shape[2:]) for x in (at, lanes, box))
    gone = (at[-1, :-1] > PLACE + 50) | (lanes[-1, :-1] != lane) | ~np.asarray(end.active)[:-1]
    assert gone.all(), "within a minute"
    assert at[-1, -1] == PLACE and (lanes[:, -1] == lane).all(), "it stands where it stood"
    middle = np.hypot(*(box[:, :-1, :2] - box[:, -1:, :2]).transpose(2, 0, 1))
    assert middle.min() > 1.8, "none drives through it"
    assert not (np.asarray(end.status)[:-1] & int(Status.COLLIDED)).any()


def test_only_a_vehicle_without_a_reason_stands_for_good():
    """In a queue, at a line, yielding, on the wrong lane or a moment ago it waits."""
    _, lane_map = bundled("intersection")
    lane = int(np.argmax((np.asarray(lane_map.stop_s) > 60) & ~np.asarray(lane_map.is_connector)))
    to_go = np.asarray(lane_map.routes.lanes_to_go)[lane]
    goal = int(np.argmax((to_go == 0) & np.asarray(lane_map.routes.reachable)[lane]))
    line = float(lane_map.stop_s[lane])
    n = 8
    state = state_of("intersection", [lane] * n, [30.0] * n, [0.0] * n, [goal] * n)
    names = ["free", "queue", "line", "yields", "short", "rolls", "changes", "crashed"]
    put = lambda x, name, value: x.at[names.index(name)].set(value)  # noqa: E731
    waiting = put(jnp.full(n, 9.0), "short", 5.0)
    state = dataclasses.replace(
        state, s=put(state.s, "line", line - 10), yielding=put(state.yielding, "yields", True),
        waiting=put(waiting, "crashed", 0.0), v=put(state.v, "rolls", 0.5),
        side=put(state.side, "changes", 1), status=put(state.status, "crashed", int(Status.COLLIDED)),
    )  # fmt: skip
    lead = put(jnp.full(n, -1), "queue", 0)
    own = Pair(lead, put(jnp.full(n, 1e6), "queue", 3.0), jnp.full(n, -1), jnp.full(n, 1e6))
    found = dict(zip(names, np.asarray(for_good(lane_map, state, own)), strict=True))
    assert [name for name, stands in found.items() if stands] == ["free", "crashed"]


def test_vehicles_behind_one_that_stands_for_good_leave_room_to_pull_out():
    """Also the next in the queue, which would otherwise follow a vehicle that pulls out too far."""
    state, _ = world([PLACE - 80.0, PLACE - 40.0, PLACE], [10.0, 8.0, 0.0], crashed=True)
    _, lane_map = bundled("highway")
    length = state.shape.length
    gap = jnp.array([40.0, 40.0, 1e6]) - jnp.array([length[1], length[2], 0])
    nothing = jnp.full(3, -1)
    found = obstructed(lane_map, state, Pair(jnp.array([1, 2, -1]), gap, nothing, jnp.full(3, 1e6)))
    np.testing.assert_array_equal(found.stands, [False, False, True])
    np.testing.assert_array_equal(found.behind, [True, True, False])
    way = np.maximum(LANE_CHANGES.least_way, LANE_CHANGES.long_way * np.asarray(length))
    room = np.array([80.0, 40.0]) - float(length[2])
    np.testing.assert_allclose(found.stop[:2], room - way[:2], rtol=1e-5)
    assert float(found.stop[2]) > 1e5


def test_a_vehicle_does_not_pull_out_just_in_front_of_one_that_rolls(run):
    """The other sees it a decision later, and would be in it by then."""
    _, lane_map = bundled("highway")
    rear = PLACE - 20.0 - 5.0
    state, lane = world([rear - 0.9, PLACE - 20.0, PLACE], [2.2, 0.0, 0.0], crashed=True)
    beside = lane_map.left[lane] if int(lane_map.left[lane]) >= 0 else lane_map.right[lane]
    state = dataclasses.replace(
        state, lane=state.lane.at[0].set(beside), waiting=state.waiting.at[1].set(30.0),
        shape=dataclasses.replace(state.shape, length=jnp.full(3, 5.0)),
    )  # fmt: skip
    end, (_, _, _, side) = run(state)
    assert not (np.asarray(end.status)[:-1] & int(Status.COLLIDED)).any()
    begins = np.flatnonzero((np.asarray(side)[..., 1] != 0).any(-1))
    assert begins.size and begins[0] > 2, "it pulls out later"
