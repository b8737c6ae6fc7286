"""The OpenDRIVE reader against closed forms and small maps with known answers."""
# ruff: noqa: E501 (XML in one line is easier to read than XML in pieces)

import gzip
import math
from itertools import pairwise

import numpy as np
import pytest
from paths import SHARED, needs_shared
from scipy.special import fresnel

from limsim_jax.maps.check import seams
from limsim_jax.maps.network import Action, Control, MapError, Network, SignKind, Turn
from limsim_jax.maps.opendrive import read_opendrive
from limsim_jax.maps.opendrive.curves import Cubics, Geometry, Kind, ReferenceLine
from limsim_jax.maps.opendrive.lanes import crossing
from limsim_jax.maps.opendrive.records import Mark

# --- writing small maps -------------------------------------------------------------------------

LINE = "<line/>"


def lane(number, *, width=3.5, kind="driving", links: dict[str, int] | None = None, inner=""):
    link = "".join(f'<{k} id="{v}"/>' for k, v in (links or {}).items())
    mark = "" if "<roadMark" in inner else '<roadMark sOffset="0" type="broken"/>'
    shape = "" if "<border" in inner or "<width" in inner else f'<width sOffset="0" a="{width}"/>'
    return f'<lane id="{number}" type="{kind}"><link>{link}</link>{shape}{mark}{inner}</lane>'


def section(s, left=(), right=(), center=""):
    side = lambda name, lanes: f"<{name}>{''.join(lanes)}</{name}>" if lanes else ""  # noqa: E731
    center = center or '<lane id="0" type="none"><roadMark sOffset="0" type="solid"/></lane>'
    return (
        f'<laneSection s="{s}">{side("left", left)}<center>{center}</center>'
        f"{side('right', right)}</laneSection>"
    )


def road(
    name,
    sections,
    *,
    length=100.0,
    x=0.0,
    y=0.0,
    hdg=0.0,
    shape=LINE,
    junction=-1,
    links="",
    head="",
    extra="",
    rule="",
    offsets="",
    tail="",
):
    rule = f' rule="{rule}"' if rule else ""
    geometry = f'<geometry s="0" x="{x}" y="{y}" hdg="{hdg}" length="{length}">{shape}</geometry>'
    return (
        f'<road id="{name}" length="{length}" junction="{junction}"{rule}><link>{links}</link>{head}'
        f"<planView>{geometry}</planView>{extra}<lanes>{offsets}{''.join(sections)}</lanes>{tail}</road>"
    )


def link(kind, name, contact="", element="road", more=""):
    contact = f' contactPoint="{contact}"' if contact else ""
    return f'<{kind} elementType="{element}" elementId="{name}"{contact}{more}/>'


@pytest.fixture
def read(tmp_path):
    def build(*elements, packed=False) -> Network:
        text = f'<OpenDRIVE>\n<header revMajor="1" revMinor="7"/>\n{chr(10).join(elements)}\n</OpenDRIVE>'
        path = tmp_path / "map.xodr"
        path.write_bytes(gzip.compress(text.encode()) if packed else text.encode())
        return read_opendrive(path)

    return build


def notes(network: Network, element: str):
    return [n for n in network.report.notes if n.element == element]


# --- geometry -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("k0", "k1", "length"),
    [(0.0, 0.02, 100.0), (-0.01, 0.04, 80.0), (0.1, -0.1, 60.0), (0.0, -0.5, 12.0), (0.002, 0.0, 900.0)],
)
def test_clothoid_against_fresnel_integrals(k0, k1, length):
    c = (k1 - k0) / length
    g = Geometry(s=0, x=3, y=-4, heading=0.7, length=length, kind=Kind.CLOTHOID, curvature=k0, sharpness=c)
    s = np.linspace(0, length, 101)
    x, y, heading, curvature, _ = ReferenceLine([g]).frame(s, s)
    # standard form: shift the parameter to where the curvature is zero
    scale, sign, s0 = math.sqrt(math.pi / abs(c)), math.copysign(1, c), -k0 / c
    base = 0.7 - c * s0**2 / 2

    def point(s):
        sin, cos = fresnel((s - s0) / scale)
        return scale * (cos + 1j * sign * sin) * np.exp(1j * base)

    expected = 3 - 4j + point(s) - point(0.0)
    assert np.abs(x + 1j * y - expected).max() < 1e-6
    assert np.abs(x + 1j * y - expected).max() < 1e-9  # what it really is
    np.testing.assert_allclose(heading, 0.7 + k0 * s + c * s**2 / 2, atol=1e-12)
    np.testing.assert_allclose(curvature, k0 + c * s, atol=1e-12)


