"""Maps of short lanes: short roads between junctions, connectors in pieces."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import arc, lane_along, network, straight
from traffic_worlds import bundled, drivers, shapes

from limsim_jax.geometry import box_separation
from limsim_jax.maps.lane_map import lane_rows
from limsim_jax.maps.network import ImportReport
from limsim_jax.maps.rasterise import build_lane_map
from limsim_jax.metrics.record import conflict_zones
from limsim_jax.traffic.bodies import tails
from limsim_jax.traffic.command import Command
from limsim_jax.traffic.engine import Traffic, _until_changed, drive
from limsim_jax.traffic.lane_change import place_beside
from limsim_jax.traffic.motion import advance, boxes
from limsim_jax.traffic.state import start_state
from limsim_jax.types import Config

pytestmark = pytest.mark.engine

CUT = 10.0  # m of the turn in its first piece: it has parted from the straight way by 0.8 m there


@functools.cache
def town(pieces: int = 5):
    """Two lanes, 2 m of road, a junction with a turn of two pieces, and roads of 1 m after it."""
    turn = arc("turn", (102.0, 60.0), 60.0, -math.pi / 2, 0.7)
    cut = np.linspace(0, CUT, 60), np.linspace(CUT, turn.length, 200)
    first, second = (turn.pose(s)[0] for s in cut)
    x, y = second[-1][:2]
    lanes = [
        straight("in", (0, 0), 0.0, 100.0, successors=("stub",), left="in_left", may_change_left=True),
        straight("in_left", (0, 3.5), 0.0, 100.0, successors=("stub_left",), right="in"),
        straight(
            "stub",
            (100, 0),
            0.0,
            2.0,
            successors=("through", "first"),
            left="stub_left",
            may_change_left=True,
        ),
        straight("stub_left", (100, 3.5), 0.0, 2.0, successors=("through_left",), right="stub"),
        straight("through", (102, 0), 0.0, 40.0, junction="J", successors=("out",), left="through_left"),
        straight("through_left", (102, 3.5), 0.0, 40.0, junction="J", successors=("out_left",)),
        lane_along(first, "first", junction="J", successors=("second",)),
        lane_along(second, "second", junction="J", successors=("away",)),
        straight("out", (142, 0), 0.0, 80.0, left="out_left"),
        straight("out_left", (142, 3.5), 0.0, 300.0, right="out"),
    ]
    h = 0.7
    step = np.array([math.cos(h), math.sin(h)])
    for k in range(pieces):
        name = "away" if k == 0 else f"away{k}"
        after = (f"away{k + 1}",) if k < pieces - 1 else ("far",)
        lanes.append(straight(name, np.array([x, y]) + k * step, h, 1.0, successors=after))
    lanes.append(straight("far", np.array([x, y]) + pieces * step, h, 200.0))
    net = network(lanes)
    return net, build_lane_map(net), lane_rows(net)


def vehicles(lane, s, v, goal):
    """State of cars on lanes by name, each with its goal lane."""
    _, lane_map, rows = town()
    is_goal = np.asarray(lane_map.routes.is_goal)
    goals = [int(np.argmax(is_goal[rows[name]])) for name in goal]
    return start_state(
        lane_map, drivers(len(lane)), shapes(len(lane)), lane=jnp.asarray([rows[name] for name in lane]),
        s=jnp.asarray(s), v=jnp.asarray(v), goal=jnp.asarray(goals), active=None,
    )  # fmt: skip


def test_how_far_lanes_run_side_by_side():
    net, lane_map, rows = town()
    found = {name: np.asarray(lane_map.beside_s[row]).tolist() for name, row in rows.items()}
    assert found["in"] == [102.0, 0.0] and found["in_left"] == [0.0, 102.0]  # not into the junction
    assert found["stub"] == [2.0, 0.0]
    assert found["out"] == [80.0, 0.0]  # it ends there
    assert found["far"] == [0.0, 0.0]
    # where the ways part, the one that leaves the neighbour first counts
    lanes = [dataclasses.replace(lane, junction=None) for lane in net.lanes.values()]
    open_map = build_lane_map(network(lanes))
    assert np.asarray(open_map.beside_s)[rows["stub"], 0] == 2.0
    assert np.asarray(open_map.beside_s)[rows["stub_left"], 1] == 2.0  # the lane to its right has ended


def test_sight_reaches_far_enough():
    # from the end of "in": 2 m, both pieces of the turn (42 m), five roads of 1 m, and the long one
    assert town()[1].lanes_in_sight == 9
    assert town(1)[1].lanes_in_sight == 5
    assert bundled("highway")[1].lanes_in_sight == 4  # no fewer, so that maps share programs


@pytest.mark.parametrize("v", [0.0, 12.0])
def test_no_lane_change_begins_without_room(v):
    """The road of 2 m has a lane beside, the junction after it has none."""
    _, lane_map, _ = town()
    time, b = (float(x[0]) for x in (drivers(1).lane_change_time, drivers(1).b))
    mean = max(v - b * time / 3, v / 2)  # it may brake gently to be done in time
    needed = max(mean * time, 9.0)  # three quarters of the 12 m that it takes at walking pace
    for s, expected in ((102.0 - needed - 1, True), (102.0 - needed + 1, False)):
        state = vehicles(["in"], [s], [v], ["out_left"])
        assert bool(place_beside(lane_map, state, jnp.ones(1, jnp.int32))[2][0]) == expected


def test_long_vehicles_need_more_room_and_no_change_ends_where_the_other_lane_has_closed():
    _, lane_map, rows = town()
    left = jnp.ones(1, jnp.int32)
    for length, s, expected in ((5.0, 92.0, True), (12.0, 92.0, False), (12.0, 78.0, True)):
        state = vehicles(["in"], [s], [0.0], ["out_left"])
        state = dataclasses.replace(state, shape=shapes(1, length))
        assert bool(place_beside(lane_map, state, left)[2][0]) == expected  # three quarters of 2.5 lengths
    closed = lane_map.end_s.at[rows["in_left"]].set(60.0)
    closes = dataclasses.replace(lane_map, end_s=closed)
    for s, expected in ((50.0, True), (52.0, False)):
        state = vehicles(["in"], [s], [0.0], ["out_left"])
        assert bool(place_beside(closes, state, left)[2][0]) == expected


def test_lane_change_is_finished_before_the_lanes_part():
    _, lane_map, _ = town()
    state = vehicles(["in", "in", "in_left"], [70.0, 70.0, 30.0], [6.0, 6.0, 6.0], ["out_left"] * 3)
    time = float(state.driver.lane_change_time[0])
    half = dataclasses.replace(
        state,
        side=jnp.asarray([1, 0, 1]),
        progress=jnp.asarray([0.5, 0.0, 0.5]),
        crossed=jnp.asarray([False, False, True]),
    )
    found = np.asarray(_until_changed(lane_map, half))
    assert found[0] == pytest.approx(0.9 * 32 / (0.5 * time), rel=1e-5) and found[1] > 1e5
    # has crossed: its old lane is to the right
    assert found[2] == pytest.approx(0.9 * 72 / (0.5 * time), rel=1e-5)


def test_vehicle_with_little_room_brakes_to_change_lanes_in_time():
    _, lane_map, _ = town()
    time, b = (float(x[0]) for x in (drivers(1).lane_change_time, drivers(1).b))
    room = max(12.0 - b * time / 3, 6.0) * time + 2
    state = vehicles(["in", "in"], [102.0 - room, 20.0], [12.0, 12.0], ["out_left", "out"])

    @jax.jit
    def run(state):
        def decision(state, _):
            after, _ = drive(Config(dt=0.1), Traffic(), lane_map, state)
            return after, (after.lane, after.side, after.v)

        return jax.lax.scan(decision, state, None, length=24)[1]

    lane, side, v = (np.asarray(x)[:, 0] for x in run(state))
    _, _, rows = town()
    assert (side > 0).any() and v.min() < 11
    done = np.flatnonzero((side == 0) & (lane != rows["in"]) & (lane != rows["stub"]))
    assert len(done) and rows["first"] not in lane and rows["through"] not in lane
    assert lane[done[0]] in (rows["in_left"], rows["stub_left"], rows["through_left"])


def test_tails_reach_back_by_the_length_of_the_vehicle():
    _, lane_map, rows = town()
    names = ["away3", "away1", "second", "out", "stub", "in"]
    before = ["away2", "away", "first", "through", "in", None]
    state = vehicles(names, [0.6, 0.5, 3.0, 9.0, 1.0, 40.0], [0.0] * 6, ["far"] * 3 + ["out"] * 3)
    previous = [-1 if name is None else rows[name] for name in before]
    state = dataclasses.replace(state, previous=jnp.asarray(previous, jnp.int32))
    length = state.shape.length[0]
    assert 4 < float(length) < 5.5
    lane, front = (np.asarray(x) for x in tails(lane_map, state))
    here = (
        ("away2", "away1", "away", "second"), ("away", "second"), ("first",), (), ("in",), ()
    )  # fmt: skip
    assert lane.tolist() == [[rows[x] for x in way] + [-1] * (4 - len(way)) for way in here]
    at = np.asarray(lane_map.length)
    assert front[0, :2].tolist() == pytest.approx([1.6, 2.6])
    assert front[1, :2].tolist() == pytest.approx([1.5, 1.5 + at[rows["second"]]])
    assert front[2, 0] == pytest.approx(3.0 + at[rows["first"]])


def blocked_crossing():
    """A vehicle has stopped just behind a crossing, with its tail on it; another approaches."""
    lanes = [
        straight("west", (-60, 0), 0.0, 60.0, successors=("cross",)),
        straight("cross", (0, 0), 0.0, 8.0, junction="J", successors=("bit",)),
        straight("bit", (8, 0), 0.0, 0.5, successors=("piece",)),
        straight("piece", (8.5, 0), 0.0, 0.5, successors=("east",)),
        straight("east", (9.0, 0), 0.0, 60.0),
        straight("south", (6, -60), math.pi / 2, 56.0, successors=("up",)),
        straight("up", (6, -4), math.pi / 2, 8.0, junction="J", successors=("north",)),
        straight("north", (6, 4), math.pi / 2, 60.0),
    ]
    net = network(lanes)
    lane_map, rows = build_lane_map(net), lane_rows(net)
    is_goal = np.asarray(lane_map.routes.is_goal)
    state = start_state(
        lane_map, drivers(2), shapes(2), lane=jnp.asarray([rows["piece"], rows["south"]]),
        s=jnp.asarray([0.3, 20.0]), v=jnp.asarray([0.0, 9.0]),
        goal=jnp.asarray([int(np.argmax(is_goal[rows[x]])) for x in ("east", "north")]), active=None,
    )  # fmt: skip
    state = dataclasses.replace(state, previous=jnp.asarray([rows["bit"], -1], jnp.int32))
    return lane_map, rows, state


def test_tail_two_lanes_back_occupies_a_conflict_zone():
    lane_map, rows, state = blocked_crossing()
    zones = conflict_zones(lane_map, state, jnp.int32(1), jnp.int32(rows["up"]))
    assert int((zones.id >= 0).sum()) == 1 and bool(zones.other.any()) and not bool(zones.ego.any())
    gone = dataclasses.replace(state, s=state.s.at[0].set(4.5))
    assert not bool(conflict_zones(lane_map, gone, jnp.int32(1), jnp.int32(rows["up"])).other.any())


def test_tail_of_a_vehicle_behind_a_short_road_is_an_obstacle():
    lane_map, _, state = blocked_crossing()
    brake = jnp.asarray([True, False])

    @jax.jit
    def run(state):
        def decision(state, _):
            state, _ = drive(Config(dt=0.1), Traffic(), lane_map, state, command=Command(brake=brake))
            return state, (state.v[1], state.status)

        return jax.lax.scan(decision, state, None, length=30)[1]

    v, status = run(state)
    assert float(v[-1]) == 0.0 and not np.asarray(status).any()


def test_no_vehicle_leaps_to_a_lane_that_begins_beside():
    """Two lanes continue as one: vehicles on the ending lane change before."""

    def two(offset, beside=True):
        left, right = ("in_left", "in") if beside else (None, None)
        both = ("out", "turn")
        return network([
            straight("in", (0, 0), 0.0, 100.0, successors=("out",), may_change_left=True, left=left),
            straight("in_left", (0, offset), 0.0, 100.0, successors=both, may_change_right=True, right=right),
            straight("out", (100, 0), 0.0, 80.0, predecessors=("in", "in_left")),
            straight("turn", (100, offset), 0.0, 80.0, predecessors=("in_left",)),
        ])  # fmt: skip

    report = ImportReport()
    net = two(3.5)
    lane_map, rows = build_lane_map(net, report=report), lane_rows(net)
    successors = np.asarray(lane_map.successors)
    assert successors[rows["in_left"]][successors[rows["in_left"]] >= 0].tolist() == [rows["turn"]]
    assert rows["out"] in successors[rows["in"]] and net.lanes["in_left"].successors == ("out", "turn")
    goal = int(np.argmax(np.asarray(lane_map.routes.is_goal)[rows["out"]]))
    assert int(lane_map.routes.lanes_to_go[rows["in_left"], goal]) == -1
    assert "out begins 3.5 m beside the end of in_left: traffic changes to in" in report.notes[-1].message
    # a little aside is no leap, and where no lane beside goes on there is no other way
    for net in (two(1.0), two(3.5, beside=False)):
        lane_map, rows = build_lane_map(net), lane_rows(net)
        assert rows["out"] in np.asarray(lane_map.successors)[rows["in_left"]]


def test_connector_in_pieces_is_followed_as_one():
    """A vehicle going straight stops behind one on the second piece of the turn."""
    _, lane_map, _ = town()
    state = vehicles(["through", "second"], [6.0, 5.0], [5.0, 0.0], ["out", "far"])
    brake = jnp.asarray([False, True])
    separation = jax.vmap(jax.vmap(box_separation, (None, 0)), (0, None))

    @jax.jit
    def run(state):
        def decision(state, _):
            state, _ = drive(Config(dt=0.1), Traffic(), lane_map, state, command=Command(brake=brake))
            box = boxes(lane_map, state)
            return state, (separation(box, box)[0, 1], state.v[0])

        return jax.lax.scan(decision, state, None, length=16)[1]

    apart, v = run(state)
    assert float(apart.min()) > 0.5
    assert float(v[-1]) == 0.0


def test_vehicles_remember_the_lanes_that_they_came_by():
    """Behind a merge of short lanes the tail lies on the lanes that were driven, and so does the body."""
    half = math.pi / 6
    lanes = [
        straight("low", (-20 * math.cos(half), -20 * math.sin(half)), half, 19.5, successors=("low1",)),
        straight("low1", (-0.5 * math.cos(half), -0.5 * math.sin(half)), half, 0.5, successors=("on",)),
        straight("high", (-20, 0), 0.0, 19.5, successors=("high1",)),
        straight("high1", (-0.5, 0), 0.0, 0.5, successors=("on",)),
        straight("on", (0, 0), 0.0, 0.5, successors=("out",)),
        straight("out", (0.5, 0), 0.0, 60.0),
    ]
    net = network(lanes)
    lane_map, rows = build_lane_map(net), lane_rows(net)
    assert lane_map.lanes_behind == 3
    step = jax.jit(lambda s: advance(Config(dt=0.1), lane_map, s, jnp.zeros(2))[0])
    state = start_state(
        lane_map, drivers(2), shapes(2), lane=jnp.array([rows["low"], rows["high"]]),
        s=jnp.array([18.0, 12.0]), v=jnp.full(2, 4.0), goal=jnp.zeros(2, jnp.int32),
    )  # fmt: skip
    for _ in range(9):
        state = step(state)
    lane, _ = tails(lane_map, state)
    assert lane[0].tolist() == [rows["on"], rows["low1"], rows["low"]]
    assert state.lane[0] == rows["out"] and lane[1].tolist()[:1] == [-1]
    x, y, heading, _, _ = np.asarray(boxes(lane_map, state))[0].tolist()
    x, y = np.array([x, y]) + np.asarray(lane_map.origin)
    half_base = float(state.shape.wheelbase[0]) / 2
    front = np.array([x, y]) + half_base * np.array([math.cos(heading), math.sin(heading)])
    rear = np.array([x, y]) - half_base * np.array([math.cos(heading), math.sin(heading)])
    slanted = np.array([math.sin(half), -math.cos(half)])
    assert abs(front[1]) < 0.02 and front[0] > -0.2, "the front axle is past the merge"
    assert abs(rear @ slanted) < 0.02, "the rear axle is on the lane that the vehicle came by"
