"""Courses along lanes, against a loop over vehicles and moments."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_worlds import bundled, motorway, overlap, scattered, state_of

from limsim_jax.maps.lane_map import NO_LANE, pose, width
from limsim_jax.metrics.course import _EVERY, COURSE, Aside, OnLanes, aside, comes_near, course
from limsim_jax.metrics.safety import NO_GAP, NONE, encounter, ttc_2d
from limsim_jax.traffic.lane_change import LaneChoice, start
from limsim_jax.traffic.motion import advance, boxes
from limsim_jax.traffic.neighbors import Obstacles
from limsim_jax.types import Config, Egos

N, D = 24, 4
seen = jax.jit(course)


def way_of(lane_map, lane: int, goal: int) -> list[int]:
    """Lanes to come, `D` of them."""
    way = [lane]
    while len(way) < D:
        way.append(int(lane_map.routes.next_lane[way[-1], goal]) if way[-1] != NO_LANE else NO_LANE)
    return way


def vehicles_of(name: str, seed: int) -> OnLanes:
    """Vehicles at random places with unequal sizes, speeds and offsets; every third one goes aside."""
    lane_map = bundled(name)[1]
    state, rng = scattered(name, N, seed, spacing=11.0), np.random.default_rng(seed)
    way = [way_of(lane_map, int(a), int(b)) for a, b in zip(state.lane, state.goal, strict=True)]
    box = np.array(boxes(lane_map, state))
    box[:, :3] += rng.normal(0, (0.3, 0.3, 0.05), (N, 3))
    box[:, 3:] = rng.uniform((3.5, 1.6), (12.0, 2.6), (N, 2))
    v = rng.uniform(0, 16, N) * (rng.random(N) < 0.8)
    to = rng.uniform(-4, 4, N) * (np.arange(N) % 3 == 0)
    numbers = (jnp.asarray(x, jnp.float32) for x in (v, box, to, rng.uniform(0.2, 2, N)))
    v, box, to, pace = numbers
    other = jnp.full(N, NO_LANE, jnp.int32)
    return OnLanes(jnp.array(way, jnp.int32), state.lane, state.s, v, box, Aside(to, pace), other)


def on_lanes(way, lane, s, v, box) -> OnLanes:
    """Vehicles that keep their lanes."""
    return OnLanes(way, lane, s, v, box, Aside(0 * s, 0 * s), jnp.full_like(lane, NO_LANE))


def ahead(lane_map, vehicles: OnLanes, k: int) -> list[np.ndarray]:
    """Boxes of a vehicle along its path, one look after the other."""
    found = []
    x0, y0, h0 = (float(x) for x in pose(lane_map, vehicles.lane[k], vehicles.s[k]))
    x, y, heading, length, width = np.asarray(vehicles.box[k], float)
    dx, dy = x - x0, y - y0
    along, start = np.cos(h0) * dx + np.sin(h0) * dy, np.cos(h0) * dy - np.sin(h0) * dx
    to, pace = float(vehicles.aside.to[k]), float(vehicles.aside.pace[k])
    for time in np.arange(0, COURSE + _EVERY / 2, _EVERY):
        lanes = [int(lane) for lane in vehicles.way[k] if lane != NO_LANE]
        s = float(vehicles.s[k]) + float(vehicles.v[k]) * time
        while len(lanes) > 1 and s > float(lane_map.length[lanes[0]]):
            s -= float(lane_map.length[lanes.pop(0)])
        px, py, h = (float(x) for x in pose(lane_map, jnp.int32(lanes[0]), jnp.float32(s)))
        arrives = abs(to) / pace
        left = start + (to if time >= arrives else np.sign(to) * pace * time)
        turned = 0.0 if to and time >= arrives else heading - h0
        place = px + np.cos(h) * along - np.sin(h) * left, py + np.sin(h) * along + np.cos(h) * left
        found.append(np.array([*place, h + turned, length, width]))
    return found


def first_overlap(one: list[np.ndarray], other: list[np.ndarray]) -> int:
    """The first look at which two bodies overlap, -1 if none."""
    return next((t for t, pair in enumerate(zip(one, other, strict=True)) if overlap(*pair)), -1)


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
                sure, maybe = (first_overlap(paths[slot], other) for other in (shrunk, grown))
                if sure == maybe:
                    time = NONE if sure < 0 else max(sure - 1, 0) * _EVERY
                    assert found[k] == np.float32(time), (seed, slot, k)
                    met += sure >= 0
                ambiguous += sure != maybe
    assert met > 5 and ambiguous < 10


def test_only_vehicles_that_are_near_are_looked_at():
    """Those that may touch the ego on straight lines; the others count as never met."""
    lane_map, vehicles = bundled("roundabout")[1], vehicles_of("roundabout", 0)
    rng = np.random.default_rng(0)
    velocity = jnp.asarray(rng.normal(0, 9, (N, 2)), jnp.float32)
    nobody, left_out, passed_by = jnp.arange(N) < 0, 0, 0
    for slot in map(jnp.int32, range(0, N, 5)):
        near = comes_near(slot, vehicles.box, velocity)
        apart = vehicles.box.at[:, :2].multiply(2.5)  # a map on which some are far
        far = comes_near(slot, apart, velocity)
        for box, found in ((vehicles.box, near), (apart, far)):
            touch = ttc_2d(encounter(box[slot], velocity[slot], box, velocity)) <= COURSE
            assert not (touch & ~found).any()
        passed_by += int((~far).sum())
        whole, some = seen(lane_map, slot, vehicles), seen(lane_map, slot, vehicles, near)
        np.testing.assert_array_equal(some.meets[near], whole.meets[near])
        known = vehicles.lane != NO_LANE
        assert (some.meets[~near & known] == NONE).all()
        left_out += int((whole.meets[~near & known] < NONE).sum())
        assert (seen(lane_map, slot, vehicles, nobody).meets[known] == NONE).all()
        np.testing.assert_array_equal(some.follows, whole.follows)
    assert left_out > 0 and passed_by > N


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
                how = seen(lane_map, jnp.int32(0), on_lanes(way, lanes, s, jnp.array([6.0, 0.0]), box))
                straight = 6.0 * jnp.stack([jnp.cos(heading[0]), jnp.sin(heading[0])])
                crossed += float(ttc_2d(encounter(box[0], straight, box[1], jnp.zeros(2)))) < COURSE
                assert how.meets[1] == NONE, (name, turn, share)
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
    vehicles = on_lanes(jnp.array(way, jnp.int32), lanes, s, jnp.full(6, 5.0), box)
    how = seen(lane_map, jnp.int32(0), vehicles)
    assert how.follows.tolist() == [False, True, False, False, False, True]
    assert how.leads.tolist() == [False, False, True, True, False, False]
    assert how.meets[5] == NONE  # off its way since a lane change it goes on along its lane
    assert seen(lane_map, jnp.int32(3), vehicles).follows.tolist() == [True, True, True, False, False, False]
    circle = vehicles._replace(way=vehicles.way.at[3, 1].set(lane))  # ahead, and behind the long way round
    assert not seen(lane_map, jnp.int32(0), circle).follows[3]
    lost = vehicles._replace(lane=lanes.at[5].set(NO_LANE))  # it may meet any
    assert seen(lane_map, jnp.int32(0), lost).meets[5] == 0
    assert not seen(lane_map, jnp.int32(5), lost).meets.any()


def test_a_neighbour_that_cuts_in_is_met_if_it_is_abreast_or_too_slow():
    """Where the ego stays, by gap and speed alone; a straight line through the lane change leads into it."""
    lane_map, (lane, _) = bundled("highway")[1], motorway()
    beside = int(lane_map.left[lane])
    between = float(width(lane_map, lane, 200.0) + width(lane_map, beside, 200.0)) / 2

    def meets(gap: float, slower: float, gone: float = 0.5) -> float:
        """A neighbour with its tail `gap` m ahead of the ego's front has `gone` m, at 1 m/s."""
        lanes, s = jnp.array([lane, beside], jnp.int32), jnp.array([200.0, 205.0 + gap])
        v = jnp.array([20.0, 20.0 - slower])
        x, y, heading = pose(lane_map, lanes, s - 2.5, jnp.array([0.0, -gone]))
        box = jnp.stack([x, y, heading - jnp.array([0.0, 0.05]), jnp.full(2, 5.0), jnp.full(2, 1.9)], -1)
        vehicles = on_lanes(jnp.array([[lane, NO_LANE], [beside, NO_LANE]], jnp.int32), lanes, s, v, box)
        vehicles = vehicles._replace(aside=Aside(jnp.array([0.0, gone - between]), jnp.array([0.0, 1.0])))
        how = [seen(lane_map, jnp.int32(slot), vehicles) for slot in (0, 1)]
        assert how[0].meets[1] == how[1].meets[0]
        return float(how[0].meets[1])

    sideways = between - 0.5 - 1.9  # s until they overlap across the lanes: at 1 m/s
    for gap, slower in ((3.0, 0.0), (3.0, -2.0), (20.0, 3.0)):
        assert meets(gap, slower) == NONE
    assert meets(-2.0, 0.0) == pytest.approx(sideways, abs=2 * _EVERY)  # abreast
    assert meets(6.0, 2.0) == pytest.approx(3.0, abs=2 * _EVERY)  # too slow
    assert meets(0.5, 4.0) == pytest.approx(sideways, abs=2 * _EVERY)
    # a lane change ends in the middle of the lane: the body does not go on to the lane after that
    assert meets(-2.0, 0.0, gone=between) == pytest.approx(0.0, abs=1e-6)
    far = int(lane_map.left[beside])
    lanes, s = jnp.array([lane, far], jnp.int32), jnp.array([200.0, 200.0])
    x, y, heading = pose(lane_map, lanes, s - 2.5)
    box = jnp.stack([x, y, heading, jnp.full(2, 5.0), jnp.full(2, 1.9)], -1)
    two = on_lanes(lanes[:, None], lanes, s, jnp.full(2, 20.0), box)
    two = two._replace(aside=Aside(jnp.array([0.0, -between]), jnp.array([0.0, 1.5])))
    assert seen(lane_map, jnp.int32(0), two).meets[1] == NONE
    # there a long body is straight again: as turned as on the way it would reach into the next lane
    front = pose(lane_map, lanes[0], jnp.float32(202.5))
    long = box.at[0, :2].set(jnp.stack(front[:2])).at[1].add(jnp.array([0.0, 0.0, -0.35, 7.0, 0.0]))
    two = two._replace(
        box=long, s=s.at[0].add(5.0), aside=Aside(jnp.array([0.0, -between]), jnp.array([0.0, between / 2]))
    )
    assert seen(lane_map, jnp.int32(0), two).meets[1] == NONE


