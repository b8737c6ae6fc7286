"""SUMO's vehicles as the traffic of an experiment."""

import warnings

import jax
import numpy as np
import pytest
from paths import SHARED, needs_shared

import limsim_jax as lj
from limsim_jax.maps.sumo import read_demand
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.sweeps.experiment import ExperimentError, read_experiments
from limsim_jax.sweeps.sumo import AFTERWARDS
from limsim_jax.traffic.demand import NEVER
from limsim_jax.traffic.demand.sumo import sumo_scenario

NET = """<net version="1.20">
<edge id="a" from="x" to="y"><lane id="a_0" index="0" speed="14" length="200" shape="0,0 200,0"/>
<lane id="a_1" index="1" speed="14" length="200" shape="0,3.2 200,3.2"/></edge>
<edge id=":y_0" function="internal"><lane id=":y_0_0" index="0" speed="14" length="10"
 shape="200,0 210,0"/></edge>
<edge id=":y_1" function="internal"><lane id=":y_1_0" index="0" speed="14" length="10"
 shape="200,3.2 210,3.2"/></edge>
<edge id="b" from="y" to="z"><lane id="b_0" index="0" speed="14" length="190" shape="210,0 400,0"/></edge>
<edge id="c" from="y" to="w"><lane id="c_0" index="0" speed="14" length="90" shape="210,3.2 300,3.2"/></edge>
<junction id="y" type="traffic_light" x="205" y="0" incLanes="a_0 a_1" intLanes=":y_0_0 :y_1_0"
 shape="200,-2 210,-2 210,5 200,5">
<request index="0" response="00" foes="00" cont="0"/><request index="1" response="00" foes="00" cont="0"/>
</junction>
<tlLogic id="y" type="static" programID="0" offset="0"><phase duration="10" state="GG"/></tlLogic>
<connection from="a" to="b" fromLane="0" toLane="0" via=":y_0_0" tl="y" linkIndex="0" dir="s" state="O"/>
<connection from="a" to="c" fromLane="1" toLane="0" via=":y_1_0" tl="y" linkIndex="1" dir="s" state="O"/>
<connection from=":y_0" to="b" fromLane="0" toLane="0" dir="s" state="M"/>
<connection from=":y_1" to="c" fromLane="0" toLane="0" dir="s" state="M"/>
</net>"""

PLANNED = """<routes><vType id="slow" maxSpeed="9"/>
<route id="ab" edges="a b"/><route id="ac" edges="a c"/>
<vehicle id="one" depart="103" route="ac" departLane="1" departSpeed="9"/>
<vehicle id="two" type="slow" depart="101" route="ab" departSpeed="max"/>
<flow id="even" begin="105" end="125" number="4" route="ab" departPos="30"/>
</routes>"""

DRAWN = """<routes><vTypeDistribution id="any"><vType id="car"/><vType id="lorry" vClass="truck"/>
</vTypeDistribution>
<routeDistribution id="way"><route id="ab" edges="a b"/><route id="ac" edges="a c"/></routeDistribution>
<flow id="some" type="any" begin="100" end="130" probability="0.3" route="way"/>
</routes>"""

PROGRAM = """<additional><tlLogic id="y" type="static" programID="1" offset="0">
<phase duration="8" state="rG"/><phase duration="4" state="Gr"/></tlLogic></additional>"""

CONFIG = """<configuration><input><net-file value="town.net.xml"/><route-files value="cars.rou.xml"/>
<additional-files value="lights.add.xml"/></input><time><begin value="100"/>{end}</time></configuration>"""


@pytest.fixture
def folder(tmp_path):
    files = {"town.net.xml": NET, "cars.rou.xml": PLANNED, "drawn.rou.xml": DRAWN, "lights.add.xml": PROGRAM}
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "morning.sumocfg").write_text(CONFIG.format(end='<end value="160"/>'))
    return tmp_path


@pytest.fixture
def experiment(folder):
    def experiment(traffic, rest="map = 'town.net.xml'\nego = false"):
        (folder / "mine.toml").write_text(f"horizon = 60.0\n{rest}\n[traffic]\n{traffic}")
        return read_experiments(folder / "mine.toml")[0]

    return experiment


def departures(episodes, seed):
    """Time and lane of every departure, and the table of all."""
    found = jax.jit(episodes.sample)(jax.random.key(seed)).schedule
    due = np.asarray(found.time) < NEVER / 2
    return sorted(zip(found.time[due].tolist(), found.lane[due].tolist(), strict=True)), found


def test_a_configuration_is_an_experiment(folder):
    (found,) = read_experiments(folder / "morning.sumocfg")
    assert (found.name, found.horizon, found.ego, found.slots) == ("morning", 60.0, (), 64)
    assert found.map.endswith("town.net.xml")
    (folder / "morning.sumocfg").write_text(CONFIG.format(end=""))
    assert read_experiments(folder / "morning.sumocfg")[0].horizon == 125 - 100 + AFTERWARDS
    (folder / "mine.toml").write_text('horizon = 9.0\nego = false\n[traffic]\ndemand = "morning.sumocfg"')
    assert read_experiments(folder / "mine.toml")[0].map.endswith("town.net.xml")


def test_keywords_name_a_demand(folder, monkeypatch):
    monkeypatch.chdir(folder)
    found = lj.Experiment(map="town.net.xml", demand="cars.rou.xml", begin=100, ego=None, horizon=9).file
    assert found.traffic.demand == [str(folder / "cars.rou.xml")] and found.traffic.begin == 100.0
    assert lj.Experiment("morning.sumocfg").file.horizon == 60.0
    assert lj.Experiment(demand="morning.sumocfg", ego=None, horizon=9).map.name == "town"
    with pytest.raises(ExperimentError, match="traffic: demand brings vehicles and drivers of its own"):
        lj.Experiment("morning.sumocfg", vehicles=9)


