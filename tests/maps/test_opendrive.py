"""The OpenDRIVE reader: lanes, links, faults of files, real maps."""
# ruff: noqa: E501 (XML in one line is easier to read than XML in pieces)

import math
from itertools import pairwise

import numpy as np
import pytest
from paths import SHARED, needs_shared
from small_xodr import lane, link, notes, road, section, two_way

from limsim_jax.maps.check import seams
from limsim_jax.maps.network import Action, MapError
from limsim_jax.maps.opendrive import read_opendrive
from limsim_jax.maps.opendrive.lanes import crossing
from limsim_jax.maps.opendrive.records import Mark

# --- directions, neighbours, permissions --------------------------------------------------------


@pytest.mark.parametrize("rule", ["RHT", "LHT"])
def test_travel_direction_and_neighbours_follow_the_rule(read, rule):
    network = read(road("1", [section(0, [lane(1), lane(2)], [lane(-1), lane(-2)])], rule=rule))
    at = lambda n: network.lane_at("1", n, 0)  # noqa: E731
    for number in (-2, -1, 1, 2):
        forward = (number < 0) == (rule == "RHT")
        np.testing.assert_allclose(np.cos(at(number).heading), 1 if forward else -1)
        assert (at(number).road_s[-1] > at(number).road_s[0]) == forward
    inner, outer = at(-1), at(-2)
    if rule == "RHT":
        assert (inner.right, inner.left, inner.opposite) == (outer.id, None, at(1).id)
        assert (outer.left, outer.right, outer.opposite) == (inner.id, None, None)
        assert inner.may_change_right and outer.may_change_left and not inner.may_change_left
    else:
        assert (inner.left, inner.right, inner.opposite) == (outer.id, None, at(1).id)
        assert (outer.right, outer.left) == (inner.id, None)


def test_lanes_without_width_are_passed_over(read):
    network = read(road("1", [section(0, [], [lane(-1), lane(-2, width=0), lane(-3)])]))
    assert network.lane_at("1", -1, 0).right == network.lane_at("1", -3, 0).id


@pytest.mark.parametrize(
    ("type_", "change", "number", "expected"),
    [  # expected: may cross towards larger t, towards smaller t
        ("broken", None, -1, (True, True)),
        ("none", None, -1, (True, True)),
        ("botts dots", None, -1, (True, True)),
        ("solid", None, -1, (False, False)),
        ("solid solid", None, -1, (False, False)),
        ("curb", None, -1, (False, False)),
        ("edge", None, -1, (False, False)),
        # right lanes: the first line is the inner one, on the side of larger t
        ("solid broken", None, -1, (True, False)),
        ("broken solid", None, -1, (False, True)),
        # left lanes: the inner line is on the side of smaller t
        ("solid broken", None, 1, (False, True)),
        ("broken solid", None, 1, (True, False)),
        # lane 0: from left to right
        ("solid broken", None, 0, (True, False)),
        ("solid", "both", -1, (True, True)),
        ("broken", "none", -1, (False, False)),
        ("broken", "increase", -1, (True, False)),
        ("broken", "decrease", 2, (False, True)),
    ],
)
def test_road_marks(type_, change, number, expected):
    assert crossing(Mark(s=0, type=type_, change=change), number) == expected
    assert crossing(Mark(s=0, type="broken", change=None, rules=("no passing",)), number) == (False, False)


def test_lanes_are_cut_only_where_something_changes(read):
    marks = (
        '<roadMark sOffset="0" type="broken"/><roadMark sOffset="20" type="broken"/>'
        '<roadMark sOffset="60" type="solid"/>'
    )
    network = read(
        road(
            "1",
            [section(0, [], [lane(-1, inner=marks), lane(-2)])],
            head='<type s="0" type="town"><speed max="50" unit="km/h"/></type>'
            '<type s="80" type="town"><speed max="30" unit="mph"/></type>',
        )
    )
    edges = sorted(lane.road_s[0] for lane in network.lanes.values() if lane.number == -1)
    assert edges == [0.0, 60.0, 80.0]
    chain = [network.lane_at("1", -1, s) for s in (0.0, 60.0, 80.0)]
    assert [lane.may_change_right for lane in chain] == [True, False, False]
    np.testing.assert_allclose([lane.speed_limit for lane in chain], [50 / 3.6, 50 / 3.6, 30 * 0.44704])
    assert all(b.id in a.successors and a.id in b.predecessors for a, b in pairwise(chain))


def test_lane_speed_prevails_and_units_count(read):
    lanes = [
        lane(-1, inner='<speed sOffset="0" max="20"/><speed sOffset="50" max="36" unit="km/h"/>'),
        lane(-2, inner='<speed sOffset="0" max="10" unit="mph"/>'),
        lane(-3),
    ]
    network = read(
        road("1", [section(0, [], lanes)], head='<type s="0" type="motorway"><speed max="no limit"/></type>')
    )
    limit = lambda n, s: network.lane_at("1", n, s).speed_limit  # noqa: E731
    assert [limit(-1, 0), limit(-1, 60)] == pytest.approx([20.0, 10.0])
    assert limit(-2, 0) == pytest.approx(4.4704)
    assert limit(-3, 0) == pytest.approx(130 / 3.6)
    assert notes(network, "speed limit")