@pytest.mark.engine
def test_a_lane_change_ends_where_and_when_it_was_foretold():
    """Against the lane change as it is driven, to either side, at several moments of it."""
    lane_map, (right, goal) = bundled("highway")[1], motorway()
    lane = int(lane_map.left[right])
    foretold, config = jax.jit(aside), Config(dt=0.1)
    go = jax.jit(lambda state: advance(config, lane_map, state, jnp.zeros(3))[0])
    state = state_of("highway", [lane] * 3, [100.0, 150.0, 200.0], [20.0, 20.0, 20.0], [goal] * 3)
    nothing = Obstacles(jnp.full((3, 2), -1), jnp.full((3, 2), NO_GAP))
    choice = LaneChoice(side=jnp.array([1, -1, 0], jnp.int32), courtesy=nothing, stops_before=jnp.zeros(3))
    state, seen_at = start(lane_map, state, choice), []
    begin = np.asarray(boxes(lane_map, state))
    heading = begin[0, 2]
    for step in range(60):
        if step in (0, 12, 22, 30, 40):
            how, box = jax.device_get((foretold(lane_map, state), boxes(lane_map, state)))
            seen_at.append((step * 0.1, how, box))
        state = go(state)
    end = np.asarray(boxes(lane_map, state))
    assert not np.asarray(state.side).any() and state.lane.tolist() == [int(lane_map.left[lane]), right, lane]
    for time, how, box in seen_at:
        across = (end - box)[:, 1] * np.cos(heading) - (end - box)[:, 0] * np.sin(heading)
        np.testing.assert_allclose(how.to, across, atol=0.02)
        np.testing.assert_allclose(np.abs(how.to[:2]) / how.pace[:2], 4.5 - time, atol=0.01)
        assert how.to[2] == 0