@pytest.mark.parametrize("difference", [0.0, 1e-15, 1e-9])
def test_spiral_with_equal_curvatures_is_an_arc(difference):
    k, length = 0.05, 40.0
    g = Geometry(
        s=0,
        x=0,
        y=0,
        heading=0,
        length=length,
        kind=Kind.CLOTHOID,
        curvature=k,
        sharpness=difference / length,
    )
    s = np.linspace(0, length, 9)
    x, y, *_ = ReferenceLine([g]).frame(s, s)
    np.testing.assert_allclose(x, np.sin(k * s) / k, atol=1e-6)
    np.testing.assert_allclose(y, (1 - np.cos(k * s)) / k, atol=1e-6)


def test_arc_of_no_curvature_is_a_line():
    g = Geometry(s=0, x=1, y=2, heading=0.3, length=50, kind=Kind.CLOTHOID, curvature=0.0)
    s = np.array([0.0, 20.0, 50.0])
    x, y, *_ = ReferenceLine([g]).frame(s, s)
    np.testing.assert_allclose(x, 1 + s * math.cos(0.3))
    np.testing.assert_allclose(y, 2 + s * math.sin(0.3))


def test_parametric_curve_is_measured_by_arc_length():
    # a parabola v = c u^2: arc length in closed form
    c, u_end = 0.01, 60.0
    arc = lambda u: u / 2 * np.sqrt(1 + (2 * c * u) ** 2) + np.arcsinh(2 * c * u) / (4 * c)  # noqa: E731
    length = float(arc(u_end))
    for p_end in (None, 1.0):  # poly3, and the same as normalized paramPoly3
        f = 1.0 if p_end is None else u_end
        g = Geometry(
            s=0,
            x=0,
            y=0,
            heading=0,
            length=length,
            kind=Kind.PARAMETRIC,
            u=(0, f, 0, 0),
            v=(0, 0, c * f**2, 0),
            p_end=p_end,
        )
        s = np.linspace(0, length, 37)
        x, y, heading, curvature, rate = ReferenceLine([g]).frame(s, s)
        np.testing.assert_allclose(arc(x), s, atol=1e-8)
        np.testing.assert_allclose(y, c * x**2, atol=1e-9)
        np.testing.assert_allclose(heading, np.arctan(2 * c * x), atol=1e-9)
        np.testing.assert_allclose(curvature, 2 * c / (1 + (2 * c * x) ** 2) ** 1.5, atol=1e-9)
        np.testing.assert_allclose(rate[1:-1], np.gradient(curvature, s)[1:-1], rtol=2e-2, atol=1e-6)


def test_cubics_take_the_later_of_two_records_at_one_place():
    f = Cubics([(0, 1, 0, 0, 0), (10, 2, 0.5, 0, 0), (10, 3, 0, 0.1, 0)])
    s = np.array([5.0, 10.0, 12.0])
    np.testing.assert_allclose(f(s, s), [1, 3, 3.4])
    np.testing.assert_allclose(f.jet(s, s)[1], [0, 0, 0.4])
    np.testing.assert_allclose(f(np.array([10.0]), np.array([9.0])), [1])  # left limit


def test_lane_on_an_arc_has_its_own_radius_and_length(read):
    k, length = 0.02, 60.0
    network = read(
        road(
            "1",
            [section(0, [lane(1, width=3.0)], [lane(-1), lane(-2, width=2.0)])],
            length=length,
            shape=f'<arc curvature="{k}"/>',
        )
    )
    for number, t in ((1, 1.5), (-1, -1.75), (-2, -4.5)):
        found = network.lane_at("1", number, 10.0)
        radius = 1 / k - t
        assert found.length == pytest.approx(length * radius * k, abs=1e-9)
        turn = 1 if number < 0 else -1  # the left lane runs the other way: it bends right
        np.testing.assert_allclose(found.curvature, turn / radius, rtol=1e-12)
        xyz, heading = found.pose(np.linspace(0, found.length, 50))
        np.testing.assert_allclose(np.hypot(xyz[:, 0], xyz[:, 1] - 1 / k), radius, atol=1e-4)
        away = np.arctan2(xyz[:, 1] - 1 / k, xyz[:, 0])
        np.testing.assert_allclose(np.cos(heading - away - turn * math.pi / 2), 1, atol=1e-8)


