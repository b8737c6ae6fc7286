"""The SUMO reader against sumolib, SUMO itself, closed forms, and files that are wrong."""

import functools
import gzip
import math
import random
import subprocess
import sys
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import Any

import maps_against_sumo as referee
import numpy as np
import pytest
import sumolib
from hypothesis import given, settings
from hypothesis import strategies as st
from lxml import etree
from paths import SHARED, needs_shared

from limsim_jax.maps.network import Action, Control, LaneType, MapError, Network
from limsim_jax.maps.sumo import VEHICLE_CLASSES, read_sumo
from limsim_jax.maps.sumo.shapes import Curve, distance_to_polyline, fit_polyline

SUMO = SHARED / "sumo"
NETS = sorted(SUMO.glob("*/*.net.xml"))


@pytest.fixture(scope="session")
def generated(tmp_path_factory) -> dict[str, Path]:
    pytest.importorskip("sumo", reason="eclipse-sumo is not installed")
    return referee.generate(tmp_path_factory.mktemp("generated"))


def net(edges: str, rest: str = "", attributes: str = "") -> str:
    return f'<net version="1.20" {attributes}>\n{edges}\n{rest}\n</net>\n'


def lane(
    edge: str, index: int, shape: str, length: float = 100.0, attributes: str = "", inner: str = ""
) -> str:
    place = f'id="{edge}_{index}" index="{index}"'
    return f'<lane {place} speed="10" length="{length}" shape="{shape}" {attributes}>{inner}</lane>'


def edge(name: str, *lanes: str, attributes: str = 'from="a" to="b"') -> str:
    return f'<edge id="{name}" {attributes}>{"".join(lanes)}</edge>'


def one_lane(shape: str, **kwargs: Any) -> str:
    return net(edge("e", lane("e", 0, shape, **kwargs)))


@pytest.fixture
def read(tmp_path):
    def reader(text: str, **kwargs) -> Network:
        path = tmp_path / "map.net.xml"
        path.write_text(text)
        return read_sumo(path, **kwargs)

    return reader


def notes(network: Network, action: Action, element: str) -> list[str]:
    return [n.message for n in network.report.notes if n.action is action and n.element == element]


# ---- against sumolib


compare = functools.cache(referee.compare)


def assert_equal(path: Path) -> Network:
    result, network = compare(path)
    assert result.mismatches == []
    assert result.compared["lane length"] == len(referee.without_bridges(network).lanes) > 0
    assert result.compared["link response"] + result.compared["phase"] > 0 or not network.movements
    assert_sound(network)
    return network


def assert_sound(network: Network) -> None:
    """Properties of any network."""
    for x in network.lanes.values():
        assert np.all(np.diff(x.s) > 0) and x.s[0] == 0, x.id
        assert np.all(np.diff(x.road_s) >= 0), x.id
        for array in (x.xyz, x.heading, x.curvature, x.width, x.road_s):
            assert np.isfinite(array).all() and len(array) == len(x.s), x.id
        for target in x.successors:
            assert x.id in network.lanes[target].predecessors
        if x.left is not None:
            assert network.lanes[x.left].right == x.id
    for i, m in enumerate(network.movements):
        assert m.index == i
        way = (m.incoming, *m.via, m.outgoing)
        for a, b in pairwise(way):
            assert b in network.lanes[a].successors
        assert all(network.movements[j].junction == m.junction for j in m.yields_to | m.foes)


@pytest.mark.engine
@needs_shared
@pytest.mark.parametrize("path", NETS, ids=[p.parent.name for p in NETS])
def test_equals_sumolib(path):
    assert_equal(path)


@pytest.mark.engine
@pytest.mark.parametrize("name", referee.GENERATED)
def test_generated_equal_sumolib(generated, name):
    network = assert_equal(generated[name])
    assert ("left-hand" in name) == all(road.left_hand for road in network.roads.values())


@pytest.mark.engine
def test_the_comparison_can_fail(generated, tmp_path, monkeypatch):
    """Each change of the file makes a mismatch of the expected kind."""
    path = generated["grid with lights, crossings, bicycle lanes"]
    changes = {
        "lane length": ("lane", "length", "77.77"),
        "lane speed": ("lane", "speed", "1.23"),
        "lane width": ("lane", "width", "9.9"),
        "lane permissions": ("lane", "allow", "ship"),
        "link dir": ("connection", "dir", "R"),
        "link signal": ("connection", "linkIndex", "1"),
        "link response": ("request", "response", "1"),
        "link foes": ("request", "foes", "1"),
        "phase": ("phase", "duration", "99"),
        "program": ("tlLogic", "offset", "5"),
    }
    tree = etree.parse(path)
    for tag, attribute, value in changes.values():
        elements = [e for e in tree.getroot().iter(tag) if attribute in e.attrib or tag == "lane"]
        element = next(e for e in elements if e.get("linkIndex", "0") == "0")
        bits = len(element.get(attribute, ""))
        element.set(attribute, value * bits if tag == "request" else value)
    tree.write(tmp_path / "changed.net.xml")
    network = read_sumo(tmp_path / "changed.net.xml")
    monkeypatch.setattr(referee, "read_sumo", lambda _: network)
    result, _ = referee.compare(path)
    assert {line.split(" of ")[0] for line in result.mismatches} >= set(changes)


