"""Kinds of faults that users of other tools have met in map files: links, gaps, lights, widths, records."""

from __future__ import annotations

import math
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
from paths import SHARED, needs_shared
from small_xodr import lane, link, notes, road, section, two_way

from limsim_jax.maps import read_network
from limsim_jax.maps.bridges import LEAP, TIGHTEST
from limsim_jax.maps.cut import without_gorges
from limsim_jax.maps.network import Action, Control, MapError, Network
from limsim_jax.maps.origins import origins
from limsim_jax.maps.routing import Round, default_goals

FAULTS = SHARED / "map_faults"


def fault(name: str) -> Network:
    return read_network(next(FAULTS.glob(f"{name}.*")), cache=False)


def ways(network: Network) -> set[tuple[str, str]]:
    """Roads that each drivable lane outside junctions leads to, also across them."""
    found = set()
    for x in network.drivable_lanes():
        stack = list(x.successors) if x.junction is None and "~" not in x.id else []
        while stack:
            after = network.lanes[stack.pop()]
            if after.junction is None and "~" not in after.id:
                found.add((x.road, after.road))
            else:
                stack += after.successors
    return found


def leaps(network: Network) -> list[float]:
    """Distances (m) from lanes to those that they lead to, in widths of the narrower one."""
    found = [0.0]
    for x in network.drivable_lanes():
        for name in x.successors:
            y = network.lanes[name]
            gap = float(np.hypot(*(y.xyz[0] - x.xyz[-1])[:2]))
            found.append(gap / max(min(x.width[-1], y.width[0]), 1.0))
    return found


# --- the maps from public reports -------------------------------------------------------------------


@needs_shared
def test_broken_optional_records_cost_themselves_only():
    network = fault("a_empty_road_link")
    assert len(network.lanes) == 4 and [n.element for n in network.report.notes][:2] == [
        "predecessor", "successor",
    ]  # fmt: skip
    assert ways(network) == {("1", "2"), ("2", "1")}


@needs_shared
def test_links_without_lane_links_are_completed():
    assert {(m.incoming, m.outgoing) for m in fault("b_tee_no_lane_links").movements} == {
        (m.incoming, m.outgoing) for m in fault("b_tee_reference").movements
    }
    network = fault("c_road_links_only")
    assert ways(network) == {("1", "2"), ("2", "1")}
    (note,) = notes(network, "lane link")
    assert note.action is Action.REPAIRED


@needs_shared
def test_gaps_are_bridged_by_lanes_of_the_junction():
    network = fault("j_connections_to_ordinary_roads")
    assert len(network.movements) == 6 and max(leaps(network)) < 1e-6
    for movement in network.movements:
        (via,) = movement.via
        bridge = network.lanes[via]
        assert bridge.junction == movement.junction and bridge.road in network.roads
        assert np.abs(bridge.curvature).max() <= 1 / TIGHTEST
        assert via in network.junctions[movement.junction].connectors
    assert {m.turn.value for m in network.movements} == {"straight", "left", "right"}


@needs_shared
def test_road_of_no_length_is_passed_through():
    assert ways(fault("k_zero_length_road")) == {("1", "3")}


@needs_shared
def test_arrow_of_a_lane_with_one_way_governs_it():
    for angle in ("15", "30"):
        network = fault(f"r_arrow_left_{angle}deg")
        assert [m.control for m in network.movements] == [Control.SIGNAL] * 3, angle


@needs_shared
def test_ring_has_no_end():
    goals = default_goals(fault("m_self_loop"))
    assert goals == {"round 1": ("1_0_-2", "1_0_-1")} and isinstance(goals["round 1"], Round)


@needs_shared
def test_tracks_of_a_level_crossing_have_no_light():
    network = fault("s4_rail")
    rails = [m for m in network.movements if not network.lanes[m.incoming].drivable]
    assert rails and all(m.program is None for m in rails)


@needs_shared
def test_lane_is_closed_where_no_car_fits():
    network = read_network(SHARED / "opendrive/line_variable_width.xodr", cache=False)
    for x in network.drivable_lanes():
        assert x.width.min() >= 1.8, x.id
    assert len(default_goals(network)["1-"]) == 2, "the lane that ends is no way out"


@needs_shared
@pytest.mark.parametrize("path", sorted(FAULTS.glob("*.xodr")) + sorted(FAULTS.glob("*.net.xml")), ids=str)
def test_no_vehicle_leaps_more_than_a_lane_width(path):
    assert max(leaps(read_network(path, cache=False))) <= LEAP


