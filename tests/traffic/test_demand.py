"""Demand: arrivals, goals, vehicles at the start, entering; SUMO's demand."""

import dataclasses
import functools
import itertools
import math
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from paths import SHARED, needs_shared
from scipy import stats
from synthetic import network as network_of
from synthetic import straight
from traffic_worlds import bundled, drivers, shapes, state_of

from limsim_jax.maps import read_network
from limsim_jax.maps.lane_map import NO_LANE, VEHICLE_CLASSES, lane_ids, lane_rows
from limsim_jax.maps.network import MapError
from limsim_jax.maps.origins import origins
from limsim_jax.maps.rasterise import build_lane_map
from limsim_jax.maps.routing import default_goals
from limsim_jax.maps.sumo import read_demand
from limsim_jax.traffic.car_following import safe_speed
from limsim_jax.traffic.demand import (
    AT_ONCE,
    CHANGE_ROOM,
    CHANGE_TIME,
    NEVER,
    Flow,
    build_demand,
    delayed,
    enter,
    overflow,
    sample_scenario,
)
from limsim_jax.traffic.demand.sumo import sumo_scenario
from limsim_jax.traffic.engine import Traffic, drive
from limsim_jax.traffic.motion import boxes
from limsim_jax.traffic.state import start_state
from limsim_jax.traffic.vehicles import default_population, uniform_population
from limsim_jax.types import Config, Schedule

CONFIG = Config(dt=0.1)
CARS = uniform_population()
let_in = jax.jit(enter, static_argnums=0)


def build(name, flows, population=CARS, horizon=3600.0, density=0.0):
    network, lane_map = bundled(name)
    goals = default_goals(network)
    return build_demand(network, lane_map, goals, flows, population, horizon=horizon, density=density)


@functools.partial(jax.jit, static_argnums=(3, 4))
def worlds(demand, lane_map, keys, slots, keep):
    """One world per key; of it what `keep` says: the less, the quicker to compile."""
    return jax.vmap(lambda key: keep(sample_scenario(demand, lane_map, key, slots)))(keys)


def time_of(scenario):
    return scenario.schedule.time


def schedule_part(scenario):
    return scenario.schedule


def start_part(scenario):
    return scenario.start


def everything(scenario):
    return scenario


def keys(n, seed=0):
    return jax.random.split(jax.random.key(seed), n)


def arrivals(name, flow, n=16, **kwargs):
    """Arrival times on the first lane of a flow, one array per world; and the demand."""
    demand = build(name, [flow], **kwargs)
    times = np.asarray(worlds(demand, bundled(name)[1], keys(n), 8, time_of))
    stop = int(demand.start[1])
    return [row[row < NEVER] for row in times[:, :stop]], demand


# --- where vehicles come in ---------------------------------------------------------------------


def test_entries_are_the_ways_into_the_bundled_maps():
    count = {name: {k: len(v) for k, v in origins(bundled(name)[0]).items()} for name in ("highway", "ramp")}
    assert count == {"highway": {"1-": 4, "2+": 4}, "ramp": {"1": 3, "4": 3, "5": 1}}
    # of the four arms of the intersection two lanes each; the pockets that begin later are no origins
    assert [len(lanes) for lanes in origins(bundled("intersection")[0]).values()] == [2, 2, 2, 2]
    for name in ("intersection", "roundabout", "long_route"):
        network, _ = bundled(name)
        for lanes in origins(network).values():
            assert all(not network.lanes[lane].predecessors for lane in lanes)
            assert all(network.lanes[lane].junction is None for lane in lanes)


# --- arrivals -----------------------------------------------------------------------------------


def test_poisson_arrivals():
    """Exponential headways (Kolmogorov-Smirnov), as many as the rate says, in order."""
    found, demand = arrivals("highway", Flow(origin="1_0_-3", rate=600.0, begin=100.0), n=24)
    assert all(row[0] >= 100.0 and row[-1] < 3600.0 and (np.diff(row) >= 0).all() for row in found)
    # the first 400 of some 580 headways: none is cut off by the horizon
    headway = np.concatenate([np.diff(row, prepend=100.0)[:400] for row in found])
    assert stats.kstest(headway, stats.expon(scale=6.0).cdf).pvalue > 0.01
    related: Any = stats.pearsonr(headway[1:], headway[:-1])
    assert related.pvalue > 0.01, "independent of one another"
    count = np.array([len(row) for row in found])
    mean = 3500 / 6
    assert abs(count.mean() - mean) < 4 * math.sqrt(mean / len(found))
    # rows: as the quantile of the Poisson distribution says
    capacity = int(demand.start[1])
    assert stats.poisson.sf(capacity - 1, mean) < 1e-9 < stats.poisson.sf(capacity - 15, mean)