def test_crossings_and_pedestrian_links(generated):
    network = read_sumo(generated["grid with lights, crossings, bicycle lanes"])
    assert network.crosswalks
    for crosswalk in network.crosswalks:
        assert crosswalk.spans, crosswalk.id
        for lane_id, lo, hi in crosswalk.spans:
            crossed = network.lanes[lane_id]
            inside = _inside(crosswalk.outline, crossed.pose((lo + hi) / 2)[0])
            assert 0 <= lo < hi <= crossed.length and inside
    on_foot = [
        m for m in network.movements if m.via and network.lanes[m.via[0]].road.rpartition("_")[2][0] == "c"
    ]
    assert len(on_foot) == len(network.crosswalks)
    yielding = {j for m in network.movements for j in m.yields_to}
    assert yielding & {m.index for m in on_foot}  # turning vehicles let pedestrians go first


def _inside(outline, point) -> bool:
    """Winding number, unlike the reader's even-odd rule."""
    corners = outline @ (1, 1j) - complex(point[0], point[1])
    return abs(np.angle(np.roll(corners, -1) / corners).sum()) > 1


# ---- against SUMO itself

libsumo_script = """
import sys, libsumo
libsumo.start(["sumo", *sys.argv[1:], "--no-step-log", "--no-warnings"])
"""


def run_libsumo(code: str, *arguments: str) -> list[str]:
    """Printed lines of a script that runs in a process of its own."""
    pytest.importorskip("libsumo")
    done = subprocess.run(
        [sys.executable, "-c", libsumo_script + code, *arguments], capture_output=True, text=True, check=True
    )
    return [line[2:] for line in done.stdout.splitlines() if line.startswith("> ")]


@pytest.mark.engine
@needs_shared
def test_program_in_use_is_sumos():
    folder = SUMO / "bologna_pasubio"
    files = [str(folder / "pasubio_buslanes.net.xml"), str(folder / "pasubio_tls.add.xml")]
    code = "for t in libsumo.trafficlight.getIDList(): print('>', t, libsumo.trafficlight.getProgram(t))"
    theirs = dict(line.split() for line in run_libsumo(code, "-n", files[0], "-a", files[1]))
    network = read_sumo(files[0], additional=[files[1]])
    lights = {m.program for m in network.movements if m.program}
    assert {t: network.programs[t].name for t in lights} == theirs
    assert set(theirs.values()) == {"utopia"}
    assert any(key.endswith(":0") or ":" in key for key in network.programs)  # those of the net stay
    assert notes(network, Action.APPROXIMATED, "tlLogic")


@pytest.mark.parametrize("left_hand", [False, True])
@pytest.mark.parametrize("attribute", ["changeLeft", "changeRight"])
def test_permission_to_change_lanes_is_sumos(read, tmp_path, left_hand, attribute):
    """A fast vehicle behind a slow one on the outer lane changes in SUMO if and only if it may here."""
    y = 1.6 if left_hand else -1.6
    outer = lane("e", 0, f"0,{3 * y} 500,{3 * y}", 500, f'{attribute}="authority"')
    text = net(
        edge("e", outer, lane("e", 1, f"0,{y} 500,{y}", 500)),
        '<junction id="a" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape="0,0 0,1"/>'
        '<junction id="b" type="dead_end" x="500" y="0" incLanes="e_0 e_1" intLanes="" shape="500,0 500,1"/>',
        f'lefthand="{str(left_hand).lower()}"',
    )
    network = read(text)
    mine = network.lanes["e_0"]
    neighbour, may = (mine.right, mine.may_change_right) if left_hand else (mine.left, mine.may_change_left)
    assert neighbour == "e_1"
    routes = tmp_path / "demand.rou.xml"
    routes.write_text(
        '<routes><route id="r" edges="e"/><vType id="slow" maxSpeed="3"/><vType id="fast" lcSpeedGain="10"/>'
        '<vehicle id="s" type="slow" route="r" depart="0" departLane="0" departPos="60"/>'
        '<vehicle id="f" type="fast" route="r" depart="0" departLane="0" departPos="5"/></routes>'
    )
    code = (
        "seen = set()\nfor _ in range(60):\n    libsumo.simulationStep()\n"
        "    if 'f' in libsumo.vehicle.getIDList(): seen.add(libsumo.vehicle.getLaneID('f'))\n"
        "print('>', 'e_1' in seen)"
    )
    assert run_libsumo(code, "-n", network.source, "-r", str(routes)) == [str(may)]