@pytest.mark.parametrize(
    ("d", "turned", "signal", "to"),
    [
        (0.5, 0.05, 0, 0.0),  # within its lane: it keeps its offset
        (0.5, 0.05, 1, "left"),  # it signals
        (0.5, 0.02, 1, "left"),  # also where it goes there slowly
        (1.0, 0.02, 0, "left"),  # just over the line
        (0.5, -0.05, 1, 0.0),  # it signals and drives the other way
        (1.3, 0.05, 0, "left"),  # over the line
        (1.3, -0.05, 0, "back"),
        (-1.3, -0.05, 0, "off"),  # there is no lane
    ],
)
def test_an_ego_in_the_plane_goes_on_to_the_middle_of_a_lane(d, turned, signal, to):
    lane_map, (lane, goal) = bundled("highway")[1], motorway()
    state = state_of("highway", [lane] * 2, [100.0, 200.0], [20.0, 20.0], [goal] * 2)
    x, y, heading = pose(lane_map, jnp.int32(lane), jnp.float32(97.5), jnp.float32(d))
    one = {"x": x, "y": y, "heading": heading + turned, "steering": 0.0, "a": 0.0}
    egos = Egos(slot=jnp.array([0], jnp.int32), free=jnp.array([True]), **{
        name: jnp.full(1, value, jnp.float32) for name, value in one.items()
    })  # fmt: skip
    state = replace(state, egos=egos, d=jnp.array([d, 0.0]), side=jnp.array([signal, 0], jnp.int32))
    how = jax.jit(aside)(lane_map, state)
    w = 20.0 * np.sin(turned)
    between = float(width(lane_map, lane, 100.0) + width(lane_map, int(lane_map.left[lane]), 100.0)) / 2
    known = {"left": between - d, "back": -d, "off": w * COURSE}
    assert float(how.to[0]) == pytest.approx(known.get(to, 0.0), abs=1e-3)
    assert float(how.pace[0]) == pytest.approx(abs(w), abs=1e-3)
    assert how.to[1] == 0


