"""Junctions, lights and signs of small OpenDRIVE maps with known answers."""
# ruff: noqa: E501 (XML in one line is easier to read than XML in pieces)

import math

import pytest
from small_xodr import lane, link, notes, road, section, two_way

from limsim_jax.maps.network import Action, Control, SignKind, Turn


def crossing_map(*, signals="", connector_tail="", junction_extra="", incoming_tail="", controller=""):
    """West to east (road 1 to 2, via 10) and west to north (road 3, via 11); the end of 1 is at x = 0."""
    west = road(
        "1",
        [section(0, [], [lane(-1)])],
        x=-100.0,
        links=link("successor", "9", element="junction"),
        tail=incoming_tail,
    )
    east = road("2", [section(0, [], [lane(-1)])], x=20.0, links=link("predecessor", "9", element="junction"))
    north = road(
        "3",
        [section(0, [], [lane(-1)])],
        x=8.0 + 1.75,
        y=8.0 - 1.75 + 0.0,
        hdg=math.pi / 2,
        links=link("predecessor", "9", element="junction"),
    )
    straight = road(
        "10",
        [section(0, [], [lane(-1, links=two_way(-1))])],
        length=20.0,
        junction=9,
        links=link("predecessor", "1", "end") + link("successor", "2", "start"),
        tail=connector_tail,
    )
    radius = 8.0 + 1.75 - 1.75
    left = road(
        "11",
        [section(0, [], [lane(-1, links=two_way(-1))])],
        length=radius * math.pi / 2,
        junction=9,
        y=0.0,
        shape=f'<arc curvature="{1 / radius}"/>',
        links=link("predecessor", "1", "end") + link("successor", "3", "start"),
    )
    connections = "".join(
        f'<connection id="{i}" incomingRoad="1" connectingRoad="{r}" contactPoint="start">'
        '<laneLink from="-1" to="-1"/></connection>'
        for i, r in enumerate((10, 11))
    )
    return (
        west,
        east,
        north,
        straight,
        left,
        (f'<junction id="9" name="x">{connections}{junction_extra}</junction>{controller}'),
    )


def test_movements_of_a_junction(read):
    network = read(*crossing_map())
    ways = {(m.incoming, m.via, m.outgoing): m.turn for m in network.movements}
    assert ways == {
        ("1_0_-1", ("10_0_-1",), "2_0_-1"): Turn.STRAIGHT,
        ("1_0_-1", ("11_0_-1",), "3_0_-1"): Turn.LEFT,
    }
    assert network.junctions["9"].movements == (0, 1)
    assert network.lanes["10_0_-1"].junction == "9"
    assert all(m.control is Control.NONE for m in network.movements)


def test_light_named_by_reference_holds_for_the_whole_lane(read):
    signal = '<signals><signal id="5" s="5" t="-4" orientation="+" dynamic="yes" type="1000001" subtype="-1" country="OpenDRIVE"><validity fromLane="0" toLane="0"/></signal></signals>'
    reference = '<signals><signalReference id="5" s="0" t="0" orientation="-"><validity fromLane="-1" toLane="-1"/></signalReference></signals>'
    west, east, north, straight, left, junction = crossing_map(
        connector_tail=reference, controller='<controller id="c7"><control signalId="5"/></controller>'
    )
    pole = road("4", [section(0, [], [lane(-1)])], y=50.0, tail=signal)
    network = read(west, east, north, straight, left, junction, pole)
    (light,) = network.traffic_lights
    assert [spot.lane for spot in light.spots] == ["10_0_-1", "11_0_-1"]
    assert light.controller == "c7"
    assert light.position == pytest.approx((5.0, 46.0, 0.0))
    assert all(m.control is Control.SIGNAL for m in network.movements)
    assert any("extended to 11_0_-1" in n.message for n in notes(network, "traffic light"))


def test_arrow_light_governs_its_turn_only(read):
    tail = '<signals><signal id="5" s="99" t="-4" orientation="+" dynamic="yes" type="1000011" subtype="10" country=""/></signals>'
    network = read(*crossing_map(incoming_tail=tail))
    assert {m.turn: m.control for m in network.movements} == {
        Turn.STRAIGHT: Control.NONE,
        Turn.LEFT: Control.SIGNAL,
    }