def test_uniform_arrivals_have_one_headway_and_any_phase():
    found, _ = arrivals("highway", Flow(origin="1_0_-3", rate=450.0, pattern="uniform"), n=64, horizon=600.0)
    assert all(len(row) == 75 for row in found)
    np.testing.assert_allclose(np.diff(np.stack(found)).astype(float), 8.0, atol=2e-4)
    phase = np.array([row[0] for row in found])
    assert stats.kstest(phase, stats.uniform(0, 8).cdf).pvalue > 0.01


def test_platoons():
    """Groups of 4, 2 s apart, and exponential times between them; stationary from the begin on."""
    flow = Flow(origin="1_0_-3", rate=720.0, pattern="platoon", platoon=4, headway=2.0)
    found, _ = arrivals("highway", flow, n=256, horizon=900.0)
    gaps = [np.diff(row) for row in found]
    pauses = np.concatenate([row[row > 2.0005][:30] - 2.0 for row in gaps])
    # 4 vehicles take 20 s, of which 8 s are headways
    assert stats.kstest(pauses, stats.expon(scale=12.0).cdf).pvalue > 0.01
    inside = np.concatenate([np.diff(np.flatnonzero(row > 2.0005)) for row in gaps])
    # every group has 4, but for pauses too short to be seen
    assert (inside % 4 == 0).all() and (inside == 4).mean() > 0.999
    for at in (0.0, 3.0, 400.0):
        count = sum(((row >= at) & (row < at + 5)).sum() for row in found)
        assert abs(count / 256 - 1.0) < 4 * 1.7 / 16, "1 per 5 s everywhere"


def test_rows_that_do_not_suffice_are_told():
    demand = build("highway", [Flow(origin="1_0_-3", rate=200.0), Flow(origin="1_0_-5", rate=200.0)])
    more = dataclasses.replace(demand, idle=demand.idle.at[1].mul(0.5))
    told = jax.jit(jax.vmap(overflow, (None, 0)))
    assert not np.asarray(told(demand, keys(64))).any()
    assert np.asarray(told(more, keys(64))).all()


def test_flows_that_share_a_lane_share_its_queue():
    flows = [
        Flow(origin="1_0_-3", rate=300.0, end=600.0, speed=20.0),
        Flow(origin="1-", rate=800.0, pattern="uniform", speed=25.0),
    ]
    demand = build("highway", flows, horizon=1200.0)
    schedule = jax.tree.map(np.asarray, worlds(demand, bundled("highway")[1], keys(3), 8, schedule_part))
    start, time, v = schedule.start[0], schedule.time[0], schedule.v[0]
    rows = lane_rows(bundled("highway")[0])
    assert schedule.lane[0, start[:4]].tolist() == sorted(rows[f"1_0_-{i}"] for i in (3, 4, 5, 6))
    for o in range(4):
        mine = slice(start[o], start[o + 1])
        assert (np.diff(time[mine]) >= 0).all()
        assert (schedule.lane[0, mine] == schedule.lane[0, start[o]]).all()
    assert np.count_nonzero(time < NEVER) == np.count_nonzero(time[: start[4]] < NEVER)
    both = time[start[3] : start[4]], v[start[3] : start[4]]
    slow = both[0][both[1] == 20.0]
    assert len(slow) > 30 and slow[slow < NEVER].max() < 600.0
    np.testing.assert_allclose(np.diff(both[0][(both[1] == 25.0) & (both[0] < NEVER)]), 18.0, atol=1e-3)