# --- sections and links -------------------------------------------------------------------------


def test_sections_that_only_continue_are_joined(read):
    sections = [section(s, [], [lane(-1, links=two_way(-1))]) for s in (0, 0.02, 40, 40.3)]
    network = read(road("1", sections))
    assert len(network.lanes) == 1
    (only,) = network.lanes.values()
    assert only.length == pytest.approx(100.0) and not only.successors
    assert network.report.counts["laneSection joined to the one before", Action.READ] == 3


def test_section_of_no_length_is_left_out_and_links_pass_through(read):
    sections = [
        section(0, [], [lane(-1, links={"successor": -1}), lane(-2, links={"successor": -2})]),
        section(
            50,
            [],
            [
                lane(-1, links={"predecessor": -1, "successor": -2}),
                lane(-2, links={"predecessor": -2, "successor": -3}),
            ],
        ),
        section(
            50,
            [],
            [lane(-1), lane(-2, links={"predecessor": -1}), lane(-3, links={"predecessor": -2})],
        ),
    ]
    network = read(road("1", sections))
    first = network.lane_at("1", -1, 10)
    assert first.successors == (network.lane_at("1", -2, 60).id,)
    assert network.lane_at("1", -2, 10).successors == (network.lane_at("1", -3, 60).id,)
    assert [n.action for n in notes(network, "laneSection")] == [Action.REPAIRED]


def test_lane_split_and_merge_inside_a_road(read):
    sections = [
        section(0, [], [lane(-1, links={"successor": -1})]),
        section(
            40,
            [],
            [
                lane(-1, links={"predecessor": -1, "successor": -1}),
                lane(-2, links={"predecessor": -1, "successor": -1}),
            ],
        ),
        section(70, [], [lane(-1)]),
    ]
    network = read(road("1", sections))
    start, end = network.lane_at("1", -1, 0), network.lane_at("1", -1, 99)
    both = {network.lane_at("1", -1, 50).id, network.lane_at("1", -2, 50).id}
    assert set(start.successors) == both and set(end.predecessors) == both


@pytest.mark.parametrize("contact", ["start", "end"])
def test_roads_linked_at_either_end(read, contact):
    """Road 2 continues road 1; drawn forwards or backwards, its lane numbers change sign."""
    backwards = contact == "end"
    first = road(
        "1",
        [
            section(
                0,
                [lane(1, links={"successor": -1 if backwards else 1})],
                [lane(-1, links={"successor": 1 if backwards else -1})],
            )
        ],
        links=link("successor", "2", contact),
    )
    second = road(
        "2",
        [section(0, [lane(1)], [lane(-1)])],
        x=200.0 if backwards else 100.0,
        hdg=math.pi if backwards else 0.0,
    )
    network = read(first, second)
    east, west = (1, -1) if backwards else (-1, 1)
    assert network.lane_at("1", -1, 0).successors == (network.lane_at("2", east, 50).id,)
    assert network.lane_at("2", west, 50).successors == (network.lane_at("1", 1, 0).id,)
    assert not list(seams(network))


def test_circular_road_leads_into_itself(read):
    radius = 30.0
    ring = road(
        "1",
        [section(0, [], [lane(-1, links=two_way(-1))])],
        length=2 * math.pi * radius,
        shape=f'<arc curvature="{1 / radius}"/>',
        links=link("predecessor", "1", "end") + link("successor", "1", "start"),
    )
    (only,) = read(ring).lanes.values()
    assert only.successors == (only.id,) and only.predecessors == (only.id,)


def test_links_that_cannot_be_are_named(read):
    network = read(
        road(
            "1",
            [section(0, [lane(1)], [lane(-1, links={"successor": 1})])],
            links=link("successor", "2", "start"),
        ),
        road("2", [section(0, [lane(1)], [lane(-1)])], x=100.0, links=link("successor", "77", "start")),
        road(
            "3",
            [section(0, [], [lane(-1, links={"successor": -9})])],
            x=500,
            links=link("successor", "2", "start"),
        ),
    )
    text = [n.message for n in network.report.notes]
    assert any("both lanes end there" in m for m in text)
    assert any("road 77 is not in the file" in m for m in text)
    assert any("road 2 has no lane -9 at its start" in m for m in text)


def test_gap_between_lanes_is_kept_and_named(read):
    network = read(
        road(
            "1", [section(0, [], [lane(-1, links={"successor": -1})])], links=link("successor", "2", "start")
        ),
        road("2", [section(0, [], [lane(-1)])], x=100.0, y=0.3),
    )
    (note,) = notes(network, "lane link")
    assert "0.300 m apart" in note.message
    assert network.lane_at("2", -1, 0).xyz[0, 1] == pytest.approx(0.3 - 1.75)


