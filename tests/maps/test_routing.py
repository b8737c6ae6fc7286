"""Route tables against brute force, worked examples and SUMO's own router."""

import dataclasses
import heapq
import itertools
import math

import numpy as np
import pytest
from paths import SHARED, needs_shared
from synthetic import intersection, network, rows, shuffled, straight

from limsim_jax.maps import read_network
from limsim_jax.maps.network import MapError
from limsim_jax.maps.route_table import FAR
from limsim_jax.maps.routing import (
    NO_ROOM,
    NO_WAY,
    ROOM_TO_CHANGE,
    SHORT_PENALTY,
    Round,
    build_fixed_routes,
    build_routes,
    default_goals,
    split_route,
)


def road(name, lengths, successors=None, changes=True, **fields):
    """Lanes `{name}{k}` side by side, k = 0 at the right; `successors[k]` are the lanes ahead of lane k."""
    successors = successors or {}
    count = len(lengths)
    return [
        straight(
            f"{name}{k}",
            (0.0, 3.5 * k),
            0.0,
            length,
            road=fields.get("road", name),
            section=fields.get("section", 0),
            number=k,
            successors=tuple(successors.get(k, ())),
            left=f"{name}{k + 1}" if k + 1 < count else None,
            right=f"{name}{k - 1}" if k else None,
            may_change_left=changes and k + 1 < count,
            may_change_right=changes and k > 0,
        )
        for k, length in enumerate(lengths)
    ]


def column(net, goals, **options):
    """The first goal's column as lane id -> field -> value, with lane ids for rows."""
    table = build_routes(net, rows(net), goals, **options)
    ids = [*rows(net), None]
    return {
        ids[row]: {
            "distance": pytest.approx(float(table.distance[row, 0]), abs=1e-3),
            "next": ids[table.next_lane[row, 0]],
            "to_go": int(table.lanes_to_go[row, 0]),
            "by": float(table.change_distance[row, 0]),
            "reachable": bool(table.reachable[row, 0]),
        }
        for row in range(len(ids) - 1)
    }


def test_worked_example_of_the_docstring():
    net = network([*road("p", [100, 100], {1: ["c0"]}), *road("c", [50])])
    got = column(net, [["c0"]])
    assert got["p0"] == {"distance": 180, "next": None, "to_go": 1, "by": 100.0, "reachable": True}
    assert got["p1"] == {"distance": 150, "next": "c0", "to_go": 0, "by": FAR, "reachable": True}
    assert got["c0"] == {"distance": 50, "next": None, "to_go": 0, "by": FAR, "reachable": True}
    longer = network(
        [
            *road("o", [100, 100], {0: ["p0"], 1: ["p1"]}),
            *road("p", [100, 100], {1: ["c0"]}),
            *road("c", [50]),
        ]
    )
    got = column(longer, [["c0"]])
    assert got["o0"] == {"distance": 280, "next": "p0", "to_go": 1, "by": 200.0, "reachable": True}


def test_two_changes_are_counted_together_and_deferred():
    net = network(
        [
            *road("a", [200, 200, 200], {k: [f"b{k}"] for k in range(3)}),
            *road("b", [60, 60, 60], {0: ["r0"], 2: ["l0"]}),
            *road("l", [40]),
            *road("r", [40]),
        ]
    )
    left, right = column(net, [["l0"]]), column(net, [["r0"]])
    assert left["a0"] == {"distance": 300 + 60, "next": "b0", "to_go": 2, "by": 260.0, "reachable": True}
    assert (left["a1"]["to_go"], left["a2"]["to_go"]) == (1, 0)
    assert (right["a2"]["to_go"], right["a2"]["by"], right["b2"]["by"]) == (-2, 260.0, 60.0)
    # Where the last stretch must not be crossed, the point of no return lies before it.
    solid = {k: dataclasses.replace(v, may_change_left=False) for k, v in net.lanes.items() if v.road == "b"}
    left = column(dataclasses.replace(net, lanes={**net.lanes, **solid}), [["l0"]])
    assert (left["a0"]["to_go"], left["a0"]["by"], left["a0"]["next"]) == (2, 200.0, None)
    assert not left["b0"]["reachable"] and left["b0"]["distance"] == FAR
    # Where only one of the two lines is solid there, the first change is due earlier than the second.
    one = {**net.lanes, "b0": dataclasses.replace(net.lanes["b0"], may_change_left=False)}
    left = column(dataclasses.replace(net, lanes=one), [["l0"]])
    assert (left["a0"]["to_go"], left["a0"]["by"]) == (1, 200.0)
    assert (left["a1"]["to_go"], left["a1"]["by"]) == (1, 260.0)