def test_vehicles_of_a_queue_do_not_depend_on_other_flows_nor_on_companions():
    _, lane_map = bundled("highway")
    flow = Flow(origin="1_0_-4", rate=500.0)
    one = build("highway", [flow], default_population(), horizon=60.0)
    more = build("highway", [flow, Flow(origin="1_0_-6", rate=150.0)], default_population(), horizon=60.0)
    a = worlds(one, lane_map, keys(3), 8, schedule_part)
    b = worlds(more, lane_map, keys(3), 8, schedule_part)
    n = int(one.start[1])
    first = lane_rows(bundled("highway")[0])["1_0_-4"]
    at = int(np.flatnonzero(np.asarray(more.lane) == first)[0])
    begin = int(more.start[at])
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        if x.ndim == 2 and x.shape[1] == a.time.shape[1]:
            np.testing.assert_allclose(x[:, :n], y[:, begin : begin + n], rtol=1e-5)
    # the same batch shape with other companions: the same bits; alone: but for rounding
    other = worlds(one, lane_map, keys(3).at[1:].set(keys(2, seed=9)), 8, schedule_part)
    alone = worlds(one, lane_map, keys(3)[:1], 8, schedule_part)
    for x, y, z in zip(*(jax.tree.leaves(s) for s in (a, other, alone)), strict=True):
        np.testing.assert_array_equal(x[0], y[0])
        np.testing.assert_allclose(x[0], z[0], rtol=1e-5)
    assert not np.array_equal(a.time[0], a.time[1])


# --- goals and classes --------------------------------------------------------------------------


def test_turning_ratios_and_classes():
    """Chi-square tests of drawn goals and classes; who cannot go there does not."""
    network, lane_map = bundled("intersection")
    goals = list(default_goals(network))
    shares = {goals[3]: 1.0, goals[1]: 3.0, goals[2]: 6.0}
    classes = {"car": 5.0, "bus": 2.0, "motorcycle": 3.0}
    flow = Flow(origin="1", rate=1500.0, goal=shares, classes=classes)
    demand = build("intersection", [flow], default_population(), horizon=600.0)
    schedule = jax.tree.map(np.asarray, worlds(demand, lane_map, keys(16), 8, schedule_part))
    used = schedule.time < NEVER
    goal = np.bincount(schedule.goal[used], minlength=4)[:4]
    assert goal[0] == 0
    assert stats.chisquare(goal[[3, 1, 2]], np.array([0.1, 0.3, 0.6]) * used.sum()).pvalue > 0.01
    kind = np.bincount(schedule.shape.vehicle_class[used], minlength=len(VEHICLE_CLASSES))
    assert kind[[1, 2, 5]].sum() == 0
    assert stats.chisquare(kind[[0, 3, 4]], np.array([0.5, 0.2, 0.3]) * used.sum()).pvalue > 0.01
    both = np.zeros((4, len(VEHICLE_CLASSES)))
    np.add.at(both, (schedule.goal[used], schedule.shape.vehicle_class[used]), 1)
    related: Any = stats.chi2_contingency(both[np.ix_([1, 2, 3], [0, 3, 4])])
    assert related.pvalue > 0.01, "independent"
    reachable = np.asarray(lane_map.routes.reachable)
    assert reachable[schedule.lane[used], schedule.goal[used]].all()
    assert set(schedule.lane[used]) == {lane_rows(network)[lane] for lane in origins(network)["1"]}
    # the front is where the body is just on the lane
    np.testing.assert_allclose(schedule.s[used], schedule.shape.length[used], rtol=1e-6)


def test_lanes_are_open_to_the_classes_that_enter_on_them():
    network, _ = bundled("highway")
    open_to = frozenset({"bus", "emergency"})
    lanes = dict(network.lanes)
    lanes["1_0_-6"] = dataclasses.replace(lanes["1_0_-6"], access=open_to)
    network = dataclasses.replace(network, lanes=lanes)
    lane_map = build_lane_map(network)
    population = default_population({"car": 8.0, "bus": 2.0})
    demand = build_demand(
        network, lane_map, default_goals(network), [Flow(origin="1-", rate=3200.0)], population,
        horizon=600.0, density=12.0,
    )  # fmt: skip
    drawn = worlds(demand, lane_map, keys(8), 400, everything)
    bus_lane, bus = lane_rows(network)["1_0_-6"], VEHICLE_CLASSES.index("bus")
    for who, there in ((drawn.schedule, drawn.schedule.time < NEVER), (drawn.start, drawn.start.active)):
        lane, kind = np.asarray(who.lane)[there], np.asarray(who.shape.vehicle_class)[there]
        assert (kind[lane == bus_lane] == bus).all()
        # as a fifth of the vehicles may use it, it gets less than the other lanes
        share = (lane == bus_lane).sum() / (lane == lane_rows(network)["1_0_-3"]).sum()
        assert 0.05 < share < 0.55


