"""Neighbours against a loop over all vehicles in plain Python."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import network, straight
from traffic_worlds import bundled, scattered, shapes, state_of

from limsim_jax.maps.lane_map import NO_LANE, lane_rows
from limsim_jax.maps.rasterise import build_lane_map
from limsim_jax.traffic.car_following import NO_GAP
from limsim_jax.traffic.neighbors import (
    lanes_ahead,
    look_ahead,
    neighbors,
    other_lane,
    place_of,
    sort_vehicles,
)
from limsim_jax.types import Config

pytestmark = pytest.mark.engine

CONFIG = Config(dt=0.1)


def by_loop(lane_map, state, shape, lane, s, config=CONFIG, *, far=False):
    """Leader and follower of each vehicle at (lane, s): every pair is looked at.

    `far`: followers may also come over more than one lane.
    """
    length = np.asarray(lane_map.length)
    after = np.asarray(lane_map.successors)
    next_lane, before = np.asarray(lane_map.routes.next_lane), np.asarray(lane_map.predecessors)
    other, other_s = (np.asarray(x) for x in other_lane(lane_map, state))
    entries = []
    for j in range(len(lane)):
        if state.active[j]:
            entries.append((j, int(state.lane[j]), float(state.s[j])))
            if other[j] != NO_LANE:
                entries.append((j, int(other[j]), float(other_s[j])))
    result = []
    for i in range(len(lane)):
        lead, lead_gap, lag, lag_gap = -1, NO_GAP, -1, NO_GAP
        if lane[i] != NO_LANE:
            here, start = int(lane[i]), -float(s[i])
            for depth in range(config.look_ahead_lanes + 1):
                if here == NO_LANE:
                    break
                found = [
                    (start + at, j) for j, on, at in entries if on == here and j != i and (depth or at > s[i])
                ]
                if found:
                    distance, j = min(found)
                    gap = distance - float(shape.length[j])
                    if gap < config.look_ahead:
                        lead, lead_gap = j, gap
                    break
                start += length[here]
                following = int(next_lane[here, int(state.goal[i])])
                here = following if following != NO_LANE else int(after[here, 0])  # tails stand there, too
            found = [(s[i] - at, j) for j, on, at in entries if on == lane[i] and j != i and at <= s[i]]
            if not found:  # the first one on each of two lanes before, the nearer of them
                for b in before[lane[i]][:2]:
                    queue = [(at, j) for j, on, at in entries if on == b and b != NO_LANE]
                    if queue and max(queue)[1] != i:
                        found.append((s[i] + length[b] - max(queue)[0], max(queue)[1]))
                queue = []
                for j in np.nonzero(np.asarray(state.active))[0] if far else ():
                    here, way = int(state.lane[j]), -float(state.s[j])
                    for depth in range(lanes_ahead(config, lane_map) + 1):
                        if depth > 1 and here == lane[i] and way < config.look_ahead:
                            queue.append((way, j))
                        if here == NO_LANE:
                            break
                        way += length[here]
                        here = int(next_lane[here, int(state.goal[j])])
                if queue and min(queue)[1] != i:
                    found.append((s[i] + min(queue)[0], min(queue)[1]))
            if found:
                distance, lag = min(found)
                lag_gap = distance - float(shape.length[i])
        result.append((lead, lead_gap, lag, lag_gap))
    return [np.array(column) for column in zip(*result, strict=True)]


@pytest.mark.parametrize(
    ("name", "n"), [("highway", 60), ("ramp", 80), ("roundabout", 40), ("intersection", 60)]
)
@pytest.mark.parametrize(("seed", "far"), [(0, True), (1, False)])
def test_neighbors_are_those_of_the_loop(name, n, seed, far):
    _, lane_map = bundled(name)
    state = scattered(name, n, seed)
    rng = np.random.default_rng(seed)
    # unequal lengths, some slots empty, some vehicles in the midst of a lane change
    shape = dataclasses.replace(shapes(n), length=jnp.asarray(rng.uniform(3, 9, n), jnp.float32))
    side = rng.integers(-1, 2, n)
    state = dataclasses.replace(
        state,
        shape=shape,
        active=jnp.asarray(rng.random(n) < 0.9),
        side=jnp.asarray(side, jnp.int32),
        crossed=jnp.asarray(rng.random(n) < 0.5) & (jnp.asarray(side) != 0),
    )
    left = np.asarray(lane_map.left)[np.asarray(state.lane)]
    lane = np.stack([np.where(state.active, state.lane, NO_LANE), left], -1)
    s = np.stack([state.s, state.s], -1)

    @jax.jit
    def query(state, lane, s):
        order = sort_vehicles(lane_map, state)
        here = place_of(order, lane_map, lane, s)
        ahead = look_ahead(CONFIG, lane_map, state) if far else None
        return neighbors(CONFIG, lane_map, order, state, lane, s, here, ahead)

    pair = query(state, jnp.asarray(lane), jnp.asarray(s))
    found_any = 0
    for k in range(2):
        lead, lead_gap, lag, lag_gap = by_loop(
            lane_map, state, shape, lane[:, k], np.asarray(s[:, k]), far=far
        )
        np.testing.assert_array_equal(np.asarray(pair.lead[:, k]), lead)
        np.testing.assert_allclose(np.asarray(pair.lead_gap[:, k]), lead_gap, atol=5e-3)
        np.testing.assert_array_equal(np.asarray(pair.lag[:, k]), lag)
        np.testing.assert_allclose(np.asarray(pair.lag_gap[:, k]), lag_gap, atol=5e-3)
        found_any += (lead >= 0).sum() + (lag >= 0).sum()
    assert found_any > n  # the comparison is about something


def test_a_follower_two_lanes_back_is_seen():
    """Over a short lane, as in SUMO's junctions; a vehicle that turns off does not count."""
    map_ = network([
        straight("a", (0.0, 0.0), 0.0, 200.0, successors=("b", "off")),
        straight("b", (200.0, 0.0), 0.0, 4.0, successors=("c",)),
        straight("off", (200.0, 0.0), -0.3, 4.0),
        straight("c", (204.0, 0.0), 0.0, 100.0),
    ])  # fmt: skip
    rows, lane_map = lane_rows(map_), build_lane_map(map_, goals=[["c"], ["off"]])
    lane, s = [rows["c"], rows["a"], rows["a"]], [30.0, 150.0, 170.0]
    state = state_of("ramp", lane, s, [10.0] * 3, [0, 0, 1])
    order = sort_vehicles(lane_map, state)
    here = order.rank[:3] + 1
    query = state.lane[:, None], state.s[:, None], here[:, None]
    pair = neighbors(CONFIG, lane_map, order, state, *query, look_ahead(CONFIG, lane_map, state))
    length = float(state.shape.length[0])
    assert int(pair.lag[0, 0]) == 1
    np.testing.assert_allclose(float(pair.lag_gap[0, 0]), 30 + 4 + 50 - length, atol=1e-2)
    assert int(neighbors(CONFIG, lane_map, order, state, *query).lag[0, 0]) == -1, "without their ways"


def test_no_vehicle_sees_empty_slots_or_itself():
    _, lane_map = bundled("highway")
    goal = int(np.nonzero(np.asarray(lane_map.routes.reachable)[0])[0][0])
    state = state_of(
        "highway", [0, 0, 0], [100.0, 130.0, 160.0], [10.0] * 3, [goal] * 3, active=[True, False, True]
    )
    order = sort_vehicles(lane_map, state)
    here = (order.rank[:3] + 1)[:, None]
    pair = neighbors(CONFIG, lane_map, order, state, state.lane[:, None], state.s[:, None], here)
    assert pair.lead[:, 0].tolist()[::2] == [2, -1]
    assert pair.lag[:, 0].tolist()[::2] == [-1, 0]
    assert float(pair.lead_gap[0, 0]) == 55.0 and float(pair.lag_gap[2, 0]) == 55.0