# ---- the meaning of elements


def junction_net(state: str = "m", connection: str = "", junction: str = "", extra: str = "") -> str:
    """Two roads that cross: `w` to `e` yields to `s` to `n` and waits inside twice."""
    edges = [
        edge(":j_0", lane(":j_0", 0, "0,0 4,0", 4), attributes='function="internal"'),
        edge(":j_2", lane(":j_2", 0, "4,0 6,1", 2.2), attributes='function="internal"'),
        edge(":j_3", lane(":j_3", 0, "6,1 10,3", 4.5), attributes='function="internal"'),
        edge(":j_1", lane(":j_1", 0, "5,-5 5,5", 10), attributes='function="internal"'),
        edge("w", lane("w", 0, "-100,0 0,0"), attributes='from="a" to="j"'),
        edge("e", lane("e", 0, "10,3 110,3"), attributes='from="j" to="b"'),
        edge("s", lane("s", 0, "5,-105 5,-5"), attributes='from="c" to="j"'),
        edge("n", lane("n", 0, "5,5 5,105"), attributes='from="j" to="d"'),
    ]
    ends = "".join(
        f'<junction id="{i}" type="dead_end" x="{x}" y="{y}" incLanes="{lanes}" intLanes="" shape="0,0 1,1"/>'
        for i, x, y, lanes in (
            ("a", -100, 0, ""),
            ("b", 110, 3, "e_0"),
            ("c", 5, -105, ""),
            ("d", 5, 105, "n_0"),
        )
    )
    rest = f"""
    <junction id="j" type="priority" x="5" y="0" incLanes="w_0 s_0" intLanes=":j_3_0 :j_1_0"
      shape="0,-5 10,-5 10,5 0,5" {junction}>
      <request index="0" response="10" foes="10" cont="1"/>
      <request index="1" response="00" foes="01" cont="0"/>
    </junction>
    {ends}
    <junction id=":j_2_0" type="internal" x="4" y="0" incLanes=":j_0_0" intLanes=":j_1_0"/>
    <junction id=":j_3_0" type="internal" x="6" y="1" incLanes=":j_2_0" intLanes=":j_1_0"/>
    <connection from="w" to="e" fromLane="0" toLane="0" via=":j_0_0" dir="s" state="{state}" {connection}/>
    <connection from="s" to="n" fromLane="0" toLane="0" via=":j_1_0" dir="s" state="M"/>
    <connection from=":j_0" to="e" fromLane="0" toLane="0" via=":j_2_0" dir="s" state="m"/>
    <connection from=":j_2" to="e" fromLane="0" toLane="0" via=":j_3_0" dir="s" state="m"/>
    <connection from=":j_3" to="e" fromLane="0" toLane="0" dir="s" state="M"/>
    <connection from=":j_1" to="n" fromLane="0" toLane="0" dir="s" state="M"/>
    {extra}"""
    return net("\n".join(edges), rest)


def test_movement_with_several_places_to_wait(read):
    network = read(junction_net())
    first, second = network.movements
    assert first.via == (":j_0_0", ":j_2_0", ":j_3_0")
    assert (first.yields_to, first.foes, first.waits_inside) == ({1}, {1}, True)
    assert (second.yields_to, second.foes, second.waits_inside) == (set(), {0}, False)
    assert first.keep_clear and first.control is Control.YIELD and second.control is Control.PRIORITY
    junction = network.junctions["j"]
    assert junction.connectors == (":j_0_0", ":j_2_0", ":j_3_0", ":j_1_0")
    assert junction.outline[2] == (10.0, 5.0) and junction.center == (5.0, 0.0) and not junction.roundabout
    for a, b in [(":j_0_0", ":j_2_0"), (":j_2_0", ":j_3_0")]:  # one curve, cut where vehicles wait
        a, b = network.lanes[a], network.lanes[b]
        assert np.allclose(a.xyz[-1], b.xyz[0], atol=1e-9)
        assert abs(a.heading[-1] - b.heading[0]) < 1e-9


@pytest.mark.parametrize(
    ("state", "control"),
    [("M", "priority"), ("m", "yield"), ("s", "stop"), ("w", "all_way_stop"), ("=", "none"), ("Z", "zipper")],
)
def test_link_states(read, state, control):
    network = read(junction_net(state, 'keepClear="0"'))
    assert network.movements[0].control == control and not network.movements[0].keep_clear
    lines = {line.spot.lane for line in network.stop_lines}
    assert ("w_0" in lines) == (control in {"yield", "stop", "all_way_stop"})