# --- the start ----------------------------------------------------------------------------------


def corners(box):
    x, y, heading, length, width = box
    c, s = math.cos(heading), math.sin(heading)
    return np.array([
        (x + a * length / 2 * c - b * width / 2 * s, y + a * length / 2 * s + b * width / 2 * c)
        for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))
    ])  # fmt: skip


def overlap(a, b):
    """Whether two boxes share a point: no edge of either separates their corners."""
    p, q = corners(a), corners(b)
    for shape in (p, q):
        for i in range(4):
            edge = shape[(i + 1) % 4] - shape[i]
            normal = np.array([-edge[1], edge[0]])
            if (p @ normal).max() < (q @ normal).min() or (q @ normal).max() < (p @ normal).min():
                return False
    return True


@pytest.mark.parametrize(("name", "density"), [("roundabout", 24.0), ("ramp", 30.0)])
def test_vehicles_at_the_start(name, density):
    """Nobody overlaps, everybody can reach the goal, and all can follow and stop."""
    network, lane_map = bundled(name)
    flows = [Flow(origin=list(origins(network)), rate=600.0)]
    demand = build(name, flows, default_population(), horizon=60.0, density=density)
    km = sum(lane.length for lane in network.drivable_lanes() if lane.junction is None) / 1000
    assert demand.initial == round(density * km)
    drawn = worlds(demand, lane_map, keys(4), demand.initial + 3, start_part)
    routes = jax.tree.map(np.asarray, lane_map.routes)
    places = set()
    for world in range(4):
        state = jax.tree.map(lambda x: np.asarray(x)[world], drawn)  # noqa: B023
        n = demand.initial
        assert state.active.sum() == n and state.active[:n].all()
        box = np.asarray(boxes(lane_map, jax.tree.map(jnp.asarray, state)))
        for i in range(n):
            near = np.flatnonzero(np.hypot(*(box[:n, :2] - box[i, :2]).T) < 14.0)
            assert not any(overlap(box[i], box[j]) for j in near if j > i)
        lane, s, goal = state.lane[:n], state.s[:n], state.goal[:n]
        ids = lane_ids(network)
        assert all(network.lanes[ids[row]].junction is None for row in lane)
        assert (s >= state.shape.length[:n]).all()
        room = routes.change_distance[lane, goal] - s
        assert routes.reachable[lane, goal].all()
        per_lane = np.maximum(CHANGE_ROOM, CHANGE_TIME * np.asarray(lane_map.speed_limit)[lane])
        assert (room > per_lane * np.abs(routes.lanes_to_go[lane, goal])).all()
        ends = (routes.next_lane[lane, goal] < 0) & ~routes.is_goal[lane, goal]
        assert (np.asarray(lane_map.length)[lane[ends]] - s[ends] > 25.0).all()
        # who follows somebody on the lane can stop behind them: v T + v^2 / 2 b <= gap - s0 + v_lead^2 / 2 b
        driver = jax.tree.map(lambda x: x[: demand.initial], state.driver)
        for i in range(n):
            on = np.flatnonzero((lane == lane[i]) & (s > s[i]))
            if len(on):
                j = on[np.argmin(s[on])]
                gap = s[j] - state.shape.length[j] - s[i]
                v, b = state.v[i], driver.b[i]
                if gap > 150.0:  # further than drivers look
                    continue
                way = v * driver.T[i] + v * v / 2 / b - state.v[j] ** 2 / 2 / b
                assert way <= max(gap - driver.s0[i], 0) + 0.01
        assert (state.v[:n] <= driver.speed_factor * np.asarray(lane_map.speed_limit)[lane] + 1e-3).all()
        assert state.v[:n].mean() > 3.0
        places.add(tuple(np.round(s, 1)))
    assert len(places) == 4


def test_places_at_the_start_keep_clear_of_other_lanes():
    """Where two lanes cross without a junction, there is no place on one of them."""
    lanes = [
        straight("a", (0, 0), 0.0, 300.0),
        straight("b", (145, -145), math.pi / 2, 300.0),
    ]
    plain = network_of(lanes)
    goals = {"a": ("a",), "b": ("b",)}
    demand = build_demand(plain, build_lane_map(plain, goals), goals, [], CARS, horizon=1.0, density=50.0)
    s = [np.asarray(demand.seat_s)[np.asarray(demand.seat_lane) == row] for row in (0, 1)]
    slack, width, length = float(demand.seat_slack.max()), 1.8, 4.5
    covers = [(x > 145 - width / 2 - slack) & (x - length < 145 + width / 2) for x in s]
    assert covers[0].any() != covers[1].any() and len(s[0]) + len(s[1]) > 40