@pytest.mark.parametrize(
    ("type_", "country", "subtype", "kind", "control"),
    [
        ("206", "OpenDRIVE", "-1", SignKind.STOP, Control.STOP),
        ("205", "DE", "", SignKind.YIELD, Control.YIELD),
        ("R1-1", "US", "", SignKind.STOP, Control.STOP),
        ("R1", "us", "2", SignKind.YIELD, Control.YIELD),
        ("306", "", "", SignKind.PRIORITY, Control.PRIORITY),
        ("999", "", "", SignKind.OTHER, Control.NONE),
        ("206", "FR", "", SignKind.OTHER, Control.NONE),
    ],
)
def test_signs_regulate_movements(read, type_, country, subtype, kind, control):
    tail = f'<signals><signal id="5" s="95" t="-4" orientation="+" dynamic="no" type="{type_}" subtype="{subtype}" country="{country}"/></signals>'
    network = read(*crossing_map(incoming_tail=tail))
    (sign,) = network.signs
    assert sign.kind is kind and [spot.lane for spot in sign.spots] == ["1_0_-1"]
    assert sign.spots[0].s == pytest.approx(95.0)
    assert {m.control for m in network.movements} == {control}
    assert bool(notes(network, "sign")) == (kind is SignKind.OTHER)


def test_sign_that_names_no_lane_is_placed_by_position(read):
    tail = '<signals><signal id="5" s="97" t="-4" orientation="-" dynamic="no" type="206" subtype="" country=""><validity fromLane="0" toLane="0"/></signal></signals>'
    network = read(*crossing_map(incoming_tail=tail))
    assert {m.control for m in network.movements} == {Control.STOP}
    assert any("by its position" in n.message for n in network.report.notes)


@pytest.mark.parametrize(
    ("country", "type_", "subtype", "value", "unit", "expected"),
    [
        ("DE", "274", "", "50", "", 50 / 3.6),
        ("OpenDRIVE", "274", "56", "-1", "", 60 / 3.6),
        ("DE", "274", "120", "0", "", 120 / 3.6),
        ("US", "R2-1", "", "35", "", 35 * 0.44704),
        ("SE", "c", "31", "5", "", 50 / 3.6),
        ("DE", "274", "", "20", "m/s", 20.0),
    ],
)
def test_speed_signs(read, country, type_, subtype, value, unit, expected):
    unit = f'unit="{unit}"' if unit else ""
    tail = f'<signals><signal id="5" s="50" t="-4" orientation="+" dynamic="no" type="{type_}" subtype="{subtype}" country="{country}" value="{value}" {unit}/></signals>'
    (sign,) = read(road("1", [section(0, [], [lane(-1)])], tail=tail)).signs
    assert sign.kind is SignKind.SPEED and sign.value == pytest.approx(expected)


def test_priority_records(read):
    network = read(
        *crossing_map(junction_extra='<priority high="10" low="11"/><priority high="10" low="55"/>')
    )
    straight, left = network.movements
    assert left.yields_to == {straight.index} and not straight.yields_to
    assert (straight.control, left.control) == (Control.PRIORITY, Control.YIELD)
    assert any("road 55 is on no movement" in n.message for n in network.report.notes)


def test_stop_line_and_crosswalk(read):
    tail = (
        '<objects><object id="1" type="roadMark" subtype="stopLine" s="96" t="-1.75" length="0.5" width="3.4" hdg="0"/>'
        '<object id="2" type="crosswalk" s="98.5" t="0" hdg="0"><outline>'
        '<cornerRoad s="97" t="-5"/><cornerRoad s="99.5" t="-5"/><cornerRoad s="99.5" t="5"/><cornerRoad s="97" t="5"/>'
        "</outline></object></objects>"
    )
    network = read(*crossing_map(incoming_tail=tail))
    (line,) = network.stop_lines
    assert (line.spot.lane, line.spot.s) == ("1_0_-1", pytest.approx(96.0))
    (walk,) = network.crosswalks
    (span,) = walk.spans
    assert span[0] == "1_0_-1" and span[1:] == pytest.approx((97.0, 99.5), abs=0.06)


def test_direct_junction(read):
    network = read(
        road("1", [section(0, [], [lane(-1), lane(-2)])], links=link("successor", "9", element="junction")),
        road(
            "2",
            [section(0, [], [lane(-1, links={"predecessor": -1})])],
            x=100.0,
            links=link("predecessor", "1", "end"),
        ),
        road(
            "3",
            [section(0, [], [lane(-1)])],
            x=100.0,
            y=-3.5,
            hdg=-0.1,
            links=link("predecessor", "9", element="junction"),
        ),
        '<junction id="9" type="direct">'
        '<connection id="0" incomingRoad="1" linkedRoad="2" contactPoint="start"><laneLink from="-1" to="-1"/></connection>'
        '<connection id="1" incomingRoad="1" linkedRoad="3" contactPoint="start"><laneLink from="-2" to="-1" overlapZone="10"/></connection>'
        "</junction>",
    )
    ways = {(m.incoming, m.via, m.outgoing, m.junction) for m in network.movements}
    assert ways == {("1_0_-1", (), "2_0_-1", "9"), ("1_0_-2", (), "3_0_-1", "9")}
    assert network.lane_at("1", -2, 0).successors == ("3_0_-1",)