def test_bends_cause_no_lane_changes():
    """The inner lane is 14 m shorter and the connectors differ a little: the change can still wait."""
    net = network(
        [
            *road("a", [114, 100], {0: ["b0"], 1: ["b1"]}),
            *road("b", [30.0], {0: ["c0"]}),
            *[dataclasses.replace(x, id="b1", road="b'") for x in road("b", [29.0], {0: ["c1"]})],
            *road("c", [100, 100], {1: ["d0"]}),
            *road("d", [10]),
        ]
    )
    got = column(net, [["d0"]])
    assert (got["a0"]["to_go"], got["a0"]["by"]) == (1, 244.0)
    strict = column(net, [["d0"]], tolerance=0.0)
    assert (strict["a0"]["to_go"], strict["a0"]["by"]) == (1, 114.0)


def test_a_detour_may_cost_less_than_changing_lanes():
    net = network(
        [
            *road("a", [50, 50], {0: ["long0"], 1: ["short0"]}),
            *road("long", [70], {0: ["end0"]}),
            *road("short", [20], {0: ["end0"]}),
            *road("end", [10]),
        ]
    )
    assert column(net, [["end0"]], change_penalty=60.0)["a0"]["to_go"] == 0
    cheap = column(net, [["end0"]], change_penalty=40.0)["a0"]
    assert cheap == {"distance": 120, "next": "long0", "to_go": 1, "by": 50.0, "reachable": True}


def test_a_vehicle_stops_before_a_lane_too_short_for_the_change_it_needs():
    """4 m before the fork are too short: a vehicle on the wrong lane changes before them."""

    def net(changes=True, piece=4.0):
        return network(
            [
                *road("a", [200, 200], {0: ["p0"], 1: ["p1"]}, changes=changes),
                *road("p", [piece, piece], {0: ["right0"], 1: ["left0"]}),
                *road("right", [50]),
                *road("left", [50]),
            ]
        )

    here = column(net(), [["left0"]])
    assert here["a0"]["next"] is None and here["a0"]["to_go"] == 1 and here["a0"]["by"] == 200.0
    assert here["a1"]["next"] == "p1" and here["p0"]["next"] is None and here["p0"]["reachable"]
    # with room there the change can wait; without leave to change before, there is no other way
    assert column(net(piece=40.0), [["left0"]])["a0"]["next"] == "p0"
    only = column(net(changes=False), [["left0"]])
    assert only["a0"]["next"] == "p0" and only["a0"]["to_go"] == 1 and only["a0"]["by"] == 204.0


def test_loops_and_goals_on_the_way():
    """On a ring of four roads, the goal is reached at the end of its lane, also from that lane itself."""
    net = network([lane for i in range(4) for lane in road(f"r{i}_", [100], {0: [f"r{(i + 1) % 4}_0"]})])
    got = column(net, [["r2_0"]])
    assert [got[f"r{i}_0"]["distance"] for i in range(4)] == [300, 200, 100, 400]
    assert got["r2_0"]["next"] is None
    goals = default_goals(net)
    assert goals == {"round r0_": ("r0_0",)} and isinstance(goals["round r0_"], Round)
    table = build_routes(net, rows(net), goals)
    assert table.reachable[:-1].all() and not table.is_goal.any(), "traffic goes round and never arrives"
    assert table.next_lane[:-1, 0].tolist() == [1, 2, 3, 0]
    ends = [lane for i in range(4) for lane in road(f"r{i}_", [100, 60], {0: [f"r{(i + 1) % 4}_0"]})]
    assert default_goals(network(ends)) == goals, "a lane that ends beside one that continues is no goal"