def test_safe_speed_is_gipps():
    """Reaction, then braking as hard as the leader, ends s0 behind it."""
    driver = drivers(3, T=1.5, b=2.5, s0=2.0)
    gap, lead = jnp.asarray([2.0 + 30.0, 50.0, 1.0]), jnp.asarray([20.0, 8.0, 5.0])
    v = np.asarray(safe_speed(driver, gap, lead), float)
    assert v[0] == pytest.approx(20.0, rel=1e-5)
    assert v[1] * 1.5 + v[1] ** 2 / 5 == pytest.approx(48.0 + 64 / 5, rel=1e-5)
    assert v[2] * 1.5 + v[2] ** 2 / 5 == pytest.approx(-1.0 + 25 / 5, rel=1e-5)


# --- entering -----------------------------------------------------------------------------------


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
    """Nobody on the road, and nobody has entered."""
    state = state_of(name, [NO_LANE] * slots, [0.0] * slots, [0.0] * slots, [0] * slots)
    queues = dataclasses.replace(state.queues, next=schedule.start[:-1])
    return dataclasses.replace(state, queues=queues)


def move(state, seconds):
    """Everybody goes on at constant speed; who is 500 m away is gone."""
    s = state.s + seconds * state.v
    gone = s > 500.0
    return dataclasses.replace(
        state, s=s, active=state.active & ~gone, step=state.step + round(seconds / CONFIG.dt)
    )


ROWS = [lane_rows(bundled("highway")[0])[f"1_0_-{i}"] for i in (3, 4, 5, 6)]
GOAL = int(np.flatnonzero(np.asarray(bundled("highway")[1].routes.reachable)[ROWS[0]])[0])


def test_queues_never_drop_anybody():
    """A standing vehicle blocks one lane for 20 s; slots are few for a while; nobody is lost."""
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
    world = ("step", "queues", "lights", "egos")
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


def test_room_across_lane_ends_and_the_tail_of_who_turned_off():
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


def test_room_to_those_who_come_from_behind():
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


def test_two_do_not_enter_right_behind_one_another():
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


# --- with the engine ----------------------------------------------------------------------------


@functools.partial(jax.jit, static_argnums=2)
def minute(schedule, state, decisions):
    """A minute on the highway; records what happens at every decision and, of `a`, in every step."""
    _, lane_map = bundled("highway")

    def decision(state, _):
        state, a = drive(CONFIG, Traffic(), lane_map, state, schedule, record=lambda tick: tick.state.a)
        kept = {name: getattr(state, name) for name in ("active", "lane", "s", "entered", "vehicle", "v")}
        return state, kept | {"a": a.min(0), "box": boxes(lane_map, state)}

    return jax.lax.scan(decision, state, None, length=decisions)


def nobody_overlaps(trace):
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
    demand = build("highway", [flow], default_population(), horizon=60.0, density=6.0)
    drawn = jax.jit(sample_scenario, static_argnums=3)(demand, lane_map, jax.random.key(2), 320)
    schedule, state = drawn.schedule, drawn.start
    if place == "middle":
        schedule = dataclasses.replace(schedule, s=jnp.full_like(schedule.s, 900.0), v=schedule.v * 0.7)
    end, trace = minute(schedule, state, 120)
    trace = jax.tree.map(np.asarray, trace)
    assert nobody_overlaps(trace)
    now = 0.5 * (np.arange(120) + 1)[:, None]
    young = trace["active"] & (trace["vehicle"] >= 0) & (now - trace["entered"] < 10.0)
    assert trace["a"][young].min() > -5.0
    assert trace["a"][trace["active"]].min() > -8.0
    entered = int((end.queues.next - schedule.start[:-1]).sum())
    due = int((schedule.time < 59.5).sum())
    assert entered + int(delayed(schedule, end, 59.5).sum()) == due
    if place == "start":
        # who came in goes with the traffic, and most came in; the rest waits
        assert 0.75 * due < entered and trace["v"][young].mean() > 22.0
    else:
        # followers on the lane do not have to brake hard for those who come in before them
        assert entered > 40
        behind = trace["active"] & (trace["s"] > 600) & (trace["s"] < 900)
        assert trace["a"][behind].min() > -5.0