def test_signals(read):
    program = """<tlLogic id="t" type="actuated" programID="day" offset="7">
      <phase duration="30" state="Gr" minDur="5" maxDur="50" name="one" next="1 0"/>
      <phase duration="3" state="yr"/></tlLogic>
      <tlLogic id="t" type="static" programID="night" offset="0"><phase duration="9" state="oo"/></tlLogic>"""
    network = read(junction_net("o", 'tl="t" linkIndex="1"', extra=program))
    movement = network.movements[0]
    assert (movement.control, movement.program, movement.link) == (Control.SIGNAL, "t", 1)
    in_use, other = network.programs["t"], network.programs["t:day"]
    assert (in_use.name, other.name, other.type, other.offset) == ("night", "day", "actuated", 7.0)
    assert in_use.movements == other.movements == ((), (0,))
    phase = other.phases[0]
    assert (phase.duration, phase.state, phase.name, phase.next) == (30.0, "Gr", "one", (1, 0))
    assert (phase.min_duration, phase.max_duration) == (5.0, 50.0)
    assert (other.phases[1].min_duration, other.phases[1].next) == (None, ())
    (light,) = network.traffic_lights
    assert light.spots[0].lane == "w_0" and light.controller == "t" and light.position[:2] == (0.0, 0.0)


def test_light_without_program(read):
    network = read(junction_net("o", 'tl="t" linkIndex="0"'))
    assert network.movements[0].control is Control.YIELD and network.movements[0].program is None
    assert notes(network, Action.APPROXIMATED, "tlLogic")


def test_roundabout_and_unknown_elements_are_reported(read):
    extra = '<roundabout nodes="j" edges="w e"/><prohibition prohibitor="a" prohibited="b"/><odd/><odd/>'
    network = read(junction_net(extra=extra, junction='odd="1"'))
    assert network.junctions["j"].roundabout
    counts = network.report.counts
    assert counts["net/odd", Action.IGNORED] == 2 and len(notes(network, Action.IGNORED, "net/odd")) == 1
    assert counts["net/prohibition", Action.IGNORED] == 1 and counts["junction@odd", Action.IGNORED] == 1
    assert counts["roundabout", Action.READ] == 1


@pytest.mark.engine
@needs_shared
def test_every_element_is_in_the_report():
    """The report counts every element of the file."""
    for path in NETS:
        _, network = compare(path)
        root = etree.parse(path).getroot()
        counts: Counter[str] = Counter()
        for (name, _), count in network.report.counts.items():
            counts[name.rpartition("/")[2]] += count  # what is ignored stands as parent/tag
        for tag in {e.tag for e in root.iter() if isinstance(e.tag, str)} - {"net"}:
            assert counts[tag] >= len(list(root.iter(tag))), (path, tag)


@pytest.mark.parametrize("left_hand", [False, True])
def test_neighbours(read, left_hand):
    lanes = [lane("e", i, f"0,{3 * i} 100,{3 * i}") for i in range(3)]
    network = read(net(edge("e", *lanes), attributes=f'lefthand="{int(left_hand)}"'))
    inner, outer = ("right", "left") if left_hand else ("left", "right")
    middle = network.lanes["e_1"]
    assert (getattr(middle, inner), getattr(middle, outer)) == ("e_2", "e_0")
    assert middle.may_change_left and middle.may_change_right
    assert getattr(network.lanes["e_0"], outer) is None and not getattr(
        network.lanes["e_0"], f"may_change_{outer}"
    )


def test_permissions(read):
    attributes = [
        ("", LaneType.DRIVING),
        ('allow="pedestrian"', LaneType.SIDEWALK),
        ('allow="bicycle pedestrian"', LaneType.BIKING),
        ('allow="bus taxi bicycle"', LaneType.BUS),
        ('allow="taxi"', LaneType.TAXI),
        ('allow="tram"', LaneType.TRAM),
        ('allow="rail rail_electric"', LaneType.RAIL),
        ('allow="emergency authority"', LaneType.RESTRICTED),
        ('disallow="all"', LaneType.NONE),
        ('disallow="all" type="shoulder"', LaneType.SHOULDER),
        ('disallow="pedestrian"', LaneType.DRIVING),
        ('acceleration="1"', LaneType.ENTRY),
        ('allow="public_transport"', LaneType.BUS),
    ]
    lanes = [lane("e", i, f"0,{3 * i} 100,{3 * i}", attributes=a) for i, (a, _) in enumerate(attributes)]
    network = read(net(edge("e", *lanes)))
    found = list(network.lanes.values())
    assert [x.type for x in found] == [kind for _, kind in attributes]
    assert found[0].access == VEHICLE_CLASSES | {"car", "van"}
    assert found[10].access == found[0].access - {"pedestrian"}
    assert found[3].access == {"bus", "taxi", "bicycle"}
    assert [x.drivable for x in found] == [x.type in {"driving", "bus", "entry"} for x in found]
    assert not found[0].may_change_left and not found[5].may_change_right  # no class may use both lanes


