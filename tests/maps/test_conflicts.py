"""Conflict tables against closed forms, brute force, symmetry and SUMO's own matrices."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from paths import SHARED, needs_shared
from scipy.spatial import KDTree
from synthetic import (
    arc,
    curve,
    intersection,
    lane_along,
    mirrored,
    network,
    roundabout,
    rows,
    shuffled,
    straight,
)

from limsim_jax.maps import read_network
from limsim_jax.maps.conflicts import (
    ConflictType,
    Overlap,
    build_conflicts,
    connectors,
    find_overlaps,
    priority_cycles,
)
from limsim_jax.maps.conflicts.build import MARGIN, VEHICLE_WIDTH
from limsim_jax.maps.conflicts.table import ABSENT
from limsim_jax.maps.conflicts.waiting import hold_back, stand_back, stretches_across
from limsim_jax.maps.network import Control, LaneType, Turn

REACH = VEHICLE_WIDTH + MARGIN


def entries(net, table=None, **options):
    """Every entry but sweeps by lane ids: (lane, foe) -> list of dicts."""
    table = build_conflicts(net, rows(net), **options) if table is None else table
    ids = list(rows(net))
    found = {}
    for k, c in zip(*np.nonzero((table.foe >= 0) & (table.type != ConflictType.SWEEP)), strict=True):
        key = ids[table.lane[k]], ids[table.lane[table.foe[k, c]]]
        names = ("s_in", "s_out", "f_in", "f_out", "type", "prio", "tie")
        found.setdefault(key, []).append({name: getattr(table, name)[k, c].item() for name in names})
    return found


def only(net, lane, foe, **options):
    (entry,) = entries(net, **options)[lane, foe]
    return entry


def crossing(angle, at=(30.0, 20.0), z=0.0, reverse=False):
    """Two straight lanes of one junction that cross at `at` (m along each) under `angle` (rad)."""
    a = straight("a", (-at[0], 0.0), 0.0, 60.0, junction="J")
    start = -at[1] * np.array([math.cos(angle), math.sin(angle)])
    b = straight("b", start, angle, 50.0, z=z, junction="J")
    return network([b, a] if reverse else [a, b])


# --- geometry ---------------------------------------------------------------------------------


@pytest.mark.engine
@given(angle=st.floats(0.35, math.pi - 0.35), at=st.tuples(st.floats(9.0, 50.0), st.floats(9.0, 40.0)))
@settings(max_examples=60, deadline=None, derandomize=True)
def test_crossing_of_straight_lanes_is_closed_form(angle, at):
    half = REACH / math.sin(angle)
    for sign in (1, -1):
        entry = only(crossing(sign * angle, at), "a", "b")
        got = [entry[name] for name in ("s_in", "s_out", "f_in", "f_out")]
        np.testing.assert_allclose(got, [at[0] - half, at[0] + half, at[1] - half, at[1] + half], atol=0.01)
        assert entry["type"] == ConflictType.CROSS


def test_width_and_margin_widen_the_stretch():
    entry = only(crossing(math.pi / 2), "a", "b", vehicle_width=2.5, margin=0.5)
    assert entry["s_in"] == pytest.approx(27.0, abs=0.01)
    assert entry["f_out"] == pytest.approx(23.0, abs=0.01)


@pytest.mark.parametrize(("turn", "conflicts"), [(0.5, False), (1.0, False), (1.4, True), (-1.8, True)])
def test_the_ends_of_a_body_swing_out_at_a_kink_into_the_next_lane(turn, conflicts):
    """Two straight lanes 3 m apart; the next lane of one turns off on the spot."""
    a = straight("a", (0.0, 0.0), 0.0, 20.0, junction="J", successors=("out",))
    b = straight("b", (0.0, 3.0), 0.0, 20.0, junction="J")
    out = straight("out", (20.0, 0.0), turn, 30.0)
    assert (("a", "b") in entries(network([a, b, out]))) is conflicts


def over_a_junction(at, *, junction=None, **fields):
    """A connector of junction J, and a lane of 100 m, not joined to it, that it crosses `at` m along."""
    a = straight("a", (0.0, 0.0), 0.0, 20.0, junction="J")
    b = straight("b", (8.0, -at), math.pi / 2, 100.0, junction=junction, **fields)
    return a, b


@pytest.mark.parametrize(
    ("at", "junction", "conflicts"),
    [(20.0, None, True), (85.0, None, True), (50.0, None, False), (50.0, "K", True)],
)
def test_a_junction_that_lies_over_a_lane_of_another_place(at, junction, conflicts):
    """The middle of a lane outside junctions does not count: it may be a bridge in a file without heights."""
    found = entries(network(over_a_junction(at, junction=junction)))
    assert bool(found) is conflicts
    if conflicts:
        entry = found["a", "b"][0]
        got = [entry[name] for name in ("s_in", "s_out", "f_in", "f_out")]
        np.testing.assert_allclose(got, [8 - REACH, 8 + REACH, at - REACH, at + REACH], atol=0.01)


def test_lanes_that_follow_each_other_are_no_strangers():
    """A lane that begins beside the next one, and the oncoming one."""
    a = straight("a", (0.0, 0.0), 0.0, 20.0, junction="J", successors=("b",))
    b = straight("b", (20.0, 0.0), 0.0, 30.0, road="r")
    beside = straight("c", (20.0, 1.5), 0.0, 30.0, road="r")
    oncoming = straight("d", (50.0, 1.5), math.pi, 30.0, road="r")
    assert not entries(network([a, b, beside, oncoming]))


@pytest.mark.parametrize(("leads", "prio"), [("out", -1), ("in", 1), ("elsewhere", -1)])
def test_of_lanes_that_lie_over_each_other_the_one_on_the_way_out_goes_first(leads, prio):
    """Seen from a connector of J: a lane that comes from J goes before it, one that leads there after it.

    Where neither holds, the one from the right goes first.
    """
    a, b = over_a_junction(50.0, junction="K", successors=("on",) if leads == "in" else ())
    on = straight("on", (8.0, 50.0), math.pi / 2, 5.0, successors=("c",))
    c = straight("c", (8.0, 55.0), math.pi / 2, 10.0, junction="J")
    if leads == "out":
        b = straight("b", (8.0, 50.0), -math.pi / 2, 100.0, junction="K")  # from the left
        on = straight("on", (8.0, 55.0), -math.pi / 2, 5.0, successors=("b",))
        c = straight("c", (8.0, 65.0), -math.pi / 2, 10.0, junction="J", successors=("on",))
    if leads == "elsewhere":
        on = straight("on", (8.0, 50.0), math.pi / 2, 50.0)
    assert only(network([a, b, on, c]), "a", "b")["prio"] == prio


@pytest.mark.parametrize(
    ("place", "across", "hold"),
    [
        (20.0, [], 20.0),
        (20.0, [(20.0, 24.0)], 20.0),  # the one that it waits for
        (20.0, [(10.0, 14.9)], 20.0),  # room for a car between two paths
        (20.0, [(10.0, 15.1)], 10.0),
        (20.0, [(10.0, 16.0), (3.0, 6.0)], 3.0),  # and there it would be in the way of a third
        (20.0, [(10.0, 16.0), (1.0, 4.0)], 10.0),
    ],
)
def test_where_a_car_waits_inside_a_junction_it_is_in_the_way_of_no_path_with_priority(place, across, hold):
    lane = straight("lane", (0.0, 0.0), 0.0, 30.0, junction="J")

    def held(prio, kind):
        row = [(overlap(begin, end, kind), prio, 0) for begin, end in across]
        (found,) = stretches_across(network([lane]), [lane], [row])
        return hold_back(place, found)

    assert held(-1, ConflictType.CROSS) == hold
    for prio, kind in ((1, ConflictType.CROSS), (0, ConflictType.CROSS), (-1, ConflictType.MERGE)):
        assert held(prio, kind) == place


@pytest.mark.parametrize(("start", "heading", "kind"), [(0.0, 0.0, "MERGE"), (9.0, math.pi, "CROSS")])
def test_lanes_that_end_side_by_side_merge_and_oncoming_ones_do_not(start, heading, kind):
    """Both are near each other from end to end, so both stretches reach the ends of their lanes."""
    one = straight("one", (0.0, 0.0), 0.0, 9.0, junction="J")
    other = straight("other", (start, 2.0), heading, 9.0, junction="J")
    (found,) = find_overlaps([one, other], 1.8, 0.5)
    assert found.type is ConflictType[kind]
    assert (found.s_in, found.s_out, found.f_in, found.f_out) == (0, 9, 0, 9)


def test_a_car_that_waits_at_the_second_piece_of_its_way_is_out_of_the_way_on_the_first():
    """The end of the first piece and the begin of the second lie across a path with priority."""
    first = straight("first", (0.0, 0.0), 0.0, 12.0, junction="J", successors=("second",))
    second = straight("second", (12.0, 0.0), 0.0, 9.0, junction="J", predecessors=("first",))
    other = straight("other", (50.0, 0.0), 0.0, 9.0, junction="J", successors=("second",))
    one = [(overlap(11.5, 12.0, ConflictType.CROSS), -1, 0), (overlap(2.0, 7.0, ConflictType.CROSS), -1, 0)]
    two = [(overlap(0.0, 4.0, ConflictType.CROSS), -1, 0)]
    lanes = [first, second, other]
    found = stretches_across(network(lanes), lanes, [one, two, []])
    assert found[1] == [(0.0, 4.0), (-0.5, 0.0), (-10.0, -5.0)]
    assert hold_back(0.0, found[1]) == -10.0  # -0.5 is in the way of the other one
    assert hold_back(0.0, found[1][:2]) == -0.5
    several = dataclasses.replace(second, predecessors=("first", "other"))
    lanes = [first, several, other]
    assert stretches_across(network(lanes), lanes, [one, two, []])[1] == [(0.0, 4.0)]


def overlap(begin, end, kind):
    return Overlap(first=0, second=1, s_in=begin, s_out=end, f_in=0.0, f_out=1.0, type=kind)


@pytest.mark.parametrize(
    ("crossed", "last", "line", "back"),
    [
        ((47.0,), 50.0, 50.0, 3.0 + REACH),
        ((47.0,), 0.2, 0.2, 3.0 + REACH),  # behind the connector of another junction
        ((43.0,), 50.0, 46.0, 3.0 + REACH),  # a car at its line reaches from 41 m to 46 m: over the path
        ((42.0,), 50.0, 50.0, 0.0),  # room for a car behind the path
        ((47.0, 40.0), 50.0, 50.0, 10.0 + REACH),  # before that path it would stand on the next
        ((47.0, 41.0, 35.0, 29.0, 23.0), 50.0, 50.0, 0.0),  # too far away
    ],
)
def test_where_traffic_waits_before_a_junction_whose_paths_lie_over_its_lane(crossed, last, line, back):
    """A lane of 50 m in all leads to a junction; paths of that junction cross it."""
    lanes = [
        straight("in", (50.0 - last, 0.0), 0.0, last, successors=("a",)),
        straight("a", (50.0, 0.0), 0.0, 20.0, junction="J"),
        *(
            straight(f"b{i}", (x, -20.0), math.pi / 2, 40.0, junction="J", road=f"b{i}")
            for i, x in enumerate(crossed)
        ),
    ]
    if last < 50:
        lanes.append(straight("first", (0.0, 0.0), 0.0, 50.0 - last, junction="K", successors=("in",)))
    net = network(lanes)
    row = rows(net)
    stop_s = np.array([lane.length for lane in net.drivable_lanes()])
    stop_s[row["in"]] = line
    found = stand_back(net, row, build_conflicts(net, row), stop_s)
    assert found[row["in"]] == pytest.approx(back, abs=0.01)
    assert not np.delete(found, row["in"]).any()


def test_bridges_do_not_conflict():
    assert not entries(crossing(math.pi / 2, z=3.6))
    assert entries(crossing(math.pi / 2, z=3.4))


def test_a_ramp_conflicts_only_at_its_foot():
    """A lane that climbs over another conflicts at its foot and not where it passes over."""
    s = np.linspace(0, 200, 801)
    z = np.clip((s - 40) * 0.1, 0, 6)
    flat = lane_along(np.column_stack([s, 0 * s, 0 * s]), "flat", junction="J")
    over = lane_along(np.column_stack([s, 1.0 * np.cos(s / 30), z]), "over", junction="J")
    entry = only(network([flat, over]), "flat", "over")
    assert entry["s_in"] == 0.0
    assert entry["f_out"] == pytest.approx(over.s[300], abs=0.3)  # at x = 75 m it is 3.5 m up
    assert entry["s_out"] == pytest.approx(75.0 + math.sqrt(REACH**2 - math.cos(2.5) ** 2), abs=0.3)


def test_separate_stretches_are_separate_entries():
    """A hairpin that crosses a straight lane twice."""
    hairpin = arc("u", (0.0, 0.0), 12.0, -math.pi / 2, math.pi, junction="J")
    line = straight("x", (6.0, -30.0), math.pi / 2, 60.0, junction="J")
    found = entries(network([hairpin, line]))
    first, second = found["u", "x"]
    assert first["s_out"] < second["s_in"]
    assert first["f_out"] < second["f_in"]
    mirror = found["x", "u"]
    assert [(m["f_in"], m["f_out"]) for m in mirror] == [(e["s_in"], e["s_out"]) for e in (first, second)]


def is_sharp(lane):
    """Whether a body on it swings round on the spot: more than 1.9 rad within 5 m."""
    s = np.linspace(0, lane.length, 400)
    heading = np.unwrap(lane.pose(s)[1])
    return np.abs(np.interp(s + 5.0, s, heading) - heading).max() > 1.9


def is_kinked(lane, lanes):
    """Whether it, or the step into or out of it, turns by more than 1.2 rad within 1 m."""
    s = np.linspace(0, lane.length, 400)
    heading = np.unwrap(lane.pose(s)[1])
    turns = [lanes[x].heading[0] - lane.heading[-1] for x in lane.successors if x in lanes]
    turns += [lane.heading[0] - lanes[x].heading[-1] for x in lane.predecessors if x in lanes]
    steps = [abs(math.remainder(turn, math.tau)) for turn in turns]
    return max([np.abs(np.interp(s + 1.0, s, heading) - heading).max(), *steps]) > 1.2


def brute_force(lane, foe, step=0.02):
    """First and last point of a lane that is within reach of the other, by dense sampling."""
    reach = REACH + (1.8 if is_sharp(lane) or is_sharp(foe) else 0.0)
    s = np.linspace(0, lane.length, math.ceil(lane.length / step) + 1)
    t = np.linspace(0, foe.length, math.ceil(foe.length / step) + 1)
    distance, _ = KDTree(foe.pose(t)[0][:, :2]).query(lane.pose(s)[0][:, :2])
    near = s[distance < reach]
    return (near.min(), near.max()) if len(near) else None


@pytest.mark.parametrize(
    "net",
    [
        intersection(),
        intersection(arms=(0, 70, 180, 290), lanes=2, u_turns=True),
        intersection(arms=(10, 130, 200), lanes=3),
        roundabout(),
    ],
    ids=["cross", "skew", "tee", "roundabout"],
)
def test_stretches_agree_with_brute_force(net):
    found = entries(net)
    for one in connectors(net):
        for two in connectors(net):
            if one.junction != two.junction or one.road == two.road:
                continue
            expected = brute_force(one, two)
            got = found.get((one.id, two.id), [])
            assert bool(got) == (expected is not None), (one.id, two.id)
            if expected is not None:
                hull = got[0]["s_in"], max(entry["s_out"] for entry in got)
                np.testing.assert_allclose(hull, expected, atol=0.05)


@pytest.mark.parametrize("apart", [1.7, 2.4])
def test_lanes_of_one_road_that_come_too_close_merge(apart):
    """Lanes side by side have room for two; where a file draws them closer, one vehicle follows the other."""
    # 3.5 m apart at both ends, where they lead on as lanes of their own
    x = np.linspace(0, 60, 601)
    y = 3.5 - (3.5 - apart) * np.sin(math.pi * x / 60) ** 2
    a = straight("a", (0, 0), 0.0, 60.0, road="r", junction="J")
    b = lane_along(np.column_stack([x, y]), "b", road="r", junction="J")
    found = entries(network([a, b]))
    if apart > REACH:
        assert not found
        return
    (entry,) = found["a", "b"]
    assert (entry["type"], entry["prio"]) == (ConflictType.MERGE, 0)
    half = 60 / math.pi * math.acos(math.sqrt((3.5 - REACH) / (3.5 - apart)))
    np.testing.assert_allclose([entry["s_in"], entry["s_out"]], [30 - half, 30 + half], atol=0.15)  # b slants
    b = dataclasses.replace(b, road="other")
    assert entries(network([a, b]))["a", "b"][0]["type"] == ConflictType.CROSS


def test_oncoming_lanes_and_other_sections_of_one_road_are_apart():
    a = straight("a", (0, 0), 0.0, 30.0, road="r", junction="J")
    oncoming = straight("b", (30, 2.0), math.pi, 30.0, road="r", number=1, junction="J")
    beyond = straight("b", (30, 1.75), 0.0, 30.0, road="r", section=1, junction="J")
    assert not entries(network([a, oncoming])) and not entries(network([a, beyond]))
    assert entries(network([a, dataclasses.replace(oncoming, road="other")]))


def sweeps(net):
    """(lane, foe) -> `sweep` and `f_sweep` (1/m^2), where only the ends of bodies meet."""
    table, ids = build_conflicts(net, rows(net)), list(rows(net))
    return {
        (ids[table.lane[k]], ids[table.lane[table.foe[k, c]]]): (table.sweep[k, c], table.f_sweep[k, c])
        for k, c in np.argwhere(table.type == ConflictType.SWEEP)
    }


def test_ends_of_long_bodies_meet_where_turns_pass_back_to_back():
    """Each end stands out by l^2 / 8r: of equal bodies they meet where l^2 / 4r is the room between."""
    r, other, apart = 9.0, 14.0, 3.4
    one = arc("one", (0.0, 0.0), r, -0.9, 1.8, junction="J")
    two = arc("two", (r + apart + other, 0.0), other, math.pi - 0.7, 1.4, junction="J")
    net = network([one, two])
    assert not entries(net)
    found = sweeps(net)
    room = apart - VEHICLE_WIDTH
    assert found["one", "two"] == pytest.approx((1 / (8 * r * room), 1 / (8 * other * room)), rel=0.01)
    assert found["two", "one"] == found["one", "two"][::-1]
    table = build_conflicts(net, rows(net))
    assert (table.prio == 0).all() and (table.clear_s == 0).all() and (table.cross_s == 0).all()
    # all of it where the longest come too close: ends of 12 m, at most 1.5 m out on the one side
    for k, c in np.argwhere(table.type == ConflictType.SWEEP):
        assert 0 < table.s_in[k, c] < table.length[k] / 2 < table.s_out[k, c] < table.length[k]


def test_only_the_inner_of_two_parallel_turns_sweeps():
    inner, outer = (arc(name, (0, 0), r, 0.0, 1.5, junction="J") for name, r in (("in", 7.0), ("out", 10.0)))
    sweep, f_sweep = sweeps(network([inner, outer]))["in", "out"]
    assert sweep == pytest.approx(1 / (8 * 7.0 * (3.0 - VEHICLE_WIDTH)), rel=0.02) and f_sweep == 0
    ahead = [straight(name, (0.0, y), 0.0, 20.0, junction="J") for name, y in (("a", 0.0), ("b", 2.6))]
    assert not sweeps(network(ahead))


def test_a_lane_does_not_conflict_with_its_successors():
    a = straight("a", (0, 0), 0.0, 20.0, junction="J", successors=("b",))
    b = straight("b", (20, 0), 0.0, 1.0, junction="J", successors=("c",))
    c = straight("c", (21, 0), 0.0, 20.0, junction="J")
    assert not entries(network([a, b, c]))


def merge(slip=10.0, ramp_type=LaneType.DRIVING, length=300.0):
    """Outside junctions: a long main lane and a ramp that comes in at `slip` degrees."""
    main = straight("main", (-length, 0), 0.0, length, successors=("after",))
    angle = math.radians(slip)
    start = np.array([-80.0 - 60 * math.cos(angle), -80 * math.sin(angle / 2) * 0 - 60 * math.sin(angle) - 8])
    ramp = curve("ramp", start, angle, (0.0, 0.0), 0.0, successors=("after",), type=ramp_type)
    return network([main, ramp, straight("after", (0, 0), 0.0, 100.0)])


def test_lanes_outside_junctions_that_merge():
    net = merge(length=900.0)  # only its end is compared
    entry = only(net, "main", "ramp")
    assert entry["type"] == ConflictType.MERGE
    assert entry["s_out"] == pytest.approx(900.0)
    assert entry["f_out"] == pytest.approx(net.lanes["ramp"].length)
    expected = brute_force(net.lanes["main"], net.lanes["ramp"])
    assert expected is not None
    assert entry["s_in"] == pytest.approx(expected[0], abs=0.1)
    table = build_conflicts(net, rows(net))
    assert table.connector[rows(net)["after"]] == -1


def test_lanes_outside_junctions_that_diverge():
    before = straight("before", (0, 0), 0.0, 50.0, successors=("on", "off"))
    on = straight("on", (50, 0), 0.0, 900.0)
    off = curve("off", (50, 0), 0.0, (130, -30), -0.6)
    entry = only(network([before, on, off]), "on", "off")
    assert entry["type"] == ConflictType.DIVERGE
    assert (entry["s_in"], entry["f_in"], entry["prio"]) == (0.0, 0.0, 0)


def test_kinds_carry_over_along_a_movement_of_several_lanes():
    """A left turn cut in two inside the area in which it diverges from the straight path."""
    through = straight("through", (0, 0), 0.0, 40.0, road="t", junction="J", successors=("out",))
    turn = arc("turn", (0, 14), 14.0, -math.pi / 2, math.pi / 2, junction="J")
    for cut in (3.0, 7.0):
        s = turn.s
        first = lane_along(
            turn.pose(np.linspace(0, cut, 40))[0], "first", junction="J", successors=("second",)
        )
        rest = np.linspace(cut, s[-1], 200)
        second = lane_along(turn.pose(rest)[0], "second", junction="J")
        before = straight("in", (-50, 0), 0.0, 50.0, successors=("through", "first"))
        after = straight("out", (40, 0), 0.0, 50.0)
        found = entries(network([before, through, first, second, after]))
        assert {e["type"] for e in found["through", "first"]} == {ConflictType.DIVERGE}
        (later,) = found["through", "second"]
        assert later["type"] == ConflictType.DIVERGE
        # level with its start, though they have been near for longer
        assert later["f_in"] == 0.0
        assert later["s_in"] == pytest.approx(14 * math.sin(cut / 14), abs=0.05)


def test_merging_paths_end_level_however_they_are_cut_into_lanes():
    """A right turn cut in two inside the area in which it merges with the straight path."""
    through = straight("through", (0, 0), 0.0, 40.0, junction="J", successors=("out",))
    turn = arc("turn", (40.0, -14.0), 14.0, math.pi, -math.pi / 2, junction="J")
    after = straight("out", (40, 0), 0.0, 50.0)
    for left in (2.0, 5.0):  # m of the second piece: shorter and longer than vehicles are wide
        cut = turn.length - left
        first = lane_along(
            turn.pose(np.linspace(0, cut, 200))[0], "first", junction="J", successors=("second",)
        )
        rest = turn.pose(np.linspace(cut, turn.length, 40))[0]
        second = lane_along(rest, "second", junction="J", successors=("out",))
        (earlier,) = entries(network([through, first, second, after]))["through", "first"]
        assert earlier["type"] == ConflictType.MERGE
        assert earlier["f_out"] == pytest.approx(first.length, abs=1e-4)
        assert earlier["s_out"] == pytest.approx(40 - 14 * math.sin(left / 14), abs=0.05)


def test_lanes_that_lead_to_the_same_lane_merge_however_far_apart_they_end():
    """A lane ends beside another one and continues as that one: vehicles step aside there."""
    lanes = [
        straight("a", (0, 0), 0.0, 30.0, junction="J", successors=("out",)),
        straight("b", (24, 3.5), 0.0, 6.0, junction="J", successors=("out",)),
        straight("out", (30, 0), 0.0, 50.0),
    ]
    found = only(network(lanes), "a", "b")
    assert found["type"] == ConflictType.MERGE
    assert [found[name] for name in ("s_in", "s_out", "f_in", "f_out")] == [22.0, 30.0, 0.0, 6.0]


# --- right of way -----------------------------------------------------------------------------


def yields(net, **options):
    """Pairs (lane, foe) in which the lane yields to the foe."""
    return {pair for pair, found in entries(net, **options).items() if any(e["prio"] < 0 for e in found)}


@pytest.mark.parametrize("seed", range(4))
def test_priority_and_geometry_are_antisymmetric(seed):
    arms = np.sort(np.random.default_rng(seed).uniform(0, 70, 4) + 90 * np.arange(4))
    found = entries(intersection(arms=arms, lanes=2, u_turns=True, control={seed % 4: Control.YIELD}))
    assert found
    swap = {"s_in": "f_in", "s_out": "f_out", "f_in": "s_in", "f_out": "s_out", "type": "type"}
    for (lane, foe), ours in found.items():
        theirs = found[foe, lane]
        assert len(ours) == len(theirs)
        for entry in ours:
            image = {swap[name]: entry[name] for name in swap} | {
                "prio": -entry["prio"],
                "tie": -entry["tie"],
            }
            assert image in theirs


@pytest.mark.parametrize("net", [intersection(lanes=2), intersection(arms=(0, 90, 180)), roundabout()])
def test_mirror_image(net):
    """Left-hand traffic in the mirror is right-hand traffic: all stays as it is."""
    one, other = entries(net), entries(mirrored(net))
    assert one.keys() == other.keys()
    for pair in one:
        for a, b in zip(one[pair], other[pair], strict=True):
            assert a == pytest.approx(b, abs=1e-4)
    assert any(e["prio"] for found in one.values() for e in found)


def test_order_of_lanes_does_not_matter():
    net = intersection(arms=(0, 80, 180, 260), lanes=2)
    one = entries(net)
    for seed in range(3):
        other = entries(shuffled(net, seed))
        assert one.keys() == other.keys()
        for pair in one:
            for a, b in zip(one[pair], other[pair], strict=True):
                assert a == pytest.approx(b, abs=1e-4)


def test_signs_decide_before_turns():
    """A left turn on the main road yields to nothing from the side; everything from the side yields."""
    net = intersection(control={0: Control.PRIORITY, 2: Control.PRIORITY, 1: Control.YIELD, 3: Control.STOP})
    found = yields(net)
    sides = {pair for pair in entries(net) if pair[0][2] in "13" and pair[1][2] in "02"}
    assert sides and sides <= found
    assert not {(foe, lane) for lane, foe in sides} & found
    assert ("in0_0>out3_0", "in2_0>out0_0") in found  # opposing left turn yields to straight
    assert ("in0_0>out3_0", "in2_0>out3_0") in found  # and to the right turn into the same lane
    assert not priority_cycles(build_conflicts(net, rows(net)))


def test_opposing_left_turn_yields_under_a_signal():
    net = intersection(control=dict.fromkeys(range(4), Control.SIGNAL))
    assert ("in0_0>out3_0", "in2_0>out0_0") in yields(net)


def test_file_decides_before_everything():
    net = intersection(control={0: Control.PRIORITY, 1: Control.YIELD})
    main, side = (next(m for m in net.movements if m.via == (v,)) for v in ("in0_0>out2_0", "in1_0>out3_0"))
    assert (side.via[0], main.via[0]) in yields(net)
    movements = list(net.movements)
    movements[main.index] = dataclasses.replace(main, yields_to=frozenset({side.index}))
    told = dataclasses.replace(net, movements=tuple(movements))
    assert (main.via[0], side.via[0]) in yields(told)
    movements[side.index] = dataclasses.replace(side, yields_to=frozenset({main.index}))
    both = only(dataclasses.replace(net, movements=tuple(movements)), main.via[0], side.via[0])
    assert both["prio"] == 0


def test_right_before_left_at_a_tee_and_its_mirror_image():
    """Two straight paths cross at a right angle; the one from the right goes first."""

    def net(left_hand):
        a = straight("from_south", (0, -20), math.pi / 2, 40, junction="J")
        b = straight("from_east", (20, 0), math.pi, 40, junction="J")
        built = network([a, b])
        roads = {r.id: dataclasses.replace(r, left_hand=left_hand) for r in built.roads.values()}
        return dataclasses.replace(built, roads=roads)

    assert yields(net(False)) == {("from_south", "from_east")}
    assert yields(net(True)) == {("from_east", "from_south")}


def test_straight_before_turn_and_u_turn_last():
    net = intersection(arms=(0, 90, 180), u_turns=True, radius=20.0)
    found = yields(net)
    through = "in0_0>out2_0"
    for foe in ("in1_0>out2_0", "in1_0>out0_0", "in2_0>out2_0"):
        assert (foe, through) in found
    u_turns = {pair for pair in entries(net) if pair[0] == "in2_0>out2_0" and pair[1][2] != "2"}
    assert u_turns and u_turns <= found


def test_circulating_traffic_goes_first():
    net = roundabout()
    table = build_conflicts(net, rows(net))
    for a in range(4):
        assert (f"{a}:enter", f"{a}:on") in yields(net)
        assert table.clear_s[table.connector[rows(net)[f"{a}:leave"]]] == 0  # parts, but meets no vehicle
    # Without the ring, the rule of turns alone would decide; make the entry straight to see the ring win.
    straightened = tuple(
        dataclasses.replace(m, turn=Turn.STRAIGHT if ":enter" in m.via[0] else Turn.RIGHT)
        for m in net.movements
    )
    for a in range(4):
        pair = f"{a}:enter", f"{a}:on"
        assert pair in yields(dataclasses.replace(net, movements=straightened))
    # Cut open, it is no ring: then the straight one goes first.
    lanes = dict(net.lanes)
    lanes["ring2"] = dataclasses.replace(lanes["ring2"], successors=("3:leave",))
    broken = dataclasses.replace(net, movements=straightened, lanes=lanes)
    assert ("0:on", "0:enter") in yields(broken)


def test_a_city_block_is_no_roundabout():
    """Four left turns round a square of sharp corners lead back too, but do not make a ring."""
    side, corner = 60.0, 6.0
    lanes, at, heading = [], np.array([0.0, 0.0]), 0.0
    for i in range(4):
        way = np.array([math.cos(heading), math.sin(heading)])
        lanes.append(straight(f"s{i}", at, heading, side, successors=(f"c{i}",)))
        at = at + side * way
        to = at + corner * way + corner * np.array([-way[1], way[0]])
        center = at + corner * np.array([-way[1], way[0]])
        lanes.append(
            arc(
                f"c{i}",
                center,
                corner,
                heading - math.pi / 2,
                math.pi / 2,
                junction="J",
                successors=(f"s{(i + 1) % 4}",),
            )
        )
        at, heading = to, heading + math.pi / 2
    at = lanes[1].xyz[-1, :2]
    lanes.append(straight("side", at - [0, 30], math.pi / 2, 30.0, junction="J", successors=("s1",)))
    net = network(lanes)
    # Were it a ring, the block's own corner would go before the straight way in.
    assert ("c0", "side") in yields(net)


def test_ramps_yield_and_so_does_the_smaller_road():
    assert ("ramp", "main") in yields(merge(ramp_type=LaneType.ON_RAMP))
    net = merge()
    assert only(net, "main", "ramp")["prio"] == 0
    lanes = {**net.lanes, "main": dataclasses.replace(net.lanes["main"], speed_limit=33.0)}
    assert ("ramp", "main") in yields(dataclasses.replace(net, lanes=lanes))


@pytest.mark.parametrize("control", [Control.ZIPPER, Control.ALL_WAY_STOP])
def test_zipper_and_all_way_stop_are_equal(control):
    net = intersection(control=dict.fromkeys(range(4), control))
    found = [e for pair in entries(net).values() for e in pair]
    assert all(e["prio"] == 0 for e in found)
    assert any(e["tie"] for e in found) == (control is Control.ALL_WAY_STOP)


def test_cycles_are_broken_or_reported():
    net = intersection()
    table = build_conflicts(net, rows(net))
    assert priority_cycles(table) == []
    kept = build_conflicts(net, rows(net), break_cycles=False)
    cycles = priority_cycles(kept)
    assert cycles
    for cycle in cycles:
        for one, two in zip(cycle, cycle[1:] + cycle[:1], strict=True):
            slots = kept.foe[one] == two
            assert (kept.prio[one][slots] < 0).any()
    # What is no longer ordered keeps right before left for those that arrive together.
    straight_on = only(net, "in0_0>out2_0", "in1_0>out3_0")
    assert straight_on["prio"] == 0
    assert straight_on["tie"] == only(net, "in0_0>out2_0", "in1_0>out3_0", break_cycles=False)["prio"] != 0


def test_cycles_in_the_file_stay():
    net = intersection()
    names = ["in0_0>out2_0", "in1_0>out3_0", "in2_0>out0_0", "in3_0>out1_0"]
    by_via = {m.via[0]: m for m in net.movements}
    movements = list(net.movements)
    for one, two in zip(names, names[1:] + names[:1], strict=True):
        index = by_via[one].index
        movements[index] = dataclasses.replace(movements[index], yields_to=frozenset({by_via[two].index}))
    told = dataclasses.replace(net, movements=tuple(movements))
    table = build_conflicts(told, rows(told))
    ids = list(rows(told))
    (cycle,) = priority_cycles(table)
    assert {ids[table.lane[k]] for k in cycle} == set(names)


# --- the table --------------------------------------------------------------------------------


def test_waiting_point_of_a_left_turn():
    net = intersection(radius=22.0)
    table = build_conflicts(net, rows(net))
    k = table.connector[rows(net)["in0_0>out3_0"]]
    first = table.s_in[k][table.prio[k] < 0].min()
    assert table.wait_s[k] == pytest.approx(first - 1)
    assert table.wait_s[k] >= 6
    assert table.wait_s[table.connector[rows(net)["in0_0>out2_0"]]] == 0
    small = intersection(radius=12.0)
    table = build_conflicts(small, rows(small))
    assert (table.wait_s == 0).all()


@pytest.mark.parametrize("cut", [5.0, 12.0])
def test_waiting_point_of_a_movement_of_two_lanes(cut):
    """On the second lane the point is nearer by the first; past it there is none."""
    net = intersection(radius=22.0)
    name = "in0_0>out3_0"
    whole = net.lanes[name]
    links = {"successors": ("second",), "predecessors": whole.predecessors}
    first = lane_along(whole.pose(np.linspace(0, cut, 60))[0], "first", junction="J", **links)
    rest = whole.pose(np.linspace(cut, whole.length, 300))[0]
    second = lane_along(rest, "second", junction="J", successors=whole.successors, predecessors=("first",))
    lanes = {k: v for k, v in net.lanes.items() if k != name} | {"first": first, "second": second}
    lanes["in0_0"] = dataclasses.replace(
        lanes["in0_0"],
        successors=tuple("first" if x == name else x for x in lanes["in0_0"].successors),
    )
    movements = tuple(
        dataclasses.replace(m, via=("first", "second"), waits_inside=True) if m.via == (name,) else m
        for m in net.movements
    )
    split = dataclasses.replace(net, lanes=lanes, movements=movements)
    table, before = build_conflicts(split, rows(split)), build_conflicts(net, rows(net))
    one, two = (table.connector[rows(split)[x]] for x in ("first", "second"))
    expected = before.wait_s[before.connector[rows(net)[name]]]
    assert table.wait_s[one] == pytest.approx(expected, abs=0.02)
    assert table.wait_s[two] == pytest.approx(max(expected - cut, 0), abs=0.02)
    assert table.movement[one] == table.movement[two] >= 0


def test_shapes_order_and_padding():
    net = intersection(lanes=2)
    row = rows(net)
    table = build_conflicts(net, row)
    num, slots = table.foe.shape
    assert num == len(connectors(net)) + 1
    assert table.connector.shape == (len(row) + 1,)
    kinds = {np.dtype(np.float32), np.dtype(np.int32), np.dtype(np.bool_)}
    assert {x.dtype for x in vars(table).values()} == kinds
    for lane, r in row.items():
        k = table.connector[r]
        assert (k >= 0) == (net.lanes[lane].junction is not None)
        assert k < 0 or (table.lane[k] == r and table.length[k] == pytest.approx(net.lanes[lane].length))
    free = table.foe < 0
    assert (np.diff(table.s_in, axis=1) >= 0).all()
    assert (np.diff(free.astype(int), axis=1) >= 0).all()
    assert (table.s_in[free] == ABSENT).all() and (table.prio[free] == 0).all()
    crossing_or_merging = (table.type == ConflictType.CROSS) | (table.type == ConflictType.MERGE)
    np.testing.assert_array_equal(table.clear_s, np.where(crossing_or_merging, table.s_out, 0).max(1))
    crossing = table.type == ConflictType.CROSS
    np.testing.assert_array_equal(table.cross_s, np.where(crossing, table.s_out, 0).max(1))
    assert (table.cross_s < table.clear_s).any()
    padded = table.pad(lanes=len(row) + 20, connectors=num + 7, foes=slots + 5)
    for t in (table, padded):
        assert t.lane[-1] == t.connector[-1] == t.movement[-1] == -1
        assert (t.foe[-1] == -1).all() and (t.type[-1] == ConflictType.NONE).all()
    assert padded.foe.shape == (num + 7, slots + 5)
    for name, x in vars(table).items():
        p = getattr(padded, name)
        inner = tuple(slice(n) for n in (x.shape[0] - 1, *x.shape[1:]))
        np.testing.assert_array_equal(p[inner], x[:-1])
    # A padded row is as inert as the null row.
    np.testing.assert_array_equal(padded.foe[num - 1], padded.foe[-1])
    with pytest.raises(ValueError, match="does not fit"):
        table.pad(lanes=len(row) + 1, connectors=num - 1, foes=slots)


def test_the_first_connector_knows_its_stop_sign():
    net = intersection(lanes=1)
    movements = tuple(
        dataclasses.replace(m, control=Control.STOP) if m.index == 2 else m for m in net.movements
    )
    signed = dataclasses.replace(net, movements=movements)
    table = build_conflicts(signed, rows(signed))
    (stops,) = np.nonzero(table.must_stop)
    first = rows(signed)[net.movements[2].via[0]]
    assert table.lane[stops].tolist() == [first]


def test_a_network_without_junctions_has_an_empty_table():
    net = network([straight("a", (0, 0), 0.0, 50.0)])
    table = build_conflicts(net, rows(net))
    assert table.foe.shape == (1, 0)
    assert (table.connector == -1).all()
    assert priority_cycles(table) == []


# --- maps -------------------------------------------------------------------------------------


def sumo_nets():
    return sorted(SHARED.glob("sumo/*/*.net.xml"))


@pytest.mark.engine
@needs_shared
@pytest.mark.parametrize("path", sumo_nets(), ids=lambda path: path.parent.name)
def test_conflicts_are_the_foes_of_sumo(path):
    """Crossing and merging movements are those that SUMO's matrices declare, and so are priorities.

    SUMO also calls foes any two movements into one edge, on whichever lanes; those never come close.
    On the other side, of the turns that SUMO lets pass each other a few graze: opposing turns into
    different roads, which overlap for less than 3 m. Lanes of one road that it draws closer together than
    vehicles are wide are no foes to it.
    """
    net = read_network(path)
    drivable = rows(net)
    known = [m for m in net.movements if m.via and {m.incoming, m.outgoing, *m.via} <= drivable.keys()]
    through = {}
    for m in known:
        for lane in m.via:
            through.setdefault(lane, []).append(m)
    ours = {}
    for (lane, foe), found in entries(net).items():
        i, j = net.lanes[lane], net.lanes[foe]
        if i.road == j.road and not set(i.successors) & set(j.successors):
            continue
        for one in through.get(lane, []):
            for two in through.get(foe, []):
                meeting = [e for e in found if e["type"] != ConflictType.DIVERGE]
                if meeting:
                    ours.setdefault((one.index, two.index), []).extend(meeting)
    indices = {m.index for m in known}
    theirs = {(m.index, foe) for m in known for foe in m.foes & indices}
    theirs |= {(b, a) for a, b in theirs}
    for one, two in theirs - ours.keys():
        a, b = net.movements[one], net.movements[two]
        assert net.lanes[a.outgoing].road == net.lanes[b.outgoing].road
        assert a.outgoing != b.outgoing
    on_the_spot = {
        x for m in known for x in m.via if is_sharp(net.lanes[x]) or is_kinked(net.lanes[x], net.lanes)
    }
    swings = {m.index for m in known if on_the_spot & set(m.via)}  # SUMO has no bodies
    grazing = {pair for pair in ours.keys() - theirs if not swings & set(pair)}
    assert len(grazing) <= 0.01 * len(theirs)
    assert all(e["s_out"] - e["s_in"] < 3.0 for pair in grazing for e in ours[pair])
    for one, two in theirs & ours.keys():
        a, b = net.movements[one], net.movements[two]
        expected = (one in b.yields_to) - (two in a.yields_to)
        assert {e["prio"] for e in ours[one, two]} == {expected}


@pytest.mark.engine
@needs_shared
@pytest.mark.parametrize(
    "path",
    sorted(SHARED.glob("opendrive/*.xodr")) + sumo_nets(),
    ids=lambda path: f"{path.parent.name}-{path.stem}",
)
def test_tables_of_real_maps_hold_together(path):
    net = read_network(path)
    table = build_conflicts(net, rows(net))
    real = table.foe >= 0
    length = np.repeat(table.length[:, None], table.foe.shape[1], 1)
    assert (table.s_in[real] <= table.s_out[real]).all()
    assert (table.s_in[real] >= 0).all() and (table.s_out[real] <= length[real] * (1 + 1e-6)).all()
    assert (table.f_out[real] <= table.length[table.foe[real]] * (1 + 1e-6)).all()
    entry = np.stack(
        [table.lane[np.nonzero(real)[0]], table.lane[table.foe[real]], table.prio[real], table.type[real]]
    )
    mirror = np.stack([entry[1], entry[0], -entry[2], entry[3]])
    assert sorted(map(tuple, entry.T)) == sorted(map(tuple, mirror.T))
    assert (table.wait_s >= 0).all()
    assert priority_cycles(table) == []