# --- errors -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("flow", "message"),
    [
        ({"origin": "17"}, "no road or lane '17' to depart from; there are 1, 3, 5-, 6-"),
        ({"origin": ()}, "flow 0: it has no origin"),
        ({"goal": "nowhere"}, "no goal 'nowhere'; there are '2', '4', '5+', '6+'"),
        ({"goal": {"4": 1.0, "5+": -1.0}}, "goal '5+' has the share -1"),
        ({"goal": {"2": 0.0}}, "no goal has a positive share"),
        ({"rate": -1.0}, "rate = -1 veh/h; it has to be 0 or more"),
        ({"rate": math.nan}, "rate = nan veh/h"),
        ({"rate": math.inf}, "rate = inf veh/h"),
        ({"pattern": "gamma"}, "pattern 'gamma' is unknown; known are poisson, uniform, platoon"),
        ({"begin": 20.0, "end": 10.0}, "ends at 10 s, before it begins at 20 s"),
        ({"begin": -1.0}, "begin = -1 s"),
        ({"end": math.nan}, "ends at nan s"),
        ({"speed": -3.0}, "speed = -3 m/s"),
        ({"classes": {"tram": 1.0}}, "vehicle class 'tram' is unknown; known are car, van"),
        ({"classes": {"bus": 1.0}}, "the population has no vehicles of class 'bus'"),
        ({"classes": {"car": 0.0}}, "no vehicle class has a positive weight"),
        ({"pattern": "platoon", "headway": 0.0}, "a headway of 0 s"),
        ({"pattern": "platoon", "rate": 5000.0, "headway": 3.0}, "do not fit a headway of 3 s, at most 1200"),
    ],
)
def test_flows_that_make_no_sense(flow, message):
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        build("intersection", [Flow(**{"origin": "1", "rate": 100.0} | flow)])
    assert "\n" not in str(error.value) and "flow 0" in str(error.value)


def test_other_demands_that_make_no_sense():
    network, lane_map = bundled("highway")
    with pytest.raises(ValueError, match=r"flow 0 from '1-': no way to goal '1\+'; it can reach '2-'"):
        build("highway", [Flow(origin="1-", rate=1.0, goal="1+")])
    back = {f"1_0_-{i}": f"1_0_{i}" for i in (3, 4, 5, 6)}
    lanes = {
        name: dataclasses.replace(lane, predecessors=(back[name],)) if name in back else lane
        for name, lane in network.lanes.items()
    }
    ring = dataclasses.replace(network, lanes=lanes)
    with pytest.raises(ValueError, match=r"road '1' has traffic both ways; name one: '1\+'"):
        build_demand(ring, lane_map, default_goals(network), [Flow(origin="1", rate=1.0)], CARS, horizon=60.0)
    with pytest.raises(ValueError, match="lies inside a junction"):
        inside = next(x.id for x in bundled("intersection")[0].drivable_lanes() if x.junction)
        build("intersection", [Flow(origin=inside, rate=1.0)])
    with pytest.raises(ValueError, match=r"density = 500 veh/km puts 12\d\d\d vehicles .* only \d+ places"):
        build("highway", [], density=500.0)
    with pytest.raises(ValueError, match="density = -1"):
        build("highway", [], density=-1.0)
    with pytest.raises(ValueError, match="horizon = 0 s"):
        build("highway", [], horizon=0.0)
    with pytest.raises(ValueError, match="is not number 0 of the lane map"):
        goals = dict(reversed(default_goals(network).items()))
        build_demand(network, lane_map, goals, [], CARS, horizon=60.0)
    demand = build("highway", [], density=5.0)
    with pytest.raises(ValueError, match=f"{demand.initial} vehicles at the start do not fit into 20 slots"):
        sample_scenario(demand, lane_map, jax.random.key(0), 20)


# --- SUMO ---------------------------------------------------------------------------------------