def test_partial_permission_to_change_is_reported(read):
    a = lane("e", 0, "0,0 100,0", attributes='changeLeft="bus"')
    network = read(net(edge("e", a, lane("e", 1, "0,3 100,3", attributes='changeRight="emergency"'))))
    assert network.lanes["e_0"].may_change_left and not network.lanes["e_1"].may_change_right
    (message,) = notes(network, Action.APPROXIMATED, "lane")
    assert "only bus" in message


def test_three_dimensions_and_stop_offset(read):
    stop = '<stopOffset value="5"/>'
    network = read(one_lane("0,0,10 30,0,40 60,0,40", inner=stop))
    mine = network.lanes["e_0"]
    assert np.allclose(mine.pose([0.0, 15.0, 30.0, 45.0])[0][:, 2], [10, 25, 40, 40])
    network = read(junction_net("s").replace('shape="-100,0 0,0" >', 'shape="-100,0 0,0" >' + stop))
    (line,) = (x for x in network.stop_lines if x.spot.lane == "w_0")
    assert line.spot.s == pytest.approx(95.0)


def test_opposite_and_bidi(read):
    a = edge(
        "e", lane("e", 0, "0,0 100,0", inner='<neigh lane="f_0"/>'), attributes='from="a" to="b" bidi="f"'
    )
    b = edge("f", lane("f", 0, "100,3 0,3"), attributes='from="b" to="a"')
    network = read(net(a + b))
    assert network.lanes["e_0"].opposite == "f_0" and network.lanes["f_0"].opposite is None
    assert notes(network, Action.APPROXIMATED, "edge")


def test_declared_lengths(read):
    network = read(one_lane("0,0 100,0", length=200.0))
    mine = network.lanes["e_0"]
    assert (mine.declared_length, mine.length) == (200.0, 100.0)
    assert mine.road_s[-1] == 200.0 and network.roads["e"].length == 200.0
    assert notes(network, Action.APPROXIMATED, "lane@length")


def test_lanes_of_a_bend_lie_abreast(read):
    """The road coordinate leads from one lane to the point beside it, though their lengths differ."""
    lanes = []
    for i, radius in enumerate((50.0, 46.5, 43.0)):
        t = np.linspace(0, math.pi / 2, 31)
        arc = " ".join(f"{radius * math.sin(a):.3f},{50 - radius * math.cos(a):.3f}" for a in t)
        lanes.append(lane("e", i, f"-50,{50 - radius} {arc}", 50 + 46.5 * math.pi / 2))
    network = read(net(edge("e", *lanes)))
    a, b = network.lanes["e_0"], network.lanes["e_2"]
    s = np.linspace(0.05, 0.95, 40) * a.length
    p, heading = a.pose(s)
    q, _ = b.pose(b.s_at_road(np.interp(s, a.s, a.road_s)))
    across = np.stack([-np.sin(heading), np.cos(heading)], -1)
    assert np.abs(q[:, :2] - p[:, :2] - 7.0 * across).max() < 0.06
    assert a.length - b.length > 10


def test_lanes_that_reach_beyond_the_middle_one(read):
    shapes = ["0,0 100,0", "4,3 100,3", "-6,6 105,6"]
    network = read(net(edge("e", *(lane("e", i, shape, 96) for i, shape in enumerate(shapes)))))
    spans = [list(network.lanes[f"e_{i}"].road_s[[0, -1]]) for i in range(3)]
    assert spans == [[-4, 96], [0, 96], [-10, 101]]


# ---- shapes


def samples_of(curve: Curve) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    s = curve.samples()
    return s, *curve.at(s)


@pytest.mark.parametrize("sign", [1, -1])
def test_samples_of_a_circle_give_the_circle(sign):
    t = np.linspace(0, math.pi / 2, 6)
    points = np.stack([8 * np.sin(t), sign * 8 * (1 - np.cos(t)), 0 * t], -1)
    curve = fit_polyline(points, start_heading=0.0, end_heading=sign * math.pi / 2)
    _, xy, _, curvature = samples_of(curve)
    assert np.abs(np.hypot(xy[:, 0], xy[:, 1] - sign * 8) - 8).max() < 1e-12
    assert np.allclose(curvature, sign / 8) and curve.total == pytest.approx(4 * math.pi)


def test_corner_is_rounded_within_the_tolerance():
    points = np.array([[0, 0, 0], [50, 0, 0], [50, 50, 0]], float)
    curve = fit_polyline(points, tolerance=0.32)
    _, xy, heading, curvature = samples_of(curve)
    apex = np.hypot(*(curve.at(curve.vertex_s[1:2])[0][0] - points[1, :2]))
    assert apex == pytest.approx(0.32, abs=1e-9) and curve.deviation < 0.32
    assert heading[0] == 0 and heading[-1] == pytest.approx(math.pi / 2)
    reach = 0.32 / math.tan(math.pi / 8)
    assert curvature.max() == pytest.approx(1 / reach) and set(curvature[[0, -1]]) == {0.0}
    assert distance_to_polyline(xy, points[:, :2]).max() < 0.32


