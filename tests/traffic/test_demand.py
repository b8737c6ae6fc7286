"""Demand: arrivals, goals, classes, vehicles at the start."""

import dataclasses
import functools
import math
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from synthetic import network as network_of
from synthetic import straight
from traffic_worlds import bundled, demand_of, drivers, overlap

from limsim_jax.maps.lane_map import NO_LANE, VEHICLE_CLASSES, lane_ids, lane_rows
from limsim_jax.maps.origins import origins
from limsim_jax.maps.rasterise import build_lane_map
from limsim_jax.maps.routing import default_goals
from limsim_jax.traffic.car_following import safe_speed
from limsim_jax.traffic.demand import (
    CHANGE_ROOM,
    CHANGE_TIME,
    NEVER,
    Flow,
    build_demand,
    overflow,
    sample_scenario,
)
from limsim_jax.traffic.motion import boxes
from limsim_jax.traffic.vehicles import default_population, uniform_population
from limsim_jax.types import Config

pytestmark = pytest.mark.engine

CONFIG = Config(dt=0.1)
CARS = uniform_population()


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
    demand = demand_of(name, [flow], **kwargs)
    times = np.asarray(worlds(demand, bundled(name)[1], keys(n), 8, time_of))
    stop = int(demand.start[1])
    return [row[row < NEVER] for row in times[:, :stop]], demand


# --- origins ----------------------------------------------------------------------------------------


def test_origins_are_the_ways_into_the_bundled_maps():
    count = {name: {k: len(v) for k, v in origins(bundled(name)[0]).items()} for name in ("highway", "ramp")}
    assert count == {"highway": {"1-": 4, "2+": 4}, "ramp": {"1": 3, "4": 3, "5": 1}}
    # of the four arms of the intersection two lanes each; the pockets that begin later are no origins
    assert [len(lanes) for lanes in origins(bundled("intersection")[0]).values()] == [2, 2, 2, 2]
    for name in ("intersection", "roundabout", "long_route"):
        network, _ = bundled(name)
        for lanes in origins(network).values():
            assert all(not network.lanes[lane].predecessors for lane in lanes)
            assert all(network.lanes[lane].junction is None for lane in lanes)


# --- arrivals ---------------------------------------------------------------------------------------


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
    demand = demand_of("highway", [Flow(origin="1_0_-3", rate=200.0), Flow(origin="1_0_-5", rate=200.0)])
    more = dataclasses.replace(demand, idle=demand.idle.at[1].mul(0.5))
    told = jax.jit(jax.vmap(overflow, (None, 0)))
    assert not np.asarray(told(demand, keys(64))).any()
    assert np.asarray(told(more, keys(64))).all()


def test_flows_that_share_a_lane_share_its_queue():
    flows = [
        Flow(origin="1_0_-3", rate=300.0, end=600.0, speed=20.0),
        Flow(origin="1-", rate=800.0, pattern="uniform", speed=25.0),
    ]
    demand = demand_of("highway", flows, horizon=1200.0)
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
    one = demand_of("highway", [flow], default_population(), horizon=60.0)
    more = demand_of("highway", [flow, Flow(origin="1_0_-6", rate=150.0)], default_population(), horizon=60.0)
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


# --- goals and classes ------------------------------------------------------------------------------


def test_turning_ratios_and_classes():
    """Chi-square tests of drawn goals and classes; no vehicle gets a goal that it cannot reach."""
    network, lane_map = bundled("intersection")
    goals = list(default_goals(network))
    shares = {goals[3]: 1.0, goals[1]: 3.0, goals[2]: 6.0}
    classes = {"car": 5.0, "bus": 2.0, "motorcycle": 3.0}
    flow = Flow(origin="1", rate=1500.0, goal=shares, classes=classes)
    demand = demand_of("intersection", [flow], default_population(), horizon=600.0)
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


# --- the start --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "density"), [("roundabout", 24.0), ("ramp", 30.0)])
def test_vehicles_at_the_start(name, density):
    """No vehicles overlap, all can reach their goals, follow and stop."""
    network, lane_map = bundled(name)
    flows = [Flow(origin=list(origins(network)), rate=600.0)]
    demand = demand_of(name, flows, default_population(), horizon=60.0, density=density)
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
        # followers can stop behind their leaders: v T + v^2 / 2 b <= gap - s0 + v_lead^2 / 2 b
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


def test_demands_of_different_size_share_shapes_on_request():
    """Vehicles at the start are as many as were asked for; their other slots are empty."""
    network, lane_map = bundled("intersection")
    least = {"streams": 16, "origins": 16, "rows": 1024, "arrivals": 192, "seats": 128, "vehicles": 24}
    made = [
        build_demand(
            network,
            lane_map,
            default_goals(network),
            [Flow(origin=list(origins(network))[:count], rate=100.0 * count)],
            CARS,
            horizon=60.0,
            vehicles=3 * count,
            least=least,
        )
        for count in (1, 4)
    ]
    assert len({str(jax.tree.map(np.shape, demand)) for demand in made}) == 1
    for demand, vehicles in zip(made, (3, 12), strict=True):
        state = worlds(demand, lane_map, keys(3), 32, start_part)
        assert np.asarray(state.active).sum(1).tolist() == [vehicles] * 3
        assert (np.asarray(state.lane)[~np.asarray(state.active)] == NO_LANE).all()
        assert np.isfinite(np.asarray(state.v)).all()
    with pytest.raises(KeyError, match="no table 'places'"):
        build_demand(network, lane_map, default_goals(network), [], CARS, horizon=1.0, least={"places": 1})


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


# --- errors -----------------------------------------------------------------------------------------


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
        demand_of("intersection", [Flow(**{"origin": "1", "rate": 100.0} | flow)])
    assert "\n" not in str(error.value) and "flow 0" in str(error.value)


def test_other_demands_that_make_no_sense():
    network, lane_map = bundled("highway")
    with pytest.raises(ValueError, match=r"flow 0 from '1-': no way to goal '1\+'; it can reach '2-'"):
        demand_of("highway", [Flow(origin="1-", rate=1.0, goal="1+")])
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
        demand_of("intersection", [Flow(origin=inside, rate=1.0)])
    with pytest.raises(ValueError, match=r"density = 500 veh/km puts 12\d\d\d vehicles .* only \d+ places"):
        demand_of("highway", [], density=500.0)
    with pytest.raises(ValueError, match="density = -1"):
        demand_of("highway", [], density=-1.0)
    with pytest.raises(ValueError, match="horizon = 0 s"):
        demand_of("highway", [], horizon=0.0)
    with pytest.raises(ValueError, match="is not number 0 of the lane map"):
        goals = dict(reversed(default_goals(network).items()))
        build_demand(network, lane_map, goals, [], CARS, horizon=60.0)
    demand = demand_of("highway", [], density=5.0)
    with pytest.raises(ValueError, match=f"{demand.initial} vehicles at the start do not fit into 20 slots"):
        sample_scenario(demand, lane_map, jax.random.key(0), 20)