# --- others of these kinds --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("record", "element"),
    [
        ('<predecessor elementType="lane" elementId="2"/>', "predecessor"),
        ('<successor elementType="road" elementId=""/>', "successor"),
        ('<successor elementType="road" elementId="2" contactPoint="start" elementS="x"/>', "successor"),
    ],
)
def test_road_links(read, record, element):
    network = read(road("1", [section(0, right=[lane(-1)])], links=record))
    (note,) = notes(network, element)
    assert note.action is Action.IGNORED and note.message.startswith("left out: attribute")


@pytest.mark.parametrize(
    ("inner", "element"),
    [
        ('<width sOffset="0" a="3"/><speed sOffset="0" max="fast" unit="km/h"/>', "speed"),
        ('<width sOffset="0" a="3"/><speed sOffset="0" max="50" unit="furlong"/>', "speed"),
        ('<width sOffset="0" a="3"/><roadMark sOffset="here" type="solid"/>', "roadMark"),
        ('<width sOffset="0" a="3"/><access sOffset="?" rule="allow"/>', "access"),
    ],
)
def test_records_of_lanes(read, inner, element):
    network = read(road("1", [section(0, right=[lane(-1, inner=inner)])]))
    (note,) = [n for n in notes(network, element) if n.message.startswith("left out")]
    assert note.action is Action.IGNORED and "road 1 lane -1" in note.where
    assert network.lanes["1_0_-1"].width[0] == 3.0


def test_signals_objects_and_junction_records(read):
    tail = (
        '<objects><object id="o" s="x" t="0"/><object id="p" s="5" t="0" type="crosswalk"/></objects>'
        '<signals><signal id="s" s="5" t="?"/><signal s="5" t="0"/><signal id="r" s="5" t="0"/></signals>'
    )
    junction = (
        '<junction id="9"><connection incomingRoad="1"/><priority high="1"/><controller/>'
        '<connection incomingRoad="1" connectingRoad="1" contactPoint="middle"/></junction>'
    )
    network = read(road("1", [section(0, right=[lane(-1)])], tail=tail), junction)
    left_out = [n.element for n in network.report.notes if n.message.startswith("left out")]
    assert sorted(left_out) == sorted(
        ["object", "signal", "signal", "connection", "priority", "controller", "connection"]
    )


@pytest.mark.parametrize(
    ("old", "new"),
    [('<width sOffset="0" a="3.5"/>', '<width sOffset="0" a="wide"/>'), ('hdg="0.0"', 'hdg="north"')],
)
def test_broken_geometry_still_refuses_the_map(read, old, new):
    whole = road("1", [section(0, right=[lane(-1)])])
    assert old in whole
    with pytest.raises(MapError):
        read(whole.replace(old, new))


@pytest.mark.parametrize("contact", ["start", "end", ""])
@pytest.mark.parametrize("gap", [0.0, 0.6, 3.0])
def test_lanes_that_coincide_are_linked(read, contact, gap):
    """Two roads end to end, whose link names no lanes; the second also the other way round."""
    left, right = [lane(2), lane(1)], [lane(-1), lane(-2)]
    first = road("1", [section(0, left, right)], links=link("successor", "2", contact))
    turned = contact == "end"
    second = road(
        "2", [section(0, left, right)], x=100.0 + gap + (100.0 if turned else 0.0),
        hdg=math.pi if turned else 0.0,
    )  # fmt: skip
    network = read(first, second)
    if gap > 1.0:
        assert not ways(network)
        (note,) = [n for n in notes(network, "lane link") if n.action is Action.UNUSABLE]
        assert "3.0 m apart" in note.message
    else:
        assert ways(network) == {("1", "2"), ("2", "1")}
        assert sum(len(x.successors) for x in network.lanes.values()) == 4


def test_sections_and_one_sided_roads(read):
    """Sections of a road are completed, too; a link between one-way roads that meet head on is a finding."""
    sections = [section(0, right=[lane(-1), lane(-2)]), section(50, right=[lane(-1), lane(-2, kind="bus")])]
    against = road("2", [section(0, left=[lane(1)])], x=100.0)
    network = read(road("1", sections, links=link("successor", "2", "start")), against)
    assert network.lanes["1_0_-2"].successors == ("1_1_-2",)
    assert not [n for n in network.report.notes if n.action is Action.UNUSABLE], "no way was ever meant"


