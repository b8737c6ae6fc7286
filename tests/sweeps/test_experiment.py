"""Experiment files: what they say, and what is said of wrong ones. Nothing here compiles a world."""

import re

import jax
import numpy as np
import pytest
from paths import REPO
from traffic_worlds import bundled

from limsim_jax.cli import common
from limsim_jax.maps import bundled_maps
from limsim_jax.maps.lane_map import lane_ids
from limsim_jax.policies import POLICIES
from limsim_jax.policies.base import build_policy
from limsim_jax.sweeps.build import plain_demand
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.sweeps.experiment import ExperimentError, bundled_experiments, read_experiments
from limsim_jax.sweeps.identity import describe

pytestmark = pytest.mark.engine

GOOD = """
map = "intersection"
horizon = 20.0
slots = 32
[ego]
start = "6-"
s = 60.0
goal = "2"
[traffic]
vehicles = 6
[[traffic.flow]]
rate = 300
"""


@pytest.fixture
def write(tmp_path):
    def write(text: str, name: str = "mine.toml"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


def test_bundled_experiments_are_the_paper_s_five():
    known = bundled_experiments()
    assert set(known) == {"highway", "ramp", "intersection", "roundabout", "long_route", "paper", "town"}
    assert known["paper"].parent == REPO / "experiments"
    paper = read_experiments("paper")
    assert [one.name for one in paper] == ["highway", "ramp", "intersection", "roundabout", "long_route"]
    assert all(one.map == one.name and one.policy == "like_traffic" for one in paper)


@pytest.mark.parametrize("name", ["highway", "ramp", "intersection"])
def test_the_ego_starts_where_the_file_says_and_nobody_is_on_top_of_it(name):
    (experiment,) = read_experiments(name)
    episodes = Episodes(experiment)
    network, _ = bundled(name)
    scenario = jax.jit(jax.vmap(episodes.sample))(jax.random.split(jax.random.key(1), 8))
    start = jax.device_get(scenario.start)
    ids = lane_ids(network)
    lane = network.lanes[ids[start.lane[0, 0]]]
    assert lane.road == experiment.ego[0].start.rstrip("+-")
    assert (start.egos.slot == 0).all() and start.active[:, 0].all()
    np.testing.assert_allclose(start.s[:, 0], experiment.ego[0].s, rtol=1e-6)
    assert (start.v[:, 0] > 3).all(), "it starts in motion"
    same = start.active[:, 1:] & (start.lane[:, 1:] == start.lane[:, :1])
    front, rear = start.s[:, 1:], start.s[:, 1:] - start.shape.length[:, 1:]
    apart = (rear > start.s[:, :1] + 9.9) | (front < start.s[:, :1] - start.shape.length[:, :1] - 9.9)
    assert apart[same].all(), "others keep off"
    assert same.any() or name != "highway", "though they are on the same lane"
    assert len({float(x) for x in start.v.sum(-1)}) == 8, "worlds differ"
    assert (start.active.sum(-1) == (experiment.traffic.vehicles or 0) + 1).all()


def test_an_ego_with_a_random_start_is_elsewhere_in_every_world(write):
    text = GOOD.replace('start = "6-"\ns = 60.0\ngoal = "2"', 'start = "random"')
    (experiment,) = read_experiments(write(text))
    episodes = Episodes(experiment)
    start = jax.device_get(jax.jit(jax.vmap(episodes.sample))(jax.random.split(jax.random.key(1), 8)).start)
    assert len({(int(a), float(b)) for a, b in zip(start.lane[:, 0], start.s[:, 0], strict=True)}) == 8
    assert (start.active.sum(-1) == 6).all(), "the ego is one of those at the start"
    assert (start.shape.length[:, 0] == start.shape.length[0, 0]).all(), "but always the same car"


def test_other_map_and_policy(write):
    path = write(
        GOOD.replace('goal = "2"', 'goal = "2"\noptions = { speed = 3.0 }\npolicy = "constant_speed"')
    )
    (experiment,) = read_experiments(path)
    assert (experiment.policy, experiment.ego[0].options) == ("constant_speed", {"speed": 3.0})
    (other,) = read_experiments(path, policy="like_traffic", map_file="roundabout")
    assert (other.policy, other.ego[0].options, other.map) == ("like_traffic", {}, "roundabout")
    (same,) = read_experiments(path, policy="constant_speed")
    assert same.ego[0].options == {"speed": 3.0}
    (own,) = read_experiments(path, policy="limsim_jax.policies.simple:ConstantSpeed")
    assert own.policy == "ConstantSpeed" and Episodes(own).policy == "ConstantSpeed"


WRONG = {  # what to replace, by what, and the message
    "a mistyped field that is needed": (
        "horizon =",
        "horizn =",
        "horizn: no such field; known are name, map, horizon",
    ),
    "an unknown field": ("slots = 32", "slotz = 32", "slotz: no such field; known are name, map, horizon"),
    "an unknown field in a table": ("rate = 300", "rate = 300\nspede = 3", "traffic.flow.0.spede: no such"),
    "a missing field": ("horizon = 20.0\n", "", "horizon: Field required"),
    "a wrong type": ("horizon = 20.0", 'horizon = "20 s"', "horizon: .*number, not '20 s'"),
    "a horizon of nothing": ("horizon = 20.0", "horizon = 0.0", "horizon: .*greater than 0, not 0.0"),
    "an infinite rate": ("rate = 300", "rate = inf", "traffic.flow.0.rate: .*finite"),
    "a negative rate": (
        "rate = 300",
        "rate = -5",
        "rate: .*greater than or equal to 0, not -5",
    ),
    "no such map": ('"intersection"', '"nowhere"', "map: .*nowhere.*bundled maps are highway"),
    "no such goal": ('goal = "2"', 'goal = "99"', "ego.goal: no goal or lane '99'; goals are 2, 4"),
    "a goal that is not reached": (
        'goal = "2"',
        'goal = "6+"',
        "ego.goal: '6\\+' cannot be reached",
    ),
    "no goal": ('goal = "2"', "", "ego: a goal is missing"),
    "no such start": (
        'start = "6-"',
        'start = "x"',
        "no origin, road or lane 'x'; origins are 1, 3",
    ),
    "a lane too many": ("s = 60.0", "s = 60.0\nlane = 7", "ego.lane: 7, but '6-' has lanes 0 to 1"),
    "a place beyond the lane": ("s = 60.0", "s = 6000.0", "ego.s: 6000 m, but lane '6_0_-2' is only 20"),
    "too few slots": ("slots = 32", "slots = 4", "slots: 4, but 7 vehicles are there at the start"),
    "no such policy": (
        'goal = "2"',
        'goal = "2"\npolicy = "best"',
        "ego.policy: unknown policy 'best'",
    ),
    "no such module": (
        'goal = "2"',
        'goal = "2"\npolicy = "no_such:thing"',
        "'no_such:thing' cannot be",
    ),
    "a wrong option": (
        'goal = "2"',
        'goal = "2"\npolicy = "constant_speed"\noptions = { speed = -1.0 }',
        "ego.options: speed: -1.0 m/s",
    ),
    "no such option": (
        'goal = "2"',
        'goal = "2"\npolicy = "constant_speed"\noptions = { sped = 1.0 }',
        "ego.options: sped: no such option; there are speed",
    ),
    "no such option of the planner around": (
        'goal = "2"',
        'goal = "2"\npolicy = "area_of_interest"\noptions = { options = { share = 1.0 } }',
        "ego.options: share: no such option; there are .*search",
    ),
    "no such metric": (
        "horizon = 20.0",
        "horizon = 20.0\nsuccess = { goodness = 1 }",
        "success.goodness: no such",
    ),
    "no such driver": ('goal = "2"', 'goal = "2"\ndriver = { tau = 1.0 }', "ego: .*'tau'"),
    "no such origin": ("rate = 300", 'rate = 300\norigin = "77"', "traffic: .*'77'"),
    "two numbers of vehicles": (
        "vehicles = 6",
        "vehicles = 6\ndensity = 2.0",
        "vehicles or density",
    ),
    "no such number of human drivers": (
        "vehicles = 6",
        "vehicles = 6\nhuman = { delay = 0.5 }",
        "traffic.human.delay: no such field; known are reaction",
    ),
    "a reaction time of minutes": (
        "vehicles = 6",
        "vehicles = 6\nhuman = { reaction = 60.0 }",
        "traffic.human.reaction = 60.0: must be 0 to 5.0",
    ),
    "no TOML": ("slots = 32", "slots = = 32", "not valid TOML"),
}


@pytest.mark.parametrize("old, new, message", WRONG.values(), ids=WRONG)
def test_what_is_wrong_is_named_in_one_line(write, old, new, message):
    assert old in GOOD
    path = write(GOOD.replace(old, new))
    with pytest.raises(ExperimentError, match=message) as caught:
        for experiment in read_experiments(path):
            Episodes(experiment)
    text = str(caught.value)
    assert "\n" not in text and "mine" in text


def test_a_folder_is_no_experiment_and_hides_none(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("roundabout", "mine"):
        (tmp_path / name).mkdir()
    assert read_experiments("roundabout")[0].name == "roundabout"
    assert common.path("roundabout") == bundled_maps()["roundabout"]
    with pytest.raises(ExperimentError, match="mine: no such file, and no bundled experiment"):
        read_experiments("mine")


def test_worlds_of_a_map_that_was_edited_start_by_a_program_of_their_own(write, tmp_path):
    """A program that is kept on disk has the map that worlds are drawn on in it."""
    source = bundled_maps()["roundabout"].read_text()
    names = []
    for limit in ("45", "25"):
        (tmp_path / "town.xodr").write_text(re.sub(r'max="[0-9.]*" unit=', f'max="{limit}" unit=', source))
        (experiment,) = read_experiments(write('map = "town.xodr"\nhorizon = 9.0\nego = false'))
        names.append(Episodes(experiment, chunk=2).worlds.names)
    one, other = names
    assert one[1:] == other[1:] and None not in one and one.sampling != other.sampling


def test_worlds_that_end_at_a_contact_are_measured_by_a_program_of_their_own(write):
    """That program sees which worlds are over; all others have no such array."""
    names = {}
    for after in ("stop", "end", "continue"):
        text = f'horizon = 1.0\nslots = 8\n[traffic]\nvehicles = 4\nafter_collision = "{after}"'
        (experiment,) = read_experiments(write(f'map = "roundabout"\nego = false\n{text}'))
        episodes = Episodes(experiment, chunk=2)
        assert episodes.run([1, 2]).metrics["traffic_entered"].tolist() == [4, 4]
        names[after] = episodes.worlds._look_name
    assert names["stop"] == names["continue"] != names["end"] and None not in names.values()


WITHOUT_WAY_OUT = """<net version="1.20">
<edge id="a" from="1" to="2"><lane id="a_0" index="0" speed="14" length="100" shape="0,0 100,0"/></edge>
<edge id="b" from="2" to="3"><lane id="b_0" index="0" speed="14" length="90" shape="100,0 190,0"/></edge>
<edge id="d" from="4" to="5"><lane id="d_0" index="0" speed="14" length="80" shape="0,50 80,50"/></edge>
<edge id="r" from="5" to="6"><lane id="r_0" index="0" speed="9" length="120" shape="80,50 200,50"/></edge>
<edge id="s" from="6" to="5">
<lane id="s_0" index="0" speed="9" length="220" shape="200,50 200,100 80,100 80,50"/></edge>
<connection from="a" to="b" fromLane="0" toLane="0" dir="s" state="M"/>
<connection from="d" to="r" fromLane="0" toLane="0" dir="s" state="M"/>
<connection from="r" to="s" fromLane="0" toLane="0" dir="s" state="M"/>
<connection from="s" to="r" fromLane="0" toLane="0" dir="s" state="M"/></net>"""


def test_flows_of_a_whole_map_come_where_a_way_leads_out(write):
    write(WITHOUT_WAY_OUT, "town.net.xml")
    text = 'map = "town.net.xml"\nhorizon = 9.0\nego = false\n[[traffic.flow]]\nrate = 300\n'
    (experiment,) = read_experiments(write(text))
    episodes = Episodes(experiment, chunk=1)
    assert set(episodes.town.origins) == {"a", "d"}
    assert [flow.origin for flow in episodes.flows] == ["a"]
    town = episodes.town
    plain_demand(town.network, town.lanes, rate=100, vehicles=0, seconds=9)
    (experiment,) = read_experiments(write(text + 'origin = "d"\n'))
    with pytest.raises(ExperimentError, match="flow 0 from 'd': it can reach none of the goals 'b'"):
        Episodes(experiment, chunk=1)


def test_lists_of_experiments(write):
    write(GOOD, "one.toml")
    write(GOOD.replace("20.0", "30.0"), "two.toml")
    both = read_experiments(write('experiments = ["one.toml", "two.toml"]', "both.toml"))
    assert [(one.name, one.horizon) for one in both] == [("one", 20.0), ("two", 30.0)]
    with pytest.raises(ExperimentError, match="two experiments are named 'one'"):
        read_experiments(write('experiments = ["one.toml", "one.toml"]', "twice.toml"))
    with pytest.raises(ExperimentError, match=r"next to 'experiments'.*not horizon"):
        read_experiments(write('experiments = ["one.toml"]\nhorizon = 2.0', "more.toml"))
    with pytest.raises(ExperimentError, match="no such file, and no bundled experiment"):
        read_experiments("nothing_of_the_kind")


@pytest.mark.parametrize(
    ("policy", "options", "asks"),
    [
        ("like_traffic", "", False),
        ("limsim_tm", "options = { simulations = 20 }", False),
        ("area_of_interest", 'options = { around = "limsim_tm", radius = 40 }', False),
        ("language", "", True),
        ("delayed", 'options = { of = "language" }', True),
        ("delayed", 'options = { options = { memory = ["mine:factory"] } }', True),
        ("package.module:factory", "", True),
    ],
)
def test_which_policies_may_ask_the_host_is_known_from_their_names(write, policy, options, asks):
    (one,) = read_experiments(write(GOOD.replace("[ego]", f'[ego]\npolicy = "{policy}"\n{options}')))
    assert one.asks_host == asks


def test_a_demand_of_sumo_asks_the_host():
    (one,) = read_experiments("highway")
    assert not one.asks_host
    traffic = one.traffic.model_copy(update={"demand": ["a.rou.xml"]})
    assert one.model_copy(update={"traffic": traffic}).asks_host


def test_policies_in_jax_never_ask_the_host():
    """What `ExperimentFile.asks_host` takes for granted of all names but one."""
    for name, factory in POLICIES.items():
        if name != "language":
            assert "HostPolicy" not in str(describe(build_policy(factory, {}))), name