# --- nothing in silence, nothing half-built -----------------------------------------------------


def test_every_unknown_element_is_counted(read):
    tail = '<railroad><switch/></railroad><userData code="a"/><userData code="b"/><surface><CRG/></surface><novelty/>'
    network = read(
        road("1", [section(0, [], [lane(-1, inner="<material/>")])], tail=tail), "<station id='7'/>"
    )
    counts = {e: n for (e, a), n in network.report.counts.items() if a is Action.IGNORED}
    assert counts == {
        "road/railroad": 1,
        "road/userData": 2,
        "road/surface": 1,
        "road/novelty": 1,
        "lane/material": 1,
        "OpenDRIVE/station": 1,
    }
    assert "not known to this reader" in next(
        n.message for n in network.report.notes if "novelty" in n.element
    )
    assert all(n.line for n in network.report.notes if n.action is Action.IGNORED)


def test_gzip_and_namespaces(read, tmp_path):
    assert len(read(road("1", [section(0, [], [lane(-1)])]), packed=True).lanes) == 1
    path = tmp_path / "ns.xodr"
    text = road("1", [section(0, [], [lane(-1)])])
    path.write_text(
        f'<OpenDRIVE xmlns="http://code.asam.net/simulation/standard/opendrive_schema">{text}</OpenDRIVE>'
    )
    assert len(read_opendrive(path).lanes) == 1


GOOD = road("1", [section(0, [], [lane(-1)])])


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (
            GOOD.replace('length="100.0"', 'length="nan"', 1),
            "attribute 'length' is 'nan', not a finite number",
        ),
        (GOOD.replace('length="100.0"', "", 1), "attribute 'length' is missing"),
        (GOOD.replace('length="100.0"', 'length="-3"', 1), "a road cannot be shorter than 0"),
        (GOOD.replace("<line/>", "<loop/>"), "unknown shape"),
        (GOOD.replace("<line/>", ""), "has no shape"),
        (GOOD.replace("<line/>", '<arc curvature="1e9"/>'), "curvature is in 1/m"),
        (GOOD.replace('hdg="0.0"', 'hdg="east"'), "attribute 'hdg' is 'east', not a finite number"),
        (GOOD.replace('lane id="-1"', 'lane id="1"'), "lane id 1 cannot stand in <right>"),
        (GOOD.replace('lane id="-1"', 'lane id="-1.5"'), "not a whole number"),
        (GOOD + GOOD, "id '1' is taken by line"),
        (GOOD.replace('junction="-1"', 'junction="-1" rule="middle"'), "not RHT or LHT"),
        (GOOD.replace('x="0.0"', 'x="1e300"'), "no finite geometry below 1e+08 m"),
        ("", "has no <road>"),
        ("<road id='1' length='5'></road>", "has no <planView>"),
        ("<road", "not well-formed XML"),
    ],
)
def test_bad_files_are_named_in_one_line(read, text, reason):
    with pytest.raises(MapError) as error:
        read(text)
    message = str(error.value)
    assert reason in message and "map.xodr" in message and "\n" not in message


def test_wrong_root_empty_and_entities(tmp_path):
    for text, reason in [
        (b"<net/>", "the root element is <net>, not <OpenDRIVE>"),
        (b"", "the file is empty"),
        (b"\x00\x01\x02", "not well-formed XML"),
        (b'<!DOCTYPE a [<!ENTITY x "y">]><OpenDRIVE>&x;</OpenDRIVE>', "entities"),
        (b"\x1f\x8bnonsense", "damaged gzip"),
    ]:
        path = tmp_path / "bad.xodr"
        path.write_bytes(text)
        with pytest.raises(MapError, match=reason):
            read_opendrive(path)
    with pytest.raises(MapError, match="no such file"):
        read_opendrive(tmp_path / "none.xodr")
    with pytest.raises(MapError, match="is a folder"):
        read_opendrive(tmp_path)


# --- real maps ----------------------------------------------------------------------------------

REAL = sorted((SHARED / "opendrive").glob("*.xodr"))


@pytest.mark.engine
@needs_shared
@pytest.mark.parametrize("path", REAL, ids=lambda p: p.stem)
def test_real_maps_load_and_every_seam_is_in_the_report(path):
    network = read_opendrive(path)
    assert network.lanes
    named = {n.where for n in network.report.notes if n.element == "lane link"}
    for seam in seams(network):
        assert f"{seam.before} to {seam.after}" in named
    for note in network.report.notes:
        assert note.message and note.where
    if path.stem.startswith("carla_town"):  # towns are continuous but for a handful of links
        links = sum(len(lane.successors) for lane in network.drivable_lanes())
        assert len(list(seams(network))) <= 0.02 * links