polylines = st.lists(
    st.tuples(st.floats(0.05, 40), st.floats(-2.0, 2.0)), min_size=1, max_size=12
)  # length of each segment and turn before it


@pytest.mark.engine
@settings(max_examples=150, deadline=None, derandomize=True)
@given(polylines, st.sampled_from([0.05, 0.32, math.inf]))
def test_curve_of_any_polyline(steps, tolerance):
    heading = np.cumsum([turn for _, turn in steps])
    xy = np.cumsum(
        [(0, 0)] + [(d * math.cos(h), d * math.sin(h)) for (d, _), h in zip(steps, heading, strict=True)], 0
    )
    points = np.column_stack([xy, np.zeros(len(xy))])
    curve = fit_polyline(points, tolerance=tolerance)
    end = np.cumsum(curve.length)
    # Starts and ends where the polyline does; position and heading are continuous.
    assert np.allclose(curve.xy[0], points[0, :2]) and np.allclose(
        curve.at(end[-1:])[0][0], points[-1, :2], atol=1e-7
    )
    before, after = curve.at(end[:-1] - 1e-9), curve.at(end[:-1] + 1e-9)
    assert np.abs(before[0] - after[0]).max(initial=0) < 1e-7
    bend = 1e-8 * (np.abs(curve.curvature).max() + 1)
    assert np.abs(before[1] - after[1]).max(initial=0) < 1e-7 + bend
    assert np.isfinite(curve.curvature).all() and (np.diff(curve.vertex_s) >= 0).all()
    if math.isfinite(tolerance) and not curve.spikes:
        s = np.linspace(0, curve.total, 400)
        reached = distance_to_polyline(curve.at(s)[0], points[:, :2]).max()
        assert reached <= 1.3 * tolerance + 0.01  # 1 cm for vertices left out; the bulge is an estimate


def test_pose_is_within_a_tenth_of_a_millimetre_of_the_curve(read):
    shape = "0,0 30,0 34,1 37,3 39,6 40,10 40,60 42,70 50,75 50,90"
    mine = read(one_lane(shape, length=130.0)).lanes["e_0"]
    points = np.array([[*map(float, p.split(",")), 0.0] for p in shape.split()])
    curve = fit_polyline(points, tolerance=0.32)
    s = np.linspace(0, curve.total, 5000)
    assert np.abs(mine.pose(s)[0][:, :2] - curve.at(s)[0]).max() < 1e-4
    polyline = mine.pose(s)[0][:, :2]
    assert np.hypot(*np.diff(polyline, axis=0).T).sum() == pytest.approx(mine.length, abs=1e-3)
    turned = np.interp(s, mine.s, mine.curvature)[:-1] @ np.diff(s)  # curvature is the slope of the heading
    assert turned == pytest.approx(mine.heading[-1] - mine.heading[0], abs=0.02)


@pytest.mark.engine
def test_curves_inside_junctions_are_nearer_to_what_was_sampled(generated, tmp_path):
    found = referee.compare_inside(generated["spider"], "spider", tmp_path)
    assert found.lanes > 100
    assert found.ours[0] < 0.5 * found.polyline[0] and found.ours[0] < 0.1


@pytest.mark.parametrize(
    ("shape", "length", "message"),
    [
        ("0,0", 0.01, "no extent"),
        ("0,0 0,0", 0.01, "no extent"),
        ("0,0 0,0 50,0 50,0 100,0", 100.0, "repeated"),
        ("0,0 60,0 40,0.1 100,0", 140.0, "folds back"),
    ],
)
def test_degenerate_shapes_are_repaired_and_reported(read, shape, length, message):
    network = read(one_lane(shape, length=length))
    assert_sound(network)
    assert network.lanes["e_0"].length == pytest.approx(0.01 if length < 1 else 100, rel=0.01)
    found = notes(network, Action.REPAIRED, "lane")
    assert any(message in note for note in found)
    assert network.report.counts["lane", Action.READ] == 0


@pytest.mark.parametrize("speed", ["0", "-0.0", "-5"])
def test_speed_that_is_not_above_zero_is_that_of_the_other_lanes(read, speed):
    lanes = [lane("e", i, f"0,{3 * i} 100,{3 * i}") for i in range(3)]
    lanes[1] = lanes[1].replace('speed="10"', f'speed="{speed}"')
    network = read(net(edge("e", *lanes)))
    assert_sound(network)
    assert [lane.speed_limit for lane in network.lanes.values()] == [10.0, 10.0, 10.0]
    (message,) = notes(network, Action.REPAIRED, "lane")
    assert "10 m/s" in message