def test_links_that_are_stated_stay_as_they_are(read):
    """One stated lane link is enough: a lane may end beside one that goes on."""
    first = road(
        "1", [section(0, right=[lane(-1, links={"successor": -1}), lane(-2)])],
        links=link("successor", "2", "start"),
    )  # fmt: skip
    second = road("2", [section(0, right=[lane(-1, links={"predecessor": -1}), lane(-2)])], x=100.0)
    network = read(first, second)
    assert network.lanes["1_0_-2"].successors == () and not notes(network, "lane link")


@pytest.mark.parametrize(
    ("turn", "away", "linked"),
    [
        (0, 12, True),
        (90, 12, True),
        (-60, 12, True),
        (180, 12, True),
        (0, -12, False),
        (30, 200, False),
        (180, 0, False),
    ],
)
def test_bridges_that_can_be_steered(read, turn, away, linked):
    """A road that goes on further, at an angle.

    One that begins behind the end of the other, or leads back beside it, has no bridge.
    """
    angle = math.radians(turn)
    first = road(
        "1", [section(0, right=[lane(-1, links={"successor": -1})])], links=link("successor", "2", "start")
    )
    x, y = 100 + away * math.cos(angle / 2), away * math.sin(angle / 2)
    second = road("2", [section(0, right=[lane(-1, links={"predecessor": -1})])], x=x, y=y, hdg=angle)
    network = read(first, second)
    assert (ways(network) == {("1", "2")}) is linked and max(leaps(network)) < 0.01
    (note,) = notes(network, "lane link")
    assert note.action is (Action.REPAIRED if linked else Action.UNUSABLE)
    for x in network.lanes.values():
        if "~" in x.id:
            before, after = network.lanes["1_0_-1"], network.lanes["2_0_-1"]
            np.testing.assert_allclose(x.xyz[[0, -1]], [before.xyz[-1], after.xyz[0]], atol=1e-9)
            np.testing.assert_allclose(
                np.exp(1j * x.heading[[0, -1]]), np.exp(1j * np.array([0, angle])), atol=1e-6
            )
            middle = np.linspace(0, x.length, 50)
            xyz, heading = x.pose(middle)
            steps = np.hypot(*np.diff(xyz[:, :2], axis=0).T)
            np.testing.assert_allclose(steps.sum(), x.length, rtol=2e-3)
            chord = np.arctan2(*np.diff(xyz[:, :2], axis=0).T[::-1])
            assert np.abs(np.angle(np.exp(1j * (chord - heading[:-1])))).max() < 0.1


@pytest.mark.parametrize("at", [0.5, 0.3])
def test_a_curve_that_turns_round_on_the_spot_is_cut(read, at):
    """A reference line runs ahead and then back on itself: the lane beside it leaps to the other side."""
    u = f'bU="120" cU="{-60 / at}"'
    shape = f'<paramPoly3 aU="0" {u} dU="0" aV="0" bV="0" cV="0" dV="0" pRange="normalized"/>'
    there, back = 60 * at, 60 * (1 - at) ** 2 / at
    network = read(road("1", [section(0, right=[lane(-1)])], length=there + back, shape=shape))
    first, second = network.lanes["1_0_-1"], network.lanes["1_1_-1"]
    assert not first.successors and not second.predecessors
    np.testing.assert_allclose([first.length, second.length], [there, back], atol=0.01)
    np.testing.assert_allclose(first.xyz[-1, :2], [there, -1.75], atol=0.01)
    np.testing.assert_allclose(second.xyz[0, :2], [there, 1.75], atol=0.01)
    assert abs(math.remainder(second.heading[0] - math.pi, 2 * math.pi)) < 1e-6
    (note,) = notes(network, "lane link")
    assert note.action is Action.UNUSABLE


@pytest.mark.parametrize(("away", "enters"), [(0.3, False), (1.5, False), (2.0, True), (6.0, True)])
def test_no_vehicle_enters_where_it_would_lie_on_another_road(read, away, enters):
    """A stub of 0.2 m that begins beside the end of another road."""
    stub = road("2", [section(0, right=[lane(-1)])], length=0.2, x=100.5, y=away)
    network = read(road("1", [section(0, right=[lane(-1)])]), stub)
    assert set(origins(network)) == ({"1", "2"} if enters else {"1"})


def test_numbers_off_by_one_link_lanes_that_begin_there(read):
    """Lane numbers of the second section are one off: the lane that begins where one ends is meant."""
    sections = [
        section(0, right=[lane(-1, links={"successor": -1}), lane(-2, links={"successor": -2})]),
        section(50, right=[lane(-1, links={"predecessor": -1}), lane(-2, links={"predecessor": -2})]),
    ]
    offsets = '<laneOffset s="0" a="0"/><laneOffset s="50" a="3.8"/>'
    network = read(road("1", sections, offsets=offsets))
    assert network.lanes["1_0_-1"].successors == ("1_1_-2",) and max(leaps(network)) < 0.2
    assert network.lanes["1_0_-2"].successors == ()


