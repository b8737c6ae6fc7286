"""Courses along lanes, against a loop over vehicles and moments."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_worlds import bundled, overlap, scattered

from limsim_jax.maps.lane_map import NO_LANE, pose
from limsim_jax.metrics.course import _EVERY, COURSE, OnLanes, course
from limsim_jax.metrics.safety import encounter, ttc_2d
from limsim_jax.traffic.motion import boxes

N, D = 24, 4
seen = jax.jit(course)


def way_of(lane_map, lane: int, goal: int) -> list[int]:
    """Lanes to come, `D` of them."""
    way = [lane]
    while len(way) < D:
        way.append(int(lane_map.routes.next_lane[way[-1], goal]) if way[-1] != NO_LANE else NO_LANE)
    return way


def vehicles_of(name: str, seed: int) -> OnLanes:
    """Vehicles at random places with unequal sizes, speeds and offsets."""
    lane_map = bundled(name)[1]
    state, rng = scattered(name, N, seed, spacing=11.0), np.random.default_rng(seed)
    way = [way_of(lane_map, int(a), int(b)) for a, b in zip(state.lane, state.goal, strict=True)]
    box = np.array(boxes(lane_map, state))
    box[:, :3] += rng.normal(0, (0.3, 0.3, 0.05), (N, 3))
    box[:, 3:] = rng.uniform((3.5, 1.6), (12.0, 2.6), (N, 2))
    v = rng.uniform(0, 16, N) * (rng.random(N) < 0.8)
    values = (np.array(way, np.int32), state.lane, state.s, v.astype(np.float32), box.astype(np.float32))
    return OnLanes(*map(jnp.asarray, values))


def ahead(lane_map, vehicles: OnLanes, k: int) -> list[np.ndarray]:
    """Boxes of a vehicle along its path, one look after the other."""
    found = []
    x0, y0, h0 = (float(x) for x in pose(lane_map, vehicles.lane[k], vehicles.s[k]))
    x, y, heading, length, width = np.asarray(vehicles.box[k], float)
    dx, dy = x - x0, y - y0
    along, left = np.cos(h0) * dx + np.sin(h0) * dy, np.cos(h0) * dy - np.sin(h0) * dx
    for time in np.arange(0, COURSE + _EVERY / 2, _EVERY):
        lanes = [int(lane) for lane in vehicles.way[k] if lane != NO_LANE]
        s = float(vehicles.s[k]) + float(vehicles.v[k]) * time
        while len(lanes) > 1 and s > float(lane_map.length[lanes[0]]):
            s -= float(lane_map.length[lanes.pop(0)])
        px, py, h = (float(x) for x in pose(lane_map, jnp.int32(lanes[0]), jnp.float32(s)))
        place = px + np.cos(h) * along - np.sin(h) * left, py + np.sin(h) * along + np.cos(h) * left
        found.append(np.array([*place, heading + h - h0, length, width]))
    return found


@pytest.mark.parametrize("name", ["roundabout", pytest.param("intersection", marks=pytest.mark.engine)])
def test_bodies_meet_where_a_loop_along_their_lanes_finds_it(name):
    lane_map, met, ambiguous = bundled(name)[1], 0, 0
    for seed in range(2):
        vehicles = vehicles_of(name, seed)
        paths = [ahead(lane_map, vehicles, k) for k in range(N)]
        for slot in range(N):
            found = np.asarray(seen(lane_map, jnp.int32(slot), vehicles).meets)
            for k in set(range(N)) - {slot}:
                more = np.array([0, 0, 0, 0.02, 0.02])
                grown, shrunk = ([box + sign * more for box in paths[k]] for sign in (1, -1))
                sure, maybe = (
                    any(overlap(a, b) for a, b in zip(paths[slot], other, strict=True))
                    for other in (shrunk, grown)
                )
                if sure == maybe:
                    assert found[k] == sure, (seed, slot, k)
                    met += sure
                ambiguous += sure != maybe
    assert met > 8 and ambiguous < 10


def test_a_turn_past_a_waiting_vehicle_is_no_course_to_meet():
    """A straight line from the middle of a turn leads into the vehicle that waits beside its end."""
    crossed = 0
    for name in ("intersection", "roundabout", "long_route"):
        lane_map = bundled(name)[1]
        for turn in np.flatnonzero(np.asarray(lane_map.valid) & (np.asarray(lane_map.junction) >= 0)):
            after = int(lane_map.successors[turn, 0])
            beside = NO_LANE if after == NO_LANE else int(lane_map.opposite[after])
            if beside == NO_LANE or float(lane_map.length[turn]) < 10:
                continue
            for share in (0.3, 0.5, 0.7, 0.9):
                lanes = jnp.array([turn, beside], jnp.int32)
                s = jnp.array([share * float(lane_map.length[turn]), float(lane_map.length[beside]) - 1.0])
                x, y, heading = pose(lane_map, lanes, s - 2.2)
                box = jnp.stack([x, y, heading, jnp.full(2, 4.4), jnp.full(2, 1.8)], -1)
                way = jnp.array([[turn, after], [beside, NO_LANE]], jnp.int32)
                how = seen(lane_map, jnp.int32(0), OnLanes(way, lanes, s, jnp.array([6.0, 0.0]), box))
                straight = 6.0 * jnp.stack([jnp.cos(heading[0]), jnp.sin(heading[0])])
                crossed += float(ttc_2d(encounter(box[0], straight, box[1], jnp.zeros(2)))) < COURSE
                assert not how.meets[1], (name, turn, share)
    assert crossed > 3, "otherwise this tells little"


def test_who_follows_whom():
    lane_map = bundled("roundabout")[1]
    lane = next(
        int(k) for k in np.flatnonzero(np.asarray(lane_map.valid))
        if float(lane_map.length[k]) > 40 and int(lane_map.successors[k, 0]) != NO_LANE
    )  # fmt: skip
    after = int(lane_map.successors[lane, 0])
    other = next(int(k) for k in np.flatnonzero(np.asarray(lane_map.valid)) if k not in (lane, after))
    lanes = jnp.array([lane, lane, lane, after, other, lane], jnp.int32)
    s = jnp.array([20.0, 8.0, 32.0, 2.0, 5.0, 9.0])
    none = NO_LANE
    way = [[lane, after], [lane, after], [lane, after], [after, none], [other, none], [other, none]]
    x, y, heading = pose(lane_map, lanes, s)
    box = jnp.stack([x, y, heading, jnp.full(6, 4.4), jnp.full(6, 1.8)], -1)
    vehicles = OnLanes(jnp.array(way, jnp.int32), lanes, s, jnp.full(6, 5.0), box)
    how = seen(lane_map, jnp.int32(0), vehicles)
    assert how.follows.tolist() == [False, True, False, False, False, False]
    assert bool(how.meets[5])  # not on its own way: it may meet any
    assert seen(lane_map, jnp.int32(3), vehicles).follows.tolist() == [True, True, True, False, False, False]
    circle = vehicles._replace(way=vehicles.way.at[3, 1].set(lane))  # ahead, and behind the long way round
    assert not seen(lane_map, jnp.int32(0), circle).follows[3]
    assert seen(lane_map, jnp.int32(5), vehicles).meets.all()  # of such an ego nothing is known either
