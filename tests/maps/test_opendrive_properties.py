"""Random OpenDRIVE roads: what the reader makes of them against direct evaluation of the formulas."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
import pytest
import xodr_writer as w
from hypothesis import HealthCheck, currently_in_test_context, given, note, settings
from hypothesis import strategies as st
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]
from opendrive_formulas import OpenDriveFormulas

from limsim_jax.maps.network import Lane, Network
from limsim_jax.maps.opendrive import read_opendrive

pytestmark = pytest.mark.engine

POSE = 1e-4  # m, what `Lane.pose` promises between samples
KINK = 0.02  # m; around a kink the centre line is rounded off within this


def examples(count: int) -> settings:
    """The same examples in every run."""
    slow = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture, HealthCheck.data_too_large]
    return settings(
        max_examples=count, derandomize=True, deadline=None, database=None, suppress_health_check=slow
    )


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("roads")


def read(folder: Path, xml: bytes) -> Network:
    path = folder / "road.xodr"
    path.write_bytes(xml)
    return read_opendrive(path)


def angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.abs(np.angle(np.exp(1j * (a - b))))


def knots(road: w.Element, number: int) -> np.ndarray:
    """Road coordinates where the formulas of a lane change."""
    at = {float(g.get("s")) for g in road.iter("geometry")}
    at |= {float(o.get("s")) for o in road.iter("laneOffset")}
    for section in road.iter("laneSection"):
        at.add(float(section.get("s")))
        for lane in section.iter("lane"):
            if int(lane.get("id")) * number > 0:
                at |= {float(section.get("s")) + float(r.get("sOffset")) for r in lane if r.get("sOffset")}
    return np.array(sorted(at))


def check_lane(network: Network, truth: OpenDriveFormulas, road: w.Element, shares: list[float]) -> None:
    """Every lane record of a road at these shares of its length, kept clear of kinks."""
    formulas = truth.roads[road.get("id")]
    for record in formulas.lanes:
        s = record.s0 + np.array(shares) * (record.s1 - record.s0)
        apart = np.abs(s[:, None] - knots(road, record.number)).min(1)
        s = s[apart > KINK]
        place = formulas.lane(record.section, record.number, s)
        for i, at in enumerate(s):
            lane = network.lane_at(record.road, record.number, float(at))
            exact = np.array([place.x[i], place.y[i]])
            arc = lane.s_at_road(at)
            # Between samples `road_s` is interpolated, so go to the foot of the perpendicular.
            for _ in range(3):
                position, heading = lane.pose(arc)
                along = (exact - position[:2]) @ (math.cos(heading), math.sin(heading))
                arc = np.clip(arc + along, 0.0, lane.length)
            position, heading = lane.pose(arc)
            if currently_in_test_context():
                note(f"road {record.road} section {record.section} lane {record.number} s {at}")
            assert np.hypot(*(position[:2] - exact)) < POSE
            assert angle(heading, place.heading[i]) < 1e-3
            assert abs(arc - lane.s_at_road(at)) < 5e-3
            assert abs(lane.width_at(lane.s_at_road(at)) - place.width[i]) < 2e-3
            assert lane.type == record.type
            assert lane.speed_limit == pytest.approx(limit(road, record.section, record.number, at), rel=1e-6)


def limit(road: w.Element, section: int, number: int, s: float) -> float:
    """Speed limit in m/s: the lane's own from where it starts, before that the road's."""
    speeds = [(-1.0, road.find("type/speed"))]
    lane_section = road.findall("lanes/laneSection")[section]
    for lane in lane_section.iter("lane"):
        if int(lane.get("id")) == number:
            speeds += [(float(v.get("sOffset")), v) for v in lane.findall("speed")]
    active = max((v for v in speeds if v[0] <= s - float(lane_section.get("s"))), key=lambda v: v[0])[1]
    return float(active.get("max")) * w.TO_MS[active.get("unit")]


shares = st.lists(st.floats(0.0, 1.0), min_size=4, max_size=4)


@examples(80)
@given(road=w.road(), shares=shares)
def test_lanes_lie_where_the_formulas_put_them(folder: Path, road: w.Element, shares: list[float]) -> None:
    xml = w.opendrive(road)
    note(xml.decode())
    check_lane(read(folder, xml), OpenDriveFormulas(xml), etree.fromstring(xml).find("road"), shares)


@examples(60)
@given(road=w.road(kinds=w.EXACT))
def test_samples_lie_on_the_curve(folder: Path, road: w.Element) -> None:
    """At the samples themselves nothing is interpolated: line, arc and spiral to 1e-6 m."""
    xml = w.opendrive(road)
    note(xml.decode())
    network, truth = read(folder, xml), OpenDriveFormulas(xml)
    element = etree.fromstring(xml).find("road")
    formulas = truth.roads["1"]
    for lane in network.lanes.values():
        clear = np.abs(lane.road_s[:, None] - knots(element, lane.number)).min(1) > KINK
        s = lane.road_s[clear]
        if not len(s):
            continue
        for section in {formulas.section_at(at) for at in s}:
            here = np.array([formulas.section_at(at) == section for at in s])
            place = formulas.lane(section, lane.number, s[here])
            note(f"lane {lane.id}")
            np.testing.assert_allclose(lane.xyz[clear][here, 0], place.x, atol=1e-6)
            np.testing.assert_allclose(lane.xyz[clear][here, 1], place.y, atol=1e-6)
            np.testing.assert_allclose(angle(lane.heading[clear][here], place.heading), 0.0, atol=1e-6)
            np.testing.assert_allclose(lane.width[clear][here], place.width, atol=1e-9)
            np.testing.assert_allclose(lane.xyz[clear][here, 2], formulas.elevation(s[here])[0], atol=1e-9)


@examples(40)
@given(road=w.road())
def test_lengths_and_curvatures(folder: Path, road: w.Element) -> None:
    """The lanes of a number together are as long as its records, and bend as their headings turn."""
    xml = w.opendrive(road)
    note(xml.decode())
    network, truth = read(folder, xml), OpenDriveFormulas(xml)
    formulas = truth.roads["1"]
    exact, found = defaultdict[int, float](float), defaultdict[int, float](float)
    for record in formulas.lanes:
        exact[record.number] += formulas.lane_length(record)
    element = etree.fromstring(xml).find("road")
    for lane in network.lanes.values():
        found[lane.number] += lane.length
        note(f"lane {lane.id}")
        clear = np.abs(lane.road_s[:, None] - knots(element, lane.number)).min(1) > KINK
        along = 1 if formulas.runs_with_s(lane.number) else -1
        which = np.array([formulas.section_at(s) for s in lane.road_s])
        for section in np.unique(which[clear]):
            s = lane.road_s[clear & (which == section)]
            before, here, after = (formulas.lane(section, lane.number, s + ds) for ds in (-1e-3, 0.0, 1e-3))
            turn = np.angle(np.exp(1j * (after.heading - before.heading))) / 2e-3 / here.speed
            bend = lane.curvature[clear & (which == section)]
            np.testing.assert_allclose(bend, along * turn, rtol=1e-3, atol=1e-5)
    assert found.keys() == exact.keys()
    for number in exact:
        # Kinks and steps between lane sections are bridged within millimetres.
        assert found[number] == pytest.approx(exact[number], abs=0.02), number


@examples(100)
@given(chain=w.chains())
def test_roads_that_meet_are_linked_as_traffic_drives(folder: Path, chain: w.Chain) -> None:
    note(chain.xml.decode())
    network = read(folder, chain.xml)
    lanes = network.lanes

    def end(lane: Lane) -> tuple[str, int]:
        return lane.road, lane.number

    links = {(end(lane), end(lanes[i])) for lane in lanes.values() for i in lane.successors}
    assert links == chain.expected_links()
    assert {(end(lanes[i]), end(lane)) for lane in lanes.values() for i in lane.predecessors} == links
    for lane in lanes.values():
        for following in (lanes[i] for i in lane.successors):
            # A link is a place where lanes meet: no step and no kink in the direction of travel.
            assert np.hypot(*(lane.xyz[-1] - following.xyz[0])[:2]) < 1e-6
            assert angle(lane.heading[-1], following.heading[0]) < 1e-6
    for piece in chain.pieces:
        for slot in (s for s in range(-piece.right, piece.left + 1) if s):
            lane = network.lane_at(piece.road, piece.number(slot), piece.length / 2)
            assert lane.junction == (f"{piece.road}9" if piece.junction else None)
            # Right of the path traffic goes along it (right-hand rule), and neighbours go the same way.
            with_s = ((slot < 0) != chain.left_hand) != piece.reversed
            assert (lane.road_s[-1] > lane.road_s[0]) == with_s
    movements = {
        (m.junction, end(lanes[m.incoming]), tuple(end(lanes[v]) for v in m.via), end(lanes[m.outgoing]))
        for m in network.movements
    }
    assert movements == {
        (f"{b[0]}9", a, (b,), c)
        for a, b in links
        for b_, c in links
        if b == b_ and any(p.junction and p.road == b[0] for p in chain.pieces)
    }


@examples(40)
@given(chain=w.chains())
def test_neighbours_stand_beside_each_other(folder: Path, chain: w.Chain) -> None:
    note(chain.xml.decode())
    network = read(folder, chain.xml)
    for lane in network.lanes.values():
        middle, heading = lane.pose(lane.length / 2)
        for other, side in ((lane.left, 1.0), (lane.right, -1.0)):
            if other is None:
                continue
            beside, facing = network.lanes[other].pose(network.lanes[other].length / 2)
            leftward = (beside - middle)[:2] @ (-math.sin(heading), math.cos(heading))
            assert leftward == pytest.approx(side * w.WIDTH, abs=1e-3)
            assert angle(heading, facing) < 1e-6
    count = Counter(lane.road for lane in network.lanes.values())
    assert count == {p.road: p.left + p.right for p in chain.pieces}


def test_the_checks_can_fail(folder: Path) -> None:
    """A road read from one file does not pass for that of another, 1 mm wider."""
    road = w.node(
        "road",
        w.node("type", w.node("speed", max=50.0, unit="km/h"), s=0.0, type="town"),
        w.node("planView", w.node("geometry", w.node("line"), s=0.0, x=0.0, y=0.0, hdg=0.0, length=50.0)),
        w.node(
            "lanes",
            w.node(
                "laneSection",
                w.node("center", w.node("lane", id=0, type="none")),
                w.node(
                    "right",
                    w.node(
                        "lane",
                        w.node("width", sOffset=0.0, a=3.5, b=0.0, c=0.0, d=0.0),
                        id=-1,
                        type="driving",
                    ),
                ),
                s=0.0,
            ),
        ),
        id="1",
        length=50.0,
        junction=-1,
    )
    xml = w.opendrive(road)
    network = read(folder, xml)
    check_lane(network, OpenDriveFormulas(xml), road, [0.3, 0.5])
    other = OpenDriveFormulas(xml.replace(b'a="3.5"', b'a="3.501"'))
    with pytest.raises(AssertionError):
        check_lane(network, other, road, [0.3, 0.5])