def test_link_that_is_its_own_foe_is_repaired(read):
    good = read(junction_net())
    network = read(GOOD.replace('response="00" foes="01"', 'response="10" foes="11"'))
    assert network.movements == good.movements
    assert notes(network, Action.REPAIRED, "request") == ["link 1 was its own foe; left out"]
    assert network.report.counts["request", Action.READ] == 1


def test_lanes_of_a_junction_that_is_none(read):
    network = read(GOOD.replace('junction id="j" type="priority"', 'junction id="j" type="internal"'))
    assert not network.junctions.get("j")
    assert all(lane.junction in {None, *network.junctions} for lane in network.lanes.values())
    assert any("no junction names it" in note for note in notes(network, Action.APPROXIMATED, "edge"))


def test_kinks_between_lanes_are_reported(read):
    network = read(junction_net().replace('shape="10,3 110,3"', 'shape="10,3 10,103"'))
    (message,) = notes(network, Action.APPROXIMATED, "lane@joint")
    assert message.startswith("1 joints")


# ---- files that are wrong

GOOD = junction_net()
BOMB = '<!DOCTYPE net [<!ENTITY a "xxxxxxxxxx"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>'
BAD: dict[str, tuple[str | bytes, str]] = {
    "empty": ("", "empty"),
    "blank": ("  \n", "empty"),
    "binary": (bytes(range(256)) * 4, "not well-formed"),
    "truncated": (GOOD[: len(GOOD) // 2], "not well-formed"),
    "wrong root": ("<OpenDRIVE/>", "root element"),
    "no edges": ("<net version='1.9'/>", "no edges"),
    "bomb": (BOMB + GOOD.replace('id="w"', 'id="&b;"'), "DOCTYPE"),
    "external entity": ('<!DOCTYPE net [<!ENTITY x SYSTEM "file:///etc/passwd">]>' + GOOD, "DOCTYPE"),
    "no id": (GOOD.replace('<edge id="w"', "<edge"), "'id' is missing"),
    "no speed": (GOOD.replace('speed="10"', "", 1), "'speed' is missing"),
    "nan": (GOOD.replace('speed="10"', 'speed="nan"', 1), "'speed' is 'nan', not a finite number"),
    "inf": (GOOD.replace('length="100.0"', 'length="1e999"', 1), "not a finite number"),
    "text": (GOOD.replace('index="0" speed', 'index="x" speed', 1), "'index' is 'x'"),
    "negative": (GOOD.replace('length="100.0"', 'length="-1"', 1), "below 0"),
    "shape": (GOOD.replace('shape="0,0 4,0"', 'shape="0,0 4"'), "is not x,y"),
    "shape nan": (GOOD.replace('shape="0,0 4,0"', 'shape="0,0 4,nan"'), "not a finite number"),
    "no shape": (GOOD.replace('shape="0,0 4,0"', 'shape=""'), "shape is empty"),
    "far": (GOOD.replace('shape="0,0 4,0"', 'shape="0,0 1e300,0"'), "away"),
    "edge twice": (GOOD.replace('<edge id="s"', '<edge id="w"'), "second edge"),
    "lane twice": (GOOD.replace('<lane id="s_0"', '<lane id="w_0"'), "second lane"),
    "junction twice": (GOOD.replace('junction id=":j_3_0"', 'junction id=":j_2_0"'), "second junction"),
    "no lanes": (GOOD.replace("</net>", '<edge id="z" from="a" to="b"/></net>'), "no lanes"),
    "function": (GOOD.replace('function="internal"', 'function="odd"', 1), "function='odd'"),
    "no such edge": (GOOD.replace('connection from="w"', 'connection from="q"'), "no edge from='q'"),
    "no such lane": (GOOD.replace('from="s" to="n" fromLane="0"', 'from="s" to="n" fromLane="7"'), "no lane"),
    "no such via": (GOOD.replace('via=":j_1_0"', 'via="q"'), "no lane via='q'"),
    "incoming": (GOOD.replace('incLanes="w_0', 'incLanes="q'), "no incoming lane 'q'"),
    "internal": (GOOD.replace('intLanes=":j_3_0 ', 'intLanes="q '), "no internal lane 'q'"),
    "dir": (GOOD.replace('dir="s"', 'dir="x"', 1), "'dir' is 'x'"),
    "state": (GOOD.replace('state="m"', 'state="q"', 1), "'state' is 'q'"),
    "short bits": (GOOD.replace('response="10"', 'response="1"'), "1 bits of response"),
    "odd bits": (GOOD.replace('foes="01"', 'foes="2x"'), "letters other than 0 and 1"),
    "request twice": (GOOD.replace('request index="1"', 'request index="0"'), "second request"),
    "request missing": (
        GOOD.replace('<request index="1" response="00" foes="01" cont="0"/>', ""),
        "1 requests for 2 links",
    ),
    "circle": (
        GOOD.replace('from=":j_3" to="e" fromLane="0"', 'from=":j_3" to="e" via=":j_0_0" fromLane="0"'),
        "circle",
    ),
    "dead via": (
        GOOD.replace('connection from=":j_2" to="e"', 'connection from=":j_2" to="n"'),
        "no connection on",
    ),
    "phase state": (
        GOOD.replace("</net>", '<tlLogic id="t"><phase duration="1" state="xx"/></tlLogic></net>'),
        "letters",
    ),
    "no phases": (GOOD.replace("</net>", '<tlLogic id="t"/></net>'), "no phases"),
    "phase next": (
        GOOD.replace("</net>", '<tlLogic id="t"><phase duration="1" state="r" next="4"/></tlLogic></net>'),
        "beyond the last phase",
    ),
    "link index": (
        junction_net(
            "o", 'tl="t" linkIndex="5"', extra='<tlLogic id="t"><phase duration="1" state="rG"/></tlLogic>'
        ),
        "controls link 5",
    ),
    "neighbour": (GOOD.replace("></lane>", '><neigh lane="q"/></lane>', 1), "no lane 'q'"),
    "no speed above 0": (GOOD.replace('speed="10"', 'speed="0"', 1), "speed='0' is not above 0"),
    "negative speed": (GOOD.replace('speed="10"', 'speed="-3"', 1), "speed='-3' is not above 0"),
    "no junction type": (
        GOOD.replace('junction id=":j_2_0" type="internal"', 'junction id=":j_2_0"'),
        "'type' is missing",
    ),
    "junction type": (
        GOOD.replace('junction id=":j_2_0" type="internal"', 'junction id=":j_2_0" type="priority"'),
        "incoming lane ':j_0_0' is inside a junction",
    ),
    "from inside": (
        GOOD.replace('<edge id="w"', '<edge id="w" function="internal"'),
        "incoming lane 'w_0' is inside a junction",
    ),
    "to inside": (
        GOOD.replace('<edge id="e"', '<edge id="e" function="internal"'),
        "leads to lane 'e_0' inside a junction",
    ),
    "gzip": (gzip.compress(GOOD.encode())[:200], "damaged gzip"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files(tmp_path, name):
    content, message = BAD[name]
    assert content != GOOD
    path = tmp_path / "bad.net.xml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(MapError) as caught:
        read_sumo(path)
    text = str(caught.value)
    assert text.startswith(str(path)) and message in text and "\n" not in text
    if name not in {"empty", "blank", "no edges", "bomb", "external entity", "gzip"}:
        assert caught.value.line is not None


def test_files_that_cannot_be_read(tmp_path):
    for path in (tmp_path, tmp_path / "none.net.xml"):
        with pytest.raises(MapError, match=str(path)):
            read_sumo(path)


def test_gzip_is_the_same(tmp_path):
    (tmp_path / "a.net.xml").write_text(GOOD)
    (tmp_path / "a.net.xml.gz").write_bytes(gzip.compress(GOOD.encode()))
    plain, packed = read_sumo(tmp_path / "a.net.xml"), read_sumo(tmp_path / "a.net.xml.gz")
    assert plain.movements == packed.movements and plain.name == packed.name == "a"
    assert plain.file_hash == packed.file_hash


@pytest.mark.engine
def test_mutated_files_raise_map_errors_only(generated, tmp_path):
    """Any damage gives a sound network or one clear error."""
    source = generated["grid with lights, crossings, bicycle lanes"]
    rng = random.Random(7)
    path = tmp_path / "mutant.net.xml"
    values = ["", "nan", "-1", "1e30", "x", "99999999999999999999", "0,0", "all", ":B1_0_0", "\u0414"]
    failures = 0
    for _ in range(60):
        tree = etree.parse(source)
        elements = [e for e in tree.getroot().iter() if isinstance(e.tag, str)]
        for element in rng.sample(elements[1:], 2):
            match rng.randrange(4):
                case 0 if element.attrib:
                    del element.attrib[rng.choice(list(element.attrib))]
                case 1 if element.attrib:
                    element.set(rng.choice(list(element.attrib)), rng.choice(values))
                case 2 if (parent := element.getparent()) is not None:
                    parent.remove(element)
                case _:
                    element.tag = "odd"
        tree.write(path)
        try:
            assert_sound(read_sumo(path))
        except MapError as error:
            failures += 1
            assert str(path) in str(error) and len(str(error)) > len(str(path)) + 5
    assert 10 < failures < 60


def test_sumolib_reads_the_hand_written_net(tmp_path):
    """The net that most tests here start from is a good one."""
    path = tmp_path / "a.net.xml"
    path.write_text(GOOD)
    result, _ = referee.compare(path)
    assert result.mismatches == [] and sumolib.net.readNet(str(path)).getNode("j").areFoes(0, 1)