@pytest.mark.engine
def test_vehicles_of_the_files_depart_in_every_world(folder, experiment):
    episodes = Episodes(experiment('demand = "cars.rou.xml"\nbegin = 100'), chunk=1)
    town = episodes.town
    plain = sumo_scenario(
        town.network, town.lanes, read_demand(folder / "cars.rou.xml"), slots=8, begin=100
    ).scenario.schedule
    due = np.asarray(plain.time) < NEVER / 2
    expected = sorted(zip(plain.time[due].tolist(), plain.lane[due].tolist(), strict=True))
    (first, one), (second, other) = (departures(episodes, seed) for seed in (0, 1))
    assert first == second == expected and len(first) == 6
    assert first[0][0] == 1 and sum(first[k][0] >= 5 for k in range(6)) == 4
    assert not np.array_equal(one.driver.speed_factor, other.driver.speed_factor)
    # every vehicle knows its way: the goals of the map come first
    routes = episodes.lane_map.routes
    assert np.asarray(one.goal)[due].min() >= town.lanes.routes.distance.shape[1]
    assert np.asarray(routes.reachable)[np.asarray(one.lane)[due], np.asarray(one.goal)[due]].all()


@pytest.mark.engine
def test_what_sumo_leaves_to_chance_differs_by_seed(experiment):
    episodes = Episodes(experiment('demand = "drawn.rou.xml"'), chunk=1)
    assert episodes.worlds.names[0] is None  # a program that calls the host is not kept
    found = [departures(episodes, seed) for seed in range(6)]
    assert found[0][0] == departures(episodes, 0)[0]
    assert len({str(times) for times, _ in found}) == 6
    lengths = np.concatenate([x.shape.length[np.asarray(x.time) < NEVER / 2] for _, x in found])
    goals = np.concatenate([x.goal[np.asarray(x.time) < NEVER / 2] for _, x in found])
    assert len(set(goals.tolist())) == 2 and len(set(lengths.tolist())) == 2
    assert 6 * 30 * 0.3 - 25 < len(goals) < 6 * 30 * 0.3 + 25
    for _, x in found:  # in queues, by time
        for a, b in zip(x.start[:-1], x.start[1:], strict=True):
            assert (np.diff(x.time[a:b]) >= 0).all() and len(set(x.lane[a:b].tolist())) <= 1


@pytest.mark.engine
def test_programs_of_lights_come_with_the_demand(folder):
    (experiment,) = read_experiments(folder / "morning.sumocfg")
    by_keywords = lj.Experiment(
        map=lj.load_map(folder / "town.net.xml"), demand=folder / "morning.sumocfg", ego=None, horizon=60
    )
    for episodes in (Episodes(experiment, chunk=1), by_keywords.episodes(chunk=1)):
        _are_those_of_the_demand(episodes)


def _are_those_of_the_demand(episodes):
    row = list(episodes.network.programs).index("y")
    assert float(episodes.lane_map.signals.cycle[row]) == 12.0
    assert float(episodes.lane_map.signals.offset[row]) == -100 % 12  # the clock is that of the files


@pytest.mark.engine
def test_an_ego_drives_among_them(experiment):
    ego = "map = 'town.net.xml'\n[ego]\nstart = 'a'\ns = 20.0\nlane = 1\ngoal = 'b'"
    found = experiment('demand = "cars.rou.xml"\nbegin = 100', ego)
    row = Episodes(found, chunk=2).run([0, 1]).metrics
    assert row["arrived"].tolist() == [1, 1] and row["traffic_entered"].tolist() == [7, 7]
    assert row["traffic_left"].tolist() == [7, 7] and row["traffic_collided"].tolist() == [0, 0]


@pytest.mark.parametrize(
    ("traffic", "ego", "message"),
    [
        ('demand = "cars.rou.xml"\nvehicles = 3', "false", "traffic: demand brings vehicles and drivers"),
        ("begin = 3", "false", "traffic: begin is a time of SUMO's files; there is no demand"),
        ('demand = "bars.rou.xml"', "false", "bars.rou.xml"),
        ('demand = "cars.rou.xml"', '{start = "random"}', "ego.start: a random start needs a vehicle at"),
        ('demand = "cars.rou.xml"\nbegin = 900', "false", "no vehicle that departs"),
        ('demand = "other.rou.xml"', "false", "other.rou.xml.*edge 'q'"),
        ('demand = "bad.sumocfg"', "false", "bad.sumocfg"),
        ("demand = 3", "false", "traffic.demand: Input should be a valid list, not 3"),
    ],
)
@pytest.mark.engine
def test_what_is_wrong_is_one_line(folder, experiment, traffic, ego, message):
    (folder / "other.rou.xml").write_text('<routes><trip id="x" depart="0" from="q" to="b"/></routes>')
    (folder / "bad.sumocfg").write_text(CONFIG.format(end="").replace("cars", "bars"))
    with pytest.raises(ExperimentError, match=message) as caught, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        Episodes(experiment(traffic, f"map = 'town.net.xml'\nego = {ego}"), chunk=1)
    assert "\n" not in str(caught.value) and "mine" in str(caught.value)


@needs_shared
@pytest.mark.engine
def test_real_configurations_are_experiments():
    for name, horizon in (("ingolstadt1/ingolstadt1", 3600.0), ("bologna_pasubio/run", None)):
        (found,) = read_experiments(SHARED / "sumo" / f"{name}.sumocfg")
        assert found.slots > 64 and horizon in (None, found.horizon)
