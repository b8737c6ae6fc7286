"""Vehicles, obstacles and zones of an experiment: what they do, against closed forms, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pydantic import ValidationError

import limsim_jax as lj
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.sweeps.experiment import ExperimentError, ExperimentFile, first_fault
from limsim_jax.sweeps.script import share_done
from limsim_jax.types import Actions, Order, Progress

HOLD = {"speed": 20.0, "careful": False}


def vehicle(lane, s, *actions, **more):
    given = {"start": "1-", "lane": lane, "s": s, "v": 20.0, "keeps_lane": True, "action": list(actions)}
    return given | more


VEHICLES = [
    # 1: brakes with 5 m/s^2 from 2 s on, for 1.5 s, and is told its speed before and after
    vehicle(0, 100.0, HOLD, {"at": 2.0, "brake": 5.0, "duration": 1.5, "careful": False},
            {"after": 1.5, "speed": 16.0, "rate": 2.0, "careful": False}),
    # 2: changes lanes when it has driven 50 m, in 3 s, while the ego is far behind
    vehicle(1, 300.0, HOLD, {"travelled": 50.0, "change_lane": "left", "duration": 3.0}),
    # 3: leaves when the ego is near
    vehicle(2, 160.0, {"speed": 10.0, "rate": 100.0, "careful": False}, {"within": 40.0, "leave": True}),
    # 4: brakes fully on ice from 4 s on
    vehicle(3, 600.0, HOLD, {"at": 6.0, "brake": 9.0}),
    # 5: follows the same limit as all traffic
    vehicle(0, 900.0),
    # 6: comes up behind the obstacle and minds it; its order holds all the same
    vehicle(1, 500.0, {"speed": 20.0}),
]  # fmt: skip
FILE = {
    "name": "script", "map": "highway", "horizon": 16.0, "slots": 16,
    "ego": {"start": "1-", "lane": 2, "s": 50.0, "v": 25.0, "goal": "2-"},
    "vehicle": VEHICLES,
    "obstacle": [{"start": "1-", "lane": 1, "s": 700.0, "length": 6.0, "until": 12.0}],
    "zone": [
        {"where": "1_0_-3", "friction": 0.2, "begin": 4.0},
        {"where": ["1_0_-6"], "s_from": 880.0, "speed_limit": 12.0, "begin": 1.0, "end": 12.0},
    ],
}  # fmt: skip
STEP = 0.1


@pytest.fixture(scope="module")
def world():
    """One world of the experiment above, every step of it, and its map."""
    experiment = lj.Experiment(ExperimentFile.model_validate(FILE))
    run = experiment.run(0)
    assert run.metrics["actions_begun"] == 1.0
    assert run.episodes is not None
    return run.trace, run.episodes.town


@pytest.mark.engine
def test_vehicles_start_where_and_as_fast_as_the_file_says(world):
    trace, town = world
    for k, table in enumerate(VEHICLES, 1):
        lane = town.network.lanes[town.lane_ids[trace.lane[0, k]]]
        assert lane.number == -6 + table["lane"]
        before = sum(x.length for x in town.network.lanes.values() if x.id in _before(lane.id))
        driven = trace.v[0, k] * STEP
        assert before + trace.s[0, k] == pytest.approx(table["s"] + driven, abs=0.2)
    speeds = [trace.v[0, k] for k in (1, 2, 4, 6)]
    np.testing.assert_allclose(speeds, 20.0, atol=1e-5)


def _before(name):
    """The pieces of a lane before this one."""
    stem, _, number = name.partition("/")
    return [stem if k == 0 else f"{stem}/{k}" for k in range(int(number or 0))]


@pytest.mark.engine
def test_orders_about_speed_follow_their_closed_forms(world):
    trace, _ = world
    time = STEP * np.arange(1, len(trace.v) + 1)
    wanted = np.where(time <= 2.0, 20.0, np.where(time <= 3.5, 20.0 - 5.0 * (time - 2.0), 12.5))
    wanted = np.where(time > 3.5, np.minimum(12.5 + 2.0 * (time - 3.5), 16.0), wanted)
    np.testing.assert_allclose(trace.v[:, 1], wanted, atol=2e-3)
    # 100 m/s^2 are asked for: the tyres give what they can
    assert trace.v[0, 3] == pytest.approx(20.0 - 8.5 * STEP, abs=0.05)


@pytest.mark.engine
def test_a_lane_change_by_order_starts_in_place_and_takes_its_time(world):
    trace, town = world
    moving = np.abs(trace.d[:, 2]) > 1e-3
    lane = np.array([town.network.lanes[town.lane_ids[row]].number for row in trace.lane[:, 2]])
    first, last = np.flatnonzero(moving)[[0, -1]]
    # 50 m at 20 m/s are 2.5 s, and a decision follows within 0.5 s
    assert 24 <= first <= 31
    assert (last - first) * STEP == pytest.approx(3.0, abs=0.25)
    assert set(lane[:first]) == {-5} and set(lane[last + 1 :]) == {-4}


@pytest.mark.engine
def test_a_vehicle_leaves_when_the_ego_is_near(world):
    trace, _ = world
    gone = int(np.argmin(trace.active[:, 3]))
    assert gone > 5 and not trace.active[gone:, 3].any()
    here = np.hypot(*(trace.box[:, 3, :2] - trace.box[:, 0, :2]).T)
    assert here[gone - 1] < 43.0 and (here[: gone - 1] > 39.9).all()


@pytest.mark.engine
def test_ice_limits_braking_and_limits_hold_for_their_time(world):
    trace, _ = world
    a = np.diff(trace.v[:, 4]) / STEP
    np.testing.assert_allclose(a[62:75], -0.2 * 9.81, atol=2e-2)
    free = trace.v[:, 5]
    assert free[8] > free[0]  # it speeds up at first
    assert free[118] == pytest.approx(12.0, abs=0.8)
    assert free[-1] > free[118] + 3.0  # and again after it


@pytest.mark.engine
def test_an_obstacle_stands_until_it_is_taken_away(world):
    trace, _ = world
    assert (trace.v[trace.active[:, 7], 7] == 0).all()
    assert int(np.argmin(trace.active[:, 7])) == pytest.approx(120, abs=2)
    assert trace.v[100:119, 6].min() < 8.0  # the vehicle behind it brakes
    assert not trace.status[trace.active][:].astype(int).__and__(1).any()  # without a contact
    assert trace.box[0, 7, 3] == pytest.approx(6.0)


@pytest.mark.engine
def test_an_experiment_without_a_script_has_the_worlds_of_before():
    plain = Episodes(ExperimentFile.model_validate(_with({})))
    scenario = jax.eval_shape(plain.sample, jax.random.key(0))
    assert scenario.schedule.script is None and scenario.start.script is None


@pytest.mark.engine
def test_other_traffic_keeps_away_from_vehicles_with_a_place():
    file = _with({"traffic": {"vehicles": 12}, "vehicle": [vehicle(k, 150.0) for k in range(4)], "slots": 24})
    episodes = Episodes(ExperimentFile.model_validate(file))
    start = jax.jit(jax.vmap(episodes.sample))(jax.random.split(jax.random.key(0), 16)).start
    lane, s = np.asarray(start.lane), np.asarray(start.s)
    for k in range(1, 5):
        others = (np.arange(24) > 4) & (lane == lane[:, k : k + 1])
        assert (np.abs(s - s[:, k : k + 1])[others] > 10.0).all()
        np.testing.assert_allclose(s[:, k], 150.0)


def test_a_lane_change_that_waits_for_a_lane_is_not_done():
    orders = [int(Order.BRAKE), int(Order.CHANGE_LANE), int(Order.CHANGE_LANE), int(Order.LEAVE)]
    nothing = jnp.zeros(4)
    actions = Actions(
        slot=jnp.zeros(4, jnp.int32), order=jnp.array(orders), value=nothing, rate=nothing, duration=nothing,
        careful=nothing > 0, at=nothing, within=nothing, travelled=nothing, after=nothing,
        before=jnp.zeros(4, jnp.int32),
    )  # fmt: skip
    begun = np.array([[1.0, 2.0, 3.0, np.inf], [1.0, 2.0, 3.0, 4.0]])
    made = np.array([[False, True, False, False], [False, True, True, False]])
    found = share_done(actions, Progress(begun=jnp.asarray(begun), made=jnp.asarray(made)))
    np.testing.assert_allclose(found, [0.5, 1.0])


def _with(more):
    plain = {name: FILE[name] for name in ("name", "map", "horizon", "slots", "ego")}
    return plain | more


def car(**more):
    return {"vehicle": [{"start": "1-", "s": 100.0} | more]}


def action(**more):
    return car(action=[more])


def zone(**more):
    return {"zone": [more]}


WRONG = {
    "two ways": (car(goal="2-", route=["1"]), "goal or route, not both"),
    "a route from anywhere": (
        {"ego": {"route": ["1"]}},
        "ego: an ego with a random start has no goal of its own",
    ),
    "a negative speed": (car(v=-3.0), "vehicle.0.v: Input should be greater than or equal to 0, not -3.0"),
    "no number as speed": (car(v=float("nan")), "vehicle.0.v: Input should be"),
    "a field that is not there": (car(speed=3.0), "vehicle.0.speed: no such field; known are start, lane"),
    "no start": ({"vehicle": [{"s": 100.0}]}, "vehicle.0.start: Field required"),
    "no order": (action(at=3.0), "an action is one of brake, stop, speed, change_lane, leave; here is none"),
    "two orders": (action(brake=3.0, leave=True), "here is brake and leave"),
    "braking that speeds up": (
        action(brake=-3.0),
        "vehicle.0.action.0.brake: Input should be greater than 0",
    ),
    "a time before the start": (action(at=-1.0, stop=True), "action.0.at: Input should be greater than or"),
    "a lane change straight on": (
        action(change_lane="on"),
        "action.0.change_lane: Input should be 'left' or",
    ),
    "a rate without a speed": (action(stop=True, rate=2.0), "rate belongs to speed"),
    "a long leave": (action(leave=True, duration=2.0), "duration has no meaning"),
    "an order that is not there": (action(jump=1.0), "vehicle.0.action.0.jump: no such field; known are at"),
    "an obstacle without a body": (
        {"obstacle": [{"start": "1-", "length": 0.0}]},
        "obstacle.0.length: Input",
    ),
    "a zone without effect": (zone(where="1"), "a zone needs closed, speed_limit or friction"),
    "a work zone for a while": (zone(where="1", closed=True, end=9.0), "closed for the whole episode"),
    "everything closed": (zone(closed=True), "closed needs the lanes or roads, as where"),
    "an end before the begin": (zone(friction=0.5, begin=9.0, end=3.0), "ends at 3 s, but begins at 9 s"),
    "a place that runs back": (
        zone(where="1", friction=0.5, s_from=9.0, s_to=3.0),
        "s_to is 3 m, but s_from",
    ),
    "a place on the whole map": (zone(friction=0.5, s_from=9.0), "s_from and s_to need the lanes or roads"),
    "friction of glue": (zone(friction=5.0), "zone.0.friction: Input should be less than or equal to 2"),
    "no limit at all": (zone(speed_limit=0.0), "zone.0.speed_limit: Input should be greater than 0"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_with_a_table_is_one_line(case):
    more, message = WRONG[case]
    with pytest.raises(ValidationError) as raised:
        ExperimentFile.model_validate(_with(more))
    said = first_fault(raised.value)
    assert message in said and "\n" not in said


MISPLACED = {
    "a route from another road": (
        car(route=["2"]), "vehicle.route: begins with road '2', but the vehicle starts on road '1'",
    ),
    "a route to nowhere": (
        {"map": "intersection", "ego": False, "vehicle": [{"start": "1", "route": ["1", "3"]}]},
        "vehicle.route: no lane from road '1' leads to '3' and on to '3'",
    ),
    "a route over no road": (car(route=["1", "9"]), "vehicle.route: no road '9'"),
    "a route in a circle": (car(route=["1", "2", "1"]), "vehicle.route: visits road '1' twice; once is"),
    "an origin that is not there": (car(start="9-"), "vehicle.start: no origin, road or lane '9-'"),
    "a place beyond the lane": (car(s=9e3), "vehicle.s: 9000 m, but lane '1_0_-6' is only 1531.6 m long"),
    "a lane too many": (car(lane=9), "vehicle.lane: 9, but '1-' has lanes 0 to 3"),
    "a goal that is not there": (car(goal="7"), "vehicle.goal: no goal or lane '7'"),
    "a class that is not there": (car(vehicle="tank"), "vehicle: vehicle class 'tank' is unknown"),
    "a driver's field that is not there": (car(driver={"mood": 1.0}), "vehicle: parameter 'mood' is unknown"),
    "a vehicle on the ego": (car(lane=2, s=52.0), "vehicle.0: overlaps ego.0 at the start"),
    "an obstacle on a vehicle": (
        car() | {"obstacle": [{"start": "1-", "s": 101.0}]}, "obstacle.0: overlaps vehicle.0 at the start",
    ),
    "too many for the slots": (car() | {"slots": 1}, "slots: 1, but 2 vehicles are there at the start"),
    "a road that is not there": (zone(where="77", friction=0.5), "zone.0.where: no road or lane '77'"),
    "a zone beyond its road": (
        zone(where="1", speed_limit=9.0, s_to=9e3), "zone.0.s_to: 9000 m, but road '1' is only",
    ),
    "a zone too short to be one": (
        zone(where="1", closed=True, s_from=700.0, s_to=702.0), "zone.0: from 700 to 702 m there is no lane",
    ),
    "a vehicle on a closed lane": (
        car(start="1_0_-6") | zone(where="1_0_-6", closed=True),
        "vehicle.start: lane '1_0_-6' is no lane to start on",
    ),
}  # fmt: skip


@pytest.mark.engine
@pytest.mark.parametrize("case", MISPLACED)
def test_what_does_not_fit_the_map_is_one_line(case):
    more, message = MISPLACED[case]
    with pytest.raises(ExperimentError) as raised:
        Episodes(ExperimentFile.model_validate(_with(more)))
    assert f"script: {message}" in str(raised.value) and "\n" not in str(raised.value)


def test_one_table_is_a_list_of_one():
    one = {"start": "1-", "s": 100.0, "action": {"at": 3.0, "brake": 5.0}}
    file = ExperimentFile.model_validate(_with({"vehicle": one, "zone": {"friction": 0.3}}))
    assert [x.action[0].brake for x in file.vehicle] == [5.0] and file.zone[0].friction == 0.3


@pytest.mark.engine
def test_a_route_prescribes_the_way_and_leaves_traffic_alone():
    way = ["5", "4", "10", "11", "12", "13", "3", "2"]
    plain = {
        "name": "way",
        "map": "long_route",
        "horizon": 60.0,
        "slots": 16,
        "traffic": {"flow": [{"rate": 300.0}]},
    }
    named = {
        "ego": {"start": "5-", "route": way},
        "vehicle": [{"start": "5-", "lane": 1, "goal": "2"}, {"start": "1", "goal": "4_0_-2"}],
    }
    episodes = Episodes(ExperimentFile.model_validate(plain | named))
    names = list(episodes.town.goals)
    assert driven(episodes, "5_0_-2", names.index(" > ".join(way))) == way
    assert driven(episodes, "5_0_-2", names.index("2")) == ["5", "2"]
    # traffic has the destinations that it has without them
    before = Episodes(ExperimentFile.model_validate(plain | {"ego": False}))._demand
    np.testing.assert_array_equal(episodes._demand.goals, before.goals)


def driven(episodes, lane, goal):
    """The roads from a lane to a goal by the tables, without the connectors of junctions."""
    lanes, routes = episodes.network.lanes, episodes.lane_map.routes
    ids, found = episodes.town.lane_ids, []
    while lane is not None:
        if lanes[lane].junction is None and lanes[lane].road not in found:
            found.append(lanes[lane].road)
        row = ids.index(lane)
        following, aside = int(routes.next_lane[row, goal]), int(routes.lanes_to_go[row, goal])
        if routes.is_goal[row, goal]:
            lane = None
        elif following >= 0:
            lane = ids[following]
        else:
            lane = lanes[lane].left if aside > 0 else lanes[lane].right
    return found


@pytest.mark.engine
def test_a_road_block_is_no_way_in_or_out():
    blocked = {"where": "1", "s_from": 400.0, "s_to": 500.0, "closed": True}
    with pytest.raises(ExperimentError, match=r"'2-' cannot be reached from lane '.*'; .* to nowhere"):
        Episodes(ExperimentFile.model_validate(_with({"zone": [blocked]})))
    experiment = ExperimentFile.model_validate(
        _with({"ego": False, "traffic": {"vehicles": 5}, "zone": [blocked]})
    )
    town = Episodes(experiment).town
    assert set(town.goals) == {"1+", "2-"} and set(town.origins) == {"1-", "2+"}


@pytest.mark.engine
def test_a_speed_in_km_per_hour_is_doubted():
    with pytest.warns(UserWarning, match=r"vehicle\.0\.action\.0\.speed: 120 m/s, but the highest limit"):
        Episodes(ExperimentFile.model_validate(_with(action(speed=120.0))))