def test_lane_with_changing_width_measures_and_heads_along_its_centre(read):
    widths = '<width sOffset="0" a="2" b="0.1"/><width sOffset="40" a="6"/>'
    network = read(road("1", [section(0, [], [lane(-1, inner=widths)])], length=60.0))
    found = network.lane_at("1", -1, 0.0)
    assert found.length == pytest.approx(40 * math.hypot(1, 0.05) + 20, abs=2e-3)
    s = np.array([10.0, 50.0])
    np.testing.assert_allclose(found.pose(s)[1], [-math.atan(0.05), 0.0], atol=1e-9)
    np.testing.assert_allclose(
        found.width_at(found.s_at_road(np.array([0, 20, 40, 55]))), [2, 4, 6, 6], atol=1e-3
    )


def test_borders_define_lanes_and_lane_offset_moves_them(read):
    borders = [
        lane(-1, inner='<border sOffset="0" a="-3"/>'),
        lane(-2, inner='<border sOffset="0" a="-7" b="0.01"/>'),
    ]
    network = read(
        road("1", [section(0, [], borders)], offsets='<laneOffset s="0" a="0.5"/>'),
    )
    xyz, _ = network.lane_at("1", -1, 0).pose(0.0)
    np.testing.assert_allclose(xyz[:2], [0, 0.5 - 1.5], atol=1e-12)
    second = network.lane_at("1", -2, 0)
    np.testing.assert_allclose(second.width[[0, -1]], [4, 3], atol=1e-12)


def test_negative_width_is_zero_and_reported(read):
    network = read(road("1", [section(0, [], [lane(-1, inner='<width sOffset="0" a="1" b="-0.02"/>')])]))
    assert network.lane_at("1", -1, 0).width.min() == 0.0
    (note,) = notes(network, "lane width")
    assert note.action is Action.REPAIRED and "-1.000" in note.message


def test_elevation_is_kept_and_superelevation_reported(read):
    extra = (
        '<elevationProfile><elevation s="0" a="5" b="0.1"/></elevationProfile>'
        '<lateralProfile><superelevation s="0" a="0.05"/></lateralProfile>'
    )
    network = read(road("1", [section(0, [], [lane(-1)])], extra=extra))
    np.testing.assert_allclose(network.lane_at("1", -1, 0).pose(50.0)[0][2], 10.0)
    (note,) = notes(network, "superelevation")
    assert "0.050 rad" in note.message and note.line is not None


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


def two_way(links):
    return {"predecessor": links, "successor": links}


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


# --- junctions ----------------------------------------------------------------------------------


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
        y=-60,
        hdg=math.pi / 2,
        length=50,
        links=link("successor", "20", "start"),
    )
    into = road(
        "20",
        [section(0, [], [lane(-1, links=two_way(-1))])],
        x=50,
        y=-10,
        hdg=math.pi / 2,
        length=10.0,
        junction=9,
        links=link("predecessor", "2", "end") + link("successor", "1", more=' elementS="60" elementDir="+"'),
    )
    junction = '<junction id="9" type="virtual" mainRoad="1" sStart="40" sEnd="60" orientation="none"><connection id="0" incomingRoad="2" connectingRoad="20" contactPoint="start"><laneLink from="-1" to="-1"/></connection></junction>'
    network = read(main, drive, into, junction)
    before, after = network.lane_at("1", -1, 10), network.lane_at("1", -1, 90)
    assert before.id != after.id and after.road_s[0] == 60.0
    assert set(after.predecessors) == {before.id, "20_0_-1"}
    (movement,) = network.movements
    assert (movement.incoming, movement.via, movement.outgoing) == ("2_0_-1", ("20_0_-1",), after.id)


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
        (GOOD.replace('length="100.0"', 'length="-3"', 1), "needs a length above zero"),
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


def test_samples_keep_their_distance(read):
    """Records a hair apart must not leave samples between which headings are noise."""
    widths = "".join(f'<width sOffset="{s}" a="3.5"/>' for s in (0, 30, 30.0000000001, 30.0005, 60))
    network = read(road("1", [section(0, [], [lane(-1, inner=widths)])]))
    found = network.lane_at("1", -1, 0)
    assert np.diff(found.s).min() > 4e-4
    assert found.length == pytest.approx(100.0, abs=1e-12)