def test_default_goals_are_the_exits():
    net = network(
        [
            *road("a", [100, 100], {1: ["b1"]}),  # a0 ends beside a1: no exit
            *road("b", [50, 50]),
            *road("c", [30]),
        ]
    )
    assert default_goals(net) == {"b": ("b0", "b1"), "c": ("c0",)}
    table = build_routes(net, rows(net))
    assert table.distance.shape == (6, 2)
    assert build_routes(net, rows(net), default_goals(net)).distance.shape == (6, 2)


def test_default_goals_distinguish_directions():
    there, back = (
        straight("there", (0, 0), 0.0, 50, road="r", number=-1),
        straight("back", (50, 4), math.pi, 50, road="r", number=1),
    )
    assert default_goals(network([there, back])) == {"r-": ("there",), "r+": ("back",)}


def test_classes_keep_to_their_lanes():
    net = network([*road("a", [100, 100], {0: ["b0"], 1: ["b1"]}), *road("b", [50, 50])])
    bus = {k: dataclasses.replace(v, access=frozenset({"bus"})) for k, v in net.lanes.items() if k == "b0"}
    net = dataclasses.replace(net, lanes={**net.lanes, **bus})
    goals = [["b0", "b1"]]
    assert column(net, goals, vehicle_class="car")["a0"]["to_go"] == 1
    assert column(net, goals, vehicle_class="bus")["a0"]["to_go"] == 0
    assert column(net, goals)["a0"]["to_go"] == 0
    assert not column(net, goals, vehicle_class="car")["b0"]["reachable"]


# --- brute force ------------------------------------------------------------------------------


def random_network(seed):
    rng = np.random.default_rng(seed)
    roads = [(f"r{i}_", int(rng.integers(1, 5)), float(rng.uniform(5, 200))) for i in range(12)]
    lanes = []
    for name, count, length in roads:
        successors = {}
        for k in range(count):
            ahead = rng.integers(0, len(roads), rng.integers(0, 4))
            successors[k] = [f"{roads[j][0]}{rng.integers(roads[j][1])}" for j in ahead]
        for lane in road(name, [length] * count, successors):
            allowed = rng.random(2) < 0.8
            lanes.append(
                dataclasses.replace(
                    lane,
                    may_change_left=lane.may_change_left and bool(allowed[0]),
                    may_change_right=lane.may_change_right and bool(allowed[1]),
                )
            )
    goals = [[f"{roads[j][0]}{k}" for k in range(roads[j][1]) if k != 1] for j in rng.integers(0, 12, 3)]
    return network(lanes), goals


def penalty(lane):
    """Penalty of a lane change: more where the lane is short."""
    hopeless = NO_WAY if lane.length < NO_ROOM else 0.0
    return 17.0 + SHORT_PENALTY * max(0.0, 1 - lane.length / ROOM_TO_CHANGE) + hopeless


def brute_force(net, goal):
    """Cost to go of every lane: Dijkstra's algorithm forwards from each, on plain dictionaries."""
    found = {}
    for start in net.lanes:
        queue, done, best = [(0.0, start)], set(), math.inf
        while queue:
            cost, name = heapq.heappop(queue)
            if name in done:
                continue
            done.add(name)
            lane = net.lanes[name]
            if name in goal:
                best = min(best, cost + lane.length)
            for after in lane.successors:
                heapq.heappush(queue, (cost + lane.length, after))
            for side, allowed in ((lane.left, lane.may_change_left), (lane.right, lane.may_change_right)):
                if allowed:
                    heapq.heappush(queue, (cost + penalty(lane), side))
        found[start] = best
    return found


@pytest.mark.parametrize("seed", range(12))
def test_costs_agree_with_brute_force(seed):
    net, goals = random_network(seed)
    row = rows(net)
    table = build_routes(net, row, goals, change_penalty=17.0)
    for g, goal in enumerate(goals):
        for name, expected in brute_force(net, goal).items():
            assert table.reachable[row[name], g] == math.isfinite(expected)
            assert table.distance[row[name], g] == pytest.approx(min(expected, FAR), rel=1e-6)


