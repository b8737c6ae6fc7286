"""Roads cut into pieces and lanes that are closed, against the uncut map."""

import numpy as np
import pytest
from paths import SHARED
from traffic_worlds import bundled

from limsim_jax.maps import build_lane_map, read_network
from limsim_jax.maps.cut import close, cut, piece_at
from limsim_jax.maps.lane_map import lane_rows
from limsim_jax.maps.network import LaneType


def sumo():
    file = SHARED / "sumo" / "limsim_corridor" / "corridor.net.xml"
    if not file.exists():
        pytest.skip(f"no {file}")
    return read_network(file, cache=False)


def network_of(name):
    return sumo() if name == "sumo" else bundled(name)[0]


NETWORKS = ("highway", "intersection", "long_route", "sumo")


def cuts_of(network, count=3):
    """The longest sections outside junctions, cut twice at uneven places."""
    lanes = [x for x in network.drivable_lanes() if x.junction is None and x.length > 40]
    longest = sorted(lanes, key=lambda lane: -lane.length)
    found = {}
    for lane in longest:
        low, high = sorted((float(lane.road_s[0]), float(lane.road_s[-1])))
        found.setdefault((lane.road, lane.section), (low + 0.31 * (high - low), low + 0.55 * (high - low)))
    return dict(list(found.items())[:count])


@pytest.mark.parametrize("name", NETWORKS)
def test_pieces_lie_on_their_lane_and_follow_each_other(name):
    network = network_of(name)
    cuts = cuts_of(network)
    pieces = cut(network, cuts)
    touched = [x for x in network.lanes.values() if (x.road, x.section) in cuts]
    assert touched
    for lane in touched:
        names = [lane.id, f"{lane.id}/1", f"{lane.id}/2"]
        parts = [pieces.lanes[x] for x in names]
        assert sum(part.length for part in parts) == pytest.approx(lane.length, abs=1e-6)
        assert f"{lane.id}/3" not in pieces.lanes
        start = 0.0
        for k, part in enumerate(parts):
            s = np.linspace(0, part.length, 17)
            xyz, heading = part.pose(s)
            wanted, along = lane.pose(start + s)
            np.testing.assert_allclose(xyz, wanted, atol=1e-3)
            np.testing.assert_allclose(np.cos(heading - along), 1.0, atol=1e-5)
            np.testing.assert_allclose(part.width_at(s), lane.width_at(start + s), atol=1e-6)
            assert piece_at(pieces.lanes, lane.id, start + part.length / 2)[0] == names[k]
            start += part.length
            if k:
                assert part.predecessors == (names[k - 1],)
                assert parts[k - 1].successors == (names[k],)
        # along the road sections are in order, whichever way the lane runs
        forward = lane.road_s[-1] >= lane.road_s[0]
        numbers = [part.section for part in parts][:: 1 if forward else -1]
        assert numbers == [numbers[0], numbers[0] + 1, numbers[0] + 2]


@pytest.mark.parametrize("name", NETWORKS)
def test_neighbours_stay_abreast_and_links_go_both_ways(name):
    network = network_of(name)
    pieces = cut(network, cuts_of(network))
    for lane in pieces.lanes.values():
        for side, back in (("left", "right"), ("opposite", "opposite")):
            other = pieces.lanes.get(getattr(lane, side) or "")
            if other is None or getattr(network.lanes.get(other.id, other), back) is None:
                continue
            middle = float(lane.road_s[[0, -1]].mean())
            assert min(other.road_s[0], other.road_s[-1]) <= middle <= max(other.road_s[0], other.road_s[-1])
        for after in lane.successors:
            if after in pieces.lanes and "/" in lane.id + after:
                assert lane.id in pieces.lanes[after].predecessors
    for movement in pieces.movements:
        before = network.movements[movement.index]
        assert pieces.lanes[movement.incoming].xyz[-1] == pytest.approx(
            network.lanes[before.incoming].xyz[-1]
        )
        assert pieces.lanes[movement.outgoing].xyz[0] == pytest.approx(network.lanes[before.outgoing].xyz[0])
    for after, before in zip(pieces.stop_lines, network.stop_lines, strict=True):
        here = pieces.lanes[after.spot.lane].pose(after.spot.s)[0]
        np.testing.assert_allclose(here, network.lanes[before.spot.lane].pose(before.spot.s)[0], atol=1e-3)


def test_a_cut_map_leads_to_the_same_goals():
    network, lane_map = bundled("long_route")
    pieces = cut(network, cuts_of(network))
    arrays = build_lane_map(pieces)
    rows, cut_rows = lane_rows(network), lane_rows(pieces)
    for lane, row in rows.items():
        np.testing.assert_array_equal(arrays.routes.reachable[cut_rows[lane]], lane_map.routes.reachable[row])
        distance = np.asarray(lane_map.routes.distance[row])
        fine = np.isfinite(distance)
        np.testing.assert_allclose(
            np.asarray(arrays.routes.distance[cut_rows[lane]])[fine], distance[fine], rtol=1e-4
        )


def test_closed_lanes_are_left_out_and_their_traffic_must_change_lanes():
    network, _ = bundled("highway")
    pieces = cut(network, {("1", 0): (400.0, 700.0)})
    closed = close(pieces, ["1_0_-5/1"])
    assert closed.lanes["1_0_-5/1"].type is LaneType.ROAD_WORKS
    assert "1_0_-5/1" not in lane_rows(closed)
    arrays, rows = build_lane_map(closed), lane_rows(closed)
    goal = int(np.flatnonzero(np.asarray(arrays.routes.reachable[rows["1_0_-4"]]))[0])
    before, beside = rows["1_0_-5"], rows["1_0_-4"]
    assert (
        int(arrays.routes.next_lane[before, goal]) == -1 and int(arrays.routes.lanes_to_go[before, goal]) != 0
    )
    assert int(arrays.routes.next_lane[beside, goal]) == rows["1_0_-4/1"]
    assert bool(arrays.routes.reachable[before, goal])
    # no change into the work zone, and on from behind it
    assert not bool(arrays.may_change_right[rows["1_0_-4/1"]])
    assert not bool(arrays.may_change_left[rows["1_0_-6/1"]])
    assert bool(arrays.routes.reachable[rows["1_0_-5/2"], goal])


def test_cuts_too_near_to_an_end_or_in_a_junction_are_left_out():
    network, _ = bundled("intersection")
    connector = next(lane for lane in network.drivable_lanes() if lane.junction is not None)
    assert cut(network, {(connector.road, connector.section): [5.0]}) is network
    lane = next(lane for lane in network.drivable_lanes() if lane.junction is None and lane.length > 100)
    low, high = sorted((float(lane.road_s[0]), float(lane.road_s[-1])))
    assert cut(network, {(lane.road, lane.section): [low + 1.0, high - 1.0]}) is network
    found = cut(network, {(lane.road, lane.section): [low + 50.0, low + 52.0]})
    assert f"{lane.id}/1" in found.lanes and f"{lane.id}/2" not in found.lanes