def test_virtual_junction_attaches_inside_the_main_road(read):
    main = road("1", [section(0, [], [lane(-1)])])
    drive = road(
        "2",
        [section(0, [], [lane(-1, links={"successor": -1})])],
        x=50,
        y=-71.75,
        hdg=math.pi / 2,
        length=50,
        links=link("successor", "20", "start"),
    )
    into = road(
        "20",
        [section(0, [], [lane(-1, links=two_way(-1))])],
        x=50,
        y=-21.75,
        hdg=math.pi / 2,
        length=10.0,
        junction=9,
        links=link("predecessor", "2", "end") + link("successor", "1", more=' elementS="60" elementDir="+"'),
    )
    junction = '<junction id="9" type="virtual" mainRoad="1" sStart="40" sEnd="60" orientation="none"><connection id="0" incomingRoad="2" connectingRoad="20" contactPoint="start"><laneLink from="-1" to="-1"/></connection></junction>'
    network = read(main, drive, into, junction)
    before, after = network.lane_at("1", -1, 10), network.lane_at("1", -1, 90)
    assert before.id != after.id and after.road_s[0] == 60.0
    across = f"20_0_-1~{after.id}"  # the connecting road of this file ends 10 m before the main road
    assert set(after.predecessors) == {before.id, across}
    (movement,) = network.movements
    assert (movement.incoming, movement.via, movement.outgoing) == ("2_0_-1", ("20_0_-1", across), after.id)


def test_missing_contact_point_and_lane_links_are_repaired(read):
    west, east, north, straight, left, _ = crossing_map()
    network = read(
        west,
        east,
        north,
        straight.replace(' contactPoint="end"', ""),
        left,
        '<junction id="9"><connection id="0" incomingRoad="1" connectingRoad="10" contactPoint="start"/></junction>',
    )
    assert any(m.via == ("10_0_-1",) for m in network.movements)
    assert {n.element for n in network.report.notes if n.action is Action.REPAIRED} == {
        "connection",
        "road link",
    }


def test_bend_of_the_road_itself_is_no_turn(read):
    """A motorway that bends left inside a junction, and an exit that leaves it to the right."""
    radius, length = 200.0, 150.0
    bend, exit_ = length / radius, length / -400.0

    def end(k, s):
        return math.sin(k * s) / k, (1 - math.cos(k * s)) / k

    def after(name, k):
        x, y = end(k, length)
        return road(name, [section(0, [], [lane(-1)])], x=x, y=y, hdg=k * length)

    def way(name, k, to):
        links = link("predecessor", "1", "end") + link("successor", to, "start")
        return road(
            name,
            [section(0, [], [lane(-1, links=two_way(-1))])],
            length=length,
            shape=f'<arc curvature="{k}"/>',
            junction=9,
            links=links,
        )

    connections = "".join(
        f'<connection id="{r}" incomingRoad="1" connectingRoad="{r}" contactPoint="start">'
        '<laneLink from="-1" to="-1"/></connection>'
        for r in (10, 11)
    )
    network = read(
        road("1", [section(0, [], [lane(-1)])], x=-100.0, links=link("successor", "9", element="junction")),
        after("2", 1 / radius),
        after("3", -1 / 400),
        way("10", 1 / radius, "2"),
        way("11", -1 / 400, "3"),
        f'<junction id="9">{connections}</junction>',
    )
    assert bend > math.radians(40) and abs(exit_) > math.radians(20)
    turns = {m.outgoing: m.turn for m in network.movements}
    # the exit bends less, so it is the way straight on, and the motorway turns from it by 64 degrees
    assert turns["3_0_-1"] is Turn.STRAIGHT and turns["2_0_-1"] is Turn.LEFT
    only = read(
        road("1", [section(0, [], [lane(-1)])], x=-100.0, links=link("successor", "9", element="junction")),
        after("2", 1 / radius),
        way("10", 1 / radius, "2"),
        f'<junction id="9">{connections.split("</connection>")[0]}</connection></junction>',
    )
    assert [m.turn for m in only.movements] == [Turn.STRAIGHT]