def test_a_vehicle_behind_follows_on_a_lane_that_one_of_both_changes_to():
    lane_map, (lane, _) = bundled("highway")[1], motorway()
    beside = int(lane_map.left[lane])
    lanes = jnp.array([lane, beside, beside], jnp.int32)
    s = jnp.array([200.0, 180.0, 220.0])
    x, y, heading = pose(lane_map, lanes, s - 2.5)
    box = jnp.stack([x, y, heading, jnp.full(3, 5.0), jnp.full(3, 1.9)], -1)
    vehicles = on_lanes(lanes[:, None], lanes, s, jnp.full(3, 20.0), box)
    for changes, behind in (([NO_LANE] * 3, False), ([beside, NO_LANE, NO_LANE], True)):
        how = seen(lane_map, jnp.int32(0), vehicles._replace(other=jnp.array(changes, jnp.int32)))
        assert how.follows.tolist() == [False, behind, False]
        assert how.leads.tolist() == [False, False, behind]
    joins = vehicles._replace(other=jnp.array([NO_LANE, lane, lane], jnp.int32))
    away = vehicles._replace(other=jnp.array([NO_LANE, *[int(lane_map.left[beside])] * 2], jnp.int32))
    for turn in (0.0, 2.0, -2.5):  # whichever way the road runs
        cos, sin = np.cos(turn), np.sin(turn)
        turned = jnp.stack([cos * x - sin * y, sin * x + cos * y, heading + turn, *box[:, 3:].T], -1)
        how = seen(lane_map, jnp.int32(0), joins._replace(box=turned.astype(box.dtype)))
        assert how.follows.tolist() == [False, True, False] and how.leads.tolist() == [False, False, True]
        how = seen(lane_map, jnp.int32(0), away._replace(box=turned.astype(box.dtype)))
        assert not how.follows.any() and not how.leads.any(), "they change to another lane"


@pytest.mark.parametrize("v", [1.0, 4.0, 20.0])
def test_a_lane_change_in_a_queue_takes_as_long_as_the_way(v):
    """Below its least way in its time a lane change goes on by distance: the slower, the later it ends."""
    lane_map, (lane, goal) = bundled("highway")[1], motorway()
    state = state_of("highway", [lane] * 2, [100.0, 200.0], [v] * 2, [goal] * 2)
    state = replace(state, side=jnp.array([1, 0], jnp.int32), progress=jnp.array([0.25, 0.0]))
    how = jax.jit(aside)(lane_map, state)
    to = float(width(lane_map, lane, 100.0) + width(lane_map, int(lane_map.left[lane]), 100.0)) / 2
    assert float(how.to[0]) == pytest.approx(to, abs=1e-3)
    way = max(12.0, 2.5 * float(state.shape.length[0]))  # m
    assert float(how.pace[0]) == pytest.approx(min(v * 4.5 / way, 1.0) * to / (0.75 * 4.5), rel=1e-4)


def test_beyond_the_last_lane_a_vehicle_goes_straight_on():
    """A vehicle 5 m before the end of its way meets a body 20 m behind that end."""
    lane_map, (lane, _) = bundled("highway")[1], motorway()
    end = float(lane_map.length[lane])
    lanes, s = jnp.array([lane, lane], jnp.int32), jnp.array([end - 5.0, end - 1.0])
    x, y, heading = pose(lane_map, lanes, jnp.array([end - 7.5, end + 20.0]))
    box = jnp.stack([x, y, heading, jnp.full(2, 5.0), jnp.full(2, 1.9)], -1)
    way = jnp.array([[lane, NO_LANE, NO_LANE]] * 2, jnp.int32)
    how = seen(lane_map, jnp.int32(0), on_lanes(way, lanes, s, jnp.array([20.0, 0.0]), box))
    assert float(how.meets[1]) == pytest.approx((27.5 - 5.0) / 20.0, abs=2 * _EVERY)
