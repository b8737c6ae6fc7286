"""SUMO's vehicles, trips and flows as a scenario."""

import dataclasses
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from paths import SHARED, needs_shared
from scipy import stats

from limsim_jax.maps import read_network
from limsim_jax.maps.lane_map import lane_ids, lane_rows
from limsim_jax.maps.network import MapError
from limsim_jax.maps.rasterise import build_lane_map
from limsim_jax.maps.sumo import read_demand
from limsim_jax.traffic.demand import (
    NEVER,
    enter,
)
from limsim_jax.traffic.demand.sumo import sumo_scenario
from limsim_jax.types import Config

pytestmark = pytest.mark.engine

CONFIG = Config(dt=0.1)
let_in = jax.jit(enter, static_argnums=0)


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
    """All vehicles depart in time on the first edge of their routes; notes say what is not used."""
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