@needs_shared
@pytest.mark.parametrize(
    ("folder", "rows", "notes"),
    [
        ("limsim_bigInter", 1793, 0),
        ("limsim_corridor", 5, 1),
        ("ingolstadt1", 1716, 0),
    ],
)
def test_shared_sumo_demands(folder, rows, notes):
    """Everybody departs in time on the first edge of the own route; what is not used is said."""
    path = SHARED / "sumo" / folder
    network = read_network(next(path.glob("*.net.xml")), cache=False)
    demand = read_demand(sorted(path.glob("*.rou.xml")), network)
    found = sumo_scenario(network, build_lane_map(network), demand, slots=16)
    schedule = jax.tree.map(np.asarray, found.scenario.schedule)
    assert len(found.vehicles) == rows == len(demand.vehicles) == len(set(found.vehicles))
    assert len(found.notes) == notes
    ids, table = lane_ids(network), found.lane_map.routes
    begin = math.floor(min(float(v.depart) for v in demand.vehicles.values()))
    for row, name in enumerate(found.vehicles):
        vehicle = demand.vehicles[name]
        kind = demand.types[vehicle.type]
        edges = demand.routes[vehicle.route].edges if vehicle.route else (vehicle.origin, vehicle.destination)
        assert schedule.time[row] == pytest.approx(float(vehicle.depart) - begin, abs=1e-2)
        lane = network.lanes[ids[schedule.lane[row]]]
        assert lane.road == edges[0]
        assert table.reachable[schedule.lane[row], schedule.goal[row]]
        assert found.routes[schedule.goal[row]][-1] == edges[-1]
        assert schedule.shape.length[row] == pytest.approx(kind.length)
        if isinstance(vehicle.depart_lane, int):
            assert lane.number == vehicle.depart_lane
    start = schedule.start
    assert (schedule.time[start[-1] :] == NEVER).all()
    for a, b in itertools.pairwise(start):
        assert (np.diff(schedule.time[a:b]) >= 0).all() and len(set(schedule.lane[a:b])) <= 1
    # and some of them drive in
    state = dataclasses.replace(found.scenario.start, step=jnp.int32(50))
    state = let_in(CONFIG, found.lane_map, found.scenario.schedule, state)
    assert 0 < int(state.active.sum()) <= 16


NET = """<net version="1.20">
<edge id="a" from="x" to="y"><lane id="a_0" index="0" speed="14" length="200" shape="0,0 200,0"/>
<lane id="a_1" index="1" speed="14" length="200" shape="0,3.2 200,3.2"/></edge>
<edge id="b" from="y" to="z">
<lane id="b_0" index="0" disallow="bus" speed="14" length="90" shape="200,0 290,0"/>
<lane id="b_1" index="1" allow="bus" speed="14" length="90" shape="200,3.2 290,3.2"/></edge>
<edge id="c" from="z" to="x">
<lane id="c_0" index="0" speed="14" length="300" shape="290,0 290,20 0,20 0,0"/></edge>
<connection from="a" to="b" fromLane="0" toLane="0" dir="s" state="M"/>
<connection from="a" to="b" fromLane="1" toLane="1" dir="s" state="M"/>
<connection from="b" to="c" fromLane="0" toLane="0" dir="s" state="M"/>
<connection from="b" to="c" fromLane="1" toLane="0" dir="s" state="M"/>
<connection from="c" to="a" fromLane="0" toLane="0" dir="s" state="M"/>
</net>"""

ROUTES = """<routes>
<vType id="bus" vClass="bus"/><vType id="bike" vClass="bicycle"/>
<route id="ab" edges="a b"/>
<vehicle id="one" depart="100.5" route="ab" departLane="1" departPos="50" departSpeed="9" speedFactor="1.2"/>
<vehicle id="two" type="bus" depart="101" route="ab" departLane="best" departSpeed="max"/>
<vehicle id="ring" depart="102"><route edges="a b c a"/></vehicle>
<vehicle id="rider" type="bike" depart="103" route="ab"/>
<trip id="trip" depart="104" from="b" to="a" departPos="-10"><stop lane="c_0" duration="5"/></trip>
<trip id="back" depart="105" from="c" to="b"/>
<vehicle id="whenever" depart="triggered" route="ab"/>
<flow id="even" begin="200" end="300" number="5" route="ab"/>
<flow id="period" begin="200" period="20" number="3" route="ab"/>
<flow id="hour" begin="200" end="290" vehsPerHour="360" route="ab"/>
<flow id="poisson" begin="0" end="5000" period="exp(0.2)" route="ab"/>
<flow id="chance" begin="0" end="5000" probability="0.1" route="ab"/>
</routes>"""