@pytest.mark.parametrize("seed", range(12))
def test_driving_by_the_table_costs_what_the_table_says(seed):
    """Stay in the lane until `change_distance` runs out, then change; the cost is that of the best way."""
    net, goals = random_network(seed)
    row, ids = rows(net), list(net.lanes)
    table = build_routes(net, row, goals, change_penalty=17.0, tolerance=0.0)
    changed = 0
    for start, g in itertools.product(net.lanes, range(len(goals))):
        if not table.reachable[row[start], g]:
            assert table.lanes_to_go[row[start], g] == 0
            continue
        name, cost, due = start, 0.0, None
        for _ in range(200):
            lane, at = net.lanes[name], row[name]
            to_go, by = int(table.lanes_to_go[at, g]), float(table.change_distance[at, g])
            assert (to_go != 0) == (by < FAR)
            if due is not None and to_go:  # what was announced upstream still holds
                assert (to_go, by) == (due[0], pytest.approx(due[1], abs=1e-2))
            if to_go and by == pytest.approx(lane.length, abs=1e-3):
                for _ in range(abs(to_go)):
                    beside = lane.left if to_go > 0 else lane.right
                    assert beside and (lane.may_change_left if to_go > 0 else lane.may_change_right)
                    lane, cost, changed = net.lanes[beside], cost + penalty(lane), changed + 1
                due = None
                name = lane.id
                if table.lanes_to_go[row[name], g]:  # the next change, perhaps on this same lane
                    continue
                lane, at = net.lanes[name], row[name]
            elif to_go:
                due = to_go, by - lane.length
            cost += lane.length
            if table.is_goal[at, g]:
                break
            assert table.next_lane[at, g] >= 0
            name = ids[table.next_lane[at, g]]
        else:
            pytest.fail("does not arrive")
        assert cost == pytest.approx(table.distance[row[start], g], rel=1e-5)
    assert changed


def test_order_of_lanes_does_not_matter():
    net, goals = random_network(3)
    one, other = rows(net), rows(shuffled(net, 1))
    a, b = build_routes(net, one, goals), build_routes(shuffled(net, 1), other, goals)
    for name in net.lanes:
        np.testing.assert_allclose(a.distance[one[name]], b.distance[other[name]])


# --- the table, errors, fixed routes ----------------------------------------------------------


def test_null_row_and_padding():
    net, goals = random_network(0)
    table = build_routes(net, rows(net), goals)
    padded = table.pad(lanes=len(net.lanes) + 9, goals=5)
    for t in (table, padded):
        assert {x.dtype for x in vars(t).values()} == {np.dtype(x) for x in (np.float32, np.int32, bool)}
        assert (t.distance[-1] == FAR).all() and (t.change_distance[-1] == FAR).all()
        assert (t.next_lane[-1] == -1).all() and (t.lanes_to_go[-1] == 0).all()
        assert not t.reachable[-1].any() and not t.is_goal[-1].any()
    assert padded.distance.shape == (len(net.lanes) + 9, 5)
    assert not padded.reachable[:, 3:].any()
    for name, x in vars(table).items():
        np.testing.assert_array_equal(getattr(padded, name)[: len(x), :3], x)
    with pytest.raises(ValueError, match="does not fit"):
        table.pad(lanes=len(net.lanes), goals=5)


def test_unknown_goals_are_refused():
    net = network([*road("a", [100]), *road("b", [50])])
    with pytest.raises(MapError, match="no lane 'x'; ids look like a0, b0"):
        build_routes(net, rows(net), [["x"]])
    with pytest.raises(MapError, match="one or more lane ids"):
        build_routes(net, rows(net), [[]])
    with pytest.raises(MapError, match="one or more lane ids"):
        build_routes(net, rows(net), ["b0"])


