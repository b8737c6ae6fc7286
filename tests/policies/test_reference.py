"""Reference paths: against a walk along the lanes, and the engine's own motion."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_worlds import bundled, scattered

from limsim_jax.maps.lane_map import NO_LANE, pose, side_s, width
from limsim_jax.policies.reference import (
    ReferencePath,
    beside,
    motion_on,
    path_from,
    to_cartesian,
)
from limsim_jax.traffic.bodies import body_place
from limsim_jax.traffic.ego import from_lane
from limsim_jax.traffic.motion import advance, boxes
from limsim_jax.types import Config

pytestmark = pytest.mark.engine

N, POINTS, STEP = 12, 60, 2.0


def walk(lane_map, lane, s, goal, after=NO_LANE):
    """Lane and arc length of every point, and where the route ends, by a loop."""
    length, following = np.asarray(lane_map.length), np.asarray(lane_map.routes.next_lane)
    begin, places, end = -s, [], None
    for k in range(POINTS):
        at = k * STEP
        while at - begin >= length[lane] and end is None:
            beyond = int(following[lane, goal]) if after == NO_LANE else after
            after = NO_LANE
            if beyond == NO_LANE:
                end = begin + length[lane]
            else:
                begin, lane = begin + length[lane], beyond
        places.append((lane, at - begin))
    return places, end


def ways(name, seed, **more):
    state, lane_map = scattered(name, N, seed), bundled(name)[1]
    slot = jnp.arange(N)
    lane, s = body_place(lane_map, state, slot)
    path = jax.jit(lambda: path_from(lane_map, lane, s, state.goal, points=POINTS, step=STEP, **more))()
    return lane_map, state, lane, s, path


def test_points_are_those_of_a_walk_along_the_lanes():
    for name in ("roundabout", "intersection"):
        lane_map, state, lane, s, path = ways(name, 5)
        ends = 0
        for i in range(N):
            places, end = walk(lane_map, int(lane[i]), float(s[i]), int(state.goal[i]))
            rows, at = jnp.array([row for row, _ in places]), jnp.array([at for _, at in places])
            x, y, heading = pose(lane_map, rows, at)
            np.testing.assert_array_equal(path.lane[i], rows)
            np.testing.assert_allclose(path.x[i], x, atol=1e-3)
            np.testing.assert_allclose(path.y[i], y, atol=1e-3)
            turned = np.remainder(np.asarray(path.heading[i] - heading) + np.pi, 2 * np.pi) - np.pi
            np.testing.assert_allclose(turned, 0, atol=1e-4)
            if end is not None and end < path.reach:
                ends += 1
                np.testing.assert_allclose(path.end[i], end, atol=1e-3)
            half = np.asarray(width(lane_map, rows, at)) / 2
            for side, edge, neighbour in ((1, path.left, lane_map.left), (-1, path.right, lane_map.right)):
                other = neighbour[rows]
                level = side_s(lane_map, rows, at, jnp.full_like(rows, side))
                more = np.where(other == NO_LANE, 0, width(lane_map, other, level))
                np.testing.assert_allclose(edge[i], half + more, atol=1e-4)
        assert np.abs(np.diff(path.heading, axis=1)).max() < 1.0, "no jumps of a whole turn"
        assert ends > 0


def test_a_known_next_lane_counts():
    """The body is on a lane from which the route would go elsewhere than where the front already is."""
    lane_map = bundled("roundabout")[1]
    successors, routes = np.asarray(lane_map.successors), lane_map.routes
    lane, goal = next(
        (row, goal)
        for row in range(len(successors)) for goal in range(routes.next_lane.shape[1])
        if (successors[row] >= 0).sum() > 1 and int(routes.next_lane[row, goal]) >= 0
    )  # fmt: skip
    other = next(int(k) for k in successors[lane] if k >= 0 and k != int(routes.next_lane[lane, goal]))
    place = jnp.array([lane]), lane_map.length[lane][None] - 3.0, jnp.array([goal])
    by_route = path_from(lane_map, *place, points=POINTS, step=STEP)
    known = path_from(lane_map, *place, points=POINTS, step=STEP, after=jnp.array([other]))
    assert int(by_route.lane[0, 2]) == int(routes.next_lane[lane, goal])
    places, _ = walk(lane_map, lane, float(place[1][0]), goal, other)
    np.testing.assert_array_equal(known.lane[0], [row for row, _ in places])


def test_places_lie_on_the_lanes():
    lane_map, state, lane, s, path = ways("roundabout", 5)
    at = jnp.broadcast_to(STEP * jnp.arange(POINTS - 1.0) + 0.7, (N, POINTS - 1))
    d = jnp.linspace(-1.5, 2.0, N)[:, None]
    found = jax.jit(to_cartesian)(path, at, d)
    for i in range(N):
        places, end = walk(lane_map, int(lane[i]), float(s[i]), int(state.goal[i]))
        rows = np.array([row for row, _ in places])
        inner = rows[:-1] == rows[1:]  # intervals within one lane
        inner &= STEP * np.arange(1, POINTS) < (1e9 if end is None else end)
        here = jnp.array([there for _, there in places[:-1]]) + 0.7
        x, y, heading = pose(lane_map, jnp.asarray(rows[:-1]), here, jnp.broadcast_to(d[i], here.shape))
        off = np.hypot(found.x[i] - x, found.y[i] - y)
        turned = np.remainder(np.asarray(found.heading[i] - heading) + np.pi, 2 * np.pi) - np.pi
        assert off[inner].max() < 0.05 and np.abs(turned[inner]).max() < 0.05
    ends = to_cartesian(path, jnp.array([[-5.0, 0.0, path.reach, path.reach + 7.0]] * N), jnp.zeros((N, 1)))
    for k, apart in ((1, 5.0), (3, 7.0)):
        np.testing.assert_allclose(
            np.hypot(ends.x[:, k] - ends.x[:, k - 1], ends.y[:, k] - ends.y[:, k - 1]), apart, atol=1e-3
        )
    assert (np.asarray(ends.curvature)[:, [0, 3]] == 0).all(), "straight before and beyond"


def test_beside_and_back():
    lane_map, _, lane, s, _ = ways("highway", 2)
    d = jnp.linspace(-1.0, 1.0, N)
    side = jnp.where(lane_map.left[lane] != NO_LANE, 1, -1)
    there, there_s, there_d, exists = beside(lane_map, lane, s, d, side)
    assert bool(exists.all()) and (np.asarray(there) != np.asarray(lane)).all()
    x, y, _ = pose(lane_map, lane, s, d)
    x2, y2, _ = pose(lane_map, there, there_s, there_d)
    np.testing.assert_allclose(np.hypot(x - x2, y - y2), 0, atol=0.05)
    back = beside(lane_map, there, there_s, there_d, -side)
    np.testing.assert_array_equal(back[0], lane)
    np.testing.assert_allclose(back[2], d, atol=1e-3)
    stays = beside(lane_map, lane, s, d, jnp.zeros_like(side))
    np.testing.assert_array_equal(stays[0], lane)
    assert not bool(stays[3].any())


def test_motion_across_is_that_of_the_lane_change():
    lane_map, state, _, _, _ = ways("highway", 2)
    left = np.asarray(lane_map.left)[np.asarray(state.lane)] >= 0
    side = jnp.asarray(np.where(left, 1, -1), jnp.int32)
    other = jnp.where(side > 0, lane_map.left[state.lane], lane_map.right[state.lane])
    between = (width(lane_map, state.lane, state.s) + width(lane_map, other, state.s)) / 2
    state = dataclasses.replace(
        state, side=side, shift=-side.astype(jnp.float32) * between, progress=jnp.linspace(0.05, 0.3, N),
        v=jnp.linspace(8.0, 25.0, N),
    )  # fmt: skip
    tick = Config(dt=0.01)
    zero = jnp.zeros(N)
    first, _, _ = advance(tick, lane_map, state, zero)
    second, dx, _ = advance(tick, lane_map, first, zero)
    slot = jnp.arange(N)
    lane, s = body_place(lane_map, first, slot)
    path = path_from(lane_map, lane, s, first.goal, points=POINTS, step=STEP)
    found = motion_on(path, first, slot, first.d)
    np.testing.assert_allclose(found.d_v, (second.d - first.d) / tick.dt, atol=0.06)
    np.testing.assert_allclose(found.slope, (second.d - first.d) / dx, atol=5e-3)
    np.testing.assert_allclose(found.v, first.v, rtol=0.02)


def test_motion_of_free_egos_is_that_of_their_heading():
    lane_map, state, _, _, _ = ways("highway", 2)
    state = dataclasses.replace(state, v=jnp.linspace(8.0, 25.0, N))
    egos = from_lane(lane_map, state, boxes(lane_map, state), [3, 7], True)
    egos = dataclasses.replace(egos, heading=egos.heading + jnp.array([0.1, -0.05]), steering=jnp.zeros(2))
    state = dataclasses.replace(state, egos=egos)
    slot = jnp.array([7, 3, 0])
    lane, s = body_place(lane_map, state, slot)
    path = path_from(lane_map, lane, s, state.goal[slot], points=POINTS, step=STEP)
    found = motion_on(path, state, slot, jnp.zeros(3))
    v = np.asarray(state.v)[[7, 3, 0]]
    np.testing.assert_allclose(found.slope, [np.tan(-0.05), np.tan(0.1), 0], atol=2e-3)
    np.testing.assert_allclose(found.d_v, v * np.sin([-0.05, 0.1, 0]), atol=0.05)
    np.testing.assert_allclose(found.v, v * np.cos([-0.05, 0.1, 0]), rtol=2e-3)


def test_no_lane_gives_a_path_of_finite_numbers():
    lane_map = bundled("highway")[1]
    nobody = jnp.array([NO_LANE])
    path = path_from(lane_map, nobody, jnp.zeros(1), jnp.zeros(1, jnp.int32), points=POINTS, step=STEP)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(path)) and isinstance(path, ReferencePath)