@pytest.fixture(scope="module")
def sumo(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sumo")
    (folder / "map.net.xml").write_text(NET)
    (folder / "demand.rou.xml").write_text(ROUTES)
    network = read_network(folder / "map.net.xml", cache=False)
    return network, build_lane_map(network), read_demand(folder / "demand.rou.xml", network), folder


def test_sumo_vehicles_trips_and_flows(sumo):
    network, lane_map, demand, _ = sumo
    found = sumo_scenario(network, lane_map, demand, slots=8, begin=0.0, seed=3)
    schedule = jax.tree.map(np.asarray, found.scenario.schedule)
    row = {name: i for i, name in enumerate(found.vehicles)}
    rows, ids = lane_rows(network), lane_ids(network)

    def place(name):
        return ids[schedule.lane[row[name]]], float(schedule.s[row[name]])

    # only buses may use b_1: cars on the left lane of a have to change to the right one, buses to the left
    table = jax.tree.map(np.asarray, found.lane_map.routes)
    goal = schedule.goal
    assert place("one") == ("a_1", 50.0) and schedule.v[row["one"]] == 9.0
    assert table.lanes_to_go[rows["a_1"], goal[row["one"]]] == -1
    assert schedule.driver.speed_factor[row["one"]] == pytest.approx(1.2)
    assert place("two") == ("a_1", 12.0) and goal[row["two"]] != goal[row["one"]]
    assert schedule.v[row["two"]] > 12.0
    assert place("trip") == ("b_0", 80.0)
    assert place("ring")[0] == "a_0" and found.routes[goal[row["ring"]]] == ("a",)
    assert place("back")[0] == "c_0" and found.routes[goal[row["back"]]] == ("b",)
    assert "rider" not in row and "whenever" not in row

    times = {name: sorted(schedule.time[i] for n, i in row.items() if n.startswith(f"{name}."))
             for name in demand.flows}  # fmt: skip
    np.testing.assert_allclose(times["even"], [200, 220, 240, 260, 280])
    np.testing.assert_allclose(times["period"], [200, 220, 240])
    np.testing.assert_allclose(times["hour"], np.arange(200, 290, 10))
    assert stats.kstest(np.diff(times["poisson"]), stats.expon(scale=5.0).cdf).pvalue > 0.01
    assert abs(len(times["chance"]) - 500) < 4 * math.sqrt(500 * 0.9)
    assert all(t % 1 == 0 for t in times["chance"])
    assert found.notes == (
        "1 x departs 'triggered', not at a time; left out ('whenever' first)",
        "1 x vClass 'bicycle' is no motor traffic on roads; left out ('rider' first)",
        "1 x its route visits an edge twice; it takes the shortest way to the last edge ('ring' first)",
        "1 x stops are not made ('trip' first)",
    )
    again = sumo_scenario(network, lane_map, demand, slots=8, begin=0.0, seed=3)
    np.testing.assert_array_equal(schedule.time, np.asarray(again.scenario.schedule.time))


def test_sumo_time_window_and_errors(sumo):
    network, lane_map, demand, folder = sumo
    cut = sumo_scenario(network, lane_map, demand, slots=8, begin=101.0, end=103.5)
    time = np.asarray(cut.scenario.schedule.time)
    assert time[time < NEVER].max() < 2.5 and {"two", "ring"} < set(cut.vehicles)
    assert any("after the scenario ends; left out" in note for note in cut.notes)
    assert any("before the scenario begins; left out" in note for note in cut.notes)
    (folder / "bad.rou.xml").write_text('<routes><trip id="x" type="t" depart="0" from="a" to="b"/></routes>')
    with pytest.raises(MapError, match="vehicle x: no file defines vehicle type 't'"):
        sumo_scenario(network, lane_map, read_demand(folder / "bad.rou.xml"), slots=8)
    (folder / "flow.rou.xml").write_text('<routes><flow id="x" period="9" from="a" to="b"/></routes>')
    with pytest.raises(MapError, match="flow x: it emits vehicles without end"):
        sumo_scenario(network, lane_map, read_demand(folder / "flow.rou.xml"), slots=8)
    with pytest.raises(ValueError, match="no vehicle that departs"):
        sumo_scenario(network, lane_map, demand, slots=8, begin=9000.0)