@pytest.mark.parametrize("position", ["first", "middle", "connecting"])
def test_roads_of_no_length(read, position):
    """A road of length 0 anywhere in a chain, or as the way across a junction."""
    both = [section(0, right=[lane(-1, links=two_way(-1))])]
    junction = ""
    before, after = link("predecessor", "1", "end"), link("successor", "3", "start")
    if position == "connecting":
        middle = road("2", both, junction=9, links=before + after, length=0.0, x=100.0)
        junction = (
            '<junction id="9"><connection incomingRoad="1" connectingRoad="2" contactPoint="start">'
            '<laneLink from="-1" to="-1"/></connection></junction>'
        )
        ahead, behind = (
            link("successor", "9", element="junction"),
            link("predecessor", "9", element="junction"),
        )
    else:
        middle = road("2", both, links=before + after, length=0.0, x=100.0)
        ahead, behind = link("successor", "2", "start"), link("predecessor", "2", "end")
    first = road("1", [section(0, right=[lane(-1, links={"successor": -1})])], links=ahead)
    last = road("3", [section(0, right=[lane(-1, links={"predecessor": -1})])], x=100.0, links=behind)
    files = [middle, first, last] if position == "first" else [first, middle, last]
    network = read(*files, junction)
    assert ways(network) == {("1", "3")} and "2" not in {x.road for x in network.lanes.values()}


@pytest.mark.parametrize("lights", [("10", "20"), ("20", "20"), ("10",), ("10", "20", "30")])
def test_arrows_choose_among_ways_only(read, lights):
    """One lane with one way straight on, and arrows over it of all kinds: the way is governed."""
    signals = "".join(
        f'<signal id="{k}" s="95" t="-2" dynamic="yes" orientation="+" country="OpenDRIVE" type="1000011" '
        f'subtype="{kind}"><validity fromLane="-1" toLane="-1"/></signal>'
        for k, kind in enumerate(lights)
    )
    first = road(
        "1", [section(0, right=[lane(-1)])], links=link("successor", "9", element="junction"),
        tail=f"<signals>{signals}</signals>",
    )  # fmt: skip
    across = road(
        "2", [section(0, right=[lane(-1, links=two_way(-1))])], length=20.0, x=100.0, junction=9,
        links=link("predecessor", "1", "end") + link("successor", "3", "start"),
    )  # fmt: skip
    last = road("3", [section(0, right=[lane(-1)])], x=120.0)
    junction = (
        '<junction id="9"><connection incomingRoad="1" connectingRoad="2" contactPoint="start">'
        '<laneLink from="-1" to="-1"/></connection></junction>'
    )
    network = read(first, across, last, junction)
    (movement,) = network.movements
    assert movement.control is Control.SIGNAL


def test_lanes_with_a_gorge(read):
    """The outer of two lanes narrows to 1 m for a stretch, and is closed there."""
    cubic = "".join(
        f'<width sOffset="{s}" a="{a}" b="{b}"/>'
        for s, a, b in [(0, 3.5, 0), (100, 3.5, -0.1), (125, 1.0, 0), (150, 1.0, 0.1), (175, 3.5, 0)]
    )
    network = without_gorges(
        read(road("1", [section(0, right=[lane(-1), lane(-2, inner=cubic)])], length=300.0))
    )
    outer = [x for x in network.lanes.values() if x.number == -2]
    closed = [x for x in outer if not x.drivable]
    assert len(closed) == 1 and closed[0].length == pytest.approx(41.5, abs=3.0)
    assert all(x.width.min() > 1.7 for x in outer if x.drivable)
    inner = [x for x in network.lanes.values() if x.number == -1]
    assert [b.id in a.successors for a, b in pairwise(inner)] == [True] * (len(inner) - 1)
    assert not inner[1].may_change_right and inner[0].may_change_right and inner[2].may_change_right


@needs_shared
def test_check_counts_links_that_lead_nowhere(tmp_path):
    text = (FAULTS / "c_road_links_only.xodr").read_text().replace('x="100', 'x="104')
    (tmp_path / "gap.xodr").write_text(text)
    done = subprocess.run(
        [sys.executable, "-m", "limsim_jax.cli", "map", "check", str(tmp_path / "gap.xodr")],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1 and "unusable" in done.stdout, done.stdout + done.stderr