def test_routes_that_prescribe_every_road():
    net = intersection(lanes=2)
    row = rows(net)
    table = build_fixed_routes(net, row, [["in0", "out3"], ["in0", "out2"]])
    assert table.lanes_to_go[row["in0_0"]].tolist() == [1, 0]
    assert table.next_lane[row["in0_1"]].tolist() == [row["in0_1>out3_1"], row["in0_1>out2_1"]]
    assert not table.reachable[row["in1_0"]].any()
    assert table.is_goal[row["out3_0"]].tolist() == [True, False]
    with pytest.raises(MapError, match="no lane from road 'in0' leads to 'in1'"):
        build_fixed_routes(net, row, [["in0", "in1"]])
    with pytest.raises(MapError, match="no road 'x'"):
        build_fixed_routes(net, row, [["in0", "x"]])
    with pytest.raises(MapError, match="at least one road"):
        build_fixed_routes(net, row, [[]])


def test_a_fixed_route_takes_no_short_cut_and_may_come_back():
    net = network(
        [
            *road("a", [100], {0: ["b0", "c0"]}),
            *road("b", [10], {0: ["c0"]}),
            *road("c", [10], {0: ["a0", "d0"]}),
            *road("d", [10]),
        ]
    )
    row = rows(net)
    assert column(net, [["d0"]])["a0"]["next"] == "c0"
    table = build_fixed_routes(net, row, [["a", "b", "c", "d"]])
    assert table.next_lane[row["a0"], 0] == row["b0"]
    loop = ["a", "b", "c", "a", "c", "d"]
    assert split_route(loop) == [("a", "b", "c"), ("c", "a"), ("a", "c", "d")]
    with pytest.raises(MapError, match="'a' twice; cut it with split_route"):
        build_fixed_routes(net, row, [loop])
    legs = build_fixed_routes(net, row, split_route(loop))
    assert legs.next_lane[row["c0"]].tolist() == [-1, row["a0"], row["d0"]]
    assert build_fixed_routes(net, row, []).distance.shape == (5, 0)


# --- maps -------------------------------------------------------------------------------------


@needs_shared
@pytest.mark.parametrize(
    "name", ["limsim_town01/Town01", "ingolstadt1/ingolstadt1", "limsim_roundabout/roundabout"]
)
def test_distances_are_those_of_sumos_router(name):
    """With free lane changes, the cost to go between edges is the length of sumolib's best path."""
    import sumolib

    path = SHARED / "sumo" / f"{name}.net.xml"
    theirs = sumolib.net.readNet(str(path), withInternal=True)
    net = read_network(path)
    # The same lengths as sumolib: that of the edge, which is declared in the file, for all its lanes.
    lanes = {
        lane.id: dataclasses.replace(
            lane, s=lane.s * (theirs.getLane(lane.id).getEdge().getLength() / lane.length)
        )
        for lane in net.lanes.values()
    }
    net = dataclasses.replace(net, lanes=lanes)
    row = rows(net)
    edges = [e for e in theirs.getEdges(withInternal=False) if e.allows("passenger")]
    goals = [[lane.id for lane in net.road_lanes(e.getID()) if lane.id in row] for e in edges]
    table = build_routes(net, row, goals, change_penalty=1e-3, short_penalty=0.0)
    compared = 0
    for g, end in enumerate(edges):
        for start in edges[:: max(1, len(edges) // 12)]:
            _, cost = theirs.getOptimalPath(start, end, withInternal=True, vClass="passenger")
            if start is end or cost is None or not math.isfinite(cost) or cost > 1e300:
                continue
            mine = min(
                table.distance[row[lane.id], g] for lane in net.road_lanes(start.getID()) if lane.id in row
            )
            assert mine == pytest.approx(cost, abs=0.05), (start.getID(), end.getID())
            compared += 1
    assert compared > 20


@pytest.mark.engine
@needs_shared
@pytest.mark.parametrize("name", ["limsim_town05/Town05", "bologna_pasubio/pasubio_buslanes"])
def test_every_exit_of_a_town_can_be_reached(name):
    net = read_network(SHARED / "sumo" / f"{name}.net.xml")
    goals = default_goals(net)
    table = build_routes(net, rows(net), goals)
    assert table.reachable[:-1].any(0).all()
    moved = table.reachable[:-1] & ~table.is_goal[:-1] & (table.lanes_to_go[:-1] == 0)
    assert (table.next_lane[:-1][moved] >= 0).all()
