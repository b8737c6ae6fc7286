"""Vehicles enter from their queues when there is room."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_worlds import bundled, demand_of, drivers, overlap, shapes, state_of

from limsim_jax.maps.lane_map import NO_LANE, lane_rows
from limsim_jax.maps.origins import origins
from limsim_jax.traffic.demand import (
    AT_ONCE,
    Flow,
    delayed,
    enter,
    sample_scenario,
)
from limsim_jax.traffic.engine import Traffic, drive
from limsim_jax.traffic.motion import boxes
from limsim_jax.traffic.state import start_state
from limsim_jax.traffic.vehicles import default_population
from limsim_jax.types import Config, Schedule

pytestmark = pytest.mark.engine

CONFIG = Config(dt=0.1)
let_in = jax.jit(enter, static_argnums=0)


def schedule_of(lane, time, goal, v=20.0, s=None, length=5.0):
    """One queue per lane with these times."""
    count = [len(t) for t in time]
    n = sum(count)
    shape = shapes(n, length)
    return Schedule(
        time=jnp.asarray(np.concatenate(time), jnp.float32),
        lane=jnp.asarray(np.repeat(lane, count)),
        s=shape.length if s is None else jnp.full(n, s, jnp.float32),
        v=jnp.full(n, v, jnp.float32),
        goal=jnp.full(n, goal),
        driver=drivers(n),
        shape=shape,
        start=jnp.asarray(np.concatenate([[0], np.cumsum(count)])),
    )


def empty(name, slots, schedule):
    """An empty road, before the first departure."""
    state = state_of(name, [NO_LANE] * slots, [0.0] * slots, [0.0] * slots, [0] * slots)
    queues = dataclasses.replace(state.queues, next=schedule.start[:-1])
    return dataclasses.replace(state, queues=queues)


def move(state, seconds):
    """Move all vehicles at constant speed; those beyond 500 m leave."""
    s = state.s + seconds * state.v
    gone = s > 500.0
    return dataclasses.replace(
        state, s=s, active=state.active & ~gone, step=state.step + round(seconds / CONFIG.dt)
    )


ROWS = [lane_rows(bundled("highway")[0])[f"1_0_-{i}"] for i in (3, 4, 5, 6)]
GOAL = int(np.flatnonzero(np.asarray(bundled("highway")[1].routes.reachable)[ROWS[0]])[0])


def test_queues_never_drop_a_vehicle():
    """A standing vehicle blocks one lane for 20 s; slots are few for a while; no vehicle is lost."""
    _, lane_map = bundled("highway")
    rng = np.random.default_rng(0)
    time = [np.sort(rng.uniform(0, 60, n)) for n in (20, 25, 0, 18)]
    schedule = schedule_of(ROWS, time, GOAL)
    state = empty("highway", 40, schedule)
    blocker = dataclasses.replace(
        state, active=state.active.at[7].set(True), lane=state.lane.at[7].set(ROWS[1]),
        s=state.s.at[7].set(11.0),
    )  # fmt: skip
    state, entered = blocker, np.zeros(4, int)
    for k in range(240):
        now = 0.5 * k
        before = np.asarray(state.active)
        state = let_in(CONFIG, lane_map, schedule, state)
        new = np.asarray(state.active) & ~before
        rows = np.asarray(state.vehicle)[new]
        assert (np.asarray(state.entered)[new] == now).all()
        origin = np.searchsorted(np.asarray(schedule.start), rows, side="right") - 1
        entered += np.bincount(origin, minlength=4)
        due = np.array([(t <= now).sum() for t in time])
        np.testing.assert_array_equal(
            entered, np.asarray(state.queues.next) - np.asarray(schedule.start[:-1])
        )
        np.testing.assert_array_equal(entered + np.asarray(delayed(schedule, state, now)), due)
        if now < 20:
            assert entered[1] == 0
        if now == 20:
            assert int(delayed(schedule, state, now)[1]) > 3
            state = dataclasses.replace(state, active=state.active.at[7].set(False))
        # on every lane, gaps to the leader are at least s0
        for row in ROWS:
            s = np.sort(np.asarray(state.s)[np.asarray(state.active & (state.lane == row))])
            assert (np.diff(s) - 5.0 >= 2.0 - 1e-3).all()
        state = move(state, 0.5)
    assert entered.tolist() == [20, 25, 0, 18] and int(state.queues.full) == 0


def test_slots_that_run_out_are_counted_and_those_of_egos_stay_free():
    _, lane_map = bundled("highway")
    schedule = schedule_of(ROWS, [[0.0, 5.0]] * 4, GOAL)
    state = empty("highway", 4, schedule)
    egos = dataclasses.replace(state.egos, slot=jnp.asarray([1]))
    state = dataclasses.replace(state, egos=egos)
    state = let_in(CONFIG, lane_map, schedule, state)
    assert np.asarray(state.active).tolist() == [True, False, True, True]
    assert int(state.queues.full) == 1
    first = set(np.asarray(state.lane)[[0, 2, 3]].tolist())
    state = let_in(CONFIG, lane_map, schedule, move(state, 0.5))
    assert int(state.queues.full) == 2, "counted at every decision"
    state = dataclasses.replace(state, active=state.active.at[2].set(False))
    state = let_in(CONFIG, lane_map, schedule, move(state, 0.5))
    assert set(ROWS) - first == {int(state.lane[2])} and int(state.queues.full) == 2
    assert not bool(state.active[1])


def test_origins_take_turns():
    """More origins than are looked at in one decision, and than there are slots."""
    network, lane_map = bundled("long_route")
    lanes = [lane_rows(network)[x] for group in origins(network).values() for x in group]
    assert len(lanes) > AT_ONCE
    goal = [int(np.flatnonzero(row)[0]) for row in np.asarray(lane_map.routes.reachable)[lanes]]
    schedule = schedule_of(lanes, [[0.0] * 8] * len(lanes), 0, v=5.0)
    schedule = dataclasses.replace(schedule, goal=jnp.repeat(jnp.asarray(goal), 8))
    state = empty("long_route", 32, schedule)
    state = let_in(CONFIG, lane_map, schedule, state)
    assert int(state.active.sum()) == AT_ONCE
    state = let_in(CONFIG, lane_map, schedule, move(state, 0.5))
    assert np.unique(np.asarray(state.lane)[np.asarray(state.active)]).tolist() == sorted(lanes)
    # two slots: the next in turn get them
    state, seen = empty("long_route", 32, schedule), set()
    state = dataclasses.replace(state, egos=dataclasses.replace(state.egos, slot=jnp.arange(30)))
    for _ in range(len(lanes)):
        state = let_in(CONFIG, lane_map, schedule, state)
        seen |= set(np.asarray(state.lane)[np.asarray(state.active)].tolist())
        state = dataclasses.replace(move(state, 0.5), active=jnp.zeros(32, bool))
    assert seen == set(lanes)


def test_entering_resets_the_slot():
    """Every field of a slot is that of a fresh vehicle, whatever was in it before."""
    _, lane_map = bundled("highway")
    schedule = schedule_of([ROWS[2]], [[0.2]], GOAL, v=17.0)
    driver = drivers(1, T=1.7, b=1.1, svo=0.3)
    schedule = dataclasses.replace(schedule, driver=driver)
    state = empty("highway", 3, schedule)
    junk = jax.tree.map(
        lambda x: (jnp.ones_like(x) if x.dtype == bool else x + 3) if x.shape == (3,) else x, state
    )
    junk = dataclasses.replace(junk, active=jnp.asarray([False, False, False]), step=jnp.int32(10))
    after = let_in(CONFIG, lane_map, schedule, junk)
    # due for 0.8 s, it could have entered half a second ago
    fresh = start_state(
        lane_map, driver, shapes(1), lane=jnp.asarray([ROWS[2]]), s=jnp.asarray([5.0 + 17.0 * 0.5]),
        v=jnp.asarray([17.0]), goal=jnp.asarray([GOAL]),
    )  # fmt: skip
    fresh = dataclasses.replace(fresh, vehicle=jnp.asarray([0]), entered=jnp.asarray([1.0], jnp.float32))
    world = ("step", "queues", "lights", "egos", "script")
    for field in dataclasses.fields(fresh):
        if field.name in world:
            continue
        for new, old, is_now in zip(
            *(jax.tree.leaves(getattr(x, field.name)) for x in (fresh, junk, after)), strict=True
        ):
            np.testing.assert_allclose(is_now[0], new[0], rtol=1e-6, err_msg=field.name)
            np.testing.assert_array_equal(is_now[1:], old[1:], err_msg=field.name)


def one_at(name, schedule, **values):
    """A world with one vehicle."""
    state = empty(name, 4, schedule)
    values = {"active": True} | values
    return dataclasses.replace(
        state, **{key: getattr(state, key).at[2].set(value) for key, value in values.items()}
    )


@pytest.mark.parametrize(
    ("other", "enters"),
    [
        ({"s": 5.0 + 5 + 2 + 1.2 * 15 + 0.1, "v": 15.0}, True),  # s0 + T v from rear to front
        ({"s": 5.0 + 5 + 2 + 1.2 * 15 - 0.1, "v": 15.0}, False),
        ({"s": 5.0 + 5 + 2.1, "v": 0.0}, True),  # behind a queue, slowly
        ({"s": 5.0 + 5 + 1.9, "v": 0.0}, False),
        ({"s": 5.0, "v": 0.0}, False),  # just there
        ({"s": 5.001, "v": 0.0}, False),
        ({"s": 3.0, "v": 0.0}, False),
        ({"s": 5.0 + 5 + 2, "v": 15.0, "lane": ROWS[2]}, True),  # on another lane
        ({"s": 5.0 + 5 + 2, "v": 15.0, "lane": ROWS[1], "side": 1, "progress": 0.2, "shift": -3.6}, False),
        ({"s": 2.0, "v": 15.0, "lane": ROWS[1], "previous": ROWS[0]}, True),  # its tail is far away
    ],
)
def test_room_to_the_leader(other, enters):
    """At the border of the gap that is needed; on the lane, changing to it, or beside it."""
    _, lane_map = bundled("highway")
    assert int(lane_map.left[ROWS[1]]) == ROWS[0]
    schedule = schedule_of([ROWS[0]], [[0.0]], GOAL, v=20.0)
    state = one_at("highway", schedule, **{"lane": ROWS[0], "goal": GOAL, **other})
    after = let_in(CONFIG, lane_map, schedule, state)
    assert int(after.active.sum()) == 1 + enters
    if enters and other.get("lane", ROWS[0]) == ROWS[0]:
        gap, v = other["s"] - 10.0, float(after.v[0])
        assert v <= 20.0 and v * 1.2 + v * v / 4 <= gap - 2.0 + other["v"] ** 2 / 4 + 1e-3


def test_room_across_lane_ends_and_the_tail_of_a_vehicle_that_turned_off():
    """On short lanes the leader stands on the next one, or has turned off but for its tail."""
    _, lane_map = bundled("intersection")
    routes, length = lane_map.routes, np.asarray(lane_map.length)
    after = np.asarray(routes.next_lane)
    lane, goal = next((int(a), int(g)) for a, g in np.argwhere(after >= 0) if 20 < length[a] < 80)
    follow = int(after[lane, goal])
    schedule = dataclasses.replace(
        schedule_of([lane], [[0.0]], goal, v=8.0, s=length[lane] - 3.0), v=jnp.asarray([8.0], jnp.float32)
    )

    def count(**other):
        state = one_at("intersection", schedule, goal=goal, **other)
        return int(let_in(CONFIG, lane_map, schedule, state).active.sum()) - 1

    assert count(lane=follow, s=7.1) == 1  # 3 m to the end of the lane, 2.1 m beyond it: s0 is 2 m
    assert count(lane=follow, s=3.9) == 0
    other = next(x for x in range(len(length)) if x not in (lane, follow) and bool(lane_map.valid[x]))
    assert count(lane=other, s=3.9, previous=lane) == 0
    assert count(lane=other, s=4.1, previous=lane) == 1
    assert count(lane=other, s=3.9) == 1


def test_room_to_followers():
    """A departure in the middle of a road: followers on the lane and on those before it, by their routes."""
    _, lane_map = bundled("ramp")
    after = np.asarray(lane_map.routes.next_lane)
    length = np.asarray(lane_map.length)
    before, goal = next((int(a), int(g)) for a, g in np.argwhere(after >= 0) if length[a] > 60)
    lane = int(after[before, goal])
    schedule = schedule_of([lane], [[0.0]], goal, v=10.0)
    far, near = 5.0 + 2 + 1.2 * 25 + (25**2 - 10**2) / 4 + 0.5, 5.0 + 2 + 1.2 * 25 + (25**2 - 10**2) / 4 - 0.5

    def count(distance, v=25.0, **changes):
        values = {"lane": before, "s": length[before] + 5.0 - distance, "v": v, "goal": goal} | changes
        state = one_at("ramp", schedule, **values)
        return int(let_in(CONFIG, lane_map, schedule, state).active.sum()) - 1

    assert length[before] > far
    assert count(far) == 1 and count(near) == 0
    assert count(near, v=12.0) == 1, "a slower one has time to follow"
    further = dataclasses.replace(schedule, s=jnp.asarray([90.0], jnp.float32))
    there = one_at("ramp", further, lane=lane, s=40.0, v=5.0, goal=goal)
    assert int(let_in(CONFIG, lane_map, further, there).active.sum()) == 2, "is no leader"
    others = np.asarray(lane_map.routes.reachable)[before] & (after[before] != lane)
    if others.any():
        assert count(near, goal=int(np.flatnonzero(others)[0])) == 1, "it goes elsewhere"


def test_two_vehicles_do_not_enter_right_behind_one_another():
    _, lane_map = bundled("ramp")
    after, length = np.asarray(lane_map.routes.next_lane), np.asarray(lane_map.length)
    first, goal = next((int(a), int(g)) for a, g in np.argwhere(after >= 0))
    schedule = schedule_of([first, int(after[first, goal])], [[0.0], [0.0]], goal, v=20.0)
    s = jnp.asarray([length[first] - 2.0, 5.0], jnp.float32)
    schedule = dataclasses.replace(schedule, s=s)
    state = let_in(CONFIG, lane_map, schedule, empty("ramp", 8, schedule))
    assert int(state.active.sum()) == 1 and int(state.queues.full) == 0


def test_headways_are_not_rounded_to_decisions():
    """Regular arrivals that fit are as far apart on the road as in time."""
    _, lane_map = bundled("highway")
    schedule = schedule_of([ROWS[0]], [np.arange(8) * 2.2 + 0.13], GOAL, v=24.0)
    state = empty("highway", 16, schedule)
    for _ in range(40):
        state = move(let_in(CONFIG, lane_map, schedule, state), 0.5)
    s = np.sort(np.asarray(state.s)[np.asarray(state.active)])
    assert len(s) == 8
    np.testing.assert_allclose(np.diff(s), 2.2 * 24.0, rtol=1e-4)


def test_gradients_of_entering_are_finite():
    _, lane_map = bundled("highway")
    schedule = schedule_of(ROWS[:2], [[0.0], [0.0]], GOAL, v=20.0)
    state = one_at("highway", schedule, lane=ROWS[0], s=5.0 + 5 + 2 + 18.5, v=15.0, goal=GOAL)

    def speed(T, v):
        driver = dataclasses.replace(schedule.driver, T=T)
        new = enter(
            CONFIG, lane_map, dataclasses.replace(schedule, driver=driver), dataclasses.replace(state, v=v)
        )
        return jnp.sum(jnp.where(new.active, new.v, 0))

    to_T, to_v = jax.jit(jax.grad(speed, (0, 1)))(schedule.driver.T, state.v)
    assert np.isfinite(np.asarray(to_T)).all() and np.isfinite(np.asarray(to_v)).all()
    assert float(to_T[0]) < 0 and float(to_T[1]) == 0 and float(to_v[2]) > 1.0


# --- with the engine --------------------------------------------------------------------------------


@functools.partial(jax.jit, static_argnums=2)
def minute(schedule, state, decisions):
    """A minute on the highway; records what happens at every decision and, of `a`, in every step."""
    _, lane_map = bundled("highway")

    def decision(state, _):
        state, a = drive(CONFIG, Traffic(), lane_map, state, schedule, record=lambda tick: tick.state.a)
        kept = {name: getattr(state, name) for name in ("active", "lane", "s", "entered", "vehicle", "v")}
        return state, kept | {"a": a.min(0), "box": boxes(lane_map, state)}

    return jax.lax.scan(decision, state, None, length=decisions)


def no_overlap(trace):
    for active, box in zip(trace["active"], trace["box"], strict=True):
        box = box[active]
        for i in range(len(box)):
            near = np.flatnonzero(np.hypot(*(box[i + 1 :, :2] - box[i, :2]).T) < 14.0) + i + 1
            if any(overlap(box[i], box[j]) for j in near):
                return False
    return True


@pytest.mark.parametrize("place", ["start", "middle"])
def test_insertion_on_a_highway_is_safe(place):
    """1800 veh/h per lane for a minute; then the same into the middle of moving traffic."""
    _, lane_map = bundled("highway")
    flow = Flow(origin="1-", rate=7200.0)
    demand = demand_of("highway", [flow], default_population(), horizon=60.0, density=6.0)
    drawn = jax.jit(sample_scenario, static_argnums=3)(demand, lane_map, jax.random.key(2), 320)
    schedule, state = drawn.schedule, drawn.start
    if place == "middle":
        schedule = dataclasses.replace(schedule, s=jnp.full_like(schedule.s, 900.0), v=schedule.v * 0.7)
    end, trace = minute(schedule, state, 120)
    trace = jax.tree.map(np.asarray, trace)
    assert no_overlap(trace)
    now = 0.5 * (np.arange(120) + 1)[:, None]
    young = trace["active"] & (trace["vehicle"] >= 0) & (now - trace["entered"] < 10.0)
    assert trace["a"][young].min() > -5.0
    assert trace["a"][trace["active"]].min() > -8.0
    entered = int((end.queues.next - schedule.start[:-1]).sum())
    due = int((schedule.time < 59.5).sum())
    assert entered + int(delayed(schedule, end, 59.5).sum()) == due
    if place == "start":
        # vehicles that entered go with the traffic, and most entered; the rest waits
        assert 0.75 * due < entered and trace["v"][young].mean() > 22.0
    else:
        # followers on the lane do not have to brake hard for vehicles that enter before them
        assert entered > 40
        behind = trace["active"] & (trace["s"] > 600) & (trace["s"] < 900)
        assert trace["a"][behind].min() > -5.0
